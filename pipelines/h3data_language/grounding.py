"""Words for the things, furniture and rooms of a home, and their interpretation."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from h3data.errors import InputError
from h3data.scene import Instance, Receptacle, Scene
from h3data.scene.articulation import joints_of
from h3data_language.evaluation.layout import Layout, owner_of
from h3data_language.evaluation.predicates import Rows, truth_of
from h3data_language.evaluation.records import Evaluation, Proposition
from h3data_language.templates import HANDLING, PREDICATES, TEMPLATES, Template

FLOOR = "floor of "
"""Prefix of the names of places on the floor of rooms."""
_UNNAMED = ("toilet", "bathroom_sink", "wine_rack", "washer", "dryer")
"""Furniture that no instruction names as a place to put something."""
_ROOMS = {"living": "living room", "child": "child's room", "dining": "dining room", "laundry": "laundry room"}


class Place(NamedTuple):
    """Furniture of one kind in one room."""

    names: tuple[str, ...]
    words: str
    room: str


@dataclass(frozen=True, eq=False)
class Home:
    """Home with words for its things."""

    scene: Scene
    layout: Layout
    """Layout of the home with all things that can be moved."""
    places: Mapping[str, Place]
    """Places on which things can be put, by words."""
    insides: Mapping[str, Place]
    """Furniture in which things can be put behind doors or in drawers, by words."""
    rooms: Mapping[str, str]
    """Names of rooms in the scene by their names in words."""
    surfaces: Mapping[str, list[tuple[Instance, Receptacle]]]
    """Open surfaces by the name of their furniture."""
    enclosed: Mapping[str, list[tuple[Instance, Receptacle]]]
    """Surfaces behind doors and in drawers, by the name of their furniture."""
    lies_on: Mapping[str, str]
    """Furniture on which each thing lies in the scene."""
    categories: Mapping[str, str]
    """Kind of each thing."""
    place_of: Mapping[str, Place] = field(default_factory=dict)
    """Place to which each piece of furniture belongs."""


def spoken(name: str) -> str:
    """Return words for a kind or a room, such as "bedroom 1" for ``bedroom_1``."""
    head, _, number = name.rpartition("_")
    if number.isdigit():
        return f"{_ROOMS.get(head, head.replace('_', ' '))} {number}"
    return _ROOMS.get(name, name.replace("_", " "))


def room_words(room: str) -> str:
    """Return words for one room, such as "the kitchen" or "bedroom 1"."""
    words = spoken(room)
    return words if words[-1].isdigit() else f"the {words}"


@lru_cache(maxsize=8)
def home_of(scene: Scene, open_m: float) -> Home:
    """Describe a home in words; open surfaces with less than ``open_m`` [m] above them are left out."""
    things = [i.name for i in scene.instances if i.motion == "kinematic" and len(scene.assets[i.asset].mesh.vertices)]
    layout, enclosed = Layout.of_scene(scene, things), joints_of(scene).enclosing
    by_name = {i.name: i for i in scene.instances}
    category = {name: scene.assets[i.asset].category for name, i in by_name.items()}
    category = {owner_of(scene, name): kind for name, kind in reversed(category.items())} | category
    moving = {name for thing in scene.articulations for part in thing.parts for name in part.instances}
    surfaces: dict[str, list[tuple[Instance, Receptacle]]] = {}
    closed: dict[str, list[tuple[Instance, Receptacle]]] = {}
    for instance, receptacle in scene.receptacles():
        owner = owner_of(scene, instance.name)
        usual = owner in layout.furniture and category[owner] not in _UNNAMED
        if usual and enclosed.get(f"{instance.name}|{receptacle.name}"):
            closed.setdefault(owner, []).append((instance, receptacle))
        elif usual and instance.name not in moving and receptacle.clearance_m >= open_m:
            surfaces.setdefault(owner, []).append((instance, receptacle))
    places, insides = (_places(some, layout, category) for some in (surfaces, closed))
    poses = np.array([by_name[t].pose for t in things], np.float64).reshape(1, -1, 7)
    rows = Rows(layout, poses, np.zeros((1, len(things)), np.bool_))
    lies_on = {}
    for thing in things:
        for furniture in layout.furniture:
            asked = {"object_handles": [thing], "receptacle_handles": [furniture]}
            if any(truth_of(Proposition(name, asked), rows)[0][0] for name in ("is_on_top", "is_inside")):
                lies_on[thing] = furniture
    return Home(
        scene=scene,
        layout=layout,
        places=places,
        insides=insides,
        rooms={room_words(room): room for room in layout.rooms if {p.room for p in places.values()} & {room}},
        surfaces=surfaces,
        enclosed=closed,
        lies_on=lies_on,
        categories={t: category[t] for t in things},
        place_of={name: place for place in places.values() for name in place.names},
    )


def _places(names: Iterable[str], layout: Layout, category: Mapping[str, str]) -> dict[str, Place]:
    """Return the pieces of furniture by words for them, those of one kind in one room together."""
    groups: dict[tuple[str, str], list[str]] = {}
    for name in names:
        room = room_at(layout, layout.furniture[name].center)
        if room:
            groups.setdefault((category[name], room), []).append(name)
    kinds, places = Counter(kind for kind, _ in groups), {}
    for (kind, room), found in groups.items():
        words = spoken(kind)
        article = "the" if len(found) == 1 else "an" if words[0] in "aeiou" else "a"
        where = f" in {room_words(room)}" if kinds[kind] > 1 else ""
        places[f"{article} {words}{where}"] = Place(tuple(found), f"{article} {words}{where}", room)
    return places


def room_at(layout: Layout, point: Iterable[float]) -> str:
    """Return the name of the room that contains a world point [3] [m] over its floor; empty if there is none."""
    x, _, z = point
    inside = (r for r, parts in layout.rooms.items() if any(a <= x <= c and b <= z <= d for a, b, c, d in parts))
    return next(inside, "")


def thing_words(home: Home, thing: str, start: Place | None, *, stays: bool = False) -> str:
    """Return words for a thing: its kind if that is unique in the home, and otherwise also its place."""
    kind = home.categories[thing]
    if sum(other == kind for other in home.categories.values()) == 1 or start is None:
        return f"the {spoken(kind)}"
    return f"the {spoken(kind)} {'on' if stays else 'from'} {start.words}"


# --- propositions -----------------------------------------------------------------------------------------------------
def clause_parts(clause: str) -> tuple[int, str, list[list[str]]]:
    """Return the count (0: all), the verb and the lists of slots of a clause."""
    first, *rest = clause.split()
    number = int(first) if first.isdigit() else 0
    verb, *slots = rest if number else (first, *rest)
    return number, verb, [re.split(r"[,|]", each) for each in slots]


def proposition_of(clause: str, slots: Mapping[str, tuple[str, ...]]) -> Proposition | None:
    """Return the proposition of a clause for the names in its slots; None for a clause without a requirement."""
    number, verb, lists = clause_parts(clause)
    first, *rest = ([name for slot in each for name in slots[slot]] for each in lists)
    if verb == "at":
        return None
    if verb == "near":
        return Proposition("is_clustered", {"*args": [[name] for name in first], "number": [1] * len(first)})
    if verb in HANDLING:
        return Proposition(PREDICATES[verb], {"object_handles": first, "number": number or len(first)})
    if verb == "next":
        return Proposition("is_next_to", {"entity_handles_a": first, "entity_handles_b": rest[0], "number": len(first)})
    if verb == "floor":
        return Proposition("is_on_floor", {"object_handles": first, "number": number or len(first)})
    if verb == "in":
        name, second = "is_in_room", "room_ids"
    else:
        name, second = "is_inside" if verb == "inside" else "is_on_top", "receptacle_handles"
    return Proposition(name, {"object_handles": first, second: rest[0], "number": number or len(first)})


def evaluation_of(template: Template, slots: Mapping[str, tuple[str, ...]]) -> dict[str, object]:
    """Return propositions, dependencies and constraints of a template for the names in its slots, in PARTNR's JSON."""
    found = [(k, p) for k, c in enumerate(template.clauses) if (p := proposition_of(c, slots)) is not None]
    count, numbers = len(found), [k for k, _ in found]
    constraints: list[dict[str, object]] = []
    if template.order:
        edges = [[numbers.index(a), numbers.index(b)] for a, b in template.order]
        constraints.append({"type": "TemporalConstraint", "args": {"dag_edges": edges, "n_propositions": count}})
    if template.relation in ("same", "different"):
        names = {"proposition_indices": [0, 1], "arg_names": ["receptacle_handles"] * 2, "n_propositions": count}
        constraints.append({"type": f"{template.relation.title()}ArgConstraint", "args": names})
    lasting = [k for k in range(count) if not (template.moves_twice and k == 0)]
    constraints.append(
        {"type": "TerminalSatisfactionConstraint", "args": {"proposition_indices": lasting, "n_propositions": count}}
    )
    after = {
        "proposition_indices": [1],
        "depends_on": [0],
        "relation_type": "after_satisfied",
        "dependency_mode": "all",
    }
    return {
        "evaluation_propositions": [{"function_name": p.function_name, "args": p.args} for _, p in found],
        "evaluation_proposition_dependencies": [after] if template.moves_twice else [],
        "evaluation_constraints": constraints,
    }


Words = Mapping[str, Mapping[str, tuple[str, ...]]]
"""Names that phrases mean, by slots: ``abc`` things, ``pq`` places, ``rs`` rooms, ``uv`` furniture that opens."""


def parse(instruction: str, words: Words) -> list[Evaluation]:
    """Return all possible evaluations of an instruction, which is one unless it is ambiguous.

    Raises:
        InputError: no wording matches the instruction, or it names something that is not in the home.
    """
    text = instruction[:1].lower() + instruction[1:]
    found: list[Evaluation] = []
    for template in TEMPLATES:
        for wording in template.wordings:
            for slots in _bindings(wording[:1].lower() + wording[1:], text, words):
                evaluation = Evaluation.of(evaluation_of(template, slots))
                if evaluation not in found:
                    found.append(evaluation)
    if not found:
        raise InputError(
            f"Expected an instruction about what is in this home, got {instruction[:200]!r}.", code="H3-LANGUAGE-014"
        )
    return found


def _bindings(wording: str, text: str, words: Words) -> list[Mapping[str, tuple[str, ...]]]:
    """Return the meanings of the slots of a wording by which it becomes a text."""
    head, slot, rest = re.match(r"([^{]*)(?:\{(\w)\})?(.*)", wording).groups()  # type: ignore[union-attr]
    if not text.startswith(head):
        return []
    text = text[len(head) :]
    if slot is None:
        return [{}] if not text else []
    found = []
    for phrase, names in next(phrases for slots, phrases in words.items() if slot in slots).items():
        if text.startswith(phrase):
            found += [{slot: names, **more} for more in _bindings(rest, text[len(phrase) :], words)]
    return found
