"""Pieces in walls and crooked chairs in other furniture are moved out of them, and nothing else is."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from h3data_homes.furnishing.furniture import Furniture, box_part
from h3data_homes.furnishing.place import Placed
from h3data_homes.lived_in.settling import settle
from h3data_homes.solids import MeshBuilder


class Room:
    """As much of a `RoomState` as is looked at."""

    def __init__(self, *placed: Placed) -> None:
        self.placed = list(placed)
        self.interior = (-5.0, -5.0, 5.0, 5.0)


def block(width: float, depth: float, x: float, z: float, yaw: float = 0.0, quarter: int = 0, **options: Any) -> Placed:
    size = (width, 0.8, depth)
    piece = Furniture(
        category="chair", builder=MeshBuilder(), shapes=(box_part((0, 0.4, 0), size),), receptacles=(), size=size
    )
    return Placed(piece=piece, room="r", x=x, z=z, quarter=quarter, yaw=yaw, **options)


def settled(*placed: Placed) -> list[Placed]:
    room = Room(*placed)
    settle(room)  # type: ignore[arg-type]
    return room.placed


def test_a_corner_that_is_in_a_neighbour_is_turned_out_of_it() -> None:
    chest, chair = block(1, 1, 0, 0), block(0.6, 0.6, 0.81, 0, yaw=0.1)
    assert settled(chest, chair) == [chest, replace(chair, yaw=0.0)]


@pytest.mark.parametrize("quarter", [0, 2])
def test_what_is_in_a_neighbour_even_so_is_pushed_out_on_the_shortest_way(quarter: int) -> None:
    chest, chair = block(1, 1, 0, 0), block(0.6, 0.4, 0.1, 0.68, yaw=0.05, quarter=quarter)
    _, moved = settled(chest, chair)
    assert moved.yaw == 0
    assert (moved.x, moved.z) == pytest.approx((0.1, 0.7))
    small = block(0.6, 0.4, -0.68, 0.1, yaw=-0.05, quarter=1)
    _, moved = settled(chest, small)
    assert (moved.x, moved.z) == pytest.approx((-0.7, 0.1))


def test_who_stands_free_or_straight_stays_to_the_bit() -> None:
    chest = block(1, 1, 0, 0)
    for other in (
        block(0.6, 0.6, 0.85, 0, yaw=0.1),  # free
        block(0.6, 0.6, 0.77, 0),  # straight: not for this to mend
        block(0.6, 0.6, 0.8, 0, yaw=0.01),  # in it by less than a centimetre
        block(0.6, 0.6, 0.7, 0, yaw=0.1, y=0.9),  # above it
    ):
        assert settled(chest, other) == [chest, other]


def test_what_is_in_a_wall_stands_at_it() -> None:
    for x, z, out in (
        (4.72, 0.0, (4.7, 0.0)),
        (-4.72, 0.0, (-4.7, 0.0)),
        (0.0, 4.75, (0.0, 4.7)),
        (4.715, -4.8, (4.7, -4.7)),
    ):
        (moved,) = settled(block(0.6, 0.6, x, z))
        assert (moved.x, moved.z) == pytest.approx(out)
    stays = block(0.6, 0.6, 4.705, 0)
    assert settled(stays) == [stays]


def test_the_way_out_is_as_long_as_the_boxes_are_in_each_other() -> None:
    rng = np.random.default_rng(0)
    chest = block(1, 1, 0, 0)
    for _ in range(50):
        x = float(rng.uniform(0.7, 0.78))
        _, moved = settled(chest, block(0.6, 0.6, x, float(rng.uniform(-0.1, 0.1)), yaw=0.02))
        assert moved.x == pytest.approx(0.8)
        assert moved.x >= x
