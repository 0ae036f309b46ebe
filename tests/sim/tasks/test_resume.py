"""Recordings simulated again: bit for bit, from any step, under other policies, beside a person who does not react."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from h3data.errors import H3DataError, InputError
from h3data.recording import Dataset, DatasetWriter, Recording, open_recording, recordings_equal, state_hash, write_mcap
from h3data.scene import FreeSpace
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.cli import main
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.policies.learned import network_of
from sim_kinematic.policies.policy import FunctionPolicy, Velocity
from sim_kinematic.policies.social_nav import POLICIES
from sim_kinematic.tasks.resume import counterfactual, resume, verify
from tests.simulated import simulate_social_nav, social_nav_episode

SCENE = build_home(HomeSpec(preset="small", seed=1))
GOALS = 3


def simulated(seed: int, *, policy: str = "rollout_expert", steps: int = 150, told: bool = False) -> Recording:
    spec = SocialNavSpec(max_steps=steps)
    world = social_nav_episode(SCENE, seed=seed, spec=spec, free=FreeSpace.from_scene(SCENE, radius_m=0.25))
    if told:  # goals that do not follow from the seed
        rng = np.random.default_rng(0)
        goals = [[float(x), float(z)] for x, z in world.free.sample(rng, GOALS)]
        world = replace(world, extra={"human_goals": goals})
    return simulate_social_nav(world, policy=policy)


@pytest.fixture(scope="module")
def episode() -> Recording:
    return simulated(5)


def changed(recording: Recording, name: str, step: int, value: Any) -> Recording:
    array = recording.columns[name].copy()
    array[step] = value
    return replace(recording, columns={**recording.columns, name: array})


def run_json(capsys: pytest.CaptureFixture[str], *arguments: str | Path, code: int = 0) -> Any:
    capsys.readouterr()
    assert main([*map(str, arguments), "--json"]) == code
    return json.loads(capsys.readouterr().out)


# --- verify -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "policy",
    [
        policy if policy in ("rollout_expert", "random") else pytest.param(policy, marks=pytest.mark.slow)
        for policy in POLICIES
    ],
)
def test_a_recording_comes_out_again_through_both_stores(policy: str, tmp_path: Path) -> None:
    recording = simulated(6, policy=policy, told=policy == "random")
    with DatasetWriter(tmp_path / "ds") as out:
        out.add(recording)
    logged = open_recording(write_mcap(recording, tmp_path / "a.mcap"))
    assert isinstance(logged, Recording)
    for stored in (logged, Dataset(tmp_path / "ds").recording(0)):
        found = verify(stored)
        assert found.equal
        assert found.steps == len(recording)


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("agent_0.base_pose", np.float32(0.125)),
        ("agent_1.motion_phase", np.float32(0.125)),
        ("sim.human_leg", 77),
        ("metrics.dist_agents", np.nan),
        ("state_hash", np.uint64(1)),
        ("time_ns", 40 * 33_333_333 + 1),
    ],
)
def test_the_first_difference_is_named(episode: Recording, column: str, value: Any) -> None:
    found = verify(changed(episode, column, 40, value))
    assert found.difference is not None
    assert (found.difference.step, found.difference.column, found.steps) == (40, column, 40)
    assert found.difference.recorded != found.difference.simulated


def test_an_action_that_did_not_act_is_found(episode: Recording) -> None:
    found = verify(changed(episode, "agent_0.action", 30, np.array([0.0, 0.5], np.float32)))
    assert found.difference is not None
    assert found.difference.step == 30


def test_a_recording_that_goes_on_after_the_end_is_found() -> None:
    short = simulated(5, steps=60)
    rules = {**short.episode.info["spec"], "max_steps": 40}
    found = verify(replace(short, episode=replace(short.episode, info={**short.episode.info, "spec": rules})))
    assert found.difference is not None
    assert (found.difference.step, found.difference.recorded) == (40, "goes on")


# --- resume -----------------------------------------------------------------------------------------------------------
def _resumes_exactly(recording: Recording, step: int) -> None:
    again = resume(recording, step)
    assert {n: a.tobytes() for n, a in again.columns.items()} == {n: a.tobytes() for n, a in recording.columns.items()}
    assert (again.events, again.skills, again.agents) == (recording.events, recording.skills, recording.agents)
    same = ("ended", "human_goals", "oracle_min_steps", "policy", "spec")
    assert [again.episode.info[n] for n in same] == [recording.episode.info[n] for n in same]
    assert again.episode.uid != recording.episode.uid
    assert again.episode.info["resumed_from"]["step"] == step


@pytest.mark.parametrize("step", [0, 1, 97, 150])
def test_resuming_gives_the_rest_of_the_episode(episode: Recording, step: int) -> None:
    _resumes_exactly(episode, step)


@pytest.mark.slow
def test_resuming_is_exact_for_50_random_episodes_and_steps() -> None:
    rng = np.random.default_rng(0)
    for seed in range(50):
        recording = simulated(
            int(rng.integers(2**31)), policy=list(POLICIES)[seed % 3], steps=1500, told=bool(seed % 2)
        )
        _resumes_exactly(recording, int(rng.integers(len(recording) + 1)))


def test_another_policy_takes_over(episode: Recording) -> None:
    other = resume(episode, 60, policy="stand_still")
    np.testing.assert_array_equal(other.columns["agent_0.base_pose"][:60], episode.columns["agent_0.base_pose"][:60])
    assert not other.columns["agent_0.action"][60:].any()
    assert np.ptp(other.columns["agent_0.base_pose"][59:], axis=0).max() == 0
    rows = min(len(other), len(episode))
    np.testing.assert_array_equal(
        other.columns["agent_1.base_pose"][:rows], episode.columns["agent_1.base_pose"][:rows]
    )
    assert verify(other).equal  # what was continued is a recording like any other
    assert other.episode.info["policy"] == "stand_still"


def test_a_policy_may_be_any_function(episode: Recording) -> None:
    seen: list[int] = []

    def watcher(view: Any, spec: Any) -> Any:
        seen.append(view.step)
        return POLICIES["stand_still"](view, spec)

    resume(episode, 140, policy=watcher)
    assert seen == list(range(140, 150))


def test_what_a_crash_left_can_be_continued() -> None:
    whole = simulated(5, told=True)
    known = {k: v for k, v in whole.episode.info.items() if k not in ("ended", "oracle_min_steps")}
    goals = known["human_goals"][:GOALS]  # all that is known before the first step
    part = replace(
        whole,
        columns={n: a[:70] for n, a in whole.columns.items()},
        events=(),
        skills=(),
        episode=replace(whole.episode, info={**known, "human_goals": goals}),
    )
    again = resume(part, 70)
    assert {n: a.tobytes() for n, a in again.columns.items()} == {n: a.tobytes() for n, a in whole.columns.items()}


def test_nothing_follows_steps_that_do_not_come_out_again(episode: Recording) -> None:
    broken = changed(episode, "agent_0.base_pose", 10, 0.0)
    resume(broken, 10)
    with pytest.raises(InputError, match=r"(?s)step 10, agent_0\.base_pose.*H3-TASK-034"):
        resume(broken, 11)


# --- counterfactual ---------------------------------------------------------------------------------------------------
def test_the_person_keeps_her_track_and_it_says_so(episode: Recording) -> None:
    other = counterfactual(episode, "random", step=20)
    rows = len(other)
    for name in (n for n in episode.columns if n.startswith(("agent_1.", "sim."))):
        assert other.columns[name].tobytes() == episode.columns[name][:rows].tobytes()
    np.testing.assert_array_equal(other.columns["agent_0.action"][:20], episode.columns["agent_0.action"][:20])
    assert not np.array_equal(other.columns["agent_0.action"][20:], episode.columns["agent_0.action"][20:rows])
    assert other.episode.info["human_reactive"] is False
    assert other.episode.info["counterfactual"] == {
        "uid": episode.episode.uid,
        "step": 20,
        "policy": "rollout_expert",
    }
    np.testing.assert_array_equal(state_hash(other.columns), other.columns["state_hash"])
    assert verify(other).equal


def test_a_track_from_elsewhere_is_kept_too(episode: Recording) -> None:
    """Somebody who walks where no script sends them: the recorded track is all that counts."""
    base = episode.columns["agent_1.base_pose"].copy()
    base[:, 0] += 0.05 * np.sin(np.arange(len(base)) / 10).astype(np.float32)
    elsewhere = replace(episode, columns={**episode.columns, "agent_1.base_pose": base})
    assert not verify(elsewhere).equal
    other = counterfactual(elsewhere, "rollout_expert")
    np.testing.assert_array_equal(other.columns["agent_1.base_pose"], base[: len(other)])
    assert verify(other).equal
    assert recordings_equal(resume(other, 40), other) != []  # another uid
    assert resume(other, 40).columns["state_hash"][-1] == other.columns["state_hash"][-1]


# --- hostile ----------------------------------------------------------------------------------------------------------
def with_info(**values: Any) -> Callable[[Recording], Recording]:
    return lambda r: replace(r, episode=replace(r.episode, info={**r.episode.info, **values}))


def without(name: str) -> Callable[[Recording], Recording]:
    return lambda r: replace(r, columns={n: a for n, a in r.columns.items() if n != name})


HOSTILE: dict[str, Callable[[Recording], Recording]] = {
    "another task": lambda r: replace(r, episode=replace(r.episode, task="gfx_replay")),
    "no scene": lambda r: replace(r, attachments={}),
    "a scene that is none": lambda r: replace(r, attachments={"scene.glb": b"glTF\x02\x00\x00\x00"}),
    "no action": without("agent_0.action"),
    "no skill": without("agent_0.skill"),
    "NaN action": lambda r: changed(r, "agent_0.action", 3, np.nan),
    "unknown skill": lambda r: changed(r, "agent_0.skill", 3, 99),
    "one agent": lambda r: replace(r, agents=r.agents[:1]),
    "a robot of another name": lambda r: replace(r, agents=(replace(r.agents[0], model="robot/../x"), r.agents[1])),
    "rules of another kind": with_info(spec=[1, 2]),
    "rules with words": with_info(spec={"max_steps": "many"}),
    "endless rules": with_info(spec={"max_steps": 10**15}),
    "starts with words": with_info(robot_start=["a", 0, 0]),
    "starts in nowhere": with_info(human_start=[float("nan"), 0.0, 0.0]),
    "starts in a wall": with_info(human_start=[1e6, 0.0, 0.0]),
    "goals of another kind": with_info(human_goals={"x": 1}),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_cannot_be_simulated_is_refused(episode: Recording, name: str) -> None:
    broken = HOSTILE[name](episode)
    for job in (verify, lambda r: resume(r, 5), lambda r: counterfactual(r, "random", step=5)):
        with pytest.raises(H3DataError):
            job(broken)


def test_a_track_that_is_no_clip_is_refused(episode: Recording) -> None:
    for broken in (
        without("agent_1.motion_id")(episode),
        changed(episode, "agent_1.motion_id", 3, 10_000),
        changed(episode, "agent_1.base_pose", 3, np.nan),
        replace(episode, columns={n: a[:0] for n, a in episode.columns.items()}, events=(), skills=()),
    ):
        with pytest.raises(InputError):
            counterfactual(broken, "random")
    for step in (-1, 151):
        with pytest.raises(InputError, match=r"(?s)0.*150.*H3-TASK-035"):
            resume(episode, step)
    with pytest.raises(InputError, match=r"(?s)policy=.*H3-TASK-040"):
        resume(with_info(policy="learned")(episode), 5)


def test_an_empty_recording_has_nothing_to_differ_in(episode: Recording) -> None:
    empty = replace(episode, columns={n: a[:0] for n, a in episode.columns.items()}, events=(), skills=())
    assert verify(empty).equal
    assert len(resume(empty, 0)) == len(episode)


# --- command ----------------------------------------------------------------------------------------------------------
def test_the_command(episode: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole, folder = tmp_path / "in" / "a.mcap", tmp_path / "in"
    write_mcap(episode, whole)
    write_mcap(changed(episode, "agent_0.base_pose", 12, 0.0), folder / "b.mcap")
    assert run_json(capsys, "replay", whole, "--verify")["episodes"][0]["equal"] is True
    found = run_json(capsys, "replay", folder, "--verify", code=1)
    assert (found["recordings"], found["equal"]) == (2, 1)
    assert found["episodes"][1]["difference"]["step"] == 12
    out = tmp_path / "again.mcap"
    assert run_json(capsys, "replay", whole, "--resume-from", "30", "-o", out)["steps"] == len(episode)
    assert "--force" in run_json(capsys, "replay", whole, "--resume-from", "30", "-o", out, code=2)["error"]
    made = run_json(capsys, "replay", whole, "--counterfactual", "--policy", "random", "-o", out, "--force")
    assert made["human_reactive"] is False
    assert run_json(capsys, "replay", out, "--verify")["equal"] == 1


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["--verify", "--resume-from", "3"],
        ["--verify", "--policy", "random"],
        ["--resume-from", "3"],
        ["--resume-from", "3", "-o", "x.txt"],
        ["--counterfactual", "-o", "x.mcap"],
        ["--resume-from", "3", "--policy", "none_such", "-o", "x.mcap"],
    ],
)
def test_options_that_do_not_go_together(
    arguments: list[str],
    episode: Recording,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    write_mcap(episode, tmp_path / "a.mcap")
    assert run_json(capsys, "replay", "a.mcap", *arguments, code=2)["error"]
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


# --- policies that remember -------------------------------------------------------------------------------------------
class Remembering:
    """A robot whose memory is all that it has seen, and which holds each action for seven steps. It counts its calls."""

    calls = 0

    def __init__(self) -> None:
        self.memory, self.action = 0.0, (0.0, 0.0)

    def act(self, view: Any) -> Any:
        type(self).calls += 1
        self.memory = 0.9 * self.memory + float(np.sum(view.robot_xz)) + float(np.sum(view.human_xz))
        if view.step % 7 == 0:
            self.action = (0.5 + 0.5 * float(np.sin(self.memory)), float(np.cos(self.memory)))
        return Velocity(*self.action, "find")


def remembering(task: Any, episode: Any, number: int) -> Any:
    """What a plug-in offers: a fresh policy for each agent of each episode."""
    return Remembering()


def remembering_function(task: Any, episode: Any, number: int) -> Any:
    """The same where what is made is a function of the view and of the robot's base, with a memory in it."""
    policy = Remembering()
    return FunctionPolicy(lambda view, spec: policy.act(view), episode.spec.robot)


@pytest.mark.parametrize("made", ["remembering", "remembering_function"])
@pytest.mark.parametrize("step", [28, 31, 60])
def test_a_policy_that_remembers_goes_on_as_if_nothing_had_happened(made: str, step: int) -> None:
    name = f"{__name__}:{made}"
    recording = simulated(5, policy=name, steps=60)
    cases: list[dict[str, Any]] = [{}, {"policy": name}, {"agents": {"robot": name}}]
    for options in cases:
        again = resume(recording, step, **options)
        assert again.columns["agent_0.action"].tobytes() == recording.columns["agent_0.action"].tobytes()
        assert again.columns["state_hash"].tobytes() == recording.columns["state_hash"].tobytes()


def test_whoever_takes_over_remembers_since_then() -> None:
    name = f"{__name__}:remembering"
    other = resume(simulated(5, steps=60), 20, policy=name)
    assert other.episode.info["deciding_since"] == [20, 0]
    again = resume(other, 45)
    assert again.columns["state_hash"].tobytes() == other.columns["state_hash"].tobytes()
    assert again.episode.info["deciding_since"] == [20, 0]


@pytest.mark.parametrize("made", ["remembering", "remembering_function"])
def test_verifying_asks_no_policy_for_what_is_recorded(made: str, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = simulated(5, policy=f"{__name__}:{made}", steps=60)
    monkeypatch.setattr(Remembering, "calls", 0)
    assert verify(recording).equal
    assert Remembering.calls == 0

    def gone(*_: Any) -> Any:
        raise ConnectionRefusedError("its server is gone")

    monkeypatch.setattr(f"{__name__}.{made}", gone)
    assert verify(recording).equal


def test_a_network_that_takes_over_between_two_decisions_decides_at_once() -> None:
    hold = network_of("end_to_end").card.hold
    other = resume(simulated(5, steps=40), 8 * hold + 1, policy="end_to_end")
    assert hold > 1
    assert np.abs(other.columns["agent_0.action"][8 * hold + 1 : 9 * hold]).max() > 0
    assert resume(other, 38).columns["state_hash"].tobytes() == other.columns["state_hash"].tobytes()
