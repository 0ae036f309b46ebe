"""PointGoal among people: episodes, endings, rewards, baselines, and what other commands make of its recordings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from benchmarks.people import hall
from h3data.builtin import builtin_root
from h3data.errors import InputError, SceneError
from h3data.metrics import measure
from h3data.scene import FreeSpace
from h3data_crowds.crowd_nav import CrowdNav, CrowdNavSpec
from h3data_crowds.imitation import FILE, PEOPLE, SEEN_M, observe
from h3data_crowds.robots import ROBOTS
from h3data_viewers.html_report.added_time import added_time_table
from h3data_viewers.html_report.report import SECTIONS
from sim_kinematic.agents.roster import make_roster
from sim_kinematic.policies.network import load_network
from sim_kinematic.policies.policy import Velocity
from sim_kinematic.policies.views import AgentView
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.resume import verify


@pytest.fixture(scope="module")
def floor() -> FreeSpace:
    return FreeSpace.from_scene(hall(), cache=False)


def in_hall(floor: FreeSpace, person: tuple[float, float, float], **rules: Any) -> Episode:
    """The robot at (3, 6) looks along x; its goal is at (13, 6)."""
    task = CrowdNav()
    spec = CrowdNavSpec(max_steps=600, **rules)
    episode = task.sample(hall(), floor, 0, spec, make_roster("robot,human"))
    return replace(episode, starts=np.array([[3.0, 6.0, 0.0], person]), extra={"goal": [13.0, 6.0]})


@pytest.mark.parametrize("name", [*sorted(ROBOTS), "imitation", "reinforced"])
def test_baselines_get_to_the_goal_past_somebody_who_stands_beside_the_path(floor: FreeSpace, name: str):
    episode = in_hall(floor, (8.0, 8.0, 0.0))
    recording = simulate(CrowdNav(), episode, {"robot": name, "human": "still"})
    assert recording.episode.info["ended"] == "success"
    values = measure(recording).values
    assert values["SR"] == 1.0
    assert values["H_coll"] == 0.0
    assert verify(recording).difference is None


@pytest.mark.parametrize("name", ["dwa", "mpc", "social_force", "yielding"])
def test_those_that_heed_people_do_not_drive_into_who_stands_in_their_way(floor: FreeSpace, name: str):
    recording = simulate(CrowdNav(), in_hall(floor, (8.0, 6.05, np.pi)), {"robot": name, "human": "still"})
    assert recording.episode.info["ended"] != "collision"


def test_the_shortest_path_leads_into_who_stands_on_it(floor: FreeSpace):
    episode = in_hall(floor, (8.0, 6.0, np.pi))
    recording = simulate(CrowdNav(), episode, {"robot": "shortest_path", "human": "still"})
    assert recording.episode.info["ended"] == "collision"
    assert recording.columns["metrics.collision"][-1]
    assert measure(recording).values["SR"] == 0.0
    goes_on = in_hall(floor, (8.0, 6.0, np.pi), end_on_collision=False)
    assert len(simulate(CrowdNav(), goes_on, {"robot": "shortest_path", "human": "still"})) > len(recording)


def test_rewards_are_progress_and_the_arrival(floor: FreeSpace):
    recording = simulate(CrowdNav(), in_hall(floor, (8.0, 10.0, 0.0)), {"robot": "shortest_path", "human": "still"})
    rewards, left = recording.columns["metrics.reward"], recording.columns["metrics.goal_distance"]
    assert rewards.sum() == pytest.approx(10.0 - left[-1] + 10.0, abs=0.02)
    assert left[-1] < 0.5


def test_a_goal_is_far_and_roomy_and_the_same_again():
    recordings = [h3data.simulate("crowd_nav", "small:0", seed=3, max_steps=2) for _ in range(2)]
    goals = [r.episode.info["extra"]["goal"] for r in recordings]
    assert goals[0] == goals[1]
    assert recordings[0].columns["metrics.goal_distance"][0] > 4.8


def test_a_home_without_room_is_refused():
    with pytest.raises(SceneError, match="H3-TASK-074"):
        h3data.simulate("crowd_nav", "small:0", seed=3, goal_path_m=80.0)


def test_environments_show_the_goal():
    env = h3data.make("crowd_nav", "small:0", num_envs=2, observations=["goal_gps", "range_scan"])
    seen, _ = env.reset(seed=1)
    assert seen["goal_gps"].shape == (2, 2)
    assert (seen["goal_gps"][:, 0] > 0.5).all()
    for _ in range(10):
        seen, reward, *_ = env.step(np.tile(np.array([[1.0, 0.0]], np.float32), (2, 1)))
        assert np.isfinite(reward).all()
    env.close()


def test_reports_show_the_added_time_of_people(tmp_path: Path):
    roster = ["robot", "human", "human"]
    for seed in (6, 9):
        play = {"robot": "still", "human": "orca"}
        h3data.simulate(
            "wander", "small:1", roster=roster, agents=play, seed=seed, max_steps=450, record=tmp_path / f"{seed}.mcap"
        )
    h3data.simulate("wander", "small:1", roster=roster, seed=1, max_steps=5, record=tmp_path / "other.mcap")
    table = added_time_table([tmp_path])
    assert "1 episode left out" in table.caption
    (row,) = table.sections[0].rows
    found = [
        person.seconds
        for seed in (6, 9)
        for person in SECTIONS.get("added_time")(h3data.load_recording(tmp_path / f"{seed}.mcap"))
        if person.seconds is not None
    ]
    assert row.cells[1].value == np.median(found)
    with pytest.raises(InputError, match="H3-TASK-081"):
        added_time_table([tmp_path / "other.mcap"])


class Shown:
    """A robot that stands still and notes what the network would be shown."""

    def __init__(self) -> None:
        self.rows: list[np.ndarray] = []

    def act(self, view: AgentView) -> Velocity:
        self.rows.append(observe(view, view.base))
        return Velocity(0.0, 0.0, "wait")


def test_the_learned_robot_is_shown_the_same_wherever_it_looks_and_stands(floor: FreeSpace):
    shown = []
    for turned in (0.0, np.pi):  # the hall is symmetric about its centre (9, 6)
        robot, person, goal = np.array([3.0, 5.0]), np.array([5.0, 6.5]), np.array([13.0, 6.0])
        if turned:
            robot, person, goal = ([18.0, 12.0] - place for place in (robot, person, goal))
        episode = in_hall(floor, (*person.tolist(), 0.0))
        starts = np.array([[*robot, turned + 0.3], [*person, 0.0]])
        pupil = Shown()
        simulate(
            CrowdNav(),
            replace(episode, spec=replace(episode.spec, max_steps=2), starts=starts, extra={"goal": goal.tolist()}),
            {"robot": pupil, "human": "still"},
        )
        shown.append(pupil.rows[1])
    assert load_network(builtin_root() / FILE).inputs == len(shown[0])
    np.testing.assert_allclose(shown[0], shown[1], atol=0.03)  # of the grid of distances
    people = shown[0][-5 * PEOPLE :].reshape(PEOPLE, 5)
    assert people[0, 2] == pytest.approx(1 - np.hypot(2.0, 1.5) / SEEN_M, abs=1e-6)
    assert not people[1:].any(), "nobody else is there"
