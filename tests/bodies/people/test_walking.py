"""Walking: planted feet, no jumps, no floor pierced, the same after a cycle."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.bodies import JOINT_INDEX, Clip, Humanoid, humanoid_names, load_humanoid
from h3data.errors import InputError
from h3data.geometry import ground_pose, quat_rotate
from tests.bodies.people.everybody import EVERYBODY

BODIES = humanoid_names()
MOVING = ("walk_0.6", "walk_1.0", "walk_1.3", "walk_1.6", "jog_2.5")


def _walk(body: Humanoid, clip: Clip, phase: np.ndarray) -> np.ndarray:
    """Joint frames while the root goes as far as the phase says."""
    base = ground_pose(np.stack([phase * clip.stride_m, np.zeros_like(phase)], 1), np.zeros(len(phase)))
    motion = body.motion_names.index(clip.name)
    return body.joint_matrices(base, *body.clip_pose(np.full(len(phase), motion), phase, np.ones(len(phase))))


@pytest.mark.parametrize("name", EVERYBODY)
@pytest.mark.parametrize("clip_name", MOVING)
def test_stance_foot_does_not_slide(name: str, clip_name: str) -> None:
    body = load_humanoid(name)
    clip = body.clips[body.motion_names.index(clip_name)]
    for side, start in (("left", 0.0), ("right", 0.5)):
        # off the stored frames (an irrational step), from the foot being flat to the toes leaving
        phase = start + np.arange(0.13, clip.stance - 1 / len(clip), 0.00737)
        joints = _walk(body, clip, phase)
        toe_joint = joints[:, JOINT_INDEX[f"{side}_foot"], :3, 3]
        assert np.ptp(toe_joint[:, [0, 2]], axis=0).max() < 0.001
        assert np.ptp(toe_joint[:, 1]) < 0.002


@pytest.mark.parametrize("name", EVERYBODY)
@pytest.mark.parametrize("clip_name", MOVING)
def test_planted_skin_rests_and_nothing_pierces_the_floor(name: str, clip_name: str) -> None:
    body = load_humanoid(name)
    clip = body.clips[body.motion_names.index(clip_name)]
    joints = _walk(body, clip, np.arange(0, 1, 0.0271))
    lowest = body.skin(joints, lod=True)[:, :, 1].min(axis=1)
    assert lowest.min() > -0.005
    if clip.stance > 0.5:  # a walk always has a foot on the floor
        assert lowest.max() < 0.005
    flat = np.arange(0.14, 0.2, 0.0061)
    skin = body.skin(_walk(body, clip, flat))
    left_foot = np.isin(body.lod.joints[:, 0], [JOINT_INDEX["left_foot"]]) & (body.lod.weights[:, 0] > 0.9)
    assert np.ptp(skin[:, left_foot], axis=0).max() < 0.005


@pytest.mark.parametrize("name", EVERYBODY)
def test_clips_are_unit_continuous_and_periodic(name: str) -> None:
    body = load_humanoid(name)
    assert body.motion_names == ("stand", *MOVING, "turn_left", "turn_right")
    for motion, clip in enumerate(body.clips):
        np.testing.assert_allclose(np.linalg.norm(clip.quats, axis=-1), 1, atol=1e-12)
        following = np.roll(clip.quats, -1, axis=0)
        assert np.sum(clip.quats * following, axis=-1).min() > 0.97  # same hemisphere, below 28 degrees a frame
        phase = np.linspace(0, 1, 2001)
        quats, pelvis = body.clip_pose(np.full(2001, motion), phase)
        np.testing.assert_allclose(np.linalg.norm(quats, axis=-1), 1, atol=1e-12)
        assert np.abs(np.diff(quats, axis=0)).max() < 0.02
        assert np.abs(np.diff(pelvis, axis=0)).max() < 0.002
        np.testing.assert_allclose(quats[-1], quats[0], atol=1e-12)
        np.testing.assert_allclose(pelvis[-1], pelvis[0], atol=1e-12)


@settings(derandomize=True, max_examples=40, deadline=None)
@given(st.integers(0, 5), st.floats(-5, 5), st.integers(-3, 3))
def test_whole_cycles_do_not_matter(motion: int, phase: float, cycles: int) -> None:
    body = load_humanoid("female_0")
    quats, pelvis = body.clip_pose([motion, motion], [phase, phase + cycles])
    np.testing.assert_allclose(quats[0], quats[1], atol=1e-9)
    np.testing.assert_allclose(pelvis[0], pelvis[1], atol=1e-9)


def test_blend_goes_from_standing_to_the_clip() -> None:
    body = load_humanoid("female_0")
    blend = np.linspace(0, 1, 41)
    quats, pelvis = body.clip_pose(np.full(41, 3), np.full(41, 0.37), blend)
    stand, at = body.clip_pose([0], [0.0])
    clip, there = body.clip_pose([3], [0.37])
    np.testing.assert_allclose(quats[0], stand[0], atol=1e-9)
    np.testing.assert_allclose(np.abs(np.sum(quats[-1] * clip[0], axis=-1)), 1, atol=1e-12)
    np.testing.assert_allclose(pelvis[0], at[0], atol=1e-9)
    np.testing.assert_allclose(pelvis[-1], there[0], atol=1e-12)
    np.testing.assert_allclose(pelvis[:, [0, 2]], (at + blend[:, None] * (there - at))[:, [0, 2]], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(quats, axis=-1), 1, atol=1e-12)
    assert np.abs(np.diff(pelvis, axis=0)).max() < 0.01
    same = np.abs(np.sum(quats[1:] * quats[:-1], axis=-1))
    assert np.degrees(2 * np.arccos(np.clip(same, 0, 1))).max() < 14  # of 1/40 of the way


@settings(derandomize=True, max_examples=60, deadline=None)
@given(st.sampled_from(BODIES), st.integers(1, 7), st.floats(0, 1))
def test_a_stop_drags_no_foot(name: str, motion: int, phase: float) -> None:
    """The root at rest, wherever in the cycle, in the 6 steps that a stop takes: a sole that moves is in the air."""
    body = load_humanoid(name)
    blend = np.linspace(1, 0, 7)
    root = np.array([[0, 0, 0, 0, 0, 0, 1.0]])
    joints = body.joint_matrices(np.tile(root, (7, 1)), *body.clip_pose(np.full(7, motion), np.full(7, phase), blend))
    standing = body.joint_matrices(root, *body.clip_pose([0], [0.0]))[0]
    for side in ("left", "right"):
        place = joints[:, JOINT_INDEX[f"{side}_foot"], :3, 3]
        moved = np.linalg.norm(np.diff(place[:, [0, 2]], axis=0), axis=1)
        low = place[:, 1] < standing[JOINT_INDEX[f"{side}_foot"], 1, 3] + 0.002
        assert moved[low[1:] & low[:-1]].max(initial=0.0) < 0.001
    np.testing.assert_allclose(joints[-1], standing, atol=1e-6)


@pytest.mark.parametrize("name", EVERYBODY)
@pytest.mark.parametrize("clip_name", MOVING)
def test_a_start_slides_no_foot(name: str, clip_name: str) -> None:
    """From standing, at full speed from the first step on: the left foot stays where it stood."""
    body = load_humanoid(name)
    clip = body.clips[body.motion_names.index(clip_name)]
    step = clip.speed_mps / 30
    distance = np.concatenate([[0.0], step * np.arange(1, 5)])
    distance = distance[distance < 0.4 * clip.stance * clip.stride_m]
    blend = np.minimum(np.where(distance > 0, 0.5 + np.arange(len(distance)) / 6, 0), 1)
    base = ground_pose(np.stack([distance, 0 * distance], 1), np.zeros(len(distance)))
    motion = np.full(len(distance), body.motion_names.index(clip_name))
    joints = body.joint_matrices(base, *body.clip_pose(motion, clip.start_phase + distance / clip.stride_m, blend))
    place = joints[:, JOINT_INDEX["left_foot"], :3, 3]
    assert np.ptp(place[:, [0, 2]], axis=0).max() < 0.001
    right = joints[1:, JOINT_INDEX["right_foot"], 1, 3]
    assert (right > joints[0, JOINT_INDEX["right_foot"], 1, 3] + 0.004).all()  # in the air


@settings(derandomize=True, max_examples=60, deadline=None)
@given(st.sampled_from(BODIES), st.one_of(st.floats(0.2, 2.0), st.floats(2.1, 3.0)))
def test_any_speed_plants_its_feet(name: str, speed: float) -> None:
    body = load_humanoid(name)
    stride = float(body.stride_m(speed))
    phase = np.arange(0.14, 0.30, 0.004)
    base = ground_pose(np.stack([phase * stride, 0 * phase], 1), np.zeros(len(phase)))
    joints = body.joint_matrices(base, *body.walk_pose(np.full(len(phase), speed), phase))
    place = joints[:, JOINT_INDEX["left_foot"], :3, 3]
    assert np.ptp(place[:, [0, 2]], axis=0).max() < 0.0005
    lowest = body.skin(joints)[:, :, 1].min(axis=1)
    assert np.abs(lowest).max() < 0.005


@settings(derandomize=True, max_examples=30, deadline=None)
@given(st.sampled_from(BODIES), st.floats(0.05, 1.95), st.floats(0, 1))
def test_speed_and_phase_are_continuous(name: str, speed: float, phase: float) -> None:
    body = load_humanoid(name)
    near = 1e-5
    quats, pelvis = body.walk_pose([speed, speed + near, speed], [phase, phase, phase + near])
    assert np.abs(np.diff(quats, axis=0)).max() < 0.01
    assert np.abs(np.diff(pelvis, axis=0)).max() < 0.001


def test_walk_pose_is_the_clip_at_its_speed() -> None:
    body = load_humanoid("male_2")
    phase = np.linspace(0, 1, 50)
    for speed, motion in ((1.3, 3), (2.5, 5)):
        quats, pelvis = body.walk_pose(np.full(50, speed), phase)
        clip, place = body.clip_pose(np.full(50, motion), phase)
        assert np.abs(np.sum(quats * clip, axis=-1)).min() > 0.9999
        np.testing.assert_allclose(pelvis, place, atol=5e-4)
    with pytest.raises(InputError, match="H3-BODY-068"):
        body.walk_pose([-1.0], [0.0])


@given(
    st.sampled_from(BODIES), st.floats(-0.08, 0.08), st.floats(-0.08, 0.08), st.integers(0, 5), st.floats(0.15, 0.25)
)
def test_feet_stand_on_uneven_floor(name: str, left: float, right: float, motion: int, phase: float) -> None:
    body = load_humanoid(name)
    root = np.array([[0, 0, 0, 0, 0, 0, 1.0]])
    level = body.joint_matrices(root, *body.clip_pose([motion], [phase]))[0]
    raised = body.joint_matrices(root, *body.clip_pose([motion], [phase], ground=[[left, right]]))[0]
    for side, height in (("left", left), ("right", right)):
        joint = JOINT_INDEX[f"{side}_ankle"]
        np.testing.assert_allclose(raised[joint, :3, 3] - level[joint, :3, 3], [0, height, 0], atol=2e-3)


@pytest.mark.parametrize("name", EVERYBODY)
@pytest.mark.parametrize("side", ["left", "right"])
def test_stepping_turn_plants_its_feet(name: str, side: str) -> None:
    body = load_humanoid(name)
    clip = body.clips[body.motion_names.index(f"turn_{side}")]
    assert clip.turn_rad == pytest.approx((1 if side == "left" else -1) * np.pi / 4)
    phase = np.arange(0, 1, 0.0071)
    base = ground_pose(np.zeros((len(phase), 2)), phase * clip.turn_rad)
    motion = np.full(len(phase), body.motion_names.index(clip.name))
    place = body.joint_matrices(base, *body.clip_pose(motion, phase))[:, JOINT_INDEX["left_ankle"], :3, 3]
    planted = phase < 0.55
    assert np.ptp(place[planted][:, [0, 2]], axis=0).max() < 0.001
    assert np.ptp(place[planted, 1]) < 1e-4
    assert np.ptp(place[~planted, 1]) > 0.04


def test_second_half_mirrors_the_first() -> None:
    body = load_humanoid("male_0")
    clip = body.clips[2]
    early, late = (_walk(body, clip, np.array([phase]))[0] for phase in (0.2, 0.7))
    for name in ("ankle", "knee", "wrist"):
        left, right = early[JOINT_INDEX[f"left_{name}"], :3, 3], late[JOINT_INDEX[f"right_{name}"], :3, 3]
        mirrored = right * [1, 1, -1] - [0.5 * clip.stride_m, 0, 0]
        np.testing.assert_allclose(left, mirrored, atol=0.006)


def test_knees_bend_backwards_and_legs_are_not_torn() -> None:
    body = load_humanoid("female_0")
    for clip in body.clips:
        knee = clip.quats[:, JOINT_INDEX["left_knee"]]
        flexion = 2 * np.degrees(np.arctan2(knee[:, 0], knee[:, 3]))  # about +X
        assert flexion.min() > -0.5
        assert flexion.max() < 120


def test_stride_matches_speed_and_period() -> None:
    for clip in load_humanoid("female_0").clips[1:6]:
        assert clip.stride_m / clip.period_s == pytest.approx(clip.speed_mps, rel=1e-6)
        assert (clip.stance < 0.5) == clip.name.startswith("jog")  # a jog has a flight


def test_clip_for_speed() -> None:
    body = load_humanoid("female_0")
    name = {speed: body.motion_names[body.clip_for_speed(speed)] for speed in (0, 0.1, 0.5, 1.1, 1.29, 1.9, 2.4, 9.0)}
    assert name == {
        0: "stand",
        0.1: "stand",
        0.5: "walk_0.6",
        1.1: "walk_1.0",
        1.29: "walk_1.3",
        1.9: "walk_1.6",
        2.4: "jog_2.5",
        9.0: "jog_2.5",
    }


def test_unknown_motion_is_refused() -> None:
    with pytest.raises(InputError, match=r"(?s)0\.\.7.*8\.\.8.*H3-BODY-069"):
        load_humanoid("female_0").clip_pose([8], [0.0])


def test_pelvis_faces_forward_above_the_root() -> None:
    for clip in load_humanoid("female_0").clips:
        forward = quat_rotate(clip.quats[:, 0], np.array([0.0, 0.0, 1.0]))  # the body's +Z is the root's +x
        assert forward[:, 0].min() > 0.98
        assert np.abs(clip.pelvis[:, [0, 2]]).max() < 0.05
