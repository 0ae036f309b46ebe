"""Skeleton of all humanoids: 55 joints with SMPL-X names and order, so AMASS and Habitat motion apply by index.

Zero pose = T-pose with every joint frame aligned to the body frame (+Z forward, +Y up, +X left).
"""

from __future__ import annotations

import numpy as np

FINGERS = ("index", "middle", "pinky", "ring", "thumb")
HUMAN_ROOT_HEIGHT_M = 0.9
"""Height of a standing humanoid's root over the floor [m], habitat-lab's ``base_offset`` (spec/habitat.md 0)."""

# SMPL-X numbers joints so: the body by depth, then jaw and eyes, then both hands finger by finger.
_ROWS = (
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
    *(
        (f"{side}_{finger}{k}", f"{side}_wrist" if k == 1 else f"{side}_{finger}{k - 1}")
        for side in ("left", "right")
        for finger in FINGERS
        for k in (1, 2, 3)
    ),
)
JOINT_NAMES: tuple[str, ...] = tuple(name for name, _ in _ROWS)
"""SMPL-X names of the joints, parents before children."""
JOINT_INDEX: dict[str, int] = {name: i for i, name in enumerate(JOINT_NAMES)}
PARENTS: tuple[int, ...] = tuple(JOINT_INDEX[parent] if parent else -1 for _, parent in _ROWS)
JOINT_COUNT = len(JOINT_NAMES)
PARENT_ARRAY = np.array(PARENTS)
HALF_JOINTS: dict[str, int] = {
    f"{side}_{joint}_half": JOINT_INDEX[f"{side}_{joint}"]
    for joint in ("hip", "knee", "shoulder", "elbow")
    for side in ("left", "right")
}
"""Names of the half joints and the index of the joint of each. A half joint is at the place of its joint and turned by half of
the angle by which that is bent from the rest mesh. Half joints move skin only; in arrays they follow the joints."""
