"""People of crowds who sit down: places before seats, the motion, recordings of it, and seats that are refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import h3data
from benchmarks.people import _block, hall
from h3data.bodies import JOINT_INDEX, humanoid_names, load_humanoid, load_robot
from h3data.bodies.people.sitting import sitting_on, take_seats
from h3data.errors import InputError
from h3data.geometry import ground_pose, wrap_angle
from h3data.recording import Recording
from h3data.replay import Replay
from h3data.scene import Box, FreeSpace, Instance, Scene
from h3data.scene.seats import seats_of
from h3data_crowds.routines import Routine, Stop
from h3data_exporters.gltf_animation import write_gltf_animation
from h3data_exporters.posing import posed_parts
from h3data_habitat.exporters.gfx_replay_export import write_gfx_replay
from h3data_pipelines.validation.penetration import penetrations
from h3data_pipelines.validation.recordings import validate_recording
from sim_kinematic.contact.clearance import RobotHumanContact
from sim_kinematic.crowd.seating import APART_M, Seats, sit_for, stand_before
from sim_kinematic.policies.crowd.people import CrowdPolicy
from sim_kinematic.tasks.resume import verify
from tests.export.test_exporters import Played, assert_same_points

SOFA, TUCKED, HIGH = "sofa", "tucked", "high"


def _box(low: tuple[float, ...], high: tuple[float, ...]) -> Box:
    corners = np.array([low, high])
    return Box(pose=np.append(corners.mean(0), [0, 0, 0, 1.0]), half_extents=np.ptp(corners, axis=0) / 2)


def living_room() -> Scene:
    """A hall of 6 x 5 m with a sofa of two places, a chair under a table, and a bench of 0.68 m."""
    room = hall(6.0, 5.0)
    seat = _box((-0.85, 0.0, -0.4), (0.85, 0.45, 0.4)), _box((-0.85, 0.0, -0.4), (0.85, 0.9, -0.2))
    things = {
        SOFA: ("sofa", seat),
        TUCKED: ("chair", (_box((-0.2, 0, -0.25), (0.2, 0.46, 0.25)),)),
        "table": ("dining_table", (_box((-0.6, 0.7, -0.4), (0.6, 0.75, 0.4)),)),
        HIGH: ("bench", (_box((-0.25, 0, -0.25), (0.25, 0.68, 0.25)),)),
    }
    assets = {
        name: replace(
            _block(name, shapes[0].pose[:3] - shapes[0].half_extents, shapes[0].pose[:3] + shapes[0].half_extents),
            category=category,
            shapes=shapes,
        )
        for name, (category, shapes) in things.items()
    }
    places = {SOFA: (3.0, 0.5), TUCKED: (1.2, 2.6), "table": (1.2, 3.1), HIGH: (5.0, 3.5)}
    placed = tuple(
        Instance(name=name, asset=name, pose=np.array([x, 0.0, z, 0, 0, 0, 1]), motion="static")
        for name, (x, z) in places.items()
    )
    return replace(room, assets={**room.assets, **assets}, instances=(*room.instances, *placed))


ROOM = living_room()
FREE = FreeSpace.from_scene(ROOM, cache=False)
ROUTINES: dict[int, list[Stop]] = {}


def follows(task: Any, episode: Any, number: int) -> CrowdPolicy:
    """A policy with a routine of `ROUTINES`."""
    routine = Routine(episode.scene, episode.free, ROUTINES[number], episode.roster[number].body)
    return CrowdPolicy("orca", episode.free, episode.seed, number, episode.spec.human, routine=routine)


def spend(stops: dict[int, list[Stop]], steps: int = 700) -> Recording:
    ROUTINES.clear()
    ROUTINES.update(stops)
    agents = {"human": f"{__name__}:follows"}
    return h3data.simulate(
        "wander", ROOM, roster=["human"] * len(stops), agents=agents, seed=3, max_steps=steps, spawn_distance_m=0.8
    )


@pytest.fixture(scope="module")
def reads() -> Recording:
    return spend({0: [Stop(SOFA, "read", 2.0)]}, 600)


def kinds_of(recording: Recording, agent: int = 0) -> list[str]:
    return [event.kind for event in recording.events if event.agent == agent]


@pytest.mark.parametrize("name", humanoid_names())
def test_take_seats_is_the_pose_and_leaves_who_stands(name: str):
    body = load_humanoid(name)
    height = 0.33 if name.startswith("child") else 0.45
    shares = np.array([0.0, 0.31, 0.8, 1.0])
    quats, pelvis = body.clip_pose(np.zeros(4, np.int64), np.zeros(4))
    standing = quats.copy()
    take_seats(body, quats, pelvis, np.column_stack([np.full(4, height), shares]))
    turns, places = sitting_on(body, height).pose(shares[1:])
    np.testing.assert_array_equal(quats[0], standing[0])
    assert np.abs(np.abs(np.sum(quats[1:] * turns, axis=-1)) - 1).max() < 1e-3
    np.testing.assert_allclose(pelvis[1:], places, atol=2e-3)


@pytest.mark.parametrize("seats", [np.zeros((2, 2)), np.array([[np.nan, 1.0]]), np.array([[0.45, 2.2]]), np.zeros(2)])
def test_what_is_no_seat_is_refused(seats: np.ndarray):
    body = load_humanoid("female_0")
    with pytest.raises(InputError, match="H3-BODY-179"):
        take_seats(body, *body.clip_pose([0], [0.0]), seats)


@given(st.integers(0, 3), st.floats(0, 6.28), st.floats(0.1, 5))
def test_the_motion_has_no_jump_and_ends_before_the_seat(which: int, heading: float, seconds: float):
    body = load_humanoid("female_0")
    place = Seats(ROOM, FREE, body).place([s for s in seats_of(ROOM) if s.name.startswith(SOFA)][which % 2])
    here = place.before + np.array([0.05, -0.1, heading])
    motion = list(sit_for(here, place, seconds))
    places, shares = np.array([here, *(at for at, _ in motion)]), np.array([0.0, *(share for _, share in motion)])
    assert np.hypot(*np.diff(places[:, :2], axis=0).T).max() < 0.025
    assert np.abs(wrap_angle(np.diff(places[:, 2]))).max() < 0.08
    assert np.abs(np.diff(shares)).max() < 0.04
    assert (places[shares > 0] == place.stand).all()
    np.testing.assert_allclose(places[-1, :2], place.before[:2], atol=1e-9)
    assert abs(wrap_angle(places[-1, 2] - place.before[2])) < 1e-9
    assert shares.max() == 1
    assert shares[-1] == 0


def test_refused_seats_say_why():
    seats = {seat.name: seat for seat in seats_of(ROOM)}
    room = Seats(ROOM, FREE, load_humanoid("female_0"))
    first = room.place(seats["sofa:0"])
    for name, taken, code in (
        ("sofa:0", [first.stand], "H3-SIM-064"),
        ("sofa:1", [first.stand + np.array([0.3, 0, 0])], "H3-SIM-064"),
        (TUCKED, [], "H3-SIM-065"),
        (HIGH, [], "H3-BODY-178"),
    ):
        with pytest.raises(InputError, match=code):
            room.place(seats[name], taken)
    with pytest.raises(InputError, match="H3-SIM-059"):
        stand_before(load_humanoid("male_1"), seats[TUCKED]._replace(depth_m=0.2))
    assert [seat.name for seat in room.at("table")] == [TUCKED]
    assert [seat.name for seat in room.at(SOFA)] == ["sofa:0", "sofa:1"]


def test_a_person_sits_down_and_gets_up(reads: Recording):
    assert verify(reads).difference is None
    kinds = kinds_of(reads)
    assert kinds[:4] == ["walks_to", "activity", "sits_down", "gets_up"]
    assert [f for f in validate_recording(reads) if f.severity == "error"] == []
    seat, share = reads.columns["agent_0.motion_seat"].T
    joints = Replay(reads).joint_matrices(0, np.arange(len(reads)))[..., :3, 3]
    hips, ankles = joints[:, JOINT_INDEX["pelvis"]], joints[:, JOINT_INDEX["left_ankle"]]
    sits = share == 1
    assert sits.sum() > 50
    assert (seat[sits] == np.float32(0.45)).all()
    assert (np.abs(hips[sits, 1] - 0.55) < 0.06).all()
    assert np.hypot(*np.diff(ankles[share > 0][:, [0, 2]], axis=0).T).max() < 2e-3
    assert np.linalg.norm(np.diff(joints[:, :22], axis=0), axis=-1)[share[1:] > 0].max() < 0.07
    (found,) = penetrations(reads, every=5)
    assert found.depth_m[share[::5] > 0].max() < 0.02


def test_a_seated_person_is_touched_where_they_are():
    robot, body = load_robot("quad_arm"), load_humanoid("female_0")
    contact = RobotHumanContact(robot, body)
    person, bench = ground_pose(np.zeros(2), 0.0), ground_pose(np.array([-0.95, 0.0]), 0.0)
    stands = np.zeros(1, int), np.zeros(1), np.zeros(1)
    assert contact.touching(bench[None], person[None], *stands, seats=np.array([[0.45, 1.0]]))[0]
    assert not contact.touching(bench[None], person[None], *stands)[0]


def test_a_seat_that_somebody_has_is_refused_and_the_rest_goes_on():
    stops = {k: [Stop("sofa", "read", 6.0), Stop("table", "eat", 2.0), Stop(HIGH, "sit", 1.0)] for k in range(3)}
    recording = spend(stops, 1500)
    assert not recording.columns["metrics.collision"].any()
    codes = {event.detail.partition(":")[0] for event in recording.events if event.kind == "refused"}
    assert codes == {"H3-SIM-064", "H3-SIM-065", "H3-BODY-178"}
    assert sum("sits_down" in kinds_of(recording, k) for k in range(3)) >= 2
    assert all(kinds_of(recording, k).count("activity") >= 2 for k in range(3))
    together = np.stack([recording.columns[f"agent_{k}.motion_seat"][:, 1] for k in range(3)]) > 0
    xz = np.stack([recording.columns[f"agent_{k}.base_pose"][:, [0, 2]] for k in range(3)])
    for a, b in ((0, 1), (0, 2), (1, 2)):
        both = together[a] & together[b]
        assert not both.any() or np.hypot(*(xz[a] - xz[b])[both].T).min() >= APART_M - 1e-6


def test_gltf_shows_who_sits(reads: Recording, tmp_path: Path):
    replay = Replay(reads, detail=False)
    played = Played(write_gltf_animation(reads, posed_parts(replay), tmp_path / "a.glb").path)
    (person,) = [k for k, drawable in enumerate(replay.drawables) if drawable.deformable]
    sits = int(np.flatnonzero(reads.columns["agent_0.motion_seat"][:, 1] == 1)[0])
    for step in (sits - 30, sits):
        expected = replay.vertices(person, np.array([step]))[0]
        assert_same_points(played.skinned(step), expected, atol=1e-5)
    assert expected[:, 1].max() < 1.4


def test_gfx_replays_show_who_sits(reads: Recording, tmp_path: Path):
    replay = Replay(reads, detail=False)
    path = write_gfx_replay(reads, posed_parts(replay), tmp_path / "a.gfx_replay.json").path
    sits, bones, names = int(np.flatnonzero(reads.columns["agent_0.motion_seat"][:, 1] == 1)[0]), None, None
    for keyframe in json.loads(path.read_text())["keyframes"][: sits + 1]:
        names = keyframe["rigCreations"][0]["boneNames"] if "rigCreations" in keyframe else names
        bones = keyframe["rigUpdates"][0]["pose"] if "rigUpdates" in keyframe else bones
    assert bones is not None
    assert names is not None
    head = bones[names.index("head")]["t"]
    expected = replay.joint_matrices(0, np.array([sits]))[0, JOINT_INDEX["head"], :3, 3]
    np.testing.assert_allclose(head, expected, atol=1e-4)
    assert expected[1] < 1.3
