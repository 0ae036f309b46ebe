"""The server through its sockets: a scripted player finishes the task, seats belong to browsers, nonsense is shown the door."""

from __future__ import annotations

import asyncio
import shutil
import ssl
import subprocess
import sys
from pathlib import Path

import aiohttp
import pytest
from aiohttp import WSCloseCode, web
from aiohttp.test_utils import TestServer
from yarl import URL

from h3data.recording import read_mcap
from h3data_studies.bots.client import Client
from sim_kinematic.tasks.resume import verify
from tests.play.bot import Bot
from tests.play.server import Server


async def free(bot: Bot) -> None:
    """Waits until nothing but keys moves the bot's agent, or it is over."""
    seq = bot.seq - 1
    await bot.until(lambda: bot.states[-1][1] & 4 or (bot.states[-1][5] >= seq and not bot.states[-1][1] & 8), 60)


async def play_to_success(link: str) -> Bot:
    async with Bot(link) as bot:
        assert await bot.sit() == 200
        await bot.connect()
        await bot.until(lambda: bot.states)
        for k, goal in enumerate(bot.manifest["goals"]):
            await bot.send(k="move", f=0.4, t=0.5)
            await asyncio.sleep(0.3)
            await bot.send(k="move", f=0, t=0)
            await bot.send(k="pick", o=k, lead=True)
            await free(bot)
            await bot.send(k="place", p=goal["position"], lead=True)
            await free(bot)
        await bot.until(lambda: bot.heard("over"))
    return bot


@pytest.mark.slow
def test_a_player_finishes_the_task_and_the_recording_verifies(tmp_path: Path):
    with Server(tmp_path / "rec", speed=4.0) as server:
        bot = asyncio.run(play_to_success(server.links[0]))
        over = server.report()["over"]
        assert server.process.wait(10) == 0, "it ends after the last episode"
    assert bot.heard("over") == [{"ended": "success", "text": "Done. Thank you!", "next": False}]
    assert bot.heard("hud")[0]["task"].startswith("Bring the ")
    steps = [head[4] for head in bot.states]
    assert steps == sorted(set(steps))
    path = tmp_path / "rec" / "000000.mcap"
    assert over["path"] == str(path)
    recording = read_mcap(path)
    assert len(recording) == over["steps"] == steps[-1]
    assert verify(recording).difference is None
    assert not list(tmp_path.glob("rec/*.part"))
    assert bot.acked, "pages measure their lag by it"


async def seats(link: str) -> None:
    async with Bot(link) as bot, Bot(link) as stranger:
        assert await bot.sit() == 200
        cookie = next(iter(bot.http.cookie_jar))
        assert cookie["httponly"]
        assert cookie["samesite"] == "Strict"
        first = bot.address
        assert await bot.sit() == 200, "a reload"
        assert bot.address == first
        assert await stranger.sit() == 409
        with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
            await stranger.http.ws_connect(first)
        with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
            await bot.http.ws_connect(first, origin="http://evil.example")
        async with bot.http.post(link + "api/session", json={}, headers={"Origin": "http://evil.example"}) as answer:
            assert answer.status == 403
            assert "default-src 'self'" in answer.headers["Content-Security-Policy"]
        async with bot.http.post(link + "api/session", data="x" * 100_000) as answer:
            assert answer.status in (413, 415)
        async with bot.http.get(link + "world/nothing.glb") as answer:
            assert answer.status == 404
        for path in ("../front.py", "assets/../../front.py", "%2e%2e/front.py"):
            async with bot.http.get(link + path) as answer:
                assert answer.status == 404
        async with bot.http.get(link + bot.glb) as answer:
            assert (await answer.read())[:4] == b"glTF"
        await bot.connect()
        await bot.until(lambda: bot.states)
        other = Bot(link)
        other.http, other.address = bot.http, first
        await other.connect()
        await bot.until(lambda: bot.close_code == 4001)
        await other.until(lambda: other.states)
        for text, code in (
            ("{", 1003),
            ('{"k":"leave","x":' + "[" * 1000, 1003),
            ('{"k":"move","f":1e300}', 1003),
            ("x" * 5000, 1009),
        ):
            await other.socket.send_str(text)
            await other.until(lambda other=other: other.close_code)
            assert other.close_code == code
            other.close_code = None
            await other.connect()
            await other.until(lambda other=other: not other.socket.closed)
        await other.socket.send_bytes(b"x")
        await other.until(lambda: other.close_code == 1003)
        other.close_code = None
        await other.connect()
        for _ in range(400):
            if not other.socket.closed:
                await other.socket.send_str('{"k":"move","f":0.1}')
        await other.until(lambda: other.close_code == 1008)


async def connects_again() -> None:
    """A scripted browser that connects twice and leaves, at a server that only counts."""
    closed: list[bool] = []

    async def play(request: web.Request) -> web.WebSocketResponse:
        socket, number = web.WebSocketResponse(), len(closed)
        closed.append(False)
        await socket.prepare(request)
        async for _ in socket:
            pass
        closed[number] = socket.close_code == WSCloseCode.OK
        return socket

    app = web.Application()
    app.router.add_get("/", play)
    async with TestServer(app) as server, Client(str(server.make_url("/"))) as client:
        client.address, client.manifest = client.link, {"objects": [], "joints": []}
        await client.connect()
        first = client.socket
        await client.connect()
        assert closed == [True, False]
        assert first.closed
        assert client.close_code is None, "that of the new socket"
        second = client.socket
    assert second.closed
    assert closed == [True, True]


def test_a_scripted_browser_that_connects_again_closes_its_first_socket():
    asyncio.run(connects_again())


@pytest.mark.slow  # a server of several processes
def test_seats_belong_to_browsers_and_nonsense_is_shown_the_door(tmp_path: Path):
    with Server(tmp_path / "rec") as server:
        asyncio.run(seats(server.links[0]))
        assert server.stop() == 0
    recording = read_mcap(tmp_path / "rec" / "000000.mcap")
    assert recording.episode.info["ended"] == "closed"
    assert verify(recording).difference is None


def test_the_front_imports_nothing_heavy():
    code = (
        "import sys, h3data_play.serve; print([m for m in ('numpy', 'numba', 'torch', 'pyarrow', 'h3data', "
        "'sim_kinematic') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


def test_other_addresses_need_tls(tmp_path: Path):
    with Server(tmp_path / "rec", {"host": "0.0.0.0"}) as server:
        assert "--cert and --key" in server.reports[0]["refused"]
        assert server.process.wait(10) == 2


@pytest.mark.slow
def test_a_certificate_serves_other_addresses_over_https_alone(tmp_path: Path):
    openssl = shutil.which("openssl")
    if openssl is None:
        pytest.skip("there is no openssl to make a certificate with")
    cert, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    made = [
        openssl,
        "req",
        "-x509",
        "-newkey",
        "ec",
        "-pkeyopt",
        "ec_paramgen_curve:prime256v1",
        "-nodes",
        "-days",
        "2",
    ]
    names = ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1"]
    subprocess.run([*made, *names, "-keyout", key, "-out", cert], check=True, capture_output=True)
    with Server(tmp_path / "rec", {"host": "0.0.0.0", "cert": str(cert), "key": str(key)}) as server:
        assert server.links[0].startswith("https://0.0.0.0:")
        link = server.links[0].replace("0.0.0.0", "127.0.0.1")
        assert "/s/" in link, "with a secret: others can reach it"
        asyncio.run(_seated_over_tls(link, ssl.create_default_context(cafile=cert)))


async def _seated_over_tls(link: str, trusted: ssl.SSLContext) -> None:
    async with Bot(link) as bot:
        await bot.http.close()
        connector = aiohttp.TCPConnector(ssl=trusted)
        bot.http = aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True), connector=connector)
        assert await bot.sit() == 200
        assert all(cookie["secure"] for cookie in bot.http.cookie_jar)
        await bot.connect()
        await bot.until(lambda: bot.states)
        await bot.socket.close()
    reader, writer = await asyncio.open_connection("127.0.0.1", URL(link).port)
    writer.write(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
    assert await reader.read() == b"", "nothing is said without TLS"
    writer.close()
    async with aiohttp.ClientSession() as stranger:  # a browser that does not know the certificate
        with pytest.raises(aiohttp.ClientConnectorCertificateError):
            await stranger.get(link)


def test_a_plan_that_cannot_be_played_says_why(tmp_path: Path):
    with Server(tmp_path / "rec", partner="nobody") as server:
        assert server.reports[0]["refused"].startswith("Unknown policy 'nobody'")
