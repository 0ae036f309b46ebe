"""PARTNR's episodes as tasks in words, with goals and an order that make their propositions true.

An episode defines when it is complete, but not how. Here each of its propositions gets things, and each thing gets a
place, so that experts and skills have goals. Only the propositions are evaluated. The files are those of PARTNR's
users, with its scenes and objects (Chang et al. 2024, 2411.00081).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter
from typing import Any

import msgspec
import numpy as np

from h3data.bodies import Humanoid, Robot
from h3data.errors import FormatError, InputError, SceneError
from h3data.geometry import Array
from h3data.recording.task_episodes.partnr_goals import Placement
from h3data.recording.task_episodes.rearrange_episode import RearrangeEpisode as FileEntry
from h3data.recording.task_episodes.rearrange_episode import instance_handles
from h3data.recording.task_episodes.stored_rearrangements import StoredRearrangement, rearrangement_of
from h3data.scene import FreeSpace, Scene
from h3data_language.episode import Errand, LanguageSpec, SpotFinder, evaluate_errands, in_scene
from h3data_language.evaluation.layout import LAYOUT, Layout, owner_of
from h3data_language.evaluation.predicates import check_names
from h3data_language.evaluation.records import (
    CONSTRAINTS,
    DEPENDENCIES,
    PROPOSITIONS,
    THEIR_STATES,
    Evaluation,
    Proposition,
)
from h3data_language.evaluation.records import STATES as STATE_OF
from h3data_language.grounding import FLOOR, Home, home_of, room_at
from h3data_language.templates import Kind
from sim_kinematic.agents.driven.object_room import object_extent
from sim_kinematic.motion.randomness import generator
from sim_kinematic.tasks.rearrange.episode import Target

TRIES = 8
"""Number of random placements of the objects that are tried."""
LONGEST_INSTRUCTION = 5_000
"""Largest number of characters of an instruction, which is part of every request to a language model."""
MAX_STEPS = 20_000
"""Longest duration of PARTNR's episodes [steps]."""


class StoredLanguage(StoredRearrangement, frozen=True, kw_only=True):
    """Task in words that is stored in an episode file."""

    extra: Mapping[str, Any]
    """Value of `Episode.extra`: propositions, layout, states, errands; without layout and errands for PARTNR's
    files."""

    @property
    def is_planned(self) -> bool:
        """True if the places of all things are known; PARTNR's files do not state them."""
        return LAYOUT in self.extra


def read_episode(entry: FileEntry) -> StoredLanguage | None:
    """Read an episode of PARTNR's files; None for other episodes.

    Raises:
        FormatError: its propositions or states are malformed.
        InputError: the episode cannot be played in any scene.
    """
    if PROPOSITIONS not in entry.extra:
        return None
    where, handles = f"Episode {entry.episode_id!r}", instance_handles(entry)
    base = rearrangement_of(
        entry, tuple(Placement(object=n, receptacles=(), source=entry.name_to_receptacle.get(n, "")) for n in handles)
    )
    try:
        propositions = _original(Evaluation.of(entry.extra), entry.extra)
    except InputError as fault:
        raise InputError(f"{where}: {fault}", code=fault.code) from None
    if len(base.instruction) > LONGEST_INSTRUCTION:
        raise InputError(
            f"{where} has an instruction of {len(base.instruction)} characters, expected at most {LONGEST_INSTRUCTION}.",
            code="H3-LANGUAGE-034",
        )
    things = list(handles)
    if not propositions or not things:
        raise InputError(
            f"{where} has no objects or no propositions, so there is nothing to do.", code="H3-LANGUAGE-022"
        )
    for p in propositions:
        if p.function_name in STATE_OF and not set(p.things[0]) <= set(things):
            raise InputError(
                f"{where} asks for a state of furniture, and only those of its objects change.", code="H3-LANGUAGE-024"
            )
    extra = {key: entry.extra.get(key) or [] for key in (PROPOSITIONS, DEPENDENCIES, CONSTRAINTS)}
    return StoredLanguage(
        **{f: getattr(base, f) for f in base.__struct_fields__},
        extra={"template": "partnr", "kind": kind_of(propositions, extra), **extra, "states": states_of(entry, things)},
    )


def states_of(entry: FileEntry, things: Sequence[str]) -> dict[str, list[bool]]:
    """Return the states of things at the start of an episode, by h3data's names; missing states are false.

    Raises:
        FormatError: the states are malformed.
    """
    try:
        states = msgspec.convert(entry.extra.get("object_states") or {}, dict[str, dict[str, bool]])
    except msgspec.ValidationError as fault:
        raise FormatError(
            f"Episode {entry.episode_id!r}: object_states: {str(fault).replace('`', '')}", code="H3-LANGUAGE-032"
        ) from None
    of = {state: states.get(name, {}) for state, name in THEIR_STATES.items()}
    return {state: [flags.get(thing, False) for thing in things] for state, flags in of.items()}


def kind_of(propositions: Sequence[Proposition], extra: Mapping[str, Any]) -> Kind:
    """Return PARTNR's type of a task.

    If several types fit, the first in this order is used: actions that only people can do, an order of steps, things
    near each other.
    """
    names = {p.function_name for p in propositions}
    if names & set(STATE_OF):
        return "heterogeneous"
    if any(c["type"] == "TemporalConstraint" and c.get("args", {}).get("dag_edges") for c in extra[CONSTRAINTS]):
        return "temporal"
    return "spatial" if names & {"is_next_to", "is_clustered"} else "free"


@dataclass(eq=False)
class _Stage:
    """A place to which a thing is brought."""

    rank: int
    """Number of propositions that come before the stage in sequence."""
    furniture: set[str] | None = None
    """Furniture that is suitable; None: that of the anchor."""
    inside: bool = False
    anchor: str = ""
    """Thing next to which the thing has to be."""
    of: list[int] = field(default_factory=list)
    """Propositions that become true by the stage."""


@dataclass(eq=False)
class PartnrPlan:
    """Assignment of things and places to the propositions of an episode."""

    home: Home
    things: list[str]
    propositions: list[Proposition]
    edges: list[tuple[int, int]]
    """Pairs of propositions, with the earlier one first."""

    def __post_init__(self) -> None:
        before: dict[int, set[int]] = {k: set() for k in range(len(self.propositions))}
        for early, late in self.edges:
            before[late].add(early)
        try:
            order = list(TopologicalSorter(before).static_order())
        except CycleError:
            raise InputError(
                "Its propositions have to come before each other in a circle.", code="H3-LANGUAGE-025"
            ) from None
        self.rank: dict[int, int] = {}
        for k in order:
            self.rank[k] = 1 + max((self.rank[n] for n in before[k]), default=-1)
        self.stages: dict[str, list[_Stage]] = {}
        self.uses: dict[str, tuple[str, bool, list[int]]] = {}
        # neighbors come after the places of their things are known
        late = ("is_next_to", "is_clustered")
        for k in sorted(order, key=lambda k: (self.rank[k], self.propositions[k].function_name in late, k)):
            self._assign(k, self.propositions[k])

    def _assign(self, k: int, p: Proposition) -> None:
        if p.function_name in STATE_OF:
            self._handle(k, p)
        elif p.function_name in ("is_next_to", "is_clustered"):
            self._gather(k, p)
        else:
            layout, inside = self.home.layout, p.function_name == "is_inside"
            rooms = p.things[1] if p.function_name == "is_in_room" else layout.rooms
            floors = {f"{FLOOR}{room}" for room in rooms}
            furniture = floors if p.function_name == "is_on_floor" else set(p.things[1])
            if p.function_name == "is_in_room":
                there = (n for n in self.home.surfaces if room_at(layout, layout.furniture[n].center) in p.things[1])
                furniture = {*there, *floors}
            furniture &= set(self.home.enclosed) if inside else {*self.home.surfaces, *floors}
            if not furniture:
                what = "with an inside that opens" if inside else "with a surface"
                raise SceneError(
                    f"It has no furniture {what} for {', '.join(p.things[-1][:3])}.", code="H3-LANGUAGE-026"
                )
            for name in self._chosen(k, p.things[0], p.number, furniture, inside):
                self._bring(name, k, furniture, inside)

    def _handle(self, k: int, p: Proposition) -> None:
        state, value = STATE_OF[p.function_name]
        fits = [n for n in p.things[0] if self.uses.get(n, (state, value))[:2] == (state, value)]
        fits.sort(key=lambda n: n not in self.uses)
        if len(fits) < p.number:
            raise InputError(
                f"It asks for more than one state of {p.things[0][0]!r}, of which one can be changed.",
                code="H3-LANGUAGE-027",
            )
        for name in fits[: p.number]:
            self.uses.setdefault(name, (state, value, []))[2].append(k)

    def _gather(self, k: int, p: Proposition) -> None:
        if p.function_name == "is_next_to":
            movers, others = p.things
            if not set(movers) & set(self.things):
                movers, others = others, movers
            pairs = [(a, b) for a in movers if a in self.things for b in others if b != a]
            pairs.sort(key=lambda pair: not self._fits(pair[0], k, None, False))
            chosen = dict(reversed(pairs))
            pairs = [(a, chosen[a]) for a in dict.fromkeys(a for a, _ in pairs)][: p.number]
        else:
            counts = p.number if isinstance(p.number, list) else [1] * len(p.things)
            group = [n for names, count in zip(p.things, counts, strict=True) for n in names[:count]]
            pairs = [(name, group[0]) for name in dict.fromkeys(group[1:]) if name != group[0]]
        for name, anchor in pairs:
            if name not in self.things:
                continue
            self._bring(name, k, None, False)
            stage = next(s for s in self.stages[name] if k in s.of)
            stage.anchor = stage.anchor or anchor

    def _fits(self, name: str, k: int, furniture: set[str] | None, inside: bool) -> _Stage | None:
        """Return the stage of a thing by which a proposition becomes true as well, if there is one."""
        for stage in self.stages.get(name, ()):
            if stage.rank != self.rank[k]:
                continue
            if furniture is None or stage.furniture is None or (stage.inside == inside and stage.furniture & furniture):
                return stage
        return None

    def _chosen(self, k: int, names: Sequence[str], number: int, furniture: set[str], inside: bool) -> list[str]:
        """Return the things for a proposition: those that come to its place anyway, then those without another goal."""
        fits = [n for n in dict.fromkeys(names) if n in self.things]
        fits.sort(key=lambda n: (self._fits(n, k, furniture, inside) is None, len(self.stages.get(n, ()))))
        if len(fits) < number:
            raise InputError(f"It asks for {names[0]!r}, which is none of its objects.", code="H3-LANGUAGE-028")
        return fits[:number]

    def _bring(self, name: str, k: int, furniture: set[str] | None, inside: bool) -> None:
        stage = self._fits(name, k, furniture, inside)
        if stage is None:
            if any(s.rank == self.rank[k] for s in self.stages.get(name, ())):
                raise InputError(
                    f"It asks for {name!r} at two places at once, or at one after the other in no order.",
                    code="H3-LANGUAGE-029",
                )
            stage = _Stage(self.rank[k], furniture, inside)
            self.stages.setdefault(name, []).append(stage)
        elif furniture is not None:
            stage.furniture = furniture if stage.furniture is None else stage.furniture & furniture
            stage.inside = inside
        stage.of.append(k)

    # --- places -------------------------------------------------------------------------------------------------------
    def places(
        self, spots: SpotFinder, starts: Mapping[str, tuple[Array, str]], ties: Sequence[tuple[str, list[int]]]
    ) -> dict[str, list[tuple[Array, str]]]:
        """Sample a spot and its receptacle for each stage of each thing.

        Args:
            spots: Finder of free spots, which marks the spots that it returns as taken.
            starts: Position [3] and receptacle of each thing.
            ties: Kinds (``Same``, ``Different``) and propositions of constraints about furniture.

        Raises:
            SceneError: there is not enough room.
        """
        found: dict[str, list[tuple[Array, str]]] = {}
        stood: dict[int, str] = {}
        todo = sorted(
            ((s.rank, bool(s.anchor), name, s) for name, stages in self.stages.items() for s in stages),
            key=lambda each: each[:3],
        )
        for _, _, name, stage in todo:
            anchor, allowed = None, set(self.home.surfaces) if stage.furniture is None else stage.furniture
            if stage.anchor in self.things:
                anchor = (found.get(stage.anchor) or [starts[stage.anchor]])[-1]
                there = {owner_in(anchor[1])}
                allowed = allowed & there or (there if stage.furniture is None else allowed)
            for kind, of in ties:
                others = {stood[n] for n in of if n in stood and n not in stage.of}
                if others and set(of) & set(stage.of):
                    allowed = allowed & others if kind == "Same" else allowed - others
            allowed = {n for n in allowed if not n.startswith(FLOOR)} or allowed  # the floor if nothing else will do
            tries = (
                spots.find(name, sorted(allowed), inside=stage.inside, other=stage.anchor, anchor=anchor)
                for _ in range(TRIES if anchor else 1)
            )
            spot = next((each for each in tries if each is not None), None)
            if spot is None:
                raise SceneError(
                    f"It has no place for {name!r} within reach of both agents on {', '.join(sorted(allowed)[:3])}"
                    + (f" next to {stage.anchor!r}." if anchor else "."),
                    code="H3-LANGUAGE-030",
                )
            found.setdefault(name, []).append(spot)
            stood |= dict.fromkeys(stage.of, owner_in(spot[1]))
        return found

    def errands(self) -> tuple[Errand, ...]:
        """Return the errands, with their order."""
        found: list[Errand] = []
        of: list[list[int]] = []
        for name, stages in self.stages.items():
            for n, stage in enumerate(sorted(stages, key=lambda s: s.rank)):
                found.append(Errand(self.things.index(name), False, n))
                of.append(stage.of)
        for name, (_, _, propositions) in self.uses.items():
            found.append(Errand(self.things.index(name), True))
            of.append(propositions)
        after = [
            {a for a in range(len(found)) if any((i, j) in self.edges for i in of[a] for j in of[b]) and a != b}
            | {a for a in range(len(found)) if found[a].thing == found[b].thing and found[a].stage < found[b].stage}
            for b in range(len(found))
        ]
        return tuple(msgspec.structs.replace(e, after=tuple(sorted(a))) for e, a in zip(found, after, strict=True))


def plan_episode(
    record: StoredLanguage, scene: Scene, free: FreeSpace, spec: LanguageSpec, robot: Robot, human: Humanoid
) -> tuple[tuple[Target, ...], dict[str, Any]]:
    """Place the goals for the things of an episode of PARTNR's files in its scene; also return `Episode.extra`.

    Raises:
        InputError: its propositions name things that are not in the scene, or contradict each other.
        SceneError: the scene has no places that make the propositions true.
    """
    home, things = home_of(scene, spec.open_m), [thing.name for thing in record.objects]
    poses = {i.name: np.asarray(i.pose, np.float64) for i in scene.instances}
    layout, evaluation = Layout.of_scene(scene, things, free.floor_y), Evaluation.of(record.extra)
    check_names(evaluation.propositions, layout)
    original = _original(evaluation, record.extra)
    plan = PartnrPlan(home, things, original, _edges(evaluation, len(original)))
    ties = [
        (c.type.removesuffix("ArgConstraint"), [k for k in c.indices if k < len(original)])
        for c in evaluation.constraints
        if "Arg" in c.type and set(c.args["arg_names"]) == {"receptacle_handles"}
    ]
    errands, uses = plan.errands(), [list(plan.uses.get(name, ("", False))[:2]) for name in things]
    sources = _sources(record, scene)
    lies_on = {name: home.lies_on.get(name) or f"{FLOOR}{room_at(layout, poses[name][:3])}" for name in things}
    starts = {name: (poses[name][:3], sources[name] or f"{lies_on[name]}|") for name in things}
    taken = [
        (i.pose[:3], object_extent(scene, i)[0])
        for i in scene.instances
        if i.motion == "kinematic" and i.name not in plan.stages
    ]
    extra: dict[str, Any] = {
        **record.extra,
        LAYOUT: msgspec.to_builtins(layout),
        "uses": uses,
        "errands": msgspec.to_builtins(errands),
    }
    why: InputError | SceneError | None = None
    for attempt in range(TRIES):
        rng = generator(record.seed, "partnr", step=attempt)
        spots = SpotFinder(home, free, spec, robot, human, rng, [*taken])
        try:
            goals = plan.places(spots, starts, ties)
        except SceneError as fault:
            why = why or fault
            continue
        targets = tuple(
            Target(
                name,
                poses[name],
                (goals.get(name) or [starts[name]])[0][0],
                sources[name],
                in_scene((goals.get(name) or [(0, "")])[0][1]),
            )
            for name in things
        )
        later = {name: some[1:] for name, some in goals.items() if some[1:]}
        extra["later_goals"] = {name: [point.tolist() for point, _ in some] for name, some in later.items()}
        extra["later_receptacles"] = {name: [on for _, on in some] for name, some in later.items()}
        verdict = evaluate_errands(targets, extra)
        if verdict.percent_complete == 1:
            return targets, extra
        why = InputError(
            f"Its propositions do not all become true by bringing things to their places: {verdict.explanation}.",
            code="H3-LANGUAGE-031",
        )
    assert why is not None
    raise why


def _sources(record: StoredLanguage, scene: Scene) -> dict[str, str]:
    """Return receptacle of the scene (``instance|receptacle``) on which each thing lies in the file, or empty texts."""
    known = {f"{i.name}|{r.name}": f"{owner_of(scene, i.name)}|{r.name}" for i, r in scene.receptacles()}
    return {p.object: next((n for n, alias in known.items() if p.source in (n, alias)), "") for p in record.placements}


def owner_in(receptacle: str) -> str:
    """Return the furniture in the name of a receptacle, such as ``counter_0`` in ``counter_0/drawer_1|bottom``."""
    name = receptacle.partition("|")[0]
    return name if name.startswith(FLOOR) else name.partition("/")[0]


def _original(evaluation: Evaluation, info: Mapping[str, Any]) -> list[Proposition]:
    """Return the propositions as the file has them, which come before the copies with fewer things."""
    return list(evaluation.propositions[: len(info[PROPOSITIONS])])


def _edges(evaluation: Evaluation, count: int) -> list[tuple[int, int]]:
    """Return the pairs of propositions, the earlier first, of which one waits for the other."""
    pairs = {(a, b) for c in evaluation.constraints if c.type == "TemporalConstraint" for a, b in c.edges}
    for d in evaluation.dependencies:
        for k in d.proposition_indices:
            pairs |= {(k, n) if d.relation_type == "before_satisfied" else (n, k) for n in d.depends_on}
    return sorted((a, b) for a, b in pairs if a < count and b < count)
