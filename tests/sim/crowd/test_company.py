"""Reactions to a robot with their published numbers, groups who walk abreast, and conversations."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import h3data
from benchmarks.people import hall
from h3data.errors import InputError
from h3data.scene import FreeSpace
from h3data.scene.open import named_scenes, open_free_space, open_scene
from h3data_crowds.places import build_plan
from sim_kinematic.crowd.company import circle_radius, closed_area, standing_circle
from sim_kinematic.crowd.crowd import VERSION, Crowd, CrowdModel
from sim_kinematic.crowd.errands import Errand, Guide
from sim_kinematic.crowd.reactions import REACTIONS
from sim_kinematic.crowd.roles import Role, check_groups, read_role
from sim_kinematic.crowd.traits import Traits
from sim_kinematic.motion.randomness import generator
from sim_kinematic.tasks.resume import verify
from tests.sim.crowd.walks import NOBODY, Discs
from tests.sim.crowd.walks import step as step_among

MODELS: tuple[CrowdModel, ...] = ("orca", "social_force")
FLOOR = FreeSpace.from_scene(hall(), cache=False)


def person(speed: float = 1.3) -> Traits:
    return Traits(speed, 0.5, 0.1, 0.34, 1.0, 6.0)


def path_to(*goals: tuple[float, float]) -> Guide:
    left = list(goals)
    return lambda xz, given, taken: Errand(
        np.array([xz, given if given is not None else left.pop(0) if len(left) > 1 else left[0]])
    )


def robot_at(x: float, z: float, heading: float = 0.0) -> Discs:
    return Discs(np.array([[x, z]]), np.array([0.25]), np.array([[x, z, heading]]), 1)


def walk(crowd: Crowd, starts: list[tuple[float, float]], heading: float, steps: int, others: Discs):
    """Positions [steps + 1, M, 2], headings [steps + 1, M] and what people told."""
    xz, headings = np.array(starts), np.full(len(starts), heading)
    before, track, looks, told = xz.copy(), [xz], [headings], []
    for step in range(steps):
        (xz, headings), before = step_among(crowd, xz, headings, before, others, step), xz
        track.append(xz)
        looks.append(headings)
        told += [(step, *event) for event in crowd.new_events if event[1] != "walks_to"]
    return np.array(track), np.array(looks), told


def alone(reaction: str, model: CrowdModel, steps: int, robot: Discs, start=(3.0, 6.0), heading: float = 0.0):
    crowd = Crowd(FLOOR, [person()], [path_to((16.0, 6.0))], model, roles=[Role(reaction)])
    track, looks, told = walk(crowd, [start], heading, steps, robot)
    return track[:, 0], looks[:, 0], told


@pytest.mark.parametrize("model", MODELS)
def test_who_is_surprised_stops_within_4_m_for_30_s_and_only_once(model: CrowdModel):
    track, looks, told = alone("surprised", model, 1500, robot_at(9.0, 6.0))
    begins, ends = told[0][0], told[1][0]
    assert [row[2] for row in told] == ["reacts", "reaction_over"], "once"
    assert math.hypot(9.0 - track[begins, 0], 0.0) == pytest.approx(4.0, abs=0.3)
    assert ends - begins == pytest.approx(900, abs=5)
    assert np.hypot(*(track[ends] - track[begins + 60])) < 0.1, "stands"
    assert looks[ends] == pytest.approx(math.atan2(track[ends, 1] - 6.0, 9.0 - track[ends, 0]), abs=0.05)
    assert np.hypot(*(track - [16.0, 6.0]).T).min() < 0.6, "walks on after that"


@pytest.mark.parametrize("model", MODELS)
def test_nobody_reacts_to_a_robot_behind_them(model: CrowdModel):
    for reaction in REACTIONS:
        crowd = Crowd(FLOOR, [person()], [path_to((16.0, 6.0))], model, roles=[Role(reaction)])
        assert not walk(crowd, [(3.0, 6.0)], 0.0, 90, robot_at(1.5, 6.0))[2], reaction


@pytest.mark.parametrize("model", MODELS)
def test_who_is_curious_comes_to_1_5_m_at_1_8_d_over_10(model: CrowdModel):
    track, looks, told = alone("curious", model, 700, robot_at(9.0, 9.0))
    assert told[0][0] < 10, "from 10 m on"
    gap = np.hypot(*(track - [9.0, 9.0]).T)
    assert gap[600] == pytest.approx(1.5, abs=0.15)
    speed = np.hypot(*np.diff(track, axis=0).T) * 30
    rows = np.flatnonzero((gap[:-1] > 2.0) & (gap[:-1] < 5.0))
    np.testing.assert_allclose(speed[rows], 0.18 * gap[rows], atol=0.1)
    towards = math.atan2(-(9.0 - track[600, 1]), 9.0 - track[600, 0])
    assert looks[600] == pytest.approx(towards, abs=0.1)


@pytest.mark.parametrize("model", MODELS)
def test_who_is_scared_is_slow_and_keeps_away_again_and_again(model: CrowdModel):
    track, _, told = alone("scared", model, 600, robot_at(9.0, 6.3))
    gap = np.hypot(*(track - [9.0, 6.3]).T)
    begins = told[0][0]
    assert gap[begins] == pytest.approx(3.0, abs=0.3)
    speed = np.hypot(*np.diff(track, axis=0).T) * 30
    near = [row for row in range(begins + 45, len(speed)) if gap[row] < 3.0]
    assert speed[near].max() < 0.75
    calm = alone("regular", model, 600, robot_at(9.0, 6.3))[0]
    assert gap.min() > np.hypot(*(calm - [9.0, 6.3]).T).min() + 0.2


@pytest.mark.parametrize("model", MODELS)
def test_who_threatens_stands_before_the_robot(model: CrowdModel):
    track, looks, told = alone("threatening", model, 600, robot_at(9.0, 6.0, math.pi))
    speed = np.hypot(*np.diff(track, axis=0).T) * 30
    assert speed[told[0][0] :].max() > 1.5, "2 m/s, faster than they walk"
    assert np.hypot(*(track[400] - [9.0 - 1.1, 6.0])) < 0.3
    assert looks[400] == pytest.approx(math.atan2(track[400, 1] - 6.0, 9.0 - track[400, 0]), abs=0.1)


@pytest.mark.parametrize("model", MODELS)
def test_who_is_impassive_goes_aside_later_than_for_a_person(model: CrowdModel):
    bent = {}
    for reaction in ("regular", "impassive"):
        track, _, told = alone(reaction, model, 500, robot_at(9.0, 6.1))
        gap = np.hypot(*(track - [9.0, 6.1]).T)
        assert not told
        assert gap.min() >= 0.59 - 1e-9
        bent[reaction] = int((np.abs(track[:, 1] - 6.0) > 0.1).sum())
    assert bent["impassive"] < 0.8 * bent["regular"], "goes aside later"


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("size", [2, 3])
def test_a_walking_group_stays_together_and_abreast(model: CrowdModel, size: int):
    goals = [(15.0, 6.0), (3.0, 6.0)] * 3
    speeds = (1.1, 1.3, 1.5)
    roles = [Role(group="walk1")] * size
    crowd = Crowd(
        FLOOR, [person(speeds[k]) for k in range(size)], [path_to(*goals) for _ in range(size)], model, roles=roles
    )
    starts = [(3.0 - 0.9 * k, 6.0 + 0.3 * k) for k in range(size)]
    track = walk(crowd, starts, 0.0, 330, NOBODY)[0]
    while_walking = track[120:300]
    gaps = np.hypot(*(while_walking[:, :, None] - while_walking[:, None]).transpose(3, 0, 1, 2))
    gaps[:, np.eye(size, dtype=bool)] = np.inf
    assert 0.6 < np.median(gaps.min(2)) < 1.1, "as far from each other as measured groups"
    assert np.ptp(while_walking[90:, :, 0], axis=1).max() < 0.8, "abreast"
    assert 0.7 < np.median(np.hypot(*np.diff(while_walking, axis=0).transpose(2, 0, 1)) * 30) < 1.2, "as the slowest"


@pytest.mark.parametrize(("model", "newer"), [("orca", 8), ("social_force", 9)])
def test_in_single_file_a_group_keeps_together_as_measured_ones(model: CrowdModel, newer: int):
    corridor, gap = FreeSpace.from_scene(hall(18.0, 1.0), cache=False), {}
    for version in (newer - 1, newer):
        roles = [Role(group="walk1")] * 2
        crowd = Crowd(corridor, [person()] * 2, [path_to((16.0, 0.5))] * 2, model, roles=roles, version=version)
        track = walk(crowd, [(3.0, 0.5), (1.6, 0.5)], 0.0, 270, NOBODY)[0]
        gap[version] = np.median(np.hypot(*(track[120:, 0] - track[120:, 1]).T))
        assert np.hypot(*(track[:, 0] - track[:, 1]).T).min() > 0.99, "feet ahead and behind do not meet"
    assert gap[newer] < (1.1 if model == "orca" else 1.16) < gap[newer - 1] < 1.2, gap


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("size", [2, 3, 5])
def test_people_who_talk_stand_in_a_circle_and_face_its_centre(model: CrowdModel, size: int):
    roles = [Role(group="talk1")] * size
    crowd = Crowd(FLOOR, [person()] * size, [path_to((9.0, 3.0))] * size, model, roles=roles)
    starts = [(3.0 + 1.5 * k, 6.0) for k in range(size)]
    track, looks, told = walk(crowd, starts, 0.0, 750, NOBODY)
    centre = track[-1].mean(0)
    np.testing.assert_allclose(np.hypot(*(track[-1] - centre).T), circle_radius(size), atol=0.15)
    towards = np.arctan2(-(centre - track[-1])[:, 1], (centre - track[-1])[:, 0])
    assert np.cos(looks[-1] - towards).min() > math.cos(0.2)
    assert np.ptp(track[-60:], axis=0).max() < 0.05, "they stand"
    assert sorted(row[1] for row in told) == list(range(size))
    assert {row[3] for row in told} == {"talk"}


@given(st.integers(2, 8), st.integers(0, 2**32))
def test_circles_of_any_size_keep_room_between_neighbours(people: int, seed: int):
    rng = generator(seed, "test")
    places, centre = standing_circle(FLOOR, FLOOR.sample(rng, people), rng)
    gaps = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1)) + 9 * np.eye(people)
    assert gaps.min() >= 1.0 - 1e-6
    np.testing.assert_allclose(np.hypot(*(places - centre).T), circle_radius(people), atol=1e-9)
    assert FLOOR.signed_distance(places).min() > 0.2


@pytest.mark.parametrize("seed", range(4))
def test_conversations_leave_a_way_around_them(seed: int):
    source = named_scenes("h3-homes/val#8")[0].source
    free = open_free_space(source, 0.25, 1.41)
    xz = free.sample(generator(seed, "test"), 2)
    before, _ = standing_circle(free, xz, generator(seed, "talk"), leaves_way=False)
    places, _ = standing_circle(free, xz, generator(seed, "talk"))
    assert closed_area(free, places) < 0.2, "the rest of the floor hangs together"
    assert closed_area(free, places) <= closed_area(free, before)


def test_a_conversation_in_a_doorway_closes_the_room_behind_it():
    free = FreeSpace.from_scene(build_plan("door"), cache=False)
    assert closed_area(free, np.array([[0.0, -0.5], [0.0, 0.5]])) > 10.0
    assert closed_area(free, np.array([[-2.5, -0.5], [-2.5, 0.5]])) < 0.2


def test_who_is_stuck_before_somebody_in_a_doorway_backs_out():
    free = FreeSpace.from_scene(build_plan("door"), cache=False)
    away = {}
    for version in (3, 4):
        stays: Guide = lambda xz, given, taken: Errand(np.array([xz, [0.0, 0.0]]), np.inf)  # noqa: E731
        crowd = Crowd(free, [person()] * 2, [path_to((2.5, 0.0)), stays], "orca", version=version)
        track = walk(crowd, [(-2.0, 0.0), (0.3, 0.0)], 0.0, 360, NOBODY)[0]
        away[version] = np.hypot(*(track[200:, 0] - track[200:, 1]).T).max()
    assert away[4] > 1.2 > 1.0 > away[3], "by version 3 they stand before each other for ever"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "home", "seed"),
    [("orca", home, seed) for home, seed in ((0, 106), (0, 112), (3, 113), (5, 103), (5, 108))]
    + [("social_force", 3, seed) for seed in (106, 112, 115)],
)
def test_walking_groups_get_on_where_they_did_not(model: str, home: int, seed: int):
    from benchmarks.people import COMPANY, Walks, describe
    from benchmarks.people import walk as walk_at_home

    source = named_scenes(f"h3-homes/val#{home}")[0].source
    scene, free = open_scene(source), open_free_space(source, 0.25, 1.41)
    partner = ",".join(f"{model}+{word}" for word in COMPANY["company"])
    figures = describe([Walks.of(walk_at_home(scene, free, 4, partner, seed, 3600), scene, free)])
    assert figures["gridlocks_per_person_hour"][0] == figures["contacts_per_person_hour"][0] == 0


def test_recordings_without_a_version_follow_the_first_rules():
    chosen = {"human": ["orca+walk1", "orca+walk1", "orca+talk1", "orca+talk1"]}
    recording = h3data.simulate(
        "wander", "h3-homes/val#8", roster=["human"] * 4, agents=chosen, seed=1, max_steps=300, spawn_distance_m=1.0
    )
    assert verify(recording).difference is None
    people = recording.episode.info["people"]
    assert {person["version"] for person in people.values()} == {VERSION}
    older = {name: {key: value for key, value in facts.items() if key != "version"} for name, facts in people.items()}
    for info in ({"people": older}, {"people": None}):
        episode = replace(recording.episode, info={**recording.episode.info, **info})
        assert verify(replace(recording, episode=episode)).difference is not None, "the first rules are others"


@given(st.lists(st.sampled_from([*REACTIONS, "any", "walk1", "talk12", "morning"]), max_size=4), st.integers(0, 99))
def test_roles_are_the_same_always(words: list[str], seed: int):
    role = read_role("+".join(words), seed, 2)
    assert role == read_role("+".join(words), seed, 2)
    assert role.reaction in REACTIONS


def test_any_draws_each_reaction():
    assert {read_role("any", 5, number).reaction for number in range(60)} == set(REACTIONS)


def test_a_reaction_that_nobody_has_and_a_group_of_one_are_refused():
    with pytest.raises(InputError, match="H3-SIM-060"):
        read_role("bored")
    with pytest.raises(InputError, match="H3-SIM-061"):
        check_groups(["", "walk1", "walk2", "walk1"])
    for partner in ("orca+bored", "orca+walk1,orca"):
        with pytest.raises(InputError, match=r"H3-SIM-06[01]"):
            h3data.simulate("wander", "small:0", roster=["robot", "human", "human"], agents={"human": partner})
    with pytest.raises(InputError, match="H3-SIM-060"):
        h3data.make("wander", "small:0", agents="robot", roster=["robot", "human"], partner="orca+bored")


@pytest.mark.parametrize("model", MODELS)
def test_a_recording_of_company_says_who_they_are_and_verifies(model: CrowdModel):
    people = [f"{model}+{words}" for words in ("curious+walk1", "any+walk1", "talk1+surprised", "talk1")]
    recording = h3data.simulate(
        "wander",
        "small:0",
        roster=["robot", *["human"] * 4],
        agents={"human": people, "robot": "wander"},
        seed=3,
        spawn_distance_m=1.0,
        max_steps=300,
    )
    assert verify(recording).difference is None
    told = recording.episode.info["people"]
    assert [told[f"human_{k}"]["group"] for k in (1, 2, 3, 4)] == ["walk1", "walk1", "talk1", "talk1"]
    assert told["human_1"]["reaction"] == "curious"
    assert {event.kind for event in recording.events} & {"reacts", "activity"}


@pytest.mark.slow
def test_added_time_is_small_for_who_passes_the_robot_and_not_for_who_is_scared():
    from h3data_pipelines.validation.added_time import added_time

    def play(partner: str, policy: str = "still", seed: int = 6):
        chosen = {"human": partner, "robot": policy}
        roster = ["robot", "human", "human"]
        return h3data.simulate("wander", "medium:1", roster=roster, agents=chosen, seed=seed, max_steps=1800)

    calm, late = added_time(play("orca", seed=9)), added_time(play("orca+scared"))
    assert [row.person for row in calm] == ["human_1", "human_2"]
    assert all(row.goals > 0 and row.seconds is not None for row in (*calm, *late))
    assert sum(row.seconds or 0.0 for row in late) > 10 > 5 > sum(row.seconds or 0.0 for row in calm)
    with pytest.raises(InputError, match="H3-TASK-081"):
        added_time(play("waypoints"))
