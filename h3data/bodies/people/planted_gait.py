"""Walking with planted feet along any track of the root, with the gaits of a body (`h3data.bodies.people.kernels.planted`).

`planted_states` processes a track once. Any row of it can then be posed alone (`pose_planted`). As the track determines
the motion, recordings of people store only their roots.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from h3data.bodies.people.clips import TO_ROOT, Gaits
from h3data.bodies.people.gait import stand_posture
from h3data.bodies.people.legs import Posture
from h3data.bodies.people.skeleton import JOINT_COUNT
from h3data.errors import SceneError
from h3data.geometry import Array, heading_from_quat
from h3data.kernels.entries import Entries
from h3data.scene.floor_heights import LEVEL, room_heights

if TYPE_CHECKING:
    from h3data.bodies.people.kernels.planted import GaitTables
    from h3data.scene import FreeSpace, Scene

PHASES, SHARES = 64, 49
STEP_S = 1 / 30
_CALL = Entries()
"""Kernels called with tables: those of all bodies and floors are contiguous and float64."""


@cache
def _kernels() -> Any:
    """Return the module of the kernels, imported at first use."""
    from h3data.bodies.people.kernels import planted

    return planted


def gait_tables(gaits: Gaits) -> GaitTables:
    """Return sampled tables of the gaits of a body; computing them takes 40 ms."""
    # rows of the tables; between them gaits are blended, also from walking (1.6) to jogging (2.5)
    speeds_mps = (0.0, 0.35, 0.6, 1.0, 1.3, 1.6, 2.5, 3.0, 4.0)
    legs, rows = gaits.legs, len(speeds_mps)
    stand = stand_posture(legs)
    quats, pelvis = np.empty((rows, PHASES, JOINT_COUNT, 4)), np.empty((rows, PHASES, 3))
    quats[0], pelvis[0] = stand.quats[0], stand.pelvis[0]
    travel, stance, strike, middle, swing = np.zeros((5, rows))
    middle[0] = stand.ankle[0, 0, 2]
    stand_foot, swing_foot, swing_path = np.zeros((3, rows, SHARES, 2))
    # row 0 stands: its curves are flat, so blending with the slowest walk fades every motion out
    swing_path[0, :, 1] = legs.ankle_height
    share = np.linspace(0, 1, SHARES)
    for k, speed in enumerate(speeds_mps[1:], 1):
        travel[k], stance[k], strike[k] = float(gaits.stride_m(speed)), gaits.stance(speed), gaits.strike(speed)

        def moment(phase: Array, speed=speed) -> Posture:
            return gaits.posture(np.full(len(phase), speed), phase)

        cycle = moment(np.arange(PHASES) / PHASES)
        quats[k], pelvis[k] = cycle.quats, cycle.pelvis
        # just short of the end, where the foot still stands; at the end the gait already has it in the air
        stand_foot[k] = moment(share * stance[k] * (1 - 1e-9)).foot[:, 0, ::2]
        flight = moment(stance[k] + share * (1 - stance[k]) * (1 - 1e-9))
        swing_foot[k] = flight.foot[:, 0, ::2]
        # the kernel adds an eased line between the places on the floor; the table holds only what is beyond it
        line = travel[k] * (strike[k] - stance[k] + share * share * (3 - 2 * share) * stance[k])
        swing_path[k] = np.stack([flight.ankle[:, 0, 2] - line, flight.ankle[:, 0, 1]], axis=-1)
        swing[k] = np.abs(np.diff(flight.ankle[:, 0, 2])).max() * (SHARES - 1) / (1 - stance[k])
    # standing has no stance of its own; a first step begins as one of the slowest walk
    stance[0], strike[0] = stance[1], strike[1]
    speeds = np.array(speeds_mps)
    # travel is 0 where nobody travels; the row after replaces the quotient
    cadence = speeds / np.maximum(travel, 1e-9)
    cadence[0] = cadence[1]
    return _kernels().GaitTables(
        legs=legs.measures,
        half_width=legs.half_width,
        ankle_height=float(legs.ankle_height),
        speeds=speeds,
        travel=travel,
        cadence=cadence,
        stance=stance,
        strike=strike,
        swing=swing * cadence,
        middle=middle,
        quats=quats,
        pelvis=pelvis,
        stand_foot=stand_foot,
        swing_foot=swing_foot,
        swing_path=swing_path,
        to_root=TO_ROOT,
        sdf=np.zeros((0, 0)),
        origin=np.zeros(2),
        cell_m=1.0,
        heights=LEVEL,
        clear=0.0,
    )


def on_floor(tables: GaitTables, free: FreeSpace) -> GaitTables:
    """Return gaits of a body whose feet avoid the walls and furniture of a home, and stand on the treads of its stairs."""
    # contiguous float64, for which the kernels are compiled
    return tables._replace(
        sdf=np.ascontiguousarray(free.sdf, np.float64),
        origin=np.ascontiguousarray(free.origin, np.float64),
        cell_m=float(free.cell_m),
        heights=np.ascontiguousarray(free.heights, np.float64),
    )


def on_stairs(tables: GaitTables, heights: Array) -> GaitTables:
    """Return the gaits of a body whose feet stand on the treads of stairs (`h3data.scene.floor_heights`)."""
    return tables._replace(heights=np.ascontiguousarray(heights, np.float64))


def drawn_in(tables: GaitTables, scene: Scene) -> GaitTables:
    """Return the gaits of a body that is only drawn: its legs keep clear of walls and furniture of a scene.

    Without rooms and collision shapes, and without free floor, legs are those of `on_stairs`.
    """
    from h3data.scene.freespace.free_space import FreeSpace

    try:
        return on_floor(tables, FreeSpace.from_scene(scene, method="shapes"))._replace(clear=1.0)
    except SceneError:
        return on_stairs(tables, room_heights(scene.rooms))


def planted_states(tables: GaitTables, base: ArrayLike, time_s: ArrayLike | None = None) -> Array:
    """Return the states [T, K] of a person whose root is at ``base`` [T, 7], one step after the other.

    ``time_s`` [T] is the time of each row [s]; by default rows are 1/30 s apart. The person stands after rows that are
    not finite (absence) and after jumps of the root.
    """
    base = np.asarray(base, np.float64)
    seconds = np.full(len(base), STEP_S)
    if time_s is not None and len(base):
        # the first row has no step before it, and is never stepped
        seconds = np.diff(np.asarray(time_s, np.float64), prepend=0.0)
    states = np.empty((len(base), _kernels().STATE_COLUMNS))
    xz, heading = np.ascontiguousarray(base[:, [0, 2]]), heading_from_quat(base[:, 3:])
    _kernels().run_gaits(tables, xz, heading, seconds, STEP_S, states)
    return states


def pose_planted(tables: GaitTables, states: Array, *, joints: int = JOINT_COUNT) -> tuple[Array, Array]:
    """Return local rotations [T, joints, 4] and pelvis positions [T, 3] [m] in the agent root frame for states [T, K].

    Fewer joints take less time. At least the first 16 (legs, trunk and head) are computed.
    """
    quats, pelvis = np.empty((len(states), joints, 4)), np.empty((len(states), 3))
    _kernels().pose_gaits(tables, np.ascontiguousarray(states, np.float64), quats, pelvis)
    return quats, pelvis


class PlantedWalk:
    """Planted feet of a person whose root moves step by step, and who stands at first."""

    def __init__(self, tables: GaitTables, base: ArrayLike) -> None:
        """Create a standing walk at ``base`` [7], the pose of the agent root."""
        self.tables = tables
        self.state: Array = np.zeros(_kernels().STATE_COLUMNS)
        """Current state, as a row of `planted_states` [K]; copy it to store a moment."""
        self.stand(base)

    def stand(self, base: ArrayLike) -> None:
        """Place both feet as in standing under a root [7]."""
        _CALL(_kernels().stand_one, self.tables, self.state, *_place(base))

    @property
    def stands(self) -> bool:
        """Return whether the feet are at rest in the standing position."""
        return bool(_CALL(_kernels().one_stands, self.tables, self.state))

    @property
    def head_turn(self) -> float:
        """Angle by which the head has turned to the left in the last step [rad]."""
        return float(self.state[_kernels().LOOK_RATE]) * STEP_S

    @property
    def speed_mps(self) -> float:
        """Speed of the gait [m/s], which follows the speed of the root with at most 9 m/s^2."""
        return abs(float(self.state[_kernels().SPEED]))

    def is_at(self, base: ArrayLike) -> bool:
        """Return whether the root [7] is the root after the last step."""
        x, z, heading = _place(base)
        turned = np.abs((self.state[_kernels().HEADING] - heading + np.pi) % (2 * np.pi) - np.pi)
        return bool(
            abs(self.state[_kernels().X] - x) < 1e-6 and abs(self.state[_kernels().Z] - z) < 1e-6 and turned < 1e-6
        )

    def step(self, base: ArrayLike) -> None:
        """Advance by 1/30 s, in which the root moves to ``base`` [7]."""
        _CALL(_kernels().step_one, self.tables, self.state, *_place(base), STEP_S)

    def stride(self, base: ArrayLike, heading: float) -> tuple[Array, Array]:
        """Advance by 1/30 s to a root [7] whose heading [rad] is known, and return the `pose` there."""
        quats, pelvis = np.empty((JOINT_COUNT, 4)), np.empty(3)
        x, _, z, *_ = np.asarray(base, np.float64).tolist()
        _CALL(_kernels().stride_one, self.tables, self.state, x, z, heading, STEP_S, quats, pelvis)
        return quats, pelvis

    def pose(self, *, joints: int = JOINT_COUNT) -> tuple[Array, Array]:
        """Return the local rotations [joints, 4] and the position of the pelvis [3] [m] in the agent root frame.

        As for `pose_planted`, fewer joints take less time.
        """
        quats, pelvis = np.empty((1, joints, 4)), np.empty((1, 3))
        _CALL(_kernels().pose_gaits, self.tables, self.state[None], quats, pelvis)
        return quats[0], pelvis[0]

    def plant(self, quats: Array, pelvis: Array) -> None:
        """Move the legs of any pose, in place, so that its feet are where the walk has planted them.

        The pose has local rotations [55, 4] and the pelvis position [3] [m] in the agent root frame. The pelvis is
        lowered where a leg would be too short.
        """
        # any other arrays of the caller by numba itself, which looks at their types
        plain = all(part.flags.carray and part.dtype == np.float64 for part in (quats, pelvis))
        plant = _kernels().plant_legs
        _CALL(plant, self.tables, self.state, quats, pelvis) if plain else plant(self.tables, self.state, quats, pelvis)


def _place(base: ArrayLike) -> tuple[float, float, float]:
    pose = np.asarray(base, np.float64)
    return float(pose[0]), float(pose[2]), float(heading_from_quat(pose[3:]))
