"""Pictures of the robots in W worlds of a skill on the GPU, computed from states by frames of links and objects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from h3data.bodies import Robot
from h3data.geometry import Array
from h3data.render import Output, RenderScene, pinhole
from h3data.scene import Scene, instance_matrix
from h3data_training.torch.cameras import in_world, with_robot
from h3data_training.torch.graph import fused
from h3data_training.torch.skills.arm import turned
from h3data_training.torch.skills.bank import SkillBank
from h3data_training.torch.skills.worlds import SkillPlay, SkillTensors

if TYPE_CHECKING:
    from h3data_gpu import GpuRenderer, GpuScene


class SkillCameras:
    """Camera of the robot in each of W worlds, which differ in home, robot and arm poses, and object positions."""

    def __init__(
        self,
        sim: SkillTensors,
        *,
        worlds: int,
        camera: str = "robot_arm",
        size: tuple[int, int] | None = None,
        compile: bool = False,
        renderer: Callable[..., GpuRenderer] | None = None,
    ) -> None:
        """Copy the meshes of homes, robot and objects to the GPU.

        Args:
            sim: the worlds; pictures are rendered on its device.
            worlds: number of worlds W.
            camera: camera of the robot, which moves with its link.
            size: width and height of pictures [px] instead of the camera's own; its field of view does not change.
            compile: whether one kernel computes the frames of links and objects (`h3data_training.torch.graph.fused`).
            renderer: function that creates the renderer; by default `GpuRenderer`.

        Raises:
            InputError: there is no GPU, or no such camera.
        """
        bank, robot = sim.bank, sim.arm.robot
        mounted = robot.camera(camera)
        width, height = size or (mounted.width, mounted.height)
        moving = moved_bodies(bank)
        stages = [_stage(home, robot, bodies) for home, bodies in zip(bank.scenes, moving, strict=True)]
        if renderer is None:
            from h3data_gpu import GpuRenderer as renderer
        self.renderer = renderer(stages, width=width, height=height, worlds=worlds, device=sim.device)
        self._camera = pinhole(width, height, hfov_deg=mounted.hfov_deg, name=camera)
        self._arm = sim.arm
        self._links = [k for k, link in enumerate(robot.links) if link.mesh is not None] + [mounted.link]

        def on_device(array: NDArray[Any]) -> Tensor:
            tensor = torch.as_tensor(array, device=sim.device)
            return tensor.float() if tensor.is_floating_point() else tensor

        self._mounted = on_device(mounted.pose[:3])
        self._place, self._floor_y = on_device(bank.place), on_device(np.array([f.floor_y for f in bank.floors]))
        resting, scales = _resting(bank, moving)
        self._resting, self._scales = on_device(resting), on_device(scales)
        slots = [np.searchsorted(moving[place], bodies) for place, bodies in zip(bank.place, bank.bodies, strict=True)]
        self._slots = on_device(np.array(slots, np.int64))
        self._frames = fused(self._frames_of) if compile else self._frames_of

    def observe(self, play: SkillPlay, outputs: Sequence[Output] = ("depth",)) -> dict[str, Tensor]:
        """Render all worlds as images [W, H, W', ...] on the device by output; depth is in metres."""
        # the kernels read it from the device in every launch, a replayed graph's included
        self.renderer._held["scene_of_world"].copy_(self._place[play.episode])
        parts, objects = self._frames(play)
        self.renderer.update_poses(torch.cat([parts[:, :-1], objects], 1))
        return self.renderer.render(self._camera, outputs=outputs, poses=parts[:, -1])

    def _frames_of(self, play: SkillPlay) -> tuple[Tensor, Tensor]:
        """Return world matrices of the robot's links and camera [W, N + 1, 3, 4], and of moved things [W, M, 3, 4]."""
        place = self._place[play.episode]
        frames = self._arm.frames(play.joints, self._links).float()
        camera = frames[:, -1]
        eye = torch.cat(
            [
                turned(camera[..., :3], self._mounted[:, :3]),
                (camera[..., :3] * self._mounted[:, 3]).sum(-1, keepdim=True) + camera[..., 3:],
            ],
            -1,
        )
        parts = torch.cat([frames[:, :-1], eye[:, None]], 1)
        parts = in_world(parts, play.robot.xz.float(), play.robot.heading.float(), self._floor_y[place])
        slots = self._slots[play.episode]
        scale = self._scales[place].gather(1, slots[..., None].expand(-1, -1, 3))
        now = torch.cat([play.turned.float() * scale[..., None, :], play.objects.float()[..., None]], -1)
        return parts, self._resting[place].scatter(1, slots[..., None, None].expand(-1, -1, 3, 4), now)


def moved_bodies(bank: SkillBank) -> list[NDArray[np.int64]]:
    """Return the numbers of the instances of each home that are objects in at least one episode, ascending."""
    return [np.unique(bank.bodies[bank.place == k]) for k in range(len(bank.scenes))]


def _stage(scene: Scene, robot: Robot, bodies: NDArray[np.int64]) -> GpuScene:
    """Return a home with a robot and movable objects.

    The links have the same slots in all homes, the objects come after them.
    """
    from h3data_gpu import GpuScene

    meshes, instances, links = with_robot(scene, robot)
    number = {instance.name: k for k, instance in enumerate(instances[: links.start])}
    objects = [number[scene.instances[body].name] for body in bodies]
    return GpuScene(RenderScene(meshes, instances), moving=[*links, *objects])


def _resting(bank: SkillBank, moving: Sequence[NDArray[np.int64]]) -> tuple[Array, Array]:
    """Return matrices [homes, M, 3, 4] and scales [homes, M, 3] of the movable objects of the homes, at their original places.

    Homes with fewer than M objects have zeros.
    """
    most = max(map(len, moving))
    matrices, scales = np.zeros((len(moving), most, 3, 4)), np.zeros((len(moving), most, 3))
    for k, (scene, bodies) in enumerate(zip(bank.scenes, moving, strict=True)):
        for slot, body in enumerate(bodies):
            instance = scene.instances[body]
            matrices[k, slot], scales[k, slot] = instance_matrix(instance)[:3], instance.scale
    return matrices, scales
