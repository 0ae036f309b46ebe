"""Cost of posing people during activities, compared with the same people when they only walk and stand.

Each activity of recordings is posed as pictures pose it: joints of many steps at once, then the light skin of each step. This
is done in alternation with and without the columns and events of seats, hands and gestures; the least of several times counts.

``motion.posing_ratio.<activity>``, ``motion.posing_ratio``
    CPU time of the steps of an activity, compared with that of walking only; the greatest of all activities.
``motion.posing_joints_ratio``
    The greatest ratio of the joints alone, without skin.
``motion.posing_walk``
    CPU time of a step of walking only.

    python -m benchmarks posing
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

import h3data
from benchmarks.chores import SEED, played
from h3data.bodies import Humanoid
from h3data.recording import Recording
from h3data.replay import Replay
from h3data.replay.stage import JOINT_STEPS

REPEATS, BODY = 7, "female_1"
SECONDS = 300
"""Duration of an evening in which the person cooks, eats, reads and lies down."""


def spans(recording: Recording) -> dict[str, NDArray[np.intp]]:
    """Return the steps of each activity of the only person of a recording."""
    turns = [event for event in recording.events if event.kind in ("activity", "walks_to")]
    steps = dict[str, list[int]]()
    for event, end in zip(turns, [*(event.step for event in turns[1:]), len(recording)], strict=True):
        if event.kind == "activity":
            steps.setdefault(event.target, []).extend(range(event.step, end))
    return {name: np.array(rows) for name, rows in steps.items() if len(rows) >= JOINT_STEPS}


def only_walking(recording: Recording) -> Recording:
    """Return a recording in which people walk and stand at the same places and do nothing else."""
    beside = (".motion_seat", ".motion_hands")
    columns = {name: values for name, values in recording.columns.items() if not name.endswith(beside)}
    return replace(recording, columns=columns, events=())


def cost(replay: Replay, steps: NDArray[np.intp]) -> tuple[float, float]:
    """Return the CPU time to pose the joints of the person at steps [T], and to pose joints and skin [s]."""
    body = replay.model(0)
    assert isinstance(body, Humanoid)
    begun = time.process_time()
    frames = [replay.joint_matrices(0, steps[k : k + JOINT_STEPS]) for k in range(0, len(steps), JOINT_STEPS)]
    posed = time.process_time()
    for part in frames:
        for k in range(len(part)):
            body.skin(part[k : k + 1])
    return posed - begun, time.process_time() - begun


def run(emit: Callable[[str, float, str], None]) -> None:
    """Emit the ratios of all activities."""
    evening = h3data.simulate(
        "wander", "medium2:1", roster=[BODY], agents={"human": "orca+evening"}, seed=SEED, max_steps=30 * SECONDS
    )
    ratios, alone, walk = dict[str, float](), [], []
    for recording in (played(BODY), evening):
        replays = Replay(recording), Replay(only_walking(recording))
        for name, steps in spans(recording).items():
            times = np.array([[cost(replay, steps) for replay in replays] for _ in range(REPEATS)]).min(0)
            joints, ratios[name] = times[0] / times[1]
            alone.append(joints)
            walk.append(times[1, 1] / len(steps))
    for name, ratio in ratios.items():
        emit(f"motion.posing_ratio.{name}", ratio, "times walking only")
    emit("motion.posing_ratio", max(ratios.values()), "times walking only")
    emit("motion.posing_joints_ratio", max(alone), "times walking only")
    emit("motion.posing_walk", 1e6 * min(walk), "us of CPU")
