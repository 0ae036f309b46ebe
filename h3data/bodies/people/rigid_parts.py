"""People as rigid parts that move with their joints: their collision capsules, or bones.

Habitat's "no skinning" shows people as bones. Contact is determined from the capsules (spec/habitat.md 1.6, 3.1)."""

from __future__ import annotations

from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np

from h3data.bodies.people.humanoid import Humanoid
from h3data.bodies.people.skeleton import JOINT_NAMES, PARENTS
from h3data.mesh.mesh import Mesh
from h3data.mesh.primitives import capsule_mesh

PeopleStyle = Literal["skin", "capsules", "bones"]
"""Rendering style of people: their skinned meshes, collision capsules, or bones."""
CAPSULE_COLOR, BONE_COLOR = (118, 156, 172), (206, 190, 152)
BONE_RADIUS_M, SHORTEST_BONE_M = 0.022, 0.01
SKULL_RADIUS_M, SKULL_M = 0.08, np.array([0.06, 0.12])


class RigidPart(NamedTuple):
    """A mesh that moves with one joint."""

    name: str
    joint: int
    mesh: Mesh
    """Mesh in the joint's frame [m]."""


@lru_cache(maxsize=64)
def rigid_parts(body: Humanoid, style: PeopleStyle) -> tuple[RigidPart, ...]:
    """Return the rigid parts of a person in a style; the style ``skin`` has none."""
    if style == "capsules":
        return tuple(
            RigidPart(c.name, c.joint, capsule_mesh(c.start, c.end, c.radius, color=CAPSULE_COLOR))
            for c in body.capsules
        )
    return _bones(body) if style == "bones" else ()


def _bones(body: Humanoid) -> tuple[RigidPart, ...]:
    """Return a capsule along each bone, and one for the skull.

    Frames of joints are aligned with the body: +Y up, +Z forward.
    """
    parts = []
    for end, (parent, offset) in enumerate(zip(PARENTS, body.joint_offsets, strict=True)):
        length = float(np.linalg.norm(offset))
        if parent >= 0 and length > SHORTEST_BONE_M:
            mesh = capsule_mesh(np.zeros(3), offset, min(BONE_RADIUS_M, length / 4), color=BONE_COLOR)
            parts.append(RigidPart(f"to_{JOINT_NAMES[end]}", parent, mesh))
    low, high = SKULL_M[:, None] * np.array([[0.0, 1.0, 0.25]]) * body.height_m / 1.7
    skull = capsule_mesh(low, high, SKULL_RADIUS_M * body.height_m / 1.7, color=BONE_COLOR)
    return (*parts, RigidPart("skull", JOINT_NAMES.index("head"), skull))
