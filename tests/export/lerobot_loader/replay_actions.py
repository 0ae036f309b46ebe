"""Play the actions of a dataset in the environment of ``--env.type=h3data``, and compare what a policy is shown there with what
lerobot's loader reads: states to the bit, pictures as far as the video's compression lets them.

Runs in an environment of its own (``make check-lerobot``). The arguments are a dataset and the folder of an evaluation by
``lerobot-eval`` on it.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import EnvConfig
from lerobot.envs.factory import make_env
from lerobot.envs.utils import env_to_policy_features, preprocess_observation
from lerobot.policies.act.configuration_act import ACTConfig  # noqa: F401  # registers what checkpoints name

import lerobot_env_h3data  # noqa: F401

LEAST_DB = 28.0
"""Least similarity of a frame of the video and the picture in the environment."""


def psnr_db(one: torch.Tensor, other: torch.Tensor) -> float:
    """Similarity of pictures in 0..1."""
    return float(-10 * torch.log10(torch.mean((one - other) ** 2) + 1e-12))


def refusal(worlds: Any, actions: np.ndarray) -> str:
    """The code of the error with which an environment refuses actions; empty: it takes them."""
    try:
        worlds.step(actions)
    except Exception as error:
        return str(getattr(error, "code", error))
    return ""


def check(root: Path) -> str:
    """Replay all episodes in two worlds at once; a line about what was seen."""
    dataset = LeRobotDataset(f"local/{root.name}", root=root, video_backend="pyav")
    config = EnvConfig.get_choice_class("h3data")(dataset=str(root), episodes="recorded")
    for key, feature in env_to_policy_features(config).items():
        expected = tuple(dataset.meta.features[key]["shape"])
        assert feature.shape == ((expected[2], *expected[:2]) if len(expected) == 3 else expected), (key, feature)
    (worlds,) = make_env(config, n_envs=2)["h3data"].values()
    starts = dataset.meta.episodes["dataset_from_index"]
    ends = dataset.meta.episodes["dataset_to_index"]
    steps, worst, actions = 0, np.inf, torch.zeros(2, len(dataset.meta.features["action"]["names"]))
    for number in range(dataset.meta.total_episodes):
        observation, _ = worlds.reset(seed=[number, number])
        succeeded = False
        for k in range(starts[number], ends[number]):
            row, shown = dataset[k], preprocess_observation(observation)
            assert torch.equal(shown["observation.state"][0], row["observation.state"]), (number, k)
            assert torch.equal(shown["observation.state"][0], shown["observation.state"][1])
            for camera in dataset.meta.video_keys:
                worst = min(worst, psnr_db(shown[camera][0], row[camera]))
                assert worst > LEAST_DB, (camera, k, worst)
            assert worlds.call("task_description")[0] == row["task"]
            actions[:] = row["action"]
            observation, reward, _, _, info = worlds.step(actions.numpy())
            assert reward[0] == float(row["next.reward"]), (number, k)
            facts = info.get("final_info", info)
            succeeded = bool(facts["is_success"][0])
            steps += 1
        wanted = any(bool(dataset[k]["next.success"]) for k in range(starts[number], ends[number]))
        assert succeeded == wanted, (number, succeeded, wanted)
    for bad in (np.full((2, 2), np.nan), np.zeros((2, 3)), np.full((2, 2), np.inf)):
        worlds.reset(seed=[0, 1])
        assert "H3-ENV-0" in refusal(worlds, bad.astype(np.float32)), bad
    return f"{root}: {steps} steps of {number + 1} episodes replayed, states equal to the bit, pictures at least {worst:.1f} dB"


if __name__ == "__main__":
    sys.stdout.write(check(Path(sys.argv[1])) + "\n")
    found = json.loads((Path(sys.argv[2]) / "eval_info.json").read_text())
    assert found["overall"]["n_episodes"] == 2, found
    sys.stdout.write(f"evaluated: {found['overall']}\n")
