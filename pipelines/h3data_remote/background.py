"""Remote policy in a real-time loop, in which a thread waits for the server so that the loop never does."""

from __future__ import annotations

import threading
import time
from collections import deque
from queue import SimpleQueue
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from h3data_remote.adapter import Adapter
from h3data_remote.wire import PolicyServerError

RETRY_S = 2.0
"""Interval at which a lost server is contacted again [s]."""


class SlowPolicy(Protocol):
    """Protocol of a policy whose decisions may take long; `h3data_remote.policy.RemotePolicy` implements it."""

    adapter: Adapter
    width: int

    def request(self, view: Any) -> dict[str, Any]:
        """Return the request to the server for the current step."""
        ...

    def fetch(self, request: dict[str, Any]) -> NDArray[np.float32]:
        """Return the actions of the server's answer, shape [hold, width]."""
        ...

    def choice(self, row: NDArray[np.float32], view: Any) -> Any:
        """Return the choice for one action [width]."""
        ...

    def reconnect(self) -> None:
        """Start a new conversation with the server."""

    def close(self) -> None:
        """End the conversation with the server."""

    def recorded_info(self) -> dict[str, Any]:
        """Return the recorded facts about the server."""
        ...


class BackgroundPolicy:
    """Policy that returns a command without waiting: the server's if it has arrived, else the previous one.

    While an answer is late, the last action continues for the adapter's ``deadline_s``; then the robot stops.
    """

    def __init__(self, policy: SlowPolicy) -> None:
        self._policy = policy
        self._requests: SimpleQueue[dict[str, Any] | None] = SimpleQueue()
        self._answers: SimpleQueue[NDArray[np.float32] | PolicyServerError] = SimpleQueue()
        self._rows: deque[NDArray[np.float32]] = deque()
        self._last = np.zeros(policy.width, np.float32)
        self._is_asked, self._since, self._retry_at = False, time.monotonic(), 0.0
        self.late, self.faults = 0, 0
        """Steps without a fresh action, and requests that failed."""
        self.fault = ""
        """Reason why the server does not answer now; empty while it does."""
        self._thread = threading.Thread(target=self._serve, name="h3data remote policy", daemon=True)
        self._thread.start()

    def command(self, view: Any) -> Any:
        """Return the choice for the next step without waiting for the server."""
        while not self._answers.empty():
            answer, self._is_asked = self._answers.get(), False
            if isinstance(answer, PolicyServerError):
                self.fault, self.faults, self._retry_at = str(answer), self.faults + 1, time.monotonic() + RETRY_S
            else:
                self.fault = ""
                self._rows = deque(answer)
        now = time.monotonic()
        if self._rows:
            self._last, self._since = self._rows.popleft(), now
        else:
            self.late += 1
            if now - self._since > self._policy.adapter.deadline_s:
                self._last = np.zeros_like(self._last)
        if not self._rows and not self._is_asked and now >= self._retry_at:
            self._is_asked = True  # one step ahead, while the last action of the chunk is carried out
            # made in this thread: observations read the simulator, which the other thread must not touch
            self._requests.put(self._policy.request(view))
        return self._policy.choice(self._last, view)

    def after(self, spans: list[Any]) -> None:
        """Do nothing, because commands of servers are not skills that end."""

    def recorded_info(self) -> dict[str, Any]:
        """Return the recorded info of the policy, with the number of late answers."""
        (found,) = self._policy.recorded_info()["remote"]
        return {"remote": [{**found, "late_steps": self.late, "faults": self.faults}]}

    def close(self) -> None:
        """End the conversation and the thread as soon as the server has answered."""
        self._requests.put(None)

    def _serve(self) -> None:
        while (request := self._requests.get()) is not None:
            try:
                if self.fault:
                    self._policy.reconnect()
                self._answers.put(self._policy.fetch(request))
            except PolicyServerError as fault:
                self._answers.put(fault)
            except Exception as fault:  # whatever it is, the game goes on
                self._answers.put(PolicyServerError(f"{type(fault).__name__}: {fault}", code="H3-REMOTE-012"))
        self._policy.close()
