"""Recordings of social navigation simulated again: under the recorded commands, from any step on under a
policy, or beside a person on her recorded track.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import H3DataError, InputError
from h3data.geometry import heading_from_quat
from h3data.habitat.episodes.social_nav_episodes import SocialNavEpisode
from h3data.recording import Event, Recording, state_hash
from sim_kinematic.motion.spec import BaseSpec
from sim_kinematic.motion.state import HumanState
from sim_kinematic.policies.social_nav import ROBOT_SKILLS, Command, Policy, View, policy_by_name, policy_name
from sim_kinematic.tasks.resimulation import (
    MAX_STEPS,
    Verification,
    compared,
    header_from,
    is_counterfactual,
    origin,
    require,
    require_kept,
    require_step,
    scene_and_map,
)
from sim_kinematic.tasks.social_nav import HUMAN, ROBOT, Posture, SocialNavWorld, hindsight, play
from sim_kinematic.tasks.social_nav_episodes import rules_of, world_of
from sim_kinematic.tasks.social_nav_log import EpisodeLog, finished


# --- from a recording to its world ------------------------------------------------------------------------------------
def recorded_world(recording: Recording) -> SocialNavWorld:
    """The world in which a recording of social navigation was simulated: its own scene, rules, starts and seed.

    Raises:
        InputError: it is no such recording, or lacks something; the message names it.
        SceneError: its starts or goals are not on the free floor of its scene.
    """
    episode, agents = recording.episode, recording.agents
    require(
        recording, info=("spec", "robot_start", "human_start"), columns=("agent_0.action", "agent_0.skill")
    )  # fmt: skip
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
    scene, free = scene_and_map(recording.attachments["scene.glb"], rules.agent_radius_m, rules.agent_height_m)
    return world_of(stored, scene, spec=rules, free=free)


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
    simulated, ended, _ = _simulate(recording, world, act, keeps_human=is_counterfactual(recording), steps=steps)
    return compared(recording, simulated, ended)


# --- continue ---------------------------------------------------------------------------------------------------------
def resume(recording: Recording, step: int, *, policy: str | Policy | None = None) -> Recording:
    """The episode anew: its first ``step`` steps as they are, then simulated on, by default under its own policy.

    Raises:
        InputError: there is no such step, or the recorded states before it do not come out again.
    """
    if is_counterfactual(recording):
        return counterfactual(recording, policy, step=step)
    name, then = _policy(recording, policy)
    world, columns, ended, events = _continued(recording, step, then, keeps_human=False)
    info = {"policy": name, "ended": ended, **hindsight(world), "resumed_from": origin(recording, step)}
    return finished(header_from(recording, f"resume:{step}:{name}"), columns, info, events)


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
        "policy": name, "ended": ended, "counterfactual": origin(recording, step), "human_reactive": False,
    }  # fmt: skip
    return finished(header_from(recording, f"counterfactual:{step}:{name}"), columns, info, events)


def _continued(
    recording: Recording, step: int, then: Policy, *, keeps_human: bool
) -> tuple[SocialNavWorld, dict[str, NDArray[Any]], str, list[Event]]:
    """World, columns, end and events of a recording that is simulated on from ``step``."""
    require_step(recording, step)
    world, act = recorded_world(recording), recorded_commands(recording, until=step, then=then)
    columns, ended, events = _simulate(recording, world, act, keeps_human=keeps_human)
    # beside a kept track, what was measured of the person may differ in its last bits
    names = [n for n in columns if n.startswith(f"agent_{ROBOT}.")] if keeps_human else None
    require_kept(recording, step, columns, ended, names)
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
        self._arms = recording.columns.get(f"agent_{HUMAN}.motion_arms", np.zeros((len(recording), 2), np.float32))
        if self._arms.shape != (len(recording), 2):
            raise InputError(f"Expected agent_{HUMAN}.motion_arms [T, 2], got shape {list(self._arms.shape)}.")
        if not all(np.isfinite(array).all() for array in (base, self._arms, *self._motion)):
            raise InputError("The person's track must be finite at every step.")
        clips = len(world.human.clips)
        if ((self._motion[0] < 0) | (self._motion[0] >= clips)).any():
            raise InputError(f"agent_{HUMAN}.motion_id must be in 0..{clips - 1}.")
        self._xz = base[:, [0, 2]].astype(np.float64)
        self._heading = np.unwrap(heading_from_quat(base[:, 3:].astype(np.float64)))

    def track(self) -> NDArray[np.float64]:
        """As `sim_kinematic.tasks.social_nav.Foreseen.track`."""
        return self._xz

    def advance(self, state: HumanState, step: int) -> Posture:
        """As `sim_kinematic.tasks.social_nav.Human.advance`."""
        state.distance[0] += float(np.hypot(*(self._xz[step] - state.xz[0])))
        state.xz[0], state.heading[0] = self._xz[step], self._heading[step]
        clip, phase, blend = (array[step] for array in self._motion)
        state.arms[0] = self._arms[step]
        left, right = self._arms[step].tolist()
        return Posture(int(clip), float(phase), float(blend), (left, right))


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
