"""One table of sensors, and one of compared tasks: worlds on a device show and judge as those on the CPU."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, partial
from types import ModuleType
from typing import Any, get_args

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("shapely")
pytest.importorskip("fcl")

import h3data  # noqa: E402
from examples.fetch import Fetch  # noqa: E402
from examples.point_goal import PointGoal  # noqa: E402
from h3data.errors import InputError  # noqa: E402
from h3data_crowds.crowd_nav import CrowdNav  # noqa: E402
from h3data_training.torch.episodes import EpisodeBank  # noqa: E402
from h3data_training.torch.rearrange.observations import OBSERVED, OF_PATHS, View, observed, observed_of  # noqa: E402
from h3data_training.torch.rearrange.state import DONE, FREE  # noqa: E402
from h3data_training.torch.social_nav import ON_DEVICES, SocialNavTensors  # noqa: E402
from h3data_training.torch.task_worlds import TaskTensors  # noqa: E402
from sim_kinematic.agents.skills import CONTROL, Action  # noqa: E402
from sim_kinematic.envs.world_stepper import WorldStepper  # noqa: E402
from sim_kinematic.motion.spec import STEP_S  # noqa: E402
from sim_kinematic.motion.state import NOBODY  # noqa: E402
from sim_kinematic.policies.rearrange_observations import exact  # noqa: E402
from sim_kinematic.policies.skills.player import observe  # noqa: E402
from sim_kinematic.sensing.encodings import DETECTOR, OF_CHOICES, OF_COMMANDS, Encoding  # noqa: E402
from sim_kinematic.sensing.table import AHEAD_M, LIDARS, OF_SKILLS, TABLE, Pose  # noqa: E402
from sim_kinematic.tasks.play import DecisionLoop  # noqa: E402
from sim_kinematic.tasks.registry import task_registry  # noqa: E402
from sim_kinematic.tasks.rules.rewards import REARRANGE_REWARDS, RewardProfile  # noqa: E402
from sim_kinematic.tasks.social_nav import SocialNav  # noqa: E402
from tests.training.torch import test_crowds, test_fetch, test_rearrange, test_skills, test_social_nav, test_task_worlds  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")
WORLDS, OBJECTS, JOINTS, CHOICES, PARTS = 5, 2, 7, 13, 2
COUNTS = {"once": 1, "objects": OBJECTS, "joints": JOINTS, "choices": CHOICES, "parts": PARTS}


# --- each row is one function -------------------------------------------------------------------------------------------
class AnyContext:
    """A moment that has everything, of random numbers, in the array namespace ``xp``: of one world, or of `WORLDS`."""

    def __init__(self, xp: ModuleType, *, one: bool = False) -> None:
        rng = np.random.default_rng(0)

        def array(values: Any) -> Any:
            return xp.asarray(values[0] if one else values)

        def numbers(*axes: int) -> Any:
            return array(rng.uniform(-4, 4, (WORLDS, *axes)))

        def flags(*axes: int) -> Any:
            return array(rng.random((WORLDS, *axes)) < 0.5)

        self.xp, self.agent = xp, 0
        self.now, self.before, self.start, self.other, self.other_before = (
            Pose(numbers(2), numbers()) for _ in range(5)
        )
        self.contact, self.touching, self.close, self.at_goal = flags(), flags(), flags(), flags(OBJECTS)
        self.arm, self.height, self.length = numbers(JOINTS), numbers(), numbers()
        self.objects, self.starts, self.goals = numbers(OBJECTS, 3), numbers(OBJECTS, 3), numbers(OBJECTS, 3)
        self.target, self.resting, self.point = numbers(3), numbers(3), numbers(2)
        self.held_by = array(rng.integers(NOBODY, 2, (WORLDS, OBJECTS)))
        self.steps = array(rng.integers(0, 900, WORLDS))
        self.handles, self.open_parts = numbers(PARTS, 3), flags(PARTS)
        self.points = numbers(OBJECTS, len(AHEAD_M), 2)
        lengths = rng.uniform(0, 9, (WORLDS, 8, OBJECTS))
        self.lengths = array(lengths)
        self.endings = array(np.eye(CHOICES)[rng.integers(0, CHOICES, WORLDS)])

    def floor_y(self) -> Any:
        return self.height

    def path(self) -> tuple[Any, Any]:
        endless = self.xp.asarray(np.inf)
        return self.xp.where(self.length > 2.0, endless, self.length * self.length), self.point

    def clearance(self, points: Any) -> Any:
        return 0.2 + 0.2 * self.xp.sin(points[..., 0]) * self.xp.cos(points[..., 1])

    def free_along(self, headings: Any, max_m: float) -> Any:
        return (3.0 + 2.0 * self.xp.sin(headings)).clip(None, max_m)

    def circles(self, *, legs: bool) -> Any:
        at = self.now.xz[..., None, :] + self.point[..., None, :]
        return self.xp.concatenate([at, self.xp.full_like(at[..., :1], 0.06 if legs else 0.25)], -1)

    def in_hand(self, points: Any) -> Any:
        return points - self.goals[..., :1, :]

    def from_start(self, points: Any) -> Any:
        return points - self.objects[..., :1, :]

    def other_root(self) -> Any:
        return self.resting

    def ways(self, end: str, *, other: bool, then: bool = False) -> Any:
        return self.lengths[..., 4 * then + 2 * other + (end == "goals"), :]

    def ahead(self, *, other: bool) -> Any:
        return self.points + other

    def ended(self, outcome: str) -> Any:
        return self.endings * len(outcome)


@pytest.mark.parametrize("name", TABLE)
def test_a_row_is_the_same_function_of_arrays_and_tensors(name: str) -> None:
    sensor = TABLE[name]
    values = np.asarray(sensor.of(AnyContext(np)), np.float64)
    limits = sensor.limits(COUNTS[sensor.times])
    assert values.shape == (WORLDS, *limits.shape)
    assert len(sensor.unit) in (0, sensor.width)
    assert np.shape(sensor.low) == np.shape(sensor.high) == (sensor.width,)
    assert np.ptp(values), "nothing that tells worlds apart"
    on_device = sensor.of(AnyContext(torch))
    within = 1e-6 if on_device.dtype == torch.float32 else 1e-12  # whole numbers times a float are of 32 bits
    np.testing.assert_allclose(on_device.double().numpy(), values, rtol=within, atol=within)
    np.testing.assert_array_equal(np.asarray(sensor.of(AnyContext(np, one=True)), np.float64), values[0])


@pytest.mark.parametrize(
    ("family", "name"), [(f, n) for f, known in {"commands": OF_COMMANDS, "choices": OF_CHOICES}.items() for n in known]
)
def test_a_network_reads_a_sensor_the_same_in_numpy_and_torch(family: str, name: str) -> None:
    encoding: Encoding = (OF_COMMANDS if family == "commands" else OF_CHOICES)[name]
    sensor = None if name == DETECTOR else (TABLE.get(name) or CrowdNav.sensors[name])
    assert encoding.given == (sensor.width if sensor else 1)
    assert encoding.times == (sensor.times if sensor else "once")
    seen = np.random.default_rng(0).uniform(0, 3, (6, encoding.given))
    read = encoding.of(np, seen.astype(encoding.dtype))
    assert read.shape == (6, encoding.length)
    assert read.dtype == encoding.dtype
    on_device = encoding.of(torch, torch.as_tensor(seen, dtype=torch.float32))
    assert on_device.dtype == torch.float32
    np.testing.assert_allclose(on_device.numpy(), read, rtol=2e-6, atol=1e-6)
    one = encoding.of(np, seen[0].astype(encoding.dtype))
    np.testing.assert_array_equal(one, read[0])


# --- worlds on a device -------------------------------------------------------------------------------------------------
Pairs = dict[str, list[tuple[Any, Any]]]


def _navigation(task: Any, rules: Any, backend: str, *, steps: int) -> Pairs:
    """A robot that goes where its first sensor says, in 8 worlds until their episodes end."""
    device, dtype = BACKENDS[backend]
    names, homes, worlds = SHOWN[task.name], test_social_nav.HOMES, 8
    found: Pairs = {name: [] for name in (*names, *JUDGED)}
    bank = EpisodeBank.draw(homes, 6, seed=test_social_nav.SEED, task=task, spec=rules)
    index = np.arange(worlds) % len(bank)
    stepper = WorldStepper(task, homes, worlds=worlds, spec=rules, observations=names)
    stepper.begin([test_social_nav.SEED] * worlds, index.tolist(), np.ones(worlds, np.bool_))
    make = SocialNavTensors if isinstance(task, SocialNav) else partial(TaskTensors, task=task)
    sim, rng = make(bank, device=device, dtype=dtype, spec=rules), np.random.default_rng(1)
    zeros = torch.zeros(worlds, 2, device=sim.device)
    play = sim.step(sim.before_the_first(torch.tensor(index - 1, device=sim.device)), zeros)
    going = np.ones(worlds, np.bool_)
    for _ in range(steps):
        shown, seen = sim.observations(names, play), stepper.observe("robot")
        for name in names:
            found[name].append((seen[name][going], shown[name].cpu().numpy()[going]))
        actions = test_social_nav.chase(seen[names[0]], rng)
        reward, terminated, truncated = stepper.step({"robot": actions})
        play = sim.step(play, torch.tensor(actions, device=sim.device))
        theirs = (play.reward, play.terminated, sim.succeeded(play))
        for name, mine, other in zip(
            JUDGED, (reward, terminated, stepper.info("robot")["success"]), theirs, strict=True
        ):
            found[name].append((mine[going], other.cpu().numpy()[going]))
        going &= ~(terminated | truncated)
    return found


def _crowd() -> Pairs:
    """A robot among people, whose paths are those of the bank."""
    found: Pairs = {name: [] for name in (*SHOWN["crowd_nav"], *JUDGED)}
    with pytest.MonkeyPatch.context() as patch:
        both = test_crowds.Pair("orca", patch)
        for action in test_crowds.drives(40):
            seen, shown = both.stepper.observe("robot"), both.sim.observations(SHOWN["crowd_nav"], both.play)
            for name in SHOWN["crowd_nav"]:
                found[name].append((seen[name], shown[name].numpy()))
            reward, terminated, _ = both.step(action)
            mine = reward, terminated, both.stepper.info("robot")["success"]
            theirs = both.play.reward, both.play.terminated, both.sim.succeeded(both.play)
            for name, own, other in zip(JUDGED, mine, theirs, strict=True):
                found[name].append((own, other.numpy()))
    return found


def _judged(found: Pairs, pair: Any, n: int, play: Any) -> None:
    """Add how the CPU and the device have judged the last step of world ``n``."""
    for name in JUDGED:
        theirs = getattr(pair.state, name)[n : n + 1].cpu().numpy()
        found[name].append((np.asarray(getattr(play.outcome, name)), theirs))


def _rearrange(profile: str) -> Pairs:
    """Robot and person in 4 worlds, each with errands of its own."""
    names = SHOWN["rearrange"]
    found: Pairs = {name: [] for name in (*names, *JUDGED)}
    rules = {"oracle": test_rearrange.QUICK, "max_steps": 330, "reward": profile}
    pair = test_rearrange.Pair(test_rearrange.drawn(6, **rules)[:4], outside=test_rearrange.KINDS)
    rng, shown = np.random.default_rng(5), {}

    def compare(n: int, play: Any) -> None:
        _judged(found, pair, n, play)
        if not looks:
            return
        if not n:
            views = {kind: View.of(pair.sim, pair.state, kind) for kind in test_rearrange.KINDS}
            shown.update({kind: (observed(view, names), view.allowed()) for kind, view in views.items()})
        for agent, kind in enumerate(test_rearrange.KINDS):
            mine, mask = shown[kind]
            known = play.team.choices(agent)
            np.testing.assert_array_equal(mask[n], [not play.team.objects.why_not(agent, action) for action in known])
            for name, values in exact([play.view(agent)], names).items():
                found[name].append((values, mine[name][n : n + 1].numpy()))

    for step in range(135):
        looks = step % 3 == 0 and not pair.turns[0].over
        pair.step(pair.random(rng), compare)
    return found


def _fetch() -> Pairs:
    """A robot that opens a drawer, closes it and opens it again, and a person who stands, in 2 worlds."""
    found: Pairs = {name: [] for name in (*SHOWN["fetch"], *JUDGED)}
    episodes = [test_fetch.before_the_drawer(episode) for episode in test_fetch.drawn(2)]
    pair = test_rearrange.Pair(episodes, outside=test_rearrange.KINDS, task=Fetch())
    choice = np.full(2, test_fetch.TO_HANDLE)

    def compare(n: int, play: Any) -> None:
        _judged(found, pair, n, play)
        for agent, kind in enumerate(test_rearrange.KINDS):
            sensors = Fetch.sensors
            mine = observed(View.of(pair.sim, pair.state, kind), SHOWN["fetch"], sensors)
            for name, values in exact([play.view(agent)], SHOWN["fetch"], sensors).items():
                found[name].append((values, mine[name][n : n + 1].numpy()))

    for _ in range(30):
        pair.step(np.stack([choice, np.full(2, test_fetch.WAIT)], 1), compare)
        does = pair.state.robot_does
        ends = (does.skill == FREE) & (does.outcome == DONE)
        after = torch.where(does.last == test_fetch.OPEN, test_fetch.CLOSE, test_fetch.OPEN)
        choice = torch.where(ends, after, FREE).numpy()
    return found


def _skill() -> Pairs:
    """A robot that is to place an object, in 6 worlds."""
    found: Pairs = {name: [] for name in OF_SKILLS}
    episode = test_skills.sampled_episode()
    starts = test_skills.starts_of(episode, "place", 6)
    sim, now = test_skills.worlds(episode, "place", starts)
    plays = [test_skills.play_of(episode, start, {}) for start in starts]
    turns = [DecisionLoop(play) for play in plays]
    rng = np.random.default_rng(2)
    for _ in range(12):
        command = rng.uniform(-1, 1, (len(starts), 10))
        command[:, -1] = 1.0
        before = [(play.team.robots[0].xz.copy(), play.team.robots[0].heading) for play in plays]
        now = sim.step(now._replace(ended=torch.zeros_like(now.ended)), torch.as_tensor(command))
        shown = sim.observations(OF_SKILLS, now)
        for w, (play, turn) in enumerate(zip(plays, turns, strict=True)):
            turn.answer(Action(CONTROL, command=tuple(command[w])))
            turn.go_on()
            for name, values in observe(test_skills.view_of(play, starts[w], before[w]), OF_SKILLS).items():
                found[name].append((values[None], shown[name][w : w + 1].numpy()))
    return found


BACKENDS: dict[str, tuple[str, Any]] = {
    "cpu": ("cpu", torch.float64),
    "cpu, 32 bits": ("cpu", torch.float32),
    "cuda": ("cuda", torch.float32),
}
"""Devices with which worlds are compared, and the numbers that they count with."""
JUDGED = ("reward", "terminated", "success")
"""What a task judges, which is compared as what it shows."""
RUNS: dict[tuple[str, str], Callable[[str], Pairs]] = {
    ("social_nav", "paper"): lambda backend: _navigation(SocialNav(), test_social_nav.RULES, backend, steps=50),
    ("point_goal", ""): lambda backend: _navigation(PointGoal(), test_task_worlds.RULES, backend, steps=60),
    **{("rearrange", profile): lambda _, profile=profile: _rearrange(profile) for profile in REARRANGE_REWARDS},
    ("crowd_nav", ""): lambda _: _crowd(),
    ("fetch", ""): lambda _: _fetch(),
    ("skill", ""): lambda _: _skill(),
}
"""The tasks that are compared, with the profiles of their rewards."""


@cache
def shown_by(task: str, profile: str, backend: str) -> Mapping[str, tuple[Any, Any]]:
    """What the CPU and a device have shown and judged of a task, [N, ...] each, by name."""
    pairs = RUNS[task, profile](backend)
    return {name: tuple(np.concatenate(side) for side in zip(*rows, strict=True)) for name, rows in pairs.items()}  # type: ignore[misc]


SHOWN = {
    "social_nav": ON_DEVICES,
    "point_goal": ("goal_gps", *ON_DEVICES),
    "crowd_nav": test_crowds.SHOWN,
    "rearrange": tuple(name for name in OBSERVED if TABLE[name].times != "choices" and name != "elapsed_s"),
    "fetch": tuple(
        name
        for name in observed_of(Fetch.sensors, Fetch.Spec().parts)
        if TABLE[name].times != "choices" and name not in ("elapsed_s", *OF_PATHS)
    ),
    "skill": OF_SKILLS,
}
"""What is compared: all but how skills ended and how long an episode lasts, of which one world is a step ahead of the other
where an agent is asked."""


def _cases() -> list[Any]:
    """Each sensor and reward of each task with each backend; with skills, whose hands let go by a step, those of 64 bits."""
    cases = []
    for task, profile in RUNS:
        judged = () if task == "skill" else JUDGED
        for backend in BACKENDS if task in ("social_nav", "point_goal") else ("cpu",):
            marks = (
                test_social_nav.on_gpu
                if backend == "cuda"
                else [pytest.mark.slow]
                if backend != "cpu" or profile == "habitat"
                else []
            )
            names = (*SHOWN[task], *judged)
            cases += [pytest.param(task, profile, name, backend, marks=marks) for name in names]
    return cases


@pytest.mark.parametrize(("task", "profile", "name", "backend"), _cases())
def test_a_device_shows_and_judges_as_the_cpu(task: str, profile: str, name: str, backend: str) -> None:
    shown = shown_by(task, profile, backend)
    cpu, device = shown[name]
    assert cpu.shape == device.shape
    assert len(cpu) >= 60
    navigates = task in ("social_nav", "point_goal", "crowd_nav")
    if name == "part_is_open":
        assert 0.2 < cpu.mean() < 0.8
    if name == "reward":
        assert np.ptp(cpu)
        off = np.abs(device - cpu)  # paths are looked up on a device, and their lengths decide what is near
        assert np.quantile(off, 0.9 if navigates else 1) < (0.1 if navigates else 1e-9)
    elif name in JUDGED:
        assert (cpu == device).mean() > (0.99 if navigates else 1 - 1e-9)
    elif name in LIDARS:  # a ray that only just misses an edge may hit it on a device
        off = np.abs(device - cpu)
        assert np.median(off) < 1e-5
        assert np.quantile(off, 0.995) < (0.02 if name == "lidar_legs" else 1e-4)
        if task == "social_nav":  # the robot chases a person, and sees their legs
            assert 0.003 < (cpu != shown["lidar" if name == "lidar_legs" else "lidar_legs"][0]).mean() < 0.5
    elif name in ("way", "goal_way"):  # looked up, not searched for: exact where the way is straight
        assert np.median(np.abs(device[:, 0] - cpu[:, 0]) / np.maximum(cpu[:, 0], 0.3)) < 0.01
        turned = np.abs(np.exp(1j * device[:, 1]) - np.exp(1j * cpu[:, 1]))
        assert np.quantile(turned, 0.8) < np.radians(20)
        if task == "social_nav":
            straight = np.isclose(cpu[:, 0], shown["humanoid_gps"][0][:, 0], atol=1e-6)
            assert 0.01 < straight.mean() < 0.97
            assert turned[straight].max() < 1e-3
    elif name not in OF_PATHS:
        near = 1e-5 if backend == "cpu" and task != "skill" else 2e-5
        if backend != "cpu" and "m/s" in TABLE.get(name, PointGoal.sensors["goal_gps"]).unit:
            near *= 1 / STEP_S  # places of 32 bits, a step apart
        np.testing.assert_allclose(device, cpu, rtol=0, atol=near)
    elif "rad" in TABLE[name].unit:
        (mine, turned), (theirs, angle) = ((side[:, 0::2], side[:, 1::2]) for side in (device, cpu))
        astray = np.abs(mine * np.exp(1j * turned) - theirs * np.exp(1j * angle))
        assert np.quantile(astray, 0.75) < 0.02
        assert np.quantile(astray, 0.95) < 0.5
    else:
        assert np.quantile(np.abs(device - cpu), 0.5) < 0.02
        assert np.quantile(np.abs(device - cpu), 0.9) < 0.5


def test_episodes_that_are_compared_end_and_succeed() -> None:
    for name in ("terminated", "success"):
        assert any(shown_by(*run, "cpu")[name][0].any() for run in RUNS if run[0] in ("point_goal", "fetch")), name


@pytest.mark.parametrize(
    "task", [pytest.param(n, marks=pytest.mark.slow) if n == "language" else n for n in task_registry().names()]
)
def test_a_task_is_compared_or_refused_on_a_device_by_its_name(task: str) -> None:
    if task not in {compared for compared, _ in RUNS}:
        with pytest.raises(InputError, match=rf"(?s){task}.*H3-"):
            h3data.make(task, "small:1", num_envs=1, device="cpu", episodes=1)


def test_a_reward_is_compared_or_refused_on_a_device_by_its_name() -> None:
    for profile in get_args(RewardProfile):
        if ("social_nav", profile) not in RUNS:
            with pytest.raises(InputError, match=rf"(?s){profile}.*H3-ENV-009"):
                h3data.make("social_nav", "small:1", num_envs=1, device="cpu", episodes=1, reward=profile)
    assert {profile for task, profile in RUNS if task == "rearrange"} == set(REARRANGE_REWARDS)
