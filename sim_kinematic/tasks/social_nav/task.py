"""Social navigation: a robot must find a walking person and follow them at 1-2 m, facing them, without contact.

The rules follow the paper (section 4.1 and appendix) and habitat-lab.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.geometry import Array
from h3data.recording import Event
from h3data.scene import FreeSpace, Scene
from sim_kinematic.agents.roster import AgentSpec, common_floor, kinds_of
from sim_kinematic.agents.stands import robot_fits
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.motion.state import HUMAN, ROBOT
from sim_kinematic.policies.assignment import AssignedPolicy, PolicyMaker
from sim_kinematic.policies.learned import SHIPPED_NAVIGATORS, is_learned, naming, navigation_of, network_of, stamped
from sim_kinematic.policies.maneuvering import Maneuvering
from sim_kinematic.policies.policy import FunctionPolicy
from sim_kinematic.policies.social_nav import EXPERTS, POLICIES, ROBOT_SKILLS
from sim_kinematic.policies.views import SocialNavView
from sim_kinematic.policies.waypoints import WaypointPolicy
from sim_kinematic.sensing.sensor import facing
from sim_kinematic.tasks.control import Control
from sim_kinematic.tasks.episode import Episode, StepOutcome, sample_pair_starts
from sim_kinematic.tasks.motion import VelocityControl
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.rules.predicates import is_found
from sim_kinematic.tasks.rules.rewards import Encounter, SocialNavReward, check_profile
from sim_kinematic.tasks.social_nav.codec import SocialNavCodec, plan_of
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
        fits = robot_fits(roster[ROBOT].body, spec.robot, scene, free)  # type: ignore[arg-type]
        starts = sample_pair_starts(free, seed, spec, fits=fits)
        return Episode(scene=scene, free=free, seed=seed, spec=spec, roster=roster, starts=starts.places)

    @property
    def codec(self) -> SocialNavCodec:
        """Codec of episodes with starts and the person's goals."""
        return SocialNavCodec(self)

    # --- policies -----------------------------------------------------------------------------------------------------
    def named_policy(self, kind: str, name: str, spec: Any) -> PolicyMaker | None:
        """Return the maker of a learned policy or expert of the robot; None for other names."""
        if kind == "robot" and is_learned(name):
            network = network_of(name)
            if spec is not None:
                with naming(name):
                    navigation_of(network, SocialNav.name)  # raises if the network was trained for another task

            def learned(episode: Episode, number: int) -> AssignedPolicy:
                with naming(name):
                    player = navigation_of(network, SocialNav.name, robot=episode.roster[number].model)
                return AssignedPolicy(FunctionPolicy(player, episode.bases[number]), stamped(name), kind)

            return learned
        if kind == "robot" and name in EXPERTS:
            return lambda episode, number: AssignedPolicy(
                Maneuvering(POLICIES[name], episode.bases[number]), name, kind
            )
        return None

    def view(self, play: WorldRollout, agent: int, world: int) -> Any:
        """Return the observation of a policy: a `SocialNavView` for the robot, or an `AgentView` if it takes one."""
        if agent != ROBOT or (play.policies and play.policies[ROBOT].takes_agent_view):
            return play.agent_view(agent, world)
        state: SocialNavState = play.memory
        robot, person = play.world.state.agents
        was, was_person = play.world.before.agents
        episode, step = play.episodes[world], int(play.steps[world])
        return SocialNavView(
            episode.floor(ROBOT),
            robot.xz[world].copy(),
            float(robot.heading[world]),
            person.xz[world].copy(),
            float(state.geodesic[world]),
            bool(state.found[world]),
            episode.seed,
            step,
            (was.xz[world].copy(), float(was.heading[world])) if step else None,
            was_person.xz[world].copy() if step else None,
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

    def info_of(self, play: WorldRollout) -> dict[str, NDArray[Any]]:
        """Return the distance, success, steps followed and contacts of each world, each [W]."""
        state: SocialNavState = play.memory
        assert state.rewards is not None
        return {
            "geodesic_m": state.geodesic.copy(),
            "found": state.found.copy(),
            "success": state.success.copy(),
            "followed": state.rewards.followed.copy(),
            "collides": state.collides.copy(),
            "robot_contact": play.world.state.robots[0].contact.copy(),
        }

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
