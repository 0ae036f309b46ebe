"""Binary message with one step of the world, as clients receive it.

The message is little-endian and its layout follows from the manifest. It has 256 bytes for a robot, a person and two
objects.

```
 0 u8 kind = 1 | 1 u8 flags | 2 u8 agents | 3 u8 objects in this state
 4 u32 step | 8 i32 the player's last message that has acted | 12 f32 server clock [ms]
robot:   f32 x, z, heading; i16 joints in units of 2e-4 rad or m
person:  f32 x, z, heading; f32 pelvis pose7; u32 rotations of 21 joints
object:  u16 index; i16 agent that holds it, -1 none; f32 pose7
joint:   u16 index; f32 position of a door or drawer [rad or m]; up to the end of the message
```

`web/src/link/wire.ts` reads the message. The tests of both read tests/play/golden_states.json.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot
from h3data.bodies.people.arms import draw_in
from h3data.bodies.people.gestures import NAMES as GESTURE_NAMES
from h3data.bodies.people.gestures import add_gestures, lead_hands
from h3data.bodies.people.planted_gait import PlantedWalk, drawn_in
from h3data.bodies.people.sitting import take_seats
from h3data.geometry import Array, heading_from_quat, pose_multiply
from h3data.recording import RecordingHeader
from h3data.recording.records import JOINTS
from h3data.replay.posed_recording import gesture_rows
from h3data.scene import Scene

STATE, PONG = 1, 2
TOUCH, WALL, ENDED, BUSY = 1, 2, 4, 8
"""Flags of a state: agents touch; a robot touches the home; the episode has ended; the player's agent is moved by a
skill or a guided walk."""
SITS, LIES, SEATED, GESTURES = 16, 32, 64, 128
"""Flags of postures: a free seat is near; a free bed or sofa is near, on which the person can lie; the person sits or
lies; the person's hands are empty, so that they can wave and look at a phone."""
BODY_JOINTS = 21
"""Number of joints that move: SMPL-X joints 1 to 21. Fingers, jaw and eyes keep the pose of the GLB."""
JOINT_UNIT = 2e-4
"""Unit of a robot's joint positions [rad or m]."""
_HEAD = struct.Struct("<BBBBIif")
_OBJECT = np.dtype([("index", "<u2"), ("held", "<i2"), ("pose", "<f4", 7)])
_JOINT = np.dtype([("index", "<u2"), ("position", "<f4")])
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
_SHIFTS = np.array([20, 10, 0], np.uint32)

Columns = dict[str, NDArray[Any]]


def pack_rotations(quats: NDArray[np.floating]) -> bytes:
    """Pack quaternions xyzw [N, 4] in 32 bits each, with 10 bits per component (0.21 degrees)."""
    largest = np.abs(quats).argmax(1)
    rows = np.arange(len(quats))
    sign = np.where(quats[rows, largest] < 0, -1.0, 1.0)
    small = quats[rows[:, None], _OTHERS[largest]] * sign[:, None]
    levels = np.clip(np.rint((small * np.sqrt(2.0) + 1.0) * 511.5), 0, 1023).astype(np.uint32)
    packed = largest.astype(np.uint32) << np.uint32(30) | np.bitwise_or.reduce(levels << _SHIFTS, axis=1)
    return packed.astype("<u4").tobytes()


def pack_head(flags: int, agents: int, objects: int, step: int, ack: int, clock_ms: float) -> bytes:
    """Pack the part of a state message that differs between players."""
    return _HEAD.pack(STATE, flags, agents, objects, step, ack, clock_ms)


def pack_pong(client_ms: float, server_ms: float) -> bytes:
    """Pack the answer to a ping, with the clocks of client and server [ms]."""
    return struct.pack("<B7xdd", PONG, client_ms, server_ms)


@dataclass(frozen=True)
class PackedStep:
    """Message of a step without the part that differs between players."""

    agents: int
    agent_bytes: bytes
    moved: NDArray[Any]
    """Indices of objects with a changed pose or holder."""
    objects: NDArray[Any]
    """Poses of all objects."""
    turned: NDArray[Any]
    """Indices of doors and drawers with a changed position."""
    joints: NDArray[Any]
    """Positions of all doors and drawers [rad or m]."""

    def state(self, flags: int, step: int, ack: int, clock_ms: float, *, whole: bool) -> bytes:
        """Return the state for one player, with only the changed objects and joints unless it is ``whole``."""
        listed, joints = (self.objects, self.joints) if whole else (self.moved, self.turned)
        head = pack_head(flags, self.agents, len(listed), step, ack, clock_ms)
        return head + self.agent_bytes + listed.tobytes() + joints.tobytes()


@dataclass
class StatePacker:
    """Packer of recorded columns, which packs one step after the other."""

    header: RecordingHeader
    bodies: tuple[Robot | Humanoid, ...]
    """Bodies of the agents."""
    scene: Scene | None = None
    """Home, so that feet stand on the treads of stairs, and legs keep clear of walls and furniture."""
    _walks: dict[int, PlantedWalk] = field(default_factory=dict)
    _activities: Mapping[int, tuple[str, float, float]] = field(default_factory=dict)
    _objects: NDArray[Any] = field(default_factory=lambda: np.zeros(0, _OBJECT))
    _joints: NDArray[Any] = field(default_factory=lambda: np.zeros(0, _JOINT))

    def __post_init__(self) -> None:
        moving = sorted((b.moving, k) for k, b in enumerate(self.header.bodies) if b.moving >= 0)
        self._number = {body: number for number, body in moving}

    def pack(
        self,
        columns: Columns,
        carried: Mapping[int, int] | None = None,
        activities: Mapping[int, tuple[str, float, float]] | None = None,
    ) -> PackedStep:
        """Pack the last row of ``columns``.

        Args:
            columns: Columns of the recording.
            carried: Number of the agent that carries a thing beyond the columns, by number of the thing.
            activities: Activity of an agent beyond the columns (`h3data_play.drivers.Driver.activity`), by its number.
        """
        parts, holders = [], dict(carried or {})
        self._activities = activities or {}
        for k, body in enumerate(self.bodies):
            agent = f"agent_{k}."
            base = columns[agent + "base_pose"][-1].astype(np.float64)
            parts.append(struct.pack("<3f", base[0], base[2], float(heading_from_quat(base[3:]))))
            if isinstance(body, Robot):
                joints = np.rint(columns[agent + "joint_pos"][-1] / JOINT_UNIT)
                parts.append(np.clip(joints, -32767, 32767).astype("<i2").tobytes())
            else:
                pelvis, quats = self._pose(k, body, base, columns)
                parts += [pelvis.astype("<f4").tobytes(), pack_rotations(quats[:BODY_JOINTS])]
            holders[self._number.get(int(columns[agent + "grasp_body"][-1]), -1)] = k
        before, self._objects = self._objects, self._packed_objects(columns, holders)
        turned, self._joints = self._joints, _packed_joints(columns)
        return PackedStep(
            len(self.bodies),
            b"".join(parts),
            _changed(before, self._objects),
            self._objects,
            _changed(turned, self._joints),
            self._joints,
        )

    def _packed_objects(self, columns: Columns, holders: dict[int, int]) -> NDArray[Any]:
        poses = columns["object_pose"][-1] if "object_pose" in columns else np.zeros((0, 7), np.float32)
        objects = np.zeros(len(poses), _OBJECT)
        objects["index"], objects["held"], objects["pose"] = np.arange(len(poses)), -1, poses
        for number, agent in holders.items():
            if number >= 0:
                objects["held"][number] = agent
        return objects

    def _pose(self, k: int, body: Humanoid, base: Array, columns: Columns) -> tuple[Array, Array]:
        """Return the pelvis in the world, pose7, and rotations of the other joints of a person."""
        agent = f"agent_{k}."
        if agent + "joint_quat" in columns:
            return columns[agent + "root_pose"][-1], columns[agent + "joint_quat"][-1]
        # recorded by clips: feet are planted from step to step, as a replay does it (`PosedRecording.joint_matrices`)
        walk = self._walks.get(k)
        if walk is None:
            tables = body.gait_tables if self.scene is None else drawn_in(body.gait_tables, self.scene)
            walk = self._walks[k] = PlantedWalk(tables, base)
        else:
            walk.step(base)
        quats, pelvis = walk.pose()
        if agent + "motion_arms" in columns:
            draw_in(quats[None], columns[agent + "motion_arms"][-1:], shoulders_forward=True)
        if agent + "motion_seat" in columns:
            take_seats(body, quats[None], pelvis[None], columns[agent + "motion_seat"][-1:])
        if k in self._activities:
            name, seconds, left = self._activities[k]
            since = np.array([seconds])
            if name in GESTURE_NAMES:
                add_gestures(body, quats[None], pelvis[None], gesture_rows(name, k, since, left))
            else:
                body.acts[name].perform(quats[None], pelvis[None], since, np.inf, left)
        if agent + "motion_hands" in columns:
            lead_hands(body, quats[None], pelvis[None], columns[agent + "motion_hands"][-1:])
        return pose_multiply(base, np.concatenate([pelvis, quats[0]])), quats[1:]


def _packed_joints(columns: Columns) -> NDArray[Any]:
    positions = columns[JOINTS][-1] if JOINTS in columns else np.zeros(0, np.float32)
    joints = np.zeros(len(positions), _JOINT)
    joints["index"], joints["position"] = np.arange(len(positions)), positions
    return joints


def _changed(before: NDArray[Any], now: NDArray[Any]) -> NDArray[Any]:
    """Return the records that differ from those before; all records if there were none."""
    return now if len(before) != len(now) else now[before != now]
