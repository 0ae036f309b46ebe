"""Step of motion in W worlds as tensor operations on the CPU or a GPU, equivalent to `sim_kinematic.motion.step`.

The numba kernels of that module are the reference. Here, branches are `torch.where`, loops have a fixed length, and no
operation waits for the device, so that a step can be captured in a CUDA graph. The two agree to 1e-5 m over 1,000 steps
in float64 (tests/training/torch/test_step.py). Each operation of a graph takes time, so values that two branches need
are computed together.

Points on the floor are [..., W, 2], so that several points of a world are on axes before that of the worlds. Only
``strict`` sliding is supported.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from h3data.errors import InputError
from h3data_training.torch.state import HumanTensors, RobotTensors
from sim_kinematic.motion.spec import STEP_S, BaseSpec, WalkerSpec

if TYPE_CHECKING:
    from h3data.scene import FreeSpace

FLAT = 1e-9
"""Length of a distance gradient below which it gives no direction [m per cell]; shorter gradients are divided by this
value instead of their length.
"""


class Floor(Protocol):
    """Protocol of the parts of a `h3data.scene.FreeSpace` that motion on a device reads."""

    @property
    def sdf(self) -> NDArray[np.float32]:
        """Signed distances of the floor's grid [m], negative in obstacles."""
        ...

    @property
    def origin(self) -> NDArray[np.float64]:
        """Position (x, z) of the grid [m]."""
        ...

    @property
    def cell_m(self) -> float:
        """Size of the grid's cells [m]."""
        ...


def refuse_stairs(floors: Iterable[FreeSpace], *, home: str = "them") -> None:
    """Check that floors have no stairs, which devices do not support.

    Raises:
        InputError: a floor has stairs; the message advises to leave out the ``home``.
    """
    if any(len(floor.heights) for floor in floors):
        raise InputError(
            f"Worlds that are stepped together, on a CPU or GPU, have no stairs. Hint: leave {home} out of the scenes.",
            code="H3-TRAIN-076",
        )


_PER_FLOOR = ("shift", "scale", "top", "last", "stride", "first", "cell")
"""Fields with a row for each floor."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Grids:
    """Signed distance grids of R floors (or of one for each of R worlds) as one table."""

    table: Tensor
    """Coefficients k, for each square between four cell centres, of ``k0 + k1 a + k2 b + k3 a b``, [squares, 4] [m]."""
    shift: Tensor
    """Offset of the cells [R, 2], with ``scale`` [R, 1]: a point p is at ``shift + scale p`` in cells."""
    scale: Tensor
    top: Tensor
    """Largest position on the grid in cells, [R, 2]; ``last`` [R, 2] is the last square that starts before it."""
    last: Tensor
    stride: Tensor
    """Number of squares per row, [R]."""
    first: Tensor
    """Number of the first square, int64 [R]."""
    zero: Tensor
    cell: Tensor
    """Side of a cell [m], [R]."""

    @classmethod
    def of(cls, floors: Sequence[Floor], device: torch.device | str, dtype: torch.dtype) -> Grids:
        """Return the grids of floors on a device."""
        tables = [_coefficients(np.asarray(f.sdf, np.float64)) for f in floors]
        sizes = np.array([f.sdf.shape for f in floors], np.float64)
        cell = np.array([f.cell_m for f in floors])
        origin = np.stack([np.asarray(f.origin, np.float64) for f in floors])

        def on_device(array: NDArray[np.float64]) -> Tensor:
            return torch.as_tensor(array, dtype=dtype, device=device)

        return cls(
            table=on_device(np.concatenate(tables)),
            shift=on_device(-origin / cell[:, None] - 0.5),
            scale=on_device(1 / cell[:, None]),
            top=on_device(sizes - 1),
            last=on_device(sizes - 2),
            stride=on_device(sizes[:, 1] - 1),
            first=torch.as_tensor(np.cumsum([0, *(len(t) for t in tables[:-1])]), device=device),
            zero=torch.zeros((), dtype=dtype, device=device),
            cell=on_device(cell),
        )

    def at(self, place: Tensor) -> Grids:
        """Return the grid of each world by the numbers of the floors [W]; if there is one floor, all worlds use it."""
        if len(self.cell) == 1:
            return self
        rows = {name: getattr(self, name)[place] for name in _PER_FLOOR}
        return Grids(table=self.table, zero=self.zero, **rows)


def _coefficients(sdf: NDArray[np.float64]) -> NDArray[np.float64]:
    s00, s01, s10, s11 = sdf[:-1, :-1], sdf[:-1, 1:], sdf[1:, :-1], sdf[1:, 1:]
    return np.stack([s00, s10 - s00, s01 - s00, s11 - s10 - s01 + s00], -1).reshape(-1, 4)


class Sample(NamedTuple):
    """Sample of a distance grid at points [..., 2]: the distance [...] [m] and its gradient [..., 2] [m per cell]."""

    distance: Tensor
    slope: Tensor


def sample_sdf(grids: Grids, xz: Tensor) -> Sample:
    """Return the signed distance and its gradient at points, bilinear.

    Outside of the grid, the distance is the value at the border minus the distance to the border
    (`h3data.scene.freespace._sdf`).
    """
    f = torch.addcmul(grids.shift, grids.scale, xz)
    c = torch.clamp(f, grids.zero, grids.top)
    low = torch.minimum(c.floor(), grids.last)
    ab = c - low
    k = grids.table[torch.addcmul(low[..., 1], low[..., 0], grids.stride).long() + grids.first]
    slope = torch.addcmul(k[..., 1:3], k[..., 3:], ab.flip(-1))
    inside = torch.addcmul(torch.addcmul(k[..., 0], ab[..., 0], slope[..., 0]), ab[..., 1], k[..., 2])
    off = f - c
    return Sample(torch.addcmul(inside, grids.cell, torch.hypot(off[..., 0], off[..., 1]), value=-1.0), slope)


def wrap_angle(angle: Tensor) -> Tensor:
    """Return an angle wrapped to [-pi, pi) [rad]."""
    return torch.sub(angle, torch.floor(angle / (2.0 * math.pi) + 0.5), alpha=2.0 * math.pi)


def heading_direction(heading: Tensor) -> Tensor:
    """Return the forward direction (x, z) [..., 2] of headings [...] [rad]."""
    return torch.stack([heading.cos(), -heading.sin()], -1)


def least_clearance(grids: Grids, xz: Tensor, direction: Tensor, offsets: Sequence[float]) -> Tensor:
    """Return the smallest signed distance [...] [m] from the centres of the base's discs to an obstacle."""
    centres = torch.stack([torch.add(xz, direction, alpha=offset) for offset in offsets])
    return sample_sdf(grids, centres).distance.amin(0)


def push_out(
    grids: Grids, xz: Tensor, direction: Tensor, offsets: Sequence[float], radius: float, iterations: int
) -> Tensor:
    """Move base positions [..., 2] until their discs, if possible, do not overlap obstacles; free bases do not move."""
    for _ in range(iterations):
        for offset in offsets:
            distance, slope = sample_sdf(grids, torch.add(xz, direction, alpha=offset) if offset else xz)
            length = torch.hypot(slope[..., 0], slope[..., 1]).clamp_min(FLAT)
            share = torch.rsub(distance, radius).clamp_min(0.0) / length
            xz = torch.addcmul(xz, slope, share[..., None])
    return xz


def integrate(xz: Tensor, direction: Tensor, speed: Tensor, lateral: Tensor | None, dt: float) -> Tensor:
    """Return the motion of bases without obstacles [W, 2] [m], along their axes before the step (spec/habitat.md 0)."""
    moved = torch.addcmul(xz, direction, speed[:, None], value=dt)
    if lateral is None:
        return moved
    left = torch.stack([direction[:, 1], -direction[:, 0]], -1)
    return torch.addcmul(moved, left, lateral[:, None], value=dt)


def drive_base(
    grids: Grids,
    xz: Tensor,
    heading: Tensor,
    speed: Tensor,
    lateral: Tensor | None,
    turn: Tensor,
    spec: BaseSpec,
    dt: float,
) -> RobotTensors:
    """Move W robot bases by one step of ``strict`` sliding, all of them moving."""
    offsets, radius = spec.disc_offsets_m, spec.disc_radius_m
    limit = radius - spec.clearance_tolerance_m
    turned = torch.add(heading, turn, alpha=dt)
    directions = heading_direction(torch.stack([turned, heading]))  # the two headings to try
    ahead = integrate(xz, directions[1], speed, lateral, dt)
    # where it wants to be, and where it is but turned
    open_room, on_the_spot = least_clearance(grids, torch.stack([ahead, xz]), directions[0], offsets)
    slid = push_out(grids, ahead.expand(2, -1, -1), directions, offsets, radius, spec.slide_iterations)
    by = slid - ahead
    touched = torch.hypot(by[0, :, 0], by[0, :, 1]) > spec.contact_tolerance_m
    # a push-out may not carry the base farther than the command itself could have
    way = speed.abs() if lateral is None else torch.hypot(speed, lateral)
    reach = torch.add(way, turn.abs(), alpha=2.0 * radius) * dt + spec.clearance_tolerance_m
    went = slid - xz
    far = torch.hypot(went[..., 0], went[..., 1])
    fits = far <= reach
    if spec.keeps_speed:
        most = spec.farthest_m(dt)
        touched |= far[0] > most
        slid = torch.where((far > most)[..., None], torch.addcmul(xz, went, (most / far)[..., None]), slid)
    both, moves = fits & (least_clearance(grids, slid, directions, offsets) >= limit)
    free = open_room >= radius
    turns = free | both | (~moves & (on_the_spot >= limit))
    stays = torch.where(moves[:, None], slid[1], xz)
    return RobotTensors(
        torch.where(free[:, None], ahead, torch.where(both[:, None], slid[0], stays)),
        torch.where(turns, turned, heading),
        ~free & (touched | ~both),
    )


class Velocities(NamedTuple):
    """Velocity commands [W] in SI units; ``lateral`` is None if the base cannot move sideways."""

    speed: Tensor
    lateral: Tensor | None
    turn: Tensor


def velocities(action: Tensor, spec: BaseSpec) -> Velocities:
    """Return the velocities of actions [W, 2 or 3], each clipped to -1..1 of the limits."""
    speed = action[:, 0].clamp(-float(spec.allow_back), 1.0) * spec.max_speed_mps
    lateral = action[:, 2].clamp(-1.0, 1.0) * spec.max_lateral_mps if action.shape[1] > 2 else None
    return Velocities(speed, lateral, action[:, 1].clamp(-1.0, 1.0) * spec.max_turn_rad_s)


def drive_robots(
    grids: Grids, robot: RobotTensors, action: Tensor, spec: BaseSpec, *, dt: float = STEP_S
) -> RobotTensors:
    """Return the robots after ``action``: forward and turn [W, 2], or also sideways [W, 3].

    The result equals that of `sim_kinematic.motion.step.drive_robots`.

    No operation waits for the device, so no action is refused; a component that is not finite counts as 0.
    """
    if spec.slide != "strict":
        raise InputError(
            f"Tensors slide strictly only, not as {spec.slide!r}. Hint: the CPU environment does both.",
            code="H3-TRAIN-077",
        )
    speed, lateral, turn = velocities(torch.nan_to_num(action, 0.0, 0.0, 0.0), spec)
    moved = drive_base(grids, robot.xz, robot.heading, speed, lateral, turn, spec, dt)
    goes = (speed != 0.0) | (turn != 0.0)
    if lateral is not None:
        goes |= lateral != 0.0
    return RobotTensors(
        torch.where(goes[:, None], moved.xz, robot.xz),
        torch.where(goes, moved.heading, robot.heading),
        moved.contact & goes,
    )


def move_humans(
    person: HumanTensors, xz: Tensor, heading: Tensor, spec: WalkerSpec, *, dt: float = STEP_S
) -> HumanTensors:
    """Return people [W, ...] after a step to positions [W, 2] [m] and headings [W] [rad]."""
    gap = xz - person.xz
    walked = torch.hypot(gap[:, 0], gap[:, 1])
    return HumanTensors(xz, heading, *step_cycle(person, walked, walked > 0.0, dt / spec.blend_s))


def step_cycle(person: HumanTensors, walked: Tensor, goes: Tensor, rate: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return ``(distance, set_off, blend)`` [W] after a step of some length [m] (`sim_kinematic.motion.gait`)."""
    begins = goes & (person.blend == 0.0)
    return (
        person.distance + walked,
        torch.where(begins, person.distance, person.set_off),
        torch.where(goes, (person.blend.clamp_min(0.5) + rate).clamp_max(1.0), (person.blend - rate).clamp_min(0.0)),
    )


def walk_humans(person: HumanTensors, goal_xz: Tensor, spec: WalkerSpec, *, dt: float = STEP_S) -> HumanTensors:
    """Move people [W, ...] one step straight towards their waypoints [W, 2] [m].

    They first turn in place, and never overshoot.
    """
    xz, heading = person.xz, person.heading
    gap = goal_xz - xz
    away = torch.hypot(gap[:, 0], gap[:, 1])
    error = wrap_angle(torch.atan2(-gap[:, 1], gap[:, 0]) - heading)
    under_way = away > spec.arrive_m
    goes = under_way & (error.abs() <= spec.turn_before_walk_rad)
    walked = torch.where(goes, away.clamp_max(spec.speed_mps * dt), 0.0)
    most = spec.turn_rad_s * dt
    turn = torch.where(goes, error, error.clamp(-most, most))
    return HumanTensors(
        torch.addcmul(xz, gap, (walked / away.clamp_min(spec.arrive_m))[:, None]),
        torch.where(under_way, heading + turn, heading),
        *step_cycle(person, walked, goes, dt / spec.blend_s),
    )
