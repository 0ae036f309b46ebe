"""Cameras in a Rerun file: their frustum, track and images, which are stills for every viewer or an embedded video."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.progress import progress
from h3data.render.camera import Camera
from h3data.replay import Replay, camera_track
from h3data_viewers.rerun.entities import entity_part
from h3data_viewers.rerun.sink import Sink
from h3data_viewers.rerun.transforms import LoggedTrack, decompose, step_blocks

ImageStorage = Literal["stills", "video"]
STILL_WIDTH = 320
STILL_EVERY = 5
"""Number of video frames per still. Stills of a 1,500-frame 640x480 video take 1.4 MB and 0.7 s of CPU time."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraFeed:
    """A camera with its track and its images."""

    camera: Camera
    """Intrinsics and name of the camera."""
    poses: NDArray[np.floating] | None = None
    """Matrices from camera (OpenCV axes) to world, [T, 4, 4], or [1, 4, 4] for a static camera; None selects
    `Camera.pose`."""
    video: Path | None = None
    """MP4 file with the images of the camera; None if there is no video."""
    steps: NDArray[np.integer] | None = None
    """Step of each video frame; None if the frames are spread evenly over the recording."""
    stills: Iterable[tuple[int, NDArray[np.uint8]]] | None = None
    """Pairs of step and sRGB image [H, W, 3], instead of a video."""

    @property
    def has_images(self) -> bool:
        """Return whether the camera has a video or stills."""
        return self.video is not None or self.stills is not None


def rendered_feed(replay: Replay, name: str) -> CameraFeed:
    """Return a camera of a replay, by name or file as in `h3data.replay.camera_track`, with newly rendered stills."""
    track = camera_track(replay, name)
    shrink = min(1.0, STILL_WIDTH / track.camera.width)
    small = replace(track, camera=scaled(track.camera, shrink))
    steps = range(0, len(replay), STILL_EVERY)
    frames = progress(
        replay.frames([small], steps, outputs=("rgb",)),
        total=len(steps),
        desc=f"render {name}",
        unit="frame",
        leave=False,
    )
    stills = ((step, images[0]["rgb"]) for step, images in frames)
    return CameraFeed(camera=track.camera, poses=track.poses, stills=stills)


def scaled(camera: Camera, factor: float) -> Camera:
    """Return a camera with the same view whose images are larger by ``factor``, and at least 1x1 pixel."""
    return camera.resized(*(max(round(side * factor), 1) for side in (camera.width, camera.height)))


def camera_entity(camera: Camera) -> str:
    """Return the entity path of a camera."""
    return f"world/cameras/{entity_part(camera.name)}"


def log_camera(sink: Sink, feed: CameraFeed, *, images: ImageStorage) -> None:
    """Log a camera, its track and its images as `camera_entity`.

    With ``images="video"`` the video file is embedded unchanged: smooth, but Rerun's desktop viewer plays H.264 only
    where FFmpeg is installed (AV1 plays without). With ``images="stills"`` it is stored as JPEGs of every fifth frame,
    which every viewer shows. Only perspective cameras get a frustum.
    """
    import rerun as rr

    camera = feed.camera
    entity = camera_entity(camera)
    poses = np.asarray(camera.pose)[None] if feed.poses is None else feed.poses
    if len(poses) == 1:
        position, quat, _ = decompose(np.asarray(poses, np.float64))
        sink.static(entity, rr.Transform3D(translation=position[0], quaternion=quat[0]))
    else:
        track = LoggedTrack(sink, entity)
        for steps in step_blocks(len(poses)):
            track.log(steps, np.asarray(poses[steps], np.float64))
    small = scaled(camera, min(1.0, STILL_WIDTH / camera.width))
    if len(sink.time_ns) and feed.stills is not None:
        # stills are RGB, and OpenCV encodes BGR
        _log_stills(sink, f"{entity}/image", ((step, _jpeg(rgb[..., ::-1])) for step, rgb in feed.stills))
        camera = small
    elif len(sink.time_ns) and feed.video is not None:
        if images == "video":
            _log_video(sink, f"{entity}/image", feed.video, feed.steps)
        else:
            _log_stills(sink, f"{entity}/image", _stills_of_video(sink, feed, (small.width, small.height)))
            camera = small
    # `camera` has the size of the images that were logged: the pinhole has to fit their pixels
    if camera.projection == "perspective":
        pinhole = rr.Pinhole(
            image_from_camera=camera.intrinsics,
            resolution=[camera.width, camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.5,
        )
        sink.static(entity, pinhole)


def frame_steps(frames: int, steps: int) -> NDArray[np.int64]:
    """Return the step of each of ``frames`` video frames spread evenly over ``steps`` steps, shape [frames]."""
    return np.floor(np.arange(frames) * steps / max(frames, 1)).astype(np.int64)


def _log_video(sink: Sink, entity: str, video: Path, steps: NDArray[np.integer] | None) -> None:
    import rerun as rr

    asset = rr.AssetVideo(path=video)
    try:
        stamps = np.asarray(asset.read_frame_timestamps_nanos())
    except RuntimeError as error:
        raise InputError(f"Expected a video that Rerun can read ({error}): {video}", code="H3-VIEW-016") from None
    rows = frame_steps(len(stamps), len(sink.time_ns)) if steps is None else np.asarray(steps)
    count = min(len(stamps), len(rows))
    sink.static(entity, asset)
    frames = rr.VideoFrameReference.columns_nanos(stamps[:count])
    sink.columns(entity, rows[:count], frames)


def _log_stills(sink: Sink, entity: str, stills: Iterable[tuple[int, bytes]]) -> None:
    """Log pairs of step and JPEG, 64 at a time, so that rendered stills do not pile up in memory."""
    import rerun as rr

    remaining = iter(stills)
    while batch := list(islice(remaining, 64)):
        blobs = [image for _, image in batch]
        columns = rr.EncodedImage.columns(blob=blobs, media_type=["image/jpeg"] * len(blobs))
        sink.columns(entity, [step for step, _ in batch], columns)


def _jpeg(bgr: NDArray[Any]) -> bytes:
    import cv2

    return cv2.imencode(".jpg", np.ascontiguousarray(bgr), [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()


def _stills_of_video(sink: Sink, feed: CameraFeed, size: tuple[int, int]) -> list[tuple[int, bytes]]:
    """Decode every fifth frame of the feed's video into pairs of step and JPEG, of ``size`` (width, height)."""
    import av
    import av.error

    stills, number = [], 0
    try:
        with av.open(str(feed.video)) as container:
            track = container.streams.video[0]
            # by default PyAV has a thread for each slice of a frame, and most videos have one slice
            track.thread_type = "AUTO"
            for frame in container.decode(track):
                if number % STILL_EVERY == 0:
                    pixels = frame.reformat(width=size[0], height=size[1], format="bgr24").to_ndarray()
                    stills.append((number, _jpeg(pixels)))
                number += 1
    except (av.error.FFmpegError, IndexError) as error:
        raise InputError(f"Expected a readable video ({error}): {feed.video}", code="H3-VIEW-017") from None
    if not stills:
        raise InputError(f"The camera's video has no frames: {feed.video}", code="H3-VIEW-015")
    # Containers report unreliable frame counts: the number of frames, hence their steps, is known after decoding.
    steps = frame_steps(number, len(sink.time_ns)) if feed.steps is None else np.asarray(feed.steps)
    return [(int(steps[k]), image) for k, image in stills if k < len(steps)]
