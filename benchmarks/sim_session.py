"""Sessions: a person driven beside a robot that follows a policy, each step recorded to a file, as a server plays them.

``sim.rearrange.person_step_cpu_ms`` is the mean over an episode of 400 steps, ``person_step_worst_ms`` its longest step: they
hold walking with and without a hand that is led, picking and dropping, and the plans of the robot. Each is the median of
five repetitions of the same episode, after one that is not counted: the first compiles and fills caches.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np

import h3data
from h3data.geometry import Array
from sim_kinematic.agents.driven.commands import Drop, HandTarget, PersonCommand, Pick
from sim_kinematic.policies.policy import External

Emit = Callable[[str, float, str], None]
STEPS, REPETITIONS = 400, 5


def run(emit: Emit) -> None:
    """Emit ``sim.rearrange.person_step_*``."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "driven.mcap"
        _step_times(path)
        times = [_step_times(path) for _ in range(REPETITIONS)]
    emit("sim.rearrange.person_step_cpu_ms", 1e3 * median(float(t.mean()) for t in times), "ms")
    emit("sim.rearrange.person_step_worst_ms", 1e3 * median(float(t.max()) for t in times), "ms")


def _step_times(path: Path) -> Array:
    """Return the CPU seconds of each step of one session, [T]."""
    session = h3data.session(
        "rearrange",
        "small:3",
        agents={"person": External(), "robot": "complement"},
        record=path,
        overwrite=True,
        end_on_collision=False,
    )
    person, rng, times = session.play.team.people[0], np.random.default_rng(0), []  # type: ignore[attr-defined]
    for step in range(STEPS):
        if session.ended:
            break
        if step % 15 == 0:
            hand = HandTarget(tuple(rng.normal((0.4, 1.0, 0.2), 0.2))) if step % 45 == 0 else None
            session.act("person", PersonCommand(*rng.uniform(-1, 1, 2), right=hand))
        if step % 60 == 50:
            session.act("person", Pick(0) if person.objects.held(person.number) < 0 else Drop())
        begun = time.process_time()
        session.step()
        times.append(time.process_time() - begun)
    session.close()
    return np.array(times)
