"""Agents on stairs: feet stand on treads, robots that climb pitch, wheels stay off, episodes cross storeys and verify."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from h3data.bodies import humanoid_names, load_humanoid, load_robot
from h3data.bodies.people.kernels.planted import AIR, FOOT, FOOT_COLUMNS
from h3data.bodies.people.planted_gait import on_stairs, planted_states, pose_planted
from h3data.bodies.people.soles import sole_points
from h3data.bodies.robots.trot import trot
from h3data.errors import InputError
from h3data.geometry import pose_to_matrix, transform_points
from h3data.replay import Replay
from h3data.scene.floor_heights import floor_heights, nose_heights
from h3data_motion.contacts import leg_frames
from sim_kinematic.agents.roster import make_roster
from sim_kinematic.motion.spec import NATURAL_WALKER, BaseSpec
from sim_kinematic.motion.state import HumanState
from sim_kinematic.motion.stride import STAIRS_SHARE, Strider
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.registry import find_task
from sim_kinematic.tasks.resume import verify
from sim_kinematic.world import DriveCommand, World
from tests import storeys

STEP_S = 1 / 30
Track = NDArray[np.float64]


@functools.cache
def walked(*, up: bool) -> Track:
    """Roots (x, z, heading) [T, 3] of somebody who walks from one landing to the other, standing before and after."""
    low, high = storeys.ends()
    path = np.array([low, high] if up else [high, low])
    way = path[1] - path[0]
    strider = Strider(storeys.floor(), NATURAL_WALKER, halts=True)
    strider.begin(path)
    rows = [np.array([*path[0], np.arctan2(-way[1], way[0])])] * 10
    gait = HumanState.zeros(1)
    gait.xz[0], gait.heading[0] = rows[0][:2], rows[0][2]
    while not strider.arrived:
        strider.walk(gait)
        rows.append(np.array([*gait.xz[0], gait.heading[0]]))
        assert len(rows) < 1000
    return np.array(rows + [rows[-1]] * 30)


def test_people_slow_down_before_they_climb() -> None:
    assert NATURAL_WALKER.stride is not None
    for up in (True, False):
        track = walked(up=up)
        speed = np.hypot(*np.diff(track[:, :2], axis=0).T) / STEP_S
        y = storeys.floor().height_at(track[1:, :2])
        on = (y > 0.01) & (y < 2.71)
        assert on.sum() > 100
        assert speed[on].max() <= STAIRS_SHARE * NATURAL_WALKER.speed_mps + 0.1
        before = np.diff(speed)[: np.flatnonzero(on)[-1]]  # at the end they stop
        assert np.abs(before).max() <= NATURAL_WALKER.stride.decel_mps2 * STEP_S + 0.02


@pytest.mark.parametrize(
    "name",
    [
        name if name in ("female_0", "male_1", "child_0") else pytest.param(name, marks=pytest.mark.slow)
        for name in humanoid_names()
    ],
)
@pytest.mark.parametrize("up", [True, False])
def test_feet_stand_on_treads_and_clear_their_noses(name: str, up: bool) -> None:
    body, free, track = load_humanoid(name), storeys.floor(), walked(up=up)
    base = free.root_pose(track[:, :2], track[:, 2])
    tables = on_stairs(body.gait_tables, free.heights)
    states = planted_states(tables, base)
    quats, pelvis = pose_planted(tables, states)
    soles = transform_points(pose_to_matrix(base)[:, None], sole_points(body, leg_frames(body, quats, pelvis)))
    over = soles[..., 1] - floor_heights(free.heights, 0.0, soles[..., ::2], treads=True)
    in_air = np.stack([states[:, FOOT + k * FOOT_COLUMNS + AIR] > 0 for k in range(2)], axis=1)
    lowest = over.min(-1)
    assert lowest[~in_air].min() > -0.001  # not in a tread or riser
    assert lowest[~in_air].max() < 0.05  # nor in the air, though a heel may be up
    assert lowest[in_air].min() > -0.001
    climbing = (base[:, 1] > 0.3) & (base[:, 1] < 2.4)
    assert lowest[in_air & climbing[:, None]].max() > 0.1  # over the next step
    height = pelvis[:, 1] + base[:, 1]
    assert np.abs(np.diff(height)).max() < 0.06  # no jumps
    assert np.abs(np.diff(height, 2))[climbing[2:]].max() < 0.045
    treads = [np.unique(np.round(soles[~in_air[:, k], k, 1, 1].round(2) / 0.17)) for k in range(2)]
    assert len(np.union1d(*treads)) >= 15  # every step is used


def test_standing_on_stairs_one_comes_to_rest() -> None:
    body, free = load_humanoid("male_0"), storeys.floor()
    low, high = storeys.ends()
    tables = on_stairs(body.gait_tables, free.heights)
    for share in np.linspace(0.2, 0.8, 7):
        for heading in (0.0, 1.57, -2.0):
            base = np.tile(free.root_pose(low + share * (high - low), heading), (60, 1))
            states = planted_states(tables, base)
            assert (states[-1, [FOOT + AIR, FOOT + FOOT_COLUMNS + AIR]] == 0).all()


def test_a_level_home_walks_as_without_heights() -> None:
    body, track = load_humanoid("female_1"), walked(up=True)
    base = np.column_stack([track[:, 0], np.zeros(len(track)), track[:, 1], np.zeros((len(track), 4))])
    base[:, 4], base[:, 6] = np.sin(track[:, 2] / 2), np.cos(track[:, 2] / 2)
    plain = planted_states(body.gait_tables, base)
    assert planted_states(on_stairs(body.gait_tables, np.zeros((0, 10))), base).tobytes() == plain.tobytes()


def test_legs_of_robots_step_on_treads() -> None:
    robot, free, track = load_robot("quad_arm"), storeys.floor(), walked(up=True)
    base = free.root_pose(track[:, :2], track[:, 2], pitch_over_m=robot.climbing_length_m)
    joints = trot(robot, base, np.tile(robot.rest, (len(base), 1)), heights=free.heights)
    links = robot.link_matrices(base, joints)
    rest = robot.link_matrices(np.array([[0, 0, 0, 0, 0, 0, 1.0]]), robot.rest[None])[0]
    for leg in robot.legs:
        shank, foot = int(robot.joint_links[leg.columns[2]]), np.append(leg.foot, 1.0)
        at = links[:, shank] @ foot
        over = at[:, 1] - (rest[shank] @ foot)[1] - floor_heights(free.heights, 0.0, at[:, [0, 2]], treads=True)
        assert over.min() > -0.02
        assert np.quantile(over, 0.3) < 0.02
        assert (over <= 0.2 + nose_heights(free.heights, 0.0, at[:, [0, 2]])).all()


@pytest.mark.parametrize(("robot", "climbs"), [("quad_arm", True), ("lift_arm", False)])
def test_wheels_stay_off_stairs_and_legs_climb_them(robot: str, climbs: bool) -> None:
    free = storeys.floor()
    low, high = storeys.ends()
    way = high - low
    world = World(make_roster(("robot", "human"), robot=robot), base=BaseSpec())
    starts = np.array([[[*low, np.arctan2(-way[1], way[0])], [*high, 0.0]]])
    world.place(starts, [free])
    x0, z0, x1, z1 = storeys.flight()
    heights = []
    for k in range(150):
        world.step([DriveCommand(np.array([[1.0, 0.02 * np.sin(k)]])), DriveCommand(np.zeros((1, 2)))])
        x, z = world.state.robots[0].xz[0]
        heights.append(world.roots(0, world.rows)[0, 1])
        if not climbs:
            assert not (x0 < x < x1 and z0 < z < z1)
    assert (max(heights) > 1.5) == climbs
    assert np.isclose(world.heights(world.state.people[0].xz)[0], 2.72)


@pytest.mark.parametrize("task", ["wander", "social_nav", pytest.param("rearrange", marks=pytest.mark.slow)])
def test_episodes_with_wheeled_robots_stay_on_one_storey(task: str) -> None:
    found = find_task(task)
    episode = found.episode(storeys.home(), free=storeys.floor(), seed=1, agents="robot,human", robot="lift_arm")
    assert not episode.free.has_stairs
    assert len(set(episode.free.height_at(episode.starts[:, :2]).tolist())) == 1
    for target in getattr(episode, "targets", ()):
        ends = [np.asarray(target.start)[[0, 2]], np.asarray(target.goal)[[0, 2]]]
        assert len(set(episode.free.height_at(ends).tolist())) == 1


def test_bases_of_habitat_are_refused_on_stairs() -> None:
    world = World(make_roster(("robot", "human")), base=BaseSpec(slide="habitat"))
    world.place(np.array([[[*storeys.ends()[0], 0.0], [*storeys.ends()[1], 0.0]]]), [storeys.floor()])
    with pytest.raises(InputError, match="H3-SIM-037"):
        world.step([DriveCommand(np.array([[1.0, 0.0]])), DriveCommand(np.zeros((1, 2)))])


@pytest.mark.slow
def test_devices_refuse_stairs_in_one_line() -> None:
    pytest.importorskip("torch")
    from h3data_training.torch.episodes import EpisodeBank
    from h3data_training.torch.social_nav import SocialNavTensors
    from sim_kinematic.tasks.social_nav import TRAINING

    bank = EpisodeBank.draw("small2-storeys:3", 1, seed=0, spec=TRAINING)
    with pytest.raises(InputError, match="H3-TRAIN-076"):
        SocialNavTensors(bank, device="cpu", spec=TRAINING)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "seed", "steps"), [("wander", 0, 400), ("social_nav", 4, 700), ("rearrange", 0, None)]
)
def test_episodes_cross_storeys_and_verify(task: str, seed: int, steps: int | None) -> None:
    found = find_task(task)
    spec = found.Spec() if steps is None else replace(found.Spec(), max_steps=steps)
    recording = simulate(found, found.episode(storeys.home(), free=storeys.floor(), seed=seed, spec=spec))
    heights = [recording.agent_column(k, "base_pose")[:, 1] for k in range(len(recording.agents))]
    assert any(y.min() < 0.01 and y.max() > 2.71 for y in heights)
    assert all(np.abs(np.diff(y)).max() < 0.08 for y in heights)
    assert verify(recording).equal
    replay = Replay(recording)
    people = [k for k, a in enumerate(recording.agents) if a.kind == "human"]
    joints = replay.joint_matrices(people[0], np.arange(0, len(recording), 7))
    over = joints[:, :, 1, 3] - heights[people[0]][::7, None]
    assert over.min() > -0.25
    assert over.max() < 2.2
