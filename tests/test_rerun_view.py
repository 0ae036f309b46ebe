"""The Rerun file, read back: every pose, state and text must be what the recording says."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from h3data.errors import InputError, MissingExtraError
from h3data.geometry import (
    ground_pose,
    pose_to_matrix,
    quat_from_axis_angle,
    quat_from_heading,
    quat_to_matrix,
    transform_points,
)
from h3data.recording.records import STEP_NS, Agent, Episode, Event, Recording, SkillSpan
from h3data.render.camera import look_at, pinhole
from h3data.scene.records import Mesh
from h3data_viewers import CameraFeed, write_rrd
from h3data_viewers.mesh_detail import thin_mesh, view_mesh
from h3data_viewers.rerun_cameras import frame_steps
from h3data_viewers.rerun_sink import Sink
from h3data_viewers.rerun_tracks import lanes_of, log_scalars

STEPS = 60
pytest.importorskip("rerun")


def sphere(points: int = 400, *, normals: bool = True) -> Mesh:
    """A closed, round mesh of ``points`` vertices: the hull of a Fibonacci spiral."""
    from scipy.spatial import ConvexHull

    k = np.arange(points) + 0.5
    polar, angle = np.arccos(1 - 2 * k / points), np.pi * (1 + 5**0.5) * k
    vertices = np.stack([np.cos(angle) * np.sin(polar), np.cos(polar), np.sin(angle) * np.sin(polar)], 1)
    faces = ConvexHull(vertices).simplices
    colors = np.random.default_rng(0).integers(0, 255, (points, 3), np.uint8)
    v = vertices.astype(np.float32)
    return Mesh(vertices=v, faces=faces.astype(np.int32), colors=colors, normals=v if normals else None)


@dataclass(frozen=True, kw_only=True)
class Thing:
    name: str
    mesh: Mesh
    matrix: np.ndarray
    layer: str = ""
    agent: int = -1
    moving: bool = False
    deformable: bool = False


class Stage:
    """A replay made by hand: floor, ceiling, a mirrored and scaled lamp, a cup that vanishes, a robot leg, a person."""

    def __init__(self, recording: Recording) -> None:
        eye = np.eye(4)
        lamp = pose_to_matrix([1.0, 1.0, 1.0, *quat_from_heading(0.7)])
        lamp[:3, :3] *= [0.5, 2.0, -1.0]
        ball = sphere()
        self.base = {i: pose_to_matrix(recording.agent_column(i, "base_pose").astype(float)) for i in (0, 1)}
        self.drawables = [
            Thing(name="floor", mesh=sphere(normals=False), matrix=np.diag([5, 0.1, 5, 1.0])),
            Thing(name="slab", mesh=ball, matrix=eye, layer="ceiling"),
            Thing(name="lamp/left hand", mesh=ball, matrix=lamp),
            Thing(name="cup", mesh=ball, matrix=eye, moving=True),
            Thing(name="spot/leg", mesh=ball, matrix=eye, moving=True, agent=0),
            Thing(name="alex", mesh=ball, matrix=eye, moving=True, deformable=True, agent=1),
            Thing(name="nothing", mesh=Mesh(vertices=np.zeros((0, 3), np.float32), faces=np.zeros((0, 3), np.int32),
                                            colors=np.zeros((0, 3), np.uint8)), matrix=eye),
        ]  # fmt: skip

    def matrices(self, index: int) -> np.ndarray:
        k = np.arange(STEPS)
        if self.drawables[index].name == "cup":
            out = np.tile(pose_to_matrix([2.0, 1.0, 0.0, *quat_from_axis_angle([1, 2, 3], 0.5)]), (STEPS, 1, 1))
            out[:, :3, :3] *= 0.1
            out[30:, 1, 3] = 1 + 0.02 * k[:30]
            out[10:20] = np.nan
            return out.astype(np.float32)
        swing = quat_from_axis_angle([0, 0, 1], 0.5 * np.sin(k / 4))
        part = pose_to_matrix(np.concatenate([np.tile([0.3, 0.5, 0.1], (STEPS, 1)), swing], 1))
        part[:, :3, :3] *= [0.05, 0.3, 0.05]
        return (self.base[0] @ part).astype(np.float32)

    def vertices(self, index: int, steps: np.ndarray) -> np.ndarray:
        local = self.drawables[index].mesh.vertices * (1 + 0.1 * np.sin(steps / 5))[:, None, None]
        return transform_points(self.base[1][steps], local).astype(np.float32)


def example(**changes) -> Recording:
    k = np.arange(STEPS)
    robot = ground_pose(np.stack([0.05 * k, 0 * k], 1), 0.02 * k).astype(np.float32)
    human = ground_pose(np.stack([0.01 * k + 3, 0 * k + 0.2], 1), -0.03 * k).astype(np.float32)
    geodesic = np.linalg.norm(robot[:, :3] - human[:, :3], axis=1)
    geodesic[0] = np.inf
    fields = {
        "episode": Episode(uid="7a1e", episode_id="e-1", task="social_nav", scene="stage", info={}),
        "agents": (
            Agent(name="spot", kind="robot", skill_names=("find", "follow")),
            Agent(name="alex", kind="human", motion_names=("walk", "stand")),
        ),
        "columns": {
            "time_ns": k * STEP_NS,
            "agent_0.base_pose": robot,
            "agent_1.base_pose": human,
            "agent_0.skill": np.where(k < 20, 0, np.where(k < 50, 1, -1)).astype(np.int32),
            "agent_1.motion_id": (k // 40).astype(np.int32),
            "metrics.geodesic_agents": geodesic.astype(np.float32),
            "metrics.collision": k == STEPS - 1,
        },
        "skills": (
            SkillSpan(agent=0, name="find", target="alex", start_step=0, end_step=19),
            SkillSpan(agent=0, name="follow", start_step=20, end_step=49, outcome="failed", reason="lost"),
        ),
        "events": (Event(step=STEPS - 1, agent=0, kind="collision", target="alex"),),
    }
    return Recording(**{**fields, **changes})


class File:
    """Chunks of an ``.rrd`` by entity and component; latest value at or before a step, as the viewer shows it."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader

        reader = RrdReader(path)
        self.recordings, self.blueprints = reader.recordings(), reader.blueprints()
        self.batches: dict[str, list] = {}
        for chunk in reader.stream().to_chunks():
            self.batches.setdefault(chunk.entity_path, []).append((chunk.is_static, chunk.to_record_batch()))

    def column(self, entity: str, component: str) -> tuple[np.ndarray | None, list]:
        """Steps (None if static) and values of one component, in the order of the steps."""
        steps, values = [], []
        for static, batch in self.batches[entity]:
            if component in batch.schema.names:
                got = batch.column(component).to_pylist()
                if static:
                    return None, got[0]
                steps += batch.column("step").to_pylist()
                values += got
        order = np.argsort(steps, kind="stable")
        return np.array(steps)[order], [values[i] for i in order]

    def at(self, entity: str, component: str, step: int):
        steps, values = self.column(entity, component)
        return values if steps is None else values[np.searchsorted(steps, step, side="right") - 1]

    def matrix(self, entity: str, step: int) -> np.ndarray:
        """4x4 of an entity relative to its parent, at a step."""
        out = np.eye(4)
        names = {n for _, batch in self.batches.get(entity, []) for n in batch.schema.names}
        if "Transform3D:quaternion" in names:
            out[:3, :3] = quat_to_matrix(np.array(self.at(entity, "Transform3D:quaternion", step)[0]))
            out[:3, 3] = self.at(entity, "Transform3D:translation", step)[0]
        if "Transform3D:scale" in names:
            out[:3, :3] *= np.array(self.at(entity, "Transform3D:scale", step)[0])
        return out


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
    assert np.allclose(leg, stage.matrices(4)[step], atol=5e-5)
    cup = file.matrix("/world/objects/cup", step) @ file.matrix("/world/objects/cup/mesh", step)
    assert np.allclose(cup, stage.matrices(3)[step], atol=5e-5)
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
        picture = cv2.imdecode(np.array(blob[0], np.uint8), cv2.IMREAD_COLOR)
        assert picture.shape == (240, 320, 3)
        assert abs(picture.mean() - 8 * frame) < 6
    assert stills.at("/world/cameras/cam", "Pinhole:resolution", 0) == [[320.0, 240.0]]

    own = CameraFeed(camera=feed.camera, video=clip, steps=np.arange(20) * 2)
    whole = File(write_rrd(example(), tmp_path / "video.rrd", cameras=[own], pictures="video"))
    steps, stamps = whole.column("/world/cameras/cam/image", "VideoFrameReference:timestamp")
    assert steps.tolist() == list(range(0, 40, 2))
    assert len({s[0] for s in stamps}) == 20
    assert frame_steps(20, 60).tolist() == list(range(0, 60, 3))


@pytest.mark.parametrize("pictures", ["stills", "video"])
def test_a_bad_video_is_refused_and_leaves_nothing(tmp_path, pictures):
    bad = tmp_path / "bad.mp4"
    bad.write_bytes(b"not a video at all" * 50)
    target = tmp_path / "out.rrd"
    camera = pinhole(64, 48, hfov_deg=60)
    with pytest.raises(InputError, match="Not a video"):
        write_rrd(example(), target, cameras=[CameraFeed(camera=camera, video=bad)], pictures=pictures)
    with pytest.raises(InputError, match="do not exist"):
        write_rrd(example(), target, cameras=[CameraFeed(camera=camera, video=tmp_path / "none.mp4")])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bad.mp4"]


def test_videos_by_name_need_a_replay_that_knows_cameras(tmp_path):
    with pytest.raises(InputError, match="CameraFeed"):
        write_rrd(example(), tmp_path / "e.rrd", replay=Stage(example()), videos={"top_down": tmp_path / "a.mp4"})
    assert not list(tmp_path.iterdir())


def test_a_file_is_replaced_only_on_request_and_only_by_a_whole_one(tmp_path, capfd):
    target = tmp_path / "e.rrd"
    target.write_bytes(b"precious")
    with pytest.raises(InputError, match="file already"):
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


def test_missing_rerun_names_the_command(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError, match="pip install"):
        write_rrd(example(), tmp_path / "e.rrd")


# --- meshes -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("limit", [30, 200, 399])
def test_thin_meshes_stay_close_and_small(limit):
    mesh = sphere(400)
    thin = thin_mesh(mesh, limit)
    assert limit / 3 < len(thin.keep) <= limit
    assert len(np.unique(thin.keep)) == len(thin.keep)
    corners = mesh.vertices[thin.keep][thin.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert 0.5 * 4 * np.pi < area < 1.1 * 4 * np.pi, "still a closed ball"
    assert thin_mesh(mesh, 400).faces is mesh.faces


def test_meshes_without_normals_become_facets():
    mesh = sphere(normals=False)
    (facets,) = view_mesh(mesh)
    assert facets.faces is None
    assert np.array_equal(facets.vertices.reshape(-1, 3, 3), mesh.vertices[mesh.faces])
    assert np.array_equal(facets.colors.reshape(-1, 3, 3), mesh.colors[mesh.faces])


def test_too_large_scenes_are_thinned(tmp_path, monkeypatch):
    monkeypatch.setattr("h3data_viewers.rerun_bodies.MESH_BYTES", 40_000)
    monkeypatch.setattr("h3data_viewers.rerun_bodies.SKIN_BYTES", 60_000)
    big = sphere(4000)
    stage = Stage(example())
    stage.drawables = [Thing(name="statue", mesh=big, matrix=np.eye(4)), stage.drawables[5]]
    stage.vertices = lambda index, steps: np.random.default_rng(0).random((len(steps), 400, 3)).astype(np.float32)
    file = File(write_rrd(example(), tmp_path / "e.rrd", replay=stage))
    assert 400 < len(file.at("/world/scene/statue", "Mesh3D:vertex_positions", 0)) <= 768  # 40 of 208 kB
    steps, _ = file.column("/world/alex/body", "Mesh3D:vertex_positions")
    assert np.diff(steps).min() == 5  # 60 rows x 400 vertices x 12 bytes = 288 kB
