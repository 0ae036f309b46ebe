"""Sliding as Habitat's base action does it, disc by disc on the navmesh (``BaseSpec(slide="habitat")``).

The rules are ``BaseVelNonCylinderAction``'s (spec/habitat.md 1.3); against recorded steps of it:
tests/sim/motion/test_habitat_slide.py.
Each disc steps on its own over the navmesh, which is shrunk by the disc's radius. If one does not get where the command
takes it, the base moves by the way of the disc that is worst off, and turns all the same. Nobody looks again at the
others, which is why it may get into walls.
"""

from __future__ import annotations

import math

from h3data.kernels import kernel
from h3data.scene.navmesh._surface import try_step


@kernel(error_model="numpy")
def slide_as_habitat(surface, x, root_y, z, heading, goal, offsets, touch, rules):
    """One step of a robot base: ``(x, z, heading, touched)``.

    ``goal`` is where it would get in the open, ``(x, z, heading)``; ``root_y`` [m] the height of its root; ``offsets`` [D]
    the places of its discs along its x axis; ``rules`` says whether it slides, slides while it turns, and whether a disc's
    own step slides.
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
    if worst <= touch:
        return goal[0], goal[1], goal[2], False
    if not rules[0] or (goal[2] != heading and not rules[1]):
        return x, z, heading, True
    return x + along_x, z + along_z, goal[2], True
