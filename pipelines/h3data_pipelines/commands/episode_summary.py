"""Summary of an episode file with its counts, scenes, tasks, objects, receptacles and distances."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from h3data.errors import H3DataError
from h3data.recording.task_episodes.partnr_goals import PROPOSITIONS
from h3data.recording.task_episodes.rearrange_episode import EpisodeSet, RearrangeEpisode, template_name
from h3data.recording.task_episodes.social_nav_episodes import read_social_nav
from h3data.recording.task_episodes.stored_episodes import task_of
from h3data.recording.task_episodes.stored_rearrangements import StoredRearrangement, read_rearrangement
from sim_kinematic.tasks.registry import find_task, task_registry

_LISTED = 6
_LONGEST = 48


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Minimum, mean and maximum of a list of numbers."""

    least: float
    mean: float
    greatest: float

    def text(self, unit: str = "") -> str:
        """Return the numbers as readable text with three significant digits."""
        if self.least == self.greatest:
            return f"{self.mean:g}{unit}"
        return f"{self.least:.3g} to {self.greatest:.3g}{unit} ({self.mean:.3g} on average)"


@dataclass(frozen=True, kw_only=True)
class EpisodeSummary:
    """Contents of an episode file."""

    episodes: int
    tasks: Mapping[str, int]
    """Number of episodes by task and by the program that wrote them."""
    scenes: Mapping[str, int]
    complete: int
    """Number of episodes that contain the starts of the agents."""
    objects: Spread | None
    """Spread of the number of objects that an episode adds to its scene."""
    goals: Spread | None
    """Spread of the number of objects that have to be moved in an episode."""
    templates: Mapping[str, int]
    """Number of objects to be moved by template, or by name in h3data's own files."""
    sources: Mapping[str, int]
    """Number of goals by the receptacle on which the object lies."""
    destinations: Mapping[str, int]
    """Number of goals by the receptacle to which the object has to be moved."""
    carry_m: Spread | None
    """Straight-line distance on the floor from objects to their goals [m]."""
    apart_m: Spread | None
    """Straight-line distance between the starts of robot and person [m]."""
    predicates: Mapping[str, int]
    """Number of PARTNR's propositions, by the name of their function."""
    instructions: tuple[str, ...]
    unplayable: Mapping[str, int]
    """Number of rearrangement episodes by the reason why they cannot be played anywhere."""
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the summary as JSON types."""
        return {**asdict(self), "instructions": list(self.instructions), "warnings": list(self.warnings)}

    def to_text(self) -> str:
        """Return the summary as lines of text."""
        starts = "sampled when they are played"
        if self.complete:
            of = "" if self.complete == self.episodes else f" in {self.complete:,} episodes, else {starts}"
            starts = f"{self.apart_m.text(' m')} apart{of}" if self.apart_m else f"in the file{of}"
        lines = [
            ("tasks", _counts(self.tasks)),
            ("scenes", f"{len(self.scenes):,}: {_counts(self.scenes)}"),
            ("goals", f"{self.goals.text()} in each episode" if self.goals else ""),
            ("objects", f"{self.objects.text()} added to the scene in each episode" if self.objects else ""),
            ("templates", f"{len(self.templates):,}: {_counts(self.templates)}" if self.templates else ""),
            ("from", f"{len(self.sources):,} receptacles: {_counts(self.sources)}" if self.sources else ""),
            (
                "to",
                f"{len(self.destinations):,} receptacles: {_counts(self.destinations)}" if self.destinations else "",
            ),
            ("distances", f"{self.carry_m.text(' m')} from objects to their goals, straight" if self.carry_m else ""),
            ("starts", starts),
            ("propositions", _counts(self.predicates) if self.predicates else ""),
            ("instructions", "; ".join(repr(text) for text in self.instructions[:2])),
            *(("unplayable", f"{count:,}: {reason}") for reason, count in self.unplayable.items()),
            *(("warning", text) for text in self.warnings),
        ]
        return "\n".join(f"  {name:13}{text}" for name, text in lines if text)


def summary_of(episodes: EpisodeSet) -> EpisodeSummary:
    """Summarise the episodes of a file."""
    tasks, scenes, templates, sources, destinations, predicates, unplayable = (Counter[str]() for _ in range(7))
    objects, goals, carried, apart = [], [], [], []
    instructions: dict[str, None] = {}
    complete = 0
    for episode in episodes.episodes:
        tasks[_task(episode)] += 1
        scenes[episode.scene_id] += 1
        predicates.update(predicates_of(episode))
        text = episode.extra.get("instruction") or episode.extra.get("language_instruction")
        if isinstance(text, str) and text:
            instructions[text] = None
        try:
            record = _record_of(episode)
            nav = read_social_nav(episode) if record is None else None
        except H3DataError as fault:
            unplayable[str(fault).replace(f"Episode {episode.episode_id!r}", "it").removeprefix("it: ")] += 1
            continue
        starts = (nav.robot_start, nav.human_start) if nav is not None else None
        if record is not None:
            objects.append(len(episode.rigid_objects) or len(record.objects))
            goals.append(len(record.goals) + len(record.placements))
            templates.update(_templates(record))
            sources.update(goal.source for goal in record.goals if goal.source)
            destinations.update(goal.destination for goal in record.goals if goal.destination)
            destinations.update(" or ".join(p.receptacles) for p in record.placements if p.receptacles)
            carried += [float(np.hypot(g.start[0] - g.position[0], g.start[2] - g.position[2])) for g in record.goals]
            if record.robot_start is not None and record.human_start is not None:
                starts = record.robot_start, record.human_start
        if starts is not None:
            complete += 1
            apart.append(float(np.hypot(starts[0][0] - starts[1][0], starts[0][1] - starts[1][1])))
        elif task_of(episode) is not None and record is None:
            complete += 1
    return EpisodeSummary(
        episodes=len(episodes),
        tasks=_sorted(tasks),
        scenes=_sorted(scenes),
        complete=complete,
        objects=_spread(objects) if any(objects) else None,
        goals=_spread(goals),
        templates=_sorted(templates),
        sources=_sorted(sources),
        destinations=_sorted(destinations),
        carry_m=_spread(carried),
        apart_m=_spread(apart),
        predicates=_sorted(predicates),
        instructions=tuple(instructions),
        unplayable=_sorted(unplayable),
        warnings=episodes.warnings,
    )


def _record_of(episode: RearrangeEpisode) -> StoredRearrangement | None:
    """Return the record of an episode with objects: that of the task that understands all of it, if it is installed."""
    if task_of(episode) is None:
        for task in map(find_task, task_registry().load_all().values()):
            if task.codec.foreign in episode.extra:
                return task.codec.read(episode, seed=0)
    return read_rearrangement(episode)


def _task(episode: RearrangeEpisode) -> str:
    task = task_of(episode)
    if task is not None:
        return f"{task} (h3data)"
    if PROPOSITIONS in episode.extra:
        return "collaboration (PARTNR)"
    if episode.targets or episode.rigid_objects:
        return "rearrange (Habitat)"
    return "navigation (Habitat)" if "goals" in episode.extra else "scene only (Habitat)"


def _templates(record: StoredRearrangement) -> list[str]:
    configs = {thing.name: template_name(thing.config) for thing in record.objects}
    names = [*(goal.object for goal in record.goals), *(placement.object for placement in record.placements)]
    return [configs.get(name, name) for name in names]


def _sorted(counts: Counter[str]) -> dict[str, int]:
    return dict(counts.most_common())


def _counts(counts: Mapping[str, int]) -> str:
    shown = ", ".join(f"{_short(name)} ({count:,})" for name, count in list(counts.items())[:_LISTED])
    return shown + (", ..." if len(counts) > _LISTED else "")


def _short(name: str) -> str:
    """Return the name without folders and endings of a scene's path, and without the middle of a long one."""
    name = name.rsplit("/", 1)[-1].removesuffix(".scene_instance.json")
    return name if len(name) <= _LONGEST else f"{name[: _LONGEST // 2]}...{name[-_LONGEST // 2 + 3 :]}"


def _spread(numbers: Sequence[float] | Iterable[float]) -> Spread | None:
    values = np.array(list(numbers), np.float64)
    if not len(values):
        return None
    return Spread(least=float(values.min()), mean=float(values.mean()), greatest=float(values.max()))


def predicates_of(episode: RearrangeEpisode) -> list[str]:
    """Return the function name of each proposition of an episode; empty if it is not an episode of PARTNR."""
    listed = episode.extra.get(PROPOSITIONS)
    if not isinstance(listed, list):
        return []
    return [str(entry.get("function_name")) for entry in listed if isinstance(entry, dict)]
