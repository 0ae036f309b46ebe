"""Reading of pickles of plain values and NumPy arrays without running anything that they name.

Unpickling calls whatever a file names. This unpickler has an allow-list instead, with its own checked placeholder for
every name, because NumPy's functions trust their arguments, and ``dtype.__setstate__`` would change a dtype of the
whole process.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError

MAX_UNFOLDED = 64
"""Largest number of values per byte of the file. A file exceeds it only if it refers to one list again and again: a few
bytes could represent more values than any memory holds, or a list that contains itself."""
MAX_DEPTH = 100
_DTYPES = {"O8", "b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8"}


def is_pickle(data: bytes) -> bool:
    """Return whether data start like a pickle of protocol 2 or later."""
    return len(data) > 1 and data[0] == 0x80 and 2 <= data[1] <= 5


def load_pickle(data: bytes, path: Path | io.BytesIO, *, records: Mapping[tuple[str, str], Any] | None = None) -> Any:
    """Load dicts with text or integer keys, lists, tuples, numbers, texts, None and NumPy arrays.

    Args:
        data: the pickle.
        path: its file, for error texts.
        records: stand-ins (`Record`, or functions that return plain values) for further names, by (module, name).

    Raises:
        FormatError: the pickle names anything else, is damaged, or unfolds to far more than the file holds.
    """
    try:
        # before unpickling, which allocates at once
        _check_memo(data)
        content = _Unpickler(data, records or {}).load()
        if _unfolded_size(content, {}, 0) > MAX_UNFOLDED * len(data):
            raise pickle.UnpicklingError("it unfolds to far more than the file holds")
        return content
    except MemoryError:
        raise FormatError(f"The pickle claims to be larger than the memory: {path}", code="H3-FORMAT-025") from None
    except Exception as fault:  # a broken pickle can raise nearly anything
        raise FormatError(
            f"The pickle is refused or damaged: {fault or type(fault).__name__}: {path}", code="H3-FORMAT-026"
        ) from None


def builtin(value: Any) -> Any:
    """Return the plain value of an array or `Record`, as an ``enc_hook`` of msgspec."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Record):
        return value.plain()
    raise TypeError(f"a {type(value).__name__} is not a plain value")


class Record:
    """Placeholder for an object of a known class: holds its data from the file, and runs nothing."""

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError(f"a {type(self).__name__} has no state")

    def plain(self) -> Any:
        """Return the value that the object represents."""
        raise TypeError(f"a {type(self).__name__} is not a plain value")


class _Unpickler(pickle.Unpickler):
    def __init__(self, data: bytes, records: Mapping[tuple[str, str], Any]) -> None:
        super().__init__(io.BytesIO(data))
        self._allowed = _NUMPY | dict(records)
        self._what = "NumPy arrays and known records" if records else "NumPy arrays"

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        allowed = self._allowed.get((module_name, global_name))
        if allowed is None:
            raise pickle.UnpicklingError(f"it asks for {module_name}.{global_name}; only {self._what} are admitted")
        return allowed

    def persistent_load(self, pid: Any, /) -> Any:
        raise pickle.UnpicklingError("it refers to things outside the file")


def _check_memo(data: bytes) -> None:
    """Refuse memo indices that the file is too short to fill: the unpickler would allocate all slots before them."""
    for opcode, argument, _ in pickletools.genops(data):
        if opcode.name in ("PUT", "BINPUT", "LONG_BINPUT") and isinstance(argument, int) and argument > len(data):
            raise pickle.UnpicklingError(f"it stores a value under the number {argument}")


def _unfolded_size(value: Any, sizes: dict[int, int], depth: int) -> int:
    """Return the number of values in a tree whose branches may be shared; ``sizes`` holds those of containers, by identity."""
    if id(value) in sizes:
        return sizes[id(value)]
    if depth > MAX_DEPTH:
        raise pickle.UnpicklingError("it unfolds to far more than the file holds")
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        return value.size
    if isinstance(value, dict):
        strange = next((key for key in value if type(key) not in (str, int)), None)
        if strange is not None:
            raise pickle.UnpicklingError(f"a key is a {type(strange).__name__}")
        children: Any = value.values()
    elif isinstance(value, (list, tuple)):
        children = value
    elif isinstance(value, np.ndarray):
        children = value.ravel().tolist()
    elif isinstance(value, Record):
        children = (value.plain(),)
    elif value is None or type(value) in (bool, int, float, str):
        return 1
    else:
        raise pickle.UnpicklingError(f"a {type(value).__name__} is not a plain value")
    # remembered by identity, so that shared branches are counted without being walked again
    sizes[id(value)] = size = 1 + sum(_unfolded_size(child, sizes, depth + 1) for child in children)
    return size


# --- NumPy ------------------------------------------------------------------------------------------------------------
class _DType:
    """Stand-in for ``numpy.dtype``: numbers, booleans and objects only."""

    def __init__(self, code: Any, align: Any = False, copy: Any = False) -> None:
        if not isinstance(code, str) or code.lstrip("<>|=") not in _DTYPES:
            raise pickle.UnpicklingError(f"arrays of {code!r} are not admitted")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) < 2 or state[1] not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError("the byte order of an array is not understood")
        self.dtype = self.dtype.newbyteorder(state[1])


class _Array(np.ndarray):
    """An array whose state is checked before NumPy allocates anything for it."""

    def __setstate__(self, state: Any, /) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise pickle.UnpicklingError("the state of an array is not understood")
        version, shape, dtype, fortran, data = state
        # a plain bool: NumPy refuses its own, which its stub asks for
        checked: Any = (version, shape, _checked(data, dtype, shape), bool(fortran), data)
        super().__setstate__(checked)


def _checked(data: Any, dtype: Any, shape: Any) -> np.dtype[Any]:
    """Return the dtype of an array whose shape and data fit each other."""
    if not isinstance(dtype, _DType):
        raise pickle.UnpicklingError("an array does not say what it holds")
    if not isinstance(shape, tuple) or len(shape) > 8 or not all(type(n) is int and n >= 0 for n in shape):
        raise pickle.UnpicklingError(f"the shape of an array is {shape!r}")
    objects = dtype.dtype.hasobject
    if not isinstance(data, list if objects else (bytes, bytearray)):
        raise pickle.UnpicklingError("an array does not hold plain values")
    # exactly: NumPy would read beyond a buffer that is too short
    if len(data) != math.prod(shape) * (1 if objects else dtype.dtype.itemsize):
        raise pickle.UnpicklingError(f"an array of shape {shape} has {len(data)} bytes or objects of {dtype.dtype}")
    return dtype.dtype


def _reconstruct(*_: Any) -> _Array:
    """Return the empty array whose state follows."""
    # only the state, which is checked, gives it shape and contents
    return np.ndarray.__new__(_Array, (0,), "b")


def _frombuffer(data: Any, dtype: Any, shape: Any, order: Any) -> NDArray[Any]:
    """Return an array of protocol 5."""
    if order not in ("C", "F"):
        raise pickle.UnpicklingError(f"the order of an array is {order!r}")
    return np.frombuffer(data, _checked(data, dtype, shape)).reshape(shape, order=order)


def _scalar(dtype: Any, data: Any) -> Any:
    return np.frombuffer(data, _checked(data, dtype, (1,)))[0].item()


def _encode(text: Any, codec: Any) -> bytes:
    """Return bytes of protocol 2, which are written as text."""
    if not isinstance(text, str) or codec != "latin1":
        raise pickle.UnpicklingError("bytes in an unknown codec")
    return text.encode("latin1")


_NUMPY: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _DType,
    ("_codecs", "encode"): _encode,
    ("__builtin__", "bytes"): lambda: b"",  # empty bytes of protocol 2
}
for _core in ("numpy.core", "numpy._core"):  # before and since NumPy 2
    _NUMPY |= {
        (f"{_core}.multiarray", "_reconstruct"): _reconstruct,
        (f"{_core}.multiarray", "scalar"): _scalar,
        (f"{_core}.numeric", "_frombuffer"): _frombuffer,
    }
