"""Definitions of the measures of habitat-lab, by its own keys (misspellings included)."""

from __future__ import annotations

from dataclasses import replace

from h3data.metrics.metric import INF, Direction, Metric

TRANSFORM = "habitat.robot_transform"
"""Name of an optional column: the robot's root transform in habitat-sim, float32 [T, 4, 4], translation in the last
column."""
_FOUND = ("agent_<robot>.base_pose", "agent_<human>.base_pose", "metrics.geodesic_agents")
_POSES = _FOUND[:2]
_SHORTEST = (
    "l is read from info:habitat_min_steps, a mapping of the oracle's rate ('60' on main, '120' in 0.3.0) to l as "
    "h3data_habitat.metrics.oracle finds it; without it l is infinite, as with Habitat's default configuration."
)
_NEVER = "Never undefined: what was not found counts as 0."


def _metric(
    name: str,
    title: str,
    formula: str,
    *,
    unit: str = "1",
    high: float = 1.0,
    low: float = 0.0,
    direction: Direction = "neither",
    source: str = "SocialNavStats",
    columns: tuple[str, ...] = _FOUND,
    optional: tuple[str, ...] = (),
    undefined: str = _NEVER,
    series: tuple[str, ...] = ("found",),
    binary: bool = False,
    reading: str = "",
) -> Metric:
    return Metric(
        id=f"habitat/social_nav/{name}@1",
        name=name,
        title=title,
        formula=formula,
        unit=unit,
        range=(low, high),
        direction=direction,
        source=f"habitat-lab, {source}",
        columns=columns,
        optional=(TRANSFORM, *optional),
        undefined=undefined,
        series=series,
        binary=binary,
        reading=reading,
    )


MAIN_METRICS: tuple[Metric, ...] = (
    _metric(
        "has_found_human",
        "Human found",
        "1 if a row k has 1 <= geodesic <= 2 m and facing > 0.5, else 0",
        direction="higher",
        binary=True,
        series=("found", "in_reach", "facing", "geodesic_m", "facing_dot"),
    ),
    _metric("found_human_rate_over_epi", "Found rate", "found rows / rows", direction="higher"),
    _metric(
        "found_human_rate_after_encounter_over_epi",
        "Found rate after the encounter",
        "found rows / rows from the first found row on; 0 if never found",
        direction="higher",
    ),
    _metric(
        "avg_robot_to_human_dis_over_epi",
        "Average distance",
        "sum of L2 distances in float32 / rows",
        unit="m",
        high=INF,
        direction="lower",
        columns=_POSES,
        undefined="A row has no pose.",
        series=("dist_m",),
    ),
    _metric(
        "avg_robot_to_human_after_encounter_dis_over_epi",
        "Average distance after the encounter",
        "the same from the first found row on; 0 if never found",
        unit="m",
        high=INF,
        direction="lower",
        series=("found", "dist_m"),
    ),
    _metric(
        "first_encounter_spl",
        "First encounter weighted by steps",
        "found * l / max(l, first_step); NaN becomes 0",
        direction="higher",
        optional=("info:habitat_min_steps",),
        reading=_SHORTEST,
    ),
    _metric(
        "frist_ecnounter_steps",
        "Steps to the first encounter",
        "row of the first encounter + 1; 1500 if never found",
        unit="steps",
        high=INF,
        direction="lower",
        reading="1500 stands for 'not yet', so that an encounter at step 1500 moves to 1501 if a step follows.",
    ),
    _metric(
        "frist_ecnounter_steps_ratio",
        "Steps to the first encounter over the oracle's",
        "frist_ecnounter_steps / l; 0 while l is infinite",
        high=INF,
        optional=("info:habitat_min_steps",),
        reading=_SHORTEST,
    ),
    _metric(
        "follow_human_steps_after_frist_encounter",
        "Followed steps",
        "found rows",
        unit="steps",
        high=INF,
        direction="higher",
    ),
    _metric(
        "follow_human_steps_ratio_after_frist_encounter",
        "Followed share",
        "found rows / (1500 - l); -0.0 while l is infinite",
        low=-INF,
        high=INF,
        direction="higher",
        optional=("info:habitat_min_steps",),
        undefined="l = 1500: Habitat stops with a ZeroDivisionError.",
        reading=_SHORTEST,
    ),
    _metric(
        "backup_ratio",
        "Backup rate",
        "rows with L2 <= 1.5 m and a motion against the former heading / rows",
        columns=_POSES,
        series=("near", "backs_up"),
        reading=(
            "For standing and turning robots float32 rounding decides between backing up and yielding. With the column "
            "habitat.robot_transform the rows are Habitat's; without it motions below 1 mm/s do not count as backing up, "
            "and a note says so."
        ),
    ),
    _metric(
        "yield_ratio",
        "Yield rate",
        "rows with L2 <= 1.5 m, no backing up, and less than 1/120 m of motion / rows",
        columns=_POSES,
        series=("near", "yields"),
    ),
    _metric(
        "num_agents_collide",
        "Contacts",
        "rows in which robot and human touch",
        unit="rows",
        high=INF,
        direction="lower",
        source="NumAgentsCollide",
        columns=("metrics.collision",),
        undefined="No column metrics.collision.",
        series=("collision",),
    ),
    _metric(
        "nav_seek_success",
        "Success",
        "1 if at the end at least 400 rows had 1 <= geodesic < 2 m and facing > 0.5",
        direction="higher",
        source="SocialNavSeekSuccess",
        optional=("info:habitat_config", "info:habitat_goal_pos"),
        undefined="Distances are measured to the task's goal, and info:habitat_goal_pos is missing.",
        series=("followed_steps", "success"),
        binary=True,
        reading="Rows need not be consecutive, and success does not end. On main, facing is ignored unless required.",
    ),
    _metric(
        "social_nav_reward",
        "Reward of the measure",
        "sum over rows of distance, facing, bonus, exploration and collision parts",
        low=-INF,
        high=INF,
        direction="higher",
        source="SocialNavReward",
        columns=(*_FOUND, "metrics.collision"),
        optional=("metrics.total_collisions", "info:habitat_config"),
        undefined="No column metrics.collision.",
        series=("social_nav_reward",),
        reading="Settings: info:habitat_config, else those that reproduce the paper. Unreachable humans: L2 distance.",
    ),
    _metric(
        "reward",
        "Reward of the learner",
        "sum over rows of slack + social_nav_reward + 10 * success",
        low=-INF,
        high=INF,
        direction="higher",
        source="RLTaskEnv.get_reward",
        columns=(*_FOUND, "metrics.collision"),
        optional=("metrics.total_collisions", "info:habitat_config", "info:habitat_goal_pos"),
        undefined="No column metrics.collision, or no success.",
        series=("reward",),
        reading="After success every further row pays its 10 again, so sums of thousands are correct.",
    ),
)

_CHANGED = {
    "nav_seek_success": "In 0.3.0 following counts only if facing is required: without need_to_face_human, never success.",
    "social_nav_reward": "In 0.3.0 the reward has only its distance and facing parts. Not checked against a run of it.",
}
PAPER_RELEASE_METRICS: tuple[Metric, ...] = tuple(
    replace(
        m,
        id=m.id.replace("habitat/", "habitat@0.3.0/", 1),
        reading=_CHANGED.get(m.name, m.reading),
        columns=_FOUND if m.name in ("social_nav_reward", "reward") else m.columns,
    )
    for m in MAIN_METRICS
)
