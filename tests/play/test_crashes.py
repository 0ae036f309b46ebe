"""What a kill -9 costs: of a worker, of the front; and what fifty hostile clients do to two players."""

from __future__ import annotations

import asyncio
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import aiohttp
import pytest

from h3data.recording import read_mcap
from h3data_play.seats import JOURNAL
from sim_kinematic.tasks.resume import verify
from tests.play.bot import Bot
from tests.play.server import Server

pytestmark = pytest.mark.slow


async def walk(bot: Bot, seconds: float) -> None:
    """Steers about."""
    await bot.until(lambda: bot.states)
    chance, end = random.Random(bot.seq), time.monotonic() + seconds
    while time.monotonic() < end and not bot.socket.closed:
        await bot.send(k="move", f=chance.choice((0.3, 0.6)), t=chance.choice((-0.5, 0.0, 0.5)))
        await asyncio.sleep(0.1)


async def back(bot: Bot, seconds: float = 60.0) -> None:
    """Connects again as a page does, until the next state comes."""
    start, seen = time.monotonic(), len(bot.states)
    bot.close_code = None
    while time.monotonic() - start < seconds:
        try:
            await bot.connect()
            await bot.until(lambda: len(bot.states) > seen or bot.close_code, 10)
        except (aiohttp.ClientError, TimeoutError):
            pass
        if len(bot.states) > seen:
            return
        await asyncio.sleep(0.1)
    raise TimeoutError("the seat did not come back")


async def worker_is_killed(server: Server) -> tuple[int, int]:
    async with Bot(server.links[0]) as bot:
        assert await bot.sit() == 200
        await bot.connect()
        await asyncio.sleep(8.0)  # until the spare worker is warm
        await walk(bot, 3.0)
        before = bot.step
        os.kill(server.workers()[0], signal.SIGKILL)
        await bot.until(lambda: bot.close_code)
        await back(bot)
        first = bot.step
        await walk(bot, 1.0)
        await bot.socket.send_str('{"k":"leave"}')
        await bot.until(lambda: bot.heard("over"))
    return before, first


def test_a_killed_worker_costs_a_second(tmp_path: Path):
    with Server(tmp_path / "rec") as server:
        before, first = asyncio.run(worker_is_killed(server))
    assert before - first <= 45, "rows are flushed once a second"
    recording = read_mcap(tmp_path / "rec" / "000000.mcap")
    assert len(recording) > first
    assert verify(recording).difference is None


async def front_is_killed(server: Server, out: Path) -> tuple[int, int]:
    async with Bot(server.links[0]) as bot:
        assert await bot.sit() == 200
        await bot.connect()
        await walk(bot, 3.0)
        before, port = bot.step, server.reports[0]["ready"]["port"]
        server.stop(signal.SIGKILL)
        await bot.until(lambda: bot.close_code)
        with await asyncio.to_thread(Server, out, {"port": port}) as again:
            await back(bot)
            first = bot.step
            await walk(bot, 1.0)
            await bot.socket.send_str('{"k":"leave"}')
            await bot.until(lambda: bot.heard("over"))
            assert again.report()["over"]["ended"] == "closed"
    return before, first


def test_a_killed_front_loses_no_seat(tmp_path: Path):
    out = tmp_path / "rec"
    with Server(out) as server:
        before, first = asyncio.run(front_is_killed(server, out))
    assert before - first <= 3, "workers write down what they have when the front is gone"
    assert verify(read_mcap(out / "000000.mcap")).difference is None
    assert not (out / JOURNAL).exists(), "all has been played"


async def starter_is_gone(server: Server) -> None:
    async with Bot(server.links[0]) as bot:
        assert await bot.sit() == 200
        await bot.connect()
        await walk(bot, 1.0)
        assert server.process.stdin is not None
        server.process.stdin.close()
        assert await asyncio.to_thread(server.process.wait, 20) == 0


def test_a_server_ends_with_whoever_started_it(tmp_path: Path):
    """Its stdin ends when that process closes it or is killed."""
    out = tmp_path / "rec"
    with Server(out) as server:
        asyncio.run(starter_is_gone(server))
    assert verify(read_mcap(out / "000000.mcap")).difference is None


async def besieged(server: Server, seconds: float) -> dict[str, int]:
    async with Bot(server.links[0]) as first, Bot(server.links[0]) as second:
        for bot in (first, second):
            assert await bot.sit() == 200
            await bot.connect()
        command = [sys.executable, "-m", "tests.play.hostile", server.links[0], "50", str(seconds)]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        crowd = subprocess.Popen(command, stdout=subprocess.PIPE, env=environment)
        await asyncio.gather(walk(first, seconds), walk(second, seconds))
        said, _ = await asyncio.to_thread(crowd.communicate)
        for bot in (first, second):
            if not bot.heard("over"):  # else the robot has brought everything already
                assert bot.close_code is None
                await bot.socket.send_str('{"k":"leave"}')
                await bot.until(lambda bot=bot: bot.heard("over"))
        return json.loads(said)


def test_fifty_hostile_clients_end_no_session(tmp_path: Path):
    """How many states a second the players get is measured by ``python -m benchmarks hitl``, lines ``hitl.siege.*``."""
    with Server(tmp_path / "rec", {"tables": 60}, episodes=60, partner="complement") as server:
        answers = asyncio.run(besieged(server, 12.0))
        assert server.stop() == 0
        assert server.process.stdout is not None
        overs = [json.loads(line).get("over", {}) for line in server.process.stdout]
    assert answers["seat 503"], "twelve seats for one address, as far as the machine goes"
    assert {"strange socket 403", "wrong token 403", "noise"} <= set(answers)
    assert {what.partition(" ")[0] for what in answers} >= {"nonsense", "flood", "giant"}, answers
    assert not any(what.endswith((" 500", " 101")) for what in answers), answers
    assert [over["ended"] for over in overs if over.get("ended") == "failed"] == []
    players = [tmp_path / "rec" / f"{k:06d}.mcap" for k in (0, 1)]
    for path in players:
        assert verify(read_mcap(path)).difference is None
    assert not list((tmp_path / "rec").glob("*.part"))
