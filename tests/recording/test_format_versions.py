"""Versions of the format: files of before 0.2, which the code of their time wrote, and newer ones are refused by version."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest

from h3data.errors import FormatError
from h3data.recording import SCHEMA_VERSION, Dataset, DatasetWriter, open_steps, read_mcap, recordings_equal, write_mcap
from h3data.recording.records import OLDEST_VERSION
from tests.recording.golden_recordings import FOLDER, recording

TOO_OLD = "H3-RECORDING-129"


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A folder with ``log.mcap`` and ``dataset`` of version 1.3."""
    with zipfile.ZipFile(FOLDER / "1.3.zip") as packed:
        packed.extractall(tmp_path)
    return tmp_path


def test_files_of_before_0_2_are_refused_with_what_reads_them(old: Path) -> None:
    for again in (
        lambda: read_mcap(old / "log.mcap"),
        lambda: open_steps(old / "log.mcap"),
        lambda: Dataset(old / "dataset"),
        lambda: open_steps(old / "dataset", episode=0),
        lambda: DatasetWriter(old / "dataset", resume=True),
    ):
        with pytest.raises(FormatError, match=TOO_OLD):
            again()


def test_episodes_of_before_0_2_in_newer_files_are_refused_too(tmp_path: Path) -> None:
    """What was converted keeps the version of its episode, by which its people were meant to be shown."""
    told = replace(recording(), episode=replace(recording().episode, schema_version="1.3"))
    with DatasetWriter(tmp_path / "ds") as writer:
        writer.add(told)
    for again in (
        lambda: read_mcap(write_mcap(told, tmp_path / "a.mcap")),
        lambda: Dataset(tmp_path / "ds").recording(0),
    ):
        with pytest.raises(FormatError, match=TOO_OLD):
            again()


@pytest.mark.parametrize("version", [".".join(map(str, OLDEST_VERSION)), SCHEMA_VERSION, "1.99"])
def test_other_minor_versions_are_read(tmp_path: Path, version: str) -> None:
    told = replace(recording(), episode=replace(recording().episode, schema_version=version))
    with DatasetWriter(tmp_path / "ds") as writer:
        writer.add(told)
    for name in ("meta/info.json", "h3/schema.json"):
        path = tmp_path / "ds" / name
        path.write_text(
            path.read_text().replace(f'"schema_version": "{SCHEMA_VERSION}"', f'"schema_version": "{version}"')
        )
    assert Dataset(tmp_path / "ds").schema.version == version
    assert recordings_equal(told, Dataset(tmp_path / "ds").recording(0)) == []
    assert recordings_equal(told, read_mcap(write_mcap(told, tmp_path / "a.mcap"))) == []


def test_a_newer_major_version_is_refused(tmp_path: Path) -> None:
    with DatasetWriter(tmp_path / "ds") as writer:
        writer.add(replace(recording(), episode=replace(recording().episode, schema_version=SCHEMA_VERSION)))
    info = tmp_path / "ds/meta/info.json"
    text = json.loads(info.read_text())
    for version in ("2.0", "10.3"):
        info.write_text(json.dumps({**text, "h3data": {**text["h3data"], "schema_version": version}}))
        with pytest.raises(FormatError, match="H3-RECORDING-110"):
            Dataset(tmp_path / "ds")
