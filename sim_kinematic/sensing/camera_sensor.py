"""Pictures of a `WorldState` from cameras on robots and people.

A `StateRenderer` poses the home, robots, people and objects once per step. Any number of `CameraSensor` objects then
take pictures of all worlds:

```python
drawn = StateRenderer(scene, [robot, human], worlds=16)
arm = CameraSensor(camera="robot_arm", outputs=("depth", "semantic"))
drawn.pose(state)
pictures = arm.observe(drawn)  # {"depth": [16, 171, 224], "semantic": ...}
```
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot
from h3data.errors import InputError
from h3data.geometry import Array, pose_to_matrix
from h3data.plugins import Registry
from h3data.render import Camera, Light, Output, Renderer, RenderInstance, RenderScene, equirectangular, pinhole
from h3data.render.light.sources import BAKERS, LightMode, sources_of
from h3data.render.raster.hulls import may_see
from h3data.render.renderer import Backend
from h3data.replay.shadow_casters import ShadowCasters, shadow_casters
from h3data.scene import Mesh, Scene, Shape
from h3data.scene.records import Capsule, Instance, instance_matrix
from sim_kinematic.contact.frames import Body, Floor, body_frames, body_shapes, require_bodies, shape_frames
from sim_kinematic.motion.state import WorldState
from sim_kinematic.sensing.lidar import COLUMNS, ELEVATION_DEG, LASERS, SCAN_M
from sim_kinematic.sensing.sensor import scaled_depth

LIDARS: Registry[Any] = Registry("h3data.lidars", {}, what="lidar")
"""Makers of laser scanners for a scene, such as `h3data_rays.LidarScanner`, by name."""


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Meshes and instances of an agent in the pictures."""

    body: Body
    instances: list[int]
    meshes: list[int]
    """Full and light mesh of a person, of which each world shows one; in the style ``bones``, one mesh per capsule."""
    moved: Callable[[Array], Array] | None
    """Function from the agent's `body_frames` to matrices of the instances [W, n, 4, 4]; None for a skinned person."""


class StateRenderer:
    """Renderer of a home with robots, people and objects in W worlds that differ in moving things; one per thread."""

    def __init__(
        self,
        scene: Scene,
        agents: Sequence[Body],
        *,
        worlds: int = 1,
        objects: Sequence[str] = (),
        speed_mps: float | None = None,
        skinned: bool = True,
        light: LightMode = "flat",
        lit_as: Scene | None = None,
        backend: Backend = "cpu",
        threads: int = 1,
    ) -> None:
        """Load the meshes of a home and its agents into a renderer.

        Args:
            scene: home, shared by all worlds.
            agents: bodies of the agents, robots first, as in the state.
            worlds: number of worlds W.
            objects: names of the instances of ``scene`` that the state moves, in the order of ``object_pose`` [O].
            speed_mps: walking speed of people [m/s], which selects their motion clips (default: `WalkerSpec`'s).
            skinned: whether people are skinned meshes; otherwise they are the rigid capsules of their bones.
            light: light in ``rgb``, as for `h3data.replay.Replay`.
            lit_as: scene whose baked light the surfaces carry (default: ``scene``). It has the same instances, with doors and
                drawers elsewhere, so that light is not baked again whenever one moves.
            backend: backend of `h3data.render.Renderer`.
            threads: number of threads that render a batch.
        """
        self._meshes: list[Mesh] = []
        self._instances: list[RenderInstance] = []
        shared = {name: self._mesh(asset.mesh) for name, asset in scene.assets.items() if len(asset.mesh.faces)}
        drawn_as: dict[str, int] = {}
        for i in scene.instances:
            if i.asset in shared:
                drawn_as[i.name] = self._add(
                    shared[i.asset], i.name, instance_matrix(i), semantic_id=i.semantic_id, layer=i.layer
                )
        static = [k for name, k in drawn_as.items() if name not in set(objects)]
        # instances without faces are not drawn, so the state cannot move them in pictures
        unknown = sorted(set(objects) - set(drawn_as))
        if unknown:
            raise InputError(
                f"The scene draws no instances {', '.join(unknown)}, which the state is to move.", code="H3-SIM-040"
            )
        scales = {i.name: i.scale for i in scene.instances}
        self._objects = [drawn_as[name] for name in objects]
        self._object_scale = np.array([scales[name] for name in objects], np.float64).reshape(-1, 1, 3)
        self._skinned, self._speed_mps = skinned, speed_mps
        self._agents = tuple(self._add_agent(body) for body in agents)
        people = [drawn for drawn in self._agents if isinstance(drawn.body, Humanoid)]
        deformable = tuple(mesh for drawn in people for mesh in drawn.meshes) if skinned else ()
        self._light: Light | None = None
        self._casters: ShadowCasters | None = None
        self._mirrors: dict[int, NDArray[np.float32]] = {}
        if light == "baked":
            self._bake(scene, static, lit_as or scene)
        self.scene = RenderScene(self._meshes, self._instances, deformable=deformable, mirrors=self._mirrors)
        self.renderer = Renderer(self.scene, light=self._light, backend=backend, worlds=worlds, threads=threads)
        self._frames: list[Array] = []
        self._shown: set[tuple[int, int, bool]] = set()
        """Agent, world and level of detail (True: low) of the people whose meshes have been skinned for the last
        pose."""
        self._rigid: list[tuple[list[int], Array]] = []
        """Instances [n] of objects and of each robot, with their matrices [W, n, 4, 4] in the last pose."""
        self._lidar: Any = None
        """Scanner of everything that never moves, used by `scans` and built once."""
        self._is_shaded = False
        """True if the shadows are up to date with the last pose."""

    @property
    def worlds(self) -> int:
        """Number of worlds W."""
        return self.renderer.world_count

    @property
    def bodies(self) -> tuple[Body, ...]:
        """Bodies of the agents."""
        return tuple(drawn.body for drawn in self._agents)

    def instances(self, agent: int) -> tuple[int, ...]:
        """Return the ids of an agent in ``instance`` pictures, which `detect_humanoids` takes as a person's."""
        return tuple(self._agents[agent].instances)

    def _bake(self, scene: Scene, static: Sequence[int], lit_as: Scene) -> None:
        """Replace static meshes by ones that carry the light of the scene.

        Their poses are those of recordings, so that the light equals that of replays and is baked once for both.
        """
        # light is baked for the scene as it was lit; surfaces that have moved since carry it along
        as_lit = list(self._instances)
        for instances, other in ((self._instances, scene), (as_lit, lit_as)):
            there = {i.name: recorded_matrix(i) for i in other.instances}
            for k in static:
                instances[k] = replace(instances[k], matrix=there[instances[k].name])
        lit = BAKERS.get("baked")(self._meshes, as_lit, static, sources_of(lit_as), name=scene.name)
        pairs = zip(self._instances, lit.instances, strict=True)
        self._instances = [replace(own, mesh=each.mesh) for own, each in pairs]
        self._meshes, self._light, self._mirrors = lit.meshes, lit.light, lit.mirrors
        if lit.field is not None:
            movers = dict.fromkeys(self._objects, -1)
            movers |= {k: number for number, drawn in enumerate(self._agents) for k in drawn.instances}
            self._casters = shadow_casters(lit.field, self._meshes, self._instances, movers)

    def _mesh(self, mesh: Mesh) -> int:
        self._meshes.append(mesh)
        return len(self._meshes) - 1

    def _add(
        self, mesh: int, name: str, matrix: NDArray[np.floating] | None = None, *, semantic_id: int = 0, layer: str = ""
    ) -> int:
        place = np.eye(4) if matrix is None else np.asarray(matrix, np.float64)
        self._instances.append(RenderInstance(mesh, place, semantic_id=semantic_id, layer=layer, name=name))
        return len(self._instances) - 1

    def _add_agent(self, body: Body) -> _Drawn:
        moved: Callable[[Array], Array] | None = None
        if isinstance(body, Robot):
            parts = [(link.mesh, f"robot/{link.name}") for link in body.links if link.mesh is not None]
            moved = itemgetter((slice(None), [k for k, link in enumerate(body.links) if link.mesh is not None]))
        elif self._skinned:
            parts = [(mesh, "human") for mesh in (body.mesh, body.lod_mesh)]
        else:
            parts, moved = [(mesh, "human") for mesh in capsule_meshes(body_shapes(body))], partial(shape_frames, body)
        meshes = [self._mesh(mesh) for mesh, _ in parts]
        named = zip(meshes, parts, strict=True)
        return _Drawn(body, [self._add(k, name, semantic_id=body.semantic_id) for k, (_, name) in named], meshes, moved)

    # --- posing -----------------------------------------------------------------------------------------------------------
    def pose(self, state: WorldState, *, floor: Floor = 0.0, frames: Sequence[Array] | None = None) -> None:
        """Pose everything as in a state, on a floor map or at a floor height ``floor`` [m].

        ``frames`` are the agents' `body_frames`, if the caller has computed them or poses the agents in another manner.
        """
        if state.object_pose.shape[:2] != (self.worlds, len(self._objects)):
            raise InputError(
                f"Expected a state of {self.worlds} worlds and {len(self._objects)} objects, got "
                f"{state.worlds} and {state.object_pose.shape[1]}.",
                code="H3-SIM-041",
            )
        require_bodies(state, self.bodies)
        if frames is None:
            pairs = zip(self.bodies, state.agents, strict=True)
            frames = [body_frames(body, own, floor, speed_mps=self._speed_mps) for body, own in pairs]
        objects = pose_to_matrix(state.object_pose)
        # scales columns, as it is mesh coordinates that are scaled, before the rotation
        objects[..., :3, :3] *= self._object_scale
        for w in range(self.worlds):
            self.renderer.set_transforms(self._objects, objects[w], world=w)
        self._rigid, self._is_shaded = [(self._objects, objects)], False
        for drawn, own in zip(self._agents, frames, strict=True):
            if drawn.moved is None:
                continue  # later, when pictures are taken: the distance of the cameras decides on the mesh
            rigid = drawn.moved(own)
            for w in range(self.worlds):
                self.renderer.set_transforms(drawn.instances, rigid[w], world=w)
            self._rigid.append((drawn.instances, rigid))
        self._frames = list(frames)
        self._shown.clear()

    def middle(self, agent: int) -> Array:
        """Return the middle of the box around an agent's links or joints in all worlds, as last posed, [W, 3] [m]."""
        places = self._posed(agent)[:, :, :3, 3]
        return (places.min(1) + places.max(1)) / 2

    def _posed(self, agent: int) -> Array:
        """Return frames of an agent as of the last `pose`."""
        if not self._frames:
            raise InputError("Nothing has been posed yet. Hint: call pose(state) first.", code="H3-SIM-042")
        if not 0 <= agent < len(self._agents):
            raise InputError(f"There are {len(self._agents)} agents, counted from 0; got {agent}.", code="H3-SIM-043")
        return self._frames[agent]

    def cameras(self, name: str = "", *, agent: int = 0, size: tuple[int, int] | None = None) -> list[Camera]:
        """Return a camera of an agent in all worlds: a robot's camera by ``name``, or the one between a person's eyes.

        The cameras are at their places in the last pose. ``size`` is a width and height [pixels] instead of the
        camera's own; the field of view does not change.
        """
        frames, body = self._posed(agent), self._agents[agent].body
        own = body.camera(name)
        camera = pinhole(*size or (own.width, own.height), hfov_deg=own.hfov_deg, name=own.name, near=own.near_m)
        return [camera.at(pose) for pose in body.camera_poses(name, frames)]

    def picture(self, cameras: Sequence[Camera], outputs: Sequence[Output]) -> dict[str, Any]:
        """Render N cameras per world and return arrays by the name of the output, each [N * W, H, W', ...].

        The first cameras of all worlds come first (`h3data.render.Renderer.render`).
        """
        if self._skinned:
            for k, drawn in enumerate(self._agents):
                if isinstance(drawn.body, Humanoid):
                    self._show_person(k, drawn, drawn.body, cameras)
        # shadows matter to colours only, and are the same for all pictures of a pose
        if "rgb" in outputs and self._casters is not None and not self._is_shaded:
            self._shade(self._casters)
        worlds = list(range(self.worlds)) * (len(cameras) // self.worlds)
        return self.renderer.render_batch(cameras, worlds=worlds, outputs=outputs)

    def scans(self, agent: int) -> Array:
        """Return the distances that a 3-D laser scanner on top of a robot measures in all worlds, [W, L, C] [m].

        The scanner's `LASERS` are spread over `ELEVATION_DEG`. Column 0 of the `COLUMNS` looks forward, and the others
        follow to the left. The scanner sees every surface except the robot's own; rays that hit nothing within `SCAN_M`
        return `SCAN_M`. The scans show the last pose. They need the extra ``rays``.

        Raises:
            InputError: The agent is not a robot, or nothing has been posed.
            MissingExtraError: Embree is not installed.
        """
        body = self._agents[agent].body if 0 <= agent < len(self._agents) else None
        frames = self._posed(agent)
        if not isinstance(body, Robot):
            raise InputError(f"Laser scanners are on robots, agent {agent} is none.", code="H3-SIM-056")
        above = np.eye(4)
        above[1, 3] = body.body_height_m
        places = frames[:, 0] @ np.linalg.inv(body.to_base) @ above
        # a camera that looks in all directions, so that people anywhere around the robot are posed
        eyes = [equirectangular(64).at(place) for place in places]
        for k, drawn in enumerate(self._agents):
            if isinstance(drawn.body, Humanoid) and self._skinned:
                self._show_person(k, drawn, drawn.body, eyes)
        moving = np.zeros(len(self.scene.instances), np.bool_)
        moving[[*self._objects, *(i for drawn in self._agents for i in drawn.instances)]] = True
        elevations, found = np.linspace(*ELEVATION_DEG, LASERS), []
        for w, place in enumerate(places):
            poses = self.renderer.poses(w)
            # built once from the first world: static instances are at the same places in all of them
            if self._lidar is None:
                self._lidar = LIDARS.get("embree")(self.scene, poses, ~moving)
            # the scanner has everything else already; people are shown by one of their two meshes
            shown = moving & poses.visible
            shown[self._agents[agent].instances] = False
            found.append(
                self._lidar.scan(poses, shown, place, elevations_deg=elevations, columns=COLUMNS, max_m=SCAN_M)
            )
        return np.array(found, np.float64)

    def _shade(self, casters: ShadowCasters) -> None:
        """Set shadows and light of what moves, as last posed."""
        people = [
            (drawn.instances[0], drawn.body.capsules_world(self._frames[k]))
            for k, drawn in enumerate(self._agents)
            if isinstance(drawn.body, Humanoid) and self._skinned
        ]
        for w in range(self.worlds):
            rigid = [(np.asarray(instances, np.intp), matrices[w]) for instances, matrices in self._rigid]
            skins = {k: np.column_stack([start[w], end[w], radius]) for k, (start, end, radius) in people}
            self.renderer.set_blockers(casters.blockers(rigid, skins), world=w)
        self._is_shaded = True

    def _show_person(self, agent: int, drawn: _Drawn, body: Humanoid, cameras: Sequence[Camera]) -> None:
        """Pose a person's mesh for the given cameras.

        As in replays, it is the mesh of low detail where that suffices for all of them. Each mesh is skinned at most
        once per pose, and only if a camera may see it: skinning takes longer than the rest of a step.
        """
        joints = self._frames[agent]
        eyes = np.array([camera.pose[:3, 3] for camera in cameras]).reshape(-1, self.worlds, 3)
        # by the nearest joint and the longest focal length: no picture gets less detail than it shows
        apart = np.linalg.norm(joints[:, :, :3, 3] - eyes[:, :, None], axis=-1).min((0, 2))
        focal = max(camera.fx for camera in cameras)
        light = np.array([body.light_enough(focal, float(distance)) for distance in apart])
        seen = np.zeros(self.worlds, np.bool_)
        for lod in (False, True):
            rows = np.flatnonzero(light == lod)
            bounds = body.bounds[int(lod)]
            for w, own in zip(rows.tolist(), bounds.posed(body.skin_matrices(joints[rows])), strict=True):
                seen[w] = any(may_see(camera, own, bounds.radii, bounds.starts) for camera in cameras[w :: self.worlds])
            for w in rows.tolist():
                self.renderer.set_visible(drawn.instances, [seen[w] and not lod, seen[w] and lod], world=w)
            fresh = [w for w in rows[seen[rows]].tolist() if (agent, w, lod) not in self._shown]
            if fresh:
                for w, vertices in zip(fresh, body.skin(joints[fresh], lod=lod), strict=True):
                    self.renderer.set_vertices(drawn.meshes[int(lod)], vertices, world=w)
                self._shown |= {(agent, w, lod) for w in fresh}


def recorded_matrix(instance: Instance) -> Array:
    """Return the matrix [4, 4] from mesh to world of an instance, with its pose rounded to float32 as in recordings."""
    pose, scale = (np.asarray(a, np.float32).astype(np.float64) for a in (instance.pose, instance.scale))
    return instance_matrix(replace(instance, pose=pose, scale=scale))


def capsule_meshes(shapes: Sequence[Shape]) -> list[Mesh]:
    """Return a grey mesh for each capsule, in the frame in which a `h3data.scene.records.Capsule` stands along y."""
    import trimesh

    # trimesh's capsules stand along z
    y_to_z = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    meshes = []
    sides = 12
    for shape in shapes:
        assert isinstance(shape, Capsule)
        length = float(np.linalg.norm(np.subtract(shape.end, shape.start)))
        made: Any = trimesh.creation.capsule(length, shape.radius, count=[sides, sides])
        made.apply_translation(-made.bounds.mean(0))
        made.apply_transform(y_to_z)
        vertices = np.asarray(made.vertices, np.float32)
        colors = np.full((len(vertices), 3), 180, np.uint8)
        meshes.append(Mesh(vertices=vertices, faces=np.asarray(made.faces, np.int32), colors=colors))
    return meshes


@dataclass(frozen=True, kw_only=True)
class CameraSensor:
    """Named camera of an agent with its outputs, such as depth, colours or ids."""

    camera: str = "robot_arm"
    """Name of the robot's camera; a person has only one camera."""
    agent: int = 0
    """Number of the agent that has the camera."""
    outputs: tuple[Output, ...] = ("depth",)
    depth_range_m: tuple[float, float] | None = None
    """Range to which depth is clipped before it is scaled to 0..1, as in Habitat [m]; None: depth stays in metres."""
    size: tuple[int, int] | None = None
    """Width and height [pixels] instead of the camera's own; the field of view does not change."""

    def __post_init__(self) -> None:
        if self.depth_range_m is not None and not 0 <= self.depth_range_m[0] < self.depth_range_m[1] < float("inf"):
            raise InputError(
                f"Expected a depth range (near, far) with 0 <= near < far, got {self.depth_range_m}.", code="H3-SIM-044"
            )

    def observe(self, drawn: StateRenderer) -> dict[str, Any]:
        """Return the pictures of all worlds in the last pose by the name of the output, each [W, H, W', ...]."""
        cameras = drawn.cameras(self.camera, agent=self.agent, size=self.size)
        pictures = drawn.picture(cameras, self.outputs)
        if self.depth_range_m is not None and "depth" in pictures:
            pictures["depth"] = scaled_depth(pictures["depth"], self.depth_range_m)
        return pictures
