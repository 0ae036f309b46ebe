"""Primitives of glTF files as triangles with colours and texture coordinates, in the mesh's own frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import SceneError
from h3data.geometry import normalized
from h3data.mesh.accessors import GltfArrays, entry, natural
from h3data.mesh.gltf_materials import GltfMaterials, Look
from h3data.mesh.mesh import Texture
from h3data.srgb import bytes_to_linear, linear_to_bytes

DEFAULT_COLOR = (204, 204, 204)
"""Colour (sRGB) of surfaces without a colour in their file."""
MAX_TRIANGLES = 30_000_000
"""Limit of triangles per file, including those of instances; larger files are refused before anything is read."""

_STRIP, _FAN = 5, 6


@dataclass(frozen=True, kw_only=True, eq=False)
class PlainMesh:
    """Triangles of one primitive, and the vertices that they use."""

    vertices: NDArray[Any]
    """Positions of the vertices, shape [V, 3]."""
    faces: NDArray[np.int32]
    """Vertices of each triangle, shape [F, 3]."""
    colors: NDArray[np.uint8]
    """Colours (sRGB) of the vertices, shape [V, 3]."""
    normals: NDArray[Any] | None
    uv: NDArray[np.float32] | None
    texture: Texture | None
    influences: tuple[NDArray[np.int32], NDArray[np.float32]] | None = None
    """Joints of the mesh's skin and their weights, both [V, 4]."""


def has_positions(primitive: dict[str, Any]) -> bool:
    """Return False for a primitive whose attributes lack POSITION, which glTF 2.0 allows and says to skip (3.7.2.1)."""
    attributes = primitive.get("attributes")
    return not isinstance(attributes, dict) or "POSITION" in attributes


def triangle_count(arrays: GltfArrays, primitive: dict[str, Any], where: str) -> int:
    """Return an upper bound of the triangles of a primitive, from the accessors' counts alone."""
    attributes = _object(primitive, "attributes", where)
    index = primitive.get("indices", attributes.get("POSITION"))
    count = natural(entry(arrays.document, "accessors", index), "count", f"accessors[{index}]")
    return count // 3 if primitive.get("mode", 4) == 4 else max(count - 2, 0)


def read_primitive(
    arrays: GltfArrays,
    materials: GltfMaterials,
    primitive: dict[str, Any],
    where: str,
    *,
    weights: Sequence[float] = (),
) -> PlainMesh:
    """Read the triangles of ``primitive`` at ``where`` in the document, with morph targets added by ``weights``.

    Raises:
        ValueError: the primitive is not valid glTF; the message names the key.
    """
    packed = _object(primitive, "extensions", where).get("KHR_draco_mesh_compression")
    accessors = _object(primitive, "attributes", where)
    if packed is None:
        attributes: Mapping[str, NDArray[Any]] = {
            name: arrays.floats(i) for name, i in accessors.items() if _used(name)
        }
        order = arrays.accessor(primitive["indices"]) if "indices" in primitive else None
    else:
        attributes, order = _unpacked(arrays, packed, accessors)
    position = attributes.get("POSITION")
    if position is None or position.ndim != 2 or position.shape[1] != 3:
        raise ValueError(f"{where}.attributes.POSITION is not an accessor of VEC3")
    for name, values in attributes.items():
        if len(values) != len(position):
            raise ValueError(f"{where}.attributes.{name} has {len(values)} elements, POSITION {len(position)}")
    attributes = _morphed(arrays, attributes, primitive.get("targets", []), weights, where)
    # exporters share one large accessor among primitives, each of which uses a part of it
    corners = _triangles(order, len(position), primitive.get("mode", 4), where)
    used, faces = _compact(corners, len(position))
    attributes = {name: values[used] for name, values in attributes.items()}
    look = materials.look(primitive["material"]) if "material" in primitive else None
    return _painted(attributes, faces, look, where)


def _morphed(
    arrays: GltfArrays, attributes: Mapping[str, NDArray[Any]], targets: Any, weights: Sequence[float], where: str
) -> dict[str, NDArray[Any]]:
    """Return the attributes with what the targets add to positions and normals."""
    found = dict(attributes)
    if not isinstance(targets, list) or not all(isinstance(target, dict) for target in targets):
        raise ValueError(f"{where}.targets is not a list of objects")
    for k, (target, weight) in enumerate(zip(targets, weights, strict=False)):
        for name in ("POSITION", "NORMAL"):
            if weight and name in target and name in found:
                added = arrays.floats(target[name])
                if added.shape != found[name].shape:
                    raise ValueError(f"{where}.targets[{k}].{name} has another shape than {name}")
                found[name] = found[name] + np.float32(weight) * added
    # targets add differences, after which normals have other lengths
    if found.get("NORMAL") is not attributes.get("NORMAL"):
        found["NORMAL"] = normalized(found["NORMAL"].astype(np.float64)).astype(np.float32)
    return found


def _used(name: str) -> bool:
    return name in ("POSITION", "NORMAL", "COLOR_0", "JOINTS_0", "WEIGHTS_0") or name.startswith("TEXCOORD_")


def _influences(attributes: Mapping[str, NDArray[Any]], where: str) -> tuple[NDArray[Any], NDArray[Any]] | None:
    joints, weights = attributes.get("JOINTS_0"), attributes.get("WEIGHTS_0")
    if joints is None or weights is None:
        return None
    for name, values in (("JOINTS_0", joints), ("WEIGHTS_0", weights)):
        if values.ndim != 2 or values.shape[1] != 4:
            raise ValueError(f"{where}.attributes.{name} is not an accessor of VEC4")
    return joints.astype(np.int32), weights.astype(np.float32)


def _triangles(order: NDArray[Any] | None, count: int, mode: int, where: str) -> NDArray[np.int64]:
    """Return the vertex indices [F, 3] of the primitive, without triangles that repeat a corner."""
    if order is None:
        order = np.arange(count)
    if order.ndim != 1 or order.dtype.kind not in "ui":
        raise ValueError(f"{where}.indices is not an accessor of integers")
    order = order.astype(np.int64)
    if len(order) and (order.max() >= count or order.min() < 0):
        raise ValueError(f"{where}.indices go from {order.min()} to {order.max()}, there are {count} vertices")
    if mode == _STRIP and len(order) > 2:
        faces = np.stack([order[:-2], order[1:-1], order[2:]], -1)
        # every second triangle of a strip is wound the other way round
        faces[1::2] = faces[1::2, [1, 0, 2]]
    elif mode == _FAN and len(order) > 2:
        faces = np.stack([np.full(len(order) - 2, order[0]), order[1:-1], order[2:]], -1)
    else:
        faces = order[: len(order) // 3 * 3].reshape(-1, 3) if mode == 4 else order[:0].reshape(-1, 3)
    a, b, c = faces.T
    good = (a != b) & (b != c) & (a != c)
    return faces if good.all() else faces[good]


def _compact(faces: NDArray[np.int64], count: int) -> tuple[NDArray[np.int64] | slice, NDArray[np.int32]]:
    """Return the vertices in use, and the faces between them. Takes time linear in the larger of the two."""
    if faces.size * 4 < count:  # a small part of a large accessor that primitives share
        used, faces = np.unique(faces, return_inverse=True)
        return used, faces.reshape(-1, 3).astype(np.int32)
    mask = np.zeros(count, bool)
    mask[faces] = True
    if mask.all():
        return slice(None), faces.astype(np.int32)
    return np.flatnonzero(mask), (np.cumsum(mask) - 1)[faces].astype(np.int32)


def _painted(
    attributes: Mapping[str, NDArray[Any]], faces: NDArray[np.int32], look: Look | None, where: str
) -> PlainMesh:
    position, normals, color = attributes["POSITION"], attributes.get("NORMAL"), attributes.get("COLOR_0")
    if normals is not None and normals.shape != position.shape:
        raise ValueError(f"{where}.attributes.NORMAL is not an accessor of VEC3")
    if color is not None and (color.ndim != 2 or color.shape[1] not in (3, 4)):
        raise ValueError(f"{where}.attributes.COLOR_0 is not an accessor of VEC3 or VEC4")
    texture, uv = (None, None) if look is None else (look.texture, attributes.get(f"TEXCOORD_{look.uv_set}"))
    if look is not None and look.alpha != "OPAQUE" and (texture is None or uv is None):
        texture, uv = _see_through(faces, color, look, len(position))
    if look is not None and uv is not None and texture is not None:
        if uv.shape != (len(position), 2):
            raise ValueError(f"{where}.attributes.TEXCOORD_{look.uv_set} is not an accessor of VEC2")
        if look.uv_transform is not None:
            uv = uv @ look.uv_transform[:, :2].T + look.uv_transform[:, 2]
        # coordinates without sense show some texel, which is better than refusing the file
        uv = np.nan_to_num(uv.astype(np.float32), posinf=0, neginf=0)
        # a palette that is see-through must stay a texture, since vertex colours have no opacity
        solid = look.alpha == "OPAQUE" or (nearest_texels(texture, uv)[:, 3] == 255).all()
        if solid and (uv[faces] == uv[faces[:, :1]]).all():  # a palette: every triangle sees one texel
            texel = bytes_to_linear(nearest_texels(texture, uv)[:, :3])
            color = texel if color is None else texel * color[:, :3]
            texture = None
    if texture is None:
        uv = None
    return PlainMesh(
        vertices=position,
        faces=faces,
        colors=_colors(color, look, len(position)),
        normals=normals,
        uv=uv,
        texture=None if uv is None else texture,
        influences=_influences(attributes, where),
    )


def _see_through(
    faces: NDArray[np.int32], color: NDArray[Any] | None, look: Look, count: int
) -> tuple[Texture | None, NDArray[Any] | None]:
    """Return a white texture with its coordinates [V, 2] where colours alone make triangles see-through.

    The result is None where colours make no triangle see-through.
    """
    alpha = np.full(count, look.opacity)
    if color is not None and color.shape[1] == 4:
        alpha = alpha * np.nan_to_num(color[:, 3].astype(np.float64)).clip(0, 1)
    if look.alpha == "MASK":
        alpha = np.where(alpha >= look.cutoff, 1.0, 0.0)
    seen = alpha[faces.ravel()]
    if (seen >= 1).all():
        return None, None
    # the centre of the texel with this opacity
    u = (alpha * 255 + 0.5) / 256
    return _white_ramp(), np.column_stack([u, np.full(count, 0.5)]).astype(np.float32)


@lru_cache(maxsize=1)
def _white_ramp() -> Texture:
    """Return a row of white texels of all opacities: a texture without any solid texel would be drawn as a solid one."""
    pixels = np.full((1, 256, 4), 255, np.uint8)
    pixels[0, :, 3] = np.arange(256)
    return Texture(pixels=pixels)


def _colors(linear: NDArray[Any] | None, look: Look | None, count: int) -> NDArray[np.uint8]:
    """Return sRGB [V, 3] of linear vertex colours times the material's factor."""
    if linear is None:
        color = DEFAULT_COLOR if look is None else linear_to_bytes(look.factor)
        return np.full((count, 3), color, np.uint8)
    rgb = np.nan_to_num(linear[:, :3].astype(np.float64))
    return linear_to_bytes(rgb if look is None else rgb * look.factor)


def nearest_texels(texture: Texture, uv: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the texels [V, 4] at texture coordinates [V, 2], which repeat outside 0..1."""
    height, width = texture.pixels.shape[:2]
    # the remainder of a tiny negative number is rounded to 1.0
    column = np.minimum((uv[:, 0] % 1.0 * width).astype(int), width - 1)
    row = np.minimum((uv[:, 1] % 1.0 * height).astype(int), height - 1)
    return texture.pixels[row, column]


def _unpacked(
    arrays: GltfArrays, packed: dict[str, Any], accessors: Mapping[str, int]
) -> tuple[dict[str, NDArray[Any]], NDArray[Any]]:
    """Return attributes and indices of a Draco primitive; ``accessors`` state which integers are normalised."""
    try:
        import DracoPy
    except ModuleNotFoundError:
        raise SceneError(
            "its triangles are compressed (Draco). Hint: pip install 'h3data[gltf]'", code="H3-MESH-014"
        ) from None
    mesh = DracoPy.decode(bytes(arrays.view(packed["bufferView"])))
    found = {}
    for name, unique_id in packed["attributes"].items():
        if _used(name):
            values = np.asarray(mesh.get_attribute_by_unique_id(unique_id)["data"])
            if entry(arrays.document, "accessors", accessors[name]).get("normalized") and values.dtype.kind in "iu":
                # as `GltfArrays.floats` does: Draco hands out integers as they are stored
                values = np.maximum(values / np.iinfo(values.dtype).max, -1)
            found[name] = values.astype(np.float32)
    return found, np.asarray(mesh.faces).astype(np.uint32).ravel()


def _object(record: dict[str, Any], key: str, where: str) -> dict[str, Any]:
    value = record.get(key, {})
    if not isinstance(value, dict):
        raise ValueError(f"{where}.{key} is not an object")
    return value
