"""Oracle skills: paths that are tables, agents that heed nobody, and recordings of them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("shapely")
pytest.importorskip("fcl")

from h3data.errors import InputError
from h3data.scene import FreeSpace
from sim_kinematic.agents.oracle.actors import OraclePerson, OracleRobot, carry_point
from sim_kinematic.agents.oracle.ways import NONE, PathTable, paths_to
from sim_kinematic.agents.skills import Action
from sim_kinematic.motion.spec import OracleSpec
from sim_kinematic.policies.assignment import assign
from sim_kinematic.policies.policy import External
from sim_kinematic.tasks.play import DecisionLoop, WorldRollout
from sim_kinematic.tasks.rearrange.codec import rules_from_json, rules_to_json
from sim_kinematic.tasks.rearrange.episode import ORACLE_RULES, RearrangeEpisode, RearrangeSpec
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.resume import resume, verify
from sim_kinematic.tasks.skills.errands import errands_of, stand_places
from sim_kinematic.tasks.sources import EpisodeSource, Home, scene_sources

HOMES = ["small:1", "h3-homes/val#1"]
TASK = Rearrange()


@pytest.fixture(scope="module")
def floors() -> list[FreeSpace]:
    return [Home(source, 0.25, 1.41).free for source in scene_sources(HOMES)]


@pytest.fixture(scope="module")
def episode() -> RearrangeEpisode:
    found = EpisodeSource(TASK, HOMES[1], spec=ORACLE_RULES).sample(3, 0)
    assert isinstance(found, RearrangeEpisode)
    return found


def walked(ways: PathTable, start: np.ndarray) -> float:
    """Length of the path from a point by the tables; inf where they lead nowhere."""
    number, here, length = ways.start(start), start, 0.0
    for _ in range(1000):
        if number == NONE:
            return math.inf
        length += float(np.hypot(*(ways.points[number] - here)))
        here = ways.points[number]
        if number >= ways.corners:
            return length
        number = int(ways.after[number])
    raise AssertionError("the tables lead in circles")


# --- paths --------------------------------------------------------------------------------------------------------------
def test_tables_hold_the_shortest_paths(floors: list[FreeSpace]) -> None:
    rng, longer, off = np.random.default_rng(0), [], []
    for free in floors:
        for _ in range(4):
            places = free.sample(rng, 3)
            ways = paths_to(free, places)
            starts = free.sample(rng, 100)
            shortest = np.min([free.geodesic(starts, np.broadcast_to(p, starts.shape)) for p in places], 0)
            longer += [
                walked(ways, start) / max(s, 0.5) - s / max(s, 0.5) for start, s in zip(starts, shortest, strict=True)
            ]
            off += (np.abs(ways.length(starts) - shortest) / np.maximum(shortest, 0.5)).tolist()
    assert max(np.median(longer), np.median(off)) < 1e-4
    assert np.quantile(longer, 0.95) < 0.01
    assert np.quantile(off, 0.95) < 0.01
    assert min(longer) > -0.1  # chords of inflated corners
    assert max(longer) < 0.5


def test_legs_keep_clear_of_walls(floors: list[FreeSpace]) -> None:
    rng, (free, _) = np.random.default_rng(1), floors
    ways = paths_to(free, free.sample(rng, 2))
    for start in free.sample(rng, 60):
        number, here = ways.start(start), start
        while True:
            there = ways.points[number]
            along = here + np.linspace(0, 1, 50)[:, None] * (there - here)
            assert free.signed_distance(along).min() > free.radius_m - 0.16  # half a cell's diagonal, and a chord
            here = there
            if number >= ways.corners:
                break
            number = int(ways.after[number])


def test_no_places_have_no_ways(floors: list[FreeSpace]) -> None:
    free = floors[0]
    ways = paths_to(free, np.zeros((0, 2)))
    start = free.sample(np.random.default_rng(0), 1)[0]
    assert ways.start(start) == NONE
    assert np.isinf(ways.length(start))
    far = paths_to(free, free.sample(np.random.default_rng(0), 1))
    assert far.cell([1e6, -1e6]) in range(len(far.first))


# --- skills -------------------------------------------------------------------------------------------------------------
def told(episode: RearrangeEpisode) -> tuple[WorldRollout, DecisionLoop]:
    play = WorldRollout.of(TASK, episode, assign(TASK, episode, {"robot": External(), "human": External()}))
    return play, DecisionLoop(play)


def go(play: WorldRollout, turns: DecisionLoop, robot: Action, human: Action, steps: int = 1) -> None:
    for _ in range(steps):
        while turns.asked is not None:
            turns.answer(robot if turns.asked == 0 else human)
        turns.go_on()


WAIT = Action("wait", steps=1)


def test_a_place_is_where_room_for_the_reach_is(episode: RearrangeEpisode) -> None:
    for number, reach in ((0, 1.2), (1, 0.9)):
        errands = errands_of(episode, number)
        assert errands is errands_of(episode, number)
        for k, target in enumerate(episode.targets):
            for ways, point in ((errands.to_start[k], target.start[:3]), (errands.to_goal[k], target.goal)):
                assert len(ways.ends) >= 1
                assert episode.free.is_navigable(ways.ends).all()
                assert (np.hypot(*(ways.ends - point[[0, 2]]).T) < reach).all()
    (places,) = stand_places(episode, 0, [np.array([1e3, 0.5, 1e3])])
    assert places.shape == (0, 2)


@pytest.mark.parametrize("who", [0, 1])
def test_an_errand(episode: RearrangeEpisode, who: int) -> None:
    rules = OracleSpec(robot_steps=(3, 5), person_steps=(3, 5))
    play, turns = told(replace(episode, spec=replace(ORACLE_RULES, oracle=rules, end_on_collision=False)))
    objects, actor = play.team.objects, play.team.actors[who]

    def own() -> list[Any]:
        return [span for span in play.spans if span.agent == who]

    def does(action: Action) -> None:
        """To the moment at which the agent chooses anew."""
        before = len(own())
        for _ in range(500):
            while turns.asked is not None:
                if turns.asked == who and len(own()) > before:
                    assert own()[-1].name == action.skill
                    assert own()[-1].outcome == "done"
                    return
                turns.answer(action if turns.asked == who else WAIT)
            turns.go_on()
        raise AssertionError(f"{action} never ended")

    go(play, turns, *((Action("pick", 0), WAIT) if who == 0 else (WAIT, Action("pick", 0))))
    assert play.team.controllers[who].ending == ("failed", "out_of_reach")
    for skill, held in (("nav_to_object", -1), ("pick", who), ("nav_to_goal", who), ("place", -1)):
        does(Action(skill, 0))
        assert objects.held_by[0] == held, skill
        if held >= 0:
            body = play.episode.roster[who].body
            heading = actor.heading
            x, y, z = carry_point(body)
            c, s = math.cos(heading), math.sin(heading)
            wanted = actor.xz + np.array([c * x + s * z, -s * x + c * z])
            np.testing.assert_allclose(objects.poses[0, [0, 2]], wanted, atol=1e-9)
            assert objects.poses[0, 1] == pytest.approx(episode.free.floor_y + y)
    np.testing.assert_array_equal(objects.poses[0, :3], episode.targets[0].goal)
    assert play.team.at_goal.tolist() == [True, False]
    events = [event.kind for event in play.events if event.kind in ("pick", "place")]
    assert events == ["pick", "place"]


def test_what_another_has_taken_is_lost(episode: RearrangeEpisode) -> None:
    rules = OracleSpec(robot_steps=(3, 5), person_steps=(6, 7))
    play, turns = told(replace(episode, spec=replace(ORACLE_RULES, oracle=rules, end_on_collision=False)))
    while not all(actor.infeasible(Action("pick", 0)) == "" for actor in play.team.actors):
        go(play, turns, Action("nav_to_object", 0), Action("nav_to_object", 0))
    for actor in play.team.actors:
        assert isinstance(actor, OracleRobot | OraclePerson)
    go(play, turns, WAIT, WAIT)
    go(play, turns, Action("pick", 0), Action("pick", 0), 8)
    failed = [(span.agent, span.reason) for span in play.spans if span.name == "pick" and span.outcome == "failed"]
    assert (1, "held_by_other") in failed
    assert play.team.objects.held_by[0] == 0


def test_agents_that_meet_touch_and_pass_through_each_other(episode: RearrangeEpisode) -> None:
    starts = episode.starts.copy()
    starts[0, :2] = errands_of(episode, 1).to_start[0].ends[0]  # the robot is in the person's way
    through = replace(episode, starts=starts, spec=replace(ORACLE_RULES, end_on_collision=False))
    task, ended = Rearrange(), []
    for rules in (through, replace(through, spec=ORACLE_RULES)):
        play = WorldRollout.of(task, rules, {"robot": "still", "human": "both"})
        turns, touched = DecisionLoop(play), 0
        while not turns.over:
            if turns.asked is not None:
                turns.answer(play.policies[turns.asked].policy.act(play.view(turns.asked)))
                continue
            if play.world.touching.any():
                touched += 1
                gap = np.hypot(*(play.team.actors[0].xz - play.team.actors[1].xz))
                assert gap < 0.225 + 0.25 + 0.2
            turns.go_on()
        ended.append((play.ended, touched))
    (first, touches), (second, _) = ended
    assert first in ("success", "max_steps")
    assert (second == "collision") == (touches > 0)
    assert touches > 0


# --- rules and recordings -----------------------------------------------------------------------------------------------
def test_rules_come_back_and_others_stay_as_they_were() -> None:
    assert rules_from_json(rules_to_json(ORACLE_RULES)) == ORACLE_RULES
    plain = RearrangeSpec()
    assert "oracle" not in rules_to_json(plain)
    assert "oracle" not in repr(plain)
    assert "solid_agents" not in repr(plain)
    assert repr(plain).startswith("RearrangeSpec(max_steps=1500, objects=2, at_goal_m=0.3, grip_m=0.15,")
    assert repr(plain).endswith(")")
    assert "oracle=OracleSpec(robot_steps=(12, 14)" in repr(ORACLE_RULES)
    with pytest.raises(InputError, match="H3-SIM-032"):
        OracleSpec(robot_steps=(5, 4))


def test_recordings_are_verified_and_resumed(episode: RearrangeEpisode) -> None:
    recording = simulate(TASK, episode, {"robot": "complement", "human": "plan_pop_4"})
    assert recording.episode.info["spec"]["oracle"]["person_radius_m"] == 0.2
    assert verify(recording).difference is None
    again = resume(recording, len(recording) // 2)
    for name, column in recording.columns.items():
        np.testing.assert_array_equal(column, again.columns[name], err_msg=name)


@pytest.mark.slow
def test_homes_with_doors_are_refused() -> None:
    source: Any = EpisodeSource(TASK, "small2-doors:1", spec=RearrangeSpec())
    found = source.sample(0, 0)
    with pytest.raises(InputError, match="H3-TASK-015"):
        errands_of(replace(found, spec=ORACLE_RULES), 0)
