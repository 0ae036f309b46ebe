"""A person and a robot give way to each other; by Habitat's rules, and in recordings from before, the person does not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import h3data
from h3data.bodies.people.kernels.planted import SPEED
from h3data.scene import FreeSpace, Scene
from h3data_homes import HomeSpec, build_home
from sim_kinematic.agents import giving_way
from sim_kinematic.agents.robots.driving import RobotDriver
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.avoidance.stand_offs import TaskProgress
from sim_kinematic.contact.frames import root_pose
from sim_kinematic.motion.spec import STEP_S, BaseSpec, WalkerSpec
from sim_kinematic.policies.rearrange import Chooser
from sim_kinematic.policies.views import CloseView, RearrangeView
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.rearrange.codec import rules_from_json, rules_to_json
from sim_kinematic.tasks.rearrange.episode import RearrangeSpec
from sim_kinematic.tasks.recorder import run, simulate
from sim_kinematic.tasks.skills.household import Household
from tests.simulated import REARRANGE, rearrange_episode

HABITAT = RearrangeSpec(robot=BaseSpec(slide="habitat"), human=WalkerSpec(), reward="habitat")


@pytest.fixture(scope="module")
def home() -> Scene:
    return build_home(HomeSpec(preset="small", seed=5))


@pytest.fixture(scope="module")
def free(home: Scene) -> FreeSpace:
    return FreeSpace.from_scene(home)


def test_rules_say_whether_people_give_way() -> None:
    assert RearrangeSpec().people_give_way
    assert not HABITAT.people_give_way
    assert repr(replace(HABITAT, people_give_way=True)) == repr(HABITAT)  # episodes keep their identity
    before = {name: value for name, value in rules_to_json(RearrangeSpec()).items() if name != "people_give_way"}
    assert not rules_from_json(before).people_give_way
    for spec in (RearrangeSpec(), HABITAT):
        assert rules_from_json(rules_to_json(spec)) == spec


@pytest.mark.slow
def test_only_a_driven_person_and_habitats_heed_nobody(home: Scene, free: FreeSpace) -> None:
    for spec, heeds in ((RearrangeSpec(), True), (HABITAT, False)):
        episode = rearrange_episode(home, seed=1, spec=spec, free=free)
        play = WorldRollout.of(REARRANGE, episode, {"robot": "complement", "human": "both"})
        assert (play.team.company.right_of_way is not None) == heeds  # type: ignore[attr-defined]
        person = play.team.people[0]  # type: ignore[attr-defined]
        assert play.team.company.avoids(person, play.team.robots[0]) == heeds  # type: ignore[attr-defined]


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_nobody_stands_aside_for_good(home: Scene, free: FreeSpace, seed: int) -> None:
    episode = rearrange_episode(home, seed=seed, free=free)
    play = WorldRollout.of(REARRANGE, episode, {"robot": "greedy_nearest", "human": "both"})
    asked: list[list[bool]] = []

    def look(step: int) -> None:
        asked.append([actor.aside is not None for actor in play.team.actors])  # type: ignore[attr-defined]

    run(play, progress=look)
    for steps in np.array(asked).T:
        spans = np.diff(np.flatnonzero(np.diff(np.concatenate([[False], steps, [False]]))))[::2]
        assert spans.max(initial=0) <= 2 * AVOIDANCE.lasts_steps, "asked at most twice in a row"
    assert not play.world.touching.any()


def test_a_robot_is_asked_wherever_it_would_interrupt(home: Scene, free: FreeSpace) -> None:
    reasons = []

    class Watched(Chooser):
        def may_interrupt(self, glance: CloseView) -> bool:
            self.may = super().may_interrupt(glance)
            return True

        def interrupts(self, view: RearrangeView) -> str:
            reason = super().interrupts(view)
            reasons.append(reason)
            assert self.may or not reason
            return reason

    robot = Watched(lambda view, left: max(left, default=None) if view.step // 30 % 2 else min(left, default=None))
    episode = rearrange_episode(home, seed=1, free=free)
    run(WorldRollout.of(REARRANGE, episode, {"robot": robot, "human": "both"}), steps=160)
    assert any(reasons)


@pytest.mark.slow
def test_people_set_off_and_brake_where_they_step_aside(home: Scene, free: FreeSpace) -> None:
    """People were at 1.3 m/s from one step to the next.

    This person first walks backwards, because they turn while they walk off. Where their feet change to walking forwards, the
    speed follows that of the gait (`PlantedWalk.speed_mps`), which passes 0 at 9 m/s^2.
    """
    episode = rearrange_episode(home, seed=1, free=free)
    play = WorldRollout.of(REARRANGE, episode, {"robot": "still", "human": "both"})
    person = play.team.people[0]  # type: ignore[attr-defined]
    path = person._path(free.sample(np.random.default_rng(3), 1)[0])
    assert np.hypot(*(path[0] - person.xz)) > 0.5
    person.aside, places, gait_mps = path[:1], [person.xz.copy()], []
    for _ in range(200):
        gait_mps.append(person.person.walk.state[SPEED])
        person.idle()
        places.append(person.xz.copy())
    speeds = np.hypot(*np.diff(places, axis=0).T) * 30
    assert np.hypot(*(places[-1] - path[0])) < 0.01, "they get there"
    assert speeds.max() > 0.4
    changes = np.abs(np.diff(speeds))
    forwards = int(np.argmax(np.array(gait_mps) > 0.0))
    assert min(gait_mps) < -0.4, "they begin backwards"
    assert changes.max() < 9.0 * STEP_S + 1e-9
    assert np.delete(changes, range(forwards - 3, forwards)).max() < 0.15


@pytest.mark.slow
def test_a_person_who_is_done_leaves_the_doorway(tmp_path: Path) -> None:
    """The person stood in the bathroom's doorway for 300 steps before the robot that carried the last thing."""
    h3data.generate(
        "rearrange", tmp_path / "ds", scenes="h3-homes/test", policies="complement", partners="both", episodes=1, seed=4
    )
    assert h3data.open(tmp_path / "ds")[0].episode.info["ended"] == "success"


def test_what_is_kept_of_agents_who_stand_changes_nothing(
    home: Scene, free: FreeSpace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Roots, contact and progress are kept until somebody moves or acts otherwise: worked out anew they are the same."""
    episode = rearrange_episode(home, seed=2, free=free)
    kept = simulate(REARRANGE, episode)
    errand = Household.errand

    def anew(team: Household, number: int) -> TaskProgress:
        team._errands.clear()
        return errand(team, number)

    monkeypatch.setattr(Household, "errand", anew)
    monkeypatch.setattr(giving_way, "_is_same", lambda was, now: False)
    pose = property(lambda robot: root_pose(robot.robot, robot.xz, robot.heading, robot.free))
    monkeypatch.setattr(RobotDriver, "pose", pose)
    again = simulate(REARRANGE, episode)
    for name, values in kept.columns.items():
        np.testing.assert_array_equal(values, again.columns[name], err_msg=name)
