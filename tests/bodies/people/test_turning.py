"""People who turn on the spot: their feet step round, and none that carries slides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.bodies import Humanoid, load_humanoid
from h3data.bodies.people.foot_planting import LEG_JOINTS, sole_points
from h3data.bodies.people.turning import turned, turning_feet
from h3data.geometry import ground_pose, heading_from_quat
from h3data.recording import Recording
from h3data.replay import Replay
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.validation.recordings import LOW_M, SLIDE_MPS, validate_recording
from sim_kinematic.motion.gait import walk_humans
from sim_kinematic.motion.spec import HOME_WALKER, STEP_S, WalkerSpec
from sim_kinematic.motion.state import HumanState
from tests.simulated import simulate_wander


@pytest.fixture(scope="module")
def wandering() -> Recording:
    """As recordings were before people walked with planted feet."""
    home = build_home(HomeSpec(preset="small", seed=5))
    recording = simulate_wander(home, "robot,human,male_1", seed=3, steps=300, human=HOME_WALKER)
    return replace(recording, episode=replace(recording.episode, schema_version="1.4"))


def _soles(replay: Replay, agent: int) -> np.ndarray:
    """Sole points [T, 2 feet, 3, xyz]; the floor of built homes is at 0."""
    body = replay.model(agent)
    assert isinstance(body, Humanoid)
    return sole_points(body, replay.joint_matrices(agent, np.arange(len(replay)))[:, LEG_JOINTS])


def _speeds(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Speed of the lowest point of each sole, and its height, [T-1, 2]."""
    pivot = np.argmin(points[1:, ..., 1] + points[:-1, ..., 1], axis=2)[..., None]
    way = np.take_along_axis(np.linalg.norm(np.diff(points[..., ::2], axis=0), axis=-1), pivot, axis=2)[..., 0]
    height = np.take_along_axis(np.maximum(points[1:, ..., 1], points[:-1, ..., 1]), pivot, axis=2)[..., 0]
    return way / STEP_S, height


def _carrying_speed(points: np.ndarray) -> np.ndarray:
    """Speed of the slowest foot that can carry, [T-1]; inf in the air."""
    speed, height = _speeds(points)
    return np.where(height < LOW_M, speed, np.inf).min(1)


def _carries(recording: Recording, agent: int, body: Humanoid) -> np.ndarray:
    """Whether the clip says that a foot stands throughout the step, [T-1, 2]: she walks or jogs, at full weight."""
    phase, clip, blend = (recording.agent_column(agent, f"motion_{n}") for n in ("phase", "id", "blend"))
    own = (phase[:, None] - np.array([0, 0.5])) % 1
    stance = own < np.array([body.clips[k].stance for k in clip])[:, None]
    full = (blend[1:] == 1) & (blend[:-1] == 1)
    return stance[1:] & stance[:-1] & (own[1:] > own[:-1]) & full[:, None]


def test_no_carrying_foot_of_those_who_wander_slides(wandering: Recording) -> None:
    replay, rigid = Replay(wandering), Replay(wandering, stepping=False)
    assert not [found for found in validate_recording(wandering) if found.check == "feet"]
    slid = 0
    for agent in (1, 2):
        body = replay.model(agent)
        assert isinstance(body, Humanoid)
        base = wandering.agent_column(agent, "base_pose")
        rests = np.hypot(*np.diff(base[:, [0, 2]], axis=0).T) < 1e-4
        assert rests.sum() > 20
        points = _soles(replay, agent)
        speed = _carrying_speed(points)
        assert speed[rests & np.isfinite(speed)].max() < SLIDE_MPS
        assert points[..., 1].min() > -2e-3
        rigidly = _carrying_speed(_soles(rigid, agent))
        slid += int((rests & np.isfinite(rigidly) & (rigidly > SLIDE_MPS)).sum())
        straight = np.abs(np.diff(np.unwrap(heading_from_quat(base[:, 3:])))) < 1e-3
        feet = turning_feet(base, *(wandering.agent_column(agent, f"motion_{name}") for name in ("phase", "blend")))
        walks = _carries(wandering, agent, body) & (straight & ~rests)[:, None]
        walks &= (feet.yaw[1:] == 0) & (feet.yaw[:-1] == 0)  # not a foot that gets straight after a turn of few steps
        assert walks.sum() > 20
        assert _speeds(points)[0][walks].max() < SLIDE_MPS
    assert slid > 10  # her root turns rigidly: without steps feet would slide


def _walk(waypoints: list[tuple[float, float]], waits: int) -> HumanState:
    """The states of one who walks to each way point in turn and waits there, as the worlds of one state."""
    person, states = HumanState.zeros(1), []
    for point in waypoints:
        goal = np.array([point])
        while np.hypot(*(goal - person.xz)[0]) > 1e-3:
            walk_humans(person, goal, WalkerSpec())
            states.append(person.copy())
        for _ in range(waits):
            walk_humans(person, person.xz.copy(), WalkerSpec())
            states.append(person.copy())
    return HumanState(**{n: np.concatenate([getattr(s, n) for s in states]) for n in vars(person)})


bends = st.lists(st.floats(0.7, np.pi) | st.floats(-np.pi, -0.7), min_size=2, max_size=4)


@settings(derandomize=True, max_examples=25, deadline=None)
@given(bends, st.sampled_from([0, 3, 12]), st.sampled_from(["female_0", "male_1"]))
def test_one_foot_stays_while_she_turns(turns: list[float], waits: int, name: str) -> None:
    body = load_humanoid(name)
    angle, at, points = 0.0, np.zeros(2), []
    for turn in turns:
        angle += turn
        at = at + 1.7 * np.array([np.cos(angle), -np.sin(angle)])
        points.append((float(at[0]), float(at[1])))
    track = _walk(points, waits)
    clip = body.clip_for_speed(2.5)
    walk = body.clips[clip]
    phase = (walk.start_phase + (track.distance - track.set_off) / walk.stride_m) % 1
    base = ground_pose(track.xz, track.heading, 0.0)
    feet = turning_feet(base, phase, track.blend)
    quats, pelvis = body.clip_pose(np.full(len(base), clip), phase, track.blend)
    new, low = turned(body, quats, pelvis, feet.yaw, feet.lift)
    soles = sole_points(body, body.joint_matrices(base, new, low)[:, LEG_JOINTS])
    rests = np.hypot(*np.diff(track.xz, axis=0).T) < 1e-6
    assert np.abs(np.diff(track.heading))[rests].max() > 0.05
    speed = _carrying_speed(soles)
    assert np.isfinite(
        speed[rests & (track.blend[:-1] == 0)]
    ).all()  # both are in the air only where a jog ended in flight
    assert speed[rests & np.isfinite(speed)].max() < 0.1
    assert soles[..., 1].min() > -5e-3
    assert np.abs(feet.yaw).max() < np.radians(60)
    still = (feet.yaw == 0).all(1) & (feet.lift == 0).all(1)
    np.testing.assert_array_equal(new[still], quats[still])
    assert still[np.concatenate([[False], ~rests])].any()
    others = [j for j in range(55) if j not in LEG_JOINTS[:, :3]]
    np.testing.assert_array_equal(new[:, others], quats[:, others])


@settings(derandomize=True, max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_any_columns_give_finite_feet(seed: int) -> None:
    rng = np.random.default_rng(seed)
    steps = int(rng.integers(1, 40))
    xz = np.cumsum(rng.choice([0.0, 0.05], (steps, 1)) * rng.standard_normal((steps, 2)), axis=0)
    base = ground_pose(xz, np.cumsum(rng.choice([0.0, 0.08, -1.0], steps)), 0.0)
    base[rng.random(steps) < 0.1] = np.nan
    feet = turning_feet(base, rng.random(steps), rng.random(steps))
    assert feet.yaw.shape == feet.lift.shape == (steps, 2)
    assert np.isfinite(feet.yaw).all()
    assert ((feet.lift >= 0) & (feet.lift <= 0.1)).all()
    gone = np.isnan(base[:, 0])
    assert (feet.yaw[gone] == 0).all() or not gone.all()
