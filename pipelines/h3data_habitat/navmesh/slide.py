"""Sliding as Habitat's base action does it, disc by disc on the navmesh (``BaseSpec(slide="habitat")``).

The rules are ``BaseVelNonCylinderAction``'s (spec/habitat.md 1.3); against recorded steps of it:
tests/habitat/navmesh/test_slide.py.
Each disc steps on its own over the navmesh, which is shrunk by the disc's radius. If one does not get where the command
takes it, the base moves as far as its most obstructed disc, and turns all the same. The other discs are not checked again,
which is why they may get into walls.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from h3data.errors import InputError
from h3data.kernels import kernel
from h3data.scene.freespace.free_space import FreeSpace
from h3data_habitat.navmesh._surface import try_step
from h3data_habitat.navmesh.pathfinder import PathFinder


@kernel(error_model="numpy")
def slide_as_habitat(surface, x, root_y, z, heading, goal, offsets, touch, rules):
    """Return one step of a robot base: ``(x, z, heading, touched)``.

    ``goal`` is its pose ``(x, z, heading)`` after the step if nothing were in its path, ``root_y`` [m] the height of
    its root, and ``offsets`` [D] the positions of its discs along its x axis. ``rules`` states whether the base slides,
    whether it slides while it turns, and whether a disc's own step slides.
    """
    c, s = math.cos(heading), math.sin(heading)
    goal_c, goal_s = math.cos(goal[2]), math.sin(goal[2])
    worst, along_x, along_z = -1.0, 0.0, 0.0
    for offset in offsets:
        start_x, start_z = x + c * offset, z - s * offset
        end_x, end_z = goal[0] + goal_c * offset, goal[1] - goal_s * offset
        reached_x, _, reached_z = try_step(surface, start_x, root_y, start_z, end_x, root_y, end_z, rules[2])
        short = math.hypot(reached_x - end_x, reached_z - end_z)
        if short > worst:
            worst, along_x, along_z = short, reached_x - start_x, reached_z - start_z
    # the base gets there where none of its discs is held up
    if worst <= touch:
        return goal[0], goal[1], goal[2], False
    # as Habitat: what touches while it turns stays where it was, if it may not slide then
    if not rules[0] or (goal[2] != heading and not rules[1]):
        return x, z, heading, True
    return x + along_x, z + along_z, goal[2], True


@kernel(error_model="numpy")
def _slide_worlds(surface, root_y, xz, heading, contact, goals, drives, offsets, touch, rules):
    for w in range(len(heading)):
        contact[w] = False
        if drives[w]:
            goal = goals[w, 0], goals[w, 1], goals[w, 2]
            xz[w, 0], xz[w, 1], heading[w], contact[w] = slide_as_habitat(
                surface, xz[w, 0], root_y, xz[w, 1], heading[w], goal, offsets, touch, rules
            )


@lru_cache(maxsize=8)
def _finder(free: FreeSpace) -> PathFinder:
    return PathFinder(free)


def slide_bases(
    free: FreeSpace,
    finder: PathFinder | None,
    *,
    moved: tuple[np.ndarray, np.ndarray, np.ndarray],
    goals: np.ndarray,
    drives: np.ndarray,
    offsets: np.ndarray,
    touch_m: float,
    root_height_m: float,
    rules: tuple[bool, bool, bool],
) -> None:
    """Move robot bases in W worlds by one step as Habitat does, in place; an entry of the group ``h3data.slides``.

    Args:
        free: the free floor, of one level.
        finder: navmesh of the floor; by default it is made from ``free`` and cached.
        moved: positions [W, 2] (x, z) [m], headings [W] [rad], and whether each base touches something [W].
        goals: pose (x, z, heading) of each base after the step if nothing were in its path, [W, 3].
        drives: True for bases that move, [W].
        offsets: places [D] of the discs along the x axis of the base [m].
        touch_m: a disc displaced by more than this has touched something [m].
        root_height_m: height of the base's root over the floor [m].
        rules: whether bases slide, slide while they turn, and whether a disc's own step slides.

    Raises:
        InputError: the floor has stairs.
    """
    if len(free.heights):
        raise InputError(
            "Bases slide as in Habitat on one level floor only. Hint: slide='strict' in homes with stairs.",
            code="H3-SIM-037",
        )
    # a floor has one navmesh for all its steps, which takes longer to build than to use
    surface = (finder or _finder(free)).surface
    _slide_worlds(surface, free.floor_y + root_height_m, *moved, goals, drives, offsets, touch_m, rules)
