"""Command ``h3data recover``, which saves the readable part of a recording that was cut off."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from h3data.commands.command import ForceFlag, JsonFlag, Outcome, claim_file


@dataclass(frozen=True)
class Recover:
    """Save all complete steps of a damaged or unfinished recording (.mcap, .mcap.part) as a new recording.

    Examples:
        h3data recover out/demo/episode.mcap.part -o saved.mcap
    """

    recording: tyro.conf.Positional[Path]
    """An .mcap file, or the .part file that an interrupted run left."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """New recording to write; the old file is kept."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Write the readable part of the recording and return how much was saved."""
        from h3data.recording import recover_mcap

        out = claim_file(self.out, force=self.force, suffix=".mcap")
        saved = recover_mcap(self.recording, out, overwrite=self.force)
        text = f"saved {saved.steps} steps in {saved.path}; {saved.bytes_read} of {saved.bytes_total} bytes read: "
        data = {
            "recording": str(saved.path),
            "steps": saved.steps,
            "reason": saved.reason,
            "bytes_read": saved.bytes_read,
            "bytes_total": saved.bytes_total,
        }
        return Outcome(text=text + saved.reason, data=data)
