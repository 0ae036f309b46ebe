"""Walking: planted feet, no jumps, no floor pierced, the same after a cycle."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.bodies import JOINT_INDEX, Clip, Humanoid, load_humanoid
from h3data.errors import InputError
from h3data.geometry import ground_pose, quat_rotate

BODIES = ("female_0", "male_0")
MOVING = ("walk_0.6", "walk_1.0", "walk_1.3", "walk_1.6", "jog_2.5")


def _walk(body: Humanoid, clip: Clip, phase: np.ndarray) -> np.ndarray:
    """Joint frames while the root goes as far as the phase says."""
    base = ground_pose(np.stack([phase * clip.stride_m, np.zeros_like(phase)], 1), np.zeros(len(phase)))
    motion = body.motion_names.index(clip.name)
    return body.joint_matrices(base, *body.clip_pose(np.full(len(phase), motion), phase, np.ones(len(phase))))


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("clip_name", MOVING)
def test_stance_foot_does_not_slide(name: str, clip_name: str) -> None:
    body = load_humanoid(name)
    clip = body.clips[body.motion_names.index(clip_name)]
    for side, start in (("left", 0.0), ("right", 0.5)):
        # off the stored frames (an irrational step), from the foot being flat to the toes leaving
        phase = start + np.arange(0.13, clip.stance - 1 / len(clip), 0.00737)
        joints = _walk(body, clip, phase)
        toe_joint = joints[:, JOINT_INDEX[f"{side}_foot"], :3, 3]
        assert np.ptp(toe_joint[:, [0, 2]], axis=0).max() < 0.005
        assert np.ptp(toe_joint[:, 1]) < 0.005


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("clip_name", MOVING)
def test_planted_skin_rests_and_nothing_pierces_the_floor(name: str, clip_name: str) -> None:
    body = load_humanoid(name)
    clip = body.clips[body.motion_names.index(clip_name)]
    joints = _walk(body, clip, np.arange(0, 1, 0.0271))
    lowest = body.skin(joints, lod=True)[:, :, 1].min(axis=1)
    assert lowest.min() > -0.015
    if clip.stance > 0.5:  # a walk always has a foot on the floor
        assert lowest.max() < 0.01
    flat = np.arange(0.14, 0.2, 0.0061)
    skin = body.skin(_walk(body, clip, flat))
    left_foot = np.isin(body.lod.joints[:, 0], [JOINT_INDEX["left_foot"]]) & (body.lod.weights[:, 0] > 0.9)
    assert np.ptp(skin[:, left_foot], axis=0).max() < 0.005


@pytest.mark.parametrize("name", BODIES)
def test_clips_are_unit_continuous_and_periodic(name: str) -> None:
    body = load_humanoid(name)
    assert body.motion_names == ("stand", *MOVING)
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
    blend = np.array([0, 0.25, 0.5, 0.75, 1.0])
    quats, pelvis = body.clip_pose(np.full(5, 3), np.full(5, 0.37), blend)
    stand, at = body.clip_pose([0], [0.0])
    clip, there = body.clip_pose([3], [0.37])
    np.testing.assert_allclose(quats[0], stand[0], atol=1e-12)
    np.testing.assert_allclose(quats[4], clip[0], atol=1e-12)
    np.testing.assert_allclose(pelvis, at + blend[:, None] * (there - at), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(quats, axis=-1), 1, atol=1e-12)
    turned = np.abs(np.sum(quats * stand, axis=-1))
    assert (np.diff(turned, axis=0) <= 1e-12).all()  # always farther from standing


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
    for clip in load_humanoid("female_0").clips[1:]:
        assert clip.stride_m / clip.period_s == pytest.approx(clip.speed_mps, rel=1e-6)
        assert (clip.stance < 0.5) == clip.name.startswith("jog")  # a jog has a flight


def test_clip_for_speed() -> None:
    body = load_humanoid("female_0")
    name = {speed: body.motion_names[body.clip_for_speed(speed)] for speed in (0, 0.1, 0.5, 1.1, 1.29, 1.9, 2.4, 9.0)}
    assert name == {
        0: "stand", 0.1: "stand", 0.5: "walk_0.6", 1.1: "walk_1.0", 1.29: "walk_1.3", 1.9: "walk_1.6", 2.4: "jog_2.5",
        9.0: "jog_2.5",
    }  # fmt: skip


def test_unknown_motion_is_refused() -> None:
    with pytest.raises(InputError, match=r"motion ids 0\.\.5, got 6\.\.6"):
        load_humanoid("female_0").clip_pose([6], [0.0])


def test_pelvis_faces_forward_above_the_root() -> None:
    for clip in load_humanoid("female_0").clips:
        forward = quat_rotate(clip.quats[:, 0], np.array([0.0, 0.0, 1.0]))  # the body's +Z is the root's +x
        assert forward[:, 0].min() > 0.98
        assert np.abs(clip.pelvis[:, [0, 2]]).max() < 0.05
