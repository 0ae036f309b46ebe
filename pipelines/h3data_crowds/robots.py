"""Baselines common in the literature that drive a robot to a goal among people, all with the same map and forecast.

All of them know the map and the current and previous positions of people, and assume that each person keeps their
velocity.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array, wrap_angle
from h3data.kernels import kernel
from h3data.scene.freespace.free_space import sample_sdf
from sim_kinematic.avoidance.yielding import NO_PATH
from sim_kinematic.crowd.step import choose_velocity
from sim_kinematic.crowd.traits import CrowdSpec, Traits
from sim_kinematic.motion.randomness import generator
from sim_kinematic.motion.spec import STEP_S, BaseSpec
from sim_kinematic.policies.policy import Velocity
from sim_kinematic.policies.views import AgentView

SKILLS = ("drive", "wait")
CRUISE_MPS = 1.3
"""Speed of all baselines, equal to that of the people around them [m/s]."""
LOOK_M = 0.3
"""Distance along the path of the point towards which a robot drives [m]."""
TURN_FIRST_RAD = 0.5
"""Heading error above which a robot turns in place [rad]."""
WINDOW_S, HORIZON_S, PIECE_S = 0.8, 1.6, 0.2
"""Time that `dwa` and `mpc` look ahead, and duration of a segment with a constant command [s]."""
PERSON_M = 0.34
"""Radius of people in all baselines [m]."""
COMFORT_M = 0.3
"""Gap to people below which a plan costs more [m]."""
SPEEDS, TURNS = np.linspace(-0.3, 1.0, 7), np.linspace(-1.0, 1.0, 9)
UNREACHABLE_M = 100.0
"""Remaining path length assumed for a plan that ends where no path to the goal exists [m]."""
TURN_M = 0.2
"""Path length that costs as much as a radian between heading and path [m]."""
SAMPLES = 160
"""Number of plans that `mpc` samples at each step."""

Policy = Callable[[AgentView, BaseSpec], Velocity]


def _target(view: AgentView) -> Array:
    return np.asarray(view.free.next_waypoint(view.xz, np.array(view.extra["goal"]), beyond_m=LOOK_M))


def _drive(view: AgentView, base: BaseSpec, velocity: Array) -> Velocity:
    """Return commands with which a robot that only drives ahead and turns follows a velocity [2] [m/s]."""
    speed = float(np.hypot(*velocity))
    if speed < 0.05:
        return Velocity(0.0, 0.0, "wait")
    error = float(wrap_angle(math.atan2(-velocity[1], velocity[0]) - view.heading))
    turn = min(max(4.0 * error / base.max_turn_rad_s, -1.0), 1.0)
    forward = speed * max(math.cos(error), 0.0) if abs(error) < TURN_FIRST_RAD else 0.0
    return Velocity(forward / base.max_speed_mps, turn, "drive" if forward else "wait")


def _wanted(view: AgentView) -> Array:
    """Return the velocity [2] [m/s] towards a point ahead on the shortest path to the goal."""
    gap = _target(view) - view.xz
    return np.asarray(gap / max(float(np.hypot(*gap)), 1e-9) * CRUISE_MPS)


def shortest_path(view: AgentView, base: BaseSpec) -> Velocity:
    """Drive along the shortest path, regardless of people in the way."""
    return _drive(view, base, _wanted(view))


def people_of(view: AgentView) -> tuple[Array, Array]:
    """Return positions [P, 2] [m] and velocities [P, 2] [m/s] of the people."""
    rows = [k for k, kind in enumerate(view.kinds) if kind == "human"]
    return view.places[rows, :2], (view.places[rows, :2] - view.before[rows, :2]) / STEP_S


def _among_people(view: AgentView, base: BaseSpec, *, forces: bool) -> Velocity:
    people, velocities = people_of(view)
    own = (view.xz - view.before[view.agent, :2]) / STEP_S
    reach = base.disc_radius_m + max(abs(offset) for offset in base.disc_offsets_m) / 2
    traits = np.array([Traits(CRUISE_MPS, 0.5, 0.2, reach, 1.0, 0.0)])
    chosen = choose_velocity(
        view.free.sdf,
        view.free.origin,
        view.free.cell_m,
        0,
        np.concatenate([view.xz[None], people]),
        np.concatenate([own[None], velocities]),
        np.concatenate([[reach], np.full(len(people), PERSON_M)]),
        np.array([[view.heading, 0.0, 0.0, view.heading]]),
        np.zeros((1, 3)),
        np.full(1, -1),
        np.full(1, -1),
        *_wanted(view).tolist(),
        CRUISE_MPS,
        0,
        traits,
        forces,
        CrowdSpec().numbers,
    )
    return _drive(view, base, np.array(chosen))


def orca(view: AgentView, base: BaseSpec) -> Velocity:
    """Avoid people by reciprocal velocity obstacles (`sim_kinematic.crowd.orca`), with only the robot giving way."""
    return _among_people(view, base, forces=False)


def social_force(view: AgentView, base: BaseSpec) -> Velocity:
    """Follow social forces (`sim_kinematic.crowd.social_force`), with the same guard against contact as for people."""
    return _among_people(view, base, forces=True)


@kernel(error_model="numpy")
def roll_plans(sdf, origin, cell, pose, plans, limits, discs, radius, people, velocities, reach, comfort, piece):
    """Return the costs [N] of plans for nearness to people and walls, and their final poses (x, z, heading) [N, 3].

    Args:
        sdf: Signed distance to obstacles at each cell of the floor's grid [m].
        origin: World position (x, z) of the grid [m].
        cell: Size of its cells [m].
        pose: Position and heading of the robot (x, z, heading) [m, m, rad].
        plans: Speed and turn rate of each segment as fractions of the limits, in -1..1, [N, K, 2].
        limits: Greatest speed [m/s] and turn rate [rad/s].
        discs: Offsets of the robot's discs along its axis [D] [m].
        radius: Radius of the discs [m].
        people: Positions of people [P, 2] [m].
        velocities: Velocities of people, assumed constant [P, 2] [m/s].
        reach: Distance between a disc's centre and a person's at which they touch [m].
        comfort: Gap below which nearness costs [m].
        piece: Duration of a segment [s].
    """
    costs, ends = np.zeros(len(plans)), np.empty((len(plans), 3))
    for n in range(len(plans)):
        x, z, heading, cost = pose[0], pose[1], pose[2], 0.0
        for k in range(plans.shape[1]):
            heading += plans[n, k, 1] * limits[1] * piece
            x += math.cos(heading) * plans[n, k, 0] * limits[0] * piece
            z -= math.sin(heading) * plans[n, k, 0] * limits[0] * piece
            time = (k + 1) * piece
            for offset in discs:
                cx, cz = x + math.cos(heading) * offset, z - math.sin(heading) * offset
                room = sample_sdf(sdf, origin, cell, cx, cz) - radius
                if room < 0.0:
                    cost += 20.0 * piece
                for p in range(len(people)):
                    px, pz = people[p, 0] + velocities[p, 0] * time, people[p, 1] + velocities[p, 1] * time
                    gap = math.hypot(px - cx, pz - cz) - reach
                    if gap < 0.0:
                        cost += 50.0 * piece
                    elif gap < comfort:
                        cost += 4.0 * (1.0 - gap / comfort) * piece
        costs[n] = cost
        ends[n, 0], ends[n, 1], ends[n, 2] = x, z, heading
    return costs, ends


def _ways_left(view: AgentView, ends: Array) -> Array:
    """Return paths [N] [m] from where plans end to the goal, longer where the robot does not look along them."""
    goal = np.array(view.extra["goal"])
    left = view.free.geodesic(ends[:, :2], np.broadcast_to(goal, (len(ends), 2)))
    ahead = _target(view) - view.xz
    error = np.abs(wrap_angle(np.arctan2(-ahead[1], ahead[0]) - ends[:, 2]))
    return np.where(np.isfinite(left), left, UNREACHABLE_M) + TURN_M * error


def _best_plan(view: AgentView, base: BaseSpec, plans: NDArray[np.float64]) -> Velocity:
    people, velocities = people_of(view)
    costs, ends = roll_plans(
        view.free.sdf,
        view.free.origin,
        view.free.cell_m,
        np.array([*view.xz, view.heading]),
        plans,
        np.array([CRUISE_MPS, base.max_turn_rad_s]),
        np.array(base.disc_offsets_m),
        base.disc_radius_m,
        people,
        velocities,
        base.disc_radius_m + PERSON_M,
        COMFORT_M,
        PIECE_S,
    )
    costs += _ways_left(view, ends)
    speed, turn = plans[int(np.argmin(costs)), 0].tolist()
    return Velocity(speed * CRUISE_MPS / base.max_speed_mps, turn, "drive" if speed else "wait")


_PIECES = round(HORIZON_S / PIECE_S)
_WINDOW = np.repeat(np.array([(speed, turn) for speed in SPEEDS for turn in TURNS])[:, None], _PIECES, axis=1)


def dwa(view: AgentView, base: BaseSpec) -> Velocity:
    """Choose the best of 63 constant commands over the next 0.8 s by the dynamic window approach (Fox et al. 1997)."""
    return _best_plan(view, base, _WINDOW[:, : round(WINDOW_S / PIECE_S)])


def mpc(view: AgentView, base: BaseSpec) -> Velocity:
    """Choose a command by model-predictive control: the best of sampled plans that change their command once."""
    rng = generator(view.seed, "crowd_mpc", world=view.agent, step=view.step)
    ends = np.stack([rng.uniform(SPEEDS[0], 1.0, (SAMPLES, 2)), rng.uniform(-1.0, 1.0, (SAMPLES, 2))], -1)
    late = np.arange(_PIECES)[None] >= rng.integers(1, _PIECES, (SAMPLES, 1))
    sampled = np.where(late[..., None], ends[:, 1:], ends[:, :1])
    return _best_plan(view, base, np.concatenate([_WINDOW, sampled]))


class Yielding:
    """Policy that yields, waits and makes detours by the same rules as robots with the policy `wander`."""

    def __init__(self) -> None:
        self._going = None

    def act(self, view: AgentView) -> Velocity:
        """Return the next step towards the goal, or no motion while a person has to pass first."""
        traffic = view.traffic()
        actor = traffic.begin_turn(view.agent, view.step)
        if self._going is None:
            actor.path = NO_PATH
            self._going = actor.go_to(np.array(view.extra["goal"]))
        try:
            next(self._going)
        except StopIteration:
            self._going = None
            actor.idle()
        traffic.end_turn(view.agent)
        choice = actor.choice()
        assert isinstance(choice, Velocity)
        return choice


ROBOTS: Mapping[str, object] = {
    "shortest_path": shortest_path,
    "dwa": dwa,
    "orca": orca,
    "social_force": social_force,
    "mpc": mpc,
    "yielding": lambda *_: Yielding(),
}
"""Baselines by name."""
