"""Cameras, projection, and what is drawn over pictures."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.errors import InputError
from h3data.render import (
    CONVENTIONS,
    OPENGL_TO_OPENCV,
    Camera,
    camera_from_matrix,
    equirectangular,
    fisheye,
    look_at,
    orthographic,
    overlay,
    pinhole,
)
from h3data_pipelines.pictures.rendering import draw_label
from h3data_viewers.strip import draw_circle

RED = (255, 0, 0)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.integers(0, 10_000))
def test_projection_inverts_the_ray_through_a_pixel(seed):
    rng = np.random.default_rng(seed)
    camera = pinhole(64, 48, hfov_deg=float(rng.uniform(20, 140)), pose=look_at(*rng.normal(size=(2, 3)) * 3))
    pixels, z = rng.uniform([0, 0], [64, 48], (10, 2)), rng.uniform(0.1, 9, 10)
    rays = np.stack([(pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy, np.ones(10)], 1)
    world = (rays * z[:, None]) @ camera.pose[:3, :3].T + camera.pose[:3, 3]
    found, depth = camera.project(world)
    np.testing.assert_allclose(found, pixels, atol=1e-8)
    np.testing.assert_allclose(depth, z)


CAMERAS = [
    pinhole(64, 48, hfov_deg=110),
    orthographic(50, 70, width_m=3.0),
    fisheye(60, 60, hfov_deg=220),
    equirectangular(80),
]


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.projection)
def test_pictures_of_another_size_show_the_same(camera: Camera):
    """Twice as large, every point is twice as far from the corner; wider, it keeps its place across."""
    points = np.random.default_rng(0).uniform((-1, -1, 1.5), (1, 1, 3.5), (20, 3))
    pixels, _ = camera.project(points)
    larger, wider = camera.resized(2 * camera.width, 2 * camera.height), camera.resized(camera.width, 30)
    np.testing.assert_allclose(larger.project(points)[0], 2 * pixels, atol=1e-9)
    np.testing.assert_allclose(wider.project(points)[0][:, 0], pixels[:, 0], atol=1e-9)
    assert (wider.height, wider.hfov_deg) == (30, camera.hfov_deg)
    middle, _ = wider.project([[0, 0, 2.0]])
    np.testing.assert_allclose(middle, [[camera.width / 2, 15]], atol=1e-9)


@pytest.mark.parametrize("size", [(50, 20), (20, 50), (300, 7)])
@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.projection)
def test_pictures_of_another_shape_lose_nothing_without_cropping(camera: Camera, size: tuple[int, int]):
    corners = np.array([[u, v] for u in (0, camera.width) for v in (0, camera.height)])
    rays = np.stack([(corners[:, 0] - camera.cx) / camera.fx, (corners[:, 1] - camera.cy) / camera.fy], -1)
    resized = camera.resized(*size, crop=False)
    pixels = rays * [resized.fx, resized.fy] + [resized.cx, resized.cy]
    assert (pixels > -1e-9).all()
    assert (pixels < np.array(size) + 1e-9).all()
    assert np.isclose(np.ptp(pixels, axis=0), size).any(), "no smaller than it has to be"


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.projection)
def test_points_on_the_ray_of_a_pixel_appear_in_its_centre(camera: Camera):
    camera = camera.at(look_at([1, 2, 3], [0.5, 1.7, -2]))
    start, directions = camera.rays()
    for depth in (0.3, 7.0):
        local = (start + depth * directions).reshape(-1, 3)
        seen = np.isfinite(local).all(1)
        pixels, found = camera.project(local[seen] @ camera.pose[:3, :3].T + camera.pose[:3, 3])
        v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
        np.testing.assert_allclose(pixels, np.stack([u, v], -1).reshape(-1, 2)[seen], atol=1e-7)
        np.testing.assert_allclose(found, depth)
        assert seen.mean() > 0.9


def test_what_lies_right_and_below_is_right_and_below_in_every_picture():
    for camera in CAMERAS:
        pixels, _ = camera.project([[0, 0, 1], [0.2, 0, 1], [0, 0.2, 1]])
        np.testing.assert_allclose(pixels[0], [camera.cx, camera.cy])
        assert pixels[1, 0] > pixels[0, 0] + 1
        assert pixels[2, 1] > pixels[0, 1] + 1


def test_a_calibrated_matrix_makes_the_same_camera():
    camera = pinhole(64, 48, hfov_deg=70)
    again = camera_from_matrix(camera.intrinsics, 64, 48)
    assert (again.fx, again.fy, again.cx, again.cy) == (camera.fx, camera.fy, camera.cx, camera.cy)
    faults = (
        ("H3-RENDER-007", np.diag([0.0, 50, 1])),
        ("H3-RENDER-008", [[50, 3, 32], [0, 50, 24], [0, 0, 1]]),
        ("H3-RENDER-006", np.full((3, 3), np.nan)),
        ("H3-RENDER-007", np.diag([-50.0, 50, 1])),
    )
    for code, matrix in faults:
        with pytest.raises(InputError, match=code):
            camera_from_matrix(matrix, 64, 48)


def test_cameras_that_cannot_be_are_refused():
    for make in (
        lambda: pinhole(4, 4, hfov_deg=180),
        lambda: pinhole(4, 4, hfov_deg=np.nan),
        lambda: fisheye(4, 4, hfov_deg=400),
        lambda: orthographic(4, 4, width_m=0),
    ):
        with pytest.raises(InputError, match=r"H3-RENDER-00[3-9]"):
            make()
    with pytest.raises(InputError, match=r"(?s)near 3\.0 and far 1\.0.*H3-RENDER-009"):
        pinhole(4, 4, hfov_deg=60, near=3.0, far=1.0).checked()


def test_conventions_lead_to_ours():
    # a Habitat camera looks along -z with y up: its point ahead is at positive z in ours
    pose = look_at([0, 1, 0], [3, 1, 0])
    habitat = pose @ OPENGL_TO_OPENCV
    ahead_and_up = habitat @ [0, 0.5, -2, 1]
    np.testing.assert_allclose(
        pinhole(8, 8, hfov_deg=90, pose=habitat @ CONVENTIONS["habitat"]).to_camera(ahead_and_up[:3]),
        [[0, -0.5, 2]],
        atol=1e-12,
    )


def test_points_behind_have_no_pixel():
    pixels, z = pinhole(8, 8, hfov_deg=90).project([[0, 0, 1], [0, 0, -1], [1, 1, 0]])
    np.testing.assert_array_equal(np.isnan(pixels).all(1), [False, True, True])
    np.testing.assert_array_equal(z, [1, -1, 0])


def test_look_at_is_a_right_handed_opencv_frame():
    for eye, target in (([1, 2, 3], [0, 0, 0]), ([0, 5, 0], [0, 0, 0]), ([0, -5, 0], [0, 0, 0])):
        pose = look_at(eye, target)
        r = pose[:3, :3]
        np.testing.assert_allclose(r.T @ r, np.eye(3), atol=1e-12)
        assert np.linalg.det(r) == pytest.approx(1)
        assert np.linalg.norm(np.cross(r[:, 2], np.subtract(target, eye))) < 1e-9
        assert r[1, 1] <= 1e-12  # the camera's y axis points down
    assert look_at([0, 5, 0], [0, 0, 0])[2, 1] == pytest.approx(1), "from above, the upper edge shows -Z"


def test_pinhole_matches_habitat():
    # spec: habitat-sim reference README: fx = fy = W / 2 / tan(hfov / 2), cx = W / 2, cy = H / 2
    camera = pinhole(171, 224, hfov_deg=55)
    assert camera.fx == camera.fy == pytest.approx(164.2439718560347)
    assert (camera.cx, camera.cy) == (85.5, 112.0)
    assert camera.hfov_deg == pytest.approx(55)
    np.testing.assert_array_equal(OPENGL_TO_OPENCV @ OPENGL_TO_OPENCV, np.eye(4))


def test_a_line_runs_through_the_projected_points():
    camera = pinhole(80, 60, hfov_deg=70)
    image = np.zeros((60, 80, 3), np.uint8)
    points = np.array([[-1.0, -0.5, 3], [1, 0.6, 3], [1.2, -0.4, 4]])
    overlay.draw_polyline(image, camera, points, RED, 2)
    for s in np.linspace(0, 1, 20):
        for a, b in ((0, 1), (1, 2)):
            (x, y), _ = (v[0] for v in camera.project(points[a] + s * (points[b] - points[a])))
            assert image[int(y), int(x), 0] > 100
    assert (image[..., 0] > 0).mean() < 0.1


def test_lines_behind_the_camera_are_cut():
    camera = pinhole(80, 60, hfov_deg=70)
    image = np.zeros((60, 80, 3), np.uint8)
    overlay.draw_polyline(image, camera, [[0, 0, -5], [0, 1, -1], [3, 0, -0.1]], RED)
    overlay.draw_polyline(image, camera, [[0, 0, 2], [np.nan, 0, 2], [0, 0, 2]], RED)
    assert not image.any()
    # from straight ahead to behind, passing on the right: must leave through the right edge, not come back on the left
    overlay.draw_polyline(image, camera, [[0, 0, 4], [1, 0, -4]], RED)
    columns = np.flatnonzero(image.any((0, 2)))
    assert columns.min() >= 36  # 40 less the line's thickness
    assert columns.max() == 79


def test_labels_and_dots_sit_at_their_point():
    camera = pinhole(160, 120, hfov_deg=70)
    image = np.zeros((120, 160, 3), np.uint8)
    draw_circle(image, camera, [0, 0, 2], (0, 255, 0), radius_px=3)
    assert image[60, 80, 1] == 255
    draw_label(image, camera, [0, 0, 2], "robot", RED)
    rows = np.flatnonzero((image[..., 0] > 150).any(1))
    assert 40 < rows.min() < rows.max() < 60
    before = image.copy()
    draw_label(image, camera, [0, 0, -2], "behind", RED)
    draw_circle(image, camera, [1e9, 0, 1e-3], RED)
    np.testing.assert_array_equal(image, before)
    with pytest.raises(InputError, match=r"(?s)\[120, 160, 3\].*H3-RENDER-049"):
        draw_label(image[:50], camera, [0, 0, 2], "x", RED)


def test_importing_cameras_is_light():
    code = "import sys, h3data.render as r; r.pinhole; print(sorted({'numba', 'cv2', 'av'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
