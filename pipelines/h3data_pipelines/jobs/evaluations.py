"""Evaluation of policies with every partner in the same episodes of any task, with one job for each episode."""

from __future__ import annotations

import glob
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from h3data.errors import InputError, JobStopError
from h3data.recording.records import agent_numbers
from h3data_pipelines.jobs.episodes import Job
from h3data_pipelines.jobs.failed_episodes import reason_of

if TYPE_CHECKING:
    from h3data.recording import Recording
    from sim_kinematic.tasks.episode import Episode
    from sim_kinematic.tasks.task import Task

ALL = "all"


@dataclass(frozen=True)
class Evaluation:
    """Evaluation of one episode for all pairs of a policy and a partner."""

    base: Job
    policies: tuple[str, ...]
    partners: tuple[str, ...] = ()
    """Policies of the partners; empty if people follow the task's default."""
    keep: bool = False
    """True if the recordings of all pairs are returned with the result."""
    uid: str | None = None
    """Identity that the episode must have (`episode_uid`), if a benchmark fixes it."""

    def to_json(self) -> dict[str, Any]:
        """Return all values that determine the results, as JSON types."""
        fields = self.base.to_json()
        fields.pop("policy", None)
        fields.pop("partner", None)
        asked: dict[str, Any] = {"episode": fields, "policies": list(self.policies)}
        return {**asked, "partners": list(self.partners)} if self.partners else asked


def play_evaluation(job: Evaluation) -> tuple[dict[str, Any], list[Recording]]:
    """Play one episode with every pair of policies; return their metrics and the recordings to store.

    A pair, or an episode, that raises an error is listed as failed. Partners with the same plan share a recording,
    whose ``info["partners"]`` names them.

    Raises:
        JobStopError: the whole job cannot continue.
    """
    from h3data.metrics import measure
    from sim_kinematic.tasks.recorder import simulate

    rows: list[dict[str, Any]] = []
    failed: list[str] = []
    kept: list[Recording] = []
    try:
        task, episode = job.base.found_task, job.base.episode()
        if job.uid is not None:
            check_identity(task, episode, job.uid)
    except Exception as fault:
        return failed_evaluation(job, fault), []
    for policy in job.policies:
        played: dict[str, dict[str, Any]] = {}  # partners with one plan do the same
        recordings: dict[str, Recording] = {}
        partners: dict[str, list[str]] = {}
        for partner in job.partners or (None,):
            chosen = {"robot": policy, **({} if partner is None else {"human": partner})}
            try:
                plan = plan_of(task, episode, partner)
                if plan not in played:
                    recording = simulate(
                        task,
                        episode,
                        {**chosen, **({"human": plan} if plan else {})},
                        episode_id=str(job.base.index),
                    )
                    measured = measure(recording)
                    if job.keep:
                        recordings[plan] = recording
                    info = recording.episode.info
                    played[plan] = {
                        "policy": policy,
                        "values": {name: None if v != v else v for name, v in measured.values.items()},
                        "set_up": measured.protocol_deviations,
                        "ended": info.get("ended"),
                        "state_hash": str(recording.columns["state_hash"][-1]) if len(recording) else "",
                    }
                    if "card" in episode.extra:
                        played[plan]["card"] = episode.extra["card"]
                    if "solo_steps" in info:
                        played[plan] |= {"plan": plan, "solo_steps": info["solo_steps"]}
                partners.setdefault(plan, []).extend([] if partner is None else [partner])
                row = {"index": job.base.index, **played[plan]}
                rows.append(row if partner is None else {**row, "partner": partner})
            except JobStopError:
                raise
            except Exception as fault:
                pair = policy if partner is None else f"{policy} with {partner}"
                failed.append(f"{pair}: {reason_of(fault)}")
        kept += [_named(recording, policy, partners.get(plan, [])) for plan, recording in recordings.items()]
    return {"job": job.to_json(), "rows": rows, "failed": failed}, kept


def failed_evaluation(job: Evaluation, fault: Exception) -> dict[str, Any]:
    """Return the results of an episode in which nothing could be played."""
    return {"job": job.to_json(), "rows": [], "failed": [reason_of(fault)]}


def _named(recording: Recording, policy: str, partners: Sequence[str]) -> Recording:
    """Return the recording with the names under which the table lists it, but no address, which means nothing later."""
    from sim_kinematic.policies.assignment import is_address

    named = {} if is_address(policy) else {"policy": policy}
    info = {**recording.episode.info, **named, **({"partners": list(partners)} if partners else {})}
    return replace(recording, episode=replace(recording.episode, info=info))


def episode_uid(task: Task, episode: Episode) -> str:
    """Return the identity of an episode by scene, bodies, starts, goals, seed and rules, but not policies."""
    from sim_kinematic.policies.assignment import AssignedPolicy

    return task.codec.uid(episode, [AssignedPolicy(None, "", member.kind) for member in episode.roster])


def check_identity(task: Task, episode: Episode, uid: str) -> None:
    """Check that an episode is the one in a benchmark's list.

    Raises:
        InputError: the episode differs.
    """
    if episode_uid(task, episode) != uid:
        raise InputError(
            "This version of h3data makes another episode than that of the benchmark. Hint: run it with the version that the "
            "benchmark was made with, or run a newer version of the benchmark.",
            code="H3-JOB-052",
        )


def write_recordings(recordings: Sequence[Recording], folder: Path) -> None:
    """Write recordings as a dataset, which gets its name when it is complete; without recordings, write nothing."""
    from h3data.recording import DatasetWriter

    part = folder.with_name(f".{folder.name}.part")
    for old in (part, folder):
        shutil.rmtree(old, ignore_errors=True)
    if not recordings:
        return
    with DatasetWriter(part, like=recordings) as writer:
        for recording in recordings:
            writer.add(recording)
    part.rename(folder)


def plan_of(task: Any, episode: Any, partner: str | None) -> str:
    """Return the name of the plan that a partner follows in this episode, or of the partner if it follows no plan."""
    if partner is None:
        return ""
    from sim_kinematic.policies.assignment import make_policy

    people = agent_numbers(episode.roster, "human")
    assigned = make_policy(task, episode, people[0], partner) if len(people) == 1 else None
    return assigned.plan if assigned is not None and assigned.plan else partner


def files_of(policy: str) -> tuple[str, ...]:
    """Return the policies that match ``weights:PATTERN``, in the order of their paths, or any other name unchanged.

    A pattern has ``*``, ``?`` or ``[...]`` as in a shell, and ``**`` for any folders. A file whose name equals the
    pattern has priority.

    Raises:
        InputError: no file matches the pattern.
    """
    from sim_kinematic.policies.learned import PREFIX

    pattern = policy.removeprefix(PREFIX)
    if not policy.startswith(PREFIX) or not glob.has_magic(pattern) or Path(pattern).is_file():
        return (policy,)
    found = sorted(path for path in glob.glob(pattern, recursive=True) if Path(path).is_file())
    if not found:
        raise InputError(f"No file of weights fits this pattern: {policy}", code="H3-JOB-031")
    return tuple(PREFIX + path for path in found)


def chosen_names(asked: Sequence[str], there: Sequence[str]) -> tuple[str, ...]:
    """Return the names of policies that an option selects.

    ``all`` selects all policies, and ``weights:PATTERN`` all matching files. Learned policies are named with the digest
    of their weights.

    Raises:
        InputError: the option selects no policy, or no file matches the pattern.
    """
    from sim_kinematic.policies.learned import stamped

    names = dict.fromkeys(each for name in asked for each in (there if name == ALL else files_of(name)))
    if not names:
        raise InputError("Expected at least one policy and partner by name, or all; got none.", code="H3-JOB-050")
    return tuple(map(stamped, names))
