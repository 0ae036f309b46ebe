"""Seats that a person can use, and the motions of sitting down and getting up.

The motion starts at a place in front of the seat, on the floor on which people walk. There the person turns their back
to the seat and steps straight back to it. A seat cannot be used if the body would overlap a thing on the path to it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, repeat
from typing import NamedTuple

import numpy as np

from h3data.bodies import Humanoid
from h3data.bodies.people.sitting import TUCKED, TURNED, Sitting, sitting_on
from h3data.errors import InputError
from h3data.geometry import Array, ground_pose, smoothstep, wrap_angle
from h3data.scene import FreeSpace, Scene
from h3data.scene.records import Capsule, instance_bounds
from h3data.scene.seats import Seat, seats_of
from sim_kinematic.contact import MovingShapes, contacts
from sim_kinematic.contact.clearance import scenery_of
from sim_kinematic.contact.frames import body_shapes, shape_frames
from sim_kinematic.crowd.errands import Motion, Station
from sim_kinematic.motion.spec import STEP_S

SIT_S, RISE_S, SETTLE_S, LIE_S = 2.0, 1.8, 1.5, 5.0
"""Durations of sitting down, of getting up, of standing still before either, and of lying down or sitting up [s]."""
STEP_MPS, TURN_RAD_S = 0.35, 1.2
"""Mean speeds of steps [m/s] and of turns [rad/s] in front of a seat."""
BRISK, BRISK_SETTLE_S = 1.5, 0.5
"""Factor of these speeds for people with routines before they sit down, and time for which they stand still then [s]."""
AWAY_M = tuple(0.1 * k for k in range(1, 13))
"""Distances that are tried between the place where people turn and the place where they stand before they sit down [m];
the first with enough room is used."""
ROOM_M = 0.27
"""Least distance of the place of the turn from obstacles [m]."""
DEPTH_M = 0.018
"""Depth by which the collision shapes of a seated person may overlap the seat, as cushions give way [m]."""
BESIDE_M = 0.8
"""Distance from a table or desk within which seats belong to it [m]."""
APART_M, LIES_APART_M = 0.75, 1.6
"""Least distance between people who sit side by side, and least distance from the hips of a person who lies to people
who sit down [m]."""


NEAR_M = 3.0
"""Distance within which the nearest seat is used when a person who is driven from outside has to sit down [m]."""


class SeatPlace(NamedTuple):
    """Seat that a person can use, and the places on the path to it."""

    seat: Seat
    before: Array
    """Place ``(x, z, heading)`` [3] at which the person turns their back to the seat."""
    stand: Array
    """Place ``(x, z, heading)`` [3] at which the person stands before sitting down."""
    lie: Array | None = None
    """Place ``(x, z, heading)`` of the hips of a person who lies with the feet ahead, and distance of the hips ahead of
    the root [m], [4]; None if the person only sits."""

    @property
    def taken(self) -> Array:
        """Place ``(x, z, heading)`` of the person who uses the seat, and distance [m] that others keep from it, [4]."""
        return np.append(*((self.stand, APART_M) if self.lie is None else (self.lie[:3], LIES_APART_M)))

    def station(self, *, brisk: bool) -> Station:
        """Return the station at which a person of a crowd uses the seat, who moves ``brisk`` before they sit down."""
        return Station(
            self.seat.name,
            self.seat.height_m,
            self.taken,
            lambda here, seconds: sit_for(here, self, seconds, brisk=brisk),
        )


def fit(body: Humanoid, seat: Seat) -> Sitting:
    """Return the motion by which a body sits down on a seat.

    Raises:
        InputError: The seat is too high, too low or too shallow for this body.
    """
    # rounded, so that seats of about the same height share a motion, which takes long to compute
    sitting = sitting_on(body, round(seat.height_m, 3))
    if not sitting.fits(seat.depth_m):
        raise InputError(
            f"{body.name} needs {sitting.edge_m - sitting.back_m:.2f} m of depth to sit, {seat.name} has "
            f"{seat.depth_m:.2f} m. Hint: choose a deeper seat.",
            code="H3-SIM-059",
        )
    return sitting


def stand_before(body: Humanoid, seat: Seat) -> Array:
    """Return the place ``(x, z, heading)`` [3] where a person stands before sitting down, with the back to the seat.

    Raises:
        InputError: The seat is too high, too low or too shallow for this body.
    """
    ahead = np.array([np.cos(seat.heading), -np.sin(seat.heading)])
    return np.append(seat.edge[[0, 2]] - fit(body, seat).edge_m * ahead, seat.heading)


class Seats:
    """Seats of a home for one person."""

    def __init__(self, scene: Scene, free: FreeSpace, body: Humanoid) -> None:
        """Find the seats of a scene, for a body that walks on the floor ``free``."""
        self._scene, self._free, self._body = scene, free, body
        self._seats = seats_of(scene)
        self._before: dict[str, Array | None] = {}
        self._lying: dict[str, bool] = {}
        """Room to lie on a seat, by its name: True if the body has it."""

    def at(self, thing: str) -> list[Seat]:
        """Return the seats of a thing in the home, or, if it has none, the seats beside it, nearest first."""
        own = [seat for seat in self._seats if seat.name.partition(":")[0] == thing or seat.name == thing]
        if own:
            return own
        instance = next(instance for instance in self._scene.instances if instance.name == thing)
        low, high = instance_bounds(self._scene, instance)[:, [0, 2]]
        gaps = [np.hypot(*(np.clip(seat.edge[[0, 2]], low, high) - seat.edge[[0, 2]])) for seat in self._seats]
        return [self._seats[k] for k in np.argsort(gaps, kind="stable") if gaps[k] < BESIDE_M]

    def place(self, seat: Seat, taken: Sequence[Array] = ()) -> SeatPlace:
        """Return the places for using a seat, given the places ``(x, z, ...)`` that are ``taken`` by others.

        Raises:
            InputError: The seat does not fit the body, is taken, or has no room in front of it.
        """
        x, z, heading = stand_before(self._body, seat).tolist()
        if any(math.hypot(other[0] - x, other[1] - z) < (*other[3:], APART_M)[0] for other in taken):
            raise InputError(
                f"{seat.name} is taken, or the seat beside it. Hint: choose another one.", code="H3-SIM-064"
            )
        stand = np.array([x, z, heading])
        if seat.name not in self._before:
            self._before[seat.name] = self._find_before(seat, stand)
        before = self._before[seat.name]
        if before is None:
            raise InputError(
                f"There is no room for {self._body.name} to sit down on {seat.name} from the floor before it. Hint: choose a "
                "seat that is not pushed under a table.",
                code="H3-SIM-065",
            )
        return SeatPlace(seat, before, stand)

    def to_lie(self, place: SeatPlace, taken: Sequence[Array] = ()) -> SeatPlace:
        """Return the places for lying down on a usable seat, given the places ``(x, z, ...)`` taken by others.

        Raises:
            InputError: The surface is too small for the body, or an object or a person is in the way.
        """
        seat, sitting = place.seat, fit(self._body, place.seat)
        to_head, to_feet, aside = sitting.lying_size.tolist()
        side, hips = math.copysign(1.0, seat.ends[0] - seat.ends[1]), float(sitting.lying[1][0, 0])
        # as near to where the person sits as the surface allows
        along = min(max(0.0, side * seat.ends[1] + to_feet), side * seat.ends[0] - to_head)
        inward = min(max(aside, sitting.edge_m - hips), seat.depth_m - aside)
        ahead = np.array([math.cos(seat.heading), -math.sin(seat.heading)])
        at = seat.edge[[0, 2]] - inward * ahead + side * along * np.array([ahead[1], -ahead[0]])
        lies = place._replace(lie=np.array([*at, seat.heading - side * math.pi / 2, hips]))
        small = along < side * seat.ends[1] + to_feet or inward < aside
        small = small or any(math.hypot(*(other[:2] - at)) < LIES_APART_M for other in taken)
        if not small and seat.name not in self._lying:
            shares = np.linspace(1, 2, len(sitting.lying[1]))[::5]
            track = np.array([root_at(lies, share) for share in shares.tolist()])
            # the seat itself carries the body
            self._lying[seat.name] = self._is_clear(
                track, sitting.lying[0][::5], sitting.lying[1][::5], on=seat.name.partition(":")[0]
            )
        if small or not self._lying[seat.name]:
            raise InputError(
                f"{self._body.name} cannot lie on {seat.name}: there is no room. Hint: choose a bed of "
                f"{to_head + to_feet:.2f} x {2 * aside:.2f} m or more, with nothing higher and nobody beside it.",
                code="H3-SIM-069",
            )
        return lies

    def nearest(
        self, xz: Array, taken: Sequence[Array] = (), *, within_m: float = NEAR_M, lies: bool = False
    ) -> SeatPlace | None:
        """Return the places for using the nearest seat that fits within a distance [m] of a place [2], or None.

        If ``lies``, the person lies down there.
        """
        gaps = {seat.name: float(np.hypot(*(seat.edge[[0, 2]] - xz))) for seat in self._seats}
        for seat in sorted(self._seats, key=lambda seat: gaps[seat.name]):
            if gaps[seat.name] > within_m:
                break
            try:
                place = self.place(seat, taken)
                place = self.to_lie(place, taken) if lies else place
            except InputError:
                continue
            if np.isfinite(self._free.geodesic(xz, place.before[:2])):
                return place
        return None

    def _find_before(self, seat: Seat, stand: Array) -> Array | None:
        """Return the place ``(x, z, heading)`` from which the person steps back to the seat; None: there is none."""
        sitting, heading = fit(self._body, seat), float(stand[2])
        shares = np.linspace(0, 1, 7)
        if self._is_clear(np.tile(stand, (len(shares), 1)), *sitting.pose(shares), depth_m=DEPTH_M):
            # directions of this step relative to the seat's, in the order of trial. Feet that step
            # farther sideways would hit the seat.
            for side in map(math.radians, (0, 20, -20, 40, -40)):
                out = np.array([math.cos(heading + side), -math.sin(heading + side)])
                for away in AWAY_M:
                    at = stand[:2] + away * out
                    if self._free.signed_distance(at) < ROOM_M:
                        continue
                    steps = np.arange(0.1, away + 0.1, 0.1)[:, None] * out + stand[:2]
                    track = np.column_stack([steps, np.full(len(steps), heading)])
                    standing = self._body.clip_pose(np.zeros(len(track), np.int64), np.zeros(len(track)))
                    if self._is_clear(track, *standing):
                        return np.append(at, heading)
                    # a longer step in this direction begins with the same one
                    break
        return None

    def _is_clear(self, track: Array, quats: Array, pelvis: Array, depth_m: float = 0.0, on: str = "") -> bool:
        """Return whether the body in poses [T] at places [T, 3] is in nothing but ``on``, or no deeper than ``depth_m``."""
        body = self._body
        roots = ground_pose(track[:, :2], track[:, 2], self._free.height_at(track[:, :2]))
        frames = shape_frames(body, body.joint_matrices(roots, quats, pelvis))
        capsules = [shape for shape in body_shapes(body) if isinstance(shape, Capsule)]
        shapes = MovingShapes([replace(shape, radius=shape.radius - depth_m) for shape in capsules])
        scenery = scenery_of(self._scene)
        for pose in frames:
            shapes.set_transforms(pose)
            if any(scenery.names[contact.index_a] != on for contact in contacts(scenery, shapes)):
                return False
        return True


def sit_for(here: Array, place: SeatPlace, seconds: float, *, brisk: bool = False) -> Motion:
    """Return the motion of a person who walks from a place [3] before a seat, sits for some time, and returns there."""
    way = lying_way(place)
    at, up = way[-1]
    stays = chain(way[1:], _shares(at, up, up, seconds), way[-2::-1])
    return chain(take_seat(here, place, brisk=brisk), stays, leave_seat(place.stand, place, 1.0))


def lying_way(place: SeatPlace) -> list[tuple[Array, float]]:
    """Return the places of a person who lies down, each with a share that grows from 1 (sitting) to 2 (lying).

    If the person does not lie down there, the list has only the first place.
    """
    steps, up = (1, 1.0) if place.lie is None else (round(LIE_S / STEP_S) + 1, 2.0)
    # each part of lying down and sitting up begins and ends at rest, so the share itself need not
    return [(root_at(place, share), share) for share in np.linspace(1, up, steps).tolist()]


def root_at(place: SeatPlace, share: float) -> Array:
    """Return the place ``(x, z, heading)`` [3] of a person with a ``share`` of 1 (sitting) to 2 (lying) on a seat."""
    x, z, heading = place.stand.tolist()
    if place.lie is None or share <= TUCKED:
        return place.stand
    lies_x, lies_z, end, hips = place.lie.tolist()
    u = smoothstep(min((share - TUCKED) / (TURNED - TUCKED), 1.0))
    turned = heading + u * float(wrap_angle(end - heading))
    x, z = x + hips * math.cos(heading), z - hips * math.sin(heading)
    x, z = x + u * (lies_x - x), z + u * (lies_z - z)
    return np.array([x - hips * math.cos(turned), z + hips * math.sin(turned), turned])


def take_seat(here: Array, place: SeatPlace, *, brisk: bool = False) -> Motion:
    """Yield the motion of a person who comes from a place [3] before a seat and sits down."""
    for start, end in ((here, place.before), (place.before, place.stand)):
        yield from steps_between(start, end, BRISK if brisk else 1.0)
    yield from _shares(place.stand, 0, 0, BRISK_SETTLE_S if brisk else SETTLE_S)
    yield from _shares(place.stand, 0, 1, SIT_S)


def leave_seat(here: Array, place: SeatPlace, share: float) -> Motion:
    """Yield the motion of a person at a place [3], with a ``share`` of sitting, who gets up and steps away."""
    if share > 0:
        yield from _shares(here, share, 0, RISE_S * (0.5 + share / 2))
        yield from _shares(here, 0, 0, SETTLE_S / 2)
    yield from steps_between(here, place.before)


def remain(here: Array, place: SeatPlace) -> Motion:
    """Return the motion of a person who comes from a place [3] before a seat, sits or lies down, and stays there."""
    way = lying_way(place)
    return chain(take_seat(here, place), way, repeat(way[-1]))


def leave(here: Array, share: float, place: SeatPlace) -> Motion:
    """Return the motion of a person at a place [3], with any ``share``, who sits up, gets up and steps away."""
    back = [step for step in lying_way(place)[::-1] if step[1] < share]
    return chain(back, leave_seat(place.stand if back else here, place, min(share, 1.0)))


def _shares(at: Array, start: float, end: float, seconds: float) -> Motion:
    """Yield the motion at a place [3] during which the share of sitting changes from ``start`` to ``end``."""
    steps = max(round(seconds / STEP_S), 1)
    u = np.arange(1, steps + 1) / steps
    # the minimum-jerk profile (Flash and Hogan 1985): it begins and ends without acceleration
    for share in (start + (end - start) * u**3 * (10 - 15 * u + 6 * u * u)).tolist():
        yield at, share


def steps_between(start: Array, end: Array, pace: float = 1.0) -> Motion:
    """Yield the motion of a person who steps and turns from one place [3] to another, at a multiple of the usual speed."""
    turn = float(wrap_angle(end[2] - start[2]))
    gap = end[:2] - start[:2]
    steps = math.ceil(max(math.hypot(*gap) / STEP_MPS, abs(turn) / TURN_RAD_S) / STEP_S / pace)
    for k in range(1, steps + 1):
        u = smoothstep(k / steps)
        yield np.append(start[:2] + u * gap, start[2] + u * turn), 0.0
