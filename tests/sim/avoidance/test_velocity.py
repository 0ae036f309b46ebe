"""How a robot speeds up, brakes, and holds on to what it has chosen."""

from __future__ import annotations

from functools import cache

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from h3data.scene import FreeSpace
from h3data_homes import HomeSpec, build_home
from sim_kinematic.avoidance.robot_base import hull_of
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.avoidance.velocity import (
    base_numbers,
    braking_speed,
    crowding,
    keep_clear,
    least_gap,
    try_command,
)
from sim_kinematic.motion.spec import HOME_BASE, STEP_S, BaseSpec
from sim_kinematic.motion.step import drive_robots, integrate, least_clearance
from tests.sim.avoidance.commands import NOTHING_HELD, Seen, kept_clear, neighbours, reference, standing

COMMANDS = st.tuples(st.floats(-1, 1), st.floats(-1, 1))
ROUNDING = 1e-12


@cache
def roomy() -> tuple[FreeSpace, np.ndarray]:
    """A home, and its point with the most room."""
    free = FreeSpace.from_scene(build_home(HomeSpec(preset="small", seed=1)), radius_m=0.25)
    places = free.sample(np.random.default_rng(0), 400)
    return free, places[int(np.argmax(free.signed_distance(places)))]


def eased(base: BaseSpec, wanted: tuple, before: tuple) -> tuple[float, float]:
    """The command of a step in which nobody is near."""
    free, at = roomy()
    return keep_clear(
        free, base_numbers(base), standing(at, 0.0), wanted, at, neighbours(), NOTHING_HELD, None, before
    )[1]


@given(st.integers(0, 10_000), st.integers(0, 3), st.booleans(), st.booleans(), st.booleans())
def test_a_step_has_the_bits_of_its_parts(seed: int, count: int, eases: bool, counts: bool, drives: bool) -> None:
    """The kernel is what the parts of it give in Python, one after the other: to the last bit, signs of zeros included."""
    free, rng = roomy()[0], np.random.default_rng(seed)
    base = (HOME_BASE, BaseSpec(), BaseSpec(max_speed_mps=0.6, max_turn_rad_s=1.0))[seed % 3]
    at, towards = free.sample(rng, 2)
    others = [
        Seen(at + rng.uniform(-2.5, 2.5, 2), rng.uniform(-1, 1, 2).tolist(), bool(rng.random() < 0.3))
        for _ in range(count)
    ]
    wanted, target, before = rng.choice([0.0, -0.0, 0.3, -0.7, 1.0, -1.0, rng.uniform(-1, 1)], (3, 2)).tolist()
    robot, expected = (standing(at, rng.uniform(-4, 4)) for _ in range(2))
    expected.heading[:] = robot.heading
    told = tuple(target) if counts else None, tuple(before) if eases else None
    result = reference(free, base, expected, tuple(wanted), towards, others, *told)
    if drives:
        drive_robots(expected, free, np.array([result[1]]), base)
    around = neighbours(*others), NOTHING_HELD
    given = keep_clear(free, base_numbers(base), robot, tuple(wanted), towards, *around, *told, drives=drives)
    assert np.array(given).tobytes() == np.array(result).tobytes()
    for mine, theirs in zip(robot.arrays(), expected.arrays(), strict=True):
        assert mine.tobytes() == theirs.tobytes()


@given(st.integers(0, 10_000), COMMANDS, st.booleans())
def test_a_roll_out_stops_where_the_floor_ends(seed: int, command: tuple, ends: bool) -> None:
    """A trial looks the floor up only where there may be no room; the reference does so at every step."""
    free, rng = roomy()[0], np.random.default_rng(seed)
    offsets, hull = np.array(HOME_BASE.disc_offsets_m), np.array(hull_of(HOME_BASE))
    (x, z), heading = free.sample(rng, 1)[0].tolist(), float(rng.uniform(-4, 4))
    speed, turn = command[0] * HOME_BASE.max_speed_mps, command[1] * HOME_BASE.max_turn_rad_s
    length, arc = (0.6, 0.5) if ends else (np.inf, np.inf)
    grid, radius, others = (free.sdf, free.origin, free.cell_m), HOME_BASE.disc_radius_m - 2e-3, np.zeros((0, 7))
    room = least_clearance(*grid, x, z, heading, offsets) - radius
    rules = AVOIDANCE.horizon_steps, AVOIDANCE.stride_steps, AVOIDANCE.doubt_mps, STEP_S
    told = others, (offsets, radius), hull, rules, np.inf, np.empty(0)
    given = try_command(*grid, (x, z, heading), room, speed, turn, length, arc, *told)
    for step in range(1, AVOIDANCE.horizon_steps + 1):
        speed = 0.0 if abs(speed) * step * STEP_S > length else speed
        turn = 0.0 if abs(turn) * (step - 0.5) * STEP_S > arc else turn
        there = integrate(x, z, heading, speed, 0.0, turn, STEP_S)
        x, z, heading = there if least_clearance(*grid, *there, offsets) >= radius else (x, z, heading)
    assert given[:3] == (x, z, heading)


@given(COMMANDS, COMMANDS, st.sampled_from([HOME_BASE, BaseSpec(max_speed_mps=0.6, max_turn_rad_s=1.0)]))
def test_commands_grow_and_shrink_within_the_rates(wanted: tuple, before: tuple, base: BaseSpec) -> None:
    forward, turn = eased(base, wanted, before)
    change = (np.array([forward, turn]) - before) * [base.max_speed_mps, base.max_turn_rad_s] / STEP_S
    speeds_up = abs(forward) > abs(before[0]) or forward * before[0] < 0
    assert abs(change[0]) <= max(AVOIDANCE.accel_mps2, AVOIDANCE.brake_mps2) + ROUNDING
    assert (
        not speeds_up or abs(forward) <= abs(before[0]) + AVOIDANCE.accel_mps2 * STEP_S / base.max_speed_mps + ROUNDING
    )
    kept = abs(before[1]) if turn * before[1] > 0 else 0.0  # it stops turning at once
    assert abs(turn) <= kept + AVOIDANCE.turn_accel_rad_s2 * STEP_S / base.max_turn_rad_s + ROUNDING
    for new, old, goal in zip((forward, turn), before, wanted, strict=True):  # towards what is wanted, and no farther
        assert min(old, goal) - ROUNDING <= new <= max(old, goal) + ROUNDING


@given(COMMANDS, COMMANDS)
def test_it_gets_to_what_is_wanted(wanted: tuple, before: tuple) -> None:
    command = before
    for _ in range(40):
        command = eased(HOME_BASE, wanted, command)
    np.testing.assert_allclose(command, wanted, atol=1e-9)


@given(COMMANDS, COMMANDS)
def test_ahead_and_back_left_and_right_are_alike(wanted: tuple, before: tuple) -> None:
    mirrored = eased(HOME_BASE, (-wanted[0], -wanted[1]), (-before[0], -before[1]))
    np.testing.assert_allclose(mirrored, -np.array(eased(HOME_BASE, wanted, before)), atol=1e-12)


@given(st.floats(0.1, 20), st.floats(0, 10), st.floats(0, 3))
def test_braking_from_the_braking_speed_ends_where_it_should(accel: float, left: float, last: float) -> None:
    speed = braking_speed(accel, left, last)
    assert abs((speed**2 - last**2) / (2 * accel) - left) < 1e-9 * max(1.0, left)
    assert braking_speed(accel, -1.0, last) == last


def test_beside_somebody_it_holds_on_to_the_side_on_which_it_passes() -> None:
    """Of two ways past somebody straight ahead it keeps the one on which it is."""
    free, at = roomy()
    ahead = at + np.array([1.6, 0.0])
    somebody = Seen(at + np.array([1.1, 0.0]))
    for side in (1.0, -1.0):
        chosen = kept_clear(free, HOME_BASE, at, 0.0, (1.0, 0.0), ahead, [somebody], (0.5, side))
        assert chosen[1] * side >= 0.0


@given(st.integers(0, 2**32 - 1), st.integers(0, 9), st.integers(0, 3))
def test_stands_are_rated_by_the_nearest_agent(seed: int, stands: int, others: int) -> None:
    rng = np.random.default_rng(seed)
    at = rng.uniform(-1, 1, (stands, 3)) * (2.0, 2.0, np.pi)
    discs = [Seen(rng.uniform(-2, 2, 2)) for _ in range(others)]
    hull, expected = np.array(hull_of(HOME_BASE)), []
    for x, z, heading in at.tolist():
        reach = HOME_BASE.disc_radius_m + AVOIDANCE.person_radius_m
        gaps = [least_gap(x, z, heading, *other.xz, hull, reach) for other in discs]
        near = any(gap < AVOIDANCE.margin_m for gap in gaps)
        expected.append(2 if any(gap < AVOIDANCE.still_margin_m for gap in gaps) else int(near))
    assert crowding(HOME_BASE, at, neighbours(*discs)).tolist() == expected
