"""Everything that people of routines do, and the film of a morning: nobody is in anything, and nothing pops."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import activities, film
from h3data.replay import Replay
from h3data_pipelines.validation.penetration import penetrations

MOST_M = 0.02
"""Greatest depth of a part of a body in the home."""


@pytest.mark.slow
def test_the_broadest_body_does_everything_without_being_in_anything() -> None:
    recording = activities.played("male_1")
    found = activities.figures_of(recording)
    walks, knuckles = found.pop("walk"), found.pop("knuckles")
    assert set(found) >= {"take", "put", "lift", "phone", "wave", "knock", "dishes"}
    assert {name: each for name, each in found.items() if each.depth_m > MOST_M or each.pops} == {}
    assert walks.pops == 0
    # the panel that collides is 15 mm behind the front of the door
    assert -0.025 < knuckles.depth_m < 0.0
    # the capsule of the hand is in the door, which is intended, and that of nothing else
    rows = np.concatenate([np.arange(*span) for span in activities.spans(recording)["knock"]])
    (measured,) = penetrations(recording, moved=False)
    deep = measured.depth_m[rows] > 0
    assert deep.any()
    assert {measured.parts[k] for k in np.flatnonzero(deep.any(0))} <= {"right_hand", "right_forearm"}
    assert set(measured.thing[rows][deep]) == {activities.DOOR}


@pytest.mark.slow
def test_people_who_sit_and_lie_are_counted_only_where_they_do() -> None:
    recording = activities.played("female_1")
    found = activities.figures_of(recording)
    assert {"sit", "lie"} <= set(found)
    assert max(found[name].depth_m for name in ("sit", "lie", "wave", "dishes")) <= MOST_M
    (first, last), *_ = activities.spans(recording)["lie"]
    share = Replay(recording).recording.columns["agent_0.motion_seat"][first:last, 1]
    assert share.max() == 2


@pytest.mark.slow
def test_the_film_of_a_morning_has_no_fault() -> None:
    played = film.script()
    found = {name: value for name, (value, _) in film.figures_of(played.play(), played.SCENE).items()}
    assert found.pop("penetration.film.worst") <= 1000 * MOST_M
    assert set(found.values()) == {0.0}, found
