"""Images of a scene: the plan from above."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.geometry import transform_points
from h3data.render.camera import Camera, look_at, pinhole
from h3data.render.renderer import Renderer
from h3data.render.scene import RenderInstance, RenderScene
from h3data.scene.records import Instance, Scene, instance_matrix

if TYPE_CHECKING:
    pass

PAPER = (250, 250, 248)
"""Colour of a plan outside the scene."""


def render_scene(scene: Scene, *, cut_above_y: float | None = None) -> RenderScene:
    """Return the scene as a `RenderScene`, without triangles entirely above ``cut_above_y`` [m].

    Raises:
        InputError: no triangles are left.
    """
    meshes, instances = [], []
    shared: dict[str, int] = {}
    for instance in scene.instances:
        mesh, matrix = scene.assets[instance.asset].mesh, instance_matrix(instance)
        if not len(mesh.faces):
            continue
        if cut_above_y is not None:
            height = transform_points(matrix, mesh.vertices.astype(np.float64))[:, 1]
            keep = height[mesh.faces].min(1) < cut_above_y
            if not keep.any():
                continue
            # a mesh that is cut depends on its instance's height, so it is not shared with other instances
            if not keep.all():
                textures = None if mesh.face_textures is None else mesh.face_textures[keep]
                meshes.append(replace(mesh, faces=np.ascontiguousarray(mesh.faces[keep]), face_textures=textures))
                instances.append(_placed(len(meshes) - 1, matrix, instance))
                continue
        if instance.asset not in shared:
            shared[instance.asset] = len(meshes)
            meshes.append(mesh)
        instances.append(_placed(shared[instance.asset], matrix, instance))
    if not instances:
        raise InputError(f"Scene {scene.name!r} has no triangles, so there is nothing to render.", code="H3-RENDER-069")
    return RenderScene(meshes, instances)


def _placed(mesh: int, matrix: NDArray[np.float64], instance: Instance) -> RenderInstance:
    return RenderInstance(
        mesh=mesh, matrix=matrix, semantic_id=instance.semantic_id, layer=instance.layer, name=instance.name
    )


def plan_picture(scene: Scene, *, pixels_per_m: float = 80.0, floor_y: float = 0.0) -> tuple[NDArray[np.uint8], Camera]:
    """Return an image of the scene from straight above without ceilings, RGB [H, W, 3] with -Z at the top, and the camera."""
    low, high = scene.bounds
    if scene.rooms:
        rectangles = np.concatenate([np.asarray(r.rectangles, np.float64) for r in scene.rooms])
        low, high = low.copy(), high.copy()
        low[[0, 2]], high[[0, 2]] = rectangles[:, :2].min(0), rectangles[:, 2:].max(0)
    low, high = low - 0.5, high + 0.5
    span = high - low
    width, height = (max(64, int(round(float(s) * pixels_per_m)) // 2 * 2) for s in (span[0], span[2]))
    if width * height > 60_000_000:
        raise InputError(
            f"A plan of {width}x{height} pixels is too large. Hint: fewer pixels per metre.", code="H3-RENDER-070"
        )
    middle = (low + high) / 2
    # 80 times the scene's size, at which walls lean by less than a pixel
    distance = 80.0 * float(max(span[0], span[2]))
    hfov_deg = float(np.degrees(2 * np.arctan(width / pixels_per_m / 2 / distance)))
    eye = np.array([middle[0], floor_y + distance, middle[2]])
    pose = look_at(eye, np.array([middle[0], floor_y, middle[2]]), up=(0.0, 0.0, -1.0))
    camera = pinhole(width, height, hfov_deg=hfov_deg, name="plan", pose=pose, hidden_layers=("ceiling",))
    has_layer = any(i.layer == "ceiling" for i in scene.instances)
    # scenes without a ceiling layer have their ceilings somewhere in their meshes, above head height
    visible = render_scene(scene, cut_above_y=None if has_layer else floor_y + 2.2)
    picture = Renderer(visible).render(camera, outputs=("depth", "rgb"), samples=4)
    image = picture["rgb"]
    image[picture["depth"] == 0] = PAPER
    return image, camera
