"""Camera files and presets: every way to place a camera, in TOML and JSON, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from h3data.errors import InputError
from h3data.geometry import pose_to_matrix
from h3data.recording import Recording
from h3data.render import OPENGL_TO_OPENCV, look_at
from h3data.replay import Replay, camera_names, camera_track
from h3data_homes import HomeSpec, build_home
from sim_kinematic.motion.spec import SocialNavSpec, WalkerSpec
from tests.simulated import simulate_social_nav, social_nav_episode

STEPS = 60


@pytest.fixture(scope="module")
def replay() -> Replay:
    spec = SocialNavSpec(max_steps=STEPS, spawn_distance_m=3.0, human=WalkerSpec(speed_mps=1.0))
    recording: Recording = simulate_social_nav(social_nav_episode(build_home(HomeSpec(seed=2)), seed=2, spec=spec))
    return Replay(recording)


def track(replay: Replay, folder: Path, text: str | dict):
    path = folder / ("camera.json" if isinstance(text, dict) else "camera.toml")
    path.write_text(json.dumps(text) if isinstance(text, dict) else text)
    return camera_track(replay, str(path))


def test_a_pose_in_every_convention_is_the_same_camera(replay, tmp_path):
    ours = look_at([1, 2, 3], [0, 1, 0])
    habitat = ours @ OPENGL_TO_OPENCV
    for convention, matrix in (("opencv", ours), ("opengl", habitat), ("habitat", habitat)):
        found = track(
            replay, tmp_path, {"pose": matrix.tolist(), "convention": convention, "hfov_deg": 55, "width": 80}
        )
        np.testing.assert_allclose(found.poses, ours[None], atol=1e-12)
        assert found.camera.hfov_deg == pytest.approx(55)
    pose7 = track(
        replay, tmp_path, "pose = [1, 2, 3, 0, 0, 0, 1]\nintrinsics = [300, 310, 20, 30]\nnear = 0.2\nfar = 9.0"
    )
    np.testing.assert_allclose(pose7.poses[0, :3, 3], [1, 2, 3])
    camera = pose7.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.near, camera.far) == (300, 310, 20, 30, 0.2, 9.0)


@pytest.mark.parametrize(("agent", "link"), [("robot", "arm_hand"), ("human", "left_wrist"), ("human", "head")])
def test_a_mounted_camera_moves_with_its_link(replay, tmp_path, agent, link):
    found = track(replay, tmp_path, f'follow = "{agent}"\nlink = "{link}"\neye = [0.1, 0, 0]\ntarget = [1, 0, 0]')
    index = [a.name for a in replay.recording.agents].index(agent)
    model = replay.model(index)
    if agent == "robot":
        frames = replay.link_matrices(index)[:, [part.name for part in model.links].index(link)]  # type: ignore[union-attr]
    else:
        from h3data.bodies import JOINT_NAMES

        frames = replay.joint_matrices(index, np.arange(STEPS))[:, list(JOINT_NAMES).index(link)]
    assert found.poses.shape == (STEPS, 4, 4)
    np.testing.assert_allclose(found.poses, frames.astype(np.float64) @ look_at([0.1, 0, 0], [1, 0, 0]), atol=1e-5)


def test_a_camera_on_a_body_ignores_its_scale(replay, tmp_path):
    moving = next(d for d in replay.drawables if d.moving and not d.deformable)
    found = track(replay, tmp_path, {"body": moving.name, "eye": [0, 0, 0.5], "target": [0, 0, 1]})
    np.testing.assert_allclose(np.linalg.det(found.poses[:, :3, :3]), 1, atol=1e-5)
    matrices = replay.matrices(replay.drawables.index(moving))
    distance = np.linalg.norm(found.poses[:, :3, 3] - matrices[:, :3, 3], axis=1)
    np.testing.assert_allclose(distance, 0.5, atol=1e-5)


def test_following_turns_or_keeps_its_direction_and_can_be_smooth(replay, tmp_path):
    place = 'follow = "robot"\neye = [-2, 1.5, 0]\ntarget = [0, 0.5, 0]\n'
    base = replay.recording.agent_column(0, "base_pose").astype(np.float64)
    turning = track(replay, tmp_path, place)
    np.testing.assert_allclose(turning.poses, pose_to_matrix(base) @ look_at([-2, 1.5, 0], [0, 0.5, 0]), atol=1e-9)
    straight = track(replay, tmp_path, place + "turns = false")
    assert np.ptp(straight.poses[:, :3, :3], axis=0).max() < 1e-9
    np.testing.assert_allclose(straight.poses[:, :3, 3] - base[:, :3], np.tile([-2, 1.5, 0], (STEPS, 1)), atol=1e-6)
    smooth = track(replay, tmp_path, place + "turns = false\nsmooth_s = 1.0")
    bends = [np.abs(np.diff(t.poses[:, :3, 3], 2, axis=0)).sum() for t in (straight, smooth)]
    assert bends[1] < bends[0]


def test_orbits_and_paths_are_where_they_say(replay, tmp_path):
    orbit = {"orbit": {"radius_m": 3, "height_m": 1, "period_s": 4, "start_deg": 90}, "target": [1, 0.5, 2]}
    found = track(replay, tmp_path, orbit)
    eyes = found.poses[:, :3, 3] - [1, 0.5, 2]
    np.testing.assert_allclose(np.hypot(eyes[:, 0], eyes[:, 2]), 3)
    np.testing.assert_allclose(eyes[0], [0, 1, -3], atol=1e-9)
    assert eyes[15, 0] < -1, "a heading that grows turns left: from -z to -x"
    keys = "".join(
        f"[[keys]]\ntime_s = {t}\neye = [{x}, 1.5, 0]\ntarget = [{x}, 1, 3]\n"
        for t, x in ((0.2, 0), (0.8, 2), (1.4, 2))
    )
    path = track(replay, tmp_path, keys).poses
    times = replay.recording.columns["time_ns"] * 1e-9
    times = times - times[0]
    assert np.ptp(path[times <= 0.2, 0, 3]) < 1e-12
    assert path[np.argmin(np.abs(times - 0.8)), 0, 3] == pytest.approx(2, abs=0.01)
    assert path[:, 0, 3].max() <= 2 + 1e-9, "no overshoot"
    np.testing.assert_allclose(path[:, :3, 2], look_at([0, 1.5, 0], [0, 1, 3])[:3, 2] + np.zeros((STEPS, 3)), atol=1e-9)


def test_every_projection_can_be_written_down(replay, tmp_path):
    place = "eye = [0, 9, 0]\ntarget = [0, 0, 0]\n"
    flat = track(replay, tmp_path, place + 'projection = "orthographic"\nwidth_m = 12.0\nhidden_layers = ["ceiling"]')
    assert flat.camera.width / flat.camera.fx == pytest.approx(12)
    assert track(replay, tmp_path, place + 'projection = "fisheye"').camera.hfov_deg == pytest.approx(180)
    assert track(replay, tmp_path, place + 'projection = "equirectangular"').camera.hfov_deg == pytest.approx(360)


def test_every_name_gives_a_camera_with_a_pose_for_every_step(replay):
    names = camera_names(replay)
    assert {"top_down", "top_down_orthographic", "orbit", "third_person", "human_head", "robot_arm"} <= set(names)
    for name in names:
        found = camera_track(replay, name)
        assert len(found.poses) in (1, STEPS)
        for step in (0, STEPS - 1):
            found.at(step).checked()
    explicit = camera_track(replay, "robot/robot_arm")
    np.testing.assert_array_equal(explicit.poses, camera_track(replay, "robot_arm").poses)


@pytest.mark.parametrize("name", ["top_down", "top_down_orthographic", "orbit"])
def test_overviews_see_into_rooms_without_ceilings(replay, name):
    """Most of the picture's home is floor and what stands on it, none is ceiling; with ceilings shown they cover it."""
    found, stage = camera_track(replay, name), replay.stage
    ceilings = [k for k, thing in enumerate(replay.drawables) if thing.layer == "ceiling"]
    camera = found.at(STEPS // 2)
    shares = []
    for seen in (camera, replace(camera, hidden_layers=())):
        ids = stage.render(stage.renderer(), STEPS // 2, [seen], outputs=("instance",))[0]["instance"]
        shares.append(np.isin(ids, ceilings).sum() / (ids >= 0).sum())
    assert ceilings
    assert shares[0] == 0
    assert shares[1] > 0.3


@pytest.mark.parametrize("size", [(640, 480), (480, 640), (1280, 240), (120, 640)])
@pytest.mark.parametrize("name", ["top_down", "top_down_orthographic"])
def test_views_from_above_show_the_whole_home_in_any_shape(replay, name, size):
    """Floor and wall tops of all rooms are in the picture, and fill it in one direction."""
    rooms = np.concatenate([room.rectangles for room in replay.scene.rooms])
    heights = replay.scene.bounds[:, 1]
    points = [[x, y, z] for x in rooms[:, [0, 2]].ravel() for z in rooms[:, [1, 3]].ravel() for y in heights]
    pixels, _ = camera_track(replay, name).resized(*size).at(0).project(points)
    assert (pixels >= 0).all()
    assert (pixels <= size).all()
    assert (np.ptp(pixels, axis=0) / size).max() > 0.85


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("eye = [0, 1, 0]", "H3-REPLAY-002"),
        ("hfov_deg = 60", "H3-REPLAY-002"),
        ("eye = [0, 1, 0]\ntarget = [0, 1, 0]", "H3-REPLAY-004"),
        ("eye = [0, 1, 0]\ntarget = [1, 1, 0]\nwidth = 0", r"(?s)size 0x480.*H3-RENDER-009"),
        ("eye = [0, 1, 0]\ntarget = [1, 1, 0]\nhfov_deg = 200", "H3-RENDER-003"),
        ("eye = [0, 1, 0]\ntarget = [1, 1, 0]\nintrinsics = [0, 5, 1, 1]", "H3-RENDER-007"),
        ("eye = [0, 1, 0]\ntarget = [1, 1, 0]\nintrinsics = [5, 5, 1, 1]\nhfov_deg = 60", "H3-REPLAY-003"),
        ('eye = [0, 1, 0]\ntarget = [1, 1, 0]\nprojection = "orthographic"', "H3-REPLAY-012"),
        ('eye = [0, 1, 0]\ntarget = [1, 1, 0]\nprojection = "isometric"', "H3-REPLAY-011"),
        ('eye = [0, 1, 0]\ntarget = [1, 1, 0]\nfollow = "cat"', r"(?s)'cat'.*robot.*H3-REPLAY-006"),
        (
            'eye = [0, 1, 0]\ntarget = [1, 1, 0]\nfollow = "robot"\nlink = "tail"',
            r"(?s)'tail'.*arm_hand.*H3-REPLAY-008",
        ),
        ('eye = [0, 1, 0]\ntarget = [1, 1, 0]\nlink = "head"', "H3-REPLAY-015"),
        ('eye = [0, 1, 0]\ntarget = [1, 1, 0]\nbody = "spaceship"', r"(?s)'spaceship'.*H3-REPLAY-009"),
        ("pose = [0, 0, 0, 0, 0, 0, 2]", r"(?s)1.*2.*H3-REPLAY-016"),
        ("pose = [0, 0, 0]", "H3-REPLAY-013"),
        (
            "pose = [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]",
            r"(?s)orthogonal and of unit length.*H3-RENDER-009",
        ),
        ("pose = [nan, 0, 0, 0, 0, 0, 1]", "H3-REPLAY-013"),
        ("eye = [0, 1, 0]\ntarget = [1, 1, 0]\nzoom = 3", r"(?s)zoom.*H3-REPLAY-011"),
    ],
)
def test_what_is_no_camera_is_refused_in_words(replay, tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        track(replay, tmp_path, text)


def test_broken_files_are_refused(replay, tmp_path):
    for name in ("lost.toml", "lost.json"):
        with pytest.raises(InputError, match="H3-REPLAY-001"):
            camera_track(replay, str(tmp_path / name))
    (tmp_path / "broken.json").write_bytes(b'{"eye": \xff')
    with pytest.raises(InputError, match="H3-REPLAY-011"):
        camera_track(replay, str(tmp_path / "broken.json"))
