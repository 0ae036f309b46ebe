"""Commands for a person who is driven from outside, step by step: by a keyboard, a headset, or a policy in training."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from h3data.errors import InputError
from sim_kinematic.agents.skills import CHORE, CHORES, CONTROL, SIT, Action, Destination, Message, Objects

HEAD_YAW_RAD, HEAD_PITCH_RAD = float(np.radians(75.0)), float(np.radians(50.0))
"""Largest turns of the head from the direction of the chest [rad]."""
LARGEST_NUMBER = 1000.0
"""Limit above which numbers are refused: they are an error of the sender, and their squares would overflow."""

Vector = tuple[float, ...]


@dataclass(frozen=True)
class HandTarget:
    """Target position of a palm."""

    position: Vector
    """Position in the agent root frame (x forward, y up, z right), [3] [m], which moves with the person. The arm stretches
    towards a position out of its reach."""
    rotation: Vector | None = None
    """Quaternion xyzw of the wrist's axes in the agent root frame [4]; None leaves the wrist straight."""


@dataclass(frozen=True)
class Pick:
    """Command to take an object."""

    object: str | int
    """Object to pick: its name, or its index among the objects of the task."""


@dataclass(frozen=True)
class Place:
    """Command to put down the held object."""

    point: Vector
    """Position of the object's origin afterwards, in the world, [3] [m]."""


@dataclass(frozen=True)
class Drop:
    """Command to let go of the held object, which then lies on the surface below it."""


@dataclass(frozen=True)
class HandOver:
    """Command to give the held object to a robot whose hand is empty and within reach."""

    agent: int
    """Number of the robot that receives the object."""


@dataclass(frozen=True)
class Open:
    """Command to open a door or drawer whose handle is within reach; the hand must be empty."""

    joint: str | int
    """Door or drawer to open: its name (``thing/part``), or its index among the joints of the home."""


@dataclass(frozen=True)
class Close:
    """Command to close a door or a drawer."""

    joint: str | int
    """Door or drawer to close, as in `Open`: its name (``thing/part``), or its index among the joints of the home."""


@dataclass(frozen=True)
class Sit:
    """Command to walk to the nearest free seat within 3 m and sit down; any other command makes the person get up again."""

    lies: bool = False
    """True if the person then lies down, on a bed or sofa that is large enough."""


@dataclass(frozen=True)
class Chore:
    """Command to handle a thing that the person brought along, where the rules of the task have chores."""

    name: str
    """Chore: one of `sim_kinematic.agents.skills.CHORES`."""


Do = Pick | Place | Drop | HandOver | Open | Close | Sit | Chore


@dataclass(frozen=True)
class PersonCommand:
    """The movement of a driven person in one step."""

    forward: float = 0.0
    """Walking speed as a share of the limit, -1..1; a negative one walks backwards."""
    turn: float = 0.0
    """Turn rate as a share of the limit, -1..1, positive to the left."""
    left: HandTarget | None = None
    right: HandTarget | None = None
    """Targets of the right and of the left hand; None: the arm swings, or carries the object in the hand."""
    head: tuple[float, float] | None = None
    """Yaw to the left and pitch downwards of the head from the direction of the chest [rad]; None to look ahead."""
    do: Do | None = None
    """Skill to start. The person first comes to a stand; while the skill runs, the rest of the command is ignored."""

    @property
    def stands(self) -> bool:
        """Return whether the command asks for no motion but standing, so that a running skill continues."""
        return self == STAND


STAND = PersonCommand()


def action_of(command: Any, objects: Objects, agent: int) -> Action:
    """Convert a command for a person into the `Action` that carries it out.

    The command is a `PersonCommand`, one of the person's skills, a pair (forward, turn), or any object with attributes
    ``forward`` and ``turn``.

    Raises:
        InputError: the command names an unknown object, or a number is out of range or not finite.
    """
    given: Any = PersonCommand(do=command) if isinstance(command, Do) else command
    do = getattr(given, "do", None)
    skills: dict[type, Callable[[Any], Action]] = {
        Pick: lambda pick: Action("pick", _index(pick.object, objects)),
        Place: lambda place: Action(
            "place", objects.held(agent), command=_numbers("a point", place.point, 3, LARGEST_NUMBER)
        ),
        Drop: lambda _: Action("drop", objects.held(agent)),
        HandOver: lambda give: Action("hand_over", objects.held(agent), command=(int(give.agent),)),
        Open: lambda part: Action("open", _joint(part.joint, objects)),
        Close: lambda part: Action("close", _joint(part.joint, objects)),
        Sit: lambda sit: Action(SIT, command=(sit.lies,) if sit.lies else ()),
        Chore: lambda chore: Action(CHORE, CHORES.index(chore.name)),
    }
    if type(do) in skills and (not isinstance(do, Chore) or do.name in CHORES):
        return skills[type(do)](do)
    if do is not None:
        raise InputError(
            f"Expected Pick, Place, Drop, HandOver, Open, Close, Sit or a Chore ({', '.join(CHORES)}), got {do!r}.",
            code="H3-SIM-001",
        )
    if not hasattr(given, "forward") and np.shape(given) == (2,):
        given = PersonCommand(*given)
    if not (hasattr(given, "forward") and hasattr(given, "turn")):
        raise InputError(
            f"Expected a PersonCommand, a skill, or a pair (forward, turn), got {command!r}.", code="H3-SIM-002"
        )
    # any finite number, as it is clipped to -1..1 below
    forward, turn = _numbers("a velocity", (given.forward, given.turn), 2, np.inf)
    head = getattr(given, "head", None)
    left, right = (_target(getattr(given, side, None)) for side in ("left", "right"))
    checked = PersonCommand(
        # float32, as the column of actions has it: what is recorded is what was done
        float(np.float32(np.clip(forward, -1, 1))),
        float(np.float32(np.clip(turn, -1, 1))),
        left,
        right,
        None if head is None else _numbers("yaw and pitch of the head", head, 2, LARGEST_NUMBER),  # type: ignore[arg-type]
    )
    return Action(CONTROL, command=checked)


def command_to_json(action: Action) -> dict[str, Any]:
    """Return an action as JSON types, for the raw input in recordings."""
    command = str(action.command) if isinstance(action.command, Destination) else msgspec.to_builtins(action.command)
    if isinstance(action.command, Message):
        command = action.command._asdict()
    elif isinstance(command, dict):
        del command["do"]  # an action is one or the other
    return {"skill": action.skill, "target": action.target, "steps": action.steps, "command": command}


def command_from_json(data: Any) -> Action:
    """Return the action that `command_to_json` has converted to JSON types."""
    given = data["command"]
    if isinstance(given, str):
        command: Any = Destination.of(given)
    elif isinstance(given, dict) and "text" in given:
        command = Message(given["text"], given["to"])
    elif isinstance(given, dict):
        left, right = (msgspec.convert(given[side], HandTarget | None) for side in ("left", "right"))
        head = msgspec.convert(given["head"], tuple[float, float] | None)
        command = PersonCommand(float(given["forward"]), float(given["turn"]), left, right, head)
    else:
        command = tuple(msgspec.convert(given, list[float]))
    return Action(str(data["skill"]), int(data["target"]), int(data["steps"]), command)


def interrupts_skill(action: Action) -> bool:
    """Return whether a command from outside interrupts a running skill; a command to stand still does not."""
    return not (isinstance(action.command, PersonCommand) and action.command.stands)


def _index(name: str | int, objects: Objects) -> int:
    index = objects.names.index(name) if name in objects.names else name
    if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(objects.names):
        raise InputError(
            f"There is no object {name!r} in this task. Expected one of: {', '.join(objects.names)}.", code="H3-SIM-003"
        )
    return index


def _joint(name: str | int, objects: Objects) -> int:
    names = objects.joints
    index = names.index(name) if name in names else name
    # True is an int, and would be joint 1
    if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(names):
        there = f"Expected one of: {', '.join(names)}." if names else "Nothing in this home opens."
        raise InputError(f"There is no door or drawer {name!r}. {there}", code="H3-SIM-004")
    return index


def _target(target: Any) -> HandTarget | None:
    if target is None:
        return None
    if not isinstance(target, HandTarget):
        target = HandTarget(target)
    rotation = target.rotation
    if rotation is not None:
        rotation = _numbers("a rotation", rotation, 4, LARGEST_NUMBER)
        length = float(np.linalg.norm(rotation))
        if length < 1e-6:
            raise InputError(f"Expected a quaternion xyzw other than zero, got {target.rotation!r}.", code="H3-SIM-006")
        rotation = tuple(component / length for component in rotation)
    return HandTarget(_numbers("the position of a hand", target.position, 3, LARGEST_NUMBER), rotation)


def _numbers(what: str, values: Sequence[float], count: int, most: float) -> Vector:
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        # of a wrong shape, so that one message refuses whatever was given
        array = np.full(0, np.nan)
    if array.shape != (count,) or not np.isfinite(array).all() or (np.abs(array) > most).any():
        within = "" if np.isinf(most) else f" up to {most:g}"
        raise InputError(f"Expected {what} as {count} finite numbers{within}, got {values!r}.", code="H3-SIM-005")
    return tuple(array.tolist())
