"""Opening mesh files of other programs: a GLB of a million triangles with textures, in a process of its own."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from h3data.interop.glb_write import glb_bytes
from h3data.scene import Mesh, Texture

TRIANGLES = 1_000_000
PARTS = 4

_OPEN = """
import sys, time
from h3data.interop import load_habitat_scene, load_mesh
def peak_mib():
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) / 1024 for line in file if line.startswith("VmHWM"))
start = time.perf_counter()
mesh = load_mesh(sys.argv[2]) if sys.argv[1] == "mesh" else load_habitat_scene(sys.argv[2])
print(time.perf_counter() - start, peak_mib())
"""


def run(emit: Callable[[str, float, str], None]) -> None:
    """Emits ``interop.glb_1m.open_s`` and ``.peak_mib`` (`load_mesh`), ``.scene_s`` and ``.scene_peak_mib`` (as a stage).

    Best of three; the peak is that of the whole process.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "terrain.glb"
        path.write_bytes(glb_bytes([_terrain(seed) for seed in range(PARTS)]))
        for kind, name in (("mesh", ""), ("scene", "scene_")):
            runs = [_measured(kind, path) for _ in range(3)]
            emit(f"interop.glb_1m.{name or 'open_'}s", min(r[0] for r in runs), "s")
            emit(f"interop.glb_1m.{name}peak_mib", min(r[1] for r in runs), "MiB")


def _measured(kind: str, path: Path) -> tuple[float, float]:
    """Seconds and MiB."""
    out = subprocess.run([sys.executable, "-c", _OPEN, kind, str(path)], check=True, capture_output=True, text=True)
    seconds, mib = map(float, out.stdout.split())
    return seconds, mib


def _terrain(seed: int) -> Mesh:
    """A square of hills with a 2048 x 2048 texture; its part of the triangles, half as many vertices."""
    rng = np.random.default_rng(seed)
    side = int((TRIANGLES / PARTS / 2) ** 0.5)
    x, z = np.meshgrid(np.linspace(0, 10, side + 1), np.linspace(0, 10, side + 1), indexing="ij")
    y = 0.5 * np.sin(x) * np.cos(z) + seed
    corner = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).reshape(-1, 1)
    faces = np.concatenate([corner + np.array(steps) for steps in ((0, 1, side + 1), (1, side + 2, side + 1))]).astype(
        np.int32
    )
    vertices = np.stack([x, y, z], -1).reshape(-1, 3).astype(np.float32)
    up = np.broadcast_to(np.array([0, 1, 0], np.float32), vertices.shape).copy()
    pixels = rng.integers(0, 256, (64, 64, 4), dtype=np.uint8).repeat(32, 0).repeat(32, 1)
    pixels[..., 3] = 255
    return Mesh(
        vertices=vertices,
        faces=faces,
        colors=np.full(vertices.shape, 255, np.uint8),
        normals=up,
        uv=np.ascontiguousarray(vertices[:, [0, 2]] / np.float32(10)),
        textures=(Texture(pixels=pixels, name=f"hills {seed}"),),
    )


if __name__ == "__main__":
    run(lambda name, value, unit: print(name, f"{value:.4g}", unit))
