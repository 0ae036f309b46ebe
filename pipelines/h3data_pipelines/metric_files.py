"""Files of metrics: tables of episodes as Parquet, CSV or JSON, and per-row series and events of many episodes."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from h3data.errors import InputError
from h3data.files import part_file, spreadsheet_cell
from h3data.metrics.registry import series_of
from h3data.metrics.requirements import UnmeasurableError
from h3data.metrics.table import MetricsTable
from h3data.recording.records import Recording
from h3data_pipelines.metric_texts import runs

_TEXTS = ("episode_id", "uid", "scene")
_PLAYERS = ("participant", "condition", "policy", "partner")
_NUMBERS = ("steps", "robot", "human", "encounter_row", "contact_row")


def write_table(table: MetricsTable, path: str | os.PathLike[str]) -> Path:
    """Write a table to ``.parquet`` or ``.csv`` (one row per episode) or ``.json`` (with means) and return its path.

    Undefined values are null in Parquet and JSON, and empty in CSV. The metadata of the Parquet file names the profile
    and metric ids.
    """
    target = Path(path)
    with part_file(target) as part:
        _by_ending(target, {".json": _table_json, ".csv": _table_csv, ".parquet": _table_parquet})(table, part)
    return target


def write_series(recordings: Iterable[Recording], path: str | os.PathLike[str], *, profile: str | None = None) -> int:
    """Write per-row series of recordings to ``.parquet`` (one row group each) or ``.csv``; return the number of rows.

    Columns: episode_id, row, time_ns, then the series of the first recording; series that a later recording lacks are
    null.
    """
    target = Path(path)
    write = _by_ending(target, {".parquet": _write_parquet, ".csv": _write_csv})
    with part_file(target) as part:
        return write(_series_tables(recordings, profile), part)


def write_events(recordings: Iterable[Recording], path: str | os.PathLike[str], *, profile: str | None = None) -> int:
    """Write runs of rows in which a profile's flags hold to ``.parquet`` or ``.csv``; return the number of runs.

    Columns: episode_id, what (the flag), first_row, last_row, seconds.
    """
    target = Path(path)
    write = _by_ending(target, {".parquet": _write_parquet, ".csv": _write_csv})
    with part_file(target) as part:
        return write(_events_tables(recordings, profile), part)


def events_of(recording: Recording, profile: str | None = None) -> list[dict[str, Any]]:
    """Return every run of rows in which a flag of the profile holds, in the order of their first rows."""
    times = recording.columns["time_ns"]
    events = [
        {"what": name, "first_row": int(a), "last_row": int(b), "seconds": float(times[b] - times[a]) * 1e-9}
        for name, values in (series_of(recording, profile) if len(recording) else {}).items()
        if values.dtype == np.bool_
        for a, b in runs(values)
    ]
    return sorted(events, key=lambda event: (event["first_row"], event["what"]))


def _table_json(table: MetricsTable, path: Path) -> None:
    path.write_text(table.to_json() + "\n", encoding="utf-8")


def _table_csv(table: MetricsTable, path: Path) -> None:
    with open(path, "w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        names = (*_TEXTS, *_player_columns(table), *_NUMBERS)
        writer.writerow([*names, *table.columns, "notes"])
        for row in table.episodes:
            facts = row.to_dict()
            values = ["" if v is None else repr(v) for v in facts["values"].values()]
            notes = "; ".join(f"{name}: {text}" for name, text in row.notes.items())
            writer.writerow(
                [*(spreadsheet_cell(facts.get(name, "")) for name in names), *values, spreadsheet_cell(notes)]
            )


def _table_parquet(table: MetricsTable, path: Path) -> None:
    rows = [row.to_dict() for row in table.episodes]
    texts = (*_TEXTS, *_player_columns(table))
    columns = [pa.array([row.get(fact, "") for row in rows], pa.string()) for fact in texts]
    columns += [pa.array([row[fact] for row in rows], pa.int64()) for fact in _NUMBERS]
    columns += [pa.array([row["values"][name] for row in rows], pa.float64()) for name in table.columns]
    columns.append(pa.array([json.dumps(row["notes"], ensure_ascii=False) for row in rows], pa.string()))
    metadata = {"h3data.profile": table.profile, "h3data.metrics": json.dumps({m.name: m.id for m in table.metrics})}
    stored = pa.table(columns, [*texts, *_NUMBERS, *table.columns, "notes"]).replace_schema_metadata(metadata)
    pq.write_table(stored, path, compression="zstd")


def _player_columns(table: MetricsTable) -> tuple[str, ...]:
    """Return columns that tell who played, as far as the recordings say."""
    return tuple(name for name in _PLAYERS if any(getattr(row, name) for row in table.episodes))


def _series_tables(recordings: Iterable[Recording], profile: str | None) -> Iterator[pa.Table]:
    for recording in recordings:
        if not len(recording):
            continue
        rows = len(recording)
        columns: dict[str, Any] = {
            "episode_id": pa.array([recording.episode.episode_id] * rows, pa.string()),
            "row": np.arange(rows),
            "time_ns": recording.columns["time_ns"],
        }
        try:
            series = series_of(recording, profile)
        except UnmeasurableError:
            continue  # `measure_files` lists it as left out
        yield pa.table(columns | {name: pa.array(v) for name, v in series.items()})


def _events_tables(recordings: Iterable[Recording], profile: str | None) -> Iterator[pa.Table]:
    kinds = [("episode_id", pa.string()), ("what", pa.string())]
    kinds += [("first_row", pa.int64()), ("last_row", pa.int64()), ("seconds", pa.float64())]
    for recording in recordings:
        try:
            events = events_of(recording, profile)
        except UnmeasurableError:
            continue  # `measure_files` lists it as left out
        rows = [{"episode_id": recording.episode.episode_id, **event} for event in events]
        yield pa.Table.from_pylist(rows, schema=pa.schema(kinds))


def _write_parquet(tables: Iterable[pa.Table], path: Path) -> int:
    return _write(tables, lambda schema: pq.ParquetWriter(path, schema, compression="zstd"))


def _write_csv(tables: Iterable[pa.Table], path: Path) -> int:
    from pyarrow.csv import CSVWriter

    return _write(tables, lambda schema: CSVWriter(path, schema))


def _write(tables: Iterable[pa.Table], open_writer: Callable[[pa.Schema], Any]) -> int:
    """Write tables one after the other with the columns of the first; return the number of rows."""
    rows, writer, schema = 0, None, pa.schema([("episode_id", pa.string())])
    try:
        for table in tables:
            if writer is None:
                schema = table.schema
                writer = open_writer(schema)
            writer.write_table(_in_shape(table, schema))
            rows += len(table)
    finally:
        (writer or open_writer(schema)).close()
    return rows


def _in_shape(table: pa.Table, schema: pa.Schema) -> pa.Table:
    """Return a table with the columns of ``schema`` only: nulls for those it lacks."""
    columns = [
        table[f.name].cast(f.type) if f.name in table.column_names else pa.nulls(len(table), f.type) for f in schema
    ]
    return pa.table(columns, schema=schema)


def _by_ending(path: Path, writers: dict[str, Callable[..., Any]]) -> Callable[..., Any]:
    if path.suffix not in writers:
        raise InputError(
            f"Expected a file name that ends in {' or '.join(writers)}, got {path.name!r}: {path}", code="H3-METRIC-048"
        )
    return writers[path.suffix]
