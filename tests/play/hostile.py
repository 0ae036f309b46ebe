"""Clients that try all kinds of things, as a process of their own: ``python -m tests.play.hostile LINK COUNT SECONDS``
prints how often which answer came. With the ids of participants behind (``ID,ID``) the link is that of a study; answers that
begin with ``IN`` are of those who got what is somebody else's."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import os
import random
import sys
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, Self
from urllib.parse import urlsplit

import aiohttp

from h3data_studies.bots.client import Client
from h3data_studies.bots.participant import DEVICE

FAULTS = (aiohttp.ClientError, ConnectionError, TimeoutError, OSError)


class Hostile(Client):
    """One of them."""

    def __init__(self, link: str, number: int, end: float, answers: Counter[str]) -> None:
        super().__init__(link)
        self.number, self.end, self.answers = number, end, answers
        self.chance = random.Random(number)

    async def attack(self) -> None:
        """Goes on until the end, then lets go of everything."""
        kinds = self.kinds()
        while time.monotonic() < self.end:
            with contextlib.suppress(*FAULTS):
                await kinds[self.number % len(kinds)]()
            await asyncio.sleep(0.05)

    def kinds(self) -> list[Callable[[], Awaitable[None]]]:
        """What they do, one thing each."""
        return [
            self.huge_request,
            self.strange_socket,
            self.wrong_token,
            self.noise,
            self.half_a_request,
            self.nonsense,
            self.flood,
            self.giant,
            self.slow_reader,
            self.costly,
        ]

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


class HostileToStudy(Hostile):
    """One of them who comes to a study."""

    pids: Sequence[str] = ()
    """Ids of others, who take part."""
    joined = False

    async def __aenter__(self) -> Self:
        await super().__aenter__()
        await self.http.close()
        connector = aiohttp.TCPConnector(local_addr=(f"127.6.6.{self.number % 5 + 1}", 0))  # five network addresses
        self.http = aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True), connector=connector)
        return self

    def kinds(self) -> list[Callable[[], Awaitable[None]]]:
        own = [self.steal, self.guess, self.invent, self.at_once, self.rebind, self.nest, self.half_open, self.no_pong]
        return [*own, *super().kinds()]

    async def _post(self, path: str, body: Any = None, **headers: str) -> tuple[int, dict[str, Any]]:
        async with self.http.post(self.link + path, json=body or {}, headers=headers) as answer:
            return answer.status, await answer.json() if answer.status == 200 else {}

    def _note(self, what: str, status: int, view: dict[str, Any]) -> None:
        self.answers[f"{'IN ' if view.get('participant') else ''}{what} {status}"] += 1

    async def steal(self) -> None:
        """Acts as somebody whose id is known."""
        ids = {"PROLIFIC_PID": self.chance.choice(self.pids)}
        for path, body in (
            ("api/study", {"ids": ids}),
            ("api/study/consent", {"accept": True, "hash": "x", "ids": ids}),
            ("api/study/withdraw", {"ids": ids}),
            ("api/study/form", {"form": "nasa_tlx", "block": 1, "answers": {}}),
            ("api/study/pause", {"paused": True, "block": 1, "trial": 1}),
            ("api/session", {"block": 1, "trial": 1}),
        ):
            self._note("steal", *await self._post(path, body))

    async def guess(self) -> None:
        """Links by which somebody goes on in another browser."""
        code = base64.urlsafe_b64encode(self.chance.randbytes(24)).decode()
        self._note("guess", *await self._post("api/study", {"rejoin": code}))

    async def invent(self) -> None:
        """A new participant each time, without a check of the computer."""
        self.http.cookie_jar.clear()
        status = await self._consent()
        self.answers[f"invent {status}"] += 1

    async def at_once(self) -> None:
        self.http.cookie_jar.clear()
        for status in await asyncio.gather(*(self._consent() for _ in range(4))):
            self.answers[f"at once {status}"] += 1

    async def _consent(self) -> int:
        ids = {"PROLIFIC_PID": self.chance.randbytes(12).hex()}
        _, view = await self._post("api/study", {"ids": ids})
        given = {"accept": True, "hash": view.get("stage", {}).get("hash", ""), "ids": ids}
        return (await self._post("api/study/consent", given))[0]

    async def rebind(self) -> None:
        """As a page of another site whose name leads here."""
        evil = {"Host": "evil.example", "Origin": "http://evil.example"}
        for path in ("api/study", "api/session", "api/study/withdraw"):
            status, _ = await self._post(path, **evil)
            self.answers[f"{'IN ' if status == 200 else ''}rebind {status}"] += 1

    async def nest(self) -> None:
        for path in ("api/study", "api/study/form", "api/session"):
            text = {"data": "[" * 1000, "headers": {"Content-Type": "application/json"}}
            async with self.http.post(self.link + path, **text) as answer:
                self.answers[f"nest {answer.status}"] += 1

    async def half_open(self) -> None:
        """Connections on which nothing more comes."""
        texts = (b"", b"GET / HT", b"POST /api/study HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\n{")
        opened = [await self._raw() for _ in range(12)]
        for k, (_, writer) in enumerate(opened):
            writer.write(texts[k % len(texts)])
        await asyncio.sleep(max(0.0, min(35.0, self.end - time.monotonic())))
        self.answers["half open"] += sum(reader.at_eof() for reader, _ in opened)
        for _, writer in opened:
            writer.close()

    async def no_pong(self) -> None:
        """A socket in the own seat that answers no ping."""
        if await self._seated():
            await self.close()
            socket = await self.http.ws_connect(self.address, autoping=False)
            await asyncio.sleep(max(0.0, min(20.0, self.end - time.monotonic())))
            self.answers["no pong"] += 1
            await socket.close()

    async def _seated(self) -> bool:
        if not self.joined:
            self.joined = await self._consent() == 200 and (await self._post("api/study/device", DEVICE))[0] == 200
            if not self.joined:
                self.answers["no place"] += 1
                await asyncio.sleep(2.0)
                return False
        return await super()._seated()


async def siege(link: str, count: int, seconds: float, pids: Sequence[str] = ()) -> Counter[str]:
    """``count`` hostile clients, for some seconds; ``pids`` are ids of others in a study."""
    answers: Counter[str] = Counter()

    async def one(number: int) -> None:
        kind = HostileToStudy if pids else Hostile
        async with kind(link, number, time.monotonic() + seconds, answers) as client:
            if isinstance(client, HostileToStudy):
                client.pids = pids
            await client.attack()

    await asyncio.gather(*map(one, range(count)))
    return answers


if __name__ == "__main__":
    os.nice(5)  # the players and the server are measured, not how fast somebody can be hostile
    ids = sys.argv[4].split(",") if len(sys.argv) > 4 else ()
    print(json.dumps(asyncio.run(siege(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), ids))))
