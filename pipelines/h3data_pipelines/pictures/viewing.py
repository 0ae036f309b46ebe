"""``h3data view``: one recording, or two side by side, as a Rerun file with a ready-made layout."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from h3data.errors import InputError
from h3data.recording import Recording
from h3data.recording.storage import RemotePath, place
from h3data.replay import Replay
from h3data_pipelines.command import ForceFlag, JsonFlag, Outcome, PeopleOption, claim_file, open_episode
from h3data_pipelines.jobs.imports import recording_stem
from h3data_pipelines.pictures.rerender import missing_lines

if TYPE_CHECKING:
    from h3data_viewers import ShownRecording


@dataclass(frozen=True)
class View:
    """Write a recording as a Rerun file: 3-D scene, moving bodies, charts, events.

    Examples:
        h3data view out/demo/episode.mcap -o episode.rrd
        h3data view rec/session.mcap --assets ~/habitat
        h3data view ds#3 --camera robot_arm --camera third_person
        h3data view ds#3 --compare other#3
    """

    recording: tyro.conf.Positional[Path]
    """.mcap file or episode of a dataset such as ds#0, as a path or URI."""
    compare: Path | None = None
    """Second recording, shown next to the first on the same timeline."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """.rrd file to write (default: next to the recording)."""
    camera: tuple[str, ...] = ()
    """Cameras to render at every fifth step: names as in rerender, or .toml or .json files."""
    people: PeopleOption = "skin"
    assets: tuple[Path, ...] = ()
    """Folders to search for recorded asset files (default: H3DATA_ASSETS)."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        from h3data_viewers import write_comparison_rrd, write_rrd

        paths = [self.recording] if self.compare is None else [self.recording, self.compare]
        if len(paths) == 2 and _same(*paths):
            raise InputError(f"--compare expects a second recording, got the first one again: {self.compare}")
        recordings = [open_episode(path) for path in paths]
        out = claim_file(self.out or self._beside(), force=self.force, suffix=".rrd")
        replays = [Replay(recording, assets=self.assets, people=self.people, detail=False) for recording in recordings]
        shown = [self._shown(*each) for each in zip(paths, recordings, replays, strict=True)]
        if len(shown) == 1:
            only = shown[0]
            write_rrd(only.recording, out, replay=only.replay, cameras=only.cameras, overwrite=self.force)
        else:
            write_comparison_rrd(shown[0], shown[1], out, overwrite=self.force)
        lines = dict.fromkeys(line for replay in replays for line in missing_lines(replay))
        text = "\n".join([f"wrote {out}; open it with: rerun {out}", *lines])
        missing = {uri: count for replay in reversed(replays) for uri, count in replay.missing.items()}
        data = {"rrd": str(out), "bytes": out.stat().st_size, "missing": missing}
        return Outcome(text=text, data=data, result=out)

    def _shown(self, path: Path, recording: Recording, replay: Replay) -> ShownRecording:
        from h3data_viewers import ShownRecording, rendered_feed

        feeds = [rendered_feed(replay, name) for name in self.camera]
        return ShownRecording(recording=recording, replay=replay, cameras=feeds, name=str(place(path)))

    def _beside(self) -> Path:
        if isinstance(place(self.recording), RemotePath):
            raise InputError(f"The recording is not local: give the .rrd file to write with -o. {self.recording}")
        stem = recording_stem(self.recording)
        if self.compare is not None:
            stem += f"_and_{recording_stem(self.compare)}"
        return self.recording.with_name(f"{stem}.rrd")


def _same(first: Path, second: Path) -> bool:
    a, b = place(first), place(second)
    if isinstance(a, RemotePath) or isinstance(b, RemotePath):
        return a == b
    return a.resolve() == b.resolve()
