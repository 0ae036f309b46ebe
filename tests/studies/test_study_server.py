"""A study through HTTP and sockets: played to the end, reloaded, killed, dropped out of."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from h3data.recording import read_mcap
from h3data_studies.commands.managing import StudyStatus
from h3data_studies.commands.running import LOCK, keep_design
from h3data_studies.files import make_plan, open_store
from sim_kinematic.tasks.resume import verify
from tests.play.server import Server
from tests.studies.participant import DEVICE, Participant
from tests.studies.tiny import tiny


def serve(folder: Path, speed: float = 8.0, **changes: Any) -> Server:
    plan = make_plan(tiny(**changes), folder, speed=speed)
    return Server(folder, {"study": msgspec.to_builtins(plan), "stays": True})


async def take_part(link: str) -> tuple[list[str], Participant]:
    async with Participant(link) as person:
        await person.join(PROLIFIC_PID="5f0000000000000000000abc", STUDY_ID="s", SESSION_ID="e")
        return await person.go_on(), person


@pytest.mark.slow
def test_a_whole_study_is_played_and_its_recordings_say_by_whom_under_what(tmp_path: Path) -> None:
    folder = tmp_path / "tiny-1"
    with serve(
        folder, recruiting={"completion_code": "C1", "completion_url": "https://example.org/?cc={code}"}
    ) as server:
        kinds, person = asyncio.run(take_part(server.links[0]))
        assert server.stop() == 0
    assert kinds.count("episode") == 2
    assert kinds[0] == "tutorial"
    assert kinds.count("form") == 4
    end = person.stage
    assert (end["status"], end["code"], end["url"]) == ("complete", "C1", "https://example.org/?cc=C1")
    name = person.view["participant"]
    files = sorted((folder / "recordings").glob("*.mcap"))
    assert [path.name for path in files] == [f"{name}_1-01.mcap", f"{name}_2-01.mcap"]
    recordings = [read_mcap(path) for path in files]
    assert {r.episode.info["condition"] for r in recordings} == {"solo", "still"}
    for recording in recordings:
        info = recording.episode.info
        assert info["participant"] == name
        assert info["hitl"]["consent"] == {"version": "1", "sha256": info["hitl"]["consent"]["sha256"]}
        assert info["hitl"]["client"]["browser"] == "bot"
        assert info["hitl"]["study"] == {"name": "tiny", "version": "1"}
        assert verify(recording).difference is None
    assert list((folder / "tutorial").glob("*.mcap"))
    assert not list(folder.glob("*/h3")), "homes are stored once for the study"
    raw = b"".join(path.read_bytes() for path in tmp_path.rglob("*") if path.is_file())
    assert b"5f0000000000000000000abc" not in raw
    store = open_store(folder, tiny())
    (kept,) = store.participants.values()
    assert kept.progress.status == "complete"
    assert kept.progress.rows["form/1/nasa_tlx"]["answers"]["effort"] == 0


async def out_of_order(link: str, rejoin: Callable[[], str]) -> None:
    async with Participant(link) as person, Participant(link) as other:
        assert await person.ask("api/study/device", DEVICE) == 409, "nobody without consent"
        assert await person.sit() == 409
        assert await person.ask("api/study") == 200
        assert person.stage["text"] == "You may stop at any time."
        assert await person.ask("api/study/consent", {"accept": True, "hash": "other"}) == 409
        assert await person.ask("api/study/consent", {"accept": "yes"}) == 400
        assert await person.ask("api/study/consent", {"accept": False}) == 200
        assert person.stage["status"] == "declined"
        assert not person.http.cookie_jar.filter_cookies(link), "nothing is kept of those who decline"
        await person.ask("api/study")
        ids = {"PROLIFIC_PID": "5f0000000000000000000abc"}
        assert await person.ask("api/study/consent", {"accept": True, "hash": person.stage["hash"], "ids": ids}) == 200
        assert await person.sit() == 409, "the device comes first"
        assert await person.ask("api/study/form", {"form": "nasa_tlx", "answers": {}}) == 409
        assert await person.ask("api/study/device", {**DEVICE, "fps": 1e300}) == 400
        assert await person.ask("api/study/device", DEVICE) == 200
        assert await person.ask("api/study/device", DEVICE) == 409, "once"
        async with person.http.post(link + "api/study", json={}, headers={"Origin": "http://evil.example"}) as answer:
            assert answer.status == 403
        await person.begin()
        step = person.step
        await person.socket.close()
        await person.begin()
        assert person.step >= step, "a reload goes on"
        # the same person in another browser: the seat moves there by the operator's link alone
        assert await other.ask("api/study", {"ids": ids}) == 200
        assert other.stage["status"] == "elsewhere"
        base, _, code = (await asyncio.to_thread(rejoin)).partition("?rejoin=")
        assert base == link
        assert await other.ask("api/study", {"rejoin": code}) == 200
        assert other.view["participant"] == person.view["participant"]
        await person.until(lambda: person.close_code == 4001)
        assert await person.ask("api/study") == 200
        assert person.stage["kind"] == "consent", "this browser has no seat any more"
        await other.begin()
        assert await other.ask("api/study/pause", {"paused": True}) == 200
        assert await other.ask("api/study/withdraw") == 200
        assert other.stage["status"] == "withdrawn"
        await other.until(lambda: other.heard("over"))
        assert await other.sit() == 410


@pytest.mark.slow
def test_nothing_can_be_skipped_and_a_seat_follows_its_participant(tmp_path: Path) -> None:
    with serve(tmp_path / "tiny-1", speed=1.0) as server:
        folder = tmp_path / "tiny-1"
        keep_design(folder, tiny())
        (folder / LOCK).write_text(server.links[0])  # as study run does

        def rejoin() -> str:
            return next(iter(StudyStatus(folder).run().result["rejoin"].values()))

        asyncio.run(out_of_order(server.links[0], rejoin))
        server.stop()


async def killed(folder: Path, server: Server) -> None:
    async with Participant(server.links[0]) as person:
        await person.join()
        await person.play()
        assert person.stage["kind"] == "episode"
        await person.begin()
        await person.until(lambda: person.step > 60)
        step, name = person.step, person.view["participant"]
        server.stop(signal.SIGKILL)
        await person.until(lambda: person.close_code)
        for number in (signal.SIGTERM, None):
            with await asyncio.to_thread(serve, folder, 4.0) as again:
                person.link = again.links[0]
                assert await person.ask("api/study") == 200
                assert person.view["participant"] == name
                await person.begin()
                assert person.step >= step - 3, "the same step goes on"
                step = person.step
                if number is not None:
                    assert await asyncio.to_thread(again.stop, number) == 0
                    assert not list(folder.glob("recordings/*.mcap")), "the episode is not over"
                else:
                    await person.socket.close()
                    await person.go_on()
                    assert person.stage["status"] == "complete"


@pytest.mark.slow
def test_a_killed_and_a_stopped_server_go_on_in_the_middle_of_an_episode(tmp_path: Path) -> None:
    folder = tmp_path / "tiny-1"
    with serve(folder, 4.0) as server:
        asyncio.run(killed(folder, server))
    for path in (folder / "recordings").glob("*.mcap"):
        assert verify(read_mcap(path)).difference is None


async def idle(link: str) -> None:
    async with Participant(link) as person, Participant(link) as late, Participant(link) as next_one:
        await person.join()
        await late.ask("api/study")
        assert late.stage["status"] == "full"
        await person.begin()
        await person.until(lambda: person.heard("over"), 40)
        await person.ask("api/study")
        assert (person.stage["status"], person.stage["reason"]) == ("dropped", "idle")
        await next_one.join()
        assert next_one.stage["kind"] == "tutorial", "the place is free again"


@pytest.mark.slow
def test_the_place_of_somebody_who_does_nothing_goes_to_the_next(tmp_path: Path) -> None:
    with serve(tmp_path / "tiny-1", 1.0, participants=1, dropout={"idle_minutes": 0.1}) as server:
        asyncio.run(idle(server.links[0]))


async def interrupted(folder: Path, server: Server) -> None:
    async with Participant(server.links[0]) as person:
        await person.join()
        assert server.stop(signal.SIGKILL) == -signal.SIGKILL
        await asyncio.sleep(20.0)
        with await asyncio.to_thread(serve, folder, 1.0, dropout={"idle_minutes": 0.3}) as again:
            person.link = again.links[0]
            again.process.send_signal(signal.SIGSTOP)
            await asyncio.sleep(20.0)
            again.process.send_signal(signal.SIGCONT)
            await asyncio.sleep(6.0)
            (kept,) = open_store(folder, tiny(dropout={"idle_minutes": 0.3})).participants.values()
            assert kept.progress.status == "active"
            assert 4 < kept.idle < 18
            await asyncio.sleep(15.0)
            await person.ask("api/study")
            assert (person.stage["status"], person.stage["reason"]) == ("dropped", "idle")


@pytest.mark.slow
def test_a_killed_and_a_suspended_server_drop_nobody(tmp_path: Path) -> None:
    folder = tmp_path / "tiny-1"
    with serve(folder, 1.0, dropout={"idle_minutes": 0.3}) as server:
        asyncio.run(interrupted(folder, server))


def test_the_server_of_a_study_imports_nothing_heavy() -> None:
    code = (
        "import sys, h3data_studies.front; from h3data_studies.pseudonyms import recruit_ids; "
        "recruit_ids({'STUDY_ID': 'x'}, bytes(32)); print([m for m in ('numpy', 'numba', 'torch', 'pyarrow', "
        "'sim_kinematic') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"
