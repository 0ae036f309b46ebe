"""``h3data view``: a recording as a Rerun file with a ready layout."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from h3data.replay import Replay
from h3data_pipelines.command import ForceFlag, JsonFlag, Outcome, claim_file, open_episode
from h3data_pipelines.importing import recording_stem
from h3data_pipelines.rerender import missing_lines


@dataclass(frozen=True)
class View:
    """Write a recording as a Rerun file: 3-D scene, moving bodies, distance plot, action lanes, event log.

    Examples:
        h3data view out/demo/episode.mcap -o episode.rrd
        h3data view rec/session.mcap --assets ~/habitat
    """

    recording: tyro.conf.Positional[Path]
    """A .mcap file, or an episode of a dataset as ds#0."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """The .rrd file (default: beside the recording)."""
    assets: tuple[Path, ...] = ()
    """Folders below which recorded asset files are searched (default: H3DATA_ASSETS)."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        from h3data_viewers import write_rrd

        recording = open_episode(self.recording)
        beside = self.recording.with_name(f"{recording_stem(self.recording)}.rrd")
        out = claim_file(self.out or beside, force=self.force)
        replay = Replay(recording, assets=self.assets, detail=False)
        write_rrd(recording, out, replay=replay, overwrite=self.force)
        text = "\n".join([f"wrote {out}; open it with: rerun {out}", *missing_lines(replay)])
        return Outcome(text=text, data={"rrd": str(out), "bytes": out.stat().st_size, "missing": replay.missing})
