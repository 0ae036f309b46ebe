"""Mesh files and generated primitives: frames, colours, orientation, errors."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh

from h3data.errors import InputError, MissingAssetError, SceneError
from h3data.mesh import loading
from h3data.mesh.gltf_primitives import nearest_texels
from h3data.mesh.loading import frame_rotation, load_mesh
from h3data.mesh.mesh import Mesh
from h3data.mesh.primitives import box_mesh, capsule_mesh, is_primitive, primitive_mesh
from h3data.plugins import Plugin, Registry
from h3data.recording.assets.placeholders import placeholder_mesh, striped_box
from h3data.srgb import linear_to_srgb, srgb_to_linear
from tests.paths import TEST_ASSETS

needs_real = pytest.mark.skipif(not TEST_ASSETS.is_dir(), reason="habitat-sim's test assets are not on this machine")

CAPSULE = "capsule3DSolid_hemiRings_4_cylRings_1_segments_12_halfLen_0.75_useTexCoords_false_useTangents_false"
CYLINDER = "cylinderSolid_rings_1_segments_12_halfLen_1_useTexCoords_false_useTangents_false_capEnds_true"
SOLIDS = [
    "cubeSolid",
    CAPSULE,
    CYLINDER,
    "coneSolid_rings_2_segments_12_halfLen_1.25_capEnd_true",
    "uvSphereSolid_rings_8_segments_16",
    "icosphereSolid_subdivs_1",
]


def volume(mesh: Mesh) -> float:
    """Signed volume: positive if every triangle is counter-clockwise from outside."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces].astype(np.float64), 1, 0)
    return float(np.sum(np.cross(a, b) * c) / 6)


def open_edges(mesh: Mesh) -> int:
    """Edges of positive length without a partner of opposite direction (by position, seams do not count)."""
    keys = np.unique(np.round(mesh.vertices, 5), axis=0, return_inverse=True)[1].reshape(-1)
    f = keys[mesh.faces]
    directed = {(a, b) for t in f for a, b in ((t[0], t[1]), (t[1], t[2]), (t[2], t[0])) if a != b}
    return sum((b, a) not in directed for a, b in directed)


@pytest.mark.parametrize("name", SOLIDS)
def test_solids_are_closed_and_turned_outwards(name: str) -> None:
    mesh = primitive_mesh(name)
    assert is_primitive(name)
    assert volume(mesh) > 0
    assert open_edges(mesh) == 0
    if mesh.normals is not None:
        np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)
        corner_normals = mesh.normals[mesh.faces].mean(1)
        t = mesh.vertices[mesh.faces]
        face_normals = np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
        assert np.all(np.sum(corner_normals * face_normals, -1) > 0)


def test_solids_have_the_size_that_their_name_says() -> None:
    np.testing.assert_allclose(primitive_mesh(CAPSULE).bounds, [[-1, -1.75, -1], [1, 1.75, 1]], atol=1e-6)
    np.testing.assert_allclose(primitive_mesh(SOLIDS[3]).bounds[:, 1], [-1.25, 1.25])
    np.testing.assert_allclose(
        np.linalg.norm(primitive_mesh("icosphereSolid_subdivs_2").vertices, axis=1), 1, atol=1e-6
    )
    assert len(primitive_mesh("icosphereSolid_subdivs_1").faces) == 80
    # a 12-gon prism of radius 1 and height 2
    assert volume(primitive_mesh(CYLINDER)) == pytest.approx(2 * 6 * np.sin(np.pi / 6), abs=1e-5)
    assert not len(primitive_mesh("cubeWireframe").faces)
    with pytest.raises(SceneError, match="H3-MESH-029"):
        primitive_mesh("teapotSolid")
    assert not is_primitive("data/objects/cubeSolid.glb")


def test_capsule_between_any_two_points() -> None:
    a, b = np.array([0.3, -1.0, 2.0]), np.array([-0.5, 0.4, 2.2])
    mesh = capsule_mesh(a, b, 0.2)
    axis = (b - a) / np.linalg.norm(b - a)
    along = np.clip((mesh.vertices - a) @ axis, 0, np.linalg.norm(b - a))
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - (a + along[:, None] * axis), axis=1), 0.2, atol=1e-5)
    assert volume(mesh) > 0


@pytest.mark.parametrize(
    "uri",
    [
        "a/stages/x.glb",
        "data/humanoids/male_0/male_0.glb",
        "data/robots/spot/base.glb",
        "data/objects/ycb/meshes/024_bowl/google_16k/textured.glb",
        "data/fpss/9/9.glb",
    ],
)
def test_placeholders_are_marked(uri: str) -> None:
    mesh = placeholder_mesh(uri)
    magenta = np.all(mesh.colors == (255, 0, 200), axis=1)
    assert magenta.any()
    assert not magenta.all()
    assert volume(mesh) > 0


def test_placeholder_person_stands_on_the_floor_below_its_root() -> None:
    bounds = placeholder_mesh("data/humanoids/humanoid_data/human_f.glb").bounds
    assert bounds[0, 1] == pytest.approx(-0.9, abs=0.01)
    assert 1.6 < bounds[1, 1] - bounds[0, 1] < 1.75
    assert bounds[1, 2] > -bounds[0, 2]  # feet and nose point to +Z


def test_striped_box_has_the_volume_of_its_box() -> None:
    assert volume(striped_box((1, 2, 3), center=(5, 5, 5))) == pytest.approx(48, rel=1e-5)
    assert volume(box_mesh((1, 2, 3), center=(-1, 0, 4))) == pytest.approx(48, rel=1e-5)


# --- frames -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("up", "front"),
    [
        ((0, 1, 0), (0, 0, -1)),
        ((0, 0, 1), (0, 1, 0)),
        ((1, 0, 0), (0, 0, 2)),
        ((0, -1, 0), (0, 0, -1)),
        ((0, 0.6, 0.8), (0, 0.8, -0.6)),
    ],
)
def test_frame_rotation_is_a_rotation_that_takes_up_to_y(up: tuple, front: tuple) -> None:
    rotation = frame_rotation(up, front)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(rotation @ up / np.linalg.norm(up), [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(rotation @ front / np.linalg.norm(front), [0, 0, -1], atol=1e-12)


@pytest.mark.parametrize(
    "axes", [((0, 1, 0), (0, 1, 0)), ((0, 0, 0), (0, 0, -1)), ((0, 1, 0), (0, 0.2, -1)), ((np.nan, 1, 0), (0, 0, -1))]
)
def test_frames_that_are_none(axes: tuple) -> None:
    with pytest.raises(SceneError, match="H3-MESH-025"):
        frame_rotation(*axes)


def test_srgb_round_trip() -> None:
    x = np.linspace(0, 1, 101)
    np.testing.assert_allclose(srgb_to_linear(linear_to_srgb(x)), x, atol=1e-12)
    assert np.rint(linear_to_srgb([0.2, 0.7]) * 255).tolist() == [124, 218]  # as habitat-sim wrote them into a replay


# --- files ------------------------------------------------------------------------------------------------------------
@pytest.fixture
def brick() -> trimesh.Trimesh:
    mesh = trimesh.creation.box(extents=(2.0, 4.0, 6.0))
    mesh.apply_translation((1, 2, 3))  # from the origin to (2, 4, 6)
    return mesh


@pytest.mark.parametrize("suffix", ["glb", "gltf", "obj", "ply", "stl"])
def test_every_format_gives_the_same_brick(brick: trimesh.Trimesh, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"brick.{suffix}"
    if suffix == "gltf":
        for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(brick)).items():
            (tmp_path / name).write_bytes(data)
        (tmp_path / "model.gltf").rename(path)
    else:
        brick.export(path)
    mesh = load_mesh(path)
    np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [2, 4, 6]], atol=1e-6)
    assert volume(mesh) == pytest.approx(48, rel=1e-5)
    turned = load_mesh(path, up=(0, 0, 1), front=(0, 1, 0), units_m=0.5)  # (x, y, z) -> (x, z, -y) / 2
    np.testing.assert_allclose(turned.bounds, [[0, 0, -2], [1, 3, 0]], atol=1e-6)
    assert volume(turned) == pytest.approx(6, rel=1e-5)


def test_scene_graph_is_flattened_and_mirrored_nodes_stay_outside_out(brick: trimesh.Trimesh, tmp_path: Path) -> None:
    scene = trimesh.Scene()
    scene.add_geometry(brick, node_name="left", transform=np.diag([-1.0, 1, 1, 1]))
    shifted = np.eye(4)
    shifted[0, 3] = 10
    scene.add_geometry(brick, node_name="right", transform=shifted)
    path = tmp_path / "two.glb"
    path.write_bytes(trimesh.exchange.gltf.export_glb(scene))
    mesh = load_mesh(path)
    np.testing.assert_allclose(mesh.bounds, [[-2, 0, 0], [12, 4, 6]], atol=1e-6)
    assert volume(mesh) == pytest.approx(96, rel=1e-5)


def test_material_colour_vertex_colour_and_texture(brick: trimesh.Trimesh, tmp_path: Path) -> None:
    from PIL import Image
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    plain = brick.copy()
    plain.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=[51, 128, 255, 255]))
    plain.export(tmp_path / "plain.glb")
    expected = np.rint(linear_to_srgb(np.array([51, 128, 255]) / 255) * 255)
    assert np.all(load_mesh(tmp_path / "plain.glb").colors == expected)

    painted = trimesh.Trimesh(vertices=brick.vertices, faces=brick.faces, process=False)
    painted.visual.vertex_colors = np.array([[10, 20, 30, 255]] * len(brick.vertices), np.uint8)
    painted.export(tmp_path / "painted.ply")
    assert np.all(load_mesh(tmp_path / "painted.ply").colors == (10, 20, 30))

    pixels = np.zeros((2, 2, 3), np.uint8)
    pixels[0, 0], pixels[0, 1], pixels[1, 0], pixels[1, 1] = (255, 0, 0), (0, 255, 0), (0, 0, 255), (9, 9, 9)
    quad = trimesh.Trimesh(
        vertices=[[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], faces=[[0, 1, 2], [0, 2, 3]], process=False
    )
    uv = np.array([[0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [1.25, 0.75]])  # the last wraps around to the left
    quad.visual = TextureVisuals(uv=uv, material=PBRMaterial(baseColorTexture=Image.fromarray(pixels)))
    quad.export(tmp_path / "quad.glb")
    seen = load_mesh(tmp_path / "quad.glb")
    assert seen.uv is not None
    assert np.all(seen.colors == 255)
    np.testing.assert_array_equal(seen.textures[0].pixels[..., :3], pixels)
    texels = nearest_texels(seen.textures[0], seen.uv)
    assert texels[:, :3].tolist() == [[0, 0, 255], [9, 9, 9], [0, 255, 0], [255, 0, 0]]


def test_normals_are_kept_only_if_the_file_has_them(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2)
    (tmp_path / "with.glb").write_bytes(trimesh.exchange.gltf.export_glb(trimesh.Scene(ball), include_normals=True))
    (tmp_path / "without.glb").write_bytes(trimesh.exchange.gltf.export_glb(trimesh.Scene(ball), include_normals=False))
    mesh = load_mesh(tmp_path / "with.glb", up=(0, 0, 1), front=(0, 1, 0))
    assert mesh.normals is not None
    assert np.all(np.sum(mesh.normals * mesh.vertices, 1) > 0.99)  # turned together with the vertices
    assert load_mesh(tmp_path / "without.glb").normals is None


def test_cache_follows_the_file(brick: trimesh.Trimesh, tmp_path: Path) -> None:
    path = tmp_path / "a.stl"
    brick.export(path)
    first = load_mesh(path)
    assert load_mesh(path) is first
    brick.apply_scale(2).export(path)
    os.utime(path, ns=(1, 1))
    assert load_mesh(path).bounds[1, 0] == pytest.approx(2 * first.bounds[1, 0])


def test_files_that_cannot_be_used(tmp_path: Path) -> None:
    with pytest.raises(MissingAssetError, match=r"(?s)absent\.glb.*H3-MESH-022"):
        load_mesh(tmp_path / "absent.glb")
    for name, data in {
        "a.glb": b"glTF\x02\0\0\0",
        "b.glb": b"",
        "c.gltf": b"{",
        "d.ply": b"ply\nformat what 1.0\n",
        "e.stl": b"\0" * 83,
    }.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(SceneError) as caught:
            load_mesh(tmp_path / name)
        assert str(caught.value).endswith(str(tmp_path / name))
        assert caught.value.__suppress_context__ or caught.value.__cause__ is None
    (tmp_path / "f.txt").write_text("x")
    with pytest.raises(SceneError, match=r"(?s)glb, \.gltf.*H3-MESH-023"):
        load_mesh(tmp_path / "f.txt")


def test_compressed_triangles_are_refused_not_drawn_as_nothing(brick: trimesh.Trimesh, tmp_path: Path) -> None:
    for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(brick)).items():
        (tmp_path / name).write_bytes(data)
    path = tmp_path / "model.gltf"
    assert len(load_mesh(path).faces) == 12
    content = json.loads(path.read_text())
    content["extensionsRequired"] = ["KHR_meshopt_compression"]
    path.write_text(json.dumps(content))
    os.utime(path, ns=(1, 1))
    with pytest.raises(SceneError, match=r"(?s)KHR_meshopt_compression.*gltfpack.*H3-MESH-021"):
        load_mesh(path)


@needs_real
def test_real_simple_room_is_turned_from_z_up() -> None:
    mesh = load_mesh(TEST_ASSETS / "scenes" / "simple_room.glb", up=(0, 0, 1), front=(0, 1, 0))
    np.testing.assert_allclose(mesh.bounds, [[-5.247, -0.0614, -5.4486], [5.2798, 2.1535, 5.3979]], atol=1e-3)


@needs_real
def test_real_chair_origin_is_off_its_box_centre() -> None:
    chair = load_mesh(TEST_ASSETS / "objects" / "chair.glb")
    np.testing.assert_allclose(-chair.bounds.mean(0), [0.0740, 0.2070, -0.0059], atol=1e-4)
    assert chair.normals is not None
    assert len(np.unique(chair.textures[0].pixels, axis=0)) > 10


def test_other_packages_read_other_mesh_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cube = box_mesh((1.0, 1.0, 1.0))
    upwards = np.eye(4)
    upwards[1, 3] = 2.0
    readers = Registry("h3data.meshes", {"cube": lambda path: [(cube, upwards)]}, what="reader of mesh files")
    readers.__dict__["_own"] = {"dae": Plugin("dae", "h3data_absent:collada_parts")}  # a package that is not installed
    monkeypatch.setattr(loading, "READERS", readers)
    for name in ("one.cube", "one.dae", "one.xyz"):
        (tmp_path / name).touch()
    np.testing.assert_allclose(load_mesh(tmp_path / "one.cube").vertices, cube.vertices + np.array([0, 2, 0]))
    with pytest.raises(InputError, match=r"(?s)reader of mesh files 'dae'.*h3data_absent.*H3-FILE-010"):
        load_mesh(tmp_path / "one.dae")
    with pytest.raises(SceneError, match=r"(?s)glb, \.gltf, \.cube.*H3-MESH-023"):
        load_mesh(tmp_path / "one.xyz")
