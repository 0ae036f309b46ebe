"""Dressed bodies: skin, clothes and hair laid over a base."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from h3data.bodies.people.humanoid import SkinnedMesh
from h3data.bodies.people.look.colors import Color, Complexion, slot_colors, vertex_colors
from h3data.bodies.people.look.patches import Floats, Patch
from h3data.bodies.people.look.wardrobe import OUTFITS, SCALP, SCALP_USUAL, Detail, Wardrobe
from h3data.mesh.mesh import Mesh


@dataclass(frozen=True, kw_only=True)
class Look:
    """Appearance of a person, apart from their shape."""

    complexion: Complexion
    hair: str
    """Name of the hair style, one of `HAIRSTYLES`."""
    beard: bool = False
    outfit: str = "casual"
    """Outfit that the person wears when none is named."""
    palette: int = 0
    """Number of the set of colors that the person wears of an outfit."""
    colors: Mapping[str, Color] = field(default_factory=dict)
    """Colors by slot that replace colors of the set in all outfits."""

    def to_json(self) -> str:
        """Return the appearance in the form of body files."""
        return json.dumps(asdict(self))


def read_look(text: str) -> Look:
    """Read an appearance: the inverse of `Look.to_json`."""
    data = json.loads(text)
    complexion: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in data.pop("complexion").items()}
    colors = {slot: tuple(color) for slot, color in data.pop("colors").items()}
    return Look(complexion=Complexion(**complexion), colors=colors, **data)


def dressed(
    wardrobe: Wardrobe, look: Look, outfit: str, vertices: Floats, normals: Floats, detail: Detail
) -> SkinnedMesh:
    """Dress a person with a base mesh [B, 3] and its normals in an outfit."""
    clothes = OUTFITS[outfit]
    hidden = wardrobe.hidden((*clothes.pieces, look.hair), detail)
    slots = slot_colors(look.complexion, {**clothes.colors[look.palette % len(clothes.colors)], **look.colors})
    scalp = SCALP.get(look.hair, SCALP_USUAL)
    pieces = ["skin", *clothes.pieces, look.hair, "brows", *(["beard"] if look.beard else [])]
    patches = [wardrobe.patch(piece, detail) for piece in pieces]
    # skin that clothes cover would poke through them where joints bend
    patches[0] = without(patches[0], hidden)
    placed = [patch.placed(vertices, normals) for patch in patches]
    colors = [vertex_colors(p, slots, look.complexion, tights=clothes.tights, scalp=scalp) for p in patches]
    # faces number the vertices of their own patch
    starts = np.cumsum([0, *(len(p.lift) for p in patches)])
    return SkinnedMesh(
        mesh=Mesh(
            vertices=np.concatenate([points for points, _ in placed]),
            faces=np.concatenate([p.faces + np.int32(k) for p, k in zip(patches, starts[:-1], strict=True)]),
            colors=np.concatenate(colors),
            normals=np.concatenate([up for _, up in placed]),
        ),
        joints=np.concatenate([p.joints for p in patches]),
        weights=np.concatenate([p.weights for p in patches]),
        regions=np.concatenate([p.slots for p in patches]),
    )


def without(patch: Patch, faces: Any) -> Patch:
    """Return a patch without some of its faces and without the vertices that only these faces use."""
    import dataclasses

    used, compact = np.unique(patch.faces[~faces], return_inverse=True)
    own = {
        name: getattr(patch, name)[used]
        for name in ("corners", "shares", "lift", "joints", "weights", "slots", "shade", "paint")
    }
    offset = None if patch.offset is None else patch.offset[used]
    return dataclasses.replace(patch, faces=compact.reshape(-1, 3).astype(np.int32), offset=offset, **own)
