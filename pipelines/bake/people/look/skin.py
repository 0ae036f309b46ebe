"""The skin of people as a patch: finer in the face, with eyes that have iris and pupil, and what is painted on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bake.people.look.base import Base
from bake.people.look.drafts import Draft, Ground, Sheet, colored, cut, refined, sheet
from bake.people.look.measures import Cloth, Measures, bump, joint_weight, smoothstep
from h3data.bodies.people.look.colors import PAINTS, SLOT
from h3data.bodies.people.skeleton import FINGERS
from h3data.geometry import Array

HEAD_DETAIL, NECK_DETAIL, HAND_DETAIL = 2.6, 1.5, 1.7
"""Factors by which the reduction enlarges faces, necklines and hands, and so how much finer it keeps them."""
LIGHT_FACES = 2300
IRIS_M, PUPIL_M = 0.0060, 0.0024
HAIRLINES = {
    "over ears": (
        (0, 66),
        (25, 64),
        (45, 56),
        (60, 44),
        (69, 34),
        (76, 6),
        (82, -10),
        (88, 12),
        (95, 20),
        (106, 14),
        (118, -28),
        (150, -60),
        (180, -68),
    ),
    "short": (
        (0, 66),
        (25, 64),
        (45, 56),
        (60, 45),
        (69, 37),
        (76, 14),
        (81, 6),
        (87, 28),
        (95, 36),
        (107, 32),
        (122, -4),
        (138, -38),
        (180, -57),
    ),
}
"""Azimuth [deg] and height above the eyes [mm at 1.63 m of stature] of the hairline."""


def full_sheet(base: Base) -> Sheet:
    """Return all skin, finer where one looks at a face."""
    m = base.measures

    def face(mesh: Cloth) -> NDArray[np.bool_]:
        x, y, z = mesh.vertices.T
        front = (z > m.eye[2] - 0.030) & (np.abs(x) < 0.062) & ~m.is_eye(mesh)
        return front & (np.abs(y - m.eye[1] + 0.018) < 0.062)

    return refined(sheet(base.pattern, base.part("skin")), face, longer_m=0.0056)


def light_sheet(base: Base) -> Sheet:
    """Return the skin by `LIGHT_FACES` triangles, more of them where one looks: the eyes stay whole."""
    import fast_simplification  # pyright: ignore[reportMissingImports]

    body = sheet(base.pattern, base.part("skin"))
    eye = joint_weight(body, ("left_eye_smplhf", "right_eye_smplhf")) > 0.9
    eyes, rest = body.faces[eye[body.faces].all(axis=1)], body.faces[~eye[body.faces].any(axis=1)]
    swollen = _swollen(body)
    used, compact = np.unique(rest, return_inverse=True)
    points, triangles = fast_simplification.simplify(
        swollen[used].astype(np.float32), compact.reshape(-1, 3), target_count=LIGHT_FACES, agg=4
    )
    kept, compact = np.unique(triangles, return_inverse=True)
    from bake.people.look.drafts import over_surface
    from h3data.bodies.people.look.patches import vertex_normals

    up = vertex_normals(swollen.astype(np.float32), body.faces).astype(np.float64)
    corners, shares, _ = over_surface(points[kept].astype(np.float64), swollen, rest, up)
    skin = Sheet(
        vertices=np.einsum("nk,nkj->nj", shares, body.vertices[corners]),
        weights=np.einsum("nk,nkj->nj", shares, body.weights[corners]),
        faces=compact.reshape(-1, 3).astype(np.int32),
        slots=np.zeros(len(kept), np.uint8),
    )
    eye_vertices, eye_faces = np.unique(eyes, return_inverse=True)
    return Sheet(
        vertices=np.concatenate([skin.vertices, body.vertices[eye_vertices]]),
        weights=np.concatenate([skin.weights, body.weights[eye_vertices]]),
        faces=np.concatenate([skin.faces, eye_faces.reshape(-1, 3) + len(kept)]).astype(np.int32),
        slots=np.zeros(len(kept) + len(eye_vertices), np.uint8),
    )


def _swollen(body: Cloth) -> Array:
    """Return the vertices with head and hands enlarged from where they begin, smoothly by their skin weights."""
    vertices = body.vertices.copy()
    parts = [
        (joint_weight(body, ("head", "jaw")), HEAD_DETAIL),
        (joint_weight(body, ("neck", "left_collar", "right_collar")), NECK_DETAIL),
    ]
    for side in ("left", "right"):
        fingers = tuple(f"{side}_{finger}{k}" for finger in FINGERS for k in (1, 2, 3))
        parts.append((joint_weight(body, (f"{side}_wrist", *fingers)), HAND_DETAIL))
    for weight, scale in parts:
        center = np.average(body.vertices, axis=0, weights=weight * (1 - weight))
        vertices += ((scale - 1) * weight)[:, None] * (body.vertices - center)
    return vertices


def skin_draft(ground: Ground, s: Sheet) -> Draft:
    """Return the skin with its eyes and its paint."""
    m = ground.base.measures

    def disc(radius: float):
        def field(mesh: Cloth) -> Array:
            x, y, z = mesh.vertices.T
            inside = radius - np.hypot(np.abs(x) - m.eye_x, y - m.eye[1])
            return np.where(m.is_eye(mesh) & (z > m.eye[2]), inside, -1.0)

        return field

    s, _ = cut(s, disc(IRIS_M))
    s, _ = cut(s, disc(PUPIL_M))
    middle = Cloth(vertices=s.vertices[s.faces].mean(1), weights=s.weights[s.faces].mean(1), faces=s.faces)
    slots = np.full(len(s.faces), SLOT["skin"], np.uint8)
    slots[m.is_eye(middle)] = SLOT["sclera"]
    slots[disc(IRIS_M)(middle) > 0] = SLOT["iris"]
    slots[disc(PUPIL_M)(middle) > 0] = SLOT["pupil"]
    s, _ = colored(s, slots)
    corners, shares, _ = ground.attached(s.vertices, "skin")
    masks = {name: np.einsum("vk,vk->v", shares, mask[corners]) for name, mask in ground.base.masks.items()}
    eye = m.is_eye(s)
    paints = painted(m, s, masks)
    paint = np.stack([np.where(eye, 0, paints[name]) for name in PAINTS], axis=1)
    up = (s.vertices[:, 1] - m.eye[1]) / 0.012
    shade = np.where(eye, 1 - 0.30 * smoothstep(0.1, 0.9, up), 1 - 0.10 * masks["ears"] * bump(up, -1, 6))
    return Draft(mesh=s, lift=np.zeros(len(eye)), shade=shade, paint=paint)


def hairline(m: Measures, mesh: Cloth, name: str) -> Array:
    """Return the distance above the hairline, whose height is a smooth function of the azimuth (0 = front) [m]."""
    from scipy.interpolate import PchipInterpolator

    x, y, z = mesh.vertices.T
    azimuth = np.degrees(np.abs(np.arctan2(x, z - m.head_z)))
    knots = np.array(HAIRLINES[name])
    line = PchipInterpolator(knots[:, 0], knots[:, 1] * 1e-3 * m.stature / 1.63)(azimuth)
    head = y > m.neck_joint[1]
    return np.where(head & ~m.is_eye(mesh), y - m.eye[1] - line, -1.0)


def beard(m: Measures, mesh: Cloth) -> Array:
    """Return the distance inside the beard: cheeks below a line from ear to mouth, chin and upper lip [m]."""
    x, y, z = mesh.vertices.T
    side, down = np.abs(x), m.eye[1] - y
    forward = z - m.head_z
    line = 0.070 - 0.45 * np.maximum(side - 0.030, 0)  # upper edge on the cheek
    cheek = down - line - 0.010 * smoothstep(0.034, 0.014, side) * smoothstep(0.0, 0.05, forward)
    cheek = np.minimum(cheek, forward + 0.004 + 0.1 * down)
    cheek = np.minimum(cheek, 0.155 - down)
    return np.where(y > m.neck_joint[1] - 0.02, cheek, -1.0)


def painted(m: Measures, s: Sheet, masks: dict[str, Array]) -> dict[str, Array]:
    """Return how much of each paint a vertex has, 0..1."""
    x, y, z = s.vertices.T
    side, up, forward = np.abs(x), y - m.eye[1], z - m.eye[2]
    front = smoothstep(-0.045, -0.015, forward) * (y > m.neck_joint[1])
    ball = np.sqrt((side - m.eye_x) ** 2 + up**2 + (forward + 0.0005) ** 2)
    eye = np.abs(ball[m.is_eye(s)]).max() if m.is_eye(s).any() else 0.013
    rim = smoothstep(eye + 0.0034, eye + 0.0012, ball)
    blush = bump(np.hypot(side - 0.040, up + 0.042) / 0.020, 0, 1) + 0.7 * bump(np.hypot(x, up + 0.052) / 0.014, 0, 1)
    blush += 0.4 * bump(np.hypot(x, up + 0.118) / 0.016, 0, 1)
    brow_lines = 0.5 + 0.5 * np.cos((up - 0.040 - 0.10 * x**2 / 0.05) * 2 * np.pi / 0.0115)
    lines = 0.8 * brow_lines**4 * bump(up, 0.052, 0.018) * smoothstep(0.055, 0.03, side)
    fold = np.abs(side - 0.019 - 0.42 * np.maximum(-up - 0.050, 0))  # from the nose to the corners of the mouth
    lines += bump(fold / 0.0028, 0, 1) * smoothstep(-0.044, -0.054, up) * smoothstep(-0.092, -0.076, up)
    feet = np.arctan2(up - 0.002, side - m.eye_x - 0.012)
    reach = np.hypot(up, side - m.eye_x - 0.012)
    lines += 0.7 * (0.5 + 0.5 * np.cos(feet * 11)) ** 3 * bump(reach, 0.016, 0.007) * (side > m.eye_x + 0.012)
    lines += 0.6 * bump(np.hypot((side - m.eye_x) / 0.017, (up + 0.019) / 0.003), 0, 1.0)  # bags under the eyes
    lips = smoothstep(0.25, 0.75, masks["lips"])
    stubble = smoothstep(-0.004, 0.012, beard(m, s)) * (1 - lips)
    legs = (m.arms(s) < 0.5) * smoothstep(m.pelvis[1], m.pelvis[1] - 0.04, y)
    hands = joint_weight(s, tuple(f"{k}_{f}{n}" for k in ("left", "right") for f in FINGERS for n in (2, 3)))
    return {
        "lips": lips * front,
        "blush": np.clip(front * blush + 0.5 * masks["ears"] + 0.35 * hands, 0, 1),
        "lashes": rim * np.where(up > -0.0015, 1.0, 0.30) * front,
        "lids": masks["eyelids"] * front,
        "lines": np.clip(lines * front * (1 - lips), 0, 1),
        "stubble": stubble,
        "scalp": smoothstep(-0.006, 0.010, hairline(m, s, "short")) * (1 - masks["ears"]),
        "legs": legs,
    }
