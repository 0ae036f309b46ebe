"""Script for docs/pictures/strides.jpg: a person who walks curves, frame by frame, and their path from above.

    python -m bake.people.stride_sheet docs/pictures/strides.jpg

Rows: setting off with the goal behind, a corner, waiting for somebody and going on. Frames are 1/6 s apart; the person
is seen from a side that turns with the first frame of a row. Below: two minutes in a home, by the paper's walk (left)
and by strides.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import h3data
from h3data.bodies import Humanoid, load_humanoid
from h3data.bodies.people.planted_gait import planted_states, pose_planted
from h3data.geometry import Array, ground_pose
from h3data.render.image_files import write_image
from h3data.render.sheets.people_sheet import lined_up
from h3data.scene import FreeSpace
from sim_kinematic.agents.waypoint_walker import WaypointHuman
from sim_kinematic.motion.gait import walk_humans
from sim_kinematic.motion.spec import HOME_WALKER, NATURAL_WALKER, WalkerSpec
from sim_kinematic.motion.state import HumanState
from sim_kinematic.motion.stride import Strider

FRAMES, EVERY, WIDTH = 12, 5, 1920
HOME, STEPS, PX_PER_M = "small:1", 3600, 80


def strip(body: Humanoid, track: Array, first: int) -> NDArray[np.uint8]:
    """Return frames of a track (x, z, heading) [T, 3] from step ``first`` on, side by side."""
    states = planted_states(body.gait_tables, ground_pose(track[:, :2], track[:, 2]))
    quats, pelvis = pose_planted(body.gait_tables, states)
    pictures = []
    for k in range(first, first + FRAMES * EVERY, EVERY):
        turned = float(track[k, 2] - track[first, 2])
        seen = [(body, quats[k : k + 1], pelvis[k : k + 1])]
        pictures.append(lined_up(seen, turned, False, 1, WIDTH // FRAMES, spacing=1.15))
    return np.concatenate(pictures, axis=1)


def open_floor() -> FreeSpace:
    """Return the floor of a home with free space in its middle."""
    return FreeSpace.from_scene(h3data.open(HOME), radius_m=0.25, height_m=1.41)


def pursued(free: FreeSpace, path: Array, heading: float, *, waits: range = range(0)) -> Array:
    """Return the steps along a path, standing for a second before and after."""
    strider = Strider(free, NATURAL_WALKER, halts=True)
    strider.begin(path)
    rows, gait = [np.array([*path[0], heading])] * 31, HumanState.zeros(1)
    gait.xz[0], gait.heading[0] = path[0], heading
    while not strider.arrived:
        strider.walk(gait, goes=len(rows) not in waits)
        rows.append(np.array([*gait.xz[0], gait.heading[0]]))
    return np.array(rows + [rows[-1]] * 60)


def plan(free: FreeSpace, spec: WalkerSpec) -> NDArray[np.uint8]:
    """Return the path of a scripted person from above, with red dots where they turn on the spot."""
    import cv2

    walkable = (free.sdf > 0).astype(np.uint8) * 40 + 215
    scale = free.cell_m * PX_PER_M
    image = cv2.resize(walkable.T, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
    image = cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
    human = WaypointHuman(free, 3, spec)
    state = HumanState.zeros(1)
    state.xz[0] = free.sample(np.random.default_rng(3), 1)[0]
    for _ in range(STEPS):
        before = state.xz[0].copy(), state.heading.item(0)
        if spec.stride is None:
            walk_humans(state, human.target(state.xz[0])[None], spec)
        else:
            state.xz[0, 0], state.xz[0, 1], state.heading[0] = human.stride(state.xz[0], state.heading.item(0))
        a, b = (tuple(int(v) for v in (xz - free.origin) * PX_PER_M) for xz in (before[0], state.xz[0]))
        moved = float(np.hypot(*(state.xz[0] - before[0])))
        if moved < 1e-3 and abs(state.heading.item(0) - before[1]) > 1e-3:
            cv2.circle(image, a, 3, (220, 50, 40), -1, cv2.LINE_AA)
        cv2.line(image, a, b, (40, 90, 160), 1, cv2.LINE_AA)
    return np.asarray(image, np.uint8)


def main(target: str) -> None:
    """Write the picture of a person who walks curves."""
    import cv2

    body, free = load_humanoid("neutral_0"), open_floor()
    points = free.sample(np.random.default_rng(0), 400)
    middle = points[np.argmax(free.signed_distance(points))]
    ahead = np.array([[0, 0], [0.9, 0]]) + middle
    corner = np.array([[-0.8, 0], [0.0, 0], [0.0, 0.9]]) + middle
    rows = [
        strip(body, pursued(free, ahead, np.pi), 26),
        strip(body, pursued(free, corner, 0.0), 40),
        strip(body, pursued(free, np.array([[-0.9, 0], [0.9, 0]]) + middle, 0.0, waits=range(55, 90)), 45),
    ]
    slow = replace(HOME_WALKER, speed_mps=NATURAL_WALKER.speed_mps)
    plans = np.concatenate([plan(free, slow), plan(free, NATURAL_WALKER)], axis=1)
    height = round(plans.shape[0] * WIDTH / plans.shape[1])
    rows.append(np.asarray(cv2.resize(plans, (WIDTH, height), interpolation=cv2.INTER_AREA), np.uint8))
    write_image(Path(target), np.concatenate(rows))


if __name__ == "__main__":
    main(sys.argv[1])
