"""Furniture of each kind of room, with the pieces that are hardest to place first.

Every `furnish_*` function raises `NoRoomError` if a necessary piece does not fit; their argument ``dining`` requests
the dining table.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from h3data_homes.furnishing import furniture_bath as bath
from h3data_homes.furnishing import furniture_bed as sleeping
from h3data_homes.furnishing import furniture_kitchen as kitchen
from h3data_homes.furnishing import furniture_living as living
from h3data_homes.furnishing.furniture import Furniture
from h3data_homes.furnishing.groups import (
    backed,
    hang,
    hang_pictures,
    in_a_row,
    media_groups,
    need,
    place_desk,
    place_dining,
    place_rug,
    place_shelves,
    place_single,
    place_talk,
    talk_group,
)
from h3data_homes.furnishing.place import Member, Placed, RoomState, commit, side_depth, turned
from h3data_homes.furnishing.search import place_at_wall, place_free
from h3data_homes.style import Style

_LARGE_M2 = 45.0
"""Living rooms above this area get more than one seating group."""


# --- living room, den, library, office --------------------------------------------------------------------------------
def furnish_living(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Furnish a living room with a sofa group with TV, shelves, lamp, plants, and the dining table if requested."""
    sides = rng.permutation(4).tolist()
    group = None
    for with_chair in (True, False):
        for side in sides:
            depth = side_depth(state.interior, side)
            for members in media_groups(rng, style, depth, small=not with_chair):
                group = group or place_at_wall(rng, state, members, middle=True, sides=[side])
    need(group, "sofa group", state)
    if dining:
        need(place_dining(rng, style, state, seats=(4,)), "dining table", state)
    size = (state.interior[2] - state.interior[0]) * (state.interior[3] - state.interior[1])
    for _ in range(2 if size > 26 else 1):
        place_single(rng, state, living.shelf(rng, style))
    place_single(rng, state, living.floor_lamp(rng, style), only_corner=True)
    for _ in range(2 if size > 24 else 1):
        place_single(rng, state, living.plant(rng, style), only_corner=True)
    if 24 < size < _LARGE_M2:
        place_desk(rng, style, state)
    if size > 28:
        place_single(rng, state, living.console(rng, style))
        place_single(rng, state, living.armchair(rng, style), corner=True)
    if size > _LARGE_M2:
        _more_groups(rng, style, state, int(size // 30))
        place_shelves(rng, style, state, 3)
    hang_pictures(rng, style, state, 2 + int(size // 20))


def _more_groups(rng: np.random.Generator, style: Style, state: RoomState, count: int) -> None:
    """Add more seats to a large room: free-standing groups and reading corners."""
    for _ in range(count):
        place_free(rng, state, talk_group(rng, style, int(rng.choice([0, 2]))))
    for _ in range(2):
        place_single(rng, state, living.armchair(rng, style), corner=True)
    for _ in range(2):
        place_single(rng, state, living.plant(rng, style))
    place_single(rng, state, living.bench(rng, style))


def furnish_den(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Furnish a den with a second sofa group with TV, shelves and a desk."""
    furnish_living(rng, style, state, dining)
    place_shelves(rng, style, state, 2)


def furnish_library(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Furnish a library with shelves along the walls, seats in the middle, and a desk."""
    need(place_at_wall(rng, state, in_a_row([living.shelf(rng, style)] * 2), middle=True), "shelves", state)
    place_talk(rng, style, state)
    for count in (4, 3, 3, 2):
        place_shelves(rng, style, state, count)
    place_desk(rng, style, state)
    for _ in range(2):
        place_single(rng, state, living.floor_lamp(rng, style), only_corner=True)
        place_single(rng, state, living.plant(rng, style), only_corner=True)
    hang_pictures(rng, style, state, 3)


def furnish_office(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Furnish an office with desks, shelves and seats for visitors."""
    need(place_desk(rng, style, state), "desk", state)
    if state.room.area > 20:
        place_desk(rng, style, state)
        place_talk(rng, style, state)
    for count in (3, 2):
        place_shelves(rng, style, state, count)
    place_single(rng, state, living.console(rng, style))
    place_single(rng, state, living.armchair(rng, style), corner=True)
    for _ in range(2):
        place_single(rng, state, living.plant(rng, style), only_corner=True)
    hang_pictures(rng, style, state, 4)


# --- dining room ------------------------------------------------------------------------------------------------------
def furnish_dining(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Furnish a dining room with a long table, sideboards, and shelves for dishes."""
    need(place_dining(rng, style, state, seats=(8, 6, 4)), "dining table", state)
    for _ in range(2):
        place_single(rng, state, living.console(rng, style), middle=True)
    if state.room.area > 38:
        place_talk(rng, style, state)
    place_shelves(rng, style, state, 2)
    for _ in range(3):
        place_single(rng, state, living.plant(rng, style), only_corner=True)
    hang_pictures(rng, style, state, 4)


# --- laundry, pantry --------------------------------------------------------------------------------------------------
def furnish_laundry(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Furnish a laundry with a row of machines, a sink and a counter, and with shelves."""
    machine, sink = bath.washer(rng, style), kitchen.counter(rng, style, kitchen.SINK_WIDTH, "sink")
    side = kitchen.counter(rng, style, 0.6)
    for pieces in ([machine, machine, sink, side], [machine, machine, sink], [machine, machine], [machine]):
        if place_at_wall(rng, state, in_a_row(pieces), corner=True):
            break
    for count in (2, 1):
        place_shelves(rng, style, state, count)
    hang_pictures(rng, style, state, 1)


def furnish_pantry(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Furnish a pantry with shelves along the walls."""
    for count in (3, 3, 2):
        place_shelves(rng, style, state, count)


# --- kitchen ----------------------------------------------------------------------------------------------------------
def furnish_kitchen(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Furnish a kitchen with fridge, counters, sink, stove, wall cabinets, and the dining table if requested."""
    fridge, stove = kitchen.fridge(rng, style), kitchen.stove(rng, style)
    sink = kitchen.counter(rng, style, kitchen.SINK_WIDTH, "sink")
    drawers, doors = kitchen.counter(rng, style, 0.6, "drawers"), kitchen.counter(rng, style, 0.6)
    slim = kitchen.counter(rng, style, 0.4)
    rows = [
        [fridge, drawers, sink, doors, stove, drawers],
        [fridge, doors, sink, drawers, stove],
        [fridge, sink, drawers, stove, slim],
        [fridge, sink, slim, stove],
    ]
    row = None
    for pieces in rows:
        for order in (pieces, pieces[::-1]) if rng.random() < 0.5 else (pieces[::-1], pieces):
            row = row or place_at_wall(rng, state, in_a_row(order), corner=True)
    if row is None:
        row = need(place_at_wall(rng, state, in_a_row([sink, slim, stove]), corner=True), "kitchen row", state)
        need(place_single(rng, state, fridge, corner=True), "fridge", state)
    second = [[doors, drawers, doors], [drawers, doors], [doors]]
    if dining:
        need(place_dining(rng, style, state, seats=(6, 4, 2)), "dining table", state)
    for pieces in second:
        more = place_at_wall(rng, state, in_a_row(pieces), corner=True)
        if more:
            row = [*row, *more]
            break
    _upper_cabinets(rng, style, state, row)
    if state.room.area > 24:
        _island(rng, style, state)
        if state.room.area > 34:
            place_dining(rng, style, state, seats=(4,))
            place_at_wall(rng, state, in_a_row([drawers, doors, drawers]), corner=True)
        place_shelves(rng, style, state, 2)
        for _ in range(2):
            place_single(rng, state, living.plant(rng, style), only_corner=True)
    if not dining:
        place_single(rng, state, living.plant(rng, style), only_corner=True)
    hang_pictures(rng, style, state, 1)


def _island(rng: np.random.Generator, style: Style, state: RoomState) -> None:
    """Add a free-standing counter with up to three stools behind it, or none if they do not fit."""
    block, seat = kitchen.island(rng, style), kitchen.stool(rng, style)
    for count in (3, 2, 0):
        z = -block.size[2] / 2 - 0.02
        stools = [Member(piece=seat, x=(i - (count - 1) / 2) * 0.56, z=z) for i in range(count)]
        if place_free(rng, state, [Member(piece=block), *stools]):
            return


def _upper_cabinets(rng: np.random.Generator, style: Style, state: RoomState, row: Sequence[Placed]) -> None:
    """Add cabinets above the counters and a hood above the stove, except in front of windows and doors."""
    cabinets: dict[float, Furniture] = {}
    for p in row:
        if p.piece.category not in ("kitchen_counter", "stove"):
            continue
        u, half = (p.x if p.quarter % 2 == 0 else p.z), p.piece.size[0] / 2
        holes = [*state.windows, *state.doors]
        if any(side == p.quarter and o.span[0] - 0.08 < u + half and u - half < o.span[1] + 0.08 for side, o in holes):
            continue
        width = p.piece.size[0]
        if p.piece.category == "stove":
            piece = kitchen.hood(rng, style)
        else:
            piece = cabinets.setdefault(width, kitchen.upper_cabinet(rng, style, width))
        dx, dz = turned(p.quarter, 0.0, -(p.piece.size[2] - piece.size[2]) / 2)
        state.placed.append(Placed(piece=piece, room=p.room, x=p.x + dx, z=p.z + dz, quarter=p.quarter))


# --- bedrooms ---------------------------------------------------------------------------------------------------------
def _bed_group(rng: np.random.Generator, style: Style, width: float, tables: int) -> list[Member]:
    """Return a bed with nightstands on ``tables`` sides."""
    bed, table = sleeping.bed(rng, style, width), sleeping.nightstand(rng, style)
    members = [backed(bed)]
    aside = bed.size[0] / 2 + table.size[0] / 2 + 0.03
    signs = (-1, 1) if tables == 2 else (int(rng.choice([-1, 1])),)[:tables]
    return [*members, *(backed(table, s * aside) for s in signs)]


def furnish_bedroom(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Furnish a bedroom with bed, nightstands, wardrobe, and, if space permits, desk with chair, shelf and plant."""
    large = state.room.area > 26
    main = large or not state.room.name.endswith(("_2", "_3"))
    wide = 1.6 if main else float(rng.choice([0.95, 1.0, 1.2]))
    group = None
    for width, tables in ((wide, 2 if main else 1), (wide, 1), (1.2, 1), (1.0, 1), (1.0, 0)):
        group = group or place_at_wall(
            rng, state, _bed_group(rng, style, width, tables), middle=tables == 2, corner=tables < 2
        )
    bed = need(group, "bed", state)[0]
    place_rug(state, living.rug(rng, style, (min(bed.piece.size[0] + 0.9, 2.4), 1.5)), bed, 0.55)
    need(place_single(rng, state, sleeping.wardrobe(rng, style), corner=True), "wardrobe", state)
    if large:
        _bedroom_extras(rng, style, state)
    place_desk(rng, style, state)
    place_single(rng, state, living.shelf(rng, style), corner=True)
    place_single(rng, state, living.plant(rng, style), only_corner=True)
    hang_pictures(rng, style, state, 5 if large else 2)


def _bedroom_extras(rng: np.random.Generator, style: Style, state: RoomState) -> None:
    """Add daytime furniture of a large bedroom: another wardrobe, a TV, seats."""
    place_single(rng, state, sleeping.wardrobe(rng, style), corner=True)
    stand, screen = living.tv_stand(rng, style), living.tv(rng, style)
    back = stand.wall_gap_m + stand.size[2] / 2
    place_at_wall(rng, state, [backed(stand), Member(piece=screen, z=back - 0.06, y=stand.size[1])], middle=True)
    place_talk(rng, style, state)
    place_single(rng, state, living.bench(rng, style))
    place_single(rng, state, living.armchair(rng, style), corner=True)
    place_single(rng, state, living.floor_lamp(rng, style), only_corner=True)


# --- bathrooms, hall --------------------------------------------------------------------------------------------------
def furnish_bathroom(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Furnish a bathroom with bathtub or shower, basin with mirror, toilet and mat."""
    first = rng.random() < 0.6 or state.room.area > 6.5
    done = place_single(rng, state, bath.bathtub(rng, style), corner=True) if first else None
    if done is None:
        done = place_single(rng, state, bath.shower(rng, style), left_corner=True)
    done = need(done, "bath or shower", state)
    basin = need(place_single(rng, state, bath.bathroom_sink(rng, style), middle=True), "basin", state)[0]
    need(place_single(rng, state, bath.toilet(rng, style)), "toilet", state)
    if state.room.area > 12:
        second = place_single(rng, state, bath.bathroom_sink(rng, style))
        if second:
            _mirror(rng, style, state, second[0], 0.6)
    if first and done[0].piece.category == "bathtub":
        place_single(rng, state, bath.shower(rng, style), left_corner=True)
    _mirror(rng, style, state, basin, min(0.7, basin.piece.size[0]))
    place_single(rng, state, living.plant(rng, style), only_corner=True)
    if state.room.area > 12:
        place_shelves(rng, style, state, 1)
        place_single(rng, state, living.bench(rng, style))
    hang_pictures(rng, style, state, 1)
    place_rug(state, bath.mat(rng, style), done[0], done[0].piece.size[2] / 2 + 0.3)


def _mirror(rng: np.random.Generator, style: Style, state: RoomState, basin: Placed, width: float) -> None:
    """Add a mirror above a basin, narrower next to a door or window."""
    u = basin.x if basin.quarter % 2 == 0 else basin.z
    any(hang(state, bath.mirror(rng, style, w), basin.quarter, u, 1.52) for w in (width, 0.45, 0.35))


def furnish_hall(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Furnish a hall with a shoe cabinet, a plant, pictures and a runner; long galleries get several of each."""
    _runner(rng, style, state, least_m=1.3)
    for _ in range(int(state.room.area // 20)):
        place_single(rng, state, living.bench(rng, style))
        place_single(rng, state, living.console(rng, style))
        place_single(rng, state, living.plant(rng, style))
    place_single(rng, state, living.console(rng, style))
    place_single(rng, state, living.plant(rng, style), only_corner=True)
    hang_pictures(rng, style, state, 3 + int(state.room.area // 8))
    if not state.rugs:
        _runner(rng, style, state, least_m=0.95)


def _runner(rng: np.random.Generator, style: Style, state: RoomState, least_m: float) -> None:
    """Add a long, narrow carpet down the middle of a hall that is at least ``least_m`` wide."""
    x0, z0, x1, z1 = state.interior
    wide, long = sorted((x1 - x0, z1 - z0))
    if wide < least_m or long < 4:
        return
    carpet = living.rug(rng, style, (long - float(rng.uniform(1.2, 2.5)), 0.62 * wide))
    quarter = 0 if x1 - x0 > z1 - z0 else 1
    commit(state, [Placed(piece=carpet, room=state.room.name, x=(x0 + x1) / 2, z=(z0 + z1) / 2, quarter=quarter)])


FURNISH: Mapping[str, Callable[[np.random.Generator, Style, RoomState, bool], None]] = {
    "living": furnish_living,
    "kitchen": furnish_kitchen,
    "bedroom": furnish_bedroom,
    "bathroom": furnish_bathroom,
    "hall": furnish_hall,
    "dining": furnish_dining,
    "den": furnish_den,
    "office": furnish_office,
    "library": furnish_library,
    "laundry": furnish_laundry,
    "pantry": furnish_pantry,
}
