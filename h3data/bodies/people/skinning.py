"""Linear blend skinning as one sparse matrix product.

A vertex is sum_j w_j A_j [v; 1], with A_j the 3x4 matrix of joint j times its inverse bind. The weights and the rest
vertices never change, so they go into one matrix S [V, 4J] (about 7 entries a row); the A_j of T frames make up a palette
[4J, 3T], and S times the palette is every vertex of every frame. It beats a numba loop 3x and dense GEMM 45x on one core
(research/humanoids.md 4) and is the same on a GPU.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array

if TYPE_CHECKING:
    from scipy.sparse import csr_array

CHUNK_FRAMES = 32
"""Frames per product: the palette and the result stay in the cache (the best of 1, 8, 32, 64, 256)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Skin:
    """Skin weights folded with the rest mesh."""

    points: csr_array
    """Float32 [V, 4J]."""
    normals: csr_array
    """The same with rest normals and no translation, float32 [V, 4J]."""


def build_skin(
    vertices: NDArray[np.float32],
    normals: NDArray[np.float32],
    joints: NDArray[np.integer],
    weights: NDArray[np.float32],
    joint_count: int,
) -> Skin:
    """The sparse operators of a mesh, from rest ``vertices`` and ``normals`` [V, 3], ``joints`` and ``weights`` [V, 4]."""
    ones = np.ones((len(vertices), 1), np.float32)
    return Skin(
        points=_operator(np.concatenate([vertices, ones], 1), joints, weights, joint_count),
        normals=_operator(np.concatenate([normals, 0 * ones], 1), joints, weights, joint_count),
    )


def _operator(
    homogeneous: NDArray[np.float32], joints: NDArray[np.integer], weights: NDArray[np.float32], joint_count: int
) -> csr_array:
    from scipy.sparse import coo_array

    vertex_count, influences = joints.shape
    values = weights[:, :, None] * homogeneous[:, None, :]
    columns = 4 * joints.astype(np.int32)[:, :, None] + np.arange(4, dtype=np.int32)
    rows = np.repeat(np.arange(vertex_count, dtype=np.int32), influences * 4)
    keep = values.ravel() != 0
    entries = (values.ravel()[keep].astype(np.float32), (rows[keep], columns.ravel()[keep]))
    return coo_array(entries, shape=(vertex_count, 4 * joint_count)).tocsr()


def apply_skin(operator: csr_array, matrices: Array) -> NDArray[np.float32]:
    """Skinned points (or unnormalised normals), float32 [..., V, 3], of bind-to-world ``matrices`` [..., J, 4, 4].

    The leading axes are frames, or worlds and frames; all go through the same product, a chunk at a time. The memory is
    vertex-major within a chunk of one (`CHUNK_FRAMES`) and else frame-major.
    """
    lead, joint_count = matrices.shape[:-3], matrices.shape[-3]
    flat = matrices.reshape(-1, *matrices.shape[-3:])
    vertex_count = operator.indptr.size - 1
    if len(flat) <= CHUNK_FRAMES:
        return _product(operator, flat, joint_count).reshape(*lead, vertex_count, 3)
    out = np.empty((len(flat), vertex_count, 3), np.float32)
    for start in range(0, len(flat), CHUNK_FRAMES):
        out[start : start + CHUNK_FRAMES] = _product(operator, flat[start : start + CHUNK_FRAMES], joint_count)
    return out.reshape(*lead, vertex_count, 3)


def skin_chunks(operator: csr_array, matrices: Array) -> Iterator[tuple[slice, NDArray[np.float32]]]:
    """The same in chunks, for long recordings: rows of ``matrices`` [T, J, 4, 4] and their points [t, V, 3], views of
    vertex-major memory. Copying them into place would take twice as long as computing them."""
    for start in range(0, len(matrices), CHUNK_FRAMES):
        rows = slice(start, min(start + CHUNK_FRAMES, len(matrices)))
        yield rows, _product(operator, matrices[rows], matrices.shape[1])


def _product(operator: csr_array, matrices: Array, joint_count: int) -> NDArray[np.float32]:
    palette = matrices[:, :, :3].transpose(1, 3, 0, 2).astype(np.float32).reshape(4 * joint_count, 3 * len(matrices))
    return (operator @ palette).reshape(-1, len(matrices), 3).swapaxes(0, 1)


def apply_skin_dense(
    vertices: NDArray[np.float32],
    joints: NDArray[np.integer],
    weights: NDArray[np.float32],
    matrices: Array,
) -> Array:
    """The plain definition in float64, frame by frame, [T, V, 3]: the reference that tests hold `apply_skin` against."""
    homogeneous = np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1)
    frames = []
    for frame in matrices.astype(np.float64):
        blended = np.sum(frame[joints] * weights.astype(np.float64)[..., None, None], axis=1)
        frames.append(np.einsum("vij,vj->vi", blended, homogeneous)[:, :3])
    return np.stack(frames)
