"""The profiles ``habitat`` and ``habitat@0.3.0``: what habitat-lab would have printed for a recording.

Row 0 of the recording stands for Habitat's reset, which it counts as step 1. The arithmetic is in
`h3data.metrics.habitat.stats` and `h3data.metrics.habitat.reward`; golden data: tests/metrics/test_habitat.py.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import pose_to_matrix
from h3data.metrics.habitat.config import HabitatConfig
from h3data.metrics.habitat.records import MAIN_METRICS, PAPER_RELEASE_METRICS, TRANSFORM
from h3data.metrics.habitat.reward import (
    MAIN,
    PAPER_RELEASE,
    TaskTrack,
    seek_success,
    social_nav_reward,
    total_reward,
)
from h3data.metrics.habitat.stats import HabitatTrack, backup_and_yield, social_nav_stats
from h3data.metrics.metric import (
    INF,
    NAN,
    EpisodeMetrics,
    Metric,
    Notes,
    Series,
    episode_metrics,
    find_agents,
    note_missing,
)
from h3data.recording.records import Recording

STILL_M = 1e-3 / 30
"""Dead zone of backing up [m per step] where Habitat's own transforms are not recorded."""
_ORACLE_RATE = {MAIN: "60", PAPER_RELEASE: "120"}


def habitat_metrics(variant: str = MAIN) -> tuple[Metric, ...]:
    """What Habitat's measures emit, by its own keys."""
    return MAIN_METRICS if variant == MAIN else PAPER_RELEASE_METRICS


def measure_habitat(recording: Recording, variant: str = MAIN) -> EpisodeMetrics:
    """The last values of Habitat's measures, and the sums of its rewards."""
    notes = Notes()
    metrics = habitat_metrics(variant)
    robot, human = find_agents(recording)
    lacking = note_missing(metrics, recording, notes)
    values = dict.fromkeys((m.name for m in metrics), NAN)
    series: Series = {}
    if len(recording):
        series = habitat_series(recording, variant)
        for name in values.keys() - lacking:
            values[name] = _final(name, series)
        _explain_gaps(recording, series, variant, notes)
    else:
        notes.add(values, "the recording has no rows")
    return episode_metrics(
        recording, metrics, values, notes, robot=robot, human=human,
        encounter_row=_first(series.get("found")), contact_row=_first(series.get("collision")),
    )  # fmt: skip


def habitat_series(recording: Recording, variant: str = MAIN) -> Series:
    """Every key of ``SocialNavStats`` as emitted at every row [T], the rewards, and the flags that they come from."""
    robot, human = find_agents(recording)
    columns = recording.columns
    config = HabitatConfig.from_info(recording.episode.info)
    track = _track(recording, robot, human)
    dead_zone = 0.0 if TRANSFORM in columns else STILL_M
    backs_up, yields = backup_and_yield(track, config.stats, dead_zone_m=dead_zone)
    shortest = _min_steps(recording, variant)
    stats = social_nav_stats(track, config.stats, min_steps=shortest, avoids=(backs_up, yields))
    facing = track.facing()
    with np.errstate(invalid="ignore"):
        in_reach = (track.geodesic >= config.stats.min_dis_human) & (track.geodesic <= config.stats.max_dis_human)
        faces = facing > config.stats.robot_face_human_threshold
    series: dict[str, NDArray] = {
        **stats,
        "dist_m": track.distance().astype(np.float64),
        "geodesic_m": np.asarray(track.geodesic, np.float64),
        "facing_dot": facing.astype(np.float64),
        "in_reach": in_reach,
        "facing": faces,
        "found": in_reach & faces,
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
    except ValueError:
        return {"social_nav_reward": reward}
    total = total_reward(reward, success, config)
    return {"social_nav_reward": reward, "followed_steps": followed, "success": success, "reward": total}


def _final(name: str, series: Series) -> float:
    """The value of a metric that the recording has what it needs for."""
    if name == "num_agents_collide":
        return float(np.sum(series["collision"]))
    if name == "nav_seek_success":
        return float(series["success"][-1]) if "success" in series else NAN
    if name in ("social_nav_reward", "reward"):
        return float(np.sum(series[name])) if name in series else NAN
    return float(series[name][-1])


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


def _first(flags: NDArray | None) -> int:
    return -1 if flags is None or not flags.any() else int(np.argmax(flags))
