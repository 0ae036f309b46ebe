"""Walking with planted feet along any track of the root."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.motion import figures_of, motion_of
from h3data.bodies import JOINT_INDEX, Humanoid, humanoid_names, load_humanoid
from h3data.bodies.people.kernels.planted import AIR, FOOT, FOOT_COLUMNS, IDLE, LOOK
from h3data.bodies.people.planted_gait import on_floor, planted_states, pose_planted
from h3data.bodies.people.soles import LEG_JOINTS, sole_points
from h3data.geometry import Array, ground_pose, pose_to_matrix
from h3data.scene.floor_heights import LEVEL
from tests.random_cases import examples

STEPS = 45
"""Of each part of a random track."""
BODIES = ("male_1", "female_3", "neutral_0")


def track(speed: Array, turn: Array) -> Array:
    """Roots [T, 7] of somebody with speeds [m/s] and turning rates [rad/s], [T] each."""
    heading = np.cumsum(turn) / 30
    xz = np.cumsum(np.stack([speed * np.cos(heading), -speed * np.sin(heading)], -1), axis=0) / 30
    return ground_pose(xz, heading)


def limited(wanted: Array, most: float) -> Array:
    """A signal [T] that follows ``wanted`` [T] and changes by no more than ``most`` a step."""
    out, value = np.empty(len(wanted)), 0.0
    for k, aim in enumerate(wanted):
        value += min(max(aim - value, -most), most)
        out[k] = value
    return out


def walked(name: str, base: Array) -> tuple[Array, Array]:
    """States and joints."""
    body = load_humanoid(name)
    states = planted_states(body.gait_tables, base)
    return states, body.joint_matrices(base, *pose_planted(body.gait_tables, states))


def in_air(states: Array) -> Array:
    """Whether each foot swings, [T, 2]."""
    return states[:, [FOOT + AIR, FOOT + FOOT_COLUMNS + AIR]] > 0


parts = st.lists(
    st.tuples(st.sampled_from([0.0, 0.2, 0.6, 1.0, 1.3, 1.8, 2.5]), st.sampled_from([0.0, 0.0, -0.8, 1.0])),
    min_size=1,
    max_size=4,
)


def profile(wanted: list[tuple[float, float]]) -> tuple[Array, Array]:
    """Speeds and turning rates [T] of a person who speeds up by 2 m/s^2 and stops by 2.5; at last they stand."""
    table = np.repeat(np.array([(0.0, 0.0), *wanted, (0.0, 0.0), (0.0, 0.0)]), STEPS, axis=0)
    return limited(table[:, 0], 2.0 / 30), limited(table[:, 1], 4.0 / 30)


@settings(max_examples=examples(25), deadline=None)
@given(wanted=parts, name=st.sampled_from(BODIES))
def test_laws_of_any_profile_of_speeds(wanted: list[tuple[float, float]], name: str) -> None:
    body = load_humanoid(name)
    base = track(*profile(wanted))
    states, joints = walked(name, base)
    soles = sole_points(body, joints[:, LEG_JOINTS])
    pivot = np.argmin(soles[1:, ..., 1] + soles[:-1, ..., 1], axis=-1)[..., None]
    slide = np.take_along_axis(np.linalg.norm(np.diff(soles[..., ::2], axis=0), axis=-1), pivot, axis=-1)[..., 0]
    planted = ~in_air(states)
    rests = slide[planted[1:] & planted[:-1]]
    assert rests.max() < 4e-3, "where the sole goes over from heel to ball"
    assert rests.mean() < 1e-4
    assert soles[..., 1].min() > -0.004
    assert np.abs(soles[planted][..., 1].min(-1)).max() < 0.004
    figures = figures_of(motion_of(body, base, joints))
    assert figures["mid_air_stops"] == 0
    local = joints[:, 1:22, :3, 3] - joints[:, :1, :3, 3]
    turns = np.abs(np.diff(base[:, 4])).max() if len(base) else 0.0
    assert np.linalg.norm(np.diff(local, n=2, axis=0), axis=-1).max() < 0.24 + turns
    assert planted[-1].all(), "they stand at the end"
    assert states[-1, IDLE] > 0


@pytest.mark.parametrize("speed", [0.2, 0.5, 0.9, 1.3, 1.7, 2.1, 2.5])
def test_start_and_stop_are_planted_at_every_speed_even_at_once(speed: float) -> None:
    moves = np.concatenate([np.zeros(10), np.full(75, speed), np.zeros(45)])
    base = track(moves, 0 * moves)
    states, joints = walked("male_1", base)
    assert not (in_air(states).all(1) & (moves == 0)).any()
    assert motion_of(load_humanoid("male_1"), base, joints)["mid_air"].sum() == 0
    assert (~in_air(states[-15:])).all()


def test_a_steady_walk_is_the_gait_itself() -> None:
    body = load_humanoid("male_1")
    moves = limited(np.full(240, 1.3), 1.5 / 30)
    states, joints = walked("male_1", track(moves, 0 * moves))
    clip = body.clip_for_speed(1.3)
    quats, pelvis = body.clip_pose(np.full(60, clip), states[-60:, 0])
    steady = body.joint_matrices(track(moves, 0 * moves)[-60:], quats, pelvis)
    assert np.abs(steady[:, :22, :3, 3] - joints[-60:, :22, :3, 3]).max() < 0.06


def test_whoever_turns_on_the_spot_steps_round() -> None:
    turning = np.concatenate([np.zeros(5), np.full(40, 1.6), np.zeros(30)])
    base = track(0 * turning, turning)
    states, joints = walked("female_0", base)
    found = figures_of(motion_of(load_humanoid("female_0"), base, joints))
    assert found["foot_slide_mm"] < 0.1
    assert found["pops_per_minute"] == 0
    lifts = np.diff(in_air(states).astype(int), axis=0) > 0
    assert lifts.sum() >= 3
    assert not in_air(states).all(1).any()


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("speed", [0.0, 0.4, 0.6, 0.9])
def test_feet_and_face_turn_no_faster_than_people_s_on_tight_curves(name: str, speed: float) -> None:
    turning = np.concatenate([np.zeros(20), np.full(70, 1.8), np.zeros(10), np.full(70, -2.4), np.zeros(30)])
    moves = limited(np.where(turning == 0, 0.0, speed), 1.1 / 30)
    base = track(moves, turning)
    states, joints = walked(name, base)
    local = np.linalg.inv(pose_to_matrix(base))[:, None] @ joints
    steps = np.linalg.norm(np.diff(local[:, 1:22, :3, 3] - local[:, :1, :3, 3], axis=0), axis=-1)
    assert steps.max() < 0.125  # toes moved 15 cm in a step
    face = np.einsum("tji,tj->ti", joints[:, JOINT_INDEX["spine3"], :3, :3], joints[:, JOINT_INDEX["head"], :3, 2])
    turned = np.degrees(np.arccos(np.clip(np.sum(face[1:] * face[:-1], axis=1), -1, 1)))
    assert turned.max() < 4.5  # 16 where a turn began or ended
    assert np.ptp(np.degrees(states[:, LOOK])) > 40, "they still look where they turn"


def test_steps_of_whole_nanoseconds_are_thirtieths_of_a_second() -> None:
    body = load_humanoid("male_1")
    moves = limited(np.repeat([0.0, 1.3, 0.4, 1.1, 0.0], 60), 1.1 / 30)
    base = track(moves, 0.5 * moves)
    time_s = np.round(np.arange(len(base)) * 1e9 / 30) * 1e-9
    for times in (time_s, np.arange(len(base)) * 33_333_333 * 1e-9):
        states = planted_states(body.gait_tables, base, times)
        np.testing.assert_array_equal(states, planted_states(body.gait_tables, base))


def test_any_moment_is_posed_alone_and_does_not_depend_on_later_ones() -> None:
    body = load_humanoid("male_2")
    moves = limited(np.repeat([0.0, 1.3, 0.4, 2.2, 0.0], 40), 1.5 / 30)
    base = track(moves, 0.3 * moves)
    states = planted_states(body.gait_tables, base)
    quats, pelvis = pose_planted(body.gait_tables, states)
    assert np.array_equal(planted_states(body.gait_tables, base[:120]), states[:120])
    alone = pose_planted(body.gait_tables, states[77:78])
    assert np.array_equal(alone[0][0], quats[77])
    assert np.array_equal(alone[1][0], pelvis[77])


def test_people_who_stand_breathe_and_those_who_are_put_elsewhere_stand_there() -> None:
    base = track(np.zeros(300), np.zeros(300))
    _, joints = walked("male_1", base)
    chest = joints[:, 9, :3, 3]
    assert 0.003 < np.ptp(chest, axis=0).max() < 0.04
    base = track(np.full(60, 1.3), np.zeros(60))
    base[30:, 0] += 4
    base[40:50, :] = np.nan
    states, joints = walked("male_1", base)
    assert not in_air(states)[[30, 50]].any()
    assert np.isfinite(joints[50:]).all()


def test_feet_keep_out_of_what_stands_in_front() -> None:
    """A person runs at a wall and stops 25 cm in front of it, then walks along it: no toe and no heel gets into it."""
    body, wall = load_humanoid("male_1"), 3.0
    xs = np.arange(200) * 0.05
    room = np.repeat((wall - xs)[:, None], 200, axis=1)
    free = SimpleNamespace(sdf=room, origin=np.array([-0.025, -5.0]), cell_m=0.05, heights=LEVEL)
    run = np.minimum(np.arange(60) * 2.5 / 30, wall - 0.25)
    turn = np.minimum(np.arange(20) * 2.5 / 30, np.pi / 2)
    along = np.arange(40) * 2.5 / 30
    base = np.concatenate(
        [
            ground_pose(np.stack([run, 0 * run], -1), 0 * run),
            ground_pose(np.tile([wall - 0.25, 0.0], (20, 1)), turn),
            ground_pose(np.stack([0 * along + wall - 0.25, -along], -1), np.full(40, np.pi / 2)),
        ]
    )
    deepest = []
    for tables in (body.gait_tables, on_floor(body.gait_tables, free)):  # type: ignore[arg-type]
        states = planted_states(tables, base)
        quats, pelvis = pose_planted(tables, states)
        deepest.append(sole_points(body, _in_world(body, base, quats, pelvis))[..., 0].max() - wall)
    assert deepest[1] < 0.0 < deepest[0]


@pytest.mark.parametrize("name", humanoid_names())
def test_drawn_legs_keep_out_of_a_counter_beside_a_turn(name: str) -> None:
    """Somebody turns away from a counter 25 cm before them and walks along it; recorded joints stay as they are."""
    body, wall = load_humanoid(name), 3.0
    room = np.repeat((wall - np.arange(100) * 0.05)[:, None], 200, axis=1)
    free = SimpleNamespace(sdf=room, origin=np.array([-0.025, -5.0]), cell_m=0.05, heights=LEVEL)
    recorded = on_floor(body.gait_tables, free)  # type: ignore[arg-type]
    legs = [capsule for capsule in body.capsules if capsule.name.endswith(("thigh", "shank", "foot"))]
    deepest = []
    for tables in (recorded, recorded._replace(clear=1.0)):
        depth = 0.0
        for side in (1, -1):
            for turn in (0.9, 1.3, 1.8):
                states = planted_states(tables, base := turning_away(wall - 0.25, side * turn))
                joints = body.joint_matrices(base, *pose_planted(tables, states))
                for capsule in legs:
                    for end in (capsule.start, capsule.end):
                        x = joints[:, capsule.joint, 0, :3] @ end + joints[:, capsule.joint, 0, 3]
                        depth = max(depth, float(x.max()) + min(capsule.radius, THICK_M) - wall)
        deepest.append(depth)
    assert deepest[1] <= 0.02 < deepest[0]


THICK_M = 0.1
"""Radius of the capsules of legs; those of two bodies are thicker, because of their clothes."""


def turning_away(nearest: float, turn: float) -> Array:
    """Roots [T, 7] of somebody who faces +x at ``nearest`` [m], and walks off at a turning rate [rad/s], never nearer."""
    x, z, roots = nearest, 0.0, []
    for k in range(90):
        heading = float(np.clip(turn * max(k - 10, 0) / 30, -1.7, 1.7))
        speed = min(max(k - 10, 0) * 0.04, 0.8)
        x, z = min(x + speed * np.cos(heading) / 30, nearest), z - speed * np.sin(heading) / 30
        roots.append((x, z, heading))
    track = np.array(roots)
    return ground_pose(track[:, :2], track[:, 2])


def _in_world(body: Humanoid, base: Array, quats: Array, pelvis: Array) -> Array:
    """As `leg_frames`, in the world."""
    joints = body.joint_matrices(base, quats, pelvis)
    return joints[:, LEG_JOINTS]


@settings(deadline=None)
@given(
    st.sampled_from(BODIES),
    st.lists(
        st.tuples(st.sampled_from([0.0, 0.25, 0.6, 1.2]), st.sampled_from([0.0, 1.8, -1.8]), st.floats(-3.1, 3.1)),
        min_size=2,
        max_size=8,
    ),
)
def test_drawn_legs_pop_nowhere(name: str, wanted: list[tuple[float, float, float]]):
    """People of crowds turn quickly, and up to 0.25 m/s they step in any direction at once."""
    body = load_humanoid(name)
    speed, turn, aside = (np.repeat(part, 25) for part in np.array(wanted).T)
    # they set off and brake by at most 2.2 m/s^2, and turn by at most 7 rad/s^2
    speed, turn = limited(speed, 2.2 / 30), limited(turn, 7 / 30)
    heading = np.cumsum(turn) / 30
    # faster people walk a little sideways at most
    way = heading + np.where(speed > 0.3, np.clip(aside, -0.35, 0.35), aside)
    base = ground_pose(np.cumsum(np.stack([speed * np.cos(way), -speed * np.sin(way)], -1), axis=0) / 30, heading)
    # a wide floor without obstacles
    floor = {"sdf": np.full((4, 4), 50.0), "origin": np.full(2, -200.0), "cell_m": 100.0, "clear": 1.0}
    tables = body.gait_tables._replace(**floor)
    joints = body.joint_matrices(base, *pose_planted(tables, planted_states(tables, base)))
    assert not motion_of(body, base, joints)["pops"].any()
