"""Two agents near each other of which neither gets on: counted, and ended."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from benchmarks import standoff
from h3data.recording import Recording
from h3data.scene import FreeSpace
from sim_kinematic.agents.skills import ALL_SKILLS, Action, SkillResult
from sim_kinematic.avoidance import right_of_way
from sim_kinematic.avoidance.right_of_way import RightOfWay
from sim_kinematic.avoidance.spec import AVOIDANCE, Footprint
from sim_kinematic.avoidance.stand_offs import TaskProgress
from sim_kinematic.avoidance.yielding import NO_PATH, shut_off
from sim_kinematic.policies.rearrange import Planner
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.recorder import simulate
from tests.sim.avoidance.commands import Seen, decide, neighbours
from tests.sim.avoidance.test_right_of_way import floor_of


@dataclass(eq=False)
class Figure:
    """Somebody who stands where they stand, or goes aside as they are told."""

    number: int
    xz: NDArray[np.float64]
    path: NDArray[np.floating] = field(default_factory=lambda: NO_PATH)
    is_robot: bool = False
    yields: bool = True
    heading: float = 0.0
    footprint: Footprint = AVOIDANCE.person
    aside: NDArray[np.float64] | None = None
    turned_away: bool = False
    hindered_by: frozenset[int] = frozenset()
    obeys: bool = True
    completed: int = 0
    left_m: float = 4.0

    @property
    def path_start(self) -> NDArray | None:
        return self.path[0] if len(self.path) else None

    def go(self, stride: float = 0.04) -> None:
        if self.aside is not None and len(self.aside):
            leg = self.aside[0] - self.xz
            self.xz = self.xz + leg * min(stride / max(float(np.hypot(*leg)), 1e-9), 1.0)


@pytest.fixture(scope="module")
def rooms() -> FreeSpace:
    """Two rooms 5 m wide with a doorway between them."""
    return floor_of(shapely.box(0, 0, 5, 4), shapely.box(4.9, 1.5, 5.6, 2.5), shapely.box(5.5, 0, 10.5, 4))


def face_to_face(free: FreeSpace, *, asks: bool = True) -> tuple[list[Figure], RightOfWay]:
    """Two people on either side of the doorway who want to get through."""
    a, b = np.array([4.6, 2.0]), np.array([6.0, 2.0])
    figures = [Figure(0, a, np.array([a, [9.0, 2.0]])), Figure(1, b, np.array([b, [1.0, 2.0]]))]

    def errand(number: int) -> TaskProgress:
        me = figures[number]
        return TaskProgress(me.obeys, number, lambda: lambda left=me.left_m: left, me.completed, me.obeys)

    return figures, RightOfWay(free, figures, errand, asks=asks)


def far_apart_after(figures: list[Figure], rules: RightOfWay, steps: int) -> tuple[int, list[bool]]:
    """The first step in which they are out of each other's way, -1 if none, and who was told to go in any step."""
    told, first = [False, False], -1
    for step in range(steps):
        decide(rules)
        for figure in figures:
            told[figure.number] |= figure.aside is not None
            figure.go()
        if first < 0 and math.dist(*(figure.xz for figure in figures)) > AVOIDANCE.stand_off_m:
            first = step
    return first, told


@pytest.mark.parametrize("driven", [0, 1])
def test_who_can_be_told_leaves_the_doorway_to_who_is_driven(rooms: FreeSpace, driven: int) -> None:
    figures, rules = face_to_face(rooms, asks=False)
    figures[driven].obeys, figures[driven].path = False, NO_PATH
    first, told = far_apart_after(figures, rules, 299)
    assert AVOIDANCE.held_up_steps < first < 299, "far from each other before it is a stand-off"
    assert told == [number != driven for number in (0, 1)]


def test_one_is_sent_away_and_the_next_time_the_other(rooms: FreeSpace) -> None:
    figures, rules = face_to_face(rooms, asks=False)
    turns: list[int] = []
    for _ in range(4 * AVOIDANCE.stand_off_steps[0]):  # nobody goes, so one gives up and it is the other's turn
        decide(rules)
        turns += [figure.number for figure in figures if figure.aside is not None and figure.number not in turns[-1:]]
    assert turns[:3] in ([0, 1, 0], [1, 0, 1])


@pytest.mark.parametrize("how", ["completes", "shortens its path", "is far"])
def test_nobody_who_gets_on_is_sent_away(rooms: FreeSpace, how: str) -> None:
    figures, rules = face_to_face(rooms, asks=False)
    if how == "is far":
        figures[1].xz = np.array([9.0, 2.0])
    for step in range(3 * AVOIDANCE.stand_off_steps[0]):
        figures[0].completed += how == "completes" and step % 50 == 49
        figures[0].left_m -= 0.02 * (how == "shortens its path")
        decide(rules)
        assert all(figure.aside is None for figure in figures), step


def test_nobody_is_sent_away_by_who_is_driven_beside_their_way(rooms: FreeSpace) -> None:
    """They turned, went a short way, or reached for something, and were sent off through the home."""
    figures, rules = face_to_face(rooms, asks=False)
    figures[1].obeys, figures[1].path, figures[1].xz = False, NO_PATH, np.array([4.4, 0.5])
    for step in range(150):
        figures[0].heading = 0.1 * step
        decide(rules)
        assert figures[0].aside is None, step


def test_who_waits_for_who_is_driven_waits_until_the_way_is_open(rooms: FreeSpace) -> None:
    figures, rules = face_to_face(rooms, asks=False)
    me, driven = figures
    driven.obeys, driven.path, driven.xz = False, NO_PATH, np.array([5.25, 2.0])
    for step in range(3 * AVOIDANCE.refuge_steps):
        decide(rules)
        me.go()
        me.path = np.array([me.xz, [9.0, 2.0]])
        assert me.aside is not None or step <= 2 * AVOIDANCE.held_off_steps
    assert math.dist(me.xz, driven.xz) > AVOIDANCE.stand_off_m
    driven.xz = np.array([7.0, 3.5])
    for _ in range(AVOIDANCE.looks_steps):
        decide(rules)
    assert me.aside is None


def test_who_is_turned_away_chooses_anew_wherever_the_other_stops(rooms: FreeSpace) -> None:
    figures, rules = face_to_face(rooms, asks=False)
    me, driven = figures
    driven.obeys, driven.path, driven.xz = False, NO_PATH, np.array([5.25, 2.0])
    chose: list[int] = []
    for step in range(200):
        decide(rules)
        if me.turned_away:
            chose.append(step)
        me.turned_away = False
        me.go()
        me.path = np.array([me.xz, [9.0, 2.0]])
        if 100 <= step < 120:  # on, and stops in the doorway again
            driven.xz = driven.xz - np.array([0.02, 0.0])
    looks = AVOIDANCE.held_up_steps + AVOIDANCE.looks_steps
    assert len(chose) == 2
    assert chose[0] <= looks
    assert 100 < chose[1] <= 120 + looks


def test_nobody_who_parts_from_a_planner_chooses_anew(rooms: FreeSpace) -> None:
    figures, rules = face_to_face(rooms, asks=False)
    _, told = far_apart_after(figures, rules, 299)
    assert any(told)
    assert not any(figure.turned_away for figure in figures)


def fled_to_refuge(free: FreeSpace) -> tuple[Figure, Figure, RightOfWay]:
    """One who has just got to a refuge from who is driven into the doorway and stands there."""
    figures, rules = face_to_face(free, asks=False)
    me, driven = figures
    driven.obeys, driven.path, driven.xz = False, NO_PATH, np.array([5.25, 2.0])
    for _ in range(200):
        decide(rules)
        me.turned_away = False
        me.go()
        me.path = np.array([me.xz, [9.0, 2.0]])
        if me.aside is not None and not len(me.aside) and math.dist(me.xz, driven.xz) > AVOIDANCE.stand_off_m:
            return me, driven, rules
    raise AssertionError("nobody fled")


def test_who_flees_does_not_stop_at_every_stop_of_who_comes_after(rooms: FreeSpace) -> None:
    """They chose anew each time, stood still for that, and were caught up with."""
    figures, rules = face_to_face(rooms, asks=False)
    me, driven = figures
    driven.obeys, driven.path, driven.xz = False, NO_PATH, np.array([5.25, 2.0])
    times = 0
    for step in range(150):
        decide(rules)
        times += me.turned_away
        me.turned_away = False
        assert times <= 1 or (me.aside is not None and not len(me.aside)), step
        if step % 40 >= 20 and times:
            driven.xz = driven.xz - np.array([0.02, 0.0])
        me.go(0.02)
        me.path = np.array([me.xz, [9.0, 2.0]])
    assert times >= 1


def test_nobody_turns_round_on_the_way_to_a_refuge_towards_who_comes_on() -> None:
    """In a room wide enough to get past they went back to meet them, and stood before them."""
    hall = floor_of(shapely.box(0, 0, 12, 2.4), shapely.box(11.9, 0.9, 12.6, 1.5))
    figures, rules = face_to_face(hall, asks=False)
    me, driven = figures
    driven.obeys, driven.path, driven.xz, me.xz = False, NO_PATH, np.array([11.9, 1.2]), np.array([10.9, 1.2])
    fled = False
    for step in range(260):
        me.path = np.array([me.xz, [12.3, 1.2]])
        decide(rules)
        fled |= me.aside is not None and len(me.aside) > 0
        if fled and driven.xz[0] > 8.0:
            assert me.aside is not None, step
            driven.xz = driven.xz - np.array([0.033, 0.0])
        me.go(0.03)
    assert fled
    assert driven.xz[0] <= 8.0


def test_who_waits_in_a_refuge_follows_who_leaves(rooms: FreeSpace) -> None:
    """They stayed until no way was shut any more, up to the far end of the home."""
    me, driven, rules = fled_to_refuge(rooms)
    for _ in range(20):
        driven.xz = driven.xz + np.array([0.03, 0.0])  # still in the doorway
        decide(rules)
        if me.aside is None:
            break
    assert me.aside is None
    assert driven.xz[0] < 5.9


def test_who_leaves_a_refuge_has_time_to_get_past(rooms: FreeSpace) -> None:
    """They were sent back on the way around, some steps after they had set off."""
    me, driven, rules = fled_to_refuge(rooms)
    driven.xz = me.xz + np.array([1.9, 1.9])  # in the open
    for _ in range(2 * AVOIDANCE.looks_steps + 1):
        decide(rules)
    assert me.aside is None
    driven.xz = me.xz + np.array([1.2, 1.2])
    for step in range(AVOIDANCE.stand_off_steps[1] - AVOIDANCE.looks_steps):
        me.path, me.heading = np.array([me.xz, [4.5, 0.5]]), me.heading + 0.1
        decide(rules)
        assert me.aside is None, step


def test_who_steps_back_to_let_another_out_stays_there_until_they_are(rooms: FreeSpace) -> None:
    """Once the one in the dead end was sent to a refuge, they came back at once and shut them in again."""
    figures, rules = face_to_face(rooms)
    cornered, comes = figures
    cornered.path, cornered.xz = NO_PATH, np.array([9.9, 3.6])
    rules._requests[0] = right_of_way._Request(0, np.array([[8.0, 3.6]]))
    rules._requests[1] = right_of_way._Request(0, np.zeros((0, 2)))
    comes.xz = np.array([9.9, 2.0])
    comes.path = np.array([comes.xz, [9.9, 3.0]])
    encounter = rules._stand_offs.of(0, 1)  # type: ignore[union-attr]
    encounter.steps = AVOIDANCE.stand_off_steps[0]
    decide(rules)
    assert cornered.aside is not None
    assert len(cornered.aside)
    assert comes.aside is not None


def test_who_flees_goes_on_where_the_other_comes_near_their_refuge(rooms: FreeSpace) -> None:
    """They stood 1.5 m before a robot that waited for them to let it pass, 396 steps in all."""
    me, driven, rules = fled_to_refuge(rooms)
    was = me.xz.copy()
    driven.xz = was + np.array([1.5, 0.0])
    for _ in range(150):
        decide(rules)
        me.turned_away = False
        me.path = np.array([me.xz, [9.0, 2.0]])
        me.go()
        if math.dist(me.xz, was) > AVOIDANCE.gets_on_m:
            return
    raise AssertionError("they stay where they are")


def test_nobody_turns_back_before_they_are_out_of_reach_of_whom_they_flee() -> None:
    """They turned back 1.5 m from the robot, as soon as it had moved a little, and met it again: 521 steps in all."""
    hall = floor_of(shapely.box(0, 0, 12, 3.0))
    figures, rules = face_to_face(hall, asks=False)
    me, driven = figures
    driven.obeys, driven.path = False, NO_PATH
    driven.xz, me.xz = np.array([6.5, 1.5]), np.array([5.0, 1.5])
    me.path = np.array([me.xz, [11.0, 1.5]])
    rules._requests[0] = right_of_way._Request(1, np.array([[2.0, 1.5]]), stays_steps=math.inf, seen=driven.xz.copy())
    for _ in range(60):
        me.path = np.array([me.xz, [11.0, 1.5]])
        decide(rules)
        assert me.aside is not None or math.dist(me.xz, driven.xz) >= AVOIDANCE.stand_off_m
        if me.aside is None:
            return
        me.go()
    raise AssertionError("they do not come back")


def test_who_waits_for_who_is_driven_waits_once(rooms: FreeSpace) -> None:
    """Whose way became another one while they waited, waited a second time: 130 steps before they gave way."""
    figures, rules = face_to_face(rooms, asks=False)
    me, driven = figures
    driven.obeys, driven.path, driven.xz, me.xz = False, NO_PATH, np.array([5.25, 2.0]), np.array([4.0, 2.0])
    for step in range(AVOIDANCE.waits_steps + 40):
        me.path = np.array([me.xz, [9.0, 2.0]])
        me.left_m -= 1.2 * (step == 30)
        decide(rules)
        if me.aside is not None and len(me.aside):
            return
    raise AssertionError("they still wait")


def test_who_stands_against_whom_they_flee_goes_on_only_from_some_way_off() -> None:
    """There every way past them seemed open: who fled stopped at once, and stood there."""
    passage = floor_of(shapely.box(0, 0, 5, 4), shapely.box(4.9, 1.2, 5.6, 2.8), shapely.box(5.5, 0, 10.5, 4))
    figures, rules = face_to_face(passage, asks=False)
    me, driven = figures
    driven.obeys, driven.path, driven.xz, me.xz = False, NO_PATH, np.array([5.25, 2.0]), np.array([4.85, 2.0])
    flees = False
    for _ in range(150):
        me.path = np.array([me.xz, [9.0, 2.0]])
        decide(rules)
        assert me.aside is not None or not flees
        flees |= me.aside is not None
        me.go(0.01)
    assert flees


def test_places_behind_who_stands_in_a_doorway_are_shut_off(rooms: FreeSpace) -> None:
    stands = Seen(np.array([5.25, 2.0]), settled=True)
    places = np.array([[2.0, 1.0], [9.0, 2.0]])
    assert shut_off(rooms, np.array([4.0, 2.0]), places, neighbours(stands)).tolist() == [False, True]
    moves = stands._replace(velocity=(1.0, 0.0))
    assert shut_off(rooms, np.array([4.0, 2.0]), places, neighbours(moves)).tolist() == [False, False]
    assert shut_off(rooms, np.array([4.0, 2.0]), places[:0], neighbours(stands)).tolist() == []


def test_nobody_steps_aside_to_where_the_other_is_about_to_walk(rooms: FreeSpace) -> None:
    """Who stood in a doorway went to meet the one who wanted to get through it: there the nearest place was."""
    comes, stands = np.array([3.4, 2.0]), np.array([5.0, 2.0])
    figures = [Figure(0, comes, np.array([comes, [9.0, 2.0]])), Figure(1, stands)]
    decide(RightOfWay(rooms, figures))
    aside = figures[1].aside
    assert aside is not None
    assert aside[-1][0] > 5.5


def test_a_planner_comes_back_to_what_others_kept_it_from() -> None:
    view: Any = SimpleNamespace(
        last=None,
        action=None,
        held_by=np.array([-1, -1]),
        agent=1,
        at_goal=np.zeros(2, np.bool_),
        barrier=lambda k, at: -1,
        is_known=lambda k: True,
    )
    for reason, goes_on in (("blocked", True), ("stuck", False)):
        planner = Planner((0,))
        view.last, view.action = SkillResult("failed", reason), Action("nav_to_object", 0)
        chosen = [planner.act(view) for _ in range(5)]
        assert (chosen[-1].skill == "nav_to_object") == goes_on


def test_a_planner_does_first_what_nobody_keeps_it_from() -> None:
    view: Any = SimpleNamespace(
        last=None,
        action=None,
        held_by=np.array([-1, -1]),
        agent=1,
        at_goal=np.zeros(2, np.bool_),
        barrier=lambda k, at: -1,
        is_known=lambda k: True,
    )
    planner = Planner((0, 1))
    assert planner.act(view).target == 0
    for target in (1, 0, 1):
        view.last = SkillResult("failed", "blocked")
        assert planner.act(view).target == target
    view.held_by[1], view.last = 1, SkillResult("failed", "blocked")  # in its hand: it can only wait
    assert planner.act(view) == Action("nav_to_goal", 1)


# --- the counter ------------------------------------------------------------------------------------------------------
def recorded(steps: int, gap_m: float, *, done: tuple[int, ...] = (), walks_mps: float = 0.0) -> Recording:
    """A robot that waits, and a person on their way to an object straight ahead."""
    poses = np.zeros((2, steps, 7))
    poses[0, :, 0], poses[:, :, 2] = 1.0, 2.0
    poses[1, :, 0] = 1.0 + gap_m + walks_mps * np.arange(steps) / 30
    columns = {f"agent_{k}.base_pose": poses[k] for k in range(2)}
    for k, skill in enumerate(("wait", "nav_to_object")):
        columns[f"agent_{k}.skill"] = np.full(steps, ALL_SKILLS.index(skill))
        columns[f"agent_{k}.skill_target"] = np.zeros(steps, np.int64)
    columns["metrics.dist_agents"] = poses[1, :, 0] - poses[0, :, 0]
    columns["object_pose"] = np.tile([9.0, 0.8, 2.0, 0, 0, 0, 1], (steps, 1, 1))
    spans = [SimpleNamespace(end_step=step, outcome="done", name="pick") for step in done]
    info = {"goals": [{"position": [2.0, 0.8, 1.0]}]}
    return cast(Recording, Recorded(columns=columns, skills=spans, episode=SimpleNamespace(info=info), steps=steps))


class Recorded(SimpleNamespace):
    def __len__(self) -> int:
        return self.steps


def test_stand_offs_are_counted(rooms: FreeSpace) -> None:
    count = standoff.stand_offs
    assert count(recorded(400, 2.0), rooms) == [(0, 399)]
    assert count(recorded(299, 2.0), rooms) == []
    assert count(recorded(400, 2.6), rooms) == []
    assert count(recorded(400, 2.0, done=(200,)), rooms) == []
    assert count(recorded(800, 2.0, done=(200,)), rooms) == [(201, 799)]
    assert count(recorded(320, 1.0, walks_mps=0.12), rooms) == []
    assert count(recorded(320, 1.0, walks_mps=0.08), rooms) == [(0, 319)]


def test_who_drives_to_an_errand_gets_on_as_others_do(rooms: FreeSpace) -> None:
    count, far = standoff.stand_offs, [float("nan")] * 400
    assert count(recorded(400, 2.0), rooms, [(1, 9.0 - 0.004 * k) for k in range(400)]) == []
    assert count(recorded(400, 2.0), rooms, [(1, 9.0)] * 400) == [(0, 399)]
    assert count(recorded(400, 2.0), rooms, [(k // 100, 9.0 - k // 100) for k in range(400)]) == [
        (0, 399)
    ]  # other errands
    assert count(recorded(400, 2.0), rooms, list(enumerate(far))) == [(0, 399)]


DANCE = 7945165734413234536
"""The seed of the first episode of ``generate rearrange --scenes small:3 --seed 3``: steps 454 to 776 were a stand-off."""


@pytest.mark.slow
def test_robot_and_person_do_not_dance() -> None:
    scene, free = standoff._home(3)
    episode = Rearrange().episode(scene, seed=DANCE, free=free)
    recording = simulate(Rearrange(), episode, {"robot": "complement", "human": "both"})
    assert standoff.stand_offs(recording, free) == []
    assert recording.episode.info["ended"] == "success"
    assert len(recording) < 872


@pytest.mark.slow
@pytest.mark.parametrize("seed", [15, 35, 39, 75])
def test_a_robot_that_is_driven_into_a_doorway_stops_nobody_for_good(seed: int) -> None:
    """They stood before it for 1177 steps, and gave up what they had to do."""
    recording, _, _ = standoff.play(seed, "parks")
    assert standoff.stand_offs(recording, standoff._home(seed % standoff.HOMES)[1]) == []


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "before"), [(36, 1500), (56, 1483)])
def test_whose_way_a_robot_shuts_takes_another_or_does_something_else(seed: int, before: int) -> None:
    """They waited, until it left, for the one place at which they wanted to stand."""
    recording, _, _ = standoff.play(seed, "parks")
    assert recording.episode.info["ended"] == "success"
    assert len(recording) < before - 50
    assert standoff.stand_offs(recording, standoff._home(seed % standoff.HOMES)[1]) == []


@pytest.mark.slow
def test_who_shuts_a_dead_end_lets_the_other_out() -> None:
    """The robot came back to its goal beside the idle person in the corner before they had got out: 360 steps."""
    recording, _, _ = standoff.play(5249)
    assert standoff.stand_offs(recording, standoff._home(9)[1]) == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", [32, 94, 195, 10072, 10234, 10299, 10315])
def test_who_gives_way_to_a_driver_on_errands_gets_away_from_them(seed: int) -> None:
    """They turned on the spot, stopped at every corner, and stood where the driver came after them: up to 396 steps."""
    recording, _, driver = standoff.play(seed, "errands")
    assert driver is not None
    assert standoff.stand_offs(recording, standoff._home(seed % standoff.HOMES)[1], driver.errands) == []


@pytest.mark.slow
def test_episodes_are_played_by_several_processes_and_not_twice(tmp_path: Path) -> None:
    file = tmp_path / "rows.jsonl"
    rows = list(standoff.played([10, 12, 18], file, workers=2))
    assert [row["seed"] for row in rows] == [10, 12, 18]
    lines = file.read_text().splitlines()
    assert len(lines) == 3
    file.write_text("\n".join(lines[:2]) + "\n")
    again = list(standoff.played([10, 12, 18], file))
    assert json.dumps(again) == json.dumps(rows)
    assert file.read_text().splitlines() == lines


def test_who_has_errands_goes_on_where_somebody_waits(rooms: FreeSpace) -> None:
    """Who parks in a doorway does not."""
    left = {}
    for name, kind in standoff.DRIVERS.items():
        driver, xz = kind(rooms, 0), np.array([5.25, 2.0])
        driver._heads_for(xz)
        driver._doorways = [xz]
        for step in range(200):
            waits = np.tile([2.5, 2.0], (31, 1))
            view: Any = SimpleNamespace(
                xz=xz, before=np.array([*xz, 0.0]), heading=0.0, other_xz=waits[-1], other_track=waits, arm=np.zeros(1)
            )
            if np.any(driver.act(view).command):  # type: ignore[arg-type]
                left[name] = step
                break
    assert set(left) == {"errands"}


@pytest.mark.slow
def test_nobody_gets_to_an_object_through_a_wall() -> None:
    """Less than 1 m from it, but behind a wall, was counted as near enough: the way was said to be open all the time."""
    recording, _, _ = standoff.play(77, "parks")
    assert standoff.shut_steps(recording, *standoff._home(7)) > 800


@pytest.mark.slow
def test_nobody_flees_from_a_robot_that_is_driven_elsewhere() -> None:
    """An episode of 759 steps took 1220."""
    recording, alone, _ = standoff.play(10, "parks")
    assert len(recording) < 1.1 * alone
