"""Rearrangement in homes with doors: who has to get through opens them, and what is open or closed makes the floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from h3data.recording import Recording, state_hash
from h3data.recording.records import JOINTS
from h3data.scene import FreeSpace, Scene
from h3data.scene.articulation import joints_of, posed
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.validation.recordings import validate_recording
from sim_kinematic.agents.driven.commands import Close, Open
from sim_kinematic.agents.opening.doorways import RoomDoors
from sim_kinematic.agents.skills import Action
from sim_kinematic.policies.policy import External
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode, RearrangeSpec, draw_episode
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.resume import resume, verify
from sim_kinematic.tasks.sessions import Session
from tests.random_cases import examples
from tests.simulated import REARRANGE, rearrange_episode


@pytest.fixture(scope="module")
def home() -> Scene:
    return build_home(HomeSpec(seed=0, generation=2, doors=True))


@pytest.fixture(scope="module")
def free(home: Scene) -> FreeSpace:
    return FreeSpace.from_scene(home, radius_m=0.25, height_m=1.41)


@pytest.fixture(scope="module")
def episode(home: Scene, free: FreeSpace) -> RearrangeEpisode:
    """One thing, to be brought through a door that is closed."""
    doorways = RoomDoors.of(home, free)
    for seed in range(40):
        found = rearrange_episode(home, seed=seed, free=free, spec=RearrangeSpec(objects=1))
        (target,) = found.targets
        ends = [target.start[[0, 2]], target.goal[[0, 2]]]
        path = doorways.open_floor.path(*ends, max_snap_m=2.0)
        if doorways.crossed(path, joints_of(home).rest, 0.25):
            return found
    raise AssertionError("no episode leads through a door")


@pytest.fixture(scope="module")
def recording(episode: RearrangeEpisode) -> Recording:
    return simulate(REARRANGE, episode.only(1), {"human": "both"}, info={"solo_steps": 1})


@pytest.mark.slow
def test_a_planner_opens_the_doors_on_its_way(recording: Recording) -> None:
    assert recording.episode.info["ended"] == "success"
    opened = [span.target for span in recording.skills if span.name == "open" and span.outcome == "done"]
    assert opened
    assert {name.partition("/")[2] for name in opened} == {"leaf"}
    picked = next(e.step for e in recording.events if e.kind == "pick")
    assert all(e.step < picked for e in recording.events if e.kind == "open")  # later its hand is full


def test_nobody_passes_a_door_before_it_is_open(recording: Recording, home: Scene, free: FreeSpace) -> None:
    positions = recording.columns["scene.joint_pos"][::12].astype(np.float64)  # each needs a floor of its own
    places = recording.columns["agent_0.base_pose"][::12, [0, 2]].astype(np.float64)
    floors = {key: free.as_in(posed(home, positions[k])) for k, key in enumerate(map(bytes, positions))}
    for place, now in zip(places, map(bytes, positions), strict=True):
        assert floors[now].signed_distance(place) > 0.2  # a person's disc has a radius of 0.25 m


def test_validation_tells_of_who_goes_through_a_closed_door(recording: Recording) -> None:
    assert not [found for found in validate_recording(recording) if found.check == "penetration"]
    shut = np.repeat(recording.columns[JOINTS][:1], len(recording), axis=0)
    columns = {**recording.columns, JOINTS: shut}
    damaged = replace(recording, columns={**columns, "state_hash": state_hash(columns)})
    found = [found for found in validate_recording(damaged) if "a door" in found.text]
    assert found
    assert {(one.check, one.severity, one.subject) for one in found} == {("penetration", "error", "human")}
    opened = {span.target for span in recording.skills if span.name == "open" and span.outcome == "done"}
    assert {one.text.split()[4].rstrip(",") for one in found} <= opened


@pytest.mark.slow  # quick: the same of a drawer
def test_it_verifies_and_continues_while_a_door_moves(recording: Recording) -> None:
    assert verify(recording).difference is None
    moving = int(np.argmax((np.diff(recording.columns["scene.joint_pos"], axis=0) != 0).any(1))) + 10
    again = resume(recording, moving)
    np.testing.assert_array_equal(again.columns["scene.joint_pos"], recording.columns["scene.joint_pos"])


def test_the_robot_opens_doors_too(episode: RearrangeEpisode) -> None:
    recording = simulate(REARRANGE, episode.only(0), {"robot": "greedy_nearest"}, info={"solo_steps": 1})
    assert recording.episode.info["ended"] == "success"
    assert [span.target for span in recording.skills if span.name == "open" and span.outcome == "done"]


def test_recordings_from_before_know_nothing_of_it(recording: Recording, episode: RearrangeEpisode) -> None:
    assert recording.episode.info["spec"]["floor_moves"] is True
    rules = {name: value for name, value in recording.episode.info["spec"].items() if name != "floor_moves"}
    old = replace(recording, episode=replace(recording.episode, info={**recording.episode.info, "spec": rules}))
    restored = REARRANGE.codec.restore(old, lambda *_: (episode.scene, episode.free))
    assert restored.spec.floor_moves is False


def test_homes_that_do_not_open_have_no_trace_of_it() -> None:
    plain = build_home(HomeSpec(seed=0, generation=2))
    sampled = rearrange_episode(plain, seed=3, spec=RearrangeSpec(objects=1))
    assert sampled.spec.floor_moves is False
    assert "floor_moves" not in REARRANGE.codec.info(sampled, [])["spec"]


def test_things_that_both_cannot_get_at_are_not_drawn(home: Scene, free: FreeSpace, episode: RearrangeEpisode) -> None:
    """Whatever is drawn is reached with all doors open, whichever of them are closed."""
    ways = RoomDoors.of(home, free).open_floor
    for seed in range(examples(3)):
        _, targets = draw_episode(home, free, seed, RearrangeSpec(), episode.robot, episode.human)
        for target in targets:
            ends = np.array([target.start[[0, 2]], target.goal[[0, 2]]])
            assert np.isfinite(ways.geodesic(ends[0], ends[1], max_snap_m=2.0))


# --- a floor that changes -------------------------------------------------------------------------------------------------
def play_on(session: Session, command: object) -> None:
    session.act("human", command)
    session.step()
    while "human" not in session.waiting and not session.ended:
        session.step()


@pytest.mark.slow
def test_opening_a_door_gives_the_room_behind_it_and_closing_takes_it_back(
    home: Scene, episode: RearrangeEpisode
) -> None:
    session = Session(REARRANGE, episode.only(1), {"human": External()})
    play = session.play
    assert isinstance(play, WorldRollout)
    assert play.team.openables is not None
    assert play.team.floor is episode.free
    start = play.team.people[0].xz
    near = [
        k for k in play.team.doorways.joints if len(play.team.people[0].stands_on(play.team.floor, handle(play, k)))
    ]
    k = min(near, key=lambda k: float(np.hypot(*(handle(play, k)[[0, 2]] - start))))
    islands = [len(play.team.floor.polygon.geoms)]
    for command in (Open(k), Close(k)):
        play_on(session, Action("nav_to_handle", k))
        assert session.refusal("human", command) is None
        play_on(session, command)
        session.step()  # all parts stand
        islands.append(len(play.team.floor.polygon.geoms))
        assert play.team.people[0].free is play.team.floor
    assert islands[1] == islands[0] - 1
    assert islands[2] == islands[0]
    assert play.team.openables.positions[k] == joints_of(home).closed[k]
    assert verify(session.close()).difference is None


def handle(play: WorldRollout, k: int) -> np.ndarray:
    assert play.team.openables is not None
    return play.team.openables.handles(play.team.openables.positions)[k]
