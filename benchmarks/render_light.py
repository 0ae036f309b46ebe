"""Baked light: what baking, compiling its kernels and pictures with it cost, in CPU time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.render import cpu_seconds, frame_ms
from h3data.bodies import load_humanoid, load_robot
from h3data.geometry import ground_pose
from h3data.render import Camera, Light, Renderer, RenderInstance, RenderScene
from h3data.render.light.sources import sources_of
from h3data.render.sheets.scene_map import render_scene
from h3data.replay.shadow_casters import shadow_casters
from h3data.scene import FreeSpace, Scene
from h3data_gpu import gpu_problem
from h3data_homes import HomeSpec, build_home
from h3data_light.bake import LitScene, lit_scene
from h3data_pipelines.assets.eye_level import eye_level_camera

Emit = Callable[[str, float, str], None]
ROOMS = ("living", "kitchen", "bedroom")


def run(emit: Emit) -> None:
    """Emit all `render.light.*` lines: homes of seed 7, RGB at 640x480 at eye height in three rooms each."""
    os.environ["H3DATA_CACHE"] = "off"
    code = "from benchmarks.render_light import compiled; compiled()"
    with TemporaryDirectory() as folder:
        command, there = (
            [sys.executable, "-c", code],
            {**os.environ, "NUMBA_CACHE_DIR": folder, "NUMBA_CPU_NAME": "host"},
        )
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
        _with_agents(emit, preset, flat, lit, cameras)


def _with_agents(emit: Emit, preset: str, flat: RenderScene, lit: LitScene, cameras: list[Camera]) -> None:
    """Emit the time of RGB with a person and a robot before each camera, each in a separate world.

    The light is flat, baked with shadows, and baked without shadows; on a GPU, 48 pictures are rendered at once.
    """
    assert lit.field is not None
    agents = _Agents(cameras)
    shadowed, first = agents.beside(lit.meshes, lit.instances, mirrors=lit.mirrors)
    plain, first_plain = agents.beside(flat.meshes, flat.instances)
    numbers = first + 1 + np.arange(len(agents.links))
    casters = shadow_casters(
        lit.field, shadowed.meshes, shadowed.instances, {first: 0} | dict.fromkeys(numbers.tolist(), 1)
    )
    dark = [casters.blockers([(numbers, frames)], {first: capsules}) for frames, capsules in agents.placed]
    start, rounds = cpu_seconds(), 50
    for frames, capsules in agents.placed * rounds:
        casters.blockers([(numbers, frames)], {first: capsules})
    posing = (cpu_seconds() - start) * 1e3 / rounds / len(cameras)
    for backend in ("cpu", *([] if gpu_problem() else ["gpu"])):
        lit_renderer = agents.renderer(shadowed, first, lit.light, backend)
        times = [
            _batch_ms(agents.renderer(plain, first_plain, Light(), backend), cameras),
            _batch_ms(lit_renderer, cameras),
        ]
        for world, blockers in enumerate(dark):
            lit_renderer.set_blockers(blockers, world=world)
        flat_ms, bare_ms, shadows_ms = *times, _batch_ms(lit_renderer, cameras) + (posing if backend == "cpu" else 0)
        name = f"render.light.{preset}_agents" if backend == "cpu" else f"render.light.gpu.{preset}_agents"
        emit(f"{name}_rgb_640x480_{'cpu_' if backend == 'cpu' else ''}ms", shadows_ms, "ms")
        emit(f"{name}_rgb_640x480_over_flat", shadows_ms / flat_ms, "x")
        emit(f"{name}_shadows_{'cpu_' if backend == 'cpu' else ''}ms", shadows_ms - bare_ms, "ms")


class _Agents:
    """A person and a robot side by side, 2.8 m before each of some cameras."""

    def __init__(self, cameras: list[Camera]) -> None:
        self.person, self.robot = load_humanoid("female_0"), load_robot("quad_arm")
        self.links = [number for number, link in enumerate(self.robot.links) if link.mesh is not None]
        self.skins: list[Any] = []
        self.placed: list[tuple[Any, Any]] = []
        """Poses of the robot's links [L, 4, 4] and capsules of the person [C, 7], for each camera."""
        for camera in cameras:
            ahead, right = camera.pose[[0, 2], 2], camera.pose[[0, 2], 0]
            places = [camera.pose[[0, 2], 3] + 2.8 * ahead + side * right for side in (-0.7, 0.7)]
            poses = [ground_pose(np.array([place]), np.array([1.0])) for place in places]
            joints = self.person.joint_matrices(poses[0], *self.person.walk_pose(np.array([1.2]), np.array([0.3])))
            frames, ends = self.robot.link_matrices(poses[1], self.robot.rest[None]), self.person.capsules_world(joints)
            self.skins.append(self.person.skin(joints)[0])
            self.placed.append((frames[0, self.links], np.column_stack([ends[0][0], ends[1][0], ends[2]])))

    def beside(self, meshes: Any, instances: Any, **options: Any) -> tuple[RenderScene, int]:
        """Return a scene with both agents in it, and the number of the person's instance, before those of the robot."""
        more = [self.person.lod_mesh, *(self.robot.links[n].mesh for n in self.links)]
        own = [RenderInstance(len(meshes) + k, np.eye(4)) for k in range(len(more))]
        return RenderScene([*meshes, *more], [*instances, *own], deformable=[len(meshes)], **options), len(instances)

    def renderer(self, scene: RenderScene, first: int, light: Light, backend: Any) -> Renderer:
        renderer = Renderer(scene, light=light, backend=backend, worlds=len(self.placed))
        for world, (frames, _) in enumerate(self.placed):
            renderer.set_vertices(scene.deformable[0], self.skins[world], world=world)
            renderer.set_transforms(first + 1 + np.arange(len(self.links)), frames, world=world)
        return renderer


def _batch_ms(renderer: Renderer, cameras: list[Camera]) -> float:
    """Return milliseconds per picture: CPU time of one at a time, or on a GPU wall-clock time of 48 at once."""
    worlds = list(range(len(cameras)))
    if renderer.backend == "cpu":
        return float(
            np.mean([frame_ms(renderer, [camera], outputs=("rgb",), world=k) for k, camera in enumerate(cameras)])
        )
    import torch

    many, of = cameras * (48 // len(cameras)), worlds * (48 // len(cameras))
    times = []
    for _ in range(40):
        start = time.perf_counter()
        renderer.render_batch(many, worlds=of, outputs=("rgb",))
        torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return float(np.median(times[10:])) * 1e3 / len(many)


def _home(preset: str) -> tuple[Scene, list[Camera]]:
    """Return a home and a camera in each of `ROOMS`."""
    home = build_home(HomeSpec(preset=preset, seed=7))  # type: ignore[arg-type]
    free = FreeSpace.from_scene(home)
    rooms = [next(room.name for room in home.rooms if room.category == category) for category in ROOMS]
    return home, [eye_level_camera(home, free, room=room, width=640, height=480) for room in rooms]


def _lit(home: Scene, flat: RenderScene) -> LitScene:
    still = {instance.name for instance in home.static_instances}
    static = [k for k, instance in enumerate(flat.instances) if instance.name in still]
    return lit_scene(flat.meshes, flat.instances, static, sources_of(home), name=home.name)


def compiled() -> None:
    """Print the CPU seconds that compiling all kernels of the light takes."""
    from h3data.mesh.primitives import box_mesh
    from h3data.render.light.sources import LightSources

    start = cpu_seconds()
    lit_scene([box_mesh((1, 1, 1))], [RenderInstance(0, np.eye(4))], [0], LightSources())
    print(json.dumps(cpu_seconds() - start))
