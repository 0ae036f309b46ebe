"""Triangle meshes and their textures, independent of file formats."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from h3data.errors import SceneError


@dataclass(frozen=True, kw_only=True, eq=False)
class Texture:
    """Image on a surface, repeated in both directions.

    Meshes may share a texture (the same object).
    """

    pixels: NDArray[np.uint8]
    """Colour (sRGB) and opacity of each texel, rows from the top, shape [H, W, 4]."""
    name: str = ""

    def __post_init__(self) -> None:
        p = self.pixels
        if p.ndim != 3 or p.shape[2] != 4 or not p.size or p.dtype != np.uint8:
            raise SceneError(
                f"Not a valid texture: pixels must be uint8 [H, W, 4], got {p.dtype} {list(p.shape)}.",
                code="H3-MESH-027",
            )

    def __repr__(self) -> str:
        return f"Texture({self.name!r}, {self.pixels.shape[1]}x{self.pixels.shape[0]})"


@dataclass(frozen=True, kw_only=True, eq=False)
class Mesh:
    """Triangle mesh of one asset in its own frame (+Y up) [m].

    It is immutable by convention and can be shared.
    """

    vertices: NDArray[np.float32]
    """Positions of the vertices, shape [V, 3] [m]."""
    faces: NDArray[np.int32]
    """Vertex indices, counter-clockwise from outside, shape [F, 3]."""
    colors: NDArray[np.uint8]
    """Colour (sRGB) of each vertex, shape [V, 3]."""
    normals: NDArray[np.float32] | None = None
    """Unit shading normals per vertex, shape [V, 3]; None shades every triangle flat."""
    uv: NDArray[np.float32] | None = None
    """Texture coordinates per vertex as in glTF, shape [V, 2]: (0, 0) is the image's upper left corner, (1, 1) its lower
    right one, and it repeats outside."""
    textures: tuple[Texture, ...] = ()
    """Textures of the mesh. The colour of a surface is texel times vertex colour, multiplied in linear light."""
    face_textures: NDArray[np.int16] | None = None
    """Index into ``textures`` per triangle, -1 = none, shape [F]; None gives all triangles the first texture."""

    def __post_init__(self) -> None:
        v, f, c, n, uv, textures = self.vertices, self.faces, self.colors, self.normals, self.uv, self.face_textures
        faults = []
        if v.ndim != 2 or v.shape[1:] != (3,) or v.dtype != np.float32:
            faults.append(f"vertices must be float32 [V, 3], got {v.dtype} {list(v.shape)}")
        if f.ndim != 2 or f.shape[1:] != (3,) or f.dtype != np.int32:
            faults.append(f"faces must be int32 [F, 3], got {f.dtype} {list(f.shape)}")
        elif len(f) and (f.min() < 0 or f.max() >= len(v)):
            faults.append(f"faces index vertices {f.min()}..{f.max()}, there are {len(v)}")
        if c.shape != v.shape or c.dtype != np.uint8:
            faults.append(f"colors must be uint8 [{len(v)}, 3], got {c.dtype} {list(c.shape)}")
        if n is not None and (n.shape != v.shape or n.dtype != np.float32):
            faults.append(f"normals must be float32 [{len(v)}, 3], got {n.dtype} {list(n.shape)}")
        if uv is not None and (uv.shape != (len(v), 2) or uv.dtype != np.float32):
            faults.append(f"uv must be float32 [{len(v)}, 2], got {uv.dtype} {list(uv.shape)}")
        if uv is None and self.textures:
            faults.append("textures need uv")
        if textures is not None:
            if textures.shape != (len(f),) or textures.dtype != np.int16:
                faults.append(f"face_textures must be int16 [{len(f)}], got {textures.dtype} {list(textures.shape)}")
            elif len(f) and (textures.min() < -1 or textures.max() >= len(self.textures)):
                faults.append(f"face_textures index textures up to {textures.max()}, there are {len(self.textures)}")
        if faults:
            raise SceneError("Not a valid mesh: " + "; ".join(faults) + ".", code="H3-MESH-028")

    @cached_property
    def bounds(self) -> NDArray[np.float32]:
        """Smallest and largest corner, shape [2, 3] [m]."""
        if not len(self.vertices):
            return np.zeros((2, 3), np.float32)
        return np.stack([self.vertices.min(0), self.vertices.max(0)])

    def __repr__(self) -> str:
        return f"Mesh({len(self.vertices)} vertices, {len(self.faces)} triangles)"
