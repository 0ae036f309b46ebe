"""Pictures of the worlds of a skill on a machine without a GPU, for tests and small experiments."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from h3data.geometry import pose_from_matrix
from h3data.render import Output
from h3data_training.cpu_cameras import stacked
from h3data_training.torch.skills.cameras import moved_bodies
from h3data_training.torch.skills.worlds import SkillPlay, SkillTensors
from sim_kinematic.motion.state import WorldState
from sim_kinematic.sensing.camera_sensor import CameraSensor, StateRenderer


class CpuSkillCameras:
    """CPU version of `h3data_training.torch.skills.cameras.SkillCameras`, which renders world by world."""

    def __init__(self, sim: SkillTensors, *, size: tuple[int, int]) -> None:
        self._sim, self._size = sim, size
        self._moving = moved_bodies(sim.bank)
        self._drawn: dict[int, StateRenderer] = {}

    def observe(self, play: SkillPlay, outputs: Sequence[Output] = ("depth",)) -> dict[str, Tensor]:
        """Render all worlds on the CPU.

        The interface is that of `h3data_training.torch.skills.cameras.SkillCameras.observe`.
        """
        sensor = CameraSensor(outputs=tuple(outputs), size=self._size)
        return stacked(sensor, (self._posed(play, w, episode) for w, episode in enumerate(play.episode.tolist())))

    def _posed(self, play: SkillPlay, w: int, episode: int) -> StateRenderer:
        bank, robot = self._sim.bank, self._sim.arm.robot
        home = int(bank.place[episode])
        scene, moving = bank.scenes[home], self._moving[home]
        if home not in self._drawn:
            self._drawn[home] = StateRenderer(scene, [robot], objects=[scene.instances[k].name for k in moving])
        state = WorldState.zeros(1, people=0, joints=len(robot.rest), objects=len(moving))
        (own,) = state.robots
        own.xz[0], own.heading[0], own.joints[0] = play.robot.xz[w], float(play.robot.heading[w]), robot.rest
        own.joints[0, list(robot.require_arm())] = play.joints[w]
        state.object_pose[0] = [scene.instances[k].pose for k in moving]
        slots = np.searchsorted(moving, bank.bodies[episode])
        matrices = np.tile(np.eye(4), (len(slots), 1, 1))
        matrices[:, :3, :3], matrices[:, :3, 3] = play.turned[w], play.objects[w]
        state.object_pose[0, slots] = pose_from_matrix(matrices)
        self._drawn[home].pose(state, floor=float(bank.floors[home].floor_y))
        return self._drawn[home]
