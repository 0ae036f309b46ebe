"""Observations on a device, by the entries of `sim_kinematic.sensing.table` for W worlds of rearrangement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from h3data.errors import InputError
from h3data_training.torch.rearrange.bank import FLOOR
from h3data_training.torch.rearrange.skills import Choices, every_choice, one_of, precondition
from h3data_training.torch.rearrange.state import ABORTED, DONE, FAILED, NOBODY, Hands, Play, SubGoal
from h3data_training.torch.rearrange.tables import Places
from h3data_training.torch.rearrange.worlds import RearrangeTensors
from h3data_training.torch.seen import read_sensors
from h3data_training.torch.state import HumanTensors, RobotTensors
from sim_kinematic.sensing.sensor import FAR_M
from sim_kinematic.sensing.table import AHEAD_M, SENSES, Ending, Pose, Sensor
from sim_kinematic.tasks.skills.household import TRACK

THEN = 1
"""Index of the moment one second ago in the arrays of `Paths`; index 0 is now."""


class Paths(NamedTuple):
    """Shortest paths of both agents, which the robot and the person observe."""

    xz: Tensor
    """Positions of both agents now and one second ago, (x, z) [W, 2, 2, 2] [m]."""
    lengths: Tensor
    """Lengths of the paths from these positions to the floor below starts and goals, [W, 2, 2, 2 K] [m]."""
    ahead: Tensor
    """Points that lie `AHEAD_M` ahead of each agent on its path to each object or, with an object in hand, to its goal,
    [W, 2, K, n, 2] [m]. The path to an object in the other agent's hand is the straight line.
    """

    @classmethod
    def of(cls, sim: RearrangeTensors, play: Play, places: Places) -> Paths:
        """Return the shortest paths of both agents, from their positions now and `THEN` steps ago."""
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
    """View of one agent in each world, from which sensors read (`sim_kinematic.sensing.table`)."""

    sim: RearrangeTensors
    play: Play
    places: Places
    choices: Choices
    does: SubGoal
    now: RobotTensors | HumanTensors
    other: RobotTensors | HumanTensors
    contact: Tensor
    paths: Paths | None = None

    @classmethod
    def of(cls, sim: RearrangeTensors, play: Play, agent: str, paths: Paths | None = None) -> View:
        """Return the view of the ``robot`` or the ``human``; without ``paths``, `observed` computes the paths."""
        now, other, does, contact = play.robot, play.human, play.robot_does, play.robot.contact
        if agent == "human":
            now, other, does, contact = other, now, play.human_does, torch.zeros_like(contact)
        return cls(
            sim=sim,
            play=play,
            places=sim.tables.at(play.episode),
            choices=sim.choices[agent],
            does=does,
            now=now,
            other=other,
            contact=contact,
            paths=paths,
        )

    @property
    def xp(self) -> ModuleType:
        """Array namespace of the tensors."""
        return torch

    @property
    def agent(self) -> int:
        """Number of the agent: robot 0, person 1."""
        return self.choices.who

    @property
    def known_paths(self) -> Paths:
        """Shortest paths of both agents, which must have been computed."""
        assert self.paths is not None, "`observed` looks them up once for all observations"
        return self.paths

    @property
    def hands(self) -> Hands:
        """Objects, their holders and open parts, all of which hands change."""
        return self.play.hands

    @property
    def before(self) -> Pose:
        """Agents before the last step."""
        return self._before(self.agent)

    @property
    def other_before(self) -> Pose:
        """State of the other agent before the last step."""
        return self._before(1 - self.agent)

    def _before(self, who: int) -> Pose:
        return Pose(self.play.before[:, who, :2], self.play.before[:, who, 2])

    @property
    def touching(self) -> Tensor:
        """Return whether the agents touch, bool [W]."""
        return self.play.collides

    @property
    def held_by(self) -> Tensor:
        """Number of the agent that holds each object, [W, K]."""
        return self.play.held_by

    @property
    def objects(self) -> Tensor:
        """Positions of objects, [W, K, 3] [m]."""
        return self.play.objects

    @property
    def starts(self) -> Tensor:
        """Initial positions of objects, [W, K, 3] [m]."""
        return self.sim.tables.spots[self.play.episode, : self.sim.bank.objects]

    @property
    def goals(self) -> Tensor:
        """Goals of objects, [W, K, 3] [m]."""
        return self.sim.tables.goals(self.play.episode)

    @property
    def handles(self) -> Tensor:
        """Handles of the doors and drawers that the agent may open, at rest, [W, M, 3] [m]."""
        return self.sim.tables.handles(self.play.episode)

    @property
    def open_parts(self) -> Tensor:
        """True for doors and drawers that are open, bool [W, M]."""
        return self.play.opened

    @property
    def at_goal(self) -> Tensor:
        """True for objects that are at their goals, bool [W, K]."""
        return self.sim.at_goal(self.hands, self.places)

    @property
    def close(self) -> Tensor:
        """Return whether the other agent is close, bool [W]."""
        return self.sim.close(self.now.xz, self.now.heading, self.other.xz)

    @property
    def steps(self) -> Tensor:
        """Number of steps since the start of the episode, [W]."""
        return self.play.steps

    def floor_y(self) -> Tensor:
        """Return heights of the floors, [W] [m]."""
        return self.sim.tables.floor_y[self.places.place]

    def ways(self, end: Literal["objects", "goals"], *, other: bool, then: bool = False) -> Tensor:
        """Return the lengths of the shortest paths from the agent or the other agent to objects or goals, [W, K] [m].

        With ``then``, the paths start at the position `THEN` steps ago. For an object that is held, the length is the
        straight-line distance, because tables have no paths to agents.
        """
        play, count, paths = self.play, self.sim.bank.objects, self.known_paths
        who, when = 1 - self.agent if other else self.agent, THEN if then else 0
        lengths = paths.lengths[:, who, when]
        if end == "goals":
            return lengths[:, count:]
        gap = play.objects[..., 0::2] - paths.xz[:, who, when, None]
        lies = torch.where(play.moved, lengths[:, count:], lengths[:, :count])
        return torch.where(play.held_by != NOBODY, torch.hypot(gap[..., 0], gap[..., 1]), lies)

    def ahead(self, *, other: bool) -> Tensor:
        """Return the points `AHEAD_M` ahead of either agent on its paths (`Paths.ahead`), [W, K, n, 2] [m]."""
        return self.known_paths.ahead[:, 1 - self.agent if other else self.agent]

    def ended(self, outcome: Ending) -> Tensor:
        """Return a number for each choice, which is 1 for the last choice if it ended with a given outcome, [W, C]."""
        code = {"done": DONE, "failed": FAILED, "aborted": ABORTED}[outcome]
        return one_of(self.does.last, len(self.choices)) & (self.does.outcome == code)[:, None]

    def allowed(self) -> Tensor:
        """Return a mask of the choices that the agent's hand allows, bool [W, C].

        The rules are those of `sim_kinematic.agents.skills.Objects.why_not`.
        """
        return precondition(self.choices, every_choice(self.choices, len(self.now.xz)), self.hands)


def observed_of(sensors: Mapping[str, Sensor], parts: int) -> tuple[str, ...]:
    """Return the names of the sensors that a device supports: all but those of the hand and of the start frame."""
    lacking = ("joints",) if parts else ("joints", "parts")
    return tuple(n for n, s in sensors.items() if s.frame not in ("hand", "start") and s.times not in lacking)


OBSERVED = observed_of(SENSES, 0)
"""Sensors of rearrangement on a device."""
OF_PATHS = (
    "way_to_objects",
    "way_to_goals",
    "other_way_to_objects",
    "other_way_to_goals",
    "other_approach",
    "path_ahead",
    "other_path_ahead",
)
"""Names of observations that are computed from `Paths`."""


def checked_observations(names: tuple[str, ...], known: Sequence[str] = OBSERVED) -> tuple[str, ...]:
    """Return the names, each once, if they are ``known``.

    Raises:
        InputError: a device does not support one of them.
    """
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise InputError(f"On a device there are {', '.join(known)}, got {unknown or 'none'}.", code="H3-TRAIN-068")
    return tuple(dict.fromkeys(names))


def observed(view: View, names: tuple[str, ...], sensors: Mapping[str, Sensor] = SENSES) -> dict[str, Tensor]:
    """Return the named observations, each float32 [W, n]."""
    if view.paths is None and any(name in OF_PATHS for name in names):
        view = view._replace(paths=Paths.of(view.sim, view.play, view.places))
    return read_sensors(view, names, sensors)
