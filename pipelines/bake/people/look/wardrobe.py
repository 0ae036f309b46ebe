"""All patches as arrays: ``datasets/bodies/wardrobe.npz``."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake.people.look.base import Base, above_shoe, neckline
from bake.people.look.drafts import Draft, Ground, canonical, pack_faces
from bake.people.look.garments import BOTTOMS, TOPS, Bottom, Dress, Top, bottom, dress, limits, top
from bake.people.look.hair import HAIR, Skull, beard_draft, brows, hair, under_hair
from bake.people.look.measures import Cloth
from bake.people.look.shoes import SHOES, shoes
from bake.people.look.skin import full_sheet, light_sheet, skin_draft
from h3data.bodies.people.look.wardrobe import WARDROBE_FORMAT
from h3data.geometry import Array

log = logging.getLogger(__name__)

MARGIN_M = {"full": 0.028, "lod": 0.045}
"""Distance inside a garment beyond which skin is not rendered [m], by level of detail."""
SCALP_MARGIN_M = 0.010
"""Distance inside the hairline beyond which the scalp of light meshes is not rendered [m]."""
Arrays = dict[str, NDArray[Any]]


def wardrobe_arrays(base: Base) -> Arrays:
    """Return the arrays of the file, over a base."""
    ground = Ground(base)
    ruler = Skull(ground).ruler
    out: Arrays = {"format": np.array(WARDROBE_FORMAT)}
    for detail, sheet in (("full", full_sheet(base)), ("lod", light_sheet(base))):
        fine = detail == "full"
        skin = skin_draft(ground, sheet)
        pieces: dict[str, list[tuple[Draft, str]]] = {"skin": [(skin, "skin")]}
        for name, spec in TOPS.items():
            made = dress(ground, sheet, spec, fine=fine) if isinstance(spec, Dress) else None
            pieces[name] = made or [(top(ground, sheet, spec, fine=fine), "skin")]
        pieces |= {name: [(bottom(ground, sheet, spec, fine=fine), "skin")] for name, spec in BOTTOMS.items()}
        pieces |= {name: shoes(ground, spec, fine=fine) for name, spec in SHOES.items()}
        pieces |= {name: [(hair(ground, spec, fine=fine), "head")] for name, spec in HAIR.items()}
        pieces |= {
            "brows": [(brows(ground, fine=fine), "skin")],
            "beard": [(beard_draft(ground, sheet, fine=fine), "skin")],
        }
        for name, drafts in pieces.items():
            arrays = _merged([ground.arrays(draft, part, ruler=ruler) for draft, part in drafts])
            if name in TOPS or name in BOTTOMS or name in SHOES:
                inside = _covered(base, name, skin.mesh) > MARGIN_M[detail]
                arrays["hides"] = np.packbits(inside[canonical(skin.mesh.faces)].all(axis=1))
            elif name in HAIR and not fine:  # the few facets of a light skull come through light hair
                inside = under_hair(ground, HAIR[name], skin.mesh.vertices) > SCALP_MARGIN_M
                arrays["hides"] = np.packbits(inside[canonical(skin.mesh.faces)].all(axis=1))
            log.info("%s %s: %d vertices", name, detail, len(arrays["lift"]))
            out |= {f"{name}/{detail}/{key}": value for key, value in arrays.items()}
    return out


def _merged(parts: list[Arrays]) -> Arrays:
    """Return several patches over different parts of the base as one."""
    starts = np.cumsum([0, *(len(p["lift"]) for p in parts)])
    out = {key: np.concatenate([p[key] for p in parts]) for key in parts[0] if parts[0][key].ndim and key != "ruler"}
    faces = np.concatenate([p["faces"] + int(k) for p, k in zip(parts, starts[:-1], strict=True)])
    out["faces"] = pack_faces(canonical(faces))
    return out | {key: parts[0][key] for key in ("ruler", "ruler_m") if key in parts[0]}


def _covered(base: Base, name: str, mesh: Cloth) -> Array:
    """Return how far inside a garment each vertex of the skin is [m]."""
    m = base.measures
    y, arms = mesh.vertices[:, 1], m.arms(mesh)
    if name in SHOES:
        return np.where(arms > 0.3, -1.0, -above_shoe(m, mesh.vertices) + 0.010)
    if name in BOTTOMS:
        spec: Bottom = BOTTOMS[name]
        waist = float(m.pelvis[1]) + spec.top * m.stature
        return np.where(arms > 0.3, -1.0, np.minimum(waist - y, (spec.end - m.along_leg(mesh)[0]) * 0.42))
    spec_top: Top = TOPS[name]
    inside = np.minimum.reduce(limits(mesh, m, spec_top))
    if isinstance(spec_top, Dress):  # hips and the upper half of the thighs
        low = float(m.rig.joint("left_hip")[1]) - 0.16
        under = np.where(arms > 0.3, -1.0, np.minimum(y - low, -neckline(m, mesh, *spec_top.neck)))
        inside = np.where(y < m.pelvis[1] + spec_top.hem * m.stature + 0.06, under, inside)
    return inside
