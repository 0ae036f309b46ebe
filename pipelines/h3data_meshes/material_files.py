"""Support for options of images in MTL files, which trimesh mistakes for a part of the image's name."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from h3data.geometry import Array

_MAP = re.compile(rb"^([ \t]*map_Kd)[ \t]+(.*?)[ \t\r]*$", re.IGNORECASE | re.MULTILINE)
_ONE_WORD = {"-blendu", "-blendv", "-cc", "-clamp", "-imfchan", "-type", "-bm", "-boost", "-texres", "-colorspace"}
_NUMBERS = {"-o": 3, "-s": 3, "-t": 3, "-mm": 2}
_UV_KEY = "h3data_uv"
"""Line of a material that carries scale and offset through trimesh's reader."""


def mtl_with_plain_names(data: bytes) -> bytes:
    """Return an MTL file's bytes with plain image names after ``map_Kd``, without options.

    ``-s`` and ``-o``, the scale and the offset of the image, are moved to a separate line, which `material_uv` reads.
    """
    return _MAP.sub(lambda found: _plain(found[1], found[2].decode("utf-8", "surrogateescape")), data)


def _plain(key: bytes, rest: str) -> bytes:
    values = {"-s": [1.0, 1.0], "-o": [0.0, 0.0]}
    while True:
        word, _, behind = rest.partition(" ") if "\t" not in rest else rest.replace("\t", " ").partition(" ")
        option = word.lower()
        if option not in _ONE_WORD and option not in _NUMBERS:
            break
        rest = behind.lstrip()
        if option in _ONE_WORD:
            rest = rest.partition(" ")[2].lstrip()
            continue
        taken: list[float] = []
        while len(taken) < _NUMBERS[option]:
            word, _, behind = rest.partition(" ")
            if not behind or not re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", word):
                break
            taken.append(float(word))
            rest = behind.lstrip()
        if option in values:
            values[option][: min(len(taken), 2)] = taken[:2]
    if len(rest) > 1 and rest[0] == rest[-1] == '"':
        rest = rest[1:-1]
    line = key + b" " + rest.encode("utf-8", "surrogateescape")
    numbers = [*values["-s"], *values["-o"]]
    if numbers == [1, 1, 0, 0]:
        return line
    return line + f"\n{_UV_KEY} {' '.join(map(repr, numbers))}".encode()


def material_uv(material: Any, uv: Array) -> Array:
    """Return texture coordinates [V, 2] for the image that a material of trimesh scales and shifts."""
    numbers = getattr(material, "kwargs", {}).get(_UV_KEY)
    if numbers is None:
        return uv
    scale, offset = np.array(numbers, np.float64).reshape(2, 2)
    return np.asarray(uv, np.float64)[:, :2] * scale + offset
