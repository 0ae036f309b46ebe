"""Rearrangement learned beside populations: fair draws, masks, parity, learning, exact resume, lost processes, files."""

from __future__ import annotations

import json
import os
import signal
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from h3data.errors import FormatError, H3DataError, InputError
from h3data_pipelines.cli import main
from h3data_pipelines.jobs.evaluation_runs import EvaluationRequest
from h3data_training.curve import curve_of
from h3data_training.populations import learner as learning
from h3data_training.populations import playing
from h3data_training.populations import run as runs
from h3data_training.populations.learner import ChooserLearner, plan_at
from h3data_training.populations.networks import Chooser
from h3data_training.populations.playing import Batch, Decisions, Job, Players, discounted
from h3data_training.populations.pool import draw_pool, episodes_of, pool_of, pool_order
from h3data_training.populations.run import CHECKPOINT, POLICY, train
from h3data_training.populations.settings import NAMES, ROBOT, PopulationSettings, rearrange_recipe
from sim_kinematic.agents.skills import choices
from sim_kinematic.policies.assignment import AssignedPolicy, resolve_policy
from sim_kinematic.policies.choosers.chooser_network import (
    OBSERVATIONS,
    OF_OTHER,
    PIXELS,
    SkillPolicyNetwork,
    encoded,
    input_lengths,
    rest_count,
)
from sim_kinematic.policies.choosers.recurrent_chooser import RecurrentSkillPolicy, allowed, observed
from sim_kinematic.policies.learned import SHIPPED_HELPERS, SHIPPED_PARTNERS, network_of
from sim_kinematic.policies.rearrange import ZSC_TEN, learned_chooser, planner
from sim_kinematic.policies.rearrange_observations import limits, observe
from sim_kinematic.policies.visual_policy import save_policy
from sim_kinematic.tasks.play import WorldRollout
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.recorder import run
from sim_kinematic.tasks.registry import find_task

DRAWN = PopulationSettings(scenes="h3-homes/train#0", episodes_per_home=2)
"""Of the episodes; tests cut them short, which has no effect on how they begin."""
SMALL = replace(
    DRAWN,
    population="learn_single",
    episodes=3,
    updates=3,
    hidden=8,
    width=8,
    chunk=4,
    epochs=2,
    chunks_per_minibatch=4,
    critic_updates=1,
)


@pytest.fixture(scope="module")
def pool(tmp_path_factory: Any) -> Path:
    file = tmp_path_factory.mktemp("pool") / "episodes.json.gz"
    pool_of(DRAWN, file)
    return file


@pytest.fixture(scope="module")
def episodes(pool: Path) -> list[RearrangeEpisode]:
    drawn = episodes_of(pool_of(DRAWN, pool), DRAWN)
    return [replace(episode, spec=replace(episode.spec, max_steps=90)) for episode in drawn]


@pytest.fixture(scope="module")
def whole(episodes: Sequence[RearrangeEpisode], tmp_path_factory: Any) -> Path:
    """A run of three updates."""
    folder = tmp_path_factory.mktemp("whole")
    said: list[str] = []
    result = train(folder, SMALL, workers=1, episodes=episodes, say=said.append)
    assert result.done
    assert result.updates == 3
    assert any(line.startswith("learn_single: 2 learners, 1 worker after") for line in said)
    assert any("update 1 " in line and "steps/s" in line for line in said)
    return folder


def chooser(name: str = ROBOT, *, seed: int = 0, **changes: Any) -> SkillPolicyNetwork:
    """An untrained policy."""
    return ChooserLearner(replace(SMALL, **changes), name, seed=seed).network()


def arrays(folder: Path, name: str = POLICY) -> dict[str, np.ndarray]:
    network = network_of(f"weights:{folder / name}")
    assert isinstance(network, SkillPolicyNetwork)
    return dict(network.arrays)


def same(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[n], b[n]) for n in a)


# --- who plays ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("population", NAMES)
def test_every_partner_plays_as_often(population: str) -> None:
    settings = replace(SMALL, population=population)
    count = len(settings.partners)
    drawn = [settings.partner_of(7, n) for n in range(20 * count)]
    assert Counter(drawn) == dict.fromkeys(settings.partners, 20)
    assert drawn == [settings.partner_of(7, n) for n in range(20 * count)]
    others = [settings.partner_of(8, n) for n in range(20 * count)]
    assert count == 1 or drawn != others
    blocks = {tuple(drawn[n : n + count]) for n in range(0, len(drawn), count)}
    assert count == 1 or len(blocks) > 1


def test_every_episode_is_played_as_often() -> None:
    order = [pool_order(6, 3, n) for n in range(18)]
    assert [sorted(order[n : n + 6]) for n in (0, 6, 12)] == [list(range(6))] * 3
    assert order[:6] != order[6:12]


def test_learners_are_those_of_the_paper() -> None:
    learners = {name: replace(SMALL, population=name).learners for name in NAMES}
    assert {name: len(of) for name, of in learners.items()} == {
        "learn_single": 2,
        "plan_pop_1": 1,
        "plan_pop_2": 1,
        "plan_pop_3": 1,
        "plan_pop_4": 1,
        "learn_pop": 9,
    }
    nets = [chooser(name, population="learn_pop").arrays for name in learners["learn_pop"]]
    assert not any(same(dict(nets[i]), dict(nets[j])) for i in range(1, 9) for j in range(i))


# --- episodes -----------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_episodes_come_back_from_their_file(pool: Path, tmp_path: Path) -> None:
    drawn, read = draw_pool(DRAWN), pool_of(DRAWN, pool)
    assert drawn == read
    for entry, episode in zip(read.entries, episodes_of(read, DRAWN), strict=True):
        task = find_task("rearrange")
        again = task.sample(episode.scene, episode.free, entry.seed, episode.spec, episode.roster)
        assert [t.name for t in again.targets] == [t.name for t in episode.targets]  # type: ignore[attr-defined]
        np.testing.assert_array_equal(again.starts, episode.starts)
        for a, b in zip(again.targets, episode.targets, strict=True):  # type: ignore[attr-defined]
            np.testing.assert_array_equal(a.goal, b.goal)
            np.testing.assert_array_equal(a.start, b.start)
    assert [entry.walk for entry in read.entries] == ["paper", "natural"]
    assert [episode.spec.max_steps for episode in episodes_of(read, DRAWN)] == [750, 1500]
    with pytest.raises(InputError, match="H3-TRAIN-026"):
        pool_of(replace(DRAWN, walk="paper"), pool)
    for content in (pool.read_bytes()[:40], b"what", b""):
        (tmp_path / "bad").write_bytes(content)
        with pytest.raises(FormatError, match="H3-TRAIN-029"):
            pool_of(DRAWN, tmp_path / "bad")


# --- choosing -----------------------------------------------------------------------------------------------------------
def shown(agent: str, rng: np.random.Generator, objects: int = 2) -> dict[str, np.ndarray]:
    """Random observations."""
    known = limits(objects=objects, arm=7 if agent == ROBOT else 0)
    found = {
        "arm_depth": rng.uniform(0, 1, (48, 64, 1)).astype(np.float32),
        "humanoid_detector": np.ones(1, np.float32),
    }
    for name in sorted({*OBSERVATIONS, *PIXELS} - set(found)):  # sets have another order in each process
        low, high = np.maximum(known[name].low, -9), np.minimum(known[name].high, 9)
        found[name] = rng.uniform(low, high).astype(np.float32)
    return found


@pytest.mark.parametrize(
    ("name", "without", "pixels"),
    [
        (ROBOT, (), False),
        (ROBOT, ("humanoid_gps",), False),
        ("partner_0", (), False),
        (ROBOT, (), True),
        (ROBOT, ("humanoid_gps",), True),
        ("partner_0", (), True),
    ],
)
def test_it_gives_what_pytorch_gives(name: str, without: tuple[str, ...], pixels: bool) -> None:
    agent, rng = (ROBOT if name == ROBOT else "human"), np.random.default_rng(4)
    learner = ChooserLearner(replace(SMALL, without=without, pixels=pixels), name, seed=2)
    with torch.no_grad():
        for parameter in learner.net.parameters():
            parameter.add_(torch.as_tensor(rng.normal(0, 0.3, parameter.shape), dtype=torch.float32))
    network, seen = learner.network(), learner.settings.observations_of(agent)
    moments = [shown(agent, rng) for _ in range(12)]
    inputs = [encoded(moment, agent=agent, objects=2, observations=seen) for moment in moments]
    each, rest = (torch.as_tensor(np.array(column))[:, None] for column in zip(*inputs, strict=True))
    pictures = torch.zeros(12, 1, 0, 0)
    if network.sees:
        depth = np.array([moment["arm_depth"][None, ..., 0] for moment in moments])
        pictures = torch.as_tensor(np.sqrt(depth).astype(np.float16))
    with torch.no_grad():
        expected = learner.net(each, rest, torch.zeros(1, 8), pictures)[0][:, 0].numpy()
    state, scores = network.start(), []
    for moment, own in zip(moments, inputs, strict=True):
        score, state = network(*own, state, moment)
        scores.append(score)
    assert (network.sees == "arm_depth") == (pixels and name == ROBOT)
    assert (each.shape[-1], rest.shape[-1]) == input_lengths(agent, seen)
    # Sums of float32 differ by the order that a processor adds in, so an error is measured by the largest score.
    np.testing.assert_allclose(scores, expected, rtol=2e-5, atol=2e-6 * np.abs(expected).max())


def test_objects_are_alike_but_for_their_numbers() -> None:
    rng, network = np.random.default_rng(1), chooser()
    known = dict(network.arrays)
    known["object.weight"] = known["object.weight"].copy()
    known["object.weight"][:, -2:] = 0  # their numbers
    wide = len(known["object.weight"])
    gru = known["gru.weight_ih"].copy()
    gru[:, -wide:] = gru[:, -2 * wide : -wide]  # where each is in the input of the recurrent layer
    network = replace(network, arrays=known | {"gru.weight_ih": gru})
    each, rest = encoded(shown(ROBOT, rng), agent=ROBOT, objects=2)
    scores, swapped = network(each, rest, network.start())[0], network(each[::-1].copy(), rest, network.start())[0]
    np.testing.assert_allclose(swapped[:8].reshape(4, 2)[:, ::-1].ravel(), scores[:8], atol=1e-6)
    np.testing.assert_allclose(swapped[8:], scores[8:], atol=1e-6)
    assert np.ptp(scores[:8].reshape(4, 2), axis=1).max() > 1e-4


class _Watched(RecurrentSkillPolicy):
    """Chooses at random and checks what it may choose."""

    def __init__(self, network: SkillPolicyNetwork, *, robot: bool, seed: int) -> None:
        super().__init__(network, 2, robot=robot)
        self.rng, self.play, self.seen = np.random.default_rng(seed), None, set()

    def choose(self, view: Any, each: Any, rest: Any, scores: Any) -> int:
        may = np.isfinite(scores)
        assert may.any()
        np.testing.assert_array_equal(may, allowed(view, self.choices))
        for number in np.flatnonzero(may).tolist():
            assert self.play.team.objects.why_not(view.agent, self.choices[number]) == ""  # type: ignore[attr-defined]
        skill = [self.choices[k].skill for k in np.flatnonzero(may)]
        preferred = [k for k, s in zip(np.flatnonzero(may).tolist(), skill, strict=True) if s in ("pick", "place")]
        chosen = int(self.rng.choice(preferred or np.flatnonzero(may)))
        self.seen.add(self.choices[chosen].skill)
        return chosen


@pytest.mark.slow
def test_what_cannot_be_is_never_offered(episodes: Sequence[RearrangeEpisode]) -> None:
    episode = replace(episodes[0], spec=replace(episodes[0].spec, max_steps=700))
    robot = _Watched(chooser(think_steps=200), robot=True, seed=1)
    person = _Watched(chooser("partner_0", think_steps=200), robot=False, seed=2)
    play = WorldRollout.of(
        Rearrange(),
        episode,
        [
            playing.AssignedPolicy(robot, "robot", "robot"),
            playing.AssignedPolicy(person, "human", "human"),
        ],
    )
    robot.play = person.play = play  # type: ignore[assignment]
    run(play)
    assert {"nav_to_object", "pick"} <= robot.seen | person.seen


def test_a_score_cannot_buy_what_is_not_allowed(episodes: Sequence[RearrangeEpisode]) -> None:
    network = chooser()
    bias = network.arrays["each_1.bias"].copy()
    bias[2:] = 1e6  # pick and place, and nobody has arrived anywhere
    policy = RecurrentSkillPolicy(replace(network, arrays={**network.arrays, "each_1.bias": bias}), 2, robot=True)
    play = WorldRollout.of(
        Rearrange(),
        episodes[0],
        [
            playing.AssignedPolicy(policy, "robot", "robot"),
            playing.AssignedPolicy(planner("still", 0), "still", "human"),
        ],
    )
    assert policy.act(play.view(0)).skill not in ("pick", "place")
    assert policy.choices == choices(2, robot=True)


# --- ablations ----------------------------------------------------------------------------------------------------------
def moved_person(view: Any, rng: np.random.Generator) -> Any:
    """The view with the person, and what they hold, somewhere else in the home."""
    start = view.free.sample(rng, 1)[0]
    objects = view.objects.copy()
    objects[view.held_by == 1, 0], objects[view.held_by == 1, 2] = start
    return view._replace(other_xz=start, other_track=np.roll(view.other_track, 3, 0) + 0.1, objects=objects)


@pytest.mark.slow
def test_without_gps_nothing_tells_where_the_person_is(episodes: Sequence[RearrangeEpisode]) -> None:
    rng, robot = np.random.default_rng(0), RecurrentSkillPolicy(chooser(without=("humanoid_gps",)))
    assert robot.network.observations == tuple(n for n in OBSERVATIONS if n not in OF_OTHER)
    inputs: dict[str, list[np.ndarray]] = {"blind": [], "seeing": []}
    blind, seeing = robot.network.observations, OBSERVATIONS
    play = WorldRollout.of(
        Rearrange(),
        replace(episodes[0], spec=replace(episodes[0].spec, max_steps=700)),
        [
            playing.AssignedPolicy(planner("still", 0), "still", "robot"),
            playing.AssignedPolicy(planner("both", 0), "both", "human"),
        ],
    )
    carried = 0

    def compare(_: Any) -> None:
        nonlocal carried
        if play.step % 40:
            return
        view = play.view(0)
        other = moved_person(view, rng)
        carried += bool((view.held_by == 1).any())
        for name, seen in (("blind", blind), ("seeing", seeing)):
            a, b = (
                np.concatenate(
                    [p.ravel() for p in encoded(observe(v, seen), agent=ROBOT, objects=2, observations=seen)]
                )
                for v in (view, other)
            )
            inputs[name].append(a - b)

    run(play, progress=compare)
    assert carried > 2
    assert not np.any(inputs["blind"])
    assert all(np.any(difference) for difference in inputs["seeing"])


def test_without_primitives_none_is_chosen(episodes: Sequence[RearrangeEpisode]) -> None:
    network = chooser(without=("primitives",))
    rest = network.arrays["rest_1.bias"].copy()
    rest[1:] = 1e6
    assert network.offered.tolist() == [True] * 9 + [False] * 4
    sure = {**network.arrays, "rest_1.bias": rest}
    for own in (network, chooser()):
        job = Job(1, 0, "both", {ROBOT: replace(own, arrays=sure)}, 0, 0.99)
        chosen = playing.play_episode(job, episodes[0]).decisions[ROBOT]
        assert (chosen.chosen >= 9).all() if own.card.primitives else (chosen.chosen < 9).all()
        assert (chosen.allowed[:, 9:] == own.card.primitives).all()
        assert np.isfinite(chosen.log_prob).all()


@pytest.mark.parametrize(
    "without",
    [
        pytest.param(("humanoid_gps",), marks=pytest.mark.slow),
        pytest.param(("primitives",), marks=pytest.mark.slow),
        ("primitives", "humanoid_gps"),
    ],
)
def test_an_ablation_is_kept_by_its_file(
    without: tuple[str, ...], episodes: Sequence[RearrangeEpisode], tmp_path: Path
) -> None:
    settings = replace(SMALL, without=without, updates=1)
    train(tmp_path, settings, workers=1, episodes=episodes)
    robot, person = (network_of(f"weights:{tmp_path / n}") for n in (POLICY, "partner_0.npz"))
    assert isinstance(robot, SkillPolicyNetwork)
    assert isinstance(person, SkillPolicyNetwork)
    assert robot.card.primitives == ("primitives" not in without)
    assert ("other_gps_compass" in robot.observations) == ("humanoid_gps" not in without)
    assert person.card.primitives
    assert person.observations == OBSERVATIONS
    assert tuple(robot.card.training["settings"]["without"]) == tuple(sorted(without))
    if not robot.card.primitives:
        assert robot.digest != replace(robot, card=msgspec.structs.replace(robot.card, primitives=True)).digest
    with pytest.raises(InputError, match=r"(?s)without=.*H3-TRAIN-003"):
        train(tmp_path, replace(settings, without=()), workers=1, episodes=episodes, resume=True)
    card = msgspec.structs.replace(robot.card, observations=robot.observations[::-1])
    with pytest.raises(InputError, match=r"(?s)expected some of.*in this order.*H3-POLICY-007"):
        SkillPolicyNetwork(card=card, arrays=robot.arrays)


def test_a_robot_that_sees_is_told_no_state(episodes: Sequence[RearrangeEpisode], tmp_path: Path) -> None:
    """Nor do its masks depend on what the person holds, where objects are, or what is at its goal."""
    settings = replace(SMALL, population="plan_pop_3", pixels=True, updates=1)
    train(tmp_path, settings, workers=1, episodes=episodes)
    robot = network_of(f"weights:{tmp_path / POLICY}")
    assert isinstance(robot, SkillPolicyNetwork)
    assert robot.observations == PIXELS
    assert robot.card.picture_size == settings.picture_size
    for size in (None, (96, 72), (63, 48)):
        with pytest.raises(InputError, match="H3-POLICY-007"):
            replace(robot, card=msgspec.structs.replace(robot.card, picture_size=size))
    seen: list[bool] = []

    class Watching(RecurrentSkillPolicy):
        def choose(self, view: Any, each: Any, rest: Any, scores: Any) -> int:
            held = np.where(view.held_by == view.agent, view.agent, 1 - view.agent)
            changed = view._replace(held_by=held, at_goal=~view.at_goal, objects=view.objects + 1.0)
            again = observed(changed, robot.card)
            assert all(np.array_equal(again[name], self.shown[name]) for name in PIXELS)
            placed = np.array([False, True])
            assert np.array_equal(
                allowed(changed, self.choices, placed=placed), allowed(view, self.choices, placed=placed)
            )
            seen.append(bool(np.ptp(self.shown["arm_depth"])))
            return super().choose(view, each, rest, scores)

    plan = planner("both", 3, 2)
    policies = [AssignedPolicy(Watching(robot), ROBOT, ROBOT), AssignedPolicy(plan, "both", "human", "both")]
    run(WorldRollout.of(Rearrange(), replace(episodes[0], spec=replace(episodes[0].spec, max_steps=200)), policies))
    assert any(seen)


def test_a_robot_that_sees_does_not_go_again_for_what_it_has_placed(episodes: Sequence[RearrangeEpisode]) -> None:
    """It forgets nothing that it has done itself, and is told nothing that the person has done."""
    offered: list[tuple[str, set[int]]] = []

    class Watching(RecurrentSkillPolicy):
        def choose(self, view: Any, each: Any, rest: Any, scores: Any) -> int:
            going = {
                a.target
                for a, s in zip(self.choices, scores, strict=True)
                if a.skill == "nav_to_object" and s > -np.inf
            }
            offered.append((" ".join(np.flatnonzero(view.at_goal).astype(str)), going))
            # the first handling skill that is offered, else the first walk: both objects, one after the other
            order = ["pick", "place", "nav_to_goal", "nav_to_object", "wait"]
            may = [n for n, s in enumerate(scores) if s > -np.inf and self.choices[n].skill in order]
            return min(may, key=lambda n: (order.index(self.choices[n].skill), n))

    robot = Watching(chooser(pixels=True))
    still = AssignedPolicy(planner("still", 3, 2), "still", "human", "still")
    episode = replace(episodes[0], spec=replace(episodes[0].spec, max_steps=1500))
    run(WorldRollout.of(Rearrange(), episode, [AssignedPolicy(robot, ROBOT, ROBOT), still]))
    assert {there for there, _ in offered} >= {"", "0"}
    assert all("0" not in there or 0 not in going for there, going in offered)
    assert any(going == {0, 1} for there, going in offered if not there)


def test_a_lower_temperature_draws_the_best_more_often() -> None:
    network = chooser()
    cold = replace(network, card=msgspec.structs.replace(network.card, temperature=0.1))
    assert cold.digest != network.digest
    scores = np.array([0.0, 1.0, *([-np.inf] * 11)], np.float32)

    def share(of: SkillPolicyNetwork) -> float:
        policy = RecurrentSkillPolicy(of)
        views: list[Any] = [SimpleNamespace(agent=0, step=step) for step in range(200)]
        return float(np.mean([policy.choose(view, scores, scores, scores) == 1 for view in views]))

    assert 0.6 < share(network) < 0.85
    assert share(cold) > 0.99
    with pytest.raises(InputError, match=r"(?s)temperature.*H3-POLICY-007"):
        replace(network, card=msgspec.structs.replace(network.card, temperature=0.0))


def test_files_of_before_still_play(episodes: Sequence[RearrangeEpisode], tmp_path: Path) -> None:
    """Those of version 0.2 are shown less: no paths ahead, no velocity."""
    new = ("path_ahead", "other_path_ahead", "other_velocity")
    network = chooser()
    card = msgspec.structs.replace(
        network.card, observations=tuple(name for name in OBSERVATIONS if name not in new), training={}
    )
    of_object, rest = (
        now - before for now, before in zip(input_lengths(ROBOT), input_lengths(ROBOT, card.observations), strict=True)
    )
    arrays = dict(network.arrays)
    for name, less in {"object.weight": of_object, "gru.weight_ih": rest, "rest_0.weight": rest}.items():
        arrays[name] = arrays[name][:, less:]
    old = SkillPolicyNetwork(card=card, arrays=arrays)
    save_policy(old, tmp_path / "old.npz")
    kept = network_of(f"weights:{tmp_path / 'old.npz'}")
    assert isinstance(kept, SkillPolicyNetwork)
    assert kept.digest == old.digest != network.digest
    played = playing.play_episode(Job(1, 0, "both", {ROBOT: kept}, 0, 0.99), episodes[0])
    assert played.decisions[ROBOT].each.shape[-1] == input_lengths(ROBOT, card.observations)[0]


# --- learning -----------------------------------------------------------------------------------------------------------
def test_rewards_are_told_apart_by_decision_and_lose_nothing() -> None:
    rng = np.random.default_rng(0)
    rewards, steps, gamma = rng.normal(size=50), [0, 0, 7, 7, 8, 30], 0.97
    gains, spans = discounted(rewards, steps, gamma)
    assert spans.tolist() == [0, 7, 0, 1, 22, 20]
    whole = sum(g * gamma**t for g, t in zip(gains, steps, strict=True))
    assert whole == pytest.approx(float(rewards @ gamma ** np.arange(50)))
    assert gains[0] == gains[2] == 0


def fabricated(rng: np.random.Generator, *, wanted: int, network: SkillPolicyNetwork) -> Decisions:
    """An episode of 20 decisions at random, of which one choice pays."""
    agent, count, names = network.card.agent, 20, network.observations
    moments = [shown(agent, rng) for _ in range(count)]
    inputs = [encoded(moment, agent=agent, objects=2, observations=names) for moment in moments]
    pictures, told = np.zeros((count, 0, 0), np.float16), np.zeros((count, 0), np.float32)
    if network.sees:
        pictures = np.array([np.sqrt(moment["arm_depth"][..., 0]) for moment in moments], np.float16)
        told = np.array(
            [np.concatenate([x.ravel() for x in encoded(m, agent=agent, objects=2)]) for m in moments], np.float32
        )
    may = np.ones(8 + rest_count(agent), np.bool_)
    may[3] = False
    state, log_probs, states = network.start(), [], []
    for moment, own in zip(moments, inputs, strict=True):
        states.append(state)
        scores, state = network(*own, state, moment)
        log_probs.append(playing.log_softmax(np.where(may, scores, -np.inf).astype(np.float64)))
    chosen = np.array([int(np.argmax(p + rng.gumbel(size=len(p)))) for p in log_probs])
    return Decisions(
        each=np.array([own[0] for own in inputs]),
        rest=np.array([own[1] for own in inputs]),
        pictures=pictures,
        told=told,
        state=np.array(states),
        allowed=np.tile(may, (count, 1)),
        chosen=chosen,
        log_prob=np.array([p[k] for p, k in zip(log_probs, chosen, strict=True)], np.float32),
        gain=10.0 * (chosen == wanted).astype(np.float32),
        discount=np.append(np.full(count - 1, 0.5), 0).astype(np.float32),
        counts=np.array([count]),
        partners=(SMALL.partners[0],),
    )


def updated(settings: PopulationSettings, *, device: str = "cpu", updates: int = 1) -> ChooserLearner:
    """A robot that has learned from the same five episodes so many times, with its critic alone at first."""
    learner, rng = ChooserLearner(settings, ROBOT, seed=0, device=device), np.random.default_rng(4)
    played = [fabricated(rng, wanted=5, network=learner.network()) for _ in range(5)]
    every = Batch.joined([Batch((), {ROBOT: d}) for d in played]).decisions[ROBOT]
    for update in range(updates):
        learner.update(every, plan_at(settings, 0.0, update), update=update)
    return learner


@pytest.mark.usefixtures("one_torch_thread")
def test_a_minibatch_that_is_not_full_teaches_nothing_else() -> None:
    exact, wider = (updated(replace(SMALL, chunks_per_minibatch=size, critic_updates=0)) for size in (25, 40))
    for name, weight in exact.net.state_dict().items():
        torch.testing.assert_close(wider.net.state_dict()[name], weight, atol=1e-6, rtol=1e-5)


@pytest.mark.usefixtures("one_torch_thread")
def test_at_first_only_the_critic_learns() -> None:
    learner = updated(SMALL)
    fresh = ChooserLearner(SMALL, ROBOT, seed=0)
    moved = {name for name, w in fresh.net.state_dict().items() if not torch.equal(w, learner.net.state_dict()[name])}
    assert moved == {name for name in moved if name.startswith("value_head.")} != set()


@pytest.mark.usefixtures("one_torch_thread")
def test_a_learner_goes_on_from_its_state() -> None:
    whole, part = updated(SMALL, updates=2), updated(SMALL)
    other = ChooserLearner(SMALL, ROBOT, seed=7)
    other.restore(part.state)
    rng = np.random.default_rng(4)
    fresh = ChooserLearner(SMALL, ROBOT, seed=0).network()
    played = [fabricated(rng, wanted=5, network=fresh) for _ in range(5)]
    other.seed = 0  # of its minibatches
    every = Batch.joined([Batch((), {ROBOT: d}) for d in played]).decisions[ROBOT]
    other.update(every, plan_at(SMALL, 0.0, 1), update=1)
    assert all(torch.equal(w, other.net.state_dict()[name]) for name, w in whole.net.state_dict().items())


@pytest.mark.gpu
def test_gradient_steps_as_one_graph_learn_the_same() -> None:
    on_cpu, on_gpu = (updated(SMALL, device=device, updates=3) for device in ("cpu", "cuda"))
    for name, weight in on_cpu.net.state_dict().items():
        torch.testing.assert_close(on_gpu.net.state_dict()[name].cpu(), weight, atol=1e-4, rtol=1e-3)


@given(st.sampled_from(NAMES), st.integers(1, 4096))
def test_partners_take_as_many_gradient_steps_as_the_robot(population: str, worlds: int) -> None:
    settings = PopulationSettings(population=population).in_worlds(worlds)
    partners, whole = len(settings.partners), settings.minibatch_of(ROBOT)
    assert whole == settings.chunks_per_minibatch
    for name in settings.learners[1:]:
        own = settings.minibatch_of(name)
        assert own <= whole
        assert own * partners <= whole or own == min(whole, 12)  # with fewer a gradient is noise
        assert own * (partners + 1) > whole - partners


@pytest.mark.slow
@pytest.mark.parametrize(("name", "pixels"), [(ROBOT, False), ("partner_0", False), (ROBOT, True)])
@pytest.mark.usefixtures("one_torch_thread")
def test_it_learns_what_pays(name: str, pixels: bool) -> None:
    rng, settings = np.random.default_rng(3), replace(SMALL, epochs=4, rate=1e-2, kl_most=0.3, pixels=pixels)
    learner = ChooserLearner(settings, name, seed=0)
    shares = []
    for update in range(10):
        network = learner.network()
        played = [fabricated(rng, wanted=5, network=network) for _ in range(4)]
        assert not any((d.chosen == 3).any() for d in played)
        shares.append(np.mean([(d.chosen == 5).mean() for d in played]))
        every = Batch.joined([Batch((), {name: d}) for d in played]).decisions[name]
        row = learner.update(every, plan_at(settings, update / 10, update), update=update)
        assert np.isfinite(list(row.values())).all()
    assert np.mean(shares[-2:]) > shares[0] + 0.3


def test_advantages_reach_over_decisions_of_any_length() -> None:
    rng, counts = np.random.default_rng(3), np.array([7, 1, 20, 16])
    ends = counts.cumsum()
    gain, value = (torch.tensor(rng.normal(size=ends[-1]).astype(np.float32)) for _ in range(2))
    discount = torch.tensor(rng.uniform(0.3, 1.0, ends[-1]).astype(np.float32))
    discount[ends - 1] = 0.0
    found = {lam: learning.advantages(gain, discount, value, torch.tensor(counts), lam=lam) for lam in (0.0, 0.9, 1.0)}
    after, estimate = 0.0, 0.0
    for k in reversed(range(ends[-1])):
        follows = float(value[k + 1]) if k + 1 < ends[-1] else 0.0
        wrong = float(gain[k]) + float(discount[k]) * follows - float(value[k])
        after, estimate = float(gain[k] + discount[k] * after), wrong + 0.9 * float(discount[k]) * estimate
        expected = {0.0: wrong, 0.9: estimate, 1.0: after - float(value[k])}
        assert {lam: float(a[k]) for lam, a in found.items()} == pytest.approx(expected, abs=1e-4)


@given(st.lists(st.integers(1, 40), min_size=1, max_size=9), st.integers(1, 20))
def test_chunks_hold_every_decision_once_and_none_of_two_episodes(counts: list[int], length: int) -> None:
    at, valid = learning.chunks_of(torch.tensor(counts), length)
    assert sorted(at[valid].tolist()) == list(range(sum(counts)))
    assert at.shape == (length, sum(-(-count // length) for count in counts))
    episode = np.repeat(np.arange(len(counts)), counts)[at.numpy()]
    assert (episode == episode[0]).all()
    assert (np.diff(at.numpy(), axis=0)[valid[1:].numpy()] == 1).all()
    assert valid[0].all()


# --- runs ---------------------------------------------------------------------------------------------------------------
def test_a_run_leaves_policies_that_play(whole: Path, episodes: Sequence[RearrangeEpisode]) -> None:
    curve = curve_of(whole)
    assert [row["episodes"] for row in curve] == [3, 6, 9]
    assert curve[-1]["steps"] == pytest.approx(9 * 90)
    robot, person = (network_of(f"weights:{whole / n}") for n in (POLICY, "partner_0.npz"))
    assert isinstance(robot, SkillPolicyNetwork)
    assert isinstance(person, SkillPolicyNetwork)
    assert (robot.card.agent, person.card.agent, robot.card.objects) == ("robot", "human", 2)
    assert robot.card.training["population"] == "learn_single"
    assert not same(dict(robot.arrays), dict(chooser().arrays))
    assert learned_chooser(f"weights:{whole / POLICY}", "rearrange", 2, robot=True)
    assert learned_chooser(f"weights:{whole / 'partner_0.npz'}", "rearrange", 2, robot=False)
    task, plays = find_task("rearrange"), []
    for _ in range(2):
        named = {"robot": f"weights:{whole / POLICY}", "human": f"weights:{whole / 'partner_0.npz'}"}
        play = WorldRollout.of(task, episodes[1], named)
        run(play)
        play.team.finish()
        plays.append([(s.agent, s.name, s.target, s.end_step) for s in play.spans])
    assert plays[0] == plays[1]
    assert plays[0]


def test_it_comes_to_the_same_weights_interrupted_and_on_more_workers(
    whole: Path, episodes: Sequence[RearrangeEpisode], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def stop_in_the_second(*args: Any) -> Any:
        asked.append(args)
        if len(asked) == 2:
            os.kill(os.getpid(), signal.SIGTERM)
        return plan_at(*args)

    monkeypatch.setattr(runs, "plan_at", stop_in_the_second)
    first = train(tmp_path, SMALL, workers=2, episodes=episodes)
    assert not first.done
    assert first.updates == 2
    monkeypatch.setattr(runs, "plan_at", plan_at)
    assert train(tmp_path, SMALL, workers=1, episodes=episodes, resume=True).done
    for name in (POLICY, "partner_0.npz"):
        assert same(arrays(tmp_path, name), arrays(whole, name))
    drop = ("seconds", "playing_share", "steps_per_s")
    for a, b in zip(curve_of(tmp_path), curve_of(whole), strict=True):
        assert {k: v for k, v in a.items() if k not in drop} == {k: v for k, v in b.items() if k not in drop}
    with pytest.raises(InputError, match=r"(?s)3.*Hint.*--updates.*H3-TRAIN-001"):
        train(tmp_path, SMALL, workers=1, episodes=episodes, resume=True)


def test_other_settings_and_damaged_checkpoints_are_refused(
    whole: Path, episodes: Sequence[RearrangeEpisode], tmp_path: Path
) -> None:
    for changes, seed, message in (
        ({"population": "learn_pop"}, 0, r"(?s)population='learn_single', not 'learn_pop'.*H3-TRAIN-003"),
        ({"updates": 9}, 1, r"(?s)seed=0.*H3-TRAIN-003"),
    ):
        with pytest.raises(InputError, match=message):
            train(whole, replace(SMALL, **changes), seed=seed, workers=1, episodes=episodes, resume=True)
    content = (whole / CHECKPOINT).read_bytes()
    for damaged in (content[: len(content) // 2], b"", b"what"):
        (tmp_path / CHECKPOINT).write_bytes(damaged)
        with pytest.raises(FormatError, match="H3-TRAIN-006"):
            train(tmp_path, SMALL, workers=1, episodes=episodes, resume=True)


def jobs(count: int) -> list[Job]:
    networks = {ROBOT: chooser(population="plan_pop_1")}
    return [Job(n, n % 2, "object_1", networks, 0, 0.99) for n in range(count)]


@pytest.mark.slow
def test_a_lost_process_costs_nothing(
    episodes: Sequence[RearrangeEpisode], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected, wanted = Players(episodes, 1).play(jobs(4))
    once, play_episode = tmp_path / "once", playing.play_episode

    def dies_once(job: Job, episode: RearrangeEpisode) -> Any:  # forked processes have it too
        if job.number == 2 and not once.exists():
            once.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return play_episode(job, episode)

    monkeypatch.setattr(playing, "play_episode", dies_once)
    said: list[str] = []
    players = Players(episodes, 2, say=said.append)
    found, decisions = players.play(jobs(4))
    players.close()
    assert once.exists()
    assert any("played again" in line for line in said)
    assert found == expected
    np.testing.assert_array_equal(decisions[ROBOT].chosen, wanted[ROBOT].chosen)


def test_processes_that_die_again_and_again_end_the_run(
    episodes: Sequence[RearrangeEpisode], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(playing, "play_episode", lambda job, episode: os.kill(os.getpid(), signal.SIGKILL))
    players = Players(episodes, 2)
    with pytest.raises(H3DataError, match=r"(?s)3.*H3-TRAIN-024") as caught:
        players.play(jobs(2))
    assert "\n" not in str(caught.value)


def test_an_episode_that_raises_is_left_out(
    episodes: Sequence[RearrangeEpisode], monkeypatch: pytest.MonkeyPatch
) -> None:
    play_episode = playing.play_episode

    def raises(job: Job, episode: RearrangeEpisode) -> Any:
        if job.number in raising:
            raise ValueError("no such luck")
        return play_episode(job, episode)

    monkeypatch.setattr(playing, "play_episode", raises)
    said: list[str] = []
    players, raising = Players(episodes, 1, say=said.append), {1}
    assert len(players.play(jobs(3)).played) == 2
    assert said == ["left out episode 1: ValueError: no such luck"]
    raising = {0, 1, 2}
    with pytest.raises(H3DataError, match="H3-TRAIN-023"):
        players.play(jobs(3))


# --- files and options ----------------------------------------------------------------------------------------------------
def test_files_that_do_not_fit_are_refused(
    tmp_path: Path, episodes: Sequence[RearrangeEpisode], capsys: pytest.CaptureFixture[str]
) -> None:
    robot, person = tmp_path / "robot.npz", tmp_path / "person.npz"
    save_policy(chooser(), robot)
    save_policy(chooser("partner_0"), person)
    task = find_task("rearrange")
    spec = task.Spec()
    resolve_policy(task, "robot", f"weights:{robot}", spec)
    resolve_policy(task, "human", f"weights:{person}", spec)
    for kind, file, rules, message in (
        ("robot", f"weights:{person}", spec, "(?s)for a robot, these are for a human.*H3-POLICY-009"),
        ("human", f"weights:{robot}", spec, "(?s)for a human, these are for a robot.*H3-POLICY-009"),
        ("robot", f"weights:{robot}", replace(spec, objects=3), "(?s)know 2 objects, the episode has 3.*H3-POLICY-010"),
        ("robot", "end_to_end", spec, "(?s)for the task rearrange, these are for 'social_nav'.*H3-POLICY-016"),
    ):
        with pytest.raises(FormatError, match=message):
            resolve_policy(task, kind, file, rules)
    with pytest.raises(FormatError, match=r"(?s)social_nav.*'rearrange'.*H3-POLICY-016"):
        resolve_policy(find_task("social_nav"), "robot", f"weights:{robot}", find_task("social_nav").Spec())
    with pytest.raises(FormatError, match=r"(?s)quad_arm.*wheeled.*H3-POLICY-011"):
        RecurrentSkillPolicy(chooser()).require_body("wheeled")
    broken = tmp_path / "broken.npz"
    network = chooser()
    for content, message in (
        (robot.read_bytes()[:500], "H3-POLICY-030"),
        (_file(tmp_path, network, persist=np.array([np.nan], np.float32)), "(?s)not finite.*H3-POLICY-007"),
        (_file(tmp_path, network, persist=np.zeros(2, np.float32)), "(?s)has the shape.*H3-POLICY-007"),
        (_file(tmp_path, network, without="gru.bias_ih"), "(?s)bias_ih is missing.*H3-POLICY-007"),
        (_file(tmp_path, network, extra=np.zeros(2, np.float32)), "(?s)unknown array extra.*H3-POLICY-007"),
    ):
        broken.write_bytes(content)
        os.utime(broken, ns=(0, hash(message) % 10**15))
        with pytest.raises(FormatError, match=message):
            resolve_policy(task, "robot", f"weights:{broken}", spec)
    options = ["generate", "rearrange", "--scenes", "small:1", "--episodes", "1", "--policy", f"weights:{person}"]
    assert main([*options, "-o", str(tmp_path / "ds")]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def _file(folder: Path, network: SkillPolicyNetwork, *, without: str = "", **changes: np.ndarray) -> bytes:
    """A policy file with other arrays."""
    path = folder / "other.npz"
    save_policy(network, path)
    with np.load(path) as file:
        data = {n: file[n] for n in file.files if n != without} | changes
    np.savez(path, **data)  # type: ignore[arg-type]
    return path.read_bytes()


def test_a_zero_shot_population_may_hold_files(tmp_path: Path) -> None:
    file = tmp_path / "person.npz"
    save_policy(chooser("partner_0"), file)
    request = EvaluationRequest(
        task="rearrange", partners=("both", f"weights:{file}"), unseen_partners=("both", f"weights:{file}")
    )
    assert request.population == request.jobs()[0].partners
    assert "@" in request.population[1]


def test_trained_policies_come_with_the_package() -> None:
    for names, agent in ((SHIPPED_HELPERS, "robot"), (SHIPPED_PARTNERS, "human")):
        cards = {}
        for name in names:
            network = network_of(name)
            assert isinstance(network, SkillPolicyNetwork)
            cards[name] = network.card
            assert network.card.agent == agent
            assert name.startswith(network.card.training["population"])
        assert len({network_of(name).digest for name in names}) == len(names)
    seeds = [network_of(f"learn_single_partner_{k}").card.training["seed"] for k in range(3)]  # type: ignore[union-attr]
    assert len(set(seeds)) == 3
    task = find_task("rearrange")
    assert set(SHIPPED_HELPERS) < set(task.policies["robot"])
    assert set(ZSC_TEN) < set(task.policies["human"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"population": "plan_pop_5"}, r"(?s)Did you mean 'plan_pop_.*H3-TRAIN-034"),
        ({"walk": "moon"}, "H3-TRAIN-035"),
        ({"without": ("gps",)}, r"(?s)'gps'.*H3-TRAIN-036"),
        ({"episodes": 0}, r"(?s)episodes.*1.*H3-TRAIN-039"),
        ({"horizon": 1.0}, "H3-TRAIN-037"),
        ({"minutes": 0.0}, "H3-TRAIN-038"),
        ({"picture_size": (63, 48)}, "H3-TRAIN-080"),
    ],
)
def test_settings_out_of_range_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        SMALL.changed(**changes)


def test_the_command_plans_and_refuses(tmp_path: Path, whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["-o", str(tmp_path / "n")]
    assert main(["train", "rearrange", "--population", "learn_pop", "--updates", "10", "--dry-run", *out]) == 0
    text = capsys.readouterr().out
    assert "9 learners" in text
    assert "10 updates" in text
    assert not (tmp_path / "n").exists()
    for options, message in (
        (
            ["rearrange", "--action-repeat", "3", "--gpus", "2"],
            "no options of rearrange: --action-repeat (of social_nav, skill and crowd_nav), --gpus",
        ),
        (["rearrange", "--recipe", "fast"], "Unknown recipe 'fast' of rearrange. Expected one of: paper; or none"),
        (["rearrange", "--population", "plan_pop"], "Did you mean"),
        (["rearrange", "--workers", "0"], "at least 1 worker"),
        (["rearrange", "--episodes-per-update", "0"], "H3-TRAIN-079"),
        (["social_nav", "--population", "learn_pop"], "--population"),
        (["skill", "nav", "--ablate", "primitives"], "no options of skill: --ablate (of rearrange)"),
        (["rearrange", "--ablate", "legs"], "humanoid_gps"),
        (["wander"], "H3-TRAIN-013"),
    ):
        assert main(["train", *options, *out]) == 2
        assert message in capsys.readouterr().err
    assert main(["train", "rearrange", "-o", str(whole)]) == 2
    assert "holds a training run" in capsys.readouterr().err


def test_the_published_settings(
    episodes: Sequence[RearrangeEpisode], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Habitat 3.0, appendix on social rearrangement: 100 M steps, 96 environments of 128 steps, two minibatches, one epoch."""

    def planned(*options: str) -> dict[str, Any]:
        command = [
            "train",
            "rearrange",
            "--recipe",
            "paper",
            *options,
            "--dry-run",
            "--json",
            "-o",
            str(tmp_path / "n"),
        ]
        assert main(command) == 0
        return json.loads(capsys.readouterr().out)

    plan = planned("--population", "learn_pop")
    assert plan["steps"] == pytest.approx(100e6, rel=0.01)
    assert plan["steps"] / plan["updates"] == pytest.approx(96 * 128, rel=0.03)
    found = plan["settings"]
    assert (found["walk"], found["hidden"], found["epochs"], found["gradient_norm"]) == ("paper", 512, 1, 0.2)
    assert (found["rate"] * found["rate_end"], found["entropy"] * found["entropy_end"]) == (2.5e-4, 1e-4)
    assert (1 - 1 / found["horizon"]) ** found["think_steps"] == pytest.approx(0.99, abs=1e-4)
    assert planned("--worlds", "40")["settings"]["chunks_per_minibatch"] == 20
    assert planned("--minutes", "5")["settings"]["updates"] == 0
    small = rearrange_recipe("paper", population="plan_pop_1", updates=1, hidden=32, width=32)
    (tmp_path / "run").mkdir()
    result = train(tmp_path / "run", small, workers=1, episodes=episodes)
    assert result.last["gradient_steps"] == 2


def test_a_critic_is_told_who_the_partner_is() -> None:
    settings = replace(SMALL, population="plan_pop_3")
    net = Chooser(settings, agent=ROBOT, objects=2)
    of_object, rest = input_lengths(ROBOT)
    assert net.value_head[0].in_features == 2 * of_object + rest + 3
    assert not any(name.startswith("value_head") for name in net.arrays())
