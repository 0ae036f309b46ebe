"""Script for docs/pictures/mjcf.jpg: robots from h3data's own MJCF files at rest, each from three sides.

python -m bake.sheets.mjcf tests/data/mjcf/barrow.xml,tests/data/mjcf/porter.xml docs/pictures/mjcf.jpg
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import load_robot
from h3data.geometry import IDENTITY_POSE
from h3data.mesh.primitives import box_mesh
from h3data.render import Renderer, RenderInstance, RenderScene, look_at, pinhole
from h3data.render.image_files import write_jpg

WIDTH, HEIGHT = 420, 360
SIDES_DEG = (-40.0, 40.0, 140.0)


def main(robot_files: str, out: str) -> None:
    """Render the robots at rest, a row for each, and write the picture."""
    write_jpg(out, np.vstack([_row(file) for file in robot_files.split(",")]))


def _row(robot_file: str) -> NDArray[np.uint8]:
    robot = load_robot(robot_file)
    frames = robot.link_matrices(IDENTITY_POSE[None], robot.rest[None])[0]
    shown = [(link.mesh, frame) for link, frame in zip(robot.links, frames, strict=True) if link.mesh is not None]
    high = max(float((mesh.vertices @ frame[:3, :3].T + frame[:3, 3])[:, 1].max()) for mesh, frame in shown)
    ground = np.eye(4)
    ground[1, 3] = -0.01
    shown.append((box_mesh(np.array([4.0, 0.01, 4.0]), color=(206, 206, 200)), ground))
    instances = [RenderInstance(k, frame) for k, (_, frame) in enumerate(shown)]
    renderer = Renderer(RenderScene([mesh for mesh, _ in shown], instances))
    middle, away_m, pictures = np.array([0.05, 0.5 * high, 0.0]), max(1.9, 1.6 * high), []
    for side in np.radians(SIDES_DEG):
        eye = middle + away_m * np.array([np.cos(side), 0.45, np.sin(side)])
        camera = pinhole(WIDTH, HEIGHT, hfov_deg=45.0, pose=look_at(eye, middle))
        pictures.append(renderer.render(camera, outputs=("rgb",), samples=4)["rgb"])
    return np.hstack(pictures)


if __name__ == "__main__":
    main(*sys.argv[1:])
