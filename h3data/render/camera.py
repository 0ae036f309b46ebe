"""Cameras of four kinds: perspective, orthographic, fisheye and equirectangular.

h3data uses the OpenCV frame (x right, y down, z forward) with pixel centres at +0.5; `CONVENTIONS` converts other frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.geometry import cross, normalized

Projection = Literal["perspective", "orthographic", "fisheye", "equirectangular"]
Convention = Literal["opencv", "opengl", "habitat"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Camera:
    """Camera with intrinsics, image size and pose."""

    name: str = "camera"
    width: int
    height: int
    fx: float
    """Focal length along x: pixels per unit at z = 1 (perspective), per metre (orthographic) or per radian (fisheye,
    equirectangular)."""
    fy: float
    cx: float
    cy: float
    pose: NDArray[np.float64]
    """Matrix 4x4 from the frame of the camera (OpenCV) to the world."""
    hidden_layers: tuple[str, ...] = ()
    """Layers whose instances are hidden, e.g. ``("ceiling",)`` in views from above."""
    projection: Projection = "perspective"
    near: float = 0.0
    """Depth below which surfaces are cut away [m]; 0 shows everything in front of the camera's plane."""
    far: float = float("inf")
    """Depth beyond which surfaces count as misses [m]."""

    def at(self, pose: ArrayLike) -> Camera:
        """Return a camera with the same lens at another pose [4, 4], camera to world."""
        return replace(self, pose=np.asarray(pose, np.float64))

    def resized(self, width: int, height: int, *, crop: bool = True) -> Camera:
        """Return the same camera with another image size [px].

        Its axis does not change, and square pixels stay square; an equirectangular camera keeps both fields of view.

        Args:
            width: new width of the image [px].
            height: new height of the image [px].
            crop: True to keep the horizontal field of view, so that a flatter image loses its top and bottom. Otherwise
                the new image contains everything in view, and may have a larger field of view.
        """
        across, down = width / self.width, height / self.height
        # a panorama spans all angles in both directions, so its two scales are those of its sides
        if self.projection != "equirectangular":
            across = down = across if crop else min(across, down)
        cx = width / 2 + (self.cx - self.width / 2) * across
        cy = height / 2 + (self.cy - self.height / 2) * down
        return replace(self, width=width, height=height, fx=self.fx * across, fy=self.fy * down, cx=cx, cy=cy)

    def __repr__(self) -> str:
        view = f"hFOV {self.hfov_deg:.1f} deg"
        if self.projection == "orthographic":
            view = f"orthographic, {self.width / self.fx:.2f} m wide"
        elif self.projection != "perspective":
            view = f"{self.projection}, {view}"
        return f"Camera({self.name!r}, {self.width}x{self.height}, {view})"

    @property
    def hfov_deg(self) -> float:
        """Horizontal field of view [deg]; 0 for orthographic cameras."""
        if self.projection == "orthographic":
            return 0.0
        # pixels of a fisheye and a panorama are angles themselves
        half = self.width / 2 / self.fx
        return float(np.degrees(2 * (np.arctan(half) if self.projection == "perspective" else half)))

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """Return the 3x3 camera matrix K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    def checked(self) -> Camera:
        """Return this camera after checking that it can render.

        Raises:
            InputError: its parameters are invalid; the message lists all faults.
        """
        faults = []
        if self.width < 1 or self.height < 1:
            faults.append(f"size {self.width}x{self.height}")
        k = np.array([self.fx, self.fy, self.cx, self.cy], np.float64)
        if not (np.isfinite(k).all() and k[0] > 0 and k[1] > 0):
            faults.append(f"fx fy cx cy {k.tolist()}")
        pose = np.asarray(self.pose, np.float64)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            faults.append("a pose that is not a finite 4x4 matrix")
        elif np.abs(pose[:3, :3].T @ pose[:3, :3] - np.eye(3)).max() > 1e-4:
            faults.append("a pose whose axes are not orthogonal and of unit length")
        if not 0 <= self.near < self.far:
            faults.append(f"near {self.near} and far {self.far} (expected 0 <= near < far)")
        if self.projection not in get_args(Projection):
            faults.append(f"projection {self.projection!r} (expected one of: {', '.join(get_args(Projection))})")
        if faults:
            raise InputError(f"Camera {self.name!r} cannot be used, it has: {'; '.join(faults)}.", code="H3-RENDER-009")
        return self

    # --- points and rays ----------------------------------------------------------------------------------------------
    def to_camera(self, points: ArrayLike) -> NDArray[np.float64]:
        """Transform world points [N, 3] into the camera's frame, shape [N, 3] [m]."""
        return (np.asarray(points, np.float64).reshape(-1, 3) - self.pose[:3, 3]) @ self.pose[:3, :3]

    def project(self, points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the pixel coordinates [N, 2] and depth [N] [m] of world points [N, 3].

        The centre of the first pixel is (0.5, 0.5). Depth is along z; for fisheye and equirectangular cameras it is the
        distance. Points at or behind the plane of a perspective camera (z <= 0) get NaN pixels.
        """
        p = self.to_camera(points)
        return self.to_pixels(p), p[:, 2] if self.is_planar else np.linalg.norm(p, axis=1)

    def to_pixels(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pixel coordinates [N, 2] of points [N, 3] in the camera's frame.

        `project` does the same for world points.
        """
        x, y, z = points.T
        if self.projection == "perspective":
            # dividing by a negative z would mirror points behind the eye into the picture
            ahead = np.where(z > 0, z, np.nan)
            u, v = x / ahead, y / ahead
        elif self.projection == "orthographic":
            u, v = x, y
        elif self.projection == "fisheye":
            across = np.hypot(x, y)
            # on the axis x and y are 0, so that any divisor gives the centre of the picture
            angle = np.arctan2(across, z) / np.where(across > 0, across, 1)
            u, v = x * angle, y * angle
        else:
            u, v = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))
        return np.stack([u * self.fx + self.cx, v * self.fy + self.cy], axis=-1)

    def rays(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Start and direction, each [H, W, 3], of the ray through each pixel's centre, in the camera's frame.

        A point at depth d lies at ``start + d * direction``. Directions are NaN outside a fisheye's image circle (more
        than 180 degrees off its axis).
        """
        v, u = np.mgrid[0 : self.height, 0 : self.width] + 0.5
        u, v = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        zero, one = np.zeros_like(u), np.ones_like(u)
        if self.projection == "perspective":
            return np.zeros((*u.shape, 3)), np.stack([u, v, one], -1)
        if self.projection == "orthographic":
            return np.stack([u, v, zero], -1), np.stack([zero, zero, one], -1)
        if self.projection == "fisheye":
            angle = np.hypot(u, v)
            sine = np.sinc(angle / np.pi)  # sin(angle) / angle
            directions = np.stack([u * sine, v * sine, np.cos(angle)], -1)
            directions[angle > np.pi] = np.nan
        else:
            directions = np.stack([np.sin(u) * np.cos(v), np.sin(v), np.cos(u) * np.cos(v)], -1)
        return np.zeros((*u.shape, 3)), directions

    @property
    def is_planar(self) -> bool:
        """Return whether straight lines stay straight and depth is along z (perspective and orthographic cameras)."""
        return self.projection in ("perspective", "orthographic")


# --- constructors -------------------------------------------------------------------------------------------------------
def pinhole(
    width: int,
    height: int,
    *,
    hfov_deg: float,
    name: str = "camera",
    pose: ArrayLike | None = None,
    hidden_layers: tuple[str, ...] = (),
    near: float = 0.0,
    far: float = float("inf"),
) -> Camera:
    """Return a perspective camera with square pixels and centred principal point, like Habitat's sensors.

    ``width`` x ``height`` are in pixels; ``hfov_deg`` spans the width.
    """
    if not 0 < hfov_deg < 180:
        raise InputError(
            f"The field of view of a perspective camera must be between 0 and 180 degrees, got {hfov_deg}.",
            code="H3-RENDER-003",
        )
    f = width / 2 / float(np.tan(np.radians(hfov_deg) / 2))
    return _centred(width, height, f, f, "perspective", name, pose, hidden_layers, near, far)


def orthographic(
    width: int,
    height: int,
    *,
    width_m: float,
    name: str = "camera",
    pose: ArrayLike | None = None,
    hidden_layers: tuple[str, ...] = (),
    near: float = 0.0,
    far: float = float("inf"),
) -> Camera:
    """Return a camera with parallel rays; the image is ``width_m`` [m] wide at any depth."""
    if not 0 < width_m < np.inf:
        raise InputError(
            f"The width of an orthographic view must be a positive number of metres, got {width_m}.",
            code="H3-RENDER-004",
        )
    f = width / width_m
    return _centred(width, height, f, f, "orthographic", name, pose, hidden_layers, near, far)


def fisheye(
    width: int,
    height: int,
    *,
    hfov_deg: float = 180.0,
    name: str = "camera",
    pose: ArrayLike | None = None,
    hidden_layers: tuple[str, ...] = (),
) -> Camera:
    """Return an equidistant fisheye (distance from the centre proportional to the angle); ``hfov_deg`` spans the width."""
    if not 0 < hfov_deg <= 360:
        raise InputError(
            f"The field of view of a fisheye must be above 0 and at most 360 degrees, got {hfov_deg}.",
            code="H3-RENDER-005",
        )
    f = width / float(np.radians(hfov_deg))
    return _centred(width, height, f, f, "fisheye", name, pose, hidden_layers)


def equirectangular(
    width: int,
    height: int = 0,
    *,
    name: str = "camera",
    pose: ArrayLike | None = None,
    hidden_layers: tuple[str, ...] = (),
) -> Camera:
    """Return a camera for panoramas of 360 degrees across and 180 degrees down.

    ``height`` defaults to half the width.
    """
    height = height or width // 2
    fx, fy = width / (2 * np.pi), height / np.pi
    return _centred(width, height, fx, fy, "equirectangular", name, pose, hidden_layers)


def _centred(
    width: int,
    height: int,
    fx: float,
    fy: float,
    projection: Projection,
    name: str,
    pose: ArrayLike | None,
    hidden_layers: tuple[str, ...],
    near: float = 0.0,
    far: float = float("inf"),
) -> Camera:
    """Return a camera with its principal point at the centre of the image."""
    return Camera(
        name=name,
        width=width,
        height=height,
        fx=fx,
        fy=fy,
        cx=width / 2,
        cy=height / 2,
        pose=np.eye(4) if pose is None else np.asarray(pose, np.float64),
        hidden_layers=hidden_layers,
        projection=projection,
        near=near,
        far=far,
    )


def camera_from_matrix(
    matrix: ArrayLike, width: int, height: int, *, name: str = "camera", pose: ArrayLike | None = None
) -> Camera:
    """Return a perspective camera with a calibrated 3x3 matrix K = [[fx 0 cx] [0 fy cy] [0 0 1]] [px].

    Raises:
        InputError: the matrix has another form: singular, skewed, not finite, or focal lengths that are not positive.
    """
    k = np.asarray(matrix, np.float64)
    if k.shape != (3, 3) or not np.isfinite(k).all():
        raise InputError(
            f"Expected a finite 3x3 camera matrix K, got shape {list(k.shape)}: {k.tolist()}.", code="H3-RENDER-006"
        )
    fx, fy = float(k[0, 0]), float(k[1, 1])
    if not (fx > 0 and fy > 0):
        raise InputError(
            f"This camera matrix is singular or mirrored: fx {fx:g}, fy {fy:g} must be positive.", code="H3-RENDER-007"
        )
    if abs(k[0, 1]) > 1e-9 * fx or np.any(k[1:, 0]) or np.any(k[2] != (0, 0, 1)):
        raise InputError(
            f"Expected K = [[fx 0 cx] [0 fy cy] [0 0 1]] without skew, got {k.tolist()}.", code="H3-RENDER-008"
        )
    eye = np.eye(4) if pose is None else np.asarray(pose, np.float64)
    return Camera(
        name=name, width=width, height=height, fx=fx, fy=fy, cx=float(k[0, 2]), cy=float(k[1, 2]), pose=eye
    ).checked()


# --- poses --------------------------------------------------------------------------------------------------------------
def look_at(eye: ArrayLike, target: ArrayLike, *, up: ArrayLike = (0.0, 1.0, 0.0)) -> NDArray[np.float64]:
    """Return the camera pose [4, 4] (OpenCV to world) at ``eye`` towards ``target``; ``up`` points upwards in the image.

    When looking along ``up``, the top of the image points towards -Z.
    """
    eye, target, up = (np.asarray(v, np.float64) for v in (eye, target, up))
    forward = normalized(target - eye)
    right = cross(forward, up)
    # the cross product of parallel directions has no direction of its own
    if np.linalg.norm(right) < 1e-6:
        right = cross(forward, np.array([0.0, 0.0, -1.0]))
    right = normalized(right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, cross(forward, right), forward, eye
    return pose


OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""Matrix that converts camera poses between OpenGL / Habitat (x right, y up, looking along -z) and OpenCV, in both
directions, when multiplied from the right."""
CONVENTIONS: dict[Convention, NDArray[np.float64]] = {
    "opencv": np.eye(4),
    "opengl": OPENGL_TO_OPENCV,
    "habitat": OPENGL_TO_OPENCV,
}
"""Matrix that converts a camera pose of each convention to OpenCV when multiplied from the right."""
