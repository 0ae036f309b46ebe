"""Cameras in a Rerun file: frustum, track, and what they saw, as stills that every viewer shows or as the video itself."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.render.camera import Camera
from h3data.replay import Replay, camera_track
from h3data_viewers.rerun.rerun_bodies import LoggedTrack, decompose, entity_part, step_blocks
from h3data_viewers.rerun.rerun_sink import Sink

Pictures = Literal["stills", "video"]
STILL_WIDTH = 320
STILL_EVERY = 5
"""Frames per still. Together 1.4 MB and 0.7 CPU-s for 1,500 frames of a 640x480 video."""
JPEG_QUALITY = 80
BATCH = 64
"""Stills that are held before they go to the file."""


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
    drawn: Iterable[tuple[int, NDArray[np.uint8]]] | None = None
    """In place of a video: steps and their pictures, sRGB [H, W, 3]."""

    @property
    def seen(self) -> bool:
        """Whether there are pictures."""
        return self.video is not None or self.drawn is not None


def drawn_feed(replay: Replay, name: str) -> CameraFeed:
    """A camera of a replay, by name or file as `h3data.replay.camera_track`, with stills drawn for the viewer."""
    track = camera_track(replay, name)
    shrink = min(1.0, STILL_WIDTH / track.camera.width)
    small = replace(track, camera=scaled(track.camera, shrink))
    steps = range(0, len(replay), STILL_EVERY)
    frames = replay.frames([small], steps, outputs=("rgb",))
    pictures = ((step, images[0]["rgb"]) for step, images in frames)
    return CameraFeed(camera=track.camera, poses=track.poses, drawn=pictures)


def scaled(camera: Camera, factor: float) -> Camera:
    """The same view in a picture of another size."""
    return replace(
        camera, width=max(round(camera.width * factor), 1), height=max(round(camera.height * factor), 1),
        fx=camera.fx * factor, fy=camera.fy * factor, cx=camera.cx * factor, cy=camera.cy * factor,
    )  # fmt: skip


def log_camera(sink: Sink, feed: CameraFeed, *, pictures: Pictures) -> str:
    """Log one camera, its track and its pictures; returns the path of its entity.

    ``video`` embeds the file as it is: smooth, but Rerun's desktop viewer plays H.264 only beside an installed FFmpeg
    (AV1 without). ``stills`` are JPEGs of some frames that every viewer shows. Only perspective cameras have a frustum.
    """
    import rerun as rr

    camera = feed.camera
    entity = f"world/cameras/{entity_part(camera.name)}"
    poses = np.asarray(camera.pose)[None] if feed.poses is None else feed.poses
    if len(poses) == 1:
        position, quat, _ = decompose(np.asarray(poses, np.float64))
        sink.static(entity, rr.Transform3D(translation=position[0], quaternion=quat[0]))
    else:
        track = LoggedTrack(sink, entity)
        for steps in step_blocks(len(poses)):
            track.log(steps, np.asarray(poses[steps], np.float64))
    small = scaled(camera, min(1.0, STILL_WIDTH / camera.width))
    if len(sink.time_ns) and feed.drawn is not None:
        _log_stills(sink, f"{entity}/image", _encoded(feed.drawn))
        camera = small
    elif len(sink.time_ns) and feed.video is not None:
        if pictures == "video":
            _log_video(sink, f"{entity}/image", feed.video, feed.steps)
        else:
            _log_stills(sink, f"{entity}/image", _stills_of_video(sink, feed, (small.width, small.height)))
            camera = small
    if camera.projection == "perspective":
        pinhole = rr.Pinhole(
            image_from_camera=camera.intrinsics,
            resolution=[camera.width, camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.5,
        )
        sink.static(entity, pinhole)
    return sink.path(entity)


def frame_steps(frames: int, steps: int) -> NDArray[np.int64]:
    """Step that each of ``frames`` video frames shows if they are spread evenly over ``steps`` rows, shape [frames]."""
    return np.floor(np.arange(frames) * steps / max(frames, 1)).astype(np.int64)


def _log_video(sink: Sink, entity: str, video: Path, steps: NDArray[np.integer] | None) -> None:
    import rerun as rr

    asset = rr.AssetVideo(path=video)
    try:
        stamps = np.asarray(asset.read_frame_timestamps_nanos())
    except RuntimeError as error:
        raise InputError(f"Not a video that Rerun can read ({error}): {video}") from None
    rows = frame_steps(len(stamps), len(sink.time_ns)) if steps is None else np.asarray(steps)
    count = min(len(stamps), len(rows))
    sink.static(entity, asset)
    frames = rr.VideoFrameReference.columns_nanos(stamps[:count])
    sink.columns(entity, rows[:count], frames)


def _log_stills(sink: Sink, entity: str, stills: Iterable[tuple[int, bytes]]) -> None:
    """Log JPEGs by step, some at a time."""
    import rerun as rr

    waiting = iter(stills)
    while batch := list(islice(waiting, BATCH)):
        blobs = [image for _, image in batch]
        columns = rr.EncodedImage.columns(blob=blobs, media_type=["image/jpeg"] * len(blobs))
        sink.columns(entity, [step for step, _ in batch], columns)


def _encoded(drawn: Iterable[tuple[int, NDArray[np.uint8]]]) -> Iterator[tuple[int, bytes]]:
    for step, rgb in drawn:
        yield step, _jpeg(rgb[..., ::-1])


def _jpeg(bgr: NDArray[Any]) -> bytes:
    import cv2

    return cv2.imencode(".jpg", np.ascontiguousarray(bgr), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


def _stills_of_video(sink: Sink, feed: CameraFeed, size: tuple[int, int]) -> list[tuple[int, bytes]]:
    """Some frames with the steps that they show; how many there are in all is known only at the end."""
    assert feed.video is not None
    stills = list(_stills(feed.video, size))
    if not stills:
        raise InputError(f"The camera's video has no frames: {feed.video}")
    total = stills.pop()[0]
    steps = frame_steps(total, len(sink.time_ns)) if feed.steps is None else np.asarray(feed.steps)
    return [(int(steps[number]), image) for number, image in stills if number < len(steps)]


def _stills(video: Path, size: tuple[int, int]) -> Iterator[tuple[int, bytes]]:
    """``(frame number, JPEG)`` of some frames; last comes ``(number of frames, b"")``."""
    import av
    import av.error

    number = 0
    try:
        with av.open(str(video)) as container:
            track = container.streams.video[0]
            track.thread_type = "AUTO"
            for frame in container.decode(track):
                if number % STILL_EVERY == 0:
                    pixels = frame.reformat(width=size[0], height=size[1], format="bgr24").to_ndarray()
                    yield number, _jpeg(pixels)
                number += 1
    except (av.error.FFmpegError, IndexError) as error:
        raise InputError(f"Not a video that can be read ({error}): {video}") from None
    if number:
        yield number, b""
