"""Assembly of the storeys of a home and their stairwell into one scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from h3data.scene.records import Articulation, Asset, Part, Room, Scene
from h3data_homes.storeys.plan import STOREY_M, StoreyPlan

UPPER = "upper_"
"""Prefix of the names of all objects on the upper storey."""


def joined_storeys(plan: StoreyPlan, ground: Scene, upper: Scene, well: Scene) -> Scene:
    """Return one scene with two furnished storeys and the parts between them.

    Both storeys are given at (0, 0) and y = 0, and ``well`` in its final place. Assets that are the same object in both
    storeys are shared.
    """
    dx, dz = plan.offset
    lift = np.array([dx, STOREY_M, dz])
    assets, names = dict(ground.assets), dict[str, str]()
    for name, asset in upper.assets.items():
        names[name] = name if assets.get(name) is asset else UPPER + name
        assets[names[name]] = asset if names[name] == name else replace(asset, name=names[name])
    added, well_names = _apart(well.assets, assets)
    stairs = Room(
        name="stairs",
        category="stairs",
        rectangles=np.array([plan.well.rect], np.float64),
        ramp=plan.well.ramp,
    )
    return Scene(
        name=ground.name,
        assets={**assets, **added},
        instances=(
            *ground.instances,
            *(replace(i, asset=well_names[i.asset], name=_stairs_name(i.name, ground)) for i in well.instances),
            *(
                replace(i, name=UPPER + i.name, asset=names[i.asset], pose=_lifted(i.pose, lift))
                for i in upper.instances
            ),
        ),
        rooms=(*ground.rooms, stairs, *(_upper_room(r, dx, dz) for r in upper.rooms)),
        source=ground.source,
        articulations=(*ground.articulations, *(_upper_thing(t, lift) for t in upper.articulations)),
    )


def _apart(new: Mapping[str, Asset], others: Mapping[str, Asset]) -> tuple[dict[str, Asset], dict[str, str]]:
    """Return assets under names that no other has, and those names by the old ones."""
    names = {name: f"stairs_{name}" if name in others else name for name in new}
    return {names[n]: a if names[n] == n else replace(a, name=names[n]) for n, a in new.items()}, names


def _stairs_name(name: str, ground: Scene) -> str:
    return f"stairs_{name}" if any(i.name == name for i in ground.instances) else name


def _lifted(pose: NDArray[np.float64], lift: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([pose[:3] + lift, pose[3:]])


def _upper_room(room: Room, dx: float, dz: float) -> Room:
    return replace(room, rectangles=room.rectangles + np.array([dx, dz, dx, dz]), floor_y=STOREY_M)


def _upper_thing(thing: Articulation, lift: NDArray[np.float64]) -> Articulation:
    parts = tuple(_upper_part(part) for part in thing.parts)
    base = UPPER + thing.base if thing.base else ""
    return replace(thing, name=UPPER + thing.name, base=base, pose=_lifted(thing.pose, lift), parts=parts)


def _upper_part(part: Part) -> Part:
    # joints and handles are in the frame of the thing, parents are its parts
    return replace(
        part,
        instances=tuple(UPPER + name for name in part.instances),
        encloses=tuple(UPPER + name for name in part.encloses),
    )
