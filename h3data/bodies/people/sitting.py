"""Sitting and lying down on seats of any height, with the soles on the floor and the body supported by the seat.

The pose on the seat follows from contact alone. The shanks are upright, the skin of the hips touches the seat, and the
hands lie on the thighs. The seat's front edge is as far forward as the skin of legs and hips allows. On the path
between standing and sitting the hips go back before they go down, and the trunk leans forward meanwhile, which keeps
the weight over the feet.

To lie down, a person draws the knees up until the feet are over the surface, turns on the hips, stretches the legs and
leans back. Hips, upper back, head and calves of a lying person touch the surface.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from h3data.bodies.people.clips import TO_ROOT
from h3data.bodies.people.gait import stand_posture
from h3data.bodies.people.gestures import lead_wrists
from h3data.bodies.people.kernels.postures import blend_rows
from h3data.bodies.people.legs import SIDES, Posture, X, rotation, solve_legs
from h3data.bodies.people.skeleton import JOINT_INDEX
from h3data.errors import InputError
from h3data.geometry import (
    IDENTITY_POSE,
    Array,
    normalized,
    quat_from_matrix,
    quat_multiply,
    quat_nlerp,
    quat_rotate,
    smoothstep,
)

if TYPE_CHECKING:
    from h3data.bodies.people.humanoid import Humanoid

SINK_M = 0.005
"""Depth by which a seat yields under the hips [m], and the largest depth of all other skin in it."""
LEAN_DEG, LEAN_EARLY = 44.0, 0.8
"""Largest lean of the trunk between standing and sitting, and the exponent that shifts it in time towards standing."""
BACK_FIRST, DOWN_LATE = 1.7, 1.2
"""Exponents of the path of the hips, which move back before they move down."""
HAND_ALONG, HAND_OVER_M, HAND_OUT_M = 0.6, 0.12, 0.02
"""Position of a wrist along the thigh, as a share, above its axis, and outwards."""
TWIST_DEG, WRIST_DEG = 35.0, 22.0
"""Twist of forearm and of wrist that turns palms down, and the extension of the wrist."""
PATH_SINK_M, BUTTOCKS_M = 0.012, 0.03
"""Depth by which skin may be behind the front edge on the path [m]. Skin that is further ahead of the pelvis than `BUTTOCKS_M`
does not carry: thighs that slope down would lift the body."""
STEEPEST = 0.75
"""Greatest slope of the thighs: height difference of hips and knees as a share of the thigh's length."""
ARMS_BY, EARLY = 0.6, 0.05
"""Share of the path at which the hands are on the thighs, because hanging hands would pass through the seat; share over
which a standing person's own pose is blended into the path."""
TABLE = 61
"""Number of poses between standing and sitting that are computed for one seat, and between sitting and lying; other
poses are interpolated."""
TUCKED, TURNED, STRETCHED, RECLINES = 1.34, 1.64, 1.86, 1.72
"""Shares of the path, from 1 (sitting) to 2 (lying), at which the knees are drawn up, the person has turned, the legs are
stretched, and the trunk begins to lie back."""
TUCK_DEG, LYING_DEG = np.array([-36.0, 24.0, 8.0, 134.0, 76.0, 8.0]), np.array([-90.0, 0.0, 4.0, 90.0, 90.0, 28.0])
"""Postures with drawn-up knees and lying: pitch of the pelvis, bend of the spine and of the neck, forward positive; angles of
thighs and shanks with the vertical, ahead positive; and how far the feet are stretched."""
LYING_PARTS = (
    ("pelvis",),
    ("spine3", "left_collar", "right_collar"),
    ("head",),
    ("left_knee", "right_knee", "left_ankle", "right_ankle"),
)
BELLY, LYING_ELBOWS = (-0.055, 0.07, 0.035), (-0.2, -0.25, 1.0)
"""Positions of the wrists of a lying person relative to the pelvis, in body heights, and the direction of the elbows:
ahead, up and outwards."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sitting:
    """Motion of one body that sits down on a seat of one height, while its agent root stays at the standing position."""

    body: Humanoid
    seat_m: float
    """Height of the seat above the floor [m]."""
    edge_m: float
    """Position of the seat's front edge ahead of the agent root [m]; it is negative because the person faces away from
    the seat."""
    back_m: float
    """Position of the rearmost point of the seated body ahead of the agent root [m], which is negative."""
    seated: tuple[Array, Array]
    """Rotations [55, 4] and pelvis position [3] [m] on the seat, in the body frame."""

    def pose(self, share: ArrayLike) -> tuple[Array, Array]:
        """Return local rotations [T, 55, 4] and pelvis positions [T, 3] [m] of sitting down, in the agent root frame.

        ``share`` [T] is the progress from standing (0) to sitting (1).
        """
        share = np.atleast_1d(np.asarray(share, np.float64))
        stand = stand_posture(self.body.gaits.legs, len(share))
        quats, pelvis = self.seated
        weight = np.repeat(share, quats.shape[0])
        mixed = quat_nlerp(stand.quats.reshape(-1, 4), np.tile(quats, (len(share), 1)), weight)
        mixed = mixed.reshape(stand.quats.shape)
        lean = LEAN_DEG * np.sin(np.pi * share**LEAN_EARLY)
        # parts of the joints in the lean; neck and head keep the eyes nearly ahead
        for name, part in (
            ("pelvis", 0.62),
            ("spine1", 0.14),
            ("spine2", 0.14),
            ("spine3", 0.1),
            ("neck", -0.25),
            ("head", -0.25),
        ):
            own = quat_from_matrix(rotation(X, part * lean))
            mixed[:, JOINT_INDEX[name]] = quat_multiply(own, mixed[:, JOINT_INDEX[name]])
        # back before down: the weight stays over the feet
        back, down = 1 - (1 - share) ** BACK_FIRST, share**DOWN_LATE
        path = stand.pelvis + np.stack([back * 0, down, back], axis=1) * (pelvis - stand.pelvis)
        mixed, path = _in_root(self.body, Posture(quats=mixed, pelvis=path, ankle=stand.ankle, foot=stand.foot))
        _lay_hands_on_thighs(self.body, mixed, path, smoothstep(np.minimum(share / ARMS_BY, 1.0)))
        return mixed, path

    @cached_property
    def table(self) -> tuple[Array, Array]:
        """Poses at `TABLE` equal shares of the path from standing (0) to sitting (1)."""
        return self.pose(np.linspace(0, 1, TABLE))

    @cached_property
    def lying(self) -> tuple[Array, Array]:
        """Poses at `TABLE` equal shares of the path from sitting (1) to lying (2), during which the agent root turns."""
        body, share = self.body, np.linspace(1, 2, TABLE)
        owners = body.lod.owners
        parts = [np.isin(owners, [JOINT_INDEX[name] for name in names]) for names in LYING_PARTS]
        flat = LYING_DEG.copy()
        # parts of the body that touch a surface on which somebody lies, and the distances of all but the
        # first from the joint that lowers them, in body heights
        levers = np.array([0.2, 0.12, 0.4])
        # what touches decides how far back, neck and legs are turned: each part is lowered or lifted to where the hips are
        for _ in range(8):
            quats = self._laid_out(flat[None])
            skin = body.skin(body.joint_matrices(IDENTITY_POSE, quats, np.zeros((1, 3))), plain=True)[0]
            hips, *others = (float(skin[part, 1].min()) for part in parts)
            trunk, head, legs = np.degrees((np.array(others) - hips) / levers / body.height_m)
            flat += (-trunk, 0.0, trunk - head, -legs, -legs, 0.0)
        drawn, stretched, back, arms_by = (
            smoothstep(np.clip((share - begin) / (end - begin), 0, 1))[:, None]
            for begin, end in ((1, TUCKED), (TURNED, STRETCHED), (RECLINES, 2), (TURNED, 2))
        )
        seated, pelvis = (np.repeat(part, TABLE, 0) for part in self.pose(1.0))
        quats = self._laid_out(TUCK_DEG + np.where(np.arange(6) < 3, back, stretched) * (flat - TUCK_DEG))
        quats = quat_nlerp(seated.reshape(-1, 4), quats.reshape(-1, 4), np.repeat(drawn, 55)).reshape(seated.shape)
        _lay_hands_on_thighs(body, quats, pelvis, np.ones(TABLE))
        belly = pelvis[:, None] + body.height_m * np.array([BELLY, BELLY]) * ((1.0, 1.0, -1.0), (1.0, 1.0, 1.0))
        lead_wrists(body, quats, pelvis, belly, arms_by[:, 0], pole=LYING_ELBOWS, twist_deg=TWIST_DEG)
        skin = body.skin(body.joint_matrices(IDENTITY_POSE, quats, pelvis), plain=True)
        # skin before the front edge need not be above the surface until the feet are over it, and skirts give way
        above = (skin[..., 0] < self.edge_m - 2 * PATH_SINK_M) | (share >= TUCKED)[:, None]
        hips_of_legs = [JOINT_INDEX[f"{side}_hip"] for side, _, _ in SIDES]
        above &= ~np.isin(owners, hips_of_legs)
        pelvis[:, 1] += self.seat_m - SINK_M - np.where(above, skin[..., 1], np.inf).min(1)
        return quats, pelvis

    @cached_property
    def lying_size(self) -> Array:
        """Distances from the hips of a lying person to head, toes and sides [3] [m]."""
        skin = self.body.skin(self.body.joint_matrices(IDENTITY_POSE, *(part[-1:] for part in self.lying)), plain=True)[
            0
        ]
        ahead = skin[:, 0] - self.lying[1][-1, 0]
        return np.array([-ahead.min(), ahead.max(), np.abs(skin[:, 2]).max()])

    def _laid_out(self, angles: Array) -> Array:
        """Return rotations [T, 55, 4] in the agent root frame for postures as `LYING_DEG`, [T, 6]."""
        quats = stand_posture(self.body.gaits.legs, len(angles)).quats.copy()
        pitch, spine, neck, thigh, shank, foot = angles.T
        turns = {"pelvis": pitch, **dict.fromkeys(("spine1", "spine2", "spine3"), spine / 3)}
        turns |= {"neck": neck / 2, "head": neck / 2}
        for side, *_ in SIDES:
            turns |= {f"{side}_hip": -thigh - pitch, f"{side}_knee": thigh - shank, f"{side}_ankle": foot}
        for name, angle in turns.items():
            quats[:, JOINT_INDEX[name]] = quat_from_matrix(rotation(X, angle))
        quats[:, 0] = quat_multiply(TO_ROOT, quats[:, 0])
        return quats

    def fits(self, depth_m: float) -> bool:
        """Return whether the hips are over a seat of this depth [m] and the back is in front of the seat's backrest or wall."""
        return self.edge_m - self.back_m <= depth_m + SINK_M


def take_seats(body: Humanoid, quats: Array, pelvis: Array, seats: ArrayLike) -> None:
    """Change poses of standing people to sitting or lying on seats, in place.

    Args:
        body: Body of the people.
        quats: Local rotations [T, 55, 4].
        pelvis: Positions of the pelvis in the agent root frame [T, 3] [m].
        seats: Height of the seat above the floor [m], and share of the path from standing (0) to sitting (1) and lying
            (2) on it, [T, 2].

    Raises:
        InputError: there are not two finite numbers for each pose, or a seat does not fit the legs of this body.
    """
    seats = np.asarray(seats, np.float64)
    if seats.shape != (len(quats), 2) or not np.isfinite(seats).all() or (seats[:, 1] > 2).any():
        raise InputError(
            f"Expected the height of a seat and a share of at most 2 for {len(quats)} poses, finite numbers of shape "
            f"[{len(quats)}, 2], got shape {list(seats.shape)}.",
            code="H3-BODY-179",
        )
    rows = np.flatnonzero(seats[:, 1] > 0)
    if not len(rows):
        return
    # by millimetres, because each height has a table of its own, which is cached
    heights, lying = seats[rows, 0].round(3), seats[rows, 1] > 1
    for height, lies in sorted(set(zip(heights.tolist(), lying.tolist(), strict=True))):
        own, sitting = rows[(heights == height) & (lying == lies)], sitting_on(body, height)
        turns, places = sitting.lying if lies else sitting.table
        at = (seats[own, 1] - lies) * (TABLE - 1)
        low = np.minimum(at.astype(np.intp), TABLE - 2)
        share, early = at - low, smoothstep(np.minimum(seats[own, 1] / EARLY, 1.0))
        there, place = turns[low], places[low] + share[:, None] * (places[low + 1] - places[low])
        blend_rows(there, np.arange(len(own)), turns[low + 1], share)
        blend_rows(quats, own, there, early)
        pelvis[own] += early[:, None] * (place - pelvis[own])


@lru_cache(maxsize=256)
def sitting_on(body: Humanoid, seat_m: float) -> Sitting:
    """Return the motion by which a body sits down on a seat at a height above the floor [m].

    Computing it takes about 10 ms, and it is cached.

    Raises:
        InputError: the seat is too high or too low for the legs of this body.
    """
    legs = body.gaits.legs
    stand = stand_posture(legs)
    quats = stand.quats[0].copy()
    # pitch of each joint of the trunk of a seated person, forward positive
    seated_deg = (("pelvis", -14.0), ("spine1", 5.0), ("spine2", 4.0), ("spine3", 3.0), ("neck", 2.0), ("head", 2.0))
    for name, angle in seated_deg:
        quats[JOINT_INDEX[name]] = quat_from_matrix(rotation(X, angle))
    hips = rotation(X, seated_deg[0][1]) @ legs.hips[0]
    ankle = stand.ankle[0, 0]
    # distance by which the knees of a seated person are ahead of the ankles
    knee_ahead_m = 0.04
    knee_y = ankle[1] + np.sqrt(legs.shank**2 - knee_ahead_m**2)
    pelvis = np.array([0.0, seat_m + 0.1, 0.0])
    of_hips = [JOINT_INDEX[name] for name in ("pelvis", "left_hip", "right_hip")]
    seat_skin = np.isin(body.lod.owners, of_hips)
    # contact sets the height of the hips, the legs then their place, which moves the skin: five rounds settle it
    for _ in range(5):
        drop = pelvis[1] + hips[1] - knee_y
        # the hip joints are further apart than the feet, so the thighs go a little inwards
        flat = legs.thigh**2 - drop**2 - (abs(hips[0]) - abs(ankle[0])) ** 2
        if not (np.isfinite(drop) and abs(drop) <= STEEPEST * legs.thigh):
            raise InputError(
                f"{body.name} cannot sit with the feet on the floor on a seat at {seat_m:.2f} m. Expected a "
                f"{'lower' if drop > 0 else 'higher'} seat.",
                code="H3-BODY-178",
            )
        pelvis[2] = ankle[2] + knee_ahead_m - np.sqrt(flat) - hips[2]
        posed = _in_root(body, Posture(quats=quats[None], pelvis=pelvis[None], ankle=stand.ankle, foot=stand.foot))
        # from the agent root's axes, forward, up and right, to right, up and forward
        vertices = body.skin(body.joint_matrices(IDENTITY_POSE, *posed), plain=True)[0][:, ::-1]
        under = seat_skin & (vertices[:, 2] < pelvis[2] + BUTTOCKS_M)
        pelvis[1] += seat_m - SINK_M - vertices[under, 1].min()
    draft = Sitting(body=body, seat_m=seat_m, edge_m=0.0, back_m=0.0, seated=(quats, pelvis))
    # shares of the path at which the front edge is kept out of the body
    shares_of_path = np.linspace(0.4, 1.0, 13)
    roots = np.tile(IDENTITY_POSE, (len(shares_of_path), 1))
    skin = body.skin(body.joint_matrices(roots, *draft.pose(shares_of_path)), plain=True)
    ahead = skin[..., 0] + np.where(shares_of_path < 1, PATH_SINK_M, SINK_M)[:, None]
    # skin below the height of the seat would be in it if the edge were further forward
    edge = float(ahead[skin[..., 1] < seat_m - PATH_SINK_M].min())
    return replace(draft, edge_m=edge, back_m=float(skin[-1, :, 0].min()))


def _in_root(body: Humanoid, posture: Posture) -> tuple[Array, Array]:
    quats = solve_legs(body.gaits.legs, posture).quats
    quats[:, 0] = quat_multiply(TO_ROOT, quats[:, 0])
    return quats, quat_rotate(TO_ROOT, posture.pelvis)


def _lay_hands_on_thighs(body: Humanoid, quats: Array, pelvis: Array, share: Array) -> None:
    """Lead the hands of poses to the thighs by shares [T], in place."""
    places, targets = body.joint_matrices(IDENTITY_POSE, quats, pelvis)[..., :3, 3], []
    for side, sign, _ in SIDES:
        hip, knee = (JOINT_INDEX[f"{side}_{name}"] for name in ("hip", "knee"))
        thigh = places[:, knee] - places[:, hip]
        over = np.cross(thigh, np.array([0.0, 0.0, 1.0]))
        target = places[:, hip] + HAND_ALONG * thigh - HAND_OVER_M * normalized(over)
        target[:, 2] -= sign * HAND_OUT_M
        targets.append(target)
    # direction of the elbows: back, down and outwards
    elbows = (-0.6, -0.2, 0.55)
    lead_wrists(body, quats, pelvis, np.stack(targets, 1), share, pole=elbows, twist_deg=TWIST_DEG, wrist_deg=WRIST_DEG)
