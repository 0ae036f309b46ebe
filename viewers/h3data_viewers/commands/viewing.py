"""Command ``h3data view``: a recording as a Rerun file, as an HTML file that plays from disk, or as a strip of pictures.

A Rerun file has a layout and may show two recordings side by side.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from h3data.commands.arguments import result_of
from h3data.commands.command import (
    ForceFlag,
    JsonFlag,
    LightOption,
    Outcome,
    PeopleOption,
    StandInsFlag,
    claim_file,
    missing_lines,
    open_episode,
    recording_stem,
)
from h3data.commands.options import command_of
from h3data.errors import InputError, suggest_keywords
from h3data.files import size_text
from h3data.recording import Recording
from h3data.recording.storage import RemotePath, place
from h3data.render.light.sources import LightMode
from h3data.replay import Replay

if TYPE_CHECKING:
    from h3data.bodies.people.rigid_parts import PeopleStyle
    from h3data.commands.arguments import FilePath, Paths
    from h3data_viewers import ViewedRecording


PICTURES = (".png", ".jpg")
"""File name endings that select a strip of pictures."""


@suggest_keywords
def view(
    recording: FilePath,
    *,
    compare: FilePath | None = None,
    out: FilePath | None = None,
    cameras: Paths = (),
    people: PeopleStyle = "skin",
    light: LightMode = "baked",
    assets: Paths = (),
    stand_ins: bool = False,
    open: bool = False,
    force: bool = False,
) -> Path:
    """Write a recording as a Rerun file, or as an HTML file that plays it in a browser.

    A Rerun file can show two recordings side by side. The options are those of ``h3data view``.

    Returns:
        The .rrd or .html file.

    Raises:
        InputError: an option is wrong, or the file exists.
    """
    return result_of(View, locals())


@command_of(view)
class View:
    """Write a recording as a Rerun file or as one HTML file that plays from disk, with 3-D scene, charts and events.

    The HTML file needs no server, no network and no program but a browser: send it by mail or put it on a web page. A
    .png or .jpg file contains a strip: the moments of a rearrangement episode (picks, places, agents that cross) side
    by side. Each moment is a picture and a plan with the paths until then.

    Examples:
        h3data view out/demo/episode.mcap -o episode.rrd
        h3data view ds#3 -o episode.html --open
        h3data view rec/session.mcap --assets ~/habitat
        h3data view ds#3 --cameras robot_arm,third_person
        h3data view ds#3 --compare other#3
        h3data view ds#3 -o strip.png
    """

    recording: tyro.conf.Positional[Path]
    """.mcap file or episode of a dataset such as ds#0, as a path or URI."""
    compare: Path | None
    """Second recording, shown next to the first on the same timeline (.rrd only)."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])]
    """File to write: .rrd, .html, .png or .jpg (default: .rrd, next to the recording)."""
    cameras: tuple[str, ...]
    """Cameras to render at every fifth step: names as in rerender, or .toml or .json files (.rrd only)."""
    people: PeopleOption
    light: LightOption
    """Light in strips and in the pictures of cameras: ``baked`` is light from windows, sun and lamps, ``flat`` is the
    same everywhere. The 3-D scene has no light."""
    assets: tuple[Path, ...]
    """Folders to search for recorded asset files (default: H3DATA_ASSETS)."""
    stand_ins: StandInsFlag
    open: bool
    """Open the file after writing it: .rrd files in Rerun, others in the browser."""
    force: ForceFlag
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Write the recording to a file, whose format follows from the ending of its name."""
        form = ".rrd" if self.out is None else self.out.suffix.lower()
        if form not in (".rrd", ".html", *PICTURES):
            raise InputError(
                f"Expected a file name that ends in .rrd, .html, .png or .jpg, got: {self.out}", code="H3-RENDER-095"
            )
        if form == ".rrd":
            return self._rrd()
        if self.compare is not None or self.cameras:
            option = "--compare" if self.compare is not None else "--camera"
            raise InputError(
                f"{option} needs a Rerun file: give -o a name that ends in .rrd. Got: {self.out}", code="H3-RENDER-096"
            )
        return self._html() if form == ".html" else self._strip(form)

    def _strip(self, form: str) -> Outcome:
        from h3data.render.image_files import write_image
        from h3data_viewers.strip import episode_strip, moments_of

        assert self.out is not None
        recording = open_episode(self.recording)
        out = claim_file(self.out, force=self.force, suffix=form)
        replay = self._replay(recording, light=self.light)
        write_image(out, episode_strip(replay))
        moments = moments_of(recording)
        lines = [f"wrote {out}", *(f"  step {m.step}: {m.text}" for m in moments), *missing_lines(replay)]
        told = [{"step": moment.step, "text": moment.text} for moment in moments]
        return self._finished("picture", out, lines, replay.missing, moments=told)

    def _html(self) -> Outcome:
        from h3data_viewers.html_replay.html_file import write_html

        assert self.out is not None
        recording = open_episode(self.recording)
        out = claim_file(self.out, force=self.force, suffix=".html")
        replay = self._replay(recording, detail=False)
        written = write_html(replay.recording, out, replay=replay, overwrite=self.force)
        fewer = f", {written.states:,} of {written.steps:,} states" if written.states < written.steps else ""
        lines = [f"wrote {out} ({size_text(written.bytes)}{fewer}); open it in a browser", *missing_lines(replay)]
        return self._finished("html", out, lines, replay.missing, states=written.states)

    def _finished(self, kind: str, out: Path, lines: list[str], missing: dict[str, int], **more: Any) -> Outcome:
        fault = _open(out) if self.open else ""
        data = {kind: str(out), "bytes": out.stat().st_size, "missing": missing, **more}
        return Outcome(
            text="\n".join([*lines, *filter(None, [fault])]), data=data, result=out, exit_code=int(bool(fault))
        )

    def _rrd(self) -> Outcome:
        from h3data_viewers import write_comparison_rrd, write_rrd

        paths = [self.recording] if self.compare is None else [self.recording, self.compare]
        places = [place(path) for path in paths]
        # paths of object stores have no links that `resolve` could follow
        named = {each if isinstance(each, RemotePath) else each.resolve() for each in places}
        if len(named) < len(paths):
            raise InputError(
                f"--compare expects a second recording, got the first one again: {self.compare}", code="H3-RENDER-097"
            )
        recordings = [open_episode(path) for path in paths]
        out = claim_file(self.out or self._beside(), force=self.force, suffix=".rrd")
        replays = [self._replay(recording, detail=False, light=self.light) for recording in recordings]
        shown = [self._shown(*each) for each in zip(paths, replays, strict=True)]
        if len(shown) == 1:
            only = shown[0]
            write_rrd(only.recording, out, replay=only.replay, cameras=only.cameras, overwrite=self.force)
        else:
            write_comparison_rrd(shown[0], shown[1], out, overwrite=self.force)
        lines = dict.fromkeys(line for replay in replays for line in missing_lines(replay))
        missing = {uri: count for replay in reversed(replays) for uri, count in replay.missing.items()}
        return self._finished("rrd", out, [f"wrote {out}; open it with: rerun {out}", *lines], missing)

    def _replay(self, recording: Recording, *, light: LightMode = "flat", detail: bool | None = None) -> Replay:
        return Replay(
            recording,
            assets=self.assets,
            people=self.people,
            detail=detail,
            light=light,
            stand_ins=self.stand_ins,
        )

    def _shown(self, path: Path, replay: Replay) -> ViewedRecording:
        from h3data_viewers import ViewedRecording, rendered_feed

        feeds = [rendered_feed(replay, name) for name in dict.fromkeys(self.cameras)]
        return ViewedRecording(recording=replay.recording, replay=replay, cameras=feeds, name=str(place(path)))

    def _beside(self) -> Path:
        if isinstance(place(self.recording), RemotePath):
            raise InputError(
                f"The recording is not local: give the .rrd file to write with -o. {self.recording}",
                code="H3-RENDER-098",
            )
        stem = recording_stem(self.recording)
        if self.compare is not None:
            stem += f"_and_{recording_stem(self.compare)}"
        return self.recording.with_name(f"{stem}.rrd")


def _open(path: Path) -> str:
    """Open a file in the program that shows it, and return why that did not work, if it did not."""
    if path.suffix.lower() in (".html", *PICTURES):
        opened = webbrowser.open(path.resolve().as_uri())
        return "" if opened else f"There is no browser to open it in. Hint: copy it to a machine with one: {path}"
    # the viewer of this environment first: one on the PATH may have another version, which cannot read the file
    beside = Path(sys.executable).with_name("rerun")
    viewer = str(beside) if beside.is_file() else shutil.which("rerun")
    if viewer is None:
        return 'Rerun is not installed, so nothing was opened. Hint: pip install "rerun-sdk>=0.41,<0.42"'
    quiet = subprocess.DEVNULL
    # in a session of its own, so that the viewer stays when the terminal is closed
    subprocess.Popen([viewer, str(path)], stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True)
    return ""
