"""Training environments: Gymnasium, single and vector, and PettingZoo."""

from __future__ import annotations

import pickle
import subprocess
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from pettingzoo.test import parallel_api_test, parallel_seed_test

import h3data
import h3data.envs
from h3data.errors import InputError, MissingExtraError, SceneError
from h3data.plugins import own_entries
from sim_kinematic.envs.parallel import TaskParallelEnv
from sim_kinematic.envs.single import TaskEnv
from sim_kinematic.envs.vector import TaskVectorEnv
from sim_kinematic.motion.spec import NATURAL_WALKER, BaseSpec, SocialNavSpec, WalkerSpec
from sim_kinematic.motion.step import least_clearance
from sim_kinematic.policies.policy import Velocity
from sim_kinematic.policies.social_nav import rollout_expert
from sim_kinematic.policies.views import SocialNavView
from sim_kinematic.sensing.agent_pictures import DETECTORS
from sim_kinematic.sensing.table import SENSORS
from sim_kinematic.tasks.episode import with_options
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.rearrange.episode import ORACLE_RULES
from sim_kinematic.tasks.registry import task_registry
from tests.random_cases import examples
from tests.sim.steppers import PAIR, Batch
from tests.sim.steppers import social_nav_env as make
from tests.simulated import simulate_social_nav

HOME = "small:1"
SHORT = SocialNavSpec(max_steps=40, spawn_distance_m=3.0)
EVERYTHING = (*SENSORS, "arm_depth", "arm_rgb", *DETECTORS)
SIZES: dict[str, Any] = {"depth_size": (48, 36), "rgb_size": (32, 20)}


def expert(play: WorldRollout, w: int = 0) -> np.ndarray:
    """What the expert does in one world, float32 [2]."""
    (robot,), (person,) = play.world.state.robots, play.world.state.people
    episode = play.episodes[w]
    view = SocialNavView(
        episode.free, robot.xz[w], float(robot.heading[w]), person.xz[w], float(play.memory.geodesic[w]), False
    )
    return np.array(rollout_expert(view, play.spec.robot)[:2], np.float32)


def ram(play: WorldRollout) -> np.ndarray:
    """Drives at the person until they touch."""
    (robot,), (person,) = play.world.state.robots, play.world.state.people
    view = SocialNavView(play.episodes[0].free, robot.xz[0], float(robot.heading[0]), person.xz[0], 100.0, False)
    return np.array(rollout_expert(view, play.spec.robot)[:2], np.float32)


def assert_same(a: dict[str, Any], b: dict[str, Any]) -> None:
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


# --- the checkers of others ---------------------------------------------------------------------------------------------
def test_gymnasium_accepts_the_environment() -> None:
    env = gymnasium.make("h3data/SocialNav-v0", scenes=HOME, observations=EVERYTHING, **SIZES)
    check_env(env.unwrapped)


def test_gymnasium_lists_every_built_in_task() -> None:
    assert set(h3data.envs.IDS.values()) == set(own_entries("h3data.tasks")) <= set(task_registry().names())
    for name in h3data.envs.IDS:
        env = gymnasium.make(name, scenes=HOME)
        assert env.observation_space.contains(env.reset(seed=1)[0])
        assert gymnasium.make(env.spec).reset(seed=1)[1]["episode_seed"] == env.reset(seed=1)[1]["episode_seed"]
    code = (
        "import gymnasium, sys, h3data.envs; gymnasium.spec('h3data/Wander-v0'); print('sim_kinematic' in sys.modules)"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == "False"


def test_gymnasium_runs_the_vector_environment_in_its_wrappers() -> None:
    env = gymnasium.make_vec("h3data/SocialNav-v0", num_envs=3, scenes=HOME, spec=SHORT)
    env = gymnasium.wrappers.vector.RecordEpisodeStatistics(env)
    env.reset(seed=1)
    env.action_space.seed(1)
    ends = [env.step(env.action_space.sample())[4] for _ in range(42)]
    assert ends[39]["episode"]["l"].tolist() == [40, 40, 40]
    assert env.observation_space["humanoid_gps"].shape == (3, 2)


def test_pettingzoo_accepts_the_environment() -> None:
    parallel_api_test(make(agents=PAIR, scenes=HOME, spec=SHORT, observations=EVERYTHING, **SIZES), num_cycles=100)
    parallel_seed_test(lambda: make(agents=PAIR, scenes=HOME, spec=SHORT), num_cycles=30)


# --- the same episodes everywhere ---------------------------------------------------------------------------------------
def test_flat_observations_are_the_others_in_a_row() -> None:
    pair = make(agents=PAIR, scenes=HOME, spec=SHORT, flatten=True)
    parallel_api_test(pair, num_cycles=5)
    named, flat = make(agents=PAIR, scenes=HOME, spec=SHORT), pickle.loads(pickle.dumps(pair))
    expected, got = named.reset(seed=4)[0], flat.reset(seed=4)[0]
    for agent in PAIR:
        assert isinstance(flat.observation_space(agent), gymnasium.spaces.Box)
        assert flat.observation_space(agent).contains(got[agent])
        row = gymnasium.spaces.flatten(named.observation_space(agent), expected[agent])
        np.testing.assert_array_equal(got[agent], row)
    check_env(make(scenes=HOME, spec=SHORT, flatten=True), skip_render_check=True)
    worlds = make(scenes=HOME, spec=SHORT, num_envs=2, flatten=True)
    seen = worlds.reset(seed=4)[0]
    assert seen.shape == worlds.observation_space.shape
    with pytest.raises(InputError, match="H3-ENV-019"):
        make(scenes=HOME, flatten=True, device="cpu")


def test_supersuit_wraps_flat_environments() -> None:
    supersuit = pytest.importorskip("supersuit", reason="SuperSuit is not installed")
    env = make(agents=PAIR, scenes=HOME, spec=SHORT, flatten=True)
    env = supersuit.pad_action_space_v0(supersuit.pad_observations_v0(supersuit.flatten_v0(env)))
    many = supersuit.concat_vec_envs_v1(supersuit.pettingzoo_env_to_vec_env_v1(env), 2, base_class="gymnasium")
    observations, _ = many.reset(seed=1)
    assert observations.shape == (4, env.observation_space("robot").shape[0])


def test_it_is_the_episode_that_the_simulator_plays() -> None:
    env = make(scenes=HOME, spec=SocialNavSpec(max_steps=200, spawn_distance_m=3.0))
    _, info = env.reset(seed=4)
    played: list[np.ndarray] = []

    def again(view: SocialNavView, spec: BaseSpec) -> Velocity:
        del spec
        return Velocity(float(played[view.step][0]), float(played[view.step][1]), "find")

    track, ended = [], ""
    while not ended:
        played.append(expert(env.stepper.play))
        _, _, terminated, truncated, info = env.step(played[-1])
        s = env.stepper.play.world.state
        track.append([*s.robots[0].xz[0], *s.people[0].xz[0], info["geodesic_m"]])
        ended = "collision" if terminated else "max_steps" if truncated else ""
    recording = simulate_social_nav(env.stepper.play.episodes[0], policy=again)
    assert recording.episode.info["ended"] == ended
    columns = recording.columns
    robot, human = columns["agent_0.base_pose"][:, [0, 2]], columns["agent_1.base_pose"][:, [0, 2]]
    recorded = np.column_stack([robot, human, columns["metrics.geodesic_agents"]])
    np.testing.assert_array_equal(np.array(track, np.float32), recorded)
    assert info["found"] == any(e.kind == "found" for e in recording.events)


def test_a_world_of_many_is_a_world_alone() -> None:
    scenes, worlds = [HOME, "small:2"], 64
    many = make(num_envs=worlds, scenes=scenes, spec=SHORT)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.3, 1.3, (95, worlds, 2)).astype(np.float32)  # two autoresets
    first, told = many.reset(seed=7)
    assert len(set(told["scene"])) == 2
    steps = [many.step(a) for a in actions]
    for w in (0, 1, 17, 63):
        one = make(scenes=scenes, spec=SHORT)
        seen, info = one.reset(seed=7 + w)
        assert (info["scene"], info["episode_seed"]) == (told["scene"][w], told["episode_seed"][w])
        assert_same(seen, {k: v[w] for k, v in first.items()})
        over = False
        for action, (all_seen, rewards, terminated, truncated, all_info) in zip(actions, steps, strict=True):
            if over:
                (seen, info), reward, ends, runs_out = one.reset(), 0.0, False, False
            else:
                seen, reward, ends, runs_out, info = one.step(action[w])
            over = ends or runs_out
            assert_same(seen, {k: v[w] for k, v in all_seen.items()})
            assert (reward, ends, runs_out) == (rewards[w], terminated[w], truncated[w])
            assert all(all_info[name][w] == value for name, value in info.items())


def test_pictures_of_many_worlds_are_those_of_each() -> None:
    many = make(num_envs=3, scenes=HOME, observations=EVERYTHING, **SIZES)
    seen = [many.reset(seed=2)[0]]
    actions = np.random.default_rng(1).uniform(-1, 1, (6, 3, 2)).astype(np.float32)
    seen += [many.step(a)[0] for a in actions]
    mixed = make(num_envs=3, scenes=[HOME, HOME], observations=EVERYTHING, **SIZES)  # drawn world by world
    again = [mixed.reset(seed=2)[0], *(mixed.step(a)[0] for a in actions)]
    one = make(scenes=HOME, observations=EVERYTHING, **SIZES)
    alone = [one.reset(seed=4)[0], *(one.step(a[2])[0] for a in actions)]
    for k, all_seen in enumerate(seen):
        assert_same({n: v[2] for n, v in all_seen.items()}, alone[k])
        assert 0 < all_seen["arm_depth"].max() <= 1
    assert again[0]["arm_depth"].shape == seen[0]["arm_depth"].shape == (3, 36, 48, 1)


def test_seeds_decide_everything() -> None:
    a, b = make(scenes=HOME, spec=SHORT), make(scenes=HOME, spec=SHORT)
    a.reset(seed=1)  # episodes before a seed do not matter
    a.reset()
    assert_same(a.reset(seed=9)[0], b.reset(seed=9)[0])
    second, same = a.reset(), b.reset()
    assert_same(second[0], same[0])
    assert second[1]["episode_seed"] == same[1]["episode_seed"] != a.reset(seed=9)[1]["episode_seed"]
    c = make(scenes=HOME, spec=SHORT)
    assert c.reset()[1]["episode_seed"] != make(scenes=HOME, spec=SHORT).reset()[1]["episode_seed"]
    vector = make(num_envs=2, scenes=HOME, spec=SHORT)
    told = vector.reset(seed=[9, 9])[1]["episode_seed"]
    assert told[0] == told[1] == a.reset(seed=9)[1]["episode_seed"]


# --- rules --------------------------------------------------------------------------------------------------------------
def test_touching_terminates_and_time_truncates() -> None:
    env = make(scenes=HOME, spec=SocialNavSpec(max_steps=900, spawn_distance_m=3.0, human=WalkerSpec(speed_mps=0.8)))
    env.reset(seed=3)
    result = next(r for r in iter(lambda: env.step(ram(env.stepper.play)), None) if r[2] or r[3])
    assert result[2]
    assert result[4]["collides"]
    assert not result[3]
    env = make(scenes=HOME, spec=SHORT)
    env.reset(seed=3)
    ends = [env.step(np.zeros(2))[2:4] for _ in range(40)]
    assert ends == [(False, False)] * 39 + [(False, True)]


def test_following_long_enough_is_success() -> None:
    spec = SocialNavSpec(max_steps=1500, spawn_distance_m=3.0, human=WalkerSpec(speed_mps=0.5))
    env = make(scenes=HOME, spec=spec, end_on_success=True)
    env.reset(seed=1)
    rewards = []
    for _ in range(1500):
        _, reward, terminated, _, info = env.step(expert(env.stepper.play))
        rewards.append(reward)
        if terminated:
            break
    assert info["success"]
    assert info["found"]
    assert info["followed"] == 400
    assert not info["collides"]
    assert rewards[-1] - rewards[-2] == pytest.approx(10, abs=1.0)


def test_far_away_the_reward_is_the_way_gained() -> None:
    env = make(scenes=HOME, spec=SocialNavSpec(spawn_distance_m=6.0))
    _, info = env.reset(seed=5)
    for _ in range(15):
        before = info["geodesic_m"]
        _, reward, _, _, info = env.step(expert(env.stepper.play))
        assert reward == pytest.approx(before - info["geodesic_m"] - 0.1)


def test_observations_are_of_the_state() -> None:
    env = make(scenes=HOME, observations=EVERYTHING)
    env.reset(seed=5)
    s = env.stepper.play.world.state
    free = env.stepper.play.episodes[0].free
    rng = np.random.default_rng(2)
    while True:  # a person 2.5 m ahead in plain sight, about to stand there: the camera sees them
        a, b = free.sample(rng, 2)
        if 2.4 < np.hypot(*(a - b)) < 2.6 and free.geodesic(a, b) < np.hypot(*(a - b)) + 1e-9:
            break
    s.robots[0].xz[0], s.people[0].xz[0] = a, b
    towards = float(np.arctan2(-(b - a)[1], (b - a)[0]))
    detected = []
    for turned in (0.0, np.pi):
        s.robots[0].heading[0] = towards + turned
        seen = env.stepper.observe("robot")
        detected.append(seen["humanoid_detector"][0, 0])
        np.testing.assert_allclose(seen["humanoid_gps"][0, 0], np.hypot(*(a - b)), rtol=1e-6)
        assert abs(seen["humanoid_gps"][0, 1]) == pytest.approx(turned, abs=1e-5)
    assert detected == [1.0, 0.0]
    env.reset(seed=5)
    heading = float(s.robots[0].heading[0])
    seen = env.step(np.array([0.0, 1.0]))[0]
    np.testing.assert_allclose(seen["egomotion"], [0, 0, 2.5], atol=1e-5)
    np.testing.assert_allclose(np.sin(seen["localization"][3] - heading - 2.5 / 30), 0, atol=1e-5)


def test_a_picture_from_above() -> None:
    env = make(scenes=HOME, render_mode="rgb_array")
    env.reset(seed=5)
    picture = env.render()
    assert picture is not None
    assert picture.shape == (480, 640, 3)
    assert picture.std() > 20
    assert make(scenes=HOME).render() is None


# --- two agents ---------------------------------------------------------------------------------------------------------
def test_a_driven_person_walks_where_she_can() -> None:
    env = make(agents=PAIR, scenes=HOME, spec=SocialNavSpec(max_steps=400, end_on_collision=False))
    env.reset(seed=1)
    s, free = env.stepper.play.world.state, env.stepper.play.episodes[0].free
    rng = np.random.default_rng(3)
    turns = np.repeat(rng.uniform(-1, 1, 20), 20)
    for turn in turns:
        before, heading = s.people[0].xz[0].copy(), float(s.people[0].heading[0])
        seen, rewards, _, _, _ = env.step({"robot": rng.uniform(-1, 1, 2), "human": np.array([1.0, turn])})
        assert free.signed_distance(s.people[0].xz[0]) >= 0.25 - 2e-3
        assert (s.people[0].xz[0] - before) @ (np.cos(heading), -np.sin(heading)) > -0.01
        assert rewards["robot"] == rewards["human"]
        assert seen["robot"]["humanoid_gps"][0] == pytest.approx(seen["human"]["humanoid_gps"][0])
    assert s.people[0].distance[0] > 3
    still = s.people[0].xz[0].copy()
    env.reset(seed=1)
    for _ in range(10):
        env.step({"robot": np.zeros(2), "human": np.array([-1.0, 0.0])})
    np.testing.assert_array_equal(s.people[0].xz[0], env.stepper.play.episodes[0].starts[1, :2])
    assert s.people[0].blend[0] == s.people[0].distance[0] == 0
    assert not np.array_equal(still, s.people[0].xz[0])


# --- anything goes ------------------------------------------------------------------------------------------------------
configurations = st.fixed_dictionaries(
    {
        "seed": st.integers(0, 2**63 - 1),
        "scenes": st.sampled_from([HOME, "small:2", ("small:1", "small:3")]),
        "worlds": st.integers(1, 5),
        "steps": st.integers(1, 60),
        "speed": st.sampled_from([0.5, 1.3, 2.5]),
        "profile": st.sampled_from(["paper", "habitat"]),
        "driven": st.booleans(),
        "lateral": st.sampled_from([0.0, 1.0]),
        "habit": st.floats(-1, 1),
        "pictures": st.sampled_from([False, False, True]),
        "body": st.sampled_from([("quad_arm", "female_0"), ("lift_arm", "male_2")]),
    }
)


def play_at_random(c: dict[str, Any], episodes: int) -> int:
    """Plays at least so many episodes of a configuration; returns how many."""
    spec = SocialNavSpec(
        max_steps=c["steps"],
        spawn_distance_m=3.0,
        human=WalkerSpec(speed_mps=c["speed"]),
        robot=BaseSpec(max_lateral_mps=c["lateral"]),
    )
    robot, human = c["body"]
    seen = EVERYTHING if c["pictures"] else ("humanoid_gps", "egomotion", "localization")
    batch = Batch(
        c["scenes"],
        worlds=c["worlds"],
        spec=spec,
        reward=c["profile"],
        driven=c["driven"],
        robot=robot,
        human=human,
        observations=seen,
        depth_size=(16, 12),
    )
    space = gymnasium.vector.utils.batch_space(batch.space(), c["worlds"])
    width = batch.stepper.action_space("robot").shape[0]
    rng = np.random.default_rng(c["seed"])
    index, over, ended = np.zeros(c["worlds"], int), np.ones(c["worlds"], bool), 0
    base = batch.play.world.bases[0]  # of the robot's own body
    offsets = np.array(base.disc_offsets_m)
    while ended < episodes:
        batch.begin(c["seed"] + np.arange(c["worlds"], dtype=object), index, where=over)
        actions = rng.uniform(-2, 2, (c["worlds"], width)) + c["habit"]  # some of them always turn or push
        reward = batch.step(actions, rng.uniform(-2, 2, (c["worlds"], 2)) + c["habit"] if c["driven"] else None)
        s = batch.state
        assert all(np.isfinite(array).all() for array in s.arrays())
        assert np.isfinite(reward).all()
        assert space.contains(batch.observe())
        for w, episode in enumerate(batch.episodes):
            free = episode.free
            grid = free.sdf, free.origin, free.cell_m
            clearance = least_clearance(*grid, *s.robots[0].xz[w], s.robots[0].heading[w], offsets)
            assert clearance >= base.disc_radius_m - 2e-3 - 1e-9
            assert np.hypot(*(free.snap(s.people[0].xz[w]) - s.people[0].xz[w])) <= 2e-3
        over = batch.ends | batch.play.out_of_time
        index, ended = index + over, ended + int(over.sum())
    return ended


@given(c=configurations)
@settings(max_examples=examples(4))
def test_random_actions_do_no_harm(c: dict[str, Any]) -> None:
    play_at_random(c, episodes=2)


@pytest.mark.slow
def test_a_thousand_random_episodes_do_no_harm() -> None:
    ended = 0

    @given(c=configurations)
    @settings(max_examples=200)
    def run(c: dict[str, Any]) -> None:
        nonlocal ended
        ended += play_at_random(c, episodes=5)

    run()
    assert ended >= 1000


# --- bad input ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("action", [[0.0], [[0.0, 0.0]], 0.0, [0.0, np.nan], [np.inf, 0.0], ["a", "b"], [[1], [2, 3]]])
def test_bad_actions_move_nothing(action: Any) -> None:
    env = make(scenes=HOME, spec=SHORT)
    env.reset(seed=1)
    before = env.stepper.play.world.state.copy()
    with pytest.raises(InputError, match=r"H3-ENV-0(10|29|31)"):
        env.step(action)
    for was, now in zip(before.arrays(), env.stepper.play.world.state.arrays(), strict=True):
        np.testing.assert_array_equal(was, now)
    vector = make(num_envs=2, scenes=HOME, spec=SHORT)
    vector.reset(seed=1)
    with pytest.raises(InputError, match=r"H3-ENV-0(10|29|31)"):
        vector.step([action, action])


def test_actions_are_clipped() -> None:
    a, b = make(scenes=HOME, spec=SHORT), make(scenes=HOME, spec=SHORT)
    a.reset(seed=1)
    b.reset(seed=1)
    assert_same(a.step(np.array([5.0, -7.0]))[0], b.step(np.array([1.0, -1.0]))[0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "chess"}, r"(?s)Expected one of.*social_nav.*H3-FILE-011"),
        ({"scenes": "castle"}, "H3-HABITAT-108"),
        ({"scenes": []}, "H3-TASK-058"),
        ({"scenes": 3}, "H3-TASK-059"),
        ({"num_envs": 0}, "H3-SIM-050"),
        ({"observations": ["smell"]}, r"(?s)humanoid_gps.*H3-SIM-046"),
        ({"observations": "arm_depth"}, "H3-SIM-046"),
        ({"observations": ["arm_depth"], "depth_size": (0, 3)}, "H3-SIM-039"),
        ({"robot": "tank"}, r"(?s)quad_arm.*H3-BODY-102"),
        ({"human": "ghost"}, r"(?s)female_0.*H3-BODY-072"),
        ({"rules": "chess"}, r"(?s)natural, paper.*H3-TASK-001"),
        ({"reward": "gold"}, r"(?s)paper, habitat.*H3-TASK-041"),
        ({"partner": "both"}, r"(?s)waypoints.*H3-POLICY-002"),
        ({"render_mode": "human"}, "H3-ENV-024"),
        ({"agents": ("robot", "robot")}, "H3-ENV-033"),
        ({"agents": ("robot", "human"), "num_envs": 2}, "H3-ENV-018"),
    ],
)
def test_what_does_not_exist_is_told_with_what_does(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        h3data.make(**{"task": "social_nav", "scenes": HOME, **options})


def test_reset_and_agents_come_first() -> None:
    with pytest.raises(InputError, match="H3-ENV-016"):
        make(scenes=HOME).step(np.zeros(2))
    with pytest.raises(InputError, match="H3-ENV-016"):
        make(scenes=HOME, render_mode="rgb_array").render()
    pair = make(agents=PAIR, scenes=HOME)
    with pytest.raises(InputError, match=r"(?s)reset.*H3-ENV-022"):
        pair.step({"robot": np.zeros(2), "human": np.zeros(2)})
    pair.reset(seed=1)
    with pytest.raises(InputError, match=r"(?s)robot, human.*H3-ENV-022"):
        pair.step({"robot": np.zeros(2)})
    with pytest.raises(InputError, match=r"(?s)3.*H3-ENV-032"):
        make(num_envs=3, scenes=HOME).reset(seed=[1, 2])
    with pytest.raises(SceneError, match="H3-TASK-048"):
        make(scenes=HOME, spec=SocialNavSpec(spawn_distance_m=500.0)).reset(seed=1)


# --- make ---------------------------------------------------------------------------------------------------------------
def test_make_takes_the_name_of_a_set_of_rules() -> None:
    usual, paper = h3data.make("social_nav", HOME), h3data.make("social_nav", HOME, rules="paper")
    assert usual.unwrapped.stepper.spec.human == NATURAL_WALKER
    assert paper.unwrapped.stepper.spec == with_options(usual.unwrapped.stepper.spec, rules="paper")
    assert paper.unwrapped.stepper.spec.person_contact == "bones"
    short = h3data.make("social_nav", HOME, num_envs=2, spec=SocialNavSpec(max_steps=7), rules="paper")
    assert short.stepper.spec == with_options(SocialNavSpec(max_steps=7), rules="paper")
    assert paper.unwrapped.recipe.options["rules"] == "paper"


def test_on_a_device_the_rules_are_those_of_the_devices_worlds() -> None:
    pytest.importorskip("torch")
    env = h3data.make("rearrange", HOME, num_envs=2, device="cpu", rules="paper", episodes=2)
    assert env.sim.spec == with_options(ORACLE_RULES, rules="paper")
    nav = h3data.make("social_nav", HOME, num_envs=2, device="cpu", rules="paper", episodes=2)
    assert nav.sim.spec.person_contact == "bones"


def test_make_finds_tasks_without_knowing_them() -> None:
    assert isinstance(h3data.make("social_nav", scenes=HOME), TaskEnv)
    vector = h3data.make("social_nav", scenes=HOME, num_envs=3)
    assert isinstance(vector, TaskVectorEnv)
    assert vector.num_envs == 3
    assert isinstance(h3data.make("social_nav", scenes=HOME, agents=("robot", "human")), TaskParallelEnv)
    code = (
        "import sys, h3data; print([m for m in sys.modules if 'sim_kin' in m]); h3data.make; "
        "print([m for m in sys.modules if 'gymn' in m or 'torch' in m])"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.split() == ["[]", "[]"]


def test_without_gymnasium_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in [name for name in sys.modules if name.startswith(("sim_kinematic.envs.", "sim_kinematic.sensing."))]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(MissingExtraError, match="H3-SIM-045"):
        h3data.make("social_nav", scenes=HOME)
