"""Messages between agents: said by policies and people, recorded, heard, repeated, and shown as text."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import h3data
from h3data.errors import InputError
from h3data.policies import LONGEST_MESSAGE, Action, External, Message
from h3data.recording import RecordingWriter
from h3data.recording.log_lines import SAY, log_lines
from h3data.scene import FreeSpace
from h3data_language.episode import LanguageSpec
from h3data_language.rearrange_talk import nearest_talk
from h3data_language.talk import INTENTS, Intent, say
from h3data_language.task import Language
from h3data_pipelines.cli import main
from h3data_viewers.html_replay.packing import Payload
from h3data_viewers.html_replay.story import _events, add_story
from sim_kinematic.tasks.rearrange.task import Rearrange, RearrangeSpec
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.resume import resume, verify

MARKUP = "<img src=x onerror=alert(1)>"


@lru_cache(maxsize=2)
def place(home: str) -> tuple[Any, FreeSpace]:
    scene = h3data.load_scene(home)
    return scene, FreeSpace.from_scene(scene, radius_m=0.25, height_m=1.41)


def episode(template: str, seed: int = 0, **rules: Any) -> Any:
    scene, free = place("h3-homes/val#3")
    return Language().episode(scene, free=free, seed=seed, spec=LanguageSpec(template=template, **rules))


def said(recording: Any) -> list[tuple[int, int, str, str]]:
    return [(e.step, e.agent, e.target, e.detail) for e in recording.events if e.kind == SAY]


class Parrot:
    """Says one thing in every third choice, and waits."""

    def __init__(self, text: Any = "hello", to: str = "") -> None:
        self.message, self.count, self.heard = Message(text, to), 0, []

    def act(self, view: Any) -> Action:
        self.heard = [event.detail for event in view.messages]
        self.count += 1
        return self.message.action if self.count % 3 == 1 else Action("wait", steps=10)


def test_messages_take_no_time_are_heard_by_whom_they_are_for_and_come_out_again() -> None:
    robot, person = Parrot("to you", "human"), Parrot(MARKUP)
    made = simulate(Language(), episode("two_on", seed=1, max_steps=100), {"robot": robot, "human": person})
    assert said(made)[:2] == [(0, 1, "", MARKUP), (0, 0, "human", "to you")]  # people first
    assert [step for step, agent, *_ in said(made) if agent == 0] == [0, 20, 40, 60, 80]
    assert person.heard[:2] == robot.heard[:2] == [MARKUP, "to you"]
    assert verify(made).equal
    again = resume(made, 70, policy="language_still", partner="language_still")
    assert said(again) == [each for each in said(made) if each[0] < 70]


def test_a_message_for_another_is_not_heard() -> None:
    first, second = Parrot("psst", "human_1"), Parrot("hm", "robot")
    task = Language()
    scene, free = place("h3-homes/val#3")
    spec = LanguageSpec(template="two_on", max_steps=60)
    three = task.episode(scene, free=free, seed=1, spec=spec, agents="robot,human,human")
    third = Parrot("all")
    simulate(task, three, {"robot": first, "human": [second, third]})
    names = [member.name for member in three.roster]
    heard_by_third = {"psst"} if names[2] == "human_1" else set()
    assert set(third.heard) == {"all"} | heard_by_third
    assert set(first.heard) == {"psst", "hm", "all"}


@pytest.mark.parametrize(
    ("text", "to", "code"),
    [
        ("", "", "H3-SIM-067"),
        ("a" * (LONGEST_MESSAGE + 1), "", "H3-SIM-067"),
        ("a" * 1_000_000, "", "H3-SIM-067"),
        (7, "", "H3-SIM-067"),
        ("hello", "nobody", "H3-SIM-068"),
        ("hello", MARKUP * 9, "H3-SIM-068"),
    ],
)
def test_a_message_that_is_none_is_refused_in_one_sentence(text: Any, to: str, code: str) -> None:
    with pytest.raises(InputError) as refused:
        simulate(Language(), episode("two_on", seed=1, max_steps=30), {"robot": Parrot(text, to)})
    assert refused.value.__cause__.code == code  # type: ignore[union-attr]
    assert len(str(refused.value)) < 300


def test_somebody_outside_talks_in_any_task_with_skills_and_their_raw_input_is_played_again() -> None:
    session = h3data.session("rearrange", "small:1", agents={"person": External(), "robot": Parrot()})
    for step in range(40):
        if step == 20:
            session.act("person", Message("I take the cup").action)
        session.step()
    with pytest.raises(InputError, match="H3-SIM-067"):
        session.act("person", Message("a" * 501).action)
    made = session.close()
    assert (20, 1, "", "I take the cup") in said(made)
    assert any('"text":"I take the cup"' in event.payload for event in made.inputs)
    assert verify(made).equal


@pytest.mark.slow
def test_talkers_say_what_they_take_and_never_head_for_the_same_thing() -> None:
    task = episode("two_on", seed=1, max_steps=3000)
    made = simulate(Language(), task, {"robot": "language_talk", "human": "language_talk"})
    assert made.episode.info["ended"] == "success"
    told = [Intent.of(text) for *_, text in said(made)]
    assert None not in told
    taken: dict[int, str] = {}
    for _, agent, _, text in said(made):
        intent = Intent.of(text)
        assert intent is not None
        taken.pop(agent, None)
        if intent.kind == "i_take":
            assert intent.names[0] not in taken.values()
            taken[agent] = intent.names[0]
    assert verify(made).equal
    again = resume(made, len(made) // 2)
    assert said(again) == said(made)
    assert again.columns["state_hash"][-1] == made.columns["state_hash"][-1]


def test_a_robot_brings_what_a_person_says_to_have_washed() -> None:
    """Without the message it does not know that the thing is clean, and never begins."""
    task = episode("wash_and_put", max_steps=4000)
    made = simulate(Language(), task, {"robot": "language_talk", "human": "language_talk"})
    assert made.episode.info["ended"] == "success"
    assert any(text.startswith("handled ") for *_, text in said(made))


@pytest.mark.parametrize(("text", "walks"), [("please_move", True), ("hello", False)])
def test_a_planner_with_nothing_to_do_makes_room_for_who_asks(text: str, walks: bool) -> None:
    task = episode("wash", max_steps=200)
    made = simulate(Language(), task, {"robot": "language_talk", "human": Parrot(text)})
    walked = [span for span in made.skills if span.agent == 0 and span.name == "nav_to_object"]
    moved = np.ptp(made.columns["agent_0.base_pose"][:, [0, 2]], axis=0).max()
    assert bool(walked) is walks
    assert bool(moved > 0.5) is walks
    assert {span.reason for span in walked} <= {"", "max_steps"}


@pytest.mark.slow
def test_what_one_sees_the_other_looks_for_first() -> None:
    task = episode("two_on", seed=1, max_steps=3000, observe="seen")
    made = simulate(Language(), task, {"robot": "language_talk", "human": "language_talk"})
    assert made.episode.info["ended"] == "success"
    assert any(text.startswith("is_in ") for *_, text in said(made))
    assert verify(made).equal


@given(text=st.text() | st.builds(" ".join, st.lists(st.sampled_from([*INTENTS, "mug_0"]), max_size=4)))
def test_a_text_is_an_intent_only_in_its_form(text: str) -> None:
    found = Intent.of(text)
    if found is not None:
        assert text.split() == [found.kind, *found.names]
        assert Intent.of(say(found.kind, *found.names).text) == found


@pytest.mark.parametrize("wrong", [("i_take",), ("sing", "x"), ("i_take", "the mug"), ("i_take", "")])
def test_an_intent_that_is_none_is_refused(wrong: tuple[str, ...]) -> None:
    with pytest.raises(InputError, match="H3-LANGUAGE-021"):
        say(*wrong)


def test_pages_show_messages_and_do_not_run_their_markup(tmp_path: Path) -> None:
    task, path = episode("two_on", seed=1, max_steps=60), tmp_path / "talk.mcap"
    agents = {"robot": Parrot(MARKUP), "human": Parrot("hm")}
    made = simulate(Language(), task, agents, sink=lambda header: RecordingWriter(path, header))
    assert f'robot says: "{MARKUP}"' in [line.text for line in log_lines(made)]
    assert main(["report", str(path), "--pictures", "1", "-o", str(tmp_path / "report.html")]) == 0
    page = (tmp_path / "report.html").read_text("utf-8")
    assert "&lt;img src=x onerror" in page
    assert MARKUP not in page
    shown = [event["text"] for event in _events(made, np.arange(len(made)))]
    assert f'Robot says: "{MARKUP}"' in shown  # the player puts it into the page as text
    bubbles = add_story(Payload(), made, np.arange(len(made)))["says"]
    assert [(one["step"], one["agent"], one["text"]) for one in bubbles] == [(s, a, t) for s, a, _, t in said(made)]


def test_pages_show_an_instruction_and_do_not_run_its_markup(tmp_path: Path) -> None:
    words = f"Put {MARKUP}</script><script>alert(2)</script> on the desk."
    task, path = replace(episode("two_on", seed=1, max_steps=10), wording=words), tmp_path / "told.mcap"
    agents = {"robot": "language_still", "human": "language_still"}
    simulate(Language(), task, agents, sink=lambda header: RecordingWriter(path, header))
    assert main(["report", str(path), "--pictures", "1", "-o", str(tmp_path / "report.html")]) == 0
    assert main(["view", str(path), "-o", str(tmp_path / "replay.html")]) == 0
    for name in ("report", "replay"):
        page = (tmp_path / f"{name}.html").read_text("utf-8")
        assert MARKUP not in page
        assert "<script>alert(2)" not in page
    assert "Put &lt;img src=x onerror" in (tmp_path / "report.html").read_text("utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("observe", ["full", "seen"])
def test_planners_of_rearrangement_say_what_they_take_and_leave_it_to_each_other(observe: str) -> None:
    scene, free = place("h3-homes/val#3")
    task = Rearrange()
    spec = RearrangeSpec(observe=observe, max_steps=2500)  # type: ignore[arg-type]
    start = task.episode(scene, free=free, seed=3, spec=spec)
    policies = {a.name: nearest_talk(task, start, k) for k, a in enumerate(start.roster)}
    made = simulate(task, start, policies)
    assert made.episode.info["ended"] == "success"
    taken: dict[int, str] = {}
    for _, agent, _, text in said(made):
        intent = Intent.of(text)
        assert intent is not None
        if intent.kind == "i_take":
            taken[agent] = intent.names[0]
            assert len(set(taken.values())) == len(taken), "nobody takes what the other has said to take"
        elif intent.kind == "i_leave":
            taken.pop(agent, None)
    assert {"i_take"} <= {text.split()[0] for *_, text in said(made)}
    assert (observe == "seen") == any(text.startswith("is_in ") for *_, text in said(made))
    assert verify(made).equal
