"""Skills: an object moves with the hand that holds it and stays put otherwise; lines are straight; feet do not slide."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from h3data.bodies import JOINT_INDEX, Humanoid, humanoid_names, load_humanoid
from h3data.bodies.people.reach import HANDS, Hand, hand_points, reacher
from h3data.errors import InputError
from h3data.geometry import (
    ground_pose,
    heading_from_quat,
    pose_inverse,
    pose_multiply,
    quat_conjugate,
    quat_from_matrix,
    quat_multiply,
    quat_rotate,
)
from h3data.scene import FreeSpace
from h3data_homes import HomeSpec, build_home
from sim_kinematic.agents import person as skills
from sim_kinematic.agents.person import Frame, Person, run
from sim_kinematic.motion.spec import NATURAL_WALKER, WalkerSpec
from sim_kinematic.motion.state import HumanState

BODIES = [name for name in humanoid_names() if not name.startswith("older")]
"""All who reach every one of `SPOTS`; who stoops does not."""
SPOTS = st.tuples(st.floats(0.32, 0.42), st.floats(0.05, 1.0), st.floats(-0.02, 0.25))
"""Forward, up and to the hand's side, in heights of the shoulder."""


def _at(person: Person, hand: Hand, spot: tuple[float, float, float]) -> np.ndarray:
    local = np.array(spot) * (1, 1, 1 if hand == "right" else -1) * reacher(person.body, hand).body.scale
    return person.base[:3] + quat_rotate(person.base[3:], local)


def _someone(name: str, hand: Hand, spot: tuple[float, float, float]) -> Person:
    person = Person(load_humanoid(name), ground_pose([1.0, -2.0], 0.7), {"far": [9.0, 1, 9, 0, 0, 0, 1]})
    person.objects["mug"] = np.concatenate([_at(person, hand, spot), ground_pose([0, 0], 2.0)[3:]])
    return person


def _joints(body: Humanoid, frames: list[Frame]) -> np.ndarray:
    return body.joint_matrices_free(np.stack([f.root for f in frames]), np.stack([f.joints for f in frames]))


def _palms(body: Humanoid, frames: list[Frame], hand: Hand) -> np.ndarray:
    joints = _joints(body, frames)
    turn = quat_from_matrix(joints[:, JOINT_INDEX[f"{hand}_wrist"], :3, :3])
    return np.concatenate([hand_points(joints, body, hand), turn], axis=1)


def _poses(frames: list[Frame], name: str) -> np.ndarray:
    return np.stack([f.objects[name] for f in frames])


def _off_the_line(points: np.ndarray) -> float:
    """Largest distance [m] of points [T, 3] from the line between the first and the last."""
    along = (points[-1] - points[0]) / np.linalg.norm(points[-1] - points[0])
    gap = points - points[0]
    return float(np.linalg.norm(gap - (gap @ along)[:, None] * along, axis=1).max())


@given(st.sampled_from(BODIES), st.sampled_from(HANDS), SPOTS, SPOTS)
def test_pick_and_place(name: str, hand: Hand, start: tuple, end: tuple) -> None:
    person = _someone(name, hand, start)
    body, first = person.body, person.frame()
    there = person.objects["mug"].copy()
    picking, picked = run(person, person.pick("mug", hand))
    assert picked.success
    assert picked.hand_error_m < 1e-5
    palms, mugs = _palms(body, picking, hand), _poses(picking, "mug")
    taken = int(np.argmax(np.any(np.abs(mugs - there) > 1e-9, axis=1)))
    np.testing.assert_array_equal(mugs[:taken], np.broadcast_to(there, (taken, 7)))
    assert np.linalg.norm(palms[taken - 1, :3] - there[:3]) < 1e-5
    grip = pose_multiply(pose_inverse(palms[taken:]), mugs[taken:])
    np.testing.assert_allclose(grip[:, :3], np.broadcast_to(grip[0, :3], (len(grip), 3)), atol=1e-6)
    assert _off_the_line(palms[taken - 1 :, :3]) < 1e-5
    goal = _at(person, hand, end)
    placing, placed = run(person, person.place(goal, hand))
    assert placed.success
    palms, mugs = _palms(body, placing, hand), _poses(placing, "mug")
    let_go = int(np.argmax(np.linalg.norm(mugs[:, :3] - mugs[-1, :3], axis=1) < 1e-9))
    np.testing.assert_allclose(mugs[: let_go + 1, :3], palms[: let_go + 1, :3], atol=2e-5)
    assert _off_the_line(mugs[: let_go + 1, :3]) < 1e-5
    np.testing.assert_allclose(mugs[-1, :3], goal, atol=1e-3)
    np.testing.assert_allclose(np.abs(mugs[-1, 3:] @ there[3:]), 1, atol=1e-6)  # as upright as it stood
    np.testing.assert_array_equal(
        _poses(picking + placing, "far"), np.tile(person.objects["far"], (len(picking + placing), 1))
    )
    joints = _joints(body, [first, *picking, *placing])
    for foot in ("left_ankle", "left_foot", "right_ankle", "right_foot"):
        assert np.ptp(joints[:, JOINT_INDEX[foot], :3, 3], axis=0).max() < 1e-4
    np.testing.assert_allclose(
        joints[-1, :, :3, 3], joints[0, :, :3, 3], atol=0.025
    )  # standing again, but for its sway
    for frames in (picking, placing):
        assert np.degrees(skills.joint_steps(np.stack([f.joints for f in frames])).max()) < 22  # in 1/30 s


@pytest.mark.parametrize("hand", HANDS)
def test_carrying_while_walking(hand: Hand) -> None:
    person = _someone("neutral_2", hand, (0.38, 0.6, 0.1))
    body, _ = person.body, run(person, person.pick("mug", hand))
    grip = person.held[hand].grip
    frames, done = run(person, person.walk_to([[2.6, -2.5], [2.8, -0.8]]))
    assert done.success
    np.testing.assert_allclose(person.base[[0, 2]], [2.8, -0.8], atol=2e-3)
    np.testing.assert_allclose(
        _poses(frames, "mug")[:, :3], pose_multiply(_palms(body, frames, hand), grip)[:, :3], atol=1e-9
    )
    high = (_poses(frames, "mug")[:, 1]) / reacher(body, hand).body.scale
    assert high.min() > 0.69  # the pelvis sinks where the root gets from 0 to 1.2 m/s in one step
    assert high.max() < 0.85
    joints = _joints(body, frames)
    standing = body.joint_matrices(ground_pose([0, 0], 0.0)[None], *body.clip_pose([0], [0.0]))[0]
    for side in ("left", "right"):
        place = joints[:, JOINT_INDEX[f"{side}_foot"], :3, 3]
        low = place[:, 1] < standing[JOINT_INDEX[f"{side}_foot"], 1, 3] + 0.001
        slide = np.linalg.norm(np.diff(place[:, [0, 2]], axis=0), axis=1)[low[1:] & low[:-1]]
        assert np.median(slide) < 2e-3
        assert slide.max() < 0.006
    back, placed = run(person, person.place(_at(person, hand, (0.36, 0.5, 0.1)), hand))
    assert placed.success
    assert not person.held
    assert np.ptp([f.base for f in back], axis=0).max() == 0


@pytest.mark.parametrize("hand", HANDS)
def test_walking_reaching_and_carrying_go_over_into_each_other(hand: Hand) -> None:
    """From one step to the next no joint moves 12 cm against the pelvis, and planted feet stay where they are."""
    person = _someone("male_1", hand, (0.38, 0.6, 0.1))
    person.spec = WalkerSpec(speed_mps=0.6, turn_rad_s=1.2)
    goal, frames = pose_multiply(ground_pose([-1.0, 0.3], -0.5), [0.4, 0.9, 0.0, 0, 0, 0, 1])[:3], []
    for skill in (
        lambda: person.turn(1.0),
        lambda: person.turn(0.7, settles=False),
        lambda: person.pick("mug", hand),
        lambda: person.walk_to([[0.2, -0.9]]),
        lambda: person.approach(goal, hand),
        lambda: person.place(_at(person, hand, (0.38, 0.7, 0.1)), hand),
        lambda: person.walk_to([[0.0, 1.0]]),
        lambda: person.wait(2.0),
    ):
        done, result = run(person, skill())
        assert result.success, result
        frames += done
    joints = _joints(person.body, frames)
    heading = heading_from_quat(np.stack([f.base for f in frames])[:, 3:])
    away = np.einsum("tij,tkj->tki", _about_y(-heading), joints[:, 1:22, :3, 3] - joints[:, :1, :3, 3])
    assert np.linalg.norm(np.diff(away, axis=0), axis=-1).max() < 0.12
    foot = np.stack([joints[:, JOINT_INDEX[f"{side}_foot"], :3, 3] for side in ("left", "right")], axis=1)
    slide = np.linalg.norm(np.diff(foot[..., ::2], axis=0), axis=-1).min(1)
    assert slide.max() < 0.006
    still = np.ptp(joints[-30:, JOINT_INDEX["head"], :3, 3], axis=0)
    assert 0.001 < np.linalg.norm(still) < 0.05  # who stands breathes


def _about_y(angle: np.ndarray) -> np.ndarray:
    c, s, o, i = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.moveaxis(np.array([[c, o, s], [o, i, o], [-s, o, c]]), -1, 0)


def test_both_hands_hold_something_of_their_own() -> None:
    person = _someone("male_1", "right", (0.38, 0.5, 0.15))
    person.objects["cup"] = np.concatenate([_at(person, "left", (0.38, 0.5, 0.15)), [0, 0, 0, 1]])
    run(person, person.pick("mug", "right"))
    held = pose_multiply(pose_inverse(person.palm("right")), person.objects["mug"])
    frames, result = run(person, person.pick("cup", "left"))
    assert result.success
    assert set(person.held) == {"left", "right"}
    grip = pose_multiply(pose_inverse(_palms(person.body, frames, "right")), _poses(frames, "mug"))
    np.testing.assert_allclose(grip[:, :3], np.broadcast_to(held[:3], (len(frames), 3)), atol=1e-9)


def test_what_is_out_of_reach_is_not_picked() -> None:
    """Unlike in Habitat, where the commanded point decides."""
    person = _someone("female_3", "right", (1.2, 0.7, 0.1))
    there, before = person.objects["mug"].copy(), person.frame()
    frames, result = run(person, person.pick("mug"))
    assert not result.success
    assert not frames
    assert result.reason == "outside_box"
    assert result.hand_error_m > 0.3
    assert result.base_motion is not None
    np.testing.assert_array_equal(person.objects["mug"], there)
    np.testing.assert_array_equal(person.frame().joints, before.joints)
    _, came = run(person, person.approach(there[:3]))
    assert came.success
    assert run(person, person.pick("mug"))[1].success


def test_a_hand_that_misses_takes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    person = _someone("male_0", "right", (0.38, 0.6, 0.1))
    there = person.objects["mug"].copy()
    skill = person.pick("mug")
    next(skill)
    person.objects["mug"][0] += 0.05  # somebody moves it meanwhile
    _, result = run(person, skill)
    assert (result.success, result.reason) == (False, "missed")
    assert result.hand_error_m == pytest.approx(0.05, abs=1e-3)
    assert not person.held
    np.testing.assert_allclose(person.objects["mug"] - there, [0.05, 0, 0, 0, 0, 0, 0], atol=1e-12)


@given(st.floats(-3.1, 3.1), st.floats(-3, 3))
def test_turning_ends_at_the_heading(start: float, heading: float) -> None:
    person = Person(load_humanoid("female_1"), ground_pose([0.3, 0.4], start))
    frames, _ = run(person, person.turn(heading))
    assert np.abs(np.angle(np.exp(1j * (heading_from_quat(person.base[3:]) - heading)))) < 1e-9
    np.testing.assert_allclose(person.base[:3], [0.3, 0, 0.4])
    if frames:
        still = _joints(person.body, [frames[-1], Person(person.body, person.base).frame()])[..., :3, 3]
        assert np.linalg.norm(still[1] - still[0], axis=-1).max() < 0.03  # feet may stand 2 cm off


def test_the_lower_levels() -> None:
    person = Person(load_humanoid("neutral_3"), ground_pose([0, 0], 1.0))
    assert run(person, person.wait(0.5))[0].__len__() == 15
    result = person.reach_to(_at(person, "left", (0.4, 0.7, 0.1)), "left")
    assert result.reached
    np.testing.assert_allclose(person.palm("left")[:3], _at(person, "left", (0.4, 0.7, 0.1)), atol=1e-6)
    quats, pelvis = person.body.clip_pose([3], [0.25])
    person.set_pose(quats[0], pelvis[0], ground_pose([5, 6], 0.0))
    np.testing.assert_array_equal(person.frame().joints, quats[0, 1:])
    np.testing.assert_allclose(person.frame().root[:3], pelvis[0] + [5, 0, 6])
    with pytest.raises(InputError, match="H3-SIM-013"):
        person.set_pose(quats, pelvis)


def test_bad_commands_are_refused() -> None:
    person = _someone("female_0", "right", (0.38, 0.6, 0.1))
    with pytest.raises(InputError, match=r"(?s)'cup'.*far, mug.*H3-SIM-015"):
        next(person.pick("cup"))
    with pytest.raises(InputError, match=r"(?s)right.*H3-SIM-017"):
        next(person.place([0, 0, 0]))
    with pytest.raises(InputError, match="H3-SIM-014"):
        next(person.walk_to([[1, 2, 3]]))
    run(person, person.pick("mug"))
    with pytest.raises(InputError, match=r"(?s)'mug'.*H3-SIM-016"):
        next(person.pick("far"))
    assert skills.SNAP_M < 0.02


@pytest.mark.parametrize("hand", HANDS)
def test_head_and_eyes_turn_to_a_thing_before_the_hand_sets_off(hand: Hand) -> None:
    person = _someone("female_1", hand, (0.33, 0.5, 0.25))
    body, place = person.body, person.objects["mug"][:3].copy()
    frames, picked = run(person, person.pick("mug", hand))
    assert picked.success
    joints = _joints(body, frames)
    head, eye = JOINT_INDEX["head"], JOINT_INDEX[f"{hand}_eye_smplhf"]
    to_mug = place - joints[:, eye, :3, 3]
    to_mug /= np.linalg.norm(to_mug, axis=1)[:, None]
    angles = [np.degrees(np.arccos(np.sum(joints[:, k, :3, 2] * to_mug, axis=1))) for k in (head, eye)]
    palms = _palms(body, frames, hand)
    sets_off = int(np.argmax(np.linalg.norm(palms[:, :3] - palms[0, :3], axis=1) > 0.03))
    taken = int(np.argmin(np.linalg.norm(palms[:, :3] - place, axis=1)))
    assert sets_off > 3
    assert angles[1][sets_off] < 8  # eyes rest on it before the hand moves
    assert angles[0][taken] < 15
    assert angles[0][taken] < angles[0][0] - 25


def test_head_and_eyes_keep_the_speed_of_heads_and_eyes() -> None:
    person = _someone("male_0", "right", (0.33, 0.5, 0.25))
    gazes = [person.gaze.copy()]
    for spot in ((0.4, 0.3, 0.25), (0.4, 1.1, -0.3), (0.0, 0.2, 0.9), None):
        person.look_at = None if spot is None else _at(person, "right", spot)
        for _ in range(60):
            person.stride()
            gazes.append(person.gaze.copy())
    steps = np.degrees(np.diff(gazes, axis=0))
    assert np.hypot(steps[:, 0], steps[:, 1]).max() <= 4.0 + 1e-9  # 120 degrees a second
    assert np.hypot(steps[:, 2], steps[:, 3]).max() <= 13.0 + 1e-9  # 390
    assert np.abs(np.diff(steps[:, :2], axis=0)).max() < 1.2  # no jerk
    assert np.hypot(steps[:, 0], steps[:, 1]).max() > 3.5
    np.testing.assert_array_equal(gazes[-1], 0)


@pytest.mark.parametrize("hand", HANDS)
def test_fingers_close_around_what_they_hold_by_its_size(hand: Hand) -> None:
    bends, side = [], ("left", "right").index(hand)
    fingers = [JOINT_INDEX[f"{hand}_{finger}2"] for finger in ("index", "middle", "pinky", "ring")]
    for radius in (0.012, 0.04, 0.08, None):
        person = _someone("neutral_0", hand, (0.38, 0.6, 0.1))
        person.sizes = {} if radius is None else {"mug": radius}
        start, open_wide = person.quats[fingers].copy(), 0.0
        for _ in person.pick("mug", hand):
            open_wide = min(open_wide, float(person.curl[side]))
        bends.append(float(person.curl[side]))
        turned = skills.joint_steps(np.stack([start, person.quats[fingers]]))[0]
        np.testing.assert_allclose(turned, abs(bends[-1]), atol=1e-3)
        assert open_wide == pytest.approx(skills.OPEN_CURL)
        run(person, person.place(_at(person, hand, (0.38, 0.6, 0.1)), hand))
        run(person, person.settle())
        for _ in range(20):
            person.stride()
        assert person.curl[side] == 0  # it hangs open again
    assert bends[0] > bends[3] > bends[1] > bends[2]


@pytest.mark.parametrize("hand", HANDS)
def test_the_face_turns_against_the_chest_no_faster_than_heads_do(hand: Hand) -> None:
    person = _someone("female_1", hand, (0.33, 0.5, 0.25))
    body, frames = person.body, []
    for skill in (
        lambda: person.pick("mug", hand),
        lambda: person.place(_at(person, hand, (0.4, 0.9, 0.0)), hand),
        person.settle,
    ):
        frames += run(person, skill())[0]
    joints = _joints(body, frames)
    face = np.einsum("tji,tj->ti", joints[:, JOINT_INDEX["spine3"], :3, :3], joints[:, JOINT_INDEX["head"], :3, 2])
    steps = np.degrees(np.arccos(np.clip(np.sum(face[1:] * face[:-1], axis=1), -1, 1)))
    assert steps.max() < 4.5  # 16 with the poses of a reach, whose head looks at its target at once


@pytest.mark.parametrize("hand", HANDS)
def test_what_is_carried_keeps_upright(hand: Hand) -> None:
    """A bowl was carried on its edge: it kept the pose in which the hand had taken it."""
    person = _someone("female_1", hand, (0.38, 0.9, 0.1))
    up = quat_rotate(quat_conjugate(person.objects["mug"][3:]), np.array([0.0, 1.0, 0.0]))
    frames: list[Frame] = []
    for skill in (
        lambda: person.pick("mug", hand),
        lambda: person.walk_to([[2.6, -2.5], [2.8, -0.8]]),
        lambda: person.place(_at(person, hand, (0.36, 0.5, 0.1)), hand),
    ):
        moved, result = run(person, skill())
        assert result.success
        frames += moved
    ups = quat_rotate(_poses(frames, "mug")[:, 3:], np.broadcast_to(up, (len(frames), 3)))
    assert ups[:, 1].min() > 1 - 1e-9


def test_what_is_held_turns_with_a_hand_that_is_turned_from_outside() -> None:
    person = _someone("female_1", "right", (0.38, 0.9, 0.1))
    run(person, person.pick("mug", "right"))
    person.tilts["right"] = 1.0
    person.stride()
    held = person.held["right"]
    expected = quat_multiply(person.palm("right")[3:], held.grip[3:])
    np.testing.assert_allclose(np.abs(person.objects["mug"][3:] @ expected), 1, atol=1e-9)


def test_a_plain_walk_is_shown_as_it_would_be_blended(monkeypatch: pytest.MonkeyPatch) -> None:
    """A walk that nothing is added to is not blended: to the last bit the same, and so is what comes after it."""
    free = FreeSpace.from_scene(build_home(HomeSpec(preset="small", seed=1)), radius_m=0.25)
    at = free.sample(np.random.default_rng(0), 1)[0]
    frames = []
    for short in (True, False):
        with monkeypatch.context() as patch:
            if not short:
                patch.setattr(Person, "_is_bare", False)
            person = Person(load_humanoid("female_1"), ground_pose(at, 0.7), {}, spec=NATURAL_WALKER, free=free)
            gait = HumanState.zeros(1)
            gait.xz[0], gait.heading[0], walk = at, 0.7, []
            for step in range(90):
                gait.xz[0, 0] += 0.02 * (step < 60)
                person.look_at = person.base[:3] + np.array([1.0, 1.5, 2.0]) if 20 < step < 40 else None
                person.stride(gait)
                walk.append([person.quats.copy(), person.bare.copy(), person._drawn.arms.copy()])
            frames.append(walk)
    for short, blended in zip(*frames, strict=True):
        assert all(one.tobytes() == other.tobytes() for one, other in zip(short, blended, strict=True))
