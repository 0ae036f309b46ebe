"""Stage of a recording: its drawables as a scene that several threads pose and render at any step."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid
from h3data.errors import InputError
from h3data.geometry import Array, pose_to_matrix
from h3data.render import Camera, Light, Output, Renderer, RenderInstance, RenderScene
from h3data.render.light.sources import BAKERS, sources_of
from h3data.render.renderer import Backend, gpu_fault
from h3data.replay.posed_recording import PosedRecording
from h3data.replay.records import BodyTrack, CameraTrack, JointTrack, LinkTrack, PersonTrack
from h3data.replay.shadow_casters import ShadowCasters, capsule_of_box, shadow_casters
from h3data.scene import Mesh

FrameBackend = Literal["auto", "cpu", "gpu"]
WORLDS = 32
"""Number of steps that a GPU renders at once, each in a separate world."""
JOINT_STEPS = 64
"""Number of steps for which poses of people are computed at once; for single steps they would cost more than skinning."""

Images = list[dict[str, NDArray[Any]]]
"""Images of each camera by name of the output, such as ``rgb``."""


@dataclass(frozen=True)
class _Skin:
    """A deformable mesh of the scene and its instance."""

    instance: int
    mesh: int


@dataclass(frozen=True)
class _Person:
    """A person with the meshes to choose from for each camera."""

    body: Humanoid
    agent: int
    full: _Skin | None
    light: _Skin | None


class _HostCopies:
    """Pictures copied from a GPU into page-locked memory, which is used again: several times as fast as into new memory."""

    def __init__(self) -> None:
        self._buffers: dict[tuple[int, str], Any] = {}

    def copied(self, camera: int, drawn: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
        """Return a camera's outputs [N, H, W, ...] as arrays, which are valid until the next call for this camera."""
        arrays: dict[str, NDArray[Any]] = {}
        devices: set[Any] = set()
        for name, array in drawn.items():
            if not hasattr(array, "cpu"):
                arrays[name] = array
                continue
            buffer = self._buffers.get((camera, name))
            if buffer is None or len(buffer) < len(array):
                buffer = array.new_empty(array.shape, device="cpu", pin_memory=array.is_cuda)
                self._buffers[camera, name] = buffer
            arrays[name] = buffer[: len(array)].copy_(array, non_blocking=True).numpy()
            devices |= {array.device} if array.is_cuda else set()
        if devices:
            import torch

            for device in devices:
                torch.cuda.current_stream(device).synchronize()
        return arrays


class Stage:
    """Drawables of a replay as a scene to render.

    A stage is immutable and shared by threads, each of which has its own renderer.
    """

    def __init__(self, replay: PosedRecording) -> None:
        self.replay = replay
        self._meshes: list[Mesh] = []
        self._slots: dict[int, int] = {}
        self._instances: list[RenderInstance] = []
        self._people: list[_Person] = []
        self._rigged: list[tuple[int, _Skin]] = []
        deformable = []
        for index, drawable in enumerate(replay.drawables):
            skin = _Skin(index, self._add(index, drawable.mesh, shared=not drawable.deformable))
            if drawable.deformable:
                deformable.append((index, skin))
        for index, skin in deformable:
            track = replay.tracks[index]
            if isinstance(track, PersonTrack):
                self._people.append(self._person(index, track.agent, skin))
            else:
                self._rigged.append((index, skin))
        # meshes that are written anew at each step may not be shared by instances
        meshes = [skin.mesh for _, skin in deformable] + [p.light.mesh for p in self._people if p.light]
        self._light: Light | None = None
        self._casters: ShadowCasters | None = None
        self._mirrors: dict[int, NDArray[np.float32]] = {}
        if replay.light == "baked":
            self._bake()
        self.scene = RenderScene(self._meshes, self._instances, deformable=meshes, mirrors=self._mirrors)
        self._find_movers()
        # threads render neighbouring steps, which share the chunk that one of them computed
        self._joints = lru_cache(maxsize=64)(self._joints_of_chunk)

    def _bake(self) -> None:
        """Replace static meshes by ones that carry the light of the scene."""
        static = [
            k
            for k, track in enumerate(self.replay.tracks)
            if isinstance(track, JointTrack) or (track is None and not self.replay.drawables[k].moving)
        ]  # doors carry the light that they have where the home has them, which is closed
        scene = self.replay.scene
        name = scene.name if scene is not None else "this recording's scene"
        lit = BAKERS.get("baked")(self._meshes, self._instances, static, sources_of(scene), name=name)
        self._meshes, self._instances, self._light = lit.meshes, lit.instances, lit.light
        self._mirrors = lit.mirrors
        if lit.field is not None:
            agents = {k: drawable.agent for k, drawable in enumerate(self.replay.drawables) if k not in set(static)}
            agents |= {p.light.instance: p.agent for p in self._people if p.light}
            self._casters = shadow_casters(lit.field, self._meshes, self._instances, agents)

    def _add(self, index: int, mesh: Mesh, *, shared: bool) -> int:
        """Add an instance of drawable ``index``; return the index of its mesh."""
        slot = self._slots.get(id(mesh), len(self._meshes)) if shared else len(self._meshes)
        if slot == len(self._meshes):
            self._meshes.append(mesh)
        if shared:
            self._slots[id(mesh)] = slot
        drawable = self.replay.drawables[index]
        matrix = np.eye(4) if drawable.deformable else drawable.matrix.astype(np.float64)
        self._instances.append(
            RenderInstance(
                mesh=slot,
                matrix=matrix,
                semantic_id=drawable.semantic_id,
                layer=drawable.layer,
                name=drawable.name,
                id=index,
            )
        )
        return slot

    def _person(self, index: int, agent: int, skin: _Skin) -> _Person:
        """Return a person with one mesh if the replay's ``detail`` is fixed, else with both."""
        body = self.replay.model(agent)
        assert isinstance(body, Humanoid)
        if self.replay.detail is not None:
            return _Person(body, agent, *((skin, None) if self.replay.detail else (None, skin)))
        instance = len(self._instances)
        return _Person(body, agent, skin, _Skin(instance, self._add(index, body.lod_mesh, shared=False)))

    def _find_movers(self) -> None:
        """Tabulate moving bodies and links, so that a step is posed by a few array operations."""
        tracks = list(enumerate(self.replay.tracks))
        bodies = [(i, t) for i, t in tracks if isinstance(t, BodyTrack)]
        self._bodies = np.array([i for i, _ in bodies], np.intp)
        self._columns = np.array([t.column for _, t in bodies], np.intp)
        self._scales = np.array([t.scale for _, t in bodies], np.float64).reshape(-1, 1, 3)
        links = [(i, t) for i, t in tracks if isinstance(t, LinkTrack)]
        parts = [(i, t.joint) for i, t in tracks if isinstance(t, JointTrack)]
        self._parts = np.array([i for i, _ in parts], np.intp)
        self._part_joints = np.array([joint for _, joint in parts], np.intp)
        self._part_matrices = np.array([self.replay.drawables[i].matrix for i, _ in parts]).reshape(-1, 4, 4)
        self._robots = [
            (agent, np.array([i for i, t in links if t.agent == agent]), [t.link for _, t in links if t.agent == agent])
            for agent in sorted({t.agent for _, t in links})
        ]

    def _joints_of_chunk(self, agent: int, chunk: int) -> Array:
        """Return the joint matrices [t, 55, 4, 4] of up to `JOINT_STEPS` steps."""
        first = chunk * JOINT_STEPS
        return self.replay.joint_matrices(agent, np.arange(first, min(first + JOINT_STEPS, len(self.replay))))

    # --- images -------------------------------------------------------------------------------------------------------
    def renderer(self, backend: Backend = "cpu", *, worlds: int = 1) -> Renderer:
        """Return a renderer for one thread, to be passed to `render`, or to `render_steps` if it has several worlds."""
        return Renderer(self.scene, light=self._light, backend=backend, worlds=worlds)

    def render(
        self,
        renderer: Renderer,
        step: int,
        cameras: Sequence[Camera],
        *,
        outputs: Sequence[Output],
        samples: Literal[1, 4] = 1,
    ) -> Images:
        """Return the outputs of each camera at ``step``, rendered by a renderer of this stage."""
        people = self._pose(renderer, step, outputs)
        posed: set[_Skin] = set()
        images = []
        for camera in cameras:
            for person, joints in people:
                _show(renderer, person, joints, camera, posed)
            images.append(renderer.render(camera, outputs=outputs, samples=samples))
        return images

    def render_steps(
        self,
        renderer: Renderer,
        steps: Sequence[int],
        tracks: Sequence[CameraTrack],
        *,
        outputs: Sequence[Output],
        samples: Literal[1, 4] = 1,
        copies: _HostCopies | None = None,
    ) -> list[Images]:
        """Render several steps at once, each in one world of the renderer, and return their outputs.

        If ``copies`` are given, the images are written there and valid until their next use; otherwise they are newly
        allocated.
        """
        people = [self._pose(renderer, step, outputs, world=world) for world, step in enumerate(steps)]
        posed: list[set[_Skin]] = [set() for _ in steps]
        images: list[Images] = [[] for _ in steps]
        for number, track in enumerate(tracks):
            cameras = [track.at(step) for step in steps]
            for world, camera in enumerate(cameras):
                for person, joints in people[world]:
                    _show(renderer, person, joints, camera, posed[world], world=world)
            drawn = renderer.render_batch(cameras, worlds=range(len(steps)), outputs=outputs, samples=samples)
            if copies is not None:
                host = copies.copied(number, drawn)
            else:
                host = {name: array.cpu().numpy() if hasattr(array, "cpu") else array for name, array in drawn.items()}
            for world in range(len(steps)):
                images[world].append({name: array[world] for name, array in host.items()})
        return images

    def _pose(
        self, renderer: Renderer, step: int, outputs: Sequence[Output], *, world: int = 0
    ) -> list[tuple[_Person, Array]]:
        """Pose all but the people in a world, and return the people with their joint matrices [1, 55, 4, 4].

        Shapes that keep light away are posed only if light is seen in ``outputs``.
        """
        rigid: list[tuple[NDArray[np.intp], Array]] = []
        deformed: dict[int, NDArray[np.floating]] = {}
        if len(self._bodies):
            poses = self.replay.recording.columns["object_pose"][step, self._columns]
            matrices = pose_to_matrix(poses.astype(np.float64))  # NaN where a body is absent
            # recorded poses are rigid; the scale of a body is constant
            matrices[:, :3, :3] *= self._scales
            renderer.set_transforms(self._bodies, matrices, world=world)
            rigid.append((self._bodies, matrices))
        rows = np.array([step])
        if len(self._parts):
            motions = self.replay.joint_motions(rows)[0, self._part_joints]
            renderer.set_transforms(self._parts, motions @ self._part_matrices, world=world)
        for agent, instances, links in self._robots:
            matrices = self.replay.link_matrices(agent, rows)[0, links]
            renderer.set_transforms(instances, matrices, world=world)
            rigid.append((instances, matrices))
        for index, skin in self._rigged:
            vertices = self.replay.vertices(index, rows)[0]
            present = bool(np.isfinite(vertices).all())
            renderer.set_visible([skin.instance], present, world=world)
            if present:
                renderer.set_vertices(skin.mesh, vertices, world=world)
                deformed[skin.instance] = capsule_of_box(vertices.min(0), vertices.max(0))[None]
        people = [
            (person, self._joints(person.agent, step // JOINT_STEPS)[[step % JOINT_STEPS]]) for person in self._people
        ]
        # depth and ids do not see light
        if self._casters is not None and "rgb" in outputs:
            for person, joints in people:
                ends = person.body.capsules_world(joints)
                skin = person.full or person.light
                assert skin is not None
                deformed[skin.instance] = np.column_stack([ends[0][0], ends[1][0], ends[2]])
            renderer.set_blockers(self._casters.blockers(rigid, deformed), world=world)
        return people

    def frames(
        self,
        tracks: Sequence[CameraTrack],
        steps: Sequence[int],
        *,
        outputs: Sequence[Output],
        samples: Literal[1, 4] = 1,
        threads: int = 1,
        then: Callable[[int, Images], Any] | None = None,
        backend: FrameBackend = "cpu",
    ) -> Iterator[tuple[int, Any]]:
        """Yield ``(step, images)`` for each step, as `Replay.frames` does, or ``(step, then(step, images))``.

        ``then`` runs in the thread that rendered the images, or in a worker thread if a GPU renders, for example to
        encode them in parallel; it must not store them, because later images of a GPU overwrite them. `chosen_backend`
        describes ``backend``.
        """
        if chosen_backend(backend) == "gpu":
            yield from self._frames_at_once(tracks, steps, outputs, samples, threads, then)
            return
        local = threading.local()

        def render(step: int) -> Any:
            # a renderer has buffers of its own, which two threads must not share
            if not hasattr(local, "renderer"):
                local.renderer = self.renderer()
            cameras = [track.at(step) for track in tracks]
            images = self.render(local.renderer, step, cameras, outputs=outputs, samples=samples)
            return images if then is None else then(step, images)

        if threads <= 1:
            for step in steps:
                yield step, render(step)
            return
        todo = iter(steps)
        with ThreadPoolExecutor(threads, thread_name_prefix="h3data-render") as pool:
            # two frames a thread are under way: enough to keep all busy, few enough for the memory
            pending = deque((step, pool.submit(render, step)) for step in islice(todo, 2 * threads))
            try:
                while pending:
                    step, future = pending.popleft()
                    yield step, future.result()
                    pending.extend((step, pool.submit(render, step)) for step in islice(todo, 1))
            finally:
                for _, future in pending:
                    future.cancel()

    def _frames_at_once(
        self,
        tracks: Sequence[CameraTrack],
        steps: Sequence[int],
        outputs: Sequence[Output],
        samples: Literal[1, 4],
        threads: int,
        then: Callable[[int, Images], Any] | None,
    ) -> Iterator[tuple[int, Any]]:
        """Yield `frames` from a GPU, which draws the next steps while ``then`` works on the last ones."""
        renderer = self.renderer("auto", worlds=min(WORLDS, max(len(steps), 1)))
        before: list[tuple[int, Future[Any]]] = []
        # while one batch is drawn, `then` works on the one before; without `then`, the images go to somebody who may keep them
        copies = [None, None] if then is None else [_HostCopies(), _HostCopies()]
        with ThreadPoolExecutor(max(threads, 1), thread_name_prefix="h3data-render") as pool:
            try:
                for first in range(0, len(steps), WORLDS):
                    some = steps[first : first + WORLDS]
                    # the buffers of the batch before may still be read by `then`
                    copies.reverse()
                    images = self.render_steps(
                        renderer, some, tracks, outputs=outputs, samples=samples, copies=copies[0]
                    )
                    work = then or (lambda _, pictures: pictures)
                    now = [(step, pool.submit(work, step, one)) for step, one in zip(some, images, strict=True)]
                    yield from ((step, future.result()) for step, future in before)
                    before = now
                yield from ((step, future.result()) for step, future in before)
            finally:
                for _, future in before:
                    future.cancel()


def chosen_backend(backend: FrameBackend) -> Literal["cpu", "gpu"]:
    """Return the renderer for a requested back end: ``cpu`` or ``gpu``; ``auto`` means the GPU if there is one.

    The page `gpu` of the documentation describes the differences between their images. Views without perspective are
    always rendered on the CPU.

    Raises:
        InputError: there is no such back end, or ``gpu`` was requested without a GPU.
    """
    if backend not in get_args(FrameBackend):
        raise InputError(
            f"Unknown back end {backend!r}. Available: {', '.join(get_args(FrameBackend))}.", code="H3-RENDER-054"
        )
    if backend == "cpu":
        return "cpu"
    fault = gpu_fault()
    if fault and backend == "gpu":
        raise InputError(
            f"There is no GPU to draw with: {fault}. Hint: cpu, or auto for a GPU only where there is one.",
            code="H3-REPLAY-030",
        )
    return "cpu" if fault else "gpu"


def _show(
    renderer: Renderer, person: _Person, joints: Array, camera: Camera, posed: set[_Skin], *, world: int = 0
) -> None:
    """Show the mesh that suits ``camera`` of a person with joint matrices [1, 55, 4, 4].

    ``posed`` collects the meshes that have this step's vertices already.
    """
    present = bool(np.isfinite(joints).all())
    light = person.full is None
    if person.full and person.light and present:
        # to the nearest joint: a hand close to the lens shows its facets
        distance = np.linalg.norm(joints[0, :, :3, 3] - camera.pose[:3, 3], axis=1).min()
        # without perspective, size does not depend on the distance, with which `light_enough` compares
        focal = camera.fx * (distance if camera.projection == "orthographic" else 1.0)
        light = person.body.light_enough(focal, distance)
    shown = person.light if light else person.full
    for skin in (person.full, person.light):
        if skin:
            renderer.set_visible([skin.instance], present and skin is shown, world=world)
    if present and shown and shown not in posed:
        posed.add(shown)
        renderer.set_vertices(shown.mesh, person.body.skin(joints, lod=light)[0], world=world)
