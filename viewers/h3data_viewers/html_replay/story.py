"""Events of a recording for the charts, marks and event list of its HTML replay."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.recording import Recording
from h3data.recording.log_lines import SAY, speech
from h3data.recording.records import agent_numbers
from h3data.recording.scans import HEIGHT_M, scans_of
from h3data_viewers.html_replay.packing import Payload
from h3data_viewers.rerun.floor_marks import object_goals, walking_goals
from h3data_viewers.rerun.timeseries import agent_pair, curves_of, is_following, lanes_of, touched_rows

CONTACT_LANES = {"collision": "robot and person", "robot_contact": "robot slides along furniture"}
"""Flags of contact and the names of their lanes. Contact of a robot with furniture and walls is neither an event nor a
collision: it is frequent, and the metric CR counts only contacts of robot and person."""
VERBS = {"pick": "picks up", "place": "puts down", "new_goal": "heads for a new goal", "found": "finds"}
VERBS |= {
    "reacts": "sees the robot and is",
    "reaction_over": "is no longer",
    "walks_to": "walks to",
    "activity": "begins to",
}
"""Words for kinds of events as parts of a sentence; other kinds are shown by their name."""
SCAN_M = 0.01
"""Resolution of the stored distances of laser scans [m]."""
_TITLES = {
    "dist_agents": "Distance",
    "distance_l2": "Distance",
    "geodesic_agents": "Walking distance",
    "facing": "Facing the person (cosine)",
    "reward": "Reward",
}


def add_story(payload: Payload, recording: Recording, rows: NDArray[np.integer]) -> dict[str, Any]:
    """Add the curves of a recording at ``rows``, and return the events for the page's manifest.

    Steps of events are indices into ``rows``.
    """
    return {
        "charts": _charts(payload, recording, rows),
        "lanes": _lanes(recording, rows),
        "events": _events(recording, rows),
        "contacts": _contacts(recording, rows),
        "goals": _goals(recording),
        "walks": [  # the points that people walk to, and from which step on
            {
                "agent": agent,
                "steps": np.clip(np.searchsorted(rows, changed), 0, len(rows) - 1).tolist(),
                "points": points.round(3).tolist(),
            }
            for agent, changed, points in walking_goals(recording)
        ],
        "scans": _scans(payload, recording, rows),
        "says": [
            {"agent": e.agent, "step": _row(rows, e.step), "text": e.detail}
            for e in recording.events
            if e.kind == SAY and 0 <= e.agent < len(recording.agents)
        ][:4000],
    }


def _row(rows: NDArray[np.integer], step: int) -> int:
    """Return the index of the row that shows a step."""
    return int(np.clip(np.searchsorted(rows, step), 0, max(len(rows) - 1, 0)))


# --- charts -----------------------------------------------------------------------------------------------------------
def _charts(payload: Payload, recording: Recording, rows: NDArray[np.integer]) -> list[dict[str, Any]]:
    charts: list[dict[str, Any]] = []
    curves, metres = curves_of(recording)
    distances = [_curve(payload, _title(name), curves[name][rows]) for name in metres]
    if distances:
        # the distances at which the robot follows: metric F of Habitat 3.0
        band = [1.0, 2.0] if is_following(recording) else None
        charts.append({"title": "Distance between the agents", "unit": "m", "curves": distances, "band": band})
    goals = recording.columns.get("metrics.at_goal")
    if goals is not None and goals.ndim == 2:
        title = f"Objects at their goals, of {goals.shape[1]}"
        done = goals[rows].sum(1)
        charts.append({"title": title, "unit": "", "curves": [_curve(payload, "objects", done)], "stairs": True})
    speeds = [_curve(payload, a.name, _speed(recording, k)[rows]) for k, a in enumerate(recording.agents)]
    if speeds:
        charts.append({"title": "Speed", "unit": "m/s", "curves": speeds, "agents": True})
    for name, values in curves.items():
        if name not in metres and values.dtype.kind != "b":
            charts.append({"title": _title(name), "unit": "", "curves": [_curve(payload, _title(name), values[rows])]})
    return charts


def _curve(payload: Payload, name: str, values: NDArray[Any]) -> dict[str, str]:
    values = np.asarray(values, np.float64)
    finite = values[np.isfinite(values)]
    # 4,000 levels: a chart is at most some hundred pixels tall, so finer ones would not show
    step = max((float(np.ptp(finite)) if len(finite) else 0.0) / 4000, 1e-9)
    return {"name": name, "array": payload.add_array(f"curve_{len(payload.entries)}", values, step)}


def _title(name: str) -> str:
    return _TITLES.get(name) or _words(name).capitalize()


def _speed(recording: Recording, agent: int) -> NDArray[np.float64]:
    """Return the speed over the floor of an agent [m/s], over a fifth of a second, so that it does not flicker."""
    time_s = recording.columns["time_ns"].astype(np.float64) * 1e-9
    xz = recording.agent_column(agent, "base_pose")[:, [0, 2]].astype(np.float64)
    if len(xz) < 2:
        return np.zeros(len(xz))
    # three steps of 1/30 s to each side
    before, after = np.maximum(np.arange(len(xz)) - 3, 0), np.minimum(np.arange(len(xz)) + 3, len(xz) - 1)
    return np.linalg.norm(xz[after] - xz[before], axis=1) / np.maximum(time_s[after] - time_s[before], 1e-9)


# --- lanes and events -------------------------------------------------------------------------------------------------
def _lanes(recording: Recording, rows: NDArray[np.integer]) -> list[dict[str, Any]]:
    lanes = dict(lanes_of(recording))
    for flag, name in CONTACT_LANES.items():
        values = touched_rows(recording) if flag == "collision" else recording.columns.get(f"metrics.{flag}")
        # the lane of encounters has contacts of robot and person already
        twice = flag == "collision" and "encounter" in lanes
        if values is not None and values.ndim == 1 and values.any() and not twice:
            lanes[name] = ["contact" if value else "-" for value in values.tolist()]
    out = []
    for name, states in lanes.items():
        # runs are found among the kept states: a state between two of them cannot be shown
        kept = [states[row] for row in rows]
        # each state once, and numbers of them in the runs: lanes repeat a few words thousands of times
        values = list(dict.fromkeys(kept))
        runs = [[k, values.index(s)] for k, s in enumerate(kept) if k == 0 or s != kept[k - 1]]
        out.append({"name": _words(name), "states": [_words(v) if v != "-" else "" for v in values], "runs": runs})
    return out


def _events(recording: Recording, rows: NDArray[np.integer]) -> list[dict[str, Any]]:
    names = [agent.name for agent in recording.agents]
    events: list[tuple[int, str, str]] = []
    for event in recording.events:
        who = names[event.agent] if 0 <= event.agent < len(names) else ""
        # details of Habitat's events are JSON with numbers of users and objects
        detail = f"({event.detail.strip('()')})" if event.detail and not event.detail.startswith("{") else ""
        text = " ".join(part for part in (who, VERBS.get(event.kind, _words(event.kind)), event.target, detail) if part)
        text = speech(event, names) if event.kind == SAY else text
        kind = (
            "bad"
            if "collision" in event.kind or "fail" in event.kind
            else "good"
            if event.kind == "success"
            else "event"
        )
        events.append((event.step, kind, text[:1].upper() + text[1:]))
    for span in recording.skills:
        who = names[span.agent] if 0 <= span.agent < len(names) else "?"
        skill = f"{who}: {_words(span.name)} {span.target}".strip()
        events.append((span.start_step, "skill", f"{skill}, started"))
        if span.outcome != "running":
            failed = span.outcome in ("failed", "aborted")
            reason = f" ({span.reason})" if span.reason else ""
            events.append((span.end_step, "skill-bad" if failed else "skill", f"{skill}, {span.outcome}{reason}"))
    # a contact that an event tells of is not listed again; the flag may begin a step before or after the event
    said = [event.step for event in recording.events if "collision" in event.kind]
    touches = [row for row in _touches(recording) if all(abs(row - step) > 1 for step in said)]
    events += [(row, "bad", "Robot and person touch") for row in touches]
    events.sort(key=lambda event: event[0])
    return [
        {"step": _row(rows, step), "kind": kind, "text": text}
        for step, kind, text in events[:4000]  # more would make the page's list slow
    ]


def _touches(recording: Recording) -> list[int]:
    """Return rows at which robot and person begin to touch."""
    return np.flatnonzero(np.diff(touched_rows(recording).astype(np.int8), prepend=0) > 0).tolist()


# --- marks ------------------------------------------------------------------------------------------------------------
def _contacts(recording: Recording, rows: NDArray[np.integer]) -> list[dict[str, Any]]:
    """Return the places where contacts begin: half-way between robot and the person whom it touches."""
    pair = agent_pair(recording)
    people = agent_numbers(recording.agents, "human")
    whom = recording.columns.get("metrics.collision_people")
    marks = []
    for row in _touches(recording) if pair is not None else ():
        both = pair if whom is None or pair is None else (pair[0], people[int(np.argmax(whom[row]))])
        points = [recording.agent_column(k, "base_pose")[row, :3].astype(np.float64) for k in both or ()]
        if np.isfinite(points).all():
            step = int(np.clip(np.searchsorted(rows, row), 0, len(rows) - 1))
            marks.append({"step": step, "text": "contact", "point": np.mean(points, 0).round(3).tolist()})
    return marks


def _goals(recording: Recording) -> list[dict[str, Any]]:
    positions, labels = object_goals(recording)
    info = recording.episode.info.get("goals")
    named = info if isinstance(info, list | tuple) else []
    goals = []
    for k, position in enumerate(positions):
        goal = named[k] if k < len(named) and isinstance(named[k], dict) else {}
        label = str(goal.get("to") or (labels[k] if k < len(labels) else ""))
        name = str(goal.get("object", ""))
        named_goal = {"label": _thing(label), "object": name, "name": _thing(name)}
        goals.append({"position": position.round(3).tolist(), **named_goal})
    return goals


def _scans(payload: Payload, recording: Recording, rows: NDArray[np.integer]) -> list[dict[str, Any]]:
    """Add what laser scanners measured at ``rows``."""
    scans = []
    for number, scan in enumerate(scans_of(recording)):
        # a ray that meets nothing ends at the range of the scanner: the payload takes rows with NaN for absent ones
        ranges = np.nan_to_num(np.minimum(scan.ranges[rows], scan.max_m), nan=scan.max_m, posinf=scan.max_m)
        track = payload.add_array(f"scan_{number}", ranges.astype(np.float64), SCAN_M)
        scans.append({"agent": scan.agent, "track": track, "most": scan.max_m, "height": HEIGHT_M})
    return scans


# --- words ------------------------------------------------------------------------------------------------------------
def _words(name: str) -> str:
    return name.replace("_", " ").strip()


def _thing(name: str) -> str:
    """Return the name of a thing in words, such as kitchen counter for ``kitchen_counter_0|top``."""
    return _words(re.sub(r"_\d+$", "", name.partition("|")[0]))
