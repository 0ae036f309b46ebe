"""Rendering: depth, ids, normals and RGB of a scene from any camera.

- `camera`, `scene`: what to render; `renderer`: `Renderer`, one interface to all back ends; `outputs`: their outputs
- back ends: `raster/` with `shade/` (CPU); entry points of the group `h3data.renderers`: rays and GPUs
- processing of images: `colors`, `overlay`; files: `image_files`, `video`
- `sheets/`: contact sheets of bodies, robots and motions, and plans of scenes

`Camera` and its helpers need no heavy packages; all other names are imported at first use (numba, OpenCV, PyAV).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from h3data.moved import lazy_names
from h3data.render import overlay
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
    from h3data.render.colors import depth_to_rgb, instance_to_rgb, normalize_depth
    from h3data.render.image_files import write_depth_png, write_png
    from h3data.render.outputs import Output, Poses
    from h3data.render.renderer import Renderer
    from h3data.render.scene import RenderInstance, RenderScene
    from h3data.render.shade.shading import Light
    from h3data.render.video import VideoWriter

__all__ = [
    "CONVENTIONS",
    "OPENGL_TO_OPENCV",
    "Camera",
    "Light",
    "Output",
    "Poses",
    "RenderInstance",
    "RenderScene",
    "Renderer",
    "VideoWriter",
    "camera_from_matrix",
    "depth_to_rgb",
    "equirectangular",
    "fisheye",
    "instance_to_rgb",
    "look_at",
    "normalize_depth",
    "orthographic",
    "overlay",
    "pinhole",
    "write_depth_png",
    "write_png",
]

__getattr__ = lazy_names(
    __name__,
    {
        **dict.fromkeys(("depth_to_rgb", "instance_to_rgb", "normalize_depth"), ".colors"),
        **dict.fromkeys(("write_depth_png", "write_png"), ".image_files"),
        **dict.fromkeys(("Output", "Poses"), ".outputs"),
        "Renderer": ".renderer",
        **dict.fromkeys(("RenderInstance", "RenderScene"), ".scene"),
        "Light": ".shade.shading",
        "VideoWriter": ".video",
    },
)
