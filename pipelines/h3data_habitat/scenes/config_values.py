"""Checked values of Habitat's JSON configs, with errors that name the key and the file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import Any

from h3data.errors import FormatError
from h3data_habitat.json_files import read_json


def read_object(path: Path) -> dict[str, Any]:
    """Return the content of a JSON file that must hold an object."""
    content = read_json(path)
    if not isinstance(content, dict):
        raise FormatError(f"Expected a JSON object, got {type(content).__name__}: {path}", code="H3-HABITAT-113")
    return content


def mapping(attributes: Mapping[str, Any], key: str, *, where: Path) -> dict[str, Any]:
    """Return the JSON object under ``key``; empty if there is none."""
    value = attributes.get(key)
    if value is not None and not isinstance(value, dict):
        raise _unexpected("an object", key, value, where)
    return value or {}


def objects(attributes: Mapping[str, Any], key: str, *, where: Path) -> list[dict[str, Any]]:
    """Return the list of JSON objects under ``key``; empty if there is none."""
    value = _list(attributes, key)
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise _unexpected("a list of objects", key, value, where)
    return value


def texts(attributes: Mapping[str, Any], key: str, *, where: Path) -> tuple[str, ...]:
    """Return the list of texts under ``key``; empty if there is none."""
    value = _list(attributes, key)
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise _unexpected("a list of texts", key, value, where)
    return tuple(value)


def text(attributes: Mapping[str, Any], key: str, *, where: Path) -> str | None:
    """Return the text under ``key``, or None."""
    value = attributes.get(key)
    if value is not None and not isinstance(value, str):
        raise _unexpected("a text", key, value, where)
    return value


def flag(attributes: Mapping[str, Any], key: str, default: bool, *, where: Path) -> bool:
    """Return whether ``key`` is true."""
    value = attributes.get(key, default)
    if not isinstance(value, bool):
        raise _unexpected("true or false", key, value, where)
    return value


def number(attributes: Mapping[str, Any], key: str, default: float, *, where: Path) -> float:
    """Return the finite number under ``key``."""
    value = attributes.get(key, default)
    if not _is_number(value):
        raise _unexpected("a finite number", key, value, where)
    return float(value)


def whole_number(attributes: Mapping[str, Any], key: str, default: int, *, where: Path) -> int:
    """Return the whole number from 0 to 2^31 - 1 under ``key``."""
    value = number(attributes, key, default, where=where)
    if value != int(value) or not 0 <= value < 2**31:
        raise _unexpected("a whole number from 0 to 2147483647", key, attributes.get(key), where)
    return int(value)


def numbers(attributes: Mapping[str, Any], key: str, default: Sequence[float], *, where: Path) -> tuple[float, ...]:
    """Return the finite numbers under ``key``, as many as ``default`` has."""
    value = attributes.get(key)
    if value is None:
        return tuple(default)
    if not isinstance(value, list) or len(value) != len(default) or not all(_is_number(v) for v in value):
        raise _unexpected(f"{len(default)} finite numbers", key, value, where)
    return tuple(float(v) for v in value)


def points(attributes: Mapping[str, Any], key: str, *, where: Path) -> list[tuple[float, float, float]]:
    """Return the list of points ``[x, y, z]`` under ``key``; empty if there is none."""
    value = _list(attributes, key)
    fine = isinstance(value, list) and all(
        isinstance(p, list) and len(p) == 3 and all(_is_number(v) for v in p) for p in value
    )
    if not fine:
        raise _unexpected("a list of points [x, y, z]", key, value, where)
    return [(float(x), float(y), float(z)) for x, y, z in value]


def _list(attributes: Mapping[str, Any], key: str) -> Any:
    """Return the list under ``key``; an empty list if there is none."""
    value = attributes.get(key)
    return [] if value is None else value


def _is_number(value: Any) -> bool:
    try:
        return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
    except OverflowError:  # an integer of hundreds of digits
        return False


def _unexpected(expected: str, key: str, value: Any, where: Path) -> FormatError:
    return FormatError(f"Expected {expected} under {key!r}, got {str(value)[:60]}: {where}", code="H3-HABITAT-112")
