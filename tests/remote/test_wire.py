"""Messages of policy servers: the bytes of both protocols, and what is refused."""

from __future__ import annotations

import contextlib
import io

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from h3data_remote.wire import GROOT, MOST_BYTES, OPENPI, PolicyServerError

ARRAYS = [
    np.arange(12, dtype=np.uint8).reshape(2, 2, 3),
    np.array([[0.5, -1.0]], np.float32),
    np.array(3.0),
    np.zeros((0, 4), np.int64),
    np.array([True, False]),
    np.arange(6, dtype=">i4").reshape(2, 3).T,
]


@pytest.mark.parametrize("array", ARRAYS, ids=str)
@pytest.mark.parametrize("codec", [OPENPI, GROOT], ids=["openpi", "groot"])
def test_arrays_come_back_as_they_were_and_can_be_written_to(codec, array) -> None:
    back = codec.unpack(codec.pack({"a": {"b": [array]}}))["a"]["b"][0]
    assert back.dtype == array.dtype
    assert np.array_equal(back, array)
    assert back.flags.writeable


def test_bytes_are_those_that_the_documented_formats_give() -> None:
    array, message = ARRAYS[1], {"prompt": "go" * 20, "n": [1, -7, 70_000, 2**40, 2.5, None, True, b"x"]}
    openpi = {b"__ndarray__": True, b"data": array.tobytes(), b"dtype": "<f4", b"shape": (1, 2)}
    assert OPENPI.pack({**message, "a": array}) == msgpack.packb({**message, "a": openpi})
    scalar = {b"__npgeneric__": True, b"data": 2, b"dtype": "<i8"}
    assert OPENPI.pack([np.int64(2), np.float64(0.5)]) == msgpack.packb([scalar, 0.5])
    file = io.BytesIO()
    np.save(file, array)
    groot = {"__ndarray_class__": True, "as_npy": file.getvalue()}
    assert GROOT.pack({**message, "a": array}) == msgpack.packb({**message, "a": groot})


def openpi(data: object, dtype: object, shape: object) -> bytes:
    return msgpack.packb({b"__ndarray__": True, b"data": data, b"dtype": dtype, b"shape": shape})


def npy(header: str) -> bytes:
    body = header.encode() + b" " * (-(len(header) + 11) % 64) + b"\n"
    return msgpack.packb(
        {"__ndarray_class__": True, "as_npy": b"\x93NUMPY\x01\x00" + len(body).to_bytes(2, "little") + body}
    )


@pytest.mark.parametrize(
    ("codec", "packed"),
    [
        (OPENPI, openpi(b"1234", "O", [1])),
        (OPENPI, openpi(b"1234", "|V4", [1])),
        (OPENPI, openpi(b"1234", "<c8", [1])),
        (OPENPI, openpi(b"1234", "nonsense", [1])),
        (OPENPI, openpi(b"1234", "<f4", [2**40])),
        (OPENPI, openpi(b"1234", "<f4", [-1])),
        (OPENPI, openpi(b"1234", "<f4", "1")),
        (OPENPI, openpi("1234", "<f4", [1])),
        (OPENPI, b"\xc1"),
        (OPENPI, b"\x91" * 100_000),
        (OPENPI, b""),
        (GROOT, npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,), }")),
        (GROOT, npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }")),
        (GROOT, npy("__import__('os').system('true')")),
        (GROOT, msgpack.packb({"__ndarray_class__": True, "as_npy": b"\x80\x04."})),
    ],
)
def test_what_is_no_array_of_numbers_is_refused(codec, packed) -> None:
    with pytest.raises(PolicyServerError):
        codec.unpack(packed)


@given(st.binary(max_size=200))
def test_no_bytes_do_anything_but_be_read_or_refused(data: bytes) -> None:
    for codec in (OPENPI, GROOT):
        with contextlib.suppress(PolicyServerError):
            codec.unpack(data)


def test_messages_are_bounded_in_both_directions() -> None:
    with pytest.raises(PolicyServerError, match="H3-REMOTE-056"):
        OPENPI.pack({"a": np.zeros(MOST_BYTES + 1, np.uint8)})
    with pytest.raises(PolicyServerError, match="H3-REMOTE-057"):
        OPENPI.unpack(bytes(MOST_BYTES + 1))
