"""People of a crowd in a hall, at a door and in homes: they get there, and nobody touches anybody."""

from __future__ import annotations

import numpy as np
import pytest

import h3data
from benchmarks.people import hall
from h3data.errors import InputError
from h3data.recording import Recording
from h3data.scene import FreeSpace
from sim_kinematic.crowd.crowd import Crowd, CrowdModel
from sim_kinematic.crowd.errands import Errand, Guide
from sim_kinematic.crowd.traits import Traits
from sim_kinematic.tasks.resume import verify
from tests.sim.crowd.walks import NOBODY, Discs
from tests.sim.crowd.walks import step as step_among

MODELS: tuple[CrowdModel, ...] = ("orca", "social_force")


@pytest.fixture(scope="module")
def floor() -> FreeSpace:
    return FreeSpace.from_scene(hall(), cache=False)


def person(speed: float = 1.3, side: float = 1.0, patience_s: float = 6.0) -> Traits:
    return Traits(speed, 0.5, 0.1, 0.34, side, patience_s)


def path_to(goal: tuple[float, float]) -> Guide:
    return lambda xz, given, taken: Errand(np.array([xz, goal if given is None else given]))


def walk(crowd: Crowd, starts: list[tuple[float, float]], headings: list[float], steps: int, others: Discs = NOBODY):
    """Positions [steps + 1, M, 2]."""
    xz, heading = np.array(starts), np.array(headings)
    before, track = xz.copy(), [xz]
    for step in range(steps):
        (xz, heading), before = step_among(crowd, xz, heading, before, others, step), xz
        track.append(xz)
    return np.array(track)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_two_who_meet_pass_on_their_side(floor: FreeSpace, model: CrowdModel, side: float):
    goals = [(15.0, 6.0), (3.0, 6.0)]
    crowd = Crowd(floor, [person(side=side)] * 2, [path_to(goal) for goal in goals], model)
    track = walk(crowd, [(3.0, 6.0), (15.0, 6.0)], [0.0, np.pi], 420)
    gaps = np.hypot(*(track[:, 0] - track[:, 1]).T)
    assert gaps.min() > 0.68
    assert gaps.min() < 2.0
    assert np.hypot(*(track[:, 0] - goals[0]).T).min() < 0.5
    assert np.hypot(*(track[:, 1] - goals[1]).T).min() < 0.5
    at = int(gaps.argmin())
    assert np.sign(track[at, 0, 1] - track[at, 1, 1]) == side, "the right of who walks along x is at larger z"


@pytest.mark.parametrize("model", MODELS)
def test_nobody_gets_into_anybody_even_in_a_circle(floor: FreeSpace, model: CrowdModel):
    angles = np.arange(8) * np.pi / 4
    starts = np.stack([9 + 4 * np.cos(angles), 6 + 4 * np.sin(angles)], 1)
    goals = 2 * np.array([9.0, 6.0]) - starts
    crowd = Crowd(floor, [person()] * 8, [path_to((x, z)) for x, z in goals], model)
    track = walk(crowd, [tuple(s) for s in starts], (np.pi - angles).tolist(), 900)
    gaps = np.hypot(*(track[:, :, None] - track[:, None]).transpose(3, 0, 1, 2))
    assert gaps[:, ~np.eye(8, dtype=bool)].min() >= 0.68 - 1e-9
    arrived = (np.hypot(*(track - goals).transpose(2, 0, 1)) < 0.5).any(0)
    assert arrived.all()


@pytest.mark.parametrize("model", MODELS)
def test_people_walk_round_a_robot_that_stands_still(floor: FreeSpace, model: CrowdModel):
    robot = Discs(np.array([[9.0, 6.0]]), np.array([0.25]))
    crowd = Crowd(floor, [person()], [path_to((15.0, 6.0))], model)
    track = walk(crowd, [(3.0, 6.0)], [0.0], 400, robot)
    assert np.hypot(*(track[:, 0] - [9.0, 6.0]).T).min() >= 0.59 - 1e-9
    assert np.hypot(*(track[:, 0] - [15.0, 6.0]).T).min() < 0.5


@pytest.mark.parametrize("model", MODELS)
def test_who_walks_alone_walks_at_their_own_speed(floor: FreeSpace, model: CrowdModel):
    crowd = Crowd(floor, [person(speed=1.0)], [path_to((16.0, 6.0))], model)
    track = walk(crowd, [(2.0, 6.0)], [0.0], 300)[:, 0]
    speeds = np.hypot(*np.diff(track, axis=0).T) * 30
    assert np.median(speeds) == pytest.approx(1.0, abs=0.02)
    assert np.abs(np.diff(speeds)).max() * 30 < 2.3, "they set off and brake as people do"
    assert np.abs(track[:, 1] - 6.0).max() < 0.05


@pytest.mark.parametrize("gap", [1.3, 1.4, 1.6])
def test_who_follows_somebody_faster_sets_off_almost_as_if_alone(floor: FreeSpace, gap: float):
    def way(version: int, people: int) -> float:
        crowd = Crowd(
            floor, [person(1.0), person(1.5)][:people], [path_to((16.0, 6.0))] * people, "orca", version=version
        )
        return walk(crowd, [(2.0, 6.0), (2.0 + gap, 6.0)][:people], [0.0, 0.0][:people], 45)[-1, 0, 0]

    assert way(6, 1) == way(5, 1), "alone, people walk as before"
    assert way(6, 1) - way(6, 2) < 0.5 * (way(5, 1) - way(5, 2)), "less than half of the way is lost behind the other"


@pytest.mark.parametrize("model", MODELS)
def test_version_6_changes_how_people_avoid_each_other_by_orca_alone(floor: FreeSpace, model: CrowdModel):
    goals, starts = [(15.0, 6.0), (3.0, 6.0), (9.0, 2.0)], [(3.0, 6.0), (15.0, 6.2), (9.0, 10.0)]
    tracks = [
        walk(Crowd(floor, [person()] * 3, [path_to(goal) for goal in goals], model, version=v), starts, [0.0] * 3, 300)
        for v in (5, 6)
    ]
    assert np.array_equal(*tracks) == (model == "social_force")


@pytest.mark.parametrize("model", MODELS)
def test_who_finds_no_goal_stands_and_others_walk_round_them(floor: FreeSpace, model: CrowdModel):
    nowhere = Errand(np.zeros((0, 2)))
    crowd = Crowd(floor, [person(), person()], [path_to((15.0, 6.0)), lambda xz, given, taken: nowhere], model)
    track = walk(crowd, [(3.0, 6.0), (9.0, 6.0)], [0.0, 0.0], 420)
    assert np.hypot(*(track[:, 0] - [15.0, 6.0]).T).min() < 0.5
    assert np.isfinite(track).all()
    assert np.hypot(*(track[:, 1] - track[0, 1]).T).max() < 0.6, "at most they step aside"


def wander(model: str, seed: int = 3, **rules: float) -> Recording:
    agents = {"human": model, "robot": "wander"}
    roster = ["robot", "human", "human", "human"]
    return h3data.simulate("wander", "small:0", roster=roster, agents=agents, seed=seed, spawn_distance_m=1.0, **rules)


@pytest.mark.parametrize("model", MODELS)
def test_a_recording_verifies_and_nobody_touches_anybody(model: str):
    recording = wander(model, max_steps=300)
    assert verify(recording).difference is None
    people = recording.columns["metrics.collision_people"]
    assert not recording.columns["metrics.collision"].any() or people.any(), "people do not touch each other"


@pytest.mark.parametrize("model", MODELS)
def test_a_world_among_many_is_that_of_one(model: str):
    def places(worlds: int) -> np.ndarray:
        roster = ["robot", "human", "human"]
        env = h3data.make(
            "wander",
            "small:0",
            num_envs=worlds,
            agents="robot",
            roster=roster,
            partner=model,
            observations=["humanoid_gps"],
        )
        env.reset(seed=4)
        rows = [env.step(np.zeros((worlds, 2), np.float32))[0]["humanoid_gps"][0] for _ in range(90)]
        env.close()
        return np.array(rows)

    one = places(1)
    assert np.ptp(one, axis=0).max() > 0.3, "they walk"
    np.testing.assert_array_equal(one, places(3))


def test_a_robot_does_not_follow_a_model_of_people():
    with pytest.raises(InputError, match="H3-POLICY-002"):
        h3data.simulate("wander", "small:0", agents={"robot": "orca"}, max_steps=10)
