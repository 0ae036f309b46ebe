"""Habitat's humanoid controller, frame for frame, as habitat-lab plays its motion files.

The people of h3data walk by distance with planted feet (`h3data.bodies.people.clips`). This module is for comparison
and for recordings that must look as in Habitat. It has Habitat's integer frames, turns of at most one step, reach by
interpolation between stored poses (spec/habitat.md 3.4 and 3.5), and errors (h3data docs motion lists them).

Frames, as in habitat-lab. The *base* has x forward, y left, z up; its origin is 0.9 m above the floor. The *root* is the
SMPL-X pelvis frame with x left, y up, z forward. 4x4 matrices act on column vectors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies.people.skeleton import FINGERS, HUMAN_ROOT_HEIGHT_M, JOINT_NAMES
from h3data.errors import InputError
from h3data.geometry import Array, normalized, pose_from_matrix, quat_to_matrix

MIN_TURN_DEG = 5.0
"""Angle below which a new direction is taken at once [deg]."""
TURN_STEP_DEG = 20.0
"""Largest turn per step, and the turn above which people do not advance, unless speeds were given [deg]."""
STOP_M = 1e-9
DIRECTIONAL_STOP_M = 1e-5
DIRECTIONAL_FPS = 30.0
DIRECTIONAL_TURNING_M = 0.05
"""Largest distance that `HabitatHumanoid.walk_directional` covers in a step in which it turns [m]."""
DIRECTIONAL_TURN_FACTOR = 20
"""Factor of the usual turn per step when a direction to look in is given."""
CONTROL_HZ = 120.0


def _depth_first(side: str) -> list[str]:
    arm = [f"{side}_{part}" for part in ("collar", "shoulder", "elbow", "wrist")]
    return arm + [f"{side}_{finger}{k}" for finger in FINGERS for k in (1, 2, 3)]


HABITAT_JOINTS: tuple[str, ...] = (
    *(f"{side}_{part}" for side in ("left", "right") for part in ("hip", "knee", "ankle", "foot")),
    *("spine1", "spine2", "spine3", "neck", "head", "jaw", "left_eye_smplhf", "right_eye_smplhf"),
    *_depth_first("left"),
    *_depth_first("right"),
)
"""The 54 joints in the order of Habitat's joint vectors: depth first over the SMPL-X tree, without the pelvis."""

Hand = Literal["left", "right"]


@dataclass(frozen=True, kw_only=True, eq=False)
class HabitatClip:
    """A sequence of whole-body poses."""

    joints: Array
    """Local rotations xyzw of `HABITAT_JOINTS`, shape [N, 54, 4]."""
    roots: Array
    """Root matrices, shape [N, 4, 4]."""
    fps: float
    displacement: Array | None = None
    """Distance walked since the first frame, shape [N] [m]; None for clips that do not walk."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReachGrid:
    """Poses in which one hand is at the points of a grid, relative to the base, axes left, up, forward."""

    joints: Array
    """Joint rotations of the poses, shape [K, 54, 4]: point (x, y, z) is row y * nx * nz + x * nz + z."""
    roots: Array
    """Root transforms of the poses, shape [K, 4, 4]."""
    low: Array
    """Position of the first grid point, shape [3] [m]."""
    high: Array
    """Position of the last grid point, shape [3] [m]."""
    bins: tuple[int, int, int]
    """Number of points per axis."""


@dataclass(frozen=True, kw_only=True, eq=False)
class HabitatMotion:
    """Contents of a ``*_motion_data_smplx.pkl``: a walk, the posture of standing still, and grids of reaching poses."""

    walk: HabitatClip
    stop_joints: Array
    """Rotations of the joints when standing, shape [54, 4]."""
    stop_root: Array
    """Root transform when standing, shape [4, 4]."""
    hands: Mapping[Hand, ReachGrid] = field(default_factory=dict)
    """Grids of the hands in the order of the file; Habitat uses the last one's grid for both hands."""


def _turn(axis: int, degrees: float) -> Array:
    """Return the 4x4 rotation about axis 0, 1 or 2."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix = np.eye(4)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    matrix[[j, j, k, k], [j, k, j, k]] = c, -s, s, c
    return matrix


_HALF_TURN = _turn(1, 180)
_BASE_OF_ROOT = _turn(2, -90) @ _turn(1, -90)
"""Axes of the root in terms of the base."""
_ROOT_OF_REACH = _turn(1, -90) @ _turn(2, -90)
_REACH_OF_BASE = _turn(1, -90) @ _turn(0, -90)
_WITHOUT_FORWARD = np.array([1.0, 1.0, 0.0])


def base_matrix(position: ArrayLike, forward: ArrayLike) -> Array:
    """Return the base frame [4, 4] at ``position`` [3] that looks along the horizontal unit vector ``forward`` [3]."""
    x, y, z = np.asarray(forward, np.float64)
    matrix = np.eye(4)
    matrix[:3] = np.stack([[x, y, z], [z, 0, -x], [0, 1, 0], np.asarray(position, np.float64)], axis=1)
    return matrix


class HabitatHumanoid:
    """Humanoid that walks, turns and reaches exactly as habitat-lab's ``HumanoidRearrangeController`` (main).

    After each call ``joints`` [54, 4] (order `HABITAT_JOINTS`), ``offset`` [4, 4] and ``base`` [4, 4] hold what
    habitat-lab puts into its ``humanoidjoint_action``, `root` where the pelvis is, `columns` what recordings store.
    """

    def __init__(
        self,
        motion: HabitatMotion,
        *,
        lin_speed: float | None = None,
        ang_speed: float | None = None,
        control_hz: float = CONTROL_HZ,
        joint_names: Sequence[str] = HABITAT_JOINTS,
    ) -> None:
        """Create a humanoid; ``joint_names`` is the order of the file's joint vectors, which motion files do not state.

        ``lin_speed`` and ``ang_speed`` are Habitat's (10 = 2.5 m/s and 2.5 rad/s at 30 steps/s); None plays 30 frames/s
        and turns 20 degrees a step."""
        walk = motion.walk
        if walk.displacement is None:
            raise InputError(
                "A walking clip needs its displacement. Hint: this file holds a sequence, not a walk.",
                code="H3-BODY-025",
            )
        if sorted(joint_names) != sorted(HABITAT_JOINTS):
            raise InputError(
                f"Expected the 54 SMPL-X joints without the pelvis, in any order, got {len(joint_names)} names.",
                code="H3-BODY-026",
            )
        # columns of recordings are in SMPL-X order, without the pelvis
        self._order = [list(joint_names).index(name) for name in JOINT_NAMES[1:]]
        self.motion = motion
        self._displacement = np.asarray(walk.displacement, np.float64)
        self._way_per_frame = float(self._displacement[-1]) / len(walk.joints)
        frames_per_second = 30.0
        self._turn_step = TURN_STEP_DEG
        if lin_speed is not None and ang_speed is not None:
            frames_per_second = walk.fps / (lin_speed / control_hz / self._way_per_frame)
            self._turn_step = float(np.degrees(ang_speed / control_hz))
        # whole frames, cut off: the source of Habitat's uneven walk
        self._frames_per_step = int(walk.fps / frames_per_second)
        self.frame = 0
        self.reset(base_matrix((0, HUMAN_ROOT_HEIGHT_M, 0), (1, 0, 0)))

    def reset(self, base: ArrayLike) -> None:
        """Stand at a base frame [4, 4]; the gait continues at its last frame."""
        self.base = np.array(base, np.float64)
        self.offset = np.eye(4)
        self.joints = np.asarray(self.motion.stop_joints, np.float64)
        self._forward = self.base[:3, 0].copy()

    # --- commands ---------------------------------------------------------------------------------------------------
    def stop(self) -> None:
        """Take the standing pose at the current base."""
        self.joints = np.asarray(self.motion.stop_joints, np.float64)

    def turn(self, target: ArrayLike) -> None:
        """Turn towards a direction [3] on the spot for one step."""
        self.walk(target, 0.0)

    def walk(self, target: ArrayLike, distance_multiplier: float = 1.0) -> None:
        """Walk one step towards ``target`` [3] [m], relative to the base, world axes (spec/habitat.md 3.4)."""
        aim = np.asarray(target, np.float64)
        left = float(np.linalg.norm(aim))
        if not left >= STOP_M:  # NaN too
            self.stop()
            return
        angle = float(np.degrees(np.arctan2(aim[0], aim[2])))
        before = float(np.degrees(np.arctan2(self._forward[0], self._forward[2])))
        change = _within_half_turn(angle - before)
        turns = abs(change) > MIN_TURN_DEG
        if turns:
            angle = before + min(self._turn_step, abs(change)) * np.sign(change)
            # whoever has to turn further than a step does not advance, whatever the distance
            left = 0.0 if abs(change) >= self._turn_step else 2 * self._way_per_frame
        heading = np.radians(angle)
        self._forward = np.array([np.sin(heading), 0.0, np.cos(heading)])
        self._advance(left, self._frames_per_step, distance_multiplier, self._forward)

    def _advance(self, left: float, frames: int, distance_multiplier: float, going: Array) -> None:
        """Play up to ``frames`` frames, but no more than the way ``left`` [m] takes, and move along ``going`` [3]."""
        step = 0 if distance_multiplier == 0 else max(1, min(frames, int(left / self._way_per_frame)))
        frame = (self.frame + step) % len(self.motion.walk.joints)
        way = self._displacement[frame] - self._displacement[self.frame]
        # the clip began anew within this step
        if frame < self.frame:
            way += self._displacement[-1]
        self.frame = frame
        move = min(left, max(0.0, float(way))) * distance_multiplier
        self.base = base_matrix(self.base[:3, 3] + going * move, self._forward)
        self._show(frame)

    def _show(self, frame: int) -> None:
        """Take the pose of a frame of the walk."""
        clip = self.motion.walk
        self.offset = _without_forward(_HALF_TURN @ clip.roots[frame])
        self.joints = np.asarray(clip.joints[frame], np.float64)

    def walk_directional(
        self, target: ArrayLike, distance_multiplier: float = 1.0, look: ArrayLike | None = None
    ) -> None:
        """Walk one step towards ``target`` [3] [m] while facing ``look`` [3], both relative to the base, world axes.

        This is habitat-hitl's ``calculate_walk_pose_directional``, for walking backwards. It plays 30 frames/s at any
        speed. A body that has to turn by more than `MIN_TURN_DEG` moves in the direction in which it looks, by at most
        5 cm.
        """
        aim = np.asarray(target, np.float64)
        left = float(np.linalg.norm(aim))
        if not left >= DIRECTIONAL_STOP_M:  # NaN too
            self.stop()
            return
        facing = aim if look is None else np.asarray(look, np.float64)
        angle, going = _bearing(facing), _bearing(aim)
        before = _bearing(self._forward)
        change = _within_half_turn(angle - before)
        if abs(change) > MIN_TURN_DEG:
            largest = self._turn_step * (1 if look is None else DIRECTIONAL_TURN_FACTOR)
            angle = going = before + min(largest, abs(change)) * np.sign(change)
            left = DIRECTIONAL_TURNING_M
        self._forward = _level(angle)
        frames = int(self.motion.walk.fps / DIRECTIONAL_FPS)
        self._advance(left, frames, distance_multiplier, _level(going))

    def with_gait(self, forward_m: float, turn_rad: float) -> None:
        """Move the base by ``forward_m`` [m] and turn it by ``turn_rad``, and find the frame of the clip that fits.

        This is habitat-hitl's ``translate_and_rotate_with_gait``. Moving backwards plays the clip backwards. The
        heading from which later walks turn stays that of the last walk, as it does there.
        """
        forward = self.base[:3, 0].copy()
        heading = float(np.arctan2(forward[0], forward[2])) + turn_rad
        place = self.base[:3, 3] + forward_m * forward
        self.base = base_matrix(place, (np.sin(heading), 0.0, np.cos(heading)))
        if forward_m != 0:
            self.frame = self._frame_after(forward_m)
        self._show(self.frame)

    def _frame_after(self, way: float) -> int:
        """Return frame of the clip ``way`` [m] after the present one: by Habitat's search, the first not before it."""
        total, here = float(self._displacement[-1]), float(self._displacement[self.frame])
        if abs(way) > total:
            # habitat-lab takes int(way / total) cycles off the length, which adds them for a way back: kept
            way = float(np.sign(way)) * (abs(way) - total * int(way / total))
        if way < 0:
            way += total  # back by x is on by the rest of the cycle
        to_end = total - here
        if to_end < way:
            way, first, last = way - to_end, 0, self.frame
        else:
            way, first, last = way + here, self.frame, len(self._displacement) - 1
        while first <= last:
            middle = (first + last) // 2
            if self._displacement[middle] == way:
                return middle
            if self._displacement[middle] < way:
                first = middle + 1
            else:
                last = middle - 1
        return min(first, len(self._displacement) - 1)

    def reach(self, position: ArrayLike, hand: Hand = "right") -> None:
        """Move a hand to a world position [3] [m], within the range of the stored poses (spec/habitat.md 3.5).

        Positions outside the grid are clamped silently, as in Habitat; `h3data.bodies.people.reach` reports them
        instead.
        """
        if hand not in self.motion.hands:
            known = ", ".join(self.motion.hands) or "none"
            raise InputError(
                f"This motion file has no reaching poses of the {hand} hand. It has: {known}.", code="H3-BODY-027"
            )
        grid = self.motion.hands[hand]
        layout = list(self.motion.hands.values())[-1]  # habitat-lab's slip: the last loaded grid serves both hands
        place = reach_coordinates(self.base, position)
        rows, weights = _corners(place, layout)
        joints, roots = self._with_rest(grid)
        mixed = np.einsum("c,cjk->jk", weights, joints[rows])
        root = np.eye(4)
        quats = pose_from_matrix(roots[rows])[:, 3:]
        root[:3, :3] = quat_to_matrix(normalized(weights @ quats))
        root[:3, 3] = weights @ roots[rows][:, :3, 3]
        self.joints = normalized(mixed)
        self.offset = _ROOT_OF_REACH @ root

    def _with_rest(self, grid: ReachGrid) -> tuple[Array, Array]:
        """Return the grid's poses and, behind them, the standing one: what lies nearer than the grid blends into it."""
        first = _without_forward(_HALF_TURN @ self.motion.walk.roots[0])
        rest = np.linalg.inv(_ROOT_OF_REACH) @ first
        return np.concatenate([grid.joints, self.motion.stop_joints[None]]), np.concatenate([grid.roots, rest[None]])

    # --- results ----------------------------------------------------------------------------------------------------
    @property
    def root(self) -> Array:
        """Pelvis frame in the world, shape [4, 4] (habitat-sim's ``sim_obj.transformation``)."""
        return self.base @ np.linalg.inv(_BASE_OF_ROOT) @ self.offset

    def columns(self) -> tuple[Array, Array]:
        """Return the pelvis pose7 in the world [7] and local rotations [54, 4] in SMPL-X order, as recordings store poses."""
        return pose_from_matrix(self.root), self.joints[self._order]


def reach_coordinates(base: ArrayLike, position: ArrayLike) -> Array:
    """Return a world position [3] relative to a base frame [4, 4]: left, up, forward [m], as in the reach grids."""
    matrix = np.asarray(base, np.float64)
    return _REACH_OF_BASE[:3, :3] @ matrix[:3, :3].T @ (np.asarray(position, np.float64) - matrix[:3, 3])


def _corners(place: Array, grid: ReachGrid) -> tuple[NDArray[np.intp], Array]:
    """Return rows [8] of the poses around a point and their weights [8]; row -1 is the standing pose."""
    low = np.array([grid.low[0], grid.low[1], 0.0])  # forward starts at the body, not at the grid
    place = np.clip(place, low, grid.high)
    counts = np.array(grid.bins)
    at = (place - grid.low) / (grid.high - grid.low) * (counts - 1)
    lower, upper = np.floor(at).astype(int), np.ceil(at).astype(int)
    share = at - lower
    # in front of the grid, towards the body: habitat-lab blends with the standing pose there
    if lower[2] < 0:
        nearest = int(-grid.low[2] * (counts[2] - 1) / (grid.high[2] - grid.low[2]))
        # habitat-lab rounds the first grid plane towards zero, and divides by zero if that gives 0 (NaN): there we blend
        share[2] = (at[2] - nearest) / -nearest if nearest else place[2] / grid.low[2]
        lower[2], upper[2] = -1, 0
    rows, weights = [], []
    for corner in np.ndindex(2, 2, 2):
        x, y, z = (upper[k] if corner[k] else lower[k] for k in range(3))
        rows.append(-1 if z < 0 else y * counts[0] * counts[2] + x * counts[2] + z)
        weights.append(np.prod([share[k] if corner[k] else 1 - share[k] for k in range(3)]))
    return np.array(rows), np.array(weights)


def _without_forward(matrix: Array) -> Array:
    out = matrix.copy()
    out[:3, 3] *= _WITHOUT_FORWARD
    return out


def _bearing(direction: Array) -> float:
    """Return the angle [degrees] of a direction on the floor, from x towards z."""
    return float(np.degrees(np.arctan2(direction[2], direction[0])))


def _level(degrees: float) -> Array:
    """Return the unit vector of a `_bearing`."""
    angle = np.radians(degrees)
    return np.array([np.cos(angle), 0.0, np.sin(angle)])


def _within_half_turn(degrees: float) -> float:
    if degrees >= 180:
        return degrees - 360
    return degrees + 360 if degrees <= -180 else degrees


def sequence_pose(clip: HabitatClip, frame: int, start: ArrayLike) -> tuple[Array, Array]:
    """Return the joints [54, 4] and offset [4, 4] of one frame of a sequence.

    Source: ``HumanoidSeqPoseController`` (spec/habitat.md 3.3).

    ``start`` [4, 4] is the base frame in which the sequence begins. The offset contains the displacement since then
    *and* the position of the start; habitat-lab multiplies it by the base frame, so there a sequence that does not
    start at the world's origin is displaced. To place a sequence correctly, use the offset with ``start`` at the origin
    below the pose of your choice. Frames before the start and after the end are the first and the last frame.
    """
    frame = int(np.clip(frame, 0, len(clip.joints) - 1))
    root = np.array(clip.roots[frame], np.float64)
    place = np.asarray(start, np.float64)[:3, 3] - (0, HUMAN_ROOT_HEIGHT_M, 0)
    # from the first frame on, whose place in the file means nothing
    root[:3, 3] += place - np.asarray(clip.roots[0], np.float64)[:3, 3]
    return np.asarray(clip.joints[frame], np.float64), root
