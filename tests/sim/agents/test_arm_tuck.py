"""People keep their arms out of walls: drawn in where there is little room, smoothly, recorded, and the same when replayed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.bodies import JOINT_INDEX, load_humanoid
from h3data.bodies.people.arms import draw_in
from h3data.bodies.people.reach import Hand
from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE, ground_pose
from h3data.replay import Replay
from h3data.scene import FreeSpace, Scene
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.validation.penetration import penetrations
from sim_kinematic.agents.arm_tuck import HANDS, arm_room, draw_arms, draw_in_planted, width_m
from sim_kinematic.agents.person import Held, Person, joint_steps, run
from sim_kinematic.agents.waypoint_walker import aside, sharp_corners, with_room
from sim_kinematic.motion.spec import HOME_WALKER, STEP_S, ArmRoomSpec, SocialNavSpec, WalkerSpec
from sim_kinematic.motion.state import HumanState
from sim_kinematic.tasks.resume import resume, verify
from sim_kinematic.tasks.social_nav import SocialNav
from tests.simulated import simulate_social_nav, simulate_wander, social_nav_episode

RULES = ArmRoomSpec()
SHOULDERS = [JOINT_INDEX["left_shoulder"], JOINT_INDEX["right_shoulder"]]
COLLARS = [JOINT_INDEX["left_collar"], JOINT_INDEX["right_collar"]]


@pytest.fixture(scope="module")
def home() -> Scene:
    return build_home(HomeSpec(preset="small", seed=30000, clutter=1.5))


@pytest.fixture(scope="module")
def free(home: Scene) -> FreeSpace:
    return FreeSpace.from_scene(home)


# --- the posture --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["female_0", "male_1"])
def test_arms_in_are_narrower_and_leave_the_rest_alone(name: str) -> None:
    body = load_humanoid(name)
    clips = np.repeat(np.arange(len(body.clips)), 16)
    phase = np.tile(np.arange(16) / 16, len(body.clips))
    out, inside = (body.clip_pose(clips, phase, arms=np.full((len(clips), 2), share)) for share in (0.0, 1.0))
    np.testing.assert_array_equal(out[0], body.clip_pose(clips, phase)[0])
    others = np.setdiff1d(np.arange(55), SHOULDERS)
    np.testing.assert_array_equal(inside[0][:, others], out[0][:, others])
    np.testing.assert_array_equal(inside[1], out[1])
    wide, narrow = (_half_width(body, *pose) for pose in (out, inside))
    assert (narrow < wide).all()
    assert (wide - narrow).max() > 0.03
    assert narrow.max() < width_m(body) + 0.02  # what the rules take for the width of a body


def _half_width(body, quats, pelvis) -> np.ndarray:
    joints = body.joint_matrices(np.tile(IDENTITY_POSE, (len(quats), 1)), quats, pelvis)
    start, end, radius = body.capsules_world(joints)
    return (np.abs(np.stack([start, end])[..., 2]).max(0) + radius).max(1)


@given(st.floats(-0.5, 1.5), st.floats(-0.5, 1.5))
def test_each_arm_is_drawn_in_by_itself(left: float, right: float) -> None:
    body = load_humanoid("female_0")
    at = np.array([5]), np.array([0.3])
    both, alone = body.clip_pose(*at, arms=[left, right])[0], body.clip_pose(*at, arms=[left, 0.0])[0]
    np.testing.assert_array_equal(both[:, SHOULDERS[0]], alone[:, SHOULDERS[0]])
    np.testing.assert_array_equal(alone[:, SHOULDERS[1]], body.clip_pose(*at)[0][:, SHOULDERS[1]])
    np.testing.assert_allclose(np.linalg.norm(both, axis=-1), 1, atol=1e-12)


def test_two_numbers_are_wanted() -> None:
    for arms in (np.zeros(3), np.zeros((2, 2)), np.array([np.nan, 0.0])):
        with pytest.raises(InputError, match="H3-BODY-067"):
            load_humanoid("female_0").clip_pose([0], [0.0], arms=arms)


# --- the room -----------------------------------------------------------------------------------------------------------
@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_arms_go_by_small_steps_and_stay_in_range(home: Scene, free: FreeSpace, seed: int) -> None:
    body, rng = load_humanoid("male_1"), np.random.default_rng(seed)
    person = HumanState.zeros(8)
    for _ in range(20):
        person.xz[:], person.heading[:] = free.sample(rng, 8), rng.uniform(-4, 4, 8)
        before = person.arms.copy()
        draw_arms(person, free, body, RULES)
        assert np.abs(person.arms - before).max() <= RULES.rate + 1e-12
        assert ((person.arms >= 0) & (person.arms <= 1)).all()
    worlds = [person.take([w]) for w in range(8)]
    draw_arms(person, free, body, RULES)
    for w, one in enumerate(worlds):
        draw_arms(one, free, body, RULES)
        np.testing.assert_array_equal(one.arms, person.arms[w : w + 1])


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([None, "left", "right"]))
def test_arms_and_poses_in_one_call_have_the_bits_of_two(free: FreeSpace, seed: int, busy: Hand | None) -> None:
    body, rng = load_humanoid("male_1"), np.random.default_rng(seed)
    fast = HumanState.zeros(4)
    fast.xz[:], fast.heading[:], fast.arms[:] = free.sample(rng, 4), rng.uniform(-4, 4, 4), rng.random((4, 2))
    slow, (quats, _) = fast.copy(), body.clip_pose([1] * 4, rng.random(4), [1.0] * 4)
    expected = quats.copy()
    for _ in range(3):
        draw_arms(slow, free, body, RULES, busy=busy)
        draw_in(expected, slow.arms, shoulders_forward=True)
        moved, number = (fast.xz, fast.heading, fast.arms), -1 if busy is None else HANDS.index(busy)
        draw_in_planted(free.sdf, free.origin, free.cell_m, *moved, number, arm_room(body, RULES), quats)
    assert fast.arms.tobytes() == slow.arms.tobytes()
    assert quats.tobytes() == expected.tobytes()


def test_without_rules_arms_swing(free: FreeSpace) -> None:
    person = HumanState.zeros(1)
    draw_arms(person, free, load_humanoid("female_0"), None)
    assert not person.arms.any()


# --- the way ------------------------------------------------------------------------------------------------------------
@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_way_points_keep_away_and_the_way_stays_free(free: FreeSpace, seed: int) -> None:
    a, b = free.sample(np.random.default_rng(seed), 2)
    sharp = sharp_corners(free, free.path(a, b))
    roomy = with_room(free, sharp, 0.4)
    assert roomy.shape == sharp.shape
    np.testing.assert_array_equal(roomy[[0, -1]], sharp[[0, -1]])
    was, now = free.signed_distance(sharp[1:-1]), free.signed_distance(roomy[1:-1])
    assert (now >= was - 1e-9).all()
    legs = np.hypot(*np.diff(roomy, axis=0).T)
    np.testing.assert_allclose(free.geodesic(roomy[:-1], roomy[1:], max_snap_m=1e-3), legs, atol=1e-5)
    np.testing.assert_array_equal(with_room(free, sharp, 0.0), sharp)


def test_aside_has_the_room_asked_for_or_the_most_there_is(free: FreeSpace) -> None:
    points = free.sample(np.random.default_rng(3), 200)
    moved = np.array([aside(free, point, 0.4) for point in points])
    room, had = free.signed_distance(moved), free.signed_distance(points)
    assert (room >= had).all()
    assert np.hypot(*(moved - points).T).max() < 0.4
    assert (room >= 0.4 - 1e-3).mean() > 0.9
    np.testing.assert_array_equal(moved[had >= 0.4], points[had >= 0.4])


# --- whole episodes -----------------------------------------------------------------------------------------------------
def walked(home: Scene, free: FreeSpace, walker: WalkerSpec, steps: int = 500):
    spec = SocialNavSpec(max_steps=steps, human=walker, end_on_collision=False)
    world = social_nav_episode(home, seed=4, spec=spec, free=free, human="male_1")
    return world, simulate_social_nav(world, policy="stand_still")


@pytest.mark.slow
def test_people_of_our_episodes_keep_out_of_the_home(home: Scene, free: FreeSpace) -> None:
    natural, plain = (
        penetrations(walked(home, free, walker)[1])[1].depth_m.max(1) for walker in (HOME_WALKER, WalkerSpec())
    )
    assert (plain > 0.02).sum() > 20  # there is something to keep out of
    assert (natural > 0.02).sum() < 0.2 * (plain > 0.02).sum()


def test_joints_turn_no_faster_for_it(home: Scene, free: FreeSpace) -> None:
    _, recording = walked(home, free, HOME_WALKER)
    columns = {n: recording.columns[f"agent_1.motion_{n}"] for n in ("id", "phase", "blend", "arms")}
    assert columns["arms"].max() > 0.5
    body = load_humanoid("male_1")
    swinging, drawn = (
        body.clip_pose(columns["id"], columns["phase"], columns["blend"], arms=arms)[0]
        for arms in (None, columns["arms"])
    )
    faster = joint_steps(drawn) - joint_steps(swinging)
    assert faster.max() < 0.12 * np.radians(60)  # shoulders are drawn in by up to 60 degrees, by RULES.rate a step


def test_the_arms_are_recorded_and_come_out_again(home: Scene, free: FreeSpace) -> None:
    world, recording = walked(home, free, HOME_WALKER, steps=200)
    assert verify(recording).equal
    again = resume(recording, 77)
    for name, column in recording.columns.items():
        np.testing.assert_array_equal(again.columns[name], column)
    replay = Replay(recording)
    step = int(recording.columns["agent_1.motion_arms"].sum(1).argmax())
    without = Replay(replace(recording, columns={n: c for n, c in recording.columns.items() if "motion_arms" not in n}))
    hand = JOINT_INDEX["left_wrist"]
    there, swung = (r.joint_matrices(1, np.array([step]))[0, hand, :3, 3] for r in (replay, without))
    assert np.linalg.norm(there - swung) > 0.02
    codec = SocialNav().codec
    assert codec.rules(codec.record(world)) == world.spec


def test_recordings_from_before_are_simulated_as_they_were(home: Scene, free: FreeSpace) -> None:
    _, recording = walked(home, free, WalkerSpec(), steps=100)
    assert "agent_1.motion_arms" not in recording.columns
    spec = recording.episode.info["spec"]
    old = {**spec, "human": {n: v for n, v in spec["human"].items() if n not in ("clearance_m", "arms")}}
    info = {**recording.episode.info, "spec": old}
    assert verify(replace(recording, episode=replace(recording.episode, info=info))).equal


def test_wandering_people_draw_their_arms_in_too(home: Scene, free: FreeSpace) -> None:
    recording = simulate_wander(home, "human,male_1", seed=1, steps=150, free=free)
    assert recording.columns["agent_1.motion_arms"].max() > 0
    assert verify(recording).equal


def test_a_person_who_carries_draws_the_other_arm_in(free: FreeSpace) -> None:
    start = free.sample(np.random.default_rng(0), 400)
    start = start[np.argmin(free.signed_distance(start))]  # close to something
    body = load_humanoid("male_1")
    tight, loose = (
        Person(body, ground_pose(start, heading), spec=replace(HOME_WALKER, speed_mps=1.2), free=room)
        for heading in (0.0,)
        for room in (free, None)
    )
    frames, others = (run(person, person.turn(2.0))[0] for person in (tight, loose))
    drawn = np.array([f.joints for f in frames]) - np.array([f.joints for f in others])
    turned = np.abs(drawn).max((0, 2))
    assert turned[np.array(SHOULDERS) - 1].max() > 0.02
    assert np.delete(turned, np.array(SHOULDERS + COLLARS) - 1).max() == 0
    quick = joint_steps(np.array([f.joints for f in frames]))[:, np.array(SHOULDERS) - 1]
    assert quick.max() < 0.18 + STEP_S


def test_the_broadest_body_fits_between_walls_half_a_metre_apart() -> None:
    body = load_humanoid("male_1")
    person = Person(body, IDENTITY_POSE)
    quats = np.stack([person.quats, person.quats])
    draw_in(quats, np.array([[0.0, 0.0], [1.0, 1.0]]), shoulders_forward=True)
    wide, narrow = _half_width(body, quats, np.stack([person.pelvis, person.pelvis]))
    assert wide > 0.3
    assert narrow < 0.25


@pytest.mark.parametrize("hand", ["left", "right"])
def test_what_is_carried_is_held_close_where_there_is_little_room_ahead(free: FreeSpace, hand: Hand) -> None:
    """The person turns in front of a wall, object in hand: neither arm nor object gets into it."""
    room = free.signed_distance(free.sample(np.random.default_rng(0), 2000))
    place = free.sample(np.random.default_rng(0), 2000)[int(np.argmin(np.abs(room - 0.27)))]
    away = free.gradient(place)
    heading = float(np.arctan2(-away[1], away[0]))  # their back to the wall
    deepest = []
    for spec in (HOME_WALKER, WalkerSpec()):
        body = load_humanoid("female_0")
        person = Person(body, ground_pose(place, heading, free.floor_y), {"mug": np.eye(7)[6]}, spec=spec, free=free)
        person.held[hand] = Held("mug", IDENTITY_POSE.copy(), IDENTITY_POSE[3:].copy())
        frames, _ = run(person, person.turn(heading + 3.1))
        joints = body.joint_matrices_free(np.stack([f.root for f in frames]), np.stack([f.joints for f in frames]))
        start, end, radius = body.capsules_world(joints)
        arm = [k for k, c in enumerate(body.capsules) if c.name.startswith(hand) and c.name.endswith(("arm", "hand"))]
        room = np.minimum(*(free.signed_distance(points[:, arm][..., [0, 2]]) for points in (start, end))) - radius[arm]
        deepest.append(float(-room.min()))
        assert np.abs(joint_steps(np.stack([f.joints for f in frames]))).max() < 0.35
    assert deepest[0] < 0.02 < deepest[1]
