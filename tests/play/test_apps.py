"""Apps: the tutorial, tele-operation, and the one that docs/play.md shows, played through a socket by the command line."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from h3data.errors import InputError
from h3data.plugins import PluginError
from h3data.recording import read_mcap
from h3data_play.app import find_app
from h3data_play.apps.tutorial import LOOK, PUT, TAKE, WALK
from h3data_play.live import LiveGame
from h3data_play.plan import GameOrder
from sim_kinematic.tasks.resume import verify
from tests.paths import ROOT
from tests.play.bot import Bot
from tests.play.test_live import Player, bring, table

FIRST = GameOrder(index=0, name="000000")
ENTRY = "from h3data_pipelines.cli import entry; entry()"
"""What the console script runs; -P: like there, the folder is not on the path by itself."""


def to_the_thing(player: Player) -> None:
    """The first two steps of the tutorial."""
    app, number = player.game.app, player.number
    marker = app.hud(number).marker
    assert marker is not None
    player.play()
    assert player.send(k="pick", o=0, lead=True).startswith("Not yet: first ")
    player.play(2)
    assert not player.busy, "what is refused does not happen"
    player.send(k="goto", p=list(marker))
    player.until_free()
    assert app.step_of(number) == LOOK  # type: ignore[attr-defined]
    assert app.hud(number).marker is None
    player.send(k="move", f=0.0, t=0.4)
    while app.step_of(number) == LOOK:  # type: ignore[attr-defined]
        player.play()
    player.send(k="move", f=0.0, t=0.0)


@pytest.mark.parametrize("seat", ["person", pytest.param("robot", marks=pytest.mark.slow)])
def test_the_tutorial_goes_step_by_step(tmp_path: Path, seat: str):
    game = table(tmp_path, app="tutorial", partner=None, seats=(seat,)).begin(FIRST)
    player = Player(game)
    assert len(game.session.episode.roster) == 1, "nobody else is at home"
    app = game.app
    assert app.step_of(player.number) == WALK  # type: ignore[attr-defined]
    assert app.hud(player.number).lines[0].startswith("→ Walk" if seat == "person" else "→ Drive")
    to_the_thing(player)
    assert app.step_of(player.number) == TAKE  # type: ignore[attr-defined]
    player.send(k="pick", o=0, lead=True)
    player.until_free()
    assert app.step_of(player.number) == PUT  # type: ignore[attr-defined]
    bring_to_goal = list(app.goals()[0].position)
    player.send(k="place", p=bring_to_goal, lead=True)
    player.until_free()
    assert game.ended == "success"
    assert all(line.startswith("✓") for line in app.hud(player.number).lines)
    assert "all steps" in app.over(player.number)
    game.close()
    assert verify(read_mcap(tmp_path / "000000.mcap")).difference is None


def test_a_killed_tutorial_goes_on_at_its_step(tmp_path: Path):
    player = Player(table(tmp_path, app="tutorial", partner=None).begin(FIRST))
    to_the_thing(player)
    player.play(3)
    player.game.session.abort()  # as a process that is killed
    again = table(tmp_path, app="tutorial", partner=None).begin(FIRST)
    assert again.app.step_of(player.number) == TAKE  # type: ignore[attr-defined]
    again.close()


def test_tele_operation_of_the_robot(tmp_path: Path):
    alone = table(tmp_path, app="teleop", partner=None, seats=("robot",))
    assert alone.roster == ("robot",)
    game = alone.begin(FIRST)
    player = Player(game)
    player.send(k="move", f=1.0, t=0.0)
    player.play(90)
    assert re.search(r"Bumps into the home: [1-9]\d*\.$", game.app.hud(player.number).lines[-1]), (
        "it drove ahead for 3 s"
    )
    assert re.search(r"empty; the .* is [\d.]+ m away", game.app.hud(player.number).lines[1])
    player.send(k="move", f=0.0, t=0.0)
    player.send(k="pick", o=0, lead=True)
    player.until_free()
    assert game.app.hud(player.number).lines[1].startswith("The gripper holds the ")
    for k in (0, 1):
        if k:
            bring(player, k)
        else:
            player.send(k="place", p=list(game.app.goals()[0].position), lead=True)
            player.until_free()
    assert game.ended == "success", player.said
    game.close()
    assert verify(read_mcap(tmp_path / "000000.mcap")).difference is None


def test_tele_operation_beside_a_person(tmp_path: Path):
    game = LiveGame(table(tmp_path, app="teleop", partner="both", seats=("robot",)), 0)
    assert [member.kind for member in game.session.episode.roster] == ["robot", "human"]
    Player(game).play(5)
    assert "Touches of people: 0" in game.app.hud(0).lines[-1]


def test_what_is_no_app_says_so():
    with pytest.raises(InputError, match=r"(?s)Did you mean 'tutorial'.*H3-FILE-011"):
        find_app("tutoral")
    with pytest.raises(PluginError, match=r"(?s)Expected a subclass.*H3-FILE-016"):
        find_app("json:dumps")


@pytest.fixture
def own_app(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """``h3data play my_app:Parade`` in the folder of the app that docs/play.md shows, and its link."""
    code = re.search(r"```python\n(# my_app.py\n.*?)```", (ROOT / "docs" / "play.md").read_text(), re.DOTALL)
    assert code is not None
    assert len(code[1].splitlines()) < 60
    (tmp_path / "my_app.py").write_text(code[1])
    command = [sys.executable, "-P", "-c", ENTRY, "play", "my_app:Parade", "--no-browser", "-o", "rec"]
    process = subprocess.Popen(
        command,
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    assert process.stderr is not None
    said = ""
    for line in process.stderr:
        said += line
        if "http://" in line:
            break
    yield process, said.split()[-1]
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    process.communicate(timeout=30)


async def parade(link: str) -> Bot:
    async with Bot(link) as bot:
        assert await bot.sit() == 200, bot.told
        await bot.connect()
        await bot.until(lambda: bot.states)
        await bot.send(k="move", f=0.6, t=0.35)
        await bot.until(lambda: bot.heard("over"), 60)
    return bot


@pytest.mark.slow
def test_an_app_of_ones_own_is_played_over_a_socket(own_app: tuple[subprocess.Popen[str], str], tmp_path: Path):
    process, link = own_app
    bot = asyncio.run(parade(link))
    assert bot.heard("over")[0]["ended"] == "paraded"
    assert bot.heard("hud")[0]["task"] == "Walk about for five seconds."
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 0, out
    assert "paraded after" in out
    recording = read_mcap(tmp_path / "rec" / "000000.mcap")
    assert recording.episode.info["hitl"]["app"] == "my_app:Parade"
    assert verify(recording).difference is None


def test_a_policy_of_robots_alone_drives_the_robot_among_people(tmp_path: Path):
    game = table(tmp_path, app="crowd", scenes="small:0", partner="reinforced").begin(FIRST)
    Player(game).play(20)
    named = [(assigned.kind, assigned.name) for assigned in game.session.policies]
    assert named[0] == ("robot", "reinforced")
    assert {name for kind, name in named if kind == "human"} == {"external", "orca"}
    game.close()
    with pytest.raises(InputError, match="H3-POLICY"):
        table(tmp_path, app="crowd", scenes="small:0", partner="mpcc")
