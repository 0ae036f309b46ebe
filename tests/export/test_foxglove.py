"""Files for Foxglove and Lichtblick, read back by their own schemas: everything is where and when the recording says."""

from __future__ import annotations

import io
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import trimesh
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from tests.simulated import simulate_social_nav, social_nav_episode

pytest.importorskip("mcap_protobuf", reason='needs the extra: pip install "h3data[foxglove]"')
pytest.importorskip("foxglove_schemas_protobuf", reason='needs the extra: pip install "h3data[foxglove]"')

from h3data.bodies.people.skeleton import JOINT_NAMES
from h3data.errors import InputError, MissingExtraError
from h3data.geometry import pose_to_matrix, quat_from_heading
from h3data.recording import AssetRef, Body, Episode, Event, InputEvent, Recording, SkillSpan
from h3data.render import pinhole
from h3data.replay import Replay, camera_track
from h3data_exporters.foxglove import foxglove_file
from h3data_exporters.foxglove.foxglove_file import FoxgloveCamera, write_foxglove
from h3data_exporters.posing import posed_parts
from h3data_habitat.gfx.replay import read_gfx_replay
from h3data_homes import HomeSpec, build_home
from sim_kinematic.motion.spec import HOME_WALKER, SocialNavSpec
from tests.export.foxglove_file import TURN, File, matrix, nanoseconds

STEPS = 45
ATOL = 3e-6
"""float32 at 10 m, and what `/tf` leaves out."""


def export(recording: Recording, path: Path, **options: Any) -> File:
    replay = Replay(recording, detail=False)
    write_foxglove(recording, lambda steps: posed_parts(replay, steps), path, **options)
    return File(path)


def boxes() -> Recording:
    """A cube that stands, one that turns, one that is away in steps 0, 4 to 6 and from 9 on; nobody acts."""
    poses = np.zeros((12, 2, 7), np.float32)
    poses[:, 0, 1] = np.arange(12) * 0.1
    poses[:, 0, 3:] = quat_from_heading(np.linspace(0, 9, 12))
    poses[:, 1, [0, 6]] = [3, 1]
    poses[0, 1] = poses[4:7, 1] = poses[9:, 1] = np.nan
    still = np.array([-3, 0, 0, *quat_from_heading(0.4)], np.float32)
    return Recording(
        episode=Episode(uid="u", episode_id="boxes", task="none", scene="", info={"t0_unix_ns": 7_000}),
        assets=(AssetRef(name="cubeSolid", uri="primitive:cubeSolid", color=(200, 10, 30)),),
        bodies=(
            Body(name="stands", asset="cubeSolid", pose=still, scale=np.array([2, 0.5, 1], np.float32), layer="roof"),
            Body(name="turns", asset="cubeSolid", pose=poses[0, 0], moving=0, scale=np.array([0.5, 1, 2], np.float32)),
            Body(name="leaves", asset="cubeSolid", pose=poses[1, 1], moving=1),
        ),
        columns={"time_ns": np.arange(12, dtype=np.int64) * 33_333_333, "object_pose": poses},
        events=(Event(step=5, agent=-1, kind="collision", target="stands"),),
        skills=(SkillSpan(agent=0, name="walk", start_step=2, end_step=7, outcome="failed", reason="lost"),),
        inputs=(InputEvent(time_ns=-3_000, kind="key_down", payload='"w"'), InputEvent(time_ns=10**9, kind="text")),
    )


@pytest.fixture(scope="module")
def recording() -> Recording:
    scene = build_home(HomeSpec(preset="small", seed=2))
    return simulate_social_nav(
        social_nav_episode(scene, seed=2, spec=SocialNavSpec(max_steps=STEPS, human=HOME_WALKER))
    )


@pytest.fixture(scope="module")
def replay(recording: Recording) -> Replay:
    return Replay(recording, detail=False)


@pytest.fixture(scope="module")
def file(recording: Recording, replay: Replay, tmp_path_factory: pytest.TempPathFactory) -> File:
    tracks = [camera_track(replay, name) for name in ("robot_arm", "orbit")]
    small = [replace(t, camera=pinhole(63, 48, hfov_deg=80, name=t.camera.name)) for t in tracks]
    frames = replay.frames(small, range(len(recording)))
    return export(
        recording,
        tmp_path_factory.mktemp("foxglove") / "e.foxglove.mcap",
        cameras=[FoxgloveCamera(camera=t.camera, poses=t.poses) for t in small],
        pictures=((step, [image["rgb"] for image in images]) for step, images in frames),
    )


def in_root(matrices: np.ndarray) -> np.ndarray:
    """From the recording's world, +Y up, to the root of the frames, +Z up."""
    return TURN @ matrices


def distance(a: np.ndarray, b: np.ndarray) -> float:
    """The farthest that a point of one set is from the other set."""
    return float(max(cKDTree(a).query(b)[0].max(), cKDTree(b).query(a)[0].max()))


def vertices(place: np.ndarray, glb: bytes) -> np.ndarray:
    mesh = trimesh.load(io.BytesIO(glb), file_type="glb", process=False).to_geometry()
    return trimesh.transform_points(mesh.vertices, place)


def drawn(replay: Replay, index: int, step: int) -> np.ndarray:
    """Vertices of a drawable in the root; only those of triangles."""
    drawable, steps = replay.drawables[index], np.array([step])
    used = np.unique(drawable.mesh.faces)
    if drawable.deformable:
        return trimesh.transform_points(replay.vertices(index, steps)[0, used], TURN)
    place = replay.matrices(index, steps)[0] if drawable.moving else drawable.matrix
    return trimesh.transform_points(drawable.mesh.vertices[used], in_root(place))


# --- what is in the file ----------------------------------------------------------------------------------------------
def test_every_topic_has_a_standard_message_whose_descriptor_is_in_the_file(file: File) -> None:
    expected = {
        "/tf": "FrameTransforms",
        "/scene_update": "SceneUpdate",
        "/scene_update/ceiling": "SceneUpdate",
        "/agents/robot/pose": "PoseInFrame",
        "/agents/human/pose": "PoseInFrame",
        "/agents/robot/joints": "JointStates",
        "/log": "Log",
        "/cam/robot_arm/calibration": "CameraCalibration",
        "/cam/robot_arm/video": "CompressedVideo",
        "/cam/orbit/calibration": "CameraCalibration",
        "/cam/orbit/video": "CompressedVideo",
    }
    names = {topic: schema.name for topic, schema in file.schemas.items()}
    assert names == {topic: f"foxglove.{name}" for topic, name in expected.items()} | {"/metrics": "h3.Metrics"}
    for schema in file.schemas.values():
        assert schema.encoding == "protobuf"
        known = FileDescriptorSet.FromString(schema.data)
        assert schema.name in {f"{f.package}.{m.name}" for f in known.file for m in f.message_type}
        assert {d for f in known.file for d in f.dependency} <= {f.name for f in known.file}, "nothing is left out"


def test_messages_come_in_the_order_of_their_times(recording: Recording, file: File) -> None:
    assert file.times == sorted(file.times)
    for topic, messages in file.messages.items():
        for t, message in messages:
            if topic == "/tf":
                assert {nanoseconds(tf.timestamp) for tf in message.transforms} == {t}
            elif topic.startswith("/scene_update"):
                assert {nanoseconds(thing.timestamp) for thing in (*message.entities, *message.deletions)} == {t}
            elif topic != "/metrics":
                assert nanoseconds(message.timestamp) == t
    assert [t for t, _ in file.messages["/agents/robot/pose"]] == recording.columns["time_ns"].tolist()


@pytest.mark.slow
def test_equal_recordings_make_equal_files(tmp_path: Path, monkeypatch, recording: Recording) -> None:
    whole = export(recording, tmp_path / "a.foxglove.mcap")
    export(recording, tmp_path / "b.foxglove.mcap")
    assert (tmp_path / "a.foxglove.mcap").read_bytes() == (tmp_path / "b.foxglove.mcap").read_bytes()
    monkeypatch.setattr(foxglove_file, "BLOCK_STEPS", 7)
    blocks = export(recording, tmp_path / "c.foxglove.mcap")
    assert blocks.times == whole.times
    for time_ns in (whole.times[0], recording.columns["time_ns"][20], whole.times[-1]):
        expected, found = whole.frames(int(time_ns)), blocks.frames(int(time_ns))
        assert all(np.allclose(found[name], expected[name], atol=ATOL) for name in expected)


@pytest.mark.slow
def test_an_independent_reader_understands_it(tmp_path: Path, recording: Recording) -> None:
    chunk = pytest.importorskip("rerun.chunk")
    view = FoxgloveCamera(camera=pinhole(64, 48, hfov_deg=80, name="still"), poses=np.eye(4)[None])
    pictures = ((step, [np.full((48, 64, 3), 5 * step, np.uint8)]) for step in range(len(recording)))
    export(recording, tmp_path / "e.foxglove.mcap", cameras=[view], pictures=pictures)
    found: dict[str, set[str]] = {}
    for part in chunk.McapReader(str(tmp_path / "e.foxglove.mcap")).stream():
        names = {name.partition(":")[0] for name in part.to_record_batch().schema.names}
        found.setdefault(part.entity_path, set()).update(names)
    assert "Transform3D" in found["/tf"]
    assert "VideoStream" in found["/cam/still/video"]
    assert "Pinhole" in found["/cam/still/calibration"]
    assert "TextLog" in found["/log"]
    assert "InstancePoses3D" in found["/agents/human/pose"]


# --- frames -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("step", [0, 1, 17, STEPS - 1])
def test_frames_are_where_the_recording_says(recording: Recording, replay: Replay, file: File, step: int) -> None:
    frames = file.frames(int(recording.columns["time_ns"][step]))
    np.testing.assert_allclose(frames["world"], TURN, atol=1e-12)
    for i, agent in enumerate(recording.agents):
        base = pose_to_matrix(recording.agent_column(i, "base_pose")[step].astype(np.float64))
        np.testing.assert_allclose(frames[agent.name], in_root(base), atol=ATOL)
    robot, human = replay.model(0), replay.model(1)
    links = replay.link_matrices(0, np.array([step]))[0]
    seen = [link.name for link in robot.links if link.mesh is not None]  # type: ignore[union-attr]
    assert len(seen) > 10
    for link in seen:
        number = robot.link_index(link)  # type: ignore[union-attr]
        np.testing.assert_allclose(frames[f"robot/{link}"], in_root(links[number]), atol=ATOL)
    joints = replay.joint_matrices(1, np.array([step]))[0]
    assert human.joint_names == JOINT_NAMES
    for name, joint in zip(JOINT_NAMES, joints, strict=True):
        np.testing.assert_allclose(frames[f"human/{name}"], in_root(joint), atol=5e-6)


def test_people_and_robots_are_trees(file: File) -> None:
    (_, first), *_ = file.messages["/tf"]
    parents = {tf.child_frame_id: tf.parent_frame_id for tf in first.transforms}
    assert len(parents) == len(first.transforms), "the first message tells each frame once"
    assert parents["human/left_knee"] == "human/left_hip"
    assert parents["human"] == parents["robot"] == parents["cam_robot_arm"] == "world"
    assert {tf.parent_frame_id for tf in first.transforms} - set(parents) == {"map"}


def test_whoever_jumps_in_time_misses_nothing_for_more_than_a_second(recording: Recording, file: File) -> None:
    end = int(recording.columns["time_ns"][-1])
    whole, late = file.frames(end), File.__new__(File)
    late.messages = {"/tf": [(t, m) for t, m in file.messages["/tf"] if t > end - 1_000_000_000]}
    again = late.frames(end)
    assert again.keys() == whole.keys()
    assert all(np.array_equal(again[name], whole[name]) for name in whole)


def test_what_rests_is_not_told_again(file: File) -> None:
    told = [{tf.child_frame_id for tf in message.transforms} for _, message in file.messages["/tf"]]
    assert len(told[0]) > 2 * min(map(len, told))


# --- things -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("step", [pytest.param(0, marks=pytest.mark.slow), 30])
def test_models_are_where_the_replay_draws_them(recording: Recording, replay: Replay, file: File, step: int) -> None:
    shown: dict[str, list[np.ndarray]] = {}
    for name, place, glb in file.models(int(recording.columns["time_ns"][step])):
        shown.setdefault(name.partition("#")[0], []).append(vertices(place, glb))
    seen = 0
    for index, drawable in enumerate(replay.drawables):
        if drawable.deformable or not len(drawable.mesh.faces):
            continue
        expected = drawn(replay, index, step)
        assert min(distance(found, expected) for found in shown[drawable.name]) < 2e-5, drawable.name
        seen += 1
    assert seen > 50
    pieces = np.concatenate([v for name, found in shown.items() if name.startswith("human/") for v in found])
    (person,) = [i for i, d in enumerate(replay.drawables) if d.deformable]
    apart = distance(pieces, drawn(replay, person, step))
    assert apart < (1e-5 if step == 0 else 0.06), "people are cut in their first posture"


def test_what_is_away_is_not_shown(tmp_path: Path) -> None:
    recording = boxes()
    file = export(recording, tmp_path / "b.foxglove.mcap")
    for step, time_ns in enumerate((recording.columns["time_ns"] + 7_000).tolist()):
        found = {name.partition("#")[0]: vertices(place, glb) for name, place, glb in file.models(time_ns)}
        there = ["stands", "turns"] + ["leaves"] * bool(np.isfinite(recording.columns["object_pose"][step, 1, 0]))
        assert sorted(found) == sorted(there)
        turns = pose_to_matrix(recording.columns["object_pose"][step, 0].astype(np.float64))
        np.testing.assert_allclose(file.frames(time_ns)["turns"], in_root(turns), atol=ATOL)
        replay = Replay(recording)
        for index, drawable in enumerate(replay.drawables):
            if drawable.name in there:
                assert distance(found[drawable.name], drawn(replay, index, step)) < 1e-5
    assert [t for t, _ in file.messages["/scene_update/leaves"]] == [7_000 + k * 33_333_333 for k in (0, 1, 4, 7, 9)]
    assert set(file.messages) == {"/tf", "/scene_update", "/scene_update/roof", "/scene_update/leaves", "/log"}


def test_agents_who_are_away_take_their_parts_with_them(tmp_path: Path, recording: Recording) -> None:
    pose = recording.agent_column(1, "base_pose").copy()
    pose[:5] = pose[20:] = np.nan
    file = export(
        replace(recording, columns={**recording.columns, "agent_1.base_pose": pose}), tmp_path / "a.foxglove.mcap"
    )
    for step in (0, 4, 5, 19, 20, STEPS - 1):
        names = [entity.id for entity in file.entities(int(recording.columns["time_ns"][step]))]
        assert any(name.startswith("human") for name in names) == (5 <= step < 20)
        assert any(name.startswith("robot/") for name in names)
    assert len(file.messages["/agents/human/pose"]) == 15


def test_recorded_rigs_are_cut_into_pieces(real: Path, tmp_path: Path) -> None:
    recording = read_gfx_replay(real / "habitat-sim/reference/replays/room_skinned/replay.gfx_replay.json")
    replay = Replay(recording, assets=[real / "habitat-sim"])
    write_foxglove(recording, lambda steps: posed_parts(replay, steps), tmp_path / "rig.foxglove.mcap")
    file = File(tmp_path / "rig.foxglove.mcap")
    rigs = [i for i, d in enumerate(replay.drawables) if d.deformable]
    start = int(recording.columns["time_ns"][0])
    for index in rigs:
        expected = drawn(replay, index, 0)
        name = replay.drawables[index].name
        found = [vertices(m, glb) for entity, m, glb in file.models(start) if entity.startswith(f"{name}/")]
        assert distance(np.concatenate(found), expected) < 1e-4
    assert len(rigs) == 2


@settings(max_examples=25)
@given(
    scale=st.tuples(*[st.sampled_from([-1.5, 0.2, 1.0, 3.0])] * 3),
    turn=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
)
def test_a_model_undoes_the_viewers_turn(scale: tuple[float, ...], turn: tuple[float, ...]) -> None:
    from h3data_exporters.foxglove.messages import model

    pose = np.array([1.0, 2, 3, *(np.array(turn) / np.linalg.norm(turn))])
    made = model(b"", pose, np.array(scale))
    shown = matrix(made.pose.position, made.pose.orientation) @ np.diag([made.scale.x, made.scale.y, made.scale.z, 1])
    np.testing.assert_allclose(shown @ TURN, pose_to_matrix(pose) @ np.diag([*scale, 1]), atol=1e-12)


# --- numbers, text, pictures ------------------------------------------------------------------------------------------
def test_numbers_of_each_step(recording: Recording, file: File) -> None:
    for step, (_, message) in enumerate(file.messages["/metrics"]):
        assert message.step == step
        for name, column in recording.columns.items():
            if name.startswith("metrics."):
                found = getattr(message, name.removeprefix("metrics.").lower())
                assert np.array_equal(np.asarray(found, column.dtype), column[step], equal_nan=column.dtype.kind == "f")
    for step, (_, message) in enumerate(file.messages["/agents/robot/joints"]):
        assert [joint.name for joint in message.joints] == list(recording.agents[0].joint_names)
        assert [joint.position for joint in message.joints] == recording.columns["agent_0.joint_pos"][step].tolist()
    for step, (_, message) in enumerate(file.messages["/agents/human/pose"]):
        assert message.frame_id == "world"
        expected = pose_to_matrix(recording.agent_column(1, "base_pose")[step].astype(np.float64))
        np.testing.assert_allclose(matrix(message.pose.position, message.pose.orientation), expected, atol=1e-12)


def test_the_log_tells_events_skills_and_input_at_their_times(tmp_path: Path) -> None:
    told = export(boxes(), tmp_path / "b.foxglove.mcap").messages["/log"]
    row = 33_333_333
    assert [(t - 7_000, m.name, m.message, m.level) for t, m in told] == [
        (-3_000, "input/user_0", 'key_down "w"', 2),
        (2 * row, "skills", "?: walk()", 2),
        (5 * row, "events", "collision stands", 3),
        (7 * row, "skills", "?: walk() failed: lost", 3),
        (10**9, "input/user_0", "text", 2),
    ]


def test_times_that_no_log_can_hold_are_those_of_the_recorded_log(tmp_path: Path) -> None:
    recording = boxes()
    for start, expected in ((10**30, 2**63 - 1), (-(10**30), 0)):
        late = replace(recording, episode=replace(recording.episode, info={"t0_unix_ns": start}))
        assert {t for t, _ in export(late, tmp_path / "t.foxglove.mcap").messages["/tf"]} == {expected}


@pytest.mark.parametrize("camera", ["robot_arm", "orbit"])
def test_pictures_are_a_stream_that_can_be_entered_at_its_key_frames(recording, replay, file: File, camera) -> None:
    track = camera_track(replay, camera)
    small = replace(track, camera=pinhole(63, 48, hfov_deg=80, name=camera))
    sent = file.messages[f"/cam/{camera}/video"]
    assert [t for t, _ in sent] == recording.columns["time_ns"].tolist()
    assert {(m.format, m.frame_id) for _, m in sent} == {("h264", f"cam_{camera}")}
    assert all(m.data.startswith((b"\0\0\0\1", b"\0\0\1")) for _, m in sent), "Annex B"
    for first in (0, 30):
        decoder = av.CodecContext.create("h264", "r")
        decoder.flags |= av.codec.context.Flags.low_delay
        for step in range(first, first + 15):
            (picture,) = decoder.decode(av.Packet(sent[step][1].data))
            assert (picture.width, picture.height) == (64, 48)
            ((_, (expected,)),) = replay.frames([small], [step])
            error = picture.to_ndarray(format="rgb24")[:, :63].astype(float) - expected["rgb"]
            assert np.sqrt((error**2).mean()) < 14
    (_, calibration), *_ = file.messages[f"/cam/{camera}/calibration"]
    assert np.array_equal(np.reshape(calibration.K, (3, 3)), small.camera.intrinsics)
    assert (calibration.width, calibration.height, calibration.frame_id) == (63, 48, f"cam_{camera}")
    pose = track.poses[17 if len(track.poses) > 1 else 0]
    frames = file.frames(int(recording.columns["time_ns"][17]))
    np.testing.assert_allclose(frames[f"cam_{camera}"], in_root(pose), atol=ATOL)


# --- what is refused --------------------------------------------------------------------------------------------------
def test_a_missing_extra_names_the_command(tmp_path: Path, monkeypatch) -> None:
    for name in ("foxglove_schemas_protobuf", "mcap_protobuf.writer"):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, name, None)
            with pytest.raises(MissingExtraError, match="H3-EXPORT-007"):
                write_foxglove(boxes(), lambda steps: [], tmp_path / "a.foxglove.mcap")
    assert not list(tmp_path.iterdir())


def test_wrong_arguments_are_refused_and_leave_nothing(tmp_path: Path) -> None:
    recording = boxes()
    empty = replace(recording, columns={n: c[:0] for n, c in recording.columns.items()})
    view = FoxgloveCamera(camera=pinhole(8, 6, hfov_deg=90, name="c"), poses=np.eye(4)[None])
    image = np.zeros((6, 8, 3), np.uint8)
    with pytest.raises(InputError, match=r"(?s)foxglove\.mcap.*H3-EXPORT-003"):
        export(recording, tmp_path / "a.mcap")  # may be the recording's own
    with pytest.raises(InputError, match=r"(?s)c, c.*H3-EXPORT-004"):
        export(recording, tmp_path / "a.foxglove.mcap", cameras=[view, view])
    with pytest.raises(InputError, match="H3-EXPORT-005"):
        export(empty, tmp_path / "a.foxglove.mcap")
    with pytest.raises(InputError, match="H3-EXPORT-006"):
        export(recording, tmp_path / "a.foxglove.mcap", cameras=[view], pictures=[(3, [image]), (2, [image])])
    with pytest.raises(InputError, match=r"(?s)uint8.*H3-EXPORT-008"):
        export(recording, tmp_path / "a.foxglove.mcap", cameras=[view], pictures=[(3, [image[:, :5]])])
    assert not list(tmp_path.iterdir())


def test_parts_at_some_steps_are_those_of_all_steps(replay: Replay) -> None:
    steps = np.array([3, 4, 40])
    for some, every in zip(posed_parts(replay, steps), posed_parts(replay), strict=True):
        rows = steps if len(every.poses) > 1 else [0]
        np.testing.assert_allclose(pose_to_matrix(some.poses), pose_to_matrix(every.poses[rows]), atol=1e-9)
        if some.skeleton is not None and every.skeleton is not None:
            found, expected = pose_to_matrix(some.skeleton.poses), pose_to_matrix(every.skeleton.poses[steps])
            np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.slow
def test_long_recordings_are_written_in_blocks(tmp_path: Path, recording: Recording) -> None:
    """Beyond the recording there are joints of stepping legs, times, and the index of the file."""
    few, many = 5_000, 25_000

    def peak(steps: int) -> int:
        """Most bytes that the export of the episode, repeated forwards and backwards, holds at a time."""
        turns = [slice(None, None, -1 if k % 2 else 1) for k in range(-(-steps // len(recording)))]
        columns = {n: np.concatenate([c[turn] for turn in turns])[:steps] for n, c in recording.columns.items()}
        columns["time_ns"] = np.arange(1, steps + 1) * recording.episode.dt_ns
        long = replace(recording, columns=columns, skills=(), events=())
        replay = Replay(long, detail=False)
        tracemalloc.start()
        try:
            write_foxglove(long, lambda rows: posed_parts(replay, rows), tmp_path / "long.foxglove.mcap")
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    peak(10)  # what is loaded at first use
    growth = (peak(many) - peak(few)) / (many - few)
    assert growth < 300, growth
