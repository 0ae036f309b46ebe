"""Cameras on the robot: the picture is that of a replay, worlds do not mix, the detector sees the person."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from h3data.bodies import Humanoid, Robot, load_humanoid, load_robot
from h3data.errors import InputError
from h3data.render import Camera, normalize_depth
from h3data.replay import Replay, camera_track
from h3data.scene import FreeSpace, Scene
from h3data_homes import HomeSpec, build_home
from sim_kinematic.motion.spec import HOME_WALKER, SocialNavSpec
from sim_kinematic.motion.state import WorldState
from sim_kinematic.sensing.camera_sensor import CameraSensor, StateRenderer
from sim_kinematic.sensing.sensor import detect_humanoids
from tests.simulated import simulate_social_nav, social_nav_episode

ARM = CameraSensor(outputs=("depth", "semantic", "instance"))


@pytest.fixture(scope="module")
def home() -> Scene:
    return build_home(HomeSpec(preset="small", seed=1))


@pytest.fixture(scope="module")
def bodies() -> tuple[Robot, Humanoid]:
    return load_robot("quad_arm"), load_humanoid("female_0")


def facing_each_other(home: Scene, worlds: int, apart: float = 1.6) -> WorldState:
    """The person stands ``apart`` metres ahead of the robot, in the middle of different free places."""
    free = FreeSpace.from_scene(home)
    rng = np.random.default_rng(0)
    state = WorldState.zeros(worlds)
    w = 0
    while w < worlds:
        (xz,), heading = free.sample(rng, 1), rng.uniform(-np.pi, np.pi)
        ahead = xz + apart * np.array([np.cos(heading), -np.sin(heading)])
        if free.geodesic(xz, ahead) < apart + 1e-9:
            robot, person = state.agents
            robot.xz[w], robot.heading[w] = xz, heading
            person.xz[w], person.heading[w] = ahead, heading + np.pi
            w += 1
    return state


def test_the_picture_is_that_of_the_replay(home: Scene, bodies: tuple[Robot, Humanoid]) -> None:
    robot, human = bodies
    world = social_nav_episode(home, seed=3, spec=SocialNavSpec(max_steps=60, human=HOME_WALKER))
    recording = simulate_social_nav(world)
    replay = Replay(recording, stepping=False)  # the simulator turns people on the spot with the feet they have
    drawn = StateRenderer(home, [robot, human])
    state, step = WorldState.zeros(1), len(recording) - 1
    (robot,), (walker,) = state.robots, state.people
    base, person = recording.columns["agent_0.base_pose"][step], recording.columns["agent_1.base_pose"][step]
    for pose, xz, heading in (
        (base, robot.xz, robot.heading),
        (person, walker.xz, walker.heading),
    ):
        xz[0] = pose[[0, 2]]
        heading[0] = 2 * np.arctan2(pose[4], pose[6])
    clip = human.clips[human.clip_for_speed(2.5)]
    phase = float(recording.columns["agent_1.motion_phase"][step])
    walker.distance[0] = (phase - clip.start_phase) * clip.stride_m
    walker.blend[0] = recording.columns["agent_1.motion_blend"][step]
    drawn.pose(state, floor=float(base[1]))
    ours = ARM.observe(drawn)
    ((_, (theirs,)),) = replay.frames([camera_track(replay, "robot_arm")], [step], outputs=("depth", "semantic"))
    assert (np.abs(ours["depth"][0] - theirs["depth"]) < 1e-4).mean() > 0.999
    assert (ours["semantic"][0] == theirs["semantic"]).mean() > 0.999


def test_the_detector_sees_who_stands_ahead(home: Scene, bodies: tuple[Robot, Humanoid]) -> None:
    drawn = StateRenderer(home, bodies, worlds=3)
    state = facing_each_other(home, 3)
    state.people[0].xz[2] = [50.0, 50.0]
    drawn.pose(state)
    seen = ARM.observe(drawn)
    assert seen["depth"].shape == (3, 171, 224)
    said = detect_humanoids(seen["semantic"])
    assert said.found.tolist() == [1.0, 1.0, 0.0]
    np.testing.assert_array_equal(said.mask, detect_humanoids(seen["instance"], drawn.instances(1)).mask)
    depth = np.where(said.mask[0] > 0, seen["depth"][0], np.inf).min()
    assert 0.4 < depth < 1.6


def test_worlds_do_not_mix(home: Scene, bodies: tuple[Robot, Humanoid]) -> None:
    state = facing_each_other(home, 3)
    many = StateRenderer(home, bodies, worlds=3)
    many.pose(state)
    together = ARM.observe(many)
    one = StateRenderer(home, bodies)
    for w in range(3):
        one.pose(state.take([w]))
        for name, picture in ARM.observe(one).items():
            np.testing.assert_array_equal(picture[0], together[name][w], err_msg=name)


@pytest.mark.parametrize(
    "projection", ["perspective", "orthographic", pytest.param("equirectangular", marks=pytest.mark.slow)]
)
def test_pictures_are_the_same_where_people_out_of_view_are_not_skinned(
    home: Scene, bodies: tuple[Robot, Humanoid], projection: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cameras all around a person, near and far, also between their legs: many see a hand or a foot at an edge alone."""
    state = facing_each_other(home, 1)
    (middle,) = np.column_stack([state.people[0].xz[:, :1], [[1.0]], state.people[0].xz[:, 1:]])
    rng = np.random.default_rng(7)
    lens = {"perspective": 40.0, "orthographic": 60.0, "equirectangular": 96 / (2 * np.pi)}[projection]
    cameras = []
    for _ in range(60):
        axes, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        pose = np.eye(4)
        pose[:3, :3] = axes * np.sign(np.linalg.det(axes))
        pose[:3, 3] = middle + rng.normal(size=3) * rng.choice([0.2, 1.0, 3.0])
        near = float(rng.choice([0.0, 0.3]))
        cameras.append(
            Camera(
                width=96,
                height=48,
                fx=lens,
                fy=lens,
                cx=48.0,
                cy=24.0,
                pose=pose,
                projection=projection,
                near=near,
                far=6.0,
            )
        )
    outputs = ("depth", "instance", "rgb")
    pictures, skinned = {}, {}
    for culled in (True, False):
        drawn = StateRenderer(home, bodies)
        if not culled:
            monkeypatch.setattr("sim_kinematic.sensing.camera_sensor.may_see", lambda *_: True)
        taken, count = [], 0
        for camera in cameras:
            drawn.pose(state)
            taken.append(drawn.picture([camera], outputs))
            count += len(drawn._shown)
        pictures[culled], skinned[culled] = taken, count
    for ours, all_skinned in zip(pictures[True], pictures[False], strict=True):
        for name in outputs:
            np.testing.assert_array_equal(ours[name], all_skinned[name], err_msg=name)
    people = StateRenderer(home, bodies).instances(1)
    showing = sum(bool(np.isin(one["instance"], people).any()) for one in pictures[False])
    assert skinned[False] == 60
    assert showing <= skinned[True]
    assert projection == "equirectangular" or skinned[True] < showing + 20


def test_objects_are_drawn_where_the_state_has_them(home: Scene, bodies: tuple[Robot, Humanoid]) -> None:
    robot, _ = bodies
    moved = max(
        (i for i in home.instances if i.motion != "static"), key=lambda i: home.assets[i.asset].mesh.bounds[1, 1]
    )
    drawn = StateRenderer(home, [robot], objects=[moved.name])
    (number,) = [k for k, i in enumerate(drawn.scene.instances) if i.name == moved.name]
    one = facing_each_other(home, 1)
    state = WorldState.zeros(1, people=0, joints=len(robot.joint_names), objects=1)
    own, there = state.robots[0], one.robots[0]
    own.xz[:], own.heading[:], own.joints[0] = there.xz, there.heading, robot.rest
    drawn.pose(state)
    camera = drawn.cameras("robot_arm")[0]
    state.object_pose[0, 0, :3] = camera.pose[:3, 3] + 0.4 * camera.pose[:3, 2]  # ahead of the lens
    assert not (ARM.observe(drawn)["instance"] == number).any()
    drawn.pose(state)
    seen = ARM.observe(drawn)
    pixels = np.argwhere(seen["instance"][0] == number)
    assert len(pixels) > 100
    assert np.hypot(*(pixels.mean(0) - [85, 112])) < 40
    assert 0.2 < seen["depth"][0][seen["instance"][0] == number].min() < 0.45
    body = CameraSensor(camera="robot_front_left", outputs=("rgb",), size=(60, 106)).observe(drawn)
    assert body["rgb"].shape == (1, 106, 60, 3)


def test_depth_is_scaled_as_habitats(home: Scene, bodies: tuple[Robot, Humanoid]) -> None:
    drawn = StateRenderer(home, bodies)
    drawn.pose(facing_each_other(home, 1))
    metres = CameraSensor().observe(drawn)["depth"]
    scaled = CameraSensor(depth_range_m=(0.0, 10.0)).observe(drawn)["depth"]
    np.testing.assert_array_equal(scaled, normalize_depth(metres, 0.0, 10.0))
    assert scaled.dtype == np.float32
    with pytest.raises(InputError, match="H3-SIM-044"):
        CameraSensor(depth_range_m=(3.0, 1.0))


def test_what_cannot_be_seen_is_told(home: Scene, bodies: tuple[Robot, Humanoid]) -> None:
    drawn = StateRenderer(home, bodies)
    with pytest.raises(InputError, match="H3-SIM-042"):
        ARM.observe(drawn)
    with pytest.raises(InputError, match=r"(?s)1.*H3-SIM-041"):
        drawn.pose(WorldState.zeros(2))
    drawn.pose(WorldState.zeros(1))
    with pytest.raises(InputError, match=r"(?s)robot_arm.*H3-BODY-093"):
        CameraSensor(camera="periscope").observe(drawn)
    with pytest.raises(InputError, match=r"(?s)unicorn.*H3-SIM-040"):
        StateRenderer(home, bodies[:1], objects=["unicorn"])
