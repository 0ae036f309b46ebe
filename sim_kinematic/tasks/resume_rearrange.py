"""Recordings of rearrangement simulated again: every agent does the recorded skills, and from a step on what a policy says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import H3DataError, InputError
from h3data.recording import Event, Recording, SkillSpan, state_hash
from sim_kinematic.agents.roster import HUMAN_BODY, ROBOT_BODY, kinds_of, make_roster
from sim_kinematic.policies.rearrange import POPULATIONS, ZSC, HighLevelPolicy, Planner
from sim_kinematic.policies.recorded import RecordedPolicy, recorded_choices
from sim_kinematic.tasks.kept_track import KeptTrack, follow_track
from sim_kinematic.tasks.rearrange.episode import RearrangeSpec, RearrangeWorld, Target
from sim_kinematic.tasks.rearrange.log import SOLO, RearrangeLog, finished
from sim_kinematic.tasks.rearrange.play import RearrangePlay
from sim_kinematic.tasks.rearrange.simulate import Choice, Mind, minds_of, solo_steps_of
from sim_kinematic.tasks.resimulation import (
    MAX_STEPS,
    Columns,
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
from sim_kinematic.tasks.social_nav import Starts


# --- from a recording to its world ------------------------------------------------------------------------------------
class _Goal(msgspec.Struct):
    """As in ``info["goals"]``."""

    object: str
    start: list[float]
    position: list[float]
    source: str = msgspec.field(name="from")
    destination: str = msgspec.field(name="to")


def recorded_world(recording: Recording) -> RearrangeWorld:
    """The world in which a recording of rearrangement was simulated: its own scene, rules, starts, objects and goals.

    Raises:
        InputError: it is no such recording, or lacks something; the message names it.
    """
    info, agents = recording.episode.info, recording.agents
    names = [f"agent_{k}.{name}" for k in range(len(agents)) for name in ("skill", "skill_target")]
    require(recording, info=("spec", "goals"), columns=names)
    kinds = tuple(agent.kind for agent in agents)
    own = {"robot": "robot_start", "human": "human_start"}
    try:
        rules = dict(msgspec.convert(info["spec"], dict[str, Any]))
        rules["arm_rad_s"] = np.inf if rules.get("arm_rad_s", 0.0) is None else rules.get("arm_rad_s", 8.0)
        rules.setdefault("human", {})  # as in the paper
        spec = msgspec.convert(rules, RearrangeSpec)
        goals = msgspec.convert(info["goals"], list[_Goal])
        starts = info["starts"] if "starts" in info else [info[own[kind]] for kind in kinds]
        places = np.array(msgspec.convert(starts, list[tuple[float, float, float]]), np.float64)
    except (msgspec.ValidationError, KeyError) as fault:
        raise InputError(f"The recording's info is malformed: {str(fault).replace('`', '')}") from None
    cast = make_roster([f"{agent.kind}:{agent.model.partition('/')[2]}" for agent in agents])
    if kinds_of(cast) != kinds:
        raise InputError(f"Expected robots, then people, got: {list(kinds)}.")
    if spec.max_steps > MAX_STEPS or len(goals) != spec.objects:
        raise InputError(
            f"Expected at most {MAX_STEPS} steps and a goal for each of {spec.objects} objects, got {spec.max_steps} steps "
            f"and {len(goals)} goals."
        )
    scene, free = scene_and_map(recording.attachments["scene.glb"], spec.agent_radius_m, spec.agent_height_m)
    things = {instance.name for instance in scene.instances}
    numbers = [[*goal.start, *goal.position] for goal in goals]
    if not all(len(n) == 10 and np.isfinite(n).all() for n in numbers) or not {g.object for g in goals} <= things:
        raise InputError(
            "Expected goals of things in the scene, with a pose7 start and a position [3] of finite numbers."
        )
    if places.shape != (len(cast), 3) or not np.isfinite(places).all() or not free.is_navigable(places[:, :2]).all():
        raise InputError(f"Expected starts on the free floor for {len(cast)} agents, got: {places.tolist()}.")
    first = {kind: places[kinds.index(kind)] if kind in kinds else np.full(3, np.nan) for kind in own}
    models = {kind: cast[kinds.index(kind)].model for kind in kinds}
    robot, human = models.get("robot", ROBOT_BODY), models.get("human", HUMAN_BODY)
    bodies = {member.model: member.body for member in (*cast, *make_roster([f"robot:{robot}", f"human:{human}"]))}
    return RearrangeWorld(
        scene=scene, free=free, seed=recording.episode.seed, spec=spec, robot=bodies[robot], human=bodies[human],  # type: ignore[arg-type]
        robot_name=robot, human_name=human, cast=cast, places=places,
        starts=Starts(
            robot_xz=first["robot"][:2], robot_heading=float(first["robot"][2]), human_xz=first["human"][:2],
            human_heading=float(first["human"][2]),
        ),
        targets=tuple(
            Target(g.object, np.array(g.start), np.array(g.position), g.source, g.destination) for g in goals
        ),
    )  # fmt: skip


# --- compare ----------------------------------------------------------------------------------------------------------
def verify(recording: Recording) -> Verification:
    """As `sim_kinematic.tasks.resume.verify`."""
    steps = len(recording)
    world = recorded_world(recording)
    played = _Played(world, recording, _recorded(world, recording), stop_at=steps)
    return compared(recording, played.columns, played.ended) if steps else Verification(steps=0, difference=None)


# --- continue ---------------------------------------------------------------------------------------------------------
def resume(
    recording: Recording, step: int, *, policy: Choice | None = None, partner: Choice | None = None
) -> Recording:
    """As `sim_kinematic.tasks.resume.resume`. What an agent is doing goes on under its own policy; another is asked at once."""
    if is_counterfactual(recording):
        if partner is not None:
            raise InputError("People of a counterfactual recording keep their tracks. Hint: leave out the partner.")
        return counterfactual(recording, policy, step=step)
    return _continued(recording, step, {"robot": policy, "human": partner})


def counterfactual(recording: Recording, policy: Choice | None, *, step: int = 0) -> Recording:
    """As `sim_kinematic.tasks.resume.counterfactual`. What people take and put down they do as recorded, unless it is not there."""
    if {agent.kind for agent in recording.agents} != {"robot", "human"}:
        raise InputError(
            "Expected a recording of robots and people: people keep their tracks, robots follow the policy."
        )
    return _continued(recording, step, {"robot": policy, "human": None}, keeps_tracks=True)


def _continued(
    recording: Recording, step: int, chosen: dict[str, Choice | None], *, keeps_tracks: bool = False
) -> Recording:
    require_step(recording, step)
    world, info = recorded_world(recording), recording.episode.info
    kinds = kinds_of(world.cast)
    named = {"robot": info.get("policy"), "human": info.get("partner")}
    new = {kind: None if choice == named[kind] else choice for kind, choice in chosen.items()}
    minds = _minds(world, info, new, keeps_tracks=keeps_tracks)
    policies = _recorded(world, recording, until=step)
    for kind, policy, mind in zip(kinds, policies, minds, strict=True):
        if kind == "robot" or not keeps_tracks:
            policy.own, policy.since = mind.policy, step if new[kind] is not None else min(policy.since, step)
    track_from = min(step, _track_from(recording)) if keeps_tracks else None
    played = _Played(world, recording, policies, track_from=track_from)
    require_kept(recording, step, played.columns, played.ended)
    robots = kinds.count("robot")
    plans = [mind.plan for mind in minds]
    made: dict[str, Any] = {
        "policy": ",".join(mind.name for mind in minds[:robots]) if robots else info.get("policy", SOLO),
        "partner": ",".join(mind.name for mind in minds[robots:]),
        "partner_plan": ",".join(filter(None, plans)),
        "deciding_since": [policy.since for policy in policies],
    }  # fmt: skip
    partner, solo = made["partner"], info.get("solo_steps")
    made["population"] = "zsc-pop" if partner in ZSC else "train-pop" if partner in POPULATIONS else ""
    made |= {"ended": played.ended, "solo_steps": solo_steps_of(world) if solo is None else solo}
    came = origin(recording, step)
    if keeps_tracks:
        made |= {"counterfactual": {**came, "track_from": track_from}, "human_reactive": False}
    else:
        made |= {"resumed_from": came}
    what = "counterfactual" if keeps_tracks else "resume"
    header = header_from(recording, f"{what}:{step}:{made['policy']}:{partner}")
    return replace(
        finished(header, played.log, made), columns=played.columns, skills=played.skills, events=played.events
    )


def _minds(
    world: RearrangeWorld, info: Mapping[str, Any], chosen: dict[str, Choice | None], *, keeps_tracks: bool
) -> list[Mind]:
    """What moves each agent from now on: what is chosen for its kind, else the recording's own."""
    kinds, count = kinds_of(world.cast), len(world.targets)
    minds: list[Mind] = []
    for kind, entry, option in (("robot", "policy", "--policy"), ("human", "partner", "--partner")):
        some = tuple(k for k in kinds if k == kind)
        choice = chosen[kind]
        names = str(info.get(entry)) if choice is None else choice
        try:
            minds += minds_of(
                some, names if kind == "robot" else "", names if kind == "human" else "", seed=world.seed, objects=count
            )  # fmt: skip
        except H3DataError as fault:
            if choice is not None:
                raise
            if kind == "human" and keeps_tracks:  # she decides nothing
                minds += [Mind(Planner(()), name, "") for name in str(names).split(",")]
                continue
            raise InputError(f"The recording's own {entry} is not at hand; name one with {option}. {fault}") from None
    return minds


def _since(recording: Recording) -> list[int]:
    """From which step on each agent's present policy has decided."""
    count = len(recording.agents)
    try:
        since = msgspec.convert(recording.episode.info.get("deciding_since", [0] * count), list[int])
    except msgspec.ValidationError:
        since = []
    if len(since) != count or min(since) < 0:
        raise InputError(f"Expected deciding_since in the info, a step for each of {count} agents.")
    return since


def _track_from(recording: Recording) -> int:
    """From which step on people keep their tracks; the end where they react throughout."""
    if not is_counterfactual(recording):
        return len(recording)
    step = recording.episode.info.get("counterfactual", {}).get("track_from")
    if not isinstance(step, int) or not 0 <= step <= len(recording):
        raise InputError(
            f"Expected counterfactual.track_from in the info, a step up to {len(recording)}, got {step!r}."
        )
    return step


def _recorded(world: RearrangeWorld, recording: Recording, *, until: int | None = None) -> list[RecordedPolicy]:
    """What each agent chose, up to a step (default: all); those that took over from others are asked when those were."""
    objects = tuple(target.name for target in world.targets)
    until = len(recording) if until is None else until
    return [
        RecordedPolicy(*_checked(recording, k, objects), until=until, since=since)
        for k, since in enumerate(_since(recording))
    ]


def _checked(
    recording: Recording, k: int, objects: tuple[str, ...]
) -> tuple[Sequence[SkillSpan], tuple[str, ...], NDArray]:
    spans, now = recorded_choices(recording, k, objects)
    return spans, objects, now


# --- play -------------------------------------------------------------------------------------------------------------
@dataclass(init=False)
class _Played:
    """A recording's world played by policies, with people on their recorded tracks from a step on, if they keep them."""

    columns: dict[str, NDArray[Any]]
    ended: str
    log: RearrangeLog
    skills: tuple[SkillSpan, ...]
    events: tuple[Event, ...]

    def __init__(
        self, world: RearrangeWorld, recording: Recording, policies: Sequence[HighLevelPolicy], *, stop_at: int | None = None,
        track_from: int | None = None,
    ) -> None:  # fmt: skip
        if track_from is None and is_counterfactual(recording):
            track_from = _track_from(recording)
        most = world.spec.max_steps if stop_at is None else min(stop_at, world.spec.max_steps)
        if track_from is not None:
            most = min(most, len(recording))
        self.log, self.columns, self.ended = RearrangeLog(None), {}, "max_steps"
        if most:
            short = replace(world, spec=replace(world.spec, max_steps=most))
            play = RearrangePlay(short, policies, self.log)
            tracks = [] if track_from is None else [KeptTrack.of(recording, p.number, play.bodies) for p in play.people]

            def keep(_: int) -> None:
                if play.steps == track_from:
                    for actor, track in zip(play.people, tracks, strict=True):
                        follow_track(play, actor, track, play.steps)

            if tracks:
                keep(0)
            self.ended = play.run(keep if tracks else None)
            self.columns = self.log.columns()
            if tracks and self.ended == "max_steps" and most < world.spec.max_steps:
                self.ended = "track_end"
        self.skills, self.events = tuple(self.log.skills), tuple(self.log.events)
        if track_from is not None:
            people = [k for k, agent in enumerate(recording.agents) if agent.kind == "human"]
            self._keep_tracks(recording, people)

    def _keep_tracks(self, recording: Recording, people: Sequence[int]) -> None:
        """Columns and skills of people as recorded, but for what is in their hands."""
        rows = len(self.columns["time_ns"])
        kept: Columns = {
            name: recording.columns[name][:rows]
            for name in self.columns
            for k in people
            if name.startswith(f"agent_{k}.") and not name.endswith("grasp_body")
        }
        self.columns |= kept
        self.columns["state_hash"] = state_hash({n: a for n, a in self.columns.items() if n != "state_hash"})
        cut = [
            span if span.end_step < rows else replace(span, end_step=rows - 1, outcome="running", reason="")
            for span in recording.skills
            if span.agent in people and span.start_step < rows
        ]
        robots = [span for span in self.log.skills if span.agent not in people]
        self.skills = tuple(sorted((*robots, *cut), key=lambda span: span.end_step))
