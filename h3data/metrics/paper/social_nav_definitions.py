"""Definitions of the paper's social navigation metrics; `h3data.metrics.paper.social_nav` computes them."""

from __future__ import annotations

from h3data.metrics.metric import INF, Metric

_POSES = ("agent_<robot>.base_pose", "agent_<human>.base_pose")
_REACH = ("metrics.geodesic_agents",)
_NO_POSES = "No row has a pose of both agents."
_NO_ORACLE = "Found, but l is not recorded or the oracle never arrives."
_ORACLE_READING = (
    "l is the oracle's minimum number of steps, stored by the simulator as info:oracle_min_steps; a recording without "
    "it has no {0}, unless the robot never finds the human: then {0} = 0 whatever l is."
)

SOCIAL_NAV: tuple[Metric, ...] = (
    Metric(
        id="paper/social_nav/S@1",
        name="S",
        title="Finding success",
        formula="S = 1 if a row k is found, else 0",
        unit="1",
        range=(0.0, 1.0),
        direction="higher",
        source="Habitat 3.0, section 4.1 'Metrics' (1); facing: appendix A.1",
        columns=_POSES,
        optional=_REACH,
        undefined=_NO_POSES,
        series=("found", "in_reach", "facing", "reach_m", "facing_dot"),
        binary=True,
        reading="Found in row k: 1 <= distance <= 2 m, both ends included, and dot(f, u) > 0.5, where f is the robot's forward "
        "vector and u the unit vector from robot to human, both on the floor plane. The distance is geodesic, as in the "
        "paper's reward; without a geodesic column it is the L2 distance, and a note says so.",
        habitat="The same, except that the state after reset counts as a step.",
    ),
    Metric(
        id="paper/social_nav/SPS@1",
        name="SPS",
        title="Finding success weighted by path steps",
        formula="SPS = S * l / max(l, p), p = k + 1 with k the first found row",
        unit="1",
        range=(0.0, 1.0),
        direction="higher",
        source="Habitat 3.0, section 4.1 'Metrics' (2); l: appendix A.1 'Oracle for the Minimum Steps'",
        columns=(*_POSES, "info:oracle_min_steps"),
        optional=_REACH,
        undefined=_NO_POSES + " " + _NO_ORACLE,
        series=("found", "in_reach", "facing", "reach_m"),
        reading="Row k is the state after action k, counted from 0, so that finding in row k took p = k + 1 steps. "
        + _ORACLE_READING.format("SPS"),
        habitat=(
            "Counts the state after reset as step 1, so p is one larger. With its default configuration l stays "
            "infinite and SPS is always 0; l tests r <= i at every step, the paper r < i at equally spaced waypoints."
        ),
    ),
    Metric(
        id="paper/social_nav/F@1",
        name="F",
        title="Following rate",
        formula="F = w / max(E - l, w), w = number of found rows; 0 if w = 0",
        unit="1",
        range=(0.0, 1.0),
        direction="higher",
        source="Habitat 3.0, section 4.1 'Metrics' (3)",
        columns=(*_POSES, "info:oracle_min_steps"),
        optional=(*_REACH, "info:max_steps"),
        undefined=_NO_POSES + " " + _NO_ORACLE,
        series=("found", "in_reach", "facing", "reach_m"),
        reading=(
            "w counts every row within 1-2 m and facing, the first one included; they need not be consecutive. E is "
            "the longest duration that the task allows (info:max_steps, 1500 in the paper), not the duration of this "
            "episode: one that ends early by a collision loses its remaining steps. " + _ORACLE_READING.format("F")
        ),
        habitat="w / (1500 - l): no maximum, 1500 even if the task allows another number; -0.0 while l is infinite.",
    ),
    Metric(
        id="paper/social_nav/CR@1",
        name="CR",
        title="Collision rate",
        formula="CR = 1 if the robot touches the human in any row, else 0",
        unit="1",
        range=(0.0, 1.0),
        direction="lower",
        source="Habitat 3.0, section 4.1 'Metrics' (4)",
        columns=("metrics.collision",),
        undefined="No row, or no column metrics.collision.",
        series=("collision",),
        binary=True,
        reading=(
            "The paper counts episodes that END in a collision; its episodes end at the first contact. A recording "
            "that goes on after a contact counts too, and a note says so. Without the column CR is undefined: that "
            "no contact was recorded does not mean that there was none."
        ),
        habitat="num_agents_collide counts per episode; it equals CR only while the first contact ends the episode.",
    ),
    Metric(
        id="paper/social_nav/BYR@1",
        name="BYR",
        title="Backup-yield rate",
        formula="BYR = share of rows with d < 1.5 m and (robot moves backwards, or its speed < 0.1 m/s)",
        unit="1",
        range=(0.0, 1.0),
        direction="neither",
        source="Habitat 3.0, appendix 'Additional Metrics' (1)",
        columns=("time_ns", *_POSES),
        undefined=_NO_POSES,
        series=("near", "backs_up", "yields", "dist_m", "speed_m_s"),
        reading=(
            "d is the L2 distance. The velocity of row k is the change of the robot's position since row k - 1; it "
            "moves backwards if the part along its heading in row k - 1 is below -1 mm/s (less is rounding noise). "
            "Row 0 has no velocity and counts as neither. The denominator is ALL rows: the paper's own heuristic "
            "backs up whenever d < 1.5 m, so over near rows alone its published 0.24 would have to be close to 1."
        ),
        habitat=(
            "d <= 1.5 m; a yield is anything below 1 'unit' = 0.25 m/s; backward is any negative rounding error, so a "
            "standing robot counts as backing up or yielding at random (their sum does not change)."
        ),
    ),
    Metric(
        id="paper/social_nav/TD@1",
        name="TD",
        title="Total distance",
        formula="TD = mean of d over all rows",
        unit="m",
        range=(0.0, INF),
        direction="lower",
        source="Habitat 3.0, appendix 'Additional Metrics' (2)",
        columns=_POSES,
        undefined=_NO_POSES,
        series=("dist_m",),
        reading="d is the L2 distance of the two base positions in space. Rows in which an agent has no pose are left "
        "out, and a note says how many.",
        habitat="The same, with the state after reset as one more row.",
    ),
    Metric(
        id="paper/social_nav/FD@1",
        name="FD",
        title="Following distance",
        formula="FD = mean of d from the first found row on, that row included",
        unit="m",
        range=(0.0, INF),
        direction="lower",
        source="Habitat 3.0, appendix 'Additional Metrics' (3)",
        columns=_POSES,
        optional=_REACH,
        undefined="The human is never found. " + _NO_POSES,
        series=("found", "dist_m"),
        reading="d is the L2 distance. An episode in which the human is never found has no FD; the mean over episodes "
        "is over those that have one.",
        habitat="An episode in which the human is never found contributes 0, which pulls the mean down.",
    ),
)
