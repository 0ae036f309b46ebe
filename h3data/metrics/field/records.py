"""What papers on social navigation report beside Habitat's own numbers, in words."""

from __future__ import annotations

from h3data.metrics.metric import INF, Direction, Metric

ROBOT_RADIUS_M = HUMAN_RADIUS_M = 0.25
"""Radii for times to collision: those of Habitat's navmesh agent."""
COMPLIANT_M = 1.0
"""Personal space of PSC, centre to centre (Falcon, ICRA 2025; the iGibson challenge takes 0.5 m)."""
INTIMATE_M, PERSONAL_M, SOCIAL_M = 0.45, 1.2, 3.6
"""Outer limits of Hall's zones (E. T. Hall, The Hidden Dimension, 1966)."""
STALLED_M_S, STALLED_RAD_S = 0.01, 0.02
"""A robot is stalled below both (HuNavSim)."""
FULL_SPEED_M_S = 2.5
"""Speed of STL's ideal robot: the paper's robot."""
GOAL_M = 2.0
"""The goal is reached when the robot, facing the person, is this near to her or nearer."""

_ROBOT, _HUMAN = "agent_<robot>.base_pose", "agent_<human>.base_pose"
_PAIR, _TIMED = (_ROBOT, _HUMAN), ("time_ns", _ROBOT)
_NO_PAIR = "No row has a pose of both agents."
_FRANCIS = "Francis et al. 2025, Principles and Guidelines for Evaluating Social Robot Navigation"
_HALL = "E. T. Hall 1966; as share of time in HuNavSim"
_GOAL = (
    "The goal is the person: reached in the first row with 1-2 m (geodesic, if recorded) and facing, as S. l is the way "
    "to within 2 m of where she is in row 0, p the path driven until the goal."
)


def _metric(
    name: str, task: str, title: str, formula: str, unit: str, high: float, direction: Direction, source: str,
    columns: tuple[str, ...], undefined: str, *, series: tuple[str, ...] = (), optional: tuple[str, ...] = (),
    binary: bool = False, reading: str = "",
) -> Metric:  # fmt: skip
    return Metric(
        id=f"field/{task}/{name}@1", name=name, title=title, formula=formula, unit=unit, range=(0.0, high),
        direction=direction, source=source, columns=columns, optional=optional, undefined=undefined, series=series,
        binary=binary, reading=reading,
    )  # fmt: skip


_GEO = ("metrics.geodesic_agents",)
_TWO, _THREE = "Fewer than two rows with a pose.", "Fewer than three rows in a row with a pose."

FIELD_METRICS: tuple[Metric, ...] = (
    _metric("PSC", "proxemics", "Personal space compliance", "rows with d >= 1.0 m / rows", "1", 1.0, "higher",
            "Falcon (ICRA 2025), PSC", _PAIR, _NO_PAIR, series=("dist_m", "personal_space"),
            reading="d is the L2 distance centre to centre; Falcon can also take the geodesic one. Between outlines of 0.25 m "
            "radius it is the 0.5 m of Francis et al.'s space compliance."),
    _metric("Z_intimate", "proxemics", "In the intimate zone", "rows with d < 0.45 m / rows", "1", 1.0, "lower",
            _HALL, _PAIR, _NO_PAIR, series=("intimate",),
            reading="d centre to centre (HuNavSim measures between outlines). The four shares add up to 1."),
    _metric("Z_personal", "proxemics", "In the personal zone", "rows with 0.45 <= d < 1.2 m / rows", "1", 1.0,
            "neither", _HALL, _PAIR, _NO_PAIR, series=("personal",)),
    _metric("Z_social", "proxemics", "In the social zone", "rows with 1.2 <= d < 3.6 m / rows", "1", 1.0, "neither",
            _HALL, _PAIR, _NO_PAIR, series=("social",)),
    _metric("Z_public", "proxemics", "In the public zone", "rows with d >= 3.6 m / rows", "1", 1.0, "neither",
            _HALL, _PAIR, _NO_PAIR, series=("public",)),
    _metric("intrusions", "proxemics", "Intrusions", "times that d falls below 1.2 m", "times", INF, "lower",
            "Hall's personal zone, counted as events", _PAIR, _NO_PAIR, series=("intruding",),
            reading="A recording that begins inside counts as one. Rows without a pose end an intrusion."),
    _metric("D_min", "proxemics", "Minimum distance", "min d", "m", INF, "higher", _FRANCIS, _PAIR, _NO_PAIR,
            series=("dist_m",)),
    _metric("TTC_min", "proxemics", "Minimum time to collision",
            "min over rows of the smallest t >= 0 with |x + v t| = r_robot + r_human",
            "s", INF, "higher", _FRANCIS, ("time_ns", *_PAIR), "Never on a collision course.", series=("ttc_s",),
            reading="x and v of the human seen from the robot, on the floor; v from the row before. 0 while they overlap. "
            "Radii: 0.25 m each."),
    _metric("PL", "navigation", "Path length", "sum of |change of the robot's position| on the floor", "m", INF, "lower",
            _FRANCIS, (_ROBOT,), "No row has a pose of the robot.", series=("speed_m_s",),
            reading="Changes between rows of which one has no pose do not count."),
    _metric("PE", "navigation", "Path efficiency", "|last - first position| / PL", "1", 1.0, "higher", _FRANCIS,
            (_ROBOT,), "PL = 0: a robot that did not move has none.", series=("speed_m_s",)),
    _metric("SPL", "navigation", "Success weighted by path length", "S * l / max(l, p)", "1", 1.0, "higher",
            "Anderson et al. 2018, On Evaluation of Embodied Navigation Agents", _PAIR,
            _NO_PAIR + " Or the human cannot be reached in row 0.", series=("goal",), optional=_GEO, reading=_GOAL),
    _metric("STL", "navigation", "Success weighted by time", "S * T* / max(T*, T), T* = l / 2.5 m/s", "1", 1.0, "higher",
            "Falcon (ICRA 2025); iGibson social navigation challenge", ("time_ns", *_PAIR),
            _NO_PAIR + " Or the human cannot be reached in row 0.", series=("goal",), optional=_GEO, reading=_GOAL),
    _metric("T_goal", "navigation", "Time to goal", "time of the first goal row - time of row 0", "s", INF, "lower",
            _FRANCIS, ("time_ns", *_PAIR), "The goal is never reached.", series=("goal",), optional=_GEO, reading=_GOAL),
    _metric("T_stalled", "navigation", "Stalled time", "time with speed < 0.01 m/s and turning < 0.02 rad/s", "s", INF,
            "lower", _FRANCIS + "; thresholds: HuNavSim", _TIMED, _TWO, series=("stalled",)),
    _metric("V_mean", "navigation", "Mean speed", "mean of v over rows", "m/s", INF, "neither", _FRANCIS, _TIMED, _TWO,
            series=("speed_m_s",), reading="v is the change of position since the row before, over its time."),
    _metric("V_max", "navigation", "Greatest speed", "max v", "m/s", INF, "neither", _FRANCIS, _TIMED, _TWO,
            series=("speed_m_s",)),
    _metric("A_mean", "navigation", "Mean acceleration", "mean of |change of the velocity vector| / time", "m/s2", INF,
            "lower", _FRANCIS, _TIMED, _THREE, series=("acceleration_m_s2",)),
    _metric("A_max", "navigation", "Greatest acceleration", "max of the same", "m/s2", INF, "lower", _FRANCIS, _TIMED,
            _THREE, series=("acceleration_m_s2",)),
    _metric("J_mean", "navigation", "Mean jerk", "mean of |change of the acceleration vector| / time", "m/s3", INF,
            "lower", _FRANCIS, _TIMED, "Fewer than four rows in a row with a pose.", series=("jerk_m_s3",)),
    _metric("J_max", "navigation", "Greatest jerk", "max of the same", "m/s3", INF, "lower", _FRANCIS, _TIMED,
            "Fewer than four rows in a row with a pose.", series=("jerk_m_s3",)),
    _metric("turning", "navigation", "Heading changes", "sum of |change of heading|", "rad", INF, "lower",
            "HuNavSim, cumulative heading changes", (_ROBOT,), _TWO),
    _metric("C_min", "navigation", "Minimum clearing distance", "min distance from the robot's centre to an obstacle",
            "m", INF, "higher", _FRANCIS, ("metrics.robot_clearance",), "No column metrics.robot_clearance.",
            series=("clearance_m",), reading="h3data.metrics.field.measures.with_clearance adds the column from a map."),
    _metric("C_mean", "navigation", "Mean clearing distance", "mean of the same", "m", INF, "higher", _FRANCIS,
            ("metrics.robot_clearance",), "No column metrics.robot_clearance.", series=("clearance_m",)),
)  # fmt: skip
