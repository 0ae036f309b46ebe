"""WebSocket connections of the front process, and common handling of its HTTP requests."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import json
import re
import socket
import struct
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from aiohttp import web

from h3data_play.seats import Game
from h3data_play.workers import WorkerProcess

QUEUE = 90
"""Largest number of states that wait for a slow client; older states are dropped, because each state is complete except
for objects at rest."""
SEND_S = 20.0
IDLE_S, BODY_S, LINGER_S, ANSWER_S, PING_S = 30.0, 20.0, 2.0, 60.0, 10.0
"""Time limits of a connection [s].

A connection is closed when no request comes within ``IDLE_S``, when a request is not complete within ``BODY_S`` (and
``LINGER_S``, so that the client can read the reason), when the client reads nothing of an answer for ``ANSWER_S``, or
when a WebSocket answers no ping within one and a half times ``PING_S``.
"""
_HOST = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(?::[0-9]*)?")
"""A Host header: a name or address, in brackets if it is one of IPv6, and a port."""
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; connect-src 'self' blob: ws: wss:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}


@dataclass(eq=False)
class Live:
    """Game that runs on a worker, with the connections of its players."""

    game: Game
    worker: WorkerProcess
    begun: asyncio.Future[dict[str, Any]]
    sockets: dict[str, Connection] = field(default_factory=dict)
    """Connections of the connected players, by seat."""
    beginning: asyncio.Task[None] | None = None
    """Task that waits until the episode has been prepared; None if the game has started."""


class Connection:
    """WebSocket of one seat, with its queue of outgoing messages."""

    def __init__(self, socket: web.WebSocketResponse, agent: int, heard: float = 0.0) -> None:
        """Create a connection; ``heard`` is the time of the last message by the clock of the front process."""
        self.socket, self.agent = socket, agent
        self.heard = heard
        """Time of the last message other than pings."""
        self._texts: deque[str] = deque()
        self._states: deque[bytes] = deque(maxlen=QUEUE)
        self._news = asyncio.Event()
        self._ends = False

    def state(self, data: bytes) -> None:
        """Queue a state, dropping the oldest one if the client is slow."""
        self._states.append(data)
        self._news.set()

    def tell(self, message: dict[str, Any]) -> None:
        """Queue a text frame."""
        self._texts.append(json.dumps(message))
        self._news.set()

    def end(self) -> None:
        """Close the connection after all queued messages have been sent."""
        self._ends = True
        self._news.set()

    async def send(self) -> None:
        """Send queued messages until the connection is closed."""
        while True:
            await self._news.wait()
            self._news.clear()
            async with asyncio.timeout(SEND_S):
                while self._states or self._texts:
                    if self._states:
                        await self.socket.send_bytes(self._states.popleft())
                    if self._texts and not self._states:
                        await self.socket.send_str(self._texts.popleft())
            if self._ends:
                await self.socket.close()
                return


class Failed(Exception):
    """Error for a game that could not start."""


class Stuck(Failed):
    """Error for a game that cannot start yet and will be started later; the text is for players."""


def runner_of(app: web.Application) -> web.AppRunner:
    """Return the runner that serves an application and closes idle connections."""
    return web.AppRunner(app, access_log=None, shutdown_timeout=0.5, keepalive_timeout=IDLE_S, lingering_time=LINGER_S)


def pong(client_ms: float) -> bytes:
    """Return the message that answers a client's ping, with the clocks of client and server [ms]."""
    return struct.pack("<B7xdd", 2, client_ms, time.monotonic() * 1e3)


def require_own_origin(request: web.Request) -> None:
    """Refuse a request that a page of another site makes with a player's cookies.

    Requests without an Origin header come from programs, which have no cookies to misuse.
    """
    origin = request.headers.get("Origin")
    if origin is not None and origin.partition("://")[2] != request.host:
        raise web.HTTPForbidden(text="This request comes from another site.")


def is_known(name: str, names: Iterable[str]) -> bool:
    """Return whether a host name belongs to the server.

    Args:
        name: Host name, without port.
        names: Names of the server in addition to loopback. ``*.example.org`` accepts any single label in place of
            ``*``.
    """
    name = name.lower().rstrip(".")
    try:
        ipaddress.ip_address(name)
    except ValueError:
        known = {given.lower().rstrip(".") for given in names} | {"localhost"}
        return name in known or f"*.{name.partition('.')[2]}" in known
    return True  # nobody can make an address lead elsewhere, as the owner of a name can (DNS rebinding)


def require_known_host(names: Iterable[str]) -> Any:
    """Return a middleware that refuses requests to host names that are not the server's.

    Otherwise a page of another site whose name resolves to this machine could use the player's cookies (DNS rebinding).
    """
    known = tuple(names)

    @web.middleware
    async def middleware(request: web.Request, handler: Any) -> web.StreamResponse:
        found = _HOST.fullmatch(request.headers.get("Host", ""))
        if found is None:
            raise web.HTTPMisdirectedRequest(text="The request's Host header names no host.")
        name = found[1].strip("[]")
        if not is_known(name, known):
            raise web.HTTPMisdirectedRequest(
                text=f"This server is not known as {name[:253]}; if that is one of its names, start it with "
                f"--allow-host {name[:253]}."
            )
        return await handler(request)

    return middleware


@web.middleware
async def strict(request: web.Request, handler: Any) -> web.StreamResponse:
    """Add security headers to all answers, and drop clients that do not read their answers (a middleware)."""
    found = None if request.transport is None else request.transport.get_extra_info("socket")
    if found is not None and hasattr(socket, "TCP_USER_TIMEOUT"):  # whoever takes nothing of the answer is hung up on
        with contextlib.suppress(OSError):
            found.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(ANSWER_S * 1e3))
    try:
        response = await handler(request)
    except web.HTTPException as error:
        error.headers.update(HEADERS)
        raise
    if not response.prepared:
        response.headers.update(HEADERS)
    return response
