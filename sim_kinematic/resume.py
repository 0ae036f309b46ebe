"""Recordings of social navigation simulated again: compared step by step, continued from any step, or with another robot
beside the same person.

A recording holds its scene, its rules, its starts, its seed and every command that acted, so the simulator's state after
any step follows from it: no hidden numbers are stored. "Resume from step K" plays the K recorded commands, and is refused
if that does not give the recorded states bit for bit.
"""

from __future__ import annotations

import importlib.metadata
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import H3DataError, InputError
from h3data.geometry import heading_from_quat
from h3data.interop.social_nav_episodes import SocialNavEpisode
from h3data.recording import SCHEMA_VERSION, Event, Recording, RecordingHeader, state_hash
from h3data.scene import FreeSpace, Scene, load_scene
from sim_kinematic.policies import ROBOT_SKILLS, Command, Policy, View, policy_by_name, policy_name
from sim_kinematic.social_nav import HUMAN, ROBOT, Posture, SocialNavWorld, hindsight, play
from sim_kinematic.social_nav_episodes import rules_of, world_of
from sim_kinematic.social_nav_log import EpisodeLog, finished
from sim_kinematic.spec import BaseSpec
from sim_kinematic.state import HumanState

MAX_STEPS = 1_000_000
"""Longer episodes are not simulated again: nine hours."""
_OF_THE_RUN = ("job", "recovered", "resumed_from", "counterfactual", "human_reactive")
"""What ``info`` says about how a recording came to be; it does not hold for one made from it."""

Columns = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, kw_only=True)
class Difference:
    """The first place where a recording and its simulation part."""

    step: int
    column: str
    recorded: str
    simulated: str

    def __str__(self) -> str:
        return f"step {self.step}, {self.column}: recorded {self.recorded}, simulated {self.simulated}"


@dataclass(frozen=True, kw_only=True)
class Verification:
    """What `verify` found."""

    steps: int
    """Steps that agree: all, or those before the first difference."""
    difference: Difference | None

    @property
    def equal(self) -> bool:
        """Whether every stored value came out again, bit for bit."""
        return self.difference is None


# --- from a recording to its world ------------------------------------------------------------------------------------
def recorded_world(recording: Recording) -> SocialNavWorld:
    """The world in which a recording of social navigation was simulated: its own scene, rules, starts and seed.

    Raises:
        InputError: it is no such recording, or lacks something; the message names it.
        SceneError: its starts or goals are not on the free floor of its scene.
    """
    episode, agents = recording.episode, recording.agents
    if episode.task != "social_nav":
        raise InputError(
            f"Only recordings of social_nav can be simulated again, this one is of the task {episode.task!r}. "
            "Hint: h3data validate checks any recording."
        )
    lacks = [n for n in ("spec", "robot_start", "human_start") if n not in episode.info]
    lacks += ["scene.glb"] if "scene.glb" not in recording.attachments else []
    lacks += [n for n in ("agent_0.action", "agent_0.skill") if n not in recording.columns]
    if lacks:
        raise InputError(f"The recording cannot be simulated again, it lacks: {', '.join(lacks)}.")
    if [a.kind for a in agents] != ["robot", "human"]:
        raise InputError(f"Expected a robot and a human, in this order, got: {[a.kind for a in agents]}.")
    spec = episode.info["spec"]
    try:
        stored = msgspec.convert(
            {
                "robot_start": episode.info["robot_start"],
                "human_start": episode.info["human_start"],
                "human_goals": episode.info.get("human_goals", ()),
                "seed": episode.seed,
                "max_steps": spec["max_steps"],
                "robot": agents[ROBOT].model,
                "human": agents[HUMAN].model,
                "rules": spec,
            },
            SocialNavEpisode,
        )
    except (msgspec.ValidationError, KeyError, TypeError) as fault:
        raise InputError(f"The recording's info is malformed: {str(fault).replace('`', '')}") from None
    if not np.isfinite([*stored.robot_start, *stored.human_start, *np.ravel(stored.human_goals)]).all():
        raise InputError("The recording's starts and goals must be finite numbers.")
    rules = rules_of(stored)
    if rules.max_steps > MAX_STEPS:
        raise InputError(f"Expected at most {MAX_STEPS} steps, the recording's rules say {rules.max_steps}.")
    scene, free = _scene_and_map(recording.attachments["scene.glb"], rules.agent_radius_m, rules.agent_height_m)
    return world_of(stored, scene, spec=rules, free=free)


@lru_cache(maxsize=4)
def _scene_and_map(file: bytes, radius_m: float, height_m: float) -> tuple[Scene, FreeSpace]:
    """The same for all recordings in one home."""
    scene = load_scene(file)
    return scene, FreeSpace.from_scene(scene, radius_m=radius_m, height_m=height_m)


def recorded_commands(recording: Recording, *, until: int | None = None, then: Policy | None = None) -> Policy:
    """The policy that gives the recorded commands of the first ``until`` steps (default: all), and after them ``then``.

    Raises:
        InputError: commands or skills are not of the kind that the simulator knows.
    """
    actions, codes = recording.columns["agent_0.action"], recording.columns["agent_0.skill"]
    names = recording.agents[ROBOT].skill_names
    until = len(recording) if until is None else until
    if actions.shape != (len(recording), 2) or not np.isfinite(actions).all():
        raise InputError(f"Expected agent_0.action [T, 2] of finite numbers, got shape {list(actions.shape)}.")
    strange = sorted({int(c) for c in codes if not 0 <= c < len(names) or names[c] not in ROBOT_SKILLS})
    if strange:
        raise InputError(f"Unknown skill codes {strange[:5]} in agent_0.skill. Expected: {', '.join(ROBOT_SKILLS)}.")

    def act(view: View, spec: BaseSpec) -> Command:
        if view.step < until:
            forward, turn = map(float, actions[view.step])
            return Command(forward, turn, names[codes[view.step]])
        assert then is not None
        return then(view, spec)

    return act


# --- compare ----------------------------------------------------------------------------------------------------------
def verify(recording: Recording) -> Verification:
    """Simulate the recorded commands and compare every stored column, and the hash of the state, step by step.

    Bit for bit on one architecture; elsewhere the last bits of sines and square roots may differ.

    Raises:
        H3DataError: it cannot be simulated again (`recorded_world`, `recorded_commands`).
    """
    steps = len(recording)
    world, act = recorded_world(recording), recorded_commands(recording)
    if not steps:
        return Verification(steps=0, difference=None)
    simulated, ended, _ = _simulate(recording, world, act, keeps_human=_is_counterfactual(recording), steps=steps)
    found = first_difference(recording.columns, simulated)
    done = len(simulated["time_ns"])
    if found is None and done < steps:
        found = Difference(step=done, column="time_ns", recorded="goes on", simulated=f"ended by {ended}")
    return Verification(steps=steps if found is None else found.step, difference=found)


def first_difference(recorded: Columns, simulated: Columns, names: Iterable[str] | None = None) -> Difference | None:
    """The first step at which columns differ in any bit, in the rows that both have; None if there is none.

    ``names`` are by default all simulated columns; one that the recording lacks differs from step 0 on. Columns that the
    simulator does not make are checked by the hash alone.
    """
    rows = min(len(recorded["time_ns"]), len(simulated["time_ns"]))
    first: Difference | None = None
    for name in simulated if names is None else names:
        ours = simulated[name][:rows]
        if name not in recorded:
            return Difference(step=0, column=name, recorded="no such column", simulated=_text(ours[:1]))
        theirs = np.asarray(recorded[name])[:rows]
        if name == "state_hash":
            ours = state_hash({n: np.asarray(a)[:rows] for n, a in recorded.items()})
        if theirs.dtype != ours.dtype or theirs.shape != ours.shape:
            kinds = (f"{a.dtype} {list(a.shape[1:])}" for a in (theirs, ours))
            return Difference(step=0, column=name, recorded=next(kinds), simulated=next(kinds))
        differ = np.flatnonzero(_bits(theirs) != _bits(ours)) if theirs.size else np.zeros(0, int)
        step = int(differ[0]) // (theirs.size // rows) if len(differ) else rows
        if step < (rows if first is None else first.step):
            first = Difference(step=step, column=name, recorded=_text(theirs[step]), simulated=_text(ours[step]))
    return first


def _bits(array: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(array).view(f"u{array.dtype.itemsize}").ravel()


def _text(values: NDArray[Any]) -> str:
    return np.array2string(np.asarray(values), max_line_width=10_000, threshold=12, floatmode="unique")


# --- continue ---------------------------------------------------------------------------------------------------------
def resume(recording: Recording, step: int, *, policy: str | Policy | None = None) -> Recording:
    """The episode anew: its first ``step`` steps as they are, then simulated on, by default under its own policy.

    Raises:
        InputError: there is no such step, or the recorded states before it do not come out again.
    """
    if _is_counterfactual(recording):
        return counterfactual(recording, policy, step=step)
    name, then = _policy(recording, policy)
    world, columns, ended, events = _continued(recording, step, then, keeps_human=False)
    info = {"policy": name, "ended": ended, **hindsight(world), "resumed_from": _origin(recording, step)}
    return finished(_header(recording, f"resume:{step}:{name}"), columns, info, events)


def counterfactual(recording: Recording, policy: str | Policy | None, *, step: int = 0) -> Recording:
    """The same person on her recorded track beside a robot that follows ``policy`` from ``step`` on.

    She does not react: ``info["human_reactive"]`` is False. It ends with her track, or as the rules say.

    Raises:
        InputError: as `resume`; or the person was not recorded as clips.
    """
    name, then = _policy(recording, policy)
    world, columns, ended, events = _continued(recording, step, then, keeps_human=True)
    if ended == "max_steps" and len(columns["time_ns"]) < world.spec.max_steps:
        ended = "track_end"
    info = {
        "policy": name, "ended": ended, "counterfactual": _origin(recording, step), "human_reactive": False,
    }  # fmt: skip
    return finished(_header(recording, f"counterfactual:{step}:{name}"), columns, info, events)


def _continued(
    recording: Recording, step: int, then: Policy, *, keeps_human: bool
) -> tuple[SocialNavWorld, dict[str, NDArray[Any]], str, list[Event]]:
    """World, columns, end and events of a recording that is simulated on from ``step``."""
    if not 0 <= step <= len(recording):
        raise InputError(f"Expected a step from 0 to {len(recording)}, the number of recorded steps, got {step}.")
    world, act = recorded_world(recording), recorded_commands(recording, until=step, then=then)
    columns, ended, events = _simulate(recording, world, act, keeps_human=keeps_human)
    done = len(columns["time_ns"])
    if done < step:
        raise InputError(f"The steps before {step} do not come out again: simulated, it ended at {done} ({ended}).")
    kept = {name: array[:step] for name, array in recording.columns.items()}
    # beside a kept track, what was measured of the person may differ in its last bits
    names = [n for n in columns if n.startswith(f"agent_{ROBOT}.")] if keeps_human else None
    found = first_difference(kept, columns, names)
    if found is not None:
        raise InputError(f"The recorded steps do not come out again, so nothing can follow them: {found}.")
    return world, columns, ended, events


def _simulate(
    recording: Recording, world: SocialNavWorld, act: Policy, *, keeps_human: bool, steps: int | None = None
) -> tuple[dict[str, NDArray[Any]], str, list[Event]]:
    """Columns, end and events of the recording's world under ``act``, with her script or her recorded track."""
    log = EpisodeLog(world, world.human.clip_for_speed(world.spec.human.speed_mps), None)
    if not keeps_human:
        ended = play(world, act, log, steps=steps)
        return log.columns(), ended, log.events
    ended = play(world, act, log, human=RecordedHuman(recording, world), steps=len(recording))
    made = log.columns()
    rows = len(made["time_ns"])
    hers = (f"agent_{HUMAN}.", "sim.human_")
    columns = {
        n: recording.columns[n][:rows] if n.startswith(hers) and n in recording.columns else a for n, a in made.items()
    }
    columns["state_hash"] = state_hash(columns)
    events = [e for e in recording.events if e.agent == HUMAN and e.step < rows] + log.events
    return columns, ended, sorted(events, key=lambda event: event.step)


class RecordedHuman:
    """A person who walks her recorded track, whatever the robot does."""

    goal, leg = -1, 0

    def __init__(self, recording: Recording, world: SocialNavWorld) -> None:
        if not len(recording):
            raise InputError("The recording has no steps, so there is no track of a person to keep.")
        names = [f"agent_{HUMAN}.{n}" for n in ("base_pose", "motion_id", "motion_phase", "motion_blend")]
        lacks = [n for n in names if n not in recording.columns]
        if lacks:
            raise InputError(f"The person's body must be recorded as clips; the recording lacks: {', '.join(lacks)}.")
        base, *self._motion = (recording.columns[n] for n in names)
        if not all(np.isfinite(array).all() for array in (base, *self._motion)):
            raise InputError("The person's track must be finite at every step.")
        clips = len(world.human.clips)
        if ((self._motion[0] < 0) | (self._motion[0] >= clips)).any():
            raise InputError(f"agent_{HUMAN}.motion_id must be in 0..{clips - 1}.")
        self._xz = base[:, [0, 2]].astype(np.float64)
        self._heading = np.unwrap(heading_from_quat(base[:, 3:].astype(np.float64)))

    def track(self) -> NDArray[np.float64]:
        """As `sim_kinematic.social_nav.Foreseen.track`."""
        return self._xz

    def advance(self, state: HumanState, step: int) -> Posture:
        """As `sim_kinematic.social_nav.Human.advance`."""
        state.distance[0] += float(np.hypot(*(self._xz[step] - state.xz[0])))
        state.xz[0], state.heading[0] = self._xz[step], self._heading[step]
        clip, phase, blend = (array[step] for array in self._motion)
        return Posture(int(clip), float(phase), float(blend))


# --- inside -----------------------------------------------------------------------------------------------------------
def _is_counterfactual(recording: Recording) -> bool:
    return recording.episode.info.get("human_reactive") is False


def _origin(recording: Recording, step: int) -> dict[str, Any]:
    """What a recording made from this one says about it."""
    return {"uid": recording.episode.uid, "step": step, "policy": recording.episode.info.get("policy")}


def _policy(recording: Recording, policy: str | Policy | None) -> tuple[str, Policy]:
    """Name and function of the policy; the recording's own if None."""
    if callable(policy):
        return policy_name(policy), policy
    name = str(recording.episode.info.get("policy")) if policy is None else policy
    try:
        return policy_name(name), policy_by_name(name)
    except H3DataError as fault:
        if policy is not None:
            raise
        raise InputError(f"The recording's own policy is not at hand; name one with --policy. {fault}") from None


def _header(recording: Recording, what: str) -> RecordingHeader:
    """The same bodies, agents and files under an episode of its own."""
    old = recording.episode
    episode = replace(
        old, uid=str(uuid.uuid5(uuid.NAMESPACE_URL, f"{old.uid}:{what}")), schema_version=SCHEMA_VERSION,
        created_by=f"h3data {importlib.metadata.version('h3data')}",
        info={k: v for k, v in old.info.items() if k not in _OF_THE_RUN},
    )  # fmt: skip
    return RecordingHeader(
        episode=episode, assets=recording.assets, bodies=recording.bodies, agents=recording.agents,
        attachments=recording.attachments,
    )  # fmt: skip
