"""Robot policies for social navigation that need no learning."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.geometry import wrap_angle
from h3data.scene import FreeSpace
from sim_kinematic.randomness import generator
from sim_kinematic.spec import STEP_S, BaseSpec

ROBOT_SKILLS = ("find", "follow", "back_up", "wait")


class View(NamedTuple):
    """What a privileged policy may know: where both are, and the map."""

    free: FreeSpace
    robot_xz: NDArray[np.float64]
    robot_heading: float
    human_xz: NDArray[np.float64]
    geodesic_m: float
    """Length of the shortest path from robot to human [m]; infinite when there is none."""
    met: bool
    """The robot has found the person before."""
    seed: int = 0
    """Of the episode: with ``step`` it decides everything that a policy draws."""
    step: int = 0
    robot_before: tuple[NDArray[np.float64], float] | None = None
    """Where the robot was before the last step, place and heading; None at the start."""


class Command(NamedTuple):
    """What a policy wants: base velocity in -1..1 of the limits, and what it calls that."""

    forward: float
    turn: float
    skill: str


Policy = Callable[[View, BaseSpec], Command]

KEEP_DISTANCE_M = 1.5
"""The expert approaches when farther than this and backs away when nearer (paper section 4.1)."""


def _steer(view: View, target_xz: NDArray[np.float64], spec: BaseSpec) -> tuple[float, float]:
    """Heading error to ``target_xz`` [rad] and the turn command that removes it in one step, if the limit allows."""
    dx, dz = target_xz - view.robot_xz
    error = float(wrap_angle(np.arctan2(-dz, dx) - view.robot_heading))
    return error, float(np.clip(error / (spec.max_turn_rad_s * STEP_S), -1, 1))


def next_waypoint(view: View, spec: BaseSpec) -> NDArray[np.float64]:
    """The first way point on the path to the person that is not already underfoot."""
    path = view.free.path(view.robot_xz, view.human_xz)
    for waypoint in path[1:]:
        if np.hypot(*(waypoint - view.robot_xz)) > spec.disc_radius_m / 2:
            return waypoint
    return view.human_xz


def heuristic_expert(view: View, spec: BaseSpec) -> Command:
    """The paper's expert: shortest path to the person when farther than 1.5 m, back away from her inside.

    Its code was never published (spec/habitat.md 1.8). Speeds are the smallest that restore 1.5 m in one step.
    """
    if not np.isfinite(view.geodesic_m):
        return Command(0.0, 0.0, "wait")
    gap = (view.geodesic_m - KEEP_DISTANCE_M) / (spec.max_speed_mps * STEP_S)
    if gap > 0:
        error, turn = _steer(view, next_waypoint(view, spec), spec)
        forward = min(gap, 1.0) * max(0.0, float(np.cos(error))) ** 2
        return Command(forward, turn, "follow" if view.met else "find")
    error, turn = _steer(view, view.human_xz, spec)
    # backing away works while she is in front; else first turn to her
    backward = max(gap, -1.0) if abs(error) < np.pi / 3 else 0.0
    return Command(backward, turn, "back_up")


def stand_still(view: View, spec: BaseSpec) -> Command:
    """Does nothing: the floor under every score."""
    del view, spec
    return Command(0.0, 0.0, "wait")


def random(view: View, spec: BaseSpec) -> Command:
    """A uniformly random base velocity at every step, the same for the same seed: what chance achieves."""
    del spec
    forward, turn = generator(view.seed, "policy/random", step=view.step).uniform(-1, 1, 2)
    return Command(float(forward), float(turn), "follow" if view.met else "find")


POLICIES: dict[str, Policy] = {
    "heuristic_expert": heuristic_expert,
    "random": random,
    "stand_still": stand_still,
}


def policy_by_name(name: str) -> Policy:
    """The policy called ``name``, or the one in a file (``weights:FILE``); an `InputError` lists what exists."""
    from sim_kinematic.learned import LearnedNavigation, is_learned, network_of

    if is_learned(name):
        return LearnedNavigation(network_of(name))
    if name not in POLICIES:
        raise InputError(f"Unknown policy {name!r}. Expected one of: {', '.join(POLICIES)}, or weights:FILE.")
    return POLICIES[name]


def policy_name(policy: str | Policy) -> str:
    """The name under which a policy is recorded; that of a file of weights says which weights (`stamped`)."""
    from sim_kinematic.learned import stamped

    return stamped(policy) if isinstance(policy, str) else getattr(policy, "__name__", type(policy).__name__)
