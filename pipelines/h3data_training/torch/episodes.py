"""Bank of sampled episodes of social navigation.

Everything that needs a search (starts clear of furniture, shortest paths between random goals) is computed once on the
host, so that steps on a device only look it up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.scene import FreeSpace, Scene
from sim_kinematic.agents.waypoint_walker import WaypointHuman
from sim_kinematic.motion.spec import STEP_S, SocialNavSpec
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.tasks.social_nav import TRAINING, SocialNav
from sim_kinematic.tasks.social_nav.episode import Starts, goals_of
from sim_kinematic.tasks.sources import EpisodeSource, Scenes


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodeBank:
    """N episodes: starts, and all way points that the person can get to in the time there is."""

    floors: tuple[FreeSpace, ...]
    """Floors of the scenes that are played in."""
    scenes: tuple[Scene, ...]
    place: NDArray[np.int64]
    """Number of the scene, [N]."""
    robot_xz: NDArray[np.float64]
    """[N, 2] [m]."""
    robot_heading: NDArray[np.float64]
    """[N] [rad]."""
    human_xz: NDArray[np.float64]
    human_heading: NDArray[np.float64]
    way_points: NDArray[np.float64]
    """[N, P, 2] [m]; the last one fills the rows of those who have fewer. Of people who walk with strides where they are
    after each step, and ``headings`` [N, P] [rad]."""
    headings: NDArray[np.float64] | None
    seeds: NDArray[np.int64]
    """Seeds of the episodes, as in recordings, [N]."""

    @classmethod
    def draw(
        cls,
        scenes: Scenes,
        count: int,
        *,
        seed: int = 0,
        spec: SocialNavSpec = TRAINING,
        robot: str = "quad_arm",
        human: str = "female_0",
    ) -> EpisodeBank:
        """The first ``count`` episodes of the run ``seed``: those that environments of the same seed begin.

        Raises:
            InputError: as `EpisodeSource`.
            SceneError: a scene has no two starts as far apart as the rules say.
        """
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
            raise InputError(f"Expected at least 1 episode, a whole number, got {count!r}.", code="H3-TRAIN-060")
        source = EpisodeSource(SocialNav(), scenes, spec=spec, robot=robot, human=human)
        runs = [(seed, k) for k in range(count)]
        source.prepare(runs)
        episodes = [source.sample(*run) for run in runs]
        homes = list(dict.fromkeys(episode.scene for episode in episodes))
        order = {id(home.scene): k for k, home in enumerate(source.homes) if home.is_ready}
        homes.sort(key=lambda scene: order[id(scene)])
        starts = [Starts.of(episode.starts) for episode in episodes]
        strides = spec.human.stride is not None
        tracks = [_strides(episode) if strides else _way_points(episode) for episode in episodes]
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
        )

    @classmethod
    def merged(cls, banks: Sequence[EpisodeBank]) -> EpisodeBank:
        """The episodes of several banks, one after the other."""
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
            **{name: np.concatenate([getattr(bank, name) for bank in banks]) for name in columns},
        )

    def __len__(self) -> int:
        return len(self.place)


def _strides(episode: Episode) -> NDArray[np.float64]:
    """Returns where the person is after each step, (x, z, heading) [P, 3]."""
    walker = WaypointHuman(episode.free, episode.seed, episode.spec.human, goals_of(episode))
    starts = Starts.of(episode.starts)
    track = np.empty((episode.spec.max_steps + 1, 3))
    before = np.array([*starts.human_xz, starts.human_heading])
    for k in range(len(track)):
        track[k] = before = walker.stride(before[:2], float(before[2]))
    return track


def _way_points(episode: Episode) -> NDArray[np.float64]:
    """Returns the way points of a person [P, 2], at least for a whole episode. They land on each way point exactly."""
    walker = WaypointHuman(episode.free, episode.seed, episode.spec.human, goals_of(episode))
    stride = episode.spec.human.speed_mps * STEP_S
    points = [Starts.of(episode.starts).human_xz]
    steps = 0
    while steps <= episode.spec.max_steps:
        points.append(walker.target(points[-1]))
        steps += int(np.ceil(np.hypot(*(points[-1] - points[-2])) / stride - 1e-6))
    return np.array(points[1:])
