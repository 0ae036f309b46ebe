"""Social navigation, simulated: a robot must find a walking person and follow her at 1-2 m, facing her, without contact
(paper section 4.1 and appendix; spec/habitat.md 1).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot, load_humanoid, load_robot
from h3data.errors import SceneError
from h3data.geometry import Array, ground_pose
from h3data.recording import Event, Recording, RecordingHeader
from h3data.scene import FreeSpace, Scene
from sim_kinematic.agents.arm_tuck import draw_arms
from sim_kinematic.agents.stands import discs_fit, robot_fits
from sim_kinematic.agents.waypoint_walker import HumanPlan, WaypointHuman, human_plan
from sim_kinematic.avoidance.robot_base import base_of, floor_of
from sim_kinematic.contact.clearance import RobotHumanContact
from sim_kinematic.motion.randomness import generator
from sim_kinematic.motion.spec import BaseSpec, SocialNavSpec
from sim_kinematic.motion.state import HumanState, RobotState
from sim_kinematic.motion.step import drive_robots, walk_humans
from sim_kinematic.policies.social_nav import ROBOT_SKILLS, Policy, View, policy_by_name, policy_name
from sim_kinematic.tasks.oracle import oracle_min_steps
from sim_kinematic.tasks.social_nav_log import (
    HUMAN_SKILLS,
    EpisodeLog,
    Sink,
    Step,
    describe,
    facing,
    finished,
    motion_phase,
)

ROBOT, HUMAN = 0, 1


@dataclass(frozen=True, kw_only=True)
class Starts:
    """Where both begin."""

    robot_xz: NDArray[np.float64]
    robot_heading: float
    human_xz: NDArray[np.float64]
    human_heading: float


@dataclass(frozen=True, kw_only=True, eq=False)
class SocialNavWorld:
    """The unchanging half of an episode: home, map, bodies, rules, seed."""

    scene: Scene
    free: FreeSpace
    seed: int
    spec: SocialNavSpec
    robot: Robot
    human: Humanoid
    starts: Starts
    human_name: str
    robot_name: str
    goals: tuple[tuple[float, float], ...] = ()
    """Points ``(x, z)`` that the person walks to first; none: she draws all from the seed."""

    @cached_property
    def base(self) -> BaseSpec:
        """Discs and limits of the robot."""
        return base_of(self.robot, self.spec.robot)

    @cached_property
    def robot_floor(self) -> FreeSpace:
        """The floor on which the robot finds its paths."""
        return floor_of(self.robot, self.base, self.scene, self.free)

    @classmethod
    def create(
        cls, scene: Scene, *, seed: int, spec: SocialNavSpec | None = None, free: FreeSpace | None = None,
        human: str = "female_0", robot: str = "quad_arm",
    ) -> SocialNavWorld:  # fmt: skip
        """An episode of ``scene`` with starts drawn from ``seed``; ``free`` saves building the map again."""
        spec = spec or SocialNavSpec()
        free = free or FreeSpace.from_scene(scene, radius_m=spec.agent_radius_m, height_m=spec.agent_height_m)
        body = load_robot(robot)
        return cls(
            scene=scene, free=free, seed=seed, spec=spec, robot=body, human=load_humanoid(human),
            starts=draw_starts(free, seed, spec, fits=robot_fits(body, spec.robot, scene, free)),
            human_name=human, robot_name=robot,
        )  # fmt: skip


def draw_starts(
    free: FreeSpace, seed: int, spec: SocialNavSpec, *, fits: Callable[[Array, float], bool] | None = None
) -> Starts:
    """Samples start poses at least ``spec.spawn_distance_m`` apart on one island (spec/habitat.md 1.2).

    ``fits`` tests the robot at ``(xz [2], heading)`` (`sim_kinematic.agents.stands.robot_fits`); without it only the base of
    the rules is kept free of obstacles.

    Raises:
        SceneError: the scene has no two such places.
    """
    rng = generator(seed, "spawn")
    base_fits = partial(discs_fit, free, spec.robot)
    farthest = 0.0
    for _ in range(200):
        robot_xz, human_xz = free.sample(rng, 2)
        robot_heading, human_heading = rng.uniform(-np.pi, np.pi, 2)
        apart = float(np.hypot(*(robot_xz - human_xz)))
        farthest = max(farthest, apart)
        if apart < spec.spawn_distance_m:
            continue
        if not np.isfinite(free.geodesic(robot_xz, human_xz)):
            continue
        if (fits or base_fits)(robot_xz, robot_heading):
            return Starts(
                robot_xz=robot_xz, robot_heading=float(robot_heading), human_xz=human_xz,
                human_heading=float(human_heading),
            )  # fmt: skip
    raise SceneError(
        f"Found no start poses {spec.spawn_distance_m} m apart with a free base in 200 attempts (the farthest pair was "
        f"{farthest:.1f} m apart). Hint: a smaller --spawn-distance, or a larger home."
    )


def simulate_social_nav(
    world: SocialNavWorld,
    *,
    policy: str | Policy = "heuristic_expert",
    episode_id: str = "0",
    sink: Callable[[RecordingHeader], Sink] | None = None,
    progress: Callable[[int], object] | None = None,
) -> Recording:
    """Run one episode to its end and return its recording.

    ``sink`` is called once, with what is known before the first step, and returns what receives rows and events while they
    come, such as a `RecordingWriter`; it is closed at the end, aborted on an error. ``progress`` is called with 1 after
    every step.
    """
    act = policy_by_name(policy) if isinstance(policy, str) else policy
    header = describe(world, episode_id=episode_id, policy=policy_name(policy))
    clip = world.human.clip_for_speed(world.spec.human.speed_mps)
    log = EpisodeLog(world, clip, sink(header) if sink is not None else None)
    try:
        ended = play(world, act, log, progress=progress)
        columns = log.columns()
        info = {"ended": ended, **hindsight(world)}
        recording = finished(header, columns, info, log.events)
        if log.sink is not None:
            for span in recording.skills:
                log.sink.skill(span)
            log.sink.close(info=info)
    except BaseException:
        if log.sink is not None:
            log.sink.abort()
        raise
    return recording


class Posture(NamedTuple):
    """What the person's body does: the clip that she plays, her place in it (0..1), its weight over standing, and how far her
    arms are drawn in."""

    clip: int
    phase: float
    blend: float
    arms: tuple[float, float] = (0.0, 0.0)


class Human(Protocol):
    """Who moves the person."""

    goal: int
    """Index of her current goal, -1 before the first."""
    leg: int
    """Index of the way point within the path to it."""

    def advance(self, state: HumanState, step: int) -> Posture:
        """Move her by one step, in place; returns what her body does then, in float32 as it is recorded."""
        ...


@runtime_checkable
class Foreseen(Protocol):
    """A person whose whole future is known."""

    def track(self) -> NDArray[np.float64]:
        """Where she is after each step of the episode, shape [steps, 2] [m]."""
        ...


class ScriptedHuman(WaypointHuman):
    """The way-point walker with a body: what `play` moves by default."""

    def __init__(self, world: SocialNavWorld, clip: int) -> None:
        super().__init__(world.free, world.seed, world.spec.human, world.goals)
        self._world, self._clip = world, clip
        self._track: NDArray[np.float64] | None = None

    def track(self) -> NDArray[np.float64]:
        """As `Foreseen.track`; computed when first asked for."""
        if self._track is None:
            self._track = plan_of(self._world).xz
        return self._track

    def advance(self, state: HumanState, step: int) -> Posture:
        """As `Human.advance`."""
        del step  # she remembers where she goes
        walk_humans(state, self.target(state.xz[0])[None], self.spec)
        draw_arms(state, self.free, self._world.human, self.spec.arms)
        since = state.distance[0] - state.set_off[0]
        phase = motion_phase(self._world, self._clip, since)
        left, right = state.arms[0].astype(np.float32).tolist()
        return Posture(self._clip, float(phase), float(np.float32(state.blend[0])), (left, right))


def play(
    world: SocialNavWorld, act: Policy, log: EpisodeLog, *, human: Human | None = None, steps: int | None = None,
    progress: Callable[[int], object] | None = None,
) -> str:  # fmt: skip
    """Step to the end of the episode, or for ``steps`` at most, into ``log``; returns what ended it.

    Commands are rounded to float32 before they act, so that the recorded ones are those that acted. ``human`` moves the
    person (default: her script).
    """
    spec, free, starts = world.spec, world.free, world.starts
    robot, person = RobotState.zeros(1), HumanState.zeros(1)
    robot.xz[0], robot.heading[0] = starts.robot_xz, starts.robot_heading
    person.xz[0], person.heading[0] = starts.human_xz, starts.human_heading
    robot_xz, human_xz = robot.xz[0], person.xz[0]  # views: they follow the state
    human = human or ScriptedHuman(world, log.clip)
    contact = RobotHumanContact(world.robot, world.human)
    met = False
    before: tuple[NDArray[np.float64], float] | None = None
    human_before: NDArray[np.float64] | None = None
    track = human.track if isinstance(human, Foreseen) else None
    geodesic = float(free.geodesic(robot_xz, human_xz))
    for step in range(spec.max_steps if steps is None else min(steps, spec.max_steps)):
        heading = float(robot.heading[0])
        view = View(
            world.robot_floor, robot_xz.copy(), heading, human_xz.copy(), geodesic, met, world.seed, step, before, human_before,
            None if track is None else partial(_from, track, step),
        )  # fmt: skip
        before, human_before = (view.robot_xz, heading), view.human_xz
        command = act(view, world.base)
        action = np.array([command.forward, command.turn], np.float32)
        goal, walked = human.goal, float(person.distance[0])
        posture = human.advance(person, step)
        drive_robots(robot, free, action[None], world.base)
        geodesic = float(free.geodesic(robot_xz, human_xz))
        collision = _collides(world, robot, person, contact, posture)
        log.add(
            Step(
                robot_x=robot_xz[0],
                robot_z=robot_xz[1],
                robot_heading=robot.heading[0],
                robot_contact=robot.contact[0],
                human_x=human_xz[0],
                human_z=human_xz[1],
                human_heading=person.heading[0],
                human_distance=person.distance[0] - person.set_off[0],
                human_blend=person.blend[0],
                human_left_arm=person.arms[0, 0],
                human_right_arm=person.arms[0, 1],
                human_skill=HUMAN_SKILLS.index("walk" if person.distance[0] > walked else "turn"),
                human_goal=human.goal,
                human_leg=human.leg,
                forward=action[0],
                turn=action[1],
                robot_skill=ROBOT_SKILLS.index(command.skill),
                geodesic=geodesic,
                collision=collision,
            )
        )
        if progress is not None:
            progress(1)
        if isinstance(human, WaypointHuman) and human.goal != goal:
            x, z = human.goals[-1]
            log.event(Event(step=step, agent=HUMAN, kind="new_goal", detail=f"({x:.2f}, {z:.2f})"))
        if not met and spec.near_m <= geodesic <= spec.far_m:
            met = bool(facing(robot_xz, robot.heading[0], human_xz) > spec.facing_dot)
            if met:
                log.event(Event(step=step, agent=ROBOT, kind="found", target="human"))
        if collision:
            log.event(Event(step=step, agent=ROBOT, kind="collision", target="human"))
            if spec.end_on_collision:
                return "collision"
    return "max_steps"


def _from(track: Callable[[], NDArray[np.float64]], step: int) -> NDArray[np.float64]:
    return track()[step:]


def _collides(
    world: SocialNavWorld, robot: RobotState, person: HumanState, contact: RobotHumanContact, posture: Posture
) -> bool:
    """Whether robot and person touch in what is recorded: poses in float32."""
    if np.hypot(*(robot.xz[0] - person.xz[0])) > contact.gate_m + 1e-3:
        return False
    floor = world.free.floor_y
    return contact.touching(
        ground_pose(robot.xz[0], robot.heading[0], floor).astype(np.float32),
        ground_pose(person.xz[0], person.heading[0], floor).astype(np.float32),
        *posture,
    )


def plan_of(world: SocialNavWorld) -> HumanPlan:
    """What the scripted person will do in an episode of greatest length."""
    starts, spec = world.starts, world.spec
    return human_plan(
        world.free, starts.human_xz, starts.human_heading, world.seed, spec.human, spec.max_steps, world.goals
    )  # fmt: skip


def hindsight(world: SocialNavWorld) -> dict[str, Any]:
    """What follows from the person's whole plan, however long the episode lasted: her goals, and the oracle's ``l``."""
    starts, spec, free = world.starts, world.spec, world.free
    plan = plan_of(world)
    return {
        "human_goals": [[float(x), float(z)] for x, z in plan.goals],
        "oracle_min_steps": oracle_min_steps(
            free, starts.robot_xz, starts.robot_heading, plan.xz, replace(spec, robot=world.base)
        ),
    }
