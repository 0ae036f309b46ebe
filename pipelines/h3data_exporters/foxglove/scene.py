"""Scene entities of a recording, attached to frames, with the poses of these frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import IDENTITY_POSE, Array
from h3data.mesh.mesh import Mesh
from h3data.recording.records import Recording
from h3data_exporters.foxglove import messages as messages
from h3data_exporters.foxglove.frames import WORLD, FrameTree
from h3data_exporters.foxglove.rigid_pieces import rigid_pieces
from h3data_exporters.glb_write import glb_bytes
from h3data_exporters.posed_parts import PosedPart

TOPIC = "/scene_update"
_TAG_HEIGHT_M = {"human": 1.95, "robot": 0.95}


@dataclass(eq=False)
class Group:
    """Entities of a scene that appear and disappear together, published on one topic.

    Viewers switch topics on and off, and show the last message of each topic after a jump in time. Agents that leave
    the world at times therefore have a topic of their own, each of whose messages describes the whole group.
    """

    topic: str
    there: NDArray[np.bool_] | None
    """Mask of the steps in which the parts are in the world, shape [T]; None means all steps."""
    entities: list[messages.SceneEntity] = field(default_factory=list)

    def changes(self, step: int) -> bool:
        """Return whether the group has changed at a step, so that a message is needed."""
        return step == 0 or (self.there is not None and self.there[step] != self.there[step - 1])

    def update(self, step: int, time_ns: int) -> messages.SceneUpdate:
        """Return the message to publish at a step."""
        if self.there is None or self.there[step]:
            # one message object for all steps: its models may be megabytes
            for entity in self.entities:
                entity.timestamp.CopyFrom(messages.stamp(time_ns))
            return messages.scene_update(self.entities)
        return messages.scene_cleared(time_ns)


class FoxgloveScene:
    """Frames and entities of the parts of a recording."""

    def __init__(self, recording: Recording, parts: Sequence[PosedPart]) -> None:
        self.frames = FrameTree()
        self.groups: dict[str, Group] = {}
        self._recording = recording
        self._glbs: dict[int, bytes] = {}
        self._agents = [self.frames.add(agent.name or f"agent_{i}") for i, agent in enumerate(recording.agents)]
        self._of_part = [self._add(part) for part in parts]
        for i, agent in enumerate(recording.agents):
            frame = self.frames.names[self._agents[i]]
            tag = messages.name_tag(agent.name, _TAG_HEIGHT_M[agent.kind])
            self._group(agent=i).entities.append(messages.entity(0, frame, frame, texts=[tag]))

    def agent_frame(self, agent: int) -> str:
        """Return the name of the root frame of an agent."""
        return self.frames.names[self._agents[agent]]

    def world_poses(self, steps: NDArray[np.integer], parts: Sequence[PosedPart]) -> Array:
        """Return the world poses of all frames of agents and present parts at ``steps``, shape [T, F, 7]."""
        columns = [self._recording.agent_column(i, "base_pose")[steps, None] for i in range(len(self._agents))]
        for part, count in zip(parts, self._of_part, strict=True):
            if count:
                columns.append(part.poses[:, None] if part.skeleton is None else part.skeleton.poses)
        return np.concatenate([np.zeros((len(steps), 0, 7)), *columns], axis=1)

    def _add(self, part: PosedPart) -> int:
        """Add the entities of a part, and return its number of frames."""
        parent = self._parent(part)
        if part.skeleton is not None:
            owner = part.name if parent < 0 else self.frames.names[parent]
            first = len(self.frames.names)
            for name, above in zip(part.skeleton.names, part.skeleton.parents, strict=True):
                self.frames.add(f"{owner}/{name}", parent if above < 0 else first + above)
            for joint, piece in rigid_pieces(part.mesh, part.skeleton):
                self._show(part, self.frames.names[first + joint], glb_bytes([piece]), IDENTITY_POSE, np.ones(3))
            return len(part.skeleton.names)
        # without a separate frame: most of a home stands still, and frames are sent again and again
        if part.body is not None and part.body.moving < 0 and len(part.poses) == 1:
            self._show(part, WORLD, self._glb(part.mesh), part.poses[0], part.scale)
            return 0
        frame = self.frames.names[self.frames.add(part.name, parent)]
        self._show(part, frame, self._glb(part.mesh), IDENTITY_POSE, part.scale)
        return 1

    def _parent(self, part: PosedPart) -> int:
        """Return the agent's frame for what its model draws, which is there when the agent is; else the world."""
        return self._agents[part.agent] if part.body is None and part.agent >= 0 else -1

    def _glb(self, mesh: Mesh) -> bytes:
        """Return the mesh as GLB, packed once per mesh; empty if there is nothing to see."""
        if id(mesh) not in self._glbs:
            self._glbs[id(mesh)] = glb_bytes([mesh]) if len(mesh.faces) else b""
        return self._glbs[id(mesh)]

    def _show(self, part: PosedPart, frame: str, glb: bytes, pose: Array, scale: Array) -> None:
        if glb:
            entities = self._group(part).entities
            name = f"{part.name if frame == WORLD else frame}#{len(entities)}"
            entities.append(messages.entity(0, frame, name, models=[messages.model(glb, pose, scale)]))

    def _group(self, part: PosedPart | None = None, *, agent: int = -1) -> Group:
        """Return the group of a part, or of an agent."""
        recording, body = self._recording, part.body if part else None
        if part is not None and body is None:
            agent = part.agent
        track, name = None, ""
        if body is not None and body.moving >= 0:
            track, name = recording.columns["object_pose"][:, body.moving], body.name
        elif body is None and agent >= 0:
            track, name = recording.agent_column(agent, "base_pose"), self.agent_frame(agent)
        there = None if track is None else np.asarray(np.isfinite(track).all(-1))
        # who is always there needs no topic of its own
        if there is not None and there.all():
            there = None
        layer = body.layer if body is not None and there is None else ""
        topic = f"{TOPIC}/{name}" if there is not None else f"{TOPIC}/{layer}" if layer else TOPIC
        return self.groups.setdefault(topic, Group(topic, there))
