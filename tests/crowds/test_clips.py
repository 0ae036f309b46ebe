"""Users' motion files as activities: on all bodies, in recordings and exports, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import h3data
from examples.dance import write_bvh
from h3data.bodies import load_humanoid, names
from h3data.bodies.people.humanoid_file import humanoid_names
from h3data.bodies.people.soles import sole_points
from h3data.errors import FormatError, InputError
from h3data.geometry import quat_conjugate, quat_multiply
from h3data.recording import Recording, read_mcap, write_mcap
from h3data.replay.posed_recording import PosedRecording
from h3data_crowds.routines import Routine, Stop, place_beside
from h3data_motion.acts import act_file
from h3data_motion.clip import Motion, in_start_frame
from h3data_motion.contacts import leg_frames
from h3data_motion.files import read_motion, save_motion
from h3data_pipelines.cli import main
from sim_kinematic.tasks.resume import verify
from tests.crowds.test_routines import FREE, SCENE
from tests.motion.motion_writers import turned

ACT_S = 4.0


@pytest.fixture(scope="module")
def dance(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("clips") / "dance.bvh"
    write_bvh(path)
    return path


def danced(dance: Path, stops: str = "sofa_0:dance:8.2", steps: int = 540) -> Recording:
    return h3data.simulate(
        "wander", "small:0", roster=[f"female_1+dance={dance}"], agents={"human": f"orca+{stops}"}, max_steps=steps
    )


@pytest.fixture(scope="module")
def recording(dance: Path) -> Recording:
    return danced(dance)


def forget() -> None:
    """As in another process."""
    names._files.clear()
    act_file.cache_clear()
    names.load_humanoid.cache_clear()


def performed(body, times: int = 2):
    act = body.acts["dance"]
    since = np.arange(-10, round(times * act.seconds * 30) + 11) / 30
    quats, pelvis = body.clip_pose(np.zeros(len(since), np.int64), np.zeros(len(since)))
    still = quats.copy()
    act.perform(quats, pelvis, since, times)
    return since, still, quats, pelvis


@pytest.mark.parametrize("name", ["child_0", "female_1", "male_3"])
def test_feet_stay_on_the_floor_and_no_joint_pops(name: str, dance: Path):
    check_body(name, dance)


@pytest.mark.slow
def test_feet_stay_on_the_floor_on_all_bodies(dance: Path):
    assert len(humanoid_names()) == 18
    for name in humanoid_names():
        check_body(name, dance)


def check_body(name: str, dance: Path) -> None:
    body = load_humanoid(f"{name}+dance={dance}")
    since, still, quats, pelvis = performed(body)
    lowest = sole_points(body, leg_frames(body, quats, pelvis))[..., 1].min((1, 2))
    assert np.abs(lowest).max() < 0.01
    between = quat_multiply(quat_conjugate(quats[:-1]), quats[1:])
    turned = 2 * np.arctan2(np.linalg.norm(between[..., :3], axis=-1), np.abs(between[..., 3]))
    assert np.degrees(turned.max()) < 15.0
    ends = body.acts["dance"].seconds * np.arange(3)
    at_ends = np.abs(since[:, None] - ends).min(1) < 0.01
    outside = (since < 0) | (since > ends[-1]) | at_ends
    assert np.abs(quats[outside] - still[outside]).max() < 1e-3, "they stand before, between and after"
    middle = np.argmin(np.abs(since - 2.0))
    assert np.array_equal(quats[middle], body.acts["dance"].motion.pose(2.0)[0][0]), "and are as captured in between"


def test_outline_covers_the_body(dance: Path):
    body = load_humanoid(f"male_1+dance={dance}")
    joints = body.joint_matrices(np.array([[0.0, 0, 0, 0, 0, 0, 1]]), *body.acts["dance"].motion.pose([0.3, 1.1, 2.6]))
    start, end, radius = body.capsules_world(joints)
    points = np.concatenate([start, end])[..., [0, 2]].reshape(-1, 2)
    circles = body.acts["dance"].outline
    gap = np.linalg.norm(points[:, None] - circles[:, :2], axis=2) - circles[:, 2]
    assert (gap.min(1) + np.tile(radius, 6) < 0.06).all()


def test_a_recording_holds_the_clip_and_verifies(recording: Recording, dance: Path, tmp_path: Path):
    begun = [event for event in recording.events if event.kind == "performs"]
    assert begun[0].detail == "2"
    assert begun[0].target.endswith("_dance")
    (name,) = [name for name in recording.attachments if name.startswith("motion_")]
    assert recording.agents[0].model.endswith(f"+dance=motion:{name.removeprefix('motion_').removesuffix('.npz')}")
    assert set(recording.episode.info["motions"]) == {name}
    posed = PosedRecording(recording).joint_matrices(0, np.arange(len(recording)))
    write_mcap(recording, tmp_path / "dance.mcap")
    forget()
    again = read_mcap(tmp_path / "dance.mcap")
    assert verify(again).difference is None
    assert np.array_equal(PosedRecording(again).joint_matrices(0, np.arange(len(again))), posed)
    # they move while they dance, and only then
    step = begun[0].step
    moved = np.abs(np.diff(posed[:, :, :3, 3], axis=0)).max((1, 2))
    assert moved[step + 20 : step + 60].max() > 0.02
    assert moved[step - 10 : step].max() < 0.005
    frames = np.linalg.inv(posed[:-1, :, :3, :3]) @ posed[1:, :, :3, :3]
    turned_deg = np.degrees(np.arccos(np.clip((np.trace(frames, axis1=2, axis2=3) - 1) / 2, -1, 1)))
    assert turned_deg[step - 5 : step + 250, :22].max() < 25, "no joint pops, also seen from the world"
    # contact finds the hands where replays show them
    assert recording.columns["agent_0.motion_hands"][step + 40, :2, 3].min() == 1.0
    assert not recording.columns["agent_0.motion_hands"][: step + 1, :2, 3].any()


def test_exports_show_the_clip(recording: Recording, tmp_path: Path):
    begun = next(event.step for event in recording.events if event.kind == "performs")
    write_mcap(recording, tmp_path / "dance.mcap")
    target = tmp_path / "dance.gfx_replay.json"
    assert main(["export", str(tmp_path / "dance.mcap"), "--to", "gfx-replay", "-o", str(target)]) == 0
    frames = json.loads(target.read_text())["keyframes"]
    bones = [
        np.array([bone["t"] for bone in frame["rigUpdates"][0]["pose"]])
        for frame in (frames[begun], frames[begun + 30])
    ]
    posed = PosedRecording(recording).joint_matrices(0, np.array([begun, begun + 30]))
    for places, joints in zip(bones, posed[:, :, :3, 3], strict=True):
        assert np.linalg.norm(places[:, None] - joints, axis=2).min(0)[:22].max() < 0.02
    assert np.abs(bones[1] - bones[0]).max() > 0.2


def test_without_its_clip_a_person_stands(recording: Recording):
    (name,) = [name for name in recording.attachments if name.startswith("motion_")]
    lost = replace(recording, attachments={"scene.glb": recording.attachments["scene.glb"]})
    forget()
    replay = PosedRecording(lost)
    assert replay.missing == {name: 1}
    step = next(event.step for event in lost.events if event.kind == "performs") + 60
    assert np.abs(np.diff(replay.joint_matrices(0, np.arange(step, step + 3))[:, 15, 1, 3])).max() < 0.002
    names.keep_walks(recording.attachments)


def test_other_recordings_have_no_column_more(dance: Path):
    plain = h3data.simulate("wander", "small:0", roster=["female_1"], agents={"human": "orca"}, max_steps=30)
    named = danced(dance, steps=30)
    assert set(named.columns) - set(plain.columns) == {"agent_0.motion_hands", "agent_0.motion_seat"}


def test_nobody_dances_through_furniture(dance: Path):
    act = load_humanoid(f"female_1+dance={dance}").acts["dance"]
    near = FREE.sample(np.random.default_rng(1), 1)[0]
    found = place_beside(SCENE, FREE, "sofa_0", near, act.outline)
    assert found is not None
    ahead = (found[1] - found[0]) / np.linalg.norm(found[1] - found[0])
    points = found[0] + act.outline[:, :1] * ahead + act.outline[:, 1:2] * [-ahead[1], ahead[0]]
    assert (FREE.signed_distance(points) >= act.outline[:, 2] - 0.021).all()
    wide = act.outline + np.array([0, 0, 3.0])
    assert place_beside(SCENE, FREE, "sofa_0", near, wide) is None


def saved(path: Path, motion: Motion) -> str:
    save_motion(in_start_frame(motion), path)
    return str(path)


def test_files_that_are_no_activity_are_refused(dance: Path, tmp_path: Path):
    motion = read_motion(dance)
    with pytest.raises(InputError, match="H3-BODY-183"):
        act_file(str(tmp_path / "nowhere.bvh"))
    with pytest.raises(InputError, match="H3-BODY-184"):
        act_file(saved(tmp_path / "slow.npz", motion.resampled(10)))
    with pytest.raises(InputError, match="H3-BODY-185"):
        act_file(saved(tmp_path / "short.npz", motion.part(0, 0.5)))
    away = np.linspace(0, 2, len(motion))[:, None] * [1, 0, 0]
    with pytest.raises(InputError, match="H3-BODY-186"):
        act_file(saved(tmp_path / "away.npz", replace(motion, pelvis=motion.pelvis + away)))
    with pytest.raises(InputError, match="H3-BODY-188"):
        act_file(saved(tmp_path / "turn.npz", turned(load_humanoid("male_1"))))
    quats = motion.quats.copy()
    quats[60:80, 0] = quat_multiply(np.array([0, 1.0, 0, 0]), quats[60:80, 0])
    with pytest.raises(InputError, match="H3-BODY-187"):
        act_file(saved(tmp_path / "cut.npz", replace(motion, quats=quats)))
    text = dance.read_text()
    (tmp_path / "dog.bvh").write_text(text.replace("LeftLeg", "Tail").replace("RightLeg", "Fin"))
    with pytest.raises(FormatError):
        act_file(str(tmp_path / "dog.bvh"))
    head, _, frames = text.partition("Frame Time")
    (tmp_path / "none.bvh").write_text(head.replace("Frames: 121", "Frames: 0") + "Frame Time: 0.033333\n")
    with pytest.raises(FormatError):
        act_file(str(tmp_path / "none.bvh"))
    (tmp_path / "nan.bvh").write_text(head + "Frame Time" + frames.replace("0.0000", "nan", 1))
    with pytest.raises(FormatError):
        act_file(str(tmp_path / "nan.bvh"))


def test_stops_that_do_not_fit_are_refused(dance: Path):
    body = load_humanoid(f"female_1+dance={dance}")
    with pytest.raises(InputError, match="H3-TASK-096"):
        Routine(SCENE, FREE, [Stop("sofa_0", "dance", 3.0)], body)
    with pytest.raises(InputError, match="H3-TASK-094"):
        Routine(SCENE, FREE, [Stop("sofa_0", "cook", 9.0)], load_humanoid(f"female_1+cook={dance}"))
    with pytest.raises(InputError, match="H3-TASK-097"):
        danced(dance, "sofa_0:juggle:9", steps=2)
    with pytest.raises(InputError, match="H3-TASK-098"):
        danced(dance, "sofa_0:dance:long", steps=2)
    with pytest.raises(InputError, match="H3-SIM-063"):
        danced(dance, "nowhere:dance:9", steps=2)


def test_where_there_is_no_floor_the_person_only_stands(dance: Path):
    body = load_humanoid(f"female_1+dance={dance}")
    body.acts["dance"].outline[:, 2] += 3.0
    try:
        routine = Routine(SCENE, FREE, [Stop("sofa_0", "dance", 9.0)], body)
        found, (place, why) = routine.errand_at(0, FREE.sample(np.random.default_rng(1), 1)[0], ())
        assert found is not None
        assert found[1].station is None
        assert (place, why.partition(":")[0]) == ("sofa_0", "H3-TASK-095")
    finally:
        body.acts["dance"].outline[:, 2] -= 3.0
