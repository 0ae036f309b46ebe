"""Scenario cards, the records of ``datasets/scenarios/cards.toml``, and layouts sampled from their ranges."""

from __future__ import annotations

import tomllib
from functools import cache
from typing import Literal, NamedTuple

import msgspec
import numpy as np

from h3data.builtin import builtin_path
from h3data.errors import InputError, suggest
from h3data.geometry import Array

Number = float | tuple[float, float]
"""A number, or a range from which it is sampled."""
Point = tuple[Number, Number]
"""Coordinates [m] along the axis of a frame and to the right of it."""
PlaceKind = Literal["corridor", "hallway", "door", "cabin", "corner", "route", "crossing", "open", "hall"]
Mode = Literal["reach", "give_way", "join", "follow", "lead", "accompany"]
ALL = "all"


class PersonCard(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Person of a scenario card."""

    role: Literal["walk", "stand", "yield", "follow"] = "walk"
    """``walk`` along the path, ``stand``, ``yield`` to the robot before walking, or ``follow`` the robot."""
    start: Point
    path: tuple[Point, ...] = ()
    speed: Number = (0.9, 1.4)
    """Preferred speed of the person [m/s]."""
    delay: Number = 0.0
    """Time at which the person sets off [s]."""


class RobotCard(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Start and goal of the robot of a scenario card."""

    start: Point
    goal: Point


class Card(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Scenario card: a situation of people and a robot, with their starts and goals in the frame of a kind of place."""

    text: str
    place: PlaceKind
    mode: Mode
    robot: RobotCard
    people: tuple[PersonCard, ...]
    gesture: Literal["", "wait", "proceed"] = ""
    """Gesture that the person makes to the robot."""


class Layout(NamedTuple):
    """Layout of a scenario card in the frame (along, right) of a place, with sampled numbers in place of its ranges."""

    robot: Array
    """Start and goal of the robot [2, 2] [m]."""
    starts: Array
    """Starts of the people [P, 2] [m]."""
    paths: list[Array]
    """Goals of each person in the order in which they are visited [K, 2] [m]."""
    speeds: list[float]
    delays: list[float]


@cache
def load_cards() -> dict[str, Card]:
    """Return all scenario cards by name."""
    return msgspec.convert(tomllib.loads(builtin_path("scenarios/cards.toml").read_text()), dict[str, Card])


def choose_cards(names: str) -> list[str]:
    """Return the names of the cards that a rule selects, which is ``all`` or names separated by commas.

    Raises:
        InputError: There is no card of a given name.
    """
    there = list(load_cards())
    chosen = there if names.strip() == ALL else [name.strip() for name in names.split(",")]
    for name in chosen:
        if name not in there:
            raise InputError(f"Unknown card {name!r}.{suggest(name, [*there, ALL])}", code="H3-TASK-076")
    return chosen


def sample_layout(card: Card, rng: np.random.Generator) -> Layout:
    """Sample a layout from a card's ranges; the sign of ``right`` is changed in half of the cases."""
    mirror = float(rng.choice((-1.0, 1.0)))

    def number(value: Number) -> float:
        return float(rng.uniform(*value)) if isinstance(value, tuple) else float(value)

    def point(value: Point) -> tuple[float, float]:
        return number(value[0]), mirror * number(value[1])

    return Layout(
        np.array([point(card.robot.start), point(card.robot.goal)]),
        np.array([point(person.start) for person in card.people]),
        [np.array([point(goal) for goal in person.path]).reshape(-1, 2) for person in card.people],
        [number(person.speed) for person in card.people],
        [number(person.delay) for person in card.people],
    )
