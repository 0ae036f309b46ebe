"""Sheets of reaching people: poses for a set of targets, and a mug being picked up, carried and placed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid
from h3data.bodies.people.reach import HANDS, Hand, reach, reacher
from h3data.geometry import (
    Array,
    ground_pose,
    pose_inverse,
    pose_multiply,
    pose_to_matrix,
    quat_rotate,
    transform_points,
)
from h3data.mesh.mesh import Mesh
from h3data.render.sheets.people_sheet import lined_up
from sim_kinematic.agents.person import Frame, Person, run

TARGETS = {
    "floor": (0.38, 0.05, 0.12),
    "knee": (0.38, 0.36, 0.12),
    "waist": (0.40, 0.68, 0.12),
    "far": (0.56, 0.78, 0.10),
    "chest": (0.42, 0.98, 0.10),
    "overhead": (0.22, 1.30, 0.15),
    "side": (0.12, 0.90, 0.48),
    "across": (0.32, 0.75, -0.16),
}
"""Reach targets: forward, up and towards the hand's side, in units of the shoulder height."""
TURNED_DEG, SPACING_M, ROW_M = -38.0, 1.2, 2.16
BALL_M, BALL = 0.032, (206, 58, 48)
TABLE, MUG = (176, 138, 96), (206, 58, 48)
MUG_SIZE_M, TABLE_SIZE_M = (0.036, 0.09), (0.30, 0.03, 0.40)
TABLES = ((0.36, 0.36, 0.12), (0.36, 0.66, 0.12))
"""Positions of the mug before and after carrying, in the frame and units of `TARGETS`."""


def reach_picture(people: Sequence[Humanoid], *, lod: bool = False, width: int = 1600) -> NDArray[np.uint8]:
    """Render a row of reaching poses per body, alternating hands, and a row of `carrying`, as RGB [H, W, 3]."""
    rows = [_reaching_row(body, HANDS[k % 2], lod, width) for k, body in enumerate(people)]
    return np.concatenate([*rows, carrying(people[0], lod=lod, width=width)])


def _reaching_row(body: Humanoid, hand: Hand, lod: bool, width: int) -> NDArray[np.uint8]:
    poses, props = [], []
    for relative in TARGETS.values():
        target = _in_root_frame(body, hand, relative)
        result = reach(body, target, hand)
        poses.append((body, result.quats[None], result.pelvis[None]))
        props.append([_ball(target)])
    heading = TURNED_DEG if hand == "right" else -180 - TURNED_DEG
    return _row(poses, props, heading, lod, width)


def carrying(body: Humanoid, *, hand: Hand = "right", lod: bool = False, width: int = 1600) -> NDArray[np.uint8]:
    """Render a person who takes a mug from a low table and carries it to a higher one, as RGB [H, W, 3]."""
    person = Person(body, ground_pose([0.0, 0.0], 0.0))
    mug = _in_root_frame(body, hand, TABLES[0])
    person.objects["mug"] = np.concatenate([mug, [0, 0, 0, 1.0]])
    picking, _ = run(person, person.pick("mug", hand))
    walking, _ = run(person, person.walk_to([[2.0, 0.0]]))
    goal = person.base[:3] + quat_rotate(person.base[3:], _in_root_frame(body, hand, TABLES[1]))
    placing, _ = run(person, person.place(goal, hand))
    grasp = next(k for k, f in enumerate(picking) if np.any(f.objects["mug"][:3] != mug))
    release = max(k for k, f in enumerate(placing) if np.any(f.objects["mug"] != placing[-1].objects["mug"]))
    moments = [
        picking[grasp // 2],
        picking[grasp],
        picking[(grasp + len(picking)) // 2],
        walking[len(walking) // 3],
        walking[len(walking) // 3 + 9],
        placing[release // 2],
        placing[release],
        placing[-1],
    ]
    tables = [mug] * 3 + [None] * 2 + [goal] * 3
    poses, props = zip(*(_moment(body, f, table) for f, table in zip(moments, tables, strict=True)), strict=True)
    return _row(list(poses), list(props), TURNED_DEG, lod, width)


def _moment(body: Humanoid, frame: Frame, table: Array | None) -> tuple[tuple[Humanoid, Array, Array], list[Mesh]]:
    """Return the pose of the person and meshes of mug and table (at the mug position ``table``), in the agent's root frame."""
    to_root = pose_inverse(frame.base)
    root, mug = pose_multiply(to_root, frame.root), pose_multiply(to_root, frame.objects["mug"])
    props = [_mug(mug)]
    if table is not None:
        below_mug = [-0.04, MUG_SIZE_M[1] / 2 + TABLE_SIZE_M[1] / 2, 0]
        top = transform_points(pose_to_matrix(to_root), table[None])[0] - below_mug
        legs = top - [0, TABLE_SIZE_M[1] / 2 + (top[1] - TABLE_SIZE_M[1] / 2) / 2, 0]
        props += [_box(top, TABLE_SIZE_M), _box(legs, (0.05, top[1] - TABLE_SIZE_M[1] / 2, 0.05))]
    return (body, np.concatenate([root[3:], frame.joints.ravel()]).reshape(1, 55, 4), root[None, :3]), props


def _row(
    poses: Sequence[tuple[Humanoid, Array, Array]],
    props: Sequence[Sequence[Mesh]],
    heading_deg: float,
    lod: bool,
    width: int,
) -> NDArray[np.uint8]:
    heading = float(np.radians(heading_deg))
    return lined_up(poses, heading, lod, len(poses), width, spacing=SPACING_M, row_m=ROW_M, props=props)


def _in_root_frame(body: Humanoid, hand: Hand, relative: tuple[float, float, float]) -> Array:
    """Scale a target as in `TARGETS` to the body, mirrored for the left hand, [3] [m]."""
    return np.array(relative) * (1, 1, 1 if hand == "right" else -1) * reacher(body, hand).body.scale


def _ball(center: Array) -> Mesh:
    import trimesh

    return _mesh(trimesh.creation.icosphere(subdivisions=2, radius=BALL_M), np.eye(4), BALL, center)


def _box(center: Array, size: Sequence[float]) -> Mesh:
    import trimesh

    return _mesh(trimesh.creation.box(size), np.eye(4), TABLE, center)


def _mug(pose: Array) -> Mesh:
    import trimesh

    upright = trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0))
    shape = trimesh.creation.cylinder(MUG_SIZE_M[0], MUG_SIZE_M[1], sections=24, transform=upright)
    return _mesh(shape, pose_to_matrix(pose), MUG, np.zeros(3))


def _mesh(shape: object, matrix: Array, color: tuple[int, int, int], offset: Array) -> Mesh:
    vertices, faces = np.asarray(getattr(shape, "vertices")), np.asarray(getattr(shape, "faces"))  # noqa: B009
    corners = transform_points(matrix, vertices)[faces.ravel()] + offset  # unshared vertices keep edges sharp
    return Mesh(
        vertices=corners.astype(np.float32),
        faces=np.arange(len(corners), dtype=np.int32).reshape(-1, 3),
        colors=np.tile(np.array(color, np.uint8), (len(corners), 1)),
    )
