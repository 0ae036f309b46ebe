"""Damaged recordings among sound ones cost themselves only."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from h3data.errors import FormatError
from h3data.metrics import measure_files
from h3data.recording import DatasetWriter, write_mcap
from h3data_pipelines.cli import main
from tests.recording.strategies import simple_recording


@pytest.fixture
def mixed(tmp_path: Path) -> Path:
    """Two sound logs, half a log, and a dataset of three episodes, the last two of them in a file that is cut."""
    episodes = [replace(simple_recording(steps=6, seed=seed), attachments={}) for seed in range(6)]
    for name, episode in zip(("a", "b", "half"), episodes, strict=False):
        write_mcap(episode, tmp_path / f"{name}.mcap")
    half = tmp_path / "half.mcap"
    half.write_bytes(half.read_bytes()[: half.stat().st_size // 2])
    with DatasetWriter(tmp_path / "ds") as out:
        out.add(episodes[3])
        out.commit()
        out.add(episodes[4])
        out.add(episodes[5])
    (_, cut) = sorted((tmp_path / "ds" / "data").rglob("*.parquet"))
    cut.write_bytes(cut.read_bytes()[:200])
    return tmp_path


@pytest.mark.parametrize("workers", [1, 2])
def test_the_sound_ones_are_measured(mixed: Path, workers: int) -> None:
    table = measure_files([mixed], "task", workers=workers)
    assert len(table) == 3
    names = sorted(Path(name).name for some in table.left_out.values() for name in some)
    assert names == ["ds#1", "ds#2", "half.mcap"]
    assert all("amaged" in reason for reason in table.left_out)


def test_commands_list_the_others_and_exit_with_1(mixed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["metrics", str(mixed), "--profile", "task", "--json"]) == 1
    assert len(json.loads(capsys.readouterr().out)["left_out"]) == 3
    assert main(["report", str(mixed), "--pictures", "0", "-o", str(mixed / "r.html")]) == 1
    assert capsys.readouterr().out.count("not measured: 1, ") == 3


def test_alone_they_are_an_error(mixed: Path) -> None:
    with pytest.raises(FormatError, match=r"(?s)half\.mcap.*H3-RECORDING-018"):
        measure_files([mixed / "half.mcap"], "task")
