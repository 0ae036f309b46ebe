"""Live play among people of crowds: one player or eight in one home, beside others, recorded and verified; names over heads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from h3data.recording import read_mcap
from h3data_play import assets
from h3data_play.plan import GameOrder
from h3data_studies.design import Condition
from sim_kinematic.tasks.resume import verify
from tests.play.test_live import Player, table

FIRST = GameOrder(index=0, name="000000")


def test_one_player_walks_among_people_of_a_crowd(tmp_path: Path):
    game = table(tmp_path, app="crowd", partner=None, scenes="medium:1").begin(FIRST)
    player = Player(game)
    assert [member.kind for member in game.session.episode.roster] == ["robot", *["human"] * 4]
    assert "Walk about" in game.app.hud(player.number).task
    assert assets.manifest(game.session, game.app, {})["names"]
    for forward, turn in ((1.0, 0.0), (0.5, 0.8), (0.0, 0.0)):
        player.send(k="move", f=forward, t=turn)
        player.play(25)
    game.close()
    recording = read_mcap(tmp_path / "000000.mcap")
    assert verify(recording).difference is None
    ways = [np.hypot(*np.ptp(recording.columns[f"agent_{k}.base_pose"][:, [0, 2]], axis=0)) for k in range(5)]
    assert min(ways) > 0.1, "robot, player and crowd move"


def test_the_robot_is_driven_to_the_ring(tmp_path: Path):
    game = table(tmp_path, app="crowd", partner=None, scenes="medium:1", seats=("robot",)).begin(FIRST)
    hud = game.app.hud(0)
    assert hud.marker is not None
    assert np.allclose([hud.marker[0], hud.marker[2]], game.session.episode.extra["goal"])
    assert hud.lines[0].endswith("m to go")
    game.abort()


def test_eight_players_share_a_home(tmp_path: Path):
    plan = {"app": "crowd", "partner": None, "scenes": "large:1", "seats": ("person",) * 8, "names": True}
    game = table(tmp_path, **plan).begin(FIRST)
    assert sorted(game.drivers) == list(range(8)), "eight people play among themselves"
    players = [Player(game, number) for number in game.drivers]
    for player in players:
        player.send(k="move", f=1.0, t=0.1 * player.number)
    players[0].play(30)
    game.close()
    recording = read_mcap(tmp_path / "000000.mcap")
    assert len(recording.agents) == 8
    assert recording.episode.info["hitl"]["seats"] == ["person"] * 8
    assert verify(recording).difference is None


@pytest.mark.parametrize("names", [True, False])
def test_names_are_there_if_the_session_wants_them(tmp_path: Path, names: bool):
    game = table(tmp_path, app="rearrange", names=names).begin(FIRST)
    assert assets.manifest(game.session, game.app, {})["names"] is names
    game.abort()
    assert Condition(name="a", names=names).names is names
    assert not Condition(name="a").names, "studies of before have none"
