"""Sampling of tasks in words, with a template, things and places of a home, free spots, and checks of the result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot
from h3data.errors import InputError, SceneError, suggest
from h3data.geometry import Array, quat_from_heading
from h3data.scene import FreeSpace, Instance, Receptacle, Scene
from h3data_language.evaluation.engine import Verdict, evaluate
from h3data_language.evaluation.layout import LAYOUT, Layout
from h3data_language.evaluation.predicates import Rows, next_to
from h3data_language.evaluation.records import NEXT_TO_M, Evaluation
from h3data_language.grounding import (
    FLOOR,
    Home,
    Place,
    Words,
    clause_parts,
    evaluation_of,
    home_of,
    parse,
    room_at,
    thing_words,
)
from h3data_language.templates import HANDLING, KINDS, TEMPLATES, Template, affords
from sim_kinematic.agents.driven.object_room import object_extent
from sim_kinematic.agents.stands import robot_fits
from sim_kinematic.motion.randomness import generator
from sim_kinematic.motion.spec import STEP_S, SocialNavSpec
from sim_kinematic.tasks.episode import Starts, sample_pair_starts
from sim_kinematic.tasks.rearrange.episode import RearrangeSpec, Target, free_spot

ATTEMPTS = 60
"""Number of choices of a template, things and places that are tried."""
NEXT_TO_TRIES = 10
BESIDE_M = 0.8 * NEXT_TO_M
"""Distance between things that are placed next to each other [m], well within the limit of the proposition."""
IN_TIME = 0.8
"""Share of the longest duration within which a person alone must complete the work, as estimated along straight
lines.
"""
DETOUR = 1.4
"""Approximate ratio of the length of a path to the straight line."""
ERRAND_S = 8.0
"""Approximate time to take and put down one thing, including doors and turning [s]."""
FLOOR_POINTS, FLOOR_TRIED = 400, 12
"""Number of points that are sampled on a room's floor, and number of those that are tried."""
FLOOR_GAP_M, FLOOR_EDGE_M, FLOOR_NEAR_M = 0.02, 0.25, 0.7
"""Limits for things on the floor [m]: smallest distance from walls and furniture, largest distance of the centre from
them (people with bodies of this radius can walk past), and largest distance between the centres of neighbouring things.
"""
STATES = ("clean", "filled", "powered")


@dataclass(frozen=True, kw_only=True, repr=False)
class LanguageSpec(RearrangeSpec):
    """Rules of tasks in words, in addition to those of rearrangement."""

    max_steps: int = 6000
    objects: int = 3
    """Number of things that can be taken, including those that the task does not need."""
    end_on_collision: bool = False
    kind: str = ""
    """Type of the task: free, spatial, temporal or heterogeneous; empty for any."""
    template: str = ""
    """Name of the template (`h3data_language.templates`); empty for any of the type."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind and self.kind not in KINDS:
            raise InputError(f"Unknown type of task {self.kind!r}.{suggest(self.kind, KINDS)}", code="H3-LANGUAGE-011")
        names = [t.name for t in TEMPLATES]
        if self.template and self.template not in names:
            raise InputError(
                f"Unknown template {self.template!r}.{suggest(self.template, names)}", code="H3-LANGUAGE-012"
            )
        if not self.templates():
            raise InputError(
                f"The template {self.template!r} is not of the type {self.kind!r}.", code="H3-LANGUAGE-013"
            )

    def templates(self, kind: str = "") -> list[Template]:
        """Return the templates that these rules allow; if the rules name no type, those of type ``kind``."""
        kind = self.kind or ("" if self.template else kind)
        return [
            t
            for t in TEMPLATES
            if (t.name == self.template or not (self.template or t.by_name)) and kind in ("", t.kind)
        ]


class Errand(msgspec.Struct, frozen=True):
    """Part of the work: bringing a thing to one of its goals, or handling it in place."""

    thing: int
    handle: bool
    """True if a person has to clean, fill, pour out or switch the thing; False if the thing has to be brought to a
    goal.
    """
    stage: int = 0
    """Number of the goal, for a thing that moves more than once."""
    after: tuple[int, ...] = ()
    """Errands that have to be completed before this one."""


@dataclass(frozen=True, kw_only=True)
class LanguageTask:
    """Task in words, with all data that are needed to judge it and to carry it out."""

    instruction: str
    targets: tuple[Target, ...]
    starts: Starts
    extra: Mapping[str, Any] = field(default_factory=dict)
    """Value of `Episode.extra`: evaluation, layout, states, errands."""


def sample_task(
    scene: Scene, free: FreeSpace, seed: int, spec: LanguageSpec, robot: Robot, human: Humanoid
) -> LanguageTask:
    """Sample the task in words with a given seed.

    Raises:
        SceneError: the home has no things and places for any template that the rules allow.
    """
    home = home_of(scene, spec.open_m)
    fits = robot_fits(robot, spec.robot, scene, free)
    rules = SocialNavSpec(spawn_distance_m=spec.spawn_distance_m, robot=spec.robot)
    starts = sample_pair_starts(free, int(generator(seed, "language_starts").integers(2**63)), rules, fits=fits)
    kind = spec.kind or KINDS[int(generator(seed, "language_kind").integers(len(KINDS)))]
    for attempt in range(ATTEMPTS):
        rng = generator(seed, "language", step=attempt)
        allowed = spec.templates(kind if attempt < ATTEMPTS // 2 else "")
        template = allowed[int(rng.integers(len(allowed)))]
        task = _Draw(SpotFinder(home, free, spec, robot, human, rng), template).task(starts)
        if task is not None:
            return task
    raise SceneError(
        f"Found no things and places in {scene.name!r} for a task in words in {ATTEMPTS} attempts. Hint: another home, or "
        "fewer rules (kind, template).",
        code="H3-LANGUAGE-010",
    )


@dataclass(eq=False)
class SpotFinder:
    """Finder of free spots for things in a home that robot and person can reach."""

    home: Home
    free: FreeSpace
    spec: LanguageSpec
    robot: Robot
    human: Humanoid
    rng: np.random.Generator
    taken: list[tuple[Array, float]] = field(default_factory=list)
    """Positions [3] and radii of other things [m]; each spot that is found is added."""

    def find(
        self,
        thing: str,
        furniture: Sequence[str],
        *,
        inside: bool = False,
        other: str = "",
        anchor: tuple[Array, str] | None = None,
    ) -> tuple[Array, str] | None:
        """Return a free spot [3] [m] for a thing on or in furniture, and its receptacle, or None.

        Names that start with `FLOOR` denote the floor of a room. With ``anchor``, the spot and receptacle of the thing
        ``other``, the spot is next to that thing.
        """
        instance = next(i for i in self.home.scene.instances if i.name == thing)
        known = self.home.enclosed if inside else self.home.surfaces
        surfaces = [each for n in furniture for each in known.get(n, ())]
        for name in furniture:
            if name.startswith(FLOOR):
                surfaces += self._floor(name, instance, anchor)
        if not surfaces:
            return None
        for _ in range(NEXT_TO_TRIES if anchor else 1):
            before = len(self.taken)
            spot = free_spot(
                self.home.scene, self.free, self.spec, self.robot, self.human, surfaces, self.rng, instance, self.taken
            )
            if spot is None or anchor is None or self._near(thing, spot[0], other, anchor[0]):
                return spot
            del self.taken[before:]
        return None

    def _floor(self, name: str, thing: Instance, anchor: tuple[Array, str] | None) -> list[tuple[Instance, Receptacle]]:
        """Return points on the floor of a room as surfaces of the size of a thing, beside walls and furniture."""
        room, radius = name.removeprefix(FLOOR), object_extent(self.home.scene, thing)[0]
        parts = np.array(self.home.layout.rooms[room], np.float64)
        low, high = parts[:, :2].min(0), parts[:, 2:].max(0)
        if anchor is not None:
            middle = np.asarray(anchor[0])[[0, 2]]
            low, high = np.maximum(low, middle - FLOOR_NEAR_M), np.minimum(high, middle + FLOOR_NEAR_M)
        points = low + self.rng.uniform(size=(FLOOR_POINTS, 2)) * (high - low)
        room_of = [room_at(self.home.layout, (x, 0.0, z)) for x, z in points.tolist()]
        apart = self.free.signed_distance(points)
        fits = (apart >= radius + FLOOR_GAP_M) & (apart <= max(FLOOR_EDGE_M, radius + 2 * FLOOR_GAP_M))
        fits &= np.array([r == room for r in room_of])
        fits &= np.abs(self.free.height_at(points) - self.free.floor_y) < FLOOR_GAP_M
        surface = Receptacle(name="", center=np.zeros(3), half_size=np.full(2, radius), clearance_m=np.inf)
        level = self.free.floor_y
        return [
            (Instance(name=name, asset="", pose=np.array([x, level, z, 0.0, 0.0, 0.0, 1.0])), surface)
            for x, z in points[fits][:FLOOR_TRIED].tolist()
        ]

    def _near(self, thing: str, at: Array, other: str, there: Array) -> bool:
        boxes = [self.home.layout.things[name] for name in (thing, other)]
        sizes = [np.array([[np.hypot(b.half[0], b.half[2]), b.half[1], np.hypot(b.half[0], b.half[2])]]) for b in boxes]
        centers = [np.array([np.add(p, (0, b.center[1], 0))]) for p, b in zip((at, there), boxes, strict=True)]
        return bool(next_to(centers[0], sizes[0] * 0.5, centers[1], sizes[1] * 0.5, BESIDE_M)[0])


@dataclass(eq=False)
class _Draw:
    """One attempt to fill the slots of a template."""

    spots: SpotFinder
    template: Template

    def __post_init__(self) -> None:
        self.home, self.spec, self.rng = self.spots.home, self.spots.spec, self.spots.rng

    def task(self, starts: Starts) -> LanguageTask | None:
        """Return the task; None if the home has nothing for a slot, or no room, or the result fails a check."""
        slots = sorted({slot for clause in self.template.clauses for each in clause_parts(clause)[2] for slot in each})
        things, places, rooms, insides = ([s for s in slots if s in kind] for kind in ("abc", "pq", "rs", "uv"))
        more = self.spec.objects - len(things)
        if more < 0:
            return None
        chosen = self._things([*things, *(f"more_{k}" for k in range(more))])
        where = self._pick(list(self.home.places), places)
        room = self._pick(list(self.home.rooms), rooms)
        within = self._pick(list(self.home.insides), insides)
        if chosen is None or where is None or room is None or within is None:
            return None
        spots = {slot: self.home.places[words] for slot, words in where.items()}
        spots |= {slot: self.home.insides[words] for slot, words in within.items()}
        began = self._starts(chosen, spots, {self.home.rooms[words] for words in room.values()})
        if began is None:
            return None
        names = {slot: (thing,) for slot, thing in chosen.items()}
        names |= {slot: place.names for slot, place in spots.items()}
        names |= {slot: (self.home.rooms[words],) for slot, words in room.items()}
        goals = self._goals(chosen, began, spots, {s: self.home.rooms[w] for s, w in room.items()})
        if goals is None:
            return None
        return self._checked(chosen, began, goals, names, {**where, **room, **within}, starts)

    def _pick(self, known: list[str], slots: Sequence[str]) -> dict[str, str] | None:
        if len(known) < len(slots):
            return None
        return {slot: known[k] for slot, k in zip(slots, self.rng.permutation(len(known)), strict=False)}

    def _things(self, slots: Sequence[str]) -> dict[str, str] | None:
        """Return a thing for each slot, of different kinds, to which can be done what the template asks for."""
        scene, found, kinds = self.home.scene, {}, set()
        verbs = {
            s: v for c in self.template.clauses for n, v, lists in [clause_parts(c)] for s in lists[0] if v in HANDLING
        }
        by_name = {i.name: i for i in scene.instances}
        names = [n for n in self.home.categories if object_extent(scene, by_name[n])[0] <= self.spec.object_radius_m]
        for slot in slots:
            for k in self.rng.permutation(len(names)).tolist():
                kind = self.home.categories[names[k]]
                if (
                    (slot.startswith("more") or kind not in kinds)
                    and names[k] not in found.values()
                    and (slot not in verbs or affords(kind, verbs[slot]))
                ):
                    found[slot] = names[k]
                    kinds.add(kind)
                    break
            else:
                return None
        moved = set(found.values())
        self.spots.taken = [
            (i.pose[:3], object_extent(scene, i)[0])
            for i in scene.instances
            if i.motion == "kinematic" and i.name not in moved
        ]
        return found

    def _starts(
        self, chosen: Mapping[str, str], spots: Mapping[str, Place], rooms: set[str]
    ) -> dict[str, tuple[Array, str]] | None:
        """Return the starts of the things: away from all goals, except for those that stay, and alone of their kind."""
        asked = {name for place in spots.values() for name in place.names}
        began: dict[str, tuple[Array, str]] = {}
        fixed = {
            lists[0][0]: spots[lists[1][0]]
            for c in self.template.clauses
            for _, v, lists in [clause_parts(c)]
            if v == "at"
        }
        for slot, thing in chosen.items():
            kind, home = self.home.categories[thing], self.home
            crowded = {
                home.place_of[on].words
                for other, on in home.lies_on.items()
                if home.categories[other] == kind and other != thing and on in home.place_of
            }
            allowed = [
                name
                for name, place in home.place_of.items()
                if place.words not in crowded
                and (name in fixed[slot].names if slot in fixed else name not in asked and place.room not in rooms)
            ]
            spot = self.spots.find(thing, allowed)
            if spot is None:
                return None
            began[slot] = spot
        return began

    def _goals(
        self,
        chosen: Mapping[str, str],
        began: Mapping[str, tuple[Array, str]],
        spots: Mapping[str, Place],
        rooms: Mapping[str, str],
    ) -> dict[str, list[tuple[Array, str]]] | None:
        """Return the goals of each thing, one after the other; none for those that stay."""
        beside: dict[str, str] = {}
        asked: list[tuple[str, list[str], bool]] = []
        low = {s for c in self.template.clauses for _, v, lists in [clause_parts(c)] if v == "floor" for s in lists[0]}
        either = int(self.rng.integers(2))
        for clause in self.template.clauses:
            number, verb, lists = clause_parts(clause)
            if verb == "next":
                beside |= dict.fromkeys(lists[0], lists[1][0])
            elif verb == "near":
                beside |= dict.fromkeys(lists[0][1:], lists[0][0])
            elif verb in ("on", "inside"):
                options = [spots[s] for s in lists[1]]
                turn = either + (len(asked) if self.template.relation == "different" else 0)
                place = options[turn % len(options)]
                asked += [(s, list(place.names), verb == "inside") for s in lists[0][: number or len(lists[0])]]
            elif verb == "in":
                room = rooms[lists[1][0]]
                there = [n for n, place in self.home.place_of.items() if place.room == room]
                asked += [(slot, [f"{FLOOR}{room}"] if slot in low else there, False) for slot in lists[0]]
        asked += [(slot, [], False) for slot in beside if slot not in {each[0] for each in asked}]
        asked.sort(key=lambda each: each[0] in beside)  # what others come to stand beside, first
        goals: dict[str, list[tuple[Array, str]]] = {}
        for slot, furniture, inside in asked:
            anchor = None
            if slot in beside:
                anchor = (goals.get(beside[slot]) or [began[beside[slot]]])[-1]
                furniture = [anchor[1].partition("|")[0]]
            other = chosen.get(beside.get(slot, ""), "")
            spot = self.spots.find(chosen[slot], furniture, inside=inside, other=other, anchor=anchor)
            if spot is None:
                return None
            goals.setdefault(slot, []).append(spot)
        return goals

    # --- the result ---------------------------------------------------------------------------------------------------
    def _checked(
        self,
        chosen: Mapping[str, str],
        began: Mapping[str, tuple[Array, str]],
        goals: Mapping[str, list[tuple[Array, str]]],
        names: Mapping[str, tuple[str, ...]],
        words: Mapping[str, str],
        starts: Starts,
    ) -> LanguageTask | None:
        stays = {slot for slot in chosen if slot not in goals}
        order = list(chosen)
        phrases = {}
        for slot, thing in chosen.items():
            place = self.home.place_of[began[slot][1].partition("|")[0]]
            phrases[slot] = thing_words(self.home, thing, place, stays=slot in stays)
        if len(set(phrases.values())) < len(phrases):
            return None
        wording = self.template.wordings[int(self.rng.integers(len(self.template.wordings)))]
        text = wording.format(**phrases, **words)
        instruction = text[:1].upper() + text[1:]
        targets = tuple(
            Target(
                chosen[s],
                np.concatenate([began[s][0], quat_from_heading(self.rng.uniform(-np.pi, np.pi))]),
                (goals.get(s) or [began[s]])[0][0],
                began[s][1],
                in_scene((goals.get(s) or [began[s]])[0][1]),
            )
            for s in order
        )
        states, uses = self._states(order)
        layout = Layout.of_scene(self.home.scene, [chosen[s] for s in order], self.spots.free.floor_y)
        told = evaluation_of(self.template, names)
        errands = errands_of(self.template, order, goals)
        later = {chosen[s]: [spot[0].tolist() for spot in goals[s][1:]] for s in order if len(goals.get(s, ())) > 1}
        extra = {
            "template": self.template.name,
            "kind": self.template.kind,
            **told,
            LAYOUT: msgspec.to_builtins(layout),
            "states": states,
            "uses": uses,
            "later_goals": later,
            "errands": msgspec.to_builtins(errands),
        }
        task = LanguageTask(instruction=instruction, targets=targets, starts=starts, extra=extra)
        means: Words = {
            "abc": {phrases[s]: names[s] for s in order},
            "pq": {place: p.names for place, p in self.home.places.items()},
            "rs": {room: (name,) for room, name in self.home.rooms.items()},
            "uv": {place: p.names for place, p in self.home.insides.items()},
        }
        evaluation = Evaluation.of(told)
        sound = parse(instruction, means) == [evaluation] and can_be_done(task)
        sound = sound and steps_alone(task, self.spec) <= IN_TIME * max(self.spec.max_steps, LanguageSpec.max_steps)
        return task if sound else None

    def _states(self, order: Sequence[str]) -> tuple[dict[str, list[bool]], list[list[Any]]]:
        """Return states of the things at the start, and what a person who handles each does: a state and its value."""
        states, uses = {name: [False] * len(order) for name in STATES}, [["", False] for _ in order]
        for clause in self.template.clauses:
            _, verb, lists = clause_parts(clause)
            for slot in lists[0] if verb in HANDLING else ():
                state, value = HANDLING[verb]
                states[state][order.index(slot)] = not value
                uses[order.index(slot)] = [state, value]
        return states, uses


def in_scene(receptacle: str) -> str:
    """Return the name of a receptacle as in scenes; empty for a place on the floor."""
    return "" if receptacle.startswith(FLOOR) else receptacle


def errands_of(
    template: Template, order: Sequence[str], goals: Mapping[str, Sequence[tuple[NDArray, str]]]
) -> tuple[Errand, ...]:
    """Return the errands of a template, in the order that it requires."""
    found: list[Errand] = []
    of_clause: list[list[int]] = []
    for k, clause in enumerate(template.clauses):
        number, verb, lists = clause_parts(clause)
        subjects = lists[0][: number or len(lists[0])] if verb != "at" else []
        mine = []
        for slot in subjects:
            thing, handle = order.index(slot), verb in HANDLING
            if not handle and slot not in goals:
                continue
            stage = k if template.moves_twice else 0
            same = [n for n, e in enumerate(found) if (e.thing, e.handle, e.stage) == (thing, handle, stage)]
            mine.append(same[0] if same else len(found))
            if not same:
                found.append(Errand(thing, handle, stage))
        of_clause.append(mine)
    edges = template.order + (((0, 1),) if template.moves_twice else ())
    after = {k: {e for a, b in edges if k in of_clause[b] for e in of_clause[a] if e != k} for k in range(len(found))}
    return tuple(msgspec.structs.replace(e, after=tuple(sorted(after[k]))) for k, e in enumerate(found))


def steps_alone(task: LanguageTask, spec: LanguageSpec) -> float:
    """Estimate the steps that a person alone takes for a task's errands, one after the other."""
    here, length = task.starts.human_xz, 0.0
    errands = msgspec.convert(task.extra["errands"], list[Errand])
    for errand in errands:
        target = task.targets[errand.thing]
        goal = [target.goal, *task.extra["later_goals"].get(target.name, ())][0 if errand.handle else errand.stage]
        for point in (target.start, goal):
            there = np.asarray(point)[[0, 2]]
            length, here = length + DETOUR * float(np.hypot(*(there - here))), there
    return (length / spec.human.speed_mps + ERRAND_S * len(errands)) / STEP_S


def can_be_done(task: LanguageTask) -> bool:
    """Return whether a task's errands complete it when done in sequence, and it is not complete from the start."""
    verdict = evaluate_errands(task.targets, task.extra)
    return verdict.percent_complete == 1 and not bool((verdict.satisfied_at == 0).any())


def evaluate_errands(targets: Sequence[Target], extra: Mapping[str, Any]) -> Verdict:
    """Evaluate the propositions of a task whose errands are done in sequence."""
    evaluation, layout = Evaluation.of(extra), msgspec.convert(extra[LAYOUT], Layout)
    poses = [np.array([t.start for t in targets], np.float32)]
    states = [{name: np.array(flags, np.bool_) for name, flags in extra["states"].items()}]
    done: list[int] = []
    errands = msgspec.convert(extra["errands"], list[Errand])
    while len(done) < len(errands):
        k = next(k for k, e in enumerate(errands) if k not in done and set(e.after) <= set(done))
        errand, pose, state = errands[k], poses[-1].copy(), {name: flags.copy() for name, flags in states[-1].items()}
        target = targets[errand.thing]
        if errand.handle:
            name, value = extra["uses"][errand.thing]
            state[name][errand.thing] = value
        else:
            pose[errand.thing, :3] = [target.goal, *extra["later_goals"].get(target.name, ())][errand.stage]
        done.append(k)
        for _ in range(len(evaluation.propositions)):  # dependencies look at the rows before
            poses.append(pose)
            states.append(state)
    rows = Rows(
        layout,
        np.stack(poses),
        np.zeros((len(poses), len(targets)), np.bool_),
        {name: np.stack([s[name] for s in states]) for name in STATES},
    )
    return evaluate(evaluation, rows)
