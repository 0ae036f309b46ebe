"""Sensors and predicates: equal to what the real habitat-lab says, and their laws."""

from __future__ import annotations

import json
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from h3data.errors import InputError
from h3data.geometry import ground_pose, pose_from_matrix, pose_to_matrix, transform_points
from h3data.scene import FreeSpace
from h3data_homes import HomeSpec, build_home
from sim_kinematic.motion.spec import STEP_S, SocialNavSpec
from sim_kinematic.motion.state import NOBODY, ROBOT
from sim_kinematic.motion.step import integrate
from sim_kinematic.sensing import sensor as sensors
from sim_kinematic.sensing import table
from sim_kinematic.tasks.rules import predicates
from tests.paths import REAL, ROOT

GOLDEN = REAL / "habitat-lab" / "reference" / "rearrange" / "predicates_sensors.json"
needs_real = pytest.mark.skipif(not GOLDEN.is_file(), reason="needs the real Habitat files in ../shared/real")
FLOAT32_TOL = 1e-5


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    """Every value of the real code by name, cases first."""
    cases = json.loads(GOLDEN.read_text())
    return {name: np.array([np.nan if c[name] is None else c[name] for c in cases]) for name in cases[0]}


def places(golden: dict[str, np.ndarray], who: str) -> tuple[np.ndarray, np.ndarray]:
    return golden[f"{who}_base_pos"][:, [0, 2]], golden[f"{who}_base_rot"]


@needs_real
def test_predicates_equal_habitats(golden: dict[str, np.ndarray]) -> None:
    held_by = np.where(golden["snap_idx"][:, None] == golden["scene_obj_id"][:, None] + [0, 1], ROBOT, NOBODY)
    holder = SimpleNamespace(held_by=held_by, agent=ROBOT)
    for name, ours in {
        "object_at_0p3": predicates.is_object_at(golden["obj"], golden["goal"]),
        "holding_any": table.TABLE["is_holding"].of(holder)[:, 0],
    }.items():
        np.testing.assert_array_equal(ours, golden[name].astype(bool), err_msg=name)
        assert 0 < ours.sum() < len(ours), name


@needs_real
def test_sensors_equal_habitats(golden: dict[str, np.ndarray]) -> None:
    robot, human = places(golden, "robot"), places(golden, "human")
    target = golden["nav_target"][:, [0, 2]]
    for name, ours in {
        "other_agent_gps_0": sensors.other_agent_gps(robot[0], human[0]),
        "other_agent_gps_1": sensors.other_agent_gps(human[0], robot[0]),
        "agents_within_threshold_0": sensors.agents_within_threshold(*robot, human[0]),
        "agents_within_threshold_1": sensors.agents_within_threshold(*human, robot[0]),
        "goal_to_agent_gps_compass_0": sensors.gps_compass(*robot, target),
        "goal_to_agent_gps_compass_1": sensors.gps_compass(*human, target),
        "nav_goal_is_human_gps_compass": sensors.gps_compass(*robot, human[0]),
        "robot_localization": sensors.localization(*robot, golden["robot_base_pos"][:, 1]),
        "human_localization": sensors.localization(*human, golden["human_base_pos"][:, 1]),
    }.items():
        np.testing.assert_allclose(ours, golden[name], rtol=0, atol=FLOAT32_TOL, err_msg=name)


@needs_real
def test_in_frame_is_the_inverse_of_habitats_transforms(golden: dict[str, np.ndarray]) -> None:
    transforms = golden["robot_sim_obj_T"].astype(np.float64)
    points = np.stack([golden["goal"], golden["obj"]], axis=1)
    back = sensors.in_frame(pose_from_matrix(transforms), points)
    np.testing.assert_allclose(transform_points(transforms, back), points, atol=FLOAT32_TOL)


angles = st.floats(-9, 9)
coordinates = st.tuples(st.floats(-20, 20), st.floats(-20, 20))


@given(coordinates, angles, coordinates, angles)
def test_seen_from_a_base_does_not_depend_on_where_the_world_is(
    xz: tuple[float, float], heading: float, point: tuple[float, float], turn: float
) -> None:
    seen = sensors.in_base_frame(xz, heading, point)
    frame = pose_to_matrix(ground_pose(np.array(xz), heading))
    x, y, z = transform_points(np.linalg.inv(frame), np.array([[point[0], 0.0, point[1]]]))[0]
    np.testing.assert_allclose([seen[0], -seen[1], 0], [x, z, y], atol=1e-9)
    c, s = np.cos(turn), np.sin(turn)
    turned = np.array([[c, s], [-s, c]])  # about +Y, points (x, z)
    again = sensors.in_base_frame(turned @ xz + [1, 2], heading + turn, turned @ point + [1, 2])
    np.testing.assert_allclose(again, seen, atol=1e-9)


@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(-2, 2), angles)
def test_egomotion_is_the_velocity_that_moved_it(speed: float, lateral: float, turn: float, heading: float) -> None:
    x, z, new = integrate.py_func(0.3, -0.4, heading, speed, lateral, turn, STEP_S)
    moved = sensors.egomotion([0.3, -0.4], heading, [x, z], new)
    np.testing.assert_allclose(moved, [speed, lateral, turn], atol=1e-9)


def test_the_detector_counts_and_frames_as_habitat() -> None:
    ids = np.zeros((2, 60, 80), np.int32)
    ids[0, 10:40, 20:60] = sensors.HUMAN_ID  # 1,200 pixels
    ids[1, 5, 7] = sensors.HUMAN_ID
    seen = sensors.detect_humanoids(ids)
    assert seen.found.tolist() == [1.0, 0.0]
    assert seen.mask.sum((1, 2)).tolist() == [1200.0, 1.0]
    np.testing.assert_array_equal(np.argwhere(seen.box[0])[[0, -1]], [[10, 20], [38, 58]])  # 39 and 59 are left out
    assert not seen.box[1].any()
    assert not sensors.detect_humanoids(ids, 7).mask.any()
    assert sensors.detect_humanoids(ids[0], more_than_pixels=1199).found == 1.0
    assert sensors.detect_humanoids(ids[0], more_than_pixels=1200).found == 0.0
    with pytest.raises(InputError, match="H3-SIM-049"):
        sensors.detect_humanoids(np.zeros(5, np.int32))


@given(st.integers(0, 2**32 - 1))
def test_the_box_is_that_of_the_mask(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mask = rng.random((9, 7)) < rng.choice([0.0, 0.05, 0.4])
    box = np.zeros(mask.shape, np.float32)
    if mask.any():
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        box[rows[0] : rows[-1], columns[0] : columns[-1]] = 1
    np.testing.assert_array_equal(sensors.detect_humanoids(mask.astype(int), 1).box, box)


def test_one_world_is_as_many() -> None:
    rng = np.random.default_rng(0)
    xz, heading, other = rng.normal(size=(64, 2)), rng.normal(size=64), rng.normal(size=(64, 2))
    functions: list[Any] = [
        sensors.gps_compass,
        sensors.agents_within_threshold,
        sensors.facing,
        sensors.in_base_frame,
    ]
    for function in functions:
        many = function(xz, heading, other)
        np.testing.assert_array_equal(many, [function(*row) for row in zip(xz, heading, other, strict=True)])


def test_found_is_near_and_faced() -> None:
    spec = SocialNavSpec()
    distance, dot = np.array([0.99, 1.0, 2.0, 2.01, 1.5, np.inf]), np.array([1.0, 1.0, 0.51, 1.0, 0.5, 1.0])
    assert predicates.is_found(distance, dot, spec).tolist() == [False, True, True, False, False, False]


def test_noise_is_what_it_says_and_repeats() -> None:
    depth = np.full((4, 100, 100), 2.0, np.float32)
    depth[0, 0] = 0.0
    noisy = sensors.depth_with_noise(depth, np.random.default_rng(0))
    assert not noisy[0, 0].any()
    assert (noisy[1:] - 2.0).std() == pytest.approx(0.0012 + 0.0019 * 1.6**2, rel=0.03)
    np.testing.assert_array_equal(noisy, sensors.depth_with_noise(depth, np.random.default_rng(0)))
    lost = sensors.depth_with_noise(depth, np.random.default_rng(0), missing=0.25)
    assert (lost[1:] == 0).mean() == pytest.approx(0.25, abs=0.02)
    assert sensors.with_noise(np.zeros(4000), 0.1, np.random.default_rng(1)).std() == pytest.approx(0.1, rel=0.05)


# --- of the home --------------------------------------------------------------------------------------------------------
def test_a_range_scan_measures_the_way_to_walls() -> None:
    free = FreeSpace.from_scene(build_home(HomeSpec(preset="small", seed=1)))
    rng = np.random.default_rng(0)
    xz, heading = free.sample(rng, 200), rng.uniform(-np.pi, np.pi, 200)
    seen = sensors.range_scan(free.signed_distance, xz, heading)
    assert seen.shape == (200, sensors.RANGES)
    np.testing.assert_array_equal(seen[3], sensors.range_scan(free.signed_distance, xz[3], heading[3]))
    angle = heading[:, None] + np.radians(30) * np.arange(12)
    direction = np.stack([np.cos(angle), -np.sin(angle)], -1)
    ends = free.signed_distance(xz[:, None] + seen[..., None] * direction)
    reached = seen < sensors.RANGE_M
    assert 0.2 < reached.mean() < 0.9
    assert (
        free.signed_distance(xz[:, None] + 0.999 * seen[..., None] * direction) > -1e-3
    ).all()  # never through a wall
    assert np.quantile(ends[reached], 0.9) < 0.05
    turned = sensors.range_scan(
        free.signed_distance, xz, heading + np.radians(30)
    )  # what was 30 degrees to the left is straight ahead
    np.testing.assert_allclose(turned[:, :-1], seen[:, 1:], atol=1e-6)


def test_a_way_is_the_shortest_and_begins_at_its_first_corner() -> None:
    free = FreeSpace.from_scene(build_home(HomeSpec(preset="small", seed=1)))
    rng = np.random.default_rng(1)
    for a, b in free.sample(rng, 40).reshape(-1, 2, 2):
        path = free.path(a, b)
        corner = next((p for p in path[1:] if np.hypot(*(p - a)) > 0.2), b)
        heading = float(np.arctan2(-(corner - a)[1], (corner - a)[0]))
        shortest = free.geodesic(a, b)
        point = sensors.first_point(free, a, b, float(shortest), beyond_m=0.2)
        length, angle = sensors.way(a, heading + 0.3, shortest, point)
        assert length == pytest.approx(np.hypot(*np.diff(path, axis=0).T).sum())
        assert angle == pytest.approx(0.3)  # it looks too far to the left: the way begins to the right
    nowhere = sensors.first_point(free, a, b, np.inf, beyond_m=0.2)
    np.testing.assert_array_equal(sensors.way(a, 0.0, np.asarray(np.inf), nowhere), [sensors.FAR_M, 0.0])


def test_her_velocity_is_seen_along_the_robots_axes() -> None:
    seen = sensors.humanoid_velocity([0.0, np.pi / 2], [1.0, 2.0], [1.0 + 2.5 * STEP_S, 2.0])
    np.testing.assert_allclose(
        seen, [[2.5, 0.0], [0.0, -2.5]], atol=1e-12
    )  # heading pi / 2 faces -Z: +X is to its right


# --- one table ----------------------------------------------------------------------------------------------------------
def test_the_name_of_a_sensor_is_written_where_it_is_defined_and_where_users_type_it() -> None:
    packages = (ROOT / name for name in ("h3data", "sim_kinematic", "pipelines", "viewers"))
    files = [f for package in packages for f in package.rglob("*.py") if '"humanoid_gps"' in f.read_text()]
    assert {f.relative_to(ROOT).as_posix() for f in files} == {
        "sim_kinematic/sensing/table.py",
    }


def test_the_documentation_describes_every_sensor_of_environments() -> None:
    text = (ROOT / "docs" / "environments.md").read_text().split("### Numbers")[1].split("### Noise")[0]
    rows = [line.split("|") for line in text.splitlines() if line.startswith("| `")]
    described: dict[str, str] = {}
    for names, shapes in ((re.findall(r"`(\w+)`", row[1]), re.findall(r"\[([^]]+)\]", row[2])) for row in rows):
        described |= dict(zip(names, shapes if len(shapes) == len(names) > 1 else shapes[:1] * len(names), strict=True))
    # the last two are of tasks with doors or drawers to open
    assert set(described) == {*table.SENSORS, *table.SENSES, "part_gps_compass", "part_is_open"}
    for name, shape in described.items():
        sensor = table.TABLE[name]
        if sensor.times == "objects":
            assert shape == ("K" if sensor.width == 1 else f"{sensor.width} K"), name
        elif sensor.times == "once":
            assert shape == str(sensor.width), name
