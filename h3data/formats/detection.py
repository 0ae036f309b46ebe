"""Built-in and third-party formats by name; detection of a file's format."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, Literal

import msgspec

from h3data.errors import FormatError, H3DataError, InputError, PluginError
from h3data.formats.builtin_formats import BUILT_IN, JSON, TABLES, UNKNOWN
from h3data.formats.format import Format
from h3data.formats.source_file import BYTE_ORDER_MARK, SourceFile, decode_json
from h3data.plugins import PluginWarning, Registry, load_reference


def _check(loaded: Any) -> None:
    if not isinstance(loaded, Format):
        raise InputError(f"expected an h3data.formats.Format, got {type(loaded).__name__}.", code="H3-FORMAT-002")
    for field in ("name", "title"):
        if not isinstance(getattr(loaded, field), str) or not getattr(loaded, field):
            raise InputError(f"the field {field!r} must be a text that is not empty.", code="H3-FORMAT-005")
    if loaded.read is None and loaded.write is None:
        raise InputError("one of the fields 'read' and 'write' must be given.", code="H3-FORMAT-003")
    for field in ("read", "write"):
        value = getattr(loaded, field)
        if not (value is None or callable(value) or (isinstance(value, str) and ":" in value)):
            raise InputError(
                f"the field {field!r} must be a function or module:name, got {value!r}.", code="H3-FORMAT-006"
            )


FORMATS: Registry[Format] = Registry(
    "h3data.formats", {one.name: one for one in (*BUILT_IN, *TABLES)}, what="file format", check=_check
)


def load(chosen: Format, field: Literal["read", "write"]) -> Callable[..., Any]:
    """Import the function that reads or writes a format.

    Raises:
        PluginError: the function cannot be imported.
    """
    function = getattr(chosen, field)
    if not isinstance(function, str):
        return function
    try:
        return load_reference(function)
    except H3DataError:
        raise
    except Exception as fault:  # a plug-in's module can raise anything
        raise PluginError(
            f"The field {field!r} of the file format {FORMATS.origin(chosen.name)} cannot be imported from {function}: "
            f"{type(fault).__name__}: {fault}.",
            code="H3-FORMAT-007",
        ) from fault


# --- detection --------------------------------------------------------------------------------------------------------
def detect(path: str | os.PathLike[str]) -> Format:
    """Detect the format of a file from its content, unpacked if it is gzip.

    The file name only distinguishes kinds of config files.

    Only the start of a gfx-replay by habitat-sim is read. NaN and Infinity are accepted although they are not JSON,
    because a file that cannot be read still has a format. Third-party formats are tried if no built-in reader matches.

    Raises:
        InputError: there is no such file.
    """
    file = SourceFile.of(path)
    try:
        # most files are recognized by their first bytes, without being read
        built_in = _by_beginning(file.head)
        if built_in is JSON:
            members = _members(file)
            built_in = UNKNOWN if members is None else json_format(members, name=file.path.name)
        built_in = _registered(built_in)
    except FormatError:
        return replace(UNKNOWN, title="a damaged gzip archive")
    if built_in.read is not None and built_in.name not in {one.name for one in TABLES}:
        return built_in
    return next(_third_party_formats(file), built_in)


def format_by_beginning(head: bytes) -> Format:
    """Return the built-in format of a file that starts with ``head``, or `JSON` if the format depends on its members."""
    return _registered(_by_beginning(head))


def _registered(recognised: Format) -> Format:
    """Return the format of this name with its reader, writer and advice; without its package, advice to install it."""
    if recognised not in (*BUILT_IN, *TABLES):
        return recognised
    package = FORMATS.missing().get(recognised.name)
    if package is None:
        return FORMATS.get(recognised.name)
    return replace(
        recognised,
        hint=f"its package {package} is not in this installation; install h3data as a whole",
    )


def _by_beginning(head: bytes) -> Format:
    text = head.removeprefix(BYTE_ORDER_MARK)
    for one in (*BUILT_IN, *TABLES):
        if one.begins is not None and one.begins.match(text):
            return one
    # what begins like JSON is decoded later, as its members decide which kind it is
    if text.lstrip()[:1] in (b"{", b"["):
        return JSON
    if not head:
        return replace(UNKNOWN, title="an empty file")
    if head.startswith(b"\x1f\x8b"):
        return replace(UNKNOWN, title="a gzip archive")
    return replace(UNKNOWN, title="text" if b"\0" not in head else "binary data of an unknown kind")


def json_format(document: Any, *, name: str = "") -> Format:
    """Return the built-in format of a decoded JSON document from a file called ``name``."""
    if not isinstance(document, dict):
        return JSON
    return next((one for one in BUILT_IN if one.members is not None and one.members(document, name)), JSON)


def _members(file: SourceFile) -> Any:
    """Return the values that `Format.members` reads; None if the file is not JSON. Other values are not decoded."""
    try:
        members = decode_json(file.data, dict[str, msgspec.Raw])
        # only whether a value is an object decides, except for keyframes: a file may have hundreds of MB
        objects = {key: {} if bytes(text).startswith(b"{") else None for key, text in members.items()}
        return objects | {key: decode_json(bytes(members[key])) for key in ("keyframes", "keyframe") if key in members}
    except msgspec.ValidationError:  # JSON, but no object
        return []
    except msgspec.DecodeError:  # NaN and Infinity, which Python's own reader takes
        pass
    try:
        return json.loads(file.data.removeprefix(BYTE_ORDER_MARK))
    except (ValueError, RecursionError):
        return None


def _third_party_formats(file: SourceFile) -> Iterator[Format]:
    """Yield the installed formats that match a file, and warn about those whose check fails."""
    plugins = FORMATS.load_third_party()
    members = _members(file) if any(one.members is not None for one in plugins.values()) else None
    head = file.head.removeprefix(BYTE_ORDER_MARK)
    for one in plugins.values():
        try:
            if one.begins is not None or one.members is not None:
                fits = bool(one.begins is not None and one.begins.match(head))
                fits |= one.members is not None and isinstance(members, dict) and one.members(members, file.path.name)
            else:
                # a format without a check is taken at the word of the file's name; no name ends in \0
                fits = file.path.name.endswith(one.suffixes or ("\0",))
        except Exception as fault:  # a plug-in can raise anything
            text = f"the field 'members' fails with {type(fault).__name__}: {fault}."
            warnings.warn(f"Ignored: the file format {FORMATS.origin(one.name)}: {text}", PluginWarning, stacklevel=4)
            continue
        if fits and one.read is not None:
            yield one


# --- lists ------------------------------------------------------------------------------------------------------------


def export_options() -> Mapping[str, Format]:
    """Return the formats that recordings can be exported to, by their names on the command line."""
    return {one.option: one for one in FORMATS.load_all().values() if one.write is not None}
