"""What policies choose is checked like what is chosen from outside."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from h3data.errors import InputError
from h3data.scene import FreeSpace, Scene
from h3data_homes import HomeSpec, build_home
from sim_kinematic.agents.skills import Action
from sim_kinematic.policies.policy import PoseAction, Velocity, WaypointAction
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.recorder import run
from sim_kinematic.tasks.social_nav import SocialNav

NAN = float("nan")
MALFORMED = [
    (SocialNav, "robot", Velocity(NAN, 0.0)),
    (SocialNav, "robot", (0.5, 0.5, 0.5)),
    (SocialNav, "robot", ("fast", "left")),
    (SocialNav, "robot", Velocity(np.zeros(2), 0.0)),  # type: ignore[arg-type]
    (SocialNav, "robot", None),
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
