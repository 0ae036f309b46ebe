"""Rigid pieces of skinned meshes, one for each joint, for programs that do not support skinning."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array, normalized, pose_inverse, pose_to_matrix, transform_points
from h3data.mesh.mesh import Mesh
from h3data.mesh.mesh_operations import face_texture_indices
from h3data_exporters.posed_parts import Skeleton

SHARED = 0.3
"""Least weight of a joint with which a triangle belongs to its piece; pieces overlap at bent joints to avoid gaps."""


def rigid_pieces(mesh: Mesh, skeleton: Skeleton) -> list[tuple[int, Mesh]]:
    """Return ``(joint, piece in the frame of that joint)`` for each joint that moves any triangle.

    The mesh is cut in the first posture of the skeleton, or at rest if the first is NaN. In this posture the pieces
    together equal the skinned mesh. In other postures, vertices with several joints are approximate.
    """
    joints, weights = skeleton.influences.joints, skeleton.influences.weights
    share = np.zeros((len(mesh.vertices), len(skeleton.names)), np.float32)
    # `share[...] += weights` would count a joint once that a vertex names twice
    np.add.at(share, (np.arange(len(share))[:, None], joints), weights)
    of_face = share[mesh.faces].mean(1)
    chosen = of_face >= SHARED
    # each triangle belongs to some piece, also where no joint has enough of it
    chosen[np.arange(len(chosen)), of_face.argmax(1)] = True
    vertices, normals, to_joint = _in_posture(mesh, skeleton, share)
    return [
        (j, _piece(mesh, chosen[:, j], vertices, normals, to_joint[j])) for j in np.flatnonzero(chosen.any(0)).tolist()
    ]


def _in_posture(mesh: Mesh, skeleton: Skeleton, share: Array) -> tuple[Array, Array | None, Array]:
    """Return vertices and normals [V, 3] in the first posture, in metres, and the matrices [J, 4, 4] to the joints."""
    size = np.diag([skeleton.scale] * 3 + [1.0])
    frames = skeleton.poses[0]
    if np.isfinite(frames).all():
        moved = np.einsum(
            "vj,jab->vab", share.astype(np.float64), pose_to_matrix(frames) @ size @ skeleton.inverse_bind
        )
        to_joint = pose_to_matrix(pose_inverse(frames))
    else:
        moved = np.broadcast_to(np.eye(4), (len(share), 4, 4))
        to_joint = size @ skeleton.inverse_bind
    vertices = np.einsum("vab,vb->va", moved[:, :3, :3], mesh.vertices) + moved[:, :3, 3]
    normals = None if mesh.normals is None else np.einsum("vab,vb->va", moved[:, :3, :3], mesh.normals)
    return vertices, normals, to_joint


def _piece(mesh: Mesh, faces: NDArray[np.bool_], vertices: Array, normals: Array | None, matrix: Array) -> Mesh:
    """Return the chosen triangles with their vertices taken through a 4x4 matrix."""
    used, index = np.unique(mesh.faces[faces], return_inverse=True)
    return Mesh(
        vertices=transform_points(matrix, vertices[used]).astype(np.float32),
        faces=index.reshape(-1, 3).astype(np.int32),
        colors=mesh.colors[used],
        normals=None if normals is None else normalized(normals[used] @ matrix[:3, :3].T).astype(np.float32),
        uv=None if mesh.uv is None else mesh.uv[used],
        textures=mesh.textures,
        face_textures=face_texture_indices(mesh)[faces] if mesh.textures else None,
    )
