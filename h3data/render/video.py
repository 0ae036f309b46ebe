"""Writer of videos: H.264 or AV1 for browsers, in MP4 with the index at the front, and lossless FFV1 for depth."""

from __future__ import annotations

import os
import threading
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from llvmlite import ir
from numba import types
from numpy.typing import NDArray

from h3data.errors import InputError, MissingExtraError
from h3data.files import part_file
from h3data.kernels import kernel, kernel_part
from h3data.kernels.vectors import intrinsic
from h3data.render.ffv1 import Ffv1Encoder

Codec = Literal["h264", "av1", "ffv1"]


class _Settings(NamedTuple):
    encoder: str
    pixels: str
    container: str
    options: dict[str, str]


# The same frames must give the same file on every run and machine. For x264 this means no mbtree, whose result differed
# between runs on depth videos, and a fixed number of threads, which leaves traces in the file; SVT-AV1 is deterministic.
# One thread takes a quarter less CPU time than four, and 0.1 dB more for the same size.
# x264's preset ultrafast takes a fifth of veryfast's time. At crf 23 its quality equals veryfast's at 20 (41.6 and 41.0 dB
# luma PSNR on a walk through a home), with files 1.6 times as large.
_SETTINGS = {
    "h264": _Settings("libx264", "yuv420p", "mp4", {"preset": "ultrafast", "x264-params": "mbtree=0"}),
    "av1": _Settings("libsvtav1", "yuv420p", "mp4", {"preset": "10"}),
    "ffv1": _Settings("ffv1", "gray16le", "matroska", {}),  # opens the file; the frames are those of `Ffv1Encoder`
}
_LUMA, _U, _V = (66, 129, 25, 4224), (-38, -74, 112, 131584), (112, -94, -18, 131584)
"""Weights of red, green and blue, and a constant, for converting RGB to YUV, in 1/256 for one pixel and in 1/1024 for
the sum of four."""
_AT_ONCE = 16
"""Number of pixels that are converted at once."""


class VideoWriter:
    """Writer of frames to a video file; use it as a context manager.

    ``h264`` and ``av1`` take RGB uint8 [H, W, 3]; odd sizes are padded to even ones by repeating the last row or column.
    ``ffv1`` takes uint16 [H, W] and is lossless. The file is written as ``<path>.part`` and renamed when the block ends
    without an exception; otherwise it is removed, except after an `OSError` (a full disk), which keeps ``<path>.part``.
    The same frames give the same bytes.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        width: int,
        height: int,
        fps: float = 30,
        *,
        codec: Codec = "h264",
        crf: int | None = None,
        preset: str | None = None,
        key_frames: int | None = None,
        threads: int = 1,
    ) -> None:
        """Open the file and the encoder.

        Args:
            path: file to write.
            width: width of the frames [px].
            height: height of the frames [px].
            fps: frames per second.
            codec: video codec.
            crf: quality, 0 is best; default 32 for AV1, and for H.264 a constant quantiser of 23, which takes less
                time than crf 23.
            preset: effort of the encoder, in the terms of x264 or SVT-AV1.
            key_frames: frames from one key frame to the next, for H.264, without B-frames: a decoder that jumps to a frame
                decodes this many at most. By default the encoder decides.
            threads: threads of the H.264 encoder. The bytes of the file depend on their number.
        """
        if width < 1 or height < 1 or not fps > 0:
            raise InputError(
                f"A video needs a size and a frame rate above 0, got {width}x{height} at {fps} frames/s.",
                code="H3-RENDER-073",
            )
        if codec not in _SETTINGS:
            raise InputError(f"Unknown codec {codec!r}. Expected one of: {', '.join(_SETTINGS)}.", code="H3-RENDER-074")
        self.path = Path(path)
        self.width, self.height, self.fps, self.codec = int(width), int(height), fps, codec
        # such as 30000 / 1001, the frame rate of television
        self._rate = Fraction(fps).limit_denominator(1001)
        self.frame_count = 0
        self._options = dict(_SETTINGS[codec].options)
        default = {"h264": ("qp", 23), "av1": ("crf", 32)}
        if codec in default:
            option, quality = default[codec] if crf is None else ("crf", crf)
            self._options[option] = str(quality)
            self._options["preset"] = preset or self._options["preset"]
        if codec == "h264":
            self._options["x264-params"] += f":threads={threads}"
        if key_frames is not None:
            every = f":keyint={key_frames}:min-keyint={key_frames}:scenecut=0:bframes=0"
            self._options["x264-params"] += every
        self._stack: ExitStack | None = None
        self._container: Any = None
        self._stream: Any = None
        self._own = threading.local()

    def __enter__(self) -> Self:
        av = _import_av()
        settings = _SETTINGS[self.codec]
        # chroma has half the size, so this format knows no odd sizes
        even = settings.pixels == "yuv420p"
        with ExitStack() as stack:
            part = stack.enter_context(part_file(self.path, kept_after=OSError))
            # the index before the frames, so that a browser shows the first ones before it has the rest
            options = {"movflags": "+faststart"} if settings.container == "mp4" else {"fflags": "+bitexact"}
            self._container = stack.enter_context(av.open(str(part), "w", format=settings.container, options=options))
            self._stream = self._container.add_stream(settings.encoder, rate=self._rate, options=self._options)
            self._stream.width = self.width + (self.width % 2 if even else 0)
            self._stream.height = self.height + (self.height % 2 if even else 0)
            self._stream.pix_fmt = settings.pixels
            if self.codec == "ffv1":
                self._stream.codec_context.open()
                self._stream.codec_context.extradata = Ffv1Encoder(self.width, self.height).record
            if even:
                # FFmpeg's constants for what `_to_yuv` makes: BT.601, limited range
                self._stream.codec_context.colorspace = 6
                self._stream.codec_context.color_range = 1
            self._stack = stack.pop_all()
        return self

    def write(self, image: NDArray[Any]) -> None:
        """Append one frame."""
        self.write_planes(self.planes(image))

    def planes(self, image: NDArray[Any]) -> Any:
        """Return a frame converted for `write_planes`; it may run in any thread.

        Frames of ``ffv1``, which do not depend on each other, are encoded here, so that several threads can do it.
        """
        if self.codec == "ffv1":
            shape, dtype = (self.height, self.width), np.dtype(np.uint16)
        else:
            shape, dtype = (self.height, self.width, 3), np.dtype(np.uint8)
        if image.shape != shape or image.dtype != dtype:
            raise InputError(
                f"Frame {self.frame_count} must be {dtype} {list(shape)}, got {image.dtype} {list(image.shape)}.",
                code="H3-RENDER-075",
            )
        if self.codec == "ffv1":
            if not hasattr(self._own, "encoder"):  # of the calling thread
                self._own.encoder = Ffv1Encoder(self.width, self.height)
            return self._own.encoder.encoded(image)
        if self.width % 2 or self.height % 2:
            image = np.pad(image, ((0, self.height % 2), (0, self.width % 2), (0, 0)), mode="edge")
        height, width = image.shape[:2]
        frame = _import_av().VideoFrame(width, height, _SETTINGS[self.codec].pixels)
        # written in place where FFmpeg's rows lie close together, which spares a copy
        written = [np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size) for plane in frame.planes]
        planes = [
            np.ascontiguousarray(rows[:, : plane.width]) for rows, plane in zip(written, frame.planes, strict=True)
        ]
        _to_yuv(np.ascontiguousarray(image), *planes)
        for rows, plane in zip(written, planes, strict=True):
            if rows.shape != plane.shape:
                rows[:, : plane.shape[1]] = plane
        return frame

    def write_planes(self, planes: Any) -> None:
        """Append one frame converted by `planes`."""
        if self._stack is None:
            raise InputError(
                f"The video is not open. Hint: with VideoWriter(...) as video: video.write(image). {self.path}",
                code="H3-RENDER-076",
            )
        if self.codec == "ffv1":
            packet = _import_av().Packet(planes)
            # not through FFmpeg's encoder, which would encode the frame again
            packet.stream, packet.time_base, packet.is_keyframe = self._stream, 1 / self._rate, True
            packet.pts = packet.dts = self.frame_count
            self._container.mux(packet)
        else:
            for packet in self._stream.encode(planes):
                self._container.mux(packet)
        self.frame_count += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        stack, self._stack = self._stack, None
        if stack is None:
            return
        if error is not None:
            stack.__exit__(kind, error, trace)  # closes the container and removes the file; the error propagates
            return
        with stack:  # likewise if the last frames cannot be written; otherwise renames the file
            if not self.frame_count:
                raise InputError(f"No frame was written to the video. {self.path}", code="H3-RENDER-078")
            for packet in self._stream.encode() if self.codec != "ffv1" else ():
                self._container.mux(packet)


@kernel(boundscheck=False)
def _to_yuv(rgb, y, u, v):
    """Convert rgb [H, W, 3] to y [H, W] and u, v [H/2, W/2]: BT.601, limited range; chroma is the mean of 2x2 pixels.

    In fixed point, of which 16 bits suffice for luma.
    """
    height, width = y.shape
    # the last columns, fewer than a block, are converted one by one below, to the same numbers
    whole = width // _AT_ONCE * _AT_ONCE
    rgb_at, y_at, u_at, v_at = np.uintp(rgb.ctypes.data), y.ctypes.data, u.ctypes.data, v.ctypes.data
    for row in range(u.shape[0]):
        for c in range(0, whole, _AT_ONCE):
            luma, chroma = np.uintp(2 * row * width + c), np.uintp((row * width + c) // 2)
            yuv_block(
                rgb_at + 3 * luma, np.uintp(3 * width), y_at + luma, np.uintp(width), u_at + chroma, v_at + chroma
            )
    for row in range(height if whole < width else 0):
        line, luma = rgb[row].reshape(-1), y[row]
        for c in range(whole, width):
            r, g, b = np.int32(line[3 * c]), np.int32(line[3 * c + 1]), np.int32(line[3 * c + 2])
            luma[c] = np.uint8(_weighted(*_LUMA, r, g, b) >> 8)
    for row in range(u.shape[0] if whole < width else 0):
        upper, lower, u_line, v_line = rgb[2 * row].reshape(-1), rgb[2 * row + 1].reshape(-1), u[row], v[row]
        for c in range(whole // 2, width // 2):
            r, g, b = _four(upper, lower, 6 * c), _four(upper, lower, 6 * c + 1), _four(upper, lower, 6 * c + 2)
            u_line[c] = np.uint8(_weighted(*_U, r, g, b) >> 10)
            v_line[c] = np.uint8(_weighted(*_V, r, g, b) >> 10)


@kernel_part(forceinline=True)
def _weighted(of_r, of_g, of_b, more, r, g, b):
    return of_r * r + of_g * g + of_b * b + more


@kernel_part(forceinline=True, boundscheck=False)
def _four(upper, lower, k):
    """Return the sum of a channel over 2x2 pixels."""
    return np.int32(upper[k]) + np.int32(upper[k + 3]) + np.int32(lower[k]) + np.int32(lower[k + 3])


@intrinsic
def yuv_block(typing_context, rgb_at, rgb_bytes, y_at, y_bytes, u_at, v_at):
    """Convert two rows of 16 RGB pixels to YUV; ``rgb_bytes`` and ``y_bytes`` are the distances between the rows."""

    def codegen(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        rgb_at, rgb_bytes, y_at, y_bytes, u_at, v_at = arguments
        byte, half, word = ir.IntType(8), ir.IntType(16), ir.IntType(32)

        def all_of(number: int, kind: Any, count: int) -> Any:
            return ir.Constant(ir.VectorType(kind, count), [number] * count)

        def picked(value: Any, first: int, step: int, count: int) -> Any:
            order = [first + step * k for k in range(count)]
            return b.shuffle_vector(value, value, ir.Constant(ir.VectorType(word, count), order))

        def weighted(channels: list[Any], weights: tuple[int, ...], kind: Any, shift: int) -> Any:
            count = channels[0].type.count
            total = all_of(weights[3], kind, count)
            for channel, weight in zip(channels, weights, strict=False):
                total = b.add(total, b.mul(channel, all_of(weight, kind, count)))
            return b.trunc(b.lshr(total, all_of(shift, kind, count)), ir.VectorType(byte, count))

        def put(value: Any, at: Any) -> None:
            b.store(value, b.inttoptr(at, value.type.as_pointer())).align = 1

        sums: list[Any] = []
        for _ in range(2):
            line = b.load(b.inttoptr(rgb_at, ir.VectorType(byte, 3 * _AT_ONCE).as_pointer()))
            line.align = 1
            halves = ir.VectorType(half, _AT_ONCE)
            channels = [b.zext(picked(line, k, 3, _AT_ONCE), halves) for k in range(3)]
            put(weighted(channels, _LUMA, half, 8), y_at)
            sums = channels if not sums else [b.add(one, other) for one, other in zip(sums, channels, strict=True)]
            rgb_at, y_at = b.add(rgb_at, rgb_bytes), b.add(y_at, y_bytes)
        pairs = _AT_ONCE // 2
        fours = [b.add(picked(one, 0, 2, pairs), picked(one, 1, 2, pairs)) for one in sums]
        wide = [b.zext(one, ir.VectorType(word, pairs)) for one in fours]
        put(weighted(wide, _U, word, 10), u_at)
        put(weighted(wide, _V, word, 10), v_at)
        return context.get_dummy_value()

    p = types.uintp
    return types.void(p, p, p, p, p, p), codegen


def _import_av() -> Any:
    try:
        import av
    except ImportError as error:
        raise MissingExtraError("Writing videos needs PyAV. Hint: pip install av", code="H3-RENDER-077") from error
    return av
