"""Conversion of episode files to jobs, and of jobs to an episode file."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from h3data.commands.command import claim_file
from h3data.errors import H3DataError, InputError
from h3data.progress import progress
from h3data.recording import Recording
from h3data.recording.records import JOINTS
from h3data.scene.articulation import joints_of
from h3data.scene.open import open_scene
from h3data.scene.sources import SceneFile
from h3data_pipelines.jobs.episodes import (
    Choices,
    Job,
    SampledEpisode,
    SampledJobs,
    checked,
    chosen_count,
    make_jobs,
    refuse_beside,
)
from h3data_pipelines.jobs.failed_episodes import is_failed
from h3data_pipelines.jobs.running import simulate_job

if TYPE_CHECKING:
    from h3data.recording.task_episodes.rearrange_episode import EpisodeSet
    from h3data.recording.task_episodes.rearrange_episode import RearrangeEpisode as FileEntry
    from sim_kinematic.tasks.task import Task


_SHOWN = 20
PROBED = 64
"""Largest number of episodes of people with routines that are tried for the widths of columns."""


class FileJobs(NamedTuple):
    """Jobs for the episodes of a file."""

    jobs: Sequence[Job]
    left_out: tuple[str, ...] = ()
    """Episodes that cannot be played, with the reason."""
    warnings: tuple[str, ...] = ()
    """Warnings about stand-ins for missing assets."""


class MissingEpisodes(Protocol):
    """Report on the episodes of a file that cannot be played."""

    @property
    def left_out(self) -> tuple[str, ...]:
        """Episodes that cannot be played, with the reason."""
        ...

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about stand-ins for missing assets."""
        ...


def notes_on(made: MissingEpisodes) -> str:
    """Return lines about missing data of a file, each preceded by a line break."""
    lines = []
    for word, texts in (("left out", made.left_out), ("warning:", made.warnings)):
        lines += [f"{word} {text}" for text in texts[:_SHOWN]]
        if len(texts) > _SHOWN:
            lines.append(f"{word} {len(texts) - _SHOWN} more like these (--json lists all)")
    return "".join(f"\n{line}" for line in lines)


class EpisodeRequest(Protocol):
    """Request for the episodes of a command, which come from a file or are sampled in scenes."""

    @property
    def episodes_file(self) -> Path | None:
        """File with the episodes; None if they are sampled in ``scenes``."""
        ...

    @property
    def scenes(self) -> tuple[str, ...]:
        """Scenes, as in the option ``--scenes``."""
        ...

    @property
    def homes(self) -> int:
        """Number of homes of a preset."""
        ...

    @property
    def assets(self) -> Sequence[str | Path]:
        """Folders and files in which assets are searched."""
        ...

    @property
    def allow_missing(self) -> bool:
        """True if scenes may lack assets."""
        ...

    @property
    def episodes(self) -> int | None:
        """Number of episodes; None for all episodes of a file or set."""
        ...

    @property
    def seed(self) -> int:
        """Seed of the first episode."""
        ...


def requested_jobs(request: EpisodeRequest, choices: Choices, *, default_scenes: tuple[str, ...]) -> FileJobs:
    """Return the jobs of a request, which cannot name both a file and scenes other than the default ones.

    Raises:
        FormatError, InputError, SceneError: see `file_jobs` and `make_jobs`.
    """
    places: dict[str, Any] = {"assets": request.assets, "allow_missing": request.allow_missing}
    numbers: dict[str, Any] = {"episodes": request.episodes, "seed": request.seed}
    if request.episodes_file is None:
        return FileJobs(make_jobs(choices, request.scenes, homes=request.homes, **places, **numbers))
    refuse_beside("--episodes-file", scenes=request.scenes != default_scenes)
    return file_jobs(choices, request.episodes_file, **places, **numbers)


def file_jobs(
    choices: Choices,
    path: Path,
    *,
    episodes: int | None,
    seed: int = 0,
    assets: Sequence[str | Path] = (),
    allow_missing: bool = False,
) -> FileJobs:
    """Return the first ``episodes`` episodes of an episode file that the task can play.

    ``seed`` determines values that the file does not define, such as the starts in Habitat's own files.

    Raises:
        FormatError: the file is damaged.
        InputError: an option contradicts the file, or none of its episodes can be played.
        SceneError: no scene is found.
    """
    from h3data.recording.task_episodes.episode_files import episode_files
    from sim_kinematic.motion.randomness import episode_seed

    choices, files = checked(choices), episode_files()
    codec = choices.found_task.codec
    given = {"seed": seed != 0, "spawn_distance": choices.spawn_distance is not None}
    if not codec.samples_starts:
        refuse_beside("--episodes-file", **given)
    read = files.read(path)
    there, digest = read.episodes, _digest(path, read)
    jobs: list[Job] = []
    stand_ins: dict[str, None] = {}
    left_out: dict[str, list[int]] = {}
    faults: list[H3DataError] = []
    count = chosen_count(episodes, len(there), path.name)
    for i, entry in enumerate(progress(there[:count], desc="read episodes", unit="episode", at_least=1000)):
        try:
            stored = codec.read(entry, seed=episode_seed(seed, i))
            if stored is None:
                raise InputError(_not_of_task(entry, choices.found_task, path), code="H3-JOB-015")
            rules = codec.rules(stored)
            source = files.scene_of(entry, stored, path.parent, assets=assets, allow_missing=allow_missing)
            stand_ins |= dict.fromkeys(codec.stand_ins(stored, source))
        except H3DataError as fault:
            faults.append(fault)
            reason = " ".join(str(fault).replace(f" of episode {entry.episode_id!r}", "").split())
            left_out.setdefault(reason, []).append(i)
            continue
        if codec.is_complete(stored):
            refuse_beside("--episodes-file", **given)
        origin = {"file": path.name, "sha256": digest, "episode": i, "episode_id": str(entry.episode_id)}
        drawn = SampledEpisode(i, stored.seed, entry.scene_id, source, origin)
        told = choices.agents is not None or choices.human is not None
        agents = {} if told else {"agents": None}
        jobs.append(choices.job(drawn, spec=choices.spec(rules), stored=stored, **agents))
    if not jobs:
        raise faults[0]
    return FileJobs(
        jobs,
        tuple(
            f"{'episode' if len(of) == 1 else 'episodes'} {_ranges(of)}: {reason}" for reason, of in left_out.items()
        ),
        tuple(stand_ins),
    )


def _digest(path: Path, read: EpisodeSet) -> str:
    """Return the SHA-256 (hex) of the file, and of its episodes if the set is split by scene."""
    from h3data.recording.task_episodes.episode_files import episode_files

    encode, digest = episode_files().encode, hashlib.sha256(path.read_bytes())
    for entry in read.episodes if read.contents else ():
        digest.update(encode(entry))
    return digest.hexdigest()


def _not_of_task(entry: FileEntry, task: Task, path: Path) -> str:
    """Return the reason why an entry of an episode file is none of a task."""
    from h3data.recording.task_episodes.stored_episodes import task_of

    of = task_of(entry)
    if of is not None:
        return f"Episode {entry.episode_id!r} is one of {of}, not of {task.name}: {path}"
    if task.control.has_skills:
        return f"Episode {entry.episode_id!r} names no targets, so there is nothing to rearrange: {path}"
    return (
        f"Episode {entry.episode_id!r} says neither where robot and person start nor where they walk, as Habitat's own "
        f"files do not. Expected one that h3data wrote (--save-episodes, h3data scenes export): {path}"
    )


def _ranges(numbers: Sequence[int]) -> str:
    """Return integers as ranges, such as ``0-3, 7`` for 0, 1, 2, 3, 7."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][-1] + 1:
            parts[-1] = [parts[-1][0], number]
        else:
            parts.append([number])
    shown = ", ".join("-".join(map(str, part)) for part in parts[:8])
    return shown + (f", ... ({len(numbers)} in all)" if len(parts) > 8 else "")


def widest_episodes(jobs: Sequence[Job]) -> Iterator[Recording]:
    """Yield the first steps of episodes that together have the widest columns of a dataset, as far as widths may differ.

    Widths depend on the number of objects, on the joints of each home, and on the things of people with routines. The
    latter differ between episodes of one home too, so that up to `PROBED` of these are tried. Episodes that cannot be
    played are left out.
    """
    all_kinds = jobs.one_round if isinstance(jobs, SampledJobs) else jobs
    chosen = {(job.scene, getattr(job.spec, "objects", 0)): job for job in reversed(all_kinds)}
    spread = jobs[:: -(-len(jobs) // PROBED)] if any(map(_has_routine, chosen.values())) else []
    probed = list({job.index: job for job in (*chosen.values(), *spread)}.values())
    if len(probed) < 2:
        return
    seen: list[tuple[int, int]] = []
    for job in progress(probed, desc="columns", unit="episode", at_least=20):
        try:
            widths = len(joints_of(open_scene(job.source)).rest), getattr(job.spec, "objects", 0)
        except H3DataError:
            continue
        if not _has_routine(job) and any(widths[0] <= joints and widths[1] <= count for joints, count in seen):
            continue
        recording = simulate_job(job, max_steps=1)
        if is_failed(recording):  # as it will be when it is played, and reported then
            continue
        seen.append(widths)
        yield recording
        if not recording.columns.keys() & {JOINTS, "object_pose"}:
            return


def _has_routine(job: Job) -> bool:
    return any("+" in name for name in (job.policy, job.partner) if name is not None)


# --- writing ----------------------------------------------------------------------------------------------------------
def claim_episode_file(path: Path, *, force: bool) -> None:
    """Raise an `InputError` if a file exists or does not have the name of an episode file."""
    if not path.name.endswith((".json.gz", ".json")):
        raise InputError(
            f"--save-episodes: expected a file name that ends in .json.gz or .json, got: {path}", code="H3-JOB-014"
        )
    claim_file(path, force=force)


def save_episodes(jobs: Sequence[Job], path: Path) -> tuple[str, ...]:
    """Write episodes of jobs to a file that `file_jobs` can read; return the reasons for episodes that are left out.

    Raises:
        SceneError: no episode can be sampled.
    """
    from h3data.recording.task_episodes.episode_files import episode_files
    from h3data.recording.task_episodes.rearrange_episode import EpisodeSet

    files = episode_files()
    entries: list[FileEntry] = []
    faults: dict[int, H3DataError] = {}
    for job in progress(jobs, desc="episodes", unit="episode", at_least=5):
        codec = job.found_task.codec
        config = job.source.path if isinstance(job.source, SceneFile) and job.source.scene else "default"
        try:
            record = codec.record(job.episode())
        except H3DataError as fault:
            faults[job.index] = fault
            continue
        entries.append(codec.entry(record, episode_id=str(job.index), scene_id=job.scene, scene_dataset_config=config))
    if not entries:
        raise next(iter(faults.values()))
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write(EpisodeSet(episodes=tuple(entries)), path)
    return tuple(f"episode {index} of {path.name}: {fault}" for index, fault in faults.items())
