"""Open datasets with lerobot's own loader, and compare every row that it gives with the Parquet files, and every frame of its
videos with pictures that ``h3data rerender`` made.

Runs in an environment of its own (``make check-lerobot``): lerobot pins older packages than ours. Each argument is a dataset,
or ``DATASET=PICTURES`` with a folder of ``<anything>#<episode>.<camera>.rgb/<step>.png``.
"""

from __future__ import annotations

import functools
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import torch
from lerobot.datasets.compute_stats import aggregate_stats, get_feature_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from PIL import Image

BACKEND = os.environ.get("LEROBOT_BACKEND", "pyav")
"""lerobot's name of a decoder: pyav or torchcodec."""
LEAST_DB = 28.0
"""Least similarity of a decoded frame and the picture that was rendered for its step."""
ALIKE_DB = 32.0
"""Pictures of neighbouring steps that are more alike than this do not tell which of them a frame shows."""


def check(root: Path, pictures: Path | None) -> str:
    """Every row and frame (without pictures 60 of them) and, where there are actions, windows over time; a line about what was
    seen."""
    dataset = LeRobotDataset(f"local/{root.name}", root=root, video_backend=BACKEND)
    table = pq.read_table(root / "data").to_pydict()
    cameras = dataset.meta.video_keys
    assert len(dataset) == len(table["index"]) > 0, (len(dataset), len(table["index"]))
    worst, compared, told_apart = np.inf, 0, 0
    seen_rows = range(len(dataset)) if pictures else np.linspace(0, len(dataset) - 1, 60).astype(int).tolist()
    for k in seen_rows:
        row = dataset[k]
        for name, values in table.items():
            got = row[name].numpy()
            assert np.array_equal(got, np.asarray(values[k], got.dtype), equal_nan=got.dtype.kind == "f"), (name, k)
        assert row["task"] == dataset.meta.tasks.iloc[table["task_index"][k]].name
        for camera in cameras:
            assert tuple(row[camera].shape[-2:]) == tuple(dataset.meta.features[camera]["shape"][:2])
            if pictures is not None:
                episode, step = table["episode_index"][k], table["frame_index"][k]
                picture = rendered(pictures, camera, episode, step)
                found = psnr_db(row[camera], picture)
                assert found > LEAST_DB, (camera, k, found)
                worst, compared = min(worst, found), compared + 1
                for other in (step - 1, step + 1):
                    neighbour = rendered(pictures, camera, episode, other)
                    if neighbour is not None and psnr_db(as_frame(neighbour), picture) < ALIKE_DB:
                        assert found > psnr_db(row[camera], neighbour), (camera, k, other)
                        told_apart += 1
    assert {camera: dataset.meta.stats[camera]["mean"].shape for camera in cameras} == dict.fromkeys(cameras, (3, 1, 1))
    check_statistics(root, table)
    if "action" in table:
        check_windows(root, dataset, cameras)
    seen = f", {compared} frames of {len(cameras)} cameras as rendered (at least {worst:.1f} dB" if compared else ""
    seen += f", {told_apart} times nearer than to a neighbour)" if compared else ""
    tasks = ", ".join(map(repr, dataset.meta.tasks.index))
    rows = f"{len(seen_rows)} of {len(dataset)} rows of {len(table)} columns are equal"
    return f"{root}: {dataset.meta.total_episodes} episodes ({tasks}), {rows}{seen}"


def check_statistics(root: Path, table: dict[str, list[Any]]) -> None:
    """Statistics of each episode and of the dataset, against lerobot's own."""
    rows = pq.read_table(root / "meta" / "episodes").to_pylist()
    stored = json.loads((root / "meta" / "stats.json").read_text())
    episodes = np.asarray(table["episode_index"])
    features = {name: np.asarray(values, np.float64).reshape(len(episodes), -1) for name, values in table.items()}
    features = {
        name: values for name, values in features.items() if np.isfinite(values).all()
    }  # lerobot knows no padding
    assert len(features) > 10
    each = []
    for row in rows:
        own = {name: values[episodes == row["episode_index"]] for name, values in features.items()}
        each.append({name: get_feature_stats(values, axis=0, keepdims=False) for name, values in own.items()})
        for name, expected in each[-1].items():
            compare(row_stats(row, name), expected, f"{name} of episode {row['episode_index']}")
    for name, expected in aggregate_stats(each).items():
        compare(stored[name], expected, name)


def row_stats(row: dict[str, Any], name: str) -> dict[str, Any]:
    """The statistics of a feature in a row of the episode table."""
    prefix = f"stats/{name}/"
    return {key.removeprefix(prefix): value for key, value in row.items() if key.startswith(prefix)}


def compare(ours: dict[str, Any], theirs: dict[str, np.ndarray], what: str) -> None:
    """The same statistics, to float32 and, of quantiles, to two of lerobot's 5,000 bins."""
    assert ours.keys() == theirs.keys(), (what, ours.keys() ^ theirs.keys())
    reach = np.asarray(theirs["max"]) - theirs["min"]
    size = np.maximum(np.abs(theirs["max"]), np.abs(theirs["min"]))
    for name, expected in theirs.items():
        near = 2e-6 * size + (reach / 2500 if name.startswith("q") else 2e-5 * reach) + 1e-9
        assert (np.abs(np.asarray(ours[name]) - expected) <= near).all(), (what, name, ours[name], expected)


def check_windows(root: Path, dataset: LeRobotDataset, cameras: list[str]) -> None:
    """Windows of actions ahead and of pictures back, across the ends of episodes."""
    times = {"action": [0.0, 1 / 30, 2 / 30], **{camera: [-1 / 30, 0.0] for camera in cameras}}
    windows = LeRobotDataset(f"local/{root.name}", root=root, delta_timestamps=times, video_backend=BACKEND)
    assert windows[0]["action"].shape == (3, *dataset[0]["action"].shape)
    assert bool(windows[len(dataset) - 1]["action_is_pad"][-1]), "the window runs over the end"
    for k in (1, 7, len(dataset) // 2, len(dataset) - 1):
        for camera in cameras:
            window = windows[k][camera]
            assert torch.equal(window[1], dataset[k][camera]), (camera, k)
            before = k if bool(windows[k][f"{camera}_is_pad"][0]) else k - 1
            assert torch.equal(window[0], dataset[before][camera]), (camera, k)


@functools.lru_cache(maxsize=16)
def rendered(pictures: Path, feature: str, episode: int, step: int) -> np.ndarray | None:
    """The picture of a step that ``h3data rerender --format png`` made; None: there is no such step."""
    camera = feature.removeprefix("observation.images.")
    (folder,) = pictures.glob(f"*#{episode}.{camera}.rgb")
    path = folder / f"{step:06d}.png"
    return np.asarray(Image.open(path)) if path.exists() else None


def as_frame(picture: np.ndarray) -> torch.Tensor:
    """A picture in the form of a decoded frame."""
    return torch.from_numpy(picture / 255).permute(2, 0, 1)


def psnr_db(frame: torch.Tensor, picture: np.ndarray) -> float:
    """Peak signal-to-noise ratio of a frame [3, H, W] in 0..1; an odd size is padded in the video."""
    height, width = picture.shape[:2]
    error = frame.permute(1, 2, 0).numpy()[:height, :width] - picture / 255
    return float(-10 * np.log10(np.mean(error**2)))


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        place, _, of = argument.partition("=")
        sys.stdout.write(check(Path(place), Path(of) if of else None) + "\n")
