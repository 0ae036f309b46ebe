"""Propositions, dependencies and constraints in PARTNR's own JSON, checked, with counted propositions unrolled.

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
"""Name and value of the state that each proposition about states asks for."""
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
    """A predicate of the home with its arguments; lists of things mean any of them."""

    function_name: str
    args: dict[str, Any] = {}

    @property
    def things(self) -> tuple[tuple[str, ...], ...]:
        """Lists of names in its arguments."""
        names = ARGUMENTS[self.function_name]
        listed = self.args["*args"] if names == ("*args",) else [self.args[name] for name in names]
        return tuple(map(tuple, listed))

    @property
    def number(self) -> int:
        """Number of things from the first list that it requires."""
        return self.args.get("number", 1)

    @property
    def is_same(self) -> bool:
        """Returns whether all of them have to be at the same thing of the second list."""
        return bool(self.args.get(_SAME.get(self.function_name, ""), False))


class Dependency(msgspec.Struct, frozen=True):
    """A condition on the rows before, without which propositions are not asked."""

    proposition_indices: list[int]
    depends_on: list[int]
    relation_type: Literal["while_satisfied", "after_satisfied", "after_unsatisfied", "before_satisfied"]
    dependency_mode: Literal["all", "any"] = "all"


class Constraint(msgspec.Struct, frozen=True):
    """A condition on the rows in which propositions were first true."""

    type: Literal["TemporalConstraint", "TerminalSatisfactionConstraint", "SameArgConstraint", "DifferentArgConstraint"]
    args: dict[str, Any] = {}

    @property
    def edges(self) -> list[list[int]]:
        """Pairs (earlier, later) of a temporal constraint."""
        return self.args.get("dag_edges", [])

    @property
    def indices(self) -> list[int]:
        """Propositions of the other constraints."""
        return self.args.get("proposition_indices", [])


@dataclass(frozen=True)
class Evaluation:
    """The propositions of an episode with their dependencies and constraints, each proposition asking for one count."""

    propositions: tuple[Proposition, ...]
    dependencies: tuple[Dependency, ...] = ()
    constraints: tuple[Constraint, ...] = ()

    @classmethod
    def of(cls, info: Mapping[str, Any], *, bugs: bool = False) -> Evaluation:
        """Read the evaluation in an episode's info.

        A proposition about ``number`` things counts as ``number`` propositions, about 1, 2, ... of them, as in PARTNR.

        Args:
            info: Info of a recording, or an episode of PARTNR's files.
            bugs: Renumber dependencies as PARTNR's code does, by the count instead of the place in the list.

        Raises:
            InputError: they are malformed, name propositions that do not exist, or ask for an order in a circle.
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
            _check_constraint(c, count)
        return _unrolled(propositions, dependencies, constraints, bugs)

    def to_json(self) -> dict[str, Any]:
        """The entries of an info that `of` reads."""
        return {
            PROPOSITIONS: msgspec.to_builtins(self.propositions),
            DEPENDENCIES: msgspec.to_builtins(self.dependencies),
            CONSTRAINTS: msgspec.to_builtins(self.constraints),
        }


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


def _check_constraint(c: Constraint, count: int) -> None:
    if c.type != "TemporalConstraint":
        _check_indices(c.indices, count)
        names = c.args.get("arg_names", [])
        if "Arg" in c.type and (not isinstance(names, list) or len(names) != len(c.indices)):
            raise _malformed(f"{c.type} needs one of arg_names for each of its propositions")
        return
    if not isinstance(c.edges, list) or any(not isinstance(e, list) or len(e) != 2 for e in c.edges):
        raise _malformed("dag_edges of a TemporalConstraint are pairs of propositions")
    _check_indices([k for edge in c.edges for k in edge], count)
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
    found: list[Proposition] = []
    places: list[list[int]] = []
    for p in propositions:
        counts = range(1, p.number + 1) if isinstance(p.number, int) else (p.number,)
        places.append(list(range(len(found), len(found) + len(counts))))
        found += [Proposition(p.function_name, {**p.args, "number": n}) for n in counts]

    def spread(indices: Sequence[int]) -> list[int]:
        return [k for index in indices for k in places[index]]

    def misspread(indices: Sequence[int]) -> list[int]:
        """The first place of each, then the counter of PARTNR's loop in place of the further ones."""
        return [k for index in indices for k in (places[index][0], *range(1, len(places[index])))]

    def told(c: Constraint) -> Constraint:
        if c.type == "TemporalConstraint":
            edges = [[a, b] for early, late in c.edges for a in places[early] for b in places[late]]
            return Constraint(c.type, {**c.args, "dag_edges": edges, "n_propositions": len(found)})
        names = c.args.get("arg_names")
        args = {**c.args, "proposition_indices": spread(c.indices), "n_propositions": len(found)}
        if names is not None:
            args["arg_names"] = [name for name, k in zip(names, c.indices, strict=True) for _ in places[k]]
        return Constraint(c.type, args)

    return Evaluation(
        tuple(found),
        tuple(
            Dependency(
                [k for k in (misspread if bugs else spread)(d.proposition_indices) if k < len(found)],
                spread(d.depends_on),
                d.relation_type,
                d.dependency_mode,
            )
            for d in dependencies
        ),
        tuple(map(told, constraints)),
    )
