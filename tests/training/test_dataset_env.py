"""Environments made of exported demonstrations: the same states, pictures and rewards as the dataset holds."""

from __future__ import annotations

import json
import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import h3data
from h3data.envs import DatasetEnv
from h3data.errors import FormatError, H3DataError, InputError
from h3data.recording import Dataset, read_mcap
from h3data.recording.demonstrations import FILE, read_demonstrations
from h3data.replay import Replay, camera_at, camera_track
from h3data.replay.cameras import split_size
from h3data_exporters.lerobot import write_lerobot
from sim_kinematic.tasks.resume import verify
from tests.simulated import rearrange_episode, simulate_rearrange

CAMERAS = ("robot_arm_rgb@64x48", "robot_arm", "human_head@32x32")
HOME = "small:3"


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short episodes in one home, with other people."""
    root = tmp_path_factory.mktemp("source") / "ds"
    h3data.generate(
        "social_nav", root, scenes=[HOME], episodes=2, seed=5, max_steps=20, spawn_distance=2.0, human="any"
    )
    return root


@pytest.fixture(scope="module")
def exported(source: Path) -> Path:
    out = source.with_name("lerobot")
    h3data.export(source, out, to="lerobot", cameras=CAMERAS)
    return out


def frames_of(env: DatasetEnv, dataset: Dataset, number: int) -> list[dict[str, Any]]:
    """Observations of an episode under its recorded actions; checks rewards on the way."""
    columns = dataset[number].columns
    shown, info = env.reset(seed=number)
    seen = [shown]
    assert info["episode_index"] == number
    for action, reward in zip(columns["action"], columns["next.reward"], strict=True):
        assert env.observation_space.contains(seen[-1])
        shown, got, _, _, info = env.step(action)
        assert got == reward
        seen.append(shown)
    assert info["is_success"] == bool(columns["next.reward"].any())
    return seen


@pytest.mark.slow
def test_recorded_actions_give_the_recorded_states_and_pictures(exported: Path, source: Path) -> None:
    dataset = Dataset(exported)
    env = DatasetEnv(exported, episodes="recorded")
    assert set(env.observation_space.spaces) == {
        "observation.state",
        *(f"observation.images.{name}" for name in dataset.cameras),
    }
    for number in range(2):
        recording = Dataset(source)[number]  # with its last row
        seen = frames_of(env, dataset, number)
        states = np.stack([one["observation.state"] for one in seen])
        assert len(seen) == len(recording)
        assert np.array_equal(states[:-1], dataset[number].columns["observation.state"])
        replay = Replay(recording, light="baked")
        for name in CAMERAS:
            track = camera_track(replay, name)
            key = f"observation.images.{split_size(name)[0]}"
            for step in (0, 7, len(seen) - 1):
                ((_, (images,)),) = replay.frames([track], [step])
                height, width = images["rgb"].shape[:2]
                difference = np.abs(seen[step][key][:height, :width].astype(int) - images["rgb"])
                assert difference.max() <= 8, (name, step)
                assert (difference > 1).mean() < 0.001, (name, step)


def test_played_episodes_are_recorded_and_verify(exported: Path, source: Path, tmp_path: Path) -> None:
    out, made = tmp_path / "played", Dataset(source)
    env = DatasetEnv(exported, episodes="recorded", cameras=[], record=out)
    frames_of(pickle.loads(pickle.dumps(env)), Dataset(exported), 1)
    (file,) = out.iterdir()
    assert file.name == "1-0.mcap"
    recording = read_mcap(file)
    kept = {"agent_0.base_pose", "agent_0.action", "agent_1.base_pose", "metrics.dist_agents"}
    assert kept < set(recording.columns)
    for name in kept:
        assert np.array_equal(recording.columns[name], made[1].columns[name]), name
    assert verify(recording).difference is None
    assert dict(h3data.measure(recording).values) == dict(h3data.measure(made[1]).values)
    env.reset(seed=0)
    env.step([1.0, 0.0])
    env.reset(seed=0)
    assert [each.name for each in out.iterdir()] == [file.name], "episodes that are broken off are not kept"


def test_the_file_says_what_was_shown(exported: Path) -> None:
    shown = read_demonstrations(Dataset(exported).root)
    assert (shown.task, shown.agent, shown.instruction) == ("social_nav", "robot", "follow the person")
    sizes = {camera.camera: (camera.agent, camera.width, camera.height) for camera in shown.cameras}
    assert sizes == {
        "robot_arm_rgb": ("robot", 64, 48),
        "robot_arm": ("robot", 224, 171),
        "human_head": ("human", 32, 32),
    }
    info = json.loads((exported / "meta" / "info.json").read_text())
    for camera in shown.cameras:
        assert info["features"][camera.key]["shape"] == [camera.stored_height, camera.stored_width, 3]
    assert info["features"]["observation.state"]["names"] == list(shown.state_names)
    assert list(shown.seeds) == [recording.episode.seed for recording in Dataset(exported)]


def test_sampled_episodes_follow_from_the_seed(exported: Path) -> None:
    env = DatasetEnv(exported, cameras=["robot_arm_rgb"], max_steps=8)
    first, info = env.reset(seed=3)
    again, told = pickle.loads(pickle.dumps(env)).reset(seed=3)
    assert info == told
    assert all(np.array_equal(first[name], again[name]) for name in first)
    assert not np.array_equal(env.reset(seed=4)[0]["observation.state"], first["observation.state"])
    for k in range(7):
        _, _, terminated, truncated, _ = env.step([0.0, 0.0])
        assert (terminated, truncated) == (False, k == 6)
    with pytest.raises(InputError, match="H3-ENV-027"):
        env.step([0.0, 0.0])
    elsewhere = DatasetEnv(exported, "small:1", cameras=[], max_steps=8)
    assert elsewhere.reset(seed=0)[1]["scene"] == "home_small_1"


@pytest.mark.filterwarnings("ignore:.*Box observation space m.*:UserWarning")
def test_gymnasium_accepts_it(exported: Path) -> None:
    check_env(DatasetEnv(exported, cameras=["robot_arm"], max_steps=6, render_mode="rgb_array"), skip_render_check=True)


@pytest.mark.parametrize(
    ("action", "code"),
    [([0.0], "H3-ENV-010"), ([0.0] * 3, "H3-ENV-010"), ([[0.0, 0.0]], "H3-ENV-010"), ([np.nan, 0], "H3-ENV-029"),
     ([0, np.inf], "H3-ENV-029"), ("go", "H3-ENV-031"), (None, "H3-ENV-010"), (torch.zeros(2), "H3-ENV-059")],
)  # fmt: skip
def test_malformed_actions_move_nothing(exported: Path, action: Any, code: str) -> None:
    env = DatasetEnv(exported, episodes="recorded", cameras=[])
    env.reset(seed=0)
    with pytest.raises(InputError, match=code):
        env.step(action)
    actions = Dataset(exported)[0].columns["action"]
    shown, *_ = env.step(actions[0])
    assert np.array_equal(shown["observation.state"], Dataset(exported)[0].columns["observation.state"][1])


def test_datasets_that_cannot_be_played_are_refused(exported: Path, source: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="H3-RECORDING-132"):
        DatasetEnv(source)  # generated, not exported
    with pytest.raises(InputError, match="H3-ENV-043"):
        DatasetEnv(exported, episodes="all")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="H3-ENV-044"):
        DatasetEnv(exported, max_steps=1)
    with pytest.raises(InputError, match="H3-ENV-045"):
        DatasetEnv(exported, "small:1", episodes="recorded")
    with pytest.raises(InputError, match=r"(?s)robot_arms.*robot_arm.*H3-ENV-047"):
        DatasetEnv(exported, cameras=["robot_arms"])
    with pytest.raises(InputError, match="H3-RENDER-046"):
        DatasetEnv(exported, light="dark")  # type: ignore[arg-type]
    copy = tmp_path / "copy"
    shutil.copytree(exported, copy)
    good = json.loads((copy / FILE).read_text())
    for change in (
        {"version": 99},
        {"seeds": "none"},
        {"seeds": []},
        {"episode_scenes": [7, 0]},
        {"agent": "human"},
        {"agent": "nobody"},
        {"cameras": [{**good["cameras"][0], "agent": "ghost"}]},
    ):
        (copy / FILE).write_text(json.dumps({**good, **change}))
        with pytest.raises(H3DataError):
            DatasetEnv(copy, cameras=None if "cameras" in change else [])
    (copy / FILE).write_bytes(b"\xff{")
    with pytest.raises(FormatError):
        DatasetEnv(copy)


@pytest.mark.slow
def test_demonstrations_of_an_arm_cannot_be_played(tmp_path: Path) -> None:
    from h3data_homes import HomeSpec, build_home

    recording = simulate_rearrange(rearrange_episode(build_home(HomeSpec(seed=3)), seed=1))
    write_lerobot([recording], tmp_path / "ds")
    with pytest.raises(InputError, match="H3-ENV-046"):
        DatasetEnv(tmp_path / "ds")


# --- named cameras at any size ----------------------------------------------------------------------------------------
def test_cameras_have_any_size_in_environments() -> None:
    env = h3data.make("social_nav", HOME, observations=["humanoid_gps", "robot_arm@48x32", "arm_depth@16x12"])
    shapes = {name: space.shape for name, space in env.observation_space.spaces.items()}
    assert shapes == {"humanoid_gps": (2,), "robot_arm": (32, 48, 3), "arm_depth": (12, 16, 1)}
    shown, _ = env.reset(seed=1)
    assert shown["robot_arm"].dtype == np.uint8
    assert len(np.unique(shown["robot_arm"])) > 10
    both = h3data.make("social_nav", HOME, observations=["robot_arm_rgb", "arm_rgb"], rgb_size=(32, 24)).reset(seed=1)[
        0
    ]
    assert np.array_equal(both["robot_arm_rgb"], both["arm_rgb"]), "the same lens under two names"


@pytest.mark.parametrize("name", ["robot_leg", "robot_arm@4by4", "robot_arm@-4x4"])
def test_cameras_and_sizes_that_do_not_exist(source: Path, tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=f"(?s){name}.*H3-SIM-046"):
        h3data.make("social_nav", HOME, observations=["robot_arm", name])
    with pytest.raises(InputError, match=f"(?s){name}.*H3-REPLAY-017"):
        camera_track(Replay(Dataset(source)[0], light="flat"), name)
    with pytest.raises(InputError, match=f"(?s){name}.*H3-REPLAY-017"):
        h3data.export(source, tmp_path / "out", to="lerobot", cameras=[name])
    assert not (tmp_path / "out").exists()


def test_one_camera_has_one_size(source: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="H3-SIM-058"):
        h3data.make("social_nav", HOME, observations=["robot_arm@8x8", "robot_arm@4x4"])
    with pytest.raises(InputError, match="H3-EXPORT-001"):
        h3data.export(source, tmp_path / "out", to="lerobot", cameras=["robot_arm@8x8", "robot_arm@4x4"])
    with pytest.raises(InputError, match="H3-EXPORT-038"):
        h3data.export(source, tmp_path / "out", to="lerobot", cameras=["robot_arm@9x8"])
    replay = Replay(Dataset(source)[0], light="flat")
    for name in ("third_person@64x64", "robot_arm@20x10"):
        one, other = camera_at(replay, name, 3), camera_track(replay, name).at(3)
        assert (one.width, one.height, one.fx) == pytest.approx((other.width, other.height, other.fx))
