"""Tasks of other packages on a device: examples/point_goal.py plays as on the CPU, learns, and says what does not fit."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("shapely")
pytest.importorskip("fcl")

import h3data  # noqa: E402
from examples.point_goal import PointGoal, PointGoalSpec  # noqa: E402
from h3data.errors import InputError  # noqa: E402
from h3data.sensors import Sensor  # noqa: E402
from h3data.tasks import SkillControl  # noqa: E402
from h3data_training.envs.task_torch_env import TaskTorchEnv  # noqa: E402
from h3data_training.torch.episodes import EpisodeBank  # noqa: E402
from h3data_training.torch.task_worlds import TaskTensors  # noqa: E402
from sim_kinematic.envs.world_stepper import WorldStepper  # noqa: E402
from sim_kinematic.motion.spec import StrideSpec, WalkerSpec  # noqa: E402
from sim_kinematic.sensing.table import LIDARS, SENSORS, TABLE  # noqa: E402
from sim_kinematic.tasks.episode import StepOutcome  # noqa: E402
from tests.training.torch.capturable import CapturableOnly  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")
HOMES, SEED, WORLDS = ["small:1", "small:2"], 3, 6
RULES = PointGoalSpec(max_steps=60, arrive_m=1.2, human=WalkerSpec())  # on a device arms always swing
STRIDES = replace(RULES, human=WalkerSpec(speed_mps=1.3, stride=StrideSpec()))
EXACT = ("goal_gps", *(name for name in SENSORS if name not in ("way", "collision", *LIDARS)))
"""Sensors that no look-up changes."""


@pytest.fixture(scope="module")
def bank() -> EpisodeBank:
    return EpisodeBank.draw(HOMES, WORLDS, seed=SEED, task=PointGoal(), spec=RULES)


def heading_for(goal: Any) -> Any:
    """Actions that drive straight at the goal, by its distance and angle [W, 2]."""
    ahead = (np.abs(goal[:, 1]) < 0.5).astype(float)
    return np.stack([ahead, (-4 * goal[:, 1]).clip(-1, 1)], -1)


@pytest.mark.parametrize("rules", [RULES, pytest.param(STRIDES, marks=pytest.mark.slow)], ids=["paper", "natural"])
def test_the_same_actions_give_the_episodes_of_the_cpu(rules: Any, bank: EpisodeBank) -> None:
    if rules is not RULES:
        bank = EpisodeBank.draw(HOMES, WORLDS, seed=SEED, task=PointGoal(), spec=rules)
    stepper = WorldStepper(PointGoal(), HOMES, worlds=WORLDS, spec=rules, observations=EXACT)
    index, everywhere = np.arange(WORLDS), np.ones(WORLDS, np.bool_)
    stepper.begin([SEED] * WORLDS, index, everywhere)
    sim = TaskTensors(bank, task=PointGoal(), device="cpu", spec=rules)
    play = sim.step(sim.before_the_first(torch.tensor(index - 1)), torch.zeros(WORLDS, 2))
    over, arrived = np.zeros(WORLDS, np.bool_), 0
    for _ in range(70):
        seen, shown = stepper.observe("robot"), sim.observations(EXACT, play)
        for name in EXACT:
            np.testing.assert_allclose(shown[name], seen[name], rtol=0, atol=2e-5, err_msg=name)
        actions = heading_for(seen["goal_gps"])
        reward, terminated, truncated = stepper.step({"robot": actions})
        if over.any():
            index[over] = (index[over] + 1) % len(bank)
            stepper.begin([SEED] * WORLDS, index, over)
        play = sim.step(play, torch.tensor(actions))
        robot, person = stepper.play.world.state.agents
        np.testing.assert_allclose(play.robot.xz, robot.xz, rtol=0, atol=1e-9)
        np.testing.assert_allclose(play.human.xz, person.xz, rtol=0, atol=1e-9)
        memory, going = stepper.play.memory, ~over
        np.testing.assert_array_equal(play.memory["goal"], memory["goal"])
        np.testing.assert_allclose(play.memory["left"], memory["left"], rtol=0.1, atol=0.05)  # paths are looked up
        np.testing.assert_allclose(play.reward[going], reward[going], rtol=0, atol=0.1)
        np.testing.assert_array_equal(play.terminated[going], terminated[going])
        np.testing.assert_array_equal(play.memory["success"][going], memory["done"][going])
        np.testing.assert_array_equal(play.truncated[going], truncated[going])
        assert not play.ended[over].any()
        arrived += int(terminated[going].sum())
        over = going & (terminated | truncated)
    assert arrived > 3


def test_make_gives_any_task_on_a_device(bank: EpisodeBank) -> None:
    shown = ("goal_gps", "range_scan", "way", "collision", "arm_joints", *LIDARS)
    env = h3data.make(
        PointGoal(), num_envs=4, device="cpu", episodes=bank, spec=RULES, observations=shown, dtype=torch.float32
    )
    assert isinstance(env, TaskTorchEnv)
    assert "point_goal" in repr(env)
    observation, info = env.reset(seed=0)
    for _ in range(3):
        observation, reward, terminated, truncated, info = env.step(torch.zeros(4, 2))
    assert set(info) == {"success", "collides", "robot_contact", "episode"}
    assert reward.dtype == torch.float32
    assert not (terminated | truncated).any()
    for name, rows in observation.items():
        assert all(env.single_observation_space[name].contains(row) for row in rows.numpy()), name


def test_a_step_can_be_part_of_a_graph(bank: EpisodeBank) -> None:
    sim = TaskTensors(bank, task=PointGoal(), device="cpu", spec=RULES)
    play, still = sim.before_the_first(torch.zeros(4, dtype=torch.int64)), torch.zeros(4, 2)
    with CapturableOnly():
        after = sim.step(play, still)
        sim.observations(("goal_gps", "way", "range_scan", *LIDARS), after)
    for mine, theirs in zip(play.tensors(), after.tensors(), strict=True):
        assert (mine.shape, mine.dtype) == (theirs.shape, theirs.dtype)


@pytest.mark.slow
def test_a_policy_learns_in_it(bank: EpisodeBank) -> None:
    """REINFORCE with a linear policy of distance and angle of the goal: the reward of 25 steps rises."""
    torch.manual_seed(0)
    env = h3data.make(PointGoal(), num_envs=128, device="cpu", episodes=bank, spec=RULES, observations=("goal_gps",))
    policy = torch.nn.Linear(3, 2)
    torch.nn.init.zeros_(policy.weight)
    optimizer, gains = torch.optim.Adam(policy.parameters(), lr=0.1), []
    for _ in range(12):
        gps = env.reset(seed=1)[0]["goal_gps"]
        gain, likely = torch.zeros(128), torch.zeros(128)
        for _ in range(25):
            at = torch.distributions.Normal(policy(torch.cat([gps.clamp_max(3), gps[:, 1:].cos()], 1)), 0.5)
            action = at.sample()
            likely = likely + at.log_prob(action).sum(1)
            shown, reward, *_ = env.step(action)
            gps, gain = shown["goal_gps"], gain + reward
        advantage = (gain - gain.mean()) / gain.std()
        optimizer.zero_grad()
        (-(advantage * likely).mean()).backward()
        optimizer.step()
        gains.append(float(gain.mean()))
    assert np.mean(gains[-3:]) > np.mean(gains[:3]) + 0.3, gains


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed, so nothing is compiled for the CPU")
def test_a_compiled_step_is_the_eager_one(bank: EpisodeBank) -> None:
    options: Any = {"episodes": bank, "spec": RULES, "observations": ("goal_gps", "way")}
    eager, compiled = (h3data.make(PointGoal(), num_envs=8, device="cpu", compile=c, **options) for c in (False, True))
    for env in (eager, compiled):
        env.reset(seed=0)
    for _ in range(70):
        action = torch.rand(8, 2, dtype=torch.float64)
        (one, gained, *ends, _), (other, worth, *closes, _) = eager.step(action), compiled.step(action)
        torch.testing.assert_close(worth, gained, rtol=0, atol=1e-5)
        assert all(torch.equal(a, b) for a, b in zip(ends, closes, strict=True))
        for name in one:
            torch.testing.assert_close(other[name], one[name], rtol=0, atol=1e-5)


# --- what does not fit --------------------------------------------------------------------------------------------------
class JudgesWithNumPy(PointGoal):
    """Computes with NumPy whatever the namespace."""

    def judge(self, play: Any) -> StepOutcome:
        good = super().judge(play)
        return StepOutcome(reward=np.zeros(play.world.worlds), terminated=good.terminated, success=good.success)


class AsksForValues(PointGoal):
    """Branches on an array."""

    def judge(self, play: Any) -> StepOutcome:
        if (play.memory["left"] < 1.0).any():
            return super().judge(play)
        return super().judge(play)


class MixesBoth(PointGoal):
    """Adds an array of NumPy to a tensor."""

    def begin(self, play: Any, rows: Any) -> Mapping[str, Any]:
        begun = super().begin(play, rows)
        return {**begun, "left": np.ones(play.world.worlds) * begun["left"]}


class KeepsItself(PointGoal):
    """Sets its memory instead of returning it."""

    def begin(self, play: Any, rows: Any) -> None:
        play.memory = dict(super().begin(play, rows))


class WantsPrize(PointGoal):
    """Asks for what was not sampled."""

    def begin(self, play: Any, rows: Any) -> Mapping[str, Any]:
        return {**super().begin(play, rows), "prize": play.extra("prize")}


class Crowded(PointGoal):
    """Two people."""

    agents: ClassVar[tuple[str, ...]] = ("robot", "human", "human")


class Skilled(PointGoal):
    """Agents with skills in a task that does not derive from rearrangement."""

    control: ClassVar[Any] = SkillControl()


class WantsObjects(PointGoal):
    """Shows where objects are, in worlds without."""

    sensors: ClassVar[Mapping[str, Sensor]] = {**PointGoal.sensors, "obj_gps_compass": TABLE["obj_gps_compass"]}


@pytest.mark.parametrize(
    ("task", "says"),
    [
        (
            JudgesWithNumPy(),
            r"(?s)judges_with_num_py: the function judge must compute with play\.xp .*reward must be a torch.*H3-ENV-040",
        ),
        (AsksForValues(), r"(?s)asks_for_values: the function judge must compute with play\.xp.*H3-ENV-040"),
        (MixesBoth(), r"(?s)mixes_both: the function begin must compute with play\.xp.*H3-ENV-040"),
        (KeepsItself(), r"(?s)keeps_itself: the function begin .*it sets play\.memory, and must return it.*H3-ENV-040"),
        (WantsPrize(), "H3-ENV-039"),
        (Crowded(), "H3-ENV-038"),
        (
            WantsObjects(),
            "H3-SIM-055",
        ),
        (Skilled(), "H3-ENV-035"),
        ("wander", "H3-ENV-036"),
    ],
    ids=lambda case: type(case).__name__ if not isinstance(case, str) else "",
)
def test_a_task_that_does_not_fit_a_device_is_named(task: Any, says: str, bank: EpisodeBank) -> None:
    given: Any = {"scenes": "small:1", "episodes": 1} if isinstance(task, Crowded) else {"episodes": bank}
    shown = ("obj_gps_compass",) if isinstance(task, WantsObjects) else ("egomotion",)
    with pytest.raises(InputError, match=says):
        h3data.make(task, device="cpu", observations=shown, **given)


def test_a_sensor_that_needs_what_a_world_lacks_is_named_on_the_cpu_too() -> None:
    env = h3data.make(WantsObjects(), "small:1", observations=("obj_gps_compass",))
    with pytest.raises(InputError, match="H3-SIM-055"):
        env.reset(seed=0)


def test_rules_and_options_that_no_device_has_are_named(bank: EpisodeBank) -> None:
    def wrong(says: str, **options: Any) -> None:
        with pytest.raises(InputError, match=says):
            h3data.make(PointGoal(), **{"device": "cpu", "episodes": bank, "spec": RULES, **options})

    wrong("H3-ENV-034", spec=replace(RULES, robot=replace(RULES.robot, slide="habitat")))
    wrong("H3-ENV-001", agents=("robot", "human"))
    wrong("H3-ENV-037", num_envs=10**13)
