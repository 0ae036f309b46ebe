"""The pickled form of paper-era HITL logs, as the plain values that their JSON form holds; nothing in it is executed.

Such a pickle names omegaconf's containers, magnum's vectors and a few of Python's types (spec/habitat-findings.md 10).
Stand-ins take their place: they keep what the file says and do nothing with it.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.array_pickle import unpickle_arrays
from h3data.errors import FormatError
from h3data.plain_values import PlainValues


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
        return _LogValues(data)(content)
    except (TypeError, ValueError) as fault:
        raise FormatError(f"The pickle does not hold a log ({fault}): {path}") from None


class _LogValues(PlainValues):
    """NaN becomes None, as in the JSON form of these logs; stand-ins become what they hold."""

    of = "a log"

    def key(self, key: Any, depth: int) -> str:
        return str(self(key, depth))

    def array(self, array: NDArray[Any], depth: int) -> Any:
        plain = not array.dtype.hasobject and np.isfinite(array).all()
        return array.tolist() if plain else self(array.tolist(), depth + 1)

    def not_finite(self, value: float) -> None:
        del value

    def other(self, value: Any, depth: int) -> Any:
        if isinstance(value, _Config):
            return self(value.content, depth + 1)
        return value.text if isinstance(value, _Datetime) else super().other(value, depth)
