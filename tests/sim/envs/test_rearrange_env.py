"""Training environments of rearrangement: the checkers of others, the same episodes as the simulator, any actions at all."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from pettingzoo.test import parallel_api_test, parallel_seed_test

import h3data.envs
from h3data.errors import InputError
from sim_kinematic.agents.person_skills import PersonActor
from sim_kinematic.agents.robots.skills import RobotActor
from sim_kinematic.agents.skills import CONTROL, Action, choices
from sim_kinematic.envs.parallel import TaskParallelEnv
from sim_kinematic.envs.single import TaskEnv
from sim_kinematic.motion.state import NOBODY
from sim_kinematic.motion.step import least_clearance
from sim_kinematic.policies.rearrange import planner, robot_policy
from sim_kinematic.policies.rearrange_observations import PAPER_SENSES, SENSES, exact
from sim_kinematic.sensing.agent_pictures import DETECTORS
from sim_kinematic.tasks.rearrange.episode import RearrangeSpec
from tests.random_cases import examples
from tests.sim.steppers import PAIR, SkillSession
from tests.sim.steppers import rearrange_env as make_env
from tests.simulated import simulate_rearrange

HOME = "small:1"
OF_ROBOT = (*SENSES, "arm_depth", "arm_rgb", *DETECTORS, "front_left_depth", "back_rgb")
OF_PERSON = (*(name for name in SENSES if name != "arm_joints"), "head_depth", "head_rgb")
SIZES: dict[str, Any] = {"depth_size": (28, 21), "rgb_size": (32, 24)}
NAV_0, NAV_1, PICK_0, PLACE_0, WAIT, FORWARD = 0, 1, 4, 6, 8, 9
"""Of `choices(2)`."""


def assert_same(a: dict[str, Any], b: dict[str, Any]) -> None:
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


# --- the checkers of others ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "options",
    [
        {},
        pytest.param({"level": "low"}, marks=pytest.mark.slow),
        pytest.param({"agent": "human"}, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_gymnasium_accepts_the_environment(options: dict[str, Any]) -> None:
    name, names = "h3data/Rearrange-v0", OF_PERSON if "agent" in options else OF_ROBOT
    env = gymnasium.make(name, scenes=HOME, observations=names, render_mode="rgb_array", **SIZES, **options)
    check_env(env.unwrapped)


@pytest.mark.parametrize("level", ["high", pytest.param("low", marks=pytest.mark.slow)])
def test_pettingzoo_accepts_the_environment(level: str) -> None:
    names = dict.fromkeys((*OF_ROBOT, *OF_PERSON))
    parallel_api_test(make_env(HOME, agents=PAIR, level=level, observations=tuple(names), **SIZES), num_cycles=25)  # type: ignore[arg-type]


def test_pettingzoo_finds_the_same_seeds() -> None:
    parallel_seed_test(lambda: make_env(HOME, agents=PAIR), num_cycles=8)


# --- the same episodes everywhere ---------------------------------------------------------------------------------------
def test_worlds_observe_together_what_each_observes_alone() -> None:
    env = h3data.make("rearrange", HOME, num_envs=3, partner="both", observations=tuple(SENSES))
    env.reset(seed=0)
    for action in (NAV_0, FORWARD, NAV_1):
        env.step(np.full(3, action))
        views = [play.view(0) for play in env.unwrapped.stepper.plays]
        for name, values in exact(views, tuple(SENSES)).items():
            for view, value in zip(views, values, strict=True):
                np.testing.assert_array_equal(value, exact([view], [name])[name][0], err_msg=name)


def test_it_is_the_episode_that_the_simulator_plays() -> None:
    session = SkillSession(HOME, partner="both", interrupts_when_close=False)
    session.begin(4, 0)
    assert session.play is not None
    greedy, rewards = robot_policy("greedy_nearest"), 0.0
    heights = []
    while not session.ended:
        action = greedy.act(session.view("robot"))
        session.step({"robot": action})
        rewards += session.reward
        heights.append(session.play.step)

    never = robot_policy("greedy_nearest")
    never.interrupts = lambda view: ""  # outside, nobody has second thoughts
    recording = simulate_rearrange(session.play.episode, policy=never, partner="both", solo_steps=1)
    assert recording.episode.info["ended"] == session.ended
    assert len(recording) == session.play.step == heights[-1]
    np.testing.assert_array_equal(
        recording.columns["object_pose"][-1], session.play.team.objects.poses.astype(np.float32)
    )
    assert rewards == pytest.approx(float(recording.columns["metrics.reward"].astype(np.float64).sum()), abs=1e-4)
    assert sorted(heights) == heights


@pytest.mark.slow
def test_two_outside_play_the_planners_episode() -> None:
    """Both agents outside, each told by the policy that would have moved it: the same bits."""
    session = SkillSession(HOME, agents=("robot", "human"), interrupts_when_close=False)
    session.begin(4, 0)
    assert session.play is not None
    seed = session.play.episode.seed
    policies = {"robot": robot_policy("same_object"), "human": planner("object_1", seed)}
    alone = SkillSession(HOME, partner=lambda seed: planner("object_1", seed), interrupts_when_close=False)
    alone.begin(4, 0)
    assert alone.play is not None
    other = robot_policy("same_object")
    while not session.ended:
        session.step({name: policies[name].act(session.view(name)) for name in session.choosing})
    while not alone.ended:
        alone.step({"robot": other.act(alone.view("robot"))})
    assert (session.ended, session.play.step) == (alone.ended, alone.play.step)
    np.testing.assert_array_equal(session.play.team.objects.poses, alone.play.team.objects.poses)
    np.testing.assert_array_equal(session.play.memory, alone.play.memory)


def test_seeds_decide_everything() -> None:
    a, b = make_env(HOME), make_env(HOME)
    a.reset(seed=1)
    assert_same(a.reset(seed=9)[0], b.reset(seed=9)[0])
    second, same = a.reset(), b.reset()
    assert_same(second[0], same[0])
    assert second[1]["episode_seed"] == same[1]["episode_seed"] != a.reset(seed=9)[1]["episode_seed"]


# --- rules --------------------------------------------------------------------------------------------------------------
def test_skills_take_their_time_and_what_is_infeasible_takes_a_step() -> None:
    env = make_env(HOME, partner="still", observations=(*PAPER_SENSES, "last_done", "holds"))
    seen, info = env.reset(seed=4)
    assert env.stepper.choosing() == ("robot",)
    assert info["action_mask"].tolist() == [1] * 6 + [0, 0] + [1] * 5
    for bad, reason in ((PICK_0, "out_of_reach"), (PLACE_0, "not_held")):
        seen, reward, _, _, info = env.step(bad)
        assert (info["steps"], info["outcome"], info["reason"]) == (1, "failed", reason)
        assert reward == pytest.approx(-0.005)
    start = seen["obj_start_gps_compass"]
    _, _, _, _, info = env.step(FORWARD)
    assert (info["steps"], info["outcome"]) == (4, "done")
    seen, reward, _, _, info = env.step(NAV_0)
    assert info["outcome"] == "done"
    assert info["steps"] > 10
    assert reward == pytest.approx(-0.005 * info["steps"])
    assert seen["last_done"].argmax() == NAV_0
    assert seen["obj_start_gps_compass"][0] < 1.2 < start[0]
    assert abs(seen["obj_start_gps_compass"][1]) < 0.1
    seen, reward, _, _, info = env.step(PICK_0)
    assert info["outcome"] == "done"
    assert reward == pytest.approx(5 - 0.005 * info["steps"])
    assert seen["is_holding"] == 1
    assert seen["holds"].tolist() == [1, 0]
    assert info["action_mask"].tolist() == [0, 1, 1, 1, 0, 0, 1, 0] + [1] * 5
    assert info["held_by"].tolist() == [0, -1]


@pytest.mark.slow
def test_time_runs_out() -> None:
    env = make_env(HOME, partner="still")
    env.reset(seed=2)
    steps = [env.step(WAIT) for _ in range(300)]
    assert [s[3] for s in steps] == [False] * 299 + [True]
    assert steps[-1][4]["step"] == 1500
    with pytest.raises(InputError, match="H3-ENV-027"):
        env.step(WAIT)
    assert env.reset()[1]["step"] == 0


def test_who_is_close_may_choose_again_and_go_on() -> None:
    """A robot that always wants the same is not held up by being asked."""
    calm = make_env(HOME, partner="still", interrupts_when_close=False)
    asked = make_env(HOME, partner="still", spec=RearrangeSpec(near_m=(50.0, 50.0)))
    took = []
    for env in (calm, asked):
        env.reset(seed=4)
        steps, calls, info = 0, 0, {"outcome": "running"}
        while info["outcome"] != "done":
            *_, info = env.step(NAV_0)
            steps, calls = steps + info["steps"], calls + 1
            assert info["outcome"] in ("done", "aborted")
        took.append((steps, calls))
    assert took[0][0] == took[1][0]
    assert took[0][1] == 1
    assert took[1][1] > 20


def test_the_lower_layer_takes_and_carries() -> None:
    """By hand to an object with the skills' own inverse kinematics; then it is gripped, carried and let go."""
    session = SkillSession(HOME, partner="still", interrupts_when_close=False)
    session.begin(4, 0)
    session.step({"robot": Action("nav_to_object", 0)})
    play = session.play
    assert play is not None
    robot, objects = session.runner("robot").actor, play.team.objects
    assert isinstance(robot, RobotActor)
    _, at = robot._reach_line(robot._hand_target(Action("pick", 0)))
    columns = list(range(7))
    for _ in range(200):
        way = (at - robot.joints)[columns] / 0.05
        session.step({"robot": Action(CONTROL, command=(0, 0, *np.clip(way, -1, 1), 0))})
        assert session.steps == 1
        if np.abs(way).max() < 1e-6:
            break
    assert objects.held(0) == -1
    session.step({"robot": Action(CONTROL, command=(0,) * 9 + (1,))})
    assert objects.held(0) == 0
    assert session.reward == pytest.approx(5 - 0.005)
    np.testing.assert_allclose(objects.poses[0, :3], robot.hand_pose[:3], atol=1e-9)
    for _ in range(10):
        session.step({"robot": Action(CONTROL, command=(-1.0, 0.3, *([0] * 7), 0.0))})
        np.testing.assert_allclose(objects.poses[0, :3], robot.hand_pose[:3], atol=1e-9)
    session.step({"robot": Action(CONTROL, command=(0,) * 9 + (-1,))})
    left = objects.poses[0].copy()
    session.step({"robot": Action(CONTROL, command=(-1.0,) + (0,) * 9)})
    assert objects.held(0) == NOBODY
    np.testing.assert_array_equal(objects.poses[0], left)


def test_of_two_only_who_chooses_is_heard() -> None:
    env = make_env(HOME, agents=PAIR, interrupts_when_close=False)
    _, infos = env.reset(seed=4)
    assert infos["robot"]["choosing"]
    assert infos["human"]["choosing"]
    _, rewards, _, _, infos = env.step({"robot": WAIT, "human": NAV_0})
    assert rewards["robot"] == rewards["human"]
    assert infos["robot"]["choosing"]
    assert not infos["human"]["choosing"]
    before = env.stepper.play.team.controllers[1].action
    env.step({"robot": WAIT, "human": NAV_1})
    assert env.stepper.play.team.controllers[1].action == before == choices(2, robot=False)[NAV_0]


# --- anything goes ------------------------------------------------------------------------------------------------------
configurations = st.fixed_dictionaries(
    {
        "seed": st.integers(0, 2**63 - 1),
        "agents": st.sampled_from(["robot", "human", "both"]),
        "level": st.sampled_from(["high", "low"]),
        "close": st.booleans(),
        "masked": st.booleans(),
        "pictures": st.booleans(),
        "scene": st.sampled_from([HOME, "small:2"]),
    }
)


def make(c: dict[str, Any]) -> TaskParallelEnv | TaskEnv:
    common: dict[str, Any] = {"interrupts_when_close": c["close"], **SIZES}
    robots, persons = (names if c["pictures"] else [n for n in names if n in SENSES] for names in (OF_ROBOT, OF_PERSON))
    if c["agents"] == "both":
        return make_env(c["scene"], agents=PAIR, level=c["level"], observations=[*robots, *persons], **common)
    level = c["level"] if c["agents"] == "robot" else "high"
    names = robots if c["agents"] == "robot" else persons
    return make_env(c["scene"], agent=c["agents"], level=level, observations=names, **common)


def play_at_random(c: dict[str, Any], *, actions: int) -> None:
    """Random actions, half of the time only feasible ones: nothing breaks, and bases stay out of obstacles."""
    env, rng = make(c), np.random.default_rng(c["seed"])
    single = isinstance(env, TaskEnv)
    spaces = (
        {"": (env.action_space, env.observation_space)}
        if single
        else {a: (env.action_space(a), env.observation_space(a)) for a in env.possible_agents}
    )
    for space, _ in spaces.values():
        space.seed(c["seed"] % 2**31)

    def choose(space: Any, info: dict[str, Any]) -> Any:
        if isinstance(space, gymnasium.spaces.Discrete) and c["masked"]:
            return int(rng.choice(np.flatnonzero(info["action_mask"])))
        return space.sample()

    seen, info = env.reset(seed=c["seed"])
    reward: Any
    for _ in range(actions):
        if single:
            seen, reward, ended, late, info = env.step(choose(spaces[""][0], info))
            over, seen = ended or late, {"": seen}
        else:
            seen, reward, ended, late, info = env.step({a: choose(spaces[a][0], info[a]) for a in env.agents})
            over = not env.agents
        assert np.isfinite(list(np.atleast_1d(reward) if single else reward.values())).all()
        assert all(spaces[a][1].contains(seen[a]) for a in seen)
        play = env.stepper.play
        assert play is not None
        assert all(np.isfinite(array).all() for array in play.world.state.arrays())
        base, free = play.episode.spec.robot, play.episode.free
        grid, offsets = (free.sdf, free.origin, free.cell_m), np.array(base.disc_offsets_m)
        robot, person = (env.stepper.play.team.controllers[k].actor for k in (0, 1))
        clearance = least_clearance(*grid, *robot.xz, robot.heading, offsets)
        assert clearance >= base.disc_radius_m - 2e-3 - 1e-9
        assert np.hypot(*(free.snap(person.xz) - person.xz)) <= 2e-3
        assert isinstance(person, PersonActor)
        assert np.isfinite([*person.person.quats.ravel(), *person.person.pelvis]).all()
        if over:
            _, info = env.reset()


@given(c=configurations)
@settings(max_examples=examples(4), deadline=None)
def test_random_actions_do_no_harm(c: dict[str, Any]) -> None:
    play_at_random(c, actions=12)


@pytest.mark.slow
@given(c=configurations)
@settings(max_examples=60, deadline=None)
def test_many_random_actions_do_no_harm(c: dict[str, Any]) -> None:
    play_at_random(c, actions=400)


@pytest.mark.parametrize("action", [-1, 13, 0.5, "pick", None, [1], np.nan], ids=str)
def test_what_is_no_action_moves_nothing(action: Any) -> None:
    env = make_env(HOME)
    env.reset(seed=1)
    assert env.stepper.play is not None
    before = env.stepper.play.world.state.copy()
    with pytest.raises(InputError, match=r"(?s)0.*12.*H3-ENV-028"):
        env.step(action)
    for a, b in zip(before.arrays(), env.stepper.play.world.state.arrays(), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("action", [np.zeros(9), [np.nan] * 10, "drive", np.full(10, np.inf)], ids=str)
def test_what_is_no_command_moves_nothing(action: Any) -> None:
    env = make_env(HOME, level="low")
    env.reset(seed=1)
    with pytest.raises(InputError, match=r"(?s)10.*H3-SIM-018"):
        env.step(action)
    assert env.step(np.zeros(10))[4]["step"] in (0, 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"agents": ("robot", "robot")}, "H3-ENV-033"),
        ({"agents": ("robot", "human"), "num_envs": 2}, "H3-ENV-018"),
        ({"num_envs": 0}, "H3-ENV-030"),
        ({"level": "middle"}, r"(?s)high, low.*H3-ENV-025"),
        ({"agents": ("human",), "level": "low"}, "H3-ENV-026"),
        ({"observations": ["smell"]}, r"(?s)is_holding.*H3-SIM-046"),
        ({"observations": "holds"}, "H3-SIM-046"),
        ({"partner": "nobody"}, "(?s)plan_pop_4.*H3-POLICY-002"),
        ({"agents": ("human",), "partner": "both"}, "(?s)greedy_nearest.*H3-POLICY-002"),
        ({"partner": "greedy_nearest"}, "(?s)plan_pop_4.*H3-POLICY-002"),
        ({"scenes": "castle"}, "H3-HABITAT-108"),
        ({"robot": "tank"}, r"(?s)quad_arm.*H3-BODY-102"),
        ({"human": "ghost"}, r"(?s)female_0.*H3-BODY-072"),
        ({"render_mode": "human"}, "H3-ENV-024"),
    ],
)
def test_what_does_not_exist_is_told_with_what_does(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        h3data.make(**{"task": "rearrange", "scenes": HOME, **options})


def test_make_finds_the_task() -> None:
    assert isinstance(h3data.make("rearrange", scenes=HOME), TaskEnv)
    assert isinstance(h3data.make("rearrange", scenes=HOME, agents=("robot", "human")), TaskParallelEnv)
    many = h3data.make("rearrange", scenes=HOME, num_envs=2)
    assert isinstance(many, gymnasium.vector.VectorEnv)
    seen, _ = many.reset(seed=3)
    assert seen["holds"].shape == (2, 2)
    one = make_env(HOME)
    for w in range(2):
        assert_same(one.reset(seed=3 + w)[0], {name: array[w] for name, array in seen.items()})
    many.step(many.action_space.sample())


def test_any_agents_can_rearrange() -> None:
    """One robot acts beside another and two people, in two worlds that do not know of each other."""
    given: Any = {"roster": "robot,robot,human,human", "agents": ("robot_2",), "partner": "still"}
    both, one = make_env(HOME, num_envs=2, **given), make_env(HOME, **given)
    both.reset(seed=[3, 4])
    assert [len(play.episode.roster) for play in both.stepper.plays] == [4, 4]
    one.reset(seed=3)
    for action in (NAV_0, FORWARD):
        seen, reward, _, _, info = both.step(np.array([action, FORWARD]))
        alone, worth, _, _, told = one.step(action)
        assert (reward[0], info["steps"][0], info["outcome"][0]) == (worth, told["steps"], told["outcome"])
        for name, values in alone.items():
            np.testing.assert_array_equal(seen[name][0], values)
    assert "beside robot_1 quad_arm (still) and human_1 female_0 (still) and human_2 female_0 (still)" in repr(both)
