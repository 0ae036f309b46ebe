"""Pictures of training worlds on a machine without a GPU, for tests and small experiments."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from types import SimpleNamespace

import numpy as np
import torch
from torch import Tensor

from h3data.bodies import load_humanoid, load_robot
from h3data.render import Output
from h3data.render.light.sources import LightMode
from h3data.scene import Scene
from h3data_training.torch.state import HumanTensors, RobotTensors
from sim_kinematic.motion.spec import WalkerSpec
from sim_kinematic.motion.state import WorldState
from sim_kinematic.sensing.camera_sensor import CameraSensor, StateRenderer


def stacked(sensor: CameraSensor, worlds: Iterable[StateRenderer]) -> dict[str, Tensor]:
    """Return pictures of worlds that are posed one after the other, each [W, H, W', ...], by output."""
    taken = [sensor.observe(drawn) for drawn in worlds]
    return {name: torch.as_tensor(np.concatenate([pictures[name] for pictures in taken])) for name in sensor.outputs}


class CpuCameras:
    """CPU version of `h3data_training.torch.cameras.TensorCameras`, which renders world by world."""

    def __init__(
        self,
        scenes: Sequence[Scene],
        robot: str,
        human: str,
        walker: WalkerSpec,
        *,
        floors: Sequence[float],
        views: Sequence[str],
        size: tuple[int, int],
        light: LightMode = "flat",
    ) -> None:
        self._scenes, self._floors, self._walker, self.views = scenes, floors, walker, tuple(views)
        self._bodies = load_robot(robot), load_humanoid(human)
        own = self._bodies[0].camera("robot_arm")
        self.share = size[0] * size[1] / (own.width * own.height)
        self.renderer = SimpleNamespace(width=size[0], height=size[1])
        self._size = size
        self._light: LightMode = light
        self._drawn: dict[tuple[int, LightMode], StateRenderer] = {}
        self._state, self._homes = WorldState.zeros(0), np.zeros(0, int)

    def pose(self, robot: RobotTensors, human: HumanTensors, *, place: Tensor | None = None) -> None:
        """Set the poses of robots and people in all worlds.

        The interface is that of `h3data_training.torch.cameras.TensorCameras.pose`.
        """
        state = WorldState.zeros(len(robot.heading), joints=[len(self._bodies[0].rest)])
        robot.put(state.robots[0])
        human.put(state.people[0])
        state.robots[0].joints[:] = self._bodies[0].rest
        self._state, self._homes = state, np.zeros(state.worlds, int) if place is None else place.numpy().copy()

    def picture(self, view: str, outputs: Sequence[Output]) -> dict[str, Tensor]:
        """Render all worlds on the CPU, with the interface of `h3data_training.torch.cameras.TensorCameras.picture`."""
        sensor = CameraSensor(camera=view, outputs=tuple(outputs), size=self._size)
        light: LightMode = self._light if "rgb" in outputs else "flat"
        return stacked(sensor, (self._posed(w, home, light) for w, home in enumerate(self._homes.tolist())))

    def _posed(self, w: int, home: int, light: LightMode) -> StateRenderer:
        if (home, light) not in self._drawn:
            speed = self._walker.speed_mps
            self._drawn[home, light] = StateRenderer(self._scenes[home], self._bodies, speed_mps=speed, light=light)
        self._drawn[home, light].pose(self._state.take(np.array([w])), floor=self._floors[home])
        return self._drawn[home, light]
