"""Start and supervision of the processes of a run that trains on several GPUs."""

from __future__ import annotations

import os
import pickle
import signal
import socket
import tempfile
import threading
from collections.abc import Callable
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, Protocol

LOOK_S = 0.5
"""Interval between checks for a request to stop [s]."""


class StopRequest(Protocol):
    """Protocol of a request to stop a run, such as `threading.Event`."""

    def is_set(self) -> bool:
        """Return whether the run should stop."""
        ...


Work = Callable[[Any, StopRequest, Callable[[str], None]], Any]
"""Function that a process runs, with an input, a request to stop, and a receiver of lines of text."""


def launch(work: Work, count: int, given: Any, *, stop: StopRequest, say: Callable[[str], None]) -> Any:
    """Run ``work`` in ``count`` new processes with torchrun's variables, and return the result of the first one.

    ``given`` is passed to them in a file, since it may be large. When a process fails, the others are ended, because
    they would wait for it forever.

    Raises:
        Exception: an exception that a process raised.
        RuntimeError: a process has died.
    """
    context = get_context("spawn")  # a forked process could not use CUDA
    asked, pipes, processes = context.Event(), [], []
    with socket.socket() as free, tempfile.TemporaryDirectory(prefix="h3data-") as folder:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        file = Path(folder) / "given"
        with file.open("wb") as stream:
            pickle.dump(given, stream, protocol=5)
        free.close()
        try:
            for rank in range(count):
                reads, writes = context.Pipe(duplex=False)
                variables = {
                    "RANK": rank,
                    "LOCAL_RANK": rank,
                    "WORLD_SIZE": count,
                    "MASTER_ADDR": "127.0.0.1",
                    "MASTER_PORT": port,
                }
                process = context.Process(target=_work, args=(work, file, variables, asked, writes))
                process.start()
                writes.close()  # the end of the process is then the end of the pipe
                pipes.append(reads)
                processes.append(process)
            return _result(processes, pipes, asked, stop, say)
        except BaseException:
            for process in processes:
                process.kill()
            raise
        finally:
            for process in processes:
                process.join()


def _result(processes: list[Any], pipes: list[Any], asked: Event, stop: StopRequest, say: Callable[[str], None]) -> Any:
    """Return the result of the first process, and passes on the lines of all."""
    result, still = None, dict(enumerate(pipes))
    while still:
        if stop.is_set():
            asked.set()
        ready = wait(list(still.values()), timeout=LOOK_S)
        for rank in [rank for rank, pipe in still.items() if pipe in ready]:
            try:
                kind, value = still[rank].recv()
            except EOFError:
                del still[rank]
                processes[rank].join()
                if processes[rank].exitcode:
                    raise RuntimeError(
                        f"Process {rank} of {len(processes)} ended with exit code {processes[rank].exitcode}."
                    ) from None
                continue
            if kind == "fault":
                raise value
            if kind == "line":
                say(value)
            elif rank == 0:
                result = value
    return result


class _Asked:
    """Set when the process that started this one asks for it, or is no longer there."""

    def __init__(self, asked: Event) -> None:
        self._asked = asked

    def is_set(self) -> bool:
        parent = parent_process()
        return self._asked.is_set() or (parent is not None and not parent.is_alive())


def _work(work: Work, file: Path, variables: dict[str, Any], asked: Event, pipe: Connection) -> None:
    """Run a process from its start to its end."""
    assert threading.current_thread() is threading.main_thread()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # Ctrl-C reaches all processes; the first one decides
        signal.signal(number, signal.SIG_IGN)
    os.environ |= {name: str(value) for name, value in variables.items()}
    try:
        with file.open("rb") as stream:
            given = pickle.load(stream)  # written by our parent process, into a folder of its own
        pipe.send(("result", work(given, _Asked(asked), lambda line: pipe.send(("line", line)))))
    except Exception as fault:  # the process that started this one raises it
        pipe.send(("fault", fault))
