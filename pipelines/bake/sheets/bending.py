"""Script for docs/pictures/bending.jpg: bent limbs of several bodies, above by plain skin and below with half joints.

python -m bake.sheets.bending docs/pictures/bending.jpg
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import JOINT_INDEX, Humanoid, load_humanoid
from h3data.bodies.people.look.patches import vertex_normals
from h3data.bodies.people.sitting import sitting_on
from h3data.geometry import IDENTITY_POSE, Array, normalized
from h3data.mesh.mesh import Mesh
from h3data.render.camera import look_at, pinhole
from h3data.render.image_files import write_jpg
from h3data.render.renderer import Renderer
from h3data.render.scene import RenderInstance, RenderScene

CASES = (
    ("male_0", "knee", 130.0, (1.0, 0, 0), (1.0, 0.1, 0.35)),
    ("female_3", "elbow", 130.0, (0, -1.0, 0), (0.1, 1.0, 0.4)),
    ("male_1", "shoulder", 75.0, (0, 0, 1.0), (0.2, 0.3, 1.0)),
)
"""Body, left joint, angle [deg], axis of the bend in the T-pose, and direction of the camera."""
SEATED = ("female_1", 0.3), ("male_2", 0.45)
"""Body and height of a seat [m]."""
SIDE_PX, HFOV_DEG = 300, 24.0


def photo(body: Humanoid, frames: Array, at: Array, toward: Array, *, plain: bool) -> NDArray[np.uint8]:
    """Return a picture [S, S, 3] of a posture, of what is around a point [3] [m]."""
    vertices = body.skin(frames, lod=False, plain=plain)[0]
    normals = vertex_normals(vertices, body.mesh.faces)
    mesh = Mesh(vertices=vertices, faces=body.mesh.faces, colors=body.mesh.colors, normals=normals)
    pose = look_at(tuple(at + toward), tuple(at))
    renderer = Renderer(RenderScene([mesh], [RenderInstance(mesh=0, matrix=np.eye(4))]))
    return renderer.render(pinhole(SIDE_PX, SIDE_PX, hfov_deg=HFOV_DEG, pose=pose), outputs=("rgb",), samples=4)["rgb"]


def main(out: str) -> None:
    """Render the picture."""
    columns = []
    for name, joint, angle, axis, toward in CASES:
        body, half = load_humanoid(name), np.radians(angle) / 2
        quats = np.tile([0.0, 0, 0, 1], (1, 54, 1))
        quats[0, JOINT_INDEX[f"left_{joint}"] - 1] = [*(np.sin(half) * np.array(axis)), np.cos(half)]
        frames = body.joint_matrices_free(np.array([[0, 1.0, 0, 0, 0, 0, 1]]), quats)
        at, seen = frames[0, JOINT_INDEX[f"left_{joint}"], :3, 3], 1.3 * normalized(np.array(toward))
        columns.append([photo(body, frames, at, seen, plain=plain) for plain in (True, False)])
    for name, height in SEATED:
        sitting = sitting_on(load_humanoid(name), height)
        frames = sitting.body.joint_matrices(IDENTITY_POSE, *sitting.pose(1.0))
        at, seen = np.array([-0.15, 0.42, 0]), np.array([1.0, 0.3, -2.2])
        columns.append([photo(sitting.body, frames, at, seen, plain=plain) for plain in (True, False)])
    write_jpg(out, np.hstack([np.vstack(column) for column in columns]))


if __name__ == "__main__":
    main(*sys.argv[1:])
