"""Social navigation in W worlds on a device: `sim_kinematic.tasks.social_nav` as tensor operations.

State, actions and results stay where they are and nothing waits for the device, so on a GPU a whole step with its new
episodes is one CUDA graph. The same episodes with the same actions are those of the CPU, but for what a GPU cannot
search for: the geodesic distance and where it leads are looked up (`h3data_training.torch.geodesic`, lengths mostly within
0.1 %), contact is right to `h3data_training.torch.contact.TOLERANCE_M`; and arms always swing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from h3data.bodies import load_humanoid, load_robot
from h3data.errors import InputError
from h3data_training.torch.contact import TouchTest
from h3data_training.torch.episodes import EpisodeBank
from h3data_training.torch.geodesic import Lattices, shortest_way
from h3data_training.torch.rules import refuse_others
from h3data_training.torch.seen import clearance, shown
from h3data_training.torch.state import HumanTensors, RobotTensors
from h3data_training.torch.step import (
    Grids,
    drive_robots,
    move_humans,
    refuse_stairs,
    walk_humans,
)
from sim_kinematic.avoidance.robot_base import base_of
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.sensing.sensor import facing
from sim_kinematic.sensing.table import FOLLOWER, Pose
from sim_kinematic.tasks.rules.predicates import is_found
from sim_kinematic.tasks.rules.rewards import PaperReward


class Play(NamedTuple):
    """State of W worlds in their episodes."""

    robot: RobotTensors
    human: HumanTensors
    episode: Tensor
    """Number in the bank, int64 [W]."""
    leg: Tensor
    """Number of the way point that the person walks to, int64 [W]."""
    steps: Tensor
    """Steps of the episode so far, int64 [W]."""
    ended: Tensor
    """The episode is over: the next step begins another, bool [W]."""
    found: Tensor
    """The robot has found the person in this episode, bool [W]."""
    followed: Tensor
    """Steps in which it followed the person, int64 [W]."""
    geodesic: Tensor
    """Shortest way between the two [W] [m], inf where there is none."""
    towards: Tensor
    """In which direction (x, z) it begins at the robot, of any length, [W, 2]."""
    collides: Tensor
    """They touch, bool [W]."""
    before_xz: Tensor
    """Place of the robot before the last step, [W, 2]; ``before_heading`` [W]."""
    before_heading: Tensor
    human_before_xz: Tensor
    """Place of the person before the last step, [W, 2]."""
    reward: Tensor
    """Reward of the last step, [W]."""
    terminated: Tensor
    """The rules ended the episode in the last step, bool [W]."""
    truncated: Tensor
    """It had all its steps, bool [W]."""

    @classmethod
    def before_the_first(cls, episode: Tensor, dtype: torch.dtype) -> Play:
        """Worlds whose first step begins the episodes after ``episode`` [W]."""
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
            found=flags(),
            followed=torch.zeros_like(episode),
            geodesic=numbers(),
            towards=numbers(2),
            collides=flags(),
            before_xz=numbers(2),
            before_heading=numbers(),
            human_before_xz=numbers(2),
            reward=numbers(),
            terminated=flags(),
            truncated=flags(),
        )

    def tensors(self) -> Iterator[Tensor]:
        """All of it, in a fixed order."""
        for part in self:
            yield from (part if isinstance(part, tuple) else (part,))


class FollowerContext(NamedTuple):
    """Robots of social navigation in W worlds."""

    play: Play
    grids: Grids
    """Grids of the worlds' floors."""
    height: Tensor
    """Heights of the floors [W] [m]."""

    @property
    def xp(self) -> ModuleType:
        """The array namespace."""
        return torch

    @property
    def now(self) -> RobotTensors:
        """Robots."""
        return self.play.robot

    @property
    def before(self) -> Pose:
        """Robots before the last step."""
        return Pose(self.play.before_xz, self.play.before_heading)

    @property
    def other(self) -> HumanTensors:
        """People."""
        return self.play.human

    @property
    def other_before(self) -> Pose:
        """People before the last step."""
        return Pose(self.play.human_before_xz, None)

    def floor_y(self) -> Tensor:
        """Heights of the floors [W] [m]."""
        return self.height

    def path(self) -> tuple[Tensor, Tensor]:
        """The shortest path to the person: its length [W] [m], and a point in the direction in which it begins [W, 2]."""
        return self.play.geodesic, self.play.robot.xz + self.play.towards

    def clearance(self, points: Tensor) -> Tensor:
        """Signed distance [W, n] [m] of points [W, n, 2] to the nearest obstacle."""
        return clearance(self.grids, points)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Drawn:
    """The bank on the device."""

    place: Tensor
    starts: Tensor
    """Robot's and person's x, z, heading, [N, 6]."""
    way_points: Tensor
    """[N * P, 2]."""
    headings: Tensor | None
    """[N * P] where way points are the person's places after each step."""
    legs: int
    floor_y: Tensor


class SocialNavTensors:
    """W worlds, each in an episode of a bank; when it is over, the next step begins the one after it."""

    def __init__(
        self,
        bank: EpisodeBank,
        *,
        device: torch.device | str,
        dtype: torch.dtype | None = None,
        spec: SocialNavSpec,
        end_on_success: bool = False,
        robot: str = "quad_arm",
        human: str = "female_0",
    ) -> None:
        """``dtype`` of the state: float64 on the CPU, else float32. The reward is the paper's."""
        self.device = torch.device(device)
        self.dtype = dtype or (torch.float64 if self.device.type == "cpu" else torch.float32)
        self.spec, self.bank, self.paper = spec, bank, PaperReward()
        refuse_others("social_nav", spec)
        self._end_on_success = end_on_success
        self._grids = Grids.of(bank.floors, self.device, self.dtype)
        refuse_stairs(bank.floors)
        self._lattices = Lattices.of(bank.floors, self.device, self.dtype)
        body = load_robot(robot)
        self.base = base_of(body, spec.robot)
        self.touch = TouchTest.of(body, load_humanoid(human), spec.human, self.device, self.dtype)

        def on_device(*columns: Any) -> Tensor:
            parts = [torch.as_tensor(c, dtype=self.dtype, device=self.device) for c in columns]
            return torch.cat([p if p.ndim == 2 else p[:, None] for p in parts], 1)

        self._drawn = _Drawn(
            place=torch.as_tensor(bank.place, device=self.device),
            starts=on_device(bank.robot_xz, bank.robot_heading, bank.human_xz, bank.human_heading),
            way_points=on_device(bank.way_points.reshape(-1, 2)),
            headings=None if bank.headings is None else on_device(bank.headings.reshape(-1, 1))[:, 0],
            legs=bank.way_points.shape[1],
            floor_y=on_device([[floor.floor_y] for floor in bank.floors])[:, 0],
        )

    @property
    def action_width(self) -> int:
        """Numbers of an action: 2, or 3 where the robot can move sideways."""
        return 3 if self.spec.robot.max_lateral_mps else 2

    def place_of(self, play: Play) -> Tensor:
        """Number of the scene of the bank that each world is in, [W]."""
        return self._drawn.place[play.episode]

    # --- a step -------------------------------------------------------------------------------------------------------
    def step(self, play: Play, action: Tensor) -> Play:
        """All worlds after ``action`` [W, 2 or 3], those that had ended at the start of their next episode."""
        spec, drawn, fresh = self.spec, self._drawn, play.ended
        episode = torch.where(fresh, (play.episode + 1) % len(self.bank), play.episode)
        place = drawn.place[episode]
        grids, lattices = self._grids.at(place), self._lattices.at(place)
        row = episode * drawn.legs
        if drawn.headings is not None:  # each step has a place of its own
            leg, now = play.leg, row + torch.where(fresh, 0, play.steps).clamp_max(drawn.legs - 1)
            human = move_humans(play.human, drawn.way_points[now], drawn.headings[now], spec.human)
        else:
            gap = drawn.way_points[row + play.leg] - play.human.xz
            arrived = torch.hypot(gap[:, 0], gap[:, 1]) <= spec.human.arrive_m
            leg = torch.where(fresh, 0, (play.leg + arrived).clamp_max(drawn.legs - 1))
            human = walk_humans(play.human, drawn.way_points[row + leg], spec.human)
        robot = drive_robots(grids, play.robot, action, self.base)
        start = drawn.starts[episode]
        zero, begins = start.new_zeros(()), fresh[:, None]
        robot = RobotTensors(
            torch.where(begins, start[:, :2], robot.xz),
            torch.where(fresh, start[:, 2], robot.heading),
            robot.contact & ~fresh,
        )
        human = HumanTensors(
            torch.where(begins, start[:, 3:5], human.xz),
            torch.where(fresh, start[:, 5], human.heading),
            *(torch.where(fresh, zero, t) for t in human[2:]),
        )
        steps = torch.where(fresh, 0, play.steps + 1)
        way = shortest_way(grids, lattices, robot.xz, human.xz)
        return self._judged(
            play,
            play._replace(
                robot=robot,
                human=human,
                episode=episode,
                leg=leg,
                steps=steps,
                geodesic=way.length,
                towards=way.towards,
                collides=self.touch.touching(robot, human),
                before_xz=torch.where(begins, robot.xz, play.robot.xz),
                before_heading=torch.where(fresh, robot.heading, play.robot.heading),
                human_before_xz=torch.where(begins, human.xz, play.human.xz),
            ),
        )

    def _judged(self, before: Play, now: Play) -> Play:
        """With what the step was worth: the paper's reward (`sim_kinematic.tasks.rules.rewards.SocialNavReward`)."""
        rules, going = self.spec, ~before.ended
        faces = facing(now.robot.xz, now.robot.heading, now.human.xz, xp=torch)
        reward, followed, success = self.paper.of(
            self._distance(now), self._distance(before), faces, before.followed, rules, xp=torch
        )
        ends = now.collides if rules.end_on_collision else torch.zeros_like(now.collides)
        terminated = going & ((ends | success) if self._end_on_success else ends)
        truncated = going & (now.steps >= rules.max_steps)
        return now._replace(
            ended=terminated | truncated,
            found=going & (before.found | is_found(now.geodesic, faces, rules)),
            followed=torch.where(going, followed, 0),
            reward=torch.where(going, reward, 0.0),
            terminated=terminated,
            truncated=truncated,
        )

    @staticmethod
    def _distance(play: Play) -> Tensor:
        """Length of the shortest path from robot to person, or the straight distance where there is none, [W] [m]."""
        gap = play.human.xz - play.robot.xz
        return torch.where(play.geodesic.isfinite(), play.geodesic, torch.hypot(gap[:, 0], gap[:, 1]))

    # --- what the robot is shown --------------------------------------------------------------------------------------
    def observations(self, names: Sequence[str], play: Play) -> dict[str, Tensor]:
        """Returns the observations of `sim_kinematic.sensing.table.FOLLOWER`, float32 [W, n] each.

        Raises:
            InputError: there is no such observation on a device.
        """
        if strangers := [name for name in names if name not in FOLLOWER]:
            raise InputError(f"On a device there is no observation {strangers[0]!r}.", code="H3-TRAIN-075")
        place = self._drawn.place[play.episode]
        return shown(FollowerContext(play, self._grids.at(place), self._drawn.floor_y[place]), names)
