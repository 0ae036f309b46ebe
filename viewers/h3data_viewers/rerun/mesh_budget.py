"""Reduction of meshes for a viewer file by clustered vertices, smaller textures, and flat facets without normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.mesh.gltf_primitives import nearest_texels
from h3data.mesh.images import reduced, reduced_size
from h3data.mesh.mesh import Mesh, Texture
from h3data.mesh.mesh_operations import face_texture_indices
from h3data.mesh.thinning import thin_mesh
from h3data.srgb import bytes_to_linear, linear_to_bytes


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewMesh:
    """Mesh arrays in the layout of Rerun's `Mesh3D`: triangles with at most one texture."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32] | None
    """Vertex indices [F, 3]; None: every three consecutive vertices form a triangle, which the viewer shades flat."""
    colors: NDArray[np.uint8]
    normals: NDArray[np.float32] | None
    uv: NDArray[np.float32] | None = None
    texture: Texture | None = None
    """Texture, if any; the surface colour is the texel times the vertex colour. The viewer treats every texel as
    opaque."""

    @property
    def nbytes(self) -> int:
        """Size of the arrays without the texture [bytes]; colours count with alpha."""
        arrays = (self.vertices, self.faces, self.normals, self.uv)
        return 4 * len(self.colors) + sum(a.nbytes for a in arrays if a is not None)


def view_mesh(mesh: Mesh, *, max_vertices: int | None = None) -> list[ViewMesh]:
    """Split a mesh into parts for the viewer: one per texture and one for untextured faces.

    A mesh without normals becomes flat facets. A mesh with more than ``max_vertices`` is thinned, and its textures become
    vertex colours, because thinning merges vertices across the seams of a texture atlas.
    """
    if max_vertices is not None and len(mesh.vertices) > max_vertices:
        thin = thin_mesh(mesh, max_vertices)
        normals = None if mesh.normals is None else mesh.normals[thin.keep]
        colors = baked_colors(mesh)[thin.keep]
        return [ViewMesh(vertices=mesh.vertices[thin.keep], faces=thin.faces, colors=colors, normals=normals)]
    if not mesh.textures:
        if mesh.normals is None:
            return [_part(mesh, mesh.faces, None, None)]
        return [ViewMesh(vertices=mesh.vertices, faces=mesh.faces, colors=mesh.colors, normals=mesh.normals)]
    index = face_texture_indices(mesh)
    return [
        _part(mesh, mesh.faces[index == k], None if k < 0 else mesh.uv, None if k < 0 else mesh.textures[k])
        for k in np.unique(index)
    ]


def _part(mesh: Mesh, faces: NDArray[np.int32], uv: NDArray[np.float32] | None, texture: Texture | None) -> ViewMesh:
    """Select triangles of a mesh and the vertices they use."""
    if mesh.normals is None:
        # facets share no vertices, else the viewer would smooth their shading
        used, corners = faces.reshape(-1), None
    else:
        used, inverse = np.unique(faces, return_inverse=True)
        corners = inverse.reshape(-1, 3).astype(np.int32)
    return ViewMesh(
        vertices=mesh.vertices[used],
        faces=corners,
        colors=mesh.colors[used],
        normals=None if mesh.normals is None else mesh.normals[used],
        uv=None if uv is None else uv[used],
        texture=texture,
    )


def baked_colors(mesh: Mesh) -> NDArray[np.uint8]:
    """Return the vertex colours [V, 3] (sRGB) multiplied by the texture's colour at each vertex.

    A vertex that several textures share has the colour of its last triangle.
    """
    if mesh.uv is None or not mesh.textures:
        return mesh.colors
    index, texture_of = face_texture_indices(mesh), np.full(len(mesh.vertices), -1)
    texture_of[mesh.faces.reshape(-1)] = np.repeat(index, 3)
    colors = mesh.colors.copy()
    for k, texture in enumerate(mesh.textures):
        selected = texture_of == k
        # one texel is read for each vertex: in a small picture it is the mean of its area, not a speck of the pattern
        small = Texture(pixels=reduced(texture.pixels, 64))
        texels = nearest_texels(small, mesh.uv[selected])[:, :3]
        # colours multiply as light, not as bytes of sRGB
        colors[selected] = linear_to_bytes(bytes_to_linear(texels) * bytes_to_linear(colors[selected]))
    return colors


def view_texture(texture: Texture, side: int) -> NDArray[np.uint8]:
    """Reduce a texture to at most ``side`` x ``side`` texels, [H, W, 3] (sRGB)."""
    return np.ascontiguousarray(reduced(texture.pixels, side)[..., :3])


def texture_bytes(texture: Texture, side: int) -> int:
    """Return the size of the array that `view_texture` returns [bytes]."""
    height, width = texture.pixels.shape[:2]
    columns, rows = reduced_size(width, height, side)
    return 3 * columns * rows
