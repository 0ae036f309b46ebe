"""People who walk curves: as fast and as sharply as `StrideSpec` allows, never in walls, always to the end of their path."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

import h3data
from h3data.errors import InputError
from h3data.geometry import Array, heading_from_quat, wrap_angle
from h3data.metrics.paper.protocol import SOCIAL_NAV_PROTOCOL, protocol_deviations
from h3data.recording import Recording
from h3data.scene import FreeSpace
from h3data.scene.freespace.build import build_from_walkable
from sim_kinematic.agents.waypoint_walker import WAYPOINTS, WaypointHuman, aside, walking_path
from sim_kinematic.motion.gait import move_people
from sim_kinematic.motion.spec import HOME_WALKER, NATURAL_WALKER, STEP_S, StrideSpec, WalkerSpec
from sim_kinematic.motion.state import HumanState
from sim_kinematic.motion.stride import SHOULDER_M, Strider, stride_step
from sim_kinematic.tasks.resume import verify
from tests.random_cases import examples

RADIUS_M = 0.25
STRIDE = NATURAL_WALKER.stride
assert STRIDE is not None
EDGE_MM = 2
"""The body may come this much nearer to walls than its radius."""


@lru_cache(maxsize=4)
def floor(home: str) -> FreeSpace:
    return FreeSpace.from_scene(h3data.open(home), radius_m=RADIUS_M, height_m=1.41)


def walked(home: str, seed: int, steps: int = 900, spec: WalkerSpec = NATURAL_WALKER) -> tuple[WaypointHuman, Array]:
    """A script's person, and where they are after each step (x, z, heading)."""
    free = floor(home)
    rng = np.random.default_rng(seed)
    human, track = WaypointHuman(free, seed, spec), np.empty((steps + 1, 3))
    track[0] = *free.sample(rng, 1)[0], rng.uniform(-np.pi, np.pi)
    for k in range(steps):
        track[k + 1] = human.stride(track[k, :2], float(track[k, 2]))
    return human, track


def stepped(strider: Strider, xz: Array, heading: float, *, goes: bool = True) -> tuple[Array, float]:
    """Where a person is after a step from a place [2] and heading."""
    gait = HumanState.zeros(1)
    gait.xz[0], gait.heading[0] = xz, heading
    strider.walk(gait, goes=goes)
    return gait.xz[0], gait.heading.item(0)


@given(st.integers(0, 10_000))
def test_a_gait_goes_on_with_the_step_to_the_bit(seed: int) -> None:
    """The kernel of both is `stride_step`, then `move_people`."""
    free, rng = floor("small:1"), np.random.default_rng(seed)
    start, goal = free.sample(rng, 2)
    fast, slow = (Strider(free, NATURAL_WALKER, halts=True) for _ in range(2))
    for strider in (fast, slow):
        strider.begin(walking_path(free, start, goal, NATURAL_WALKER), facing=0.5)
    gait = HumanState.zeros(1)
    gait.xz[0], gait.heading[0] = start, rng.uniform(-9, 9)
    expected = gait.copy()
    for k in range(120):
        was, goes = expected.copy(), not 40 <= k < 60
        slow._state[:3] = *expected.xz[0], expected.heading[0]
        told = goes, True, 0.5, slow._state, *slow._rules
        slow.arrived = stride_step(*slow._grid, slow._path, slow._cumulative, *told)
        move_people(expected, slow._state[None, :2], slow._state[2:3], NATURAL_WALKER)
        before = fast.walk(gait, goes=goes)
        assert fast.arrived == slow.arrived
        assert before.tolist() == [*was.xz[0], was.heading[0], was.distance[0], was.set_off[0], was.blend[0]]
        for mine, theirs in zip(gait.arrays(), expected.arrays(), strict=True):
            assert mine.tobytes() == theirs.tobytes()


@given(st.integers(0, 10_000), st.sampled_from(["small:1", "medium:0"]), st.sampled_from([0.5, 0.9, 1.3, 2.0]))
def test_nobody_is_faster_sharper_or_nearer_to_walls_than_allowed(seed: int, home: str, speed: float) -> None:
    human, track = walked(home, seed, spec=replace(NATURAL_WALKER, speed_mps=speed))
    moved = np.hypot(*np.diff(track[:, :2], axis=0).T) / STEP_S
    turn = np.diff(track[:, 2]) / STEP_S
    assert moved.max() <= speed + 1e-6
    assert np.abs(turn).max() <= STRIDE.turn_rad_s + 1e-6
    assert np.abs(np.diff(turn)).max() <= STRIDE.turn_accel_rad_s2 * STEP_S + 1e-6
    room = floor(home).signed_distance(track[:, :2])
    assert room.min() >= RADIUS_M - EDGE_MM / 1000
    beside = RADIUS_M + SHOULDER_M + 0.01
    free = (room[1:-1] > beside) & (room[2:] > beside)  # walls may stop them at once
    change = np.diff(moved)[free] / STEP_S
    assert change.max(initial=0) <= STRIDE.accel_mps2 + 1e-6
    assert -change.min(initial=0) <= STRIDE.decel_mps2 + 1e-6
    assert human.goal >= 1 or moved.mean() > speed / 2


@given(st.integers(0, 10_000))
def test_hardly_anybody_turns_on_the_spot(seed: int) -> None:
    _, track = walked("small:1", seed, 1500)
    rests = np.hypot(*np.diff(track[:, :2], axis=0).T) < 1e-3
    assert (rests & (np.abs(np.diff(track[:, 2])) > 1e-3)).mean() < 0.08


@settings(max_examples=examples(6))
@given(st.integers(0, 10_000))
def test_who_faces_a_wall_turns_away_before_they_walk(seed: int) -> None:
    free, rng = floor("small:1"), np.random.default_rng(seed)
    places = free.sample(rng, 400)
    start = places[np.argmin(np.abs(free.signed_distance(places) - 0.33))]
    out = free.gradient(start) / np.hypot(*free.gradient(start))
    goals = free.sample(rng, 200)
    firsts = [walking_path(free, start, goal, NATURAL_WALKER) for goal in goals[np.hypot(*(goals - start).T) > 1.5]]
    paths = [path for path in firsts if len(path) > 1 and (path[1] - start) @ out > 0.8 * np.hypot(*(path[1] - start))]
    if not paths:
        return
    strider, xz, heading = Strider(free, NATURAL_WALKER), start, float(np.arctan2(out[1], -out[0]))
    strider.begin(paths[0])
    walked_at_wall = 0.0
    for _ in range(60):
        before, faces = xz, -np.array([np.cos(heading), -np.sin(heading)]) @ out
        xz, heading = stepped(strider, xz, heading)
        walked_at_wall += float(np.hypot(*(xz - before))) * (faces > 0.8)
    assert walked_at_wall < 0.03
    assert np.hypot(*(xz - start)) > 0.15


def room(*parts: shapely.Polygon) -> FreeSpace:
    """The free floor of rooms that are one."""
    sizes = {"floor_y": 0.0, "radius_m": RADIUS_M, "height_m": 1.4, "max_climb_m": 0.2, "cell_m": 0.05}
    return FreeSpace.from_map(build_from_walkable(shapely.MultiPolygon([shapely.union_all(parts)]), **sizes))  # type: ignore[arg-type,list-item]


@pytest.mark.parametrize("lateral", [-0.03, 0.0, 0.03])
@pytest.mark.parametrize("heading", [0.0, 0.2, 2.0])
def test_who_turns_back_in_a_narrow_place_stays_in_its_middle(lateral: float, heading: float) -> None:
    """Creeping round a U-turn they got 7 cm nearer to the wall, elbows first: 5 cm inside it with the broadest body."""
    free = room(shapely.box(0.0, 0.0, 6.0, 0.64))
    strider, xz = Strider(free, NATURAL_WALKER, halts=True), np.array([3.0, 0.32 + lateral])
    strider.begin(np.array([xz, [0.6, 0.32]]))
    before, least = float(free.signed_distance(xz)), np.inf
    for _ in range(600):
        xz, heading = stepped(strider, xz, heading)
        if abs(wrap_angle(heading - np.pi)) > 0.6:
            least = min(least, float(free.signed_distance(xz)))
        if strider.arrived:
            break
    assert strider.arrived
    assert least >= before - 0.02


@pytest.mark.parametrize("facing", [-1.5, -0.7, 0.0, 0.7, 1.5, 3.0])
def test_who_is_told_where_to_face_arrives_facing_it(facing: float) -> None:
    """They turned on the spot after they had arrived."""
    free = room(shapely.box(0.0, 0.0, 6.0, 6.0))
    off = []
    for told in (None, facing):
        strider, xz, heading = Strider(free, NATURAL_WALKER, halts=True), np.array([1.0, 3.0]), 0.0
        strider.begin(np.array([xz, [4.0, 3.0]]), facing=told)
        for steps in range(200):  # noqa: B007
            xz, heading = stepped(strider, xz, heading)
            if strider.arrived:
                break
        assert strider.arrived
        off.append((abs(float(wrap_angle(heading - facing))), steps))
    assert off[1][0] <= max(abs(facing) - 1.1, 0.1)
    assert off[1][1] <= off[0][1] + 8
    np.testing.assert_allclose(xz, [4.0, 3.0], atol=1e-9)


def test_who_cuts_a_corner_keeps_their_shoulders_out_of_it() -> None:
    """They slid around door posts at the radius of the floor, 0.25 m; the broadest body is 0.27 m wide to each side."""
    free = room(shapely.box(0.0, 0.0, 6.0, 1.0), shapely.box(5.0, 0.0, 6.0, 6.0))
    for corner in ([5.2, 0.75], [5.3, 0.7], [5.25, 0.72]):
        strider, xz, heading = Strider(free, NATURAL_WALKER, halts=True), np.array([2.0, 0.6]), 0.0
        strider.begin(np.array([xz, corner, [5.5, 5.0]]))
        least = np.inf
        while not strider.arrived:
            xz, heading = stepped(strider, xz, heading)
            least = min(least, float(free.signed_distance(xz)))
        assert least >= RADIUS_M + 0.8 * SHOULDER_M


@given(st.integers(0, 10_000), st.floats(-3.1, 3.1))
def test_who_halts_stands_on_the_end_of_the_path(seed: int, heading: float) -> None:
    free = floor("small:1")
    start, goal = free.sample(np.random.default_rng(seed), 2)
    path = walking_path(free, start, goal, NATURAL_WALKER)
    if not np.isfinite(free.geodesic(start, goal)):
        return
    strider = Strider(free, NATURAL_WALKER, halts=True)
    strider.begin(path)
    xz, turned, last = start, heading, 0.0
    for _ in range(3000):
        before = xz
        xz, turned = stepped(strider, xz, turned)
        last = float(np.hypot(*(xz - before))) / STEP_S
        if strider.arrived:
            break
    assert strider.arrived
    np.testing.assert_array_equal(xz, path[-1])
    assert last < 0.4  # they have braked


@given(st.integers(0, 10_000))
def test_the_way_ahead_is_the_one_walked_step_by_step(seed: int) -> None:
    free = floor("small:1")
    start, goal = free.sample(np.random.default_rng(seed), 2)
    path = walking_path(free, start, goal, NATURAL_WALKER)
    ahead, now = (Strider(free, NATURAL_WALKER) for _ in range(2))
    ahead.begin(path)
    now.begin(path)
    track = ahead.whole(start, 0.3, most=400)
    xz, heading = start, 0.3
    for row in track:
        xz, heading = stepped(now, xz, heading)
        np.testing.assert_array_equal([*xz, heading], row)


def test_points_are_moved_aside_to_the_bits_of_the_formula() -> None:
    free = floor("small:0")
    for point in free.sample(np.random.default_rng(3), 60):
        for clearance in (0.3, 0.5):
            here, room = point, float(free.signed_distance(point))
            while room < clearance:
                away = free.gradient(here)
                length = float(np.hypot(*away))
                if length < 1e-6:
                    break
                there = here + away / length * min(WAYPOINTS.aside_step_m, clearance - room)
                wider = float(free.signed_distance(there))
                if wider < room + 1e-3:
                    break
                here, room = there, wider
            assert aside(free, point, clearance).tobytes() == here.tobytes()


def test_who_waits_brakes_and_goes_on() -> None:
    free = floor("medium:0")
    start, goal = max(
        (free.sample(np.random.default_rng(k), 2) for k in range(20)), key=lambda ab: np.hypot(*(ab[1] - ab[0]))
    )
    strider = Strider(free, NATURAL_WALKER)
    strider.begin(walking_path(free, start, goal, NATURAL_WALKER))
    xz, heading, speeds = start, 0.0, []
    for k in range(400):
        before = xz
        xz, heading = stepped(strider, xz, heading, goes=not 60 <= k < 120)
        speeds.append(float(np.hypot(*(xz - before))) / STEP_S)
    brakes = int(np.ceil(speeds[59] / STRIDE.decel_mps2 / STEP_S)) + 1
    assert max(speeds[60 + brakes : 120]) == 0
    assert max(speeds[120:]) > 0.5


@pytest.mark.parametrize(
    "path", [[[3, 3]], [[3, 3], [3, 3]], [[3, 3], [3, 3], [3, 3]], [[3, 3], [3.4, 3], [3, 3], [3.4, 3]]], ids=str
)
def test_paths_without_length_and_back_and_forth_end(path: list[list[float]]) -> None:
    free = floor("small:1")
    points = free.sample(np.random.default_rng(0), 50)
    at = points[np.argmax(free.signed_distance(points))]
    moved = np.array(path) - path[0] + at
    strider = Strider(free, NATURAL_WALKER, halts=True)
    strider.begin(moved)
    xz, heading = at, 0.0
    for _ in range(2000):
        xz, heading = stepped(strider, xz, heading)
        if strider.arrived:
            break
    assert np.isfinite([*xz, heading]).all()
    assert strider.arrived


def test_a_walker_who_turns_on_the_spot_has_no_strides() -> None:
    with pytest.raises(InputError, match="H3-SIM-038"):
        Strider(floor("small:1"), HOME_WALKER)


def test_names_of_walkers_that_turn_on_the_spot_stay() -> None:
    """uids of episodes are made of the rules' text."""
    assert "stride" not in repr(HOME_WALKER)
    assert "stride" in repr(NATURAL_WALKER)
    assert repr(replace(NATURAL_WALKER, stride=StrideSpec(accel_mps2=2.0))) != repr(NATURAL_WALKER)


# --- in episodes --------------------------------------------------------------------------------------------------------
def person_of(recording: Recording) -> tuple[Array, Array]:
    """Speed [T - 1] [m/s] and turn rate [T - 1] [rad/s] of the person."""
    number = next(k for k, agent in enumerate(recording.agents) if agent.kind == "human")
    base = recording.columns[f"agent_{number}.base_pose"].astype(np.float64)
    turned = wrap_angle(np.diff(heading_from_quat(base[:, 3:])))
    return np.hypot(*np.diff(base[:, [0, 2]], axis=0).T) / STEP_S, turned / STEP_S


@pytest.mark.parametrize(
    "task",
    ["social_nav", *(pytest.param(task, marks=pytest.mark.slow) for task in ("rearrange", "wander"))],
)
def test_episodes_with_strides_verify(task: str) -> None:
    recording = h3data.simulate(task, "small:1", seed=2, rules="natural", max_steps=900)
    speed, turn = person_of(recording)
    assert speed.max() <= 1.3 + 1e-4
    assert (speed > 1.0).any()
    most = {"social_nav": 0.05, "wander": 0.08, "rearrange": 0.15}[
        task
    ]  # not every turn in a small home has room for a curve
    assert ((speed < 0.03) & (np.abs(turn) > 0.03)).mean() < most
    assert verify(recording).equal


def test_the_speed_of_strides_can_be_chosen_and_metrics_say_that_they_are_not_the_papers() -> None:
    recording = h3data.simulate("social_nav", "small:1", rules="natural", human_speed=0.8, max_steps=300)
    told = protocol_deviations(recording, SOCIAL_NAV_PROTOCOL)
    assert "human.speed_mps 0.8 (paper 2.5)" in told
    assert "people walk curves" in told
    assert 0.75 < person_of(recording)[0].max() <= 0.8 + 1e-4


def test_worlds_side_by_side_walk_as_each_alone() -> None:
    spec = replace(_rules(), max_steps=80)
    alone = h3data.make("social_nav", "small:1", spec=spec, observations=["humanoid_gps"])
    many = h3data.make("social_nav", "small:1", spec=spec, num_envs=3, observations=["humanoid_gps"])
    one, _ = alone.reset(seed=4)
    all_, _ = many.reset(seed=4)
    for _ in range(60):
        np.testing.assert_array_equal(one["humanoid_gps"], all_["humanoid_gps"][0])
        one = alone.step(np.array([0.3, 0.1], np.float32))[0]
        all_ = many.step(np.tile(np.float32([0.3, 0.1]), (3, 1)))[0]


def _rules():
    from sim_kinematic.tasks.social_nav import TRAINING

    return replace(TRAINING, human=NATURAL_WALKER)


def test_an_unknown_walk_is_refused() -> None:
    with pytest.raises(InputError, match="H3-TASK-001"):
        h3data.simulate("social_nav", "small:1", rules="moon", max_steps=3)
