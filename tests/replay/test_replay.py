"""Replay: what was recorded is where it was, from any camera, with any number of threads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import h3data
from h3data.bodies import load_robot
from h3data.errors import InputError
from h3data.geometry import transform_points
from h3data.recording import Agent, AssetRef, Body, Episode, Recording
from h3data.replay import Replay, camera_names, camera_track, posed_recording
from h3data.replay.cameras import CUT_M
from h3data.scene import Asset, FreeSpace, Instance, Mesh
from h3data.scene.records import instance_matrix
from h3data.scene.scene_file import scene_bytes
from h3data_homes import HomeSpec, build_home
from sim_kinematic.motion.spec import SocialNavSpec, WalkerSpec
from tests.simulated import simulate_social_nav, social_nav_episode


@pytest.fixture(scope="module")
def recording() -> Recording:
    spec = SocialNavSpec(max_steps=200, spawn_distance_m=3.0, human=WalkerSpec(speed_mps=1.0))
    return simulate_social_nav(social_nav_episode(build_home(HomeSpec(seed=2)), seed=2, spec=spec))


@pytest.fixture(scope="module")
def replay(recording: Recording) -> Replay:
    return Replay(recording)


def boxes() -> Recording:
    """Three cubes: one stands, one moves up, one leaves the world in the second half."""
    steps = 20
    poses = np.zeros((steps, 2, 7), np.float32)
    poses[..., 6] = 1
    poses[:, 0, 1] = np.arange(steps) * 0.1
    poses[:, 1, 0] = 3
    poses[10:, 1] = np.nan
    return Recording(
        episode=Episode(uid="u", episode_id="boxes", task="none", scene="none"),
        assets=(AssetRef(name="cube", uri="primitive:cubeSolid"), AssetRef(name="lost", uri="data/objects/lost.glb")),
        bodies=(
            Body(name="stands", asset="cube", pose=np.array([-3, 0, 0, 0, 0, 0, 1], np.float32)),
            Body(name="rises", asset="cube", pose=poses[0, 0], moving=0, scale=np.full(3, 0.5, np.float32)),
            Body(name="leaves", asset="lost", pose=poses[0, 1], moving=1),
        ),
        columns={"time_ns": np.arange(1, steps + 1, dtype=np.int64) * 33_333_333, "object_pose": poses},
    )


def test_poses_are_the_recorded_ones(recording: Recording, replay: Replay) -> None:
    state = replay.at(100)
    np.testing.assert_allclose(state.agents["robot"]["base_pose"], recording.columns["agent_0.base_pose"][100])
    still = recording.bodies[5]
    np.testing.assert_allclose(state.poses[still.name][:3, 3], still.pose[:3], atol=1e-6)
    assert state.time_s == pytest.approx(101 / 30, abs=1e-3)


def test_links_worked_out_in_blocks_are_those_worked_out_at_once(recording: Recording, monkeypatch) -> None:
    robot, poses = load_robot("quad_arm"), Replay(recording, stepping=False)
    base, joints = (recording.agent_column(0, name) for name in ("base_pose", "joint_pos"))
    expected = robot.link_matrices(base, joints).astype(np.float32)
    monkeypatch.setattr(posed_recording, "BLOCK_STEPS", 7)
    monkeypatch.setattr(posed_recording, "BLOCKS_KEPT", 2)
    for steps in (None, np.arange(200), np.array([13]), np.array([-1, 0, 41, 6, 7, 7, 199]), np.zeros(0, np.intp)):
        rows = slice(None) if steps is None else steps
        np.testing.assert_array_equal(poses.link_matrices(0, steps), expected[rows])
        np.testing.assert_array_equal(poses.link_track(0, 3, steps), expected[rows, 3])
    with pytest.raises(IndexError):
        poses.link_matrices(0, np.array([200]))
    with pytest.raises(InputError, match="H3-REPLAY-024"):
        poses.link_matrices(1)


def test_steps_outside_are_refused(replay: Replay) -> None:
    with pytest.raises(InputError, match=r"(?s)200.*H3-REPLAY-019"):
        replay.at(200)
    assert replay.at(-1).step == 199
    with pytest.raises(InputError, match=r"(?s)200.*H3-REPLAY-019"):
        next(iter(replay.frames([camera_track(replay, "top_down")], [5, 200])))
    with pytest.raises(InputError, match=r"(?s)-300.*H3-REPLAY-019"):
        h3data.render_frame(replay, step=-300)


def test_the_person_stands_on_the_floor_all_along(replay: Replay) -> None:
    index = next(i for i, d in enumerate(replay.drawables) if d.deformable)
    vertices = replay.vertices(index, np.arange(0, 200, 10))
    lowest = vertices[..., 1].min(1)
    assert lowest.min() > -0.03
    assert lowest.max() < 0.05
    assert vertices[..., 1].max(1).min() > 1.4


def test_bodies_that_leave_are_gone(replay: Replay) -> None:
    del replay
    r = Replay(boxes())
    assert set(r.at(5).poses) == {"stands", "rises", "leaves"}
    assert set(r.at(15).poses) == {"stands", "rises"}
    assert r.at(15).poses["rises"][1, 3] == pytest.approx(1.5, abs=1e-6)
    assert r.at(15).poses["rises"][0, 0] == pytest.approx(0.5)
    track = camera_track(r, "top_down")
    (_, before), (_, after) = r.frames([track], [5, 15], outputs=("instance",))
    assert set(np.unique(before[0]["instance"])) == {-1, 0, 1, 2}
    assert set(np.unique(after[0]["instance"])) == {-1, 0, 1}


def test_missing_assets_are_counted_and_drawn() -> None:
    r = Replay(boxes())
    assert r.missing == {"data/objects/lost.glb": 1}
    assert [d.placeholder for d in r.drawables] == [False, False, True]


def test_threads_draw_the_same(replay: Replay) -> None:
    tracks = [camera_track(replay, "robot_arm"), camera_track(replay, "top_down")]
    steps = list(range(0, 60, 7))
    one = list(replay.frames(tracks, steps, outputs=("rgb", "depth", "instance")))
    two = list(replay.frames(tracks, steps, outputs=("rgb", "depth", "instance"), threads=3))
    assert [s for s, _ in one] == [s for s, _ in two] == steps
    for (_, a), (_, b) in zip(one, two, strict=True):
        for view_a, view_b in zip(a, b, strict=True):
            for name, image in view_a.items():
                np.testing.assert_array_equal(image, view_b[name])


def test_stopping_early_is_allowed(replay: Replay) -> None:
    frames = replay.frames([camera_track(replay, "robot_arm")], range(50), threads=2)
    assert next(iter(frames))[0] == 0
    frames.close()  # type: ignore[attr-defined]


def test_everybody_is_seen_from_above(replay: Replay) -> None:
    agents = np.array([d.agent for d in replay.drawables])
    _, (view,) = next(iter(replay.frames([camera_track(replay, "top_down")], [150], outputs=("instance", "rgb"))))
    seen = set(agents[view["instance"][view["instance"] >= 0]])
    assert seen == {-1, 0, 1}
    ceiling = [i for i, d in enumerate(replay.drawables) if d.layer == "ceiling"]
    assert ceiling
    assert not np.isin(view["instance"], ceiling).any()


def test_the_robot_does_not_look_at_itself(replay: Replay) -> None:
    agents = np.array([d.agent for d in replay.drawables])
    for _, (view,) in replay.frames(
        [camera_track(replay, "robot_arm")], range(0, 200, 20), outputs=("instance", "depth")
    ):
        hit = view["instance"] >= 0
        assert not (agents[view["instance"][hit]] == 0).any()
        assert view["depth"].shape == (171, 224)


def test_the_trailing_camera_stays_out_of_walls(replay: Replay) -> None:
    track = camera_track(replay, "third_person")
    assert replay.scene is not None
    walls = FreeSpace.from_scene(replay.scene, radius_m=0.1, height_m=2.0, max_climb_m=1.3, cache=False)
    eyes = track.poses[:, [0, 2], 3]
    assert (walls.signed_distance(eyes) > 0.03).mean() > 0.99
    assert np.linalg.norm(np.diff(track.poses[:, :3, 3], axis=0), axis=1).max() < 0.25  # no jumps


def test_unknown_cameras_are_listed(replay: Replay) -> None:
    names = camera_names(replay)
    assert {"top_down", "third_person", "robot_arm"} <= set(names)
    with pytest.raises(InputError, match=r"(?s)robot_arm.*H3-REPLAY-017"):
        camera_track(replay, "sky")


def test_recordings_without_agents_have_a_view_from_above() -> None:
    r = Replay(boxes())
    assert camera_names(r) == ["top_down", "top_down_orthographic", "orbit"]
    with pytest.raises(InputError):
        camera_track(r, "third_person")


def test_an_agent_without_a_model_needs_none() -> None:
    b = boxes()
    base = np.zeros((20, 7), np.float32)
    base[:, 6] = 1
    rec = Recording(
        episode=b.episode,
        assets=b.assets,
        bodies=b.bodies,
        agents=(Agent(name="r", kind="robot"),),
        columns={**b.columns, "agent_0.base_pose": base},
    )
    assert camera_track(Replay(rec), "third_person").poses.shape == (20, 4, 4)


def test_things_of_one_mesh_share_it() -> None:
    stage = Replay(boxes()).stage
    meshes = [instance.mesh for instance in stage.scene.instances]
    assert meshes[0] == meshes[1] != meshes[2]


def one_mesh_home() -> Recording:
    """A person in a home whose walls, floor, furniture and ceiling are one mesh, as scans and HSSD's stages are."""
    home = build_home(HomeSpec(seed=1))
    recording = simulate_social_nav(social_nav_episode(home, seed=5, spec=SocialNavSpec(max_steps=10)))
    meshes = []
    for instance in home.instances:
        mesh, matrix = home.assets[instance.asset].mesh, instance_matrix(instance)
        meshes.append(
            Mesh(
                vertices=transform_points(matrix, mesh.vertices).astype(np.float32),
                faces=mesh.faces,
                colors=mesh.colors,
            )
        )
    offsets = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    stage = Mesh(
        vertices=np.concatenate([m.vertices for m in meshes]),
        faces=np.concatenate([m.faces + k for m, k in zip(meshes, offsets, strict=False)]).astype(np.int32),
        colors=np.concatenate([m.colors for m in meshes]),
    )
    scene = replace(
        home,
        assets={"stage": Asset(name="stage", mesh=stage)},
        rooms=(),
        instances=(Instance(name="stage", asset="stage", pose=np.array([0, 0, 0, 0, 0, 0, 1.0])),),
    )
    body = Body(name="stage", asset="stage", pose=np.array([0, 0, 0, 0, 0, 0, 1], np.float32))
    return replace(
        recording,
        assets=(AssetRef(name="stage", uri="scene:stage"),),
        bodies=(body,),
        attachments={"scene.glb": scene_bytes(scene)},
    )


@pytest.mark.parametrize("name", ["top_down", "top_down_orthographic"])
def test_views_from_above_cut_the_ceiling_of_a_stage_of_one_mesh(name: str) -> None:
    replay = Replay(one_mesh_home(), detail=False)
    track = camera_track(replay, name)
    ((_, (picture,)),) = replay.frames([track], [5], outputs=("depth", "instance"))
    eye = track.poses[0][1, 3]
    assert (eye - picture["depth"][picture["depth"] > 0]).max() <= CUT_M + 0.05
    agents = {k for k, drawable in enumerate(replay.drawables) if drawable.agent >= 0}
    assert agents & set(np.unique(picture["instance"]).tolist()), "people and robots are seen from above"
