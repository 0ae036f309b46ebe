"""Sensors in recordings: they are measurements beside the state, come back from both stores, and change nothing else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import h3data
from h3data.errors import InputError
from h3data.geometry import Array, heading_from_quat
from h3data.recording import Dataset, DatasetWriter, read_mcap, write_mcap
from h3data.recording.scans import Scan, clouds_of, scan_column, scans_of
from sim_kinematic.tasks.resume import resume, verify

SENSORS = ("lidar", "lidar_legs", "egomotion")
CLOUD = scan_column(0, "lidar_3d")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> h3data.Recording:
    path = tmp_path_factory.mktemp("scan") / "a.mcap"
    h3data.simulate("wander", roster="robot,human", max_steps=40, sensors=SENSORS, record=path)
    return read_mcap(path)


def test_scans_are_recorded_and_read(recording: h3data.Recording, tmp_path: Path) -> None:
    lidar, legs = scans_of(recording)
    assert (lidar.agent, lidar.sensor, lidar.max_m, lidar.ranges.shape) == (0, "lidar", 12.0, (40, 360))
    assert recording.columns[scan_column(0, "lidar")].dtype == np.float16
    assert recording.columns[scan_column(0, "egomotion")].dtype == np.float32
    assert legs.sensor == "lidar_legs"
    with DatasetWriter(tmp_path / "ds", max_bodies=400) as out:
        out.add(recording)
    again = Dataset(tmp_path / "ds").recording(0)
    np.testing.assert_array_equal(scans_of(again)[0].ranges, lidar.ranges)
    points = lidar.points(recording)
    base = recording.agent_column(0, "base_pose")
    away = np.hypot(points[..., 0] - base[:, None, 0], points[..., 2] - base[:, None, 2])
    np.testing.assert_allclose(away[np.isfinite(away)], lidar.ranges[np.isfinite(away)], atol=1e-4)


def test_they_are_no_state(recording: h3data.Recording) -> None:
    plain = h3data.simulate("wander", roster="robot,human", max_steps=40)
    assert {*recording.columns} - {*plain.columns} == {scan_column(0, name) for name in SENSORS}
    np.testing.assert_array_equal(recording.columns["state_hash"], plain.columns["state_hash"])
    assert verify(recording).equal
    assert len(resume(recording, step=20)) == 40


def test_what_is_no_sensor_is_refused() -> None:
    with pytest.raises(InputError, match="H3-TASK-071"):
        h3data.simulate("wander", max_steps=2, sensors=("sonar",))
    for roster, sensors in (("human,human", ("lidar",)), ("robot,human", "lidar")):
        with pytest.raises(InputError, match="H3-TASK-075"):
            h3data.simulate("wander", roster=roster, max_steps=2, sensors=sensors)
    with pytest.raises(InputError, match="H3-TASK-075"):
        h3data.simulate("rearrange", "small:3", max_steps=900, sensors=("lidar",))


@pytest.mark.parametrize("told", [None, 3, {"metrics.agent_0.lidar": 7}, {"metrics.agent_0.lidar": {"high": "far"}}])
def test_scans_without_sound_facts_are_shown_as_far_as_they_go(recording: h3data.Recording, told: object) -> None:
    info = {**recording.episode.info, "sensors": told}
    odd = replace(recording, episode=replace(recording.episode, info=info))
    found: list[Scan] = scans_of(odd)
    assert found[0].max_m == pytest.approx(float(np.nanmax(found[0].ranges)))
    assert np.isfinite(found[0].points(odd)).any()


# --- what is shown and exported ---------------------------------------------------------------------------------------
def test_the_rerun_view_shows_the_points(recording: h3data.Recording, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    from h3data_viewers.rerun.floor_marks import SCAN_EVERY
    from h3data_viewers.rerun.rrd_file import write_rrd
    from tests.viewers.rerun_file import File

    shown = File(write_rrd(recording, tmp_path / "a.rrd"))
    met = np.isfinite(scans_of(recording)[0].points(recording))[::SCAN_EVERY].all(-1)
    _, points = shown.column("/world/scans/robot_lidar", "Points3D:positions")
    assert [len(at) for at in points] == met.sum(1).tolist()


def test_the_html_replay_has_the_distances(recording: h3data.Recording) -> None:
    from h3data_viewers.html_replay.packing import Payload
    from h3data_viewers.html_replay.story import SCAN_M, add_story

    payload = Payload()
    story = add_story(payload, recording, np.arange(len(recording)))
    assert [(s["agent"], s["track"], s["most"]) for s in story["scans"]] == [(0, "scan_0", 12.0), (0, "scan_1", 12.0)]
    entry = payload.entries["scan_0"]
    assert entry["shape"] == [40, 360]
    assert entry["step"] == SCAN_M


def test_foxglove_gets_laser_scans_to_the_left(recording: h3data.Recording, tmp_path: Path) -> None:
    pytest.importorskip("foxglove_schemas_protobuf")
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    from h3data_exporters.foxglove.foxglove_file import write_foxglove

    path = tmp_path / "a.foxglove.mcap"
    write_foxglove(recording, lambda steps: [], path)
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        scans = [message for *_, message in reader.iter_decoded_messages(topics=["/agents/robot/lidar"])]
    assert len(scans) == len(recording)
    np.testing.assert_array_equal(np.array(scans[7].ranges, np.float32), scans_of(recording)[0].met()[7])
    assert scans[7].end_angle == pytest.approx(2 * np.pi * 359 / 360)
    turn = scans[7].pose.orientation  # from x forward, y left, z up to the root's x forward, y up, z right
    assert (turn.x, turn.y, turn.z, turn.w) == pytest.approx((-(0.5**0.5), 0, 0, 0.5**0.5))


# --- scanners of several lasers ---------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def cloud() -> h3data.Recording:
    pytest.importorskip("embreex")
    return h3data.simulate("wander", roster="robot,human", max_steps=12, sensors=("lidar_3d", "lidar"))


def test_recorded_clouds_are_those_that_are_computed_from_the_recording(cloud: h3data.Recording) -> None:
    from h3data.replay import Replay

    scan, replay, step = clouds_of(cloud)[0], Replay(cloud), np.array([9])
    base = cloud.agent_column(0, "base_pose")[9].astype(np.float64)
    cos, sin = np.cos(heading := heading_from_quat(base[3:])), np.sin(heading)
    rays = scan.directions() @ np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])
    corners = []
    for index, one in enumerate(replay.drawables):
        if one.agent == 0:
            continue
        vertices = replay.vertices(index, step)[0] if one.deformable else one.mesh.vertices
        matrix = np.eye(4) if one.deformable else replay.matrices(index, step)[0]
        corners.append((vertices @ matrix[:3, :3].T + matrix[:3, 3])[one.mesh.faces])
    triangles, at = np.concatenate(corners).astype(np.float64), base[:3] + np.array([0, scan.height_m, 0])
    some = np.arange(0, len(rays), 97)
    again = np.array([_first_hit(triangles, at, ray) for ray in rays[some]])
    apart = np.abs(np.minimum(again, 30.0) - scan.ranges[9].ravel()[some])
    assert np.quantile(apart, 0.95) < 1e-3, "rays along edges may miss"
    points = scan.points(cloud, step)[0][some][apart < 1e-3]
    np.testing.assert_allclose(points, (at + rays[some] * again[:, None])[apart < 1e-3], atol=2e-3)


def _first_hit(triangles: Array, at: Array, ray: Array) -> float:
    """Distance along a ray to the nearest triangle [N, 3, 3] by the formula of Moeller and Trumbore, infinite without one."""
    a, ab, ac = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    across = np.cross(ray, ac)
    det = (ab * across).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = ((at - a) * across).sum(-1) / det
        q = np.cross(at - a, ab)
        v, t = q @ ray / det, (ac * q).sum(-1) / det
        return float(np.min(t[(u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)], initial=np.inf))


def test_clouds_come_back_and_are_verified(cloud: h3data.Recording, tmp_path: Path) -> None:
    write_mcap(cloud, tmp_path / "a.mcap")
    with DatasetWriter(tmp_path / "ds", max_bodies=400) as out:
        out.add(cloud)
    for again in (read_mcap(tmp_path / "a.mcap"), Dataset(tmp_path / "ds").recording(0)):
        np.testing.assert_array_equal(clouds_of(again)[0].ranges, cloud.columns[CLOUD])
        assert clouds_of(again)[0].elevations == clouds_of(cloud)[0].elevations
        assert verify(again).equal
    assert resume(cloud, 5).columns[CLOUD].shape == (12, 16, 360)


@pytest.mark.parametrize("sensor", ["lidar_3d", "lidar"])
def test_changed_measurements_are_found(cloud: h3data.Recording, sensor: str) -> None:
    column = scan_column(0, sensor)
    changed = cloud.columns[column].copy()
    changed[7, ..., 100] += 0.25
    found = verify(replace(cloud, columns={**cloud.columns, column: changed}))
    assert found.difference is not None
    assert (found.difference.step, found.difference.column) == (7, column)


def test_foxglove_gets_the_points_of_clouds(cloud: h3data.Recording, tmp_path: Path) -> None:
    pytest.importorskip("foxglove_schemas_protobuf")
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    from h3data_exporters.foxglove.foxglove_file import write_foxglove

    path = tmp_path / "a.foxglove.mcap"
    write_foxglove(cloud, lambda steps: [], path)
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        clouds = [message for *_, message in reader.iter_decoded_messages(topics=["/agents/robot/lidar_3d"])]
    scan = clouds_of(cloud)[0]
    expected = scan.around([7])[0]
    found = np.frombuffer(clouds[7].data, "<f4").reshape(-1, 3)
    np.testing.assert_allclose(found, expected[np.isfinite(expected).all(1)], atol=1e-5)
    assert clouds[7].pose.position.y == pytest.approx(scan.height_m)
    assert [field.offset for field in clouds[7].fields] == [0, 4, 8]


@pytest.mark.parametrize("wrong", [{}, {"elevation_deg": 7}, {"elevation_deg": ["a", 1]}, {"height_m": float("nan")}])
def test_clouds_without_sound_geometry_are_no_clouds(cloud: h3data.Recording, wrong: dict[str, object]) -> None:
    facts = {**cloud.episode.info["sensors"][CLOUD], **wrong} if wrong else None
    info = {**cloud.episode.info, "sensors": {CLOUD: facts}}
    assert not clouds_of(replace(cloud, episode=replace(cloud.episode, info=info)))
