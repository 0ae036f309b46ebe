"""Chores of people with routines, who handle the things of a home.

They open a fridge and take something, carry a tray with two hands, put both down elsewhere, and look at a phone. A
`ChoreRoutine` finds places from which their hands reach. For each step at such a place it plans the targets of the
hands, the opening of a door, and the things that are held. Each posture follows from the targets of the hands
(`h3data.bodies.people.gestures`): trunk and legs take a reaching posture, and both arms are bent so that the palms are
at the handle, thing or tray.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import JOINT_INDEX, Humanoid
from h3data.bodies.people.arms import draw_in
from h3data.bodies.people.gestures import ARMS, BOTH, NAMES, add_gestures, lead_hands
from h3data.bodies.people.reach import Hand, grasp_point, hand_points, reach_poses, reacher
from h3data.bodies.people.sitting import take_seats
from h3data.errors import InputError, SceneError
from h3data.geometry import (
    IDENTITY_POSE,
    Array,
    ground_pose,
    heading_from_quat,
    pose_inverse,
    pose_to_matrix,
    quat_from_axis_angle,
    quat_multiply,
    quat_nlerp,
    quat_rotate,
    transform_points,
)
from h3data.recording import AssetRef, Body
from h3data.scene import FreeSpace, Scene
from h3data.scene.articulation import handle_points, joints_of
from h3data.scene.records import Box, Instance, instance_bounds, instance_matrix
from h3data_crowds.routines import KEPT, PERSON_M, Routine, Stop, no_wall_between, place_beside
from sim_kinematic.agents.arm_tuck import held_close
from sim_kinematic.crowd.crowd import VERSION
from sim_kinematic.crowd.errands import Errand, HandWork, Motion, Station
from sim_kinematic.crowd.seating import SETTLE_S, steps_between
from sim_kinematic.motion.randomness import generator
from sim_kinematic.motion.spec import STEP_S, WalkerSpec

CHORES = {"take": 8.0, "lift": 4.0, "put": 4.3, "phone": 3.0, "knock": 3.0}
"""Chores by name, with the shortest time that each of them needs [s].

``lift`` takes up a tray, and ``put`` puts down the things in the hands.
"""
UNPLANNED = ("phone", "knock")
"""Chores that are done wherever people can stand beside the thing."""
KNOCKS, TOUCHES_M = 3, 0.003
"""Number of knocks, and distance of the knuckles from the surface that is knocked at [m]."""
FINGERS = ("wrist", "index", "middle", "pinky", "ring", "thumb")
"""Names of the joints of a hand, by part."""
TRAY_M, ITEM_M = np.array([0.13, 0.012, 0.19]), np.array([0.033, 0.1, 0.033])
"""Half sizes (forward, up, sideways) of a tray and of a thing that is taken out of a fridge [m]."""
HAND = [k for name, k in JOINT_INDEX.items() if name.startswith("right_") and name.rstrip("123")[6:] in FINGERS]
"""Joints of the right hand."""
PHONE_M = np.array([0.005, 0.074, 0.036])
"""Half sizes of a phone [m]."""
GRIP_BACK_M = 0.1
"""Distance of the hands behind the centre of a tray [m]."""
OVERHANGS_M = (0.03, 0.06, 0.09, 0.11)
"""Overhangs of the nearer side of a tray over the edge of its support [m]; the first that the hands can reach is
used.
"""
CARRIED = np.array([0.27, 0.80, 0.15])
"""Position (forward, up, outward) of a hand that carries something, in shoulder heights."""
TRAY_AHEAD, TRAY_UP, UNFOLDED = (0.26, 0.29, 0.32, 0.35), 0.79, 0.605
"""Position of the centre of a carried tray in shoulder heights, and the extension of the arms that selects it.

Of the forward distances, the first is used at which the hands are this share of an arm's length from the shoulders,
because folded arms cannot carry a tray.
"""
CLOSER = 0.06
"""Share of the path between a hand that carries something out and one that holds it close that is passed in a step. At twice
this rate, which is that of empty arms, elbows turn by up to 25 degrees in a step."""
AJAR_RAD, WIDE_RAD = 0.95, 1.3
"""Smallest and largest angle of a door that one hand opens and holds while the other hand reaches in [rad]."""
BESIDE_M = (0.016, 0.03, 0.06)
"""Depths to which collision shapes may penetrate the door that a person moves [m].

The next depth is tried if one allows no place, because the collision shapes of children are wider than their skin.
"""
SLIDE_M, ANKLES = 0.02, [JOINT_INDEX["left_ankle"], JOINT_INDEX["right_ankle"]]
"""Largest displacement of an ankle while a person leans from one reaching posture to another [m], and the ankle
joints.
"""
ROOM_M, LEAF = 0.3, 0.16
"""Smallest distance of a person from obstacles [m], and of the body's centre from an open door [body heights]."""
NEIGHBOUR_M, APART_M, BESIDE_CARTON_M = 0.12, 0.45, 0.12
"""Distance of neighbouring places, where a rotation by 1 rad counts as 0.1 m, of the spots of two people's things,
and of cartons in one fridge [m].
"""
FARTHER_M = (0.0, 0.08, 0.16, 0.24, 0.3, 0.36, 0.42)
"""Additional distances by which people lean to reach with both hands [m]; the first that suffices is used."""
ASIDE_M = 0.2
"""Largest sideways distance of the centre of a thing that people lift or put down [m]."""
SETTLES_S = 4.0
"""Time that people have to step to the place and to come to rest there [s]."""
COVER_M, PAGES_M = np.array([0.002, 0.1, 0.072]), np.array([0.005, 0.095, 0.067])
"""Half sizes of a half of the cover of an open book, and of the pages in it [m]."""
BOOK = (("book_cover", -1.0), ("book_cover", 1.0), ("book_pages", -1.0), ("book_pages", 1.0))
"""Parts of an open book and their sides: left -1, right 1."""
FOLD_RAD, OVER_PALMS_M, READS_S = 0.3, np.array([0.02, 0.06, 0.0]), 20 * STEP_S
"""Angle of each half of an open book, position of its middle relative to that of the palms [m], and time after which a
person who has sat down has the book in the hands, as before they get up [s].
"""
LOOKS: dict[str, tuple[AssetRef, Array]] = {
    "tray": (AssetRef(name="tray", uri="primitive:cubeSolid", color=(146, 104, 66)), TRAY_M),
    "carton": (AssetRef(name="carton", uri="primitive:cubeSolid", color=(214, 226, 236)), ITEM_M),
    "book_cover": (AssetRef(name="book_cover", uri="primitive:cubeSolid", color=(122, 42, 48)), COVER_M),
    "book_pages": (AssetRef(name="book_pages", uri="primitive:cubeSolid", color=(240, 236, 224)), PAGES_M),
    "phone": (AssetRef(name="phone", uri="primitive:cubeSolid", color=(34, 36, 42)), PHONE_M),
}
"""Appearance and half sizes [m] of the things that people handle."""
BREAKFAST: tuple[tuple[tuple[str, tuple[str, ...], float], ...], ...] = (
    (("take", ("fridge",), 12.5), ("put", ("kitchen_counter", "dining_table"), 9.0)),
    (("lift", ("kitchen_counter",), 8.5), ("put", ("dining_table", "coffee_table", "kitchen_counter"), 9.0)),
    (("eat", ("dining_table",), 40.0),),
    (("phone", ("window", "bookshelf", "plant"), 10.0),),
)
"""Parts of a breakfast (activity, categories of things, duration [s]), some of which each person leaves out."""


class CarryingHands(HandWork):
    """Hands that hold a small thing close to the body where there is little room, as in rearrangement (`held_close`)."""

    def __init__(self, things: tuple[Body, ...], assets: tuple[AssetRef, ...], body: Humanoid) -> None:
        """Create empty hands of a body."""
        super().__init__(things, assets)
        quats, pelvis = body.clip_pose(np.zeros(1, np.int64), np.zeros(1))
        draw_in(quats, (1.0, 1.0), shoulders_forward=True)
        frames = body.joint_matrices(IDENTITY_POSE[None], quats, pelvis)
        self.folded = np.stack([hand_points(frames, body, hand)[0] for hand in BOTH])
        """Places of the palms of folded arms, left and right, in the agent root frame [2, 3] [m]."""
        self.carries = False
        """True while the person walks about with a thing in ``hand``, and False during chores."""
        self.hand = 0
        self.close = 0.0
        """Share of the path from where the thing is carried where there is room (0) to a folded arm (1)."""

    def beside(
        self, free: FreeSpace, place: Array, heading: float, walker: WalkerSpec, arms: Array
    ) -> tuple[Array, dict[int, Array]]:
        """Return ``lead`` and ``held`` as `HandWork.beside` does, moved by one step towards the room that there is."""
        wanted, (ahead, _, aside) = 0.0, self.lead[self.hand, :3].tolist()
        if self.carries and walker.arms is not None:
            rules = replace(walker.arms, rate=CLOSER)
            # no farther out than an arm that holds nothing would be here
            wanted = max(held_close(free, place, heading, (ahead, aside), walker, rules), float(arms[self.hand]))
        self.close += min(max(wanted - self.close, -CLOSER), CLOSER)
        if self.close == 0.0:
            return self.lead, self.held
        lead, inward = self.lead.copy(), self.close * (self.folded[self.hand] - self.lead[self.hand, :3])
        lead[self.hand, :3] += inward
        return lead, {n: np.append(pose[:3] + inward, pose[3:]) for n, pose in self.held.items()}


class Chore(NamedTuple):
    """Chore of one body at one place, with the targets of the hands."""

    name: str
    place: str
    """Name of the thing at which the chore is done."""
    root: Array
    """World pose of the person's root (pose7)."""
    spot: Array
    """World position of the thing that is taken or put down [3] [m]."""
    joint: int = -1
    """Number of the door's joint; -1 if nothing opens."""
    angles: Array = np.zeros(1)
    """Angles of the door while the hand moves it [N] [rad]."""
    handles: Array = np.zeros((1, 3))
    """World positions of the handle at each angle [N, 3] [m]."""
    farther_m: float = 0.0
    """Additional distance by which people lean to reach with both hands instead of one [m]."""
    wide: bool = False
    """True if a tray is lifted or put down."""


class Movement(NamedTuple):
    """Movement of the hands during a chore, with one row for each step."""

    lead: Array
    """Target frames of the hands (`h3data.bodies.people.gestures.lead_hands`) [T, 4, 4]."""
    places: Array
    """Positions in the agent root frame of the thing that is taken or put down [T, 3] [m]."""
    moment: int
    """Step at which the thing is taken or put down."""
    hand: int = 2
    """Hand that takes the thing: 0 for left, 1 for right, 2 for both."""
    joint: int = -1
    positions: Array = np.zeros(0)
    """Positions of the door's joint [T] [rad]."""


class ChoreRoutine(Routine):
    """Routine with chores (`CHORES`) in addition to the other activities.

    All chores are planned at the start, so that trays and things in a fridge have their places from the first step on.
    A thing that has been taken is not there any more, so that the next round of the routine leaves out that stop.
    """

    def __init__(
        self,
        scene: Scene,
        free: FreeSpace,
        stops: Sequence[Stop] | Callable[[int], Sequence[Stop]],
        body: Humanoid,
        *,
        start: NDArray[np.float64],
        number: int = 0,
        version: int = VERSION,
    ) -> None:
        """Check the stops as `Routine` does, and plan the chores.

        Args:
            scene: The home.
            free: Free floor of the home.
            stops: Places, activities and durations [s], or a function that returns those of a version of the rules.
            body: The person's body.
            start: Position (x, z) [2] [m] from which the person comes.
            number: Number of the agent; people with different numbers put their things at different spots.
            version: Version of the rules of people by which the chores are planned (`follow`).
        """
        self._choose = stops if callable(stops) else None
        super().__init__(scene, free, stops(version) if callable(stops) else stops, body)
        self._body, self._start, self._number = body, start, number
        self.use(CarryingHands((), (), body))
        self.version = version
        self.follow(version)
        scale = reacher(body, "right").body.scale
        self._carry = np.stack([CARRIED * scale * (1, 1, -1), CARRIED * scale])
        self._tray_at = _carried_tray(body, scale)
        self.holds: tuple[int, int] | None = None
        """Number of the thing in the hands, and the hand: left 0, right 1, both 2."""
        self._gone: set[int] = set()
        """Numbers of the things that have been taken."""

    def use(self, hands: CarryingHands) -> None:
        """Change the state of other hands, which have the same things, from now on."""
        self.hands: HandWork | None = hands
        self._work = hands

    def follow(self, version: int) -> ChoreRoutine:
        """Plan the chores by a version of the rules.

        Up to version 6, people also do chores through a wall; up to version 7, they choose stops as if they did. Up to
        version 8, two people may have their things at one spot.
        """
        if self._choose is not None and (version > 7, version > 8) != (self.version > 7, self.version > 8):
            self.stops = tuple(self._choose(version))
        self.version = version
        self.plans, self.own = dict[int, Chore | InputError](), dict[int, int]()
        things, held = list[Body](), ""
        for k, stop in enumerate(self.stops):
            if stop.activity not in CHORES or stop.activity in UNPLANNED:
                named = {thing.name for thing in things}
                if stop.activity == "phone" and "phone" not in named:
                    things.append(_body("phone", np.full(7, np.nan)))
                elif stop.activity == "read" and "book_cover_0" not in named:
                    things += [_body(kind, np.full(7, np.nan), n) for n, (kind, _) in enumerate(BOOK)]
                continue
            try:
                where = self._scene, self._free, self._body, stop, self._start, self._number
                plan = planned(*where, tray=held == "tray", walls=version > 6)
            except InputError as fault:
                self.plans[k] = fault
                continue
            self.plans[k] = plan
            if stop.activity == "put":
                held = ""
                continue
            held = {"take": "carton", "lift": "tray"}[stop.activity]
            count = sum(thing.name.startswith(held) for thing in things)
            self.own[k] = len(things)
            things.append(_body(held, np.concatenate([plan.spot, plan.root[3:]]), count))
        looks = dict.fromkeys(thing.asset for thing in things)
        self._work.things, self._work.assets = tuple(things), tuple(LOOKS[name][0] for name in looks)
        return self

    def errand_at(
        self, k: int, xz: NDArray[np.float64], taken: Sequence[Array]
    ) -> tuple[tuple[NDArray[np.float64], Errand] | None, tuple[str, str]]:
        """Return the errand at a stop, as `Routine.errand_at` does; an impossible chore is refused with a reason.

        Chores that are impossible now are skipped, e.g. because the hands are full or empty, or the thing has been
        taken.
        """
        stop, plan = self.stops[k], self.plans.get(k)
        free_hands = self.holds is None
        # nobody who holds something sits down or takes out a phone: they stand
        if plan is None and not free_hands and stop.activity != "put":
            found = place_beside(self._scene, self._free, stop.place, xz)
            if found is None or any(np.hypot(*(found[0] - other[:2])) < PERSON_M for other in taken):
                return None, ("", "")
            at, (x, z) = found
            return (
                np.asarray(at, np.float64),
                Errand(np.zeros((0, 2)), stop.seconds, (float(x), float(z)), "look_out", stop.place),
            ), ("", "")
        if plan is None or isinstance(plan, InputError):
            found, refused = super().errand_at(k, xz, taken)
            if isinstance(plan, InputError):
                return found, (stop.place, f"{plan.code}: {plan}")
            if found is not None and stop.activity == "read" and found[1].station is not None:
                station = found[1].station
                station = station._replace(motion=partial(self._read, station.motion, station.height_m))
                return (found[0], found[1]._replace(station=station)), refused
            if found is None or stop.activity not in UNPLANNED or found[1].look is None:
                return found, refused
            (x, z), look = found[0].tolist(), found[1].look
            place = np.array([x, z, np.arctan2(z - look[1], look[0] - x)])
            if stop.activity == "knock":
                move = partial(self._knock, place, float(np.hypot(look[0] - x, look[1] - z)))
                station = Station(stop.place, 0.0, np.append(place, PERSON_M), move)
                # another name than that of the gesture, which knows no door
                errand = found[1]._replace(look=None, station=station, activity="knocking")
                return (found[0], errand), refused
            number = next(n for n, thing in enumerate(self._work.things) if thing.name == "phone")
            station = Station(stop.place, 0.0, np.append(place, PERSON_M), partial(self._look_at_phone, place, number))
            return (found[0], found[1]._replace(look=None, station=station)), refused
        if stop.activity == "put":
            fits = self.holds is not None and (self.holds[1] == 2) == plan.wide
        else:
            fits = free_hands and self.own[k] not in self._gone
        place = np.append(plan.root[[0, 2]], heading_from_quat(plan.root[3:]))
        if not fits or any(np.hypot(*(place[:2] - other[:2])) < PERSON_M for other in taken):
            return None, ("", "")
        station = Station(stop.place, 0.0, np.append(place, PERSON_M), partial(self._do, place, k, plan))
        errand = Errand(np.zeros((0, 2)), stop.seconds, None, stop.activity, stop.place, station)
        return (np.asarray(place[:2], np.float64), errand), ("", "")

    def _do(self, place: Array, k: int, plan: Chore, here: Array, seconds: float) -> Motion:
        """Yield the motion of a person who steps to a place [3] and does the chore of stop ``k`` there."""
        yield from steps_between(here, place)
        yield from self.handle(plan, self.own[k] if self.holds is None else self.holds[0], place, seconds)

    def handle(self, plan: Chore, number: int, place: Array, seconds: float) -> Motion:
        """Yield the motion of somebody who does a chore with thing ``number`` where they have come to stand, a place [3].

        Args:
            plan: The chore, which was planned for this place.
            number: Number of the thing in `HandWork.things`.
            place: Place ``(x, z, heading)`` of the person [3].
            seconds: Time for the chore, including `SETTLES_S` for getting there [s].
        """
        work, self._work.carries = self._work, False
        for _ in range(round(SETTLE_S / STEP_S)):
            yield place, 0.0
        t = np.arange(round((seconds - SETTLES_S) / STEP_S)) * STEP_S
        puts = plan.name == "put"
        moves = self._put(plan, t) if puts else self._take_up(plan, t) if plan.name == "lift" else self._take(plan, t)
        assert not puts or self.holds is not None
        for n, lead in enumerate(moves.lead):
            work.lead[:] = lead
            if moves.joint >= 0:
                work.joints[moves.joint] = float(moves.positions[n])
            if (n <= moves.moment) if puts else (n >= moves.moment):
                work.held[number] = np.append(moves.places[n], IDENTITY_POSE[3:])
            if n == moves.moment:
                self.holds = None if puts else (number, moves.hand)
                self._gone.add(number)
                work.events.append(("puts" if puts else "takes", work.things[number].name, plan.place))
            yield place, 0.0
            if puts and n == moves.moment:
                del work.held[number]
        work.carries, work.hand = self.holds is not None and moves.hand < 2, moves.hand % 2

    def _look_at_phone(self, place: Array, number: int, here: Array, seconds: float) -> Motion:
        """Yield the motion of a person who looks at a phone while they turn to a place [3] and stand there."""
        steps = max(round(seconds / STEP_S), 90)
        share = np.minimum(_ramp(np.arange(steps) * STEP_S, 0.0, 0.8), _ramp(np.arange(steps)[::-1] * STEP_S, 0.0, 0.8))
        yield from self.show_phone(number, share, place, steps_between(here, place))
        del self._work.held[number]

    def show_phone(self, number: int, shares: Array, place: Array, way: Motion) -> Motion:
        """Yield the motion of somebody at the end of a way, at a place [3], whose right hand is led to a phone.

        Args:
            number: Number of the phone in `HandWork.things`.
            shares: Shares [T], 0 to 1, by which the hand is led to where a phone is looked at.
            place: Place ``(x, z, heading)`` [3].
            way: Motion of the feet meanwhile, up to the place.
        """
        body, work = self._body, self._work
        quats, pelvis = body.clip_pose(np.zeros(1, np.int64), np.zeros(1))
        # the gesture, which replays add by the name of the activity, lowers the head; the palm is led to where it is then
        add_gestures(body, quats, pelvis, [[NAMES.index("phone"), 0.0, 1.0]])
        palm = hand_points(body.joint_matrices(IDENTITY_POSE[None], quats, pelvis), body, "right")[0]
        work.lead[1, :3] = palm
        # 0.3: half of the angle by which the phone leans back
        shown = np.array([*np.add(palm, (0.0, 0.03, 0.0)), 0.0, 0.0, -np.sin(0.3), np.cos(0.3)])
        for share in shares:
            work.lead[1, 3] = share
            # 0.95: share from which on the hand is nearly there
            work.held[number] = shown if share > 0.95 else np.full(7, np.nan)
            yield next(way, (place, 0.0))

    def _read(self, sits: Callable[[Array, float], Motion], height_m: float, here: Array, seconds: float) -> Motion:
        """Yield the motion of somebody who holds a book while they sit on a seat of a height [m]."""
        body, work, way = self._body, self._work, list(sits(here, seconds))
        quats, pelvis = body.clip_pose(np.zeros(1, np.int64), np.zeros(1))
        take_seats(body, quats, pelvis, [(height_m, 1.0)])
        # as replays add it by the name of the activity
        add_gestures(body, quats, pelvis, [[NAMES.index("read"), 0.0, 1.0]])
        frames = body.joint_matrices(IDENTITY_POSE[None], quats, pelvis)
        middle = np.mean([hand_points(frames, body, hand)[0] for hand in BOTH], 0) + OVER_PALMS_M
        first = next(n for n, thing in enumerate(work.things) if thing.name == "book_cover_0")
        book = _open_book(middle, frames[0, JOINT_INDEX["head"], :3, 3])
        sat = [n for n, (_, share) in enumerate(way) if share >= 1]
        margin = round(READS_S / STEP_S)
        for n, moment in enumerate(way):
            shown = sat[0] + margin <= n <= sat[-1] - margin
            work.held.update(enumerate(book if shown else np.full_like(book, np.nan), first))
            yield moment
        for k in range(len(book)):
            del work.held[first + k]

    def _knock(self, place: Array, gap: float, here: Array, seconds: float) -> Motion:
        """Yield the motion of a person who knocks at a surface ``gap`` [m] ahead of a place [3]."""
        yield from steps_between(here, place)
        work, right = self._work, reacher(self._body, "right")
        door = np.array([gap, 0.95 * right.body.scale, 0.12])
        for _ in range(2):  # the second time from a posture that differs by millimetres only
            door[0] += gap - TOUCHES_M - self._knuckles(door, bool(right.reachable(door[None])[0]))
        t = np.arange(round(max(seconds - 1.0, 2.5) / STEP_S)) * STEP_S
        on = _ramp(t, 0.0, 0.8) - _ramp(t, t[-1] - 0.8, t[-1])
        back = 0.07 * np.cos(np.pi * np.clip((t - 0.8) / 0.25, 0.0, 2 * KNOCKS)) + 0.07
        leans = bool(right.reachable(door[None])[0])
        for n in range(len(t)):
            work.lead[1] = [door[0] - back[n], *door[1:], on[n]]
            work.lead[3] = [*door, 0.6 * on[n] * leans]
            yield place, 0.0
        work.lead[:] = 0.0

    def _knuckles(self, palm: Array, leans: bool) -> float:
        """Return how far ahead the skin of the right hand reaches while its palm is led to a place [3] [m]."""
        body, lead = self._body, np.zeros((1, 4, 4))
        quats, pelvis = body.clip_pose(np.zeros(1, np.int64), np.zeros(1))
        lead[0, 1], lead[0, 3] = [*palm, 1.0], [*palm, 0.6 * leans]
        lead_hands(body, quats, pelvis, lead)
        frames = body.joint_matrices(IDENTITY_POSE[None], quats, pelvis)
        return float(body.skin(frames, plain=True)[0, np.isin(body.lod.owners, HAND), 0].max())

    # --- movements -------------------------------------------------------------------------------------------------------
    def _take(self, plan: Chore, t: Array) -> Movement:
        """Open the door with one hand, take with the other one, and close the door."""
        _, _, hinge = _frame(plan.handles)
        o, h = (BOTH.index(hand) for hand in _hands(plan.root, hinge))
        angle = (_ramp(t, 0.9, 2.3) - _ramp(t, 4.7, 6.0)) * plan.angles[-1]
        handle, spot = _seen(plan.root, plan.handles), _seen(plan.root, plan.spot[None])[0]
        lead = np.zeros((len(t), 4, 4))
        lead[:, o, :3] = np.stack([np.interp(angle, plan.angles, handle[:, k]) for k in range(3)], 1)
        inside = (_ramp(t, 2.3, 3.4) - _ramp(t, 3.8, 4.9))[:, None]
        # close before the body until the hand is out of what stands beside
        near = self._carry[h] * np.column_stack([np.ones((len(t), 2)), 0.3 + 0.7 * _ramp(t, 4.9, 5.9)])
        lead[:, h, :3] = near + inside * (spot - near)
        on, other = _ramp(t, 0.0, 0.9) - _ramp(t, 6.0, 6.9), _ramp(t, 2.3, 3.3) - _ramp(t, 3.9, 4.9)
        lead[:, o, 3], lead[:, h, 3] = on, _ramp(t, 1.4, 2.2)
        lead[:, 2 + o, :3], lead[:, 2 + h, :3] = lead[:, o, :3], spot
        lead[:, 2 + o, 3], lead[:, 2 + h, 3] = on * (1 - other), on * other
        joint = joints_of(self._scene).parts[plan.joint][1].joint
        positions = joint.closed + np.sign(joint.opened - joint.closed) * angle
        return Movement(lead, lead[:, h, :3], int(np.searchsorted(t, 3.6)), h, plan.joint, positions)

    def _take_up(self, plan: Chore, t: Array) -> Movement:
        """Take up a tray with both hands, or a smaller thing as it is put down, played backwards."""
        if not plan.wide:
            down = self._put(plan, t)
            return down._replace(lead=down.lead[::-1], places=down.places[::-1], moment=len(t) - 1 - down.moment)
        up, spot = _ramp(t, 1.7, 2.9)[:, None], _seen(plan.root, plan.spot[None])[0]
        # hands come from above, not through the edge of a table
        middle = self._tray_at + (_ramp(t, 0.5, 1.5)[:, None] - up) * (spot - self._tray_at)
        lead = _led_to_tray(middle, spot, _ramp(t, 0.4, 1.4) - _ramp(t, 2.0, 3.1), plan.farther_m)
        lead[:, :2, 3] = _ramp(t, 0.0, 0.9)[:, None]
        return Movement(lead, middle, int(np.searchsorted(t, 1.6)))

    def _put(self, plan: Chore, t: Array) -> Movement:
        """Put down what the hands hold, or hands that are empty, of which the right one would hold a thing."""
        hand, spot = 1 if self.holds is None else self.holds[1], _seen(plan.root, plan.spot[None])[0]
        lean, out = _ramp(t, 0.2, 1.4) - _ramp(t, 2.0, 3.0), (_ramp(t, 0.0, 1.5) - _ramp(t, 2.0, 3.0))[:, None]
        start = self._tray_at if hand == 2 else self._carry[hand]
        places = start + out * (spot - start)
        if hand == 2:
            lead = _led_to_tray(places, spot, lean, plan.farther_m)
        else:
            lead = np.zeros((len(t), 4, 4))
            lead[:, hand, :3], lead[:, 2 + hand, :3], lead[:, 2 + hand, 3] = places, spot, lean
        lead[:, slice(0, 2) if hand == 2 else hand, 3] = (1 - _ramp(t, 2.9, 3.8)).reshape(-1, *[1] * (hand == 2))
        return Movement(lead, places, int(np.searchsorted(t, 1.7)), hand)


def chore_at(
    scene: Scene,
    free: FreeSpace,
    body: Humanoid,
    stop: Stop,
    *,
    near: NDArray[np.float64],
    number: int = 0,
    tray: bool = False,
    walls: bool = False,
) -> Chore:
    """Return a chore at the best place for a body next to the thing of a stop.

    Args:
        scene: The home.
        free: Free floor of the home.
        body: The person's body.
        stop: Thing and chore.
        near: Position (x, z) [2] [m] from which the person comes.
        number: Number of the agent, which decides between places whose spots are `APART_M` from each other.
        tray: True if the person puts down a tray.
        walls: True if no wall may be between the person and the thing.

    Raises:
        InputError: Nothing there opens, or no place has room and is near enough for the hands.
    """
    thing = next(instance for instance in scene.instances if instance.name == stop.place)
    if stop.activity == "take":
        places = _before_door(scene, thing)
        made = [partial(_opening, scene, body, stop.place, number, deep) for deep in BESIDE_M]
    else:
        wide = stop.activity == "lift" or tray
        places, made = _around(scene, thing), [partial(_surface, scene, body, thing, stop.activity, wide)]
    room = free.signed_distance(places[:, :2]) >= ROOM_M
    room &= np.isfinite(free.geodesic(np.broadcast_to(near, places[:, :2].shape), places[:, :2]))
    if walls and len(places):
        faced = np.clip(places[:, :2], *instance_bounds(scene, thing)[:, [0, 2]])
        room &= no_wall_between(free, places[:, :2], faced)
    tries = ([chore for chore in map(make, places[room]) if chore is not None] for make in made)
    found = next(filter(None, tries), list[Chore]())
    if not found:
        raise InputError(
            f"{body.name} cannot {stop.activity} at {stop.place}: no place beside it has room and is near enough for the "
            "hands. Hint: choose another thing, or a home whose furniture opens.",
            code="H3-TASK-086",
        )
    # the place with most others around it from which the hands reach too is in the middle of what they reach
    roots = np.array([chore.root for chore in found])
    apart = np.linalg.norm(roots[:, None, [0, 2]] - roots[None, :, [0, 2]], axis=2)
    apart += 0.2 * np.linalg.norm(roots[:, None, 3:] - roots[None, :, 3:], axis=2)
    best = list[Chore]()
    for k in np.argsort(-(apart < NEIGHBOUR_M).sum(1), kind="stable").tolist():
        if all(np.linalg.norm(found[k].spot - other.spot) >= APART_M for other in best):
            best.append(found[k])
    return best[number % len(best)]


def breakfast(episode: Any, number: int) -> ChoreRoutine:
    """Return the breakfast routine of an agent, sampled by the seed.

    People take things, lay the table, eat, and look at a phone.

    Raises:
        SceneError: The home has no things for any of it.
    """
    scene, free, member = episode.scene, episode.free, episode.roster[number]
    stops = partial(chosen_stops, episode, number, BREAKFAST, "breakfast", KEPT)
    if not stops(VERSION):
        raise SceneError(
            f"{member.name} can have no breakfast in {scene.name}. Hint: choose a home that opens, such as medium-open:3.",
            code="H3-TASK-089",
        )
    return ChoreRoutine(scene, free, stops, member.body, start=episode.starts[number, :2], number=number)


def chosen_stops(
    episode: Any,
    number: int,
    parts: Sequence[Sequence[tuple[str, tuple[str, ...], float]]],
    stream: str,
    kept: float,
    version: int,
) -> list[Stop]:
    """Return stops of an agent at random things of the home, without the parts that are impossible there.

    Args:
        episode: The episode.
        number: Number of the agent.
        parts: Parts as in `BREAKFAST`.
        stream: Name of the stream of random numbers.
        kept: Share of the parts that are not left out.
        version: Version of the rules (`ChoreRoutine.follow`).
    """
    taken = list[Array]()
    # those who choose first may have the same routine: from version 9 on, nobody has their things at the spots of others
    for k in range(number if version > 8 else 0):
        if episode.roster[k].kind == "human":
            taken += _chosen(episode, k, parts, stream, kept, version, taken)[1]
    apart = _chosen(episode, number, parts, stream, kept, version, taken)[0]
    # in a home with too few spots for all, who would have nothing to do shares those of others
    return apart if apart or not taken else _chosen(episode, number, parts, stream, kept, version, ())[0]


def _chosen(
    episode: Any,
    number: int,
    parts: Sequence[Sequence[tuple[str, tuple[str, ...], float]]],
    stream: str,
    kept: float,
    version: int,
    taken: Sequence[Array],
) -> tuple[list[Stop], list[Array]]:
    """Return the stops of an agent by `chosen_stops`, and the spots of their things [3] [m], away from those ``taken``."""
    scene, free, body, start = episode.scene, episode.free, episode.roster[number].body, episode.starts[number, :2]
    things, rng = dict[str, list[str]](), generator(episode.seed, stream, world=number)
    for instance in scene.instances:
        # not the fronts of drawers, whose names have the thing's before a slash
        if "/" not in instance.name:
            things.setdefault(scene.assets[instance.asset].category, []).append(instance.name)
    stops, spots = list[Stop](), list[Array]()
    for part in parts:
        wanted, chosen, tray = rng.random() < kept, list[Stop](), False
        own = list[Array]()
        for activity, categories, seconds in part:
            tray = tray or activity == "lift"
            there = [name for category in categories for name in things.get(category, ())]
            for k in rng.permutation(len(there)).tolist() if wanted else ():
                stop = Stop(there[k], activity, seconds)
                try:
                    if activity in CHORES and activity not in UNPLANNED:
                        plan = planned(scene, free, body, stop, start, number, tray=tray, walls=version > 7)
                        # cartons stand side by side in a fridge
                        apart = BESIDE_CARTON_M if activity == "take" else APART_M
                        if any(np.linalg.norm(plan.spot - other) < apart for other in taken):
                            continue
                        own.append(plan.spot)
                except InputError:
                    continue
                chosen.append(stop)
                break
        if len(chosen) == len(part):
            stops, spots = stops + chosen, spots + own
    return stops, spots


def _carried_tray(body: Humanoid, scale: float) -> Array:
    """Return the place [3] of the middle of a tray that a body carries, in the agent root frame."""
    frames = body.joint_matrices(IDENTITY_POSE[None], *body.clip_pose(np.zeros(1, np.int64), np.zeros(1)))[0]
    middle = np.zeros(3)
    for ahead in TRAY_AHEAD:
        middle = np.array([ahead, TRAY_UP, 0.0]) * scale
        gaps = np.linalg.norm(frames[ARMS[:, 0], :3, 3] - _grips(middle, IDENTITY_POSE), axis=1)
        if all(gap > UNFOLDED * _arm(body, side) for side, gap in enumerate(gaps.tolist())):
            break
    return middle


def _body(kind: str, pose: Array, count: int | None = None) -> Body:
    """Return a thing of `LOOKS` with a number in its name."""
    name = kind if count is None else f"{kind}_{count}"
    scale = LOOKS[kind][1].astype(np.float32)
    return Body(name=name, asset=kind, pose=pose.astype(np.float32), scale=scale, moving=0)


def _open_book(middle: Array, eyes: Array) -> Array:
    """Return the poses (pose7) of the parts `BOOK` of a book whose middle is at a point [3] and that faces the eyes [3]."""
    away = middle - eyes
    lean = quat_from_axis_angle([0.0, 0.0, 1.0], np.arctan2(away[1], away[0]))
    poses = []
    for kind, side in BOOK:
        fold = quat_multiply(lean, quat_from_axis_angle([0.0, 1.0, 0.0], -side * FOLD_RAD))
        # pages lie on the cover, on the side of the reader
        inwards = 0.0 if kind == "book_cover" else -COVER_M[0] - PAGES_M[0]
        poses.append(np.append(middle + quat_rotate(fold, np.array([inwards, 0.0, side * COVER_M[2]])), fold))
    return np.array(poses)


def _led_to_tray(middle: Array, spot: Array, lean: Array, farther_m: float) -> Array:
    """Return places [T, 4, 4] of hands that hold a tray at places [T, 3] and lean to a spot [3], in the agent root frame."""
    lead = np.zeros((len(middle), 4, 4))
    lead[:, :2, :3] = _grips(middle, np.tile(IDENTITY_POSE, (len(middle), 1)))
    lead[:, 2:, :3] = _grips(spot, IDENTITY_POSE) + np.array([farther_m, 0.0, 0.0])
    lead[:, 2:, 3] = lean[:, None] / 2
    return lead


def minimum_jerk(share: Array) -> Array:
    """Return the progress along a path, 0 to 1, at a share of its time, by a quintic without acceleration at both ends.

    It is the minimum-jerk profile of Flash and Hogan (1985).
    """
    return share**3 * (10 - 15 * share + 6 * share * share)


def _ramp(t: Array, start: float, end: float) -> Array:
    """Return shares [T] of a movement between two times, from 0 to 1 with the minimum-jerk profile."""
    return minimum_jerk(np.clip((t - start) / (end - start), 0.0, 1.0))


@lru_cache(maxsize=256)
def _kept_plan(
    scene: Scene,
    free: FreeSpace,
    body: Humanoid,
    stop: Stop,
    near: tuple[float, float],
    number: int,
    tray: bool,
    walls: bool,
) -> Chore | InputError:
    try:
        return chore_at(scene, free, body, stop, near=np.array(near), number=number, tray=tray, walls=walls)
    except InputError as fault:
        return fault


def planned(
    scene: Scene,
    free: FreeSpace,
    body: Humanoid,
    stop: Stop,
    start: Array,
    number: int,
    *,
    tray: bool,
    walls: bool = False,
) -> Chore:
    """Return the chore of a stop (`chore_at`); the same one is not planned twice."""
    least = CHORES[stop.activity] + SETTLES_S
    if stop.seconds < least:
        raise InputError(
            f"Expected at least {least:g} s for {stop.activity!r}, got {stop.seconds:g}.",
            code="H3-TASK-088",
        )
    found = _kept_plan(scene, free, body, stop, (float(start[0]), float(start[1])), number, tray, walls)
    if isinstance(found, InputError):
        raise found.with_traceback(None)
    return found


# --- places --------------------------------------------------------------------------------------------------------------
def _before_door(scene: Scene, thing: Instance) -> Array:
    """Return places ``(x, z, heading)`` [N, 3] before the door of a thing, facing it."""
    joint, handles, *_ = _door(scene, thing.name)
    if joint < 0:
        return np.zeros((0, 3))
    ahead, along, _ = _frame(handles)
    heading = float(np.arctan2(ahead[1], -ahead[0]))
    # who stands beside the door's path turns to the inside
    inward = -1.0 if ahead[0] * along[1] - ahead[1] * along[0] > 0 else 1.0
    gaps, sides, turns = (
        each.reshape(-1, 1)
        for each in np.meshgrid(
            np.arange(0.25, 0.76, 0.05), np.arange(-0.2, 0.45, 0.05), (0.0, 0.35, 0.7), indexing="ij"
        )
    )
    return np.column_stack([handles[0, [0, 2]] + gaps * ahead + sides * along, heading + inward * turns])


def _around(scene: Scene, thing: Instance) -> Array:
    """Return places ``(x, z, heading)`` [N, 3] around a thing, facing it at right angles, the nearest first."""
    low, high = instance_bounds(scene, thing)[:, [0, 2]]
    rows = []
    for gap in (0.33, 0.38, 0.43, 0.48):
        for axis, sign in ((0, -1), (0, 1), (1, -1), (1, 1)):
            for share in np.linspace(0.15, 0.85, 8):
                at = low + share * (high - low)
                at[axis] = (low, high)[sign > 0][axis] + sign * gap
                away = np.eye(2)[axis] * sign
                rows.append([*at, float(np.arctan2(away[1], -away[0]))])
    return np.array(rows)


class Leaf(NamedTuple):
    """Door of a thing that encloses something, at N angles from closed to `WIDE_RAD`."""

    joint: int = -1
    """Number of the door's joint; -1 if there is none."""
    handles: Array = np.zeros((0, 3))
    """World positions of the handle at each angle [N, 3] [m]."""
    back: Array = np.zeros((0, 4, 4))
    """Transforms from the world to the frame of the panel at each angle [N, 4, 4]."""
    half: Array = np.zeros(3)
    """Half sizes of the panel [3] [m]."""

    def depth(self, points: Array, root: Array, k: NDArray[np.intp]) -> Array:
        """Return the depth in the panel [T, C] [m] of points [T, C, P, 3] in the agent root frame, at angles ``k`` [T].

        Of P points, the deepest counts.

        It is negative outside the panel.
        """
        moved = (self.back[k] @ pose_to_matrix(root))[:, None]
        there = np.abs(points @ moved[..., :3, :3].swapaxes(2, 3) + moved[..., None, :3, 3])
        return (self.half - there).min(3).max(2)


@lru_cache(maxsize=16)
def _door(scene: Scene, name: str) -> Leaf:
    """Return the first door of a thing that encloses something."""
    joints = joints_of(scene)
    for k, (thing, part) in enumerate(joints.parts):
        if thing.name == name and part.joint.kind == "revolute" and part.encloses:
            way = np.tile(joints.rest, (40, 1))
            way[:, k] = joints.closed[k] + np.linspace(0, WIDE_RAD, 40) * np.sign(joints.opened[k] - joints.closed[k])
            motions = joints.motions(way)[:, k]
            leaf = next(each for each in scene.instances if joints.owner.get(each.name) == k)
            panel = next(shape for shape in scene.assets[leaf.asset].shapes if isinstance(shape, Box))
            back = np.linalg.inv(motions @ instance_matrix(leaf) @ pose_to_matrix(panel.pose))
            handles = motions[:, :3, :3] @ handle_points(scene)[k] + motions[:, :3, 3]
            return Leaf(k, handles, back, np.asarray(panel.half_extents, np.float64))
    return Leaf()


def _frame(handles: Array) -> tuple[Array, Array, Array]:
    """Return directions [2] out of a closed door and from hinge to handle, and the hinge [2], by the handle's path [N, 3]."""
    path = handles[:, [0, 2]]
    ahead = (path[1] - path[0]) / np.hypot(*(path[1] - path[0]))
    middle = path[len(path) // 2]
    # the hinge is where the bisector of a chord meets the closed door
    chord, along = middle - path[0], np.array([-ahead[1], ahead[0]])
    along = along if along @ (path[0] - middle) > 0 else -along
    radius = float(chord @ chord / (2 * abs(chord @ along)))
    return ahead, along, path[0] - radius * along


def _opening(scene: Scene, body: Humanoid, name: str, number: int, deep: float, place: Array) -> Chore | None:
    """Return the chore of taking something out of a thing with a door, from a place [3]; None: the hands do not reach."""
    door = _door(scene, name)
    k, handles = door.joint, door.handles
    ahead, along, hinge = _frame(handles)
    root = ground_pose(place[:2], float(place[2]))
    opens, takes = _hands(root, hinge)
    local = _seen(root, handles)
    angles = np.linspace(0, WIDE_RAD, len(handles))
    # the leaf of the door, which is a little wider than the handle is far from the hinge
    leaf = hinge + np.linspace(0, 1.1, 12)[:, None, None] * (handles[:, [0, 2]] - hinge)
    clear = np.hypot(*(leaf - place[:2]).transpose(2, 0, 1)).min(0) >= LEAF * body.height_m
    count = len(clear) if clear.all() else int(np.argmin(clear))
    if count < 2 or angles[count - 1] < AJAR_RAD:
        return None
    out = np.flatnonzero(~reacher(body, opens).reachable(local[:count]))
    count = int(out[0]) if len(out) else count
    if count < 2 or angles[count - 1] < AJAR_RAD:
        return None
    part = joints_of(scene).parts[k][1]
    by_name = {instance.name: instance for instance in scene.instances}
    for shelf in reversed(part.encloses):
        owner, _, label = shelf.partition("|")
        asset = scene.assets[by_name[owner].asset]
        board = next(each for each in asset.receptacles if each.name == label)
        matrix = instance_matrix(by_name[owner])
        centre = matrix[:3, :3] @ board.center + matrix[:3, 3]
        depth, width = board.half_size[1], board.half_size[0]
        # the cartons of three people stand beside each other
        across = centre[[0, 2]] + (0.5 - 0.4 * (number % 3)) * width * along + (depth - 0.05) * ahead
        spot = np.array([across[0], centre[1] + ITEM_M[1], across[1]])
        if reacher(body, takes).reachable(_seen(root, spot[None]))[0]:
            side, inside = BOTH.index(opens), _seen(root, spot[None])[0]
            count = _beside_leaf(body, door, root, side, local[:count], inside, deep)
            if angles[count - 1] >= AJAR_RAD:
                return Chore("take", name, root, spot, k, angles[:count], handles[:count])
    return None


def _beside_leaf(body: Humanoid, door: Leaf, root: Array, side: int, handles: Array, spot: Array, deep: float) -> int:
    """Return the number of the first angles of a door at which nobody's body but the hands is in its panel.

    At each of them the hand is at the handle, while the body leans to it or to the spot for which the other hand reaches, both
    in the frame of the agent root.
    """
    count, far = len(handles), 1 - side
    lead = np.zeros((2 * count, 4, 4))
    lead[:, side, :3], lead[:, 2 + side, :3] = np.tile(handles, (2, 1)), np.tile(handles, (2, 1))
    lead[:, 2 + far, :3], lead[:, side, 3] = spot, 1.0
    lead[:count, 2 + side, 3], lead[count:, 2 + far, 3] = 1.0, 1.0
    quats, pelvis = body.clip_pose(np.zeros(len(lead), np.int64), np.zeros(len(lead)))
    lead_hands(body, quats, pelvis, lead)
    frames = body.joint_matrices(IDENTITY_POSE, quats, pelvis)
    starts, ends, radii = body.capsules_world(frames)
    points = starts[:, :, None] + np.linspace(0.0, 1.0, 5)[:, None] * (ends - starts)[:, :, None]
    within = door.depth(points, root, np.tile(np.arange(count), 2)) + radii
    depth = within[:, [not each.name.endswith("hand") for each in body.capsules]].max(1)
    # leaning to the spot counts only where the door comes to rest, so at the last angle
    leads = np.flatnonzero(depth[:count] > deep)
    count = int(leads[0]) if len(leads) else count
    while count > 1 and depth[len(handles) + count - 1] > deep:
        count -= 1
    # between two postures that differ much, legs are blended to where the feet slide
    quats, pelvis = body.clip_pose(np.zeros(1, np.int64), np.zeros(1))
    stands = body.joint_matrices(IDENTITY_POSE, quats, pelvis)[:, ANKLES, :3, 3]
    lead[count - 1, 2:, 3] = 0.5
    lead_hands(body, quats, pelvis, lead[count - 1 : count])
    slides = np.linalg.norm(body.joint_matrices(IDENTITY_POSE, quats, pelvis)[:, ANKLES, :3, 3] - stands, axis=-1)
    return max(count, 1) if slides.max() < SLIDE_M else 1


def _surface(scene: Scene, body: Humanoid, thing: Instance, name: str, wide: bool, place: Array) -> Chore | None:
    """Return the chore of lifting something from a thing or putting it there, from a place [3].

    The result is None if the hands do not reach it.
    """
    root, matrix = ground_pose(place[:2], float(place[2])), instance_matrix(thing)
    ahead = quat_rotate(root[3:], np.array([1.0, 0.0, 0.0]))
    half = TRAY_M if wide else ITEM_M
    for board in scene.assets[thing.asset].receptacles:
        centre = matrix[:3, :3] @ board.center + matrix[:3, 3]
        if not 0.35 * body.height_m < centre[1] < 0.75 * body.height_m:
            continue
        extent = np.abs(matrix[:3, :3] @ [board.half_size[0], 0, board.half_size[1]])[[0, 2]]
        inset = np.abs(quat_rotate(root[3:], half * (1, 0, 1)))[[0, 2]]
        for over in OVERHANGS_M if wide else (0.0,):
            inner = inset - over * np.abs(ahead[[0, 2]])
            low, high = centre[[0, 2]] - extent + inner, centre[[0, 2]] + extent - inner
            if (low > high).any():
                continue
            near = np.clip(place[:2] + 0.05 * ahead[[0, 2]], low, high)
            spot = np.array([near[0], centre[1] + half[1], near[1]])
            # first what takes least time to find out
            if float(abs((near - place[:2]) @ [-ahead[2], ahead[0]])) >= ASIDE_M:
                continue
            grips = _seen(root, _grips(spot, root) if wide else np.stack([spot, spot]))
            farther = _farther(body, grips) if wide else 0.0
            if not (np.isfinite(farther) if wide else reacher(body, "left").reachable(grips[:1])[0]):
                continue
            if not _occupied(scene, thing, spot, inset):
                return Chore(name, thing.name, root, spot, farther_m=farther, wide=wide)
    return None


def _farther(body: Humanoid, grips: Array) -> float:
    """Return the distance [m] by which a body has to lean farther so that both palms reach places [2, 3] at once.

    The distance is NaN if they do not reach.

    The trunk is turned less than for one hand, which takes reach from both.
    """
    for farther in FARTHER_M:
        there = grips + np.array([farther, 0.0, 0.0])
        one, other = (reach_poses(body, there[k : k + 1], hand) for k, hand in enumerate(BOTH))
        if one.status[0] or other.status[0]:
            continue
        quats = quat_nlerp(one.quats, other.quats, np.full((1, 55), 0.5))
        frames = body.joint_matrices(IDENTITY_POSE[None], quats, (one.pelvis + other.pelvis) / 2)[0]
        gaps = np.linalg.norm(frames[[joints[0] for joints in ARMS], :3, 3] - grips, axis=1)
        if all(gap < 0.97 * _arm(body, side) for side, gap in enumerate(gaps.tolist())):
            return farther
    return np.nan


def _arm(body: Humanoid, side: int) -> float:
    """Return the length of an arm from the shoulder to the palm [m]."""
    grasp = grasp_point(body, BOTH[side])
    return float(np.linalg.norm(body.joint_offsets[ARMS[side][1:]], axis=1).sum() + 0.5 * np.linalg.norm(grasp))


@lru_cache(maxsize=16)
def _solids(scene: Scene) -> tuple[list[Instance], Array]:
    """Return everything in a scene that has shapes, with its bounds [N, 2, 3]."""
    solids = [each for each in scene.instances if scene.assets[each.asset].shapes]
    return solids, np.array([instance_bounds(scene, each) for each in solids]).reshape(-1, 2, 3)


def _occupied(scene: Scene, thing: Instance, spot: Array, inset: Array) -> bool:
    """Return whether something stands where a tray would."""
    solids, bounds = _solids(scene)
    low, high = bounds[:, 0], bounds[:, 1]
    near = (low[:, 1] < spot[1] + 0.2) & (high[:, 1] > spot[1] - 0.005)
    near &= (np.maximum(low - spot, spot - high)[:, [0, 2]] < inset).all(1)
    for other in (solids[k] for k in np.flatnonzero(near)):
        if other is not thing and not other.name.startswith(f"{thing.name}/"):
            # walls are around everything, and chairs before a table are not over it
            points = transform_points(instance_matrix(other), scene.assets[other.asset].mesh.vertices) - spot
            there = (np.abs(points[:, [0, 2]]) < inset).all(1) & (points[:, 1] > -0.005) & (points[:, 1] < 0.2)
            if there.any():
                return True
    return False


def _hands(root: Array, hinge: Array) -> tuple[Hand, Hand]:
    """Return the hand that opens a door, on the side of its hinge [2], and the one that takes."""
    right = _seen(root, np.array([[hinge[0], 0.0, hinge[1]]]))[0, 2] > 0
    return ("right", "left") if right else ("left", "right")


def _seen(root: Array, points: Array) -> Array:
    """Return world points [N, 3] in the frames of agent roots, [7] or [N, 7]."""
    inverse = pose_inverse(root)
    return inverse[..., :3] + quat_rotate(np.broadcast_to(inverse[..., 3:], (*points.shape[:-1], 4)), points)


def _grips(middle: Array, root: Array) -> Array:
    """Return the places [..., 2, 3] of the left and the right palm at trays whose middle is at world points [..., 3]."""
    ends = np.array([[-GRIP_BACK_M, 0, -TRAY_M[2]], [-GRIP_BACK_M, 0, TRAY_M[2]]])
    quats = np.broadcast_to(root[..., None, 3:], (*middle.shape[:-1], 2, 4))
    return middle[..., None, :] + quat_rotate(quats, np.broadcast_to(ends, (*middle.shape[:-1], 2, 3)))
