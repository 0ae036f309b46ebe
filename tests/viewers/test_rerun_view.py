"""The Rerun file, read back: every pose, state and text must be what the recording says."""

from __future__ import annotations

import re
import resource
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from h3data.errors import InputError, MissingExtraError
from h3data.geometry import (
    pose_to_matrix,
    transform_points,
)
from h3data.recording import write_mcap
from h3data.recording.records import STEP_NS, Agent, InputEvent, Recording
from h3data.render.camera import look_at, orthographic, pinhole
from h3data_pipelines.cli import main
from h3data_viewers import CameraFeed, write_rrd
from h3data_viewers.rerun import transforms
from h3data_viewers.rerun.cameras import frame_steps
from h3data_viewers.rerun.entities import agent_colors
from h3data_viewers.rerun.floor_marks import stacked_labels
from h3data_viewers.rerun.layout import LoggedRecording, layout
from h3data_viewers.rerun.sink import Sink
from h3data_viewers.rerun.timeseries import lanes_of, log_scalars
from tests.viewers.rerun_file import STEPS, File, Stage, example

pytest.importorskip("rerun")


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> tuple[Recording, Stage, File]:
    recording = example()
    stage = Stage(recording)
    track = np.stack([look_at([0.1 * k, 2, 3], [0, 0, 0]) for k in range(STEPS)])
    cameras = [CameraFeed(camera=pinhole(64, 48, hfov_deg=60, name="user eye"), poses=track)]
    path = write_rrd(recording, tmp_path_factory.mktemp("rrd") / "e.rrd", replay=stage, cameras=cameras)
    return recording, stage, File(path)


@pytest.mark.parametrize("step", [0, 9, 25, 45, STEPS - 1])
def test_rigid_things_are_where_the_replay_says(written, step):
    recording, stage, file = written
    root = pose_to_matrix(recording.agent_column(0, "base_pose")[step])
    assert np.allclose(file.matrix("/world/spot", step), root, atol=1e-5)
    leg = root @ file.matrix("/world/spot/leg", step) @ file.matrix("/world/spot/leg/mesh", step)
    assert np.allclose(leg, stage.matrices(4, step), atol=5e-5)
    cup = file.matrix("/world/objects/cup", step) @ file.matrix("/world/objects/cup/mesh", step)
    assert np.allclose(cup, stage.matrices(3, step), atol=5e-5)
    lamp = file.matrix("/world/scene/lamp\\/left\\ hand", step)
    assert np.allclose(lamp, stage.drawables[2].matrix, atol=1e-6), "mirrored and scaled"
    camera = file.matrix("/world/cameras/user\\ eye", step)
    assert np.allclose(camera, look_at([0.1 * step, 2, 3], [0, 0, 0]), atol=5e-5)


def test_what_is_not_in_the_world_is_hidden(written):
    _, _, file = written
    for step, shown in ((9, True), (10, False), (19, False), (20, True)):
        scale = np.array(file.at("/world/objects/cup", "Transform3D:scale", step)[0])
        assert (scale > 0.5).all() == shown
        assert (scale > 0).all(), "Rerun reports 0 as a fault"


def test_things_at_rest_cost_one_row(written):
    _, _, file = written
    steps, _ = file.column("/world/objects/cup", "Transform3D:translation")
    assert steps[:4].tolist() == [0, 10, 20, 31]  # appears, vanishes, comes back, begins to rise
    assert "/world/scene/nothing" not in file.batches
    assert all(static for static, _ in file.batches["/world/scene/floor"])
    assert "/world/scene/ceiling/slab" in file.batches


@pytest.mark.parametrize("block", [1, 10, 7])
def test_blocks_of_steps_show_the_same(tmp_path, monkeypatch, written, block):
    recording, stage, file = written
    monkeypatch.setattr(transforms, "BLOCK_STEPS", block)
    again = File(write_rrd(recording, tmp_path / "e.rrd", replay=stage))
    for entity in ("/world/spot", "/world/alex", "/world/spot/leg", "/world/objects/cup"):
        assert again.column(entity, "Transform3D:translation")[0].tolist() == (
            file.column(entity, "Transform3D:translation")[0].tolist()
        )
        for step in range(STEPS):
            np.testing.assert_allclose(again.matrix(entity, step), file.matrix(entity, step), atol=1e-6)


def test_what_appears_late_is_hidden_before(tmp_path, monkeypatch):
    monkeypatch.setattr(transforms, "BLOCK_STEPS", 4)
    recording = example()
    pose = recording.agent_column(1, "base_pose").copy()
    pose[:13] = np.nan
    recording = replace(recording, columns={**recording.columns, "agent_1.base_pose": pose})
    file = File(write_rrd(recording, tmp_path / "e.rrd"))
    shown = [np.linalg.det(file.matrix("/world/alex", step)) > 0.9 for step in range(STEPS)]
    assert shown == [step >= 13 for step in range(STEPS)]
    np.testing.assert_allclose(file.matrix("/world/alex", 13), pose_to_matrix(pose[13]), atol=1e-5)


def test_raw_input_is_logged_at_its_own_times(tmp_path):
    given = (
        InputEvent(time_ns=-5, kind="key_down", payload='{"key": "w"}'),
        InputEvent(time_ns=3 * STEP_NS, kind="mouse_move", user=1),
        InputEvent(time_ns=3 * STEP_NS + 1, kind="key_up", payload='{"key": "w"}'),
        InputEvent(time_ns=1000 * STEP_NS, kind="text", payload='"bye"'),
    )
    file = File(write_rrd(replace(example(), inputs=given), tmp_path / "e.rrd"))
    steps, texts = file.column("/input/user_0", "TextLog:text")
    assert list(zip(steps.tolist(), [t[0] for t in texts], strict=True)) == [
        (0, 'key_down {"key": "w"}'),
        (4, 'key_up {"key": "w"}'),
        (STEPS, 'text "bye"'),
    ]
    ((_, batch),) = file.batches["/input/user_0"]
    assert batch.column("sim_time").cast("int64").to_pylist() == [g.time_ns for g in given if g.user == 0]
    assert file.column("/input/user_1", "TextLog:text")[0].tolist() == [3]


def test_skinned_vertices(written):
    recording, stage, file = written
    steps, values = file.column("/world/alex/body", "Mesh3D:vertex_positions")
    assert np.diff(steps).min() == 3
    for step in (0, 30, 57):
        root = pose_to_matrix(recording.agent_column(1, "base_pose")[step])
        world = transform_points(root, np.array(values[steps.tolist().index(step)]))
        assert np.allclose(world, stage.vertices(5, np.array([step]))[0], atol=1e-5)
    assert len(file.at("/world/alex/body", "Mesh3D:triangle_indices", 0)) == len(stage.drawables[5].mesh.faces)


def test_times_plots_lanes_and_log(written):
    recording, _, file = written
    batch = next(b for static, b in file.batches["/world/spot"] if not static)
    times = batch.column("sim_time").cast("int64").to_numpy()
    assert np.array_equal(times, batch.column("step").to_numpy() * STEP_NS)
    _, curve = file.column("/metrics/geodesic_agents", "Scalars:scalars")
    curve = np.array(curve)[:, 0]
    assert np.isnan(curve[0]), "no path: a gap"
    assert np.allclose(curve[1:], recording.columns["metrics.geodesic_agents"][1:])
    steps, states = file.column("/actions/spot_skill", "StateChange:state")
    assert list(zip(steps.tolist(), [s[0] for s in states], strict=True)) == [(0, "find"), (20, "follow"), (50, "-")]
    _, values = file.column("/actions/encounter", "StateConfiguration:values")
    _, colors = file.column("/actions/encounter", "StateConfiguration:colors")
    assert len(values) == len(colors) == len(set(colors)) >= 3
    steps, texts = file.column("/log/skills", "TextLog:text")
    assert list(zip(steps.tolist(), [t[0] for t in texts], strict=True)) == [
        (0, "spot: find(alex)"),
        (20, "spot: follow()"),
        (49, "spot: follow() failed: lost"),
    ]
    assert file.at("/log/events", "TextLog:text", STEPS) == ["spot collision alex"]
    assert file.at("/log/events", "TextLog:level", STEPS) == ["WARN"]


def test_identity_and_layout(written):
    _, _, file = written
    assert [(s.application_id, s.recording_id) for s in file.recordings] == [("h3data", "7a1e")]
    assert len(file.blueprints) == 1
    assert file.at("/__properties/episode", "task", 0) == ["social_nav"]


def test_paths_begin_and_end_with_marks_in_the_colour_of_their_agent(written):
    recording, _, file = written
    colors = set()
    for index, name in enumerate(("spot", "alex")):
        track = recording.agent_column(index, "base_pose")[:, :3]
        entity = f"/world/trajectories/{name}"
        _, start = file.column(f"{entity}/start", "Points3D:positions")
        _, end = file.column(f"{entity}/end", "Boxes3D:centers")
        assert np.allclose(np.subtract(start[0], track[0]), [0, 0.03, 0], atol=1e-6)
        assert np.allclose(np.subtract(end[0], track[-1]), [0, 0.03, 0], atol=1e-6)
        assert file.column(f"{entity}/start", "Points3D:labels")[1] == [f"{name} starts"]
        assert file.column(f"{entity}/start", "Points3D:show_labels")[1] == [False]  # the agent's name stands there
        assert file.column(f"{entity}/end", "Boxes3D:show_labels")[1] == [False]
        own = {file.column(entity, "LineStrips3D:colors")[1][0], file.column(f"{entity}/end", "Boxes3D:colors")[1][0]}
        assert len(own) == 1
        colors |= own
    assert len(colors) == 2


def test_agents_of_one_kind_have_different_colours():
    people = tuple(Agent(name=f"p{k}", kind="human") for k in range(3))
    robots = tuple(Agent(name=f"r{k}", kind="robot") for k in range(3))
    colors = agent_colors((*people, *robots))
    assert len(set(colors)) == 6
    assert all(b > r for r, _, b in colors[:3])  # people cold
    assert all(r > b for r, _, b in colors[3:])  # robots warm


def test_the_picture_in_third_person_is_the_largest():
    def of(*cameras: str) -> Any:
        logged = LoggedRecording(
            label="",
            name="Home",
            world="/world",
            focus=np.array([[0.0, 0, 0], [4, 2, 4]]),
            hidden=(),
            cameras=[f"/world/cameras/{c}" for c in cameras],
            plotted=["/metrics/d"],
            lanes=["/actions/a", "/actions/b"],
            latency=(),
            log="/log",
            inputs="",
        )
        return layout([logged], timeline="step").root_container

    both = of("robot_arm", "third_person", "person_head")
    assert both.column_shares == [1, 1]
    column = both.contents[1]
    assert column.contents[0].name == "third_person"
    assert [view.name for view in column.contents[1].contents] == ["robot_arm", "person_head"]
    assert column.row_shares[0] == max(column.row_shares) > 2 * column.row_shares[1]
    assert column.row_shares[3] > 1.0  # lanes are wide enough to be read
    without = of("robot_arm")
    assert without.column_shares == [3, 2]
    assert without.contents[1].contents[0].name == "robot_arm"


def test_only_distances_share_a_plot():
    import rerun as rr

    columns = example().columns
    recording = example(columns={**columns, "metrics.facing": np.zeros(STEPS, np.float32)})
    stream = rr.RecordingStream("h3data", recording_id="test")
    assert log_scalars(Sink(stream, recording.columns["time_ns"]), recording) == (
        "/metrics/geodesic_agents",
        "/metrics/distance_l2",
        "/metrics/follow_from_1m",
        "/metrics/follow_to_2m",
    )


def test_every_curve_of_a_plot_has_a_colour_of_its_own(written):
    _, _, file = written
    curves = ("geodesic_agents", "distance_l2", "follow_from_1m", "follow_to_2m")
    colors = [file.column(f"/metrics/{name}", "SeriesLines:colors")[1][0] for name in curves]
    assert len(set(colors)) == 4


def test_only_following_has_bounds_and_states_of_following():
    import rerun as rr

    followed = example()
    tidied = replace(followed, episode=replace(followed.episode, task="rearrange"))
    stream = rr.RecordingStream("h3data", recording_id="bounds")
    plotted = log_scalars(Sink(stream, tidied.columns["time_ns"]), tidied)
    assert plotted == ("/metrics/geodesic_agents", "/metrics/distance_l2")
    assert set(lanes_of(followed)["encounter"]) >= {"following", "too close"}
    assert set(lanes_of(tidied)["encounter"]) == {"apart", "near", "contact"}


def test_goals_side_by_side_share_one_label():
    points = np.array([[0.0, 1, 0], [3, 1, 0], [0.3, 0.5, 0.3]])
    assert stacked_labels(points, ["cup", "box", "book"]) == ["cup\nbook", "box", ""]


def test_the_window_opens_paused_with_its_layout_before_its_meshes(tmp_path):
    from rerun.blueprint.components import PlayState
    from rerun.chunk import RrdReader

    recording = example()
    path = write_rrd(recording, tmp_path / "episode.rrd", replay=Stage(recording))
    reader = RrdReader(path)
    states = [
        state
        for chunk in reader.stream(store=reader.blueprints()[0]).to_chunks()
        for state in chunk.to_record_batch().to_pydict().get("TimePanelBlueprint:play_state", [])
    ]
    assert states == [[PlayState.Paused.value]]
    content = path.read_bytes()
    assert 0 < content.index(b"time_panel") < content.index(b"SeriesLines:") < content.index(b"world/scene/floor")


def test_a_view_shows_how_far_it_is(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("h3data.progress.LINE_EVERY_S", 0.0)
    recording = example()
    write_rrd(recording, tmp_path / "episode.rrd", replay=Stage(recording))
    said = capsys.readouterr().err
    assert re.search(r"write poses: \d+ of \d+ blocks", said)
    assert re.search(r"write skins: \d+ of \d+ poses", said)


def test_encounter_lane():
    lane = lanes_of(example())["encounter"]
    assert lane[1] == "apart"
    assert lane[-1] == "contact"
    assert set(lane) == {"apart", "following", "too close", "contact"} | ({"near"} & set(lane))


def test_without_a_replay_agents_are_solids(tmp_path):
    file = File(write_rrd(example(), tmp_path / "bare.rrd"))
    assert {"/world/spot/solid", "/world/alex/solid", "/world/trajectories/alex"} <= set(file.batches)


@pytest.mark.parametrize("agents", [(), (Agent(name="a", kind="human"),)])
def test_recordings_without_agents_or_rows(tmp_path, agents):
    for rows in (0, 1):
        columns = {"time_ns": np.arange(rows)} | {
            f"agent_{i}.base_pose": np.full((rows, 7), np.nan, np.float32) for i in range(len(agents))
        }
        recording = example(agents=agents, columns=columns, skills=(), events=())
        file = File(write_rrd(recording, tmp_path / f"{rows}.rrd"))
        assert file.recordings


def video(path: Path, frames: int) -> Path:
    import av

    with av.open(str(path), "w") as container:
        track = container.add_stream("libx264", rate=30)
        track.width, track.height, track.pix_fmt = 64, 48, "yuv420p"
        for k in range(frames):
            picture = np.full((48, 64, 3), 8 * k, np.uint8)
            container.mux(track.encode(av.VideoFrame.from_ndarray(picture)))
        container.mux(track.encode())
    return path


def test_camera_pictures(tmp_path):
    import cv2

    clip = video(tmp_path / "clip.mp4", 20)
    feed = CameraFeed(camera=pinhole(640, 480, hfov_deg=60, name="cam"), video=clip)
    stills = File(write_rrd(example(), tmp_path / "stills.rrd", cameras=[feed]))
    steps, blobs = stills.column("/world/cameras/cam/image", "EncodedImage:blob")
    assert steps.tolist() == [0, 15, 30, 45]  # frames 0, 5, 10, 15 of 20 over 60 steps
    for frame, blob in zip((0, 5, 10, 15), blobs, strict=True):
        picture: Any = cv2.imdecode(np.array(blob[0], np.uint8), cv2.IMREAD_COLOR)
        assert np.shape(picture) == (240, 320, 3)
        assert abs(np.mean(np.asarray(picture)) - 8 * frame) < 6
    assert stills.at("/world/cameras/cam", "Pinhole:resolution", 0) == [[320.0, 240.0]]

    own = CameraFeed(camera=feed.camera, video=clip, steps=np.arange(20) * 2)
    whole = File(write_rrd(example(), tmp_path / "video.rrd", cameras=[own], images="video"))
    steps, stamps = whole.column("/world/cameras/cam/image", "VideoFrameReference:timestamp")
    assert steps.tolist() == list(range(0, 40, 2))
    assert len({s[0] for s in stamps}) == 20
    assert frame_steps(20, 60).tolist() == list(range(0, 60, 3))


@pytest.mark.parametrize("images", ["stills", "video"])
def test_a_bad_video_is_refused_and_leaves_nothing(tmp_path, images):
    bad = tmp_path / "bad.mp4"
    bad.write_bytes(b"not a video at all" * 50)
    target = tmp_path / "out.rrd"
    camera = pinhole(64, 48, hfov_deg=60)
    with pytest.raises(InputError, match=r"(?s)bad\.mp4.*H3-VIEW-01(6|7)"):
        write_rrd(example(), target, cameras=[CameraFeed(camera=camera, video=bad)], images=images)
    with pytest.raises(InputError, match="H3-VIEW-019"):
        write_rrd(example(), target, cameras=[CameraFeed(camera=camera, video=tmp_path / "none.mp4")])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bad.mp4"]


def test_videos_by_name_need_a_replay_that_knows_cameras(tmp_path):
    with pytest.raises(InputError, match="H3-VIEW-020"):
        write_rrd(example(), tmp_path / "e.rrd", replay=Stage(example()), videos={"top_down": tmp_path / "a.mp4"})
    assert not list(tmp_path.iterdir())


def test_a_file_is_replaced_only_on_request_and_only_by_a_whole_one(tmp_path, capfd):
    target = tmp_path / "e.rrd"
    target.write_bytes(b"precious")
    with pytest.raises(InputError, match="H3-VIEW-001"):
        write_rrd(example(), target)

    class Broken(Stage):
        def vertices(self, index, steps):
            raise RuntimeError("broken replay")

    with pytest.raises(RuntimeError, match="broken replay"):
        write_rrd(example(), target, replay=Broken(example()), overwrite=True)
    assert target.read_bytes() == b"precious"
    write_rrd(example(), target, replay=Stage(example()), overwrite=True)
    assert File(target).recordings
    assert [p.name for p in tmp_path.iterdir()] == ["e.rrd"]
    assert capfd.readouterr() == ("", "")


def test_on_a_full_disk_it_ends_in_one_line_and_leaves_nothing(tmp_path, capfd):
    write_mcap(example(), tmp_path / "episode.mcap")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))  # as a disk that fills up while the file is written
    try:
        assert main(["view", str(tmp_path / "episode.mcap"), "-o", str(tmp_path / "full.rrd")]) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    told = capfd.readouterr().err
    assert told.startswith("error: The disk is full")
    assert told.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["episode.mcap"]


def test_missing_rerun_names_the_command(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError, match="H3-VIEW-022"):
        write_rrd(example(), tmp_path / "e.rrd")


def test_the_same_recording_gives_the_same_content(tmp_path, written):
    recording, stage, _ = written
    files = [File(write_rrd(recording, tmp_path / f"{k}.rrd", replay=stage)) for k in range(2)]
    assert files[0].batches.keys() == files[1].batches.keys()
    for entity, batches in files[0].batches.items():
        pairs = (batches, files[1].batches[entity])
        plain = [[repr(b.drop_columns(["rerun.controls.RowId"]).to_pydict()) for _, b in file] for file in pairs]
        assert plain[0] == plain[1], entity


# --- pictures drawn for the file --------------------------------------------------------------------------------------
def test_drawn_pictures_and_lenses_without_a_frustum(tmp_path):
    import cv2

    pictures = [(step, np.full((24, 32, 3), (200, 2 * step, 0), np.uint8)) for step in range(0, STEPS, 7)]
    feeds = [
        CameraFeed(camera=pinhole(64, 48, hfov_deg=60, name="drawn"), stills=iter(pictures)),
        CameraFeed(camera=orthographic(64, 48, width_m=3.0, name="plan"), stills=iter(pictures[:1])),
    ]
    file = File(write_rrd(example(), tmp_path / "e.rrd", cameras=feeds))
    steps, blobs = file.column("/world/cameras/drawn/image", "EncodedImage:blob")
    assert steps.tolist() == [step for step, _ in pictures]
    for (_, rgb), blob in zip(pictures, blobs, strict=True):
        shown = cv2.imdecode(np.array(blob[0], np.uint8), cv2.IMREAD_COLOR)
        assert np.abs(np.asarray(shown, int)[..., ::-1] - rgb).max() < 5
    components = {n for _, batch in file.batches["/world/cameras/plan"] for n in batch.schema.names}
    assert not [name for name in components if name.startswith("Pinhole")]
