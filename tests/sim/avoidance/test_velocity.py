"""How a robot speeds up, brakes, and holds on to what it has chosen."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from h3data.scene import FreeSpace
from h3data_homes import HomeSpec, build_home
from sim_kinematic.avoidance.robot_base import hull_of
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.avoidance.velocity import ObstacleDisc, braking_speed, crowding, eased, keep_clear, least_gap
from sim_kinematic.motion.spec import HOME_BASE, STEP_S, BaseSpec

COMMANDS = st.tuples(st.floats(-1, 1), st.floats(-1, 1))
ROUNDING = 1e-12


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
    free = FreeSpace.from_scene(build_home(HomeSpec(preset="small", seed=1)), radius_m=0.25)
    places = free.sample(np.random.default_rng(0), 400)
    at = places[int(np.argmax(free.signed_distance(places)))]
    ahead = at + np.array([1.6, 0.0])
    somebody = ObstacleDisc(at + np.array([1.1, 0.0]), np.zeros(2))
    for side in (1.0, -1.0):
        chosen = keep_clear(free, HOME_BASE, at, 0.0, (1.0, 0.0), ahead, [somebody], (0.5, side))
        assert chosen[1] * side >= 0.0


@given(st.integers(0, 2**32 - 1), st.integers(0, 9), st.integers(0, 3))
def test_stands_are_rated_by_the_nearest_agent(seed: int, stands: int, others: int) -> None:
    rng = np.random.default_rng(seed)
    at = rng.uniform(-1, 1, (stands, 3)) * (2.0, 2.0, np.pi)
    discs = [
        ObstacleDisc(tuple(rng.uniform(-2, 2, 2).tolist()), [0.0, 0.0], False, *rng.uniform(0.0, 0.5, 2).tolist())
        for _ in range(others)
    ]
    hull, expected = np.array(hull_of(HOME_BASE)), []
    for x, z, heading in at.tolist():
        reach = [HOME_BASE.disc_radius_m + other.radius_m for other in discs]
        gaps = [least_gap(x, z, heading, *other.xz, hull, r) for other, r in zip(discs, reach, strict=True)]
        near = any(gap < other.margin_m for gap, other in zip(gaps, discs, strict=True))
        expected.append(2 if any(gap < AVOIDANCE.still_margin_m for gap in gaps) else int(near))
    assert crowding(HOME_BASE, at, discs).tolist() == expected
