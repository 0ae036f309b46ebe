"""People of crowds who lie down: places on beds and sofas, the motion, contact, and recordings of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.people import hall
from h3data.bodies import JOINT_INDEX, load_humanoid, load_robot
from h3data.errors import InputError
from h3data.geometry import ground_pose, wrap_angle
from h3data.recording import Recording
from h3data.replay import Replay
from h3data.scene import FreeSpace, Instance, Scene
from h3data.scene.seats import seats_of
from h3data_crowds.routines import Stop
from h3data_exporters.gltf_animation import write_gltf_animation
from h3data_exporters.posing import posed_parts
from h3data_pipelines.validation.penetration import penetrations
from h3data_pipelines.validation.recordings import validate_recording
from sim_kinematic.contact.clearance import RobotHumanContact
from sim_kinematic.crowd.seating import LIES_APART_M, Seats, sit_for
from sim_kinematic.tasks.resume import verify
from tests.export.test_exporters import Played, assert_same_points
from tests.sim.crowd import test_seating
from tests.sim.crowd.test_seating import _block, _box, kinds_of

BED, SOFA, SHORT = "bed", "sofa", "short"


def bedroom() -> Scene:
    """A hall of 7 x 6 m with a bed, its head at a wall, a sofa with armrests, and a bed that is too short."""
    room = hall(7.0, 6.0)
    bed = _box((-0.5, 0.0, -1.0), (0.5, 0.5, 1.05)), _box((-0.5, 0.0, -1.06), (0.5, 1.0, -1.0))
    sofa = (
        _box((-1.0, 0.0, -0.26), (1.0, 0.45, 0.5)),
        _box((-1.0, 0.0, -0.46), (1.0, 0.8, -0.26)),
        _box((-1.17, 0.0, -0.46), (-1.0, 0.6, 0.5)),
        _box((1.0, 0.0, -0.46), (1.17, 0.6, 0.5)),
    )
    short = (_box((-0.45, 0.0, -0.6), (0.45, 0.5, 0.6)),)
    things = {BED: ("bed", bed, 1.07), SOFA: ("sofa", sofa, 0.5), SHORT: ("bed", short, 5.2)}
    assets = {
        name: replace(
            _block(name, shapes[0].pose[:3] - shapes[0].half_extents, shapes[0].pose[:3] + shapes[0].half_extents),
            category=category,
            shapes=shapes,
        )
        for name, (category, shapes, _) in things.items()
    }
    placed = tuple(
        Instance(name=name, asset=name, pose=np.array([x, 0.0, things[name][2], 0, 0, 0, 1]), motion="static")
        for name, x in ((BED, 2.0), (SOFA, 5.2), (SHORT, 4.0))
    )
    return replace(room, assets={**room.assets, **assets}, instances=(*room.instances, *placed))


ROOM = bedroom()
FREE = FreeSpace.from_scene(ROOM, cache=False)


@pytest.fixture(scope="module")
def rests() -> Recording:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(test_seating, "ROOM", ROOM)
        return test_seating.spend({0: [Stop(BED, "rest", 2.0)]}, 900)


def test_a_person_lies_down_and_gets_up(rests: Recording):
    assert verify(rests).difference is None
    assert kinds_of(rests)[:4] == ["walks_to", "activity", "sits_down", "gets_up"]
    assert [f for f in validate_recording(rests) if f.severity == "error"] == []
    height, share = rests.columns["agent_0.motion_seat"].T
    replay = Replay(rests)
    joints = replay.joint_matrices(0, np.arange(len(rests)))[..., :3, 3]
    lies = share == 2
    assert lies.sum() > 50
    hips, head, feet = (joints[lies][:, JOINT_INDEX[name]] for name in ("pelvis", "head", "left_ankle"))
    # the head is at the end of the bed at the wall, and the body within its edges
    assert (head[:, 2] < hips[:, 2] - 0.4).all()
    assert (feet[:, 2] > hips[:, 2] + 0.6).all()
    (body,) = [k for k, drawable in enumerate(replay.drawables) if drawable.deformable]
    skin = replay.vertices(body, np.flatnonzero(lies)[:1])[0]
    assert 1.5 <= skin[:, 0].min() < skin[:, 0].max() <= 2.5
    assert 0.06 < skin[:, 2].min() < skin[:, 2].max() <= 2.13
    assert abs(skin[:, 1].min() - height[lies][0]) < 0.02
    moves = share[1:] > 0
    assert np.linalg.norm(np.diff(joints[:, :22], axis=0), axis=-1)[moves].max() < 0.09
    (found,) = penetrations(rests, every=5)
    assert found.unintended_m[share[::5] > 0].max() < 0.02


@pytest.mark.parametrize("name", [BED, SOFA])
def test_the_motion_has_no_jump_and_ends_before_the_seat(name: str):
    seats = Seats(ROOM, FREE, load_humanoid("female_0"))
    place = seats.to_lie(seats.place(seats.at(name)[0]))
    motion = list(sit_for(place.before, place, 1.0))
    places, shares = (
        np.array([place.before, *(at for at, _ in motion)]),
        np.array([0.0, *(share for _, share in motion)]),
    )
    assert np.hypot(*np.diff(places[:, :2], axis=0).T).max() < 0.06
    assert np.abs(wrap_angle(np.diff(places[:, 2]))).max() < 0.08
    assert np.abs(np.diff(shares)).max() < 0.04
    assert shares.max() == 2
    np.testing.assert_allclose(places[-1, :2], place.before[:2], atol=1e-9)


def test_who_cannot_lie_is_told_why_and_sits():
    seats = Seats(ROOM, FREE, load_humanoid("female_0"))
    place = seats.place(seats.at(SHORT)[0])
    with pytest.raises(InputError, match="H3-SIM-069"):
        seats.to_lie(place)
    lies = seats.to_lie(seats.place(seats.at(BED)[0]))
    assert lies.taken[3] == LIES_APART_M
    for seat in seats.at(BED):
        with pytest.raises(InputError, match="H3-SIM-064"):
            seats.place(seat, [lies.taken])
    with pytest.raises(InputError, match="H3-SIM-069"):
        seats.to_lie(lies, [seats.place(seats.at(BED)[-1]).taken])
    assert all(seat.ends == (0.0, 0.0) or abs(seat.ends[0] - seat.ends[1]) > 1 for seat in seats_of(ROOM))


def test_head_and_feet_of_somebody_who_lies_are_touched():
    robot, body = load_robot("quad_arm"), load_humanoid("female_0")
    contact = RobotHumanContact(robot, body)
    person, stands = ground_pose(np.zeros(2), 0.0), (np.zeros(1, int), np.zeros(1), np.zeros(1))
    for x in (-1.4, 0.9):  # at the head, at the feet
        base = ground_pose(np.array([x, 0.0]), 0.0)
        assert contact.touching(base[None], person[None], *stands, seats=np.array([[0.4, 2.0]]))[0]
        assert not contact.touching(base[None], person[None], *stands)[0]


def test_gltf_shows_who_lies(rests: Recording, tmp_path: Path):
    replay = Replay(rests, detail=False)
    played = Played(write_gltf_animation(rests, posed_parts(replay), tmp_path / "a.glb").path)
    (person,) = [k for k, drawable in enumerate(replay.drawables) if drawable.deformable]
    lies = int(np.flatnonzero(rests.columns["agent_0.motion_seat"][:, 1] == 2)[0])
    expected = replay.vertices(person, np.array([lies]))[0]
    assert_same_points(played.skinned(lies), expected, atol=1e-5)
    assert expected[:, 1].max() < 0.95
