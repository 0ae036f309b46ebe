"""A reader of files for Foxglove that knows no more than the viewer: message schemas, transforms, glTF turned to +Z up."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from h3data.geometry import pose_to_matrix

TURN = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""What Foxglove and Lichtblick do to every glTF model: +Y up becomes +Z up."""


def matrix(position: Any, turn: Any) -> np.ndarray:
    return pose_to_matrix([position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w])


def nanoseconds(stamp: Any) -> int:
    return stamp.seconds * 1_000_000_000 + stamp.nanos


class File:
    """All messages of a file, decoded by the descriptors in it; checksums are verified."""

    def __init__(self, path: Path) -> None:
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
            summary = reader.get_summary()
            assert summary is not None
            self.schemas = {c.topic: summary.schemas[c.schema_id] for c in summary.channels.values()}
            self.messages: dict[str, list[tuple[int, Any]]] = {topic: [] for topic in self.schemas}
            self.times = []
            for _, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
                self.messages[channel.topic].append((message.log_time, decoded))
                self.times.append(message.log_time)

    def frames(self, time_ns: int) -> dict[str, np.ndarray]:
        """4x4 of every frame in the root, as of a time."""
        told: dict[str, tuple[str, np.ndarray]] = {}
        for t, message in self.messages["/tf"]:
            if t <= time_ns:
                for tf in message.transforms:
                    told[tf.child_frame_id] = (tf.parent_frame_id, matrix(tf.translation, tf.rotation))

        def in_root(name: str) -> np.ndarray:
            return in_root(told[name][0]) @ told[name][1] if name in told else np.eye(4)

        roots = {parent for parent, _ in told.values()} - set(told)
        assert len(roots) <= 1, "the tree is not connected"
        return {name: in_root(name) for name in told}

    def entities(self, time_ns: int) -> Iterator[Any]:
        """Everything that a viewer shows at a time."""
        for topic in self.messages:
            if topic.startswith("/scene_update"):
                shown: dict[str, Any] = {}
                for t, update in self.messages[topic]:
                    if t <= time_ns:
                        if update.deletions:
                            shown.clear()
                        shown |= {entity.id: entity for entity in update.entities}
                yield from shown.values()

    def models(self, time_ns: int) -> Iterator[tuple[str, np.ndarray, bytes]]:
        """``(entity, matrix from glTF to the root, GLB)`` of every model at a time."""
        frames = self.frames(time_ns)
        for entity in self.entities(time_ns):
            for model in entity.models:
                scale = np.diag([model.scale.x, model.scale.y, model.scale.z, 1])
                own = matrix(model.pose.position, model.pose.orientation) @ scale @ TURN
                yield entity.id, frames[entity.frame_id] @ own, model.data
