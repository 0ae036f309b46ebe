"""Observations on a device: the numbers of `sim_kinematic.policies.rearrange_observations`, by the same names."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from h3data.errors import InputError
from h3data_training.torch.rearrange.bank import FLOOR
from h3data_training.torch.rearrange.skills import Choices, Hands, every_choice, one_of, precondition
from h3data_training.torch.rearrange.state import ABORTED, DONE, FAILED, NOBODY, Play, SubGoal
from h3data_training.torch.rearrange.tables import Places
from h3data_training.torch.rearrange.worlds import RearrangeTensors
from h3data_training.torch.step import heading_direction, wrap_angle
from sim_kinematic.motion.spec import STEP_S
from sim_kinematic.policies.rearrange_observations import AHEAD_M, NEARER_M
from sim_kinematic.sensing.sensor import FAR_M
from sim_kinematic.tasks.rearrange.play import TRACK

THEN = 1
"""A second ago, of the two moments of `Paths`; 0 is now."""


class Paths(NamedTuple):
    """Shortest paths of both agents, robot and person, which both are shown."""

    xz: Tensor
    """Positions of both agents now and a second ago, [W, 2, 2, 2] [m]."""
    lengths: Tensor
    """Lengths of the paths from these positions to the floor below starts and goals, [W, 2, 2, 2 K] [m]."""
    ahead: Tensor
    """Where each would be `AHEAD_M` further on, on the way to each object or, with what they hold, to its goal,
    [W, 2, K, n, 2]: to what is in the other's hand the way is straight."""

    @classmethod
    def of(cls, sim: RearrangeTensors, play: Play, places: Places) -> Paths:
        """Shortest paths of both agents, from their positions now and `THEN` steps ago."""
        now = torch.stack([play.robot.xz, play.human.xz], 1)
        row = torch.where(play.steps >= TRACK - 1, (play.steps + 1) % TRACK, 0)
        then = play.track[torch.arange(len(row), device=row.device), row]
        xz = torch.stack([now, then], 2)
        return cls(xz, places.lengths(xz).clamp_max(FAR_M), cls._ahead(sim, play, places, now))

    @staticmethod
    def _ahead(sim: RearrangeTensors, play: Play, places: Places, now: Tensor) -> Tensor:
        count = sim.bank.objects
        own = play.held_by[:, None] == torch.arange(2, device=now.device)[:, None]
        field = 2 * FLOOR * count + torch.arange(count, device=now.device) + count * (own | play.moved[:, None])
        xz = now[:, :, None].expand(-1, -1, count, -1)
        gap = play.objects[:, None, :, 0::2] - xz
        away = torch.hypot(gap[..., 0], gap[..., 1]).clamp_min(1e-9)
        straight = torch.stack([xz + gap * (length / away).clamp_max(1.0)[..., None] for length in AHEAD_M], -2)
        leads = own | (play.held_by == NOBODY)[:, None]
        return torch.where(leads[..., None, None], places.along(field, xz, AHEAD_M), straight)


class View(NamedTuple):
    """Everything that one agent of each world may know."""

    sim: RearrangeTensors
    play: Play
    places: Places
    choices: Choices
    does: SubGoal
    xz: Tensor
    heading: Tensor
    other: Tensor
    """Where the other is, [W, 2]."""
    contact: Tensor
    paths: Paths | None = None

    @classmethod
    def of(cls, sim: RearrangeTensors, play: Play, agent: str, paths: Paths | None = None) -> View:
        """The view of the ``robot`` or the ``human``; without ``paths`` `observed` looks them up."""
        own, other = (play.robot, play.human) if agent == "robot" else (play.human, play.robot)
        is_robot = agent == "robot"
        return cls(
            sim=sim, play=play, places=sim.tables.at(play.episode), choices=sim.choices(agent),
            does=play.robot_does if is_robot else play.human_does, xz=own.xz, heading=own.heading, other=other.xz,
            contact=play.robot.contact if is_robot else torch.zeros_like(play.robot.contact), paths=paths,
        )  # fmt: skip

    @property
    def who(self) -> int:
        """Number of the agent: robot 0, person 1."""
        return self.choices.who

    @property
    def known_paths(self) -> Paths:
        """Shortest paths of both agents, which must have been looked up."""
        assert self.paths is not None, "`observed` looks them up once for all observations"
        return self.paths

    @property
    def hands(self) -> Hands:
        """Objects and who holds, moved or placed them."""
        return Hands(self.play.objects, self.play.held_by, self.play.moved, self.play.placed_by)

    @property
    def close(self) -> Tensor:
        """Whether the other agent is close, bool [W]."""
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

    def ways(self, who: int, when: int = 0) -> tuple[Tensor, Tensor]:
        """Lengths of the shortest paths from agent ``who`` to the objects and to their goals, [W, K] [m] each.

        ``when`` is 0 for the agent's present position, 1 for the one `THEN` steps ago. The length to an object that is
        held is the straight distance, as tables have no paths to agents.
        """
        play, count, paths = self.play, self.sim.bank.objects, self.known_paths
        lengths = paths.lengths[:, who, when]
        gap = play.objects[..., 0::2] - paths.xz[:, who, when, None]
        lies = torch.where(play.moved, lengths[:, count:], lengths[:, :count])
        held = play.held_by != NOBODY
        return torch.where(held, torch.hypot(gap[..., 0], gap[..., 1]), lies), lengths[:, count:]

    def approach(self) -> Tensor:
        """How much shorter the other's way to each object has become over their known track, [W, K] [m]."""
        them = 1 - self.who
        return (self.ways(them, THEN)[0] - self.ways(them)[0]).clamp(-NEARER_M, NEARER_M)

    def path_ahead(self, who: int) -> Tensor:
        """Where agent ``who`` would be `AHEAD_M` further on, as this one sees it (`Paths.ahead`), [W, K * 4]."""
        return self.gps(self.known_paths.ahead[:, who].flatten(1, 2))

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
        """Forward velocity, left velocity and turn rate in the last step, [W, 3] [m/s, rad/s]."""
        before = self.play.before[:, self.who]
        moved, ahead = self.xz - before[:, :2], heading_direction(before[:, 2])
        forward = (moved * ahead).sum(-1)
        left = moved[:, 0] * ahead[:, 1] - moved[:, 1] * ahead[:, 0]
        return torch.stack([forward, left, wrap_angle(self.heading - before[:, 2])], -1) / STEP_S

    def localization(self) -> Tensor:
        """Position and heading of the agent, (x, y, z, heading) [W, 4]."""
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
    "way_to_objects": lambda v: v.ways(v.who)[0],
    "way_to_goals": lambda v: v.ways(v.who)[1],
    "other_way_to_objects": lambda v: v.ways(1 - v.who)[0],
    "other_way_to_goals": lambda v: v.ways(1 - v.who)[1],
    "other_approach": View.approach,
    "path_ahead": lambda v: v.path_ahead(v.who),
    "other_path_ahead": lambda v: v.path_ahead(1 - v.who),
    "other_velocity": View.other_velocity,
    "elapsed_s": lambda v: v.play.steps[:, None] * STEP_S,
}
"""By name, [W, n]."""
OF_PATHS = (
    "way_to_objects", "way_to_goals", "other_way_to_objects", "other_way_to_goals", "other_approach", "path_ahead",
    "other_path_ahead",
)  # fmt: skip
"""Those that `Paths` are needed for."""


def checked_observations(names: tuple[str, ...]) -> tuple[str, ...]:
    """The names, each once.

    Raises:
        InputError: a device does not show one of them.
    """
    unknown = [name for name in names if name not in OBSERVED]
    if unknown or not names:
        raise InputError(f"On a device there are {', '.join(OBSERVED)}, got {unknown or 'none'}.", code="H3-TRAIN-068")
    return tuple(dict.fromkeys(names))


def observed(view: View, names: tuple[str, ...]) -> dict[str, Tensor]:
    """The named observations, each float32 [W, n]."""
    if view.paths is None and any(name in OF_PATHS for name in names):
        view = view._replace(paths=Paths.of(view.sim, view.play, view.places))
    return {name: OBSERVED[name](view).float() for name in names}
