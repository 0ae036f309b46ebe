"""Reaching: the position and posture of a person in which a hand is at a given point.

One table of trunk postures over a box of targets, in units of the standing shoulder's height, serves all bodies and,
mirrored, both hands; legs and arm follow in closed form, so the hand is exactly at the target and the feet stay where
they are. Every answer is checked: lengths, joint limits, balance, and that forearm and hand stay out of the body
(research/humanoids.md 3).

Points and poses are in the agent root frame: x forward, y up, z right, the origin on the floor.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies.people.humanoid import Humanoid
from h3data.bodies.people.humanoid_file import read_arrays
from h3data.bodies.people.kernels import reach as kernel
from h3data.bodies.people.kernels.reach import ReachBody, reach_many
from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.builtin import builtin_path
from h3data.errors import FormatError, InputError
from h3data.geometry import (
    Array,
    add_up,
    ground_pose,
    pose_multiply,
    quat_conjugate,
    quat_from_axis_angle,
    quat_multiply,
    quat_rotate,
)

Hand = Literal["left", "right"]
ReachStatus = Literal["reached", "outside_box", "invalid_posture", "too_far"]
HANDS: tuple[Hand, Hand] = ("right", "left")
STATUSES: tuple[ReachStatus, ...] = ("reached", "outside_box", "invalid_posture", "too_far")
"""Results of reaching, in the order of the kernel's codes."""
TABLE_FILE, TABLE_FORMAT = "bodies/reach/table.npz", "h3data.reach/1"
"""Name and format of the table's file, which is in a separate folder so that it is not taken for a body."""
ROOT_OF_BODY = quat_from_axis_angle(np.array([0.0, 1.0, 0.0]), np.pi / 2)
"""Rotation from the kernel's body frame (+Z forward, +X left) to the agent root frame, as a quaternion xyzw."""
ARM_RADIUS, INSET = 0.026, 0.02
"""Radius of forearm and hand for the clearance, as a share of the shoulder's height; share of the path inside the valid volume
by which advice keeps away from its border."""
PALM_SHARE, PALM_DROP = 0.9, 0.018
"""Position of the grasp point: along the hand to the middle finger's root, and this share of the shoulder's height out
of the palm."""


class BaseMotion(NamedTuple):
    """Motion of the agent root, in its frame before the motion."""

    forward_m: float
    right_m: float
    turn_rad: float
    """Turn to the left, after the move [rad]."""

    def of(self, base_pose: ArrayLike) -> Array:
        """Return the pose7 of a root after this motion, which starts at ``base_pose``."""
        step = ground_pose(np.array([self.forward_m, self.right_m]), np.array(self.turn_rad))
        return pose_multiply(np.asarray(base_pose, np.float64), step)


@dataclass(frozen=True, kw_only=True, eq=False)
class ReachResult:
    """Result of reaching for one point."""

    status: ReachStatus
    """Result of the search: ``reached``; ``outside_box``: outside the box for which postures were solved; ``too_far``:
    inside the box, but the arm is too short (or the point too near the shoulder); ``invalid_posture``: the hand gets
    there only by falling over, bending too far or passing through the body."""
    quats: Array
    """Local joint rotations xyzw, shape [55, 4], like one row of the result of `Humanoid.clip_pose`."""
    pelvis: Array
    """Position of the pelvis in the agent root frame, shape [3] [m]; if the target is not reached, for the posture at
    ``nearest_valid``."""
    hand_error_m: float
    """Distance from the target to the palm in this pose [m]."""
    nearest_valid: Array
    """The target if it is reached, else a valid point near it in the agent root frame, to about 2 cm, shape [3] [m]."""
    base_motion: BaseMotion | None
    """Motion of the base after which the target is reached; zero when it is reached already, None when no motion helps (too
    high, below the floor)."""

    @property
    def reached(self) -> bool:
        """Return whether the point can be reached."""
        return self.status == "reached"


class ReachPoses(NamedTuple):
    """Poses for many points, without advice."""

    quats: Array
    """Rotations of the joints as quaternions xyzw, shape [T, 55, 4]."""
    pelvis: Array
    """Position of the pelvis in the agent root frame, shape [T, 3] [m]."""
    status: NDArray[np.int8]
    """Index into `STATUSES`, shape [T]."""
    measures: Array
    """Measures of each pose, shape [T, M]; columns are named in `h3data.bodies.people.kernels.reach`."""


def reach(body: Humanoid, target: ArrayLike, hand: Hand = "right") -> ReachResult:
    """Return the pose in which the palm of ``hand`` is at ``target`` [3] [m], or the reason for failure.

    Raises:
        InputError: the target is not three finite numbers, or there is no such hand.
    """
    solver = reacher(body, hand)
    point = _points(target)
    if point.shape != (3,):
        raise InputError(
            f"Expected one target of shape [3], got {list(point.shape)}. Hint: reach_poses takes many.",
            code="H3-BODY-080",
        )
    poses = solver.poses(point[None])
    if poses.status[0] == kernel.REACHED:
        return ReachResult(
            status="reached",
            quats=poses.quats[0],
            pelvis=poses.pelvis[0],
            hand_error_m=0.0,
            nearest_valid=point,
            base_motion=BaseMotion(0.0, 0.0, 0.0),
        )
    nearest = solver.nearest_valid(point)
    # a pose in any case, which shows how far the person gets
    instead = solver.poses(nearest[None])
    return ReachResult(
        status=STATUSES[poses.status[0]],
        quats=instead.quats[0],
        pelvis=instead.pelvis[0],
        hand_error_m=float(np.linalg.norm(nearest - point)),
        nearest_valid=nearest,
        base_motion=solver.base_motion(point),
    )


def reach_poses(
    body: Humanoid, targets: ArrayLike, hand: Hand = "right", *, trunk: ArrayLike = 1.0, arm: ArrayLike = 1.0
) -> ReachPoses:
    """Return poses with the palm at ``targets`` [T, 3] [m], or as near as possible where the status is not 0.

    ``trunk`` and ``arm`` [T] (0 to 1) interpolate from the standing trunk and the elbow of a hanging arm to the solved
    posture. At (0, 0), with the target at the hanging hand, the result is the standing pose.
    """
    return reacher(body, hand).poses(_points(targets), trunk, arm)


def hand_points(joint_matrices: Array, body: Humanoid, hand: Hand = "right") -> Array:
    """Return the world positions [T, 3] [m] of a palm (the grasp point) from joint frames [T, 55, 4, 4]."""
    frames = joint_matrices[:, JOINT_INDEX[f"{hand}_wrist"]]
    return frames[:, :3, :3] @ grasp_point(body, hand) + frames[:, :3, 3]


@lru_cache(maxsize=64)
def grasp_point(body: Humanoid, hand: Hand) -> Array:
    """Return the palm's grasp point in the wrist's frame, shape [3] [m]."""
    return PALM_SHARE * body.joint_offsets[JOINT_INDEX[f"{hand}_middle1"]] - [0, PALM_DROP * _shoulder(body), 0]


@lru_cache(maxsize=64)
def reacher(body: Humanoid, hand: Hand = "right") -> ReachSolver:
    """Return the solver of one hand, made once per body (5 ms)."""
    if hand not in HANDS:
        raise InputError(f"Expected the left or the right hand, got {hand!r}.", code="H3-BODY-081")
    return ReachSolver(body, hand)


class Table(NamedTuple):
    """Solved postures of the right hand on a grid of targets, in units of the standing shoulder's height."""

    values: NDArray[np.float32]
    """Values at the points of the table, shape [X, Y, Z, P], with axes left, up, forward."""
    low: Array
    step: Array

    @property
    def points(self) -> Array:
        """All grid points, shape [N, 3]."""
        axes = [self.low[k] + self.step[k] * np.arange(self.values.shape[k]) for k in range(3)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


@lru_cache(maxsize=1)
def reach_table() -> Table:
    """Return the included table of postures, which is read once."""
    path = builtin_path(TABLE_FILE)
    data = read_arrays(path, TABLE_FORMAT)
    # whole numbers in the file, each parameter with a unit of its own
    values = (data["values"] * data["unit"]).astype(np.float32)
    if values.ndim != 4 or values.shape[3] != kernel.PARAMETER_COUNT:
        raise FormatError(
            f"The table of reaching postures has the shape {list(values.shape)}. Hint: bake it. File: {path}",
            code="H3-BODY-082",
        )
    return Table(values, data["low"].astype(np.float64), data["step"].astype(np.float64))


class ReachSolver:
    """Solver of postures in which one hand of one body reaches points."""

    tried = 24
    """Number of the nearest table points among which the nearest valid one is searched."""

    def __init__(self, body: Humanoid, hand: Hand, table: Table | None = None) -> None:
        self.table = reach_table() if table is None else table
        self.body = reach_body(body, hand)
        self._mirror = np.array([-self.body.sign, 1.0, 1.0])
        self._valid: Array | None = None
        quats, pelvis = body.clip_pose([0], [0.0])
        root = np.array([[0, 0, 0, 0, 0, 0, 1.0]])
        self.rest = hand_points(body.joint_matrices(root, quats, pelvis), body, hand)[0]
        """Position of the palm of a standing person, shape [3] [m]."""

    def poses(self, targets: Array, trunk: ArrayLike = 1.0, arm: ArrayLike = 1.0) -> ReachPoses:
        """Return poses with the palm at ``targets`` [T, 3] [m], as `reach_poses` does, for the body of this solver."""
        count = len(targets)
        quats, pelvis = np.empty((count, 55, 4)), np.empty((count, 3))
        measures, status = np.empty((count, kernel.MEASURE_COUNT)), np.empty(count, np.int8)
        points = np.empty((count, 3))
        # from the agent root frame (x forward, z right) to that of the kernel (x left, z forward)
        points[:, 0], points[:, 1], points[:, 2] = -targets[:, 2], targets[:, 1], targets[:, 0]
        reach_many(
            self.body,
            self.table.values,
            self.table.low,
            self.table.step,
            points,
            _each(trunk, count),
            _each(arm, count),
            ROOT_OF_BODY,
            quats,
            pelvis,
            measures,
            status,
        )
        return ReachPoses(quats, pelvis, status, measures)

    def reachable(self, targets: Array) -> NDArray[np.bool_]:
        """Return which of the points [T, 3] [m] the hand reaches, bool [T]."""
        return self.poses(targets).status == kernel.REACHED

    @property
    def valid_points(self) -> Array:
        """Points of the table that this body reaches, shape [N, 3] [m]."""
        if self._valid is None:
            points = self.table.points * self._mirror * self.body.scale
            # back to the agent root frame
            points = np.stack([points[:, 2], points[:, 1], -points[:, 0]], axis=1)
            self._valid = points[self.reachable(points)]
            if not len(self._valid):
                raise InputError(
                    "This body reaches nothing with this hand. Hint: are its joint offsets in metres?",
                    code="H3-BODY-084",
                )
        return self._valid

    def nearest_valid(self, target: Array) -> Array:
        """Return a valid point [3] [m] near ``target``, found on lines from the nearest valid table points towards it."""
        gap = np.linalg.norm(self.valid_points - target, axis=1)
        # several, because the straight line from the nearest one may leave the valid volume at once
        starts = self.valid_points[np.argsort(gap)[: self.tried]]
        found = self._towards(starts, np.broadcast_to(target, starts.shape))
        return found[int(np.argmin(np.linalg.norm(found - target, axis=1)))]

    def base_motion(self, target: Array) -> BaseMotion | None:
        """Return the smallest motion of the base, among those tried, after which ``target`` [3] [m] is reached.

        The motion turns the body to the target if the target is not in front of it.
        """
        forward, height, right = target
        if abs(right) < forward or np.hypot(forward, right) < 0.3 * self.body.scale:
            turn = 0.0
        else:  # towards where the hand is most at ease: in front, a little to its side
            turn = -float(np.arctan2(right, forward)) - 0.3 * self.body.sign
        c, s = np.cos(turn), np.sin(turn)
        seen = np.array([forward * c - right * s, height, right * c + forward * s])  # axes turned, origin kept
        starts = self.valid_points.copy()
        starts = starts[np.abs(starts[:, 1] - height) < 1.01 * self.table.step[1] * self.body.scale]
        # the base moves along the floor, so the hand has to be at this height already
        starts[:, 1] = height
        starts = starts[self.reachable(starts)] if len(starts) else starts
        if not len(starts):
            return None
        starts = starts[np.argsort(np.hypot(*(starts - seen)[:, [0, 2]].T))[: self.tried]]
        found = self._towards(starts, np.broadcast_to(seen, starts.shape))
        x, _, z = seen - found[int(np.argmin(np.linalg.norm(found - seen, axis=1)))]
        return BaseMotion(float(x * c + z * s), float(z * c - x * s), turn)

    def _towards(self, starts: Array, ends: Array) -> Array:
        """Return how far a posture gets from valid ``starts`` [N, 3] on straight lines to ``ends`` [N, 3], by bisection."""
        low, high = np.zeros((len(starts), 1)), np.ones((len(starts), 1))
        # ten halvings leave a thousandth of the line
        for _ in range(10):
            middle = (low + high) / 2
            good = self.reachable(starts + middle * (ends - starts))[:, None]
            low, high = np.where(good, middle, low), np.where(good, high, middle)
        inner = np.maximum(low - INSET, 0) * (ends - starts) + starts
        # valid points need not be convex: one a little further inside may be invalid again
        return np.where(self.reachable(inner)[:, None], inner, starts)


def _each(share: ArrayLike, count: int) -> Array:
    return np.ascontiguousarray(np.broadcast_to(np.asarray(share, np.float64), count))


def _points(targets: ArrayLike) -> Array:
    points = np.asarray(targets, np.float64)
    if points.ndim not in (1, 2) or points.shape[-1] != 3 or not np.isfinite(points).all():
        raise InputError(
            f"Expected finite points of shape [3] or [T, 3], got shape {list(points.shape)}: {targets!r}",
            code="H3-BODY-083",
        )
    return points


# --- what the kernel knows of a body ------------------------------------------------------------------------------------
def _shoulder(body: Humanoid) -> float:
    """Return the height of the shoulders in the zero pose [m]."""
    chain = ("pelvis", "spine1", "spine2", "spine3", "right_collar", "right_shoulder")
    return float(add_up(body.joint_offsets[JOINT_INDEX[name], 1] for name in chain))


def reach_body(body: Humanoid, hand: Hand) -> ReachBody:
    """Return the measures of one body and hand, in the body frame."""
    sign, other = (1.0, "right") if hand == "left" else (-1.0, "left")
    stand, frames = _standing(body)
    # the order is that of `ReachBody.joints`
    names = [f"{hand}_{part}" for part in ("collar", "shoulder", "elbow", "wrist")] + [f"{other}_shoulder"]
    names += [f"{side}_{part}" for part in ("hip", "knee", "ankle") for side in ("left", "right")]
    kept_out = {
        "pelvis": 0,
        "abdomen": 1,
        "chest_low": 2,
        "chest_high": 3,
        "head": 4,
        "left_thigh": 5,
        "right_thigh": 6,
    }
    obstacles = [c for c in body.capsules if c.name in kept_out]
    legs, ankles = body.gaits.legs, frames[[JOINT_INDEX["left_ankle"], JOINT_INDEX["right_ankle"]], :3, 3]
    scale = _shoulder(body)
    return ReachBody(
        scale=scale,
        sign=sign,
        stand=stand,
        pelvis=frames[0, :3, 3].copy(),
        pole=_hanging_pole(body, frames, hand, sign),
        offsets=np.ascontiguousarray(body.joint_offsets, np.float64),
        ankles=np.ascontiguousarray(ankles),
        support=ankles[:, 2].mean() + legs.feet[:, :2, 2].mean(axis=0),
        bones=np.array([legs.thigh, legs.shank]),
        joints=np.array([JOINT_INDEX[name] for name in names]),
        palm=grasp_point(body, hand),
        obstacles=np.array([[*c.start, *c.end, c.radius] for c in obstacles]).reshape(-1, 7),
        obstacle_joints=np.array([kept_out[c.name] for c in obstacles], np.int64),
        arm_radius=ARM_RADIUS * scale,
    )


def _standing(body: Humanoid) -> tuple[Array, Array]:
    """Return the local rotations [55, 4] and joint frames [55, 4, 4] of standing, in the body frame."""
    quats, pelvis = body.clip_pose([0], [0.0])
    back = quat_conjugate(ROOT_OF_BODY)
    quats[:, 0] = quat_multiply(back, quats[:, 0])
    frames = body.joint_matrices(np.array([[0, 0, 0, 0, 0, 0, 1.0]]), quats, quat_rotate(back, pelvis))
    return quats[0], frames[0]


def _hanging_pole(body: Humanoid, frames: Array, hand: Hand, sign: float) -> Array:
    """Return the elbow direction [3] in the chest frame with which the kernel gives the standing pose."""
    shoulder, wrist = frames[JOINT_INDEX[f"{hand}_shoulder"]], frames[JOINT_INDEX[f"{hand}_wrist"]]
    palm = wrist[:3, :3] @ grasp_point(body, hand) + wrist[:3, 3]
    along = (palm - shoulder[:3, 3]) / np.linalg.norm(palm - shoulder[:3, 3])
    axis = shoulder[:3, 1] - (shoulder[:3, 1] @ along) * along
    return frames[JOINT_INDEX["spine3"], :3, :3].T @ (-sign * np.cross(along, axis / np.linalg.norm(axis)))
