"""Trot of legged robots for rendering, computed from the track of the base alone.

Diagonal legs move together; their phase depends on the distance covered, so they stand when the robot stands and step
backwards when it moves backwards. A standing foot is fixed in the world, at its resting position relative to the base
in the middle of the stance. The simulation does not use the trot: as in Habitat, the legs of its robot keep a fixed
posture.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies.robots.robot import Robot, RobotLeg
from h3data.errors import InputError
from h3data.geometry import (
    Array,
    ground_pose,
    heading_from_quat,
    pose_to_matrix,
    quat_rotate,
    smoothstep,
    transform_points,
)
from h3data.scene.floor_heights import LEVEL, floor_heights, nose_heights, off_risers


@dataclass(frozen=True)
class TrotSpec:
    """Constants of the trot."""

    stride_m: float = 0.7
    """Longest distance that a robot covers in one cycle of a leg [m]."""
    least_stride_m: float = 0.28
    """Shortest stride, at very low speeds [m]."""
    stride_steps: float = 6.0
    """Number of simulation steps whose distance, plus 0.2 m, is the length of a stride, up to `stride_m` at 2.5 m/s.
    With equal strides at all speeds, legs that turned on the spot stretched 37 cm to the side, and hind knees stood in
    walls."""
    stride_offset_m: float = 0.2
    """Length of a stride at speed 0, before it is clipped [m]."""
    smooth_steps: int = 9
    """Number of steps over which the distance covered in a step is averaged, from which the stride is computed."""
    duty: float = 0.55
    """Fraction of the cycle in which a foot stands."""
    lift_m: float = 0.05
    """Height to which a swinging foot is lifted [m]; with 8 cm, thighs stuck out 4 cm behind the discs of the base."""
    tuck: float = 0.7
    """Largest share of its distance by which a swinging foot is moved towards its resting position half-way. In 24
    episodes, hind legs were more than 2 cm in walls in 21 steps without it, in 11 with 0.4 and in 1 to 3 with this
    value."""
    settle_steps: int = 4
    """Number of steps after a stop within which all feet are on the floor."""
    settle_m: float = 0.05
    """Distance covered in the surrounding steps above which feet are lifted fully [m]."""
    nose_clear_m: float = 0.02
    """Height at which a foot passes over the noses of steps [m]."""
    over_share: float = 0.25
    """Share of a swing, at its start and at its end, in which the foot is below `nose_clear_m`."""
    lean_share: float = 0.5
    """Share of the distance from below the root to below the hips by which feet under a pitched base are moved. With
    all of it the lower legs of `quad_arm` were too short for the steps below, with none the upper ones were folded
    flat."""
    jump_m: float = 0.5
    """Distance of a step beyond which the base was moved from outside, so that the trot starts again [m]."""
    max_stretch: float = 0.999
    """Largest stretch as a share of the length of a leg, so that the knee does not flip."""


TROT = TrotSpec()


def trot(
    robot: Robot,
    base_pose: ArrayLike,
    joint_pos: ArrayLike,
    *,
    heights: NDArray[np.float64] = LEVEL,
) -> NDArray[np.float64]:
    """Return joint positions [T, J] with the legs of a robot stepping along its base track.

    Other joints stay as they are.

    Args:
        robot: A robot; one without legs gets its joint positions back.
        base_pose: Agent roots at consecutive steps, shape [T, 7] [m]; NaN where the robot is absent.
        joint_pos: Joint positions of the robot, shape [T, J] [rad or m].
        heights: Floor heights of the scene (`h3data.scene.floor_heights`); feet stand on the treads of its stairs.
    """
    bases, out = np.asarray(base_pose, np.float64), np.array(joint_pos, np.float64)
    if bases.ndim != 2 or bases.shape[1] != 7 or out.shape != (len(bases), len(robot.joint_names)):
        raise InputError(
            f"Expected a base track [T, 7] and joint positions [T, {len(robot.joint_names)}] of {robot.name}, got "
            f"{list(bases.shape)} and {list(out.shape)}.",
            code="H3-BODY-112",
        )
    if not robot.legs:
        return out
    rest = robot.link_matrices(np.array([[0, 0, 0, 0, 0, 0, 1.0]]), robot.rest[None])[0]
    shanks = [int(robot.joint_links[leg.columns[2]]) for leg in robot.legs]
    feet = np.stack([rest[k, :3, :3] @ leg.foot + rest[k, :3, 3] for k, leg in zip(shanks, robot.legs, strict=True)])
    # a damaged quaternion gives a matrix without an inverse: such steps keep their recorded joints
    is_turned = np.abs(np.linalg.norm(bases[:, 3:], axis=1) - 1) < 0.1
    there: NDArray[np.bool_] = np.all(np.isfinite(bases), axis=1) & is_turned
    jump = np.linalg.norm(np.diff(bases[:, :3], axis=0, prepend=bases[:1, :3]), axis=1) > TROT.jump_m
    begins = np.flatnonzero(jump | (there != np.concatenate([[False], there[:-1]])))
    # worked out at once: the matrices of a long track would take a hundred times its memory
    block_steps = 4096
    for first, last in zip(begins, [*begins[1:], len(bases)], strict=True):
        if there[first]:
            track = bases[first:last]
            heading = np.unwrap(heading_from_quat(track[:, 3:]))
            covered = np.hypot(*np.diff(track[:, [0, 2]], axis=0).T)
            # a turn on the spot covers what feet at their mean distance from the root do
            covered = covered + np.abs(np.diff(heading)) * np.hypot(feet[:, 0], feet[:, 2]).mean()
            way = np.concatenate([[0.0], np.cumsum(covered)])
            # distance ahead of the root at which feet stand under a pitched base, nearer to being below their hips
            up = quat_rotate(track[:, 3:], np.array([1.0, 0.0, 0.0]))[:, 1]
            lean = -TROT.lean_share * robot.base_height_m * up if len(heights) else np.zeros(len(track))
            cycles = _cycles(way)
            for start in range(0, len(track), block_steps):
                rows = np.arange(start, min(start + block_steps, len(track)))
                to_base = np.linalg.inv(pose_to_matrix(track[rows]) @ robot.to_base)
                places = _feet(track, heading, way, cycles, feet, rows, heights, lean)
                spots = np.einsum("tij,tlj->tli", to_base[:, :3, :3], places) + to_base[:, None, :3, 3]
                for k, leg in enumerate(robot.legs):
                    out[first + rows[:, None], leg.columns] = leg_angles(robot, leg, spots[:, k])
    return out


def legs_are_posed(robot: Robot, joint_pos: ArrayLike) -> bool:
    """Return whether the robot has legs and they keep their resting posture throughout joint positions [T, J]."""
    columns = [c for leg in robot.legs for c in leg.columns]
    return bool(columns) and np.allclose(np.asarray(joint_pos)[:, columns], robot.rest[columns], atol=1e-4)


def _ahead(way: Array, heading: Array) -> Array:
    return way[:, None] * np.stack([np.cos(heading), -np.sin(heading)], -1)


def _cycles(way: Array) -> Array:
    """Return the cycles of a leg up to each step [T], from the distance covered [T]."""
    covered = np.diff(way)
    if not len(covered):
        return np.zeros(len(way))
    weight = np.ones(min(TROT.smooth_steps, len(covered)))
    # at both ends over the fewer steps that there are
    smooth = np.convolve(covered, weight, "same") / np.convolve(np.ones(len(covered)), weight, "same")
    stride = np.clip(TROT.stride_offset_m + TROT.stride_steps * smooth, TROT.least_stride_m, TROT.stride_m)
    return np.concatenate([[0.0], np.cumsum(covered / stride)])


def _feet(
    bases: Array,
    heading: Array,
    way: Array,
    cycles: Array,
    feet: Array,
    rows: NDArray[np.integer],
    heights: NDArray[np.float64],
    lean: Array,
) -> Array:
    """Return the world positions of the feet at some rows of a base track, [len(rows), L, 3].

    ``feet`` [L, 3] are their places at rest, which on stairs are ``lean`` [T] ahead of the root.
    """
    edges = np.clip(rows[:, None] + [-TROT.settle_steps, TROT.settle_steps], 0, len(way) - 1)
    lift = TROT.lift_m * np.clip(np.diff(way[edges], axis=1)[:, 0] / TROT.settle_m, 0, 1)
    out = np.empty((len(rows), len(feet), 3))
    # upright: feet at rest do not pitch with the base
    roots = pose_to_matrix(ground_pose(bases[rows][:, [0, 2]], heading[rows], bases[rows, 1]))
    for k, foot in enumerate(feet):
        begin = TROT.duty / 2 + (0.0 if foot[0] * foot[2] > 0 else 0.5)  # one diagonal stands, the other swings
        place = begin + cycles[rows]
        cycle = np.floor(place)

        def planted(number: NDArray[np.float64], foot: Array = foot, begin: float = begin) -> Array:
            """Return the place of the foot on the floor in a cycle [m]; before the first step, the resting place."""
            middle = np.where(number <= begin, 0.0, number + TROT.duty / 2 - begin)
            x, y, z, turn = (np.interp(middle, cycles, v) for v in (*bases[:, :3].T, heading))
            at = transform_points(pose_to_matrix(ground_pose(np.stack([x, z], -1), turn, y)), foot[None])[:, 0]
            if len(heights):
                at[:, ::2] += _ahead(np.interp(middle, cycles, lean), turn)
                at[:, ::2] = off_risers(heights, at[:, ::2])
                at[:, 1] = foot[1] + floor_heights(heights, 0.0, at[:, ::2], treads=True)
            return at

        # the first swing begins where the feet stood
        lifts_off = np.maximum(cycle + TROT.duty, begin)
        swing = np.clip((place - lifts_off) / (cycle + 1 - lifts_off), 0, 1)
        weight = smoothstep(swing)[:, None]
        out[:, k] = planted(cycle) * (1 - weight) + planted(cycle + 1) * weight
        rest = transform_points(roots, foot[None])[:, 0]
        if len(heights):
            rest[:, ::2] += _ahead(lean[rows], heading[rows])
        out[:, k] += (TROT.tuck * np.sin(np.pi * swing) ** 2)[:, None] * (rest - out[:, k])
        if len(heights):
            noses = foot[1] + TROT.nose_clear_m + nose_heights(heights, 0.0, out[:, k, ::2])
            over = np.clip(np.minimum(swing, 1 - swing) / TROT.over_share, 0, 1)
            out[:, k, 1] += over * np.maximum(noses - out[:, k, 1], 0.0)
        out[:, k, 1] += lift * np.sin(np.pi * swing)
    return out


def leg_angles(robot: Robot, leg: RobotLeg, foot: ArrayLike) -> NDArray[np.float64]:
    """Return the hip roll, hip pitch and knee [..., 3] [rad] that bring a foot to points [..., 3] [m] in the URDF base frame.

    The solution is in closed form: the roll turns the plane of the leg through the point, and the other angles are
        those of a triangle. Points out of reach are approached along the line from the hip, and angles are clipped to
        their limits.
    """
    hip, pitch, knee = (robot.origins[robot.joint_links[c], :3, 3] for c in leg.columns)
    x, y, z = np.moveaxis(np.asarray(foot, np.float64) - hip, -1, 0)
    side = pitch[1] + knee[1] + leg.foot[1]
    # in the plane of the leg: the roll has turned the point under the axis of the hip
    x, down = x - pitch[0], np.sqrt(np.maximum(y * y + z * z - side * side, 1e-12))
    roll = np.arctan2(z, y) - np.arctan2(-down, side)
    thigh, shank = np.hypot(knee[0], knee[2]), np.hypot(leg.foot[0], leg.foot[2])
    thigh_lean, shank_lean = np.arctan2(-knee[0], -knee[2]), np.arctan2(-leg.foot[0], -leg.foot[2])
    away = np.clip(np.hypot(x, down), 1e-6, TROT.max_stretch * (thigh + shank))
    # the knee keeps the side that it has at rest
    side_of_knee = np.sign(robot.rest[leg.columns[2]] + shank_lean - thigh_lean) or -1.0
    cosine = np.clip((away**2 - thigh**2 - shank**2) / (2 * thigh * shank), -1, 1)
    bend = side_of_knee * np.arccos(cosine)
    lean = np.arctan2(-x, down) - np.arctan2(shank * np.sin(bend), thigh + shank * np.cos(bend))
    angles = np.stack([(roll + np.pi) % (2 * np.pi) - np.pi, lean - thigh_lean, bend + thigh_lean - shank_lean], -1)
    columns = list(leg.columns)
    return np.clip(angles, robot.lower[columns], robot.upper[columns])
