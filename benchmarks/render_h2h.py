"""Depth and ids beside the real habitat-sim (software OpenGL), same scenes, same cameras: CPU milliseconds per picture.

The furnished homes are those on which habitat-sim was measured: six rooms, 16 kinds of things, every triangle count and
camera as there (0.092, 0.336 and 1.07 M triangles, static part, eight cameras, every pixel hit). Here alone z points up.
`ratio` is habitat-sim's figure divided by ours, so 3 means a third of its time; its figures come from a 2-core EPYC (Zen 3)
and only bear on such a machine. The cameras in simple_room are ours: its ratio is rough, and at 640x480 there is none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.render import SIZES, cameras_at, frame_ms
from h3data.mesh.loading import load_mesh
from h3data.mesh.mesh import Mesh
from h3data.render import Camera, Renderer, RenderInstance, RenderScene, look_at

Emit = Callable[[str, float, str], None]
Part = tuple[NDArray[np.float64], NDArray[np.int32]]
"""Vertices [V, 3] and faces [F, 3]."""
Surface = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
"""Points [n, 3] at parameters u and v [n] in 0..1."""

HABITAT_MS = {
    "92k": {"224x171": 3.49, "256x256": 3.78, "640x480": 6.95},
    "336k": {"224x171": 10.6, "256x256": 13.2, "640x480": 19.1},
    "1070k": {"224x171": 22.8, "256x256": 31.3, "640x480": 34.1},
    "simple_room": {"224x171": 0.58, "256x256": 0.81},
}
"""habitat-sim 0.3.3, Mesa llvmpipe, one thread (research/head-to-head.md)."""
HOMES = {"92k": (10_000, 60, 91_880), "336k": (270_000, 600, 335_964), "1070k": (1_000_000, 600, 1_067_216)}
"""Wanted triangles of the things, number of things, and the triangles that come out with the building."""
SIMPLE_ROOM = Path(__file__).resolve().parents[2] / "shared/real/habitat-sim/data/test_assets/scenes/simple_room.glb"
ROOM, HEIGHT, ROOMS_X, ROOMS_Y = 4.5, 2.7, 3, 2
LARGE = ("table", "chair", "sofa", "bed", "shelf", "plant", "lamp", "fridge", "cabinet", "rug", "curtain", "picture")
SMALL = ("vase", "bowl", "mug", "toy")


# --- shapes -----------------------------------------------------------------------------------------------------------
def patch(surface: Surface, nu: int, nv: int) -> Part:
    """Return a surface cut into 2 nu nv triangles."""
    u, v = np.meshgrid(np.linspace(0, 1, nu + 1), np.linspace(0, 1, nv + 1), indexing="ij")
    corner = (np.arange(nu)[:, None] * (nv + 1) + np.arange(nv)).ravel()
    across, along = corner + 1, corner + nv + 1
    faces = np.concatenate([np.stack([corner, along, across], 1), np.stack([across, along, along + 1], 1)])
    return surface(u.ravel(), v.ravel()), faces.astype(np.int32)


def join(parts: Sequence[Part]) -> Part:
    starts = np.cumsum([0, *(len(v) for v, _ in parts)])
    faces = [f + start for (_, f), start in zip(parts, starts, strict=False)]
    return np.concatenate([v for v, _ in parts]), np.concatenate(faces).astype(np.int32)


def box(center: Sequence[float], size: Sequence[float], n: int) -> Part:
    """Return 12 n^2 triangles."""

    def side(axis: int, sign: int) -> Surface:
        def points(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
            p = np.empty((len(u), 3))
            p[:, axis] = sign
            p[:, (axis + 1) % 3] = (2 * u - 1) * sign
            p[:, (axis + 2) % 3] = 2 * v - 1
            return np.array(center) + p * np.array(size) / 2

        return points

    return join([patch(side(axis, sign), n, n) for axis in range(3) for sign in (-1, 1)])


def blob(
    center: Sequence[float], size: Sequence[float], n: int, roundness: float = 1.0, bumps: float = 0.0, seed: int = 0
) -> Part:
    """Return a superellipsoid of 4 n^2 triangles, of ``roundness`` 1 an ellipsoid, with bumps."""
    rng = np.random.default_rng(seed)
    waves, phase = rng.normal(size=(6, 3)) * 4, rng.uniform(0, 6, 6)

    def power(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.sign(x) * np.abs(x) ** roundness

    def points(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        polar, around = u * np.pi, v * 2 * np.pi
        across = np.sin(polar)
        p = np.stack([power(across * np.cos(around)), power(across * np.sin(around)), power(np.cos(polar))], 1)
        p = p * (1 + bumps * np.sin(p @ waves.T + phase).sum(1, keepdims=True) / 6)
        return np.array(center) + p * np.array(size) / 2

    return patch(points, n, 2 * n)


def turned(radius: Callable[[NDArray[np.float64]], NDArray[np.float64]], height: float, n: int, m: int) -> Part:
    """Return a surface of revolution about z."""

    def points(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        r, around = radius(u), v * 2 * np.pi
        return np.stack([r * np.cos(around), r * np.sin(around), u * height], 1)

    return patch(points, n, m)


def rod(start: Sequence[float], end: Sequence[float], radius: float, n: int, m: int) -> Part:
    """Return a tube that narrows at its ends."""
    a, along = np.array(start), np.array(end) - np.array(start)
    length = np.linalg.norm(along)
    side = np.cross(along / length, [0.3, 0.5, 0.8])
    side /= np.linalg.norm(side)
    other = np.cross(along / length, side)

    def points(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        r = radius * np.sin(np.clip(u, 0.02, 0.98) * np.pi) ** 0.25
        around = np.cos(v * 2 * np.pi)[:, None] * side + np.sin(v * 2 * np.pi)[:, None] * other
        return a + np.outer(u, along) + r[:, None] * around

    return patch(points, n, m)


# --- things -----------------------------------------------------------------------------------------------------------
def things(fineness: float) -> dict[str, Part]:
    """Return the 16 kinds, standing on z = 0 about their own origin."""

    def n(base: int) -> int:
        return max(2, round(base * fineness))

    rng = np.random.default_rng(5)
    shelf = _shelf(rng, n)
    plant = _plant(rng, n)  # after the shelf: they share the generator
    return {
        "table": join(
            [
                box((0, 0, 0.72), (1.4, 0.8, 0.05), n(8)),
                *(box((x, y, 0.35), (0.06, 0.06, 0.7), n(4)) for x, y in product((-0.6, 0.6), (-0.3, 0.3))),
            ]
        ),
        "chair": join(
            [
                box((0, 0, 0.45), (0.45, 0.45, 0.05), n(8)),
                box((0, -0.2, 0.75), (0.45, 0.04, 0.55), n(8)),
                *(rod((x, y, 0), (x, y, 0.45), 0.025, n(6), n(10)) for x, y in product((-0.18, 0.18), repeat=2)),
            ]
        ),
        "sofa": join(
            [
                blob((0, 0, 0.25), (2, 0.9, 0.5), n(40), 0.35, 0.03, 1),
                blob((0, -0.35, 0.6), (2, 0.3, 0.6), n(40), 0.4, 0.03, 2),
                *(
                    blob((x, 0.05, 0.55), (0.6, 0.6, 0.2), n(36), 0.5, 0.08, 3 + k)
                    for k, x in enumerate((-0.6, 0, 0.6))
                ),
            ]
        ),
        "bed": join(
            [
                blob((0, 0, 0.35), (1.6, 2, 0.5), n(50), 0.3, 0.02, 7),
                blob((-0.4, 0.75, 0.65), (0.6, 0.4, 0.2), n(40), 0.6, 0.1, 8),
                blob((0.4, 0.75, 0.65), (0.6, 0.4, 0.2), n(40), 0.6, 0.1, 9),
                box((0, 1, 0.5), (1.7, 0.06, 1), n(10)),
            ]
        ),
        "shelf": shelf,
        "plant": plant,
        "lamp": join(
            [
                turned(lambda u: 0.02 + 0.12 * (u < 0.03), 1.4, n(30), n(16)),
                turned(lambda u: 0.25 - 0.1 * u, 0.3, n(10), n(40)),
            ]
        ),
        "fridge": join(
            [box((0, 0, 0.9), (0.7, 0.7, 1.8), n(14)), rod((0.3, 0.37, 0.6), (0.3, 0.37, 1.5), 0.015, n(8), n(8))]
        ),
        "cabinet": join(
            [
                box((0, 0, 0.45), (0.8, 0.6, 0.9), n(10)),
                box((0, 0.31, 0.45), (0.7, 0.02, 0.8), n(8)),
                box((0, 0, 0.92), (0.84, 0.64, 0.04), n(8)),
            ]
        ),
        "rug": patch(
            lambda u, v: np.stack([(u - 0.5) * 2, (v - 0.5) * 1.4, 0.01 + 0.004 * np.sin(40 * u) * np.sin(37 * v)], 1),
            n(60),
            n(60),
        ),
        "curtain": patch(lambda u, v: np.stack([(u - 0.5) * 1.2, 0.05 * np.sin(u * 50), v * 2.2], 1), n(80), n(20)),
        "picture": box((0, 0, 0), (0.6, 0.03, 0.45), n(6)),
        "vase": turned(lambda u: 0.06 + 0.05 * np.sin(u * 5), 0.3, n(30), n(40)),
        "bowl": turned(lambda u: 0.02 + 0.1 * u**0.5, 0.08, n(16), n(40)),
        "mug": join(
            [turned(lambda u: 0.04 + 0 * u, 0.1, n(10), n(30)), blob((0.05, 0, 0.05), (0.03, 0.01, 0.06), n(12))]
        ),
        "toy": join(
            [
                blob((0, 0, 0.1), (0.2, 0.15, 0.2), n(24), 1, 0.1, 21),
                blob((0, 0.05, 0.25), (0.14, 0.14, 0.14), n(20), 1, 0.1, 22),
            ]
        ),
    }


def _shelf(rng: np.random.Generator, n: Callable[[int], int]) -> Part:
    parts = []
    for level in range(5):
        parts.append(box((0, 0, 0.05 + 0.4 * level), (1, 0.3, 0.03), n(4)))
        x = -0.48
        while x < 0.46:
            wide, tall = rng.uniform(0.02, 0.05), rng.uniform(0.2, 0.32)
            center = (x + wide / 2, rng.uniform(-0.02, 0.02), 0.07 + 0.4 * level + tall / 2)
            parts.append(box(center, (wide * 0.95, 0.22, tall), n(2)))
            x += wide
    sides = [box((x, 0, 1), (0.03, 0.3, 2), n(4)) for x in (-0.5, 0.5)]
    return join([*parts, *sides, box((0, -0.15, 1), (1, 0.01, 2), n(4))])


def _plant(rng: np.random.Generator, n: Callable[[int], int]) -> Part:
    def leaf(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([(u - 0.5) * 0.2, (v - 0.5) * 0.08 * np.sin(u * 3.1), 0.03 * np.cos(u * 3)], 1)

    parts = [turned(lambda u: 0.12 + 0.05 * u, 0.25, n(6), n(20))]
    for _ in range(140):
        around, r, z = rng.uniform(0, 6.28), rng.uniform(0.02, 0.35), rng.uniform(0.3, 1.3)
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        vertices, faces = patch(leaf, n(5), n(3))
        parts.append((vertices @ turn.T + [r * np.cos(around), r * np.sin(around), z], faces))
    return join(parts)


def building() -> Part:
    """Return floor, ceiling, walls with doors in the middle of the inner ones."""
    wide, deep = ROOMS_X * ROOM, ROOMS_Y * ROOM
    parts = [
        box((wide / 2, deep / 2, -0.05), (wide + 0.2, deep + 0.2, 0.1), 40),
        box((wide / 2, deep / 2, HEIGHT + 0.05), (wide + 0.2, deep + 0.2, 0.1), 20),
    ]
    for axis, lines, cells in ((0, ROOMS_X, ROOMS_Y), (1, ROOMS_Y, ROOMS_X)):
        for line, cell in product(range(lines + 1), range(cells)):
            pieces = [(0.5, 1.0, HEIGHT / 2, HEIGHT, 16)]  # middle and length in rooms, middle and height, fineness
            if 0 < line < lines:
                pieces = [
                    (0.2, 0.4, HEIGHT / 2, HEIGHT, 10),
                    (0.8, 0.4, HEIGHT / 2, HEIGHT, 10),
                    (0.5, 0.2, 2.35, 0.7, 4),
                ]
            for middle, length, z, tall, n in pieces:
                center, size = [line * ROOM, (cell + middle) * ROOM, z], [0.1, length * ROOM, tall]
                if axis == 1:
                    center[:2], size[:2] = center[1::-1], size[1::-1]
                parts.append(box(center, size, n))
    return join(parts)


def placed(count: int, seed: int = 0) -> list[tuple[str, NDArray[np.float64]]]:
    """Return kind and 4x4 pose of every thing, room by room, along the walls."""
    rng = np.random.default_rng(seed)
    found = []
    per = count // (ROOMS_X * ROOMS_Y)
    for x0, y0, k in product(range(ROOMS_X), range(ROOMS_Y), range(per)):
        large = k < per * 0.35
        kind = LARGE[rng.integers(len(LARGE))] if large else SMALL[rng.integers(len(SMALL))]
        side = rng.integers(4)
        along = rng.uniform(0.5, ROOM - 0.5) if large else rng.uniform(0.4, ROOM - 0.4)
        off = rng.uniform(0.25, 0.6) if large else rng.uniform(0.2, 0.9)
        x, y = [(along, off), (along, ROOM - off), (off, along), (ROOM - off, along)][side]
        if large:
            z = 1.5 if kind == "picture" else 0.0
            if kind == "rug":
                x, y = ROOM / 2 + rng.uniform(-0.5, 0.5), ROOM / 2 + rng.uniform(-0.5, 0.5)
            angle = [0, np.pi, -np.pi / 2, np.pi / 2][side] + rng.uniform(-0.1, 0.1)
            scale = rng.uniform(0.85, 1.1)
        else:
            angle, z, scale = rng.uniform(0, 6.3), float(rng.choice([0, 0.45, 0.75, 0.95])), rng.uniform(0.8, 1.2)
        c, s = np.cos(angle), np.sin(angle)
        pose = np.eye(4)
        pose[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) * scale
        pose[:3, 3] = x0 * ROOM + x, y0 * ROOM + y, z
        found.append((kind, pose))
    return found


def home(triangles: int, count: int) -> RenderScene:
    """Return the building with ``count`` things, as fine as gives about so many ``triangles``."""
    poses = placed(count)
    uses = {kind: sum(k == kind for k, _ in poses) for kind in (*LARGE, *SMALL)}
    low, high, parts = 0.1, 20.0, {}
    for _ in range(14):
        fineness = float(np.sqrt(low * high))
        parts = things(fineness)
        enough = sum(len(parts[kind][1]) * used for kind, used in uses.items()) >= triangles
        low, high = (low, fineness) if enough else (fineness, high)
    meshes = [_mesh(building()), *(_mesh(parts[kind]) for kind in (*LARGE, *SMALL))]
    slots = {kind: k + 1 for k, kind in enumerate((*LARGE, *SMALL))}
    return RenderScene(
        meshes, [RenderInstance(0, np.eye(4)), *(RenderInstance(slots[kind], pose) for kind, pose in poses)]
    )


def _mesh(part: Part) -> Mesh:
    vertices, faces = part
    return Mesh(vertices=vertices.astype(np.float32), faces=faces, colors=np.full((len(vertices), 3), 200, np.uint8))


def views(count: int = 8, seed: int = 3) -> list[NDArray[np.float64]]:
    """Return camera poses in the rooms, at the height of robots and eyes."""
    rng = np.random.default_rng(seed)
    poses = []
    for k in range(count):
        room = (k % ROOMS_X, k // ROOMS_X % ROOMS_Y)
        eye = np.array([(r + 0.5) * ROOM + rng.uniform(-0.8, 0.8) for r in room] + [rng.uniform(0.5, 1.6)])
        yaw = rng.uniform(0, 2 * np.pi) if k else -np.pi / 2
        pitch = rng.uniform(-0.3, 0.05)
        eye = eye if k else np.array([2.2, 3.9, 1.3])
        forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
        poses.append(look_at(eye, eye + forward, up=(0, 0, 1)))
    return poses


# --- measuring --------------------------------------------------------------------------------------------------------
def run(emit: Emit) -> None:
    """Emit all `render.h2h.*` lines."""
    for name, (wanted, count, triangles) in HOMES.items():
        scene = home(wanted, count)
        if scene.triangle_count != triangles:
            raise RuntimeError(f"The home {name} should have {triangles} triangles, it has {scene.triangle_count}.")
        _measure(emit, name, Renderer(scene), views())
    if SIMPLE_ROOM.exists():
        mesh = load_mesh(SIMPLE_ROOM, up=(0, 0, 1), front=(0, 1, 0))
        _measure(emit, "simple_room", Renderer(RenderScene([mesh], [RenderInstance(0, np.eye(4))])), _room_views(mesh))


def _measure(emit: Emit, name: str, renderer: Renderer, poses: Sequence[NDArray[np.float64]]) -> None:
    for size in ("224x171", "256x256", "640x480"):
        cameras: list[Camera] = cameras_at(*SIZES[size], list(poses))
        ms = frame_ms(renderer, cameras, outputs=("depth", "instance"))
        emit(f"render.h2h.{name}.{size}_cpu_ms", ms, "ms")
        if size in HABITAT_MS[name]:
            emit(f"render.h2h.{name}.{size}.ratio", HABITAT_MS[name][size] / ms, "1")


def _room_views(mesh: Mesh) -> list[NDArray[np.float64]]:
    """Return the cameras inside the room's box."""
    low, high = mesh.bounds
    rng = np.random.default_rng(0)
    poses = []
    for _ in range(8):
        eye = (low + (high - low) * rng.uniform(0.35, 0.65, 3)).astype(np.float64)
        yaw = rng.uniform(0, 2 * np.pi)
        poses.append(look_at(eye, eye + np.array([np.cos(yaw) * np.cos(0.2), -np.sin(0.2), np.sin(yaw) * np.cos(0.2)])))
    return poses


if __name__ == "__main__":
    run(lambda name, value, unit: print(f"{name} {value:.4g} {unit}", flush=True))
