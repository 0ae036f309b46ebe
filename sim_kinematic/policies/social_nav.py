"""Robot policies of social navigation: experts by rules, samples and foresight, baselines, and a learned policy."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from h3data.builtin import builtin_path
from h3data.errors import InputError
from h3data.geometry import wrap_angle
from h3data.scene import FreeSpace
from sim_kinematic.avoidance.maneuvers import plan_maneuver
from sim_kinematic.avoidance.rollouts import roll_out, roll_out_to, straight_walk
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.motion.randomness import generator
from sim_kinematic.motion.spec import STEP_S, BaseSpec
from sim_kinematic.policies.learned import LearnedNavigation
from sim_kinematic.policies.network import load_network
from sim_kinematic.policies.policy import Velocity
from sim_kinematic.policies.views import SocialNavView

ROBOT_SKILLS = ("find", "follow", "back_up", "wait")


Policy = Callable[[SocialNavView, BaseSpec], Velocity]


@dataclass(frozen=True)
class ExpertSpec:
    """Constants of the experts that find and follow a person."""

    keep_distance_m: float = 1.5
    """Distance to the person above which the expert approaches, and below which it backs away (paper section 4.1)
    [m]."""
    slack_m: float = 0.1
    """Distance beyond ``keep_distance_m`` within which the expert does not approach an oncoming person [m]."""
    steer_steps: int = 8
    """Number of steps that the experts look ahead when they choose a direction."""
    escape_steps: int = 30
    """Number of steps that the experts look ahead when they make room for the person."""
    margin_m: float = 0.15
    """Gap between robot and person that the experts keep if possible [m]."""
    turn_cost_m: float = 0.5
    """Length of path that a heading error of one radian costs [m]."""
    room_cost: float = 8.0
    """Cost of each metre by which the gap is smaller than ``margin_m``, as a length of path [m]."""
    reach_m: float = 2.0
    """Distance to the person below which the robot may find them [m]; a robot farther away ignores them until they are
    found."""
    samples: int = 24
    """Number of commands that the sampling expert samples in every step."""


EXPERT = ExpertSpec()

_LEVELS = (1.0, 0.5, 0.0, -0.5, -1.0)
_STEERING = np.array(
    [
        (f, t, n, f)
        for f in _LEVELS
        for t in _LEVELS
        for n in ((EXPERT.steer_steps // 2, EXPERT.steer_steps) if t else (EXPERT.steer_steps,))
    ]
)
"""Commands for the next steps, as `roll_out` takes them. Each turn is tried for half and for all of them."""
_APPROACHING = np.concatenate([np.ones((1, 4)), _STEERING])
"""Those commands after one at full speed whose turn depends on the goal."""
_BACKING = np.array(
    [(-1.0, t, n, -1.0) for t in _LEVELS for n in ((8, 16, EXPERT.escape_steps) if t else (EXPERT.escape_steps,))]
)
"""Commands to back away: straight, or in a bend and then straight."""


def _steer(view: SocialNavView, target_xz: NDArray[np.float64], spec: BaseSpec) -> tuple[float, float]:
    """Return the heading error to ``target_xz`` [rad] and the turn command that removes it in one step, if the limit allows."""
    dx, dz = (target_xz - view.robot_xz).tolist()  # Python floats: a third of the time of NumPy's
    # minus, as headings turn from x towards -z
    error = float(wrap_angle(np.arctan2(-dz, dx) - view.robot_heading))
    return error, min(max(error / (spec.max_turn_rad_s * STEP_S), -1.0), 1.0)


def _steps_to_turn(error: float, spec: BaseSpec) -> float:
    """Return the number of steps that a turn by a heading error [rad] takes at the limit of the base."""
    return float(math.ceil(abs(error) / (spec.max_turn_rad_s * STEP_S)))


def next_waypoint(view: SocialNavView, goal: NDArray[np.float64], spec: BaseSpec) -> NDArray[np.float64]:
    """Return the first waypoint on the path to ``goal`` [2] beyond the robot's own place."""
    path = view.free.path(view.robot_xz, goal)
    for waypoint in path[1:]:
        if np.hypot(*(waypoint - view.robot_xz).tolist()) > spec.disc_radius_m / 2:
            return waypoint
    return goal


def _expected_walk(view: SocialNavView) -> NDArray[np.float64]:
    """Return where the person will be in the next `EXPERT.escape_steps` steps if they go on as in the last one."""
    velocity = np.zeros(2) if view.human_before is None else (view.human_xz - view.human_before) / STEP_S
    return straight_walk(view.free, view.human_xz, velocity, EXPERT.escape_steps)


def rollout_expert(view: SocialNavView, spec: BaseSpec) -> Velocity:
    """Follow the two rules of `heuristic_expert` by roll-outs, choosing the best command.

    The robot approaches, forwards or backwards, by the command that shortens the path most, and restores 1.5 m at the
    smallest speed that does so. In front of a person who comes nearer, it backs away at the person's speed. Where the
    person would walk into it, it backs away along the curve that leaves most room. It knows the person's position now
    and one step ago.
    """
    step_m, receding = spec.max_speed_mps * STEP_S, _receding(view)
    gap_m = view.geodesic_m + receding - EXPERT.keep_distance_m
    if receding < 0 < gap_m < EXPERT.slack_m:
        return _back_up(view, spec, receding / step_m, hurries=False)
    gap = gap_m / step_m
    return _approach(view, spec, view.human_xz, gap) if gap > 0 else _back_up(view, spec, gap)


def _receding(view: SocialNavView) -> float:
    """Return the distance by which the person moves away from the robot in this step, if they continue as in the last one [m].

    Without it, a robot in front of a person who walks towards it backs away and returns every other step.
    """
    if view.human_before is None or view.geodesic_m > EXPERT.reach_m:
        return 0.0
    (away_x, away_z), (step_x, step_z) = (
        (view.human_xz - view.robot_xz).tolist(),
        (view.human_xz - view.human_before).tolist(),
    )
    return (away_x * step_x + away_z * step_z) / max(math.hypot(away_x, away_z), 1e-9)


def heuristic_expert(view: SocialNavView, spec: BaseSpec) -> Velocity:
    """Drive to a person farther than 1.5 m away, and back away from a nearer one (rules of the paper, section 4.1).

    The paper's code was never published. The robot drives to the next corner of the shortest path, and backs away in a
    straight line. It does not simulate or predict anything, so the person often traps it against a wall.
    """
    if not np.isfinite(view.geodesic_m):
        return Velocity(0.0, 0.0, "wait")
    gap = (view.geodesic_m - EXPERT.keep_distance_m) / (spec.max_speed_mps * STEP_S)
    if gap <= 0:
        backward, turn, _ = _straight_back(view, spec, gap)
        return Velocity(backward, turn, "back_up")
    error, turn = _steer(view, next_waypoint(view, view.human_xz, spec), spec)
    return Velocity(min(gap, 1.0) * max(0.0, float(np.cos(error))) ** 2, turn, "follow" if view.met else "find")


def _straight_back(view: SocialNavView, spec: BaseSpec, gap: float) -> tuple[float, float, float]:
    """Return the commands (forward, turn) that back away if the person is in front, or else turn to them; the error [rad]."""
    error, turn = _steer(view, view.human_xz, spec)
    # 60 degrees, within which the robot still faces the person (cosine above 0.5)
    return max(gap, -1.0) if abs(error) < np.pi / 3 else 0.0, turn, error


def _approach(view: SocialNavView, spec: BaseSpec, goal: NDArray[np.float64], gap: float = 1.0) -> Velocity:
    """Return the best command towards ``goal`` [2], for a path of at most ``gap`` steps at full speed."""
    if not np.isfinite(view.geodesic_m):
        return Velocity(0.0, 0.0, "wait")
    error, turn = _steer(view, next_waypoint(view, goal, spec), spec)
    commands = _APPROACHING.copy()
    commands[0, 1:3] = turn, _steps_to_turn(error, spec)
    if gap < 1.0:  # tried as slowly as it will be done
        commands[:, ::3] = np.minimum(np.maximum(commands[:, ::3], -gap), gap)
    left, off = roll_out_to(
        view.free,
        spec,
        view.robot_xz,
        view.robot_heading,
        commands,
        goal,
        look_steps=EXPERT.steer_steps,
        turn_cost_m=EXPERT.turn_cost_m,
    )
    forward, turn = commands[(left + EXPERT.turn_cost_m * off).argmin(), :2].tolist()
    return Velocity(forward, turn, "follow" if view.met else "find")


def _back_up(view: SocialNavView, spec: BaseSpec, gap: float, *, hurries: bool = True) -> Velocity:
    """Return the command away from the person for a path of ``gap`` steps (negative) at full speed.

    Where the person would walk into the robot it is a bend and, with ``hurries``, faster.
    """
    backward, turn, error = _straight_back(view, spec, gap)
    straight = np.array([(backward, turn, _steps_to_turn(error, spec), backward)])
    walk = _expected_walk(view)
    trial = partial(roll_out, view.free, spec, view.robot_xz, view.robot_heading, look_steps=EXPERT.escape_steps)
    # the usual case: one roll-out instead of dozens
    if trial(straight, walk).gap_m[0] >= EXPERT.margin_m:
        return Velocity(backward, turn, "back_up")
    calm = _BACKING * (max(-gap, 0.0), 1.0, 1.0, max(-gap, 0.0)) if gap > -1 else _BACKING[:0]
    commands = np.concatenate([straight, calm, _BACKING if hurries or gap <= -1 else _BACKING[:0]])
    ends = trial(commands, walk)
    dx, dz = (walk[-1] - ends.xz).T
    error = np.abs(wrap_angle(np.arctan2(-dz, dx) - ends.heading))
    best = np.argmin(EXPERT.room_cost * np.maximum(EXPERT.margin_m - ends.gap_m, 0.0) + EXPERT.turn_cost_m / 2 * error)
    return Velocity(float(commands[best, 0]), float(commands[best, 1]), "back_up")


def _way_left(
    free: FreeSpace, goal: NDArray[np.float64], xz: NDArray[np.float64], heading: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return lengths of shortest paths to ``goal`` from places [N, 2] [m], and errors of headings [N] [rad]."""
    # one field for all places costs less than a search for each
    left, direction = free.distance_field(goal).distance_and_direction(xz)
    error = np.abs(wrap_angle(np.arctan2(-direction[:, 1], direction[:, 0]) - heading))
    # places without a path have no direction
    return left, np.where(np.isnan(error), np.pi, error)


def sampling_expert(view: SocialNavView, spec: BaseSpec) -> Velocity:
    """Sample commands, simulate each together with the person's expected walk, and choose the best one.

    The best command leads to a place 1.5 m from the person, facing them, with room between both. An expert that samples
    waypoints without predicting the walk collides more often than one that just backs away (in 75% of episodes,
    according to a draft of the paper's appendix), because it drives to where the person is going.
    """
    if not view.met and view.geodesic_m > EXPERT.reach_m:
        return _approach(view, spec, view.human_xz)
    return _best_sample(view, spec, _expected_walk(view))


def future_oracle(view: SocialNavView, spec: BaseSpec) -> Velocity:
    """Act like `sampling_expert`, but with the person's true future.

    The robot drives to the earliest meeting point and gives way in time.

    Raises:
        InputError: The person's future is unknown, because they do not follow the script of an episode.
    """
    if view.future is None:
        raise InputError(
            "future_oracle needs the person's future, known of scripted and recorded people alone.",
            code="H3-POLICY-062",
        )
    future = view.future()
    # near the end of an episode the known future is shorter: they stay where it ends
    walk = np.concatenate(
        [future[: EXPERT.escape_steps], np.repeat(future[-1:], max(EXPERT.escape_steps - len(future), 0), axis=0)]
    )
    if not view.met and view.geodesic_m > EXPERT.reach_m:
        # towards the first place on the person's path that the robot can reach before they leave it;
        # to find the person it need only come within `EXPERT.reach_m` of them
        soonest = np.arange(1, len(future) + 1) * (spec.max_speed_mps * STEP_S) + EXPERT.reach_m
        in_time = view.free.geodesic(np.broadcast_to(view.robot_xz, future.shape), future) <= soonest
        return _approach(view, spec, future[np.argmax(in_time)] if in_time.any() else view.human_xz)
    return _best_sample(view, spec, walk)


def _best_sample(view: SocialNavView, spec: BaseSpec, walk: NDArray[np.float64]) -> Velocity:
    """Return the best of fixed and sampled commands, given a person who walks along ``walk`` [H, 2]."""
    if not np.isfinite(view.geodesic_m):
        return Velocity(0.0, 0.0, "wait")
    drawn = generator(view.seed, "policy/sampling", step=view.step).uniform(-1, 1, (EXPERT.samples, 3))
    steps = np.exp2(3.5 + 1.5 * drawn[:, 2])  # 4 to 32
    forward = np.where(np.arange(EXPERT.samples) % 2, np.sign(drawn[:, 0]), drawn[:, 0])
    then = np.where(np.arange(EXPERT.samples) % 4 < 2, forward, 0.0)
    # the row of zeros: to stand still may be best
    commands = np.vstack([_STEERING, _BACKING, np.stack([forward, drawn[:, 1], steps, then], -1), np.zeros((1, 4))])
    ends = roll_out(view.free, spec, view.robot_xz, view.robot_heading, commands, walk, look_steps=EXPERT.steer_steps)
    left, error = _way_left(view.free, walk[EXPERT.steer_steps - 1], ends.xz, ends.heading)
    lacking = np.maximum(EXPERT.margin_m - ends.gap_m, 0.0)
    best = np.argmin(np.abs(left - EXPERT.keep_distance_m) + EXPERT.turn_cost_m * error + EXPERT.room_cost * lacking)
    forward, turn = commands[best, :2].tolist()
    skill = "back_up" if forward < 0 and view.geodesic_m < EXPERT.keep_distance_m else "follow" if view.met else "find"
    return Velocity(forward, turn, skill)


def stand_still(view: SocialNavView, spec: BaseSpec) -> Velocity:
    """Return a velocity of 0, which gives the lower bound of all scores."""
    return Velocity(0.0, 0.0, "wait")


def random(view: SocialNavView, spec: BaseSpec) -> Velocity:
    """Return a uniformly random base velocity in every step, determined by the seed, as a baseline."""
    forward, turn = generator(view.seed, "policy/random", step=view.step).uniform(-1, 1, 2)
    return Velocity(float(forward), float(turn), "follow" if view.met else "find")


def learned_follower(view: SocialNavView, spec: BaseSpec) -> Velocity:
    """Act by the included weights, which ``examples/train_social_nav.py`` produced (h3data docs learned-policies)."""
    return _follower()(view, spec)


@cache
def _follower() -> Policy:
    return LearnedNavigation(load_network(builtin_path("policies/learned_follower.npz")))


POLICIES: dict[str, Policy] = {
    "rollout_expert": rollout_expert,
    "heuristic_expert": heuristic_expert,
    "sampling_expert": sampling_expert,
    "future_oracle": future_oracle,
    "learned_follower": learned_follower,
    "random": random,
    "stand_still": stand_still,
}
EXPERTS = ("rollout_expert", "sampling_expert", "future_oracle")
"""Names of the experts that can also maneuver out of places where they are stuck
(`sim_kinematic.policies.social_nav`). ``heuristic_expert`` follows only the paper's two rules."""


NEAR_M = 2.0
"""Distance from the person below which a maneuver ends or does not start, as maneuvers do not avoid people [m]."""


class Maneuvering:
    """Policy that computes velocities from the view, and maneuvers out of places where the base is stuck.

    When the base has not moved for a moment, it makes a maneuver (`sim_kinematic.avoidance.maneuvers`) towards the
    person. A base 1.2 m long that is wedged between two walls needs several commands to get out, the first of which
    does not shorten the path. Without maneuvers, experts stood like that for the rest of 3% of the episodes.
    """

    def __init__(self, function: Callable[[SocialNavView, BaseSpec], Velocity], base: BaseSpec) -> None:
        self._function, self._base = function, base
        self.__name__ = function.__name__
        self._still = 0
        """Number of steps for which the base has not moved although it was to find or follow the person."""
        self._commands: list[tuple[float, float]] = []

    def act(self, view: SocialNavView) -> Velocity:
        """Return the function's command, or the next one of a maneuver."""
        wish = self._function(view, self._base)
        # a robot that waits or backs away may stand still on purpose
        if not self._base.maneuvers or wish.skill not in ("find", "follow"):
            self._still, self._commands = 0, []
            return wish
        # equal to the last bit: a base that is pressed against walls does not move at all
        before = view.robot_before
        rests = before is not None and view.robot_heading == before[1] and (view.robot_xz == before[0]).all()
        self._still = self._still + 1 if rests else 0
        if (self._commands or rests) and float(np.hypot(*(view.human_xz - view.robot_xz))) < NEAR_M:
            self._commands = []
        # again after every interval: a plan may have found nothing or not led out
        elif rests and self._still % AVOIDANCE.maneuver_after_steps == 0:
            self._commands = [(forward, turn) for forward, turn in self._plan(view)]
        return Velocity(*self._commands.pop(0), wish.skill) if self._commands else wish

    def _plan(self, view: SocialNavView) -> list[list[float]]:
        """Return commands (forward, turn), one per step, that lead the base towards the person; empty: there are none."""
        # without discs of others: near the person the maneuver ends anyway (`NEAR_M`)
        nobody = np.zeros((0, 3))
        return plan_maneuver(view.free, self._base, view.robot_xz, view.robot_heading, view.human_xz, nobody).tolist()
