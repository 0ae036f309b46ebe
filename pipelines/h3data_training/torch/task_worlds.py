"""Worlds of any task with one robot and one scripted person on a device, as tensor operations.

State, actions and results stay on the device, and no operation waits for it, so that on a GPU a whole step, including
new episodes, is one CUDA graph. The same episodes with the same actions give the same results as on the CPU, with three
exceptions. Lengths and directions of paths are looked up (`h3data_training.torch.geodesic`, lengths mostly within
0.1%), contact is accurate to `h3data_training.torch.contact.TOLERANCE_M`, and arms always swing.

The rules are those of the task: `Task.begin`, `Task.judge` and its sensors are called with tensors, in the namespace
``play.xp`` or ``moment.xp``.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, is_dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from h3data.bodies import load_humanoid, load_robot
from h3data.errors import H3DataError, InputError
from h3data_training.torch.contact import TouchTest
from h3data_training.torch.cycle import WalkingCycle
from h3data_training.torch.episodes import EpisodeBank
from h3data_training.torch.geodesic import Lattices, ShortestPath, shortest_path
from h3data_training.torch.rules import refuse_others
from h3data_training.torch.seen import clearance, free_along
from h3data_training.torch.state import HumanTensors, RobotTensors, choose, tensors_of
from h3data_training.torch.step import Grids, drive_robots, heading_direction, move_humans, refuse_stairs, walk_humans
from sim_kinematic.agents.roster import AgentSpec, make_roster
from sim_kinematic.avoidance.robot_base import base_of
from sim_kinematic.contact.outlines import legs_at, shins
from sim_kinematic.motion.spec import PersonContact
from sim_kinematic.motion.state import ROBOT
from sim_kinematic.sensing.sensor import in_base_frame
from sim_kinematic.sensing.table import Pose, SensorContext, sensed
from sim_kinematic.tasks.control import resting_arm
from sim_kinematic.tasks.rearrange.episode import PAIR
from sim_kinematic.tasks.task import Task


class Play(NamedTuple):
    """State of W worlds within their episodes."""

    robot: RobotTensors
    human: HumanTensors
    """The person, or P people of a crowd, whose tensors are [P, W, ...]."""
    episode: Tensor
    """Number of the episode in the bank, int64 [W]."""
    leg: Tensor
    """Number of the waypoint to which the person walks, int64 [W]."""
    steps: Tensor
    """Number of steps of the episode so far, int64 [W]."""
    ended: Tensor
    """True if the episode is over, so that the next step starts another, bool [W]."""
    memory: Mapping[str, Tensor]
    """Values that the task stores between steps, [W, ...] each, and ``success`` of the last step."""
    collides: Tensor
    """True if the robot touches a person, bool [W]."""
    before_xz: Tensor
    """Position of the robot before the last step, [W, 2] [m]; ``before_heading`` [W] [rad]."""
    before_heading: Tensor
    human_before_xz: Tensor
    """Position of the person before the last step, [W, 2] [m], or of the people of a crowd."""
    reward: Tensor
    """Reward of the last step, [W]."""
    terminated: Tensor
    """True if the rules ended the episode in the last step, bool [W]."""
    truncated: Tensor
    """True if the episode reached its time limit, bool [W]."""
    crowd: tuple[Tensor, ...] = ()
    """Further state of the people of a crowd (`h3data_training.torch.crowd.people.CrowdTensors`)."""

    @classmethod
    def before_the_first(cls, episode: Tensor, dtype: torch.dtype, memory: Mapping[str, Tensor]) -> Play:
        """Return worlds whose first step starts the episodes after ``episode`` [W]."""
        worlds, device = len(episode), episode.device

        def numbers(*axes: int) -> Tensor:
            return torch.zeros((worlds, *axes), dtype=dtype, device=device)

        def flags() -> Tensor:
            return torch.zeros(worlds, dtype=torch.bool, device=device)

        return cls(
            robot=RobotTensors(numbers(2), numbers(), flags()),
            human=HumanTensors(numbers(2), numbers(), numbers(), numbers(), numbers()),
            episode=episode.clone(),
            leg=torch.zeros_like(episode),
            steps=torch.zeros_like(episode),
            ended=~flags(),
            memory=memory,
            collides=flags(),
            before_xz=numbers(2),
            before_heading=numbers(),
            human_before_xz=numbers(2),
            reward=numbers(),
            terminated=flags(),
            truncated=flags(),
        )

    def tensors(self) -> Iterator[Tensor]:
        """Return all tensors of the state, in a fixed order."""
        return tensors_of(self)


class Agents(NamedTuple):
    """Agents of all worlds at one step, without objects."""

    agents: tuple[Any, ...]
    """State of the robot, then of people; each has ``xz`` and ``heading``."""
    held_by: Tensor | None = None
    """Holders of objects: an empty array [W, 0]."""

    @property
    def people(self) -> tuple[Any, ...]:
        """State of each person."""
        return self.agents[1:]


@dataclass(frozen=True, eq=False)
class Outlines:
    """Outlines of robot and person on the floor, as laser scanners see them."""

    offsets: Tensor
    """Positions of the discs of the robot's base along its axis, [D] [m]."""
    robot_m: float
    """Radius of the robot's discs [m]."""
    human_m: float
    """Radius of the disc of the person [m]."""
    cycle: WalkingCycle
    legs: Tensor
    """Centres of the person's legs in the frame of the root, as a table of the ``cycle``, [rows, 2, 2] [m]."""


class TensorWorld(NamedTuple):
    """Part of a `sim_kinematic.world.World` that tasks and sensors read on a device."""

    worlds: int
    state: Agents
    before: Agents
    """World one step ago; headings of people are not known."""
    start: Agents
    roster: Sequence[AgentSpec]
    """Agents of every world, the robot first."""
    touching: Tensor
    """True for `pairs` that touch, bool [W, P]."""
    floor_y: Tensor
    """Height of the floor in each world [m], [W]."""
    grids: Grids
    """Grids of the worlds' floors."""
    outlines: Outlines
    """Outlines of the agents on the floor."""

    @property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Pairs of agents whose contact is known: the robot and each of P people."""
        return tuple((ROBOT, person) for person in range(1, len(self.roster)))

    def heights(self, xz: Tensor) -> Tensor:
        """Return heights of the floor at positions, [W] [m], which are constant because floors are level."""
        return self.floor_y

    def clearance(self, points: Tensor) -> Tensor:
        """Return the signed distance [W, n] [m] of points [W, n, 2] to the nearest obstacle."""
        return clearance(self.grids, points)

    def free_along(self, xz: Tensor, headings: Tensor, max_m: float) -> Tensor:
        """Return the distance [W, R] [m] from places [W, 2] along headings [W, R] [rad] to the nearest obstacle.

        It is at most ``max_m``.
        """
        return free_along(self.grids, xz, headings, max_m)

    def circles(self, agent: int, *, legs: bool = False) -> Tensor:
        """Return the other agents as circles ``(x, z, radius)`` [W, N, 3] [m] (`sim_kinematic.world.World.circles`)."""
        circles = []
        for number, own in enumerate(self.state.agents):
            if number == agent:
                continue
            if number != ROBOT and legs:
                shins = self.outlines.cycle.look_up(self.outlines.legs, own)
                circles.append(legs_at(torch, own.xz, own.heading, shins))
                continue
            xz, radius_m = own.xz[:, None], self.outlines.human_m
            if number == ROBOT:
                ahead = heading_direction(own.heading)[:, None] * self.outlines.offsets[:, None]
                xz, radius_m = xz + ahead, self.outlines.robot_m
            circles.append(torch.cat([xz, torch.full_like(xz[..., :1], radius_m)], -1))
        return torch.cat(circles, 1) if circles else self.floor_y.new_zeros((self.worlds, 0, 3))

    def in_root_frame(self, own: Any, points: Tensor) -> Tensor:
        """Transform world points [W, n, 3] [m] into the agent root frames of given agents."""
        seen = in_base_frame(own.xz[:, None], own.heading[:, None], points[..., 0:3:2], xp=torch)
        return torch.stack([seen[..., 0], points[..., 1] - self.floor_y[:, None], -seen[..., 1]], -1)


class TensorRollout:
    """Part of a `sim_kinematic.tasks.play.WorldRollout` that a task reads on a device."""

    xp = torch

    def __init__(self, sim: TaskTensors, now: Play, memory: Any) -> None:
        """Create a rollout; ``memory`` has the values that the task stores between steps, [W, ...] each."""
        self._sim, self._now = sim, now
        self.spec, self.steps, self.world, self.memory = sim.spec, now.steps, sim.world(now), memory

    def extra(self, name: str) -> Tensor:
        """Return an entry of `Episode.extra` of every world, [W, ...]."""
        return self._sim.extra(name)[self._now.episode]

    def path_length(self, agent: int, points: Tensor) -> Tensor:
        """Return the shortest path lengths from an agent to points [W, 2], [W] [m]; infinite if there is no path."""
        return self._sim.path_between(self._now, self.world.state.agents[agent].xz, points).length

    def events_where(self, flags: Tensor, kind: str, *, agent: int = -1, target: str = "") -> tuple[()]:
        """Return no events, because nothing is recorded on a device."""
        return ()


class TaskTensors:
    """W worlds, each in an episode of a bank, which start the following episode in the step after the end of one."""

    def __init__(
        self,
        bank: EpisodeBank,
        *,
        task: Task,
        device: torch.device | str,
        dtype: torch.dtype | None = None,
        spec: Any,
        end_on_success: bool = False,
        robot: str = "quad_arm",
        human: str = "female_0",
    ) -> None:
        """Create the worlds; ``dtype`` of the state is by default float64 on the CPU and float32 on other devices.

        Raises:
            InputError: a device does not support the rules, or a home has stairs.
        """
        self.device = torch.device(device)
        self.dtype = dtype or (torch.float64 if self.device.type == "cpu" else torch.float32)
        self.task, self.spec, self.bank = task, spec, bank
        self.roster = make_roster(PAIR, robot=robot, human=human)
        refuse_others(task.name, spec)
        self._end_on_success = end_on_success
        self._grids = Grids.of(bank.floors, self.device, self.dtype)
        refuse_stairs(bank.floors)
        self._lattices = Lattices.of(bank.floors, self.device, self.dtype)
        body = load_robot(robot)
        self.base = base_of(body, spec.robot)
        contact: PersonContact = spec.person_contact if hasattr(spec, "person_contact") else "body"
        self.touch = TouchTest.of(
            body, load_humanoid(human), spec.human, self.device, self.dtype, person_contact=contact
        )
        cycle = self.touch.cycle
        self._outlines = Outlines(
            torch.as_tensor(self.base.disc_offsets_m, dtype=self.dtype, device=self.device),
            self.base.disc_radius_m,
            spec.agent_radius_m,
            cycle,
            torch.as_tensor(shins(cycle.joint_matrices()), dtype=self.dtype, device=self.device),
        )

        def on_device(*columns: Any) -> Tensor:
            parts = [torch.as_tensor(c, dtype=self.dtype, device=self.device) for c in columns]
            return torch.cat([p if p.ndim == 2 else p[:, None] for p in parts], 1)

        self.arm = on_device(resting_arm(body)[None])
        """Resting positions of the robot's arm joints, [1, n]."""
        self._place = torch.as_tensor(bank.place, device=self.device)
        self._starts = torch.as_tensor(bank.starts, dtype=self.dtype, device=self.device)
        self._take_people(bank)
        self._floor_y = on_device([[floor.floor_y] for floor in bank.floors])[:, 0]
        self._extra = {
            name: torch.as_tensor(rows, device=self.device, dtype=self.dtype if rows.dtype.kind == "f" else None)
            for name, rows in bank.extra.items()
        }

    def _take_people(self, bank: Any) -> None:
        """Copy to the device how people walk in the episodes of the bank."""
        self._way_points = torch.as_tensor(bank.way_points.reshape(-1, 2), dtype=self.dtype, device=self.device)
        self._headings = None
        if bank.headings is not None:
            self._headings = torch.as_tensor(bank.headings.reshape(-1), dtype=self.dtype, device=self.device)

    @property
    def action_width(self) -> int:
        """Number of values of an action: 2, or 3 if the robot can move sideways."""
        return 3 if self.spec.robot.max_lateral_mps else 2

    def place_of(self, play: Play) -> Tensor:
        """Return the number of the scene of the bank that each world is in, [W]."""
        return self._place[play.episode]

    def world(self, play: Play) -> TensorWorld:
        """Return the agents and floors as a `TensorWorld`."""
        start, place = self._starts[play.episode], self.place_of(play)
        return TensorWorld(
            worlds=len(play.steps),
            state=Agents((play.robot, *self._each(play.human)), play.steps.new_empty((len(play.steps), 0))),
            before=Agents((Pose(play.before_xz, play.before_heading), *self._each(Pose(play.human_before_xz, None)))),
            start=Agents(tuple(Pose(place[:, :2], place[:, 2]) for place in start.unbind(1))),
            roster=self.roster,
            touching=self._touching(play),
            floor_y=self._floor_y[place],
            grids=self._grids.at(place),
            outlines=self._outlines,
        )

    def _each(self, people: Any) -> tuple[Any, ...]:
        """Return the state or pose of each person of all worlds."""
        return (people,)

    def _touching(self, play: Play) -> Tensor:
        """Return whether the robot touches each person, bool [W, P]."""
        return play.collides[:, None]

    def path_between(self, play: Play, start: Tensor, end: Tensor) -> ShortestPath:
        """Return the shortest paths between points [W, 2]."""
        place = self.place_of(play)
        return shortest_path(self._grids.at(place), self._lattices.at(place), start, end)

    def path_to_person(self, play: Play) -> ShortestPath:
        """Return the shortest paths from robots to people."""
        return self.path_between(play, play.robot.xz, play.human.xz)

    def extra(self, name: str) -> Tensor:
        """Return an entry of `Episode.extra` of all episodes of the bank, [N, ...].

        Raises:
            InputError: the episodes have no numerical entry of this name.
        """
        if name not in self._extra:
            there = ", ".join(self._extra) or "none"
            raise InputError(
                f"Episodes of {self.task.name} have no {name!r} in Episode.extra that is an array of one shape in all of "
                f"them; there are: {there}.",
                code="H3-ENV-039",
            )
        return self._extra[name]

    # --- a step -------------------------------------------------------------------------------------------------------
    def before_the_first(self, episode: Tensor) -> Play:
        """Return worlds whose first step begins the episodes after ``episode`` [W]."""
        play = self._blank(episode.to(self.device))
        return play._replace(memory={name: torch.zeros_like(t) for name, t in self._begun(play).items()})

    def _blank(self, episode: Tensor) -> Play:
        """Return worlds whose first step begins the episodes after ``episode`` [W], without the task's memory."""
        return Play.before_the_first(episode, self.dtype, {})

    def step(self, play: Play, action: Tensor) -> Play:
        """Return all worlds after ``action`` [W, 2 or 3]; worlds that had ended are at the start of their next episode."""
        spec, fresh = self.spec, play.ended
        episode = torch.where(fresh, (play.episode + 1) % len(self.bank), play.episode)
        robot = drive_robots(self._grids.at(self._place[episode]), play.robot, action, self.base)
        start, begins = self._starts[episode], fresh[:, None]
        robot = RobotTensors(
            torch.where(begins, start[:, 0, :2], robot.xz),
            torch.where(fresh, start[:, 0, 2], robot.heading),
            robot.contact & ~fresh,
        )
        moved = self._with_people(play, episode, robot)
        moved = moved._replace(
            robot=robot,
            episode=episode,
            steps=torch.where(fresh, 0, play.steps + 1),
            before_xz=torch.where(begins, robot.xz, play.robot.xz),
            before_heading=torch.where(fresh, robot.heading, play.robot.heading),
            human_before_xz=torch.where(begins, moved.human.xz, play.human.xz),
        )
        outcome, memory = self._judged(moved, fresh)
        going = ~fresh
        ends = outcome.terminated | outcome.success if self._end_on_success else outcome.terminated
        terminated, truncated = going & ends, going & (moved.steps >= spec.max_steps)
        return moved._replace(
            memory=memory,
            ended=terminated | truncated,
            reward=torch.where(going, outcome.reward, 0.0),
            terminated=terminated,
            truncated=truncated,
        )

    def _with_people(self, play: Play, episode: Tensor, robot: RobotTensors) -> Play:
        """Return the state with people after the step, and their contacts with the ``robot`` there.

        Where an episode begins, which is the one with the number ``episode`` [W], people are at their starts.
        """
        spec, fresh, legs = self.spec, play.ended, self.bank.way_points.shape[1]
        row = episode * legs
        if self._headings is not None:  # each step has a place of its own
            leg, now = play.leg, row + torch.where(fresh, 0, play.steps).clamp_max(legs - 1)
            human = move_humans(play.human, self._way_points[now], self._headings[now], spec.human)
        else:
            gap = self._way_points[row + play.leg] - play.human.xz
            arrived = torch.hypot(gap[:, 0], gap[:, 1]) <= spec.human.arrive_m
            leg = torch.where(fresh, 0, (play.leg + arrived).clamp_max(legs - 1))
            human = walk_humans(play.human, self._way_points[row + leg], spec.human)
        human = human.begun(self._starts[episode][:, 1], fresh)
        return play._replace(human=human, leg=leg, collides=self.touch.touching(robot, human))

    def _begun(self, play: Play) -> dict[str, Tensor]:
        """Return the memory that the task would have if all worlds began in their present state."""
        begun = self.task.begin(TensorRollout(self, play, None), torch.arange(len(play.steps), device=self.device))  # type: ignore[arg-type]
        return {
            "success": play.steps < 0,
            **{name: typed(values, self.dtype) for name, values in (begun or {}).items()},
        }

    def succeeded(self, play: Play) -> Tensor:
        """Return the worlds whose last step was judged a success, bool [W]."""
        return play.memory["success"]

    def _judged(self, now: Play, fresh: Tensor) -> tuple[Any, dict[str, Tensor]]:
        """Return outcome of the step and the task's memory after it; worlds that are ``fresh`` [W] have just begun."""
        begun = self._begun(now)
        memory = {name: choose(fresh, values, now.memory[name]) for name, values in begun.items()}
        rollout = TensorRollout(self, now._replace(memory=memory), dict(memory))
        outcome: Any = self.task.judge(rollout)  # type: ignore[arg-type]
        outcome = replace(outcome, reward=typed(outcome.reward, self.dtype))
        after = {name: typed(rollout.memory[name], self.dtype) for name in begun} | {"success": outcome.success}
        return outcome, {name: choose(fresh, values, after[name]) for name, values in begun.items()}

    # --- what the robot is shown --------------------------------------------------------------------------------------
    def context(self, play: Play) -> SensorContext:
        """Return the context from which the robot's sensors compute observations."""
        world: Any = self.world(play)

        def path(points: Tensor | None = None) -> tuple[Tensor, Tensor]:
            way = self.path_to_person(play) if points is None else self.path_between(play, play.robot.xz, points)
            return way.length, play.robot.xz + way.towards

        # a robot alone has no sensors of others
        (now, other, *_), (before, other_before, *_), (start, *_) = (
            (*at.agents, None) for at in (world.state, world.before, world.start)
        )
        arm: Any = self.arm.expand(world.worlds, -1)
        touched: Any = (play.robot.contact, play.collides)
        agents = now, before, start, other, other_before
        return SensorContext(self.spec, self.base, play.memory, (), world, ROBOT, *agents, *touched, arm, path, torch)  # type: ignore[arg-type]

    def observations(self, names: Sequence[str], play: Play) -> dict[str, Tensor]:
        """Return the sensors of the robot by name, float32 [W, n] each."""
        sensors, moment = self.task.sensors, self.context(play)
        return {name: sensed(name, sensors[name], moment, self.task.name, "robot").float() for name in names}

    # --- whether the task is for arrays of any namespace --------------------------------------------------------------
    def check_functions(self, names: Sequence[str], worlds: int = 2) -> None:
        """Call `Task.begin`, `Task.judge` and the named sensors with tensors without data.

        Functions fail if they wait for the device, or need NumPy or features that no device has.

        Raises:
            InputError: a function fails; the message names the task and the function or sensor.
        """
        sim, who = on_meta(copy.copy(self)), self.task.name
        sim.device = torch.device("meta")
        blank = sim._blank(torch.zeros(worlds, dtype=torch.int64, device="meta"))
        with in_words(f"{who}: the function begin"):
            rollout = TensorRollout(sim, blank, None)
            begun = self.task.begin(rollout, torch.arange(worlds, device="meta"))  # type: ignore[arg-type]
            if begun is None and rollout.memory is not None:
                raise TypeError("it sets play.memory, and must return it: arrays [W, ...] by name")
            require_tensors(begun or {}, worlds)
        play = blank._replace(memory=sim._begun(blank))
        with in_words(f"{who}: the function judge"):
            rollout = TensorRollout(sim, play, dict(play.memory))
            outcome = self.task.judge(rollout)  # type: ignore[arg-type]
            flags = {name: getattr(outcome, name) for name in ("terminated", "success")}
            require_tensors({"reward": outcome.reward, **flags, **rollout.memory}, worlds)
            if strange := set(rollout.memory) ^ set(play.memory):
                raise TypeError(f"begin and judge must remember the same; {', '.join(sorted(strange))} differ")
        for name in names:
            with in_words(f"{who}: the sensor {name} of robot"):
                sensor = self.task.sensors[name]
                require_tensors({"it": sensed(name, sensor, sim.context(play), who, "robot")}, worlds)


def typed(values: Any, dtype: torch.dtype) -> Tensor:
    """Return a tensor of numbers, converted to the floating-point type of the state."""
    return values.to(dtype) if isinstance(values, Tensor) and values.is_floating_point() else values


def require_tensors(values: Mapping[str, Any], worlds: int) -> None:
    """Raise a TypeError for a value that is not a tensor without data with one row for each world."""
    for name, value in values.items():
        if not isinstance(value, Tensor):
            raise TypeError(f"{name} must be a torch tensor, got {type(value).__name__}")
        if value.device.type != "meta" or value.shape[:1] != (worlds,):
            raise TypeError(f"{name} must have a row for each world and follow from the state of the worlds")


@contextmanager
def in_words(which: str) -> Iterator[None]:
    """Turn errors of a task's function within a block into one sentence."""
    try:
        yield
    except H3DataError:
        raise
    except Exception as fault:
        says = str(fault).splitlines()[0] if str(fault) else type(fault).__name__
        raise InputError(
            f"On a device, {which} must compute with play.xp or moment.xp, which is torch there, without NumPy and without "
            f"asking for values: {says}.",
            code="H3-ENV-040",
        ) from fault


def on_meta(thing: Any) -> Any:
    """Return a copy of an object whose tensors have no data (device ``meta``), also those in nested dataclasses."""
    for name, value in vars(thing).items():
        if isinstance(value, Tensor):
            object.__setattr__(thing, name, value.to("meta"))
        elif isinstance(value, dict) and any(isinstance(v, Tensor) for v in value.values()):
            object.__setattr__(thing, name, {key: v.to("meta") for key, v in value.items()})
        elif is_dataclass(value) and any(isinstance(v, Tensor) for v in vars(value).values()):
            object.__setattr__(thing, name, on_meta(copy.copy(value)))
    return thing
