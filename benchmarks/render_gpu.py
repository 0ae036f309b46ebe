"""GPU renderer: frames per second of a whole step, by picture size and number of worlds, on the machine's first GPU.

A step is: new poses of 25 rigid things, a skinned person (55 joints; the full mesh, 47 k triangles, or the light one, 4 k, in
pictures of 64 x 64 and 128 x 128, where one sees no difference at 1.3 m), a new camera, and the pictures (depth and instance
ids; one line with RGB), all in a generated home of 1.1 M triangles, for every world. Times are wall-clock times of a captured
step, Python and the wait for the GPU included, the median after warm-up; those called uncaptured are CUDA events around a step
that Python launches kernel by kernel.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.render import SIZES, Emit, blob, box, colored, home, poses
from h3data.bodies.people.humanoid_file import load_humanoid
from h3data.render import RenderInstance, RenderScene, pinhole
from h3data_gpu import GpuRenderer, GpuScene, gpu_problem

if TYPE_CHECKING:
    import torch

TRIANGLES, OBJECTS, MOVERS, PHASES = 1_120_000, 600, 25, 8
MANY = ("64x64", "128x128", "224x171", "256x256")
IDS = ("depth", "instance")
PERSON_M = 1.3
"""From a camera to the person it is turned to."""


def stage(*, light: bool = False) -> GpuScene:
    """Return the home, 25 things that move, and a person, by the full or the light mesh."""
    meshes, instances = home(TRIANGLES, OBJECTS)
    body = load_humanoid("female_0")
    skin, worn = (body.lod, body.lod_mesh) if light else (body.full, body.mesh)
    toy, link = len(meshes), len(meshes) + 1
    person = len(meshes) + 2
    meshes = [
        *meshes,
        colored(blob((0, 0, 0), (0.2, 0.2, 0.2), 26, 0.9), (190, 80, 80)),
        colored(box((0, 0, 0), (0.3, 0.1, 0.1), 8), (90, 90, 95)),
        worn,
    ]
    first = len(instances)
    instances += [RenderInstance(toy if k < 5 else link, np.eye(4)) for k in range(MOVERS)]
    instances.append(RenderInstance(person, np.eye(4), semantic_id=77))
    scene = RenderScene(meshes, instances, deformable=[person])
    return GpuScene(scene, moving=range(first, first + MOVERS), skins={person: (skin.influences, body.skin_bind)})


class Steps:
    """Everything that changes from step to step, for ``worlds`` worlds, on the device: eight phases, one after another."""

    def __init__(self, worlds: int, device: torch.device) -> None:
        import torch

        cameras = np.stack(poses(worlds))
        ahead = cameras[:, :3, 2] * (1, 0, 1)
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        base = cameras[:, :3, 3] * (1, 0, 1) + 1.3 * ahead
        phase = np.arange(PHASES)[:, None]
        body = load_humanoid("female_0")
        turn = phase * 0.3 + np.arange(worlds)
        roots = np.zeros((PHASES, worlds, 7))
        roots[..., :3] = base
        roots[..., 4], roots[..., 6] = np.sin(turn / 2), np.cos(turn / 2)
        steps = (phase / PHASES + np.arange(worlds) * 0.11) % 1
        quats, pelvis = body.walk_pose(np.full(steps.size, 1.2), steps.ravel())
        joints = body.joint_matrices(roots.reshape(-1, 7), quats, pelvis)
        joints = body.skin_frames(joints).reshape(PHASES, worlds, 1, -1, 4, 4)
        angle = phase[..., None] * 0.2 + np.arange(MOVERS) * 0.7 + np.arange(worlds)[:, None] * 0.37
        things = np.tile(np.eye(4), (PHASES, worlds, MOVERS, 1, 1))
        things[..., 0, 0] = things[..., 2, 2] = np.cos(angle)
        things[..., 0, 2], things[..., 2, 0] = np.sin(angle), -np.sin(angle)
        spread = np.arange(MOVERS)
        things[..., :3, 3] = base[:, None] + np.stack(
            [
                0.8 * np.cos(angle * 0.3 + spread),
                np.broadcast_to(0.2 + 0.05 * spread, angle.shape),
                0.8 * np.sin(angle * 0.3 + 1.3 * spread),
            ],
            -1,
        )
        views = np.tile(cameras, (PHASES, 1, 1, 1))
        views[:, :, :3, 3] += 0.02 * phase[..., None] * ahead

        def on_device(array: Any) -> torch.Tensor:
            return torch.tensor(array, dtype=torch.float32, device=device)

        self.things, self.joints, self.views = on_device(things), on_device(joints), on_device(views)
        self.phase = torch.zeros(1, dtype=torch.int64, device=device)

    def next(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the poses of the things, joints and cameras of the next phase, chosen on the device."""
        self.phase.add_(1).remainder_(PHASES)
        return tuple(all_.index_select(0, self.phase)[0] for all_ in (self.things, self.joints, self.views))  # type: ignore[return-value]


def step_of(renderer: GpuRenderer, steps: Steps, size: str, outputs: tuple) -> Callable[[], dict[str, torch.Tensor]]:
    width, height, hfov = SIZES[size]
    camera = pinhole(width, height, hfov_deg=hfov)

    def step() -> dict[str, torch.Tensor]:
        things, joints, views = steps.next()
        renderer.update_poses(things)
        renderer.update_joints(joints)
        return renderer.render(camera, outputs=outputs, poses=views)

    return step


def event_ms(work: Callable[[], object], *, rounds: int = 30) -> float:
    """Return median time on the GPU [ms]."""
    import torch

    for _ in range(3):
        work()
    times = []
    for _ in range(rounds):
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        start.record()
        work()
        end.record()
        end.synchronize()
        times.append(start.elapsed_time(end))
    return median(times)


def wall_ms(work: Callable[[], object], *, rounds: int = 300) -> float:
    """Return median wall-clock time with the wait for the GPU [ms]."""
    import torch

    times = []
    for _ in range(3):
        work()
    for _ in range(rounds):
        start = time.perf_counter()
        work()
        torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return median(times) * 1e3


def run(emit: Emit) -> None:
    """Emit all `render.gpu.*` lines; none where there is no GPU."""
    problem = gpu_problem()
    if problem:
        print(f"# render.gpu: {problem}")
        return
    start = time.perf_counter()
    scenes = {light: stage(light=light) for light in (False, True)}
    for light, scene in scenes.items():
        emit(f"render.gpu.scene_triangles{'_light' * light}", scene.scene.triangle_count, "1")
    for worlds, sizes in ((1, MANY), (16, MANY), (1024, MANY), (4096, MANY[:2])):
        for size in sizes:
            width, _, hfov = SIZES[size]
            light = load_humanoid("female_0").light_enough(width / 2 / np.tan(np.radians(hfov / 2)), PERSON_M)
            _run_size(emit, scenes[light], worlds, size)
    emit("render.gpu.benchmark_s", time.perf_counter() - start, "s")


def _run_size(emit: Emit, scene: GpuScene, worlds: int, size: str) -> None:
    width, height, _ = SIZES[size]
    renderer = GpuRenderer(scene, width=width, height=height, worlds=worlds)
    steps = Steps(worlds, renderer.device)
    name = f"render.gpu.{size}.w{worlds}"
    step = step_of(renderer, steps, size, IDS)
    milliseconds = wall_ms(renderer.captured(step), rounds=300 if worlds < 64 else 60)
    emit(f"{name}_fps", worlds * 1e3 / milliseconds, "frame/s")
    if worlds < 64:
        return
    emit(f"{name}_uncaptured_fps", worlds * 1e3 / event_ms(step), "frame/s")
    with_rgb = wall_ms(renderer.captured(step_of(renderer, steps, size, (*IDS, "rgb"))), rounds=30)
    emit(f"{name}_rgb_ratio", with_rgb / milliseconds, "1")


if __name__ == "__main__":
    run(lambda name, value, unit: print(f"{name} {value:.6g} {unit}", flush=True))
