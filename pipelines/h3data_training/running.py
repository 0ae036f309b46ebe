"""Code for training runs of all kinds: their length, their interruption, and their results."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch

SPARE_S = 10.0
"""Time at the end of a run of limited duration for the last update and the files [s]."""

Say = Callable[[str], None]


class RunLength(Protocol):
    """Protocol of the settings of the length of a run."""

    @property
    def updates(self) -> int:
        """Number of updates of the run."""
        ...

    @property
    def minutes(self) -> float:
        """Time limit of the run [min]."""
        ...


@dataclass(frozen=True, kw_only=True)
class RunResult:
    """Result of a call of `train`."""

    folder: Path
    done: bool
    """True if the run has ended; False if it can be continued from the checkpoint."""
    updates: int
    decisions: int
    seconds: float
    """Duration of all calls including set-up [s]."""
    setup_s: float
    """Duration of the set-up of this call [s]."""
    last: dict[str, float]
    """Last row of the learning curve."""

    def as_data(self) -> dict[str, object]:
        """Return the result as JSON data, as ``--json`` prints it."""
        return {
            "policy": str(self.folder / "policy.npz"),
            "done": self.done,
            "updates": self.updates,
            "decisions": self.decisions,
            "seconds": self.seconds,
            "setup_s": self.setup_s,
            "last": self.last,
        }


def share_of(settings: RunLength, curve: list[Any], seconds: float, setups_s: float) -> float:
    """Return the progress of a run (0..1), by updates if their number is given, otherwise by learning time."""
    if settings.updates:
        return min(len(curve) / settings.updates, 1.0)
    return min(max((seconds - setups_s) / max(settings.minutes * 60 - setups_s - SPARE_S, 1e-9), 0.0), 1.0)


@contextmanager
def stop_asked() -> Iterator[threading.Event]:
    """Provide an event that Ctrl-C or SIGTERM sets, so that an update is finished and saved.

    A second signal ends the process at once.
    """
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}

    def ask(number: int, frame: Any) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, ask)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def one_thread(device: str) -> Iterator[None]:
    """Limit PyTorch to one thread on the CPU.

    The tensors are small. With other busy processes, several threads would spend most of the time waiting for each
    other (145 decisions per second instead of 6,000).
    """
    threads = torch.get_num_threads()
    if device == "cpu":
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
