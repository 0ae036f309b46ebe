"""Worker processes of the front process, which starts, supplies and replaces them."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from h3data_play.channel import encode, receive
from h3data_play.plan import GameOrder, PlayPlan, prepared_key

MOST_UNSENT = 1 << 20
"""Number of unread bytes above which messages of players to a worker are dropped, so that a stuck worker cannot block
the front process."""
EXPECTED_SHARE = 0.06
"""Share of a core that a game is expected to need before one has been measured."""
MOST_FILES, MOST_EPISODES = 160, 512
"""Largest number of files and largest number of prepared episodes in the cache of the front process."""
PREPARE_S = 60.0
"""Time after which an episode is prepared by the worker that plays it [s]."""
READY_S = 600.0
"""Time limit for the start of a worker [s], which may compile kernels for minutes once per machine."""

Heard = Callable[["WorkerProcess", str, str, Any], None]


class Refused(Exception):
    """Error about a plan that cannot be played, with the reason as its text.

    It is not an `H3DataError`, because the front process imports nothing of h3data; the command raises an `H3DataError`
    with the same text and code.
    """

    def __init__(self, text: str, *, code: str = "") -> None:
        super().__init__(text)
        self.code = code


class WorkerProcess:
    """Process of a worker, with the games that it plays."""

    def __init__(self, plans: Sequence[PlayPlan], heard: Heard, lost: Callable[[WorkerProcess], None]) -> None:
        self._plans, self._heard, self._lost = plans, heard, lost
        self.games: set[str] = set()
        self.busy, self.measured, self.left = 0.0, 0, 0
        """Share of a core that the games take (CPU time of their median steps), number of games measured for it, and
        number of games that stand still because their players have left."""
        self.ready: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._reading: asyncio.Task[None] | None = None
        ours, theirs = socket.socketpair()
        paths = os.pathsep.join(path for path in sys.path if path)  # the same packages, also where none is installed
        command = [sys.executable, "-m", "h3data_play.worker", str(theirs.fileno())]
        self.process = subprocess.Popen(
            command, pass_fds=[theirs.fileno()], env={**os.environ, "PYTHONPATH": paths}, stdin=subprocess.DEVNULL
        )
        theirs.close()
        self._socket = ours
        self._writer: asyncio.StreamWriter | None = None

    async def start(self) -> None:
        """Wait until the process has compiled and loaded everything.

        Raises:
            Refused: the worker cannot play the plan, or its process has ended.
        """
        reader, self._writer = await asyncio.open_connection(sock=self._socket)
        self._reading = asyncio.create_task(self._read(reader))
        self.send("plans", "", msgspec.to_builtins(self._plans))
        await asyncio.wait_for(self.ready, READY_S)

    async def _read(self, reader: asyncio.StreamReader) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError, OSError):
            while True:
                kind, key, body = await receive(reader)
                if kind == "ready":
                    self.ready.set_result(None)
                elif kind == "refused":
                    self.ready.set_exception(Refused(body["text"], code=body["code"]))
                elif kind == "load":
                    self.busy, self.measured, self.left = float(body["busy"]), int(body["games"]), int(body["left"])
                else:
                    self._heard(self, kind, key, body)
        if not self.ready.done():
            self.ready.set_exception(
                Refused("A worker process ended while it started; its message is above.", code="H3-PLAY-026")
            )
        self._lost(self)

    def send(self, kind: str, key: str, body: Any) -> None:
        """Send a message to the worker; do nothing if its process has ended."""
        if self._writer is not None and not self._writer.is_closing():
            self._writer.write(encode(kind, key, body))

    @property
    def with_one_more(self) -> float:
        """Share of a core that the worker would need with one more game; new games count as average ones."""
        each = self.busy / self.measured if self.measured else EXPECTED_SHARE
        return self.busy + each * (max(len(self.games) - self.measured - self.left, 0) + 1)

    @property
    def is_stuck(self) -> bool:
        """Return whether the worker has not read for a while."""
        return self._writer is not None and self._writer.transport.get_write_buffer_size() > MOST_UNSENT

    async def stop(self, seconds: float, *, finish: bool = True) -> None:
        """Stop the worker, which finishes its recordings or leaves them as logs, and wait until it has ended."""
        self.send("stop", "", {"finish": finish})
        try:
            await asyncio.wait_for(asyncio.to_thread(self.process.wait), seconds)
        except TimeoutError:
            self.process.kill()
        if self._writer is not None:
            self._writer.close()
        if self._reading is not None:
            # what it said last may still have to be read
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._reading, 1.0)


class Workers:
    """Pool of worker processes, with a spare one that takes over when a worker dies."""

    def __init__(
        self, plans: Sequence[PlayPlan], count: int, heard: Heard, lost: Callable[[WorkerProcess], None]
    ) -> None:
        self._plans, self._count, self._heard, self._on_lost = plans, count, heard, lost
        self.active: list[WorkerProcess] = []
        self.spare: asyncio.Task[WorkerProcess] | None = None
        self._stops = False

    async def start(self) -> None:
        """Start all workers; the spare one becomes ready later.

        Raises:
            Refused: the plan cannot be played.
        """
        # the first one compiles; the others find everything compiled
        self.active = [await self._started()]
        self.active += await asyncio.gather(*(self._started() for _ in range(self._count - 1)))
        self.spare = asyncio.create_task(self._started())

    async def _started(self) -> WorkerProcess:
        worker = WorkerProcess(self._plans, self._heard, self._lost)
        await worker.start()
        return worker

    def least_busy(self) -> WorkerProcess:
        """Return the worker that should play the next game."""
        return min(self.active, key=lambda worker: (round(worker.with_one_more, 1), len(worker.games)))

    def ready_spare(self) -> WorkerProcess | None:
        """Return the spare worker if it is ready; else None."""
        spare = self.spare
        if spare is None or not spare.done() or spare.cancelled() or spare.exception() is not None:
            return None
        return spare.result()

    async def warm_spare(self) -> WorkerProcess | None:
        """Wait until the spare worker is ready and return it; None if there is none."""
        if self.spare is not None:
            await asyncio.wait([self.spare])
        return self.ready_spare()

    def _lost(self, worker: WorkerProcess) -> None:
        if worker in self.active and not self._stops:
            self.active.remove(worker)
            self._on_lost(worker)

    async def replacement(self) -> WorkerProcess:
        """Return the spare worker, or else the next process that becomes ready, and start another spare."""
        spare = self.spare or asyncio.create_task(self._started())
        worker = await spare
        self.spare = asyncio.create_task(self._started())
        self.active.append(worker)
        return worker

    async def stop(self, seconds: float, *, finish: bool = True) -> None:
        """Stop all workers, which finish their recordings or leave them as logs."""
        self._stops = True
        if self.spare is not None:
            if self.spare.done() and not self.spare.cancelled() and self.spare.exception() is None:
                self.active.append(self.spare.result())
            self.spare.cancel()
        await asyncio.gather(*(worker.stop(seconds, finish=finish) for worker in self.active))


class Preparer:
    """Preparation of the parts of episodes that pages need, by the spare worker before the episodes start.

    The files of a home and its precomputed facts take a second, during which the games of a playing worker would stand
    still. A game that starts next to others waits until the spare worker is ready.
    """

    def __init__(self, workers: Workers) -> None:
        self._workers = workers
        self.files: dict[str, tuple[bytes, str]] = {}
        """Files by name: content, gzip-compressed, and its type."""
        self._made: dict[str, dict[str, Any]] = {}
        self._asked: dict[str, tuple[WorkerProcess, asyncio.Future[None]]] = {}

    def heard(self, key: str, body: dict[str, Any]) -> None:
        """Store prepared data that a worker has sent."""
        for what, kind in (("glb", "model/gltf-binary"), ("grid", "application/octet-stream")):
            name, data = body[what]
            self.files.pop(name, None)
            self.files[name] = data, kind
        while len(self.files) > MOST_FILES:
            del self.files[next(iter(self.files))]
        kept = {"manifest": body["manifest"], "agents": body["agents"], "facts": body["facts"]}
        self._made.pop(key, None)
        self._made[key] = {**kept, "glb": f"world/{body['glb'][0]}", "names": [body["glb"][0], body["grid"][0]]}
        while len(self._made) > MOST_EPISODES:
            del self._made[next(iter(self._made))]
        asked = self._asked.pop(key, None)
        if asked is not None and not asked[1].done():
            asked[1].set_result(None)

    def made(self, order: GameOrder) -> dict[str, Any] | None:
        """Return the prepared files of an episode if they are still in the cache."""
        found = self._made.get(prepared_key(order))
        return found if found is not None and all(name in self.files for name in found["names"]) else None

    def ask(self, order: GameOrder) -> asyncio.Future[None] | None:
        """Request the preparation of an episode; return None if no worker can do it, or if it is not needed."""
        key, spare = prepared_key(order), self._workers.ready_spare()
        if spare is None or self.made(order) is not None:
            return None
        asked = self._asked.get(key)
        if asked is None or asked[0] is not spare:  # another spare than that which was asked: that one is busy playing
            spare.send("prepare", key, {"plan": order.plan, "index": order.index})
            asked = self._asked[key] = spare, asyncio.get_running_loop().create_future()
        return asked[1]

    async def wait(self, order: GameOrder) -> dict[str, Any] | None:
        """Wait for the prepared files of an episode; return None if the worker that plays it has to prepare them."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(PREPARE_S):
                await self._workers.warm_spare()
                asked = self.ask(order)
                if asked is not None:
                    await asyncio.wait([asked])
        return self.made(order)
