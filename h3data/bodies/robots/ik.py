"""Inverse kinematics: joint positions that bring a point or a frame of a robot's link to a target.

Damped least squares in the manner of Levenberg and Marquardt (Wampler 1986; Nakamura and Hanafusa 1986; Sugihara 2011):
the damping shrinks while steps help and grows when they do not. A joint at a limit is left out of a step as long as the
step would push it outwards. If the search stops far from the target, it is repeated from fixed pseudo-random postures,
so the same target has the same solution, alone or in a batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies.robots.robot import Robot
from h3data.errors import InputError
from h3data.geometry import pose_inverse, pose_multiply, pose_to_matrix


@dataclass(frozen=True, kw_only=True, eq=False)
class IkResult:
    """Result of `solve_ik`; arrays have the batch shape of its targets."""

    joint_pos: NDArray[np.float64]
    """Positions of all joints of the robot, inside their limits, shape [*batch, J] [rad or m]."""
    position_error_m: NDArray[np.float64]
    """Remaining distance to the target, shape [*batch] [m]."""
    rotation_error_rad: NDArray[np.float64]
    """Angle between the wanted and the reached rotation, shape [*batch] [rad]; 0 where only a position was asked for."""
    reached: NDArray[np.bool_]
    """True if both errors are within their tolerances, shape [*batch]."""
    clamped: NDArray[np.bool_]
    """Joints that the search stopped at a limit, shape [*batch, J]."""

    def __repr__(self) -> str:
        return f"IkResult({self.reached.sum()} of {self.reached.size} reached, joint_pos {list(self.joint_pos.shape)})"


def solve_ik(
    robot: Robot,
    link: str,
    target: ArrayLike,
    q0: ArrayLike | None = None,
    *,
    offset: ArrayLike = (0.0, 0.0, 0.0),
    base_pose: ArrayLike | None = None,
    joints: Sequence[str] | None = None,
    tolerance_m: float = 1e-4,
    tolerance_rad: float = 1e-3,
    iterations: int = 60,
    restarts: int = 32,
) -> IkResult:
    """Compute joint positions that bring a link to a target, starting from ``q0``.

    Args:
        robot: The robot.
        link: Name of the link; its frame is URDF's.
        target: Positions [*batch, 3] [m], or poses [*batch, 7], in the agent root frame; in the world with
            ``base_pose``.
        q0: Initial angles, shape [*batch, J] or [J], clipped to the joint limits; None is the resting posture.
        offset: The point of the link that goes to the target, in its frame, shape [3] [m]: ``robot.hand_position``.
        base_pose: Agent roots in the world, shape [*batch, 7] or [7].
        joints: Joints that may move; None is all between the base and the link. The others stay as they are in ``q0``.
        tolerance_m: Position error [m] below which the target is reached.
        tolerance_rad: Orientation error [rad] below which the target is reached.
        iterations: Greatest number of steps from one start.
        restarts: Largest number of repetitions from other postures. With 0 the solution stays near ``q0``.

    Returns:
        The solution with its remaining errors. For an unreachable target it is the nearest one found.

    Raises:
        InputError: wrong shapes, NaN, an unknown link, joints that do not move it, or spherical ones among them.
    """
    from h3data.bodies.robots.ik_kernel import solve_targets

    targets, oriented, batch = _targets(robot, target, base_pose)
    start = robot.clamp(robot.rest if q0 is None else q0).positions
    try:
        start = np.broadcast_to(start, (*batch, start.shape[-1])).reshape(-1, start.shape[-1]).copy()
    except ValueError:
        raise InputError(
            f"Expected q0 for {list(batch)} targets, got {list(start.shape[:-1])}.", code="H3-BODY-090"
        ) from None
    point = np.asarray(offset, np.float64)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise InputError(f"Expected an offset of 3 finite numbers, got {offset!r}.", code="H3-BODY-085")
    if not (tolerance_m > 0 and tolerance_rad > 0 and iterations >= 1 and restarts >= 0):
        raise InputError(
            "Expected tolerances above 0, at least one iteration, and no fewer restarts than 0.", code="H3-BODY-086"
        )
    # links from the base to this one, in which order the kernel multiplies their frames
    links = [robot.link_index(link)]
    while robot.links[links[-1]].parent >= 0:
        links.append(robot.links[links[-1]].parent)
    chain = np.array(links[::-1], np.int64)
    free = _free(robot, chain, joints)
    # the kernel improves postures in place
    out = start.copy()
    errors = np.empty((len(start), 2))
    # 0.25: an error of one radian counts as much as this one of position: about half the length of an arm
    solve_targets(
        targets,
        oriented,
        point,
        robot.origins[chain],
        robot.kinds[chain],
        robot.axes[chain],
        robot.columns[chain],
        robot.gains[chain],
        robot.offsets[chain],
        free,
        robot.lower,
        robot.upper,
        0.25,
        tolerance_m,
        tolerance_rad,
        iterations,
        restarts,
        out,
        errors,
    )
    clamped = np.zeros(out.shape, np.bool_)
    clamped[:, free] = ((out <= robot.lower) | (out >= robot.upper))[:, free]
    return IkResult(
        joint_pos=out.reshape(*batch, -1),
        position_error_m=errors[:, 0].reshape(batch),
        rotation_error_rad=errors[:, 1].reshape(batch),
        reached=((errors[:, 0] <= tolerance_m) & (errors[:, 1] <= tolerance_rad)).reshape(batch),
        clamped=clamped.reshape(*batch, -1),
    )


def _targets(robot: Robot, target: ArrayLike, base_pose: ArrayLike | None) -> tuple[NDArray, bool, tuple[int, ...]]:
    """Return the targets [N, 4, 4] in the URDF base frame, whether their orientation counts, and their batch shape."""
    wanted = np.asarray(target, np.float64)
    if wanted.shape[-1:] not in ((3,), (7,)) or not np.isfinite(wanted).all():
        raise InputError(
            f"Expected finite targets [..., 3] or [..., 7], got an array {list(wanted.shape)} or NaN.",
            code="H3-BODY-087",
        )
    oriented = wanted.shape[-1] == 7
    poses = (
        np.concatenate([wanted, np.broadcast_to([0, 0, 0, 1.0], (*wanted.shape[:-1], 4))], -1)
        if not oriented
        else wanted
    )
    length = np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
    if (length < 1e-9).any():
        raise InputError("Expected target poses with quaternions, got one of length 0.", code="H3-BODY-088")
    # only the direction of a quaternion means something
    poses = np.concatenate([poses[..., :3], poses[..., 3:] / length], -1)
    if base_pose is not None:
        base = np.asarray(base_pose, np.float64)
        if base.shape[-1:] != (7,) or not np.isfinite(base).all():
            raise InputError(
                f"Expected finite base poses [..., 7], got an array {list(base.shape)} or NaN.", code="H3-BODY-091"
            )
        try:
            poses = pose_multiply(pose_inverse(np.broadcast_to(base, poses.shape)), poses)
        except ValueError:
            raise InputError(
                f"Expected base poses for targets {list(wanted.shape)}, got {list(base.shape)}.", code="H3-BODY-092"
            ) from None
    # the frames of the chain begin at the URDF base
    matrices = np.linalg.inv(robot.to_base) @ pose_to_matrix(poses)
    return np.ascontiguousarray(matrices.reshape(-1, 4, 4)), oriented, wanted.shape[:-1]


def _free(robot: Robot, chain: NDArray[np.int64], joints: Sequence[str] | None) -> NDArray[np.int64]:
    """Return columns of the joints that may move."""
    from h3data.bodies.robots.kinematics import BALL, FIXED

    moving = chain[robot.kinds[chain] != FIXED]
    # a link that follows by mimic has the column of its leader, which counts once
    columns = dict.fromkeys(robot.columns[moving].tolist())
    names = {robot.joint_names[c]: c for c in columns}
    strangers = [] if joints is None else sorted(set(joints) - set(names))
    if strangers or not columns or (robot.kinds[moving] == BALL).any():
        raise InputError(
            f"Expected joints that move {robot.links[chain[-1]].name} of {robot.name} and are not spherical "
            f"({', '.join(names) or 'none'}), got {', '.join(strangers) or 'all'}.",
            code="H3-BODY-089",
        )
    return np.array([c for name, c in names.items() if joints is None or name in joints], np.int64)
