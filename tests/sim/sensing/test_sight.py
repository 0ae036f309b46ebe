"""What agents have seen, and planners that search for what they have not."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.bodies import load_humanoid, load_robot
from h3data.errors import InputError
from h3data.geometry import heading_direction
from h3data.scene.articulation import joints_of
from sim_kinematic.agents.skills import SEARCH, Action
from sim_kinematic.policies.assignment import External
from sim_kinematic.sensing.sight import MARGIN_M, NEAR_M, PLACE_M, THING_M, Boxes, Sight, surface_names
from sim_kinematic.tasks.rearrange.episode import RearrangeSpec
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.resume import verify
from sim_kinematic.tasks.sessions import Session

HOME = "small-open:2"


@lru_cache(maxsize=1)
def home() -> Any:
    return h3data.load_scene(HOME)


@lru_cache(maxsize=8)
def episode(seed: int, **rules: Any) -> Any:
    spec = RearrangeSpec(observe="seen", end_on_collision=False, **rules)
    return Rearrange().episode(home(), seed=seed, spec=spec)


def test_rays_agree_with_points_along_them() -> None:
    """A ray is open if none of 400 points on it is in a box that does not hold its end."""
    sight, rng = Sight(home(), (load_humanoid("female_0"),), 1, 0.0), np.random.default_rng(3)
    least, most = sight.points.min(0), sight.points.max(0)
    wrong = opened = 0
    turned, centers, halves, bounds = sight.boxes
    for _ in range(200):
        eye = rng.uniform(least, most) * (1, 0, 1) + (0, 1.5, 0)
        away, height = rng.uniform(-0.7 * PLACE_M, 0.7 * PLACE_M, 2), rng.uniform(least[1], most[1])
        point = np.array([eye[0] + away[0], height, eye[2] + away[1]])
        found = sight.sees(eye, float(np.arctan2(-away[1], away[0])), point[None], 0)[0]
        local = np.einsum("bij,bj->bi", turned, point - centers)
        about = ((local >= bounds[:, 0] - MARGIN_M) & (local <= bounds[:, 1] + MARGIN_M)).all(1)
        along = eye + np.linspace(0, 1, 400)[:, None] * (point - eye)
        inside = np.einsum("bij,nbj->nbi", turned, along[:, None] - centers)
        expected = not ((np.abs(inside) < halves).all(-1) & ~about).any()
        wrong += found != expected
        opened += found
    assert 20 < opened < 180
    assert wrong <= 2  # a ray may cut a corner between two points


def test_robots_see_from_their_highest_camera_and_people_from_their_eyes() -> None:
    assert load_robot("quad_arm").eye_height_m == pytest.approx(0.86, abs=0.01)
    assert load_robot("lift_arm").eye_height_m == pytest.approx(1.36, abs=0.01)
    assert replace(load_robot("quad_arm"), cameras=()).eye_height_m == load_robot("quad_arm").body_height_m
    assert load_humanoid("child_0").eye_height_m < 1.3 < load_humanoid("female_0").eye_height_m < 1.65


def test_agents_see_what_is_before_them_and_not_what_is_far_or_behind() -> None:
    sight, point = Sight(home(), (load_humanoid("female_0"),), 1, 0.0), np.array([[0.0, 0.8, 0.0]])
    sight.boxes = Boxes(*(part[:0] for part in sight.boxes))  # no walls
    for distance, turned, thing, expected in (
        (THING_M - 0.1, 0.0, True, True),
        (THING_M + 0.1, 0.0, True, False),
        (PLACE_M + 0.1, 0.0, False, False),
        (PLACE_M - 0.1, 0.0, False, True),
        (2.0, 2.0, True, False),
        (NEAR_M - 0.1, 3.0, True, True),
    ):
        x, z = -distance * np.array(heading_direction(0.7))
        assert sight.sees(np.array([x, 1.5, z]), 0.7 + turned, point, int(thing))[0] == expected, (distance, turned)


def test_nothing_is_known_before_it_is_seen_and_skills_refuse_it() -> None:
    with Session(Rearrange(), episode(1), {"robot": External(), "human": External()}) as session:
        view, sight = session.observe("robot"), session.play.team.objects.sight
        assert view.places is not None
        assert len(view.places.points) == len(surface_names(home()))
        for k in np.flatnonzero(~sight.known[0]).tolist():
            assert not view.is_known(k)
            assert np.isnan(view.starts[k]).all()
            assert "has not seen" in str(session.refusal("robot", Action("nav_to_object", k)))
        assert not sight.known.all()
        assert session.refusal("robot", Action(SEARCH, 0)) is None
        with pytest.raises(InputError, match="H3-SIM-066"):
            session.refusal("robot", Action(SEARCH, 10_000))
        session.act("robot", Action(SEARCH, 0))
        session.step()
    full = Session(Rearrange(), Rearrange().episode(home(), seed=1), {"robot": External()})
    assert full.observe("robot").places is None
    with pytest.raises(InputError, match="H3-SIM-022"):
        full.refusal("robot", Action(SEARCH, 0))


def test_contents_are_seen_only_when_opened() -> None:
    sight, joints = Sight(home(), (load_humanoid("female_0"),), 1, 0.0), joints_of(home())
    shut = [k for k, name in enumerate(sight.names) if joints.enclosing.get(name)]
    sight.open(np.zeros(len(joints), np.bool_))
    assert sorted(np.flatnonzero(sight.shut >= 0)) == shut
    free = episode(1).free
    stands = free.snap(sight.points[:, [0, 2]])
    eyes = [np.array([x, 1.55, z]) for x, z in stands]
    faces = [float(np.arctan2(-(p[2] - z), p[0] - x)) for p, (x, z) in zip(sight.points, stands, strict=True)]
    seen = [k for k in shut if sight.sees(eyes[k], faces[k], sight.points[[k]], 0)[0]]
    assert len(seen) > 0.8 * len(shut)
    thing, eye = sight.points[[seen[0]]], np.array([[*stands[seen[0]], faces[seen[0]]]])
    sight.hidden[:] = True
    assert sight.look(eye, thing, np.array([-1])) == []
    assert not sight.looked[0, shut].any()
    sight.hidden[:] = False
    sight.open(np.ones(len(joints), np.bool_))
    assert (sight.shut < 0).all()
    assert sight.look(eye, thing, np.array([-1])) == [(0, 0, True)]
    assert sight.looked[0, seen[0]]
    assert sight.look(eye, thing + np.array([30.0, 0.0, 3.0]), np.array([1])) == [(0, 0, False)]
    assert np.isnan(sight.where[0, 0]).all()


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_planners_find_things_and_recordings_tell_when(seed: int) -> None:
    recording = simulate(Rearrange(), episode(seed, max_steps=4000), {"robot": "complement", "human": "both"})
    assert recording.episode.info["ended"] == "success"
    assert recording.episode.info["solo_steps"] < 4000, "the person alone, by whom efficiency is measured, searches too"
    first = {(e.agent, e.target): e.step for e in reversed(recording.events) if e.kind == "see"}
    picks = [e for e in recording.events if e.kind == "pick"]
    assert picks
    assert all(first[e.agent, e.target] <= e.step for e in picks)
    assert SEARCH in {span.name for span in recording.skills}
    assert verify(recording).equal


def test_what_planners_may_know_is_a_rule() -> None:
    with pytest.raises(InputError, match="H3-TASK-085"):
        RearrangeSpec(observe="all")
    assert "observe" not in repr(RearrangeSpec())
    assert "observe='seen'" in repr(RearrangeSpec(observe="seen"))
