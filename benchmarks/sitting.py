"""Contact and speed of people who sit down: all bodies on seats of ten heights.

``penetration.sit.worst`` is the deepest that any skin gets into a seat on the path from standing to sitting,
``motion.sit.hips`` the greatest distance between the skin of the hips and the seat, ``motion.sit.slide`` by which an ankle
moves, ``motion.sit.joint`` the fastest joint, ``motion.sit.pose`` the time to compute a pose.

    python -m benchmarks sitting
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from h3data.bodies import JOINT_INDEX, humanoid_names, load_humanoid
from h3data.bodies.people.sitting import Sitting, sitting_on
from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE

HEIGHTS_M = (0.30, 0.33, 0.36, 0.39, 0.42, 0.45, 0.47, 0.48, 0.50, 0.57)
"""From the seats of children to beds: those of our homes are among them."""
STEPS = 60
ANKLES = [JOINT_INDEX["left_ankle"], JOINT_INDEX["right_ankle"]]
HIPS = [JOINT_INDEX[name] for name in ("pelvis", "left_hip", "right_hip")]


def figures_of(sitting: Sitting) -> dict[str, float]:
    """Return figures of one body on one seat: depth, distance of the hips, slide of the ankles [m], and turn per step
    [deg].
    """
    body, u = sitting.body, np.linspace(0, 1, STEPS + 1)
    quats, pelvis = sitting.pose(u**3 * (10 - 15 * u + 6 * u * u))
    joints = body.joint_matrices(np.tile(IDENTITY_POSE, (len(u), 1)), quats, pelvis)
    skin = body.skin(joints)
    depth = np.minimum(sitting.seat_m - skin[..., 1], sitting.edge_m - skin[..., 0])
    seated = np.isin(body.lod.owners, HIPS) & (skin[-1, :, 0] < sitting.edge_m - 0.01)
    ankles = joints[:, ANKLES][..., :3, 3]
    turns = np.abs(np.sum(quats[1:] * quats[:-1], axis=-1))
    return {
        "depth_m": float(depth.max()),
        "hips_m": float(np.abs(sitting.seat_m - skin[-1, seated, 1].min())) if seated.any() else np.inf,
        "slide_m": float(np.linalg.norm(ankles - ankles[0], axis=-1).max()),
        "joint_deg": float(np.degrees(2 * np.arccos(np.minimum(turns, 1))).max()),
    }


def run(emit: Callable[[str, float, str], None]) -> None:
    """Emit the worst figures over all bodies and heights, and how many of them fit."""
    figures, unfit, seconds = [], 0, 0.0
    for name in humanoid_names():
        for height in HEIGHTS_M:
            try:
                sitting = sitting_on(load_humanoid(name), height)
            except InputError:
                unfit += 1
                continue
            begun = time.process_time()
            sitting.pose(np.linspace(0, 1, STEPS))
            seconds += time.process_time() - begun
            figures.append(figures_of(sitting))
    worst = {name: max(own[name] for own in figures) for name in figures[0]}
    emit("penetration.sit.worst", 1000 * worst["depth_m"], "mm")
    emit("motion.sit.hips", 1000 * worst["hips_m"], "mm")
    emit("motion.sit.slide", 1000 * worst["slide_m"], "mm")
    emit("motion.sit.joint", worst["joint_deg"], "degrees in a step of 1/30 s")
    emit("motion.sit.unfit", unfit, f"of {unfit + len(figures)}: seats too high for the legs of a body")
    emit("motion.sit.pose", 1e6 * seconds / STEPS / len(figures), "us of CPU")
