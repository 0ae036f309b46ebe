"""Baked light: what baking, compiling its kernels and pictures with it cost, in CPU time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.render import cpu_seconds, frame_ms
from h3data.render import Camera, Renderer, RenderScene
from h3data.render.light.bake import LitScene, lit_scene
from h3data.render.light.sources import sources_of
from h3data.render.sheets.scene_map import eye_level_camera, render_scene
from h3data.scene import FreeSpace, HomeSpec, Scene, build_home

Emit = Callable[[str, float, str], None]
ROOMS = ("living", "kitchen", "bedroom")


def run(emit: Emit) -> None:
    """Emit all `render.light.*` lines: homes of seed 7, RGB at 640x480 at eye height in three rooms each."""
    os.environ["H3DATA_CACHE"] = "off"
    code = "from benchmarks.render_light import compiled; compiled()"
    with TemporaryDirectory() as folder:
        command, there = [sys.executable, "-c", code], {**os.environ, "NUMBA_CACHE_DIR": folder}
        told = subprocess.run(
            command, cwd=Path(__file__).parents[1], env=there, capture_output=True, text=True, check=True
        )
    emit("render.light.compile_cpu_s", json.loads(told.stdout), "s")
    home, _ = _home("small")
    _lit(home, render_scene(home))  # may compile
    for preset in ("small", "medium", "large"):
        home, cameras = _home(preset)
        flat = render_scene(home)
        start = cpu_seconds()
        lit = _lit(home, flat)
        emit(f"render.light.{preset}_bake_cpu_s", cpu_seconds() - start, "s")
        scene = RenderScene(lit.meshes, lit.instances, mirrors=lit.mirrors)
        emit(f"render.light.{preset}_triangles_ratio", scene.triangle_count / flat.triangle_count, "x")
        before = frame_ms(Renderer(flat), cameras, outputs=("rgb",))
        after = frame_ms(Renderer(scene, light=lit.light), cameras, outputs=("rgb",))
        emit(f"render.light.{preset}_rgb_640x480_cpu_ms", after, "ms")
        emit(f"render.light.{preset}_rgb_640x480_over_flat", after / before, "x")


def _home(preset: str) -> tuple[Scene, list[Camera]]:
    """A home and a camera in each of `ROOMS`."""
    home = build_home(HomeSpec(preset=preset, seed=7))  # type: ignore[arg-type]
    free = FreeSpace.from_scene(home)
    rooms = [next(room.name for room in home.rooms if room.category == category) for category in ROOMS]
    return home, [eye_level_camera(home, free, room=room, width=640, height=480) for room in rooms]


def _lit(home: Scene, flat: RenderScene) -> LitScene:
    still = {instance.name for instance in home.static_instances}
    static = [k for k, instance in enumerate(flat.instances) if instance.name in still]
    return lit_scene(flat.meshes, flat.instances, static, sources_of(home), name=home.name)


def compiled() -> None:
    """Prints the CPU seconds that compiling all kernels of the light takes."""
    import numpy as np

    from h3data.mesh.primitives import box_mesh
    from h3data.render import RenderInstance
    from h3data.render.light.sources import LightSources

    start = cpu_seconds()
    lit_scene([box_mesh((1, 1, 1))], [RenderInstance(0, np.eye(4))], [0], LightSources())
    print(json.dumps(cpu_seconds() - start))
