"""Pictures of training environments for people who watch: an agent from obliquely above, without ceilings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array, heading_direction
from h3data.render import Camera, look_at, pinhole

if TYPE_CHECKING:
    from sim_kinematic.sensing.camera_sensor import StateRenderer

SIZE, HFOV_DEG = (640, 480), 60.0
DISTANCE_M, ELEVATION_DEG = 4.2, 50.0
SIDES = 12
"""Number of directions from which the camera may look."""


class DebugRenderer:
    """Renderer for people who watch: its camera follows one agent of one world.

    It looks from the same side of the world until walls or furniture hide the agent, then changes to the side from
    which most of the agent is visible.
    """

    def __init__(self) -> None:
        self._side = -1

    def picture(self, drawn: StateRenderer, agent: int = 0) -> NDArray[np.uint8]:
        """Return a picture uint8 [480, 640, 3] of the only world of ``drawn``, in the last pose."""
        target = drawn.middle(agent)[0]
        # small pictures are enough to tell from which side the agent is seen best
        trials = [_camera(target, side, (64, 48)) for side in range(SIDES)]
        pictures = drawn.picture(trials, ("instance", "depth"))
        # all trials in one batch: they share what is posed
        seen, depth = (pictures[output].reshape(SIDES, -1) for output in ("instance", "depth"))
        pixels = [np.isin(seen, drawn.instances(k)).sum(1) for k in range(len(drawn.bodies))]
        most = max(int(pixels[agent].max()), 1)
        others = sum((np.minimum(p / most, 1.0) for k, p in enumerate(pixels) if k != agent), np.zeros(SIDES))
        # 3.2: surfaces nearer to the camera than this are in front of the agent, which is 4.2 m away [m]
        is_open = 1 - ((depth > 0) & (depth < 3.2)).mean(1)
        # weight of another agent in the picture relative to the agent itself
        weight = 0.5
        score = pixels[agent] / most + weight * others + is_open
        # only to a side that is clearly better, or the camera would jump back and forth
        if self._side < 0 or score[self._side] < score.max() - 0.25:
            self._side = int(score.argmax())
        return drawn.picture([_camera(target, self._side, SIZE)], ("rgb",))["rgb"][0]

    def __repr__(self) -> str:
        return f"DebugRenderer(side {self._side} of {SIDES})"


def _camera(target: Array, side: int, size: tuple[int, int]) -> Camera:
    """Return a camera that looks at a point [3] from one of the `SIDES`."""
    elevation = np.radians(ELEVATION_DEG)
    x, z = np.cos(elevation) * heading_direction(2 * np.pi * side / SIDES)
    pose = look_at(target + DISTANCE_M * np.array([x, np.sin(elevation), z]), target)
    return pinhole(*size, hfov_deg=HFOV_DEG, name="watching", pose=pose, hidden_layers=("ceiling",))
