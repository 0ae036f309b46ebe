"""What of a scene moves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from h3data.render.scene import RenderScene


class SkinWeights(Protocol):
    """What drives a skinned mesh; `h3data.bodies.people.humanoid.SkinnedMesh` is one."""

    @property
    def joints(self) -> NDArray[np.uint8]:
        """Joints of the four weights, shape [V, 4]."""
        ...

    @property
    def weights(self) -> NDArray[np.float32]:
        """Shape [V, 4]."""
        ...


@dataclass(frozen=True, eq=False)
class GpuScene:
    """A scene, and what of it moves: everything else is baked where it stands."""

    scene: RenderScene
    moving: Sequence[int] = ()
    """Instances with a pose of their own in every world; those of deformable meshes need not be named."""
    skins: Mapping[int, tuple[SkinWeights, NDArray[Any]]] = field(default_factory=dict)
    """Of deformable meshes that follow joints: the weights, and the inverse bind matrices [J, 4, 4]. The other deformable
    meshes are given their vertices."""

    @property
    def slots(self) -> tuple[int, ...]:
        """The instances that have poses, in the order of `GpuRenderer.update_poses`."""
        deformable = set(self.scene.deformable)
        others = [k for k, m in enumerate(self.scene.instance_mesh) if int(m) in deformable and k not in self.moving]
        return (*(int(k) for k in self.moving), *others)
