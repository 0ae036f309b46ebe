"""Habitat's humanoid controller and motion files, against what the real habitat-lab did with the same file."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from h3data.bodies.people.skeleton import JOINT_NAMES
from h3data.errors import FormatError, InputError
from h3data_habitat.motion.habitat_humanoid import HABITAT_JOINTS, HabitatHumanoid, reach_coordinates, sequence_pose
from h3data_habitat.motion.habitat_motion import read_habitat_motion, read_habitat_sequence
from h3data_habitat.motion.habitat_pick import HabitatPick

STOP, WALK, TURN, DIRECTIONAL, GAIT, HALF_WALK = range(6)


@pytest.fixture(scope="module")
def golden(real) -> Path:
    folder = real / "habitat-lab/reference/humanoid"
    if not folder.is_dir():
        pytest.skip("no humanoid reference below ../shared/real")
    return folder


@pytest.fixture(scope="module")
def motion(golden):
    return read_habitat_motion(golden / "synthetic_motion_data_smplx.pkl")


@pytest.mark.parametrize("run", [0, *(pytest.param(run, marks=pytest.mark.slow) for run in range(1, 5))])
def test_walks_turns_and_stops_as_habitat_does(golden, motion, run):
    """Teacher forced; the steps after two HITL commands are left out, which keep a heading that no file shows."""
    truth = np.load(golden / f"commands_{run}.npz")
    given = not np.isnan(truth["lin_speed"])
    person = HabitatHumanoid(
        motion,
        lin_speed=float(truth["lin_speed"]) if given else None,
        ang_speed=float(truth["ang_speed"]) if given else None,
        control_hz=float(truth["ctrl_freq"]),
    )
    commands, compared = truth["command"], 0
    for t, command in enumerate(commands):
        if command not in (STOP, WALK, TURN, HALF_WALK) or (t and commands[t - 1] in (3, 4)):
            continue
        bases = truth["agent_base_T"] if truth["reset_every_step"] else truth["base_T"]
        person.reset(bases[t - 1] if t else truth["start_base_T"])
        if t:
            person.frame, person.offset = int(truth["mocap_frame"][t - 1]), truth["offset_T"][t - 1].astype(float)
        if command == STOP:
            person.stop()
        elif command == TURN:
            person.turn(truth["rel"][t])
        else:
            person.walk(truth["rel"][t], 1.0 if command == WALK else 0.5)
        assert person.frame == truth["mocap_frame"][t]
        np.testing.assert_allclose(person.base, truth["base_T"][t], atol=1e-6)
        np.testing.assert_allclose(person.offset, truth["offset_T"][t], atol=1e-6)
        np.testing.assert_allclose(person.joints, truth["joints_xyzw"][t], atol=1e-6)
        np.testing.assert_allclose(person.root, truth["sim_obj_T"][t], atol=1e-6)
        compared += 1
    assert compared > 180


@pytest.mark.parametrize("run", [0, *(pytest.param(run, marks=pytest.mark.slow) for run in range(1, 5))])
def test_whole_sessions_of_all_commands_as_habitat_plays_them(golden, motion, run):
    """From the commands alone, the two of habitat-hitl (a look of its own, gait by deltas) included; nothing is reset."""
    truth = np.load(golden / f"commands_{run}.npz")
    given = not np.isnan(truth["lin_speed"])
    person = HabitatHumanoid(
        motion,
        lin_speed=float(truth["lin_speed"]) if given else None,
        ang_speed=float(truth["ang_speed"]) if given else None,
        control_hz=float(truth["ctrl_freq"]),
    )
    person.reset(truth["start_base_T"])
    seen = set()
    for t, command in enumerate(truth["command"].tolist()):
        if t and truth["reset_every_step"]:
            person.reset(truth["agent_base_T"][t - 1])
        rel, look = truth["rel"][t], truth["target_dir"][t]
        if command == STOP:
            person.stop()
        elif command == TURN:
            person.turn(rel)
        elif command == DIRECTIONAL:
            person.walk_directional(rel, look=None if np.isnan(look).any() else look)
        elif command == GAIT:
            person.with_gait(float(truth["forward_delta"][t]), float(truth["rot_delta"][t]))
        else:
            person.walk(rel, 1.0 if command == WALK else 0.5)
        seen.add(command)
        assert person.frame == truth["mocap_frame"][t], t
        np.testing.assert_allclose(person.base, truth["base_T"][t], atol=5e-5, err_msg=f"step {t}")
        np.testing.assert_allclose(person.joints, truth["joints_xyzw"][t], atol=1e-6)
        if command != STOP:
            np.testing.assert_allclose(person.offset, truth["offset_T"][t], atol=1e-6)
            np.testing.assert_allclose(person.root, truth["sim_obj_T"][t], atol=5e-5)
    assert run == 1 or seen >= {STOP, WALK, TURN, DIRECTIONAL, GAIT}  # run 1 has none of habitat-hitl's


def test_reaches_as_habitat_does(golden, motion):
    truth = np.load(golden / "reach.npz")
    person = HabitatHumanoid(motion)
    for t, hand in enumerate(truth["hand"]):
        person.reset(truth["base_T"][t])
        person.reach(truth["obj_pos"][t], "right" if hand else "left")
        place = reach_coordinates(truth["base_T"][t], truth["obj_pos"][t])
        np.testing.assert_allclose(place, truth["local_left_up_forward"][t], atol=1e-5)
        np.testing.assert_allclose(person.joints, truth["joints_xyzw"][t], atol=1e-6)
        np.testing.assert_allclose(person.offset, truth["offset_T"][t], atol=1e-5)


@pytest.mark.parametrize("run", range(6))
def test_picks_and_places_as_habitat_does(golden, motion, run):
    """120 steps each of the real HumanoidPickAction, also those that never take hold."""
    truth = np.load(golden / f"pick_place_{run}.npz")
    person = HabitatHumanoid(motion)
    person.reset(truth["start_base_T"])
    action = HabitatPick(person, step_m=float(truth["dist_move_per_step"]), snap_m=float(truth["dist_to_snap"]))
    holding, place = False, truth["object_pos"]
    for t, (entity, pick) in enumerate(truth["arg"]):
        if entity <= 0:
            break  # nothing is asked for any more
        target = place if pick else truth["goal_pos"]
        event = action.step(target, pick=bool(pick), holding=holding)
        holding = {"take": True, "put": False, None: holding}[event]
        assert holding == (truth["snap_idx"][t] >= 0), t
        assert action.retracting == bool(truth["hand_state"][t]), t
        assert action.steps == truth["hand_iter"][t], t
        assert action.done == truth["skill_done"][t], t
        np.testing.assert_allclose(person.joints, truth["joints_xyzw"][t], atol=1e-5)
        np.testing.assert_allclose(person.offset, truth["offset_T"][t], atol=1e-5)
        place = truth["object_T"][t][:3, 3]
    assert t > 50


def test_reaching_below_the_grid_never_gives_nan(motion):
    person = HabitatHumanoid(motion)
    for forward in np.linspace(-0.2, 0.3, 26):
        person.reach(person.base[:3, 3] + forward * person.base[:3, 0])
        assert np.isfinite(person.joints).all()
        assert np.isfinite(person.root).all()


def test_sequences_play_as_habitat_does(golden):
    truth = np.load(golden / "seq_pose.npz")
    clip = read_habitat_sequence(golden / "synthetic_sequence.pkl")
    before_the_base_moves = 120
    for t in range(before_the_base_moves):
        frame = int(np.argmin(np.abs(clip.joints - truth["joints_xyzw"][t]).max((1, 2))))
        joints, offset = sequence_pose(clip, frame, truth["start_base_T"])
        np.testing.assert_allclose(joints, truth["joints_xyzw"][t], atol=1e-6)
        np.testing.assert_allclose(offset, truth["offset_T"][t], atol=1e-6)


def _clip(frames: int = 8) -> dict:
    joints = np.tile([0, 0, 0, 1.0], (frames, 54, 1))
    return {
        "joints_array": joints,
        "transform_array": np.tile(np.eye(4), (frames, 1, 1)),
        "displacement": np.linspace(0, 1, frames),
        "fps": 120,
    }


def _motion() -> dict:
    return {"walk_motion": _clip(), "stop_pose": {"joints": _clip()["joints_array"][0], "transform": np.eye(4)}}


def _saved(tmp_path: Path, content, name: str = "motion.pkl") -> Path:
    path = tmp_path / name
    path.write_bytes(pickle.dumps(content))
    return path


def test_joints_come_in_smplx_order(tmp_path):
    content = _motion()
    for k in range(54):  # each joint turned by its own angle about x
        content["walk_motion"]["joints_array"][:, k] = (np.sin(k / 100), 0, 0, np.cos(k / 100))
    person = HabitatHumanoid(read_habitat_motion(_saved(tmp_path, content)))
    person.walk((0, 0, 1))
    _, joints = person.columns()
    for row, name in zip(joints, JOINT_NAMES[1:], strict=True):
        assert np.arcsin(row[0]) * 100 == pytest.approx(HABITAT_JOINTS.index(name))


def test_sequences_of_npz_files(tmp_path):
    np.savez(
        tmp_path / "s.npz", pose_motion=np.array({**_clip(), "displacement": None}, dtype=object)
    )  # as habitat-lab does
    clip = read_habitat_sequence(tmp_path / "s.npz")
    assert clip.joints.shape == (8, 54, 4)
    assert clip.displacement is None


def test_code_in_a_motion_file_is_refused(tmp_path):
    class Evil:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "proof",))

    np.savez(tmp_path / "s.npz", pose_motion=np.array({"joints_array": Evil()}, dtype=object))
    for path, read in [
        (_saved(tmp_path, {"walk_motion": Evil()}), read_habitat_motion),
        (tmp_path / "s.npz", read_habitat_sequence),
    ]:
        with pytest.raises(FormatError, match=r"(?s)only NumPy arrays are admitted.*H3-FORMAT-026"):
            read(path)
    assert not (tmp_path / "proof").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.pop("walk_motion"), r"(?s)'walk_motion'.*stop_pose.*H3-BODY-030"),
        (lambda m: m["walk_motion"].update(fps=0), r"(?s)walk_motion\.fps.*0.*0.*H3-BODY-031"),
        (lambda m: m["walk_motion"].pop("displacement"), "H3-BODY-028"),
        (lambda m: m["walk_motion"].update(displacement=np.zeros(8)), "H3-BODY-037"),
        (lambda m: m["walk_motion"].update(joints_array=np.zeros((8, 17, 4))), r"(?s)\[8, 54, 4\].*H3-BODY-038"),
        (lambda m: m["walk_motion"].update(joints_array=np.zeros((8, 54, 4))), "H3-BODY-034"),
        (lambda m: m["walk_motion"].update(transform_array=np.full((8, 4, 4), np.nan)), "H3-BODY-033"),
        (lambda m: m["stop_pose"].update(joints="none"), r"(?s)stop_pose\.joints.*H3-BODY-038"),
        (
            lambda m: m.update(right_hand={"pose_motion": _clip(), "coord_info": {"min": [0] * 3, "max": [0] * 3}}),
            r"(?s)num_bins.*H3-BODY-038",
        ),
    ],
)
def test_faults_of_motion_files_are_named(tmp_path, change, message):
    content = _motion()
    change(content)
    with pytest.raises(FormatError, match=message):
        read_habitat_motion(_saved(tmp_path, content))


def test_cut_off_motion_files_are_refused(tmp_path):
    data = _saved(tmp_path, _motion()).read_bytes()
    for size in range(0, len(data), 997):
        (tmp_path / "cut.pkl").write_bytes(data[:size])
        with pytest.raises(FormatError):
            read_habitat_motion(tmp_path / "cut.pkl")
    with pytest.raises(InputError, match=r"(?s)No such.*H3-BODY-036"):
        read_habitat_motion(tmp_path / "none.pkl")


def test_a_hand_without_poses_is_refused(tmp_path):
    person = HabitatHumanoid(read_habitat_motion(_saved(tmp_path, _motion())))
    with pytest.raises(InputError, match=r"(?s)left.*H3-BODY-027"):
        person.reach((0, 0, 0), "left")
