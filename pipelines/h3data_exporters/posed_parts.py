"""Parts of a recording, posed at every step, in the form for writers of other formats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
from h3data.mesh.mesh import Mesh
from h3data.recording.records import Body
from h3data_exporters.glb_write import Influences


@dataclass(frozen=True, kw_only=True, eq=False)
class Skeleton:
    """The joints that deform a mesh. A vertex v goes to the sum of w_j J_j B_j v over its four joints."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    """Index of each joint's parent, which comes first; -1 = it has none, or none is known."""
    poses: Array
    """Poses (pose7) of the joints in the world, shape [T, J, 7]; NaN where the body was absent."""
    scale: float = 1.0
    """Scale of the joint frames."""
    inverse_bind: Array
    """Matrices from the rest mesh to the joint frames, shape [J, 4, 4]."""
    influences: Influences


@dataclass(frozen=True, kw_only=True, eq=False)
class PosedPart:
    """Visible part of a scene."""

    name: str
    mesh: Mesh
    """Mesh in its own frame [m]; that of a body with a skeleton in the rest pose."""
    poses: Array
    """Pose (pose7) from mesh to world, shape [T, 7], or [1, 7] of a static part; NaN where it was absent. Of a part
    with a skeleton, the pose of its root."""
    scale: Array = field(default_factory=lambda: np.ones(3))
    semantic_id: int = 0
    agent: int = -1
    """Index of the agent of the part; -1 = none."""
    body: Body | None = None
    """Body of the recording that this part shows; None if it shows the model of its agent."""
    placeholder: bool = False
    """True if the file of the mesh was not found."""
    skeleton: Skeleton | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class PosedCamera:
    """A camera on an agent or a body."""

    name: str
    poses: Array
    """Poses (pose7) [T, 7] in the world: x right, y up, looking along -z, as Habitat and glTF have it; NaN where absent."""
    vfov_rad: float
    aspect: float
    """Width divided by height."""
    near_m: float


def spans(there: Sequence[bool] | NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first step of each run of True in ``there`` [T], and the first step after it."""
    # with an edge on both sides, also runs at the ends have a beginning and an end
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.asarray(there, np.int8), [0]])))
    return [(int(start), int(end)) for start, end in edges.reshape(-1, 2)]
