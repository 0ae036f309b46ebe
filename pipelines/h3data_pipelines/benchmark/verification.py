"""Verification of a result, whose table is checked against its recordings, and these against the benchmark's episodes.

No claim of the result is trusted. Each recording is compared with the episode that the benchmark names,
simulated again from the robot's recorded actions while the policies of people decide again, and measured again.
"""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from h3data.commands.executors import opened
from h3data.errors import H3DataError, InputError
from h3data.plugins import names_from_data
from h3data.recording import Recording
from h3data.terminal import counted
from h3data_pipelines.benchmark.definition import Benchmark, find_benchmark
from h3data_pipelines.benchmark.result import (
    MANIFEST,
    BenchmarkResult,
    read_result,
    result_files,
    summarized,
)
from h3data_pipelines.hub.checksums import checksums_of
from h3data_pipelines.jobs.evaluation_runs import RECORDINGS
from h3data_pipelines.jobs.evaluations import episode_uid
from h3data_pipelines.jobs.result_files import RESULTS, NoProgress

if TYPE_CHECKING:
    from h3data_pipelines.jobs.episodes import Job
    from sim_kinematic.tasks.episode import Episode
    from sim_kinematic.tasks.resimulation import Verification
    from sim_kinematic.tasks.task import Task

MOST_SHOWN = 20
"""Largest number of faults that are printed; ``--json`` lists all."""


@dataclass(frozen=True, kw_only=True)
class ResultVerification:
    """Outcome of the verification of a result."""

    folder: Path
    benchmark: str
    recordings: int
    """Number of recordings of the episodes that were checked."""
    episodes: int
    """Number of episodes that were checked."""
    of_episodes: int
    """Number of episodes of the whole benchmark."""
    faults: tuple[str, ...]
    """Faults that were found, one sentence each; empty if the table is confirmed."""

    @property
    def is_true(self) -> bool:
        """Return whether no fault was found."""
        return not self.faults

    def to_text(self) -> str:
        """Return the faults, followed by the verdict."""
        checked = (
            f"{counted(self.recordings, 'recording')} of {self.episodes} of {counted(self.of_episodes, 'episode')} simulated "
            "and measured again"
        )
        if self.is_true:
            return f"true: {self.folder}, {self.benchmark}: {checked}, and the table follows from them."
        more = len(self.faults) - MOST_SHOWN
        lines = [*self.faults[:MOST_SHOWN], *([f"and {more} more (--json lists all)"] if more > 0 else [])]
        return "\n".join([*lines, f"not true: {self.folder}, {self.benchmark}: {checked}."])

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict as JSON types."""
        return {
            "result": str(self.folder),
            "benchmark": self.benchmark,
            "true": self.is_true,
            "recordings": self.recordings,
            "episodes": self.episodes,
            "of_episodes": self.of_episodes,
            "faults": list(self.faults),
        }


@dataclass(frozen=True)
class _Part:
    """The recordings of one episode."""

    folder: str
    index: int
    job: Job
    uid: str
    """Identity of the benchmark's episode."""
    rows: tuple[dict[str, Any], ...]
    """Results that the episode's file gives."""


def verify_result(
    folder: Path,
    *,
    benchmark: str | None = None,
    episodes: int | None = None,
    seed: int = 0,
    workers: int = 1,
    progress: Callable[..., Any] | None = None,
) -> ResultVerification:
    """Verify a result, either completely or in a random sample of its episodes.

    Args:
        folder: Folder of the result.
        benchmark: Name or folder of the benchmark (default: the shipped one that the result names).
        episodes: Number of episodes to check, sampled at random (default: all).
        seed: Seed of the random sample.
        workers: Number of processes.
        progress: Function that creates a progress bar, called with ``total``, ``desc`` and ``unit``.

    Raises:
        InputError: the folder holds no result, or there is no such benchmark.
        FormatError: ``benchmark.json`` is damaged.
    """
    result = read_result(folder)
    found = find_benchmark(benchmark or result.benchmark)
    if episodes is not None and episodes < 1:
        raise InputError(f"--episodes must be at least 1, got {episodes}.", code="H3-OPTION-094")
    faults = [*_of_manifest(folder, result, found)]
    uids, jobs = found.episode_uids(), found.jobs()
    stored, unreadable = _stored_rows(folder, found)
    faults += unreadable
    chosen = (
        range(len(uids))
        if episodes is None or episodes >= len(uids)
        else sorted(random.Random(seed).sample(range(len(uids)), episodes))
    )
    parts = [_Part(str(folder), index, jobs[index].base, uids[index], tuple(stored.get(index, ()))) for index in chosen]
    parts.sort(key=lambda part: str(part.job.scene))  # home by home: the files of a few homes alone are kept
    count = 0
    with (
        opened("local", workers) as workforce,
        (progress or NoProgress)(total=len(parts), desc="verify", unit="episode") as bar,
        closing(workforce.run(_check_episode, parts, lost=_lost)) as results,
    ):
        for recordings, wrong in results:
            count += recordings
            faults += wrong
            bar.update()
    faults += _of_table(result, found, stored)
    return ResultVerification(
        folder=folder,
        benchmark=found.label,
        recordings=count,
        episodes=len(parts),
        of_episodes=len(uids),
        faults=tuple(faults),
    )


def _of_manifest(folder: Path, result: BenchmarkResult, benchmark: Benchmark) -> list[str]:
    """Return faults of the benchmark's name and of the digests of files."""
    faults = []
    if result.benchmark != benchmark.label:
        faults.append(f"{MANIFEST}: expected a result of {benchmark.label}, got one of {result.benchmark}.")
    elif result.definition_sha256 != benchmark.sha256:
        faults.append(f"{MANIFEST}: the result is of another definition of {benchmark.label} than this one.")
    there = result_files(folder)
    if missing := sorted(set(result.files) - set(there)):
        faults.append(f"{MANIFEST}: {counted(len(missing), 'file')} missing, the first is {missing[0]}.")
    if added := sorted(set(there) - set(result.files)):
        faults.append(f"{MANIFEST}: {counted(len(added), 'file')} not listed, the first is {added[0]}.")
    known = {f"{index:06d}" for index in range(benchmark.file.episodes)}
    odd = [
        name for name in there if name.split("/")[1].removesuffix(".json") not in known or (folder / name).is_symlink()
    ]
    if odd:
        faults.append(f"{counted(len(odd), 'file')} of no episode, or links, the first is {odd[0]}.")
    found = checksums_of(folder, [name for name in there if name in result.files])
    changed = [name for name, digest in found.items() if digest != result.files[name]]
    return [*faults, *(f"{name}: the file is not the one that {MANIFEST} lists." for name in changed)]


def _stored_rows(folder: Path, benchmark: Benchmark) -> tuple[dict[int, list[dict[str, Any]]], list[str]]:
    """Return results by episode as their files give them, and what is wrong with these files."""
    stored: dict[int, list[dict[str, Any]]] = {}
    faults = []
    for index in range(benchmark.file.episodes):
        path = folder / RESULTS / f"{index:06d}.json"
        try:
            rows = json.loads(path.read_text(encoding="utf-8"))["rows"]
            stored[index] = [_checked_row(row) for row in rows]
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as fault:
            faults.append(f"{RESULTS}/{path.name}: expected the results of an episode, got {fault!r}.")
            continue
        pairs = [(row["policy"], row.get("partner")) for row in stored[index]]
        if len(pairs) != len(set(pairs)):
            faults.append(f"{RESULTS}/{path.name}: a policy is listed twice.")
        expected: set[Any] = set(benchmark.file.partners) or {None}
        if {row.get("partner") for row in stored[index]} - expected:
            faults.append(
                f"{RESULTS}/{path.name}: expected the partners {', '.join(benchmark.file.partners) or 'of no name'}."
            )
            stored[index] = [row for row in stored[index] if row.get("partner") in expected]
    return stored, faults


def _checked_row(row: Any) -> dict[str, Any]:
    """Return result of a policy in an episode from a file; raise a ValueError, KeyError or TypeError if it is none."""
    if not isinstance(row.get("partner"), str | None):
        raise TypeError(f"a partner that is no name: {row['partner']!r}")
    return {**row, "policy": str(row["policy"]), "values": dict(row["values"])}


def _of_table(
    result: BenchmarkResult, benchmark: Benchmark, stored: Mapping[int, Sequence[Mapping[str, Any]]]
) -> list[str]:
    """Return faults of the table: rows that do not follow from the results of the episodes."""
    expected = benchmark.file.episodes * max(len(benchmark.file.partners), 1)
    rows = summarized(benchmark.metrics(), [row for index in sorted(stored) for row in stored[index]], expected)
    ours = {row.policy: msgspec.to_builtins(row) for row in rows}
    theirs = {row.policy: msgspec.to_builtins(row) for row in result.rows}
    faults = [f"{MANIFEST}: the row of {policy} has no episodes." for policy in theirs if policy not in ours]
    faults += [f"{MANIFEST}: there is no row of {policy}, which has played." for policy in ours if policy not in theirs]
    for policy in ours:
        if policy in theirs and ours[policy] != theirs[policy]:
            names = [
                name for name, cell in ours[policy]["metrics"].items() if theirs[policy]["metrics"].get(name) != cell
            ]
            what = ", ".join(names) or "the number of episodes"
            faults.append(f"{MANIFEST}: the row of {policy} does not follow from its episodes: {what}.")
    return faults


def _check_episode(part: _Part) -> tuple[int, list[str]]:
    """Return the number of recordings of an episode, and what is wrong with them."""
    from h3data.recording.finding import find_episodes

    name = f"{RECORDINGS}/{part.index:06d}"
    folder = Path(part.folder) / name
    expected = {(row["policy"], row.get("partner")) for row in part.rows}
    base = part.job
    episode = base.episode()
    if episode_uid(base.found_task, episode) != part.uid:
        return 0, [f"{name}: this version of h3data makes another episode than the benchmark's."]
    faults: list[str] = []
    seen: set[tuple[str, Any]] = set()
    sources = list(find_episodes([folder])) if folder.is_dir() else []
    for source in sources:
        try:
            recording = source.read()
            info = recording.episode.info
            policy, partners = str(info.get("policy")), info.get("partners") or [None]
            if not isinstance(partners, list) or not all(isinstance(partner, str | None) for partner in partners):
                faults.append(f"{name}, {policy}: its partners are no list of names.")
                continue
            rows = [row for row in part.rows if row["policy"] == policy and row.get("partner") in partners]
            seen |= {(policy, partner) for partner in partners}
            with names_from_data():  # whoever made the result chose the names in it
                faults += [f"{name}, {policy}: {wrong}" for wrong in _wrong_with(recording, base, episode, rows)]
            if len(rows) != len(partners):
                faults.append(f"{name}, {policy}: {RESULTS} has no results of it with each of its partners.")
        except H3DataError as fault:
            faults.append(f"{source.name}: {fault}")
    if lost := sorted(f"{policy} with {partner}" if partner else policy for policy, partner in expected - seen):
        faults.append(f"{name}: no recording of {', '.join(lost)}.")
    return len(sources), faults


def _wrong_with(recording: Recording, base: Job, episode: Episode, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the faults of one recording: another episode, another course, or other metrics than ``rows`` say."""
    from h3data.metrics import measure
    from h3data_pipelines.jobs.evaluations import plan_of

    task = base.found_task
    if other := _other_facts(recording, task, episode):
        return [f"it is another episode than the benchmark's: {', '.join(other)}."]
    plans = {plan_of(task, episode, row["partner"]) for row in rows if row.get("partner") is not None}
    if len(plans) > 1:
        return [f"its partners play differently in this episode: {', '.join(sorted(plans))}."]
    found = verify_episode(recording, task, episode, *plans)
    if found.difference is not None:
        return [f"simulated again, it takes another course: {found.difference}."]
    values = {name: None if value != value else value for name, value in measure(recording).values.items()}
    faults = []
    for row in rows:
        if wrong := [name for name, value in row["values"].items() if name not in values or values[name] != value]:
            first = wrong[0]
            faults.append(f"{first}: measured again {values.get(first)}, its results say {row['values'][first]}.")
    return faults


def verify_episode(recording: Recording, task: Task, episode: Episode, people: Any = None) -> Verification:
    """Play an episode with the robots' recorded decisions, and compare the outcome with the recording as `verify` does.

    Nothing else of the recording is used, so a recording of another episode differs, and so does one in which people did not
    decide as their policy does. The names of bodies and the results that the task adds at the end (`EpisodeCodec.final_info`)
    are compared too.

    Args:
        recording: The recording to check.
        task: The task.
        episode: The episode that it should be.
        people: Policy of people, a name or an object (default: the task's own).

    Raises:
        H3DataError: The robots' decisions are not in the recording.
    """
    from h3data.recording.assets.scenes import scene_records
    from sim_kinematic.policies.assignment import AssignedPolicy, assign
    from sim_kinematic.tasks.resimulation import Difference, compared
    from sim_kinematic.tasks.resume import Played, repeat_crowd

    steps, named = len(recording), task.codec.policy_names(recording)
    if [agent.kind for agent in recording.agents] != [member.kind for member in episode.roster]:
        raise InputError(
            f"Expected a recording of {', '.join(member.kind for member in episode.roster)}, got "
            f"{', '.join(agent.kind for agent in recording.agents)}.",
            code="H3-TASK-072",
        )
    assigned = assign(task, episode, {} if people is None else {"human": people})
    own = [
        # robots repeat recorded decisions, so their policies need not be at hand
        repeat_crowd(mine, recording, agent.name) if mine.kind == "human" else AssignedPolicy(None, name, mine.kind)
        for mine, name, agent in zip(assigned, named, recording.agents, strict=True)
    ]
    repeated = task.control.recorded_policies(recording, episode, own, until=steps)
    policies = [mine if mine.kind == "human" else again for mine, again in zip(own, repeated, strict=True)]
    played = Played(task, episode, policies, recording, steps=steps, keeps_people=False, since=steps)
    found = compared(recording, played.columns, played.ended)
    if not found.equal:
        return found
    # with what people bring along, which no description of the episode has
    bodies = [body.name for body in (*scene_records(episode.scene)[1], *played.play.things)]
    if (recorded_bodies := [body.name for body in recording.bodies]) != bodies:
        wrong = Difference(step=steps, column="bodies", recorded=repr(recorded_bodies), simulated=repr(bodies))
        return replace(found, difference=wrong)
    # through JSON, as the recorded info has been: tuples are lists there
    results = json.loads(msgspec.json.encode(task.codec.final_info(episode, played.play, own)))
    for name, value in results.items():
        if (recorded := recording.episode.info.get(name)) != value:
            wrong = Difference(step=steps, column=f"info.{name}", recorded=repr(recorded), simulated=repr(value))
            return replace(found, difference=wrong)
    return found


def _other_facts(recording: Recording, task: Task, episode: Episode) -> list[str]:
    """Return the facts of an episode that a recording states wrongly, whoever plays."""
    from sim_kinematic.policies.assignment import AssignedPolicy
    from sim_kinematic.tasks.codec import POLICY_ENTRIES
    from sim_kinematic.tasks.recorder import describe

    policies = [AssignedPolicy(None, "", member.kind) for member in episode.roster]
    header = describe(task, episode, policies)
    info = json.loads(msgspec.json.encode(header.episode.info))
    # at its end a recording lists all goals that the person could reach in its time, which under other rules than those of the
    # episode's file are more or fewer than the file has: `verify_episode` compares them with those of the simulation
    who = {*POLICY_ENTRIES, "human_goals"}
    other = [name for name, value in info.items() if name not in who and recording.episode.info.get(name) != value]
    other += [] if recording.episode.seed == header.episode.seed else ["seed"]
    other += [] if recording.agents == header.agents else ["agents"]
    files = [name for name, file in header.attachments.items() if recording.attachments.get(name) != file]
    return other + files


def _lost(part: _Part, fault: Exception) -> tuple[int, list[str]]:
    return 0, [f"{RECORDINGS}/{part.index:06d}: {fault}"]
