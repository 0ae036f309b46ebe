"""A dataset as Arrow, polars, pandas and torch tables: what `Dataset.recording` gives, padded where it must be."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from h3data.errors import InputError, MissingExtraError
from h3data.recording import Dataset, DatasetWriter
from h3data.recording.parquet.schema import STANDARD
from tests.recording.strategies import recordings, simple_recording


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Five episodes of different lengths in three shards; one is empty, one has fewer bodies."""
    root = tmp_path_factory.mktemp("tables") / "ds"
    lengths, bodies = (7, 0, 12, 3, 9), (2, 2, 1, 2, 2)
    with DatasetWriter(root, episodes_per_file=2) as writer:
        for seed, (steps, count) in enumerate(zip(lengths, bodies, strict=True)):
            writer.add(simple_recording(steps=steps, bodies=count, seed=seed))
    return Dataset(root)


def test_arrow_holds_every_step_in_order(dataset: Dataset) -> None:
    table = dataset.to_arrow()
    assert table.column_names == [*STANDARD, *(c.name for c in dataset.schema.columns)]
    assert table["index"].to_pylist() == list(range(31))
    assert table["episode_index"].to_pylist() == [0] * 7 + [2] * 12 + [3] * 3 + [4] * 9
    assert table.schema.field("object_pose").type == pa.list_(pa.float32(), 14)


def test_columns_and_episodes_come_as_asked(dataset: Dataset) -> None:
    table = dataset.to_arrow(["metrics.dist_agents", "frame_index"], episodes=[4, 1, 0])
    assert table.column_names == ["metrics.dist_agents", "frame_index"]
    assert table["frame_index"].to_pylist() == [*range(9), *range(7)]
    whole = np.concatenate([dataset.recording(k).columns["metrics.dist_agents"] for k in (4, 0)])
    np.testing.assert_array_equal(table["metrics.dist_agents"].to_numpy(), whole)
    assert len(dataset.to_arrow(episodes=[1])) == 0


@pytest.mark.slow
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(rec=recordings(max_steps=12), times=st.integers(1, 3))
def test_torch_is_what_was_recorded(tmp_path: Path, rec, times: int) -> None:
    root = tmp_path / "ds"
    with DatasetWriter(root, overwrite=root.exists(), episodes_per_file=2) as writer:
        for k in range(times):
            writer.add(replace(rec, episode=replace(rec.episode, uid=str(k))))
    tensors = Dataset(root).to_torch()
    for name, array in rec.columns.items():
        if array[:0].size or np.prod(array.shape[1:], dtype=int):
            tensor = tensors[name].numpy()
            assert tensor.dtype == array.dtype
            assert tensor.tobytes() == np.concatenate([array] * times).tobytes()
            assert tensor.shape == (len(array) * times, *array.shape[1:])


def test_torch_shares_memory_with_one_episode(dataset: Dataset) -> None:
    from h3data.recording.parquet import tables

    table = dataset.to_arrow(["object_pose"], episodes=[2])
    tensor = tables.to_torch(table, tables.shapes_of(dataset))["object_pose"]
    assert tensor.shape == (12, 2, 7)
    assert tensor[:, 1].isnan().all(), "the second body is padding"
    assert tensor.data_ptr() == table["object_pose"].chunk(0).flatten().buffers()[1].address


def test_polars_and_pandas_hold_the_same(dataset: Dataset) -> None:
    columns = ["episode_index", "metrics.dist_agents", "metrics.collision", "agent_0.base_pose"]
    table = dataset.to_arrow(columns)
    frame = dataset.to_polars(columns)
    assert frame.columns == columns
    assert frame.to_arrow().cast(table.schema).equals(table)
    pandas = dataset.to_pandas(columns)
    assert list(pandas.columns) == columns
    np.testing.assert_array_equal(pandas["metrics.dist_agents"], table["metrics.dist_agents"].to_numpy())
    poses = np.stack(table["agent_0.base_pose"].to_pylist())
    np.testing.assert_array_equal(np.stack(pandas["agent_0.base_pose"].to_list()), poses)


def test_what_is_not_there_is_named(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"(?s)\['speed'\].*metrics\.dist_agents.*H3-RECORDING-076"):
        dataset.to_arrow(["speed"])
    with pytest.raises(InputError, match=r"(?s)5.*0\.\.4.*H3-RECORDING-079"):
        dataset.to_arrow(episodes=[5])
    for name, convert in (("polars", dataset.to_polars), ("pandas", dataset.to_pandas)):
        monkeypatch.setitem(sys.modules, name, None)
        with pytest.raises(MissingExtraError, match=f"(?s){name}.*H3-RECORDING-07[78]"):
            convert()
