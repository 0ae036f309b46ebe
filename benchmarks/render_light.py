"""Baked light: what baking, compiling its kernels and pictures with it cost, in CPU time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.render import cpu_seconds, frame_ms
from h3data.bodies import load_humanoid, load_robot
from h3data.geometry import ground_pose
from h3data.render import Camera, Light, Renderer, RenderInstance, RenderScene
from h3data.render.light.bake import LitScene, lit_scene
from h3data.render.light.sources import sources_of
from h3data.render.shade.blockers import Blockers
from h3data.render.sheets.scene_map import eye_level_camera, render_scene
from h3data.replay.shadow_casters import shadow_casters
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
        _with_agents(emit, preset, flat, lit, cameras)


def _with_agents(emit: Emit, preset: str, flat: RenderScene, lit: LitScene, cameras: list[Camera]) -> None:
    """A person and a robot before each camera: RGB in flat light, in baked light with their shadows, and without them."""
    assert lit.field is not None
    person, robot = load_humanoid("female_0"), load_robot("quad_arm")
    links = [number for number, link in enumerate(robot.links) if link.mesh is not None]
    body, first = len(lit.meshes), len(lit.instances)
    more = [person.lod_mesh, *(robot.links[n].mesh for n in links)]
    numbers = first + 1 + np.arange(len(links))
    own = [RenderInstance(body + k, np.eye(4)) for k in range(len(more))]
    meshes, instances = [*lit.meshes, *more], [*lit.instances, *own]
    casters = shadow_casters(lit.field, meshes, instances, {first: 0} | dict.fromkeys(numbers.tolist(), 1))
    shadowed = Renderer(RenderScene(meshes, instances, deformable=[body], mirrors=lit.mirrors), light=lit.light)
    own = [RenderInstance(len(flat.meshes) + k, np.eye(4)) for k in range(len(more))]
    plain = Renderer(
        RenderScene([*flat.meshes, *more], [*flat.instances, *own], deformable=[len(flat.meshes)]), light=Light()
    )
    times = []
    for camera in cameras:
        ahead, right = camera.pose[[0, 2], 2], camera.pose[[0, 2], 0]
        places = [camera.pose[[0, 2], 3] + 2.8 * ahead + side * right for side in (-0.7, 0.7)]
        poses = [ground_pose(np.array([place]), np.array([1.0])) for place in places]
        joints = person.joint_matrices(poses[0], *person.walk_pose(np.array([1.2]), np.array([0.3])))
        frames, ends = robot.link_matrices(poses[1], robot.rest[None])[0, links], person.capsules_world(joints)
        for renderer, mesh, number in ((shadowed, body, first), (plain, len(flat.meshes), len(flat.instances))):
            renderer.set_vertices(mesh, person.skin(joints)[0])
            renderer.set_transforms(numbers - first + number, frames)
        of_person = np.column_stack([ends[0][0], ends[1][0], ends[2]])

        def blockers(frames: Any = frames, of_person: Any = of_person) -> Blockers:
            return casters.blockers([(numbers, frames)], {first: of_person})

        start, rounds = cpu_seconds(), 50
        for _ in range(rounds):
            blockers()
        posing = (cpu_seconds() - start) * 1e3 / rounds
        shadowed.set_blockers(blockers())
        with_shadows = frame_ms(shadowed, [camera], outputs=("rgb",)) + posing
        shadowed.set_blockers(None)
        times.append(
            (frame_ms(plain, [camera], outputs=("rgb",)), frame_ms(shadowed, [camera], outputs=("rgb",)), with_shadows)
        )
    flat_ms, bare_ms, shadows_ms = np.mean(times, axis=0)
    emit(f"render.light.{preset}_agents_rgb_640x480_cpu_ms", float(shadows_ms), "ms")
    emit(f"render.light.{preset}_agents_rgb_640x480_over_flat", float(shadows_ms / flat_ms), "x")
    emit(f"render.light.{preset}_agents_shadows_cpu_ms", float(shadows_ms - bare_ms), "ms")


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
    from h3data.mesh.primitives import box_mesh
    from h3data.render.light.sources import LightSources

    start = cpu_seconds()
    lit_scene([box_mesh((1, 1, 1))], [RenderInstance(0, np.eye(4))], [0], LightSources())
    print(json.dumps(cpu_seconds() - start))
