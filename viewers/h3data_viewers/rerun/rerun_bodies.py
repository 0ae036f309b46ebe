"""Everything of a recording that has a place in the world, as Rerun entities: agents, rigid things, skinned bodies."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import pose_inverse, pose_to_matrix, quat_from_matrix, quat_sign_continuous, transform_points
from h3data.mesh.mesh import Mesh, Texture
from h3data.recording.records import Recording
from h3data_viewers.rerun.mesh_detail import ViewMesh, baked_colors, texture_bytes, thin_mesh, view_mesh, view_texture
from h3data_viewers.rerun.rerun_sink import Sink

_LOG = logging.getLogger(__name__)

MESH_BYTES = 12_000_000
"""Above this, all rigid meshes are thinned alike."""
TEXTURE_BYTES = 8_000_000
"""Above this, textures are halved until they fit: the viewer's format holds texels as they are, for each mesh anew."""
TEXTURE_SIDE_PX = 512
SKIN_BYTES = 16_000_000
"""Above this, skinned bodies are sampled less often."""
SKIN_VERTICES = 3_500
BLOCK_STEPS = 4096
"""Steps whose poses are worked out and logged together."""
HIDDEN = 1e-6
"""Scale of a thing that is not in the world at a step: Rerun takes 0 and NaN for a fault and says so in its log."""
AGENT_COLORS = {"robot": (255, 202, 40), "human": (66, 165, 245)}


class Drawable(Protocol):
    """One thing that can be drawn, as `h3data.replay.Drawable`."""

    @property
    def name(self) -> str: ...
    @property
    def mesh(self) -> Mesh: ...
    @property
    def matrix(self) -> NDArray[np.floating]: ...
    @property
    def layer(self) -> str: ...
    @property
    def agent(self) -> int: ...
    @property
    def moving(self) -> bool: ...
    @property
    def deformable(self) -> bool: ...


class Posed(Protocol):
    """Something that knows where everything was, as `h3data.replay.Replay`."""

    @property
    def drawables(self) -> Sequence[Drawable]: ...

    def matrices(self, index: int, steps: NDArray[np.integer]) -> NDArray[np.float32]:
        """4x4 of a moving drawable at ``steps``, shape [len(steps), 4, 4]; NaN where it was not in the world."""
        ...

    def vertices(self, index: int, steps: NDArray[np.integer]) -> NDArray[np.float32]:
        """World vertices of a deformable drawable at ``steps``, shape [len(steps), V, 3] [m]."""
        ...


# --- agents -----------------------------------------------------------------------------------------------------------
def entity_part(name: str) -> str:
    import rerun as rr

    return rr.escape_entity_path_part(name or "unnamed")


def log_agents(sink: Sink, recording: Recording, drawn: set[int]) -> None:
    """Root frames, name tags and tracks of all agents; plain solids for those that nothing else draws."""
    import rerun as rr

    for i, agent in enumerate(recording.agents):
        pose = recording.agent_column(i, "base_pose")
        color = AGENT_COLORS[agent.kind]
        root = f"world/{entity_part(agent.name)}"
        track = LoggedTrack(sink, root)
        for steps in step_blocks(len(recording)):
            track.log(steps, pose_to_matrix(pose[steps].astype(np.float64)))
        height = 1.95 if agent.kind == "human" else 0.95
        tag = rr.Points3D([[0, height, 0]], radii=[0.02], colors=[color], labels=[agent.name], show_labels=True)
        sink.static(f"{root}/name", tag)
        if i not in drawn:
            sink.static(f"{root}/solid", _solid(agent.kind, color))
        strips = _strips(pose[:, :3] + np.array([0, 0.03, 0], np.float32))
        if strips:
            lines = rr.LineStrips3D(strips, colors=[color] * len(strips), radii=[0.015])
            sink.static(f"world/trajectories/{entity_part(agent.name)}", lines)


def _solid(kind: str, color: tuple[int, int, int]) -> Any:
    import rerun as rr

    if kind == "human":
        return rr.Capsules3D(
            lengths=[1.3], radii=[0.2], translations=[[0, 0.2, 0]], colors=[color],
            rotation_axis_angles=[rr.RotationAxisAngle(axis=[1, 0, 0], degrees=-90)], fill_mode="solid",
        )  # fmt: skip
    return rr.Boxes3D(half_sizes=[[0.4, 0.2, 0.15]], centers=[[0, 0.5, 0]], colors=[color], fill_mode="solid")


def _strips(points: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """Runs of finite points, at least two long."""
    finite = np.asarray(np.isfinite(points).all(axis=1))
    runs = np.split(np.arange(len(points)), np.flatnonzero(np.diff(finite)) + 1)
    return [points[run] for run in runs if len(run) > 1 and finite[run[0]]]


# --- rigid things -----------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class _Look:
    """How a drawable looks: its parts, and the texels of their textures."""

    parts: list[ViewMesh]
    texels: Mapping[Texture, NDArray[np.uint8]]


def log_rigid(sink: Sink, recording: Recording, replay: Posed, *, share: float = 1.0) -> None:
    """Meshes of everything that does not deform, static or with a track; ``share`` of the file's bytes are theirs."""
    rigid = [(i, d) for i, d in enumerate(replay.drawables) if not d.deformable and len(d.mesh.faces)]
    looks = _looks([d.mesh for _, d in rigid], share)
    taken: set[str] = set()
    moving = []
    for (index, drawable), look in zip(rigid, looks, strict=True):
        if not drawable.moving:
            layer = f"{entity_part(drawable.layer)}/" if drawable.layer else ""
            entity = _unique(f"world/scene/{layer}{entity_part(drawable.name)}", taken)
            _log_mesh(sink, entity, look, drawable.matrix)
            continue
        agent = drawable.agent if _has_root(recording, drawable.agent) else -1
        parent, name = "world/objects", drawable.name
        if agent >= 0:
            owner = recording.agents[agent].name
            parent, name = f"world/{entity_part(owner)}", name.removeprefix(owner + "/")
        moving.append((index, agent, LoggedTrack(sink, _unique(f"{parent}/{entity_part(name)}", taken)), look))
    roots = {agent: recording.agent_column(agent, "base_pose") for _, agent, _, _ in moving if agent >= 0}
    for steps in step_blocks(len(recording)):
        to_root = {a: pose_to_matrix(pose_inverse(pose[steps].astype(np.float64))) for a, pose in roots.items()}
        for index, agent, track, _ in moving:
            matrices = replay.matrices(index, steps).astype(np.float64)
            track.log(steps, matrices if agent < 0 else to_root[agent] @ matrices)
    for _, _, track, look in moving:
        _log_mesh(sink, f"{track.entity}/mesh", look, np.diag([*track.scale, 1.0]))


def _has_root(recording: Recording, agent: int) -> bool:
    """Whether things of this agent can hang in its root frame: it must be in the world all the time."""
    if not 0 <= agent < len(recording.agents):
        return False
    return bool(np.isfinite(recording.agent_column(agent, "base_pose")).all())


def _unique(entity: str, taken: set[str]) -> str:
    name, number = entity, 1
    while name in taken:
        number += 1
        name = f"{entity}_{number}"
    taken.add(name)
    return name


def _looks(meshes: list[Mesh], share: float) -> list[_Look]:
    """Every mesh for the viewer, all thinned alike if they are too large together; shared ones are prepared once."""
    distinct = {id(m): m for m in meshes}
    ready = {key: view_mesh(m) for key, m in distinct.items()}
    total = sum(part.nbytes for m in meshes for part in ready[id(m)])
    if total > share * MESH_BYTES:
        kept = share * MESH_BYTES / total
        _LOG.info("Meshes of %.0f MB are thinned to %.0f %% of their vertices", total / 1e6, 100 * kept)
        for key, mesh in distinct.items():
            ready[key] = view_mesh(mesh, max_vertices=max(300, int(kept * len(mesh.vertices))))
    textures = [part.texture for m in meshes for part in ready[id(m)] if part.texture is not None]
    side = TEXTURE_SIDE_PX
    while side > 1 and sum(texture_bytes(t, side) for t in textures) > share * TEXTURE_BYTES:
        side //= 2
    texels = {t: view_texture(t, side) for t in dict.fromkeys(textures)}
    return [_Look(ready[id(m)], texels) for m in meshes]


def _log_mesh(sink: Sink, entity: str, look: _Look, matrix: NDArray[np.floating]) -> None:
    """Further parts of a mesh, which have textures of their own, hang below its entity."""
    import rerun as rr

    for number, part in enumerate(look.parts):
        components: list[Any] = [
            rr.Mesh3D(
                vertex_positions=part.vertices,
                triangle_indices=part.faces,
                vertex_colors=part.colors,
                vertex_normals=part.normals,
                vertex_texcoords=part.uv,
                albedo_texture=None if part.texture is None else look.texels[part.texture],
            )
        ]
        if number == 0 and not np.allclose(matrix, np.eye(4)):
            position, quat, scale = decompose(matrix[None])
            components.append(rr.Transform3D(translation=position[0], quaternion=quat[0], scale=scale[0]))
        sink.static(f"{entity}/part_{number + 1}" if number else entity, *components)


def decompose(
    matrices: NDArray[np.floating],
) -> tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]:
    """Positions [T, 3], quaternions [T, 4] and scales [T, 3] of 4x4 matrices; mirrored ones get a negative x scale."""
    linear = matrices[:, :3, :3]
    scale = np.linalg.norm(linear, axis=1)
    scale[np.linalg.det(linear) < 0, 0] *= -1
    rotation = linear / np.where(scale == 0, 1, scale)[:, None, :]
    return matrices[:, :3, 3], quat_from_matrix(rotation), scale


def step_blocks(steps: int) -> list[NDArray[np.intp]]:
    """All steps in runs that are logged together: only one run of poses is in memory at a time."""
    return [np.arange(start, min(start + BLOCK_STEPS, steps)) for start in range(0, steps, BLOCK_STEPS)]


class LoggedTrack:
    """Poses of one entity, logged where they change, block by block."""

    def __init__(self, sink: Sink, entity: str) -> None:
        self.entity = entity
        self.scale: NDArray[np.floating] = np.ones(3)
        """Of the first pose; the logged ones leave it out."""
        self._sink = sink
        self._last = np.eye(4)
        self._last_quat = np.array([[0.0, 0, 0, 1]])
        self._coarse = np.full((1, 8), np.nan)
        self._met = self._hides = False

    def log(self, steps: NDArray[np.integer], matrices: NDArray[np.floating]) -> None:
        """Poses [n, 4, 4] at the next ``steps`` [n], at least one; NaN where it was not in the world."""
        import rerun as rr

        there = np.asarray(np.isfinite(matrices).reshape(len(matrices), 16).all(axis=1))
        known = np.maximum.accumulate(np.where(there, np.arange(1, len(there) + 1), 0))
        position, quat, scale = decompose(np.concatenate([self._last[None], matrices])[known])
        quat = quat_sign_continuous(np.concatenate([self._last_quat, quat]))[1:]
        if there.any():
            if not self._met:
                self._met, self.scale = True, scale[np.argmax(there)]
            self._last, self._last_quat = matrices[np.flatnonzero(there)[-1]], quat[-1:]
        # 20 µm steps: rounding noise of a thing at rest makes no new row, and nothing drifts.
        coarse = np.concatenate([np.round(np.concatenate([position, quat], 1) / 2e-5), there[:, None]], axis=1)
        chosen = np.flatnonzero(np.any(np.diff(np.concatenate([self._coarse, coarse]), axis=0) != 0, axis=1))
        self._coarse = coarse[-1:]
        if not len(chosen):
            return
        self._hides |= not there.all()  # from then on every row says whether it is seen
        shown = np.where(there[chosen, None], 1.0, HIDDEN) * np.ones(3) if self._hides else None
        columns = rr.Transform3D.columns(translation=position[chosen], quaternion=quat[chosen], scale=shown)
        self._sink.columns(self.entity, steps[chosen], columns)


# --- skinned bodies ---------------------------------------------------------------------------------------------------
def log_skins(sink: Sink, recording: Recording, replay: Posed, skin_every: int, *, share: float = 1.0) -> None:
    """Vertices of skinned bodies at a reduced rate, in the root frame of their agent, which moves at the full rate."""
    import rerun as rr

    skins = [(i, d) for i, d in enumerate(replay.drawables) if d.deformable and len(d.mesh.faces)]
    if not skins or not len(recording):
        return
    thin = {i: thin_mesh(d.mesh, SKIN_VERTICES) for i, d in skins}
    per_sample = sum(12 * len(t.keep) for t in thin.values())
    every = max(1, skin_every, int(np.ceil(len(recording) * per_sample / (share * SKIN_BYTES))))
    steps = np.arange(0, len(recording), every)
    for index, drawable in skins:
        keep = thin[index].keep
        # Skinning makes all vertices of each sample: in blocks, so that memory stays small.
        blocks = [replay.vertices(index, part)[:, keep] for part in np.array_split(steps, len(steps) // 64 + 1)]
        vertices, rows, entity = np.concatenate(blocks), steps, f"world/objects/{entity_part(drawable.name)}"
        if _has_root(recording, drawable.agent):
            pose = recording.agent_column(drawable.agent, "base_pose")[steps].astype(np.float64)
            vertices = transform_points(pose_to_matrix(pose_inverse(pose)), vertices).astype(np.float32)
            entity = f"world/{entity_part(recording.agents[drawable.agent].name)}/body"
        changed = np.abs(np.diff(vertices, axis=0)).max((1, 2)) > 2e-4
        chosen = np.flatnonzero(np.concatenate([[True], changed]))
        vertices, rows = vertices[chosen], rows[chosen]
        look = rr.Mesh3D.from_fields(
            triangle_indices=thin[index].faces, vertex_colors=baked_colors(drawable.mesh)[keep], clear_unset=False
        )
        sink.static(entity, look)
        columns = rr.Mesh3D.columns(vertex_positions=vertices.reshape(-1, 3)).partition([len(keep)] * len(rows))
        sink.columns(entity, rows, columns)
