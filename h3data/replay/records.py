"""What a replay is made of: things that can be drawn, how each of them moves, where everything was, cameras and their ways."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
from h3data.recording import Body
from h3data.render.camera import Camera
from h3data.scene import Mesh

if TYPE_CHECKING:
    from h3data.habitat.skinned_meshes import SkinnedMesh


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawable:
    """One thing that can be drawn. Its position in `Replay.drawables` is its instance id in pictures."""

    name: str
    mesh: Mesh
    matrix: Array
    """4x4 mesh frame to world, scale included; of a moving thing, at its first step."""
    layer: str = ""
    semantic_id: int = 0
    agent: int = -1
    """Index of the agent that it belongs to; -1 = none."""
    moving: bool = False
    deformable: bool = False
    """Its vertices change and are given in the world frame (skinned bodies)."""
    placeholder: bool = False
    """A stand-in: the recorded asset was not found."""


@dataclass(frozen=True, eq=False)
class BodyTrack:
    """A rigid body with a recorded track."""

    column: int
    scale: NDArray[np.float32]


@dataclass(frozen=True)
class LinkTrack:
    """A link of a robot that is drawn by its model."""

    agent: int
    link: int


@dataclass(frozen=True)
class PersonTrack:
    """A humanoid that is drawn by its model."""

    agent: int


@dataclass(frozen=True, eq=False)
class RigTrack:
    """A body whose mesh follows recorded bones."""

    body: Body
    column: str
    bones: tuple[str, ...]
    skin: SkinnedMesh


Track = BodyTrack | LinkTrack | PersonTrack | RigTrack


@dataclass(frozen=True, eq=False)
class State:
    """Where everything was at one step."""

    step: int
    time_s: float
    poses: dict[str, NDArray[np.float64]] = field(repr=False)
    """4x4 in the world by name, scale included; things that were not in the world then are left out."""
    agents: dict[str, dict[str, Any]]
    """Per agent: every recorded column of it at this step."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraTrack:
    """A camera and where it is at every step."""

    camera: Camera
    poses: Array
    """4x4 camera to world, shape [T, 4, 4]; [1, 4, 4] for one that stands still."""
    nears: Array | None = None
    """What is nearer than this is cut away [T] [m], as `Camera.near`; None: as ``camera`` has it."""

    def at(self, step: int) -> Camera:
        """The camera at one step."""
        camera = self.camera.at(self.poses[min(step, len(self.poses) - 1)])
        return camera if self.nears is None else replace(camera, near=float(self.nears[step]))
