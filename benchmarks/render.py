"""CPU renderer: CPU milliseconds per picture in generated homes of 92 k, 336 k and 1.07 M triangles, one thread.

Eight cameras at eye or robot height in six furnished rooms; every pixel is hit. Times are user + system seconds of the
process (getrusage), the median of seven rounds.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from statistics import median

import numpy as np
from numpy.typing import NDArray

from h3data.mesh.mesh import Mesh, Texture
from h3data.render import (
    Camera,
    Light,
    Renderer,
    RenderInstance,
    RenderScene,
    fisheye,
    look_at,
    orthographic,
    pinhole,
)

Emit = Callable[[str, float, str], None]
Vertices = NDArray[np.float64]

ROOM_M, HEIGHT_M, ROOMS_X, ROOMS_Z = 4.5, 2.7, 3, 2


# --- a generated home -----------------------------------------------------------------------------------------------
def patch(corners: Vertices, n: int) -> tuple[Vertices, NDArray[np.int32]]:
    """Return a quad [4, 3] cut into 2 n^2 triangles."""
    s, t = (g.ravel()[:, None] for g in np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1), indexing="ij"))
    a, b, c, d = corners
    points = a * (1 - s) * (1 - t) + b * s * (1 - t) + c * s * t + d * (1 - s) * t
    i = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate([np.stack([i, i + n + 1, i + n + 2], 1), np.stack([i, i + n + 2, i + 1], 1)])
    return points, faces.astype(np.int32)


def box(center: tuple, size: tuple, n: int) -> tuple[Vertices, NDArray[np.int32]]:
    """Return an axis-aligned box of 12 n^2 triangles with sharp edges."""
    parts = []
    for axis in range(3):
        for side in (-1, 1):
            corners = np.zeros((4, 3))
            corners[:, axis] = side
            corners[:, (axis + 1) % 3] = np.array([-1, 1, 1, -1]) * side
            corners[:, (axis + 2) % 3] = [-1, -1, 1, 1]
            parts.append(patch(np.array(center) + corners * np.array(size) / 2, n))
    return join(parts)


def blob(center: tuple, size: tuple, n: int, roundness: float) -> tuple[Vertices, NDArray[np.int32]]:
    """Return a superellipsoid of 4 n^2 triangles: ``roundness`` 1 is an ellipsoid, near 0 a box."""
    s, t = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, 2 * n + 1), indexing="ij")
    polar, around = s.ravel() * np.pi, t.ravel() * 2 * np.pi

    def power(x: NDArray) -> NDArray:
        return np.sign(x) * np.abs(x) ** roundness

    points = np.stack(
        [
            power(np.sin(polar)) * power(np.cos(around)),
            power(np.cos(polar)),
            power(np.sin(polar)) * power(np.sin(around)),
        ],
        1,
    )
    i = (np.arange(n)[:, None] * (2 * n + 1) + np.arange(2 * n)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + 2 * n + 2], 1), np.stack([i, i + 2 * n + 2, i + 2 * n + 1], 1)])
    return np.array(center) + points * np.array(size) / 2, faces.astype(np.int32)


def join(parts: list[tuple[Vertices, NDArray[np.int32]]]) -> tuple[Vertices, NDArray[np.int32]]:
    starts = np.cumsum([0, *(len(v) for v, _ in parts)])
    return np.concatenate([v for v, _ in parts]), np.concatenate(
        [f + o for (_, f), o in zip(parts, starts, strict=False)]
    ).astype(np.int32)


def colored(part: tuple[Vertices, NDArray[np.int32]], color: tuple[int, int, int]) -> Mesh:
    vertices, faces = part
    return Mesh(
        vertices=vertices.astype(np.float32),
        faces=faces,
        colors=np.tile(np.array(color, np.uint8), (len(vertices), 1)),
    )


def furniture(fineness: float) -> list[Mesh]:
    """Return six large and four small things on the floor, about their own origin."""

    def n(base: float) -> int:
        return max(1, round(base * fineness))

    legs = [box((x, 0.35, z), (0.06, 0.7, 0.06), n(3)) for x in (-0.6, 0.6) for z in (-0.3, 0.3)]
    seats = [blob((x, 0.55, 0.05), (0.62, 0.2, 0.6), n(30), 0.5) for x in (-0.6, 0, 0.6)]
    boards = [box((0, 0.05 + 0.4 * k, 0), (1.0, 0.03, 0.3), n(4)) for k in range(5)]
    books = [box((-0.45 + 0.06 * k, 0.2 + 0.4 * s, 0), (0.045, 0.26, 0.2), n(2)) for s in range(4) for k in range(15)]
    return [
        colored(join([box((0, 0.72, 0), (1.4, 0.05, 0.8), n(8)), *legs]), (150, 110, 75)),
        colored(
            join(
                [
                    blob((0, 0.25, 0), (2, 0.5, 0.9), n(40), 0.35),
                    blob((0, 0.6, -0.35), (2, 0.6, 0.3), n(40), 0.4),
                    *seats,
                ]
            ),
            (95, 120, 150),
        ),
        colored(
            join([blob((0, 0.35, 0), (1.6, 0.5, 2), n(50), 0.3), blob((0, 0.65, -0.75), (1, 0.2, 0.4), n(36), 0.6)]),
            (205, 200, 190),
        ),
        colored(join([*boards, *books]), (165, 90, 70)),
        colored(
            join([box((0, 0.45, 0), (0.8, 0.9, 0.6), n(10)), box((0, 0.92, 0), (0.84, 0.04, 0.64), n(8))]),
            (215, 210, 200),
        ),
        colored(
            join([blob((0, 0.7, 0), (0.08, 1.4, 0.08), n(16), 1), blob((0, 1.45, 0), (0.45, 0.35, 0.45), n(30), 0.8)]),
            (225, 190, 110),
        ),
        colored(blob((0, 0.12, 0), (0.16, 0.24, 0.16), n(26), 0.9), (190, 80, 80)),
        colored(blob((0, 0.05, 0), (0.25, 0.1, 0.25), n(22), 1), (80, 150, 120)),
        colored(box((0, 0.1, 0), (0.2, 0.2, 0.15), n(8)), (120, 90, 160)),
        colored(blob((0, 0.09, 0), (0.18, 0.18, 0.18), n(20), 1), (230, 140, 60)),
    ]


LARGE = 6


def shell() -> list[Mesh]:
    """Return floor, walls with door openings, ceiling."""
    width, depth = ROOMS_X * ROOM_M, ROOMS_Z * ROOM_M
    walls = []
    for along_x in (True, False):
        lines, cells = (ROOMS_Z, ROOMS_X) if along_x else (ROOMS_X, ROOMS_Z)
        for line in range(lines + 1):
            for cell in range(cells):
                spans = [(0.0, 1.0, 0.0, HEIGHT_M)]
                if 0 < line < lines:  # a door in the middle
                    spans = [(0.0, 0.4, 0.0, HEIGHT_M), (0.6, 1.0, 0.0, HEIGHT_M), (0.4, 0.6, 2.1, HEIGHT_M)]
                for start, end, low, high in spans:
                    a, c = (cell + (start + end) / 2) * ROOM_M, line * ROOM_M
                    center = (a, (low + high) / 2, c) if along_x else (c, (low + high) / 2, a)
                    length = (end - start) * ROOM_M
                    size = (length, high - low, 0.1) if along_x else (0.1, high - low, length)
                    walls.append(box(center, size, 8))
    return [
        colored(box((width / 2, -0.05, depth / 2), (width + 0.2, 0.1, depth + 0.2), 40), (185, 150, 110)),
        colored(join(walls), (225, 222, 214)),
        colored(box((width / 2, HEIGHT_M + 0.05, depth / 2), (width + 0.2, 0.1, depth + 0.2), 20), (240, 240, 238)),
    ]


def home(triangles: int, objects: int, seed: int = 0) -> tuple[list[Mesh], list[RenderInstance]]:
    """Return meshes and instances of a home of about so many triangles and exactly so many objects."""
    rng = np.random.default_rng(seed)
    building = shell()
    kinds = np.where(rng.random(objects) < 0.35, rng.integers(0, LARGE, objects), rng.integers(LARGE, 10, objects))
    kinds[: LARGE + 4] = np.arange(10)
    uses = np.bincount(kinds, minlength=10)
    wanted = triangles - sum(len(m.faces) for m in building)
    candidates = np.geomspace(0.1, 6, 120)
    counts = [sum(int(u) * len(m.faces) for u, m in zip(uses, furniture(f), strict=True)) for f in candidates]
    things = furniture(float(candidates[np.argmin(np.abs(np.array(counts) - wanted))]))
    layers = ("", "", "ceiling")
    instances = [RenderInstance(k, np.eye(4), layer=layers[k]) for k in range(3)]
    for number, kind in enumerate(kinds):
        room = np.array([number % ROOMS_X, number // ROOMS_X % ROOMS_Z]) * ROOM_M
        side, along, off = rng.integers(4), rng.uniform(0.5, ROOM_M - 0.5), rng.uniform(0.45, 0.8)
        x, z = [(along, off), (along, ROOM_M - off), (off, along), (ROOM_M - off, along)][side]
        turn = [0, np.pi, np.pi / 2, -np.pi / 2][side] + rng.uniform(-0.1, 0.1)
        y = 0.0 if kind < LARGE else rng.choice([0, 0.45, 0.75, 0.95])
        matrix = np.eye(4)
        c, s = np.cos(turn), np.sin(turn)
        matrix[:3, :3] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) * rng.uniform(0.85, 1.1)
        matrix[:3, 3] = room[0] + x, y, room[1] + z
        instances.append(RenderInstance(3 + int(kind), matrix, semantic_id=int(kind)))
    return [*building, *things], instances


def poses(count: int = 8, seed: int = 3) -> list[NDArray[np.float64]]:
    """Return camera poses in the rooms."""
    rng = np.random.default_rng(seed)
    out = []
    for k in range(count):
        room = (np.array([k % ROOMS_X, k // ROOMS_X % ROOMS_Z]) + 0.5) * ROOM_M + rng.uniform(-0.8, 0.8, 2)
        eye = np.array([room[0], rng.uniform(0.5, 1.6), room[1]])
        yaw, pitch = rng.uniform(0, 2 * np.pi), rng.uniform(-0.3, 0.05)
        out.append(look_at(eye, eye + _direction(yaw, pitch)))
    return out


def _direction(yaw: float, pitch: float) -> NDArray[np.float64]:
    return np.array([np.cos(yaw) * np.cos(pitch), np.sin(pitch), np.sin(yaw) * np.cos(pitch)])


def textured(mesh: Mesh, seed: int) -> Mesh:
    """Return the mesh with a noisy texture of its own of 512 x 512 texels, one repeat a metre, along each triangle's
    two longer axes (no vertex is shared any more).
    """
    corners = mesh.vertices[mesh.faces]
    normal = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    along = np.array([[2, 1], [0, 2], [0, 1]])[normal.argmax(1)]
    uv = np.take_along_axis(corners, along[:, None, :], axis=2).reshape(-1, 2)
    pixels = np.random.default_rng(seed).integers(120, 256, (512, 512, 4)).astype(np.uint8)
    pixels[..., 3] = 255
    return Mesh(
        vertices=corners.reshape(-1, 3),
        faces=np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3),
        colors=mesh.colors[mesh.faces].reshape(-1, 3),
        uv=np.ascontiguousarray(uv),
        textures=(Texture(pixels=pixels),),
    )


# --- measuring ------------------------------------------------------------------------------------------------------
def cpu_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def cpu_ms(work: Callable[[], object], *, per: int = 1, rounds: int = 7) -> float:
    """Return CPU milliseconds of ``work`` divided by ``per``: the median of some rounds, after one that does not count."""
    work()
    times = []
    for _ in range(rounds):
        start = cpu_seconds()
        repeats = 0
        while cpu_seconds() - start < 0.02:  # getrusage may tick in milliseconds
            work()
            repeats += 1
        times.append((cpu_seconds() - start) / repeats)
    return median(times) * 1e3 / per


def frame_ms(renderer: Renderer, cameras: list[Camera], *, outputs: tuple, samples: int = 1, world: int = 0) -> float:
    def work() -> None:
        for camera in cameras:
            renderer.render(camera, outputs=outputs, samples=samples, world=world)  # type: ignore[arg-type]

    return cpu_ms(work, per=len(cameras))


def cameras_at(width: int, height: int, hfov_deg: float, views: list[NDArray[np.float64]]) -> list[Camera]:
    return [pinhole(width, height, hfov_deg=hfov_deg, pose=pose) for pose in views]


SIZES = {
    "64x64": (64, 64, 90),
    "128x128": (128, 128, 90),
    "224x171": (224, 171, 55),
    "256x256": (256, 256, 90),
    "640x480": (640, 480, 47),
    "1280x720": (1280, 720, 60),
}
HOMES = {"92k": (92_000, 60), "336k": (336_000, 600), "1070k": (1_070_000, 600)}
IDS = ("depth", "instance")


def run(emit: Emit) -> None:
    """Emit all `render.cpu.*` lines. `render.cpu.*` is the home of 1.07 M triangles."""
    dense = colored(blob((0, 0, 0), (2, 1, 3), 158, 0.4), (200, 200, 200))
    emit("render.cpu.build_100k_cpu_ms", cpu_ms(lambda: RenderScene([dense], [])), "ms")
    for name, (triangles, objects) in HOMES.items():
        scene = RenderScene(*home(triangles, objects))
        emit(f"render.cpu.{name}_triangles", scene.triangle_count, "1")
        renderer = Renderer(scene)
        if name == "1070k":
            _run_largest(emit, renderer)


def _views(size: str) -> list[Camera]:
    return cameras_at(*SIZES[size], poses())


def _run_largest(emit: Emit, renderer: Renderer) -> None:
    for size in SIZES:
        emit(f"render.cpu.{size}_cpu_ms", frame_ms(renderer, _views(size), outputs=IDS), "ms")
    views = _views("640x480")
    emit("render.cpu.rgb_640x480_cpu_ms", frame_ms(renderer, views, outputs=(*IDS, "rgb")), "ms")
    meshes = [textured(mesh, seed) for seed, mesh in enumerate(renderer.scene.meshes)]
    papered = Renderer(RenderScene(meshes, renderer.scene.instances))
    emit("render.cpu.rgb_textured_640x480_cpu_ms", frame_ms(papered, views, outputs=(*IDS, "rgb")), "ms")
    plain, empty = Renderer(renderer.scene, light=Light(occlusion=0)), Renderer(RenderScene([], []))
    emit("render.cpu.rgb_plain_640x480_cpu_ms", frame_ms(plain, views, outputs=(*IDS, "rgb")), "ms")
    emit("render.cpu.sky_640x480_cpu_ms", frame_ms(empty, views, outputs=("rgb",)), "ms")
    emit("render.cpu.rgb_4_samples_640x480_cpu_ms", frame_ms(renderer, views, outputs=("rgb",), samples=4), "ms")
    flat = [
        orthographic(640, 480, width_m=ROOMS_X * ROOM_M, pose=look_at([x, HEIGHT_M - 0.1, z], [x, 0, z]))
        for x in (5.0, 6.75, 8.0)
        for z in (4.0, 4.5)
    ]
    emit("render.cpu.orthographic_640x480_cpu_ms", frame_ms(renderer, flat, outputs=IDS), "ms")
    cut = [replace(camera, near=0.5, far=8.0) for camera in views]
    emit("render.cpu.clipped_640x480_cpu_ms", frame_ms(renderer, cut, outputs=IDS), "ms")
    leafy = Renderer(RenderScene([*renderer.scene.meshes, plant(200)], [*renderer.scene.instances, *plants(40)]))
    emit("render.cpu.cutouts_640x480_cpu_ms", frame_ms(leafy, views, outputs=IDS), "ms")
    whole = Renderer(RenderScene([*renderer.scene.meshes, replace(plant(200), textures=())], leafy.scene.instances))
    emit("render.cpu.cutouts_as_whole_640x480_cpu_ms", frame_ms(whole, views, outputs=IDS), "ms")
    _run_rays(emit, renderer.scene)
    emit("render.cpu.update_cpu_ms", _update_ms(), "ms")
    emit("render.cpu.two_threads_speedup", _speedup(renderer.scene), "x")
    larger = Renderer(RenderScene(*home(5_000_000, 600)))
    ratio = frame_ms(larger, views, outputs=IDS) / frame_ms(renderer, views, outputs=IDS)
    emit("render.cpu.5m_over_1m_640x480", ratio, "x")
    del larger
    code = "import time; start = time.perf_counter(); from benchmarks.render import fresh; fresh(start)"
    command, root = [sys.executable, "-c", code], Path(__file__).parents[1]
    told = [subprocess.run(command, cwd=root, capture_output=True, text=True, check=True).stdout for _ in range(2)]
    for name, value in json.loads(told[1]).items():  # the first may compile
        emit(f"render.cpu.{name}", value, name.rsplit("_", 1)[1].replace("mb", "MB"))


def plant(leaves: int) -> Mesh:
    """Return leaves on squares of two triangles, each with a texture that is clear around the leaf."""
    rng = np.random.default_rng(1)
    yaw, tilt = rng.uniform(0, 2 * np.pi, leaves), rng.uniform(0.2, 1.3, leaves)
    out = np.stack([np.sin(tilt) * np.cos(yaw), np.cos(tilt), np.sin(tilt) * np.sin(yaw)], 1)
    side = np.stack([-np.sin(yaw), np.zeros(leaves), np.cos(yaw)], 1) * 0.06
    foot = np.stack([np.zeros(leaves), rng.uniform(0.2, 0.8, leaves), np.zeros(leaves)], 1)
    corners = np.stack([foot - side, foot + side, foot + side + 0.3 * out, foot - side + 0.3 * out], 1)
    y, x = np.mgrid[0:128, 0:128] / 127
    pixels = np.full((128, 128, 4), (60, 130, 50, 0), np.uint8)
    pixels[..., 3] = 255 * (np.abs(x - 0.5) < 0.45 * np.sin(np.pi * y))
    first = 4 * np.arange(leaves, dtype=np.int32)[:, None]
    return Mesh(
        vertices=corners.reshape(-1, 3).astype(np.float32),
        faces=np.concatenate([first + np.array([[0, 1, 2]]), first + np.array([[0, 2, 3]])]).astype(np.int32),
        colors=np.full((4 * leaves, 3), 255, np.uint8),
        uv=np.tile(np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32), (leaves, 1)),
        textures=(Texture(pixels=pixels),),
    )


def plants(count: int) -> list[RenderInstance]:
    """Return instances of mesh 13, the one after those of `home`, on the floor all over it."""
    rng = np.random.default_rng(2)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, [0, 2], 3] = rng.uniform(0.4, 1, (count, 2)) * (ROOMS_X * ROOM_M - 0.5, ROOMS_Z * ROOM_M - 0.5)
    return [RenderInstance(13, pose) for pose in poses]


def _speedup(scene: RenderScene) -> float:
    """Return the wall-clock time of one thread divided by that of two, for 32 pictures of 640x480, best of five."""
    cameras, best = _views("640x480") * 4, []
    for threads in (1, 2):
        renderer, times = Renderer(scene, threads=threads), []
        for _ in range(6):
            start = time.perf_counter()
            renderer.render_batch(cameras, outputs=IDS)
            times.append(time.perf_counter() - start)
        best.append(min(times[1:]))
    return best[0] / best[1]


def fresh(start: float) -> None:
    """Print what a process of its own takes: seconds from ``start`` (before any import) to the first picture of a small
    scene, MB of the large home's arrays, and MB of resident memory of each world with a body of 23.6 k triangles,
    reposed and drawn."""
    box_only = RenderScene([colored(box((0, 0, 0), (1, 1, 1), 4), (200, 200, 200))], [RenderInstance(0, np.eye(4))])
    Renderer(box_only).render(_views("64x64")[0], outputs=(*IDS, "rgb"))
    seconds = time.perf_counter() - start
    meshes, instances = home(1_070_000, 600)
    body = colored(blob((0, 0.9, 0), (0.5, 1.8, 0.3), 77, 0.9), (200, 160, 140))
    scene = RenderScene([*meshes, body], [*instances, RenderInstance(len(meshes), np.eye(4))], deformable=[len(meshes)])
    Renderer(scene).render(_views("640x480")[0], outputs=IDS)
    before, worlds = _resident_mb(), 32
    renderer = Renderer(scene, worlds=worlds)
    for world in range(worlds):
        renderer.set_vertices(len(meshes), body.vertices * np.float32(1 + world / 100), world=world)
    renderer.render_batch(_views("64x64")[:1] * worlds, worlds=range(worlds), outputs=IDS)
    print(
        json.dumps(
            {"startup_s": seconds, "shared_mb": _array_mb(scene), "world_mb": (_resident_mb() - before) / worlds}
        )
    )


def _array_mb(thing: object) -> float:
    """Return the size of all arrays that an object holds, each counted once [MB]."""
    waiting, seen = [thing], {}
    while waiting:
        one = waiting.pop()
        if isinstance(one, np.ndarray):
            whole = one if one.base is None else one.base
            seen[id(whole)] = getattr(whole, "nbytes", one.nbytes)
        elif isinstance(one, list | tuple | dict):
            waiting += one.values() if isinstance(one, dict) else one
        elif hasattr(one, "__dict__"):
            waiting += vars(one).values()
    return sum(seen.values()) / 1e6


def _resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


def _run_rays(emit: Emit, scene: RenderScene) -> None:
    if find_spec("embreex") is None:
        return
    eye = poses(1)[0]
    renderer, shaded = Renderer(scene), Renderer(scene, light=Light(shadow_rays=8))
    emit("render.rays.fisheye_480x480_cpu_ms", frame_ms(renderer, [fisheye(480, 480, pose=eye)], outputs=IDS), "ms")
    emit(
        "render.rays.fisheye_rgb_480x480_cpu_ms",
        frame_ms(renderer, [fisheye(480, 480, pose=eye)], outputs=("rgb",)),
        "ms",
    )
    emit("render.rays.shadows_8_640x480_cpu_ms", frame_ms(shaded, _views("640x480")[:2], outputs=("rgb",)), "ms")


def _update_ms() -> float:
    """Return the time to move 25 rigid parts and one body of about 23.6 k triangles, for a depth picture [ms]."""
    body = colored(blob((0, 0.9, 0), (0.5, 1.8, 0.3), 77, 0.9), (200, 160, 140))
    part = colored(box((0, 0, 0), (0.2, 0.2, 0.2), 4), (90, 90, 90))
    instances = [RenderInstance(0, np.eye(4)), *(RenderInstance(1, np.eye(4)) for _ in range(25))]
    renderer = Renderer(RenderScene([body, part], instances, deformable=[0]))
    moved = np.tile(np.eye(4), (25, 1, 1))
    vertices = body.vertices * np.float32(1.01)

    def work() -> None:
        renderer.set_transforms(np.arange(1, 26), moved)
        renderer.set_vertices(0, vertices)

    return cpu_ms(work)


if __name__ == "__main__":
    run(lambda name, value, unit: print(f"{name} {value:.4g} {unit}", flush=True))
