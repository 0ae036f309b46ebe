"""Pictures of people who reach: a strip of targets per body, and one who picks something up, carries it and puts it down."""

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
    "floor": (0.38, 0.05, 0.12), "knee": (0.38, 0.36, 0.12), "waist": (0.40, 0.68, 0.12), "far": (0.56, 0.78, 0.10),
    "chest": (0.42, 0.98, 0.10), "overhead": (0.22, 1.30, 0.15), "side": (0.12, 0.90, 0.48), "across": (0.32, 0.75, -0.16),
}  # fmt: skip
"""Forward, up and to the hand's side, in heights of the shoulder."""
TURNED_DEG, SPACING_M, ROW_M = -38.0, 1.2, 2.16
BALL_M, BALL = 0.032, (206, 58, 48)
TABLE, MUG = (176, 138, 96), (206, 58, 48)
MUG_SIZE_M, TABLE_SIZE_M = (0.036, 0.09), (0.30, 0.03, 0.40)
TABLES = ((0.36, 0.36, 0.12), (0.36, 0.66, 0.12))
"""Where the mug stands before and after, as `TARGETS`."""


def reach_picture(people: Sequence[Humanoid], *, lod: bool = False, width: int = 1600) -> NDArray[np.uint8]:
    """RGB [H, W, 3]: a row of reaches per body, with the right and the left hand in turn, and a row of `carrying`."""
    rows = [_reaches(body, HANDS[k % 2], lod, width) for k, body in enumerate(people)]
    return np.concatenate([*rows, carrying(people[0], lod=lod, width=width)])


def _reaches(body: Humanoid, hand: Hand, lod: bool, width: int) -> NDArray[np.uint8]:
    poses, props = [], []
    for spot in TARGETS.values():
        target = _spot(body, hand, spot)
        result = reach(body, target, hand)
        poses.append((body, result.quats[None], result.pelvis[None]))
        props.append([_ball(target)])
    heading = TURNED_DEG if hand == "right" else -180 - TURNED_DEG
    return _row(poses, props, heading, lod, width)


def carrying(body: Humanoid, *, hand: Hand = "right", lod: bool = False, width: int = 1600) -> NDArray[np.uint8]:
    """Somebody takes a mug from a low table, walks with it and puts it on a higher one, RGB [H, W, 3]."""
    person = Person(body, ground_pose([0.0, 0.0], 0.0))
    mug = _spot(body, hand, TABLES[0])
    person.objects["mug"] = np.concatenate([mug, [0, 0, 0, 1.0]])
    picking, _ = run(person, person.pick("mug", hand))
    walking, _ = run(person, person.walk_to([[2.0, 0.0]]))
    goal = person.base[:3] + quat_rotate(person.base[3:], _spot(body, hand, TABLES[1]))
    placing, _ = run(person, person.place(goal, hand))
    taken = next(k for k, f in enumerate(picking) if np.any(f.objects["mug"][:3] != mug))
    let_go = max(k for k, f in enumerate(placing) if np.any(f.objects["mug"] != placing[-1].objects["mug"]))
    moments = [
        picking[taken // 2], picking[taken], picking[(taken + len(picking)) // 2], walking[len(walking) // 3],
        walking[len(walking) // 3 + 9], placing[let_go // 2], placing[let_go], placing[-1],
    ]  # fmt: skip
    tables = [mug] * 3 + [None] * 2 + [goal] * 3
    poses, props = zip(*(_moment(body, f, table) for f, table in zip(moments, tables, strict=True)), strict=True)
    return _row(list(poses), list(props), TURNED_DEG, lod, width)


def _moment(body: Humanoid, frame: Frame, table: Array | None) -> tuple[tuple[Humanoid, Array, Array], list[Mesh]]:
    """The pose and the things around it, as the agent root sees them."""
    seen = pose_inverse(frame.base)
    root, mug = pose_multiply(seen, frame.root), pose_multiply(seen, frame.objects["mug"])
    props = [_mug(mug)]
    if table is not None:
        top = transform_points(pose_to_matrix(seen), table[None])[0] - [
            -0.04,
            MUG_SIZE_M[1] / 2 + TABLE_SIZE_M[1] / 2,
            0,
        ]
        legs = top - [0, TABLE_SIZE_M[1] / 2 + (top[1] - TABLE_SIZE_M[1] / 2) / 2, 0]
        props += [_box(top, TABLE_SIZE_M), _box(legs, (0.05, top[1] - TABLE_SIZE_M[1] / 2, 0.05))]
    return (body, np.concatenate([root[3:], frame.joints.ravel()]).reshape(1, 55, 4), root[None, :3]), props


def _row(
    poses: Sequence[tuple[Humanoid, Array, Array]], props: Sequence[Sequence[Mesh]], heading_deg: float, lod: bool, width: int
) -> NDArray[np.uint8]:  # fmt: skip
    heading = float(np.radians(heading_deg))
    return lined_up(poses, heading, lod, len(poses), width, spacing=SPACING_M, row_m=ROW_M, props=props)


def _spot(body: Humanoid, hand: Hand, spot: tuple[float, float, float]) -> Array:
    return np.array(spot) * (1, 1, 1 if hand == "right" else -1) * reacher(body, hand).body.scale


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
    flat = transform_points(matrix, vertices)[faces.ravel()] + offset  # a corner per face: edges stay sharp
    return Mesh(
        vertices=flat.astype(np.float32), faces=np.arange(len(flat), dtype=np.int32).reshape(-1, 3),
        colors=np.tile(np.array(color, np.uint8), (len(flat), 1)),
    )  # fmt: skip
