"""The agents of the speed benchmark: each samples random actions, moves by the simulator's own kernels in W worlds, is drawn,
and has a camera on its head. `sim_kinematic.benchmark` puts them together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot
from h3data.bodies.reach import hand_points, reach_poses, reacher
from h3data.errors import InputError
from h3data.geometry import Array, ground_pose, quat_from_heading, quat_rotate
from h3data.render import Camera, Renderer, RenderInstance, pinhole
from h3data.replay.cameras import HEAD_NEAR_M, HEAD_POSE
from h3data.scene import FreeSpace, Mesh
from h3data.scene.records import Shape
from sim_kinematic.collision import capsule_transforms, shapes_from_capsules
from sim_kinematic.manipulation import arm_columns, grip_objects, move_arms, robot_hands
from sim_kinematic.person import HAND_SPEED_MPS
from sim_kinematic.spec import STEP_S, ArmSpec, BaseSpec, WalkerSpec
from sim_kinematic.state import WorldState
from sim_kinematic.step import drive_robots, walk_humans

Action = Literal["nav", "pick"]
HFOV_DEG = 90.0
CAPSULE_SIDES = 12
PLACES_TRIED = 1000


class Drawn(NamedTuple):
    """Meshes and instances that an agent adds to the picture."""

    meshes: list[Mesh]
    instances: list[RenderInstance]
    deformable: list[int]


class RobotAgent:
    """A robot in W worlds. ``nav``: random base velocities; ``pick``: it stands, its arm moves at random, its hand opens and
    closes."""

    camera = "robot_arm"

    def __init__(
        self, robot: Robot, free: FreeSpace, state: WorldState, *, number: int, is_clear: Callable[[Array], bool]
    ) -> None:
        """``state`` has the robot's joints. ``number`` is the agent's, for what it holds. ``is_clear`` says whether it can
        start at a base pose [7]."""
        self.robot, self.free, self.state, self.number, self._is_clear = robot, free, state, number, is_clear
        self.own = state.robots[number]
        self.shapes: list[Shape] = [shape for link in robot.links for shape in link.shapes]
        self._shape_links = [k for k, link in enumerate(robot.links) for _ in link.shapes]
        self._drawn_links = [k for k, link in enumerate(robot.links) if link.mesh is not None]
        self.instances: list[int] = []
        """Its instances in pictures."""
        self._pose()

    def drawn(self, meshes: int, instances: int) -> Drawn:
        """What it adds to a picture that has so many meshes and instances."""
        self.instances = [instances + k for k in range(len(self._drawn_links))]
        own = [self.robot.links[k].mesh for k in self._drawn_links]
        placed = [RenderInstance(meshes + k, np.eye(4), name="robot") for k in range(len(own))]
        return Drawn([mesh for mesh in own if mesh is not None], placed, [])

    def reset(self, rng: np.random.Generator) -> None:
        """At random places where nothing of the home touches it, its arm and its rear neither; the arm at rest."""
        for w in range(len(self.own.heading)):
            self.own.xz[w], self.own.heading[w] = self._clear_place(rng)
        self.own.joints[:] = self.robot.rest
        self._pose()

    def _clear_place(self, rng: np.random.Generator) -> tuple[Array, float]:
        for _ in range(PLACES_TRIED):
            (xz,), heading = self.free.sample(rng, 1), float(rng.uniform(-np.pi, np.pi))
            if self._is_clear(ground_pose(xz, heading, self.free.floor_y)):
                return xz, heading
        raise InputError(f"Found no place for {self.robot.name} in {PLACES_TRIED} tries. Hint: a larger home.")

    def sample(self, rng: np.random.Generator, action: Action) -> Array:
        """Random actions [W, n], -1..1."""
        worlds = len(self.own.heading)
        return rng.uniform(-1, 1, (worlds, 2 if action == "nav" else len(arm_columns(self.robot)) + 1))

    def step(self, action: Action, values: Array) -> None:
        """Move, and take along what is held."""
        if action == "nav":
            drive_robots(self.own, self.free, values, BaseSpec())
        else:
            move_arms(self.own, self.robot, values[:, :-1], ArmSpec())
            hands = robot_hands(self.own, self.robot, self.free.floor_y)
            grip_objects(self.state, hands, values[:, -1], ArmSpec(), agent=self.number)
        self._pose()

    def _pose(self) -> None:
        """The root poses [W, 7], frames of the links [W, L, 4, 4] and of the collision shapes [W, n, 4, 4]."""
        self.base = ground_pose(self.own.xz, self.own.heading, self.free.floor_y)
        self.links = self.robot.link_matrices(self.base, self.own.joints)
        self.shape_frames = self.links[:, self._shape_links]

    def show(self, renderer: Renderer, focal_px: float, eyes: Array) -> None:
        """Put the robots where they are in all worlds."""
        frames = self.links[:, self._drawn_links]
        for w in range(len(frames)):
            renderer.set_transforms(self.instances, frames[w], world=w)

    def cameras(self, size: int) -> list[Camera]:
        """Where it looks, in all worlds: from its arm, square pictures of 90 degrees."""
        camera = pinhole(size, size, hfov_deg=HFOV_DEG, name=self.camera)
        return [camera.at(pose) for pose in self.robot.camera_poses(self.camera, self.links)]


class HumanAgent:
    """A person in W worlds. ``nav``: she walks on shortest paths to random objects, a new one when she is there (oracle
    navigation); ``pick``: she stands and her right hand goes to random objects as far as it reaches."""

    def __init__(
        self, human: Humanoid, free: FreeSpace, state: WorldState, *, number: int, skinned: bool = True
    ) -> None:
        """``skinned``: drawn as a skinned mesh; else as the rigid capsules of her bones."""
        self.human, self.free, self.state, self.number, self.skinned = human, free, state, number, skinned
        self.own = state.people[number - len(state.robots)]
        self.walker = WalkerSpec()
        self._clip = human.clip_for_speed(self.walker.speed_mps)
        worlds = state.worlds
        self._paths: list[NDArray[np.float64]] = [np.zeros((0, 2))] * worlds
        self._hands = np.tile(reacher(human, "right").rest, (worlds, 1))
        standing = human.joint_matrices(ground_pose(np.zeros((1, 2)), np.zeros(1)), *human.clip_pose([0], [0.0]))
        self.capsules = tuple(part if part.ndim == 1 else part[0] for part in human.capsules_world(standing))
        self.instances: list[int] = []
        """Hers in pictures."""
        self._meshes: list[int] = []
        self._pose("nav")

    def drawn(self, meshes: int, instances: int) -> Drawn:
        """What she adds to a picture that has so many meshes and instances."""
        own = [self.human.mesh, self.human.lod_mesh] if self.skinned else _capsule_meshes(*self.capsules)
        self._meshes = [meshes + k for k in range(len(own))]
        self.instances = [instances + k for k in range(len(own))]
        placed = [RenderInstance(mesh, np.eye(4), name="human") for mesh in self._meshes]
        return Drawn(own, placed, self._meshes if self.skinned else [])

    def reset(self, rng: np.random.Generator) -> None:
        """Standing at random places, her hand at her side."""
        own, worlds = self.own, self.state.worlds
        own.xz[:] = self.free.sample(rng, worlds)
        own.heading[:] = rng.uniform(-np.pi, np.pi, worlds)
        for array in (own.distance, own.set_off, own.blend):
            array[:] = 0
        self._paths = [np.zeros((0, 2))] * worlds
        self._hands[:] = reacher(self.human, "right").rest
        self._pose("nav")

    def sample(self, rng: np.random.Generator, action: Action) -> Array:
        """Random objects, and whether the hand closes (above 0) or opens, [W, 2]."""
        worlds, objects = self.state.held_by.shape
        return np.stack([rng.integers(objects, size=worlds), rng.uniform(-1, 1, worlds)], axis=1)

    def step(self, action: Action, values: Array) -> None:
        """Walk, or reach and take."""
        state, chosen = self.state, values[:, 0].astype(int)
        targets = state.object_pose[np.arange(len(chosen)), chosen, :3]
        if action == "nav":
            walk_humans(self.own, self._way_points(targets[:, [0, 2]]), self.walker)
            self._pose(action)
        else:
            away = quat_from_heading(-self.own.heading)
            origin = ground_pose(self.own.xz, self.own.heading, self.free.floor_y)[:, :3]
            way = quat_rotate(away, targets - origin) - self._hands
            most = HAND_SPEED_MPS * STEP_S
            self._hands += way * np.minimum(1.0, most / np.maximum(np.linalg.norm(way, axis=1), 1e-9))[:, None]
            self._pose(action)
            palms = np.tile(np.eye(4), (len(chosen), 1, 1))
            palms[:, :3, 3] = hand_points(self.joints, self.human, "right")
            grip_objects(state, palms, values[:, 1], ArmSpec(), agent=self.number)

    def _way_points(self, goals: Array) -> Array:
        """Next way points [W, 2]; who has arrived sets out for her goal of ``goals`` [W, 2]."""
        here, points = self.own.xz, self.own.xz.copy()
        for w, goal in enumerate(goals):
            path = self._paths[w]
            while len(path) and np.hypot(*(path[0] - here[w])) <= self.walker.arrive_m:
                path = path[1:]
            if not len(path):
                path = self.free.path(here[w], self.free.snap(goal))[1:]
            self._paths[w] = path
            if len(path):
                points[w] = path[0]
        return points

    def _pose(self, action: Action) -> None:
        """The root poses [W, 7], frames of the joints [W, 55, 4, 4], starts and ends [W, C, 3] of the collision capsules."""
        own, human = self.own, self.human
        self.base = ground_pose(own.xz, own.heading, self.free.floor_y)
        if action == "nav":
            walk, stands = human.clips[self._clip], own.blend == 0
            phase = walk.start_phase + (own.distance - own.set_off) / walk.stride_m
            posture = human.clip_pose(np.where(stands, 0, self._clip), phase % 1.0, np.where(stands, 1.0, own.blend))
        else:
            reached = reach_poses(human, self._hands, "right")
            posture = reached.quats, reached.pelvis
        self.joints = human.joint_matrices(self.base, *posture)
        self.capsule_ends = human.capsules_world(self.joints)[:2]

    def show(self, renderer: Renderer, focal_px: float, eyes: Array) -> None:
        """Put her where she is in all worlds, with the light mesh where it will do for every camera.

        ``eyes`` [W, N, 3] are the places of the cameras of each world, ``focal_px`` their focal length.
        """
        if not self.skinned:
            frames = capsule_transforms(*self.capsule_ends)
            for w in range(len(frames)):
                renderer.set_transforms(self.instances, frames[w], world=w)
            return
        apart = np.linalg.norm(self.joints[:, None, :, :3, 3] - eyes[:, :, None], axis=-1).min((1, 2))
        light = np.array([self.human.light_enough(focal_px, float(distance)) for distance in apart])
        for lod in (False, True):
            worlds = np.flatnonzero(light == lod).tolist()
            if not worlds:
                continue
            for w, vertices in zip(worlds, self.human.skin(self.joints[worlds], lod=lod), strict=True):
                renderer.set_visible(self.instances, [not lod, lod], world=w)
                renderer.set_vertices(self._meshes[int(lod)], vertices, world=w)

    def cameras(self, size: int) -> list[Camera]:
        """What she sees in all worlds: from between her eyes, square pictures of 90 degrees."""
        camera = pinhole(size, size, hfov_deg=HFOV_DEG, name="human_head", near=HEAD_NEAR_M)
        head = self.human.joint_names.index("head")
        return [camera.at(pose) for pose in self.joints[:, head] @ HEAD_POSE]


Agent = RobotAgent | HumanAgent


def _capsule_meshes(start: Array, end: Array, radius: Array) -> list[Mesh]:
    import trimesh

    y_to_z = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    meshes = []
    for shape in shapes_from_capsules(start, end, radius):
        length = float(np.linalg.norm(np.subtract(shape.end, shape.start)))
        made: Any = trimesh.creation.capsule(length, shape.radius, count=[CAPSULE_SIDES, CAPSULE_SIDES])
        made.apply_translation(-made.bounds.mean(0))
        made.apply_transform(y_to_z)
        vertices = np.asarray(made.vertices, np.float32)
        colors = np.full((len(vertices), 3), 180, np.uint8)
        meshes.append(Mesh(vertices=vertices, faces=np.asarray(made.faces, np.int32), colors=colors))
    return meshes


def cameras_of(agents: Sequence[Agent], size: int) -> tuple[list[Camera], Array]:
    """The cameras of all agents, worlds within agents [N * W], and their places [W, N, 3]."""
    cameras = [agent.cameras(size) for agent in agents]
    eyes = np.array([[camera.pose[:3, 3] for camera in own] for own in cameras]).swapaxes(0, 1)
    return [camera for own in cameras for camera in own], eyes
