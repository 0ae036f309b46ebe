"""Places at which agents with oracle skills take and put down an episode's objects, and paths to these places."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from h3data.bodies import Humanoid, Robot
from h3data.errors import InputError
from h3data.geometry import Array
from h3data.scene import FreeSpace
from h3data.scene.articulation import joints_of
from sim_kinematic.agents.opening.doorways import RoomDoors
from sim_kinematic.agents.opening.reachable import openables_at
from sim_kinematic.agents.oracle.actors import SubGoal, SubGoals
from sim_kinematic.agents.oracle.ways import paths_to
from sim_kinematic.agents.person_clearance import reach_room
from sim_kinematic.agents.person_skills import HANDS
from sim_kinematic.agents.robots.arm_clearance import arm_clearance
from sim_kinematic.agents.stands import island_of, nearest_stand, person_stands, robot_stands
from sim_kinematic.motion.spec import OracleSpec
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode

Stands = tuple[Array, Callable[[Array], bool]]
"""Stands ``(x, z, heading)`` [N, 3], and a function that returns whether the body has room at one of them."""


def errands_of(episode: RearrangeEpisode, number: int, parts: tuple[int, ...] = ()) -> SubGoals:
    """Return the sub-goals of an agent in an episode, which are computed once and cached with the episode.

    ``parts`` are the joints of the doors and drawers that the agent may open (`Rearrange.parts_of`).

    Raises:
        InputError: A closed door is between the rooms of the home.
    """
    # beside the fields of the frozen episode: replace() leaves it out, so other agents have their own
    known = vars(episode).setdefault("_errands", {})
    if number not in known:
        openables = openables_at(episode.scene, joints_of(episode.scene).rest)
        if RoomDoors.of(episode.scene, episode.free).any_closed(openables.positions):
            raise InputError(
                f"Oracle skills open no doors on their way, and {episode.scene.name} has closed ones. Hint: other scenes, "
                "or rules without oracle.",
                code="H3-TASK-015",
            )
        # paths to the places where the agent takes and puts down each object
        starts = np.array([target.start[:3] for target in episode.targets], np.float64)
        goals = np.array([target.goal for target in episode.targets], np.float64)
        floor = episode.floor(number)
        handles, count = openables.handles(openables.positions)[list(parts)], len(starts)
        ways = [paths_to(floor, places) for places in stand_places(episode, number, [*starts, *goals, *handles])]
        known[number] = SubGoals(
            oracle=episode.spec.oracle or OracleSpec(),
            to_start=ways[:count],
            to_goal=ways[count : 2 * count],
            starts=starts,
            goals=goals,
            to_part=dict(zip(parts, map(SubGoal, ways[2 * count :], handles), strict=True)),
        )
    return known[number]


def stand_places(episode: RearrangeEpisode, number: int, points: list[Array]) -> list[Array]:
    """Return floor points [S, 2] [m] from which an agent reaches each of several world points [3].

    For each world point, they are the stand nearest to the agent's start and the stands nearest to those of each other
    point, among the stands with room for the agent's reach.
    """
    floor, start = episode.floor(number), episode.starts[number, :2]
    stands = [list(_stands(episode, number, floor, point)) for point in points]
    near = [_nearest(floor, one, start) for one in stands]
    found = []
    for one, own in zip(stands, near, strict=True):
        # an agent comes from its start, or from where it handled another object
        places = [own, *(_nearest(floor, one, other) for other in near if other is not None)]
        kept = [place for place in places if place is not None]
        # one stand may be the nearest from several places
        found.append(np.unique(np.array(kept), axis=0) if kept else np.zeros((0, 2)))
    return found


def _stands(episode: RearrangeEpisode, number: int, floor: FreeSpace, point: Array) -> Iterator[Stands]:
    """Yield stands to be tried one after the other, the best ones first."""
    body, scene, floor_y = episode.roster[number].body, episode.scene, episode.free.floor_y
    # only stands to which the agent can get from its start
    island = island_of(floor, episode.starts[number, :2])
    if isinstance(body, Robot):
        clearance = arm_clearance(scene, body, floor_y)
        stands = robot_stands(floor, body, episode.bases[number], point, island=island)
        # with room for the whole arm if possible, else with a free line from shoulder to point
        for test in (clearance.is_clear, clearance.is_open):
            yield stands, partial(test, point=point)
        return
    assert isinstance(body, Humanoid)
    room = reach_room(scene, body, floor_y)
    for hand in HANDS:
        yield (
            person_stands(floor, body, point, hand, island=island),
            partial(room.is_clear, point=point, hand=hand),
        )


def _nearest(floor: FreeSpace, tried: list[Stands], start: Array) -> Array | None:
    """Return the place [2] of the nearest stand with room, by the path from ``start`` [2]; None: there is none."""
    for stands, has_room in tried:
        k, _ = nearest_stand(floor, stands, start, is_clear=has_room)
        if k >= 0:
            return stands[k, :2].copy()
    return None
