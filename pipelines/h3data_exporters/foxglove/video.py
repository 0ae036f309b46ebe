"""Encoder of pictures as an H.264 stream without container, with one picture per packet and independent key frames."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError

KEY_FRAMES = 30
"""Number of pictures from one key frame to the next; after a jump in time, a viewer waits for a key frame."""


class PictureStream:
    """Encoder of one camera's pictures in order, without B-frames, so that each picture gives a packet at once."""

    def __init__(self, width: int, height: int) -> None:
        import av

        self._size = (height, width)
        codec: Any = av.CodecContext.create("libx264", "w")
        # half as many colour samples in each direction, so even sizes only
        codec.width, codec.height = width + width % 2, height + height % 2
        codec.pix_fmt, codec.time_base = "yuv420p", Fraction(1, 30)
        # zero latency and one thread: a packet for each picture, the same bytes on every machine
        codec.options = {
            "preset": "ultrafast",
            "tune": "zerolatency",
            "crf": "23",
            "x264-params": f"keyint={KEY_FRAMES}:scenecut=0:bframes=0:repeat-headers=1:annexb=1:mbtree=0:threads=1",
        }
        self._codec = codec
        self._count = 0

    def packet(self, rgb: NDArray[np.uint8]) -> bytes:
        """Return one picture [H, W, 3] in sRGB as an Annex B packet; odd sizes are padded to even ones."""
        import av

        if rgb.shape != (*self._size, 3) or rgb.dtype != np.uint8:
            expected = f"uint8 {[*self._size, 3]}"
            raise InputError(
                f"Expected a picture of {expected}, got {rgb.dtype} {list(rgb.shape)}.", code="H3-EXPORT-008"
            )
        even = np.pad(rgb, ((0, self._size[0] % 2), (0, self._size[1] % 2), (0, 0)), mode="edge")
        frame = av.VideoFrame.from_ndarray(even, format="rgb24").reformat(format="yuv420p")
        frame.pts = self._count
        self._count += 1
        return b"".join(bytes(packet) for packet in self._codec.encode(frame))
