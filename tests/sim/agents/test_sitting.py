"""People under control who sit down on the seats of a home."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.bodies import load_humanoid
from h3data.bodies.people.planted_gait import on_stairs
from h3data.geometry import ground_pose, quat_from_heading
from h3data.recording import write_mcap
from h3data.recording.records import STEP_NS, Agent, Episode, Recording
from h3data.scene import FreeSpace, Scene
from h3data.scene.seats import seats_of
from sim_kinematic.agents.driven.commands import PersonCommand, Sit
from sim_kinematic.agents.driven.person import DrivenPerson, show_seated
from sim_kinematic.agents.person import MotionResult, Person, Skill, joint_steps, run
from sim_kinematic.crowd.seating import SeatPlace, Seats, sit_for
from sim_kinematic.policies.policy import External
from sim_kinematic.tasks.resume import verify
from sim_kinematic.tasks.sessions import Session


@pytest.fixture(scope="module")
def home() -> Scene:
    return h3data.load_scene("medium:1")


@pytest.fixture(scope="module")
def bed(home: Scene) -> SeatPlace:
    free = FreeSpace.from_scene(home, radius_m=0.25)
    return Seats(home, free, load_humanoid("female_0")).place(next(s for s in seats_of(home) if s.name == "bed_0:0"))


def sit(person: Person, place: SeatPlace, seconds: float) -> Skill:
    """Sit down from the place in front of a seat, sit for some time, get up and step away."""
    floor = person.walk.tables
    # feet that keep out of furniture would be pushed away from the seat that they stand close to
    person.walk.tables = on_stairs(person.body.gait_tables, floor.heights)
    try:
        here = np.append(person.base[[0, 2]], person.heading)
        for at, share in sit_for(here, place, seconds):
            show_seated(person, place, at, share)
            yield
    finally:
        person.walk.tables = floor
    return MotionResult(success=True)


def test_seats_of_a_home(home: Scene) -> None:
    seats = seats_of(home)
    assert {"sofa", "armchair", "chair", "bed"} == {seat.category for seat in seats}
    assert all(0.4 < seat.height_m < 0.6 and seat.depth_m > 0.35 for seat in seats)
    assert len({seat.name for seat in seats}) == len(seats)


def test_sits_and_gets_up_without_a_pop(bed: SeatPlace, tmp_path: Path) -> None:
    body = load_humanoid("female_0")
    person = Person(body, ground_pose(bed.before[:2], bed.before[2] + 0.4))
    frames, result = run(person, sit(person, bed, 1.0))
    assert result.success
    low = min(frames, key=lambda frame: frame.root[1])
    assert abs(low.root[1] - bed.seat.height_m) < 0.2
    assert np.hypot(*(low.root[[0, 2]] - bed.seat.edge[[0, 2]])) < 0.35
    assert frames[-1].root[1] > 0.8
    turns = joint_steps(np.stack([np.vstack([frame.root[3:], frame.joints]) for frame in frames]))
    assert np.degrees(turns.max()) < 25
    columns = {
        "time_ns": np.arange(len(frames), dtype=np.int64) * STEP_NS,
        "agent_0.base_pose": np.stack([frame.base for frame in frames]).astype(np.float32),
        "agent_0.root_pose": np.stack([frame.root for frame in frames]).astype(np.float32),
        "agent_0.joint_quat": np.stack([frame.joints for frame in frames]).astype(np.float32),
    }
    recording = Recording(
        episode=Episode(uid="sit", episode_id="sit", task="motion", scene="", created_by="test", info={}),
        agents=(Agent(name="person", kind="human", model="humanoid/female_0"),),
        columns=columns,
    )
    write_mcap(recording, tmp_path / "sit.mcap")
    h3data.export(tmp_path / "sit.mcap", tmp_path / "sit.glb", to="gltf")
    assert (tmp_path / "sit.glb").stat().st_size > 100_000


# --- driven from outside ----------------------------------------------------------------------------------------------
def begun(**options: Any) -> tuple[Session, DrivenPerson]:
    agents = {"person": External(), "robot": "still"}
    session = h3data.session("rearrange", "medium:1", agents=agents, **options)
    person = session.play.team.people[0]
    assert isinstance(person, DrivenPerson)
    return session, person


def put_before(person: DrivenPerson, place: SeatPlace) -> None:
    """Puts the person 0.4 m ahead of the place before a seat."""
    x, z, heading = place.before.tolist()
    at = [x + 0.4 * np.cos(heading), z - 0.4 * np.sin(heading)]
    person.person.set_pose(person.person.quats, person.person.pelvis, ground_pose(np.array(at), heading + 1.0))


def test_a_driven_person_sits_until_a_key_moves_them(bed: SeatPlace) -> None:
    session, person = begun()
    put_before(person, bed)
    session.act("person", Sit())
    for _ in range(300):
        session.step()
    assert person.seat is not None
    assert person.seat.seat.category == "bed"
    assert person._seated[1] == 1
    hips = person.person.frame().root
    assert abs(hips[1] - person.seat.seat.height_m) < 0.2
    heights = []
    for _ in range(150):
        session.act("person", PersonCommand(forward=0.5))
        session.step()
        heights.append(person.person.frame().root[1])
    assert person.seat is None
    assert heights[-1] > 0.8
    assert np.abs(np.diff(heights)).max() < 0.03
    base = session.recorder.columns()["agent_1.base_pose"]
    assert np.hypot(*(base[-1] - base[-140])[[0, 2]]) > 0.3


def test_a_driven_person_who_is_stopped_on_the_way_down_gets_up() -> None:
    session, person = begun(seed=3)
    place = person.seats.nearest(person.xz, within_m=30.0)  # type: ignore[union-attr]
    assert place is not None
    person.person.set_pose(
        person.person.quats,
        person.person.pelvis,
        np.append(ground_pose(place.before[:2], place.before[2])[:3], quat_from_heading(place.before[2])),
    )
    session.act("person", Sit())
    while person._seated[1] < 0.5:
        session.step()
    joints = [person.person.frame().joints]
    session.act("person", PersonCommand(turn=0.2))
    for _ in range(120):
        session.step()
        joints.append(person.person.frame().joints)
    assert person.seat is None
    assert np.degrees(joint_steps(np.stack(joints)).max()) < 25


def test_nobody_sits_where_no_seat_is_near() -> None:
    session, person = begun(seed=1)
    person.seats = None
    assert "no free seat" in (session.refusal("person", Sit()) or "")
    result = session.act("person", Sit())
    assert result is None or "no free seat" in str(result)


@pytest.mark.slow
def test_a_recording_of_sitting_verifies() -> None:
    for seed in range(1, 12):
        session, person = begun(seed=seed)
        if session.refusal("person", Sit()) in (None, ""):
            break
    session.act("person", Sit())
    for _ in range(320):
        session.step()
    seated = person._seated[1]
    session.act("person", PersonCommand(forward=0.6))
    for _ in range(100):
        session.step()
    recording = session.close()
    assert seated == 1
    assert recording.agents[1].skill_names.index("sit") in recording.columns["agent_1.skill"]
    assert verify(recording).difference is None


def test_a_driven_person_lies_down_and_gets_up_again(bed: SeatPlace) -> None:
    session, person = begun()
    put_before(person, bed)
    session.act("person", Sit(lies=True))
    joints = [person.person.frame().joints]
    for _ in range(450):
        session.step()
        joints.append(person.person.frame().joints)
    assert person.seat is not None
    assert person._seated[1] == 2
    frame = person.person.frame()
    assert abs(frame.root[1] - person.seat.seat.height_m) < 0.2
    for _ in range(330):
        session.act("person", PersonCommand(forward=0.5))
        session.step()
        joints.append(person.person.frame().joints)
    assert person.seat is None
    assert person.person.frame().root[1] > 0.8
    assert np.degrees(joint_steps(np.stack(joints)).max()) < 25
