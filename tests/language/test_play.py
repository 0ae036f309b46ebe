"""Tasks in words that people play live: what they are told and do, what they say and hear, how an episode ends."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

from h3data.errors import InputError
from h3data.metrics import measure_many
from h3data.policies import LONGEST_MESSAGE
from h3data.recording import Recording, read_mcap
from h3data.recording.live_input import CLIENT
from h3data_language.play import DONE, SAID, USES, LanguageApp
from h3data_language.talk import INTENTS
from h3data_language.templates import HANDLING
from h3data_pipelines.cli import main
from h3data_play.app import Hud
from h3data_play.live import EpisodeFactory, LiveGame
from h3data_play.messages import MOST_BYTES, MOST_CHARACTERS, decode
from h3data_play.plan import GameOrder, PlayPlan
from h3data_play.worker import ANSWER_S, Worker
from h3data_studies.texts import SHIPPED, shipped
from sim_kinematic.tasks.resume import verify
from tests.play.test_live import Player
from tests.studies.test_languages import sentences

FIRST = GameOrder(index=0, name="000000")
MARKUP = "<img src=x onerror=alert(1)>"


def table(out: Path, **changes: Any) -> EpisodeFactory:
    """ "Wash the mug from a kitchen counter and put it on the bed in bedroom 1." beside a robot that keeps still."""
    plan: dict[str, Any] = {"app": "language", "scenes": "h3-homes/val#3", "partner": "language_still"}
    return EpisodeFactory(PlayPlan(out=str(out), **{**plan, "rules": {"template": "wash_and_put"}, **changes}))


def said(recording: Recording) -> list[tuple[int, str]]:
    return [(e.agent, e.detail) for e in recording.events if e.kind == "say"]


def finished(player: Player, out: Path) -> Recording:
    """The recording of the game, which comes out again from its raw input."""
    player.game.close()
    recording = read_mcap(out / "000000.mcap")
    assert verify(recording).difference is None
    return recording


def test_a_person_washes_talks_and_brings_a_thing_by_name_and_it_is_measured_as_ever(tmp_path: Path) -> None:
    game = table(tmp_path, app="language_progress").begin(FIRST)
    player = Player(game)
    player.play()
    me = player.number
    assert game.app.hud(me).task == "Wash the mug from a kitchen counter and put it on the bed in bedroom 1."
    assert game.app.hud(me).uses == ("clean", "", "")
    assert game.app.hud(me).lines == ("0 of 2 parts of the task are done.",)
    assert game.app.goals() == [], "the instruction says where things go, and nothing else does"
    assert all(at_goal == -1 for _, at_goal in game.barriers(me))
    assert player.send(k="bring", place="bed_0") == "The hand holds no such thing."
    player.send(k="use", o=0, lead=True)
    player.play(30)
    player.send(k="say", text=f"I wash it {MARKUP}")
    assert player.busy
    player.until_free()
    player.play(20)
    assert game.app.hud(me).lines == ("The mug is clean now.", "1 of 2 parts of the task are done.")
    assert game.app.hud(me).uses == ("", "", "")
    player.send(k="pick", o=0, lead=True)
    player.until_free()
    player.send(k="bring", place="bed_0")
    player.until_free()
    assert game.ended == "success", player.said
    assert player.said == []
    recording = finished(player, tmp_path)
    assert said(recording) == [(me, f"I wash it {MARKUP}")]
    walks = [span for span in recording.skills if span.agent == me and span.name == "nav_to_object"]
    assert [span.outcome for span in walks[:1]] == ["done"], "talking does not end a walk"
    values = measure_many([recording]).to_dict()
    assert "PC" in json.dumps(values)


def test_a_walk_by_keys_goes_on_while_somebody_talks(tmp_path: Path) -> None:
    player = Player(table(tmp_path).begin(FIRST))
    player.send(k="move", f=0.0, t=1.0)
    player.play(10)
    headings = []
    for text in ("a", "b", "c"):
        player.send(k="say", text=text, to="robot")
        before = player.base.copy()
        player.play()
        headings.append(bool((player.base != before).any()))
    assert headings == [True] * 3
    assert said(finished(player, tmp_path)) == [(player.number, text) for text in "abc"]


def test_a_robot_that_is_played_brings_by_name_and_talks_on_its_way(tmp_path: Path) -> None:
    game = table(tmp_path, seats=("robot",)).begin(FIRST)
    player = Player(game)
    player.play()
    assert game.app.hud(player.number).uses == ()
    assert player.send(k="use", o=0) == "It has no hand for water and switches."
    player.send(k="pick", o=0, lead=True)
    player.play(30)
    player.send(k="say", text="I take the mug.")
    player.until_free()
    player.send(k="bring", place="bed_0")
    player.until_free()
    assert player.said == []
    recording = finished(player, tmp_path)
    assert said(recording) == [(0, "I take the mug.")]
    assert [e.kind for e in recording.events if e.kind in ("pick", "place")] == ["pick", "place"]


@pytest.mark.parametrize("seat", ["robot", pytest.param("person", marks=pytest.mark.slow)])
def test_players_bring_things_to_the_floor_of_a_room(tmp_path: Path, seat: str) -> None:
    game = table(tmp_path, rules={"template": "floor"}, seats=(seat,)).begin(FIRST)
    player = Player(game)
    player.play()
    assert game.app.hud(player.number).task == "Put the bowl from the bed in bedroom 1 on the floor of the kitchen."
    (spot,) = [s for s in game.app.spots() if s.label == "on the floor of the kitchen"]
    player.send(k="pick", o=0, lead=True)
    player.until_free()
    player.send(k="bring", place=spot.name)
    player.until_free()
    assert (player.said, game.ended) == ([], "success")
    recording = finished(player, tmp_path)
    assert measure_many([recording]).episodes[0].values["PC"] == 1.0


def test_players_hear_what_is_for_them_in_words(tmp_path: Path) -> None:
    game = LiveGame(table(tmp_path, partner="language_talk", seats=("person", "person")), 0)
    one, two = (Player(game, number) for number in game.drivers)
    one.send(k="say", text="psst", to="robot")
    one.play()
    other = one.game.session.episode.roster[two.number].name
    one.send(k="say", text="for you", to=other)
    two.send(k="say", text="please_move")
    one.play()
    heard = {number: [one["text"] for one in game.messages(number)] for number in (one.number, two.number, -1)}
    assert heard[one.number] == ["psst", "I take the mug.", "for you", "Please move aside."]
    assert heard[two.number] == ["I take the mug.", "for you", "Please move aside."]
    assert heard[-1] == heard[one.number]
    assert [said["own"] for said in game.messages(one.number)] == [True, False, True, False]
    assert game.messages(two.number, 3)[0]["text"] == "Please move aside."


@pytest.mark.slow
def test_two_people_share_a_task(tmp_path: Path) -> None:
    game = table(tmp_path, partner=None, seats=("person", "person")).begin(FIRST)
    assert [member.kind for member in game.session.episode.roster] == ["human", "human"]
    one, two = (Player(game, number) for number in game.drivers)
    one.send(k="use", o=0, lead=True)
    one.until_free()
    one.play(20)
    x, z = game.session.episode.starts[one.number, :2].tolist()
    one.send(k="goto", p=[x, 0.0, z])
    one.until_free()
    one.send(k="say", text="It is clean.", to=game.session.episode.roster[two.number].name)
    two.send(k="pick", o=0, lead=True)
    two.until_free()
    two.send(k="bring", place="bed_0")
    two.until_free()
    assert game.ended == "success", (one.said, two.said)
    recording = finished(one, tmp_path)
    assert said(recording) == [(one.number, "It is clean.")]
    assert measure_many([recording]).episodes[0].values["PC"] == 1.0


@pytest.mark.parametrize(
    "message",
    [
        {"k": "say", "text": ""},
        {"k": "say", "text": "a" * (MOST_CHARACTERS + 1)},
        {"k": "say", "text": "a" * 1_000_000},
        {"k": "say", "text": 7},
        {"k": "problem", "text": ""},
        {"k": "end", "why": "bored"},
        {"k": "answer", "answer": MARKUP},
    ],
)
def test_what_is_no_message_is_malformed(message: dict[str, Any]) -> None:
    with pytest.raises(msgspec.MsgspecError):
        decode(json.dumps(message))
    assert MOST_CHARACTERS == LONGEST_MESSAGE
    assert len(json.dumps({"k": "say", "text": "é" * MOST_CHARACTERS}, ensure_ascii=False).encode()) < MOST_BYTES


@pytest.mark.parametrize(
    ("message", "code"),
    [
        ({"k": "say", "text": "hello", "to": MARKUP}, "H3-SIM-068"),
        ({"k": "use", "o": 77}, "H3-LANGUAGE-036"),
        ({"k": "bring", "place": MARKUP}, "H3-LANGUAGE-018"),
        ({"k": "bring", "place": "bed_0", "next_to": MARKUP}, "H3-LANGUAGE-035"),
    ],
)
def test_what_names_nothing_here_is_refused_and_not_recorded(
    tmp_path: Path, message: dict[str, Any], code: str
) -> None:
    player = Player(table(tmp_path).begin(FIRST))
    player.send(k="pick", o=0, lead=True)
    player.until_free()
    with pytest.raises(InputError, match=code) as refused:
        player.send(**message)
    assert len(str(refused.value)) < 1000
    kinds = [json.loads(e.payload)["message"]["k"] for e in finished(player, tmp_path).inputs if e.kind == CLIENT]
    assert kinds == ["pick"]


def test_nobody_talks_faster_than_the_steps(tmp_path: Path) -> None:
    player = Player(table(tmp_path).begin(FIRST))
    replies = [player.send(k="say", text=str(k)) for k in range(7)]
    assert replies == [""] * 5 + ["Wait a moment before you say more."] * 2
    player.play(8)
    assert [text for _, text in said(finished(player, tmp_path))] == list("01234")


# --- the end ----------------------------------------------------------------------------------------------------------
class MarkupApp(LanguageApp):
    """Its instruction is somebody's markup."""

    def hud(self, number: int) -> Hud:
        return replace(super().hud(number), task=f"Put the mug on the bed. {MARKUP}", lines=(MARKUP,))

    def spoken(self, text: str) -> str:
        return f"{text} {MARKUP}"


class Letters:
    """The front's side of a worker."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, str, Any]] = []

    def send(self, *letter: Any) -> None:
        self.sent.append(letter)

    def told(self, name: str) -> list[Any]:
        return [body[1][name] for kind, _, body in self.sent if kind == "told" and name in body[1]]


def worker_of(out: Path, **changes: Any) -> Worker:
    worker = Worker(Letters(), [table(out, **changes).plan])  # type: ignore[arg-type]
    worker.begin("g", msgspec.to_builtins(FIRST))
    for number in worker.games["g"].game.drivers:
        worker.here("g", {"agent": number, "here": True})
    worker.step("g", None)
    return worker


def send(worker: Worker, number: int, **message: Any) -> None:
    worker.input("g", [number, json.dumps(message), 1.0])


def remarks(out: Path) -> tuple[str, list[dict[str, Any]]]:
    info = read_mcap(out / "000000.mcap").episode.info
    return info["ended"], info["hitl"].get("remarks", [])


def test_players_are_asked_at_the_end_and_their_answers_and_problems_are_recorded(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    worker = worker_of(tmp_path)
    send(worker, 1, k="problem", text=f"It hangs. {MARKUP}")
    worker.step("g", None)
    assert not worker.games["g"].game.ended
    send(worker, 1, k="end", why="finished")
    worker.step("g", None)
    running = worker.games["g"]
    assert not running.runs
    assert worker.channel.told("question") == ["Did you complete the task?"]  # type: ignore[attr-defined]
    worker.here("g", {"agent": 1, "here": False})
    worker.here("g", {"agent": 1, "here": True})
    assert len(worker.channel.told("question")) == 2, "who comes back is asked again"  # type: ignore[attr-defined]
    send(worker, 1, k="move", f=1.0)
    assert "g" in worker.games
    send(worker, 1, k="answer", answer="unsure", text="Where was it?")
    assert "g" not in worker.games
    ended, notes = remarks(tmp_path)
    assert ended == "finished"
    assert notes == [
        {"agent": 1, "step": 1, "text": f"It hangs. {MARKUP}"},
        {
            "agent": 1,
            "step": 3,
            "text": "Where was it?",
            "question": "Did you complete the task?",
            "answer": "unsure",
        },
    ]
    assert verify(read_mcap(tmp_path / "000000.mcap")).difference is None
    assert main(["report", str(tmp_path), "--pictures", "1", "-o", str(tmp_path / "report.html")]) == 0
    page = (tmp_path / "report.html").read_text("utf-8")
    assert MARKUP not in page
    assert "Did you complete the task? unsure" in page
    assert "It hangs. &lt;img" in page
    capsys.readouterr()


def test_an_episode_that_is_skipped_asks_nothing(tmp_path: Path) -> None:
    worker = worker_of(tmp_path)
    send(worker, 1, k="end", why="skipped")
    worker.step("g", None)
    assert remarks(tmp_path) == ("skipped", [])
    over = next(body for kind, _, body in worker.channel.sent if kind == "over")  # type: ignore[attr-defined]
    assert over["texts"]["1"] == "The task has been skipped."


def test_a_question_that_nobody_answers_ends_by_itself(tmp_path: Path) -> None:
    worker = worker_of(tmp_path)
    send(worker, 1, k="end", why="finished")
    worker.step("g", None)
    worker.end_unanswered()
    assert "g" in worker.games
    worker.games["g"].asked[1] -= ANSWER_S + 1
    worker.end_unanswered()
    assert remarks(tmp_path) == ("finished", [])


@pytest.mark.slow
def test_a_server_that_is_killed_during_the_question_asks_again(tmp_path: Path) -> None:
    first = worker_of(tmp_path)
    send(first, 1, k="problem", text="hm")
    send(first, 1, k="end", why="finished")
    first.step("g", None)
    first.games["g"].game.abort()
    second = Worker(Letters(), first.plans)  # type: ignore[arg-type]
    second.begin("g", msgspec.to_builtins(FIRST))
    assert remarks(tmp_path)[0] == "finished", "nobody is connected when it begins"


@pytest.mark.slow
def test_apps_without_a_question_take_no_remarks(tmp_path: Path) -> None:
    player = Player(LiveGame(table(tmp_path, app="rearrange", scenes="small:3", partner="still", rules={}), 0))
    for message in ({"k": "end", "why": "skipped"}, {"k": "problem", "text": "x"}, {"k": "answer", "answer": "yes"}):
        with pytest.raises(InputError, match="H3-PLAY-013"):
            player.send(**message)


# --- words ------------------------------------------------------------------------------------------------------------
def test_every_intent_and_every_use_has_words() -> None:
    assert set(SAID) == set(INTENTS)
    assert set(USES) == set(HANDLING.values())
    assert set(DONE) == set(USES.values())


@pytest.mark.parametrize("code", [code for code in SHIPPED if code != "en"])
def test_players_read_all_of_it_in_their_language(tmp_path: Path, code: str) -> None:
    language = shipped(code)
    assert language is not None
    folder = Path(LanguageApp.driver.__code__.co_filename).parent
    told = {*DONE.values(), *SAID.values(), LanguageApp.question} | sentences(folder / "task.py")
    app = LiveGame(table(tmp_path), 0).app
    told |= {one.label for one in (*app.phrases(), *app.spots())}
    patterns = [re.compile("^" + ".+?".join(map(re.escape, text.split("{}"))) + "$") for text in language.said]
    assert [text for text in sorted(told) if not any(pattern.match(text) for pattern in patterns)] == []
