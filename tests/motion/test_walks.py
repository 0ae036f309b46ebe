"""A captured motion as the walk of people: what comes of it, what is refused, and that recordings carry it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import h3data
from benchmarks.motion import SHARED, figures_of, motion_of
from h3data.bodies import JOINT_INDEX, load_humanoid, names
from h3data.bodies.people.planted_gait import planted_states, pose_planted
from h3data.errors import FormatError, InputError
from h3data.geometry import Array, ground_pose, pose_to_matrix, quat_from_heading, quat_multiply
from h3data.recording import write_mcap
from h3data_motion import walks
from h3data_motion.clip import Motion, in_start_frame
from h3data_motion.files import read_motion, save_motion
from h3data_motion.walks import walk_of
from sim_kinematic.agents.roster import make_roster, with_motion
from sim_kinematic.tasks.resume import resume, verify

SPEED = 1.3


def walk(speed: float = SPEED, *, seconds: float = 4.0, fps: float = 60.0) -> Motion:
    """A steady walk of male_1."""
    body, count = load_humanoid("male_1"), round(seconds * fps)
    way = np.arange(count) * speed / fps
    quats, pelvis = body.walk_pose(np.full(count, speed), way / body.stride_m(speed))
    pelvis = pelvis + np.stack([way, 0 * way, 0 * way], -1)
    return in_start_frame(Motion(name="walk", fps=fps, quats=quats, pelvis=pelvis, leg_m=body.gaits.legs.length))


@pytest.fixture(scope="module")
def walk_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("motion") / "walk.npz"
    save_motion(replace(walk(), source="our own"), path)
    return path


def forget() -> None:
    """As in another process."""
    names._files.clear()
    walks.walk_file.cache_clear()
    names.load_humanoid.cache_clear()


def track(speed: Array, turn: Array) -> Array:
    heading = np.cumsum(turn) / 30
    return ground_pose(
        np.cumsum(np.stack([speed * np.cos(heading), -speed * np.sin(heading)], -1), axis=0) / 30, heading
    )


def test_a_walk_comes_back_as_it_was(walk_file: Path) -> None:
    own, body = load_humanoid("male_1"), load_humanoid(f"male_1+{walk_file}")
    assert body.stride_m(SPEED) == pytest.approx(own.stride_m(SPEED), rel=0.01)
    assert body.motion_names == own.motion_names
    phase = np.arange(64) / 64
    places = [
        b.joint_matrices(np.tile([0.0, 0, 0, 0, 0, 0, 1], (64, 1)), *b.walk_pose(np.full(64, SPEED), phase))[
            :, :22, :3, 3
        ]
        for b in (own, body)
    ]
    apart = np.linalg.norm(places[1] - places[0], axis=-1)
    assert apart.mean() < 0.015
    assert apart.max() < 0.06
    assert np.array_equal(body.clip_pose([0], [0.0])[0], own.clip_pose([0], [0.0])[0]), "they stand as before"
    assert np.array_equal(body.walk_pose([2.5], [0.3])[0], own.walk_pose([2.5], [0.3])[0]), "and run as before"


def test_arms_of_the_capture_are_seen(tmp_path: Path) -> None:
    motion = walk()
    raised = motion.quats.copy()
    raised[:, JOINT_INDEX["left_shoulder"]] = [0, 0, 0, 1]  # straight to the side
    save_motion(replace(motion, quats=raised), tmp_path / "arm.npz")
    body = load_humanoid(f"female_2+{tmp_path / 'arm.npz'}")
    base = track(np.full(60, SPEED), np.zeros(60))
    joints = body.joint_matrices(base, *pose_planted(body.gait_tables, planted_states(body.gait_tables, base)))[-1]
    assert joints[JOINT_INDEX["left_wrist"], 1, 3] > joints[JOINT_INDEX["spine3"], 1, 3]


@pytest.mark.parametrize("name", ["male_1", "female_3"])
def test_feet_are_planted_at_every_speed(name: str, walk_file: Path) -> None:
    body = load_humanoid(f"{name}+{walk_file}")
    wanted = np.repeat([0.0, 0.5, 1.3, 0.9, 0.0], 60)
    speed = np.zeros(len(wanted))
    for k in range(1, len(wanted)):
        speed[k] = speed[k - 1] + np.clip(wanted[k] - speed[k - 1], -1.1 / 30, 1.1 / 30)
    base = track(speed, 0.6 * speed)
    joints = body.joint_matrices(base, *pose_planted(body.gait_tables, planted_states(body.gait_tables, base)))
    found = figures_of(motion_of(body, base, joints))
    assert found["pops_per_minute"] == found["mid_air_stops"] == 0
    assert found["foot_slide_mm"] < 0.5


def test_what_cannot_be_played_is_refused() -> None:
    motion = walk()
    count = len(motion)
    still = replace(
        motion, quats=np.repeat(motion.quats[:1], count, axis=0), pelvis=np.repeat(motion.pelvis[:1], count, axis=0)
    )
    with pytest.raises(InputError, match="H3-BODY-065"):
        walk_of(still)
    with pytest.raises(InputError, match=r"(?s)20.*12.*H3-BODY-062"):
        walk_of(walk(fps=12))
    with pytest.raises(InputError, match="H3-BODY-056"):
        walk_of(in_start_frame(replace(motion, quats=motion.quats[::-1].copy(), pelvis=motion.pelvis[::-1].copy())))
    with pytest.raises(InputError, match="H3-BODY-063"):
        walk_of(walk(seconds=0.4))
    cuts = motion.pelvis.copy()
    cuts[:, 2] += 0.4 * (np.arange(count) // 20 % 2)
    with pytest.raises(InputError, match="H3-BODY-066"):
        walk_of(replace(motion, pelvis=cuts))
    twitch = motion.quats.copy()
    rows = np.arange(3, count, 30)  # twice in each cycle
    twitch[rows, JOINT_INDEX["right_shoulder"]] = quat_multiply(
        np.tile(quat_from_heading(2.5), (len(rows), 1)), twitch[rows, JOINT_INDEX["right_shoulder"]]
    )
    with pytest.raises(InputError, match="H3-BODY-066"):
        walk_of(replace(motion, quats=twitch))
    with pytest.raises(FormatError, match=r"(?s)NaN.*H3-BODY-039"):
        replace(motion, pelvis=np.full_like(motion.pelvis, np.nan))
    slide = replace(motion, quats=np.repeat(motion.quats[:1], count, axis=0))  # carried along in one pose
    with pytest.raises(InputError, match="H3-BODY-058"):
        walk_of(slide)
    with pytest.raises(InputError, match="H3-BODY-061"):
        load_humanoid("female_0+nowhere.npz")
    with pytest.raises(InputError, match="H3-BODY-060"):
        load_humanoid("female_0+motion:0123456789abcdef")


def test_a_floor_elsewhere_and_a_cut_outside_are_repaired() -> None:
    motion = walk(seconds=6.0)
    low, cut = motion.pelvis - (0, 0.3, 0), motion.pelvis.copy()
    cut[280:, 2] += 1.0
    body = load_humanoid("neutral_0")
    strides = [
        float(walks.walks_as(body, walk_of(replace(motion, pelvis=pelvis))).stride_m(SPEED))
        for pelvis in (motion.pelvis, low, cut)
    ]
    np.testing.assert_allclose(strides, strides[0], rtol=0.01)


@pytest.mark.parametrize(
    "task", ["social_nav", *(pytest.param(t, marks=pytest.mark.slow) for t in ("rearrange", "wander"))]
)
def test_recordings_carry_the_walk(task: str, walk_file: Path, tmp_path: Path) -> None:
    copy = tmp_path / "walk.npz"
    copy.write_bytes(walk_file.read_bytes())
    options = {} if task == "rearrange" else {"max_steps": 90}
    human = {"human": f"male_1+{copy}"} if task != "wander" else {"roster": f"robot,human:male_1+{copy}"}
    recording = h3data.simulate(task, "small:1", seed=1, **human, **options)
    number = next(k for k, agent in enumerate(recording.agents) if agent.kind == "human")
    model = recording.agents[number].model
    assert model.startswith("humanoid/male_1+motion:")
    (fact,) = recording.episode.info["motions"].values()
    assert fact["source"] == "our own"
    joints = h3data.Replay(recording).joint_matrices(number, np.arange(30))
    write_mcap(recording, tmp_path / "e.mcap")
    copy.unlink()
    forget()
    again = h3data.open(tmp_path / "e.mcap")
    np.testing.assert_array_equal(h3data.Replay(again).joint_matrices(number, np.arange(30)), joints)
    assert verify(again).equal
    assert resume(again, 30).agents[number].model == model
    plain = h3data.simulate(task, "small:1", seed=1, human="male_1", **options) if task != "wander" else None
    if plain is not None:
        assert plain.episode.uid != recording.episode.uid
        assert "motions" not in plain.episode.info


@pytest.mark.slow
def test_generate_gives_everybody_the_walk(walk_file: Path, tmp_path: Path) -> None:
    options = {"scenes": "small", "episodes": 2, "max_steps": 40, "motion": walk_file, "human": "any"}
    done = h3data.generate("wander", tmp_path / "ds", agents=["robot", "human", "male_1"], **options)
    assert not done.failed
    people = [
        agent.model for recording in h3data.open(tmp_path / "ds") for agent in recording.agents if agent.kind == "human"
    ]
    assert len(people) == 4
    assert {model.partition("+")[2] for model in people} == {names.keep_walk(walks.walk_file(str(walk_file)))}
    assert "humanoid/male_1" in {model.partition("+")[0] for model in people}
    h3data.generate("wander", tmp_path / "ds", agents=["robot", "human", "male_1"], resume=True, **options)
    with pytest.raises(InputError):
        h3data.generate(
            "wander", tmp_path / "ds", agents=["robot", "human", "male_1"], resume=True, **{**options, "motion": None}
        )
    with pytest.raises(InputError, match=r"(?s)--motion.*H3-JOB-027"):
        h3data.generate("wander", tmp_path / "robots", agents=["robot", "robot"], motion=walk_file)


@pytest.mark.slow
def test_evaluations_take_the_walk(walk_file: Path, tmp_path: Path) -> None:
    options = {"scenes": "small", "episodes": 1, "max_steps": 30, "motion": walk_file, "keep": True}
    done = h3data.evaluate("social_nav", tmp_path / "e", policies="stand_still", **options)
    assert not done.failed
    recording = next(iter(h3data.open(next((tmp_path / "e" / "recordings").iterdir()))))
    assert "+motion:" in recording.agents[1].model


def test_environments_take_the_walk(walk_file: Path) -> None:
    env = h3data.make("social_nav", scenes="small:1", human=f"female_0+{walk_file}")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()


def test_names() -> None:
    assert with_motion(("robot", "human", "male_1", "human:female_1", "robot:quad_arm", "random:4"), "+w.npz") == (
        "robot",
        "human",
        "male_1+w.npz",
        "human:female_1+w.npz",
        "robot:quad_arm",
        "random:4+w.npz",
    )
    with pytest.raises(InputError, match=r"(?s)no_such.*H3-SIM-019"):
        make_roster("robot,no_such+walk.npz")


def test_a_captured_walk_becomes_one() -> None:
    clips = sorted((SHARED / "motion").glob("*.bvh"))
    if not clips:
        pytest.skip("no captured walk in ../shared/motion")
    kept = walk_of(read_motion(clips[0]))
    assert kept.duration_s < 4
    body = load_humanoid(f"female_1+{clips[0]}")
    base = track(np.minimum(np.arange(120) * 1.1 / 30, SPEED), np.zeros(120))
    joints = body.joint_matrices(base, *pose_planted(body.gait_tables, planted_states(body.gait_tables, base)))
    found = figures_of(motion_of(body, base, joints))
    local = np.linalg.inv(pose_to_matrix(base))[:, None] @ joints
    assert np.linalg.norm(np.diff(local[:, 1:22, :3, 3] - local[:, :1, :3, 3], axis=0), axis=-1).max() < 0.13
    assert found["foot_slide_mm"] < 0.5
    assert found["jerk"] < 500
