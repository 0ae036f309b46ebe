"""A recording brought back: everything that was there, posed at any step, ready to be drawn from any camera."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid, Robot, load_humanoid, load_robot
from h3data.bodies.trot import legs_are_posed, trot
from h3data.errors import FormatError, InputError
from h3data.geometry import Array, pose_to_matrix
from h3data.interop import AssetLibrary
from h3data.recording import Agent, AssetRef, Body, Recording
from h3data.render.camera import Camera
from h3data.scene import Mesh, Scene, load_scene

if TYPE_CHECKING:
    from h3data.render import Output, Renderer, RenderScene


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawable:
    """One thing that can be drawn. Its position in `Replay.drawables` is its instance id in pictures."""

    name: str
    mesh: Mesh
    matrix: Array
    """4x4 mesh frame to world, scale included; of a moving thing, at its first step."""
    layer: str = ""
    semantic_id: int = 0
    agent: int = -1
    """Index of the agent that it belongs to; -1 = none."""
    moving: bool = False
    deformable: bool = False
    """Its vertices change and are given in the world frame (skinned bodies)."""
    placeholder: bool = False
    """A stand-in: the recorded asset was not found."""


@dataclass(frozen=True)
class _BodyTrack:
    """A rigid body with a recorded track."""

    column: int
    scale: NDArray[np.float32]


@dataclass(frozen=True)
class _LinkTrack:
    """A link of a robot that is drawn by its model."""

    agent: int
    link: int


@dataclass(frozen=True)
class _SkinTrack:
    """A humanoid that is drawn by its model."""

    agent: int


@dataclass(frozen=True, eq=False)
class State:
    """Where everything was at one step."""

    step: int
    time_s: float
    poses: dict[str, NDArray[np.float64]] = field(repr=False)
    """4x4 in the world by name, scale included; things that were not in the world then are left out."""
    agents: dict[str, dict[str, Any]]
    """Per agent: every recorded column of it at this step."""


class Replay:
    """Poses and pictures of a recording.

    ``assets`` finds the files that a foreign recording names; what is missing is drawn as a marked placeholder and listed
    in `missing`. ``detail`` chooses the full body meshes instead of the reduced ones. ``stepping`` lets legs trot that the
    recording only holds in their resting posture (`h3data.bodies.trot`); nothing but their looks depends on it.
    """

    def __init__(self, recording: Recording, *, assets: AssetLibrary | Sequence[str | Path] | None = None,
                 detail: bool = True, stepping: bool = True) -> None:  # fmt: skip
        self.recording = recording
        self.detail = detail
        self.stepping = stepping
        self.library = assets if isinstance(assets, AssetLibrary) else AssetLibrary([Path(p) for p in assets or ()])
        self.scene: Scene | None = None
        if "scene.glb" in recording.attachments:
            self.scene = load_scene(recording.attachments["scene.glb"])
            self.library = self.library.with_scene(self.scene)
        self._tracks: list[_BodyTrack | _LinkTrack | _SkinTrack | None] = []
        self._mesh_slots: dict[str, int] = {}
        self._meshes: list[Mesh] = []
        self._slot_of: list[int] = []
        self._drawables: list[Drawable] = []
        self.missing: dict[str, int] = {}
        """Asset files that were not found, and how many bodies wanted each."""
        refs = {ref.name: ref for ref in recording.assets}
        for body in recording.bodies:
            self._add_body(body, refs[body.asset])
        for index, agent in enumerate(recording.agents):
            if agent.model:
                self._add_agent(index, agent)

    # --- what there is ------------------------------------------------------------------------------------------------
    @property
    def drawables(self) -> Sequence[Drawable]:
        """Everything that can be drawn; the index is the instance id in pictures."""
        return self._drawables

    def __len__(self) -> int:
        return len(self.recording)

    def _slot(self, key: str, mesh: Mesh) -> int:
        if key not in self._mesh_slots:
            self._mesh_slots[key] = len(self._meshes)
            self._meshes.append(mesh)
        return self._mesh_slots[key]

    def _add(self, drawable: Drawable, key: str, track: _BodyTrack | _LinkTrack | _SkinTrack | None) -> None:
        self._drawables.append(drawable)
        self._slot_of.append(self._slot(key, drawable.mesh))
        self._tracks.append(track)

    def _add_body(self, body: Body, ref: AssetRef) -> None:
        mesh = self.library.mesh(ref)
        key, missing = f"asset:{ref.name}", mesh is None
        if mesh is None:
            mesh, key = self.library.placeholder(ref, body), f"placeholder:{ref.name}"
            self.missing[ref.uri] = self.missing.get(ref.uri, 0) + 1
        matrix = pose_to_matrix(np.nan_to_num(body.pose.astype(np.float64)))
        matrix[:3, :3] *= body.scale
        self._add(
            Drawable(
                name=body.name, mesh=mesh, matrix=matrix, layer=body.layer, semantic_id=body.semantic_id,
                agent=body.agent, moving=body.moving >= 0, placeholder=missing,
            ),
            key,
            _BodyTrack(body.moving, body.scale) if body.moving >= 0 else None,
        )  # fmt: skip

    def _add_agent(self, index: int, agent: Agent) -> None:
        model = self.model(index)
        self._require_motion(index, model)
        if isinstance(model, Robot):
            for number, link in enumerate(model.links):
                if link.mesh is not None:
                    matrix = self.link_matrices(index)[0, number] if len(self) else np.eye(4)
                    self._add(
                        Drawable(
                            name=f"{agent.name}/{link.name}", mesh=link.mesh, matrix=matrix.astype(np.float64),
                            semantic_id=agent.semantic_id, agent=index, moving=True,
                        ),
                        f"{agent.model}/{link.name}",
                        _LinkTrack(index, number),
                    )  # fmt: skip
        else:
            mesh = model.mesh if self.detail else model.lod_mesh
            self._add(
                Drawable(
                    name=agent.name, mesh=mesh, matrix=np.eye(4), semantic_id=agent.semantic_id, agent=index, moving=True,
                    deformable=True,
                ),
                f"{agent.model}/{agent.name}",  # never shared: each body has vertices of its own
                _SkinTrack(index),
            )  # fmt: skip

    def _require_motion(self, index: int, model: Robot | Humanoid) -> None:
        """Refuse a recording that names a model and lacks the columns that move it."""
        columns, prefix = self.recording.columns, f"agent_{index}."
        needed = ("motion_id", "motion_phase", "motion_blend")
        if isinstance(model, Robot):
            needed = ("joint_pos",)
        elif prefix + "joint_quat" in columns:
            needed = ("root_pose",)
        missing = [prefix + name for name in needed if prefix + name not in columns]
        if missing:
            agent = self.recording.agents[index]
            raise FormatError(
                f"Agent {agent.name!r} is drawn by {agent.model!r}, but the recording lacks the columns "
                f"{', '.join(missing)}. Hint: with an empty model its bodies are drawn."
            )

    def model(self, agent: int) -> Robot | Humanoid:
        """The built-in model that draws an agent."""
        kind, _, name = self.recording.agents[agent].model.partition("/")
        if kind == "robot":
            return load_robot(name)
        if kind == "humanoid":
            return load_humanoid(name)
        raise FormatError(
            f"Agent {self.recording.agents[agent].name!r} has the model {self.recording.agents[agent].model!r}. "
            "Expected robot/<name> or humanoid/<name>."
        )

    # --- poses --------------------------------------------------------------------------------------------------------
    def link_matrices(self, agent: int) -> NDArray[np.float32]:
        """World matrices of the links of a robot that is drawn by its model, at all steps, shape [T, L, 4, 4]."""
        if agent not in self._links:
            robot = self.model(agent)
            if not isinstance(robot, Robot):
                raise InputError(f"Agent {self.recording.agents[agent].name!r} is not a robot with links.")
            base = self.recording.agent_column(agent, "base_pose")
            joints = self.recording.agent_column(agent, "joint_pos")
            if self.stepping and legs_are_posed(robot, joints):
                joints = trot(robot, base, joints)
            self._links[agent] = robot.link_matrices(base, joints).astype(np.float32)
        return self._links[agent]

    @cached_property
    def _links(self) -> dict[int, NDArray[np.float32]]:
        return {}

    def matrices(self, index: int, steps: NDArray[np.integer] | None = None) -> NDArray[np.float32]:
        """4x4 of a moving drawable at ``steps`` (all by default), shape [T, 4, 4]; NaN where it was not in the world."""
        rows = np.arange(len(self)) if steps is None else np.asarray(steps)
        track = self._tracks[index]
        if isinstance(track, _BodyTrack):
            out = pose_to_matrix(self.recording.columns["object_pose"][rows, track.column])
            out[:, :3, :3] *= track.scale
            out[np.isnan(out[:, 0, 0])] = np.nan
            return out
        if isinstance(track, _LinkTrack):
            return self.link_matrices(track.agent)[rows, track.link]
        return np.broadcast_to(self._drawables[index].matrix.astype(np.float32), (len(rows), 4, 4))

    def joint_matrices(self, agent: int, steps: NDArray[np.integer]) -> NDArray[np.floating]:
        """World matrices of a humanoid's 55 joints at ``steps``, shape [T, 55, 4, 4]."""
        body = self.model(agent)
        if not isinstance(body, Humanoid):
            raise InputError(f"Agent {self.recording.agents[agent].name!r} is not a humanoid with a skeleton.")
        prefix, columns = f"agent_{agent}.", self.recording.columns
        if prefix + "joint_quat" in columns:
            return body.joint_matrices_free(columns[prefix + "root_pose"][steps], columns[prefix + "joint_quat"][steps])
        quats, pelvis = body.clip_pose(
            columns[prefix + "motion_id"][steps],
            columns[prefix + "motion_phase"][steps],
            columns[prefix + "motion_blend"][steps],
        )
        return body.joint_matrices(columns[prefix + "base_pose"][steps], quats, pelvis)

    def vertices(self, index: int, steps: NDArray[np.integer]) -> NDArray[np.float32]:
        """World vertices of a deformable drawable at ``steps``, shape [T, V, 3] [m]."""
        track = self._tracks[index]
        if not isinstance(track, _SkinTrack):
            raise InputError(f"{self._drawables[index].name!r} is rigid; ask for its matrices.")
        body = self.model(track.agent)
        assert isinstance(body, Humanoid)
        return body.skin(self.joint_matrices(track.agent, np.asarray(steps)), lod=not self.detail)

    def row(self, step: int) -> int:
        """The row of ``step`` in the recording's columns; negative steps count from the end."""
        if not -len(self) <= step < len(self):
            raise self._no_step(step)
        return step % len(self)

    def _no_step(self, step: int) -> InputError:
        return InputError(f"There is no step {step}: the recording has {len(self)} steps, 0 to {len(self) - 1}.")

    def at(self, step: int) -> State:
        """Where everything was after action ``step``; negative steps count from the end."""
        step = self.row(step)
        poses = {}
        for index, drawable in enumerate(self._drawables):
            if drawable.deformable:
                continue
            matrix = self.matrices(index, np.array([step]))[0] if drawable.moving else drawable.matrix
            if np.isfinite(matrix[0, 0]):
                poses[drawable.name] = np.asarray(matrix, np.float64)
        columns = self.recording.columns
        agents = {
            agent.name: {
                name.partition(".")[2]: columns[name][step] for name in columns if name.startswith(f"agent_{i}.")
            }
            for i, agent in enumerate(self.recording.agents)
        }
        return State(step, float(columns["time_ns"][step]) * 1e-9, poses, agents)

    # --- pictures -----------------------------------------------------------------------------------------------------
    @cached_property
    def render_scene(self) -> RenderScene:
        """The immutable half of the renderer, shared by all threads."""
        from h3data.render import RenderInstance, RenderScene

        instances = [
            RenderInstance(
                mesh=slot, matrix=d.matrix.astype(np.float64), semantic_id=d.semantic_id, layer=d.layer, name=d.name
            )
            for slot, d in zip(self._slot_of, self._drawables, strict=True)
        ]
        deformable = tuple(s for s, d in zip(self._slot_of, self._drawables, strict=True) if d.deformable)
        return RenderScene(self._meshes, instances, deformable=deformable)

    def renderer(self) -> Renderer:
        """A renderer for one thread, posed by `pose`."""
        from h3data.render import Renderer

        return Renderer(self.render_scene)

    def pose(self, renderer: Renderer, step: int) -> None:
        """Put everything that moves where it was at ``step``."""
        rows = np.array([step])
        rigid = [i for i, d in enumerate(self._drawables) if d.moving and not d.deformable]
        if rigid:
            renderer.set_transforms(rigid, np.concatenate([self.matrices(i, rows) for i in rigid]))
        for index, drawable in enumerate(self._drawables):
            if drawable.deformable:
                renderer.set_vertices(self._slot_of[index], self.vertices(index, rows)[0])

    def frames(
        self, tracks: Sequence[CameraTrack], steps: Sequence[int], *, outputs: Sequence[Output] = ("rgb",),
        samples: Literal[1, 4] = 1, threads: int = 1,
    ) -> Iterator[tuple[int, list[dict[str, NDArray[Any]]]]]:  # fmt: skip
        """``(step, [outputs of each camera])`` in the order of ``steps``, drawn by ``threads`` threads.

        A few frames are drawn ahead, so memory stays constant however long the recording.
        """
        outside = [step for step in steps if not 0 <= step < len(self)]
        if outside:
            raise self._no_step(outside[0])
        _ = self.render_scene  # built once, before the threads start
        local = threading.local()

        def draw(step: int) -> list[dict[str, NDArray[Any]]]:
            if not hasattr(local, "renderer"):
                local.renderer = self.renderer()
            self.pose(local.renderer, step)
            return [local.renderer.render(t.at(step), outputs=outputs, samples=samples) for t in tracks]

        if threads <= 1:
            for step in steps:
                yield step, draw(step)
            return
        with ThreadPoolExecutor(threads) as pool:
            ahead, pending, todo = 2 * threads, [], list(steps)
            try:
                while todo or pending:
                    while todo and len(pending) < ahead:
                        pending.append((todo[0], pool.submit(draw, todo.pop(0))))
                    step, future = pending.pop(0)
                    yield step, future.result()
            finally:
                for _, future in pending:
                    future.cancel()


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraTrack:
    """A camera and where it is at every step."""

    camera: Camera
    poses: Array
    """4x4 camera to world, shape [T, 4, 4]; [1, 4, 4] for one that stands still."""

    def at(self, step: int) -> Camera:
        """The camera at one step."""
        return self.camera.at(self.poses[min(step, len(self.poses) - 1)])
