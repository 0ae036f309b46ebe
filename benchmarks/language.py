"""Speed of the evaluation of propositions: 10,000 recordings of tasks in words, from a Parquet dataset to the table."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np

from h3data.metrics import measure_files
from h3data.recording import STEP_NS, Agent, AssetRef, Body, DatasetWriter, Episode, Event, Recording
from h3data_language.evaluation.layout import FurnitureBox, Layout, Surface, ThingBox

EPISODES, STEPS, BODIES, THINGS, FURNITURE, ROOMS = 10_000, 1_500, 100, 4, 24, 8


def run(emit: Callable[[str, float, str], None]) -> None:
    """Wall and CPU seconds for six propositions, with an order, dependencies and counts, in each recording."""
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
    """Recordings in which a person carries things, one after the other, from the first table to others."""
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
