"""Files for other programs: what we write is read back, by ourselves or by the format's own definition."""

from __future__ import annotations

import csv
import gzip
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from h3data.bodies import Humanoid
from h3data.bodies.people.skeleton import HALF_JOINTS, JOINT_NAMES
from h3data.bodies.robots.robot_files import robot_names
from h3data.bodies.robots.robot_loading import load_robot
from h3data.errors import InputError
from h3data.geometry import pose_to_matrix, quat_from_heading, quat_to_matrix
from h3data.mesh.accessors import GltfArrays
from h3data.mesh.glb import unpack_glb
from h3data.metrics import UnmeasurableError, measure
from h3data.metrics.batch import measure_files
from h3data.recording import (
    Agent,
    AssetRef,
    Body,
    Dataset,
    Episode,
    Event,
    InputEvent,
    Recording,
    SkillSpan,
    read_mcap,
    write_mcap,
)
from h3data.replay import Replay
from h3data_exporters.csv_tables import write_csv_tables
from h3data_exporters.gltf_animation import write_gltf_animation
from h3data_exporters.lerobot import write_lerobot
from h3data_exporters.posing import posed_cameras, posed_parts
from h3data_exporters.robomimic import write_robomimic
from h3data_exporters.transitions import transitions_of
from h3data_habitat.exporters.gfx_replay_export import write_gfx_replay
from h3data_habitat.gfx.replay import read_gfx_replay
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.cli import main
from h3data_pipelines.validation.recordings import validate_recording
from sim_kinematic.motion.spec import SocialNavSpec, WalkerSpec
from tests.simulated import simulate_social_nav, social_nav_episode

STEPS = np.array([0, 20, 59])


@pytest.fixture(scope="module")
def recording() -> Recording:
    spec = SocialNavSpec(max_steps=60, spawn_distance_m=3.0, human=WalkerSpec(speed_mps=1.0))
    return simulate_social_nav(social_nav_episode(build_home(HomeSpec(seed=2)), seed=2, spec=spec))


@pytest.fixture(scope="module")
def replay(recording: Recording) -> Replay:
    return Replay(recording, detail=False)


def boxes() -> Recording:
    """A cube that stands, one that turns, one that is away in steps 4 to 6 and from 9 on; nobody acts."""
    poses = np.zeros((12, 2, 7), np.float32)
    poses[:, 0, 1] = np.arange(12) * 0.1
    poses[:, 0, 3:] = quat_from_heading(np.linspace(0, 9, 12))
    poses[:, 1, [0, 6]] = [3, 1]
    poses[4:7, 1] = poses[9:, 1] = np.nan
    view = np.tile(np.array([1, 2, 3, 0, 0, 0, 1], np.float32), (12, 1))
    view[3] = np.nan
    return Recording(
        episode=Episode(uid="u", episode_id="boxes", task="none", scene=""),
        assets=(
            AssetRef(name="cubeSolid", uri="primitive:cubeSolid", color=(200, 10, 30)),
            AssetRef(name="lost", uri="data/objects/lost.glb", up=(0.0, 0.0, 1.0), front=(0.0, 1.0, 0.0), units_m=0.5),
        ),
        bodies=(
            Body(name="stands", asset="cubeSolid", pose=np.array([-3, 0, 0, 0, 0, 0, 1], np.float32), semantic_id=7),
            Body(name="turns", asset="cubeSolid", pose=poses[0, 0], moving=0, scale=np.array([0.5, 1, 2], np.float32)),
            Body(name="leaves", asset="lost", pose=poses[0, 1], moving=1),
        ),
        columns={
            "time_ns": np.arange(12, dtype=np.int64) * 33_333_333,
            "object_pose": poses,
            "user.sensor_eye": view,
        },
    )


def exported(recording: Recording, path: Path, **options: Any) -> Recording:
    replay = Replay(recording, **options)
    return read_gfx_replay(write_gfx_replay(recording, posed_parts(replay), path, cameras=posed_cameras(replay)).path)


# --- gfx-replay -------------------------------------------------------------------------------------------------------
def assert_same_replay(back: Recording, recording: Recording) -> None:
    assert list(back.columns) == list(recording.columns)
    for name, values in recording.columns.items():
        np.testing.assert_allclose(back.columns[name], values, atol=1e-6, err_msg=name)
    assert back.assets == recording.assets
    assert back.agents == recording.agents
    assert back.episode.scene == recording.episode.scene
    assert len(back.bodies) == len(recording.bodies)
    for one, other in zip(back.bodies, recording.bodies, strict=True):
        assert (one.asset, one.semantic_id, one.moving, one.agent) == (
            other.asset,
            other.semantic_id,
            other.moving,
            other.agent,
        )
        np.testing.assert_allclose(one.pose, other.pose, atol=1e-6)
        np.testing.assert_array_equal(one.scale, other.scale)
    for key in ("lights", "light_changes", "warnings"):
        assert back.episode.info.get(key) == recording.episode.info.get(key)


REAL_REPLAYS = (
    "habitat-sim/reference/replays/room_skinned/replay.gfx_replay.json",
    "habitat-sim/reference/replays/room_articulated/replay.gfx_replay.json",
    "habitat-lab/reference/hitl/session_1user_policy/gfx/episode_0.gfx_replay.json.gz",
    "hitl/my_session.gfx_replay.json",
)


@pytest.mark.parametrize("name", REAL_REPLAYS)
def test_replays_of_habitat_come_back_as_they_were(name: str, real: Path, tmp_path: Path) -> None:
    recording = read_gfx_replay(real / name)
    back = exported(recording, tmp_path / "again.gfx_replay.json", assets=[real / "habitat-sim", real / "habitat-lab"])
    assert_same_replay(back, recording)


def test_bodies_that_come_and_go_are_created_anew(tmp_path: Path) -> None:
    recording = boxes()
    back = exported(recording, tmp_path / "boxes.gfx_replay.json.gz")
    assert back.assets == recording.assets
    assert len(back.bodies) == 4  # the one that came back is another instance
    old, new = recording.columns["object_pose"], back.columns["object_pose"]
    np.testing.assert_allclose(new[:, 0], old[:, 0], atol=1e-6)
    np.testing.assert_allclose(new[:4, 1], old[:4, 1], atol=1e-6)
    np.testing.assert_allclose(new[7:9, 2], old[7:9, 1], atol=1e-6)
    assert np.isnan(new[4:, 1]).all()
    assert np.isnan(new[:7, 2]).all()
    assert np.isnan(new[9:, 2]).all()
    np.testing.assert_array_equal(back.columns["user.sensor_eye"], recording.columns["user.sensor_eye"])


def test_our_own_people_and_robots_come_back_where_they_were(
    recording: Recording, replay: Replay, tmp_path: Path
) -> None:
    back = exported(recording, tmp_path / "own.gfx_replay.json", detail=False)
    again = Replay(back, assets=[tmp_path])
    assert not again.missing
    assert [a.kind for a in back.agents] == ["robot", "human"]
    for agent in (0, 1):
        column = f"agent_{agent}.base_pose"
        np.testing.assert_allclose(np.abs(back.columns[column]), np.abs(recording.columns[column]), atol=1e-6)
    ours = [b for b in recording.bodies if not b.asset.startswith("robot")]
    for one, other in zip(ours, back.bodies[: len(ours)], strict=True):
        assert (one.semantic_id, one.moving) == (other.semantic_id, other.moving)
        np.testing.assert_allclose(one.pose, other.pose, atol=1e-6)
    links = [d for d in replay.drawables if d.agent == 0]
    assert sum(body.agent == 0 for body in back.bodies) == len(links) > 5
    assert back.episode.info["rigs"][0]["bones"] == [*JOINT_NAMES, *HALF_JOINTS]
    assert not [name for name in back.columns if "person_root" in name]
    joints = pose_to_matrix(back.columns["rig.0"].astype(np.float64))
    body = replay.model(1)
    assert isinstance(body, Humanoid)
    frames = body.skin_frames(replay.joint_matrices(1, np.arange(len(recording))))
    np.testing.assert_allclose(joints, frames, atol=2e-6)
    people = 0
    for index, (old, new) in enumerate(zip(replay.drawables, again.drawables, strict=True)):
        assert old.semantic_id == new.semantic_id
        if old.deformable:
            people += 1
            for step in STEPS:
                one, other = (r.vertices(index, np.array([step]))[0] for r in (replay, again))
                assert_same_points(one, other, atol=3e-6)
        else:
            np.testing.assert_allclose(replay.matrices(index, STEPS), again.matrices(index, STEPS), atol=2e-6)
    assert people == 1
    np.testing.assert_allclose(back.columns["user.sensor_human_head"], posed_cameras(replay)[-1].poses, atol=1e-6)


def test_people_stand_where_habitat_sim_skins_them(recording: Recording, replay: Replay, tmp_path: Path) -> None:
    """What habitat-sim 57ee494 makes of a rig, from the written files alone.

    `ResourceManager::mapSkinnedModelToRig` walks the nodes depth first; the first with a bone is the root R.
    `Drawable::buildSkinJointTransforms` gives joint i the matrix R^-1 bone_i inverse_bind_i, and the instance moves all that.
    """
    path = write_gfx_replay(recording, posed_parts(replay), tmp_path / "own.gfx_replay.json").path
    keyframes = json.loads(path.read_text())["keyframes"]
    rig = keyframes[0]["rigCreations"][0]
    (person,) = [c for c in keyframes[0]["creations"] if c["creation"]["rigId"] == rig["id"]]
    file = tmp_path / person["creation"]["filepath"]
    document, chunk = unpack_glb(file.read_bytes(), "")
    nodes = document["nodes"]
    order, waiting = [], list(reversed(document["scenes"][0]["nodes"]))
    while waiting:
        order.append(waiting.pop())
        waiting += reversed(nodes[order[-1]].get("children", []))
    root = next(rig["boneNames"].index(nodes[n]["name"]) for n in order if nodes[n].get("name") in rig["boneNames"])
    joints = [rig["boneNames"].index(nodes[n]["name"]) for n in document["skins"][0]["joints"]]
    binds = GltfArrays(document, lambda _: chunk).accessor(document["skins"][0]["inverseBindMatrices"])
    binds = binds.reshape(-1, 4, 4).swapaxes(1, 2)
    (number,) = [k for k, d in enumerate(replay.drawables) if d.deformable]
    state, bones, heights = None, None, []
    for step, keyframe in enumerate(keyframes):
        updates = [u for u in keyframe.get("stateUpdates", []) if u["instanceKey"] == person["instanceKey"]]
        state = updates[-1]["state"]["absTransform"] if updates else state
        bones = keyframe["rigUpdates"][0]["pose"] if "rigUpdates" in keyframe else bones
        assert state is not None
        assert bones is not None
        placed = _matrix(state["translation"], state["rotation"])
        of_bone = np.stack([_matrix(b["t"], b["r"]) for b in bones])
        np.testing.assert_allclose(placed, of_bone[root], atol=1e-6)  # as in habitat-sim's own recordings
        heights.append(state["translation"][1])
        if step in STEPS:
            moves = placed @ np.linalg.inv(of_bone[root]) @ of_bone[joints] @ binds
            drawn = _skinned_by(document, chunk, moves)
            assert_same_points(drawn, replay.vertices(number, np.array([step]))[0], atol=1e-5)
    assert np.ptp(heights) > 0.005  # the pelvis sways


def _matrix(position: list[float], wxyz: list[float]) -> np.ndarray:
    w, x, y, z = wxyz
    return pose_to_matrix(np.array([*position, x, y, z, w]))


def _skinned_by(document: dict[str, Any], chunk: Any, moves: np.ndarray) -> np.ndarray:
    arrays, out = GltfArrays(document, lambda _: chunk), []
    for primitive in document["meshes"][0]["primitives"]:
        get = {name: arrays.floats(index) for name, index in primitive["attributes"].items()}
        blend = np.einsum("vk,vkab->vab", get["WEIGHTS_0"], moves[get["JOINTS_0"].astype(int)])
        out.append(np.einsum("vab,vb->va", blend[:, :3, :3], get["POSITION"]) + blend[:, :3, 3])
    return np.concatenate(out)


def test_our_replays_carry_light_from_all_sides(recording: Recording, replay: Replay, tmp_path: Path) -> None:
    path = write_gfx_replay(recording, posed_parts(replay), tmp_path / "own.gfx_replay.json").path
    first = json.loads(path.read_text())["keyframes"][0]
    assert first["lightsChanged"] is True
    normals = np.concatenate([np.eye(3), -np.eye(3)])
    vectors, colors = (np.array([light[key] for light in first["lights"]]) for key in ("vector", "color"))
    received = np.maximum(-normals @ vectors[:, :3].T, 0) @ colors
    assert received.min() > 0.6  # also what faces down
    assert received.max() <= 1.0
    assert {light["model"] for light in first["lights"]} == {"global"}
    assert read_gfx_replay(path).episode.info["lights"] == first["lights"]


@pytest.mark.slow
def test_replays_from_before_still_come_back(recording: Recording, replay: Replay, tmp_path: Path) -> None:
    """Until 0.1.0's first trial, people stood at their root 0.9 m above the floor, and no user transform said so."""
    path = write_gfx_replay(recording, posed_parts(replay), tmp_path / "own.gfx_replay.json").path
    content = json.loads(path.read_text())
    rig = next(c for c in content["keyframes"][0]["creations"] if c["creation"]["rigId"] == 0)
    for keyframe in content["keyframes"]:
        roots = [u for u in keyframe["userTransforms"] if u["name"].startswith("h3data_person_root_")]
        keyframe["userTransforms"] = [u for u in keyframe["userTransforms"] if u not in roots]
        keep = [u for u in keyframe.get("stateUpdates", []) if u["instanceKey"] != rig["instanceKey"]]
        state = {"absTransform": roots[0]["transform"]}
        keyframe["stateUpdates"] = [*keep, {"instanceKey": rig["instanceKey"], "state": state}]
    path.write_text(json.dumps(content))
    back = read_gfx_replay(path)
    np.testing.assert_allclose(
        np.abs(back.columns["agent_1.base_pose"]), np.abs(recording.columns["agent_1.base_pose"]), atol=1e-6
    )
    again = Replay(back, assets=[tmp_path])
    (number,) = [k for k, d in enumerate(again.drawables) if d.deformable]
    one, other = (r.vertices(number, STEPS) for r in (replay, again))
    for step in range(len(STEPS)):
        assert_same_points(one[step], other[step], atol=3e-6)


@pytest.mark.parametrize("name", robot_names())
def test_every_robot_of_ours_comes_back_onto_its_floor(name: str, tmp_path: Path) -> None:
    robot = load_robot(name)
    base = np.zeros((5, 7), np.float32)
    base[:, :3] = np.linspace([1, 0.2, -3], [2, 0.2, -2], 5)
    base[:, 3:] = quat_from_heading(np.linspace(-2, 4, 5))
    recording = Recording(
        episode=Episode(uid="u", episode_id="x", task="none", scene=""),
        agents=(Agent(name="robot", kind="robot", model=f"robot/{name}", joint_names=tuple(robot.joint_names)),),
        columns={
            "time_ns": np.arange(5, dtype=np.int64) * 33_333_333,
            "agent_0.base_pose": base,
            "agent_0.joint_pos": np.tile(robot.rest.astype(np.float32), (5, 1)),
        },
    )
    back = exported(recording, tmp_path / "x.gfx_replay.json")
    assert back.episode.info["warnings"] == []
    np.testing.assert_allclose(np.abs(back.columns["agent_0.base_pose"]), np.abs(base), atol=1e-6)


def assert_same_points(one: np.ndarray, other: np.ndarray, *, atol: float) -> None:
    """Both sets lie on each other; files split vertices and put them in another order."""
    from scipy.spatial import cKDTree

    assert cKDTree(one).query(other)[0].max() < atol
    assert cKDTree(other).query(one)[0].max() < atol


def test_a_replay_is_a_valid_json_whose_quiet_keyframes_are_empty(tmp_path: Path) -> None:
    moving = boxes()
    columns = {"time_ns": moving.columns["time_ns"], "object_pose": moving.columns["object_pose"][[0] * 12]}
    still = replace(moving, columns=columns)
    path = tmp_path / "x.gfx_replay.json.gz"
    write_gfx_replay(still, posed_parts(Replay(still)), path)
    keyframes = json.loads(gzip.decompress(path.read_bytes()))["keyframes"]
    assert len(keyframes) == 12
    assert all(keyframe == {} for keyframe in keyframes[1:])
    assert [item["creation"]["scale"] for item in keyframes[0]["creations"]] == [[1, 1, 1], [0.5, 1, 2], [1, 1, 1]]


# --- glTF -------------------------------------------------------------------------------------------------------------
class Played:
    """A glTF file posed by its animation as the specification says, written from it and not from our writer."""

    def __init__(self, path: Path) -> None:
        self.document, binary = unpack_glb(path.read_bytes(), str(path))
        self.arrays = GltfArrays(self.document, lambda _: binary)

    def nodes_at(self, step: int) -> dict[int, np.ndarray]:
        """World matrices by node."""
        poses = [dict(node) for node in self.document["nodes"]]
        for animation in self.document.get("animations", []):
            for channel in animation["channels"]:
                sampler = animation["samplers"][channel["sampler"]]
                target = channel["target"]
                poses[target["node"]][target["path"]] = self.arrays.floats(sampler["output"])[step]
        world: dict[int, np.ndarray] = {}

        def visit(index: int, parent: np.ndarray) -> None:
            node, local = poses[index], np.eye(4)
            rotation = np.asarray(node.get("rotation", [0, 0, 0, 1]), np.float64)
            local[:3, :3] = quat_to_matrix(rotation) * np.asarray(node.get("scale", [1, 1, 1]), np.float64)
            local[:3, 3] = node.get("translation", [0, 0, 0])
            world[index] = parent @ local
            for child in node.get("children", []):
                visit(child, world[index])

        for root in self.document["scenes"][0]["nodes"]:
            visit(root, np.eye(4))
        return world

    def by_name(self, step: int) -> dict[str, np.ndarray]:
        world = self.nodes_at(step)
        return {self.document["nodes"][index]["name"]: matrix for index, matrix in world.items()}

    def skinned(self, step: int, skin: int = 0) -> np.ndarray:
        """World vertices of the mesh with that skin."""
        world, record = self.nodes_at(step), self.document["skins"][skin]
        binds = self.arrays.floats(record["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
        joints = np.stack([world[j] for j in record["joints"]]) @ binds
        mesh = next(node["mesh"] for node in self.document["nodes"] if node.get("skin") == skin)
        out = []
        for primitive in self.document["meshes"][mesh]["primitives"]:
            where = {
                key: self.arrays.floats(index) for key, index in primitive["attributes"].items() if key != "JOINTS_0"
            }
            own = self.arrays.accessor(primitive["attributes"]["JOINTS_0"]).astype(int)
            assert np.abs(where["WEIGHTS_0"].sum(1) - 1).max() < 1e-6
            points = np.concatenate([where["POSITION"], np.ones((len(own), 1))], 1)
            out.append(np.einsum("vk,vkij,vj->vi", where["WEIGHTS_0"], joints[own], points)[:, :3])
        return np.concatenate(out)


def test_an_animation_played_by_the_book_is_the_replay(recording: Recording, replay: Replay, tmp_path: Path) -> None:
    made = write_gltf_animation(recording, posed_parts(replay), tmp_path / "a.glb", cameras=posed_cameras(replay))
    played = Played(made.path)
    assert made.joints == len(JOINT_NAMES) + len(HALF_JOINTS)
    assert made.seconds == pytest.approx(59 / 30, abs=1e-4)
    for step in STEPS:
        found = played.by_name(int(step))
        for index, drawable in enumerate(replay.drawables):
            if drawable.deformable:
                vertices = replay.vertices(index, np.array([step]))[0]
                assert_same_points(played.skinned(int(step)), vertices, atol=1e-5)
            else:
                expected = replay.matrices(index, np.array([step]))[0] if drawable.moving else drawable.matrix
                np.testing.assert_allclose(found[drawable.name], expected, atol=2e-6, err_msg=drawable.name)
        for camera in posed_cameras(replay):
            np.testing.assert_allclose(found[camera.name], pose_to_matrix(camera.poses[step]), atol=2e-6)
    rest = trimesh.load(made.path)  # an independent reader: nodes in their first pose
    assert isinstance(rest, trimesh.Scene)
    assert len(rest.geometry) >= made.meshes


def test_recorded_rigs_are_skinned_as_habitat_draws_them(real: Path, tmp_path: Path) -> None:
    recording = read_gfx_replay(real / REAL_REPLAYS[0])
    replay = Replay(recording, assets=[real / "habitat-sim"])
    made = write_gltf_animation(recording, posed_parts(replay), tmp_path / "rig.glb")
    played, rigs = Played(made.path), [i for i, d in enumerate(replay.drawables) if d.deformable]
    assert len(rigs) == 2  # the second has scale 0.5
    for skin, index in enumerate(rigs):
        for step in (0, 30, 59):
            assert_same_points(played.skinned(step, skin), replay.vertices(index, np.array([step]))[0], atol=1e-5)


def test_what_is_away_is_shrunk_to_nothing(tmp_path: Path) -> None:
    recording = boxes()
    made = write_gltf_animation(recording, posed_parts(Replay(recording)), tmp_path / "boxes.glb")
    played = Played(made.path)
    sizes = [float(np.abs(played.by_name(step)["leaves"][:3, :3]).max()) for step in range(12)]
    assert [size > 0 for size in sizes] == [True] * 4 + [False] * 3 + [True] * 2 + [False] * 3
    nodes = {node["name"]: node for node in played.document["nodes"]}
    assert nodes["leaves"]["extras"]["placeholder"]
    assert "extras" in played.document["asset"]


# --- tables and demonstrations ----------------------------------------------------------------------------------------
def test_tables_hold_every_number(recording: Recording, tmp_path: Path) -> None:
    write_csv_tables(recording, tmp_path)
    with np.load(tmp_path / "columns.npz") as arrays:
        assert set(arrays) == set(recording.columns)
        for name, values in recording.columns.items():
            np.testing.assert_array_equal(arrays[name], values)
    with (tmp_path / "steps.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(recording)
    for place, name in ((0, "x"), (2, "z"), (6, "qw")):
        found = np.array([row[f"agent_0.base_pose.{name}"] for row in rows]).astype(np.float32)
        np.testing.assert_array_equal(found, recording.columns["agent_0.base_pose"][:, place])
    assert f"agent_0.joint_pos.{recording.agents[0].joint_names[0]}" in rows[0]
    assert int(rows[-1]["state_hash"]) == recording.columns["state_hash"][-1]
    record = json.loads((tmp_path / "recording.json").read_text())
    assert record["episode"]["uid"] == recording.episode.uid


def test_tables_keep_raw_input_to_the_letter(tmp_path: Path) -> None:
    typed = InputEvent(time_ns=-7, kind="key_down", user=2, payload='{"key": "ü,\\n"}')
    write_csv_tables(replace(boxes(), inputs=(typed,)), tmp_path)
    with (tmp_path / "inputs.csv").open(newline="", encoding="utf-8") as stream:
        (row,) = csv.DictReader(stream)
    assert (
        InputEvent(time_ns=int(row["time_ns"]), kind=row["kind"], user=int(row["user"]), payload=row["payload"])
        == typed
    )


def test_tables_leave_out_what_is_away(tmp_path: Path) -> None:
    recording = boxes()
    write_csv_tables(recording, tmp_path)
    with (tmp_path / "object_pose.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [int(row["step"]) for row in rows if row["body"] == "leaves"] == [0, 1, 2, 3, 7, 8]
    with (tmp_path / "steps.csv").open() as stream:
        assert [row["user.sensor_eye.x"] for row in csv.DictReader(stream)][2:5] == ["1.0", "", "1.0"]


def test_the_action_of_a_frame_is_the_one_taken_in_it(recording: Recording, tmp_path: Path) -> None:
    found = transitions_of(recording)
    assert len(found) == len(recording) - 1
    np.testing.assert_array_equal(found.action[7], recording.columns["agent_0.action"][8])
    np.testing.assert_array_equal(found.state["base_pose"][7], recording.columns["agent_0.base_pose"][7])
    assert len(found.state_names) == found.flat_state.shape[1]
    assert write_lerobot([recording, recording], tmp_path / "ds") == 2
    back = Dataset(tmp_path / "ds").recording(1)
    np.testing.assert_array_equal(back.columns["action"], found.action)
    np.testing.assert_array_equal(back.columns["observation.state"], found.flat_state[:-1])
    assert back.columns["next.done"].tolist() == [False] * (len(found) - 1) + [True]
    features = json.loads((tmp_path / "ds/meta/info.json").read_text())["features"]
    assert features["action"]["shape"] == [2]
    assert "uint64" not in {feature["dtype"] for feature in features.values()}


def test_demonstrations_without_their_last_row_are_not_measured(recording: Recording, tmp_path: Path) -> None:
    write_lerobot([recording, recording], tmp_path / "ds")
    with pytest.raises(UnmeasurableError, match="H3-METRIC-028"):
        measure(Dataset(tmp_path / "ds").recording(0))
    with pytest.raises(UnmeasurableError, match="H3-METRIC-028"):
        measure_files([tmp_path / "ds"])
    assert measure(recording).rows == len(recording)


def test_what_happens_in_the_last_row_counts_for_the_frame_before(recording: Recording, tmp_path: Path) -> None:
    last = len(recording) - 1
    spans = [SkillSpan(agent=0, name="place", start_step=begin, end_step=last) for begin in (last - 3, last)]
    events = (Event(step=last, kind="found", agent=0), Event(step=4, kind="lost", agent=0))
    write_lerobot([replace(recording, skills=tuple(spans), events=events)], tmp_path / "ds")
    back = Dataset(tmp_path / "ds").recording(0)
    assert [(span.start_step, span.end_step) for span in back.skills] == [(last - 3, last - 1)]
    assert [(event.step, event.kind) for event in back.events] == [(last - 1, "found"), (4, "lost")]
    assert [finding.text for finding in validate_recording(back) if finding.severity == "error"] == []


def test_demonstrations_without_their_last_row_are_neither_verified_nor_exported_again(
    recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_lerobot([recording], tmp_path / "ds")
    assert "cannot be simulated again" in run_json(capsys, "replay", tmp_path / "ds", "--verify", code=2)["error"]
    write_lerobot([recording, recording], tmp_path / "two")
    result = run_json(capsys, "replay", tmp_path / "two", "--verify", code=1)
    assert [row["equal"] for row in result["episodes"]] == [None, None]
    for to, out in (("lerobot", "again"), ("robomimic", "again.hdf5")):
        said = run_json(capsys, "export", tmp_path / "ds", "--to", to, "-o", tmp_path / out, code=2)["error"]
        assert "lack the last row" in said
        assert not (tmp_path / out).exists()


def test_the_reward_is_of_the_action_that_led_to_success(recording: Recording) -> None:
    def rewards(*events: Event, **info: bool) -> list[int]:
        changed = replace(recording, events=events, episode=replace(recording.episode, info=info))
        return np.flatnonzero(transitions_of(changed).reward).tolist()

    assert rewards() == []
    assert rewards(Event(step=9, agent=0, kind="found"), Event(step=20, agent=0, kind="found")) == [8]
    assert rewards(Event(step=9, agent=0, kind="collision"), success=True) == [len(recording) - 2]


def test_robomimic_demonstrations(recording: Recording, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "demos.hdf5"
    assert write_robomimic([recording, recording], path) == 2
    found = transitions_of(recording)
    with h5py.File(path) as file:
        assert file["data"].attrs["total"] == 2 * len(found)
        assert json.loads(file["data"].attrs["env_args"])["env_kwargs"]["action_names"] == ["forward", "turn_left"]
        demo = file["data/demo_1"]
        assert demo.attrs["num_samples"] == len(found)
        np.testing.assert_array_equal(demo["actions"], found.action)
        np.testing.assert_array_equal(demo["obs/base_pose"][1:], demo["next_obs/base_pose"][:-1])
        assert set(demo["obs"]) == set(demo["next_obs"]) >= {"base_pose", "joint_pos", "agent_1.base_pose"}
        assert demo["dones"][:].sum() == demo["dones"][-1] == 1
    with pytest.raises(InputError, match="H3-EXPORT-037"):
        write_robomimic([boxes()], tmp_path / "none.hdf5")
    assert not (tmp_path / "none.hdf5").exists()


# --- the command ------------------------------------------------------------------------------------------------------
TARGETS = {
    "gfx-replay": "e.gfx_replay.json",
    "gltf": "e.glb",
    "foxglove": "e.foxglove.mcap",
    "rosbag2": "bag",
    "csv": "tables",
    "lerobot": "lerobot",
    "robomimic": "d.hdf5",
}
NEEDS = {"robomimic": "h5py", "foxglove": "mcap_protobuf", "rosbag2": "rosbags"}


def run_json(capsys: pytest.CaptureFixture[str], *arguments: str | Path, code: int = 0) -> Any:
    capsys.readouterr()
    assert main([*map(str, arguments), "--json"]) == code
    return json.loads(capsys.readouterr().out)


@pytest.fixture(scope="module")
def log(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "episode.mcap"
    write_mcap(recording, path)
    return path


@pytest.mark.parametrize(
    "to",
    [pytest.param(to, marks=pytest.mark.slow) if to in ("gfx-replay", "gltf", "foxglove") else to for to in TARGETS],
)
def test_the_command_writes_once_and_again_only_by_force(
    to: str, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if to in NEEDS:
        pytest.importorskip(NEEDS[to], reason=f'needs the extra: pip install "h3data[{to}]"')
    out = tmp_path / "new" / TARGETS[to]
    arguments: list[str | Path] = ["export", log, "--to", to, "-o", out]
    assert run_json(capsys, *arguments)["to"] == to
    assert out.exists()
    assert "exist" in run_json(capsys, *arguments, code=2)["error"] or to in ("csv", "rosbag2")
    run_json(capsys, *arguments, "--force")
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.parametrize("to", TARGETS)
def test_recordings_without_agents_and_places_that_cannot_be_written(
    to: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if to in NEEDS:
        pytest.importorskip(NEEDS[to], reason=f'needs the extra: pip install "h3data[{to}]"')
    log, learns = tmp_path / "boxes.mcap", to in ("lerobot", "robomimic")
    write_mcap(boxes(), log)
    answer = run_json(capsys, "export", log, "--to", to, "-o", tmp_path / TARGETS[to], code=2 if learns else 0)
    if learns:
        assert "no actions" in answer["error"]
        assert not (tmp_path / TARGETS[to]).is_file()
    (tmp_path / "file").write_text("")
    answer = run_json(capsys, "export", log, "--to", to, "-o", tmp_path / "file" / TARGETS[to], code=2)
    assert answer["error"]


def test_a_folder_of_recordings_may_hold_files_for_foxglove(
    recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mcap_protobuf", reason='needs the extra: pip install "h3data[foxglove]"')
    log = tmp_path / "e.mcap"
    write_mcap(recording, log)
    run_json(capsys, "export", log, "--to", "foxglove", "-o", tmp_path / "e.foxglove.mcap")
    assert run_json(capsys, "metrics", tmp_path)["metrics"]
    assert [found["path"] for found in run_json(capsys, "info", tmp_path)["found"]] == [str(log)]


def test_options_that_do_not_fit_are_refused(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for more, words in (
        (["--to", "gltf", "-o", tmp_path / "a.gltf"], ".glb"),
        (["--to", "gfx-replay", "-o", tmp_path / "a.txt"], ".json"),
        (["--to", "robomimic", "-o", tmp_path / "a.npz"], ".hdf5"),
        (["--to", "csv", "-o", tmp_path / "t", "--agent", "robot"], "--agent"),
        (["--to", "csv", "-o", tmp_path / "t", "--person-detail", "low"], "--person-detail"),
        (["--to", "robomimic", "-o", tmp_path / "t.hdf5", "--assets", tmp_path], "--assets"),
        (["--to", "gltf", "-o", tmp_path / "a.glb", "--camera", "orbit"], "--camera"),
        (["--to", "foxglove", "-o", tmp_path / "a.mcap"], ".foxglove.mcap"),
        (["--to", "foxglove", "-o", tmp_path / "a.foxglove.mcap", "--camera", "nowhere"], "nowhere"),
        (["--to", "lerobot", "-o", tmp_path / "l", "--agent", "nobody"], "nobody"),
        (["--to", "habitat-episodes", "-o", tmp_path / "h"], "rearrange"),
    ):
        assert words in run_json(capsys, "export", log, *more, code=2)["error"]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("ending", [pytest.param(".gfx_replay.json", marks=pytest.mark.slow), ".gfx_replay.json.gz"])
def test_an_exported_replay_is_imported_with_its_own_assets(
    recording: Recording,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    ending: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.delenv("H3DATA_ASSETS", raising=False)
    write_mcap(recording, tmp_path / "walk.mcap")
    folder = tmp_path / "replay"
    folder.mkdir()
    monkeypatch.chdir(folder)
    assert (
        main(
            [
                "export",
                str(tmp_path / "walk.mcap"),
                "--to",
                "gfx-replay",
                "--person-detail",
                "low",
                "-o",
                f"walk{ending}",
            ]
        )
        == 0
    )
    capsys.readouterr()
    assert main(["import", f"walk{ending}", "-o", str(tmp_path / "out"), "--json"]) == 0
    assert "not found" not in capsys.readouterr().out
    monkeypatch.chdir(tmp_path)
    back = read_mcap(tmp_path / "out" / "walk.mcap")
    assert Replay(back).missing == {}
    folder.rename(tmp_path / "moved")
    assert Replay(back).missing
    assert Replay(back, assets=[tmp_path / "moved"]).missing == {}


def test_a_recording_cannot_name_any_folder_of_assets(recording: Recording, tmp_path: Path) -> None:
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret" / "a.glb").write_bytes(b"")
    info = {"source": {"assets": str(tmp_path / "secret")}}
    asset = AssetRef(name="x", uri="secret/a.glb")
    body = Body(name="x", asset="x", pose=np.array([0, 0, 0, 0, 0, 0, 1], np.float32))
    changed = replace(
        recording,
        episode=replace(recording.episode, info=info),
        assets=(*recording.assets, asset),
        bodies=(*recording.bodies, body),
    )
    assert list(Replay(changed).missing) == ["secret/a.glb"]
