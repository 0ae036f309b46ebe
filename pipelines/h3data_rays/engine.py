"""CPU rasteriser that casts rays for other projections, shadows of the sun, and the back end ``rays``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.render.camera import Camera
from h3data.render.raster.cpu import CpuEngine, World
from h3data.render.raster.drawings import Drawings
from h3data.render.scene import RenderScene
from h3data.render.shade.shading import Light
from h3data.srgb import bytes_to_linear, linear_to_bytes
from h3data_rays.cameras import cast_picture, picture_from_cube
from h3data_rays.rays import Part, RayCaster

_KEPT_CASTERS = 8


class HybridEngine(CpuEngine):
    """CPU engine that supports every camera and casts shadows; with ``only_rays``, only colours are rasterised."""

    def __init__(
        self, scene: RenderScene, *, light: Light, worlds: int = 1, threads: int = 1, only_rays: bool = False
    ) -> None:
        super().__init__(scene, light=light, worlds=worlds, threads=threads)
        self.only_rays = only_rays
        self._still: dict[bytes, Part] = {}
        self._casters: dict[tuple[int, tuple[str, ...]], tuple[int, RayCaster]] = {}
        if only_rays:
            self._caster(self.worlds[0], ())  # fails early if Embree is missing

    def render(
        self,
        cameras: Sequence[Camera],
        worlds: Sequence[int],
        outputs: Sequence[str],
        samples: int,
        out: Mapping[str, NDArray] | None,
    ) -> dict[str, NDArray]:
        """Render each camera by the rasteriser, by rays, or by both, depending on its projection and outputs."""
        geometry = any(name != "rgb" for name in outputs)
        for camera, world in zip(cameras, worlds, strict=True):  # casters are built before the threads start
            if self._shadows(outputs) or (geometry and self._casts(camera)):
                self._caster(self.worlds[world], camera.hidden_layers)
        return super().render(cameras, worlds, outputs, samples, out)

    def _casts(self, camera: Camera) -> bool:
        return self.only_rays or not camera.is_planar

    def _shadows(self, outputs: Sequence[str] | Mapping[str, NDArray]) -> bool:
        return "rgb" in outputs and self.light.shadow_rays > 0

    def _caster(self, world: World, hidden_layers: tuple[str, ...]) -> RayCaster:
        """Return the ray caster of a world.

        Static and moving instances are separate parts, which are rebuilt only when they have changed.
        """
        key = (self.worlds.index(world), hidden_layers)
        version, caster = self._casters.pop(key, (-1, None))
        if caster is None or version != world.version:
            shown = world.shown(hidden_layers)
            still, poses = shown & ~world.moved, world.poses()
            if still.tobytes() not in self._still:
                self._still[still.tobytes()] = Part(self.scene, poses, np.flatnonzero(still))
            moving = Part(self.scene, poses, np.flatnonzero(shown & world.moved))
            caster = RayCaster(self.scene, poses, parts=[self._still[still.tobytes()], moving])
        self._casters[key] = (world.version, caster)
        _drop_oldest(self._casters, _KEPT_CASTERS + len(self.worlds))
        _drop_oldest(self._still, _KEPT_CASTERS)
        return caster

    def _rasterise(
        self, camera: Camera, world: World, drawings: Drawings, results: Mapping[str, NDArray], samples: int
    ) -> None:
        colors = {name: array for name, array in results.items() if name == "rgb"}
        if self._casts(camera):
            if len(results) > len(colors):
                cast_picture(self._caster(world, camera.hidden_layers), camera, results)
            results = colors
        if not camera.is_planar:
            if colors:

                def render_face(side: Camera) -> NDArray[np.uint8]:
                    face = np.zeros((side.height, side.width, 3), np.uint8)
                    self._rasterise_planar(side, world, drawings, {"rgb": face}, samples)
                    return face

                picture_from_cube(camera, render_face, colors["rgb"])
        elif results:
            self._rasterise_planar(camera, world, drawings, results, samples)

    def _rasterise_planar(
        self, camera: Camera, world: World, drawings: Drawings, results: Mapping[str, NDArray], samples: int
    ) -> None:
        if not self._shadows(results):
            super()._rasterise(camera, world, drawings, results, samples)
            return
        size = (camera.height, camera.width)
        more = {"depth": np.zeros(size, np.float32), "normal": np.zeros((*size, 3), np.float32), **results}
        super()._rasterise(camera, world, drawings, more, samples)
        # Shaded once with and once without the sun; each pixel is blended by the share of the sun that it sees.
        fine = 2 if samples == 4 else 1
        view, drawing, _ = self._draw(camera, world, drawings, fine=fine)
        shaded, dark = results["rgb"], np.zeros((*size, 3), np.uint8)
        patches = self.scene.patches if samples == 4 else None
        drawing.picture = None  # not that of this image
        self._shade(
            world, view, drawing.target, rgb=dark, patches=patches, light=replace(self.light, sun=(0.0, 0.0, 0.0))
        )
        start, directions = camera.rays()
        points = (start + directions * more["depth"][..., None]) @ camera.pose[:3, :3].T + camera.pose[:3, 3]
        caster = self._caster(world, camera.hidden_layers)
        sunlit = caster.sunlight(points, more["normal"].astype(np.float64), self.light)[..., None]
        sunlit = np.where(more["depth"][..., None] > 0, sunlit, 1)
        mixed = bytes_to_linear(shaded) * sunlit + bytes_to_linear(dark) * (1 - sunlit)
        shaded[:] = linear_to_bytes(mixed)


def _drop_oldest(cache: dict[Any, Any], size: int) -> None:
    while len(cache) > size:
        del cache[next(iter(cache))]
