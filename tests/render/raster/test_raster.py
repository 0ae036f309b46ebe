"""The rasteriser against a brute-force ray caster in float64, and every pitfall that once cost a wrong pixel."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.mesh.mesh import Mesh
from h3data.render import Camera, Light, Renderer, RenderInstance, RenderScene, look_at, pinhole
from h3data.render.camera import Projection
from h3data.render.raster.cpu import CpuEngine
from h3data.render.raster.drawings import Drawings
from h3data.render.raster.raster_draw import hidden
from h3data.render.raster.raster_simd import blend_block
from tests.random_cases import examples

EDGE = 2e-4
"""Pixels whose ray passes an edge closer than this (barycentric) may go either way."""


def mesh_of(triangles: NDArray, color=(200, 200, 200), normals: NDArray | None = None) -> Mesh:
    """A mesh of loose triangles [T, 3, 3]."""
    vertices = np.asarray(triangles, np.float32).reshape(-1, 3)
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    return Mesh(vertices=vertices, faces=faces, colors=np.tile(np.uint8(color), (len(vertices), 1)), normals=normals)


def rays(camera: Camera) -> NDArray[np.float64]:
    """Directions [H*W, 3] in camera space with z = 1."""
    return camera.rays()[1].reshape(-1, 3)


def cast(triangles: NDArray, camera: Camera) -> tuple[NDArray, NDArray, NDArray]:
    """Nearest depth, triangle and "this is clear" [H, W] by testing every triangle, in float64 (Pluecker coordinates)."""
    p = (np.asarray(triangles, np.float32).astype(np.float64) - camera.pose[:3, 3]) @ camera.pose[:3, :3]
    a, b, c = p[:, 0], p[:, 1], p[:, 2]
    o, d = (r.reshape(-1, 3) for r in camera.rays())
    moments = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], 1)  # [T, 3, 3]
    sides = np.stack([b - c, c - a, a - b], 1)

    def edge_values(o: NDArray, d: NDArray) -> NDArray:
        return np.einsum("nk,tek->nte", d, moments) + np.einsum("nk,tek->nte", np.cross(d, o), sides)

    with np.errstate(all="ignore"):
        numerators, normal = edge_values(o, d), np.cross(b - a, c - a)
        total = d @ normal.T
        bary = numerators / total[..., None]
        depth = (np.einsum("tk,tk->t", a, normal) - o @ normal.T) / total
    lowest = bary.min(-1)
    ahead = np.isfinite(depth) & (depth > camera.near) & (depth < camera.far)
    shape = (camera.height, camera.width)
    # in pixels, too: a sliver is narrow in pixels while its barycentrics are not
    corner = edge_values(*(r.reshape(-1, 3) for r in dataclasses.replace(camera, width=2, height=2).rays()))
    steps = np.abs(corner[1] - corner[0]) + np.abs(corner[2] - corner[0])
    with np.errstate(all="ignore"):
        pixel_distance = (np.abs(numerators) / steps).min(-1)
    hit = ahead & (lowest >= 0)
    z = np.where(hit, depth, np.inf)
    best = z.argmin(1)
    nearest = z[np.arange(len(z)), best]
    unsure = ahead & (lowest > -EDGE) & ((np.abs(lowest) < EDGE) | (pixel_distance < EDGE))
    unsure &= depth < nearest[:, None] + 1e-3
    for plane in (camera.near, camera.far):  # where a triangle passes through a clip plane
        unsure |= (lowest > -EDGE) & (np.abs(depth - plane) < 1e-4 * max(1.0, min(plane, 99.0))) & (plane > 0)
    ties = (z < (nearest + 1e-3 * np.maximum(1, nearest))[:, None]).sum(1) > 1  # coplanar: either id is right
    ids = np.where(np.isfinite(nearest), np.where(ties, -2, best), -1)
    return (
        np.where(np.isfinite(nearest), nearest, 0).reshape(shape),
        ids.reshape(shape),
        ~unsure.any(1).reshape(shape),
    )


def soup(rng: np.random.Generator) -> NDArray[np.float64]:
    """Triangles of every nasty kind around the origin [T, 3, 3]."""
    small = rng.normal(size=(60, 1, 3)) * 4 + rng.normal(size=(60, 3, 3)) * rng.choice([0.03, 0.3, 1.5], (60, 1, 1))
    through_eye = rng.normal(size=(6, 3, 3)) * 6
    behind = rng.normal(size=(6, 3, 3)) * 3 + [0, 0, -4]
    start = rng.normal(size=(10, 1, 3)) * 4
    slivers = start + np.stack([np.zeros((10, 3)), rng.normal(size=(10, 3)) * 4, rng.normal(size=(10, 3)) * 0.01], 1)
    floor = rng.uniform(-8, 8, (6, 3, 3)) * [1, 0, 1] + [0, 1, 0]
    return np.concatenate([small, through_eye, behind, slivers, floor])


def random_camera(rng: np.random.Generator) -> Camera:
    width, height = (int(v) for v in rng.choice([[7, 5], [31, 23], [64, 64], [97, 41], [120, 90]]))
    pose = look_at(rng.normal(size=3) * 0.3, rng.normal(size=3) * [2, 2, 2] + [0, 0, 3])
    camera = pinhole(width, height, hfov_deg=float(rng.uniform(30, 140)), pose=pose)
    # an off-centre principal point and pixels that are not square
    k = {"name": "odd", "width": width, "height": height, "fx": camera.fx, "pose": pose}
    shift = rng.uniform(-0.2, 0.2, 2)
    return Camera(**k, fy=camera.fy * rng.uniform(0.8, 1.25), cx=width * (0.5 + shift[0]), cy=height * (0.5 + shift[1]))


def draw(triangles: NDArray, camera: Camera) -> dict[str, NDArray]:
    scene = RenderScene([mesh_of(triangles)], [RenderInstance(0, np.eye(4))])
    poisoned = {
        "depth": np.full((camera.height, camera.width), np.inf, np.float32),
        "triangle": np.full((camera.height, camera.width), 12345, np.int32),
    }
    return Renderer(scene).render(camera, outputs=("depth", "triangle", "instance"), out=poisoned)


def assert_same(picture: dict[str, NDArray], triangles: NDArray, camera: Camera) -> int:
    depth, ids, clear = cast(triangles, camera)
    error = np.abs(picture["depth"] - depth)[clear]
    relative = 1e-4 if camera.projection == "perspective" else 0
    assert (error <= np.maximum(1e-4, relative * depth[clear])).all(), f"worst {error.max()} m of {camera}"
    known = clear & (ids != -2)
    np.testing.assert_array_equal(picture["triangle"][known], ids[known])
    np.testing.assert_array_equal(picture["instance"] >= 0, picture["depth"] > 0)
    return int(clear.sum())


def test_random_soups_equal_the_ray_caster():
    rng = np.random.default_rng(1)
    checked = total = 0
    for _ in range(examples(30)):
        triangles, camera = soup(rng), random_camera(rng)
        checked += assert_same(draw(triangles, camera), triangles, camera)
        total += camera.width * camera.height
    assert checked > 0.9 * total, "too few pixels were clear of edges to mean anything"


def random_view(rng: np.random.Generator, projection: Projection) -> Camera:
    """As `random_camera`, orthographic or not, with clip planes more often than not."""
    camera = random_camera(rng)
    near, far = float(rng.choice([0, 0.005, 0.3, 2])), float(rng.choice([3, 6, np.inf]))
    if projection == "orthographic":
        fx, fy = camera.width / rng.uniform(0.5, 12, 2)
        camera = dataclasses.replace(camera, projection=projection, fx=fx, fy=fy)
    return dataclasses.replace(camera, near=near, far=far)


@pytest.mark.parametrize("projection", ["orthographic", pytest.param("perspective", marks=pytest.mark.slow)])
def test_orthographic_and_clipped_soups_equal_the_ray_caster(projection):
    rng = np.random.default_rng(3)
    checked = total = 0
    for _ in range(examples(25)):
        triangles, camera = soup(rng), random_view(rng, projection)
        checked += assert_same(draw(triangles, camera), triangles, camera)
        total += camera.width * camera.height
    assert checked > 0.9 * total


def grid(n: int, size: float = 4.0, y: float = 0.0) -> NDArray[np.float64]:
    """A floor of 2 n^2 triangles [T, 3, 3] around the origin."""
    s = np.linspace(-size / 2, size / 2, n + 1)
    x, z = np.meshgrid(s[:-1], s[:-1], indexing="ij")
    d = size / n
    a = np.stack([x, np.full_like(x, y), z], -1).reshape(-1, 3)
    b, c, e = (a + np.array(shift) for shift in ([d, 0, 0], [d, 0, d], [0, 0, d]))
    return np.concatenate([np.stack([a, c, b], 1), np.stack([a, e, c], 1)])


@pytest.mark.parametrize("n", [1, 3, 17, 90])
@pytest.mark.parametrize("size", [(64, 48), (211, 133)])
def test_closed_surfaces_have_no_cracks(n, size):
    # pitfalls: -0.0 in a gradient (holes), inside tolerance of slivers, the exact test of one-pixel boxes
    rng = np.random.default_rng(n)
    triangles = grid(n)
    for eye in ([0, 1.3, 0], [0, 2, 1e-3], *(rng.uniform([-0.4, 0.3, -0.4], [0.4, 0.9, 0.4]) for _ in range(6))):
        camera = pinhole(*size, hfov_deg=60, pose=look_at(eye, [eye[0], 0, eye[2]]))
        picture = draw(triangles, camera)
        inside = cast(grid(1, 3.9), camera)[0] > 0
        assert (picture["depth"][inside] > 0).all(), f"a hole from {eye}"
        np.testing.assert_allclose(picture["depth"][inside], eye[1], atol=1e-5)


def test_axis_aligned_edges_leave_no_holes():
    # pitfall: right angles facing the camera give gradients of exactly 0, which must be +0 for the span division
    s = np.float64([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
    triangles = np.stack([s[[0, 1, 2]], s[[0, 2, 3]], s[[2, 1, 0]] + [1, 0, 0], s[[3, 2, 0]] + [1, 0, 0]])
    for width in (20, 33, 50, 150, 400):
        f = width / 2.0  # the squares span the whole width
        camera = Camera(width=width, height=width // 2, fx=f, fy=f, cx=0, cy=0, pose=np.eye(4))
        assert (draw(triangles, camera)["depth"] == 1).all()


def plane_depth(triangles: NDArray, picture: dict[str, NDArray], camera: Camera) -> tuple[NDArray, NDArray, NDArray]:
    """Of every hit pixel: its depth on the plane of the reported triangle (float64), the drawn depth, and the sine of
    the angle between ray and plane."""
    hit = picture["triangle"] >= 0
    p = (np.asarray(triangles, np.float32).astype(np.float64) - camera.pose[:3, 3]) @ camera.pose[:3, :3]
    p = p[picture["triangle"][hit]]
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    d = rays(camera)[hit.ravel()]
    slope = (d * normal).sum(1)
    return (p[:, 0] * normal).sum(1) / slope, picture["depth"][hit], np.abs(slope) / np.linalg.norm(d, axis=1)


def test_slivers_are_drawn_exactly():
    # pitfall: slivers lose their float32 edge functions and depth; they go to the double path
    rng = np.random.default_rng(5)
    a = rng.uniform([-1, -1, 3], [1, 1, 5], (6000, 3))
    along = rng.uniform([-0.5, -0.5, -2], [0.5, 0.5, 2], (6000, 3))
    across = rng.normal(size=(6000, 3)) * rng.choice([3e-4, 1e-3, 4e-3], (6000, 1))
    triangles = np.stack([a, a + along, a + along * rng.uniform(0.2, 0.8, (6000, 1)) + across], 1)
    camera = pinhole(224, 171, hfov_deg=55)
    expected, drawn, slope = plane_depth(triangles, draw(triangles, camera), camera)
    clear = slope > 0.05
    assert clear.sum() > 2000
    assert np.abs(expected - drawn)[clear].max() < 1e-4


def test_strong_perspective_is_drawn_exactly():
    # pitfall: when 1/z varies much within a triangle (ratio above 4), its far end needs the double path
    rng = np.random.default_rng(6)
    worst = []
    for _ in range(300):
        near = np.append(rng.uniform(-0.005, 0.005, 2), 0.03)
        far = np.concatenate([rng.uniform(-12, 12, (2, 2)), np.full((2, 1), 60.0)], 1)
        triangles = np.stack([near, *far])[None]
        camera = pinhole(160, 120, hfov_deg=90)
        expected, drawn, slope = plane_depth(triangles, draw(triangles, camera), camera)
        clear = slope > 0.002
        worst.append((np.abs(expected - drawn)[clear] / expected[clear]).max(initial=0))
    assert max(worst) < 1e-5, max(worst)


def test_there_is_no_near_plane():
    for distance in (0.5, 0.021, 0.019, 0.005, 0.0005):
        camera = pinhole(33, 21, hfov_deg=90)
        wall = np.float64([[[-9, -9, distance], [9, -9, distance], [0, 12, distance]]])
        np.testing.assert_allclose(draw(wall, camera)["depth"], distance, rtol=1e-5)


def test_clusters_at_the_eye_are_never_culled():
    # pitfall: a cluster nearer than 2 cm takes the whole screen and is not tested against the coarse depth
    near = grid(12, 6.0, y=0.0)
    front = np.float64([[[-3, -3, 0.5], [3, -3, 0.5], [0, 5, 0.5]]])
    triangles = np.concatenate([front, near])
    camera = pinhole(96, 72, hfov_deg=100, pose=look_at([0, 0.015, 0], [0, 0.0, 1]))
    assert_same(draw(triangles, camera), triangles, camera)


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (8, 8), (9, 17), (63, 65)])
def test_padding_of_odd_sizes_never_shows(size):
    # pitfall: blocks overrun the row, and tiles reach beyond the picture: padding counts as infinitely near
    width, height = size
    rng = np.random.default_rng(width)
    far, near = grid(16, 30, 0.0), rng.uniform([-3, -1, -3], [3, 5, 3], (200, 3, 3))
    triangles = np.concatenate([near, far])
    camera = pinhole(width, height, hfov_deg=80, pose=look_at([0, 6, 0.5], [0, 0, 0]))
    assert_same(draw(triangles, camera), triangles, camera)


def test_occlusion_tests_have_a_margin():
    # pitfall: a wall is drawn first (its cluster reaches nearer), then patches that stand just in front of it
    wall = np.float64([[[-9, -9, 3], [9, -9, 3], [0, 14, 3]], [[5, 5, 1.0], [5.1, 5, 1], [5, 5.1, 1]]])
    for gap in (1e-1, 1e-3, 4e-4, 1e-4):
        meshes = [mesh_of(wall)]
        for k, size in enumerate([0.02, 0.1, 0.5, 1.0]):  # all three fillers
            patch = grid(1, size)[:, :, [0, 2, 1]] + [-1.0 + 0.7 * k, 0, 3 - gap]
            meshes.append(mesh_of(patch))
        scene = RenderScene(meshes, [RenderInstance(k, np.eye(4)) for k in range(len(meshes))])
        seen = Renderer(scene).render(pinhole(200, 150, hfov_deg=60), outputs=("instance",))["instance"]
        assert set(np.unique(seen)) == set(range(len(meshes))), f"{gap} m in front of the wall"


@pytest.mark.parametrize("size", [(63, 41), (64, 48), (1, 9)])
def test_padding_never_looks_empty_to_the_occlusion_test(size):
    # pitfall: tiles at the right and lower border reach beyond the picture; padded as empty they would hide nothing
    scene = RenderScene(
        [mesh_of(np.float64([[[-99, -99, 3], [99, -99, 3], [0, 140, 3]]]))], [RenderInstance(0, np.eye(4))]
    )
    engine, camera = CpuEngine(scene, light=Light()), pinhole(*size, hfov_deg=60)
    target = engine._draw(camera, engine.worlds[0], Drawings())[1].target
    rows, columns = target.tile_inv_z.shape
    address, row_bytes = np.uintp(target.inv_z.ctypes.data), np.uintp(target.inv_z.shape[1] * 4)
    for depth, covered in ((3.1, True), (2.9, False)):
        bounds, stale = target.tile_inv_z, target.tile_stale
        inv_z = np.float32(1 / depth)
        assert njit(hidden.py_func)(0, columns - 1, 0, rows - 1, inv_z, bounds, stale, address, row_bytes) == covered


def test_degenerate_triangles_and_cluster_padding_are_never_drawn():
    # 13 triangles: the second packet is padded with collapsed ones
    line = np.tile(np.float64([[[-1, 0, 2], [1, 0, 2], [0, 0, 2]]]), (6, 1, 1))
    points = np.tile(np.float64([[[0.1, 0.1, 2]] * 3]), (7, 1, 1))
    near = np.tile(np.float64([[[0.0, 0.0, 0.001]] * 3]), (3, 1, 1))
    picture = draw(np.concatenate([line, points, near]), pinhole(65, 49, hfov_deg=60))
    assert (picture["triangle"] == -1).all()
    assert (picture["depth"] == 0).all()


def test_depth_lies_on_the_plane_of_the_reported_triangle():
    rng = np.random.default_rng(8)
    triangles = rng.normal(size=(4000, 1, 3)) * 3 + rng.normal(size=(4000, 3, 3)) * 0.3
    camera = pinhole(224, 171, hfov_deg=55, pose=look_at([0, 0, -8], [0, 0, 0]))
    picture = draw(triangles, camera)
    assert (picture["triangle"] >= 0).mean() > 0.3
    expected, drawn, slope = plane_depth(triangles, picture, camera)
    assert np.abs(expected - drawn)[slope > 0.02].max() < 1e-4


def test_pictures_repeat_bit_for_bit():
    rng = np.random.default_rng(2)
    triangles, camera = soup(rng), pinhole(97, 41, hfov_deg=90)
    scene = RenderScene([mesh_of(triangles)], [RenderInstance(0, np.eye(4))])
    first, again = Renderer(scene).render(camera), Renderer(scene)
    again.render(pinhole(33, 50, hfov_deg=20))
    for name, picture in again.render(camera).items():
        np.testing.assert_array_equal(picture, first[name])


def test_an_unknown_output_is_refused():
    with pytest.raises(InputError, match=r"(?s)depth, instance.*H3-RENDER-047"):
        Renderer(RenderScene([], [])).render(pinhole(4, 4, hfov_deg=60), outputs=("dpeth",))  # type: ignore[arg-type]


def test_pixels_are_not_stored_through_masks() -> None:
    """AMD's processors take several times as long for a masked store as for a blend and a whole store."""

    @njit(error_model="numpy")
    def blend(inv_z, words, number):
        inv_z_at, words_at = np.uintp(inv_z.ctypes.data), np.uintp(words.ctypes.data)
        for k in range(len(inv_z) // 8):
            at, e = np.uintp(32 * k), number
            blend_block(inv_z_at + at, words_at + at, e, e, e, e, e, e, e, e, np.int32(7))

    inv_z, words = np.zeros(16, np.float32), np.zeros(16, np.int32)
    inv_z[3] = 1e6
    blend(inv_z, words, np.float32(1))
    assert inv_z.tolist() == [*range(1, 4), 1e6, *range(5, 9), *range(1, 9)]
    assert words.tolist() == [7, 7, 7, 0, *[7] * 12]
    assert not [line for code in blend.inspect_asm().values() for line in code.splitlines() if "maskmov" in line]
