"""Pinhole cameras. Inside h3data: OpenCV frame (x right, y down, z forward), pixel centres at +0.5, depth along z [m]."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.geometry import normalized


@dataclass(frozen=True, kw_only=True, eq=False)
class Camera:
    """Intrinsics, size and pose of one view."""

    name: str = "camera"
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    pose: NDArray[np.float64]
    """4x4, camera (OpenCV) to world."""
    hidden_layers: tuple[str, ...] = ()
    """Instances in these layers are left out, e.g. ``("ceiling",)`` in views from above."""

    def at(self, pose: ArrayLike) -> Camera:
        """The same camera at another pose [4, 4]."""
        return replace(self, pose=np.asarray(pose, np.float64))

    def __repr__(self) -> str:
        return f"Camera({self.name!r}, {self.width}x{self.height}, hFOV {self.hfov_deg:.1f} deg)"

    @property
    def hfov_deg(self) -> float:
        """Horizontal field of view [deg]."""
        return float(np.degrees(2 * np.arctan(self.width / 2 / self.fx)))

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """3x3 camera matrix K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    def to_camera(self, points: ArrayLike) -> NDArray[np.float64]:
        """World points [N, 3] in the camera's frame, shape [N, 3] [m]."""
        p = np.asarray(points, np.float64).reshape(-1, 3)
        return (p - self.pose[:3, 3]) @ self.pose[:3, :3]

    def project(self, points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where world points [N, 3] appear: pixel coordinates [N, 2] and z-depth [N] [m].

        The first pixel's centre is (0.5, 0.5). Points at or behind the camera's plane (z <= 0) get NaN pixels.
        """
        p = self.to_camera(points)
        z = np.where(p[:, 2] > 0, p[:, 2], np.nan)[:, None]
        return p[:, :2] / z * (self.fx, self.fy) + (self.cx, self.cy), p[:, 2]


def pinhole(
    width: int,
    height: int,
    *,
    hfov_deg: float,
    name: str = "camera",
    pose: ArrayLike | None = None,
    hidden_layers: tuple[str, ...] = (),
) -> Camera:
    """A camera with square pixels and centred principal point, as Habitat's sensors (spec/habitat.md 1.5).

    ``width`` x ``height`` in pixels; ``hfov_deg`` spans the width.
    """
    f = width / 2 / float(np.tan(np.radians(hfov_deg) / 2))
    matrix = np.eye(4) if pose is None else np.asarray(pose, np.float64)
    return Camera(
        name=name,
        width=width,
        height=height,
        fx=f,
        fy=f,
        cx=width / 2,
        cy=height / 2,
        pose=matrix,
        hidden_layers=hidden_layers,
    )


def look_at(eye: ArrayLike, target: ArrayLike, *, up: ArrayLike = (0.0, 1.0, 0.0)) -> NDArray[np.float64]:
    """4x4 camera (OpenCV) to world, at ``eye`` and looking at ``target``; ``up`` is the world direction shown upwards.

    If the view is along ``up``, the picture's upper edge points to -Z.
    """
    eye, target, up = (np.asarray(v, np.float64) for v in (eye, target, up))
    forward = normalized(target - eye)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(forward, np.array([0.0, 0.0, -1.0]))
    right = normalized(right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(forward, right), forward, eye
    return pose


OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""Right-multiply an OpenGL / Habitat camera pose (x right, y up, looks along -z) by this to get ours, and back."""
