"""The short way in from Python: open a recording, draw one picture of it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from h3data.recording import Dataset, Recording, open_recording
from h3data.render import Output
from h3data.replay import Replay, camera_track


def open(path: str | os.PathLike[str]) -> Any:
    """The `Recording` in an MCAP file, or the `Dataset` in a folder.

    Raises:
        FormatError: it is neither; the message says what it looks like and what to do.
    """
    opened: Recording | Dataset = open_recording(Path(path))
    return opened


def render_frame(
    recording: Recording | Replay,
    *,
    camera: str = "third_person",
    step: int = 0,
    outputs: Sequence[Output] = ("rgb",),
    assets: Sequence[str | Path] = (),
) -> dict[str, NDArray[Any]]:
    """One picture: ``rgb`` uint8 [H, W, 3], ``depth`` float32 [H, W] [m], ``instance`` int32 [H, W], ...

    For many pictures make a `Replay` once and pass it, or use its `Replay.frames`.
    """
    replay = recording if isinstance(recording, Replay) else Replay(recording, assets=assets)
    row = replay.row(step)
    track = camera_track(replay, camera)
    return next(iter(replay.frames([track], [row], outputs=outputs)))[1][0]
