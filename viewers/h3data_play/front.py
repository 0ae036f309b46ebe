"""Web server for browsers, with the page, the seats and the WebSockets.

It simulates nothing and imports neither NumPy nor numba.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import ipaddress
import math
import sqlite3
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
from aiohttp import WSCloseCode, WSMsgType, web

from h3data_play.connections import (
    BODY_S,
    PING_S,
    Connection,
    Failed,
    Live,
    Stuck,
    pong,
    require_known_host,
    require_own_origin,
    strict,
)
from h3data_play.messages import MOST_BYTES, Can, Ping, decode, read_json
from h3data_play.plan import GameOrder, PlayPlan, recording_name
from h3data_play.seats import Game, Seat, SeatLog, new_token, uptime
from h3data_play.workers import Preparer, WorkerProcess, Workers

PAGE = Path(__file__).parent / "web" / "dist"
RATE_PER_S, BURST = 90.0, 180.0
CAN_S = 0.09
"""Least time between previews that are answered [s]. Each takes milliseconds of the worker that all players share; a
page asks every 120 ms."""
MOST_BUSY = 0.7
"""Largest share of a core for a worker's games; another game would slow down all of them."""
AGAIN_S, SAY_S = 1.0, 60.0
"""Seconds after which a failed write to the database is tried again, and seconds between messages to the operator."""
NO_ROOM = "The server's disk is full. Nothing that you have done before is lost; try again in a minute."
MOST_SPECTATORS = 20
MOST_AHEAD = 4
"""Number of episodes that are prepared while earlier ones are played."""
SEAT_S = 86400
"""Time for which a browser keeps its seat [s]."""
SEATS_PER_ADDRESS = 12
"""Largest number of seats of one network address at a time: enough for a class in a lab."""
LOADING_S = 60.0
"""Time for which a seat is reserved for a player who has not connected yet because the home is still loading [s]."""
AWAY_S = 20.0
"""Time for which a disconnected browser keeps its seat against requests without a key [s]. A request with the link's
key gets the seat at once."""
BEGIN_S, POST_BYTES = 90.0, 64 * 1024
ELSEWHERE, GONE, RESTARTING = 4001, 4003, 1012


def network(address: str) -> str:
    """Return the part of an address that identifies a network: for IPv6 its first 64 bits."""
    try:
        parsed = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(parsed, ipaddress.IPv4Address):
        return str(parsed)
    return str(parsed.ipv4_mapped or ipaddress.ip_network((parsed, 64), strict=False))


def _sent(request: web.Request, task: asyncio.Task[None]) -> None:
    """Stop sending to a socket. A socket that accepted nothing for long, or broke, also ends its reader."""
    if not task.cancelled() and task.exception() is not None and request.transport is not None:
        request.transport.abort()


class WebServer:
    """Web server with all seats and games of one plan."""

    seat_s = SEAT_S

    def __init__(
        self,
        plan: PlayPlan,
        *,
        workers: int = 1,
        tables: int = 1,
        open_door: bool = True,
        secure: bool = False,
        report: Callable[[dict[str, Any]], None] = lambda _: None,
        plans: Sequence[PlayPlan] = (),
        journal: SeatLog | None = None,
        seats_per_address: int = SEATS_PER_ADDRESS,
        behind_proxy: bool = False,
        hosts: Sequence[str] = (),
        clock: Callable[[], float] = uptime,
    ) -> None:
        """Create the server, which starts with its web application.

        Args:
            plan: session that is played.
            workers: number of worker processes, in addition to the spare one.
            tables: number of simultaneous games, for plans with one player.
            open_door: whether ``/`` leads to the seat of the only player; otherwise every seat has a secret link.
            secure: whether browsers connect through TLS: cookies are then for TLS only.
            report: called with messages for the user of the command line.
            plans: plans to which orders of games refer by number (default: ``plan`` alone).
            journal: journal of seats and games (default: the one in the plan's folder).
            seats_per_address: number of simultaneous seats for one network address.
            behind_proxy: whether the address is the one that a proxy names (``X-Forwarded-For``).
            hosts: names by which browsers may reach the server, besides loopback and addresses; ``*.example.org`` has
                any first label.
            clock: clock in seconds by which long absences are measured.
        """
        self.plan, self.secure, self.report, self.clock = plan, secure, report, clock
        self.tables = tables if len(plan.players) == 1 else 1
        self.open_door = open_door and len(plan.players) == 1
        self.journal = SeatLog(Path(plan.out)) if journal is None else journal
        self.journal.make_links(len(plan.seats))
        self.workers = Workers(plans or (plan,), workers, self.heard, self.lost)
        self.lives: dict[str, Live] = {}
        self.preparer = Preparer(self.workers)
        self.done = asyncio.Event()
        """All episodes are over."""
        self.seats_per_address, self.behind_proxy, self.hosts = seats_per_address, behind_proxy, hosts
        self._addresses: dict[str, set[str]] = {}
        """Seats by address; in memory only: addresses of people are not stored."""
        self._stuck: dict[str, str] = {}
        """Games that wait for space on the disk, with a sentence for their players."""
        self._begun_before = set(self.journal.games)
        """Games that other processes have begun, which may have come to their end."""
        self._said_full = -math.inf
        """Time of the last message to the operator that the database cannot be written."""
        self._loading: dict[str, float] = {}
        """Times at which seats were given to browsers that have not connected since, by the clock."""
        self._gone: dict[str, float] = {}
        """Times at which browsers were last connected to their seats, if not since the start of this server."""
        self._began = clock()
        self._left: set[str] = set()
        """Seats that other browsers have now, under other names."""
        self.finishes = True
        """True if recordings are finished when the server stops; else the next server continues them."""

    # --- the application ----------------------------------------------------------------------------------------------
    def application(self) -> web.Application:
        """Return the web application that aiohttp serves."""
        app = web.Application(
            client_max_size=POST_BYTES, middlewares=[strict, require_known_host(self.hosts), self._with_room]
        )
        for prefix in ("", "/s/{key}"):
            app.router.add_get(prefix + "/", self.page)
            app.router.add_post(prefix + "/api/session", self.sit)
            app.router.add_get(prefix + "/world/{name}", self.world)
            app.router.add_get(prefix + "/play/{sid}", self.play)
            app.router.add_get(prefix + "/{path:(?:assets/)?[A-Za-z0-9_.-]+}", self.asset)
        app.on_shutdown.append(self._close_sockets)
        return app

    def link(self, number: int) -> str:
        """Return the URL path of a seat's page."""
        is_open = self.open_door and self.plan.seats[number] != "spectator"
        return "/" if is_open else f"/s/{self.journal.links[number]}/"

    async def _close_sockets(self, app: web.Application) -> None:
        """Close open sockets, because aiohttp would otherwise wait for them for a minute."""
        connections = [c for live in self.lives.values() for c in live.sockets.values()]
        for connection in connections:
            with contextlib.suppress(Exception):
                async with asyncio.timeout(0.5):
                    await connection.socket.close(code=WSCloseCode.GOING_AWAY)

    # --- pages --------------------------------------------------------------------------------------------------------
    async def page(self, request: web.Request) -> web.StreamResponse:
        """Answer with the page of a seat."""
        self._seat_number(request)
        if not (PAGE / "index.html").is_file():
            raise web.HTTPNotFound(text="The page has not been built. Hint: make web")
        return web.FileResponse(PAGE / "index.html", headers={"Cache-Control": "no-cache"})

    async def asset(self, request: web.Request) -> web.StreamResponse:
        """Answer with a file of the page, whose name contains a digest of its content."""
        path = PAGE / request.match_info["path"]
        if not path.is_file() or ".." in path.parts:
            raise web.HTTPNotFound
        return web.FileResponse(path, headers={"Cache-Control": "public, max-age=31536000, immutable"})

    async def world(self, request: web.Request) -> web.StreamResponse:
        """Answer with a GLB or a distance grid, requested by its digest."""
        found = self.preparer.files.get(request.match_info["name"])
        if found is None:
            raise web.HTTPNotFound(text="There is no such file any more. Reload the page.")
        data, kind = found
        headers = {"Content-Encoding": "gzip", "Cache-Control": "public, max-age=31536000, immutable"}
        return web.Response(body=data, content_type=kind, headers=headers)

    # --- sitting down -------------------------------------------------------------------------------------------------
    async def sit(self, request: web.Request) -> web.Response:
        """Give a browser its seat, or the seat that it already has, and start the next episode if none is running."""
        number = self._seat_number(request)
        await self._read(request, dict)
        token = request.cookies.get(self._cookie(number), "")
        seat = self.journal.owner(token, number) if token else None
        if seat is None:
            self._require_room_at(request)
            token = new_token()
            seat = self._new_seat(token, number, has_key="key" in request.match_info)
            self._note_address(request, seat)
        live = self._game_for(seat)
        self._loading[seat.sid] = self.clock()
        if live.game.key in self._stuck and not live.begun.done():
            raise web.HTTPServiceUnavailable(text=self._stuck[live.game.key])
        try:
            begun = await asyncio.wait_for(asyncio.shield(live.begun), BEGIN_S)
        except TimeoutError:
            raise web.HTTPServiceUnavailable(text="The home could not be set up in time. Try again.") from None
        except Stuck as fault:
            raise web.HTTPServiceUnavailable(text=str(fault)) from None
        except Failed as fault:
            if live.game.over != "failed":  # the server was killed before it had noted the end
                raise web.HTTPServiceUnavailable(text="This episode is over.") from None
            raise web.HTTPInternalServerError(text=f"The session could not begin: {fault}") from None
        manifest = {**begun["manifest"], "me": self._agent(seat, begun)}
        body = {"manifest": manifest, "glb": begun["glb"], "socket": f"play/{seat.sid}"}
        answer = web.json_response(body, headers={"Cache-Control": "no-store"})
        answer.set_cookie(
            self._cookie(number),
            token,
            httponly=True,
            samesite="Strict",
            secure=self.secure,
            max_age=self.seat_s,
            path="/",
        )
        return answer

    async def _read(self, request: web.Request, kind: type[Any]) -> Any:
        """Return the message that a browser has sent to its seat."""
        require_own_origin(request)
        self._seat_number(request)
        if request.content_type != "application/json":
            raise web.HTTPUnsupportedMediaType(text="Expected JSON.")
        try:
            async with asyncio.timeout(BODY_S):
                text = await request.read()
            return read_json(text, msgspec.json.Decoder(kind))
        except TimeoutError:
            raise web.HTTPRequestTimeout(text="The request did not come to its end.") from None
        except msgspec.MsgspecError as fault:
            raise web.HTTPBadRequest(text=f"The request is not what was expected: {fault}") from None

    def _seat_number(self, request: web.Request) -> int:
        key = request.match_info.get("key")
        if key is None and self.open_door:
            return 0
        if key in self.journal.links:
            return self.journal.links.index(key)
        raise web.HTTPNotFound(
            text="There is no seat here. Use the link that was printed when the session was started."
        )

    def _cookie(self, number: int) -> str:
        # cookies ignore ports: two sessions on one machine need names of their own
        name = hashlib.sha256(self.journal.links[number].encode()).hexdigest()[:8]
        return f"h3data_seat_{name}"

    def _new_seat(self, token: str, number: int, *, has_key: bool) -> Seat:
        if self.plan.seats[number] == "spectator":
            if sum(seat.number == number for seat in self.journal.seats.values()) >= MOST_SPECTATORS:
                raise web.HTTPServiceUnavailable(text="There are too many spectators already.")
            return self.journal.sit(token, 0, number)
        if self.tables == 1:
            seat = self.journal.taken(0, number)
            if seat is None:
                return self.journal.sit(token, 0, number)
            if self._is_attended(seat, 0.0 if has_key else AWAY_S):
                raise web.HTTPConflict(
                    text="Somebody plays here already, in another browser. Close the page there and try again here."
                )
            self._left.add(seat.sid)
            return self.journal.hand_over(seat, token)
        places = {seat.place for seat in self.journal.seats.values()}
        going = sum(not game.over for game in self.journal.games.values())
        if going >= self.tables:
            raise web.HTTPServiceUnavailable(text="All places are taken. Try again in a minute.")
        self._require_capacity()
        return self.journal.sit(token, max(places, default=-1) + 1, number)

    def _is_attended(self, seat: Seat, away_s: float) -> bool:
        """Return whether a seat's browser is connected, was so within ``away_s`` [s], or may be loading the home."""
        now = self.clock()
        if (
            now - self._loading.get(seat.sid, -LOADING_S) < LOADING_S
            or now - self._gone.get(seat.sid, self._began) < away_s
        ):
            return True
        return any(seat.sid in live.sockets for live in self.lives.values())

    def _require_capacity(self) -> None:
        if not self.workers.active or self.workers.least_busy().with_one_more > MOST_BUSY:
            raise web.HTTPServiceUnavailable(text="The machine is busy with other sessions. Try again in a minute.")

    def _require_room_at(self, request: web.Request) -> None:
        """Refuse another seat to a network address that has many."""
        sids = self._addresses.get(self._address(request), set())
        sids.difference_update([sid for sid in sids if not self._is_taken(sid)])
        if len(sids) >= self.seats_per_address:
            raise web.HTTPServiceUnavailable(
                text="Too many people take part from your network address already. Try again when one of them has finished."
            )

    def _note_address(self, request: web.Request, seat: Seat) -> None:
        self._addresses.setdefault(self._address(request), set()).add(seat.sid)

    def _address(self, request: web.Request) -> str:
        # the last entry is the proxy's own; what a client writes itself comes before it
        named = request.headers.get("X-Forwarded-For", "") if self.behind_proxy else ""
        return network(named.rpartition(",")[2].strip() or request.remote or "")

    def _is_taken(self, sid: str) -> bool:
        """Return whether a seat is still played."""
        seat = self.journal.seats.get(sid)
        game = None if seat is None else self.journal.games.get(seat.game)
        return seat is not None and (game is None or not game.over)

    def _game_for(self, seat: Seat) -> Live:
        """Return the game of a seat's table: the running one, or the next episode."""
        game = self.journal.open_game(seat.place)
        if game is None:
            if len(self.journal.games) >= self.plan.episodes:
                raise web.HTTPGone(text="All episodes have been played. You can close this page.")
            if self.plan.seats[seat.number] == "spectator":
                raise web.HTTPConflict(text="Nobody plays at the moment. Reload the page when they do.")
            game = self.journal.begin(seat.place)
            self._prepare_next()
        if seat.game != game.key:
            self.journal.assign(seat, game)
        return self._live(game)

    def _live(self, game: Game) -> Live:
        live = self.lives.get(game.key)
        if live is None:
            if not self.workers.active:
                raise web.HTTPServiceUnavailable(text="The server is just starting again. Try again in a moment.")
            worker = self.workers.least_busy()
            live = self.lives[game.key] = Live(game, worker, asyncio.get_running_loop().create_future())
            self._begin(live, worker)
        return live

    def _begin(self, live: Live, worker: WorkerProcess) -> None:
        live.worker = worker
        worker.games.add(live.game.key)
        order = self._order(live.game)
        plays = any(other.worker is worker and other.begun.done() for other in self.lives.values())
        if self.preparer.made(order) is None and (plays or self.workers.ready_spare() is not None):
            live.beginning = asyncio.create_task(self._begin_prepared(live, worker, order))
        else:
            self._send_order(live, worker, order)

    def _prepare_next(self) -> None:
        """Have the next episodes prepared while the present ones are played."""
        begun = len(self.journal.games)
        for episode in range(begun, min(begun + min(self.tables, MOST_AHEAD), self.plan.episodes)):
            self.preparer.ask(GameOrder(index=episode, name=recording_name(episode)))

    async def _begin_prepared(self, live: Live, worker: WorkerProcess, order: GameOrder) -> None:
        await self.preparer.wait(order)
        if live.worker is worker and not live.game.over:  # else it has moved meanwhile
            self._send_order(live, worker, order)

    def _send_order(self, live: Live, worker: WorkerProcess, order: GameOrder) -> None:
        made = self.preparer.made(order)
        resumes = live.game.key in self._begun_before
        order = msgspec.structs.replace(order, facts=None if made is None else made["facts"], resumes=resumes)
        worker.send("begin", live.game.key, msgspec.to_builtins(order))

    def _order(self, game: Game) -> GameOrder:
        """Return the order by which a worker plays a game."""
        return GameOrder(index=game.episode, name=recording_name(game.episode))

    def _agent(self, seat: Seat, begun: dict[str, Any]) -> int:
        """Return the agent that a seat plays; -1: none."""
        return int(begun["agents"][seat.number]) if seat.number < len(self.plan.players) else -1

    # --- from workers -------------------------------------------------------------------------------------------------
    def heard(self, worker: WorkerProcess, kind: str, key: str, body: Any) -> None:
        """Handle a worker's message about a game.

        A message that cannot be written to the disk now is handled again later.
        """
        try:
            self._hear(worker, kind, key, body)
        except sqlite3.OperationalError as fault:
            self._say_full(fault)
            asyncio.get_running_loop().call_later(AGAIN_S, self.heard, worker, kind, key, body)

    def _say_full(self, fault: sqlite3.OperationalError) -> None:
        if self.clock() - self._said_full > SAY_S:
            self._said_full = self.clock()
            self.report({"disk": {"is_full": True, "why": str(fault)}})

    @web.middleware
    async def _with_room(self, request: web.Request, handler: Any) -> web.StreamResponse:
        """Answer that an action did not happen if it cannot be written to the disk (`SeatLog`)."""
        try:
            return await handler(request)
        except sqlite3.OperationalError as fault:
            self._say_full(fault)
            raise web.HTTPServiceUnavailable(text=NO_ROOM) from None

    def _hear(self, worker: WorkerProcess, kind: str, key: str, body: Any) -> None:
        if kind == "prepared":
            self.preparer.heard(key, body)
            return
        live = self.lives.get(key)
        if live is None or live.worker is not worker:
            return
        if kind == "state":
            states: dict[int, bytes] = dict(body)
            for connection in live.sockets.values():
                if connection.agent in states:
                    connection.state(states[connection.agent])
        elif kind == "told":
            for connection in live.sockets.values():
                if connection.agent == body[0]:
                    connection.tell(body[1])
        elif kind == "stuck":
            self._waits(live, body)
        elif kind == "free":
            self._waits_no_more(key)
        elif kind == "begun":
            self._waits_no_more(key)
            made = self.preparer.made(self._order(live.game))
            assert made is not None, "it comes before"
            live.begun.set_result({**made, **body})
        elif kind == "failed":
            self._over(live, {"ended": "failed", "why": body, "path": "", "steps": 0, "texts": {}})
        elif kind == "over":
            self._over(live, body)

    def _waits(self, live: Live, body: dict[str, str]) -> None:
        """Note that a game waits, because the disk has no space for its data or for its beginning."""
        if not self._stuck:
            self.report({"disk": {"is_full": True, "why": body["why"]}})
        self._stuck[live.game.key] = body["text"]
        if not live.begun.done():
            live.begun.set_exception(Stuck(body["text"]))
            live.begun.exception()  # nobody may be waiting for it
            live.begun = asyncio.get_running_loop().create_future()

    def _waits_no_more(self, key: str) -> None:
        if self._stuck.pop(key, None) is not None and not self._stuck:
            self.report({"disk": {"is_full": False, "why": ""}})

    def _over(self, live: Live, over: dict[str, Any]) -> None:
        if live.game.over:
            return
        self._waits_no_more(live.game.key)
        self.journal.end(live.game, over["ended"])
        live.worker.games.discard(live.game.key)
        is_last = self._is_last()
        text = "Something went wrong in the simulator. What was played is kept." if over["ended"] == "failed" else ""
        for connection in live.sockets.values():
            said = over["texts"].get(str(connection.agent), text)
            connection.tell({"over": {"ended": over["ended"], "text": said, "next": not is_last}})
            connection.end()
        if not live.begun.done():
            live.begun.set_exception(Failed(over.get("why", over["ended"])))
            live.begun.exception()  # nobody may be waiting for it
        del self.lives[live.game.key]
        if over["path"]:
            nobody_plays_there = self.workers.ready_spare() or live.worker
            nobody_plays_there.send("pack", "", {"path": over["path"], "share_in": over["share_in"]})
        self._prepare_next()
        self.report({"over": {**over, "episode": live.game.episode, "key": live.game.key}})
        if is_last and all(game.over for game in self.journal.games.values()):
            self.done.set()

    def _is_last(self) -> bool:
        """Return whether no further game will begin."""
        return len(self.journal.games) >= self.plan.episodes

    def lost(self, worker: WorkerProcess) -> None:
        """Continue the games of a worker that died on another worker, from the data on the disk."""
        self.report({"lost": {"games": len(worker.games)}})
        lives = [live for live in self.lives.values() if live.worker is worker]
        loop = asyncio.get_running_loop()
        for live in lives:
            self._begun_before.add(live.game.key)
            self._stuck.pop(live.game.key, None)  # the next worker says so again
            if live.begun.done():
                live.begun = loop.create_future()
        self._moving = asyncio.create_task(self._move(lives))

    async def _move(self, lives: list[Live]) -> None:
        worker = await self.workers.replacement()
        for live in lives:
            self._begin(live, worker)
            for connection in list(live.sockets.values()):
                with contextlib.suppress(Exception):
                    await connection.socket.close(code=RESTARTING)

    # --- sockets ------------------------------------------------------------------------------------------------------
    async def play(self, request: web.Request) -> web.StreamResponse:
        """Serve the WebSocket of a seat."""
        require_own_origin(request)
        number = self._seat_number(request)
        seat = self.journal.seats.get(request.match_info["sid"])
        token = request.cookies.get(self._cookie(number), "")
        if request.match_info["sid"] in self._left:
            socket = web.WebSocketResponse(timeout=2.0)
            await socket.prepare(request)
            await socket.close(code=ELSEWHERE, message=b"opened elsewhere")
            return socket
        if seat is None or seat.number != number or self.journal.owner(token, number) is not seat:
            raise web.HTTPForbidden(text="This is not your seat.")
        game = self.journal.games.get(seat.game)
        socket = web.WebSocketResponse(compress=False, max_msg_size=MOST_BYTES, heartbeat=PING_S, timeout=2.0)
        await socket.prepare(request)
        if game is None or game.over:
            await socket.close(code=GONE, message=b"the session has ended")
            return socket
        try:
            live = self._live(game)
            begun = await asyncio.wait_for(asyncio.shield(live.begun), BEGIN_S)
        except (Failed, TimeoutError, web.HTTPException):
            await socket.close(code=RESTARTING)
            return socket
        connection = Connection(socket, self._agent(seat, begun), self.clock())
        before = live.sockets.get(seat.sid)
        live.sockets[seat.sid] = connection
        if before is not None:
            before_closes = asyncio.create_task(before.socket.close(code=ELSEWHERE, message=b"opened elsewhere"))
            with contextlib.suppress(Exception):
                await asyncio.wait_for(before_closes, 1.0)
        live.worker.send("here", game.key, {"agent": connection.agent, "here": True})
        sending = asyncio.create_task(connection.send())
        sending.add_done_callback(partial(_sent, request))
        self._loading.pop(seat.sid, None)
        try:
            await self._listen(live, connection, socket)
        finally:
            sending.cancel()
            if live.sockets.get(seat.sid) is connection:
                del live.sockets[seat.sid]
                self._gone[seat.sid] = self.clock()
                if not any(c.agent == connection.agent for c in live.sockets.values()) and not game.over:
                    live.worker.send("here", game.key, {"agent": connection.agent, "here": False})
        return socket

    async def _listen(self, live: Live, connection: Connection, socket: web.WebSocketResponse) -> None:
        allowance, last, asked = BURST, time.monotonic(), 0.0
        async for frame in socket:
            now = time.monotonic()
            allowance, last = min(BURST, allowance + (now - last) * RATE_PER_S) - 1, now
            if allowance < 0:
                await socket.close(code=WSCloseCode.POLICY_VIOLATION, message=b"too many messages")
                return
            if frame.type is not WSMsgType.TEXT:
                await socket.close(code=WSCloseCode.UNSUPPORTED_DATA, message=b"no message")
                return
            try:
                message = decode(frame.data)
            except msgspec.MsgspecError:
                await socket.close(code=WSCloseCode.UNSUPPORTED_DATA, message=b"no message")
                return
            if isinstance(message, Ping):
                connection.state(pong(message.ct))
                continue
            connection.heard = self.clock()
            if connection.agent < 0 or live.worker.is_stuck:
                continue
            if isinstance(message, Can):
                if now - asked < CAN_S:
                    continue
                asked = now
                live.worker.send("can", live.game.key, [connection.agent, list(message.p)])
            else:
                live.worker.send("input", live.game.key, [connection.agent, frame.data, time.monotonic() * 1e3])
