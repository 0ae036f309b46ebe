"""Rearrangement learned in worlds on a device: the same inputs, masks, scores and decisions as on CPU cores, exact resume."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("shapely")
pytest.importorskip("fcl")

from h3data.errors import InputError  # noqa: E402
from h3data_training.populations import worlds as populations  # noqa: E402
from h3data_training.populations.learner import ChooserLearner  # noqa: E402
from h3data_training.populations.playing import Job  # noqa: E402
from h3data_training.populations.pool import draw_pool, episodes_of  # noqa: E402
from h3data_training.populations.run import CHECKPOINT, POLICY, train  # noqa: E402
from h3data_training.populations.settings import ROBOT, PopulationSettings  # noqa: E402
from h3data_training.populations.worlds import TensorPlayers, arrays_of, encode, scored  # noqa: E402
from sim_kinematic.motion.spec import HOME_WALKER, OracleSpec  # noqa: E402
from sim_kinematic.policies.assignment import AssignedPolicy  # noqa: E402
from sim_kinematic.policies.choosers.chooser_network import OBSERVATIONS, ChooserNetwork, encoded  # noqa: E402
from sim_kinematic.policies.choosers.recurrent_chooser import RecurrentChooser  # noqa: E402
from sim_kinematic.policies.learned import network_of  # noqa: E402
from sim_kinematic.policies.rearrange import partner_plan, planner  # noqa: E402
from sim_kinematic.policies.rearrange_observations import limits  # noqa: E402
from sim_kinematic.tasks.rearrange.episode import ORACLE_RULES, RearrangeEpisode, RearrangeSpec  # noqa: E402
from sim_kinematic.tasks.rearrange.play import RearrangePlay  # noqa: E402
from sim_kinematic.tasks.rearrange.task import Rearrange  # noqa: E402
from sim_kinematic.tasks.runner import run  # noqa: E402
from sim_kinematic.tasks.sources import EpisodeSource  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")
DRAWN = PopulationSettings(scenes="h3-homes/val#1", episodes_per_home=4, walk="paper")
SMALL = replace(
    DRAWN, population="plan_pop_3", updates=2, hidden=8, width=8, chunk=4, epochs=2, critic_updates=1,
).in_worlds(6)  # fmt: skip
SHORT = replace(
    ORACLE_RULES, max_steps=50, oracle=OracleSpec(robot_steps=(2, 4), person_steps=(2, 4)), end_on_collision=False
)


@pytest.fixture(scope="module")
def episodes() -> list[RearrangeEpisode]:
    return episodes_of(draw_pool(DRAWN), DRAWN)


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(populations, "ORACLE_RULES", SHORT)


def network(name: str = ROBOT, *, seed: int = 0, settings: PopulationSettings = SMALL) -> ChooserNetwork:
    return ChooserLearner(settings, name, seed=seed).network()


def jobs_of(count: int, networks: dict[str, ChooserNetwork], partner: str = "both") -> list[Job]:
    return [
        Job(number=n, entry=n % 4, partner=partner, networks=networks, seed=3, gamma=0.99) for n in range(count)
    ]  # fmt: skip


# --- the network --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("agent", "without"), [(ROBOT, ()), (ROBOT, ("humanoid_gps",)), ("human", ())])
def test_inputs_and_scores_are_those_of_one_agent(agent: str, without: tuple[str, ...]) -> None:
    rng = np.random.default_rng(0)
    settings = replace(SMALL, population="learn_single", without=without)
    policy = network("partner_0" if agent == "human" else ROBOT, settings=settings)
    names = settings.observations_of(agent)
    known = limits(objects=2, arm=7 if agent == ROBOT else 0)
    rows = [
        {
            n: rng.uniform(np.maximum(known[n].low, -40), np.minimum(known[n].high, 40)).astype(np.float32)
            for n in OBSERVATIONS
        }
        for _ in range(9)
    ]
    for row in rows:
        row["held_by_other"] = np.round(row["held_by_other"])
    seen = {n: torch.tensor(np.array([r[n] for r in rows])) for n in names}
    each, rest = encode(seen, agent, 2, observations=names)
    states = rng.normal(size=(9, 8)).astype(np.float32)
    scores, after = scored(arrays_of(policy, torch.device("cpu")), each, rest, torch.tensor(states))
    for n, row in enumerate(rows):
        one, other = encoded(row, agent=agent, objects=2, observations=names)
        np.testing.assert_allclose(each[n], one, rtol=0, atol=1e-5)
        np.testing.assert_allclose(rest[n], other, rtol=0, atol=1e-5)
        wanted, state = policy(one, other, states[n])
        np.testing.assert_allclose(scores[n], wanted, rtol=0, atol=1e-4)
        np.testing.assert_allclose(after[n], state, rtol=0, atol=1e-5)


class _Best(RecurrentChooser):
    """Keeps what it was asked; takes the best."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.rows: list[tuple[int, tuple[bool, ...], int]] = []

    def choose(self, view: Any, each: Any, rest: Any, scores: Any) -> int:
        self.rows.append((view.step, tuple(np.isfinite(scores).tolist()), int(np.argmax(scores))))
        return self.rows[-1][2]


@pytest.mark.slow  # quick: sim/torch/test_rearrange.py
@pytest.mark.parametrize("without", [(), pytest.param(("humanoid_gps", "primitives"), marks=pytest.mark.slow)])
def test_decisions_are_those_of_the_cpu(
    episodes: Sequence[RearrangeEpisode], monkeypatch: pytest.MonkeyPatch, without: tuple[str, ...]
) -> None:
    rules = replace(SHORT, max_steps=110)
    monkeypatch.setattr(populations, "ORACLE_RULES", rules)
    monkeypatch.setattr(torch, "rand", lambda shape, **_: torch.full(shape, 0.5))  # the best has the best chance
    policy = network(seed=5, settings=replace(SMALL, without=without))
    played = TensorPlayers(episodes, "cpu").play(jobs_of(4, {ROBOT: policy}))
    agree = []
    for job, own in zip(jobs_of(4, {}), played, strict=True):
        episode = replace(episodes[job.entry], spec=rules)
        chooser = _Best(policy, 2)
        seed = populations.episode_seed(job.seed, job.number)
        plan = AssignedPolicy(planner(job.partner, seed, 2), job.partner, "human", job.partner)
        play = RearrangePlay(episode, [AssignedPolicy(chooser, ROBOT, ROBOT), plan])
        rewards: list[float] = []
        run(play, progress=lambda _, rewards=rewards, play=play: rewards.append(play.reward))
        mine, first = own.decisions[ROBOT], chooser.rows[:4]
        assert len(mine) > 4
        assert not (mine.chosen[:, None] >= 9).any() or not without
        agree += [
            chosen == int(mine.chosen[k]) and may == tuple(mine.allowed[k].tolist())
            for k, (_, may, chosen) in enumerate(first)
        ]
        spans = np.diff([step for step, *_ in chooser.rows[:3]])
        np.testing.assert_allclose(np.log(mine.discount[:2]) / np.log(0.99), spans, rtol=0, atol=1.01)
        if len(mine) == len(chooser.rows):
            assert own.reward == pytest.approx(sum(rewards), abs=1e-6)
    assert np.mean(agree) > 0.9  # the robot on the device knows of the person's last step a step later


# --- episodes -----------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_every_episode_is_accounted_for(episodes: Sequence[RearrangeEpisode], short: None) -> None:
    settings = replace(SMALL, population="learn_single")
    networks = {name: network(name, settings=settings) for name in settings.learners}
    players = TensorPlayers(episodes, "cpu")
    assert players.size == 4
    played = players.play(jobs_of(5, networks, "partner_0"))
    again = players.play(jobs_of(5, networks, "partner_0"))
    assert [p.reward for p in played] == [p.reward for p in again]
    for one in played:
        assert set(one.decisions) == {ROBOT, "partner_0"}
        assert one.steps <= SHORT.max_steps
        assert one.ended in ("success", "max_steps")
        for decisions in one.decisions.values():
            assert decisions.allowed[np.arange(len(decisions)), decisions.chosen].all()
            assert (decisions.log_prob <= 0).all()
            assert decisions.discount[-1] == 0
            assert (decisions.discount[:-1] < 1).all()
            assert not decisions.state[0].any()
            assert decisions.state[1:].any(1).all()


@pytest.mark.slow
def test_other_seeds_play_otherwise(episodes: Sequence[RearrangeEpisode], short: None) -> None:
    players, policy = TensorPlayers(episodes, "cpu"), network()
    chosen = [
        [
            p.decisions[ROBOT].chosen.tolist()
            for p in players.play([job._replace(seed=s) for job in jobs_of(3, {ROBOT: policy})])
        ]
        for s in (1, 2)
    ]
    assert chosen[0] != chosen[1]


# --- runs ---------------------------------------------------------------------------------------------------------------
def arrays(folder: Path, name: str = POLICY) -> dict[str, np.ndarray]:
    found = network_of(f"weights:{folder / name}")
    assert isinstance(found, ChooserNetwork)
    return dict(found.arrays)


@pytest.mark.slow  # quick: the same on CPU cores, test_populations.py
def test_a_run_learns_and_resumes_exactly(episodes: Sequence[RearrangeEpisode], short: None, tmp_path: Path) -> None:
    whole, parted = tmp_path / "whole", tmp_path / "parted"
    for folder in (whole, parted):
        folder.mkdir()
    result = train(whole, SMALL, episodes=episodes)
    assert result.done
    assert result.last["episodes"] == 12
    before = dict(network().arrays)
    assert any(not np.array_equal(before[name], array) for name, array in arrays(whole).items())
    train(parted, replace(SMALL, updates=1), episodes=episodes)
    assert not all(np.array_equal(a, arrays(whole)[n]) for n, a in arrays(parted).items())
    train(parted, SMALL, episodes=episodes, resume=True)
    assert all(np.array_equal(a, arrays(whole)[n]) for n, a in arrays(parted).items())
    (whole / "other").mkdir()
    with pytest.raises(InputError, match="oracle=True, not False"):
        train(whole, replace(SMALL, oracle=False), episodes=episodes, resume=True)
    assert (whole / CHECKPOINT).exists()


@pytest.mark.slow
def test_reward_rises(episodes: Sequence[RearrangeEpisode], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(populations, "ORACLE_RULES", replace(SHORT, max_steps=200))
    settings = replace(DRAWN, population="plan_pop_1", updates=20, hidden=32, width=32).in_worlds(48)
    import pyarrow.parquet as pq

    train(tmp_path, settings, episodes=episodes)
    reward = pq.read_table(tmp_path / "curve.parquet")["reward"].to_numpy()
    assert reward[-4:].mean() > reward[:4].mean() + 2.0


def test_no_such_device(episodes: Sequence[RearrangeEpisode], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Unknown device"):
        train(tmp_path, SMALL, device="toaster", episodes=episodes)
    if not torch.cuda.is_available():
        with pytest.raises(InputError, match="no GPU"):
            train(tmp_path, SMALL, device="cuda", episodes=episodes)


def test_the_command_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    from h3data_pipelines.cli import main

    out = ["-o", str(tmp_path / "run")]
    assert main(["train", "rearrange", "--worlds", "128", "--updates", "10", "--dry-run", *out]) == 0
    said = capsys.readouterr().out
    assert '"oracle": true' in said
    assert '"episodes": 128' in said
    assert '"chunks_per_minibatch": 48' in said
    assert "10 updates with 1 worker" in said
    for words, message in (
        (("--device", "cuda"), "Without --worlds rearrange plays our full rules"),
        (("--worlds", "0"), "at least 1 world"),
        (("--worlds", "8", "--workers", "2"), "no --workers"),
        (("--worlds", "8", "--gpus", "2"), "Options of social_nav, not of rearrange: --gpus"),
    ):
        assert main(["train", "rearrange", *words, *out]) == 2
        assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "run").exists()


# --- judgement ----------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_device_and_full_rules_judge_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same robot beside the same partners in the same episodes: success and steps with oracle skills, where agents pass
    through each other, are near those of our full rules, where they give way (docs/gpu.md)."""
    rules = RearrangeSpec(max_steps=750, human=HOME_WALKER)
    sources = [EpisodeSource(Rearrange(), f"h3-homes/test#{k}", spec=rules) for k in range(10)]
    found = [source.sample(7, k) for source in sources for k in range(3)]
    episodes = [one for one in found if isinstance(one, RearrangeEpisode)]
    robot, task = network_of("learn_single"), Rearrange()
    assert isinstance(robot, ChooserNetwork)
    seeds = [one.seed for one in episodes]
    monkeypatch.setattr(populations, "ORACLE_RULES", replace(ORACLE_RULES, end_on_collision=False))
    monkeypatch.setattr(populations, "episode_seed", lambda seed, number: seeds[number])  # plans are the episode's
    jobs = [
        Job(number=n, entry=n, partner=partner_plan("plan_pop_3", s), networks={ROBOT: robot}, seed=1, gamma=0.99)
        for n, s in enumerate(seeds)
    ]
    device = [(p.ended == "success", p.steps) for p in TensorPlayers(episodes, "cpu").play(jobs)]
    full = []
    for episode in episodes:
        play = task.play(episode, task.assign(episode, {"robot": "learn_single", "human": "plan_pop_3"}))
        full.append((run(play) == "success", play.steps))
    # measured: success 1.00 and 0.97, steps 371 and 483
    (success, steps), (full_success, full_steps) = (np.mean(rows, 0) for rows in (device, full))
    assert abs(success - full_success) <= 0.1
    assert 0.7 * full_steps <= steps <= full_steps
