"""Who gets in, whose seat is whose, and what old pages and hostile clients cannot do: the server of a study without workers."""

from __future__ import annotations

import asyncio
import functools
import sqlite3
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from aiohttp.test_utils import TestServer

from h3data.errors import InputError
from h3data_play.connections import Live
from h3data_play.front import network
from h3data_studies.commands.running import keep_design
from h3data_studies.design import StudyPlan
from h3data_studies.files import DESIGN_FILE, make_plan, read_design
from h3data_studies.front import CHECK_S, HURRIED_S, MOST_UNCHECKED, WATCH_S, StudyServer
from h3data_studies.overview import overview
from h3data_studies.pseudonyms import recruit_ids, rejoin_code
from h3data_studies.store import DATABASE, StudyStore
from tests.studies.participant import DEVICE, Participant
from tests.studies.test_flow import DEVICE as REPORT
from tests.studies.test_flow import act
from tests.studies.tiny import tiny, write_tiny

PID, OTHER = "5f0000000000000000000abc", "5f0000000000000000000def"
CODE = {"completion_code": "C1A2B3C4"}


@functools.cache
def made_plan() -> StudyPlan:
    return make_plan(tiny(tutorial={"skip": True}), Path("study"))


class Clock:
    """A clock that is set by hand."""

    now = 1e5

    def __call__(self) -> float:
        return self.now


class Study:
    """The server of a study in this process, and browsers of some network address."""

    def __init__(self, folder: Path, stack: AsyncExitStack, **changes: Any) -> None:
        folder.mkdir()
        design = tiny(**{"tutorial": {"skip": True}, "recruiting": CODE, **changes})
        plan = msgspec.structs.replace(made_plan(), design=design, out=str(folder), key_file=str(folder) + ".key")
        plan = msgspec.structs.replace(plan, places=plan.places[: design.participants])
        self.clock = Clock()
        self.front = StudyServer(plan, behind_proxy=True, clock=self.clock)
        self.front.preparer.ask = lambda order: None  # type: ignore[method-assign]
        self.stack, self.link = stack, ""

    async def browser(self, address: str = "1.1.1.1") -> Participant:
        person = Participant(self.link)
        await self.stack.enter_async_context(person)
        person.http.headers["X-Forwarded-For"] = address
        return person

    async def joined(self, pid: str = "", address: str = "1.1.1.1") -> Participant:
        person = await self.browser(address)
        await person.join(**({"PROLIFIC_PID": pid} if pid else {}))
        return person

    def finish(self, person: Participant) -> None:
        who = self.front.journal.by_id(person.view["participant"])
        assert who is not None
        while who.is_active:
            act(who.progress)
        self.front.journal.save(who, who.progress.rows)

    def serve(self, minutes: float) -> None:
        """Time passes, in which the server looks around every few seconds."""
        end = self.clock.now + minutes * 60
        while self.clock.now < end:
            self.clock.now += WATCH_S
            self.front.look_for_drop_outs()

    @property
    def people(self) -> list[str]:
        return [p.progress.status for p in self.front.journal.participants.values()]


@asynccontextmanager
async def opened(folder: Path, **changes: Any) -> AsyncIterator[Study]:
    async with AsyncExitStack() as stack:
        study = Study(folder / "s", stack, **changes)
        server = await stack.enter_async_context(TestServer(study.front.application()))
        study.link = str(server.make_url("/"))
        yield study


def run(folder: Path, what: Callable[[Study], Awaitable[None]], **changes: Any) -> None:
    async def main() -> None:
        async with opened(folder, **changes) as study:
            await what(study)

    asyncio.run(main())


async def consent(person: Participant, **ids: str) -> int:
    await person.ask("api/study", {"ids": ids})
    if person.stage["kind"] != "consent":
        return 0
    return await person.ask("api/study/consent", {"accept": True, "hash": person.stage["hash"], "ids": ids})


# --- an id is no password ---------------------------------------------------------------------------------------------
def test_an_id_opens_neither_a_seat_nor_a_finished_ones_code_nor_ends_anybody(tmp_path: Path) -> None:
    async def what(study: Study) -> None:
        owner, thief = await study.joined(PID), await study.browser()
        ids = {"PROLIFIC_PID": PID}
        for given in (ids, {**ids, "SESSION_ID": "e"}, {"PROLIFIC_PID": PID.upper()}, {"PROLIFIC_PID": f" {PID} "}):
            await thief.ask("api/study", {"ids": given})
            assert thief.stage["status"] == "elsewhere"
            assert await thief.ask("api/study/consent", {"accept": True, "hash": "x", "ids": given}) == 200
            assert (thief.stage["status"], thief.view["participant"]) == ("elsewhere", None)
            for path, body in (("withdraw", {"ids": given}), ("pause", {"paused": True}), ("device", DEVICE)):
                assert await thief.ask(f"api/study/{path}", body) == 409
            assert await thief.sit() == 409
        await owner.ask("api/study")
        assert owner.stage["kind"] == "episode", "the owner goes on"
        study.finish(owner)
        await thief.ask("api/study", {"ids": ids})
        assert (thief.stage["status"], thief.stage["code"]) == ("elsewhere", "")
        await owner.ask("api/study")
        assert owner.stage["code"] == "C1A2B3C4"

    run(tmp_path, what)


def test_a_rejoin_link_moves_a_seat_once(tmp_path: Path) -> None:
    async def what(study: Study) -> None:
        owner, other, late = await study.joined(PID), await study.browser(), await study.browser()
        who = study.front.journal.by_id(owner.view["participant"])
        assert who is not None
        seat = study.front.journal.seat_of(who)
        assert seat is not None
        code = rejoin_code(who.id, seat.token, study.front._key)
        assert await other.ask("api/study", {"rejoin": code[:-1] + "é"}) == 403
        assert await other.ask("api/study", {"ids": {"PROLIFIC_PID": PID}, "rejoin": code}) == 200
        assert (other.view["participant"], other.stage["kind"]) == (who.id, "episode")
        assert await other.ask("api/study", {"rejoin": code}) == 200, "the same browser may open it again"
        assert await late.ask("api/study", {"rejoin": code}) == 403, "once"
        await owner.ask("api/study", {"ids": {"PROLIFIC_PID": PID}})
        assert owner.stage["status"] == "elsewhere", "the seat has moved"
        raw = b"".join(path.read_bytes() for path in (tmp_path / "s").rglob("*") if path.is_file())
        cookies = [cookie.value.encode() for cookie in other.http.cookie_jar]
        assert cookies
        assert not any(secret in raw for secret in (*cookies, code.encode())), "secrets are kept as digests"

    run(tmp_path, what)


def test_another_participant_at_the_same_computer_gets_neither_seat_nor_code(tmp_path: Path) -> None:
    async def what(study: Study) -> None:
        person = await study.joined(PID)
        await person.ask("api/study", {"ids": {"PROLIFIC_PID": OTHER}})
        assert person.stage["status"] == "occupied"
        await person.ask("api/study", {"ids": {"PROLIFIC_PID": PID}})
        assert person.stage["kind"] == "episode"
        study.finish(person)
        await person.join(PROLIFIC_PID=OTHER)
        assert person.stage["kind"] == "episode"
        assert study.people == ["complete", "active"]

    run(tmp_path, what)


# --- places -----------------------------------------------------------------------------------------------------------
def test_invented_ids_do_not_fill_a_study(tmp_path: Path) -> None:
    async def what(study: Study) -> None:
        for pid in ("one", "5f", "z" * 24, PID + "0", "' or 1=1 --"):
            assert await consent(person := await study.browser(), PROLIFIC_PID=pid) == 0
            assert person.stage["status"] == "bad_id"
        answers = [await consent(await study.browser("6.6.6.6"), PROLIFIC_PID=f"{k:024x}") for k in range(5)]
        assert answers == [200] * MOST_UNCHECKED + [503] * (5 - MOST_UNCHECKED)
        assert len(study.people) == MOST_UNCHECKED
        for number in study.front._unchecked:
            study.front.journal.participants[number].used += HURRIED_S
        for address in ("1.1.1.1", "2.2.2.2"):  # whoever comes gets the place of one who has not been checked
            assert (await study.joined(address=address)).stage["kind"] == "episode"
        assert study.people == ["active", "active"], "what nobody had checked is free again"

    run(tmp_path, what, participants=4)


def test_a_place_without_a_device_check_is_free_after_a_minute_and_so_is_its_id(tmp_path: Path) -> None:
    async def what(study: Study) -> None:
        squatter, owner = await study.browser(), await study.browser("2.2.2.2")
        assert await consent(squatter, PROLIFIC_PID=PID) == 200
        study.front.release_unchecked(CHECK_S)
        assert len(study.people) == 1
        study.front.journal.participants[1].used += CHECK_S
        study.front.release_unchecked(CHECK_S)
        assert study.people == []
        await owner.join(PROLIFIC_PID=PID)
        assert owner.stage["kind"] == "episode"
        assert await squatter.ask("api/study/device", DEVICE) == 409
        study.front.release_unchecked(0.0)
        assert study.people == ["active"], "checked ones stay"

    run(tmp_path, what)


def test_an_address_sends_few_participants_in_a_time_and_others_are_not_affected(tmp_path: Path) -> None:
    async def what(study: Study) -> None:
        study.front.seats_per_address = 2
        for k in range(2):
            study.finish(await study.joined(f"{k:024x}", "6.6.6.6"))
        assert await consent(await study.browser("6.6.6.6"), PROLIFIC_PID=PID) == 503
        assert await consent(await study.browser("2.2.2.2"), PROLIFIC_PID=PID) == 200
        assert await consent(await study.browser("2001:db8::1")) == 200

    run(tmp_path, what)
    assert network("2001:db8::1") == network("2001:db8::2:3") != network("2001:db8:0:1::1")
    assert network("::ffff:1.2.3.4") == network("1.2.3.4")


@pytest.mark.parametrize(
    "value",
    [
        "{{%PROLIFIC_PID%}}",
        "%PROLIFIC_PID%",
        "${PROLIFIC_PID}",
        "{{PROLIFIC_PID}}",
        "<PROLIFIC_PID>",
        "{PROLIFIC_PID}",
        "PROLIFIC_PID",
        "[PROLIFIC_PID]",
        "${e://Field/PROLIFIC_PID}",
        "__PROLIFIC_PID__",
    ],
)
def test_placeholders_that_nobody_has_filled_in_are_refused_by_name(tmp_path: Path, value: str) -> None:
    async def what(study: Study) -> None:
        person = await study.browser()
        for name in ("PROLIFIC_PID", "STUDY_ID", "SESSION_ID"):
            assert await consent(person, **{name: value.replace("PROLIFIC_PID", name)}) == 0
            assert person.stage["status"] == "placeholder"
            assert name in person.stage["text"]
        assert study.people == []

    run(tmp_path, what)


def test_a_study_file_says_what_ids_look_like(tmp_path: Path) -> None:
    async def what(study: Study) -> None:
        assert await consent(await study.browser(), PROLIFIC_PID="lab-07", SESSION_ID="s1") == 200
        assert await consent(await study.browser(), PROLIFIC_PID=PID, SESSION_ID="s1") == 0
        assert await consent(await study.browser(), PROLIFIC_PID="lab-08", SESSION_ID="t1") == 0

    patterns = {"PROLIFIC_PID": "lab-[0-9]{2}", "SESSION_ID": "s[0-9]"}
    run(tmp_path, what, recruiting={"id_pattern": patterns})
    assert read_design(write_tiny(tmp_path, recruiting={"id_pattern": "lab-[0-9]+"})).recruiting.id_pattern
    with pytest.raises(InputError, match="H3-STUDY-049"):
        read_design(write_tiny(tmp_path, recruiting={"id_pattern": "lab-["}))
    with pytest.raises(InputError, match=r"(?s)Did you mean.*H3-STUDY-041"):
        read_design(write_tiny(tmp_path, recruiting={"id_pattern": {"PROLIFIC_ID": "x"}}))


def test_a_study_that_began_before_there_were_formats_goes_on_without(tmp_path: Path) -> None:
    design = tiny()
    keep_design(tmp_path, design)
    store = StudyStore(design, make_plan(design, tmp_path).places, tmp_path)
    store.join("P-1", 0, language="en", consent={}, ids={})
    store.close(done=False)
    kept = tmp_path / DESIGN_FILE
    before = msgspec.json.decode(kept.read_bytes())
    del before["recruiting"]["id_pattern"]
    kept.write_bytes(msgspec.json.encode(before))
    for _ in range(2):
        assert keep_design(tmp_path, design).recruiting.id_pattern == ".*"
    named = tiny(recruiting={"id_pattern": "lab-[0-9]+"})
    assert keep_design(tmp_path, named) == named, "the format may change while people take part"
    with pytest.raises(InputError, match="H3-STUDY-013"):
        keep_design(tmp_path, tiny(seed=7))


# --- requests name their block ----------------------------------------------------------------------------------------
def test_a_resend_and_an_old_tab_store_nothing_under_another_condition(tmp_path: Path) -> None:
    async def what(study: Study) -> None:
        person = await study.joined(PID)
        who = study.front.journal.by_id(person.view["participant"])
        assert who is not None
        act(who.progress)
        assert await person.ask("api/study") == 200
        old = {
            "form": "nasa_tlx",
            "block": person.stage["block"],
            "answers": dict.fromkeys(("mental", "physical", "temporal", "performance", "effort", "frustration"), 95),
        }
        assert await person.ask("api/study/form", {**old, "block": 2}) == 409
        assert await person.ask("api/study/form", {k: old[k] for k in ("form", "answers")}) == 409, "of which block?"
        assert await person.ask("api/study/form", old) == 200
        while who.progress.stage.key != "form/2/nasa_tlx":
            act(who.progress)
        rows = dict(who.progress.rows)
        assert await person.ask("api/study/form", old) == 409, "of the first block"
        assert who.progress.rows == rows
        assert await person.ask("api/study/form", {**old, "block": 2}) == 200

    run(tmp_path, what, conditions=[{"name": "still", "partner": "still"}, {"name": "solo", "partner": "solo"}])


def test_an_old_tab_begins_no_episode_and_notes_no_pause(tmp_path: Path) -> None:
    async def what(study: Study) -> None:
        person = await study.joined(PID)
        who = study.front.journal.by_id(person.view["participant"])
        assert who is not None
        old = {"block": person.stage["block"], "trial": person.stage["trial"]}
        while who.progress.stage.key != "episode/2/1":
            act(who.progress)
        assert await person.ask("api/session", old) == 409
        assert await person.ask("api/study/pause", {"paused": True, **old}) == 409
        assert not study.front.journal.games
        assert await person.ask("api/study/pause", {"paused": True, "block": 2, "trial": 1}) == 200

    run(tmp_path, what)


def test_consent_at_once_makes_one_seat(tmp_path: Path) -> None:
    async def what(study: Study) -> None:
        person = await study.browser()  # four times in one browser, without an id
        await person.ask("api/study")
        body = {"accept": True, "hash": person.stage["hash"]}
        assert await asyncio.gather(*(person.ask("api/study/consent", body) for _ in range(4))) == [200] * 4
        assert study.people == ["active"]
        assert await person.ask("api/study/device", DEVICE) == 200
        tabs = [await study.browser("2.2.2.2") for _ in range(4)]  # the same id in four browsers
        ids = {"PROLIFIC_PID": PID}
        for tab in tabs:
            await tab.ask("api/study", {"ids": ids})
        assert await asyncio.gather(*(tab.ask("api/study/consent", {**body, "ids": ids}) for tab in tabs)) == [200] * 4
        assert sorted(tab.stage.get("status", "") for tab in tabs) == ["", "elsewhere", "elsewhere", "elsewhere"]
        assert study.people == ["active", "active"]
        bare = await study.browser("3.3.3.3")
        assert await bare.ask("api/study/consent", body) == 409, "a browser that sends no cookie would lose its place"
        assert "cookie" in bare.told[-1]["refused"]

    run(tmp_path, what)


# --- small windows ----------------------------------------------------------------------------------------------------
def test_a_portrait_phone_is_turned_and_goes_on(tmp_path: Path) -> None:
    async def what(study: Study) -> None:
        person = await study.browser()
        assert await consent(person, PROLIFIC_PID=PID) == 200
        phone = {**DEVICE, "touch": True, "width": 390, "height": 844}
        for _ in range(3):
            assert await person.ask("api/study/device", phone) == 200
            assert person.stage["kind"] == "device"
            assert "landscape" in person.stage["again"]
        study.front.release_unchecked(0.0)
        assert await person.ask("api/study/device", {**phone, "width": 844, "height": 390}) == 200
        assert person.stage["kind"] == "episode"
        other = await study.browser()
        assert await consent(other) == 200
        assert await other.ask("api/study/device", {**phone, "final": True}) == 200
        assert (other.stage["status"], other.stage["reason"]) == ("screened_out", "small_window")

    run(tmp_path, what)
    assert REPORT["width"] > 640


# --- time -------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("minutes", [30, -30, 60 * 24 * 400])
def test_a_step_of_the_clock_drops_nobody_and_keeps_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, minutes: float
) -> None:
    async def what(study: Study) -> None:
        await study.joined(PID)
        study.serve(minutes=5)
        before = time.time()
        monkeypatch.setattr(time, "time", lambda: before + minutes * 60)
        study.serve(minutes=5)
        assert study.people == ["active"]
        person = study.front.journal.participants[1]
        assert (person.used, person.idle) == (600, 600)
        study.serve(minutes=9)
        assert study.people == ["active"]
        study.serve(minutes=2)
        assert study.people == ["dropped"], "20 minutes without doing anything"

    run(tmp_path, what)


@pytest.mark.parametrize("rule", ["idle_minutes", "total_minutes"])
def test_a_suspended_server_is_nobodys_time(tmp_path: Path, rule: str) -> None:
    async def what(study: Study) -> None:
        person = await study.joined(PID)
        for k in range(8):
            study.serve(minutes=1)
            study.clock.now += 3600
            if k % 2:  # whoever is there first: a request or the watch
                assert await person.ask("api/study/pause", {"paused": True, "block": 1, "trial": 1}) == 200
            study.front.look_for_drop_outs()
        assert study.people == ["active"]
        assert study.front.journal.participants[1].used == 480
        study.serve(minutes=4)
        assert study.people == ["dropped"]

    run(tmp_path, what, dropout={rule: 10 if rule == "total_minutes" else 3.9})


@pytest.mark.parametrize("kind", ["killed", "stopped"])
def test_time_used_outlives_the_server_and_its_absence_is_nobodys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    async def before(study: Study) -> None:
        person = await study.joined(PID)
        study.serve(minutes=3)
        assert await person.ask("api/study/pause", {"paused": True, "block": 1, "trial": 1}) == 200
        study.serve(minutes=15)
        if kind == "killed":
            study.clock.now += WATCH_S - 1  # not counted yet
        else:
            study.front.journal.close(done=False)

    run(tmp_path, before)
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + 86400)
    again = StudyStore(tiny(), made_plan().places, tmp_path / "s", clock=(clock := Clock()))
    (person,) = again.participants.values()
    assert (person.used, person.idle) == (18 * 60, 15 * 60)
    assert overview(again.design, again)["participants"][0]["idle_minutes"] == 15, "as the operator reads it"
    clock.now += 10
    again.count_time()
    assert (person.used, person.idle) == (18 * 60 + 10, 15 * 60 + 10)


def test_who_plays_is_not_idle(tmp_path: Path) -> None:
    async def what(study: Study) -> None:
        await study.joined(PID)
        game = study.front.journal.begin_episode(study.front.journal.participants[1], "game")
        connection = SimpleNamespace(heard=0.0)
        (sid,) = study.front.journal.seats
        study.front.lives["game"] = SimpleNamespace(game=game, sockets={sid: connection})  # type: ignore[assignment]
        for _ in range(30):
            study.serve(minutes=1)
            connection.heard = study.clock.now
        study.serve(minutes=0.5)
        assert study.front.journal.participants[1].idle == 30
        assert study.people == ["active"]

    run(tmp_path, what)


def test_a_study_that_stored_dates_goes_on_with_seconds(tmp_path: Path) -> None:
    """Participants of a version that stored the date of the last act: one under way, one who finished."""
    folder, design = tmp_path / "s", tiny(recruiting={"id_pattern": ".*"})
    folder.mkdir()
    db = sqlite3.connect(folder / DATABASE)
    db.executescript(
        """
        create table participants (
            number integer primary key, id text not null unique, place integer not null, status text not null,
            reason text not null, joined real not null, seen real not null, ended real, language text not null,
            consent text not null, ids text not null
        );
        create table rows (
            participant integer not null, stage text not null, at real not null, data text not null,
            primary key (participant, stage)
        );
        insert into participants values (1, 'P-A', 0, 'active', '', 1000, 90600, null, 'en', '{"version":"1"}', '{}');
        insert into participants values (2, 'P-B', 1, 'withdrawn', 'asked', 1000, 1500, 1600, 'en', '{}', '{}');
        insert into rows values (1, 'device', 1060, '{}'), (1, 'tutorial/1', 1360, '{"ended":"success"}'),
            (1, 'tutorial', 1360, '{}'), (1, 'episode/1/1', 90500, '{"ended":"success"}');
        """
    )
    db.close()
    status = StudyStore(design, made_plan().places, folder, read_only=True)
    stores = [StudyStore(design, made_plan().places, folder) for _ in range(2)]
    for store in (status, *stores):
        first, second = store.participants.values()
        assert (first.id, first.joined, first.used, first.idle, first.consent) == (
            "P-A",
            1000,
            460,
            0,
            {"version": "1"},
        )
        assert (second.progress.status, second.used, second.ended) == ("withdrawn", 600, 1600)
        assert first.progress.stage.key == "form/1/nasa_tlx"


# --- a full disk ------------------------------------------------------------------------------------------------------
def test_answers_wait_for_space_on_the_disk(tmp_path: Path) -> None:
    """The database may have no more pages than it has: SQLite says what it says on a full disk."""

    async def what(study: Study) -> None:
        db, said = study.front.journal._db, []
        person = await study.joined(PID)
        study.front.report = said.append
        who = study.front.journal.participants[1]
        rows = dict(who.progress.rows)
        ((pages,),) = db.execute("pragma page_count")
        db.execute(f"pragma max_page_count = {pages}")
        form = {"form": "long", "block": 0, "answers": {"words": "x" * 4000}}
        for _ in range(2):
            assert await person.ask("api/study/form", form) == 503
            assert "disk is full" in person.told[-1]["refused"]
            assert (who.progress.rows, who.progress.status, db.in_transaction) == (rows, "active", False)
        study.serve(minutes=0.1)
        assert said == [{"disk": {"is_full": True, "why": "database or disk is full"}}]
        db.execute("pragma max_page_count = 4294967294")
        assert await person.ask("api/study/form", form) == 200
        assert person.stage["kind"] == "episode"
        again = StudyStore(study.front.design, study.front.journal.places, tmp_path / "s", read_only=True)
        assert again.participants[1].progress.rows == who.progress.rows

    item = {"id": "words", "kind": "text", "text": "Anything?"}
    run(tmp_path, what, forms=[{"id": "long", "after": "consent", "items": [item]}])


def test_the_end_of_an_episode_is_written_when_there_is_space(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("h3data_play.front.AGAIN_S", 0.05)

    async def what(study: Study) -> None:
        person = await study.joined(PID)
        who = study.front.journal.participants[1]
        game = study.front.journal.begin_episode(who, f"{who.id}/episode/1/1")
        worker = SimpleNamespace(games={game.key}, send=lambda *_: None)
        begun = asyncio.get_running_loop().create_future()
        begun.set_result({})
        study.front.lives[game.key] = Live(game, worker, begun)  # type: ignore[arg-type]
        over = {"ended": "success", "steps": 9, "slipped": 0, "step_ms": 1, "path": "", "share_in": "", "texts": {}}
        study.front.journal._db.execute("pragma query_only = on")
        study.front.heard(worker, "over", game.key, over)  # type: ignore[arg-type]
        assert (game.over, who.progress.stage.key) == ("", "episode/1/1")
        assert await person.ask("api/study") == 503
        study.front.journal._db.execute("pragma query_only = off")
        await asyncio.sleep(0.2)
        assert (game.over, who.progress.stage.key) == ("success", "form/1/nasa_tlx")
        again = StudyStore(study.front.design, study.front.journal.places, tmp_path / "s", read_only=True)
        assert again.participants[1].progress.rows == who.progress.rows

    run(tmp_path, what)


# --- names of the server ----------------------------------------------------------------------------------------------
def test_a_name_that_is_not_the_servers_ends_nobodys_study(tmp_path: Path) -> None:
    async def what(study: Study) -> None:
        person = await study.joined(PID)
        evil = {"Host": "evil.example:8080", "Origin": "http://evil.example:8080"}
        for path in ("api/study", "api/study/withdraw", "api/session"):
            async with person.http.post(study.link + path, json={}, headers=evil) as answer:
                assert (answer.status, "--allow-host evil.example" in await answer.text()) == (421, True), path
                assert "Set-Cookie" not in answer.headers
        async with person.http.get(study.link, headers=evil) as answer:
            assert answer.status == 421
        assert study.people == ["active"]
        assert await person.ask("api/study") == 200
        study.front.hosts = ("evil.example",)
        server = await study.stack.enter_async_context(TestServer(study.front.application()))
        async with person.http.post(server.make_url("/api/study"), json={}, headers=evil) as answer:
            assert answer.status == 200

    run(tmp_path, what)


# --- nonsense ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("text", ["[" * 1000, '{"ids":' * 1000, '{"x":' + "[" * 900 + "]" * 900 + "}"])
def test_nested_json_is_malformed_and_the_participant_goes_on(tmp_path: Path, text: str) -> None:
    async def what(study: Study) -> None:
        person = await study.joined(PID)
        for path in (
            "study",
            "study/consent",
            "study/device",
            "study/form",
            "study/pause",
            "study/withdraw",
            "session",
        ):
            given = {"data": text, "headers": {"Content-Type": "application/json"}}
            async with person.http.post(f"{study.link}api/{path}", **given) as answer:
                assert (answer.status, "not what was expected" in await answer.text()) == (400, True), path
        assert await person.ask("api/study") == 200
        assert person.stage["kind"] == "episode"

    run(tmp_path, what)


# --- all at once ------------------------------------------------------------------------------------------------------
def test_hostile_clients_beside_players_of_whom_none_loses_the_seat(tmp_path: Path) -> None:
    async def what(study: Study) -> None:
        pids = [f"{k:024x}" for k in range(1, 5)]
        players = [await study.joined(pid, f"1.1.1.{k}") for k, pid in enumerate(pids)]
        names = [player.view["participant"] for player in players]

        async def hostile(number: int) -> None:
            pid = pids[number % 4]
            attempts: list[tuple[str, dict[str, Any]]] = [
                ("api/study", {"ids": {"PROLIFIC_PID": pid}}),
                ("api/study", {"ids": {"PROLIFIC_PID": pid}, "rejoin": "A" * 32}),
                ("api/study/consent", {"accept": True, "hash": "x", "ids": {"PROLIFIC_PID": pid}}),
                ("api/study/withdraw", {"ids": {"PROLIFIC_PID": pid}}),
                ("api/study/form", {"form": "nasa_tlx", "block": 1, "answers": {}}),
                ("api/study/pause", {"paused": True, "block": 1, "trial": 1}),
                ("api/study/device", {**DEVICE, "width": 1}),
                ("api/session", {"block": 1, "trial": 1}),
            ]
            client = await study.browser(f"6.6.6.{number % 5}")
            client.http.cookie_jar.update_cookies({study.front._cookie(0): names[number % 4].ljust(32, "x")})
            for path, body in attempts:
                await client.ask(path, body)
                if hasattr(client, "view"):
                    assert client.view["participant"] is None
            await consent(client, PROLIFIC_PID=f"{number + 100:024x}")

        async def play(player: Participant) -> None:
            for _ in range(20):
                assert await player.ask("api/study") == 200
                assert player.stage["kind"] == "episode"

        await asyncio.gather(*map(hostile, range(40)), *map(play, players))
        study.front.release_unchecked(0.0)
        recruited = [recruit_ids({"PROLIFIC_PID": pid}, study.front._key)["PROLIFIC_PID"] for pid in pids]
        assert names == recruited == [p.id for p in study.front.journal.participants.values()]
        assert study.people == ["active"] * 4

    run(tmp_path, what, participants=4)
