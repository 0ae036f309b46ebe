"""Encoding of the messages of policy servers: MessagePack with arrays, as in openpi and GR00T.

Received data are never executed: arrays have a known numeric dtype and a shape that fits their bytes.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import H3DataError

MOST_BYTES = 64 * 1024**2
"""Largest size of a message, in both directions [bytes]."""
MISSING = "Policy servers need the packages websockets and pyzmq. Hint: pip install 'h3data[remote]'"
_KINDS = "biuf"
"""Kinds of dtypes that are taken from the wire: booleans, integers and floats."""


class PolicyServerError(H3DataError):
    """Error of a policy server that does not answer in time, or whose answer is not an action."""


class Codec:
    """Codec of messages between policies and servers."""

    def __init__(self, pack_array: Callable[[Any], Any], unpack_array: Callable[[dict[Any, Any]], Any]) -> None:
        """Create a codec.

        Args:
            pack_array: Function that encodes an array or NumPy scalar, and raises a `TypeError` for other values.
            unpack_array: Function that decodes a map in a message, or returns the map itself.
        """
        self._encoder = msgspec.msgpack.Encoder(enc_hook=pack_array)
        self._unpack_array = unpack_array

    def pack(self, message: Any) -> bytes:
        """Return the bytes of a message of maps, lists, text, numbers and arrays.

        Raises:
            PolicyServerError: the message is larger than `MOST_BYTES`.
        """
        packed = self._encoder.encode(message)
        if len(packed) > MOST_BYTES:
            raise PolicyServerError(
                f"A message of {len(packed):,} bytes is too large: at most {MOST_BYTES:,} are sent. Hint: smaller pictures.",
                code="H3-REMOTE-056",
            )
        return packed

    def unpack(self, packed: bytes) -> Any:
        """Return the message that some bytes encode, with writable arrays.

        Raises:
            PolicyServerError: the bytes are not a message, or an array is malformed.
        """
        if len(packed) > MOST_BYTES:
            raise PolicyServerError(
                f"Expected a message of at most {MOST_BYTES:,} bytes, got {len(packed):,}.", code="H3-REMOTE-057"
            )
        try:
            return self._unpacked(msgspec.msgpack.decode(packed))
        except (msgspec.MsgspecError, RecursionError, ValueError, TypeError, UnicodeDecodeError) as fault:
            raise PolicyServerError(
                f"Expected a MessagePack message, got something else: {fault}", code="H3-REMOTE-059"
            ) from None

    def _unpacked(self, value: Any) -> Any:
        if isinstance(value, dict):
            found = self._unpack_array(value)
            return {k: self._unpacked(v) for k, v in value.items()} if found is value else found
        return [self._unpacked(one) for one in value] if isinstance(value, list) else value


def _checked_dtype(text: Any) -> np.dtype[Any]:
    dtype = np.dtype(text) if isinstance(text, str) and len(text) <= 8 else None
    if dtype is None or dtype.kind not in _KINDS:
        raise PolicyServerError(
            f"Expected an array of booleans, integers or floats, got the dtype {text!r}.", code="H3-REMOTE-053"
        )
    return dtype


def _array(data: bytes | memoryview, dtype: np.dtype[Any], shape: Any, *, fortran: bool = False) -> NDArray[Any]:
    fits = isinstance(shape, list | tuple) and all(type(n) is int and n >= 0 for n in shape) and len(shape) <= 16
    if not fits or math.prod(shape) * dtype.itemsize != len(data):
        raise PolicyServerError(
            f"An array of shape {shape!r} and dtype {dtype} cannot have {len(data):,} bytes.", code="H3-REMOTE-054"
        )
    # a copy, since arrays over the bytes of a message can neither be written to nor outlive it cheaply
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C").copy()


# --- openpi -----------------------------------------------------------------------------------------------------------
def _pack_openpi(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        _checked_dtype(value.dtype.str)
        data = value.data if value.ndim and value.size and value.flags.c_contiguous else value.tobytes()
        return {b"__ndarray__": True, b"data": data, b"dtype": value.dtype.str, b"shape": value.shape}
    # float64 is a Python float, which msgpack writes before it asks this hook in openpi's codec too
    if isinstance(value, np.float64):
        return float(value)
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(f"Expected maps, lists, text, numbers and arrays, got {type(value).__name__}.")


def _unpack_openpi(value: dict[Any, Any]) -> Any:
    if b"__ndarray__" in value:
        data = value.get(b"data")
        if not isinstance(data, bytes):
            raise PolicyServerError("An array has no bytes.", code="H3-REMOTE-058")
        return _array(data, _checked_dtype(value.get(b"dtype")), value.get(b"shape"))
    if b"__npgeneric__" in value:
        return _checked_dtype(value.get(b"dtype")).type(value.get(b"data"))
    return value


OPENPI = Codec(_pack_openpi, _unpack_openpi)
"""Codec for openpi, where an array is a map of raw bytes, dtype and shape, whose keys are bytes."""


# --- GR00T ------------------------------------------------------------------------------------------------------------
def _pack_groot(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        _checked_dtype(value.dtype.str)
        file = io.BytesIO()
        np.save(file, value, allow_pickle=False)
        return {"__ndarray_class__": True, "as_npy": file.getvalue()}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"Expected maps, lists, text, numbers and arrays, got {type(value).__name__}.")


def _unpack_groot(value: dict[Any, Any]) -> Any:
    if "__ndarray_class__" in value:
        data = value.get("as_npy")
        if not isinstance(data, bytes):
            raise PolicyServerError("An array has no bytes.", code="H3-REMOTE-058")
        return _array_of_npy(data)
    if "__ModalityConfig_class__" in value:
        return value.get("as_json")
    return value


def _array_of_npy(data: bytes) -> NDArray[Any]:
    """Return the array of a .npy file; `numpy.load` would believe its header and reserve memory for the shape that it names."""
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise PolicyServerError(f"Expected a .npy array of version 1 or 2, got {version}.", code="H3-REMOTE-055")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read(file)
    return _array(memoryview(data)[file.tell() :], _checked_dtype(dtype.str), shape, fortran=fortran)


GROOT = Codec(_pack_groot, _unpack_groot)
"""Codec for GR00T, where an array is a map with a .npy file."""
