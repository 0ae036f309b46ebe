"""Rotations and rigid poses, with the conventions of the whole package.

World: right-handed, metres, +Y up, as Habitat and glTF. Agent root frame: x forward, y up, z right; the heading is the
rotation about +Y, 0 faces +X, positive turns left. Quaternions are ``[x y z w]``, unit. A pose7 is
``[x y z qx qy qz qw]``, local to world; a 4x4 matrix acts on column vectors. Every function broadcasts over leading axes
and keeps the floating dtype of its operands.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable
from functools import reduce
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating]

IDENTITY_QUAT = np.array([0.0, 0.0, 0.0, 1.0])
IDENTITY_POSE = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


def _floating(value: ArrayLike) -> Array:
    array = np.asarray(value)
    return array if array.dtype.kind == "f" else array.astype(np.float64)


def _components(vectors: Array, *others: Array) -> list[Any]:
    """Return the components [...] of vectors [..., n], as views of the array.

    Those of a single float64 vector are Python floats, unless they are combined with ``others`` of another type. The
    bits of the results are the same, in a third of the time: a step of a person computes some twenty single
    quaternions.
    """
    if all(v.ndim == 1 and v.dtype == np.float64 for v in (vectors, *others)):
        return vectors.tolist()
    return [vectors[..., k] for k in range(vectors.shape[-1])]


_F64 = np.dtype(np.float64)


def _is_single(value: Any) -> bool:
    """Return whether a value is a single float64 vector, which is computed in Python floats.

    The same operations in the same order give the same bits, in a quarter of the time of NumPy's calls on four numbers;
    agents pose one such vector each per step.
    """
    return type(value) is np.ndarray and value.ndim == 1 and value.dtype is _F64


Share = TypeVar("Share", float, NDArray[np.float64], Array)


def smoothstep(share: Share) -> Share:
    """Return the progress along a path, 0 to 1, at a share of its time, by a cubic with zero speed at both ends."""
    return share * share * (3 - 2 * share)


def add_up(values: Iterable[float]) -> float:
    """Return the sum from left to right, 0.0 without numbers, with the same bits on all versions of Python.

    The built-in `sum` rounds differently since Python 3.12.
    """
    return reduce(operator.add, values, 0.0)


def normalized(vectors: ArrayLike) -> Array:
    """Scale vectors (or quaternions) along the last axis to unit length; a zero vector stays zero."""
    v = _floating(vectors)
    if _is_single(v) and len(v) < 8:  # NumPy sums eight and more in pairs
        numbers = v.tolist()
        square = 0.0
        for n in numbers:  # as `add_up`, which takes longer
            square += n * n
        length = math.sqrt(square) or 1.0
        return np.array([n / length for n in numbers])
    length = np.sqrt(np.add.reduce(v * v, axis=-1, keepdims=True))
    return v / np.where(length > 0, length, 1)


def cross(a: Array, b: Array) -> Array:
    """Return cross products [..., 3], bit-identical to `numpy.cross`, but faster for few vectors."""
    if _is_single(a) and _is_single(b):
        (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
        return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
    ax, ay, az = _components(a, b)
    bx, by, bz = _components(b, a)
    x = ay * bz - az * by
    out = np.empty((*np.shape(x), 3), np.result_type(a, b))
    out[..., 0] = x
    out[..., 1] = az * bx - ax * bz
    out[..., 2] = ax * by - ay * bx
    return out


def quat_multiply(a: ArrayLike, b: ArrayLike) -> Array:
    """Return the Hamilton product ``a b``, shape [..., 4]: the rotation by ``b`` followed by the one by ``a``."""
    if _is_single(a) and _is_single(b):
        return np.array(_product(a.tolist(), b.tolist()))  # type: ignore[union-attr]
    a, b = _floating(a), _floating(b)
    ax, ay, az, aw = _components(a, b)
    bx, by, bz, bw = _components(b, a)
    x = aw * bx + ax * bw + ay * bz - az * by
    out = np.empty((*np.shape(x), 4), np.result_type(a, b))
    out[..., 0] = x
    out[..., 1] = aw * by - ax * bz + ay * bw + az * bx
    out[..., 2] = aw * bz + ax * by - ay * bx + az * bw
    out[..., 3] = aw * bw - ax * bx - ay * by - az * bz
    return out


def _product(a: list[float], b: list[float]) -> tuple[float, float, float, float]:
    """Return `quat_multiply` of two quaternions, bit for bit."""
    (ax, ay, az, aw), (bx, by, bz, bw) = a, b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def quat_conjugate(q: ArrayLike) -> Array:
    """Return the inverse of unit quaternions, shape [..., 4]."""
    q = _floating(q)
    # an array of the same type, so that float32 stays float32
    return q * np.array([-1, -1, -1, 1], q.dtype)


def quat_rotate(q: ArrayLike, vectors: ArrayLike) -> Array:
    """Return vectors [..., 3] rotated by unit quaternions [..., 4]."""
    if _is_single(q) and _is_single(vectors):
        return np.array(_rotated(q.tolist(), vectors.tolist()))  # type: ignore[union-attr]
    q, v = _floating(q), _floating(vectors)
    axis, w = q[..., :3], q[..., 3:]
    # v + 2 w (axis x v) + 2 axis x (axis x v), without making a matrix
    t = 2 * cross(axis, v)
    return v + w * t + cross(axis, t)


def _rotated(q: list[float], v: list[float]) -> tuple[float, float, float]:
    """Return `quat_rotate` of one vector, bit for bit."""
    (ax, ay, az, w), (x, y, z) = q, v
    tx, ty, tz = 2 * (ay * z - az * y), 2 * (az * x - ax * z), 2 * (ax * y - ay * x)
    return x + w * tx + (ay * tz - az * ty), y + w * ty + (az * tx - ax * tz), z + w * tz + (ax * ty - ay * tx)


def quat_from_axis_angle(axis: ArrayLike, angle_rad: ArrayLike) -> Array:
    """Return quaternions [..., 4] of rotations by ``angle_rad`` [...] about ``axis`` [..., 3] (any length)."""
    half = _floating(angle_rad)[..., None] / 2
    axis = normalized(axis)
    turned = axis * np.sin(half)
    out = np.empty((*turned.shape[:-1], 4), turned.dtype)
    out[..., :3], out[..., 3:] = turned, np.cos(half)
    return out


def quat_from_heading(heading_rad: ArrayLike) -> Array:
    """Return quaternions [..., 4] of headings [...]: rotation about +Y, 0 faces +X, positive turns left."""
    if isinstance(heading_rad, float):  # also NumPy's; the same bits, in a third of the time
        return np.array([0.0, math.sin(heading_rad / 2), 0.0, math.cos(heading_rad / 2)])
    half = _floating(heading_rad) / 2
    out = np.zeros((*half.shape, 4), half.dtype)
    out[..., 1], out[..., 3] = np.sin(half), np.cos(half)
    return out


def heading_from_quat(q: ArrayLike) -> Array:
    """Return the headings [...] [rad] of the x axes of frames [..., 4]; roll and pitch are dropped."""
    x, y, z, w = q.tolist() if _is_single(q) else _components(_floating(q))  # type: ignore[union-attr]
    # Bit-identical to `quat_rotate` of (1, 0, 0), signs of zeros included, without the component that goes unused
    tx, ty, tz = 2 * (y * 0 - z * 0), 2 * (z - x * 0), 2 * (x * 0 - y)
    return np.arctan2(-(0 + w * tz + (x * ty - y * tx)), 1 + w * tx + (y * tz - z * ty))


def heading_direction(heading_rad: ArrayLike) -> Array:
    """Return the unit forward vectors in the floor plane, ``(x, z)`` [..., 2], of headings [...]."""
    h = _floating(heading_rad)
    out = np.empty((*h.shape, 2), h.dtype)  # np.stack costs more than the cosines and sines of a few headings
    out[..., 0], out[..., 1] = np.cos(h), -np.sin(h)
    return out


def wrap_angle(angle_rad: ArrayLike) -> Array:
    """Wrap angles to [-pi, pi)."""
    if isinstance(angle_rad, float):  # also NumPy's; the same bits, in a third of the time
        return (angle_rad + math.pi) % (2 * math.pi) - math.pi  # type: ignore[return-value]
    a = _floating(angle_rad)
    return (a + np.pi) % (2 * np.pi) - np.pi


def quat_to_matrix(q: ArrayLike) -> Array:
    """Return the rotation matrices [..., 3, 3] of unit quaternions [..., 4]."""
    q = _floating(q)
    x, y, z, w = _components(q)
    m = np.empty((*q.shape[:-1], 3, 3), q.dtype)
    m[..., 0, 0] = 1 - 2 * (y * y + z * z)
    m[..., 0, 1] = 2 * (x * y - z * w)
    m[..., 0, 2] = 2 * (x * z + y * w)
    m[..., 1, 0] = 2 * (x * y + z * w)
    m[..., 1, 1] = 1 - 2 * (x * x + z * z)
    m[..., 1, 2] = 2 * (y * z - x * w)
    m[..., 2, 0] = 2 * (x * z - y * w)
    m[..., 2, 1] = 2 * (y * z + x * w)
    m[..., 2, 2] = 1 - 2 * (x * x + y * y)
    return m


def quat_from_matrix(matrix: ArrayLike) -> Array:
    """Return the unit quaternions [..., 4] with w >= 0 of rotation matrices [..., 3, 3].

    The computation divides by the largest of the four components, so that no case loses precision (Shepperd's method).
    """
    m = _floating(matrix)
    # single matrices are the common case, and NumPy's calls would take most of their time
    if m.ndim == 2 and m.dtype is _F64:
        return np.array(_quat_of_rows(m.tolist()))
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    rows = np.empty((*m.shape[:-2], 4, 4), m.dtype)  # row i: the quaternion times four times its component i
    rows[..., 0, 0], rows[..., 1, 1] = 1 + m00 - m11 - m22, 1 - m00 + m11 - m22
    rows[..., 2, 2], rows[..., 3, 3] = 1 - m00 - m11 + m22, 1 + m00 + m11 + m22
    best = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    rows[..., 0, 1] = rows[..., 1, 0] = m[..., 0, 1] + m[..., 1, 0]
    rows[..., 0, 2] = rows[..., 2, 0] = m[..., 0, 2] + m[..., 2, 0]
    rows[..., 1, 2] = rows[..., 2, 1] = m[..., 1, 2] + m[..., 2, 1]
    rows[..., 0, 3] = rows[..., 3, 0] = m[..., 2, 1] - m[..., 1, 2]
    rows[..., 1, 3] = rows[..., 3, 1] = m[..., 0, 2] - m[..., 2, 0]
    rows[..., 2, 3] = rows[..., 3, 2] = m[..., 1, 0] - m[..., 0, 1]
    q = normalized(np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :])
    return np.where(q[..., 3:] < 0, -q, q)


def _quat_of_rows(rows: list[list[float]]) -> list[float]:
    """Return `quat_from_matrix` of one matrix, bit for bit."""
    (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = rows
    squares = (1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22, 1 + m00 + m11 + m22)
    best = squares.index(max(squares))
    xy, xz, yz, xw, yw, zw = m01 + m10, m02 + m20, m12 + m21, m21 - m12, m02 - m20, m10 - m01
    x, y, z, w = (
        (squares[0], xy, xz, xw),
        (xy, squares[1], yz, yw),
        (xz, yz, squares[2], zw),
        (xw, yw, zw, squares[3]),
    )[best]
    length = math.sqrt(x * x + y * y + z * z + w * w) or 1.0
    q = [x / length, y / length, z / length, w / length]
    return [-c for c in q] if q[3] < 0 else q


def quat_sign_continuous(q: ArrayLike) -> Array:
    """Choose signs of quaternions [T, ..., 4] so that none jumps to the antipode from one time (axis 0) to the next."""
    q = _floating(q)
    if len(q) < 2:
        return q.copy()
    # q and -q are one rotation; each flip turns all that come after it, hence the product
    flips = np.where(np.sum(q[1:] * q[:-1], axis=-1) < 0, -1.0, 1.0).astype(q.dtype)
    signs = np.concatenate([np.ones_like(flips[:1]), np.cumprod(flips, axis=0)])
    return q * signs[..., None]


def quat_nlerp(a: ArrayLike, b: ArrayLike, weight: ArrayLike) -> Array:
    """Blend quaternions [..., 4] along the shorter arc, normalised; ``weight`` [...] 0 gives a, 1 gives b."""
    if _is_single(a) and _is_single(b) and isinstance(weight, float):
        (ax, ay, az, aw), (bx, by, bz, bw) = a.tolist(), b.tolist()  # type: ignore[union-attr]
        w = -weight if ax * bx + ay * by + az * bz + aw * bw < 0 else weight
        v = 1 - weight
        return normalized(np.array([ax * v + bx * w, ay * v + by * w, az * v + bz * w, aw * v + bw * w]))
    a, b, w = _floating(a), _floating(b), _floating(weight)[..., None]
    # the antipode is the same rotation and may be nearer
    b = np.where(np.sum(a * b, axis=-1, keepdims=True) < 0, -b, b)
    return normalized(a * (1 - w) + b * w)


def pose_to_matrix(pose: ArrayLike) -> Array:
    """Return poses (pose7) [..., 7] as 4x4 matrices [..., 4, 4]."""
    if _is_single(pose):
        px, py, pz, x, y, z, w = pose.tolist()  # type: ignore[union-attr]
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), px],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), py],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), pz],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
    p = _floating(pose)
    m = np.zeros((*p.shape[:-1], 4, 4), p.dtype)
    m[..., :3, :3] = quat_to_matrix(p[..., 3:])
    m[..., :3, 3] = p[..., :3]
    m[..., 3, 3] = 1
    return m


def pose_from_matrix(matrix: ArrayLike) -> Array:
    """Return rigid 4x4 (or 3x4) matrices [..., 4, 4] as poses (pose7) [..., 7]."""
    m = _floating(matrix)
    return np.concatenate([m[..., :3, 3], quat_from_matrix(m[..., :3, :3])], axis=-1)


def pose_multiply(a: ArrayLike, b: ArrayLike) -> Array:
    """Return the product of poses ``a`` and ``b``, shape [..., 7].

    The result is the pose ``b``, given in frame ``a``, expressed in the parent frame of ``a``."""
    if _is_single(a) and _is_single(b):
        (px, py, pz, *turn), (*offset, bx, by, bz, bw) = a.tolist(), b.tolist()  # type: ignore[union-attr]
        x, y, z = _rotated(turn, offset)
        return np.array([px + x, py + y, pz + z, *_product(turn, [bx, by, bz, bw])])
    a, b = _floating(a), _floating(b)
    position = a[..., :3] + quat_rotate(a[..., 3:], b[..., :3])
    return np.concatenate([position, quat_multiply(a[..., 3:], b[..., 3:])], axis=-1)


def pose_inverse(pose: ArrayLike) -> Array:
    """Return the inverse transform of a pose, shape [..., 7]."""
    if _is_single(pose):
        *place, qx, qy, qz, qw = pose.tolist()  # type: ignore[union-attr]
        q = [qx * -1, qy * -1, qz * -1, qw]
        x, y, z = _rotated(q, place)
        return np.array([-x, -y, -z, *q])
    p = _floating(pose)
    q = quat_conjugate(p[..., 3:])
    return np.concatenate([-quat_rotate(q, p[..., :3]), q], axis=-1)


def transform_points(matrix: ArrayLike, points: ArrayLike) -> Array:
    """Return points [..., N, 3] transformed by 4x4 (or 3x4) matrices [..., 4, 4]."""
    m, p = _floating(matrix), _floating(points)
    return p @ np.swapaxes(m[..., :3, :3], -1, -2) + m[..., None, :3, 3]


def distance_to_circles(points: Any, headings: Any, circles: Any, *, xp: Any = np) -> Any:
    """Return the distance [..., R] [m] from floor points along headings to the first circle.

    It is infinite if no circle is hit, and 0 inside a circle.

    Args:
        points: Points (x, z) [..., 2] [m].
        headings: Headings of the rays [..., R] [rad].
        circles: Circles (x, z, radius) [..., N, 3] [m], N > 0; circles with NaN are never hit.
        xp: Array namespace of the arguments: ``numpy`` or ``torch``.
    """
    gap = circles[..., None, :, :2] - points[..., None, None, :]
    x, z = xp.cos(headings)[..., None], -xp.sin(headings)[..., None]
    along, across = gap[..., 0] * x + gap[..., 1] * z, gap[..., 0] * z - gap[..., 1] * x
    radius = circles[..., None, :, 2]
    half = radius * radius - across * across
    # clipped, because a root of negative numbers is NaN and a warning; such rays are left out below
    near = along - xp.sqrt(half.clip(0.0, None))
    inside = gap[..., 0] ** 2 + gap[..., 1] ** 2 <= radius * radius
    first = xp.where((half > 0.0) & (near > 0.0), near, xp.inf)
    first = xp.where(inside, 0.0, first)
    # torch's ``min`` along an axis returns places too
    return first.min(-1) if xp is np else first.amin(-1)


def ground_pose(xz: ArrayLike, heading_rad: ArrayLike, floor_y: ArrayLike = 0.0) -> Array:
    """Return poses (pose7) [..., 7] of agent roots that stand at floor points ``(x, z)`` [..., 2] with headings [...]."""
    if _is_single(xz) and isinstance(heading_rad, float) and isinstance(floor_y, float):
        x, z = xz.tolist()  # type: ignore[union-attr]
        half = heading_rad / 2
        return np.array([x, floor_y, z, 0.0, math.sin(half), 0.0, math.cos(half)])
    xz = _floating(xz)
    q = quat_from_heading(np.asarray(heading_rad, xz.dtype))
    y = np.broadcast_to(np.asarray(floor_y, xz.dtype), xz.shape[:-1])
    out = np.empty((*xz.shape[:-1], 7), xz.dtype)
    out[..., 0], out[..., 1], out[..., 2], out[..., 3:] = xz[..., 0], y, xz[..., 1], q
    return out


def sloped_pose(
    height_at: Callable[[Array], Array], xz: ArrayLike, heading_rad: ArrayLike, length_m: float = 0.0
) -> Array:
    """Return the world pose of an agent on a floor whose height varies, shape [..., 7]; `ground_pose` on a level floor.

    Args:
        height_at: height of the floor at points [..., 2] [m].
        xz: positions on the floor [..., 2] [m].
        heading_rad: heading of the agent [...] [rad].
        length_m: distance between the two points that rest on the floor. Above 0, the root pitches with the floor under
            both points and lies at its mean height there; at 0 it stays upright.
    """
    xz = np.asarray(xz, np.float64)
    heading = np.broadcast_to(np.asarray(heading_rad, np.float64), xz.shape[:-1])
    if length_m <= 0.0:
        return ground_pose(xz, heading, height_at(xz))
    # z is to the right and a positive heading turns left, hence the minus
    ahead = length_m / 2 * np.stack([np.cos(heading), -np.sin(heading)], -1)
    front, back = height_at(xz + ahead), height_at(xz - ahead)
    out = ground_pose(xz, heading, (front + back) / 2)
    half = np.arctan2(front - back, length_m) / 2
    # about z, the axis to the right, in the frame of the agent: applied before its heading
    pitch = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], -1)
    out[..., 3:] = quat_multiply(out[..., 3:], pitch)
    return out
