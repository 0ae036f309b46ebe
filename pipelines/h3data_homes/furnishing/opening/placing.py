"""Records of furniture that opens, and its placement in a scene."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from h3data.scene.articulation import rests_on
from h3data.scene.records import Articulation, Asset, Instance, Joint, Part, Receptacle, Shape
from h3data_homes.solids import MeshBuilder


@dataclass(frozen=True, kw_only=True, eq=False)
class MovingPart:
    """Door or drawer of a piece of furniture, in the frame of the closed piece."""

    name: str
    builder: MeshBuilder
    shapes: tuple[Shape, ...]
    joint: Joint
    handle: NDArray[np.float64]
    """Position of the handle, shape [3] [m]."""
    receptacles: tuple[Receptacle, ...] = ()
    behind: tuple[str, ...] = ()
    """Other receptacles of the piece that the closed part blocks, in addition to its own; those of another part are
    ``part/receptacle``."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Opening:
    """Piece of furniture that opens, with its body and moving parts."""

    kind: str
    """Kind of the piece, from which the instance's name is made."""
    category: str
    builder: MeshBuilder
    """Builder of the mesh of the body, which does not move."""
    shapes: tuple[Shape, ...]
    receptacles: tuple[Receptacle, ...]
    parts: tuple[MovingPart, ...]


def opening_assets(opening: Opening, model: str) -> dict[str, Asset]:
    """Return the assets of a piece that opens: its body, called ``model``, and its moving parts."""
    body = Asset(
        name=model,
        mesh=opening.builder.mesh(),
        category=opening.category,
        shapes=opening.shapes,
        receptacles=opening.receptacles,
    )
    parts = [
        Asset(
            name=f"{model}/{part.name}",
            mesh=part.builder.mesh(),
            category=opening.category,
            shapes=part.shapes,
            receptacles=part.receptacles,
        )
        for part in opening.parts
    ]
    return {asset.name: asset for asset in (body, *parts)}


def placed_opening(opening: Opening, body: Instance) -> tuple[list[Instance], Articulation]:
    """Return instances and joints of the moving parts of a piece whose body has been placed."""
    instances = [
        replace(body, name=f"{body.name}/{part.name}", asset=f"{body.asset}/{part.name}") for part in opening.parts
    ]
    parts = tuple(
        Part(
            name=part.name,
            joint=part.joint,
            instances=(instance.name,),
            encloses=(
                *(f"{instance.name}|{receptacle.name}" for receptacle in part.receptacles),
                *(_full_name(body.name, receptacle) for receptacle in part.behind),
            ),
            handle=part.handle,
        )
        for part, instance in zip(opening.parts, instances, strict=True)
    )
    return instances, Articulation(name=body.name, base=body.name, pose=body.pose.copy(), parts=parts)


def _full_name(body: str, receptacle: str) -> str:
    part, _, own = receptacle.rpartition("/")
    return f"{body}/{part}|{own}" if part else f"{body}|{own}"


def carrying(
    things: Iterable[Articulation],
    instances: Sequence[Instance],
    assets: Mapping[str, Asset],
    objects: Sequence[Instance],
) -> tuple[Articulation, ...]:
    """Return the articulated objects, with the objects that lie in their moving parts attached to these."""
    by_name = {i.name: i for i in instances}
    lowest = [[0.0, float(assets[o.asset].mesh.bounds[0, 1]), 0.0] for o in objects]
    feet = (np.array([o.pose[:3] for o in objects]) + lowest).reshape(-1, 3)

    def loaded(part: Part) -> Part:
        inside = np.zeros(len(objects), np.bool_)
        for name in part.instances:
            inside |= rests_on(by_name[name], assets[by_name[name].asset], feet)
        return replace(part, instances=(*part.instances, *(objects[k].name for k in np.flatnonzero(inside).tolist())))

    return tuple(replace(thing, parts=tuple(map(loaded, thing.parts))) for thing in things)
