"""Contact sheets of robots from all sides, at rest or with the hand moved along a circle by inverse kinematics."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.robots.ik import solve_ik
from h3data.bodies.robots.robot import Robot
from h3data.geometry import Array, ground_pose
from h3data.mesh.mesh import Mesh
from h3data.render.camera import look_at, pinhole
from h3data.render.renderer import Renderer
from h3data.render.scene import RenderInstance, RenderScene
from h3data.render.sheets.people_sheet import floor_mesh

HFOV_DEG, PITCH_DEG, MARGIN_M = 14.0, 12.0, 0.12
FLOOR = (226, 226, 222)
FIRST_DEG = 35.0
"""Heading in the first view, in which forward points right and slightly towards the camera [deg]."""
CIRCLE_M, AHEAD_M = 0.22, 0.12
"""Radius of the hand's circle, and distance of its centre in front of the resting hand [m]."""


def turntable(robot: Robot, *, views: int = 6, width: int = 1600, reaching: bool = False) -> NDArray[np.uint8]:
    """Render a robot at equally spaced headings as RGB [H, W, 3]; ``reaching`` moves its hand along a circle."""
    if reaching and robot.hand_link >= 0:
        postures = solve_ik(
            robot, robot.links[robot.hand_link].name, _circle(robot, views), offset=robot.hand_position
        ).joint_pos
    else:
        postures = np.tile(robot.rest, (views, 1))
    headings = np.radians(FIRST_DEG) * -1 + np.arange(views) * 2 * np.pi / views
    frames = robot.link_matrices(ground_pose(np.zeros((views, 2)), headings), postures)
    visuals = [(k, link.mesh) for k, link in enumerate(robot.links) if link.mesh is not None]
    if not visuals:
        visuals = [(0, floor_mesh(FLOOR))]
    reach, top = _extent(frames, visuals)
    instances = [RenderInstance(mesh=n, matrix=frames[0, k]) for n, (k, _) in enumerate(visuals)]
    instances.append(RenderInstance(mesh=len(visuals), matrix=np.eye(4)))
    renderer = Renderer(RenderScene([mesh for _, mesh in visuals] + [floor_mesh(FLOOR)], instances))
    span, pitch = 2 * (reach + MARGIN_M), np.radians(PITCH_DEG)
    distance = span / 2 / np.tan(np.radians(HFOV_DEG) / 2)
    across = width // views
    high = round(across * (top * np.cos(pitch) + 2 * reach * np.sin(pitch) + 2 * MARGIN_M) / span)
    middle = np.array([0, top / 2, 0])
    pose = look_at(middle + distance * np.array([0, np.sin(pitch), np.cos(pitch)]), middle)
    camera = pinhole(across, high, hfov_deg=HFOV_DEG, pose=pose)
    pictures = []
    for frame in frames:
        renderer.set_transforms(range(len(visuals)), np.stack([frame[k] for k, _ in visuals]))
        pictures.append(renderer.render(camera, outputs=("rgb",), samples=4)["rgb"])
    return np.concatenate(pictures, axis=1)


def _circle(robot: Robot, count: int) -> Array:
    """Return the hand positions [count, 3] in the agent root frame, on a vertical circle that faces forward."""
    rest = robot.link_matrices(np.array([[0, 0, 0, 0, 0, 0, 1.0]]), robot.rest[None])[0, robot.hand_link]
    middle = rest[:3, :3] @ robot.hand_position + rest[:3, 3] + [AHEAD_M, 0, 0]
    angle = np.arange(count) * 2 * np.pi / count
    return middle + CIRCLE_M * np.stack([np.zeros(count), np.sin(angle), np.cos(angle)], axis=-1)


def _extent(frames: Array, visuals: list[tuple[int, Mesh]]) -> tuple[float, float]:
    """Return the largest distance from the vertical axis, and largest height, in link frames [T, L, 4, 4] [m]."""
    corners = [
        _corners(mesh) @ np.swapaxes(frames[:, k, :3, :3], 1, 2) + frames[:, k, None, :3, 3] for k, mesh in visuals
    ]
    points = np.concatenate(corners, axis=1)
    return float(np.hypot(points[..., 0], points[..., 2]).max()), float(points[..., 1].max())


def _corners(mesh: Mesh) -> Array:
    lo, hi = mesh.bounds
    return np.array([[x, y, z] for x in (lo[0], hi[0]) for y in (lo[1], hi[1]) for z in (lo[2], hi[2])])
