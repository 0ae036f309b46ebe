"""Observations of agents as pure functions on arrays with any leading axes (worlds first), in float64 and SI units.

Functions with the argument ``xp``, an array namespace, are the same on the CPU (``numpy``) and on a device (``torch``),
where all arguments are tensors. `sim_kinematic.sensing.table` makes sensors of these functions. Places on the floor are
``(x, z)``, and headings follow h3data docs conventions. Where Habitat has the same sensor, the values are Habitat's,
and tests/sim/sensing/test_sensors.py compares them with outputs of its code. All values are exact; `with_noise` and
`depth_with_noise` add noise. Pictures are in `sim_kinematic.sensing.camera_sensor`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies import Humanoid
from h3data.errors import InputError
from h3data.geometry import Array, quat_conjugate, quat_rotate, wrap_angle
from h3data.kernels import kernel
from sim_kinematic.motion.spec import STEP_S

if TYPE_CHECKING:
    from h3data.scene import FreeSpace


HUMAN_ID = Humanoid.semantic_id
"""Semantic id of people, in Habitat and in h3data's recordings."""
DETECTED_PIXELS = 1000
"""Number of pixels above which a person counts as detected in a picture, as in Habitat."""
DEPTH_RANGE_M = (0.0, 10.0)
"""Range to which observed depth is clipped before it is scaled to 0..1, as in Habitat [m]."""
FAR_M = 1000.0
"""Length that stands for a path that does not exist [m]; it is larger than any home."""
FAST = 10.0
"""Bound of observed velocities [m/s, rad/s], which is four times the robot's limits."""
RANGES = 12
"""Number of rays of `range_scan`, one every 30 degrees."""
RANGE_M = 2.0
"""Largest distance that `range_scan` measures [m]."""


def scaled_depth(depth: Any, limits_m: tuple[float, float] = DEPTH_RANGE_M) -> Any:
    """Return the depth [m], an array or a tensor of any shape, clipped to ``limits_m`` and scaled to 0..1."""
    near, far = limits_m
    return (depth.clip(near, far) - near) / (far - near)


# --- where things are ---------------------------------------------------------------------------------------------------
def stacked(xp: Any, *columns: Any) -> Any:
    """Return columns [...] of numbers side by side, [..., n]; on the CPU all columns but the first may be numbers."""
    if xp is not np:
        return xp.stack(columns, -1)
    # for a few numbers `np.stack` takes three times as long
    out = np.empty((*columns[0].shape, len(columns)))
    for k, column in enumerate(columns):
        out[..., k] = column
    return out


def _wrapped(xp: Any, angle: Any) -> Any:
    """Return angles in [-pi, pi)."""
    if xp is np:
        return wrap_angle(np.asarray(angle, np.float64))
    # unlike a remainder, this leaves small angles of 32 bits as they are
    return angle - 2.0 * math.pi * xp.floor(angle / (2.0 * math.pi) + 0.5)


def in_base_frame(robot_xz: Any, heading: Any, point_xz: Any, *, xp: Any = np) -> Any:
    """Transform points ``(x, z)`` [..., 2] [m] to coordinates ``(forward, left)`` [..., 2] [m] of a base.

    The base is at ``robot_xz`` [..., 2] [m] with heading [...] [rad].
    """
    if xp is np:
        gap, heading = _gaps(robot_xz, heading, point_xz)
        return _in_frames(gap.reshape(-1, 2), heading.reshape(-1)).reshape(gap.shape)
    # forward is (x, z) on the floor, so left is (z, -x)
    gap, x, z = point_xz - robot_xz, xp.cos(heading), -xp.sin(heading)
    return stacked(xp, gap[..., 0] * x + gap[..., 1] * z, gap[..., 0] * z - gap[..., 1] * x)


def _gaps(xz: ArrayLike, heading: ArrayLike, other_xz: ArrayLike) -> tuple[Array, Array]:
    """Return vectors [..., 2] from places to others, and headings [...] of the same shape, or one for all of them."""
    gap, heading = np.asarray(other_xz, np.float64) - np.asarray(xz, np.float64), np.asarray(heading, np.float64)
    if (heading.size > 1 or heading.ndim >= gap.ndim) and gap.shape[:-1] != heading.shape:
        shape = np.broadcast_shapes(gap.shape[:-1], heading.shape)
        gap, heading = np.broadcast_to(gap, (*shape, 2)), np.broadcast_to(heading, shape)
    # the kernels below are compiled for C order
    return np.asarray(gap, order="C"), np.asarray(heading, order="C")


@kernel(error_model="numpy")
def _in_frames(gap, heading):
    """Return vectors [N, 2] in base frames with headings [N or 1].

    It is compiled as `_facing` is: for a few vectors NumPy is five times slower.
    """
    out, last = np.empty_like(gap), len(heading) - 1
    for n in range(len(gap)):
        x, z = math.cos(heading[min(n, last)]), -math.sin(heading[min(n, last)])
        out[n, 0], out[n, 1] = gap[n, 0] * x + gap[n, 1] * z, gap[n, 0] * z - gap[n, 1] * x
    return out


def gps_compass(robot_xz: Any, heading: Any, point_xz: Any, *, xp: Any = np) -> Any:
    """Return the polar positions of points: ``(distance [m], angle [rad])`` [..., 2]; angles are positive to the RIGHT.

    For a person this is Habitat's ``goal_to_agent_gps_compass``, the humanoid GPS of the paper. For a navigation goal
    it is Habitat's point-goal, and for objects and their goals ``obj_start_gps_compass`` and ``obj_goal_gps_compass``.
    """
    seen = in_base_frame(robot_xz, heading, point_xz, xp=xp)
    ahead, left = seen[..., 0], seen[..., 1]
    # minus, as in Habitat, whose angle is -atan2 in a base frame with y to the left (spec/habitat.md 1.5)
    return stacked(xp, xp.hypot(ahead, left), -xp.arctan2(left, ahead))


def other_agent_gps(own_xz: Any, other_xz: Any, *, xp: Any = np) -> Any:
    """Return an agent's position minus the other's in world axes ``(x, z)``, [..., 2] [m], as in Habitat."""
    if xp is np:
        own_xz, other_xz = np.asarray(own_xz, np.float64), np.asarray(other_xz, np.float64)
    return own_xz - other_xz


def agents_within_threshold(
    own_xz: Any,
    heading: Any,
    other_xz: Any,
    *,
    # Habitat's half axes; the paper gives 1.5 m without an ellipse (spec/habitat.md 2.1)
    ahead_m: float = 2.0,
    aside_m: float = 1.5,
    xp: Any = np,
) -> Any:
    """Return whether the other agent is in an ellipse around the base, bool [...].

    The half axes of the ellipse are ``ahead_m`` and ``aside_m`` [m].
    """
    seen = in_base_frame(own_xz, heading, other_xz, xp=xp)
    return (seen[..., 0] / ahead_m) ** 2 + (seen[..., 1] / aside_m) ** 2 < 1.0


def localization(xz: Any, heading: Any, floor_y: Any = 0.0, *, xp: Any = np) -> Any:
    """Return the pose ``(x, y, z, heading)`` [..., 4] of a base in the world, with the heading in [-pi, pi)."""
    place: Any = np.asarray(xz, np.float64) if xp is np else xz
    return stacked(xp, place[..., 0], floor_y, place[..., 1], _wrapped(xp, heading))


def localization_in_start_frame(start_xz: Any, start_heading: Any, xz: Any, heading: Any, *, xp: Any = np) -> Any:
    """Return the pose ``(x, y, z, heading)`` [..., 4] of a base in the agent root frame of its start.

    In this frame x is forward, y up and z to the right.
    """
    seen = in_base_frame(start_xz, start_heading, xz, xp=xp)
    # the root frame's z points to the right, and base frames have left positive
    return stacked(xp, seen[..., 0], xp.zeros_like(seen[..., 0]), -seen[..., 1], _turned(xp, start_heading, heading))


def _turned(xp: Any, before: Any, now: Any) -> Any:
    """Return the change of a heading, in [-pi, pi)."""
    if xp is np:
        before, now = np.asarray(before, np.float64), np.asarray(now, np.float64)
    return _wrapped(xp, now - before)


def in_frame(pose: ArrayLike, points: ArrayLike) -> Array:
    """Return world points [..., K, 3] in the frame of a pose7 [..., 7], as [..., K, 3] [m].

    With the robot's start pose, these are the object and goal positions in its start frame (paper appendix). With the
    hand's pose, they are Habitat's ``obj_start_sensor`` and ``obj_goal_sensor``.
    """
    # one more axis, so that one pose goes with all K points
    p = np.asarray(pose, np.float64)[..., None, :]
    return np.asarray(quat_rotate(quat_conjugate(p[..., 3:]), np.asarray(points, np.float64) - p[..., :3]))


def humanoid_velocity(robot_heading: Any, before_xz: Any, xz: Any, *, dt: float = STEP_S, xp: Any = np) -> Any:
    """Return the velocity of a person along the axes of a robot's base: ``(forward, left)`` [..., 2] [m/s].

    The velocity is measured over the ground, not relative to the robot.

    Args:
        robot_heading: heading of the base [...] [rad].
        before_xz: position of the person one step ago [..., 2] [m].
        xz: position now [..., 2] [m].
        dt: duration of a step [s].
        xp: array namespace.
    """
    # where the person was stands in for the base, which only lends its axes
    return in_base_frame(before_xz, robot_heading, xz, xp=xp) / dt


def way(xz: Any, heading: Any, length_m: Any, point_xz: Any, *, xp: Any = np) -> Any:
    """Return the shortest path from a base on the map, as ``(length [m], initial angle [rad])`` [..., 2].

    The angle is the direction of a point on the path [..., 2] (`first_point`), positive to the RIGHT. ``length_m``
    [...] is the length from `FreeSpace.geodesic`; a path that does not exist counts as `FAR_M` long and straight ahead.
    """
    angle = gps_compass(xz, heading, point_xz, xp=xp)[..., 1]
    return stacked(xp, length_m.clip(None, FAR_M), xp.where(xp.isfinite(length_m), angle, 0.0))


def first_point(free: FreeSpace, xz: Array, goal_xz: ArrayLike, length_m: float, *, beyond_m: float) -> Array:
    """Return the first waypoint from ``xz`` [2] to ``goal_xz`` [2] that is farther than ``beyond_m``, [2] [m].

    The result is ``xz`` if there is no path, in which case ``length_m`` is infinite.
    """
    return free.next_waypoint(xz, goal_xz, beyond_m=beyond_m) if np.isfinite(length_m) else xz


def path_points(
    free: FreeSpace, xz: ArrayLike, goal_xz: ArrayLike, lengths_m: Sequence[float], *, max_snap_m: float
) -> Array:
    """Return the points at given lengths [n] of the shortest path from ``xz`` [2] to ``goal_xz`` [2], [n, 2] [m].

    If the path is shorter than a length, the point is its end. If there is no path, the points are on the straight
    line.
    """
    path = free.path(xz, goal_xz, max_snap_m=max_snap_m)
    if len(path) < 2:
        path = np.array([xz, goal_xz], np.float64)
    walked = np.append(0.0, np.hypot(*np.diff(path, axis=0).T).cumsum())
    return np.stack([np.interp(lengths_m, walked, path[:, axis]) for axis in range(2)], -1)


def range_scan(clearance: Callable[[Any], Any], xz: Any, heading: Any, *, xp: Any = np) -> Any:
    """Return the free distance around bases [..., 2] that a laser scanner in their middle measures, [..., RANGES] [m].

    ``clearance`` returns the distance [..., RANGES] [m] of points [..., RANGES, 2] to the nearest obstacle, negative
    inside one, as `FreeSpace.signed_distance` does. The first direction is straight ahead, and the others follow to the
    LEFT. Distances are at most `RANGE_M`; people are not seen. The method is sphere tracing (Hart, 1996) with eight
    strides: a ray that grazes a wall may end too early.
    """
    if xp is np:
        xz, heading = np.asarray(xz, np.float64), np.asarray(heading, np.float64)
    along = stacked(xp, *(heading + 2 * np.pi / RANGES * k for k in range(RANGES)))
    direction, start = stacked(xp, xp.cos(along), -xp.sin(along)), xz[..., None, :]
    reach = xp.zeros_like(along)
    # number of strides of sphere tracing, with which 95% of rays in furnished homes are right within 3 cm
    strides = 8
    # a stride as long as the distance to the nearest obstacle cannot enter one
    for _ in range(strides):
        left = clearance(start + reach[..., None] * direction)
        reach = (reach + left.clip(0.0, None)).clip(None, RANGE_M)
    return reach


# --- the robot itself ---------------------------------------------------------------------------------------------------
def egomotion(
    before_xz: Any,
    before_heading: Any,
    xz: Any,
    heading: Any,
    *,
    dt: float = STEP_S,
    xp: Any = np,
) -> Any:
    """Return a base's velocity in its frame before the step: ``(forward [m/s], left [m/s], turn [rad/s])`` [..., 3]."""
    # by the old heading, along which `integrate` moves, so that a turn adds no part to the left
    moved = in_base_frame(before_xz, before_heading, xz, xp=xp)
    return stacked(xp, moved[..., 0], moved[..., 1], _turned(xp, before_heading, heading)) / dt


# --- the person in a picture --------------------------------------------------------------------------------------------
class Detection(NamedTuple):
    """Output of the humanoid detector for pictures [..., H, W]."""

    found: NDArray[np.float32]
    """1 if more than `DETECTED_PIXELS` pixels show a person, else 0, shape [...]."""
    mask: NDArray[np.float32]
    """1 in the pixels that show a person, else 0, shape [..., H, W]."""
    box: NDArray[np.float32]
    """1 in the rectangle around the pixels that show a person, else 0, shape [..., H, W]. As in Habitat, the last row
    and the last column of the rectangle are left out."""


def detect_humanoids(
    ids: ArrayLike, human: int | tuple[int, ...] = HUMAN_ID, *, more_than_pixels: int = DETECTED_PIXELS
) -> Detection:
    """Apply the humanoid detector to pictures of ids [..., H, W].

    The pictures are ``semantic`` pictures by default, or ``instance`` pictures if ``human`` has the ids of the people
    in them.
    """
    mask = np.isin(np.asarray(ids), human)
    if mask.ndim < 2:
        raise InputError(f"Expected pictures [..., H, W] of ids, got shape {list(mask.shape)}.", code="H3-SIM-049")
    rows, columns = mask.any(-1), mask.any(-2)
    # Habitat fills bbox[rmin:rmax, cmin:cmax], which leaves out the last of each (spec/habitat.md 1.5)
    box = _but_last(rows)[..., :, None] & _but_last(columns)[..., None, :]
    found = mask.sum((-2, -1)) > more_than_pixels
    return Detection(found.astype(np.float32), mask.astype(np.float32), box.astype(np.float32))


def _but_last(used: ArrayLike) -> NDArray[np.bool_]:
    """Return what lies from the first True of each line [..., n] up to the last one, which is left out, [..., n]."""
    used = np.asarray(used, np.bool_)
    begun = np.logical_or.accumulate(used, axis=-1)
    later = np.logical_or.accumulate(used[..., ::-1], axis=-1)[..., ::-1]
    return begun & np.concatenate([later[..., 1:], np.zeros_like(later[..., :1])], axis=-1)


def facing(xz: Any, heading: Any, other_xz: Any, *, xp: Any = np) -> Any:
    """Return the cosine [...] between an agent's forward axis and the direction to a point; 0 where they coincide."""
    if xp is np:
        gap, heading = _gaps(xz, heading, other_xz)
        # `[()]` makes a number of an array without axes and leaves others as they are
        return _facing(gap.reshape(-1, 2), heading.reshape(-1)).reshape(gap.shape[:-1])[()]
    gap = other_xz - xz
    straight = xp.hypot(gap[..., 0], gap[..., 1])
    ahead = gap[..., 0] * xp.cos(heading) + gap[..., 1] * -xp.sin(heading)
    return ahead / xp.where(straight > 0.0, straight, 1.0)


@kernel(error_model="numpy")
def _facing(gap, heading):
    """Return cosines [N] between headings [N or 1] and vectors [N, 2].

    The function is compiled, because every step of social navigation calls it.
    """
    out, last = np.empty(len(gap)), len(heading) - 1
    for n in range(len(gap)):
        dx, dz, angle = gap[n, 0], gap[n, 1], heading[min(n, last)]
        length = math.sqrt(dx * dx + dz * dz)
        length = length if length > 0.0 else 1.0
        out[n] = 0.0 + math.cos(angle) * (dx / length) - math.sin(angle) * (dz / length)
    return out


# --- noise: off unless called -------------------------------------------------------------------------------------------
NoiseModel = Callable[..., ArrayLike]
"""Function ``model(values, rng=rng)`` that adds noise to the exact values of a sensor, such as `depth_with_noise` and
``partial(with_noise, sigma=0.05)``."""


def with_noise(values: ArrayLike, sigma: ArrayLike, rng: np.random.Generator) -> Array:
    """Return values with Gaussian noise of a standard deviation, one for all or one per value, in their unit."""
    exact = np.asarray(values, np.float64)
    return exact + np.asarray(sigma, np.float64) * rng.standard_normal(exact.shape)


def depth_with_noise(
    depth: ArrayLike, rng: np.random.Generator, *, base_m: float = 0.0012, growth: float = 0.0019, missing: float = 0.0
) -> NDArray[np.float32]:
    """Add the axial noise of a structured-light camera to depth [...] [m].

    sigma = base + growth (d - 0.4)^2 (Nguyen, Izadi and Lovell, "Modeling Kinect sensor noise", 2012). ``missing`` is
    the share of pixels that are lost (0). Pixels without depth stay 0.
    """
    d = np.asarray(depth, np.float64)
    noisy = d + (base_m + growth * (d - 0.4) ** 2) * rng.standard_normal(d.shape)
    lost = rng.random(d.shape) < missing
    return np.where((d <= 0) | lost, 0.0, np.maximum(noisy, 0.0)).astype(np.float32)
