"""People of crowds on a device: each step is that of the CPU, whole episodes too, and what does not fit is said."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("shapely")
pytest.importorskip("fcl")

import h3data  # noqa: E402
from examples.point_goal import PointGoal  # noqa: E402
from h3data.errors import InputError  # noqa: E402
from h3data_crowds.crowd_nav import CrowdNav, CrowdNavSpec  # noqa: E402
from h3data_training.envs.crowd_torch_env import CrowdTorchEnv  # noqa: E402
from h3data_training.torch.contact import TOLERANCE_M  # noqa: E402
from h3data_training.torch.crowd import avoidance  # noqa: E402
from h3data_training.torch.crowd import bank as banks  # noqa: E402
from h3data_training.torch.crowd.bank import CrowdBank  # noqa: E402
from h3data_training.torch.crowd.worlds import CrowdWorlds  # noqa: E402
from sim_kinematic.crowd.errands import Errand  # noqa: E402
from sim_kinematic.crowd.orca import half_plane, nearest_velocity  # noqa: E402
from sim_kinematic.crowd.social_force import interaction  # noqa: E402
from sim_kinematic.envs.world_stepper import WorldStepper  # noqa: E402
from sim_kinematic.motion.randomness import episode_seed  # noqa: E402
from sim_kinematic.motion.spec import WalkerSpec  # noqa: E402
from sim_kinematic.policies.crowd import people as cpu_people  # noqa: E402
from sim_kinematic.sensing.table import LIDARS  # noqa: E402
from tests.training.torch.capturable import CapturableOnly  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")
HOME, SEED, WORLDS, PEOPLE = "medium:1", 3, 4, 4
RULES = CrowdNavSpec(end_on_collision=False)
SHOWN = (
    "goal_gps",
    "goal_way",
    "people",
    "humanoid_gps",
    "humanoid_velocity",
    "egomotion",
    "range_scan",
    "lidar",
    "localization",
)
"""Sensors that are compared; of them, only ``goal_way`` is looked up on a device."""


@pytest.fixture(scope="module")
def bank() -> CrowdBank:
    return CrowdBank.draw(HOME, WORLDS, seed=SEED, task=CrowdNav(), spec=RULES)


# --- single functions ---------------------------------------------------------------------------------------------------
def test_half_planes_and_velocities_are_those_of_the_kernels():
    rng = np.random.default_rng(0)
    gaps, relative = rng.uniform(-2, 2, (5, 300, 2)), rng.uniform(-2, 2, (5, 300, 2))
    radius, horizon, share = rng.uniform(0.3, 1.2, (5, 300)), rng.uniform(0.5, 2, (5, 300)), rng.uniform(0, 1, (5, 300))
    given = [torch.tensor(values) for values in (gaps, relative, radius, horizon)]
    gap, moves, reach, ahead = given
    planes = avoidance.half_planes(gap, moves, reach, ahead, 0.5, torch.tensor(share))
    wanted, most = rng.uniform(-1.5, 1.5, (300, 2)), rng.uniform(0.3, 1.5, 300)
    velocities = avoidance.nearest_velocities(planes, torch.tensor(wanted), torch.tensor(most))
    for w in range(300):
        rows = [
            half_plane(*gaps[k, w], *relative[k, w], radius[k, w], horizon[k, w], 0.5, share[k, w]) for k in range(5)
        ]
        own = np.column_stack([planes.normal[:, w], planes.offset[:, w]])
        np.testing.assert_allclose(own, rows, rtol=0, atol=1e-12)
        found = nearest_velocity(np.array(rows), 5, *wanted[w], most[w])
        np.testing.assert_allclose(velocities[w], found, rtol=0, atol=1e-9)


def test_forces_are_those_of_the_kernel():
    rng = np.random.default_rng(1)
    gaps, relative = rng.uniform(-3, 3, (300, 2)), rng.uniform(-2, 2, (300, 2))
    gaps[0] = relative[0] = relative[1] = 0.0
    own = avoidance.interactions(torch.tensor(gaps), torch.tensor(relative), 2.0, 0.35, 2.0, 3.0)
    found = [interaction(*gap, *moves, 2.0, 0.35, 2.0, 3.0) for gap, moves in zip(gaps, relative, strict=True)]
    np.testing.assert_allclose(own, found, rtol=0, atol=1e-12)


# --- against the CPU ----------------------------------------------------------------------------------------------------
class Pair:
    """The same episodes on the CPU and as tensors, in which people never lose patience and walk the bank's paths."""

    def __init__(self, model: Any, monkeypatch: pytest.MonkeyPatch, **rules: Any) -> None:
        sample = cpu_people.sample_traits
        for module in (cpu_people, banks):
            monkeypatch.setattr(module, "sample_traits", lambda *a: sample(*a)._replace(patience_s=1e9))
        spec = replace(RULES, **rules)
        self.bank = CrowdBank.draw(HOME, WORLDS, seed=SEED, task=CrowdNav(), spec=spec)
        chains, legs = {}, iter(self.bank.legs)
        for seed, counts in zip(self.bank.seeds.tolist(), self.bank.leg_counts.tolist(), strict=True):
            for number, count in enumerate(counts, 1):
                chains[episode_seed(seed, number)] = [next(legs) for _ in range(count)]
        self.walked: dict[int, int] = {}

        def guide(policy: Any, *_: Any) -> Errand:
            who = policy._goals.seed
            self.walked[who] = self.walked.get(who, -1) + 1
            return Errand(chains[who][self.walked[who]])

        monkeypatch.setattr(cpu_people.CrowdPolicy, "_guide", guide)
        self.stepper = WorldStepper(CrowdNav(), HOME, worlds=WORLDS, spec=spec, partner=model, observations=SHOWN)
        self.stepper.begin([SEED] * WORLDS, list(range(WORLDS)), np.ones(WORLDS, np.bool_))
        self.sim = CrowdWorlds(self.bank, model=model, task=CrowdNav(), device="cpu", spec=spec)
        self.play = self.sim.step(self.sim.before_the_first(torch.arange(WORLDS) - 1), torch.zeros(WORLDS, 2))

    @property
    def cpu(self) -> Any:
        return self.stepper.plays[0]

    def step(self, action: np.ndarray) -> Any:
        self.play = self.sim.step(self.play, torch.tensor(action))
        return self.stepper.step({"robot": action})

    def take_over(self) -> None:
        """Put the people of the CPU into the tensors."""
        crowds = [next(iter(self.cpu.team.crowds_of(w)._crowds.values())) for w in range(WORLDS)]
        seeds = self.bank.seeds.tolist()
        legs = [[self.walked[episode_seed(seed, number)] for number in range(1, PEOPLE + 1)] for seed in seeds]

        def of(name: str, *index: Any) -> Any:
            return torch.tensor(np.stack([getattr(crowd, name)[index or ...] for crowd in crowds], 1))

        every, people = slice(None), self.cpu.world.state.people
        crowd: Any = self.play.crowd
        human = self.play.human._replace(
            xz=torch.tensor(np.stack([p.xz for p in people])),
            heading=torch.tensor(np.stack([p.heading for p in people])),
        )
        crowd = crowd._replace(
            leg=torch.tensor(legs).T,
            along=of("_along"),
            best=of("_best", every, 0),
            best_step=of("_best", every, 1),
            claim=of("_claims", every, 0),
            turn=of("_body", every, 1),
            speed=of("_body", every, 2),
            direction=of("_body", every, 3),
            chosen=of("_chosen"),
        )
        before = torch.tensor(np.stack([p.xz for p in self.cpu.world.before.people]))
        self.play = self.play._replace(human=human, crowd=crowd, human_before_xz=before)

    def apart(self) -> np.ndarray:
        """Distances between people of both [P, W] [m]."""
        people = np.stack([p.xz for p in self.cpu.world.state.people])
        return np.hypot(*(self.play.human.xz.numpy() - people).transpose(2, 0, 1))


def drives(steps: int) -> np.ndarray:
    """Actions of robots [steps, W, 2] that change every second."""
    return np.random.default_rng(0).uniform(-1, 1, (steps // 30 + 1, WORLDS, 2)).repeat(30, 0)[:steps]


@pytest.mark.parametrize(
    ("model", "steps"),
    [("orca", 40), *(pytest.param(m, 150, marks=pytest.mark.slow) for m in ("orca", "social_force"))],
)
def test_episodes_are_those_of_the_cpu(model: str, steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Positions within 1e-6 m for 150 steps, in which people meet and begin new paths; sensors and rewards too."""
    both = Pair(model, monkeypatch)
    for action in drives(steps):
        reward, terminated, truncated = both.step(action)
        robot = both.cpu.world.state.agents[0]
        np.testing.assert_allclose(both.play.robot.xz, robot.xz, rtol=0, atol=1e-9)
        assert both.apart().max() < 1e-6
        np.testing.assert_allclose(both.play.reward, reward, rtol=0, atol=0.1)  # paths are looked up
        np.testing.assert_array_equal(both.play.terminated, terminated)
        np.testing.assert_array_equal(both.play.truncated, truncated)
    seen, shown = both.stepper.observe("robot"), both.sim.observations(SHOWN, both.play)
    for name in set(SHOWN) - {"goal_way"}:
        np.testing.assert_allclose(shown[name], seen[name], rtol=0, atol=2e-5, err_msg=name)
    memory = both.cpu.memory
    np.testing.assert_allclose(both.play.memory["left"], memory["left"], rtol=0.1, atol=0.05)
    np.testing.assert_array_equal(both.play.memory["goal"], memory["goal"])


@pytest.mark.slow
@pytest.mark.parametrize("model", ["orca", "social_force"])
def test_each_step_is_that_of_the_cpu(model: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the state of the CPU, a step of 9,600 leads to the same place but where rounding decides who slides past whom."""
    both, differ, met = Pair(model, monkeypatch), 0, 0
    for k, action in enumerate(drives(600)):
        both.step(action)
        crowd: Any = both.play.crowd
        differ += int((both.apart() > 1e-8).sum())
        touching = both.cpu.world.touching[:, :PEOPLE]
        met += int(touching.sum())
        gap = both.sim.touch.gap
        for p in range(PEOPLE):
            person = type(both.play.human)(*(t[p] for t in both.play.human))
            sure = gap(both.play.robot, person).abs() > 3 * TOLERANCE_M
            np.testing.assert_array_equal(crowd.touching[p][sure], touching[:, p][sure])
        if k:
            both.take_over()
    assert differ <= 5, differ


def test_people_who_are_stuck_turn_round_and_come_back(bank: CrowdBank) -> None:
    sim = CrowdWorlds(bank, model="orca", task=CrowdNav(), device="cpu", spec=RULES)
    play = sim.step(sim.before_the_first(torch.arange(WORLDS) - 1), torch.zeros(WORLDS, 2))
    for _ in range(20):
        play = sim.step(play, torch.zeros(WORLDS, 2))
    crowd: Any = play.crowd
    walked = crowd.along[0, 0].item()
    assert walked > 0.05
    # as if they had made no progress for a minute
    play = play._replace(crowd=crowd._replace(best_step=torch.full_like(crowd.best_step, -1800.0)))
    play = sim.step(play, torch.zeros(WORLDS, 2))
    after: Any = play.crowd
    assert after.back.all()
    assert (after.leg == crowd.leg).all()
    total = np.hypot(*np.diff(bank.legs[0], axis=0).T).sum()
    assert after.along[0, 0].item() == pytest.approx(total - walked, abs=0.2)
    for _ in range(20):
        play = sim.step(play, torch.zeros(WORLDS, 2))
    again: Any = play.crowd
    assert not again.back.all(), "at the beginning of the chain they walk it forwards again"
    assert (again.leg == 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("model", ["orca", "social_force"])
def test_nobody_walks_into_anybody(model: Any, bank: CrowdBank) -> None:
    """In float32, with robots that drive at random: people keep their distance and stay on the floor."""
    sim = CrowdWorlds(bank, model=model, task=CrowdNav(), device="cpu", spec=RULES, dtype=torch.float32)
    play = sim.step(sim.before_the_first(torch.arange(WORLDS) - 1), torch.zeros(WORLDS, 2))
    for action in drives(200):
        play = sim.step(play, torch.tensor(action, dtype=torch.float32))
        gap = torch.cdist(play.human.xz.movedim(0, 1), play.human.xz.movedim(0, 1)) + 9 * torch.eye(PEOPLE)
        assert gap.min() > 2 * 0.34 - 1e-3
    free = bank.floors[0].signed_distance(play.human.xz.numpy())
    assert free.min() > 0.2


# --- environments -------------------------------------------------------------------------------------------------------
def test_make_gives_any_number_of_people_the_same_again() -> None:
    for people in (0, 1, 12):
        shown = ("goal_gps", "collision", *["humanoid_gps", "lidar_legs"] * bool(people))
        env = h3data.make(
            "crowd_nav",
            HOME,
            num_envs=3,
            device="cpu",
            roster=["robot", *["human"] * people],
            episodes=2,
            observations=shown,
        )
        assert isinstance(env, CrowdTorchEnv)
        assert "crowd_nav" in repr(env)
        seen, reward = [], torch.zeros(3)
        for _ in range(2):
            observation, info = env.reset(seed=0)
            for _ in range(3):
                observation, reward, *_, info = env.step(torch.full((3, 2), 0.3))
            assert set(info) == {"success", "collides", "robot_contact", "episode"}
            assert reward.dtype == torch.float32
            for name, rows in observation.items():
                assert all(env.single_observation_space[name].contains(row) for row in rows.numpy()), name
            seen.append(observation)
        assert env.play.human.xz.shape == (people, 3, 2)
        assert all(torch.equal(seen[0][name], seen[1][name]) for name in shown)


def test_other_tasks_have_crowds_too() -> None:
    shown: Any = {"num_envs": 2, "device": "cpu", "episodes": 1, "observations": ("goal_gps",), "partner": "orca"}
    env = h3data.make(PointGoal(), "small:1", roster=["robot", "human", "human"], **shown)
    env.reset(seed=0)
    *_, info = env.step(torch.ones(2, 2))
    assert info["success"].shape == (2,)
    with pytest.raises(InputError, match="H3-ENV-040"):  # its functions are for NumPy alone
        h3data.make("wander", "small:1", **dict(shown, observations=("egomotion",)))


def test_episodes_begin_again_where_the_next_of_the_bank_does(bank: CrowdBank) -> None:
    env = h3data.make(
        "crowd_nav",
        num_envs=2,
        device="cpu",
        episodes=bank,
        spec=replace(RULES, max_steps=4),
        observations=("goal_gps",),
    )
    _, info = env.reset(seed=0)
    first = info["episode"]
    for _ in range(3):
        env.step(torch.zeros(2, 2))
    *_, truncated, info = env.step(torch.zeros(2, 2))
    assert truncated.all()
    _, reward, terminated, truncated, info = env.step(torch.zeros(2, 2))
    assert not (terminated | truncated).any()
    assert (reward == 0).all()
    assert torch.equal(info["episode"], (first + 1) % len(bank))
    starts = torch.tensor(bank.starts)[info["episode"]]
    assert torch.equal(env.play.human.xz, starts[:, 1:, :2].movedim(1, 0))
    assert torch.equal(env.play.robot.xz, starts[:, 0, :2])


def test_actions_that_are_not_finite_count_as_0(bank: CrowdBank) -> None:
    env = h3data.make("crowd_nav", num_envs=2, device="cpu", episodes=bank, spec=RULES, observations=("goal_gps",))
    env.reset(seed=0)
    observation, reward, *_ = env.step(torch.tensor([[torch.nan, torch.inf], [0.0, 0.0]]))
    assert torch.isfinite(observation["goal_gps"]).all()
    assert torch.isfinite(reward).all()
    with pytest.raises(InputError, match="H3-ENV-010"):
        env.step(torch.zeros(2, 3))


@pytest.mark.slow
def test_a_policy_learns_in_it() -> None:
    """REINFORCE with a linear policy of distance and angle of the goal: the reward of a second rises."""
    torch.manual_seed(0)
    bank = CrowdBank.draw(HOME, 16, seed=SEED, task=CrowdNav(), spec=RULES, agents=["robot", "human", "human"])
    shown = ("goal_gps",)
    env = h3data.make(
        "crowd_nav", num_envs=128, device="cpu", episodes=bank, spec=RULES, observations=shown, dtype=torch.float32
    )
    policy = torch.nn.Linear(3, 2)
    torch.nn.init.zeros_(policy.weight)
    optimizer, gains = torch.optim.Adam(policy.parameters(), lr=0.1), []
    for _ in range(14):
        gps = env.reset(seed=1)[0]["goal_gps"]
        gain, likely = torch.zeros(128), torch.zeros(128)
        for _ in range(30):
            at = torch.distributions.Normal(policy(torch.cat([gps.clamp_max(3), gps[:, 1:].cos()], 1)), 0.5)
            action = at.sample()
            likely = likely + at.log_prob(action).sum(1)
            seen, reward, *_ = env.step(action)
            gps, gain = seen["goal_gps"], gain + reward
        advantage = (gain - gain.mean()) / gain.std()
        optimizer.zero_grad()
        (-(advantage * likely).mean()).backward()
        optimizer.step()
        gains.append(float(gain.mean()))
    assert np.mean(gains[-3:]) > gains[0] + 0.25, gains


@pytest.mark.parametrize("model", ["orca", "social_force"])
def test_a_step_can_be_part_of_a_graph(model: Any, bank: CrowdBank) -> None:
    sim = CrowdWorlds(bank, model=model, task=CrowdNav(), device="cpu", spec=RULES)
    play, still = sim.before_the_first(torch.zeros(2, dtype=torch.int64)), torch.zeros(2, 2)
    with CapturableOnly():
        after = sim.step(play, still)
        sim.observations(("goal_gps", "goal_way", "people", "way", *LIDARS), after)
    for mine, theirs in zip(play.tensors(), after.tensors(), strict=True):
        assert (mine.shape, mine.dtype) == (theirs.shape, theirs.dtype)
        assert mine.is_contiguous(), "a graph writes into it"


def test_what_no_device_has_is_named(bank: CrowdBank) -> None:
    def wrong(says: str, **options: Any) -> None:
        given = {"device": "cpu", "episodes": bank, "spec": RULES, "observations": ("goal_gps",), **options}
        with pytest.raises(InputError, match=says):
            h3data.make("crowd_nav", HOME, **given)

    wrong("H3-ENV-036", partner="orca+curious")
    wrong("H3-ENV-036", partner="wander")
    wrong("H3-ENV-060", noise={})
    wrong("H3-ENV-060", light="baked")
    wrong("H3-ENV-060", depth_size=(64, 48))
    wrong("H3-ENV-061", roster="robot,robot,human", episodes=1)
    wrong("H3-ENV-061", roster="human,human", episodes=1)
    wrong("H3-ENV-061", roster="robot,female_0,male_0", episodes=1)
    wrong("H3-ENV-001", agents=("robot", "human_1"))
    wrong("H3-ENV-008", observations=("arm_depth",))
    wrong("H3-ENV-008", observations=("humanoid_gps",), roster="robot", episodes=1)
    wrong("H3-ENV-034", spec=replace(RULES, solid_agents=True))
    wrong("H3-ENV-034", spec=replace(RULES, robot=replace(RULES.robot, slide="habitat")))
    wrong("H3-TRAIN-060", episodes=0)
    wrong("H3-ENV-015", num_envs=0)
    wrong("H3-ENV-037", num_envs=10**13)


def test_people_of_other_walkers_have_strides_of_their_own() -> None:
    rules = replace(RULES, human=WalkerSpec(speed_mps=1.0))
    bank = CrowdBank.draw(HOME, 1, seed=1, task=CrowdNav(), spec=rules)
    assert bank.traits[0, :, 0].mean() < 1.6
    sim = CrowdWorlds(bank, model="orca", task=CrowdNav(), device="cpu", spec=rules)
    play = sim.before_the_first(torch.zeros(1, dtype=torch.int64))
    for _ in range(40):
        play = sim.step(play, torch.zeros(1, 2))
    assert (torch.hypot(*(play.human.xz - play.human_before_xz).unbind(-1)) * 30).max() < 2.0
