"""Files of older format versions, written by the code of their time (tests/recording/golden_recordings.py): they are read as
they were meant, become current ones without loss, and are continued as what they are; newer ones are refused."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from h3data.errors import FormatError
from h3data.recording import (
    SCHEMA_VERSION,
    Dataset,
    DatasetWriter,
    InputEvent,
    open_steps,
    read_mcap,
    recordings_equal,
    write_mcap,
)
from h3data.recording.parquet.tables import record_table
from tests.recording.golden_recordings import FOLDER, recording

VERSIONS = ("1.0", "1.1", "1.2", "1.3")


@pytest.fixture(params=VERSIONS)
def old(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A folder with ``log.mcap`` and ``dataset`` of an older version."""
    with zipfile.ZipFile(FOLDER / f"{request.param}.zip") as packed:
        packed.extractall(tmp_path)
    version = json.loads((tmp_path / "dataset/meta/info.json").read_text())["h3data"]["schema_version"]
    assert version == request.param != SCHEMA_VERSION
    return tmp_path


def test_old_files_are_read_as_they_were_meant(old):
    assert recordings_equal(recording(), read_mcap(old / "log.mcap")) == []
    assert recordings_equal(recording(), Dataset(old / "dataset").recording(0)) == []
    for path, episode in ((old / "log.mcap", None), (old / "dataset", 0)):
        with open_steps(path, episode=episode) as steps:
            row = steps[7]
            assert all(
                np.array_equal(row[n], a[7], equal_nan=a.dtype.kind == "f") for n, a in recording().columns.items()
            )


def test_old_files_become_current_ones(old):
    now = read_mcap(write_mcap(read_mcap(old / "log.mcap"), old / "now.mcap"))
    assert recordings_equal(recording(), now) == []
    with DatasetWriter(old / "now") as writer:
        writer.add(Dataset(old / "dataset")[0])
    assert recordings_equal(recording(), Dataset(old / "now").recording(0)) == []
    info = json.loads((old / "now/meta/info.json").read_text())
    assert info["h3data"]["schema_version"] == SCHEMA_VERSION
    assert str(pq.read_schema(old / "now/data/chunk-000/file-000.parquet").field("state_hash").type) == "int64"


def test_an_old_dataset_is_continued_as_what_it_is(old):
    other = replace(recording(), episode=replace(recording().episode, uid="second"))
    with DatasetWriter(old / "dataset", resume=True) as writer:
        assert writer.add(other) == 1
    dataset = Dataset(old / "dataset")
    assert recordings_equal(recording(), dataset.recording(0)) == []
    assert recordings_equal(other, dataset.recording(1)) == []
    kinds = {str(pq.read_schema(p).field("state_hash").type) for p in (old / "dataset/data").rglob("*.parquet")}
    version = dataset.schema.version
    assert kinds == {"int64" if version in ("1.2", "1.3") else "uint64"}, (
        "one kind in all files, or LeRobot and DuckDB could not read them together"
    )


def test_old_files_hold_no_raw_input_and_can_be_given_some(old):
    """The sidecar of inputs came with 1.3: shards before it have none, those added later do."""
    assert read_mcap(old / "log.mcap").inputs == Dataset(old / "dataset")[0].inputs == ()
    assert len(record_table(Dataset(old / "dataset"), "inputs")) == 0
    key = InputEvent(time_ns=5, kind="key_down", payload='{"key": "w"}')
    typed = replace(recording(), episode=replace(recording().episode, uid="second"), inputs=(key,))
    with DatasetWriter(old / "dataset", resume=True) as writer:
        writer.add(typed)
    dataset = Dataset(old / "dataset")
    assert [episode.inputs for episode in dataset.recordings(range(2))] == [(), (key,)]
    assert record_table(dataset, "inputs")["episode_index"].to_pylist() == [1]


def test_a_newer_major_version_is_refused(old):
    info = old / "dataset/meta/info.json"
    text = json.loads(info.read_text())
    for version in ("2.0", "10.3"):
        info.write_text(json.dumps({**text, "h3data": {**text["h3data"], "schema_version": version}}))
        with pytest.raises(FormatError, match=rf"schema version {version}.*newer h3data"):
            Dataset(old / "dataset")
    info.write_text(json.dumps({**text, "h3data": {**text["h3data"], "schema_version": "1.99"}}))
    assert recordings_equal(recording(), Dataset(old / "dataset").recording(0)) == []


@pytest.mark.parametrize(
    ("version", "task", "recorded", "read"),
    [
        ("1.5", "social_nav", "heuristic_expert", "rollout_expert"),
        ("1.5", "social_nav", "plain_expert", "plain_expert"),
        ("1.5", "mine", "heuristic_expert", "heuristic_expert"),
        ("1.6", "social_nav", "heuristic_expert", "heuristic_expert"),
    ],
)
def test_the_name_of_a_policy_means_what_it_meant_when_it_was_recorded(tmp_path, version, task, recorded, read):
    info = {"policy": recorded, "counterfactual": {"policy": recorded}}
    episode = replace(recording().episode, task=task, schema_version=version, info=info)
    write_mcap(replace(recording(), episode=episode), tmp_path / "a.mcap")
    with DatasetWriter(tmp_path / "ds") as writer:
        writer.add(replace(recording(), episode=episode))
    logged, dataset = read_mcap(tmp_path / "a.mcap"), Dataset(tmp_path / "ds")
    expected = {"policy": read, "counterfactual": {"policy": read}}
    assert logged.episode.info == dataset.recording(0).episode.info == expected
    assert json.loads(dataset.row(0)["info"]) == expected
    again = read_mcap(write_mcap(logged, tmp_path / "b.mcap"))
    assert again.episode == logged.episode, "reading and writing twice renames once"
