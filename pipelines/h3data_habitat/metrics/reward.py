"""habitat-lab's social navigation rewards and success, step by step, from arrays.

Variant ``habitat`` is its main branch. ``habitat@0.3.0`` is the paper's release: the reward has only the distance and the
facing part, without collisions, and following counts only if facing is required (spec/habitat-findings.md 3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.metrics.habitat_settings import HabitatConfig, RewardConfig, SuccessConfig
from h3data_habitat.metrics.stats import HabitatTrack, unit_vectors

MAIN, PAPER_RELEASE = "habitat", "habitat@0.3.0"


@dataclass(frozen=True, kw_only=True, eq=False)
class TaskTrack:
    """Inputs of the rewards besides positions; every array is [T]."""

    collides: NDArray[np.bool_]
    """True if robot and human touch."""
    collisions: NDArray[np.integer]
    """Number of collisions of the robot with anything up to each step."""
    has_found: NDArray[np.bool_]
    """Value of ``has_found_human`` in the statistics."""
    goal_pos: NDArray[np.float64] | None = None
    """Position of the task's navigation goal [3], if known."""


def goal_errors(track: HabitatTrack, goal_pos: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the distance on the floor [m] and the angle [rad] from the robot to a goal [3], each [T]."""
    towards = (goal_pos - track.robot_pos)[:, [0, 2]]
    cosine = np.sum(unit_vectors(track.robot_transform[:, [0, 2], 0]) * unit_vectors(towards), axis=1)
    return np.linalg.norm(towards, axis=1), np.arccos(np.clip(cosine, -1, 1))


def seek_success(
    track: HabitatTrack, task: TaskTrack, config: SuccessConfig, *, variant: str = MAIN
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the steps followed so far (not necessarily consecutive) and whether they suffice, each [T].

    Raises:
        ValueError: the configuration measures distances to the task's goal, but the task has no goal.
    """
    if task.goal_pos is None and (config.must_look_at_targ or not config.use_geo_distance):
        raise ValueError("needs the task's goal position")
    to_goal, angle = (None, None) if task.goal_pos is None else goal_errors(track, task.goal_pos)
    distance = track.geodesic if config.use_geo_distance or to_goal is None else to_goal
    with np.errstate(invalid="ignore"):
        faces = track.facing() > config.facing_threshold
        near = (distance >= config.safe_dis_min) & (distance < config.safe_dis_max)
    if variant == PAPER_RELEASE:
        follows = near & faces & config.need_to_face_human
    else:
        follows = near & (faces | (not config.need_to_face_human))
    steps = np.cumsum(follows, dtype=np.int64)
    success = np.asarray(steps >= config.following_step_succ_threshold)
    if config.must_look_at_targ and angle is not None:
        success = success & (angle < config.success_angle_dist)
    return steps, success


def social_nav_reward(
    track: HabitatTrack, task: TaskTrack, config: RewardConfig, *, variant: str = MAIN
) -> NDArray[np.float64]:
    """Compute ``SocialNavReward`` at every step [T]."""
    if not len(track.geodesic):
        return np.zeros(0)
    main = variant != PAPER_RELEASE
    straight = track.distance()
    reachable = np.isfinite(track.geodesic)
    distance = np.where(reachable, track.geodesic, straight) if config.use_geo_distance else straight
    # what Habitat starts with; the row is set to 0 below
    before = np.concatenate([[-1.0], distance[:-1]])
    with np.errstate(invalid="ignore"):
        kept = (distance >= config.safe_dis_min) & (distance < config.safe_dis_max)
        # too near, more distance is a reward; else less
        closer = np.where(distance < config.safe_dis_min, distance - before, before - distance)
        seen = (distance < config.facing_human_dis) & (config.facing_human_reward != -1)
    reward = np.where(kept, config.safe_dis_reward, closer) * (config.toward_human_reward if main else 1.0)
    reward = reward + np.where(seen, config.facing_human_reward * track.facing(), 0.0)
    if main and config.near_human_bonus != -1:
        reward = reward + seen * config.near_human_bonus
    if main and config.explore_reward != -1:
        reward = reward + _explores(track.robot_pos, task.has_found) * config.explore_reward
    reward[0] = 0.0  # no previous distance yet
    if main:
        reward -= config.collide_penalty * task.collides
        reward += _counted_collisions(task.collisions, config)
    return reward


def total_reward(reward: NDArray[np.float64], success: NDArray[np.bool_], config: HabitatConfig) -> NDArray[np.float64]:
    """Return the training reward at every step [T]; success that does not end the episode is rewarded repeatedly."""
    return config.slack_reward + reward + config.success_reward * success


def _explores(robot_pos: NDArray[np.float32], has_found: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return rows in which the robot enters a cell of 0.5 m for the first time and had not found the human a step before."""
    looking = np.concatenate([[False], ~has_found[:-1]])  # at the reset the statistics have not been computed yet
    # rounded as Habitat does it, so that cells lie around multiples of 0.5 m
    cells = np.round(np.nan_to_num(robot_pos[:, [0, 2]]) * 2).astype(np.int64)
    rows = np.flatnonzero(looking)
    new = np.zeros(len(cells), np.bool_)
    new[rows[np.unique(cells[rows], axis=0, return_index=True)[1]]] = True
    return new


def _counted_collisions(collisions: NDArray[np.integer], config: RewardConfig) -> NDArray[np.float64]:
    penalty = np.zeros(len(collisions))
    # -1 switches a part of the reward off
    if config.count_coll_pen != -1:
        penalty -= config.count_coll_pen * (np.diff(collisions, prepend=0) > 0)
    if config.max_count_colls != -1:
        penalty -= config.count_coll_end_pen * (collisions > config.max_count_colls)
    return penalty
