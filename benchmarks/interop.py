"""Files of other programs, each in a process of its own: a GLB of a million triangles, a gfx-replay of 500 MB."""

from __future__ import annotations

import gzip
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from h3data.scene import Mesh, Texture
from h3data_exporters.glb_write import glb_bytes

TRIANGLES = 1_000_000
PARTS = 4
REPLAY_BYTES = 500 << 20
REPLAY_BODIES = 22
"""As many move in a real session with a Spot and a person."""

_PEAK = """
import sys, time
def peak_mib():
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) / 1024 for line in file if line.startswith("VmHWM"))
"""
_OPEN = """
from h3data_habitat.scenes.scene_instance import load_habitat_scene
from h3data.mesh.loading import load_mesh
start = time.perf_counter()
mesh = load_mesh(sys.argv[2]) if sys.argv[1] == "mesh" else load_habitat_scene(sys.argv[2])
print(time.perf_counter() - start, peak_mib())
"""
_IMPORT = """
start = time.perf_counter()
from h3data_pipelines.cli import main
assert main(["import", sys.argv[1], "-o", sys.argv[2], "--force"]) == 0
print(time.perf_counter() - start, peak_mib())
"""


def run(emit: Callable[[str, float, str], None]) -> None:
    """Emit ``interop.glb_1m.open_s`` and ``.peak_mib`` (`load_mesh`), ``.scene_s`` and ``.scene_peak_mib`` (as a
    stage); ``interop.gfx_replay_500mb.s`` and ``.peak_mib`` (`h3data import`), ``.gz_s`` and ``.gz_peak_mib`` (the same
    packed).

    Best of three, of replays of one; the peak is that of the whole process.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "terrain.glb"
        path.write_bytes(glb_bytes([_terrain(seed) for seed in range(PARTS)]))
        for kind, name in (("mesh", ""), ("scene", "scene_")):
            runs = [_measured(_OPEN, kind, path) for _ in range(3)]
            emit(f"interop.glb_1m.{name or 'open_'}s", min(r[0] for r in runs), "s")
            emit(f"interop.glb_1m.{name}peak_mib", min(r[1] for r in runs), "MiB")
    with tempfile.TemporaryDirectory() as folder:
        for suffix, name in ((".json", ""), (".json.gz", "gz_")):
            path = Path(folder) / f"long.gfx_replay{suffix}"
            _write_replay(path)
            seconds, mib = _measured(_IMPORT, path, Path(folder) / "rec")
            emit(f"interop.gfx_replay_500mb.{name}s", seconds, "s")
            emit(f"interop.gfx_replay_500mb.{name}peak_mib", mib, "MiB")
            path.unlink()


def _measured(code: str, *arguments: str | Path) -> tuple[float, float]:
    """Return the seconds and MiB that the code prints last."""
    out = subprocess.run(
        [sys.executable, "-c", _PEAK + code, *map(str, arguments)], check=True, capture_output=True, text=True
    )
    seconds, mib = map(float, out.stdout.splitlines()[-1].split())
    return seconds, mib


def _write_replay(path: Path) -> None:
    """Write bodies that all move in every keyframe, with 7 decimals as habitat-sim does."""
    rng = np.random.default_rng(0)

    def updates() -> list[dict[str, Any]]:
        transforms = [
            {"translation": rng.normal(size=3).round(7).tolist(), "rotation": rng.normal(size=4).round(7).tolist()}
            for _ in range(REPLAY_BODIES)
        ]
        return [{"instanceKey": k, "state": {"absTransform": t}} for k, t in enumerate(transforms)]

    creations = [{"instanceKey": k, "creation": {"filepath": f"part_{k}.glb"}} for k in range(REPLAY_BODIES)]
    block = b",".join(json.dumps({"stateUpdates": updates()}, separators=(",", ":")).encode() for _ in range(500))
    with gzip.open(path, "wb", 1) if path.suffix == ".gz" else path.open("wb") as out:
        out.write(b'{"keyframes":[' + json.dumps({"creations": creations}).encode())
        for _ in range(REPLAY_BYTES // len(block)):
            out.write(b"," + block)
        out.write(b"]}")


def _terrain(seed: int) -> Mesh:
    """Write a square of hills with a 2048 x 2048 texture, with half as many vertices as triangles."""
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
