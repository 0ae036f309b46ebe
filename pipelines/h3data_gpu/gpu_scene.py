"""Scenes with moving parts for `GpuRenderer`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from h3data.bodies.people.skinning import Influences
from h3data.render.scene import RenderScene


@dataclass(frozen=True, eq=False)
class GpuScene:
    """Scene with moving parts; all other instances are baked into world coordinates."""

    scene: RenderScene
    moving: Sequence[int] = ()
    """Instances that have their own pose in every world; instances of deformable meshes need not be listed."""
    skins: Mapping[int, tuple[Influences, NDArray[Any]]] = field(default_factory=dict)
    """Skin weights and inverse bind matrices [J, 4, 4] of deformable meshes that follow joints. Other deformable meshes
    get their vertices by `GpuRenderer.update_vertices`."""

    @property
    def slots(self) -> tuple[int, ...]:
        """Instances that have poses, in the order that `GpuRenderer.update_poses` expects."""
        deformable = set(self.scene.deformable)
        others = [k for k, m in enumerate(self.scene.instance_mesh) if int(m) in deformable and k not in self.moving]
        return (*(int(k) for k in self.moving), *others)
