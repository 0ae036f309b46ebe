"""Speed and cost of gestures: all bodies, standing, in all gestures.

``motion.gesture.joint`` is the fastest joint from step to step, ``motion.gesture.pose`` the time that a gesture adds to a pose.

    python -m benchmarks gestures
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from h3data.bodies import humanoid_names, load_humanoid
from h3data.bodies.people.gestures import GESTURES, NAMES, add_gestures
from h3data.geometry import smoothstep

STEPS_PER_S = 30
RAMP_S = 0.8


def run(emit: Callable[[str, float, str], None]) -> None:
    """Emit the fastest joint and the time of a pose."""
    worst, seconds, poses = 0.0, 0.0, 0
    for name in humanoid_names():
        body = load_humanoid(name)
        for number, gesture in enumerate(NAMES):
            count = round((2 * GESTURES[gesture].seconds + 2 * RAMP_S) * STEPS_PER_S)
            since = np.arange(count) / STEPS_PER_S
            u = np.clip(np.minimum(since, since[::-1]) / RAMP_S, 0, 1)
            quats, pelvis = body.clip_pose(np.zeros(count, np.int64), np.zeros(count))
            begun = time.process_time()
            add_gestures(body, quats, pelvis, np.column_stack([np.full(count, number), since, smoothstep(u)]))
            seconds, poses = seconds + time.process_time() - begun, poses + count
            turns = np.minimum(np.abs(np.sum(quats[1:] * quats[:-1], axis=-1)), 1)
            worst = max(worst, float(np.degrees(2 * np.arccos(turns)).max()))
    emit("motion.gesture.joint", worst, "degrees in a step of 1/30 s")
    emit("motion.gesture.pose", 1e6 * seconds / poses, "us of CPU")
