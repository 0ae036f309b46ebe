"""Moments of learned behaviour: events find what they are named for in made-up recordings, and nothing else."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from bake.sheets.behaviour import (
    FILMS,
    Motion,
    backs_up_at_a_door,
    fetches_what_is_left,
    follows_around_a_corner,
    gives_way,
    room_of,
    shares_the_task,
    waits,
)
from h3data.geometry import ground_pose
from h3data.recording import Recording
from h3data.recording.records import STEP_NS, Agent, Episode, Event
from h3data.scene import Room
from tests.paths import DOCS

ROOMS = (
    Room(name="hall", category="hall", rectangles=np.array([[-20.0, -20.0, 0.0, 20.0]])),
    Room(name="kitchen", category="kitchen", rectangles=np.array([[0.0, -20.0, 20.0, 20.0]])),
)


def made_up(
    robot: Any, person: Any, *, heading: float = 0.0, hit: bool = False, events: Any = (), **info: Any
) -> Recording:
    """A recording in which the agents are at given places [T, 2], the robot with one heading."""
    robot, person = np.asarray(robot, float), np.asarray(person, float)
    steps = len(robot)
    touch = np.zeros(steps, np.bool_)
    touch[steps // 2] = hit
    return Recording(
        episode=Episode(uid="a", episode_id="a", task="rearrange", scene="x", info=info),
        agents=(Agent(name="robot", kind="robot"), Agent(name="human", kind="human")),
        columns={
            "time_ns": np.arange(1, steps + 1) * STEP_NS,
            "agent_0.base_pose": ground_pose(robot, np.full(steps, heading)).astype(np.float32),
            "agent_1.base_pose": ground_pose(person, np.zeros(steps)).astype(np.float32),
            "metrics.collision": touch,
        },
        events=tuple(
            Event(step=step, agent=agent, kind=kind, target=target, detail=detail)
            for step, agent, kind, target, detail in events
        ),
    )


def line(start: tuple[float, float], end: tuple[float, float], steps: int) -> np.ndarray:
    return np.linspace(start, end, steps)


def found(event: Any, recording: Recording) -> list[tuple[int, int]]:
    return [(moment.first, moment.last) for moment in event(recording, Motion.of(recording, ROOMS))]


def test_rooms_of_places() -> None:
    assert room_of(np.array([[-1.0, 0.0], [1.0, 0.0], [90.0, 0.0]]), ROOMS).tolist() == [0, 1, -1]


def test_backing_up_at_a_door() -> None:
    person = line((2.0, 0.0), (-1.5, 0.0), 120)  # through the door at x = 0
    robot = line((0.5, 0.0), (-3.0, 0.0), 120)
    assert found(backs_up_at_a_door, made_up(robot, person, heading=0.0)) == [(0, 119)]
    # with the other heading it drives forward; a touch, another room or a distant person do not count either
    assert not found(backs_up_at_a_door, made_up(robot, person, heading=np.pi))
    assert not found(backs_up_at_a_door, made_up(robot, person, hit=True))
    assert not found(backs_up_at_a_door, made_up(robot - np.array([8.0, 0.0]), person - np.array([8.0, 0.0])))
    assert not found(backs_up_at_a_door, made_up(robot - np.array([3.0, 0.0]), person))
    assert not found(backs_up_at_a_door, made_up(robot[:100], person[:100]))


def test_giving_way() -> None:
    person = line((-4.0, 0.0), (0.0, 0.0), 120)
    aside = np.concatenate([line((-2.0, 0.1), (-2.0, 0.9), 50), np.full((70, 2), (-2.0, 0.9))])
    ((first, last),) = found(gives_way, made_up(aside, person))
    assert last - first == 119
    assert not found(gives_way, made_up(np.full((120, 2), (-2.0, 0.1)), person))  # the person walks around it
    assert not found(gives_way, made_up(aside, person, hit=True))
    assert not found(gives_way, made_up(aside + np.array([0.0, 3.0]), person))


def test_waiting() -> None:
    robot = np.concatenate([line((0, 0), (1, 0), 40), np.full((60, 2), (1.0, 0.0)), line((1, 0), (2, 0), 50)])
    person = line((2.5, -1.5), (2.5, 1.5), 150)
    assert found(waits, made_up(robot, person)) == [(10, 146)]
    assert not found(waits, made_up(robot, np.full((150, 2), (2.5, 0.0))))  # nobody walks
    assert not found(waits, made_up(robot, person + np.array([5.0, 0.0])))
    assert not found(waits, made_up(np.full((150, 2), (1.0, 0.0)), person))  # it never drives


def test_following_around_a_corner() -> None:
    person = np.concatenate([line((-3.0, 0.0), (1.0, 0.0), 100), line((1.0, 0.0), (1.0, 4.0), 100)])
    robot = np.concatenate([np.tile(person[:1], (40, 1)) + line((-1.6, 0), (0, 0), 40), person[:-40]])
    (moment,) = found(follows_around_a_corner, made_up(robot, person))
    assert moment[1] - moment[0] == 149
    straight = line((-3.0, 0.0), (5.0, 0.0), 200)
    assert not found(follows_around_a_corner, made_up(straight - np.array([1.5, 0.0]), straight))
    assert not found(follows_around_a_corner, made_up(robot - np.array([4.0, 0.0]), person))


EVENTS = (
    (20, 1, "pick", "mug", ""),
    (60, 0, "pick", "apple", ""),
    (90, 1, "place", "mug", "at its goal"),
    (150, 0, "place", "apple", "at its goal"),
    (150, -1, "success", "", ""),
)
NEAR = line((0.0, 0.0), (3.0, 0.0), 200), line((4.0, 0.0), (1.5, 1.0), 200)


def test_fetching_what_the_person_leaves() -> None:
    assert found(fetches_what_is_left, made_up(*NEAR, events=EVENTS, partner="object_1")) == [(15, 165)]
    assert not found(fetches_what_is_left, made_up(*NEAR, events=EVENTS, partner="both"))
    dropped = [*EVENTS[:3], (150, 0, "place", "apple", "")]
    assert not found(fetches_what_is_left, made_up(*NEAR, events=dropped, partner="object_1"))


def test_sharing_the_task() -> None:
    assert found(shares_the_task, made_up(*NEAR, events=EVENTS, partner="both")) == [(0, 199)]
    assert not found(shares_the_task, made_up(*NEAR, hit=True, events=EVENTS))
    assert not found(shares_the_task, made_up(NEAR[0], NEAR[1] + np.array([0.0, 9.0]), events=EVENTS))
    assert not found(shares_the_task, made_up(*NEAR, events=EVENTS[:-1]))
    alone = [(step, 0, kind, target, detail) for step, _, kind, target, detail in EVENTS]
    assert not found(shares_the_task, made_up(*NEAR, events=alone))


def test_the_documentation_names_every_film() -> None:
    page = (DOCS / "behaviour.md").read_text()
    assert all(f"`{name}`" in page for name in FILMS)
    shown = re.findall(r"pictures/behaviour_([a-z]+)\.webp", page)
    assert set(shown) == {file.stem.removeprefix("behaviour_") for file in (DOCS / "pictures").glob("behaviour_*.webp")}
    assert sum((DOCS / f"pictures/behaviour_{name}.webp").stat().st_size for name in shown) <= 2.5e6
