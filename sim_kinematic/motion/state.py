"""State of W worlds, each with the same robots, people and O objects, as structs of arrays with worlds first.

A single world has W = 1. A world may have any number of robots and people, including none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE

NOBODY = -1
"""Number that stands for no agent, as the holder of objects that no agent holds."""
ROBOT, HUMAN = 0, 1
"""Indices of the agents if there is one robot and one person; in general, robots come first, then people."""

Worlds = NDArray[np.bool_] | NDArray[np.integer] | Sequence[int] | slice
"""Selection of worlds: indices or a mask, which copy, or a slice, which gives views."""


class _Arrays:
    """A struct of arrays whose first axis is the world."""

    @property
    def worlds(self) -> int:
        """Number W of worlds."""
        return len(self.arrays()[0])

    def arrays(self) -> list[NDArray[Any]]:
        """Return all arrays of the struct, those of agents first, in a fixed order."""
        return list(vars(self).values())

    def take(self, worlds: Worlds) -> Self:
        """Return the state of some of the worlds."""
        # numbers of rows take a few of them in half the time of indexing
        numbers = isinstance(worlds, np.ndarray) and worlds.dtype == np.intp
        return type(self)(**{name: a.take(worlds, 0) if numbers else a[worlds] for name, a in vars(self).items()})

    def put(self, worlds: Worlds, other: Self) -> None:
        """Overwrite some of the worlds with all worlds of ``other``, or with its only one."""
        for mine, theirs in zip(self.arrays(), other.arrays(), strict=True):
            mine[worlds] = theirs

    def copy(self) -> Self:
        """Return a copy with its own arrays."""
        other = object.__new__(type(self))  # a step copies several: checks of arguments would take most of the time
        vars(other).update({name: array.copy() for name, array in vars(self).items()})
        return other


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotState(_Arrays):
    """State of one robot in each world."""

    xz: NDArray[np.float64]
    """Base position on the floor [m], shape [W, 2]."""
    heading: NDArray[np.float64]
    """Heading [rad], shape [W]. Headings are never wrapped: the quaternion of h + 2 pi is the negative of that of h, so
    the signs of recorded quaternions are continuous in time."""
    contact: NDArray[np.bool_]
    """True if the base touched an obstacle in the last step, shape [W]."""
    joints: NDArray[np.float64]
    """Joint positions [rad or m], shape [W, J]; J is 0 if no arm moves."""

    @classmethod
    def zeros(cls, worlds: int, *, joints: int = 0) -> RobotState:
        """Return the state of robots at the origin."""
        return cls(
            xz=np.zeros((worlds, 2)),
            heading=np.zeros(worlds),
            contact=np.zeros(worlds, np.bool_),
            joints=np.zeros((worlds, joints)),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class HumanState(_Arrays):
    """State of one person in each world."""

    xz: NDArray[np.float64]
    """Places on the floor, shape [W, 2] [m]."""
    heading: NDArray[np.float64]
    """Headings, shape [W] [rad], never wrapped."""
    distance: NDArray[np.float64]
    """Distance walked since the start [m], which determines the phase of the walking cycle; shape [W]."""
    set_off: NDArray[np.float64]
    """Value of `distance` when the person last set off from standing [m], at which the cycle started again; shape
    [W]."""
    blend: NDArray[np.float64]
    """Share of walking in the motion: 0 = standing, 1 = walking, shape [W]."""
    arms: NDArray[np.float64]
    """Fold of the left and the right arm, from 0 (out) to 1 (in), shape [W, 2]."""
    seat: NDArray[np.float64]
    """Height of a seat above the floor [m], and share of the path from standing (0) to sitting (1) and lying (2) on it,
    shape [W, 2]."""
    hands: NDArray[np.float64]
    """Places to which the hands move (`h3data.bodies.people.gestures.lead_hands`), shape [W, 4, 4]; zeros: nowhere."""

    @classmethod
    def zeros(cls, worlds: int) -> HumanState:
        """Return the state of people who stand at the origin."""
        return cls(
            xz=np.zeros((worlds, 2)),
            arms=np.zeros((worlds, 2)),
            seat=np.zeros((worlds, 2)),
            hands=np.zeros((worlds, 4, 4)),
            **{n: np.zeros(worlds) for n in ("heading", "distance", "set_off", "blend")},
        )


AgentState = RobotState | HumanState


@dataclass(frozen=True, kw_only=True, eq=False)
class WorldState(_Arrays):
    """State of W worlds, whose arrays a step changes in place; `copy` makes a snapshot."""

    robots: tuple[RobotState, ...]
    people: tuple[HumanState, ...]
    object_pose: NDArray[np.float64]
    """Pose (pose7) of each object that can be taken, shape [W, O, 7]."""
    held_by: NDArray[np.int64]
    """Number of the agent that holds each object (its index in `agents`), or `NOBODY`, shape [W, O]."""
    grip_pose: NDArray[np.float64]
    """Pose (pose7) of each held object in the frame of the hand that holds it, shape [W, O, 7]."""
    joint_pos: NDArray[np.float64]
    """Positions of the joints of doors, drawers and the like, in the order of the scene, shape [W, J] [rad or m]."""

    @classmethod
    def zeros(
        cls,
        worlds: int,
        *,
        robots: int = 1,
        people: int = 1,
        joints: int | Sequence[int] = 0,
        objects: int = 0,
        scene_joints: int = 0,
    ) -> WorldState:
        """Return the state of W worlds with everything at the origin and nothing held.

        Args:
            worlds: number of worlds W.
            robots: number of robots in each world.
            people: number of people.
            joints: number of joints of every robot, or one number for each of them.
            objects: number of objects O.
            scene_joints: number of doors and drawers.

        Raises:
            InputError: a number is negative, or the counts of joints do not match the number of robots.
        """
        each = [joints] * robots if isinstance(joints, int) else list(joints)
        if len(each) != robots or min(worlds, robots, people, objects, scene_joints, *each) < 0:
            raise InputError(
                f"Expected numbers of 0 or more, and one number of joints for each robot; got {worlds} worlds, {robots} "
                f"robots, {people} people, joints {joints}, {objects} objects and {scene_joints} joints of the scene.",
                code="H3-SIM-033",
            )
        nowhere = np.tile(IDENTITY_POSE, (worlds, objects, 1))
        return cls(
            robots=tuple(RobotState.zeros(worlds, joints=count) for count in each),
            people=tuple(HumanState.zeros(worlds) for _ in range(people)),
            object_pose=nowhere,
            held_by=np.full((worlds, objects), NOBODY),
            # an array of its own: both are changed in place
            grip_pose=nowhere.copy(),
            joint_pos=np.zeros((worlds, scene_joints)),
        )

    @cached_property
    def agents(self) -> tuple[AgentState, ...]:
        """Agents of the worlds, robots first, then people; an agent's index here is its number."""
        return (*self.robots, *self.people)

    def arrays(self) -> list[NDArray[Any]]:
        """Return all arrays of the state, in a fixed order."""
        own = [self.object_pose, self.held_by, self.grip_pose, self.joint_pos]
        return [array for agent in self.agents for array in agent.arrays()] + own

    def copy(self) -> WorldState:
        """Return a copy with its own arrays."""
        # by numbers, which copy: a slice would give views
        return self.take(np.arange(self.worlds))

    def take(self, worlds: Worlds) -> WorldState:
        """Return the state of some of the worlds."""
        return WorldState(
            robots=tuple(robot.take(worlds) for robot in self.robots),
            people=tuple(person.take(worlds) for person in self.people),
            object_pose=self.object_pose[worlds],
            held_by=self.held_by[worlds],
            grip_pose=self.grip_pose[worlds],
            joint_pos=self.joint_pos[worlds],
        )


class StateBlock(NamedTuple):
    """State of W worlds whose arrays lie in one block of memory, so that one copy stores all of them."""

    block: NDArray[np.uint8]
    """Bytes of all arrays [N]."""
    state: WorldState
    """The state, whose arrays are views of the block."""
    people: HumanState
    """Views of all people as one, [P * W]: person ``p`` of world ``w`` is row ``p * W + w``."""
    xz: NDArray[np.float64]
    """Places of all agents [A, W, 2] [m]."""
    heading: NDArray[np.float64]
    """Headings of all agents [A, W] [rad]."""
    arrays: list[NDArray[Any]]
    """Arrays of `_adjacent`, which are views of the block."""

    @classmethod
    def of(cls, state: WorldState) -> StateBlock:
        """Return a copy of a state in one block."""
        arrays = _adjacent(state)
        block = np.frombuffer(bytearray(b"".join(a.tobytes().ljust(-(-a.nbytes // 8) * 8) for a in arrays)), np.uint8)
        views = [
            block[begin : begin + array.nbytes].view(array.dtype).reshape(array.shape)
            for array, begin in zip(arrays, _begins(arrays), strict=False)
        ]
        people = [*(view[len(state.robots) :] for view in views[:2]), *views[2 : len(_PEOPLE)]]
        together = {n: a.reshape(-1, *a.shape[2:]) for n, a in zip(_PEOPLE, people, strict=True)}
        return cls(block, _assembled(state, views), HumanState(**together), views[0], views[1], views)

    def first(self) -> NDArray[np.uint8]:
        """Return a copy of the first world's state as bytes, for `past`."""
        return self._alone.block.copy()

    @property
    def _alone(self) -> StateBlock:
        """Block of the first world."""
        # that of one world is its own, which takes a tenth of the time
        return self if self.xz.shape[1] == 1 else StateBlock.of(self.state.take(np.arange(1)))

    def past(self, moments: Sequence[NDArray[np.uint8]]) -> WorldState:
        """Return the first world at T moments, which `first` stored, as the state of T worlds."""
        first, blocks, parts = self._alone, np.stack(moments), []
        for number, (array, begin) in enumerate(zip(first.arrays, _begins(first.arrays), strict=False)):
            part = np.ascontiguousarray(blocks[:, begin : begin + array.nbytes]).view(array.dtype)
            part = part.reshape(len(blocks), *array.shape)
            # the moment takes the place of the world, behind the number of the agent
            parts.append(np.moveaxis(part[:, :, 0], 0, 1) if number < len(_PEOPLE) else part[:, 0])
        return _assembled(first.state, parts)


_PEOPLE = ("xz", "heading", *(name for name in vars(HumanState.zeros(0)) if name not in ("xz", "heading")))
"""Arrays of people in the order of `_adjacent`; the first two are those of all agents."""


def _adjacent(state: WorldState) -> list[NDArray[Any]]:
    """Return all arrays of a state, those of several agents as one with the agents first [A or P, W, ...]."""
    # one more, as nothing cannot be stacked
    agents = *state.agents, HumanState.zeros(state.worlds)
    people = *state.people, agents[-1]
    shared = [np.stack([vars(own)[name] for own in agents])[:-1] for name in _PEOPLE[:2]]
    shared += [np.stack([vars(own)[name] for own in people])[:-1] for name in _PEOPLE[2:]]
    rest = (state.object_pose, state.held_by, state.grip_pose, state.joint_pos)
    return [*shared, *(array for own in state.robots for array in (own.contact, own.joints)), *rest]


def _begins(arrays: Sequence[NDArray[Any]]) -> list[int]:
    """Return where each array begins in a block, at a multiple of the largest item, and where the block ends."""
    return [0, *np.cumsum([-(-array.nbytes // 8) * 8 for array in arrays]).tolist()]


def _assembled(like: WorldState, arrays: Sequence[NDArray[Any]]) -> WorldState:
    """Return the state of the arrays of `_adjacent`, with as many agents as another state."""
    count, rest = len(like.robots), arrays[len(_PEOPLE) :]
    people = [*(array[count:] for array in arrays[:2]), *arrays[2 : len(_PEOPLE)]]
    return WorldState(
        robots=tuple(
            RobotState(xz=arrays[0][k], heading=arrays[1][k], contact=rest[2 * k], joints=rest[2 * k + 1])
            for k in range(count)
        ),
        people=tuple(
            HumanState(**{name: array[p] for name, array in zip(_PEOPLE, people, strict=True)})
            for p in range(len(like.people))
        ),
        **dict(zip(("object_pose", "held_by", "grip_pose", "joint_pos"), rest[2 * count :], strict=True)),
    )
