"""Contact of people who lie down: all bodies on beds and sofas of the heights of our homes.

``penetration.lie.worst`` is the deepest that any skin but that of thighs, over which skirts hang, gets into the surface on the
path from sitting to lying, ``motion.lie.touches`` the greatest distance of the skin of hips, upper back, head and lower legs
from the surface at its end, ``motion.lie.joint`` the fastest joint.

    python -m benchmarks lying
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from h3data.bodies import JOINT_INDEX, humanoid_names, load_humanoid
from h3data.bodies.people.sitting import LYING_PARTS, TUCKED, Sitting, sitting_on, take_seats
from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE
from sim_kinematic.crowd.seating import LIE_S
from sim_kinematic.motion.spec import STEP_S

HEIGHTS_M = (0.33, 0.42, 0.45, 0.48, 0.57)
THIGHS = [JOINT_INDEX["left_hip"], JOINT_INDEX["right_hip"]]


def figures_of(sitting: Sitting) -> dict[str, float]:
    """Return figures of one body on one surface: depth, greatest distance of what touches [m], and turn per step [deg]."""
    body, share = sitting.body, np.linspace(1, 2, round(LIE_S / STEP_S) + 1)
    quats, pelvis = (np.repeat(part, len(share), 0) for part in sitting.pose(1.0))
    take_seats(body, quats, pelvis, np.column_stack([np.full(len(share), sitting.seat_m), share]))
    skin = body.skin(body.joint_matrices(np.tile(IDENTITY_POSE, (len(share), 1)), quats, pelvis))
    low = sitting.seat_m - skin[..., 1]
    # until the feet are over the surface they are before its edge
    depth = np.where((share >= TUCKED)[:, None], low, np.minimum(low, sitting.edge_m - skin[..., 0]))
    parts = [np.isin(body.lod.owners, [JOINT_INDEX[name] for name in names]) for names in LYING_PARTS]
    turns = np.abs(np.sum(quats[1:] * quats[:-1], axis=-1))
    return {
        "depth_m": float(depth[:, ~np.isin(body.lod.owners, THIGHS)].max()),
        "touches_m": max(abs(float(low[-1, part].max())) for part in parts),
        "joint_deg": float(np.degrees(2 * np.arccos(np.minimum(turns, 1))).max()),
    }


def run(emit: Callable[[str, float, str], None]) -> None:
    """Emit the worst figures over all bodies and heights, and how many of them fit."""
    figures, unfit = [], 0
    for name in humanoid_names():
        for height in HEIGHTS_M:
            try:
                figures.append(figures_of(sitting_on(load_humanoid(name), height)))
            except InputError:
                unfit += 1
    worst = {name: max(own[name] for own in figures) for name in figures[0]}
    emit("penetration.lie.worst", 1000 * worst["depth_m"], "mm")
    emit("motion.lie.touches", 1000 * worst["touches_m"], "mm")
    emit("motion.lie.joint", worst["joint_deg"], "degrees in a step of 1/30 s")
    emit("motion.lie.unfit", unfit, f"of {unfit + len(figures)}: surfaces too high for the legs of a body")
