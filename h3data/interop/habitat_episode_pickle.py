"""habitat-lab's pickled episode datasets (spec/habitat.md 6.5), read without running anything that is in them.

The file holds ``{all_transforms, idx_to_name, all_eps}`` with NumPy arrays. The unpickler below knows the few names
that pickled arrays use and builds its own, checked objects for them; no function of NumPy is called with what the file says.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from h3data.errors import FormatError

_UNFOLD = 64
"""How many values may come out of one byte: more only happens where a file refers to one list again and again."""
_DEPTH = 100


def is_pickle(data: bytes) -> bool:
    """Whether these bytes start like a pickle of protocol 2 or later."""
    return len(data) > 1 and data[0] == 0x80 and 2 <= data[1] <= 5


def unpickle_episodes(data: bytes, path: Path) -> Sequence[msgspec.Raw]:
    """Each episode as the JSON text that the unpickled dataset would be written as."""
    content = _unpickle(data, path)
    if not isinstance(content, dict) or not {"all_transforms", "idx_to_name", "all_eps"} <= set(content):
        keys = list(map(str, content))[:5] if isinstance(content, dict) else type(content).__name__
        raise FormatError(f"Expected a pickle with all_transforms, idx_to_name and all_eps, got {keys}: {path}")
    names, transforms, episodes = (content[key] for key in ("idx_to_name", "all_transforms", "all_eps"))
    transforms = _transforms(transforms, path)
    if not isinstance(names, dict) or not all(isinstance(name, str) for name in names.values()):
        raise FormatError(f"idx_to_name: Expected names by index: {path}")
    if not isinstance(episodes, list) or not all(isinstance(episode, dict) for episode in episodes):
        raise FormatError(f"all_eps: Expected a list of objects: {path}")
    plain = _Plain(_UNFOLD * len(data))
    return [_resolved(episode, k, names, transforms, plain, path) for k, episode in enumerate(episodes)]


def _transforms(value: Any, path: Path) -> NDArray[Any]:
    array = value.array if isinstance(value, _Array) else None
    if array is not None and array.size == 0:
        array = np.zeros((0, 4, 4))
    if array is None or array.dtype.kind != "f" or array.ndim != 3 or array.shape[1:] != (4, 4):
        got = type(value).__name__ if array is None else f"{array.dtype} {list(array.shape)}"
        raise FormatError(f"all_transforms: Expected a float array [N, 4, 4], got {got}: {path}")
    finite = np.isfinite(array).all(axis=(1, 2))
    if not finite.all():
        raise FormatError(f"all_transforms[{int(np.argmin(finite))}]: Expected finite numbers: {path}")
    return array


def _resolved(
    episode: dict[Any, Any], index: int, names: dict[Any, str], transforms: NDArray[Any], plain: _Plain, path: Path
) -> msgspec.Raw:
    """The episode with names and matrices in place of their indices."""
    where = f"all_eps[{index}]"
    try:
        content = {str(key): plain(value) for key, value in episode.items()}
        if "rigid_objs" in content:
            content["rigid_objs"] = [
                [names[name], transforms[_inside(at, len(transforms))].tolist()] for name, at in content["rigid_objs"]
            ]
        if "ao_states" in content:
            content["ao_states"] = {names[int(name)]: states for name, states in content["ao_states"].items()}
        if "name_to_receptacle" in content:
            pairs = content["name_to_receptacle"]
            content["name_to_receptacle"] = {names[name]: names[receptacle] for name, receptacle in pairs}
        if "markers" in content:
            content["markers"] = [
                {"name": names[n], "type": names[t], "params": {"offset": p, "link": names[k], "object": names[o]}}
                for n, t, p, k, o in content["markers"]
            ]
        return msgspec.Raw(msgspec.json.encode(content))
    except KeyError as fault:
        raise FormatError(f"{where}: index {fault} is not in idx_to_name: {path}") from None
    except (TypeError, ValueError, AttributeError, IndexError, OverflowError) as fault:
        raise FormatError(f"{where} does not have the layout of a pickled episode ({fault}): {path}") from None


def _inside(at: Any, size: int) -> int:
    if type(at) is not int or not 0 <= at < size:
        raise IndexError(f"there is no transform {at}, all_transforms has {size}")
    return at


class _Plain:
    """Turns what the unpickler built into lists, dicts, numbers and strings that JSON can hold."""

    def __init__(self, budget: int) -> None:
        self.budget = budget

    def __call__(self, value: Any, depth: int = 0) -> Any:
        self.budget -= value.array.size if isinstance(value, _Array) else 1
        if self.budget < 0 or depth > _DEPTH:
            raise ValueError("it unfolds to far more than the file holds")
        if isinstance(value, _Array):
            if value.array.dtype.kind == "f" and not np.isfinite(value.array).all():
                raise ValueError("an array holds NaN or infinity")
            return value.array.tolist()
        if isinstance(value, dict):
            return {_key(key): self(entry, depth + 1) for key, entry in value.items()}
        if isinstance(value, (list, tuple)):
            return [self(entry, depth + 1) for entry in value]
        if isinstance(value, float) and not np.isfinite(value):
            raise ValueError("a number is NaN or infinity")
        if value is None or type(value) in (bool, int, float, str):
            return value
        raise TypeError(f"a {type(value).__name__} does not belong into an episode")


def _key(key: Any) -> str:
    if type(key) not in (str, int):
        raise TypeError(f"a key is a {type(key).__name__}")
    return str(key)


# --- the unpickler ------------------------------------------------------------------------------------------------------
class _DType:
    """Stands for a pickled ``numpy.dtype``; only numbers and booleans are let in."""

    def __init__(self, code: Any, align: Any = False, copy: Any = False) -> None:
        if not isinstance(code, str) or code.lstrip("<>|=") not in _CODES:
            raise pickle.UnpicklingError(f"arrays of {code!r} are not admitted")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) < 2 or state[1] not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError("the byte order of an array is not understood")
        self.dtype = self.dtype.newbyteorder(state[1])


_CODES = {"b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8"}


class _Array:
    """Stands for a pickled ``numpy.ndarray``."""

    def __init__(self, array: NDArray[Any] | None = None) -> None:
        self.array: NDArray[Any] = np.zeros(0) if array is None else array

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise pickle.UnpicklingError("the state of an array is not understood")
        _, shape, dtype, fortran, data = state
        self.array = _array(data, dtype, shape, "F" if fortran else "C")


def _array(data: Any, dtype: Any, shape: Any, order: Any) -> NDArray[Any]:
    if not isinstance(dtype, _DType) or not isinstance(data, (bytes, bytearray)):
        raise pickle.UnpicklingError("an array does not hold plain numbers")
    if not isinstance(shape, tuple) or len(shape) > 8 or not all(type(n) is int and n >= 0 for n in shape):
        raise pickle.UnpicklingError(f"the shape of an array is {shape!r}")
    numbers = np.frombuffer(data, dtype.dtype)
    if numbers.size != _product(shape) or order not in ("C", "F"):
        raise pickle.UnpicklingError(f"an array of shape {shape} has {numbers.size} numbers")
    return numbers.reshape(shape, order=order)


def _product(shape: tuple[int, ...]) -> int:
    # in Python numbers, which do not overflow
    total = 1
    for n in shape:
        total *= n
    return total


def _reconstruct(*_: Any) -> _Array:
    """The empty array whose content follows."""
    return _Array()


def _frombuffer(data: Any, dtype: Any, shape: Any, order: Any) -> _Array:
    """An array of protocol 5."""
    return _Array(_array(data, dtype, shape, order))


def _scalar(dtype: Any, data: Any) -> Any:
    return _array(data, dtype, (1,), "C")[0].item()


def _encode(text: Any, codec: Any) -> bytes:
    """Bytes of protocol 2, which are written as text."""
    if not isinstance(text, str) or codec != "latin1":
        raise pickle.UnpicklingError("bytes in an unknown codec")
    return text.encode("latin1")


def _no_bytes() -> bytes:
    """Empty bytes of protocol 2."""
    return b""


_ADMITTED: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _Array,
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
    def find_class(self, module_name: str, global_name: str, /) -> Any:
        admitted = _ADMITTED.get((module_name, global_name))
        if admitted is None:
            raise pickle.UnpicklingError(f"it asks for {module_name}.{global_name}; only NumPy arrays are admitted")
        return admitted

    def persistent_load(self, pid: Any, /) -> Any:
        raise pickle.UnpicklingError("it refers to things outside the file")


def _unpickle(data: bytes, path: Path) -> Any:
    try:
        return _Unpickler(io.BytesIO(data)).load()
    except MemoryError:
        raise FormatError(f"The pickle claims to be larger than the memory: {path}") from None
    except Exception as fault:  # a broken pickle can raise nearly anything
        raise FormatError(f"The pickle is refused or damaged: {fault or type(fault).__name__}: {path}") from None
