"""Scripted browser that speaks the protocol of `h3data docs play` over HTTP and a socket.

It stores the server's messages, and needs no simulator. Tests, benchmarks and scripted participants of studies use it.
"""

from __future__ import annotations

import asyncio
import json
import struct
import time
from dataclasses import dataclass, field
from typing import Any, Self

import aiohttp

STATE = 1
TOUCH, WALL, ENDED, BUSY = 1, 2, 4, 8
"""Flags of state messages, repeated from `h3data_play.wire`, which imports NumPy."""
HEAD = struct.Struct("<BBBBIif")
_ROBOT, _OBJECT, _JOINT = struct.Struct("<3f"), struct.Struct("<Hh7f"), struct.Struct("<Hf")
_PERSON_BYTES = 12 + 28 + 21 * 4
MOST_KEPT = 20_000


@dataclass
class Thing:
    """Object in a state message."""

    held: int = -1
    """Number of the agent that holds the object; -1 if none does."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass
class Client:
    """Browser of a scripted participant."""

    link: str
    """Address of a seat or of a study, with a slash at the end."""
    http: aiohttp.ClientSession = field(init=False)
    socket: aiohttp.ClientWebSocketResponse = field(init=False)
    address: str = ""
    """Address of the WebSocket; empty before the client has a seat."""
    glb: str = ""
    manifest: dict[str, Any] = field(default_factory=dict)
    head: tuple[Any, ...] = (STATE, 0, 0, 0, 0, -1, 0.0)
    """Head of the last state: kind, flags, agents, objects in it, step, acknowledged message, clock [ms]."""
    bases: list[tuple[float, float, float]] = field(default_factory=list)
    """Poses of the agents in the last state: x [m], z [m], heading [rad]."""
    things: list[Thing] = field(default_factory=list)
    joints: list[float] = field(default_factory=list)
    """Positions of doors and drawers [rad or m]."""
    states: int = 0
    bytes: int = 0
    """Number of bytes of all received states."""
    told: list[dict[str, Any]] = field(default_factory=list)
    """Text frames that the client received."""
    delays: list[float] = field(default_factory=list)
    """Delay from each message to the state that reflects it [s]."""
    times: list[float] = field(default_factory=list)
    """Times at which states arrived, by `time.monotonic` [s]."""
    played_s: float = 0.0
    """Time between states of the same connection [s], without waiting for seats and next episodes."""
    waited_s: list[float] = field(default_factory=list)
    """Time from the end of each episode to the first state of the next [s]."""
    close_code: int | None = None
    seq: int = 0
    news: asyncio.Event = field(default_factory=asyncio.Event)
    """Event that is set by every message from the server."""
    _latest: float = 0.0
    _sent: dict[int, float] = field(default_factory=dict)
    _hearing: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        # without unsafe no cookies are kept for 127.0.0.1
        self.http = aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True))
        return self

    async def __aexit__(self, *_: Any) -> None:
        await self.close()
        await self.http.close()

    async def sit(self) -> int:
        """Take the seat and return the HTTP status; the text of a refusal is stored in ``told`` as ``refused``."""
        async with self.http.post(self.link + "api/session", json={}) as answer:
            if answer.status != 200:
                self.told.append({"refused": await answer.text()})
                return answer.status
            body = await answer.json()
        self.manifest, self.glb, self.address = body["manifest"], body["glb"], self.link + body["socket"]
        return 200

    async def connect(self) -> None:
        """Open the WebSocket of a seat, for a new episode or again, after closing the previous one."""
        await self.close()
        self.head, self.told, self.close_code = (STATE, 0, 0, 0, 0, -1, 0.0), [], None
        self.things, self._latest = [Thing() for _ in self.manifest["objects"]], 0.0
        self.joints = [joint["rest"] for joint in self.manifest["joints"]]
        self.socket = await self.http.ws_connect(self.address, compress=0)
        self._hearing = asyncio.create_task(self._hear())

    async def close(self) -> None:
        """Close the WebSocket, if there is one; the seat remains."""
        if self._hearing is not None:
            await self.socket.close()
            await asyncio.gather(self._hearing, return_exceptions=True)

    async def _hear(self) -> None:
        try:
            async for frame in self.socket:
                if frame.type is aiohttp.WSMsgType.TEXT:
                    self.told.append(json.loads(frame.data))
                elif frame.data[0] == STATE:
                    self._state(frame.data)
                self.news.set()
            self.close_code = self.socket.close_code
        finally:
            self.news.set()

    def _state(self, data: bytes) -> None:
        now = time.monotonic()
        before, self.head = self.head[5], HEAD.unpack_from(data)
        self.states += 1
        self.bytes += len(data)
        self.played_s += now - (self._latest or now)
        self._latest = now
        if len(self.times) < MOST_KEPT:
            self.times.append(now)
        at, self.bases = HEAD.size, []
        for agent in self.manifest["agents"]:
            self.bases.append(_ROBOT.unpack_from(data, at))
            at += _PERSON_BYTES if agent["kind"] == "human" else 12 + 2 * agent["joints"]
        for _ in range(self.head[3]):
            index, held, x, y, z, *_ = _OBJECT.unpack_from(data, at)
            if index < len(self.things):  # after the objects come things of chores
                self.things[index] = Thing(held, (x, y, z))
            at += _OBJECT.size
        for index, position in _JOINT.iter_unpack(data[at:]):
            self.joints[index] = position
        for seq in range(before + 1, self.head[5] + 1):
            if seq in self._sent:
                self.delays.append(now - self._sent.pop(seq))

    async def send(self, **message: Any) -> int:
        """Send a message to the server and return its number."""
        seq, self.seq = self.seq, self.seq + 1
        now = time.monotonic()
        self._sent[seq] = now
        text = {**message, "seq": seq, "ct": round(now * 1e3, 1), "rtt": round(self.rtt_ms, 1)}
        await self.socket.send_str(json.dumps(text))
        return seq

    async def until(self, what: Any, seconds: float = 20.0) -> Any:
        """Wait until ``what()`` is true, and return its value.

        Raises:
            TimeoutError: the value is still false after ``seconds`` [s].
            ConnectionError: the connection was closed while waiting.
        """
        end = time.monotonic() + seconds
        while not (found := what()):
            if self._hearing is not None and self._hearing.done():
                self._hearing.result()  # raises what a message has raised
            if self.close_code is not None:
                raise ConnectionError(f"The server closed the connection ({self.close_code}).")
            rest = end - time.monotonic()
            if rest <= 0:
                raise TimeoutError(f"Waited {seconds:g} s in vain; told: {self.told[-3:]}, state: {self.head}")
            self.news.clear()
            try:
                await asyncio.wait_for(self.news.wait(), rest)
            except TimeoutError:
                continue
        return found

    def heard(self, name: str) -> list[Any]:
        """Return the contents of the received text frames with a name."""
        return [message[name] for message in self.told if name in message]

    @property
    def flags(self) -> int:
        """Flags of the last state message."""
        return self.head[1]

    @property
    def step(self) -> int:
        """Step of the last state message."""
        return self.head[4]

    @property
    def ack(self) -> int:
        """Number of the last message that has taken effect."""
        return self.head[5]

    @property
    def rtt_ms(self) -> float:
        """Time from the last acknowledged message to the state that reflects it [ms]; 0 if there was none."""
        return 1e3 * self.delays[-1] if self.delays else 0.0
