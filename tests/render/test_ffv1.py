"""FFV1: FFmpeg's decoder reads back every image."""

from __future__ import annotations

import av
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from h3data.render.ffv1 import Ffv1Encoder


def decoded(record: bytes, frames: list[bytes], width: int, height: int) -> list[np.ndarray]:
    """The images that FFmpeg's decoder makes of frames."""
    decoder = av.CodecContext.create("ffv1", "r")
    decoder.extradata, decoder.width, decoder.height, decoder.thread_count = record, width, height, 1
    pictures = [picture for frame in frames for picture in decoder.decode(av.Packet(frame))]
    return [picture.to_ndarray(format="gray16le") for picture in [*pictures, *decoder.decode(None)]]


def assert_reads_back(*images: np.ndarray) -> None:
    height, width = images[0].shape
    encoder = Ffv1Encoder(width, height)
    pictures = decoded(encoder.record, [encoder.encoded(image) for image in images], width, height)
    np.testing.assert_array_equal(pictures, images)


sizes = st.tuples(st.integers(1, 40), st.integers(1, 70))


@settings(max_examples=60, deadline=None)
@given(arrays(np.uint16, sizes))
def test_any_image_reads_back(image: np.ndarray):
    assert_reads_back(image)


@settings(max_examples=60, deadline=None)
@given(sizes, st.integers(0, 2**32 - 1), st.integers(0, 16))
def test_noise_of_any_strength_reads_back(size, seed: int, bits: int):
    rng = np.random.default_rng(seed)
    assert_reads_back(*(rng.integers(0, 1 << bits, size).astype(np.uint16) for _ in range(3)))


@settings(max_examples=60, deadline=None)
@given(sizes, *[st.floats(-3000, 3000)] * 3)
def test_slopes_read_back(size, start: float, across: float, down: float):
    y, x = np.mgrid[: size[0], : size[1]]
    assert_reads_back(np.int64(start + across * x + down * y).astype(np.uint16))


@pytest.mark.parametrize("size", [(1, 1), (1, 3000), (700, 5), (93, 171), (480, 640)])
@pytest.mark.parametrize("values", [(0, 0), (65535, 65535), (0, 65535), (0, 32768), (32767, 32768), (0, 1)])
def test_extremes_read_back(size, values):
    """Flat images, and the largest differences there are, alternating in space and at random."""
    y, x = np.mgrid[: size[0], : size[1]]
    chosen = [(x + y) % 2, x % 2, np.random.default_rng(3).integers(0, 2, size)]
    assert_reads_back(*(np.array(values, np.uint16)[which] for which in chosen))


def remainder(data: bytes) -> int:
    """CRC of 32 bits, bit by bit (RFC 9043, 4.9.3)."""
    crc = 0
    for byte in data:
        crc ^= byte << 24
        for _ in range(8):
            crc = (crc << 1 ^ 0x104C11DB7) if crc >> 31 else crc << 1
    return crc


def test_slices_and_the_record_have_checksums():
    encoder = Ffv1Encoder(40, 24)
    frame = encoder.encoded(np.random.default_rng(4).integers(0, 9, (24, 40)).astype(np.uint16))
    assert remainder(encoder.record) == 0
    slices = []
    while frame:
        size = int.from_bytes(frame[-8:-5]) + 8
        frame, one = frame[:-size], frame[-size:]
        slices.append(one)
    assert len(slices) == 8
    assert {remainder(one) for one in slices} == {0}
    assert remainder(b"\1" + slices[0]) != 0


def test_an_image_that_lies_otherwise_in_memory_is_the_same():
    image = np.random.default_rng(5).integers(0, 65536, (64, 48)).astype(np.uint16)
    encoder = Ffv1Encoder(64, 48)
    assert encoder.encoded(image.T) == encoder.encoded(np.ascontiguousarray(image.T))
