"""Episode datasets of habitat-lab: positions and goals of objects (spec/habitat.md 0, 6.5).

Poses stay the 4x4 matrices that the file has (row-major, acting on column vectors, local to world [m]), so that reading
and writing lose nothing; `object_poses` and `goal_poses` give them as pose7. An object's frame is its centre-of-mass frame.
`h3data_habitat.episodes.files` reads and writes the files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.geometry import pose_from_matrix

RIGID_TOLERANCE = 1e-3
"""Largest error of an entry of R^T R. Habitat writes five decimals, which causes errors below 2e-5."""

Matrix = NDArray[np.float64]


class RigidObject(msgspec.Struct, frozen=True, eq=False, gc=False):
    """Object that the episode adds to the scene."""

    config: str
    """File name of the object's template, such as ``024_bowl.object_config.json``."""
    matrix: Matrix
    """Frame of the object in the world, shape [4, 4]."""

    @property
    def pose(self) -> NDArray[np.float64]:
        """Pose (pose7) of the object in the world."""
        return _pose(self.matrix, self.config)


class Marker(msgspec.Struct, frozen=True, kw_only=True):
    """Point of interest on an articulated object, such as the handle of a drawer."""

    name: str
    kind: str
    """Kind of the marker, Habitat's ``type``."""
    offset: tuple[float, float, float]
    """Position of the marker in the frame of its link [m]."""
    link: str | int
    object: str
    extra: Mapping[str, Any] = msgspec.field(default_factory=dict)
    """Unknown keys of the marker; unknown keys of its ``params`` are under ``params``."""


class RearrangeEpisode(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """Episode with the fields of habitat-lab's ``RearrangeEpisode``.

    Episodes of navigation datasets have no objects.
    """

    episode_id: str | int
    """Id as in the file. habitat-lab's rearrange loader replaces it by 0, 1, ... in the order of the file."""
    scene_id: str
    scene_dataset_config: str = "default"
    additional_obj_config_paths: tuple[str, ...] = ()
    start_position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Start of the agent in the world [m]. The multi-agent tasks sample their own starts and ignore it (spec/habitat.md
    1.2)."""
    start_rotation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """Quaternion ``[x y z w]`` of an agent that looks along -Z in its own frame."""
    rigid_objects: tuple[RigidObject, ...] = ()
    targets: Mapping[str, Matrix] = msgspec.field(default_factory=dict)
    """Goal frames in the world, [4, 4] each, by the handle of the object. Their order numbers the targets."""
    markers: tuple[Marker, ...] = ()
    target_receptacles: tuple[tuple[str, int | None], ...] = ()
    """Handle and link of the furniture on which each target object stands, in the order of ``targets``."""
    goal_receptacles: tuple[tuple[str, int | None], ...] = ()
    """Receptacles of the goals, in the same form as those of the targets."""
    name_to_receptacle: Mapping[str, str] = msgspec.field(default_factory=dict)
    """Name of the receptacle by handle of the object."""
    ao_states: Mapping[str, Mapping[int, float]] = msgspec.field(default_factory=dict)
    """Joint positions [rad or m] by link index, by handle of the articulated object, where they are not the default."""
    info: Mapping[str, Any] = msgspec.field(default_factory=dict)
    extra: Mapping[str, Any] = msgspec.field(default_factory=dict)
    """Keys of the file without a field in this class, or in an older form. The stock loader of habitat-lab refuses
    episodes with keys that its class lacks, and refuses the original file too."""
    absent: frozenset[str] = frozenset()
    """Keys of Habitat that the file did not have (or that are in ``extra``); these fields are not written."""

    @property
    def object_labels(self) -> Mapping[str, str]:
        """Name in the planning problem (``any_targets|0``) by object handle."""
        return self.info.get("object_labels") or {}

    def __repr__(self) -> str:
        return (
            f"RearrangeEpisode({self.episode_id!r}, scene {self.scene_id!r}, {len(self.rigid_objects)} objects, "
            f"{len(self.targets)} targets{', extra ' + ', '.join(self.extra) if self.extra else ''})"
        )


class ContentFile(msgspec.Struct, frozen=True, kw_only=True):
    """Part of a dataset that is split into files ``content/<name>.json.gz``."""

    name: str
    episodes: int
    """Number of consecutive episodes of the set in this file."""
    extra: Mapping[str, Any] = msgspec.field(default_factory=dict)


class EpisodeSet(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """Episodes of a dataset, in the order of the file."""

    episodes: tuple[RearrangeEpisode, ...]
    extra: Mapping[str, Any] = msgspec.field(default_factory=dict)
    """Keys of the file that have no field in this class, such as ``config``."""
    contents: tuple[ContentFile, ...] = ()
    """Names of the files that hold the episodes, if the dataset is split by scene; replace it by () to write one
    file."""
    warnings: tuple[str, ...] = ()
    """Peculiarities of the file, which can nevertheless be used."""

    def __len__(self) -> int:
        return len(self.episodes)

    def __repr__(self) -> str:
        scenes = len({e.scene_id for e in self.episodes})
        return f"EpisodeSet({len(self)} episodes in {scenes} scenes, {len(self.warnings)} warnings)"


def instance_handles(episode: RearrangeEpisode) -> list[str]:
    """Return the handles ``<template>_:<count>`` that Habitat gives to ``episode.rigid_objects``, in the same order.

    Habitat instances them in the order of their template names and counts per template (spec/habitat.md 6.5).
    """
    return handles_of([thing.config for thing in episode.rigid_objects])


def handles_of(configs: Sequence[str]) -> list[str]:
    """Return the handles that Habitat gives to objects, from the file names of their templates, in the same order.

    The handles are ``<template>_:<count>``, counted per template (`instance_handles`).
    """
    handles = [""] * len(configs)
    counts: dict[str, int] = {}
    # the sort is stable, so objects of one template are counted in the order of the file
    for k in sorted(range(len(configs)), key=configs.__getitem__):
        stem = template_name(configs[k])
        counts[stem] = counts.get(stem, 0) + 1
        handles[k] = f"{stem}_:{counts[stem] - 1:04d}"
    return handles


@lru_cache(4096)
def template_name(config: str) -> str:
    """Return the name of a template from its path: ``024_bowl`` of ``configs/024_bowl.object_config.json``."""
    name = config.rsplit("/", 1)[-1]
    return name.removesuffix(".json").removesuffix(".object_config").removesuffix(".glb")


def object_poses(episode: RearrangeEpisode) -> dict[str, NDArray[np.float64]]:
    """Return the pose (pose7) [7] in the world of every rigid object at the start, by handle, in Habitat's order."""
    placed = zip(instance_handles(episode), episode.rigid_objects, strict=True)
    in_order = sorted(placed, key=lambda pair: pair[1].config)
    return {handle: _pose(thing.matrix, handle) for handle, thing in in_order}


def goal_poses(episode: RearrangeEpisode) -> dict[str, NDArray[np.float64]]:
    """Return the pose (pose7) [7] in the world of the goal of every target object, by handle, in the order of the targets."""
    return {handle: _pose(matrix, f"the goal of {handle}") for handle, matrix in episode.targets.items()}


def is_rigid(matrices: Matrix) -> NDArray[np.bool_]:
    """Return whether ``matrices`` [..., 4, 4] are rotations and translations within `RIGID_TOLERANCE`; shape [...]."""
    rotation = matrices[..., :3, :3]
    with np.errstate(invalid="ignore", over="ignore"):
        error = np.abs(np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3)).max(axis=(-1, -2))
        last = np.abs(matrices[..., 3, :] - [0, 0, 0, 1]).max(axis=-1)
        # a mirror image is orthogonal too; the sign of the determinant tells it from a rotation
        proper = np.einsum("...i,...i->...", np.cross(rotation[..., 0], rotation[..., 1]), rotation[..., 2]) > 0
    return (error <= RIGID_TOLERANCE) & (last <= RIGID_TOLERANCE) & proper & np.isfinite(matrices).all(axis=(-1, -2))


def _pose(matrix: Matrix, what: str) -> NDArray[np.float64]:
    if not is_rigid(matrix):
        raise InputError(
            f"Expected a rotation and a translation, the matrix of {what} is none:\n{matrix}", code="H3-HABITAT-038"
        )
    return pose_from_matrix(np.asarray(matrix, np.float64)).astype(np.float64)
