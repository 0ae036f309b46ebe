"""Readers of mesh files other than glTF (Collada, OBJ, PLY, STL) for the group ``h3data.meshes``, and a glTF codec."""

from pathlib import Path

import numpy as np

from h3data.geometry import Array
from h3data.mesh.mesh import Mesh
from h3data_meshes.collada import read_collada
from h3data_meshes.trimesh_files import FilesBeside, read_with_trimesh


def collada_parts(path: Path) -> list[tuple[Mesh, Array]]:
    """Return the parts of a Collada file, with the 4x4 matrices that place them."""
    beside = FilesBeside(path)
    parts = [(part.mesh, part.matrix) for part in read_collada(path, beside.get)]
    beside.warn()
    return parts


def trimesh_parts(path: Path) -> list[tuple[Mesh, Array]]:
    """Return the parts of an OBJ, PLY or STL file, with identity matrices."""
    return [(part, np.eye(4)) for part in read_with_trimesh(path)]
