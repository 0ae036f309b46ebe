"""Camera logs ``<recording>.cameras.json``, with the videos of a recording, their cameras, and camera poses by frame.

The file also makes rendering resumable: a listed output that was made from the same inputs is not rendered again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from h3data.commands.command import write_text
from h3data.errors import InputError
from h3data.plugins import own_version
from h3data.replay import CameraTrack, Replay
from h3data_pipelines.outputs import Target


class CameraLog:
    """Camera log of one recording in one folder, which may be missing or from an earlier run."""

    def __init__(
        self, folder: Path, stem: str, replay: Replay, steps: range, *, samples: int = 1, backend: str = "cpu"
    ) -> None:
        self.path = folder / f"{stem}.cameras.json"
        self._folder, self._stem, self._replay, self._steps = folder, stem, replay, steps
        self._samples, self._backend = samples, backend
        self._recording = _digest_of_recording(replay)
        self._cameras: dict[str, Any] = {}
        if self.path.exists():
            try:
                self._cameras = dict(json.loads(self.path.read_bytes())["cameras"])
            except (ValueError, KeyError, TypeError):
                raise InputError(
                    f"Not a file of ours; remove it or choose another -o: {self.path}", code="H3-JOB-013"
                ) from None

    def made_of(self, track: CameraTrack, target: Target) -> str:
        """Return a digest of everything that an output depends on."""
        camera = _intrinsics(track)
        things = [own_version(), self._recording, str(self._steps), target.output, target.form, json.dumps(camera)]
        things += [] if self._replay.people == "skin" else [self._replay.people]
        things += ["stand-ins"] if self._replay.stand_ins else []
        things += [self._replay.light] if target.output == "rgb" and self._replay.light != "flat" else []
        things += [f"{self._samples} samples"] if target.output == "rgb" and self._samples > 1 else []
        things += [] if self._backend == "cpu" else [self._backend]
        poses = np.ascontiguousarray(track.poses, np.float64).tobytes()
        nears = b"" if track.nears is None else np.ascontiguousarray(track.nears, np.float64).tobytes()
        return hashlib.blake2b("\n".join(things).encode() + poses + nears, digest_size=16).hexdigest()

    def has(self, track: CameraTrack, target: Target) -> bool:
        """Return whether an output exists, is complete and was made from the same inputs."""
        outputs = self._cameras.get(track.camera.name, {}).get("outputs", {})
        entry = outputs.get(target.output, {}) if isinstance(outputs, Mapping) else {}
        return entry.get("made_of") == self.made_of(track, target) and target.path.exists()

    def forget(self, track: CameraTrack, targets: Sequence[Target]) -> None:
        """Remove outputs that are about to be replaced from the log."""
        outputs = self._cameras.get(track.camera.name, {}).get("outputs", {})
        stale = [target.output for target in targets if target.output in outputs]
        for output in stale:
            del outputs[output]
        if stale:
            self._write()

    def add(self, track: CameraTrack, targets: Sequence[Target], *, fps: float) -> None:
        """Add complete outputs to the log."""
        steps = list(self._steps)
        times = self._replay.recording.columns["time_ns"][steps]
        before = self._cameras.get(track.camera.name, {}).get("outputs", {})
        outputs = {
            target.output: {
                "file": target.path.name,
                "form": target.form,
                "values": target.meaning,
                "made_of": self.made_of(track, target),
            }
            for target in targets
        }
        self._cameras[track.camera.name] = {
            **_intrinsics(track),
            "frames_per_second": fps,
            "outputs": {name: e for name, e in before.items() if (self._folder / e["file"]).exists()} | outputs,
            "steps": steps,
            "time_s": [round(float(t) * 1e-9, 9) for t in times],
            "camera_to_world": [np.round(track.at(step).pose, 7).tolist() for step in steps],
            **({} if track.nears is None else {"near": [round(track.at(step).near, 7) for step in steps]}),
        }
        self._write()

    def _write(self) -> None:
        content = {
            "recording": self._stem,
            "uid": self._replay.recording.episode.uid,
            "camera_frame": "OpenCV: x right, y down, z forward; pixel centres at +0.5; world +Y up, metres",
            "cameras": self._cameras,
        }
        write_text(self.path, json.dumps(content) + "\n")


def _intrinsics(track: CameraTrack) -> dict[str, Any]:
    camera = track.camera
    more = {name: getattr(camera, name) for name in ("projection", "near", "far") if hasattr(camera, name)}
    return {
        "width": camera.width,
        "height": camera.height,
        "K": camera.intrinsics.tolist(),
        "hidden_layers": list(camera.hidden_layers),
        **{k: v if v != float("inf") else None for k, v in more.items()},
    }


def _digest_of_recording(replay: Replay) -> str:
    recording = replay.recording
    digest = hashlib.blake2b(recording.episode.uid.encode(), digest_size=16)
    for name in sorted(recording.columns):
        column = np.ascontiguousarray(recording.columns[name])
        digest.update(f"{name} {column.dtype} {column.shape}".encode())
        digest.update(column.tobytes())
    digest.update(json.dumps(sorted(replay.missing.items())).encode())
    return digest.hexdigest()
