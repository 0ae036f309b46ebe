"""Social navigation: the rules of the episode, the scripted person, the expert, the oracle."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from h3data.bodies import JOINT_INDEX, load_humanoid, load_robot
from h3data.errors import InputError, SceneError
from h3data.geometry import IDENTITY_POSE, ground_pose, heading_from_quat
from h3data.recording import Recording, RecordingWriter, open_recording, recordings_equal, state_hash
from h3data.scene import FreeSpace, Scene
from h3data_homes import HomeSpec, build_home
from sim_kinematic.agents.waypoint_walker import human_plan, sharp_corners
from sim_kinematic.contact import FclScene, MovingShapes, collide
from sim_kinematic.motion.spec import STEP_S, BaseSpec, SocialNavSpec, WalkerSpec
from sim_kinematic.motion.step import least_clearance
from sim_kinematic.policies.assignment import resolve_policy
from sim_kinematic.policies.policy import Velocity
from sim_kinematic.policies.social_nav import rollout_expert
from sim_kinematic.policies.views import SocialNavView
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.tasks.episode import sample_pair_starts as draw_starts
from sim_kinematic.tasks.social_nav import SocialNav, oracle_min_steps, steps_to_find
from tests.random_cases import examples
from tests.simulated import simulate_social_nav, social_nav_episode


@pytest.fixture(scope="module")
def home() -> Scene:
    return build_home(HomeSpec(preset="small", seed=1))


@pytest.fixture(scope="module")
def free(home: Scene) -> FreeSpace:
    return FreeSpace.from_scene(home, radius_m=0.25, cache=False)


def world(home: Scene, free: FreeSpace, seed: int = 5, **changes: object) -> Episode:
    return social_nav_episode(home, seed=seed, spec=SocialNavSpec(**{"max_steps": 150, **changes}), free=free)  # type: ignore[arg-type]


def ram(view: SocialNavView, spec: BaseSpec) -> Velocity:
    """Drives straight into the person."""
    command = rollout_expert(view._replace(geodesic_m=100.0), spec)
    return Velocity(command.forward, command.turn, "follow")


def test_starts_keep_their_distance(free: FreeSpace) -> None:
    spec = SocialNavSpec(spawn_distance_m=4.0)
    offsets = np.asarray(spec.robot.disc_offsets_m)
    seen = set()
    for seed in range(30):
        s = draw_starts(free, seed, spec)
        assert np.hypot(*(s.robot_xz - s.human_xz)) >= 4.0
        assert least_clearance(free.sdf, free.origin, free.cell_m, *s.robot_xz, s.robot_heading, offsets) >= 0.25
        assert np.isfinite(free.geodesic(s.robot_xz, s.human_xz))
        seen.add(tuple(s.robot_xz))
    assert len(seen) == 30


def test_the_whole_robot_starts_out_of_the_furniture(home: Scene, free: FreeSpace) -> None:
    """Habitat refuses a start at which any link touches anything (spec/habitat.md 1.2)."""
    robot, scenery = load_robot("quad_arm"), FclScene(home)
    shapes = MovingShapes([s for link in robot.links for s in link.shapes])
    at = [k for k, link in enumerate(robot.links) for _ in link.shapes]
    for seed in range(25):
        starts = world(home, free, seed=seed).starts
        base = ground_pose(starts[0, :2], starts[0, 2], 0.02)
        shapes.set_transforms(robot.link_matrices(base[None], robot.rest[None])[0][at])
        assert not collide(scenery, shapes)


def test_a_home_that_is_too_small_says_so(free: FreeSpace) -> None:
    with pytest.raises(SceneError, match="H3-TASK-048"):
        draw_starts(free, 0, SocialNavSpec(spawn_distance_m=500.0))


def test_same_seed_same_bits_and_the_hash_knows(home: Scene, free: FreeSpace) -> None:
    a, b = (simulate_social_nav(world(home, free)) for _ in range(2))
    assert recordings_equal(a, b) == []
    state = {k: v for k, v in a.columns.items() if k != "state_hash"}
    np.testing.assert_array_equal(state_hash(state), a.columns["state_hash"])
    other = simulate_social_nav(world(home, free, seed=6))
    assert other.columns["state_hash"][-1] != a.columns["state_hash"][-1]


def test_another_person_is_another_episode(home: Scene, free: FreeSpace) -> None:
    spec = SocialNavSpec(max_steps=2)
    worlds = [social_nav_episode(home, seed=5, spec=spec, free=free, human=h) for h in ("female_0", "male_0")]
    assert len({simulate_social_nav(w).episode.uid for w in worlds}) == 2


def test_the_person_does_not_react(home: Scene, free: FreeSpace) -> None:
    expert = simulate_social_nav(world(home, free, end_on_collision=False))
    still = simulate_social_nav(world(home, free, end_on_collision=False), policy="stand_still")
    np.testing.assert_array_equal(expert.columns["agent_1.base_pose"], still.columns["agent_1.base_pose"])
    w = world(home, free)
    track = human_plan(free, w.starts[1, :2], w.starts[1, 2], w.seed, w.spec.human, 150).xz
    np.testing.assert_allclose(expert.columns["agent_1.base_pose"][:, [0, 2]], track, atol=1e-6)
    assert np.ptp(still.columns["agent_0.base_pose"], axis=0).max() == 0


def test_the_person_walks_where_one_can_and_never_too_fast(free: FreeSpace) -> None:
    spec = WalkerSpec(speed_mps=2.5)
    start = free.sample(np.random.default_rng(0), 1)[0]
    track = human_plan(free, start, 0.3, 11, spec, 1500).xz
    assert np.hypot(*np.diff(track, axis=0).T).max() <= 2.5 * STEP_S + 1e-9
    assert free.is_navigable(free.snap(track, max_distance_m=0.002)).all()
    assert np.ptp(track, axis=0).min() > 2.0  # it gets about


def test_the_person_walks_without_stutter(free: FreeSpace) -> None:
    """The person turns on the spot at corners (paper section 3.1), not before each of the 5 cm legs that round one."""
    start = free.sample(np.random.default_rng(0), 1)[0]
    walks = np.hypot(*np.diff(human_plan(free, start, 0.3, 11, WalkerSpec(), 1500).xz, axis=0).T) > 0
    changes = np.flatnonzero(np.diff(walks.astype(int)))
    assert np.median(np.diff(changes)) > 6
    assert len(changes) / 50 < 3  # per second


def test_sharp_corners_go_round_what_the_path_goes_round(free: FreeSpace) -> None:
    rng = np.random.default_rng(5)
    fewer = 0
    for a, b in zip(free.sample(rng, 40), free.sample(rng, 40), strict=True):
        path = free.path(a, b)
        sharp = sharp_corners(free, path)
        np.testing.assert_array_equal(sharp[[0, -1]], path[[0, -1]])
        fewer += len(sharp) < len(path)
        along = np.concatenate([np.linspace(p, q, 50) for p, q in itertools.pairwise(sharp)])
        assert np.abs(free.snap(along) - along).max() < 0.0015
        length = np.hypot(*np.diff(sharp, axis=0).T).sum()
        assert free.geodesic(a, b) - 1e-3 < length < free.geodesic(a, b) * 1.15
    assert fewer > 10
    straight = np.array([[0.0, 0.0], [3.0, 1.0]])
    np.testing.assert_array_equal(sharp_corners(free, straight), straight)


def test_ramming_ends_the_episode(home: Scene, free: FreeSpace) -> None:
    recording = simulate_social_nav(world(home, free, max_steps=450), policy=ram)
    assert recording.episode.info["ended"] == "collision"
    collision = recording.columns["metrics.collision"]
    assert collision[-1]
    assert not collision[:-1].any()
    assert recording.events[-1].kind == "collision"
    assert recording.columns["metrics.dist_agents"][-1] < 1.2
    on = simulate_social_nav(world(home, free, max_steps=450, end_on_collision=False), policy=ram)
    assert len(on) == 450


def test_the_expert_finds_and_follows(home: Scene, free: FreeSpace) -> None:
    calm = WalkerSpec(speed_mps=0.8)
    recording = simulate_social_nav(world(home, free, max_steps=600, human=calm))
    geodesic = recording.columns["metrics.geodesic_agents"]
    assert any(e.kind == "found" for e in recording.events)
    found = next(e.step for e in recording.events if e.kind == "found")
    assert np.median(geodesic[found:]) == pytest.approx(1.5, abs=0.35)


def test_every_step_has_a_skill(home: Scene, free: FreeSpace) -> None:
    recording = simulate_social_nav(world(home, free))
    for agent in (0, 1):
        covered = np.zeros(len(recording), int)
        for span in recording.skills:
            if span.agent == agent:
                covered[span.start_step : span.end_step + 1] += 1
                codes = recording.columns[f"agent_{agent}.skill"][span.start_step : span.end_step + 1]
                assert set(codes) == {recording.agents[agent].skill_names.index(span.name)}
        assert (covered == 1).all()


def test_feet_and_floor_agree(home: Scene, free: FreeSpace) -> None:
    """The walking cycle advances by the distance walked, so planted feet stay."""
    w = world(home, free, human=WalkerSpec(speed_mps=1.3))
    recording = simulate_social_nav(w, policy="stand_still")
    xz = recording.columns["agent_1.base_pose"][:, [0, 2]].astype(np.float64)
    walked = np.hypot(*np.diff(xz, axis=0).T)
    phase = np.diff(recording.columns["agent_1.motion_phase"].astype(np.float64)) % 1.0
    stride = load_humanoid("female_0").clips[int(recording.columns["agent_1.motion_id"][0])].stride_m
    going = recording.columns["agent_1.motion_blend"][:-1] > 0  # a start from standing begins the cycle anew
    np.testing.assert_allclose((np.where(phase > 0.99, 0.0, phase) * stride)[going], walked[going], atol=2e-5)


@pytest.mark.parametrize("speed", [1.3, 2.5])
def test_no_foot_slides_where_she_walks_starts_or_stops(home: Scene, free: FreeSpace, speed: float) -> None:
    """Turns on the spot apart, which are rigid as the paper's: what is low from one step to the next does not move."""
    w = world(home, free, human=WalkerSpec(speed_mps=speed))
    columns = simulate_social_nav(w, policy="stand_still").columns
    person = load_humanoid("female_0")
    joints = person.joint_matrices(
        columns["agent_1.base_pose"].astype(np.float64),
        *person.clip_pose(*(columns[f"agent_1.motion_{name}"] for name in ("id", "phase", "blend"))),
    )
    turning = np.abs(np.diff(columns["agent_1.base_pose"][:, 4])) > 1e-6
    standing = person.joint_matrices(IDENTITY_POSE[None], *person.clip_pose([0], [0.0]))[0]
    slides = []
    for side in ("left", "right"):
        toe = JOINT_INDEX[f"{side}_foot"]
        low = joints[:, toe, 1, 3] < standing[toe, 1, 3] + 0.001
        moved = np.hypot(*np.diff(joints[:, toe][:, [0, 2], 3], axis=0).T)
        slides.append(moved[low[1:] & low[:-1] & ~turning])
    assert len(slides[0]) > 20
    found = np.concatenate(slides)
    assert np.mean(found < 0.0005) > 0.9
    assert found.max() < 0.01  # a toe that leaves between two steps, less than a millimetre up in the second


def test_the_log_grows_with_the_episode(home: Scene, free: FreeSpace, tmp_path: Path) -> None:
    path = tmp_path / "live.mcap"
    steps = []

    def watch(_: int) -> None:
        steps.append(path.with_name("live.mcap.part").stat().st_size)

    recording = simulate_social_nav(world(home, free), sink=lambda h: RecordingWriter(path, h), progress=watch)
    assert len(set(steps)) >= 4
    read = open_recording(path)
    assert isinstance(read, Recording)
    assert recordings_equal(recording, read) == []
    assert not path.with_name("live.mcap.part").exists()


def test_an_interrupted_episode_can_be_recovered(home: Scene, free: FreeSpace, tmp_path: Path) -> None:
    from h3data.recording import recover_mcap

    path = tmp_path / "cut.mcap"

    def stop(_: int, count: list[int] = [0]) -> None:  # noqa: B006 - a counter
        count[0] += 1
        if count[0] == 100:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_social_nav(world(home, free), sink=lambda h: RecordingWriter(path, h), progress=stop)
    assert not path.exists()
    assert recover_mcap(tmp_path / "cut.mcap.part", path).steps >= 90


# --- policies -----------------------------------------------------------------------------------------------------------
def view(free: FreeSpace, robot: np.ndarray, heading: float, human: np.ndarray) -> SocialNavView:
    return SocialNavView(free, robot, heading, human, float(free.geodesic(robot, human)), False)


@pytest.fixture(scope="module")
def lane(free: FreeSpace) -> tuple[np.ndarray, np.ndarray]:
    """Two points 3 m apart in plain sight of each other."""
    rng = np.random.default_rng(4)
    while True:
        a, b = free.sample(rng, 2)
        if 2.9 < np.hypot(*(a - b)) < 3.3 and free.geodesic(a, b) < np.hypot(*(a - b)) + 1e-9:
            return a, b


def test_the_expert_approaches_waits_and_backs_away(free: FreeSpace, lane: tuple[np.ndarray, np.ndarray]) -> None:
    a, b = lane
    spec = BaseSpec()
    towards = float(np.arctan2(-(b - a)[1], (b - a)[0]))
    far = rollout_expert(view(free, a, towards, b), spec)
    assert far.forward == pytest.approx(1.0)
    assert abs(far.turn) < 1e-6
    near = b + (a - b) / np.hypot(*(a - b)) * 1.0
    back = rollout_expert(view(free, near, towards, b), spec)
    assert back.forward < 0
    assert back.skill == "back_up"
    away = rollout_expert(view(free, near, towards + np.pi, b), spec)
    assert away.forward == 0  # the person is behind: turn first
    assert abs(away.turn) == pytest.approx(1.0)


def test_random_actions_are_the_same_for_the_same_seed(home: Scene, free: FreeSpace) -> None:
    first, again = (
        simulate_social_nav(world(home, free, max_steps=40, end_on_collision=False), policy="random") for _ in range(2)
    )
    other = simulate_social_nav(world(home, free, seed=6, max_steps=40, end_on_collision=False), policy="random")
    actions = first.columns["agent_0.action"]
    assert not recordings_equal(first, again)
    assert not np.array_equal(actions, other.columns["agent_0.action"])
    assert actions.min() < -0.5 < 0.5 < actions.max()
    assert len(np.unique(actions, axis=0)) == len(actions) == 40


def test_unknown_policies_are_listed() -> None:
    with pytest.raises(InputError, match=r"(?s)rollout_expert.*H3-POLICY-002"):
        resolve_policy(SocialNav(), "robot", "magic", None)


# --- the oracle ---------------------------------------------------------------------------------------------------------
def test_oracle_steps_of_a_straight_line() -> None:
    spec = SocialNavSpec()
    path = np.array([[0.0, 0.0], [10.0, 0.0]])
    straight = np.ceil(8.0 / (2.5 * STEP_S))
    assert steps_to_find(path, 0.0, spec) == straight
    assert steps_to_find(path, np.pi / 2, spec) == straight  # it turns meanwhile
    assert steps_to_find(path * 0.3, np.pi, spec) == np.ceil(np.pi / (2.5 * STEP_S))
    assert steps_to_find(np.array([[0.0, 0.0], [1.5, 0.0]]), 0.0, spec) == 0
    assert steps_to_find(path[:1], 0.0, spec) == 0


def test_corners_cost_turning_until_she_is_within_reach() -> None:
    spec = SocialNavSpec(far_m=0.5)
    zigzag = np.array([[0.0, 0.0], [0.5, 0.0], [0.5, -0.5], [1.0, -0.5], [1.0, -1.0]])
    assert steps_to_find(zigzag, 0.0, spec) == np.ceil(np.pi / (2.5 * STEP_S))  # the last corner lies behind the end
    assert steps_to_find(zigzag * 10, 0.0, spec) == np.ceil(19.5 / (2.5 * STEP_S))


def test_the_oracle_meets_one_who_stands_and_not_one_out_of_time(
    free: FreeSpace, lane: tuple[np.ndarray, np.ndarray]
) -> None:
    a, b = lane
    spec = SocialNavSpec()
    towards = float(np.arctan2(-(b - a)[1], (b - a)[0]))
    needed = int(steps_to_find(free.path(a, b), towards, spec))
    assert oracle_min_steps(free, a, towards, np.tile(b, (200, 1)), spec) == needed + 1  # r < i, not r <= i
    assert oracle_min_steps(free, a, towards, np.tile(b, (needed, 1)), spec) is None


def test_no_policy_is_faster_than_the_oracle(home: Scene, free: FreeSpace) -> None:
    """``l`` is a minimum: whoever finds the person in step p had ``r_p <= p``, so ``l <= p + 1``."""
    for seed in range(examples(6)):
        recording = simulate_social_nav(world(home, free, seed=seed, max_steps=400))
        found = next(e.step for e in recording.events if e.kind == "found") + 1
        assert 1 < recording.episode.info["oracle_min_steps"] <= found + 1


def test_recorded_heading_is_the_heading(home: Scene, free: FreeSpace) -> None:
    recording = simulate_social_nav(world(home, free, max_steps=30))
    start = recording.episode.info["robot_start"]
    first = heading_from_quat(recording.columns["agent_0.base_pose"][0, 3:].astype(np.float64))
    assert abs(np.angle(np.exp(1j * (first - start[2])))) <= 2.5 * STEP_S + 1e-6
