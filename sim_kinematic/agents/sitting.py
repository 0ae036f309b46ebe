"""People who sit down, sit and get up: skills of a `sim_kinematic.agents.person.Person` on a seat of a home."""

from __future__ import annotations

import numpy as np

from h3data.bodies.people.planted_gait import on_stairs
from h3data.bodies.people.sitting import Sitting
from h3data.geometry import heading_from_quat, wrap_angle
from h3data.scene.seats import Seat
from sim_kinematic.agents.person import MotionResult, Person, Skill
from sim_kinematic.crowd.seating import RISE_S, SIT_S, fit, stand_before
from sim_kinematic.motion.spec import STEP_S

AWAY_M = tuple(0.3 + 0.1 * k for k in range(8))
"""Distances before the stand, of which the first on free floor is walked to; from there people go straight to it."""
PLACE_M, HEADING_RAD = 0.06, 0.2
"""A person sits down if they stand this near to where they should."""


def sit(person: Person, seat: Seat, seconds: float) -> Skill:
    """Walk to a seat, turn the back to it, sit down, sit for some time, get up, and step away.

    The path goes around furniture where the person knows the floor (`Person.free`), else straight.
    """
    x, z, heading = stand_before(person.body, seat).tolist()
    ahead = np.array([[x, z]]) + np.array(AWAY_M)[:, None] * [np.cos(heading), -np.sin(heading)]
    path = ahead[:1]
    if person.free is not None:
        here = person.free.island(person.base[[0, 2]])
        free = ahead[person.free.island(ahead) == here]
        path = person.free.path(person.base[[0, 2]], free[0])[1:] if len(free) else free
        if not len(path):
            return MotionResult(success=False, reason="no_way")
    yield from person.walk_to(path)
    floor = person.walk.tables
    # feet that keep out of furniture would be pushed away from the seat that they stand close to
    person.walk.tables = on_stairs(person.body.gait_tables, floor.heights)
    try:
        yield from person.walk_to([x, z])
        yield from person.turn(heading)
        for part in (sit_down(person, seat), rest(person, seat, seconds), get_up(person, seat)):
            result = yield from part
            if not result.success:
                return result
        yield from person.walk_to(path[-1])
    finally:
        person.walk.tables = floor
    return MotionResult(success=True)


def sit_down(person: Person, seat: Seat) -> Skill:
    """Sit down on the seat behind the person."""
    away = np.linalg.norm(stand_before(person.body, seat)[:2] - person.base[[0, 2]])
    turned = abs(wrap_angle(seat.heading - float(heading_from_quat(person.base[3:]))))
    if away > PLACE_M or turned > HEADING_RAD:
        return MotionResult(success=False, reason="not_before_seat", hand_error_m=float(away))
    yield from person.settle()
    yield from _move(person, fit(person.body, seat), 0.0, 1.0, SIT_S)
    return MotionResult(success=True)


def rest(person: Person, seat: Seat, seconds: float) -> Skill:
    """Remain seated for some time."""
    yield from _move(person, fit(person.body, seat), 1.0, 1.0, seconds)
    return MotionResult(success=True)


def get_up(person: Person, seat: Seat) -> Skill:
    """Get up from the seat, and stand."""
    yield from _move(person, fit(person.body, seat), 1.0, 0.0, RISE_S)
    yield from person.wait(0.5)
    return MotionResult(success=True)


def _move(person: Person, sitting: Sitting, start: float, end: float, seconds: float) -> Skill:
    steps = max(round(seconds / STEP_S), 1)
    u = np.arange(1, steps + 1) / steps
    share = start + (end - start) * u**3 * (10 - 15 * u + 6 * u * u)
    for quats, pelvis in zip(*sitting.pose(share), strict=True):
        person.walk.step(person.base)
        person.show("sit", quats, pelvis)
        yield
    return MotionResult(success=True)
