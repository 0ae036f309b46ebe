"""Parts of a recording, posed at every step, as input of the writers of other formats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.skinning import Influences
from h3data.geometry import Array
from h3data.mesh.mesh import Mesh
from h3data.recording.records import Body


@dataclass(frozen=True, kw_only=True, eq=False)
class Skeleton:
    """Joints that deform a mesh: a vertex v moves to the sum of w_j J_j B_j v over its four joints."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    """Index of each joint's parent, which precedes it; -1 if it has none or none is known."""
    poses: Array
    """World poses (pose7) of the joints, shape [T, J, 7]; NaN while the body is absent."""
    scale: float = 1.0
    """Scale of the joint frames."""
    inverse_bind: Array
    """Matrices from the rest mesh to the joint frames, shape [J, 4, 4]."""
    influences: Influences


@dataclass(frozen=True, kw_only=True, eq=False)
class PosedPart:
    """Visible part of a recorded scene, with its poses over time."""

    name: str
    mesh: Mesh
    """Mesh in its own frame [m], in the rest pose for a body with a skeleton."""
    poses: Array
    """Pose7 from the mesh to the world, shape [T, 7], or [1, 7] for a static part; NaN while it is absent. For a part
    with a skeleton, it is the pose of the root."""
    scale: Array = field(default_factory=lambda: np.ones(3))
    semantic_id: int = 0
    agent: int = -1
    """Index of the agent to which the part belongs; -1 if there is none."""
    body: Body | None = None
    """Body of the recording that the part shows; None for the model of an agent."""
    placeholder: bool = False
    """True if the file of the mesh was not found."""
    skeleton: Skeleton | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class PosedCamera:
    """Camera on an agent or a body, with its poses over time."""

    name: str
    poses: Array
    """World poses (pose7), shape [T, 7], with x right, y up and view along -z, as in Habitat and glTF; NaN while
    absent."""
    vfov_rad: float
    aspect: float
    """Width divided by height."""
    near_m: float


def spans(there: Sequence[bool] | NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return each run of True in ``there`` [T] as its first step and the step after its last one."""
    # with an edge on both sides, also runs at the ends have a beginning and an end
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(there, np.int8), [0]])))
    return [(int(start), int(end)) for start, end in edges.reshape(-1, 2)]
