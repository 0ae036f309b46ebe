"""Doors and drawers in live play: opened and closed by messages, told in states, played again after a crash."""

from __future__ import annotations

import asyncio
import base64
import random
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from h3data.errors import InputError
from h3data.recording import read_mcap
from h3data.recording.records import JOINTS
from h3data_play import assets
from h3data_play.drivers import DOOR_SHUT
from h3data_play.live import EpisodeFactory, LiveGame
from h3data_play.messages import Pick
from h3data_play.plan import GameOrder
from h3data_play.worker import Worker
from sim_kinematic.tasks.resume import verify
from tests.play.test_live import Player, bring, table

HOME = {"scenes": "small-open:2", "seed": 5}
"""The second thing of its first episode, a mug, lies in a drawer that is closed."""
MUG = 1


def opening(out: Path, **changes: object) -> EpisodeFactory:
    """A table in that home."""
    return table(out, **{**HOME, **changes})


def joints_told(player: Player, *, whole: bool) -> dict[int, float]:
    """Positions by joint at the end of the player's state."""
    game = player.game
    assert game.packed is not None
    data = game.state(player.number, 0.0, whole=whole)
    things = game.packed.objects if whole else game.packed.moved
    at = 16 + len(game.packed.agent_bytes) + things.nbytes
    return dict(struct.iter_unpack("<Hf", data[at:]))


@pytest.mark.slow
def test_a_player_is_told_only_of_what_their_own_eyes_have_met(tmp_path: Path):
    """The server decides: neither points, nor what shuts a thing in, nor why it cannot be taken tell where it is."""
    told: list[Any] = []

    class Page:
        def send(self, kind: str, key: str, body: Any) -> None:
            if kind == "told":
                told.append(body[1])

    for observe in ("full", "seen"):
        worker = Worker(Page(), [opening(tmp_path / observe, rules={"observe": observe}).plan])  # type: ignore[arg-type]
        worker.begin("g", msgspec.to_builtins(GameOrder(index=0, name="000000", facts={})))
        game = worker.games["g"].game
        number = next(iter(game.drivers))
        worker.here("g", {"agent": number, "here": True})
        told.clear()
        worker.step("g", None)
        if observe == "full":
            assert game.seen(number) is None
            assert not any("seen" in message for message in told)
            game.close()
            continue
        (message,) = (m for m in told if "seen" in m)
        sight = game.session.play.team.objects.sight  # type: ignore[attr-defined]
        assert [point is not None for point in message["seen"]] == sight.known[number].tolist()
        assert message["seen"][MUG] is None
        assert game.seen(-1) is None
        assert game.barriers(number)[MUG][0] == -1, "it lies in a drawer, which is not told"
        assert "not seen" in game.take(number, Pick(o=MUG, lead=True), "", 0.0)
        told.clear()
        sight.known[number, MUG], sight.where[number, MUG] = True, (1.0, 0.84, 2.0)
        worker.step("g", None)
        assert [m["seen"][MUG] for m in told if "seen" in m] == [[1.0, 0.8, 2.0]]
        assert game.barriers(number)[MUG][0] >= 0
        told.clear()
        worker.step("g", None)
        assert not any("seen" in m for m in told), "once"
        game.close()


@pytest.mark.slow  # quick: what cannot be opened; tasks/test_opening.py
def test_a_drawer_is_opened_emptied_and_closed_and_the_recording_verifies(tmp_path: Path):
    game = opening(tmp_path).begin(GameOrder(index=0, name="000000"))
    player, still = Player(game), 0
    player.play()
    drawer = game.barriers(player.number)[MUG][0]
    assert game.barriers(player.number) == [[-1, -1], [drawer, -1]]
    assert player.send(k="pick", o=MUG, lead=True) == "It is in something that is closed."
    assert player.send(k="open", j=drawer, lead=True) == ""
    known = joints_told(player, whole=True)
    assert sorted(known) == list(range(game.columns[JOINTS].shape[1])), "whoever comes is told of all"
    player.play()
    while player.busy:
        before = game.columns[JOINTS][-1].copy()
        player.play()
        told = joints_told(player, whole=False)
        assert set(told) == set(np.flatnonzero(game.columns[JOINTS][-1] != before)), "then of those that move"
        still += not told
        known |= told
    assert still > 10
    assert known == dict(enumerate(game.columns[JOINTS][-1].tolist()))
    assert known[drawer] == pytest.approx(game.session.play.team.openables.joints.opened[drawer])  # type: ignore[attr-defined]
    assert game.barriers(player.number) == [[-1, -1], [-1, -1]]
    player.send(k="pick", o=MUG, lead=True)
    player.until_free()
    assert player.send(k="close", j=drawer, lead=True) == "The hand already holds something."
    player.send(k="place", p=list(game.app.goals()[MUG].position), lead=True)
    player.until_free()
    player.send(k="close", j=drawer, lead=True)
    player.until_free()
    assert player.said == []
    assert joints_told(player, whole=True)[drawer] == pytest.approx(0, abs=1e-6)
    game.close()
    recording = read_mcap(tmp_path / "000000.mcap")
    assert verify(recording).difference is None
    name = game.session.play.team.openables.joints.names[drawer]  # type: ignore[attr-defined]
    assert [(e.kind, e.target) for e in recording.events if e.kind in ("open", "close")] == [
        ("open", name),
        ("close", name),
    ]


ROOMS = {"scenes": "small2-doors:0", "seed": 2}
"""Two closed doors, one after the other, are between the person and the cup, the first thing of the episode."""
CUP = 0


@pytest.mark.slow
def test_a_closed_door_between_rooms_is_named_and_told(tmp_path: Path):
    player = Player(LiveGame(opening(tmp_path, **ROOMS), 0))
    player.play()
    game, play = player.game, player.game.session.play
    doors = play.team.doorways.joints  # type: ignore[attr-defined]
    cup, other = play.team.objects.poses[:, :3].tolist()  # type: ignore[attr-defined]
    (door, at_goal), (of_other, at_its_goal) = game.barriers(player.number)
    assert (of_other, door) == (-1, at_goal) == (-1, at_its_goal)
    assert door in doors
    assert game.barriers(-1) == [], "who only watches opens nothing"
    refused = [
        player.send(k="pick", o=CUP, lead=True),
        player.send(k="goto", p=cup),
        *(player.send(k="open", j=k, lead=True) for k in doors if k != door),
    ]
    assert refused == [DOOR_SHUT] * (1 + len(doors))
    allowed = [
        player.send(k="open", j=door, lead=True),
        player.send(k="goto", p=other),
        player.send(k="pick", o=1 - CUP, lead=True),
    ]
    assert allowed == [""] * 3
    labels = {
        k: joint["label"]
        for k, joint in enumerate(assets.manifest(game.session, game.app, {})["joints"])
        if joint["passage"]
    }
    assert labels == dict.fromkeys(doors, "door")


@pytest.mark.slow
def test_doors_between_rooms_are_named_one_after_the_other(tmp_path: Path):
    player = Player(opening(tmp_path, **ROOMS).begin(GameOrder(index=0, name="000000")))
    player.play()
    game, opened = player.game, list[int]()
    while (door := game.barriers(player.number)[CUP][0]) >= 0:
        assert door not in opened
        assert player.send(k="open", j=door, lead=True) == ""
        player.until_free()
        player.play(5)
        opened.append(door)
    assert len(opened) == 2
    assert player.send(k="pick", o=CUP, lead=True) == ""
    player.until_free()
    assert player.said == []
    assert game.columns[f"agent_{player.number}.grasp_body"][-1] >= 0
    game.close()
    assert verify(read_mcap(tmp_path / "000000.mcap")).difference is None


@pytest.mark.slow  # in the quick suite, test_live has one without a drawer
def test_a_game_that_was_killed_while_a_drawer_opened_goes_on(tmp_path: Path):
    player = Player(opening(tmp_path).begin(GameOrder(index=0, name="000000")))
    player.play()
    drawer = player.game.barriers(player.number)[MUG][0]
    player.send(k="open", j=drawer, lead=True)
    while not 0.1 < player.game.columns[JOINTS][-1, drawer] < 0.3:
        player.play()
    player.game.session.abort()
    again = opening(tmp_path).begin(GameOrder(index=0, name="000000"))
    np.testing.assert_array_equal(again.columns[JOINTS], player.game.columns[JOINTS])
    np.testing.assert_array_equal(again.columns["object_pose"], player.game.columns["object_pose"])
    assert again.barriers(player.number) == player.game.barriers(player.number)
    other = Player(again)
    other.seq = player.seq
    assert len(joints_told(other, whole=True)) == again.columns[JOINTS].shape[1]
    other.until_free()
    assert again.barriers(player.number)[MUG] == [-1, -1]
    again.close()
    assert verify(read_mcap(tmp_path / "000000.mcap")).difference is None


@pytest.mark.slow
def test_a_played_robot_opens_and_takes(tmp_path: Path):
    game = opening(tmp_path, seats=("robot",), partner="solo").begin(GameOrder(index=0, name="000000"))
    player = Player(game)
    player.play()
    player.send(k="open", j=game.barriers(player.number)[MUG][0], lead=True)
    player.until_free()
    bring(player, MUG)
    assert game.session.play.team.at_goal[MUG], player.said  # type: ignore[attr-defined]
    game.close()
    assert verify(read_mcap(tmp_path / "000000.mcap")).difference is None


@pytest.mark.slow
def test_what_cannot_be_opened(tmp_path: Path):
    player = Player(LiveGame(opening(tmp_path), 0))
    player.play()
    count = player.game.columns[JOINTS].shape[1]
    for kind in ("open", "close"):
        with pytest.raises(InputError, match="H3-PLAY-016"):
            player.send(k=kind, j=count)
    player.send(k="open", j=0)
    player.until_free()
    player.send(k="close", j=player.game.barriers(player.number)[MUG][0], lead=True)
    player.until_free()
    assert player.said == ["It is too far away to reach from here.", "It is closed already."]
    plain = Player(LiveGame(table(tmp_path), 0))
    plain.play()
    assert plain.game.barriers(plain.number) == []
    with pytest.raises(InputError, match="H3-PLAY-016"):
        plain.send(k="open", j=0)


@pytest.mark.slow
def test_the_page_learns_of_joints_only_where_they_move(tmp_path: Path):
    def manifest(**changes: object) -> dict[str, object]:
        game = LiveGame(opening(tmp_path, **changes), 0)
        return assets.manifest(game.session, game.app, {})

    found = manifest()
    joints = found["joints"]
    assert isinstance(joints, list)
    labels = [joint["label"] for joint in joints]
    assert {"fridge door", "kitchen counter drawer", "dishwasher rack"} <= set(labels)
    movable = {thing["name"] for thing in found["objects"]}  # type: ignore[attr-defined]
    moved = [name for joint in joints for name in joint["nodes"]]
    assert len(moved) == len(set(moved)), "nothing is moved twice"
    assert not movable & set(moved), "things have poses of their own"
    assert all(joint["parent"] < k for k, joint in enumerate(joints))
    assert manifest(app="social_nav")["joints"] == [], "there nothing opens"
    assert manifest(scenes="small:2")["joints"] == []


@pytest.mark.slow
def test_pages_are_told_of_the_floor_when_it_has_changed(tmp_path: Path):
    told: list[dict[str, Any]] = []

    class Page:
        def send(self, kind: str, key: str, body: Any) -> None:
            if kind == "told":
                told.append(body[1])

    worker = Worker(Page(), [opening(tmp_path).plan])  # type: ignore[arg-type]
    worker.begin("g", msgspec.to_builtins(GameOrder(index=0, name="000000", facts={})))
    game = worker.games["g"].game
    number, free = next(iter(game.drivers)), game.session.episode.free

    def floors(steps: int) -> list[dict[str, Any]]:
        told.clear()
        for _ in range(steps):
            worker.step("g", None)
        return [message["floor"] for message in told if "floor" in message]

    worker.here("g", {"agent": number, "here": True})
    assert floors(2) == [], "the page has loaded it"
    assert sum("barriers" in message for message in told) == 1
    other = replace(free, sdf=free.sdf - np.float32(0.1))
    game.session.play.team.floor = other  # type: ignore[attr-defined]
    (message,) = floors(3)
    cells = np.frombuffer(zlib.decompress(base64.b64decode(message["cells"])), "<i2").reshape(message["shape"])
    np.testing.assert_allclose(cells * message["unit"], other.sdf, atol=0.6e-3)
    assert message["origin"] == pytest.approx(free.origin.tolist())
    game.session.play.team.floor = free  # type: ignore[attr-defined]
    assert len(floors(2)) == 1, "and back"
    for here in (False, True):
        worker.here("g", {"agent": number, "here": here})
    assert len(floors(2)) == 1, "to a page that may have been loaded again"
    worker.close_all(finish=False)


async def play_by_script(link: str) -> list[str]:
    """Kinds of the messages by which a scripted participant plays an episode to its end."""
    from h3data_studies.bots.participant import ScriptedParticipant

    kinds: list[str] = []

    class Noted(ScriptedParticipant):
        async def send(self, **message: object) -> int:
            kinds.append(str(message["k"]))
            return await super().send(**message)

    async with Noted(link, "bot") as bot:
        assert await bot.sit() == 200
        bot.chance = random.Random(1)
        await bot.connect()
        await bot.until(lambda: bot.step)
        await bot._play()
        over = (await bot.until(lambda: bot.heard("over")))[0]
        assert over["ended"] == "success"
    return kinds


@pytest.mark.slow
def test_scripted_participants_open_what_they_need(tmp_path: Path):
    from tests.play.server import Server

    with Server(tmp_path / "out", **HOME, speed=0) as server:
        kinds = asyncio.run(play_by_script(server.links[0]))
    assert kinds.count("open") == 1
    assert kinds.index("open") < len(kinds) - 1 - kinds[::-1].index("pick")
    assert verify(read_mcap(tmp_path / "out" / "000000.mcap")).difference is None
