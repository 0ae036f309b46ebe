"""Wandering: agents heed each other as those of rearrangement do."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from h3data.recording import Recording
from h3data.scene.open import named_scenes, open_scene
from sim_kinematic.motion.spec import HOME_WALKER, SocialNavSpec, WalkerSpec
from sim_kinematic.tasks.play import DecisionLoop, WorldRollout
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.resume import resume, verify
from sim_kinematic.tasks.wander import Wander

STEPS = 450


@lru_cache(maxsize=2)
def wander(number: int, agents: str, *, steps: int = STEPS, human: WalkerSpec | None = None) -> Recording:
    """The episode of a validation home with its number as seed."""
    spec = SocialNavSpec(max_steps=steps) if human is None else SocialNavSpec(max_steps=steps, human=human)
    scene = open_scene(named_scenes("h3-homes/val")[number].source)
    return simulate(Wander(), Wander().episode(scene, seed=number, spec=spec, agents=agents))


def longest_stand(recording: Recording, agent: int) -> int:
    """Most steps in a row in which an agent moves by less than a millimetre."""
    xz = recording.columns[f"agent_{agent}.base_pose"][:, [0, 2]].astype(np.float64)
    moves = np.flatnonzero(np.hypot(*np.diff(xz, axis=0).T) > 1e-3)
    return int(np.diff(np.concatenate([[-1], moves, [len(xz) - 1]])).max()) - 1


@pytest.mark.parametrize(
    ("number", "agents"),
    # each had contacts, or somebody who stood for more than 200 steps, before agents had a right of way
    [
        pytest.param(0, "robot,human,male_1", marks=pytest.mark.slow),
        pytest.param(3, "robot,robot,human,male_1", marks=pytest.mark.slow),
        (3, "robot,human,male_1"),
    ],
)
def test_nobody_touches_anybody_or_stays_stuck(number: int, agents: str) -> None:
    recording = wander(number, agents)
    assert not recording.columns["metrics.collision"].any()
    assert max(longest_stand(recording, k) for k in range(len(recording.agents))) < 130


@pytest.mark.slow
def test_people_who_turn_on_the_spot_let_each_other_pass() -> None:
    recording = wander(1, "robot,human,male_1", human=HOME_WALKER)
    assert not recording.columns["metrics.collision"].any()
    assert max(longest_stand(recording, k) for k in range(3)) < 130


def test_it_is_simulated_again_bit_for_bit() -> None:
    recording = wander(3, "robot,human,male_1")
    assert verify(recording).difference is None
    again = resume(recording, 200)
    for name, values in recording.columns.items():
        np.testing.assert_array_equal(again.columns[name], values, err_msg=name)


def test_the_world_makes_the_step_that_an_agent_has_tried() -> None:
    """Else the test for contact would be of postures that never come about."""
    scene = open_scene(named_scenes("h3-homes/val")[3].source)
    episode = Wander().episode(scene, seed=3, spec=SocialNavSpec(max_steps=60), agents="robot,human,male_1")
    play = WorldRollout.of(Wander(), episode)
    assert isinstance(play, WorldRollout)
    loop = DecisionLoop(play)
    while not loop.over:
        while loop.asked is not None:
            loop.answer(play.policies[loop.asked].policy.act(play.view(loop.asked)))
        traffic = play.agent_view(0).traffic()
        for actor, own in zip(traffic.actors, play.world.state.agents, strict=True):
            np.testing.assert_allclose(actor.xz, own.xz[0], rtol=0, atol=1e-6)
            assert actor.heading == pytest.approx(own.heading[0], abs=1e-6)
        loop.go_on()
