"""examples/fetch.py: a task with things in one file, which goes where built-in tasks go."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from examples.fetch import Fetch, drawer_of
from h3data.errors import SceneError
from h3data.recording import Recording, read_mcap
from h3data.scene import Scene
from h3data.scenes import HomeSpec, build_home
from h3data_play.plan import GameOrder
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.resume import resume, verify
from sim_kinematic.tasks.sources import EpisodeSource
from tests.paths import ROOT
from tests.play.test_live import Player, table

FACES = {"h3data", *(f"h3data.{name}" for name in ("errors", "policies", "recording", "tasks"))}


@pytest.fixture(scope="module")
def home() -> Scene:
    return build_home(HomeSpec(seed=2, articulated=True))


@pytest.fixture(scope="module")
def episode(home: Scene) -> Any:
    """That of `h3data.simulate(Fetch(), home, seed=3)`."""
    return EpisodeSource(Fetch(), home).sample(3, 0)


@pytest.fixture(scope="module")
def recording(episode: Any) -> Recording:
    return simulate(Fetch(), episode, info={"solo_steps": 1})


def test_it_is_short_and_imports_public_faces_only() -> None:
    text = Path(ROOT / "examples" / "fetch.py").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 250
    ours = {node.module for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom) and node.module}
    assert {name for name in ours if name.startswith(("h3data", "sim_kinematic"))} <= FACES


@pytest.mark.slow
def test_its_home_has_a_drawer(home: Scene, episode: Any) -> None:
    with pytest.raises(SceneError, match="has none"):
        drawer_of(replace(episode, scene=replace(home, articulations=())))


@pytest.mark.slow
def test_the_rules_are_its_own(recording: Recording, episode: Any) -> None:
    rewards, info = recording.columns["metrics.reward"], recording.episode.info
    opened = recording.columns["metrics.drawer_open"]
    assert info["ended"] == "success"
    assert rewards.sum() == 5.0 + 2 * 10.0
    assert rewards[int(np.argmax(opened))] == 5.0
    assert info["instruction"].startswith("open kitchen counter")
    of_world, own = (e for e in recording.events if e.kind in ("open", "opened"))
    assert of_world.step == own.step == int(np.argmax(opened))
    assert of_world.target == Fetch().codec.drawer_name(episode)


@pytest.mark.slow
def test_it_is_verified_and_resumed(recording: Recording) -> None:
    assert verify(recording).difference is None
    again = resume(recording, len(recording) - 30)
    np.testing.assert_array_equal(again.columns["metrics.reward"], recording.columns["metrics.reward"])
    np.testing.assert_array_equal(again.columns["object_pose"], recording.columns["object_pose"])


@pytest.mark.slow
def test_it_is_an_environment(home: Scene) -> None:
    env: Any = h3data.make(Fetch(), scenes=home)
    env.reset(seed=0)
    rewards = [env.step(env.action_space.sample())[1] for _ in range(3)]
    assert np.isfinite(rewards).all()
    env.close()


@pytest.mark.slow
def test_a_person_whose_way_a_drawer_bars_chooses_again(home: Scene) -> None:
    """The robot opens the drawer where the person was about to stand."""
    barred = simulate(Fetch(), EpisodeSource(Fetch(), home).sample(1, 0), info={"solo_steps": 1})
    assert ("nav_to_goal", "failed", "stuck") in {(s.name, s.outcome, s.reason) for s in barred.skills if s.agent == 1}


@pytest.mark.slow
def test_it_is_played_live(tmp_path: Path) -> None:
    """By its own name: a task needs no app."""
    game = table(tmp_path, app="examples.fetch:Fetch", scenes="small-open:2").begin(GameOrder(index=0, name="000000"))
    player = Player(game)
    assert game.app.hud(player.number).task.startswith("Open ")
    assert len(game.app.goals()) == 2
    player.send(k="pick", o=0, lead=True)
    player.until_free()
    assert game.columns[f"agent_{player.number}.grasp_body"][-1] >= 0, player.said
    game.close()
    live = read_mcap(tmp_path / "000000.mcap")
    assert live.episode.task == "fetch"
    assert verify(live).difference is None
