"""Tasks in words: the evaluation of 10,000 recordings, the size of a request, memory over 200 episodes, the cost of sight."""

from __future__ import annotations

import gc
import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from h3data import load_scene
from h3data.metrics import measure_files
from h3data.policies import AssignedPolicy, resolve_policy
from h3data.recording import STEP_NS, Agent, AssetRef, Body, DatasetWriter, Episode, Event, Recording
from h3data.tasks import Rearrange, WorldRollout
from h3data_language.evaluation.layout import FurnitureBox, Layout, Surface, ThingBox
from h3data_language.task import Language
from h3data_llm.endpoint import Address, HttpEndpoint
from h3data_llm.policy import LanguageModelPolicy
from sim_kinematic.tasks.recorder import run as run_episode
from sim_kinematic.tasks.recorder import simulate

EPISODES, STEPS, BODIES, THINGS, FURNITURE, ROOMS = 10_000, 1_500, 100, 4, 24, 8


MEMORY_EPISODES, MEMORY_HOMES, MEMORY_STEPS, WARM = 200, 4, 400, 40
SIGHT_TURNS, SIGHT_SEEDS = 2, (5, 6, 7)


def run(emit: Callable[[str, float, str], None]) -> None:
    """Measure all of it; the recordings last, as they take longest to write."""
    _size(emit)
    _memory(emit)
    _sight(emit)
    _propositions(emit)


def _size(emit: Callable[[str, float, str], None]) -> None:
    """Emit tokens of 4 characters in the first request about a home of eleven rooms: all of it, and the text alone."""
    task = Language()
    episode = task.episode(load_scene("medium2:0"), seed=0, spec=task.Spec(observe="seen"))
    address = Address.of("llm:http://127.0.0.1/v1?model=m")
    policy = LanguageModelPolicy(address, HttpEndpoint(address), task, episode, 1)  # which is not asked
    nobody = [AssignedPolicy(None, "", member.kind) for member in episode.roster]
    body = json.loads(policy.request(WorldRollout.of(task, episode, nobody).view(1)))
    emit("language.request_tokens", len(json.dumps(body)) / 4, "tokens")
    emit("language.world_text_tokens", sum(len(m["content"]) for m in body["messages"]) / 4, "tokens")


def _memory(emit: Callable[[str, float, str], None]) -> None:
    """Emit the growth of memory of one process from its 40th episode to its 200th, in four homes by turns."""
    task, sizes = Language(), []
    scenes = [load_scene(f"small:{k}") for k in range(MEMORY_HOMES)]
    for k in range(MEMORY_EPISODES):
        spec = task.Spec(max_steps=MEMORY_STEPS)
        recording = simulate(task, task.episode(scenes[k % MEMORY_HOMES], seed=k, spec=spec))
        assert len(recording) <= MEMORY_STEPS
        sizes.append(_resident_mb())
    emit(f"language.memory_growth_{MEMORY_EPISODES}_episodes_mb", max(sizes[WARM:]) - sizes[WARM - 1], "MiB")
    emit("language.memory_mb", sizes[-1], "MiB")


def _resident_mb() -> float:
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def _sight(emit: Callable[[str, float, str], None]) -> None:
    """Emit CPU time of a step of rearrangement whose agents see with their own eyes, over that with full knowledge.

    Without pictures, and with a depth image of the robot's arm at every step.
    """
    task, scene = Rearrange(), load_scene("h3-homes/test#0")
    for camera, names in (("", ()), ("camera_", ("arm_depth",))):
        cost: dict[str, list[float]] = {"full": [], "seen": []}
        for _ in range(SIGHT_TURNS + 1):
            for observe, found in cost.items():
                steps, spent = 0, 0.0
                for seed in SIGHT_SEEDS:
                    episode = task.episode(scene, seed=seed, spec=task.Spec(observe=observe))
                    rollout = WorldRollout.of(task, episode, _errands(task, episode))
                    draw = partial(rollout.pictures, 0, 0, names, None) if names else int
                    start = time.process_time()
                    run_episode(rollout, progress=lambda _, draw=draw: draw())
                    spent, steps = spent + time.process_time() - start, steps + rollout.step
                found.append(spent / steps)
        full, seen = (min(found[1:]) for found in cost.values())
        emit(f"language.step_{camera}full_ms", full * 1e3, "ms")
        emit(f"language.step_{camera}seen_ms", seen * 1e3, "ms")
        emit(f"language.sight_{camera}cost_percent", 100 * (seen / full - 1), "%")


def _errands(task: Rearrange, episode: Any) -> list[AssignedPolicy]:
    names = {"robot": "complement", "human": "both"}
    return [resolve_policy(task, m.kind, names[m.kind])(episode, k) for k, m in enumerate(episode.roster)]


def _propositions(emit: Callable[[str, float, str], None]) -> None:
    """Emit wall and CPU seconds for six propositions, with an order, dependencies and counts, in each recording."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "dataset"
        with DatasetWriter(root) as out:
            for recording in synthetic_recordings(EPISODES):
                out.add(recording)
        start, cpu = time.perf_counter(), time.process_time()
        table = measure_files([root], "partnr", workers=min(2, len(os.sched_getaffinity(0))))
        emit(f"language.propositions_{EPISODES}x{STEPS}_s", time.perf_counter() - start, "s")
        emit(f"language.propositions_{EPISODES}x{STEPS}_cpu_s", time.process_time() - cpu, "s")
        emit("language.percent_complete", float(table.columns["PC"].mean()), "1")


def synthetic_recordings(count: int) -> Iterator[Recording]:
    """Yield recordings in which a person carries things, one after the other, from the first table to others."""
    rng = np.random.default_rng(0)
    tables = {
        f"table_{k}": FurnitureBox((2.0 * k, 0.4, 0), (0.5, 0.4, 0.5), (Surface((2.0 * k, 0.8, 0), (0.5, 0.5), 0, 1),))
        for k in range(FURNITURE)
    }
    things = {f"mug_{k}": ThingBox(k, (0, 0.05, 0), (0.04, 0.05, 0.04)) for k in range(THINGS)}
    rooms = {f"room_{k}": ((6.0 * k - 3, -3.0, 6.0 * k + 3, 3.0),) for k in range(ROOMS)}
    layout = msgspec.to_builtins(Layout(things, tables, rooms))
    names = [[f"table_{k}", f"table_{k + 1}"] for k in range(THINGS)]
    asked = [("is_on_top", {"object_handles": [f"mug_{k}"], "receptacle_handles": names[k]}) for k in range(THINGS)]
    asked += [("is_on_top", {"object_handles": list(things), "receptacle_handles": list(tables), "number": 2})]
    told = {
        "evaluation_propositions": [{"function_name": f, "args": a} for f, a in asked],
        "evaluation_proposition_dependencies": [
            {"proposition_indices": [1], "depends_on": [0], "relation_type": "after_satisfied"}
        ],
        "evaluation_constraints": [
            {"type": "TemporalConstraint", "args": {"dag_edges": [[0, 2], [1, 2]]}},
            {"type": "TerminalSatisfactionConstraint", "args": {"proposition_indices": [0, 1, 2, 3]}},
        ],
    }
    still = np.tile(np.array([0, 0, 0, 0, 0, 0, 1], np.float32), (STEPS, 1))
    for number in range(count):
        at = np.zeros((STEPS, THINGS, 7), np.float32)
        at[..., 1], at[..., 6] = 0.8, 1
        grasp, events = np.full(STEPS, -1, np.int32), []
        for k in range(THINGS):
            a, b = 300 * k + rng.integers(0, 100), 300 * k + rng.integers(150, 300)
            at[a:b, k, 0] = np.linspace(0, 2.0 * k, b - a)
            at[b:, k, 0], grasp[a:b] = 2.0 * k, k
            events += [
                Event(step=int(t), agent=1, kind=kind, target=f"mug_{k}") for t, kind in ((a, "pick"), (b, "place"))
            ]
        yield Recording(
            episode=Episode(
                uid=f"language-{number}",
                episode_id=f"{number}",
                task="language",
                scene="synthetic",
                info={**told, "evaluation_layout": layout},
            ),
            assets=(AssetRef(name="mug", uri="primitive:box"),),
            bodies=tuple(
                Body(name=f"body_{k}", asset="mug", pose=still[0], moving=k if k < THINGS else -1)
                for k in range(BODIES)
            ),
            agents=(Agent(name="robot", kind="robot"), Agent(name="person", kind="human")),
            columns={
                "time_ns": np.arange(STEPS, dtype=np.int64) * STEP_NS,
                "object_pose": at,
                "agent_0.base_pose": still,
                "agent_1.base_pose": still,
                "agent_0.grasp_body": np.full(STEPS, -1, np.int32),
                "agent_1.grasp_body": grasp,
            },
            events=tuple(events),
        )
