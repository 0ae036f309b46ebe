"""Script for docs/pictures/doors.jpg: swinging doors (above) and sliding doors, closed, half open and open.

python -m bake.sheets.doors docs/pictures/doors.jpg
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray

from bake.open_kitchen import picture
from h3data.geometry import heading_from_quat
from h3data.render import look_at, pinhole
from h3data.render.image_files import write_jpg
from h3data.scene import Scene
from h3data.scene.articulation import joints_of, posed
from h3data_homes import HomeSpec, build_home

SHOWN = ((1, "door_0/leaf"), (0, "door_1/leaf"))
"""Homes and their doors."""
WIDTH, HEIGHT, GAP, EYE_M, BACK_M, ASIDE_M = 480, 480, 6, 1.6, 2.6, 0.5
SHARES = (0.0, 0.45, 1.0)


def row(scene: Scene, name: str) -> NDArray[np.uint8]:
    """Return a door at three positions, RGB [H, W, 3]."""
    joints = joints_of(scene)
    thing, part = joints.parts[joints.index(name)]
    assert part.handle is not None
    heading = float(heading_from_quat(thing.pose[3:]))
    inward, along = (np.array([np.sin(a), 0.0, np.cos(a)]) for a in (heading, heading + np.pi / 2))
    middle = thing.pose[:3] + 0.5 * along * np.sign(part.handle[0]) + np.array([0.0, 1.0, 0.0])
    eye = middle + BACK_M * inward + ASIDE_M * along + np.array([0.0, EYE_M - 1.0, 0.0])
    camera = pinhole(WIDTH, HEIGHT, hfov_deg=70.0, pose=look_at(eye, middle))
    low, high = part.joint.closed, part.joint.opened
    shown = [picture(posed(scene, {name: low + share * (high - low)}), camera) for share in SHARES]
    gap = np.full((HEIGHT, GAP, 3), 255, np.uint8)
    return np.hstack([shown[0], gap, shown[1], gap, shown[2]])


def main(path: str) -> None:
    """Render the doors and write the picture."""
    rows = [row(build_home(HomeSpec(seed=seed, generation=2, doors=True)), name) for seed, name in SHOWN]
    write_jpg(path, np.vstack([rows[0], np.full((GAP, rows[0].shape[1], 3), 255, np.uint8), rows[1]]))


if __name__ == "__main__":
    main(*sys.argv[1:])
