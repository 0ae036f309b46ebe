"""Windows of steps for training: whole, in order, never across the border of an episode, the same in every worker."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.utils.data import DataLoader

from h3data.errors import InputError
from h3data.recording import Dataset, DatasetWriter
from h3data_training.samples import WindowDataset
from tests.recording.strategies import simple_recording

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


@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
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
        ({"history": 0}, "H3-RECORDING-125"),
        ({"horizon": -1}, "H3-RECORDING-125"),
        ({"stride": 0}, "H3-RECORDING-125"),
        ({"border": "wrap"}, "H3-RECORDING-126"),
        ({"episodes": [5]}, r"(?s)0\.\.4.*H3-RECORDING-079"),
    ):
        with pytest.raises(InputError, match=said):
            WindowDataset(dataset, COLUMNS, **options)
    with pytest.raises(InputError, match="H3-RECORDING-076"):
        WindowDataset(dataset, ["speed"])
    windows = WindowDataset(dataset, COLUMNS, history=100)
    assert len(windows) == 0
    with pytest.raises(IndexError, match="0 windows"):
        windows[0]


# --- the cache of mapped files ----------------------------------------------------------------------------------------
def all_windows(dataset: Dataset, **options) -> list[dict]:
    return list(WindowDataset(dataset, COLUMNS, history=3, horizon=2, border="pad", **options))


def same(first: list[dict], second: list[dict]) -> bool:
    return len(first) == len(second) and all(
        torch.equal(torch.as_tensor(a[name]), torch.as_tensor(b[name]))
        for a, b in zip(first, second, strict=True)
        for name in a
    )


def test_mapped_files_give_the_same_windows(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("H3DATA_CACHE", str(tmp_path))
    plain = all_windows(dataset)
    assert same(all_windows(dataset, disk_cache=True, cache_bytes=0), plain)
    files = sorted((tmp_path / "arrow").iterdir())
    assert len(files) == 3, "one for each shard"
    with monkeypatch.context() as patch:
        patch.setattr(Dataset, "read_group", None)  # nothing is read from Parquet any more
        windows = WindowDataset(dataset, COLUMNS, history=3, horizon=2, border="pad", disk_cache=True)
        assert same(list(pickle.loads(pickle.dumps(windows))), plain)
    files[0].unlink()
    (tmp_path / "arrow" / "gone.arrow").symlink_to(tmp_path / "nowhere")  # as one that another worker evicts meanwhile
    with monkeypatch.context() as patch:
        patch.setattr("h3data_training.samples.cache.log.info", pytest.fail)  # says that nothing is cached
        assert same(all_windows(dataset, disk_cache=True), plain)
    (tmp_path / "arrow" / "gone.arrow").unlink()
    files[0].write_bytes(b"ARROW1 and then something else")
    assert same(all_windows(dataset, disk_cache=True), plain)
    assert "broken" in caplog.text
    monkeypatch.setenv("H3DATA_CACHE", "off")
    assert same(all_windows(dataset, disk_cache=True), plain)
    (tmp_path / "file").touch()
    monkeypatch.setenv("H3DATA_CACHE", str(tmp_path / "file"))  # cannot be a folder
    assert same(all_windows(dataset, disk_cache=True), plain)


def test_a_dataset_that_was_written_anew_is_not_taken_from_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("H3DATA_CACHE", str(tmp_path / "cache"))
    for seed in range(2):
        with DatasetWriter(tmp_path / "ds", overwrite=True) as writer:
            writer.add(simple_recording(steps=5, seed=seed))
        dataset = Dataset(tmp_path / "ds")
        assert same(all_windows(dataset, disk_cache=True), all_windows(dataset))


def test_the_mapped_files_that_were_used_last_stay(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("H3DATA_CACHE", str(tmp_path))
    for column in ("agent_0.action", "agent_0.base_pose"):
        list(WindowDataset(dataset, [column], disk_cache=True))
    files = sorted((tmp_path / "arrow").iterdir(), key=lambda path: path.stat().st_mtime_ns)
    assert len(files) == 6
    largest = max(path.stat().st_size for path in files)
    monkeypatch.setenv("H3DATA_CACHE_GB", str(2.5 * largest / 1e9))
    list(WindowDataset(dataset, ["metrics.collision"], episodes=[0], disk_cache=True))
    kept = set((tmp_path / "arrow").iterdir())
    assert files[-1] in kept
    assert not kept & set(files[:3])
    assert sum(path.stat().st_size for path in kept) <= 2.5 * largest
    monkeypatch.setenv("H3DATA_CACHE_GB", "much")
    with pytest.raises(InputError, match="H3-RECORDING-056"):
        list(WindowDataset(dataset, ["time_ns"], disk_cache=True))
