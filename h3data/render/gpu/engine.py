"""The GPU behind `h3data.render.Renderer` (``backend="gpu"``): the same calls as on the CPU, tensors on the device.

For thousands of worlds, or where poses already lie on the device, use `GpuRenderer`: here poses come from the host.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.render.camera import Camera
from h3data.render.gpu.renderer import GpuRenderer
from h3data.render.gpu.stage import GpuScene
from h3data.render.pictures import Poses
from h3data.render.scene import RenderScene
from h3data.render.shade.shading import Light


class GpuEngine:
    """Every instance may move; what was changed goes to the device with the next picture."""

    renderer_class = GpuRenderer

    def __init__(self, scene: RenderScene, *, light: Light, worlds: int = 1) -> None:
        self.scene, self.light, self.world_count = scene, light, worlds
        self._stage = GpuScene(scene, moving=range(len(scene.instances)))
        self._matrix = np.tile(scene.instance_matrix, (worlds, 1, 1, 1))
        self._visible = np.ones((worlds, len(scene.instances)), np.bool_)
        self._vertices: dict[int, NDArray[np.float32]] = {}
        self._given: list[set[int]] = [set() for _ in range(worlds)]
        self._renderer: GpuRenderer | None = None
        self._poses_stale = True
        self._stale_meshes: set[int] = set()

    # --- what moves ---------------------------------------------------------------------------------------------------
    def set_transforms(self, world: int, instances: NDArray[np.intp], matrices: NDArray[np.float64]) -> None:
        self._matrix[world, instances] = matrices
        self._poses_stale = True

    def set_visible(self, world: int, instances: NDArray[np.intp], visible: NDArray[np.bool_]) -> None:
        self._visible[world, instances] = visible
        self._poses_stale = True

    def set_vertices(self, world: int, mesh: int, vertices: NDArray[np.float32]) -> None:
        if mesh not in self._vertices:
            self._vertices[mesh] = np.tile(self.scene.meshes[mesh].vertices, (self.world_count, 1, 1))
        self._vertices[mesh][world] = vertices
        self._given[world].add(mesh)
        self._stale_meshes.add(mesh)

    def poses(self, world: int) -> Poses:
        vertices = {mesh: self._vertices[mesh][world].copy() for mesh in sorted(self._given[world])}
        return Poses(matrix=self._matrix[world].copy(), vertices=vertices, visible=self._visible[world].copy())

    # --- pictures -----------------------------------------------------------------------------------------------------
    def render(
        self, cameras: Sequence[Camera], worlds: Sequence[int], outputs: Sequence[Any], samples: Any,
        out: Mapping[str, Any] | None,
    ) -> dict[str, Any]:  # fmt: skip
        renderer = self._posed(cameras[0].width, cameras[0].height)
        return handed_out(renderer.render(list(cameras), worlds=worlds, outputs=outputs, samples=samples), out)

    def _posed(self, width: int, height: int) -> GpuRenderer:
        """A renderer of this size with everything where it is now. The one of the last size is kept."""
        renderer = self._renderer
        if renderer is None or (renderer.width, renderer.height) != (width, height):
            renderer = self.renderer_class(
                self._stage, width=width, height=height, worlds=self.world_count, light=self.light
            )
            self._renderer = renderer
            self._poses_stale, self._stale_meshes = True, set(self._vertices)
        if self._poses_stale and len(self.scene.instances):
            renderer.update_poses(np.where(self._visible[..., None, None], self._matrix, np.nan))
        for mesh in sorted(self._stale_meshes):
            renderer.update_vertices(mesh, self._vertices[mesh])
        self._poses_stale, self._stale_meshes = False, set()
        return renderer


def handed_out(results: Mapping[str, Any], out: Mapping[str, Any] | None) -> dict[str, Any]:
    """``results``, those that ``out`` has a tensor for copied into it."""
    handed = dict(results)
    for name, array in (out or {}).items():
        if name not in handed:
            continue
        tensor = handed[name]
        if getattr(array, "dtype", None) != tensor.dtype or tuple(array.shape) != tuple(tensor.shape):
            raise InputError(f"out[{name!r}] must be a {tensor.dtype} tensor {list(tensor.shape[1:])} per camera.")
        handed[name] = array.copy_(tensor)
    return handed
