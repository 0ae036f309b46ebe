"""What cameras on the robots see in a `WorldState`: the home, robots, people and objects drawn as the state has them.

`StateRenderer` poses everything once per step; any number of `CameraSensor` then take pictures of all worlds:

```python
drawn = StateRenderer(scene, robot, human, worlds=16)
arm = CameraSensor(camera="robot_arm", outputs=("depth", "semantic"))
drawn.pose(state)
pictures = arm.observe(drawn)  # {"depth": [16, 171, 224], "semantic": ...}
```
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot
from h3data.errors import InputError
from h3data.geometry import Array, ground_pose, pose_to_matrix
from h3data.render import Camera, Output, Renderer, RenderInstance, RenderScene, pinhole
from h3data.render.renderer import Backend
from h3data.scene import Mesh, Scene
from h3data.scene.records import instance_matrix
from sim_kinematic.sensors import HUMAN_ID
from sim_kinematic.state import WorldState

ROBOT_ID = 200
"""Semantic id of robots in our recordings."""


class _Person(NamedTuple):
    """The two meshes of the person; each world shows one."""

    full: int
    light: int
    full_mesh: int
    light_mesh: int


class StateRenderer:
    """A home with a robot, a person and objects, in W worlds that differ in what moves. Holds a renderer: one per thread."""

    def __init__(
        self, scene: Scene, robot: Robot, human: Humanoid | None = None, *, worlds: int = 1, objects: Sequence[str] = (),
        speed_mps: float = 2.5, backend: Backend = "cpu", threads: int = 1,
    ) -> None:  # fmt: skip
        """
        Args:
            scene: The home; all worlds share it.
            robot: Whose cameras see.
            human: Who walks there, None for nobody.
            worlds: W.
            objects: Names of the instances of ``scene`` that the state moves, in the order of ``object_pose`` [O].
            speed_mps: At which the person walks, which chooses her clip.
            backend: Of `h3data.render.Renderer`.
            threads: Threads that draw a batch.
        """
        self.robot, self.human = robot, human
        self._meshes: list[Mesh] = []
        self._instances: list[RenderInstance] = []
        shared = {name: self._mesh(asset.mesh) for name, asset in scene.assets.items() if len(asset.mesh.faces)}
        drawn_as: dict[str, int] = {}
        for i in scene.instances:
            if i.asset in shared:
                drawn_as[i.name] = self._add(
                    shared[i.asset], i.name, instance_matrix(i), semantic_id=i.semantic_id, layer=i.layer
                )
        self._links = [k for k, link in enumerate(robot.links) if link.mesh is not None]
        self._robot = [
            self._add(self._mesh(link.mesh), f"robot/{link.name}", semantic_id=ROBOT_ID)
            for link in robot.links
            if link.mesh is not None
        ]
        unknown = sorted(set(objects) - set(drawn_as))
        if unknown:
            raise InputError(f"The scene draws no instances {', '.join(unknown)}, which the state is to move.")
        scales = {i.name: i.scale for i in scene.instances}
        self._objects = [drawn_as[name] for name in objects]
        self._object_scale = np.array([scales[name] for name in objects], np.float64).reshape(-1, 1, 3)
        self._person = None if human is None else self._add_person(human)
        self._clip = 0 if human is None else human.clip_for_speed(speed_mps)
        deformable = () if self._person is None else (self._person.full_mesh, self._person.light_mesh)
        self.scene = RenderScene(self._meshes, self._instances, deformable=deformable)
        self.renderer = Renderer(self.scene, backend=backend, worlds=worlds, threads=threads)
        self._joint_frames: Array = np.zeros((worlds, 0, 4, 4))
        self._link_frames: Array | None = None
        self._skinned: set[tuple[int, bool]] = set()

    @property
    def worlds(self) -> int:
        return self.renderer.world_count

    @property
    def human_instances(self) -> tuple[int, ...]:
        """Ids of the person in ``instance`` pictures, for `detect_humanoids`."""
        return () if self._person is None else (self._person.full, self._person.light)

    def _mesh(self, mesh: Mesh) -> int:
        self._meshes.append(mesh)
        return len(self._meshes) - 1

    def _add(
        self, mesh: int, name: str, matrix: NDArray[np.floating] | None = None, *, semantic_id: int = 0, layer: str = ""
    ) -> int:
        place = np.eye(4) if matrix is None else np.asarray(matrix, np.float64)
        self._instances.append(RenderInstance(mesh, place, semantic_id=semantic_id, layer=layer, name=name))
        return len(self._instances) - 1

    def _add_person(self, human: Humanoid) -> _Person:
        full, light = self._mesh(human.mesh), self._mesh(human.lod_mesh)
        first, second = (self._add(mesh, "human", semantic_id=HUMAN_ID) for mesh in (full, light))
        return _Person(first, second, full, light)

    # --- posing -----------------------------------------------------------------------------------------------------------
    def pose(self, state: WorldState, *, floor_y: float = 0.0) -> None:
        """Put everything where the state has it. Robots without joints in the state are at rest."""
        if state.object_pose.shape[:2] != (self.worlds, len(self._objects)):
            raise InputError(
                f"Expected a state of {self.worlds} worlds and {len(self._objects)} objects, got "
                f"{state.worlds} and {state.object_pose.shape[1]}."
            )
        joints = state.robots[0].joints
        if not joints.shape[1]:
            joints = np.tile(self.robot.rest, (self.worlds, 1))
        base = ground_pose(state.robots[0].xz, state.robots[0].heading, floor_y)
        self._link_frames = self.robot.link_matrices(base, joints)
        objects = pose_to_matrix(state.object_pose)
        objects[..., :3, :3] *= self._object_scale
        for w in range(self.worlds):
            self.renderer.set_transforms(self._robot, self._link_frames[w, self._links], world=w)
            self.renderer.set_transforms(self._objects, objects[w], world=w)
        if self.human is not None:
            walk, person = self.human.clips[self._clip], state.people[0]
            phase = (walk.start_phase + (person.distance - person.set_off) / walk.stride_m) % 1.0
            posture = self.human.clip_pose(np.full(self.worlds, self._clip), phase, person.blend)
            human = ground_pose(person.xz, person.heading, floor_y)
            self._joint_frames = self.human.joint_matrices(human, *posture)
            self._skinned.clear()

    def cameras(self, name: str) -> list[Camera]:
        """A camera of the robot, by name, in all worlds, as last posed."""
        if self._link_frames is None:
            raise InputError("Nothing has been posed yet. Hint: call pose(state) first.")
        mounted = self.robot.camera(name)
        camera = pinhole(mounted.width, mounted.height, hfov_deg=mounted.hfov_deg, name=name)
        return [camera.at(pose) for pose in self.robot.camera_poses(name, self._link_frames)]

    def picture(self, cameras: Sequence[Camera], outputs: Sequence[Output]) -> dict[str, Any]:
        """What one camera per world sees, by output, each [W, H, W', ...] (`h3data.render.Renderer.render`)."""
        if self._person is not None and self.human is not None:
            for w, camera in enumerate(cameras):
                self._show_person(self.human, self._person, camera, w)
        return self.renderer.render_batch(cameras, worlds=range(self.worlds), outputs=outputs)

    def _show_person(self, human: Humanoid, person: _Person, camera: Camera, world: int) -> None:
        """The light mesh where it will do, as in replays; each is skinned at most once per pose."""
        joints = self._joint_frames[world]
        distance = float(np.linalg.norm(joints[:, :3, 3] - camera.pose[:3, 3], axis=-1).min())
        light = human.light_enough(camera.fx, distance)
        self.renderer.set_visible([person.full, person.light], [not light, light], world=world)
        if (world, light) not in self._skinned:
            self._skinned.add((world, light))
            mesh = person.light_mesh if light else person.full_mesh
            self.renderer.set_vertices(mesh, human.skin(joints[None], lod=light)[0], world=world)


@dataclass(frozen=True, kw_only=True)
class CameraSensor:
    """A named camera of the robot and what it gives: depth and colours of the arm, body cameras, ids for the detector."""

    camera: str = "robot_arm"
    outputs: tuple[Output, ...] = ("depth",)
    depth_range_m: tuple[float, float] | None = None
    """Depth is clipped to this range and scaled to 0..1, as Habitat's; None leaves metres."""
    size: tuple[int, int] | None = None
    """Width and height [pixels] instead of the camera's own; its field of view stays."""

    def __post_init__(self) -> None:
        if self.depth_range_m is not None and not 0 <= self.depth_range_m[0] < self.depth_range_m[1] < float("inf"):
            raise InputError(f"Expected a depth range (near, far) with 0 <= near < far, got {self.depth_range_m}.")

    def observe(self, drawn: StateRenderer) -> dict[str, Any]:
        """Pictures of all worlds as last posed, by output, each [W, H, W', ...]."""
        cameras = drawn.cameras(self.camera)
        if self.size is not None:
            cameras = [_resized(camera, *self.size) for camera in cameras]
        pictures = drawn.picture(cameras, self.outputs)
        if self.depth_range_m is not None and "depth" in pictures:
            near, far = self.depth_range_m
            pictures["depth"] = (pictures["depth"].clip(near, far) - near) / (far - near)  # NumPy, or torch on a GPU
        return pictures


def _resized(camera: Camera, width: int, height: int) -> Camera:
    other = pinhole(width, height, hfov_deg=camera.hfov_deg, name=camera.name)
    return replace(other, pose=camera.pose)
