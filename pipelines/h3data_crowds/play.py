"""Live play among people of crowds: players walk about a home in which others walk, and robots drive to goals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from h3data_crowds.crowd_nav import CrowdNav
from h3data_play.app import App, Hud
from sim_kinematic.tasks.task import Task


class CrowdApp(App):
    """App in which players walk among people of a crowd, or drive the robot past them to its goal."""

    task: ClassVar[str | type[Task]] = CrowdNav
    rules: ClassVar[Mapping[str, Any]] = {"max_steps": 3600, "end_on_collision": False, "solid_agents": True}
    names = True

    def hud(self, number: int) -> Hud:
        """Return the task of the player, the time left, and for the robot the way to its goal."""
        if number < 0 or self.session.episode.roster[number].kind == "human":
            return Hud(task="Walk about as you like. The robot drives past people to its goal.", left_s=self.left_s)
        memory = self.session.play.memory
        (x, z), free = memory["goal"][0].tolist(), self.session.episode.free
        return Hud(
            task="Drive to the ring, and touch nobody.",
            left_s=self.left_s,
            lines=(f"{float(memory['left'][0]):.0f} m to go",),
            marker=(x, float(free.floor_y), z),
        )
