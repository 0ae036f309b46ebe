"""What policies choose is checked like what is chosen from outside."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import pytest

from h3data.errors import InputError
from h3data.scene import FreeSpace, Scene
from h3data_homes import HomeSpec, build_home
from sim_kinematic.agents.skills import Action
from sim_kinematic.policies.policy import PoseAction, Velocity, WaypointAction
from sim_kinematic.sensing.table import SENSORS, Sensor
from sim_kinematic.tasks.control import Control, MotionTeam, VelocityControl
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.recorder import run
from sim_kinematic.tasks.social_nav import SocialNav
from sim_kinematic.tasks.wander import Wander

NAN = float("nan")
MALFORMED = [
    (SocialNav, "robot", Velocity(NAN, 0.0)),
    (SocialNav, "robot", (0.5, 0.5, 0.5)),
    (SocialNav, "robot", ("fast", "left")),
    (SocialNav, "robot", Velocity(np.zeros(2), 0.0)),  # type: ignore[arg-type]
    (SocialNav, "robot", None),
    # choices of the other agent
    (SocialNav, "robot", WaypointAction(np.zeros(2))),
    (SocialNav, "robot", PoseAction(np.zeros(2), 0.0)),
    (SocialNav, "human", WaypointAction(np.array([NAN, 0.0]))),
    (SocialNav, "human", PoseAction(np.zeros(3), 0.0)),
    (Rearrange, "robot", Action("fly")),
    (Rearrange, "robot", Action("pick", 99)),
    (Rearrange, "robot", Action("pick", 0.5)),  # type: ignore[arg-type]
    (Rearrange, "robot", Action("control", command=(NAN,) * 10)),
    (Rearrange, "robot", "pick"),
    (Rearrange, "human", None),
]


@pytest.fixture(scope="module")
def home() -> Scene:
    return build_home(HomeSpec(preset="small", seed=1))


@pytest.fixture(scope="module")
def free(home: Scene) -> FreeSpace:
    return FreeSpace.from_scene(home)


class Says:
    """A policy that always chooses the same."""

    def __init__(self, choice: Any) -> None:
        self._choice = choice

    def act(self, view: Any) -> Any:
        del view
        return self._choice


@pytest.mark.parametrize(("task", "agent", "choice"), MALFORMED)
def test_a_malformed_choice_is_refused_by_the_name_of_its_policy(
    task: Any, agent: str, choice: Any, home: Scene, free: FreeSpace
) -> None:
    episode = task().episode(home, seed=1, free=free)
    play = WorldRollout.of(task(), episode, {agent: Says(choice)})
    with pytest.raises(InputError) as refused:
        run(play, steps=2)
    assert refused.value.code == "H3-TASK-083"
    number = next(k for k, member in enumerate(episode.roster) if member.kind == agent)
    assert repr(play.policies[number].name) in str(refused.value)


def test_a_pair_counts_as_a_velocity(home: Scene, free: FreeSpace) -> None:
    episode = SocialNav().episode(home, seed=1, free=free)
    play = WorldRollout.of(SocialNav(), episode, {"robot": Says((0.0, 0.5))})
    run(play, steps=1)
    assert play.step == 1


class Asking(MotionTeam):
    """A team whose controllers never have enough."""

    def __init__(self, play: Any) -> None:
        super().__init__(play)
        for controller in self.controllers:
            controller.start = lambda choice: None
            controller.step = lambda: None


class AskingControl(VelocityControl):
    def team(self, play: Any) -> Asking:
        return Asking(play)


class Endless(Wander):
    name: ClassVar[str] = "endless"
    control: ClassVar[Control] = AskingControl()


def test_a_controller_that_never_has_enough_is_named_with_its_task(home: Scene, free: FreeSpace) -> None:
    play = WorldRollout.of(Endless(), Endless().episode(home, seed=1, free=free))
    with pytest.raises(InputError, match="H3-TASK-091") as refused:
        run(play, steps=1)
    assert all(word in str(refused.value) for word in ("endless", "robot", "MotionController"))


class Crooked(Wander):
    """A task with a sensor of other rows than worlds."""

    name: ClassVar[str] = "crooked"

    sensors: ClassVar[Mapping[str, Sensor]] = {
        **SENSORS,
        "egomotion": SENSORS["egomotion"]._replace(of=lambda moment: np.zeros((7, 2))),
    }


def test_a_sensor_of_other_rows_than_worlds_is_named_with_task_and_agent(home: Scene, free: FreeSpace) -> None:
    play = WorldRollout.of(Crooked(), Crooked().episode(home, seed=1, free=free))
    with pytest.raises(InputError, match="H3-TASK-092") as refused:
        play.observe(0, 0, ["egomotion"])
    assert all(word in str(refused.value) for word in ("crooked", "robot", "egomotion"))
