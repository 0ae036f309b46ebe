"""A server of a plan in a process of its own, for tests."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any


class Server:
    """``python -m h3data_play.serve``, or ``h3data_studies.serve`` for the option ``study``, started and stopped."""

    def __init__(self, out: Path, options: dict[str, Any] | None = None, **plan: Any) -> None:
        out.mkdir(parents=True, exist_ok=True)
        self.out = out
        module = "h3data_studies.serve" if "study" in (options or {}) else "h3data_play.serve"
        self.process = subprocess.Popen(
            [sys.executable, "-m", module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            text=True,
        )
        whole = {"app": "rearrange", "scenes": "small:3", "partner": "still", "out": str(out), **plan}
        given = {"plan": whole, **(options or {})}
        if "study" in given:
            del given["plan"]
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(given) + "\n")
        self.process.stdin.flush()
        self.reports: list[dict[str, Any]] = [self.report()]

    def report(self) -> dict[str, Any]:
        """The next line; an empty object at the end."""
        assert self.process.stdout is not None
        return json.loads(self.process.stdout.readline() or "{}")

    @property
    def links(self) -> list[str]:
        """Addresses of the seats."""
        return [link for _, link in self.reports[0]["ready"]["links"]]

    def workers(self) -> list[int]:
        """Process numbers of its workers, in the order in which they were started."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text()
        return [int(number) for number in children.split()]

    def stop(self, number: int = signal.SIGTERM) -> int:
        """Sends a signal and waits; returns the exit code."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.wait(20)

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: Any) -> None:
        self.stop()
        for stream in (self.process.stdin, self.process.stdout):
            assert stream is not None
            stream.close()
