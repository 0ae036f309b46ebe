"""Export of a home's building for habitat-sim, with its parts as nodes of a GLB, without the roof."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import transform_points
from h3data.mesh.mesh import Mesh
from h3data.scene.records import Instance, Scene, instance_matrix
from h3data_exporters.glb_write import GlbNode

_CEILING_SLACK_M = 0.01


def building_parts(scene: Scene, stage: Sequence[Instance]) -> tuple[list[Mesh], list[GlbNode]]:
    """Return the meshes, and the nodes that place them, with category, semantic id and layer in ``extras["h3data"]``."""
    meshes: list[Mesh] = []
    shared: dict[str, int] = {}
    nodes = []
    ceilings = [_world_box(scene, i) for i in stage if scene.assets[i.asset].category == "ceiling"]
    for instance in stage:
        asset = scene.assets[instance.asset]
        mesh = _without_roof(asset.mesh, instance_matrix(instance), ceilings)
        if not len(mesh.faces):
            continue
        # only whole meshes are shared: what was cut from a roof depends on the place
        number = shared.get(instance.asset) if mesh is asset.mesh else None
        if number is None:
            number = len(meshes)
            meshes.append(mesh)
            if mesh is asset.mesh:
                shared[instance.asset] = number
        extras = {"category": asset.category, "semantic_id": int(instance.semantic_id), "layer": instance.layer}
        nodes.append(
            GlbNode(
                name=instance.name,
                mesh=number,
                pose=instance.pose,
                scale=instance.scale,
                extras={"h3data": extras},
            )
        )
    return meshes, nodes


def speck(scene: Scene, stage: Sequence[Instance]) -> Mesh:
    """Return a triangle of 0.1 mm in a lower corner of the building, because a stage must have something to render."""
    corner = np.min([_world_box(scene, i)[0] for i in stage], axis=0)
    return Mesh(
        vertices=(corner + 1e-4 * np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0]])).astype(np.float32),
        faces=np.array([[0, 1, 2]], np.int32),
        colors=np.full((3, 3), 128, np.uint8),
    )


def parts_by_class(meshes: Sequence[Mesh], nodes: Sequence[GlbNode]) -> list[tuple[list[Mesh], list[GlbNode]]]:
    """Return meshes and nodes grouped by category, semantic id and layer, in the order of their first occurrence."""
    classes: dict[tuple[object, ...], tuple[list[Mesh], list[GlbNode]]] = {}
    for node in nodes:
        own_meshes, own_nodes = classes.setdefault(tuple(node.extras["h3data"].values()), ([], []))
        mesh = meshes[node.mesh]
        number = next((k for k, m in enumerate(own_meshes) if m is mesh), len(own_meshes))
        if number == len(own_meshes):
            own_meshes.append(mesh)
        own_nodes.append(replace(node, mesh=number))
    return list(classes.values())


def _world_box(scene: Scene, instance: Instance) -> NDArray[np.float64]:
    """Return the lower and upper corner [2, 3] [m] of an instance in the world."""
    points = transform_points(instance_matrix(instance), scene.assets[instance.asset].mesh.vertices.astype(np.float64))
    return np.stack([points.min(0), points.max(0)])


def _without_roof(mesh: Mesh, matrix: NDArray[np.float64], ceilings: Sequence[NDArray[np.float64]]) -> Mesh:
    """Return the mesh without upward faces on or in a ceiling, which are invisible from inside.

    habitat-sim bakes its navmesh from the stage: the roof was the largest island. A ceiling whose underside alone is left
    is too steep to walk on, and tops of walls in it would lend it their walkability (``rcAddSpan`` merges spans).
    """
    corners = transform_points(matrix, mesh.vertices.astype(np.float64))[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # within 60 degrees of straight up, as slanting roofs are
    upward = normal[:, 1] > 0.5 * np.linalg.norm(normal, axis=1)
    middle, roof = corners.mean(1), np.zeros(len(corners), bool)
    for low, high in ceilings:
        roof |= ((middle >= low - _CEILING_SLACK_M) & (middle <= high + _CEILING_SLACK_M)).all(1)
    kept = ~(upward & roof)
    if kept.all():
        return mesh
    textures = None if mesh.face_textures is None else mesh.face_textures[kept]
    return replace(mesh, faces=np.ascontiguousarray(mesh.faces[kept]), face_textures=textures)
