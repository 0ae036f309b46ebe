"""Reading of the pickled form of paper-era HITL logs as JSON; nothing in it is executed.

Such a pickle names omegaconf's containers, magnum's vectors and a few of Python's types (spec/habitat-findings.md 10).
They are replaced by placeholders that hold the data of the file.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any

import msgspec

from h3data.errors import FormatError
from h3data_habitat.safe_pickle import Record, builtin, load_pickle


class _Config(Record):
    """omegaconf's DictConfig, ListConfig and AnyNode."""

    content: Any = None

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, dict) or not {"_content", "_val"} & set(state):
            raise TypeError("a configuration holds neither _content nor _val")
        self.content = state["_content"] if "_content" in state else state["_val"]

    def plain(self) -> Any:
        return self.content


class _Metadata(Record):
    """omegaconf's notes about the type of a node, which are not needed."""

    def __setstate__(self, state: Any) -> None:
        del state


class _DefaultDict(dict[Any, Any]):
    """``collections.defaultdict``, without its default."""

    def __init__(self, *_: Any) -> None:
        super().__init__()

    def __setstate__(self, state: Any) -> None:
        raise TypeError("a defaultdict has no state")


class _Datetime(Record):
    """``datetime.datetime``, whose ten bytes are year (2), month, day, hour, minute, second, microsecond (3)."""

    def __init__(self, packed: Any = b"", *zone: Any) -> None:
        if not isinstance(packed, bytes) or len(packed) != 10 or zone:
            raise TypeError("a date is not understood")
        # the layout of `datetime.__reduce__`, big-endian
        year, micro = int.from_bytes(packed[:2], "big"), int.from_bytes(packed[7:], "big")
        month, day, hour, minute, second = packed[2:7]
        self._text = str(datetime(year, month, day, hour, minute, second, micro))

    def plain(self) -> str:
        return self._text


def _vector3(*values: Any) -> Any:
    """Return the three numbers of a magnum vector."""
    # one version of the tool passes a list, another three numbers
    return values[0] if len(values) == 1 else list(values)


_RECORDS: dict[tuple[str, str], Any] = {
    ("collections", "defaultdict"): _DefaultDict,
    ("datetime", "datetime"): _Datetime,
    ("typing", "Any"): Record(),
    ("omegaconf.dictconfig", "DictConfig"): _Config,
    ("omegaconf.listconfig", "ListConfig"): _Config,
    ("omegaconf.nodes", "AnyNode"): _Config,
    ("omegaconf.base", "ContainerMetadata"): _Metadata,
    ("omegaconf.base", "Metadata"): _Metadata,
    ("utils.serialize_utils", "unpickle_vector3"): _vector3,
    ("habitat_hitl.core.serialize_utils", "unpickle_vector3"): _vector3,
}
for _name in ("dict", "list", "tuple", "str", "int", "float", "bool"):  # omegaconf notes them beside its values
    _RECORDS["builtins", _name] = Record()


def json_of_pickled_log(data: bytes, path: Path) -> bytes:
    """Return the log as JSON; dates become text ``YYYY-MM-DD HH:MM:SS.ffffff``, NaN null.

    Raises:
        FormatError: the pickle asks for a name that such logs do not have (the message names it), or is damaged.
    """
    content = load_pickle(data, path, records=_RECORDS)
    try:
        return msgspec.json.encode(content, enc_hook=builtin)
    except (TypeError, ValueError, OverflowError) as fault:
        raise FormatError(f"The pickle does not hold a log ({fault}): {path}", code="H3-HABITAT-073") from None
