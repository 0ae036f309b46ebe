"""Motions of a `sim_kinematic.agents.person.Person` who sits down on a seat, sits there and gets up."""

from __future__ import annotations

import numpy as np

from h3data.bodies.people.planted_gait import on_stairs
from h3data.bodies.people.sitting import take_seats
from h3data.geometry import Array
from sim_kinematic.agents.person import MotionResult, Person, Skill
from sim_kinematic.crowd.seating import SeatPlace, sit_for
from sim_kinematic.motion.state import HumanState


def sit(person: Person, place: SeatPlace, seconds: float) -> Skill:
    """Sit down from the place in front of a seat, sit for some time, get up and step away."""
    floor = person.walk.tables
    # feet that keep out of furniture would be pushed away from the seat that they stand close to
    person.walk.tables = on_stairs(person.body.gait_tables, floor.heights)
    try:
        here = np.append(person.base[[0, 2]], person.heading)
        for at, share in sit_for(here, place, seconds):
            show_seated(person, place, at, share)
            yield
    finally:
        person.walk.tables = floor
    return MotionResult(success=True)


def show_seated(person: Person, place: SeatPlace | None, at: Array, share: float) -> None:
    """Pose a person at a place ``(x, z, heading)`` [3], between standing (share 0, or no seat) and sitting (1)."""
    gait = HumanState.zeros(1)
    gait.xz[0], gait.heading[0] = at[:2], at[2]
    person.base = person.root_at(gait)
    quats, pelvis = person.walk.stride(person.base, person.heading)
    quats = person.with_arms(quats)
    if place is not None:
        take_seats(person.body, quats[None], pelvis[None], [(place.seat.height_m, share)])
    person.show("walk", quats, pelvis)
