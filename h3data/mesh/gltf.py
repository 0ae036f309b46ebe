"""Reader of glTF 2.0 files (GLB, or JSON with separate files): buffers, node graph and primitives.

Triangles, strips and fans are read. Triangles that repeat a corner, which strips contain by design, are dropped. Skins
have the pose of their joints in the file (`h3data.recording.assets.skinned_meshes` poses them), and morph targets the
weights in the file. Points and lines are ignored.
"""

from __future__ import annotations

import base64
import json
import logging
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from h3data.errors import SceneError
from h3data.files import path_inside
from h3data.geometry import normalized, quat_to_matrix
from h3data.mesh.accessors import GltfArrays, entry
from h3data.mesh.glb import GLTF_1_HINT, unpack_glb
from h3data.mesh.gltf_materials import GltfMaterials
from h3data.mesh.gltf_primitives import MAX_TRIANGLES, PlainMesh, has_positions, read_primitive, triangle_count

_log = logging.getLogger(__name__)


class GltfFile:
    """Reader of one glTF file.

    Faults raise a `SceneError` or `ValueError` that names the key; `h3data.mesh.loading` adds the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        data = path.read_bytes()
        if data[:4] == b"glTF":
            self.document, self._binary = unpack_glb(data, str(path))
        elif not data:
            raise ValueError("the file is empty")
        else:
            self.document, self._binary = json.loads(data), memoryview(b"")
        if not isinstance(self.document, dict):
            raise ValueError("its JSON is not an object")
        version = str(_part(self.document, "asset").get("version", ""))
        if version.startswith("1"):
            raise SceneError(f"this is glTF {version}, {GLTF_1_HINT}", code="H3-MESH-011")
        _check_extensions(self.document.get("extensionsRequired", []), path)
        self._buffers: dict[int, memoryview] = {}
        self._meshes: dict[tuple[int, tuple[float, ...]], list[PlainMesh]] = {}
        self._warned: set[tuple[int, int]] = set()
        self._warned_of_skins = False
        self.arrays = GltfArrays(self.document, self._buffer)
        self.materials = GltfMaterials(self.arrays, self._resource, str(path))

    # --- bytes --------------------------------------------------------------------------------------------------------
    def _buffer(self, index: int) -> memoryview:
        if index not in self._buffers:
            record = entry(self.document, "buffers", index)
            # only the first buffer may be the binary chunk of a GLB (glTF 2.0, 4.4.3.3)
            data = memoryview(self._resource(record["uri"])) if "uri" in record else self._binary
            if "uri" not in record and index != 0:
                raise ValueError(f"buffers[{index}] has no uri")
            self._buffers[index] = data
        return self._buffers[index]

    def _resource(self, uri: Any) -> bytes:
        """Return the content of a ``data:`` uri, or of a file in the folder of this one or below; never of one outside."""
        if not isinstance(uri, str) or not uri:
            raise SceneError("it has neither a bufferView nor a uri", code="H3-MESH-012")
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            return base64.b64decode(unquote(body)) if head.endswith(";base64") else unquote_to_bytes(body)
        name = path_inside(unquote(uri))
        if name is None:
            raise ValueError(f"the uri {uri[:200]!r} leads out of the file's folder, which is not followed")
        file = self.path.parent / name
        if not file.is_file():
            raise SceneError(f"there is no file {uri[:200]!r} beside it", code="H3-MESH-013")
        return file.read_bytes()

    # --- node graph ---------------------------------------------------------------------------------------------------
    @cached_property
    def nodes(self) -> list[tuple[int, int, NDArray[np.float64]]]:
        """Nodes of the scene, parents before children: index, position of the parent in this list (-1: none), matrix.

        The matrix [4, 4] maps to the file's frame. Raises `ValueError` if a node has two parents or is its own ancestor.
        """
        ordered: list[tuple[int, int, NDArray[np.float64]]] = []
        visited: set[int] = set()
        # a stack instead of recursion, which a file with a long chain of nodes would exhaust
        waiting = [(index, -1) for index in reversed(self._roots())]
        while waiting:
            index, parent = waiting.pop()
            record = entry(self.document, "nodes", index)
            if index in visited:
                raise ValueError(f"nodes[{index}] has two parents or is its own ancestor")
            # a second visit would also never end, where a node is its own ancestor
            visited.add(index)
            matrix = local_matrix(record, f"nodes[{index}]")
            ordered.append((index, parent, ordered[parent][2] @ matrix if parent >= 0 else matrix))
            waiting += [(child, len(ordered) - 1) for child in reversed(record.get("children", []))]
        return ordered

    def _roots(self) -> list[int]:
        """Return the root nodes of the default scene; without scenes, all nodes without a parent."""
        if self.document.get("scenes"):
            return entry(self.document, "scenes", self.document.get("scene", 0)).get("nodes", [])
        nodes = self.document.get("nodes", [])
        children = {child for node in nodes for child in node.get("children", [])}
        return [index for index in range(len(nodes)) if index not in children]

    def _placed_meshes(self) -> list[tuple[dict[str, Any], NDArray[np.float64]]]:
        """Return node and 4x4 matrix of every mesh and instance in the scene; without nodes, each mesh once."""
        if not self.document.get("nodes"):
            return [({"mesh": index}, np.eye(4)) for index in range(len(self.document.get("meshes", [])))]
        placed = [(index, self.node(index), matrix) for index, _, matrix in self.nodes]
        return [
            (node, matrix @ instance)
            for index, node, matrix in placed
            if node.get("mesh") is not None
            for instance in self.instances(index)
        ]

    def instances(self, index: int) -> NDArray[np.float64]:
        """Return the matrices [N, 4, 4] of a node's instances of its mesh, in the node's frame.

        The result is a single matrix if the node is not instanced.
        """
        where = f"nodes[{index}].extensions.EXT_mesh_gpu_instancing"
        record = _part(_part(self.node(index), "extensions"), "EXT_mesh_gpu_instancing")
        found = {
            name: self.arrays.floats(accessor).astype(np.float64)
            for name, accessor in _part(record, "attributes").items()
            if name in ("TRANSLATION", "ROTATION", "SCALE")
        }
        if not found:
            return np.eye(4)[None]
        count = len(next(iter(found.values())))
        matrices = np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
        for name, values in found.items():
            width = 4 if name == "ROTATION" else 3
            if values.shape != (count, width) or not np.isfinite(values).all():
                raise ValueError(f"{where}.{name} is not an accessor of {count} VEC{width}")
        if "ROTATION" in found:
            matrices[:, :3, :3] = quat_to_matrix(normalized(found["ROTATION"]))
        if "SCALE" in found:
            matrices[:, :3, :3] *= found["SCALE"][:, None]
        if "TRANSLATION" in found:
            matrices[:, :3, 3] = found["TRANSLATION"]
        return matrices

    def node(self, index: int) -> dict[str, Any]:
        """Return the node with this index."""
        return entry(self.document, "nodes", index)

    # --- triangles ----------------------------------------------------------------------------------------------------
    def mesh(self, node: dict[str, Any]) -> list[PlainMesh]:
        """Return the primitives with triangles of the mesh of ``node``, in the mesh's own frame; they are read once.

        Morph targets are added with the node's weights, or else with the mesh's.
        """
        index = node["mesh"]
        record = entry(self.document, "meshes", index)
        owner, where = (node, f"a node of meshes[{index}]") if "weights" in node else (record, f"meshes[{index}]")
        given = owner.get("weights", [])
        weights = (
            tuple(_numbers(owner, "weights", len(given), where).tolist()) if isinstance(given, list) and given else ()
        )
        if (index, weights) not in self._meshes:
            self._meshes[index, weights] = [
                read_primitive(self.arrays, self.materials, *p, weights=weights) for p in self._primitives(index)
            ]
        return self._meshes[index, weights]

    def _primitives(self, mesh: int) -> Iterator[tuple[dict[str, Any], str]]:
        for k, primitive in enumerate(entry(self.document, "meshes", mesh).get("primitives", [])):
            where = f"meshes[{mesh}].primitives[{k}]"
            if primitive.get("mode", 4) not in (4, 5, 6):
                continue
            if has_positions(primitive):
                yield primitive, where
            elif (mesh, k) not in self._warned:  # valid glTF: an extension may give the positions
                self._warned.add((mesh, k))
                _log.warning("%s has no POSITION, it is left out: %s", where, self.path)

    def parts(self) -> Iterator[tuple[PlainMesh, NDArray[np.float64]]]:
        """Yield every primitive in the scene, once per node and instance, with its 4x4 matrix to the file's frame.

        A skinned primitive is posed in the file's frame by its joints; the transforms of its node are ignored (glTF
        3.7.3.3).
        """
        for part, matrix, skin in self.skinned_parts():
            if skin is None or part.influences is None:
                yield part, matrix
                continue
            try:
                posed, place = self._posed(part, matrix, skin), np.eye(4)
            except ValueError as fault:
                posed, place = part, matrix
                if not self._warned_of_skins:
                    self._warned_of_skins = True
                    _log.warning("a skin is damaged, its mesh stands where its node is (%s): %s", fault, self.path)
            yield posed, place

    def skinned_parts(self) -> Iterator[tuple[PlainMesh, NDArray[np.float64], object]]:
        """Yield every primitive in the scene, once per node, with its 4x4 matrix and the node's skin (None: no skin)."""
        placed = self._placed_meshes()
        meshes = {node["mesh"] for node, _ in placed}
        # from the counts of accessors, before anything is read: a few bytes can instance a mesh a million times
        counts = {mesh: sum(triangle_count(self.arrays, *p) for p in self._primitives(mesh)) for mesh in meshes}
        total = sum(counts[node["mesh"]] for node, _ in placed)
        if total > MAX_TRIANGLES:
            raise ValueError(f"its nodes show {total} triangles, the limit is {MAX_TRIANGLES}")
        for node, matrix in placed:
            yield from ((part, matrix, node.get("skin")) for part in self.mesh(node))

    # --- skins --------------------------------------------------------------------------------------------------------
    def skin(self, index: object) -> tuple[list[int], NDArray[np.float64]]:
        """Return joints of ``skins[index]``, as indices of nodes, and their inverse bind matrices [J, 4, 4]."""
        record, where = entry(self.document, "skins", index), f"skins[{index}]"
        joints = record.get("joints")
        if not isinstance(joints, list) or not joints:
            raise ValueError(f"{where}.joints is not a list of nodes")
        if "inverseBindMatrices" not in record:
            return joints, np.broadcast_to(np.eye(4), (len(joints), 4, 4))
        values = self.arrays.floats(record["inverseBindMatrices"]).astype(np.float64)
        if values.shape != (len(joints), 16) or not np.isfinite(values).all():
            raise ValueError(f"{where}.inverseBindMatrices is not an accessor of {len(joints)} MAT4")
        return joints, values.reshape(-1, 4, 4).swapaxes(1, 2)  # stored by columns

    @cached_property
    def _parents(self) -> dict[int, int]:
        nodes = self.document.get("nodes", [])
        return {child: index for index, node in enumerate(nodes) for child in node.get("children", [])}

    def _world(self, index: int) -> NDArray[np.float64]:
        """Return the matrix [4, 4] of any node, in the scene or not."""
        matrix, seen = np.eye(4), set()
        at: int | None = index
        while at is not None:
            if at in seen:
                raise ValueError(f"nodes[{at}] is its own ancestor")
            seen.add(at)
            matrix = local_matrix(self.node(at), f"nodes[{at}]") @ matrix
            at = self._parents.get(at)
        return matrix

    def _posed(self, part: PlainMesh, matrix: NDArray[np.float64], skin: object) -> PlainMesh:
        """Return a skinned primitive in the file's frame; vertices without weights stay with its node (``matrix``)."""
        assert part.influences is not None
        joints, inverse_bind = self.skin(skin)
        which, weights = part.influences
        if which.size and (which.min() < 0 or which.max() >= len(joints)):
            raise ValueError(f"JOINTS_0 goes up to {which.max()}, skins[{skin}] has {len(joints)} joints")
        bones = np.stack([self._world(joint) @ bind for joint, bind in zip(joints, inverse_bind, strict=True)])
        total = weights.astype(np.float64).sum(1)
        # weights of exporters rarely add up to 1 exactly
        held = np.isfinite(total) & (total > 0)
        shares = np.where(held[:, None], weights / np.where(held, total, 1)[:, None], 0)
        blended = np.zeros((len(weights), 3, 4))
        for k in range(which.shape[1]):
            blended += shares[:, k, None, None] * bones[which[:, k], :3]
        blended[~held] = matrix[:3]
        linear = blended[:, :, :3]
        vertices = np.einsum("vij,vj->vi", linear, part.vertices.astype(np.float64)) + blended[:, :, 3]
        normals, faces = part.normals, part.faces
        if normals is not None:
            # the cofactor matrix turns normals under any scale, also of zero, and changes its sign with a mirror
            cofactors = np.cross(linear[:, [1, 2, 0]], linear[:, [2, 0, 1]])
            turned = np.einsum("vij,vj->vi", cofactors, np.nan_to_num(normals.astype(np.float64)))
            normals = normalized(turned * np.sign(np.linalg.det(linear))[:, None]).astype(np.float32)
        if len(faces) and (np.linalg.det(linear[faces[:, 0]]) < 0).all():  # mirrored: right side out again
            faces = np.ascontiguousarray(faces[:, ::-1])
        return replace(part, vertices=vertices, normals=normals, faces=faces)


def _part(document: dict[str, Any], key: str) -> dict[str, Any]:
    value = document.get(key)
    return value if isinstance(value, dict) else {}


def _check_extensions(required: Any, path: Path) -> None:
    """Refuse required extensions that are not known, by name; warn of those that only paint."""
    if not isinstance(required, list):
        raise ValueError(f"extensionsRequired is not a list but {type(required).__name__}")
    # extensions that are read or do not change the picture. Quantised vertices are plain accessors of integers.
    known = {
        "EXT_mesh_gpu_instancing",
        "EXT_meshopt_compression",
        "EXT_texture_webp",
        "KHR_draco_mesh_compression",
        "KHR_materials_pbrSpecularGlossiness",
        "KHR_materials_unlit",
        "KHR_mesh_quantization",
        "KHR_texture_basisu",
        "KHR_texture_ktx",
        "KHR_texture_transform",
    }
    unknown = sorted({str(name) for name in required} - known)
    packed = [name for name in unknown if "compression" in name]
    if packed:
        raise SceneError(
            f"its triangles are compressed ({packed[0]}), which is not read. Hint: gltfpack -noq -i IN -o OUT.glb",
            code="H3-MESH-009",
        )
    # By their names these change no triangle, so files that require them are read without them. Habitat's batch files cut
    # one mesh into several by MAGNUMX_mesh_views: it is shown whole, with a warning.
    harmless = re.compile(r"^[A-Z]+_(materials|texture|lights|image|xmp|animation)(_|$)|^MAGNUMX_mesh_views\Z")
    shapes = [name for name in unknown if not harmless.match(name)]
    if shapes:
        raise SceneError(
            f"it requires the glTF extension {', '.join(shapes)}, which is not read. Hint: export it without this extension",
            code="H3-MESH-010",
        )
    if unknown:
        _log.warning("It needs glTF extensions that are not supported, and may look different: %s: %s", unknown, path)


def local_matrix(node: dict[str, Any], where: str) -> NDArray[np.float64]:
    """Return the matrix [4, 4] of a node in its parent's frame."""
    # stored by columns
    if "matrix" in node:
        return _numbers(node, "matrix", 16, where).reshape(4, 4).T
    matrix = np.eye(4)
    # files round quaternions, and a length of 1.0001 would scale the mesh
    rotation = normalized(_numbers(node, "rotation", 4, where, (0, 0, 0, 1)))
    matrix[:3, :3] = quat_to_matrix(rotation) * _numbers(node, "scale", 3, where, (1, 1, 1))
    matrix[:3, 3] = _numbers(node, "translation", 3, where, (0, 0, 0))
    return matrix


def _numbers(node: dict[str, Any], key: str, count: int, where: str, default: Any = None) -> NDArray[np.float64]:
    try:
        values = np.array(node.get(key, default), np.float64)
    except (TypeError, ValueError, OverflowError):
        values = np.zeros(0)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(f"{where}.{key} is not {count} numbers")
    return values
