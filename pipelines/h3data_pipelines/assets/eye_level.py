"""Views of a scene at eye level."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.render.camera import Camera, look_at, pinhole
from h3data.render.renderer import Renderer
from h3data.render.sheets.scene_map import render_scene
from h3data.scene.records import Scene

if TYPE_CHECKING:
    from h3data.scene.freespace.free_space import FreeSpace


def eye_level_camera(
    scene: Scene,
    free: FreeSpace,
    *,
    room: str | None = None,
    width: int = 960,
    height: int = 640,
    hfov_deg: float = 82.0,
) -> Camera:
    """Return a camera at a height of 1.55 m in a corner of a room's free floor, looking across the room.

    Among the far corners, the one with the most open view is chosen. ``room`` defaults to the largest; a scene without
    rooms is treated as one room.

    Raises:
        InputError: there is no such room, or no free floor in it.
    """
    import shapely

    main = shapely.get_parts(free.polygon)[0]
    rooms = {r.name: shapely.union_all([shapely.box(*b) for b in np.asarray(r.rectangles)]) for r in scene.rooms}
    if room is not None and room not in rooms:
        raise InputError(
            f"There is no room {room!r} in scene {scene.name!r}. Its rooms: {', '.join(rooms) or 'none'}.",
            code="H3-RENDER-071",
        )
    chosen = room or max(rooms, key=lambda name: rooms[name].area, default="")
    area = main.intersection(rooms[chosen]) if chosen else main
    inside = area.intersection(rooms[chosen].buffer(-0.32)) if chosen else area
    area = area if inside.is_empty else inside  # away from doorways
    corners = shapely.get_coordinates(area.simplify(0.1))
    if not len(corners):
        raise InputError(f"There is no free floor in room {chosen!r} of scene {scene.name!r}.", code="H3-RENDER-072")
    middle = shapely.get_coordinates((rooms[chosen] if chosen else main).centroid)[0]
    target = np.array([middle[0], free.height_at(middle) + 0.9, middle[1]])
    far = corners[np.argsort(-np.linalg.norm(corners - middle, axis=1), kind="stable")[:12]]
    eyes = np.insert(far, 1, free.height_at(far) + 1.55, axis=1)
    poses = [look_at(eye, target) for eye in eyes]
    renderer = Renderer(render_scene(scene))

    def openness(pose: NDArray[np.float64]) -> float:
        depth = renderer.render(pinhole(96, 64, hfov_deg=hfov_deg, pose=pose), outputs=("depth",))["depth"]
        # mostly what stands close in front of the camera, because that is what spoils a view
        return float(np.quantile(depth, 0.15)) + 0.1 * float(depth.mean())

    return pinhole(width, height, hfov_deg=hfov_deg, name="eye", pose=max(poses, key=openness))


def eye_level_picture(scene: Scene, free: FreeSpace, *, room: str | None = None) -> NDArray[np.uint8]:
    """Render the view of a person who stands in a room, as RGB [H, W, 3]."""
    camera = eye_level_camera(scene, free, room=room)
    return Renderer(render_scene(scene)).render(camera, outputs=("rgb",), samples=4)["rgb"]
