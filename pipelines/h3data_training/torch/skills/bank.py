"""Bank of starts for the skills.

Everything that needs a search (objects on furniture, places from which to reach them, starts clear of furniture) is
computed once on the host, so that steps on a device only look it up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.scene import FreeSpace, Scene
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode, body_indices
from sim_kinematic.tasks.skills.skill_starts import SkillStart

COLUMNS = ("place", "xz", "heading", "objects", "bodies", "turned", "target", "holds", "point", "stand")
"""Names of the arrays of a `SkillBank`, with a row for each start."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SkillBank:
    """Bank of N starts of one skill, all with the same number of objects."""

    floors: tuple[FreeSpace, ...]
    """Floors of the homes, for the robot's base."""
    scenes: tuple[Scene, ...]
    place: NDArray[np.int64]
    """Number of the home of each start, [N]."""
    xz: NDArray[np.float64]
    """Position (x, z) of the robot, [N, 2] [m]."""
    heading: NDArray[np.float64]
    """Headings at the start [N] [rad]."""
    objects: NDArray[np.float64]
    """Positions of the objects [N, K, 3] [m]."""
    bodies: NDArray[np.int64]
    """Numbers of the objects among the instances of the home, [N, K]."""
    turned: NDArray[np.float64]
    """Orientations of the objects, quaternions [N, K, 4]."""
    target: NDArray[np.int64]
    """Number of the target object, [N]."""
    holds: NDArray[np.bool_]
    """True if the robot holds the target object, [N]."""
    point: NDArray[np.float64]
    """Point at which the object lies or has to be placed, [N, 3] [m]."""
    stand: NDArray[np.float64]
    """Nearest position (x, z) from which the hand can reach the point, [N, 2] [m]."""
    unfolded: NDArray[np.float64] | None = None
    """Share of the motion from rest to reaching that the arm has made at the start, [N]; None if the arm is at rest."""

    @classmethod
    def of(cls, starts: Sequence[tuple[RearrangeEpisode, FreeSpace, Sequence[SkillStart]]]) -> SkillBank:
        """Return a bank of starts in some episodes, which are given with the floor for the robot's base.

        Raises:
            InputError: there are no starts, or a device does not support a home.
        """
        rows = [(episode, floor, start) for episode, floor, some in starts for start in some]
        if not rows:
            raise InputError("Expected at least one start of a skill, got none.", code="H3-TRAIN-070")
        homes = list({id(episode.scene): (episode.scene, floor) for episode, floor, _ in rows}.values())
        if any(scene.articulations or len(floor.heights) for scene, floor in homes):
            raise InputError(
                "Skills are simulated on a device only in homes on one floor where nothing opens. Hint: h3-homes/train.",
                code="H3-TRAIN-071",
            )
        number = {id(scene): k for k, (scene, _) in enumerate(homes)}
        found = [start for _, _, start in rows]
        return cls(
            floors=tuple(floor for _, floor in homes),
            scenes=tuple(scene for scene, _ in homes),
            place=np.array([number[id(episode.scene)] for episode, _, _ in rows], np.int64),
            xz=np.array([s.xz for s in found], np.float64),
            heading=np.array([s.heading for s in found], np.float64),
            objects=np.array([s.objects for s in found], np.float64),
            bodies=np.array([body_indices(episode) for episode, _, _ in rows], np.int64),
            turned=np.array([[t.start[3:] for t in episode.targets] for episode, _, _ in rows], np.float64),
            target=np.array([s.target for s in found], np.int64),
            holds=np.array([s.holds for s in found], np.bool_),
            point=np.array([s.point for s in found], np.float64),
            stand=np.array([s.stand_xz for s in found], np.float64),
        )

    @classmethod
    def merged(cls, banks: Sequence[SkillBank]) -> SkillBank:
        """Return the concatenated starts of several banks."""
        first = np.cumsum([0, *(len(bank.floors) for bank in banks)])
        return cls(
            floors=tuple(floor for bank in banks for floor in bank.floors),
            scenes=tuple(scene for bank in banks for scene in bank.scenes),
            place=np.concatenate([bank.place + n for bank, n in zip(banks, first[:-1], strict=True)]),
            **{name: np.concatenate([getattr(bank, name) for bank in banks]) for name in COLUMNS[1:]},
        )

    def with_near(self, share: float, *, within_m: float = 1.0) -> SkillBank:
        """Return a bank in which a given share of the starts is close to the stands.

        For this, starts within ``within_m`` of their stands are repeated. The bank is unchanged if there are none, or
        enough.
        """
        near = np.hypot(*(self.xz - self.stand).T) < within_m
        missing = int(share * (~near).sum() / (1.0 - share)) - int(near.sum())
        if not near.any() or missing <= 0:
            return self
        rows = np.concatenate([np.arange(len(self)), np.resize(np.flatnonzero(near), missing)])
        return replace(self, **{name: getattr(self, name)[rows] for name in COLUMNS})

    def with_reaching(self, share: float, bearing: float, rng: np.random.Generator) -> SkillBank:
        """Return a bank in which a given share of the starts is at the stands, with the arm partly extended.

        Such a start repeats one of the bank, but with the robot at the position and heading from which the hand reaches
        the target.

        Args:
            share: share of the starts, from 0 to less than 1.
            bearing: direction in which the robot reaches, to the left of its forward axis [rad].
            rng: random generator for the extension of the arms.
        """
        count = round(share / (1.0 - share) * len(self))
        if not count:
            return self
        rows = np.resize(np.arange(len(self)), count)
        ahead = self.point[rows][:, [0, 2]] - self.stand[rows]
        near = {name: getattr(self, name)[rows] for name in COLUMNS}
        near |= {"xz": self.stand[rows], "heading": np.arctan2(-ahead[:, 1], ahead[:, 0]) - bearing}
        return replace(
            self,
            **{name: np.concatenate([getattr(self, name), near[name]]) for name in COLUMNS},
            unfolded=np.concatenate([np.zeros(len(self)), rng.uniform(0.0, 1.0, count)]),
        )

    def __len__(self) -> int:
        return len(self.place)
