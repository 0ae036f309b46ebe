"""Three to five agents that rearrange one home: how often they touch, whether the work gets done, who gets stuck.

The homes are those of h3-homes/test, casts are `CASTS`; robots play ``complement``, people ``both``. Shares are of runs:
``contact`` ended with a contact, ``success`` with all objects at their goals, ``stuck`` with neither (after 750 steps),
``blocked``: in the last `BLOCKED_STEPS` somebody wanted to go somewhere and did not get on.

    python -m benchmarks.sim_many 12      # so many seeds of each cast; `make bench` takes 4
    python -m benchmarks.sim_many 12 out/ # and keeps the recordings of all runs that fail
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from h3data.recording import Recording, write_mcap
from h3data.scene import FreeSpace, Scene
from h3data.scene.open import named_scenes, open_free_space, open_scene
from sim_kinematic.tasks.rearrange.episode import RearrangeSpec
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.recorder import simulate

Emit = Callable[[str, float, str], None]
SCENES = "h3-homes/test"
CASTS = (
    "robot,robot,robot",
    "robot,robot,human",
    "robot,human,human",
    "human,human,human",
    "robot,robot,human,human",
    "robot,human,human,human",
    "robot,robot,robot,human",
    "robot,robot,human,human,human",
    "robot,robot,robot,human,human",
    "human,human,human,human,human",
)
SEEDS, PROCESSES = 4, 2
BLOCKED_STEPS = 150


class Run(NamedTuple):
    """One episode."""

    agents: int
    ended: str
    steps: int
    blocked: bool


def run(emit: Emit, seeds: int = SEEDS, keep: str = "") -> None:
    """Emit ``sim.many.*`` for 3, 4 and 5 agents and for all."""
    runs = list(play_all(seeds, keep))
    for name, counts in (("agents_3", (3,)), ("agents_4", (4,)), ("agents_5", (5,)), ("all", (3, 4, 5))):
        some = [r for r in runs if r.agents in counts]
        ended = Counter(r.ended for r in some)
        emit(f"sim.many.{name}.runs", len(some), "runs")
        for what, how in (("contact", "collision"), ("success", "success"), ("stuck", "max_steps")):
            emit(f"sim.many.{name}.{what}", 100 * ended[how] / len(some), "%")
        emit(f"sim.many.{name}.blocked", 100 * sum(r.blocked for r in some) / len(some), "%")
        emit(f"sim.many.{name}.steps", float(np.mean([r.steps for r in some])), "steps")


def play_all(seeds: int, keep: str = "") -> Iterator[Run]:
    """Play every cast with so many seeds, in turn in all homes."""
    homes = len(named_scenes(SCENES))
    jobs = [(agents, (3 * seed + k) % homes, seed, keep) for k, agents in enumerate(CASTS) for seed in range(seeds)]
    with ProcessPoolExecutor(PROCESSES) as pool:
        yield from pool.map(play, sorted(jobs, key=lambda job: job[1]))


def play(job: tuple[str, int, int, str]) -> Run:
    """Return one episode: agents, home, seed, and the folder in which its recording is kept if it fails."""
    agents, home, seed, keep = job
    scene, free = _home(home)
    world = Rearrange().episode(scene, seed=seed, free=free, agents=agents)
    recording = simulate(Rearrange(), world, {"robot": "complement", "human": "both"})
    ended, kinds = str(recording.episode.info["ended"]), [agent.kind for agent in recording.agents]
    if keep and ended != "success":
        Path(keep).mkdir(parents=True, exist_ok=True)
        write_mcap(recording, Path(keep) / f"{''.join(kind[0] for kind in kinds)}-h{home}-s{seed}-{ended}.mcap")
    return Run(len(kinds), ended, len(recording), is_blocked(recording))


def is_blocked(recording: Recording) -> bool:
    """Return whether an agent wanted to go somewhere in the last steps without success."""
    for k in range(len(recording.agents)):
        goes = recording.columns[f"agent_{k}.skill"][-BLOCKED_STEPS:] < 2
        xz = recording.columns[f"agent_{k}.base_pose"][-BLOCKED_STEPS:, [0, 2]]
        if len(goes) == BLOCKED_STEPS and goes.all() and np.ptp(xz, axis=0).max() < 0.5:
            return True
    return False


@lru_cache(maxsize=2)
def _home(index: int) -> tuple[Scene, FreeSpace]:
    source, spec = named_scenes(SCENES)[index].source, RearrangeSpec()
    return open_scene(source), open_free_space(source, spec.agent_radius_m, spec.agent_height_m)


if __name__ == "__main__":
    seeds, keep = int((sys.argv[1:2] or [SEEDS])[0]), (sys.argv[2:3] or [""])[0]
    run(lambda name, value, unit: print(f"{name} {value:.6g} {unit}", flush=True), seeds, keep)
