"""Reading MCAP logs: whole files exactly, the records of damaged ones up to the damage."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any
from uuid import NAMESPACE_OID, uuid5

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, InputError, suggest
from h3data.recording.mcap.header import PROFILE, TOPIC_MESSAGES, episode_metadata
from h3data.recording.mcap.scan import McapRecords, decoding_errors, scan_records
from h3data.recording.mcap.shared_files import RECORD, shared_files
from h3data.recording.mcap.wire import STEP, decode_messages, fields_from_metadata, message_class
from h3data.recording.records import STEP_NS, Episode, Recording, RecordingHeader, SkillSpan
from h3data.recording.schema import (
    Column,
    Layout,
    check_version,
    default_layout,
    episode_from_dict,
    layout_from_json,
    layout_hash,
    layout_to_json,
    ordered,
    required_columns,
    struct_from_dict,
)
from h3data.recording.storage import AnyPath, RemotePath, place


def read_mcap(path: str | os.PathLike[str] | RemotePath, *, columns: Sequence[str] | None = None) -> Recording:
    """Return the recording in an MCAP file, exactly as it was written.

    With ``columns``, only these and the required columns (time, object and base poses) are decoded. If another program
    has rewritten the log without its metadata records, all steps, skills and events are read; the task is ``unknown``,
    and ``info["recovered"]`` states the reason.

    Raises:
        InputError: the file does not exist or cannot be read, or lacks a column.
        FormatError: the file is not a log of h3data, or is truncated or damaged; the message states how much of it
            `recover_mcap` can recover.
    """
    path = place(path)
    log = scan_records(load(path))
    check_kind(log, path)
    if lacks_records(log):
        reconstruct_all(log, path)
    elif log.fault is None and "h3.end" not in log.metadata:
        # every record may be sound although steps are missing: the writer was killed between two flushes
        log.fault = "the recording was never finished"
    if log.fault is not None:
        raise FormatError(
            f"Damaged or unfinished MCAP log: {log.fault}. {log.readable_bytes} of {log.size} bytes are sound, "
            f"{_recoverable_steps(log, path)} complete steps can be saved with `h3data recover {path} -o OUT`: {path}",
            code="H3-RECORDING-018",
        )
    log.attachments |= shared_files(log.metadata.get(RECORD, {}), path)
    try:
        return assemble(log, path, steps=int(log.metadata["h3.end"]["steps"]), wanted=columns)
    except FormatError as error:
        raise FormatError(f"{error} File: {path}", code=error.code) from error
    except (KeyError, *decoding_errors()) as error:
        raise FormatError(f"Not a log that h3data can read ({error!r}): {path}", code="H3-RECORDING-024") from error


# --- kinds of files --------------------------------------------------------------------------------------------------
def load(path: AnyPath) -> bytes:
    """Return contents of a file; an `InputError` or `FormatError` if it cannot be read."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"There is no such file: {path}", code="H3-FORMAT-013") from None
    except IsADirectoryError:
        raise FormatError(f"Expected an MCAP file, this is a folder: {path}", code="H3-RECORDING-025") from None
    except OSError as error:
        raise InputError(
            f"The file cannot be read ({error.strerror or error}): {path}", code="H3-RECORDING-026"
        ) from error


def check_kind(log: McapRecords, path: AnyPath) -> None:
    """Raise a `FormatError` unless the records are those of an h3data log of a supported version."""
    if not log.readable_bytes:
        raise FormatError(
            f"Expected an MCAP log, the file does not begin like one ({log.fault}): {path}", code="H3-RECORDING-019"
        )
    # the schema too, because tools that copy logs leave out the profile
    ours = log.profile == PROFILE or "h3.Scene" in {name for name, _ in log.schemas.values()}
    # a file that is damaged before its profile may be ours; its damage is what has to be reported
    if not ours and (log.profile or log.fault is None):
        raise FormatError(
            f"An MCAP log, but of profile {log.profile!r}; h3data reads profile {PROFILE!r}. "
            f"Hint: open it with Rerun or Foxglove: {path}",
            code="H3-RECORDING-020",
        )
    if "h3.schema" in log.metadata:
        check_version(log.metadata["h3.schema"].get("version", ""), path=path)


# --- logs without metadata records ------------------------------------------------------------------------------------
def lacks_records(log: McapRecords) -> bool:
    """Return whether another program rewrote the log without h3data's metadata records, with which every log starts."""
    ours = any(name.startswith("h3.") for name in log.metadata)
    return not ours and log.channel_of("/h3/scene") is not None


def reconstruct_all(log: McapRecords, path: AnyPath) -> None:
    """Reconstruct a whole log as `reconstruct` does; raise a `FormatError` if its topics cannot be read."""
    try:
        reconstruct(log, path)
    except (KeyError, *decoding_errors()) as error:
        raise FormatError(f"Not a log that h3data can read ({error!r}): {path}", code="H3-RECORDING-024") from error


def reconstruct(
    log: McapRecords, path: AnyPath, *, steps: int | None = None, first: Sequence[memoryview] | None = None
) -> None:
    """Reconstruct the metadata records of a log from its topics: columns, number of steps, and time between steps.

    Task, scene, seed and settings are lost, as ``info["recovered"]`` states. ``steps`` and ``first`` are the number of
    messages on ``/h3/state`` and the first two messages; if None, they are taken from the log.
    """
    channels = {topic: log.channel_of(f"/h3/{topic}") for topic in TOPIC_MESSAGES}
    layout: list[Column] = []
    for topic, channel in channels.items():
        if channel is not None:
            fields = fields_from_metadata(log.channels[channel][2], topic=f"/h3/{topic}")
            layout += [field.column for field in fields if field.column is not STEP]
    messages = [] if channels["state"] is None else log.messages.get(channels["state"], [])
    steps, first = len(messages) if steps is None else steps, messages[:2] if first is None else first
    note = {
        "from": path.name,
        "reason": "the log has no metadata records: task, scene, seed and settings are not known",
    }
    episode = Episode(
        # from what is known, so that the same file has the same uid whenever it is read
        uid=str(uuid5(NAMESPACE_OID, f"{path.name} {steps}")),
        episode_id=path.name.split(".")[0],
        task="unknown",
        scene="unknown",
        dt_ns=_step_ns(log, channels["state"], first),
        info={"recovered": {**note, "steps": steps}},
    )
    log.metadata |= {"h3.episode": episode_metadata(episode), "h3.end": {"steps": str(steps)}}
    if layout:
        columns = tuple(layout)
        log.metadata["h3.layout"] = {"columns": layout_to_json(columns), "hash": layout_hash(columns)}


def _step_ns(log: McapRecords, channel: int | None, first: Sequence[memoryview]) -> int:
    """Return the time from the first step to the second [ns], or that of our tasks."""
    if channel is None or len(first) < 2:
        return STEP_NS
    _, schema, metadata = log.channels[channel]
    fields = fields_from_metadata(metadata, topic="/h3/state")
    rows = decode_messages(
        fields, first, wanted={"time_ns"}, descriptor=log.schemas[schema][1], message=f"h3.{TOPIC_MESSAGES['state']}"
    )
    # never zero: everything that computes speeds divides by it
    return max(int(rows["time_ns"][1]) - int(rows["time_ns"][0]), 1)


# --- from records to a recording --------------------------------------------------------------------------------------
def _messages(log: McapRecords, topic: str) -> list[Any]:
    channel = log.channel_of(topic)
    if channel is None:
        return []
    name, descriptor = log.schemas[log.channels[channel][1]]
    cls = message_class(descriptor, name)
    return [cls.FromString(bytes(m)) for m in log.messages.get(channel, ())]


def _plain(message: Any) -> dict[str, Any]:
    """Return fields of a protobuf message as plain values, except lists of messages."""
    out = {}
    for f in message.DESCRIPTOR.fields:
        if f.message_type is None:
            value = getattr(message, f.name)
            out[f.name] = list(value) if hasattr(value, "extend") else value
    return out


def columns_of(
    log: McapRecords, *, steps: int | None, wanted: set[str] | None, first: int = 0
) -> dict[str, NDArray[Any]]:
    """Return the columns of all topics: exactly ``steps`` rows from row ``first`` on, or if None, all consecutive rows."""
    parts: list[dict[str, NDArray[Any]]] = []
    for topic, message in TOPIC_MESSAGES.items():
        channel = log.channel_of(f"/h3/{topic}")
        if channel is None:
            continue
        _, schema, metadata = log.channels[channel]
        fields = fields_from_metadata(metadata, topic=f"/h3/{topic}")
        parts.append(
            decode_messages(
                fields,
                log.messages.get(channel, []),
                wanted=wanted,
                descriptor=log.schemas[schema][1],
                message=f"h3.{message}",
            )
        )
        numbers = parts[-1].pop("")
        # row numbers, not times, tell whether steps are missing: times may jump in recordings of real sessions
        broken = np.flatnonzero(numbers != np.arange(first, first + len(numbers)))
        sound = int(broken[0]) if len(broken) else len(numbers)
        if steps is not None and (len(numbers) != steps or sound != steps):
            raise FormatError(
                f"Expected steps {first}..{first + steps - 1} in /h3/{topic}, got {len(numbers)}, {sound} in order.",
                code="H3-RECORDING-027",
            )
        parts[-1] = {name: array[:sound] for name, array in parts[-1].items()}
    # topics are flushed one after the other, so a log that was cut off may have a step in one of them only
    rows = min((len(a) for part in parts for a in part.values()), default=0)
    return {name: array[:rows] for part in parts for name, array in part.items()}


def _layout(log: McapRecords) -> Layout | None:
    if "h3.layout" not in log.metadata:
        return None
    layout = layout_from_json(log.metadata["h3.layout"]["columns"])
    # columns are found by this record; where it is damaged, numbers would land in other columns without an error
    if log.metadata["h3.layout"].get("hash") != layout_hash(layout):
        raise FormatError(
            "The record of the column layout is damaged: its hash does not match.", code="H3-RECORDING-022"
        )
    return layout


def assemble(
    log: McapRecords, path: AnyPath, *, steps: int | None, wanted: Sequence[str] | None, first: int = 0
) -> Recording:
    """Return the recording in these records, with ``steps`` rows from row ``first`` on, as in `columns_of`."""
    if "h3.episode" not in log.metadata:
        raise FormatError("it ends before the episode record", code="H3-RECORDING-021")
    episode = episode_from_dict(log.metadata["h3.episode"], path=path)
    scenes = _messages(log, "/h3/scene")
    if not scenes:
        raise FormatError("it has no message on /h3/scene", code="H3-RECORDING-023")
    scene: dict[str, Any] = {
        kind: tuple(struct_from_dict(struct, _plain(m)) for m in getattr(scenes[0], kind))
        for kind, struct in (("assets", "Asset"), ("bodies", "Body"), ("agents", "Agent"))
    }
    layout = _layout(log)
    names = None
    if wanted is not None:
        existing = [c.name for c in layout or ()]
        unknown = sorted(set(wanted) - set(existing))
        if unknown:
            near = suggest(unknown[0], existing, lead="It has")
            raise InputError(f"No columns {unknown} in this log.{near} File: {path}", code="H3-RECORDING-028")
        names = set(wanted) | required_columns(len(scene["agents"]))
    columns = columns_of(log, steps=steps, wanted=names, first=first)
    if not columns:
        if steps:
            raise FormatError(f"Expected {steps} steps, got none.", code="H3-RECORDING-029")
        # an episode that failed before its first step has none, but the columns that its reader expects
        layout = layout or default_layout(RecordingHeader(episode=episode, **scene))
        columns = {c.name: c.empty() for c in layout}
    if layout is not None:
        lost = [c.name for c in layout if c.name not in columns and (names is None or c.name in names)]
        if lost:
            raise FormatError(
                f"The topics lack columns that the layout announces: {', '.join(lost)}.", code="H3-RECORDING-030"
            )
        columns = ordered(columns, [c.name for c in layout])
    spans: dict[int, SkillSpan] = {}
    # a later message with the same number replaces the earlier one, which said that the skill was running
    for message in _messages(log, "/h3/skill"):
        spans[message.span] = struct_from_dict("Skill", _plain(message))
    return Recording(
        episode=episode,
        **scene,
        columns=columns,
        skills=tuple(spans[k] for k in sorted(spans)),
        events=tuple(struct_from_dict("Event", _plain(m)) for m in _messages(log, "/h3/event")),
        inputs=tuple(struct_from_dict("Input", _plain(m)) for m in _messages(log, "/h3/input")),
        attachments=log.attachments,
    )


def _recoverable_steps(log: McapRecords, path: AnyPath) -> int:
    try:
        return len(assemble(log, path, steps=None, wanted=None))
    except (KeyError, FormatError, *decoding_errors()):
        return 0
