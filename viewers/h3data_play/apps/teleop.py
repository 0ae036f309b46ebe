"""Tele-operation app: a player drives the robot, grasps objects with its arm, and brings them to their goals."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from h3data.recording.records import agent_numbers
from h3data_play.app import Hud
from h3data_play.apps.rearrange import RearrangeApp
from h3data_play.drivers import Driver
from sim_kinematic.tasks.sessions import Session, StepResult


class TeleopApp(RearrangeApp):
    """App in which an operator drives the robot, alone or next to a person who follows a policy (``--partner``)."""

    seats: ClassVar[tuple[str, ...]] = ("robot",)
    partner: ClassVar[str | None] = "solo"

    def reset(self, session: Session) -> None:
        """Start an episode with all counts at 0."""
        super().reset(session)
        self.drivers: dict[int, Driver] = {}
        self.bumps = self.touches = 0
        self._was = {"metrics.robot_contact": False, "metrics.collision": False}

    def driver(self, number: int) -> Driver:
        """Return the driver of an agent, and store it for the text about its hand."""
        driver = self.drivers[number] = super().driver(number)
        return driver

    def step(self, result: StepResult) -> str:
        """Count new contacts of the robot with the home and with people."""
        columns = self.session.recorder.latest_columns()
        self.bumps += self._begins("metrics.robot_contact", columns)
        self.touches += self._begins("metrics.collision", columns)
        return super().step(result)

    def hud(self, number: int) -> Hud:
        """Return the lines of rearrangement, the state of the hand, and the counts of contacts."""
        hud = super().hud(number)
        counts = f"Bumps into the home: {self.bumps}."
        if agent_numbers(self.session.episode.roster, "human"):
            counts += f" Touches of people: {self.touches}."
        return Hud(task=hud.task, left_s=hud.left_s, lines=(*hud.lines, self._hand(number), counts))

    def _hand(self, number: int) -> str:
        """Return the text about the held object, or the distance of the nearest object that is not at its goal yet."""
        objects = self.session.play.team.objects  # type: ignore[attr-defined]
        number = number if number in self.drivers else next(iter(self.drivers), 0)
        held = objects.held(number)
        if held >= 0:
            return f"The gripper holds the {self.label(objects.names[held])}."
        if self.session.recorder.latest is None:
            return "The gripper is empty."
        poses = self.session.recorder.latest_columns()["object_pose"][-1].astype(np.float64)
        gaps = np.hypot(*(poses[:, [0, 2]] - self.drivers[number].place[0]).T)
        gaps[np.asarray(self.session.play.team.at_goal)] = np.inf  # type: ignore[attr-defined]
        k = int(gaps.argmin())
        if not np.isfinite(gaps[k]):
            return "The gripper is empty."
        # half metres: the line is sent again whenever it changes
        return f"The gripper is empty; the {self.label(objects.names[k])} is {round(gaps[k] * 2) / 2:g} m away."

    def _begins(self, name: str, columns: dict[str, np.ndarray]) -> bool:
        now = bool(columns[name][-1]) if name in columns else False
        was, self._was[name] = self._was[name], now
        return now and not was
