"""Training environment on a device for a task of one robot and one scripted person, with tensors in and out."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from h3data.bodies import Humanoid, Robot, load_humanoid, load_robot
from h3data.errors import InputError
from h3data.render.light.sources import LightMode, check_light
from h3data_training.envs.torch_env import Tensors, TorchEnv
from h3data_training.torch.task_worlds import Play, TaskTensors
from sim_kinematic.motion.spec import WalkerSpec
from sim_kinematic.sensing.sensor import DETECTED_PIXELS, HUMAN_ID, scaled_depth
from sim_kinematic.sensing.table import STATE_OBSERVATIONS, Sensor, sensors_of
from sim_kinematic.tasks.sources import Scenes, in_words
from sim_kinematic.tasks.task import Task

if TYPE_CHECKING:
    from gymnasium.spaces import Box, Dict

    from h3data.render import Output
    from h3data_training.torch.cameras import TensorCameras
    from h3data_training.torch.episodes import EpisodeBank

PICTURED = ("arm_depth", "arm_rgb", "humanoid_detector")
"""Observations that need a rendered picture, and therefore a GPU."""
OUTPUTS: dict[str, Output] = {"arm_depth": "depth", "humanoid_detector": "semantic"}
"""Outputs of the arm's depth camera from which the observations are computed."""
ARM, ARM_RGB = "robot_arm", "robot_arm_rgb"
EPISODES = 512
"""Default number of episodes in the bank, which take some seconds to sample."""


def arm_cameras(observations: Sequence[str]) -> tuple[str, ...]:
    """Return the arm cameras that observations need: that of depth and detector, then the colour camera, if any."""
    return (*[ARM] * bool(set(OUTPUTS) & set(observations)), *[ARM_RGB] * ("arm_rgb" in observations))


def arm_pictures(cameras: TensorCameras, names: Collection[str]) -> Tensors:
    """Return the named observations of `PICTURED` for the last poses of all worlds, [W, ...] each."""
    by_arm: list[Output] = [OUTPUTS[name] for name in names if name in OUTPUTS]
    seen, shown = cameras.picture(cameras.views[0], by_arm) if by_arm else {}, {}
    if "depth" in seen:
        shown["arm_depth"] = scaled_depth(seen["depth"])[..., None]
    if "semantic" in seen:
        pixels = (seen["semantic"] == HUMAN_ID).sum((-2, -1))
        shown["humanoid_detector"] = (pixels > int(DETECTED_PIXELS * cameras.share)).float()[:, None]
    if "arm_rgb" in names:
        shown["arm_rgb"] = cameras.picture(cameras.views[-1], ("rgb",))["rgb"]
    return shown


def cameras_of(bank: Any, robot: Robot, human: Humanoid, walker: WalkerSpec, **options: Any) -> TensorCameras:
    """Return cameras in the homes of a bank, with the options of `h3data_training.torch.cameras.TensorCameras`.

    Raises:
        InputError: the floors have different heights, or there is no GPU.
    """
    from h3data_training.torch.cameras import TensorCameras

    heights = sorted({floor.floor_y for floor in bank.floors})
    if len(heights) != 1:
        raise InputError(
            f"Pictures on a device need floors at one height, the scenes have {heights} m. Hint: name one scene.",
            code="H3-ENV-012",
        )
    return TensorCameras(bank.scenes, robot, human, walker, floor_y=heights[0], **options)


class TaskTorchEnv(TorchEnv[Play]):
    """W worlds of a task on one device (h3data docs gpu).

    The worlds play the episodes of a bank in order, each from a position that depends on its seed.
    """

    pictured: tuple[str, ...] = PICTURED
    """Observations that need a rendered picture and can be had in these worlds."""

    def __init__(
        self,
        task: Task,
        num_envs: int = 1,
        scenes: Scenes = "h3-homes/train",
        *,
        device: torch.device | str = "cuda",
        dtype: torch.dtype | None = None,
        observations: Sequence[str] = STATE_OBSERVATIONS,
        spec: Any = None,
        end_on_success: bool = False,
        depth_size: tuple[int, int] | None = None,
        light: LightMode = "baked",
        episodes: int | EpisodeBank = EPISODES,
        episodes_seed: int = 0,
        robot: str = "quad_arm",
        human: str = "female_0",
        graph: bool | None = None,
        compile: bool | None = None,
    ) -> None:
        """Sample the episodes, or take a bank of them, and copy it to the device.

        Args:
            task: the task, whose functions are for arrays of any namespace (h3data docs extending).
            num_envs: number of worlds W.
            scenes: as for `sim_kinematic.tasks.sources.EpisodeSource`.
            device: device of all tensors: ``cuda``, ``cuda:1``, ``cpu``.
            dtype: type of the state: by default float64 on the CPU, else float32.
            observations: names of observations.
            spec: rules; by default those of the task's environments.
            end_on_success: whether success ends an episode even if the task would continue.
            depth_size: width and height of pictures [px]; None for the size of the robot's camera.
            light: light in ``arm_rgb``, as in environments without a device: ``baked``, which is computed once for each
                home and cached, or ``flat``.
            episodes: number of episodes in the bank, or a bank.
            episodes_seed: seed of the run from which the first episodes are taken.
            robot: name of a built-in robot.
            human: name of a built-in body.
            graph: whether a step is captured as a CUDA graph; by default on a GPU.
            compile: whether its operations are fused (`h3data_training.torch.graph.fused`), which makes steps ten times faster
                and the first reset half a minute longer; by default on a GPU, if Triton is installed.

        Raises:
            InputError: an argument is not supported on devices, or there is no such device.
        """
        self.task, self.name, known = task, task.name, (*self.pictured, *self._sensors(task))
        if set(observations) - set(known) or not observations or isinstance(observations, str):
            raise InputError(f"On a device there are {', '.join(known)}, got {observations!r}.", code="H3-ENV-008")
        super().__init__(num_envs, device, graph=graph, compile=compile)
        rules = spec or task.usage.env_rules or task.Spec()
        bodies = {"robot": robot, "human": human}
        self._models = robot, human
        self.bank = self._drawn(scenes, episodes, seed=episodes_seed, task=task, spec=rules, **bodies)
        self._names = tuple(dict.fromkeys(observations))
        self.sim = self._make_worlds(
            device=self.device, dtype=dtype, spec=rules, end_on_success=end_on_success, **bodies
        )
        check_light(light)
        self._light: LightMode = light if "arm_rgb" in self._names else "flat"
        pictured = bool(set(PICTURED) & set(observations))
        self._cameras = self._make_cameras(depth_size, compile=self._compiles, **bodies) if pictured else None
        self._action = torch.zeros((self.num_envs, self.sim.action_width), dtype=self.sim.dtype, device=self.device)
        nothing = torch.full((self.num_envs,), -1, dtype=torch.int64, device=self.device)
        self.play = self.sim.before_the_first(nothing)
        self._shown: Tensors = {}

    def _drawn(self, scenes: Scenes, episodes: Any, **options: Any) -> Any:
        """Return ``episodes``, or a bank of as many that are sampled in some scenes."""
        from h3data_training.torch.episodes import EpisodeBank

        return episodes if isinstance(episodes, EpisodeBank) else EpisodeBank.draw(scenes, episodes, **options)

    @staticmethod
    def _sensors(task: Task) -> Mapping[str, Sensor]:
        """Return sensors of the robot that are not pictures, by name."""
        return sensors_of("robot", task.sensors)

    def _make_worlds(self, **options: Any) -> TaskTensors:
        worlds = TaskTensors(self.bank, task=self.task, **options)
        worlds.check_functions([name for name in self._names if name not in PICTURED])
        return worlds

    # --- the interface ------------------------------------------------------------------------------------------------
    def step(self, actions: Tensor) -> tuple[Tensors, Tensor, Tensor, Tensor, Tensors]:
        """Advance all worlds by 1/30 s; worlds whose episode is over start the next one.

        Args:
            actions: forward velocity and left turn [W, 2] in -1..1 of the limits, clipped. Numbers that are not finite
                count as 0, because a check would have to wait for the device.

        Returns:
            Observations, rewards [W], terminated [W], truncated [W], and info.

        Raises:
            InputError: the actions are no tensor, have the wrong shape, or no episode has started.
        """
        self._require_begun()
        given = self._tensor(actions, "robot")
        if given.shape != self._action.shape:
            raise InputError(
                f"Expected actions of shape {list(self._action.shape)}, got {list(given.shape)}.", code="H3-ENV-010"
            )
        with torch.no_grad():
            self._action.copy_(given, non_blocking=True)
            return self._stepped()

    def info(self) -> Tensors:
        """Return data in addition to the observations, [W] each; ``episode`` is a number in the bank."""
        play = self.play
        known = {
            "success": self.sim.succeeded(play),
            "collides": play.collides,
            "robot_contact": play.robot.contact,
            "episode": play.episode,
        }
        return {name: tensor.clone() for name, tensor in known.items()}

    # --- parts --------------------------------------------------------------------------------------------------------
    def _eager(self) -> None:
        """Make one step of all worlds, in place."""
        shown = self._move()
        if self._cameras is not None:
            shown |= self._pictures(self._cameras)
        self._shown = {name: shown[name] for name in self._names}

    def _moved(self) -> Tensors:
        """Return a step but for its pictures."""
        self._keep(self.sim.step(self.play, self._action))
        return self.sim.observations([name for name in self._names if name not in PICTURED], self.play)

    def _make_cameras(self, size: tuple[int, int] | None, *, compile: bool, robot: str, human: str) -> TensorCameras:
        return cameras_of(
            self.bank,
            load_robot(robot),
            load_humanoid(human),
            self.sim.spec.human,
            worlds=self.num_envs,
            views=arm_cameras(self._names),
            size=size,
            light=self._light,
            device=self.device,
            compile=compile,
        )

    def _pictures(self, cameras: TensorCameras) -> Tensors:
        place = self.sim.place_of(self.play) if len(self.bank.scenes) > 1 else None
        cameras.pose(self.play.robot, self.play.human, place=place)
        return arm_pictures(cameras, self._names)

    def _forget_actions(self) -> None:
        self._action.zero_()

    def _result(self) -> Tensors:
        return {name: tensor.clone() for name, tensor in self._shown.items()}

    # --- spaces, where Gymnasium is installed -------------------------------------------------------------------------
    @cached_property
    def single_action_space(self) -> Box:
        """Space of the action of one world."""
        from sim_kinematic.envs.stepper import gymnasium

        return gymnasium.spaces.Box(-1.0, 1.0, (self.sim.action_width,), np.float32)

    @cached_property
    def single_observation_space(self) -> Dict:
        """Space of the observations of one world."""
        from sim_kinematic.envs.stepper import gymnasium
        from sim_kinematic.sensing.observation_set import box

        sensors, joints = self._sensors(self.task), self.sim.arm.shape[1]
        spaces: dict[str, Any] = {
            name: box(sensors[name].limits(joints if sensors[name].times == "joints" else 1))
            for name in self._names
            if name not in PICTURED
        }
        spaces["humanoid_detector"] = gymnasium.spaces.Box(0.0, 1.0, (1,), np.float32)
        if self._cameras is not None:
            size = self._cameras.renderer.height, self._cameras.renderer.width
            spaces["arm_depth"] = gymnasium.spaces.Box(0.0, 1.0, (*size, 1), np.float32)
            spaces["arm_rgb"] = gymnasium.spaces.Box(0, 255, (*size, 3), np.uint8)
        return gymnasium.spaces.Dict({name: spaces[name] for name in self._names})

    def __repr__(self) -> str:
        robot, human = self._models
        what = in_words(
            self.task.name,
            self.bank.scenes,
            len(self.bank.scenes),
            {"robot": robot},
            beside={"human": human},
            worlds=self.num_envs,
        )
        return f"{type(self).__name__}({what}, {len(self.bank)} episodes, {self.device}, {self.sim.dtype})"
