"""Rearrangement on a device: the episodes of the CPU under the same rules, step by step, and the environment's manners."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("shapely")
pytest.importorskip("fcl")

from torch.utils._python_dispatch import TorchDispatchMode  # noqa: E402

import h3data  # noqa: E402
from h3data.errors import InputError  # noqa: E402
from h3data_training.torch.graph import fused  # noqa: E402
from h3data_training.torch.rearrange.bank import RearrangeBank  # noqa: E402
from h3data_training.torch.rearrange.observations import OBSERVED, View, observed  # noqa: E402
from h3data_training.torch.rearrange.state import DONE, FAILED, FREE, Play  # noqa: E402
from h3data_training.torch.rearrange.worlds import RearrangeTensors  # noqa: E402
from sim_kinematic.agents.skills import Action, choices  # noqa: E402
from sim_kinematic.motion.spec import HOME_BASE, NATURAL_WALKER, OracleSpec  # noqa: E402
from sim_kinematic.policies.assignment import assign  # noqa: E402
from sim_kinematic.policies.choosers.chooser_network import OBSERVATIONS  # noqa: E402
from sim_kinematic.policies.policy import External  # noqa: E402
from sim_kinematic.tasks.play import DecisionLoop, WorldRollout  # noqa: E402
from sim_kinematic.tasks.rearrange.episode import ORACLE_RULES, RearrangeEpisode, RearrangeSpec  # noqa: E402
from sim_kinematic.tasks.rearrange.task import Rearrange  # noqa: E402
from sim_kinematic.tasks.sources import EpisodeSource  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")
HOMES = ["h3-homes/val#0", "h3-homes/val#1"]
KINDS = ("robot", "human")
QUICK = OracleSpec(robot_steps=(3, 5), person_steps=(4, 6))
"""Hands faster than ours, so that much happens in few steps."""


def drawn(count: int, *, seed: int = 3, homes: Sequence[str] = HOMES, **rules: Any) -> list[RearrangeEpisode]:
    source = EpisodeSource(Rearrange(), list(homes), spec=ORACLE_RULES)
    spec = replace(ORACLE_RULES, **rules)
    found = [source.sample(seed, k) for k in range(count)]
    return [replace(one, spec=spec) for one in found if isinstance(one, RearrangeEpisode)]


@pytest.fixture(scope="module")
def episodes() -> list[RearrangeEpisode]:
    return drawn(6, oracle=QUICK, max_steps=330)


@pytest.fixture(scope="module")
def bank(episodes: list[RearrangeEpisode]) -> RearrangeBank:
    return RearrangeBank.of(episodes)


def test_banks_of_homes_are_the_bank_of_all(episodes: list[RearrangeEpisode]) -> None:
    of_home: dict[int, list[RearrangeEpisode]] = {}
    for episode in episodes:
        of_home.setdefault(id(episode.free), []).append(episode)
    assert len(of_home) > 1
    found = RearrangeBank.merged([RearrangeBank.of(own) for own in of_home.values()])
    wanted = RearrangeBank.of([episode for own in of_home.values() for episode in own])
    for field in fields(RearrangeBank):
        mine, theirs = getattr(found, field.name), getattr(wanted, field.name)
        if isinstance(mine, np.ndarray):
            assert mine.dtype == theirs.dtype
            np.testing.assert_array_equal(mine, theirs, err_msg=field.name)
        elif field.name not in ("floors", "scenes"):
            assert mine == theirs
    assert [(id(a), id(b)) for a, b in zip(found.floors, found.scenes, strict=True)] == [
        (id(a), id(b)) for a, b in zip(wanted.floors, wanted.scenes, strict=True)
    ]


class Pair:
    """Worlds on the device beside plays of the same episodes on the CPU."""

    def __init__(
        self,
        episodes: Sequence[RearrangeEpisode],
        *,
        outside: Sequence[str],
        partner: str = "plan_pop_4",
        task: Rearrange | None = None,
    ) -> None:
        task = task or Rearrange()
        self.bank = RearrangeBank.of(episodes, task=task)
        planners = set(KINDS) - set(outside)
        self.sim = RearrangeTensors(self.bank, task=task, device="cpu", planners=planners, partner=partner)
        self.state: Play = self.sim.start(self.sim.before_the_first(torch.arange(len(episodes)) - 1))
        chosen = {kind: External() if kind in outside else partner for kind in KINDS}
        self.plays = [WorldRollout.of(task, e, assign(task, e, chosen)) for e in episodes]
        self.turns = [DecisionLoop(play) for play in self.plays]
        self.seen: Counter[str] = Counter()

    def does(self, kind: str) -> Any:
        return self.state.robot_does if kind == "robot" else self.state.human_does

    def random(self, rng: np.random.Generator) -> np.ndarray:
        """Choices [W, 2] that hands allow: mostly the next step of an errand, sometimes another one on the way."""
        found = np.full((len(self.plays), 2), FREE)
        for n, play in enumerate(self.plays):
            for agent, kind in enumerate(KINDS):
                does, known = self.does(kind), play.team.choices(agent)
                skill, last, outcome = (int(t[n]) for t in (does.skill, does.last, does.outcome))
                if skill != FREE and rng.random() > 0.03:
                    continue
                may = [c for c, action in enumerate(known) if not play.team.objects.why_not(agent, action)]
                weights = np.array([1.0 if known[c].target < 0 else 6.0 for c in may])
                found[n, agent] = rng.choice(may, p=weights / weights.sum())
                # as many choices further on, what can be done where the agent has gone
                after = last + (4 if last < 4 else len(play.team.parts))
                if outcome == DONE and known[last].skill.startswith("nav") and after in may and rng.random() < 0.9:
                    found[n, agent] = after
        return found

    def step(self, chosen: np.ndarray, on_view: Any = None) -> None:
        self.state = self.sim.step(self.state, *(torch.tensor(chosen[:, k]) for k in range(2)))
        at_goal = self.sim.at_goal(View.of(self.sim, self.state, "robot").hands, self.sim.tables.at(self.state.episode))
        for n, (play, turns) in enumerate(zip(self.plays, self.turns, strict=True)):
            if turns.over:
                continue
            while turns.asked is not None:
                agent = turns.asked
                policy, known = play.policies[agent].policy, play.team.choices(agent)
                running = play.team.controllers[agent]
                if not isinstance(policy, External):
                    turns.answer(policy.act(play.view(agent)))
                elif chosen[n, agent] != FREE:
                    turns.answer(known[chosen[n, agent]])
                else:  # it goes on, or waits
                    turns.answer(running.action if running.skill is not None else known[8])
            self.compare(n, play, at_goal[n])
            if on_view is not None:
                on_view(n, play)
            turns.go_on()
            assert bool(self.state.ended[n]) == turns.over
            if turns.over:
                assert bool(self.state.success[n]) == (play.ended == "success")
                self.seen[play.ended] += 1

    def compare(self, n: int, play: WorldRollout, at_goal: Any) -> None:
        state = self.state
        for actor, own in zip(play.team.actors, (state.robot, state.human), strict=True):
            np.testing.assert_allclose(own.xz[n], actor.xz, rtol=0, atol=1e-9)
            turned = np.exp(1j * (float(own.heading[n]) - actor.heading))
            np.testing.assert_allclose(turned, 1.0, rtol=0, atol=1e-9)
        np.testing.assert_allclose(state.objects[n], play.team.objects.poses[:, :3], rtol=0, atol=1e-9)
        np.testing.assert_array_equal(state.held_by[n], play.team.objects.held_by)
        np.testing.assert_array_equal(at_goal, play.team.at_goal)
        assert bool(state.collides[n]) == bool(play.world.touching.any())
        assert float(state.reward[n]) == pytest.approx(play.reward, abs=1e-12)
        for agent, kind in enumerate(KINDS):
            action, last = play.team.controllers[agent].action, int(self.does(kind).last[n])
            assert play.team.choices(agent)[last][:2] == action[:2]
        np.testing.assert_array_equal(state.opened[n], play.open_parts[0])
        for name, values in state.memory.items():
            np.testing.assert_array_equal(values[n], play.memory[name][0])
        self.seen["picked"] += int((play.team.objects.held_by >= 0).any())


def count_spans(pair: Pair) -> Counter[str]:
    found: Counter[str] = Counter()
    for play in pair.plays:
        play.team.finish()
        found.update(f"{span.outcome} {span.reason}".strip() for span in play.spans)
        found.update(f"{span.name} {span.outcome}" for span in play.spans)
    return found


# --- against the CPU ----------------------------------------------------------------------------------------------------
@pytest.mark.slow  # quick: what agents are shown; training/test_population_worlds.py
def test_the_same_choices_give_the_episodes_of_the_cpu(episodes: list[RearrangeEpisode]) -> None:
    pair, rng = Pair(episodes, outside=KINDS), np.random.default_rng(1)
    while not all(turns.over for turns in pair.turns):
        pair.step(pair.random(rng))
    spans = count_spans(pair)
    assert pair.seen["collision"] >= 2
    assert pair.seen["picked"] > 100
    for what in (
        "pick done",
        "place done",
        "nav_to_object done",
        "nav_to_goal done",
        "aborted agents_close",
        "failed out_of_reach",
    ):
        assert spans[what], f"nothing was ever: {what}"


@pytest.mark.slow  # quick: the same choices
def test_planners_are_those_of_the_cpu(episodes: list[RearrangeEpisode]) -> None:
    through = [replace(e, spec=replace(e.spec, end_on_collision=False, max_steps=280)) for e in episodes]
    ended, spans = Counter[str](), Counter[str]()
    for outside in (("robot",), ("human",)):
        pair, rng = Pair(through[:5], outside=outside, partner="both"), np.random.default_rng(2)
        while not all(turns.over for turns in pair.turns):
            pair.step(pair.random(rng))
        spans, ended = spans + count_spans(pair), ended + pair.seen
    assert spans["place done"] >= 10
    assert ended["success"] >= 1
    assert ended["max_steps"] >= 1


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_long_episodes_in_many_homes_are_those_of_the_cpu(seed: int) -> None:
    homes = [f"h3-homes/train#{k}" for k in range(3 * seed, 3 * seed + 3)]
    through = drawn(8, seed=seed, homes=homes, end_on_collision=False)
    for outside, partner in ((KINDS, "still"), (("robot",), "plan_pop_3"), ((), "plan_pop_4")):
        pair, rng = Pair(through, outside=outside, partner=partner), np.random.default_rng(seed)
        while not all(turns.over for turns in pair.turns):
            pair.step(pair.random(rng))
        assert sum(pair.seen[ended] for ended in ("success", "max_steps")) == len(through)


def test_the_ends_of_skills_are_shown() -> None:
    (episode,) = drawn(1, oracle=QUICK)
    pair = Pair([episode], outside=KINDS)
    wait, there = np.array([[8, 8]]), np.array([[0, 8]])
    pair.step(np.array([[4, 1]]))  # what is out of reach cannot be picked
    shown = observed(View.of(pair.sim, pair.state, "robot"), ("last_failed", "last_done"))
    assert shown["last_failed"][0].nonzero().tolist() == [[4]]
    pair.step(there)
    while int(pair.state.robot_does.skill[0]) != FREE:
        assert not observed(View.of(pair.sim, pair.state, "robot"), ("last_done",))["last_done"].any()
        pair.step(wait * 0 - 1)
    assert observed(View.of(pair.sim, pair.state, "robot"), ("last_done",))["last_done"][0].nonzero().tolist() == [[0]]


@pytest.mark.slow
def test_float32_plays_nearly_the_same(episodes: list[RearrangeEpisode], bank: RearrangeBank) -> None:
    sims = [
        RearrangeTensors(bank, device="cpu", dtype=t, planners=KINDS, partner="both")
        for t in (torch.float64, torch.float32)
    ]
    a, b = (sim.start(sim.before_the_first(torch.arange(len(bank)) - 1)) for sim in sims)
    nothing = torch.full((len(bank),), FREE)
    for _ in range(150):
        a, b = (sim.step(s, nothing, nothing) for sim, s in zip(sims, (a, b), strict=True))
        assert b.robot.xz.dtype == b.reward.dtype == b.objects.dtype == torch.float32
    apart = (a.robot.xz - b.robot.xz).abs().amax(1)
    assert (apart < 0.01).double().mean() > 0.6  # a step sooner or later at a corner parts two tracks
    assert torch.equal(a.held_by, b.held_by)


# --- the next episode ---------------------------------------------------------------------------------------------------
def test_a_world_that_is_over_begins_its_next_episode(episodes: list[RearrangeEpisode]) -> None:
    bank = RearrangeBank.of([replace(e, spec=replace(e.spec, max_steps=60)) for e in episodes])
    sim = RearrangeTensors(bank, device="cpu", partner="still")
    first, nothing = torch.arange(len(bank)) - 1, torch.full((len(bank),), FREE)
    play = sim.start(sim.before_the_first(first))
    short = int(bank.spec.max_steps)
    for step in range(1, short + 1):
        play = sim.step(play, nothing, nothing)
        assert torch.equal(play.steps, torch.full_like(nothing, step))
    assert play.truncated.all()
    assert not play.terminated.any()
    play = sim.step(play, torch.zeros_like(nothing), nothing)
    assert torch.equal(play.episode, (torch.arange(len(bank)) + 1) % len(bank))
    for column in (play.steps, play.reward, play.ended, play.paid):
        assert not column.any()
    fresh = sim.start(sim.before_the_first(torch.arange(len(bank))))
    for mine, new in zip(play.tensors(), fresh.tensors(), strict=True):
        assert torch.equal(mine, new)


@pytest.mark.slow
def test_worlds_without_repeats_stay_as_they_ended(bank: RearrangeBank) -> None:
    sim = RearrangeTensors(bank, device="cpu", planners=KINDS, partner="both", repeats=False)
    nothing = torch.full((len(bank),), FREE)
    play = sim.start(sim.before_the_first(torch.arange(len(bank)) - 1))
    kept: dict[int, Any] = {}
    for _ in range(200):
        play = sim.step(play, nothing, nothing)
        for n in play.ended.nonzero()[:, 0].tolist():
            now = (int(play.steps[n]), play.robot.xz[n].tolist(), play.objects[n].tolist())
            assert kept.setdefault(n, now) == now
    assert kept
    assert not play.reward[list(kept)].any()


def test_every_partner_has_the_plan_of_the_cpu(episodes: list[RearrangeEpisode], bank: RearrangeBank) -> None:
    from sim_kinematic.policies.rearrange import PARTNERS, partner_policy

    for name in PARTNERS:
        mine = [[k for k in row if k >= 0] for row in bank.orders(name).tolist()]
        assert mine == [list(partner_policy(name, e.seed, 2).objects) for e in episodes]  # type: ignore[attr-defined]
    with pytest.raises(InputError, match="H3-POLICY-039"):
        bank.orders("nobody")


# --- the environment ----------------------------------------------------------------------------------------------------
def env_of(bank: RearrangeBank, worlds: int = 5, **options: Any) -> Any:
    return h3data.make("rearrange", num_envs=worlds, device="cpu", episodes=bank, **options)


def test_runs_repeat_and_differ_by_seed(bank: RearrangeBank) -> None:
    def played(seed: int) -> Any:
        env, rng = env_of(bank), np.random.default_rng(0)
        shown, _ = env.reset(seed=seed)
        rows = [shown]
        rows += [env.step(torch.tensor(rng.integers(0, 13, 5)))[0] for _ in range(20)]
        return torch.cat([row["obj_gps_compass"] for row in rows])

    assert torch.equal(played(4), played(4))
    assert not torch.equal(played(4), played(5))


def test_both_learn_and_info_says_who_chooses(bank: RearrangeBank) -> None:
    env = env_of(bank, agents=("robot", "human"), observations=OBSERVATIONS)
    shown, info = env.reset(seed=1)
    assert set(shown) == {"robot", "human"}
    assert set(shown["human"]) == set(OBSERVATIONS)
    assert shown["robot"]["last_done"].shape == (5, 13)
    assert shown["human"]["last_done"].shape == (5, 9)
    assert info["robot_choosing"].all()
    assert info["human_action_mask"].shape == (5, 9)
    _, reward, terminated, truncated, info = env.step({"robot": torch.zeros(5).long(), "human": torch.ones(5).long()})
    assert reward.dtype == torch.float32
    assert not terminated.any()
    assert not truncated.any()
    assert not info["robot_choosing"].all()
    assert torch.equal(info["robot_last"], torch.zeros(5).long())
    assert "robot quad_arm and human female_0" in repr(env)


def test_what_is_handed_out_is_not_overwritten(bank: RearrangeBank) -> None:
    env = env_of(bank)
    shown, info = env.reset(seed=1)
    before = {name: t.clone() for name, t in {**shown, **info}.items()}
    for _ in range(30):
        env.step(torch.zeros(5).long())
    for name, tensor in {**shown, **info}.items():
        assert torch.equal(tensor, before[name]), name


def test_spaces(bank: RearrangeBank) -> None:
    pytest.importorskip("gymnasium")
    env = env_of(bank, observations=("obj_gps_compass", "close"))
    shown, _ = env.reset(seed=0)
    assert env.action_space.nvec.tolist() == [13] * 5
    assert {name: space.shape for name, space in env.observation_space.items()} == {
        n: t.shape for n, t in shown.items()
    }
    for row in range(5):
        assert env.single_observation_space.contains({name: t[row].numpy() for name, t in shown.items()})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"partner": "complement"}, r"(?s)'complement'.*H3-ENV-004"),
        ({"partner": "plan_pop_5"}, r"(?s)Did you mean 'plan_pop_4'.*plan_pop_1.*H3-ENV-004"),
        ({"agents": ("dog",)}, "H3-ENV-002"),
        ({"agents": ("robot", "human"), "partner": "both"}, "H3-ENV-003"),
        ({"observations": ("arm_depth",)}, "H3-TRAIN-068"),
        ({"observations": ()}, "H3-TRAIN-068"),
        ({"worlds": 0}, "H3-ENV-015"),
        ({"spec": RearrangeSpec()}, "H3-ENV-006"),
    ],
)
def test_bad_options(bank: RearrangeBank, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        env_of(bank, **options)


def test_bad_actions(bank: RearrangeBank) -> None:
    env = env_of(bank)
    with pytest.raises(InputError, match="H3-ENV-016"):
        env.step(torch.zeros(5).long())
    env.reset(seed=0)
    for bad in (torch.zeros(4).long(), torch.zeros(5), torch.zeros(5, 1).long()):
        with pytest.raises(InputError, match="H3-ENV-007"):
            env.step(bad)
    with pytest.raises(InputError, match=r"(?s)human.*H3-ENV-005"):
        env.step({"human": torch.zeros(5).long()})
    with pytest.raises(InputError, match=r"(?s)rearrange.*robot.*ndarray.*H3-ENV-058"):
        env.step(np.zeros(5, np.int64))
    env.step(torch.tensor([99, -7, 12, 0, 8]))  # refused they would have to wait for the device
    assert env.info()["last"].tolist() == [12, 8, 12, 0, 8]


def test_other_rules_are_refused(episodes: list[RearrangeEpisode]) -> None:
    for rules, message in (
        ({"oracle": None}, "H3-TRAIN-061"),
        ({"human": NATURAL_WALKER}, r"(?s)stride.*WalkerSpec.*H3-ENV-034"),
        ({"arm_rad_s": 8.0}, r"(?s)arm_rad_s.*RearrangeSpec.*inf.*H3-ENV-034"),
        ({"robot": replace(HOME_BASE, slide="habitat")}, r"(?s)slide.*BaseSpec.*'strict'.*H3-ENV-034"),
    ):
        with pytest.raises(InputError, match=message):
            RearrangeBank.of([replace(e, spec=replace(e.spec, **rules)) for e in episodes])
    with pytest.raises(InputError, match="H3-TRAIN-063"):
        RearrangeBank.of([episodes[0].played_by("robot,robot")])
    with pytest.raises(InputError, match="H3-TRAIN-060"):
        RearrangeBank.draw(HOMES, 0)


# --- what a CUDA graph needs --------------------------------------------------------------------------------------------
class Graphable(TorchDispatchMode):
    """Refuses what would wait for a device, or would give a tensor whose size depends on values."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        assert name not in {"_local_scalar_dense", "nonzero", "masked_select", "unique", "item", "is_nonzero"}, name
        if name in ("index", "index_put", "index_put_"):
            assert all(i is None or i.dtype != torch.bool for i in args[1]), "an index is a mask"
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("agents", [("robot",), ("human",), KINDS])
def test_a_step_waits_for_nothing_and_works_in_place(bank: RearrangeBank, agents: tuple[str, ...]) -> None:
    env = env_of(bank, agents=agents, observations=tuple(OBSERVED), dtype=torch.float32)
    env.reset(seed=0)
    places = [t.data_ptr() for t in env.play.tensors()]
    assert len(set(places)) == len(places)
    with torch.no_grad(), Graphable():
        for _ in range(3):
            env._eager()
    assert [t.data_ptr() for t in env.play.tensors()] == places
    assert int(env.play.steps[0]) == 3
    kinds = {t.dtype for t in env.play.tensors()}
    assert kinds == {torch.float32, torch.int64, torch.bool}


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed, so nothing is compiled for the CPU")
def test_fused_steps_are_the_same(bank: RearrangeBank) -> None:
    sim = RearrangeTensors(bank, device="cpu", partner="both")
    start = sim.start(sim.before_the_first(torch.arange(len(bank)) - 1))
    step, a, b = fused(sim.step), start, start
    nothing = torch.full((len(bank),), FREE)
    with torch.no_grad():
        for k in range(60):
            chosen = torch.full_like(nothing, k % 2)
            a, b = sim.step(a, chosen, nothing), step(b, chosen, nothing)
    for mine, theirs in zip(a.tensors(), b.tensors(), strict=True):
        if mine.dtype.is_floating_point:
            torch.testing.assert_close(theirs, mine, rtol=0, atol=1e-6)
        else:
            assert torch.equal(mine, theirs)


def test_a_failed_choice_costs_a_step(bank: RearrangeBank) -> None:
    sim = RearrangeTensors(bank, device="cpu", planners=())
    play = sim.start(sim.before_the_first(torch.arange(len(bank)) - 1))
    place = torch.full((len(bank),), 6)  # hands are empty
    play = sim.step(play, place, place)
    assert (play.robot_does.outcome == FAILED).all()
    assert (play.human_does.outcome == FAILED).all()
    assert (play.robot_does.skill == FREE).all()
    assert torch.equal(play.robot.xz, sim.tables.starts[play.episode, 0, :2])
    walks = sim.step(
        play, place, torch.full_like(place, 10)
    )  # a person has no primitives, so it counts as the last choice
    assert (walks.human_does.last == 8).all()
    assert Action("wait", steps=5) == choices(2, robot=False)[8]
