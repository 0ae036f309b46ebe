"""Reading gfx-replay: against a slow player, against real recordings with their truth, and against broken files."""

from __future__ import annotations

import gzip
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.errors import FormatError, InputError
from h3data.formats import detect
from h3data.geometry import (
    heading_direction,
    heading_from_quat,
    pose_from_matrix,
    pose_inverse,
    pose_multiply,
    pose_to_matrix,
)
from h3data.recording.records import STEP_NS, Recording
from h3data_habitat.gfx.replay import read_gfx_replay
from tests.paths import REAL

SESSION = REAL / "hitl" / "my_session.gfx_replay.json"
REPLAYS = REAL / "habitat-sim" / "reference" / "replays"
HITL = REAL / "habitat-lab" / "reference" / "hitl"
needs_real = pytest.mark.skipif(not REAL.is_dir(), reason="the real Habitat files are not on this machine")

BOXES_ORIGIN = np.array([-0.2929, 2.0, 0.0])  # the README says zero for all but the chair; the poses say this
CHAIR_ORIGIN = np.array([0.0740, 0.2070, -0.0059])  # from the COM frame, in the object's axes (reference/README.md)


# --- writing small replays --------------------------------------------------------------------------------------------
def transform(x: float = 0.0, q: tuple[float, ...] = (1.0, 0, 0, 0)) -> dict[str, Any]:
    return {"translation": [x, 0.0, 0.0], "rotation": list(q)}


def create(key: int, filepath: str = "data/a/thing.glb", **more: Any) -> dict[str, Any]:
    return {"instanceKey": key, "creation": {"filepath": filepath, **more}}


def update(key: int, x: float = 0.0, q: tuple[float, ...] = (1.0, 0, 0, 0), **more: Any) -> dict[str, Any]:
    return {"instanceKey": key, "state": {"absTransform": transform(x, q), **more}}


def write(folder: Path, content: Any, name: str = "x.gfx_replay.json") -> Path:
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def read(folder: Path, *keyframes: dict[str, Any], **options: Any) -> Recording:
    return read_gfx_replay(write(folder, {"keyframes": list(keyframes)}), **options)


def body_poses(rec: Recording, step: int) -> list[tuple[int, np.ndarray]]:
    """Instance key and pose of every body that is in the world at a step."""
    found = []
    for body in rec.bodies:
        pose = rec.columns["object_pose"][step, body.moving] if body.moving >= 0 else body.pose
        match = re.search(r"_(\d+)(?:~\d+)?$", body.name)
        assert match
        if not np.isnan(pose).any():
            found.append((int(match.group(1)), pose))
    return sorted(found, key=lambda item: item[0])


def played(keyframes: list[dict[str, Any]]) -> list[list[tuple[int, list[float]]]]:
    """A slow player: the world's dictionary after every keyframe, as wxyz transforms."""
    world: dict[int, list[float]] = {}
    history = []
    for keyframe in keyframes:
        created = [c["instanceKey"] for c in keyframe.get("creations", [])]
        before = set(world)
        for key in created:
            world[key] = [0, 0, 0, 1, 0, 0, 0]
        for key in keyframe.get("deletions", []):
            if not (key in before and key in created):
                world.pop(key, None)
        for item in keyframe.get("stateUpdates", []):
            if item["instanceKey"] in world:
                t = item["state"]["absTransform"]
                world[item["instanceKey"]] = [*t["translation"], *t["rotation"]]
        history.append(sorted((k, list(v)) for k, v in world.items()))
    return history


def assert_same_history(rec: Recording, keyframes: list[dict[str, Any]]) -> None:
    for step, expected in enumerate(played(keyframes)):
        ours = body_poses(rec, step)
        assert [k for k, _ in ours] == [k for k, _ in expected]
        for (_, pose), (_, values) in zip(ours, expected, strict=True):
            np.testing.assert_allclose(pose[:3], values[:3], atol=2e-6)
            w, x, y, z = np.array(values[3:]) / np.linalg.norm(values[3:])
            assert abs(abs(pose[3:] @ np.array([x, y, z, w])) - 1) < 1e-5


keys = st.integers(0, 3)
quats = st.sampled_from([(1.0, 0, 0, 0), (-1.0, 0, 0, 0), (0.5, 0.5, 0.5, 0.5), (0.0, 0.7, 0.0, 0.7)])
keyframe_lists = st.lists(
    st.fixed_dictionaries(
        {},
        optional={
            "creations": st.lists(keys, unique=True, max_size=3).map(lambda ks: [create(k) for k in ks]),
            "deletions": st.lists(keys, unique=True, max_size=3),
            "stateUpdates": st.lists(
                st.tuples(keys, st.integers(-3, 3), quats).map(lambda t: update(t[0], float(t[1]), t[2])), max_size=4
            ),
        },
    ),
    min_size=1,
    max_size=8,
)


@settings(max_examples=60, derandomize=True, deadline=None)
@given(keyframes=keyframe_lists)
def test_fold_agrees_with_a_slow_player(
    keyframes: list[dict[str, Any]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    # two creations of a live key without a deletion between them replace each other in both
    rec = read(tmp_path_factory.mktemp("replay"), *keyframes)
    assert len(rec) == len(keyframes)
    assert_same_history(rec, keyframes)


@pytest.mark.slow
@needs_real
@pytest.mark.parametrize(
    "path",
    [
        pytest.param(p, id=f"{p.parts[-3]}-{p.stem}", marks=() if k == 0 else pytest.mark.slow)
        for k, p in enumerate(sorted(HITL.glob("*/g*/*.gfx_replay.json.gz"), key=lambda p: p.stat().st_size))
    ],
)
def test_fold_of_real_sessions_agrees_with_a_slow_player(path: Path) -> None:
    keyframes = json.loads(gzip.decompress(path.read_bytes()))["keyframes"]
    assert_same_history(read_gfx_replay(path), keyframes)


# --- rules of the format ----------------------------------------------------------------------------------------------
def test_what_moves_has_a_track_and_what_does_not_is_static(tmp_path: Path) -> None:
    rec = read(
        tmp_path,
        {
            "creations": [create(0, "data/stages/home.glb", isStatic=True), create(1), create(2)],
            "stateUpdates": [update(0), update(1, 1.0), update(2, 2.0)],
        },
        {},
        {"stateUpdates": [update(1, 1.0), update(2, 3.0)], "creations": [create(7)]},
        {"deletions": [7]},
    )
    home, same, mover, visitor = rec.bodies
    assert (home.moving, same.moving, mover.moving, visitor.moving) == (-1, -1, 0, 1)
    assert rec.episode.scene == "home"
    np.testing.assert_array_equal(rec.columns["object_pose"][:, 0, 0], [2, 2, 3, 3])
    np.testing.assert_array_equal(np.isnan(rec.columns["object_pose"][:, 1, 0]), [True, True, False, True])
    np.testing.assert_array_equal(rec.columns["object_pose"][2, 1], [0, 0, 0, 0, 0, 0, 1])  # made at the origin
    np.testing.assert_array_equal(rec.columns["time_ns"], np.arange(4) * STEP_NS)


def test_keys_are_used_again_and_same_frame_pairs_cancel(tmp_path: Path) -> None:
    rec = read(
        tmp_path,
        {"creations": [create(5, "a/one.glb")], "stateUpdates": [update(5, 1.0)]},
        {
            "deletions": [5],
            "creations": [create(5, "a/two.glb"), create(6, "a/never.glb")],
            "stateUpdates": [update(5, 2.0)],
        },
        {"deletions": [6, 99], "stateUpdates": [update(42, 0.0)]},
    )
    assert [b.name for b in rec.bodies] == ["one_5", "two_5", "never_6"]
    np.testing.assert_array_equal(np.nan_to_num(rec.columns["object_pose"][:, :2, 0]), [[1, 0], [0, 2], [0, 2]])
    assert "1 deletions of instances that do not exist" in rec.episode.info["warnings"]
    assert "1 pose updates of instances that do not exist" in rec.episode.info["warnings"]
    cancelled = read(tmp_path, {"creations": [create(0), create(1)], "deletions": [1], "stateUpdates": [update(0)]})
    assert [b.name for b in cancelled.bodies] == ["thing_0"]


def test_frames_units_and_colours_come_from_loads_and_suffixes(tmp_path: Path) -> None:
    z_up = {"up": [0, 0, 1], "front": [0, 1, -0.0], "origin": [0, 0, 0]}
    phong = {"ambient": [0.7, 0, 0, 1], "diffuse": [0.7, 0, 0, 1], "specular": [0.4, 0.4, 0.4, 1]}
    rec = read(
        tmp_path,
        {
            "loads": [
                {"type": 4, "filepath": "a/b.glb", "frame": z_up, "virtualUnitToMeters": 0.01, "later": {"unknown": 1}},
                {"type": "instance_mesh", "filepath": "a/red.stl", "overridePhongMaterial": phong},
                {"type": 0, "filepath": "a/two.stl"},
                {"type": 0, "filepath": "a/two.stl", "overridePhongMaterial": phong},
            ],
            "creations": [
                create(0, "a/b.glb", scale=[1, 2, 3]),
                create(1, "a/red.stl"),
                create(2, "a/two.stl"),
                create(3, "a/two.stl?phong_amb_3657433343_dif_3657433343_spec_2863311615"),
                create(4, "cubeSolid?phong_amb_1_dif_14287103_spec_1"),
                create(5, "invalid_filepath"),
                create(6, "x/../a/unloaded.glb"),
            ],
        },
    )
    refs = {b.name: next(a for a in rec.assets if a.name == b.asset) for b in rec.bodies}
    assert [(r.uri, r.color) for r in refs.values()] == [
        ("a/b.glb", None),
        ("a/red.stl", (218, 0, 0)),
        ("a/two.stl", None),
        ("a/two.stl", (218, 0, 0)),
        ("primitive:cubeSolid", (0, 218, 0)),
        ("primitive:empty", None),
        ("a/unloaded.glb", None),
    ]
    b = refs["b_0"]
    assert (b.up, b.front, b.units_m) == ((0, 0, 1), (0, 1, 0), 0.01)
    np.testing.assert_array_equal(rec.bodies[0].scale, [1, 2, 3])
    assert len({a.name for a in rec.assets}) == len(rec.assets)
    assert any("are invisible" in w for w in rec.episode.info["warnings"])
    assert any("no load entry" in w for w in rec.episode.info["warnings"])


def test_semantic_ids_of_old_and_new_files(tmp_path: Path) -> None:
    rec = read(
        tmp_path,
        {
            "creations": [create(0), create(1), create(2)],
            "stateUpdates": [update(0, semanticId=104)],
            "metadata": [{"instanceKey": 1, "metadata": {"objectId": 1, "semanticId": 11}}],
        },
    )
    assert [b.semantic_id for b in rec.bodies] == [104, 11, 0]


def test_user_transforms_are_not_sticky_and_lights_are_kept(tmp_path: Path) -> None:
    light = {"vector": [0, -1, 0, 0], "color": [1, 1, 1], "model": "global"}
    rec = read(
        tmp_path,
        {
            "userTransforms": [{"name": "sensor_head", "transform": transform(1.0, (0, 1.0, 0, 0))}],
            "lightsChanged": True,
            "lights": [light],
        },
        {},
        {"userTransforms": [{"name": "sensor_head", "transform": transform(2.0)}], "lightsChanged": True},
    )
    column = rec.columns["user.sensor_head"]
    np.testing.assert_array_equal(np.isnan(column[:, 0]), [False, True, False])
    np.testing.assert_array_equal(column[0], [1, 0, 0, 1, 0, 0, 0])
    assert rec.episode.info["lights"] == [light]
    assert [c["step"] for c in rec.episode.info["light_changes"]] == [0, 2]
    json.dumps(dict(rec.episode.info))


def test_quaternions_become_unit_and_continuous(tmp_path: Path) -> None:
    turn = [
        update(0, q=(np.cos(a / 2) * s, 0, np.sin(a / 2) * s, 0))
        for a, s in zip(np.linspace(0, 4, 9), [1, -1, 1.001, -1, 1, 1, -0.999, 1, -1], strict=True)
    ]
    rec = read(tmp_path, {"creations": [create(0)]}, *({"stateUpdates": [t]} for t in turn))
    q = rec.columns["object_pose"][1:, 0, 3:].astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=1e-6)
    assert np.all(np.sum(q[1:] * q[:-1], 1) > 0.9)


def test_single_keyframe_gzip_rate_and_stable_uid(tmp_path: Path) -> None:
    single = write(tmp_path, {"keyframe": {"creations": [create(0)]}})
    assert len(read_gfx_replay(single)) == 1
    packed = tmp_path / "walk.gfx_replay.json.gz"
    packed.write_bytes(gzip.compress(json.dumps({"keyframes": [{}, {}, {}]}).encode()))
    rec = read_gfx_replay(packed, fps=20)
    assert rec.episode.episode_id == "walk"
    assert rec.columns["time_ns"].tolist() == [0, 50_000_000, 100_000_000]
    assert rec.episode.dt_ns == 50_000_000
    assert rec.episode.uid == read_gfx_replay(packed).episode.uid != read_gfx_replay(single).episode.uid
    assert detect(packed).name == "gfx_replay"
    for fps in (0.0, -1.0, float("nan")):
        with pytest.raises(InputError, match="H3-HABITAT-065"):
            read_gfx_replay(packed, fps=fps)


# --- agents -----------------------------------------------------------------------------------------------------------
SPOT = "data/robots/hab_spot_arm/urdf/../meshesColored/"
PERSON = "data/humanoids/humanoid_data/female_0/female_0.glb"


def test_several_agents_robots_first(tmp_path: Path) -> None:
    files = [
        PERSON,
        SPOT + "base.glb",
        SPOT + "fl.hip.glb",
        SPOT + "base.glb",
        SPOT + "fl.hip.glb",
        "data/sofa.glb",
        "data/robots/hab_stretch/meshes/base_link.dae",
        "data/robots/hab_stretch/meshes/arm.dae",
    ]
    rec = read(tmp_path, {"creations": [create(k, f) for k, f in enumerate(files)]})
    assert [(a.name, a.kind) for a in rec.agents] == [
        ("robot_0", "robot"),
        ("robot_1", "robot"),
        ("robot_2", "robot"),
        ("human", "human"),
    ]
    assert [b.agent for b in rec.bodies] == [3, 0, 0, 1, 1, -1, 2, 2]
    assert "metrics.dist_agents" not in rec.columns
    assert any("at the floor" in w for w in rec.episode.info["warnings"])


def test_base_pose_of_robot_and_person(tmp_path: Path) -> None:
    s = 0.5**0.5
    upright = (s, -s, 0.0, 0.0)  # a Spot whose mesh frame (x forward, z up) stands upright: turned by -90 deg about x
    facing_x = (s, 0.0, s, 0.0)  # a person (+Z forward) that faces +X
    lifted = update(0, 1.0, upright)
    lifted["state"]["absTransform"]["translation"][1] = 0.6
    root = update(1, 4.0, facing_x)
    root["state"]["absTransform"]["translation"][1] = 1.02
    rec = read(
        tmp_path, {"creations": [create(0, SPOT + "base.glb"), create(1, PERSON)], "stateUpdates": [lifted, root]}
    )
    np.testing.assert_allclose(rec.columns["agent_0.base_pose"][0], [1, 0.12, 0, 0, 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(rec.columns["agent_1.base_pose"][0], [4, 0.12, 0, 0, 0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(rec.columns["metrics.dist_agents"], [3.0], atol=1e-6)


def test_an_agent_that_is_away_has_no_pose(tmp_path: Path) -> None:
    rec = read(tmp_path, {}, {"creations": [create(0, PERSON)]}, {"deletions": [0]})
    np.testing.assert_array_equal(np.isnan(rec.columns["agent_0.base_pose"]).all(1), [True, False, True])


# --- real recordings --------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def session() -> Recording:
    return read_gfx_replay(SESSION)


@needs_real
def test_real_session_is_recognised(session: Recording) -> None:
    assert len(session) == 503
    assert len(session.bodies) == 352
    assert len(session.moving_bodies) == 22
    assert [(a.name, a.kind) for a in session.agents] == [("robot", "robot"), ("human", "human")]
    assert sum(b.agent == 0 for b in session.bodies) == 21
    assert [b.name for b in session.bodies if b.agent == 1] == ["human_f_344"]
    assert {b.agent for b in session.moving_bodies} == {0, 1}
    assert session.agents[1].semantic_id == 100
    assert session.episode.scene == "106879104_174887235"
    assert session.episode.info["warnings"] == []
    bowl = next(a for a in session.assets if "024_bowl" in a.uri)
    assert (bowl.name, bowl.up, bowl.front) == ("024_bowl", (0, 0, 1), (0, 1, 0))
    assert bowl.uri == "data/objects/ycb/meshes/024_bowl/google_16k/textured.glb"
    json.dumps(session.episode.info)


@needs_real
def test_real_agents_stand_on_one_floor_and_move_the_way_they_face(session: Recording) -> None:
    robot, human = (session.agent_column(i, "base_pose").astype(np.float64) for i in (0, 1))
    # both offsets of habitat-lab lead to the same floor, to the micrometre, before the person begins to walk
    assert robot[0, 1] == pytest.approx(human[0, 1], abs=1e-6)
    assert robot[0, 1] == pytest.approx(0.124385, abs=1e-5)
    assert np.ptp(robot[:, 1]) < 1e-5
    assert np.ptp(human[:, 1]) < 0.05
    for track, forward_only in ((robot, False), (human, True)):
        step = np.diff(track[:, [0, 2]], axis=0)
        length = np.linalg.norm(step, axis=1)
        along = np.sum(step * heading_direction(heading_from_quat(track[:-1, 3:])), 1)[length > 0.02]
        cosine = along / length[length > 0.02]
        assert np.median(cosine if forward_only else np.abs(cosine)) > 0.98
    dist = session.columns["metrics.dist_agents"]
    np.testing.assert_allclose(dist, np.linalg.norm(robot[:, :3] - human[:, :3], axis=1), atol=1e-5)


@needs_real
def test_real_minimal_file() -> None:
    rec = read_gfx_replay(REAL / "hitl" / "minimal.gfx_replay.json")
    assert len(rec) == 1
    assert [b.semantic_id for b in rec.bodies] == [0, 100]
    np.testing.assert_array_equal(rec.bodies[1].scale, [1, 2, 3])
    np.testing.assert_allclose(rec.bodies[1].pose[3:], [0, -0.0063939, 0, 0.99997956], atol=1e-6)


@needs_real
@pytest.mark.parametrize("name", ["room_rigid", "room_rigid_flat"])
def test_real_rigid_poses_against_the_simulators_truth(name: str) -> None:
    rec = read_gfx_replay(REPLAYS / name / "replay.gfx_replay.json")
    meta = json.loads((REPLAYS / name / "meta.json").read_text())
    bodies = {b.semantic_id - 10: b for b in rec.bodies if b.semantic_id}  # semantic ids are 10 + object id
    seen = set()
    for step, keyframe in enumerate(meta["keyframes"]):
        for truth in keyframe["rigid"]:
            body = bodies[truth["object_id"]]
            seen.add(body.name)
            w, x, y, z = truth["rotation_wxyz"]
            com = np.array([*truth["translation"], x, y, z, w])
            offset = {"chair": CHAIR_ORIGIN, "5boxes": BOXES_ORIGIN}.get(body.asset, np.zeros(3))
            expected = pose_to_matrix(pose_multiply(com, [*offset, 0, 0, 0, 1]))
            ours = pose_to_matrix(rec.columns["object_pose"][step, body.moving].astype(np.float64))
            np.testing.assert_allclose(ours, expected, atol=1e-4)
        there = {b.name for b in bodies.values() if not np.isnan(rec.columns["object_pose"][step, b.moving]).any()}
        assert there == {bodies[t["object_id"]].name for t in keyframe["rigid"]}
    assert len(seen) == 8


@needs_real
def test_real_link_poses_against_the_simulators_truth() -> None:
    """Every link that moves has a body that keeps a constant pose in it: links are COM frames, bodies visual nodes."""
    rec = read_gfx_replay(REPLAYS / "room_articulated" / "replay.gfx_replay.json")
    meta = json.loads((REPLAYS / "room_articulated" / "meta.json").read_text())
    tracks = [rec.columns["object_pose"][:, b.moving].astype(np.float64) for b in rec.moving_bodies]
    links = np.array(
        [[link["world"] for ao in k["articulated"] for link in ao["links"].values()] for k in meta["keyframes"]]
    )
    checked = 0
    for i in range(links.shape[1]):
        link = pose_from_matrix(links[:, i])
        if np.ptp(links[:, i], axis=0).max() < 0.05:
            continue
        spread = [np.ptp(pose_to_matrix(pose_multiply(pose_inverse(link), t)), axis=0).max() for t in tracks]
        checked += min(spread) < 5e-5
    assert checked >= 12


@needs_real
def test_real_user_transforms_and_rigs() -> None:
    folder = REPLAYS / "room_skinned"
    rec = read_gfx_replay(folder / "replay.gfx_replay.json")
    meta = json.loads((folder / "meta.json").read_text())
    truth = np.array([k["camera_to_world"] for k in meta["keyframes"]])
    np.testing.assert_allclose(pose_to_matrix(rec.columns["user.cam_depth_256x256"]), truth, atol=2e-6)
    assert rec.columns["rig.0"].shape == (60, 5, 7)
    assert not np.isnan(rec.columns["rig.1"]).any()
    np.testing.assert_allclose(rec.columns["rig.1"][0, 0, :3], [-1.1085004, 0.7386182, -0.9630684], atol=1e-6)
    assert [r["body"] for r in rec.episode.info["rigs"]] == ["skinned_prism_1", "skinned_prism_2"]


# --- hostile input ----------------------------------------------------------------------------------------------------
def rig(bones: int) -> dict[str, Any]:
    return {"rigUpdates": [{"id": 3, "pose": [{"t": [0, 0, 0], "r": [1, 0, 0, 0]}] * bones}]}


FRAME = {"up": [0, 1, 0], "front": [0, 1, 0]}
BROKEN: dict[str, tuple[Any, str]] = {
    "empty file": ("", "H3-FORMAT-010"),
    "not json": ("hello", r"(?s)byte\ 0.*H3-FORMAT-008"),
    "truncated": ('{"keyframes":[{"loads":[{"filepath":"a', "H3-FORMAT-009"),
    "garbage behind": ('{"keyframes":[{}]}}', r"(?s)byte\ 19.*H3-FORMAT-008"),
    "nan": ('{"keyframes":[{"deletions":[NaN]}]}', r"(?s)byte\ 28.*H3-FORMAT-012"),
    "array": ([1, 2], r"(?s)JSON\ list.*H3-HABITAT-058"),
    "number": (7, r"(?s)JSON\ int.*H3-HABITAT-058"),
    "no keyframes": ({"keyframes": []}, "H3-HABITAT-060"),
    "null keyframes": ({"keyframes": None}, "H3-HABITAT-058"),
    "keyframes no list": ({"keyframes": {"a": 1}}, "(?s)array.*H3-HABITAT-059"),
    "keyframe no object": ({"keyframes": [{}, 3]}, r"(?s)keyframe\ 1.*H3-HABITAT-059"),
    "hitl session": (
        {"session": {}, "users": [], "episodes": []},
        r"(?s)human\-in\-the\-loop\ session.*H3-HABITAT-058",
    ),
    "episodes": ({"episodes": [], "config": None}, r"(?s)episode\ dataset.*H3-HABITAT-058"),
    "other": ({"a": 1, "b": 2}, r"(?s)a,\ b.*H3-HABITAT-058"),
    "short rotation": (
        {"keyframes": [{}, {"stateUpdates": [update(1), update(17, q=(1, 0, 0))]}]},
        r"(?s)keyframe\ 1,\ stateUpdates,\ instance\ 17.*H3-HABITAT-059",
    ),
    "long translation": (
        {
            "keyframes": [
                {
                    "stateUpdates": [
                        {
                            "instanceKey": 4,
                            "state": {"absTransform": {"translation": [1, 2, 3, 4], "rotation": [1, 0, 0, 0]}},
                        }
                    ]
                }
            ]
        },
        r"(?s)instance\ 4.*H3-HABITAT-059",
    ),
    "text in translation": (
        {
            "keyframes": [
                {
                    "stateUpdates": [
                        {
                            "instanceKey": 4,
                            "state": {"absTransform": {"translation": ["x", 2, 3], "rotation": [1, 0, 0, 0]}},
                        }
                    ]
                }
            ]
        },
        r"(?s)instance\ 4.*H3-HABITAT-059",
    ),
    "infinite": (
        '{"keyframes":[{"stateUpdates":[{"instanceKey":9,"state":{"absTransform":{"translation":[1e999,0,0],'
        '"rotation":[1,0,0,0]}}}]}]}',
        "(?s)range.*H3-HABITAT-059",
    ),
    "zero rotation": (
        {"keyframes": [{"creations": [create(2)]}, {"stateUpdates": [update(2, q=(0, 0, 0, 0))]}]},
        r"(?s)keyframe\ 1,\ stateUpdates,\ instance\ 2.*H3-HABITAT-066",
    ),
    "zero user rotation": (
        {"keyframes": [{"userTransforms": [{"name": "cam", "transform": transform(q=(0, 0, 0, 0))}]}]},
        "(?s)'cam'.*H3-HABITAT-066",
    ),
    "negative key": ({"keyframes": [{"creations": [create(-3)]}]}, r"(?s)instance\ \-3.*H3-HABITAT-059"),
    "negative deletion": ({"keyframes": [{"deletions": [-1]}]}, "(?s)deletions.*H3-HABITAT-059"),
    "text key": (
        {"keyframes": [{"creations": [{"instanceKey": "a", "creation": {"filepath": "x"}}]}]},
        r"(?s)instance\ a.*H3-HABITAT-059",
    ),
    "no filepath": (
        {"keyframes": [{"creations": [{"instanceKey": 1, "creation": {}}]}]},
        "(?s)filepath.*H3-HABITAT-059",
    ),
    "bones": ({"keyframes": [rig(2), rig(3)]}, r"(?s)rig\ 3\ has\ 2\ bones.*H3-HABITAT-056"),
    "axes": (
        {"keyframes": [{"loads": [{"filepath": "x.glb", "frame": FRAME}], "creations": [create(0, "x.glb")]}]},
        "(?s)perpendicular.*H3-HABITAT-067",
    ),
    "twice": ('{"keyframes":[{"deletions":[-1],"deletions":3}]}', r"(?s)keyframe\ 0,\ deletions.*H3-HABITAT-059"),
    "lists": ({"keyframes": [{"creations": 5}]}, r"(?s)keyframe\ 0,\ creations.*H3-HABITAT-059"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_files_give_one_clear_line(case: str, tmp_path: Path) -> None:
    content, expected = BROKEN[case]
    path = write(tmp_path, content)
    with pytest.raises(FormatError, match=expected) as caught:
        read_gfx_replay(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
    assert len(str(caught.value)) < 600 + len(str(path))


def test_missing_files_folders_and_damaged_gzip(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="H3-FORMAT-013"):
        read_gfx_replay(tmp_path / "x.json")
    with pytest.raises(InputError, match="H3-FORMAT-014"):
        read_gfx_replay(tmp_path)
    data = gzip.compress(json.dumps({"keyframes": [{}] * 100}).encode())
    (tmp_path / "cut.json.gz").write_bytes(data[:-9])
    with pytest.raises(FormatError, match="H3-FORMAT-017"):
        read_gfx_replay(tmp_path / "cut.json.gz")
    (tmp_path / "log.mcap").write_bytes(b"\x89MCAP0\r\n" + b"\0" * 50)
    with pytest.raises(FormatError, match=r"(?s)mcap.*H3-FORMAT-011"):
        read_gfx_replay(tmp_path / "log.mcap")


@needs_real
def test_real_session_cut_anywhere_never_crashes(tmp_path: Path) -> None:
    data = SESSION.read_bytes()
    for cut in (1, 100, 12345, len(data) // 2, len(data) - 1):
        path = tmp_path / "cut.gfx_replay.json"
        path.write_bytes(data[:cut])
        with pytest.raises(FormatError, match="H3-FORMAT-009"):
            read_gfx_replay(path)


# --- detection --------------------------------------------------------------------------------------------------------
DATASET_0 = "habitat-sim/data/test_assets/dataset_tests/dataset_0"


@needs_real
@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ("hitl/my_session.gfx_replay.json", "gfx_replay"),
        ("habitat-lab/demo.json.gz", "rearrange_episodes"),
        ("habitat-lab/hitl_teleop_episodes.json.gz", "rearrange_episodes"),
        ("habitat-lab/reference/hitl/session_2users/gen2/session.json.gz", "hitl_session"),
        ("habitat-lab/reference/hitl/session_2users/gen2/10.json.gz", "hitl_episode"),
        ("habitat-lab/reference/hitl/session_2users/gen1/session.0.json.gz", "hitl_log"),
        ("habitat-lab/reference/hitl/session_2users/gen1/session.0.pkl.gz", "pickle"),
        (f"{DATASET_0}/test_dataset_0.scene_dataset_config.json", "scene_dataset_config"),
        (f"{DATASET_0}/scenes/dataset_test_scene.scene_instance.json", "scene_instance"),
        ("habitat-sim/data/test_assets/scenes/simple_room.stage_config.json", "stage_config"),
        ("habitat-sim/data/test_assets/objects/chair.object_config.json", "object_config"),
        ("habitat-sim/data/test_assets/urdf/skinned_prism.ao_config.json", "ao_config"),
        ("habitat-sim/data/test_assets/lights/test_lights.lighting_config.json", "lighting_config"),
        ("habitat-sim/data/test_assets/semantic/test_regions.semantic_config.json", "semantic_config"),
        ("habitat-sim/data/test_assets/objects/chair.glb", "glb"),
        ("habitat-sim/reference/navmesh/simple_room_6chairs/simple_room_6chairs.navmesh", "navmesh"),
        ("habitat-sim/LICENSE", "unknown"),
    ],
)
def test_formats_of_real_files_are_detected(path: str, kind: str) -> None:
    if not (REAL / path).exists():
        pytest.skip(f"{path} is not on this machine")
    assert detect(REAL / path).name == kind
