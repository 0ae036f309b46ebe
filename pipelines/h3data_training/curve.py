"""Learning curve of a run, as a table in its folder and as event files for TensorBoard."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from h3data.errors import InputError
from h3data.files import part_file

CURVE, EVENTS = "curve.parquet", "tensorboard"

Row = dict[str, float]
"""Results of one update, by name."""


def save_curve(curve: list[Row], folder: Path) -> None:
    """Write the table of a learning curve atomically."""
    with part_file(folder / CURVE) as part:
        pq.write_table(pa.Table.from_pylist(curve), part)


def curve_of(folder: Path) -> list[Row]:
    """Return the learning curve of a run.

    Raises:
        InputError: the run has no learning curve.
    """
    path = folder / CURVE
    if not path.is_file():
        raise InputError(
            f"Expected the folder of a training run, found no {CURVE}. Folder: {folder}", code="H3-TRAIN-019"
        )
    return pq.read_table(path.absolute()).to_pylist()  # a relative path may look like a URI


class EventLog:
    """Writer of the curve's rows for TensorBoard, by number of decisions; without ``tensorboard`` it does nothing."""

    def __init__(self, folder: Path, curve: list[Row]) -> None:
        self._writer: Any = None
        self._rows = len(curve)
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            return
        last = int(curve[-1]["decisions"]) if curve else 0
        self._writer = SummaryWriter(str(folder / EVENTS), purge_step=last + 1)

    def write(self, curve: list[Row]) -> None:
        """Write the rows that were added since the last call."""
        if self._writer is None:
            return
        for row in curve[self._rows :]:
            for name, value in row.items():
                if name not in ("update", "decisions"):
                    self._writer.add_scalar(name, value, int(row["decisions"]))
        self._rows = len(curve)
        self._writer.flush()
