"""Parquet datasets, whose episodes are read as recordings, columns or tables; only requested columns are read."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, overload

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from h3data.errors import InputError, suggest
from h3data.recording.episodes import Episodes, HasEpisodes, StoredEpisode
from h3data.recording.parquet import tables
from h3data.recording.parquet.columns import to_numpy
from h3data.recording.parquet.folder import DatasetFolder
from h3data.recording.parquet.records import DAMAGE
from h3data.recording.parquet.schema import SIDECARS
from h3data.recording.parquet.videos import EpisodeVideo, episode_video
from h3data.recording.records import Recording, notebook
from h3data.recording.schema import Layout, episode_from_dict, layout_from_json, required_columns
from h3data.recording.steps import Steps
from h3data.recording.storage import RemotePath

if TYPE_CHECKING:
    import pandas
    import polars
    import torch


class Dataset(DatasetFolder):
    """Episodes of a dataset folder, read on demand.

    A dataset can be opened while another process adds episodes.
    """

    def __init__(self, root: str | os.PathLike[str] | RemotePath) -> None:
        """Open a folder written by `DatasetWriter`, by path or URI (``s3://bucket/ds``)."""
        super().__init__(root)
        self._declared = {c.name: c for c in self.schema.columns}

    @overload
    def __getitem__(self, index: int) -> Recording: ...
    @overload
    def __getitem__(self, index: slice) -> Episodes: ...
    def __getitem__(self, index: int | slice) -> Recording | Episodes:
        """Return episode ``index`` as `recording` does, or for a slice the `Episodes`, which are read when needed."""
        if isinstance(index, slice):
            return self.all()[index]
        # integers of numpy are numbers of episodes too
        if not hasattr(index, "__index__"):
            raise InputError(
                f"Expected the number of an episode or a slice, got {index!r:.60}.", code="H3-RECORDING-057"
            )
        if not -len(self) <= index < len(self):
            raise IndexError(f"The dataset has {len(self)} episodes, there is no {index}.")  # also ends a for loop
        return self.recording(index % len(self))

    def __iter__(self) -> Iterator[Recording]:
        return (self.recording(index) for index in range(len(self)))

    def all(self) -> Episodes:
        """Return all episodes, for `Episodes.filter`, `Episodes.split` and `Episodes.merge`."""
        return Episodes(
            # partials and not lambdas: jobs send episodes to other processes, and lambdas cannot be pickled
            StoredEpisode(
                f"{self.root}#{k}",
                self.root,
                partial(self.recording, k),
                partial(self.row, k),
                index=k,
                read_videos=partial(self.videos, k),
                read_together=self.recordings,
            )
            for k in range(len(self))
        )

    def filter(self, keep: Callable[[Mapping[str, Any]], bool] | None = None, **equal: Any) -> Episodes:
        """Return the episodes whose facts match a function or given values, as `Episodes.filter` does.

        Examples: ``ds.filter(policy="rollout_expert")``, ``ds.filter(lambda f: f["length"] > 300)``.
        """
        return self.all().filter(keep, **equal)

    def split(self, *shares: float, seed: int = 0, by: str = "uid") -> tuple[Episodes, ...]:
        """Split the episodes at random, as `Episodes.split` does: ``train, test = ds.split(0.8, by="scene")``."""
        return self.all().split(*shares, seed=seed, by=by)

    def merge(self, *others: HasEpisodes) -> Episodes:
        """Return the episodes of this dataset followed by those of others: ``ds.merge(other).save("both/")``."""
        return self.all().merge(*others)

    def recording(
        self, index: int, *, columns: Sequence[str] | None = None, records: Sequence[str] | None = None
    ) -> Recording:
        """Return episode ``index``, exactly as it was added, or only parts of it.

        ``columns`` restricts it to these columns and the required ones. ``records`` restricts it to some kinds of
        records (``bodies``, ``assets``, ``agents``, ``skills``, ``events``, ``inputs``) and omits attachments. Metrics
        need only ``agents``. One row group is read.
        """
        self.row(index)
        return next(self.recordings(range(index, index + 1), columns=columns, records=records))

    def recordings(
        self, indices: range, *, columns: Sequence[str] | None = None, records: Sequence[str] | None = None
    ) -> Iterator[Recording]:
        """Yield consecutive episodes as recordings, which are read together and therefore faster than one by one.

        All of them are held in memory; their columns are views of shared arrays.
        """
        kinds = [kind for kind in SIDECARS if records is None or kind in records]
        self._require_columns(columns or ())
        # one read for all episodes of a shard, instead of one for each
        for group in self._groups(indices):
            rows = [self.row(index) for index in group]
            shard = self.shard_of(rows[0])
            sidecars = {kind: self._records.of_episodes(kind, shard, group) for kind in kinds}
            names = None
            if columns is not None or records is not None:
                agents = max(map(len, sidecars.get("agents", [()])))
                # without all records the columns must be named, because those that a record describes are
                # left out with it
                names = {*(self._declared if columns is None else columns), *required_columns(agents)}
                if "bodies" not in kinds:
                    # poses of bodies that were not read would fit no body
                    names.discard("object_pose")
            for k, (row, arrays) in enumerate(zip(rows, self._read(group, names), strict=True)):
                yield Recording(
                    episode=episode_from_dict(row, path=self.root),
                    columns=arrays,
                    attachments=self._records.attachments(row) if records is None else {},
                    **{kind: by_episode[k] for kind, by_episode in sidecars.items()},
                )

    def with_columns(self, index: int, columns: Mapping[str, NDArray[Any]]) -> Recording:
        """Return episode ``index`` with its records and attachments, and with given arrays instead of its columns."""
        row, one = self.row(index), range(index, index + 1)
        return Recording(
            episode=episode_from_dict(row, path=self.root),
            columns=columns,
            attachments=self._records.attachments(row),
            **{kind: self._records.of_episodes(kind, self.shard_of(row), one)[0] for kind in SIDECARS},
        )

    def iter_columns(
        self, columns: Sequence[str], *, episodes: Iterable[int] | None = None
    ) -> Iterator[tuple[int, dict[str, NDArray[Any]]]]:
        """Yield ``(index, {column: array [T, ...]})`` of each episode, in constant memory; only these columns are read.

        If an episode lacks a column, its dict lacks it too. Metrics are computed with this method.
        """
        self._require_columns(columns)
        for index in range(len(self)) if episodes is None else episodes:
            yield index, self._read(range(index, index + 1), columns)[0]

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras that have videos of the episodes."""
        return tuple(video.camera for video in self.schema.videos)

    def video(self, index: int, camera: str) -> EpisodeVideo:
        """Return the video of a camera in episode ``index``, with one frame for each step; `EpisodeVideo.frames` decodes it.

        Raises:
            InputError: there is no such episode or camera, or the episode has no steps.
            FormatError: the episode table is damaged.
        """
        row = self.row(index)
        feature = next((video for video in self.schema.videos if video.camera == camera), None)
        if feature is None or not row["length"]:
            has = ", ".join(self.cameras) or "none"
            what = f"no video of camera {camera!r}" if feature is None else "no steps"
            raise InputError(
                f"Episode {index} has {what}. The dataset has videos of: {has}: {self.root}", code="H3-RECORDING-058"
            )
        return episode_video(self.root, row, feature, fps=self.schema.fps)

    def videos(self, index: int) -> list[EpisodeVideo]:
        """Return the videos of episode ``index`` from all `cameras`; none if the episode has no steps."""
        return [self.video(index, camera) for camera in self.cameras if self.row(index)["length"]]

    def layout(self, index: int) -> Layout:
        """Return the columns of one episode with their own shapes, which may be narrower than those of the dataset."""
        return _layout(self.row(index)["columns"])

    def to_numpy(self, index: int, stored: Mapping[str, pa.ChunkedArray], rows: int) -> dict[str, NDArray[Any]]:
        """Return stored columns of episode ``index`` (from `read_group`), ``rows`` long, in their own shapes.

        Columns of width 0 are not stored, but the result contains them.
        """
        try:
            return {
                c.name: to_numpy(stored.get(c.name), c, self._declared[c.name], rows)
                for c in self.layout(index)
                if c.name in stored or not c.width
            }
        except DAMAGE as error:
            raise self._damage([index], error) from error

    def _repr_html_(self) -> str:
        return notebook().episodes_html(self.all(), f"Dataset {self.root}")

    def __repr__(self) -> str:
        frames = self.rows[-1]["dataset_to_index"] if self.rows else 0
        tasks = ", ".join(sorted({row["task"] for row in self.rows})) or "none"
        lines = [f"Dataset {str(self.root)!r}: {len(self)} episodes, {frames} steps, tasks: {tasks}"]
        lines += [f"  {v.key:<24} video    [T, {v.height}, {v.width}, 3]" for v in self.schema.videos]
        lines += [f"  {c.name:<24} {c.dtype:<8} {['T', *c.shape]}".replace("'T'", "T") for c in self.schema.columns]
        return "\n".join(lines)

    # --- as tables ------------------------------------------------------------------------------------------------
    def to_arrow(self, columns: Sequence[str] | None = None, *, episodes: Iterable[int] | None = None) -> pa.Table:
        """Return the steps of ``episodes`` (default: all) as one table of ``columns`` (default: all, including LeRobot's).

        Values have their stored form: a vector is a fixed-size list of the declared width, and narrower episodes are
        padded. The table is held in memory; for larger data use `iter_columns` or ``h3data sql``.

        Raises:
            InputError: there is no such column or episode.
            FormatError: the data are damaged.
        """
        return tables.to_arrow(self, columns=columns, episodes=episodes)

    def to_polars(
        self, columns: Sequence[str] | None = None, *, episodes: Iterable[int] | None = None
    ) -> polars.DataFrame:
        """Return `to_arrow` as a polars frame in the same memory. Needs ``pip install "h3data[frames]"``."""
        return tables.to_polars(self.to_arrow(columns, episodes=episodes))

    def to_pandas(
        self, columns: Sequence[str] | None = None, *, episodes: Iterable[int] | None = None
    ) -> pandas.DataFrame:
        """Return `to_arrow` as a pandas frame; vectors stay Arrow lists. Needs ``pip install "h3data[frames]"``."""
        return tables.to_pandas(self.to_arrow(columns, episodes=episodes))

    def to_torch(
        self, columns: Sequence[str] | None = None, *, episodes: Iterable[int] | None = None
    ) -> dict[str, torch.Tensor]:
        """Return `to_arrow` as tensors [T, *declared shape] on the CPU; without a copy if it is one episode."""
        return tables.to_torch(self.to_arrow(columns, episodes=episodes), tables.shapes_of(self))

    # --- private --------------------------------------------------------------------------------------------------
    def _require_columns(self, columns: Sequence[str]) -> None:
        unknown = sorted(set(columns) - set(self._declared))
        if unknown:
            near = suggest(unknown[0], self._declared, lead="It has")
            raise InputError(
                f"No columns {unknown} in this dataset.{near} Dataset: {self.root}", code="H3-RECORDING-059"
            )

    def _groups(self, indices: range) -> Iterator[range]:
        """Yield runs of episodes of one shard with the same columns, which one read can return."""
        start = indices.start
        for index in indices[1:]:
            before, row = self.row(index - 1), self.row(index)
            if self.shard_of(before) != self.shard_of(row) or before["columns"] != row["columns"]:
                yield range(start, index)
                start = index
        if len(indices):
            yield range(start, indices.stop)

    def _read(self, group: range, names: Iterable[str] | None) -> list[dict[str, NDArray[Any]]]:
        """Return the columns of each episode of one group."""
        rows = [self.row(index) for index in group]
        wanted = None if names is None else set(names)
        layout = [c for c in self.layout(group[0]) if wanted is None or c.name in wanted]
        ends = np.cumsum([row["length"] for row in rows])
        steps, stored = int(ends[-1]), [c.name for c in layout if c.width]
        # episodes without steps have no row group
        if not steps or not stored:
            return [{c.name: c.empty(row["length"]) for c in layout} for row in rows]
        try:
            table = self.read_group(group, stored)
            whole = {
                c.name: to_numpy(table[c.name] if c.width else None, c, self._declared[c.name], steps) for c in layout
            }
        except DAMAGE as error:
            raise self._damage(group, error) from error
        return [
            # views of one array: to copy each episode would double what is held
            {name: array[end - row["length"] : end] for name, array in whole.items()}
            for row, end in zip(rows, ends, strict=True)
        ]


@lru_cache(maxsize=64)
def _layout(text: str) -> Layout:
    return layout_from_json(text)


class DatasetSteps(Steps):
    """Steps of one episode of a dataset; columns that were read are cached as Arrow data."""

    def __init__(self, dataset: Dataset, index: int) -> None:
        self.dataset, self.index = dataset, index
        self.layout = dataset.layout(index)  # an InputError if there is no such episode
        self._length: int = dataset.rows[index]["length"]
        self._kept: dict[str, pa.ChunkedArray] = {}

    def __len__(self) -> int:
        return self._length

    def close(self) -> None:
        """Drop the columns read so far from memory."""
        self._kept.clear()

    def _rows(self, start: int, stop: int, names: list[str]) -> dict[str, NDArray[Any]]:
        if start == stop:
            return {c.name: c.empty() for c in self.layout if c.name in names}
        # whole columns, because Parquet reads no less than a row group; steps are then slices without a copy
        unread = [c.name for c in self.layout if c.width and c.name in names and c.name not in self._kept]
        if unread:
            table = self.dataset.read_group([self.index], unread)
            self._kept |= {name: table[name] for name in unread}
        stored = {name: array.slice(start, stop - start) for name, array in self._kept.items() if name in names}
        columns = self.dataset.to_numpy(self.index, stored, stop - start)
        return {name: columns[name] for name in names}

    def _recording(self, start: int, stop: int) -> Recording:
        return self.dataset.with_columns(self.index, self._rows(start, stop, [c.name for c in self.layout]))
