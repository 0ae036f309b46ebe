"""Templates of tasks in words, with their wordings, and their requirements as clauses.

A clause is a line of text: ``on a,b p`` (things a and b on furniture p), ``on a p|q`` (on p or q), ``2 on a,b,c p``
(any two of them), ``inside a u`` (in a drawer or behind a door of furniture u), ``in a r`` (in a room), ``floor a`` (on
the floor, of the room that ``in a r`` names), ``next a b``, ``near a,b,c`` (all together), ``clean a``, ``fill a``,
``pour a``, ``power a``, and ``at b p``, which requires nothing (b lies on p from the start). Slots a, b, c are things,
p and q furniture, r and s rooms, u and v furniture with doors or drawers.
"""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

Kind = Literal["free", "spatial", "temporal", "heterogeneous"]
KINDS: tuple[Kind, ...] = get_args(Kind)
"""Types of tasks, as in PARTNR: unconstrained; with things near each other; in an order; with actions that only people
can do."""


class Template(NamedTuple):
    """Template of an instruction."""

    name: str
    kind: Kind
    clauses: tuple[str, ...]
    wordings: tuple[str, ...]
    order: tuple[tuple[int, int], ...] = ()
    """Pairs of clauses, with the earlier one first."""
    relation: str = ""
    """Relation of the first two clauses: ``same`` or ``different`` piece of furniture."""
    by_name: bool = False
    """True if it is sampled only by name: the sampled tasks of a set stay the same when templates are added."""

    @property
    def moves_twice(self) -> bool:
        """True if the second clause moves the object of the first one again."""
        return self.relation == "twice"


def _free(name: str, clauses: tuple[str, ...], *wordings: str, relation: str = "", by_name: bool = False) -> Template:
    return Template(name, "free", clauses, wordings, relation=relation, by_name=by_name)


def _spatial(name: str, clauses: tuple[str, ...], *wordings: str) -> Template:
    return Template(name, "spatial", clauses, wordings)


def _temporal(
    name: str, clauses: tuple[str, ...], *wordings: str, order: tuple[tuple[int, int], ...] = ((0, 1),)
) -> Template:
    return Template(name, "temporal", clauses, wordings, order)


def _mixed(name: str, clauses: tuple[str, ...], *wordings: str, order: tuple[tuple[int, int], ...] = ()) -> Template:
    return Template(name, "heterogeneous", clauses, wordings, order)


TEMPLATES: tuple[Template, ...] = (
    _free("one_on", ("on a p",), "Put {a} on {p}.", "Please move {a} to {p}.", "{a} should be on {p}."),
    _free("two_on", ("on a p", "on b p"), "Put {a} and {b} on {p}.", "Move both {a} and {b} to {p}."),
    _free("two_places", ("on a p", "on b q"), "Put {a} on {p} and {b} on {q}.", "Move {a} to {p}; move {b} to {q}."),
    _free(
        "three_on", ("on a p", "on b p", "on c p"), "Put {a}, {b} and {c} on {p}.", "Gather {a}, {b} and {c} on {p}."
    ),
    _free("three_places", ("on a p", "on b p", "on c q"), "Put {a} and {b} on {p}, and {c} on {q}."),
    _free("one_room", ("in a r",), "Bring {a} to {r}.", "Take {a} into {r}.", "I need {a} in {r}."),
    _free("two_room", ("in a r", "in b r"), "Bring {a} and {b} to {r}.", "Take both {a} and {b} into {r}."),
    _free("two_rooms", ("in a r", "in b s"), "Bring {a} to {r} and {b} to {s}."),
    _free("room_and_place", ("in a r", "on b p"), "Bring {a} to {r} and put {b} on {p}."),
    _free(
        "any_two", ("2 on a,b,c p",), "Put any two of {a}, {b} and {c} on {p}.", "Two of {a}, {b} and {c} go on {p}."
    ),
    _free("either_thing", ("1 on a,b p",), "Put {a} or {b} on {p}.", "Either {a} or {b} should be on {p}."),
    _free("either_place", ("on a p|q",), "Put {a} on {p} or on {q}.", "Move {a} to {p} or to {q}."),
    _free(
        "same_place",
        ("on a p|q", "on b p|q"),
        "Put {a} and {b} in one place, either on {p} or on {q}.",
        relation="same",
    ),
    _free(
        "different_places",
        ("on a p|q", "on b p|q"),
        "Put one of {a} and {b} on {p} and the other on {q}.",
        relation="different",
    ),
    _free("inside", ("inside a u",), "Put {a} inside {u}.", "{a} belongs inside {u}."),
    _free("two_inside", ("inside a u", "inside b u"), "Put {a} and {b} inside {u}."),
    _free("inside_and_place", ("inside a u", "on b p"), "Put {a} inside {u} and {b} on {p}."),
    _spatial(
        "next_to_there",
        ("on a p", "next a b", "at b p"),
        "Put {a} on {p}, next to {b}.",
        "{a} goes next to {b} on {p}.",
    ),
    _spatial("next_to", ("next a b",), "Put {a} next to {b}.", "Move {a} close to {b}."),
    _spatial(
        "pair",
        ("on a p", "on b p", "next b a"),
        "Put {a} and {b} next to each other on {p}.",
        "Put {a} on {p} and {b} beside it.",
    ),
    _spatial("group", ("on a p", "on b p", "on c p", "near a,b,c"), "Put {a}, {b} and {c} close together on {p}."),
    _spatial(
        "pair_and_one",
        ("on a p", "on b p", "next b a", "on c q"),
        "Put {a} and {b} next to each other on {p}, and {c} on {q}.",
    ),
    _spatial(
        "two_next_to", ("next a c", "next b c"), "Put {a} and {b} next to {c}.", "Move both {a} and {b} close to {c}."
    ),
    _spatial("next_and_room", ("next a b", "in c r"), "Put {a} next to {b} and bring {c} to {r}."),
    _spatial("next_and_place", ("next a b", "on c p"), "Put {a} next to {b} and put {c} on {p}."),
    _temporal(
        "first_then",
        ("on a p", "on b q"),
        "First put {a} on {p}, then put {b} on {q}.",
        "Before you put {b} on {q}, put {a} on {p}.",
    ),
    _temporal(
        "first_then_there",
        ("on a p", "on b p"),
        "First put {a} on {p}, then {b} as well.",
        "Put {b} on {p}, but only after {a} is there.",
    ),
    _temporal("after_place_room", ("on a p", "in b r"), "After {a} is on {p}, bring {b} to {r}."),
    _temporal("after_room_place", ("in a r", "on b p"), "First bring {a} to {r}, then put {b} on {p}."),
    _temporal(
        "three_in_order",
        ("on a p", "on b p", "on c p"),
        "Put {a} on {p}, then {b}, and last {c}.",
        order=((0, 1), (1, 2)),
    ),
    _temporal(
        "two_then_one",
        ("on a p", "on b p", "on c q"),
        "Put {a} and {b} on {p}, and after that {c} on {q}.",
        order=((0, 2), (1, 2)),
    ),
    _temporal(
        "one_then_two",
        ("on a p", "on b q", "on c q"),
        "Once {a} is on {p}, put {b} and {c} on {q}.",
        order=((0, 1), (0, 2)),
    ),
    _temporal(
        "then_next_to",
        ("on a p", "on b p", "next b a"),
        "First put {a} on {p}, then put {b} next to it there.",
        order=((0, 1), (0, 2)),
    ),
    _temporal("inside_then_place", ("inside a u", "on b p"), "First put {a} inside {u}, then put {b} on {p}."),
    Template(
        "twice",
        "temporal",
        ("on a p", "on a q"),
        ("Put {a} on {p}. After that, move it to {q}.", "First show {a} on {p}, then take it to {q}."),
        relation="twice",
    ),
    _mixed("wash", ("clean a",), "Wash {a}.", "{a} is dirty: clean it."),
    _mixed("wash_two", ("clean a", "clean b"), "Wash {a} and {b}.", "Clean both {a} and {b}."),
    _mixed(
        "wash_and_put", ("clean a", "on a p"), "Wash {a} and put it on {p}.", "Bring {a} to {p}; it has to be clean."
    ),
    _mixed(
        "wash_then_put",
        ("clean a", "on a p"),
        "First wash {a}, then put it on {p}.",
        "Put {a} on {p} after you have washed it.",
        order=((0, 1),),
    ),
    _mixed("wash_and_other", ("clean a", "on b p"), "Wash {a} and put {b} on {p}."),
    _mixed("fill_and_put", ("fill a", "on a p"), "Fill {a} and put it on {p}."),
    _mixed("put_then_fill", ("on a p", "fill a"), "Put {a} on {p}, and fill it there.", order=((0, 1),)),
    _mixed("fill_and_room", ("fill a", "in b r"), "Fill {a}, and bring {b} to {r}."),
    _mixed("pour_and_put", ("pour a", "on a p"), "Pour out {a} and put it on {p}.", "Empty {a}, and move it to {p}."),
    _mixed("wash_and_fill", ("clean a", "fill b", "on b p"), "Wash {a}; fill {b} and put it on {p}."),
    _mixed(
        "wash_then_both",
        ("clean a", "on a p", "on b p"),
        "First wash {a}, then put it and {b} on {p}.",
        order=((0, 1), (0, 2)),
    ),
    _mixed("wash_and_inside", ("clean a", "inside a u"), "Wash {a} and put it inside {u}."),
    _mixed("switch_on", ("power a",), "Switch on {a}.", "Turn {a} on."),
    _mixed("switch_on_there", ("on a p", "power a"), "Put {a} on {p}, and switch it on there.", order=((0, 1),)),
    _free(
        "floor", ("floor a", "in a r"), "Put {a} on the floor of {r}.", "{a} belongs on the floor of {r}.", by_name=True
    ),
    _free(
        "floor_and_place", ("floor a", "in a r", "on b p"), "Put {a} on the floor of {r}, and {b} on {p}.", by_name=True
    ),
    Template(
        "floor_next_to",
        "spatial",
        ("floor a", "in a r", "floor b", "next b a"),
        ("Put {a} on the floor of {r}, and {b} next to it.",),
        by_name=True,
    ),
)

HANDLING = {"clean": ("clean", True), "fill": ("filled", True), "pour": ("filled", False), "power": ("powered", True)}
"""State and value that each clause about states requires. Only people can change them: robots have no hand for water
and switches."""
PREDICATES = {"clean": "is_clean", "fill": "is_filled", "pour": "is_empty", "power": "is_powered_on"}
WASHABLE = (
    "mug",
    "bowl",
    "plate",
    "pot",
    "pan",
    "cup",
    "glass",
    "tumbler",
    "vase",
    "fork",
    "knife",
    "spoon",
    "apple",
    "orange",
)
FILLABLE = ("mug", "bowl", "bottle", "pot", "cup", "glass", "tumbler", "vase", "jug", "can", "bucket", "kettle")
POWERED = ("phone", "laptop", "tablet", "radio", "lantern", "speaker", "camera", "clock", "lamp", "headphones", "mixer")
AFFORDS = {"clean": WASHABLE, "fill": FILLABLE, "pour": FILLABLE, "power": POWERED}
"""Suffixes of the names of kinds of things on which each action is possible."""


def affords(category: str, verb: str) -> bool:
    """Return whether an action is possible on things of a kind, e.g. whether a ``teacup`` can be washed."""
    return category.endswith(AFFORDS[verb])
