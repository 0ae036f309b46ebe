"""Pictures of one agent in one world, for policies that request them, equal to those of training environments."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

from numpy.typing import NDArray

from h3data.geometry import Array
from h3data.render.light.sources import LightMode
from h3data.scene import Scene
from sim_kinematic.contact.frames import Body, Floor
from sim_kinematic.motion.state import WorldState
from sim_kinematic.sensing.agent_pictures import AgentPictures, in_colour
from sim_kinematic.sensing.camera_sensor import StateRenderer
from sim_kinematic.sensing.sensor import scaled_depth

PictureSize = tuple[int, int] | Mapping[str, tuple[int, int]] | None
"""Width and height of all pictures, or of some by name [pixels]; None: those of each camera."""


def see(
    state: WorldState,
    scene: Scene,
    bodies: Sequence[Body],
    names: Sequence[str],
    *,
    agent: int,
    size: PictureSize = None,
    floor: Floor = 0.0,
    speed_mps: float | None = None,
    objects: Sequence[str] = (),
    frames: Sequence[Array] | None = None,
    light: LightMode = "flat",
    lit_as: Scene | None = None,
) -> dict[str, NDArray[Any]]:
    """Return named pictures of an agent without noise, scaled as in `sim_kinematic.sensing.observation_set`.

    Args:
        state: State of one world.
        scene: Home of the world.
        bodies: Bodies of all agents in the order of the state.
        names: Some of `sim_kinematic.sensing.agent_pictures.picture_names` and of the names of the cameras of the body.
        agent: Number of the agent whose cameras are used.
        size: Width and height [pixels], one for all or by name of a picture; None is each camera's own.
        floor: Map of the home's floor, or the height of that floor [m].
        speed_mps: Walking speed of people [m/s], which selects their motion clips.
        objects: Names of the instances that the state moves.
        frames: Frames of all agents, as in `StateRenderer.pose`.
        light: Light in ``*_rgb``; nothing else depends on it.
        lit_as: Scene whose baked light the surfaces carry, as in `StateRenderer`.

    Returns:
        ``*_depth`` [H, W, 1] in 0..1 of `DEPTH_RANGE_M`, ``*_rgb`` and cameras uint8 [H, W, 3], the detector [1].
    """
    # without colours all lights look alike: they share the renderer of flat light, and nothing is baked
    seen_in, like = (light, lit_as) if any(in_colour(name, bodies[agent]) for name in names) else ("flat", None)
    rendered = shared_renderer(scene, tuple(bodies), tuple(objects), speed_mps, seen_in, like, threading.get_ident())
    # shared with other policies of this thread, so it is posed anew each time
    rendered.pose(state, floor=floor, frames=frames)
    by_name = size if isinstance(size, Mapping) else dict.fromkeys(names, size) if size is not None else {}
    sizes = tuple((name, tuple(each)) for name, each in by_name.items())
    pictures = _pictures(bodies[agent], tuple(names), agent, sizes).take(rendered)
    return {name: scaled_depth(p[0]) if name.endswith("_depth") else p[0] for name, p in pictures.items()}


@lru_cache(maxsize=64)
def _pictures(body: Body, names: tuple[str, ...], agent: int, sizes: tuple[tuple[str, Any], ...]) -> AgentPictures:
    return AgentPictures(body, names, agent=agent, sizes=dict(sizes))


# packing a home costs as much as some hundred pictures
@lru_cache(maxsize=4)
def shared_renderer(
    scene: Scene,
    bodies: tuple[Body, ...],
    objects: tuple[str, ...],
    speed_mps: float | None,
    light: LightMode,
    lit_as: Scene | None,
    thread: int,
) -> StateRenderer:
    """Return the renderer of a thread (`threading.get_ident`) for one world of a home, cached between calls.

    The other arguments are those of `StateRenderer`.
    """
    del thread  # a renderer must not be shared between threads
    return StateRenderer(scene, bodies, objects=objects, speed_mps=speed_mps, light=light, lit_as=lit_as)
