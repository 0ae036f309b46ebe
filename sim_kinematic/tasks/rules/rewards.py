"""Rewards of the two built-in tasks, computed step by step for W worlds at once, in two profiles.

The profile ``paper`` has the published rewards (appendix, social navigation and social rearrangement), and ``habitat``
those of habitat-lab's main branch.

`h3data.metrics` (profile ``habitat``) computes the same rewards for whole recordings, and its configuration is used
here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.metrics.habitat_settings import HabitatConfig
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.sensing.sensor import facing
from sim_kinematic.tasks.rules.predicates import is_found

RewardProfile = Literal["paper", "habitat"]


def check_profile(profile: str) -> None:
    """Raise an `InputError` if there is no `RewardProfile` with this name."""
    if profile not in get_args(RewardProfile):
        raise InputError(
            f"Unknown reward {profile!r}. Expected one of: {', '.join(get_args(RewardProfile))}.", code="H3-TASK-041"
        )


class Encounter(NamedTuple):
    """Quantities of one step that the reward of social navigation depends on."""

    robot_xz: ArrayLike
    """Place of the robot, shape [W, 2] [m]."""
    robot_heading: ArrayLike
    """Heading of the robot, shape [W] [rad]."""
    human_xz: ArrayLike
    """Place of the person, shape [W, 2] [m]."""
    geodesic: ArrayLike
    """Length of the shortest path between robot and person [m], shape [W]; if it is infinite, the straight distance
    counts."""
    collides: ArrayLike = False
    """True if robot and person touch, shape [W]."""
    collisions: ArrayLike = 0
    """Collisions of the robot with anything since the start, shape [W] (``habitat`` only)."""
    faces: ArrayLike | None = None
    """Value of `facing` of the robot towards the person, shape [W]; None: it is computed."""
    goal_xz: ArrayLike | None = None
    """Position of the task's navigation goal, shape [W, 2] [m]; only if ``habitat`` is configured to measure to it."""

    def of(self, where: NDArray[np.bool_]) -> Encounter:
        """Return the quantities in some of the worlds; values that hold for all worlds are unchanged."""
        rows: dict[str, Any] = {
            n: v if v is None or np.ndim(v) == 0 else np.asarray(v)[where] for n, v in self._asdict().items()
        }
        return Encounter(**rows)


class RewardStep(NamedTuple):
    """Reward, success and end of a step, each of shape [W]."""

    reward: NDArray[np.float64]
    success: NDArray[np.bool_]
    """True once the person has been followed long enough; it stays true."""
    ends: NDArray[np.bool_]
    """True if the rules end the episode, because of a collision."""


@dataclass(frozen=True, kw_only=True)
class PaperReward:
    """Published reward ``10 success + r_distance + 3 r_orientation - 0.1`` (paper appendix)."""

    success: float = 10.0
    kept: float = 2.0
    # habitat-lab's file has 0.01, its command for the paper's results 3
    facing: float = 3.0
    facing_within_m: float = 3.0
    slack: float = -0.1
    # habitat-lab's file has 500, its command for the paper's results 400
    follow_steps: int = 400

    def of(
        self,
        geodesic: Any,
        straight: Any,
        before: Any,
        faces: Any,
        followed: Any,
        rules: SocialNavSpec,
        *,
        xp: Any = np,
    ) -> tuple[Any, Any, Any, Any]:
        """Compute the reward of a step, from arrays or tensors [W].

        Args:
            geodesic: length of the shortest path between robot and person after the step [m]; infinite if there is none.
            straight: straight distance between them [m], which counts then.
            before: distance before the step, as this function returns it; NaN in the first step.
            faces: `facing` of the robot towards the person after the step.
            followed: number of earlier steps in which the person was followed.
            rules: distances and angle at which the robot follows.
            xp: array namespace.

        Returns:
            The reward; the steps in which the person has been followed now; whether these are enough; the distance [m].
        """
        distance = xp.where(xp.isfinite(geodesic), geodesic, straight)
        # in the first step there is no change of distance to pay
        before = xp.where(xp.isnan(before), distance, before)
        # the paper counts 1 m itself as too near and 2 m as right; Habitat's interval is half-open the other way
        near = distance <= rules.near_m
        kept = (distance <= rules.far_m) & ~near
        count = followed + (kept & (faces > rules.facing_dot))
        success = count >= self.follow_steps
        # too near, going away pays; too far, coming nearer
        reward = xp.where(kept, self.kept, xp.where(near, distance - before, before - distance)) + self.slack
        reward = reward + self.facing * xp.where(distance <= self.facing_within_m, faces, 0.0)
        # once, where Habitat pays it in every later step again
        return reward + self.success * (success & (followed < self.follow_steps)), count, success, distance


class SocialNavReward:
    """Reward of social navigation in W worlds, with the last distances and the numbers of steps followed."""

    def __init__(
        self,
        worlds: int,
        *,
        profile: RewardProfile = "paper",
        rules: SocialNavSpec | None = None,
        paper: PaperReward | None = None,
        habitat: HabitatConfig | None = None,
    ) -> None:
        check_profile(profile)
        self.profile: RewardProfile = profile
        self.rules, self.paper, self.habitat = (
            rules or SocialNavSpec(),
            paper or PaperReward(),
            habitat or HabitatConfig(),
        )
        self.followed = np.zeros(worlds, np.int64)
        """Number of steps in which the person was followed, not necessarily in a row, shape [W]."""
        self._distance = np.full(worlds, np.nan)
        self._collisions = np.zeros(worlds, np.int64)
        self._found = np.zeros(worlds, np.bool_)
        self._cells: list[set[tuple[int, int]]] = [set() for _ in range(worlds)]

    def reset(self, seen: Encounter, *, where: ArrayLike = True) -> RewardStep:
        """Start new episodes in the worlds ``where`` [W], whose first states are ``seen``.

        The result is meaningful only for ``habitat``, where the reset is evaluated as a step and may count as followed.
        """
        fresh = np.broadcast_to(np.asarray(where, np.bool_), self.followed.shape)
        new = SocialNavReward(
            int(fresh.sum()), profile=self.profile, rules=self.rules, paper=self.paper, habitat=self.habitat
        )
        first = new.step(seen.of(fresh))
        # in the paper rewards and followed steps begin with the first step, after the reset
        if self.profile == "paper":
            new.followed[:] = 0
        self.followed[fresh], self._distance[fresh] = new.followed, new._distance
        self._collisions[fresh], self._found[fresh] = new._collisions, new._found
        for w, cells in zip(np.flatnonzero(fresh), new._cells, strict=True):
            self._cells[w] = cells
        result = RewardStep(np.zeros(len(fresh)), np.zeros(len(fresh), np.bool_), np.zeros(len(fresh), np.bool_))
        if self.profile == "habitat":
            for all_worlds, some in zip(result, first, strict=True):
                all_worlds[fresh] = some
        return result

    def step(self, seen: Encounter) -> RewardStep:
        """Compute the reward of the last step from the state after it."""
        xz, human = np.asarray(seen.robot_xz, np.float64), np.asarray(seen.human_xz, np.float64)
        if xz.shape != (len(self.followed), 2) or human.shape != xz.shape:
            raise InputError(
                f"Expected places [{len(self.followed)}, 2] of robots and humans, "
                f"got {list(xz.shape)} and {list(human.shape)}.",
                code="H3-TASK-042",
            )
        faces = facing(xz, seen.robot_heading, human) if seen.faces is None else np.asarray(seen.faces, np.float64)
        gap = human - xz
        straight = np.hypot(gap[:, 0], gap[:, 1])
        geodesic = _each(np.asarray(seen.geodesic, np.float64), straight.shape)
        collides = _each(np.asarray(seen.collides, np.bool_), straight.shape)
        if self.profile == "habitat":
            return self._step_habitat(seen, faces, straight, geodesic, collides)
        reward, self.followed[:], success, self._distance[:] = self.paper.of(
            geodesic, straight, self._distance, faces, self.followed, self.rules
        )
        return RewardStep(reward, success, collides & self.rules.end_on_collision)

    def _step_habitat(
        self, seen: Encounter, faces: NDArray, straight: NDArray, geodesic: NDArray, collides: NDArray
    ) -> RewardStep:
        worth = self.habitat.reward
        distance = np.where(np.isfinite(geodesic), geodesic, straight) if worth.use_geo_distance else straight
        first = np.isnan(self._distance)
        # Habitat's own mark for no distance yet; what follows from it is set to 0 below
        before = np.where(first, -1.0, self._distance)
        # half-open, unlike the paper's interval and that of `is_found`
        kept = (distance >= worth.safe_dis_min) & (distance < worth.safe_dis_max)
        closer = np.where(distance < worth.safe_dis_min, distance - before, before - distance)
        reward = np.where(kept, worth.safe_dis_reward, closer) * worth.toward_human_reward
        # -1 is Habitat's mark for a part that is switched off, here and below
        near = (distance < worth.facing_human_dis) & (worth.facing_human_reward != -1)
        reward += near * worth.facing_human_reward * faces
        if worth.near_human_bonus != -1:
            reward += near * worth.near_human_bonus
        if worth.explore_reward != -1:
            reward += self._explores(np.asarray(seen.robot_xz), first) * worth.explore_reward
        # as in Habitat, the first step has no distance before it and gives no reward
        reward = np.where(first, 0.0, reward) - worth.collide_penalty * collides
        collisions = np.broadcast_to(np.asarray(seen.collisions, np.int64), straight.shape)
        ends = collides.copy()
        if worth.count_coll_pen != -1:
            reward -= worth.count_coll_pen * (collisions > self._collisions)
        if worth.max_count_colls != -1:
            ends |= collisions > worth.max_count_colls
            reward -= worth.count_coll_end_pen * (collisions > worth.max_count_colls)
        success = self._follows_habitat(seen, faces, geodesic)
        self._distance[:], self._collisions[:] = distance, collisions
        self._found |= is_found(geodesic, faces, self.rules)
        reward += self.habitat.slack_reward + self.habitat.success_reward * success
        return RewardStep(reward, success, ends)

    def _follows_habitat(self, seen: Encounter, faces: NDArray, geodesic: NDArray) -> NDArray[np.bool_]:
        rules, distance, angle = self.habitat.success, geodesic, np.zeros_like(faces)
        if rules.must_look_at_targ or not rules.use_geo_distance:
            if seen.goal_xz is None:
                raise InputError(
                    "The success is configured to be measured to the task's goal, and goal_xz is not given.",
                    code="H3-TASK-044",
                )
            xz, goal = np.asarray(seen.robot_xz, np.float64), np.asarray(seen.goal_xz, np.float64)
            # clipped, as rounding may put a cosine beyond 1
            angle = np.arccos(np.clip(facing(xz, seen.robot_heading, goal), -1, 1))
            distance = geodesic if rules.use_geo_distance else np.hypot(*(goal - xz).T)
        near = (distance >= rules.safe_dis_min) & (distance < rules.safe_dis_max)
        self.followed += near & ((faces > rules.facing_threshold) | (not rules.need_to_face_human))
        # not in a row, and true from then on: Habitat pays the success in every later step too
        success = self.followed >= rules.following_step_succ_threshold
        return success & (angle < rules.success_angle_dist) if rules.must_look_at_targ else success

    def _explores(self, xz: NDArray, first: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return in which worlds the robot has not found the person and enters a cell of 0.5 m for the first time, [W]."""
        new = np.zeros(len(first), np.bool_)
        for w in np.flatnonzero(~first & ~self._found):
            cell = int(np.round(xz[w, 0] * 2)), int(np.round(xz[w, 1] * 2))
            new[w] = cell not in self._cells[w]
            self._cells[w].add(cell)
        return new


def _each(values: NDArray, shape: tuple[int, ...]) -> NDArray:
    """Return values of this shape; a single one is repeated for all."""
    return values if values.shape == shape else np.broadcast_to(values, shape)


# --- rearrangement ------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, kw_only=True)
class RearrangeReward:
    """Rewards of social rearrangement, by default those of the paper."""

    success: float = 10.0
    stage: float = 5.0
    """Reward for each sub-goal (an object picked, an object at its goal), given once."""
    collision: float = 5.0
    """Penalty when the agents touch, which ends the episode."""
    slack: float = -0.005

    def step(self, held: Any, at_goal: Any, paid: Any, collides: Any, *, xp: Any = np) -> tuple[Any, Any, Any]:
        """Return the reward of a step in W worlds of K objects, as arrays or tensors.

        Args:
            held: which objects are held, bool [W, K].
            at_goal: which objects are at their goals and not held, bool [W, K].
            paid: sub-goals that were rewarded before: each object taken, then each at its goal, bool [W, 2 K].
            collides: whether the agents touch, as numbers [W] in the type of the reward.
            xp: array namespace.

        Returns:
            The reward; the sub-goals that have been rewarded now; whether all objects are at their goals.
        """
        stages, success = xp.concatenate([held, at_goal], -1), at_goal.all(-1)
        # what is paid stays paid, even if an object is taken from its goal and put back
        return self.of((stages & ~paid).sum(-1), collides, success), paid | stages, success

    def of(self, reached: Any, collides: Any, success: Any) -> Any:
        """Return the reward of a step in which ``reached`` sub-goals were rewarded, as a number or array [W]."""
        return self.stage * reached - self.collision * collides + self.success * success + self.slack


REARRANGE_REWARDS: dict[str, RearrangeReward] = {
    "paper": RearrangeReward(),
    # a tenth of what the paper prints, in habitat-lab's configuration
    "habitat": RearrangeReward(collision=0.5, slack=-0.0005),
}
"""Rewards of rearrangement by the name of the profile."""
