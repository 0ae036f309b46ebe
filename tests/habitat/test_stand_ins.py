"""Built-in bodies and named boxes in place of assets that are not on this machine."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import h3data
from h3data.bodies import load_humanoid, load_robot
from h3data.bodies.people.skeleton import JOINT_NAMES
from h3data.commands.command import missing_lines
from h3data.errors import InputError
from h3data.geometry import ground_pose, pose_from_matrix, pose_to_matrix
from h3data.recording import Recording
from h3data.replay import Replay
from h3data_habitat.gfx.replay import read_gfx_replay
from h3data_habitat.stand_ins import named_box, readable_name
from h3data_motion.amass import quat_from_rotvec
from tests.paths import REAL

STEPS = 4
SPOT = {
    "base": "base_link",
    "fl.hip": "front_left_hip",
    "fl.uleg": "front_left_thigh",
    "fl.lleg": "front_left_shank",
    "hr.hip": "rear_right_hip",
    "hr.uleg": "rear_right_thigh",
    "arm0.link_sh0": "arm_turret",
    "arm0.link_sh1": "arm_upper",
    "arm0.link_hr0": "arm_upper_end",
    "arm0.link_el0": "arm_elbow",
}
POSED = (
    "front_left_hip_roll",
    "front_left_hip_pitch",
    "front_left_knee",
    "rear_right_hip_pitch",
    "arm_0",
    "arm_1",
    "arm_3",
)
CHAIR = "data/fpss/objects/0/004315b97305e4c6986491dfc1057ae72b91537e.glb"
BOWL = "data/objects/ycb/meshes/024_bowl/google_16k/textured.glb"


def _transform(pose: np.ndarray) -> dict[str, list[float]]:
    x, y, z, w = pose[3:].tolist()
    return {"translation": pose[:3].tolist(), "rotation": [w, x, y, z]}


def _session(folder: Path, *, rigged: bool = False) -> tuple[Recording, np.ndarray, np.ndarray]:
    """A HITL session as habitat-sim records one: Spot, a person, a piece of furniture and a bowl; with the joint positions of
    the robot [T, J] and the joints of the person [T, 55, 4, 4]."""
    rng = np.random.default_rng(3)
    robot, human = load_robot("quad_arm"), load_humanoid("neutral_0")
    joints = np.tile(robot.rest, (STEPS, 1))
    columns = [robot.joint_names.index(name) for name in POSED]
    joints[:, columns] += rng.uniform(-0.3, 0.1, (STEPS, len(columns)))
    joints = np.clip(joints, robot.lower, robot.upper)
    path = np.stack([np.linspace(0, 0.2, STEPS), np.zeros(STEPS)], 1)
    links = robot.link_matrices(ground_pose(path, np.full(STEPS, 0.4)), joints)
    pelvis = np.tile([2.0, 0.9, 1.0, 0, 0, 0, 1.0], (STEPS, 1))
    pelvis[:, 2] += np.linspace(0, 0.15, STEPS)
    bones = human.joint_matrices_free(pelvis, quat_from_rotvec(rng.normal(0, 0.2, (STEPS, 54, 3))))
    names = [f"data/robots/hab_spot_arm/meshesColored/{name}.glb" for name in SPOT]
    names += ["data/humanoids/humanoid_data/female_0/female_0.glb", CHAIR, BOWL]
    still = [np.array([1.0, 0, 1, 0, 0, 0, 1]), np.array([1.0, 0.8, 1, 0, 0, 0, 1])]
    keyframes: list[dict[str, Any]] = []
    for step in range(STEPS):
        poses = [pose_from_matrix(links[step, robot.link_index(own)]) for own in SPOT.values()]
        poses += [pelvis[step], *still]
        updates = [{"instanceKey": key, "state": {"absTransform": _transform(pose)}} for key, pose in enumerate(poses)]
        keyframes.append({"stateUpdates": updates})
        if rigged:
            pose = [
                {"t": transform["translation"], "r": transform["rotation"]}
                for transform in map(_transform, map(pose_from_matrix, bones[step]))
            ]
            keyframes[-1]["rigUpdates"] = [{"id": 0, "pose": pose}]
    keyframes[0]["creations"] = [
        {"instanceKey": key, "creation": {"filepath": name, **({"rigId": 0} if rigged and "humanoid" in name else {})}}
        for key, name in enumerate(names)
    ]
    if rigged:
        keyframes[0]["rigCreations"] = [{"id": 0, "boneNames": list(JOINT_NAMES)}]
    file = folder / "session.gfx_replay.json"
    file.write_text(json.dumps({"keyframes": keyframes}))
    return read_gfx_replay(file), joints, bones


def test_the_robot_has_the_recorded_joints(tmp_path: Path) -> None:
    recording, joints, _ = _session(tmp_path)
    assert recording.agents[0].model == ""
    shown = Replay(recording, stand_ins=True)
    assert shown.recording.agents[0].model == "robot/quad_arm"
    np.testing.assert_allclose(shown.recording.columns["agent_0.joint_pos"], joints, atol=1e-4)
    robot = load_robot("quad_arm")
    links = shown.link_matrices(0)
    for name, own in SPOT.items():
        body = next(b for b in recording.bodies if b.asset == name)
        recorded = (
            pose_to_matrix(recording.columns["object_pose"][:, body.moving].astype(np.float64))
            if (body.moving >= 0)
            else pose_to_matrix(body.pose.astype(np.float64))
        )
        np.testing.assert_allclose(links[:, robot.link_index(own)], recorded, atol=2e-3, err_msg=name)


def test_the_person_has_the_posture_of_the_recorded_bones(tmp_path: Path) -> None:
    recording, _, bones = _session(tmp_path, rigged=True)
    shown = Replay(recording, stand_ins=True)
    assert shown.recording.agents[1].model == "humanoid/female_0"  # the file's name is that of a built-in body
    joints = shown.joint_matrices(1, np.arange(STEPS))
    np.testing.assert_allclose(joints[:, :, :3, :3], bones[:, :, :3, :3], atol=1e-4)
    np.testing.assert_allclose(joints[:, 0, :3, 3], bones[:, 0, :3, 3], atol=1e-4)


def test_a_person_without_bones_walks_their_path(tmp_path: Path) -> None:
    shown = Replay(_session(tmp_path)[0], stand_ins=True)
    person = shown.recording.agents[1]
    assert person.model == "humanoid/female_0"
    feet = shown.joint_matrices(1, np.arange(STEPS))[:, [JOINT_NAMES.index("left_foot")], 1, 3]
    assert np.isfinite(feet).all()
    assert abs(float(feet.mean())) < 0.15  # on the floor that the robot stands on


def test_the_rest_are_plain_boxes_with_names_and_nothing_is_striped(tmp_path: Path) -> None:
    recording, *_ = _session(tmp_path)
    striped, plain = Replay(recording), Replay(recording, stand_ins=True)
    assert plain.missing == striped.missing
    assert "--stand-ins draws plain bodies and named boxes" in missing_lines(striped)[0]
    assert "built-in bodies and named boxes stand in" in missing_lines(plain)[0]
    assert {d.agent for d in striped.drawables if d.placeholder} == {-1, 0, 1}
    boxes = [d for d in plain.drawables if d.placeholder]
    assert [d.mesh.textures[0].name for d in boxes] == ["furniture", "bowl"]
    assert all(d.agent == -1 for d in boxes)
    np.testing.assert_allclose(
        boxes[1].mesh.bounds, next(d for d in striped.drawables if d.name == boxes[1].name).mesh.bounds
    )
    rgb = {
        name: h3data.render_frame(replay, camera="third_person", step=2)["rgb"].astype(int)
        for name, replay in {"striped": striped, "plain": plain}.items()
    }
    magenta = {
        name: int(((p[..., 0] > 1.8 * p[..., 1]) & (p[..., 2] > 1.8 * p[..., 1])).sum()) for name, p in rgb.items()
    }
    assert magenta["striped"] > 300
    assert magenta["plain"] < 10


def test_names_read_from_left_to_right_on_every_side() -> None:
    box = named_box(BOWL)
    assert box.uv is not None
    for corners, uv in zip(box.vertices[box.faces], box.uv[box.faces], strict=True):
        # pixels that go right and down go away from who reads them: the area on the plate and the triangle's have one sign
        across, along = uv[1] - uv[0], uv[2] - uv[0]
        assert across[0] * along[1] - across[1] * along[0] < 0
        sides = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        if abs(sides[1]) < 1e-6:  # on the four walls, down is down
            heights, rows = corners[:, 1], uv[:, 1]
            assert np.corrcoef(heights, rows)[0, 1] == pytest.approx(-1)


@pytest.mark.parametrize(
    ("uri", "name"),
    [
        (BOWL, "bowl"),
        (CHAIR, "furniture"),
        ("handle:003_cracker_box_:0000", "cracker box"),
        ("data/fpss/objects/openings/004315b97305e4c6986491dfc1057ae7.glb", "door or window"),
        ("objects/decomposed/1d8c555b5635a8fc89ac59b47cb40988d3e91243_part_1.glb", "furniture"),
        ("meshes/textured.glb", "furniture"),
        ("objects/chair.object_config.json", "chair"),
        ("own.assets/objects/shelf_model_2.glb", "shelf"),
    ],
)
def test_names_of_files_that_are_not_here(uri: str, name: str) -> None:
    assert readable_name(uri) == name


@pytest.mark.slow
def test_commands_take_the_option_and_say_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from h3data_pipelines.cli import main

    _session(tmp_path)
    assert main(["import", str(tmp_path / "session.gfx_replay.json"), "-o", str(tmp_path / "rec")]) == 0
    log = str(tmp_path / "rec" / "session.mcap")
    line = ["rerender", log, "--steps", "0", "--format", "png", "--size", "64x48", "-o", str(tmp_path / "v")]
    capsys.readouterr()
    assert main(line) == 0
    assert "--stand-ins draws plain bodies and named boxes" in capsys.readouterr().out
    assert main([*line, "--stand-ins"]) == 2  # other pictures than those that are there
    assert main([*line, "--stand-ins", "--force", "--camera", "robot_arm"]) == 0  # a camera of the built-in robot
    assert "built-in bodies and named boxes stand in" in capsys.readouterr().out
    assert main(["export", log, "--to", "gltf", "--stand-ins", "-o", str(tmp_path / "a.glb")]) == 0
    assert b"front_left_shank" in (tmp_path / "a.glb").read_bytes()
    assert main(["view", log, "--stand-ins", "-o", str(tmp_path / "a.html")]) == 0
    assert main(["view", log, "--stand-ins", "-o", str(tmp_path / "a.rrd")]) == 0
    with pytest.raises(InputError, match="H3-OPTION-035"):
        h3data.export(log, tmp_path / "b.gfx_replay.json", to="gfx-replay", stand_ins=True)


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="the real Habitat files are not on this machine")
def test_a_real_session_has_a_robot_a_person_and_no_stripes() -> None:
    recording = read_gfx_replay(REAL / "hitl" / "my_session.gfx_replay.json")
    shown = Replay(recording, stand_ins=True)
    assert [agent.model for agent in shown.recording.agents] == ["robot/quad_arm", "humanoid/neutral_0"]
    base = next(b for b in recording.bodies if b.asset == "base")
    recorded = pose_to_matrix(recording.columns["object_pose"][:, base.moving].astype(np.float64))
    np.testing.assert_allclose(shown.link_matrices(0)[:, 0], recorded, atol=0.012)  # Habitat tilts it by 0.6 degrees
