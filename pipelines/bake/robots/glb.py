"""Meshes of links as small GLB files: one unmoved node, one primitive and one plain material per colour."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from h3data.mesh.glb import UINT16, GlbChunk, gltf_document, pack_glb
from h3data.mesh.mesh import Mesh
from h3data.srgb import bytes_to_linear


def write_link_glb(path: Path, mesh: Mesh) -> None:
    """Write a mesh with normals and without textures; the same mesh gives the same bytes."""
    assert mesh.normals is not None
    palette, index = np.unique(mesh.colors, axis=0, return_inverse=True)
    face_color = index.ravel()[mesh.faces[:, 0]]
    chunk, primitives, materials = GlbChunk(), [], []
    for k, color in enumerate(palette):
        used, faces = np.unique(mesh.faces[face_color == k], return_inverse=True)
        if not len(used):
            continue
        linear = [round(float(v), 6) for v in bytes_to_linear(color)]
        look = {"baseColorFactor": [*linear, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.6}
        materials.append({"pbrMetallicRoughness": look})
        attributes = {
            "POSITION": chunk.vectors(mesh.vertices[used], limits=True),
            "NORMAL": chunk.vectors(mesh.normals[used], limits=True),
        }
        indices = chunk.triangles(faces, UINT16)
        primitives.append({"attributes": attributes, "indices": indices, "material": len(materials) - 1})
    document = gltf_document(
        {"nodes": [0]}, nodes=[{"mesh": 0}], meshes=[{"primitives": primitives}], materials=materials, **chunk.lists()
    )
    path.write_bytes(pack_glb(document, chunk))
