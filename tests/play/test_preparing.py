"""Episodes are prepared by the spare worker, so that games that go on do not stand still."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from h3data_play import workers as module
from h3data_play.connections import Live
from h3data_play.front import WebServer
from h3data_play.live import EpisodeFactory
from h3data_play.plan import GameOrder, PlayPlan
from h3data_play.worker import Worker
from h3data_play.workers import Preparer, WorkerProcess
from sim_kinematic.tasks.rearrange import codec

ORDER = GameOrder(index=3, name="000003")
MADE = {"manifest": {}, "agents": [1], "facts": {"solo_steps": 7}, "glb": ["a.glb", b"x"], "grid": ["b.sdf", b"y"]}


class Spare:
    """A worker of which only the letters that it gets are seen."""

    def __init__(self) -> None:
        self.games: set[str] = set()
        self.letters: list[tuple[str, str, Any]] = []

    def send(self, kind: str, key: str, body: Any) -> None:
        self.letters.append((kind, key, body))


class Spares:
    """Workers of which one is spare."""

    def __init__(self, spare: Spare | None) -> None:
        self.spare = spare

    def ready_spare(self) -> Spare | None:
        return self.spare

    async def warm_spare(self) -> Spare | None:
        return self.spare


def test_what_the_spare_found_out_is_not_simulated_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def simulated(*_: Any) -> int:
        raise AssertionError("the worlds of others would stand still")

    monkeypatch.setattr(codec, "_simulated_solo_steps", simulated)
    table = EpisodeFactory(PlayPlan(app="rearrange", out=str(tmp_path), partner="still", scenes="small:2"))
    game = table.begin(GameOrder(index=5, name="x", facts={"solo_steps": 432}))
    game.step()
    recording = game.close()
    assert recording is not None
    assert recording.episode.info["solo_steps"] == 432


def test_an_episode_is_asked_for_once_and_waited_for() -> None:
    async def ask() -> None:
        spare = Spare()
        preparer = Preparer(Spares(spare))  # type: ignore[arg-type]
        waiting = asyncio.create_task(preparer.wait(ORDER))
        await asyncio.sleep(0)
        assert preparer.ask(ORDER) is not None
        assert spare.letters == [("prepare", "0/3", {"plan": 0, "index": 3})]
        preparer.heard("0/3", dict(MADE))
        made = await waiting
        assert made is not None
        assert (made["glb"], made["facts"]) == ("world/a.glb", {"solo_steps": 7})
        assert preparer.files["b.sdf"] == (b"y", "application/octet-stream")
        assert preparer.ask(ORDER) is None, "it has been made"
        for k in range(module.MOST_FILES):
            preparer.heard(f"1/{k}", {**MADE, "glb": [f"{k}.glb", b"x"]})
        assert preparer.made(ORDER) is None, "its home has made room for others"

    asyncio.run(ask())


def test_without_a_spare_or_with_one_that_says_nothing_the_worker_does_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "PREPARE_S", 0.05)

    async def ask() -> None:
        workers = Spares(None)
        preparer = Preparer(workers)  # type: ignore[arg-type]
        assert await preparer.wait(ORDER) is None
        workers.spare = first = Spare()
        assert await preparer.wait(ORDER) is None
        workers.spare = second = Spare()
        preparer.ask(ORDER)
        assert len(first.letters) == len(second.letters) == 1, "another spare is asked again"

    asyncio.run(ask())


def test_the_episodes_after_those_that_are_played_are_prepared_ahead(tmp_path: Path) -> None:
    async def ask() -> None:
        plan = PlayPlan(app="rearrange", out=str(tmp_path), seats=("person",), episodes=6)
        front, spare = WebServer(plan, tables=2), Spare()
        front.workers.ready_spare = lambda: spare  # type: ignore[assignment, return-value]
        front.journal.begin(0)
        front._prepare_next()
        front._prepare_next()
        assert [body["index"] for _, _, body in spare.letters] == [1, 2], "as many as there are tables, each once"
        for _ in range(4):
            front.journal.begin(0)
        front._prepare_next()
        assert [body["index"] for _, _, body in spare.letters] == [1, 2, 5], "never more than there are"

    asyncio.run(ask())


def test_a_game_beside_others_begins_when_the_spare_is_warm_and_has_prepared_it(tmp_path: Path) -> None:
    async def begin() -> None:
        front = WebServer(PlayPlan(app="rearrange", out=str(tmp_path), seats=("person",), episodes=6), tables=6)
        plays, warming = Spare(), asyncio.get_running_loop().create_future()
        front.workers.spare = cast("Any", warming)
        lives = []

        def begun() -> Live:
            live = Live(front.journal.begin(len(lives)), cast("WorkerProcess", plays), asyncio.Future())
            front.lives[live.game.key] = live
            front._begin(live, live.worker)
            lives.append(live)
            return live

        begun().begun.set_result({})
        assert [letter[:2] for letter in plays.letters] == [("begin", "000000")], "nobody plays whom it would disturb"
        begun()
        await asyncio.sleep(0.01)
        assert len(plays.letters) == 1, "it would stop the first game for a second"
        warming.set_result(spare := Spare())
        await asyncio.sleep(0.01)
        assert [letter[:2] for letter in spare.letters] == [("prepare", "0/1")]
        front.preparer.heard("0/1", dict(MADE))
        await asyncio.sleep(0.01)
        assert [letter[:2] for letter in plays.letters] == [("begin", "000000"), ("begin", "000001")]
        assert plays.letters[1][2]["facts"] == MADE["facts"]

    asyncio.run(begin())


def test_homes_of_the_next_episodes_are_made_one_at_a_time_while_nobody_plays(tmp_path: Path) -> None:
    plan = PlayPlan(app="rearrange", out=str(tmp_path), partner="still", scenes="small", episodes=3)
    worker = Worker(cast("Any", None), [plan])
    source = worker.table(0).source
    needed = {source.home_of(plan.seed, index) for index in range(3)}
    ready = [sum(home.is_ready for home in source.homes) for _ in worker.homes_ahead()]
    assert ready == list(range(1, len(needed) + 1)), "each once, and then there is nothing to do"


def test_games_begin_one_at_a_time_and_not_while_another_is_late(tmp_path: Path) -> None:
    worker = Worker(
        cast("Any", None), [PlayPlan(app="rearrange", out=str(tmp_path), partner="still", scenes="small:2")]
    )
    begun: list[str] = []
    worker.guarded = lambda key, act, body: begun.append(key)  # type: ignore[method-assign]
    now = time.monotonic()
    worker._waiting.extend((key, {}, now) for key in "abc")
    worker.begin_next()
    assert begun == ["a"]
    late = SimpleNamespace(runs=True, due=now - 1)
    worker.games["late"] = cast("Any", late)
    worker.begin_next()
    assert begun == ["a"], "the late one first"
    late.due = now + 60
    worker.begin_next()
    assert begun == ["a", "b"]
    late.due = now - 1
    worker._waiting[0] = ("c", {}, now - 60)
    worker.begin_next()
    assert begun == ["a", "b", "c"], "nobody waits for ever"
