"""How many files one has to open to follow an episode; CONTRIBUTING.md lists them. The numbers may only fall."""

from __future__ import annotations

from pathlib import Path

from tests.journeys import returns, stays_of_an_episode


def test_an_episode_is_followed_through_few_files(tmp_path: Path) -> None:
    files = stays_of_an_episode(tmp_path)
    assert files[0] == "sim_kinematic/tasks/runner.py"
    assert len(files) <= 7, files
    assert returns(files) <= 3, files
