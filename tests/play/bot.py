"""A scripted player who speaks the protocol of docs/play.md through a socket, without a browser."""

from __future__ import annotations

import asyncio
import json
import struct
import time
from dataclasses import dataclass, field
from typing import Any

import aiohttp

HEAD = struct.Struct("<BBBBIif")


@dataclass
class Bot:
    """One browser."""

    link: str
    """Address of a seat."""
    http: aiohttp.ClientSession = field(init=False)
    socket: aiohttp.ClientWebSocketResponse = field(init=False)
    manifest: dict[str, Any] = field(default_factory=dict)
    states: list[tuple[Any, ...]] = field(default_factory=list)
    """Heads of the states that came: kind, flags, agents, objects, step, ack, clock."""
    last: bytes = b""
    told: list[dict[str, Any]] = field(default_factory=list)
    close_code: int | None = None
    times: list[float] = field(default_factory=list)
    seq: int = 0
    sent: dict[int, float] = field(default_factory=dict)
    acked: dict[int, float] = field(default_factory=dict)
    _hearing: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Bot:
        # without unsafe no cookies are kept for 127.0.0.1
        self.http = aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True))
        return self

    async def __aexit__(self, *_: Any) -> None:
        await self.close()
        await self.http.close()

    async def sit(self) -> int:
        """Takes the seat; returns the HTTP status."""
        async with self.http.post(self.link + "api/session", json={}) as answer:
            if answer.status != 200:
                self.told.append({"refused": await answer.text()})
                return answer.status
            body = await answer.json()
        self.manifest, self.glb, self.address = body["manifest"], body["glb"], self.link + body["socket"]
        return 200

    async def connect(self) -> None:
        """Opens the socket; closes the one before."""
        await self.close()
        self.close_code = None
        self.socket = await self.http.ws_connect(self.address, compress=0)
        self._hearing = asyncio.create_task(self._hear())

    async def close(self) -> None:
        """Closes the socket, if there is one; the seat is kept."""
        if self._hearing is not None:
            await self.socket.close()
            await asyncio.gather(self._hearing, return_exceptions=True)

    async def _hear(self) -> None:
        async for frame in self.socket:
            now = time.monotonic()
            if frame.type is aiohttp.WSMsgType.TEXT:
                self.told.append(json.loads(frame.data))
            elif frame.data[0] == 1:
                head = HEAD.unpack_from(frame.data)
                self.last = frame.data
                self.times.append(now)
                self.states.append(head)
                for seq in range(max(self.acked, default=-1) + 1, head[5] + 1):
                    if seq in self.sent:
                        self.acked[seq] = now
        self.close_code = self.socket.close_code

    async def send(self, **message: Any) -> int:
        """Sends a message; returns its number."""
        seq, self.seq = self.seq, self.seq + 1
        self.sent[seq] = time.monotonic()
        text = {**message, "seq": seq, "ct": round(time.monotonic() * 1e3, 1), "rtt": 1.5}
        await self.socket.send_str(json.dumps(text))
        return seq

    async def until(self, what: Any, seconds: float = 20.0) -> Any:
        """Waits until ``what()`` is true, and returns it."""
        end = time.monotonic() + seconds
        while not (found := what()):
            if time.monotonic() > end:
                raise TimeoutError(f"{what} did not come true; told: {self.told[-5:]}, states: {self.states[-1:]}")
            await asyncio.sleep(0.01)
        return found

    def heard(self, name: str) -> list[Any]:
        """What text frames said under a name."""
        return [message[name] for message in self.told if name in message]

    @property
    def step(self) -> int:
        return self.states[-1][4] if self.states else 0
