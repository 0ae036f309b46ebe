"""Rearrangement: a person, or somebody who steers the robot, brings things to their places."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from h3data_play.app import App, Goal, Hud, sentence_of
from h3data_play.drivers import Driver, PersonDriver, RobotDriver
from sim_kinematic.agents.driven.person import DrivenPerson
from sim_kinematic.tasks.rearrange.codec import spoken
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.task import Task


class RearrangeApp(App):
    """App in which all objects are brought to their goals, together with the other agents."""

    task: ClassVar[str | type[Task]] = Rearrange
    # as in the paper's study: contact is counted, it does not end the episode
    rules: ClassVar[Mapping[str, Any]] = {"max_steps": 5400, "end_on_collision": False, "solid_agents": True}

    def driver(self, number: int) -> Driver:
        """Driver of a person or a robot with skills."""
        is_person = isinstance(self.session.play.team.actors[number], DrivenPerson)  # type: ignore[attr-defined]
        return (PersonDriver if is_person else RobotDriver)(self.session, number)

    def hud(self, number: int) -> Hud:
        """Instruction, time left, and the number of things at their goals."""
        done = int(self.session.play.team.at_goal.sum())  # type: ignore[attr-defined]
        words = str(self.session.recorder.header.episode.info["instruction"])
        lines = (f"{done} of {len(self.goals())} things are where they belong.",)
        return Hud(task=sentence_of(words), left_s=self.left_s, lines=lines)

    def goals(self) -> list[Goal]:
        """Goal of each object, with its name in words."""
        targets = self.session.episode.targets  # type: ignore[attr-defined]
        return [Goal(position=tuple(t.goal.tolist()), label=spoken(t.destination) or "its goal") for t in targets]

    def label(self, name: str) -> str:
        """Name of an object in words."""
        return spoken(name) or "thing"
