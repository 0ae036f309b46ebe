"""Recordings, replays made by hand, and a reader of Rerun files, for tests of the Rerun view."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from h3data.geometry import (
    ground_pose,
    pose_to_matrix,
    quat_from_axis_angle,
    quat_from_heading,
    quat_to_matrix,
    transform_points,
)
from h3data.mesh.mesh import Mesh
from h3data.recording.records import STEP_NS, Agent, Episode, Event, Recording, SkillSpan

STEPS = 60


def sphere(points: int = 400, *, normals: bool = True) -> Mesh:
    """A closed, round mesh of ``points`` vertices: the hull of a Fibonacci spiral."""
    from scipy.spatial import ConvexHull

    k = np.arange(points) + 0.5
    polar, angle = np.arccos(1 - 2 * k / points), np.pi * (1 + 5**0.5) * k
    vertices = np.stack([np.cos(angle) * np.sin(polar), np.cos(polar), np.sin(angle) * np.sin(polar)], 1)
    faces = ConvexHull(vertices).simplices
    colors = np.random.default_rng(0).integers(0, 255, (points, 3), np.uint8)
    v = vertices.astype(np.float32)
    return Mesh(vertices=v, faces=faces.astype(np.int32), colors=colors, normals=v if normals else None)


@dataclass(frozen=True, kw_only=True)
class Thing:
    name: str
    mesh: Mesh
    matrix: np.ndarray
    layer: str = ""
    agent: int = -1
    moving: bool = False
    deformable: bool = False


class Stage:
    """A replay made by hand: floor, ceiling, a mirrored and scaled lamp, a cup that vanishes, a robot leg, a person."""

    def __init__(self, recording: Recording) -> None:
        eye = np.eye(4)
        lamp = pose_to_matrix([1.0, 1.0, 1.0, *quat_from_heading(0.7)])
        lamp[:3, :3] *= [0.5, 2.0, -1.0]
        ball = sphere()
        self.base = {i: pose_to_matrix(recording.agent_column(i, "base_pose").astype(float)) for i in (0, 1)}
        self.drawables = [
            Thing(name="floor", mesh=sphere(normals=False), matrix=np.diag([5, 0.1, 5, 1.0])),
            Thing(name="slab", mesh=ball, matrix=eye, layer="ceiling"),
            Thing(name="lamp/left hand", mesh=ball, matrix=lamp),
            Thing(name="cup", mesh=ball, matrix=eye, moving=True),
            Thing(name="spot/leg", mesh=ball, matrix=eye, moving=True, agent=0),
            Thing(name="alex", mesh=ball, matrix=eye, moving=True, deformable=True, agent=1),
            Thing(
                name="nothing",
                mesh=Mesh(
                    vertices=np.zeros((0, 3), np.float32),
                    faces=np.zeros((0, 3), np.int32),
                    colors=np.zeros((0, 3), np.uint8),
                ),
                matrix=eye,
            ),
        ]

    def matrices(self, index: int, steps: np.ndarray) -> np.ndarray:
        return self._tracks(index)[steps]

    def _tracks(self, index: int) -> np.ndarray:
        k = np.arange(STEPS)
        if self.drawables[index].name == "cup":
            out = np.tile(pose_to_matrix([2.0, 1.0, 0.0, *quat_from_axis_angle([1, 2, 3], 0.5)]), (STEPS, 1, 1))
            out[:, :3, :3] *= 0.1
            out[30:, 1, 3] = 1 + 0.02 * k[:30]
            out[10:20] = np.nan
            return out.astype(np.float32)
        swing = quat_from_axis_angle([0, 0, 1], 0.5 * np.sin(k / 4))
        part = pose_to_matrix(np.concatenate([np.tile([0.3, 0.5, 0.1], (STEPS, 1)), swing], 1))
        part[:, :3, :3] *= [0.05, 0.3, 0.05]
        return (self.base[0] @ part).astype(np.float32)

    def vertices(self, index: int, steps: np.ndarray) -> np.ndarray:
        local = self.drawables[index].mesh.vertices * (1 + 0.1 * np.sin(steps / 5))[:, None, None]
        return transform_points(self.base[1][steps], local).astype(np.float32)


def example(**changes) -> Recording:
    k = np.arange(STEPS)
    robot = ground_pose(np.stack([0.05 * k, 0 * k], 1), 0.02 * k).astype(np.float32)
    human = ground_pose(np.stack([0.01 * k + 3, 0 * k + 0.2], 1), -0.03 * k).astype(np.float32)
    geodesic = np.linalg.norm(robot[:, :3] - human[:, :3], axis=1)
    geodesic[0] = np.inf
    fields = {
        "episode": Episode(uid="7a1e", episode_id="e-1", task="social_nav", scene="stage", info={}),
        "agents": (
            Agent(name="spot", kind="robot", skill_names=("find", "follow")),
            Agent(name="alex", kind="human", motion_names=("walk", "stand")),
        ),
        "columns": {
            "time_ns": k * STEP_NS,
            "agent_0.base_pose": robot,
            "agent_1.base_pose": human,
            "agent_0.skill": np.where(k < 20, 0, np.where(k < 50, 1, -1)).astype(np.int32),
            "agent_1.motion_id": (k // 40).astype(np.int32),
            "metrics.geodesic_agents": geodesic.astype(np.float32),
            "metrics.collision": k == STEPS - 1,
        },
        "skills": (
            SkillSpan(agent=0, name="find", target="alex", start_step=0, end_step=19),
            SkillSpan(agent=0, name="follow", start_step=20, end_step=49, outcome="failed", reason="lost"),
        ),
        "events": (Event(step=STEPS - 1, agent=0, kind="collision", target="alex"),),
    }
    return Recording(**{**fields, **changes})


class File:
    """Chunks of an ``.rrd`` by entity and component; latest value at or before a step, as the viewer shows it."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader

        reader = RrdReader(path)
        self.recordings, self.blueprints = reader.recordings(), reader.blueprints()
        self.batches: dict[str, list] = {}
        for chunk in reader.stream().to_chunks():
            self.batches.setdefault(chunk.entity_path, []).append((chunk.is_static, chunk.to_record_batch()))

    def column(self, entity: str, component: str) -> tuple[Any, list]:
        """Steps (None if static) and values of one component, in the order of the steps."""
        steps, values = [], []
        for static, batch in self.batches[entity]:
            if component in batch.schema.names:
                got = batch.column(component).to_pylist()
                if static:
                    return None, got[0]
                steps += batch.column("step").to_pylist()
                values += got
        order = np.argsort(steps, kind="stable")
        return np.array(steps)[order], [values[i] for i in order]

    def at(self, entity: str, component: str, step: int):
        steps, values = self.column(entity, component)
        return values if steps is None else values[np.searchsorted(steps, step, side="right") - 1]

    def matrix(self, entity: str, step: int) -> np.ndarray:
        """4x4 of an entity relative to its parent, at a step."""
        out = np.eye(4)
        names = {n for _, batch in self.batches.get(entity, []) for n in batch.schema.names}
        if "Transform3D:quaternion" in names:
            out[:3, :3] = quat_to_matrix(np.array(self.at(entity, "Transform3D:quaternion", step)[0]))
            out[:3, 3] = self.at(entity, "Transform3D:translation", step)[0]
        if "Transform3D:scale" in names:
            out[:3, :3] *= np.array(self.at(entity, "Transform3D:scale", step)[0])
        return out
