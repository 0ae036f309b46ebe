"""What agents choose becomes commands, or skills that go on by themselves."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.recording import SkillSpan
from sim_kinematic.agents.skills import Action, SkillResult
from sim_kinematic.avoidance.yielding import NO_PATH
from sim_kinematic.motion.state import HumanState
from sim_kinematic.policies.policy import GaitAction, PoseAction, Velocity, WaypointAction
from sim_kinematic.tasks.control import MotionController, command_of
from sim_kinematic.tasks.skills.controller import CHOICES, SkillController
from sim_kinematic.world import DriveCommand, GaitCommand, PoseCommand, WaypointCommand

numbers = st.floats(-1.0, 1.0)


# --- motion -------------------------------------------------------------------------------------------------------------
@given(st.lists(st.tuples(numbers, numbers), min_size=1, max_size=4))
def test_choices_of_all_worlds_are_one_command(pairs: list[tuple[float, float]]) -> None:
    wanted = np.array(pairs)
    driven = command_of([Velocity(*pair) for pair in pairs], "robot")
    assert isinstance(driven, DriveCommand)
    np.testing.assert_array_equal(driven.velocity, wanted.astype(np.float32))  # as they are recorded
    walked = command_of([WaypointAction(np.array(pair)) for pair in pairs], "human")
    assert isinstance(walked, WaypointCommand)
    np.testing.assert_array_equal(walked.points, wanted)
    placed = command_of([PoseAction(np.array(pair), pair[0]) for pair in pairs], "human")
    assert isinstance(placed, PoseCommand)
    np.testing.assert_array_equal(placed.points, wanted)
    np.testing.assert_array_equal(placed.headings, wanted[:, 0])
    gaits = [HumanState.zeros(1) for _ in pairs]
    for gait, pair in zip(gaits, pairs, strict=True):
        gait.xz[0] = pair
    paced = command_of([GaitAction(gait) for gait in gaits], "human")
    assert isinstance(paced, GaitCommand)
    np.testing.assert_array_equal(paced.gait.xz, wanted)


def test_other_choices_are_refused() -> None:
    for choice in (None, (0.5, 0.5), Action("wait")):
        with pytest.raises(InputError, match="H3-TASK-069"):
            command_of([choice], "robot")


def test_who_drives_chooses_in_every_step() -> None:
    controller = MotionController("human")
    for step in range(3):
        controller.begin(step)
        assert controller.status == "choosing"
        controller.start(Velocity(1.0, 0.0))
        assert controller.status == "acting"
        assert controller.step() is not None
        assert controller.status == "acting"


# --- skills -------------------------------------------------------------------------------------------------------------
@dataclass
class Doer:
    """Somebody whose skill ``wait`` takes its steps and whose other skills take none; ``pick`` is impossible."""

    path: NDArray[np.float64] = field(default_factory=lambda: NO_PATH)
    yields: bool = True
    did: list[str] = field(default_factory=list)

    def infeasible(self, action: Action) -> str:
        return "out_of_reach" if action.skill == "pick" else ""

    def start(self, action: Action) -> Generator[None, None, SkillResult]:
        for _ in range(action.steps if action.skill == "wait" else 0):
            self.did.append(action.skill)
            yield
        return SkillResult("done")

    def idle(self) -> None:
        self.did.append("idle")


class Played:
    """A controller under a list of choices."""

    def __init__(self, choices: list[Action]) -> None:
        self.doer, self.spans, self.choices = Doer(), list[SkillSpan](), choices
        self.controller = SkillController(0, self.doer, self.spans, ("cup",))  # type: ignore[arg-type]
        self.asked: list[int] = []
        """How often it was asked in each step."""

    def step(self, interrupt: str = "") -> None:
        controller, asked = self.controller, 0
        controller.begin(len(self.asked))
        if interrupt:
            controller.interrupt(interrupt)
        while True:
            if controller.status == "choosing":
                asked += 1
                controller.start(self.choices.pop(0))
            controller.step()
            if controller.status != "choosing":
                break
        self.asked.append(asked)

    def told(self) -> list[tuple[str, int, int, str]]:
        return [(span.name, span.start_step, span.end_step, span.outcome) for span in self.spans]


def test_a_skill_goes_on_until_it_ends_and_the_next_begins_in_the_same_step() -> None:
    played = Played([Action("wait", steps=2), Action("wait", steps=5)])
    for _ in range(3):
        played.step()
    assert played.asked == [1, 0, 1]
    assert played.doer.did == ["wait"] * 3
    assert played.told() == [("wait", 0, 1, "done")]
    played.controller.finish(2, completed=False)
    assert played.told()[1:] == [("wait", 2, 2, "running")]


def test_what_is_impossible_takes_a_step() -> None:
    played = Played([Action("pick", 0), Action("wait", steps=1)])
    played.step()
    assert (played.doer.did, played.told()) == (["idle"], [("pick", 0, 0, "failed")])
    assert played.controller.ending == ("failed", "out_of_reach")
    played.step()
    assert played.doer.did == ["idle", "wait"]


def test_skills_without_end_of_the_step_are_given_up() -> None:
    played = Played([Action("nav_to_goal", 0)] * (CHOICES + 1))
    played.step()
    assert (played.asked, played.doer.did) == ([CHOICES], ["idle"])
    assert len(played.spans) == CHOICES == played.controller.completed


def test_who_is_interrupted_and_chooses_the_same_again_goes_on() -> None:
    long, other = Action("wait", steps=9), Action("wait", steps=3)
    played = Played([long, long, other])
    played.step()
    played.step("agents_close")
    assert played.spans == []
    assert played.controller.ending is None
    played.step("agents_close")
    assert played.told() == [("wait", 0, 1, "aborted")]
    assert (played.controller.action, played.asked) == (other, [1, 1, 1])
    assert played.doer.did == ["wait"] * 3
