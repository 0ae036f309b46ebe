"""Writes ``golden_states.json``, which the tests of the server and of the page read: packed states with what they say, a walk
beside others, things that open, a home with stairs. ``python -m tests.play.golden``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from h3data.geometry import sloped_pose, transform_points
from h3data.replay.rigs import joint_rigs
from h3data.scene import Ramp, Room
from h3data.scene.articulation import handle_points, joints_of, posed
from h3data.scene.floor_heights import floor_heights, room_heights
from h3data_play.wire import BODY_JOINTS, JOINT_UNIT, PackedStep, StatePacker, pack_pong
from sim_kinematic.motion.step import drive_base, keep_apart, stairs_speeds
from tests.scene.test_articulation import chain

FILE = Path(__file__).parent / "golden_states.json"
JOINTS = 20


def columns_of(seed: int) -> dict[str, np.ndarray]:
    """Recorded columns of one step with a robot, a person and three objects, the second of which the person holds."""
    rng = np.random.default_rng(seed)

    def quats(count: int) -> np.ndarray:
        values = rng.normal(size=(count, 4))
        return (values / np.linalg.norm(values, axis=1, keepdims=True)).astype(np.float32)

    def base(heading: float) -> np.ndarray:
        x, z = rng.uniform(-5, 5, 2)
        return np.array([[x, 0.1, z, 0, np.sin(heading / 2), 0, np.cos(heading / 2)]], np.float32)

    return {
        "agent_0.base_pose": base(0.5),
        "agent_0.joint_pos": rng.uniform(-3, 3, (1, JOINTS)).astype(np.float32),
        "agent_0.grasp_body": np.array([-1], np.int32),
        "agent_1.base_pose": base(-2.0),
        "agent_1.root_pose": np.concatenate([rng.uniform(-2, 2, (1, 3)).astype(np.float32), quats(1)], 1),
        "agent_1.joint_quat": quats(54)[None],
        "agent_1.grasp_body": np.array([5], np.int32),
        "object_pose": np.concatenate([rng.uniform(-2, 2, (3, 3)).astype(np.float32), quats(3)], 1)[None],
    }


def packer() -> StatePacker:
    """A packer for the world of `columns_of`."""
    from types import SimpleNamespace

    from h3data.bodies import load_humanoid, load_robot

    bodies = [SimpleNamespace(moving=k) for k in (-1, -1, 2, -1, 0, 1)]
    header: Any = SimpleNamespace(bodies=bodies)
    return StatePacker(header, (load_robot("quad_arm"), load_humanoid("female_0")))


def said(columns: dict[str, np.ndarray], head: tuple[Any, ...], objects: list[int]) -> dict[str, Any]:
    """What a decoder should find."""
    names = ("flags", "agents", "objects", "step", "ack", "clock_ms")
    person = columns["agent_1.root_pose"][0]
    return {
        **dict(zip(names, head, strict=True)),
        "robot": {
            "base": [*columns["agent_0.base_pose"][0, [0, 2]].tolist(), 0.5],
            "joints": (np.rint(columns["agent_0.joint_pos"][0] / JOINT_UNIT) * JOINT_UNIT).tolist(),
        },
        "person": {
            "base": [*columns["agent_1.base_pose"][0, [0, 2]].tolist(), -2.0],
            "root": person.tolist(),
            "quats": columns["agent_1.joint_quat"][0, :BODY_JOINTS].tolist(),
        },
        "joints": columns["scene.joint_pos"][0].tolist() if "scene.joint_pos" in columns else [],
        "things": [
            {"index": k, "held": 1 if k == 1 else -1, "pose": columns["object_pose"][0, k].tolist()} for k in objects
        ],
    }


def golden() -> dict[str, Any]:
    """Five states, one after the other, the last two with doors and drawers, and a pong."""
    pack, states = packer(), []
    for step, whole in ((1, True), (2, False), (3, False), (4, True), (5, False)):
        columns = columns_of(7)
        if step >= 3:
            columns["object_pose"][0, 2, 1] += 1.0
        if step >= 4:
            columns["scene.joint_pos"] = np.array([[0.0, 0.25 if step == 5 else 0.0, -1.5]], np.float32)
        packed: PackedStep = pack.pack(columns)
        objects = [0, 1, 2] if whole else [2] if step == 3 else []
        head = (1 | 8 * (step == 2), 2, len(objects), step, step - 2, 33.5 * step)
        data = packed.state(head[0], head[3], head[4], head[5], whole=whole)
        states.append({"bytes": data.hex(), "said": said(columns, head, objects)})
    pong = {"bytes": pack_pong(12.5, 99.25).hex(), "said": [12.5, 99.25]}
    return {
        "joints": JOINTS,
        "states": states,
        "pong": pong,
        "beside": walk_beside(),
        "opening": opening(),
        "stairs": stairs(),
    }


def walk_beside() -> dict[str, Any]:
    """A person who walks about between two others and a wall, and where they are after every step, ``(x, z, heading)``."""
    room, cell, radius, others = (8.0, 6.0), 0.05, 0.25, np.array([[4.0, 3.0, 0.25], [4.0, 0.7, 0.25]])
    x, z = np.meshgrid(*((np.arange(round(size / cell)) + 0.5) * cell for size in room), indexing="ij")
    sdf = np.rint(1e3 * np.minimum(np.minimum(x, room[0] - x), np.minimum(z, room[1] - z))) * 1e-3
    origin, offsets, base, places = np.zeros(2), np.zeros(1), (3.0, 2.9, 0.0), []
    commands = [[1.0, 0.0]] * 40 + [[1.0, 0.6]] * 30 + [[-0.7, 0.1]] * 60 + [[1.0, -0.9]] * 60
    for forward, turn in commands:
        was = base
        drives = forward * 2.5, 0.0, turn * 2.5, 1 / 30, offsets, radius, 6, 7e-4, 1e-5, np.inf
        at = drive_base.py_func(sdf, origin, cell, *was, *drives)
        *apart, _ = keep_apart(sdf, origin, cell, was[0], was[1], at[0], at[1], others, radius, radius - 7e-4)
        base = apart[0], apart[1], at[2]
        places.append([round(float(value), 9) for value in base])
    return {
        "room": list(room),
        "others": others.tolist(),
        "start": [3.0, 2.9, 0.0],
        "commands": commands,
        "places": places,
    }


def opening() -> dict[str, Any]:
    """A cabinet with a box on its door, and where everything is as they move, pose7 and handles."""
    scene, frames = chain(rest=0.3), []
    handles = handle_points(scene)
    for positions in ([0.3, 0.0], [1.4, 0.0], [1.4, -0.3], [-0.2, -0.3], [0.3, 0.0]):
        there, motions = posed(scene, positions), joints_of(scene).motions(positions)
        frames.append(
            {
                "positions": positions,
                "poses": {i.name: np.round(i.pose, 6).tolist() for i in there.instances},
                "handles": [
                    transform_points(m, h[None])[0].round(6).tolist() for m, h in zip(motions, handles, strict=True)
                ],
            }
        )
    return {"joints": joint_rigs(scene, movable={"cup"}), "frames": frames}


def stairs() -> dict[str, Any]:
    """Two storeys joined by stairs, and of some places ``(x, z, heading)`` how high the floor is, how fast bodies go there, and
    how a robot of a length stands."""
    up = Ramp(axis=0, start=6.2, end=3.4, top_y=2.7, steps=15)
    rooms = (
        Room(name="hall", category="hallway", rectangles=np.array([[0.0, 0, 3, 4]]), floor_y=0.1),
        Room(name="stairwell", category="stairwell", rectangles=np.array([[3.0, 1, 7, 2]]), floor_y=0.1, ramp=up),
        Room(name="upper", category="bedroom", rectangles=np.array([[7.1, 0, 10, 4]]), floor_y=2.7),
    )
    heights, length = room_heights(rooms), 0.7
    rng = np.random.default_rng(3)
    places = np.round(
        np.concatenate([rng.uniform((-1, -1, -3), (11, 5, 3), (30, 3)), rng.uniform((2, 1, -3), (8, 2, 3), (60, 3))]), 4
    )
    xz, heading = places[:, :2], places[:, 2]
    poses = sloped_pose(lambda at: floor_heights(heights, 0.0, at), xz, heading, length)
    return {
        "heights": heights.tolist(),
        "length": length,
        "places": places.tolist(),
        "y": floor_heights(heights, 0.0, xz).tolist(),
        "pace": stairs_speeds(heights, xz).tolist(),
        "poses": poses.round(9).tolist(),
    }


if __name__ == "__main__":
    FILE.write_text(json.dumps(golden(), indent=1) + "\n", encoding="utf-8")
