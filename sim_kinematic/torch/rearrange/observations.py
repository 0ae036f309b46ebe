"""What agents are shown on a device: the numbers of `sim_kinematic.policies.rearrange_observations`, by the same names."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from h3data.errors import InputError
from sim_kinematic.motion.spec import STEP_S
from sim_kinematic.policies.rearrange_observations import AHEAD_M, NEARER_M
from sim_kinematic.sensing.sensor import FAR_M
from sim_kinematic.tasks.rearrange.play import TRACK
from sim_kinematic.torch.rearrange.bank import FLOOR
from sim_kinematic.torch.rearrange.skills import Choices, Hands, every_choice, one_of, precondition
from sim_kinematic.torch.rearrange.state import ABORTED, DONE, FAILED, NOBODY, Errand, Play
from sim_kinematic.torch.rearrange.tables import Places
from sim_kinematic.torch.rearrange.worlds import RearrangeTensors
from sim_kinematic.torch.step import heading_direction, wrap_angle


class View(NamedTuple):
    """What one agent of each world may know."""

    sim: RearrangeTensors
    play: Play
    places: Places
    choices: Choices
    does: Errand
    xz: Tensor
    heading: Tensor
    other: Tensor
    """Where the other is, [W, 2]."""
    contact: Tensor

    @classmethod
    def of(cls, sim: RearrangeTensors, play: Play, agent: str) -> View:
        """Of ``robot`` or ``human``."""
        own, other = (play.robot, play.human) if agent == "robot" else (play.human, play.robot)
        is_robot = agent == "robot"
        return cls(
            sim=sim, play=play, places=sim.tables.at(play.episode), choices=sim.choices(agent),
            does=play.robot_does if is_robot else play.human_does, xz=own.xz, heading=own.heading, other=other.xz,
            contact=play.robot.contact if is_robot else torch.zeros_like(play.robot.contact),
        )  # fmt: skip

    @property
    def who(self) -> int:
        return self.choices.who

    @property
    def hands(self) -> Hands:
        return Hands(self.play.objects, self.play.held_by, self.play.moved, self.play.placed_by)

    @property
    def close(self) -> Tensor:
        return self.sim.close(self.xz, self.heading, self.other)

    def spots(self, at_goal: int) -> Tensor:
        """Floor points of objects' starts (0) or goals (1), [W, K, 2]."""
        k = self.sim.bank.objects
        return self.sim.tables.spots[self.play.episode, at_goal * k : (at_goal + 1) * k, 0::2]

    def gps(self, points: Tensor) -> Tensor:
        """Distance and angle, positive to the right, of points [W, n, 2]: [W, 2 n]."""
        gap, ahead = points - self.xz[:, None], heading_direction(self.heading)[:, None]
        forward = (gap * ahead).sum(-1)
        left = gap[..., 0] * ahead[..., 1] - gap[..., 1] * ahead[..., 0]
        return torch.stack([torch.hypot(forward, left), -torch.atan2(left, forward)], -1).flatten(1)

    def ways(self, xz: Tensor) -> tuple[Tensor, Tensor]:
        """Lengths [W, K] [m] of the shortest ways from points [W, 2] to where objects are, and to their goals. To one that is
        held it is the straight distance: no table leads to an agent."""
        play, count = self.play, self.sim.bank.objects
        lengths = self.places.lengths(xz).clamp_max(FAR_M)
        gap = play.objects[..., 0::2] - xz[:, None]
        lies = torch.where(play.moved, lengths[:, count:], lengths[:, :count])
        held = play.held_by != NOBODY
        return torch.where(held, torch.hypot(gap[..., 0], gap[..., 1]), lies), lengths[:, count:]

    def approach(self) -> Tensor:
        """How much shorter the other's way to each object has become over their known track, [W, K] [m]."""
        row = torch.where(self.play.steps >= TRACK - 1, (self.play.steps + 1) % TRACK, 0)
        them = 1 - self.who
        then = self.play.track[torch.arange(len(row), device=row.device), row, them]
        return (self.ways(then)[0] - self.ways(self.other)[0]).clamp(-NEARER_M, NEARER_M)

    def path_ahead(self, who: int) -> Tensor:
        """Where agent ``who`` would be `AHEAD_M` further on, on the way to each object or with it to its goal, as this one sees
        it, [W, K * 4]."""
        play, count = self.play, self.sim.bank.objects
        xz = (self.xz if who == self.who else self.other)[:, None].expand(-1, count, -1)
        own, lies = play.held_by == who, play.held_by == NOBODY
        number = torch.arange(count, device=xz.device)
        field = 2 * FLOOR * count + number + count * (own | play.moved)
        gap = play.objects[..., 0::2] - xz
        away = torch.hypot(gap[..., 0], gap[..., 1]).clamp_min(1e-9)
        straight = torch.stack([xz + gap * (length / away).clamp_max(1.0)[..., None] for length in AHEAD_M], -2)
        points = torch.where((own | lies)[..., None, None], self.places.along(field, xz, AHEAD_M), straight)
        return self.gps(points.flatten(1, 2))

    def other_velocity(self) -> Tensor:
        """Of the other agent over the ground, along the axes of this one, [W, 2] [m/s]."""
        moved, ahead = self.other - self.play.before[:, 1 - self.who, :2], heading_direction(self.heading)
        forward = (moved * ahead).sum(-1)
        return torch.stack([forward, moved[:, 0] * ahead[:, 1] - moved[:, 1] * ahead[:, 0]], -1) / STEP_S

    def ended(self, outcome: int) -> Tensor:
        """One of the choices is 1: the last one, if it ended so, [W, C]."""
        return one_of(self.does.last, len(self.choices)) & (self.does.outcome == outcome)[:, None]

    def allowed(self) -> Tensor:
        """Which choices the agent's hand allows, bool [W, C] (`sim_kinematic.agents.skills.Objects.why_not`)."""
        return precondition(self.choices, every_choice(self.choices, len(self.xz)), self.hands)

    def egomotion(self) -> Tensor:
        before = self.play.before[:, self.who]
        moved, ahead = self.xz - before[:, :2], heading_direction(before[:, 2])
        forward = (moved * ahead).sum(-1)
        left = moved[:, 0] * ahead[:, 1] - moved[:, 1] * ahead[:, 0]
        return torch.stack([forward, left, wrap_angle(self.heading - before[:, 2])], -1) / STEP_S

    def localization(self) -> Tensor:
        floor_y = self.sim.tables.floor_y[self.places.place]
        return torch.stack([self.xz[:, 0], floor_y, self.xz[:, 1], wrap_angle(self.heading)], -1)


def _other_gps(v: View) -> Tensor:
    return v.gps(v.other[:, None])


OBSERVED: Mapping[str, Callable[[View], Tensor]] = {
    "is_holding": lambda v: (v.play.held_by == v.who).any(1, keepdim=True),
    "obj_start_gps_compass": lambda v: v.gps(v.spots(0)),
    "obj_goal_gps_compass": lambda v: v.gps(v.spots(1)),
    "obj_gps_compass": lambda v: v.gps(v.play.objects[..., 0::2]),
    "holds": lambda v: v.play.held_by == v.who,
    "held_by_other": lambda v: (v.play.held_by != v.who) & (v.play.held_by != NOBODY),
    "at_goal": lambda v: v.sim.at_goal(v.hands, v.places),
    "other_gps_compass": _other_gps,
    "humanoid_gps": _other_gps,
    "other_agent_gps": lambda v: v.xz - v.other,
    "close": lambda v: v.close[:, None],
    "localization": View.localization,
    "egomotion": View.egomotion,
    "collision": lambda v: torch.stack([v.contact, v.play.collides], -1),
    "last_done": lambda v: v.ended(DONE),
    "last_failed": lambda v: v.ended(FAILED),
    "interrupted": lambda v: v.ended(ABORTED),
    "way_to_objects": lambda v: v.ways(v.xz)[0],
    "way_to_goals": lambda v: v.ways(v.xz)[1],
    "other_way_to_objects": lambda v: v.ways(v.other)[0],
    "other_way_to_goals": lambda v: v.ways(v.other)[1],
    "other_approach": View.approach,
    "path_ahead": lambda v: v.path_ahead(v.who),
    "other_path_ahead": lambda v: v.path_ahead(1 - v.who),
    "other_velocity": View.other_velocity,
    "elapsed_s": lambda v: v.play.steps[:, None] * STEP_S,
}
"""By name, [W, n]."""


def checked_observations(names: tuple[str, ...]) -> tuple[str, ...]:
    """The names, each once.

    Raises:
        InputError: a device does not show one of them.
    """
    unknown = [name for name in names if name not in OBSERVED]
    if unknown or not names:
        raise InputError(f"On a device there are {', '.join(OBSERVED)}, got {unknown or 'none'}.")
    return tuple(dict.fromkeys(names))


def observed(view: View, names: tuple[str, ...]) -> dict[str, Tensor]:
    """The named observations, each float32 [W, n]."""
    return {name: OBSERVED[name](view).float() for name in names}
