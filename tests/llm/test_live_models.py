"""Language models beside people who play live: the game never waits, and goes on when the endpoint is gone."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from h3data.errors import H3DataError
from h3data.recording import Recording, read_mcap
from h3data_llm.background import BackgroundModel
from h3data_play.live import EpisodeFactory, LiveGame
from h3data_play.plan import GameOrder, PlayPlan
from sim_kinematic.tasks.resume import verify
from tests.llm.scripted_endpoint import call, chat_server, script
from tests.play.test_live import Player

FIRST = GameOrder(index=0, name="000000")


def table(out: Path, partner: str) -> EpisodeFactory:
    """ "Wash the mug from a kitchen counter and put it on the bed in bedroom 1." beside a language model."""
    rules = {"template": "wash_and_put"}
    plan = PlayPlan(app="language", out=str(out), scenes="h3-homes/val#3", partner=partner, rules=rules)
    return EpisodeFactory(plan)


def model_of(game: LiveGame) -> BackgroundModel:
    (model,) = game.waited_for.values()
    return model


def play_until(player: Player, what: Callable[[], Any], steps: int = 4000) -> None:
    """Plays steps, and lets the thread that asks have a turn in each."""
    nap = threading.Event()
    while not what() and steps and not player.game.ended:
        player.play()
        nap.wait(0.001)
        steps -= 1
    assert what(), f"it never came true in {len(player.game.session.recorder)} steps"


def ended(player: Player, out: Path) -> Recording:
    player.game.close()
    recording = read_mcap(out / "000000.mcap")
    assert verify(recording).difference is None, "without the endpoint"
    return recording


def test_a_model_brings_a_thing_while_somebody_plays_and_hears_what_they_say(tmp_path: Path) -> None:
    answers = [
        call("say", text="I bring the mug."),
        call("bring", thing="mug_4", place="bed_0"),
        call("wait", seconds=60),
        call("say", text="You are welcome."),
    ]
    with chat_server(script(answers)) as served:
        game = table(tmp_path, served.policy()).begin(FIRST)
        player = Player(game)
        player.send(k="move", f=0.0, t=0.3)
        play_until(player, lambda: any(e.kind == "place" for e in game.session.recorder.events))
        play_until(player, lambda: len(served.requests) > 2)
        player.send(k="say", text="Thank you!")
        play_until(player, lambda: len(game.messages(-1)) == 3)
        assert [said["text"] for said in game.messages(-1)] == ["I bring the mug.", "Thank you!", "You are welcome."]
        assert any("Thank you!" in str(request["messages"]) for request in served.requests)
        assert "is on the bed" in str(served.requests[2]["messages"]) or "bed_0" in str(served.requests[2]["messages"])
    recording = ended(player, tmp_path)
    (facts,) = recording.episode.info["llm"]
    assert facts["calls"] >= 4
    assert "faults" not in facts


def test_the_game_goes_on_while_a_model_thinks(tmp_path: Path) -> None:
    release = threading.Event()

    def slow(body: dict[str, Any]) -> dict[str, Any]:
        del body
        release.wait(30)
        return call("say", text="At last.")

    with chat_server(slow) as served:
        game = table(tmp_path, served.policy(plans=1)).begin(FIRST)
        player = Player(game)
        player.send(k="move", f=0.0, t=0.5)
        player.play(60)
        assert len(game.session.recorder) == 60
        assert game.messages(-1) == []
        release.set()
        play_until(player, lambda: game.messages(-1))
    ended(player, tmp_path)


def test_an_endpoint_that_goes_during_play_stops_nobody(tmp_path: Path) -> None:
    with chat_server(script([call("say", text="hello")])) as served:
        game = table(tmp_path, served.policy(retries=0)).begin(FIRST)
        player = Player(game)
        play_until(player, lambda: game.messages(-1))
    play_until(player, lambda: model_of(game).faults)
    player.play(30)
    assert not game.ended
    (facts,) = ended(player, tmp_path).episode.info["llm"]
    assert facts["faults"][0].startswith("step ")


def test_nonsense_and_markup_of_a_model_stop_nobody(tmp_path: Path) -> None:
    with chat_server(lambda _: (200, "text/html", b"<html><script>alert(1)</script>")) as served:
        game = table(tmp_path, served.policy(retries=0)).begin(FIRST)
        player = Player(game)
        play_until(player, lambda: model_of(game).faults)
        player.play(10)
    assert not game.ended
    ended(player, tmp_path)


def test_nobody_begins_beside_a_model_that_is_not_there(tmp_path: Path) -> None:
    with chat_server(script([])) as served:
        address = served.policy()
    with pytest.raises(H3DataError, match="H3-LLM-012"):
        table(tmp_path, address)


def test_a_killed_game_goes_on_with_what_the_model_had_said(tmp_path: Path) -> None:
    answers = [call("say", text="I bring the mug."), call("bring", thing="mug_4", place="bed_0")]
    with chat_server(script(answers)) as served:
        game = table(tmp_path, served.policy()).begin(FIRST)
        player = Player(game)
        play_until(player, lambda: game.messages(-1))
        player.play(60)
        game.abort()
        again = table(tmp_path, served.policy()).begin(FIRST)
        assert len(again.session.recorder) == len(game.session.recorder)
        assert again.messages(-1) == game.messages(-1)
        other = Player(again)
        other.play(5)
        ended(other, tmp_path)
