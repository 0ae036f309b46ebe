"""``h3data generate``: episode datasets, one row group per episode, safe to interrupt and to resume."""

from __future__ import annotations

import json
import os
import re
import signal
import threading
import time
from collections.abc import Generator, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import tyro
from tqdm import tqdm

from h3data.errors import H3DataError, InputError
from h3data.recording import Recording
from h3data_pipelines.command import ForceFlag, JsonFlag, Outcome, claim_folder, remove_dataset, uninterrupted
from sim_kinematic.spec import SocialNavSpec, WalkerSpec

if TYPE_CHECKING:
    from h3data.recording import Dataset, DatasetWriter
    from h3data.scene import FreeSpace, Scene

COMMIT_S = 60.0
"""At most the work of this time is lost when the process is killed."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """One episode to simulate: all that a worker needs to know."""

    index: int
    seed: int
    scene: str
    policy: str
    human: str
    spec: SocialNavSpec

    def to_json(self) -> dict[str, Any]:
        """All of it as JSON gives it back."""
        return json.loads(json.dumps(asdict(self)))


@dataclass(frozen=True)
class Generate:
    """Simulate episodes into a Parquet dataset (LeRobot v3 layout). The same seed gives the same episodes, bit for bit.

    Examples:
        h3data generate social_nav --episodes 20 --seed 7 -o ds/
        h3data generate social_nav --scenes medium --homes 8 --episodes 200 --workers 2 -o ds/
        h3data generate social_nav --scenes my_home.scene_instance.json --episodes 5 -o ds/ --mcap
    """

    task: tyro.conf.Positional[str]
    """social_nav: find a walking person and follow her at 1-2 m."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder of the dataset."""
    episodes: int = 10
    """How many."""
    seed: int = 0
    """Everything random follows from it."""
    scenes: str = "small"
    """small, medium or large (built-in homes), one home as small:3, or the path of a Habitat scene (.scene_instance.json)."""
    homes: int = 4
    """Number of different built-in homes that the episodes go round."""
    policy: str = "heuristic_expert"
    """Robot policy: heuristic_expert or stand_still."""
    human: str = "female_0"
    """Built-in body of the person."""
    human_speed: float = 2.5
    """Walking speed of the person [m/s]; the paper's is 2.5."""
    max_steps: int = 1500
    """Length limit of an episode, at 30 steps per second."""
    spawn_distance: float = 5.0
    """Least distance between both at the start [m]; the paper: 3 for training, 5 for evaluation."""
    workers: int = 1
    """Processes."""
    mcap: bool = False
    """Also write each episode as <out>/mcap/<episode>.mcap, at the end."""
    resume: bool = False
    """Go on with an interrupted dataset that was started with the same options."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        from h3data.metrics import measure_many
        from h3data.recording import Dataset, DatasetWriter

        if self.force and self.resume:
            raise InputError("Choose one: --resume goes on with a dataset, --force replaces it.")
        jobs = self.jobs()
        if self.force:
            remove_dataset(self.out)
        if self.resume:
            require_same_options(self.out, jobs)
        else:
            claim_folder(self.out, force=False)
        with DatasetWriter(self.out, resume=self.resume) as writer:
            done = len(writer)
            self._simulate(jobs[done:], writer)
        recordings = _ReadBack(Dataset(self.out), self.out / "mcap" if self.mcap else None)
        table = measure_many(recordings)
        text = f"{len(table)} episodes, {recordings.steps} steps in {self.out}\n\n{table.to_text()}"
        data: dict[str, Any] = {
            "dataset": str(self.out), "episodes": len(table), "new": len(table) - done, "steps": recordings.steps,
            "state_hashes": recordings.hashes, "metrics": table.to_dict(),
        }  # fmt: skip
        return Outcome(text=text, data=data)

    def _simulate(self, jobs: list[Job], writer: DatasetWriter) -> None:
        committed = time.monotonic()
        bar = tqdm(total=self.episodes, initial=len(writer), desc="simulate", unit="episode", disable=None)
        with bar, closing(simulate_jobs(jobs, workers=self.workers)) as recordings:
            for recording in recordings:
                with uninterrupted():
                    writer.add(recording)
                    if time.monotonic() - committed > COMMIT_S:
                        writer.commit()
                        committed = time.monotonic()
                bar.update()
        with uninterrupted():
            writer.commit()

    def jobs(self) -> list[Job]:
        """All episodes, or an `InputError` that names the bad option."""
        from sim_kinematic.policies import policy_by_name
        from sim_kinematic.randomness import episode_seed
        from sim_kinematic.social_nav import require_task

        require_task(self.task)
        policy_by_name(self.policy)
        for name, value, least in (
            ("--episodes", self.episodes, 1), ("--homes", self.homes, 1), ("--max-steps", self.max_steps, 1),
            ("--workers", self.workers, 1), ("--seed", self.seed, 0),
        ):  # fmt: skip
            if value < least:
                raise InputError(f"{name} must be at least {least}, got {value}.")
        if not 0 < self.human_speed <= 4:
            raise InputError(f"--human-speed must be above 0 and at most 4 m/s, got {self.human_speed}.")
        if not self.spawn_distance >= 0:  # also NaN
            raise InputError(f"--spawn-distance must not be negative, got {self.spawn_distance}.")
        names = scene_names(self.scenes, self.homes)
        spec = SocialNavSpec(
            max_steps=self.max_steps, spawn_distance_m=self.spawn_distance, human=WalkerSpec(speed_mps=self.human_speed)
        )
        return [
            Job(
                index=i, seed=episode_seed(self.seed, i), scene=names[i % len(names)], policy=self.policy,
                human=self.human, spec=spec,
            )
            for i in range(self.episodes)
        ]  # fmt: skip


class _ReadBack:
    """The episodes of a dataset, read once, with what they add up to. Writes those logs that are wanted and not there."""

    def __init__(self, dataset: Dataset, mcap: Path | None) -> None:
        self.dataset, self.mcap = dataset, mcap
        self.hashes: list[str] = []
        self.steps = 0

    def __iter__(self) -> Iterator[Recording]:
        from h3data.recording import write_mcap

        for index in range(len(self.dataset)):
            recording = self.dataset.recording(index)
            if self.mcap is not None:
                log = self.mcap / f"{recording.episode.episode_id}.mcap"
                if not log.exists():
                    write_mcap(recording, log, overwrite=True)  # over what an interrupted run left of it
            self.hashes.append(str(recording.columns["state_hash"][-1]))
            self.steps += len(recording)
            yield recording


def require_same_options(folder: Path, jobs: list[Job]) -> None:
    """Refuse to go on with a dataset whose episodes are not those that ``jobs`` would make."""
    from h3data.recording import Dataset

    if not folder.is_dir() or not any(folder.iterdir()):
        return
    for job, row in zip(jobs, Dataset(folder).episodes.to_pylist(), strict=False):
        was, wanted = json.loads(row["info"]).get("job", {}), job.to_json()
        differs = [
            f"{name} was {was.get(name)}, is {value}" for name, value in wanted.items() if was.get(name) != value
        ]
        if differs:
            raise InputError(
                f"Cannot resume with other options: episode {job.index} of the dataset was made differently "
                f"({'; '.join(differs)}). Use the options it was started with, or another -o: {folder}"
            )


def scene_names(text: str, homes: int) -> list[str]:
    """Scenes that ``text`` stands for: ``small`` is ``homes`` homes ``small:0``, ``small:1``, ...; a path is itself."""
    from h3data.scene import HOME_PRESETS

    if text in HOME_PRESETS:
        return [f"{text}:{i}" for i in range(homes)]
    if re.fullmatch(r"[a-z]+:\d+", text) and text.partition(":")[0] in HOME_PRESETS:
        return [text]
    if Path(text).exists():
        return [str(Path(text))]
    raise InputError(
        f"Unknown scenes {text!r}. Expected {' or '.join(HOME_PRESETS)}, one home as small:3, or the path of a Habitat "
        "scene (.scene_instance.json, .stage_config.json, .glb)."
    )


@lru_cache(maxsize=64)  # 2 MB each; episodes go round the homes, so fewer would all be made anew each time
def load_scene_by_name(name: str) -> Scene:
    """The built-in home ``preset:seed`` or the Habitat scene at a path."""
    from h3data.interop import load_habitat_scene
    from h3data.scene import HomeSpec, build_home
    from h3data.scene.homes.spec import Preset

    preset, _, seed = name.partition(":")
    for known in get_args(Preset):
        if preset == known and seed.isdigit():
            return build_home(HomeSpec(preset=known, seed=int(seed)))
    return load_habitat_scene(Path(name))


@lru_cache(maxsize=64)
def _free_space(name: str, radius_m: float, height_m: float) -> FreeSpace:
    from h3data.scene import FreeSpace

    return FreeSpace.from_scene(load_scene_by_name(name), radius_m=radius_m, height_m=height_m)


def simulate_job(job: Job) -> Recording:
    """One episode. Depends on the job alone, so any process may run it."""
    from sim_kinematic.social_nav import SocialNavWorld, simulate_social_nav

    scene = load_scene_by_name(job.scene)
    free = _free_space(job.scene, job.spec.agent_radius_m, job.spec.agent_height_m)
    world = SocialNavWorld.create(scene, seed=job.seed, spec=job.spec, free=free, human=job.human)
    recording = simulate_social_nav(world, policy=job.policy, episode_id=f"{job.index:06d}")
    info = {**recording.episode.info, "job": job.to_json()}
    return replace(recording, episode=replace(recording.episode, info=info))


def simulate_jobs(jobs: list[Job], *, workers: int) -> Generator[Recording]:
    """Recordings in the order of ``jobs``, by this process or by several."""
    if workers <= 1 or len(jobs) <= 1:
        yield from map(simulate_job, jobs)
        return
    # spawn: forked children would share the thread pools of numba and torch
    size = min(workers, len(jobs), os.cpu_count() or 1)
    with ProcessPoolExecutor(size, mp_context=get_context("spawn"), initializer=_start_worker) as pool:
        try:
            yield from pool.map(simulate_job, jobs)
        except BrokenProcessPool:
            raise H3DataError(
                "A worker process died, perhaps for lack of memory. Finished episodes are kept: go on with --resume and "
                "fewer --workers."
            ) from None


def _start_worker() -> None:
    """Leave Ctrl-C to the parent, and do not outlive it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    assert parent is not None
    threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()
