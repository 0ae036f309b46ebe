"""Social navigation on a device: the episodes of the CPU's batch, look-ups near the truth, the environment's manners."""

from __future__ import annotations

import shutil
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("shapely")
pytest.importorskip("fcl")

import h3data  # noqa: E402
from h3data.bodies import load_humanoid, load_robot  # noqa: E402
from h3data.errors import InputError  # noqa: E402
from h3data.geometry import ground_pose  # noqa: E402
from h3data.scene import FreeSpace  # noqa: E402
from h3data_homes import (  # noqa: E402
    HOME_NAMES,
    HomeSpec,
    build_home,
)
from h3data_training.envs.social_nav_torch_env import SocialNavTorchEnv  # noqa: E402
from h3data_training.torch.contact import BONE_TOLERANCE_M, TOLERANCE_M, TouchTest  # noqa: E402
from h3data_training.torch.episodes import EpisodeBank  # noqa: E402
from h3data_training.torch.geodesic import Lattices, shortest_path  # noqa: E402
from h3data_training.torch.graph import fused  # noqa: E402
from h3data_training.torch.social_nav import SocialNavTensors  # noqa: E402
from h3data_training.torch.state import HumanTensors, RobotTensors  # noqa: E402
from h3data_training.torch.step import Grids  # noqa: E402
from sim_kinematic.motion.spec import PersonContact, StrideSpec, WalkerSpec  # noqa: E402
from sim_kinematic.sensing.table import FOLLOWER, TABLE  # noqa: E402
from sim_kinematic.tasks.rules.rewards import Encounter, SocialNavReward  # noqa: E402
from sim_kinematic.tasks.social_nav import TRAINING  # noqa: E402
from tests.sim.steppers import Batch  # noqa: E402

HOMES = ["small:1", "small:2"]
pytestmark = pytest.mark.usefixtures("one_torch_thread")
GPS = ("humanoid_gps",)
RULES = replace(TRAINING, max_steps=60, end_on_collision=False, human=WalkerSpec())  # on a device arms always swing
STRIDES = replace(RULES, human=WalkerSpec(speed_mps=1.3, stride=StrideSpec()))
SEED = 5
compiles = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed, so nothing is compiled for the CPU"),
]
on_gpu = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no GPU")]


@pytest.fixture(scope="module")
def bank() -> EpisodeBank:
    return EpisodeBank.draw(HOMES, 6, seed=SEED, spec=RULES)


def doubles(array: Any) -> Any:
    return torch.tensor(array, dtype=torch.float64)


def chase(gps: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Actions that follow the person, by their distance and angle [W, 2]."""
    ahead = np.where(gps[:, 0] > 1.3, 0.9, 0.0) + rng.normal(0, 0.2, len(gps))
    return np.stack([ahead, -gps[:, 1]], -1).clip(-1, 1)


# --- against the batch --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("rules", "homes"),
    [
        (RULES, HOMES),
        (replace(RULES, person_contact="bones"), HOMES),
        pytest.param(STRIDES, HOMES, marks=pytest.mark.slow),
        pytest.param(STRIDES, ["h3-homes/train#0", "h3-homes-v2/train#6"], marks=pytest.mark.slow),
    ],
    ids=["paper", "bones", "natural", "both generations"],
)
def test_the_same_actions_give_the_episodes_of_the_batch(rules: Any, homes: list[str]) -> None:
    worlds, rng = 8, np.random.default_rng(1)
    bank = EpisodeBank.draw(homes, 6, seed=SEED, spec=rules)
    assert len(bank.floors) == 2
    index = np.arange(worlds) % len(bank)
    batch = Batch(homes, worlds=worlds, spec=rules)
    batch.begin(SEED, index)
    sim = SocialNavTensors(bank, device="cpu", spec=rules)
    play = sim.step(sim.before_the_first(torch.tensor(index - 1)), torch.zeros(worlds, 2))
    (robots,), (people,) = batch.state.robots, batch.state.people
    rewards = SocialNavReward(worlds, rules=rules)
    tolerance_m = BONE_TOLERANCE_M if rules.person_contact == "bones" else TOLERANCE_M

    def met() -> Encounter:
        return Encounter(robots.xz, robots.heading, people.xz, play.memory["geodesic"].numpy(), play.collides.numpy())

    rewards.reset(met())
    ended, touches, follows = np.zeros(worlds, np.bool_), 0, 0
    for _ in range(150):
        actions = chase(sim.observations(GPS, play)["humanoid_gps"].numpy(), rng)
        batch.step(actions)
        if ended.any():
            index[ended] = (index[ended] + 1) % len(bank)
            batch.begin(SEED, index, where=ended)
        play = sim.step(play, torch.tensor(actions))
        np.testing.assert_allclose(play.robot.xz, robots.xz, rtol=0, atol=1e-9)
        np.testing.assert_allclose(play.robot.heading, robots.heading, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(play.robot.contact, robots.contact)
        for name, mine in play.human._asdict().items():
            np.testing.assert_allclose(mine, getattr(people, name), rtol=0, atol=1e-9)
        np.testing.assert_array_equal(play.steps, batch.play.steps)
        np.testing.assert_array_equal(play.episode, index)
        clear = sim.touch.gap(play.robot, play.human).abs().numpy() > tolerance_m
        np.testing.assert_array_equal(play.collides.numpy()[clear], batch.memory.collides[clear])
        np.testing.assert_allclose(play.memory["geodesic"], batch.memory.geodesic, rtol=0.1, atol=0.05)
        worth = rewards.step(met())  # the CPU's reward of what the device saw
        if ended.any():
            rewards.reset(met(), where=ended)
        np.testing.assert_allclose(play.reward, np.where(ended, 0, worth.reward), rtol=0, atol=1e-9)
        np.testing.assert_array_equal(play.memory["followed"], rewards.followed)
        ended = ~ended & batch.play.out_of_time
        np.testing.assert_array_equal(play.truncated, ended)
        touches += batch.memory.collides.sum()
        follows += rewards.followed.sum()
    assert touches > (2 if rules.person_contact == "bones" else 5) or rules is STRIDES
    assert follows > 100 or homes is not HOMES  # larger homes take longer to cross than these episodes last
    assert batch.play.world.floor_y.shape == (worlds,)


@pytest.mark.slow
def test_float32_plays_nearly_the_same(bank: EpisodeBank) -> None:
    worlds, rng = 24, np.random.default_rng(4)
    first = torch.arange(worlds) % len(bank) - 1
    exact, single = (SocialNavTensors(bank, device="cpu", dtype=t, spec=RULES) for t in (torch.float64, torch.float32))
    a, b = (sim.before_the_first(first) for sim in (exact, single))
    for _ in range(130):
        actions = torch.tensor(chase(exact.observations(GPS, a)["humanoid_gps"].numpy(), rng))
        a, b = exact.step(a, actions), single.step(b, actions.float())
        assert b.robot.xz.dtype == b.reward.dtype == torch.float32
        assert torch.equal(a.episode, b.episode)
        assert (a.human.xz - b.human.xz).abs().max() < 1e-3
    apart = (a.robot.xz - b.robot.xz).abs().amax(1)
    assert (apart < 1e-3).double().mean() > 0.8  # a tie at a wall may part two tracks
    same = apart < 1e-3
    assert (a.reward - b.reward).abs()[same].median() < 1e-3


def test_her_way_points_last_for_the_whole_episode(bank: EpisodeBank) -> None:
    sim = SocialNavTensors(bank, device="cpu", spec=RULES)
    play = sim.step(sim.before_the_first(torch.arange(len(bank)) - 1), torch.zeros(len(bank), 2))
    last = 0
    for _ in range(RULES.max_steps):
        before = play.human
        play = sim.step(play, torch.zeros(len(bank), 2))
        moved = (play.human.xz - before.xz).abs().sum(1) + (play.human.heading - before.heading).abs()
        assert (moved > 0).all()
        last = max(last, int(play.leg.max()))
    assert 2 <= last < bank.way_points.shape[1]


@pytest.mark.slow
def test_a_collision_ends_the_episode_where_the_rules_say_so(bank: EpisodeBank) -> None:
    rules = replace(RULES, end_on_collision=True, max_steps=500)
    sim = SocialNavTensors(bank, device="cpu", spec=rules)
    play = sim.step(sim.before_the_first(torch.arange(len(bank)) - 1), torch.zeros(len(bank), 2))
    ends = 0
    for _ in range(200):
        gps = sim.observations(GPS, play)["humanoid_gps"]
        before = play
        play = sim.step(play, torch.stack([torch.ones(len(bank)), -gps[:, 1]], 1))
        assert torch.equal(play.terminated, play.collides & ~before.ended)
        assert torch.equal(play.steps[before.ended], torch.zeros_like(play.steps[before.ended]))
        assert (play.reward[before.ended] == 0).all()
        ends += int(play.terminated.sum())
    assert ends > 2


@pytest.mark.slow
def test_a_step_waits_for_nothing(bank: EpisodeBank) -> None:
    # tensors without data: whatever asked for a value, or mixed devices, would fail
    sim = SocialNavTensors(bank, device="meta", dtype=torch.float32, spec=RULES)
    play = sim.before_the_first(torch.zeros(7, dtype=torch.int64, device="meta"))
    after = sim.step(play, torch.zeros(7, 2, device="meta"))
    for mine, theirs in zip(play.tensors(), after.tensors(), strict=True):
        assert (mine.shape, mine.dtype, mine.device) == (theirs.shape, theirs.dtype, theirs.device)
    shown = sim.observations(FOLLOWER, after)
    assert {name: seen.shape for name, seen in shown.items()} == {name: (7, TABLE[name].width) for name in FOLLOWER}


# --- look-ups -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("home", ["small", pytest.param("medium", marks=pytest.mark.slow), "small2"])
def test_ways_are_nearly_the_exact_ones(home: str) -> None:
    free = FreeSpace.from_scene(build_home(HomeSpec(seed=1, **HOME_NAMES[home])))
    rng = np.random.default_rng(0)
    a, b = free.sample(rng, 4000), free.sample(rng, 4000)
    b[:2000] = a[:2000] + rng.uniform(-2.5, 2.5, (2000, 2))  # near each other, as where one follows
    a, b = (p[free.is_navigable(b)] for p in (a, b))
    exact = free.geodesic(a, b)
    tables = Grids.of([free], "cpu", torch.float64), Lattices.of([free], "cpu", torch.float64)
    way = shortest_path(*tables, doubles(a), doubles(b))
    found = way.length.numpy()
    error = np.abs(found - exact) / exact.clip(0.1)
    assert np.median(error) < 0.002
    assert np.quantile(error, 0.95) < 0.015
    assert np.quantile(np.abs(found - exact), 0.99) < 0.15
    assert (found >= np.hypot(*(a - b).T) - 1e-9).all()
    first = np.array([free.next_waypoint(p, q, beyond_m=0.125) for p, q in zip(a, b, strict=True)])
    turns = np.isfinite(found) & (found > np.hypot(*(a - b).T) + 1e-9)
    towards, wanted = way.towards.numpy(), first - a
    cross = towards[:, 0] * wanted[:, 1] - towards[:, 1] * wanted[:, 0]
    off = np.degrees(np.abs(np.arctan2(cross, (towards * wanted).sum(1))))
    assert off[~turns & np.isfinite(found)].max() < 1.0  # a straight way may come nearer to corners, by 4 mm
    assert np.quantile(off[turns], 0.5) < 6
    assert np.quantile(off[turns], 0.9) < 20
    back = shortest_path(*tables, doubles(b), doubles(a)).length.numpy()
    np.testing.assert_allclose(back, found, rtol=0, atol=1e-2)


def test_ways_on_several_floors_and_off_the_floor(bank: EpisodeBank) -> None:
    place = torch.tensor([0, 1, 1, 0])
    grids, lattices = Grids.of(bank.floors, "cpu", torch.float64), Lattices.of(bank.floors, "cpu", torch.float64)
    rng = np.random.default_rng(2)
    a, b = (np.stack([bank.floors[k].sample(rng, 1)[0] for k in place]) for _ in range(2))
    found = shortest_path(grids.at(place), lattices.at(place), doubles(a), doubles(b)).length.numpy()
    exact = [float(bank.floors[k].geodesic(p, q)) for k, p, q in zip(place, a, b, strict=True)]
    np.testing.assert_allclose(found, exact, rtol=0.05)
    assert len(bank.floors) == 2
    far = shortest_path(grids.at(place), lattices.at(place), doubles(a + 500.0), doubles(b))
    assert far.length.isinf().all()
    assert far.towards.isfinite().all()


@pytest.mark.parametrize(
    ("name", "person", "tolerance_m"),
    [
        ("quad_arm", "body", TOLERANCE_M),
        ("lift_arm", "body", TOLERANCE_M),
        ("quad_arm", "bones", BONE_TOLERANCE_M),
        ("lift_arm", "bones", BONE_TOLERANCE_M),
    ],
)
def test_contact_is_that_of_the_exact_shapes(name: str, person: PersonContact, tolerance_m: float) -> None:
    from sim_kinematic.contact import AgentContacts
    from sim_kinematic.contact.clearance import RobotHumanContact
    from sim_kinematic.contact.frames import body_shapes, shape_frames

    robot, human, rng, count = load_robot(name), load_humanoid("female_0"), np.random.default_rng(0), 600
    robot_xz, robot_heading, human_heading = rng.uniform(-3, 3, (count, 2)), *rng.uniform(-4, 4, (2, count))
    away, angle = rng.uniform(0.2, 1.1, count), rng.uniform(-np.pi, np.pi, count)
    human_xz = robot_xz + np.stack([away * np.cos(angle), away * np.sin(angle)], -1)
    distance, blend = rng.uniform(0, 20, count), rng.integers(0, 7, count) / 6
    clip = human.clip_for_speed(WalkerSpec().speed_mps)
    phase = (human.clips[clip].start_phase + distance / human.clips[clip].stride_m) % 1.0
    bases = ground_pose(robot_xz, robot_heading, 0.0), ground_pose(human_xz, human_heading, 0.0)
    frame = np.full(count, clip), phase, blend
    truth = RobotHumanContact(robot, human, person_contact=person).touching(*bases, *frame)
    robots = RobotTensors(doubles(robot_xz), doubles(robot_heading), torch.zeros(count, dtype=torch.bool))
    people = HumanTensors(*map(doubles, (human_xz, human_heading, distance, np.zeros(count), blend)))
    test = TouchTest.of(robot, human, WalkerSpec(), "cpu", torch.float64, person_contact=person)
    gap = test.gap(robots, people).numpy()
    clear = np.abs(gap) > tolerance_m
    np.testing.assert_array_equal((gap <= 0)[clear], truth[clear])
    assert clear.mean() > 0.9
    pair = AgentContacts(body_shapes(robot), body_shapes(human, person))
    links = shape_frames(robot, robot.link_matrices(bases[0], np.tile(robot.rest, (count, 1))))
    joints = shape_frames(human, human.joint_matrices(bases[1], *human.clip_pose(*frame)), person)
    near = np.flatnonzero((gap > 0) & (gap < 0.0399))
    assert len(near) > 10
    for n in near:
        pair.update(0, links[n])
        pair.update(1, joints[n])
        assert abs(pair.distance() - gap[n]) < tolerance_m


# --- the environment ----------------------------------------------------------------------------------------------------
def test_the_environment_keeps_gymnasiums_manners(bank: EpisodeBank) -> None:
    env = SocialNavTorchEnv(
        5, device="cpu", spec=RULES, episodes=bank, observations=("humanoid_gps", "egomotion", "localization")
    )
    with pytest.raises(InputError, match="H3-ENV-016"):
        env.step(torch.zeros(5, 2))
    shown, info = env.reset(seed=3)
    kept = {name: tensor.clone() for name, tensor in shown.items()}
    assert (info["episode"] < len(bank)).all()
    for k in range(RULES.max_steps):
        after, reward, terminated, truncated, info = env.step(torch.full((5, 2), 0.5))
        assert not terminated.any()
        assert truncated.all() == (k == RULES.max_steps - 1) == truncated.any()
        assert reward.dtype == torch.float32
        for name, tensor in after.items():
            rows = env.single_observation_space[name]
            assert all(rows.contains(row) for row in tensor.numpy())
    first = info["episode"]
    after, reward, _, truncated, info = env.step(torch.ones(5, 2))
    assert (reward == 0).all()
    assert not truncated.any()
    assert torch.equal(info["episode"], (first + 1) % len(bank))
    assert (after["egomotion"] == 0).all()
    assert all(torch.equal(shown[name], kept[name]) for name in shown)  # what was handed out stays as it was
    np.testing.assert_allclose(after["localization"][:, 0], bank.robot_xz[info["episode"], 0], rtol=1e-6)
    assert env.action_space.shape == (5, 2)
    assert env.single_action_space.contains(np.zeros(2, np.float32))
    batched: Any = env.observation_space
    assert batched["egomotion"].shape == (5, 3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_results_are_not_overwritten_by_later_steps(bank: EpisodeBank, dtype: Any) -> None:
    env = SocialNavTorchEnv(3, device="cpu", dtype=dtype, spec=RULES, episodes=bank)
    rng = np.random.default_rng(0)
    given = list(env.reset(seed=1))
    kept = [{name: tensor.clone() for name, tensor in part.items()} for part in given]
    for _ in range(5):
        observed, *ends, info = env.step(torch.tensor(rng.uniform(-1, 1, (3, 2))))
        given += [observed, dict(enumerate(ends)), info]
        kept += [{name: tensor.clone() for name, tensor in part.items()} for part in given[-3:]]
    for mine, theirs in zip(given, kept, strict=True):
        assert all(torch.equal(mine[name], theirs[name]) for name in theirs)


def test_a_seed_says_which_episodes_are_played(bank: EpisodeBank) -> None:
    env = SocialNavTorchEnv(9, device="cpu", spec=RULES, episodes=bank)
    _, one = env.reset(seed=11)
    env.reset(seed=12)
    _, again = env.reset(seed=11)
    assert torch.equal(one["episode"], again["episode"])
    _, following = env.reset()
    assert torch.equal(following["episode"], (one["episode"] + 1) % len(bank))
    _, listed = env.reset(seed=[11 + w for w in range(9)])
    assert torch.equal(listed["episode"], one["episode"])
    assert one["episode"].unique().numel() > 2
    _, shifted = env.reset(seed=12)
    assert torch.equal(shifted["episode"][:-1], one["episode"][1:])


def test_make_gives_it_for_a_device() -> None:
    env = h3data.make("social_nav", scenes="small:1", num_envs=2, device="cpu", episodes=2, spec=RULES)
    assert isinstance(env, SocialNavTorchEnv)
    assert env.num_envs == 2
    assert "cpu" in repr(env)
    env.reset()
    env.close()


def test_what_a_device_does_not_know_is_refused(bank: EpisodeBank) -> None:
    def wrong(match: str, **options: Any) -> None:
        with pytest.raises(InputError, match=match):
            SocialNavTorchEnv(**{"num_envs": 1, "device": "cpu", "episodes": bank, "spec": RULES, **options})

    wrong(r"(?s)humanoid_gps.*H3-ENV-008", observations=("rgb",))
    wrong("H3-RENDER-014", observations=("arm_depth",))
    wrong("H3-RENDER-014", observations=("arm_rgb",), light="flat")
    wrong(r"(?s)'sunny'.*H3-RENDER-046", light="sunny")
    wrong("H3-ENV-009", reward="habitat")
    wrong("H3-ENV-015", num_envs=0)
    wrong("H3-ENV-017", device="toaster")
    wrong(r"(?s)slide.*BaseSpec.*H3-ENV-034", spec=replace(RULES, robot=replace(RULES.robot, slide="habitat")))
    if not torch.cuda.is_available():
        wrong("H3-ENV-013", device="cuda")
    with pytest.raises(InputError, match="H3-TRAIN-060"):
        EpisodeBank.draw(HOMES, 0)
    env = SocialNavTorchEnv(2, device="cpu", episodes=bank, spec=RULES)
    with pytest.raises(InputError, match=r"(?s)2.*H3-ENV-014"):
        env.reset(seed=[1])
    env.reset(seed=1)
    with pytest.raises(InputError, match=r"(?s)\[2, 2\].*H3-ENV-010"):
        env.step(torch.zeros(3, 2))
    for bad in (np.zeros((2, 2)), [[0.0, 0.0]] * 2):
        with pytest.raises(InputError, match=r"(?s)social_nav.*robot.*H3-ENV-058"):
            env.step(bad)
    with pytest.raises(InputError, match="H3-ENV-001"):
        h3data.make("social_nav", device="cpu", agents=("robot", "human"))


# --- on a GPU -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("worlds", [pytest.param(256, marks=on_gpu)])
def test_a_gpu_plays_as_the_cpu_and_a_graph_as_eager(bank: EpisodeBank, worlds: int) -> None:
    options: dict[str, Any] = {"spec": RULES, "episodes": bank, "dtype": torch.float64}
    cpu = SocialNavTorchEnv(worlds, device="cpu", **options)
    eager = SocialNavTorchEnv(worlds, device="cuda", graph=False, compile=False, **options)
    graph = SocialNavTorchEnv(worlds, device="cuda", compile=False, **options)
    envs, rng = (cpu, eager, graph), np.random.default_rng(0)
    seen = [env.reset(seed=1)[0] for env in envs]
    for _ in range(150):
        actions = torch.tensor(chase(seen[0]["humanoid_gps"].numpy(), rng))
        results = [env.step(actions.to(env.device)) for env in envs]
        seen = [r[0] for r in results]
        for a, b in zip(eager.play.tensors(), graph.play.tensors(), strict=True):
            assert torch.equal(a, b)
        for name, tensor in seen[1].items():
            assert torch.equal(tensor, seen[2][name])
        assert torch.equal(cpu.play.episode, graph.play.episode.cpu())
        apart = (cpu.play.robot.xz - graph.play.robot.xz.cpu()).abs().amax(1)
        assert (apart < 1e-5).double().mean() > 0.98  # a tie at a wall may part two tracks
        assert (cpu.play.human.xz - graph.play.human.xz.cpu()).abs().max() < 1e-5
        same = apart < 1e-5
        assert (results[0][1][same] - results[2][1].cpu()[same]).abs().quantile(0.99) < 1e-3


@pytest.mark.filterwarnings("default")  # of what compiles
@pytest.mark.parametrize("device", [pytest.param("cpu", marks=compiles), pytest.param("cuda", marks=on_gpu)])
def test_a_compiled_step_is_the_eager_one(bank: EpisodeBank, device: str) -> None:
    options: dict[str, Any] = {"spec": RULES, "episodes": bank, "dtype": torch.float64, "device": device}
    eager = SocialNavTorchEnv(64, compile=False, **options)
    compiled = SocialNavTorchEnv(64, compile=True, **options)
    rng = np.random.default_rng(0)
    seen = [env.reset(seed=1)[0] for env in (eager, compiled)]
    for _ in range(150):
        actions = torch.tensor(chase(seen[0]["humanoid_gps"].cpu().numpy(), rng), device=device)
        results = [env.step(actions) for env in (eager, compiled)]
        seen = [r[0] for r in results]
    apart = (eager.play.robot.xz - compiled.play.robot.xz).abs().amax(1)
    assert (apart < 1e-9).double().mean() > 0.98  # a tie at a wall may part two tracks
    assert torch.equal(eager.play.episode, compiled.play.episode)
    assert (seen[0]["humanoid_gps"] - seen[1]["humanoid_gps"])[apart < 1e-9].abs().max() < 1e-5


@pytest.mark.filterwarnings("default")  # of what compiles
@pytest.mark.parametrize("device", [pytest.param("cpu", marks=compiles), pytest.param("cuda", marks=on_gpu)])
def test_any_number_of_steps_can_be_compiled(device: str) -> None:
    for worlds in range(2, 14):
        ones = torch.ones(worlds, device=device)
        assert fused(lambda value, ones=ones: value + ones)(ones).sum() == 2 * worlds


@pytest.mark.filterwarnings("ignore:Synchronization debug mode")  # what it says of itself when it is turned on
@pytest.mark.parametrize("worlds", [pytest.param(4096, marks=on_gpu)])
def test_actions_and_results_stay_on_the_gpu(bank: EpisodeBank, worlds: int) -> None:
    env = SocialNavTorchEnv(worlds, device="cuda", spec=RULES, episodes=bank)
    env.reset(seed=0)
    actions = torch.rand(worlds, 2, device="cuda")
    torch.cuda.synchronize()
    try:
        torch.cuda.set_sync_debug_mode("error")
        shown, *rest = env.step(actions)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert all(t.is_cuda for t in [*shown.values(), *rest[:3], *rest[3].values()])
