"""Garments: their cuts from the base, their distance from the skin, and their seams and collars."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bake.people.look.base import SKIRT_COLUMNS, SKIRT_ROWS, grid_faces, neckline, skirt_weights
from bake.people.look.cloth import (
    INSIDE_SHADE,
    Hang,
    arm_folds,
    between_legs,
    border_loops,
    free,
    hemmed,
    leg_folds,
    resampled,
    ridge,
    trunk_folds,
    tube,
    turned_out,
    wobble,
)
from bake.people.look.drafts import Draft, Field, Ground, Sheet, colored, cut, hollows, joined, kept, refined
from bake.people.look.measures import Cloth, Measures, bump, smoothstep
from h3data.bodies.people.look.colors import SLOT
from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.geometry import Array, normalized

Collar = Literal["none", "rib", "shirt", "hood", "lapels"]
FINE_M = 0.0172
"""Length above which edges of the full sheets are halved [m]."""
HOLLOWS = {True: 130.0, False: 14.0}
"""Strength [1/m] with which hollows are darkened in full and in light meshes: the latter's neighbours are three times as far
away, so a surface of the same curvature lies ten times as deep between them."""


@dataclass(frozen=True, kw_only=True)
class Top:
    """A garment of the upper body."""

    sleeve: tuple[Literal["upper", "lower"], float] = ("lower", 0.96)
    """End of sleeves: fraction of the upper arm, or of the forearm."""
    hem: float = -0.03
    """Height of the hem over the pelvis, in statures."""
    neck: tuple[float, float, float] = (-0.030, 0.50, 4.0)
    """Drop, tilt and curve of the neckline (`neckline`)."""
    ease_m: float = 0.010
    sleeve_ease_m: float = 0.010
    flare_m: float = 0.004
    """Width that sleeves gain towards their ends."""
    hang: float | None = 0.22
    """Inward fall of the cloth below the chest per metre; None for clinging cloth."""
    folds_m: float = 0.004
    cuffs_m: float = 0.0
    """Height of ribbed cuffs and waistband, which gather the cloth."""
    collar: Collar = "none"
    buttoned: bool = False
    stripes: bool = False


@dataclass(frozen=True, kw_only=True)
class Bottom:
    """Trousers or shorts."""

    end: float = 1.97
    """End of the legs: 0 hip, 1 knee, 2 ankle."""
    top: float = 0.008
    """Height of the waist over the pelvis, in statures."""
    ease_m: float = 0.006
    seat: float = 0.45
    """Inward fall of the cloth below the seat per metre."""
    width_m: tuple[float, float, float] = (0.088, 0.069, 0.063)
    """Least radius of the cloth at the thigh, at the knee and at its end [m]."""
    folds_m: float = 0.005
    cuffs_m: float = 0.0
    tucked: float = -0.05
    """Height over the pelvis down to which the cloth lies close below a top, in statures."""
    ribs: bool = False
    """True for lines along the legs, as in corduroy."""
    crease: bool = False


@dataclass(frozen=True, kw_only=True)
class Dress(Top):
    """Dress with a bodice and a skirt."""

    flare: float = 0.10
    """Additional distance of the skirt from the body per metre of its length."""
    pleats: int = 18
    pleat_m: float = 0.010


TOPS: dict[str, Top] = {
    "tshirt": Top(sleeve=("upper", 0.62), flare_m=0.012, ease_m=0.008, collar="rib", hem=-0.035, folds_m=0.0045),
    "shirt": Top(neck=(-0.012, 0.42, 3.0), collar="shirt", buttoned=True, hem=-0.045, folds_m=0.005, cuffs_m=0.0),
    "pullover": Top(
        ease_m=0.016,
        sleeve_ease_m=0.015,
        cuffs_m=0.045,
        collar="rib",
        neck=(-0.020, 0.45, 3.5),
        hem=-0.02,
        hang=0.12,
        folds_m=0.006,
    ),
    "hoodie": Top(
        ease_m=0.019,
        sleeve_ease_m=0.018,
        cuffs_m=0.055,
        collar="hood",
        neck=(-0.020, 0.50, 3.5),
        hem=-0.03,
        hang=0.05,
        folds_m=0.008,
    ),
    "pyjama": Top(
        ease_m=0.012,
        sleeve_ease_m=0.015,
        flare_m=0.006,
        neck=(-0.030, 0.72, 3.0),
        collar="lapels",
        buttoned=True,
        hem=-0.055,
        hang=0.05,
        folds_m=0.007,
        stripes=True,
    ),
    "dress": Dress(
        sleeve=("upper", 0.50),
        flare_m=0.008,
        ease_m=0.006,
        neck=(-0.040, 0.55, 4.5),
        hem=0.052,
        hang=0.6,
        folds_m=0.003,
        collar="none",
    ),
}
BOTTOMS: dict[str, Bottom] = {
    "jeans": Bottom(),
    "chinos": Bottom(width_m=(0.086, 0.064, 0.055), folds_m=0.004, ease_m=0.006, end=1.95, crease=True),
    "cords": Bottom(width_m=(0.090, 0.073, 0.070), ribs=True, ease_m=0.008, tucked=-0.035),
    "joggers": Bottom(width_m=(0.096, 0.080, 0.066), folds_m=0.008, cuffs_m=0.05, ease_m=0.011, end=1.95),
    "pyjama trousers": Bottom(width_m=(0.100, 0.090, 0.088), folds_m=0.007, ease_m=0.011, seat=0.15, tucked=-0.068),
    "shorts": Bottom(end=0.86, width_m=(0.102, 0.100, 0.100), ease_m=0.009),
}


def _refined(s: Sheet, fine: bool) -> Sheet:
    return refined(s, lambda mesh: np.ones(len(mesh.vertices), bool), longer_m=FINE_M) if fine else s


def top(ground: Ground, skin: Sheet, spec: Top, *, fine: bool) -> Draft:
    """Return a garment of the upper body over a sheet of the whole skin."""
    m = ground.base.measures
    s = kept(skin, lambda mesh: limits(mesh, m, spec)[0])
    s = kept(s, lambda mesh: limits(mesh, m, spec)[1])
    s = kept(s, lambda mesh: limits(mesh, m, spec)[2])
    s = _refined(s, fine)
    trims: list[Field] = []
    if spec.cuffs_m:
        trims = [
            lambda mesh: spec.cuffs_m - limits(mesh, m, spec)[0],
            lambda mesh: spec.cuffs_m - limits(mesh, m, spec)[1],
        ]
    if spec.collar == "lapels":
        trims = [lambda mesh: 0.032 - limits(mesh, m, spec)[2]]

    def placket(mesh: Cloth) -> Array:
        return np.where(mesh.vertices[:, 2] > m.pelvis[2], 0.016 - np.abs(mesh.vertices[:, 0] - 0.004), -1)

    for field in (*trims, placket) if spec.buttoned and fine else trims:
        s, _ = cut(s, field)
    middle = Cloth(vertices=s.vertices[s.faces].mean(1), weights=s.weights[s.faces].mean(1), faces=s.faces)
    slots = np.full(len(s.faces), SLOT["top"], np.uint8)
    for field in trims:  # a placket is a raised band of the same cloth
        slots[field(middle) > 0] = SLOT["top trim"]
    s, source = colored(s, slots)
    lift = top_lift(ground, m, s, spec)
    s = replace(s, weights=_hanging(s.weights))
    shown = ground.shown(Draft(mesh=s, lift=lift), "skin")
    shade = _hollows(shown, s.faces, source, fine)
    if spec.cuffs_m:
        shade = shade * np.where(s.slots == SLOT["top trim"], 0.90, 1.0)
    if spec.stripes:
        line = ridge(m.azimuth(s) * 9 / np.pi) * (1 - m.arms(s)) + ridge(m.along_arm(s)[1] * 3 / np.pi) * m.arms(s)
        shade = shade * (1 - 0.16 * smoothstep(0.55, 0.35, line))
    draft = Draft(mesh=s, lift=lift, shade=shade)
    parts = [hemmed(draft, source=source)]
    parts += _sewn(ground, draft, source, spec, fine=fine)
    return joined(parts)


def _hanging(weights: Array) -> Array:
    """Return the weights of a top; the part that hangs over the hips follows the thighs by half."""
    out = weights.copy()
    for side in ("left", "right"):
        hip = JOINT_INDEX[f"{side}_hip"]
        out[:, JOINT_INDEX["pelvis"]] += 0.55 * out[:, hip]
        out[:, hip] *= 0.45
    return out


def _hollows(points: Array, faces: NDArray[np.int32], source: NDArray[np.int64], fine: bool) -> Array:
    count = int(source.max()) + 1
    one = np.stack([np.bincount(source, points[:, k], minlength=count) for k in range(3)], 1)
    one /= np.maximum(np.bincount(source, minlength=count), 1)[:, None]
    return hollows(one, source[faces].astype(np.int32), HOLLOWS[fine])[source]


def limits(mesh: Cloth, m: Measures, spec: Top) -> tuple[Array, Array, Array]:
    """Return the distance inside hem, sleeves and neckline [m]."""
    arms = m.arms(mesh) > 0.5
    hem = np.where(arms, 1.0, mesh.vertices[:, 1] - m.pelvis[1] - spec.hem * m.stature)
    bone, share = spec.sleeve
    ends = ("shoulder", "elbow") if bone == "upper" else ("elbow", "wrist")
    beyond = m.beyond(mesh, *ends, share)
    return hem, np.where(beyond <= -1.0, 1.0, -beyond), -neckline(m, mesh, *spec.neck)


def top_lift(ground: Ground, m: Measures, mesh: Cloth, spec: Top) -> Array:
    """Return the distance of a top from the skin [m], shape [V]."""
    hem, sleeve, neck = limits(mesh, m, spec)
    arms, (u, _) = m.arms(mesh), m.along_arm(mesh)
    hem_y = float(m.pelvis[1]) + spec.hem * m.stature
    end = spec.sleeve[1] + (0 if spec.sleeve[0] == "upper" else 1)
    ease = (1 - arms) * spec.ease_m + arms * (spec.sleeve_ease_m + spec.flare_m * smoothstep(end - 0.6, end, u))
    lift = ease * smoothstep(-0.01, 0.05, neck) + 0.004 + 0.006 * smoothstep(0.09, 0.03, hem)
    if spec.hang is not None:
        lift += (1 - arms) * np.minimum(Hang(ground, spec.hang)(mesh), 0.05)
    folds = arm_folds(m, mesh, spec.folds_m) + trunk_folds(m, mesh, spec.folds_m, hem_y)
    lift += folds * smoothstep(0.0, 0.05, neck)
    if spec.cuffs_m:  # cloth bulges above a band that gathers it
        for edge in (hem, sleeve):
            band = smoothstep(spec.cuffs_m + 0.004, spec.cuffs_m - 0.006, edge)
            bulge = 0.010 * bump(edge, spec.cuffs_m + 0.030, 0.028)
            lift = (1 - band) * (lift + bulge) + band * (0.006 + 0.25 * np.where(edge is hem, lift, 0.0))
    if spec.buttoned:
        placket = (mesh.vertices[:, 2] > m.pelvis[2]) * smoothstep(0.0165, 0.0155, np.abs(mesh.vertices[:, 0] - 0.004))
        lift += 0.0022 * placket
    if spec.collar == "hood":  # a pocket on the belly
        x, y, z = mesh.vertices.T
        waist = hem_y + spec.cuffs_m
        pocket = smoothstep(0.006, -0.006, np.abs(x) - 0.13 + 0.45 * np.maximum(y - waist - 0.07, 0))
        lift += (
            0.007 * pocket * smoothstep(0.155, 0.145, y - waist) * smoothstep(0.0, 0.02, y - waist) * (z > m.pelvis[2])
        )
    return lift


def _sewn(ground: Ground, draft: Draft, source: NDArray[np.int64], spec: Top, *, fine: bool) -> list[Draft]:
    """Return collars, hoods and buttons."""
    m = ground.base.measures
    shown = ground.shown(draft, "skin")
    parts: list[Draft] = []
    first = np.full(int(source.max()) + 1, -1)
    first[source[::-1]] = np.arange(len(source))[::-1]
    loops = border_loops(source[draft.mesh.faces].astype(np.int32))
    neck = max((shown[first[loop]] for loop in loops), key=lambda p: p[:, 1].mean())
    n = 40 if fine else 14
    ring = resampled(neck, n)
    center = ring.mean(0)
    across = normalized((ring - center) * [1, 0, 1])
    front = (1 + normalized((ring - center) * [1, 0, 1])[:, 2]) / 2  # 1 in front, 0 at the back
    up = np.tile([0, 1.0, 0], (n, 1))
    slot = SLOT["top trim"]
    if spec.collar == "rib":
        points, faces = tube(
            ring - 0.003 * across + [0, 0.001, 0],
            across + 0.5 * up,
            up - 0.2 * across,
            np.full(n, 0.0050),
            np.full(n, 0.0105),
            6 if fine else 4,
        )
        parts.append(free(ground, points, faces, slot))
    if spec.collar == "hood":
        back = 1 - front
        width, height = 0.016 + 0.030 * back**1.5, 0.018 + 0.022 * back
        path = ring + (0.004 + 0.020 * back)[:, None] * across + (0.006 + 0.012 * back)[:, None] * up
        lean = normalized(across + (0.35 * (1 - back) - 0.5 * back)[:, None] * up)
        points, faces = tube(
            path, lean, normalized(up + 0.4 * back[:, None] * across), width, height, 10 if fine else 6
        )
        parts.append(free(ground, points, faces, SLOT["top"]))
        droop = ring - 0.020 * across - 0.010 * up  # the opening of the hood, seen as a second roll inside
        points, faces = tube(droop, across, up, 0.012 + 0.010 * back, 0.016 + 0.012 * back, 8 if fine else 5)
        inner = free(ground, points, faces, SLOT["top"])
        parts.append(replace(inner, shade=np.full(len(points), 0.8)))
        if fine:
            parts += [_cord(ground, ring, side) for side in (1, -1)]
    if spec.collar == "shirt":
        parts += _shirt_collar(ground, ring, across, front, fine=fine)
    if spec.buttoned and fine:
        parts += _buttons(ground, shown, m, spec)
    return parts


def _cord(ground: Ground, ring: Array, side: int) -> Draft:
    start = ring[np.argmin(np.abs(ring[:, 0] - side * 0.045) - ring[:, 2])] + [0, -0.004, 0.024]
    path = start + np.linspace(0, 1, 7)[:, None] * [side * 0.004, -0.13, 0.012]
    angle = np.linspace(0, 2 * np.pi, 5, endpoint=False)
    circle = 0.0032 * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], 1)
    points = (path[:, None] + circle).reshape(-1, 3)
    faces = turned_out(points, grid_faces(7, 5), path.mean(0))
    return free(ground, points, faces, SLOT["buttons"])


def _shirt_collar(ground: Ground, ring: Array, across: Array, front: Array, *, fine: bool) -> list[Draft]:
    """Return a shirt collar: a stand round the neck that folds over, open in front, with two points."""
    n = len(ring)
    order = np.arange(1, n)  # from beside the middle of the front once round
    base, out, f = ring[order], across[order], front[order][:, None]
    tip = smoothstep(0.80, 1.0, f)
    up = np.array([0, 1.0, 0])
    rise, fall = 0.030 - 0.008 * f, 0.034 + 0.022 * tip
    rows = [
        base - 0.004 * out - 0.004 * up,
        base - (0.008 - 0.003 * f) * out + 0.5 * rise * up,
        base - (0.009 - 0.004 * f) * out + rise * up,
        base - (0.003 - 0.006 * f) * out + (rise + 0.002) * up,
        base + (0.008 + 0.004 * f) * out + (rise - 0.45 * fall) * up,
        base + (0.015 + 0.008 * f) * out + (rise - fall) * up + tip * np.sign(base[:, :1]) * np.array([0.010, 0, 0]),
    ]
    points = np.concatenate(rows)
    faces = grid_faces(len(rows), n - 1, closed=False)
    outer = faces.max(axis=1) >= 3 * (n - 1)
    a, b, c = (points[faces[outer, k]] for k in range(3))
    if np.sum(np.cross(b - a, c - a) * ((a - points.mean(0)) * [1, 0, 1])) < 0:
        faces = faces[:, ::-1]
    return [free(ground, points, faces, SLOT["top trim"])]


def _buttons(ground: Ground, shown: Array, m: Measures, spec: Top) -> list[Draft]:
    """Return buttons as small discs along the placket."""
    y1 = m.neck_joint[1] + (spec.neck[0] - spec.neck[1] * 0.055) * m.stature - 0.02
    y0 = m.pelvis[1] + spec.hem * m.stature + 0.05
    near = (np.abs(shown[:, 0] - 0.004) < 0.03) & (shown[:, 2] > m.pelvis[2])
    angle = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    parts = []
    for y in np.linspace(y0, y1, 6):
        spot = shown[near]
        z = spot[np.argmin(np.hypot(spot[:, 0] - 0.004, spot[:, 1] - y)), 2] + 0.0035
        rim = np.stack([0.004 + 0.0058 * np.cos(angle), y + 0.0058 * np.sin(angle), np.full(8, z - 0.0028)], 1)
        points = np.concatenate([rim, [[0.004, y, z]]])
        faces = np.stack([np.arange(8), (np.arange(8) + 1) % 8, np.full(8, 8)], 1).astype(np.int32)
        parts.append(free(ground, points, faces, SLOT["buttons"]))
    return parts


def bottom(ground: Ground, skin: Sheet, spec: Bottom, *, fine: bool) -> Draft:
    """Return trousers over a sheet of the whole skin."""
    m = ground.base.measures
    waist = float(m.pelvis[1]) + spec.top * m.stature

    def lower(mesh: Cloth) -> Array:
        return np.where(m.arms(mesh) > 0.4, -1.0, waist - mesh.vertices[:, 1])

    def end(mesh: Cloth) -> Array:
        return (spec.end - m.along_leg(mesh)[0]) * 0.42

    s = kept(kept(skin, lower), end)
    s = _refined(s, fine)
    slots = np.full(len(s.faces), SLOT["bottom"], np.uint8)
    if spec.cuffs_m:
        s, _ = cut(s, lambda mesh: spec.cuffs_m - end(mesh))
        slots = np.where(
            end(Cloth(vertices=s.vertices[s.faces].mean(1), weights=s.weights[s.faces].mean(1), faces=s.faces))
            < spec.cuffs_m,
            SLOT["bottom trim"],
            SLOT["bottom"],
        ).astype(np.uint8)
    s, source = colored(s, slots)
    u, angle, r = m.along_leg(s)
    wide = np.interp(u, [0.45, 1.0, 1.95], spec.width_m)
    on_leg = smoothstep(0.20, 0.60, u)
    lift = np.maximum(on_leg * (wide - r), 0.0)
    lift = np.hypot(lift, spec.ease_m) + (1 - on_leg) * np.minimum(Hang(ground, spec.seat)(s), 0.035) * smoothstep(
        -0.2, 0.1, u
    )
    lift += leg_folds(m, s, spec.folds_m, spec.end) * smoothstep(waist - 0.01, waist - 0.06, s.vertices[:, 1])
    tucked = float(m.pelvis[1]) + spec.tucked * m.stature
    lift = lift * smoothstep(tucked + 0.03, tucked - 0.04, s.vertices[:, 1]) + 0.0035
    if spec.cuffs_m:
        edge = end(s)
        band = smoothstep(spec.cuffs_m + 0.004, spec.cuffs_m - 0.006, edge)
        lift = (1 - band) * (lift + 0.012 * bump(edge, spec.cuffs_m + 0.035, 0.03)) + 0.006 * band
    lift = between_legs(m, s, lift)
    draft = Draft(mesh=s, lift=lift)
    shade = _hollows(ground.shown(draft, "skin"), s.faces, source, fine)
    if spec.ribs:
        shade = shade * (1 - 0.10 * smoothstep(0.5, 0.2, ridge(angle * 8 / np.pi)))
    if spec.crease:
        shade = shade * (1 + 0.07 * bump(angle, 0.1, 0.12) * smoothstep(0.2, 0.5, u))
    return hemmed(replace(draft, shade=shade), source=source)


def dress(ground: Ground, skin: Sheet, spec: Dress, *, fine: bool) -> list[tuple[Draft, str]]:
    """Return bodice over the skin, skirt over its cage; each with the part of the base that it lies on."""
    m = ground.base.measures
    start, columns = ground.base.starts["skirt"], SKIRT_COLUMNS
    cage = ground.body.vertices[start : start + SKIRT_ROWS * columns].reshape(SKIRT_ROWS, columns, 3)
    rows, across = (22, 80) if fine else (8, 20)
    t = np.linspace(0.02, 1, rows)
    row, column = np.meshgrid(t * (SKIRT_ROWS - 1), np.arange(across) * columns / across, indexing="ij")
    i = np.minimum(row.astype(int), SKIRT_ROWS - 2)
    j = column.astype(int)
    a, b = (row - i)[..., None], (column - j)[..., None]
    k = (j + 1) % columns
    points = (1 - a) * ((1 - b) * cage[i, j] + b * cage[i, k]) + a * ((1 - b) * cage[i + 1, j] + b * cage[i + 1, k])
    flat = points.reshape(-1, 3)
    angle = np.arctan2(flat[:, 0], flat[:, 2] - m.pelvis[2])
    down = (cage[0, 0, 1] - flat[:, 1]) / (cage[0, 0, 1] - cage[-1, 0, 1])
    mesh = Sheet(
        vertices=flat,
        weights=skirt_weights(m, flat),
        faces=grid_faces(rows, across),
        slots=np.full(len(flat), SLOT["top"], np.uint8),
    )
    depth = spec.pleat_m if fine else 0.4 * spec.pleat_m
    turns = angle * spec.pleats / (2 * np.pi) + 0.28 * wobble(mesh, 0.30, 4)
    lift = (
        0.002
        + 0.010 * smoothstep(0.05, 0.25, down)
        + spec.flare * 0.45 * down**1.4
        + depth * ridge(turns) * smoothstep(0.05, 0.6, down)
    )
    skirt = Draft(mesh=mesh, lift=lift)
    shade = hollows(ground.shown(skirt, "skirt"), mesh.faces, HOLLOWS[fine])
    # the lower edge turns in and up, so that one looks at cloth from below
    row = np.arange(rows * across).reshape(rows, across)
    back = row[[-1, -2, -3]].ravel()
    lip = Sheet(
        vertices=flat[back],
        weights=mesh.weights[back],
        faces=grid_faces(3, across)[:, ::-1].copy(),
        slots=mesh.slots[back],
    )
    lip_lift = lift[back] - np.repeat([0.0, 0.004, 0.006] if fine else [0.0, 0.012, 0.020], across)
    lip_draft = Draft(mesh=lip, lift=lip_lift, shade=np.repeat([0.8, 0.5, INSIDE_SHADE], across))
    whole = joined([replace(skirt, shade=shade), lip_draft])
    return [(top(ground, skin, spec, fine=fine), "skin"), (whole, "skirt")]
