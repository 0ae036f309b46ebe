"""Robots as the pages of `h3data play` and of HTML replays pose them: forward kinematics in the browser."""

from __future__ import annotations

from typing import Any

from h3data.bodies import Robot
from h3data.geometry import pose_from_matrix


def robot_rig(robot: Robot) -> dict[str, Any]:
    """Base frame, number of joints and links of a robot, as ``web/src/scene/robot.ts`` reads them."""
    links = [
        {
            "name": link.name,
            "parent": int(link.parent),
            "origin": pose_from_matrix(robot.origins[k]).round(7).tolist(),
            "axis": robot.axes[k].tolist(),
            "kind": int(robot.kinds[k]),
            "column": int(robot.columns[k]),
            "gain": float(robot.gains[k]),
            "offset": float(robot.offsets[k]),
        }
        for k, link in enumerate(robot.links)
    ]
    return {
        "base": pose_from_matrix(robot.to_base).round(7).tolist(),
        "joints": len(robot.joint_names),
        "links": links,
    }
