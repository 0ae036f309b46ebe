"""Web server as a process, started by ``h3data play``.

``python -m h3data_play.serve`` reads one JSON object from stdin and reports JSON lines on stdout.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import sqlite3
import ssl
import sys
from typing import Any

import msgspec
from aiohttp import web

from h3data_play.connections import runner_of
from h3data_play.front import SEATS_PER_ADDRESS, WebServer
from h3data_play.plan import PlayPlan
from h3data_play.workers import Refused

LOOPBACK = ("127.0.0.1", "::1", "localhost")
CLOSE_S = 4.5
"""Time after SIGTERM within which recordings are finished [s]."""
LAST_WORDS_S = 1.0
"""Time for which players see the end of the game before the server closes [s]."""


class ServeOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options of a server: its address, its allowed hosts, and its number of workers."""

    host: str = "127.0.0.1"
    port: int = 0
    """Port of the server; 0 takes any free one."""
    workers: int = 1
    cert: str = ""
    key: str = ""
    """Files of a TLS certificate (``cert``) and of its private key (``key``); empty for no TLS."""
    behind_proxy: bool = False
    """True if a proxy in front of the server terminates TLS and forwards the addresses of browsers."""
    seats_per_address: int = SEATS_PER_ADDRESS
    allow_hosts: tuple[str, ...] = ()
    """Names of this server in addition to loopback, ``host`` and those of the certificate."""
    stays: bool = False
    """True if the server continues after the last episode."""

    def front(self, **given: Any) -> WebServer:
        """Return the server of this session; `given` has the options that all kinds of servers share."""
        raise NotImplementedError


class PlayServeOptions(ServeOptions, frozen=True, kw_only=True):
    """Options of the server of one session: its plan, and its number of simultaneous tables."""

    plan: PlayPlan
    tables: int = 1

    def front(self, **given: Any) -> WebServer:
        """Return the server of the session."""
        return WebServer(self.plan, tables=self.tables, **given)


def require_safe(options: ServeOptions) -> None:
    """Check that a server that is reachable from other machines uses TLS or a proxy.

    Raises:
        Refused: the traffic could be read on the network.
    """
    if options.host in LOOPBACK or (options.cert and options.key) or options.behind_proxy:
        return
    raise Refused(
        f"On the address {options.host} others on the network could listen in. Give --cert and --key (TLS), or "
        "--behind-proxy if a proxy in front of this server does TLS; without --host only this machine is served.",
        code="H3-PLAY-023",
    )


def certificate_names(cert: str) -> list[str]:
    """Return the DNS names of the first certificate in a file (subjectAltName).

    Raises:
        Refused: the file has no certificate.
    """
    try:
        # what the ssl module shows of a certificate that it has not verified; it has no public name
        found = ssl._ssl._test_decode_cert(cert)  # type: ignore[attr-defined]
    except (ssl.SSLError, OSError) as fault:
        raise Refused(f"Expected a certificate in PEM format, got {cert} ({fault}).", code="H3-PLAY-024") from None
    return [name for kind, name in found.get("subjectAltName", ()) if kind == "DNS"]


async def serve(options: ServeOptions, report: Any) -> int:
    """Serve until all episodes have ended or a signal arrives; return the exit code."""
    require_safe(options)
    names = certificate_names(options.cert) if options.cert else []
    stops = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        loop.add_signal_handler(number, stops.set)
    with contextlib.suppress(OSError):  # a file as stdin cannot be watched
        loop.add_reader(sys.stdin, _hear, stops)
    is_local = options.host in LOOPBACK
    given = {
        "workers": options.workers,
        "open_door": is_local,
        "secure": bool(options.cert) or options.behind_proxy,
        "report": report,
        "seats_per_address": options.seats_per_address,
        "behind_proxy": options.behind_proxy,
        "hosts": (options.host, *options.allow_hosts, *names),
    }
    front = options.front(**given)
    starting, stopped = asyncio.ensure_future(front.workers.start()), asyncio.ensure_future(stops.wait())
    await asyncio.wait((starting, stopped), return_when=asyncio.FIRST_COMPLETED)
    runner = runner_of(front.application())
    try:
        if starting.done():
            starting.result()
            await _listen(front, runner, options, report)
            waiting = [stopped] if options.stays else [stopped, asyncio.ensure_future(front.done.wait())]
            await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
            if not stops.is_set():
                await asyncio.sleep(LAST_WORDS_S)
    finally:
        starting.cancel()
        await front.workers.stop(CLOSE_S, finish=front.finishes)
        with contextlib.suppress(Exception):
            await runner.cleanup()
        front.journal.close(done=front.done.is_set())
    return 0


def _hear(stops: asyncio.Event) -> None:
    """Set ``stops`` when stdin is closed, because the parent process has gone."""
    if not os.read(sys.stdin.fileno(), 4096):
        asyncio.get_running_loop().remove_reader(sys.stdin)
        stops.set()


async def _listen(front: WebServer, runner: web.AppRunner, options: ServeOptions, report: Any) -> None:
    await runner.setup()
    tls = None
    if options.cert:
        tls = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        tls.load_cert_chain(options.cert, options.key)
    site = web.TCPSite(runner, options.host, options.port, ssl_context=tls)
    try:
        await site.start()
    except OSError as fault:
        raise Refused(
            f"Port {options.port} cannot be used ({fault.strerror}). Choose another with --port.", code="H3-PLAY-025"
        ) from None
    port = runner.addresses[0][1]
    host = f"[{options.host}]" if ":" in options.host else options.host
    base = f"{'https' if tls else 'http'}://{host}:{port}"
    links = [[seat, base + front.link(number)] for number, seat in enumerate(front.plan.seats)]
    report({"ready": {"links": links, "port": port}})


def main(kind: type[ServeOptions]) -> int:
    """Read options of type ``kind`` from stdin and serve with them; return the exit code."""

    def report(message: dict[str, Any]) -> None:
        with contextlib.suppress(OSError):
            sys.stdout.write(msgspec.json.encode(message).decode() + "\n")
            sys.stdout.flush()

    options = msgspec.json.decode(sys.stdin.readline(), type=kind)
    try:
        return asyncio.run(serve(options, report))
    except (Refused, sqlite3.OperationalError) as fault:
        if not isinstance(fault, Refused):
            fault = Refused(
                f"The folder of the session cannot be written ({fault}). Is its disk full?", code="H3-PLAY-029"
            )
        report({"refused": str(fault), "code": fault.code})
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main(PlayServeOptions))
