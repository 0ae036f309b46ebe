"""Server of a study: the pages before, between and after the episodes, and the assignment of episodes to participants."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import sqlite3
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from aiohttp import web
from msgspec import Meta

from h3data_play.connections import Failed, Live
from h3data_play.front import ELSEWHERE, PAGE, SEATS_PER_ADDRESS, WebServer
from h3data_play.plan import GameOrder
from h3data_play.seats import Game, Seat, new_token, uptime
from h3data_studies.design import StudyPlan
from h3data_studies.exclusions import FOCUS
from h3data_studies.flow import DROPPED, PARTED, SCREENED_OUT, UNPAIRED, WITHDRAWN, NotNow
from h3data_studies.orders import game_key, order_of, row_of
from h3data_studies.pseudonyms import completion_code, read_key, recruit_ids, refused_id, rejoin_code
from h3data_studies.store import Participant, StudyStore, pair_entry
from h3data_studies.views import consent_view, end_view, stage_view

CHECK_S, HURRIED_S = 60.0, 10.0
"""Time without a check of the computer after which a place is released, and the shorter time that applies while another
person wants the place [s]."""
MOST_UNCHECKED = 3
"""Largest number of participants from one network address who have consented but whose devices have not been checked
yet."""
JOINS_S = 600.0
"""Time window in which a network address may add at most the number of participants that it may have at once [s]."""
TOKEN_LENGTH = len(new_token())
NOT_YET = "The other participant is not here yet. Please keep this page open."
MEET_S = 0.5
HOLD_S = 20.0
"""Time for which a request waits for the other participant of a pair before the page has to ask again [s]."""
WATCH_S = 5.0
"""Interval of checks for participants who have dropped out [s]."""
MOST_PAUSES = 200
MOST_FOCUS = 1000
Short = Annotated[str, Meta(max_length=80)]
Measure = Annotated[float, Meta(ge=0, le=1e6)]


class Hello(msgspec.Struct, frozen=True):
    """Request body of ``api/study``, by which a page asks for its stage."""

    ids: dict[Short, Annotated[str, Meta(max_length=200)]] = {}
    language: Short = ""
    rejoin: Annotated[str, Meta(max_length=80)] = ""
    """Code of a link with which a participant continues in another browser."""


class Answer(msgspec.Struct, frozen=True):
    """Request body of ``api/study/consent``: the answer to the consent text."""

    accept: bool
    hash: Short = ""
    ids: dict[Short, Annotated[str, Meta(max_length=200)]] = {}
    language: Short = ""


class DeviceReport(msgspec.Struct, frozen=True):
    """Request body of ``api/study/device``: the kind of device, without its identity."""

    webgl: bool
    ping_ms: Measure
    fps: Measure
    width: Measure
    height: Measure
    touch: bool = False
    headset: bool = False
    browser: Short = ""
    system: Short = ""
    gpu: Short = ""
    final: bool = False
    """True if a window that is too small cannot be enlarged."""


class Filled(msgspec.Struct, frozen=True):
    """Request body of ``api/study/form``: the answers to a form."""

    form: Short
    answers: dict[Short, Any]
    block: int | None = None
    """Number of the form's block, as in the view of the stage."""
    trial: int | None = None


class Pause(msgspec.Struct, frozen=True):
    """Request body of ``api/study/pause``: the start or end of a pause."""

    paused: bool
    block: int | None = None
    trial: int | None = None


class Focus(msgspec.Struct, frozen=True):
    """Request body of ``api/study/focus``: the participant has turned to another window, or is back."""

    away: bool
    why: Literal["hidden", "blur"] = "blur"
    """Reason for the absence: the page was hidden, or only another window had the keyboard focus."""
    ms: Annotated[float, Meta(ge=0, le=1e9)] = 0.0
    """Duration of the absence, once the participant is back [ms]."""


class Episode(msgspec.Struct, frozen=True):
    """Request body of ``api/session``: the block and trial of the page's episode."""

    block: int | None = None
    trial: int | None = None


class StudyServer(WebServer):
    """Web server for all participants of one study."""

    journal: StudyStore
    seat_s = 30 * 86400

    def __init__(
        self,
        study: StudyPlan,
        *,
        workers: int = 1,
        open_door: bool = True,
        secure: bool = False,
        report: Callable[[dict[str, Any]], None] = lambda _: None,
        seats_per_address: int = SEATS_PER_ADDRESS,
        behind_proxy: bool = False,
        hosts: Sequence[str] = (),
        clock: Callable[[], float] = uptime,
    ) -> None:
        """Create the server, which starts with its web application.

        Args:
            study: design and plan of the study.
            workers: number of worker processes, in addition to the spare one.
            open_door: whether ``/`` is the study's page; otherwise its link has a secret.
            secure: whether browsers connect through TLS.
            report: called with messages for the user of the command line.
            seats_per_address: number of simultaneous participants for one network address.
            behind_proxy: as in `h3data_play.front.WebServer`.
            hosts: as in `h3data_play.front.WebServer`.
            clock: as in `h3data_play.front.WebServer`.
        """
        self.study, self.design = study, study.design
        super().__init__(
            study.plans[0],
            workers=workers,
            open_door=open_door,
            secure=secure,
            report=report,
            plans=study.plans,
            journal=StudyStore(study.design, study.places, Path(study.out), clock=clock),
            seats_per_address=seats_per_address,
            behind_proxy=behind_proxy,
            hosts=hosts,
            clock=clock,
        )
        self.finishes = False
        self._key = read_key(Path(study.key_file))
        self._page = ""
        self._tasks: set[asyncio.Task[None]] = set()
        self._unchecked: dict[int, str] = {}
        """Address of participants whose computers have not been checked, by number."""
        for participant in self.journal.participants.values():
            if participant.is_active and not participant.progress.rows:
                self._unchecked[participant.number] = ""
        self._lobby: dict[int, tuple[str, float]] = {}
        """Participants who wait for the other member of their pair: the stage, and the start of waiting by the clock.
        """
        self._joins: dict[str, tuple[float, float]] = {}
        """Number of participants who may still join from an address, and the time of that count."""

    # --- the application ----------------------------------------------------------------------------------------------
    def application(self) -> web.Application:
        """Return the web application with the study's pages and those of live play."""
        app = super().application()
        for prefix in ("", "/s/{key}"):
            app.router.add_post(prefix + "/api/study", self.hello)
            app.router.add_get(prefix + "/api/study/ping", self.ping)
            for name, act in (
                ("consent", self.consent),
                ("device", self.device),
                ("form", self.form),
                ("pause", self.pause),
                ("focus", self.focus),
                ("withdraw", self.withdraw),
            ):
                app.router.add_post(f"{prefix}/api/study/{name}", act)
        app.on_startup.append(self._start)
        app.on_shutdown.insert(0, self._stop)
        return app

    async def _start(self, app: web.Application) -> None:
        self._spawn(self._watch())

    async def _stop(self, app: web.Application) -> None:
        for task in list(self._tasks):
            task.cancel()

    def _spawn(self, work: Any) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def page(self, request: web.Request) -> web.StreamResponse:
        """Answer with the page of live play, marked as part of a study."""
        self._seat_number(request)
        if not self._page:
            try:
                html = (PAGE / "index.html").read_text("utf-8")
            except OSError:
                raise web.HTTPNotFound(text="The page has not been built. Hint: make web") from None
            self._page = html.replace("<body ", "<body data-study ", 1)
        return web.Response(text=self._page, content_type="text/html", headers={"Cache-Control": "no-cache"})

    # --- pages --------------------------------------------------------------------------------------------------------
    async def hello(self, request: web.Request) -> web.Response:
        """Answer with the participant's stage; before consent, answer with the consent text."""
        body, token = await self._read(request, Hello), ""
        participant = self._participant(request, body.ids)
        if body.rejoin and (participant is None or not participant.is_active):
            participant, token = self._rejoining(body.rejoin), new_token()
            await self._reseat(request, participant, token)
        if participant is not None and self._is_other(participant, body.ids):
            return self._answer(request, end_view(self.design, participant.language, "occupied"))
        if participant is None:
            # the token is the browser's seat once somebody agrees there, in whichever of its tabs
            if self._participant(request) is not None or not self._token(request):
                token = new_token()
            return self._answer(request, self._welcome(body.ids, self._language(body.language)), token)
        self.journal.saw(participant)
        return self._answer(request, self._view(participant), token)

    def _rejoining(self, code: str) -> Participant:
        for participant in self.journal.participants.values():
            seat = self.journal.seat_of(participant)
            if participant.is_active and seat is not None:
                expected = rejoin_code(participant.id, seat.token, self._key)
                if hmac.compare_digest(code.encode(), expected.encode()):
                    return participant
        raise web.HTTPForbidden(
            text="This link has been used, or its session is over. Go on in the browser that has used it, or ask for another."
        )

    async def ping(self, request: web.Request) -> web.Response:
        """Answer a ping with an empty body at once, so that a page can measure its round trip."""
        return web.Response(status=204, headers={"Cache-Control": "no-store"})

    async def consent(self, request: web.Request) -> web.Response:
        """Add a participant who consents; for people who decline, only their number is counted."""
        body = await self._read(request, Answer)
        participant, token = self._participant(request, body.ids), self._token(request)
        language = self._language(body.language)
        if participant is None:
            view = self._welcome(body.ids, language)
            if view["stage"]["kind"] != "consent":
                return self._answer(request, view)
            if not body.accept:
                self.journal.count("declined")
                answer = self._answer(request, end_view(self.design, language, "declined"))
                if self._participant(request) is None:
                    answer.del_cookie(self._cookie(0), path="/")
                return answer
            if not token or self._participant(request) is not None:
                raise web.HTTPConflict(
                    text="This browser has sent no cookie, by which the study knows it. Allow cookies and reload the page."
                )
            if body.hash != view["stage"]["hash"]:
                raise web.HTTPConflict(text="The text has been changed. Reload the page and read it again.")
            self._require_room_at(request)
            self._require_patience(self._address(request))
            place = self.journal.free_place()
            assert place is not None, "the view would have been another one"
            ids = recruit_ids(body.ids, self._key)
            pseudonym = ids.get("PROLIFIC_PID") or recruit_ids({"PROLIFIC_PID": token}, self._key)["PROLIFIC_PID"]
            agreed = {"version": self.design.consent.version, "sha256": body.hash}
            participant = self.journal.join(pseudonym, place, language=language, consent=agreed, ids=ids)
            self._unchecked[participant.number] = self._address(request)
            self._note_address(request, self.journal.move(participant, token))
            self.report({"joined": {"participant": pseudonym, "place": place}})
        return self._answer(request, self._view(participant), token)

    def _require_patience(self, address: str) -> None:
        """Count a new participant of an address, or refuse them if the address has had many."""
        if list(self._unchecked.values()).count(address) >= MOST_UNCHECKED:
            raise web.HTTPServiceUnavailable(
                text="Others are just beginning at your network address. Try again in some seconds."
            )
        now, most = self.clock(), float(self.seats_per_address)
        self._joins = {
            where: (left, at) for where, (left, at) in self._joins.items() if left + (now - at) * most / JOINS_S < most
        }
        left, at = self._joins.get(address, (most, now))
        left = min(most, left + (now - at) * most / JOINS_S)
        if left < 1:
            raise web.HTTPServiceUnavailable(
                text="Many people have begun at your network address lately. Try again in some minutes."
            )
        self._joins[address] = left - 1, now

    async def device(self, request: web.Request) -> web.Response:
        """Store the page's report about the participant's device and its connection."""
        body = await self._read(request, DeviceReport)

        def note(participant: Participant) -> dict[str, dict[str, Any]]:
            return participant.progress.device(msgspec.to_builtins(body))

        answer = self._act(request, note)
        self._unchecked.pop(self._required(request).number, None)
        return answer

    async def form(self, request: web.Request) -> web.Response:
        """Store a form that the participant has filled in."""
        body = await self._read(request, Filled)

        def answer(participant: Participant) -> dict[str, dict[str, Any]]:
            progress = participant.progress
            if body.block is None and sum(stage.form == body.form for stage in progress.stages) > 1:
                raise NotNow("This form is asked more than once, and the answers do not say where. Reload the page.")
            if body.trial is None and progress.stage.trial:
                raise NotNow(
                    "This form is asked after each episode, and the answers do not say which. Reload the page."
                )
            return progress.answer(body.form, body.answers, body.block, body.trial)

        return self._act(request, answer)

    async def pause(self, request: web.Request) -> web.Response:
        """Store the start or end of a pause; the world stands still while no participant is connected."""
        body = await self._read(request, Pause)

        def note(participant: Participant) -> dict[str, dict[str, Any]]:
            participant.progress.require_here(body.block, body.trial)
            count = sum(key.startswith("pause/") for key in participant.progress.rows)
            rows = {f"pause/{count + 1}": {"paused": body.paused}} if count < MOST_PAUSES else {}
            participant.progress.rows |= rows
            return rows

        return self._act(request, note)

    async def focus(self, request: web.Request) -> web.Response:
        """Store that the participant has turned to another window, or is back; an absence does not count as activity."""
        body, participant = await self._read(request, Focus), self._required(request)
        progress = participant.progress
        count = sum(key.startswith(f"{FOCUS}/") for key in progress.rows)
        if participant.is_active and count < MOST_FOCUS:
            left = progress.rows.get(f"{FOCUS}/{count}", {})
            # who comes back after the end of an episode has been away from that one
            stage = left["stage"] if left.get("away") and not body.away else progress.stage.key
            row = {"away": body.away, "why": body.why, "seconds": round(body.ms / 1e3, 3), "stage": stage}
            progress.rows[f"{FOCUS}/{count + 1}"] = row
            self.journal.save(participant, {f"{FOCUS}/{count + 1}": row})
        return web.Response(status=204)

    async def withdraw(self, request: web.Request) -> web.Response:
        """End the participation at the participant's request."""
        await self._read(request, Hello)

        def stop(participant: Participant) -> dict[str, dict[str, Any]]:
            participant.progress.end(WITHDRAWN, "asked")
            return {}

        return self._act(request, stop)

    def _act(self, request: web.Request, act: Callable[[Participant], dict[str, dict[str, Any]]]) -> web.Response:
        participant = self._required(request)
        self.journal.saw(participant)
        try:
            rows = act(participant)
        except NotNow as fault:
            raise web.HTTPConflict(text=str(fault)) from None
        self._save(participant, rows)
        return self._answer(request, self._view(participant))

    def _save(self, participant: Participant, rows: dict[str, dict[str, Any]]) -> None:
        was_open = participant.ended is None
        self.journal.save(participant, rows)
        if was_open and not participant.is_active:
            progress = participant.progress
            ended = {"participant": participant.id, "status": progress.status, "reason": progress.reason}
            self.report({"ended": ended})
            game = self.journal.shared_game(participant)
            if game is not None:
                self._spawn(self._leave(game))

    async def _leave(self, game: Game) -> None:
        """End the episode of a participant who will not come back, and finish its recording."""
        with contextlib.suppress(Failed, TimeoutError, web.HTTPException):
            if game.over:
                return
            live = self._live(game)
            begun = await asyncio.wait_for(asyncio.shield(live.begun), 60.0)
            live.worker.send("input", game.key, [begun["agents"][0], '{"k":"leave"}', time.monotonic() * 1e3])

    # --- what requests have in common ---------------------------------------------------------------------------------
    def _answer(self, request: web.Request, view: dict[str, Any], token: str = "") -> web.Response:
        answer = web.json_response(view, headers={"Cache-Control": "no-store"})
        if token:
            answer.set_cookie(
                self._cookie(0),
                token,
                httponly=True,
                samesite="Strict",
                secure=self.secure,
                max_age=self.seat_s,
                path="/",
            )
        return answer

    def _token(self, request: web.Request) -> str:
        """Return the token in the browser's cookie if this server may have given it, else an empty text."""
        token = request.cookies.get(self._cookie(0), "")
        return token if len(token) == TOKEN_LENGTH else ""

    def _participant(self, request: web.Request, ids: dict[str, str] | None = None) -> Participant | None:
        """Return the participant in the browser's seat; None also if they have finished and the link's ids are another's."""
        token = self._token(request)
        seat = self.journal.owner(token, 0) if token else None
        participant = None if seat is None else self.journal.participants.get(seat.place)
        if participant is not None and not participant.is_active and self._is_other(participant, ids or {}):
            return None
        return participant

    def _is_other(self, participant: Participant, ids: dict[str, str]) -> bool:
        """Return whether a link's ids belong to another person than ``participant``."""
        given = recruit_ids(ids, self._key).get("PROLIFIC_PID")
        return given is not None and given != participant.ids.get("PROLIFIC_PID", given)

    def _required(self, request: web.Request) -> Participant:
        participant = self._participant(request)
        if participant is None:
            raise web.HTTPConflict(text="This browser does not take part in the study yet. Reload the page.")
        return participant

    def _language(self, wanted: str) -> str:
        return wanted if wanted in self.design.languages else self.design.languages[0]

    def _welcome(self, ids: dict[str, str], language: str) -> dict[str, Any]:
        given = recruit_ids(ids, self._key)
        if self.design.recruiting.require_id and "PROLIFIC_PID" not in given:
            return end_view(self.design, language, "need_id")
        name, why = refused_id(ids, self.design.recruiting.id_pattern)
        if why:
            return end_view(self.design, language, why, name)
        known = self.journal.by_id(given.get("PROLIFIC_PID", ""))
        if self.journal.free_place() is None or (known is not None and known.number in self._unchecked):
            self.release_unchecked(HURRIED_S)
        if self.journal.by_id(given.get("PROLIFIC_PID", "")) is not None:
            return end_view(self.design, language, "elsewhere")  # an id is known to others: it opens nothing
        if self.journal.free_place() is None:
            return end_view(self.design, language, "full")
        return consent_view(self.design, language)

    def _view(self, participant: Participant) -> dict[str, Any]:
        stage = participant.progress.stage
        if stage.kind in ("tutorial", "episode"):  # while they read what comes next
            self.preparer.ask(order_of(self.study, participant, game_key(participant, stage)))
        return stage_view(self.design, participant, own_code=completion_code(participant.id, self._key))

    async def _reseat(self, request: web.Request, participant: Participant, token: str) -> None:
        """Give the seat to another browser, and notify the previous one."""
        before = self.journal.seat_of(participant)
        self._note_address(request, self.journal.move(participant, token))
        if before is not None:
            self._left.add(before.sid)
        for live in list(self.lives.values()):
            connection = live.sockets.get(before.sid) if before is not None else None
            if connection is not None:
                with contextlib.suppress(Exception):
                    async with asyncio.timeout(1.0):
                        await connection.socket.close(code=ELSEWHERE)

    # --- episodes -----------------------------------------------------------------------------------------------------
    async def sit(self, request: web.Request) -> web.Response:
        """Give a seat to a browser whose page is at the next episode."""
        body = await self._read(request, Episode)
        participant = self._participant(request)
        if participant is not None and participant.is_active:
            try:
                participant.progress.require_here(body.block, body.trial)
            except NotNow as fault:
                raise web.HTTPConflict(text=str(fault)) from None
            await self._meet(participant)
        return await super().sit(request)

    # --- pairs --------------------------------------------------------------------------------------------------------
    async def _meet(self, participant: Participant) -> None:
        """Wait until the other participant of the pair has come as far, if an episode is played by both.

        Raises:
            web.HTTPException: They have not come yet, or will not come.
        """
        key = participant.progress.stage.key
        known, since = self._lobby.get(participant.number, ("", 0.0))
        self._lobby[participant.number] = (key, since if known == key else self.clock())
        ends = time.monotonic() + (HOLD_S if known == key else 0.0)
        while participant.is_active and self._lacks_company(participant):
            why = PARTED if self._is_parted(participant) else ""
            if self.clock() - self._lobby[participant.number][1] > self.design.dropout.wait_minutes * 60:
                why = why or UNPAIRED
            if why:
                participant.progress.end(SCREENED_OUT, why)
                self._save(participant, {})
                return
            if time.monotonic() > ends:
                raise web.HTTPServiceUnavailable(text=NOT_YET)
            self.journal.saw(participant)
            await asyncio.sleep(MEET_S)
        self._lobby.pop(participant.number, None)

    def _lacks_company(self, participant: Participant) -> bool:
        """Return whether the next episode cannot begin because the other participant of the pair is elsewhere."""
        stage = participant.progress.stage
        if not participant.progress.is_shared(stage.key) or self.journal.shared_game(participant) is not None:
            return False
        other = self.journal.company(participant)
        return other is None or not other.is_active or other.progress.stage.key != stage.key

    def _is_parted(self, participant: Participant) -> bool:
        """Return whether the next episode is for two, and the other participant of the pair has left."""
        other, progress = self.journal.company(participant), participant.progress
        return progress.is_shared(progress.stage.key) and progress.has_met and (other is None or not other.is_active)

    def _agent(self, seat: Seat, begun: dict[str, Any]) -> int:
        agents, participant = begun["agents"], self.journal.participants[seat.place]
        return int(agents[len(agents) - 1 if not seat.game.startswith(f"{participant.id}/") else 0])

    def _new_seat(self, token: str, number: int, *, has_key: bool) -> Seat:
        raise web.HTTPConflict(text="This browser does not take part in the study yet. Reload the page.")

    def _is_taken(self, sid: str) -> bool:
        seat = self.journal.seats.get(sid)
        participant = None if seat is None else self.journal.participants.get(seat.place)
        return participant is not None and participant.is_active

    def _game_for(self, seat: Seat) -> Live:
        participant = self.journal.participants[seat.place]
        self.journal.saw(participant)
        game = self.journal.shared_game(participant)
        if not participant.is_active:
            raise web.HTTPGone(text="The session has ended. Reload the page.")
        if game is None:
            stage = participant.progress.stage
            if stage.kind not in ("tutorial", "episode"):
                raise web.HTTPConflict(text="There is something else to do first. Reload the page.")
            if self._lacks_company(participant):
                raise web.HTTPServiceUnavailable(text=NOT_YET)
            self._require_capacity()
            company = self.journal.company(participant) if participant.progress.is_shared(stage.key) else None
            first = participant if company is None or participant.place < company.place else company
            game = self.journal.begin_episode(first, game_key(first, stage))
        if seat.game != game.key:
            self.journal.assign(seat, game)
        return self._live(game)

    def _order(self, game: Game) -> GameOrder:
        return order_of(self.study, self.journal.participants[game.place], game.key, *self.journal.players(game)[1:])

    def _is_last(self) -> bool:
        return False

    def _over(self, live: Live, over: dict[str, Any]) -> None:
        game = live.game
        players = () if game.over else self.journal.players(game)
        agents, remarks = over.get("agents", ()), over.get("remarks") or ()
        left = dict(zip(agents, players, strict=False)).get(over.get("left"))
        stays = [player for player in players if player.is_active and player is not left]
        for participant, agent in zip(players, agents or (-1,) * len(players), strict=False):
            result = {name: over.get(name) for name in ("ended", "steps", "slipped", "step_ms")} | pair_entry(players)
            if own := [remark for remark in remarks if len(players) == 1 or remark["agent"] == agent]:
                result["remarks"] = own
            if over["ended"] == "closed" and stays == [participant] and len(players) > 1:
                participant.progress.end(SCREENED_OUT, PARTED)
            self._save(participant, participant.progress.over(row_of(game.key), result))
            self.journal.saw(participant)
        super()._over(live, over)

    # --- drop-outs ----------------------------------------------------------------------------------------------------
    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(WATCH_S)
            try:
                self.look_for_drop_outs()
                self.release_unchecked(CHECK_S)
            except sqlite3.OperationalError as fault:
                self._say_full(fault)

    def release_unchecked(self, seconds: float) -> None:
        """Remove participants whose devices were not checked in time, so that their places and ids become free."""
        self.journal.count_time()
        for number in list(self._unchecked):
            participant = self.journal.participants.get(number)
            if participant is not None and participant.is_active and participant.used < seconds:
                continue
            del self._unchecked[number]
            if participant is not None and participant.is_active:
                self.journal.remove(participant)
                self.report({"released": {"participant": participant.id}})

    def look_for_drop_outs(self) -> None:
        """Update the time of all participants, and end the participation of those who have been idle for too long."""
        self.journal.count_time()
        now = self.clock()
        for live in self.lives.values():
            waits = len(live.sockets) < len(
                self.journal.players(live.game)
            )  # for the other participant: that is not idle
            for sid, connection in live.sockets.items():
                seat = self.journal.seats.get(sid)
                participant = None if seat is None else self.journal.participants.get(seat.place)
                if participant is not None:
                    participant.idle = min(participant.idle, 0.0 if waits else now - connection.heard)
        self.journal.keep_time()
        rules = self.design.dropout
        for participant in list(self.journal.participants.values()):
            if not participant.is_active:
                continue
            if participant.idle > rules.idle_minutes * 60:
                participant.progress.end(DROPPED, "idle")
            elif participant.used > rules.total_minutes * 60:
                participant.progress.end(DROPPED, "too_long")
            elif self._is_parted(participant) and self.journal.shared_game(participant) is None:
                participant.progress.end(SCREENED_OUT, PARTED)
            else:
                continue
            self._save(participant, {})
