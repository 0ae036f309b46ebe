"""Rewards: those of the real habitat-lab step by step, and the published formulas."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from h3data.errors import InputError
from h3data.metrics.habitat_settings import HabitatConfig
from h3data_habitat.metrics.settings import config_of as read_config
from sim_kinematic.motion.state import NOBODY
from sim_kinematic.tasks.rules.predicates import is_object_at
from sim_kinematic.tasks.rules.rewards import (
    REARRANGE_REWARDS,
    Encounter,
    PaperReward,
    RearrangeReward,
    SocialNavReward,
)
from sim_kinematic.tasks.skills.household import _reached
from tests.paths import REAL

GOLDEN = REAL / "habitat-lab" / "reference"
FILES = sorted((GOLDEN / "socialnav").glob("[0-9]*.npz"))
needs_real = pytest.mark.skipif(not FILES, reason="needs the real Habitat files in ../shared/real")


def config_of(path: Path) -> HabitatConfig:
    said = json.loads(path.with_suffix(".json").read_text())
    sections = {
        "social_nav_stats": said["social_nav_stats_config"],
        "social_nav_reward": said["social_nav_reward_config"],
        "nav_seek_success": said["nav_seek_success_config"],
    }
    told = {name: {k: v for k, v in section.items() if k != "type"} for name, section in sections.items()}
    told |= {"slack_reward": said["slack_reward"], "success_reward": said["success_reward"]}
    return read_config({"habitat_config": told})


@needs_real
@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_every_step_pays_what_habitat_pays(path: Path) -> None:
    """Twice at once: the second world lags a step behind, so that it is reset while the first goes on."""
    data = dict(np.load(path))
    reward = SocialNavReward(2, profile="habitat", habitat=config_of(path))
    steps = len(data["geodesic"])

    def seen(k: int) -> Encounter:
        rows = [k, max(k - 1, 0)]
        return Encounter(
            robot_xz=data["robot_base_pos_f32"][rows][:, [0, 2]],
            robot_heading=data["in_robot_yaw"][rows],
            human_xz=data["human_base_pos_f32"][rows][:, [0, 2]],
            geodesic=data["geodesic"][rows],
            collides=data["in_did_collide"][rows],
            collisions=data["in_total_collisions"][rows],
            goal_xz=np.tile(data["nav_goal_pos"][[0, 2]], (2, 1)),
        )

    first = reward.reset(seen(0))
    rows = [first.reward[0]]
    for k in range(1, steps):
        if k == 1:
            step = reward.step(seen(k))
            late = reward.reset(seen(k), where=[False, True])
            assert late.reward[0] == 0
        else:
            step = reward.step(seen(k))
            assert step.reward[1] == pytest.approx(rows[-1], abs=1e-12)
        rows.append(step.reward[0])
        assert step.success[0] == data["seek_success"][k], k
    # Habitat adds in float32: half a unit in the last place of 14.9, on top of the reward's own 1e-6
    np.testing.assert_allclose(rows, data["rl_reward"], rtol=0, atol=4e-6)
    assert reward.followed[0] == data["following_step"][-1]


@needs_real
def test_cooperation_pays_what_habitat_pays() -> None:
    for case in json.loads((GOLDEN / "rearrange" / "cooperate_reward.json").read_text()):
        pays, costs = case["stage_sparse_reward"], case["collide_penalty"]
        spec, ended = RearrangeReward(stage=pays, collision=costs, slack=0.0, success=0.0), False
        paid = np.zeros((1, 4), np.bool_)
        for k, truth in enumerate(case["stage_truth"]):
            hit = case["did_collide"][k]
            ended |= hit
            stages = np.array([list(truth.values())], np.bool_)
            reward, paid, _ = spec.step(stages[:, :2], stages[:, 2:], paid, np.array([float(hit)]))
            assert reward[0] == case["reward"][k]
            assert ended == case["should_end"][k]


def meeting(distance: float, *, turned: float = 0.0, collides: bool = False) -> Encounter:
    return Encounter([[0.0, 0.0]], [turned], [[distance, 0.0]], [distance], collides=[collides])


def test_the_papers_reward_by_hand() -> None:
    reward = SocialNavReward(1)
    assert not reward.reset(meeting(4.0)).reward.any()
    assert reward.step(meeting(3.5)).reward[0] == pytest.approx(0.5 - 0.1)  # nearer
    assert reward.step(meeting(3.6)).reward[0] == pytest.approx(-0.1 - 0.1)  # farther
    assert reward.step(meeting(3.0)).reward[0] == pytest.approx(0.6 + 3 - 0.1)  # 3 m away, and facing the person
    assert reward.step(meeting(2.0)).reward[0] == pytest.approx(2 + 3 - 0.1)
    assert reward.step(meeting(2.0, turned=np.pi)).reward[0] == pytest.approx(2 - 3 - 0.1)
    assert reward.step(meeting(1.0)).reward[0] == pytest.approx(-1 + 3 - 0.1)  # too near
    hit = reward.step(meeting(0.5, collides=True))
    assert hit.reward[0] == pytest.approx(-0.5 + 3 - 0.1)
    assert hit.ends[0]


def test_the_papers_bonus_is_paid_once() -> None:
    reward = SocialNavReward(1, paper=PaperReward(follow_steps=5))
    reward.reset(meeting(1.5))
    paid = [reward.step(meeting(1.5)) for _ in range(8)]
    assert [bool(p.success[0]) for p in paid] == [False] * 4 + [True] * 4
    assert [round(p.reward[0] - 4.9) for p in paid] == [0, 0, 0, 0, 10, 0, 0, 0]


def test_without_a_way_the_straight_distance_counts() -> None:
    reward = SocialNavReward(1)
    reward.reset(meeting(4.0)._replace(geodesic=[np.inf]))
    assert reward.step(meeting(3.8)._replace(geodesic=[np.inf])).reward[0] == pytest.approx(0.2 - 0.1)


def test_rearrangement_in_both_profiles() -> None:
    for profile, collision, slack in (("paper", 5.0, -0.005), ("habitat", 0.5, -0.0005)):
        spec, paid = REARRANGE_REWARDS[profile], np.zeros((2, 4), np.bool_)
        one, none, both = [True, False], [False, False], [True, True]
        first, paid, done = spec.step(np.array([one, none]), np.array([one, none]), paid, np.array([0.0, 1.0]))
        np.testing.assert_allclose(first, [10 + slack, slack - collision])
        assert not done.any()
        again, paid, done = spec.step(np.array([none, none]), np.array([both, none]), paid, np.zeros(2))
        np.testing.assert_allclose(again, [5 + 10 + slack, slack])
        assert done.tolist() == one
        assert paid.tolist() == [[True, False, True, True], [False] * 4]


def test_what_cannot_be_rewarded_is_refused() -> None:
    with pytest.raises(InputError, match=r"(?s)paper, habitat.*H3-TASK-041"):
        SocialNavReward(1, profile="galactic")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"(?s)\[3, 2\].*H3-TASK-042"):
        SocialNavReward(3).step(meeting(1.0))


def test_a_household_and_a_device_ask_one_rule_whether_objects_are_at_their_goals() -> None:
    rng = np.random.default_rng(3)
    goals = rng.normal(size=(500, 3))
    poses = np.concatenate([goals + rng.normal(size=(500, 3)) * 0.2, np.zeros((500, 4))], 1)
    held_by, at_goal = rng.integers(NOBODY, 2, 500), np.empty(500, np.bool_)
    _reached(poses, goals, held_by, 0.3, at_goal)
    near = is_object_at(poses[:, :3], goals)
    np.testing.assert_array_equal(at_goal, near & (held_by == NOBODY))
    assert 50 < near.sum() < 450
    torch = pytest.importorskip("torch")
    tensors = torch.from_numpy(poses[:, :3]), torch.from_numpy(goals)
    np.testing.assert_array_equal(is_object_at(*tensors, xp=torch).numpy(), near)
