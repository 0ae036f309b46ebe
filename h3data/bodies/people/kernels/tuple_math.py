"""Vectors and quaternions (xyzw) as tuples of floats, for compiled kernels, without memory allocations."""

from __future__ import annotations

import math

from h3data.kernels import kernel_part


@kernel_part()
def multiply(a, b):
    """Return the product of two quaternions."""
    return (
        a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
        a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0],
        a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3],
        a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
    )


@kernel_part()
def inverse(q):
    """Return the inverse of a unit quaternion."""
    return (-q[0], -q[1], -q[2], q[3])


@kernel_part()
def cross(a, b):
    """Return the cross product of two vectors."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@kernel_part()
def dot(a, b):
    """Return the dot product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel_part()
def plus(a, b, share):
    """Return the vector ``a`` plus ``share`` times the vector ``b``."""
    return (a[0] + share * b[0], a[1] + share * b[1], a[2] + share * b[2])


@kernel_part()
def unit(a):
    """Return the unit vector in the direction of a vector; 0 for a vector shorter than 1e-12."""
    length = math.sqrt(dot(a, a))
    if length < 1e-12:
        return (0.0, 0.0, 0.0)
    return (a[0] / length, a[1] / length, a[2] / length)


@kernel_part()
def turned(q, v):
    """Return a vector rotated by a unit quaternion."""
    # with t = 2 a x v, where a is the vector part: v + w t + a x t
    axis = (q[0], q[1], q[2])
    t = cross(axis, v)
    t = (2 * t[0], 2 * t[1], 2 * t[2])
    return plus(plus(v, t, q[3]), cross(axis, t), 1.0)


@kernel_part()
def positive(q):
    """Return the quaternion with w >= 0 of the same rotation."""
    return (-q[0], -q[1], -q[2], -q[3]) if q[3] < 0 else q


@kernel_part()
def normalized(q):
    """Return a quaternion scaled to length 1; 0 stays 0."""
    length = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (q[0] / length, q[1] / length, q[2] / length, q[3] / length) if length > 0.0 else q


@kernel_part()
def nlerp(a, b, weight):
    """Return the normalised linear blend of two quaternions along the shorter arc; weight 0 gives a, 1 gives b."""
    dot4 = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    # -q is the same rotation; without this the blend would go the long way round
    b = (-b[0], -b[1], -b[2], -b[3]) if dot4 < 0 else b
    rest = 1 - weight
    return normalized(
        (
            a[0] * rest + b[0] * weight,
            a[1] * rest + b[1] * weight,
            a[2] * rest + b[2] * weight,
            a[3] * rest + b[3] * weight,
        )
    )


@kernel_part()
def from_vector(x, y, z):
    """Return the quaternion of a rotation vector."""
    angle = math.sqrt(x * x + y * y + z * z)
    # the limit of sin(angle / 2) / angle
    s = 0.5 if angle < 1e-9 else math.sin(angle / 2) / angle
    return (s * x, s * y, s * z, math.cos(angle / 2))


@kernel_part()
def to_vector(q):
    """Return the rotation vector of a quaternion, of at most half a turn."""
    sine = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    if sine < 1e-9:
        return (0.0, 0.0, 0.0)
    # q and -q are one rotation: with w above 0 it is at most half a turn
    angle = 2 * math.atan2(sine, abs(q[3])) / sine
    if q[3] < 0:
        angle = -angle
    return (q[0] * angle, q[1] * angle, q[2] * angle)


@kernel_part()
def from_axes(a, b, c):
    """Return the quaternion of the rotation whose columns are a, b and c (Shepperd's method)."""
    # the case with the largest component, which the others are divided by
    trace = a[0] + b[1] + c[2]
    if trace > max(a[0], b[1], c[2]):
        q = (b[2] - c[1], c[0] - a[2], a[1] - b[0], 1 + trace)
    elif a[0] >= b[1] and a[0] >= c[2]:
        q = (1 + a[0] - b[1] - c[2], a[1] + b[0], a[2] + c[0], b[2] - c[1])
    elif b[1] >= c[2]:
        q = (a[1] + b[0], 1 + b[1] - a[0] - c[2], b[2] + c[1], c[0] - a[2])
    else:
        q = (a[2] + c[0], b[2] + c[1], 1 + c[2] - a[0] - b[1], a[1] - b[0])
    n = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (q[0] / n, q[1] / n, q[2] / n, q[3] / n)


@kernel_part()
def row3(array, k):
    """Return row k of an array [N, 3] as a tuple."""
    return (array[k, 0], array[k, 1], array[k, 2])


@kernel_part()
def row4(array, k):
    """Return row k of an array [N, 4] as a tuple."""
    return (array[k, 0], array[k, 1], array[k, 2], array[k, 3])


@kernel_part()
def put(quats, joint, q):
    """Write a quaternion into row ``joint`` of an array [N, 4]."""
    quats[joint, 0], quats[joint, 1], quats[joint, 2], quats[joint, 3] = q


@kernel_part()
def segments_apart(p, q, a, b):
    """Return the distance between the segments p-q and a-b (Ericson, Real-Time Collision Detection, 5.1.9)."""
    d1, d2, r = plus(q, p, -1.0), plus(b, a, -1.0), plus(p, a, -1.0)
    e1, e2, f = dot(d1, d1), dot(d2, d2), dot(d2, r)
    c, g = dot(d1, r), dot(d1, d2)
    room = e1 * e2 - g * g
    # parallel segments: any point of the first one will do
    s = min(max((g * f - c * e2) / room, 0.0), 1.0) if room > 1e-12 else 0.0
    t = (g * s + f) / e2 if e2 > 1e-12 else 0.0
    # the nearest point of the second line lies beyond its segment: clamp it, then find s again
    if t < 0.0 or t > 1.0:
        t = min(max(t, 0.0), 1.0)
        s = min(max((g * t - c) / e1, 0.0), 1.0) if e1 > 1e-12 else 0.0
    gap = plus(plus(r, d1, s), d2, -t)
    return math.sqrt(dot(gap, gap))
