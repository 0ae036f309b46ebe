"""The server of a study: the pages before, between and after the episodes, and which episode each participant plays."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import msgspec
from aiohttp import web
from msgspec import Meta

from h3data_viewers.hitl.connections import Failed, Live, require_own_origin
from h3data_viewers.hitl.front import ELSEWHERE, PAGE, SEATS_PER_ADDRESS, Front
from h3data_viewers.hitl.plan import GameOrder
from h3data_viewers.hitl.seats import Game, Seat, new_token
from h3data_viewers.hitl.study.design import StudyPlan
from h3data_viewers.hitl.study.flow import DROPPED, WITHDRAWN, NotNow
from h3data_viewers.hitl.study.orders import game_key, order_of, row_of
from h3data_viewers.hitl.study.pseudonyms import read_key, recruit_ids
from h3data_viewers.hitl.study.store import Participant, StudyStore
from h3data_viewers.hitl.study.views import consent_view, end_view, stage_view

WATCH_S = 5.0
"""Who has dropped out is looked for this often."""
MOST_PAUSES = 200
Short = Annotated[str, Meta(max_length=80)]
Measure = Annotated[float, Meta(ge=0, le=1e6)]


class Hello(msgspec.Struct, frozen=True):
    """Body of ``api/study``."""

    ids: dict[Short, Annotated[str, Meta(max_length=200)]] = {}
    language: Short = ""


class Answer(msgspec.Struct, frozen=True):
    """Body of ``api/study/consent``."""

    accept: bool
    hash: Short = ""
    ids: dict[Short, Annotated[str, Meta(max_length=200)]] = {}
    language: Short = ""


class DeviceReport(msgspec.Struct, frozen=True):
    """Body of ``api/study/device``: what kind of computer it is, not which one."""

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


class Filled(msgspec.Struct, frozen=True):
    """Body of ``api/study/form``."""

    form: Short
    answers: dict[Short, Any]


class Pause(msgspec.Struct, frozen=True):
    """Body of ``api/study/pause``."""

    paused: bool


class StudyFront(Front):
    """All participants of one study."""

    journal: StudyStore

    def __init__(
        self, study: StudyPlan, *, workers: int = 1, open_door: bool = True, secure: bool = False,
        report: Callable[[dict[str, Any]], None] = lambda _: None, seats_per_address: int = SEATS_PER_ADDRESS,
        behind_proxy: bool = False,
    ) -> None:  # fmt: skip
        """
        Args:
            study: What is played, by whom.
            workers: Processes beside the spare one.
            open_door: Whether ``/`` is the study's page, else its link has a secret.
            secure: Whether browsers come through TLS.
            report: Called with what the command line tells its user.
            seats_per_address: Participants at once of one network address.
            behind_proxy: As of `Front`.
        """
        self.study, self.design = study, study.design
        super().__init__(
            study.plans[0], workers=workers, open_door=open_door, secure=secure, report=report, plans=study.plans,
            journal=StudyStore(study.design, study.places, Path(study.out)),
            seats_per_address=seats_per_address, behind_proxy=behind_proxy,
        )  # fmt: skip
        self.finishes = False
        self.began = time.time()
        self._key = read_key(Path(study.key_file))
        self._page = ""
        self._tasks: set[asyncio.Task[None]] = set()

    # --- the application ----------------------------------------------------------------------------------------------
    def application(self) -> web.Application:
        app = super().application()
        for prefix in ("", "/s/{key}"):
            app.router.add_post(prefix + "/api/study", self.hello)
            app.router.add_get(prefix + "/api/study/ping", self.ping)
            for name, act in (
                ("consent", self.consent),
                ("device", self.device),
                ("form", self.form),
                ("pause", self.pause),
                ("withdraw", self.withdraw),
            ):
                app.router.add_post(f"{prefix}/api/study/{name}", act)
        app.on_startup.append(self._start)
        app.on_shutdown.insert(0, self._stop)
        return app

    async def _start(self, app: web.Application) -> None:
        del app
        self._spawn(self._watch())

    async def _stop(self, app: web.Application) -> None:
        del app
        for task in list(self._tasks):
            task.cancel()

    def _spawn(self, work: Any) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def page(self, request: web.Request) -> web.StreamResponse:
        """The page, told that this is a study."""
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
        """Where the participant is; before consent, what they are asked to agree to."""
        body, token = await self._read(request, Hello), ""
        participant = self._participant(request)
        if participant is None:
            ids = recruit_ids(body.ids, self._key)
            known = self.journal.by_id(ids["PROLIFIC_PID"]) if "PROLIFIC_PID" in ids else None
            if known is None:
                return self._answer(request, self._welcome(body.ids, self._language(body.language)))
            participant, token = known, new_token()  # another browser, or cookies that are gone
            await self._reseat(participant, token)
        self.journal.saw(participant)
        return self._answer(request, self._view(participant), token)

    async def ping(self, request: web.Request) -> web.Response:
        """Nothing, at once."""
        del request
        return web.Response(status=204, headers={"Cache-Control": "no-store"})

    async def consent(self, request: web.Request) -> web.Response:
        """A new participant; of those who decline only their number is kept."""
        body = await self._read(request, Answer)
        participant, token = self._participant(request), ""
        language = self._language(body.language)
        if participant is None:
            view = self._welcome(body.ids, language)
            if view["stage"]["kind"] != "consent":
                return self._answer(request, view)
            if not body.accept:
                self.journal.count("declined")
                return self._answer(request, end_view(self.design, language, "declined"))
            if body.hash != view["stage"]["hash"]:
                raise web.HTTPConflict(text="The text has been changed. Reload the page and read it again.")
            self._require_room_at(request)
            place = self.journal.free_place()
            assert place is not None, "the view would have been another one"
            token = new_token()
            ids = recruit_ids(body.ids, self._key)
            pseudonym = ids.get("PROLIFIC_PID") or recruit_ids({"PROLIFIC_PID": token}, self._key)["PROLIFIC_PID"]
            agreed = {"version": self.design.consent.version, "sha256": body.hash}
            participant = self.journal.join(pseudonym, place, language=language, consent=agreed, ids=ids)
            self._note_address(request, self.journal.move(participant, token))
            self.report({"joined": {"participant": pseudonym, "place": place}})
        return self._answer(request, self._view(participant), token)

    async def device(self, request: web.Request) -> web.Response:
        """What the page has found out about the computer and its connection."""
        body = await self._read(request, DeviceReport)
        return self._act(request, lambda p: p.progress.device(msgspec.to_builtins(body)))

    async def form(self, request: web.Request) -> web.Response:
        """A form that has been filled in."""
        body = await self._read(request, Filled)
        return self._act(request, lambda p: p.progress.answer(body.form, body.answers))

    async def pause(self, request: web.Request) -> web.Response:
        """Notes a pause, or its end. The world stands still by itself while nobody is connected to it."""
        body = await self._read(request, Pause)

        def note(participant: Participant) -> dict[str, dict[str, Any]]:
            count = sum(key.startswith("pause/") for key in participant.progress.rows)
            rows = {f"pause/{count + 1}": {"paused": body.paused}} if count < MOST_PAUSES else {}
            participant.progress.rows |= rows
            return rows

        return self._act(request, note)

    async def withdraw(self, request: web.Request) -> web.Response:
        """The participant stops taking part."""
        await self._read(request, Hello)

        def stop(participant: Participant) -> dict[str, dict[str, Any]]:
            participant.progress.end(WITHDRAWN, "asked")
            return {}

        return self._act(request, stop)

    def _act(self, request: web.Request, act: Callable[[Participant], dict[str, dict[str, Any]]]) -> web.Response:
        participant = self._required(request)
        try:
            rows = act(participant)
        except NotNow as fault:
            raise web.HTTPConflict(text=str(fault)) from None
        self.journal.saw(participant)
        self._save(participant, rows)
        return self._answer(request, self._view(participant))

    def _save(self, participant: Participant, rows: dict[str, dict[str, Any]]) -> None:
        was_open = participant.ended is None
        self.journal.save(participant, rows)
        if was_open and not participant.is_active:
            progress = participant.progress
            ended = {"participant": participant.id, "status": progress.status, "reason": progress.reason}
            self.report({"ended": ended})
            game = self.journal.open_game(participant.number)
            if game is not None:
                self._spawn(self._leave(game))

    async def _leave(self, game: Game) -> None:
        """Ends the episode of somebody who will not come back; its recording is finished."""
        with contextlib.suppress(Failed, TimeoutError, web.HTTPException):
            live = self._live(game)
            begun = await asyncio.wait_for(asyncio.shield(live.begun), 60.0)
            live.worker.send("input", game.key, [begun["agents"][0], '{"k":"leave"}', time.monotonic() * 1e3])

    # --- what requests have in common ---------------------------------------------------------------------------------
    async def _read(self, request: web.Request, kind: type[Any]) -> Any:
        require_own_origin(request)
        self._seat_number(request)
        if request.content_type != "application/json":
            raise web.HTTPUnsupportedMediaType(text="Expected JSON.")
        try:
            return msgspec.json.decode(await request.read(), type=kind)
        except msgspec.MsgspecError as fault:
            raise web.HTTPBadRequest(text=f"The request is not what was expected: {fault}") from None

    def _answer(self, request: web.Request, view: dict[str, Any], token: str = "") -> web.Response:
        del request
        answer = web.json_response(view, headers={"Cache-Control": "no-store"})
        if token:
            answer.set_cookie(
                self._cookie(0),
                token,
                httponly=True,
                samesite="Strict",
                secure=self.secure,
                max_age=30 * 86400,
                path="/",
            )
        return answer

    def _participant(self, request: web.Request) -> Participant | None:
        token = request.cookies.get(self._cookie(0), "")
        seat = self.journal.owner(token, 0) if token else None
        return None if seat is None else self.journal.participants.get(seat.place)

    def _required(self, request: web.Request) -> Participant:
        participant = self._participant(request)
        if participant is None:
            raise web.HTTPConflict(text="This browser does not take part in the study yet. Reload the page.")
        return participant

    def _language(self, wanted: str) -> str:
        return wanted if wanted in self.design.languages else self.design.languages[0]

    def _welcome(self, ids: dict[str, str], language: str) -> dict[str, Any]:
        if self.design.recruiting.require_id and not ids.get("PROLIFIC_PID"):
            return end_view(self.design, language, "need_id")
        if self.journal.free_place() is None:
            return end_view(self.design, language, "full")
        return consent_view(self.design, language)

    def _view(self, participant: Participant) -> dict[str, Any]:
        stage = participant.progress.stage
        if stage.kind in ("tutorial", "episode"):  # while they read what comes next
            self.preparer.ask(order_of(self.study, participant, game_key(participant, stage)))
        return stage_view(self.design, participant)

    async def _reseat(self, participant: Participant, token: str) -> None:
        """Gives the seat to another browser; the one before is told so."""
        before = self.journal.seat_of(participant)
        self.journal.move(participant, token)
        for live in list(self.lives.values()):
            connection = live.sockets.get(before.sid) if before is not None else None
            if connection is not None:
                with contextlib.suppress(Exception):
                    async with asyncio.timeout(1.0):
                        await connection.socket.close(code=ELSEWHERE)

    # --- episodes -----------------------------------------------------------------------------------------------------
    def _new_seat(self, token: str, number: int) -> Seat:
        raise web.HTTPConflict(text="This browser does not take part in the study yet. Reload the page.")

    def _is_taken(self, sid: str) -> bool:
        seat = self.journal.seats.get(sid)
        participant = None if seat is None else self.journal.participants.get(seat.place)
        return participant is not None and participant.is_active

    def _game_for(self, seat: Seat) -> Live:
        participant = self.journal.participants[seat.place]
        self.journal.saw(participant)
        game = self.journal.open_game(participant.number)
        if not participant.is_active:
            raise web.HTTPGone(text="The session has ended. Reload the page.")
        if game is None:
            stage = participant.progress.stage
            if stage.kind not in ("tutorial", "episode"):
                raise web.HTTPConflict(text="There is something else to do first. Reload the page.")
            self._require_capacity()
            game = self.journal.begin_episode(participant, game_key(participant, stage))
        if seat.game != game.key:
            self.journal.assign(seat, game)
        return self._live(game)

    def _order(self, game: Game) -> GameOrder:
        return order_of(self.study, self.journal.participants[game.place], game.key)

    def _is_last(self) -> bool:
        return False

    def _over(self, live: Live, over: dict[str, Any]) -> None:
        game, participant = live.game, self.journal.participants.get(live.game.place)
        if not game.over and participant is not None:
            result = {name: over.get(name) for name in ("ended", "steps", "slipped", "step_ms")}
            self._save(participant, participant.progress.over(row_of(game.key), result))
            self.journal.saw(participant)
        super()._over(live, over)

    # --- drop-outs ----------------------------------------------------------------------------------------------------
    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(WATCH_S)
            self.look_for_drop_outs(time.time())

    def look_for_drop_outs(self, now: float) -> None:
        """Ends the sessions of those who have done nothing for too long; a server that was down has seen nobody."""
        for live in self.lives.values():
            participant = self.journal.participants.get(live.game.place)
            heard = max((c.heard for c in live.sockets.values()), default=0.0)
            if participant is not None and heard > participant.seen:
                self.journal.saw(participant, heard)
        rules = self.design.dropout
        for participant in list(self.journal.participants.values()):
            if not participant.is_active:
                continue
            idle = now - max(participant.seen, self.began)
            if idle > rules.idle_minutes * 60:
                participant.progress.end(DROPPED, "idle")
            elif now - participant.joined > rules.total_minutes * 60:
                participant.progress.end(DROPPED, "too_long")
            else:
                continue
            self._save(participant, {})
