"""Bank of sampled episodes of a task of one robot and one scripted person.

Everything that needs a search (starts clear of furniture, shortest paths between random goals) is computed once on the
host, so that steps on a device only look it up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.scene import FreeSpace, Scene
from sim_kinematic.agents.roster import kinds_of
from sim_kinematic.agents.waypoint_walker import WaypointHuman
from sim_kinematic.motion.spec import STEP_S
from sim_kinematic.motion.state import HUMAN
from sim_kinematic.policies.assignment import resolve_policy
from sim_kinematic.tasks.episode import Episode, Starts
from sim_kinematic.tasks.rearrange.episode import PAIR
from sim_kinematic.tasks.social_nav import TRAINING, SocialNav
from sim_kinematic.tasks.sources import EpisodeSource, Scenes
from sim_kinematic.tasks.task import Task


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodeBank:
    """Bank of N episodes, with starts and all waypoints that the person can reach in the available time."""

    floors: tuple[FreeSpace, ...]
    """Floors of the scenes."""
    scenes: tuple[Scene, ...]
    place: NDArray[np.int64]
    """Number of the scene of each episode, [N]."""
    robot_xz: NDArray[np.float64]
    """Starts of the robot [N, 2] [m]."""
    robot_heading: NDArray[np.float64]
    """Headings of the robot at the start [N] [rad]."""
    human_xz: NDArray[np.float64]
    human_heading: NDArray[np.float64]
    way_points: NDArray[np.float64]
    """Waypoints of the person, [N, P, 2] [m]; the last one fills shorter rows. For people with strides, these are their
    positions after each step, with ``headings`` [N, P] [rad].
    """
    headings: NDArray[np.float64] | None
    seeds: NDArray[np.int64]
    """Seeds of the episodes, as in recordings, [N]."""
    extra: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """Entries of `Episode.extra` that are arrays of one shape in all episodes, [N, ...] each."""

    @classmethod
    def draw(
        cls,
        scenes: Scenes,
        count: int,
        *,
        seed: int = 0,
        task: Task | None = None,
        spec: Any = TRAINING,
        robot: str = "quad_arm",
        human: str = "female_0",
    ) -> EpisodeBank:
        """Sample the first ``count`` episodes of the run ``seed``, which environments with this seed also play.

        ``task`` is social navigation by default, and ``spec`` are its rules.

        Raises:
            InputError: as for `EpisodeSource`, or the task does not have exactly one robot and one person.
            SceneError: a scene has no two starts at the distance that the rules require.
        """
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
            raise InputError(f"Expected at least 1 episode, a whole number, got {count!r}.", code="H3-TRAIN-060")
        task = task or SocialNav()
        source = EpisodeSource(task, scenes, spec=spec, robot=robot, human=human)
        if (kinds := kinds_of(source.roster)) != PAIR:
            raise InputError(
                f"On a device a task is of one robot and one person, {task.name} has: {', '.join(kinds)}. "
                "Hint: partner='orca', or leave out device.",
                code="H3-ENV-038",
            )
        runs = [(seed, k) for k in range(count)]
        source.prepare(runs)
        episodes = [source.sample(*run) for run in runs]
        homes = list(dict.fromkeys(episode.scene for episode in episodes))
        order = {id(home.scene): k for k, home in enumerate(source.homes) if home.is_ready}
        homes.sort(key=lambda scene: order[id(scene)])
        starts = [Starts.of(episode.starts) for episode in episodes]
        strides = spec.human.stride is not None
        script = resolve_policy(task, "human", "waypoints", spec)
        walkers = [script(episode, HUMAN).policy for episode in episodes]
        tracks = [(_strides if strides else _way_points)(*each) for each in zip(episodes, walkers, strict=True)]
        longest = max(map(len, tracks))
        padded = np.stack([np.pad(t, ((0, longest - len(t)), (0, 0)), mode="edge") for t in tracks])
        floors = {id(episode.scene): episode.free for episode in episodes}
        return cls(
            floors=tuple(floors[id(scene)] for scene in homes),
            scenes=tuple(homes),
            place=np.array([homes.index(episode.scene) for episode in episodes], np.int64),
            robot_xz=np.array([s.robot_xz for s in starts]),
            robot_heading=np.array([s.robot_heading for s in starts]),
            human_xz=np.array([s.human_xz for s in starts]),
            human_heading=np.array([s.human_heading for s in starts]),
            way_points=padded[..., :2].copy(),
            headings=padded[..., 2].copy() if strides else None,
            seeds=np.array([episode.seed for episode in episodes], np.int64),
            extra=columns_of([episode.extra for episode in episodes]),
        )

    @classmethod
    def merged(cls, banks: Sequence[EpisodeBank]) -> EpisodeBank:
        """Return the concatenated episodes of several banks."""
        longest = max(bank.way_points.shape[1] for bank in banks)
        first = np.cumsum([0, *(len(bank.floors) for bank in banks)])

        def padded(rows: np.ndarray) -> np.ndarray:
            return np.pad(rows, ((0, 0), (0, longest - rows.shape[1]), *[(0, 0)] * (rows.ndim - 2)), mode="edge")

        headings = [bank.headings for bank in banks if bank.headings is not None]
        columns = ("robot_xz", "robot_heading", "human_xz", "human_heading", "seeds")
        return cls(
            floors=tuple(floor for bank in banks for floor in bank.floors),
            scenes=tuple(scene for bank in banks for scene in bank.scenes),
            place=np.concatenate([bank.place + n for bank, n in zip(banks, first[:-1], strict=True)]),
            way_points=np.concatenate([padded(bank.way_points) for bank in banks]),
            headings=np.concatenate([padded(h) for h in headings]) if len(headings) == len(banks) else None,
            extra=columns_of([{name: rows[n] for name, rows in b.extra.items()} for b in banks for n in range(len(b))]),
            **{name: np.concatenate([getattr(bank, name) for bank in banks]) for name in columns},
        )

    @property
    def starts(self) -> NDArray[np.float64]:
        """Starts ``(x, z, heading)`` of robot and person, [N, 2, 3]."""
        robot, human = (self.robot_xz, self.robot_heading), (self.human_xz, self.human_heading)
        return np.stack([np.column_stack(agent) for agent in (robot, human)], 1)

    def __len__(self) -> int:
        return len(self.place)


def columns_of(of_episodes: Sequence[Mapping[str, Any]]) -> dict[str, NDArray[Any]]:
    """Return entries that are numbers, and of one shape in all episodes, as arrays [N, ...]."""
    found = {}
    for name in of_episodes[0]:
        try:
            rows = np.array([extra.get(name) for extra in of_episodes])
        except ValueError:  # of several shapes
            continue
        if rows.dtype.kind in "biuf":
            found[name] = rows
    return found


def _strides(episode: Episode, walker: WaypointHuman) -> NDArray[np.float64]:
    """Return the position and heading of the person after each step, (x, z, heading) [P, 3] [m, m, rad]."""
    starts = Starts.of(episode.starts)
    track = np.empty((episode.spec.max_steps + 1, 3))
    before = np.array([*starts.human_xz, starts.human_heading])
    for k in range(len(track)):
        track[k] = before = walker.stride(before[:2], float(before[2]))
    return track


def _way_points(episode: Episode, walker: WaypointHuman) -> NDArray[np.float64]:
    """Return the waypoints of the person [P, 2] [m], at least as many as can be reached in an episode.

    The person reaches each waypoint exactly.
    """
    stride = episode.spec.human.speed_mps * STEP_S
    points = [Starts.of(episode.starts).human_xz]
    steps = 0
    while steps <= episode.spec.max_steps:
        points.append(walker.target(points[-1]))
        steps += int(np.ceil(np.hypot(*(points[-1] - points[-2])) / stride - 1e-6))
    return np.array(points[1:])
