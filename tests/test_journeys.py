"""How many files one has to open to follow an episode; CONTRIBUTING.md lists them. The numbers may only fall."""

from __future__ import annotations

from pathlib import Path

from h3data.recording import RecordingHeader
from sim_kinematic.tasks.episode import Episode
from tests.journeys import returns, stays_of_an_episode


def test_an_episode_is_followed_through_few_files(tmp_path: Path) -> None:
    files = stays_of_an_episode(tmp_path, Episode)
    assert files[0] == "sim_kinematic/tasks/recorder.py"
    assert len(files) <= 7, files
    assert returns(files) <= 2, files


def test_an_episode_comes_to_the_disk_in_few_files(tmp_path: Path) -> None:
    files = stays_of_an_episode(tmp_path, Episode, RecordingHeader)
    assert "h3data/recording/mcap/writer.py" in files
    assert len(set(files)) <= 7, files
    assert returns(files) <= 3, files
