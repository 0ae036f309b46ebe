"""The figures of ``python -m benchmarks motion``, and what they say of motions whose faults are known."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.motion import SHARED, figures_of, motion_of, real_motion, robot_tracks, trot_slides
from h3data.bodies import JOINT_INDEX, load_humanoid
from h3data.geometry import Array, ground_pose

SPEED = 1.3


def walk(steps: int = 120) -> tuple[Array, Array]:
    """Roots and joints of a steady walk of male_1."""
    body = load_humanoid("male_1")
    clip = body.clip_for_speed(SPEED)
    way = np.arange(steps) * SPEED / 30
    base = ground_pose(np.stack([way, 0 * way], -1), np.zeros(steps))
    posture = body.clip_pose(np.full(steps, clip), way / body.clips[clip].stride_m)
    return base, body.joint_matrices(base, *posture)


def figures(base: Array, joints: Array) -> dict[str, float]:
    return figures_of(motion_of(load_humanoid("male_1"), base, joints))


def test_a_steady_walk_has_no_faults() -> None:
    found = figures(*walk())
    assert found["pops_per_minute"] == found["mid_air_stops"] == found["turning_share"] == 0
    assert found["foot_slide_mm"] < 0.2
    assert 50 < found["jerk"] < 1000


def test_faults_are_counted() -> None:
    base, joints = walk()
    joints[60, JOINT_INDEX["left_wrist"], :3, 3] += 0.3  # there and back: two steps
    assert figures(base, joints)["pops_per_minute"] == pytest.approx(2 / (119 / 30 / 60))
    base, joints = walk()
    joints[..., 1, 3] += 0.05
    base[80:] = base[80]
    assert figures(base, joints)["mid_air_stops"] == 39
    base, joints = walk()
    joints[:, :, 0, 3] += np.arange(120)[:, None] * 0.01
    assert figures(base, joints)["foot_slide_mm"] == pytest.approx(10, abs=0.5)
    turning = ground_pose(np.zeros((120, 2)), np.arange(120) * 0.05)
    assert figures(turning, walk()[1])["turning_share"] == 1


def test_a_captured_walk_has_figures() -> None:
    clips: list[Path] = sorted((SHARED / "motion").glob("*.bvh"))
    if not clips:
        pytest.skip("no captured walk in ../shared/motion")
    found = figures_of(real_motion(clips[0]))
    assert found["minutes"] > 0.1
    assert 50 < found["jerk"] < 1000


def test_feet_of_the_robot_stay_planted_at_every_speed_and_turn() -> None:
    slides = [trot_slides(track) for track in robot_tracks(150)]
    assert min(map(len, slides)) > 200  # feet stand about half of the time
    assert max(float(slide.mean()) for slide in slides) < 1e-4
    assert max(float(slide.max()) for slide in slides) < 1e-3
