"""The third_person camera: whom it follows is seen at every step, from a place that moves smoothly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from h3data.errors import InputError
from h3data.geometry import normalized
from h3data.recording import Agent, AssetRef, Body, Episode, Recording
from h3data.recording.assets.library import AssetLibrary
from h3data.replay import CameraTrack, Replay, camera_at, camera_names, camera_track
from h3data.replay.sight import Fan, Sight, reach_of
from h3data_habitat.gfx.replay import read_gfx_replay
from h3data_habitat.hitl.paper_logs import read_hitl_log
from h3data_habitat.hitl.sessions import read_hitl_episode
from h3data_homes import HomeSpec, build_home
from sim_kinematic.motion.spec import SocialNavSpec, WalkerSpec
from tests.simulated import simulate_social_nav, social_nav_episode

FASTER_MPS = 5.5
"""The camera moves at most so much faster than the agent."""
SEEN_PX = 60
"""Of 160x120."""
PERSON_M = 0.35
"""A person hides what is less than this beside their middle."""
DT = 1 / 30
HITL = "habitat-lab/reference/hitl"


def seen_px(replay: Replay, stride: int) -> np.ndarray:
    """Pixels of the followed agent, number 0, in small pictures."""
    track = camera_track(replay, "third_person")
    large = track.camera
    camera = replace(large, width=160, height=120, fx=large.fx / 4, fy=large.fy / 4, cx=80.0, cy=60.0)
    small = CameraTrack(camera=camera, poses=track.poses, nears=track.nears)
    owner = np.append([d.agent for d in replay.drawables], -1)
    frames = replay.frames([small], range(0, len(replay), stride), outputs=("instance",))
    return np.array([(owner[picture["instance"]] == 0).sum() for _, (picture,) in frames])


def is_behind_the_other(replay: Replay, stride: int) -> np.ndarray:
    """True at the steps at which agent 1 is between the camera and agent 0."""
    eye = camera_track(replay, "third_person").poses[::stride, :3, 3]
    robot, person = (replay.recording.agent_column(k, "base_pose")[::stride, :3].astype(float) for k in (0, 1))
    sight, passed = (robot - eye)[:, (0, 2)], (person - eye)[:, (0, 2)]
    far = np.linalg.norm(sight, axis=1)
    along = (sight * passed).sum(1) / far
    beside = np.abs(sight[:, 0] * passed[:, 1] - sight[:, 1] * passed[:, 0]) / far
    return (along > 0) & (along < far) & (beside < PERSON_M)


def speed_past_agent(replay: Replay) -> float:
    """How fast the camera moves at most seen from the agent [m/s]."""
    eye = camera_track(replay, "third_person").poses[:, :3, 3]
    offset = eye - replay.recording.agent_column(0, "base_pose")[:, :3]
    return float(np.linalg.norm(np.diff(offset, axis=0), axis=1).max() / DT)


def share_of_the_other(replay: Replay, *, within_m: float) -> float:
    """Share of the steps at which the person, who is near the robot, has their chest in the picture."""
    track = camera_track(replay, "third_person")
    robot, person = (replay.recording.agent_column(k, "base_pose")[:, :3].astype(float) for k in (0, 1))
    near = np.flatnonzero(np.linalg.norm(robot - person, axis=1) < within_m)
    found = [track.at(step).project(person[[step]] + (0.0, 1.1, 0.0)) for step in near]
    size = track.camera.width, track.camera.height
    return float(np.mean([depth[0] > 0 and ((pixel > 0) & (pixel < size)).all() for pixel, depth in found]))


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in range(1, 10))])
def test_the_agent_is_seen_in_generated_homes(seed: int) -> None:
    spec = SocialNavSpec(max_steps=150, spawn_distance_m=3.0, human=WalkerSpec(speed_mps=1.0))
    replay = Replay(simulate_social_nav(social_nav_episode(build_home(HomeSpec(seed=seed)), seed=seed, spec=spec)))
    # the person may walk through the line of sight, and is drawn whole then
    assert ((seen_px(replay, 3) > SEEN_PX) | is_behind_the_other(replay, 3)).all()
    assert (seen_px(replay, 3) > SEEN_PX).mean() > 0.9
    assert speed_past_agent(replay) < FASTER_MPS
    assert share_of_the_other(replay, within_m=2.5) > 0.6
    heights = camera_track(replay, "third_person").poses[:, 1, 3]
    assert heights.max() < 2.5, "it stays below the ceiling, which is drawn"


@pytest.mark.parametrize(
    "name",
    [
        f"{HITL}/session_1user_policy/gen2/10.json.gz",
        f"{HITL}/session_2users/gen1/session.0.pkl.gz",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in (
                f"{HITL}/session_1user_policy/gen2/11.json.gz",
                f"{HITL}/session_2users/gen1/session.1.pkl.gz",
                f"{HITL}/session_2users/gen2/10.json.gz",
                f"{HITL}/session_2users/gen2/11.json.gz",
                "hitl/my_session.gfx_replay.json",
            )
        ),
    ],
)
def test_the_agent_is_seen_in_recorded_sessions(real: Path, name: str) -> None:
    """In homes without rooms, whose walls are known by their meshes alone."""
    assets = AssetLibrary([real / "habitat-sim", real / "habitat-lab" / "reference" / "navmesh"])
    path = real / name
    if ".gfx_replay." in name:
        recording = read_gfx_replay(path)
    else:
        recording = (read_hitl_log if name.endswith(".pkl.gz") else read_hitl_episode)(path, assets=assets)
    replay = Replay(recording, assets=assets)
    assert (seen_px(replay, 4) > SEEN_PX).mean() > 0.99
    assert speed_past_agent(replay) < FASTER_MPS


def box(name: str, center: tuple[float, float, float], size: tuple[float, float, float]) -> Body:
    pose = np.array([*center, 0, 0, 0, 1], np.float32)
    return Body(name=name, asset="box", pose=pose, scale=np.array(size, np.float32))


def robot_among(bodies: tuple[Body, ...], way: np.ndarray) -> Replay:
    """A robot, drawn by its model, at rest on the floor points ``way`` [T, 2] among boxes."""
    still = simulate_social_nav(
        social_nav_episode(build_home(HomeSpec(seed=2)), seed=2, spec=SocialNavSpec(max_steps=len(way)))
    )
    columns = {name: still.columns[name] for name in ("time_ns", "agent_0.joint_pos")}
    base = np.zeros((len(way), 7), np.float32)
    base[:, [0, 2]], base[:, 6] = way, 1
    return Replay(
        Recording(
            episode=Episode(uid="u", episode_id="boxes", task="none", scene="none"),
            assets=(AssetRef(name="box", uri="primitive:box"),),
            bodies=bodies,
            agents=still.agents[:1],
            columns={**columns, "agent_0.base_pose": base},
        )
    )


def test_it_finds_the_one_open_side() -> None:
    """Boxed in on three sides, the line of sight goes out by the fourth."""
    walls = (
        box("left", (0, 1.5, -0.8), (6, 3, 0.1)),
        box("right", (0, 1.5, 0.8), (6, 3, 0.1)),
        box("back", (-0.9, 1.5, 0), (0.1, 3, 6)),
        box("roof", (0, 3, 0), (6, 0.1, 6)),
    )
    replay = robot_among(walls, np.zeros((20, 2)))
    eye = camera_track(replay, "third_person").poses[:, :3, 3]
    assert (eye[:, 0] > 1.5).all()
    assert (np.abs(eye[:, 2]) < 0.75).all()
    assert seen_px(replay, 5).min() > SEEN_PX


@pytest.mark.parametrize(("at_m", "cut"), [(1.2, False), (2.0, True)])
def test_somebody_who_walks_by_is_cut_only_around_the_camera(at_m: float, cut: bool) -> None:
    """A near plane through a body in the middle of the line of sight would leave a foot and take away the floor."""
    sides = tuple(
        box(name, center, size)
        for name, center, size in (
            ("left", (0, 1.5, -0.8), (6, 3, 0.1)),
            ("right", (0, 1.5, 0.8), (6, 3, 0.1)),
            ("back", (-0.9, 1.5, 0), (0.1, 3, 6)),
        )
    )
    alone = robot_among(sides, np.zeros((60, 2))).recording
    walk = np.zeros((60, 7), np.float32)
    walk[:, 0], walk[:, 2], walk[:, 6] = at_m, np.linspace(-2, 2, 60), 1
    person = Agent(name="person", kind="human")
    columns = {**alone.columns, "agent_1.base_pose": walk}
    track = camera_track(Replay(replace(alone, agents=(*alone.agents, person), columns=columns)), "third_person")
    assert (track.nears is not None) == cut
    assert track.nears is None or track.nears.max() < 0.8


def test_what_is_too_near_is_cut_away() -> None:
    """Where nothing within reach is free, the box around the robot is cut open."""
    walls = tuple(
        box(name, center, size)
        for name, center, size in (
            ("x-", (-0.7, 1, 0), (0.1, 3, 6)),
            ("x+", (0.7, 1, 0), (0.1, 3, 6)),
            ("z-", (0, 1, -0.7), (6, 3, 0.1)),
            ("z+", (0, 1, 0.7), (6, 3, 0.1)),
            ("roof", (0, 1.2, 0), (6, 0.1, 6)),
        )
    )
    replay = robot_among(walls, np.zeros((20, 2)))
    track = camera_track(replay, "third_person")
    assert track.nears is not None
    assert (track.nears > 0.1).all()
    assert seen_px(replay, 5).min() > SEEN_PX
    uncut = replace(track, nears=None)
    owner = np.append([d.agent for d in replay.drawables], -1)
    for _, (picture,) in replay.frames([uncut], [10], outputs=("instance",)):
        assert not (owner[picture["instance"]] == 0).any()


def test_it_cuts_where_the_agent_jumps_and_only_there() -> None:
    way = np.zeros((40, 2))
    way[20:] = (8.0, 3.0)
    eye = camera_track(robot_among((), way), "third_person").poses[:, :3, 3]
    step = np.linalg.norm(np.diff(eye, axis=0), axis=1)
    assert step[19] > 5
    assert np.delete(step, 19).max() < FASTER_MPS * DT


def test_a_lone_person_is_followed_without_meshes() -> None:
    base = np.zeros((10, 7), np.float32)
    base[:, 6] = 1
    base[3:5] = np.nan  # not there for two steps
    recording = Recording(
        episode=Episode(uid="u", episode_id="p", task="none", scene="none"),
        agents=(Agent(name="p", kind="human"),),
        columns={"time_ns": np.arange(1, 11, dtype=np.int64) * 33_333_333, "agent_0.base_pose": base},
    )
    track = camera_track(Replay(recording), "third_person")
    assert np.isfinite(track.poses).all()
    pixels, depth = track.at(5).project([[0.0, 1.25, 0.0]])
    np.testing.assert_allclose(pixels, [[320, 240]], atol=2)
    assert 2 < depth[0] < 3


def test_one_step_alone_is_that_of_the_whole_track() -> None:
    way = np.cumsum(np.full((150, 2), (0.03, 0.01)), axis=0)
    way[60:] += (5.0, 2.0)  # a cut
    post = box("post", (1.5, 1, 1.4), (0.5, 3, 0.5))
    replay = robot_among((post, box("wall", (8.0, 1.5, 0), (0.1, 3, 8))), way)
    track = camera_track(replay, "third_person")
    for step in (0, 1, 29, 58, 59, 60, 61, 100, 149, -1):
        alone, expected = camera_at(replay, "third_person", step), track.at(step % 150)
        np.testing.assert_array_equal(alone.pose, expected.pose)
        assert (alone.near, alone.name, alone.hidden_layers) == (expected.near, expected.name, expected.hidden_layers)
    np.testing.assert_array_equal(camera_at(replay, "orbit", -1).pose, camera_track(replay, "orbit").poses[149])
    with pytest.raises(InputError, match=r"(?s)150.*H3-REPLAY-019"):
        camera_at(replay, "third_person", 150)


def test_an_agent_by_name_is_followed_instead_of_the_robot() -> None:
    recording = simulate_social_nav(
        social_nav_episode(build_home(HomeSpec(seed=1)), seed=1, spec=SocialNavSpec(max_steps=40))
    )
    replay, (robot, person) = Replay(recording), (agent.name for agent in recording.agents)
    assert f"{person}/third_person" in camera_names(replay)
    assert f"{robot}/third_person" not in camera_names(replay)  # that is third_person
    track = camera_track(replay, f"{person}/third_person")
    assert track.camera.name == f"{person}.third_person"
    alone = camera_at(replay, f"{person}/third_person", 20)
    np.testing.assert_allclose(alone.pose, track.poses[20], atol=1e-6)
    heads = recording.agent_column(1, "base_pose")[:, :3] + (0.0, 1.25, 0.0)
    for step in (0, 20, 39):
        (pixel,), (depth,) = track.at(step).project(heads[[step]])
        assert np.all(np.abs(pixel - (320, 240)) < 200)
        assert 0.5 < depth < 3
    np.testing.assert_array_equal(
        camera_track(replay, f"{robot}/third_person").poses, camera_track(replay, "third_person").poses
    )
    with pytest.raises(InputError, match=r"(?s)'nobody/third_person'.*H3-REPLAY-017"):
        camera_track(replay, "nobody/third_person")


@pytest.mark.slow  # quick: one step of a short one
def test_one_step_of_a_long_recording_is_found_from_those_around_it() -> None:
    turn = np.linspace(0, 9, 900)
    way = np.stack([4 * np.cos(turn) + turn, 3 * np.sin(2 * turn)], axis=1)
    posts = tuple(
        box(f"post {k}", (x, 1, z), (0.6, 3, 0.6)) for k, (x, z) in enumerate(way[40::130] + np.array([0.9, 0.4]))
    )
    replay = robot_among(posts, way)
    poses = camera_track(replay, "third_person").poses
    for step in (0, 250, 400, 655, 899):
        np.testing.assert_allclose(camera_at(replay, "third_person", step).pose, poses[step], atol=1e-3)


def test_what_is_beyond_the_boom_changes_no_free_line() -> None:
    around = [((3.0 * np.cos(a), 1.5, 3.0 * np.sin(a)), k) for k, a in enumerate(np.linspace(0, 6, 9))]
    bodies = tuple(box(f"post_{k}", center, (0.3 + 0.2 * k, 3.0, 0.3)) for center, k in around)
    sight = Sight(robot_among(bodies, np.zeros((2, 2))))
    rng = np.random.default_rng(2)
    directions = normalized(rng.uniform([-1, -0.6, -1], [1, 0.6, 1], (64, 3)) + 1e-3)
    fan = Fan(sight, directions)
    for reach_m in rng.uniform(1.5, 4.0, 8):
        whole, near = (sight.around(np.array([0.0, 1.2, 0.0]), far) for far in (np.inf, reach_of(reach_m)))
        np.testing.assert_array_equal(fan.free(near, reach_m), fan.free(whole, reach_m))
        assert np.isinf(near).sum() > np.isinf(whole).sum()
