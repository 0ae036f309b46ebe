"""Task ``language``: agents carry out an instruction in words, and propositions measure their progress."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot, load_humanoid, load_robot
from h3data.errors import InputError, suggest
from h3data.geometry import transform_points
from h3data.policies import Action, AssignedPolicy, PolicyMaker
from h3data.recording import Event, Recording
from h3data.recording.task_episodes.rearrange_episode import RearrangeEpisode as FileEntry
from h3data.recording.task_episodes.stored_episodes import plain, read_info_block, task_of
from h3data.recording.task_episodes.stored_rearrangements import StoredRearrangement
from h3data.scene import FreeSpace, Scene
from h3data.tasks import (
    Control,
    Episode,
    EpisodeCodec,
    Rearrange,
    RearrangeCodec,
    SkillControl,
    StepOutcome,
    TaskUsage,
    WorldRollout,
)
from h3data_language.episode import STATES, LanguageSpec, SpotFinder, sample_task
from h3data_language.evaluation.engine import STATE_COLUMNS, evaluate
from h3data_language.evaluation.layout import LAYOUT, Layout
from h3data_language.evaluation.predicates import Rows, check_names
from h3data_language.evaluation.records import CONSTRAINTS, DEPENDENCIES, PROPOSITIONS, Evaluation
from h3data_language.experts import EXPERTS, expert
from h3data_language.grounding import FLOOR, home_of
from h3data_language.partnr import MAX_STEPS, StoredLanguage, plan_episode, read_episode
from sim_kinematic.agents.driven.object_room import object_extent
from sim_kinematic.agents.roster import ROBOT_BODY, kinds_of, with_body
from sim_kinematic.agents.skills import INSIDE, Destination, sentence
from sim_kinematic.motion.randomness import generator
from sim_kinematic.motion.state import NOBODY
from sim_kinematic.tasks.codec import EpisodePlace, SceneAndMap, malformed_info, require_info, uid_of
from sim_kinematic.tasks.episode import Starts
from sim_kinematic.tasks.rearrange.codec import goal_record
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode, rules_in
from sim_kinematic.tasks.skills.household import Household

HANDLING_STEPS = 12
"""Number of steps that a person takes to clean, fill, pour out or switch something [1/30 s]."""
HANDLING_M = 1.5
"""Largest distance on the floor from a person to a thing that they handle [m]."""
_STORED = (PROPOSITIONS, DEPENDENCIES, CONSTRAINTS, LAYOUT)


class LanguageCodec(RearrangeCodec):
    """Codec of tasks in words, which extends that of rearrangement by propositions in PARTNR's JSON."""

    foreign: ClassVar[str] = PROPOSITIONS

    def record(self, episode: Episode) -> StoredLanguage:
        """Return the record of an episode: the record of rearrangement, and the other sampled values."""
        record = super().record(episode)
        return StoredLanguage(**{f: getattr(record, f) for f in record.__struct_fields__}, extra=plain(episode.extra))

    entry = EpisodeCodec[StoredRearrangement].entry  # not in the form of Habitat's rearrangement episodes

    def read(self, entry: FileEntry, *, seed: int) -> StoredLanguage | None:
        """Return the record in an entry of h3data's or PARTNR's files with a seed; None for entries of other tasks.

        Raises:
            FormatError, InputError: its propositions are malformed, or require things that cannot be played.
        """
        record = read_info_block(entry, self.task.name, StoredLanguage)
        if record is not None:
            check_extra(record.extra, len(record.goals))
        elif task_of(entry) is None and (record := read_episode(entry)) is not None:
            record = msgspec.structs.replace(record, seed=seed)
        return record

    def rules(self, record: StoredRearrangement) -> LanguageSpec:
        """Return the rules in a record; PARTNR's episodes may last longer than h3data's."""
        spec = super().rules(record)
        assert isinstance(spec, LanguageSpec)
        return spec if record.rules else replace(spec, max_steps=MAX_STEPS)

    def episode(self, record: StoredRearrangement, place: EpisodePlace) -> RearrangeEpisode:
        """Return the episode of a record in an opened scene, where the things of PARTNR's episodes get places.

        Raises:
            InputError, SceneError: PARTNR's episode requires things that are not in the scene, or cannot be completed
                in it.
        """
        assert isinstance(record, StoredLanguage)
        if not record.is_planned:
            scene, _ = self._furnished(record, place)
            pair = place.robot or ROBOT_BODY, with_body(place.human, "")
            bodies = load_robot(pair[0]), load_humanoid(pair[1])
            spec = replace(place.spec, floor_moves=rules_in(scene, place.spec).floor_moves)
            targets, extra = plan_episode(record, scene, place.free, spec, *bodies)
            goals = tuple(goal_record(target) for target in targets)
            record = msgspec.structs.replace(record, goals=goals, placements=(), com_frames=False, extra=extra)
        return replace(super().episode(record, place), extra=record.extra)

    def restore(self, recording: Recording, scene: SceneAndMap) -> RearrangeEpisode:
        """Return the episode of a recording, from the rules, starts, goals and propositions in its info.

        Raises:
            InputError: one of these entries is missing or malformed.
        """
        require_info(recording, "extra", *_STORED)
        info, episode = recording.episode.info, super().restore(recording, scene)
        try:
            extra = msgspec.convert({**info["extra"], **{name: info[name] for name in _STORED}}, dict[str, Any])
        except (msgspec.ValidationError, TypeError) as fault:
            raise malformed_info(fault) from None
        check_extra(extra, len(episode.targets))
        return replace(episode, extra=extra)

    def info(self, episode: Episode, policies: Sequence[AssignedPolicy]) -> dict[str, Any]:
        """Return the info of rearrangement with propositions, dependencies, constraints and the home's layout."""
        extra = dict(episode.extra)
        stored = {name: extra.pop(name) for name in _STORED}
        return {**super().info(episode, policies), **stored, "extra": extra}

    def uid(self, episode: Episode, policies: Sequence[AssignedPolicy]) -> str:
        """Return an identifier derived from that of rearrangement, starts, goals, propositions, layout and states."""
        assert isinstance(episode, RearrangeEpisode)
        what = msgspec.json.encode([episode.wording, [goal_record(t) for t in episode.targets], plain(episode.extra)])
        return uid_of(f"{super().uid(episode, policies)}:{what.decode()}")

    def final_info(self, episode: Episode, play: WorldRollout, policies: Sequence[AssignedPolicy]) -> dict[str, Any]:
        """Return the reason why the episode ended."""
        return {"ended": play.ended}

    def precompute(self, episode: Episode) -> dict[str, Any]:
        """Return nothing, because no value takes long to compute."""
        return {}


def check_extra(extra: Mapping[str, Any], things: int) -> None:
    """Check the propositions of an episode, and the data about its things.

    Raises:
        InputError: propositions are malformed, or name things that are not in the home.
    """
    check_names(Evaluation.of(extra).propositions, Layout.of_info(extra))
    try:
        uses = msgspec.convert(extra.get("uses"), list[tuple[str, bool]])
        states = msgspec.convert(extra.get("states"), dict[str, list[bool]])
    except msgspec.ValidationError as fault:
        raise malformed_info(fault) from None
    fits = len(uses) == things and set(states) == set(STATES) and all(len(flags) == things for flags in states.values())
    if not fits or {name for name, _ in uses} - {"", *STATES} or len(extra[LAYOUT]["things"]) != things:
        raise InputError(
            f"Expected states and uses of {things} things in a task in words, got {states} and {uses}.",
            code="H3-LANGUAGE-015",
        )


class LanguageControl(SkillControl):
    """Control by skills, with which people can also handle a thing by a ``wait`` with it as the target.

    The thing must be in the person's hand or near them.
    """

    def team(self, play: Any) -> Household:
        """Return agents who choose where things go."""
        return LanguageHousehold(play)

    def refusal(self, play: Any, number: int, choice: Any) -> str | None:
        """Return the reason why a choice is infeasible now, as a sentence; None if it is feasible."""
        if isinstance(choice, Action) and isinstance(choice.command, Destination):
            why = play.team.spot_for(choice.target, choice.command)
            return sentence(why) if isinstance(why, str) else None
        if isinstance(choice, Action) and choice.skill == "wait" and choice.target >= 0:
            return why_not(play, number, choice.target)
        return super().refusal(play, number, choice)


def why_not(play: Any, number: int, thing: int) -> str | None:
    """Return the reason why an agent cannot handle a thing now, as a sentence; None if it can."""
    state = play.world.state
    if play.episode.roster[number].kind != "human":
        return "It has no hand for water and switches."
    if not play.episode.extra["uses"][thing][0]:
        return "There is nothing to do to it in this task."
    if state.held_by[0, thing] not in (NOBODY, number):
        return "Somebody else holds it."
    far = np.hypot(*(state.object_pose[0, thing, [0, 2]] - state.agents[number].xz[0])) > HANDLING_M
    return "It is too far away to reach from here." if far else None


class LanguageHousehold(Household):
    """Agents who can also put things at places other than the goals of the task."""

    def aim(self, number: int, action: Action) -> str:
        """Assign a free spot at a destination to a thing as its goal, and record an event."""
        if not isinstance(action.command, Destination):
            return super().aim(number, action)
        name, found = self.objects.names[action.target], self.spot_for(action.target, action.command)
        event = Event(step=self.play.step, agent=number, kind="aim", target=name, detail=str(action.command))
        self.play.events.append(event)
        if isinstance(found, str):
            return found
        self.set_goal(action.target, *found)
        self.at_goal = self._at_goal()
        return ""

    def spot_for(self, k: int, to: Destination) -> tuple[NDArray[np.floating], str] | str:
        """Return a free spot [3] [m] for thing ``k`` and its receptacle, or the reason why there is none.

        The spot depends on the episode's seed, the step and the current positions of things.

        Raises:
            InputError: there is no such furniture, room or thing.
        """
        episode, names = self.episode, self.objects.names
        if not 0 <= k < len(names):
            raise InputError(f"Expected one of {len(names)} things, got {k}.", code="H3-LANGUAGE-017")
        home = home_of(episode.scene, episode.spec.open_m)
        inside, place = to.place.startswith(INSIDE), to.place.removeprefix(INSIDE)
        known: Mapping[str, Any] = home.enclosed if inside else home.surfaces
        furniture = [n for n, p in home.place_of.items() if p.room == place] if place not in known else [place]
        if place.startswith(FLOOR) and place.removeprefix(FLOOR) in home.layout.rooms:
            furniture = [place]
        if not furniture or (to.next_to and to.next_to not in names):
            missing, there = (to.next_to, names) if furniture else (place, (*known, *home.rooms.values()))
            raise InputError(
                f"There is no {missing!r} where things can be put in this home.{suggest(missing, list(there))}",
                code="H3-LANGUAGE-018",
            )
        anchor = (self.objects.poses[names.index(to.next_to), :3], "") if to.next_to else None
        lying = [n for n in range(len(names)) if n != k and self.objects.held_by[n] == NOBODY]
        by_name = {i.name: i for i in episode.scene.instances}
        taken = [(i.pose[:3], i.name) for i in by_name.values() if i.motion == "kinematic" and i.name not in names]
        taken += [(self.objects.poses[n, :3].copy(), names[n]) for n in lying]
        if self.objects.openables is not None:  # where they are once drawers are closed, as spots are
            for back in np.linalg.inv(self.objects.openables.joints.motions(self.objects.openables.positions)):
                moved = [(transform_points(back, self.objects.poses[[n], :3])[0], names[n]) for n in lying]
                taken += moved if inside and (back != np.eye(4)).any() else []
        finder = SpotFinder(
            home,
            episode.free,
            episode.spec,
            load_robot(episode.pair[0]),
            load_humanoid(episode.pair[1]),
            generator(episode.seed, f"put/{k}", step=self.play.step),
            [(point, object_extent(episode.scene, by_name[name])[0]) for point, name in taken],
        )
        spot = finder.find(names[k], furniture, inside=inside, other=to.next_to, anchor=anchor)
        return "no_space" if spot is None else spot


def _later_goals(extra: Mapping[str, Any], thing: str) -> list[tuple[NDArray[np.float64], str]]:
    """Return goals of a thing after the first, with their receptacles, which are named where they may be in drawers."""
    goals = extra["later_goals"].get(thing, ())
    names = extra.get("later_receptacles", {}).get(thing, [""] * len(goals))
    return [(np.array(goal, np.float64), name) for goal, name in zip(goals, names, strict=True)]


def put(things: Sequence[str], thing: str, place: str, next_to: str = "") -> Action:
    """Return the choice of another place for a thing; it takes no time. ``nav_to_goal`` and ``place`` then go there.

    Args:
        things: Names of the things of the task, as in `Objects.names`.
        thing: Name of the thing.
        place: Name of a piece of furniture or a room; ``inside NAME`` for a drawer or a cupboard of the furniture, ``floor of
            NAME`` for the floor of a room.
        next_to: Name of another thing, next to which it goes.

    Raises:
        InputError: there is no such thing.
    """
    for name in (thing, next_to):
        if name and name not in things:
            raise InputError(f"There is no thing {name!r} in this task.{suggest(name, things)}", code="H3-LANGUAGE-019")
    return Action("wait", list(things).index(thing), 0, Destination(place, next_to))


class Language(Rearrange):
    """Task to carry out an instruction in words."""

    name = "language"
    Spec: ClassVar[type[Any]] = LanguageSpec
    profile = "partnr"
    usage: ClassVar[TaskUsage] = TaskUsage(can_be_solo=True)
    control: ClassVar[Control] = LanguageControl()
    columns: ClassVar[Mapping[str, Any]] = {
        "metrics.at_goal": np.bool_,
        "metrics.percent_complete": np.float32,
        **dict.fromkeys(STATE_COLUMNS.values(), np.bool_),
    }
    policies: ClassVar[Mapping[str, Mapping[str, Any]]] = {kind: dict.fromkeys(EXPERTS) for kind in ("robot", "human")}
    defaults: ClassVar[Mapping[str, str]] = {"robot": "language_expert", "human": "language_expert"}

    @property
    def codec(self) -> LanguageCodec:
        """Codec of episodes with propositions."""
        return LanguageCodec(self)

    def draw(
        self, scene: Scene, free: FreeSpace, seed: int, spec: Any, robot: Robot, person: Humanoid
    ) -> tuple[Starts, dict[str, Any]]:
        """Sample starts of robot and person, targets, instruction, and propositions."""
        task = sample_task(scene, free, seed, spec, robot, person)
        return task.starts, {"targets": task.targets, "wording": task.instruction, "extra": task.extra}

    def named_policy(self, kind: str, name: str, spec: Any) -> PolicyMaker | None:
        """Return the maker of an expert, or of a policy that stands still, or None for other names."""
        if name not in EXPERTS:
            return None

        def make(episode: Episode, number: int) -> AssignedPolicy:
            return AssignedPolicy(expert(name, episode, number, kinds_of(episode.roster)), name, kind)

        return make

    # --- rules --------------------------------------------------------------------------------------------------------
    def begin(self, play: Any, rows: NDArray[np.intp]) -> None:
        """Store states, the rows in which something changed, and the progress of handling each thing."""
        extra = play.episode.extra
        play.memory = {
            "evaluation": Evaluation.of(extra),
            "layout": msgspec.convert(extra[LAYOUT], Layout),
            "states": np.array([extra["states"][name] for name in STATES], np.bool_),
            "later": [_later_goals(extra, t.name) for t in play.episode.targets],
            "handled": np.zeros(len(play.episode.targets), np.int64),
            "rows": [],
            "quiet": 0,
            "complete": 0.0,
        }

    def judge(self, play: Any) -> StepOutcome:
        """Reward each share of the task that is completed for the first time; completion ends the episode."""
        memory, state, events = play.memory, play.world.state, []
        self._handle(play, events)
        held, at_goal = state.held_by[0] != NOBODY, play.team.at_goal.copy()
        row = state.object_pose[0].astype(np.float32), held.copy(), memory["states"].copy()
        for k, later in enumerate(memory["later"]):
            if later and at_goal[k]:
                play.team.set_goal(k, *later.pop(0))
        before = memory["complete"]
        if self._is_new(memory, row):
            memory["rows"].append(row)
            poses, hands, states = (np.stack(part) for part in zip(*memory["rows"], strict=True))
            known = {name: states[:, n] for n, name in enumerate(STATES)}
            verdict = evaluate(memory["evaluation"], Rows(memory["layout"], poses, hands, known))
            memory["complete"] = verdict.percent_complete
        success = memory["complete"] == 1.0
        collides = play.world.touching.any(1)
        return StepOutcome(
            reward=np.array([memory["complete"] - before + 10.0 * success]),
            terminated=np.array([success]) | (collides & play.spec.end_on_collision),
            success=np.array([success]),
            columns={
                "metrics.at_goal": at_goal[None],
                "metrics.percent_complete": np.array([memory["complete"]]),
                **{column: memory["states"][None, n].copy() for n, column in enumerate(STATE_COLUMNS.values())},
            },
            ended="success" if success else "collision",
            events=[*events, *play.events_where(np.array([success]), "success")],
        )

    @staticmethod
    def _is_new(memory: dict[str, Any], row: tuple[NDArray, ...]) -> bool:
        """Return whether a row may change the evaluation, which looks a few rows back where things depend on each other."""
        if memory["rows"]:
            poses, held, states = memory["rows"][-1]
            loose = ~row[1]
            same = np.array_equal(held, row[1]) and np.array_equal(states, row[2])
            if same and np.array_equal(poses[loose], row[0][loose]):
                memory["quiet"] += 1
                return memory["quiet"] <= len(memory["evaluation"].propositions)
        memory["quiet"] = 0
        return True

    @staticmethod
    def _handle(play: Any, events: list[tuple[int, Event]]) -> None:
        """Clean, fill, pour out and switch the things that people have handled for long enough."""
        handled, now = play.memory["handled"], set()
        for number, controller in enumerate(play.team.controllers):
            skill, thing = controller.action[:2]
            busy = controller.skill is not None and skill == "wait" and 0 <= thing < len(handled)
            if busy and why_not(play, number, thing) is None:
                now.add(thing)
                handled[thing] += 1
                name, value = play.episode.extra["uses"][thing]
                flags = play.memory["states"][STATES.index(name)]
                if handled[thing] >= HANDLING_STEPS and flags[thing] != value:
                    flags[thing] = value
                    detail = name if value else f"not {name}"
                    target = play.episode.targets[thing].name
                    events.append((0, Event(step=play.step, agent=number, kind="state", target=target, detail=detail)))
        handled[[k for k in range(len(handled)) if k not in now]] = 0
