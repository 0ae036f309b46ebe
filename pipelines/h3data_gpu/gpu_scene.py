"""`GpuScene`: a scene and its moving parts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from h3data.render.scene import RenderScene


class SkinWeights(Protocol):
    """Skin weights of a mesh, e.g. `h3data.bodies.people.humanoid.SkinnedMesh`."""

    @property
    def joints(self) -> NDArray[np.uint8]:
        """Joint of each weight, shape [V, 4]."""
        ...

    @property
    def weights(self) -> NDArray[np.float32]:
        """Four weights per vertex, shape [V, 4]."""
        ...


@dataclass(frozen=True, eq=False)
class GpuScene:
    """A scene and its moving parts; everything else is baked into world coordinates."""

    scene: RenderScene
    moving: Sequence[int] = ()
    """Instances that have a pose of their own in every world; those of deformable meshes need not be listed."""
    skins: Mapping[int, tuple[SkinWeights, NDArray[Any]]] = field(default_factory=dict)
    """Skin weights and inverse bind matrices [J, 4, 4] of deformable meshes that follow joints. Other deformable meshes
    get their vertices by `GpuRenderer.update_vertices`."""

    @property
    def slots(self) -> tuple[int, ...]:
        """Instances that have poses, in the order of `GpuRenderer.update_poses`."""
        deformable = set(self.scene.deformable)
        others = [k for k, m in enumerate(self.scene.instance_mesh) if int(m) in deformable and k not in self.moving]
        return (*(int(k) for k in self.moving), *others)
