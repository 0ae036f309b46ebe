"""Script for docs/pictures/lidar.jpg: points of a laser scanner that sees legs, and those of a 3-D scanner.

python -m bake.sheets.lidar docs/pictures/lidar.jpg
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray

import h3data
from h3data.geometry import Array
from h3data.recording.scans import Scan, clouds_of, scans_of
from h3data.render import Camera
from h3data.render.image_files import write_jpg
from h3data.replay import CameraTrack, Replay, camera_at
from sim_kinematic.tasks.social_nav import SocialNav

CAMERAS = ("third_person", "top_down")
STEP, DOT_PX, COLOR = 150, (2, 1), (232, 30, 160)
NEARER_M = 0.08
"""Largest distance behind the surface of their pixel at which points are drawn [m]."""


def picture(replay: Replay, scan: Scan, name: str) -> NDArray[np.uint8]:
    """Return the picture of a camera with the points of a scan, RGB [H, W, 3]."""
    seen_from = camera_at(replay, name, STEP)
    track = CameraTrack(camera=seen_from, poses=seen_from.pose[None])
    shown = next(iter(replay.frames([track], [STEP], outputs=("rgb", "depth"))))[1][0]
    rgb, depth = shown["rgb"].copy(), shown["depth"]
    points = scan.points(replay.recording, np.array([STEP]))[0].astype(np.float64)
    points = points[np.isfinite(points).all(1)]
    local = (points - seen_from.pose[:3, 3]) @ seen_from.pose[:3, :3]
    x, y = _pixels(seen_from, local)
    for k in np.flatnonzero((local[:, 2] > 0.1) & (x >= 0) & (y >= 0) & (x < rgb.shape[1]) & (y < rgb.shape[0])):
        if name == CAMERAS[1] or depth[y[k], x[k]] + NEARER_M > local[k, 2] or depth[y[k], x[k]] == 0:
            dot = DOT_PX[scan.ranges.ndim - 2]
            rows, columns = (slice(max(at - dot, 0), at + dot + 1) for at in (y[k], x[k]))
            rgb[rows, columns] = COLOR
    return rgb


def _pixels(camera: Camera, local: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the columns and rows of points [N, 3] in the frame of a camera."""
    away = local[:, 2] if camera.projection == "perspective" else np.ones(len(local))
    x, y = camera.fx * local[:, 0] / away + camera.cx, camera.fy * local[:, 1] / away + camera.cy
    return np.nan_to_num(x, nan=-1).astype(np.int64), np.nan_to_num(y, nan=-1).astype(np.int64)


def main(out: str) -> None:
    """Play an episode and write the picture."""
    recording = h3data.simulate(SocialNav, "small:1", seed=3, max_steps=STEP + 30, sensors=("lidar_legs", "lidar_3d"))
    replay = Replay(recording, light="baked")
    pictures = [picture(replay, scans_of(recording)[0], name) for name in CAMERAS]
    pictures.append(picture(replay, clouds_of(recording)[0], CAMERAS[0]))
    height = min(each.shape[0] for each in pictures)
    write_jpg(out, np.hstack([each[(each.shape[0] - height) // 2 :][:height] for each in pictures]))


if __name__ == "__main__":
    main(*sys.argv[1:])
