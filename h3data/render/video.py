"""Videos that a browser plays: H.264, yuv420p, in MP4 with its index in front."""

from __future__ import annotations

import os
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError, MissingExtraError
from h3data.files import part_file


class VideoWriter:
    """Writes RGB frames to an MP4 file; use it as a context manager.

    The file is written as ``<path>.part`` and gets its name only when the block ends without an exception; otherwise
    nothing remains. Odd sizes are padded to even ones by repeating the last row or column.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        width: int,
        height: int,
        fps: float = 30,
        *,
        crf: int = 20,
        preset: str = "veryfast",
    ) -> None:
        """``crf`` is the quality (0 best, 51 worst), ``preset`` the encoder's effort, both as x264 names them."""
        if width < 1 or height < 1 or not fps > 0:
            raise InputError(f"A video needs a size and a frame rate above 0, got {width}x{height} at {fps} frames/s.")
        self.path = Path(path)
        self.width, self.height, self.fps = int(width), int(height), fps
        self.frame_count = 0
        # without mbtree: its result differs from run to run (seen with x264 on depth videos), and files must not
        self._options = {"crf": str(crf), "preset": preset, "x264-params": "mbtree=0"}
        self._stack: ExitStack | None = None
        self._container: Any = None
        self._stream: Any = None

    def __enter__(self) -> Self:
        av = _import_av()
        with ExitStack() as stack:
            part = stack.enter_context(part_file(self.path))
            options = {"movflags": "+faststart"}
            self._container = stack.enter_context(av.open(str(part), "w", format="mp4", options=options))
            rate = Fraction(self.fps).limit_denominator(1001)
            self._stream = self._container.add_stream("libx264", rate=rate, options=self._options)
            self._stream.width = self.width + self.width % 2
            self._stream.height = self.height + self.height % 2
            self._stream.pix_fmt = "yuv420p"
            self._stack = stack.pop_all()
        return self

    def write(self, rgb: NDArray[np.uint8]) -> None:
        """Append one frame, uint8 [H, W, 3]."""
        if self._stack is None:
            raise InputError(
                f"The video is not open. Hint: with VideoWriter(...) as video: video.write(rgb). {self.path}"
            )
        if rgb.shape != (self.height, self.width, 3) or rgb.dtype != np.uint8:
            raise InputError(
                f"Frame {self.frame_count} must be uint8 [{self.height}, {self.width}, 3], "
                f"got {rgb.dtype} {list(rgb.shape)}."
            )
        if self.width % 2 or self.height % 2:
            rgb = np.pad(rgb, ((0, self.height % 2), (0, self.width % 2), (0, 0)), mode="edge")
        frame = _import_av().VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
        for packet in self._stream.encode(frame):
            self._container.mux(packet)
        self.frame_count += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        stack, self._stack = self._stack, None
        if stack is None:
            return
        if error is not None:
            stack.__exit__(kind, error, trace)  # closes the container, removes the file; the error goes on
            return
        with stack:  # the same if the last frames cannot be written; else the file gets its name
            if not self.frame_count:
                raise InputError(f"No frame was written to the video. {self.path}")
            for packet in self._stream.encode():
                self._container.mux(packet)


def _import_av() -> Any:
    try:
        import av
    except ImportError as error:
        raise MissingExtraError("Writing videos needs PyAV. Hint: pip install av") from error
    return av
