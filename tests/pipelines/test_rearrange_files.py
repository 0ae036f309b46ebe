"""Rearrangement episodes as files: ours, played again bit for bit, and Habitat's."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.geometry import pose_to_matrix
from h3data.recording import recordings_equal
from h3data.scene.open import open_scene
from h3data_habitat.exporters.scenes import export_habitat
from h3data_homes import HomeSpec
from h3data_pipelines.cli import main
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode, RearrangeSpec
from sim_kinematic.tasks.rearrange.task import Rearrange

HOME = HomeSpec(seed=1)
BOWL = "024_bowl"


def run_json(capsys: pytest.CaptureFixture[str], *args: object, code: int = 0) -> Any:
    capsys.readouterr()
    assert main([*map(str, args), "--json"]) == code
    return json.loads(capsys.readouterr().out)


def content(file: Path) -> Any:
    return json.loads(gzip.decompress(file.read_bytes()) if file.suffix == ".gz" else file.read_bytes())


def written(file: Path, episodes: list[Any]) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"episodes": episodes}).encode()
    file.write_bytes(gzip.compress(text) if file.suffix == ".gz" else text)
    return file


# --- ours -------------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_saved_episodes_are_played_again_bit_for_bit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "eps.json.gz"
    options = ("--scenes", "h3-homes/test", "--episodes", 2, "--save-episodes", file)
    planned = run_json(capsys, "generate", "rearrange", *options, "--dry-run", "-o", tmp_path / "no")
    assert planned["plan"]["saved_episodes"] == str(file)
    assert not (tmp_path / "no").exists()
    first = file.read_bytes()
    run_json(capsys, "generate", "rearrange", *options, "--force", "-o", tmp_path / "a")
    assert file.read_bytes() == first
    again = run_json(capsys, "generate", "rearrange", "--episodes-file", file, "-o", tmp_path / "b")
    assert (again["episodes"], again["left_out"], again["warnings"]) == (2, [], [])
    for k in range(2):
        a, b = (h3data.open(tmp_path / name).recording(k) for name in "ab")
        assert b.episode.info["origin"]["episode"] == k
        for recording in (a, b):
            recording.episode.info.pop("origin", None)
            recording.episode.info.pop("job")
        assert recordings_equal(a, b) == []
        assert a.episode.uid == b.episode.uid
    resumed = run_json(capsys, "generate", "rearrange", "--episodes-file", file, "--resume", "-o", tmp_path / "b")
    assert resumed["new"] == 0


def test_an_edited_episode_is_another_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "eps.json"
    run_json(
        capsys,
        "generate",
        "rearrange",
        "--scenes",
        "small:1",
        "--episodes",
        1,
        "--save-episodes",
        file,
        "--dry-run",
        "-o",
        tmp_path / "no",
    )
    episodes = content(file)["episodes"]
    goals = episodes[0]["info"]["h3data"]["goals"]
    goals[0]["start"], goals[1]["start"] = goals[1]["start"], goals[0]["start"]
    written(tmp_path / "edited.json", episodes)
    play = ("--max-steps", 30, "--policy", "still", "--partner", "still")
    uids = []
    for name in ("eps", "edited"):
        run_json(
            capsys, "generate", "rearrange", "--episodes-file", tmp_path / f"{name}.json", *play, "-o", tmp_path / name
        )
        recording = h3data.open(tmp_path / name).recording(0)
        uids.append(recording.episode.uid)
    assert uids[0] != uids[1]
    np.testing.assert_allclose(recording.columns["object_pose"][0], [g["start"] for g in goals], atol=1e-6)


def test_a_task_without_a_record_of_its_own_has_files_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "eps.json"
    options = ("--agents", "robot,male_1", "--max-steps", 40)
    run_json(
        capsys,
        "generate",
        "wander",
        "--scenes",
        "small",
        "--episodes",
        2,
        *options,
        "--save-episodes",
        file,
        "-o",
        tmp_path / "a",
    )
    run_json(capsys, "generate", "wander", "--episodes-file", file, "-o", tmp_path / "b")
    for k in range(2):
        a, b = (h3data.open(tmp_path / name).recording(k) for name in "ab")
        assert a.episode.uid == b.episode.uid
        assert a.columns["state_hash"][-1] == b.columns["state_hash"][-1]
    refused = run_json(capsys, "generate", "rearrange", "--episodes-file", file, "-o", tmp_path / "c", code=2)
    assert "is one of wander, not of rearrange" in refused["error"]


# --- Habitat's --------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def sampled() -> RearrangeEpisode:
    return Rearrange().episode(open_scene(HOME), seed=3, spec=RearrangeSpec())  # type: ignore[return-value]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as Habitat's users have it: ``data/`` with a scene dataset."""
    root = tmp_path_factory.mktemp("habitat")
    export_habitat(open_scene(HOME), root / "data" / "home")
    return root


def habitat_episode(folder: Path, sampled: RearrangeEpisode) -> dict[str, Any]:
    """An episode as habitat-lab writes it: an object of the dataset, and one whose template is not here."""
    config = next(folder.glob("data/home/*.scene_dataset_config.json")).relative_to(folder)
    scene = next(folder.glob("data/home/scenes/*.json")).relative_to(folder)
    things = json.loads((folder / scene).read_text())["object_instances"]
    mine = next(t for t in things if t["user_defined"]["h3data"]["name"] == sampled.targets[0].name)
    names = [mine["template_name"], BOWL]
    matrices = [pose_to_matrix(target.start).tolist() for target in sampled.targets]
    goals = [pose_to_matrix(np.concatenate([t.goal, [0, 0, 0, 1]])).tolist() for t in sampled.targets]
    handles = [f"{name}_:0000" for name in names]
    return {
        "episode_id": "7",
        "scene_id": scene.as_posix(),
        "scene_dataset_config": config.as_posix(),
        "additional_obj_config_paths": ["data/objects/ycb/configs/"],
        "start_position": [0, 0, 0],
        "start_rotation": [0, 0, 0, 1],
        "info": {"object_labels": {handle: f"any_targets|{k}" for k, handle in enumerate(handles)}},
        "ao_states": {},
        "rigid_objs": [[f"{name}.object_config.json", m] for name, m in zip(names, matrices, strict=True)],
        "targets": dict(zip(handles, goals, strict=True)),
        "markers": [],
        "target_receptacles": [[t.source.split("|")[0], None] for t in sampled.targets],
        "goal_receptacles": [[t.destination.split("|")[0], None] for t in sampled.targets],
        "name_to_receptacle": {h: t.source for h, t in zip(handles, sampled.targets, strict=True)},
    }


@pytest.mark.slow  # quick: those below, in fewer steps
def test_a_habitat_file_is_played_in_its_scene(
    folder: Path, sampled: RearrangeEpisode, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    episode = habitat_episode(folder, sampled)
    lost = {**episode, "scene_id": "data/nowhere/scenes/b.scene_instance.json", "scene_dataset_config": "default"}
    file = written(tmp_path / "val.json.gz", [lost, episode, lost])
    args = ("generate", "rearrange", "--episodes-file", file, "--assets", folder, "--policy", "solo", "-o")
    result = run_json(capsys, *args, tmp_path / "ds", code=1)
    assert (result["episodes"], result["failed"]) == (1, [])
    assert [text.partition(":")[0] for text in result["left_out"]] == ["episodes 0, 2"]
    assert "Cannot find the scene 'data/nowhere/scenes/b.scene_instance.json'" in result["left_out"][0]
    assert [text.partition(":")[0] for text in result["warnings"]] == [f"a box stands in for '{BOWL}'"]
    recording = h3data.open(tmp_path / "ds").recording(0)
    info = recording.episode.info
    assert (recording.episode.episode_id, info["origin"]["episode_id"]) == ("000001", "7")
    assert any(BOWL in warning for warning in info["scene_source"]["warnings"])
    assert [goal["object"] for goal in info["goals"]] == list(episode["targets"])
    assert [goal["from"] for goal in info["goals"]] == list(episode["name_to_receptacle"].values())
    start = np.array([t.start for t in sampled.targets])
    np.testing.assert_allclose(recording.columns["object_pose"][0], start, atol=1e-5)
    assert info["ended"] == "success"
    assert recording.bodies[info["goal_objects"][1]].asset == BOWL
    # the same episode again, from another folder, resumed, and other starts from another seed
    same = run_json(capsys, *args, tmp_path / "again", "--workers", 2, code=1)
    assert same["state_hashes"] == result["state_hashes"]
    other = run_json(capsys, *args, tmp_path / "other", "--seed", 5, "--max-steps", 5, code=1)
    assert other["state_hashes"] != result["state_hashes"]
    assert h3data.open(tmp_path / "other").recording(0).episode.uid != recording.episode.uid
    verified = run_json(capsys, "replay", f"{tmp_path / 'ds'}#0", "--verify")
    assert (verified["recordings"], verified["equal"]) == (1, 1)


def test_habitat_episodes_are_saved_with_their_starts(
    folder: Path, sampled: RearrangeEpisode, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = written(tmp_path / "val.json.gz", [habitat_episode(folder, sampled)])
    short = ("--max-steps", 60, "--assets", folder, "-o")
    run_json(
        capsys,
        "generate",
        "rearrange",
        "--episodes-file",
        file,
        "--save-episodes",
        tmp_path / "ours.json",
        *short,
        tmp_path / "a",
    )
    run_json(capsys, "generate", "rearrange", "--episodes-file", tmp_path / "ours.json", *short, tmp_path / "b")
    a, b = (h3data.open(tmp_path / name).recording(0) for name in "ab")
    assert a.episode.uid == b.episode.uid
    assert a.columns["state_hash"][-1] == b.columns["state_hash"][-1]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"targets": {"ghost_:0000": np.eye(4).tolist()}}, "its target 'ghost_:0000' is none of its objects"),
        ({"rigid_objs": []}, "is none of its objects (it has none)"),
        ({"targets": {}}, "names no targets"),
        (
            {"targets": {f"{BOWL}_:0000": np.zeros((4, 4)).tolist()}},
            "the goal of '024_bowl_:0000' is no rotation and translation",
        ),
        ({"rigid_objs": [[f"{BOWL}.object_config.json", [[float("nan")] * 4] * 4]]}, "Expected finite numbers"),
        ({"scene_id": "data/gone.scene_instance.json", "scene_dataset_config": "default"}, "Cannot find the scene"),
    ],
)
def test_a_hostile_episode_ends_in_one_line(
    folder: Path,
    sampled: RearrangeEpisode,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    change: dict[str, Any],
    told: str,
) -> None:
    file = written(tmp_path / "val.json", [{**habitat_episode(folder, sampled), **change}])
    args = ("generate", "rearrange", "--episodes-file", file, "--assets", folder, "-o", tmp_path / "ds")
    error = run_json(capsys, *args, code=2)["error"]
    assert told in error
    assert "\n" not in error
    assert not (tmp_path / "ds").exists()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"goals": []}, "goals is empty"),
        ({"robot_start": [1e999, 0, 0]}, "out of range"),
        ({"robot_start": [900, 0, 0]}, "not on the free floor"),
        ({"version": 99}, "Expected version 1, got 99"),
        ({"rules": {"objects": 5}}, "has 2 goals, its rules say 5 objects"),
        ({"goals": "both"}, "Expected"),
        ("unknown", "has no receptacle 'cloud|nine'"),
        ("strange", "has no movable thing 'unicorn'"),
    ],
)
def test_a_hostile_record_of_ours_ends_in_one_line(
    saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Any, told: str
) -> None:
    episodes = content(saved)["episodes"]
    block = episodes[0]["info"]["h3data"]
    if change == "unknown":
        block["goals"][0]["to"] = "cloud|nine"
    elif change == "strange":
        block["goals"][0]["object"] = "unicorn"
    else:
        block |= change
    file = tmp_path / "bad.json"
    file.write_text(json.dumps({"episodes": episodes}).replace("Infinity", "1e999"))
    error = run_json(capsys, "generate", "rearrange", "--episodes-file", file, "-o", tmp_path / "ds", code=2)["error"]
    assert told in error
    assert "\n" not in error


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("saved") / "eps.json.gz"
    args = [
        "generate",
        "rearrange",
        "--scenes",
        "small:1",
        "--episodes",
        "1",
        "--dry-run",
        "--save-episodes",
        str(file),
    ]
    assert main([*args, "-o", "unused"]) == 0
    return file


def test_files_that_are_none_end_in_one_line(saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "cut.json.gz").write_bytes(saved.read_bytes()[:-40])
    written(tmp_path / "empty.json", [])
    for name, told in (("cut.json.gz", "amaged"), ("empty.json", "no episodes"), ("none.json", "no such file")):
        args = ("generate", "rearrange", "--episodes-file", tmp_path / name, "-o", tmp_path / "ds")
        error = run_json(capsys, *args, code=2)["error"]
        assert told in error
        assert "\n" not in error


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--scenes", "medium"), "leave out --scenes"),
        (("--seed", "3"), "leave out --seed"),
        (("--spawn-distance", "3"), "leave out --spawn-distance"),
        (("--set", "objects=3"), "leave out the rule objects=3"),
        (("--episodes", "2"), "at most 1"),
    ],
)
def test_options_that_a_file_decides_are_refused(
    saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], told: str
) -> None:
    args = ("generate", "rearrange", "--episodes-file", saved, *options, "-o", tmp_path / "ds")
    assert told in run_json(capsys, *args, code=2)["error"]


@pytest.mark.slow
def test_policies_are_evaluated_on_a_file(
    saved: Path, folder: Path, sampled: RearrangeEpisode, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    args = ("evaluate", "rearrange", "--policies", "complement", "--partners", "both", "-o", tmp_path / "out")
    result = run_json(capsys, *args, "--episodes-file", saved)
    assert (result["episodes"], result["job"]["episodes_file"]["file"]) == (1, saved.name)
    refused = run_json(capsys, *args, "--episodes-file", saved, "--scenes", "small", code=2)
    assert "leave out --scenes" in refused["error"]
    episode = habitat_episode(folder, sampled)
    file = written(tmp_path / "val.json", [episode, {**episode, "targets": {}}])
    other = ("--policies", "complement", "--partners", "both", "-o", tmp_path / "habitat", "--max-steps", 20)
    result = run_json(capsys, "evaluate", "rearrange", *other, "--episodes-file", file, "--assets", folder, code=1)
    assert result["left_out"][0].startswith("episode 1: Episode '7' names no targets")
    assert BOWL in result["warnings"][0]


def test_python_plays_and_saves_files(saved: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.json.gz"
    made = h3data.generate("rearrange", tmp_path / "ds", episodes_file=saved, save_episodes=again, max_steps=10)
    assert (len(made.dataset), made.failed, made.left_out) == (1, (), ())
    assert (
        content(again)["episodes"][0]["info"]["h3data"]["goals"]
        == content(saved)["episodes"][0]["info"]["h3data"]["goals"]
    )


# --- PARTNR's ---------------------------------------------------------------------------------------------------------
def partnr_episode(folder: Path, sampled: RearrangeEpisode, *propositions: dict[str, Any]) -> dict[str, Any]:
    """An episode as partnr-planner writes it: no targets, an instruction and propositions instead."""
    episode = habitat_episode(folder, sampled)
    return {
        **episode,
        "targets": {},
        "target_receptacles": [],
        "goal_receptacles": [],
        "instruction": "Bring the can and the bowl to the table.",
        "evaluation_propositions": list(propositions),
        "evaluation_proposition_dependencies": [],
        "evaluation_constraints": [{"type": "TerminalSatisfactionConstraint", "args": {"proposition_indices": [0]}}],
        "object_states": {},
    }


def on_top(objects: list[str], furniture: list[str], **more: Any) -> dict[str, Any]:
    args = {"object_handles": objects, "receptacle_handles": furniture, "number": 1, **more}
    return {"function_name": "is_on_top", "args": args}


def table_of(folder: Path) -> str:
    """Handle of the dining table in the exported scene."""
    scene = json.loads(next(folder.glob("data/home/scenes/*.json")).read_text())
    table = next(t for t in scene["object_instances"] if t["user_defined"]["h3data"]["name"] == "dining_table_0")
    return f"{table['template_name']}_:0000"


def test_partnr_episodes_are_played_where_they_ask_for_places(
    folder: Path, sampled: RearrangeEpisode, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    handles, table = list(habitat_episode(folder, sampled)["targets"]), table_of(folder)
    both = on_top(handles, [table], number=2)
    clean = {"function_name": "is_clean", "args": {"object_handles": handles}}
    twice = on_top(handles[:1], [table])
    file = written(
        tmp_path / "partnr.json.gz",
        [
            partnr_episode(folder, sampled, both),
            partnr_episode(folder, sampled, both, clean),
            partnr_episode(folder, sampled, twice, twice),
            partnr_episode(folder, sampled, on_top(handles, ["moon_:0000"])),
        ],
    )
    args = (
        "generate",
        "rearrange",
        "--episodes-file",
        file,
        "--assets",
        folder,
        "--policy",
        "solo",
        "--max-steps",
        1200,
    )
    result = run_json(capsys, *args, "-o", tmp_path / "ds", code=1)
    assert "asks for is_clean, which h3data does not play" in result["left_out"][0]
    assert "more than once" in result["left_out"][1]
    assert "no such furniture" in result["failed"][0]
    info = h3data.open(tmp_path / "ds").recording(0).episode.info
    assert info["ended"] == "success"
    assert [goal["object"] for goal in info["goals"]] == handles
    assert {goal["to"].partition("|")[0] for goal in info["goals"]} == {table}
    a, b = (np.array(goal["position"]) for goal in info["goals"])
    assert np.hypot(*(a - b)[[0, 2]]) > 0.05
    shown = run_json(capsys, "info", file)["found"][0]
    assert (shown["episodes"], shown["tasks"]) == (4, {"collaboration (PARTNR)": 4})
    assert shown["predicates"] == {"is_on_top": 5, "is_clean": 1}
    assert shown["instructions"] == ["Bring the can and the bowl to the table."]
    assert not shown["unplayable"]  # the others are tasks in words


@pytest.mark.slow
def test_episodes_of_one_file_may_differ_in_their_number_of_objects(
    folder: Path, sampled: RearrangeEpisode, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    two = habitat_episode(folder, sampled)
    one = {**two, "targets": dict(list(two["targets"].items())[:1])}
    file = written(tmp_path / "val.json.gz", [one, two, one])
    args = ("--assets", folder, "--policy", "still", "--partner", "both", "--max-steps", 10, "-o", tmp_path / "ds")
    result = run_json(capsys, "generate", "rearrange", "--episodes-file", file, *args)
    assert (result["episodes"], result["failed"]) == (3, [])
    shapes = [r.columns["object_pose"].shape[1] for r in h3data.open(tmp_path / "ds")]
    assert shapes == [1, 2, 1]


@pytest.mark.parametrize(
    ("proposition", "told"),
    [
        ({"function_name": "is_on_top", "args": {"object_handles": 3}}, "Expected array"),
        (on_top([], ["a"]), "asks for 1 of 0 objects on 1 pieces of furniture"),
        (on_top(["a"], []), "asks for 1 of 1 objects on 0 pieces of furniture"),
        ({"args": {}}, "missing required field function_name"),
    ],
)
def test_hostile_propositions_end_in_one_line(
    folder: Path,
    sampled: RearrangeEpisode,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    proposition: dict[str, Any],
    told: str,
) -> None:
    file = written(tmp_path / "bad.json", [partnr_episode(folder, sampled, proposition)])
    args = ("generate", "rearrange", "--episodes-file", file, "--assets", folder, "-o", tmp_path / "ds")
    error = run_json(capsys, *args, code=2)["error"]
    assert told in error
    assert "\n" not in error


# --- info -------------------------------------------------------------------------------------------------------------
def test_info_tells_what_files_hold(
    saved: Path, folder: Path, sampled: RearrangeEpisode, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    episode = habitat_episode(folder, sampled)
    file = written(tmp_path / "val.json.gz", [episode, {**episode, "targets": {"x": np.eye(4).tolist()}}])
    (tmp_path / "cut.json.gz").write_bytes(saved.read_bytes()[:-40])
    ours, theirs, cut = run_json(capsys, "info", saved, file, tmp_path / "cut.json.gz", code=1)["found"]
    assert (ours["kind"], ours["episodes"], ours["tasks"], ours["complete"]) == (
        "episodes",
        1,
        {"rearrange (h3data)": 1},
        1,
    )
    assert ours["scenes"] == {"small:1": 1}
    assert ours["apart_m"]["least"] >= 5
    assert sum(ours["destinations"].values()) == ours["goals"]["greatest"] == 2
    assert (theirs["episodes"], theirs["tasks"], theirs["complete"]) == (2, {"rearrange (Habitat)": 2}, 0)
    assert theirs["templates"][BOWL] == 1
    assert list(theirs["sources"]) == list(episode["name_to_receptacle"].values())
    straight = [np.hypot(*(t.start[[0, 2]] - t.goal[[0, 2]])) for t in sampled.targets]
    assert theirs["carry_m"]["mean"] == pytest.approx(np.mean(straight), abs=1e-4)
    assert "its target 'x' is none of its objects" in next(iter(theirs["unplayable"]))
    assert "amaged" in cut["error"]
    assert main(["info", str(file)]) == 0
    text = capsys.readouterr().out
    for line in ("rearrange (Habitat) (2)", "starts       sampled when they are played", "from objects to their goals"):
        assert line in text


def test_info_of_real_files(real: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = real / "habitat-lab"
    demo, teleop = run_json(capsys, "info", folder / "demo.json.gz", folder / "hitl_teleop_episodes.json.gz")["found"]
    assert (demo["episodes"], len(demo["scenes"]), demo["objects"]["greatest"]) == (2, 2, 7)
    assert (teleop["episodes"], teleop["goals"]["mean"]) == (2000, 1)


def test_habitats_own_assets_are_played_in_their_frames(
    real: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In habitat-sim's test scene: a chair whose center of mass is 22 cm off its origin, and a donut on the table."""
    assets = real / "habitat-sim" / "data" / "test_assets"
    donut, chair = np.eye(4), np.eye(4)
    donut[:3, 3] = 0.85, 1.21, -0.25
    chair[:3, 3] = 2.5, 0.6, 2.5
    there, turned = donut.copy(), pose_to_matrix(np.array([2.0, 0.7, 3.0, 0, np.sin(0.6), 0, np.cos(0.6)]))
    there[:3, 3] = 0.2, 1.21, -0.85
    episode = {
        "episode_id": "0",
        "scene_id": "data/test_assets/scenes/simple_room.stage_config.json",
        "scene_dataset_config": "default",
        "additional_obj_config_paths": ["data/test_assets/objects/"],
        "rigid_objs": [["donut.object_config.json", donut.tolist()], ["chair.object_config.json", chair.tolist()]],
        "targets": {"donut_:0000": there.tolist(), "chair_:0000": turned.tolist()},
        "info": {"object_labels": {"donut_:0000": "any_targets|0", "chair_:0000": "any_targets|1"}},
        "instruction": "Put the donut across the table.",
    }
    one = {**episode, "targets": {"donut_:0000": there.tolist()}}
    file = written(tmp_path / "eps.json", [episode, one])
    args = ("--assets", assets.parent, "--spawn-distance", 2, "--policy", "solo", "-o", tmp_path / "ds")
    result = run_json(capsys, "generate", "rearrange", "--episodes-file", file, *args)
    assert (result["warnings"], result["failed"]) == ([], [])
    both, alone = (recording.episode.info for recording in h3data.open(tmp_path / "ds"))
    assert (alone["ended"], alone["instruction"]) == ("success", episode["instruction"])
    middle = np.array([-0.07404434, -0.20700817, 0.00593796])  # of the chair, from its mesh's box
    np.testing.assert_allclose(both["goals"][1]["start"][:3], chair[:3, 3] - middle, atol=1e-6)
    np.testing.assert_allclose(both["goals"][1]["position"], turned[:3, 3] - turned[:3, :3] @ middle, atol=1e-6)
    np.testing.assert_allclose(both["goals"][0]["start"][:3], donut[:3, 3], atol=1e-6)


def test_episodes_that_cannot_be_sampled_are_left_out_of_the_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    args = ("--scenes", "small", "--episodes", 2, "--homes", 2, "--dry-run", "-o", tmp_path / "ds")
    refused = ("--save-episodes", tmp_path / "x.json", "--spawn-distance", 90)
    told = run_json(capsys, "generate", "rearrange", *args, *refused, code=2)["error"]
    assert "Found no start poses 90.0 m apart" in told
    assert not (tmp_path / "x.json").exists()
    told = run_json(capsys, "generate", "rearrange", *args, "--save-episodes", tmp_path / "x.txt", code=2)["error"]
    assert "ends in .json.gz or .json" in told
