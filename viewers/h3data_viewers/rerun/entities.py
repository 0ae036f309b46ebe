"""A recording's agents, rigid objects and skinned bodies as Rerun entities."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import pose_inverse, pose_to_matrix, transform_points
from h3data.mesh.mesh import Mesh, Texture
from h3data.mesh.thinning import thin_mesh
from h3data.progress import progress
from h3data.recording.records import Agent, Recording
from h3data_viewers.rerun.mesh_budget import ViewMesh, baked_colors, texture_bytes, view_mesh, view_texture
from h3data_viewers.rerun.sink import Sink
from h3data_viewers.rerun.transforms import LoggedTrack, decompose, step_blocks

MESH_BYTES = 12_000_000
"""Budget of all rigid meshes [bytes]; above it, all are thinned by the same factor."""
TEXTURE_BYTES = 8_000_000
"""Budget of all textures [bytes], which are halved until they fit: a ``.rrd`` stores texels uncompressed, once per
mesh."""
TEXTURE_SIDE_PX = 512
SKIN_BYTES = 16_000_000
"""Budget of all skinned bodies [bytes]; above it, they are sampled less often."""
SKIN_VERTICES = 3_500
AGENT_COLORS = {
    "robot": ((255, 202, 40), (239, 83, 80), (255, 138, 101), (212, 225, 87)),
    "human": ((66, 165, 245), (171, 71, 188), (38, 166, 154), (121, 134, 203)),
}
"""Colours of the name tag, path and marks of agents by kind and order: warm for robots, cold for people."""
PATH_RADIUS_M, MARK_M = 0.025, 0.09


class Drawable(Protocol):
    """Visible mesh, such as a `h3data.replay.Drawable`."""

    @property
    def name(self) -> str:
        """Name of the mesh."""
        ...

    @property
    def mesh(self) -> Mesh:
        """Mesh in its own frame."""
        ...

    @property
    def matrix(self) -> NDArray[np.floating]:
        """World matrix of a static mesh, shape [4, 4]."""
        ...

    @property
    def layer(self) -> str:
        """Layer by which viewers can hide it, such as ``ceiling``."""
        ...

    @property
    def agent(self) -> int:
        """Number of the agent to which it belongs; -1 for parts of the scene."""
        ...

    @property
    def moving(self) -> bool:
        """Return whether the pose of the mesh changes over time."""
        ...

    @property
    def deformable(self) -> bool:
        """Return whether the vertices change over time, as those of skinned bodies do."""
        ...


class PosedScene(Protocol):
    """Drawables with their poses over time, such as a `h3data.replay.Replay`."""

    @property
    def drawables(self) -> Sequence[Drawable]:
        """Meshes of the scene and its agents."""
        ...

    def matrices(self, index: int, steps: NDArray[np.integer]) -> NDArray[np.float32]:
        """Return the world matrices of a moving drawable, [len(steps), 4, 4]; NaN where it is not in the world."""
        ...

    def vertices(self, index: int, steps: NDArray[np.integer]) -> NDArray[np.float32]:
        """Return the world vertices of a deformable drawable, [len(steps), V, 3] [m]."""
        ...


# --- agents -----------------------------------------------------------------------------------------------------------
def entity_part(name: str) -> str:
    """Return the name as one part of an entity path, with special characters escaped."""
    import rerun as rr

    return rr.escape_entity_path_part(name or "unnamed")


def log_agents(sink: Sink, recording: Recording, with_meshes: set[int]) -> None:
    """Log root frames, name tags and trajectories of all agents, and simple solids for agents without meshes."""
    import rerun as rr

    for i, (agent, color) in enumerate(zip(recording.agents, agent_colors(recording.agents), strict=True)):
        pose = recording.agent_column(i, "base_pose")
        root = f"world/{entity_part(agent.name)}"
        track = LoggedTrack(sink, root)
        for steps in step_blocks(len(recording)):
            track.log(steps, pose_to_matrix(pose[steps].astype(np.float64)))
        # name tags hang above the heads [m]
        height = 1.95 if agent.kind == "human" else 0.95
        tag = rr.Points3D([[0, height, 0]], radii=[0.02], colors=[color], labels=[agent.name], show_labels=True)
        sink.static(f"{root}/name", tag)
        if i not in with_meshes:
            sink.static(f"{root}/solid", _solid(agent.kind, color))
        # the path lies 3 cm above the floor, which would hide it, and is broken where the agent is not in the world
        points = pose[:, :3] + np.array([0, 0.03, 0], np.float32)
        finite = np.asarray(np.isfinite(points).all(axis=1))
        runs = np.split(np.arange(len(points)), np.flatnonzero(np.diff(finite)) + 1)
        strips = [points[run] for run in runs if len(run) > 1 and finite[run[0]]]
        if strips:
            lines = rr.LineStrips3D(strips, colors=[color] * len(strips), radii=[PATH_RADIUS_M])
            entity = f"world/trajectories/{entity_part(agent.name)}"
            sink.static(entity, lines)
            start, end = strips[0][0], strips[-1][-1]
            # Hidden labels: at the first and the last step the agent's name stands in the same place.
            ball = rr.Points3D(
                [start], radii=[MARK_M], colors=[color], labels=[f"{agent.name} starts"], show_labels=False
            )
            sink.static(f"{entity}/start", ball)
            cube = rr.Boxes3D(
                centers=[end],
                half_sizes=[[MARK_M] * 3],
                colors=[color],
                labels=[f"{agent.name} ends"],
                show_labels=False,
                fill_mode="solid",
            )
            sink.static(f"{entity}/end", cube)


def agent_colors(agents: Sequence[Agent]) -> list[tuple[int, int, int]]:
    """Return a colour for every agent; those of one kind differ, up to four of them."""
    before = dict.fromkeys(AGENT_COLORS, 0)
    out = []
    for agent in agents:
        family = AGENT_COLORS[agent.kind]
        out.append(family[before[agent.kind] % len(family)])
        before[agent.kind] += 1
    return out


def _solid(kind: str, color: tuple[int, int, int]) -> Any:
    import rerun as rr

    if kind == "human":
        return rr.Capsules3D(
            lengths=[1.3],
            radii=[0.2],
            translations=[[0, 0.2, 0]],
            rotation_axis_angles=[rr.RotationAxisAngle(axis=[1, 0, 0], degrees=-90)],
            colors=[color],
            fill_mode="solid",
        )
    return rr.Boxes3D(half_sizes=[[0.4, 0.2, 0.15]], centers=[[0, 0.5, 0]], colors=[color], fill_mode="solid")


# --- rigid objects ----------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class _Appearance:
    """Parts of a drawable's mesh and the texels of their textures."""

    parts: list[ViewMesh]
    texels: Mapping[Texture, NDArray[np.uint8]]


def log_rigid(sink: Sink, recording: Recording, replay: PosedScene, *, share: float = 1.0) -> None:
    """Log the meshes of all drawables that do not deform, static or with a track.

    ``share`` is the fraction of the byte budgets that this recording may use, less than 1 if the file holds several.
    """
    rigid = [(i, d) for i, d in enumerate(replay.drawables) if not d.deformable and len(d.mesh.faces)]
    appearances = _appearances([d.mesh for _, d in rigid], share)
    taken: set[str] = set()
    moving = []
    for (index, drawable), appearance in zip(rigid, appearances, strict=True):
        if not drawable.moving:
            layer = f"{entity_part(drawable.layer)}/" if drawable.layer else ""
            entity = _unique(f"world/scene/{layer}{entity_part(drawable.name)}", taken)
            _log_mesh(sink, entity, appearance, drawable.matrix)
            continue
        agent = drawable.agent if _has_root(recording, drawable.agent) else -1
        # a link below its agent's frame moves only where its joint does
        parent, name = "world/objects", drawable.name
        if agent >= 0:
            owner = recording.agents[agent].name
            parent, name = f"world/{entity_part(owner)}", name.removeprefix(owner + "/")
        track = LoggedTrack(sink, _unique(f"{parent}/{entity_part(name)}", taken))
        moving.append((index, agent, track, appearance))
    roots = {agent: recording.agent_column(agent, "base_pose") for _, agent, _, _ in moving if agent >= 0}
    blocks = step_blocks(len(recording) if moving else 0)
    for steps in progress(blocks, desc="write poses", unit="block", delay=1.0, leave=False):
        to_root = {a: pose_to_matrix(pose_inverse(pose[steps].astype(np.float64))) for a, pose in roots.items()}
        for index, agent, track, _ in moving:
            matrices = replay.matrices(index, steps).astype(np.float64)
            track.log(steps, matrices if agent < 0 else to_root[agent] @ matrices)
    # a track knows the scale of its first pose only now; its transforms leave the scale to the mesh
    for _, _, track, appearance in moving:
        _log_mesh(sink, f"{track.entity}/mesh", appearance, np.diag([*track.scale, 1.0]))


def _has_root(recording: Recording, agent: int) -> bool:
    """Return whether the agent's entities can be children of its root frame: the agent must be in the world at every step."""
    if not 0 <= agent < len(recording.agents):
        return False
    return bool(np.isfinite(recording.agent_column(agent, "base_pose")).all())


def _unique(entity: str, taken: set[str]) -> str:
    # Rerun would merge two drawables of one name into one entity
    name, number = entity, 1
    while name in taken:
        number += 1
        name = f"{entity}_{number}"
    taken.add(name)
    return name


def _appearances(meshes: list[Mesh], share: float) -> list[_Appearance]:
    """Prepare meshes for the viewer within the byte budgets; a mesh that several drawables share is prepared once."""
    distinct = {id(m): m for m in meshes}
    ready = {key: view_mesh(m) for key, m in distinct.items()}
    # over all meshes, not the distinct ones: a file holds a shared mesh once for each of its entities
    total = sum(part.nbytes for m in meshes for part in ready[id(m)])
    if total > share * MESH_BYTES:
        kept = share * MESH_BYTES / total
        message = "Thinning %.0f MB of meshes to %.0f%% of their vertices"
        logging.getLogger(__name__).info(message, total / 1e6, 100 * kept)
        for key, mesh in distinct.items():
            # small things, which cost little, keep their shape
            ready[key] = view_mesh(mesh, max_vertices=max(300, int(kept * len(mesh.vertices))))
    textures = [part.texture for m in meshes for part in ready[id(m)] if part.texture is not None]
    # all textures shrink alike, so that none is sharp beside a blurred one
    side = TEXTURE_SIDE_PX
    while side > 1 and sum(texture_bytes(t, side) for t in textures) > share * TEXTURE_BYTES:
        side //= 2
    texels = {t: view_texture(t, side) for t in dict.fromkeys(textures)}
    return [_Appearance(ready[id(m)], texels) for m in meshes]


def _log_mesh(sink: Sink, entity: str, appearance: _Appearance, matrix: NDArray[np.floating]) -> None:
    """Log a mesh; parts after the first, which have textures of their own, become children of its entity."""
    import rerun as rr

    for number, part in enumerate(appearance.parts):
        components: list[Any] = [
            rr.Mesh3D(
                vertex_positions=part.vertices,
                triangle_indices=part.faces,
                vertex_colors=part.colors,
                vertex_normals=part.normals,
                vertex_texcoords=part.uv,
                albedo_texture=None if part.texture is None else appearance.texels[part.texture],
            )
        ]
        if number == 0 and not np.allclose(matrix, np.eye(4)):
            position, quat, scale = decompose(matrix[None])
            components.append(rr.Transform3D(translation=position[0], quaternion=quat[0], scale=scale[0]))
        sink.static(f"{entity}/part_{number + 1}" if number else entity, *components)


# --- skinned bodies ---------------------------------------------------------------------------------------------------
def log_skins(sink: Sink, recording: Recording, replay: PosedScene, skin_every: int, *, share: float = 1.0) -> None:
    """Log the vertices of skinned bodies every ``skin_every`` steps or less often, within ``share`` of the budget.

    Vertices are relative to the agent's root frame, which is logged at every step, so that walking bodies move
    smoothly.
    """
    import rerun as rr

    skins = [(i, d) for i, d in enumerate(replay.drawables) if d.deformable and len(d.mesh.faces)]
    if not skins or not len(recording):
        return
    thin = {i: thin_mesh(d.mesh, SKIN_VERTICES) for i, d in skins}
    # three float32 for each vertex
    per_sample = sum(12 * len(t.keep) for t in thin.values())
    every = max(1, skin_every, int(np.ceil(len(recording) * per_sample / (share * SKIN_BYTES))))
    steps = np.arange(0, len(recording), every)
    parts = np.array_split(steps, len(steps) // 64 + 1)
    bar = progress(total=len(steps) * len(skins), desc="write skins", unit="pose", delay=1.0, leave=False)
    for index, drawable in skins:
        keep = thin[index].keep
        # Skinning computes all vertices of a sample before thinning: blocks of about 64 samples bound the memory.
        blocks = []
        for part in parts:
            blocks.append(replay.vertices(index, part)[:, keep])
            bar.update(len(part))
        vertices, rows, entity = np.concatenate(blocks), steps, f"world/objects/{entity_part(drawable.name)}"
        # below the root frame, which is logged at every step, the body goes on moving between its samples
        if _has_root(recording, drawable.agent):
            pose = recording.agent_column(drawable.agent, "base_pose")[steps].astype(np.float64)
            vertices = transform_points(pose_to_matrix(pose_inverse(pose)), vertices).astype(np.float32)
            entity = f"world/{entity_part(recording.agents[drawable.agent].name)}/body"
        # a body that stands still, to a fifth of a millimetre, takes no rows
        changed = np.concatenate([[True], np.abs(np.diff(vertices, axis=0)).max((1, 2)) > 2e-4])
        vertices, rows = vertices[changed], rows[changed]
        surface = rr.Mesh3D.from_fields(
            triangle_indices=thin[index].faces, vertex_colors=baked_colors(drawable.mesh)[keep], clear_unset=False
        )
        sink.static(entity, surface)
        columns = rr.Mesh3D.columns(vertex_positions=vertices.reshape(-1, 3)).partition([len(keep)] * len(rows))
        sink.columns(entity, rows, columns)
    bar.close()
