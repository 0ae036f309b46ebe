"""Checked propositions, dependencies and constraints in PARTNR's JSON, with counted propositions unrolled.

A recording carries them in its info, under the names of PARTNR's episode files: ``evaluation_propositions``,
``evaluation_proposition_dependencies`` and ``evaluation_constraints`` (Chang et al. 2024, 2411.00081).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from typing import Any, Literal

import msgspec

from h3data.errors import InputError, suggest

PROPOSITIONS, DEPENDENCIES, CONSTRAINTS = (
    "evaluation_propositions",
    "evaluation_proposition_dependencies",
    "evaluation_constraints",
)
STATES = {
    "is_clean": ("clean", True),
    "is_dirty": ("clean", False),
    "is_filled": ("filled", True),
    "is_empty": ("filled", False),
    "is_powered_on": ("powered", True),
    "is_powered_off": ("powered", False),
}
"""Name and value of the state that each proposition about states requires."""
THEIR_STATES = {state: name for name, (state, value) in STATES.items() if value}
"""Name of each state in PARTNR's files and logs."""
ARGUMENTS: dict[str, tuple[str, ...]] = {
    "is_on_top": ("object_handles", "receptacle_handles"),
    "is_inside": ("object_handles", "receptacle_handles"),
    "is_in_room": ("object_handles", "room_ids"),
    "is_on_floor": ("object_handles",),
    "is_next_to": ("entity_handles_a", "entity_handles_b"),
    "is_clustered": ("*args",),
    **dict.fromkeys(STATES, ("object_handles",)),
}
"""Arguments with names of things, by proposition."""
_SAME = {"is_on_top": "is_same_receptacle", "is_inside": "is_same_receptacle", "is_in_room": "is_same_room"}
_SAME["is_next_to"] = "is_same_b"
NEXT_TO_M = 0.5


class Proposition(msgspec.Struct, frozen=True):
    """Predicate with arguments, which is true if it holds for any thing of each list."""

    function_name: str
    args: dict[str, Any] = {}

    @property
    def things(self) -> tuple[tuple[str, ...], ...]:
        """Lists of names in the arguments of the proposition."""
        names = ARGUMENTS[self.function_name]
        listed = self.args["*args"] if names == ("*args",) else [self.args[name] for name in names]
        return tuple(map(tuple, listed))

    @property
    def number(self) -> int:
        """Number of things from the first list that the proposition requires."""
        return self.args.get("number", 1)

    @property
    def is_same(self) -> bool:
        """Return whether all things of the first list have to be at the same thing of the second list."""
        return bool(self.args.get(_SAME.get(self.function_name, ""), False))


class Dependency(msgspec.Struct, frozen=True):
    """Condition on earlier rows without which propositions are not evaluated."""

    proposition_indices: list[int]
    depends_on: list[int]
    relation_type: Literal["while_satisfied", "after_satisfied", "after_unsatisfied", "before_satisfied"]
    dependency_mode: Literal["all", "any"] = "all"


class Constraint(msgspec.Struct, frozen=True):
    """Condition on the rows in which propositions were first true."""

    type: Literal["TemporalConstraint", "TerminalSatisfactionConstraint", "SameArgConstraint", "DifferentArgConstraint"]
    args: dict[str, Any] = {}

    @property
    def edges(self) -> list[list[int]]:
        """Pairs (earlier, later) of propositions in a temporal constraint."""
        return self.args.get("dag_edges", [])

    @property
    def indices(self) -> list[int]:
        """Propositions in a constraint that is not temporal."""
        return self.args.get("proposition_indices", [])


@dataclass(frozen=True)
class Evaluation:
    """Propositions of an episode with dependencies and constraints, each proposition about one count of things."""

    propositions: tuple[Proposition, ...]
    dependencies: tuple[Dependency, ...] = ()
    constraints: tuple[Constraint, ...] = ()

    @classmethod
    def of(cls, info: Mapping[str, Any], *, bugs: bool = False) -> Evaluation:
        """Read the evaluation in an episode's info.

        A proposition about ``number`` things counts as ``number`` propositions, about 1, 2, ... of them, as in PARTNR.

        Args:
            info: Info of a recording, or an episode of PARTNR's files.
            bugs: Renumber dependencies as PARTNR's code does, by the count instead of the position in the list.

        Raises:
            InputError: entries are malformed, name propositions that do not exist, or require a circular order.
        """
        try:
            propositions = msgspec.convert(info.get(PROPOSITIONS) or [], list[Proposition])
            dependencies = msgspec.convert(info.get(DEPENDENCIES) or [], list[Dependency])
            constraints = msgspec.convert(info.get(CONSTRAINTS) or [], list[Constraint])
        except msgspec.ValidationError as fault:
            raise _malformed(str(fault).replace("`", "")) from None
        for proposition in propositions:
            _check_proposition(proposition)
        count = len(propositions)
        for d in dependencies:
            _check_indices([*d.proposition_indices, *d.depends_on], count)
        for c in constraints:
            _check_constraint(c, propositions)
        return _unrolled(propositions, dependencies, constraints, bugs)


def _malformed(why: str) -> InputError:
    return InputError(
        f"Expected propositions in PARTNR's form, got some that cannot be read: {why}.", code="H3-LANGUAGE-006"
    )


def _check_proposition(p: Proposition) -> None:
    if p.function_name not in ARGUMENTS:
        raise InputError(
            f"Unknown proposition {p.function_name!r}.{suggest(p.function_name, ARGUMENTS)}", code="H3-LANGUAGE-007"
        )
    for name in ARGUMENTS[p.function_name]:
        value = p.args.get(name)
        lists = value if name == "*args" and isinstance(value, list) else [value]
        for listed in lists or [None]:
            if not isinstance(listed, list) or not listed or not all(isinstance(x, str) for x in listed):
                raise _malformed(f"{p.function_name} needs {name}, a list of names")
    number, many = p.args.get("number", 1), p.function_name == "is_clustered"
    if many and number == 1:
        number = [1] * len(p.things)
    counts = number if many and isinstance(number, list) else [number]
    fits = len(counts) == (len(p.things) if many else 1)
    if not fits or any(type(n) is not int or not 1 <= n <= len(t) for n, t in zip(counts, p.things, strict=False)):
        raise _malformed(f"{p.function_name} asks for {number!r} of {len(p.things[0])} things")
    threshold = p.args.get("l2_threshold", NEXT_TO_M)
    if type(threshold) not in (int, float) or not 0 <= threshold < float("inf"):
        raise _malformed(f"{p.function_name} has the threshold {threshold!r}")


def _check_indices(indices: Any, count: int) -> None:
    if not isinstance(indices, list) or any(type(k) is not int or not 0 <= k < count for k in indices):
        raise InputError(
            f"Expected numbers of propositions from 0 to {count - 1} in a dependency or constraint, got {indices!r}.",
            code="H3-LANGUAGE-008",
        )


def _check_constraint(c: Constraint, propositions: Sequence[Proposition]) -> None:
    if c.type != "TemporalConstraint":
        _check_indices(c.indices, len(propositions))
        names = c.args.get("arg_names", [])
        if "Arg" in c.type and (not isinstance(names, list) or len(names) != len(c.indices)):
            raise _malformed(f"{c.type} needs one of arg_names for each of its propositions")
        for k, name in zip(c.indices, names, strict=False):
            p = propositions[k]
            known = ARGUMENTS[p.function_name]
            if known == ("*args",):
                known = tuple(f"*args_{n}" for n in range(len(p.things)))
            if "Arg" in c.type and name not in known:
                raise _malformed(f"{c.type} names {name!r} of {p.function_name}, which has {', '.join(known)}")
        return
    if not isinstance(c.edges, list) or any(not isinstance(e, list) or len(e) != 2 for e in c.edges):
        raise _malformed("dag_edges of a TemporalConstraint are pairs of propositions")
    _check_indices([k for edge in c.edges for k in edge], len(propositions))
    graph: dict[int, set[int]] = {}
    for earlier, later in c.edges:
        graph.setdefault(later, set()).add(earlier)
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as fault:
        circle = " before ".join(map(str, fault.args[1]))
        raise InputError(
            f"Expected an order of propositions without a circle in a TemporalConstraint, got {circle}.",
            code="H3-LANGUAGE-009",
        ) from None


def _unrolled(
    propositions: Sequence[Proposition],
    dependencies: Sequence[Dependency],
    constraints: Sequence[Constraint],
    bugs: bool,
) -> Evaluation:
    """Add the propositions about fewer things at the end of the list, as PARTNR does, and let all else speak of them too.

    What depends on a counted proposition depends on the whole count.
    """
    found = list(propositions)
    places = [[k] for k in range(len(found))]
    listed = [list(d.proposition_indices) for d in dependencies]
    for k, p in enumerate(propositions):
        for n in range(1, p.number if isinstance(p.number, int) else 1):
            places[k].append(len(found))
            for indices in listed:
                # PARTNR's code appends its loop counter; the wrong number may then be that of a later proposition
                indices += [n if bugs else len(found)] * (k in indices)
            found.append(Proposition(p.function_name, {**p.args, "number": n}))

    def spread(c: Constraint) -> Constraint:
        if c.type == "TemporalConstraint":
            return Constraint(c.type, {"dag_edges": [[a, b] for i, j in c.edges for a in places[i] for b in places[j]]})
        names = dict(zip(c.indices, c.args.get("arg_names", [""] * len(c.indices)), strict=True))
        added = sorted(n for k in names for n in places[k][1:])
        # the order decides between propositions of the same row
        indices = [*names, *added] if c.type != "DifferentArgConstraint" else [*added[::-1], *names]
        origin = {n: k for k in names for n in places[k]}
        args = {"arg_names": [names[origin[n]] for n in indices], "counts_of": [origin[n] for n in indices]}
        return Constraint(c.type, {"proposition_indices": indices, **args})

    return Evaluation(
        tuple(found),
        tuple(msgspec.structs.replace(d, proposition_indices=k) for d, k in zip(dependencies, listed, strict=True)),
        tuple(map(spread, constraints)),
    )
