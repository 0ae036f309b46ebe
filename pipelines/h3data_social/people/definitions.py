"""Definitions of the profile ``social``: the metrics of Francis et al., HuNavSim, Falcon and SEAN, over all people."""

from __future__ import annotations

from functools import partial

from h3data.metrics.metric import Metric
from h3data_social.definition import HUMAN_POSE, ROBOT_POSE, define_metric

RATE_HZ = 10
"""Rate at which speeds, accelerations, jerks and forces are computed [Hz]; their values depend on it."""
SPACE_M = 0.5
"""Radius of personal space in the metric SC (Francis et al.) [m]."""
PROGRESS_M, PROGRESS_S = 0.1, 5.0
"""Distance [m] by which a robot must come nearer to its goal within a time [s]; otherwise it fails to progress."""
TARGET_M = 1.2
"""Distance from the target within which SEAN calls an episode completed."""
MET_M, P_SPACE_M = 2.0, 0.5
"""Distance from its centre at which the members of a group count as met, and width of the group's p-space [m]."""
FORCE, LAMBDA, GAMMA, N_PRIME, N = 2.1, 2.0, 0.35, 3.0, 2.0
"""Parameters of HuNavSim's social force (lightsfm, after Moussaid et al. 2009)."""

FRANCIS = "Francis et al. 2025, Principles and Guidelines for Evaluating Social Robot Navigation, table 1"
HUNAVSIM = "HuNavSim (Perez-Higueras et al. 2023), hunav_evaluator"
FALCON = "Falcon, Social-HM3D (Gong et al., ICRA 2025)"
SEAN = "SEAN 2.0 (Tsoi et al. 2022)"
_HALL = "E. T. Hall 1966; as share of time in " + HUNAVSIM

_PAIR, _TIMED = (ROBOT_POSE, HUMAN_POSE), ("time_ns", ROBOT_POSE)
_TOUCHED = ("metrics.collision_people or metrics.collision",)
_SLID, _CLEAR = "metrics.robot_contact", "metrics.robot_clearance"
_NO_PAIR = "No row has a pose of the robot and of a person."
_NO_POSE = "No row has a pose of the robot."
_NO_GOAL = "No goal is recorded, or no row has a pose of the robot and its goal."
_UNKNOWN = "Nobody recorded whom the robot touches."
_TWO, _THREE, _FOUR = (f"Fewer than {n} samples with a pose." for n in ("two", "three consecutive", "four consecutive"))
_WHO = (
    "Contact of the robot only: metrics.collision_people says whom it touches. Without it, metrics.collision, if there are two "
    "agents or if it never holds; people who touch each other do not count."
)
_REACHED = (
    "The goal is info goal: a point [x, z], reached with metrics.success (without it from 0.5 m), or the number or name of an "
    "agent, reached from 1-2 m and facing; in social_nav with one person it is that person."
)
_SAMPLED = (
    f"Of positions at {RATE_HZ} Hz, between rows interpolated; rows that are farther apart are taken as they are. "
)
NOTATION = (
    "c_k is the distance between the centres of the robot and person k on the floor, c that to the nearest person, "
    "o = max(c - r_robot - r_human, 0), radii 0.25 m. "
)
_CLOSES = (
    "The robot closes the gap if its step towards the person in that row is at least as long as the person's step towards it. "
    "Who is inside or in contact from the first row on, or appears there, is counted for neither."
)


_metric = partial(define_metric, "social")
_goal = partial(
    _metric,
    "task",
    columns=_PAIR,
    optional=("info:goal", "metrics.goal_distance", "metrics.geodesic_agents", "metrics.success"),
    undefined=_NO_GOAL,
    series=("goal", "goal_distance_m"),
    reading=_REACHED,
)
_contact = partial(_metric, "task", columns=_TOUCHED, undefined=_UNKNOWN, series=("collision",), reading=_WHO)
_motion = partial(_metric, "motion", columns=_TIMED, source=FRANCIS)
_space = partial(_metric, "space", notation=NOTATION, columns=_PAIR, undefined=_NO_PAIR)
_share = partial(_space, high=1.0, direction="neither")
_zone = partial(_share, source=_HALL)
_crossing = partial(_space, unit="times", columns=("time_ns", *_PAIR), reading=_CLOSES)
_group = partial(
    _metric,
    "groups",
    source=HUNAVSIM + ", zones to the nearest group's centre; spaces of Kendon 1990",
    columns=(ROBOT_POSE, HUMAN_POSE),
    optional=("info:people",),
    undefined="No group of two or more people is recorded in info people.",
    high=1.0,
    direction="neither",
    reading="g is the distance of the robot to the mean position of a group's members, q their mean distance to it. A group "
    "counts in rows in which nobody is more than 2 m from that: they have met.",
)
_OUTLINE = "From the robot's outline to the person's centre, as HuNavSim's code; its description has centres."

SOCIAL_METRICS: tuple[Metric, ...] = (
    _goal(
        "S",
        "Success",
        "1 if the goal is reached, and WC + AC + HC = 0 until then, else 0",
        source=FRANCIS,
        columns=(*_PAIR, *_TOUCHED, _SLID),
        undefined=_NO_GOAL + " Or the goal is reached, and contacts are not recorded.",
        direction="higher",
        binary=True,
        reading="Sliding along furniture is contact: SR disregards it. " + _REACHED,
    ),
    _goal(
        "SR",
        "Success rate",
        "1 if the goal is reached, and HC = 0 until then, else 0",
        source=FALCON,
        columns=(*_PAIR, *_TOUCHED),
        undefined=_NO_GOAL + " Or the goal is reached, and contacts are not recorded.",
        direction="higher",
        binary=True,
    ),
    _contact("H_coll", "Human collision rate", "1 if HC > 0, else 0", source=FALCON + ", H-Coll", binary=True),
    _contact(
        "C",
        "Collisions",
        "WC + AC + HC",
        unit="times",
        source=FRANCIS,
        columns=(*_TOUCHED, _SLID),
        undefined="WC, AC or HC is undefined.",
    ),
    _contact(
        "WC",
        "Wall collisions",
        "times that metrics.robot_contact becomes true",
        unit="times",
        source=FRANCIS,
        columns=(_SLID,),
        undefined="No column metrics.robot_contact.",
        series=("wall_contact",),
        reading="Walls and furniture, of any robot if there are several.",
    ),
    _contact(
        "AC",
        "Agent collisions",
        "sum over other robots of the times that the robot begins to touch them",
        unit="times",
        source=FRANCIS,
        columns=("metrics.collision_robots or metrics.collision_people or metrics.collision",),
        reading="0 without another robot.",
    ),
    _contact(
        "HC",
        "Human collisions",
        "sum over people of the times that the robot begins to touch them",
        unit="times",
        source=FRANCIS,
    ),
    _contact(
        "HC_steps", "Steps of human collision", "rows in which the robot touches a person", unit="rows", source=FRANCIS
    ),
    _goal(
        "TO",
        "Timeout",
        "1 if the goal is never reached and the time limit ends the episode, else 0",
        source=FRANCIS,
        columns=(*_PAIR, "info:ended or info:max_steps"),
        undefined=_NO_GOAL + " Or neither info ended nor info max_steps is recorded.",
        binary=True,
        reading="The limit ends it if info ended is max_steps; without it, if there are info max_steps rows. "
        + _REACHED,
    ),
    _goal(
        "FP",
        "Failures to progress",
        "times that g(t - 5 s) - g(t) falls below 0.1 m before the goal is reached",
        source=FRANCIS + "; parameters of robot_sf",
        columns=("time_ns", *_PAIR),
        unit="times",
        series=("stuck", "goal_distance_m"),
        reading="g is the distance to the goal; one long stand is one failure. " + _REACHED,
    ),
    _metric(
        "task",
        "ST",
        "Stalled time",
        "time with speed < 0.01 m/s and turning < 0.02 rad/s",
        source=FRANCIS + "; thresholds of " + HUNAVSIM,
        columns=_TIMED,
        undefined="Fewer than two rows with a pose.",
        unit="s",
        series=("stalled",),
        reading="Of rows. Its description now has 0.001 m/s and 0.01 rad/s.",
    ),
    _goal(
        "T",
        "Time to reach the goal",
        "time of the first goal row - time of row 0",
        source=FRANCIS,
        columns=("time_ns", *_PAIR),
        undefined="The goal is never reached, or no goal is recorded.",
        unit="s",
    ),
    _metric(
        "task",
        "PL",
        "Path length",
        "sum of |change of the robot's position| on the floor",
        source=FRANCIS + "; L_p of HuNavSim",
        columns=(ROBOT_POSE,),
        undefined=_NO_POSE,
        unit="m",
        series=("speed_m_s",),
        reading="Of rows. Changes from or to a row without a pose do not count.",
    ),
    _goal(
        "SPL",
        "Success weighted by path length",
        "SR * l / max(l, p)",
        source="Anderson et al. 2018; with the SR of " + FALCON,
        columns=(*_PAIR, *_TOUCHED),
        undefined="SR is undefined, or the goal is reached and cannot be reached in row 0.",
        direction="higher",
        high=1.0,
        reading="l is the path to the goal in row 0 (to 2 m from an agent), p the path driven until the goal. "
        + _REACHED,
    ),
    _goal(
        "STL",
        "Success weighted by time",
        "SR * T* / max(T*, T), T* = l / 2.5 m/s",
        source=FALCON,
        columns=("time_ns", *_PAIR, *_TOUCHED),
        undefined="SR is undefined, or the goal is reached and cannot be reached in row 0.",
        direction="higher",
        high=1.0,
        reading="Falcon's ideal robot drives 0.25 m in 10 of its steps. " + _REACHED,
    ),
    _goal(
        "total",
        "Total score",
        "0.4 SR + 0.3 SPL + 0.3 PSC",
        source="RoboSense challenge 2025, track 2",
        columns=(*_PAIR, *_TOUCHED),
        undefined="SR, SPL or PSC is undefined.",
        direction="higher",
        high=1.0,
    ),
    _goal(
        "completed",
        "Completed",
        "1 if g < 1.2 m in the last row, else 0",
        source=SEAN,
        direction="higher",
        binary=True,
        series=("goal_distance_m",),
        reading="g is the distance to the goal in a straight line. " + _REACHED,
    ),
    _goal("TD_min", "Least distance to the target", "min g", source=SEAN, unit="m", reading="g in a straight line."),
    _goal(
        "TD_final",
        "Final distance to the target",
        "g in the last row",
        source=SEAN,
        unit="m",
        reading="g in a straight line.",
    ),
    _goal(
        "path_ratio",
        "Path efficiency",
        "PL / l",
        source=SEAN + ", path efficiency",
        undefined=_NO_GOAL + " Or l is 0 or unknown.",
        reading="l is the path to the goal in row 0 (to 2 m from an agent). Path irregularity needs a planner: left out.",
    ),
    _motion("V_min", "Least speed", "min v", unit="m/s", direction="neither", undefined=_TWO, reading=_SAMPLED),
    _motion("V_mean", "Mean speed", "mean v", unit="m/s", direction="neither", undefined=_TWO, reading=_SAMPLED),
    _motion("V_max", "Greatest speed", "max v", unit="m/s", direction="neither", undefined=_TWO, reading=_SAMPLED),
    _motion(
        "A_min",
        "Least acceleration",
        "min a, a = |change of the velocity vector| / 0.1 s",
        unit="m/s2",
        undefined=_THREE,
        reading=_SAMPLED,
    ),
    _motion("A_mean", "Mean acceleration", "mean a", unit="m/s2", undefined=_THREE, reading=_SAMPLED),
    _motion("A_max", "Greatest acceleration", "max a", unit="m/s2", undefined=_THREE, reading=_SAMPLED),
    _motion(
        "J_min",
        "Least jerk",
        "min j, j = |change of the acceleration vector| / 0.1 s",
        unit="m/s3",
        undefined=_FOUR,
        reading=_SAMPLED,
    ),
    _motion(
        "J_mean",
        "Mean jerk",
        "mean j",
        unit="m/s3",
        undefined=_FOUR,
        reading=_SAMPLED
        + "HuNavSim's over-acceleration divides the change of speed by the time twice, which is no jerk.",
    ),
    _motion("J_max", "Greatest jerk", "max j", unit="m/s3", undefined=_FOUR, reading=_SAMPLED),
    _motion(
        "CHC",
        "Cumulative heading changes",
        "sum of |change of heading|",
        unit="rad",
        source=HUNAVSIM,
        columns=(ROBOT_POSE,),
        undefined="Fewer than two rows with a pose.",
        reading="Of rows.",
    ),
    _share(
        "PSC",
        "Personal space compliance",
        "rows with c >= 1.0 m / rows",
        direction="higher",
        source=FALCON,
        series=("dist_m", "personal_space"),
    ),
    _share(
        "SC",
        "Space compliance",
        "rows with o >= 0.5 m / rows",
        direction="higher",
        source=FRANCIS,
        series=("dist_m",),
        reading="Between outlines. Some readers take SC for the share inside, which is 1 - SC.",
    ),
    _share(
        "SC_centre",
        "Space compliance, between centres",
        "rows with c >= 0.5 m / rows",
        direction="higher",
        source="iGibson social navigation challenge 2021, personal space compliance",
        series=("dist_m",),
    ),
    _space(
        "DH_min",
        "Minimum distance to a human",
        "min c",
        unit="m",
        direction="higher",
        source=FRANCIS,
        series=("dist_m",),
    ),
    _space(
        "DH_min_outline",
        "Minimum distance to a human, between outlines",
        "min o",
        unit="m",
        direction="higher",
        source=FRANCIS,
        series=("dist_m",),
        reading="0 where discs overlap: bodies are not discs, and contact is decided by metrics.collision_people.",
    ),
    _space("CP_avg", "Mean distance to the closest person", "mean c", unit="m", direction="neither", source=HUNAVSIM),
    _space("CP_min", "Least distance to the closest person", "min c", unit="m", direction="higher", source=HUNAVSIM),
    _space(
        "CP_max", "Greatest distance to the closest person", "max c", unit="m", direction="neither", source=HUNAVSIM
    ),
    _space(
        "CP_avg_outline",
        "Mean distance to the closest person, between outlines",
        "mean o",
        unit="m",
        direction="neither",
        source=HUNAVSIM + ", code",
    ),
    _space(
        "CP_min_outline",
        "Least distance to the closest person, from the robot's outline",
        "min max(c - r_robot, 0)",
        unit="m",
        direction="higher",
        source=HUNAVSIM + ", code",
        reading=_OUTLINE,
    ),
    _space(
        "CP_max_outline",
        "Greatest distance to a person, from the robot's outline",
        "max over rows and people of max(c_k - r_robot, 0)",
        unit="m",
        direction="neither",
        source=HUNAVSIM + ", code",
        reading="Of everybody, not of the closest, as HuNavSim's code.",
    ),
    _zone("Z_intimate", "In the intimate zone", "rows with c < 0.45 m / rows", direction="lower", series=("intimate",)),
    _zone("Z_personal", "In the personal zone", "rows with 0.45 <= c < 1.2 m / rows", series=("personal",)),
    _zone("Z_social", "In the social zone", "rows with 1.2 <= c < 3.6 m / rows", series=("social",)),
    _zone("Z_public", "In the public zone", "rows with c >= 3.6 m / rows", series=("public",)),
    _zone(
        "Z_intimate_outline",
        "In the intimate zone, from the robot's outline",
        "rows with c - r_robot < 0.45 m / rows",
        direction="lower",
        reading=_OUTLINE,
    ),
    _zone(
        "Z_personal_outline",
        "In the personal zone, from the robot's outline",
        "rows with 0.45 <= c - r_robot < 1.2 m / rows",
        reading=_OUTLINE,
    ),
    _zone(
        "Z_social_outline",
        "In the social zone, from the robot's outline",
        "rows with 1.2 <= c - r_robot < 3.6 m / rows",
        reading=_OUTLINE,
    ),
    _zone(
        "Z_public_outline",
        "In the public zone, from the robot's outline",
        "rows with c - r_robot >= 3.6 m / rows",
        reading=_OUTLINE,
    ),
    _crossing(
        "RP_personal",
        "Personal distance violations by the robot",
        "sum over people of the times that c_k falls below 1.2 m and the robot closes the gap",
        source=SEAN + ", robot on person",
    ),
    _crossing(
        "PR_personal",
        "Personal distance violations by people",
        "sum over people of the times that c_k falls below 1.2 m and the person closes the gap",
        source=SEAN + ", person on robot",
        direction="neither",
    ),
    _crossing(
        "RP_intimate",
        "Intimate distance violations by the robot",
        "sum over people of the times that c_k falls below 0.45 m and the robot closes the gap",
        source=SEAN + ", robot on person",
    ),
    _crossing(
        "PR_intimate",
        "Intimate distance violations by people",
        "sum over people of the times that c_k falls below 0.45 m and the person closes the gap",
        source=SEAN + ", person on robot",
        direction="neither",
    ),
    _crossing(
        "RPC",
        "Robot on person collisions",
        "contacts of HC in which the robot closes the gap",
        source=SEAN + "; " + HUNAVSIM,
        columns=("time_ns", *_PAIR, *_TOUCHED),
        undefined=_UNKNOWN,
        series=("collision",),
    ),
    _crossing(
        "PRC",
        "Person on robot collisions",
        "contacts of HC in which the person closes the gap",
        source=SEAN + "; " + HUNAVSIM,
        columns=("time_ns", *_PAIR, *_TOUCHED),
        undefined=_UNKNOWN,
        series=("collision",),
        direction="neither",
    ),
    _space(
        "CD_min",
        "Minimum clearing distance",
        "min distance from the robot's centre to an obstacle",
        source=FRANCIS,
        unit="m",
        direction="higher",
        columns=(_CLEAR,),
        undefined="No column metrics.robot_clearance.",
        reading="h3data_social.field.with_clearance adds the column from a map.",
    ),
    _space(
        "CD_mean",
        "Mean clearing distance",
        "mean of the same",
        source=FRANCIS,
        unit="m",
        direction="higher",
        columns=(_CLEAR,),
        undefined="No column metrics.robot_clearance.",
    ),
    _space(
        "TTC_min",
        "Minimum time to collision",
        "min over rows and people of the smallest t >= 0 with |x_k + v_k t| = r_robot + r_human",
        source=FRANCIS,
        unit="s",
        direction="higher",
        columns=("time_ns", *_PAIR),
        undefined="Never on a collision course.",
        series=("ttc_s",),
        reading="x_k and v_k of the person relative to the robot, v_k since the previous row. 0 while the discs overlap.",
    ),
    _metric(
        "people",
        "V_people",
        "Mean speed of people",
        "mean over samples and people of their speed",
        source="SocNavBench and Katyal et al. 2022, in " + HUNAVSIM,
        columns=("time_ns", HUMAN_POSE),
        undefined=_TWO,
        unit="m/s",
        direction="neither",
        reading=_SAMPLED,
    ),
    _metric(
        "people",
        "V_nearest",
        "Mean speed of the nearest person",
        "mean over samples of the speed of the nearest person",
        source=HUNAVSIM,
        columns=("time_ns", *_PAIR),
        undefined=_TWO,
        unit="m/s",
        direction="neither",
        reading=_SAMPLED,
    ),
    _metric(
        "people",
        "SF",
        "Social force",
        "mean over samples of the sum over people of |f_k|",
        source=HUNAVSIM + ", social force on robot and on agents; Moussaid et al. 2009",
        columns=("time_ns", *_PAIR),
        undefined=_TWO,
        unit="m/s2",
        reading=_SAMPLED
        + "|f_k| = 2.1 sqrt(exp(-2 c_k/B - 2 (3 B a)^2) + [a != 0] exp(-2 c_k/B - 2 (2 B a)^2)), B = 0.35 |D|, "
        "D = 2 (v_robot - v_k) + e, e the direction to the person, a the angle between D and e. It is the same on the robot "
        "and on the person; HuNavSim sums it over its messages.",
    ),
    _group(
        "GCR",
        "Group crossing rate",
        "1 if a row has g < q for a group, else 0",
        source="TAGA (group-aware navigation); o-space of Kendon 1990",
        direction="lower",
        binary=True,
        series=("o_space",),
    ),
    _group(
        "G_o", "In the o-space of a group", "rows with g < q for a group / rows", direction="lower", series=("o_space",)
    ),
    _group(
        "G_p",
        "In the p-space of a group",
        "rows with q <= g < q + 0.5 m for a group, and in no o-space / rows",
        direction="lower",
    ),
    _group("IG_intimate", "In the intimate zone of a group", "rows with g < 0.45 m for the nearest group / rows"),
    _group(
        "IG_personal", "In the personal zone of a group", "rows with 0.45 <= g < 1.2 m for the nearest group / rows"
    ),
    _group("IG_social", "In the social zone of a group", "rows with 1.2 <= g < 3.6 m for the nearest group / rows"),
)
"""Metrics of the profile, in the order of tables; `NOTATION` explains the symbols."""
