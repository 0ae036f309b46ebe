"""Half-planes of velocities, the linear program over them, and forces between people: laws that hold for any numbers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from benchmarks.people import hall
from h3data.scene import FreeSpace
from h3data_social.people.profile import social_force
from sim_kinematic.crowd.orca import half_plane, nearest_velocity
from sim_kinematic.crowd.social_force import interaction
from sim_kinematic.crowd.step import first_through, is_narrow
from sim_kinematic.crowd.traits import CrowdSpec, sample_traits

metres = st.floats(-4.0, 4.0)
speeds = st.floats(-1.5, 1.5)
FORCE = CrowdSpec().numbers[14:18]


def least_gap(p: np.ndarray, v: np.ndarray, horizon: float) -> float:
    """Least distance of a neighbour at ``p`` [2] to somebody who moves with ``v`` [2] relative to it, within ``horizon``."""
    at = np.clip((p @ v) / max(v @ v, 1e-12), 0.0, horizon)
    return float(np.hypot(*(p - at * v)))


@given(metres, metres, speeds, speeds, st.floats(0.3, 1.0), st.floats(0.5, 3.0))
def test_who_makes_the_whole_change_does_not_touch_within_the_horizon(px, pz, vx, vz, radius, horizon):
    p, v = np.array([px, pz]), np.array([vx, vz])
    assume(np.hypot(px, pz) > radius + 1e-3)
    nx, nz, offset = half_plane(px, pz, vx, vz, radius, horizon, 0.5, 1.0)
    assert math.hypot(nx, nz) == pytest.approx(1.0)
    n = np.array([nx, nz])
    changed = v + n * offset  # the least change that is allowed
    if offset > 0.0:
        assert least_gap(p, changed, horizon) >= radius - 1e-6
    else:
        assert least_gap(p, v, horizon) >= radius - 1e-6, "a velocity that needs no change leads nowhere near"


@given(st.floats(0.75, 4.0), st.floats(-math.pi, math.pi), st.floats(0.9, 2.0), st.floats(-0.1, 0.1))
def test_two_who_share_the_change_avoid_each_other(distance, angle, haste, beside):
    radius, horizon = 0.7, 2.0
    p = distance * np.array([math.cos(angle), math.sin(angle)])
    v = (haste * p + beside * np.array([-p[1], p[0]])) / horizon  # they meet within the horizon
    (px, pz), (vx, vz) = p, v
    nx, nz, offset = half_plane(px, pz, vx, vz, radius, horizon, 0.5, 0.5)
    assert offset > 0.0
    mx, mz, other = half_plane(-px, -pz, -vx, -vz, radius, horizon, 0.5, 0.5)
    assert (mx, mz, other) == pytest.approx((-nx, -nz, offset), abs=1e-6)
    changed = v + np.array([nx, nz]) * offset - np.array([mx, mz]) * other
    assert least_gap(p, changed, horizon) >= radius - 1e-6


planes = st.lists(st.tuples(st.floats(-math.pi, math.pi), st.floats(-1.0, 0.3)), max_size=5)


@given(planes, speeds, speeds)
def test_the_nearest_velocity_is_allowed_and_no_other_is_nearer(rows, wx, wz):
    most = 1.4
    table = np.array([[math.cos(a), math.sin(a), b] for a, b in rows]).reshape(-1, 3)
    v = np.array(nearest_velocity(table, len(table), wx, wz, most))
    assert np.hypot(*v) <= most + 1e-9
    angles, radii = np.meshgrid(np.linspace(0, 2 * np.pi, 61), np.linspace(0, most, 15))
    grid = np.stack([radii * np.cos(angles), radii * np.sin(angles)], -1).reshape(-1, 2)
    allowed = grid[(grid @ table[:, :2].T >= table[:, 2] + 1e-6).all(1)]
    if len(allowed):
        assert (table[:, :2] @ v >= table[:, 2] - 1e-6).all()
        wanted = np.array([wx, wz])
        assert np.hypot(*(v - wanted)) <= np.hypot(*(allowed - wanted).T).min() + 1e-9


@given(metres, metres, speeds, speeds, st.floats(-math.pi, math.pi))
def test_a_force_turns_with_the_scene_and_is_mirrored_with_it(px, pz, vx, vz, angle):
    assume(math.hypot(px, pz) > 0.1)
    fx, fz = interaction(px, pz, vx, vz, *FORCE)
    c, s = math.cos(angle), math.sin(angle)

    def turned(x: float, z: float) -> tuple[float, float]:
        return c * x - s * z, s * x + c * z

    assert interaction(*turned(px, pz), *turned(vx, vz), *FORCE) == pytest.approx(turned(fx, fz), abs=1e-6)
    theta = math.atan2(pz, px) - math.atan2(2.0 * vz + pz / math.hypot(px, pz), 2.0 * vx + px / math.hypot(px, pz))
    if abs(math.sin(theta)) > 1e-6:  # in line, the side of evasion is a convention
        assert interaction(px, -pz, vx, -vz, *FORCE) == pytest.approx((fx, -fz), abs=1e-6)


@given(metres, metres, speeds, speeds)
def test_a_force_has_the_size_that_metrics_report(px, pz, vx, vz):
    assume(math.hypot(px, pz) > 0.1)
    size = CrowdSpec().social_gain * math.hypot(*interaction(px, pz, vx, vz, *FORCE))
    measured = float(social_force(np.array([[px, pz]]), np.array([[vx, vz]]))[0])
    assert size == pytest.approx(measured, rel=1e-6, abs=1e-9) or abs(px * vz - pz * vx) < 1e-6


def test_a_force_slows_down_and_turns_away_from_the_side_of_the_neighbour():
    fx, fz = interaction(1.5, 0.2, 1.0, 0.0, *FORCE)
    assert fx < 0.0
    assert fz < 0.0
    far, _ = interaction(4.0, 0.2, 1.0, 0.0, *FORCE)
    assert abs(far) < abs(fx)


def test_places_are_narrow_where_two_cannot_pass_and_not_beside_a_wall_of_a_hall():
    free = FreeSpace.from_scene(hall(6.0, 1.0), cache=False)
    wide = FreeSpace.from_scene(hall(6.0, 1.4), cache=False)
    grids = [(floor.sdf, floor.origin, floor.cell_m) for floor in (free, wide)]
    for z in (0.25, 0.32, 0.4, 0.45, 0.52, 0.6, 0.7):
        assert is_narrow(*grids[0], 3.0, z, 0.55, True), "0.5 m from both walls at most"
        assert is_narrow(*grids[1], 3.0, z, 0.55, False) == (z < 0.55)
        assert not is_narrow(*grids[1], 3.0, z, 0.55, True), "who walks here can go aside to the middle"


def test_constants_of_earlier_versions_stay():
    kept = {1: (2.0, 1.2, 0.9, 2.0, 0.6, 0.8), 3: (1.2, 1.2, 0.9, 0.7, 1.0, 1.1), 5: (1.2, 1.7, 0.9, 0.7, 1.3, 1.3)}
    for version, numbers in (kept | {4: kept[3]}).items():
        assert tuple(CrowdSpec.of_version(version).numbers[[0, 6, 7, 19, 20, 21]]) == numbers
    assert CrowdSpec.of_version(7, wary=True) == CrowdSpec.of_version(4, wary=True), "groups decide as before"
    assert CrowdSpec.of_version(8, wary=True) == replace(CrowdSpec.of_version(4, wary=True), company_m=0.0)
    assert len({CrowdSpec.of_version(version) for version in (3, 4, 5, 6)}) == 4
    for version in (6, 7, 8):
        assert CrowdSpec.of_version(version, wary=True, early=True) == CrowdSpec.of_version(4, wary=True)
        assert replace(CrowdSpec.of_version(version, early=True), version=5) == CrowdSpec.of_version(5)
        assert replace(CrowdSpec.of_version(version), version=6) == CrowdSpec.of_version(6)


@given(st.floats(-math.pi, math.pi), st.floats(0.1, 1.5), st.booleans())
def test_who_has_come_through_a_passage_is_not_waited_for(angle: float, gap: float, inside: bool):
    ahead, nobody = np.array([math.cos(angle), math.sin(angle)]), np.full(2, -1, np.int64)
    for sign in (-1.0, 1.0):
        # the first comes towards the second from ``gap`` beyond the passage of that one, or has gone as far past it
        place = sign * gap * ahead
        claims = np.array([[1.0, *place, *-ahead, 1.0], [2.0, 0.0, 0.0, *ahead, float(inside)]])
        assert first_through(claims, nobody, 1, 1.7, False) == 0, "up to version 5, both count"
        assert first_through(claims, nobody, 1, 1.7, True) == (0 if sign > 0 else -1)
        assert first_through(claims, nobody, 0, 1.7, True) == -1, "who was there first gives way to nobody"


def test_people_differ_and_are_the_same_again():
    people = [sample_traits(7, number, 1.3) for number in range(200)]
    assert people[3] == sample_traits(7, 3, 1.3)
    assert people[3] != sample_traits(8, 3, 1.3)
    speeds = np.array([person.speed_mps for person in people])
    assert speeds.mean() == pytest.approx(1.3, abs=0.1)
    assert 0.25 < speeds.std() < 0.4
    assert speeds.min() >= 0.65
    assert 0.75 < np.mean([person.side > 0 for person in people]) < 0.95
