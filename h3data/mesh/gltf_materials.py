"""Materials of a glTF document: base colour factor, texture and texture coordinates."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import SceneError
from h3data.mesh.accessors import GltfArrays, entry, natural
from h3data.mesh.images import Alpha, image_size, image_texture, largest_side
from h3data.mesh.mesh import Texture


@dataclass(frozen=True, kw_only=True, eq=False)
class Look:
    """Appearance of the triangles of one material."""

    factor: NDArray[np.float64]
    """Linear base colour, shape [3]."""
    alpha: Alpha = "OPAQUE"
    """Meaning of opacity: none, a cut at ``cutoff``, or the transparency of the surface."""
    cutoff: float = 0.5
    opacity: float = 1.0
    texture: Texture | None = None
    uv_set: int = 0
    """Number n of the attribute ``TEXCOORD_n``."""
    uv_transform: NDArray[np.float64] | None = None
    """Matrix [2, 3] applied to the file's texture coordinates; None for no change."""


class GltfMaterials:
    """Materials of one glTF document.

    Materials with unreadable images have their colour factor alone, and one warning reports all such images.
    """

    def __init__(self, arrays: GltfArrays, resource: Callable[[str], bytes], where: str) -> None:
        self._arrays, self._document, self._resource, self._where = arrays, arrays.document, resource, where
        self._looks: dict[int, Look] = {}
        self._images: dict[int, bytes | memoryview] = {}
        self._side: int | None = None
        self._warned = False

    def look(self, index: object) -> Look:
        """Return the appearance of ``materials[index]``."""
        record = entry(self._document, "materials", index)
        assert isinstance(index, int)
        if index not in self._looks:
            self._looks[index] = self._read(record, f"materials[{index}]")
        return self._looks[index]

    def _read(self, record: dict[str, Any], where: str) -> Look:
        factor, info = _base_color(record)
        rgb = np.array([1, 1, 1] if factor is None else factor[:3], np.float64)
        if rgb.shape != (3,) or not np.isfinite(rgb).all():
            raise ValueError(f"{where} has the base colour {factor!r}, not 4 numbers")
        opacity = 1.0 if factor is None or len(factor) < 4 else float(factor[3])
        if not 0 <= opacity <= 1:
            raise ValueError(f"{where} has the opacity {factor!r}[3], not between 0 and 1")
        modes: Mapping[str, Alpha] = {"OPAQUE": "OPAQUE", "MASK": "MASK", "BLEND": "BLEND"}
        alpha, cutoff = (
            modes.get(record.get("alphaMode", "OPAQUE"), "OPAQUE"),
            float(record.get("alphaCutoff", 0.5)),
        )
        if info is None:
            return Look(factor=rgb, alpha=alpha, cutoff=cutoff, opacity=opacity)
        texture = self._texture(info, where, alpha, cutoff, opacity)
        moved = info.get("extensions", {}).get("KHR_texture_transform", {})
        uv_set = natural(moved, "texCoord", where, natural(info, "texCoord", where, 0))
        return Look(
            factor=rgb,
            alpha=alpha,
            cutoff=cutoff,
            opacity=opacity,
            texture=texture,
            uv_set=uv_set,
            uv_transform=_uv_transform(moved, where),
        )

    def _texture(self, info: dict[str, Any], where: str, alpha: Alpha, cutoff: float, opacity: float) -> Texture | None:
        fault = f"{where} names no image"
        # files may give an image twice, plain and compressed: the first that can be read is taken
        for index in self._sources(info):
            try:
                data = self._image(index)
                name = str(entry(self._document, "images", index).get("name", ""))
                side = self._largest_side()
                return image_texture(data, name=name, side=side, alpha=alpha, cutoff=cutoff, opacity=opacity)
            except SceneError as reason:
                fault = f"images[{index}]: {reason}"
        if not self._warned:
            logging.getLogger(__name__).warning(
                "a texture is left out, its surfaces show their material's colour (%s): %s", fault, self._where
            )
            self._warned = True
        return None

    def _sources(self, info: dict[str, Any]) -> list[int]:
        """Return images that hold a texture, the plain one first."""
        texture = entry(self._document, "textures", info.get("index"))
        extensions = texture.get("extensions", {})
        kinds = ("EXT_texture_webp", "KHR_texture_basisu", "KHR_texture_ktx")
        records = [texture, *(extensions[name] for name in kinds if name in extensions)]
        return [r["source"] for r in records if "source" in r]

    def _image(self, index: int) -> bytes | memoryview:
        """Return the encoded bytes of ``images[index]``."""
        if index not in self._images:
            record = entry(self._document, "images", index)
            if "bufferView" in record:
                self._images[index] = self._arrays.view(record["bufferView"])
            else:
                self._images[index] = self._resource(record.get("uri", ""))
        return self._images[index]

    def _largest_side(self) -> int:
        """Return the largest side [px] of images, chosen so that all base colour textures fit into memory."""
        if self._side is None:
            # of base colours alone: normal maps and the like are never decoded
            wanted = set()
            for material in self._document.get("materials", []):
                info = _base_color(material)[1]
                wanted |= set() if info is None else set(self._sources(info))
            sizes = []
            for index in wanted:
                try:
                    sizes.append(image_size(self._image(index)))
                except SceneError:
                    continue  # reported when the image is needed
            self._side = largest_side(sizes)
        return self._side


def _base_color(material: dict[str, Any]) -> tuple[list[float] | None, dict[str, Any] | None]:
    """Return the factor and texture of a material, metallic-roughness or the older specular-glossiness."""
    # before metallic-roughness, which files with this extension give for readers that do not know it
    older = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
    if older is not None:
        return older.get("diffuseFactor"), older.get("diffuseTexture")
    metallic = material.get("pbrMetallicRoughness", {})
    return metallic.get("baseColorFactor"), metallic.get("baseColorTexture")


def _uv_transform(moved: dict[str, Any], where: str) -> NDArray[np.float64] | None:
    """Return the matrix [2, 3] of KHR_texture_transform: scale, rotate counter-clockwise as seen on the image, translate."""
    if not {"offset", "rotation", "scale"} & set(moved):
        return None
    offset = np.array(moved.get("offset", (0, 0)), np.float64)
    scale = np.array(moved.get("scale", (1, 1)), np.float64)
    angle = float(moved.get("rotation", 0))
    if offset.shape != (2,) or scale.shape != (2,) or not np.isfinite([*offset, *scale, angle]).all():
        raise ValueError(f"{where} has a KHR_texture_transform that is not one: {moved!r}")
    cos, sin = np.cos(angle), np.sin(angle)
    return np.column_stack([np.array([[cos, sin], [-sin, cos]]) * scale, offset])
