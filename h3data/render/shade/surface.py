"""What shading and cut-outs need to know of the meshes of a scene."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.render.shade.textures import Textures


class Surface(NamedTuple):
    """What shading needs to know of the meshes; vertices of all meshes one after another."""

    faces: NDArray[np.int32]
    """Shape [F, 3]."""
    colors: NDArray[np.uint8]
    """sRGB, shape [V, 3]."""
    normals: NDArray[np.float32]
    """Shape [V, 3]; zero where a mesh is shaded flat."""
    packet_faces: NDArray[np.int32]
    """Face of every lane of every packet, -1 = padding, shape [P, 8]."""
    uv: NDArray[np.float32]
    """Texture coordinates [repeats], shape [V, 2]; [0, 2] if no mesh has any textures."""
    face_textures: NDArray[np.int32]
    """Index into ``textures``, -1 = none, shape [F]."""
    textures: Textures
    """Those of all meshes, each once."""
