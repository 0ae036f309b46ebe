"""Recordings of episodes, and their storage as MCAP session logs and Parquet datasets.

The modules for storage are imported at first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from h3data.moved import lazy_names
from h3data.recording.records import (
    SCHEMA_VERSION,
    STEP_NS,
    Agent,
    AssetRef,
    Body,
    Episode,
    Event,
    InputEvent,
    Recording,
    RecordingHeader,
    SkillSpan,
)

if TYPE_CHECKING:
    from h3data.recording.compare import recordings_equal, state_hash
    from h3data.recording.episodes import Episodes
    from h3data.recording.mcap.read import read_mcap
    from h3data.recording.mcap.recover import Recovery, recover_mcap
    from h3data.recording.mcap.writer import RecordingWriter, pack_mcap, write_mcap
    from h3data.recording.opening import open_recording, open_steps
    from h3data.recording.parquet.dataset import Dataset
    from h3data.recording.parquet.lerobot import rebuild_meta
    from h3data.recording.parquet.writer import DatasetWriter
    from h3data.recording.steps import Steps

__all__ = [
    "SCHEMA_VERSION",
    "STEP_NS",
    "Agent",
    "AssetRef",
    "Body",
    "Dataset",
    "DatasetWriter",
    "Episode",
    "Episodes",
    "Event",
    "InputEvent",
    "Recording",
    "RecordingHeader",
    "RecordingWriter",
    "Recovery",
    "SkillSpan",
    "Steps",
    "open_recording",
    "open_steps",
    "pack_mcap",
    "read_mcap",
    "rebuild_meta",
    "recordings_equal",
    "recover_mcap",
    "state_hash",
    "write_mcap",
]

__getattr__ = lazy_names(
    __name__,
    {
        "recordings_equal": ".compare",
        "state_hash": ".compare",
        "Dataset": ".parquet.dataset",
        "DatasetWriter": ".parquet.writer",
        "rebuild_meta": ".parquet.lerobot",
        "RecordingWriter": ".mcap.writer",
        "pack_mcap": ".mcap.writer",
        "write_mcap": ".mcap.writer",
        "Recovery": ".mcap.recover",
        "read_mcap": ".mcap.read",
        "recover_mcap": ".mcap.recover",
        "open_recording": ".opening",
        "Episodes": ".episodes",
        "Steps": ".steps",
        "open_steps": ".opening",
    },
)
