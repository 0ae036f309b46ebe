"""Recorded rearrangement exported as episodes that habitat-lab loads, and played again from there."""

from __future__ import annotations

import gzip
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.errors import InputError
from h3data.recording.task_episodes.rearrange_episode import goal_poses, instance_handles, object_poses
from h3data_habitat.episodes.episode_json import KEYS
from h3data_habitat.episodes.files import read_episodes
from h3data_habitat.scenes.scene_instance import load_habitat_scene
from h3data_pipelines.cli import main


def run_json(capsys: pytest.CaptureFixture[str], *args: object, code: int = 0) -> Any:
    capsys.readouterr()
    assert main([*map(str, args), "--json"]) == code
    return json.loads(capsys.readouterr().out)


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("played") / "ds"
    h3data.generate(
        "rearrange",
        out,
        scenes="small",
        homes=2,
        episodes=2,
        policies="still",
        partners="both",
        max_steps=600,
        rules="paper",
    )
    return out


@pytest.fixture(scope="module")
def exported(played: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exported") / "data" / "h3"
    h3data.export(played, folder, to="habitat-episodes")
    return folder


def test_the_file_is_what_habitat_lab_reads(played: Path, exported: Path) -> None:
    content = read_episodes(exported / "episodes/rearrange.json.gz", strict=True)
    assert len(content) == 2
    recordings = list(h3data.open(played))
    for number, (episode, recording) in enumerate(zip(content.episodes, recordings, strict=True)):
        assert (episode.episode_id, episode.extra, episode.absent) == (str(number), {}, frozenset())
        goals = recording.episode.info["goals"]
        assert len(episode.targets) == len(goals) == 2
        scene = load_habitat_scene(episode.scene_id)
        assert scene.source["config"].endswith(episode.scene_dataset_config.rsplit("/", 1)[-1])
        assert {i.motion for i in scene.instances} == {
            "static"
        }  # what moves is an object of the episode, and only that
        movable = {i.name for i in recording_scene(recording) if i.motion == "kinematic"}
        moving = [b for b in recording.bodies if b.name in movable]
        assert len(episode.rigid_objects) == len(moving) > 10
        for thing in episode.rigid_objects:
            assert (exported / "objects" / thing.config).is_file()
        handles = instance_handles(episode)
        assert set(episode.targets) <= set(handles)
        starts, ends = object_poses(episode), goal_poses(episode)
        known = {f"{i.name}|{r.name}" for i, r in scene.receptacles()}
        for k, (handle, goal) in enumerate(zip(episode.targets, goals, strict=True)):
            np.testing.assert_allclose(starts[handle][:3], goal["start"][:3], atol=1e-6)
            np.testing.assert_allclose(ends[handle][:3], goal["position"], atol=1e-6)
            assert episode.info["object_labels"][handle] == f"any_targets|{k}"
            assert episode.name_to_receptacle[handle] in known
            assert episode.target_receptacles[k][0] == episode.name_to_receptacle[handle].partition("|")[0]
            assert any(name.startswith(episode.goal_receptacles[k][0] + "|") for name in known)
    assert KEYS.keys() >= {"rigid_objs", "targets"}  # the fields of habitat-lab's RearrangeEpisode, none beside them


def recording_scene(recording: Any) -> Any:
    from h3data.scene import load_scene

    return load_scene(recording.attachments["scene.glb"]).instances


@pytest.mark.slow
def test_the_export_is_played_again(
    played: Path, exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = exported / "episodes/rearrange.json.gz"
    args = ("--policy", "still", "--partner", "both", "-o", tmp_path / "again")
    again = run_json(capsys, "generate", "rearrange", "--episodes-file", file, *args)
    assert again["warnings"] == []
    for a, b in zip(h3data.open(played), h3data.open(tmp_path / "again"), strict=True):
        assert a.columns["state_hash"][-1] == b.columns["state_hash"][-1]


@pytest.mark.slow
def test_the_exported_scenes_are_played_where_the_home_cannot_be_built(
    played: Path, exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As by a later generator, in a folder that has been moved; and without our record, as any file of Habitat."""
    moved = tmp_path / "moved"
    shutil.copytree(exported, moved)
    file = moved / "episodes/rearrange.json.gz"
    content = json.loads(gzip.decompress(file.read_bytes()))
    for episode in content["episodes"]:
        episode["info"]["h3data"]["scene_sha256"] = "0" * 64
    file.write_bytes(gzip.compress(json.dumps(content).encode()))
    short = ("--policy", "still", "--partner", "both", "--max-steps", 20, "-o")
    made = run_json(capsys, "generate", "rearrange", "--episodes-file", file, *short, tmp_path / "ours")
    assert (made["episodes"], made["failed"], made["warnings"]) == (2, [], [])
    for episode in content["episodes"]:
        del episode["info"]["h3data"]
    bare = moved / "episodes/bare.json"
    bare.write_text(json.dumps(content))
    plain = run_json(capsys, "generate", "rearrange", "--episodes-file", bare, *short, tmp_path / "plain")
    assert (plain["episodes"], plain["failed"], plain["warnings"]) == (2, [], [])
    for name in ("ours", "plain"):
        for a, b in zip(h3data.open(played), h3data.open(tmp_path / name), strict=True):
            np.testing.assert_allclose(b.columns["object_pose"][0], a.columns["object_pose"][0], atol=1e-5)
            assert len(b.bodies) > 20


def test_other_recordings_are_refused(tmp_path: Path) -> None:
    h3data.generate("wander", tmp_path / "ds", episodes=1, max_steps=5)
    with pytest.raises(InputError, match="H3-HABITAT-049"):
        h3data.export(tmp_path / "ds", tmp_path / "out", to="habitat-episodes")
