"""Light sources of a scene: windows, lamps, and the lights that scene files name."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.plugins import Registry
from h3data.scene.records import LightSource, Scene, instance_bounds

BAKERS: Registry[Callable[..., Any]] = Registry("h3data.lights", {}, what="light")
"""Functions that compute a lit scene from meshes, instances, indices of static instances, and `LightSources`."""
LightMode = Literal["baked", "flat"]
"""Kind of light. ``baked``: windows, sun and lamps light the home (`h3data.render.light`). ``flat``: the same light
everywhere."""


def check_light(light: object) -> None:
    """Raise an error for a value that is not a `LightMode`.

    Raises:
        InputError: the value is not a `LightMode`.
    """
    if light not in get_args(LightMode):
        raise InputError(
            f"Unknown light {light!r}. Expected one of: {', '.join(get_args(LightMode))}.", code="H3-RENDER-046"
        )


@dataclass(frozen=True)
class Window:
    """Window pane: an upright rectangle through which sky light enters."""

    center: NDArray[np.float64]
    half_u: NDArray[np.float64]
    """Vector of half the horizontal side, shape [3] [m]."""
    half_v: NDArray[np.float64]
    """Vector of half the vertical side, shape [3] [m]."""
    across: NDArray[np.float64]
    """Unit normal of the pane, shape [3]; the bake determines which side is indoors."""


@dataclass(frozen=True)
class Lamp:
    """Point light source."""

    position: NDArray[np.float64]
    power: NDArray[np.float64]
    """Linear RGB irradiance at 1 m, shape [3]."""


@dataclass(frozen=True)
class LightSources:
    """All light sources of a scene, some of which are given by names of instances."""

    windows: tuple[Window, ...] = ()
    lamps: tuple[Lamp, ...] = ()
    suns: tuple[tuple[NDArray[np.float64], NDArray[np.float64]], ...] = ()
    """Additional suns, each a unit vector towards the sun and a linear RGB irradiance."""
    glass: frozenset[str] = field(default_factory=frozenset)
    """Instances of window panes, which let the sun through and look bright."""
    glowing: frozenset[str] = field(default_factory=frozenset)
    """Instances of lamps, which cast no shadow and look bright."""
    glossy: frozenset[str] = field(default_factory=frozenset)
    """Instances of floors of varnished wood and glazed tile, which reflect slightly."""


def sources_of(scene: Scene | None, *, file: str = "") -> LightSources:
    """Return the light sources of a scene: window panes, lamps, and the lights of its file.

    Lights that cannot be used (NaN, negative power) are left out, with a warning that names the light and the ``file``.
    """
    if scene is None:
        return LightSources()
    windows, lamps, glass, glowing, glossy = [], [], set(), set(), set()
    for instance in scene.static_instances:
        category = scene.assets[instance.asset].category
        if category == "window" and len(scene.assets[instance.asset].mesh.vertices):
            bounds = instance_bounds(scene, instance)
            size = bounds[1] - bounds[0]
            # a window is thinner than it is wide, and stands upright
            across = 0 if size[0] < size[2] else 2
            along = 2 - across
            axis, u, v = np.eye(3)[across], np.zeros(3), np.zeros(3)
            u[along], v[1] = max(size[along] / 2 - 0.09, 0.05), max(size[1] / 2 - 0.05, 0.05)
            windows.append(Window(center=bounds.mean(0), half_u=u, half_v=v, across=axis))
            glass.add(instance.name)
        elif category in ("ceiling_lamp", "floor_lamp", "table_lamp", "lamp") and len(
            scene.assets[instance.asset].mesh.vertices
        ):
            low, high = instance_bounds(scene, instance)
            position = (low + high) / 2
            # a point below the shade of a ceiling lamp, and in the upper part of those that stand
            position[1] = low[1] - 0.12 if category == "ceiling_lamp" else high[1] - 0.1
            share = 1.0 if category == "ceiling_lamp" else 0.35
            # irradiance 3.2, in units of the flat light, at 1 m below the lamp of a home; a warm white
            lamps.append(Lamp(position, 3.2 * share * np.array((1.0, 0.86, 0.68))))
            glowing.add(instance.name)
        elif category == "floor":
            glossy.add(instance.name)
    file_lamps, suns = _named(scene.lights or (), file or scene.name)
    return LightSources(
        windows=tuple(windows),
        lamps=(*lamps, *file_lamps),
        suns=suns,
        glass=frozenset(glass),
        glowing=frozenset(glowing),
        glossy=frozenset(glossy),
    )


def _named(
    lights: Sequence[LightSource], file: str
) -> tuple[tuple[Lamp, ...], tuple[tuple[NDArray[np.float64], NDArray[np.float64]], ...]]:
    lamps, suns = [], []
    for light in lights:
        numbers = np.concatenate([light.vector, light.color, [light.intensity]])
        fault = ""
        if not np.isfinite(numbers).all():
            fault = "has numbers that are not finite"
        elif light.intensity < 0 or light.color.min() < 0:
            fault = f"has negative power ({light.intensity:g} x {light.color.tolist()})"
        elif light.frame != "global":
            fault = f"moves with the {light.frame}"
        elif light.kind == "directional" and not np.linalg.norm(light.vector):
            fault = "has no direction"
        if fault:
            logging.getLogger(__name__).warning(
                "Light %r %s: the picture is rendered without it. Scene: %s", light.name, fault, file
            )
            continue
        power = light.color * light.intensity
        if light.kind == "directional":
            suns.append((-light.vector / np.linalg.norm(light.vector), power))
        else:  # of a spot, its cone is ignored
            lamps.append(Lamp(light.vector.astype(np.float64), power))
    return tuple(lamps), tuple(suns)
