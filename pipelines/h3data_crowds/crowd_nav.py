"""Crowd navigation (PointGoal among people), in which a robot drives to a place in a home with walking people."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from h3data.errors import SceneError
from h3data.scene import FreeSpace, Scene
from h3data_crowds.imitation import imitation
from h3data_crowds.learned import driver_of, reinforced
from h3data_crowds.robots import ROBOTS, SKILLS
from sim_kinematic.agents.roster import AgentSpec, common_floor
from sim_kinematic.motion.randomness import generator
from sim_kinematic.motion.spec import STEP_S
from sim_kinematic.policies.assignment import PolicyMaker, learned_policy
from sim_kinematic.policies.learned import SHIPPED, is_learned
from sim_kinematic.sensing.encodings import SPEED_MPS
from sim_kinematic.sensing.sensor import gps_compass, in_base_frame, way
from sim_kinematic.sensing.table import Sensor
from sim_kinematic.tasks.control import Control, VelocityControl
from sim_kinematic.tasks.episode import Episode, StepOutcome, TaskSpec, sample_starts
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.task import Task

CANDIDATES = 400
"""Number of goals that are sampled for an episode; the first one that satisfies the rules is used."""
FAR_M = 100.0
"""Largest distance in observations [m]; larger distances are clipped to it."""
NEAREST, SEEN_M = 4, 5.0
"""Number of people whom the sensor ``people`` measures, nearest first, and distance beyond which it measures nobody [m]."""


def nearest_people(m: Any) -> Any:
    """Return the `NEAREST` people within `SEEN_M`, five numbers each, [W, 5 n]; 0 for people who are not there.

    The numbers are the direction of a person in the frame of the base (forward, left), their nearness
    ``1 - distance / SEEN_M``, and their velocity over the ground along the same axes [m/s]. Walls hide nobody.

    Args:
        m: a `sim_kinematic.sensing.table.SensorContext`.
    """
    xp, own, slots = m.xp, m.now, []
    for person, was in zip(m.world.state.people, m.world.before.people, strict=True):
        gap = in_base_frame(own.xz, own.heading, person.xz, xp=xp)
        moved = in_base_frame(was.xz, own.heading, person.xz, xp=xp) / STEP_S
        far = xp.hypot(gap[:, 0], gap[:, 1])[:, None]
        slot = xp.concatenate([gap / far.clip(1e-9, None), 1.0 - far / SEEN_M, moved.clip(-SPEED_MPS, SPEED_MPS)], -1)
        slots.append(slot * (far < SEEN_M))
    nobody = 0.0 * own.xz[:, :1]
    slots += [xp.concatenate([nobody] * 5, -1)] * (NEAREST - len(slots))
    found = xp.stack(slots, 1)
    order = xp.argsort(-found[..., 2])[:, :NEAREST]
    rows = xp.arange(len(order), device=order.device)[:, None]
    return found[rows, order].reshape((len(order), -1))


@dataclass(frozen=True, kw_only=True)
class CrowdNavSpec(TaskSpec):
    """Rules of crowd navigation, in addition to those of every task."""

    max_steps: int = 1800
    spawn_distance_m: float = 1.5
    goal_path_m: float = 5.0
    """Least length of the robot's shortest path to the goal [m]."""
    goal_room_m: float = 0.4
    """Radius of the free space around the goal [m]."""
    arrive_m: float = 0.5
    """Distance to the goal at which the robot counts as arrived [m]."""
    personal_m: float = 1.0
    """Distance between the centres of robot and person below which the robot is in the person's personal space (PSC)
    [m].
    """
    end_on_collision: bool = True
    """True if contact with a person ends the episode, as a failure."""
    solid_agents: bool = field(default=False, repr=False)
    """True if people and robots that somebody plays slide along other agents as along walls (h3data docs play)."""
    progress_reward: float = 1.0
    """Reward for each metre of progress along the shortest path."""
    arrive_reward: float = 10.0
    """Reward for arriving."""
    collision_reward: float = -5.0
    """Reward for touching a person."""
    personal_reward: float = -0.02
    """Reward for each step in a person's personal space."""


class CrowdNav(Task):
    """Task to reach a goal without touching anyone and while spending little time close to people."""

    Spec = CrowdNavSpec
    agents: ClassVar[tuple[str, ...]] = ("robot", "human", "human", "human", "human")
    profile: ClassVar[str] = "social"
    columns: ClassVar[Mapping[str, Any]] = {"metrics.goal_distance": np.float32, "metrics.personal_space": np.bool_}
    sensors: ClassVar[Mapping[str, Sensor]] = {
        **Task.sensors,
        # distance and angle of the goal
        "goal_gps": Sensor(
            lambda m: gps_compass(m.now.xz, m.now.heading, m.memory["goal"], xp=m.xp),
            [0.0, -np.pi],
            [FAR_M, np.pi],
            ("m", "rad"),
            "base",
            kinds=("robot",),
        ),
        # length and initial angle of the shortest path to it
        "goal_way": Sensor(
            lambda m: way(m.now.xz, m.now.heading, *m.path(m.memory["goal"]), xp=m.xp),
            [0.0, -np.pi],
            [FAR_M, np.pi],
            ("m", "rad"),
            "base",
            kinds=("robot",),
        ),
        "people": Sensor(
            nearest_people,
            [-1.0, -1.0, 0.0, -SPEED_MPS, -SPEED_MPS] * NEAREST,
            [1.0, 1.0, 1.0, SPEED_MPS, SPEED_MPS] * NEAREST,
            ("", "", "", "m/s", "m/s") * NEAREST,
            "base",
            kinds=("robot",),
        ),
    }
    control: ClassVar[Control] = VelocityControl({"robot": SKILLS})
    policies: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "robot": {**ROBOTS, "imitation": imitation, "reinforced": reinforced}
    }
    defaults: ClassVar[Mapping[str, str]] = {"robot": "dwa", "human": "orca"}

    def named_policy(self, kind: str, name: str, spec: Any) -> PolicyMaker | None:
        """Return the maker of a robot with the weights in a file; None for other names."""
        if kind != "robot" or not is_learned(name) or name in SHIPPED:
            return None
        return learned_policy(kind, name, spec, self.name, driver_of)

    def sample(
        self, scene: Scene, free: FreeSpace, seed: int, spec: CrowdNavSpec, roster: tuple[AgentSpec, ...]
    ) -> Episode:
        """Sample starts, and a goal with room around it that is at least ``goal_path_m`` away.

        Raises:
            SceneError: the home has no place for such a goal.
        """
        free = common_floor(roster, free)
        starts = sample_starts(scene, free, seed, spec, roster)
        goals = free.sample(generator(seed, "crowd_goal"), CANDIDATES)
        far = free.geodesic(np.broadcast_to(starts[0, :2], goals.shape), goals)
        fits = np.flatnonzero(
            np.isfinite(far) & (far >= spec.goal_path_m) & (free.signed_distance(goals) >= spec.goal_room_m)
        )
        if not len(fits):
            raise SceneError(
                f"No free place in {scene.name} is {spec.goal_path_m} m from the robot's start by the shortest path, with "
                f"{spec.goal_room_m} m of room. Hint: a larger home, or a smaller goal_path_m.",
                code="H3-TASK-074",
            )
        extra = {"goal": goals[fits[0]].tolist()}
        return Episode(scene=scene, free=free, seed=seed, spec=spec, roster=roster, starts=starts, extra=extra)

    def begin(self, play: WorldRollout, rows: NDArray[np.intp]) -> Mapping[str, Any]:
        """Store the goals and the remaining path lengths."""
        goal = self.goals(play)
        return {"goal": goal, "left": self._left(play, goal), "done": play.steps < 0}

    def judge(self, play: WorldRollout) -> StepOutcome:
        """Reward progress and arrival, and penalise contact with a person, which may end the episode."""
        xp, memory, spec, world = play.xp, play.memory, play.spec, play.world
        memory["goal"] = self.moved_goals(play)
        left, before = self._left(play, memory["goal"]), memory["left"]
        robot, people = world.state.agents[0], world.state.people
        near, touching = play.steps < 0, play.steps < 0
        for person in people:
            gap = person.xz - robot.xz
            near = near | (xp.hypot(gap[:, 0], gap[:, 1]) < spec.personal_m)
        for p, (a, b) in enumerate(world.pairs):
            if a == 0 and world.roster[b].kind == "human":
                touching = touching | world.touching[:, p]
        arrived, over = self.achieved(play, touching)
        memory["left"], memory["done"] = left, memory["done"] | arrived
        reward = spec.progress_reward * (before - left) + spec.arrive_reward * arrived
        reward = reward + spec.collision_reward * touching + spec.personal_reward * near
        # events and not flags decide on the word that is recorded, as on a device nobody may ask for values
        reached = play.events_where(arrived, "arrived", agent=0)
        touched = play.events_where(touching, "collision", agent=0)
        return StepOutcome(
            reward=reward,
            terminated=over | (touching & spec.end_on_collision),
            success=memory["done"],
            columns={"metrics.goal_distance": left, "metrics.personal_space": near},
            events=[*reached, *touched],
            ended="collision" if touched and spec.end_on_collision and not reached else "",
        )

    def goals(self, play: WorldRollout) -> Any:
        """Return the goal of the robot of each world (x, z) [W, 2] [m]."""
        return play.extra("goal")

    def moved_goals(self, play: WorldRollout) -> Any:
        """Return the goals (x, z) after a step [W, 2] [m]; by default they do not move."""
        return play.memory["goal"]

    def achieved(self, play: WorldRollout, touching: Any) -> tuple[Any, Any]:
        """Return whether robots have completed their task, and whether their episode has ended, bool [W] each."""
        gap = play.memory["goal"] - play.world.state.agents[0].xz
        arrived = (play.xp.hypot(gap[:, 0], gap[:, 1]) < play.spec.arrive_m) & ~touching
        return arrived, arrived

    def _left(self, play: WorldRollout, goal: Any) -> Any:
        """Return the length of the shortest path to the goal [m], [W]; the straight line where there is none."""
        far, gap = play.path_length(0, goal), goal - play.world.state.agents[0].xz
        return play.xp.where(play.xp.isfinite(far), far, play.xp.hypot(gap[:, 0], gap[:, 1]))
