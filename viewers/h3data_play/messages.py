"""Messages of players as JSON text; a page sends one for each change of its input."""

from __future__ import annotations

import re
from typing import Annotated, Literal, TypeVar

import msgspec
from msgspec import Meta

PERIOD_S = 1 / 30
"""Time between two steps of a live world [s]."""
MOST_BYTES = 4096
"""Length of the longest message that a socket accepts [bytes]."""
MOST_CHARACTERS = 500
"""Greatest length of a text from a player, such as a message to an agent [characters]
(`sim_kinematic.agents.skills.LONGEST_MESSAGE`)."""

Count = Annotated[int, Meta(ge=0, le=2**31 - 1)]
Share = Annotated[float, Meta(ge=-1, le=1)]
Coordinate = Annotated[float, Meta(ge=-1000, le=1000)]
Angle = Annotated[float, Meta(ge=-10, le=10)]
Component = Annotated[float, Meta(ge=-10, le=10)]
Index = Annotated[int, Meta(ge=0, le=65535)]
Name = Annotated[str, Meta(max_length=200)]
Words = Annotated[str, Meta(max_length=MOST_CHARACTERS)]
Point = tuple[Coordinate, Coordinate, Coordinate]
"""Point in the world [m]."""
Rotation = tuple[Component, Component, Component, Component]
"""Rotation as a quaternion xyzw."""


class Message(msgspec.Struct, frozen=True, tag_field="k", kw_only=True):
    """Base of the messages with a player's input.

    ``ct`` and ``rtt`` are the client's time and its measured round trip [ms].
    """

    seq: Count | None = None
    """Number of the message within its page; state messages report the number of the last message that took effect."""
    step: Count | None = None
    """Number of the step for which the message is meant; None or a past step: it takes effect in the next step."""
    ct: float = 0.0
    rtt: float = 0.0


class Move(Message, frozen=True, tag="move"):
    """Message to walk or drive until further notice, with the speed and the turn rate as shares of their maximum."""

    f: Share = 0.0
    t: Share = 0.0


class GoTo(Message, frozen=True, tag="goto"):
    """Message to walk to a point of the floor; the server finds the path."""

    p: Point


class Stop(Message, frozen=True, tag="stop"):
    """Message to end a guided walk."""


class Pick(Message, frozen=True, tag="pick"):
    """Message to take object ``o``; with ``lead``, the agent walks there first."""

    o: Index
    lead: bool = False


class Place(Message, frozen=True, tag="place"):
    """Message to put the object in hand down with its origin at a point; with ``lead``, the agent walks there first."""

    p: Point
    lead: bool = False


class Drop(Message, frozen=True, tag="drop"):
    """Message to drop the object in hand."""


class Give(Message, frozen=True, tag="give"):
    """Message to hand the object in hand to agent ``a``."""

    a: Index


class Open(Message, frozen=True, tag="open"):
    """Message to open door or drawer ``j``; with ``lead``, the agent walks there first."""

    j: Index
    lead: bool = False


class Close(Message, frozen=True, tag="close"):
    """Message to close door or drawer ``j``; with ``lead``, the agent walks there first."""

    j: Index
    lead: bool = False


class Sit(Message, frozen=True, tag="sit"):
    """Message to walk to the nearest free seat and sit down, or to get up; with ``lies``, also to lie down."""

    lies: bool = False


class Gesture(Message, frozen=True, tag="gesture"):
    """Message to wave with the right hand, or to look at a phone until the message is repeated."""

    name: Literal["wave", "phone"]


class Perform(Message, frozen=True, tag="perform"):
    """Message to play the captured motion of this name once, or to end it early."""

    name: Name


class Chore(Message, frozen=True, tag="chore"):
    """Message to handle a thing that the person brought along, such as to take it out of the fridge."""

    name: Literal["take", "lift", "put", "phone"]


class Hand(Message, frozen=True, tag="hand"):
    """Message with the target position of a palm in the person's root frame [m]; without a point the arm is released."""

    side: Literal["left", "right"]
    p: Point | None = None
    q: Rotation | None = None


class Head(Message, frozen=True, tag="head"):
    """Message with the direction of the head relative to the chest: angles to the left and downwards [rad]."""

    yaw: Angle
    pitch: Angle


class Use(Message, frozen=True, tag="use"):
    """Message to clean, fill, pour out or switch object ``o``, as the task requires; with ``lead``, after walking there."""

    o: Index
    lead: bool = False


class Bring(Message, frozen=True, tag="bring"):
    """Message to carry the object in hand to a named place and put it there, optionally next to another object."""

    place: Name
    next_to: Name = ""


class Say(Message, frozen=True, tag="say"):
    """Message with a text for one other agent, or for all agents."""

    text: Annotated[Words, Meta(min_length=1)]
    to: Name = ""


class Problem(Message, frozen=True, tag="problem"):
    """Message that reports a problem with the episode, which continues."""

    text: Annotated[Words, Meta(min_length=1)]


class End(Message, frozen=True, tag="end"):
    """Message to end the episode, because the player considers the task finished or skips it."""

    why: Literal["finished", "skipped"]


class Answer(Message, frozen=True, tag="answer"):
    """Message with the answer to the question at the end of an episode."""

    answer: Literal["yes", "no", "unsure"]
    text: Words = ""


class Leave(Message, frozen=True, tag="leave"):
    """Message to end the session."""


class Ping(msgspec.Struct, frozen=True, tag_field="k", tag="ping"):
    """Message that requests the server's time."""

    ct: float


class Can(msgspec.Struct, frozen=True, tag_field="k", tag="can"):
    """Message that asks whether the object in hand could be placed at a point; it changes nothing and is not recorded."""

    p: Point


Remark = Problem | End | Answer
"""Messages about the episode, in apps that ask a question at its end (`h3data_play.app.App.question`)."""
Act = (
    Move
    | GoTo
    | Stop
    | Pick
    | Place
    | Drop
    | Give
    | Open
    | Close
    | Sit
    | Gesture
    | Perform
    | Chore
    | Use
    | Bring
    | Say
    | Hand
    | Head
    | Leave
    | Remark
)
"""Messages that are recorded."""
_DECODER: msgspec.json.Decoder[Act | Ping | Can] = msgspec.json.Decoder(Act | Ping | Can)
MOST_DEEP = 32
"""Largest nesting depth in JSON of clients.

The limit of a decoder depends on the depth of its caller's stack, so a worker could otherwise fail at a message that
the front process accepted.
"""
_BRACKET = re.compile(rb'"[^"\\]*(?:\\.[^"\\]*)*"?|[\[{]|[\]}]', re.DOTALL)
"""Pattern of a string, which may lack its end, or of a bracket."""
Kind = TypeVar("Kind")


def decode(text: str) -> Act | Ping | Can:
    """Decode the message in a text frame.

    Raises:
        msgspec.MsgspecError: the text is not a message: not JSON, an unknown kind, or a number out of range.
    """
    return read_json(text, _DECODER)


def read_json(text: str | bytes, decoder: msgspec.json.Decoder[Kind]) -> Kind:
    """Decode JSON that a client has sent; all JSON from clients passes through this function.

    Raises:
        msgspec.MsgspecError: the text is not JSON, is nested too deeply, or does not fit the decoder.
    """
    try:
        data = text.encode() if isinstance(text, str) else text
        if data.count(b"[") + data.count(b"{") > MOST_DEEP:  # else it cannot be too deep
            _require_shallow(data)
        return decoder.decode(data)
    except UnicodeError:
        raise msgspec.DecodeError("JSON is text in UTF-8") from None


def _require_shallow(data: bytes) -> None:
    depth = 0
    for found in _BRACKET.finditer(data):
        first = found[0][:1]
        depth += (first in b"[{") - (first in b"]}")
        if depth > MOST_DEEP:
            raise msgspec.DecodeError(f"JSON has more than {MOST_DEEP} brackets within each other")
