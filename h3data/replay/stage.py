"""Pictures of a recording: its things as a scene to render, posed step by step, drawn by several threads."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.bodies import Humanoid
from h3data.geometry import Array, pose_to_matrix
from h3data.render import Camera, Output, Renderer, RenderInstance, RenderScene
from h3data.replay.records import BodyTrack, LinkTrack, PersonTrack
from h3data.scene import Mesh

if TYPE_CHECKING:
    from h3data.replay.records import CameraTrack
    from h3data.replay.replay import Replay

JOINT_STEPS = 64
"""Poses of people are worked out for so many steps at once: for a single one they would cost more than skinning."""

Pictures = list[dict[str, NDArray[Any]]]
"""The outputs of each camera."""


@dataclass(frozen=True)
class _Skin:
    """A deformable mesh in the scene and its instance."""

    instance: int
    mesh: int


@dataclass(frozen=True)
class _Person:
    """A person with the meshes that a camera may choose."""

    body: Humanoid
    agent: int
    full: _Skin | None
    light: _Skin | None


class Stage:
    """What a replay shows, as a scene to render. Immutable: threads share it, each with a renderer of its own."""

    def __init__(self, replay: Replay) -> None:
        self.replay = replay
        self._meshes: list[Mesh] = []
        self._slots: dict[int, int] = {}
        self._instances: list[RenderInstance] = []
        self._people: list[_Person] = []
        self._rigged: list[tuple[int, _Skin]] = []
        soft = []
        for index, drawable in enumerate(replay.drawables):
            skin = _Skin(index, self._add(index, drawable.mesh, shared=not drawable.deformable))
            if drawable.deformable:
                soft.append((index, skin))
        for index, skin in soft:
            track = replay.tracks[index]
            if isinstance(track, PersonTrack):
                self._people.append(self._person(index, track.agent, skin))
            else:
                self._rigged.append((index, skin))
        meshes = [skin.mesh for _, skin in soft] + [p.light.mesh for p in self._people if p.light]
        self.scene = RenderScene(self._meshes, self._instances, deformable=meshes)
        self._find_movers()
        self._joints = lru_cache(maxsize=64)(self._joints_of_chunk)

    def _add(self, index: int, mesh: Mesh, *, shared: bool) -> int:
        """An instance of drawable ``index``; returns the number of its mesh."""
        slot = self._slots.get(id(mesh), len(self._meshes)) if shared else len(self._meshes)
        if slot == len(self._meshes):
            self._meshes.append(mesh)
        if shared:
            self._slots[id(mesh)] = slot
        drawable = self.replay.drawables[index]
        matrix = np.eye(4) if drawable.deformable else drawable.matrix.astype(np.float64)
        self._instances.append(
            RenderInstance(
                mesh=slot, matrix=matrix, semantic_id=drawable.semantic_id, layer=drawable.layer, name=drawable.name,
                id=index,
            )
        )  # fmt: skip
        return slot

    def _person(self, index: int, agent: int, skin: _Skin) -> _Person:
        body = self.replay.model(agent)
        assert isinstance(body, Humanoid)
        if self.replay.detail is not None:
            return _Person(body, agent, *((skin, None) if self.replay.detail else (None, skin)))
        instance = len(self._instances)
        return _Person(body, agent, skin, _Skin(instance, self._add(index, body.lod_mesh, shared=False)))

    def _find_movers(self) -> None:
        """Tables of what moves, so that a step is posed by a few array operations."""
        tracks = list(enumerate(self.replay.tracks))
        bodies = [(i, t) for i, t in tracks if isinstance(t, BodyTrack)]
        self._bodies = np.array([i for i, _ in bodies], np.intp)
        self._columns = np.array([t.column for _, t in bodies], np.intp)
        self._scales = np.array([t.scale for _, t in bodies], np.float64).reshape(-1, 1, 3)
        links = [(i, t) for i, t in tracks if isinstance(t, LinkTrack)]
        self._robots = [
            (agent, np.array([i for i, t in links if t.agent == agent]), [t.link for _, t in links if t.agent == agent])
            for agent in sorted({t.agent for _, t in links})
        ]

    def _joints_of_chunk(self, agent: int, chunk: int) -> Array:
        """Joint frames [t, 55, 4, 4] of `JOINT_STEPS` steps."""
        first = chunk * JOINT_STEPS
        return self.replay.joint_matrices(agent, np.arange(first, min(first + JOINT_STEPS, len(self.replay))))

    # --- drawing ------------------------------------------------------------------------------------------------------
    def renderer(self) -> Renderer:
        """A renderer for one thread, to be given to `draw`."""
        return Renderer(self.scene)

    def draw(
        self, renderer: Renderer, step: int, cameras: Sequence[Camera], *, outputs: Sequence[Output],
        samples: Literal[1, 4] = 1,
    ) -> Pictures:  # fmt: skip
        """What each camera sees at ``step``, from what a renderer of this stage draws."""
        if len(self._bodies):
            poses = self.replay.recording.columns["object_pose"][step, self._columns]
            matrices = pose_to_matrix(poses.astype(np.float64))  # NaN where a body is not there
            matrices[:, :3, :3] *= self._scales
            renderer.set_transforms(self._bodies, matrices)
        rows = np.array([step])
        for agent, instances, links in self._robots:
            renderer.set_transforms(instances, self.replay.link_matrices(agent, rows)[0, links])
        for index, skin in self._rigged:
            vertices = self.replay.vertices(index, rows)[0]
            there = bool(np.isfinite(vertices).all())
            renderer.set_visible([skin.instance], there)
            if there:
                renderer.set_vertices(skin.mesh, vertices)
        people = [
            (person, self._joints(person.agent, step // JOINT_STEPS)[[step % JOINT_STEPS]]) for person in self._people
        ]
        posed: set[_Skin] = set()
        pictures = []
        for camera in cameras:
            for person, joints in people:
                _show(renderer, person, joints, camera, posed)
            pictures.append(renderer.render(camera, outputs=outputs, samples=samples))
        return pictures

    def frames(
        self, tracks: Sequence[CameraTrack], steps: Sequence[int], *, outputs: Sequence[Output],
        samples: Literal[1, 4] = 1, threads: int = 1, then: Callable[[int, Pictures], Any] | None = None,
    ) -> Iterator[tuple[int, Any]]:  # fmt: skip
        """As `Replay.frames`; with ``then``, what it makes of a step and its pictures, in the thread that drew them."""
        local = threading.local()

        def draw(step: int) -> Any:
            if not hasattr(local, "renderer"):
                local.renderer = self.renderer()
            cameras = [track.at(step) for track in tracks]
            pictures = self.draw(local.renderer, step, cameras, outputs=outputs, samples=samples)
            return pictures if then is None else then(step, pictures)

        if threads <= 1:
            for step in steps:
                yield step, draw(step)
            return
        todo = iter(steps)
        with ThreadPoolExecutor(threads, thread_name_prefix="h3data-draw") as pool:
            pending = deque((step, pool.submit(draw, step)) for step in islice(todo, 2 * threads))
            try:
                while pending:
                    step, future = pending.popleft()
                    yield step, future.result()
                    pending.extend((step, pool.submit(draw, step)) for step in islice(todo, 1))
            finally:
                for _, future in pending:
                    future.cancel()


def _show(renderer: Renderer, person: _Person, joints: Array, camera: Camera, posed: set[_Skin]) -> None:
    """Show the mesh that ``camera`` needs of a person with joint frames [1, 55, 4, 4]; ``posed`` ones have their shape."""
    there = bool(np.isfinite(joints).all())
    light = person.full is None
    if person.full and person.light and there:
        distance = np.linalg.norm(joints[0, :, :3, 3] - camera.pose[:3, 3], axis=1).min()
        focal = camera.fx * (distance if camera.projection == "orthographic" else 1.0)
        light = person.body.light_enough(focal, distance)
    shown = person.light if light else person.full
    for skin in (person.full, person.light):
        if skin:
            renderer.set_visible([skin.instance], there and skin is shown)
    if there and shown and shown not in posed:
        posed.add(shown)
        renderer.set_vertices(shown.mesh, person.body.skin(joints, lod=light)[0])
