"""The GPU back end against the CPU renderer: on a GPU (marker ``gpu``), and its CUDA C run on the CPU."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.render import blob, box, colored, textured
from h3data.bodies.people.humanoid_file import load_humanoid
from h3data.errors import InputError
from h3data.mesh.mesh import Mesh, Texture
from h3data.render import Camera, Light, Renderer, RenderInstance, RenderScene, look_at, pinhole
from h3data.render.light.sources import Lamp, LightSources
from h3data.render.shade.blockers import Blockers, blocker_rows
from h3data.render.sheets.scene_map import render_scene
from h3data_gpu import AutoEngine, GpuEngine, GpuRenderer, GpuScene, gpu_problem
from h3data_gpu.meshlets import CLUSTER_TRIANGLES, CLUSTER_VERTICES, GROUP_CLUSTERS, build_meshlets
from h3data_gpu.packing import pack_scenes
from h3data_gpu.views import choose_variant
from h3data_homes import HomeSpec, build_home
from h3data_light.bake import lit_scene
from tests.gpu.emulator import COMPILER, EmulatedRenderer

OUTPUTS: Any = ("depth", "instance", "semantic", "triangle", "normal", "rgb")
WIDTH, HEIGHT = 96, 72


@pytest.fixture(scope="session", params=["emulated", pytest.param("gpu", marks=pytest.mark.gpu)])
def make(request, tmp_path_factory):
    """A class of renderers: the CUDA C run by fibers on the CPU, or on a GPU."""
    if request.param == "gpu":
        problem = gpu_problem()
        if problem:
            pytest.skip(problem)
        return GpuRenderer
    if COMPILER is None:
        pytest.skip("g++ is not installed, so the CUDA code cannot be run on the CPU")
    EmulatedRenderer.folder = tmp_path_factory.mktemp("kernels")
    return EmulatedRenderer


# --- comparing ------------------------------------------------------------------------------------------------------
def off_silhouettes(instance: NDArray, depth: NDArray) -> NDArray[np.bool_]:
    """Pixels [H, W] around which one instance is seen without a jump in depth."""

    def around(image: NDArray) -> NDArray:
        padded = np.pad(image, 1, mode="edge")
        return np.lib.stride_tricks.sliding_window_view(padded, (3, 3))

    ids, z = around(instance), around(depth)
    return (ids == instance[..., None, None]).all((2, 3)) & (z.max((2, 3)) < 1.2 * z.min((2, 3)) + 1e-3)


def assert_alike(got: dict[str, Any], want: dict[str, NDArray], *, odd: float = 1e-4) -> None:
    """The contract: depth within 1e-4 m and ids equal on all but a share ``odd`` of the pixels off silhouettes."""
    calm = off_silhouettes(want["instance"], want["depth"])
    assert calm.mean() > 0.3
    shares = {"depth": (np.abs(got["depth"] - want["depth"]) > 1e-4)}
    shares |= {name: got[name] != want[name] for name in ("instance", "semantic", "triangle")}
    shares["normal"] = np.abs(got["normal"] - want["normal"]).max(-1) > 0.02
    shares["rgb"] = np.abs(got["rgb"].astype(int) - want["rgb"]).max(-1) > 3
    limits = {
        "triangle": 0.005,
        "normal": 0.003,
        "rgb": 0.02,
    }  # neighbours meet in edges; textures are cut in blocks of 8
    for name, differs in shares.items():
        share, all_over = differs[calm].mean(), differs.mean()
        assert share <= limits.get(name, odd), f"{name}: {share:.6f} of the pixels off silhouettes differ"
        assert all_over <= 0.05, f"{name}: {all_over:.4f} of the pixels differ"


def compare(make: Any, scene: GpuScene, cameras: list[Camera], pose: Any = None, **options: Any) -> dict[str, NDArray]:
    """Draw with both renderers, a world per camera; ``pose`` changes each (with a GpuRenderer, or a Renderer)."""
    gpu = make(scene, width=cameras[0].width, height=cameras[0].height, worlds=len(cameras))
    cpu = Renderer(scene.scene)
    if pose is not None:
        pose(gpu, cpu)
    got = {name: t.cpu().numpy() for name, t in gpu.render(cameras, outputs=OUTPUTS, **options).items()}
    for k, camera in enumerate(cameras):
        assert_alike({name: t[k] for name, t in got.items()}, cpu.render(camera, outputs=OUTPUTS, **options))
    return got


def views(eyes: Any, targets: Any, *, hfov_deg: float = 80) -> list[Camera]:
    return [pinhole(WIDTH, HEIGHT, hfov_deg=hfov_deg, pose=look_at(e, t)) for e, t in zip(eyes, targets, strict=True)]


@cache
def home_with_person(size: str) -> tuple[RenderScene, int]:
    """A furnished home with a person, and the number of the person's instance."""
    pytest.importorskip("shapely", reason="furnishing a home needs shapely")
    home = render_scene(build_home(HomeSpec(seed=5, preset=size)))  # type: ignore[arg-type]
    body = load_humanoid("female_0").lod_mesh
    mesh = len(home.meshes)
    instances = [*home.instances, RenderInstance(mesh, np.eye(4), semantic_id=77, name="person")]
    return RenderScene([*home.meshes, body], instances, deformable=[mesh]), len(home.instances)


def eight_views(scene: RenderScene) -> list[Camera]:
    """Cameras in the home, at random."""
    floor = np.concatenate([scene.meshes[0].vertices @ m[:, :3].T + m[:, 3] for m in scene.instance_matrix[:1]])
    low, high = floor.min(0), floor.max(0)
    rng = np.random.default_rng(3)
    eyes = np.stack(
        [
            rng.uniform(low[0] + 0.5, high[0] - 0.5, 8),
            rng.uniform(0.5, 1.7, 8),
            rng.uniform(low[2] + 0.5, high[2] - 0.5, 8),
        ],
        axis=1,
    )
    yaw, pitch = rng.uniform(0, 2 * np.pi, 8), rng.uniform(-0.5, 0.1, 8)
    ahead = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(pitch), np.sin(yaw) * np.cos(pitch)], axis=1)
    return views(eyes, eyes + ahead)


def walking(cameras: list[Camera]) -> NDArray[np.floating]:
    """Joint frames [8, 55, 4, 4] of a person who walks in front of each camera."""
    body = load_humanoid("female_0")
    quats, pelvis = body.walk_pose(np.full(len(cameras), 1.2), np.linspace(0, 0.9, len(cameras)))
    roots = np.zeros((len(cameras), 7))
    roots[:, 6] = 1
    for k, camera in enumerate(cameras):
        ahead = camera.pose[:3, 2] * (1, 0, 1)
        roots[k, :3] = camera.pose[:3, 3] * (1, 0, 1) + 1.6 * ahead / np.linalg.norm(ahead)
    return body.joint_matrices(roots, quats, pelvis)


# --- whole homes ----------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("size", ["small", "medium"])
def test_homes_with_a_walking_person_look_as_on_the_cpu(make, size):
    scene, person = home_with_person(size)
    body = load_humanoid("female_0")
    cameras = eight_views(scene)
    joints = walking(cameras)
    mesh = int(scene.instance_mesh[person])
    stage = GpuScene(scene, skins={mesh: (body.lod.influences, body.skin_bind)})
    gpu = make(stage, width=WIDTH, height=HEIGHT, worlds=8)
    gpu.update_joints(body.skin_frames(joints))
    got = {name: t.cpu().numpy() for name, t in gpu.render(cameras, outputs=OUTPUTS).items()}
    cpu, skinned = Renderer(scene), body.skin(joints)
    for k, camera in enumerate(cameras):
        cpu.set_vertices(mesh, skinned[k])
        assert_alike({name: t[k] for name, t in got.items()}, cpu.render(camera, outputs=OUTPUTS))
    assert (got["instance"] == person).sum() > 1000


# --- what may go wrong ----------------------------------------------------------------------------------------------
def ball(n: int = 20, *, smooth: bool = False) -> Mesh:
    mesh = colored(blob((0, 0, 0), (1, 1, 1), n, 1), (200, 120, 60))
    return (
        replace(mesh, normals=(mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)))
        if smooth
        else mesh
    )


def room() -> Mesh:
    return colored(box((0, 1.25, 0), (6, 2.5, 5), 1), (180, 185, 190))


def placed(x: float, y: float, z: float, scale: Any = 1.0) -> NDArray[np.float64]:
    m = np.eye(4)
    m[:3, :3] *= scale
    m[:3, 3] = x, y, z
    return m


ROOM_VIEWS = views([(2, 1.4, 2), (-2, 0.6, -1.9)], [(0, 0.6, 0), (0.3, 1, 0)])


def test_moved_scaled_mirrored_and_sheared_instances(make):
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    odd = placed(-0.8, 0.7, 0.2)
    odd[:3, :3] = turn @ np.diag([0.4, -1.1, 0.7])
    instances = [
        RenderInstance(1, np.eye(4)),
        RenderInstance(0, placed(0.5, 0.6, 0.1, 0.5), semantic_id=4),
        RenderInstance(2, odd),
        RenderInstance(0, placed(0, 1.2, -1, 0.3)),
    ]
    scene = RenderScene([ball(), room(), ball(9, smooth=True)], instances)
    compare(make, GpuScene(scene), ROOM_VIEWS)
    moved = np.stack([placed(0.2, 0.5, 0.4, 0.6), odd @ placed(0.2, 0, 0)])

    def pose(gpu: Any, cpu: Renderer) -> None:
        gpu.update_poses(np.tile(moved, (2, 1, 1, 1)))
        cpu.set_transforms([3, 2], moved)

    compare(make, GpuScene(scene, moving=[3, 2]), ROOM_VIEWS, pose)


def test_nan_poses_and_nan_joints_hide(make):
    scene = RenderScene([ball(), room()], [RenderInstance(1, np.eye(4)), RenderInstance(0, placed(0, 1, 0))])
    gone = np.full((2, 1, 4, 4), np.nan)

    def pose(gpu: Any, cpu: Renderer) -> None:
        gpu.update_poses(gone)
        cpu.set_transforms([1], gone[0])

    got = compare(make, GpuScene(scene, moving=[1]), ROOM_VIEWS, pose)
    assert not (got["instance"] == 1).any()
    body = load_humanoid("female_0")
    scene = RenderScene(
        [room(), body.lod_mesh], [RenderInstance(0, np.eye(4)), RenderInstance(1, np.eye(4))], deformable=[1]
    )
    gpu = make(GpuScene(scene, skins={1: (body.lod.influences, body.skin_bind)}), width=WIDTH, height=HEIGHT, worlds=2)
    fresh = gpu.render(ROOM_VIEWS, outputs=OUTPUTS)
    assert (fresh["instance"] == 1).sum() > 100  # as the scene was built
    gpu.update_joints(np.full((2, 63, 4, 4), np.nan))
    assert not (gpu.render(ROOM_VIEWS, outputs=["instance"])["instance"] == 1).any()


def test_there_is_no_near_plane(make):
    """Eyes in a wall, a centimetre off a wall, and with geometry beside and behind them."""
    scene = RenderScene(
        [room(), ball(), colored(box((0, 0, 0), (1, 1, 1), 1), (90, 140, 90))],
        [RenderInstance(0, np.eye(4)), RenderInstance(1, placed(0, 1, 0)), RenderInstance(2, placed(2, 0.5, 0))],
    )
    eyes = [(3.0, 1.2, 0.3), (2.995, 1.2, 0), (0, 0.004, 2.2), (2.2, 0.6, 0.1), (0.1, 1.1, 0)]
    cameras = views(eyes, [(0, 1, 0), (2.9, 1.2, 2), (0, 0.3, 0), (0, 1, 0), (3, 1, 1)])
    compare(make, GpuScene(scene), cameras)


def test_ids_are_those_of_the_scene(make):
    """Two meshes of one thing share an id; things that stand still, move and deform."""
    instances = [
        RenderInstance(1, np.eye(4), id=40),
        RenderInstance(0, placed(0.5, 0.6, 0.1, 0.5), semantic_id=4, id=7),
        RenderInstance(2, placed(-0.6, 0.8, 0, 0.5), semantic_id=5, id=7),
        RenderInstance(0, placed(0, 1.2, -1, 0.3)),
    ]
    scene = RenderScene([ball(), room(), ball(9)], instances, deformable=[2])
    other = RenderScene([room()], [RenderInstance(0, np.eye(4))])
    got = compare(make, GpuScene(scene, moving=[1]), ROOM_VIEWS)
    assert set(np.unique(got["instance"])) == {3, 7, 40}
    several = make([other, scene], width=WIDTH, height=HEIGHT, worlds=2)
    assert (several.render(ROOM_VIEWS[0], outputs=["instance"])["instance"][1] == 40).any()


def test_baked_light_looks_as_on_the_cpu(make, monkeypatch):
    monkeypatch.setenv("H3DATA_CACHE", "off")
    meshes = [room(), textured(ball(), 1)]
    instances = [RenderInstance(0, np.eye(4)), RenderInstance(1, placed(1, 0.8, 0, 0.5))]
    lamps = LightSources(lamps=(Lamp(np.array([-1.0, 2.2, 0.5]), np.full(3, 4.0)),))
    lit = lit_scene(meshes, instances, [0, 1], lamps)
    assert lit.baked
    scene = RenderScene(lit.meshes, lit.instances)
    gpu = make(GpuScene(scene), width=WIDTH, height=HEIGHT, worlds=1, light=lit.light)
    cpu = Renderer(scene, light=lit.light)
    camera = ROOM_VIEWS[0]
    got = {name: t[0].cpu().numpy() for name, t in gpu.render([camera], outputs=OUTPUTS).items()}
    assert_alike(got, cpu.render(camera, outputs=OUTPUTS))
    assert np.ptp(got["rgb"].astype(int)) > 60  # light and shade


@pytest.mark.parametrize("samples", [1, pytest.param(4, marks=pytest.mark.slow)])
def test_glossy_floors_look_as_on_the_cpu(make, samples):
    meshes = [textured(room(), 1), ball()]
    instances = [RenderInstance(0, np.eye(4)), RenderInstance(1, placed(0, 0.5, 0))]
    mirrors = np.random.default_rng(0).uniform(0, 1.5, (len(meshes[0].vertices), 5)).astype(np.float32)
    dull, glossy = RenderScene(meshes, instances), RenderScene(meshes, instances, mirrors={0: mirrors})
    got = compare(make, GpuScene(glossy, moving=[1]), ROOM_VIEWS, samples=samples)
    plain = compare(make, GpuScene(dull, moving=[1]), ROOM_VIEWS, samples=samples)
    assert (got["rgb"] != plain["rgb"]).any(-1).mean() > 0.3
    for name in ("depth", "instance", "normal"):
        np.testing.assert_array_equal(got[name], plain[name])


@pytest.mark.parametrize("samples", [1, pytest.param(4, marks=pytest.mark.slow)])
def test_soft_shadows_and_tints_look_as_on_the_cpu(make, samples):
    import torch

    rng = np.random.default_rng(5)
    scene = RenderScene(
        [room(), textured(ball(), 1)], [RenderInstance(0, np.eye(4)), RenderInstance(1, placed(0, 0.5, 0))]
    )
    start = rng.uniform([-1.5, 0.1, -1.5], [1.5, 1.2, 1.5], (20, 3))
    capsules = np.column_stack([start, start + rng.normal(0, 0.3, (20, 3)), rng.uniform(0.05, 0.2, 20)])
    group = np.arange(20) // 7
    light = np.array([[0.3, 0.9, 0.3], [-0.6, 0.7, 0.4], [0.0, 1.0, 0.0]])[group]
    light /= np.linalg.norm(light, axis=1, keepdims=True)
    rows = blocker_rows(capsules, group, light, np.array([0.6, 0.3, 0.0])[group], np.full(20, 2.0))
    tints = np.array([[1, 1, 1, -1], [1.2, 0.8, 0.5, 1]], np.float32)
    gpu = make(GpuScene(scene, moving=[1]), width=WIDTH, height=HEIGHT, worlds=2)
    cpu = Renderer(scene)
    cameras = [ROOM_VIEWS[0]] * 2
    plain = gpu.render(cameras, outputs=["rgb"], samples=samples)["rgb"].cpu().numpy()
    gpu.update_blockers([None, Blockers(rows, tints)])
    got = {name: t.cpu().numpy() for name, t in gpu.render(cameras, outputs=OUTPUTS, samples=samples).items()}
    np.testing.assert_array_equal(got["rgb"][0], plain[0])  # of a world without blockers nothing changes
    assert (got["rgb"][1] != plain[1]).any(-1).mean() > 0.2
    on_device = torch.as_tensor(rows, device=gpu.device), torch.as_tensor(tints, device=gpu.device)
    gpu.update_shadows(*(t.expand(2, -1, -1) for t in on_device))
    alike = gpu.render(cameras, outputs=["rgb"], samples=samples)["rgb"].cpu().numpy()
    np.testing.assert_array_equal(alike, got["rgb"][[1, 1]])
    cpu.set_blockers(Blockers(rows, tints))
    want = cpu.render(cameras[1], outputs=OUTPUTS, samples=samples)
    assert_alike({name: t[1] for name, t in got.items()}, want)
    gpu.update_blockers([None, None])
    np.testing.assert_array_equal(gpu.render(cameras, outputs=["rgb"], samples=samples)["rgb"].cpu().numpy(), plain)
    with pytest.raises(InputError, match=r"(?s)2.*H3-RENDER-030"):
        gpu.update_blockers([None])
    for wrong in (on_device, (t[None] for t in on_device), (on_device[0].expand(2, -1, -1), torch.ones(2, 5, 4))):
        with pytest.raises(InputError, match="H3-RENDER-100"):
            gpu.update_shadows(*wrong)


def test_textures_and_smooth_edges(make):
    meshes = [textured(room(), 1), textured(ball(), 2)]
    scene = RenderScene(meshes, [RenderInstance(0, np.eye(4)), RenderInstance(1, placed(0, 0.8, 0))])
    compare(make, GpuScene(scene, moving=[1]), ROOM_VIEWS)
    compare(make, GpuScene(scene), ROOM_VIEWS, samples=4)


@pytest.mark.slow
def test_what_is_clear_is_cut_out(make):
    """Leaves that stand still, move and bend; the same words as on the CPU wherever a texture is not just half opaque."""

    def leafy(mesh: Mesh, seed: int) -> Mesh:
        mesh = textured(mesh, seed)
        clear = np.kron(np.random.default_rng(seed).random((16, 16)) < 0.5, np.ones((32, 32), np.bool_))
        pixels = mesh.textures[0].pixels.copy()
        pixels[..., 3] = np.where(clear, 0, 255)
        return replace(mesh, textures=(Texture(pixels=pixels),))

    meshes = [room(), leafy(ball(), 1), leafy(ball(9), 2)]
    still, moving, soft = placed(0, 0.8, 0, 0.5), placed(-0.7, 0.9, 0.2, 0.5), placed(0.7, 0.8, -0.2)
    instances = [RenderInstance(0, np.eye(4)), *(RenderInstance(m, p) for m, p in ((1, still), (1, moving), (2, soft)))]
    scene = RenderScene(meshes, instances, deformable=[2])
    assert 0 < scene.cut_out_faces.sum() < len(scene.cut_out_faces)
    bent = meshes[2].vertices * np.array([0.5, 1.4, 0.8], np.float32)

    def pose(gpu: Any, cpu: Renderer) -> None:
        gpu.update_vertices(2, np.tile(bent, (2, 1, 1)))
        cpu.set_vertices(2, bent)

    got = compare(make, GpuScene(scene, moving=[2]), ROOM_VIEWS, pose)
    whole = RenderScene([meshes[0], *(replace(m, textures=()) for m in meshes[1:])], instances, deformable=[2])
    covered = Renderer(whole)
    covered.set_vertices(2, bent)
    seen = covered.render(ROOM_VIEWS[0], outputs=("instance",))["instance"]
    for k in (1, 2, 3):
        assert (got["instance"][0] == k).sum() < 0.9 * (seen == k).sum()
    textured_room = RenderScene([leafy(room(), 3)], [RenderInstance(0, np.eye(4))])
    several = make([textured_room, scene], width=WIDTH, height=HEIGHT, worlds=2)
    several.update_vertices(2, np.tile(bent, (2, 1, 1)))
    assert (
        several.render(ROOM_VIEWS[0], outputs=["instance"])["instance"][1].cpu().numpy() == got["instance"][0]
    ).all()


def test_deformed_meshes_without_skin(make):
    scene = RenderScene(
        [ball(9), room(), ball(12, smooth=True)],
        [RenderInstance(1, np.eye(4)), RenderInstance(2, placed(0.6, 0.8, 0)), RenderInstance(0, placed(-0.6, 0.8, 0))],
        deformable=[0, 2],
    )
    stretched = scene.meshes[2].vertices * np.array([0.5, 1.4, 0.8], np.float32)

    def pose(gpu: Any, cpu: Renderer) -> None:
        gpu.update_vertices(2, np.tile(stretched, (2, 1, 1)))
        cpu.set_vertices(2, stretched)

    compare(make, GpuScene(scene), ROOM_VIEWS, pose)


def test_several_scenes_layers_and_views_of_one_world(make):
    one = RenderScene(
        [room(), ball()], [RenderInstance(0, np.eye(4)), RenderInstance(1, placed(0, 1, 0), layer="ball")]
    )
    two = RenderScene(
        [textured(ball(14), 3), textured(room(), 4)],
        [
            RenderInstance(1, np.eye(4), semantic_id=9),
            RenderInstance(0, placed(0.4, 0.5, 0.3), semantic_id=8, layer="ball"),
        ],
    )
    gpu = make([one, GpuScene(two, moving=[1])], width=WIDTH, height=HEIGHT, worlds=3, scene_of_world=[1, 0, 1])
    cameras = [*ROOM_VIEWS, replace(ROOM_VIEWS[0], hidden_layers=("ball",)), ROOM_VIEWS[1]]
    seen = [0, 1, 2, 0]
    got = {name: t.cpu().numpy() for name, t in gpu.render(cameras, worlds=seen, outputs=OUTPUTS).items()}
    for k, (camera, world) in enumerate(zip(cameras, seen, strict=True)):
        want = Renderer([two, one, two][world]).render(camera, outputs=OUTPUTS)
        assert_alike({name: t[k] for name, t in got.items()}, want)
    assert not (got["instance"][2] == 1).any()


@pytest.mark.slow
def test_pictures_repeat_whatever_the_tile(make):
    scene, _ = home_with_person("small")
    cameras = eight_views(scene)[:2]
    gpu = make(scene, width=WIDTH, height=HEIGHT, worlds=2)
    first = gpu.render(cameras, outputs=OUTPUTS)
    again = gpu.render(cameras[0], outputs=OUTPUTS, poses=np.stack([c.pose for c in cameras]))
    for name in OUTPUTS:
        assert (first[name] == again[name]).all(), name
    gpu.variant = choose_variant(1024, 64, 64)
    other = gpu.render(cameras, outputs=OUTPUTS)
    assert (abs(first["depth"] - other["depth"]) < 1e-4).float().mean() > 0.9999
    assert (first["instance"] == other["instance"]).float().mean() > 0.9999


def test_near_and_far_cut_as_on_the_cpu(make):
    scene = RenderScene([room(), ball()], [RenderInstance(0, np.eye(4)), RenderInstance(1, placed(0, 1, 0))])
    got = compare(make, GpuScene(scene), [replace(c, near=2.4, far=4.0) for c in ROOM_VIEWS])
    seen = got["depth"][got["depth"] > 0]
    assert seen.min() >= 2.4
    assert seen.max() <= 4.0
    assert (got["instance"] == -1).any()


def test_one_renderer_for_both_back_ends(make):
    """`Renderer` with the GPU behind it: moved, hidden and deformed things in two worlds."""

    class Engine(GpuEngine):
        renderer_class = make

    scene = RenderScene(
        [room(), ball(), ball(10, smooth=True)],
        [RenderInstance(0, np.eye(4)), RenderInstance(1, placed(0, 1, 0)), RenderInstance(2, placed(0.5, 0.5, 0.5))],
        deformable=[2],
    )
    engine, cpu = Engine(scene, light=Light(), worlds=2), Renderer(scene, worlds=2)
    gpu = Renderer(scene, worlds=2)
    gpu._engine = engine
    seen = [0, 1, 0]
    cameras = [*ROOM_VIEWS, ROOM_VIEWS[1]]
    for step in range(2):
        for renderer in (gpu, cpu):
            renderer.set_transforms([1], placed(0.3 * step, 1.1, 0.2), world=1)
            renderer.set_vertices(2, scene.meshes[2].vertices * np.float32(1 - 0.3 * step), world=step)
            renderer.set_visible([1], False, world=0)
        want = cpu.render_batch(cameras, worlds=seen, outputs=OUTPUTS)
        got = gpu.render_batch(cameras, worlds=seen, outputs=OUTPUTS)
        for k in range(3):
            assert_alike({n: t[k].cpu().numpy() for n, t in got.items()}, {n: a[k] for n, a in want.items()})
    assert list(gpu.poses(1).vertices) == [2]
    packed = pack_scenes.cache_info().misses
    Engine(scene, light=Light(), worlds=3).render(cameras[:1], [2], OUTPUTS, 1, None)
    assert pack_scenes.cache_info().misses == packed, "the next renderer of a scene must not pack it again"


def test_what_the_gpu_does_not_draw_is_left_to_the_cpu(make):
    """``backend="auto"``: orthographic cameras and shadows, with things moved before and after the CPU was first needed."""
    pytest.importorskip("embreex", reason="the extra 'rays' is not installed")

    class Engine(AutoEngine):
        renderer_class = make

        def _device(self) -> Any:
            return "cuda" if make is GpuRenderer else "cpu"

    scene = RenderScene(
        [room(), ball(), ball(10)],
        [RenderInstance(0, np.eye(4)), RenderInstance(1, placed(0, 1, 0)), RenderInstance(2, placed(0.5, 0.5, 0.5))],
        deformable=[2],
    )
    light = Light(shadow_rays=4)
    auto, cpu = Renderer(scene, worlds=2, light=light), Renderer(scene, worlds=2, light=light)
    auto._engine = Engine(scene, light=light, worlds=2)
    above = replace(ROOM_VIEWS[0], projection="orthographic", fx=30.0, fy=30.0)
    for step in range(2):
        for renderer in (auto, cpu):
            renderer.set_transforms([1], placed(0.3 * step, 1.1, 0.2), world=1)
            renderer.set_vertices(2, scene.meshes[2].vertices * np.float32(1 - 0.3 * step), world=step)
            renderer.set_visible([1], bool(step), world=0)
        for cameras, outputs in [([above, ROOM_VIEWS[1]], ("depth", "instance")), (ROOM_VIEWS, ("rgb",))]:
            want = cpu.render_batch(cameras, worlds=[0, 1], outputs=outputs)
            got = auto.render_batch(cameras, worlds=[0, 1], outputs=outputs)
            for name in outputs:
                assert (got[name].cpu().numpy() == want[name]).all(), name
        want = cpu.render(ROOM_VIEWS[0], outputs=OUTPUTS[:5], world=1)
        got = auto.render(ROOM_VIEWS[0], outputs=OUTPUTS[:5], world=1)
        alike = got["instance"].cpu().numpy() == want["instance"]
        assert alike.mean() > 0.99


@pytest.mark.slow
def test_memory_that_does_not_suffice_takes_some_views_at_a_time(make, monkeypatch, caplog):
    import torch

    scene = RenderScene([room(), ball()], [RenderInstance(0, np.eye(4)), RenderInstance(1, placed(0, 1, 0))])
    gpu = make(scene, width=WIDTH, height=HEIGHT, worlds=5)
    cameras = [ROOM_VIEWS[k % 2] for k in range(5)]
    whole = gpu.render(cameras, outputs=OUTPUTS)
    draw = gpu._draw_part

    def short_of_memory(views: Any, part: slice, results: Any, scale: int) -> None:
        if part.stop - part.start > 2:
            raise torch.cuda.OutOfMemoryError("a test")
        draw(views, part, results, scale)

    monkeypatch.setattr(gpu, "_draw_part", short_of_memory)
    parts = gpu.render(cameras, outputs=OUTPUTS)
    for name in OUTPUTS:
        assert (whole[name] == parts[name]).all(), name
    assert "rendering 2 at a time" in caplog.text


def test_an_empty_scene_is_sky(make):
    got = compare_sky(make)
    assert (got["depth"] == 0).all()
    assert (got["instance"] == -1).all()


def compare_sky(make: Any) -> dict[str, NDArray]:
    empty = RenderScene([], [])
    got = {
        k: t.cpu().numpy()[0]
        for k, t in make(empty, width=WIDTH, height=HEIGHT, worlds=1).render(ROOM_VIEWS[0], outputs=OUTPUTS).items()
    }
    want = Renderer(empty).render(ROOM_VIEWS[0], outputs=OUTPUTS)
    assert np.abs(got["rgb"].astype(int) - want["rgb"]).max() <= 1
    return got


def test_wrong_arguments_are_named(make):
    scene = RenderScene([ball(6)], [RenderInstance(0, np.eye(4))])
    gpu = make(GpuScene(scene, moving=[0]), width=WIDTH, height=HEIGHT, worlds=2)
    camera = ROOM_VIEWS[0]
    for call, words in [
        (lambda: gpu.render(camera, outputs=("dpeth",)), "H3-RENDER-047"),
        (lambda: gpu.render(camera, samples=2), "H3-RENDER-032"),
        (lambda: gpu.render([camera] * 3), "H3-RENDER-035"),
        (lambda: gpu.render(replace(camera, width=4)), r"(?s)4x72.*96x72.*H3-RENDER-038"),
        (lambda: gpu.render(camera, worlds=[2]), r"(?s)0.*1.*H3-RENDER-036"),
        (lambda: gpu.render(camera, poses=np.eye(4)), r"(?s)poses.*3.*H3-RENDER-031"),
        (lambda: gpu.update_poses(np.zeros((2, 2, 4, 4))), r"(?s)\[2.*1, 4, 4\].*H3-RENDER-027"),
        (lambda: gpu.update_joints(np.zeros((2, 55, 4, 4))), "H3-RENDER-028"),
        (lambda: gpu.update_vertices(0, np.zeros((2, 5, 3))), "H3-RENDER-029"),
        (lambda: make(scene, width=0, height=4, worlds=1), "H3-RENDER-023"),
        (lambda: make([], width=4, height=4, worlds=1), "H3-RENDER-024"),
        (lambda: make(scene, width=4, height=4, worlds=2, scene_of_world=[0, 1]), r"(?s)0.*0.*H3-RENDER-025"),
        (
            lambda: make(GpuScene(scene, moving=[3]), width=4, height=4, worlds=1),
            r"(?s)moving lists instance 3.*H3-RENDER-021",
        ),
        (
            lambda: make(GpuScene(scene, skins={0: (None, None)}), width=4, height=4, worlds=1),
            r"(?s)not deformable.*H3-RENDER-021",
        ),  # type: ignore[dict-item]
    ]:
        with pytest.raises(InputError, match=words):
            call()


@pytest.mark.gpu
def test_a_captured_step_gives_the_same_pictures():
    import torch

    if gpu_problem():
        pytest.skip(str(gpu_problem()))
    scene = RenderScene([room(), ball()], [RenderInstance(0, np.eye(4)), RenderInstance(1, placed(0, 1, 0))])
    gpu = GpuRenderer(GpuScene(scene, moving=[1]), width=WIDTH, height=HEIGHT, worlds=2)
    views_ = torch.tensor(np.stack([c.pose for c in ROOM_VIEWS]), dtype=torch.float32, device="cuda")
    poses = torch.tensor(np.tile(placed(0, 1, 0), (2, 1, 1, 1)), dtype=torch.float32, device="cuda")

    def step() -> dict[str, torch.Tensor]:
        gpu.update_poses(poses)
        return gpu.render(ROOM_VIEWS[0], outputs=OUTPUTS, poses=views_)

    replay = gpu.captured(step)
    for x in (0.0, 0.7):
        poses[:, 0, 0, 3] = x
        expected = {name: t.clone() for name, t in step().items()}
        for name, t in replay().items():
            assert (t == expected[name]).all(), name


def test_without_a_gpu_the_message_says_what_to_do():
    if gpu_problem() is None:
        pytest.skip("there is a GPU")
    scene = RenderScene([ball(6)], [RenderInstance(0, np.eye(4))])
    with pytest.raises(InputError, match=r"(?s)Hint.*H3-RENDER-014"):
        GpuRenderer(scene, width=4, height=4, worlds=1)


# --- packing ----------------------------------------------------------------------------------------------------------
def test_every_triangle_lies_in_one_cluster_and_its_box():
    mesh = ball(40)
    cut = build_meshlets(mesh.vertices, mesh.faces)
    assert sorted(cut.faces[cut.faces >= 0]) == list(range(len(mesh.faces)))
    assert (np.diff(cut.first_vertex) <= CLUSTER_VERTICES).all()
    assert (cut.triangle_count <= CLUSTER_TRIANGLES).all()
    assert (np.diff(cut.group_first) <= GROUP_CLUSTERS).all()
    assert (np.diff(cut.group_first) > 0).all()
    for c in range(len(cut.triangles)):
        for k in range(cut.triangle_count[c]):
            word = int(cut.triangles[c, k])
            local = [word & 255, word >> 8 & 255, word >> 16]
            corners = cut.vertices[cut.first_vertex[c] : cut.first_vertex[c + 1]][local]
            assert list(corners) == list(mesh.faces[cut.faces[c, k]])
            assert (mesh.vertices[corners] >= cut.low[c]).all()
            assert (mesh.vertices[corners] <= cut.high[c]).all()


def test_triangles_that_share_nothing_make_small_clusters():
    rng = np.random.default_rng(1)
    vertices = rng.normal(size=(3000, 3)).astype(np.float32)
    cut = build_meshlets(vertices, np.arange(3000, dtype=np.int32).reshape(-1, 3))
    assert np.diff(cut.first_vertex).max() <= CLUSTER_VERTICES
    assert sorted(cut.faces[cut.faces >= 0]) == list(range(1000))
    same = build_meshlets(np.zeros((3, 3), np.float32), np.tile(np.arange(3, dtype=np.int32), (5000, 1)))
    assert (same.faces >= 0).sum() == 5000
    assert len(build_meshlets(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)).triangles) == 0


def test_packed_items_hold_all_triangles_of_all_instances():
    scene, person = home_with_person("small")
    packed = pack_scenes((GpuScene(scene, moving=[2]), GpuScene(scene)))
    for row in packed.scenes:
        items = packed.items[row["first_item"] : row["first_item"] + row["items"]]
        places = packed.places[row["first_item"] : row["first_item"] + row["items"]]
        count = 0
        for item in items:
            clusters = packed.clusters[item["first"] : item["first"] + item["second"]]
            count += int((clusters["first"] >> 16).sum())
        assert count == scene.triangle_count
        assert set(places["instance"]) >= {person, -1}
    assert packed.slots == 3
    assert packed.nbytes > 0
