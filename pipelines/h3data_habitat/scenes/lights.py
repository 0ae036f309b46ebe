"""Habitat's lighting configs as `LightSource` records."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np

from h3data.errors import FormatError
from h3data.scene.records import LightFrame, LightKind, LightSource
from h3data_habitat.scenes.config_keys import KeyNotes
from h3data_habitat.scenes.config_values import mapping, number, numbers, text


def read_lights(content: Mapping[str, Any], keys: KeyNotes, *, where: Path) -> tuple[LightSource, ...]:
    """Return the lights of a ``*.lighting_config.json``, in the order of the file (spec/habitat.md 6.3).

    Intensities are multiplied by the file's ``positive_intensity_scale`` or ``negative_intensity_scale`` by their sign.
    Colours are as the file gives them.
    """
    keys.note("lighting_config", content)
    scales = [number(content, f"{sign}_intensity_scale", 1.0, where=where) for sign in ("positive", "negative")]
    lights = mapping(content, "lights", where=where)
    return tuple(_light(name, mapping(lights, name, where=where), scales, keys, where) for name in lights)


def _light(name: str, entry: Mapping[str, Any], scales: list[float], keys: KeyNotes, where: Path) -> LightSource:
    keys.note("light", entry)
    kind = (text(entry, "type", where=where) or ("directional" if "direction" in entry else "point")).lower()
    frame = (text(entry, "position_model", where=where) or "global").lower()
    for key, value, known in (("type", kind, LightKind), ("position_model", frame, LightFrame)):
        if value not in get_args(known):
            raise FormatError(
                f"Expected {', '.join(get_args(known))} under {key!r} of light {name!r}, got {value[:60]!r}: {where}",
                code="H3-HABITAT-114",
            )
    key, default = ("direction", (0, -1, 0)) if kind == "directional" else ("position", (0, 0, 0))
    intensity = number(entry, "intensity", 1.0, where=where)
    spot = mapping(entry, "spot", where=where)
    return LightSource(
        name=name,
        kind=cast("LightKind", kind),
        vector=np.array(numbers(entry, key, default, where=where), np.float64),
        color=np.array(numbers(entry, "color", (1, 1, 1), where=where), np.float64),
        # the second scale is that of negative lights, which darken
        intensity=intensity * scales[intensity < 0],
        frame=cast("LightFrame", frame),
        cone_rad=(
            number(spot, "innerConeAngle", 0.0, where=where),
            number(spot, "outerConeAngle", np.pi / 2 if kind == "spot" else 0.0, where=where),
        ),
    )
