"""Recordings of rearrangement and of wandering simulated again: bit for bit, from any step, under other policies, beside
people who do not react."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from h3data.builtin import builtin_path
from h3data.errors import H3DataError, InputError
from h3data.recording import Dataset, DatasetWriter, Recording, open_recording, state_hash, write_mcap
from h3data.scene import FreeSpace, Scene
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.cli import main
from sim_kinematic.agents.skills import CONTROL, SKILLS, Action
from sim_kinematic.policies.learned import SHIPPED
from sim_kinematic.policies.rearrange import PARTNERS, ROBOT_POLICIES
from sim_kinematic.policies.views import RearrangeView
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode
from sim_kinematic.tasks.resume import counterfactual, resume, verify
from tests.simulated import rearrange_episode, simulate_rearrange, simulate_wander

STEP = 60
"""Where others take over in most tests: robot and person are under way."""


@pytest.fixture(scope="module")
def home() -> Scene:
    return build_home(HomeSpec(preset="small", seed=1))


@pytest.fixture(scope="module")
def world(home: Scene) -> RearrangeEpisode:
    return rearrange_episode(home, seed=3, free=FreeSpace.from_scene(home, radius_m=0.25))


@pytest.fixture(scope="module")
def episode(world: RearrangeEpisode) -> Recording:
    return simulate_rearrange(world, policy="complement", partner="both", solo_steps=500)


@pytest.fixture(scope="module")
def wandering(home: Scene) -> Recording:
    return simulate_wander(home, "robot,human", seed=4, steps=80)


def changed(recording: Recording, name: str, step: int, value: Any) -> Recording:
    array = recording.columns[name].copy()
    array[step] = value
    return replace(recording, columns={**recording.columns, name: array})


def require_same(one: Recording, other: Recording) -> None:
    """Every bit of every column, all skills and events."""
    assert {n: a.tobytes() for n, a in one.columns.items()} == {n: a.tobytes() for n, a in other.columns.items()}
    assert (one.skills, one.events, one.agents) == (other.skills, other.events, other.agents)
    same = [
        n
        for n in ("ended", "solo_steps", "policy", "partner", "partner_plan", "population", "spec", "goals")
        if n in other.episode.info
    ]
    assert [one.episode.info[n] for n in same] == [other.episode.info[n] for n in same]


@pytest.fixture(scope="module")
def known(world: RearrangeEpisode, episode: Recording) -> Callable[[int], Recording]:
    """Episodes of different casts and policies, in turn, each played once."""
    played = {0: episode}

    def of(number: int) -> Recording:
        agents, policy, partner = (
            ("robot,human", "complement", "both"),
            ("robot,human", "greedy_nearest", "plan_pop_4"),
            ("robot,robot", "complement,both", "both"),
            ("human", "complement", "both"),
        )[number]
        if number not in played:
            played[number] = simulate_rearrange(world.played_by(agents), policy=policy, partner=partner, solo_steps=500)
        return played[number]

    return of


# --- verify -----------------------------------------------------------------------------------------------------------
@pytest.mark.slow  # quick: test_resume
def test_a_recording_comes_out_again_through_both_stores(
    episode: Recording, wandering: Recording, tmp_path: Path
) -> None:
    for name, recording in (("r", episode), ("w", wandering)):
        with DatasetWriter(tmp_path / name) as out:
            out.add(recording)
        logged = open_recording(write_mcap(recording, tmp_path / f"{name}.mcap"))
        assert isinstance(logged, Recording)
        for stored in (logged, Dataset(tmp_path / name).recording(0)):
            found = verify(stored)
            assert found.equal
            assert found.steps == len(recording)


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("agent_0.base_pose", 0.125),
        pytest.param("agent_0.joint_pos", 0.125, marks=pytest.mark.slow),
        pytest.param("agent_1.joint_quat", 0.5, marks=pytest.mark.slow),
        pytest.param("object_pose", 1.0, marks=pytest.mark.slow),
        pytest.param("agent_1.grasp_body", 3, marks=pytest.mark.slow),
        pytest.param("metrics.reward", 0.0, marks=pytest.mark.slow),
        ("state_hash", np.uint64(1)),
    ],
)
def test_the_first_difference_is_named(episode: Recording, column: str, value: Any) -> None:
    found = verify(changed(episode, column, 40, value))
    assert found.difference is not None
    assert (found.difference.step, found.difference.column, found.steps) == (40, column, 40)


def test_a_skill_that_did_not_act_is_found(episode: Recording) -> None:
    first = next(s for s in episode.skills if s.agent == 0 and s.name == "nav_to_object")
    names = [goal["object"] for goal in episode.episode.info["goals"]]
    other = replace(first, target=names[1 - names.index(first.target)])
    told = replace(episode, skills=tuple(other if s is first else s for s in episode.skills))
    found = verify(told)
    assert found.difference is not None
    assert found.difference.step == first.start_step
    assert found.difference.column.startswith("agent_0.")


def test_a_command_that_did_not_act_is_found(wandering: Recording) -> None:
    found = verify(changed(wandering, "agent_0.action", 30, np.array([-0.5, 0.5], np.float32)))
    assert found.difference is not None
    assert found.difference.step == 30


# --- resume -----------------------------------------------------------------------------------------------------------
def test_a_policy_that_remembers_goes_on_under_any_of_its_names(world: RearrangeEpisode, tmp_path: Path) -> None:
    weights = tmp_path / "mine.npz"
    weights.write_bytes(builtin_path(SHIPPED["learn_pop"]).read_bytes())
    name, spec = f"weights:{weights}", replace(world.spec, max_steps=90)
    recording = simulate_rearrange(replace(world, spec=spec), policy=name, partner="both", solo_steps=500)
    cases: list[dict[str, Any]] = [{}, {"policy": name}, {"agents": {"robot": name}}]
    for options in cases:
        require_same(resume(recording, 61, **options), recording)
    weights.unlink()
    assert verify(recording).equal  # without them: nobody is asked


def test_resuming_gives_the_rest_of_the_episode(known: Callable[[int], Recording]) -> None:
    rng = np.random.default_rng(0)
    for number in (0, 3):
        recording = known(number)
        step = int(rng.integers(len(recording) + 1))
        again = resume(recording, step)
        require_same(again, recording)
        assert again.episode.uid != recording.episode.uid
        assert again.episode.info["resumed_from"]["step"] == step


@pytest.mark.slow
def test_resuming_is_exact_for_50_random_episodes_and_steps(world: RearrangeEpisode) -> None:
    rng, free = np.random.default_rng(0), world.free
    casts = ("robot,human", "robot,human", "robot,robot", "human,male_1", "robot,robot,human")
    for seed in range(50):
        drawn = rearrange_episode(world.scene, seed=seed, free=free, agents=casts[seed % len(casts)])
        policy, partner = str(rng.choice(list(ROBOT_POLICIES))), str(rng.choice(PARTNERS))
        recording = simulate_rearrange(drawn, policy=policy, partner=partner, solo_steps=500)
        step = int(rng.integers(len(recording) + 1))
        require_same(resume(recording, step), recording)
        robots = recording.agents[0].kind == "robot"
        other = resume(recording, step, **{"policy" if robots else "partner": str(rng.choice(list(ROBOT_POLICIES)))})
        assert verify(other).equal
        require_same(resume(other, int(rng.integers(step, len(other) + 1))), other)


@pytest.mark.slow
def test_others_take_over(episode: Recording) -> None:
    still = resume(episode, STEP, policy="still")
    both = resume(episode, STEP, policy="same_object", partner="object_2")
    for other in (still, both):
        for name, array in episode.columns.items():
            np.testing.assert_array_equal(other.columns[name][:STEP], array[:STEP], err_msg=name)
        assert verify(other).equal  # what was continued is a recording like any other
        require_same(resume(other, STEP + 20), other)
        stopped = [s for s in other.skills if s.agent == 0 and s.start_step < STEP]
        assert (stopped[-1].end_step, stopped[-1].outcome, stopped[-1].reason) == (STEP - 1, "aborted", "resumed")
    assert set(still.columns["agent_0.skill"][STEP:].tolist()) == {SKILLS.index("wait")}
    assert [still.episode.info[n] for n in ("policy", "partner", "deciding_since")] == ["still", "both", [STEP, 0]]
    assert both.episode.info["partner_plan"] == "object_2"
    require_same(resume(episode, STEP, policy="complement"), episode)  # by its own name
    twice = resume(resume(episode, STEP - 20, partner="object_1"), STEP, policy="greedy_nearest")
    assert verify(twice).equal
    require_same(resume(twice, STEP + 30), twice)
    assert twice.episode.info["deciding_since"] == [STEP, STEP - 20]


class Mine:
    """A policy without a name: it turns for ever."""

    def act(self, view: RearrangeView) -> Action:
        return Action("turn_left")

    def interrupts(self, view: RearrangeView) -> str:
        return ""


def test_a_policy_may_be_any_object(world: RearrangeEpisode, episode: Recording) -> None:
    info = episode.episode.info  # cut short, because it never comes to an end
    cut = {**info, "spec": {**info["spec"], "max_steps": 130}}
    other = resume(replace(episode, episode=replace(episode.episode, info=cut)), STEP, policy=Mine())
    assert other.episode.info["policy"] == "Mine"
    assert verify(other).equal
    with pytest.raises(InputError, match=r"(?s)policy=.*H3-TASK-040"):
        resume(other, STEP)
    assert resume(other, 90, policy="complement").episode.info["policy"] == "complement"


@pytest.mark.slow
def test_what_a_crash_left_can_be_continued(episode: Recording) -> None:
    left = {k: v for k, v in episode.episode.info.items() if k != "ended"}
    for rows in (1, 150):
        part = replace(
            episode,
            columns={n: a[:rows] for n, a in episode.columns.items()},
            episode=replace(episode.episode, info=left),
            events=(),
            skills=tuple(s for s in episode.skills if s.end_step < rows - 1),
        )
        assert verify(part).equal
        require_same(resume(part, rows), episode)


@pytest.mark.slow
def test_nothing_follows_steps_that_do_not_come_out_again(episode: Recording, wandering: Recording) -> None:
    for recording in (episode, wandering):
        broken = changed(recording, "agent_0.base_pose", 10, 0.0)
        resume(broken, 10)
        with pytest.raises(InputError, match="H3-TASK-034"):
            resume(broken, 11)


def test_who_wanders_wanders_on(wandering: Recording) -> None:
    for step in (0, 1, 37, 80):
        again = resume(wandering, step)
        require_same(again, wandering)
        assert again.episode.info["resumed_from"]["step"] == step
    for options in ({"policy": "random"}, {"partner": "both"}):
        with pytest.raises(InputError, match="H3-TASK-067"):
            resume(wandering, 3, **options)
    with pytest.raises(InputError, match="H3-TASK-067"):
        counterfactual(wandering, "random")


# --- counterfactual ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("step", [0, STEP])
def test_the_person_keeps_her_track_and_it_says_so(episode: Recording, step: int) -> None:
    other = counterfactual(episode, "same_object", step=step)
    rows = len(other)
    for name in (n for n in episode.columns if n.startswith("agent_1.") and "grasp" not in n):
        assert other.columns[name].tobytes() == episode.columns[name][:rows].tobytes()
    assert other.episode.info["human_reactive"] is False
    assert other.episode.info["counterfactual"] == {
        "uid": episode.episode.uid,
        "step": step,
        "policy": "complement",
        "track_from": step,
    }
    np.testing.assert_array_equal(
        state_hash({n: a for n, a in other.columns.items() if n != "state_hash"}), other.columns["state_hash"]
    )
    assert verify(other).equal
    require_same(resume(other, step + 40), other)


@pytest.mark.slow
def test_she_takes_only_what_is_there(world: RearrangeEpisode) -> None:
    """A robot that is at the person's object first keeps it; nobody is at two places, nothing is held twice."""
    alone = simulate_rearrange(world, policy="still", partner="object_1", solo_steps=500)
    picked = next(e.step for e in alone.events if e.kind == "pick")
    apart = counterfactual(alone, "still")
    assert [e for e in apart.events if e.kind == "pick"] == [e for e in alone.events if e.kind == "pick"]
    np.testing.assert_array_equal(apart.columns["object_pose"], alone.columns["object_pose"][: len(apart)])
    late = counterfactual(alone, "greedy_nearest", step=0)
    held = [late.columns[f"agent_{i}.grasp_body"] for i in (0, 1)]
    assert not ((held[0] == held[1]) & (held[0] >= 0)).any()
    still = (held[0] < 0) & (held[1] < 0)
    moved = np.abs(np.diff(late.columns["object_pose"], axis=0)).max(axis=(1, 2))
    assert moved[still[1:] & still[:-1]].max(initial=0.0) == 0
    assert 0 < picked < len(alone)


# --- hostile ----------------------------------------------------------------------------------------------------------
def with_info(**values: Any) -> Callable[[Recording], Recording]:
    return lambda r: replace(r, episode=replace(r.episode, info={**r.episode.info, **values}))


def with_goals(**values: Any) -> Callable[[Recording], Recording]:
    return lambda r: with_info(goals=[{**goal, **values} for goal in r.episode.info["goals"]])(r)


def with_skill(**values: Any) -> Callable[[Recording], Recording]:
    return lambda r: replace(r, skills=(replace(r.skills[0], **values), *r.skills[1:]))


def with_models(*models: str) -> Callable[[Recording], Recording]:
    return lambda r: replace(r, agents=tuple(replace(a, model=m) for a, m in zip(r.agents, models, strict=True)))


HOSTILE: dict[str, Callable[[Recording], Recording]] = {
    "no scene": lambda r: replace(r, attachments={}),
    "no skills": lambda r: replace(r, columns={n: a for n, a in r.columns.items() if n != "agent_0.skill"}),
    "unknown skill": lambda r: changed(r, "agent_0.skill", 3, 99),
    "unknown target": lambda r: changed(r, "agent_1.skill_target", 3, 2),
    "a skill of another name": with_skill(name="fly"),
    "a skill of the lower layer": with_skill(name=CONTROL),
    "a skill with an unknown object": with_skill(target="moon"),
    "a skill without its object": with_skill(name="pick", target=""),
    "rules of another kind": with_info(spec=[1, 2]),
    "rules with words": with_info(spec={"max_steps": "many"}),
    "endless rules": with_info(spec={"max_steps": 10**15}),
    "no rules": with_info(spec={"max_steps": 0}),
    "starts with words": with_info(robot_start=["a", 0, 0]),
    "starts in nowhere": with_info(human_start=[float("nan"), 0.0, 0.0]),
    "starts in a wall": with_info(human_start=[1e6, 0.0, 0.0]),
    "one start": with_info(starts=[[0.0, 0.0, 0.0]]),
    "goals of another kind": with_info(goals={"x": 1}),
    "no goals": with_info(goals=[]),
    "goals of nothing": with_goals(object="moon"),
    "goals without a start": with_goals(start=None),
    "goals in nowhere": with_goals(position=[0.0, float("inf"), 0.0]),
    "short goals": with_goals(position=[0.0]),
    "bodies of another name": with_models("robot/../x", "humanoid/female_0"),
    "two people": with_models("humanoid/female_0", "humanoid/female_0"),
    "another's history": with_info(deciding_since=[0]),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_cannot_be_simulated_is_refused(episode: Recording, name: str) -> None:
    broken = HOSTILE[name](episode)
    for job in (verify, lambda r: resume(r, 5), lambda r: counterfactual(r, "still", step=5)):
        with pytest.raises(H3DataError):
            job(broken)


@pytest.mark.parametrize(
    "broken",
    [
        with_info(starts=[[0.0, 0.0]]),
        with_info(starts=[[1e6, 0.0, 0.0]] * 2),
        with_info(spec={"max_steps": "x"}),
        with_models("robot/quad_arm", "humanoid/nobody"),
        lambda r: changed(r, "agent_0.action", 3, np.nan),
    ],
)
def test_wanderers_that_cannot_be_simulated_are_refused(
    wandering: Recording, broken: Callable[[Recording], Recording]
) -> None:
    with pytest.raises(H3DataError):
        verify(broken(wandering))


def test_tracks_and_policies_that_are_none_are_refused(known: Callable[[int], Recording], episode: Recording) -> None:
    for track in (changed(episode, "agent_1.root_pose", 3, np.nan), changed(episode, "object_pose", 3, np.nan)):
        with pytest.raises(InputError):
            counterfactual(track, "still")
    with pytest.raises(InputError, match="H3-TASK-036"):
        counterfactual(known(2), "still")
    with pytest.raises(InputError, match=r"(?s)greedy_nearest.*H3-POLICY-002"):
        resume(episode, 5, policy="magic")
    with pytest.raises(InputError, match=r"(?s)plan_pop_4.*H3-POLICY-002"):
        resume(episode, 5, partner="magic")
    for step in (-1, len(episode) + 1):
        with pytest.raises(InputError, match="H3-TASK-035"):
            resume(episode, step)


def test_an_empty_recording_has_nothing_to_differ_in(episode: Recording, wandering: Recording) -> None:
    for recording in (episode, wandering):
        empty = replace(recording, columns={n: a[:0] for n, a in recording.columns.items()}, events=(), skills=())
        assert verify(empty).equal
        require_same(resume(empty, 0), recording)


# --- command ----------------------------------------------------------------------------------------------------------
@pytest.mark.slow  # quick: test_driven_person verifies by the command
def test_the_command(
    episode: Recording, wandering: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*arguments: str | Path, code: int = 0) -> Any:
        capsys.readouterr()
        assert main(["replay", *map(str, arguments), "--json"]) == code
        return json.loads(capsys.readouterr().out)

    folder, out = tmp_path / "in", tmp_path / "out.mcap"
    file = folder / "a.mcap"
    write_mcap(episode, file)
    write_mcap(wandering, folder / "b.mcap")
    assert run(folder, "--verify")["equal"] == 2
    made = run(file, "--resume-from", "50", "--policy", "still", "--partner", "object_1", "-o", out)
    assert (made["kept"], made["policy"]) == (50, "still")
    assert run(folder / "b.mcap", "--resume-from", "50", "-o", out, "--force")["steps"] == 80
    made = run(file, "--counterfactual", "--policy", "greedy_nearest", "-o", out, "--force")
    assert made["human_reactive"] is False
    assert run(out, "--verify")["equal"] == 1
    assert (
        "tracks"
        in run(file, "--counterfactual", "--policy", "still", "--partner", "both", "-o", out, "--force", code=2)[
            "error"
        ]
    )
