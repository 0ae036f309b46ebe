"""Simulation of recordings, to compare them step by step, or to continue them from any step or with other robots.

A recording holds its scene, rules, starts, seed and every decision. The simulator's state after any step follows from
these, so no hidden numbers are stored. Resuming from step K plays the K recorded steps, and fails if this does not
reproduce the recorded states bit for bit.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from h3data.errors import H3DataError, InputError, UntrustedNameError
from h3data.plugins import names_from_data
from h3data.recording import Event, InputEvent, Recording, SkillSpan, state_hash
from h3data.recording.records import JOINTS, agent_numbers
from h3data.replay.recorded_robots import check_recorded_robots
from sim_kinematic.policies.assignment import ENTRIES, KINDS, AssignedPolicy, each_of, make_policy
from sim_kinematic.policies.recorded import NotRecorded
from sim_kinematic.tasks.codec import POLICY_ENTRIES
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.tasks.play import Columns, WorldRollout
from sim_kinematic.tasks.recorder import RecordedSensors, Recorder, finished, run
from sim_kinematic.tasks.registry import find_task, task_registry
from sim_kinematic.tasks.resimulation import (
    Verification,
    compared,
    header_from,
    is_counterfactual,
    origin,
    require,
    require_recorded,
    require_step,
    scene_and_map,
)
from sim_kinematic.tasks.task import Task


def task_of(recording: Recording) -> Task:
    """Return the task of a recording.

    Raises:
        InputError: The task is not installed, or the recording is not of a simulated task.
    """
    name = str(recording.episode.info.get("task") or recording.episode.task)
    try:
        with names_from_data():
            return find_task(name)
    # also an InputError, but its cause is trust and not a task that is missing
    except UntrustedNameError:
        raise
    except InputError as fault:
        known = ", ".join(task_registry().names())
        raise InputError(
            f"Only recordings of {known} and of installed tasks can be simulated again, this one is of the task {name!r}: "
            f"{fault} Hint: h3data validate checks any recording.",
            code="H3-TASK-038",
        ) from None


def verify(recording: Recording) -> Verification:
    """Simulate a recording again and compare every stored column and the hash of the state step by step.

    Policies whose decisions are recorded are neither created nor called. Values are equal bit for bit on one
    architecture; elsewhere the last bits of sines and square roots may differ.

    Raises:
        H3DataError: The recording cannot be simulated again, because its task is not installed or data is missing.
    """
    task, episode = restored_episode(recording)
    steps = len(recording)
    if not steps:
        return Verification(steps=0, difference=None)
    own = assigned_policies(
        task,
        episode,
        recording,
        {},
        strict=False,
        recorded=task.control.decided(recording, task.codec.policy_names(recording)),
    )
    policies = task.control.recorded_policies(recording, episode, own, until=steps)
    played = Played(
        task, episode, policies, recording, steps=steps, keeps_people=is_counterfactual(recording), since=steps
    )
    return compared(recording, played.columns, played.ended)


def resume(
    recording: Recording, step: int, *, policy: Any = None, partner: Any = None, agents: dict[str, Any] | None = None
) -> Recording:
    """Return a recording whose first ``step`` steps are unchanged and whose further steps are simulated again.

    From then on, ``policy`` moves the robots and ``partner`` the people, by default with the recorded policies;
    ``agents`` selects policies by agent or kind.

    Raises:
        InputError: There is no such step or policy, or the recorded states before it are not reproduced.
    """
    chosen = {
        **{kind: choice for kind, choice in (("robot", policy), ("human", partner)) if choice is not None},
        **(agents or {}),
    }
    if is_counterfactual(recording):
        if any(KINDS.get(key, "human") == "human" for key in chosen):
            raise InputError(
                "People of a counterfactual recording keep their tracks. Hint: leave out the partner.",
                code="H3-TASK-039",
            )
        return _continued(recording, step, chosen, keeps_people=True)
    return _continued(recording, step, chosen, keeps_people=False)


def counterfactual(recording: Recording, policy: Any, *, step: int = 0) -> Recording:
    """Simulate people on their recorded tracks with robots that follow ``policy`` from ``step`` on.

    People do not react, so ``info["human_reactive"]`` is False. The episode ends with their tracks, or by its rules.

    Raises:
        InputError: The recording cannot be resumed, has no robot or no person, or lacks a person's body.
    """
    if {agent.kind for agent in recording.agents} != {"robot", "human"}:
        raise InputError(
            "Expected a recording of robots and people: people keep their tracks, robots follow the policy.",
            code="H3-TASK-036",
        )
    return _continued(recording, step, {} if policy is None else {"robot": policy}, keeps_people=True)


# --- one continued run ------------------------------------------------------------------------------------------------
def _continued(recording: Recording, step: int, chosen: dict[str, Any], *, keeps_people: bool) -> Recording:
    require_step(recording, step)
    task, episode = restored_episode(recording)
    codec = task.codec
    codec.check_changes(recording, chosen)
    # who plays does not change these facts, so the recorded ones save computing them again
    codec.load_precomputed(episode, recording.episode.info)
    assigned = assigned_policies(task, episode, recording, chosen, strict=True, keeps_people=keeps_people)
    named = codec.policy_names(recording)
    changed = [one.name != name for one, name in zip(assigned, named, strict=True)]
    if not keeps_people and any(
        new and f"agent_{k}.motion_hands" in recording.columns for k, new in enumerate(changed)
    ):
        raise InputError(
            "People who do chores brought the things along that they carry, so no other policy can take over from theirs. "
            "Hint: change the robot's policy alone.",
            code="H3-TASK-090",
        )
    policies = task.control.recorded_policies(recording, episode, assigned, until=step, changed=changed)
    played = Played(
        task,
        episode,
        policies,
        recording,
        steps=len(recording) if keeps_people else None,
        keeps_people=keeps_people,
        since=step,
    )
    robots = [
        n for n in played.columns if any(n.startswith(f"agent_{k}.") for k in agent_numbers(recording.agents, "robot"))
    ]
    # people keep their recorded tracks, which are rounded, so measurements of them may differ in the last bits
    require_recorded(
        recording, step, played.columns, played.ended, robots if keeps_people and not task.control.has_skills else None
    )
    came = origin(recording, step)
    told = codec.info(episode, assigned)
    info = {name: told[name] for name in POLICY_ENTRIES if name in told}
    names = [told[name] for name in ("policy", "partner") if name in told]
    info["deciding_since"] = [getattr(one.policy, "since", 0) for one in policies]
    if keeps_people:
        info |= {"ended": played.ended, **codec.precompute(episode)}
        info |= {"counterfactual": {**came, **played.track}, "human_reactive": False}
    else:
        info |= {**codec.final_info(episode, played.play, assigned), **codec.precompute(episode)}
        info |= {"resumed_from": came}
    what = "counterfactual" if keeps_people else "resume"
    # the uid comes from it: the same change to the same recording gives the same one
    header = header_from(recording, ":".join([what, str(step), *names]))
    return finished(header, played.columns, info, played.skills, played.events, played.inputs)


@dataclass(init=False)
class Played:
    """A recording's episode played by policies, with people on their recorded tracks if they keep them."""

    def __init__(
        self,
        task: Task,
        episode: Episode,
        policies: Sequence[AssignedPolicy],
        recording: Recording,
        *,
        steps: int | None,
        keeps_people: bool,
        since: int = 0,
    ) -> None:
        self.play: WorldRollout = WorldRollout.of(task, episode, policies, measure=False)
        self.track: dict[str, Any] = {}
        sensors = RecordedSensors.again(task, episode.roster, recording)
        recorder = Recorder(header_from(recording, "again"), self.play, sensors=sensors)
        most = episode.spec.max_steps if steps is None else min(steps, episode.spec.max_steps)
        keep = None
        if keeps_people:
            self.track, keep = task.control.keep_people(self.play, recording, since)
        unrecorded = ""
        try:
            if most:
                run(self.play, recorder, steps=most, progress=keep)
        # no error: the run took another course, and the comparison tells where it ended
        except NotRecorded as fault:
            unrecorded = str(fault)
        self.ended = unrecorded or self.play.ended
        recording_made = recorder.finish({}) if len(recorder) else None
        self.columns: Columns = recorder.columns() if recording_made else {"time_ns": np.zeros(0, np.int64)}
        self.skills: tuple[SkillSpan, ...] = tuple(recorder.skills)
        self.events: tuple[Event, ...] = tuple(recorder.events)
        rows = len(self.columns["time_ns"])
        # raw input before the change is that of the same steps, and replays need it
        self.inputs: tuple[InputEvent, ...] = tuple(
            event for event in recording.inputs if event.time_ns < since * recording.episode.dt_ns
        )
        if keeps_people:
            # `ended` begins as max_steps, so here the track was over before the time
            if self.ended == "max_steps" and rows < episode.spec.max_steps:
                self.ended = "track_end"
            self._keep(task, recording, rows)

    def _keep(self, task: Task, recording: Recording, rows: int) -> None:
        """Store the columns, skills and events of recorded people, as far as the task selects them."""
        people = agent_numbers(recording.agents, "human")
        # in social_nav ``sim.`` are the goal and the leg of the person's script
        prefixes = ("sim.", *(f"agent_{k}." for k in people))
        kept = {
            name: recording.columns[name][:rows]
            for name in recording.columns
            # what people hold is simulated again
            if (name in self.columns and name.startswith(prefixes) and not name.endswith("grasp_body"))
            # who keeps a track handles the same things, which the simulation leaves alone
            or name.endswith(".motion_hands")
            or (name in (JOINTS, "object_pose") and not task.control.has_skills)
        }
        self.columns |= kept
        # over the kept columns, which are part of the new recording
        self.columns["state_hash"] = state_hash({n: a for n, a in self.columns.items() if n != "state_hash"})
        cut_short: dict[str, Any] = {} if not task.control.has_skills else {"outcome": "running", "reason": ""}
        cut = [
            span if span.end_step < rows else replace(span, end_step=rows - 1, **cut_short)
            for span in recording.skills
            if span.agent in people and span.start_step < rows
        ]
        self.skills = (*(span for span in self.skills if span.agent not in people), *cut)
        if task.control.has_skills:  # skills that have a result are recorded when they end
            self.skills = tuple(sorted(self.skills, key=lambda span: span.end_step))
        else:
            theirs = [e for e in recording.events if e.agent in people and e.step < rows]
            self.events = tuple(sorted([*theirs, *self.events], key=lambda event: event.step))


def restored_episode(recording: Recording) -> tuple[Task, Episode]:
    """Return the task of a recording, and its episode with scene, free floor and starts."""
    if recording.episode.is_lerobot_export:
        raise InputError(
            "Demonstrations exported to LeRobot cannot be simulated again, or verified: they lack the last row of each episode "
            "and the simulator's own columns. Hint: use the dataset that they were exported from.",
            code="H3-TASK-037",
        )
    task = task_of(recording)
    require(recording, columns=task.control.needed_columns(recording))
    # before it is restored, as another file of its robot may give other states
    check_recorded_robots(recording)
    file = recording.attachments["scene.glb"]
    with names_from_data():
        return task, task.codec.restore(recording, lambda radius, height: scene_and_map(file, radius, height))


def assigned_policies(
    task: Task,
    episode: Episode,
    recording: Recording,
    new: dict[str, Any],
    *,
    strict: bool,
    keeps_people: bool = False,
    recorded: Collection[int] = (),
) -> list[AssignedPolicy]:
    """Return the policy of each agent: the one that is chosen, else the recording's own; none for those in ``recorded``."""
    named = task.codec.policy_names(recording)
    result = []
    for k, member in enumerate(episode.roster):
        choice = _chosen_for(episode, k, new)
        if k in recorded:
            result.append(repeat_crowd(AssignedPolicy(None, named[k], member.kind), recording, member.name))
            continue
        try:
            if choice is None:
                with names_from_data():
                    result.append(repeat_crowd(_policy(task, episode, k, named[k]), recording, member.name))
            else:
                result.append(_policy(task, episode, k, choice))
        except H3DataError as fault:
            if choice is not None:
                raise
            # people on their tracks ask no policy, so theirs may be missing
            if strict and not (keeps_people and member.kind == "human"):
                entry = ENTRIES[member.kind]
                raise InputError(
                    f"The recording's own {entry} is not at hand; name one with {entry}=. {fault}", code="H3-TASK-040"
                ) from None
            result.append(AssignedPolicy(None, named[k], member.kind))
    return result


def repeat_crowd(assigned: AssignedPolicy, recording: Recording, name: str) -> AssignedPolicy:
    """Return the policy of a person, who decides by the version of the rules that the recording holds for them.

    Without one, it is the first version, or that of a policy whose recordings did not hold it from the first one on.
    """
    people = recording.episode.info.get("people")
    facts = people.get(name) if isinstance(people, dict) else None
    told = facts.get("version") if isinstance(facts, dict) else None
    version = told if isinstance(told, int) else getattr(assigned.policy, "unversioned", 1)
    if hasattr(assigned.policy, "repeat"):
        assigned.policy.repeat(version)
    return assigned._replace(version=version)


def _policy(task: Task, episode: Episode, number: int, choice: Any) -> AssignedPolicy:
    """Return the policy with a recorded name, or one that is chosen instead; for ``external`` one that does nothing."""
    if choice == "external":
        return AssignedPolicy(task.control.still(episode, number), "external", episode.roster[number].kind)
    return make_policy(task, episode, number, choice)


def _chosen_for(episode: Episode, number: int, new: dict[str, Any]) -> Any:
    """Return the choice for one agent: by its name, else by its kind, one for all or one for each."""
    member = episode.roster[number]
    for key in (member.name, member.name.replace("human", "person")):
        if key in new and key not in KINDS:
            return new[key]
    for key, kind in KINDS.items():
        if kind == member.kind and new.get(key) is not None:
            numbers = [k for k, other in enumerate(episode.roster) if other.kind == kind]
            return each_of(new[key], len(numbers), kind)[numbers.index(number)]
    return None
