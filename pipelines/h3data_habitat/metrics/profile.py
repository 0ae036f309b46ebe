"""Profiles ``habitat`` and ``habitat@0.3.0``: the values that habitat-lab would have printed for a recording.

Row 0 of the recording stands for Habitat's reset, which it counts as step 1. The arithmetic is in
`h3data_habitat.metrics.stats` and `h3data_habitat.metrics.reward`; tests/metrics/test_habitat.py compares it with outputs of
habitat-lab.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import pose_to_matrix
from h3data.metrics.episode import Notes, first_moments
from h3data.metrics.habitat_settings import HabitatConfig
from h3data.metrics.metric import INF, Metric, Series
from h3data.metrics.paper.profiles import SOCIAL_NAV_PROFILE
from h3data.metrics.profile import Computed, Profile
from h3data.metrics.report_layout import Milestone, ReportLayout
from h3data.metrics.requirements import find_agents, note_missing
from h3data.recording.records import Recording
from h3data_habitat.metrics.definitions import MAIN_METRICS, PAPER_RELEASE_METRICS, TRANSFORM
from h3data_habitat.metrics.reward import (
    MAIN,
    PAPER_RELEASE,
    TaskTrack,
    seek_success,
    social_nav_reward,
    total_reward,
)
from h3data_habitat.metrics.settings import config_of
from h3data_habitat.metrics.stats import HabitatTrack, backup_and_yield, social_nav_stats

STILL_M = 1e-3 / 30
"""Dead zone of backing up [m per step] where Habitat's own transforms are not recorded."""
_ORACLE_RATE = {MAIN: "60", PAPER_RELEASE: "120"}
"""Rate [Hz] at which each variant integrates its oracle: the key of ``info["habitat_min_steps"]``."""


def compute_habitat(recording: Recording, notes: Notes, *, metrics: tuple[Metric, ...], variant: str) -> Computed:
    """Compute the final values of Habitat's measures and the sums of its rewards."""
    robot, human = find_agents(recording)
    missing = note_missing(metrics, recording, notes)
    names = [m.name for m in metrics]
    if not len(recording):
        notes.add(names, "the recording has no rows")
        return Computed(values={}, robot=robot, human=human)
    series = habitat_series(recording, variant=variant)
    values = {name: value for name in names if name not in missing and (value := _final(name, series)) is not None}
    _explain_gaps(recording, series, variant, notes)
    return Computed(values=values, robot=robot, human=human, moments=first_moments(series, ("found", "collision")))


def habitat_series(recording: Recording, *, variant: str) -> Series:
    """Compute every key of ``SocialNavStats`` as emitted at every row [T], the rewards, and the flags behind them."""
    robot, human = find_agents(recording)
    columns = recording.columns
    config = config_of(recording.episode.info)
    track = _track(recording, robot, human)
    # our float32 poses are not Habitat's transforms, and for a standing robot rounding decides the sign
    dead_zone = 0.0 if TRANSFORM in columns else STILL_M
    backs_up, yields = backup_and_yield(track, config.stats, dead_zone_m=dead_zone)
    in_reach, faces = track.found(config.stats)
    found = in_reach & faces
    shortest = _min_steps(recording, variant)
    stats = social_nav_stats(track, config.stats, found=found, min_steps=shortest, backs_up=backs_up, yields=yields)
    series: dict[str, NDArray] = {
        **stats,
        "dist_m": track.distance().astype(np.float64),
        "geodesic_m": np.asarray(track.geodesic, np.float64),
        "facing_dot": track.facing().astype(np.float64),
        "in_reach": in_reach,
        "facing": faces,
        "found": found,
        "near": track.distance() <= config.stats.dis_threshold_for_backup_yield,
        "backs_up": backs_up,
        "yields": yields,
    }
    if "metrics.collision" in columns:
        series["collision"] = columns["metrics.collision"].astype(np.bool_)
    return series | _rewards(recording, track, stats["has_found_human"] > 0, config, variant)


def _rewards(
    recording: Recording, track: HabitatTrack, has_found: NDArray[np.bool_], config: HabitatConfig, variant: str
) -> dict[str, NDArray]:
    columns, goal = recording.columns, recording.episode.info.get("habitat_goal_pos")
    none = np.zeros(len(recording), np.bool_)
    task = TaskTrack(
        collides=columns.get("metrics.collision", none).astype(np.bool_),
        collisions=columns.get("metrics.total_collisions", none).astype(np.int64),
        has_found=has_found,
        goal_pos=None if goal is None else np.asarray(goal, np.float64),
    )
    reward = social_nav_reward(track, task, config.reward, variant=variant)
    try:
        followed, success = seek_success(track, task, config.success, variant=variant)
    # the settings ask for the goal of the task, which is not recorded
    except ValueError:
        return {"social_nav_reward": reward}
    total = total_reward(reward, success, config)
    return {"social_nav_reward": reward, "followed_steps": followed, "success": success, "reward": total}


def _final(name: str, series: Series) -> float | None:
    """Return the value of a metric whose columns are recorded; None where the settings need data that is not."""
    if name == "num_agents_collide":
        return float(np.sum(series["collision"]))
    key = {"nav_seek_success": "success"}.get(name, name)
    if key not in series:
        return None
    return float(np.sum(series[key]) if name in ("social_nav_reward", "reward") else series[key][-1])


def _track(recording: Recording, robot: int, human: int) -> HabitatTrack:
    pose = recording.agent_column(robot, "base_pose").astype(np.float32)
    stored = recording.columns.get(TRANSFORM)
    if stored is None:
        stored = pose_to_matrix(pose.astype(np.float64))
    return HabitatTrack(
        robot_pos=pose[:, :3],
        human_pos=recording.agent_column(human, "base_pose")[:, :3].astype(np.float32),
        robot_transform=np.asarray(stored, np.float32),
        geodesic=recording.columns.get("metrics.geodesic_agents", np.full(len(pose), np.nan)),
    )


def _min_steps(recording: Recording, variant: str) -> float:
    stored = recording.episode.info.get("habitat_min_steps")
    value = stored.get(_ORACLE_RATE[variant]) if isinstance(stored, Mapping) else None
    return INF if value is None else float(value)


def _explain_gaps(recording: Recording, series: Series, variant: str, notes: Notes) -> None:
    columns = recording.columns
    if np.isinf(_min_steps(recording, variant)):
        rate = _ORACLE_RATE[variant]
        text = f"l is infinite: info habitat_min_steps has no {rate!r} (Habitat's default computes no shortest paths)"
        names = (
            "first_encounter_spl",
            "frist_ecnounter_steps_ratio",
            "follow_human_steps_ratio_after_frist_encounter",
        )
        notes.add(names, text)
    if TRANSFORM not in columns:
        text = f"no column {TRANSFORM}: motions below 1 mm/s are not backing up (Habitat: by rounding)"
        notes.add(("backup_ratio", "yield_ratio"), text)
    if "metrics.total_collisions" not in columns and variant == MAIN:
        text = "no column metrics.total_collisions: collisions with the home are not counted"
        notes.add(("social_nav_reward", "reward"), text)
    if "success" not in series:
        notes.add(
            ("nav_seek_success", "reward"), "needs info habitat_goal_pos: the settings measure to the task's goal"
        )
    if np.isnan(series["dist_m"]).any():
        notes.add(("avg_robot_to_human_dis_over_epi",), "a row has no pose")


_REPORT = ReportLayout(
    title="Social navigation, as habitat-lab computes it",
    findings={
        "has_found_human": "finds the person in",
        "found_human_rate_over_epi": "follows at a found rate of",
        "nav_seek_success": "succeeds in",
    },
    ranking=("found_human_rate_over_epi", "has_found_human"),
    milestones=(
        Milestone(flag="found", title="Person found by then", label="finds the person", metric="has_found_human"),
        Milestone(flag="collision", title="Person touched by then", label="first contact", metric="num_agents_collide"),
    ),
    distance_zone_m=(1.0, 2.0),
)


def _profile(name: str, title: str, metrics: tuple[Metric, ...]) -> Profile:
    return Profile(
        name=name,
        title=title,
        tasks=SOCIAL_NAV_PROFILE.tasks,
        metrics=metrics,
        compute=functools.partial(compute_habitat, metrics=metrics, variant=name),
        series=functools.partial(habitat_series, variant=name),
        report=_REPORT,
    )


MAIN_PROFILE = _profile(MAIN, "habitat-lab's main branch, bug for bug", MAIN_METRICS)
PAPER_RELEASE_PROFILE = _profile(
    PAPER_RELEASE, "habitat-lab 0.3.0, the paper's release, where it differs", PAPER_RELEASE_METRICS
)
