"""Windows of steps for training: whole, in order, never across the border of an episode, the same in every worker."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from recording_strategies import simple_recording
from torch.utils.data import DataLoader

from h3data.errors import InputError
from h3data.recording import Dataset, DatasetWriter, WindowDataset

LENGTHS = (7, 0, 12, 1, 9)
COLUMNS = ["agent_0.action", "metrics.collision", "frame_index"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    root = tmp_path_factory.mktemp("windows") / "ds"
    with DatasetWriter(root, episodes_per_file=2) as writer:
        for seed, steps in enumerate(LENGTHS):
            writer.add(simple_recording(steps=steps, seed=seed))
    return Dataset(root)


def expected(dataset: Dataset, history: int, horizon: int, stride: int, border: str) -> list[dict]:
    """All windows by the definition, row by row."""
    windows = []
    for episode, length in enumerate(LENGTHS):
        columns = {**dataset.recording(episode).columns, "frame_index": np.arange(length)}
        steps = range(length) if border == "pad" else range(history - 1, length - horizon)
        for step in steps[::stride]:
            rows = range(step - history + 1, step + horizon + 1)
            window = {name: np.stack([columns[name][min(max(r, 0), length - 1)] for r in rows]) for name in COLUMNS}
            valid = np.array([0 <= r < length for r in rows])
            windows.append({**window, "valid": valid, "episode": episode, "step": step})
    return windows


@given(
    history=st.integers(1, 8),
    horizon=st.integers(0, 8),
    stride=st.integers(1, 5),
    border=st.sampled_from(["drop", "pad"]),
    cache=st.sampled_from([0, 300, 1 << 20]),
)
def test_windows_are_those_of_the_definition(dataset, history, horizon, stride, border, cache) -> None:
    windows = WindowDataset(
        dataset, COLUMNS, history=history, horizon=horizon, stride=stride, border=border, cache_bytes=cache
    )
    want = expected(dataset, history, horizon, stride, border)
    assert len(windows) == len(want)
    for k in np.random.default_rng(history).permutation(len(want)):
        got = windows[int(k)]
        assert got.keys() == want[k].keys()
        for name, value in want[k].items():
            np.testing.assert_array_equal(np.asarray(got[name]), value)
            assert isinstance(value, int) or got[name].numpy().dtype == value.dtype


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_workers_give_what_one_process_gives(dataset: Dataset, method: str) -> None:
    windows = WindowDataset(dataset, COLUMNS, history=3, horizon=2, border="pad")
    windows[5]  # something is open and kept before the workers start

    def batches(workers: int) -> list[dict[str, torch.Tensor]]:
        context = method if workers else None
        order = torch.Generator().manual_seed(3)
        options = {"generator": order, "num_workers": workers, "multiprocessing_context": context}
        return list(DataLoader(windows, batch_size=8, shuffle=True, **options))

    one, two = batches(0), batches(2)
    assert len(one) == len(two) == 4
    assert one[0]["agent_0.action"].shape == (8, 5, 2)
    for a, b in zip(one, two, strict=True):
        assert all(torch.equal(a[name], b[name]) for name in a)


def test_one_window_reads_one_row_group_and_its_columns(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    windows = WindowDataset(dataset, ["agent_0.action"], history=2)
    reads: list[tuple[list[int], list[str]]] = []
    original = Dataset.read_group
    monkeypatch.setattr(
        Dataset, "read_group", lambda ds, group, names: reads.append((group, names)) or original(ds, group, names)
    )
    assert windows[-1]["episode"] == 4
    assert windows[-2]["episode"] == 4
    assert windows[0]["episode"] == 0
    assert reads == [([4], ["agent_0.action"]), ([0], ["agent_0.action"])]


def test_the_cache_is_bounded(dataset: Dataset) -> None:
    windows = WindowDataset(dataset, ["agent_0.base_pose"], cache_bytes=12 * 7 * 4)
    for _ in windows:
        assert sum(size for _, size in windows._cache.values()) <= 12 * 7 * 4
    assert list(windows._cache) == [3, 4]
    assert pickle.loads(pickle.dumps(windows))._cache == {}


def test_a_window_is_a_copy(dataset: Dataset) -> None:
    windows = WindowDataset(dataset, ["agent_0.base_pose"], history=3)
    before = windows[0]["agent_0.base_pose"].clone()
    windows[0]["agent_0.base_pose"].zero_()
    assert torch.equal(windows[0]["agent_0.base_pose"], before)


def test_a_pickled_dataset_keeps_its_episodes_when_the_folder_grows(tmp_path: Path) -> None:
    with DatasetWriter(tmp_path / "ds") as writer:
        writer.add(simple_recording(steps=4))
    windows = WindowDataset(Dataset(tmp_path / "ds"), ["time_ns"])
    sent = pickle.dumps(windows)
    with DatasetWriter(tmp_path / "ds", resume=True) as writer:
        writer.add(simple_recording(steps=5, seed=1))
    assert len(pickle.loads(sent)) == len(windows) == 4
    assert len(WindowDataset(Dataset(tmp_path / "ds"), ["time_ns"])) == 9


def test_refusals(dataset: Dataset) -> None:
    for options, said in (
        ({"history": 0}, "history >= 1"),
        ({"horizon": -1}, "horizon >= 0"),
        ({"stride": 0}, "stride >= 1"),
        ({"border": "wrap"}, "'drop' or 'pad'"),
        ({"episodes": [5]}, "0..4"),
    ):
        with pytest.raises(InputError, match=said):
            WindowDataset(dataset, COLUMNS, **options)
    with pytest.raises(InputError, match="No columns"):
        WindowDataset(dataset, ["speed"])
    windows = WindowDataset(dataset, COLUMNS, history=100)
    assert len(windows) == 0
    with pytest.raises(IndexError, match="0 windows"):
        windows[0]
