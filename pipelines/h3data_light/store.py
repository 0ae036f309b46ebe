"""Cache of baked light on disk, by a key of all its inputs (`h3data.files.cache_folder`).

The key is a digest of the meshes, their poses and textures, the light sources, the flat light and `FORMAT`. Files get
their final names when they are complete, so processes may write at the same time or be killed. A damaged file is
computed again.
"""

from __future__ import annotations

import hashlib
import logging
import os
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.errors import SceneError
from h3data.files import cache_folder, evict, part_file
from h3data.mesh.mesh import Mesh
from h3data.render.light.sources import LightSources
from h3data.render.shade.shading import Light
from h3data_light.field import LightField

log = logging.getLogger(__name__)

FORMAT = 4
"""Version of the cache format, which is part of the key; increase it whenever the baking changes."""
ROOM_BYTES = 2e9
"""Largest size of the cache [bytes]; the least recently used homes are removed."""
_FIELD = ("origin", "spacing_m", "cube", "reach_m", "mean", "flat")
_ARRAYS = ("vertices", "faces", "colors", "normals", "uv", "face_textures")


class Baked(NamedTuple):
    """Baked light of a home, as it is stored in the cache."""

    meshes: list[Mesh]
    """Static meshes with their baked light."""
    mirrors: list[NDArray[np.float32] | None]
    """Light that the vertices of glossy meshes reflect (`RenderScene`), each [V, 5]; None for other meshes."""
    field: LightField
    """Light field in the space between the surfaces."""


def cached(
    meshes: Sequence[Mesh],
    matrices: Sequence[NDArray[np.float64]],
    names: Sequence[str],
    sources: LightSources,
    light: Light,
    build: Callable[[], Baked | None],
) -> Baked | None:
    """Return baked light from the cache, or else from ``build``, whose result is cached if possible."""
    folder = cache_folder("light")
    if folder is None:
        return build()
    path = folder / f"{_key(meshes, matrices, names, sources, light)}.npz"
    try:
        baked = _load(path, meshes)
        os.utime(path)
        return baked
    except FileNotFoundError:
        pass  # there is none yet, or another process has just removed it
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, SceneError) as fault:
        log.warning("Cached light is broken and is computed again (%s): %s", fault, path)
    baked = build()
    if baked is not None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            _save(path, baked)
            evict(folder, ROOM_BYTES, keep=path)
        except OSError as fault:
            log.info("The light is not cached: %s", fault)
    return baked


def _key(
    meshes: Sequence[Mesh],
    matrices: Sequence[NDArray[np.float64]],
    names: Sequence[str],
    sources: LightSources,
    light: Light,
) -> str:
    digest = hashlib.blake2b(f"{FORMAT} {light!r}".encode(), digest_size=16)
    hashes: dict[int, bytes] = {}
    for mesh, matrix, name in zip(meshes, matrices, names, strict=True):
        if id(mesh) not in hashes:
            part = hashlib.blake2b(digest_size=16)
            arrays = (mesh.vertices, mesh.faces, mesh.colors, mesh.normals, mesh.uv, mesh.face_textures)
            for array in (*arrays, *(t.pixels for t in mesh.textures)):
                part.update(
                    b"-" if array is None else f"{array.shape}".encode() + np.ascontiguousarray(array).tobytes()
                )
            hashes[id(mesh)] = part.digest()
        digest.update(hashes[id(mesh)] + matrix.tobytes())
        digest.update(f"{name in sources.glass} {name in sources.glowing} {name in sources.glossy}".encode())
    for window in sources.windows:
        for array in (window.center, window.half_u, window.half_v, window.across):
            digest.update(array.tobytes())
    for lamp in sources.lamps:
        digest.update(b"lamp" + lamp.position.tobytes() + lamp.power.tobytes())
    for direction, power in sources.suns:
        digest.update(b"sun" + direction.tobytes() + power.tobytes())
    return digest.hexdigest()


def _save(path: Path, baked: Baked) -> None:
    arrays: dict[str, NDArray] = {f"field.{name}": np.asarray(getattr(baked.field, name)) for name in _FIELD}
    columns = {name: [getattr(mesh, name) for mesh in baked.meshes] for name in _ARRAYS}
    for name, parts in {**columns, "mirrors": baked.mirrors}.items():
        arrays[f"{name}.count"] = np.array([-1 if p is None else len(p) for p in parts])
        present = [p for p in parts if p is not None]
        arrays[name] = np.concatenate(present) if present else np.zeros(0)
    with part_file(path, shared=True) as part, part.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def _load(path: Path, originals: Sequence[Mesh]) -> Baked:
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
        columns: dict[str, list] = {}
        for name in (*_ARRAYS, "mirrors"):
            counts, values = file[f"{name}.count"], file[name]
            if len(counts) != len(originals):
                raise ValueError(f"{len(counts)} meshes, expected {len(originals)}")
            ends = np.cumsum(np.maximum(counts, 0))
            columns[name] = [
                None if n < 0 else values[end - n : end] for n, end in zip(counts.tolist(), ends.tolist(), strict=True)
            ]
        grid: dict[str, Any] = {name: file[f"field.{name}"] for name in _FIELD}
        grid |= {name: float(grid[name]) for name in ("spacing_m", "mean")}
        field = LightField(**grid)
    mirrors = columns.pop("mirrors")
    rows = zip(*columns.values(), strict=True)
    meshes = [
        Mesh(**dict(zip(columns, row, strict=True)), textures=mesh.textures)
        for row, mesh in zip(rows, originals, strict=True)
    ]
    return Baked(meshes, mirrors, field)
