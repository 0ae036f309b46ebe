"""Writer of a shard of a dataset: data file, sidecars and episode table, which become visible when all are complete."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from h3data.errors import InputError
from h3data.recording.parquet.columns import padded, to_arrow
from h3data.recording.parquet.files import FILES_PER_CHUNK, shard_path
from h3data.recording.parquet.moments import Moments, finite_stats, lerobot_stats, merge_into, moments_of, pack_moments
from h3data.recording.parquet.schema import (
    SIDECARS,
    STANDARD,
    DatasetSchema,
    data_schema,
    episode_schema,
    record_schema,
    stored_dtype,
)
from h3data.recording.parquet.videos import EpisodeVideo, VideoAppender
from h3data.recording.records import Recording
from h3data.recording.schema import Column

ZSTD_LEVEL, FAST_LEVEL, PAGE_BYTES = 6, 2, 8 << 20


class Shard:
    """Files with up to ``episodes_per_file`` episodes, before they are committed."""

    def __init__(self, root: Path, number: int, schema: DatasetSchema, *, video_number: int = 0) -> None:
        """Open data file ``number`` of the dataset in ``root`` under its temporary name.

        ``video_number`` is that of the last shard with videos.
        """
        self.root, self.number, self.schema, self.video_number = root, number, schema, video_number
        self.episodes = self.frames = self.row_groups = 0
        self.rows: list[dict[str, Any]] = []
        """Rows of the episode table."""
        self.sidecars: dict[str, list[pa.Table]] = {kind: [] for kind in SIDECARS}
        self.stats: list[dict[str, Moments]] = []
        """Moments of each episode with steps, if the episode table has statistics of features."""
        self.moments: dict[str, Moments] = {}
        self.parts: list[tuple[Path, Path]] = []
        """Temporary and final name of each file."""
        self.videos: dict[str, VideoAppender] = {}
        """Video file of each camera, by the key of its feature."""
        self.spoiled = False
        """True if a row group was begun and not finished, so that the file cannot be used."""
        self._arrow = data_schema(schema)
        self._stream = self._open("data")
        self._writer = pq.ParquetWriter(self._stream, self._arrow, **self._parquet_options())

    @property
    def bytes(self) -> int:
        """Present size of the data file [bytes]."""
        return self._stream.tell()

    @property
    def video_frames(self) -> int:
        """Present number of frames in each video file."""
        return max((video.frames for video in self.videos.values()), default=0)

    @property
    def video_bytes(self) -> int:
        """Present size of the largest video file [bytes]."""
        return max((video.bytes for video in self.videos.values()), default=0)

    def add(
        self,
        recording: Recording,
        row: dict[str, Any],
        sidecars: dict[str, list[dict[str, Any]]],
        *,
        videos: Mapping[str, EpisodeVideo],
        index: int,
        start: int,
        task: int,
        instruction: str,
    ) -> None:
        """Write an episode: its steps as one row group, its row of the episode table, its records and its videos.

        ``index`` and ``start`` are the numbers of the episode and of its first step in the whole dataset.
        """
        steps = len(recording)
        arrays = {
            # as stored, with the same bits
            c.name: padded(recording.columns.get(c.name), c, steps).view(stored_dtype(c))
            for c in self.schema.columns
            if c.width
        }
        frame = np.arange(steps, dtype=np.int64)
        standard = {
            "timestamp": (frame / self.schema.fps).astype(np.float32),
            "frame_index": frame,
            "episode_index": np.full(steps, index, np.int64),
            "index": frame + start,
            "task_index": np.full(steps, task, np.int64),
        }
        arrays |= {name: values[:, None] for name, values in standard.items()}
        table = pa.Table.from_arrays([to_arrow(arrays[name]) for name in self._arrow.names], schema=self._arrow)
        tables = {kind: _record_table(kind, records, index) for kind, records in sidecars.items() if records}
        # before anything is written: what numpy refuses must not spoil the file
        moments = {name: moments_of(a) for name, a in arrays.items()}
        chunk, file = divmod(self.number, FILES_PER_CHUNK)
        place: dict[str, Any] = {
            "episode_index": index,
            "tasks": [instruction],
            "task_index": task,
            "length": steps,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "meta/episodes/chunk_index": chunk,
            "meta/episodes/file_index": file,
            "dataset_from_index": start,
            "dataset_to_index": start + steps,
        }
        self.spoiled = True  # from here on, all or nothing
        if steps:
            self._writer.write_table(table, row_group_size=steps)
            merge_into(self.moments, moments)
            self.stats += [moments] * self.schema.episode_stats
            for key, video in videos.items():
                place |= self._add_video(key, video)
        # an episode without steps has a row but no row group
        self.rows.append({**row, **place, "row_group": self.row_groups if steps else -1})
        for kind, records in tables.items():
            self.sidecars[kind].append(records)
        self.row_groups += steps > 0
        self.episodes += 1
        self.frames += steps
        self.spoiled = False

    def commit(self) -> None:
        """Write the sidecars and the episode table, then give all files their final names."""
        self._writer.close()
        _sync(self._stream)
        for video in self.videos.values():
            video.close()
        for kind, struct in SIDECARS.items():
            tables = [record_schema(struct).empty_table(), *self.sidecars[kind]]
            self._write(f"h3/{kind}", pa.concat_tables(tables).combine_chunks())
        metadata = {"h3data.schema_version": self.schema.version, "h3data.moments": pack_moments(self.moments)}
        # in the metadata of the table, because what is not committed with the episodes could differ from them
        columns = episode_schema(self.schema).with_metadata(metadata)
        table = dict(self._stats(columns))
        rows = [{**self._no_video, **row} for row in self.rows]
        facts = pa.Table.from_pylist(rows, schema=pa.schema([field for field in columns if field.name not in table]))
        table |= dict(zip(facts.column_names, facts.columns, strict=True))
        self._write("meta/episodes", pa.Table.from_arrays([table[name] for name in columns.names], schema=columns))
        for part, final in self.parts:  # the episode table is the last: its name is the commit
            os.replace(part, final)

    def discard(self) -> None:
        """Close and delete all files."""
        with contextlib.suppress(Exception):  # the disk may be full; nothing of this file is wanted
            self._writer.close()
        with contextlib.suppress(OSError):
            self._stream.close()
        for video in self.videos.values():
            video.discard()
        for part, _ in self.parts:
            part.unlink(missing_ok=True)

    def _stats(self, columns: pa.Schema) -> Iterator[tuple[str, pa.Array]]:
        """Yield LeRobot's statistics of each feature as columns of the episode table, null for episodes without steps."""
        lengths = np.array([row["length"] for row in self.rows])
        ends, empty = np.cumsum([0, *(lengths > 0)]), pa.array((lengths == 0).tolist())
        # all episodes at once: of single values there are some thousand in each
        for name in self._arrow.names if self.stats else ():
            found = {**finite_stats([moments[name] for moments in self.stats]), "count": lengths[lengths > 0, None]}
            for statistic, values in found.items():
                field, width = f"stats/{name}/{statistic}", values.shape[1]
                stored = values.astype(columns.field(field).type.value_type.to_pandas_dtype()).reshape(-1, 1)
                starts = to_arrow((ends * width).astype(np.int32)[:, None])
                yield field, pa.ListArray.from_arrays(starts, to_arrow(stored), mask=empty)

    def _add_video(self, key: str, video: EpisodeVideo) -> dict[str, Any]:
        """Append an episode's video; return its place and statistics as columns of the episode table."""
        if key not in self.videos:
            part = self._claim(shard_path(self.root, f"videos/{key}", self.number).with_suffix(".mp4"))
            self.videos[key] = VideoAppender(part)
        start, fps = self.videos[key].frames, self.schema.fps
        place = _video_place(key, self.number, start / fps, (start + video.length) / fps)
        self.videos[key].add(video)
        merge_into(self.moments, {key: video.moments})
        stats = lerobot_stats(video.moments, video.length, (3, 1, 1))
        return place | {f"stats/{key}/{name}": values for name, values in stats.items()}

    @property
    def _no_video(self) -> dict[str, Any]:
        """Columns of an episode without steps. LeRobot looks for its video files too, so they are some that exist."""
        number = self.number if self.videos else self.video_number
        return {k: v for video in self.schema.videos for k, v in _video_place(video.key, number, 0.0, 0.0).items()}

    def _open(self, kind: str) -> IO[bytes]:
        final = shard_path(self.root, kind, self.number)
        stream = open_shard_file(part := self._part_of(final))
        self.parts.append((part, final))
        return stream

    def _claim(self, final: Path) -> Path:
        """Return the temporary name of a file, to be renamed at the commit."""
        part = self._part_of(final)
        self.parts.append((part, final))
        return part

    @staticmethod
    def _part_of(final: Path) -> Path:
        final.parent.mkdir(parents=True, exist_ok=True)
        return final.with_name(f"_{final.name}.part")  # readers of whole folders skip names with an underscore

    def _write(self, kind: str, table: pa.Table) -> None:
        with self._open(kind) as stream:
            # of the few rows of an episode table, dictionaries and statistics take as much time and space as the values
            facts = kind == "meta/episodes"
            options: dict[str, Any] = {
                "use_dictionary": not facts,
                "write_statistics": not facts,
                "store_schema": not facts,
            }
            with pq.ParquetWriter(
                stream, table.schema, compression="zstd", write_page_checksum=True, **options
            ) as writer:
                writer.write_table(table)
                if facts:
                    writer.add_key_value_metadata(
                        {k.decode(): v.decode() for k, v in (table.schema.metadata or {}).items()}
                    )
            _sync(stream)

    def _parquet_options(self) -> dict[str, Any]:
        """Return the options of Parquet files: zstd, no dictionaries, BYTE_STREAM_SPLIT on floats.

        Files take 436 B/step instead of 733 with pyarrow's defaults. Poses and actions stay PLAIN because they have
        long runs of equal rows: a base pose takes 13.4 B/step instead of 14.9 split, 20 objects 7.5 instead of 9.9;
        joint rotations take 790 plain, 700 split. Pages are as large as an episode's column, so that each of the four
        byte streams is compressed in one piece: a looping clip takes 15 B/step instead of 30 with pages of 1 MiB.
        The widest columns are compressed at level 2, because level 6 takes twice the time for 0.9 % less. So are actions,
        which level 6 does not make smaller.
        """
        encodings, levels = {}, {}
        standard = [Column(name, dtype, ()) for name, dtype in STANDARD.items()]
        for c in (*standard, *self.schema.columns):
            path = c.name if c.width == 1 else f"{c.name}.list.element"
            levels[path] = FAST_LEVEL if c.name.endswith(("object_pose", ".action")) else ZSTD_LEVEL
            if c.name.endswith(("_pose", ".action")):
                encodings[path] = "PLAIN"
            elif c.dtype in ("float32", "float64"):
                encodings[path], levels[path] = "BYTE_STREAM_SPLIT", FAST_LEVEL
            elif stored_dtype(c) in ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32"):
                encodings[path] = "DELTA_BINARY_PACKED"
        return {
            "compression": "zstd",
            "compression_level": levels,
            "data_page_size": PAGE_BYTES,
            "use_dictionary": False,
            "column_encoding": encodings,
            "write_statistics": ["episode_index", "index", "frame_index", "task_index", "time_ns"],
            "write_page_checksum": True,
        }


def open_shard_file(part: Path) -> IO[bytes]:
    """Return a new file under its temporary name; tests replace this by disks that fill up."""
    # must not exist: a second writer is noticed here, before it has destroyed anything
    return open(part, "xb")


def _video_place(key: str, number: int, start_s: float, end_s: float) -> dict[str, Any]:
    """Return the video file of an episode and its stretch in it [s], as columns of the episode table."""
    chunk, file = divmod(number, FILES_PER_CHUNK)
    place = {"chunk_index": chunk, "file_index": file, "from_timestamp": start_s, "to_timestamp": end_s}
    return {f"videos/{key}/{name}": value for name, value in place.items()}


def _sync(stream: IO[bytes]) -> None:
    stream.flush()
    os.fsync(stream.fileno())
    stream.close()


def _record_table(kind: str, records: list[dict[str, Any]], index: int) -> pa.Table:
    """Return the records of episode ``index``; raise an `InputError` if a value cannot be stored."""
    rows = [{"episode_index": index, **record} for record in records]
    try:
        return pa.Table.from_pylist(rows, schema=record_schema(SIDECARS[kind]))
    except (OverflowError, UnicodeEncodeError, pa.ArrowException) as error:
        raise InputError(
            f"The {kind} of episode {index}: a value cannot be stored ({error}).", code="H3-RECORDING-075"
        ) from None
