"""Reach into a home once the doors and drawers that block it have been opened."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array, transform_points
from h3data.scene import Instance, Scene
from h3data.scene.articulation import joints_of, posed
from sim_kinematic.agents.opening.openables import ArticulatedParts
from sim_kinematic.agents.skills import Objects
from sim_kinematic.motion.state import WorldState


class ReachQuery(NamedTuple):
    """Place to reach, together with the doors and drawers as they are when it is reached."""

    scene: Scene
    """Home in which the doors and drawers around the place are open."""
    point: Array
    """Position of the place with these doors and drawers open, shape [3] [m]."""
    taken: NDArray[np.float64]
    """Floor points [P, 2] below open parts."""
    opened: tuple[tuple[ArticulatedParts, int], ...] = ()
    """Doors and drawers to open, in order: for each, the parts of the home before it opens, and the number of its joint.
    """


def is_drawer(scene: Scene, instance: Instance) -> bool:
    """Return whether an instance is a drawer.

    Its contents are reached from above, however low the space into which it slides.
    """
    joints = joints_of(scene)
    k = joints.owner.get(instance.name, -1)
    return k >= 0 and joints.parts[k][1].joint.kind == "prismatic"


def within_reach(scene: Scene, receptacle: str, point: Array) -> ReachQuery | None:
    """Return how to reach a world point [3] on a receptacle (``instance|receptacle``) once doors and drawers are open.

    Only the doors and drawers that enclose the receptacle are opened.

    Returns None if they cannot be opened.
    """
    joints = joints_of(scene)
    needed = joints.enclosing.get(receptacle, ())
    if not needed:
        return ReachQuery(scene, point, np.zeros((0, 2)))
    opened = _opened(scene, needed)
    if opened is None:
        return None
    there, motions, taken, before = opened
    mover = joints.owner.get(receptacle.partition("|")[0], -1)
    # what lies on a part that opens goes with it
    moved = transform_points(motions[mover], point[None])[0] if mover >= 0 else point
    return ReachQuery(there, moved, taken, before)


@lru_cache(maxsize=64)
def _opened(
    scene: Scene, needed: tuple[int, ...]
) -> tuple[Scene, Array, NDArray[np.float64], tuple[tuple[ArticulatedParts, int], ...]] | None:
    """Return the home with some parts open.

    Returns:
        The home; the motions of all parts [J, 4, 4]; points on the open parts; and each opened part with the home before it
        was opened. None if a part is obstructed while the others stand as the scene has them.
    """
    joints = joints_of(scene)
    openables, before = openables_at(scene, joints.rest), list[tuple[ArticulatedParts, int]]()
    for k in sorted(needed, key=lambda k: joints.parts[k][1].joint.kind == "prismatic"):  # doors first
        if openables.obstacle(k, opens=True):
            return None
        # the positions are copied there, so this is the home before the part opens
        before.append((openables_at(scene, openables.positions), k))
        openables.positions[k] = joints.opened[k]
    positions = openables.positions
    return posed(scene, positions), joints.motions(positions), openables.open_points(), tuple(before)


def openables_at(scene: Scene, positions: Array, doors: frozenset[int] = frozenset()) -> ArticulatedParts:
    """Return the doors and drawers of a home at positions [J] [rad or m], without agents or objects."""
    state = WorldState.zeros(1, robots=0, people=0, scene_joints=len(positions))
    state.joint_pos[0] = positions
    return ArticulatedParts(scene, Objects((), np.zeros((0, 3)), state), 0.0, doors=doors)
