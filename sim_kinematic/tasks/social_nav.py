"""Social navigation: a robot must find a walking person and follow them at 1-2 m, facing them, without contact.

The rules follow the paper (section 4.1 and appendix) and habitat-lab.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any, ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.bodies.names import split_walk
from h3data.errors import InputError, SceneError
from h3data.geometry import Array, wrap_angle
from h3data.plugins import names_from_data
from h3data.recording import Event, Recording
from h3data.recording.assets.scenes import scene_attachment
from h3data.recording.task_episodes.rearrange_episode import RearrangeEpisode as FileEntry
from h3data.recording.task_episodes.social_nav_episodes import SocialNavEpisode, read_social_nav, social_nav_episode
from h3data.scene import FreeSpace, Scene, scene_digest
from sim_kinematic.agents.roster import ROBOT_BODY, AgentSpec, common_floor, kinds_of, make_roster, with_body
from sim_kinematic.agents.stands import robot_fits
from sim_kinematic.agents.waypoint_walker import HumanPlan, human_plan
from sim_kinematic.motion.spec import STEP_S, SocialNavSpec
from sim_kinematic.motion.state import HUMAN, ROBOT
from sim_kinematic.policies.assignment import AssignedPolicy, PolicyMaker, learned_policy
from sim_kinematic.policies.learned import SHIPPED_NAVIGATORS, is_learned, navigation_of
from sim_kinematic.policies.social_nav import EXPERTS, POLICIES, ROBOT_SKILLS, Maneuvering
from sim_kinematic.policies.views import SocialNavView
from sim_kinematic.policies.waypoints import WaypointPolicy
from sim_kinematic.sensing.sensor import facing
from sim_kinematic.tasks.codec import (
    SNAP_M,
    EpisodeCodec,
    EpisodePlace,
    SceneAndMap,
    malformed_info,
    read_rules,
    require_info,
    uid_of,
)
from sim_kinematic.tasks.control import Control, VelocityControl
from sim_kinematic.tasks.episode import Episode, Starts, StepOutcome, rules_dict, sample_pair_starts
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.rules.predicates import is_found
from sim_kinematic.tasks.rules.rewards import Encounter, SocialNavReward, check_profile
from sim_kinematic.tasks.task import Task, TaskUsage

TRAINING = SocialNavSpec(spawn_distance_m=3.0)
"""Rules of the paper for training, in which robot and person start at least 3 m apart (appendix, social navigation)."""


@dataclass(eq=False)
class SocialNavState:
    """Memory of the task's rules for W worlds, with arrays [W]."""

    rewards: SocialNavReward | None
    """Rewards of the step; None if they are not computed."""
    geodesic: Array
    """Length of the shortest path from robot to person, [W] [m]; infinite if there is none."""
    collides: NDArray[np.bool_]
    """True if robot and person touch, [W]."""
    found: NDArray[np.bool_]
    """True if the robot has found the person in this episode, [W]."""
    success: NDArray[np.bool_]
    """True if the robot has followed the person long enough, [W]."""
    faces: Array
    """Cosine between the robot's forward axis and the direction to the person, [W]."""
    collisions: NDArray[np.int64]
    goal: NDArray[np.int64]
    """Number of the goal that a scripted person walks to, [W]; -1 before the first goal and for people without a
    script."""
    leg: NDArray[np.int64]
    """Index of the waypoint on the path to the goal, [W]."""
    track: list[NDArray[np.float64]] = field(default_factory=list)
    """Positions so far of a person without a script, each [2] [m]."""


class SocialNav(Task):
    """Task in which a robot finds a person and then follows them (paper section 4.1)."""

    name: ClassVar[str] = "social_nav"
    Spec: ClassVar[type[Any]] = SocialNavSpec
    columns: ClassVar[Mapping[str, Any]] = {
        "sim.human_goal": np.int32,
        "sim.human_leg": np.int32,
        "metrics.geodesic_agents": np.float32,
        "metrics.facing": np.float32,
    }
    control: ClassVar[Control] = VelocityControl({"robot": ROBOT_SKILLS, "human": ("walk", "turn")})
    policies: ClassVar[Mapping[str, Mapping[str, Any]]] = {"robot": {**POLICIES, **SHIPPED_NAVIGATORS}}
    defaults: ClassVar[Mapping[str, str]] = {"robot": "rollout_expert", "human": "waypoints"}
    usage: ClassVar[TaskUsage] = TaskUsage(
        env_rules=TRAINING,
        set_rules=lambda scenes: SocialNavSpec(spawn_distance_m=scenes.social_nav.spawn_distance_m),
        env_options={"reward": check_profile},
        env_info={
            "geodesic_m": lambda play: play.memory.geodesic,
            "found": lambda play: play.memory.found,
            "followed": lambda play: play.memory.rewards.followed,
            "collides": lambda play: play.memory.collides,
            "robot_contact": lambda play: play.world.state.robots[0].contact,
        },
        named_kinds=("robot",),
    )

    # --- episodes -----------------------------------------------------------------------------------------------------
    def sample(
        self, scene: Scene, free: FreeSpace, seed: int, spec: SocialNavSpec, roster: tuple[AgentSpec, ...]
    ) -> Episode:
        """Sample the starts of the robot and the person on the floor that both can use.

        Raises:
            InputError: The roster is not one robot and one person.
        """
        if kinds_of(roster) != ("robot", "human"):
            raise InputError(
                f"In social_nav one robot follows one person, got: {', '.join(kinds_of(roster))}. "
                "Hint: rearrange and wander take any agents.",
                code="H3-TASK-053",
            )
        free = common_floor(roster, free)
        fits = robot_fits(roster[ROBOT].robot, spec.robot, scene, free)
        starts = sample_pair_starts(free, seed, spec, fits=fits)
        return Episode(scene=scene, free=free, seed=seed, spec=spec, roster=roster, starts=starts.places)

    @property
    def codec(self) -> SocialNavCodec:
        """Codec of episodes with starts and the person's goals."""
        return SocialNavCodec(self)

    # --- policies -----------------------------------------------------------------------------------------------------
    def named_policy(self, kind: str, name: str, spec: Any) -> PolicyMaker | None:
        """Return the maker of a learned policy or expert of the robot; None for other names."""
        if kind not in self.usage.named_kinds:
            return None
        if is_learned(name):
            return learned_policy(kind, name, spec, self.name, navigation_of)
        if name in EXPERTS:
            return lambda episode, number: AssignedPolicy(
                Maneuvering(POLICIES[name], episode.bases[number]), name, kind
            )
        return None

    def view(self, play: WorldRollout, agent: int, world: int) -> Any:
        """Return the observation of a policy: a `SocialNavView` for the robot, or an `AgentView` if it takes one."""
        if agent != ROBOT or (play.policies and play.policies[ROBOT].takes_agent_view):
            return play.agent_view(agent, world)
        state: SocialNavState = play.memory
        now, was = play.world.now, play.world.was
        episode, step = play.episodes[world], play.steps.item(world)
        # copies, as the world moves agents in place
        (robot_xz, human_xz), (robot_was, human_was) = now.xz[:, world].copy(), was.xz[:, world].copy()
        return SocialNavView(
            episode.floor(ROBOT),
            robot_xz,
            now.heading.item(ROBOT, world),
            human_xz,
            state.geodesic.item(world),
            state.found.item(world),
            episode.seed,
            step,
            (robot_was, was.heading.item(ROBOT, world)) if step else None,
            human_was if step else None,
            self._future(play, step),
            partial(play.pictures, agent, world),
            partial(play.observe, agent, world),
        )

    def _future(self, play: WorldRollout, step: int) -> Callable[[], NDArray[np.float64]] | None:
        """Return a function that gives the person's positions from this step on; None: nobody knows them."""
        policy = play.policies[HUMAN].policy if play.policies else None
        if isinstance(policy, WaypointPolicy):
            return lambda: plan_of(play.episode).xz[step:]
        track = getattr(policy, "track", None)
        return None if track is None else lambda: track()[step:]

    # --- rules --------------------------------------------------------------------------------------------------------
    def begin(self, play: WorldRollout, rows: NDArray[np.intp]) -> None:
        """Reset rewards, counters and the person's goals in the worlds ``rows`` [n]."""
        worlds = play.world.worlds
        if play.memory is None:
            reward = play.options.get("reward", "paper")
            play.memory = SocialNavState(
                rewards=SocialNavReward(worlds, profile=reward, rules=play.spec) if play.measure else None,
                geodesic=np.zeros(worlds),
                collides=np.zeros(worlds, np.bool_),
                found=np.zeros(worlds, np.bool_),
                success=np.zeros(worlds, np.bool_),
                faces=np.zeros(worlds),
                collisions=np.zeros(worlds, np.int64),
                goal=np.full(worlds, -1),
                leg=np.zeros(worlds, np.int64),
            )
        state: SocialNavState = play.memory
        state.collisions[rows] = 0
        state.found[rows] = state.success[rows] = state.collides[rows] = False
        state.goal[rows], state.leg[rows], state.track = -1, 0, []
        self._look(play, rows)
        if state.rewards is not None:
            fresh = np.zeros(worlds, np.bool_)
            fresh[rows] = True
            worth = state.rewards.reset(self._encounter(play), where=fresh)
            # under Habitat's profile the reset counts as a step, which may complete the following
            state.success[rows] |= worth.success[rows]

    def judge(self, play: WorldRollout) -> StepOutcome:
        """Compute reward, success and end of a step, and an event when the person is first found."""
        state: SocialNavState = play.memory
        # before the look, so that the event comes in the step in which this changes
        lost = not state.found[0]
        self._look(play)
        if lost or play.world.worlds > 1:  # once true it stays true
            state.found |= is_found(state.geodesic, state.faces, play.spec)
        if state.rewards is not None:
            state.collisions += state.collides | play.world.state.robots[0].contact
            worth = state.rewards.step(self._encounter(play))
            # once true it stays true, as every task's success does
            state.success |= worth.success
            reward, ends = worth.reward, worth.ends
        else:
            # of the same type as the array: a Python bool would take ten times as long
            reward, ends = np.zeros(play.world.worlds), state.collides & np.bool_(play.spec.end_on_collision)
        return StepOutcome(
            reward=reward,
            terminated=ends,
            success=state.success,
            columns={
                "sim.human_goal": state.goal,
                "sim.human_leg": state.leg,
                "metrics.geodesic_agents": state.geodesic,
                "metrics.facing": state.faces,
            },
            ended="collision",  # the only end besides the time limit
            events=self._events(play, state, lost) if play.policies else (),
        )

    def _events(self, play: WorldRollout, state: SocialNavState, lost: bool) -> list[tuple[int, Event]]:
        """Return the events of a world that is recorded, and store the goal or the position of the person."""
        events, step, walker = [], play.step - 1, play.policies[HUMAN].policy
        if not isinstance(walker, WaypointPolicy):
            # a copy, as the world moves people in place
            state.track.append(play.world.state.people[0].xz[0].copy())
        else:
            if walker.goal != state.goal[0]:
                x, z = walker.goals[-1]
                events.append(Event(step=step, agent=HUMAN, kind="new_goal", detail=f"({x:.2f}, {z:.2f})"))
            state.goal[0], state.leg[0] = walker.goal, walker.leg
        if lost and state.found[0]:
            events.append(Event(step=step, agent=ROBOT, kind="found", target="human"))
        if state.collides[0]:
            events.append(Event(step=step, agent=ROBOT, kind="collision", target="human"))
        return [(0, event) for event in events]

    def _look(self, play: WorldRollout, rows: NDArray[np.intp] | None = None) -> None:
        """Update distances and contact in the worlds ``rows`` [n] (default: all)."""
        state: SocialNavState = play.memory
        world, at = play.world, slice(None) if rows is None else rows
        robot, person = world.state.agents
        state.geodesic[at] = world.geodesic(ROBOT, HUMAN, rows)
        state.collides[at] = world.touching[at, 0]
        state.faces[at] = facing(robot.xz[at], robot.heading[at], person.xz[at])

    def _encounter(self, play: WorldRollout) -> Encounter:
        state: SocialNavState = play.memory
        robot, person = play.world.state.agents
        return Encounter(
            robot_xz=robot.xz,
            robot_heading=robot.heading,
            human_xz=person.xz,
            geodesic=state.geodesic,
            collides=state.collides,
            collisions=state.collisions,
            faces=state.faces,
        )


class SocialNavCodec(EpisodeCodec[SocialNavEpisode]):
    """Codec of episodes that consist of two starts, the person's goals and the rules."""

    records_judgement: ClassVar[bool] = False

    def record(self, episode: Episode) -> SocialNavEpisode:
        """Return the record of an episode: its starts, all goals that the person can reach in time, and the rules.

        The record follows from scene, seed and rules alone, and `episode_from` makes the same episode from it, bit for
        bit.
        """
        robot, human = episode.starts.tolist()
        return SocialNavEpisode(
            robot_start=tuple(robot),
            human_start=tuple(human),
            human_goals=tuple((float(x), float(z)) for x, z in plan_of(episode).goals),
            floor_y=float(episode.free.height_at(episode.starts[ROBOT, :2])),
            max_steps=episode.spec.max_steps,
            seed=episode.seed,
            robot=f"robot/{episode.roster[ROBOT].model}",
            human=f"humanoid/{split_walk(episode.roster[HUMAN].model)[0]}",
            scene_sha256=scene_digest(episode.scene),
            scene_source=dict(episode.scene.source),
            rules=msgspec.to_builtins(rules_dict(episode.spec)),
        )

    def entry(
        self, record: SocialNavEpisode, *, episode_id: str, scene_id: str, scene_dataset_config: str = "default"
    ) -> FileEntry:
        """Return the entry of an episode file, in the format of Habitat's social navigation episodes."""
        return social_nav_episode(
            record, episode_id=episode_id, scene_id=scene_id, scene_dataset_config=scene_dataset_config
        )

    def read(self, entry: FileEntry, *, seed: int) -> SocialNavEpisode | None:
        """Return the record in an entry of a file; None if the entry belongs to another task."""
        return read_social_nav(entry)

    def rules(self, record: SocialNavEpisode) -> SocialNavSpec:
        """Return the rules in a record."""
        return read_rules(record.rules, SocialNavSpec, max_steps=record.max_steps)

    def episode(self, record: SocialNavEpisode, place: EpisodePlace) -> Episode:
        """Return the episode of a record in an opened scene."""
        return episode_from(record, place.scene, spec=place.spec, free=place.free, human=place.human, robot=place.robot)

    # --- recordings ---------------------------------------------------------------------------------------------------
    def restore(self, recording: Recording, scene: SceneAndMap) -> Episode:
        """Return the episode of a recording, from the rules and starts in its info.

        Raises:
            InputError: The recording lacks rules or starts, or its agents are not a robot and a person.
        """
        info, agents = recording.episode.info, recording.agents
        require_info(recording, "spec", "robot_start", "human_start")
        if [a.kind for a in agents] != ["robot", "human"]:
            raise InputError(
                f"Expected a robot and a human, in this order, got: {[a.kind for a in agents]}.", code="H3-TASK-054"
            )
        try:
            stored = msgspec.convert(
                {
                    "robot_start": info["robot_start"],
                    "human_start": info["human_start"],
                    # only the scripted person has goals that decide where they walk
                    "human_goals": info.get("human_goals", ())
                    if info.get("partner", "waypoints") == "waypoints"
                    else (),
                    "seed": recording.episode.seed,
                    "max_steps": info["spec"]["max_steps"],
                    "robot": agents[ROBOT].model,
                    "human": agents[HUMAN].model,
                    "rules": info["spec"],
                },
                SocialNavEpisode,
            )
        except (msgspec.ValidationError, KeyError, TypeError) as fault:
            raise malformed_info(fault) from None
        if not np.isfinite([*stored.robot_start, *stored.human_start, *np.ravel(stored.human_goals)]).all():
            raise InputError("The recording's starts and goals must be finite numbers.", code="H3-TASK-055")
        rules = self.rules(stored)
        home, free = scene(rules.agent_radius_m, rules.agent_height_m)
        return episode_from(stored, home, spec=rules, free=free)

    def instruction(self, episode: Episode) -> str:
        """Return the instruction in words, the same for all episodes."""
        return "follow the person"

    def info(self, episode: Episode, policies: Sequence[AssignedPolicy]) -> dict[str, Any]:
        """Return the policies, rules, starts and the person's goals for a recording's info."""
        spec, (robot, human) = episode.spec, episode.starts.tolist()
        info = {
            "policy": policies[ROBOT].name,
            "max_steps": spec.max_steps,
            "spec": rules_dict(spec),
            "robot_start": robot,
            "human_start": human,
        }
        if policies[HUMAN].name != "waypoints":
            info["partner"] = policies[HUMAN].name
        goals = goals_of(episode)
        # before the first step, so that a recording that ends in a crash can be continued
        if goals:
            info["human_goals"] = [list(goal) for goal in goals]
        return info

    def uid(self, episode: Episode, policies: Sequence[AssignedPolicy]) -> str:
        """Return an identifier derived from scene, bodies, seed, policies, rules and, if they are given, goals."""
        digest = scene_attachment(episode.scene)[1]
        robot, human = episode.roster
        goals, partner = goals_of(episode), policies[HUMAN].name
        # without goals of a file, starts and goals follow from the seed
        told = f":{Starts.of(episode.starts)}:{goals}" if goals else ""
        policy = policies[ROBOT].name + ("" if partner == "waypoints" else f":{partner}")
        what = f"social_nav:{digest}:{robot.model}:{human.model}:{episode.seed}:{policy}:{episode.spec}{told}"
        return uid_of(what)

    def check_changes(self, recording: Recording, chosen: Mapping[str, Any]) -> None:
        """Raise an `InputError` if a policy is chosen for a person who follows a script."""
        if chosen.get("human") is not None and "external" not in str(recording.episode.info.get("partner", "")):
            raise InputError(
                "Nobody in recordings of social_nav follows a partner: the person walks by a script. Hint: leave it out.",
                code="H3-TASK-057",
            )

    def final_info(self, episode: Episode, play: WorldRollout, policies: Sequence[AssignedPolicy]) -> dict[str, Any]:
        """Return the person's goals, and the least number of steps ``l`` in which an oracle finds the person.

        Both follow from the person's whole plan, regardless of the length of the episode. For a person without a
        script, they follow from the track that the person walked.
        """
        info: dict[str, Any] = {"ended": play.ended}
        if isinstance(policies[HUMAN].policy, WaypointPolicy):
            plan = plan_of(episode)
            info["human_goals"] = [[float(x), float(z)] for x, z in plan.goals]
            return {**info, "oracle_min_steps": _oracle(episode, plan.xz)}
        if play.memory.track:
            info["oracle_min_steps"] = _oracle(episode, np.array(play.memory.track))
        return info


def goals_of(episode: Episode) -> tuple[tuple[float, float], ...]:
    """Return the given points ``(x, z)`` [m] that the person walks to first; all later ones are sampled by the seed."""
    return tuple((float(x), float(z)) for x, z in episode.extra.get("human_goals", ()))


@lru_cache(maxsize=4)
def plan_of(episode: Episode) -> HumanPlan:
    """Return the whole walk of the scripted person, from the start to the time limit of an episode."""
    x, z, heading = episode.starts[HUMAN]
    return human_plan(
        episode.free,
        np.array([x, z]),
        float(heading),
        episode.seed,
        episode.spec.human,
        episode.spec.max_steps,
        goals_of(episode),
    )


def episode_from(
    episode: SocialNavEpisode,
    scene: Scene,
    *,
    spec: SocialNavSpec | None = None,
    free: FreeSpace | None = None,
    human: str | None = None,
    robot: str | None = None,
) -> Episode:
    """Return the episode that a record stores, in its scene.

    ``spec`` and the bodies ``human`` and ``robot`` replace those of the record; ``free`` saves computing the map again.

    Raises:
        SceneError: A start or a goal is off the free floor or on another island, so the scene must differ.
        InputError: There are no such rules or bodies.
    """
    rules: SocialNavSpec = spec or read_rules(episode.rules, SocialNavSpec, max_steps=episode.max_steps)
    free = free or FreeSpace.from_scene(scene, radius_m=rules.agent_radius_m, height_m=rules.agent_height_m)
    points = _on_free_floor(free, episode)
    robot_name = robot or episode.robot.removeprefix("robot/") or ROBOT_BODY
    human_name = with_body(human, episode.human.removeprefix("humanoid/"))
    headings = np.array([[episode.robot_start[2]], [episode.human_start[2]]])
    goals = [[float(x), float(z)] for x, z in points[2:]]
    # the user may name any robot, a file only those that are built in, installed or trusted
    with nullcontext() if robot else names_from_data():
        roster = make_roster(("robot", "human"), robot=robot_name, human=human_name)
    return Episode(
        scene=scene,
        free=free,
        seed=episode.seed,
        spec=rules,
        starts=np.hstack([points[:2], headings]),
        roster=roster,
        extra={"human_goals": goals} if goals else {},
    )


def _on_free_floor(free: FreeSpace, episode: SocialNavEpisode) -> np.ndarray:
    """Return starts and goals [2 + G, 2]; those that rounding has put beside the free floor are moved onto it."""
    points = np.array([episode.robot_start[:2], episode.human_start[:2], *episode.human_goals], np.float64)
    off = ~free.is_navigable(points)
    points[off] = free.snap(points[off], max_distance_m=SNAP_M)
    names = ["robot_start", "human_start", *(f"human_goals[{k}]" for k in range(len(points) - 2))]
    lost = [name for name, point in zip(names, points, strict=True) if np.isnan(point).any()]
    if lost:
        raise SceneError(
            f"{', '.join(lost[:4])}: more than {SNAP_M} m off the free floor of this scene. Expected the scene for which "
            "the episode was made.",
            code="H3-TASK-050",
        )
    if len(set(free.island(points).tolist())) > 1:
        raise SceneError(
            "The starts and goals of the episode are not on one island of this scene's free floor.", code="H3-TASK-051"
        )
    return points


def _oracle(episode: Episode, track: NDArray[np.float64]) -> Any:
    """Return the fewest steps in which a robot could find a person on a track [E, 2]; None: in none of them."""
    # by the limits of the robot itself, which may be slower than the rules allow
    x, z, heading = episode.starts[ROBOT]
    return oracle_min_steps(
        episode.free, np.array([x, z]), float(heading), track, replace(episode.spec, robot=episode.bases[ROBOT])
    )


# --- the oracle of SPS and F ------------------------------------------------------------------------------------------
def steps_to_find(path: NDArray[np.float64], heading: float, spec: SocialNavSpec) -> float:
    """Return a lower bound of the steps along ``path`` [K, 2] until the robot has found the person.

    The person is found when the robot is ``spec.far_m`` from the end of the path and faces along it (paper appendix,
    "Oracle for the Minimum Steps"). The robot turns while it drives, so the larger of the two numbers of steps counts.
    No policy needs fewer steps.
    """
    legs = np.diff(path, axis=0)
    lengths = np.hypot(legs[:, 0], legs[:, 1])
    # points that coincide give no direction
    legs, lengths = legs[lengths > 1e-9], lengths[lengths > 1e-9]
    drive = max(float(lengths.sum()) - spec.far_m, 0.0)
    # only legs on which the robot drives: it need not turn at corners beyond its place
    driven = int(np.searchsorted(np.cumsum(lengths), drive)) + 1
    # forward is (cos, -sin) of the heading in (x, z)
    headings = np.concatenate([[heading], np.arctan2(-legs[:driven, 1], legs[:driven, 0])])
    turn = float(np.abs(wrap_angle(np.diff(headings))).sum())
    robot = spec.robot
    return float(np.ceil(max(drive / robot.max_speed_mps, turn / robot.max_turn_rad_s) / STEP_S))


def oracle_min_steps(
    free: FreeSpace, robot_xz: NDArray[np.float64], heading: float, track: NDArray[np.float64], spec: SocialNavSpec
) -> int | None:
    """Return ``l``, the first i with ``r_i < i`` along the person's ``track`` [E, 2], tested at every step (paper appendix).

    ``track[k]`` is the position of the person after step ``k + 1``. Returns None if they cannot be found within the
    track.
    """
    for i, place in enumerate(track, start=1):
        path = free.path(robot_xz, place)
        # an empty path leads nowhere: the person is out of reach there
        if len(path) and steps_to_find(path, heading, spec) < i:
            return i
    return None
