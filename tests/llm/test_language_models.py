"""Agents whose work a language model chooses, here a script behind a server on loopback."""

from __future__ import annotations

import json
import re
import time
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import h3data
from h3data.errors import InputError
from h3data.metrics import UnmeasurableError, measure
from h3data.recording.finding import find_episodes
from h3data.recording.log_lines import SAY
from h3data.scene import FreeSpace
from h3data_language.episode import LanguageSpec
from h3data_language.task import Language
from h3data_llm.budget import JobBudget
from h3data_llm.endpoint import KEY_VARIABLE, MOST_BYTES, Address, LanguageModelError, reply_of
from h3data_llm.policy import FAULTS, LanguageModelPolicy
from h3data_llm.replies import models_in
from h3data_llm.tools import Names, called, kept, tools_for
from h3data_pipelines.cli import main
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.resume import resume, verify
from tests.llm.scripted_endpoint import call, chat_server, script, text

HOME, OPEN_HOME = "h3-homes/val#3", "small2-open:0"


def run(capsys: pytest.CaptureFixture[str], *words: object, code: int = 0) -> str:
    """Everything that a command prints."""
    capsys.readouterr()
    assert main([str(word) for word in words]) == code
    said = capsys.readouterr()
    return said.out + said.err


@lru_cache(maxsize=4)
def place(home: str) -> tuple[Any, FreeSpace]:
    scene = h3data.load_scene(home)
    return scene, FreeSpace.from_scene(scene, radius_m=0.25, height_m=1.41)


@lru_cache(maxsize=16)
def episode(template: str, seed: int = 0, home: str = HOME, **rules: Any) -> Any:
    scene, free = place(home)
    return Language().episode(scene, free=free, seed=seed, spec=LanguageSpec(template=template, **rules))


def asked(episode: Any) -> list[tuple[str, str]]:
    """Thing and place of each proposition about furniture."""
    args = [p["args"] for p in episode.extra["evaluation_propositions"]]
    return [(a["object_handles"][0], a["receptacle_handles"][0]) for a in args if "receptacle_handles" in a]


def play(episode: Any, policy: str, *, kind: str = "robot", other: str = "language_still") -> Any:
    return simulate(Language(), episode, {kind: policy, "human" if kind == "robot" else "robot": other})


# --- a whole episode --------------------------------------------------------------------------------------------------
def test_a_scripted_model_does_the_task_and_the_recording_verifies_with_the_endpoint_gone() -> None:
    task = episode("two_on", seed=1, max_steps=3000)
    calls = [call("say", text="I take both."), *(call("bring", thing=a, place=b) for a, b in asked(task))]
    with chat_server(script(calls)) as server:
        made = play(task, server.policy(plans=9))
    assert made.episode.info["ended"] == "success"
    assert re.fullmatch(r"llm:scripted@[0-9a-f]{12}", made.episode.info["policy"])
    (told,) = made.episode.info["llm"]
    assert told["calls"] == len(server.requests) == 3
    assert [d["reply"]["tool_calls"][0]["function"]["name"] for d in told["decisions"]] == ["say", "bring", "bring"]
    assert told["decisions"][-1]["model"] == "scripted-1"
    assert told["tokens"][1] == 60
    assert server.requests[0]["path"] == "/v1/chat/completions"
    assert [(e.kind, e.agent, e.detail) for e in made.events if e.kind == SAY] == [(SAY, 0, "I take both.")]
    assert verify(made).equal
    again = resume(made, len(made) - 1, policy="language_still")
    assert [e for e in again.events if e.kind == SAY] == [e for e in made.events if e.kind == SAY]


def test_what_a_model_is_told_has_the_result_of_its_last_choice_and_the_present_state() -> None:
    task = episode("two_on", seed=1, max_steps=3000)
    ((thing, where), _) = asked(task)
    with chat_server(
        script([call("bring", thing=thing, place=where), call("bring", thing=thing, place="moon")])
    ) as server:
        play(task, server.policy(plans=2, history=1, calls=4))
    first, second, third, *_ = [request["messages"] for request in server.requests]
    assert task.wording in first[0]["content"]
    assert f"- {thing} (" in first[-1]["content"]
    assert second[-1]["role"] == "tool"
    assert second[-1]["content"].startswith(f"{thing} is on {where}, in ")
    assert third[-1]["content"].startswith("There is no 'moon' for place of bring.")
    assert len(third) == 4  # the last decision alone


def test_a_person_by_a_model_in_text_mode_handles_a_thing_and_a_robot_has_no_such_tool() -> None:
    task = episode("wash", max_steps=3000)
    thing = next(t.name for t, (use, _) in zip(task.targets, task.extra["uses"], strict=True) if use == "clean")
    answers = [text(f"It is dirty.\nAction: handle[{thing}, clean]")]
    with chat_server(script(answers)) as server:
        made = play(task, server.policy(mode="text", plans=3), kind="human")
    assert "tools" not in server.requests[0]
    assert "handle[thing, do]" in server.requests[0]["messages"][0]["content"]
    assert [(e.target, e.detail) for e in made.events if e.kind == "state"] == [(thing, "clean")]
    assert made.episode.info["ended"] == "success"
    assert verify(made).equal
    robot = script([call("handle", thing=thing, do="clean")] * FAULTS)
    with chat_server(robot) as server, pytest.raises(LanguageModelError, match="H3-LLM-017"):
        play(task, server.policy())


@pytest.mark.slow
def test_a_model_opens_a_drawer_on_the_way_and_by_itself() -> None:
    task = episode("inside", home=OPEN_HOME, max_steps=4000)
    ((thing, full),) = asked(task)
    free = task.targets[0].destination.partition("/")[0]
    calls = [call("bring", thing=thing, place=place, how="inside") for place in (full, free)]
    with chat_server(script([*calls, call("close", name="fridge_0/door")])) as server:
        made = play(task, server.policy(plans=3))
    told = [request["messages"][-1]["content"] for request in server.requests]
    assert told[1].startswith("There is no space for it")
    assert made.episode.info["ended"] == "success"
    assert any(event.kind == "open" for event in made.events)
    assert verify(made).equal
    assert "Doors and drawers:" in told[0]


def test_a_model_puts_a_thing_on_the_floor_of_a_room() -> None:
    task = episode("floor", max_steps=3000)
    thing = task.targets[0].name
    calls = [call("bring", thing=thing, place=place, how="floor") for place in ("sofa_0", "bedroom_1", "hall")]
    with chat_server(script(calls)) as server:
        made = play(task, server.policy(plans=3))
    told = [request["messages"][-1]["content"] for request in server.requests]
    assert told[1].startswith("There is no 'floor of sofa_0' where things can be put.")
    assert told[2].startswith(f"{thing} is on the floor, in bedroom_1 now.")
    assert made.episode.info["ended"] == "success"
    assert verify(made).equal


@pytest.mark.slow
def test_a_model_that_searches_knows_nothing_at_first_and_is_woken_by_what_it_finds() -> None:
    task = episode("two_on", seed=1, max_steps=2500, observe="seen")
    with chat_server(script([call("explore")] * 3 + [call("explore", room="kitchen")] * 2)) as server:
        made = play(task, server.policy(plans=5))
    told = [request["messages"][-1]["content"] for request in server.requests]
    assert "you have not seen where it is" in told[0]
    assert any(line.startswith("You have seen something new.") for line in told)
    assert any(span.reason == "found" for span in made.skills)
    assert verify(made).equal


def test_rearrangement_by_a_model_goes_to_the_goals_of_the_task() -> None:
    with chat_server(lambda body: call("bring", thing="?")) as server:
        game = h3data.session("rearrange", "small:1", agents={"robot": server.policy(), "human": "still"})
        things = game.play.team.objects.names
        with pytest.raises(LanguageModelError, match="H3-LLM-022"):
            game.step()
    assert "its goal is" in server.requests[0]["messages"][-1]["content"]
    with chat_server(script([call("bring", thing=name) for name in things])) as server:
        made = h3data.simulate("rearrange", "small:1", agents={"robot": server.policy(), "human": "still"})
    assert made.episode.info["ended"] == "success"
    assert verify(made).equal


def test_two_models_talk_and_one_that_rests_is_woken_by_a_message() -> None:
    task = episode("two_on", seed=1, max_steps=900)

    def answer(body: dict[str, Any]) -> dict[str, Any]:
        is_robot = "what robot," in body["messages"][0]["content"]
        last = body["messages"][-1]["content"]
        if is_robot:
            return call("wait", seconds=3) if len(body["messages"]) == 2 else call("say", text="<b>Wake up</b>")
        return call("done") if "Wake up" not in last else call("wait", seconds=1)

    with chat_server(answer) as server:
        policy = server.policy(plans=3)
        made = simulate(Language(), task, {"robot": policy, "human": policy})
    woken = [span for span in made.skills if span.agent == 1 and span.reason == "message"]
    assert woken
    assert len(made.episode.info["llm"]) == 2
    assert verify(made).equal


# --- size -------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("mode", ["tools", "text"])
def test_the_first_request_about_a_medium2_home_has_less_than_3000_tokens(mode: str) -> None:
    task = episode("two_on", home="medium2:0", observe="seen")
    policy = LanguageModelPolicy(Address.of(f"llm:http://x/v1?model=m&mode={mode}"), None, Language(), task, 1)  # type: ignore[arg-type]
    from h3data.tasks import WorldRollout

    view = WorldRollout.of(Language(), task, h3data_still(task)).view(1)
    body = json.loads(policy.request(view))
    assert len(json.dumps(body)) // 4 < 3000
    assert len("".join(m["content"] for m in body["messages"])) // 4 < 1500


def h3data_still(task: Any) -> Any:
    from h3data.policies import AssignedPolicy

    return [AssignedPolicy(None, "", member.kind) for member in task.roster]


def test_requests_stop_growing_after_the_history_is_full() -> None:
    task = episode("two_on", seed=1, max_steps=1200)
    with chat_server(lambda body: call("wait", seconds=1)) as server:
        play(task, server.policy(plans=30, history=4))
    sizes = [len(json.dumps(request)) for request in server.requests]
    assert len(sizes) == 30
    assert max(sizes[6:]) - min(sizes[6:]) < 100


# --- faults -----------------------------------------------------------------------------------------------------------
HTML = b"<!doctype html><title>Welcome</title>"
BAD = {
    "a page": ((200, "text/html", HTML), "H3-LLM-010"),
    "a page with another status": ((404, "text/html", HTML), "H3-LLM-010"),
    "a refusal": ((401, "application/json", b'{"error": {"message": "bad key"}}'), "H3-LLM-011"),
    "another form": (b'{"object": "list"}', "H3-LLM-013"),
    "a number": (b"7", "H3-LLM-013"),
    "an endless answer": (b" " * (MOST_BYTES + 10), "H3-LLM-009"),
    "no choice": ({}, "H3-LLM-015"),
    "text alone": (text("I would take the mug."), "H3-LLM-015"),
    "an unknown tool": (call("teleport", thing="x"), "H3-LLM-017"),
    "an unknown thing": (call("pick", thing="moon"), "H3-LLM-022"),
    "a number that is too large": (call("wait", seconds=1e9), "H3-LLM-020"),
    "a number that is none": (call("wait", seconds="soon"), "H3-LLM-020"),
    "a missing argument": (call("pick"), "H3-LLM-019"),
    "an argument too many": (call("done", now=True), "H3-LLM-019"),
    "a list as a name": (call("pick", thing=["x"]), "H3-LLM-021"),
    "a message of 20,000 letters": (call("say", text="a" * 20_000), "H3-LLM-016"),
    "a message of a megabyte": (call("say", text="a" * 1_000_000), "H3-LLM-009"),
    "arguments that are no JSON": (
        {"content": None, "tool_calls": [{"function": {"name": "wait", "arguments": "{seconds"}}]},
        "H3-LLM-016",
    ),
    "tool calls of another form": ({"content": None, "tool_calls": [7, {"function": 3}]}, "H3-LLM-015"),
}


@pytest.mark.parametrize("case", BAD)
def test_an_endpoint_that_misbehaves_ends_the_episode_with_one_sentence(case: str) -> None:
    answer, code = BAD[case]
    with chat_server(lambda body: answer) as server, pytest.raises(LanguageModelError, match=code) as fault:
        play(episode("two_on", seed=1, max_steps=300), server.policy())
    assert "\n" not in str(fault.value)
    assert len(str(fault.value)) < 500


def test_an_endpoint_that_is_late_or_gone_ends_the_episode_after_further_attempts() -> None:
    def late(body: dict[str, Any]) -> dict[str, Any]:
        time.sleep(1.5)
        return call("done")

    task = episode("two_on", seed=1, max_steps=300)
    with chat_server(late) as server, pytest.raises(LanguageModelError, match="H3-LLM-008"):
        play(task, server.policy(timeout=1, retries=0))
    with pytest.raises(LanguageModelError, match="H3-LLM-012"):
        play(task, server.policy(retries=1))


def test_a_busy_endpoint_is_asked_again() -> None:
    answers: list[Any] = [(503, "text/plain", b"busy"), call("done")]
    with chat_server(lambda body: answers.pop(0)) as server:
        made = play(episode("two_on", seed=1, max_steps=30), server.policy())
    assert len(server.requests) == 2
    assert made.episode.info["llm"][0]["calls"] == 1


@pytest.mark.parametrize("budget", [{"calls": 3}, {"tokens": 2000}])
def test_a_budget_that_is_used_up_ends_the_episode(budget: dict[str, int]) -> None:
    with (
        chat_server(lambda body: call("wait", seconds=1)) as server,
        pytest.raises(LanguageModelError, match="H3-LLM-024"),
    ):
        play(episode("two_on", seed=1, max_steps=600), server.policy(**budget))
    assert len(server.requests) <= 3


@pytest.mark.parametrize(
    ("address", "code"),
    [
        ("llm:http://127.0.0.1/v1?model=m&calls=0", "H3-LLM-006"),
        ("llm:http://127.0.0.1/v1?model=m&tokens=0", "H3-LLM-006"),
        ("llm:http://127.0.0.1/v1?model=m&tokens=-5", "H3-LLM-006"),
        ("llm:http://127.0.0.1/v1?model=m&tokens=9999999999999", "H3-LLM-006"),
        ("llm:http://me:secret@127.0.0.1/v1?model=m", "H3-LLM-001"),
        ("llm:http://127.0.0.1/v1?model=m&api_key=secret", "H3-LLM-002"),
        ("llm:http://127.0.0.1/v1", "H3-LLM-003"),
        ("llm:http://127.0.0.1/v1?model=m&mode=telepathy", "H3-LLM-004"),
        ("llm:http://:80/v1?model=m", "H3-LLM-005"),
        ("llm:http://127.0.0.1:port/v1?model=m", "H3-LLM-005"),
        ("llm://127.0.0.1/v1?model=m", "H3-LLM-005"),
    ],
)
def test_an_address_that_is_none_is_refused_without_its_secrets(address: str, code: str) -> None:
    with pytest.raises(InputError, match=code) as refused:
        h3data.session("rearrange", "small:1", agents={"robot": address})
    assert "secret" not in str(refused.value)


def test_people_and_robots_that_only_drive_and_walk_have_no_language_model() -> None:
    with pytest.raises(InputError, match="H3-LLM-023"):
        h3data.session("social_nav", "small:1", agents={"robot": "llm:http://127.0.0.1:1/v1?model=m"})


def test_a_key_is_sent_but_neither_recorded_nor_told_nor_sent_in_plain_text(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(KEY_VARIABLE, "sk-very-secret")
    task = episode("two_on", seed=1, max_steps=30)
    with chat_server(lambda body: call("done")) as server:
        made = play(task, server.policy())
    assert server.headers[0]["Authorization"] == "Bearer sk-very-secret"
    assert "very-secret" not in json.dumps(dict(made.episode.info), default=str)
    echo = (401, "application/json", b'{"error": {"message": "wrong key sk-very-secret"}}')
    with chat_server(lambda body: echo) as server, pytest.raises(LanguageModelError, match="H3-LLM-011") as refused:
        play(task, server.policy())
    assert "very-secret" not in str(refused.value)
    with pytest.raises(InputError, match="H3-LLM-007"):
        play(task, "llm:http://example.org/v1?model=m")


NAMES = Names(("mug_0", "bowl_1"), ("desk_0", "kitchen"), ("kitchen",), ("fridge_0/door",), ("human",))
TOOLS = tools_for(NAMES, places=True, handles=True, searches=True)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=12), inner, max_size=3),
    max_leaves=8,
)


@given(
    message=st.dictionaries(st.sampled_from(["content", "tool_calls", "function", "role"]), JSON),
    mode=st.sampled_from(["tools", "text"]),
)
def test_any_message_is_a_call_or_one_sentence(message: dict[str, Any], mode: str) -> None:
    found = kept(message)
    json.dumps(found, ensure_ascii=False).encode()
    try:
        called(found, TOOLS, NAMES, mode)
    except LanguageModelError:
        return
    assert called(found, TOOLS, NAMES, mode).tool in {tool.name for tool in TOOLS}


@given(
    arguments=st.dictionaries(st.sampled_from(["thing", "place", "how", "seconds", "text", "x"]), JSON),
    name=st.sampled_from([t.name for t in TOOLS]),
)
def test_any_arguments_are_checked(arguments: dict[str, Any], name: str) -> None:
    try:
        made = called(kept(call(name, **arguments)), TOOLS, NAMES, "tools")
    except LanguageModelError:
        return
    assert made.tool == name
    assert {*made.arguments} <= {*arguments}


@given(answer=JSON)
def test_any_answer_is_a_reply_or_one_sentence(answer: Any) -> None:
    with pytest.raises(LanguageModelError, match="H3-LLM-013"):
        reply_of(answer, "http://x")


def test_text_means_a_call_by_its_last_line() -> None:
    def meant(content: str) -> str:
        return str(called(kept(text(content)), TOOLS, NAMES, "text"))

    assert meant("Thought.\nAction: bring[mug_0, desk_0]") == "bring[mug_0, desk_0]"
    assert (
        meant("Action: pick[mug_0]\nNo.\nAction: bring[mug_0, desk_0, on, bowl_1].")
        == "bring[mug_0, desk_0, on, bowl_1]"
    )
    assert meant("Action: say[I take it, the mug, and the bowl]") == "say[I take it, the mug, and the bowl]"
    assert meant("Action: done[]") == "done[]"
    for wrong, code in (("pick[mug_0]", "014"), ("Action: pick[]", "019"), ("Action: done[now]", "018")):
        with pytest.raises(LanguageModelError, match=f"H3-LLM-{code}"):
            meant(wrong)


# --- commands ---------------------------------------------------------------------------------------------------------
def test_generate_evaluate_and_replay_take_a_model_and_list_what_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def answer(body: dict[str, Any]) -> dict[str, Any]:
        return call("say", text="hm") if len(body["messages"]) == 2 else call("done")

    with chat_server(answer) as server:
        common = ("--scenes", HOME, "--episodes", 1, "--set", "max_steps=60")
        said = run(capsys, "generate", "language", *common, "--policy", server.policy(), "-o", tmp_path / "ds")
        assert "1 episode" in said
        table = run(capsys, "evaluate", "language", *common, "--policies", server.policy(), "-o", tmp_path / "ev")
        assert "scripted" in table
    assert "60" in run(capsys, "replay", tmp_path / "ds", "--verify")
    question = f"select count(*) from events where kind = '{SAY}'"
    assert "1" in run(capsys, "sql", question, tmp_path / "ds")
    shown = run(capsys, "llm", "show", tmp_path / "ds")
    assert 'say {"text": "hm"}' in shown
    again = run(capsys, "llm", "again", tmp_path / "ds")
    assert again.count("the same") == 3
    monkeypatch.setattr("h3data_llm.policy.FAULTS", 2)
    monkeypatch.setattr("h3data_llm.policy.RULES", "Do this: {instruction}")
    assert "another from 0 on" in run(capsys, "llm", "again", tmp_path / "ds", code=1)
    plain = ("generate", "language", *common, "--policy", "language_still", "--partner", "language_still")
    run(capsys, *plain, "-o", tmp_path / "plain")
    assert "No language model has played" in run(capsys, "llm", "show", tmp_path / "plain", code=2)
    seeds: list[int] = []

    def one_good(body: dict[str, Any]) -> Any:
        seeds.append(body["seed"])
        return call("done") if body["seed"] == seeds[0] else (200, "text/html", HTML)

    two = ("--scenes", HOME, "--episodes", 2, "--set", "max_steps=60")
    with chat_server(one_good) as server:
        said = run(capsys, "generate", "language", *two, "--policy", server.policy(), "-o", tmp_path / "bad", code=1)
    assert "failed" in said
    assert "H3-LLM-010" in said
    assert "No language model answers" in run(
        capsys, "generate", "language", *two, "--policy", server.policy(), "-o", tmp_path / "gone", code=2
    )


def test_a_budget_of_a_job_stops_it_between_requests_and_a_larger_one_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def answer(body: dict[str, Any]) -> dict[str, Any]:
        return call("say", text="hm") if len(body["messages"]) == 2 else call("done")

    budget = tmp_path / "budget.toml"
    spent = tmp_path / "budget.toml.spent"
    with chat_server(answer) as server:
        policy = server.policy(budget=budget)
        common = ("--scenes", HOME, "--episodes", 3, "--set", "max_steps=30")
        generate = ("generate", "language", *common, "--policy", policy, "-o", tmp_path / "ds")
        evaluate = ("evaluate", "language", *common, "--policies", policy, "-o", tmp_path / "ev")
        budget.write_text("calls = 3")
        said = run(capsys, *generate, code=2)
        assert "H3-LLM-035" in said
        assert "2 episodes (1, 2)" in said
        assert len(server.requests) == 3  # the second episode, which was not finished, is played again
        assert "H3-LLM-035" in run(capsys, *generate, "--resume", code=2)
        assert len(server.requests) == 3
        budget.write_text("calls = 8\ntokens = 90000")
        assert "3 episodes" in run(capsys, *generate, "--resume")
        assert len(server.requests) == len(spent.read_text().split()) == 7
        assert "2 episodes (1, 2)" not in run(capsys, *evaluate, code=2)
        assert len(server.requests) == 8
        budget.write_text("calls = 12")
        said = run(capsys, *evaluate, code=2)
        assert "1 episode (2)" in said
        budget.write_text("calls = 100")
        assert "scripted" in run(capsys, *evaluate)
    assert len(list((tmp_path / "ev" / "episodes").iterdir())) == 3
    made = [stored.read() for stored in find_episodes([tmp_path / "ds"])]
    assert [told["calls"] for each in made for told in each.episode.info["llm"]] == [2, 2, 2]
    assert not any("budget" in told["options"] for each in made for told in each.episode.info["llm"])


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (None, "033"),
        ("tokens = 0", "034"),
        ("calls = -1", "034"),
        ("tokens = 'many'", "034"),
        ("euros = 5", "034"),
        ("<html>", "034"),
        ("", "031"),
        ("tokens = 5", "032"),
    ],
)
def test_a_file_that_is_no_budget_is_refused_in_one_sentence(content: str | None, code: str, tmp_path: Path) -> None:
    file = tmp_path / "budget.toml"
    if content is not None:
        file.write_text(content)
    (tmp_path / "budget.toml.spent").write_text("12\nmuch\n")
    with pytest.raises(InputError, match=f"H3-LLM-{code}") as refused:
        JobBudget(str(file)).check()
    assert "\n" not in str(refused.value)


def test_the_cost_of_a_model_is_measured_and_reported_from_the_recording_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    answers = [call("say", text="hm"), call("teleport"), call("done")]
    with chat_server(script(answers)) as server:
        common = ("--scenes", HOME, "--episodes", 1, "--set", "max_steps=30")
        run(capsys, "generate", "language", *common, "--policy", server.policy(), "-o", tmp_path / "ds")
    (made,) = [stored.read() for stored in find_episodes([tmp_path / "ds"])]
    (told,) = made.episode.info["llm"]
    found = measure(made, "llm").values
    assert (found["calls"], found["plans"], found["tokens_out"]) == (3, 2, 60)
    assert found["tokens"] == sum(told["tokens"]) > 1000
    assert found["seconds"] == pytest.approx(sum(d["ms"] for d in told["decisions"]) / 1e3)
    shown = run(capsys, "llm", "show", tmp_path / "ds")
    assert f"3 answers, {sum(told['tokens']):,} tokens (60 of answers)" in shown
    page, tables = tmp_path / "report.html", tmp_path / "report.md"
    run(capsys, "report", tmp_path / "ds", "-o", page, "--markdown", tables, "--pictures", 0)
    assert f"{sum(told['tokens']):.2f}" in tables.read_text()
    assert "Cost of language models" in page.read_text()
    wrong = replace(made, episode=replace(made.episode, info={**made.episode.info, "llm": "x"}))
    with pytest.raises(UnmeasurableError, match="H3-LLM-026"):
        measure(wrong, "llm")
    plain = replace(made, episode=replace(made.episode, info={}))
    with pytest.raises(UnmeasurableError, match="H3-METRIC-026"):
        measure(plain, "llm")


@pytest.mark.parametrize(
    ("told", "code"),
    [
        ("x", "026"),
        ([{"policy": "llm:m", "agent": 0}], "026"),
        ([{"policy": "llm:m", "agent": 0, "options": {"model": "m", "calls": "many"}, "decisions": []}], "026"),
        ([{"policy": "llm:m", "agent": 0, "options": {"model": "m"}, "decisions": [{"step": 0}]}], "026"),
        ([{"policy": "llm:m", "agent": 9, "options": {"model": "m"}, "decisions": []}], "027"),
    ],
)
def test_malformed_answers_in_a_recording_are_one_sentence(told: Any, code: str) -> None:
    with chat_server(lambda body: call("done")) as server:
        made = play(episode("two_on", seed=1, max_steps=20), server.policy())
    wrong = replace(made, episode=replace(made.episode, info={**made.episode.info, "llm": told}))
    with pytest.raises(InputError, match=f"H3-LLM-{code}"):
        models_in(wrong)
