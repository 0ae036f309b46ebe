"""Rearrangement learned in worlds on a device: the same inputs, masks, scores and decisions as on CPU cores, exact resume."""

from __future__ import annotations

import contextlib
import gzip
import json
import shutil
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("shapely")
pytest.importorskip("fcl")

import h3data  # noqa: E402
from benchmarks import device_scores  # noqa: E402
from h3data.errors import FormatError, InputError  # noqa: E402
from h3data_training.populations import run as run_module  # noqa: E402
from h3data_training.populations import worlds as populations  # noqa: E402
from h3data_training.populations.learner import ChooserLearner  # noqa: E402
from h3data_training.populations.playing import Decisions, Job, discounted  # noqa: E402
from h3data_training.populations.pool import bank_of, draw_pool, drawn_by, episodes_of, with_scenes  # noqa: E402
from h3data_training.populations.run import CHECKPOINT, POLICY, train  # noqa: E402
from h3data_training.populations.settings import ROBOT, PopulationSettings  # noqa: E402
from h3data_training.populations.tensor_choosers import arrays_of, encode, features, scored  # noqa: E402
from h3data_training.populations.worlds import TensorPlayers  # noqa: E402
from h3data_training.torch.rearrange.bank import RearrangeBank  # noqa: E402
from h3data_training.torch.rearrange.bank_file import load_bank, save_bank  # noqa: E402
from sim_kinematic.motion.spec import HOME_WALKER, OracleSpec  # noqa: E402
from sim_kinematic.policies.assignment import AssignedPolicy  # noqa: E402
from sim_kinematic.policies.choosers.chooser_network import OBSERVATIONS, SkillPolicyNetwork, encoded  # noqa: E402
from sim_kinematic.policies.choosers.recurrent_chooser import RecurrentSkillPolicy  # noqa: E402
from sim_kinematic.policies.learned import network_of  # noqa: E402
from sim_kinematic.policies.rearrange import partner_plan, planner  # noqa: E402
from sim_kinematic.policies.rearrange_observations import limits  # noqa: E402
from sim_kinematic.tasks.play import WorldRollout  # noqa: E402
from sim_kinematic.tasks.rearrange.episode import ORACLE_RULES, RearrangeEpisode, RearrangeSpec  # noqa: E402
from sim_kinematic.tasks.rearrange.task import Rearrange  # noqa: E402
from sim_kinematic.tasks.recorder import run  # noqa: E402
from sim_kinematic.tasks.sources import EpisodeSource  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")
DRAWN = PopulationSettings(scenes="h3-homes/val#1", episodes_per_home=4, walk="paper")
SMALL = replace(
    DRAWN,
    population="plan_pop_3",
    updates=2,
    hidden=8,
    width=8,
    chunk=4,
    epochs=2,
    critic_updates=1,
).in_worlds(6)
SHORT = replace(
    ORACLE_RULES, max_steps=50, oracle=OracleSpec(robot_steps=(2, 4), person_steps=(2, 4)), end_on_collision=False
)


@pytest.fixture(scope="module")
def episodes() -> list[RearrangeEpisode]:
    return episodes_of(draw_pool(DRAWN), DRAWN)


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_module, "ORACLE_RULES", SHORT)


def network(name: str = ROBOT, *, seed: int = 0, settings: PopulationSettings = SMALL) -> SkillPolicyNetwork:
    return ChooserLearner(settings, name, seed=seed).network()


def players_of(episodes: Sequence[RearrangeEpisode], **options: Any) -> TensorPlayers:
    bank = RearrangeBank.of([replace(episode, spec=run_module.ORACLE_RULES) for episode in episodes])
    return TensorPlayers(bank, "cpu", **options)


def jobs_of(count: int, networks: dict[str, SkillPolicyNetwork], partner: str = "both") -> list[Job]:
    return [Job(number=n, entry=n % 4, partner=partner, networks=networks, seed=3, gamma=0.99) for n in range(count)]


# --- the network --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("agent", "without", "pixels"),
    [
        (ROBOT, (), False),
        pytest.param(ROBOT, ("humanoid_gps",), False, marks=pytest.mark.slow),
        ("human", (), False),
        (ROBOT, (), True),
    ],
)
def test_inputs_and_scores_are_those_of_one_agent(agent: str, without: tuple[str, ...], pixels: bool) -> None:
    rng = np.random.default_rng(0)
    settings = replace(SMALL, population="learn_single", without=without, pixels=pixels)
    policy = network("partner_0" if agent == "human" else ROBOT, settings=settings)
    names = settings.observations_of(agent)
    known = limits(objects=2, arm=7 if agent == ROBOT else 0)
    rows = [
        {
            n: rng.uniform(np.maximum(known[n].low, -40), np.minimum(known[n].high, 40)).astype(np.float32)
            for n in {*OBSERVATIONS, *names} & set(known)
        }
        for _ in range(9)
    ]
    for row in rows:
        row["held_by_other"] = np.round(row["held_by_other"])
        row["arm_depth"] = rng.uniform(0, 1, (48, 64, 1)).astype(np.float32)
        row["humanoid_detector"] = rng.integers(0, 2, 1).astype(np.float32)
    seen = {n: torch.tensor(np.array([r[n] for r in rows])) for n in names}
    each, rest = encode(seen, agent, 2, observations=names)
    states = rng.normal(size=(9, 8)).astype(np.float32)
    arrays = arrays_of([policy], torch.device("cpu"))
    given = rest
    if pixels:
        roots = seen["arm_depth"][..., 0].sqrt().half().float()
        given = torch.cat([features(arrays, roots), rest], 1)
    (scores,), (after,) = scored(arrays, each[None], given[None], torch.tensor(states)[None])
    for n, row in enumerate(rows):
        one, other = encoded(row, agent=agent, objects=2, observations=names)
        np.testing.assert_allclose(each[n], one, rtol=0, atol=1e-5)
        np.testing.assert_allclose(rest[n], other, rtol=0, atol=1e-5)
        wanted, state = policy(one, other, states[n], row)
        np.testing.assert_allclose(scores[n], wanted, rtol=0, atol=1e-4)
        np.testing.assert_allclose(after[n], state, rtol=0, atol=1e-5)


def by_episode(decisions: Decisions) -> list[dict[str, np.ndarray]]:
    """The columns of each episode."""
    cuts = np.cumsum(decisions.counts)[:-1]
    names = [f.name for f in fields(decisions) if f.name not in ("counts", "partners")]
    parts = {name: np.split(np.asarray(getattr(decisions, name)), cuts) for name in names}
    return [{name: part[e] for name, part in parts.items()} for e in range(len(decisions.counts))]


class _Best(RecurrentSkillPolicy):
    """Keeps what it was asked; takes the best."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.rows: list[tuple[int, tuple[bool, ...], int]] = []
        self.depth = np.zeros(0)
        """What it saw first."""

    def choose(self, view: Any, each: Any, rest: Any, scores: Any) -> int:
        if not self.rows and self.network.sees:
            self.depth = self.shown["arm_depth"][..., 0]
        self.rows.append((view.step, tuple(np.isfinite(scores).tolist()), int(np.argmax(scores))))
        return self.rows[-1][2]


@pytest.mark.slow  # quick: sim/torch/test_rearrange.py
@pytest.mark.parametrize(("without", "pixels"), [((), False), (("humanoid_gps", "primitives"), False), ((), True)])
def test_decisions_are_those_of_the_cpu(
    episodes: Sequence[RearrangeEpisode], monkeypatch: pytest.MonkeyPatch, without: tuple[str, ...], pixels: bool
) -> None:
    rules = replace(SHORT, max_steps=110)
    monkeypatch.setattr(run_module, "ORACLE_RULES", rules)
    monkeypatch.setattr(torch, "rand", lambda shape, **_: torch.full(shape, 0.5))  # the best has the best chance
    settings = replace(SMALL, without=without, pixels=pixels)
    policy = network(seed=5, settings=settings)
    options = {"picture_size": settings.picture_size} if pixels else {}
    played, decisions = players_of(episodes, **options).play(jobs_of(4, {ROBOT: policy}))
    agree, equal = [], 0
    for job, own, mine in zip(jobs_of(4, {}), played, by_episode(decisions[ROBOT]), strict=True):
        episode = replace(episodes[job.entry], spec=rules)
        chooser = _Best(policy, 2)
        seed = populations.episode_seed(job.seed, job.number)
        plan = AssignedPolicy(planner(job.partner, seed, 2), job.partner, "human", job.partner)
        play = WorldRollout.of(Rearrange(), episode, [AssignedPolicy(chooser, ROBOT, ROBOT), plan])
        rewards: list[float] = []
        run(play, progress=lambda _, rewards=rewards, play=play: rewards.append(play.reward))
        first, chosen = chooser.rows[:4], mine["chosen"]
        assert len(chosen) > 4
        assert mine["pictures"].shape[1:] == ((48, 64) if pixels else (0, 0))
        if pixels:  # objects stay where they were
            gap = np.abs(mine["pictures"][0].astype(np.float32) ** 2 - chooser.depth)
            assert (gap > 0.01).mean() < 0.02
            assert np.ptp(chooser.depth) > 0
        assert not (chosen >= 9).any() or not without
        agree += [
            best == int(chosen[k]) and may == tuple(mine["allowed"][k].tolist())
            for k, (_, may, best) in enumerate(first)
        ]
        spans = np.diff([step for step, *_ in chooser.rows[:3]])
        np.testing.assert_allclose(np.log(mine["discount"][:2]) / np.log(0.99), spans, rtol=0, atol=1.01)
        if len(chosen) == len(chooser.rows):
            assert own.reward == pytest.approx(sum(rewards), abs=1e-6)
        gains, spans = discounted(np.array(rewards), [step for step, *_ in chooser.rows], 0.99)
        if len(gains) == len(chosen) and np.allclose(mine["discount"][:-1], 0.99 ** spans[:-1]):
            np.testing.assert_allclose(mine["gain"], gains, rtol=0, atol=1e-5)
            equal += 1
    assert equal
    assert np.mean(agree) > 0.9  # the robot on the device knows of the person's last step a step later


# --- episodes -----------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_every_episode_is_accounted_for(episodes: Sequence[RearrangeEpisode], short: None) -> None:
    settings = replace(SMALL, population="learn_single")
    networks = {name: network(name, settings=settings) for name in settings.learners}
    players = players_of(episodes)
    assert players.size == 4
    played, decisions = players.play(jobs_of(5, networks, "partner_0"))
    again, _ = players.play(jobs_of(5, networks, "partner_0"))
    assert played == again
    assert all(one.steps <= SHORT.max_steps and one.ended in ("success", "max_steps") for one in played)
    assert set(decisions) == {ROBOT, "partner_0"}
    for own in decisions.values():
        assert own.partners == ("partner_0",) * 5
        assert sum(own.counts) == len(own)
        for episode in by_episode(own):
            assert episode["allowed"][np.arange(len(episode["chosen"])), episode["chosen"]].all()
            assert (episode["log_prob"] <= 0).all()
            assert episode["discount"][-1] == 0
            assert (episode["discount"][:-1] < 1).all()
            assert not episode["state"][0].any()
            assert episode["state"][1:].any(1).all()


@pytest.mark.slow
def test_other_seeds_play_otherwise(episodes: Sequence[RearrangeEpisode], short: None) -> None:
    players, policy = players_of(episodes), network()
    chosen = [
        players.play([job._replace(seed=s) for job in jobs_of(3, {ROBOT: policy})]).decisions[ROBOT].chosen.tolist()
        for s in (1, 2)
    ]
    assert chosen[0] != chosen[1]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed, so nothing is compiled for the CPU")
def test_fused_steps_decide_alike(episodes: Sequence[RearrangeEpisode], short: None) -> None:
    settings = replace(SMALL, population="learn_pop")
    networks = {name: network(name, settings=settings) for name in settings.learners}
    jobs = [job._replace(partner=f"partner_{job.number % 3}") for job in jobs_of(6, networks)]
    one, other = (players_of(episodes, compile=compile).play(jobs) for compile in (False, True))
    assert one.played == other.played
    for name, mine in one.decisions.items():
        theirs = other.decisions[name]
        assert torch.equal(mine.chosen, theirs.chosen)
        torch.testing.assert_close(theirs.log_prob, mine.log_prob, rtol=0, atol=1e-5)


@pytest.mark.slow
def test_a_bank_is_drawn_home_by_home(episodes: Sequence[RearrangeEpisode], tmp_path: Path) -> None:
    bank = bank_of(DRAWN, tmp_path / "bank.npz", workers=1)
    whole = RearrangeBank.of([replace(e, spec=ORACLE_RULES) for e in episodes])
    np.testing.assert_array_equal(bank.seeds, whole.seeds)
    np.testing.assert_array_equal(bank.first, whole.first)
    assert len(bank.floors) == len(whole.floors)
    drawn = with_scenes(load_bank(tmp_path / "bank.npz")[0], tmp_path / "bank.npz")
    assert [len(scene.instances) for scene in drawn.scenes] == [len(scene.instances) for scene in whole.scenes]
    with pytest.raises(InputError, match="H3-TRAIN-016"):
        with_scenes(replace(bank, names=()), tmp_path / "bank.npz")


@pytest.mark.slow
def test_a_bank_comes_back_from_its_file(episodes: Sequence[RearrangeEpisode], tmp_path: Path, short: None) -> None:
    bank, file = RearrangeBank.of([replace(e, spec=SHORT) for e in episodes]), tmp_path / "bank.npz"
    save_bank(bank, file, drawn_by=drawn_by(DRAWN))
    kept, known = load_bank(file, spec=SHORT)
    assert known == drawn_by(DRAWN)
    assert len(kept) == len(bank)
    assert (kept.robot.name, kept.human.name) == (bank.robot.name, bank.human.name)
    jobs = jobs_of(4, {ROBOT: network()})
    one, other = (TensorPlayers(b, "cpu").play(jobs) for b in (bank, kept))
    assert one.played == other.played
    with pytest.raises(InputError, match="H3-TRAIN-066"):
        load_bank(file)
    save_bank(replace(bank, spec=ORACLE_RULES), file, drawn_by=drawn_by(DRAWN))
    assert len(bank_of(DRAWN, file)) == len(bank)
    with pytest.raises(InputError, match=r"(?s)scenes='h3-homes/val\#1', not 'b'\. Hint.*H3-TRAIN-026"):
        bank_of(replace(DRAWN, scenes="b"), file)
    whole, rng = file.read_bytes(), np.random.default_rng(0)
    for broken in (b"", whole[: len(whole) // 2], b"PK" + whole[2:200], gzip.compress(b"{}")):
        file.write_bytes(broken)
        with pytest.raises(FormatError, match="H3-TRAIN-067") as caught:
            load_bank(file)
        assert "\n" not in str(caught.value)
        assert "pickle" not in str(caught.value)
    for at in rng.integers(0, len(whole), 40).tolist():  # bits of headers may not matter
        file.write_bytes(whole[:at] + bytes([whole[at] ^ (1 << int(rng.integers(8)))]) + whole[at + 1 :])
        with contextlib.suppress(FormatError):
            assert load_bank(file)[1] == drawn_by(DRAWN)


@pytest.mark.slow
def test_agents_begin_where_they_do_in_episodes_of_the_same_home(
    episodes: Sequence[RearrangeEpisode], short: None
) -> None:
    jobs = jobs_of(24, {ROBOT: network()})
    kept, moved = (players_of(episodes, moves_starts=moves) for moves in (False, True))
    for players, most in ((kept, 4), (moved, 16)):
        places = []
        for seed in range(3):
            players.play([job._replace(seed=seed) for job in jobs])
            assert players._worlds is not None
            places.append(
                players._worlds._starts(torch.tensor([j.entry for j in jobs]), torch.Generator().manual_seed(seed))
            )
        found = torch.cat(places)
        known = torch.tensor(np.array([episode.starts for episode in episodes]))
        for who in range(2):
            assert (found[:, None, who] == known[None, :, who]).all(-1).any(1).all()
        assert 4 <= len(found.flatten(1).unique(dim=0)) <= most
        assert (found[:, 0, :2] - found[:, 1, :2]).norm(dim=1).min() > 0.5
    assert len(found.flatten(1).unique(dim=0)) > 6


# --- runs ---------------------------------------------------------------------------------------------------------------
def arrays(folder: Path, name: str = POLICY) -> dict[str, np.ndarray]:
    found = network_of(f"weights:{folder / name}")
    assert isinstance(found, SkillPolicyNetwork)
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
    with pytest.raises(InputError, match="H3-TRAIN-003"):
        train(whole, replace(SMALL, oracle=False), episodes=episodes, resume=True)
    assert (whole / CHECKPOINT).exists()


@pytest.mark.slow
def test_reward_rises(episodes: Sequence[RearrangeEpisode], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(run_module, "ORACLE_RULES", replace(SHORT, max_steps=200))
    settings = replace(DRAWN, population="plan_pop_1", updates=20, hidden=32, width=32).in_worlds(48)
    import pyarrow.parquet as pq

    train(tmp_path, settings, episodes=episodes)
    reward = pq.read_table(tmp_path / "curve.parquet")["reward"].to_numpy()
    assert reward[-4:].mean() > reward[:4].mean() + 2.0


def test_no_such_device(episodes: Sequence[RearrangeEpisode], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="H3-ENV-017"):
        train(tmp_path, SMALL, device="toaster", episodes=episodes)
    if not torch.cuda.is_available():
        with pytest.raises(InputError, match="H3-ENV-013"):
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
        (("--worlds", "0"), "at least 1 world"),
        (("--worlds", "8", "--workers", "0"), "at least 1 worker"),
        (("--worlds", "8", "--gpus", "2"), "no options of rearrange: --gpus"),
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
    assert isinstance(robot, SkillPolicyNetwork)
    seeds = [one.seed for one in episodes]
    monkeypatch.setattr(run_module, "ORACLE_RULES", replace(ORACLE_RULES, end_on_collision=False))
    monkeypatch.setattr(populations, "episode_seed", lambda seed, number: seeds[number])  # plans are the episode's
    jobs = [
        Job(number=n, entry=n, partner=partner_plan("plan_pop_3", s), networks={ROBOT: robot}, seed=1, gamma=0.99)
        for n, s in enumerate(seeds)
    ]
    device = [(p.ended == "success", p.steps) for p in players_of(episodes).play(jobs).played]
    full = []
    for episode in episodes:
        play = WorldRollout.of(task, episode, {"robot": "learn_single", "human": "plan_pop_3"})
        full.append((run(play) == "success", play.step))
    # measured: success 0.93 and 0.97, steps 414 and 499
    (success, steps), (full_success, full_steps) = (np.mean(rows, 0) for rows in (device, full))
    assert abs(success - full_success) <= 0.1
    assert 0.7 * full_steps <= steps <= full_steps


@pytest.mark.slow
def test_a_device_and_an_evaluation_score_alike(tmp_path: Path) -> None:
    """With oracle skills, in fresh episodes; `python -m benchmarks device_scores` has 150 of them (docs/gpu.md)."""
    robot, partner = device_scores.PAIRS[0]
    found, count = list(device_scores.fresh_episodes(12)), 12
    h3data.evaluate(
        "rearrange",
        tmp_path / "table",
        policies=[robot],
        partners=[partner],
        skills=["oracle"],
        scenes=device_scores.SCENES,
        seed=device_scores.SEED,
        episodes=count,
    )
    rows = [json.loads(file.read_text())["rows"][0] for file in sorted((tmp_path / "table").glob("episodes/*.json"))]
    judged = [row["ended"] == "success" for row in rows]
    assert judged == device_scores.cpu_successes(found, robot, partner).tolist()
    there = device_scores.device_successes(RearrangeBank.of(found), robot, partner, "cpu", rounds=2)
    assert there.shape == (2, count)
    assert abs(there.mean() - np.mean(judged)) <= 0.15  # measured: 0.95 and 0.93 of 150
