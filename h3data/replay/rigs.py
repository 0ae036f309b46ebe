"""Descriptions of robots, doors and drawers for web pages, whose forward kinematics is computed in the browser."""

from __future__ import annotations

from collections.abc import Container
from typing import Any

import numpy as np

from h3data.bodies import Robot
from h3data.geometry import pose_from_matrix, pose_to_matrix
from h3data.scene import Scene
from h3data.scene.articulation import handle_points, joints_of


def robot_rig(robot: Robot) -> dict[str, Any]:
    """Return the base frame, number of joints and links of a robot, in the form that ``web/src/scene/robot.ts`` reads."""
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
        "climbs": robot.climbing_length_m,
        "links": links,
    }


def joint_rigs(scene: Scene, *, movable: Container[str] = ()) -> list[dict[str, Any]]:
    """Return the joints of a scene in order, in the world frame, in the form that ``web/src/scene/joints.ts`` reads.

    Args:
        scene: The scene.
        movable: Names of the instances that have their own poses and do not move with joints.
    """
    joints, numbers = joints_of(scene), {}
    rigs = []
    for k, ((thing, part), handle) in enumerate(zip(joints.parts, handle_points(scene), strict=True)):
        numbers[thing.name, part.name] = k
        frame = pose_to_matrix(np.asarray(thing.pose, np.float64))
        rigs.append(
            {
                "name": joints.names[k],
                "parent": numbers[thing.name, part.parent] if part.parent else -1,
                "kind": 1 if part.joint.kind == "revolute" else 2,
                "axis": (frame[:3, :3] @ part.joint.axis).round(9).tolist(),
                # rounded to a micrometre, so that files stay small
                "origin": (frame[:3, :3] @ part.joint.origin + frame[:3, 3]).round(6).tolist(),
                "rest": part.joint.rest,
                "closed": part.joint.closed,
                "opened": part.joint.opened,
                "handle": handle.round(4).tolist(),
                "nodes": [name for name in part.instances if name not in movable],
            }
        )
    return rigs
