"""Commands of a robot's base: what the kernel of a step gives, and a reference of it in Python."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from h3data.scene import FreeSpace
from sim_kinematic.avoidance import velocity
from sim_kinematic.avoidance.right_of_way import RightOfWay
from sim_kinematic.avoidance.spec import AVOIDANCE, Footprint
from sim_kinematic.avoidance.velocity import base_numbers
from sim_kinematic.avoidance.yielding import Body, Neighbours
from sim_kinematic.motion.spec import STEP_S, BaseSpec
from sim_kinematic.motion.state import RobotState

Command = tuple[float, float]
NOTHING_HELD = np.zeros(0, np.int64)


class Seen(NamedTuple):
    """An agent as another one observes it."""

    xz: np.ndarray
    velocity: Sequence[float] = (0.0, 0.0)
    settled: bool = False
    is_robot: bool = False
    heading: float = 0.0
    footprint: Footprint = AVOIDANCE.person


def note(found: Neighbours, k: int, body: Body, **values: float) -> None:
    """Write where an agent is and further ``values`` to row ``k``, with no path if they name none."""
    row, turn = found.agents[k], body.heading if body.is_robot else 0.0
    (x, z), heading = body.xz.tolist(), body.heading
    told = {"x": x, "z": z, "heading": heading, "cos": math.cos(turn), "sin": math.sin(turn)}
    for name, value in {**told, "start_x": math.nan, "start_z": math.nan, **values}.items():
        row[name] = value


def neighbours(*others: Seen, first: int = 1) -> Neighbours:
    """The arrays of some agents, of which the first has the number ``first``."""
    found = Neighbours.of(others)
    for k, other in enumerate(others):
        note(found, k, other, velocity_x=other.velocity[0], velocity_z=other.velocity[1])
        found.agents["settled"][k], found.agents["number"][k] = other.settled, first + k
    return found


def decide(rules: RightOfWay, carrying: Sequence[int] = ()) -> None:
    """Let agents decide who steps aside, each as it is now."""
    walkers = list(rules._walkers.values())
    found = Neighbours.of(walkers)
    for k, walker in enumerate(walkers):
        start = {} if walker.path_start is None else dict(zip(("start_x", "start_z"), walker.path_start, strict=True))
        note(found, k, walker, **start, yields=walker.yields, hindered=bool(walker.hindered_by))
    rules.update(found.agents, carrying)


def standing(xz: np.ndarray, heading: float) -> RobotState:
    """A robot at a floor point [2]."""
    state = RobotState.zeros(1)
    state.xz[0], state.heading[0] = xz, heading
    return state


def kept_clear(
    free: FreeSpace,
    base: BaseSpec,
    xz: np.ndarray,
    heading: float,
    wanted: Command,
    towards: np.ndarray,
    others: Sequence[Seen],
    target: Command | None = None,
) -> Command:
    """The command that keeps clear of others, of a robot that does not move."""
    told = neighbours(*others), NOTHING_HELD, target
    return velocity.keep_clear(free, base_numbers(base), standing(xz, heading), wanted, towards, *told)[0]


def reference(
    free: FreeSpace,
    base: BaseSpec,
    state: RobotState,
    wanted: Command,
    towards: np.ndarray,
    others: Sequence[Seen],
    target: Command | None,
    before: Command | None,
) -> tuple[Command, Command]:
    """`sim_kinematic.avoidance.velocity.keep_clear` put together in Python, without the step."""
    spec, here, goal = AVOIDANCE, tuple(state.xz[0].tolist()), tuple(towards.tolist())
    rows = [
        (x, z, *speeds, base.disc_radius_m + spec.person_radius_m, spec.margin_m, settled)
        for (x, z), speeds, settled, *_ in others
        if math.hypot(x - here[0], z - here[1]) <= spec.range_m
    ]
    keeps, heading = wanted, state.heading.item(0)
    if rows:
        dx, dz = goal[0] - here[0], goal[1] - here[1]
        length = math.hypot(dx, dz)
        arc = abs(velocity.wrap_angle.py_func(math.atan2(-dz, dx) - heading)) if length > 0.1 else math.inf
        candidates = velocity._CANDIDATES
        levels = candidates if target is None else np.concatenate([candidates, [target]])
        offsets, hull = velocity._discs(base)
        chosen = velocity.choose_command(
            free.sdf,
            free.origin,
            free.cell_m,
            (*here, heading),
            goal,
            wanted,
            length,
            arc,
            np.array(rows, np.float64),
            (offsets, base.disc_radius_m - spec.wall_tolerance_m),
            hull,
            (float(base.max_speed_mps), float(base.max_turn_rad_s)),
            (spec.horizon_steps, spec.stride_steps, spec.doubt_mps, STEP_S),
            (spec.still_margin_m, spec.gap_weight, spec.heading_weight_m, spec.turn_weight_m, spec.change_weight_m),
            (math.nan, math.nan) if target is None else target,
            np.empty(len(rows)),
        )
        keeps = wanted if chosen < 0 else tuple(levels[chosen].tolist())
    return keeps, eased(base, wanted, before) if before is not None and keeps == wanted else keeps


def eased(base: BaseSpec, wanted: Command, before: Command) -> Command:
    """The command one step further from ``before`` towards ``wanted``; it stops turning at once, to end where it wants to."""
    spec, speed = AVOIDANCE, STEP_S / base.max_speed_mps
    forward = _within(wanted[0], before[0], spec.accel_mps2 * speed, spec.brake_mps2 * speed)
    return forward, _within(wanted[1], before[1], spec.turn_accel_rad_s2 * STEP_S / base.max_turn_rad_s, 1.0)


def _within(wanted: float, before: float, up: float, down: float) -> float:
    if before < 0.0:
        return -_within(-wanted, -before, up, down)
    return min(max(wanted, before - down, -up), before + up)
