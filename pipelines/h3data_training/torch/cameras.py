"""Pictures of W robots and people on the GPU, computed from states by frames of links and joints and by skinning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from h3data.bodies import Humanoid, Robot
from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE
from h3data.progress import progress
from h3data.render import Light, Output, RenderInstance, RenderScene, pinhole
from h3data.render.light.sources import BAKERS, LightMode, check_light, sources_of
from h3data.render.sheets.scene_map import render_scene
from h3data.scene import Mesh, Scene
from h3data_training.torch.cycle import WalkingCycle
from h3data_training.torch.graph import fused
from h3data_training.torch.state import HumanTensors, RobotTensors
from sim_kinematic.motion.spec import WalkerSpec
from sim_kinematic.sensing.camera_sensor import recorded_matrix

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from h3data_gpu import GpuRenderer, GpuScene
    from h3data_light.bake import LitScene

HUMAN = "human"
"""Name of the view between a person's eyes; other views have the names of the robot's cameras."""
NEAREST_M = 0.9
"""Distance from a camera below which people seldom are [m], because a robot that follows them keeps a larger distance.
It selects the one mesh that is used in all worlds.
"""


class TensorCameras:
    """Homes with a resting robot and a walking person, in W worlds with different homes and agent positions."""

    def __init__(
        self,
        scenes: Scene | Sequence[Scene],
        robot: Robot,
        human: Humanoid,
        walker: WalkerSpec,
        *,
        worlds: int,
        floor_y: float = 0.0,
        views: Sequence[str] = ("robot_arm",),
        size: tuple[int, int] | None = None,
        hfov_deg: float | None = None,
        light: LightMode = "flat",
        device: torch.device | str = "cuda",
        compile: bool = False,
        renderer: Callable[..., GpuRenderer] | None = None,
    ) -> None:
        """Copy the meshes of homes and agents to the GPU.

        Args:
            scenes: home that all worlds share, or homes from which `observe` selects.
            robot: body of the robot, which keeps its resting posture.
            human: body of the person, rendered with the full mesh or, for pictures so small that there is no visible
                difference at distances above `NEAREST_M`, with the mesh of low detail.
            walker: gait of the person, which selects the motion clips.
            worlds: number of worlds W.
            floor_y: height of the floor [m].
            views: cameras in every world: those of the robot (``robot_arm_rgb`` is ``robot_arm`` if it has no other), and
                `HUMAN`.
            size: width and height of all pictures [px]; None for the size of the robot's first camera.
            hfov_deg: horizontal field of view of the robot's cameras, instead of their own.
            light: light in colours: that of each home, which is baked for a home that is lit for the first time, or ``flat``.
            device: the GPU.
            compile: whether one kernel computes the frames of links and joints (`h3data_training.torch.graph.fused`).
            renderer: function that creates the renderer; by default `GpuRenderer`.

        Raises:
            InputError: there is no GPU or no such camera, or no light reaches one of the homes.
        """
        if not views:
            raise InputError("Expected at least one view.", code="H3-TRAIN-058")
        self.worlds, self.views, self._floor_y = worlds, tuple(views), floor_y
        names = [camera.name for camera in robot.cameras]
        mounted = {
            view: robot.camera(view if view in names else view.removesuffix("_rgb"))
            for view in self.views
            if view != HUMAN
        }
        first = next(iter(mounted.values()), robot.cameras[0])
        width, height = size or (first.width, first.height)
        self.share = width * height / (first.width * first.height)
        """Pixels of a picture over those of the first camera itself."""
        homes = [scenes] if isinstance(scenes, Scene) else list(scenes)
        self._lenses = {
            view: pinhole(width, height, hfov_deg=hfov_deg or camera.hfov_deg, name=view)
            for view, camera in mounted.items()
        }
        if HUMAN in self.views:
            own = human.camera(HUMAN)
            self._lenses[HUMAN] = pinhole(width, height, hfov_deg=own.hfov_deg, name=own.name, near=own.near_m)
        focal = max(lens.fx for lens in self._lenses.values())
        low = human.light_enough(focal, NEAREST_M)
        stages, lamps = zip(*_stages(homes, robot, human, low_detail=low, light=light), strict=True)
        links = [k for k, link in enumerate(robot.links) if link.mesh is not None]
        if renderer is None:
            from h3data_gpu import GpuRenderer as renderer
        self.renderer = renderer(
            stages, width=width, height=height, worlds=worlds, light=light_of_all(homes, lamps), device=device
        )
        self._eyes: dict[str, Tensor] = {}
        """Poses of the cameras as last posed, [W, 3, 4] each."""

        def on_device(matrices: Any) -> Tensor:
            rows = np.asarray(matrices, np.float64)[..., :3, :]
            return torch.as_tensor(rows, dtype=torch.float32, device=self.renderer.device)

        rest = robot.link_matrices(IDENTITY_POSE[None], np.asarray(robot.rest, np.float64)[None])[0]
        eyes = [rest[camera.link] @ camera.pose for camera in mounted.values()]
        self._robot, self._links = on_device([*(rest[n] for n in links), *eyes]), len(links)
        self._cycle = WalkingCycle.of(human, walker)
        joints = human.skin_frames(self._cycle.joint_matrices())
        head = human.camera_poses(HUMAN, joints)
        self._person = on_device(np.concatenate([joints, head[:, None]], 1))
        self._frames = fused(self._frames_of) if compile else self._frames_of
        self._cast: Callable[..., tuple[Tensor, Tensor]] | None = None
        if all(lit is not None and lit.baked for lit in lamps):
            from h3data_training.torch.light import AgentLight

            agents = AgentLight(lamps, robot, human, device=self.renderer.device)
            self._cast = fused(agents.cast) if compile else agents.cast

    def observe(
        self,
        robot: RobotTensors,
        human: HumanTensors,
        outputs: Sequence[Output] = ("depth",),
        *,
        place: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Set poses, and return pictures of all views, each [views, W, H, W', ...], by output."""
        self.pose(robot, human, place=place)
        return self._taken(self.views, outputs)

    def pose(self, robot: RobotTensors, human: HumanTensors, *, place: Tensor | None = None) -> None:
        """Set the current poses of the robot and the person in all worlds.

        ``place`` is the number of the home that each world is in, [W]; None leaves it unchanged.
        """
        if place is not None:  # the kernels read it from the device in every launch, a replayed graph's included
            self.renderer._held["scene_of_world"].copy_(place)
        parts, joints = self._frames(robot, human)
        self.renderer.update_poses(parts[:, : self._links])
        self.renderer.update_joints(joints[:, :-1])
        if self._cast is not None:
            homes = self.renderer._held["scene_of_world"].long()
            self.renderer.update_shadows(*self._cast(parts[:, : self._links], joints[:, :-1], homes))
        robots = [view for view in self.views if view != HUMAN]
        self._eyes = {view: parts[:, self._links + k] for k, view in enumerate(robots)} | {HUMAN: joints[:, -1]}

    def picture(self, view: str, outputs: Sequence[Output]) -> dict[str, Tensor]:
        """Render a view in all worlds with the last poses, as images [W, H, W', ...] on the device by output.

        Depths are in metres.
        """
        return {name: t[0] for name, t in self._taken((view,), outputs).items()}

    def _taken(self, views: Sequence[str], outputs: Sequence[Output]) -> dict[str, Tensor]:
        pictures = self.renderer.render(
            [self._lenses[view] for view in views for _ in range(self.worlds)],
            worlds=list(range(self.worlds)) * len(views),
            outputs=outputs,
            poses=torch.cat([self._eyes[view] for view in views]),
        )
        return {name: t.unflatten(0, (len(views), self.worlds)) for name, t in pictures.items()}

    def _frames_of(self, robot: RobotTensors, human: HumanTensors) -> tuple[Tensor, Tensor]:
        """Return world matrices of the robot's links and cameras [W, N + C, 3, 4], and of the person's joints and eyes.

        Those of the person have the shape [W, 56, 3, 4].
        """
        parts = in_world(self._robot, robot.xz.float(), robot.heading.float(), self._floor_y)
        posture = self._cycle.look_up(self._person, HumanTensors(*(t.float() for t in human)))
        return parts, in_world(posture, human.xz.float(), human.heading.float(), self._floor_y)


def _stages(
    homes: Sequence[Scene], robot: Robot, human: Humanoid, *, low_detail: bool, light: LightMode
) -> Iterator[tuple[GpuScene, LitScene | None]]:
    """Yield homes with one robot and one person in them, and their baked light. Robot and person have the same slots in all."""
    from h3data_gpu import GpuScene

    check_light(light)
    skin, worn = (human.lod, human.lod_mesh) if low_detail else (human.full, human.mesh)
    for scene in progress(homes, desc="rendered homes", unit="home", delay=1.0, leave=False):
        meshes, instances, links = with_robot(scene, robot)
        person, lit = len(meshes), None
        meshes.append(worn)
        instances.append(RenderInstance(person, np.eye(4), semantic_id=Humanoid.semantic_id, name="human"))
        if light == "baked":
            lit = lit_home(scene, meshes, instances, range(links.start))
            meshes, instances = lit.meshes, lit.instances
        drawn = RenderScene(meshes, instances, deformable=[person], mirrors=lit.mirrors if lit else None)
        yield GpuScene(drawn, moving=links, skins={person: (skin.influences, human.skin_bind)}), lit


def lit_home(
    scene: Scene, meshes: Sequence[Mesh], instances: Sequence[RenderInstance], static: Sequence[int]
) -> LitScene:
    """Return a home in its baked light, which is the same as on the CPU and in the same cache."""
    there = {i.name: recorded_matrix(i) for i in scene.instances}
    placed = list(instances)
    for k in static:
        placed[k] = replace(placed[k], matrix=there[placed[k].name])
    return BAKERS.get("baked")(meshes, placed, static, sources_of(scene), name=scene.name)


def light_of_all(homes: Sequence[Scene], lamps: Sequence[LitScene | None]) -> Light | None:
    """Return the light of a renderer of several homes.

    Raises:
        InputError: some homes have baked light, and others do not.
    """
    dark = [home.name for home, lit in zip(homes, lamps, strict=True) if lit is not None and not lit.baked]
    if dark and len(dark) < len(homes):
        raise InputError(
            f"No light reaches {', '.join(dark[:5])}, but other homes are lit. Hint: light='flat', or leave it out.",
            code="H3-ENV-057",
        )
    return lamps[0].light if lamps[0] is not None else None


def with_robot(scene: Scene, robot: Robot) -> tuple[list[Mesh], list[RenderInstance], range]:
    """Return the meshes and instances of a home with a robot in it, and the instance numbers of the robot's links."""
    home = render_scene(scene)
    links = [link for link in robot.links if link.mesh is not None]
    first, ids = len(home.instances), {i.name: i.semantic_id for i in scene.instances}
    instances = [replace(i, semantic_id=ids[i.name]) for i in home.instances]
    instances += [
        RenderInstance(len(home.meshes) + k, np.eye(4), semantic_id=Robot.semantic_id, name=link.name)
        for k, link in enumerate(links)
    ]
    meshes = [*home.meshes, *(link.mesh for link in links if link.mesh is not None)]
    return meshes, instances, range(first, first + len(links))


def in_world(frames: Tensor, xz: Tensor, heading: Tensor, floor_y: float | Tensor) -> Tensor:
    """Return the world matrices [W, N, 3, 4] of frames that are given in agent root frames.

    Frames are [N, 3, 4] or [W, N, 3, 4], agents at [W, 2] with headings [W], and floors of one height or of one for
    each world [W]. No matrix product is used, because a GPU might compute it with a precision of 10 bits.
    """
    c, s = heading.cos()[:, None, None], heading.sin()[:, None, None]
    x, y, z = frames.unbind(-2)
    rows = torch.stack([c * x + s * z, y.expand(len(heading), -1, -1), c * z - s * x], -2)
    place = torch.stack([xz[:, 0], torch.zeros_like(heading) + floor_y, xz[:, 1]], -1)
    return rows + torch.nn.functional.pad(place[:, None, :, None], (3, 0))
