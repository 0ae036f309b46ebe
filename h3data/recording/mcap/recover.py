"""Recovery of the readable part of a log that was truncated, damaged or never finished."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

from h3data.errors import FormatError, InputError
from h3data.recording.mcap.part import publish
from h3data.recording.mcap.read import assemble, check_kind, lacks_records, load, reconstruct_all
from h3data.recording.mcap.scan import decoding_errors, scan_records
from h3data.recording.mcap.shared_files import RECORD, shared_files
from h3data.recording.mcap.writer import write_mcap
from h3data.recording.storage import RemotePath, local, place


@dataclass(frozen=True, kw_only=True)
class Recovery:
    """Result of `recover_mcap`."""

    path: Path
    steps: int
    bytes_read: int
    bytes_total: int
    reason: str
    """Reason why the original could not be read as a whole."""


def recover_mcap(
    path: str | os.PathLike[str] | RemotePath, out: str | os.PathLike[str], *, overwrite: bool = False
) -> Recovery:
    """Save all complete steps of a truncated, damaged or unfinished log (also ``*.part``) as a new, complete log.

    ``info["recovered"]`` of the new episode states the reason. Reading stops at the first damage, and no data are
    guessed. The original is not deleted, even if ``out`` is its intended final name.

    Raises:
        InputError: ``out`` exists and ``overwrite`` is False, or the file cannot be read.
        FormatError: nothing can be recovered, or the file is not a log of h3data.
    """
    path, out = place(path), local(out)
    if os.path.exists(out) and not overwrite:
        raise InputError(f"The file exists; choose another name or pass overwrite=True: {out}", code="H3-RECORDING-031")
    log = scan_records(load(path))
    check_kind(log, path)
    if bare := lacks_records(log):
        reconstruct_all(log, path)
    finished = log.fault is None and "h3.end" in log.metadata
    reason = log.fault or ("nothing is wrong with it" if finished else "the recording was never finished")
    missing = ""
    try:
        log.attachments |= shared_files(log.metadata.get(RECORD, {}), path)
    except FormatError as error:  # better the steps without the scene than nothing
        missing = str(error)
    try:
        recording = assemble(log, path, steps=None, wanted=None)
    except (KeyError, FormatError, *decoding_errors()) as error:
        raise FormatError(f"Nothing can be recovered ({error}): {path}", code="H3-RECORDING-032") from error
    if bare:
        missing = "; ".join(filter(None, [missing, recording.episode.info["recovered"]["reason"]]))
    if missing:
        reason = missing if finished else f"{reason}; {missing}"
    if not finished or missing:
        note = {"from": path.name, "reason": reason, "steps": len(recording)}
        info = {**recording.episode.info, "recovered": note}
        recording = replace(recording, episode=replace(recording.episode, info=info))
    # a log is written as <name>.part, which may be the very file that is being recovered
    part = out.with_name(f".{out.name}.recovering")
    write_mcap(recording, part, overwrite=True)
    publish(part, out)
    return Recovery(path=out, steps=len(recording), bytes_read=log.readable_bytes, bytes_total=log.size, reason=reason)
