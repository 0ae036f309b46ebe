"""Loading of meshes from GLB, glTF, OBJ, PLY, STL and Collada files: +Y up, metres, with colours and textures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import H3DataError, MissingAssetError, SceneError
from h3data.geometry import Array, normalized
from h3data.mesh.gltf import GltfFile
from h3data.mesh.gltf_primitives import PlainMesh
from h3data.mesh.mesh import Mesh
from h3data.mesh.mesh_operations import joined
from h3data.plugins import Registry

MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
_GLTF_SUFFIXES = (".glb", ".gltf")
READERS: Registry[Callable[[Path], Iterable[tuple[Mesh, Array]]]] = Registry(
    "h3data.meshes", {}, what="reader of mesh files"
)
"""Readers of files other than glTF by suffix without its dot: parts of a file with the 4x4 matrices that place them."""

Vector3 = tuple[float, float, float]


def load_mesh(
    path: str | Path,
    *,
    up: Sequence[float] = (0.0, 1.0, 0.0),
    front: Sequence[float] = (0.0, 0.0, -1.0),
    units_m: float = 1.0,
) -> Mesh:
    """Load the triangles of a file as one mesh, +Y up, -Z forward, metres; its scene graph is flattened.

    ``up`` and ``front`` are the axes *of the file* that point up and forward, as in Habitat's ``frame``
    (spec/habitat.md 5.1): YCB files have up +Z, front +Y. Collada files state their unit and ``up_axis``; they are
    first converted to metres with +Z up, as robots have them, and then ``up``, ``front`` and ``units_m`` are applied.

    Colours are sRGB per vertex: the file's vertex colours times the material's base colour, in linear light. Base
    colour textures are kept (PNG, JPEG, WebP; KTX2 with Basis Universal if ``h3data[gltf]`` is installed), equal
    images as one `Texture`, reduced to at most 2048 texels a side; samplers that clamp or mirror are treated as
    repeating. If every triangle uses a single texel, as with a palette, triangles get the texel's colour and the
    texture is dropped. If an image cannot be read, its surfaces have the material's colour, and one warning per file
    states the reason. Without normals in the file, `Mesh.normals` is None, so that the mesh is shaded flat.

    The result is cached per file, time stamp and frame: do not write to it.

    Raises:
        MissingAssetError: there is no such file.
        SceneError: the file is damaged, of another kind, compressed in an unsupported way, has no triangles or has
            vertices that are not finite, or has its buffers or images outside its folder.
    """
    path = Path(path)
    if not is_file(path):
        raise MissingAssetError(f"There is no such mesh file. Hint: check the asset roots. {path}", code="H3-MESH-022")
    suffix = path.suffix.lower()
    if suffix not in _GLTF_SUFFIXES and suffix[1:] not in (*READERS.names(), *READERS.missing()):
        readable = ", ".join((*_GLTF_SUFFIXES, *(f".{name}" for name in READERS.names())))
        raise SceneError(
            f"Cannot read a mesh of type {path.suffix!r}. Expected one of {readable}: {path}", code="H3-MESH-023"
        )
    up3, front3 = _vector3(up), _vector3(front)
    return _load_cached(str(path), path.stat().st_mtime_ns, up3, front3, float(units_m))


def is_file(path: Path) -> bool:
    """Return whether a file exists; False also for recorded paths that are too long for the file system."""
    try:
        return path.is_file()
    except OSError:
        return False


def frame_rotation(up: ArrayLike, front: ArrayLike) -> NDArray[np.float64]:
    """Return the rotation [3, 3] from a file's frame to h3data's: ``up`` becomes +Y, ``front`` -Z (spec/habitat.md 5.1)."""
    u, f = np.asarray(up, np.float64), np.asarray(front, np.float64)
    lengths = np.linalg.norm(u), np.linalg.norm(f)
    perpendicular = u.shape == f.shape == (3,) and abs(u @ f) < 1e-3 * lengths[0] * lengths[1]  # False for NaN and zero
    if not perpendicular:
        raise SceneError(
            f"An asset frame needs two perpendicular axes. Got up {u.tolist()}, front {f.tolist()}.", code="H3-MESH-025"
        )
    u, f = u / lengths[0], f / lengths[1]
    return np.array([np.cross(f, u), u, -f], np.float64)


def _vector3(value: Sequence[float]) -> Vector3:
    x, y, z = (float(v) for v in value)
    return (x, y, z)


def load_parts(
    path: str | Path,
    *,
    up: Sequence[float] = (0.0, 1.0, 0.0),
    front: Sequence[float] = (0.0, 0.0, -1.0),
    units_m: float = 1.0,
) -> list[Mesh]:
    """Load a file as separate parts, one mesh per primitive and node.

    The parts are not cached. Errors are those of `load_mesh`.
    """
    path, rotation = Path(path), frame_rotation(_vector3(up), _vector3(front))
    to_metres = np.eye(4)
    to_metres[:3, :3] = rotation * units_m
    reader = None if path.suffix.lower() in _GLTF_SUFFIXES else READERS.get(path.suffix.lower()[1:])
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # such values are refused below
            if reader is None:
                parts = [
                    _placed(part, to_metres @ matrix) for part, matrix in GltfFile(path).parts() if len(part.faces)
                ]
            else:
                parts = [_placed(part, to_metres @ matrix) for part, matrix in reader(path)]
    except Exception as fault:
        raise unreadable(fault, path) from None
    if not parts:
        raise SceneError(f"A mesh file without triangles: {path}", code="H3-MESH-024")
    if not all(np.isfinite(part.vertices).all() for part in parts):
        raise SceneError(
            f"A mesh with vertices that are not finite numbers (units_m = {units_m:g}): {path}", code="H3-MESH-026"
        )
    return parts


@lru_cache(maxsize=2048)
def _load_cached(path: str, mtime_ns: int, up: Vector3, front: Vector3, units_m: float) -> Mesh:
    del mtime_ns  # only part of the key: a changed file is read again
    try:
        return joined(load_parts(path, up=up, front=front, units_m=units_m))
    except (MemoryError, ValueError) as fault:
        raise unreadable(fault, Path(path)) from None


def unreadable(fault: Exception, path: Path) -> SceneError:
    """Return the error for a file whose reader failed with ``fault``."""
    # a message that already names the file is whole
    if str(path) in str(fault):
        return SceneError(str(fault), code=fault.code if isinstance(fault, H3DataError) else "")
    plain = isinstance(fault, ValueError | SceneError) and str(fault)
    reason = (str(fault) if plain else f"{type(fault).__name__}: {fault}").splitlines()[0][:300]
    return SceneError(
        f"Cannot read this mesh file, it may be damaged or of another kind ({reason}): {path}", code="H3-MESH-021"
    )


def _placed(part: Mesh | PlainMesh, matrix: NDArray[np.float64]) -> Mesh:
    """Return a part moved by a 4x4 matrix; a mirrored one is turned right side out again."""
    linear, faces = matrix[:3, :3], part.faces
    mirrored = np.linalg.det(linear) < 0
    # a mirror turns the order of corners round, by which the outside is known
    if mirrored:
        faces = faces[:, ::-1]
    textures = part.textures if isinstance(part, Mesh) else (() if part.texture is None else (part.texture,))
    return Mesh(
        vertices=(part.vertices.astype(np.float64) @ linear.T + matrix[:3, 3]).astype(np.float32),
        faces=np.ascontiguousarray(faces),
        colors=part.colors,
        normals=None if part.normals is None else _turned(part.normals, linear, mirrored),
        uv=part.uv,
        textures=textures,
    )


def _turned(normals: NDArray[Any], linear: NDArray[np.float64], mirrored: bool) -> NDArray[np.float32]:
    """Return the unit normals [V, 3] of a surface moved by a 3x3 matrix."""
    if (linear == np.eye(3)).all() and np.abs((normals * normals).sum(1) - 1).max() < 1e-6:
        return normals.astype(np.float32, copy=False)  # dividing by the length again would change their last bits
    cofactors = np.cross(linear[[1, 2, 0]], linear[[2, 0, 1]])  # also of flat matrices, which have no inverse
    sign = -1 if mirrored else 1
    return normalized(np.nan_to_num(normals.astype(np.float64)) @ (sign * cofactors).T).astype(np.float32)
