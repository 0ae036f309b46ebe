"""A person reaches only where their body has room: not through walls, not with the head in a shelf."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from h3data.bodies import JOINT_INDEX, load_humanoid
from h3data.bodies.people.reach import reacher
from h3data.geometry import ground_pose
from h3data.recording import Recording
from h3data.scene import FreeSpace, Scene
from h3data_homes import HomeSpec, build_home
from sim_kinematic.agents.person import Person, run
from sim_kinematic.agents.person_clearance import REACHING_PARTS, TOLERANCE_M, BodyClearance
from sim_kinematic.agents.person_skills import PersonActor
from sim_kinematic.agents.skills import Action, Objects, SkillResult
from sim_kinematic.agents.stands import nearest_stand, person_stands
from sim_kinematic.contact import FclScene, MovingShapes, capsule_transforms, contacts, shapes_from_capsules
from sim_kinematic.motion.spec import WalkerSpec
from sim_kinematic.motion.state import NOBODY, WorldState
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.sources import EpisodeSource
from tests.simulated import rearrange_episode, simulate_rearrange

DEEPEST_M = TOLERANCE_M + 0.01
"""In recorded episodes: a little more between the frames that are looked at."""


@pytest.fixture(scope="module")
def home() -> Scene:
    return build_home(HomeSpec(preset="small", seed=1))


@pytest.fixture(scope="module")
def world(home: Scene) -> RearrangeEpisode:
    return rearrange_episode(home, seed=3, free=FreeSpace.from_scene(home, radius_m=0.25, cache=False))


def parts_inside(recording: Recording, scene: Scene, *, deeper_than_m: float) -> set[tuple[str, str]]:
    """Capsules of the person that are deeper than this in something while they pick or place, and in what."""
    person = len(recording.agents) - 1
    body, scenery = load_humanoid("female_0"), FclScene(scene)
    at = f"agent_{person}."
    bones = body.joint_matrices_free(
        recording.columns[at + "root_pose"].astype(np.float64), recording.columns[at + "joint_quat"].astype(np.float64)
    )
    start, end, radius = body.capsules_world(bones)
    thinner = MovingShapes(shapes_from_capsules(start[0], end[0], np.maximum(radius - deeper_than_m, 1e-3)))
    found = set()
    for step in np.flatnonzero(np.isin(recording.columns[at + "skill"], (2, 3))):
        thinner.set_transforms(capsule_transforms(start[step], end[step]))
        found |= {(body.capsules[c.index_b].name, scenery.names[c.index_a]) for c in contacts(scenery, thinner)}
    return found


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.slow)])
def test_in_recorded_episodes_her_body_keeps_out_of_the_home(home: Scene, world: RearrangeEpisode, seed: int) -> None:
    played = world if seed == world.seed else rearrange_episode(home, seed=seed, free=world.free)
    recording = simulate_rearrange(played, policy="solo", partner="both", solo_steps=1)
    assert recording.episode.info["ended"] == "success"
    supports = {place.partition("|")[0] for t in played.targets for place in (t.source, t.destination)}
    for part, thing in parts_inside(recording, home, deeper_than_m=DEEPEST_M):
        assert part in REACHING_PARTS["right"]
        assert thing in supports


@pytest.mark.slow
def test_in_many_homes_her_body_keeps_out() -> None:
    source = EpisodeSource(Rearrange(), "h3-homes/test")
    for number in range(0, 150, 15):
        played = source.sample(0, number)
        recording = simulate_rearrange(played, policy="solo", partner="both", solo_steps=1)
        inside = parts_inside(recording, played.scene, deeper_than_m=DEEPEST_M)
        parts = {part for part, thing in inside if not thing.startswith("plant")}  # leaves are solid shapes here
        assert parts <= {*REACHING_PARTS["right"], *REACHING_PARTS["left"]}


def test_what_stands_in_her_way_leaves_no_room(home: Scene, world: RearrangeEpisode) -> None:
    body, free = world.human, world.free
    point = world.targets[0].start[:3]
    room = BodyClearance(home, body, free.floor_y)
    stands = person_stands(free, body, point)
    clear = np.array([room.is_clear(stand, point) for stand in stands])
    assert clear.any()
    stand = stands[np.flatnonzero(clear)[0]]
    tall = max(
        home.static_instances, key=lambda i: np.ptp(home.assets[i.asset].mesh.bounds, axis=0)[1] * ("shelf" in i.name)
    )
    beside = ground_pose(stand[:2], float(stand[2]), free.floor_y)
    blocked = replace(home, instances=(*home.instances, replace(tall, name="in_the_way", pose=beside)))
    assert not BodyClearance(blocked, body, free.floor_y).is_clear(stand, point)
    again = BodyClearance(home, body, free.floor_y)  # what it was asked before does not matter
    order = np.random.default_rng(0).permutation(len(stands))
    np.testing.assert_array_equal([again.is_clear(stands[k], point) for k in order], clear[order])
    k, _ = nearest_stand(free, stands, world.starts[1, :2], is_clear=lambda s: room.is_clear(s, point))
    assert clear[k]
    assert nearest_stand(free, stands, world.starts[1, :2], is_clear=lambda s: False) == (-1, np.inf)


def test_the_way_that_is_looked_at_is_the_one_that_is_gone() -> None:
    """`Person.hand_path` and what `pick` and `place` do, but for the gaze and the fingers, which move by themselves."""
    trunk_and_limbs = np.setdiff1d(
        np.arange(JOINT_INDEX["right_wrist"]), [JOINT_INDEX["neck"] - 1, JOINT_INDEX["head"] - 1]
    )
    body = load_humanoid("female_0")
    person = Person(body, ground_pose([0.0, 0.0], 0.3), {"cup": np.array([0.0, 1.0, 0.0, 0, 0, 0, 1.0])})
    person.objects["cup"][:3] = person.palm("right")[:3] + np.array([0.3, 0.3, 0.0])
    point = person.objects["cup"][:3].copy()
    assert reacher(body, "right").reachable(person.seen(point)[None])[0]
    empty = person.hand_path(point)
    frames, result = run(person, person.pick("cup"))
    assert result.success
    assert min(np.abs((f.joints - empty.quats[-1, 1:])[trunk_and_limbs]).max() for f in frames) < 1e-9
    full = person.hand_path(point, full=True)
    frames, _ = run(person, person.place(point))
    assert min(np.abs((f.joints - full.quats[-1, 1:])[trunk_and_limbs]).max() for f in frames) < 1e-9


class NoRoom(BodyClearance):
    """Nowhere."""

    def __init__(self) -> None: ...

    def is_clear(self, stand: Any, point: Any, hand: Any = "right") -> bool:
        return False


def test_without_room_the_skill_fails_and_says_so(world: RearrangeEpisode) -> None:
    state = WorldState.zeros(1, objects=2)
    state.object_pose[0] = [t.start for t in world.targets]
    objects = Objects(tuple(t.name for t in world.targets), np.array([t.goal for t in world.targets]), state)
    stand = person_stands(world.free, world.human, world.targets[0].start[:3])[0]
    person = Person(
        world.human, ground_pose(stand[:2], float(stand[2])), dict(zip(objects.names, objects.poses, strict=True))
    )

    def ending(skill: Generator[None, None, SkillResult]) -> SkillResult:
        while True:
            try:
                next(skill)
            except StopIteration as end:
                return end.value

    for room, reason in ((NoRoom(), "no_room"), (None, "")):
        actor = PersonActor(person, world.free, WalkerSpec(), objects, 1, room)
        assert ending(actor.start(Action("pick", 0))).reason == reason
        assert ending(actor.start(Action("nav_to_goal", 0))).reason == reason


def test_the_left_hand_takes_what_the_right_cannot(world: RearrangeEpisode) -> None:
    """Where only the left side has room, a person walks to a stand of the left hand, takes and puts down with that hand."""

    class OnlyLeft(BodyClearance):
        def __init__(self) -> None: ...

        def is_clear(self, stand: Any, point: Any, hand: Any = "right") -> bool:
            return hand == "left"

    state = WorldState.zeros(1, objects=2)
    state.object_pose[0] = [t.start for t in world.targets]
    objects = Objects(tuple(t.name for t in world.targets), np.array([t.goal for t in world.targets]), state)
    start = ground_pose(world.starts[1, :2], world.starts[1, 2], world.free.floor_y)
    person = Person(world.human, start, dict(zip(objects.names, objects.poses, strict=True)))
    actor = PersonActor(person, world.free, WalkerSpec(), objects, 1, OnlyLeft())
    for name in ("nav_to_object", "pick"):
        assert run(person, actor.start(Action(name, 0)))[1] == SkillResult("done")  # type: ignore[arg-type,comparison-overlap]
    assert list(person.held) == ["left"]
    assert objects.held(1) == 0
    np.testing.assert_allclose(actor.hand_pose[:3], objects.poses[0, :3], atol=0.02)
    assert actor._hands(0) == ("left",)
    point = person.palm("left")[:3] - np.array([0.0, 0.1, 0.0])
    objects.goals[0] = point
    assert run(person, actor.start(Action("place", 0)))[1] == SkillResult("done")  # type: ignore[arg-type,comparison-overlap]
    assert objects.held(1) == NOBODY
    np.testing.assert_allclose(objects.poses[0, :3], point, atol=0.012)
