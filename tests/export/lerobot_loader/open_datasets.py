"""Open datasets with lerobot's own loader, and compare every row that it gives with the Parquet files.

Runs in an environment of its own (``make check-lerobot``): lerobot pins older packages than ours.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import torch

# torchvision's operators need the CUDA build of torch; lerobot imports it for pictures, which our tables have none of.
_operators = torch.library.Library("torchvision", "DEF")
for _name in ("nms", "qnms"):
    _operators.define(f"{_name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")

from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402


def check(root: Path) -> str:
    """Every row and, where there are actions, windows over time; a line about what was seen."""
    dataset = LeRobotDataset(f"local/{root.name}", root=root)
    table = pq.read_table(root / "data").to_pydict()
    assert len(dataset) == len(table["index"]) > 0, (len(dataset), len(table["index"]))
    for k in range(len(dataset)):
        row = dataset[k]
        for name, values in table.items():
            got = row[name].numpy()
            assert np.array_equal(got, np.asarray(values[k], got.dtype), equal_nan=got.dtype.kind == "f"), (name, k)
    if "action" in table:
        windows = LeRobotDataset(f"local/{root.name}", root=root, delta_timestamps={"action": [0.0, 1 / 30, 2 / 30]})
        assert windows[0]["action"].shape == (3, *dataset[0]["action"].shape)
        assert bool(windows[len(dataset) - 1]["action_is_pad"][-1]), "the window runs over the end"
    return f"{root}: {dataset.meta.total_episodes} episodes, {len(dataset)} rows of {len(table)} columns are equal"


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        sys.stdout.write(check(Path(argument)) + "\n")
