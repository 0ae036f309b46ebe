"""Renderer of thousands of worlds on one GPU, with torch tensors on the device as inputs and outputs."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from h3data.errors import InputError
from h3data.render.camera import Camera
from h3data.render.outputs import FORMS, Output, check_outputs
from h3data.render.scene import RenderScene
from h3data.render.shade.blockers import Blockers
from h3data.render.shade.blockers_simd import BLOCKER_WORDS
from h3data.render.shade.shading import Light
from h3data_gpu.cuda import Program, resolve_device
from h3data_gpu.gpu_scene import GpuScene
from h3data_gpu.layout import Cutouts, Deform, Raster, World
from h3data_gpu.packing import Packed, pack_scenes
from h3data_gpu.shader import Shader
from h3data_gpu.views import Variant, Views, choose_variant, depth_range, new_views, tensor_of

if TYPE_CHECKING:
    import torch

_log = logging.getLogger(__name__)
_SHARED_LIMIT = 227 * 1024
"""Shared memory per block on Hopper [bytes]; other devices have less, and the launch fails."""
_VIEWS_KEPT = 4
_MAX_PIXELS = 2**31 - 1
"""Pixels per launch: the kernels count them in 32 bits."""


class GpuRenderer:
    """Renderer of many worlds at once, whose images equal those of `h3data.render.Renderer`.

    A world is a scene with its own poses, deformed vertices and camera. Everything runs on torch's current stream. No
    call waits for the GPU or copies results to the host unless asked to, so that a step can be captured as a graph
    (`captured`). A new renderer shows the scenes as they were built.
    """

    def __init__(
        self,
        scenes: RenderScene | GpuScene | Sequence[RenderScene | GpuScene],
        *,
        width: int,
        height: int,
        worlds: int,
        scene_of_world: Sequence[int] | None = None,
        light: Light | None = None,
        device: str | torch.device | None = None,
    ) -> None:
        """Copy scenes to the GPU and compile the kernels.

        Args:
            scenes: one scene, or a sequence of scenes.
            width: width of the images [px].
            height: height of the images [px].
            worlds: number of worlds.
            scene_of_world: index of each world's scene; by default world w shows scene w modulo their number.
            light: light of all scenes; default `Light()`. Cast shadows are not supported.
            device: CUDA device; default the current one.

        Raises:
            InputError: there is no GPU, or an argument is invalid.
        """
        listed = [scenes] if isinstance(scenes, RenderScene | GpuScene) else list(scenes)
        self.scenes = tuple(s if isinstance(s, GpuScene) else GpuScene(s) for s in listed)
        self.width, self.height, self.worlds = _positive(width=width, height=height, worlds=worlds)
        if not self.scenes:
            raise InputError("Expected at least one scene.", code="H3-RENDER-024")
        chosen = np.arange(worlds) % len(self.scenes) if scene_of_world is None else np.asarray(scene_of_world)
        if (
            chosen.shape != (worlds,)
            or chosen.dtype.kind not in "iu"
            or not set(chosen) <= set(range(len(self.scenes)))
        ):
            raise InputError(
                f"scene_of_world needs {worlds} numbers from 0 to {len(self.scenes) - 1}.", code="H3-RENDER-025"
            )
        self.scene_of_world = tuple(int(s) for s in chosen)
        self.light = light or Light()
        if self.light.shadow_rays:
            raise InputError(
                "The GPU back end casts no shadows. Hint: Light(shadow_rays=0), or the CPU renderer.",
                code="H3-RENDER-026",
            )
        self.device = self._find_device(device)
        self.packed = pack_scenes(self.scenes)
        self._items = int(self.packed.scenes["items"].max())
        self._programs: dict[Variant, Any] = {}
        self.variant = choose_variant(self.worlds, self.width, self.height)
        self._views: dict[tuple[Any, ...], Views] = {}
        """Buffers on the device for the last `_VIEWS_KEPT` combinations of worlds and lenses."""
        self._upload()
        self._reset()

    def _find_device(self, device: str | torch.device | None) -> torch.device:
        return resolve_device(device)

    def _compile(self, defines: dict[str, int]) -> Any:
        return Program(self.device, defines)

    # --- data on the device -------------------------------------------------------------------------------------------
    def _upload(self) -> None:
        """Upload the packed scenes, allocates the state of all worlds, and fill the structs of the kernels."""
        import torch

        packed = self.packed
        self._tensors = {
            f.name: tensor_of(getattr(packed, f.name), self.device)
            for f in fields(Packed)
            if isinstance(getattr(packed, f.name), np.ndarray)
        }

        def empty(*shape: int) -> torch.Tensor:
            return torch.zeros(shape, dtype=torch.float32, device=self.device)

        worlds = self.worlds
        self._poses = empty(worlds, packed.slots - 1, 12)
        self._palettes = empty(worlds, packed.bodies, packed.inverse_bind.shape[2], 12)
        self._sources = empty(worlds, max(map(len, packed.sources)), 3)
        held = self._held = {
            "scene_of_world": tensor_of(np.array(self.scene_of_world, np.int32), self.device),
            "deformed": empty(worlds, packed.deformed_vertices, 3),
            "deformed_clusters": empty(worlds, packed.deformed_clusters, 8),
            "deformed_groups": empty(worlds, packed.deformed_groups, 8),
        }
        self._world = World()
        self._world.fill(
            **{
                k: self._tensors[k]
                for k in ("vertices", "triangles", "clusters", "items", "places", "scenes", "groups")
            },
            **held,
            poses=self._poses,
            slots=packed.slots,
            deformed_vertices=packed.deformed_vertices,
            deformed_cluster_count=packed.deformed_clusters,
            deformed_group_count=packed.deformed_groups,
        )
        self._deform = Deform()
        self._deform.fill(
            **{k: self._tensors[k] for k in ("inverse_bind", "skin_joints", "skin_weights", "source_vertex")},
            world=self._world,
            palettes=self._palettes,
            sources=self._sources,
            worlds=worlds,
            bodies=packed.bodies,
            joint_count=packed.inverse_bind.shape[2],
            source_count=self._sources.shape[1],
        )
        cutouts = Cutouts()
        cutouts.fill(
            uv=self._tensors["uv"],
            triangle_textures=self._tensors["triangle_textures"],
            maps=self._tensors["opacity_maps"],
            opacity=self._tensors["opacity"],
        )
        self._cutouts = tensor_of(np.frombuffer(bytes(cutouts), np.uint8).copy(), self.device)
        self._shader = Shader(self._tensors, packed, self.light, self.device)

    def _reset(self) -> None:
        """Set all worlds to the state that the scenes were built with."""
        packed = self.packed
        poses = np.full((len(self.scenes), packed.slots - 1, 3, 4), np.nan, np.float32)
        sources = np.zeros((len(self.scenes), *self._sources.shape[1:]), np.float32)
        joints = np.linalg.inv(packed.inverse_bind.astype(np.float64))[:, : packed.bodies, :, :3]
        for number, stage in enumerate(self.scenes):
            poses[number, : len(stage.slots)] = stage.scene.instance_matrix[list(stage.slots)]
            sources[number, : len(packed.sources[number])] = packed.sources[number]
        which = self._held["scene_of_world"].long()
        self._poses.copy_(tensor_of(poses, self.device)[which].flatten(2))
        self._sources.copy_(tensor_of(sources, self.device)[which])
        self._skin(tensor_of(joints.astype(np.float32), self.device)[which])

    @property
    def nbytes(self) -> int:
        """Size of the scenes and worlds on the device, without images [bytes]."""
        state = [self._poses, self._palettes, self._sources]
        tensors = [*self._tensors.values(), *self._held.values(), *state]
        return sum(t.numel() * t.element_size() for t in tensors)

    # --- state --------------------------------------------------------------------------------------------------------
    def update_poses(self, poses: Any) -> None:
        """Set the poses of moving instances, [worlds, N, 4, 4] or [worlds, N, 3, 4], mesh to world.

        The poses are in the order of `GpuScene.slots`. If there are more slots than N, the remaining instances keep
        their poses. NaN hides an instance.
        """
        given = self._floats(poses, "poses", 4)
        count = given.shape[1]
        if count > self.packed.slots - 1 or given.shape[0] != self.worlds or given.shape[2:] not in ((4, 4), (3, 4)):
            raise InputError(
                f"poses must be [{self.worlds}, up to {self.packed.slots - 1}, 4, 4], got {list(given.shape)}.",
                code="H3-RENDER-027",
            )
        self._poses[:, :count].unflatten(2, (3, 4)).copy_(given[:, :, :3])

    def update_joints(self, joints: Any) -> None:
        """Deform all skinned meshes according to the poses of their joints.

        ``joints`` [worlds, bodies, J, 4, 4] (or [..., 3, 4]) map joint to world, for the scene's deformable meshes in
        order; the second axis may be omitted for a single body. NaN hides a body.
        """
        count = self._palettes.shape[2]
        given = self._floats(joints, "joints", None)
        if given.ndim == 4:
            given = given[:, None]
        expected = (self.worlds, self.packed.bodies, count)
        if given.ndim != 5 or given.shape[:3] != expected or given.shape[3:] not in ((4, 4), (3, 4)):
            raise InputError(f"joints must be {[*expected, 4, 4]}, got {list(given.shape)}.", code="H3-RENDER-028")
        given = given.contiguous()
        self._skin(given if given.data_ptr() % 16 == 0 else given.clone())  # the kernel reads rows as float4

    def update_vertices(self, mesh: int, vertices: Any) -> None:
        """Replace the vertices [worlds, V, 3] [m] of a deformable mesh without skin.

        The vertices are in the frame of the mesh. They apply to all worlds whose scene has such a mesh with V vertices,
        of which there must be at least one. NaN hides the triangles at a vertex.
        """
        given = self._floats(vertices, "vertices", 3)
        where = [
            (number, first[mesh])
            for number, first in enumerate(self.packed.source_first)
            if mesh in first and len(self.scenes[number].scene.meshes[mesh].vertices) == given.shape[1]
        ]
        if not where or given.shape[0] != self.worlds or given.shape[2] != 3:
            skinless = sorted({m for first in self.packed.source_first for m in first})
            raise InputError(
                f"Expected vertices [{self.worlds}, V, 3] of a deformable mesh without skin (these are: {skinless}), "
                f"got {list(given.shape)} for mesh {mesh}.",
                code="H3-RENDER-029",
            )
        for number, first in where:
            if len(self.scenes) == 1:
                self._sources[:, first : first + given.shape[1]].copy_(given)
            else:
                worlds = [w for w, scene in enumerate(self.scene_of_world) if scene == number]
                self._sources[worlds, first : first + given.shape[1]] = given[worlds]
        self._run_deform()

    def update_blockers(self, blockers: Sequence[Blockers | None]) -> None:
        """Set the capsules that block light (`Renderer.set_blockers`) from the host, one set for each world."""
        if len(blockers) != self.worlds:
            raise InputError(f"Expected blockers for {self.worlds} worlds, got {len(blockers)}.", code="H3-RENDER-030")
        self._shader.set_blockers(blockers)

    def update_shadows(self, rows: torch.Tensor, tints: torch.Tensor) -> None:
        """Set the capsules that block light from surfaces from tensors on the device, which are not copied.

        Args:
            rows: `Blockers.rows` of all worlds, the same number in each, float32 [worlds, N, 21].
            tints: `Blockers.tints` of all worlds, float32 [worlds, I, 4]; I is the greatest number of instances of a scene.
        """
        import torch

        most = max(len(stage.scene.instances) for stage in self.scenes)
        if rows.shape[0] != self.worlds or rows.shape[2:] != (BLOCKER_WORDS,) or tints.shape != (self.worlds, most, 4):
            raise InputError(
                f"Expected blockers [{self.worlds}, N, {BLOCKER_WORDS}] and tints [{self.worlds}, {most}, 4], got "
                f"{list(rows.shape)} and {list(tints.shape)}.",
                code="H3-RENDER-100",
            )
        counts = torch.full((self.worlds,), rows.shape[1], dtype=torch.int32, device=self.device)
        self._shader.take_blockers(rows.contiguous(), counts, tints.contiguous())

    def _skin(self, joints: torch.Tensor) -> None:
        """Deform all skinned meshes to joints [worlds, bodies, J, 3 or 4, 4]."""
        count = joints.shape[0] * joints.shape[1] * joints.shape[2]
        self._deform.fill(world=self._world, joints=joints, joint_words=joints.shape[3] * 4)
        self._program().launch("palette", -(-count * 3 // 256), 256, self._deform)
        self._run_deform()

    def _run_deform(self) -> None:
        blocks = self.worlds * self.packed.deformed_groups
        shared = self._deform.joint_count * 48
        self._deform.world = self._world
        self._program().launch("deform", blocks, 128, self._deform, shared_bytes=shared)

    def _floats(self, values: Any, name: str, ndim: int | None) -> torch.Tensor:
        import torch

        tensor = torch.as_tensor(values, dtype=torch.float32, device=self.device)
        if ndim is not None and tensor.ndim != ndim:
            raise InputError(f"{name} must have {ndim} axes, got {list(tensor.shape)}.", code="H3-RENDER-031")
        return tensor

    # --- images -------------------------------------------------------------------------------------------------------
    def render(
        self,
        cameras: Camera | Sequence[Camera],
        *,
        worlds: Sequence[int] | None = None,
        outputs: Sequence[Output] = ("depth", "instance", "rgb"),
        samples: Literal[1, 4] = 1,
        poses: Any = None,
    ) -> dict[str, torch.Tensor]:
        """Return images by the name of their output (as in `Renderer.render`), each [views, H, W, ...] on the device.

        Args:
            cameras: Perspective cameras of this renderer's size: one for all views, or one per view.
            worlds: World of each view; by default one view of every world.
            outputs: ``depth``, ``instance``, ``semantic``, ``triangle``, ``rgb``, ``normal``.
            samples: Samples per pixel; 4 smooths the edges of ``rgb`` at about four times the cost of 1.
            poses: Camera poses (OpenCV to world) [views, 4, 4] that replace those of ``cameras``; rotations are not
                checked. NaN gives an empty image.
        """
        import torch

        check_outputs(outputs)
        if samples not in (1, 4):
            raise InputError(f"samples must be 1 or 4, got {samples!r}.", code="H3-RENDER-032")
        views = self._views_of([cameras] if isinstance(cameras, Camera) else list(cameras), worlds, poses)
        results = {
            name: torch.empty(
                (views.count, self.height, self.width, *FORMS[name][0]),
                dtype=getattr(torch, np.dtype(FORMS[name][1]).name),
                device=self.device,
            )
            for name in outputs
        }
        fine = {"rgb": results["rgb"]} if samples == 4 and "rgb" in results else {}
        coarse = {name: t for name, t in results.items() if name not in fine}
        if coarse:
            self._draw(views, coarse, scale=1)
        if fine:
            self._draw(views, fine, scale=2)
        return results

    def _views_of(self, cameras: list[Camera], worlds: Sequence[int] | None, poses: Any) -> Views:
        """Return the views on the device. With ``poses`` and unchanged intrinsics, nothing is uploaded from the host."""
        world_of_view = tuple(range(self.worlds)) if worlds is None else tuple(int(w) for w in worlds)
        intrinsics = tuple(
            (c.width, c.height, c.fx, c.fy, c.cx, c.cy, c.hidden_layers, *depth_range(c)) for c in cameras
        )
        key = (world_of_view, intrinsics)
        views = None if poses is None else self._views.pop(key, None)
        if views is None:
            views = new_views(
                key,
                cameras,
                worlds=self.worlds,
                size=(self.width, self.height),
                layers=self.packed.layers,
                slots=self.packed.slots,
                device=self.device,
            )
        self._views[key] = views
        while len(self._views) > _VIEWS_KEPT:
            del self._views[next(iter(self._views))]
        if poses is not None:
            given = self._floats(poses, "poses", 3)
            if given.shape not in ((views.count, 4, 4), (views.count, 3, 4)):
                raise InputError(f"poses must be [{views.count}, 4, 4], got {list(given.shape)}.", code="H3-RENDER-033")
            views.cameras[:, :12].unflatten(1, (3, 4)).copy_(given[:, :3])
        return views

    def _draw(self, views: Views, results: dict[str, torch.Tensor], *, scale: int) -> None:
        """Render all views into ``results``, in several parts if memory for the intermediate buffers runs out."""
        import torch

        at_once = min(views.count, max(1, _MAX_PIXELS // (self.width * self.height * scale**2)))
        while True:
            try:
                for first in range(0, views.count, at_once):
                    part = slice(first, min(first + at_once, views.count))
                    self._draw_part(views, part, {name: t[part] for name, t in results.items()}, scale)
                return
            except torch.cuda.OutOfMemoryError:
                if at_once == 1:
                    raise
                at_once = -(-at_once // 2)
                _log.warning("Out of GPU memory for %d images at once: rendering %d at a time.", views.count, at_once)

    def _draw_part(self, views: Views, part: slice, results: dict[str, torch.Tensor], scale: int) -> None:
        import torch

        count, program = part.stop - part.start, self._program()
        size = (count, self.height * scale, self.width * scale)
        shaded = {name: t for name, t in results.items() if name != "depth"}
        depth = results.get("depth")
        if depth is None:
            depth = torch.empty(size, dtype=torch.float32, device=self.device)
        words = torch.empty(size, dtype=torch.int32, device=self.device)
        world = self._world
        world.fill(
            cameras=views.cameras,
            hidden=views.hidden,
            world_of_view=views.world_of_view,
            placement=views.placement,
            width=size[2],
            height=size[1],
            first_view=part.start,
            views=count,
            scale=scale,
        )
        program.launch("place", -(-count * self.packed.slots // 128), 128, world)
        raster = Raster()
        raster.fill(world=world, depth=depth, words=words, cutouts=self._cutouts)
        tiles = -(-size[1] // self.variant.tile) * -(-size[2] // self.variant.tile)
        program.launch(
            "raster",
            tiles * count,
            self.variant.warps * 32,
            raster,
            shared_bytes=self.variant.shared_bytes(self._items),
        )
        if shaded:
            self._shader.run(program, world, depth, words, shaded)

    def _program(self) -> Any:
        if self.variant not in self._programs:
            needed = self.variant.shared_bytes(self._items)
            if needed > _SHARED_LIMIT:
                raise InputError(
                    f"A scene has too many groups of triangles for this GPU: {needed} of {_SHARED_LIMIT} bytes of shared "
                    "memory. Hint: remove what no camera sees, or split the scene.",
                    code="H3-RENDER-034",
                )
            tile, warps, blocks = self.variant.tile, self.variant.warps, self.variant.blocks
            holes = int(len(self.packed.opacity) > 0)
            self._programs[self.variant] = self._compile(
                {"TILE": tile, "WARPS": warps, "BLOCKS": blocks, "HOLES": holes}
            )
        return self._programs[self.variant]

    def captured(self, step: Callable[[], dict[str, torch.Tensor]]) -> Callable[[], dict[str, torch.Tensor]]:
        """Return ``step`` captured as a CUDA graph, which reads and writes the same tensors with little work in Python.

        ``step`` may call `update_poses`, `update_joints`, `update_vertices` and `render` (with ``poses``) on tensors that
        are on the device already. Each call overwrites the tensors that it returns. A graph is worthwhile for few
        worlds, where the launches of kernels take most of the time.
        """
        import torch

        step()  # compiles, and fills the caches
        torch.cuda.synchronize(self.device)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.device(self.device), torch.cuda.graph(graph):
            results = step()
        references = results, dict(self._views)  # keeps the tensors alive: the graph itself holds addresses only

        def replay() -> dict[str, torch.Tensor]:
            graph.replay()
            return references[0]

        return replay

    def __repr__(self) -> str:
        return (
            f"GpuRenderer({len(self.scenes)} scenes, {self.worlds} worlds, {self.width}x{self.height}, {self.device})"
        )


def _positive(**values: int) -> list[int]:
    wrong = {name: v for name, v in values.items() if int(v) != v or v < 1}
    if wrong:
        raise InputError(f"Expected positive whole numbers, got {wrong}.", code="H3-RENDER-023")
    return [int(v) for v in values.values()]
