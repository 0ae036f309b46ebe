"""Hair as shells over the cage of the head: caps, curtains that hang from them, knots, tails, scarves; brows and beards."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from bake.people.look.base import HEAD_COLUMNS, HEAD_POLAR_DEG, HEAD_ROWS, grid_faces, sphere_grid
from bake.people.look.cloth import ROUND, free, ridge, turned_out, wobble
from bake.people.look.drafts import Draft, Ground, Sheet, cut, hollows, joined, only, over_surface, refined
from bake.people.look.measures import Measures, bump, smoothstep
from bake.people.look.skin import HAIRLINES, beard
from h3data.bodies.people.look.colors import SLOT
from h3data.bodies.people.skeleton import JOINT_COUNT, JOINT_INDEX
from h3data.geometry import Array, normalized

SUNK_M = -0.005
"""Offset below the skull at which a shell is invisible [m]."""
SHOULDER_ROOM_M = 0.034
"""Least distance of hanging hair from the shoulders, for the clothes there [m]."""


@dataclass(frozen=True, kw_only=True)
class Hair:
    """Hairstyle with its hairline, strands and lengths."""

    line: Literal["over ears", "short"] = "short"
    """Name of the hairline (`HAIRLINES`)."""
    top_m: float = 0.022
    side_m: float = 0.010
    strand_m: float = 0.0022
    """Depth of the furrows between strands."""
    strands: int = 34
    curl_m: float = 0.0
    """Size of curls; 0 = straight."""
    hang_m: float = 0.0
    """Length by which it hangs below the hairline at the back."""
    side_hang: float = 0.6
    """Hang at the temples, as a share of that at the back."""
    part_x: float | None = None
    """Place of the parting, in head widths from the middle."""
    bald: Literal["no", "receding", "crown"] = "no"
    knot: Literal["", "bun", "tail"] = ""
    fringe_m: float = 0.0
    """Length by which it hangs over the forehead."""
    scarf: bool = False


HAIR: dict[str, Hair] = {
    "crop": Hair(top_m=0.008, side_m=0.0065, strand_m=0.0006, strands=60),
    "short": Hair(top_m=0.024, side_m=0.009, part_x=0.35, strand_m=0.0028),
    "swept": Hair(top_m=0.034, side_m=0.008, strand_m=0.0035, strands=26),
    "tousled": Hair(top_m=0.028, side_m=0.018, curl_m=0.034, line="over ears", fringe_m=0.018, strand_m=0.002),
    "bob": Hair(line="over ears", top_m=0.020, side_m=0.020, hang_m=0.045, side_hang=1.45, part_x=0.15, fringe_m=0.0),
    "long": Hair(line="over ears", top_m=0.018, side_m=0.018, hang_m=0.200, side_hang=0.62, part_x=0.0),
    "tail": Hair(line="over ears", top_m=0.010, side_m=0.007, knot="tail", strand_m=0.0015, strands=44),
    "bun": Hair(line="over ears", top_m=0.012, side_m=0.008, knot="bun", strand_m=0.0015, strands=44),
    "curls": Hair(line="over ears", top_m=0.050, side_m=0.038, curl_m=0.026, strand_m=0.0),
    "waves": Hair(
        line="over ears",
        top_m=0.026,
        side_m=0.026,
        hang_m=0.030,
        side_hang=1.0,
        curl_m=0.040,
        part_x=0.3,
        strand_m=0.002,
    ),
    "receding": Hair(line="over ears", top_m=0.010, side_m=0.010, bald="receding", strand_m=0.0014, strands=50),
    "scarf": Hair(line="over ears", top_m=0.014, side_m=0.014, scarf=True, strand_m=0.003, strands=9),
}


class Skull:
    """The cage of the head on the pattern body, as a function of directions."""

    def __init__(self, ground: Ground) -> None:
        start = ground.base.starts["head"]
        self.grid = ground.body.vertices[start : start + HEAD_ROWS * HEAD_COLUMNS].reshape(HEAD_ROWS, HEAD_COLUMNS, 3)
        self.up = ground.normals[start : start + HEAD_ROWS * HEAD_COLUMNS].reshape(HEAD_ROWS, HEAD_COLUMNS, 3)
        middle = start + 9 * HEAD_COLUMNS
        self.ruler = (middle + HEAD_COLUMNS // 4, middle + 3 * HEAD_COLUMNS // 4)
        self.m = ground.base.measures

        ears = ground.base.masks["ears"]
        self.round_head, self.with_ears = Round(ground, ears < 0.2), Round(ground, ears >= 0.0)

    def at(self, polar_deg: Array, azimuth: Array, grid: Array | None = None) -> Array:
        """Return points of the cage [..., 3] at polar angles [deg] and azimuths [rad]."""
        g = self.grid if grid is None else grid
        row = np.clip((polar_deg - np.degrees(np.radians(0.5))) / (HEAD_POLAR_DEG - 0.5), 0, 1) * (HEAD_ROWS - 1)
        column = (azimuth / (2 * np.pi) * HEAD_COLUMNS) % HEAD_COLUMNS
        i, j = np.minimum(row.astype(int), HEAD_ROWS - 2), column.astype(int) % HEAD_COLUMNS
        a, b, k = (row - i)[..., None], (column - column.astype(int))[..., None], (j + 1) % HEAD_COLUMNS
        return (1 - a) * ((1 - b) * g[i, j] + b * g[i, k]) + a * ((1 - b) * g[i + 1, j] + b * g[i + 1, k])

    def line_deg(self, azimuth: Array, name: str) -> Array:
        """Polar angles [deg] of a hairline at azimuths [rad]."""
        from scipy.interpolate import PchipInterpolator

        knots = np.array(HAIRLINES[name])
        degrees = np.degrees(np.abs((azimuth + np.pi) % (2 * np.pi) - np.pi))
        height = PchipInterpolator(knots[:, 0], knots[:, 1] * 1e-3 * self.m.stature / 1.63)(degrees) + self.m.eye[1]
        polar = np.linspace(5, HEAD_POLAR_DEG, 120)
        y = self.at(np.broadcast_to(polar, (len(azimuth), 120)), np.broadcast_to(azimuth[:, None], (len(azimuth), 120)))
        return np.array([np.interp(-h, -row[:, 1], polar) for h, row in zip(height, y, strict=True)])


class Round:
    """Reach of head and neck from a vertical axis, by height and azimuth."""

    def __init__(self, ground: Ground, of: NDArray[np.bool_]) -> None:
        from scipy.ndimage import gaussian_filter, maximum_filter

        m = ground.base.measures
        self.z, self.low, self.high = m.head_z, float(m.neck_joint[1]) + 0.02, m.stature
        points = ground.body.vertices[: len(of)][of]
        x, y, z = points[points[:, 1] > self.low].T
        rows, columns = 44, 48
        row = ((y - self.low) / (self.high - self.low) * (rows - 1)).round().astype(int)
        column = np.floor((np.arctan2(x, z - self.z) + np.pi) / (2 * np.pi) * columns).astype(int) % columns
        radius = np.zeros((rows, columns))
        np.maximum.at(radius, (row, column), np.hypot(x, z - self.z))
        for _ in range(4):
            radius = np.where(radius > 0, radius, maximum_filter(radius, 3, mode=ROUND))
        radius = maximum_filter(radius, (3, 1), mode=ROUND)
        self.radius: Any = gaussian_filter(radius, 0.7, mode=ROUND)

    def __call__(self, points: Array) -> Array:
        """Return the distance of head and neck from the axis at the height and azimuth of points [..., 3] [m]."""
        from scipy.ndimage import map_coordinates

        rows, columns = self.radius.shape
        row = (points[..., 1] - self.low) / (self.high - self.low) * (rows - 1)
        column = (np.arctan2(points[..., 0], points[..., 2] - self.z) + np.pi) / (2 * np.pi) * columns - 0.5
        padded = np.concatenate([self.radius[:, -2:], self.radius, self.radius[:, :2]], axis=1)
        there = map_coordinates(padded, [np.clip(row, 0, rows - 1), column + 2], order=1)
        return np.where(row < 0, 0.0, there)


def _outside(head: Round, points: Array, room: Array) -> Array:
    """Return points moved away from the vertical axis until they are ``room`` [m] outside, if ``room`` is positive."""
    flat = (points - [0, 0, head.z]) * [1, 0, 1]
    r = np.maximum(np.linalg.norm(flat, axis=-1), 1e-6)
    wanted = np.where((room > 0) & (points[..., 1] < head.high - 0.045), head(points) + room, 0.0)
    return points + (np.clip(wanted / r - 1, 0, 1.0))[..., None] * flat


def hair(ground: Ground, spec: Hair, *, fine: bool) -> Draft:
    """Return a hairstyle over the cage of the head."""
    skull, m = Skull(ground), ground.base.measures
    rows, columns, hanging = (20, 72, 10) if fine else (7, 16, 3)
    azimuth = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    degrees = np.degrees(np.abs((azimuth + np.pi) % (2 * np.pi) - np.pi))
    end = skull.line_deg(azimuth, spec.line)
    if spec.fringe_m:
        end = end + np.degrees(spec.fringe_m / 0.10) * smoothstep(75, 40, degrees)
    if spec.scarf:
        end = end + 5 * smoothstep(30, 60, degrees)
    t = np.concatenate([np.linspace(0, 0.86, rows - 4), [0.91, 0.95, 0.98, 1.0]]) if fine else np.linspace(0, 1, rows)
    polar = t[:, None] * end
    around = np.broadcast_to(azimuth, polar.shape)
    anchor, up = skull.at(polar, around), normalized(skull.at(polar, around, skull.up))
    hang = spec.hang_m * np.interp(degrees, [0, 54, 72, 150, 180], [0, 0, spec.side_hang, 1, 1])
    # at the sides it ends above the shoulders
    room = skull.at(end, azimuth)[:, 1] - m.neck_joint[1] - 0.050
    hang = np.where(degrees < 118, np.minimum(hang, np.maximum(room, 0)), hang)
    lift = _thickness(spec, polar, np.broadcast_to(degrees, polar.shape), t[:, None], hang > 0.003, fine=fine)
    if spec.line == "over ears" or spec.hang_m:  # round the ears
        lift += 0.012 * bump(degrees, 96, 22) * smoothstep(62, 82, polar)
    points = anchor + lift[..., None] * up
    covers = (hang > 0.003) | spec.scarf
    points = _outside(skull.round_head, points, np.where((lift > 0.0005) & ~covers, 0.0055, -1.0))
    points = _outside(skull.with_ears, points, np.where((lift > 0.0005) & covers, 0.0050, -1.0))
    valley = np.zeros_like(lift)
    if spec.part_x is not None:
        side = points[..., 0] - spec.part_x * 0.075
        valley = bump(side, 0, 0.006 if fine else 0.012) * (np.cos(around) > -0.2) * smoothstep(4, 12, polar)
        points = points - (0.6 * lift * valley)[..., None] * up
    if hang.any():
        k = np.linspace(0, 1, hanging + 1)[1:, None]
        flat = normalized(np.stack([np.sin(azimuth), 0 * azimuth, np.cos(azimuth)], 1))
        # it falls straight, swings out a little, and its ends turn in
        sway = (0.010 * np.sin(np.pi * k) - 0.012 * smoothstep(0.75, 1.0, k)) * np.minimum(hang / 0.04, 1)
        fall = points[-1] + (k * -hang)[..., None] * [0, 1.0, 0] + sway[..., None] * flat
        fall[..., 2] -= 0.30 * np.minimum(hang, 0.10) * k * smoothstep(120, 80, degrees)
        fall = _outside(skull.with_ears, fall, np.where(hang > 0.003, 0.009, -1.0)[None])
        fall = _off_the_shoulders(ground, fall, (hang > 0.003) & (degrees > 85), points[-1])
        inner = 0.35 * fall[-1:] + 0.65 * points[-1:] - 0.016 * flat
        tucked = anchor[-1:] + SUNK_M * up[-1:]
        shell = np.concatenate([points, fall, fall[-1:] - 0.010 * flat * (hang > 0.003)[:, None], inner, tucked])
        low = np.concatenate([anchor, np.repeat(anchor[-1:], hanging + 3, axis=0)])
    else:
        shell, low = points, anchor
    count = len(shell)
    flat_points = shell.reshape(-1, 3)
    mesh = Sheet(
        vertices=low.reshape(-1, 3),
        weights=_hair_weights(m, flat_points),
        faces=grid_faces(count, columns),
        slots=np.full(len(flat_points), SLOT["scarf" if spec.scarf else "hair"], np.uint8),
    )
    shade = _streaks(
        spec, np.broadcast_to(azimuth, (count, columns)).ravel(), np.repeat(np.arange(count), columns), fine=fine
    )
    shade = shade * hollows(flat_points, mesh.faces, 60.0)
    if hang.any():
        shade[-3 * columns :] = 0.55
    if spec.part_x is not None:
        shade[: rows * columns] *= 1 - 0.35 * valley.ravel()
    draft = Draft(mesh=mesh, lift=np.zeros(len(flat_points)), offset=flat_points - mesh.vertices, shade=shade)
    extra: list[Draft] = []
    if spec.knot:
        extra.append(_knot(skull, spec.knot, fine=fine))
    if spec.scarf:
        extra.append(_wrap(ground, skull, fine=fine))
    return joined([draft, *extra])


def under_hair(ground: Ground, spec: Hair, points: Array) -> Array:
    """Return the distance of skin points [N, 3] inside the hairline [m]; -1 where little or no hair grows."""
    from scipy.ndimage import minimum_filter
    from scipy.spatial import KDTree

    skull, columns = Skull(ground), 72
    azimuth, t = np.linspace(0, 2 * np.pi, columns, endpoint=False), np.linspace(0, 1, 24)[:, None]
    polar = t * skull.line_deg(azimuth, spec.line)
    degrees = np.broadcast_to(np.degrees(np.abs((azimuth + np.pi) % (2 * np.pi) - np.pi)), polar.shape)
    lift = _thickness(spec, polar, degrees, t, np.zeros(polar.shape, bool), fine=False)
    modes: Any = ("nearest", "wrap")  # one for each axis
    around = minimum_filter(lift, (5, 7), mode=modes)  # also 1.5 cm further on
    cap = skull.at(polar, np.broadcast_to(azimuth, polar.shape)).reshape(-1, 3)
    away, near = KDTree(cap).query(points)
    inside = 0.10 * np.radians((polar[-1] - polar).ravel()[near])
    return np.where((away < 0.02) & (around.ravel()[near] > 0.0015), inside, -1.0)


def _thickness(spec: Hair, polar: Array, degrees: Array, t: Array, hangs: NDArray[np.bool_], *, fine: bool) -> Array:
    """Return how far the shell is off the skull [m]: full on top, thin towards the neck, sunk where nothing grows."""
    top = smoothstep(98, 20, polar)
    full = spec.side_m + (spec.top_m - spec.side_m) * top
    nape = 1 - 0.45 * smoothstep(95, 125, polar) * smoothstep(110, 150, degrees)
    edge = smoothstep(1.0, 0.72, t) ** 0.7
    # a forelock: hair stands up from the brow
    edge = np.where(degrees < 60, smoothstep(1.0, 0.66, t) ** 0.6, edge)
    lift = full * nape * np.where(hangs, np.maximum(edge, 0.85), edge)
    angle = np.radians(degrees)
    if spec.strand_m and fine:
        turns = angle * spec.strands / np.pi + 0.9 * np.sin(3 * t + 5 * angle)
        lift -= spec.strand_m * (1 - ridge(turns)) * smoothstep(0.03, 0.3, t)
    if spec.curl_m:
        size = 0.09 / spec.curl_m * (1.0 if fine else 0.5)
        curl = np.sin(size * 2.1 * (t * 3.2) + 4 * np.sin(size * angle * 0.9)) * np.sin(
            size * 2.0 * angle + 2.0 * t * size
        )
        lift += 0.22 * full * curl * smoothstep(0.0, 0.25, t) * smoothstep(1.0, 0.9, t)
    lift = np.where(hangs, lift, np.where(t > 0.985, SUNK_M, lift - 0.003 * smoothstep(0.9, 1.0, t)))
    if spec.bald == "no":
        return lift
    grows = smoothstep(58, 76, polar) * smoothstep(50, 72, degrees)
    if spec.bald == "crown":
        grows = np.maximum(grows, smoothstep(48, 60, polar))
    return grows * lift + (1 - grows) * SUNK_M


def _streaks(spec: Hair, azimuth: Array, row: NDArray[np.int64], *, fine: bool) -> Array:
    """Shade of strands: lighter and darker ones side by side."""
    if spec.scarf:
        return 1 - 0.10 * (1 - ridge(azimuth * 9 / np.pi + 0.12 * row))
    rng = np.random.default_rng(11)
    knots = rng.uniform(0.86, 1.10, 96)
    turn = (azimuth / (2 * np.pi) * 96 + (0.55 * np.sin(0.35 * row) if fine else 0)) % 96
    i = turn.astype(int) % 96
    f = turn - turn.astype(int)
    return (1 - f) * knots[i] + f * knots[(i + 1) % 96]


def _hair_weights(m: Measures, points: Array) -> Array:
    """Return the weights of hair: those of the head, and of the trunk for hair that hangs on the back."""
    weights = np.zeros((len(points), JOINT_COUNT))
    chin = m.eye[1] - 0.115
    low = 0.75 * smoothstep(chin - 0.01, chin - 0.14, points[:, 1])
    weights[:, JOINT_INDEX["head"]] = 1 - low
    weights[:, JOINT_INDEX["neck"]] = 0.35 * low
    weights[:, JOINT_INDEX["spine3"]] = 0.65 * low
    return weights


def _off_the_shoulders(ground: Ground, fall: Array, hangs: NDArray[np.bool_], roots: Array) -> Array:
    """Return the vertices of falling hair, those that hang pushed out of neck, shoulders and back."""
    skin = ground.base.part("skin")
    out = fall.copy()
    for _ in range(3):
        flat = out[:, hangs].reshape(-1, 3)
        corners, shares, _ = over_surface(flat, ground.body.vertices, skin, ground.normals)
        near = np.einsum("nk,nkj->nj", shares, ground.body.vertices[corners])
        up = normalized(np.einsum("nk,nkj->nj", shares, ground.normals[corners]))
        off = np.sum((flat - near) * up, axis=1)
        below = smoothstep(roots[:, 1].min(), roots[:, 1].min() - 0.05, flat[:, 1])
        room = SHOULDER_ROOM_M + 0.018 * bump(flat[:, 1], ground.base.measures.neck_joint[1] - 0.02, 0.05)
        push = np.clip((0.010 + (room - 0.010) * below) - off, 0, 0.06)
        flat = flat + push[:, None] * up * (np.array([1, 0.5, 1]))
        out[:, hangs] = flat.reshape(len(out), -1, 3)
    return out


def _knot(skull: Skull, kind: str, *, fine: bool) -> Draft:
    """Return a bun, or a tail with its band, at the back of the head."""
    back = skull.at(np.array([86.0 if kind == "bun" else 80.0]), np.array([np.pi]))[0]
    if kind == "bun":
        n = 9 if fine else 5
        grid = sphere_grid(n)
        radius = np.array([0.040, 0.037, 0.032]) * (
            1 + 0.05 * ridge(np.arctan2(grid[:, 0], grid[:, 1])[:, None] * 4 / np.pi)
        )
        points = back + [0, 0.006, -0.020] + grid * radius
        faces = grid_faces(n, 2 * n)
        shade = 0.94 + 0.14 * ridge(np.arctan2(grid[:, 0], grid[:, 1]) * 5 / np.pi + 1.4 * grid[:, 2])
    else:
        rows, sides = (14, 10) if fine else (5, 5)
        k = np.linspace(0, 1, rows)
        path = back + np.stack(
            [
                0 * k,
                0.014 * np.sin(np.pi * np.minimum(2 * k, 1)) - 0.235 * k**1.15,
                0.006 - 0.052 * np.sqrt(k) - 0.004 * k,
            ],
            1,
        )
        size = 0.021 * np.interp(k, [0, 0.06, 0.12, 0.5, 0.85, 1], [0.3, 0.62, 0.62, 1.1, 0.85, 0.12])
        angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
        ring = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], 1)
        tilt = smoothstep(0.35, 0.0, k)  # the first rings stand across the way out of the head
        around = ring[None] + tilt[:, None, None] * (np.stack([0 * angle, np.sin(angle), -0.4 * np.sin(angle)], 1))
        points = (path[:, None] + size[:, None, None] * around).reshape(-1, 3)
        faces = turned_out(points, grid_faces(rows, sides), path.mean(0))
        shade = (0.88 + 0.2 * np.random.default_rng(2).random(sides))[None].repeat(rows, 0).ravel()
        shade[: 2 * sides] *= 0.6
    weights = np.zeros((len(points), JOINT_COUNT))
    low = 0.7 * smoothstep(back[1] - 0.08, back[1] - 0.22, points[:, 1])
    weights[:, JOINT_INDEX["head"]], weights[:, JOINT_INDEX["spine3"]] = 1 - low, low
    mesh = Sheet(
        vertices=np.tile(back, (len(points), 1)),
        weights=weights,
        faces=faces,
        slots=np.full(len(points), SLOT["hair"], np.uint8),
    )
    return Draft(mesh=mesh, lift=np.zeros(len(points)), offset=points - back, shade=shade)


def _wrap(ground: Ground, skull: Skull, *, fine: bool) -> Draft:
    """Return a scarf round cheeks, chin and neck: rings from the edge of the cap down to the collar."""
    m = ground.base.measures
    rows, columns = (14, 48) if fine else (5, 14)
    azimuth = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    flat = np.stack([np.sin(azimuth), 0 * azimuth, np.cos(azimuth)], 1)
    degrees = np.degrees(np.abs((azimuth + np.pi) % (2 * np.pi) - np.pi))
    # the edge runs from the temples down the cheeks and under the chin
    edge_y = m.eye[1] + np.interp(
        degrees, [0, 22, 40, 55, 66, 80, 110, 180], [-0.124, -0.119, -0.096, -0.050, 0.005, 0.035, 0.020, -0.03]
    )
    skin = ground.body.vertices[: ground.base.starts["left last"]]
    near = skin[:, 1] > m.neck_joint[1] - 0.03
    axis = np.array([0, 0, m.head_z])
    cols = (
        np.floor(((np.arctan2(skin[:, 0], skin[:, 2] - axis[2]) + 2 * np.pi) % (2 * np.pi)) / (2 * np.pi) * 24).astype(
            int
        )
        % 24
    )
    k = np.linspace(0, 1, rows)
    low_y = m.neck_joint[1] - 0.010 - 0.030 * smoothstep(90, 0, degrees)
    y = edge_y[None] + k[:, None] * (low_y - edge_y)[None]
    radius = np.zeros((rows, columns))
    for r in range(rows):
        for c in range(columns):
            at = (
                near
                & (np.abs(skin[:, 1] - y[r, c]) < 0.014)
                & np.isin((cols - int(azimuth[c] / (2 * np.pi) * 24)) % 24, (0, 1, 23))
            )
            radius[r, c] = np.hypot(skin[at, 0], skin[at, 2] - axis[2]).max() if at.any() else 0.06
    radius = (np.roll(radius, 1, 1) + 2 * radius + np.roll(radius, -1, 1)) / 4
    radius = np.minimum(radius, 0.105)
    cloth = 0.007 + 0.012 * np.sin(np.pi * k)[:, None] + 0.004 * ridge(3.2 * k[:, None] + azimuth[None] / np.pi)
    cloth[0] = 0.004
    points = axis + (radius + cloth)[..., None] * flat + y[..., None] * [0, 1.0, 0]
    first = points[0] - 0.012 * flat  # turned in at the edge
    last = points[-1] - 0.020 * flat - [0, 0.012, 0]
    shell = np.concatenate([first[None], points, last[None]]).reshape(-1, 3)
    faces = turned_out(shell, grid_faces(rows + 2, columns), np.array([0, shell[:, 1].mean(), axis[2]]))
    corners, shares, _ = ground.attached(shell, "skin")
    own = np.einsum("vk,vkj->vj", shares, ground.body.weights[corners])
    anchor = skull.at(np.array([100.0]), np.array([np.pi]))[0]
    mesh = Sheet(
        vertices=np.tile(anchor, (len(shell), 1)),
        weights=own,
        faces=faces,
        slots=np.full(len(shell), SLOT["scarf"], np.uint8),
    )
    return Draft(mesh=mesh, lift=np.zeros(len(shell)), offset=shell - anchor, shade=hollows(shell, faces, 40.0))


# --- brows and beard --------------------------------------------------------------------------------------------------
def brows(ground: Ground, *, fine: bool) -> Draft:
    """Return both brows as ribbons on the face: level, arched a little, thinner outside."""
    from scipy.interpolate import griddata

    m = ground.base.measures
    columns, rows = (11, 4) if fine else (5, 2)
    a = np.linspace(-1, 1, columns)
    middle = np.interp(a, [-1, -0.5, 0.0, 0.4, 0.75, 1.0], [0.0196, 0.0212, 0.0226, 0.0232, 0.0218, 0.0190])
    half = np.interp(a, [-1, -0.75, 0.0, 0.6, 1.0], [0.0020, 0.0035, 0.0032, 0.0022, 0.0006])
    skin = ground.body.vertices[: ground.base.starts["left last"]]
    face = skin[(skin[:, 2] > m.eye[2] - 0.03) & (skin[:, 1] > m.eye[1] + 0.005) & (skin[:, 1] < m.eye[1] + 0.05)]
    parts = []
    for sign in (1.0, -1.0):
        x = np.broadcast_to(sign * (m.eye_x + 0.0015 + 0.0200 * a), (rows, columns))
        way = np.linspace(1, -1, rows)[:, None]
        y = m.eye[1] + middle[None] + way * half[None]
        z = griddata(face[:, :2], face[:, 2], np.stack([x, y], -1).reshape(-1, 2), method="linear", fill_value=m.eye[2])
        points = np.stack([x.ravel(), y.ravel(), z], 1)
        faces = grid_faces(rows, columns, closed=False)
        p, q, r = (points[faces[:, k]] for k in range(3))
        faces = faces if np.cross(q - p, r - p)[:, 2].sum() > 0 else faces[:, ::-1]
        draft = free(ground, points, faces, SLOT["brows"])
        lift = (0.0016 - 0.0009 * np.abs(way) + 0 * x).ravel() if fine else np.full(points.shape[0], 0.0028)
        rng = np.random.default_rng(7)
        parts.append(replace(draft, lift=lift, shade=rng.uniform(0.9, 1.15, len(points))))
    return joined(parts)


def beard_draft(ground: Ground, skin: Sheet, *, fine: bool) -> Draft:
    """Return a short full beard."""
    m = ground.base.measures
    corners, shares, _ = ground.attached(skin.vertices, "skin")
    lips = np.einsum("vk,vk->v", shares, ground.base.masks["lips"][corners])
    grows = np.minimum(beard(m, skin), (0.35 - lips) * 0.02)
    s, side = cut(skin, lambda _: grows)
    s = only(s, side)
    if fine:
        s = refined(s, lambda mesh: np.ones(len(mesh.vertices), bool), longer_m=0.007)
    corners, shares, _ = ground.attached(s.vertices, "skin")
    lips = np.einsum("vk,vk->v", shares, ground.base.masks["lips"][corners])
    depth = np.minimum(beard(m, s), (0.35 - lips) * 0.03)
    chin = bump(np.hypot(s.vertices[:, 0], s.vertices[:, 1] - m.eye[1] + 0.125), 0, 0.045)
    lift = (0.003 + 0.005 * chin) * smoothstep(0.0, 0.012, depth) + 0.0012 * wobble(s, 0.012, 8) * smoothstep(
        0.004, 0.015, depth
    )
    s = replace(s, slots=np.full(len(s.vertices), SLOT["hair"], np.uint8))
    shade = 0.95 + 0.12 * wobble(s, 0.010, 5)
    return Draft(mesh=s, lift=lift, shade=shade)
