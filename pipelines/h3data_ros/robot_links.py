"""Frames of a robot's links for tf, as robot_state_publisher makes them from URDF and joint positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies import Robot
from h3data.geometry import IDENTITY_POSE, pose_from_matrix, pose_to_matrix
from h3data_ros.frames import FROM_WORLD

FOOTPRINT, BASE = "base_footprint", "base_link"
BLOCK = 256
Edge = tuple[str, str, NDArray[np.float64]]
"""Edge of the frame tree: parent frame, child frame and pose [7] of the child in the parent."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotLinks:
    """Frames below ``base_footprint``: static ones (`still`), and those of movable joints (`moving`)."""

    still: list[Edge]
    moving: list[tuple[str, str]]
    """Names of parent and child of each moving frame."""
    poses: NDArray[np.float64]
    """Poses of the moving frames in their parents, shape [T, M, 7]; NaN if a joint position is unknown."""


def robot_links(robot: Robot, joint_pos: ArrayLike, prefix: str) -> RobotLinks:
    """Return the frames of all links of a robot, named ``prefix`` plus their name in the URDF.

    The parent of the URDF's root is ``base_link``, unless a link has that name, and its parent is ``base_footprint``,
    the agent's root. A URDF root called ``base_footprint`` is the agent's root itself.

    Args:
        robot: Model of the robot.
        joint_pos: Joint positions [T, J] [rad or m].
        prefix: Prefix of the names of frames.
    """
    names = [prefix + name for name in robot.link_names]
    footprint, base = prefix + FOOTPRINT, prefix + BASE
    lift = pose_from_matrix(pose_to_matrix(FROM_WORLD) @ robot.to_base)
    still: list[Edge] = []
    if names[0] != footprint:
        still.append((footprint, base if base not in names else names[0], np.asarray(lift, np.float64)))
        still += [] if base in names else [(base, names[0], IDENTITY_POSE)]
    joints = np.asarray(joint_pos, np.float64)
    parents = np.array([link.parent for link in robot.links])
    fixed = [k for k in range(1, len(names)) if robot.kinds[k] == 0]
    turning = [k for k in range(1, len(names)) if robot.kinds[k] != 0]
    still += [(names[parents[k]], names[k], np.asarray(pose_from_matrix(robot.origins[k]), np.float64)) for k in fixed]
    poses = np.full((len(joints), len(turning), 7), np.nan)
    known = np.flatnonzero(np.isfinite(joints).all(axis=1))
    for start in range(0, len(known) if turning else 0, BLOCK):
        rows = known[start : start + BLOCK]
        frames = robot.link_matrices(np.tile(IDENTITY_POSE, (len(rows), 1)), joints[rows])
        inside = np.linalg.inv(frames[:, parents[turning]]) @ frames[:, turning]
        poses[rows] = pose_from_matrix(inside)
    return RobotLinks(still=still, moving=[(names[parents[k]], names[k]) for k in turning], poses=poses)
