"""Furniture of each kind of room in homes of the second generation.

The furniture of the first generation is placed first. Then follow large pieces, `EXTRAS` in random order if they fit,
and `ON_WALL`. Finally `remodel` replaces models of the first generation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from h3data.scene.kinds import KINDS
from h3data_homes.furnishing import furniture_bath as bath
from h3data_homes.furnishing import furniture_bed as sleeping
from h3data_homes.furnishing import furniture_kitchen as kitchen
from h3data_homes.furnishing import furniture_living as living
from h3data_homes.furnishing.furniture import Furniture
from h3data_homes.furnishing.groups import backed, hang, hang_pictures, in_a_row, need, place_rug, place_single
from h3data_homes.furnishing.place import Member, RoomState, overlap, side_span, strip
from h3data_homes.furnishing.search import place_at_wall, place_free
from h3data_homes.kinds.kind import furniture_of
from h3data_homes.lived_in.models import remodel
from h3data_homes.lived_in.settling import settle
from h3data_homes.rooms import FURNISH
from h3data_homes.style import Style

EXTRAS: Mapping[str, tuple[str, ...]] = {
    "living": (
        "side_table",
        "pouf",
        "plant_stand",
        "sideboard",
        "low_bookcase",
        "piano",
        "aquarium",
        "floor_vase",
        "bar_cart",
        "cat_tree",
        "guitar_stand",
        "rocking_chair",
        "bean_bag",
        "pet_bed",
        "toy_chest",
        "easel",
    ),
    "den": (
        "pouf",
        "bar_cart",
        "guitar_stand",
        "exercise_bike",
        "bean_bag",
        "low_bookcase",
        "piano",
        "easel",
        "sideboard",
    ),
    "library": ("rocking_chair", "low_bookcase", "side_table", "floor_vase", "piano", "stool", "plant_stand"),
    "kitchen": ("trash_bin", "wine_rack", "stool", "plant_stand", "pet_bed", "bar_cart"),
    "dining": ("sideboard", "bar_cart", "wine_rack", "floor_vase", "plant_stand", "piano"),
    "bedroom": (
        "chest_of_drawers",
        "pouf",
        "laundry_basket",
        "stool",
        "floor_vase",
        "rocking_chair",
        "exercise_bike",
        "guitar_stand",
        "low_bookcase",
    ),
    "child": (
        "toy_chest",
        "toy_shelf",
        "bean_bag",
        "rocking_horse",
        "doll_house",
        "play_tent",
        "easel",
        "low_bookcase",
        "chest_of_drawers",
    ),
    "office": (
        "filing_cabinet",
        "low_bookcase",
        "waste_basket",
        "plant_stand",
        "floor_vase",
        "guitar_stand",
        "moving_boxes",
        "exercise_bike",
    ),
    "bathroom": ("laundry_basket", "linen_cabinet", "waste_basket", "stool"),
    "hall": ("shoe_rack", "coat_stand", "umbrella_stand", "chest_of_drawers", "stool", "floor_vase", "plant_stand"),
    "laundry": ("laundry_basket", "ironing_board", "drying_rack", "water_heater", "linen_cabinet", "trash_bin"),
    "pantry": ("freezer_chest", "wine_rack", "trash_bin", "moving_boxes"),
    "garage": (
        "tool_cabinet",
        "tyre_stack",
        "moving_boxes",
        "lawn_mower",
        "step_ladder",
        "freezer_chest",
        "trash_bin",
        "water_heater",
        "exercise_bike",
    ),
    "balcony": ("flower_box", "planter", "grill", "parasol", "drying_rack", "planter", "flower_box", "stool"),
}
"""Kinds of additional pieces by kind of room, placed at a wall if there is space."""
ON_WALL: Mapping[str, tuple[tuple[str, float], ...]] = {
    "living": (
        ("wall_clock", 1.75),
        ("wall_shelf", 1.5),
        ("sun_mirror", 1.6),
        ("radiator", 0.42),
        ("wall_lamp", 1.7),
        ("hanging_plant", 1.8),
    ),
    "den": (("wall_clock", 1.75), ("wall_shelf", 1.5), ("wall_lamp", 1.7)),
    "library": (("wall_lamp", 1.7), ("wall_clock", 1.75)),
    "dining": (("sun_mirror", 1.6), ("wall_clock", 1.75), ("wall_lamp", 1.7)),
    "kitchen": (("calendar", 1.6), ("wall_clock", 1.8), ("wall_shelf", 1.55), ("hanging_plant", 1.8)),
    "bedroom": (("wall_lamp", 1.6), ("wall_shelf", 1.55), ("radiator", 0.42), ("sun_mirror", 1.6)),
    "child": (("pennants", 1.95), ("growth_chart", 1.0), ("wall_shelf", 1.45), ("radiator", 0.42)),
    "office": (("whiteboard", 1.5), ("cork_board", 1.5), ("calendar", 1.6), ("wall_clock", 1.8), ("wall_shelf", 1.6)),
    "bathroom": (("towel_rail", 1.25), ("radiator", 0.45), ("wall_shelf", 1.5)),
    "hall": (("coat_hooks", 1.7), ("key_rack", 1.5), ("thermostat", 1.45), ("wall_lamp", 1.75), ("radiator", 0.42)),
    "laundry": (("wall_shelf", 1.6), ("wall_clock", 1.8)),
    "garage": (("tool_board", 1.5), ("wall_shelf", 1.6)),
    "balcony": (("hanging_plant", 1.8), ("wall_lamp", 1.8)),
}
"""Kinds of wall-mounted objects by kind of room, with the height of their middle [m]."""
_FROM_M2 = 5.5
"""Floor per extra piece [m2]."""
_MOST_EXTRAS, _LARGE_EXTRAS = 4, 7
_WALL_TRIES = 5
_REACH_OVER_M = 0.55
"""Depth of furniture above which it has no shelf above it [m]."""


def model(name: str, rng: np.random.Generator, style: Style) -> Furniture:
    """Return a piece of second-generation furniture by the name of its kind."""
    return furniture_of(KINDS[name], rng, style)


def _extras(rng: np.random.Generator, style: Style, state: RoomState) -> None:
    names = EXTRAS.get(state.room.category, ())
    count = min(int(state.room.area / _FROM_M2) + 1, _MOST_EXTRAS if state.room.area < 45 else _LARGE_EXTRAS)
    for k in rng.permutation(len(names)).tolist():
        if count <= 0:
            return
        members = [backed(model(names[k], rng, style))]
        count -= place_at_wall(rng, state, members, corner=True, tries=1) is not None


def _on_walls(rng: np.random.Generator, style: Style, state: RoomState) -> None:
    names = ON_WALL.get(state.room.category, ())
    for k in rng.permutation(len(names)).tolist():
        name, y = names[k]
        piece = model(name, rng, style)
        for _ in range(_WALL_TRIES):
            side = int(rng.integers(4))
            u = float(rng.uniform(*side_span(state.interior, side)))
            if piece.receptacles and _above_deep(state, side, u, piece.size[0] / 2 + 0.2):
                continue
            if hang(state, piece, side, u, y):
                break


def _above_deep(state: RoomState, side: int, u: float, half: float) -> bool:
    """Return whether furniture too deep to reach over stands at a stretch of wall."""
    rect = strip(state.interior, side, u - half, u + half, 0.9)
    return any(overlap(rect, s) and min(s[2] - s[0], s[3] - s[1]) > _REACH_OVER_M for s in state.solids)


# --- new kinds of rooms -----------------------------------------------------------------------------------------------
def _furnish_child(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Furnish a child's room: a bed or a bunk bed, a wardrobe, a small table with chairs, a carpet."""
    bunk = rng.random() < 0.4 and state.room.area > 10
    group = None
    if bunk:
        group = place_at_wall(rng, state, [backed(model("bunk_bed", rng, style))], corner=True)
    for width in (1.0, 0.9):
        group = group or place_at_wall(rng, state, [backed(sleeping.bed(rng, style, width))], corner=True)
    bed = need(group, "bed", state)[0]
    place_rug(state, living.rug(rng, style, (1.6, 1.3)), bed, 0.8)
    place_single(rng, state, sleeping.wardrobe(rng, style), corner=True)
    table, seat = model("kids_table", rng, style), model("kids_chair", rng, style)
    z = table.size[2] / 2 + 0.02
    seats = [Member(piece=seat, x=0.0, z=s * (z + 0.04), quarter=2 if s > 0 else 0) for s in (1, -1)]
    if state.room.area > 11:
        place_free(rng, state, [Member(piece=table), *seats], tries=2)
    if state.room.area > 12:
        _desk(rng, style, state)
    hang_pictures(rng, style, state, 3)


def _desk(rng: np.random.Generator, style: Style, state: RoomState) -> object:
    """Return a desk with an office chair."""
    desk, seat = sleeping.desk(rng, style), model("office_chair", rng, style)
    chair = Member(
        piece=seat,
        x=desk.size[0] / 2 - sleeping.DESK_DRAWERS - seat.size[0] / 2 - 0.03,
        z=desk.wall_gap_m + desk.size[2] + sleeping.chair_reach(rng) - seat.size[2] / 2,
        quarter=2,
        yaw=float(rng.uniform(-0.06, 0.06)),
    )
    return place_at_wall(rng, state, [backed(desk), chair], corner=True, tries=3)


def _furnish_office(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Furnish an office: a desk with an office chair, shelves, an armchair."""
    if not _desk(rng, style, state):
        desk = place_single(rng, state, sleeping.desk(rng, style), corner=True)
        need(desk, "desk", state)
    place_at_wall(
        rng, state, in_a_row([living.shelf(rng, style)] * (2 if state.room.area > 9 else 1)), middle=True, tries=3
    )
    if state.room.area > 12:
        place_single(rng, state, living.armchair(rng, style), corner=True)
    place_single(rng, state, living.plant(rng, style), only_corner=True)
    hang_pictures(rng, style, state, 2)


def _furnish_laundry(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Furnish a laundry: washer and dryer in a row with a sink, shelves."""
    machine, dryer = bath.washer(rng, style), model("dryer", rng, style)
    sink = kitchen.counter(rng, style, kitchen.SINK_WIDTH, "sink")
    for pieces in ([machine, dryer, sink], [machine, dryer], [machine]):
        if place_at_wall(rng, state, in_a_row(pieces), corner=True, tries=3):
            break
    place_at_wall(rng, state, in_a_row([living.shelf(rng, style, stores=True)]), corner=True, tries=2)


def _furnish_garage(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Furnish a garage: a workbench, racks, a bicycle."""
    place_single(rng, state, model("workbench", rng, style), middle=True)
    rack = model("storage_rack", rng, style)
    for count in (2, 1):
        place_at_wall(rng, state, in_a_row([rack] * count), corner=True, tries=3)
    place_single(rng, state, model("bicycle", rng, style), corner=True)


def _furnish_balcony(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Furnish a balcony: a table with two folding chairs, or a deck chair."""
    table, seat = model("balcony_table", rng, style), model("folding_chair", rng, style)
    x = table.size[0] / 2 + seat.size[2] / 2 + 0.02
    z = table.wall_gap_m + table.size[2] / 2
    chairs = [Member(piece=seat, x=s * x, z=z, quarter=3 if s > 0 else 1) for s in (1, -1)]
    for members in ([Member(piece=table, z=z), *chairs], [Member(piece=table, z=z), chairs[0]]):
        if place_at_wall(rng, state, members, corner=True, tries=3):
            break
    place_single(rng, state, model("deck_chair", rng, style), corner=True)


_NEW: Mapping[str, Callable[[np.random.Generator, Style, RoomState, bool], None]] = {
    **FURNISH,
    "child": _furnish_child,
    "office": _furnish_office,
    "laundry": _furnish_laundry,
    "garage": _furnish_garage,
    "balcony": _furnish_balcony,
}


def furnish(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Furnish a room of any kind; raise `NoRoomError` if a necessary piece does not fit."""
    _NEW[state.room.category](rng, style, state, dining)
    _extras(rng, style, state)
    _on_walls(rng, style, state)
    settle(state)
    remodel(rng, style, state)
