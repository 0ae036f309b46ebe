"""People who sit down on the seats of a home."""

from pathlib import Path

import numpy as np
import pytest

import h3data
from h3data.bodies import load_humanoid
from h3data.errors import InputError
from h3data.geometry import ground_pose
from h3data.recording import write_mcap
from h3data.recording.records import STEP_NS, Agent, Episode, Recording
from h3data.scene import FreeSpace, Scene
from h3data.scene.seats import Seat, seats_of
from sim_kinematic.agents.person import Person, joint_steps, run
from sim_kinematic.agents.sitting import get_up, sit, sit_down
from sim_kinematic.crowd.seating import stand_before

SEAT = Seat(name="chair", category="chair", edge=np.array([0.0, 0.46, 0.0]), heading=0.3, depth_m=0.5, height_m=0.46)


@pytest.fixture(scope="module")
def home() -> Scene:
    return h3data.load_scene("medium:1")


def before(seat: Seat, name: str = "female_0") -> Person:
    person = Person(load_humanoid(name), ground_pose(np.zeros(2), 0.0))
    x, z, heading = stand_before(person.body, seat)
    return Person(person.body, ground_pose(np.array([x, z]), heading))


def test_seats_of_a_home(home: Scene) -> None:
    seats = seats_of(home)
    assert {"sofa", "armchair", "chair", "bed"} == {seat.category for seat in seats}
    assert all(0.4 < seat.height_m < 0.6 and seat.depth_m > 0.35 for seat in seats)
    assert len({seat.name for seat in seats}) == len(seats)


def test_walks_sits_and_gets_up(home: Scene) -> None:
    free = FreeSpace.from_scene(home, radius_m=0.25)
    start = free.sample(np.random.default_rng(1), 1)[0]
    reached = 0
    for seat in [s for s in seats_of(home) if s.name in ("chair_0", "bed_0:0", "armchair_1", "sofa_0:0")]:
        person = Person(load_humanoid("female_0"), free.root_pose(start, 0.0), free=free)
        frames, result = run(person, sit(person, seat, 1.0))
        reached += result.success
        low = min(frames, key=lambda frame: frame.root[1])
        assert abs(low.root[1] - seat.height_m) < 0.2
        assert np.hypot(*(low.root[[0, 2]] - seat.edge[[0, 2]])) < 0.35
        assert frames[-1].root[1] > 0.8
    assert reached == 4


@pytest.mark.parametrize("name", ["male_1", "older_0"])
def test_has_no_pop(name: str) -> None:
    person = before(SEAT, name)
    for part in (sit_down, get_up):
        frames, result = run(person, part(person, SEAT))
        assert result.success
        turns = joint_steps(np.stack([np.vstack([frame.root[3:], frame.joints]) for frame in frames]))
        assert np.degrees(turns.max()) < 20
    joints = person.body.joint_matrices_free(person.frame().root[None], person.frame().joints[None])
    np.testing.assert_allclose(joints[0], person.joint_matrices, atol=1e-6)


def test_sits_only_before_the_seat() -> None:
    person = Person(load_humanoid("female_0"), ground_pose(np.array([2.0, 0.0]), 0.0))
    _, result = run(person, sit_down(person, SEAT))
    assert not result.success
    assert result.reason == "not_before_seat"


def test_shallow_seat() -> None:
    with pytest.raises(InputError) as caught:
        before(SEAT._replace(depth_m=0.1))
    assert caught.value.code == "H3-SIM-059"


def test_frames_are_recorded(tmp_path: Path) -> None:
    person = before(SEAT)
    frames, _ = run(person, sit_down(person, SEAT))
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
    posed = h3data.load_recording(tmp_path / "sit.mcap")
    joints = person.body.joint_matrices_free(*(posed.columns[f"agent_0.{n}"] for n in ("root_pose", "joint_quat")))
    np.testing.assert_allclose(joints[-1], person.joint_matrices, atol=1e-4)
    h3data.export(tmp_path / "sit.mcap", tmp_path / "sit.glb", to="gltf")
    assert (tmp_path / "sit.glb").stat().st_size > 100_000
