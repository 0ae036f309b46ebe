"""Bank of sampled episodes of a task of one robot and the people of a crowd, with the paths between their goals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.progress import progress
from h3data.scene import FreeSpace, Scene
from h3data_training.torch.episodes import columns_of
from sim_kinematic.agents.roster import AgentSpec, kinds_of
from sim_kinematic.agents.waypoint_walker import WaypointHuman, walking_path
from sim_kinematic.crowd.crowd import ARRIVED_M, ATTEMPTS
from sim_kinematic.crowd.traits import Traits, sample_traits
from sim_kinematic.motion.randomness import episode_seed
from sim_kinematic.motion.spec import STEP_S
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.tasks.sources import EpisodeSource, Scenes
from sim_kinematic.tasks.task import Task


@dataclass(frozen=True, kw_only=True, eq=False)
class CrowdBank:
    """Bank of N episodes with P people each, whose chains of goals last for an episode in which nobody is in their way."""

    roster: tuple[AgentSpec, ...]
    """Agents of all episodes, the robot first."""
    floors: tuple[FreeSpace, ...]
    """Floors of the scenes."""
    scenes: tuple[Scene, ...]
    place: NDArray[np.int64]
    """Number of the scene of each episode, [N]."""
    starts: NDArray[np.float64]
    """Starts ``(x, z, heading)`` of robot and people, [N, 1 + P, 3]."""
    traits: NDArray[np.float64]
    """`Traits` of the people, [N, P, 6]."""
    legs: tuple[NDArray[np.float64], ...]
    """Paths from goal to goal of all people of all episodes, one after the other, [K, 2] each [m]."""
    leg_counts: NDArray[np.int64]
    """Number of legs of each person, [N, P]."""
    seeds: NDArray[np.int64]
    """Seeds of the episodes, as in recordings, [N]."""
    extra: dict[str, NDArray[Any]] = field(default_factory=dict)
    """Entries of `Episode.extra` that are arrays of one shape in all episodes, [N, ...] each."""

    @classmethod
    def draw(
        cls,
        scenes: Scenes,
        count: int,
        *,
        task: Task,
        spec: Any,
        seed: int = 0,
        agents: str | Sequence[str] | None = None,
        robot: str = "quad_arm",
        human: str = "female_0",
    ) -> CrowdBank:
        """Sample the first ``count`` episodes of the run ``seed``, which environments with this seed also play.

        Raises:
            InputError: as for `EpisodeSource`; there is not exactly one robot, or people have different bodies.
            SceneError: a scene has no room for an episode.
        """
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
            raise InputError(f"Expected at least 1 episode, a whole number, got {count!r}.", code="H3-TRAIN-060")
        source = EpisodeSource(task, scenes, spec=spec, agents=agents, robot=robot, human=human)
        require_crowd(task.name, source.roster)
        runs = [(seed, k) for k in range(count)]
        source.prepare(runs)
        episodes, legs, counts, traits = [], [], [], []
        for run in progress(runs, desc="episodes", unit="episode", delay=1.0, leave=False):
            episode = source.sample(*run)
            require_crowd(task.name, episode.roster, like=source.roster)
            chains = [chain(episode, number) for number in range(1, len(episode.roster))]
            episodes.append(episode)
            legs += [leg for goals in chains for leg in goals]
            counts.append([len(goals) for goals in chains])
            speed = spec.human.speed_mps
            traits.append([sample_traits(episode.seed, number, speed) for number in range(1, len(episode.roster))])
        homes = list(dict.fromkeys(episode.scene for episode in episodes))
        floors = {id(episode.scene): episode.free for episode in episodes}
        people = len(source.roster) - 1
        return cls(
            roster=source.roster,
            floors=tuple(floors[id(scene)] for scene in homes),
            scenes=tuple(homes),
            place=np.array([homes.index(episode.scene) for episode in episodes], np.int64),
            starts=np.array([episode.starts for episode in episodes], np.float64),
            traits=np.array(traits, np.float64).reshape(count, people, len(Traits._fields)),
            legs=tuple(legs),
            leg_counts=np.array(counts, np.int64).reshape(count, people),
            seeds=np.array([episode.seed for episode in episodes], np.int64),
            extra=columns_of([episode.extra for episode in episodes]),
        )

    @classmethod
    def merged(cls, banks: Sequence[CrowdBank]) -> CrowdBank:
        """Return the concatenated episodes of several banks with the same agents."""
        first = np.cumsum([0, *(len(bank.floors) for bank in banks)])
        columns = ("starts", "traits", "leg_counts", "seeds")
        return cls(
            roster=banks[0].roster,
            floors=tuple(floor for bank in banks for floor in bank.floors),
            scenes=tuple(scene for bank in banks for scene in bank.scenes),
            place=np.concatenate([bank.place + n for bank, n in zip(banks, first[:-1], strict=True)]),
            legs=tuple(leg for bank in banks for leg in bank.legs),
            extra=columns_of([{name: rows[n] for name, rows in b.extra.items()} for b in banks for n in range(len(b))]),
            **{name: np.concatenate([getattr(bank, name) for bank in banks]) for name in columns},
        )

    def __len__(self) -> int:
        return len(self.place)


def require_crowd(task: str, roster: Sequence[AgentSpec], like: Sequence[AgentSpec] | None = None) -> None:
    """Check that worlds on a device can have a roster: one robot, and people with one body, as many as in ``like``.

    Raises:
        InputError: the roster is another one.
    """
    bodies = {member.model for member in roster[1:]}
    if (
        kinds_of(roster).count("robot") != 1
        or len(bodies) > 1
        or (like is not None and [m.model for m in roster] != [m.model for m in like])
    ):
        raise InputError(
            f"On a device, episodes of {task} have one robot and always the same number of people, all with one body; got "
            f"{', '.join(member.model for member in roster)}. Hint: another roster, or leave out device.",
            code="H3-ENV-061",
        )


def chain(episode: Episode, number: int) -> list[NDArray[np.float64]]:
    """Return the paths [K, 2] [m] from goal to goal of agent ``number``: at least as many as they can walk in the episode.

    Goals are those of `sim_kinematic.policies.crowd.people.CrowdPolicy`, for a person who reaches each goal exactly. One
    who can go nowhere has a path of two equal points.
    """
    walker, free = episode.spec.human, episode.free
    goals = WaypointHuman(free, episode_seed(episode.seed, number), walker)
    at, legs = np.asarray(episode.starts[number, :2], np.float64), []
    left = episode.spec.max_steps * STEP_S * sample_traits(episode.seed, number, walker.speed_mps).speed_mps
    while left > 0:
        tried = (walking_path(free, at, goals.next_goal(at), walker) for _ in range(ATTEMPTS))
        path = next((p for p in tried if len(p) > 1 and np.hypot(*(p[-1] - at)) >= ARRIVED_M), None)
        if path is None:
            break
        # they go on as soon as they are near a goal
        left -= float(np.hypot(*np.diff(path, axis=0).T).sum()) - ARRIVED_M
        legs.append(path)
        at = path[-1]
    return legs or [np.array([at, at])]
