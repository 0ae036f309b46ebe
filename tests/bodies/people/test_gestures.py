"""Gestures: hands reach the places that a gesture names, move without jumps, and leave the rest of the body alone."""

import numpy as np
import pytest

from benchmarks.gestures import run
from h3data.bodies import JOINT_INDEX, humanoid_names, load_humanoid
from h3data.bodies.people.gestures import GESTURES, NAMES, RAISED, add_gestures
from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE
from tests.bodies.people.test_postures import wrists_at

WRISTS = [JOINT_INDEX["left_wrist"], JOINT_INDEX["right_wrist"]]
SHOULDERS = [JOINT_INDEX["left_shoulder"], JOINT_INDEX["right_shoulder"]]


def standing(name: str, count: int):
    body = load_humanoid(name)
    return body, *body.clip_pose(np.zeros(count, np.int64), np.zeros(count))


@pytest.mark.parametrize("name", humanoid_names()[::5])
def test_wrists_are_where_the_gesture_says(name: str) -> None:
    for number, gesture in enumerate(GESTURES.values()):
        seconds = np.linspace(0, gesture.seconds, 23)
        body, quats, pelvis = standing(name, len(seconds))
        before = quats.copy()
        add_gestures(body, quats, pelvis, np.column_stack([np.full(23, number), seconds, np.ones(23)]))
        changed = np.flatnonzero((quats != before).any((0, 2)))
        joints = {list(JOINT_INDEX)[k].removeprefix("left_").removeprefix("right_") for k in changed}
        assert joints <= {"shoulder", "elbow", "wrist", "neck", "head"}
        frames = body.joint_matrices(np.tile(IDENTITY_POSE, (23, 1)), quats, pelvis)[..., :3, 3]
        places = wrists_at(gesture, seconds)
        for side, sign in enumerate((1.0, -1.0)):
            elbow, wrist = (JOINT_INDEX[f"{('left', 'right')[side]}_{joint}"] for joint in ("elbow", "wrist"))
            arm = np.linalg.norm(body.joint_offsets[[elbow, wrist]], axis=1).sum()
            expected = frames[:, SHOULDERS[side]] + arm * places[:, side, :3] * (1, 1, -sign)
            shoulder = frames[:, SHOULDERS[side], 1]
            expected[:, 1] = np.maximum(expected[:, 1], np.minimum(gesture.least_m, shoulder - RAISED * arm))
            away = np.linalg.norm(expected - frames[:, SHOULDERS[side]], axis=1)
            used = (places[:, side, 3] == 1) & (away < 0.97 * arm)
            np.testing.assert_allclose(frames[used, WRISTS[side]], expected[used], atol=2e-3)


def test_without_weight_nothing_moves_and_joints_move_without_jumps() -> None:
    body, quats, pelvis = standing("female_0", 4)
    before = quats.copy()
    add_gestures(body, quats, pelvis, np.column_stack([np.arange(4), np.ones(4), np.zeros(4)]))
    np.testing.assert_array_equal(quats, before)
    figures = {}
    run(lambda name, value, unit: figures.update({name: value}))
    assert 0.5 < figures["motion.gesture.joint"] < 14


@pytest.mark.parametrize("gesture", [(len(NAMES), 0, 1), (0.5, 0, 1), (-1, 0, 0), (0, np.nan, 1), (0, 1)])
def test_what_is_no_gesture_is_refused(gesture: tuple[float, ...]) -> None:
    body, quats, pelvis = standing("male_0", 1)
    with pytest.raises(InputError, match="H3-BODY-180"):
        add_gestures(body, quats, pelvis, [gesture])
