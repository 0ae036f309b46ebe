"""Cloth over a body: how it hangs, where it folds, its hems, collars and seams. All on the pattern body."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bake.people.look.base import grid_faces
from bake.people.look.drafts import Draft, Ground, Sheet
from bake.people.look.measures import Cloth, Measures, bump, smoothstep
from h3data.geometry import Array, normalized

ROUND: Any = ("nearest", "wrap")
"""Modes in which fields over height and azimuth go on beyond their edges."""
INSIDE_SHADE = 0.42
"""Darkness of cloth where one looks into a sleeve."""


class Hang:
    """Distance of cloth that hangs from chest and seat to the trunk and legs below them [m]."""

    def __init__(self, ground: Ground, slope: float) -> None:
        """Create a hanging field; ``slope`` is the inward fall per metre (0 falls straight down)."""
        from scipy.ndimage import gaussian_filter, maximum_filter1d

        m = ground.base.measures
        skin = ground.body.vertices[: ground.base.starts["left last"]]
        weights = ground.body.weights[: len(skin)]
        body = Cloth(vertices=skin, weights=weights, faces=ground.base.part("skin"))
        trunk = (m.arms(body) < 0.35) & (skin[:, 1] < m.neck_joint[1] - 0.05)
        self.middle_z = float(m.pelvis[2])
        self.low, self.high = float(m.ankle[1]), float(m.neck_joint[1])
        rows, columns = 90, 48
        x, y, z = skin[trunk].T
        r, a = np.hypot(x, z - self.middle_z), np.arctan2(x, z - self.middle_z)
        row = np.clip(((y - self.low) / (self.high - self.low) * (rows - 1)).round().astype(int), 0, rows - 1)
        column = np.floor((a + np.pi) / (2 * np.pi) * columns).astype(int) % columns
        radius = np.zeros((rows, columns))
        np.maximum.at(radius, (row, column), r)
        for _ in range(3):
            wide = maximum_filter1d(maximum_filter1d(radius, 3, axis=1, mode="wrap"), 3, axis=0)
            radius = np.where(radius > 0, radius, wide)
        radius = gaussian_filter(radius, (1.0, 1.0), mode=ROUND)
        step = (self.high - self.low) / (rows - 1)
        fall = radius.copy()
        for k in range(rows - 2, -1, -1):
            fall[k] = np.maximum(fall[k], fall[k + 1] - slope * step)
        self.excess: Any = gaussian_filter(fall - radius, (1.2, 1.6), mode=ROUND)

    def __call__(self, mesh: Cloth) -> Array:
        """Return the distance of hanging cloth from the body at each vertex of a mesh [m]."""
        from scipy.ndimage import map_coordinates

        x, y, z = mesh.vertices.T
        rows, columns = self.excess.shape
        row = (y - self.low) / (self.high - self.low) * (rows - 1)
        column = (np.arctan2(x, z - self.middle_z) + np.pi) / (2 * np.pi) * columns - 0.5
        padded = np.concatenate([self.excess[:, -2:], self.excess, self.excess[:, :2]], axis=1)
        return map_coordinates(padded, [np.clip(row, 0, rows - 1), column + 2], order=1)


def ridge(turns: Array) -> Array:
    """Return the profile of folds, 0 to 1, with one round ridge and one sharp valley per turn."""
    return np.abs(np.sin(np.pi * turns))


def wobble(mesh: Cloth, scale_m: float, seed: int) -> Array:
    """Return smooth noise about 0 with a given grain size, shape [V]."""
    rng = np.random.default_rng(seed)
    direction = normalized(rng.normal(size=(6, 3)))
    phase = rng.uniform(0, 2 * np.pi, 6)
    return np.sin(mesh.vertices @ direction.T * (2 * np.pi / scale_m) + phase).sum(axis=1) / 3


def _here_and_there(mesh: Cloth, seed: int) -> Array:
    """Return a factor on folds, 0.15 to 1, so that some places have hardly any."""
    return 0.15 + 0.85 * smoothstep(-0.55, 0.75, wobble(mesh, 0.24, seed))


def arm_folds(m: Measures, mesh: Cloth, amount: float) -> Array:
    """Return folds of a sleeve [m]: rings at the elbow, a spiral along the arm, bunching above the wrist."""
    u, angle = m.along_arm(mesh)
    s, n = 0.26 * u, wobble(mesh, 0.13, 3)
    inner = 0.5 + 0.5 * np.cos(angle)
    rings = bump(u, 1.0, 0.26) * ridge(s / 0.034 + 0.35 * np.sin(angle) + 0.4 * n) * (0.35 + 0.65 * inner)
    spiral = 0.55 * ridge(s / 0.062 + angle / (2 * np.pi) + 0.5 * n) * smoothstep(0.15, 0.5, u)
    wrist = 0.9 * bump(u, 1.80, 0.14) * ridge(s / 0.026 + 0.2 * n)
    return amount * m.arms(mesh) * (rings + spiral + wrist) * _here_and_there(mesh, 1)


def trunk_folds(m: Measures, mesh: Cloth, amount: float, hem_y: float) -> Array:
    """Return folds of a shirt's trunk [m]: drawn from the armpits, slanting about the waist, falling to the hem."""
    x, y, _ = mesh.vertices.T
    azimuth, n = m.azimuth(mesh), wobble(mesh, 0.17, 5)
    trunk = 1 - m.arms(mesh)
    shoulder = m.rig.joint("left_shoulder")
    out, down = shoulder[0] - 0.02 - np.abs(x), shoulder[1] - 0.075 - y
    pull = ridge(np.arctan2(down, out) * 2.1 + 0.25 * n) * bump(np.hypot(out, down), 0.10, 0.065)
    waist = m.pelvis[1] + 0.07 * m.stature
    flank = 0.35 + 0.65 * np.sin(azimuth) ** 2
    slant = ridge((y + 0.05 * np.abs(np.sin(azimuth)) + 0.010 * n) / 0.058) * bump(y, waist, 0.085) * flank
    fall = ridge(azimuth * 5.5 / np.pi + 0.55 * n) * smoothstep(hem_y + 0.20, hem_y, y)
    return amount * trunk * (0.45 * pull + 0.8 * slant + 0.8 * fall) * _here_and_there(mesh, 2)


def leg_folds(m: Measures, mesh: Cloth, amount: float, end: float) -> Array:
    """Return folds of trousers [m] at crotch, knee and foot; ``end`` is where the leg of cloth ends."""
    u, angle, _ = m.along_leg(mesh)
    s, n = 0.42 * u, wobble(mesh, 0.15, 9)
    front = 0.5 + 0.5 * np.cos(angle)
    x, y, _ = mesh.vertices.T
    hip = m.rig.joint("left_hip")
    whisker = ridge((y - hip[1] - 0.55 * np.abs(x)) / 0.045 + 0.3 * n) * bump(u, 0.06, 0.10) * front
    knee = bump(u, 1.02, 0.20) * ridge(s / 0.040 + 0.3 * np.cos(angle) + 0.4 * n) * (1.1 - 0.6 * front)
    below = 0.5 * bump(u, 1.45, 0.25) * ridge(s / 0.075 + angle / (2 * np.pi) + 0.6 * n)
    rest = 1.25 * bump(u, end - 0.10, 0.13) * ridge(s / 0.036 + 0.25 * np.cos(angle) + 0.35 * n) * (0.4 + 0.6 * front)
    seat = 0.8 * bump(u, 0.20, 0.10) * ridge(y / 0.05 + 0.3 * n) * (1 - front)
    return amount * (whisker + knee + below + rest + seat) * _here_and_there(mesh, 3)


def between_legs(m: Measures, mesh: Cloth, lift: Array, gap_m: float = 0.0015) -> Array:
    """Return the lift, limited where the cloth of one leg would go into that of the other [m]."""
    from h3data.bodies.people.look.patches import vertex_normals

    up = vertex_normals(mesh.vertices.astype(np.float32), mesh.faces)
    inward = np.maximum(-up[:, 0] * np.sign(mesh.vertices[:, 0]), 0.0)
    room = np.maximum(np.abs(mesh.vertices[:, 0]) - gap_m, 0.0004)
    below = mesh.vertices[:, 1] < m.rig.joint("left_hip")[1] + 0.02
    return np.where(below & (inward > 0.05), np.minimum(lift, room / np.maximum(inward, 0.05)), lift)


# --- hems -------------------------------------------------------------------------------------------------------------
def border_edges(faces: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the directed edges of faces that no other face has in the opposite direction [E, 2]."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    size = int(faces.max()) + 1
    there = np.isin(edges[:, 0] * size + edges[:, 1], edges[:, 1] * size + edges[:, 0])
    return edges[~there]


def hemmed(draft: Draft, *, source: NDArray[np.int64] | None = None, close_m: float = 0.0004) -> Draft:
    """Return a draft with a strip at every border that turns in and ends close to the skin.

    It prevents views below the cloth. ``source`` numbers vertices that are the same, where colours take a sheet apart.
    """
    mesh = draft.mesh
    same = np.arange(len(mesh.vertices)) if source is None else source
    edges = border_edges(same[mesh.faces].astype(np.int32))
    first = np.full(int(same.max()) + 1, -1)
    first[same[::-1]] = np.arange(len(same))[::-1]
    used, compact = np.unique(edges, return_inverse=True)
    rows = first[used]
    outer = len(mesh.vertices) + np.arange(len(rows))
    inner = outer + len(rows)
    a, b = compact.reshape(-1, 2).T
    strip = np.concatenate(
        [
            np.stack([outer[b], outer[a], inner[a]], 1),
            np.stack([outer[b], inner[a], inner[b]], 1),
        ]
    )
    index = np.concatenate([np.arange(len(mesh.vertices)), rows, rows])
    shade = np.ones(len(mesh.vertices)) if draft.shade is None else draft.shade
    low = np.minimum(draft.lift[rows], close_m)
    return replace(
        draft,
        mesh=Sheet(
            vertices=mesh.vertices[index],
            weights=mesh.weights[index],
            slots=mesh.slots[index],
            faces=np.concatenate([mesh.faces, strip]).astype(np.int32),
        ),
        lift=np.concatenate([draft.lift, draft.lift[rows], low]),
        shade=np.concatenate([shade, 0.85 * shade[rows], np.full(len(rows), INSIDE_SHADE)]),
        weights=None if draft.weights is None else draft.weights[index],
    )


def border_loops(faces: NDArray[np.int32]) -> list[NDArray[np.int64]]:
    """Return the borders as closed rows of vertices."""
    following = dict(border_edges(faces).tolist())
    loops = []
    while following:
        start, at = next(iter(following.items()))
        loop = [start]
        del following[start]
        while at != start and at in following:
            loop.append(at)
            at = following.pop(at)
        loops.append(np.array(loop))
    return loops


# --- free forms -------------------------------------------------------------------------------------------------------
def free(ground: Ground, points: Array, faces: NDArray[np.int32], slot: int, part: str = "skin") -> Draft:
    """Return a draft of points in space, which move as the base below them."""
    corners, shares, _ = ground.attached(points, part)
    weights = np.einsum("vk,vkj->vj", shares, ground.body.weights[corners])
    mesh = Sheet(vertices=points, weights=weights, faces=faces, slots=np.full(len(points), slot, np.uint8))
    return Draft(mesh=mesh, lift=np.zeros(len(points)), shade=np.ones(len(points)))


def resampled(loop: Array, count: int) -> Array:
    """Return a closed row of points [N, 3] resampled to ``count`` equidistant points, starting in front."""
    loop = np.roll(loop, -int(np.argmax(loop[:, 2] - 0.2 * np.abs(loop[:, 0]))), axis=0)
    loop = np.concatenate([loop, loop[:1]])
    way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(loop, axis=0), axis=1))])
    at = np.linspace(0, way[-1], count, endpoint=False)
    return np.stack([np.interp(at, way, loop[:, k]) for k in range(3)], axis=1)


def tube(path: Array, across: Array, up: Array, width: Array, height: Array, sides: int = 8) -> tuple[Array, NDArray]:
    """Return points and faces of ellipses round a closed path [N, 3], with axes ``across`` and ``up`` [N, 3]."""
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.cos(angle)[None, :, None] * (width[:, None] * across)[:, None]
    ring = ring + np.sin(angle)[None, :, None] * (height[:, None] * up)[:, None]
    n = len(path)
    points = (path[:, None] + ring).reshape(-1, 3)
    faces = grid_faces(n + 1, sides) % (n * sides)
    a, b, c = (points[faces[:, k]] for k in range(3))
    center = np.repeat(path, sides, axis=0)[faces[:, 0]]
    outward = np.sum(np.cross(b - a, c - a) * (a - center)) > 0
    return points, faces if outward else faces[:, ::-1]


def turned_out(points: Array, faces: NDArray[np.int32], middle: Array) -> NDArray[np.int32]:
    """Return the faces, oriented so that most point away from a point."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    return faces if np.sum(np.cross(b - a, c - a) * (a - middle)) > 0 else faces[:, ::-1]


def along(points: Array) -> Array:
    """Return lengths along a row of points [N]."""
    return np.cumsum([0.0, *(float(np.linalg.norm(b - a)) for a, b in pairwise(points))])
