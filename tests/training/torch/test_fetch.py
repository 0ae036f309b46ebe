"""A task with things on a device: examples/fetch.py plays as on the CPU, learns, and says what does not fit."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("shapely")
pytest.importorskip("fcl")

import h3data  # noqa: E402
from examples.fetch import Fetch, FetchSpec  # noqa: E402
from h3data.bodies import load_robot  # noqa: E402
from h3data.errors import InputError  # noqa: E402
from h3data.tasks import SkillControl, StepOutcome, with_oracle_skills  # noqa: E402
from h3data_training.envs.rearrange_torch_env import RearrangeTorchEnv  # noqa: E402
from h3data_training.torch.rearrange.bank import RearrangeBank  # noqa: E402
from h3data_training.torch.rearrange.state import DONE, FAILED, FREE  # noqa: E402
from h3data_training.torch.rearrange.worlds import RearrangeTensors  # noqa: E402
from sim_kinematic.agents.robots.hand_reach import reach_bearing  # noqa: E402
from sim_kinematic.agents.skills import Action  # noqa: E402
from sim_kinematic.envs.world_stepper import WorldStepper  # noqa: E402
from sim_kinematic.policies.rearrange_observations import STATE_SENSES  # noqa: E402
from sim_kinematic.tasks.episode import Starts  # noqa: E402
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode  # noqa: E402
from sim_kinematic.tasks.recorder import simulate  # noqa: E402
from sim_kinematic.tasks.resume import verify  # noqa: E402
from sim_kinematic.tasks.skills.errands import errands_of  # noqa: E402
from sim_kinematic.tasks.sources import EpisodeSource  # noqa: E402
from tests.training.torch.capturable import CapturableOnly  # noqa: E402
from tests.training.torch.test_rearrange import KINDS, QUICK, Pair, count_spans  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")
RULES = replace(with_oracle_skills(FetchSpec()), oracle=QUICK, max_steps=330)
WAIT, TO_HANDLE, OPEN, CLOSE = 8, 13, 14, 15
"""Numbers of choices of the robot, with two objects and one drawer."""


def drawn(count: int, task: Fetch | None = None) -> list[RearrangeEpisode]:
    source = EpisodeSource(task or Fetch(), "small-open:2", spec=with_oracle_skills(FetchSpec()))
    found = [source.sample(3, k) for k in range(count)]
    return [replace(one, spec=RULES) for one in found if isinstance(one, RearrangeEpisode)]


@pytest.fixture(scope="module")
def episodes() -> list[RearrangeEpisode]:
    return drawn(2)


def before_the_drawer(episode: RearrangeEpisode) -> RearrangeEpisode:
    """The episode, but its robot begins where it can reach the handle, half a radian from facing it, far from the person."""
    (joint,), starts = Fetch().parts_of(episode), episode.starts.copy()
    drawer = errands_of(episode, 0, (joint,)).to_part[joint]
    starts[0, :2] = drawer.ways.ends[0]
    x, z = drawer.point[[0, 2]] - starts[0, :2]
    starts[0, 2] = np.arctan2(-z, x) - reach_bearing(load_robot(episode.pair[0])) + 0.5
    places = [way.ends[0] for way in errands_of(episode, 1, (joint,)).to_start]
    starts[1, :2] = max(places, key=lambda place: float(np.hypot(*(place - starts[0, :2]))))
    return replace(episode, starts=starts, pair_starts=Starts.of(starts))


@pytest.fixture(scope="module")
def near(episodes: list[RearrangeEpisode]) -> RearrangeEpisode:
    return before_the_drawer(episodes[0])


@pytest.fixture(scope="module")
def bank(episodes: list[RearrangeEpisode]) -> RearrangeBank:
    return RearrangeBank.of(episodes, task=Fetch())


# --- against the CPU ----------------------------------------------------------------------------------------------------
def test_a_drawer_opens_and_closes_as_on_the_cpu(near: RearrangeEpisode) -> None:
    pair, choice, rewards, stood = Pair([near], outside=KINDS, task=Fetch()), TO_HANDLE, [], []
    for _ in range(40):
        pair.step(np.array([[choice, WAIT]]))
        does = pair.state.robot_does
        free, last, done = int(does.skill[0]) == FREE, int(does.last[0]), int(does.outcome[0]) == DONE
        choice = min(last + 1, CLOSE) if free and done else FREE
        rewards.append(float(pair.state.reward[0]))
        stood.append(bool(pair.state.opened[0, 0]))
    assert sum(rewards) == FetchSpec().drawer_worth  # once, though it is opened and closed
    assert stood[0] is stood[-1] is False
    assert rewards.index(FetchSpec().drawer_worth) == stood.index(True)
    spans = count_spans(pair)
    assert spans["nav_to_handle done"] == spans["open done"] == 1
    assert spans["close done"] >= 1


@pytest.mark.slow  # quick: one drawer
def test_the_same_choices_give_the_episodes_of_the_cpu() -> None:
    pair, rng = Pair(drawn(5), outside=KINDS, task=Fetch()), np.random.default_rng(3)
    while not all(turns.over for turns in pair.turns):
        pair.step(pair.random(rng))
    spans = count_spans(pair)
    for what in ("pick done", "place done", "open done", "nav_to_handle done", "failed out_of_reach"):
        assert spans[what], f"nothing was ever: {what}"


def test_its_episodes_with_oracle_skills_are_verified(near: RearrangeEpisode) -> None:
    short = replace(near, spec=replace(RULES, max_steps=40))
    recording = simulate(Fetch(), short, {"robot": "drawer_first", "human": "still"}, info={"solo_steps": 1})
    assert recording.columns["metrics.drawer_open"][-1]
    assert recording.episode.info["spec"]["parts"] == 1
    assert verify(recording).difference is None


def test_choices_of_the_cpu_have_the_same_numbers(episodes: list[RearrangeEpisode], bank: RearrangeBank) -> None:
    sim, rules = RearrangeTensors(bank, task=Fetch(), device="cpu"), with_oracle_skills(FetchSpec())
    stepper = WorldStepper(
        Fetch(),
        "small-open:2",
        spec=rules,
        partner="still",
        observations=("part_is_open",),
        interrupts_when_close=False,
    )
    stepper.begin([3], [0], np.ones(1, np.bool_))
    known = stepper.play.team.choices(0)
    assert len(known) == len(sim.choices["robot"]) == stepper.action_space("robot").n == CLOSE + 1  # type: ignore[attr-defined]
    (joint,) = Fetch().parts_of(episodes[0])
    assert known[TO_HANDLE:] == (Action("nav_to_handle", joint), Action("open", joint), Action("close", joint))
    assert stepper.info("robot")["action_mask"].shape == (1, CLOSE + 1)
    for number in (TO_HANDLE, OPEN):
        stepper.step({"robot": np.array([number])})
        assert stepper.info("robot")["outcome"].tolist() == ["done"]
    assert stepper.observe("robot")["part_is_open"].tolist() == [[1.0]]


# --- the environment ----------------------------------------------------------------------------------------------------
def test_make_gives_it_on_a_device(bank: RearrangeBank) -> None:
    shown = (*STATE_SENSES, "part_gps_compass", "part_is_open", "last_failed")
    env = h3data.make(Fetch(), num_envs=4, device="cpu", episodes=bank, observations=shown, dtype=torch.float32)
    assert isinstance(env, RearrangeTorchEnv)
    assert "fetch" in repr(env)
    observation, info = env.reset(seed=0)
    observation, reward, terminated, truncated, info = env.step(torch.full((4,), OPEN))
    assert (info["outcome"] == FAILED).all()
    assert observation["last_failed"].argmax(1).tolist() == [OPEN] * 4
    assert reward.dtype == torch.float32
    assert not (terminated | truncated).any()
    for name, rows in observation.items():
        assert all(env.single_observation_space[name].contains(row) for row in rows.numpy()), name


def test_a_step_can_be_part_of_a_graph(bank: RearrangeBank) -> None:
    sim = RearrangeTensors(bank, task=Fetch(), device="cpu")
    play, chosen = sim.before_the_first(torch.zeros(4, dtype=torch.int64)), torch.full((4,), TO_HANDLE)
    with CapturableOnly():
        after = sim.step(play, chosen, chosen)
    for mine, theirs in zip(play.tensors(), after.tensors(), strict=True):
        assert (mine.shape, mine.dtype) == (theirs.shape, theirs.dtype)


def test_a_policy_learns_in_it(near: RearrangeEpisode) -> None:
    """REINFORCE with a linear policy of the last choice and its end: the reward of 20 steps rises."""
    torch.manual_seed(0)
    shown, worlds, bank = ("last_done", "last_failed", "part_is_open"), 64, RearrangeBank.of([near], task=Fetch())
    bank.starts[0] = near.starts
    env = h3data.make(Fetch(), num_envs=worlds, device="cpu", episodes=bank, partner="still", observations=shown)
    policy = torch.nn.Linear(2 * (CLOSE + 1) + 2, CLOSE + 1)
    torch.nn.init.zeros_(policy.weight)
    torch.nn.init.zeros_(policy.bias)
    optimizer, gains = torch.optim.Adam(policy.parameters(), lr=0.3), []
    for _ in range(12):
        seen, info = env.reset(seed=1)
        gain, likely = torch.zeros(worlds), torch.zeros(worlds)
        for _ in range(20):
            features = torch.cat([*seen.values(), torch.ones(worlds, 1)], 1)
            scores = policy(features).masked_fill(info["action_mask"] == 0, -1e9)
            at, asked = torch.distributions.Categorical(logits=scores), info["choosing"]
            action = at.sample()
            likely = likely + torch.where(asked, at.log_prob(action), 0.0)
            seen, reward, *_, info = env.step(torch.where(asked, action, FREE))
            gain = gain + reward
        advantage = (gain - gain.mean()) / (gain.std() + 1e-6)
        optimizer.zero_grad()
        (-(advantage * likely).mean()).backward()
        optimizer.step()
        gains.append(float(gain.mean()))
    assert np.mean(gains[-3:]) > np.mean(gains[:3]) + 1.0, gains


# --- what does not fit --------------------------------------------------------------------------------------------------
class JudgesWithNumPy(Fetch):
    """Computes with NumPy whatever the namespace."""

    def judge(self, play: Any) -> StepOutcome:
        good = super().judge(play)
        return StepOutcome(reward=np.zeros(play.world.worlds), terminated=good.terminated, success=good.success)


class AsksForValues(Fetch):
    """Branches on an array."""

    def judge(self, play: Any) -> StepOutcome:
        assert not play.at_goal.all()
        return super().judge(play)


class WantsPoses(Fetch):
    """Asks for directions of things, which no device keeps."""

    def judge(self, play: Any) -> StepOutcome:
        assert play.world.state.object_pose.shape[-1] == 7
        return super().judge(play)


class TwoParts(Fetch):
    """Names another number of drawers than its rules."""

    def parts_of(self, episode: Any) -> tuple[int, ...]:
        return (*super().parts_of(episode), 0)


@pytest.mark.parametrize(
    ("task", "says"),
    [
        (JudgesWithNumPy(), r"(?s)judges_with_num_py: the function judge must .*reward must be a torch.*H3-ENV-040"),
        (AsksForValues(), r"(?s)asks_for_values: the function judge must compute with play\.xp.*H3-ENV-040"),
        (WantsPoses(), r"(?s)wants_poses: the function judge must .*object_pose.*H3-ENV-040"),
    ],
    ids=lambda case: type(case).__name__ if not isinstance(case, str) else "",
)
def test_a_function_that_does_not_fit_a_device_is_named(task: Any, says: str, bank: RearrangeBank) -> None:
    with pytest.raises(InputError, match=says):
        h3data.make(task, device="cpu", episodes=bank)


def test_rules_and_parts_that_no_device_has_are_named(episodes: list[RearrangeEpisode]) -> None:
    with pytest.raises(InputError, match="H3-ENV-034"):
        RearrangeBank.of([replace(episodes[0], spec=replace(RULES, solid_agents=True))], task=Fetch())
    with pytest.raises(InputError, match="H3-TRAIN-061"):
        RearrangeBank.of([replace(episodes[0], spec=FetchSpec())], task=Fetch())
    with pytest.raises(InputError, match="H3-TRAIN-081"):
        RearrangeBank.of(episodes[:1], task=TwoParts())
    assert isinstance(Fetch.control, SkillControl)
