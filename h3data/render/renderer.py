"""Renderer with one interface to all back ends, for single cameras or batches of cameras over many worlds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, Protocol, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError, MissingExtraError
from h3data.plugins import Registry
from h3data.render.camera import Camera
from h3data.render.outputs import Output, Poses, check_outputs
from h3data.render.scene import RenderScene
from h3data.render.shade.blockers import Blockers
from h3data.render.shade.blockers_simd import BLOCKER_WORDS
from h3data.render.shade.shading import Light

Backend = Literal["auto", "cpu", "gpu", "rays"]
ENGINES: Registry[Callable[..., Engine]] = Registry("h3data.renderers", {}, what="back end")
"""Functions that create the back ends ``gpu``, ``auto`` and ``rays`` from a scene, a light and the numbers of worlds
and threads. ``rays`` also takes ``only_rays``; if it is False, the rasteriser renders outputs that rays cannot."""


class Engine(Protocol):
    """Interface of back ends, which hold the state of each world and render images.

    `Renderer` checks all arguments before it calls a back end.
    """

    def set_transforms(self, world: int, instances: NDArray[np.intp], matrices: NDArray[np.float64]) -> None:
        """Set the transforms [n, 3, 4] of instances [n]."""
        ...

    def set_visible(self, world: int, instances: NDArray[np.intp], visible: NDArray[np.bool_]) -> None:
        """Show or hide instances [n]."""
        ...

    def set_vertices(self, world: int, mesh: int, vertices: NDArray[np.float32]) -> None:
        """Replace the vertices [V, 3] of a deformable mesh; the engine may keep the array."""
        ...

    def set_blockers(self, world: int, blockers: Blockers | None) -> None:
        """Set the capsules that block light from surfaces."""
        ...

    def poses(self, world: int) -> Poses:
        """Return a copy of the state of a world."""
        ...

    def render(
        self,
        cameras: Sequence[Camera],
        worlds: Sequence[int],
        outputs: Sequence[str],
        samples: int,
        out: Mapping[str, Any] | None,
    ) -> dict[str, Any]:
        """Return images [N, H, W, ...] of N cameras of one size, each in its own world."""
        ...


class Renderer:
    """Renderer of a `RenderScene`; holds the state of its worlds and the buffers.

    Use one renderer per thread, or one with ``threads``, which renders batches in parallel. In a new renderer, every
    world has the initial state of the scene.
    """

    def __init__(
        self,
        scene: RenderScene,
        *,
        light: Light | None = None,
        backend: Backend = "cpu",
        worlds: int = 1,
        threads: int = 1,
    ) -> None:
        """Prepare a scene for a back end.

        Args:
            scene: the scene.
            light: light; default `Light()`.
            backend: ``cpu`` (rasteriser, NumPy arrays), ``gpu`` (CUDA, torch tensors that stay on the device), ``rays``
                (Embree, NumPy arrays) or ``auto``: ``gpu`` if there is one, else ``cpu``. With ``auto`` on a GPU, cast
                shadows and non-perspective cameras are rendered on the CPU and copied to the device.
            worlds: number of worlds.
            threads: number of threads that render a batch on the CPU.

        Raises:
            InputError: there is no such back end.
            MissingExtraError: the back end cannot run here; the message says what is missing.
        """
        if worlds < 1 or threads < 1:
            raise InputError(
                f"A renderer needs at least one world and one thread, got {worlds} and {threads}.", code="H3-RENDER-055"
            )
        self.scene = scene
        self.light = light or Light()
        self.world_count = worlds
        self.backend, self._engine = _engine(scene, self.light, backend, worlds, threads)

    # --- state ----------------------------------------------------------------------------------------------------
    def set_transforms(self, indices: ArrayLike, matrices: ArrayLike, *, world: int = 0) -> None:
        """Set the transforms [n, 4, 4] or [n, 3, 4] of instances [n], mesh to world.

        NaN hides an instance until its transform is set again.
        """
        index = self._checked(indices)
        m = np.asarray(matrices, np.float64)
        if m.ndim == 2:
            m = m[None]
        if m.shape not in ((len(index), 4, 4), (len(index), 3, 4)):
            raise InputError(
                f"Expected {len(index)} matrices [n, 4, 4], got shape {list(m.shape)}.", code="H3-RENDER-056"
            )
        self._engine.set_transforms(self._world(world), index, m[:, :3])

    def set_visible(self, indices: ArrayLike, visible: ArrayLike, *, world: int = 0) -> None:
        """Show or hide instances [n]; ``visible`` is one bool or [n]."""
        index = self._checked(indices)
        self._engine.set_visible(self._world(world), index, np.broadcast_to(np.asarray(visible, np.bool_), index.shape))

    def set_vertices(self, mesh: int, vertices: ArrayLike, *, world: int = 0) -> None:
        """Replace the vertices [V, 3] [m] of a deformable mesh; its smooth normals are updated."""
        scene = self.scene
        if mesh not in scene.deformable:
            raise InputError(
                f"Mesh {mesh} is not deformable (these are: {list(scene.deformable)}). "
                "Hint: list it in RenderScene(..., deformable=...).",
                code="H3-RENDER-057",
            )
        # a copy, because engines keep the array, and the caller may go on to write into theirs
        v = np.array(vertices, np.float32, order="C")
        expected = scene.meshes[mesh].vertices.shape
        if v.shape != expected or not np.isfinite(v).all():
            fault = "values that are not finite" if v.shape == expected else f"shape {list(v.shape)}"
            raise InputError(
                f"Mesh {mesh} needs {list(expected)} finite vertices, got {fault}. Hint: hide it with set_visible.",
                code="H3-RENDER-058",
            )
        self._engine.set_vertices(self._world(world), mesh, v)

    def set_blockers(self, blockers: Blockers | None, *, world: int = 0) -> None:
        """Set the capsules that cast soft shadows in ``rgb``, and the light on moving instances; None removes both.

        `h3data_light.field.LightField.blockers` computes them from the poses of agents and objects. The capsules are
        used until the next call.
        """
        if blockers is not None:
            # checked here, because the kernels that read them check no bounds
            rows, tints, count = blockers.rows, blockers.tints, len(self.scene.instances)
            if rows.ndim != 2 or rows.shape[1] != BLOCKER_WORDS or tints.shape != (count, 4):
                raise InputError(
                    f"Blockers need rows [N, {BLOCKER_WORDS}] and tints [{count}, 4], "
                    f"got {list(rows.shape)} and {list(tints.shape)}.",
                    code="H3-RENDER-065",
                )
            if not (np.isfinite(rows).all() and np.isfinite(tints).all()):
                raise InputError(
                    "Blockers need finite numbers. Hint: blocker_rows leaves out capsules with NaN.",
                    code="H3-RENDER-066",
                )
            blockers = Blockers(np.ascontiguousarray(rows, np.float32), np.ascontiguousarray(tints, np.float32))
        self._engine.set_blockers(self._world(world), blockers)

    def poses(self, world: int = 0) -> Poses:
        """Return a copy of the state of a world, e.g. for `h3data_pipelines.pictures.flow.optical_flow`."""
        return self._engine.poses(self._world(world))

    def _world(self, world: int) -> int:
        # -1 would be the last world of a list
        if not 0 <= world < self.world_count:
            raise InputError(
                f"There is no world {world}: this renderer has {self.world_count}, 0 to {self.world_count - 1}.",
                code="H3-RENDER-059",
            )
        return int(world)

    def _checked(self, indices: ArrayLike) -> NDArray[np.intp]:
        index = np.atleast_1d(np.asarray(indices))
        count = len(self.scene.instances)
        # NumPy makes an array of floats of an empty list
        if index.size == 0:
            return np.zeros(0, np.intp)
        if index.ndim != 1 or index.dtype.kind not in "iu" or index.min() < 0 or index.max() >= count:
            raise InputError(f"Expected instance indices from 0 to {count - 1}, got {indices!r}.", code="H3-RENDER-060")
        return index.astype(np.intp)

    # --- images ---------------------------------------------------------------------------------------------------
    def render(
        self,
        camera: Camera,
        *,
        outputs: Sequence[Output] = ("depth", "instance", "rgb"),
        samples: Literal[1, 4] = 1,
        out: Mapping[str, Any] | None = None,
        world: int = 0,
    ) -> dict[str, Any]:
        """Return images of one camera by output, each [H, W, ...], top row first.

        - ``depth`` float32: z-depth [m] (distance for fisheye and equirectangular cameras), 0 = miss
        - ``instance``, ``semantic``, ``triangle`` (of the mesh) int32, -1 = miss
        - ``rgb`` uint8 [H, W, 3] sRGB; ``samples=4`` smooths edges (all other outputs sample the pixel centre)
        - ``normal`` float32 [H, W, 3]: unit world normal facing the camera, 0 = miss

        Arrays given in ``out`` are filled and returned; the others are newly allocated.
        """
        given = None if out is None else {name: array[None] for name, array in out.items() if array is not None}
        pictures = self.render_batch([camera], worlds=[world], outputs=outputs, samples=samples, out=given)
        return {name: out[name] if out and name in out else batch[0] for name, batch in pictures.items()}

    def render_batch(
        self,
        cameras: Sequence[Camera],
        *,
        worlds: Sequence[int] | None = None,
        outputs: Sequence[Output] = ("depth", "instance", "rgb"),
        samples: Literal[1, 4] = 1,
        out: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """Return images of N cameras of one size, each in its own world (default 0), as in `render`, each [N, H, W, ...]."""
        check_outputs(outputs)
        if samples not in (1, 4):
            raise InputError(f"samples must be 1 or 4, got {samples!r}.", code="H3-RENDER-032")
        if not cameras:
            raise InputError("A batch needs at least one camera.", code="H3-RENDER-061")
        for camera in cameras:
            camera.checked()
        sizes = sorted({(camera.width, camera.height) for camera in cameras})
        if len(sizes) > 1:
            raise InputError(
                f"The cameras of a batch must have one size, got {sizes}. Hint: one batch per size.",
                code="H3-RENDER-062",
            )
        world_of_camera = [0] * len(cameras) if worlds is None else [self._world(world) for world in worlds]
        if len(world_of_camera) != len(cameras):
            raise InputError(
                f"Expected one world for each of {len(cameras)} cameras, got {len(world_of_camera)}.",
                code="H3-RENDER-063",
            )
        return self._engine.render(cameras, world_of_camera, outputs, samples, out)

    def __repr__(self) -> str:
        return f"Renderer({self.scene!r}, backend={self.backend!r}, worlds={self.world_count})"


def gpu_fault() -> str:
    """Return the reason why the back end ``gpu`` cannot be used here; empty if it can."""
    missing = ENGINES.missing().get("gpu")
    if missing:
        return f"it needs the package {missing}, which this installation does not have"
    import torch

    return "" if torch.cuda.is_available() else "PyTorch finds no CUDA device"


def _engine(scene: RenderScene, light: Light, backend: str, worlds: int, threads: int) -> tuple[Backend, Engine]:
    if backend not in get_args(Backend):
        raise InputError(
            f"Unknown back end {backend!r}. Available: {', '.join(get_args(Backend))}.", code="H3-RENDER-054"
        )
    if backend in ("auto", "gpu"):
        fault = gpu_fault()
        if not fault:
            return "gpu", ENGINES.get(backend)(scene, light=light, worlds=worlds, threads=threads)
        if backend == "gpu":
            raise MissingExtraError(
                f"The back end 'gpu' cannot be used: {fault}. Hint: backend='cpu'.", code="H3-RENDER-064"
            )
    only_rays = backend == "rays"
    # The rasteriser alone serves installations without the package of rays, as long as nobody asks for what needs
    # rays; otherwise that package has an engine that rasterises what it can.
    if "rays" in ENGINES.missing() and not only_rays and not light.shadow_rays:
        from h3data.render.raster.cpu import CpuEngine

        return "cpu", CpuEngine(scene, light=light, worlds=worlds, threads=threads)
    engine = ENGINES.get("rays")(scene, light=light, worlds=worlds, threads=threads, only_rays=only_rays)
    return "rays" if only_rays else "cpu", engine
