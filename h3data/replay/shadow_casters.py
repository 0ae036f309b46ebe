"""Capsules of all moving objects in a recording, which cast soft shadows in baked light."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array
from h3data.render.scene import RenderInstance
from h3data.render.shade.blockers import Blockers
from h3data.scene import Mesh


class LightField(Protocol):
    """Interface of the light at all points of a home, such as `h3data_light.field.LightField`."""

    def blockers(
        self, capsules: NDArray[np.floating], groups: NDArray[np.integer], *, members: NDArray[np.integer]
    ) -> Blockers:
        """Return the light that capsules [N, 7] of groups [N] block; ``members`` [I] are the groups of all instances."""
        ...


@dataclass(frozen=True, eq=False)
class ShadowCasters:
    """Moving instances of a scene, in groups that cast no shadow on themselves; a group is an agent or one object."""

    field: LightField
    members: NDArray[np.int64]
    """Group of every instance, -1 for static ones, shape [I]."""
    local: NDArray[np.float64]
    """Capsule around the mesh of every instance, in its frame: both ends and radius, shape [I, 7] [m]; NaN without a
    mesh."""

    def blockers(
        self, rigid: Sequence[tuple[NDArray[np.intp], Array]], world: Mapping[int, NDArray[np.floating]]
    ) -> Blockers:
        """Return the blockers of light at one moment.

        Args:
            rigid: Instances [n] and their matrices [n, 4, 4], NaN where absent.
            world: Capsules [n, 7] of deformable bodies in the world, by an instance of each.
        """
        capsules, groups = [np.zeros((0, 7))], [np.zeros(0, np.int64)]
        for instances, matrices in rigid:
            capsules.append(moved(self.local[instances], np.asarray(matrices, np.float64)))
            groups.append(self.members[instances])
        for instance, own in world.items():
            capsules.append(np.asarray(own, np.float64))
            groups.append(np.full(len(own), self.members[instance]))
        return self.field.blockers(np.concatenate(capsules), np.concatenate(groups), members=self.members)


def shadow_casters(
    field: LightField, meshes: Sequence[Mesh], instances: Sequence[RenderInstance], agents: Mapping[int, int]
) -> ShadowCasters:
    """Return the shadow casters of a scene.

    ``agents`` holds the agent of every moving instance, or -1 for objects.
    """
    members = np.full(len(instances), -1, np.int64)
    local = np.full((len(instances), 7), np.nan)
    first_thing = max(agents.values(), default=-1) + 1
    for instance, agent in sorted(agents.items()):
        # a group does not darken itself: all parts of an agent are one, each thing is its own
        members[instance] = agent if agent >= 0 else first_thing + instance
        mesh = meshes[instances[instance].mesh]
        if len(mesh.vertices):
            local[instance] = capsule_of_box(*mesh.bounds.astype(np.float64))
    return ShadowCasters(field, members, local)


def moved(capsules: NDArray[np.float64], matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Move capsules [N, 7] by matrices [N, 4, 4]; their radii scale like the cube root of the volume."""
    linear, origin = matrices[:, :3, :3], matrices[:, :3, 3]
    ends = [(linear @ capsules[:, k : k + 3, None])[..., 0] + origin for k in (0, 3)]
    size = np.cbrt(np.abs(np.linalg.det(np.nan_to_num(linear))))  # of bodies that are absent the ends are NaN
    return np.column_stack([*ends, capsules[:, 6] * size])


def capsule_of_box(low: Sequence[float], high: Sequence[float]) -> NDArray[np.float64]:
    """Return a capsule along the longest side of a box, with a cross-section of the same area, shape [7] [m].

    For an empty box the capsule is NaN.
    """
    size, middle = np.subtract(high, low), np.add(low, high) / 2
    if not np.isfinite(size).all() or size.max() <= 0:
        return np.full(7, np.nan)
    axis = int(size.argmax())
    # the circle with the area of the cross-section; a sheet keeps half a centimetre
    radius = max(float(np.sqrt(np.delete(size, axis).prod() / np.pi)), 0.005)
    half = np.zeros(3)
    half[axis] = max(size[axis] / 2 - radius, 0)
    return np.concatenate([middle - half, middle + half, [radius]])
