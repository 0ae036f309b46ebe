"""Records of a replay: drawables and their tracks, states, and camera tracks."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.geometry import Array
from h3data.recording import Body
from h3data.render.camera import Camera
from h3data.scene import Mesh

if TYPE_CHECKING:
    from h3data.recording.assets.skinned_meshes import SkinnedMesh


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawable:
    """Object that is rendered, whose index in `Replay.drawables` is its id in instance images."""

    name: str
    mesh: Mesh
    matrix: Array
    """Matrix 4x4 from mesh to world, scale included; for moving objects, at the first step."""
    layer: str = ""
    semantic_id: int = 0
    agent: int = -1
    """Index of the agent to which the object belongs; -1 = none."""
    moving: bool = False
    deformable: bool = False
    """True if the object's vertices change and are in the world frame (skinned bodies)."""
    placeholder: bool = False
    """True if the object replaces an asset that was not found."""


@dataclass(frozen=True, eq=False)
class BodyTrack:
    """Motion of a rigid body with recorded poses."""

    column: int
    scale: NDArray[np.float32]


@dataclass(frozen=True)
class LinkTrack:
    """Motion of a robot's link, or of a rigid part of a person, from the poses of the model."""

    agent: int
    link: int


@dataclass(frozen=True)
class PersonTrack:
    """Motion of a person who is rendered from a humanoid model."""

    agent: int


@dataclass(frozen=True, eq=False)
class RigTrack:
    """Motion of a body whose mesh follows recorded bones."""

    body: Body
    column: str
    bones: tuple[str, ...]
    skin: SkinnedMesh


@dataclass(frozen=True)
class JointTrack:
    """Motion of a door, a drawer or an object in it with a joint of the home."""

    joint: int
    """Index of the joint in ``scene.joint_pos``."""


Track = BodyTrack | LinkTrack | PersonTrack | RigTrack | JointTrack


@dataclass(frozen=True, eq=False)
class State:
    """State of a recording at one step."""

    step: int
    time_s: float
    poses: dict[str, NDArray[np.float64]] = field(repr=False)
    """Matrices 4x4 from each object's mesh to the world, by name, scale included; absent objects are left out."""
    agents: dict[str, dict[str, Any]]
    """All recorded columns of each agent at this step, by agent name."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraTrack:
    """Camera with its pose at every step."""

    camera: Camera
    poses: Array
    """Matrices 4x4 from camera to world, shape [T, 4, 4]; [1, 4, 4] for a static camera."""
    nears: Array | None = None
    """`Camera.near` at every step, shape [T] [m]; None if it is ``camera.near`` at all steps."""
    crops: bool = True
    """True if `resized` may cut off the top and bottom of the image; False for views that must contain the whole
    home."""

    def at(self, step: int) -> Camera:
        """Return the camera at one step."""
        # a static camera has one pose
        camera = self.camera.at(self.poses[min(step, len(self.poses) - 1)])
        return camera if self.nears is None else replace(camera, near=float(self.nears[step]))

    def resized(self, width: int, height: int) -> CameraTrack:
        """Return the same track with another image size [px], as `Camera.resized` does."""
        return replace(self, camera=self.camera.resized(width, height, crop=self.crops))


def forward_fill(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rows [T, n] with rows that contain NaN (absent agents) replaced by the last finite row, or the first at the start.

    Raises:
        InputError: no row is finite.
    """
    finite = np.isfinite(values).all(-1)
    if not finite.any():
        raise InputError("This camera has no pose at any step.", code="H3-REPLAY-029")
    last = np.maximum.accumulate(np.where(finite, np.arange(len(values)), -1))
    return values[np.where(last < 0, np.argmax(finite), last)]
