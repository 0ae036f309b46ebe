"""The profile ``partnr``: percent complete, state success, offloading, extraneous effort of PARTNR's collaboration tasks.

The evaluator of the task's propositions stores in a recording: ``info["satisfied_at"]``, for each of P propositions the row
in which it first held, -1 = never; ``info["constraints"]``, C lists of P flags, whether each constraint admits each
proposition (absent: no constraints); events of kind ``progress`` (an agent's action made a proposition true) and ``place``
(an agent put something down).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.metrics.episode import Notes
from h3data.metrics.metric import Metric, Series
from h3data.metrics.profile import Computed, Profile
from h3data.metrics.report_layout import ReportLayout
from h3data.metrics.requirements import note_missing
from h3data.recording.records import Recording

COMPLETE = 0.99
"""Percent complete from which PARTNR's analysis counts an episode as done."""
_SOURCE = "PARTNR (2411.00081), "

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
        columns=("info:satisfied_at",),
        optional=("info:constraints",),
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
        columns=("info:satisfied_at",),
        optional=("info:constraints",),
        undefined="Propositions were not evaluated.",
        series=("satisfied_share",),
        binary=True,
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
        columns=("info:satisfied_at", "events:progress"),
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
        columns=("info:satisfied_at",),
        optional=("events:progress", "events:place"),
        undefined="PC < 0.99, as in PARTNR's analysis, or nobody did anything.",
        series=("progress", "place"),
    ),
)


def partnr_series(recording: Recording) -> Series:
    """Computes ``satisfied_share`` [T] of the propositions so far, and flags of rows with ``progress`` and ``place`` events."""
    rows = len(recording)
    series: dict[str, NDArray] = {kind: np.zeros(rows, np.bool_) for kind in ("progress", "place")}
    for event in recording.events:
        if event.kind in series and 0 <= event.step < rows:
            series[event.kind][event.step] = True
    if recording.episode.info.get("satisfied_at") is not None:
        since = _satisfied_at(recording)
        held = (np.arange(rows)[:, None] >= since) & (since != -1)
        series["satisfied_share"] = held.mean(axis=1) if held.shape[1] else np.zeros(rows)
    return series


def compute_partnr(recording: Recording, notes: Notes) -> Computed:
    """Computes the metrics of the profile.

    Raises:
        MissingColumnsError: propositions were not evaluated.
    """
    note_missing(PARTNR, recording, notes)
    complete = percent_complete(_satisfied_at(recording), _constraints(recording))
    progress = [e for e in recording.events if e.kind == "progress"]
    productive = {(e.step, e.agent) for e in progress}
    idle = sum(e.kind == "place" and (e.step, e.agent) not in productive for e in recording.events)
    robots = {i for i, agent in enumerate(recording.agents) if agent.kind == "robot"}
    values = {"PC": complete, "state_success": float(complete == 1)}
    if progress:
        values["offloading"] = sum(e.agent in robots for e in progress) / len(progress)
    if complete < COMPLETE:
        notes.add(("extraneous_effort",), f"the task is not complete (PC = {complete:.2f})")
    elif not progress and not idle:
        notes.add(("extraneous_effort",), "nobody placed anything")
    else:
        values["extraneous_effort"] = idle / (len(progress) + idle)
    return Computed(values=values)


def percent_complete(satisfied_at: NDArray[np.int64], constraints: NDArray[np.bool_]) -> float:
    """Returns the share of the propositions [P] that held and that all constraints [C, P] admit; 0 without propositions."""
    return float(((satisfied_at != -1) & constraints.all(axis=0)).mean()) if len(satisfied_at) else 0.0


def _satisfied_at(recording: Recording) -> NDArray[np.int64]:
    value = recording.episode.info["satisfied_at"]
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


PROFILE = Profile(
    name="partnr",
    title="PARTNR's measures of people and robots tidying up together",
    metrics=PARTNR,
    compute=compute_partnr,
    series=partnr_series,
    report=ReportLayout(
        findings={"PC": "completes this share of the task:", "state_success": "succeeds in"},
        ranking=("PC", "extraneous_effort"),
    ),
)
