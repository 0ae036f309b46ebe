"""The one skeleton of all humanoids: 55 joints with SMPL-X names and order, so AMASS and Habitat motion apply by index.

Zero pose = T-pose with every joint frame aligned to the body frame (+Z forward, +Y up, +X left).
"""

from __future__ import annotations

import numpy as np

_BODY = (
    ("pelvis", ""),
    ("left_hip", "pelvis"),
    ("right_hip", "pelvis"),
    ("spine1", "pelvis"),
    ("left_knee", "left_hip"),
    ("right_knee", "right_hip"),
    ("spine2", "spine1"),
    ("left_ankle", "left_knee"),
    ("right_ankle", "right_knee"),
    ("spine3", "spine2"),
    ("left_foot", "left_ankle"),
    ("right_foot", "right_ankle"),
    ("neck", "spine3"),
    ("left_collar", "spine3"),
    ("right_collar", "spine3"),
    ("head", "neck"),
    ("left_shoulder", "left_collar"),
    ("right_shoulder", "right_collar"),
    ("left_elbow", "left_shoulder"),
    ("right_elbow", "right_shoulder"),
    ("left_wrist", "left_elbow"),
    ("right_wrist", "right_elbow"),
    ("jaw", "head"),
    ("left_eye_smplhf", "head"),
    ("right_eye_smplhf", "head"),
)
FINGERS = ("index", "middle", "pinky", "ring", "thumb")


def _with_fingers() -> tuple[tuple[str, str], ...]:
    rows = list(_BODY)
    for side in ("left", "right"):
        for finger in FINGERS:
            rows.append((f"{side}_{finger}1", f"{side}_wrist"))
            rows += [(f"{side}_{finger}{k}", f"{side}_{finger}{k - 1}") for k in (2, 3)]
    return tuple(rows)


_ROWS = _with_fingers()
JOINT_NAMES: tuple[str, ...] = tuple(name for name, _ in _ROWS)
"""SMPL-X names, parents before children."""
JOINT_INDEX: dict[str, int] = {name: i for i, name in enumerate(JOINT_NAMES)}
PARENTS: tuple[int, ...] = tuple(JOINT_INDEX[parent] if parent else -1 for _, parent in _ROWS)
JOINT_COUNT = len(JOINT_NAMES)
PARENT_ARRAY = np.array(PARENTS)

HABITAT_BASE_HEIGHT_M = 0.9
"""Height above the floor of the frame that places a humanoid of Habitat [m]."""


def _depth_first(side: str) -> list[str]:
    arm = [f"{side}_{part}" for part in ("collar", "shoulder", "elbow", "wrist")]
    return arm + [f"{side}_{finger}{k}" for finger in FINGERS for k in (1, 2, 3)]


HABITAT_JOINTS: tuple[str, ...] = (
    *(f"{side}_{part}" for side in ("left", "right") for part in ("hip", "knee", "ankle", "foot")),
    *("spine1", "spine2", "spine3", "neck", "head", "jaw", "left_eye_smplhf", "right_eye_smplhf"),
    *_depth_first("left"),
    *_depth_first("right"),
)
"""The 54 joints in the order of Habitat's joint vectors: depth first over the SMPL-X tree, without the pelvis."""
