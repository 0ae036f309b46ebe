"""A learned robot for `crowd_nav`: a small network that has learned to do what `mpc` does (h3data docs crowds)."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from h3data.builtin import builtin_root
from h3data.geometry import Array, wrap_angle
from h3data_crowds.robots import CRUISE_MPS, SKILLS, people_of
from sim_kinematic.motion.spec import STEP_S, BaseSpec
from sim_kinematic.policies.network import Network, load_network
from sim_kinematic.policies.policy import Velocity
from sim_kinematic.policies.views import AgentView

FILE = "policies/crowd_imitation.npz"
"""Weights among the shipped data, which `bake.crowd_imitation` makes."""
WAYS_M = (0.3, 1.0)
"""Distances along the path of the points whose directions are shown [m]."""
RINGS_M, BEARINGS = (0.45, 0.9), 16
"""Radii of the circles on which the room between obstacles is shown [m], and number of directions on each."""
PEOPLE, SEEN_M, SLOW_MPS = 4, 4.0, 0.05
"""Number of people who are shown, nearest first; distance beyond which nobody is [m]; speed below which a robot waits."""


def observe(view: AgentView, base: BaseSpec) -> NDArray[np.float32]:
    """Return what the network is shown [N], in the robot's frame (x ahead, y to the left).

    These are the directions of two points on the path, the straight distance to the goal, the robot's own speed and turn, the
    room on two circles around it, and place, speed and gap of the nearest people.
    """
    turn = np.array([[np.cos(view.heading), -np.sin(view.heading)], [-np.sin(view.heading), -np.cos(view.heading)]])
    goal, before = np.array(view.extra["goal"]), view.before[view.agent]
    shown = [np.array([min(float(np.hypot(*(goal - view.xz))), 5.0) / 5.0])]
    for ahead in WAYS_M:
        way = turn @ (np.asarray(view.free.next_waypoint(view.xz, goal, beyond_m=ahead)) - view.xz)
        shown.append(way / max(float(np.hypot(*way)), 1e-9))
    moved = turn @ (view.xz - before[:2]) / STEP_S
    turned = float(wrap_angle(view.heading - before[2])) / STEP_S
    shown.append(np.array([moved[0] / CRUISE_MPS, turned / base.max_turn_rad_s]))
    angles = view.heading + 2 * np.pi * np.arange(BEARINGS) / BEARINGS
    out = np.stack([np.cos(angles), -np.sin(angles)], 1)
    around = np.concatenate([view.xz + radius * out for radius in RINGS_M])
    shown.append(np.clip(view.free.signed_distance(around), -0.5, 1.0))
    places, velocities = people_of(view)
    slots = np.zeros((PEOPLE, 5))
    gaps = np.hypot(*(places - view.xz).T)
    for row, k in enumerate(np.argsort(gaps, kind="stable")[:PEOPLE].tolist()):
        if gaps[k] < SEEN_M:
            at: Array = turn @ (places[k] - view.xz)
            slots[row] = [*at / gaps[k], 1.0 - gaps[k] / SEEN_M, *(turn @ velocities[k])]
    shown.append(slots.reshape(-1))
    return np.concatenate(shown).astype(np.float32)


def command(network: Network, view: AgentView, base: BaseSpec) -> Velocity:
    """Return the command of a network, whose outputs are shares of `CRUISE_MPS` and of the greatest turn rate."""
    speed, turn = np.clip(network(observe(view, base)), -1.0, 1.0).tolist()
    speed = 0.0 if abs(speed) * CRUISE_MPS < SLOW_MPS else speed
    return Velocity(speed * CRUISE_MPS / base.max_speed_mps, turn, SKILLS[0] if speed else SKILLS[1])


@lru_cache(maxsize=1)
def _shipped() -> Network:
    return load_network(builtin_root() / FILE)


def imitation(view: AgentView, base: BaseSpec) -> Velocity:
    """Drive by the shipped network, which has learned from `mpc` and from its corrections (DAgger, Ross et al. 2011)."""
    return command(_shipped(), view, base)
