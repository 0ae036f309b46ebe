"""Who gives way to whom: ways round those who stand, stepping aside, stopping before a contact."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import shapely

from h3data.bodies import load_humanoid
from h3data.geometry import ground_pose
from h3data.scene import FreeSpace, Scene
from h3data.scene.freespace.build import build_from_walkable
from h3data_homes import HomeSpec, build_home
from sim_kinematic.agents.person import Person
from sim_kinematic.agents.person_skills import PersonActor
from sim_kinematic.agents.robots.skills import RobotActor
from sim_kinematic.agents.skills import Action, Objects, SkillResult
from sim_kinematic.avoidance import right_of_way
from sim_kinematic.avoidance.right_of_way import RightOfWay
from sim_kinematic.avoidance.routes import FloorRoutes, distance_to_path, first_of_path
from sim_kinematic.avoidance.spec import AVOIDANCE, Footprint
from sim_kinematic.avoidance.yielding import NO_PATH, discs_of, in_the_way, path_around
from sim_kinematic.motion.spec import NATURAL_WALKER, STEP_S, WalkerSpec
from sim_kinematic.motion.state import WorldState
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.rearrange.episode import RearrangeSpec
from sim_kinematic.tasks.recorder import run
from tests.sim.avoidance.commands import Seen, decide, neighbours
from tests.simulated import REARRANGE, rearrange_episode, simulate_rearrange


@pytest.fixture(scope="module")
def home() -> Scene:
    return build_home(HomeSpec(preset="small", seed=5))


@pytest.fixture(scope="module")
def free(home: Scene) -> FreeSpace:
    return FreeSpace.from_scene(home)


SIZES: dict[str, Any] = {
    "floor_y": 0.0,
    "radius_m": 0.25,
    "height_m": 1.4,
    "max_climb_m": 0.2,
    "cell_m": 0.05,
}


def floor_of(*rooms: shapely.Polygon) -> FreeSpace:
    """The free space of rooms that are one."""
    return FreeSpace.from_map(build_from_walkable(shapely.MultiPolygon([shapely.union_all(rooms)]), **SIZES))  # type: ignore[list-item]


def corridor(length: float = 8.0, width: float = 1.0) -> FreeSpace:
    """A straight corridor along x with a pocket 1.4 m deep on its side in the middle."""
    pocket = shapely.box(length / 2 - 0.7, width, length / 2 + 0.7, width + 1.4)
    return floor_of(shapely.box(0, 0, length, width), pocket)


# --- ways -------------------------------------------------------------------------------------------------------------
def test_distances_to_ways_are_those_of_shapely() -> None:
    rng = np.random.default_rng(0)
    for count in (1, 2, 7):
        way, points = rng.uniform(-2, 2, (count, 2)), rng.uniform(-3, 3, (5, 4, 2))
        line = shapely.LineString(way) if count > 1 else shapely.Point(way[0])
        np.testing.assert_allclose(
            distance_to_path(points, way), shapely.distance(line, shapely.points(points)), atol=1e-12
        )
        length = line.length
        for share in (0.0, 0.3, 1.0, 2.0):
            first = first_of_path(way, share * length)
            assert np.hypot(*np.diff(first, axis=0).T).sum() == pytest.approx(min(share, 1.0) * length)
            np.testing.assert_allclose(distance_to_path(first, way), 0, atol=1e-9)
    assert np.isinf(distance_to_path(np.zeros((3, 2)), NO_PATH)).all()


def test_ways_are_free_and_hardly_longer_than_the_shortest(free: FreeSpace) -> None:
    rng, routes = np.random.default_rng(1), FloorRoutes.of(free)
    starts, ends = free.sample(rng, 40), free.sample(rng, 40)
    found = 0
    for a, b in zip(starts, ends, strict=True):
        way = routes.flood(a, np.zeros((0, 3))).path_to(b)
        if way is None:
            continue
        found += 1
        shortest, length = float(free.geodesic(a, b)), float(np.hypot(*np.diff(way, axis=0).T).sum())
        assert shortest - 1e-6 <= length <= 1.1 * shortest + 0.2
        np.testing.assert_array_equal(way[[0, -1]], [a, b])
        dots = np.concatenate([np.linspace(p, q, 20) for p, q in pairwise(way)])
        assert np.hypot(*(free.snap(dots) - dots).T).max() < 5e-3
    assert found >= 20


def test_ways_lead_round_discs_and_out_of_them(free: FreeSpace) -> None:
    rng, routes = np.random.default_rng(2), FloorRoutes.of(free)
    discs = np.append(free.sample(rng, 4), [[0.4], [0.5], [0.3], [0.6]], axis=1)
    for start in free.sample(rng, 25):
        inside = np.hypot(*(discs[:, :2] - start).T) < discs[:, 2]
        flood = routes.flood(start, discs)
        reached = np.isfinite(flood.distance)
        for x, z, radius in discs[~inside]:
            assert not reached[np.hypot(*(routes.centres - [x, z]).transpose(2, 0, 1)) < radius].any()
        goals = free.sample(rng, 3)
        for goal in goals:
            way = flood.path_to(goal)
            if way is not None and not inside.any() and (np.hypot(*(discs[:, :2] - goal).T) > discs[:, 2]).all():
                assert (distance_to_path(discs[:, :2], way) > discs[:, 2] - 0.08).all()  # corners of cells
        assert reached.sum() > 10


def test_floods_that_end_early_find_the_same_paths(free: FreeSpace) -> None:
    rng, routes = np.random.default_rng(3), FloorRoutes.of(free)
    found = 0
    for _ in range(30):
        (start, goal), discs = (
            free.sample(rng, 2),
            np.append(free.sample(rng, 4), rng.uniform(0.2, 0.7, (4, 1)), axis=1),
        )
        whole, to_goal = routes.flood(start, discs), routes.flood(start, discs, goal=goal)
        path, other = whole.path_to(goal), to_goal.path_to(goal)
        assert (path is None) == (other is None)
        if path is not None:
            found += 1
            np.testing.assert_array_equal(path, other)
        near = routes.flood(start, discs, farthest_m=1.5).distance
        np.testing.assert_array_equal(near[near <= 1.5], whole.distance[near <= 1.5])
        assert (near <= 1.5).sum() == (whole.distance <= 1.5).sum()
        assert np.isfinite(to_goal.distance).sum() <= np.isfinite(whole.distance).sum()
    assert found > 10


# --- what is in the way -------------------------------------------------------------------------------------------------
def seen(
    xz: object, *, is_robot: bool = False, heading: float = 0.0, velocity: tuple[float, float] = (0.0, 0.0)
) -> Seen:
    footprint = AVOIDANCE.robot if is_robot else AVOIDANCE.person
    return Seen(np.array(xz, np.float64), velocity, False, is_robot, heading, footprint)


def test_a_robot_is_as_long_as_it_is() -> None:
    along, across = (seen([1.0, 0.55], is_robot=True, heading=h) for h in (0.0, np.pi / 2))
    here, there = np.zeros(2), np.array([3.0, 0.0])
    assert in_the_way(here, there, neighbours(seen([1.0, 0.65]))) == -1
    assert in_the_way(here, there, neighbours(seen([1.0, 0.65], velocity=(0, -1)))) == 0
    assert in_the_way(here, there, neighbours(seen([3.0, 3.0]), across)) == 1
    assert in_the_way(here, there, neighbours(seen([-0.5, 0.0]))) == -1
    assert len(discs_of(along)) == 3
    np.testing.assert_allclose(discs_of(across)[:, 0], 1.0, atol=1e-9)


def test_whom_one_gets_no_nearer_to_is_not_in_the_way() -> None:
    """Two people side by side in a corridor waited for each other for the rest of the episode."""
    assert in_the_way(np.zeros(2), np.array([3.0, 0.0]), neighbours(seen([0.05, 0.5]))) == -1
    assert in_the_way(np.zeros(2), np.array([3.0, 0.0]), neighbours(seen([0.3, 0.5]))) == 0


def test_a_way_round_all_who_stand(free: FreeSpace) -> None:
    rng = np.random.default_rng(1)
    found = 0
    for a, b in zip(free.sample(rng, 40), free.sample(rng, 40), strict=True):
        path = free.path(a, b)
        others = [seen((p + q) / 2) for p, q in pairwise(path)][:2]
        if any(min(np.hypot(*(o.xz - a)), np.hypot(*(o.xz - b))) < 1.0 for o in others):
            continue
        way = path_around(free, a, b, neighbours(*others))
        if way is not None:
            found += 1
            whole = np.vstack([a, way])
            assert all(
                distance_to_path(o.xz, whole) > 2 * AVOIDANCE.person.radius_m + min(AVOIDANCE.passing_m) - 0.08
                for o in others
            )
        moving = [o._replace(velocity=(1.0, 1.0)) for o in others]
        assert path_around(free, a, b, neighbours(*moving)) is not None  # they will be elsewhere
    assert found >= 2


# --- stepping aside -----------------------------------------------------------------------------------------------------
@dataclass
class Puppet:
    """A walker that is where it is put."""

    number: int
    xz: np.ndarray
    is_robot: bool = False
    heading: float = 0.0
    path: np.ndarray = field(default_factory=lambda: NO_PATH)
    yields: bool = True
    turned_away: bool = False
    aside: np.ndarray | None = None
    hindered_by: frozenset[int] = frozenset()
    footprint: Footprint = AVOIDANCE.person

    @property
    def path_start(self) -> np.ndarray | None:
        return self.path[0] if len(self.path) else None


def puppet(number: int, x: float, z: float, to: tuple[float, float] | None = None) -> Puppet:
    here = np.array([x, z])
    return Puppet(number, here, path=NO_PATH if to is None else np.array([here, to]))


def test_who_has_nothing_to_do_leaves_the_way_at_once() -> None:
    free = corridor()
    comes, idle = puppet(0, 2.0, 0.5, (7.5, 0.5)), puppet(1, 4.0, 0.5)
    rule = RightOfWay(free, [comes, idle])
    decide(rule)
    assert comes.aside is None
    assert idle.aside is not None
    assert len(idle.aside)
    assert distance_to_path(idle.aside[-1], comes.path) >= AVOIDANCE.aside_share * AVOIDANCE.aside_m[0]
    idle.xz = idle.aside[-1].copy()
    decide(rule)
    assert idle.aside is None  # it is out of the way


def test_who_is_not_on_the_way_stays() -> None:
    free = corridor()
    comes, idle, behind = puppet(0, 2.0, 0.5, (3.0, 0.5)), puppet(1, 6.0, 0.5), puppet(2, 1.0, 0.5)
    rule = RightOfWay(free, [comes, idle, behind])
    for _ in range(2 * AVOIDANCE.held_up_steps):
        decide(rule)
        assert idle.aside is None
        assert behind.aside is None


@pytest.mark.parametrize(("carrying", "first"), [((), 1), ((0,), 0), ((0, 1), 1)])
def test_two_who_meet_in_a_corridor_agree_on_one(carrying: tuple[int, ...], first: int) -> None:
    """Who carries something goes first, then who has the shorter way."""
    both = puppet(0, 3.2, 0.5, (7.5, 0.5)), puppet(1, 4.2, 0.5, (0.2, 0.5))
    rule = RightOfWay(corridor(), both)
    for _ in range(AVOIDANCE.held_up_steps - 1):
        decide(rule, carrying)
        assert all(walker.aside is None for walker in both)  # they may get past each other
    for _ in range(3):
        decide(rule, carrying)
    passes, other = both[first], both[1 - first]
    assert passes.aside is None
    assert other.aside is not None
    assert distance_to_path(other.aside[-1], passes.path) >= AVOIDANCE.aside_share * AVOIDANCE.aside_m[0]
    other.xz = other.aside[-1].copy()
    decide(rule, carrying)
    assert other.aside is not None  # it stays there
    passes.xz, passes.path = passes.path[-1].copy(), NO_PATH
    decide(rule, carrying)
    assert other.aside is None  # the other has passed: it goes on


def test_a_row_backs_out_together() -> None:
    """The one in the middle can only step aside if the last does."""
    free = corridor()
    comes, middle, last = puppet(0, 1.5, 0.5, (7.5, 0.5)), puppet(1, 2.6, 0.5), puppet(2, 3.3, 0.5)
    rule = RightOfWay(free, [comes, middle, last])
    decide(rule)
    assert middle.aside is not None
    assert last.aside is not None
    ends = [puppet.aside[-1] for puppet in (middle, last)]  # type: ignore[index]
    assert np.hypot(*(ends[0] - ends[1])) > 0.3 or distance_to_path(ends[0], comes.path) > 0.5


def test_in_a_dead_end_the_roles_are_exchanged() -> None:
    """There is no room to step aside but behind the one who comes."""
    free = floor_of(shapely.box(0, -1.5, 2, 2.5), shapely.box(2, 0, 6, 1.0))
    comes, idle = puppet(0, 3.0, 0.5, (5.5, 0.5)), puppet(1, 4.5, 0.5)
    rule = RightOfWay(free, [comes, idle])
    decide(rule)
    assert comes.aside is not None
    assert idle.aside is not None
    assert comes.aside[-1][0] < 2.5
    assert idle.aside[-1][0] < 2.5
    assert np.hypot(*(comes.aside[-1] - idle.aside[-1])) >= AVOIDANCE.aside_share * AVOIDANCE.aside_m[0]


def test_exchanged_roles_last_until_somebody_had_time_to_move() -> None:
    """The one that was held up for long before used to give up stepping aside after a few steps, turning, and both stood face
    to face for the rest of the episode."""
    both = puppet(0, 3.2, 0.5, (7.5, 0.5)), puppet(1, 4.2, 0.5, (0.2, 0.5))
    rule = RightOfWay(corridor(), both)
    steps = 0
    while any(walker.aside is None for walker in both):
        decide(rule)
        steps += 1
        assert steps < 200
    for _ in range(AVOIDANCE.gives_up_steps - 1):
        decide(rule)
        assert all(walker.aside is not None for walker in both)


def test_who_is_busy_is_not_asked() -> None:
    comes, busy = puppet(0, 2.0, 0.5, (7.5, 0.5)), puppet(1, 4.0, 0.5)
    busy.yields = False
    rule = RightOfWay(corridor(), [comes, busy])
    for _ in range(2 * AVOIDANCE.held_up_steps):
        decide(rule)
        assert busy.aside is None


def test_who_steps_aside_from_elsewhere_than_planned_goes_around_furniture() -> None:
    """Somebody who had first gone back a few steps walked straight at the point, 16 cm through a table."""
    free = floor_of(shapely.box(0, 0, 4, 4).difference(shapely.box(1.5, 1.0, 2.5, 4.0)))
    base = ground_pose(np.array([1.0, 2.5]), 0.0, free.floor_y)
    objects = Objects((), np.zeros((0, 3)), WorldState.zeros(1, robots=0, people=1))
    person = Person(load_humanoid("female_0"), base, spec=NATURAL_WALKER)
    actor = PersonActor(person, free, NATURAL_WALKER, objects, 0)
    actor.aside = np.array([[3.2, 2.5]])
    for _ in range(300):
        actor.idle()
        assert free.signed_distance(actor.xz) >= free.radius_m - 0.02
    np.testing.assert_allclose(actor.xz, actor.aside[0], atol=0.05)


def test_who_cannot_turn_for_somebody_beside_them_steps_back(free: FreeSpace) -> None:
    places = free.sample(np.random.default_rng(0), 200)
    at = places[np.argmax(free.signed_distance(places))]
    base = ground_pose(at, 0.0, free.floor_y)
    objects = Objects((), np.zeros((0, 3)), WorldState.zeros(1, robots=0, people=1))
    actor = PersonActor(Person(load_humanoid("female_0"), base, spec=NATURAL_WALKER), free, NATURAL_WALKER, objects, 0)
    actor.meets = lambda: abs(actor.heading) > 0.1  # an elbow would touch
    actor.aside = np.array([at - [0.6, 0.0]])
    for _ in range(120):
        actor.idle()
    np.testing.assert_allclose(actor.xz, actor.aside[0], atol=0.02)


def test_who_steps_aside_walks_while_they_turn() -> None:
    """They turned on the spot first, and stopped at every corner: 1.3 s, and again 0.5 s each, in the other's way."""
    free = floor_of(shapely.box(0, 0, 6, 4))
    objects = Objects((), np.zeros((0, 3)), WorldState.zeros(1, robots=0, people=1))
    person = Person(
        load_humanoid("female_0"), ground_pose(np.array([4.0, 1.0]), 0.0, free.floor_y), spec=NATURAL_WALKER
    )
    actor = PersonActor(person, free, NATURAL_WALKER, objects, 0)
    actor.aside = np.array([[3.0, 1.0], [1.6, 1.9]])
    steps = []
    while len(actor.aside):
        before = actor.xz.copy()  # a view, which moves with the person
        actor.idle()
        steps.append(float(np.hypot(*(actor.xz - before))))
        if float(np.hypot(*(actor.aside[0] - actor.xz))) < 0.01:
            actor.aside = actor.aside[1:]
    assert sum(steps[:20]) > 0.15
    assert len(steps) < 115
    assert max(steps) <= NATURAL_WALKER.speed_mps * STEP_S + 1e-9


# --- stopping -------------------------------------------------------------------------------------------------------------
def test_a_hand_that_is_in_somebodys_way_is_taken_back(home: Scene, free: FreeSpace) -> None:
    at = free.sample(np.random.default_rng(0), 1)[0]
    base = ground_pose(at, 0.0, free.floor_y)
    thing = np.append(base[:3] + np.array([0.45, 0.9, 0.1]), [0, 0, 0, 1.0])
    state = WorldState.zeros(1, robots=0, people=1, objects=1)
    state.object_pose[0, 0] = thing
    person = Person(load_humanoid("female_0"), base, {"cup": thing})
    actor = PersonActor(person, free, WalkerSpec(), Objects(("cup",), np.zeros((1, 3)), state), 0)
    before, meetings = person.frame(), iter([False] * 12 + [True] * 200 + [False] * 400)
    actor.meets = lambda: next(meetings)
    skill, steps = actor.start(Action("pick", 0)), 0
    ending = None
    while ending is None:
        try:
            next(skill)
            steps += 1
        except StopIteration as end:
            ending = end.value
    assert ending == SkillResult("failed", "blocked")
    after = person.frame()
    np.testing.assert_array_equal(after.joints, before.joints)
    np.testing.assert_array_equal(after.root, before.root)
    assert not person.held
    assert steps > 100


@pytest.mark.parametrize(
    ("agents", "seed", "steps"),
    [
        pytest.param("robot,human,male_1", 3, 1500, marks=pytest.mark.slow),
        ("human,human,human,robot,robot", 4, 200),
    ],
)
def test_nobody_touches_anybody(home: Scene, free: FreeSpace, agents: str, seed: int, steps: int) -> None:
    world = rearrange_episode(home, seed=seed, free=free, agents=agents)
    world = replace(world, spec=replace(world.spec, max_steps=steps))
    made = simulate_rearrange(world, policy="complement", partner="both", solo_steps=1)
    assert not made.columns["metrics.collision"].any()
    assert made.episode.info["ended"] == ("success" if steps == 1500 else "max_steps")


@pytest.mark.slow  # quick: tasks/test_giving_way.py
def test_who_has_finished_clears_a_doorway(home: Scene, free: FreeSpace) -> None:
    """Somebody who does nothing stands in the narrowest place of the other's way, and somebody else looks on."""
    spec = RearrangeSpec(max_steps=1000)  # with nobody in the way the person needs 870
    world = rearrange_episode(home, seed=3, free=free, agents="human,male_1,female_2", spec=spec)
    points = [point[[0, 2]] for target in world.targets for point in (target.start, target.goal)]
    paths = [free.path(world.starts[0, :2], point, max_snap_m=2.0) for point in points]
    path = max(paths, key=lambda way: float(np.hypot(*np.diff(way, axis=0).T).sum()))
    dots = np.concatenate([np.linspace(p, q, 30) for p, q in pairwise(path)])
    inner = dots[(np.hypot(*(dots - path[0]).T) > 1.0) & (np.hypot(*(dots - path[-1]).T) > 1.0)]
    narrow = inner[int(np.argmin(free.signed_distance(inner)))]
    places = world.starts.copy()
    places[1, :2] = narrow
    world = replace(world, starts=places)
    play = WorldRollout.of(REARRANGE, world, {"human": "both,still,still"})
    assert run(play) == "success"
    idle = play.team.company.track(1)
    assert np.hypot(*(idle[-1] - narrow)) > 0.3  # the person went out of the way


@pytest.mark.slow
def test_mixes_of_three_to_five_neither_touch_nor_block_each_other() -> None:
    from benchmarks.sim_many import play_all

    runs = list(play_all(4))
    assert sum(run.ended == "collision" for run in runs) <= 0.03 * len(runs)
    assert sum(run.ended == "success" for run in runs) >= 0.85 * len(runs)
    assert sum(run.blocked for run in runs) <= 0.03 * len(runs)


# --- agents far from each other -----------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("agents", [None, "robot,robot,human,human"])
def test_not_ranking_those_who_are_clear_of_each_other_changes_nothing(
    home: Scene, free: FreeSpace, agents: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    hashes, blocks = [], []
    count = right_of_way._CALL

    def counted(*args: Any) -> tuple[bool, Any]:
        may_block, near = count(*args)
        blocks.append(bool(may_block))
        return may_block, near

    for counts in (counted, lambda *args: (True, count(*args)[1])):
        monkeypatch.setattr(right_of_way, "_CALL", counts)
        episode = rearrange_episode(home, seed=4, free=free, agents=agents)
        episode = replace(episode, spec=replace(episode.spec, max_steps=400))
        hashes.append(simulate_rearrange(episode, solo_steps=1).columns["state_hash"])
    np.testing.assert_array_equal(*hashes)
    assert 0 < sum(blocks) < len(blocks)


@pytest.mark.slow
def test_robots_work_out_their_paths_only_where_somebody_may_have_to_step_aside(
    home: Scene, free: FreeSpace, monkeypatch: pytest.MonkeyPatch
) -> None:
    announced, worked_out = [], []
    announce = RobotActor._announce

    def counted(robot: RobotActor, via: np.ndarray, goal: np.ndarray) -> None:
        announce(robot, via, goal)
        path = robot._path
        announced.append(1)
        robot._path = lambda: worked_out.append(1) or path()  # type: ignore[operator]

    monkeypatch.setattr(RobotActor, "_announce", counted)
    simulate_rearrange(rearrange_episode(home, seed=3, free=free), solo_steps=1)
    assert announced
    assert len(worked_out) < 0.5 * len(announced)


def blocker_in_python(xz: np.ndarray, towards: np.ndarray, others: list[Seen]) -> int:
    """`in_the_way`, agent after agent in plain Python."""
    (leg_x, leg_z), found, nearest = (towards - xz).tolist(), -1, np.inf
    length = float(np.hypot(leg_x, leg_z))
    for k, other in enumerate(others):
        moves = np.hypot(*other.velocity) > AVOIDANCE.stands_mps
        for x, z, radius in discs_of(other):
            gap_x, gap_z = x - xz[0], z - xz[1]
            room = AVOIDANCE.person.radius_m + radius + AVOIDANCE.moving_m * moves
            along, aside = (gap_x * leg_x + gap_z * leg_z) / length, abs(gap_x * leg_z - gap_z * leg_x) / length
            distance = float(np.hypot(gap_x, gap_z))
            nears = along > 0 and distance - aside > AVOIDANCE.beside_nearer_m
            if nears and along < min(AVOIDANCE.ahead_m, length) + room and aside < room and distance < nearest:
                found, nearest = k, distance
    return found


def test_the_kernel_finds_who_is_in_the_way() -> None:
    rng, found = np.random.default_rng(2), set()
    for _ in range(500):
        others = [
            seen(
                rng.uniform(-2, 2, 2),
                is_robot=bool(rng.random() < 0.5),
                heading=float(rng.uniform(-3, 3)),
                velocity=tuple((rng.uniform(-1, 1, 2) * (rng.random() < 0.5)).tolist()),
            )
            for _ in range(int(rng.integers(4)))
        ]
        xz, towards = rng.uniform(-0.5, 0.5, (2, 2))
        found.add(in_the_way(xz, towards, neighbours(*others)))
        assert in_the_way(xz, towards, neighbours(*others)) == blocker_in_python(xz, towards, others)
        discs = neighbours(*others).discs(np.ones(len(others), np.bool_))
        np.testing.assert_array_equal(discs, np.concatenate([np.zeros((0, 3)), *map(discs_of, others)]))
    assert found == {-1, 0, 1, 2}
