"""The habitat profiles against outputs of the real habitat-lab, step by step, and the cases that no golden file holds."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from h3data.errors import InputError
from h3data.geometry import ground_pose
from h3data.metrics import MissingColumnsError, measure, series_of
from h3data.metrics.habitat_settings import StatsConfig
from h3data.recording.records import STEP_NS, Agent, Episode, Recording
from h3data_habitat.metrics.profile import STILL_M
from h3data_habitat.metrics.reward import goal_errors
from h3data_habitat.metrics.settings import config_of
from h3data_habitat.metrics.stats import HabitatTrack, _found_step, social_nav_stats
from tests.paths import REFERENCE

FOLDER = REFERENCE / "socialnav"
FILES = sorted(FOLDER.glob("[0-9]*.npz"))
golden = pytest.mark.skipif(not FILES, reason=f"real habitat-lab reference files are not on this machine: {FOLDER}")


def load(path: Path) -> tuple[Recording, dict[str, np.ndarray], list[str]]:
    """A recording with all that Habitat's measures read, the real outputs, and the names of its statistics."""
    with np.load(path) as file:
        data = dict(file)
    said = json.loads(path.with_suffix(".json").read_text())

    def pose(who: str) -> np.ndarray:
        at = data[f"{who}_base_pos_f32"]
        pose = ground_pose(at[:, [0, 2]], data[f"in_{who}_yaw"], at[:, 1]).astype(np.float32)
        pose[:, :3] = at
        return pose

    config = {
        "social_nav_stats": said["social_nav_stats_config"],
        "social_nav_reward": said["social_nav_reward_config"],
        "nav_seek_success": said["nav_seek_success_config"],
        "slack_reward": said["slack_reward"],
        "success_reward": said["success_reward"],
    }
    oracle = data["min_step"][-1]
    shortest = {"60": int(oracle), "120": int(oracle)} if np.isfinite(oracle) else {}
    config = {k: strip(v) if isinstance(v, dict) else v for k, v in config.items()}
    info = {
        "habitat_config": config,
        "habitat_goal_pos": data["nav_goal_pos"].tolist(),
        "habitat_min_steps": shortest,
    }
    recording = Recording(
        episode=Episode(uid=path.stem, episode_id=path.stem, task="social_nav", scene="flat", info=info),
        agents=(Agent(name="robot", kind="robot"), Agent(name="human", kind="human")),
        columns={
            "time_ns": np.arange(len(data["geodesic"])) * STEP_NS,
            "agent_0.base_pose": pose("robot"),
            "agent_1.base_pose": pose("human"),
            "metrics.collision": data["in_did_collide"],
            "metrics.total_collisions": data["in_total_collisions"],
            "metrics.geodesic_agents": data["geodesic"],
            "habitat.robot_transform": data["robot_sim_obj_T"],
        },
    )
    return recording, data, said["stats_columns"]


def strip(section: dict) -> dict:
    return {k: v for k, v in section.items() if k != "type"}


@golden
@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_every_key_at_every_step_equals_the_real_code(path):
    recording, data, names = load(path)
    series = series_of(recording, "habitat")
    for i, name in enumerate(names):
        np.testing.assert_array_equal(series[name], data["stats"][:, i], err_msg=name)
    np.testing.assert_array_equal(series["followed_steps"], data["following_step"])
    np.testing.assert_array_equal(series["success"], data["seek_success"])
    np.testing.assert_allclose(series["social_nav_reward"], data["reward_measure"], rtol=0, atol=1e-6)
    # Habitat adds in float32: half a unit in the last place of 14.9, on top of the reward's own 1e-6.
    np.testing.assert_allclose(series["reward"], data["rl_reward"], rtol=0, atol=2e-6)


@golden
@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_the_table_holds_what_habitat_prints_at_the_end(path):
    recording, data, names = load(path)
    values = measure(recording, "habitat").values
    for i, name in enumerate(names):
        assert values[name] == data["stats"][-1, i]
        assert np.signbit(values[name]) == np.signbit(data["stats"][-1, i]), "F is -0.0 while l is infinite"
    assert values["num_agents_collide"] == data["num_agents_collide"][-1]
    assert values["nav_seek_success"] == data["seek_success"][-1]
    assert values["social_nav_reward"] == pytest.approx(data["reward_measure"].sum(), abs=1e-4)
    assert values["reward"] == pytest.approx(data["rl_reward"].sum(), abs=1e-4)


@golden
@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_distances_to_the_goal(path):
    _, data, _ = load(path)
    track = HabitatTrack(
        robot_pos=data["robot_base_pos_f32"],
        human_pos=data["human_base_pos_f32"],
        robot_transform=data["robot_sim_obj_T"],
        geodesic=data["geodesic"],
    )
    distance, angle = goal_errors(track, data["nav_goal_pos"])
    np.testing.assert_allclose(distance, data["dist_to_goal"], atol=1e-9)
    cosine = np.cos(data["rot_dist_to_goal"])  # float32, which arccos would magnify near 0 and pi
    np.testing.assert_allclose(np.cos(angle), cosine, rtol=0, atol=3e-6)


@golden
@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_without_its_transforms_the_sum_of_backup_and_yield_is_still_right(path):
    recording, data, names = load(path)
    columns = {k: v for k, v in recording.columns.items() if k != "habitat.robot_transform"}
    clean = measure(dataclasses.replace(recording, columns=columns), "habitat")
    both = data["stats"][-1, names.index("backup_ratio")] + data["stats"][-1, names.index("yield_ratio")]
    assert clean.values["backup_ratio"] + clean.values["yield_ratio"] == pytest.approx(both, abs=1e-12)
    assert "rounding" in clean.notes["backup_ratio"]


@golden
def test_the_files_hold_every_case():
    """Guards the tests above."""
    data = [load(path)[1] for path in FILES]
    names = load(FILES[0])[2]
    last = {name: {d["stats"][-1, i] for d in data} for i, name in enumerate(names)}
    assert last["has_found_human"] == {0.0, 1.0}
    assert any(v > 0 for v in last["first_encounter_spl"])
    assert any(v < 0.3 and v > 0 for v in last["backup_ratio"])
    assert any(d["in_did_collide"].any() for d in data)
    assert any(d["in_total_collisions"].any() for d in data)
    assert any(d["seek_success"].any() for d in data)


# --- what no golden file holds ----------------------------------------------------------------------------------------
def still(steps: int, gap: float = 1.5, *, info: dict | None = None, **columns) -> Recording:
    """A robot that stands ``gap`` metres from a human and faces them."""
    robot = ground_pose(np.zeros((steps, 2)), np.zeros(steps)).astype(np.float32)
    human = ground_pose(np.full((steps, 2), [gap, 0.0]), np.zeros(steps)).astype(np.float32)
    return Recording(
        episode=Episode(uid="u", episode_id="e", task="social_nav", scene="none", info=info or {}),
        agents=(Agent(name="robot", kind="robot"), Agent(name="human", kind="human")),
        columns={
            "time_ns": np.arange(steps) * STEP_NS,
            "agent_0.base_pose": robot,
            "agent_1.base_pose": human,
            "metrics.geodesic_agents": np.full(steps, gap, np.float32),
            "metrics.collision": np.zeros(steps, np.bool_),
            **columns,
        },
    )


def test_success_pays_again_in_every_later_step():
    config = {"nav_seek_success": {"following_step_succ_threshold": 3}, "social_nav_reward": {"facing_human_reward": 0}}
    rewards = series_of(still(6, info={"habitat_config": config}), "habitat")["reward"]
    np.testing.assert_allclose(rewards, [-0.1, 1.9, 11.9, 11.9, 11.9, 11.9], atol=1e-6)


def test_the_paper_release_needs_facing_to_be_asked_for_and_knows_no_collisions():
    config = {"nav_seek_success": {"following_step_succ_threshold": 3, "need_to_face_human": False}}
    recording = still(6, info={"habitat_config": config}, **{"metrics.collision": np.ones(6, np.bool_)})
    main, release = measure(recording, "habitat"), measure(recording, "habitat@0.3.0")
    assert (main.values["nav_seek_success"], release.values["nav_seek_success"]) == (1, 0)
    assert main.values["social_nav_reward"] == pytest.approx(release.values["social_nav_reward"] - 6 * 1.0)
    assert release.profile == "habitat@0.3.0"


def test_each_release_has_its_own_oracle():
    recording = still(10, info={"habitat_min_steps": {"60": 2, "120": 4}})
    assert measure(recording, "habitat").values["follow_human_steps_ratio_after_frist_encounter"] == 10 / 1498
    assert measure(recording, "habitat@0.3.0").values["follow_human_steps_ratio_after_frist_encounter"] == 10 / 1496
    never = measure(still(10), "habitat")
    assert never.values["first_encounter_spl"] == 0
    assert "computes no shortest paths" in never.notes["first_encounter_spl"]


def test_found_at_step_1500_moves_on_by_one():
    has_found = np.arange(1, 1504) >= 1500
    got = _found_step(has_found, np.arange(1, 1504))
    assert got[1498:1502].tolist() == [1500, 1500, 1501, 1501]
    assert _found_step(np.arange(1, 10) >= 4, np.arange(1, 10)).tolist() == [1500] * 3 + [4] * 6


def test_an_oracle_of_1500_steps_divides_by_zero():
    track = HabitatTrack(
        robot_pos=np.zeros((1501, 3), np.float32),
        human_pos=np.full((1501, 3), [1.5, 0, 0], np.float32),
        robot_transform=np.tile(np.eye(4, dtype=np.float32), (1501, 1, 1)),
        geodesic=np.full(1501, 1.5),
    )
    never = np.zeros(1501, np.bool_)
    stats = social_nav_stats(track, StatsConfig(), found=~never, min_steps=1500, backs_up=never, yields=never)
    ratio = stats["follow_human_steps_ratio_after_frist_encounter"]
    assert np.isnan(ratio[1499:]).all()
    assert not np.isnan(ratio[:1499]).any()


def test_what_is_missing_is_named():
    recording = still(4)
    columns = {k: v for k, v in recording.columns.items() if k != "metrics.collision"}
    part = measure(dataclasses.replace(recording, columns=columns), "habitat")
    assert np.isnan(part.values["num_agents_collide"])
    assert np.isnan(part.values["reward"])
    assert "metrics.collision" in part.notes["reward"]
    assert part.values["has_found_human"] == 1
    nothing = measure(still(0), "habitat")
    assert all(np.isnan(v) for v in nothing.values.values())
    planar = measure(still(4, info={"habitat_config": {"nav_seek_success": {"use_geo_distance": False}}}), "habitat")
    assert np.isnan(planar.values["nav_seek_success"])
    assert "habitat_goal_pos" in planar.notes["nav_seek_success"]


@pytest.mark.parametrize("config", ["fast", {"social_nav_stats": 3}, {"social_nav_reward": {"safe_dis_min": "near"}}])
def test_settings_that_are_none_are_refused(config):
    with pytest.raises(InputError, match=r"(?s)habitat_config.*H3-METRIC-01(0|1|2)"):
        measure(still(3, info={"habitat_config": config}), "habitat")


def test_settings_are_read_by_their_own_names():
    config = config_of({"habitat_config": {"social_nav_stats": {"max_dis_human": 3, "type": "X"}}})
    assert config.stats.max_dis_human == 3.0
    assert config.reward.facing_human_reward == 3.0
    assert measure(still(3, 2.5), "habitat").values["has_found_human"] == 0
    far = still(3, 2.5, info={"habitat_config": {"social_nav_stats": {"max_dis_human": 3}}})
    assert measure(far, "habitat").values["has_found_human"] == 1


def test_a_standing_robot_yields_without_recorded_transforms():
    values = measure(still(8, 1.2), "habitat").values
    assert (values["backup_ratio"], values["yield_ratio"]) == (0, 1)
    assert pytest.approx(3.3e-5, rel=0.02) == STILL_M


def test_missing_columns_error_names_metric_and_column():
    error = MissingColumnsError("e7", {"RC": ("metrics.at_goal",)})
    assert error.needs == {"RC": ("metrics.at_goal",)}
    assert "RC needs metrics.at_goal" in str(error)
