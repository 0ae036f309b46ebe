"""Learned skills on the CPU: names and files, how they end, and that episodes with them are recorded and verified."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from h3data.errors import FormatError, InputError
from h3data.recording import Recording
from h3data_pipelines.cli import main
from h3data_pipelines.skill_judging import judge, play_of
from sim_kinematic.agents.robots.skills import RobotActor
from sim_kinematic.agents.skills import REASONS
from sim_kinematic.motion.spec import SkillSpec
from sim_kinematic.policies.skills.names import recorded_skills, skills_of
from sim_kinematic.policies.skills.player import NetworkSkill
from sim_kinematic.policies.visual_policy import PolicyCard, VisualPolicy, number_count, save_policy
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode, RearrangeSpec
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.resume import verify
from sim_kinematic.tasks.skills.skill_starts import SkillStart, draw_starts
from sim_kinematic.tasks.sources import EpisodeSource

SHOWN = {
    "skill_nav": ("target_gps_compass", "way"),
    "skill_pick": ("target_sensor", "arm_joints", "is_holding"),
    "skill_place": ("target_sensor", "resting_sensor"),
}


def constant(task: str, command: Any = None, **card: Any) -> VisualPolicy:
    """A policy that always does the same."""
    actions = 2 if task == "skill_nav" else 10
    command = np.zeros(actions) if command is None else np.asarray(command)
    numbers = number_count(SHOWN[task], actions)
    arrays = {
        "gru.weight_ih": np.zeros((12, numbers)),
        "gru.weight_hh": np.zeros((12, 4)),
        "gru.bias_ih": np.zeros(12),
        "gru.bias_hh": np.zeros(12),
        "act_0.weight": np.zeros((8, 4 + numbers)),
        "act_0.bias": np.zeros(8),
        "act_1.weight": np.zeros((actions, 8)),
        "act_1.bias": command,
    }
    about = {"task": task, "robot": "quad_arm", "observations": SHOWN[task], "picture_size": None, "hold": 3, **card}
    return VisualPolicy(
        card=PolicyCard(**{"actions": actions, **about}), arrays={n: a.astype(np.float32) for n, a in arrays.items()}
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three skills that turn on the spot, as training leaves them."""
    for task in SHOWN:
        run = tmp_path / "runs" / task
        run.mkdir(parents=True)
        turns = [0.0, 0.3] if task == "skill_nav" else [0.0, 0.3, *[0.0] * 7, 1.0]
        save_policy(constant(task, turns), run / "policy.npz")
    return tmp_path / "runs"


@pytest.fixture(scope="module")
def episode() -> RearrangeEpisode:
    found = EpisodeSource(Rearrange(), "small:1").sample(0, 0)
    assert isinstance(found, RearrangeEpisode)
    return found


def start_of(episode: RearrangeEpisode, skill: Any, **options: Any) -> SkillStart:
    return draw_starts(episode, skill, 1, np.random.default_rng(0), **options)[0]


# --- names and files ----------------------------------------------------------------------------------------------------
def test_names_carry_digests_and_mean_these_weights_only(folder: Path) -> None:
    names = recorded_skills(str(folder))
    assert names.count("@") == 3
    assert recorded_skills(names) == names
    assert set(skills_of(names)) == {"nav_to_object", "nav_to_goal", "pick", "place"}
    one = recorded_skills(str(folder / "skill_pick" / "policy.npz"))
    assert set(skills_of(one)) == {"pick"}
    save_policy(constant("skill_pick", [0.1] * 10), folder / "skill_pick" / "policy.npz")
    with pytest.raises(InputError, match="H3-POLICY-014"):
        skills_of(one, robot="quad_arm")
    assert RearrangeSpec(skills=str(folder)).skills != names
    assert RearrangeSpec().skills == ""


def test_the_folder_of_one_run_means_its_policy(folder: Path) -> None:
    run = folder / "skill_pick"
    np.savez(run / "starts.npz", starts=np.zeros(3))  # training keeps where its episodes begin there
    assert recorded_skills(str(run)) == recorded_skills(str(run / "policy.npz"))


def broken(path: Path, how: str) -> Path:
    if how == "truncated":
        path.write_bytes(path.read_bytes()[:700])
    elif how == "nan":
        with np.load(path) as data:
            arrays = {**dict(data), "act_1.bias": np.array([np.nan, 0.0], np.float32)}
        np.savez(path, **arrays)  # type: ignore[arg-type]
    elif how == "lift_arm":
        save_policy(constant("skill_nav", robot="lift_arm"), path)
    elif how == "social_nav":
        network = constant("skill_nav")
        save_policy(replace(network, card=_card(network, task="social_nav")), path)
    elif how == "outputs":
        network = constant("skill_nav")
        save_policy(replace(network, card=_card(network, task="skill_pick")), path)
    return path


def _card(network: VisualPolicy, **changes: Any) -> PolicyCard:
    import msgspec

    return msgspec.structs.replace(network.card, **changes)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("truncated", "H3-POLICY-030"),
        ("nan", r"(?s)act_1\.bias holds numbers that are not finite.*H3-POLICY-007"),
        ("social_nav", r"(?s)skill_nav, skill_pick, skill_place.*H3-POLICY-057"),
        ("outputs", r"(?s)2.*H3-POLICY-060"),
        ("missing", "H3-POLICY-029"),
    ],
)
def test_a_file_that_is_no_skill_is_refused_in_one_line(
    folder: Path, how: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = folder / "skill_nav" / "policy.npz"
    path = tmp_path / "none.npz" if how == "missing" else broken(path, how)
    with pytest.raises((InputError, FormatError), match=message):
        recorded_skills(str(path))
    options = ["generate", "rearrange", "--scenes", "small:1", "--episodes", "1"]
    assert main([*options, "--skills", str(path), "-o", str(tmp_path / "ds")]) == 2
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error")]
    assert len(said) == 1


def test_another_robot_and_the_same_skill_twice_are_refused(folder: Path, tmp_path: Path) -> None:
    path = broken(folder / "skill_nav" / "policy.npz", "lift_arm")
    with pytest.raises(FormatError, match=r"(?s)lift_arm.*quad_arm.*H3-POLICY-058"):
        skills_of(recorded_skills(str(path)), robot="quad_arm")
    with pytest.raises(InputError, match=r"(?s)nav_to_object.*H3-POLICY-056"):
        recorded_skills(f"{path},{path}")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="H3-POLICY-053"):
        recorded_skills(str(tmp_path / "empty"))


def test_other_tasks_have_no_skills(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["generate", "social_nav", "--skills", str(folder), "-o", str(tmp_path / "ds")]) == 2
    assert "no options of social_nav: --skills" in capsys.readouterr().err


# --- how they end -------------------------------------------------------------------------------------------------------
def test_one_that_does_not_get_there_times_out(episode: RearrangeEpisode) -> None:
    slow = NetworkSkill(constant("skill_nav"), rules=SkillSpec(nav_steps=7))
    result = judge(episode, start_of(episode, "nav"), {"nav_to_object": slow, "nav_to_goal": slow})
    assert (result.outcome, result.reason, result.steps) == ("failed", "timed_out", 7)
    assert result.reason in REASONS


def test_one_that_stands_before_its_target_has_arrived(episode: RearrangeEpisode) -> None:
    start = start_of(episode, "nav", path_m=(0.0, 1.0))
    gap = start.point[[0, 2]] - start.stand_xz
    there = replace(start, xz=start.stand_xz, heading=float(np.arctan2(-gap[1], gap[0])))
    still = NetworkSkill(constant("skill_nav"))
    result = judge(episode, there, {"nav_to_object": still, "nav_to_goal": still})
    assert (result.outcome, result.steps) == ("done", 1)


def test_an_object_in_the_hand_is_taken_kept_and_dropped(
    episode: RearrangeEpisode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(RobotActor, "open_stand", lambda robot, point: np.array([*robot.xz, robot.heading]))
    start = start_of(episode, "pick")
    hand = play_of(episode, start, {}).team.robots[0].hand_pose[:3]
    objects = start.objects.copy()
    objects[start.target] = hand + np.array([0.0, 0.05, 0.0])
    near = replace(start, objects=objects, point=objects[start.target])
    grips = NetworkSkill(constant("skill_pick", [0.0] * 9 + [1.0]))
    assert judge(episode, near, {"pick": grips})[:3] == ("done", "", 1)
    other = objects[[1, 0]]
    wrong = replace(near, objects=other, point=other[start.target])
    assert judge(episode, wrong, {"pick": grips}).reason in ("wrong_object", "out_of_reach")
    lets_go = NetworkSkill(constant("skill_place", [0.0] * 9 + [-1.0]))
    place = start_of(episode, "place")
    assert judge(episode, place, {"place": lets_go})[:3] == ("failed", "dropped", 1)
    at_hand = replace(place, point=play_of(episode, place, {}).team.robots[0].hand_pose[:3])
    goals = episode.targets[place.target]._replace(goal=at_hand.point)
    targets = tuple(goals if k == place.target else t for k, t in enumerate(episode.targets))
    assert judge(replace(episode, targets=targets), at_hand, {"place": lets_go}).outcome == "done"


# --- recorded, verified -------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory, episode: RearrangeEpisode) -> Recording:
    runs = tmp_path_factory.mktemp("runs")
    for task in SHOWN:
        turns = [0.5, 0.3] if task == "skill_nav" else [0.0, 0.3, *[0.1] * 7, 1.0]
        save_policy(constant(task, turns), runs / f"{task}.npz")
    played = replace(episode, spec=replace(episode.spec, skills=str(runs), max_steps=120))
    return simulate(Rearrange(), played, {"robot": "greedy_nearest", "human": "still"})


def test_a_recording_names_its_skills_and_is_verified(recorded: Recording) -> None:
    info = recorded.episode.info
    assert info["skills"].count("@") == 3
    assert info["spec"]["skills"] == info["skills"]
    assert verify(recorded).difference is None


def test_episodes_without_learned_skills_know_nothing_of_them(episode: RearrangeEpisode) -> None:
    short = replace(episode, spec=replace(episode.spec, max_steps=3))
    info = simulate(Rearrange(), short, {"robot": "still", "human": "still"}).episode.info
    assert "skills" not in info
    assert "skills" not in info["spec"]
