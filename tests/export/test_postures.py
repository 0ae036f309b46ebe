"""Exports of people who do chores and lie down: joints and things are where the recording has them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.bodies import Humanoid
from h3data.bodies.people.skeleton import JOINT_NAMES
from h3data.recording.records import JOINTS
from h3data.replay import Replay
from h3data_crowds.routines import Stop
from h3data_exporters.gltf_animation import write_gltf_animation
from h3data_exporters.posing import posed_parts
from h3data_habitat.exporters.gfx_replay_export import write_gfx_replay
from h3data_habitat.gfx.replay import read_gfx_replay
from sim_kinematic.policies.crowd.people import CrowdPolicy
from tests.crowds.acting import chores_at
from tests.export.test_exporters import Played

HOME = "medium-open:3"
STOPS = Stop("fridge_0", "take", 12.5), Stop("kitchen_counter_0", "put", 9.0), Stop("bed_0", "rest", 9.0)
WRISTS = ("left_wrist", "right_wrist")


def resident(task: Any, episode: Any, number: int) -> CrowdPolicy:
    """A person who takes something, puts it down and lies down."""
    return chores_at(STOPS, episode, number)


@pytest.fixture(scope="module")
def acted() -> h3data.Recording:
    agents = {"human": f"{__name__}:resident"}
    return h3data.simulate("wander", HOME, roster=["female_1"], agents=agents, seed=3, max_steps=1900)


@pytest.fixture(scope="module")
def steps(acted: h3data.Recording) -> list[int]:
    """Steps in which the fridge is open, the carton is carried, and the person lies."""
    opened = int(np.ptp(acted.columns[JOINTS], axis=0).argmax())
    wide = int(np.abs(acted.columns[JOINTS][:, opened] - acted.columns[JOINTS][0, opened]).argmax())
    taken = next(event.step for event in acted.events if event.kind == "takes")
    lies = int(acted.columns["agent_0.motion_seat"][:, 1].argmax())
    assert acted.columns["agent_0.motion_seat"][lies, 1] == 2
    return [wide, taken + 20, lies]


def wrists_of(replay: Replay, steps: list[int]) -> np.ndarray:
    """Places of both wrists [T, 2, 3]."""
    assert isinstance(replay.model(0), Humanoid)
    frames = replay.joint_matrices(0, np.array(steps))
    return np.asarray(frames)[:, [JOINT_NAMES.index(name) for name in WRISTS]][..., :3, 3]


@pytest.mark.slow
def test_gltf_has_hands_doors_and_things(acted: h3data.Recording, steps: list[int], tmp_path: Path) -> None:
    replay = Replay(acted, detail=False)
    write_gltf_animation(acted, posed_parts(replay), tmp_path / "acted.glb")
    file, wrists = Played(tmp_path / "acted.glb"), wrists_of(replay, steps)
    (carton,) = acted.moving_bodies
    (door,) = [body for body in acted.bodies if body.name == "fridge_0/door"]
    index = [drawable.name for drawable in replay.drawables].index(door.name)
    for k, step in enumerate(steps):
        nodes = file.by_name(step)
        np.testing.assert_allclose([nodes[name][:3, 3] for name in WRISTS], wrists[k], atol=1e-4)
        thing = acted.columns["object_pose"][step, carton.moving].astype(np.float64)
        np.testing.assert_allclose(nodes[carton.name][:3, 3], thing[:3], atol=1e-4)
        np.testing.assert_allclose(nodes[door.name], replay.matrices(index, np.array([step]))[0], atol=1e-4)
        (person,) = [part for part, each in enumerate(replay.drawables) if each.agent == 0]
        skin = replay.vertices(person, np.array([step]))[0]
        np.testing.assert_allclose(file.skinned(step).min(0), skin.min(0), atol=1e-3)
        np.testing.assert_allclose(file.skinned(step).max(0), skin.max(0), atol=1e-3)


@pytest.mark.slow
def test_gfx_replays_have_hands_and_things(acted: h3data.Recording, steps: list[int], tmp_path: Path) -> None:
    replay = Replay(acted, detail=False)
    write_gfx_replay(acted, posed_parts(replay), tmp_path / "acted.gfx_replay.json")
    again = Replay(read_gfx_replay(tmp_path / "acted.gfx_replay.json"), assets=[tmp_path])
    assert not again.missing
    (ours,) = [k for k, each in enumerate(replay.drawables) if each.agent == 0]
    (theirs,) = [k for k, each in enumerate(again.drawables) if each.deformable]
    rows = np.array(steps)
    for step in rows:
        skin, other = (each.vertices(k, np.array([step]))[0] for each, k in ((replay, ours), (again, theirs)))
        assert abs(np.ptp(other, axis=0) - np.ptp(skin, axis=0)).max() < 2e-3
        np.testing.assert_allclose(other.max(0), skin.max(0), atol=2e-3)
        np.testing.assert_allclose(other.min(0), skin.min(0), atol=2e-3)
    (carton,) = acted.moving_bodies
    track = acted.columns["object_pose"][rows, carton.moving, :3]
    tracks = again.recording.columns["object_pose"][rows][..., :3]
    assert np.abs(tracks - track[:, None]).max((0, 2)).min() < 1e-3


@pytest.mark.slow
def test_bags_have_frames_of_joints_and_things(acted: h3data.Recording, steps: list[int], tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason='needs the extra: pip install "h3data[ros]"')
    from rosbags.highlevel import AnyReader

    from h3data_ros.bag_export import write_rosbag2
    from h3data_ros.frames import pose_to_ros

    write_rosbag2(acted, tmp_path / "bag")
    with AnyReader([tmp_path / "bag"]) as reader:
        of_topic = {
            name: [c for c in reader.connections if c.topic == name] for name in ("/tf", "/humans/bodies/tracked")
        }
        sent: list[Any] = [reader.deserialize(d, c.msgtype) for c, _, d in reader.messages(of_topic["/tf"])]
        told: list[Any] = [
            reader.deserialize(d, c.msgtype) for c, _, d in reader.messages(of_topic["/humans/bodies/tracked"])
        ]
    assert [message.ids for message in told] == [["human"]] * len(acted)
    frames = [{each.child_frame_id: each.transform.translation for each in message.transforms} for message in sent]
    expected = wrists_of(Replay(acted), steps)
    (carton,) = acted.moving_bodies
    for k, step in enumerate(steps):
        for side, name in enumerate(WRISTS):
            at = frames[step][f"{name}_human"]
            x, y, z = expected[k, side]
            np.testing.assert_allclose([at.x, at.y, at.z], [x, -z, y], atol=1e-5)
        at, thing = frames[step][f"object_{carton.name}"], acted.columns["object_pose"][step, carton.moving]
        np.testing.assert_allclose([at.x, at.y, at.z], pose_to_ros(thing)[:3], atol=1e-6)
