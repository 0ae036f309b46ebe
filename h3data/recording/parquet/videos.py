"""Videos of a dataset's cameras in LeRobot's layout: one MP4 per camera with the episodes of a shard in sequence.

Episodes are copied packet by packet, never encoded again. They must be H.264 without B-frames and start with a key
frame, so that packets are in the order of their frames and each section from a key frame on is a separate video.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError, InputError
from h3data.recording.parquet.files import FILES_PER_CHUNK, shard_path
from h3data.recording.parquet.moments import QUANTILES, Moments
from h3data.recording.storage import AnyPath, open_binary

MAX_FILE_S = 1000.0
"""Longest video file [s]. LeRobot compares timestamps within a file as float32 with a tolerance of 1e-4 s: from 1,024 s on,
neighbouring float32 numbers are farther apart than that."""
MAX_FILE_BYTES = 200 << 20
"""Size of a video file above which the next episode goes into another file, LeRobot's ``video_files_size_in_mb``
[bytes]."""


@dataclass(frozen=True, kw_only=True)
class VideoFeature:
    """Properties that all videos of one camera share."""

    camera: str
    width: int
    """Width of the encoded frames [px], an even number."""
    height: int
    codec: str = "h264"
    pixels: str = "yuv420p"

    @property
    def key(self) -> str:
        """Name of the feature in LeRobot's metadata."""
        return f"observation.images.{self.camera}"

    def lerobot(self, fps: int) -> dict[str, Any]:
        """Return the entry of the video in ``features`` of info.json."""
        return {
            "dtype": "video",
            "shape": [self.height, self.width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": self.height,
                "video.width": self.width,
                "video.codec": self.codec,
                "video.pix_fmt": self.pixels,
                "video.is_depth_map": False,
                "video.fps": fps,
                "video.channels": 3,
                "has_audio": False,
            },
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class EpisodeVideo:
    """Video of one episode by one camera: a section of a video file."""

    feature: VideoFeature
    path: AnyPath
    length: int
    """Number of frames."""
    fps: int
    moments: Moments
    """Moments of the channels R, G, B over all pixels, in 0..1."""
    start: int = 0
    """Index of the frame in the file at which the episode starts, a key frame."""

    def frames(self) -> Iterator[NDArray[np.uint8]]:
        """Decode the frames in order, each sRGB [height, width, 3].

        Raises:
            FormatError: the file is damaged or too short.
        """
        with ExitStack() as stack:
            count = 0
            for packet in _packets(self, stack):
                for frame in packet.decode():
                    yield frame.to_ndarray(format="rgb24")
                    count += 1
            if count != self.length:
                raise FormatError(
                    f"Expected {self.length} frames from frame {self.start} on, got {count}: {self.path}",
                    code="H3-RECORDING-086",
                )


def episode_video(root: AnyPath, row: Mapping[str, Any], feature: VideoFeature, *, fps: int) -> EpisodeVideo:
    """Return the video of an episode, from its row of the episode table.

    Raises:
        FormatError: the row is damaged.
    """
    at, stats = f"videos/{feature.key}", f"stats/{feature.key}"
    try:
        number = row[f"{at}/chunk_index"] * FILES_PER_CHUNK + row[f"{at}/file_index"]
        low, high, mean, std = (
            np.array(row[f"{stats}/{n}"], np.float64).reshape(3) for n in ("min", "max", "mean", "std")
        )
        stored = [row.get(f"{stats}/{name}") for name in QUANTILES]
        quantiles = None if None in stored else np.array(stored, np.float64).reshape(len(QUANTILES), 3)
        (frames,) = row[f"{stats}/count"]
        # LeRobot counts frames, moments are over pixels
        pixels = np.full(3, float(frames) * feature.width * feature.height)
        return EpisodeVideo(
            feature=feature,
            path=shard_path(root, at, number).with_name(f"file-{number % FILES_PER_CHUNK:03d}.mp4"),
            length=row["length"],
            fps=fps,
            moments=Moments(pixels, mean, std**2 * pixels, low, high, quantiles),
            # stored in seconds, as LeRobot wants it; rounding gives back the frame
            start=round(row[f"{at}/from_timestamp"] * fps),
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise FormatError(
            f"The place of a video in the episode table is damaged ({error!r}): {root}", code="H3-RECORDING-081"
        ) from None


class VideoAppender:
    """MP4 file to which episodes are appended."""

    def __init__(self, part: Path) -> None:
        """Create the file ``part``, which must not exist."""
        self.part = part
        self.frames = self.bytes = 0
        self._stack = ExitStack()
        self._container: Any = None
        self._stream: Any = None
        self._settings = b""
        # now, although FFmpeg comes later: the name is taken from here on
        part.touch(exist_ok=False)

    def add(self, video: EpisodeVideo) -> None:
        """Copy an episode to the end of the file.

        Raises:
            InputError: the episode is encoded with other settings than earlier ones.
            FormatError: the video is damaged or has too few frames.
        """
        import av

        with ExitStack() as stack:
            count = 0
            for packet in _packets(video, stack):
                if self._container is None:
                    options = {"movflags": "+faststart"}
                    self._container = self._stack.enter_context(
                        av.open(os.path.abspath(self.part), "w", format="mp4", options=options)
                    )
                    self._stream = self._container.add_stream_from_template(packet.stream)
                    self._settings = bytes(packet.stream.codec_context.extradata or b"")
                # a file has one set of parameters for its decoder, so other packets would decode to noise
                elif not count and bytes(packet.stream.codec_context.extradata or b"") != self._settings:
                    raise InputError(
                        f"The video of camera {video.feature.camera} was encoded with other settings than those before it "
                        f"in the dataset. Hint: write it to another dataset: {video.path}",
                        code="H3-RECORDING-089",
                    )
                if not count and not packet.is_keyframe:
                    raise FormatError(
                        f"Expected a key frame at frame {video.start}: {video.path}", code="H3-RECORDING-088"
                    )
                # times are counted in frames of the whole file, as those of the source begin anew with
                # each episode
                packet.stream = self._stream
                packet.time_base = Fraction(1, video.fps)
                packet.pts = packet.dts = self.frames + count
                packet.duration = 1
                self.bytes += packet.size
                self._container.mux(packet)
                count += 1
        if count != video.length:
            raise FormatError(
                f"Expected {video.length} frames from frame {video.start} on, got {count}: {video.path}",
                code="H3-RECORDING-082",
            )
        self.frames += count

    def close(self) -> None:
        """Finish the file and sync it to the disk."""
        self._stack.close()
        # FFmpeg has closed its own; to sync a file any descriptor will do
        with self.part.open("rb") as stream:
            os.fsync(stream.fileno())

    def discard(self) -> None:
        """Close the file and discard its content."""
        with suppress(Exception):  # the disk may be full
            self._stack.close()


def _packets(video: EpisodeVideo, stack: ExitStack) -> Iterator[Any]:
    """Yield the packets of an episode, in order; fewer if the file ends before."""
    container = _opened(video.path, stack)
    stream = container.streams.video[0]
    try:
        if video.start:
            # to the key frame before; packets up to the first one wanted are passed over below
            container.seek(round(video.start / video.fps / stream.time_base), stream=stream)
        count = 0
        for packet in container.demux(stream):
            if packet.size and round(packet.pts * packet.time_base * video.fps) >= video.start:
                yield packet
                count += 1
            if count == video.length:
                return
    except (OSError, ValueError) as error:
        raise FormatError(f"The video is damaged ({error}): {video.path}", code="H3-RECORDING-083") from None


def _opened(path: AnyPath, stack: ExitStack) -> Any:
    import av

    try:
        # absolute, since FFmpeg takes a name with a colon for a protocol
        source: Any = os.path.abspath(path) if isinstance(path, Path) else stack.enter_context(open_binary(path))
        container = stack.enter_context(av.open(source))
    except FileNotFoundError:
        raise FormatError(f"A video of the dataset is missing: {path}", code="H3-RECORDING-084") from None
    except (OSError, ValueError) as error:
        raise FormatError(f"The video cannot be read ({error}): {path}", code="H3-RECORDING-085") from None
    if not container.streams.video:
        raise FormatError(f"Expected a video, this file has none: {path}", code="H3-RECORDING-080")
    return container
