"""Annotated plan of a scene with names of rooms, free floor, receptacles, and the problems that a validation found."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.geometry import transform_points
from h3data.render.camera import Camera
from h3data.render.sheets.scene_map import PAPER, plan_picture
from h3data.scene.records import Room, Scene, instance_matrix

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

    from h3data.scene.freespace.free_space import FreeSpace
    from h3data_pipelines.validation.scenes import Problem

Color = tuple[int, int, int]

MAIN_COLOR, ISLAND_COLOR = (46, 160, 110), (226, 128, 30)
RECEPTACLE_COLOR, PROBLEM_COLOR, INK = (120, 70, 200), (214, 30, 40), (30, 30, 36)
_KEY = (
    (MAIN_COLOR, "free"),
    (ISLAND_COLOR, "cut off"),
    (RECEPTACLE_COLOR, "receptacle"),
    (PROBLEM_COLOR, "problem"),
)
_HEADER_PX, _FOOTER_PX, _LINE_PX = 40, 46, 22
_LIST_SCALE = 0.42


def scene_map(
    scene: Scene, free: FreeSpace, *, problems: Sequence[Problem] = (), pixels_per_m: float = 80.0
) -> NDArray[np.uint8]:
    """Return an annotated plan, RGB [H, W, 3], with room names, free floor, receptacles, numbered problems and a scale.

    The largest island of ``free`` is green, and all others are orange. Receptacles are violet frames. Problems are
    listed by number below the plan.
    """
    import shapely

    picture, camera = plan_picture(scene, pixels_per_m=pixels_per_m, floor_y=free.floor_y)
    grey = picture.mean(-1, keepdims=True)
    image = np.ascontiguousarray((0.45 * picture + 0.20 * grey + 0.35 * 255).astype(np.uint8))
    islands = list(shapely.get_parts(free.polygon))
    for k, island in enumerate(islands):
        color = MAIN_COLOR if k == 0 else ISLAND_COLOR
        _shade(image, camera, island, color, free, strength=0.28 if k == 0 else 0.5)
    for instance, receptacle in scene.receptacles():
        x, z = np.asarray(receptacle.half_size, np.float64)
        corners = np.array([[-x, 0, -z], [x, 0, -z], [x, 0, z], [-x, 0, z]]) + receptacle.center
        _outline(image, camera, transform_points(instance_matrix(instance), corners), RECEPTACLE_COLOR)
    for room in scene.rooms:
        _name_room(image, camera, room)
    for number, problem in enumerate(problems, 1):
        if problem.position is not None:
            _mark(image, camera, np.asarray(problem.position), str(number))
    return _framed(image, scene, free, problems, pixels_per_m)


# --- parts of the plan ------------------------------------------------------------------------------------------------
def _pixels(camera: Camera, points: ArrayLike) -> NDArray[np.int32]:
    """Return the OpenCV pixels [N, 2] of world points [N, 3]."""
    xy, _ = camera.project(np.asarray(points, np.float64))
    return np.rint(xy - 0.5).astype(np.int32)


def _shade(
    image: NDArray[np.uint8], camera: Camera, area: BaseGeometry, color: Color, free: FreeSpace, *, strength: float
) -> None:
    import cv2
    import shapely

    outer, inner = shapely.get_exterior_ring(area), area.interiors  # type: ignore[attr-defined]
    rings = [shapely.get_coordinates(ring) for ring in (outer, *inner)]
    outlines = [_pixels(camera, np.insert(r, 1, free.height_at(r), axis=1)) for r in rings]
    mask = np.zeros(image.shape[:2], np.uint8)
    cv2.fillPoly(mask, outlines, 255, cv2.LINE_AA)  # even-odd: the inner rings are holes
    weight = mask[..., None] * (strength / 255)
    image[:] = (image * (1 - weight) + np.array(color) * weight).astype(np.uint8)
    cv2.polylines(image, outlines, True, color, 1, cv2.LINE_AA)


def _outline(image: NDArray[np.uint8], camera: Camera, corners: ArrayLike, color: Color) -> None:
    import cv2

    cv2.polylines(image, [_pixels(camera, corners)], True, color, 1, cv2.LINE_AA)


def _name_room(image: NDArray[np.uint8], camera: Camera, room: Room) -> None:
    """Write a room's name and area in the middle of its largest rectangle."""
    rectangles = np.asarray(room.rectangles, np.float64)
    areas = (rectangles[:, 2] - rectangles[:, 0]) * (rectangles[:, 3] - rectangles[:, 1])
    x0, z0, x1, z1 = rectangles[int(np.argmax(areas))]
    at = _pixels(camera, [[(x0 + x1) / 2, room.floor_y, (z0 + z1) / 2]])[0]
    _text(image, room.name.replace("_", " "), (int(at[0]), int(at[1])), scale=0.55, centred=True, thickness=2)
    _text(image, f"{areas.sum():.1f} m2", (int(at[0]), int(at[1]) + 18), scale=0.42, centred=True)


def _mark(image: NDArray[np.uint8], camera: Camera, position: NDArray[np.float64], label: str) -> None:
    import cv2

    at = _pixels(camera, position[None])[0]
    center = (int(np.clip(at[0], 14, image.shape[1] - 14)), int(np.clip(at[1], 14, image.shape[0] - 14)))
    cv2.circle(image, center, 13, (255, 255, 255), -1, cv2.LINE_AA)
    cv2.circle(image, center, 13, PROBLEM_COLOR, 2, cv2.LINE_AA)
    _text(image, label, (center[0], center[1] + 5), scale=0.45, centred=True, color=PROBLEM_COLOR, rim=None)


def _text(
    image: NDArray[np.uint8],
    text: str,
    at: tuple[int, int],
    *,
    scale: float = 0.45,
    centred: bool = False,
    color: Color = INK,
    rim: Color | None = (255, 255, 255),
    thickness: int = 1,
) -> int:
    """Write ``text`` with its baseline at ``at``; return its width in pixels."""
    import cv2

    (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thickness)
    x, y = (at[0] - width // 2, at[1]) if centred else at
    around = [(dx, dy) for dx in (-2, 0, 2) for dy in (-2, 0, 2)]  # a thicker stroke would widen the letters
    for dx, dy, paint in [*((*d, rim) for d in around if rim is not None), (0, 0, color)]:
        cv2.putText(image, text, (x + dx, y + dy), cv2.FONT_HERSHEY_SIMPLEX, scale, paint, thickness, cv2.LINE_AA)
    return width


def _framed(
    image: NDArray[np.uint8], scene: Scene, free: FreeSpace, problems: Sequence[Problem], pixels_per_m: float
) -> NDArray[np.uint8]:
    """Return the plan with a title above it, and the scale bar, the key and the list of problems below it."""
    lines = [f"{k}  {p.kind.replace('_', ' ')}: {p.subject}: {p.text}" for k, p in enumerate(problems, 1)]
    lines = lines[:40] + ([f"... and {len(lines) - 40} more"] if len(lines) > 40 else [])
    width = max(image.shape[1], 640)
    lines = [part for line in lines for part in _wrapped(line, width - 24)]
    list_height = _LINE_PX * len(lines) + (8 if lines else 0)
    out = np.full((_HEADER_PX + image.shape[0] + _FOOTER_PX + list_height, width, 3), PAPER, np.uint8)
    left = (width - image.shape[1]) // 2
    out[_HEADER_PX : _HEADER_PX + image.shape[0], left : left + image.shape[1]] = image
    count = sum(1 for _ in scene.receptacles())
    islands = len(free.island_areas)
    title = (
        f"{scene.name}   free floor {free.polygon.area:.1f} m2 in {islands} island{'s' if islands != 1 else ''}, "
        f"{count} receptacles" + (f", {len(problems)} problems" if problems else "")
    )
    _text(out, title, (12, 26), scale=0.5)
    base = _HEADER_PX + image.shape[0] + 26
    at = 12 + _scale_bar(out, (12, base), pixels_per_m) + 24
    for color, text in _KEY:
        out[base - 10 : base + 2, at : at + 12] = color
        at += 18 + _text(out, text, (at + 18, base), scale=0.42) + 16
    for k, line in enumerate(lines):
        _text(out, line, (12, base + _LINE_PX * (k + 1) + 8), scale=_LIST_SCALE, color=PROBLEM_COLOR, rim=None)
    return out


def _wrapped(line: str, width: int) -> list[str]:
    """Return a line of the list broken into parts at most ``width`` pixels wide; all but the first are indented."""
    import cv2

    parts = [""]
    for word in line.split(" "):
        longer = f"{parts[-1]} {word}" if parts[-1] else word
        if parts[-1].strip() and cv2.getTextSize(longer, cv2.FONT_HERSHEY_SIMPLEX, _LIST_SCALE, 1)[0][0] > width:
            parts.append(f"      {word}")
        else:
            parts[-1] = longer
    return parts


def _scale_bar(image: NDArray[np.uint8], at: tuple[int, int], pixels_per_m: float) -> int:
    """Draw a bar of a round number of metres and its label; return the width of both in pixels."""
    import cv2

    metres = next((m for m in (1, 2, 5, 10, 20, 50) if m * pixels_per_m >= 70), 100)
    length = int(round(metres * pixels_per_m))
    x, y = at
    cv2.rectangle(image, (x, y - 8), (x + length, y), INK, 1)
    cv2.rectangle(image, (x, y - 8), (x + length // 2, y), INK, -1)
    return length + 8 + _text(image, f"{metres} m", (x + length + 8, y), scale=0.45)
