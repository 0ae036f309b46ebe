"""Minari datasets, read by the minari package itself; `make check-rl` runs this in an environment that has it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from h3data.errors import InputError
from h3data.recording import Recording, write_mcap
from h3data_exporters.minari import write_minari
from h3data_exporters.transitions import observations_of, transitions_of
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.cli import main
from sim_kinematic.motion.spec import SocialNavSpec
from tests.simulated import simulate_social_nav, social_nav_episode

minari: Any = pytest.importorskip("minari", reason='needs the extra: pip install "h3data[minari]"')


@pytest.fixture(scope="module")
def recordings() -> list[Recording]:
    home = build_home(HomeSpec(seed=2))
    spec = SocialNavSpec(max_steps=40, spawn_distance_m=3.0)
    return [simulate_social_nav(social_nav_episode(home, seed=seed, spec=spec)) for seed in (2, 3)]


def loaded(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder.parent))
    return minari.load_dataset(folder.name)


def test_every_observation_and_action_comes_back(
    recordings: list[Recording], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "walks-v0"
    monkeypatch.chdir(tmp_path)
    ended = replace(
        recordings[1], events=(), episode=replace(recordings[1].episode, info={"ended": "success", "success": True})
    )
    assert write_minari([recordings[0], ended], Path("walks-v0")) == 2
    assert [path.name for path in folder.iterdir()] == ["data"]
    for dataset in (loaded(folder, monkeypatch), minari.MinariDataset(folder / "data")):
        assert (dataset.id, dataset.total_episodes, dataset.total_steps) == ("walks-v0", 2, 2 * 39)
        for recording, episode in zip((recordings[0], ended), dataset, strict=True):
            found = transitions_of(recording)
            observed = observations_of(recording, found)
            assert set(episode.observations) == set(observed) >= {"base_pose", "joint_pos", "agent_1.base_pose"}
            for name, values in observed.items():
                np.testing.assert_array_equal(episode.observations[name], values)
                assert episode.observations[name].dtype == np.float32
            np.testing.assert_array_equal(episode.actions, found.action)
            np.testing.assert_array_equal(episode.rewards, found.reward)
            assert all(dataset.action_space.contains(action) for action in episode.actions)
            first = {name: values[0] for name, values in episode.observations.items()}
            assert dataset.observation_space.contains(first)
        assert [[e.terminations.sum(), e.truncations.sum()] for e in dataset] == [[0, 1], [1, 0]]
        assert dataset[0].truncations[-1]
        assert dataset[1].terminations[-1]
        assert dataset[1].rewards[-1] == 1


def test_the_dataset_says_where_each_episode_is_from(
    recordings: list[Recording], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_minari(recordings, tmp_path / "walks-v3")
    dataset = loaded(tmp_path / "walks-v3", monkeypatch)
    assert dataset.storage.metadata["action_names"] == ["forward", "turn_left"]
    about = list(dataset.storage.get_episode_metadata(range(2)))
    assert [row["uid"] for row in about] == [recording.episode.uid for recording in recordings]
    assert [row["seed"] for row in about] == [recording.episode.seed for recording in recordings]
    assert {row["instruction"] for row in about} == {"follow the person"}
    assert list(minari.list_local_datasets()) == ["walks-v3"]


@pytest.mark.parametrize("name", ["walks", "walks-v", "walks v0", "walks-v0.h5", "-v1.", "wälks-v0/x"])
def test_a_name_that_is_no_id_is_refused(name: str, recordings: list[Recording], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="H3-EXPORT-039"):
        write_minari(recordings, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_nothing_is_left_of_an_export_that_fails(recordings: list[Recording], tmp_path: Path) -> None:
    folder = tmp_path / "walks-v0"
    write_minari(recordings, folder)
    kept = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}

    def without(column: str) -> Recording:
        return replace(recordings[1], columns={k: v for k, v in recordings[1].columns.items() if k != column})

    narrower, silent = without("agent_0.joint_pos"), without("agent_0.action")
    for bad, code in ((narrower, "H3-EXPORT-032"), (silent, "H3-EXPORT-037")):
        with pytest.raises(InputError, match=code):
            write_minari([recordings[0], bad], folder)
    with pytest.raises(InputError, match="H3-EXPORT-027"):
        write_minari([], folder)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == kept


def test_the_command_writes_once_and_again_only_by_force(
    recordings: list[Recording], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "logs").mkdir()
    for number, recording in enumerate(recordings):
        write_mcap(recording, tmp_path / "logs" / f"{number}.mcap")
    arguments = ["export", str(tmp_path / "logs"), "--to", "minari", "-o", str(tmp_path / "walks-v0"), "--json"]
    assert main(arguments) == 0
    assert json.loads(capsys.readouterr().out)["episodes"] == 2
    assert main(arguments) == 2
    assert "not empty" in json.loads(capsys.readouterr().out)["error"]
    (tmp_path / "logs" / "1.mcap").unlink()
    assert main([*arguments, "--force"]) == 0
    assert loaded(tmp_path / "walks-v0", monkeypatch).total_episodes == 1
