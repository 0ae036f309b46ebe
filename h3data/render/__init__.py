"""Cameras, renderers (`Renderer`: one interface to all back ends), colour maps, overlays, pictures and videos.

`Camera` and its helpers are cheap; everything else is imported at its first use (numba, OpenCV, PyAV).
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from h3data.render.camera import (
    CONVENTIONS,
    OPENGL_TO_OPENCV,
    Camera,
    camera_from_matrix,
    equirectangular,
    fisheye,
    look_at,
    orthographic,
    pinhole,
)

if TYPE_CHECKING:
    from h3data.render import overlay
    from h3data.render.colors import depth_to_rgb, instance_to_rgb, normalize_depth
    from h3data.render.files import write_depth_png, write_png
    from h3data.render.motion import Boxes, flow_to_rgb, optical_flow, visible_boxes, visible_masks
    from h3data.render.pictures import Output, Poses
    from h3data.render.rays import RayCaster, lidar
    from h3data.render.renderer import Renderer
    from h3data.render.scene import RenderInstance, RenderScene
    from h3data.render.shade.shading import Light
    from h3data.render.video import VideoWriter

__all__ = [
    "CONVENTIONS",
    "OPENGL_TO_OPENCV",
    "Boxes",
    "Camera",
    "Light",
    "Output",
    "Poses",
    "RayCaster",
    "RenderInstance",
    "RenderScene",
    "Renderer",
    "VideoWriter",
    "camera_from_matrix",
    "depth_to_rgb",
    "equirectangular",
    "fisheye",
    "flow_to_rgb",
    "instance_to_rgb",
    "lidar",
    "look_at",
    "normalize_depth",
    "optical_flow",
    "orthographic",
    "overlay",
    "pinhole",
    "visible_boxes",
    "visible_masks",
    "write_depth_png",
    "write_png",
]

_HOMES = {
    "Boxes": "motion",
    "RayCaster": "rays",
    "flow_to_rgb": "motion",
    "lidar": "rays",
    "optical_flow": "motion",
    "visible_boxes": "motion",
    "visible_masks": "motion",
    "Light": "shade.shading",
    "Output": "pictures",
    "Poses": "pictures",
    "RenderInstance": "scene",
    "RenderScene": "scene",
    "Renderer": "renderer",
    "VideoWriter": "video",
    "depth_to_rgb": "colors",
    "instance_to_rgb": "colors",
    "normalize_depth": "colors",
    "write_depth_png": "files",
    "write_png": "files",
}
"""Module of each name that is imported late."""


def __getattr__(name: str) -> Any:
    if name == "overlay":
        return import_module("h3data.render.overlay")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
