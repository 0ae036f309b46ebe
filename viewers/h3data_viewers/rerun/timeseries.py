"""Plots, action lanes and event log of a recording as Rerun columns."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.metrics import find_agents
from h3data.metrics.paper.encounter import found_series
from h3data.metrics.paper.profiles import SOCIAL_NAV_PROFILE
from h3data.metrics.paper.social_nav import l2_distance, reach_distance
from h3data.recording.live_input import AWAY, live_inputs
from h3data.recording.log_lines import LogLine, log_lines
from h3data.recording.records import Recording
from h3data_viewers.rerun.sink import Sink

NOTHING = "-"
"""Lane state while no skill or motion is running."""
ENDED = "ended"
"""Lane state after the last step, in files whose other recording is longer."""
STATE_COLORS = {
    NOTHING: 0x3A3A3AFF,
    "apart": 0x616161FF,
    "near": 0xFFB300FF,
    "following": 0x43A047FF,
    "too close": 0xFB8C00FF,
    "contact": 0xE53935FF,
    AWAY: 0x90A4AEFF,
    ENDED: 0x1A1A1AFF,
}
PALETTE = (0x1E88E5FF, 0x8E24AAFF, 0x00897BFF, 0xF4511EFF, 0x6D4C41FF, 0x3949ABFF, 0xC0CA33FF, 0xD81B60FF, 0x00ACC1FF)


def agent_pair(recording: Recording) -> tuple[int, int] | None:
    """Return the numbers of the robot and the human for which metrics are computed, or None if there is no such pair."""
    try:
        return find_agents(recording)
    except InputError:
        return None


def touched_rows(recording: Recording) -> NDArray[np.bool_]:
    """Return a mask [T] of the rows in which the robot is recorded as touching a person."""
    # with several agents, `collision` may be a contact between others
    people = recording.columns.get("metrics.collision_people")
    if people is not None and people.ndim == 2:
        return np.asarray(people.any(axis=1))
    anybody = recording.columns.get("metrics.collision")
    return np.zeros(len(recording), np.bool_) if anybody is None or anybody.ndim != 1 else anybody.astype(np.bool_)


def is_following(recording: Recording) -> bool:
    """Return whether the robot's task is to follow a person; only then do the bounds of 1 and 2 m apply."""
    return recording.episode.task == SOCIAL_NAV_PROFILE.tasks[0]


# --- plots ------------------------------------------------------------------------------------------------------------
def curves_of(recording: Recording) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """Return the per-step scalars [T] by name, and the names of those that are distances [m]."""
    curves: dict[str, NDArray[Any]] = {
        name.removeprefix("metrics."): column
        for name, column in recording.columns.items()
        if name.startswith("metrics.") and column.ndim == 1 and column.dtype.kind in "fiub"
    }
    distances = [name for name in curves if name.startswith(("dist", "geodesic"))]
    pair = agent_pair(recording)
    if pair is not None and "dist_agents" not in curves:
        curves["distance_l2"] = l2_distance(recording, *pair)
        distances.append("distance_l2")
    return curves, distances


def log_scalars(sink: Sink, recording: Recording, *, shade: int | None = None, bounds: bool = True) -> tuple[str, ...]:
    """Log every per-step scalar below ``metrics/`` and return the paths of the distances, which share one plot.

    Args:
        shade: index of the recording, which then sets the colours and the names of its curves; for plots that several
            recordings share.
        bounds: whether to log the two distances between which the robot counts as following, if following is the task.
    """
    import rerun as rr

    # in a shared plot, the first recording is blue and the second one red
    shared = ((0x1565C0FF, 0x64B5F6FF, 0x4DD0E1FF), (0xD84315FF, 0xFFB74DFF, 0xF06292FF))
    family = (0x1565C0FF, 0x8E24AAFF, 0x00ACC1FF, 0x6D4C41FF) if shade is None else shared[shade]
    curves, plotted = curves_of(recording)
    for name, column in curves.items():
        values = column.astype(np.float64)
        values[np.isinf(values)] = np.nan  # infinite: no path; NaN leaves a gap in the curve
        if name in plotted:
            color = np.array([family[plotted.index(name) % len(family)]], np.uint32)
            title = f"{sink.label} {name}".lstrip()
            sink.static(f"metrics/{name}", rr.SeriesLines(names=[title], colors=color, widths=[2.0]))
        sink.columns(f"metrics/{name}", None, rr.Scalars.columns(scalars=values))
    if bounds and len(recording) and is_following(recording) and agent_pair(recording) is not None:
        # two points make a line
        ends = np.unique([0, len(recording) - 1])
        for name, bound, color in (("follow_from_1m", 1.0, 0xC0A000FF), ("follow_to_2m", 2.0, 0x2E7D32FF)):
            style = rr.SeriesLines(names=[name], colors=np.array([color], np.uint32), widths=[1.0])
            sink.static(f"metrics/{name}", style)
            sink.columns(f"metrics/{name}", ends, rr.Scalars.columns(scalars=np.full(len(ends), bound)))
            plotted.append(name)
    return tuple(sink.path(f"metrics/{name}") for name in plotted)


# --- lanes ------------------------------------------------------------------------------------------------------------
def lanes_of(recording: Recording) -> dict[str, list[str]]:
    """Return the state of every lane at each row, by lane name.

    Lanes are skills, motions, requests of players of a live session, and the encounter of robot and person.
    """
    lanes: dict[str, list[str]] = {}
    for i, agent in enumerate(recording.agents):
        skill = _skill_states(recording, i)
        if skill is not None:
            lanes[f"{agent.name}_skill"] = skill
        motion = recording.columns.get(f"agent_{i}.motion_id")
        if motion is not None and agent.motion_names:
            lanes[f"{agent.name}_motion"] = [_coded(agent.motion_names, code) for code in motion.tolist()]
    for player in live_inputs(recording):
        if player.user < len(recording.agents):
            lanes[f"{recording.agents[player.user].name}_input"] = list(player.asked)
    pair = agent_pair(recording)
    if pair is not None:
        lanes["encounter"] = _encounter_states(recording, *pair)
    return lanes


def log_lanes(sink: Sink, recording: Recording, *, ends: bool = False) -> tuple[str, ...]:
    """Log the lanes below ``actions/`` and return their paths; with ``ends``, they show where the recording ends."""
    import rerun as rr

    lanes = {name: states for name, states in lanes_of(recording).items() if states}
    for name, lane in lanes.items():
        states = [*lane, ENDED] if ends else lane
        values = list(dict.fromkeys(states))
        uncolored = [v for v in values if v not in STATE_COLORS]
        colors = {v: PALETTE[k % len(PALETTE)] for k, v in enumerate(uncolored)} | STATE_COLORS
        rgba = np.array([colors[v] for v in values], np.uint32)
        config = rr.StateConfiguration(values=values, labels=values, colors=rgba)
        sink.static(f"actions/{name}", config)
        rows = [0, *(k for k in range(1, len(states)) if states[k] != states[k - 1])]
        columns = rr.StateChange.columns(state=[states[k] for k in rows])
        # only changes: a state lasts until the next one
        sink.columns(f"actions/{name}", rows, columns)
    return tuple(sink.path(f"actions/{name}") for name in lanes)


def _skill_states(recording: Recording, agent: int) -> list[str] | None:
    names, column = recording.agents[agent].skill_names, recording.columns.get(f"agent_{agent}.skill")
    if column is not None and names:
        return [_coded(names, code) for code in column.tolist()]
    spans = [s for s in recording.skills if s.agent == agent]
    if not spans:
        return None
    states = [NOTHING] * len(recording)
    for span in spans:
        # spans of foreign files may reach beyond the recording
        for k in range(max(span.start_step, 0), min(span.end_step + 1, len(states))):
            states[k] = span.name
    return states


def _coded(names: tuple[str, ...], code: int) -> str:
    return names[code] if 0 <= code < len(names) else NOTHING


def _encounter_states(recording: Recording, robot: int, human: int) -> list[str]:
    """Classify each row as apart, near, or contact.

    If following is the task, rows can also be following (1-2 m, facing the person) and too close.
    """
    distance = l2_distance(recording, robot, human)
    contact = touched_rows(recording)
    if not is_following(recording):
        return np.select([contact, distance <= 2.0], ["contact", "near"], "apart").tolist()
    following = following_rows(recording, robot, human)
    choice = np.select(
        [contact, following, distance < 1.0, distance <= 2.0], ["contact", "following", "too close", "near"], "apart"
    )
    return choice.tolist()


# --- log --------------------------------------------------------------------------------------------------------------
def log_events(sink: Sink, recording: Recording, *, ends: bool = False) -> bool:
    """Log events and skills as text below ``log/``; return whether there are any.

    With ``ends``, the end of the recording is logged as an event.
    """
    import rerun as rr

    lines = log_lines(recording)
    if ends:
        reason = str(recording.episode.info.get("ended", ""))
        lines.append(LogLine("events", len(recording), "the recording ends" + (f" ({reason})" if reason else "")))
    # events of a file need not lie within its steps
    last = len(recording) if ends else max(len(recording) - 1, 0)
    for source in dict.fromkeys(line.source for line in lines):
        group = [line for line in lines if line.source == source]
        levels = ["WARN" if line.warning else "INFO" for line in group]
        columns = rr.TextLog.columns(text=[line.text for line in group], level=levels)
        sink.columns(f"log/{source}", np.clip([line.step for line in group], 0, last), columns)
    return bool(lines)


def log_inputs(sink: Sink, recording: Recording) -> bool:
    """Log raw input of people as text below ``input/``, at the times it arrived; return whether there is any."""
    import rerun as rr

    for user in sorted({event.user for event in recording.inputs}):
        events = [event for event in recording.inputs if event.user == user]
        text = [f"{event.kind} {event.payload}".rstrip() for event in events]
        columns = rr.TextLog.columns(text=text, level=["INFO"] * len(events))
        sink.moments(f"input/user_{user}", np.array([event.time_ns for event in events], np.int64), columns)
    return bool(recording.inputs)


def log_latency(sink: Sink, recording: Recording) -> tuple[str, ...]:
    """Log the round trips of the players of a live session [ms] below ``latency/`` and return their paths."""
    import rerun as rr

    paths = []
    for player in live_inputs(recording):
        if np.isfinite(player.rtt_ms).any():
            name = recording.agents[player.user].name if player.user < len(recording.agents) else f"user_{player.user}"
            sink.columns(f"latency/{name}", None, rr.Scalars.columns(scalars=player.rtt_ms.astype(np.float64)))
            paths.append(sink.path(f"latency/{name}"))
    return tuple(paths)


def following_rows(recording: Recording, robot: int, human: int) -> NDArray[np.bool_]:
    """Return a mask [T] of the rows in which the robot is within 1-2 m of the human and faces them (metric ``w``)."""
    robot_pose, human_pose = (recording.agent_column(agent, "base_pose") for agent in (robot, human))
    return found_series(robot_pose, human_pose, reach_distance(recording, robot, human))["found"]
