"""Routines: what a home has things for, places beside them, and people who follow them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import h3data
from benchmarks.people import hall
from h3data.errors import InputError, SceneError
from h3data.scene import FreeSpace
from h3data.scene.open import named_scenes, open_free_space, open_scene
from h3data_crowds.routines import (
    ACTIVITIES,
    DAYS,
    ROOM_M,
    Routine,
    Stop,
    make_routine,
    place_beside,
    posture_of,
)
from sim_kinematic.tasks.resume import verify

SOURCE = named_scenes("small:0")[0].source
SCENE, FREE = open_scene(SOURCE), open_free_space(SOURCE, 0.25, 1.41)


@given(st.integers(0, 2**40), st.integers(0, 20))
def test_a_morning_is_the_same_always_and_keeps_its_order(seed: int, number: int):
    stops = make_routine(SCENE, seed, number)
    assert stops == make_routine(SCENE, seed, number)
    order = [DAYS["morning"].index(stop.activity) for stop in stops]
    assert order == sorted(set(order))
    category = {thing.name: SCENE.assets[thing.asset].category for thing in SCENE.instances}
    for stop in stops:
        activity = ACTIVITIES[stop.activity]
        assert category[stop.place] in activity.categories
        assert activity.least_s - 0.1 <= stop.seconds <= activity.most_s + 0.1


@given(st.sampled_from(["fridge_0", "sofa_0", "dining_table_0", "kitchen_counter_0"]), st.integers(0, 2**32))
def test_people_stand_on_the_floor_beside_a_thing(name: str, seed: int):
    near = FREE.sample(np.random.default_rng(seed), 1)[0]
    beside = place_beside(SCENE, FREE, name, near)
    assert beside is not None
    at, faced = beside
    assert float(FREE.signed_distance(at)) >= ROOM_M
    assert np.hypot(*(at - faced)) < 1.0
    assert math.isfinite(float(FREE.geodesic(near, at)))


def test_an_activity_is_a_posture_that_a_person_has_or_standing():
    assert posture_of("eat") == "stand"
    assert posture_of("eat", ("stand", "sit")) == "sit"
    assert posture_of("eat", ("stand", "sit", "eat")) == "eat"
    assert posture_of("juggle", ("stand", "sit")) == "stand"


@pytest.mark.parametrize(
    "stops", [[], [Stop("nowhere", "cook", 3.0)], [Stop("fridge_0", "cook", 0.0)], [Stop("fridge_0", "cook", math.inf)]]
)
def test_stops_that_nobody_can_make_are_refused(stops: list[Stop]):
    with pytest.raises(InputError, match="H3-SIM-063"):
        Routine(SCENE, FREE, stops)


def test_nobody_spends_a_morning_in_an_empty_hall():
    with pytest.raises(SceneError, match="H3-SIM-062"):
        make_routine(hall(), 1, 1)
    assert FreeSpace.from_scene(hall(), cache=False) is not None


def test_three_people_follow_their_mornings_and_verify():
    roster = ["human"] * 3
    chosen = {"human": "orca+morning"}
    recording = h3data.simulate(
        "wander", "small:0", roster=roster, agents=chosen, seed=2, max_steps=2400, spawn_distance_m=1.0
    )
    assert verify(recording).difference is None
    for k, name in enumerate(("human_1", "human_2", "human_3")):
        routine = [tuple(stop[:2]) for stop in recording.episode.info["people"][name]["routine"]]
        done = [
            (event.target, event.detail) for event in recording.events if event.kind == "activity" and event.agent == k
        ]
        assert 1 <= len(done) <= len(routine)
        assert [(place, activity) for activity, place in done] == [stop for stop in routine if stop[::-1] in done]
