"""Meshes from files: GLB, glTF, OBJ, PLY and STL through trimesh, in our frame and with a colour per vertex."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import MissingAssetError, SceneError
from h3data.geometry import normalized
from h3data.scene.meshes import joined
from h3data.scene.records import Mesh
from h3data.srgb import bytes_to_linear, linear_to_bytes

MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
DEFAULT_COLOR = (204, 204, 204)
"""sRGB of a surface whose file says nothing about its colour."""

_COMPRESSIONS = {"KHR_draco_mesh_compression": "DracoPy", "EXT_meshopt_compression": None}
"""glTF extensions that pack triangles, and the module with which trimesh unpacks them."""

Vector3 = tuple[float, float, float]


def load_mesh(
    path: str | Path,
    *,
    up: Sequence[float] = (0.0, 1.0, 0.0),
    front: Sequence[float] = (0.0, 0.0, -1.0),
    units_m: float = 1.0,
) -> Mesh:
    """The triangles of a file as one mesh, +Y up, -Z forward, metres; its scene graph is flattened.

    ``up`` and ``front`` are the axes *of the file* that point up and forward, as in Habitat's ``frame``
    (spec/habitat.md 5.1): YCB files have up +Z, front +Y. Colours are sRGB per vertex, from the file's vertex
    colours, the material's base colour, or its texture sampled at the vertices (detail inside a triangle is lost;
    KTX2/Basis textures are not read and give grey). Normals are kept if the file has them; else None, which shades
    flat. The result is cached per file, time stamp and frame: do not write to it.
    """
    path = Path(path)
    if not is_file(path):
        raise MissingAssetError(f"There is no such mesh file. Hint: check the asset roots. {path}")
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise SceneError(
            f"Cannot read a mesh of type {path.suffix!r}. Expected one of {', '.join(MESH_SUFFIXES)}: {path}"
        )
    up3, front3 = _vector3(up), _vector3(front)
    return _load_cached(str(path), path.stat().st_mtime_ns, up3, front3, float(units_m))


def is_file(path: Path) -> bool:
    """Whether a file is there; also for paths that others wrote down, which may be too long for the file system."""
    try:
        return path.is_file()
    except OSError:
        return False


def node_box(
    path: str | Path,
    *,
    up: Sequence[float] = (0.0, 1.0, 0.0),
    front: Sequence[float] = (0.0, 0.0, -1.0),
    units_m: float = 1.0,
) -> NDArray[np.float64]:
    """Smallest and largest corner [2, 3] [m] of a file's contents as habitat-sim computes them, in our frame.

    Each node's box encloses its mesh's box and the *boxes* of its children, turned into its frame; so the result is
    larger than the mesh where nodes are turned. Its middle is where Habitat puts the origin of an object
    (habitat-findings, "what habitat-sim itself does" 2).
    """
    path = Path(path)
    rotation = frame_rotation(_vector3(up), _vector3(front))
    with _reading(str(path)) as scene:
        found = _node_box(scene)
    if not len(found) or not np.isfinite(found).all():
        raise SceneError(f"A mesh file without triangles: {path}")
    turned = _corners(found) @ rotation.T * units_m
    return np.stack([turned.min(0), turned.max(0)])


def _node_box(scene: Any) -> NDArray[np.float64]:
    children, edges = scene.graph.transforms.children, scene.graph.transforms.edge_data

    def box(node: str) -> NDArray[np.float64]:
        _, geometry = scene.graph[node]
        bounds = None if geometry is None else scene.geometry[geometry].bounds
        boxes = [np.zeros((0, 3)) if bounds is None else np.asarray(bounds)]
        for child in children.get(node, ()):
            inner = box(child)
            if len(inner):
                matrix = np.asarray(edges[(node, child)].get("matrix", np.eye(4)), np.float64)
                boxes.append(_corners(inner) @ matrix[:3, :3].T + matrix[:3, 3])
        points = np.concatenate(boxes)
        return np.stack([points.min(0), points.max(0)]) if len(points) else points

    return box(scene.graph.base_frame)


def _corners(box: NDArray[np.float64]) -> NDArray[np.float64]:
    """The 8 corners [8, 3] of a box [2, 3]."""
    return np.stack(np.meshgrid(*box.T, indexing="ij"), -1).reshape(8, 3)


def frame_rotation(up: ArrayLike, front: ArrayLike) -> NDArray[np.float64]:
    """3x3 rotation from a file's frame to ours: ``up`` goes to +Y, ``front`` to -Z (spec/habitat.md 5.1)."""
    u, f = np.asarray(up, np.float64), np.asarray(front, np.float64)
    lengths = np.linalg.norm(u), np.linalg.norm(f)
    perpendicular = u.shape == f.shape == (3,) and abs(u @ f) < 1e-3 * lengths[0] * lengths[1]  # False for NaN and zero
    if not perpendicular:
        raise SceneError(f"An asset frame needs two perpendicular axes. Got up {u.tolist()}, front {f.tolist()}.")
    u, f = u / lengths[0], f / lengths[1]
    return np.array([np.cross(f, u), u, -f], np.float64)


def _vector3(value: Sequence[float]) -> Vector3:
    x, y, z = (float(v) for v in value)
    return (x, y, z)


@lru_cache(maxsize=2048)
def _load_cached(path: str, mtime_ns: int, up: Vector3, front: Vector3, units_m: float) -> Mesh:
    del mtime_ns  # only part of the key: a changed file is read again
    rotation = frame_rotation(up, front)
    glb = path.lower().endswith(("glb", "gltf"))
    with _reading(path) as scene:
        parts = [_part(geometry, matrix, glb=glb) for geometry, matrix in _triangles(scene)]
    parts = [p for p in parts if len(p.faces)]
    if not parts:
        raise SceneError(f"A mesh file without triangles: {path}")
    mesh = joined(parts)
    with np.errstate(over="ignore", invalid="ignore"):
        vertices = (mesh.vertices @ rotation.T * units_m).astype(np.float32)
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(vertices):
        raise SceneError(f"A mesh with triangles between vertices that do not exist: {path}")
    if not np.isfinite(vertices).all():
        raise SceneError(f"A mesh with vertices that are not finite numbers (units_m = {units_m:g}): {path}")
    return Mesh(
        vertices=vertices,
        faces=mesh.faces,
        colors=mesh.colors,
        normals=None if mesh.normals is None else (mesh.normals @ rotation.T).astype(np.float32),
    )


def _triangles(scene: Any) -> list[tuple[Any, NDArray[np.float64]]]:
    """Pairs of trimesh geometry and its 4x4 to the file's root."""
    import trimesh

    nodes = [scene.graph[node] for node in scene.graph.nodes_geometry]
    pairs = [(scene.geometry[name], np.asarray(matrix, np.float64)) for matrix, name in nodes]
    return [(geometry, matrix) for geometry, matrix in pairs if isinstance(geometry, trimesh.Trimesh)]


@contextmanager
def _reading(path: str) -> Iterator[Any]:
    """The file as trimesh's scene, for reading in the block; `SceneError` names the reason if that fails.

    Much is decoded only when it is asked for (textures, bounds), and trimesh raises whatever its loaders meet.
    """
    import trimesh

    _refuse_compressed(path)
    try:
        with np.errstate(all="ignore"):  # of values that are refused afterwards
            yield trimesh.load_scene(path, process=False)
    except Exception as fault:
        reason = f"{type(fault).__name__}: {fault}".splitlines()[0][:200]
        raise SceneError(
            f"Cannot read this mesh file, it may be damaged or of another kind ({reason}): {path}"
        ) from None


def _refuse_compressed(path: str) -> None:
    """`SceneError` for glTF whose triangles are compressed: trimesh would return zeros in their place."""
    if not path.lower().endswith((".glb", ".gltf")):
        return
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise SceneError(f"The mesh file cannot be read ({error.strerror}): {path}") from None
    header = data[20 : 20 + int.from_bytes(data[12:16], "little")] if data.startswith(b"glTF") else data
    for extension, module in _COMPRESSIONS.items():
        if extension.encode() in header and (module is None or find_spec(module) is None):
            hint = "" if module is None else f" Hint: pip install {module}."
            raise SceneError(
                f"The triangles of this file are compressed ({extension}), which is not read.{hint} {path}"
            )


def _part(geometry: Any, matrix: NDArray[np.float64], *, glb: bool) -> Mesh:
    """One trimesh geometry, moved into the file's root frame."""
    vertices = np.asarray(geometry.vertices, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    faces = np.asarray(geometry.faces, np.int32).reshape(-1, 3)
    if np.linalg.det(matrix[:3, :3]) < 0:  # a mirrored node turns its triangles inside out
        faces = faces[:, ::-1]
    normals = None
    if "vertex_normals" in geometry._cache:  # set by trimesh's loaders only if the file has normals
        inverse = np.linalg.inv(matrix[:3, :3])
        normals = normalized(np.asarray(geometry.vertex_normals, np.float64) @ inverse).astype(np.float32)
    return Mesh(
        vertices=vertices.astype(np.float32),
        faces=np.ascontiguousarray(faces),
        colors=_colors(geometry, glb=glb),
        normals=normals,
    )


def _colors(geometry: Any, *, glb: bool) -> NDArray[np.uint8]:
    """sRGB per vertex, shape [V, 3]. In glTF factors and vertex colours are linear, textures sRGB (glTF 2.0, 3.9.2)."""
    count, visual = len(geometry.vertices), geometry.visual
    if visual.kind == "vertex":
        colors = np.asarray(visual.vertex_colors)[:, :3].astype(np.uint8)
        return linear_to_bytes(colors / 255) if glb else colors
    if visual.kind == "face":
        face_colors = np.asarray(visual.face_colors)[:, :3].astype(np.uint8)
        colors = np.full((count, 3), DEFAULT_COLOR, np.uint8)
        colors[np.asarray(geometry.faces).ravel()] = np.repeat(face_colors, 3, axis=0)
        return colors
    material = getattr(visual, "material", None)
    factor = _first(material, "baseColorFactor", "diffuse") if material is not None else None
    image = _first(material, "baseColorTexture", "image") if material is not None else None
    uv = getattr(visual, "uv", None)
    if image is not None and uv is not None:
        texels = _sample(image, np.asarray(uv, np.float64))
        if factor is None or not glb or np.all(np.asarray(factor)[:3] == 255):
            return texels
        linear = bytes_to_linear(texels) * (np.asarray(factor, np.float64)[:3] / 255)
        return linear_to_bytes(linear)
    if factor is None:
        return np.full((count, 3), DEFAULT_COLOR, np.uint8)
    rgb = np.asarray(factor, np.float64)[:3] / 255
    return np.broadcast_to(linear_to_bytes(rgb) if glb else _to_uint8(rgb), (count, 3)).copy()


def _first(material: Any, *names: str) -> Any:
    values = (getattr(material, name, None) for name in names)
    return next((v for v in values if v is not None), None)


def _to_uint8(unit: ArrayLike) -> NDArray[np.uint8]:
    return np.rint(np.asarray(unit) * 255).astype(np.uint8)


def _sample(image: Any, uv: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Nearest texels [V, 3] of a PIL image at ``uv`` [V, 2]: origin at the lower left, repeated outside 0..1."""
    pixels = np.asarray(image.convert("RGB"))
    height, width = pixels.shape[:2]
    uv = np.nan_to_num(uv)
    column = np.minimum((uv[:, 0] % 1.0 * width).astype(int), width - 1)
    row = np.minimum(((1.0 - uv[:, 1]) % 1.0 * height).astype(int), height - 1)
    return pixels[row, column]
