"""Postures beside walking, compiled: hands are where they are led, and the rest equals plain NumPy code."""

from __future__ import annotations

import numpy as np
import pytest

from h3data.bodies import Humanoid, humanoid_names, load_humanoid
from h3data.bodies.people.gestures import ARMS, BOTH, Gesture, lead_hands, lead_wrists
from h3data.bodies.people.reach import hand_points, reach_poses
from h3data.bodies.people.sitting import EARLY, TABLE, sitting_on, take_seats
from h3data.geometry import IDENTITY_POSE, Array, quat_nlerp, smoothstep
from h3data_crowds.chores import minimum_jerk

BODIES = pytest.mark.parametrize("name", humanoid_names()[1::6])


def wrists_at(gesture: Gesture, seconds: Array) -> Array:
    """Places of both wrists, and whether each is used (0 to 1), at times [T] since a gesture began, [T, 2, 4]."""
    out = np.zeros((len(seconds), 2, 4))
    for side, keys in enumerate((gesture.left, gesture.right)):
        at = (seconds / gesture.seconds % 1.0) * len(keys)
        k = np.minimum(at.astype(np.intp), len(keys) - 1)
        share = minimum_jerk(np.asarray(at - k))[:, None]
        used = [key for key in keys if key is not None]
        places = np.array([[*(key or (used or [(0.6, -0.5, 0.0)])[0]), float(key is not None)] for key in keys])
        out[:, side] = (1 - share) * places[k] + share * places[(k + 1) % len(keys)]
    return out


def rooted(body: Humanoid, quats: Array, pelvis: Array) -> Array:
    """Joint frames [T, 55, 4, 4] by the agent root."""
    return body.joint_matrices(IDENTITY_POSE, quats, pelvis)


def walking(body: Humanoid, count: int) -> tuple[Array, Array]:
    """Poses of somebody who walks."""
    return body.walk_pose(np.full(count, 1.1), np.linspace(0, 1, count))


def assert_same(quats: Array, expected: Array) -> None:
    """Asserts that two poses are the same rotations."""
    np.testing.assert_allclose(np.abs(np.sum(quats * expected, -1)), 1, atol=1e-12)
    np.testing.assert_allclose(quats, np.copysign(1, np.sum(quats * expected, -1))[..., None] * expected, atol=1e-9)


@BODIES
def test_wrists_are_led_there_and_elbows_point_where_they_should(name: str) -> None:
    body, rng, count = load_humanoid(name), np.random.default_rng(3), 60
    quats, pelvis = walking(body, count)
    before = rooted(body, quats, pelvis)[:, ARMS][..., :3, 3]
    arm = np.linalg.norm(body.joint_offsets[ARMS[:, 1:]], axis=2).sum(1)
    # ahead of the shoulders, where neither folded nor stretched arms end
    away = rng.uniform((0.3, -0.5, 0.0), (0.5, 0.3, 0.3), (count, 2, 3)) * arm[:, None] * [[1, 1, -1], [1, 1, 1]]
    shares = np.repeat([0.0, 1.0, 0.5], 20)
    pole = (-0.6, -0.2, 0.55)
    places = before[:, :, 0] + away
    lead_wrists(body, quats, pelvis, places, shares, pole=pole, twist_deg=20.0, wrist_deg=9.0)
    after = rooted(body, quats, pelvis)[:, ARMS][..., :3, 3]
    np.testing.assert_allclose(after[:20], before[:20], atol=1e-12)
    np.testing.assert_allclose(after[20:40, :, 2], places[20:40], atol=1e-6)
    # the elbow is on the side of the line from shoulder to wrist to which the pole points
    line = places - before[:, :, 0]
    out = np.array(pole) * [[1, 1, -1], [1, 1, 1]]
    out = out - np.sum(out * line, -1, keepdims=True) / np.sum(line * line, -1, keepdims=True) * line
    assert (np.sum(out * (after[:, :, 1] - before[:, :, 0]), -1)[20:40] > 0).all()


@BODIES
def test_palms_are_led_there_and_trunks_lean_as_by_numpy(name: str) -> None:
    body, rng, count = load_humanoid(name), np.random.default_rng(5), 60
    scale, hands = body.height_m / 1.7, np.zeros((count, 4, 4))
    hands[..., :3] = scale * rng.uniform((0.3, 0.9, -0.2), (0.4, 1.2, 0.2), (count, 4, 3))
    hands[:, 2:, 3] = rng.choice([0.0, 0.2, 0.5], (count, 2))
    # a share of one hand alone, of which the other posture is not computed
    hands[::5, 2, 3], hands[1::5, 3, 3] = 0.0, 0.0
    (quats, pelvis), (expected, place) = walking(body, count), walking(body, count)
    lead_hands(body, quats, pelvis, hands)
    left, right = (reach_poses(body, hands[:, 2 + k, :3], hand) for k, hand in enumerate(BOTH))
    lean = hands[:, 2:, 3].sum(1)
    share = hands[:, 3, 3] / np.where(lean > 0, lean, 1)
    both = quat_nlerp(left.quats, right.quats, np.repeat(share[:, None], 55, 1))
    expected = quat_nlerp(expected, both, np.repeat(lean[:, None], 55, 1))
    assert_same(quats, expected)
    place += lean[:, None] * (left.pelvis + share[:, None] * (right.pelvis - left.pelvis) - place)
    np.testing.assert_allclose(pelvis, place, atol=1e-12)
    hands[:, :2, 3] = 1.0
    (quats, pelvis) = walking(body, count)
    lead_hands(body, quats, pelvis, hands)
    frames, arm = rooted(body, quats, pelvis), np.linalg.norm(body.joint_offsets[ARMS[:, 1:]], axis=2).sum(1)
    for k, hand in enumerate(BOTH):
        gap = np.linalg.norm(hand_points(frames, body, hand) - hands[:, k, :3], axis=1)
        away = np.linalg.norm(hands[:, k, :3] - frames[:, ARMS[k, 0], :3, 3], axis=1)
        near = (away > 0.5 * arm[k]) & (away < 1.0 * arm[k])
        assert near.any()
        np.testing.assert_allclose(gap[near], 0, atol=1e-6)


def test_seats_are_interpolated_by_height_and_posture() -> None:
    body, shares = load_humanoid("neutral_2"), np.array([0.0, 0.03, 0.4, 1.0, 1.3, 2.0] * 2)
    heights = np.repeat([0.42, 0.5], 6)
    (quats, pelvis), (expected, place) = walking(body, 12), walking(body, 12)
    take_seats(body, quats, pelvis, np.column_stack([heights, shares]))
    for t in np.flatnonzero(shares > 0).tolist():
        lies = shares[t] > 1
        turns, places = sitting_on(body, heights[t]).lying if lies else sitting_on(body, heights[t]).table
        at = (shares[t] - lies) * (TABLE - 1)
        low = min(int(at), TABLE - 2)
        early = smoothstep(min(shares[t] / EARLY, 1.0))
        there = quat_nlerp(turns[low], turns[low + 1], np.full(55, at - low))
        expected[t] = quat_nlerp(expected[t], there, np.full(55, early))
        place[t] += early * (places[low] + (at - low) * (places[low + 1] - places[low]) - place[t])
    assert_same(quats, expected)
    np.testing.assert_allclose(pelvis, place, atol=1e-12)


def test_who_only_stands_is_not_changed() -> None:
    body = load_humanoid("older_0")
    (quats, pelvis), (before, _) = walking(body, 5), walking(body, 5)
    lead_hands(body, quats, pelvis, np.zeros((5, 4, 4)))
    np.testing.assert_array_equal(quats, before)
