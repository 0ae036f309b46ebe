"""Definitions of the profile ``field``: metrics of papers on social navigation beyond Habitat's."""

from __future__ import annotations

from functools import partial

from h3data.metrics.metric import Metric
from h3data_social.definition import HUMAN_POSE, ROBOT_POSE, define_metric

ROBOT_RADIUS_M = HUMAN_RADIUS_M = 0.25
"""Radius of a robot for times to collision, that of Habitat's navmesh agent [m]."""
COMPLIANT_M = 1.0
"""Personal space for the metric PSC, centre to centre [m] (Falcon, ICRA 2025; the iGibson challenge uses 0.5 m)."""
INTIMATE_M, PERSONAL_M, SOCIAL_M = 0.45, 1.2, 3.6
"""Outer limits of Hall's zones [m] (E. T. Hall, The Hidden Dimension, 1966)."""
STALLED_M_S, STALLED_RAD_S = 0.01, 0.02
"""Speed [m/s] and turn rate [rad/s] below which, together, a robot counts as stalled (HuNavSim)."""
FULL_SPEED_M_S = 2.5
"""Speed of the ideal robot in the metric STL, that of the paper's robot [m/s]."""

_PAIR, _TIMED = (ROBOT_POSE, HUMAN_POSE), ("time_ns", ROBOT_POSE)
_NO_PAIR = "No row has a pose of the robot and of a person."
_UNREACHABLE = "No goal is recorded, or it cannot be reached in row 0, or no row has a pose of the robot and its goal."
_TWO, _THREE, _FOUR = (f"Fewer than {n} rows with a pose." for n in ("two", "three consecutive", "four consecutive"))
_FRANCIS = "Francis et al. 2025, Principles and Guidelines for Evaluating Social Robot Navigation"
_HALL = "E. T. Hall 1966; as share of time in HuNavSim"
_GOAL = (
    "The goal is info goal: a point [x, z], reached with metrics.success (without it from 0.5 m), or the number or name of an "
    "agent. In social_nav with one person it is that person. An agent is reached in the first row with 1-2 m (geodesic, if "
    "recorded) and facing, as in S of paper. l is the length of the path from row 0 to the point, or to within 2 m of the "
    "agent's place in row 0; p is the path driven until the goal. Version 1 knew one person and no other goal."
)
_ALL = "Over all people; version 1 was of one person, and with one person both are equal."


_metric = partial(define_metric, "field", source=_FRANCIS)
_near = partial(_metric, "proxemics", columns=_PAIR, undefined=_NO_PAIR, version=2, reading=_ALL)
_share = partial(_near, high=1.0, direction="neither", source=_HALL)
_motion = partial(_metric, "navigation", columns=_TIMED, undefined=_TWO)
_goal = partial(
    _metric,
    "navigation",
    columns=("time_ns", *_PAIR),
    optional=("metrics.geodesic_agents", "metrics.goal_distance", "metrics.success"),
    undefined=_UNREACHABLE,
    series=("goal", "reach_m"),
    reading=_GOAL,
    version=2,
)
_clearance = partial(
    _metric,
    "navigation",
    unit="m",
    direction="higher",
    columns=("metrics.robot_clearance",),
    undefined="No column metrics.robot_clearance.",
    series=("clearance_m",),
)

FIELD_METRICS: tuple[Metric, ...] = (
    _share(
        "PSC",
        "Personal space compliance",
        "rows with d >= 1.0 m / rows",
        direction="higher",
        source="Falcon (ICRA 2025), PSC",
        series=("dist_m", "personal_space"),
        reading="d is the L2 distance centre to centre to the nearest person; Falcon can also take the geodesic one. Between "
        "outlines of 0.25 m radius it is the 0.5 m of Francis et al.'s space compliance. " + _ALL,
    ),
    _share(
        "Z_intimate",
        "In the intimate zone",
        "rows with d < 0.45 m / rows",
        direction="lower",
        series=("intimate",),
        reading="d centre to centre to the nearest person (HuNavSim's code measures from the robot's outline). The four shares "
        "add up to 1. " + _ALL,
    ),
    _share("Z_personal", "In the personal zone", "rows with 0.45 <= d < 1.2 m / rows", series=("personal",)),
    _share("Z_social", "In the social zone", "rows with 1.2 <= d < 3.6 m / rows", series=("social",)),
    _share("Z_public", "In the public zone", "rows with d >= 3.6 m / rows", series=("public",)),
    _near(
        "intrusions",
        "Intrusions",
        "sum over people of the times that d to them falls below 1.2 m",
        unit="times",
        source="Hall's personal zone, counted as events",
        series=("intruding",),
        reading="A recording that begins inside counts as one. Rows without a pose end an intrusion. " + _ALL,
    ),
    _near("D_min", "Minimum distance", "min d", unit="m", direction="higher", series=("dist_m",)),
    _near(
        "TTC_min",
        "Minimum time to collision",
        "min over rows and people of the smallest t >= 0 with |x + v t| = r_robot + r_human",
        unit="s",
        direction="higher",
        columns=("time_ns", *_PAIR),
        undefined="Never on a collision course.",
        series=("ttc_s",),
        reading="x and v of the human relative to the robot, on the floor; v since the previous row. 0 while they overlap. "
        "Radii: 0.25 m each. " + _ALL,
    ),
    _motion(
        "PL",
        "Path length",
        "sum of |change of the robot's position| on the floor",
        unit="m",
        columns=(ROBOT_POSE,),
        undefined="No row has a pose of the robot.",
        series=("speed_m_s",),
        reading="Changes from or to a row without a pose do not count.",
    ),
    _motion(
        "PE",
        "Path efficiency",
        "|last - first position| / PL",
        high=1.0,
        direction="higher",
        columns=(ROBOT_POSE,),
        undefined="PL = 0: a robot that did not move has none.",
        series=("speed_m_s",),
    ),
    _goal(
        "SPL",
        "Success weighted by path length",
        "S * l / max(l, p)",
        high=1.0,
        direction="higher",
        source="Anderson et al. 2018, On Evaluation of Embodied Navigation Agents",
        columns=_PAIR,
    ),
    _goal(
        "STL",
        "Success weighted by time",
        "S * T* / max(T*, T), T* = l / 2.5 m/s",
        high=1.0,
        direction="higher",
        source="Falcon (ICRA 2025); iGibson social navigation challenge",
    ),
    _goal(
        "T_goal",
        "Time to goal",
        "time of the first goal row - time of row 0",
        unit="s",
        undefined="The goal is never reached, or no goal is recorded.",
    ),
    _motion(
        "T_stalled",
        "Stalled time",
        "time with speed < 0.01 m/s and turning < 0.02 rad/s",
        unit="s",
        source=_FRANCIS + "; thresholds: HuNavSim",
        series=("stalled",),
    ),
    _motion(
        "V_mean",
        "Mean speed",
        "mean of v over rows",
        unit="m/s",
        direction="neither",
        series=("speed_m_s",),
        reading="v is the change of position since the previous row, over its time.",
    ),
    _motion("V_max", "Greatest speed", "max v", unit="m/s", direction="neither", series=("speed_m_s",)),
    _motion(
        "A_mean",
        "Mean acceleration",
        "mean of |change of the velocity vector| / time",
        unit="m/s2",
        undefined=_THREE,
        series=("acceleration_m_s2",),
    ),
    _motion(
        "A_max",
        "Greatest acceleration",
        "max of the same",
        unit="m/s2",
        undefined=_THREE,
        series=("acceleration_m_s2",),
    ),
    _motion(
        "J_mean",
        "Mean jerk",
        "mean of |change of the acceleration vector| / time",
        unit="m/s3",
        undefined=_FOUR,
        series=("jerk_m_s3",),
    ),
    _motion("J_max", "Greatest jerk", "max of the same", unit="m/s3", undefined=_FOUR, series=("jerk_m_s3",)),
    _motion(
        "turning",
        "Heading changes",
        "sum of |change of heading|",
        unit="rad",
        source="HuNavSim, cumulative heading changes",
        columns=(ROBOT_POSE,),
    ),
    _clearance(
        "C_min",
        "Minimum clearing distance",
        "min distance from the robot's centre to an obstacle",
        reading="h3data_social.field.with_clearance adds the column from a map.",
    ),
    _clearance("C_mean", "Mean clearing distance", "mean of the same"),
)
