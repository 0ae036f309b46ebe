"""Posing of all parts of a recording at all steps, for the writers of other formats."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid
from h3data.bodies.people.humanoid import SkinnedMesh as PersonMesh
from h3data.bodies.people.skeleton import HALF_JOINTS, HUMAN_ROOT_HEIGHT_M
from h3data.bodies.people.skinning import Influences
from h3data.errors import SceneError
from h3data.geometry import (
    Array,
    pose_from_matrix,
    pose_multiply,
    pose_to_matrix,
    quat_from_heading,
    quat_sign_continuous,
)
from h3data.recording.assets.skinned_meshes import SkinnedMesh
from h3data.render import OPENGL_TO_OPENCV
from h3data.replay.cameras import THIRD_PERSON, camera_names, camera_track
from h3data.replay.records import JointTrack, LinkTrack, PersonTrack, RigTrack
from h3data.replay.replay import Replay
from h3data_exporters.posed_parts import PosedCamera, PosedPart, Skeleton

_ROOT_OF_PERSON = np.array([0, HUMAN_ROOT_HEIGHT_M, 0, *quat_from_heading(np.pi / 2)])
"""habitat-lab's humanoid root in the agent's root frame: at that height, z forward."""


def posed_parts(replay: Replay, steps: NDArray[np.integer] | None = None) -> list[PosedPart]:
    """Return one part for each of `Replay.drawables`, in their order, posed at ``steps`` (all by default)."""
    steps = np.arange(len(replay)) if steps is None else steps
    bodies = {body.name: body for body in replay.recording.bodies}
    parts = []
    for drawable, track in zip(replay.drawables, replay.tracks, strict=True):
        body, scale, skeleton = bodies.get(drawable.name), np.ones(3), None
        if isinstance(track, LinkTrack):
            body, poses = None, _poses(replay.link_track(track.agent, track.link, steps))
        elif isinstance(track, PersonTrack):
            body = None
            base = replay.recording.agent_column(track.agent, "base_pose")[steps].astype(np.float64)
            poses, skeleton = pose_multiply(base, _ROOT_OF_PERSON), _skeleton_of_person(replay, track.agent, steps)
        else:
            assert body is not None
            poses, scale = body.pose.astype(np.float64)[None], body.scale.astype(np.float64)
            if body.moving >= 0:
                poses = replay.recording.columns["object_pose"][steps, body.moving].astype(np.float64)
            if isinstance(track, JointTrack):
                motions = replay.joint_motions(steps)[:, track.joint]
                poses = _poses(motions @ pose_to_matrix(body.pose.astype(np.float64)))
            if isinstance(track, RigTrack):
                skeleton = _skeleton_of_rig(replay, track, steps, poses, scale)
        parts.append(
            PosedPart(
                name=drawable.name,
                mesh=drawable.mesh,
                poses=poses,
                scale=scale,
                semantic_id=drawable.semantic_id,
                agent=drawable.agent,
                body=body,
                placeholder=drawable.placeholder,
                skeleton=skeleton,
            )
        )
    return parts


def posed_cameras(replay: Replay) -> list[PosedCamera]:
    """Return the cameras of robots and people, and those that the recording contains."""
    cameras = []
    for name in camera_names(replay):
        # views that every replay has, which nobody carries
        if name.rpartition("/")[2] in ("top_down", "top_down_orthographic", "orbit", THIRD_PERSON):
            continue
        track = camera_track(replay, name)
        camera = track.camera
        if name.startswith("user."):
            poses = replay.recording.columns[name].astype(np.float64)
        else:
            # ours look along +z with y down, those of glTF along -z with y up
            poses = _poses(np.asarray(track.poses, np.float64) @ OPENGL_TO_OPENCV)
        cameras.append(
            PosedCamera(
                name=name,
                poses=poses,
                vfov_rad=2 * float(np.arctan2(camera.height / 2, camera.fy)),
                aspect=camera.width / camera.height,
                near_m=camera.near,
            )
        )
    return cameras


def drawn_note(missing: Sequence[str], *, stand_ins: bool) -> str:
    """Return a note on missing asset files for an export that writes stand-ins for them."""
    if stand_ins:
        return missing_note(missing, "have built-in bodies and named boxes in their place")
    note = missing_note(missing, "are marked placeholders")
    return note and f"{note}, or --stand-ins for plain bodies and named boxes"


def missing_note(missing: Sequence[str], consequence: str) -> str:
    """Return a note on missing asset files for users; empty if all files were found."""
    return f"\n{len(missing)} asset files were not found and {consequence}. Hint: --assets DIR" if missing else ""


def _poses(matrices: Array) -> Array:
    """Return pose7 [T, ..., 7] of rigid matrices, sign-continuous; NaN where they are."""
    poses = pose_from_matrix(np.asarray(matrices, np.float64))
    poses[..., 3:] = quat_sign_continuous(poses[..., 3:])
    return poses


def _skeleton_of_person(replay: Replay, agent: int, steps: NDArray[np.integer]) -> Skeleton:
    body = replay.model(agent)
    assert isinstance(body, Humanoid)
    mesh: PersonMesh = body.lod if replay.detail is False else body.full
    return Skeleton(
        names=(*body.joint_names, *HALF_JOINTS),
        parents=(*body.parents, *(body.parents[joint] for joint in HALF_JOINTS.values())),
        poses=_poses(body.skin_frames(replay.joint_matrices(agent, steps))),
        inverse_bind=np.asarray(body.skin_bind, np.float64),
        influences=_influences(*mesh.influences),
    )


def _skeleton_of_rig(
    replay: Replay, track: RigTrack, steps: NDArray[np.integer], roots: Array, scale: Array
) -> Skeleton:
    """Return the joints as `h3data.recording.assets.skinned_meshes` moves them, and one more for parts that no skin moves.

    There a vertex of the file goes to root F rigid(root)^-1 bone_j inverse_bind_j v, with ``root`` scaled and F the file's
    axes; here meshes are F v, so B_j = inverse_bind_j F^-1, brought to unit scale.
    """
    skin: SkinnedMesh = track.skin
    size = float(scale[0]) * float(np.cbrt(np.linalg.det(skin.to_metres[:3, :3])))
    if not np.allclose(scale, scale[0]):
        raise SceneError(
            f"A skinned body with a scale that is not uniform cannot be exported: {track.body.name!r}.",
            code="H3-EXPORT-030",
        )
    # F without its scale, which is in `size` and becomes that of the joints
    frame = skin.to_metres.copy()
    frame[:3, :3] /= size / float(scale[0])
    rigid = np.broadcast_to(pose_to_matrix(roots), (len(steps), 4, 4))
    bones = pose_to_matrix(replay.recording.columns[track.column][steps].astype(np.float64))
    # NaN has no inverse: an absent body gets any frame here, and NaN again below
    local = np.linalg.inv(np.nan_to_num(rigid) + np.where(np.isnan(rigid), np.eye(4), 0))[:, None] @ bones
    local[:, :, :3, 3] *= size
    of_bone = {name: number for number, name in enumerate(track.bones)}
    names = (*skin.joint_names, "rest of the body")
    still = np.broadcast_to(np.eye(4), (len(steps), 4, 4))
    joints = np.stack([local[:, of_bone[n]] if n in of_bone else still for n in skin.joint_names] + [still], 1)
    unbound = np.array([n not in of_bone for n in names])
    # without a bone the body itself moves the vertex, from where it is at rest
    binds = np.concatenate([np.where(unbound[:-1, None, None], np.eye(4), skin.inverse_bind), np.eye(4)[None]])
    return Skeleton(
        names=names,
        parents=(-1,) * len(names),
        poses=_poses(rigid[:, None] @ frame @ joints),
        scale=size,
        inverse_bind=binds @ np.linalg.inv(skin.to_metres),
        influences=_influences_of_operator(skin),
    )


def _influences_of_operator(skin: SkinnedMesh) -> Influences:
    """Return joints and weights [V, 4] from the skinning operator, whose every fourth column holds the bare weights."""
    weights = skin.points.toarray()[:, 3::4]
    # glTF has four joints for each vertex; the rest of the weight is spread over them
    joints = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    if joints.shape[1] < 4:
        joints = np.pad(joints, ((0, 0), (0, 4 - joints.shape[1])))
        first = np.arange(4) < weights.shape[1]
        return _influences(joints, np.where(first, np.take_along_axis(weights, joints, 1), 0))
    return _influences(joints, np.take_along_axis(weights, joints, 1))


def _influences(joints: NDArray[np.integer], weights: Array) -> Influences:
    """Return the skin with weights that sum to 1 as closely as float32 can."""
    shares = weights.astype(np.float64)
    shares /= shares.sum(1, keepdims=True)
    return Influences(joints=joints.astype(np.uint8), weights=shares.astype(np.float32))
