"""Builds small GLBs for tests of reading them."""

from __future__ import annotations

import io
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from h3data.mesh.glb import GlbChunk, pack_glb
from h3data.mesh.loading import load_mesh
from h3data.mesh.mesh import Mesh

FLOAT, U8, U16, U32, I8 = 5126, 5121, 5123, 5125, 5120
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
TWO = np.array([0, 1, 2, 0, 2, 3], np.uint16)
COLORS = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0]], np.uint8).reshape(2, 2, 3)


def encoded(pixels: np.ndarray, kind: str = "PNG", **options: Any) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format=kind, **options)
    return file.getvalue()


class Builder:
    """A GLB with one square, to which tests add what they are about."""

    def __init__(self) -> None:
        self.chunk = GlbChunk()
        self.primitive: dict[str, Any] = {
            "attributes": {
                "POSITION": self.chunk.array(SQUARE, "VEC3", FLOAT),
                "TEXCOORD_0": self.chunk.array(UV, "VEC2", FLOAT),
            },
            "indices": self.chunk.array(TWO, "SCALAR", U16),
        }
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [self.primitive]}],
        }

    def attribute(self, name: str, values: np.ndarray, kind: str, component: int, **more: Any) -> None:
        self.primitive["attributes"][name] = self.chunk.array(values, kind, component, **more)

    def image(self, data: bytes, material: dict[str, Any] | None = None, **texture: Any) -> None:
        """Gives the square a material with this image."""
        stored = self.document.setdefault("images", [])
        stored.append({"bufferView": self.chunk.view(data), "mimeType": "image/png"})
        textures = self.document.setdefault("textures", [])
        textures.append(texture or {"source": len(stored) - 1})
        pbr = {"baseColorTexture": {"index": len(textures) - 1}}
        material = {"pbrMetallicRoughness": pbr, **(material or {})}
        self.document.setdefault("materials", []).append(material)
        self.primitive["material"] = len(self.document["materials"]) - 1

    def data(self) -> bytes:
        sizes = [{"byteLength": self.chunk.size}]
        more = {"accessors": self.chunk.accessors, "bufferViews": self.chunk.views, "buffers": sizes}
        return pack_glb({**more, **self.document}, self.chunk)

    def mesh(self, folder: Path) -> Mesh:
        path = folder / f"{len(list(folder.iterdir()))}.glb"
        path.write_bytes(self.data())
        return load_mesh(path)


def separate(build: Builder, folder: Path, **uris: str) -> Path:
    """The same as a .gltf with its bytes in a file beside."""
    folder.mkdir(exist_ok=True)
    data = b"".join(build.chunk.parts)
    (folder / "some bytes.bin").write_bytes(data)
    document = {
        **build.document,
        "accessors": build.chunk.accessors,
        "bufferViews": build.chunk.views,
        "buffers": [{"byteLength": len(data), "uri": uris.get("buffer", "some%20bytes.bin")}],
    }
    if "image" in uris:
        document["images"] = [{"uri": uris["image"]}]
    path = folder / "x.gltf"
    path.write_text(json.dumps(document))
    os.utime(path, ns=(len(list(folder.iterdir())), hash(str(uris)) % 2**40))
    return path
