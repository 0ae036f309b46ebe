"""Profile ``partnr`` with percent complete, success, steps, offloading and extraneous effort of PARTNR's tasks.

For a recording with propositions (`h3data_language.evaluation.records`) and the layout of its home, the profile
evaluates when each proposition was satisfied. Other recordings contain results of their simulator's evaluator:
``info["satisfied_at"]``, for each of P propositions the row in which it first held, -1 = never;
``info["constraints"]``, C lists of P flags, whether each constraint admits each proposition (absent: no constraints);
events of kind ``progress`` (an agent's action made a proposition true) and ``place`` (an agent put something down).

``partnr@habitat`` evaluates propositions as PARTNR's code does, including its faults.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.metrics.episode import Notes
from h3data.metrics.metric import INF, Metric, Series
from h3data.metrics.profile import Computed, Profile
from h3data.metrics.report_layout import ReportLayout
from h3data.metrics.requirements import UnmeasurableError, note_missing
from h3data.recording.records import Event, Recording, agent_numbers
from h3data_language.evaluation.engine import STATE_COLUMNS, Verdict, evaluate, rows_of
from h3data_language.evaluation.layout import LAYOUT, Layout
from h3data_language.evaluation.records import PROPOSITIONS, Evaluation

COMPLETE = 0.99
"""Percentage of completion from which PARTNR's analysis counts an episode as done."""
_SOURCE = "PARTNR (2411.00081), "
_FOUND = f"info:{PROPOSITIONS} or info:satisfied_at"
_READ = (
    "info:constraints",
    "object_pose",
    "agent_<i>.grasp_body",
    *STATE_COLUMNS.values(),
    *(f"events:{kind}" for kind in ("progress", "place", "pick", "state")),
)

PARTNR: tuple[Metric, ...] = (
    Metric(
        id="partnr/any/PC@1",
        name="PC",
        title="Percent complete",
        formula="PC = mean over propositions of [satisfied_at != -1 and every constraint admits it]",
        unit="1",
        range=(0.0, 1.0),
        direction="higher",
        source=_SOURCE + "task_percent_complete",
        columns=(_FOUND,),
        optional=_READ,
        undefined="Propositions were not evaluated.",
        series=("satisfied_share",),
        reading="0 without propositions, as in PARTNR.",
    ),
    Metric(
        id="partnr/any/state_success@1",
        name="state_success",
        title="State success",
        formula="1 if PC = 1, else 0",
        unit="1",
        range=(0.0, 1.0),
        direction="higher",
        source=_SOURCE + "task_state_success",
        columns=(_FOUND,),
        optional=_READ,
        undefined="Propositions were not evaluated.",
        series=("satisfied_share",),
        binary=True,
    ),
    Metric(
        id="partnr/any/steps@1",
        name="steps",
        title="Steps",
        formula="rows of the recording",
        unit="steps",
        range=(0.0, INF),
        direction="lower",
        source=_SOURCE + "table 3, sim steps",
        columns=(_FOUND,),
        undefined="Propositions were not evaluated.",
        series=("satisfied_share",),
    ),
    Metric(
        id="partnr/any/exploration@1",
        name="exploration",
        title="Exploration",
        formula="row of the first event pick",
        unit="steps",
        range=(0.0, INF),
        direction="lower",
        source=_SOURCE + "table 3, exploration efficiency",
        columns=(_FOUND, "events:pick"),
        undefined="Nobody took anything.",
        series=("progress",),
    ),
    Metric(
        id="partnr/any/offloading@1",
        name="offloading",
        title="Offloading",
        formula="progress events of robots / progress events",
        unit="1",
        range=(0.0, 1.0),
        direction="neither",
        source=_SOURCE + "ratio_agent_0",
        columns=(_FOUND,),
        optional=_READ,
        undefined="Nobody made progress.",
        series=("progress",),
    ),
    Metric(
        id="partnr/any/extraneous_effort@1",
        name="extraneous_effort",
        title="Extraneous effort",
        formula="u / (progress events + u), u = place events without a progress event of that agent in that row",
        unit="1",
        range=(0.0, 1.0),
        direction="lower",
        source=_SOURCE + "ratio_extraneous_actions",
        columns=(_FOUND,),
        optional=_READ,
        undefined="PC < 0.99, as in PARTNR's analysis, or nobody did anything.",
        series=("progress", "place"),
    ),
)


class Progress(NamedTuple):
    """Satisfied propositions of a recording, and the agents that satisfied them."""

    satisfied_at: NDArray[np.int64]
    """Row in which each proposition was first satisfied; -1 = never, [P]."""
    admitted: NDArray[np.bool_]
    """True for propositions that each constraint admits, bool [C, P]."""
    events: list[Event]
    """Events of the kind ``progress``."""
    explanation: str = ""
    """Sentences about the propositions that are not completed, if h3data evaluated them."""


def progress_of(recording: Recording, *, bugs: bool = False) -> Progress:
    """Return the progress in a recording: evaluated from its propositions, or as its simulator recorded it.

    Raises:
        InputError: propositions or stored results are malformed.
    """
    info, events = recording.episode.info, recording.events
    if info.get(LAYOUT) is None:
        stored = [e for e in events if e.kind == "progress"]
        return Progress(_satisfied_at(recording), _constraints(recording), stored)
    verdict = verdict_of(recording, bugs=bugs)
    acted = [e for e in events if e.kind in ("place", "state", "state_change")]
    found = []
    for p, row in zip(verdict.evaluation.propositions, verdict.satisfied_at.tolist(), strict=True):
        about = {name for names in p.things for name in names}
        by = [e for e in acted if abs(e.step - row) <= 1 and e.target in about]
        found += [Event(step=e.step, agent=e.agent, kind="progress", target=e.target) for e in by[-1:] if row >= 0]
    return Progress(verdict.satisfied_at, verdict.admitted, found, verdict.explanation)


def verdict_of(recording: Recording, *, bugs: bool = False) -> Verdict:
    """Evaluate the propositions of a recording that has them and the layout of its home.

    Raises:
        InputError: propositions are malformed, or name things that do not exist.
    """
    info = recording.episode.info
    return evaluate(Evaluation.of(info, bugs=bugs), rows_of(recording, Layout.of_info(info), bugs=bugs))


def partnr_series(recording: Recording, *, bugs: bool = False) -> Series:
    """Compute ``satisfied_share`` [T] of the propositions so far, and flags of rows with ``progress`` and ``place`` events."""
    rows, info = len(recording), recording.episode.info
    series: dict[str, NDArray] = {kind: np.zeros(rows, np.bool_) for kind in ("progress", "place")}
    known = info.get("satisfied_at") is not None or info.get(LAYOUT) is not None
    progress = progress_of(recording, bugs=bugs) if known else None
    for event in (*(e for e in recording.events if e.kind == "place"), *(progress.events if progress else ())):
        if 0 <= event.step < rows:
            series[event.kind][event.step] = True
    if progress is not None:
        since = progress.satisfied_at
        held = (np.arange(rows)[:, None] >= since) & (since != -1)
        series["satisfied_share"] = held.mean(axis=1) if held.shape[1] else np.zeros(rows)
    return series


def compute_partnr(recording: Recording, notes: Notes, *, metrics: tuple[Metric, ...], bugs: bool = False) -> Computed:
    """Compute the metrics of the profile.

    Raises:
        MissingColumnsError: there are neither propositions nor stored results.
        UnmeasurableError: propositions are malformed, or name things that do not exist.
    """
    if not len(recording):  # the place of an episode that failed
        notes.add((m.name for m in metrics), "the recording has no rows")
        return Computed(values={})
    note_missing(metrics, recording, notes)
    try:
        found = progress_of(recording, bugs=bugs)
    except InputError as fault:  # of one recording of many, which are measured all the same
        raise UnmeasurableError(str(fault), str(fault), code=fault.code) from None
    complete = percent_complete(found.satisfied_at, found.admitted)
    productive = {(e.step, e.agent) for e in found.events}
    idle = sum(e.kind == "place" and (e.step, e.agent) not in productive for e in recording.events)
    robots = set(agent_numbers(recording.agents, "robot"))
    values = {"PC": complete, "state_success": float(complete == 1), "steps": float(len(recording))}
    picks = [e.step for e in recording.events if e.kind == "pick"]
    if picks:
        values["exploration"] = float(min(picks))
    if found.explanation:
        notes.add(("PC",), found.explanation)
    if found.events:
        values["offloading"] = sum(e.agent in robots for e in found.events) / len(found.events)
    else:
        notes.add(("offloading",), "nobody made progress")
    if complete < COMPLETE:
        notes.add(("extraneous_effort",), f"the task is not complete (PC = {complete:.2f})")
    elif not found.events and not idle:
        notes.add(("extraneous_effort",), "nobody placed anything")
    else:
        values["extraneous_effort"] = idle / (len(found.events) + idle)
    return Computed(values=values)


def percent_complete(satisfied_at: NDArray[np.int64], constraints: NDArray[np.bool_]) -> float:
    """Return the share of propositions [P] that were true and that all constraints [C, P] admit; 0 without any."""
    return float(((satisfied_at != -1) & constraints.all(axis=0)).mean()) if len(satisfied_at) else 0.0


def _satisfied_at(recording: Recording) -> NDArray[np.int64]:
    value = recording.episode.info.get("satisfied_at")
    try:
        rows = np.asarray(value, np.int64).reshape(-1)
    except (TypeError, ValueError, OverflowError):
        raise InputError(
            f"Episode {recording.episode.episode_id!r}: expected info satisfied_at to be a list of rows, got {value!r}.",
            code="H3-METRIC-018",
        ) from None
    if rows.size and rows.min() < -1:
        raise InputError(
            f"Episode {recording.episode.episode_id!r}: info satisfied_at has rows below -1.", code="H3-METRIC-016"
        )
    return rows


def _constraints(recording: Recording) -> NDArray[np.bool_]:
    count = len(_satisfied_at(recording))
    given = recording.episode.info.get("constraints") or []
    if not isinstance(given, list | tuple) or any(not isinstance(c, list | tuple) or len(c) != count for c in given):
        raise InputError(
            f"Episode {recording.episode.episode_id!r}: expected info constraints to be lists of {count} flags, one for each "
            "proposition.",
            code="H3-METRIC-017",
        )
    return np.array(given, np.bool_).reshape(len(given), count)


def _profile(name: str, title: str, *, bugs: bool) -> Profile:
    metrics = tuple(replace(m, id=m.id.replace("partnr/", f"{name}/", 1)) for m in PARTNR)
    return Profile(
        name=name,
        title=title,
        metrics=metrics,
        compute=partial(compute_partnr, metrics=metrics, bugs=bugs),
        series=partial(partnr_series, bugs=bugs),
        report=ReportLayout(
            findings={"PC": "completes this share of the task:", "state_success": "succeeds in"},
            ranking=("PC", "extraneous_effort"),
        ),
    )


PROFILE = _profile("partnr", "PARTNR's measures of people and robots tidying up together", bugs=False)
HABITAT_PROFILE = _profile("partnr@habitat", "The same, with propositions as PARTNR's code evaluates them", bugs=True)
