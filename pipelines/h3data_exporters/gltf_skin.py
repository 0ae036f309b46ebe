"""Skeletons in glTF files: joint nodes, skins, and the poses of nodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from h3data.geometry import Array, pose_from_matrix, pose_to_matrix
from h3data.mesh.glb import FLOAT32, GlbChunk, gltf_document, pack_glb, placement
from h3data.mesh.mesh import Mesh
from h3data_exporters.glb_write import mesh_lists
from h3data_exporters.posed_parts import Skeleton

Node = dict[str, Any]


def skinned_glb_bytes(mesh: Mesh, skeleton: Skeleton) -> bytes:
    """Return a GLB of one mesh in its rest pose with its skin and joints, so that other programs can pose it."""
    chunk = GlbChunk()
    rest = np.linalg.inv(skeleton.inverse_bind)
    # nodes are posed by quaternions, which have no scale
    rest[:, :3, :3] /= np.linalg.norm(rest[:, :3, :3], axis=1, keepdims=True)
    nodes: list[Node] = [{"name": "body", "mesh": 0, "skin": 0}]
    roots = add_joints(nodes, skeleton, local_poses(pose_from_matrix(rest)[None], skeleton.parents)[0])
    skins = [skin_record(chunk, skeleton, first=1)]
    lists = mesh_lists(chunk, [mesh], {0: skeleton.influences})
    document = gltf_document({"nodes": [0, *roots]}, nodes=nodes, skins=skins, **lists, **chunk.lists())
    return pack_glb(document, chunk)


def add_joints(nodes: list[Node], skeleton: Skeleton, local: Array) -> list[int]:
    """Append a node for each joint, with the pose ``local`` [J, 7] in its parent; return the root joints."""
    first = len(nodes)
    nodes += [{"name": name, **trs(pose)} for name, pose in zip(skeleton.names, local, strict=True)]
    roots = []
    for joint, parent in enumerate(skeleton.parents):
        if parent < 0:
            roots.append(first + joint)
        else:
            nodes[first + parent].setdefault("children", []).append(first + joint)
    return roots


def skin_record(chunk: GlbChunk, skeleton: Skeleton, *, first: int) -> dict[str, Any]:
    """Return a skin record whose joints are the nodes from index ``first`` on."""
    # glTF has matrices column by column
    columns = skeleton.inverse_bind.swapaxes(1, 2).reshape(-1, 16).astype("<f4")
    # exactly, as validators ask for: inverting leaves rounding there
    columns[:, 3::4] = [0, 0, 0, 1]
    binds = chunk.array(columns, "MAT4", FLOAT32)
    return {"joints": list(range(first, first + len(skeleton.names))), "inverseBindMatrices": binds}


def local_poses(world: Array, parents: Sequence[int]) -> Array:
    """Return the poses of joints in their parents' frames, [T, J, 7], from world poses."""
    matrices = pose_to_matrix(world)
    local = world.copy()
    has = np.flatnonzero(np.asarray(parents) >= 0)
    if len(has):
        inverse = np.linalg.inv(matrices[:, np.asarray(parents)[has]])
        local[:, has] = pose_from_matrix(inverse @ matrices[:, has])
    return local


def trs(pose: Array, scale: Array | None = None) -> Node:
    """Return the translation and rotation of a node, and its scale if it is not 1."""
    node = placement(pose, np.ones(3) if scale is None else scale)
    # a scale of 1 is the default, which files leave out
    if scale is None or (scale == 1).all():
        del node["scale"]
    return node
