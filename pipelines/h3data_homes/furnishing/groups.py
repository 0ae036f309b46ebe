"""Groups of furniture shared by several kinds of rooms, and pictures on walls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from h3data.errors import SceneError
from h3data.geometry import add_up
from h3data_homes.furnishing import furniture_bed as sleeping
from h3data_homes.furnishing import furniture_kitchen as kitchen
from h3data_homes.furnishing import furniture_living as living
from h3data_homes.furnishing.furniture import Furniture
from h3data_homes.furnishing.place import (
    Member,
    Placed,
    RoomState,
    around,
    commit,
    footprint,
    overlap,
    side_span,
    turned,
    wall_point,
)
from h3data_homes.furnishing.search import place_at_wall, place_free
from h3data_homes.solids import shade
from h3data_homes.style import Style


class NoRoomError(SceneError):
    """Error about a necessary piece of furniture that does not fit, after which another plan is tried."""


def backed(piece: Furniture, x: float = 0.0) -> Member:
    """Return a group member with its back against the wall, at ``x`` along the wall [m]."""
    return Member(piece=piece, x=x, z=piece.wall_gap_m + piece.size[2] / 2)


def place_single(
    rng: np.random.Generator,
    state: RoomState,
    piece: Furniture,
    *,
    corner: bool = False,
    middle: bool = False,
    only_corner: bool = False,
    left_corner: bool = False,
) -> list[Placed] | None:
    """Place one piece against a wall; see `place_at_wall` for the options and the result."""
    members = [backed(piece)]
    return place_at_wall(
        rng, state, members, corner=corner, middle=middle, only_corner=only_corner, left_corner=left_corner
    )


def need(group: list[Placed] | None, what: str, state: RoomState) -> list[Placed]:
    """Return the placed group; raise `NoRoomError` if it is None."""
    if group is None:
        raise NoRoomError(f"No place for the {what} in {state.room.name}.", code="H3-SCENE-022")
    return group


def in_a_row(pieces: Sequence[Furniture]) -> list[Member]:
    """Place pieces side by side along a wall, without gaps."""
    width = add_up(p.size[0] for p in pieces)
    members, x = [], -width / 2
    for p in pieces:
        members.append(backed(p, x + p.size[0] / 2))
        x += p.size[0]
    return members


def _with_other_fabrics(rng: np.random.Generator, style: Style) -> Style:
    """Return the style with its fabrics permuted, so that not all seats of a home look the same."""
    fabrics = [style.fabric, style.fabric_2, style.accent, shade(style.fabric, 1.35), shade(style.fabric_2, 0.7)]
    a, b, c = (fabrics[i] for i in rng.permutation(len(fabrics))[:3].tolist())
    return replace(style, fabric=a, fabric_2=b, accent=c)


def media_groups(rng: np.random.Generator, style: Style, depth: float, small: bool) -> list[list[Member]]:
    """Return variants of a group of TV stand, TV, rug, coffee table, sofa and, unless ``small``, an armchair.

    ``depth`` is the depth of the room [m]: the sofa either stands at the opposite wall or leaves room to walk behind
    it. The result is empty if the room is too shallow.
    """
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
        backed(stand),
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


def talk_group(rng: np.random.Generator, style: Style, chairs: int) -> list[Member]:
    """Return a group centred on a rug: two sofas facing each other across a table, or a sofa and up to two armchairs."""
    style = _with_other_fabrics(rng, style)
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


def place_talk(rng: np.random.Generator, style: Style, state: RoomState) -> list[Placed] | None:
    """Place a free-standing sofa with armchairs.

    The function tries more positions than for other groups, because large rooms look empty without this one.
    """
    for chairs in (2, 2, 2, 1, 1):
        group = place_free(rng, state, talk_group(rng, style, chairs))
        if group:
            return group
    return None


def place_rug(state: RoomState, rug: Furniture, by: Placed, distance: float) -> None:
    """Place a rug at ``distance`` [m] between centres in front of furniture, moved away from walls if needed."""
    dx, dz = turned(by.quarter, 0.0, distance)
    x, z = by.x + dx, by.z + dz
    x0, z0, x1, z1 = around(0.0, 0.0, rug.size[0] + 0.04, rug.size[2] + 0.04, by.quarter)
    a0, b0, a1, b1 = state.interior
    x, z = min(max(x, a0 - x0), a1 - x1), min(max(z, b0 - z0), b1 - z1)
    commit(state, [Placed(piece=rug, room=by.room, x=x, z=z, quarter=by.quarter)])


def place_shelves(rng: np.random.Generator, style: Style, state: RoomState, count: int) -> None:
    """Place up to ``count`` equal shelves side by side, filled with books or, in service rooms, with supplies."""
    shelf = living.shelf(rng, style, stores=state.room.category in ("pantry", "laundry", "kitchen", "bathroom"))
    for n in range(count, 0, -1):
        if place_at_wall(rng, state, in_a_row([shelf] * n), middle=True):
            return


def place_dining(rng: np.random.Generator, style: Style, state: RoomState, seats: Sequence[int]) -> list[Placed] | None:
    """Place a table with chairs, free-standing or with its end at a wall, for the first of ``seats`` that fits."""
    for count in seats:
        table, chair = kitchen.dining_table(rng, style, count), kitchen.chair(rng, style)
        w, _, d = table.size
        members = [Member(piece=table)]
        if state.room.category == "dining":
            members.append(Member(piece=living.rug(rng, style, (w + 1.2, d + 1.5))))
        per_side = count // 2
        for i in range(per_side):
            x = 0.0 if per_side == 1 else (i / (per_side - 1) - 0.5) * (w - 0.64)
            for s in (1, -1):
                reach = sleeping.chair_reach(rng)
                z = s * (d / 2 + reach - chair.size[2] / 2)
                yaw = float(rng.uniform(-0.05, 0.05))
                members.append(Member(piece=chair, x=x, z=z, quarter=2 if s > 0 else 0, yaw=yaw))
        group = place_free(rng, state, members)
        if group is None:
            shifted = [
                Member(piece=m.piece, x=m.z, z=m.x + 0.02 + w / 2, quarter=m.quarter + 1, yaw=m.yaw) for m in members
            ]
            group = place_at_wall(rng, state, shifted, middle=True)
        if group:
            return group
    return None


def place_desk(rng: np.random.Generator, style: Style, state: RoomState) -> list[Placed] | None:
    """Place a desk with a chair that is slightly pulled out."""
    desk, chair = sleeping.desk(rng, style), kitchen.chair(rng, style)
    edge = desk.wall_gap_m + desk.size[2]
    seat = Member(
        piece=chair,
        x=desk.size[0] / 2 - sleeping.DESK_DRAWERS - chair.size[0] / 2 - 0.025,
        z=edge + sleeping.chair_reach(rng) - chair.size[2] / 2,
        quarter=2,
        yaw=float(rng.uniform(-0.06, 0.06)),
    )
    return place_at_wall(rng, state, [backed(desk), seat], corner=True)


def hang(state: RoomState, piece: Furniture, side: int, u: float, y: float) -> bool:
    """Hang a flat piece with its centre at height ``y`` [m]; return False if something obstructs the wall there."""
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


def hang_pictures(rng: np.random.Generator, style: Style, state: RoomState, most: int) -> None:
    """Hang up to ``most`` pictures on free stretches of wall."""
    hung = 0
    for _ in range(12 + 4 * max(0, most - 3)):
        if hung == most:
            return
        side = int(rng.integers(4))
        low, high = side_span(state.interior, side)
        hung += hang(
            state, living.picture(rng, style), side, float(rng.uniform(low, high)), float(rng.uniform(1.5, 1.6))
        )
