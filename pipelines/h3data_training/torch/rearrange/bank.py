"""Bank of sampled episodes of rearrangement.

Everything that needs a search (objects and goals within reach of both agents, places to stand, and the shortest paths
to them) is computed once on the host, so that steps on a device only look it up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot
from h3data.errors import InputError
from h3data.geometry import Array
from h3data.scene import Scene
from h3data_training.torch.rules import refuse_others
from h3data_training.torch.step import Floor, refuse_stairs
from sim_kinematic.agents.oracle.ways import PathTable, paths_to
from sim_kinematic.policies.rearrange import partner_plan, planner
from sim_kinematic.tasks.rearrange.episode import ORACLE_RULES, PAIR, RearrangeEpisode, RearrangeSpec
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.skills.errands import errands_of
from sim_kinematic.tasks.sources import EpisodeSource, Scenes

ROBOT, HUMAN, FLOOR = 0, 1, 2
"""Indices of tables of paths: paths of the robot and of the person to their stands, and paths of any agent to the floor
below an object.
"""


class BankFloor(Floor, Protocol):
    """Protocol of the parts of a `h3data.scene.FreeSpace` that rearrangement on a device reads."""

    @property
    def floor_y(self) -> float:
        """Height of the floor [m]."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class RearrangeBank:
    """Bank of N episodes of K objects in R homes, with the shortest paths in them.

    Paths to places are numbered ``(who * 2 + at_goal) * K + object``, with ``who = 2`` for the floor below. They are
    followed by the paths of both agents to the M handles of doors and drawers that they may open, numbered
    ``6 K + who * M + part``. There are F paths in total. Points of a path are the n corners of the home, then the S
    places at its end (`sim_kinematic.agents.oracle.ways.PathTable`).
    """

    spec: RearrangeSpec
    robot: Robot
    human: Humanoid
    floors: tuple[BankFloor, ...]
    """Floors of the homes, [R]."""
    scenes: tuple[Scene, ...]
    """Homes, for pictures; empty if the bank comes from a file."""
    place: NDArray[np.int64]
    """Number of the home of each episode, [N]."""
    seeds: NDArray[np.int64]
    """Seeds of the episodes, as in recordings, [N]."""
    starts: Array
    """Starts ``(x, z, heading)`` of robot and person, [N, 2, 3] [m, m, rad]."""
    spots: Array
    """Initial positions of the objects, followed by their goals and the handles at rest, [N, 2 K + M, 3] [m]."""
    ends: Array
    """Places at the ends of the paths, [N, F, S, 2] [m]; NaN for unused rows."""
    first: NDArray[np.int16]
    """First point of the path from each cell; each episode has F tables with one entry for each cell of the home."""
    first_of: NDArray[np.int64]
    """Index in ``first`` of the first entry of each episode, [N]."""
    after: NDArray[np.int16]
    """Next point of the path from each corner, in F tables for each episode."""
    after_of: NDArray[np.int64]
    left: NDArray[np.float32]
    """Length of the path from each corner to the floor below objects and goals [m], in 2 K tables for each episode."""
    left_of: NDArray[np.int64]
    corners: Array
    """Corners (x, z) of all homes, one home after the other [m]."""
    corners_of: NDArray[np.int64]
    """First row of each home in ``corners``, [R + 1]."""
    origins: Array
    """Lower corner of the first cell of each home, [R, 2] [m]."""
    shapes: NDArray[np.int64]
    """Number of cells along x and z, [R, 2]."""
    names: tuple[str, ...] = ()
    """Names by which the homes can be opened, if they are known."""

    @classmethod
    def draw(
        cls,
        scenes: Scenes,
        count: int,
        *,
        seed: int = 0,
        spec: RearrangeSpec = ORACLE_RULES,
        robot: str = "quad_arm",
        human: str = "female_0",
        task: Rearrange | None = None,
    ) -> RearrangeBank:
        """Sample the first ``count`` episodes of the run ``seed``, which environments with this seed also play.

        Raises:
            InputError: as for `EpisodeSource` and `of`.
            SceneError: no home has room for an episode.
        """
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
            raise InputError(f"Expected at least 1 episode, a whole number, got {count!r}.", code="H3-TRAIN-060")
        task = task or Rearrange()
        source = EpisodeSource(task, scenes, spec=spec, robot=robot, human=human)
        runs = [(seed, k) for k in range(count)]
        source.prepare(runs)
        episodes = [source.sample(*run) for run in runs]
        return cls.of([one for one in episodes if isinstance(one, RearrangeEpisode)], task=task)

    @classmethod
    def of(cls, episodes: Sequence[RearrangeEpisode], *, task: Rearrange | None = None) -> RearrangeBank:
        """Return a bank of a task's episodes of one robot and one person, under the rules of the first episode.

        Raises:
            InputError: the episodes have other agents, the rules have no oracle skills, or a device does not support a
                home.
        """
        spec, roster = episodes[0].spec, episodes[0].roster
        parts = [(task or Rearrange()).parts_of(episode) for episode in episodes]
        _check(episodes, parts, (task or Rearrange()).name)
        robot, human = roster[0].robot, roster[1].body
        assert isinstance(human, Humanoid)
        homes = {id(episode.free): episode for episode in episodes}
        number = {key: k for k, key in enumerate(homes)}
        ways = [_ways(episode, own) for episode, own in zip(episodes, parts, strict=True)]
        widest = max(len(one.ends) for of_episode in ways for one in of_episode)
        ends = np.full((len(episodes), len(ways[0]), max(widest, 1), 2), np.nan)
        for n, of_episode in enumerate(ways):
            for f, one in enumerate(of_episode):
                ends[n, f, : len(one.ends)] = one.ends
        floors = tuple(episode.free for episode in homes.values())
        sample = {number[id(episode.free)]: of_episode[0] for episode, of_episode in zip(episodes, ways, strict=True)}
        below = [of_episode[FLOOR * 2 * spec.objects : (FLOOR + 1) * 2 * spec.objects] for of_episode in ways]
        first, first_of = _joined([[one.first for one in of_episode] for of_episode in ways])
        after, after_of = _joined([[one.after for one in of_episode] for of_episode in ways])
        left, left_of = _joined([[one.left.astype(np.float32) for one in of_episode] for of_episode in below])
        return cls(
            spec=spec,
            robot=robot,
            human=human,
            floors=floors,
            scenes=tuple(episode.scene for episode in homes.values()),
            place=np.array([number[id(episode.free)] for episode in episodes], np.int64),
            seeds=np.array([episode.seed for episode in episodes], np.int64),
            starts=np.array([episode.starts for episode in episodes]),
            spots=np.array([_spots(episode, own) for episode, own in zip(episodes, parts, strict=True)]),
            ends=ends,
            first=first,
            first_of=first_of,
            after=after,
            after_of=after_of,
            left=left,
            left_of=left_of,
            corners=np.concatenate([*(free.graph.nodes for free in floors), np.zeros((1, 2))]),  # never empty
            corners_of=np.cumsum([0, *(len(free.graph.nodes) for free in floors)]),
            origins=np.array([sample[r].origin for r in range(len(floors))]),
            shapes=np.array([sample[r].shape for r in range(len(floors))], np.int64),
        )

    @classmethod
    def merged(cls, banks: Sequence[RearrangeBank]) -> RearrangeBank:
        """Return the concatenated episodes of several banks with the same rules and bodies.

        If no two banks share a home, the result equals the bank that is made of all episodes at once.
        """
        widest = max(bank.ends.shape[2] for bank in banks)
        homes = np.cumsum([0, *(len(bank.floors) for bank in banks)])

        def tables(name: str) -> tuple[NDArray, NDArray[np.int64]]:
            parts = [getattr(bank, name)[:-1] for bank in banks]
            begins = np.cumsum([0, *map(len, parts)])
            own = [getattr(bank, f"{name}_of") + begin for bank, begin in zip(banks, begins, strict=False)]
            return np.concatenate([*parts, getattr(banks[-1], name)[-1:]]), np.concatenate(own)

        def wide(ends: Array) -> Array:
            return np.pad(ends, ((0, 0), (0, 0), (0, widest - ends.shape[2]), (0, 0)), constant_values=np.nan)

        (first, first_of), (after, after_of), (left, left_of) = map(tables, ("first", "after", "left"))
        counts = np.concatenate([np.diff(bank.corners_of) for bank in banks])
        columns = ("seeds", "starts", "spots", "origins", "shapes")
        return replace(
            banks[0],
            floors=tuple(floor for bank in banks for floor in bank.floors),
            scenes=tuple(scene for bank in banks for scene in bank.scenes),
            names=tuple(name for bank in banks for name in bank.names),
            place=np.concatenate([bank.place + n for bank, n in zip(banks, homes, strict=False)]),
            ends=np.concatenate([wide(bank.ends) for bank in banks]),
            first=first,
            first_of=first_of,
            after=after,
            after_of=after_of,
            left=left,
            left_of=left_of,
            corners=np.concatenate([*(bank.corners[:-1] for bank in banks), banks[-1].corners[-1:]]),
            corners_of=np.cumsum([0, *counts]),
            **{name: np.concatenate([getattr(bank, name) for bank in banks]) for name in columns},
        )

    def __len__(self) -> int:
        return len(self.place)

    @property
    def objects(self) -> int:
        """Number K of objects."""
        return self.spec.objects

    def orders(self, partner: str) -> NDArray[np.int64]:
        """Return the objects that a planner brings to their goals in each episode, in order, [N, K]; -1 after the last.

        Raises:
            InputError: there is no such planner.
        """
        return orders(
            [planner(partner_plan(partner, seed), seed, self.objects).objects for seed in self.seeds.tolist()],
            self.objects,
        )

    def __repr__(self) -> str:
        return f"RearrangeBank({len(self)} episodes of {self.objects} objects, {len(self.floors)} homes)"


def orders(chosen: Sequence[Sequence[int]], objects: int) -> NDArray[np.int64]:
    """Return the objects in the order in which a planner brings them to their goals, [N, K]; -1 after the last."""
    return np.array([[*row, *[-1] * (objects - len(row))] for row in chosen], np.int64).reshape(-1, objects)


def _ways(episode: RearrangeEpisode, parts: tuple[int, ...]) -> list[PathTable]:
    """Return all paths of an episode, [F]."""
    found, opening = [], []
    for number in (ROBOT, HUMAN):
        errands = errands_of(episode, number, parts)
        found += [*errands.to_start, *errands.to_goal]
        opening += [errands.to_part[joint].ways for joint in parts]
    return [*found, *floor_paths(episode), *opening]


def _spots(episode: RearrangeEpisode, parts: tuple[int, ...]) -> list[Array]:
    """Return the starts and goals of the objects, then handles, [2 K + M, 3]."""
    handles = [errands_of(episode, ROBOT, parts).to_part[joint].point for joint in parts]
    return [*(t.start[:3] for t in episode.targets), *(t.goal for t in episode.targets), *handles]


def _joined(tables: Sequence[Sequence[NDArray]]) -> tuple[NDArray, NDArray[np.int64]]:
    """Concatenate the tables of all episodes; return them, and where those of each episode begin.

    A last number is appended, so that no table is empty.
    """
    sizes = [sum(map(len, of_episode)) for of_episode in tables]
    flat = [table for of_episode in tables for table in of_episode]
    return np.concatenate([*flat, np.zeros(1, flat[0].dtype)]), np.cumsum([0, *sizes[:-1]])


def _check(episodes: Sequence[RearrangeEpisode], parts: Sequence[tuple[int, ...]], task: str) -> None:
    first = episodes[0]
    if first.spec.oracle is None:
        raise InputError(
            "On a device skills are the oracle ones. Hint: spec=sim_kinematic.tasks.rearrange.episode.ORACLE_RULES, or "
            "leave out device.",
            code="H3-TRAIN-061",
        )
    refuse_others(task, first.spec)
    if wrong := next((own for own in parts if len(own) != first.spec.parts), None):
        raise InputError(
            f"Rules of {task} have {first.spec.parts} doors and drawers to open (parts), and parts_of gives {wrong}.",
            code="H3-TRAIN-081",
        )
    for episode in episodes:
        kinds = tuple(member.kind for member in episode.roster)
        models = [[member.model for member in one.roster] for one in (episode, first)]
        if kinds != PAIR or models[0] != models[1] or len(episode.targets) != first.spec.objects:
            raise InputError(
                f"A bank is of one robot, one person and {first.spec.objects} objects, got {kinds} and "
                f"{len(episode.targets)}.",
                code="H3-TRAIN-063",
            )
        if episode.floor(ROBOT) is not episode.free:
            raise InputError(
                f"On a device robots are as narrow as people; {episode.roster[ROBOT].model} is wider.",
                code="H3-TRAIN-064",
            )
        refuse_stairs([episode.free])


def floor_paths(episode: RearrangeEpisode) -> list[PathTable]:
    """Return the shortest paths to the floor nearest to the start of each object, then to each goal."""
    points = [target.start[:3] for target in episode.targets] + [target.goal for target in episode.targets]
    return [paths_to(episode.free, episode.free.snap(point[[0, 2]])) for point in points]
