"""Rearrangement app: a person, or a player who drives the robot, brings objects to their goals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from h3data_play.app import App, Hud, sentence_of
from sim_kinematic.crowd.roles import routines
from sim_kinematic.tasks.rearrange.codec import spoken
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.task import Task


class RearrangeApp(App):
    """App in which players and other agents bring all objects to their goals."""

    task: ClassVar[str | type[Task]] = Rearrange
    # as in the paper's study: contact is counted, it does not end the episode
    # chores come from another package, which an installation may lack
    rules: ClassVar[Mapping[str, Any]] = {
        "max_steps": 5400,
        "end_on_collision": False,
        "solid_agents": True,
        "chores": "chores" in routines().names(),
    }

    def hud(self, number: int) -> Hud:
        """Return the instruction, the time left, and the number of things at their goals."""
        done = int(self.session.play.team.at_goal.sum())  # type: ignore[attr-defined]
        words = str(self.session.recorder.header.episode.info["instruction"])
        lines = (f"{done} of {len(self.goals())} things are where they belong.",)
        return Hud(task=sentence_of(words), left_s=self.left_s, lines=lines)

    def label(self, name: str) -> str:
        """Return the name of an object in words."""
        return spoken(name) or "thing"
