"""Records of a home in a recording: its assets by reference, and its objects as bodies."""

from __future__ import annotations

import io
from functools import lru_cache

import numpy as np

from h3data.recording.records import AssetRef, Body
from h3data.scene import Scene, save_scene, scene_digest
from h3data.scene.kinds import KINDS


# Episodes of a run often share their home.
@lru_cache(maxsize=4)
def scene_records(scene: Scene) -> tuple[tuple[AssetRef, ...], tuple[Body, ...]]:
    """Return the assets of a home, which refer to the attachment ``scene.glb``, and its objects as bodies that never move."""
    assets = tuple(AssetRef(name=name, uri=f"scene:{name}") for name in scene.assets)
    bodies = tuple(
        Body(
            name=i.name,
            asset=i.asset,
            pose=i.pose.astype(np.float32),
            scale=i.scale.astype(np.float32),
            semantic_id=i.semantic_id,
            layer=i.layer,
        )
        for i in scene.instances
    )
    return assets, bodies


@lru_cache(maxsize=4)
def scene_attachment(scene: Scene) -> tuple[bytes, str]:
    """Return the scene file of a home and its digest, which are the same for all its episodes."""
    buffer = io.BytesIO()
    save_scene(scene, buffer)
    return buffer.getvalue(), scene_digest(scene)


def categories_of(scene: Scene) -> list[str]:
    """Return the names of the semantic classes that a scene may have, in the order of their ids.

    Homes have the classes of their generation, and classes of stairs if they have several storeys. All other scenes
    have the classes of the first generation.
    """
    # scenes of other makers get ids from the first generation, by the names of their categories
    home = scene.source if scene.source.get("kind") == "home" else {}
    generation, storeys = home.get("generation", 1), home.get("storeys", 1)
    return [kind.name for kind in KINDS.values() if kind.generation <= generation and kind.storeys <= storeys]
