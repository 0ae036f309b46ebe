"""Shoes and slippers: the lasts in other colors and heights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bake.people.look.base import LAST_ROWS, above_shoe, grid_faces
from bake.people.look.drafts import Draft, Ground, Sheet, colored, cut, sheet
from bake.people.look.measures import Cloth, bump, smoothstep
from h3data.bodies.people.look.colors import SLOT
from h3data.geometry import Array


@dataclass(frozen=True, kw_only=True)
class Shoe:
    """A pair of shoes."""

    sole_m: float = 0.020
    """Height of the sole's edge."""
    welt_m: float = 0.003
    """Distance by which the welt stands out."""
    laces: bool = False
    cap: bool = False
    low: float = 0.0
    """Height by which the edge is lower than the last's [m]."""


SHOES: dict[str, Shoe] = {
    "sneakers": Shoe(sole_m=0.024, welt_m=0.004, laces=True),
    "leather shoes": Shoe(sole_m=0.013, welt_m=0.003, cap=True),
    "flats": Shoe(sole_m=0.009, welt_m=0.001, low=0.012),
    "slippers": Shoe(sole_m=0.011, welt_m=0.005, low=0.006),
}


def shoes(ground: Ground, spec: Shoe, *, fine: bool) -> list[tuple[Draft, str]]:
    """Return both shoes, each with the part of the base that it lies on."""
    return [(_shoe(ground, spec, side, fine=fine), f"{side} last") for side in ("left", "right")]


def _shoe(ground: Ground, spec: Shoe, side: str, *, fine: bool) -> Draft:
    m = ground.base.measures
    s = sheet(ground.body, ground.base.part(f"{side} last"))
    if not fine:
        rows = LAST_ROWS
        points = s.vertices.reshape(rows, 2 * rows, 3)[[0, 2, 4, 6, 8, 10, 12, 15], ::4]
        weights = s.weights.reshape(rows, 2 * rows, -1)[[0, 2, 4, 6, 8, 10, 12, 15], ::4]
        s = Sheet(
            vertices=points.reshape(-1, 3),
            weights=weights.reshape(-1, weights.shape[-1]),
            faces=grid_faces(8, rows // 2),
            slots=np.zeros(8 * rows // 2, np.uint8),
        )

    def sole(mesh: Cloth) -> Array:
        return spec.sole_m - mesh.vertices[:, 1]

    s, _ = cut(s, sole)
    middle = Cloth(vertices=s.vertices[s.faces].mean(1), weights=s.weights[s.faces].mean(1), faces=s.faces)
    s, _ = colored(s, np.where(sole(middle) > 0, SLOT["soles"], SLOT["shoes"]).astype(np.uint8))
    x, y, z = s.vertices.T
    along = z - m.ankle[2]
    toe = float(s.vertices[:, 2].max() - m.ankle[2])
    lift = np.where(s.slots == SLOT["soles"], spec.welt_m * smoothstep(0.002, 0.006, y), 0.0)
    above = above_shoe(m, s.vertices)
    opening = smoothstep(-0.016, -0.004, above) * smoothstep(0.055, 0.02, along)
    lift += 0.003 * smoothstep(-0.010, -0.002, above) - spec.low * opening
    shade = np.where(s.slots == SLOT["soles"], 1.0 - 0.12 * (y < 0.004), 1.0)
    upper = s.slots == SLOT["shoes"]
    middle_x = float(m.ankle[0]) * (1 if side == "left" else -1)
    out = np.abs(x - middle_x - 0.10 * along * (1 if side == "left" else -1))
    if spec.laces:
        tongue = upper & (out < 0.020) & (along > 0.03) & (along < toe - 0.075) & (y > 0.045)
        lift += np.where(tongue, 0.003, 0.0)
        shade = np.where(tongue, 1.18 - 0.25 * (np.sin(along * 2 * np.pi / 0.016) > 0), shade)
    if spec.cap:
        shade = shade * (1 - 0.25 * bump(along, toe - 0.062, 0.006) * upper)
    shade = np.where(upper & (above > -0.006) & (along < 0.06), 0.72, shade)
    return Draft(mesh=s, lift=lift, shade=shade)
