"""Reading of OBJ, PLY and STL files through trimesh: colours of vertices, faces and materials, and textures."""

from __future__ import annotations

import io
import logging
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import SceneError
from h3data.files import path_inside
from h3data.mesh.gltf_primitives import DEFAULT_COLOR
from h3data.mesh.images import picture_texture
from h3data.mesh.mesh import Mesh, Texture
from h3data_meshes.material_files import material_uv, mtl_with_plain_names
from h3data_meshes.polygon_files import obj_of_triangles, ply_of_triangles

_log = logging.getLogger(__name__)

_TRIANGLES_OF = {"obj": obj_of_triangles, "ply": ply_of_triangles}


def read_with_trimesh(path: Path) -> list[Mesh]:
    """Read the meshes of a file in its own frame and units with trimesh, including its exceptions.

    Material files and images that the file names are read from its folder or below, and from nowhere else. There is one
    warning if some are missing or lie outside. They only affect colours, because all triangles are in the file itself.
    """
    import trimesh

    beside = FilesBeside(path)
    resolver: Any = beside
    kind = path.suffix[1:].lower()
    with np.errstate(all="ignore"):  # such values are refused afterwards
        data = io.BytesIO(_TRIANGLES_OF.get(kind, bytes)(path.read_bytes()))
        scene = trimesh.load_scene(data, file_type=kind, resolver=resolver, process=False)
    beside.warn()
    geometries = [scene.geometry[scene.graph[node][1]] for node in scene.graph.nodes_geometry]
    return [_mesh(g, path) for g in geometries if isinstance(g, trimesh.Trimesh) and len(g.faces)]


class FilesBeside:
    """Resolver of the files that a mesh file names, which records those that are missing or outside its folder."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.outside: list[str] = []
        self.missing: list[str] = []

    def get(self, name: Any) -> bytes:
        """Return the content of a file that the mesh file names, relative to the mesh file's folder.

        MTL files are returned with plain image names.

        Raises:
            FileNotFoundError: the name leads outside the folder.
            OSError: the file is missing or cannot be read.
        """
        text = (name.decode(errors="replace") if isinstance(name, bytes) else str(name)).strip()
        clean = path_inside(text)
        if clean is None:
            self.outside.append(text[:200])
            raise FileNotFoundError(text)
        try:
            data = (self._path.parent / clean).read_bytes()
        except OSError:
            self.missing.append(text[:200])
            raise
        return mtl_with_plain_names(data) if clean.lower().endswith(".mtl") else data

    __getitem__ = get

    def warn(self) -> None:
        """Warn about the first named file that is missing or outside the folder."""
        if self.outside:
            _log.warning(
                "the name %r leads out of the file's folder, which is not followed: its surfaces show other colours: %s",
                *(self.outside[0], self._path),
            )
        elif self.missing:
            _log.warning(
                "there is no file %r beside it, its surfaces show other colours: %s", self.missing[0], self._path
            )


def _mesh(geometry: Any, path: Path) -> Mesh:
    vertices = np.asarray(geometry.vertices, np.float32)
    faces = np.asarray(geometry.faces, np.int32).reshape(-1, 3)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise SceneError("triangles between vertices that do not exist", code="H3-MESH-031")
    normals = None
    if "vertex_normals" in geometry._cache:  # set by trimesh's readers only if the file has normals
        normals = np.asarray(geometry.vertex_normals, np.float32)
    visual = geometry.visual
    if visual.kind == "face":  # every triangle has corners of its own
        colors = np.repeat(np.asarray(visual.face_colors)[:, :3].astype(np.uint8), 3, axis=0)
        corners = faces.ravel()
        faces = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
        normals = None if normals is None else normals[corners]
        return Mesh(vertices=vertices[corners], faces=faces, colors=colors, normals=normals)
    if visual.kind == "vertex":
        colors = np.ascontiguousarray(np.asarray(visual.vertex_colors)[:, :3].astype(np.uint8))
        return Mesh(vertices=vertices, faces=faces, colors=colors, normals=normals)
    material, uv = getattr(visual, "material", None), getattr(visual, "uv", None)
    image = _first(material, "image", "baseColorTexture")
    if image is not None and getattr(image, "format", None) is None:
        material = image = None  # trimesh's stand-in for a missing material
    texture = None if image is None or uv is None or len(uv) != len(vertices) else _texture(image, material, path)
    if texture is None or uv is None:
        factor = _first(material, "diffuse", "baseColorFactor")
        color = DEFAULT_COLOR if factor is None else np.asarray(factor)[:3].astype(np.uint8)
        colors = np.full((len(vertices), 3), color, np.uint8)
        return Mesh(vertices=vertices, faces=faces, colors=colors, normals=normals)
    return Mesh(
        vertices=vertices,
        faces=faces,
        colors=np.full((len(vertices), 3), 255, np.uint8),
        normals=normals,
        uv=_uv(material_uv(material, uv)),
        textures=(texture,),
    )


def _uv(uv: Any) -> NDArray[np.float32]:
    """Convert texture coordinates from trimesh's origin in the lower left corner to ours in the upper left one."""
    values = np.nan_to_num(np.asarray(uv, np.float64)[:, :2])
    return np.column_stack([values[:, 0], 1 - values[:, 1]]).astype(np.float32)


def _texture(image: Any, material: Any, path: Path) -> Texture | None:
    try:
        return picture_texture(image, name=str(getattr(material, "name", "") or ""))
    except SceneError as reason:
        _log.warning("a texture is left out, its surfaces show their material's colour (%s): %s", reason, path)
        return None


def _first(material: Any, *names: str) -> Any:
    values = (getattr(material, name, None) for name in names)
    return next((v for v in values if v is not None), None)
