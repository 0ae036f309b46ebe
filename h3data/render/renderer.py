"""One thread's renderer: the poses of the moment, the buffers, and `render`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.render.camera import Camera
from h3data.render.clusters import enclosing_box, fill_packets, smooth_normals
from h3data.render.raster import Placement, Target, View, new_target, rasterise
from h3data.render.raster_read import read_depth, read_ids, read_triangles
from h3data.render.scene import RenderScene
from h3data.render.shading import Light, shade

Output = Literal["depth", "instance", "semantic", "triangle", "rgb", "normal"]

_FORMS: Mapping[str, tuple[tuple[int, ...], type]] = {
    "depth": ((), np.float32),
    "instance": ((), np.int32),
    "semantic": ((), np.int32),
    "triangle": ((), np.int32),
    "rgb": ((3,), np.uint8),
    "normal": ((3,), np.float32),
}
"""Trailing shape after [H, W], and dtype, of each output."""

_KEPT_TARGETS = 4
"""Buffers are kept for this many picture sizes."""


class Renderer:
    """Draws a `RenderScene`. Holds poses, deformed vertices and buffers: use one per thread (the kernels free the GIL).

    A fresh renderer shows the scene as it was built.
    """

    def __init__(self, scene: RenderScene, *, light: Light | None = None) -> None:
        self.scene = scene
        self.light = light or Light()
        self._matrix = scene.instance_matrix.copy()
        self._visible = np.ones(len(scene.instances), np.bool_)
        self._geometry = scene.geometry
        self._surface = scene.surface
        self._stale_normals: dict[int, NDArray[np.float32]] = {}
        if scene.deformable:
            shared = scene.geometry
            self._geometry = shared._replace(
                own_packets=shared.own_packets.copy(),
                center=shared.center.copy(),
                half=shared.half.copy(),
                mesh_center=shared.mesh_center.copy(),
                mesh_half=shared.mesh_half.copy(),
            )
            self._surface = scene.surface._replace(normals=scene.surface.normals.copy())
        self._targets: dict[tuple[int, int], Target] = {}

    # --- what moves -----------------------------------------------------------------------------------------------
    def set_transforms(self, indices: ArrayLike, matrices: ArrayLike) -> None:
        """Place instances [n] by matrices [n, 4, 4] (or [n, 3, 4]), mesh to world; NaN hides one until it is set again."""
        index = self._checked(indices)
        m = np.asarray(matrices, np.float64)
        if m.ndim == 2:
            m = m[None]
        if m.shape not in ((len(index), 4, 4), (len(index), 3, 4)):
            raise InputError(f"Expected {len(index)} matrices [n, 4, 4], got shape {list(m.shape)}.")
        self._matrix[index] = m[:, :3]

    def set_visible(self, indices: ArrayLike, visible: ArrayLike) -> None:
        """Show or hide instances [n]; ``visible`` is one bool or [n]."""
        self._visible[self._checked(indices)] = np.asarray(visible, np.bool_)

    def set_vertices(self, mesh: int, vertices: NDArray[np.float32]) -> None:
        """Replace the vertices [V, 3] [m] of a deformable mesh; its smooth normals follow."""
        scene = self.scene
        if mesh not in scene.deformable:
            raise InputError(
                f"Mesh {mesh} is not deformable (these are: {list(scene.deformable)}). "
                "Hint: name it in RenderScene(..., deformable=...)."
            )
        v = np.ascontiguousarray(vertices, np.float32)
        expected = scene.meshes[mesh].vertices.shape
        if v.shape != expected or not np.isfinite(v).all():
            what = "values that are not finite" if v.shape == expected else f"shape {list(v.shape)}"
            raise InputError(
                f"Mesh {mesh} needs {list(expected)} finite vertices, got {what}. Hint: hide it with set_visible."
            )
        if not len(scene.meshes[mesh].faces):
            return
        geometry, part = self._geometry, scene.parts[mesh]
        clusters = scene.cluster_range(mesh)
        packets = geometry.own_packets[scene.own_packet_range(mesh)]
        center, half = geometry.center[clusters], geometry.half[clusters]
        fill_packets(v, scene.meshes[mesh].faces, part.triangles, part.first, packets, center, half)
        geometry.mesh_center[mesh], geometry.mesh_half[mesh] = enclosing_box(center, half)
        if mesh in scene.groups:
            self._stale_normals[mesh] = v.copy()

    def _checked(self, indices: ArrayLike) -> NDArray[np.intp]:
        index = np.atleast_1d(np.asarray(indices))
        count = len(self.scene.instances)
        if index.size == 0:
            return np.zeros(0, np.intp)
        if index.ndim != 1 or index.dtype.kind not in "iu" or index.min() < 0 or index.max() >= count:
            raise InputError(f"Expected instance numbers from 0 to {count - 1}, got {indices!r}.")
        return index.astype(np.intp)

    def _refresh_normals(self) -> None:
        for mesh, vertices in self._stale_normals.items():
            first, end = self.scene.first_vertex[mesh : mesh + 2]
            groups = self.scene.groups[mesh]
            sums = np.empty((int(groups.max(initial=-1)) + 1, 3), np.float32)
            smooth_normals(vertices, self.scene.meshes[mesh].faces, groups, sums, self._surface.normals[first:end])
        self._stale_normals.clear()

    # --- pictures -------------------------------------------------------------------------------------------------
    def render(
        self,
        camera: Camera,
        *,
        outputs: Sequence[Output] = ("depth", "instance", "rgb"),
        samples: Literal[1, 4] = 1,
        out: Mapping[str, NDArray] | None = None,
    ) -> dict[str, NDArray]:
        """What the camera sees, by name, each [H, W, ...], top row first.

        - ``depth`` float32: z-depth [m], 0 = nothing hit
        - ``instance``, ``semantic``, ``triangle`` (of the mesh) int32, -1 = nothing hit
        - ``rgb`` uint8 [H, W, 3] sRGB; ``samples=4`` smooths its edges (the other outputs always take the pixel centre)
        - ``normal`` float32 [H, W, 3]: unit world normal that faces the camera, 0 = nothing hit

        The arrays are new and yours, except those given in ``out``, which are written and returned.
        """
        results = self._outputs(camera, outputs, out)
        if samples not in (1, 4):
            raise InputError(f"samples must be 1 or 4, got {samples!r}.")
        at_centres = [name for name in outputs if name != "rgb"]
        if at_centres or (samples == 1 and "rgb" in results):
            view = _view(camera)
            target = self._draw(camera, view)
            self._read(target, view, results, rgb=samples == 1)
        if samples == 4 and "rgb" in results:
            view = _view(camera, fine=2)
            self._shade(self._draw(camera, view), view, rgb=results["rgb"], samples=4)
        return results

    def _outputs(self, camera: Camera, outputs: Sequence[str], out: Mapping[str, NDArray] | None) -> dict[str, NDArray]:
        unknown = [name for name in outputs if name not in _FORMS]
        if unknown or isinstance(outputs, str):
            raise InputError(f"Unknown outputs {unknown or outputs!r}. There are: {', '.join(get_args(Output))}.")
        results: dict[str, NDArray] = {}
        for name in outputs:
            trailing, dtype = _FORMS[name]
            shape = (camera.height, camera.width, *trailing)
            array = None if out is None else out.get(name)
            if array is None:
                array = np.zeros(shape, dtype)
            elif array.shape != shape or array.dtype != dtype or not array.flags.c_contiguous:
                raise InputError(
                    f"out[{name!r}] must be contiguous {np.dtype(dtype)} {list(shape)}, "
                    f"got {array.dtype} {list(array.shape)}."
                )
            results[name] = array
        return results

    def _draw(self, camera: Camera, view: View) -> Target:
        size = (view.width, view.height)
        target = self._targets.pop(size, None)
        if target is None:
            target = new_target(*size, draws=self.scene.draw_limit, instances=len(self.scene.instances))
        self._targets[size] = target  # the most recent one last
        while len(self._targets) > _KEPT_TARGETS:
            del self._targets[next(iter(self._targets))]
        shown = self._visible
        if camera.hidden_layers:
            shown = shown & ~np.isin(self.scene.layers, camera.hidden_layers)
        rasterise(self._geometry, Placement(self.scene.instance_mesh, self._matrix, shown), view, target)
        return target

    def _read(self, target: Target, view: View, results: Mapping[str, NDArray], *, rgb: bool) -> None:
        if "depth" in results:
            read_depth(target.inv_z, results["depth"])
        if "instance" in results:
            read_ids(target.words, target.draws, self.scene.ids, results["instance"])
        if "semantic" in results:
            read_ids(target.words, target.draws, self.scene.semantic_ids, results["semantic"])
        if "triangle" in results:
            triangles, packets = self.scene.packet_triangles, self._geometry.cluster_packets
            read_triangles(target.words, target.draws, packets, triangles, results["triangle"])
        picture, normal = results.get("rgb") if rgb else None, results.get("normal")
        if picture is not None or normal is not None:
            self._shade(target, view, rgb=picture, normal=normal)

    def _shade(
        self,
        target: Target,
        view: View,
        *,
        rgb: NDArray[np.uint8] | None = None,
        normal: NDArray[np.float32] | None = None,
        samples: int = 1,
    ) -> None:
        self._refresh_normals()
        placement = Placement(self.scene.instance_mesh, self._matrix, self._visible)
        shade(self._geometry, self._surface, placement, view, target, self.light, rgb, normal, samples)

    def __repr__(self) -> str:
        return f"Renderer({self.scene!r})"


def _view(camera: Camera, *, fine: int = 1) -> View:
    """The camera as the kernels read it, with ``fine`` x ``fine`` as many pixels."""
    pose = np.asarray(camera.pose, np.float64)
    k = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64)
    faults = []
    if camera.width < 1 or camera.height < 1:
        faults.append(f"size {camera.width}x{camera.height}")
    if not (np.isfinite(k).all() and k[0] > 0 and k[1] > 0):
        faults.append(f"fx fy cx cy {k.tolist()}")
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        faults.append("a pose that is not a finite 4x4 matrix")
    elif np.abs(pose[:3, :3].T @ pose[:3, :3] - np.eye(3)).max() > 1e-4:
        faults.append("a pose whose axes are not orthogonal and of unit length")
    if faults:
        raise InputError(f"Camera {camera.name!r} cannot be used, it has: {'; '.join(faults)}.")
    axes = np.ascontiguousarray(pose[:3, :3])
    return View(axes, np.ascontiguousarray(pose[:3, 3]), k * fine, camera.width * fine, camera.height * fine)
