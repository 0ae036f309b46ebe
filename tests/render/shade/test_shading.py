"""Light, colour and normals; colour maps and ids as pictures."""

from __future__ import annotations

import dataclasses
import sys

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.mesh.mesh import Mesh
from h3data.render import (
    Camera,
    Light,
    Renderer,
    RenderInstance,
    RenderScene,
    depth_to_rgb,
    instance_to_rgb,
    look_at,
    normalize_depth,
    orthographic,
    pinhole,
)
from h3data.render.shade.borrowed import borrowed
from h3data.render.shade.shading import tone_map
from h3data.srgb import linear_to_srgb, srgb_to_linear

WHITE_ROOM = Light(sky=(0.5, 0.5, 0.5), ground=(0.5, 0.5, 0.5), sun=(0, 0, 0), fill=(0, 0, 0), headlight=(0, 0, 0))


def triangle(points: list, colors: list, normals: NDArray | None = None) -> Mesh:
    return Mesh(
        vertices=np.array(points, np.float32),
        faces=np.int32([[0, 1, 2]]),
        colors=np.array(colors, np.uint8),
        normals=normals,
    )


def draw(mesh: Mesh, camera: Camera, *, light: Light | None = None, samples=1, matrix=None) -> dict[str, NDArray]:
    scene = RenderScene([mesh], [RenderInstance(0, np.eye(4) if matrix is None else matrix)])
    renderer = Renderer(scene, light=light)
    return renderer.render(camera, outputs=("rgb", "normal", "instance", "depth"), samples=samples)


def test_srgb_is_its_own_inverse_and_tone_mapping_is_monotone():
    x = np.linspace(0, 1, 257)
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(x)), x, atol=1e-6)
    y = tone_map(np.linspace(0, 4, 1000))
    assert (np.diff(y) >= 0).all()
    assert y.max() < 1
    np.testing.assert_array_equal(tone_map(x[x <= 0.75]), x[x <= 0.75])


def test_borrowed_arrays_are_the_same_arrays():
    @njit
    def doubled(nested, once):
        (a, (b, _)), c = borrowed(nested), borrowed(once)
        for k in range(len(a)):
            a[k] *= 2
            b[0, k] += c[k]
        return borrowed(nested)[1][0].sum() + once[0]

    first, second, once = np.arange(3.0), np.zeros((2, 3), np.int64), np.ones(3, np.float32)
    counts = [sys.getrefcount(array) for array in (first, second, once)]
    for _ in range(3):
        doubled((first, (second, 7)), once)
    np.testing.assert_array_equal(first, [0, 8, 16])
    np.testing.assert_array_equal(second, [[3, 3, 3], [0, 0, 0]])
    assert counts == [sys.getrefcount(array) for array in (first, second, once)]


def test_light_is_computed_in_linear_space():
    # albedo sRGB 200 under light 0.5: linear product, then back to sRGB
    camera = pinhole(16, 12, hfov_deg=60)
    wall = triangle([[-9, -9, 2], [9, -9, 2], [0, 12, 2]], [[200, 100, 50]] * 3)
    rgb = draw(wall, camera, light=WHITE_ROOM)["rgb"]
    expected = 255 * linear_to_srgb(0.5 * srgb_to_linear(np.array([200, 100, 50]) / 255))
    np.testing.assert_allclose(rgb.reshape(-1, 3), np.tile(expected, (16 * 12, 1)), atol=1)


@pytest.mark.parametrize("samples", [1, 4])
def test_colours_are_interpolated_in_perspective(samples):
    # a floor that recedes: colours must follow the ray's hit point, not the pixel
    points = np.array([[-3.0, 1, 1], [3, 1, 1], [0, 1, 30]])
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255]])
    camera = pinhole(64, 48, hfov_deg=90)
    picture = draw(triangle(points.tolist(), colors.tolist()), camera, light=WHITE_ROOM, samples=samples)
    v, u = np.nonzero(picture["instance"] == 0)
    inside = (v > v.min() + 2) & (v < v.max() - 1)
    v, u = v[inside], u[inside]
    ray = np.stack([(u + 0.5 - camera.cx) / camera.fx, (v + 0.5 - camera.cy) / camera.fy, np.ones(len(u))], 1)
    hit = ray / ray[:, 1:2]
    bary = np.linalg.solve(
        np.vstack([points[:, 0], points[:, 2], np.ones(3)]), np.stack([hit[:, 0], hit[:, 2], np.ones(len(u))])
    )
    clear = bary.min(0) > 0.08
    assert clear.sum() > 100
    expected = 255 * linear_to_srgb(0.5 * np.clip(bary.T[clear], 0, 1))
    assert np.abs(picture["rgb"][v[clear], u[clear]] - expected).max() < 3


def test_flat_normals_face_the_camera_from_both_sides():
    points = [[-9, -9, 0], [9, -9, 0], [0, 12, 0]]
    for order in (points, points[::-1]):
        for z in (-3.0, 3.0):
            camera = pinhole(8, 6, hfov_deg=40, pose=look_at([0, 0, z], [0, 0, 0]))
            normal = draw(triangle(order, [[9, 9, 9]] * 3), camera)["normal"]
            np.testing.assert_allclose(normal, np.broadcast_to([0, 0, np.sign(z)], normal.shape), atol=1e-6)


def test_smooth_normals_follow_non_uniform_scale_and_mirroring():
    n = np.float32([[0.6, 0, -0.8], [-0.6, 0, -0.8], [0, 0.6, -0.8]])
    mesh = triangle([[-2, -2, 0], [2, -2, 0], [0, 3, 0]], [[99, 99, 99]] * 3, n)
    camera = pinhole(33, 33, hfov_deg=40, pose=look_at([0, 0, -4], [0, 0, 0]))
    for scale in ([1, 1, 1], [2, 1, 0.5], [-1.5, 1, 3]):
        picture = draw(mesh, camera, matrix=np.diag([*scale, 1.0]))
        corners = n / np.array(scale)  # inverse transpose of a diagonal
        corners /= np.linalg.norm(corners, axis=1, keepdims=True)
        v, u = np.nonzero(picture["instance"] == 0)
        x = (u + 0.5 - camera.cx) / camera.fx * 4
        y = (v + 0.5 - camera.cy) / camera.fy * 4
        world = np.stack([x, y, np.zeros_like(x)], 1) @ camera.pose[:3, :3].T
        p = np.array([[-2, -2], [2, -2], [0, 3]]) * scale[:2]
        bary = np.linalg.solve(np.vstack([p.T, np.ones(3)]), np.stack([world[:, 0], world[:, 1], np.ones(len(u))]))
        expected = np.clip(bary, 0, 1).T @ corners
        expected /= np.linalg.norm(expected, axis=1, keepdims=True)
        np.testing.assert_allclose(picture["normal"][v, u], expected, atol=2e-3)


def test_the_sun_lights_what_faces_it():
    light = Light(sun_direction=(0, 0, -1), headlight=(0, 0, 0), fill=(0, 0, 0))
    wall = triangle([[-9, -9, 0], [9, -9, 0], [0, 12, 0]], [[150, 150, 150]] * 3)
    lit, shaded = (
        draw(wall, pinhole(8, 6, hfov_deg=40, pose=look_at([0, 0, z], [0, 0, 0])), light=light)["rgb"].mean()
        for z in (-3.0, 3.0)
    )
    assert lit > shaded + 20


@pytest.mark.parametrize(
    "fault", [{"sun": (0.1, float("nan"), 0)}, {"sky": (-0.1, 1, 1)}, {"sun_direction": (0, float("inf"), 0)}]
)
def test_a_light_that_is_not_finite_or_negative_is_refused(fault):
    with pytest.raises(InputError, match=f"(?s){next(iter(fault))}.*H3-RENDER-068"):
        Light(**fault)


def test_four_samples_average_edges_only():
    # a vertical edge through the middle of a pixel column: half sky, half wall
    black = dataclasses.replace(WHITE_ROOM, horizon=(0, 0, 0), zenith=(0, 0, 0), sky=(1, 1, 1), ground=(1, 1, 1))
    camera = Camera(width=8, height=6, fx=8, fy=8, cx=4.5, cy=3, pose=np.eye(4))
    wall = triangle([[0, -50, 1], [0, 50, 1], [60, 0, 1]], [[128, 128, 128]] * 3)
    one, four = (draw(wall, camera, light=black, samples=s)["rgb"][2, :, 0] for s in (1, 4))
    full = 128
    half = 255 * linear_to_srgb(srgb_to_linear(np.array(full / 255)) / 2)
    np.testing.assert_allclose(four, [0, 0, 0, 0, half, full, full, full], atol=1)
    assert set(one.tolist()) == {0, full}


def test_four_samples_leave_depth_and_ids_alone():
    mesh = triangle([[-1, -1, 3], [1, -0.7, 4], [0.2, 1.1, 5]], [[200, 80, 80]] * 3)
    camera = pinhole(41, 31, hfov_deg=50)
    one, four = draw(mesh, camera), draw(mesh, camera, samples=4)
    for name in ("depth", "instance", "normal"):
        np.testing.assert_array_equal(one[name], four[name])
    inside = np.abs(one["rgb"].astype(int) - four["rgb"]).max(-1)
    assert 0 < (inside > 2).sum() < 150


def test_the_sky_depends_on_elevation_only():
    up = Renderer(RenderScene([], [])).render(pinhole(9, 9, hfov_deg=20, pose=look_at([0, 0, 0], [0, 1, 0])))["rgb"]
    level = Renderer(RenderScene([], [])).render(pinhole(9, 9, hfov_deg=20, pose=look_at([0, 0, 0], [1, -0.5, 0])))[
        "rgb"
    ]
    assert np.ptp(level, axis=(0, 1)).max() <= 1
    assert up[4, 4, 0] < level[4, 4, 0]


# --- colour maps ----------------------------------------------------------------------------------------------------
def test_depth_is_normalised_as_habitat_does():
    depth = np.float32([[0, 0.5, 1.0], [5.5, 10, 20]])
    np.testing.assert_allclose(normalize_depth(depth, 1, 10), [[0, 0, 0], [0.5, 1, 1]])
    assert normalize_depth(depth, 0, 10).dtype == np.float32
    with pytest.raises(InputError, match="H3-RENDER-011"):
        normalize_depth(depth, 3, 3)


def test_depth_colours_get_darker_with_distance_and_misses_are_dark():
    rgb = depth_to_rgb(np.float32([[0.5, 2, 4, 8, 100, 0]]), 0.5, 8)
    luminance = rgb[0] @ np.array([0.2126, 0.7152, 0.0722])
    assert (np.diff(luminance[:4]) < 0).all()
    assert luminance[4] == luminance[3]
    assert luminance[5] < luminance[4]
    assert rgb.dtype == np.uint8
    assert rgb.shape == (1, 6, 3)


def test_instance_colours_are_stable_and_distinct():
    ids = np.arange(-1, 60)
    rgb = instance_to_rgb(ids)
    np.testing.assert_array_equal(rgb[10], instance_to_rgb(np.array([[9]]))[0, 0])
    assert len(np.unique(rgb, axis=0)) == len(ids)
    neighbours = np.abs(rgb[1:-1].astype(int) - rgb[2:]).sum(-1)
    assert neighbours.min() > 40
    assert rgb[0].max() < 30
    with pytest.raises(InputError, match="H3-RENDER-010"):
        instance_to_rgb(np.zeros(3))


# --- glossy surfaces ------------------------------------------------------------------------------------------------
def _glossy_floor(camera: Camera, mirror: NDArray, *, samples=1) -> dict[str, NDArray]:
    floor = Mesh(
        vertices=np.float32([[-9, 0, -9], [-9, 0, 9], [9, 0, 9], [9, 0, -9]]),
        faces=np.int32([[0, 1, 2], [0, 2, 3]]),
        colors=np.full((4, 3), 120, np.uint8),
    )
    scene = RenderScene(
        [floor], [RenderInstance(0, np.eye(4))], mirrors={0: np.tile(mirror.astype(np.float32), (4, 1))}
    )
    light = dataclasses.replace(WHITE_ROOM, occlusion=0.0)
    return Renderer(scene, light=light).render(camera, outputs=("rgb", "depth"), samples=samples)


@pytest.mark.parametrize("samples", [1, 4])
@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_a_glossy_floor_mirrors_by_schlick_what_lies_in_the_mirrored_direction(kind, samples):
    mirror = np.array([0.2, 0.9, 0.5, 0.3, 0.7])
    pose = look_at([0, 1.5, 0], [1.2, 0.5, 0.9])
    camera = (
        pinhole(48, 36, hfov_deg=60, pose=pose) if kind == "perspective" else orthographic(48, 36, width_m=3, pose=pose)
    )
    picture = _glossy_floor(camera, mirror, samples=samples)
    _, rays = camera.rays()
    rays = np.broadcast_to(rays, (36, 48, 3)) @ pose[:3, :3].T
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    facing = -rays[..., 1]
    to = rays + 2 * facing[..., None] * [0, 1, 0]
    x, z = (np.where(to[..., a] > 0, mirror[1 + k], mirror[k]) for a, k in ((0, 0), (2, 3)))
    mirrored = to[..., 0] ** 2 * x + to[..., 1] ** 2 * mirror[2] + to[..., 2] ** 2 * z
    share = 0.04 + 0.46 * (1 - facing) ** 5
    color = 0.5 * srgb_to_linear(np.array(120 / 255)) * (1 - share) + share * mirrored
    hit = picture["depth"] > 0
    hit[:2] = False  # the floor's edge
    assert hit.mean() > 0.5
    np.testing.assert_allclose(picture["rgb"][hit][:, 0], (255 * linear_to_srgb(tone_map(color)))[hit], atol=1.5)


def test_a_floor_that_mirrors_nothing_is_dull():
    camera = pinhole(48, 36, hfov_deg=60, pose=look_at([0, 1.5, 0], [1.2, 0.5, 0.9]))
    picture = _glossy_floor(camera, np.zeros(5))["rgb"][-5:]
    np.testing.assert_allclose(picture, 255 * linear_to_srgb(0.5 * srgb_to_linear(np.array(120 / 255))), atol=1)


def test_mirrors_of_the_wrong_shape_are_named():
    floor = triangle([[-1, 0, 0], [1, 0, 0], [0, 0, 1]], [[99, 99, 99]] * 3)
    for mirror in (np.zeros((2, 5)), np.full((3, 5), np.nan)):
        with pytest.raises(InputError, match=r"(?s)mirrors of mesh 0.*H3-RENDER-067"):
            RenderScene([floor], [RenderInstance(0, np.eye(4))], mirrors={0: mirror.astype(np.float32)})
