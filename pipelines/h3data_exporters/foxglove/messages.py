"""Functions that build Foxglove's standard messages (needs the extra ``h3data[foxglove]``)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointState_pb2 import JointState
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.ModelPrimitive_pb2 import ModelPrimitive
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp

from h3data.geometry import Array, pose_multiply
from h3data.render.camera import Camera

_TURN = np.array([0, 0, 0, -np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
"""Rotation that undoes the 90 degrees about x by which viewers of these messages, with +Z up, turn glTF models."""
_TAG_M = 0.18


def stamp(time_ns: int) -> Timestamp:
    """Return a time [ns] as seconds and nanoseconds since 1970."""
    return Timestamp(seconds=time_ns // 1_000_000_000, nanos=time_ns % 1_000_000_000)


def transforms(time_ns: int, frames: Sequence[tuple[str, str, Array]]) -> FrameTransforms:
    """Return the message with frames, each given as ``(parent, child, pose7 of the child in its parent)``."""
    at = stamp(time_ns)
    return FrameTransforms(
        transforms=[
            FrameTransform(
                timestamp=at,
                parent_frame_id=parent,
                child_frame_id=child,
                translation=_vector(pose),
                rotation=_turn(pose),
            )
            for parent, child, pose in frames
        ]
    )


def model(glb: bytes, pose: Array, scale: Array) -> ModelPrimitive:
    """Return a GLB model with a pose7 and a scale in the frame of its entity."""
    across, up, along = scale
    size = Vector3(x=across, y=along, z=up)  # axes after the viewer's turn
    return ModelPrimitive(pose=_pose(pose_multiply(pose, _TURN)), scale=size, data=glb, media_type="model/gltf-binary")


def entity(
    time_ns: int, frame: str, name: str, *, models: Sequence[ModelPrimitive] = (), texts: Sequence[TextPrimitive] = ()
) -> SceneEntity:
    """Return an entity of models that moves with a frame."""
    # locked, so that viewers move it with its frame after this message too
    return SceneEntity(timestamp=stamp(time_ns), frame_id=frame, id=name, frame_locked=True, models=models, texts=texts)


def name_tag(text: str, height_m: float) -> TextPrimitive:
    """Return a text above the origin of its entity that always faces the viewer."""
    above = np.array([0, height_m, 0, 0, 0, 0, 1])
    return TextPrimitive(pose=_pose(above), billboard=True, font_size=_TAG_M, color=Color(a=1), text=text)


def scene_update(entities: Sequence[SceneEntity]) -> SceneUpdate:
    """Return the message that adds or removes entities of a scene."""
    return SceneUpdate(entities=entities)


def scene_cleared(time_ns: int) -> SceneUpdate:
    """Return a message that removes all entities of the topic."""
    return SceneUpdate(deletions=[SceneEntityDeletion(timestamp=stamp(time_ns), type=SceneEntityDeletion.ALL)])


def pose_in_frame(time_ns: int, frame: str, pose: Array) -> PoseInFrame:
    """Return the message with a pose7 in a frame."""
    return PoseInFrame(timestamp=stamp(time_ns), frame_id=frame, pose=_pose(pose))


def joint_states(time_ns: int, names: Sequence[str], positions: Sequence[float]) -> JointStates:
    """Return the message with the positions of a robot's joints [rad or m]."""
    joints = [JointState(name=name, position=at) for name, at in zip(names, positions, strict=True)]
    return JointStates(timestamp=stamp(time_ns), joints=joints)


def laser_scan(time_ns: int, frame: str, height_m: float, ranges: Array) -> LaserScan:
    """Return the message with ranges [m] of rays at equal angles, ``height_m`` above an agent's root frame.

    A range is infinite if the ray has no hit. The frame of the scan has x forward, y left and z up.
    """
    # the last ray is one step before the first one again
    step = 2 * np.pi / max(len(ranges), 1)
    # from our +Y up to the +Z up of the plane of the scan
    pose = np.array([0.0, height_m, 0.0, -np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
    return LaserScan(
        timestamp=stamp(time_ns),
        frame_id=frame,
        pose=_pose(pose),
        start_angle=0.0,
        end_angle=step * (len(ranges) - 1),
        ranges=ranges.tolist(),
    )


def point_cloud(time_ns: int, frame: str, height_m: float, points: Array) -> PointCloud:
    """Return the message with points [N, 3] [m] of a scanner ``height_m`` above an agent's root frame.

    The points have the axes of the root frame. Points that are NaN are omitted.
    """
    known = np.ascontiguousarray(points[np.isfinite(points).all(axis=1)], "<f4")
    return PointCloud(
        timestamp=stamp(time_ns),
        frame_id=frame,
        pose=_pose(np.array([0.0, height_m, 0.0, 0.0, 0.0, 0.0, 1.0])),
        point_stride=12,
        fields=[PackedElementField(name=a, offset=4 * k, type=PackedElementField.FLOAT32) for k, a in enumerate("xyz")],
        data=known.tobytes(),
    )


def log(time_ns: int, source: str, text: str, *, warning: bool = False) -> Log:
    """Return the message with a line for the log panel."""
    level = Log.Level.WARNING if warning else Log.Level.INFO
    return Log(timestamp=stamp(time_ns), level=level, name=source, message=text)


def calibration(time_ns: int, frame: str, camera: Camera) -> CameraCalibration:
    """Return the Foxglove message of a pinhole camera without distortion."""
    k = np.asarray(camera.intrinsics, np.float64)
    return CameraCalibration(
        timestamp=stamp(time_ns),
        frame_id=frame,
        width=camera.width,
        height=camera.height,
        K=k.ravel(),
        R=np.eye(3).ravel(),
        # no stereo: the projection is the intrinsics with a column of zeros
        P=np.hstack([k, np.zeros((3, 1))]).ravel(),
    )


def video_frame(time_ns: int, frame: str, packet: bytes) -> CompressedVideo:
    """Return the message with one picture of an H.264 stream."""
    return CompressedVideo(timestamp=stamp(time_ns), frame_id=frame, data=packet, format="h264")


def _pose(pose: Array) -> Pose:
    return Pose(position=_vector(pose), orientation=_turn(pose))


def _vector(pose: Array) -> Vector3:
    x, y, z = pose[:3].tolist()
    return Vector3(x=x, y=y, z=z)


def _turn(pose: Array) -> Quaternion:
    x, y, z, w = pose[3:].tolist()
    return Quaternion(x=x, y=y, z=z, w=w)
