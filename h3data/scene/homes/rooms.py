"""What belongs into each kind of room, and in what order it is placed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from h3data.errors import SceneError
from h3data.scene.homes import furniture_bath as bath
from h3data.scene.homes import furniture_bed as sleeping
from h3data.scene.homes import furniture_kitchen as kitchen
from h3data.scene.homes import furniture_living as living
from h3data.scene.homes.furniture import Furniture
from h3data.scene.homes.place import (
    Member,
    Placed,
    RoomState,
    commit,
    footprint,
    overlap,
    place_at_wall,
    place_free,
    side_depth,
    side_span,
    turned,
    wall_point,
)
from h3data.scene.homes.solids import shade
from h3data.scene.homes.style import Style

_LARGE_M2 = 45.0
"""Living rooms above this need more than one group of seats."""


class NoRoomError(SceneError):
    """A necessary piece of furniture found no place: another plan has to be tried."""


def _backed(piece: Furniture, x: float = 0.0) -> Member:
    return Member(piece=piece, x=x, z=piece.wall_gap_m + piece.size[2] / 2)


def _single(
    rng: np.random.Generator,
    state: RoomState,
    piece: Furniture,
    *,
    corner: bool = False,
    middle: bool = False,
    only_corner: bool = False,
    left_corner: bool = False,
) -> list[Placed] | None:
    members = [_backed(piece)]
    return place_at_wall(
        rng, state, members, corner=corner, middle=middle, only_corner=only_corner, left_corner=left_corner
    )


def _need(found: list[Placed] | None, what: str, state: RoomState) -> list[Placed]:
    if found is None:
        raise NoRoomError(f"No place for the {what} in {state.room.name}.")
    return found


# --- living room ------------------------------------------------------------------------------------------------------
def _media_group(rng: np.random.Generator, style: Style, depth: float, small: bool) -> list[list[Member]]:
    """Variants of tv stand, tv, rug, coffee table, sofa and armchair that span from the tv's wall to the sofa."""
    stand, screen = living.tv_stand(rng, style), living.tv(rng, style)
    table, sofa = living.coffee_table(rng, style), living.sofa(rng, style)
    chair = living.armchair(rng, style)
    front = stand.wall_gap_m + stand.size[2]
    knee = float(rng.uniform(0.36, 0.42))
    fixed = front + table.size[2] + knee + sofa.size[2] + 0.02
    slack = depth - fixed
    if slack < 0.8:
        return []
    if slack <= 2.0:
        aisle = slack
    elif slack - 0.8 < 0.9:
        aisle = slack - 0.8
    else:
        aisle = float(rng.uniform(1.0, min(1.7, slack - 0.8)))
    table_z = front + aisle + table.size[2] / 2
    sofa_z = table_z + table.size[2] / 2 + knee + sofa.size[2] / 2
    carpet = living.rug(rng, style, (sofa.size[0] - 0.04, table.size[2] + 1.0))
    base = [
        _backed(stand),
        Member(piece=screen, z=front - stand.size[2] / 2 - 0.06, y=stand.size[1]),
        Member(piece=carpet, z=table_z + 0.05),
        Member(piece=table, z=table_z),
        Member(piece=sofa, z=sofa_z, quarter=2),
    ]
    beside = table.size[0] / 2 + knee + chair.size[2] / 2
    variants = [
        [*base, Member(piece=chair, x=s * beside, z=table_z - 0.05, quarter=3 if s > 0 else 1)] for s in (1, -1)
    ]
    return [base] if small else [*variants, base]


def furnish_living(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Sofa group with tv, perhaps the dining table, shelves, lamp and plants."""
    sides = rng.permutation(4).tolist()
    group = None
    for with_chair in (True, False):
        for side in sides:
            depth = side_depth(state.interior, side)
            for members in _media_group(rng, style, depth, small=not with_chair):
                group = group or place_at_wall(rng, state, members, middle=True, sides=[side])
    _need(group, "sofa group", state)
    if dining:
        _need(_dining(rng, style, state, seats=(4,)), "dining table", state)
    size = (state.interior[2] - state.interior[0]) * (state.interior[3] - state.interior[1])
    for _ in range(2 if size > 26 else 1):
        _single(rng, state, living.shelf(rng, style))
    _single(rng, state, living.floor_lamp(rng, style), only_corner=True)
    for _ in range(2 if size > 24 else 1):
        _single(rng, state, living.plant(rng, style), only_corner=True)
    if 24 < size < _LARGE_M2:
        _desk(rng, style, state)
    if size > 28:
        _single(rng, state, living.console(rng, style))
        _single(rng, state, living.armchair(rng, style), corner=True)
    if size > _LARGE_M2:
        _more_groups(rng, style, state, int(size // 30))
        _shelf_wall(rng, style, state, 3)
    pictures(rng, style, state, 2 + int(size // 20))


def _other(rng: np.random.Generator, style: Style) -> Style:
    """The style with its fabrics changed about, so that not all seats of a home are of one set."""
    fabrics = [style.fabric, style.fabric_2, style.accent, shade(style.fabric, 1.35), shade(style.fabric_2, 0.7)]
    a, b, c = (fabrics[i] for i in rng.permutation(len(fabrics))[:3].tolist())
    return replace(style, fabric=a, fabric_2=b, accent=c)


def _talk_group(rng: np.random.Generator, style: Style, chairs: int) -> list[Member]:
    """Two sofas that face each other over a table, or a sofa and two armchairs, about the middle of a rug."""
    style = _other(rng, style)
    table, sofa = living.coffee_table(rng, style), living.sofa(rng, style)
    knee = float(rng.uniform(0.36, 0.42))
    away = table.size[2] / 2 + knee
    carpet = living.rug(rng, style, (sofa.size[0] + 0.3, 2 * away + 1.0))
    members = [
        Member(piece=carpet),
        Member(piece=table),
        Member(piece=sofa, z=-away - sofa.size[2] / 2),
    ]
    if not chairs:
        return [*members, Member(piece=sofa, z=away + sofa.size[2] / 2, quarter=2)]
    chair = living.armchair(rng, style)
    beside = chair.size[0] / 2 + 0.06
    z = away + chair.size[2] / 2
    return [*members, *(Member(piece=chair, x=s * beside, z=z, quarter=2) for s in (-1, 1)[:chairs])]


def _more_groups(rng: np.random.Generator, style: Style, state: RoomState, count: int) -> None:
    """Further seats in a large room: groups in the open, and corners to read in."""
    for _ in range(count):
        place_free(rng, state, _talk_group(rng, style, int(rng.choice([0, 2]))))
    for _ in range(2):
        _single(rng, state, living.armchair(rng, style), corner=True)
    for _ in range(2):
        _single(rng, state, living.plant(rng, style))
    _single(rng, state, living.bench(rng, style))


def _shelf_wall(rng: np.random.Generator, style: Style, state: RoomState, count: int) -> None:
    """Up to ``count`` equal shelves side by side, with books or, where things are kept, with stores."""
    shelf = living.shelf(rng, style, stores=state.room.category in ("pantry", "laundry", "kitchen", "bathroom"))
    for n in range(count, 0, -1):
        if place_at_wall(rng, state, _row([shelf] * n), middle=True):
            return


def furnish_den(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """A second sofa group with tv, shelves, a desk."""
    furnish_living(rng, style, state, dining)
    _shelf_wall(rng, style, state, 2)


def furnish_library(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Shelves along the walls, seats in the middle."""
    del dining
    _need(place_at_wall(rng, state, _row([living.shelf(rng, style)] * 2), middle=True), "shelves", state)
    place_free(rng, state, _talk_group(rng, style, 2))
    for count in (4, 3, 3, 2):
        _shelf_wall(rng, style, state, count)
    _desk(rng, style, state)
    for _ in range(2):
        _single(rng, state, living.floor_lamp(rng, style), only_corner=True)
        _single(rng, state, living.plant(rng, style), only_corner=True)
    pictures(rng, style, state, 3)


def furnish_office(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Desks, shelves, a seat for visitors."""
    del dining
    _need(_desk(rng, style, state), "desk", state)
    if state.room.area > 20:
        _desk(rng, style, state)
        place_free(rng, state, _talk_group(rng, style, 2))
    for count in (3, 2):
        _shelf_wall(rng, style, state, count)
    _single(rng, state, living.console(rng, style))
    _single(rng, state, living.armchair(rng, style), corner=True)
    for _ in range(2):
        _single(rng, state, living.plant(rng, style), only_corner=True)
    pictures(rng, style, state, 4)


# --- dining room ------------------------------------------------------------------------------------------------------
def furnish_dining(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """One long table, or two, sideboards, a shelf for the dishes."""
    del dining
    _need(_dining(rng, style, state, seats=(8, 6, 4)), "dining table", state)
    for _ in range(2):
        _single(rng, state, living.console(rng, style), middle=True)
    if state.room.area > 38:
        place_free(rng, state, _talk_group(rng, style, 2))
    _shelf_wall(rng, style, state, 2)
    for _ in range(3):
        _single(rng, state, living.plant(rng, style), only_corner=True)
    pictures(rng, style, state, 4)


# --- laundry, pantry --------------------------------------------------------------------------------------------------
def furnish_laundry(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Machines and a counter in a row, shelves."""
    del dining
    machine, sink = bath.washer(rng, style), kitchen.counter(rng, style, kitchen.SINK_WIDTH, "sink")
    side = kitchen.counter(rng, style, 0.6)
    for pieces in ([machine, machine, sink, side], [machine, machine, sink], [machine, machine], [machine]):
        if place_at_wall(rng, state, _row(pieces), corner=True):
            break
    for count in (2, 1):
        _shelf_wall(rng, style, state, count)
    pictures(rng, style, state, 1)


def furnish_pantry(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Shelves on all walls."""
    del dining
    for count in (3, 3, 2):
        _shelf_wall(rng, style, state, count)


# --- kitchen ----------------------------------------------------------------------------------------------------------
def _dining(rng: np.random.Generator, style: Style, state: RoomState, seats: Sequence[int]) -> list[Placed] | None:
    for count in seats:
        table, chair = kitchen.dining_table(rng, style, count), kitchen.chair(rng, style)
        w, _, d = table.size
        members = [Member(piece=table)]
        per_side = count // 2
        for i in range(per_side):
            x = 0.0 if per_side == 1 else (i / (per_side - 1) - 0.5) * (w - 0.64)
            for s in (1, -1):
                reach = sleeping.chair_reach(rng)
                z = s * (d / 2 + reach - chair.size[2] / 2)
                yaw = float(rng.uniform(-0.05, 0.05))
                members.append(Member(piece=chair, x=x, z=z, quarter=2 if s > 0 else 0, yaw=yaw))
        found = place_free(rng, state, members)
        if found is None:
            shifted = [
                Member(piece=m.piece, x=m.z, z=m.x + 0.02 + w / 2, quarter=m.quarter + 1, yaw=m.yaw) for m in members
            ]
            found = place_at_wall(rng, state, shifted, middle=True)
        if found:
            return found
    return None


def furnish_kitchen(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """A row of fridge, counters, sink and stove with cabinets above; the table if it is eaten here."""
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
            row = row or place_at_wall(rng, state, _row(order), corner=True)
    if row is None:
        row = _need(place_at_wall(rng, state, _row([sink, slim, stove]), corner=True), "kitchen row", state)
        _need(_single(rng, state, fridge, corner=True), "fridge", state)
    second = [[doors, drawers, doors], [drawers, doors], [doors]]
    if dining:
        _need(_dining(rng, style, state, seats=(6, 4, 2)), "dining table", state)
    for pieces in second:
        more = place_at_wall(rng, state, _row(pieces), corner=True)
        if more:
            row = [*row, *more]
            break
    _upper_cabinets(rng, style, state, row)
    if state.room.area > 24:
        _island(rng, style, state)
        if state.room.area > 34:
            _dining(rng, style, state, seats=(4,))
            place_at_wall(rng, state, _row([drawers, doors, drawers]), corner=True)
        _shelf_wall(rng, style, state, 2)
        for _ in range(2):
            _single(rng, state, living.plant(rng, style), only_corner=True)
    if not dining:
        _single(rng, state, living.plant(rng, style), only_corner=True)
    pictures(rng, style, state, 1)


def _island(rng: np.random.Generator, style: Style, state: RoomState) -> None:
    """A free-standing counter with stools at its back; without them where they find no room."""
    block, seat = kitchen.island(rng, style), kitchen.stool(rng, style)
    for count in (3, 2, 0):
        z = -block.size[2] / 2 - 0.02
        stools = [Member(piece=seat, x=(i - (count - 1) / 2) * 0.56, z=z) for i in range(count)]
        if place_free(rng, state, [Member(piece=block), *stools]):
            return


def _row(pieces: Sequence[Furniture]) -> list[Member]:
    width = sum(p.size[0] for p in pieces)
    members, x = [], -width / 2
    for p in pieces:
        members.append(_backed(p, x + p.size[0] / 2))
        x += p.size[0]
    return members


def _upper_cabinets(rng: np.random.Generator, style: Style, state: RoomState, row: Sequence[Placed]) -> None:
    cabinets: dict[float, Furniture] = {}
    for p in row:
        if p.piece.category != "kitchen_counter":
            continue
        u, half = (p.x if p.quarter % 2 == 0 else p.z), p.piece.size[0] / 2
        holes = [*state.windows, *state.doors]
        if any(side == p.quarter and o.span[0] - 0.08 < u + half and u - half < o.span[1] + 0.08 for side, o in holes):
            continue
        width = p.piece.size[0]
        cabinets.setdefault(width, kitchen.upper_cabinet(rng, style, width))
        dx, dz = turned(p.quarter, 0.0, -(p.piece.size[2] - cabinets[width].size[2]) / 2)
        state.placed.append(Placed(piece=cabinets[width], room=p.room, x=p.x + dx, z=p.z + dz, quarter=p.quarter))


# --- bedrooms ---------------------------------------------------------------------------------------------------------
def _bed_group(rng: np.random.Generator, style: Style, width: float, tables: int) -> list[Member]:
    bed, table = sleeping.bed(rng, style, width), sleeping.nightstand(rng, style)
    members = [_backed(bed)]
    aside = bed.size[0] / 2 + table.size[0] / 2 + 0.03
    signs = (-1, 1) if tables == 2 else (int(rng.choice([-1, 1])),)[:tables]
    return [*members, *(_backed(table, s * aside) for s in signs)]


def furnish_bedroom(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Bed with nightstands, wardrobe, desk with chair, and what else fits."""
    del dining
    large = state.room.area > 26
    main = large or not state.room.name.endswith(("_2", "_3"))
    wide = 1.6 if main else float(rng.choice([0.95, 1.0, 1.2]))
    group = None
    for width, tables in ((wide, 2 if main else 1), (wide, 1), (1.2, 1), (1.0, 1), (1.0, 0)):
        group = group or place_at_wall(
            rng, state, _bed_group(rng, style, width, tables), middle=tables == 2, corner=tables < 2
        )
    bed = _need(group, "bed", state)[0]
    dx, dz = turned(bed.quarter, 0.0, 0.55)
    carpet = living.rug(rng, style, (min(bed.piece.size[0] + 0.9, 2.4), 1.5))
    commit(state, [Placed(piece=carpet, room=bed.room, x=bed.x + dx, z=bed.z + dz, quarter=bed.quarter)])
    _need(_single(rng, state, sleeping.wardrobe(rng, style), corner=True), "wardrobe", state)
    if large:
        _bedroom_extras(rng, style, state)
    _desk(rng, style, state)
    _single(rng, state, living.shelf(rng, style), corner=True)
    _single(rng, state, living.plant(rng, style), only_corner=True)
    pictures(rng, style, state, 5 if large else 2)


def _bedroom_extras(rng: np.random.Generator, style: Style, state: RoomState) -> None:
    """What makes a large bedroom a place to stay in by day: more wardrobes, a tv, seats."""
    _single(rng, state, sleeping.wardrobe(rng, style), corner=True)
    stand, screen = living.tv_stand(rng, style), living.tv(rng, style)
    back = stand.wall_gap_m + stand.size[2] / 2
    place_at_wall(rng, state, [_backed(stand), Member(piece=screen, z=back - 0.06, y=stand.size[1])], middle=True)
    place_free(rng, state, _talk_group(rng, style, 2))
    _single(rng, state, living.bench(rng, style))
    _single(rng, state, living.armchair(rng, style), corner=True)
    _single(rng, state, living.floor_lamp(rng, style), only_corner=True)


def _desk(rng: np.random.Generator, style: Style, state: RoomState) -> list[Placed] | None:
    desk, chair = sleeping.desk(rng, style), kitchen.chair(rng, style)
    edge = desk.wall_gap_m + desk.size[2]
    seat = Member(
        piece=chair,
        x=desk.size[0] / 2 - sleeping.DESK_DRAWERS - chair.size[0] / 2 - 0.025,
        z=edge + sleeping.chair_reach(rng) - chair.size[2] / 2,
        quarter=2,
        yaw=float(rng.uniform(-0.06, 0.06)),
    )
    return place_at_wall(rng, state, [_backed(desk), seat], corner=True)


# --- bathrooms, hall --------------------------------------------------------------------------------------------------
def furnish_bathroom(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Bath or shower first (they are hardest to place), basin with mirror, toilet, mat."""
    del dining
    first = rng.random() < 0.6 or state.room.area > 6.5
    done = _single(rng, state, bath.bathtub(rng, style), corner=True) if first else None
    if done is None:
        done = _single(rng, state, bath.shower(rng, style), left_corner=True)
    done = _need(done, "bath or shower", state)
    basin = _need(_single(rng, state, bath.bathroom_sink(rng, style), middle=True), "basin", state)[0]
    _need(_single(rng, state, bath.toilet(rng, style)), "toilet", state)
    if state.room.area > 12:
        second = _single(rng, state, bath.bathroom_sink(rng, style))
        if second:
            glass, p = bath.mirror(rng, style, 0.6), second[0]
            _hang(state, glass, p.quarter, p.x if p.quarter % 2 == 0 else p.z, 1.52)
    if first and done[0].piece.category == "bathtub":
        _single(rng, state, bath.shower(rng, style), left_corner=True)
    glass = bath.mirror(rng, style, min(0.7, basin.piece.size[0]))
    _hang(state, glass, basin.quarter, basin.x if basin.quarter % 2 == 0 else basin.z, 1.52)
    _single(rng, state, living.plant(rng, style), only_corner=True)
    if state.room.area > 12:
        _shelf_wall(rng, style, state, 1)
        _single(rng, state, living.bench(rng, style))
    pictures(rng, style, state, 1)


def furnish_hall(rng: np.random.Generator, style: Style, state: RoomState, dining: bool) -> None:
    """Narrow: a shoe cabinet, a plant, pictures; galleries get more of it."""
    del dining
    _runner(rng, style, state)
    for _ in range(int(state.room.area // 20)):
        _single(rng, state, living.bench(rng, style))
        _single(rng, state, living.console(rng, style))
        _single(rng, state, living.plant(rng, style))
    _single(rng, state, living.console(rng, style))
    _single(rng, state, living.plant(rng, style), only_corner=True)
    pictures(rng, style, state, 3 + int(state.room.area // 8))


def _runner(rng: np.random.Generator, style: Style, state: RoomState) -> None:
    """A long narrow carpet down the middle of a wide hall."""
    x0, z0, x1, z1 = state.interior
    wide, long = sorted((x1 - x0, z1 - z0))
    if wide < 1.3 or long < 4:
        return
    carpet = living.rug(rng, style, (long - float(rng.uniform(1.2, 2.5)), 0.62 * wide))
    quarter = 0 if x1 - x0 > z1 - z0 else 1
    commit(state, [Placed(piece=carpet, room=state.room.name, x=(x0 + x1) / 2, z=(z0 + z1) / 2, quarter=quarter)])


# --- on walls ---------------------------------------------------------------------------------------------------------
def _hang(state: RoomState, piece: Furniture, side: int, u: float, y: float) -> bool:
    """Hangs a flat thing with its middle at height y, unless an opening, a tall piece or another one is there."""
    half = piece.size[0] / 2 + 0.1
    low, high = side_span(state.interior, side)
    if u - half < low or u + half > high:
        return False
    if any(
        k == side and o.span[0] - half - 0.05 < u < o.span[1] + half + 0.05 for k, o in (*state.windows, *state.doors)
    ):
        return False
    x, z = wall_point(state.interior, side, u)
    dx, dz = turned(side, 0.0, 0.05)
    span = (half, 0.1) if side % 2 == 0 else (0.1, half)
    rect = (x + dx - span[0], z + dz - span[1], x + dx + span[0], z + dz + span[1])
    for p in state.placed:
        top = p.y + p.piece.size[1] if p.piece.category not in ("picture", "mirror") else 9.0
        if top > y - piece.size[1] / 2 - 0.05 and overlap(footprint(p), rect):
            return False
    state.placed.append(Placed(piece=piece, room=state.room.name, x=x, z=z, quarter=side, y=y))
    return True


def pictures(rng: np.random.Generator, style: Style, state: RoomState, most: int) -> None:
    """Up to ``most`` pictures on free stretches of wall."""
    hung = 0
    for _ in range(12 + 4 * max(0, most - 3)):
        if hung == most:
            return
        side = int(rng.integers(4))
        low, high = side_span(state.interior, side)
        hung += _hang(
            state, living.picture(rng, style), side, float(rng.uniform(low, high)), float(rng.uniform(1.5, 1.6))
        )


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
