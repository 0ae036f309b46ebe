"""Homes of two storeys in live play: the page is told how high the floor is, people and robots climb the stairs, recordings
verify."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from h3data.bodies import Robot
from h3data.recording import read_mcap
from h3data.replay import Replay
from h3data.scene.floor_heights import HIGH, LOW, STEPS
from h3data_play import assets
from h3data_play.live import LiveGame
from h3data_play.plan import GameOrder
from sim_kinematic.motion.step import stairs_speeds
from sim_kinematic.tasks.resume import verify
from tests.play.test_live import Player, table

HOME = "small2-storeys:3"


def other_storey(game: LiveGame, xz: np.ndarray) -> list[float]:
    """A point of the free floor on the storey where ``xz`` is not."""
    free = game.session.episode.free
    here = float(free.height_at(xz))
    levels = free.heights[(free.heights[:, LOW] == free.heights[:, HIGH]) & (free.heights[:, STEPS] == 0)]
    far = levels[np.abs(levels[:, LOW] - here) > 1]
    places = free.snap((far[:, :2] + far[:, 2:4]) / 2)
    reachable = [
        place for place in places if len(free.path(xz, place)) and abs(float(free.height_at(place)) - here) > 1
    ]
    x, z = reachable[0].tolist()
    return [x, float(free.height_at([x, z])), z]


# the robot is as long as it is: where it cannot turn on the spot, it is led nowhere, on any floor; there it stands well
@pytest.mark.slow
@pytest.mark.parametrize(
    ("seat", "episode", "near_m"), [("person", 0, 0.05), pytest.param("robot", 2, 0.4, marks=pytest.mark.slow)]
)
def test_stairs_are_climbed_by_a_click(tmp_path: Path, seat: str, episode: int, near_m: float):
    game = table(tmp_path, scenes=HOME, seats=(seat,), partner="solo").begin(GameOrder(index=episode, name="000000"))
    player, free = Player(game), game.session.episode.free
    player.play()
    start = player.base[[0, 2]].astype(np.float64)
    goal = other_storey(game, start)
    assert player.send(k="goto", p=goal) == ""
    heights, places = [], []
    player.play()
    while player.busy:
        player.play()
        heights.append(float(player.base[1]))
        places.append(player.base[[0, 2]].astype(np.float64))
    assert np.hypot(*(places[-1] - goal[::2])) < near_m
    assert abs(heights[-1] - goal[1]) < 0.01
    assert abs(heights[-1] - heights[0]) > 2
    assert np.abs(np.diff(heights)).max() < 0.1, "by a ramp, not by a jump"
    slow = stairs_speeds(free.heights, np.array(places)) < 0.5
    moved = np.hypot(*np.diff(places, axis=0).T)
    assert slow.sum() > 20
    assert moved[slow[:-1]].max() < 0.5 * moved.max(), "slower on stairs, as the page predicts"
    game.close()
    assert verify(read_mcap(tmp_path / "000000.mcap")).difference is None


@pytest.mark.slow
def test_the_page_is_told_how_high_the_floor_is(tmp_path: Path):
    game = LiveGame(table(tmp_path, scenes=HOME), 0)
    said = assets.manifest(game.session, game.app, {})
    np.testing.assert_allclose(said["heights"], game.session.episode.free.heights, atol=1e-6)
    robot = game.session.episode.roster[0].body
    assert isinstance(robot, Robot)
    assert said["agents"][0]["climbs"] == robot.climbing_length_m > 0.3
    level = LiveGame(table(tmp_path), 0)
    assert assets.manifest(level.session, level.app, {})["heights"] == []


@pytest.mark.slow
def test_people_recorded_by_clips_are_sent_on_the_treads_as_replays_show_them(tmp_path: Path):
    game = LiveGame(table(tmp_path, app="social_nav", scenes=HOME, partner="still"), 0)
    player, robot = Player(game), game.session.episode.roster[0].body
    assert isinstance(robot, Robot)
    at = 16 + 12 + 2 * len(robot.joint_names) + 12
    player.play()
    player.send(k="goto", p=other_storey(game, player.base[[0, 2]].astype(np.float64)))
    sent = []
    for _ in range(600):
        if player.busy or not sent:
            player.play()
            sent.append(struct.unpack_from("<3f", game.state(player.number, 0.0, whole=False), at))
    recording = game.close()
    assert recording is not None
    pelvis = Replay(recording, detail=False).joint_matrices(player.number, np.arange(1, len(recording)))[:, 0, :3, 3]
    assert np.ptp(pelvis[:, 1]) > 2
    assert np.abs(np.array(sent) - pelvis).max() < 1e-4
