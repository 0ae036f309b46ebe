"""Home of a HITL session: found below the user's folders, or replaced by a marked floor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import PurePosixPath

import numpy as np

from h3data.errors import H3DataError
from h3data.recording.assets.folders import clean_path
from h3data.recording.assets.library import AssetLibrary
from h3data.recording.assets.scenes import scene_records
from h3data.recording.records import AssetRef, Body
from h3data.scene.scene_file import scene_bytes
from h3data_habitat.scene_files import find_scene_file
from h3data_habitat.scenes.scene_instance import load_habitat_scene


@dataclass(frozen=True, kw_only=True, eq=False)
class Place:
    """Scene around the agents, as records."""

    name: str
    assets: tuple[AssetRef, ...]
    bodies: tuple[Body, ...]
    attachments: Mapping[str, bytes] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


def find_place(scene_id: str, library: AssetLibrary | None, *, floor_y: float) -> Place:
    """Return the scene that a log names by ``scene_id``.

    It is attached if its file is in a root of the library; otherwise a striped floor at the height ``floor_y`` [m]
    under the agents' feet replaces it.
    """
    path = clean_path(scene_id) if scene_id else ""
    name = PurePosixPath(path).name.split(".")[0] or "unknown"
    warnings = []
    file = find_scene_file(path, library)
    if file is not None:
        try:
            scene = load_habitat_scene(file, allow_missing=True, assets=library.roots if library else None)
            assets, bodies = scene_records(scene)
            return Place(
                name=scene.name,
                assets=assets,
                bodies=bodies,
                attachments={"scene.glb": scene_bytes(scene)},
                warnings=tuple(scene.source.get("warnings", ())),
            )
        except H3DataError as fault:
            warnings.append(f"the scene cannot be used: {fault}")
    ref = AssetRef(
        name=f"stage_{name}", uri=f"stages/{name}.not_found"
    )  # shows the marked floor, even if a library finds a file later
    pose = np.array(
        [0, floor_y + 0.01, 0, 0, 0, 0, 1], np.float32
    )  # the placeholder's upper side is 1 cm below its origin
    floor = Body(name="stage", asset=ref.name, pose=pose, layer="floor")
    return Place(name=name, assets=(ref,), bodies=(floor,), warnings=tuple(warnings))
