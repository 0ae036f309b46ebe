"""Sensors in recordings: they are measurements beside the state, come back from both stores, and change nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import h3data
from h3data.errors import InputError
from h3data.recording import Dataset, DatasetWriter, read_mcap
from h3data.recording.scans import Scan, scan_column, scans_of
from sim_kinematic.tasks.resume import resume, verify

SENSORS = ("lidar", "lidar_legs", "egomotion")


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
        with pytest.raises(InputError, match="H3-TASK-"):
            h3data.simulate("wander", roster=roster, max_steps=2, sensors=sensors)
    with pytest.raises(InputError, match="H3-TASK-"):
        h3data.simulate("rearrange", "small:3", max_steps=900, sensors=("lidar",))


@pytest.mark.parametrize("told", [None, 3, {"metrics.agent_0.lidar": 7}, {"metrics.agent_0.lidar": {"high": "far"}}])
def test_scans_without_sound_facts_are_shown_as_far_as_they_go(recording: h3data.Recording, told: object) -> None:
    from dataclasses import replace

    info = {**recording.episode.info, "sensors": told}
    odd = replace(recording, episode=replace(recording.episode, info=info))
    found: list[Scan] = scans_of(odd)
    assert found[0].max_m == pytest.approx(float(np.nanmax(found[0].ranges)))
    assert np.isfinite(found[0].points(odd)).any()
