"""Contact sheets of people who stand in rows or walk, and of their heads."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.humanoid import Humanoid
from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.geometry import ground_pose
from h3data.render.camera import look_at, pinhole
from h3data.render.renderer import Renderer
from h3data.render.scene import RenderInstance, RenderScene
from h3data.render.sheets.people_sheet import STRIDE_SPACING_M, lined_up, skinned

FACE_HFOV_DEG, FACE_DISTANCE_M, FACE_TURN_DEG = 11.0, 2.0, 14.0


def sheet_picture(
    people: Sequence[Humanoid], *, heading_deg: float = -90.0, lod: bool = False, columns: int = 6, width: int = 1600
) -> NDArray[np.uint8]:
    """Render people in rows of ``columns`` as RGB [H, W, 3]; at a heading of -90 degrees they face the camera."""
    rows = [people[k : k + columns] for k in range(0, len(people), columns)]
    heading, places = float(np.radians(heading_deg)), min(columns, len(people))
    standing = [[(body, *body.clip_pose([0], [0.0])) for body in row] for row in rows]
    return np.concatenate([lined_up(row, heading, lod, places, width) for row in standing])


def face_picture(
    people: Sequence[Humanoid], *, lod: bool = False, columns: int = 6, width: int = 1600
) -> NDArray[np.uint8]:
    """Render heads from the front and a little from the side, in rows of ``columns``, as RGB [H, W, 3]."""
    size = width // min(columns, len(people))
    turn = np.radians(FACE_TURN_DEG)
    pictures = []
    for body in people:
        base = ground_pose(np.array([[0.0, 0.0]]), np.array([-np.pi / 2]))
        joints = body.joint_matrices(base, *body.clip_pose([0], [0.0]))
        eyes = joints[0, [JOINT_INDEX["left_eye_smplhf"], JOINT_INDEX["right_eye_smplhf"]], :3, 3].mean(axis=0)
        target = eyes - [0.0, 0.035, 0.08]
        mesh = skinned(body, joints, lod)
        renderer = Renderer(RenderScene([mesh], [RenderInstance(mesh=0, matrix=np.eye(4))]))
        pose = look_at(target + FACE_DISTANCE_M * np.array([np.sin(turn), 0.02, np.cos(turn)]), target)
        camera = pinhole(size, size, hfov_deg=FACE_HFOV_DEG, pose=pose)
        pictures.append(renderer.render(camera, outputs=("rgb",), samples=4)["rgb"])
    blank = np.full_like(pictures[0], 255)
    rows = [pictures[k : k + columns] for k in range(0, len(pictures), columns)]
    full = [row + [blank] * (min(columns, len(people)) - len(row)) for row in rows]
    return np.concatenate([np.concatenate(row, axis=1) for row in full])


def walk_picture(
    body: Humanoid, speed_mps: float, *, frames: int = 8, lod: bool = False, width: int = 1600
) -> NDArray[np.uint8]:
    """Render phases of one walking cycle at a speed, from left to right, seen from the right, as RGB [H, W, 3]."""
    phase = np.arange(frames) / frames
    quats, pelvis = body.walk_pose(np.full(frames, speed_mps), phase)
    poses = [(body, quats[k : k + 1], pelvis[k : k + 1]) for k in range(frames)]
    return lined_up(poses, 0.0, lod, frames, width, spacing=STRIDE_SPACING_M)
