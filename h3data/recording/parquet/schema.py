"""Schemas of the files of a dataset: the declared columns of its steps, its records and its episode tables."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Self

import numpy as np
import pyarrow as pa

from h3data.errors import FormatError, InputError
from h3data.recording.parquet.moments import STATISTICS
from h3data.recording.parquet.videos import VideoFeature
from h3data.recording.records import SCHEMA_VERSION
from h3data.recording.schema import (
    CONVENTIONS,
    STRUCTS,
    Column,
    Layout,
    check_version,
    layout_from_json,
    layout_hash,
)
from h3data.recording.storage import AnyPath

STANDARD = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""Columns that LeRobot requires in every data file."""

SIDECARS = {
    "bodies": "Body",
    "assets": "Asset",
    "agents": "Agent",
    "skills": "Skill",
    "events": "Event",
    "inputs": "Input",
}
"""Names of the tables of records next to the data files (sidecars), with the struct that each contains."""

EPISODE_SCHEMA = pa.schema(
    [
        ("episode_index", pa.int64()),
        ("tasks", pa.list_(pa.string())),
        ("length", pa.int64()),
        ("data/chunk_index", pa.int64()),
        ("data/file_index", pa.int64()),
        ("dataset_from_index", pa.int64()),
        ("dataset_to_index", pa.int64()),
        ("meta/episodes/chunk_index", pa.int64()),
        ("meta/episodes/file_index", pa.int64()),
        ("uid", pa.string()),
        ("episode_id", pa.string()),
        ("task", pa.string()),
        ("scene", pa.string()),
        ("seed", pa.int64()),
        ("dt_ns", pa.int64()),
        ("task_index", pa.int64()),
        ("created_by", pa.string()),
        ("schema_version", pa.string()),
        ("info", pa.string()),
        ("row_group", pa.int64()),
        ("columns", pa.string()),
        ("attachments", pa.string()),
    ]
)


def stored_dtype(column: Column) -> str:
    """Return the dtype of a column in the data files, which stores uint64 values as int64 with the same bits.

    Torch tensors hold no uint64, so LeRobot's loader would refuse the whole dataset.
    """
    return "int64" if column.dtype == "uint64" else column.dtype


@dataclass(frozen=True, kw_only=True)
class DatasetSchema:
    """Columns of every data file of a dataset, fixed before the first one is written."""

    columns: Layout
    """Widest shape of each column over all episodes."""
    fps: int
    robot_type: str
    version: str = SCHEMA_VERSION
    """Schema version of the whole dataset, also of files added to it later."""
    videos: tuple[VideoFeature, ...] = ()
    """Cameras of which every episode has a video."""
    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Names of the components of each column, by column, as an export to LeRobot writes them."""
    episode_stats: bool = True
    """True if the episode tables have LeRobot's statistics of every feature. Older datasets have only those of the
    videos."""

    def to_json(self) -> bytes:
        """Return contents of ``h3/schema.json``."""
        values: dict[str, Any] = {
            "schema_version": self.version,
            "layout_hash": layout_hash(self.columns),
            "fps": self.fps,
            "robot_type": self.robot_type,
            "conventions": CONVENTIONS,
            "columns": [{"name": c.name, "dtype": c.dtype, "shape": list(c.shape)} for c in self.columns],
        }
        more = {
            "videos": [asdict(video) for video in self.videos],
            "names": dict(self.names),
            "episode_stats": self.episode_stats,
        }
        values |= {name: value for name, value in more.items() if value}
        return json.dumps(values, indent=1, ensure_ascii=False).encode()

    @classmethod
    def load(cls, root: AnyPath) -> Self:
        """Return the schema of an existing dataset.

        Raises:
            FormatError: the schema is missing or damaged, or written by a newer version of h3data.
        """
        path = root / "h3" / "schema.json"
        try:
            values = json.loads(path.read_bytes())
            check_version(values["schema_version"], path=path)
            # through the same reader as logs, so that damaged columns are refused by the same rules
            text = json.dumps([[c["name"], c["dtype"], c["shape"]] for c in values["columns"]], ensure_ascii=False)
            return cls(
                columns=layout_from_json(text),
                fps=int(values["fps"]),
                robot_type=str(values["robot_type"]),
                version=values["schema_version"],
                videos=tuple(VideoFeature(**video) for video in values.get("videos", ())),
                names={str(name): tuple(map(str, each)) for name, each in dict(values.get("names", {})).items()},
                episode_stats=values.get("episode_stats") is True,
            )
        except FileNotFoundError:
            raise FormatError(
                f"Expected a dataset of h3data, there is no {path.name}: {path}", code="H3-RECORDING-073"
            ) from None
        except (OSError, KeyError, ValueError, TypeError, OverflowError, RecursionError) as error:
            raise FormatError(
                f"The schema of the dataset is damaged ({error!r}): {path}", code="H3-RECORDING-074"
            ) from error


def union_layout(layouts: Iterable[Layout], *, max_bodies: int | None = None) -> Layout:
    """Return the narrowest layout that fits all given layouts; ``max_bodies`` widens ``object_pose``.

    Raises:
        InputError: columns of one name differ in dtype or number of axes.
    """
    union: dict[str, Column] = {}
    faults = []
    for layout in layouts:
        for column in layout:
            widest = union.setdefault(column.name, column)
            # shapes may be padded, but another type would change values and another number of axes their
            # meaning
            if widest.dtype != column.dtype or len(widest.shape) != len(column.shape):
                faults.append(f"{widest} and {column}")
            else:
                shape = tuple(max(a, b) for a, b in zip(widest.shape, column.shape, strict=True))
                union[column.name] = Column(column.name, column.dtype, shape)
    if faults:
        raise InputError(f"These columns cannot share a dataset: {'; '.join(faults[:8])}.", code="H3-RECORDING-072")
    # the fullest home may come later, and columns cannot grow once a file is written
    if max_bodies is not None:
        poses = union.get("object_pose", Column("object_pose", "float32", (0, 7)))
        union["object_pose"] = Column("object_pose", poses.dtype, (max(max_bodies, poses.shape[0]), *poses.shape[1:]))
    return tuple(union.values())


def data_schema(schema: DatasetSchema) -> pa.Schema:
    """Return the Arrow schema of the data files: LeRobot's columns, then h3data's columns with a width above 0."""
    fields = [pa.field(name, arrow_rows(dtype, 1)) for name, dtype in STANDARD.items()]
    fields += [pa.field(c.name, arrow_rows(stored_dtype(c), c.width)) for c in schema.columns if c.width]
    return pa.schema(
        fields, metadata={"h3data.schema_version": schema.version, "h3data.layout_hash": layout_hash(schema.columns)}
    )


def episode_schema(schema: DatasetSchema) -> pa.Schema:
    """Return the Arrow schema of the episode tables: `EPISODE_SCHEMA`, the video files of every camera, and statistics."""
    fields = list(EPISODE_SCHEMA)
    channels = pa.list_(pa.list_(pa.list_(pa.float64())))
    for video in schema.videos:
        at, stats = f"videos/{video.key}", f"stats/{video.key}"
        fields += [pa.field(f"{at}/{name}", pa.int64()) for name in ("chunk_index", "file_index")]
        fields += [pa.field(f"{at}/{name}", pa.float64()) for name in ("from_timestamp", "to_timestamp")]
        # older datasets go on with the columns that they began with: all files of one need the same
        names = STATISTICS if schema.episode_stats else ("min", "max", "mean", "std")
        fields += [pa.field(f"{stats}/{name}", channels) for name in names]
        fields.append(pa.field(f"{stats}/count", pa.list_(pa.int64())))
    stored = STANDARD | {c.name: stored_dtype(c) for c in schema.columns if c.width}
    for name, dtype in stored.items() if schema.episode_stats else ():
        # float32 where the column has it: the extremes are exact, and half as large
        numbers = pa.list_(pa.float32() if dtype == "float32" else pa.float64())
        fields += [pa.field(f"stats/{name}/{statistic}", numbers) for statistic in STATISTICS]
        fields.append(pa.field(f"stats/{name}/count", pa.list_(pa.int64())))
    return pa.schema(fields)


def record_schema(struct: str) -> pa.Schema:
    """Return the Arrow schema of a sidecar: the fields of one of `STRUCTS` and the episode they belong to."""
    arrow = {"string": pa.string(), "int64": pa.int64(), "double": pa.float64(), "float": pa.float32()}
    kinds = {name: (arrow[spec.rstrip("*")], spec.endswith("*")) for name, spec in STRUCTS[struct].items()}
    fields = [(name, pa.list_(kind) if many else kind) for name, (kind, many) in kinds.items()]
    return pa.schema([("episode_index", pa.int64()), *fields])


def arrow_rows(dtype: str, width: int) -> pa.DataType:
    """Return the Arrow type of one row of a column: a scalar, or a fixed-size list if the width is not 1."""
    item = pa.from_numpy_dtype(np.dtype(dtype))
    # as LeRobot stores a feature of one number
    return item if width == 1 else pa.list_(item, width)
