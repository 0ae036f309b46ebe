"""Rooms of three homes in flat and in baked light, as a contact sheet: docs/pictures/light.jpg.

python examples/light_picture.py docs/pictures/light.jpg
"""

import sys
from pathlib import Path

import numpy as np

from h3data.render import Renderer, RenderScene
from h3data.render.image_files import write_jpg
from h3data.render.light.sources import sources_of
from h3data.render.sheets.scene_map import render_scene
from h3data.scenes import FreeSpace, HomeSpec, build_home
from h3data_light.bake import lit_scene
from h3data_pipelines.assets.eye_level import eye_level_camera

ROOMS = {
    ("small", 15): ("living", "kitchen"),
    ("medium", 7): ("living", "bedroom"),
    ("large", 7): ("living", "library"),
}

rows = []
for (preset, seed), names in ROOMS.items():
    home = build_home(HomeSpec(preset=preset, seed=seed))
    free = FreeSpace.from_scene(home)
    flat = render_scene(home)
    fixed = {instance.name for instance in home.static_instances}
    static = [k for k, instance in enumerate(flat.instances) if instance.name in fixed]
    lit = lit_scene(flat.meshes, flat.instances, static, sources_of(home), name=home.name)
    renderers = Renderer(flat), Renderer(RenderScene(lit.meshes, lit.instances, mirrors=lit.mirrors), light=lit.light)
    for name in names:
        room = next(room.name for room in home.rooms if room.category == name)
        camera = eye_level_camera(home, free, room=room, width=480, height=320)
        rows.append(np.hstack([r.render(camera, outputs=("rgb",), samples=4)["rgb"] for r in renderers]))

out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/light.jpg")
out.parent.mkdir(parents=True, exist_ok=True)
write_jpg(out, np.vstack(rows), quality=85)
print(out)
