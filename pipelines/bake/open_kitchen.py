"""Script for docs/pictures/articulated.jpg: two kitchens of the generator, closed and with everything open.

python -m bake.open_kitchen docs/pictures/articulated.jpg
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray

from h3data.render import Camera, Renderer, RenderInstance, RenderScene, look_at, pinhole
from h3data.render.image_files import write_jpg
from h3data.render.light.sources import sources_of
from h3data.scene import Scene, instance_matrix
from h3data.scene.articulation import opened
from h3data_homes import HomeSpec, build_home
from h3data_light.bake import lit_scene

SEEDS, WIDTH, HEIGHT, GAP = (0, 2), 640, 560, 6
EYE_M, BACK_M, ASIDE_M = 1.75, 2.4, 0.9
"""Height of the camera, and its distances from the fronts and to the side [m]."""


def picture(scene: Scene, camera: Camera) -> NDArray[np.uint8]:
    """Return a picture of a scene with baked light, RGB [H, W, 3]."""
    meshes = [scene.assets[i.asset].mesh for i in scene.instances]
    instances = [
        RenderInstance(mesh=k, matrix=instance_matrix(i), layer=i.layer, name=i.name)
        for k, i in enumerate(scene.instances)
    ]
    lit = lit_scene(meshes, instances, range(len(instances)), sources_of(scene), name=scene.name)
    renderer = Renderer(RenderScene(lit.meshes, lit.instances), light=lit.light)
    return renderer.render(camera, outputs=("rgb",), samples=4)["rgb"]


def view_of(scene: Scene) -> Camera:
    """Return a camera in front of the row of cupboards next to the fridge."""
    heads = [float(2 * np.arctan2(thing.pose[4], thing.pose[6])) for thing in scene.articulations]
    row = [
        thing.pose[:3]
        for thing, heading in zip(scene.articulations, heads, strict=True)
        if abs(np.sin((heading - heads[0]) / 2)) < 0.01 and not thing.name.startswith("kitchen_cabinet")
    ]
    middle, ahead = np.mean(row, axis=0), np.array([np.sin(heads[0]), 0.0, np.cos(heads[0])])
    eye = middle + ahead * BACK_M + np.cross(ahead, [0, 1, 0]) * ASIDE_M + [0, EYE_M, 0]
    return pinhole(WIDTH, HEIGHT, hfov_deg=78.0, pose=look_at(eye, middle + np.array([0, 0.9, 0])))


def main(path: str) -> None:
    """Render the kitchens and write the picture."""
    rows = []
    for seed in SEEDS:
        scene = build_home(HomeSpec(seed=seed, articulated=True))
        camera, gap = view_of(scene), np.full((HEIGHT, GAP, 3), 255, np.uint8)
        rows.append(np.hstack([picture(scene, camera), gap, picture(opened(scene), camera)]))
    between = np.full((GAP, rows[0].shape[1], 3), 255, np.uint8)
    write_jpg(path, np.vstack([rows[0], between, rows[1]]))


if __name__ == "__main__":
    main(*sys.argv[1:])
