"""Contact sheets of homes of the second generation.

``python -m bake.sheets.homes docs/pictures`` writes ``kinds.jpg``, ``styles.jpg``, ``room_kinds.jpg`` and
``generations.jpg``; further words choose some of them.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from h3data.mesh.mesh import Mesh
from h3data.render import Renderer, RenderInstance, RenderScene
from h3data.render.camera import look_at, pinhole
from h3data.render.image_files import write_jpg
from h3data.render.light.sources import sources_of
from h3data.render.sheets.scene_map import plan_picture, render_scene
from h3data.scene import FreeSpace, Scene
from h3data.scene.kinds import KINDS, Kind
from h3data_homes import HomeSpec, build_home
from h3data_homes.kinds.kind import furniture_of, thing_of
from h3data_homes.layout import plan_layout
from h3data_homes.lived_in.looks import sample_look
from h3data_homes.spec import Look
from h3data_light.bake import lit_scene
from h3data_pipelines.assets.eye_level import eye_level_camera

Picture = NDArray[np.uint8]
PAPER, INK = (250, 250, 248), (30, 30, 36)
CELL_PX, LABEL_PX, COLUMNS = 104, 14, 16
VIEW_PX = (480, 320)


def _labelled(picture: Picture, text: str, *, scale: float = 0.45) -> Picture:
    """Return a picture with a line of text above it."""
    import cv2

    height = LABEL_PX if scale < 0.4 else 24
    head = np.full((height, picture.shape[1], 3), PAPER, np.uint8)
    cv2.putText(head, text, (4, height - 5), cv2.FONT_HERSHEY_SIMPLEX, scale, INK, 1, cv2.LINE_AA)
    return np.vstack([head, picture])


def _grid(cells: Sequence[Picture], columns: int) -> Picture:
    height, width = max(c.shape[0] for c in cells), max(c.shape[1] for c in cells)
    count = -(-len(cells) // columns)
    sheet = np.full((count * height, columns * width, 3), PAPER, np.uint8)
    for k, cell in enumerate(cells):
        y, x = k // columns * height, k % columns * width
        sheet[y : y + cell.shape[0], x : x + cell.shape[1]] = cell
    return sheet


# --- kinds ------------------------------------------------------------------------------------------------------------
def kind_picture(kind: Kind, *, size_px: int = CELL_PX, look: Look = "mid_century", seed: int = 3) -> Picture:
    """Return a kind of the second generation from the front, above and right, filling the picture."""
    style = sample_look(np.random.default_rng(seed), plan_layout(HomeSpec(seed=0)), look)
    rng = np.random.default_rng(seed)
    if kind.role == "thing":
        mesh = thing_of(kind, rng, style, kind.name).mesh
    else:
        mesh = furniture_of(kind, rng, style).builder.mesh()
    return mesh_picture(mesh, size_px=size_px)


def mesh_picture(mesh: Mesh, *, size_px: int = CELL_PX) -> Picture:
    """Return a picture of a mesh on a plain background, uint8 [size_px, size_px, 3]."""
    low, high = mesh.bounds.astype(float)
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    eye = middle + 4.2 * radius * np.array([0.42, 0.42, 0.8])
    camera = pinhole(size_px, size_px, hfov_deg=27.0, pose=look_at(eye, middle))
    image = Renderer(RenderScene([mesh], [RenderInstance(mesh=0, matrix=np.eye(4))])).render(
        camera, outputs=("rgb", "depth"), samples=4
    )
    image["rgb"][image["depth"] == 0] = PAPER
    return image["rgb"]


def kinds_sheet() -> Picture:
    """Return all kinds of the second generation."""
    kinds = [k for k in KINDS.values() if k.model]
    cells = [kind_picture(k, seed=n, look=get_args(Look)[n % len(get_args(Look))]) for n, k in enumerate(kinds)]
    names = [k.name.replace("_", " ") for k in kinds]
    return _grid([_labelled(c, n, scale=0.32) for c, n in zip(cells, names, strict=True)], COLUMNS)


# --- homes ------------------------------------------------------------------------------------------------------------
def room_pictures(home: Scene, categories: Sequence[str]) -> list[Picture]:
    """Return views of the first room of each category, in baked light."""
    free = FreeSpace.from_scene(home)
    flat = render_scene(home)
    fixed = {instance.name for instance in home.static_instances}
    static = [k for k, instance in enumerate(flat.instances) if instance.name in fixed]
    lit = lit_scene(flat.meshes, flat.instances, static, sources_of(home), name=home.name)
    renderer = Renderer(RenderScene(lit.meshes, lit.instances), light=lit.light)
    pictures = []
    for category in categories:
        room = next(room.name for room in home.rooms if room.category == category)
        camera = eye_level_camera(home, free, room=room, width=VIEW_PX[0], height=VIEW_PX[1])
        pictures.append(renderer.render(camera, outputs=("rgb",), samples=4)["rgb"])
    return pictures


def styles_sheet() -> Picture:
    """Return the living room and the kitchen of one home in every style."""
    cells = []
    for look in get_args(Look):
        home = build_home(HomeSpec(seed=4, generation=2, style=look))
        living, kitchen = room_pictures(home, ("living", "kitchen"))
        cells.append(_labelled(np.hstack([living, kitchen]), look.replace("_", " ")))
    return _grid(cells, 2)


ROOMS: Sequence[tuple[HomeSpec, tuple[str, ...]]] = (
    (HomeSpec(seed=7, preset="medium", generation=2), ("living", "bedroom", "child", "office", "laundry")),
    (
        HomeSpec(seed=1, preset="medium", area_m2=210, bedrooms=3, bathrooms=2, generation=2),
        ("garage", "balcony", "kitchen", "hall", "bathroom"),
    ),
)


def rooms_sheet() -> Picture:
    """Return one room of each kind."""
    cells = []
    for spec, categories in ROOMS:
        for category, picture in zip(categories, room_pictures(build_home(spec), categories), strict=True):
            cells.append(_labelled(picture, category))
    return _grid(cells, 2)


def generations_sheet() -> Picture:
    """Return a medium and a large home of each generation from above."""
    rows = []
    for preset, scale in (("medium", 46.0), ("large", 20.0)):
        cells = []
        for generation in (1, 2):
            home = build_home(HomeSpec(seed=2, preset=preset, generation=generation))  # type: ignore[arg-type]
            picture, _ = plan_picture(home, pixels_per_m=scale)
            picture = np.rot90(picture) if picture.shape[0] > picture.shape[1] else picture
            cells.append(_labelled(np.ascontiguousarray(picture), home.name.replace("_", " ")))
        rows.append(_grid(cells, 2))
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(r, ((0, 0), (0, width - r.shape[1]), (0, 0)), constant_values=250) for r in rows]
    return np.vstack(padded)


SHEETS: Mapping[str, Callable[[], Picture]] = {
    "kinds": kinds_sheet,
    "styles": styles_sheet,
    "room_kinds": rooms_sheet,
    "generations": generations_sheet,
}


def main() -> None:
    """Render and write the sheets."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", help=f"some of {', '.join(SHEETS)} (default: all)")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    for name in given.names or SHEETS:
        write_jpg(given.folder / f"{name}.jpg", SHEETS[name](), quality=82)


if __name__ == "__main__":
    main()
