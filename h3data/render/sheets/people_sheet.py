"""Images of people in postures, side by side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.humanoid import Humanoid
from h3data.geometry import Array, ground_pose, pose_to_matrix, transform_points
from h3data.mesh.mesh import Mesh
from h3data.mesh.mesh_operations import painted
from h3data.render.camera import look_at, pinhole
from h3data.render.renderer import Renderer
from h3data.render.scene import RenderInstance, RenderScene

SPACING_M, STRIDE_SPACING_M, ROW_M, HFOV_DEG = 0.95, 1.25, 2.05, 16.0


def lined_up(
    poses: Sequence[tuple[Humanoid, Array, Array]],
    heading: float,
    lod: bool,
    places: int,
    width: int,
    *,
    spacing: float = SPACING_M,
    row_m: float = ROW_M,
    props: Sequence[Sequence[Mesh]] = (),
) -> NDArray[np.uint8]:
    """Render people in given poses, side by side from left to right, RGB [H, W, 3].

    Args:
        poses: Body, local joint rotations [1, 55, 4] and pelvis position [1, 3] [m] of each person.
        heading: Heading of all people [rad].
        lod: True to render the simplified meshes.
        places: Number of places in the row, at least the number of people.
        width: Width of the image [px].
        spacing: Distance between neighbours [m].
        row_m: Height of the visible part of the row [m].
        props: Objects beside each person, in their agent root frame.
    """
    meshes, positions = [], (np.arange(len(poses)) - (places - 1) / 2) * spacing
    for k, (x, (body, quats, pelvis)) in enumerate(zip(positions, poses, strict=True)):
        base = ground_pose(np.array([[x, 0.0]]), np.array([heading]))
        joints = body.joint_matrices(base, quats, pelvis)
        for prop in props[k] if props else ():
            vertices = transform_points(pose_to_matrix(base[0]), prop.vertices).astype(np.float32)
            meshes.append(Mesh(vertices=vertices, faces=prop.faces, colors=prop.colors))
        meshes.append(skinned(body, joints, lod))
    wall = (232, 233, 236)
    meshes.append(floor_mesh(wall))
    renderer = Renderer(RenderScene(meshes, [RenderInstance(mesh=k, matrix=np.eye(4)) for k in range(len(meshes))]))
    span = places * spacing
    # a long lens from far away, so that people at the sides are not seen from the side
    distance = span / 2 / np.tan(np.radians(HFOV_DEG) / 2)
    height = round(width * row_m / span)
    middle = row_m / 2 - 0.04
    pose = look_at((0.0, middle + 0.06 * distance, distance), (0.0, middle, 0.0))
    return renderer.render(pinhole(width, height, hfov_deg=HFOV_DEG, pose=pose), outputs=("rgb",), samples=4)["rgb"]


def skinned(body: Humanoid, joints: Array, lod: bool) -> Mesh:
    """Return a body in a posture as one mesh."""
    rest = body.lod_mesh if lod else body.mesh
    return Mesh(
        vertices=np.ascontiguousarray(body.skin(joints, lod=lod)[0]),
        faces=rest.faces,
        colors=rest.colors,
        normals=np.ascontiguousarray(body.skin_normals(joints, lod=lod)[0]),
    )


def floor_mesh(color: tuple[int, int, int]) -> Mesh:
    """Return a square floor of 14 m around the origin in one colour."""
    half = 7.0
    corners = np.array([[-half, 0, -half], [-half, 0, half], [half, 0, half], [half, 0, -half]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return painted(Mesh(vertices=corners, faces=faces, colors=np.zeros((4, 3), np.uint8)), color)
