"""Pickles of plain values and NumPy arrays, read without running anything that is in them.

Unpickling calls whatever a file names. The unpickler below knows only the few names that pickled arrays use and builds
its own, checked objects for them; no function of NumPy is called with what the file says.
"""

from __future__ import annotations

import io
import pickle
import pickletools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError


def is_pickle(data: bytes) -> bool:
    """Whether these bytes start like a pickle of protocol 2 or later."""
    return len(data) > 1 and data[0] == 0x80 and 2 <= data[1] <= 5


class _DType:
    """Stands for a pickled ``numpy.dtype``; only numbers, booleans and lists of what else is admitted are let in."""

    def __init__(self, code: Any, align: Any = False, copy: Any = False) -> None:
        if not isinstance(code, str) or code.lstrip("<>|=") not in _CODES:
            raise pickle.UnpicklingError(f"arrays of {code!r} are not admitted")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) < 2 or state[1] not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError("the byte order of an array is not understood")
        self.dtype = self.dtype.newbyteorder(state[1])


_CODES = {"O8", "b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8"}


class PickledArray:
    """Stands for a pickled ``numpy.ndarray``; of objects only if the file has such an array."""

    def __init__(self, array: NDArray[Any] | None = None) -> None:
        self.array: NDArray[Any] = np.zeros(0) if array is None else array

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise pickle.UnpicklingError("the state of an array is not understood")
        _, shape, dtype, fortran, data = state
        self.array = _array(data, dtype, shape, "F" if fortran else "C")


def _array(data: Any, dtype: Any, shape: Any, order: Any) -> NDArray[Any]:
    if not isinstance(dtype, _DType):
        raise pickle.UnpicklingError("an array does not say what it holds")
    if not isinstance(shape, tuple) or len(shape) > 8 or not all(type(n) is int and n >= 0 for n in shape):
        raise pickle.UnpicklingError(f"the shape of an array is {shape!r}")
    values = _values(data, dtype.dtype)
    if values.size != _product(shape) or order not in ("C", "F"):
        raise pickle.UnpicklingError(f"an array of shape {shape} has {values.size} values")
    return values.reshape(shape, order=order)


def _values(data: Any, dtype: np.dtype[Any]) -> NDArray[Any]:
    if dtype.hasobject and isinstance(data, list):
        objects = np.empty(len(data), object)
        for k, value in enumerate(data):  # one by one: assigned at once, lists in the list would be taken for an axis
            objects[k] = value
        return objects
    if not dtype.hasobject and isinstance(data, (bytes, bytearray)):
        return np.frombuffer(data, dtype)
    raise pickle.UnpicklingError("an array does not hold plain values")


def _product(shape: tuple[int, ...]) -> int:
    # in Python numbers, which do not overflow
    total = 1
    for n in shape:
        total *= n
    return total


def _reconstruct(*_: Any) -> PickledArray:
    """The empty array whose content follows."""
    return PickledArray()


def _frombuffer(data: Any, dtype: Any, shape: Any, order: Any) -> PickledArray:
    """An array of protocol 5."""
    return PickledArray(_array(data, dtype, shape, order))


def _scalar(dtype: Any, data: Any) -> Any:
    value = _array(data, dtype, (1,), "C")[0]
    if not isinstance(value, np.generic):
        raise pickle.UnpicklingError("a number is an object")
    return value.item()


def _encode(text: Any, codec: Any) -> bytes:
    """Bytes of protocol 2, which are written as text."""
    if not isinstance(text, str) or codec != "latin1":
        raise pickle.UnpicklingError("bytes in an unknown codec")
    return text.encode("latin1")


def _no_bytes() -> bytes:
    """Empty bytes of protocol 2."""
    return b""


_ADMITTED: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): PickledArray,
    ("numpy", "dtype"): _DType,
    ("_codecs", "encode"): _encode,
    ("__builtin__", "bytes"): _no_bytes,
}
for _core in ("numpy.core", "numpy._core"):
    _ADMITTED |= {
        (f"{_core}.multiarray", "_reconstruct"): _reconstruct,
        (f"{_core}.multiarray", "scalar"): _scalar,
        (f"{_core}.numeric", "_frombuffer"): _frombuffer,
    }


class _Unpickler(pickle.Unpickler):
    def __init__(self, data: bytes, also: Mapping[tuple[str, str], Any]) -> None:
        super().__init__(io.BytesIO(data))
        self._admitted = _ADMITTED | dict(also)
        self._what = "NumPy arrays and known records" if also else "NumPy arrays"

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        admitted = self._admitted.get((module_name, global_name))
        if admitted is None:
            raise pickle.UnpicklingError(f"it asks for {module_name}.{global_name}; only {self._what} are admitted")
        return admitted

    def persistent_load(self, pid: Any, /) -> Any:
        raise pickle.UnpicklingError("it refers to things outside the file")


def _check_memo(data: bytes) -> None:
    """Refuse places in the memo that the file is too short to fill: the unpickler would allocate all that lie before."""
    for opcode, argument, _ in pickletools.genops(data):
        if opcode.name in ("PUT", "BINPUT", "LONG_BINPUT") and isinstance(argument, int) and argument > len(data):
            raise pickle.UnpicklingError(f"it remembers a value under the number {argument}")


def unpickle_arrays(data: bytes, path: Path, *, also: Mapping[tuple[str, str], Any] | None = None) -> Any:
    """Dicts, lists, tuples, numbers and strings, with `PickledArray` where the file has arrays.

    ``also`` admits further names by (module, name): stand-ins of the caller's, never what the file names itself.

    Raises:
        FormatError: it asks for anything else, or is damaged.
    """
    try:
        _check_memo(data)
        return _Unpickler(data, also or {}).load()
    except MemoryError:
        raise FormatError(f"The pickle claims to be larger than the memory: {path}") from None
    except Exception as fault:  # a broken pickle can raise nearly anything
        raise FormatError(f"The pickle is refused or damaged: {fault or type(fault).__name__}: {path}") from None
