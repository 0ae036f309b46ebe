"""Social navigation app: a person walks through a home, and a robot has to find and follow them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from h3data_play.app import App, Hud
from sim_kinematic.motion.state import HUMAN, ROBOT
from sim_kinematic.tasks.social_nav import SocialNav
from sim_kinematic.tasks.task import Task


class FollowMeApp(App):
    """App in which the player walks freely and the robot follows at a distance of 1 to 2 m."""

    task: ClassVar[str | type[Task]] = SocialNav
    rules: ClassVar[Mapping[str, Any]] = {"max_steps": 2700, "end_on_collision": False, "solid_agents": True}

    def hud(self, number: int) -> Hud:
        """Return the task of the player, the time left, and whether the robot has found the person."""
        session = self.session
        state, spec = session.play.memory, session.episode.spec  # type: ignore[attr-defined]
        metres = float(state.geodesic[0])
        task, whom = "Walk about as you like. The robot has to find you and follow you.", "the person"
        if number == ROBOT:
            task = f"Find the person and follow them at {spec.near_m:g} to {spec.far_m:g} m, facing them."
        elif number == HUMAN:
            whom = "you"
        found = "The robot has found" if state.found[0] else "The robot is looking for"
        return Hud(task=task, left_s=self.left_s, lines=(f"{found} {whom} ({metres:.0f} m).",))
