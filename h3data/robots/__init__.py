"""Robots: their links, joints and cameras, from a URDF or by name (h3data docs robots)."""

from __future__ import annotations

from h3data.bodies import (
    JointTargets,
    Robot,
    RobotCamera,
    RobotLeg,
    RobotLink,
    guess_robot_settings,
    load_robot,
    robot_names,
    solve_ik,
)

__all__ = [
    "JointTargets",
    "Robot",
    "RobotCamera",
    "RobotLeg",
    "RobotLink",
    "guess_robot_settings",
    "load_robot",
    "robot_names",
    "solve_ik",
]
