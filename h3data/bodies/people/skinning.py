"""Skinning as one sparse matrix product, with half joints that keep bent joints from collapsing.

A vertex is sum_j w_j A_j [v; 1], with A_j the 3x4 matrix of joint j times its inverse bind. The weights and the rest
vertices never change, so they go into one matrix S [V, 4J] (about 7 entries a row); the A_j of T frames make up a
palette [4J, 3T], and S times the palette is every vertex of every frame. On one core, this is 3 times as fast as a
numba loop and 45 times as fast as a dense product (research/humanoids.md 4). The method is the same on a GPU.

A linear blend of two rotations that are an angle a apart shrinks the skin towards the joint, to cos(a / 2) of its distance
where both weights are equal: 0.42 for a knee bent by 130 degrees. `with_half_joints` therefore moves the weight that two
neighbours share to a joint half way between them (Mohr and Gleicher, Building Efficient, Accurate Character Skins from
Examples, 2003). Rotations that are blended are then a / 2 apart at most: 1 where both weights were equal, and not below
0.84 elsewhere. The skin stays a linear blend, so that files and programs that know only such skins have the same shape.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.people.skeleton import HALF_JOINTS, JOINT_COUNT, PARENTS
from h3data.geometry import Array

if TYPE_CHECKING:
    from scipy.sparse import csr_array

FEW_FRAMES = 8
"""Number of frames up to which `apply_skin_frames` is faster than `apply_skin` (one frame: 0.13 ms instead of 0.73
ms)."""
CHUNK_FRAMES = 32
"""Number of frames per product: the palette and the result stay in the cache (the best of 1, 8, 32, 64, 256)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Skin:
    """Skin weights folded with the rest mesh."""

    points: csr_array
    """Matrix that gives the vertices when multiplied with the joints' matrices, float32 [V, 4J]."""
    normals: csr_array
    """Matrix that gives the normals in the same way, without translation, float32 [V, 4J]."""

    @cached_property
    def frame(self) -> FrameOperator:
        """Operator ``points`` for a single frame: its rows in groups with the same columns, built at first use."""
        groups: dict[bytes, list[int]] = {}
        starts: Any = self.points.indptr
        # the bytes of a row's columns as a key: vertices that move with the same joints have equal ones
        for row, (begin, end) in enumerate(pairwise(starts.tolist())):
            groups.setdefault(self.points.indices[begin:end].astype(np.int32).tobytes(), []).append(row)
        columns = [np.frombuffer(key, np.int32) for key in groups]
        at = [starts[rows] + np.arange(len(own))[:, None] for rows, own in zip(groups.values(), columns, strict=True)]
        return FrameOperator(
            rows=np.concatenate([np.array(rows, np.int32) for rows in groups.values()]),
            row_starts=np.cumsum([0, *map(len, groups.values())], dtype=np.int32),
            columns=np.concatenate(columns),
            column_starts=np.cumsum([0, *map(len, columns)], dtype=np.int32),
            values=np.concatenate([np.asarray(self.points.data, np.float32)[places].ravel() for places in at]),
        )


class Influences(NamedTuple):
    """Joints of a skin that move each vertex of a mesh, with their weights."""

    joints: NDArray[np.uint8]
    """Indices into the joints of the skin, shape [V, 4]."""
    weights: NDArray[np.float32]
    """Weights of the joints, which sum to 1, shape [V, 4]."""


def with_half_joints(joints: NDArray[np.integer], weights: NDArray[np.float32]) -> Influences:
    """Move weight that a joint and its parent share to their half joint (`HALF_JOINTS`).

    Weights of 1 - w and w become 1 - 2w, 2w of the half joint and 0 if w is below a half, and else 0, 2 - 2w and 2w - 1. At the
    hips less is moved.

    Args:
        joints: joints that move each vertex [V, 4].
        weights: weights of these joints [V, 4].
    """
    halves, count = np.fromiter(HALF_JOINTS.values(), np.intp), JOINT_COUNT + len(HALF_JOINTS)
    parents = np.array(PARENTS)[halves]
    dense = np.zeros((len(joints), count))
    np.add.at(dense, (np.arange(len(joints))[:, None], joints), weights)
    rows = np.flatnonzero((dense[:, halves] * dense[:, parents]).any(1))
    of_joint, of_parent = dense[rows][:, halves], dense[rows][:, parents]
    # both legs move skirts, which hang between them and do not collapse: there neither leg's half joint takes weight. Half
    # joints of hips take half as much elsewhere, too: postures on seats are those of plain skin, since recordings depend on
    # them, and all of the weight would push a dress 28 mm into a low seat
    both = np.maximum(of_joint @ (parents[:, None] == parents), 1e-9)
    alone = np.clip(2 * of_joint / both - 1, 0, 1) * np.where(parents == 0, 0.5, 1.0)
    taken = np.eye(count)[halves] + np.eye(count)[parents]
    moved = dense[rows] + np.minimum(of_joint, of_parent) * alone @ (2 * np.eye(count)[JOINT_COUNT:] - taken)
    # a vertex keeps its four greatest weights, as in files
    slots = np.argsort(-moved, axis=1, kind="stable")[:, :4]
    # what is left of equal weights is rounding
    shares = np.take_along_axis(np.where(moved < 1e-6, 0, moved), slots, 1)
    found = Influences(joints.astype(np.uint8), weights.astype(np.float32))
    found.joints[rows], found.weights[rows] = slots, shares / shares.sum(1, keepdims=True)
    return found


class FrameOperator(NamedTuple):
    """Rows of a sparse operator in groups with the same columns, so that all vertices of a group are summed together.

    A frame of 24,741 vertices takes 0.13 ms; SciPy's product takes 0.72 ms.
    """

    rows: NDArray[np.int32]
    """Row of the operator for each position in the grouped order, shape [V]."""
    row_starts: NDArray[np.int32]
    """First position of each group, then V, shape [G + 1]."""
    columns: NDArray[np.int32]
    """Columns of all groups in sequence."""
    column_starts: NDArray[np.int32]
    """First of each group's columns, then their number, shape [G + 1]."""
    values: NDArray[np.float32]
    """Entries of the operator, ordered by group, then by column, then by vertex."""


class SkinBounds(NamedTuple):
    """Spheres that bound a skinned mesh in any pose.

    The vertices that move with the same joints are one group. Moved by one of these joints alone, they stay in one
    sphere; skinned vertices therefore lie in the convex hull of the group's spheres.
    """

    joints: NDArray[np.intp]
    """Joint that moves each sphere, shape [K]."""
    centers: Array
    """Centres in the rest mesh, shape [K, 3] [m]."""
    radii: Array
    """Radii of the balls that bound the skin, shape [K] [m]."""
    starts: NDArray[np.intp]
    """First sphere of each group, shape [G], then K."""

    def posed(self, matrices: Array) -> Array:
        """Return the world centres [..., K, 3] of the spheres for ``matrices`` [..., J, 4, 4] of `Humanoid.skin_matrices`."""
        from h3data.bodies.people.kernels.skin import pose_centers

        flat = np.ascontiguousarray(matrices, np.float64).reshape(-1, *matrices.shape[-3:])
        out = np.empty((len(flat), len(self.joints), 3))
        pose_centers(flat, self.joints, self.centers, out)
        return out.reshape(*matrices.shape[:-3], *out.shape[1:])


def build_skin_bounds(
    vertices: NDArray[np.float32], joints: NDArray[np.integer], weights: NDArray[np.float32]
) -> SkinBounds:
    """Compute the bounding spheres of a mesh.

    Args:
        vertices: vertices at rest [V, 3] [m].
        joints: joints that move each vertex [V, 4].
        weights: weights of these joints [V, 4].
    """
    used = np.sort(np.where(weights > 0, joints.astype(np.int64), -1), axis=1)
    # a vertex may name a joint twice, with two weights
    used[:, 1:][used[:, 1:] == used[:, :-1]] = -1
    sets, group_of = np.unique(np.sort(used, axis=1), axis=0, return_inverse=True)
    middles, radii = np.zeros((len(sets), 3)), np.zeros(len(sets))
    for group in range(len(sets)):
        own = vertices[group_of.reshape(-1) == group].astype(np.float64)
        middles[group] = (own.min(0) + own.max(0)) / 2
        radii[group] = np.linalg.norm(own - middles[group], axis=1).max()
    group, column = np.nonzero(sets >= 0)
    return SkinBounds(
        joints=sets[group, column],
        centers=middles[group],
        radii=radii[group],
        starts=np.flatnonzero(np.diff(group, prepend=-1, append=len(sets))),
    )


def build_skin(
    vertices: NDArray[np.float32],
    normals: NDArray[np.float32] | None,
    joints: NDArray[np.integer],
    weights: NDArray[np.float32],
    joint_count: int,
) -> Skin:
    """Build the sparse operators of a mesh from rest ``vertices`` and ``normals`` [V, 3], ``joints`` and ``weights`` [V, 4].

    Without normals, their operator is zero.
    """
    ones = np.ones((len(vertices), 1), np.float32)
    return Skin(
        points=_operator(np.concatenate([vertices, ones], 1), joints, weights, joint_count),
        # 0 instead of 1: directions do not move with the places of joints
        normals=_operator(
            np.concatenate([0 * vertices if normals is None else normals, 0 * ones], 1), joints, weights, joint_count
        ),
    )


def _operator(
    homogeneous: NDArray[np.float32], joints: NDArray[np.integer], weights: NDArray[np.float32], joint_count: int
) -> csr_array:
    from scipy.sparse import coo_array

    vertex_count, influences = joints.shape
    values = weights[:, :, None] * homogeneous[:, None, :]
    columns = 4 * joints.astype(np.int32)[:, :, None] + np.arange(4, dtype=np.int32)
    rows = np.repeat(np.arange(vertex_count, dtype=np.int32), influences * 4)
    # most vertices move with fewer than four joints: 1.8 on the mean
    keep = values.ravel() != 0
    entries = (values.ravel()[keep].astype(np.float32), (rows[keep], columns.ravel()[keep]))
    # entries of one place are summed, so a joint that is named twice counts with both weights
    return coo_array(entries, shape=(vertex_count, 4 * joint_count)).tocsr()


def apply_skin(operator: csr_array, matrices: Array) -> NDArray[np.float32]:
    """Return skinned points (or unnormalised normals), float32 [..., V, 3], of bind-to-world ``matrices`` [..., J, 4, 4].

    The leading axes are frames, or worlds and frames; the product is computed in chunks of frames. The memory is
    vertex-major if one chunk (`CHUNK_FRAMES`) holds all frames, else frame-major.
    """
    lead, joint_count = matrices.shape[:-3], matrices.shape[-3]
    flat, vertex_count = matrices.reshape(-1, *matrices.shape[-3:]), operator.indptr.size - 1
    if len(flat) <= CHUNK_FRAMES:
        return _product(operator, flat, joint_count).reshape(*lead, vertex_count, 3)
    out = np.empty((len(flat), vertex_count, 3), np.float32)
    for start in range(0, len(flat), CHUNK_FRAMES):
        out[start : start + CHUNK_FRAMES] = _product(operator, flat[start : start + CHUNK_FRAMES], joint_count)
    return out.reshape(*lead, vertex_count, 3)


def apply_skin_frames(operator: FrameOperator, matrices: Array) -> NDArray[np.float32]:
    """Return the skinned points, float32 [T, V, 3], for bind-to-world ``matrices`` [T, J, 4, 4], frame by frame.

    The points equal those of `apply_skin` bit for bit, and are computed faster for up to `FEW_FRAMES` frames.
    """
    from h3data.bodies.people.kernels.skin import frame_product

    palettes = np.ascontiguousarray(matrices[:, :, :3].transpose(0, 1, 3, 2), np.float32)
    out = np.empty((len(matrices), len(operator.rows), 3), np.float32)
    for palette, points in zip(palettes.reshape(len(matrices), -1, 3), out, strict=True):
        frame_product(operator, palette, points)
    return out


def skin_chunks(operator: csr_array, matrices: Array) -> Iterator[tuple[slice, NDArray[np.float32]]]:
    """Yield skinned points of long recordings, in chunks.

    Yields slices of the rows of ``matrices`` [T, J, 4, 4] and their points [t, V, 3], which are views of vertex-major
    memory: copying them into place would take twice as long as computing them.
    """
    for start in range(0, len(matrices), CHUNK_FRAMES):
        rows = slice(start, min(start + CHUNK_FRAMES, len(matrices)))
        yield rows, _product(operator, matrices[rows], matrices.shape[1])


def _product(operator: csr_array, matrices: Array, joint_count: int) -> NDArray[np.float32]:
    palette = matrices[:, :, :3].transpose(1, 3, 0, 2).astype(np.float32).reshape(4 * joint_count, 3 * len(matrices))
    return (operator @ palette).reshape(-1, len(matrices), 3).swapaxes(0, 1)
