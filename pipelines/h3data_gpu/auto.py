"""Back end ``auto`` of `h3data.render.Renderer`, which uses the GPU, and the CPU for features that the GPU lacks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from h3data.render.camera import Camera
from h3data.render.renderer import ENGINES, Engine
from h3data.render.scene import RenderScene
from h3data.render.shade.blockers import Blockers
from h3data.render.shade.shading import Light
from h3data_gpu.cuda import resolve_device
from h3data_gpu.engine import GpuEngine, copied_to
from h3data_gpu.views import tensor_of

if TYPE_CHECKING:
    import torch


class AutoEngine(GpuEngine):
    """A `GpuEngine` that leaves cast shadows and non-perspective cameras to the CPU.

    A batch with one such camera is rendered by the CPU as a whole. All images are tensors on the device.
    """

    def __init__(self, scene: RenderScene, *, light: Light, worlds: int = 1, threads: int = 1) -> None:
        super().__init__(scene, light=replace(light, shadow_rays=0), worlds=worlds)
        self._cpu_light, self._threads = light, threads
        self._cpu: Engine | None = None

    def set_transforms(self, world: int, instances: NDArray[np.intp], matrices: NDArray[np.float64]) -> None:
        """Set transforms of instances on both back ends."""
        super().set_transforms(world, instances, matrices)
        if self._cpu:
            self._cpu.set_transforms(world, instances, matrices)

    def set_visible(self, world: int, instances: NDArray[np.intp], visible: NDArray[np.bool_]) -> None:
        """Show or hide instances on both back ends."""
        super().set_visible(world, instances, visible)
        if self._cpu:
            self._cpu.set_visible(world, instances, visible)

    def set_vertices(self, world: int, mesh: int, vertices: NDArray[np.float32]) -> None:
        """Replace the vertices of a deformable mesh on both back ends."""
        super().set_vertices(world, mesh, vertices)
        if self._cpu:
            self._cpu.set_vertices(world, mesh, vertices)

    def set_blockers(self, world: int, blockers: Blockers | None) -> None:
        """Set the capsules that cast soft shadows on both back ends."""
        super().set_blockers(world, blockers)
        if self._cpu:
            self._cpu.set_blockers(world, blockers)

    def render(
        self,
        cameras: Sequence[Camera],
        worlds: Sequence[int],
        outputs: Sequence[Any],
        samples: Any,
        out: Mapping[str, Any] | None,
    ) -> dict[str, Any]:
        """Render on the GPU, or on the CPU if cast shadows or other projections are needed."""
        shadows = "rgb" in outputs and self._cpu_light.shadow_rays > 0
        if not shadows and all(camera.projection == "perspective" for camera in cameras):
            return super().render(cameras, worlds, outputs, samples, out)
        self._cpu = self._cpu or self._cpu_engine()
        pictures = self._cpu.render(cameras, worlds, outputs, samples, None)
        device = self._device()
        return copied_to(out, {name: tensor_of(array, device) for name, array in pictures.items()})

    def _device(self) -> torch.device:
        return resolve_device(None)

    def _cpu_engine(self) -> Engine:
        """Return a CPU engine in the current state of all worlds."""
        scene, count = self.scene, self.world_count
        engine = ENGINES.get("rays")(scene, light=self._cpu_light, worlds=count, threads=self._threads)
        for world in range(count):
            poses = self.poses(world)
            engine.set_blockers(world, self._blockers[world])
            same = np.isclose(poses.matrix, scene.instance_matrix, rtol=0, atol=0, equal_nan=True).all((1, 2))
            moved, hidden = np.flatnonzero(~same), np.flatnonzero(~poses.visible)
            if len(moved):
                engine.set_transforms(world, moved, poses.matrix[moved])
            if len(hidden):
                engine.set_visible(world, hidden, poses.visible[hidden])
            for mesh, vertices in poses.vertices.items():
                engine.set_vertices(world, mesh, vertices)
        return engine
