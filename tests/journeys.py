"""Files that one has to open to follow something through the product, counted while it runs: ``python -m tests.journeys``.

A stay is a file with functions that are given the thing that is followed. Each function counts once, in the order of first
calls, and functions in one file after another are one stay. A return is a stay in a file that was visited before.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

from h3data.recording import RecordingHeader, RecordingWriter
from h3data.scene.open import open_scene
from h3data_homes import HomeSpec
from sim_kinematic.tasks.episode import Episode
from tests.paths import ROOT
from tests.simulated import SOCIAL_NAV, simulate_social_nav

PARTS = tuple(f"{ROOT}/{name}/" for name in ("h3data", "sim_kinematic", "pipelines", "viewers"))


def stays(play: Callable[[], object], follows: Callable[[str, Any], bool]) -> list[str]:
    """The files of a journey in order; ``follows`` says of each argument, by name and value, whether it is what is followed."""
    seen, files = set(), []

    def called(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event != "call" or code in seen or not code.co_filename.startswith(PARTS) or code.co_name.startswith("<"):
            return
        names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
        if not any(follows(name, frame.f_locals.get(name)) for name in names):
            return
        seen.add(code)
        file = str(Path(code.co_filename).relative_to(ROOT))
        if files[-1:] != [file]:
            files.append(file)

    before = sys.getprofile()
    sys.setprofile(called)
    try:
        play()
    finally:
        sys.setprofile(before)
    return files


def stays_of_an_episode(folder: Path, *followed: type) -> list[str]:
    """Return the files in which an episode of social navigation is handed on, from `simulate` to the disk.

    Args:
        folder: Folder for the recording.
        followed: Types of what is followed; (Episode, RecordingHeader) for the episode and what it becomes on the disk.
    """
    home = open_scene(HomeSpec(seed=1))
    episode = SOCIAL_NAV.episode(home, spec=replace(SOCIAL_NAV.Spec(), max_steps=3))

    def play() -> None:
        file = folder / "a.mcap"
        simulate_social_nav(episode, policy="stand_still", sink=lambda header: RecordingWriter(file, header))

    # methods of the episode itself are no journey
    return stays(play, lambda name, value: isinstance(value, followed) and name != "self")


def returns(files: list[str]) -> int:
    """How often a journey comes back to a file."""
    return len(files) - len(set(files))


if __name__ == "__main__":
    import tempfile

    for followed in ((Episode,), (Episode, RecordingHeader)):
        with tempfile.TemporaryDirectory() as folder:
            found = stays_of_an_episode(Path(folder), *followed)
        total = f"{len(found)} stays in {len(set(found))} files, {returns(found)} returns\n\n"
        sys.stdout.write("\n".join([f"{' and '.join(kind.__name__ for kind in followed)}:", *found, total]))
