"""Stored episodes: drawn by a pure function, played as they are, the same through files and through the command line."""

from __future__ import annotations

import gzip
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import h3data
from h3data.errors import InputError, SceneError
from h3data.recording import Dataset
from h3data.recording.task_episodes.social_nav_episodes import SocialNavEpisode, read_social_nav
from h3data.scene import scene_digest
from h3data.scene.open import open_free_space, open_scene
from h3data.scene.scene_sets import SceneEntry, SceneSet, SocialNavRules
from h3data.scene.sources import SceneFile
from h3data_habitat.episodes.files import read_episodes
from h3data_habitat.episodes.scenes import scene_of_episode
from h3data_homes import HomeSpec
from h3data_pipelines.assets.set_episodes import sampled_episode, set_episode
from h3data_pipelines.cli import main
from sim_kinematic.agents.waypoint_walker import human_plan
from sim_kinematic.motion.spec import STEP_S, BaseSpec, SocialNavSpec, WalkerSpec
from sim_kinematic.tasks.social_nav import SocialNav, episode_from, goals_of
from tests.simulated import simulate_social_nav, social_nav_episode

CODEC = SocialNav().codec

HOME = HomeSpec(seed=1)
SET_TEXT = """
format = 1
name = "two"
split = "eval"
scenes = [{ id = "a", seed = 1 }, { id = "b", seed = 2 }]
[social_nav]
episodes_per_scene = 3
spawn_distance_m = 4.0
"""


def small_set(seed: int = 1) -> SceneSet:
    return SceneSet(
        name="two",
        split="eval",
        scenes=(SceneEntry(id="a", source=HomeSpec(seed=seed)),),
        social_nav=SocialNavRules(spawn_distance_m=4.0),
        about="",
        sha256="",
    )


def run_json(capsys: pytest.CaptureFixture[str], *arguments: str | Path, code: int = 0) -> Any:
    capsys.readouterr()
    assert main([*map(str, arguments), "--json"]) == code
    return json.loads(capsys.readouterr().out)


# --- drawing ----------------------------------------------------------------------------------------------------------
def test_the_episode_is_a_pure_function() -> None:
    scenes = small_set()
    entry = scenes.scenes[0]
    first = [set_episode(scenes, entry, k) for k in range(8)]
    open_scene.cache_clear()
    open_free_space.cache_clear()
    assert [set_episode(scenes, entry, k) for k in reversed(range(8))] == first[::-1]
    assert len({e.robot_start for e in first}) == 8
    assert set_episode(scenes, entry, 0, seed=1) != first[0]
    other = replace(scenes, split="train")
    assert set_episode(other, entry, 0).seed != first[0].seed


def test_starts_and_goals_are_where_one_can_be() -> None:
    scenes = small_set()
    free = open_free_space(HOME, 0.25, 1.41)
    for k in range(20):
        episode = set_episode(scenes, scenes.scenes[0], k)
        points = np.array([episode.robot_start[:2], episode.human_start[:2], *episode.human_goals])
        islands = free.island(points)
        assert (islands == islands[0]).all()
        assert islands[0] >= 0
        assert np.hypot(*(points[0] - points[1])) >= 4.0
        assert 4.0 <= free.geodesic(points[0], points[1]) < np.inf
        assert len(episode.human_goals) >= 3  # a walk through the home
        assert episode.scene_sha256 == scene_digest(open_scene(HOME))
        assert HomeSpec(**{n: v for n, v in episode.scene_source.items() if n != "kind"}) == HOME


@pytest.mark.slow
@pytest.mark.parametrize("split", ["val", "test"])
def test_all_episodes_of_the_eval_splits_can_be_played(split: str) -> None:
    from h3data.scene.scene_sets import find_scene_set

    scenes = find_scene_set(f"h3-homes/{split}")
    assert scenes is not None
    for i in range(scenes.episodes):
        entry, index = scenes.place(i)
        episode = set_episode(scenes, entry, index)
        free = open_free_space(entry.source, 0.25, 1.41)
        world = episode_from(episode, open_scene(entry.source), free=free)
        assert free.geodesic(world.starts[0, :2], world.starts[1, :2]) >= 5.0
        x, z, heading = world.starts[1]
        track = human_plan(free, np.array([x, z]), heading, world.seed, WalkerSpec(), 1500, goals_of(world)).xz
        steps = np.hypot(*np.diff(track, axis=0).T)
        assert steps.sum() > 50  # of the 125 m that fit into 50 s; the largest homes have goals 40 m apart
        standing = np.diff(np.flatnonzero(np.concatenate([[1], steps > 1e-9, [1]]))) - 1
        assert standing.max() <= np.ceil(np.pi / (WalkerSpec().turn_rad_s * STEP_S))  # a turn right round, never stuck


# --- playing ----------------------------------------------------------------------------------------------------------
def test_a_stored_episode_plays_like_the_drawn_one() -> None:
    spec = SocialNavSpec(max_steps=200)
    free = open_free_space(HOME, spec.agent_radius_m, spec.agent_height_m)
    drawn = social_nav_episode(open_scene(HOME), seed=5, spec=spec, free=free)
    stored = episode_from(CODEC.record(drawn), drawn.scene, free=free)
    assert CODEC.record(stored) == CODEC.record(drawn)
    a, b = simulate_social_nav(drawn), simulate_social_nav(stored)
    for name, column in a.columns.items():
        np.testing.assert_array_equal(column, b.columns[name], err_msg=name)
    assert a.episode.info["oracle_min_steps"] == b.episode.info["oracle_min_steps"]
    assert a.episode.info["human_goals"] == b.episode.info["human_goals"]


def test_the_person_goes_where_the_episode_says() -> None:
    """Not where its seed would have sent them; after the last stored goal the person goes on by themselves."""
    episode = sampled_episode(HOME, seed=5, spec=SocialNavSpec(max_steps=400))
    told = msgspec.structs.replace(episode, human_goals=episode.human_goals[2:0:-1], goals_complete=False)
    world = episode_from(told, open_scene(HOME), spec=SocialNavSpec(max_steps=400, end_on_collision=False))
    recording = simulate_social_nav(world, policy="stand_still")
    walked = recording.episode.info["human_goals"]
    assert walked[:2] == [list(g) for g in told.human_goals]
    assert len(walked) > 2
    person = recording.columns["agent_1.base_pose"][:, [0, 2]]
    for goal in walked[:2]:
        assert np.hypot(*(person - goal).T).min() < 0.05
    uids = {
        simulate_social_nav(episode_from(e, open_scene(HOME), spec=SocialNavSpec(max_steps=2))).episode.uid
        for e in (episode, told)
    }
    assert len(uids) == 2


def test_rules_come_with_the_episode() -> None:
    episode = sampled_episode(HOME, seed=5, spec=SocialNavSpec(max_steps=77, near_m=0.9))
    assert CODEC.rules(episode) == SocialNavSpec(max_steps=77, near_m=0.9)
    bare = msgspec.structs.replace(episode, rules={}, robot="", human="")
    assert CODEC.rules(bare) == SocialNavSpec(max_steps=77, robot=BaseSpec(), human=WalkerSpec())  # as in the paper
    assert [member.model for member in episode_from(bare, open_scene(HOME)).roster] == ["quad_arm", "female_0"]
    assert episode_from(episode, open_scene(HOME), human="male_0").roster[1].model == "male_0"
    for rules in ({"near_m": "x"}, {"max_steps": 0}, {"human": {"speed_mps": -1}}, {"human": {"speed_mps": 1e9}}):
        with pytest.raises(InputError, match=r"H3-TASK-0(49|52)"):
            CODEC.rules(msgspec.structs.replace(episode, rules=rules))
    with pytest.raises(InputError, match=r"(?s)yeti.*H3-BODY-072"):
        episode_from(msgspec.structs.replace(episode, human="humanoid/yeti"), open_scene(HOME))


def test_an_episode_of_another_home_is_refused() -> None:
    episode = sampled_episode(HOME, seed=5, spec=SocialNavSpec())
    rounded = msgspec.structs.replace(
        episode, human_goals=tuple((round(x, 2), round(z, 2)) for x, z in episode.human_goals)
    )
    world = episode_from(rounded, open_scene(HOME))
    assert world.free.is_navigable(np.array(goals_of(world))).all()
    for change in ({"robot_start": (99.0, 0.0, 0.0)}, {"human_goals": ((1e9, 0.0),)}):
        with pytest.raises(SceneError, match="H3-TASK-050"):
            episode_from(msgspec.structs.replace(episode, **change), open_scene(HOME))


@pytest.mark.slow
# --- commands ---------------------------------------------------------------------------------------------------------
def test_generate_plays_a_set_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "two.toml"
    file.write_text(SET_TEXT)
    options = ("generate", "social_nav", "--scenes", file, "--max-steps", "12", "-o")
    whole = run_json(capsys, *options, tmp_path / "whole")
    assert whole["episodes"] == 6
    assert len(set(whole["state_hashes"])) == 6
    first = run_json(capsys, *options, tmp_path / "parts", "--episodes", "2")
    assert first["state_hashes"] == whole["state_hashes"][:2]
    rest = run_json(capsys, *options, tmp_path / "parts", "--episodes", "6", "--resume")
    assert (rest["new"], rest["state_hashes"]) == (4, whole["state_hashes"])
    origins = [r.episode.info["origin"] for r in h3data.open(tmp_path / "whole")]
    assert [(o["set"], o["split"], o["scene"], o["episode"]) for o in origins] == [
        ("two", "eval", s, k) for k in range(3) for s in "ab"
    ]
    others = run_json(capsys, *options, tmp_path / "others", "--seed", "9")
    assert not set(others["state_hashes"]) & set(whole["state_hashes"])
    assert main([*map(str, options), str(tmp_path / "text"), "--seed", "9", "--episodes", "1"]) == 0
    assert "1 episode in the scenes of two/eval, drawn with seed 9" in capsys.readouterr().out
    one = run_json(capsys, "generate", "social_nav", "--scenes", f"{file}#b", "--max-steps", "12", "-o", tmp_path / "b")
    assert one["state_hashes"] == whole["state_hashes"][1::2]
    file.write_text(SET_TEXT.replace("4.0", "3.0"))
    assert "Cannot resume" in run_json(capsys, *options, tmp_path / "parts", "--resume", code=2)["error"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--scenes", "SET", "--episodes", "7"), "at most 6"),
        (("--scenes", "SET", "--spawn-distance", "2"), "leave out --spawn-distance"),
        (("--scenes", "SET#c"), "There is no scene 'c'"),
        (("--scenes", "none.toml"), "No such file"),
        (("--episodes-file", "none.json.gz"), "none.json.gz"),
        (("--episodes-file", "SET"), "two.toml"),
        (("--episodes-file", "x", "--scenes", "medium"), "leave out --scenes"),
        (("--episodes-file", "x", "--seed", "3"), "leave out --seed"),
    ],
)
def test_refusals(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("two.toml").write_text(SET_TEXT)
    given = [a.replace("SET", "two.toml") for a in arguments]
    assert words in run_json(capsys, "generate", "social_nav", *given, "-o", "ds", code=2)["error"]
    assert not Path("ds").exists()


@pytest.mark.slow
def test_an_exported_set_plays_the_same_from_its_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "two.toml"
    file.write_text(SET_TEXT)
    data = run_json(capsys, "scenes", "export", file, "-o", tmp_path / "export")
    assert data["scenes"] == ["a", "b"]
    (episodes_file,) = data["episodes"]
    episodes = read_episodes(episodes_file, strict=True).episodes
    scenes = tmp_path / "export/scenes"
    assert [e.scene_id for e in episodes[:2]] == [f"{scenes}/{name}.scene_instance.json" for name in "ab"]
    assert all(Path(e.scene_id).is_file() for e in episodes)
    assert Path(episodes[0].scene_dataset_config).is_file()
    options = ("--max-steps", "40", "--episodes", "3", "-o")
    a = run_json(capsys, "generate", "social_nav", "--scenes", file, *options, tmp_path / "a")
    b = run_json(capsys, "generate", "social_nav", "--episodes-file", episodes_file, *options, tmp_path / "b")
    assert a["state_hashes"] == b["state_hashes"]
    origin = Dataset(tmp_path / "b").recording(1).episode.info["origin"]
    assert (origin["file"], origin["episode"]) == ("social_nav_two_eval.json.gz", 1)
    none = run_json(capsys, "scenes", "export", file, "-o", tmp_path / "bare", "--episodes", "0")
    assert none["episodes"] == []


@pytest.mark.slow
def test_a_home_that_is_built_differently_now_is_taken_from_its_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "two.toml"
    file.write_text(SET_TEXT)
    data = run_json(capsys, "scenes", "export", file, "-o", tmp_path / "export", "--episodes", "1")
    path = Path(data["episodes"][0])
    episode = read_episodes(path).episodes[0]
    nav = read_social_nav(episode)
    assert nav is not None
    assert scene_of_episode(episode, nav, path.parent) == HomeSpec(seed=1)
    changed: SocialNavEpisode = msgspec.structs.replace(nav, scene_sha256="0" * 64)
    source = scene_of_episode(episode, changed, path.parent)
    assert isinstance(source, SceneFile)
    assert goals_of(episode_from(nav, open_scene(source)))  # its free floor is that of the home, to a few centimetres
    (tmp_path / "export").rename(tmp_path / "moved")
    with pytest.raises(SceneError, match="H3-HABITAT-032"):
        scene_of_episode(episode, changed, tmp_path / "elsewhere")


def test_habitats_own_episodes_say_no_starts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    episode = {"episode_id": "3", "scene_id": "s", "start_position": [0, 0, 0], "start_rotation": [0, 0, 0, 1]}
    with gzip.open(tmp_path / "plain.json.gz", "wt") as file:
        json.dump({"episodes": [episode]}, file)
    options = ("generate", "social_nav", "--episodes-file", tmp_path / "plain.json.gz", "-o", tmp_path / "ds")
    assert "says neither where" in run_json(capsys, *options, code=2)["error"]


def test_lists_of_sets(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = run_json(capsys, "scenes", "list")
    episodes = {"train": 37_000, "val": 1200, "test": 150}
    assert {s["set"]: s["episodes"] for s in data["sets"]} == {
        f"{name}/{split}": count
        for name in ("h3-homes", "h3-homes-v2", "h3-homes-large")
        for split, count in episodes.items()
    } | {"h3-homes-open/train": 740, "h3-homes-open/val": 240, "h3-homes-open/test": 200}
    assert [p["preset"] for p in data["presets"]] == [
        *("small", "medium", "large", "small2", "medium2", "large2"),
        *("small2-storeys", "medium2-storeys"),
    ]
    file = tmp_path / "two.toml"
    file.write_text(SET_TEXT)
    rows = run_json(capsys, "scenes", "list", file)["scenes"]
    assert [(r["scene"], r["id"]) for r in rows] == [(f"{file}#0", "a"), (f"{file}#1", "b")]
    assert all(r["triangles"] > 1000 and r["free_m2"] > 10 for r in rows)
    shown = run_json(capsys, "scenes", "show", f"{file}#1", "-o", tmp_path / "b.png", "--pixels-per-m", "20")
    assert (tmp_path / "b.png").stat().st_size > 1000
    assert shown["rooms"] == rows[1]["rooms"]
    assert "#0" in run_json(capsys, "scenes", "show", file, "-o", tmp_path / "c.png", code=2)["error"]
    assert run_json(capsys, "scenes", "validate", file)["faults"] == 0
