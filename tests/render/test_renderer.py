"""One interface: batches, worlds, threads, back ends; orthographic pictures; what is refused."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from numba import typeof
from numpy.typing import NDArray

from benchmarks.render import box, colored
from h3data.errors import InputError, MissingExtraError
from h3data.mesh.mesh import Mesh, Texture
from h3data.render import Light, Renderer, RenderInstance, RenderScene, equirectangular, look_at, orthographic, pinhole

EVERYTHING = ("depth", "instance", "semantic", "triangle", "rgb", "normal")


def bumpy(n: int = 24, *, smooth: bool = True) -> Mesh:
    """A textured, rolling floor of 2 n^2 triangles, 4 m wide."""
    x, z = np.meshgrid(np.linspace(-2, 2, n + 1), np.linspace(-2, 2, n + 1), indexing="ij")
    y = 0.3 * np.sin(2 * x) * np.cos(1.5 * z)
    slope_x, slope_z = 0.6 * np.cos(2 * x) * np.cos(1.5 * z), -0.45 * np.sin(2 * x) * np.sin(1.5 * z)
    normals = np.stack([-slope_x, np.ones_like(x), -slope_z], -1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    i = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + n + 2], 1), np.stack([i, i + n + 2, i + n + 1], 1)])
    pixels = np.full((16, 16, 4), 255, np.uint8)
    pixels[::2, ::2, :3] = 120
    return Mesh(
        vertices=np.stack([x, y, z], -1).reshape(-1, 3).astype(np.float32),
        faces=faces.astype(np.int32),
        colors=np.tile(np.uint8([220, 180, 150]), ((n + 1) ** 2, 1)),
        normals=normals.astype(np.float32) if smooth else None,
        uv=np.stack([x, z], -1).reshape(-1, 2).astype(np.float32),
        textures=(Texture(pixels=pixels),),
    )


def at(x: float, y: float, z: float, scale: float = 1.0) -> NDArray:
    m = np.diag([scale, scale, scale, 1.0])
    m[:3, 3] = x, y, z
    return m


def scene() -> RenderScene:
    instances = [RenderInstance(0, at(0, 0, 0)), *(RenderInstance(0, at(k - 1.5, 1, 0, 0.2), k) for k in range(4))]
    return RenderScene([bumpy()], instances)


def views(count: int) -> list:
    rng = np.random.default_rng(0)
    eyes = rng.uniform([-2, 1.2, -2], [2, 3, 2], (count, 3))
    return [pinhole(65, 43, hfov_deg=80, pose=look_at(eye, [0, 0.3, 0])) for eye in eyes]


def test_all_scenes_share_one_compiled_rasteriser():
    several = [RenderInstance(k, np.eye(4)) for k in range(3)]
    scenes = [scene(), *(RenderScene([bumpy(4)] * 3, several, deformable=chosen) for chosen in ([], [1]))]
    assert len({(typeof(s.geometry), typeof(s.surface), typeof(s.cutouts)) for s in scenes}) == 1


@pytest.mark.parametrize("samples", [1, 4])
def test_batches_over_worlds_and_threads_are_the_single_pictures(samples):
    drawn, cameras, worlds = scene(), views(10), [0, 1, 2, 0, 1, 2, 0, 1, 2, 0]
    singles = []
    for camera, world in zip(cameras, worlds, strict=True):
        alone = Renderer(drawn)
        alone.set_transforms([1], at(0, 0.8 + 0.2 * world, 0, 0.3))
        singles.append(alone.render(camera, outputs=EVERYTHING, samples=samples))
    for threads in (1, 2):
        renderer = Renderer(drawn, worlds=3, threads=threads)
        for world in range(3):
            renderer.set_transforms([1], at(0, 0.8 + 0.2 * world, 0, 0.3), world=world)
        batch = renderer.render_batch(cameras, worlds=worlds, outputs=EVERYTHING, samples=samples)
        for name in EVERYTHING:
            np.testing.assert_array_equal(batch[name], np.stack([single[name] for single in singles]), err_msg=name)


def test_worlds_do_not_touch_each_other():
    mesh = bumpy(6)
    renderer = Renderer(RenderScene([mesh], [RenderInstance(0, np.eye(4))], deformable=[0]), worlds=3)
    camera = views(1)[0]
    renderer.set_vertices(0, mesh.vertices + np.float32([0, 0.5, 0]), world=1)
    renderer.set_visible([0], False, world=2)
    a, b, c = renderer.render_batch([camera] * 3, worlds=[0, 1, 2], outputs=("depth", "rgb"))["depth"]
    np.testing.assert_array_equal(a, Renderer(renderer.scene).render(camera)["depth"])
    assert (a != b).any()
    assert not c.any()


def test_an_orthographic_picture_is_that_of_an_eye_far_away():
    # colours, normals and textures: what a perspective camera tends to from afar
    drawn = scene()
    direction = np.array([0.3, 1.0, 0.2]) / np.linalg.norm([0.3, 1.0, 0.2])
    distance, width_m = 3000.0, 4.5
    flat = orthographic(96, 80, width_m=width_m, pose=look_at(direction * 6, [0, 0, 0]))
    narrow = np.degrees(2 * np.arctan(width_m / 2 / distance))
    eye = pinhole(96, 80, hfov_deg=float(narrow), pose=look_at(direction * distance, [0, 0, 0]))
    light = Light(occlusion=0, headlight=(0, 0, 0))
    a, b = (Renderer(drawn, light=light).render(c, outputs=EVERYTHING) for c in (flat, eye))
    same = a["triangle"] == b["triangle"]
    assert same.mean() > 0.9  # bumps of 30 cm lean by a part of a pixel
    assert np.abs((a["depth"] - 6) - (b["depth"].astype(np.float64) - distance))[same & (a["depth"] > 0)].max() < 0.02
    np.testing.assert_allclose(a["normal"][same], b["normal"][same], atol=0.03)
    far_off = np.abs(a["rgb"].astype(int) - b["rgb"])[same & (a["depth"] > 0)].max(-1) > 12
    assert far_off.mean() < 0.01


def test_orthographic_corners_get_darker_and_open_floors_do_not():
    floor = Mesh(
        vertices=np.float32([[-3, 0, -3], [3, 0, -3], [3, 0, 3], [-3, 0, 3]]),
        faces=np.int32([[0, 2, 1], [0, 3, 2]]),
        colors=np.full((4, 3), 200, np.uint8),
    )
    camera = orthographic(120, 120, width_m=5, pose=look_at([0, 9, 0], [0, 0, 0]))
    instances = [RenderInstance(0, np.eye(4)), RenderInstance(0, at(-3, 0.2, 0))]  # and a step of 20 cm along x = 0
    plain, dark = (
        Renderer(RenderScene([floor], instances[:count])).render(camera, outputs=("rgb",))["rgb"] for count in (1, 2)
    )
    assert np.ptp(plain, axis=(0, 1)).max() <= 1, "an open floor is lit evenly"
    middle = dark[60].mean(1) - plain[60].mean(1)
    assert middle[60:63].max() < -4
    assert abs(middle[100:]).max() <= 1


def test_far_leaves_nothing_and_near_shows_what_is_behind():
    drawn = RenderScene([bumpy()], [RenderInstance(0, at(0, 0, 0)), RenderInstance(0, at(0, 2, 0))])
    for camera in (
        orthographic(32, 32, width_m=2, pose=look_at([0, 5, 0], [0, 0, 0])),
        pinhole(32, 32, hfov_deg=20, pose=look_at([0, 5, 0], [0, 0, 0])),
    ):
        cut = type(camera)(**{**vars(camera), "near": 3.6, "far": 9.0})
        seen = Renderer(drawn).render(cut, outputs=EVERYTHING)
        assert set(np.unique(seen["instance"])) == {0}
        assert (seen["depth"] > 4).all()
        blind = Renderer(drawn).render(type(camera)(**{**vars(camera), "far": 1.0}), outputs=EVERYTHING)
        assert not blind["depth"].any()
        assert (blind["triangle"] == -1).all()


def test_invalid_arguments_are_refused(monkeypatch):
    drawn, camera = scene(), pinhole(8, 8, hfov_deg=60)
    with pytest.raises(InputError, match=r"(?s)auto, cpu, gpu, rays.*H3-RENDER-054"):
        Renderer(drawn, backend="vulkan")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="H3-RENDER-055"):
        Renderer(drawn, worlds=0)
    renderer = Renderer(drawn, worlds=2)
    with pytest.raises(InputError, match=r"(?s)2.*H3-RENDER-059"):
        renderer.set_transforms([0], np.eye(4), world=2)
    with pytest.raises(InputError, match="H3-RENDER-062"):
        renderer.render_batch([camera, pinhole(9, 8, hfov_deg=60)])
    with pytest.raises(InputError, match=r"(?s)2.*H3-RENDER-063"):
        renderer.render_batch([camera, camera], worlds=[0])
    with pytest.raises(InputError, match="H3-RENDER-061"):
        renderer.render_batch([])
    for name in ("embreex", "embreex.mesh_construction", "embreex.rtcore_scene"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingExtraError, match="H3-RENDER-053"):
        Renderer(drawn, backend="rays")
    with pytest.raises(MissingExtraError, match="H3-RENDER-053"):
        renderer.render(equirectangular(16), outputs=("depth",))


def test_a_camera_inside_a_wall_sees_its_back():
    wall = colored(box((0, 1.2, 0), (4, 2.4, 0.1), 2), (200, 200, 200))
    drawn = RenderScene([wall], [RenderInstance(0, np.eye(4))])
    camera = pinhole(24, 16, hfov_deg=90, pose=look_at([0.3, 1, 0.02], [0.9, 1.1, 5]))
    for backend in ("cpu", "rays"):
        if backend == "rays":
            pytest.importorskip("embreex", reason="the extra 'rays' is not installed")
        got = Renderer(drawn, backend=backend).render(camera, outputs=("depth", "instance"))
        assert (got["instance"] == 0).all()
        assert got["depth"] == pytest.approx(0.03, abs=0.02)


@pytest.mark.slow
def test_memory_does_not_grow_with_resets_and_worlds():
    resource = pytest.importorskip("resource", reason="peak memory is read the POSIX way")
    wall = bumpy(12)
    drawn = RenderScene([wall], [RenderInstance(0, np.eye(4))], deformable=[0])
    camera = pinhole(128, 96, hfov_deg=70, pose=look_at([0, 1, 6], [0, 0, 0]))
    kept = Renderer(drawn)

    def reset(times: int) -> None:
        for k in range(times):
            for renderer in (kept, Renderer(drawn, worlds=2)):
                renderer.set_vertices(0, wall.vertices * np.float32(1 + k / 1000))
                renderer.set_transforms([0], np.eye(4))
                renderer.render(camera, outputs=EVERYTHING)

    reset(50)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    reset(1000)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 8000, "kB"


def test_without_a_gpu_auto_is_the_cpu_and_gpu_says_why():
    torch = pytest.importorskip("torch")
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    assert Renderer(scene(), backend="auto").backend == "cpu"
    with pytest.raises(MissingExtraError, match=r"(?s)Hint: backend='cpu'.*H3-RENDER-064"):
        Renderer(scene(), backend="gpu")
