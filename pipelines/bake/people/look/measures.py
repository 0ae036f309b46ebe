"""Landmarks of a rig and coordinates along its limbs, as smooth fields over points with skin weights.

Lengths are fractions of the stature where they grow with the person and metres where they do not (cloth thickness).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bake.people.rig import Rig
from h3data.bodies.people.skeleton import FINGERS, JOINT_INDEX
from h3data.geometry import Array, normalized


def smoothstep(low: float, high: float, x: Array) -> Array:
    """Return 0 below ``low``, 1 above ``high``, and smooth values between (the reverse for ``low`` > ``high``)."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def bump(x: Array, middle: float, width: float) -> Array:
    """Return 1 at ``middle``, falling to 0 as a bell of a given ``width``."""
    return np.exp(-(((x - middle) / width) ** 2))


@dataclass(frozen=True, kw_only=True, eq=False)
class Cloth:
    """A surface on the pattern body: what fields are evaluated on and what is cut."""

    vertices: Array
    """Vertices of the surface, shape [V, 3] [m]."""
    weights: Array
    """Dense skin weights, shape [V, 55]."""
    faces: NDArray[np.int32]


def joint_weight(mesh: Cloth, names: tuple[str, ...]) -> Array:
    """Return the sum of the skin weights of some joints per vertex [V]."""
    return mesh.weights[:, [JOINT_INDEX[n] for n in names]].sum(axis=1)


def arm_joints(side: str) -> tuple[str, ...]:
    """Return names of the joints of one arm, fingers included."""
    fingers = tuple(f"{side}_{finger}{k}" for finger in FINGERS for k in (1, 2, 3))
    return (f"{side}_shoulder", f"{side}_elbow", f"{side}_wrist", *fingers)


class Measures:
    """Landmarks and coordinates of one rig."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.stature = float(rig.vertices[:, 1].max())
        self.eye = (rig.joint("left_eye_smplhf") + rig.joint("right_eye_smplhf")) / 2
        self.eye_x = float(rig.joint("left_eye_smplhf")[0])
        self.head_z = float(np.mean(rig.vertices[rig.vertices[:, 1] > self.eye[1]][:, 2]))
        self.pelvis, self.knee = rig.joint("pelvis"), rig.joint("left_knee")
        self.ankle, self.neck_joint = rig.joint("left_ankle"), rig.joint("neck")
        self.head_size = self.stature - float(self.eye[1])

    def is_eye(self, mesh: Cloth) -> NDArray[np.bool_]:
        """Return a mask of the vertices of the eyeballs."""
        return joint_weight(mesh, ("left_eye_smplhf", "right_eye_smplhf")) > 0.9

    def arms(self, mesh: Cloth) -> Array:
        """Return the share of each vertex that belongs to the arms, 0 to 1, shape [V]."""
        return joint_weight(mesh, arm_joints("left")) + joint_weight(mesh, arm_joints("right"))

    def beyond(self, mesh: Cloth, start: str, end: str, share: float) -> Array:
        """Return the distance beyond a plane across the bone from ``start`` to ``end`` of each arm [m]; -1 elsewhere."""
        result = np.full(len(mesh.vertices), -1.0)
        for side in ("left", "right"):
            near, far = self.rig.joint(f"{side}_{start}"), self.rig.joint(f"{side}_{end}")
            along = (mesh.vertices - near - share * (far - near)) @ normalized(far - near)
            result = np.where(joint_weight(mesh, arm_joints(side)) > 0.5, along, result)
        return result

    def along_arm(self, mesh: Cloth) -> tuple[Array, Array]:
        """Return the place along the arm (0 shoulder, 1 elbow, 2 wrist) and the angle about it [rad], each [V]."""
        left = mesh.vertices[:, 0] > 0
        out, angle = np.zeros(len(mesh.vertices)), np.zeros(len(mesh.vertices))
        for side, mine in (("left", left), ("right", ~left)):
            shoulder, elbow, wrist = (self.rig.joint(f"{side}_{j}") for j in ("shoulder", "elbow", "wrist"))
            lower = joint_weight(mesh, arm_joints(side)[1:])
            t0 = (mesh.vertices - shoulder) @ (elbow - shoulder) / np.sum((elbow - shoulder) ** 2)
            t1 = 1 + (mesh.vertices - elbow) @ (wrist - elbow) / np.sum((wrist - elbow) ** 2)
            out = np.where(mine, (1 - lower) * np.minimum(t0, 1.3) + lower * np.maximum(t1, 0.7), out)
            axis = normalized(wrist - shoulder)
            front = np.array([0, 0, 1.0])
            up = np.cross(front, axis)
            off = mesh.vertices - shoulder - ((mesh.vertices - shoulder) @ axis)[:, None] * axis
            off = off - (np.clip(t0, 0, 1) * float((elbow - shoulder) @ up))[:, None] * up
            angle = np.where(mine, np.arctan2(off @ front, off @ up), angle)
        return out, angle

    def along_leg(self, mesh: Cloth) -> tuple[Array, Array, Array]:
        """Return place along the leg (0 hip, 1 knee, 2 ankle), angle about it and distance from it.

        The angle is 0 in front and positive outside [rad].
        """
        y = mesh.vertices[:, 1]
        hip = self.rig.joint("left_hip")
        knots = np.array([self.ankle[1], self.knee[1], hip[1], hip[1] + 0.4])
        u = np.interp(y, knots, [2.0, 1.0, 0.0, -1.0])
        axis = [np.interp(y, knots[:3], [self.ankle[k], self.knee[k], hip[k]]) for k in (0, 2)]
        outside, front = np.abs(mesh.vertices[:, 0]) - axis[0], mesh.vertices[:, 2] - axis[1]
        return u, np.arctan2(outside, front), np.hypot(outside, front)

    def azimuth(self, mesh: Cloth) -> Array:
        """Return the angle about the trunk [rad]: 0 in front, positive on the left."""
        return np.arctan2(mesh.vertices[:, 0], mesh.vertices[:, 2] - float(self.pelvis[2]))
