"""A full disk stops games and forms, tells who plays and who serves, and loses nothing."""

from __future__ import annotations

import asyncio
import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from h3data.recording import read_mcap
from h3data.recording.mcap import part as mcap_part
from h3data_play.live import EpisodeFactory
from h3data_play.messages import PERIOD_S
from h3data_play.plan import GameOrder, PlayPlan
from h3data_play.worker import DISK_FULL, Running, Worker
from sim_kinematic.tasks.resume import verify
from tests.play.bot import Bot
from tests.play.server import Server
from tests.recording.test_mcap_writer import FillingDisk

KEY = "000000"


class Disk:
    """Room for each file [bytes], and the files that are open for writing."""

    def __init__(self) -> None:
        self.room, self.files = 1 << 40, list[FillingDisk]()

    def open(self, part: Path, *, overwrite: bool) -> FillingDisk:
        self.files.append(FillingDisk(part, "wb"))
        self.files[-1].room = self.room
        return self.files[-1]

    def fill(self) -> None:
        self.room = 0
        for file in self.files:
            file.room = 0

    def clear(self) -> None:
        self.room = 1 << 40
        for file in self.files:
            file.room = self.room


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    found = Disk()
    monkeypatch.setattr(mcap_part, "open_part", found.open)
    return found


class Letters:
    """The front, which only listens."""

    def __init__(self) -> None:
        self.all: list[tuple[str, str, Any]] = []

    def send(self, kind: str, key: str, body: Any) -> None:
        self.all.append((kind, key, body))

    def of(self, kind: str) -> list[Any]:
        return [body for name, _, body in self.all if name == kind]

    @property
    def pauses(self) -> list[str]:
        return [body[1]["pause"] for body in self.of("told") if "pause" in body[1]]


def begun(folder: Path) -> tuple[Worker, Letters]:
    """A worker with one game, whose player is there."""
    letters = Letters()
    worker = Worker(
        letters,  # type: ignore[arg-type]
        [PlayPlan(app="rearrange", scenes="small:3", partner="still", out=str(folder), seats=("person",))],
    )
    worker.prepare = lambda key, body: None  # type: ignore[method-assign]
    ask(worker, Worker.begin, msgspec.to_builtins(GameOrder(index=0, name=KEY, resumes=True)))
    if KEY in worker.games:
        here(worker)
    return worker, letters


def ask(worker: Worker, act: Callable[..., None], body: Any) -> None:
    worker.guarded(KEY, act, body)


def here(worker: Worker) -> Running:
    running = worker.games[KEY]
    ask(worker, Worker.here, {"agent": next(iter(running.game.drivers)), "here": True})
    return running


def press(worker: Worker, text: str) -> None:
    ask(worker, Worker.input, [next(iter(worker.games[KEY].game.drivers)), text, 0.0])


def play(worker: Worker, steps: int) -> None:
    for _ in range(steps):
        if KEY in worker.games and worker.games[KEY].runs:
            ask(worker, Worker.step, None)


def try_again(worker: Worker) -> None:
    worker._tried = -1e9
    worker.try_disk()
    while worker._waiting:
        worker.begin_next()


def whole(path: Path, steps: int) -> bool:
    recording = read_mcap(path)
    return len(recording) == steps and verify(recording).difference is None


def test_a_game_waits_for_space_and_goes_on(tmp_path: Path, disk: Disk) -> None:
    worker, letters = begun(tmp_path)
    running = worker.games[KEY]
    press(worker, '{"k":"move","f":0.5,"t":0.2}')
    play(worker, 40)
    disk.fill()
    play(worker, 100)
    steps = len(running.game.session.recorder)
    assert steps == 60, "it stands still as soon as a second could not be written"
    assert letters.of("stuck") == [{"why": "No space left on device", "text": DISK_FULL}]
    assert letters.pauses == [DISK_FULL]
    for k in range(300):
        press(worker, f'{{"k":"move","f":{k / 1000}}}')
    press(worker, '{"k":"drop"}')
    try_again(worker)
    assert (letters.of("free"), running.runs) == ([], False)
    worker.here(KEY, {"agent": 0, "here": False})
    here(worker)
    assert letters.pauses[-1] == DISK_FULL, "whoever comes is told"
    disk.clear()
    try_again(worker)
    assert letters.of("free") == [{}]
    assert letters.pauses[-1] == ""
    play(worker, 30)
    press(worker, '{"k":"leave"}')
    (over,) = letters.of("over")
    assert (over["ended"], over["steps"], over["path"]) == ("closed", steps + 30, str(tmp_path / "000000.mcap"))
    assert set(over["texts"].values()) == {"The episode has been ended."}
    assert whole(tmp_path / "000000.mcap", steps + 30)
    last = [event.payload for event in read_mcap(tmp_path / "000000.mcap").inputs if event.kind == "client"][-2]
    assert '"f":0.299' in last, "which keys are down is known"
    assert not letters.of("failed")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000000.mcap", "h3"]


def test_the_end_of_a_game_waits_for_space(tmp_path: Path, disk: Disk) -> None:
    worker, letters = begun(tmp_path)
    play(worker, 40)
    disk.fill()
    press(worker, '{"k":"leave"}')
    assert not letters.of("over")
    assert len(letters.of("stuck")) == 1
    disk.clear()
    try_again(worker)
    assert letters.of("over")[0]["steps"] == 40
    assert whole(tmp_path / "000000.mcap", 40)
    again, answers = begun(tmp_path)  # a server that was killed before it had noted the end
    assert not again.games
    assert answers.of("over")[0]["ended"] == "closed"
    assert whole(tmp_path / "000000.mcap", 40)


def test_a_server_that_is_stopped_while_the_disk_is_full_leaves_what_is_written(
    tmp_path: Path, disk: Disk, caplog: pytest.LogCaptureFixture
) -> None:
    worker, _ = begun(tmp_path)
    play(worker, 70)
    disk.fill()
    worker.close_all(finish=True)
    assert "is not finished (No space left on device); the same command goes on with it" in caplog.text
    assert "Traceback" not in caplog.text
    assert [path.name for path in tmp_path.glob("*.mcap*")] == ["000000.mcap.part"]
    again, letters = begun(tmp_path)  # the disk is still full
    assert not again.games
    assert letters.of("stuck") == [{"why": "No space left on device", "text": DISK_FULL}]
    try_again(again)
    assert [path.name for path in tmp_path.glob("*.mcap*")] == ["000000.mcap.part"], "it is not called broken"
    disk.clear()
    try_again(again)
    assert letters.of("begun") == [{"steps": 60}]
    here(again)
    play(again, 10)
    press(again, '{"k":"leave"}')
    assert whole(tmp_path / "000000.mcap", 70)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["000000.mcap", "h3"]


@pytest.mark.slow
def test_a_recovery_that_is_killed_loses_nothing(tmp_path: Path, disk: Disk, monkeypatch: pytest.MonkeyPatch) -> None:
    worker, _ = begun(tmp_path)
    play(worker, 70)
    worker.close_all(finish=False)
    monkeypatch.setattr("h3data_play.live.LiveGame.play_again", lambda game, recording: game.session.recorder.abort())
    for _ in range(2):
        begun(tmp_path)
    monkeypatch.undo()
    again = EpisodeFactory(PlayPlan(app="rearrange", scenes="small:3", partner="still", out=str(tmp_path))).begin(
        GameOrder(index=0, name=KEY)
    )
    assert len(again.session.recorder) == 70
    again.close()
    assert whole(tmp_path / "000000.mcap", 70)


# --- the whole server -------------------------------------------------------------------------------------------------
@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 3 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", folder], capture_output=True)
    if mounted.returncode:
        pytest.skip("a small disk can be mounted by root only")
    yield folder
    subprocess.run(["umount", "-l", folder], check=True)


async def fills_up(server: Server, folder: Path) -> int:
    async with Bot(server.links[0]) as bot:
        assert await bot.sit() == 200
        await bot.connect()
        await bot.until(lambda: bot.step > 40)
        with (folder / "filler").open("wb", buffering=0) as filler:
            while True:
                try:
                    filler.write(bytes(4096))
                except OSError:
                    break
        await bot.until(lambda: DISK_FULL in bot.heard("pause"), 30)
        stood = bot.step
        assert (await asyncio.to_thread(server.report))["disk"]["is_full"]
        await asyncio.sleep(3.0)
        assert bot.step == stood
        assert bot.close_code is None
        os.unlink(folder / "filler")
        await bot.until(lambda: bot.step > stood + 2 / PERIOD_S)
        assert bot.heard("pause")[-1] == ""
        assert not (await asyncio.to_thread(server.report))["disk"]["is_full"]
        await bot.socket.send_str('{"k":"leave"}')
        await bot.until(lambda: bot.heard("over"))
        return bot.step


@pytest.mark.slow
def test_a_session_on_a_disk_that_fills_up(small_disk: Path) -> None:
    with Server(small_disk / "rec", app="tutorial", partner="solo") as server:
        steps = asyncio.run(fills_up(server, small_disk))
        assert server.stop() == 0
    assert whole(small_disk / "rec" / "000000.mcap", steps)
    assert not list((small_disk / "rec").glob("*.part*"))
