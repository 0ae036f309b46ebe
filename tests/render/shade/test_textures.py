"""Textured shading against a slow reference, and the laws of mip levels."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from h3data.mesh.mesh import Mesh, Texture
from h3data.render import Camera, Light, Renderer, RenderInstance, RenderScene, look_at, pinhole
from h3data.render.shade.textures import BITS, SHIFTS, WORD_SCALE, mip_levels, pack_textures
from h3data.render.shade.textures_simd import FOLLOWING, HEIGHT, OFFSET, WIDTH
from h3data.srgb import bytes_to_linear, linear_to_srgb
from tests.paths import ROOT

WHITE_ROOM = Light(
    sky=(0.5, 0.5, 0.5), ground=(0.5, 0.5, 0.5), sun=(0, 0, 0), fill=(0, 0, 0), headlight=(0, 0, 0), occlusion=0
)
"""Every surface gets light 0.5 from everywhere."""
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
SQUARE_UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)


def noise(seed: int, height: int, width: int) -> Texture:
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width, 4)).astype(np.uint8)
    pixels[..., 3] = 255
    return Texture(pixels=pixels)


def checkerboard(size: int) -> Texture:
    """Black and white, one texel each."""
    pixels = np.full((size, size, 4), 255, np.uint8)
    pixels[np.indices((size, size)).sum(0) % 2 == 0, :3] = 0
    return Texture(pixels=pixels)


def plain(color: tuple[int, int, int], size: int = 1) -> Texture:
    return Texture(pixels=np.broadcast_to(np.array([*color, 255], np.uint8), (size, size, 4)).copy())


def quad(texture: Texture | None, uv: NDArray = SQUARE_UV, *, points: NDArray = SQUARE, color=(255, 255, 255)) -> Mesh:
    return Mesh(
        vertices=np.asarray(points, np.float32),
        faces=np.int32([[0, 1, 2], [0, 2, 3]]),
        colors=np.tile(np.array(color, np.uint8), (4, 1)),
        uv=np.asarray(uv, np.float32),
        textures=() if texture is None else (texture,),
    )


def soup(seed: int, count: int, texture: Texture, reach: float) -> Mesh:
    """Random triangles around the origin; texture coordinates and colours are random too."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-2, 2, (count, 1, 3)) + rng.normal(0, 0.8, (count, 3, 3))
    return Mesh(
        vertices=corners.reshape(-1, 3).astype(np.float32),
        faces=np.arange(3 * count, dtype=np.int32).reshape(-1, 3),
        colors=rng.integers(0, 256, (3 * count, 3)).astype(np.uint8),
        uv=rng.uniform(-reach, reach, (3 * count, 2)).astype(np.float32),
        textures=(texture,),
    )


def render(meshes: list[Mesh], camera: Camera, *, samples=1, light: Light = WHITE_ROOM) -> dict[str, NDArray]:
    scene = RenderScene(meshes, [RenderInstance(k, np.eye(4)) for k in range(len(meshes))])
    return Renderer(scene, light=light).render(camera, outputs=("rgb", "triangle", "instance"), samples=samples)


def bilinear(linear: NDArray, uv: NDArray) -> NDArray:
    """Colours [N, 3] of an image [H, W, 3] at texture coordinates [N, 2], repeated."""
    height, width = linear.shape[:2]
    x, y = uv[:, 0] * width - 0.5, uv[:, 1] * height - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    result = np.zeros((len(uv), 3))
    for dy in (0, 1):
        for dx in (0, 1):
            weight = np.abs(1 - dx - (x - x0)) * np.abs(1 - dy - (y - y0))
            result += weight[:, None] * linear[(y0 + dy) % height, (x0 + dx) % width]
    return result


def barycentrics(mesh: Mesh, triangles: NDArray, camera: Camera, x: NDArray, y: NDArray) -> NDArray:
    """Where the rays through pixel coordinates meet their triangles' planes, [N, 3]."""
    ray = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(len(x))], 1)
    corners = camera.to_camera(mesh.vertices[mesh.faces[triangles]]).reshape(-1, 3, 3)
    over_z = np.linalg.solve(np.swapaxes(corners, 1, 2), ray[..., None])[..., 0]
    return over_z / over_z.sum(1, keepdims=True)


def reference(mesh: Mesh, picture: dict[str, NDArray], camera: Camera) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Pixels ``y x`` that are not at an edge, their expected sRGB values [N, 3] and texels per pixel [N]."""
    y, x = np.nonzero(picture["triangle"] >= 0)
    triangles = picture["triangle"][y, x]
    faces = mesh.faces[triangles]

    def uv_at(dx: float, dy: float) -> NDArray:
        bary = barycentrics(mesh, triangles, camera, x + 0.5 + dx, y + 0.5 + dy)
        return (bary[:, None, :] @ np.asarray(mesh.uv, float)[faces])[:, 0]

    bary = barycentrics(mesh, triangles, camera, x + 0.5, y + 0.5)
    levels = mip_levels(mesh.textures[0].pixels)
    size = np.array([levels[0].shape[1], levels[0].shape[0]])
    across, down = (uv_at(1e-3, 0) - uv_at(-1e-3, 0)) * 500 * size, (uv_at(0, 1e-3) - uv_at(0, -1e-3)) * 500 * size
    density = np.sqrt(np.maximum((across**2).sum(1), (down**2).sum(1)))
    level = np.clip(np.log2(np.maximum(density, 1e-9)), 0, len(levels) - 1)
    lower = np.floor(level).astype(int)
    fraction = np.clip((level - lower - 0.25) * 2, 0, 1)[:, None]
    every = np.stack([bilinear(image.astype(float), uv_at(0, 0)) for image in levels])
    n = np.arange(len(x))
    texel = every[lower, n] * (1 - fraction) + every[np.minimum(lower + 1, len(levels) - 1), n] * fraction
    color = (bary[:, None, :] @ bytes_to_linear(mesh.colors[faces]))[:, 0]
    clear = bary.min(1) > 0.01
    expected = 255 * linear_to_srgb(0.5 * texel * color)
    return np.stack([y, x])[:, clear], expected[clear], density[clear], level[clear]


# --- one level ------------------------------------------------------------------------------------------------------
@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.integers(1, 9), st.integers(1, 9))
def test_near_textures_equal_the_reference(seed, height, width):
    camera = pinhole(96, 72, hfov_deg=70, pose=look_at([0.4, 1.1, -4], [0, 0, 0]))
    mesh = soup(seed, 12, noise(seed, height, width), reach=1.5)
    picture = render([mesh], camera)
    (y, x), expected, density, _ = reference(mesh, picture, camera)
    near = density < 0.95
    assert near.sum() > 200
    error = np.abs(picture["rgb"][y, x] - expected)[near]
    assert error.max() < 1.5


@pytest.mark.parametrize("samples", [1, 4])
def test_a_texture_fills_a_square_that_faces_the_camera(samples):
    texture = noise(3, 8, 8)
    camera = Camera(width=72, height=72, fx=72, fy=72, cx=36, cy=36, pose=look_at([0, 0, 2], [0, 0, 0]))
    rgb = render([quad(texture)], camera, samples=samples)["rgb"]
    expected = 255 * linear_to_srgb(0.5 * bytes_to_linear(texture.pixels[..., :3]))
    clear = ~np.eye(8, dtype=bool)[::-1] | (samples == 1)  # where the triangles meet, four samples are averaged
    np.testing.assert_allclose(rgb[4::9, 4::9][clear], expected[clear], atol=1)  # 9 pixels a texel, upper left first


def test_a_texture_of_one_colour_equals_vertex_colours():
    camera = pinhole(80, 60, hfov_deg=60, pose=look_at([0.5, 0.8, 2], [0, 0, 0]))
    color = (200, 33, 121)
    light = Light()
    by_vertex = render([quad(None, color=color)], camera, light=light)["rgb"].astype(int)
    for size in (1, 5, 64):
        by_texture = render([quad(plain(color, size), 7 * SQUARE_UV)], camera, light=light)["rgb"]
        assert np.abs(by_texture - by_vertex).max() <= 1
    both = render([quad(plain((255, 128, 255)), color=color)], camera)["rgb"][30, 40]
    expected = 255 * linear_to_srgb(0.5 * bytes_to_linear(np.array(color)) * bytes_to_linear(np.array([255, 128, 255])))
    np.testing.assert_allclose(both, expected, atol=1)


@pytest.mark.parametrize("shift", [(1, 0), (0, -1), (-3, 7), (1000, -1000)])
def test_textures_repeat(shift):
    camera = pinhole(90, 70, hfov_deg=60, pose=look_at([0.3, 0.2, 2], [0, 0, 0]))
    uv = SQUARE_UV * (2.5, 1.7) - (0.6, 1.1)
    here = render([quad(noise(1, 6, 10), uv)], camera)["rgb"].astype(int)
    there = render([quad(noise(1, 6, 10), uv + shift)], camera)["rgb"]
    assert np.abs(here - there).max() <= (1 if max(np.abs(shift)) < 100 else 3)


def test_straight_lines_stay_straight_in_perspective():
    # a stripe along the floor: its middle must project onto the line between the projections of its ends
    pixels = np.full((1, 64, 4), 255, np.uint8)
    pixels[:, 30:34, :3] = 0
    floor = quad(
        Texture(pixels=pixels),
        [[0, 0], [1, 0], [1, 1], [0, 1]],
        points=np.array([[-2, 0, 1], [2, 0, 1], [2, 0, 30], [-2, 0, 30]]),
    )
    camera = pinhole(320, 240, hfov_deg=70, pose=look_at([1.5, 1.2, -0.5], [0, 0, 4]))
    rgb = render([floor], camera)["rgb"][..., 0].astype(float)
    ends, _ = camera.project([[0, 0, 1.3], [0, 0, 6]])
    for share in (0.1, 0.4, 0.7, 0.9):
        column, row = ends[0] + share * (ends[1] - ends[0])
        line = rgb[int(row), int(column) - 15 : int(column) + 16]
        dark = np.maximum(line.max() - line, 0) * (line < line.max() - 40)
        offset = (dark * np.arange(-15, 16)).sum() / dark.sum()
        assert abs(offset + 0.5 - column % 1) < 1.2


# --- levels ---------------------------------------------------------------------------------------------------------
@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 1000))
def test_levels_keep_the_mean_light(height, width, seed):
    levels = mip_levels(noise(seed, height, width).pixels)
    assert levels[-1].shape == (1, 1, 3)
    for finer, coarser in itertools.pairwise(levels):
        assert coarser.shape[:2] == tuple(max(n // 2, 1) for n in finer.shape[:2])
        np.testing.assert_allclose(coarser.mean((0, 1)), finer.mean((0, 1)), atol=1e-5)


def test_texels_of_no_opacity_show_nowhere():
    pixels = np.zeros((8, 8, 4), np.uint8)  # black under full transparency
    pixels[:, 2:5] = (10, 220, 30, 255)
    for level in mip_levels(pixels):
        np.testing.assert_allclose(level, np.broadcast_to(bytes_to_linear([10, 220, 30]), level.shape), atol=1e-5)
    pixels[..., 3] = 0  # nothing to see at all: then as if it were opaque
    np.testing.assert_allclose(mip_levels(pixels)[0], bytes_to_linear(pixels[..., :3]), atol=1e-6)


def test_words_keep_every_srgb_byte():
    ramp = np.zeros((1, 256, 4), np.uint8)
    ramp[0, :, :3], ramp[..., 3] = np.arange(256)[:, None], 255
    packed = pack_textures([plain((1, 2, 3)), Texture(pixels=ramp)])
    offset, width, height, following = packed.levels[packed.first_level[1]][[OFFSET, WIDTH, HEIGHT, FOLLOWING]]
    assert (width, height, following) == (256, 1, 8)
    words = packed.words[offset : offset + 256]
    for shift, bits, scale in zip(SHIFTS, BITS, WORD_SCALE, strict=True):
        linear = ((words >> shift) & (2**bits - 1)).astype(float) ** 2 * scale
        np.testing.assert_allclose(255 * linear_to_srgb(linear), np.arange(256), atol=0.2)
    assert packed.words[offset + 256] == words[0]  # the first column again


@settings(max_examples=10, deadline=None, derandomize=True)
@given(st.integers(0, 10_000))
def test_far_textures_equal_the_reference(seed):
    camera = pinhole(96, 72, hfov_deg=70, pose=look_at([0.4, 1.1, -4], [0, 0, 0]))
    mesh = soup(seed, 12, noise(seed, 48, 80), reach=3)
    picture = render([mesh], camera)
    (y, x), expected, _, level = reference(mesh, picture, camera)
    far = level > 0.5
    assert far.sum() > 200
    error = np.abs(picture["rgb"][y, x] - expected)[far]
    assert error.mean() < 1.5
    assert np.quantile(error, 0.99) < 15  # the logarithm is rough, and 8 pixels share two levels


def test_a_fine_pattern_far_away_is_its_mean_light():
    floor = quad(
        checkerboard(16), SQUARE_UV * 400, points=np.array([[-80, 0, 5], [80, 0, 5], [80, 0, 90], [-80, 0, 90]])
    )
    camera = pinhole(160, 120, hfov_deg=60, pose=look_at([0, 1.5, 0], [0, 0.6, 10]))
    picture = render([floor], camera)
    grey = 255 * linear_to_srgb(0.25)
    seen = picture["rgb"][picture["instance"] == 0]
    assert len(seen) > 3000
    assert np.abs(seen - grey).max() < 2


def test_what_moves_by_a_part_of_a_pixel_does_not_shimmer():
    floor = quad(
        noise(5, 64, 64), SQUARE_UV * 60, points=np.array([[-60, 0, 2], [60, 0, 2], [60, 0, 60], [-60, 0, 60]])
    )
    camera = pinhole(160, 120, hfov_deg=60, pose=look_at([0, 1.5, 0], [0, 0.3, 6]))
    renderer = Renderer(RenderScene([floor], [RenderInstance(0, np.eye(4))]), light=WHITE_ROOM)
    frames = []
    for k in range(6):
        pose = camera.pose.copy()
        pose[:3, 3] += pose[:3, 0] * 0.004 * k
        frames.append(renderer.render(camera.at(pose), outputs=("rgb",))["rgb"].astype(float))
    assert np.abs(np.diff(frames, axis=0))[:, 60:].mean() < 4
    assert frames[0][60:].std() > 8  # and yet it shows


# --- scenes ---------------------------------------------------------------------------------------------------------
def test_triangles_of_a_mesh_can_differ():
    red, green = plain((255, 0, 0)), plain((0, 255, 0))
    base = quad(red)
    mesh = Mesh(
        vertices=np.concatenate([SQUARE, SQUARE + np.array([0, 2.2, 0])]).astype(np.float32),
        faces=np.concatenate([base.faces, base.faces + 4]),
        colors=np.full((8, 3), 255, np.uint8),
        uv=np.tile(SQUARE_UV, (2, 1)),
        textures=(red, green),
        face_textures=np.int16([0, 1, -1, -1]),
    )
    camera = pinhole(60, 60, hfov_deg=70, pose=look_at([0, 1, 4], [0, 1, 0]))
    picture = render([quad(None, points=SQUARE + np.array([9, 9, 9])), mesh], camera)
    shown = {t: np.unique(picture["rgb"][picture["triangle"] == t], axis=0).tolist() for t in range(4)}
    half = round(float(255 * linear_to_srgb(0.5)))
    assert shown == {0: [[half, 0, 0]], 1: [[0, half, 0]], 2: [[half] * 3], 3: [[half] * 3]}


def test_meshes_without_textures_look_the_same_next_to_textured_ones():
    camera = pinhole(90, 70, hfov_deg=60, pose=look_at([0.3, 0.2, 3], [0, 0, 0]))
    clay = quad(None, color=(180, 90, 30))
    alone = render([clay], camera, light=Light())
    behind = quad(noise(0, 8, 8), points=SQUARE * 5 - (0, 0, 4))
    together = render([clay, behind], camera, light=Light(occlusion=0.7))
    mask = alone["instance"] == 0
    inner = mask & (together["instance"] == 0)
    assert inner.sum() > 500
    np.testing.assert_array_equal(render([clay], camera)["rgb"][inner], render([clay, behind], camera)["rgb"][inner])


def test_a_shared_texture_is_packed_once():
    shared, other = noise(0, 16, 16), noise(1, 16, 16)
    one = RenderScene([quad(shared)], []).surface.textures
    many = RenderScene([quad(shared), quad(shared), quad(other), quad(shared)], []).surface.textures
    assert len(many.words) == 2 * len(one.words)
    assert len(many.first_level) == 2
    assert len(RenderScene([quad(None)], []).surface.uv) == 0


def test_deforming_keeps_the_texture():
    texture = noise(2, 8, 8)
    camera = pinhole(64, 48, hfov_deg=60, pose=look_at([0, 0, 3], [0, 0, 0]))
    bent = SQUARE * (0.7, 1.2, 1) + (0.1, 0, 0.4)
    soft = Renderer(RenderScene([quad(texture)], [RenderInstance(0, np.eye(4))], deformable=[0]), light=WHITE_ROOM)
    soft.set_vertices(0, bent.astype(np.float32))
    rebuilt = render([quad(texture, points=bent)], camera)["rgb"]
    np.testing.assert_array_equal(soft.render(camera, outputs=("rgb",))["rgb"], rebuilt)


def test_threads_draw_the_same():
    scene = RenderScene([soup(1, 60, noise(1, 33, 57), 4)], [RenderInstance(0, np.eye(4))])
    camera = pinhole(160, 120, hfov_deg=70, pose=look_at([0.4, 1.1, -4], [0, 0, 0]))
    expected = Renderer(scene).render(camera, samples=4)["rgb"]
    with ThreadPoolExecutor(2) as pool:
        for rgb in pool.map(lambda _: Renderer(scene).render(camera, samples=4)["rgb"], range(6)):
            np.testing.assert_array_equal(rgb, expected)


def test_no_seam_between_triangles():
    uv = SQUARE_UV * 0.3
    camera = pinhole(200, 150, hfov_deg=60, pose=look_at([0.5, 0.3, 1.2], [0, 0, 0]))
    rgb = render([quad(noise(4, 4, 4), uv)], camera)["rgb"].astype(int)
    other = replace(quad(noise(4, 4, 4), uv), faces=np.int32([[1, 2, 3], [1, 3, 0]]))
    assert np.abs(rgb - render([other], camera)["rgb"])[5:-5, 5:-5].max() <= 1  # cut along the other diagonal


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30])
def test_wild_coordinates_never_crash(value):
    uv = SQUARE_UV.copy()
    uv[1, 0] = value
    camera = pinhole(64, 48, hfov_deg=60, pose=look_at([0, 0, 3], [0, 0, 0]))
    assert render([quad(noise(0, 5, 3), uv)], camera)["rgb"].shape == (48, 64, 3)


@pytest.mark.slow
def test_machines_without_wide_vectors_draw_the_same(tmp_path):
    script = (
        "import numpy as np, sys; sys.path.insert(0, 'tests')\n"
        "from test_textures import Texture, noise, render, soup\n"
        "from h3data.render import look_at, pinhole\n"
        "camera = pinhole(160, 120, hfov_deg=70, pose=look_at([0.4, 1.1, -4], [0, 0, 0]))\n"
        "pixels = noise(1, 33, 57).pixels.copy(); pixels[::3, ::3, 3] = 0\n"
        "np.save(sys.argv[1], render([soup(1, 60, Texture(pixels=pixels), 4)], camera, samples=4)['rgb'])"
    )
    plainest = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(tmp_path)}
    pictures = []
    for name, change in (("this", {}), ("plainest", plainest)):
        file = tmp_path / f"{name}.npy"
        command = [sys.executable, "-c", script, str(file)]
        subprocess.run(command, check=True, env=os.environ | change, cwd=ROOT)
        pictures.append(np.load(file).astype(int))
    assert np.ptp(pictures[0]) > 100
    difference = np.abs(pictures[0] - pictures[1]).max(-1)
    assert (difference > 1).mean() <= 1e-3  # silhouettes may differ
