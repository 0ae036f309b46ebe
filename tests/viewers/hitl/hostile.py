"""Clients that try all kinds of things, as a process of their own: ``python -m tests.viewers.hitl.hostile LINK COUNT SECONDS``
prints how often which answer came."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import random
import sys
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from urllib.parse import urlsplit

import aiohttp

from h3data_viewers.hitl.bots.client import Client

FAULTS = (aiohttp.ClientError, ConnectionError, TimeoutError, OSError)


class Hostile(Client):
    """One of them."""

    def __init__(self, link: str, number: int, end: float, answers: Counter[str]) -> None:
        super().__init__(link)
        self.number, self.end, self.answers = number, end, answers
        self.chance = random.Random(number)

    async def attack(self) -> None:
        """Goes on until the end, then lets go of everything."""
        kinds: list[Callable[[], Awaitable[None]]] = [
            self.huge_request, self.strange_socket, self.wrong_token, self.noise, self.half_a_request, self.nonsense,
            self.flood, self.giant, self.slow_reader, self.costly,
        ]  # fmt: skip
        while time.monotonic() < self.end:
            with contextlib.suppress(*FAULTS):
                await kinds[self.number % len(kinds)]()
            await asyncio.sleep(0.05)

    # --- without a seat -----------------------------------------------------------------------------------------------
    async def huge_request(self) -> None:
        async with self.http.post(self.link + "api/session", data=b"x" * 200_000) as answer:
            self.answers[f"huge request {answer.status}"] += 1

    async def strange_socket(self) -> None:
        await self._refused("strange socket", f"play/{self.chance.randbytes(8).hex()}")

    async def wrong_token(self) -> None:
        await self._refused("wrong token", "play/x", Cookie="h3data_seat_0=" + "x" * 2000)

    async def _refused(self, what: str, path: str, **headers: str) -> None:
        try:
            await self.http.ws_connect(self.link + path, headers=headers)
            self.answers[f"{what} 101"] += 1
        except aiohttp.WSServerHandshakeError as refusal:
            self.answers[f"{what} {refusal.status}"] += 1

    async def noise(self) -> None:
        reader, writer = await self._raw()
        writer.write(self.chance.randbytes(4000))
        await writer.drain()
        await asyncio.wait_for(reader.read(1000), 2.0)
        writer.close()
        self.answers["noise"] += 1

    async def half_a_request(self) -> None:
        _, writer = await self._raw()
        writer.write(b"POST /api/session HTTP/1.1\r\nHost: localhost\r\nContent-Length: 10000\r\n")
        await asyncio.sleep(3.0)
        writer.close()
        self.answers["half a request"] += 1

    async def _raw(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        address = urlsplit(self.link)
        return await asyncio.open_connection(address.hostname, address.port)

    # --- in a seat ----------------------------------------------------------------------------------------------------
    async def nonsense(self) -> None:
        for text in (
            "[" * 4000,
            '{"k":"hand","side":"left","p":[0,1e200,0]}',
            '{"k":"pick","o":-1}',
            "\x00",
            "é" * 900,
        ):
            if await self._seated():
                await self.socket.send_str(text)
                await self._closed("nonsense")

    async def flood(self) -> None:
        if await self._seated():
            with contextlib.suppress(*FAULTS):
                for _ in range(400):
                    await self.socket.send_str('{"k":"move","f":0.1}')
            await self._closed("flood")

    async def giant(self) -> None:
        if await self._seated():
            with contextlib.suppress(*FAULTS):  # the server does not wait for the end of it
                await self.socket.send_str("x" * 5_000_000)
            await self._closed("giant")

    async def slow_reader(self) -> None:
        if await self._seated():
            if self._hearing is not None:
                self._hearing.cancel()  # nothing is read any more
            await asyncio.sleep(max(0.0, min(30.0, self.end - time.monotonic())))
            self.answers["slow reader"] += 1

    async def costly(self) -> None:
        """What makes the server plan, as often as it is let."""
        if await self._seated():
            for k in range(80):
                await self.send(k="goto", p=[self.chance.uniform(0, 8), 0, self.chance.uniform(0, 8)])
                await self.socket.send_str(json.dumps({"k": "can", "p": [1, 1, k * 0.05]}))
                await asyncio.sleep(0.025)
            self.answers["costly"] += 1

    async def _seated(self) -> bool:
        status = await self.sit()
        if status != 200:
            self.answers[f"seat {status}"] += 1
            await asyncio.sleep(0.5)
            return False
        await self.connect()
        return True

    async def _closed(self, what: str) -> None:
        with contextlib.suppress(*FAULTS):
            await self.until(lambda: self.close_code is not None, 5.0)
        self.answers[f"{what} {self.close_code}"] += 1


async def siege(link: str, count: int, seconds: float) -> Counter[str]:
    """``count`` hostile clients, for some seconds."""
    answers: Counter[str] = Counter()

    async def one(number: int) -> None:
        async with Hostile(link, number, time.monotonic() + seconds, answers) as client:
            await client.attack()

    await asyncio.gather(*map(one, range(count)))
    return answers


if __name__ == "__main__":
    os.nice(5)  # the players and the server are measured, not how fast somebody can be hostile
    print(json.dumps(asyncio.run(siege(sys.argv[1], int(sys.argv[2]), float(sys.argv[3])))))
