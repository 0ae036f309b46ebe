"""Per-vertex and per-face data of a scene's meshes for shading and cut-outs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.render.shade.textures import Textures


class Surface(NamedTuple):
    """Attributes of the vertices and faces of all meshes in sequence."""

    faces: NDArray[np.int32]
    """Vertices of each triangle, shape [F, 3]."""
    colors: NDArray[np.uint8]
    """Colours (sRGB) of the vertices, shape [V, 3]."""
    normals: NDArray[np.float32]
    """Unit normals of the vertices, shape [V, 3]; zero where a mesh is shaded flat."""
    packet_faces: NDArray[np.int32]
    """Face of every lane of every packet, -1 = padding, shape [P, 8]."""
    uv: NDArray[np.float32]
    """Texture coordinates [repeats], shape [V, 2]; [0, 2] if no mesh has textures."""
    face_textures: NDArray[np.int32]
    """Index into ``textures`` of each face, -1 = none, shape [F]."""
    mirrors: NDArray[np.float32]
    """Light that glossy surfaces reflect from -x, +x, +y, -z and +z, 0 = dull, shape [V, 5]; [0, 5] if none is
    glossy."""
    textures: Textures
    """The distinct textures of all meshes."""
