"""``h3data metrics``: the paper's tables from recordings and datasets."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from h3data.errors import InputError
from h3data.recording import Recording, open_recording
from h3data_pipelines.command import ForceFlag, JsonFlag, Outcome, claim_file, write_text


@dataclass(frozen=True)
class Metrics:
    """Compute task metrics from recordings alone: S, SPS, F, CR, BYR, TD, FD with 95 % intervals.

    Examples:
        h3data metrics out/demo/episode.mcap
        h3data metrics ds/ -o metrics.json --json
    """

    recordings: tyro.conf.Positional[tuple[Path, ...]]
    """.mcap files and datasets."""
    profile: Literal["paper"] = "paper"
    """Which formulas: those of the Habitat 3.0 paper."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """Write the JSON result to this file too."""
    force: ForceFlag = False
    json: JsonFlag = False

    def run(self) -> Outcome:
        from h3data.metrics import measure_many

        if not self.recordings:
            raise InputError("Expected at least one recording (.mcap) or dataset.")
        if self.out is not None:
            claim_file(self.out, force=self.force)
        table = measure_many(iterate(self.recordings), profile=self.profile)
        if self.out is not None:
            write_text(self.out, table.to_json() + "\n")
        return Outcome(text=table.to_text(), data=table.to_dict())


def iterate(paths: tuple[Path, ...]) -> Iterator[Recording]:
    """The recordings of all files, datasets and folders of .mcap files, one after the other."""
    for path in paths:
        files = sorted(path.glob("*.mcap")) if path.is_dir() and not (path / "meta").is_dir() else []
        for file in files or [path]:
            opened = open_recording(file)
            if isinstance(opened, Recording):
                yield opened
            else:
                yield from map(opened.recording, range(len(opened)))
