"""Command ``h3data sql``, which runs DuckDB queries over the steps, episodes and events of Parquet datasets."""

from __future__ import annotations

import io
import json
import math
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import pyarrow as pa
import tyro

from h3data.commands.command import ForceFlag, JsonFlag, Outcome, claim_file
from h3data.errors import InputError, MissingExtraError
from h3data.files import part_file
from h3data.recording.parquet.files import shard_path
from h3data.recording.parquet.folder import DatasetFolder
from h3data.recording.parquet.schema import SIDECARS, data_schema, record_schema
from h3data.recording.storage import RemotePath

if TYPE_CHECKING:
    import duckdb
    import pyarrow.dataset as pads

    from h3data.recording import Dataset

_ROWS = 40
"""Largest number of rows shown as text: the first ones, and the last of the first 10,000."""
_RECORDS = ("events", "skills", "agents", "bodies", "inputs")
_TEXT, _WHOLE, _REAL = pa.string(), pa.int64(), pa.float64()
_EPISODES = pa.schema(
    [
        ("dataset", _TEXT),
        ("episode_index", _WHOLE),
        ("episode_id", _TEXT),
        ("uid", _TEXT),
        ("task", _TEXT),
        ("scene", _TEXT),
        ("seed", _WHOLE),
        ("policy", _TEXT),
        ("partner", _TEXT),
        ("length", _WHOLE),
        ("seconds", _REAL),
        ("created_by", _TEXT),
        ("info", _TEXT),
    ]
)
"""Columns of the view ``episodes``, without the metrics."""
_READ_ONLY = {"enable_external_access": "false", "python_enable_replacements": "false", "lock_configuration": "true"}


@dataclass(frozen=True)
class Sql:
    """Query Parquet datasets with SQL.

    The command needs DuckDB (pip install "h3data[sql]"). It reads only the data that the query needs, and writes
    nothing.

    Views (the columns of a dataset: h3data sql "describe steps" ds/; all of them: h3data docs queries):
        steps      one row per step. Names with a dot need quotes: "agent_0.action"[1]; lists count from 1.
                   Shorter: agent_0_x, _y, _z, _heading; dist_agents for "metrics.dist_agents"; seconds.
        episodes   one row per episode: task, scene, seed, policy, partner, length, seconds, info and the metrics S, SPS, ...
        events     episode_index, step, agent, kind, target, detail. Likewise skills, agents, bodies, inputs.
        all        each has a column dataset (its path as you typed it), so that several datasets can be compared.

    Examples:
        h3data sql "select policy, avg(dist_agents) from steps join episodes using (dataset, episode_index) group by 1" a/ b/
        h3data sql "select episode_index, min(seconds) from steps where collision group by 1 order by 1" ds/
        h3data sql "select episode_index, scene, seed, length from episodes order by length desc limit 10" ds/
        h3data sql "select scene, count(*) n, avg(S) found, avg(CR) from episodes group by all" ds/ --json
        h3data sql "select kind, agent, count(*) from events group by all order by 3 desc" ds/
        h3data sql "select episode_index, seconds, agent_1_x, agent_1_z from steps" ds/ -o paths.parquet
    """

    query: tyro.conf.Positional[str]
    """One SELECT (also FROM ..., WITH ..., DESCRIBE, SUMMARIZE, EXPLAIN) in DuckDB's SQL."""
    datasets: tyro.conf.Positional[tuple[Path, ...]]
    """Datasets, as folders or URIs (s3://bucket/ds), and folders of datasets (recordings/ of h3data evaluate
    --save-recordings)."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Write all rows to this .csv or .parquet instead of showing them."""
    profile: str | None = None
    """Profile of the metrics in the view episodes (default: the profile of each episode's task)."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Run the query and return its rows."""
        from h3data.recording import Dataset, open_recording
        from h3data.recording.finding import find_sources

        if not self.datasets:
            raise InputError('Expected at least one dataset: h3data sql "select ..." DATASET', code="H3-OPTION-055")
        opened = {str(path): open_recording(path) for path in find_sources(self.datasets)}
        for path, recording in opened.items():
            if not isinstance(recording, Dataset):
                raise InputError(
                    f"Expected a dataset, this is one recording. Hint: h3data convert {path} DATASET: {path}",
                    code="H3-OPTION-058",
                )
        if self.out is not None:
            if self.out.suffix not in (".csv", ".parquet"):
                raise InputError(
                    f"Expected a file name that ends in .csv or .parquet, got {self.out.name!r}.", code="H3-OPTION-059"
                )
            claim_file(self.out, force=self.force)
        datasets = {path: dataset for path, dataset in opened.items() if isinstance(dataset, Dataset)}
        connection = connect(datasets, profile=self.profile, metrics="episodes" in self.query.lower())
        with explained_errors():
            relation = select(connection, self.query)
            if self.out is None:
                if self.json:
                    return Outcome(text="", data=_data(relation.to_arrow_table()))
                return Outcome(text=_text_of(relation))
            rows = _write(relation, self.out)
        return Outcome(text=f"{rows} rows in {self.out}", data={"rows": rows, "file": str(self.out)})


def connect(
    datasets: dict[str, Dataset], *, profile: str | None = None, metrics: bool = True
) -> duckdb.DuckDBPyConnection:
    """Return a read-only DuckDB connection with views over ``datasets`` (by name), which has no access to other files.

    The view ``episodes`` has the metrics of ``profile`` (default: the profile of each episode's task). If ``metrics``
    is False, it has no metrics, and nothing is measured.

    Raises:
        MissingExtraError: DuckDB is not installed.
    """
    try:
        import duckdb
    except ImportError:
        raise MissingExtraError('SQL needs DuckDB. Hint: pip install "h3data[sql]"', code="H3-OPTION-056") from None

    connection = duckdb.connect()
    steps = []
    for number, (name, dataset) in enumerate(datasets.items()):
        connection.register(f"_steps_{number}", step_source(dataset))
        steps.append(f"SELECT {_text(name)} AS dataset, {', '.join(_step_columns(dataset))} FROM _steps_{number}")
    connection.execute(f"CREATE VIEW steps AS {' UNION ALL BY NAME '.join(steps)}")
    episodes = pa.concat_tables(
        [_episodes(*item, profile, metrics) for item in datasets.items()], promote_options="default"
    )
    connection.register("episodes", episodes)
    for kind in _RECORDS:
        tables = [_named(record_table(dataset, kind), name) for name, dataset in datasets.items()]
        connection.register(kind, pa.concat_tables(tables))
    for option, value in _READ_ONLY.items():
        connection.execute(f"SET {option} = {value}")
    return connection


def select(connection: duckdb.DuckDBPyConnection, query: str) -> duckdb.DuckDBPyRelation:
    """Return the result of one query, which is computed lazily.

    Raises:
        InputError: the query is not a single read-only statement.
        duckdb.Error: the query is not valid SQL, or names a view or column that does not exist; see `explained_errors`.
    """
    import duckdb

    reading = (duckdb.StatementType.SELECT, duckdb.StatementType.EXPLAIN)
    kinds = [statement.type for statement in connection.extract_statements(query)]
    if len(kinds) != 1 or kinds[0] not in reading:
        raise InputError(
            "Expected one query that reads: SELECT, FROM, WITH, DESCRIBE, SUMMARIZE or EXPLAIN.", code="H3-OPTION-054"
        )
    return connection.sql(query)


@contextmanager
def explained_errors() -> Iterator[None]:
    """Turn DuckDB's errors into an `InputError` with one line, which names the closest columns."""
    import duckdb

    try:
        yield
    except duckdb.Error as error:
        said, _, where = str(error).partition("\n\n")
        near = re.search(r"^Candidate bindings: .*$|^Did you mean .*$", where, re.MULTILINE)
        line = " ".join(f"{said} {near[0] if near and near[0] not in said else ''}".split())
        hint = "" if isinstance(error, duckdb.ParserException) else f" {_WHERE}"
        raise InputError(f"{line}{'' if line.endswith(('.', '!', '?')) else '.'}{hint}", code="H3-OPTION-057") from None


_WHERE = (
    'Hint: h3data sql "describe steps" DATASET lists the columns of a view: '
    f"{', '.join(('steps', 'episodes', *_RECORDS))}."
)


# --- the views --------------------------------------------------------------------------------------------------------
def _step_columns(dataset: Dataset) -> list[str]:
    """Return SQL for all stored columns, as lists without a fixed length (it varies), and for short names."""
    from h3data.recording.parquet.tables import table_schema

    schema = table_schema(dataset)
    taken = {name.lower() for name in schema.names}
    columns = []
    for field in schema:
        name = _name(field.name)
        listed = pa.types.is_fixed_size_list(field.type)
        item = field.type.value_type if listed else field.type
        if item == pa.uint64():  # newer files hold its bits as int64
            value = f"[{_unsigned('v')} for v in {name}]" if listed else _unsigned(name)
        else:
            value = f"{name}::{_SQL_TYPES[str(item)]}[]" if listed else name
        columns.append(f"{value} AS {name}")
    short = {"seconds": "time_ns / 1e9"}
    for name in schema.names:
        if match := re.fullmatch(r"agent_(\d+)\.base_pose", name):
            pose, agent = _name(name), f"agent_{match[1]}"
            short |= {f"{agent}_{axis}": f"{pose}[{k}]" for k, axis in enumerate("xyz", 1)}
            x, y, z, w = (f"{pose}[{k}]" for k in range(4, 8))
            short[f"{agent}_heading"] = f"atan2(2 * ({y} * {w} - {x} * {z}), 1 - 2 * ({y} * {y} + {z} * {z}))"
        elif name.startswith("metrics."):
            short[name.removeprefix("metrics.")] = _name(name)
    return columns + [f"{value} AS {_name(name)}" for name, value in short.items() if name.lower() not in taken]


_SQL_TYPES = {
    "bool": "BOOLEAN",
    "float": "FLOAT",
    "halffloat": "FLOAT",
    "double": "DOUBLE",
    "int8": "TINYINT",
    "int16": "SMALLINT",
    "int32": "INTEGER",
    "int64": "BIGINT",
    "uint8": "UTINYINT",
    "uint16": "USMALLINT",
    "uint32": "UINTEGER",
}
"""SQL type of each Arrow type that a column can have; uint64 is handled by `_unsigned`."""


def _unsigned(value: str) -> str:
    """Return SQL that reads the 64 bits of an integer as UBIGINT."""
    return f"({value}::HUGEINT & {2**64 - 1})::UBIGINT"


def _episodes(name: str, dataset: Dataset, profile: str | None, metrics: bool) -> pa.Table:
    """Return one row per episode, with policy and partner from its info, and its metrics measured now."""
    rows = []
    for row in dataset.rows:
        info = json.loads(row["info"])
        policy, partner = (info.get(key) if isinstance(info.get(key), str) else None for key in ("policy", "partner"))
        seconds = row["length"] * row["dt_ns"] / 1e9
        rows.append({**row, "dataset": name, "policy": policy, "partner": partner, "seconds": seconds})
    table = pa.Table.from_pylist(rows, schema=_EPISODES)
    values = _metrics(dataset, profile) if metrics else []
    for metric in dict.fromkeys(metric for row in values for metric in row):
        table = table.append_column(metric, pa.array([row.get(metric) for row in values], _REAL))
    return table


def _metrics(dataset: Dataset, profile: str | None) -> list[dict[str, float | None]]:
    """Return the metrics of each episode by name; empty where the profile does not apply to the task or recording."""
    from h3data.metrics import measure
    from h3data.metrics.reading import recordings

    by_episode: list[dict[str, float | None]] = []
    for recording in recordings([dataset.root], profile):
        try:
            values = measure(recording, profile).values
        except InputError:
            values = {}
        by_episode.append({name: None if math.isnan(value) else value for name, value in values.items()})
    return by_episode


def _named(table: pa.Table, dataset: str) -> pa.Table:
    return table.add_column(0, "dataset", pa.array([dataset] * len(table), pa.string()))


def _name(column: str) -> str:
    return '"' + column.replace('"', '""') + '"'


def _text(value: str) -> str:
    return "'" + value.replace("'", "''") + "'"


# --- the result -------------------------------------------------------------------------------------------------------
def _text_of(relation: duckdb.DuckDBPyRelation) -> str:
    """Return a table as wide as the terminal; computes only the rows that DuckDB needs for it."""
    text = io.StringIO()
    with redirect_stdout(text):
        relation.show(max_width=shutil.get_terminal_size((120, 24)).columns, max_rows=_ROWS)
    return text.getvalue()


def _data(table: pa.Table) -> dict[str, Any]:
    columns = [[_plain(value) for value in column.to_pylist()] for column in table.columns]
    return {
        "columns": table.column_names,
        "types": [str(field.type) for field in table.schema],
        "rows": [list(row) for row in zip(*columns, strict=True)],
    }


def _plain(value: Any) -> Any:
    """Return the value as JSON can hold it: DuckDB's sums of integers are decimals; times and the like become text."""
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, Decimal):
        return int(value) if value == value.to_integral_value() else float(value)
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def _write(relation: duckdb.DuckDBPyRelation, path: Path) -> int:
    """Write all rows to a file as they come, through a second connection: that of the views may write nothing."""
    import duckdb

    writer = duckdb.connect()
    writer.register("result", relation.to_arrow_reader())
    with part_file(path) as part:
        kind = path.suffix.removeprefix(".")
        (written,) = writer.execute(f"COPY (FROM result) TO {_text(str(part))} (FORMAT {kind})").fetchall()
    return written[0]


def step_source(dataset: DatasetFolder) -> pads.Dataset:
    """Return all committed steps as a lazy source, of which engines read only the columns and row groups they need.

    Values of type float16 become float32.
    """
    import pyarrow.dataset as pads  # imports pandas where it is installed: half a second of every command

    schema = pa.schema([pa.field(f.name, _without_halves(f.type)) for f in data_schema(dataset.schema)])
    paths = [shard_path(dataset.root, "data", shard) for shard in committed_shards(dataset, with_steps=True)]
    if not paths:
        return pads.dataset(schema.empty_table())
    if isinstance(paths[0], RemotePath):
        keys = [path.key for path in paths if isinstance(path, RemotePath)]
        return pads.dataset(keys, schema=schema, format="parquet", filesystem=paths[0].filesystem)
    return pads.dataset([str(path) for path in paths], schema=schema, format="parquet")


def record_table(dataset: DatasetFolder, kind: str) -> pa.Table:
    """Return all records of one kind with their ``episode_index``.

    ``kind`` is ``bodies``, ``assets``, ``agents``, ``skills``, ``events`` or ``inputs``.
    """
    schema = record_schema(SIDECARS[kind])
    tables = [dataset.sidecar(kind, shard).select(schema.names) for shard in committed_shards(dataset)]
    return pa.concat_tables([schema.empty_table(), *tables], promote_options="default")


def committed_shards(dataset: DatasetFolder, *, with_steps: bool = False) -> list[int]:
    """Return the numbers of the shards in the episode tables, optionally only of shards that have steps."""
    rows = dataset.rows
    return list(dict.fromkeys(dataset.shard_of(row) for row in rows if row["length"] or not with_steps))


def _without_halves(kind: pa.DataType) -> pa.DataType:
    """Return float32 in place of float16, because DuckDB refuses any table with a float16 column."""
    if pa.types.is_fixed_size_list(kind):
        return pa.list_(_without_halves(kind.value_type), kind.list_size)
    return pa.float32() if kind == pa.float16() else kind
