"""The pickled form of paper-era HITL logs, as the plain values that their JSON form holds; nothing in it is executed.

Such a pickle names omegaconf's containers, magnum's vectors and a few of Python's types (spec/habitat-findings.md 10).
Stand-ins take their place: they keep what the file says and do nothing with it.
"""

from __future__ import annotations

import math
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from h3data.errors import FormatError
from h3data.interop.array_pickle import PickledArray, unpickle_arrays

_UNFOLD = 64
"""How many values may come out of one byte: more only happens where a file refers to one list again and again."""
_DEPTH = 100


class _Fixed:
    """A stand-in that takes no state: pickles cannot change it."""

    def __setstate__(self, state: Any) -> None:
        raise TypeError(f"{type(self).__name__.strip('_')} has no state")


class _Config:
    """Stands for omegaconf's DictConfig, ListConfig and AnyNode: ``content`` is what they hold."""

    content: Any = None

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, dict) or not {"_content", "_val"} & set(state):
            raise TypeError("a configuration holds neither _content nor _val")
        self.content = state["_content"] if "_content" in state else state["_val"]


class _Metadata:
    """Stands for what omegaconf notes about a node's type; of no use here."""

    def __setstate__(self, state: Any) -> None:
        del state


class _Type(_Fixed):
    """Stands for ``typing.Any`` and Python's own types, which omegaconf notes beside its values."""


class _DefaultDict(dict[Any, Any]):
    """Stands for ``collections.defaultdict``: a dict without a default."""

    def __init__(self, *_: Any) -> None:
        super().__init__()

    def __setstate__(self, state: Any) -> None:
        raise TypeError("a defaultdict has no state")


class _Datetime(_Fixed):
    """Stands for ``datetime.datetime``, whose ten bytes are year (2), month, day, hour, minute, second, microsecond (3)."""

    def __init__(self, packed: Any = b"", *zone: Any) -> None:
        if not isinstance(packed, bytes) or len(packed) != 10 or zone:
            raise TypeError("a date is not understood")
        year, micro = int.from_bytes(packed[:2], "big"), int.from_bytes(packed[7:], "big")
        month, day, hour, minute, second = packed[2:7]
        self.text = str(datetime(year, month, day, hour, minute, second, micro))


def _vector3(*values: Any) -> Any:
    """The three numbers of a magnum vector."""
    return values[0] if len(values) == 1 else list(values)


_ALSO: dict[tuple[str, str], Any] = {
    ("collections", "defaultdict"): _DefaultDict,
    ("datetime", "datetime"): _Datetime,
    ("typing", "Any"): _Type(),
    ("omegaconf.dictconfig", "DictConfig"): _Config,
    ("omegaconf.listconfig", "ListConfig"): _Config,
    ("omegaconf.nodes", "AnyNode"): _Config,
    ("omegaconf.base", "ContainerMetadata"): _Metadata,
    ("omegaconf.base", "Metadata"): _Metadata,
    ("utils.serialize_utils", "unpickle_vector3"): _vector3,
    ("habitat_hitl.core.serialize_utils", "unpickle_vector3"): _vector3,
}
for _name in ("dict", "list", "tuple", "str", "int", "float", "bool"):
    _ALSO["builtins", _name] = _Type()


def unpickle_log(data: bytes, path: Path) -> Any:
    """Dicts with text keys, lists, numbers, texts and None; dates as text ``YYYY-MM-DD HH:MM:SS.ffffff``, NaN as None.

    Raises:
        FormatError: the pickle asks for a name that such logs do not have (it is named), or is damaged.
    """
    content = unpickle_arrays(data, path, also=_ALSO)
    try:
        return _Plain(_UNFOLD * len(data))(content)
    except (TypeError, ValueError) as fault:
        raise FormatError(f"The pickle does not hold a log ({fault}): {path}") from None


class _Plain:
    def __init__(self, budget: int) -> None:
        self.budget = budget

    def __call__(self, value: Any, depth: int = 0) -> Any:
        self.budget -= value.array.size if isinstance(value, PickledArray) else 1
        if self.budget < 0 or depth > _DEPTH:
            raise ValueError("it unfolds to far more than the file holds")
        if isinstance(value, float) and not math.isfinite(value):
            return None
        if isinstance(value, str):
            value.encode()  # refuses halves of surrogate pairs, which no file of ours could hold
        if value is None or type(value) in (bool, int, float, str):
            return value
        if isinstance(value, PickledArray):
            plain = not value.array.dtype.hasobject and np.isfinite(value.array).all()
            return value.array.tolist() if plain else self(value.array.tolist(), depth + 1)
        if isinstance(value, _Config):
            return self(value.content, depth + 1)
        if isinstance(value, _Datetime):
            return value.text
        if isinstance(value, dict):
            return {str(self(key, depth + 1)): self(entry, depth + 1) for key, entry in value.items()}
        if isinstance(value, (list, tuple)):
            return [self(entry, depth + 1) for entry in value]
        raise TypeError(f"a {type(value).__name__.strip('_')} does not belong into a log")
