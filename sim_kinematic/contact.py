"""Does the robot touch the person? A distance test first; FCL on the exact shapes when they are near."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot
from h3data.geometry import IDENTITY_POSE
from sim_kinematic.collision import AgentContact

GATE_M = 2.0
"""Bases farther apart than this cannot touch: neither body reaches a metre from its root along the floor."""


class RobotHumanContact:
    """Contact between one robot (collision shapes of its links) and one humanoid (its 18 capsules)."""

    def __init__(self, robot: Robot, human: Humanoid) -> None:
        self.robot, self.human = robot, human
        self._links = [k for k, link in enumerate(robot.links) for _ in link.shapes]
        rest = human.joint_matrices(IDENTITY_POSE[None], *human.clip_pose(np.zeros(1, int), np.zeros(1), np.zeros(1)))
        start, end, radius = human.capsules_world(rest)
        self._pair = AgentContact([s for link in robot.links for s in link.shapes], start[0], end[0], radius)

    def touching(
        self,
        robot_base: NDArray[np.floating],
        robot_joints: NDArray[np.floating],
        human_base: NDArray[np.floating],
        human_joints: Callable[[], NDArray[np.floating]],
    ) -> bool:
        """Whether they touch: base poses [7], the robot's joint positions [J], and the person's joint matrices
        [55, 4, 4], which are computed only when the two are near."""
        if np.hypot(*(robot_base[[0, 2]] - human_base[[0, 2]])) > GATE_M:
            return False
        links = self.robot.link_matrices(robot_base[None], robot_joints[None])[0]
        start, end, _ = self.human.capsules_world(human_joints()[None])
        self._pair.update(links[self._links], start[0], end[0])
        return self._pair.collides()
