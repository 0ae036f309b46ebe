"""Metadata records, messages and log times of an MCAP log."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from h3data.errors import InputError
from h3data.recording.mcap.wire import message_class, struct_descriptor
from h3data.recording.records import SCHEMA_VERSION, Episode, Recording, RecordingHeader
from h3data.recording.schema import CONVENTIONS, Topic, episode_to_dict

PROFILE = "h3data"
TOPIC_MESSAGES: dict[Topic, str] = {"state": "State", "action": "Action"}
"""Topics with a message for each step."""


def start_time(header: RecordingHeader | Recording, t0_unix_ns: int | None) -> int:
    """Return the Unix time of step 0 [ns]: ``t0_unix_ns``, or else the value in ``episode.info``, or else 0."""
    t0 = header.episode.info.get("t0_unix_ns", 0) if t0_unix_ns is None else t0_unix_ns
    try:
        return int(t0)
    except (TypeError, ValueError):
        raise InputError(f"t0_unix_ns must be whole nanoseconds, got {t0!r}.", code="H3-RECORDING-008") from None


def log_time(t0_unix_ns: int, time_ns: int) -> int:
    """Return the time of a message [ns since 1970], clipped to the range that MCAP readers accept."""
    # MCAP has unsigned times of 64 bits, but many readers hold them in signed ones
    return min(max(t0_unix_ns + time_ns, 0), 2**63 - 1)


def header_metadata(header: RecordingHeader | Recording) -> dict[str, dict[str, str]]:
    """Return the metadata records at the start of a log, by name."""
    episode = episode_metadata(header.episode)
    try:
        # names with lone surrogates come from file systems, and would fail in the middle of the file
        for text in [*episode.values(), *header.attachments]:
            text.encode()
    except UnicodeEncodeError as error:
        raise InputError(
            f"Names must be valid Unicode, this one is not: {error.object!r}.", code="H3-RECORDING-009"
        ) from None
    return {"h3.schema": {"version": SCHEMA_VERSION, **CONVENTIONS}, "h3.episode": episode}


def episode_metadata(episode: Episode) -> dict[str, str]:
    """Return the episode as a metadata record, all values as text."""
    # MCAP allows nothing but text in metadata
    return {k: str(v) for k, v in episode_to_dict(episode).items()}


def encode_record(message: str, values: Mapping[str, Any]) -> bytes:
    """Return a serialised message of `struct_descriptor`; raise an `InputError` if it cannot hold a value."""
    try:
        return message_class(struct_descriptor(), message)(**values).SerializeToString(deterministic=True)
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{message} cannot hold this value: {error}.", code="H3-RECORDING-010") from error
