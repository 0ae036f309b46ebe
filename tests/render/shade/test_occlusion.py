"""Ambient occlusion: darkens corners and contacts and nothing else, in RGB only."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from h3data.geometry import pose_to_matrix
from h3data.mesh.mesh import Mesh
from h3data.render import Camera, Light, Renderer, RenderInstance, RenderScene, look_at, pinhole
from h3data.render.raster.cpu import CpuEngine
from h3data.render.raster.drawings import Drawings
from h3data.render.raster.raster import Target, View
from h3data.render.shade.occlusion import EDGE, EDGE_ROWS, Occlusion, light_left, occlude

GREY = (170, 170, 170)


def quads(corners: list) -> Mesh:
    """A grey mesh of quads [N, 4, 3]."""
    points = np.array(corners, np.float32)
    first = 4 * np.arange(len(points), dtype=np.int32)[:, None]
    faces = (first[:, None] + np.array([[0, 1, 2], [0, 2, 3]], np.int32)).reshape(-1, 3)
    vertices = points.reshape(-1, 3)
    return Mesh(vertices=vertices, faces=faces, colors=np.tile(np.array(GREY, np.uint8), (len(vertices), 1)))


def box(center: tuple, size: tuple) -> list:
    """The six sides of a box."""
    sides = []
    for axis in range(3):
        for side in (-0.5, 0.5):
            corners = np.zeros((4, 3))
            corners[:, axis] = side
            corners[:, (axis + 1) % 3] = [-0.5, 0.5, 0.5, -0.5]
            corners[:, (axis + 2) % 3] = [-0.5, -0.5, 0.5, 0.5]
            sides.append((np.array(center) + corners * size).tolist())
    return sides


FLOOR = [[-20, 0, -20], [-20, 0, 20], [20, 0, 20], [20, 0, -20]]
WALL = [[-20, 0, -2], [20, 0, -2], [20, 20, -2], [-20, 20, -2]]
SIDE_WALL = [[-2, 0, -20], [-2, 20, -20], [-2, 20, 20], [-2, 0, 20]]
POST = box((0, 0.15, 0.5), (0.2, 0.3, 0.2))
ROOM = [FLOOR, WALL, SIDE_WALL, *POST]
EYE_LEVEL = look_at([1.0, 1.5, 2.2], [-0.6, 0.2, -0.8])


def renderer(corners: list, *, strength: float = 0.7) -> Renderer:
    return Renderer(RenderScene([quads(corners)], [RenderInstance(0, np.eye(4))]), light=Light(occlusion=strength))


def camera(pose: NDArray, width: int = 160, height: int = 120, hfov_deg: float = 70) -> Camera:
    return pinhole(width, height, hfov_deg=hfov_deg, pose=pose)


def light_of(corners: list, view: Camera, samples: Literal[1, 4] = 1) -> NDArray:
    """What occlusion leaves of the picture's brightness, per pixel, about 1."""
    on, off = (
        renderer(corners, strength=s).render(view, outputs=("rgb",), samples=samples)["rgb"].astype(float)
        for s in (1.0, 0.0)
    )
    return ((on + 0.5) / (off + 0.5)).mean(-1)


def drawn_target(drawn: Renderer, view: Camera) -> tuple[View, Target]:
    """The view as kernels read it, and its buffers."""
    engine = drawn._engine
    assert isinstance(engine, CpuEngine)
    seen, drawing, _ = engine._draw(view, engine.worlds[0], Drawings())
    return seen, drawing.target


def amounts(drawn: Renderer, view: Camera) -> Occlusion:
    return occlude(*drawn_target(drawn, view), 1)


# --- what must not change -------------------------------------------------------------------------------------------
@pytest.mark.parametrize("samples", [1, 4])
@pytest.mark.parametrize(
    "pose",
    [
        look_at([0, 1.5, 0], [3, 0.9, 4]),  # far away at a grazing angle
        look_at([0, 0.05, 0], [1, 0.04, 0.3]),  # from a mouse's eye
        look_at([0, 0.3, 0], [0, 0, 0]),
        look_at([0, 60, 0], [0, 0, 0]),
    ],
)
def test_an_open_plane_is_not_darkened_at_all(pose, samples):
    on, off = (
        renderer([FLOOR], strength=s).render(camera(pose), outputs=("rgb",), samples=samples) for s in (1.0, 0.0)
    )
    np.testing.assert_array_equal(on["rgb"], off["rgb"])


def test_a_floor_of_many_triangles_is_a_plane_too():
    x, z = np.meshgrid(np.linspace(-8, 8, 60), np.linspace(-8, 8, 60))
    y = np.zeros_like(x)
    grid = np.stack([x, y, z], -1)
    cells = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], 2).reshape(-1, 4, 3)
    assert light_of(cells.tolist(), camera(EYE_LEVEL)).min() == 1


def test_convex_things_in_the_air_are_not_darkened():
    view = camera(look_at([1.5, 6, 2], [0, 5, 0]))
    light = light_of(box((0, 5, 0), (1, 1, 1)), view)
    assert np.percentile(light, 99) > 0.999
    assert light.min() > 0.9  # where a face is narrower than three coarse pixels, its plane is a guess


def test_only_colours_change():
    view = camera(EYE_LEVEL)
    names = ("depth", "instance", "semantic", "triangle", "normal", "rgb")
    on, off = (renderer(ROOM, strength=s).render(view, outputs=names) for s in (1.0, 0.0))
    for name in names[:-1]:
        np.testing.assert_array_equal(on[name], off[name])
    assert (on["rgb"] != off["rgb"]).mean() > 0.1
    assert (on["rgb"] <= off["rgb"]).all()


def test_occlusion_is_on_by_default_and_the_same_every_time():
    view = camera(EYE_LEVEL)
    scene = RenderScene([quads(ROOM)], [RenderInstance(0, np.eye(4))])
    first, second = (Renderer(scene).render(view, outputs=("rgb",))["rgb"] for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert Light().occlusion > 0
    assert (first != renderer(ROOM, strength=0).render(view, outputs=("rgb",))["rgb"]).any()


# --- what must get darker -------------------------------------------------------------------------------------------
@pytest.mark.parametrize("samples", [1, 4])
def test_corners_and_contacts_are_darker_than_open_surfaces(samples):
    view = camera(EYE_LEVEL, 320, 240)
    light = light_of(ROOM, view, samples)

    def at(*point: float) -> float:
        (u, v), _ = (a[0] for a in view.project([point]))
        return float(light[int(v), int(u)])

    wall, edge, corner = at(-0.5, 0.9, -2), at(-0.5, 0.03, -2), at(-1.97, 0.03, -1.97)
    assert wall == 1
    assert edge < 0.9
    assert corner < edge - 0.03
    assert at(0.13, 0, 0.45) < 0.85  # at the foot of the post
    assert at(0.6, 0, 0.5) == 1  # further away than the radius


def test_nothing_darkens_what_is_far_behind_it():
    # a post in front of a wall 3 m behind it: no halo around its outline
    post = box((0, 1.5, 1), (0.2, 1.0, 0.2))
    light = light_of([WALL, *post], camera(look_at([0, 1.5, 3], [0, 1.5, 0]), 161, 121))
    assert light.min() > 0.97


def test_a_symmetric_room_gets_symmetric_light():
    walls = [FLOOR, WALL, SIDE_WALL, (np.array(SIDE_WALL) * [-1, 1, 1]).tolist()]
    light = light_of(walls, camera(look_at([0, 1.4, 1.5], [0, 0.7, -2]), 320, 240, hfov_deg=90))
    mirrored = light[:, ::-1]
    assert light.min() < 0.9
    assert np.abs(light.mean(0) - mirrored.mean(0)).max() < 0.02
    assert np.percentile(np.abs(light - mirrored), 99) < 0.06


def test_distance_and_resolution_do_not_change_the_size_of_shadows():
    # the same stretch of floor along a plinth, from above at two heights with the same pixels per metre
    plinth = box((0, 0.1, -1), (20, 0.2, 1))

    def width_m(height: float) -> float:
        fov = float(np.degrees(2 * np.arctan(1.5 / height)))
        light = light_of([FLOOR, *plinth], camera(look_at([0, height, -0.3], [0, 0, -0.3]), 300, 200, hfov_deg=fov))
        return float((light[:, 150] < 0.97).sum() / 100)

    assert 0.1 < width_m(6.0) < 0.35
    assert abs(width_m(6.0) - width_m(60.0)) < 0.06


def test_the_pattern_does_not_show_and_does_not_swim():
    # along a straight edge the light must be even, and stay so under a shift by a part of a pixel
    rows = []
    for shift in (0.0, 0.004, 0.009):
        view = camera(look_at([shift, 1.2, 0.5], [shift, 0.4, -2]), 320, 240)
        light = light_of([FLOOR, WALL], view)
        rows.append(light)
        near_edge = light[:, 100:220]
        assert near_edge.min() < 0.9
        assert near_edge.std(axis=1).max() < 0.02
    assert np.abs(rows[0] - rows[1]).max() < 0.05
    assert np.abs(rows[0] - rows[2]).max() < 0.05


def test_a_borders_light_is_what_a_larger_picture_shows_there():
    # what lies outside the picture cannot occlude, so borders may only be lighter, and not by much
    pose = look_at([-1.0, 1.2, 0.5], [-1.0, 0.4, -2])
    large = camera(pose, 320, 240)
    small = Camera(width=161, height=121, fx=large.fx, fy=large.fy, cx=80, cy=60, pose=pose)
    whole, part = light_of(ROOM, large), light_of(ROOM, small)
    difference = part - whole[60:181, 80:241]
    assert np.abs(difference[20:-20, 20:-20]).max() < 0.05
    assert difference.max() < 0.25
    assert difference.min() > -0.12


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (7, 5), (9, 1), (17, 33)])
@pytest.mark.parametrize("samples", [1, 4])
def test_tiny_and_odd_pictures(size, samples):
    view = pinhole(*size, hfov_deg=70, pose=EYE_LEVEL)
    light = light_of(ROOM, view, samples)
    assert np.isfinite(light).all()
    assert light.min() > 0.1


def test_an_empty_picture_is_left_alone():
    view = camera(np.eye(4))
    np.testing.assert_array_equal(light_of([FLOOR], view.at(look_at([0, 1, 0], [0, 5, 1]))), 1)


# --- fast against slow ----------------------------------------------------------------------------------------------
def test_the_fast_rows_agree_with_the_single_pixel():
    view = camera(EYE_LEVEL, 61, 47)
    drawn = renderer(ROOM)
    occlusion, near = amounts(drawn, view), drawn_target(drawn, view)[1].inv_z
    from_python = njit(light_left.py_func)
    slow = np.array([[from_python(occlusion, 1.0, x, y, near[y, x]) for x in range(61)] for y in range(47)])
    assert slow.min() < 0.8
    np.testing.assert_allclose(light_of(ROOM, view), slow, atol=0.15)  # sRGB is not linear ...
    light = light_of(ROOM, view)
    order = np.argsort(slow.ravel())
    assert np.corrcoef(slow.ravel()[order], light.ravel()[order])[0, 1] > 0.98  # ... but monotone


def test_the_planes_are_those_of_the_surfaces():
    view = camera(look_at([0, 2, 0], [1, 0, 1]), 64, 48)
    occlusion = amounts(renderer([FLOOR]), view)
    inside = (slice(EDGE_ROWS, EDGE_ROWS + 24), slice(EDGE, EDGE + 32))
    inv_z, (slope_x, slope_y, *_) = occlusion.inv_z[inside], occlusion.planes[:, *inside]
    np.testing.assert_allclose(slope_x[:, :-1], np.diff(inv_z, axis=1), atol=2e-6)
    np.testing.assert_allclose(slope_y[:-1], np.diff(inv_z, axis=0), atol=2e-6)


def test_turned_and_scaled_instances_are_occluded_as_any_other():
    pose = np.array([0.3, 0.0, -0.4, np.cos(0.4), 0.0, np.sin(0.4), 0.0])
    moved = np.asarray(pose_to_matrix(pose))
    points = np.array(ROOM) @ moved[:3, :3].T + moved[:3, 3]
    view = camera(EYE_LEVEL)
    one = light_of(ROOM, view)
    other = light_of(points.tolist(), view.at(moved @ EYE_LEVEL))
    assert np.percentile(np.abs(one - other), 99.5) < 0.05
