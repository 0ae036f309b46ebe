"""Host side of `shade.cu` and `occlusion.cu`, which compute ids, normals and RGB from rasterised words."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from h3data.render.shade.blockers import Blockers
from h3data.render.shade.blockers_simd import BLOCKER_WORDS
from h3data.render.shade.occlusion import CONTRAST, RADIUS_M, SPREAD, TAP_OFFSETS
from h3data.render.shade.occlusion_simd import TAPS
from h3data.render.shade.shading import BYTE_OF_LINEAR, LINEAR_OF_BYTE, Light, light_table
from h3data_gpu.layout import Occlude, Shade, World
from h3data_gpu.packing import Packed

if TYPE_CHECKING:
    import torch

_THREADS = 256
_SCENE_TABLES = (
    "triangle_instances",
    "triangle_faces",
    "instance_ids",
    "semantic_ids",
    "normals",
    "colors",
    "uv",
    "levels",
    "first_level",
    "texels",
    "normal_groups",
    "group_first",
    "group_faces",
)


class Shader:
    """Launcher of the shading kernels, with the tables for shading that are not part of the scenes."""

    def __init__(self, tensors: dict[str, torch.Tensor], packed: Packed, light: Light, device: torch.device) -> None:
        import torch

        self.device, self.strength = device, light.occlusion
        # [4 rows, taps, xy, 8 lanes] to [4, taps, 8, xy]
        offsets = np.ascontiguousarray(TAP_OFFSETS.swapaxes(2, 3), np.float32)
        self._tables = {
            "linear_of_byte": torch.from_numpy(LINEAR_OF_BYTE).to(device),
            "byte_of_level": torch.from_numpy(BYTE_OF_LINEAR).to(device),
            "offsets": torch.from_numpy(offsets).to(device),
        }
        self._blockers: dict[str, torch.Tensor] = {}
        self._shade = Shade()
        self._shade.fill(
            **{name: tensors[name] for name in _SCENE_TABLES},
            triangle_textures=tensors["triangle_textures"] if packed.textured else None,
            mirrors=tensors["mirrors"] if len(packed.mirrors) else None,
            linear_of_byte=self._tables["linear_of_byte"],
            byte_of_level=self._tables["byte_of_level"],
            light=(ctypes.c_float * 27)(*light_table(light)),
        )

    def set_blockers(self, blockers: Sequence[Blockers | None]) -> None:
        """Set the capsules that block light from surfaces, for every world."""
        import torch

        self._blockers = {}
        if all(b is None for b in blockers):
            self._shade.fill(blockers=None, blocker_counts=None, receivers=None)
            return
        counts = [0 if b is None else len(b.rows) for b in blockers]
        rows = np.zeros((len(blockers), max(counts), BLOCKER_WORDS), np.float32)
        receivers = np.zeros((len(blockers), max(len(b.tints) for b in blockers if b is not None), 4), np.float32)
        receivers[:] = 1, 1, 1, -1
        for world, own in enumerate(blockers):
            if own is not None:
                rows[world, : len(own.rows)], receivers[world, : len(own.tints)] = own.rows, own.tints
        arrays = rows, np.array(counts, np.int32), receivers
        self.take_blockers(*(torch.from_numpy(array).to(self.device) for array in arrays))

    def take_blockers(self, rows: torch.Tensor, counts: torch.Tensor, receivers: torch.Tensor) -> None:
        """Set the capsules [W, N, 21], their number [W] and the tints of instances [W, I, 4] for every world."""
        self._blockers = {"blockers": rows, "blocker_counts": counts, "receivers": receivers}
        self._shade.fill(**self._blockers, blocker_limit=rows.shape[1], receiver_limit=receivers.shape[1])

    def run(
        self, program: Any, world: World, depth: torch.Tensor, words: torch.Tensor, results: dict[str, torch.Tensor]
    ) -> None:
        """Fill ``results`` (any outputs except depth) from a rasterised image."""
        samples = 4 if world.scale == 2 else 1
        shade = self._shade
        shade.fill(world=world, depth=depth, words=words, samples=samples, strength=0.0)
        for name in ("instance", "semantic", "triangle", "normal", "rgb"):
            setattr(shade, name, results[name].data_ptr() if name in results else None)
        if any(name in results for name in ("instance", "semantic", "triangle")):
            program.launch("identify", -(-words.numel() // _THREADS), _THREADS, shade)
        if "rgb" not in results and "normal" not in results:
            return
        buffers: tuple[torch.Tensor, ...] = ()  # referenced until the launch below has been queued
        if "rgb" in results and self.strength > 0:
            buffers = self._occlude(program, world, depth, factor=4 if samples == 4 else 2)
            surfaces, amounts, _ = buffers
            _, shade.coarse_height, shade.coarse_width, _ = surfaces.shape
            shade.fill(surfaces=surfaces, occlusion=amounts, strength=self.strength)
        pixels = depth.numel() // samples
        program.launch("shade", -(-pixels // _THREADS), _THREADS, shade)

    def _occlude(self, program: Any, world: World, depth: torch.Tensor, *, factor: int) -> tuple[torch.Tensor, ...]:
        """Return surfaces [worlds, h, w, 4] and amounts [worlds, h, w] of the coarse image, and scratch."""
        import torch

        count, height, width = depth.shape
        size = (count, -(-height // factor), -(-width // factor))
        surfaces = torch.empty((*size, 4), dtype=torch.float32, device=self.device)
        amounts, scratch = torch.empty((2, *size), dtype=torch.float32, device=self.device)
        occlude = Occlude()
        occlude.fill(
            depth=depth,
            cameras=world.cameras,
            offsets=self._tables["offsets"],
            surfaces=surfaces,
            amounts=amounts,
            width=width,
            height=height,
            factor=factor,
            coarse_height=size[1],
            coarse_width=size[2],
            scale=world.scale,
            first_view=world.first_view,
            views=count,
            radius=RADIUS_M,
            near_radius=SPREAD,
            gain=CONTRAST / TAPS,
        )
        blocks = -(-amounts.numel() // _THREADS)
        program.launch("occlude", blocks, _THREADS, occlude)
        for along_y, source, target in ((0, amounts, scratch), (1, scratch, amounts)):
            occlude.fill(along_y=along_y, source=source, amounts=target)
            program.launch("blur", blocks, _THREADS, occlude)
        return surfaces, amounts, scratch
