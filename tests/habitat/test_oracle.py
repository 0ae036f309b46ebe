"""The oracle's minimum steps against the real habitat-lab's at 60 and 120 Hz, and its rules on an empty floor."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from h3data.errors import InputError
from h3data.geometry import ground_pose
from h3data_habitat.metrics.oracle import LONGEST, oracle_min_steps, steps_to_find
from h3data_habitat.navmesh.file import read_navmesh
from h3data_habitat.navmesh.pathfinder import PathFinder
from tests.paths import REFERENCE

golden = pytest.mark.skipif(
    not (REFERENCE / "socialnav").is_dir(),
    reason=f"real habitat-lab reference files are not on this machine: {REFERENCE}",
)


class EmptyFloor:
    """Every way is straight."""

    def path(self, start, end):
        return np.stack([np.asarray(start, float), np.asarray(end, float)])


class Closed:
    """There is no way anywhere."""

    def path(self, start, end):
        return np.zeros((0, 3))


def pose(x: float, z: float, heading: float) -> np.ndarray:
    return ground_pose(np.array([x, z]), np.array(heading))


@pytest.fixture(scope="module")
def finder() -> PathFinder:
    return PathFinder(read_navmesh(REFERENCE / "navmesh" / "flat.navmesh"))


@golden
def test_steps_equal_the_real_oracle_wherever_our_way_is_its_way(finder):
    """Habitat's ways are taut strings through the polygons that A* chose; where ours are shorter, so may the steps be."""
    queries = json.loads((REFERENCE / "socialnav" / "oracle_min_steps.json").read_text())
    same, equal = 0, 0
    for query in queries:
        x, y, z = query["robot_base_pos"]
        start = ground_pose(np.array([x, z]), np.array(query["robot_yaw"]), np.array(y))
        human = np.array(query["human_base_pos"])
        if abs(finder.geodesic_distance(start[:3], human) - query["geodesic"]) > 1e-4:
            continue
        for name in (n for n in query if n.startswith("min_step")):
            hz, speed = name.removeprefix("min_step_hz").split("_lin")
            same += 1
            equal += steps_to_find(finder, start, human, hz=float(hz), speed=float(speed)) == query[name]
    assert same >= 200
    assert equal >= 0.99 * same


@golden
@pytest.mark.parametrize("path", sorted((REFERENCE / "socialnav").glob("*_sp*.npz")), ids=lambda p: p.stem)
def test_l_equals_the_real_one_on_whole_trajectories(path, finder):
    with np.load(path) as file:
        data = dict(file)
    at = data["robot_base_pos_f32"][0].astype(float)
    start = ground_pose(at[[0, 2]], data["in_robot_yaw"][0], at[1])
    hz = 120 if path.stem.endswith("120") else 60
    assert oracle_min_steps(finder, start, data["human_base_pos_f32"], hz=hz) == data["min_step"][-1]


@golden
def test_half_the_speed_at_half_the_rate_is_the_same_robot():
    for query in json.loads((REFERENCE / "socialnav" / "oracle_min_steps.json").read_text()):
        assert query["min_step_hz60_lin5"] == query["min_step_hz120_lin10"]


@given(
    x=st.floats(-6, 6), z=st.floats(-6, 6), heading=st.floats(-3, 3), turn=st.floats(-3, 3), shift=st.floats(-20, 20)
)
def test_only_the_step_length_counts_and_not_the_place(x, z, heading, turn, shift):
    human = np.array([0.0, 0.0, 0.0])
    here = steps_to_find(EmptyFloor(), pose(x, z, heading), human)
    assert steps_to_find(EmptyFloor(), pose(x, z, heading), human, hz=60, speed=5) == here
    assert steps_to_find(EmptyFloor(), pose(x, z, heading), human, hz=60, speed=10) <= here
    assert here >= max(0.0, np.hypot(x, z) - 2.0) / (10 / 120) - 1e-6
    c, s = np.cos(turn), np.sin(turn)
    moved = pose(c * x + s * z + shift, -s * x + c * z, heading + turn)
    assert (
        abs(steps_to_find(EmptyFloor(), moved, human + np.array([shift, 0.0, 0.0])) - here) <= 1
    )  # thresholds and rounding


def test_a_drive_straight_ahead():
    ahead = np.array([7.0, 0.0, 0.0])  # 5 m to drive at 1/12 m a step
    assert steps_to_find(EmptyFloor(), pose(0, 0, 0), ahead) in (60, 61)
    assert steps_to_find(EmptyFloor(), pose(0, 0, 0), ahead, hz=60) in (30, 31)
    behind = steps_to_find(EmptyFloor(), pose(0, 0, np.pi / 2), ahead)
    assert behind >= 60 + 17  # (pi/2 - 0.1) / (1/12)
    assert steps_to_find(EmptyFloor(), pose(5.5, 0, 0), ahead) == 0


def test_the_rules_differ_by_one_step():
    start, stands = pose(0, 0, 0), np.tile([7.0, 0.0, 0.0], (200, 1))
    needed = steps_to_find(EmptyFloor(), start, stands[0])
    assert oracle_min_steps(EmptyFloor(), start, stands) == needed
    assert oracle_min_steps(EmptyFloor(), start, stands, rule="paper") == needed + 1
    spaced = oracle_min_steps(EmptyFloor(), start, stands, rule="paper", every=50)
    assert spaced == 101  # of steps 1, 51, 101, ... the first in time
    assert oracle_min_steps(EmptyFloor(), start, stands[:20]) is None
    assert oracle_min_steps(EmptyFloor(), start, stands[:0]) is None


def test_who_cannot_be_reached_and_what_is_refused():
    assert steps_to_find(Closed(), pose(0, 0, 0), np.array([7.0, 0.0, 0.0])) == LONGEST
    with pytest.raises(InputError, match="H3-METRIC-013"):
        steps_to_find(Closed(), pose(0, 0, 0), np.zeros(3), hz=0)
    with pytest.raises(InputError, match="H3-METRIC-014"):
        oracle_min_steps(Closed(), pose(0, 0, 0), np.zeros((1, 3)), every=0)
