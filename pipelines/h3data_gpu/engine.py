"""Back end ``gpu`` of `h3data.render.Renderer`, whose outputs are tensors on the device.

Poses come from the host. For thousands of worlds, or if poses are on the device already, use `GpuRenderer`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.render.camera import Camera
from h3data.render.outputs import Poses
from h3data.render.scene import RenderScene
from h3data.render.shade.blockers import Blockers
from h3data.render.shade.shading import Light
from h3data_gpu.gpu_scene import GpuScene
from h3data_gpu.renderer import GpuRenderer


class GpuEngine:
    """An engine in which every instance may move; changes are uploaded with the next image."""

    renderer_class = GpuRenderer

    def __init__(self, scene: RenderScene, *, light: Light, worlds: int = 1, threads: int = 1) -> None:
        self.scene, self.light, self.world_count = scene, light, worlds
        self._stage = _whole(scene)
        self._matrix = np.tile(scene.instance_matrix, (worlds, 1, 1, 1))
        self._visible = np.ones((worlds, len(scene.instances)), np.bool_)
        self._vertices: dict[int, NDArray[np.float32]] = {}
        self._changed_meshes: list[set[int]] = [set() for _ in range(worlds)]
        self._renderer: GpuRenderer | None = None
        self._blockers: list[Blockers | None] = [None] * worlds
        self._poses_stale, self._blockers_stale = True, False
        self._stale_meshes: set[int] = set()

    # --- state --------------------------------------------------------------------------------------------------------
    def set_transforms(self, world: int, instances: NDArray[np.intp], matrices: NDArray[np.float64]) -> None:
        """Set the transforms [n, 4, 4] (mesh to world) of instances in one world, which the next image uses."""
        self._matrix[world, instances] = matrices
        self._poses_stale = True

    def set_visible(self, world: int, instances: NDArray[np.intp], visible: NDArray[np.bool_]) -> None:
        """Show or hide instances in one world."""
        self._visible[world, instances] = visible
        self._poses_stale = True

    def set_vertices(self, world: int, mesh: int, vertices: NDArray[np.float32]) -> None:
        """Replace the vertices [V, 3] [m] of a deformable mesh in one world."""
        if mesh not in self._vertices:
            self._vertices[mesh] = np.tile(self.scene.meshes[mesh].vertices, (self.world_count, 1, 1))
        self._vertices[mesh][world] = vertices
        self._changed_meshes[world].add(mesh)
        self._stale_meshes.add(mesh)

    def set_blockers(self, world: int, blockers: Blockers | None) -> None:
        """Set the capsules that cast soft shadows in one world; None removes them."""
        self._blockers[world] = blockers
        self._blockers_stale = True

    def poses(self, world: int) -> Poses:
        """Copy of the transforms, vertices and visibility in one world."""
        vertices = {mesh: self._vertices[mesh][world].copy() for mesh in sorted(self._changed_meshes[world])}
        return Poses(matrix=self._matrix[world].copy(), vertices=vertices, visible=self._visible[world].copy())

    # --- images -------------------------------------------------------------------------------------------------------
    def render(
        self,
        cameras: Sequence[Camera],
        worlds: Sequence[int],
        outputs: Sequence[Any],
        samples: Any,
        out: Mapping[str, Any] | None,
    ) -> dict[str, Any]:
        """Render cameras of one picture size in the given worlds; return tensors on the device."""
        renderer = self._current_renderer(cameras[0].width, cameras[0].height)
        return copied_to(out, renderer.render(list(cameras), worlds=worlds, outputs=outputs, samples=samples))

    def _current_renderer(self, width: int, height: int) -> GpuRenderer:
        """Return a renderer of this size in the current state of all worlds. Only the most recent size is kept."""
        renderer = self._renderer
        if renderer is None or (renderer.width, renderer.height) != (width, height):
            renderer = self.renderer_class(
                self._stage, width=width, height=height, worlds=self.world_count, light=self.light
            )
            self._renderer = renderer
            self._poses_stale, self._blockers_stale, self._stale_meshes = True, True, set(self._vertices)
        if self._poses_stale and len(self.scene.instances):
            renderer.update_poses(np.where(self._visible[..., None, None], self._matrix, np.nan))
        for mesh in sorted(self._stale_meshes):
            renderer.update_vertices(mesh, self._vertices[mesh])
        if self._blockers_stale:
            renderer.update_blockers(self._blockers)
        self._poses_stale, self._blockers_stale, self._stale_meshes = False, False, set()
        return renderer


@lru_cache(maxsize=1)
def _whole(scene: RenderScene) -> GpuScene:
    """Return a scene in which everything may move: the same object again for the last one, which is packed already."""
    return GpuScene(scene, moving=range(len(scene.instances)))


def copied_to(out: Mapping[str, Any] | None, results: Mapping[str, Any]) -> dict[str, Any]:
    """Copy ``results`` into the tensors of ``out`` of the same names, if there are any."""
    copies = dict(results)
    for name, target in (out or {}).items():
        if name not in copies:
            continue
        tensor = copies[name]
        if getattr(target, "dtype", None) != tensor.dtype or tuple(target.shape) != tuple(tensor.shape):
            raise InputError(
                f"out[{name!r}] must be a {tensor.dtype} tensor {list(tensor.shape[1:])} per camera.",
                code="H3-RENDER-019",
            )
        copies[name] = target.copy_(tensor)
    return copies
