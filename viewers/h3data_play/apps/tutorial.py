"""Tutorial app: a player alone in a home walks to a mark, looks at an object, takes it, and brings it to its goal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np

from h3data.geometry import Array, wrap_angle
from h3data_play.app import Hud
from h3data_play.apps.rearrange import RearrangeApp
from h3data_play.drivers import Driver, PersonDriver
from h3data_play.messages import Act, Drop, Give, Pick, Place
from sim_kinematic.tasks.sessions import Session, StepResult

MARK_AHEAD_M = 2.5
"""Distance from the start to the mark along the path to the object or its goal [m]; shorter if that path is short."""
SNAP_M = 5.0
"""Distance within which the path to a thing on furniture ends on the nearest floor [m]."""
AT_MARK_M = 0.5
LOOKS_RAD = 0.35
LOOK_STEPS = 15
"""Number of steps for which a player has to look at the object, so that a player who happens to face it sees the step."""
WALK, LOOK, TAKE, PUT = range(4)
HOW: Mapping[int, Mapping[str, str]] = {
    WALK: {
        "keys": "W goes ahead, A and D turn, S goes back. The arrow keys do it, too.",
        "mouse": "Click on the floor at the ring. W, A, S and D walk there, too.",
        "touch": "Push the stick at the lower left upwards, or to a side to turn. A tap on the floor walks there.",
        "pad": "The left stick walks and turns.",
        "headset": "The left stick walks where you look.",
    },
    LOOK: {
        "keys": "Turn with A and D until you face it.",
        "mouse": "Click on the floor before it, or turn with A and D until you face it.",
        "touch": "Push the stick to the left or to the right until you face it.",
        "pad": "Push the left stick to a side until you face it.",
        "headset": "Turn until you face it.",
    },
}
"""Instructions for the steps that only the tutorial has, by step and device; the page's hints explain the other steps."""


class TutorialApp(RearrangeApp):
    """App of the tutorial, which ends with ``success`` when all steps have been completed."""

    rules: ClassVar[Mapping[str, Any]] = {**RearrangeApp.rules, "objects": 1, "max_steps": 18_000, "chores": False}
    partner: ClassVar[str | None] = "solo"

    def reset(self, session: Session) -> None:
        """Start an episode in which no player has completed a step of the tutorial."""
        super().reset(session)
        self.drivers: dict[int, Driver] = {}
        self.marks: dict[int, Array] = {}
        self.walked: dict[int, bool] = {}
        self.looked: dict[int, int] = {}

    def driver(self, number: int) -> Driver:
        """Return the driver of an agent, and choose a mark on the floor for its player."""
        driver = self.drivers[number] = super().driver(number)
        self.marks[number] = self._mark(number)
        return driver

    def refusal(self, number: int, message: Act) -> str:
        """Return a request to complete earlier steps first if a player takes or places the object too early."""
        step = self.step_of(number)
        if step < TAKE and isinstance(message, Pick | Place | Drop | Give):
            first = (
                f"{self._go(number).lower()} to the white ring" if step == WALK else f"turn towards the {self.thing}"
            )
            return f"Not yet: first {first}."
        return ""

    def step(self, result: StepResult) -> str:
        """Record which players have reached their mark or look at the object."""
        for number, driver in self.drivers.items():
            xz, heading = driver.place
            step = self.step_of(number)
            if step == WALK:
                self.walked[number] = bool(np.hypot(*(xz - self.marks[number])) < AT_MARK_M)
            elif step == LOOK:
                count = self.looked.get(number, 0) + 1 if self._looks(driver, xz, heading) else 0
                self.looked[number] = count
        return super().step(result)

    def hud(self, number: int) -> Hud:
        """Return the current step of the tutorial, and all steps as a list."""
        current = self.step_of(number)
        thing, goal, go = self.thing, self.goals()[0].label, self._go(number)
        short = f"{go} to the white ring", f"Look at the {thing}", f"Take the {thing}", f"Put it on the {goal}"
        lines = [f"{'✓' if k < current else '→' if k == current else '·'} {text}" for k, text in enumerate(short)]
        tasks = (
            f"{go} to the white ring.",
            f"Look at the {thing}, marked A. The map shows where it is.",
            f"Take the {thing}.",
            f"Bring the {thing} to the {goal}.",
        )
        step = min(current, PUT)
        mark = None
        if current == WALK and number in self.marks:
            x, z = self.marks[number].tolist()
            mark = (x, float(self.session.episode.free.height_at(self.marks[number])), z)
        return Hud(task=tasks[step], left_s=None, lines=tuple(lines), how=HOW.get(step, {}), marker=mark)

    def over(self, number: int) -> str:
        """Return the text at the end of the tutorial, with praise if it was passed."""
        if self.session.ended == "success":
            return "You have done all steps: you can walk, look, take things and put them where they belong."
        return super().over(number)

    def step_of(self, number: int) -> int:
        """Return the tutorial step of an agent's player; `PUT` + 1 means that all are completed.

        Spectators see the step of the first player.
        """
        number = number if number in self.drivers else next(iter(self.drivers), number)
        if not self.walked.get(number):
            return WALK
        if self.looked.get(number, 0) < LOOK_STEPS:
            return LOOK
        objects = self.session.play.team.objects  # type: ignore[attr-defined]
        if bool(self.session.play.team.at_goal[0]) and objects.held(number) != 0:  # type: ignore[attr-defined]
            return PUT + 1
        return PUT if objects.held(number) == 0 else TAKE

    @property
    def thing(self) -> str:
        """Name of the object to take, as players read it."""
        return self.label(self.session.episode.targets[0].name)  # type: ignore[attr-defined]

    def _go(self, number: int) -> str:
        return {"robot": "Drive", "human": "Walk"}[self.session.episode.roster[max(number, 0)].kind]

    def _mark(self, number: int) -> Array:
        """Return a point of the floor on the longer one of the paths to the thing and to its place."""
        target = self.session.episode.targets[0]  # type: ignore[attr-defined]
        start, free = self.session.episode.starts[number, :2], self.session.episode.floor(number)
        paths = [free.path(start, point[[0, 2]], max_snap_m=SNAP_M) for point in (target.start, target.goal)]
        path = max(paths, key=_length)
        return _along(path, min(MARK_AHEAD_M, 0.7 * _length(path))) if len(path) else start.copy()

    def _looks(self, driver: Driver, xz: Array, heading: float) -> bool:
        thing = self.session.recorder.latest_columns()["object_pose"][-1, 0, [0, 2]].astype(np.float64)
        head = driver.head[0] if isinstance(driver, PersonDriver) and driver.head is not None else 0.0
        dx, dz = thing - xz
        return abs(float(wrap_angle(math.atan2(-dz, dx) - heading - head))) < LOOKS_RAD


def _length(path: Array) -> float:
    return float(np.hypot(*np.diff(path, axis=0).T).sum()) if len(path) > 1 else 0.0


def _along(path: Array, metres: float) -> Array:
    """Return the point at a distance along a path [N, 2]."""
    for a, b in pairwise(path):
        leg = float(np.hypot(*(b - a)))
        if metres <= leg:
            return a + (b - a) * (metres / max(leg, 1e-9))
        metres -= leg
    return np.array(path[-1])
