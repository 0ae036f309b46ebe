"""What the agents observe, as pure functions on arrays: any leading axes (worlds first), float64 in SI units.

Places on the floor are ``(x, z)``, headings as in h3data docs conventions. Where Habitat has the sensor, this is its value
(spec/habitat.md 1.5, 2.5); tests/sim/sensing/test_sensors.py compares them with outputs of the real code. All are exact;
noise is added by `with_noise` and `depth_with_noise`, where wanted. Pictures: `sim_kinematic.sensing.camera_sensor`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.geometry import heading_direction, quat_conjugate, quat_rotate, wrap_angle
from h3data.kernels import kernel
from sim_kinematic.motion.spec import STEP_S

if TYPE_CHECKING:
    from h3data.scene import FreeSpace

Floats = NDArray[np.floating]

HUMAN_ID = 100
"""Semantic id of people, in Habitat and in our recordings."""
DETECTED_PIXELS = 1000
"""A person is detected in a picture if more pixels than this show them (spec/habitat.md 1.5)."""
DEPTH_RANGE_M = (0.0, 10.0)
"""Observed depth is clipped to this range and scaled to 0..1 (spec/habitat.md 1.1, 1.5)."""
FAR_M = 1000.0
"""A way that does not exist counts as this long; no home reaches as far."""
FAST = 10.0
"""Bound of velocities [m/s, rad/s]: four times the robot's limits."""
RANGES = 12
"""Rays of `range_scan`, one every 30 degrees."""
RANGE_M = 2.0
"""Farthest that it measures."""
RANGE_STRIDES = 8
"""Of sphere tracing: 95 % of rays in furnished homes are then within 3 cm."""


def scaled_depth(depth: Any, limits_m: tuple[float, float] = DEPTH_RANGE_M) -> Any:
    """Depth [m], an array or a tensor of any shape, clipped to ``limits_m`` and scaled to 0..1."""
    near, far = limits_m
    return (depth.clip(near, far) - near) / (far - near)


# --- where things are ---------------------------------------------------------------------------------------------------
def in_base_frame(robot_xz: ArrayLike, heading: ArrayLike, point_xz: ArrayLike) -> Floats:
    """Points ``(x, z)`` [..., 2] as seen from a base at [..., 2] with heading [...]: ``(forward, left)`` [..., 2] [m]."""
    gap, heading = _gaps(robot_xz, heading, point_xz)
    return _in_frames(gap.reshape(-1, 2), heading.reshape(-1)).reshape(gap.shape)


def _gaps(xz: ArrayLike, heading: ArrayLike, other_xz: ArrayLike) -> tuple[Floats, Floats]:
    """Vectors [..., 2] from places to others, and headings [...] of the same shape, or one for all of them."""
    gap, heading = np.asarray(other_xz, np.float64) - np.asarray(xz, np.float64), np.asarray(heading, np.float64)
    if heading.ndim and gap.shape[:-1] != heading.shape:
        shape = np.broadcast_shapes(gap.shape[:-1], heading.shape)
        gap, heading = np.broadcast_to(gap, (*shape, 2)), np.broadcast_to(heading, shape)
    return np.asarray(gap, order="C"), np.asarray(heading, order="C")


@kernel(error_model="numpy")
def _in_frames(gap, heading):
    """Vectors [N, 2] in base frames with headings [N or 1]; compiled, as `_facing`: for a few NumPy is five times slower."""
    out, last = np.empty_like(gap), len(heading) - 1
    for n in range(len(gap)):
        x, z = math.cos(heading[min(n, last)]), -math.sin(heading[min(n, last)])
        out[n, 0], out[n, 1] = gap[n, 0] * x + gap[n, 1] * z, gap[n, 0] * z - gap[n, 1] * x
    return out


def gps_compass(robot_xz: ArrayLike, heading: ArrayLike, point_xz: ArrayLike) -> Floats:
    """Polar place of points: ``(distance [m], angle [rad])`` [..., 2]; the angle is positive to the RIGHT.

    Of a person this is Habitat's ``goal_to_agent_gps_compass``, the paper's humanoid GPS; of a navigation goal, its
    point-goal; of objects and goals its ``obj_start_gps_compass`` and ``obj_goal_gps_compass``.
    """
    seen = in_base_frame(robot_xz, heading, point_xz)
    ahead, left = seen[..., 0], seen[..., 1]
    out = np.empty(seen.shape)
    out[..., 0], out[..., 1] = np.hypot(ahead, left), -np.arctan2(left, ahead)
    return out


humanoid_gps = gps_compass
nav_goal = gps_compass


def other_agent_gps(own_xz: ArrayLike, other_xz: ArrayLike) -> Floats:
    """Own place minus the other's, world axes ``(x, z)`` [..., 2] [m], as in Habitat: without heading (spec/habitat.md 1.5)."""
    return np.asarray(own_xz, np.float64) - np.asarray(other_xz, np.float64)


def agents_within_threshold(
    own_xz: ArrayLike, heading: ArrayLike, other_xz: ArrayLike, *, ahead_m: float = 2.0, aside_m: float = 1.5
) -> NDArray[np.bool_]:
    """Whether the other agent is inside the ellipse with these half axes around the own base, bool [...]."""
    seen = in_base_frame(own_xz, heading, other_xz)
    return (seen[..., 0] / ahead_m) ** 2 + (seen[..., 1] / aside_m) ** 2 < 1.0


def localization(xz: ArrayLike, heading: ArrayLike, floor_y: ArrayLike = 0.0) -> Floats:
    """``(x, y, z, heading)`` [..., 4] of a base, the heading in [-pi, pi)."""
    xz = np.asarray(xz, np.float64)
    y = np.broadcast_to(np.asarray(floor_y, np.float64), xz.shape[:-1])
    turn = np.broadcast_to(wrap_angle(np.asarray(heading, np.float64)), xz.shape[:-1])
    return np.stack([xz[..., 0], y, xz[..., 1], turn], axis=-1)


def localization_in_start_frame(
    start_xz: ArrayLike, start_heading: ArrayLike, xz: ArrayLike, heading: ArrayLike
) -> Floats:
    """``(x, y, z, heading)`` [..., 4] of a base in the agent root frame that it began in: x forward, y up, z right."""
    seen = in_base_frame(start_xz, start_heading, xz)
    turn = wrap_angle(np.asarray(heading, np.float64) - np.asarray(start_heading, np.float64))
    return np.stack([seen[..., 0], np.zeros_like(seen[..., 0]), -seen[..., 1], turn], axis=-1)


def in_frame(pose: ArrayLike, points: ArrayLike) -> Floats:
    """World points [..., K, 3] in the frame of a pose7 [..., 7], shape [..., K, 3] [m].

    With the robot's start pose: object and goal positions in its start frame (paper appendix); with the hand's pose:
    Habitat's ``obj_start_sensor`` and ``obj_goal_sensor``.
    """
    p = np.asarray(pose, np.float64)[..., None, :]
    return np.asarray(quat_rotate(quat_conjugate(p[..., 3:]), np.asarray(points, np.float64) - p[..., :3]))


def humanoid_velocity(robot_heading: ArrayLike, before_xz: ArrayLike, xz: ArrayLike, *, dt: float = STEP_S) -> Floats:
    """Velocity of a person along the axes of a robot's base: ``(forward, left)`` [..., 2] [m/s].

    It is the velocity over the ground, not relative to the robot.

    Args:
        robot_heading: heading of the base [...] [rad].
        before_xz: position of the person one step ago [..., 2] [m].
        xz: position now [..., 2] [m].
        dt: duration of a step [s].
    """
    return in_base_frame(before_xz, robot_heading, xz) / dt


def way(
    free: FreeSpace, xz: ArrayLike, heading: float, goal_xz: ArrayLike, length_m: float, *, beyond_m: float
) -> Floats:  # fmt: skip
    """The shortest way from a base to ``goal_xz`` [2], by the map: ``(length [m], angle at which it begins [rad])`` [2].

    The angle is to the first way point farther than ``beyond_m``, positive to the RIGHT. ``length_m`` is that of
    `FreeSpace.geodesic`; a way that does not exist counts as `FAR_M`, straight ahead.
    """
    if not np.isfinite(length_m):
        return np.array([FAR_M, 0.0])
    point = free.next_waypoint(xz, goal_xz, beyond_m=beyond_m)
    return np.append(min(length_m, FAR_M), gps_compass(xz, heading, point)[1])


def path_points(
    free: FreeSpace, xz: ArrayLike, goal_xz: ArrayLike, lengths_m: Sequence[float], *, max_snap_m: float
) -> Floats:
    """Points on the shortest path from ``xz`` [2] to ``goal_xz`` [2], so far along it: [n, 2]; its end where it is shorter.

    Where there is no path they are on the straight line.
    """
    path = free.path(xz, goal_xz, max_snap_m=max_snap_m)
    if len(path) < 2:
        path = np.array([xz, goal_xz], np.float64)
    walked = np.append(0.0, np.hypot(*np.diff(path, axis=0).T).cumsum())
    return np.stack([np.interp(lengths_m, walked, path[:, axis]) for axis in range(2)], -1)


def range_scan(free: FreeSpace, xz: ArrayLike, heading: ArrayLike) -> Floats:
    """Free distance around bases [..., 2] as a laser scanner in their middle measures it, [..., RANGES] [m].

    The first direction is straight ahead, the others follow to the LEFT. Distances are at most `RANGE_M`; people are
    not seen. The method is sphere tracing in the distance grid (Hart, 1996) with `RANGE_STRIDES` strides: a ray that
    grazes a wall may end too early.
    """
    along = np.asarray(heading, np.float64)[..., None] + 2 * np.pi / RANGES * np.arange(RANGES)
    direction, start = heading_direction(along), np.asarray(xz, np.float64)[..., None, :]
    reach = np.zeros(along.shape)
    for _ in range(RANGE_STRIDES):
        left = free.signed_distance(start + reach[..., None] * direction)
        reach = np.minimum(reach + np.maximum(left, 0.0), RANGE_M)
    return reach


# --- the robot itself ---------------------------------------------------------------------------------------------------
def egomotion(
    before_xz: ArrayLike, before_heading: ArrayLike, xz: ArrayLike, heading: ArrayLike, *, dt: float = STEP_S
) -> Floats:
    """Velocity of a base in its frame before the step: ``(forward [m/s], left [m/s], turn [rad/s])`` [..., 3]."""
    moved = in_base_frame(before_xz, before_heading, xz)
    turn = wrap_angle(np.asarray(heading, np.float64) - np.asarray(before_heading, np.float64))
    out = np.empty((*moved.shape[:-1], 3))
    out[..., :2], out[..., 2] = moved, turn
    return out / dt


def arm_joints(joints: ArrayLike, columns: tuple[int, ...]) -> Floats:
    """Positions of the arm's joints [..., n] of all [..., J]; `h3data.bodies.Robot.arm_columns` names them."""
    return np.asarray(joints, np.float64)[..., list(columns)]


def is_holding(held_by: ArrayLike, agent: int = 0) -> Floats:
    """1 where the agent holds something, else 0, shape [...] of holders [..., O]."""
    return (np.asarray(held_by) == agent).any(axis=-1).astype(np.float64)


# --- the person in a picture --------------------------------------------------------------------------------------------
class Detection(NamedTuple):
    """Output of the humanoid detector for pictures [..., H, W]."""

    found: NDArray[np.float32]
    """1 where more than `DETECTED_PIXELS` pixels show a person, shape [...]."""
    mask: NDArray[np.float32]
    """1 in the pixels that do, shape [..., H, W]."""
    box: NDArray[np.float32]
    """1 in the rectangle around them, shape [..., H, W]. As in Habitat, without its last row and its last column."""


def detect_humanoids(
    ids: ArrayLike, human: int | tuple[int, ...] = HUMAN_ID, *, more_than_pixels: int = DETECTED_PIXELS
) -> Detection:
    """Applies the humanoid detector to pictures of ids [..., H, W].

    The ids are those of ``semantic`` with the default, or of ``instance`` with the numbers of the instances that are
    people.
    """
    mask = np.isin(np.asarray(ids), human)
    if mask.ndim < 2:
        raise InputError(f"Expected pictures [..., H, W] of ids, got shape {list(mask.shape)}.", code="H3-SIM-049")
    rows, columns = mask.any(-1), mask.any(-2)
    box = _but_last(rows)[..., :, None] & _but_last(columns)[..., None, :]
    found = mask.sum((-2, -1)) > more_than_pixels
    return Detection(found.astype(np.float32), mask.astype(np.float32), box.astype(np.float32))


def _but_last(used: ArrayLike) -> NDArray[np.bool_]:
    """From the first True of each line [..., n] up to the last, which is left out."""
    used = np.asarray(used, np.bool_)
    begun = np.logical_or.accumulate(used, axis=-1)
    later = np.logical_or.accumulate(used[..., ::-1], axis=-1)[..., ::-1]
    after = np.concatenate([later[..., 1:], np.zeros_like(later[..., :1])], axis=-1)
    return begun & after


def facing(xz: ArrayLike, heading: ArrayLike, other_xz: ArrayLike) -> Floats:
    """Cosine [...] between an agent's forward axis and the direction to a point; 0 where they coincide."""
    gap, heading = _gaps(xz, heading, other_xz)
    return _facing(gap.reshape(-1, 2), heading.reshape(-1)).reshape(gap.shape[:-1])[()]


@kernel(error_model="numpy")
def _facing(gap, heading):
    """Cosines [N] between headings [N or 1] and vectors [N, 2]; compiled: every step of social navigation asks for one."""
    out, last = np.empty(len(gap)), len(heading) - 1
    for n in range(len(gap)):
        dx, dz, angle = gap[n, 0], gap[n, 1], heading[min(n, last)]
        length = math.sqrt(dx * dx + dz * dz)
        length = length if length > 0.0 else 1.0
        out[n] = 0.0 + math.cos(angle) * (dx / length) - math.sin(angle) * (dz / length)
    return out


# --- noise: off unless called -------------------------------------------------------------------------------------------
NoiseModel = Callable[..., ArrayLike]
"""``model(values, rng=rng)``: exact values of a sensor with noise. `depth_with_noise` is one, and
``partial(with_noise, sigma=0.05)``."""


def with_noise(values: ArrayLike, sigma: ArrayLike, rng: np.random.Generator) -> Floats:
    """Values with Gaussian noise of this standard deviation (one, or one for each value), in their own unit."""
    exact = np.asarray(values, np.float64)
    return exact + np.asarray(sigma, np.float64) * rng.standard_normal(exact.shape)


def depth_with_noise(
    depth: ArrayLike, rng: np.random.Generator, *, base_m: float = 0.0012, growth: float = 0.0019, missing: float = 0.0
) -> NDArray[np.float32]:
    """Adds the axial noise of a structured-light camera to depth [...] [m].

    sigma = base + growth (d - 0.4)^2 (Nguyen, Izadi and Lovell, "Modeling Kinect sensor noise", 2012). ``missing`` is
    the share of pixels that are lost (0). Pixels without depth stay 0.
    """
    d = np.asarray(depth, np.float64)
    noisy = d + (base_m + growth * (d - 0.4) ** 2) * rng.standard_normal(d.shape)
    lost = rng.random(d.shape) < missing
    return np.where((d <= 0) | lost, 0.0, np.maximum(noisy, 0.0)).astype(np.float32)
