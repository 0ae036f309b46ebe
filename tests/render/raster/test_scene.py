"""Instances, layers, deformation, hostile input, threads, and the depth of the real habitat-sim."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.mesh.mesh import Mesh
from h3data.render import OPENGL_TO_OPENCV, Camera, Renderer, RenderInstance, RenderScene, look_at, pinhole
from h3data.render.raster.clusters import CLUSTER_TRIANGLES, build_clusters
from tests.paths import REAL

IDS = ("depth", "instance", "semantic", "triangle")
CAMERA = pinhole(96, 72, hfov_deg=70, pose=look_at([0.4, 1.1, -4], [0, 0, 0]))


def make_blob(n: int = 12, *, smooth: bool = False) -> Mesh:
    """A unit sphere of 4 n^2 triangles with shared vertices."""
    polar, around = np.meshgrid(np.linspace(0, np.pi, n + 1), np.linspace(0, 2 * np.pi, 2 * n + 1), indexing="ij")
    points = np.stack([np.sin(polar) * np.cos(around), np.cos(polar), np.sin(polar) * np.sin(around)], -1)
    vertices = points.reshape(-1, 3).astype(np.float32)
    i = (np.arange(n)[:, None] * (2 * n + 1) + np.arange(2 * n)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + 2 * n + 2], 1), np.stack([i, i + 2 * n + 2, i + 2 * n + 1], 1)])
    colors = (127 + 120 * vertices).astype(np.uint8)
    normals = vertices.copy() if smooth else None
    return Mesh(vertices=vertices, faces=faces.astype(np.int32), colors=colors, normals=normals)


def moved(mesh: Mesh, matrix: NDArray) -> Mesh:
    """The mesh with the matrix baked into vertices and normals."""
    vertices = (mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)
    normals = None
    if mesh.normals is not None:
        n = mesh.normals @ np.linalg.inv(matrix[:3, :3])
        normals = (n / np.linalg.norm(n, axis=1, keepdims=True)).astype(np.float32)
    return Mesh(vertices=vertices, faces=mesh.faces, colors=mesh.colors, normals=normals)


def translation(x: float, y: float = 0.0, z: float = 0.0) -> NDArray:
    m = np.eye(4)
    m[:3, 3] = x, y, z
    return m


def assert_alike(a: dict, b: dict, *, outliers: float = 0.004) -> None:
    """The same picture up to rounding: silhouette pixels may differ."""
    for name in a:
        same = np.isclose(a[name].astype(float), b[name].astype(float), atol=2e-3 if name == "normal" else 2e-4)
        if name == "rgb":
            same = np.abs(a[name].astype(int) - b[name]) <= 2
        assert (~same).mean() <= outliers, f"{name}: {(~same).mean():.4f} of the values differ"


@settings(max_examples=15, deadline=None, derandomize=True)
@given(st.integers(0, 10_000))
def test_a_scaled_instance_equals_the_baked_mesh(seed):
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    matrix = translation(*rng.uniform(-0.5, 0.5, 3))
    matrix[:3, :3] = turn @ np.diag(rng.uniform(0.3, 2.0, 3) * rng.choice([-1, 1], 3)) @ turn.T @ turn
    mesh = make_blob(10, smooth=bool(seed % 2))
    outputs = ("depth", "triangle", "normal", "rgb")
    placed = Renderer(RenderScene([mesh], [RenderInstance(0, matrix)])).render(CAMERA, outputs=outputs)
    baked = Renderer(RenderScene([moved(mesh, matrix)], [RenderInstance(0, np.eye(4))])).render(CAMERA, outputs=outputs)
    assert (placed["triangle"] >= 0).sum() > 50
    assert_alike(placed, baked)


def test_instance_and_semantic_ids_and_mesh_triangles():
    meshes = [make_blob(4), make_blob(9)]
    instances = [
        RenderInstance(1, translation(-1.5), semantic_id=40),
        RenderInstance(0, translation(0), semantic_id=7),
        RenderInstance(1, translation(1.5), semantic_id=100),
    ]
    picture = Renderer(RenderScene(meshes, instances)).render(CAMERA, outputs=IDS)
    for k, instance in enumerate(instances):
        mask = picture["instance"] == k
        assert mask.sum() > 100
        assert (picture["semantic"][mask] == instance.semantic_id).all()
        assert picture["triangle"][mask].max() < len(meshes[instance.mesh].faces)
    miss = picture["instance"] == -1
    assert miss.any()
    assert (picture["semantic"][miss] == -1).all()
    assert (picture["triangle"][miss] == -1).all()
    assert (picture["depth"][miss] == 0).all()
    assert {name: a.dtype for name, a in picture.items()} == {
        "depth": np.float32,
        "instance": np.int32,
        "semantic": np.int32,
        "triangle": np.int32,
    }


def test_moving_hiding_and_layers():
    instances = [
        RenderInstance(0, translation(0), name="ball"),
        RenderInstance(0, np.diag([3, 3, 0.1, 1]) + translation(0, 0, -1) - np.eye(4), layer="ceiling"),
    ]
    renderer = Renderer(RenderScene([make_blob()], instances))

    def seen(camera: Camera = CAMERA) -> set[int]:
        return set(np.unique(renderer.render(camera, outputs=("instance",))["instance"]).tolist()) - {-1}

    assert seen() == {1}
    layered = Camera(**{**vars(CAMERA), "hidden_layers": ("ceiling", "roof")})
    assert seen(layered) == {0}
    renderer.set_visible(1, False)
    assert seen() == {0}
    renderer.set_transforms([0], translation(100)[None])
    assert seen() == set()
    renderer.set_transforms([0], np.full((1, 4, 4), np.nan))  # a body that is not there
    assert seen() == set()
    renderer.set_transforms(np.array([0]), translation(0, 0.1)[:3])
    renderer.set_visible([0, 1], [True, True])
    assert seen() == {1}
    assert set(np.unique(Renderer(renderer.scene).render(CAMERA)["instance"])) == {-1, 1}, "state must not leak"


def test_deforming_equals_building_again():
    rng = np.random.default_rng(0)
    fixed, soft, other = make_blob(7), make_blob(14, smooth=True), make_blob(5)
    instances = [RenderInstance(k, translation(1.6 * (k - 1))) for k in range(3)]
    scene = RenderScene([soft, fixed, other], instances, deformable=[2, 0])
    renderer, untouched = Renderer(scene), Renderer(scene)
    outputs = ("depth", "instance", "triangle", "normal", "rgb")
    before = untouched.render(CAMERA, outputs=outputs)
    for _ in range(3):
        bend = np.eye(3) + rng.normal(size=(3, 3)) * 0.3
        wave = 1 + 0.2 * np.sin(3 * soft.vertices[:, 1:2])
        new = (soft.vertices @ bend * wave).astype(np.float32)
        renderer.set_vertices(0, new)
        renderer.set_vertices(2, other.vertices * np.float32(0.7))
        a, b, c = (new[soft.faces[:, k]].astype(float) for k in range(3))
        normals = np.zeros((len(new), 3))
        for k in range(3):
            np.add.at(normals, soft.faces[:, k], np.cross(b - a, c - a))
        seam = {}  # the sphere's seam and poles are doubled vertices with one normal
        for v, place in enumerate(np.round(soft.vertices, 4) + 0.0):
            seam.setdefault(tuple(place), []).append(v)
        for group in seam.values():
            normals[group] = normals[group].sum(0)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        rebuilt = Mesh(vertices=new, faces=soft.faces, colors=soft.colors, normals=normals.astype(np.float32))
        small = Mesh(vertices=other.vertices * np.float32(0.7), faces=other.faces, colors=other.colors)
        expected = Renderer(RenderScene([rebuilt, fixed, small], instances)).render(CAMERA, outputs=outputs)
        assert_alike(renderer.render(CAMERA, outputs=outputs), expected, outliers=1e-3)
    for name, picture in untouched.render(CAMERA, outputs=outputs).items():
        np.testing.assert_array_equal(picture, before[name], err_msg="another renderer's vertices leaked")


def test_sharp_edges_stay_sharp_when_a_mesh_deforms():
    # two quads that share an edge whose vertices are doubled with their own normals
    v = np.float32([[-1, -1, 0], [0, -1, -1], [0, 1, -1], [-1, 1, 0], [0, -1, -1], [1, -1, 0], [1, 1, 0], [0, 1, -1]])
    f = np.int32([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    n = np.repeat(np.float32([[-1, 0, -1], [1, 0, -1]]) / np.sqrt(2), 4, axis=0).astype(np.float32)
    mesh = Mesh(vertices=v, faces=f, colors=np.full((8, 3), 200, np.uint8), normals=n)
    renderer = Renderer(RenderScene([mesh], [RenderInstance(0, np.eye(4))], deformable=[0]))
    renderer.set_vertices(0, v * np.float32(1.1))
    normal = renderer.render(pinhole(40, 30, hfov_deg=30, pose=look_at([0, 0, -5], [0, 0, 0])), outputs=("normal",))
    seen = normal["normal"][np.abs(normal["normal"]).max(-1) > 0]
    x = np.unique(np.round(seen[:, 0], 3))
    assert len(x) == 2, f"expected two flat sides, got normals x = {x}"


@pytest.mark.parametrize("meshes", [[], [make_blob(3)], "no triangles"])
def test_empty_scenes_show_the_sky(meshes):
    instances = []
    if meshes == "no triangles":
        bare = Mesh(
            vertices=np.zeros((3, 3), np.float32), faces=np.zeros((0, 3), np.int32), colors=np.zeros((3, 3), np.uint8)
        )
        meshes, instances = [bare], [RenderInstance(0, np.eye(4))]
    picture = Renderer(RenderScene(meshes, instances)).render(CAMERA, outputs=(*IDS, "rgb", "normal"), samples=4)
    assert (picture["instance"] == -1).all()
    assert (picture["depth"] == 0).all()
    assert (picture["normal"] == 0).all()
    assert picture["rgb"].min() > 60


def test_clusters_hold_every_triangle_once_in_their_boxes():
    for n in (1, 3, 8, 40):
        mesh = make_blob(n)
        c = build_clusters(mesh.vertices, mesh.faces)
        used = c.triangles[c.triangles >= 0]
        np.testing.assert_array_equal(np.sort(used), np.arange(len(mesh.faces)))
        assert (np.diff(c.first) * 8 <= CLUSTER_TRIANGLES).all()
        for k in range(len(c.center)):
            soup = c.packets[c.first[k] : c.first[k + 1]].transpose(0, 2, 1).reshape(-1, 3)
            assert (np.abs(soup - c.center[k]) <= c.half[k]).all()
        padding = c.packets.transpose(0, 2, 1)[c.triangles < 0].reshape(-1, 3, 3)
        assert (padding == padding[:, :1]).all(), "padding must be degenerate"


def test_many_equal_triangles_can_be_clustered():
    mesh = make_blob(1)
    same = Mesh(vertices=mesh.vertices, faces=np.tile(mesh.faces[:1], (5000, 1)), colors=mesh.colors)
    assert len(build_clusters(same.vertices, same.faces).center) >= 5000 // CLUSTER_TRIANGLES


def test_threads_with_a_renderer_each_draw_the_same():
    scene = RenderScene([make_blob(20, smooth=True)], [RenderInstance(0, translation(0.3 * k)) for k in range(5)])
    expected = Renderer(scene).render(CAMERA)
    with ThreadPoolExecutor(2) as pool:
        for picture in pool.map(lambda _: Renderer(scene).render(CAMERA), range(8)):
            for name in expected:
                np.testing.assert_array_equal(picture[name], expected[name])


def test_results_are_yours_unless_out_is_given():
    renderer = Renderer(RenderScene([make_blob()], [RenderInstance(0, np.eye(4))]))
    first = renderer.render(CAMERA)
    kept = {name: a.copy() for name, a in first.items()}
    renderer.set_transforms([0], translation(1)[None])
    second = renderer.render(CAMERA, out={"depth": first["depth"]})
    assert second["depth"] is first["depth"]
    assert second["rgb"] is not first["rgb"]
    np.testing.assert_array_equal(first["rgb"], kept["rgb"])
    assert (second["depth"] != kept["depth"]).any()


def test_bad_input_is_refused_with_a_reason():
    mesh = make_blob(2)
    scene = RenderScene([mesh], [RenderInstance(0, np.eye(4))])
    renderer = Renderer(scene)
    broken = Mesh(
        vertices=np.full((3, 3), np.nan, np.float32), faces=np.int32([[0, 1, 2]]), colors=np.zeros((3, 3), np.uint8)
    )
    with pytest.raises(
        InputError,
        match=r"(?s)mesh 1 has vertices that are not finite; instance 0 \(a\) refers to mesh 7.*H3-RENDER-067",
    ):
        RenderScene([mesh, broken], [RenderInstance(7, np.eye(4), name="a")])
    with pytest.raises(InputError, match=r"(?s)4x4.*H3-RENDER-067"):
        RenderScene([mesh], [RenderInstance(0, np.eye(3))])
    with pytest.raises(InputError, match="H3-RENDER-057"):
        renderer.set_vertices(0, mesh.vertices)
    soft = Renderer(RenderScene([mesh], [RenderInstance(0, np.eye(4))], deformable=[0]))
    with pytest.raises(InputError, match=r"(?s)not.*H3-RENDER-058"):
        soft.set_vertices(0, mesh.vertices * np.float32(np.nan))
    with pytest.raises(InputError, match=r"(?s)shape.*H3-RENDER-058"):
        soft.set_vertices(0, mesh.vertices[:-1])
    for index in (1, -1, [0.5]):
        with pytest.raises(InputError, match=r"(?s)0.*0.*H3-RENDER-060"):
            renderer.set_transforms(index, np.eye(4))
    with pytest.raises(InputError, match=r"(?s)1.*H3-RENDER-056"):
        renderer.set_transforms([0], np.eye(3))
    with pytest.raises(InputError, match="H3-RENDER-032"):
        renderer.render(CAMERA, samples=3)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"(?s)out\['depth'\].*float32 \[72, 96\].*H3-RENDER-048"):
        renderer.render(CAMERA, out={"depth": np.zeros((72, 96))})
    for change in ({"width": 0}, {"fx": -1.0}, {"pose": np.full((4, 4), np.nan)}, {"pose": np.diag([2.0, 2, 2, 1])}):
        with pytest.raises(InputError, match="H3-RENDER-009"):
            renderer.render(Camera(**{**vars(CAMERA), **change}))


@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.sampled_from([1e-3, 1.0, 1e4, 1e12, 1e30]))
def test_wild_matrices_never_crash(seed, scale):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(4, 4)) * scale
    matrix[rng.integers(3), rng.integers(4)] = rng.choice([0, np.inf, -np.inf, np.nan, 1])
    scene = RenderScene([make_blob(3, smooth=True)], [RenderInstance(0, matrix)])
    picture = Renderer(scene).render(CAMERA, outputs=(*IDS, "rgb", "normal"))
    assert np.isin(picture["instance"], [-1, 0]).all()


@pytest.mark.parametrize("sensor", ["depth_256x256", "depth_224x171"])
def test_depth_equals_the_real_habitat_sim(sensor):
    folder = REAL / "habitat-sim" / "reference" / "replays" / "room_rigid"
    if not folder.is_dir():
        pytest.skip("habitat-sim reference data (shared/real) are not on this machine")
    trimesh = pytest.importorskip("trimesh")
    room = trimesh.load(REAL / "habitat-sim/data/test_assets/scenes/simple_room.glb", process=False, force="mesh")
    z_up = np.asarray(room.vertices)
    vertices = np.stack([z_up[:, 0], z_up[:, 2], -z_up[:, 1]], 1).astype(np.float32)
    mesh = Mesh(
        vertices=vertices, faces=np.asarray(room.faces, np.int32), colors=np.full(vertices.shape, 200, np.uint8)
    )
    renderer = Renderer(RenderScene([mesh], [RenderInstance(0, np.eye(4))]))
    meta = json.loads((folder / "meta.json").read_text())
    c = meta["cameras"][sensor]
    camera = Camera(
        width=c["width"], height=c["height"], fx=c["fx"], fy=c["fy"], cx=c["cx"], cy=c["cy"], pose=np.eye(4)
    )
    for index in meta["gt_keyframes"]:
        truth = np.load(folder / "gt" / f"{index:04d}_{sensor}.npy")
        pose = np.array(meta["keyframes"][index]["camera_to_world"]) @ OPENGL_TO_OPENCV
        depth = renderer.render(camera.at(pose), outputs=("depth",))["depth"]
        # We draw the room without its objects, and objects only ever stand in front: nowhere may the truth be
        # farther than the room, or empty where the room is. Silhouettes of the room may differ by a pixel.
        room_here = depth > 0
        impossible = room_here & ((truth == 0) | (truth > depth + 1.2e-3))
        assert impossible.mean() <= 1e-4, f"keyframe {index}: {impossible.sum()} pixels"
        same = room_here & (np.abs(truth - depth) <= 1.2e-3)
        assert same.mean() > 0.1, f"keyframe {index}: only {same.mean():.2f} of the picture shows the room"
        if sensor == "depth_256x256":  # here the truth also says which pixels no object covers: semantic id 0
            bare = np.load(folder / "gt" / f"{index:04d}_semantic_256x256.npy") == 0
            assert (bare & room_here).mean() > 0.25
            wrong = bare & (np.abs(truth - depth) > 1.2e-3)
            assert wrong.mean() <= 1e-4, f"keyframe {index}: {wrong.sum()} of {bare.sum()} pixels differ"
