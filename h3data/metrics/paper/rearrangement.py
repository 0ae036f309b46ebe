"""Metrics of social rearrangement as in the paper: SR, RE, CR, RC and TS.

They read ``metrics.at_goal`` bool [T, K], which states whether each of K objects is at its goal
(``info["goal_objects"]`` holds the K object indices, as in ``agent_<i>.grasp_body``), ``agent_<i>.grasp_body`` of every
agent, ``metrics.collision``, ``info["max_steps"]`` (E) and ``info["solo_steps"]`` (steps that the person needs alone in
the same episode). If Habitat itself determined success, as in imported sessions, ``metrics.success`` bool [T] is read
instead of ``metrics.at_goal``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.metrics.episode import Notes, first_moments
from h3data.metrics.metric import INF, NAN, Metric, Series
from h3data.metrics.paper.protocol import REARRANGEMENT_PROTOCOL, protocol_deviations
from h3data.metrics.profile import Computed
from h3data.metrics.requirements import OR, note_missing
from h3data.recording.records import Recording, agent_numbers

AT_GOAL, SUCCESS = "metrics.at_goal", "metrics.success"
_DONE = f"{SUCCESS}{OR}{AT_GOAL}"
_NO_ROWS = "The recording has no rows. "

REARRANGEMENT: tuple[Metric, ...] = (
    Metric(
        id="paper/rearrange/SR@1",
        name="SR",
        title="Success rate",
        formula="SR = 1 if all objects are at their goals in a row within E, else 0",
        unit="1",
        range=(0.0, 1.0),
        direction="higher",
        source="Habitat 3.0, section 4.2 'Metrics'",
        columns=(_DONE,),
        optional=("info:max_steps",),
        undefined=_NO_ROWS,
        series=("done", "at_goal_count"),
        binary=True,
        reading=(
            "E is info:max_steps (750 in the paper); rows after it do not count. metrics.success, where recorded, decides: "
            "it is Habitat's pddl_success in imported sessions."
        ),
        habitat="pddl_success at the last step, which also asks that nothing is held; success ends its episodes.",
    ),
    Metric(
        id="paper/rearrange/RE@1",
        name="RE",
        title="Relative efficiency",
        formula="RE = 100 * L_human / min(L_joint, E)",
        unit="%",
        range=(0.0, INF),
        direction="higher",
        source="Habitat 3.0, section 4.2 'Metrics'",
        columns=(_DONE, "info:solo_steps"),
        optional=("info:max_steps",),
        undefined=_NO_ROWS + "The steps of the person alone are not recorded.",
        series=("done",),
        reading=(
            "The paper prints L_human / max(L_joint, E), which never exceeds 100%, while its tables hold 159%. Read as "
            "min: L_joint is the number of steps until success; an episode without success counts E. Where L_human is E, the "
            "person alone did not finish: a note says that RE is a lower bound."
        ),
        habitat="Not computed in either repository.",
    ),
    Metric(
        id="paper/rearrange/CR@2",
        name="CR",
        title="Collision rate",
        formula="CR = 1 if a robot touches the human in any row, else 0",
        unit="1",
        range=(0.0, 1.0),
        direction="lower",
        source="Habitat 3.0, section 4.2 'Metrics'",
        columns=("metrics.collision",),
        undefined=_NO_ROWS + "No column metrics.collision, with a robot there.",
        series=("collision",),
        binary=True,
        reading="Without a robot it is 0, as the paper's row Solo has it.",
        habitat="did_collide at the last step; equal while a contact ends the episode.",
    ),
    Metric(
        id="paper/rearrange/RC@1",
        name="RC",
        title="Ratio of completion by the robot",
        formula="RC = placed objects that a robot held last / placed objects",
        unit="1",
        range=(0.0, 1.0),
        direction="neither",
        source="Habitat 3.0, section 4.2 'Metrics'",
        columns=(AT_GOAL, "agent_<i>.grasp_body", "info:goal_objects"),
        undefined="There is no robot, no object is at its goal in the last row, or nobody held those that are.",
        series=("at_goal_count",),
        reading=(
            "Placed: at its goal in the last row and not from the start. The credit goes to the agent that held the object "
            "last before the row from which it stayed at its goal; an object that nobody held counts for neither."
        ),
        habitat="Not computed; ratio_agent_0 of PARTNR's analysis is similar.",
    ),
    Metric(
        id="paper/rearrange/TS@2",
        name="TS",
        title="Task completion steps",
        formula="TS = steps until success; undefined without success",
        unit="steps",
        range=(0.0, INF),
        direction="lower",
        source="Habitat 3.0, section 4.3 'task completion steps', appendix 'HITL Evaluation'",
        columns=(_DONE,),
        optional=("info:max_steps",),
        undefined=_NO_ROWS + "The task is not completed within E.",
        series=("done",),
        reading=(
            "An episode that ends early, by a contact or otherwise, has not completed the task: its length is no TS. The "
            "paper shows TS over successful episodes (all of its participants' were). TS@1 took the length of the episode."
        ),
        habitat="num_steps at the last step, whether the task is completed or not.",
    ),
)


def rearrangement_series(recording: Recording) -> Series:
    """Compute ``done`` (the task is completed), ``at_goal_count`` and ``collision``, each [T], as far as recorded."""
    series: dict[str, NDArray] = {}
    if AT_GOAL in recording.columns:
        at_goal = _at_goal(recording)
        # `all` of no objects is true
        series["done"] = at_goal.all(axis=1) & (at_goal.shape[1] > 0)
        series["at_goal_count"] = at_goal.sum(axis=1).astype(np.float64)
    if SUCCESS in recording.columns:
        # not astype(bool), which takes NaN for true: imported columns have it where nothing was logged
        series["done"] = recording.columns[SUCCESS] > 0
    if "metrics.collision" in recording.columns:
        series["collision"] = recording.columns["metrics.collision"].astype(np.bool_)
    return series


def compute_rearrangement(recording: Recording, notes: Notes) -> Computed:
    """Compute SR, RE, CR, RC and TS.

    Raises:
        MissingColumnsError: the recording has none of the columns.
    """
    # a person alone cannot touch a robot: CR is 0 without a column of contacts
    alone = bool(recording.agents) and not agent_numbers(recording.agents, "robot")
    missing = note_missing([m for m in REARRANGEMENT if not (alone and m.name == "CR")], recording, notes)
    deviations = protocol_deviations(recording, REARRANGEMENT_PROTOCOL)
    if not len(recording):
        notes.add((m.name for m in REARRANGEMENT), "the recording has no rows")
        return Computed(values={}, protocol_deviations=deviations)
    values: dict[str, float] = {}
    series = rearrangement_series(recording)
    if "done" in series:
        steps, solved, limit = _steps(recording, series["done"], notes)
        values |= {"SR": float(solved), "TS": float(steps) if solved else NAN}
        if not solved:
            notes.add(("TS",), "the task is not completed")
        if "RE" not in missing:
            # an episode without success counts E, however early it ended
            values["RE"] = _efficiency(recording, steps if solved else limit, limit, notes)
        elif recording.episode.info.get("participant"):
            notes.add(("RE",), "for people it follows from the estimated means of TS, see h3data report")
    if "RC" not in missing:
        values["RC"] = _robot_share(recording, notes)
    if alone:
        values["CR"] = 0.0
    elif "collision" in series:
        values["CR"] = float(series["collision"].any())
    moments = first_moments(series, ("done", "collision"))
    return Computed(values=values, moments=moments, protocol_deviations=deviations)


def _steps(recording: Recording, done: NDArray[np.bool_], notes: Notes) -> tuple[int, bool, int]:
    """Return the steps until success or the end, whether success came in time, and the limit E."""
    limit = recording.episode.info.get("max_steps")
    if not isinstance(limit, int) or limit < 1:
        limit = len(done)
        notes.add(("SR", "RE", "TS"), f"the longest duration E is not recorded (info max_steps): {limit} rows taken")
    in_time = done[:limit]
    solved = bool(in_time.any())
    # row k is the state after step k + 1
    return (int(np.argmax(in_time)) + 1 if solved else len(in_time)), solved, limit


def _efficiency(recording: Recording, joint_steps: int, limit: int, notes: Notes) -> float:
    solo = recording.episode.info["solo_steps"]
    # `not solo >= 1` also refuses NaN
    if isinstance(solo, bool) or not isinstance(solo, int | float) or not solo >= 1:
        notes.add(("RE",), f"info solo_steps must be a number of at least 1, is {solo!r}")
        return NAN
    if solo >= limit:
        notes.add(("RE",), f"censored: the person alone did not finish before E = {limit}, so RE is a lower bound")
    return 100.0 * float(solo) / joint_steps


def _robot_share(recording: Recording, notes: Notes) -> float:
    """Return the robots' share of the objects that were carried to their goals."""
    at_goal = _at_goal(recording)
    objects = recording.episode.info["goal_objects"]
    if len(objects) != at_goal.shape[1]:
        raise InputError(
            f"Episode {recording.episode.episode_id!r}: {AT_GOAL} has {at_goal.shape[1]} objects, info goal_objects "
            f"names {len(objects)}.",
            code="H3-METRIC-015",
        )
    if not agent_numbers(recording.agents, "robot"):
        notes.add(("RC",), "there is no robot")
        return NAN
    credits = [
        credit for k, body in enumerate(objects) if (credit := _carrier(recording, at_goal[:, k], body)) is not None
    ]
    if not credits:
        notes.add(("RC",), "no object was carried to its goal")
        return NAN
    return sum(recording.agents[agent].kind == "robot" for agent in credits) / len(credits)


def _carrier(recording: Recording, at_goal: NDArray[np.bool_], body: int) -> int | None:
    """Return the index of the agent that last held a placed object before it stayed at its goal.

    The result is None if the object was not placed, or never held.
    """
    # an object that was at its goal all along was carried by nobody
    if not at_goal[-1] or at_goal.all():
        return None
    placed = len(at_goal) - int(np.argmin(at_goal[::-1]))  # from this row on it stays there
    # the row of success counts too: an object may be let go in the step in which it reaches its goal
    last, carrier = -1, None
    for i in range(len(recording.agents)):
        held = recording.columns.get(f"agent_{i}.grasp_body")
        rows = np.flatnonzero(held[: placed + 1] == body) if held is not None else []
        if len(rows) and rows[-1] > last:
            last, carrier = int(rows[-1]), i
    return carrier


def _at_goal(recording: Recording) -> NDArray[np.bool_]:
    column = recording.columns[AT_GOAL]
    return column.astype(np.bool_).reshape(len(column), -1)
