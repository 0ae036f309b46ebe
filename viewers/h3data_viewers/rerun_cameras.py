"""Cameras in a Rerun file: frustum, track, and what they saw, as stills that every viewer shows or as the video itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.render.camera import Camera
from h3data_viewers.rerun_bodies import decompose, entity_part, log_track
from h3data_viewers.rerun_tracks import Timeline

if TYPE_CHECKING:
    import rerun as rr

Pictures = Literal["stills", "video"]
STILL_WIDTH = 320
STILL_EVERY = 5
"""Video frames per still. Together 1.4 MB and 0.7 CPU-s for 1,500 frames of 640x480."""
JPEG_QUALITY = 80


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraFeed:
    """A camera to show: where it was, and what it saw."""

    camera: Camera
    """Intrinsics and name."""
    poses: NDArray[np.floating] | None = None
    """4x4 camera (OpenCV) to world at every step, [T, 4, 4], or [1, 4, 4]; None: `Camera.pose` for ever."""
    video: Path | None = None
    """An MP4 file."""
    steps: NDArray[np.integer] | None = None
    """Step that each video frame shows; None: the frames are spread evenly over the recording."""


def log_camera(stream: rr.RecordingStream, timeline: Timeline, feed: CameraFeed, *, pictures: Pictures) -> str:
    """Log one camera, its track and its pictures; returns its entity.

    ``video`` embeds the file as it is: smooth, but Rerun's desktop viewer plays H.264 only beside an installed FFmpeg
    (AV1 without). ``stills`` are JPEGs of some frames that every viewer shows.
    """
    import rerun as rr

    camera = feed.camera
    entity = f"world/cameras/{entity_part(camera.name)}"
    poses = np.asarray(camera.pose)[None] if feed.poses is None else feed.poses
    if len(poses) == 1:
        position, quat, _ = decompose(np.asarray(poses, np.float64))
        stream.log(entity, rr.Transform3D(translation=position[0], quaternion=quat[0]), static=True, strict=True)
    else:
        log_track(stream, entity, timeline, np.asarray(poses, np.float64))
    shrink = 1.0
    if feed.video is not None and len(timeline.time_ns):
        if pictures == "video":
            _log_video(stream, timeline, f"{entity}/image", feed.video, feed.steps)
        else:
            shrink = min(1.0, STILL_WIDTH / camera.width)
            size = (round(camera.width * shrink), round(camera.height * shrink))
            _log_stills(stream, timeline, f"{entity}/image", feed.video, feed.steps, size)
    scaled = camera.intrinsics * np.array([[shrink], [shrink], [1.0]])
    pinhole = rr.Pinhole(
        image_from_camera=scaled,
        resolution=[round(camera.width * shrink), round(camera.height * shrink)],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.5,
    )
    stream.log(entity, pinhole, static=True, strict=True)
    return f"/{entity}"


def frame_steps(frames: int, steps: int) -> NDArray[np.int64]:
    """Step that each of ``frames`` video frames shows if they are spread evenly over ``steps`` rows, shape [frames]."""
    return np.floor(np.arange(frames) * steps / max(frames, 1)).astype(np.int64)


def _log_video(
    stream: rr.RecordingStream, timeline: Timeline, entity: str, video: Path, steps: NDArray[np.integer] | None
) -> None:
    import rerun as rr

    asset = rr.AssetVideo(path=video)
    try:
        stamps = np.asarray(asset.read_frame_timestamps_nanos())
    except RuntimeError as error:
        raise InputError(f"Not a video that Rerun can read ({error}): {video}") from None
    rows = frame_steps(len(stamps), len(timeline.time_ns)) if steps is None else np.asarray(steps)
    count = min(len(stamps), len(rows))
    stream.log(entity, asset, static=True, strict=True)
    frames = rr.VideoFrameReference.columns_nanos(stamps[:count])
    stream.send_columns(entity, timeline.at(rows[:count]), frames, strict=True)


def _log_stills(
    stream: rr.RecordingStream,
    timeline: Timeline,
    entity: str,
    video: Path,
    steps: NDArray[np.integer] | None,
    size: tuple[int, int],
) -> None:
    import rerun as rr

    stills = list(_stills(video, size))
    if not stills:
        raise InputError(f"The camera's video has no frames: {video}")
    total = stills[-1][0]
    numbers = np.array([number for number, image in stills if image])
    rows = frame_steps(total, len(timeline.time_ns)) if steps is None else np.asarray(steps)
    numbers = numbers[numbers < len(rows)]
    blobs = [image for _, image in stills if image][: len(numbers)]
    columns = rr.EncodedImage.columns(blob=blobs, media_type=["image/jpeg"] * len(blobs))
    stream.send_columns(entity, timeline.at(rows[numbers]), columns, strict=True)


def _stills(video: Path, size: tuple[int, int]) -> Iterator[tuple[int, bytes]]:
    """``(frame number, JPEG)`` of some frames; last comes ``(number of frames, b"")``."""
    import av
    import av.error
    import cv2

    number = 0
    try:
        with av.open(str(video)) as container:
            track = container.streams.video[0]
            track.thread_type = "AUTO"
            for frame in container.decode(track):
                if number % STILL_EVERY == 0:
                    pixels = frame.reformat(width=size[0], height=size[1], format="bgr24").to_ndarray()
                    yield number, cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
                number += 1
    except (av.error.FFmpegError, IndexError) as error:
        raise InputError(f"Not a video that can be read ({error}): {video}") from None
    if number:
        yield number, b""
