"""Crash-safe writer of Parquet datasets in the layout of LeRobot v3.0, with a row per step and a row group per episode.

Episodes are gathered in *shards* of about 100. A shard is a data file, its sidecars (``h3/bodies``, ``h3/skills``, ...)
and an episode table. All are written under temporary names and renamed when complete, the episode table last: its
presence is the commit, and readers ignore episodes that no table lists.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tempfile
import uuid
import weakref
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

import pyarrow as pa

from h3data.errors import InputError
from h3data.recording.file_store import FileStore
from h3data.recording.parquet.files import is_begun, is_dataset, shard_files, shard_number, write_atomic
from h3data.recording.parquet.lerobot import FILE_MB, Totals, write_meta
from h3data.recording.parquet.moments import merge_into
from h3data.recording.parquet.schema import SIDECARS, STANDARD, DatasetSchema, union_layout
from h3data.recording.parquet.shard import Shard
from h3data.recording.parquet.videos import MAX_FILE_BYTES, MAX_FILE_S, EpisodeVideo, VideoFeature
from h3data.recording.records import Recording
from h3data.recording.schema import Layout, episode_to_dict, layout_of, layout_to_json, struct_to_dict
from h3data.recording.storage import RemotePath, place, put_tree, remove_tree

_WRITER = "h3/writer"
"""Name of the file that identifies the process writing a dataset in an object store; deleted when the dataset is
closed."""


class DatasetWriter:
    """Writer of recordings into a dataset folder.

    The columns of a dataset are determined by its first episode, by ``like`` (recordings whose columns must fit too)
    and by ``max_bodies`` (largest number of moving bodies). Later episodes may be narrower or lack columns: they are
    padded, and read back exactly. They must not be wider. All have ``fps`` steps per second; with ``nominal_fps`` they
    may have other rates, and LeRobot's ``timestamp`` is then nominal (``time_ns`` is always the true time). As a
    context manager it commits all completely added episodes, also on an exception or Ctrl-C. Only one writer per folder
    may be active at a time.

    The root may be a URI (``s3://bucket/ds``). Each shard is then made in a temporary folder and uploaded when it is
    committed, its episode table last. If two writers are active, the first one fails at its next commit, before it
    uploads anything, because the file ``h3/writer`` names the last one.
    """

    def __init__(
        self,
        root: str | os.PathLike[str] | RemotePath,
        *,
        fps: int = 30,
        nominal_fps: bool = False,
        overwrite: bool = False,
        resume: bool = False,
        max_bodies: int | None = None,
        like: Iterable[Recording] = (),
        episodes_per_file: int = 100,
        file_bytes: int = FILE_MB << 20,
    ) -> None:
        """Open a new folder, replace the dataset in it (``overwrite``), or continue after its last commit (``resume``).

        Raises:
            InputError: the folder holds anything else, or a dataset without either option.
        """
        self.root = place(root)
        self._local_root = self.root if isinstance(self.root, Path) else Path(tempfile.mkdtemp(prefix="h3data-"))
        """Folder where a shard's files are made: the dataset itself, or a temporary one until they are uploaded."""
        self._name = uuid.uuid4().hex
        if isinstance(self.root, RemotePath):
            # also where nobody closes the writer
            weakref.finalize(self, shutil.rmtree, self._local_root, ignore_errors=True)
        self.closed = False
        self._fps, self._nominal_fps, self._max_bodies = fps, nominal_fps, max_bodies
        self._episodes_per_file, self._file_bytes = episodes_per_file, file_bytes
        self._totals, self._shard_index, self._video_number = Totals(), 0, 0
        self._files = FileStore(self.root / "h3" / "files")
        self._schema: DatasetSchema | None = None
        self._shard: Shard | None = None
        if overwrite and resume:
            raise InputError("Choose one: overwrite=True starts anew, resume=True continues.", code="H3-RECORDING-092")
        with self._writing():
            self._open_root(overwrite=overwrite, resume=resume)
            if self._schema is None:
                self._declare(like)

    def __len__(self) -> int:
        """Return the number of episodes, including those not yet committed: the index of the next one."""
        return self._totals.episodes + (self._shard.episodes if self._shard else 0)

    def add(self, recording: Recording, *, videos: Sequence[EpisodeVideo] = ()) -> int:
        """Append one episode and return its index.

        The episode survives a crash after the next commit.

        ``videos`` have a frame for each step. They must be from the same cameras in all episodes that have steps, and
        are copied.

        Raises:
            InputError: the episode or its videos do not fit the dataset.
        """
        if self.closed:
            raise InputError(f"This dataset writer is closed: {self.root}", code="H3-RECORDING-093")
        with self._writing():
            if self._schema is None:
                self._declare([recording])
            assert self._schema is not None
            layout = _checked_layout(recording, self._schema, any_rate=self._nominal_fps)
            by_key = self._checked_videos(recording, videos)
            # before the episode, not after it: no episode may lie in two video files
            if self._shard and self._shard.video_frames + len(recording) > MAX_FILE_S * self._fps_of_schema:
                self.commit()
            # everything that can be refused comes before the first byte, so that the shard is not spoiled by
            # it
            row = {**episode_to_dict(recording.episode), "columns": layout_to_json(layout)}
            try:
                for value in row.values():
                    pa.scalar(value)
            except (OverflowError, UnicodeEncodeError, pa.ArrowException) as error:
                raise InputError(
                    f"Episode {recording.episode.episode_id!r}: a value cannot be stored ({error}).",
                    code="H3-RECORDING-101",
                ) from None
            attachments = {name: self._files.put(name, data) for name, data in recording.attachments.items()}
            row["attachments"] = json.dumps(attachments, ensure_ascii=False)
            sidecars = {kind: [struct_to_dict(r) for r in getattr(recording, kind)] for kind in SIDECARS}
            index, start = len(self), self._totals.frames + (self._shard.frames if self._shard else 0)
            told = recording.episode.info.get("instruction")
            # the task in words is what LeRobot's policies read; its name is better than nothing
            told = told if isinstance(told, str) and told else recording.episode.task
            task = self._totals.tasks.setdefault(told, len(self._totals.tasks))
            if self._shard is None:
                self._shard = Shard(self._local_root, self._shard_index, self._schema, video_number=self._video_number)
            try:
                self._shard.add(
                    recording, row, sidecars, videos=by_key, index=index, start=start, task=task, instruction=told
                )
            except BaseException:
                if self._shard.spoiled:  # a half-written row group spoils its file: drop the shard
                    shard, self._shard = self._shard, None
                    shard.discard()
                raise
        full = self._shard.bytes >= self._file_bytes or self._shard.video_bytes >= MAX_FILE_BYTES
        if full or self._shard.episodes >= self._episodes_per_file:
            self.commit()
        return index

    def commit(self) -> None:
        """Finish the current files, so that all episodes added so far survive a crash."""
        if self._shard is None or self._schema is None:
            return
        shard, self._shard = self._shard, None
        with self._writing():
            try:
                shard.commit()
                if isinstance(self.root, RemotePath):
                    self._require_mine(self.root)
                    put_tree(self._local_root, self.root, last="meta/episodes")
            except BaseException:
                shard.discard()
                raise
            # LeRobot looks for a video file even for episodes without steps, so the last one is remembered
            self._video_number = self._shard_index if shard.videos else self._video_number
            # the number of a shard that failed is used again; its files were deleted
            self._shard_index += 1
            self._totals.episodes += shard.episodes
            self._totals.frames += shard.frames
            merge_into(self._totals.moments, shard.moments)
            # last: the totals only summarise, and can be made again if this fails
            write_meta(self.root, self._schema, self._totals)

    def close(self) -> None:
        """Commit and close the dataset. A second call does nothing."""
        if not self.closed:
            self.commit()
            self.closed = True
            if isinstance(self.root, RemotePath) and self._schema is not None:
                with self._writing():
                    self._require_mine(self.root)
                    (self.root / _WRITER).unlink()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"DatasetWriter({str(self.root)!r}, {len(self)} episodes, {self._totals.episodes} committed)"

    # --- private ---
    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except FileExistsError as error:
            raise InputError(
                f"Another process is writing this dataset: {error.filename}", code="H3-RECORDING-102"
            ) from None
        except OSError as error:
            raise InputError(
                f"Could not write the dataset: {error.strerror or error}. Episodes committed before are safe; continue with "
                f"resume=True: {self.root}",
                code="H3-RECORDING-103",
            ) from error

    def _open_root(self, *, overwrite: bool, resume: bool) -> None:
        root = self.root
        if root.exists() and not root.is_dir():
            raise InputError(f"Expected a folder for the dataset, this is a file: {root}", code="H3-RECORDING-094")
        if not root.exists() or not any(root.iterdir()):
            if isinstance(root, Path):
                root.mkdir(parents=True, exist_ok=True)
            return
        begun = is_begun(root)
        if not (begun or is_dataset(root)):
            raise InputError(
                f"The folder exists and is not a dataset of h3data; choose another one: {root}", code="H3-RECORDING-095"
            )
        if not (overwrite or resume):
            raise InputError(
                "The folder holds a dataset. resume=True goes on with it, overwrite=True replaces it; or choose another "
                f"folder: {root}",
                code="H3-RECORDING-096",
            )
        # a dataset without a commit has nothing to go on with
        if overwrite or begun:
            # the episode tables first: readers then find no episode whose files are gone already
            for folder in (root / "meta", root / "data", root / "h3", root / "videos"):
                remove_tree(folder)
        else:
            self._resume()

    def _claim(self) -> None:
        """Say in an object store, which has no other means, who writes."""
        if isinstance(self.root, RemotePath):
            (self.root / _WRITER).put(self._name.encode())

    def _require_mine(self, root: RemotePath) -> None:
        mark = root / _WRITER
        if not mark.is_file() or mark.read_bytes() != self._name.encode():
            raise InputError(
                f"Another process is writing this dataset; end one of them, go on with resume=True: {root}",
                code="H3-RECORDING-097",
            )

    def _resume(self) -> None:
        if not (self.root / "h3" / "schema.json").exists():
            raise InputError(
                f"A dataset, but not written by h3data; choose another folder: {self.root}", code="H3-RECORDING-098"
            )
        self._schema = DatasetSchema.load(self.root)
        self._claim()
        # a writer that was killed cannot come back to them
        for leftover in self.root.rglob("*.part"):
            leftover.unlink()
        # counted by episode tables, the commits: a data file alone says nothing
        committed = shard_files(self.root, "meta/episodes")
        self._shard_index = shard_number(committed[-1]) + 1 if committed else 0
        for kind in ("data", *(f"h3/{k}" for k in SIDECARS)):
            for path in shard_files(self.root, kind):
                if shard_number(path) >= self._shard_index:
                    path.unlink()  # renamed before the crash, never committed
        for path in self.root.glob("videos/*/chunk-*/file-*.mp4"):
            if shard_number(path) >= self._shard_index:
                path.unlink()
            else:
                self._video_number = max(self._video_number, shard_number(path))
        self._totals = Totals.of(self.root)

    def _checked_videos(self, recording: Recording, videos: Sequence[EpisodeVideo]) -> dict[str, EpisodeVideo]:
        """Return the videos of an episode by the keys of their features; the first ones are declared for the whole dataset."""
        assert self._schema is not None
        name, given = recording.episode.episode_id, tuple(video.feature for video in videos)
        taken = {*STANDARD, *(c.name for c in self._schema.columns)}
        for video in videos:
            feature = video.feature
            if "/" in feature.camera or feature.key in taken:
                raise InputError(
                    f"A LeRobot dataset cannot have a camera {feature.camera!r}. Rename it.", code="H3-RECORDING-104"
                )
            if (video.length, video.fps) != (len(recording), self._schema.fps):
                raise InputError(
                    f"Expected a video of {len(recording)} frames, {self._schema.fps} per second, for episode {name!r}, got "
                    f"{video.length} frames, {video.fps} per second: {video.path}",
                    code="H3-RECORDING-105",
                )
        frames = self._totals.frames + (self._shard.frames if self._shard else 0)
        # the cameras are not known before the first episode with steps is rendered
        if given and not self._schema.videos and not frames:
            self._schema = replace(self._schema, videos=given)
            write_atomic(self.root / "h3" / "schema.json", self._schema.to_json())
            if self._shard is not None:  # episodes without steps
                self._shard.schema = self._schema
        if len(recording) and set(given) != set(self._schema.videos):
            raise InputError(
                f"All episodes of a dataset have videos of the same cameras and sizes: expected "
                f"{_listed(self._schema.videos)}, episode {name!r} has {_listed(given)}.",
                code="H3-RECORDING-099",
            )
        return {video.feature.key: video for video in videos} if len(recording) else {}

    @property
    def _fps_of_schema(self) -> int:
        assert self._schema is not None
        return self._schema.fps

    def _declare(self, examples: Iterable[Recording]) -> None:
        """Fix the columns of the dataset so that all of these recordings fit; without any, do nothing."""
        layouts, robots, named = [], [], []
        for recording in examples:  # may be a generator: one recording in memory at a time
            layouts.append(layout_of(recording.columns))
            about = recording.episode.info.get("lerobot")
            told = about.get("names") if isinstance(about, dict) else None
            named.append(told if isinstance(told, dict) else {})
            robots += [a.model or a.name for a in recording.agents if a.kind == "robot"]
        if not layouts:
            return
        columns = union_layout(layouts, max_bodies=self._max_bodies)
        faults = [f"{c.name!r} contains '/'" for c in columns if "/" in c.name]
        faults += [f"{c.name!r} is reserved by LeRobot" for c in columns if c.name in STANDARD]
        if faults:
            raise InputError(
                f"Columns that a LeRobot dataset cannot have: {'; '.join(faults)}. Rename them.",
                code="H3-RECORDING-100",
            )
        widths = {c.name: c.width for c in columns}
        names = {
            name: tuple(each)
            for name, each in named[0].items()
            if isinstance(each, list)
            and widths.get(name) == len(each)
            and all(other.get(name) == each for other in named)
        }
        robot = robots[0] if robots else "none"
        schema = DatasetSchema(columns=columns, fps=self._fps, robot_type=robot, names=names)
        write_atomic(self.root / "h3" / "schema.json", schema.to_json())
        self._claim()
        self._schema = schema


def _listed(features: Sequence[VideoFeature]) -> str:
    return ", ".join(f"{v.camera} ({v.width}x{v.height})" for v in features) or "none"


def _checked_layout(recording: Recording, schema: DatasetSchema, *, any_rate: bool) -> Layout:
    """Return the layout of a recording; an `InputError` lists every reason why it does not fit the dataset."""
    layout = layout_of(recording.columns)
    declared = {c.name: c for c in schema.columns}
    faults = []
    for column in layout:
        widest = declared.get(column.name)
        if widest is None:
            faults.append(f"{column} is not a column of the dataset")
        elif widest.dtype != column.dtype or len(widest.shape) != len(column.shape):
            faults.append(f"{column}, the dataset has {widest}")
        elif any(n > m for n, m in zip(column.shape, widest.shape, strict=True)):
            faults.append(f"{column} is wider than {widest}")
    if faults:
        raise InputError(
            f"Episode {recording.episode.episode_id!r} does not fit this dataset: {'; '.join(faults[:8])}. "
            "Hint: declare the widest episodes before the first one, DatasetWriter(..., max_bodies=N, like=[recordings]), "
            "or write them to another dataset.",
            code="H3-RECORDING-090",
        )
    # ten milliseconds in a second: rates such as 29.97 count as 30
    if not any_rate and abs(recording.episode.dt_ns * schema.fps - 1_000_000_000) > 10_000_000:
        raise InputError(
            f"Episode {recording.episode.episode_id!r} has steps of {recording.episode.dt_ns} ns, the dataset "
            f"{schema.fps} per second. Hint: DatasetWriter(..., fps=N); or nominal_fps=True (h3data convert --nominal-fps N): "
            "LeRobot's time stamps are then nominal, time_ns stays exact.",
            code="H3-RECORDING-091",
        )
    return layout
