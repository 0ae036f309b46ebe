"""Evaluation of when propositions were satisfied in a recording, and which constraints admit them.

Dependencies are conditions on earlier rows, and constraints on the rows in which propositions were first true; both
follow PARTNR (Chang et al. 2024, section 3 and appendix).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.recording.records import Recording
from h3data_language.evaluation.layout import Layout
from h3data_language.evaluation.predicates import Flags, Rows, members_of, truth_of
from h3data_language.evaluation.records import ARGUMENTS, Constraint, Dependency, Evaluation, Proposition

Names = AbstractSet[str]
STATE_COLUMNS = {state: f"object_state.{state}" for state in ("clean", "filled", "powered")}
"""Columns with the states of things, bool [T, K]."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Evaluation of one recording."""

    evaluation: Evaluation
    satisfied_at: NDArray[np.int64]
    """Row in which each proposition was first satisfied; -1 = never, [P]."""
    admitted: Flags
    """True for propositions that each constraint admits, bool [C, P]."""
    satisfied: Flags
    """True for propositions that are satisfied in each row, bool [T, P]."""

    @property
    def complete(self) -> Flags:
        """True for propositions that count as completed, bool [P]."""
        return (self.satisfied_at >= 0) & self.admitted.all(0)

    @property
    def percent_complete(self) -> float:
        """Share of the propositions that were satisfied and that all constraints admit; 0 without propositions."""
        return float(self.complete.mean()) if len(self.complete) else 0.0

    @property
    def explanation(self) -> str:
        """Sentences about the propositions that are not completed; empty if all are completed."""
        lines = []
        for k, p in enumerate(self.evaluation.propositions):
            if self.satisfied_at[k] < 0:
                lines.append(f"{describe(p)} was never satisfied")
            for c, admits in zip(self.evaluation.constraints, self.admitted, strict=True):
                if self.satisfied_at[k] >= 0 and not admits[k]:
                    lines.append(f"{describe(p)} {_REASONS[c.type]}")
        return "; ".join(lines)


_REASONS = {
    "TemporalConstraint": "came before something that has to be done first",
    "TerminalSatisfactionConstraint": "was satisfied, and not any more at the end",
    "SameArgConstraint": "was satisfied elsewhere than what belongs with it",
    "DifferentArgConstraint": "was satisfied where something else was",
}


def describe(p: Proposition) -> str:
    """Return a short description of a proposition, such as ``is on top (1 of mug_0, mug_1; table_0)``."""
    things = "; ".join(", ".join(names) for names in p.things)
    count = f"{p.number} of " if len(p.things[0]) > 1 and isinstance(p.number, int) else ""
    return f"{p.function_name.replace('_', ' ')} ({count}{things})"


def rows_of(recording: Recording, layout: Layout, *, bugs: bool = False) -> Rows:
    """Return the rows of a recording that propositions are about.

    Raises:
        InputError: the recording lacks poses of things, or has poses of other things.
    """
    poses = recording.columns.get("object_pose")
    if poses is None or poses.shape[1:] != (len(layout.things), 7):
        shape = None if poses is None else list(poses.shape)
        raise InputError(
            f"Expected object_pose [T, {len(layout.things)}, 7] for the propositions of episode "
            f"{recording.episode.episode_id!r}, got {shape}.",
            code="H3-LANGUAGE-001",
        )
    bodies = np.array([thing.body for thing in layout.things.values()], np.int64)
    held = np.zeros(poses.shape[:2], np.bool_)
    for k in range(len(recording.agents)):
        grasp = recording.columns.get(f"agent_{k}.grasp_body")
        if grasp is not None:
            held |= grasp[:, None] == bodies
    states = {name: recording.columns[column] for name, column in STATE_COLUMNS.items() if column in recording.columns}
    for name, flags in states.items():
        if flags.shape != held.shape:
            raise InputError(
                f"Expected {STATE_COLUMNS[name]} {list(held.shape)} in episode {recording.episode.episode_id!r}, "
                f"got {list(flags.shape)}.",
                code="H3-LANGUAGE-002",
            )
    return Rows(layout, poses, held, states, bugs)


def evaluate(evaluation: Evaluation, rows: Rows) -> Verdict:
    """Evaluate propositions over rows.

    Raises:
        InputError: a proposition names what does not exist.
    """
    few, stands_for = rows.distinct()
    found = [truth_of(p, few) for p in evaluation.propositions]
    count, steps = len(found), len(rows.poses)
    truth = np.stack([t for t, _ in found], 1)[stands_for] if found else np.zeros((steps, 0), np.bool_)
    satisfied = _asked(evaluation, truth) if evaluation.dependencies else truth
    first = np.where(satisfied.any(0), satisfied.argmax(0), -1) if steps else np.full(count, -1)
    terminal = (satisfied if rows.bugs else truth)[-1] if steps else np.zeros(count, np.bool_)
    chosen = [
        _arguments(p, some[stands_for[row]], rows.bugs) if row >= 0 else {}
        for p, (_, some), row in zip(evaluation.propositions, found, first, strict=True)
    ]
    admitted = [_admits(c, first, terminal, chosen) for c in evaluation.constraints]
    return Verdict(
        evaluation=evaluation,
        satisfied_at=first.astype(np.int64),
        admitted=np.array(admitted, np.bool_).reshape(len(admitted), count),
        satisfied=satisfied,
    )


# --- dependencies -----------------------------------------------------------------------------------------------------
def _asked(evaluation: Evaluation, truth: Flags) -> Flags:
    """Return the truth of propositions in the rows in which their dependencies have them asked."""
    needs: dict[int, list[Dependency]] = {k: [] for k in range(truth.shape[1])}
    for dependency in evaluation.dependencies:
        for k in dependency.proposition_indices:
            needs[k].append(dependency)
    graph = {k: {on for d in each for on in d.depends_on} for k, each in needs.items()}
    result = np.zeros_like(truth)
    try:
        order = tuple(TopologicalSorter(graph).static_order())
    except CycleError:  # the rows before decide, so even a circle has a meaning
        for t in range(len(truth)):
            for k, each in needs.items():
                result[t, k] = truth[t, k] and all(_relation(d, result[:t])[-1] for d in each)
        return result
    for k in order:
        asked = np.ones(len(truth), np.bool_)
        for dependency in needs[k]:
            asked &= _relation(dependency, result)[: len(truth)]
        result[:, k] = truth[:, k] & asked
    return result


def _relation(d: Dependency, satisfied: Flags) -> Flags:
    """Return whether the rows before each row, and before the one after the last, have the relation of a dependency [T + 1]."""
    now = np.concatenate([np.zeros((1, len(d.depends_on)), np.bool_), satisfied[:, d.depends_on]])
    ever = np.logical_or.accumulate(now)
    holds = {
        "while_satisfied": now,
        "after_satisfied": ever,
        "after_unsatisfied": np.logical_or.accumulate(np.concatenate([now[:1], now[:-1] & ~now[1:]])),
        "before_satisfied": ~ever,
    }[d.relation_type]
    return holds.any(1) if d.dependency_mode == "any" else holds.all(1)


# --- constraints ------------------------------------------------------------------------------------------------------
def _admits(c: Constraint, first: NDArray[np.int64], terminal: Flags, chosen: Sequence[Mapping[str, Names]]) -> Flags:
    admits = np.ones(len(first), np.bool_)
    if c.type == "TemporalConstraint":
        before = np.zeros((len(first), len(first)), np.bool_)
        for earlier, later in c.edges:
            before[earlier, later] = True
        for k in range(len(first)):  # ancestors of ancestors
            before |= before[:, k, None] & before[None, k]
        in_order = (first[:, None] >= 0) & (first[:, None] < first)
        return (in_order | ~before).all(0) | (first < 0)
    if c.type == "TerminalSatisfactionConstraint":
        admits[c.indices] = terminal[c.indices] | (first[c.indices] < 0)
        return admits
    named = zip(c.indices, c.args["arg_names"], c.args["counts_of"], strict=True)
    # the first one in time is right, whatever it has, and those after it are compared with it or with all before
    known = sorted(((first[k], k, chosen[k][name], of) for k, name, of in named if first[k] >= 0), key=itemgetter(0))
    for n, (_, k, names, of) in enumerate(known):
        if c.type == "SameArgConstraint":
            admits[k] &= not names.isdisjoint(known[0][2])
        else:
            admits[k] &= all(names.isdisjoint(other) for _, _, other, others in known[:n] if others != of)
    return admits


def _arguments(p: Proposition, pairs: Flags, bugs: bool) -> dict[str, Names]:
    """Return things by which a proposition became true, by argument, from its pairs [A, B] then, or a cluster's members [N].

    PARTNR compares two handles as if they were lists, by their letters; with ``bugs``, names are sets of letters.
    """
    if p.function_name == "is_clustered":
        members = {name for name, inside in zip(members_of(p), pairs, strict=True) if inside}
        return {f"*args_{n}": members & set(group) for n, group in enumerate(p.things)}
    if p.is_same:
        b = int(np.argmax(pairs.sum(0) >= p.number))
        at = int(np.flatnonzero(pairs[:, b])[p.number - 1]), b
    else:
        counted = pairs if bugs else pairs & (np.cumsum(pairs, 1) == 1)
        at = tuple(np.argwhere(counted)[p.number - 1])
    names = [listed[k] for listed, k in zip(p.things, at, strict=False)]
    return {key: set(name) if bugs else {name} for key, name in zip(ARGUMENTS[p.function_name], names, strict=True)}
