"""Search for a resting posture in which the arm is folded over the base, so that the robot fits through doors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.robots.robot import Robot
from h3data.geometry import IDENTITY_POSE, Array, transform_points
from h3data.scene.shape_bounds import shape_bounds

SAMPLES, KEPT, ROUNDS = 2000, 6, 30
"""Number of random postures, number of the best ones that are improved, and number of rounds of improvement. For an arm
of eight joints this takes about a second."""
FLOOR_M = 0.15
"""Height above the floor that all parts of the arm should have at least [m]."""
SPARE_M = 0.03
"""Least distance of the arm from the body and from itself [m]."""
BODY_WEIGHT, SELF_WEIGHT = 10.0, 4.0
"""Weights of a metre inside the body, and inside the arm itself, compared with a metre beyond the base."""


def compact_posture(robot: Robot, hand: int, body: Sequence[int], joints: Array, reach_m: float) -> Array:
    """Return joint positions [J] in which the arm extends least beyond a circle around the robot's root.

    Args:
        robot: Model of the robot.
        hand: Link at the end of the arm.
        body: Links that the arm must not enter.
        joints: Positions of all other joints [J].
        reach_m: Radius of the circle [m].
    """
    chain, link = [], hand
    while link >= 0:
        chain.append(link)
        link = robot.links[link].parent
    columns = np.array(sorted({int(robot.columns[k]) for k in chain if robot.kinds[k] == 1}), np.int64)
    if not len(columns):
        return joints
    cost = _Cost(robot, hand, body, joints, reach_m)
    # continuous joints have no limits, and a turn more looks the same
    lower, upper = np.maximum(robot.lower[columns], -np.pi), np.minimum(robot.upper[columns], np.pi)
    # the same robot must always rest alike: recordings depend on it
    rng = np.random.default_rng(0)
    postures = np.tile(np.asarray(joints, np.float64), (SAMPLES, 1))
    postures[1:, columns] = rng.uniform(lower, upper, (SAMPLES - 1, len(columns)))
    best = postures[np.argsort(cost(postures), kind="stable")[:KEPT]]
    for step in range(ROUNDS):
        near = np.repeat(best, 16, axis=0)
        near[:, columns] += rng.normal(0, 0.5 * 0.88**step, (len(near), len(columns)))
        near[:, columns] = np.clip(near[:, columns], lower, upper)
        tried = np.concatenate([best, near])
        best = tried[np.argsort(cost(tried), kind="stable")[:KEPT]]
    return np.clip(np.round(best[0], 3), robot.lower, robot.upper)


class _Cost:
    """Cost of postures [N, J] by how badly they are folded, [N] [m]."""

    def __init__(self, robot: Robot, hand: int, body: Sequence[int], joints: Array, reach_m: float) -> None:
        self._robot, self._reach_m = robot, reach_m
        still = robot.link_matrices(IDENTITY_POSE[None], joints[None])[0]
        boxes = [shape_bounds(shape, still[k]) for k in body for shape in robot.links[k].shapes]
        self._boxes = np.array(boxes).reshape(-1, 2, 3) + np.array([[-SPARE_M], [SPARE_M]])
        arm = [k for k in range(len(robot.links)) if k not in set(body)]
        self._arm, self._hand = arm, hand
        self._points = {k: _outline(robot, k) for k in arm}
        self._pairs = [(a, b) for n, a in enumerate(arm) for b in arm[n + 1 :] if self._apart(a, b)]
        self._radius = {k: SPARE_M + 0.5 * float(np.ptp(self._points[k], axis=0).min()) for k in arm}

    def _apart(self, a: int, b: int) -> bool:
        """Return whether two links are neither neighbours nor held by a common one."""
        parents = [link.parent for link in self._robot.links]
        return a not in (parents[b], parents[parents[b]]) and b != parents[a] and parents[a] != parents[b]

    def __call__(self, postures: Array) -> Array:
        root = np.tile(IDENTITY_POSE, (len(postures), 1))
        frames = self._robot.link_matrices(root, postures)
        placed = {k: transform_points(frames[:, k], np.tile(self._points[k], (len(root), 1, 1))) for k in self._arm}
        points = np.concatenate(list(placed.values()), axis=1)
        far = np.hypot(points[..., 0], points[..., 2]).max(1)
        cost = np.maximum(far - self._reach_m, 0.0) + 0.1 * far
        cost += np.maximum(FLOOR_M - points[..., 1], 0.0).sum(1)
        for low, high in self._boxes:
            inside = np.minimum(points - low, high - points).min(-1)
            cost += BODY_WEIGHT * np.maximum(inside, 0.0).sum(1)
        for a, b in self._pairs:
            middles = placed[a].mean(1), placed[b].mean(1)
            gap = np.linalg.norm(middles[0] - middles[1], axis=-1) - self._radius[a] - self._radius[b]
            cost += SELF_WEIGHT * np.maximum(-gap, 0.0)
        return cost - 0.05 * frames[:, self._hand, 0, 3]  # rather before the robot than behind it


def _outline(robot: Robot, link: int) -> NDArray[np.float64]:
    """Return corners and centres [N, 3] of the boxes around a link's shapes, in its frame; its origin without any."""
    bounds = [shape_bounds(shape, np.eye(4)) for shape in robot.links[link].shapes]
    if not bounds:
        return np.zeros((1, 3))
    corners = [np.stack(np.meshgrid(*box.T), -1).reshape(-1, 3) for box in bounds]
    return np.concatenate([*corners, [box.mean(0) for box in bounds]])
