"""``h3data view``: a recording as a Rerun file with a ready layout."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from h3data.errors import InputError
from h3data.recording import Recording, open_recording
from h3data.replay import Replay
from h3data_pipelines.command import ForceFlag, JsonFlag, Outcome, claim_file
from h3data_pipelines.rerender import missing_lines


@dataclass(frozen=True)
class View:
    """Write a recording as a Rerun file: 3-D scene, moving bodies, distance plot, action lanes, event log.

    Examples:
        h3data view out/demo/episode.mcap -o episode.rrd
        h3data view rec/session.mcap --assets ~/habitat
    """

    recording: tyro.conf.Positional[Path]
    """A .mcap file."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """The .rrd file (default: beside the recording)."""
    assets: tuple[Path, ...] = ()
    """Folders below which recorded asset files are searched (default: H3DATA_ASSETS)."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        from h3data_viewers import write_rrd

        recording = open_recording(self.recording)
        if not isinstance(recording, Recording):
            raise InputError(
                f"Expected a recording (.mcap), this is a dataset. Use one of its episodes: {self.recording}"
            )
        out = claim_file(self.out or self.recording.with_suffix(".rrd"), force=self.force)
        replay = Replay(recording, assets=self.assets, detail=False)
        write_rrd(recording, out, replay=replay, overwrite=self.force)
        text = "\n".join([f"wrote {out}; open it with: rerun {out}", *missing_lines(replay)])
        return Outcome(text=text, data={"rrd": str(out), "bytes": out.stat().st_size, "missing": replay.missing})
