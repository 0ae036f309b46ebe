"""Tasks in words: sampled, told, carried out, judged, recorded and read again."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.errors import FormatError, InputError
from h3data.policies import Action, External
from h3data.recording.task_episodes.stored_episodes import info_block
from h3data.scene import FreeSpace
from h3data.scene.scene_sets import read_scene_set
from h3data_language.episode import LanguageSpec, can_be_done
from h3data_language.evaluation.layout import Layout
from h3data_language.evaluation.predicates import Rows, truth_of
from h3data_language.evaluation.profile import verdict_of
from h3data_language.evaluation.records import Evaluation, Proposition
from h3data_language.experts import Expert
from h3data_language.grounding import home_of, parse
from h3data_language.task import HANDLING_STEPS, Language, check_extra, put
from h3data_language.templates import KINDS, TEMPLATES, affords
from h3data_language.verification import (
    PlayedTask,
    VerifiedTask,
    rows_of_kinds,
    skip_table,
    tasks_in,
    verify_homes,
    verify_task,
)
from h3data_pipelines.benchmark.definition import find_benchmark
from h3data_pipelines.cli import main
from h3data_pipelines.jobs.episodes import Choices, make_jobs
from sim_kinematic.agents.roster import kinds_of
from sim_kinematic.agents.skills import PRIMITIVES, Destination, SkillResult
from sim_kinematic.motion.state import NOBODY
from sim_kinematic.policies.rearrange import errand
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.resume import verify

HOME, OPEN_HOME, DRAWERS = "h3-homes/val#3", "small2-open:0", "kitchen_counter_2"


def run(capsys: pytest.CaptureFixture[str], *words: object, code: int = 0) -> str:
    """Everything that a command prints."""
    capsys.readouterr()
    assert main([str(word) for word in words]) == code
    said = capsys.readouterr()
    return said.out + said.err


@lru_cache(maxsize=1)
def place() -> tuple[Any, FreeSpace]:
    scene = h3data.load_scene(HOME)
    return scene, FreeSpace.from_scene(scene, radius_m=0.25, height_m=1.41)


@lru_cache(maxsize=64)
def episode(template: str, seed: int = 0, **rules: Any) -> Any:
    scene, free = place()
    return Language().episode(scene, free=free, seed=seed, spec=LanguageSpec(template=template, **rules))


NOT_IN_THIS_HOME = [t.name for t in TEMPLATES if t.name.startswith("switch") or "inside" in t.name]


@pytest.mark.parametrize("template", [t.name for t in TEMPLATES if t.name not in NOT_IN_THIS_HOME])
def test_each_template_gives_a_task_that_can_be_done_and_is_not_done(template: str) -> None:
    """Sampling checks each task itself; here the checks are made again from what is recorded."""
    sampled = episode(template)
    assert sampled.extra["template"] == template
    assert len(sampled.targets) == 3
    evaluation = Evaluation.of(json.loads(json.dumps(sampled.extra, default=list)))
    assert evaluation.propositions
    check_extra(sampled.extra, 3)
    named = {name for p in evaluation.propositions for names in p.things for name in names}
    assert named & {t.name for t in sampled.targets}
    assert can_be_done(sampled_task(sampled))


def sampled_task(sampled: Any) -> Any:
    from h3data_language.episode import LanguageTask

    return LanguageTask(
        instruction=sampled.wording, targets=sampled.targets, starts=sampled.pair_starts, extra=sampled.extra
    )


def test_a_task_that_is_done_from_the_start_or_voids_itself_does_not_pass_the_check() -> None:
    sampled = episode("two_on")
    done = sampled_task(sampled)
    first = done.targets[0]
    lies = first._replace(start=np.append(first.goal, first.start[3:]))
    from dataclasses import replace

    assert not can_be_done(replace(done, targets=(lies, *done.targets[1:])))
    circle = {"type": "TemporalConstraint", "args": {"dag_edges": [[1, 0]]}}
    wrong = {**done.extra, "evaluation_constraints": [circle]}
    assert not can_be_done(replace(done, extra=wrong))


def test_a_home_without_what_a_template_needs_says_so() -> None:
    home = home_of(place()[0], 0.35)
    assert not any(affords(kind, "power") for kind in home.categories.values())
    with pytest.raises(h3data.errors.SceneError, match="H3-LANGUAGE-010") as refused:
        episode("switch_on")
    assert refused.value.code.startswith("H3-LANGUAGE-")


def test_an_instruction_means_its_propositions_and_one_about_nothing_is_refused() -> None:
    words = {
        "abc": {"the mug": ("mug_0",), "the apple": ("apple_0",)},
        "pq": {"the desk": ("desk_0",), "a nightstand": ("nightstand_0", "nightstand_1")},
        "rs": {"the kitchen": ("kitchen",)},
    }
    (meant,) = parse("First put the mug on the desk, then put the apple on a nightstand.", words)
    assert [p.things for p in meant.propositions] == [
        (("mug_0",), ("desk_0",)),
        (("apple_0",), ("nightstand_0", "nightstand_1")),
    ]
    assert meant.constraints[0].edges == [[0, 1]]
    for text in (
        "Put the spoon on the desk.",
        "Put the mug on the moon.",
        "Sing.",
        "",
        "<script>",
        "Put the mug on the desk",
    ):
        with pytest.raises(InputError, match="H3-LANGUAGE-014") as refused:
            parse(text, words)
        assert refused.value.code.startswith("H3-LANGUAGE-")


def test_wordings_name_all_slots_once() -> None:
    import re

    assert len({t.name for t in TEMPLATES}) == len(TEMPLATES)
    for template in TEMPLATES:
        asked = {slot for clause in template.clauses for slot in re.findall(r"\b[a-cp-su-v]\b", clause)}
        for wording in template.wordings:
            assert sorted(re.findall(r"\{(\w)\}", wording)) == sorted(asked), template.name
    assert {t.kind for t in TEMPLATES} == set(KINDS)


@pytest.mark.parametrize("template", ["next_to_there", "wash_then_put", "twice"])
def test_the_expert_does_a_task_alone_and_in_a_pair(template: str) -> None:
    alone, pair = verify_task(Language(), episode(template))
    assert alone.success
    assert pair.success
    rows = rows_of_kinds([VerifiedTask(0, "", "free", "", alone, pair)])
    assert rows[1] == ["free", "1", str(alone.steps), str(pair.steps), f"{alone.steps / pair.steps:.2f}", rows[1][5]]


def test_greedy_agents_do_a_task_without_a_common_plan() -> None:
    from h3data_language.verification import play_task

    assert play_task(Language(), episode("two_places"), "language_greedy").success
    still = play_task(Language(), episode("two_places", max_steps=30), "language_still")
    assert (still.success, still.complete, still.steps) == (False, 0.0, 30)


@lru_cache(maxsize=4)
def recorded(template: str) -> Any:
    return h3data.simulate(Language(), scenes=HOME, seed=1, spec=LanguageSpec(template=template))


def test_a_robot_that_cannot_get_on_again_and_again_tries_other_ways_and_a_person_does_not() -> None:
    task = episode("two_on", seed=1)
    kinds = kinds_of(task.roster)
    held = np.full(len(task.targets), NOBODY)

    def told(number: int, reason: str, times: int) -> list[list[str]]:
        expert, found = Expert(task, number, kinds, greedy=True), []
        expert.plan.doing[number] = 0
        held[0] = number
        for step in range(times):
            last = SkillResult("failed", reason)
            expert._note(SimpleNamespace(last=last, action=Action("nav_to_goal", 0), step=step, held_by=held))  # type: ignore[arg-type]
            if expert.escape:
                found.append(expert.escape)
                expert.escape = []
        return found

    robot, person = kinds.index("robot"), kinds.index("human")
    tried = told(robot, "stuck", 15)
    assert len(tried) == len({*map(tuple, tried)}) == 4
    assert all(skill in PRIMITIVES for way in tried for skill in way)
    assert not told(robot, "blocked", 15)
    assert not told(robot, "stuck", 5)
    assert not told(person, "stuck", 15)


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["language_greedy", "language_talk"])
def test_a_robot_gets_free_that_is_wedged_in_a_doorway(robot: str) -> None:
    """Task 58 of the benchmark, which failed: the robot backs out of a room and turns too early."""
    job = find_benchmark("h3-language@1").jobs()[58].base
    made = simulate(Language(), job.episode(), {"robot": robot, "human": "language_greedy"})
    assert made.episode.info["ended"] == "success"
    assert any(span.name in PRIMITIVES for span in made.skills)
    assert verify(made).equal


def test_a_recording_tells_the_task_and_its_evaluation_agrees_with_the_episode() -> None:
    recording = recorded("put_then_fill")
    info = recording.episode.info
    assert info["instruction"].endswith("it there.")
    assert info["ended"] == "success"
    verdict = verdict_of(recording)
    assert verdict.percent_complete == 1
    assert verdict.explanation == ""
    assert verdict.satisfied_at.max() == len(recording) - 1  # it ends with the last of them
    assert recording.columns["object_state.filled"][-1].sum() == 1
    assert not recording.columns["object_state.filled"][0].any()
    assert [e.detail for e in recording.events if e.kind == "state"] == ["filled"]
    assert recording.columns["metrics.percent_complete"][-1] == 1
    values = h3data.measure(recording).values
    assert (values["PC"], values["state_success"]) == (1, 1)


def test_generated_tasks_are_reproduced_from_recordings_and_from_episode_files(
    tmp_path: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ("--scenes", HOME, "--episodes", 1, "--seed", 4)
    file, first, second = tmp_path / "e.json", tmp_path / "a", tmp_path / "b"
    run(capsys, "generate", "language", *where, "--save-episodes", file, "-o", first)
    run(capsys, "generate", "language", "--episodes-file", file, "-o", second)
    said = run(capsys, "replay", first, "--verify")
    assert "equal" in said
    a, b = h3data.open(first)[0], h3data.open(second)[0]
    assert a.episode.info["instruction"] == b.episode.info["instruction"]
    assert (a.columns["object_pose"] == b.columns["object_pose"]).all()
    assert a.episode.info["instruction"] in run(capsys, "info", f"{first}#0")
    assert "PC" in run(capsys, "metrics", first)


def test_the_commands_list_templates_and_verify_tasks(capsys: pytest.CaptureFixture[str]) -> None:
    assert f"{len(TEMPLATES)} templates" in run(capsys, "language", "templates")
    assert "faster" in run(capsys, "language", "verify", "--scenes", HOME, "--episodes", 1)
    assert "H3-LANGUAGE-" in run(capsys, "language", "verify", "--episodes", 0, code=2)


def test_generate_measures_the_other_episodes_if_one_cannot_be_sampled(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from h3data_language import task

    real, calls = task.sample_task, []

    def sample(*given: Any) -> Any:
        calls.append(given)
        if len(calls) == 2:
            raise h3data.errors.SceneError("no room", code="H3-LANGUAGE-010")
        return real(*given)

    monkeypatch.setattr(task, "sample_task", sample)
    args = ("generate", "language", "--scenes", HOME, "--episodes", 2, "--max-steps", 40, "-o", tmp_path / "ds")
    said = run(capsys, *args, code=1)
    assert "H3-LANGUAGE-010" in said
    assert "state_success" in said


DONE, FAILED = PlayedTask(True, 1.0, 20), PlayedTask(False, 0.5, 90)


def test_episodes_that_are_no_task_or_are_not_completed_make_room_for_the_next(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What verify skips, a set with its lines skips too, in this task alone."""
    played: list[int] = []
    sampled, home = episode("two_on"), tasks_in("h3-homes/val", episodes=24, seed=0)[3]
    assert home.numbers == (3, 15)

    def sample(job: Any) -> Any:
        played.append(job.seed)
        if job.seed == home.seed_of(1):
            raise h3data.errors.SceneError("no room", code="H3-LANGUAGE-010")
        return sampled

    def fails_in_the_first(*_: Any) -> Any:
        if played[-1] == home.seed_of(3) and len(played) == 4:
            raise RuntimeError("a fault of ours")
        return (DONE, FAILED if played[-1] == home.seed_of(0) else DONE)

    monkeypatch.setattr("h3data_pipelines.jobs.episodes.Job.episode", sample)
    monkeypatch.setattr("h3data_language.verification.verify_task", fails_in_the_first)
    out = tmp_path / "verified"
    done = verify_homes([home], out)
    # 0 and 1 are none; 2 and 3 take their places, but 3 fails, and 4 takes its place
    assert [index for index in range(5) if home.seed_of(index) in played] == list(range(5))
    assert ([t.number for t in done.tasks], done.new, done.short) == ([3, 15], 5, [])
    assert [(s.episode, s.reason) for s in done.skipped] == [
        (0, "not completed by robot and person"),
        (1, "could not be sampled [H3-LANGUAGE-010]"),
    ]
    assert len(done.failed) == 1
    assert done.failed[0].startswith("episode 3 of val_03: RuntimeError: a fault of ours")
    again = verify_homes([home], out, resume=True)  # that one is played again, and is a task
    assert (again.new, again.skipped, again.failed) == (1, done.skipped, [])
    text = 'format = 1\nname = "h3-homes"\nsplit = "val"\nscenes = [{ id = "val_03", seed = 1 }]\n'
    file = tmp_path / "mine.toml"
    file.write_text(text + skip_table([home], again.skipped))
    known = read_scene_set(file)
    assert [known.place(k, "language")[1] for k in range(3)] == [2, 3, 4]
    assert [known.place(k)[1] for k in range(3)] == [0, 1, 2]
    for seed, index in ((0, 2), (5, 0)):  # another seed has other episodes
        (home,) = tasks_in(str(file), episodes=1, seed=seed)
        jobs = make_jobs(Choices(task="language"), str(file), episodes=1, seed=seed)
        assert jobs[0].seed == known.episode_seed("val_03", index, seed=seed)
        assert home.skipped == (() if seed else (0, 1))
        assert skip_table([home], []) == ("" if seed else "[skipped.language]\nval_03 = [0, 1]")
    file.write_text(text + "[skipped.language]\nval_04 = [1]\n")
    with pytest.raises(FormatError, match="H3-SCENE-058"):
        read_scene_set(file)
    monkeypatch.setattr("h3data_language.verification.TRIES", 1)
    monkeypatch.setattr("h3data_language.verification.verify_task", lambda *_: (FAILED, FAILED))
    verify = ("language", "verify", "--scenes", HOME, "--episodes", 1)
    assert "H3-LANGUAGE-" in run(capsys, *verify, code=2)
    assert "H3-LANGUAGE-" in run(capsys, *verify, "--resume", code=2)
    assert "H3-JOB-044" in run(capsys, *verify, "--resume", "-o", tmp_path / "nothing", code=2)
    others = ("language", "verify", "--scenes", "h3-homes/val", "--episodes", 4, "--seed", 1)
    assert "H3-JOB-045" in run(capsys, *others, "-o", out, code=2)


SLOW_VERIFY = """
import sys, time
from h3data_language import verification as v
from h3data_pipelines.cli import main
v.verify_task = lambda task, episode: (time.sleep(0.05), (v.PlayedTask(True, 1.0, 3), v.PlayedTask(True, 1.0, 2)))[1]
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_a_verification_that_is_stopped_goes_on_where_it_was(
    number: signal.Signals, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    words = [str(w) for w in ("language", "verify", "--scenes", HOME, "--episodes", 30, "-o", out)]
    process = subprocess.Popen([sys.executable, "-c", SLOW_VERIFY, *words], stderr=subprocess.PIPE, text=True)
    end = time.monotonic() + 120
    while len(list(out.glob("episodes/*.json"))) < 2:
        assert process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.02)
    process.send_signal(number)
    _, error = process.communicate(timeout=60)
    there = {file: file.read_text() for file in sorted(out.glob("episodes/*.json"))}
    assert 2 <= len(there) < 30
    assert all(json.loads(text)["alone"]["success"] for text in there.values())
    if number == signal.SIGINT:
        assert process.returncode == 130
        assert f"results of {len(there)} episodes in {out}: the same command goes on" in error
    monkeypatch.setattr("h3data_language.verification.verify_task", lambda *_: (DONE, DONE))
    words[words.index("30")] = str(len(there) + 2)
    said = json.loads(run(capsys, *words, "--resume", "--quiet", "--json"))
    assert said["new"] == 2
    assert len(said["tasks"]) == len(there) + 2
    assert {file: file.read_text() for file in there} == there
    assert said["sha256"] in (out / "table.txt").read_text()


def test_only_people_beside_a_thing_can_handle_it() -> None:
    task = Language()
    session = h3data.session(task, scenes=HOME, seed=1, spec=LanguageSpec(template="wash"), roster=("robot", "human"))
    play = session.play
    thing = next(k for k, (state, _) in enumerate(play.episode.extra["uses"]) if state)
    other = next(k for k, (state, _) in enumerate(play.episode.extra["uses"]) if not state)
    wait = Action("wait", thing, HANDLING_STEPS)
    assert "no hand" in str(task.control.refusal(play, 0, wait))
    pose, person = play.world.state.object_pose[0, thing], play.world.state.agents[1].xz[0]
    pose[[0, 2]] = person + 2.0
    assert "too far away" in str(task.control.refusal(play, 1, wait))
    pose[[0, 2]] = person + 0.5
    assert task.control.refusal(play, 1, wait) is None
    play.world.state.held_by[0, thing] = 0
    assert "Somebody else" in str(task.control.refusal(play, 1, wait))
    assert "nothing to do" in str(task.control.refusal(play, 1, Action("wait", other)))
    assert task.control.refusal(play, 1, Action("wait")) is None


class Porter:
    """Puts things at places, one after the other."""

    def __init__(self, puts: list[Action]) -> None:
        self.puts, self.now, self.said = puts, 0, False

    def act(self, view: Any) -> Action:
        """First says where a thing goes, then brings it there."""
        if self.said and view.at_goal[self.puts[self.now].target]:
            self.now, self.said = self.now + 1, False
        if self.now == len(self.puts):
            return Action("wait")
        if not self.said:
            self.said = True
            return self.puts[self.now]
        return errand(view, self.puts[self.now].target)


@pytest.mark.slow
def test_things_are_put_where_somebody_says_and_replays_do_the_same() -> None:
    spec = LanguageSpec(template="inside", max_steps=2500)
    sampled: Any = Language().episode(h3data.load_scene(OPEN_HOME), seed=3, spec=spec)
    things = [t.name for t in sampled.targets]
    jar, paste, pepper = things
    puts = put(things, pepper, f"inside {DRAWERS}"), put(things, paste, "bed_0"), put(things, jar, "bed_0", paste)
    porter = Porter(list(puts))
    recording = simulate(Language(), sampled, {"robot": porter, "human": "language_still"})
    assert porter.now == 3
    said = [event.detail for event in recording.events if event.kind == "aim"]
    assert said == [f"inside {DRAWERS}", "bed_0", f"bed_0 next to {paste}"]
    rows = Rows(
        Layout.of_info(recording.episode.info), recording.columns["object_pose"][-1:], np.zeros((1, 3), np.bool_)
    )
    for name, thing, there in (
        ("is_inside", pepper, DRAWERS),
        ("is_on_top", paste, "bed_0"),
        ("is_on_top", jar, "bed_0"),
    ):
        asked = {"object_handles": [thing], "receptacle_handles": [there]}
        assert truth_of(Proposition(name, asked), rows)[0][0], (name, thing)
    near = Proposition("is_next_to", {"entity_handles_a": [paste], "entity_handles_b": [jar]})
    assert truth_of(near, rows)[0][0]
    assert verify(recording).equal


@pytest.mark.slow
def test_things_are_put_on_the_floor_of_a_room_and_replays_do_the_same() -> None:
    sampled = episode("two_on", 3)
    one, other, third = [t.name for t in sampled.targets]
    things = [one, other, third]
    puts = put(things, one, "floor of kitchen"), put(things, other, "floor of kitchen", one), put(things, one, "sofa_0")
    porters = (
        {"robot": Porter([puts[0]]), "human": "language_still"},
        {"human": Porter(list(puts)), "robot": "language_still"},
    )
    for who in porters:
        recording = simulate(Language(), replace(sampled, spec=replace(sampled.spec, max_steps=2500)), who)
        places = [event for event in recording.events if event.kind == "place"]
        assert len(places) == len(next(p for p in who.values() if isinstance(p, Porter)).puts)
        at = recording.columns["object_pose"][[e.step for e in places]]
        rows = Rows(Layout.of_info(recording.episode.info), at, np.zeros(at.shape[:2], np.bool_))
        low = Proposition("is_on_floor", {"object_handles": [one]})
        there = Proposition("is_in_room", {"object_handles": [one], "room_ids": ["kitchen"]})
        near = Proposition("is_next_to", {"entity_handles_a": [one], "entity_handles_b": [other]})
        expected = [True, True, False][: len(places)]
        assert [truth_of(p, rows)[0].tolist() for p in (low, there)] == [expected] * 2
        assert truth_of(near, rows)[0].tolist() == [False, True, False][: len(places)]
        assert verify(recording).equal


def test_the_floor_is_asked_for_only_by_name() -> None:
    assert not any(t.by_name for kind in KINDS for t in LanguageSpec().templates(kind))
    assert [t.name for t in LanguageSpec(template="floor").templates()] == ["floor"]
    sampled = episode("floor_next_to")
    assert [p["function_name"] for p in sampled.extra["evaluation_propositions"]] == [
        "is_on_floor",
        "is_in_room",
        "is_on_floor",
        "is_next_to",
    ]
    assert [goal.destination for goal in Language().codec.record(sampled).goals][:2] == ["", ""]


def test_destinations_that_do_not_exist_or_are_full_are_refused() -> None:
    session = h3data.session(
        Language(), scenes=OPEN_HOME, seed=3, spec=LanguageSpec(template="inside"), agents={"robot": External()}
    )
    things = session.play.team.objects.names
    for place, next_to, code in (
        ("moon_0", "", "018"),
        ("floor of moon_0", "", "018"),
        ("inside bed_0", "", "018"),
        ("bed_0", "spoon", "019"),
    ):
        with pytest.raises(InputError, match=f"H3-LANGUAGE-{code}"):
            session.refusal("robot", put(things, things[0], place, next_to))
    with pytest.raises(InputError, match="H3-LANGUAGE-019"):
        put(things, "spoon", "bed_0")
    assert session.refusal("robot", put(things, things[0], "bed_0")) is None
    assert Destination.of(str(Destination("inside fridge_0", "mug_1"))) == ("inside fridge_0", "mug_1")


@pytest.mark.slow
@pytest.mark.parametrize(
    "template",
    [
        pytest.param(t.name, marks=[] if t.name == "inside" else pytest.mark.slow)
        for t in TEMPLATES
        if "inside" in t.name
    ],
)
def test_goals_in_drawers_and_cupboards_are_reached(template: str) -> None:
    sampled = Language().episode(h3data.load_scene(OPEN_HOME), seed=1, spec=LanguageSpec(template=template))
    assert can_be_done(sampled_task(sampled))
    assert {p.function_name for p in Evaluation.of(sampled.extra).propositions} >= {"is_inside"}
    _, pair = verify_task(Language(), sampled)
    assert pair.success


@pytest.mark.parametrize(
    "rules", [{"kind": "easy"}, {"template": "one"}, {"kind": "free", "template": "wash"}, {"max_steps": 0}]
)
def test_rules_that_mean_nothing_are_refused(rules: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        LanguageSpec(**rules)


@pytest.mark.parametrize(
    "change",
    [
        {"uses": None},
        {"uses": [["wet", True]] * 3},
        {"states": {"clean": [True]}},
        {"evaluation_propositions": [{"function_name": "is_clean", "args": {"object_handles": ["spoon_0"]}}]},
        {"evaluation_layout": {}},
    ],
)
def test_episode_files_that_were_tampered_with_are_refused(change: dict[str, Any]) -> None:
    task = Language()
    record = task.codec.record(episode("wash"))
    entry = task.codec.entry(record, episode_id="0", scene_id="x")
    assert task.codec.read(entry, seed=0) is not None
    import msgspec

    broken = msgspec.structs.replace(record, extra={**record.extra, **change})
    entry = msgspec.structs.replace(entry, info=info_block("language", broken))
    with pytest.raises(InputError):
        task.codec.read(entry, seed=0)
