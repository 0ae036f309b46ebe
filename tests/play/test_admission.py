"""Who may sit down: by what a worker's games cost, and how many seats an address has; and what is refused at the door."""

from __future__ import annotations

import asyncio
import contextlib
import subprocess
import time
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import aiohttp
import msgspec
import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer, make_mocked_request
from aiohttp.web import HTTPServiceUnavailable

from h3data.errors import InputError
from h3data_play import connections
from h3data_play import front as fronts
from h3data_play.commands.playing import Play
from h3data_play.connections import Live, is_known
from h3data_play.front import AWAY_S, LOADING_S, WebServer
from h3data_play.messages import Ping, decode
from h3data_play.plan import PlayPlan
from h3data_play.seats import SeatLog
from h3data_play.serve import certificate_names
from h3data_play.worker import LEFT_S, REPORT_S, Running, Worker
from h3data_play.workers import EXPECTED_SHARE, Refused, WorkerProcess
from h3data_studies.bots.client import Client
from tests.play.bot import Bot
from tests.play.server import Server


def worker(busy: float, measured: int, games: int, left: int = 0) -> WorkerProcess:
    found = WorkerProcess.__new__(WorkerProcess)
    found.busy, found.measured, found.left, found.games = busy, measured, left, {str(k) for k in range(games)}
    return found


@pytest.fixture
def front(tmp_path: Path) -> WebServer:
    plan = PlayPlan(app="rearrange", out=str(tmp_path), seats=("person",))

    async def made() -> WebServer:
        return WebServer(plan, tables=50, behind_proxy=True, seats_per_address=2)

    return asyncio.run(made())


@pytest.mark.parametrize(
    ("games", "expected"),
    [
        ((0.0, 0, 0), EXPECTED_SHARE),
        ((0.6, 10, 10), 0.66),
        ((0.6, 10, 12), 0.78),  # two have begun since it was measured
        ((0.03, 1, 1), 0.06),
        ((0.06, 1, 9, 8), 0.12),  # eight games whose players have left
        ((0.0, 0, 9, 9), EXPECTED_SHARE),
    ],
)
def test_a_worker_knows_what_a_further_game_would_make(games: tuple[Any, ...], expected: float):
    assert worker(*games).with_one_more == pytest.approx(expected)


def test_a_worker_takes_games_up_to_a_share_of_a_core(front: WebServer):
    front.workers.active = [worker(0.69, 10, 10), worker(0.6, 10, 10)]
    front._require_capacity()
    front.workers.active = [worker(0.69, 10, 10), worker(0.65, 10, 10)]
    with pytest.raises(HTTPServiceUnavailable, match="Service Unavailable"):
        front._require_capacity()


def test_an_address_has_few_seats(front: WebServer):
    def request(forwarded: str) -> object:
        return make_mocked_request("POST", "/api/session", headers={"X-Forwarded-For": forwarded})

    for k, forwarded in enumerate(("1.1.1.1", "9.9.9.9, 1.1.1.1")):  # what a client claims stands first
        front._require_room_at(request(forwarded))  # type: ignore[arg-type]
        front._note_address(request(forwarded), front.journal.sit(f"t{k}", k, 0))  # type: ignore[arg-type]
    with pytest.raises(HTTPServiceUnavailable):
        front._require_room_at(request("1.1.1.1"))  # type: ignore[arg-type]
    front._require_room_at(request("2.2.2.2"))  # type: ignore[arg-type]
    game = front.journal.begin(0)
    front.journal.assign(next(iter(front.journal.seats.values())), game)
    front.journal.end(game, "success")
    front._require_room_at(request("1.1.1.1"))  # type: ignore[arg-type]
    front.behind_proxy = False
    assert front._address(SimpleNamespace(headers={"X-Forwarded-For": "1.1.1.1"}, remote="3.3.3.3")) == "3.3.3.3"  # type: ignore[arg-type]


async def five(link: str) -> list[int]:
    statuses = []
    clients = [Client(link) for _ in range(5)]
    for client in clients:
        await client.__aenter__()
        statuses.append(await client.sit())
    assert "network address" in clients[-1].told[-1]["refused"]
    assert await clients[0].sit() == 200, "who has a seat keeps it"
    for client in clients:
        await client.__aexit__()
    return statuses


@pytest.mark.slow
def test_the_server_refuses_a_fifth_seat_of_an_address_that_may_have_four(tmp_path: Path):
    options = {"tables": 20, "seats_per_address": 4}
    with Server(tmp_path / "rec", options, episodes=20, app="social_nav", partner="rollout_expert") as server:
        assert asyncio.run(five(server.links[0])) == [200, 200, 200, 200, 503]


# --- what a browser sends, at a server whose worker only counts -------------------------------------------------------
class Table:
    """The server of one game in this process, and a browser that has its seat."""

    def __init__(self, folder: Path, **options: Any) -> None:
        self.front = WebServer(PlayPlan(app="rearrange", out=str(folder), seats=("person",)), **options)
        self.heard: list[str] = []
        journal = self.front.journal
        self.seat, self.game = journal.sit("token", 0, 0), journal.begin(0)
        journal.assign(self.seat, self.game)
        worker = SimpleNamespace(send=lambda kind, key, body: self.heard.append(kind), is_stuck=False)
        begun = asyncio.get_running_loop().create_future()
        begun.set_result({"manifest": {}, "glb": "", "agents": [0]})
        self.front.lives[self.game.key] = Live(self.game, worker, begun)  # type: ignore[arg-type]
        self.http: aiohttp.ClientSession
        self.link = self.said = ""

    @property
    def cookies(self) -> dict[str, str]:
        return {"Cookie": f"{self.front._cookie(0)}=token"}

    async def status(self, method: str, path: str, headers: dict[str, str] | None = None, data: str = "{}") -> int:
        """Of an answer; a socket that opens has 101."""
        given = {"Content-Type": "application/json", **self.cookies, **(headers or {})}
        async with self.http.request(method, self.link + path, headers=given, data=data) as answer:
            self.said = await answer.text()
            return answer.status

    async def socket(self, headers: dict[str, str]) -> int:
        """Status with which a socket is refused; 101 if it opens, to send ``leave``."""
        try:
            async with self.http.ws_connect(
                f"{self.link}play/{self.seat.sid}", headers={**self.cookies, **headers}
            ) as socket:
                await socket.send_str('{"k":"leave"}')
                await asyncio.sleep(0.05)
        except aiohttp.WSServerHandshakeError as fault:
            return fault.status
        return 101

    async def closed_by(self, text: str) -> int | None:
        """Code with which the server closes the socket after a message."""
        async with self.http.ws_connect(f"{self.link}play/{self.seat.sid}", headers=self.cookies) as socket:
            await socket.send_str(text)
            await socket.send_str('{"k":"leave"}')
            async for _ in socket:
                pass
            return socket.close_code


def at_a_table(folder: Path, what: Callable[[Table], Awaitable[None]], **options: Any) -> None:
    async def main() -> None:
        table = Table(folder, **options)
        async with TestServer(table.front.application()) as server, aiohttp.ClientSession() as table.http:
            table.link = str(server.make_url("/"))
            await what(table)

    asyncio.run(main())


NESTED = ("[" * 1000, "[" * 30_000, '{"a":' * 1000, '{"x":' + "[" * 900 + "]" * 900 + "}")


def test_nested_json_is_malformed_and_the_seat_goes_on(tmp_path: Path):
    async def what(table: Table) -> None:
        for text in NESTED:
            assert await table.status("POST", "api/session", data=text) == 400
            assert "not what was expected" in table.said
        for depth in (800, 1500):
            assert await table.closed_by('{"k":"leave","x":' + "[" * depth + "]" * depth + "}") == 1003
        assert "input" not in table.heard
        assert await table.status("POST", "api/session") == 200
        async with table.http.ws_connect(f"{table.link}play/{table.seat.sid}", headers=table.cookies) as socket:
            await socket.send_str('{"k":"leave"}')
            while "input" not in table.heard:
                await asyncio.sleep(0.01)

    at_a_table(tmp_path, what)


@pytest.mark.parametrize("text", ['"' + "[" * 900 + '"', '"\\"' + "[" * 900 + '"', "[" + "[]," * 900 + "[]]"])
def test_brackets_in_texts_and_beside_each_other_are_not_nested(text: str):
    assert decode('{"k":"ping","ct":1,"x":' + text + "}") == Ping(ct=1.0)


def test_whether_json_is_nested_is_found_in_linear_time():
    began = time.monotonic()
    for text in ("[" * 40 + '"\\' * 200_000, "[" * 40 + '\\"' * 200_000, '"' + "\\" * 400_000 + "[" * 40):
        with pytest.raises(msgspec.MsgspecError):
            decode(text)
    assert time.monotonic() - began < 1.0


# --- by which names the server is known -------------------------------------------------------------------------------
ALLOWED = ("study.example.org", "*.lab.example")


def as_page_of(host: str) -> dict[str, str]:
    return {"Host": host, "Origin": f"http://{host}"}


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:8080", "localhost.evil.example", "127.0.0.1.evil.example"]
)
def test_a_name_that_leads_here_without_being_the_servers_gets_nothing(tmp_path: Path, host: str):
    async def what(table: Table) -> None:
        paths = ("", "index.html", "world/a.glb", "nothing/at/all", "api/nothing", f"play/{table.seat.sid}")
        for method, path in [*(("GET", path) for path in paths), ("POST", "api/session")]:
            assert await table.status(method, path, as_page_of(host)) == 421, path
            name = host.partition(":")[0]
            assert table.said == (
                f"This server is not known as {name}; if that is one of its names, start it with --allow-host {name}."
            )
        assert not table.http.cookie_jar
        assert await table.socket(as_page_of(host)) == 421
        assert table.heard == [], "nobody has left"
        assert await table.socket({}) == 101
        assert table.heard == ["here", "input", "here"]

    at_a_table(tmp_path, what, hosts=ALLOWED)


@pytest.mark.parametrize(
    "host", ["study.example.org", "Study.Example.ORG.:84", "a.lab.example", "localhost:1", "[::1]:80", "10.1.1.7"]
)
def test_names_of_the_server_and_addresses_get_in_at_any_port(tmp_path: Path, host: str):
    async def what(table: Table) -> None:
        assert await table.status("POST", "api/session", as_page_of(host)) == 200
        assert await table.socket(as_page_of(host)) == 101
        assert "input" in table.heard
        assert await table.status("POST", "api/session", {"Host": host, "Origin": "http://10.0.0.8"}) == 403

    at_a_table(tmp_path, what, hosts=ALLOWED)


@pytest.mark.parametrize(
    "name",
    ["lab.example", "a.b.lab.example", "example.org", "xstudy.example.org", "example", "2130706433", "127.1", ""],
)
def test_names_like_those_of_the_server_are_not_known(name: str):
    assert not is_known(name, ALLOWED)


def test_a_host_header_that_names_nothing_is_refused(tmp_path: Path):
    async def what(table: Table) -> None:
        for host in ("", ":80", "user@localhost", "[::1", "localhost/evil.example", "l\u00f6calhost"):
            assert await table.status("GET", "", {"Host": host}) in (400, 421), host

    at_a_table(tmp_path, what)


def test_the_names_of_a_certificate_are_read_from_it(tmp_path: Path):
    cert = tmp_path / "cert.pem"
    names = "subjectAltName=DNS:study.example.org,DNS:*.lab.example,IP:192.168.1.20"
    command = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    command += ["-keyout", str(tmp_path / "key.pem"), "-out", str(cert), "-subj", "/CN=x", "-addext", names]
    subprocess.run(command, check=True, capture_output=True)
    assert certificate_names(str(cert)) == ["study.example.org", "*.lab.example"]
    cert.write_text("none")
    with pytest.raises(Refused, match=r"cert\.pem") as refused:
        certificate_names(str(cert))
    assert refused.value.code == "H3-PLAY-024"


def test_commands_pass_further_names_to_the_server():
    assert Play("rearrange", allow_hosts=("a.example", "*.b.example"))._serving()["allow_hosts"] == [
        "a.example",
        "*.b.example",
    ]
    for wrong in ("https://a.example", "a.example:80", "*", "a..example", ""):
        with pytest.raises(InputError, match="H3-PLAY-012"):
            Play("rearrange", allow_hosts=(wrong,))._serving()


async def statuses(link: str, hosts: Sequence[str]) -> list[int]:
    async with aiohttp.ClientSession() as http:
        answers = [await http.get(link, headers={"Host": host}) for host in hosts]
        return [answer.status for answer in answers]


@pytest.mark.slow
def test_the_server_goes_by_the_names_that_it_is_given(tmp_path: Path):
    with Server(tmp_path / "rec", {"allow_hosts": ["study.example.org"], "host": "localhost"}) as server:
        assert asyncio.run(statuses(server.links[0], ("study.example.org", "localhost", "evil.example"))) == [
            200,
            200,
            421,
        ]


# --- seats that nobody is connected to --------------------------------------------------------------------------------
class Clock:
    """A clock that is set by hand."""

    now = 1e5

    def __call__(self) -> float:
        return self.now


@pytest.mark.parametrize("open_door", [False, True])
def test_a_seat_that_nobody_is_connected_to_can_be_taken_over(tmp_path: Path, open_door: bool):
    clock = Clock()

    async def what(table: Table) -> None:
        link = table.link if open_door else f"{table.link}s/{table.front.journal.links[0]}/"
        async with Bot(link) as first, Bot(link) as second:
            clock.now += AWAY_S
            assert await first.sit() == 200, "whoever had the seat is not connected"
            assert await second.sit() == 409, "the home is loading there"
            await first.connect()
            assert await second.sit() == 409
            assert "Close the page there" in second.told[-1]["refused"]
            assert await first.sit() == 200
            await first.close()
            clock.now += LOADING_S - 1
            assert await second.sit() == 409, "the page is loaded again"
            await first.connect()
            await first.close()
            await asyncio.sleep(0.05)
            if open_door:
                assert await second.sit() == 409, "a connection may be lost for a moment"
                clock.now += AWAY_S
            assert await second.sit() == 200
            await second.connect()
            assert len(table.front.journal.seats) == 1
            assert await first.sit() == 409
            await first.connect()
            await first.until(lambda: first.close_code == 4001)
            assert second.close_code is None
            again = SeatLog(tmp_path)
            assert again.seats.keys() == table.front.journal.seats.keys()
            assert again.seats[second.address.rpartition("/")[2]].game == table.game.key, "the episode goes on"

    at_a_table(tmp_path, what, clock=clock, open_door=open_door)


# --- connections on which nothing happens -----------------------------------------------------------------------------
@pytest.mark.slow
def test_half_open_connections_are_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(connections, "IDLE_S", 0.5)
    monkeypatch.setattr(connections, "ANSWER_S", 0.5)
    monkeypatch.setattr(connections, "LINGER_S", 0.5)
    monkeypatch.setattr(fronts, "BODY_S", 0.5)
    monkeypatch.setattr(fronts, "PING_S", 0.4)

    async def main() -> None:
        table = Table(tmp_path)
        table.front.preparer.files["home.glb"] = bytes(30_000_000), "model/gltf-binary"
        runner = connections.runner_of(table.front.application())
        await runner.setup()
        await web.TCPSite(runner, "127.0.0.1", 0).start()
        port = runner.addresses[0][1]
        host, cookie = f"Host: localhost:{port}\r\n", f"Cookie: {table.cookies['Cookie']}\r\n"

        async def raw(text: str, *, slowly: bool = False, reads: bool = True) -> float:
            """Sends something and waits for the end; returns after how long it came."""
            reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=1024)
            begun = time.monotonic()
            with contextlib.suppress(ConnectionError):
                for byte in text if slowly else ():
                    writer.write(byte.encode())
                    await asyncio.sleep(0.05)
                writer.write(b"" if slowly else text.encode())
                while reads and await reader.read(100):
                    pass
                while not reads and runner.server.connections:  # type: ignore[union-attr]
                    await asyncio.sleep(0.05)
            writer.close()
            return time.monotonic() - begun

        get = f"GET /world/home.glb HTTP/1.1\r\n{host}"
        post = f"POST /api/session HTTP/1.1\r\n{host}{cookie}Content-Type: application/json\r\nContent-Length: 100\r\n\r\n{{"
        upgrade = (
            f"GET /play/{table.seat.sid} HTTP/1.1\r\n{host}{cookie}Upgrade: websocket\r\nConnection: Upgrade\r\n"
            "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        )
        cases = [raw(""), raw("POST /api/ses"), raw("GET /" + "a" * 20, slowly=True), raw(post), raw(upgrade)]
        taken = await asyncio.wait_for(asyncio.gather(*cases), 8.0)
        for seconds in [*taken, await asyncio.wait_for(raw(f"{get}\r\n", reads=False), 5.0)]:
            assert seconds < 5.0
        assert table.heard == ["here", "here"], "the player came and went"
        async with (
            aiohttp.ClientSession(headers=table.cookies) as http,
            http.ws_connect(f"http://localhost:{port}/play/{table.seat.sid}") as socket,
        ):
            with pytest.raises(TimeoutError):  # one that answers pings stays
                await asyncio.wait_for(socket.receive(), 1.5)  # its own limit begins anew with each ping
            assert not socket.closed
        await runner.cleanup()

    asyncio.run(main())


def test_games_whose_players_have_left_take_no_capacity():
    letters: list[dict[str, Any]] = []
    here = Worker.__new__(Worker)
    here.channel = SimpleNamespace(send=lambda kind, key, body: letters.append(body))  # type: ignore[assignment]
    here.period, here._reported = 0.1, -REPORT_S
    here.games = {}
    for key, present, ago in (("plays", True, 0.0), ("away", False, LEFT_S / 2), ("left", False, 2 * LEFT_S)):
        running = Running(key, SimpleNamespace(drivers={0: None}, ended=""))  # type: ignore[arg-type]
        running.here, running.stepped = {0} if present else set(), time.monotonic() - ago
        running.latest_s.append(0.004)
        here.games[key] = running
    here.report()
    assert letters == [{"busy": pytest.approx(0.08), "games": 2, "left": 1}]
