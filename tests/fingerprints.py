"""What the product computes, as digests: recordings, environments, replays, metrics, exports, pictures.

    python -m tests.fingerprints                        compare everything with tests/data/fingerprints.json
    python -m tests.fingerprints NAME...                only the cases whose names contain one of these words
    python -m tests.fingerprints --renew [NAME...]      compute again and store
    python -m tests.fingerprints --list                 names of all cases
    python -m tests.fingerprints NAME --keep FOLDER     also write the values themselves, to compare those of two commits

A case has groups (one recording, one profile of metrics, one environment), a group has parts (one column, one metric, one
observation), and every part has its own digest, so a difference is named by case, group and part.

Floating-point results differ between types of CPU and versions of libraries. `stamp` says on which arithmetic the digests
were stored; elsewhere they mean nothing. There, store those of the commit before a change and compare the change with them:

    git checkout BEFORE && python -m tests.fingerprints --renew --file /tmp/before.json
    git checkout AFTER && python -m tests.fingerprints --file /tmp/before.json
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import hashlib
import importlib.metadata
import importlib.util
import io
import json
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import h3data

# --- adapter: all that is imported from below the public entry points --------------------------------------------------
from h3data_pipelines.cli import main as run_command


def make(task: str, **options: Any) -> Any:
    """What `h3data.make` makes, by the entry points of these sources: another state of them may be the installed one."""
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    entry = project["entry-points"]["h3data.tasks"][task]
    return importlib.metadata.EntryPoint(task, entry, "h3data.tasks").load()(**options)


def habitat_rules(task: str) -> Any:
    """The rules of a task with sliding and people as in Habitat."""
    from sim_kinematic.rearrange_episode import RearrangeSpec
    from sim_kinematic.spec import BaseSpec, SocialNavSpec, WalkerSpec

    moves: dict[str, Any] = {"robot": BaseSpec(slide="habitat"), "human": WalkerSpec()}
    if task == "social_nav":
        return SocialNavSpec(max_steps=600, **moves)
    return RearrangeSpec(reward="habitat", arm_rad_s=float("inf"), **moves)


def simulated(task: str, home: Any, *, seed: int, rules: Any) -> Any:
    """The recording of one episode of a task under any rules, with its default policies."""
    if task == "social_nav":
        from sim_kinematic.social_nav import SocialNavWorld, simulate_social_nav

        return simulate_social_nav(SocialNavWorld.create(home, seed=seed, spec=rules))
    from sim_kinematic.rearrange import simulate_rearrange
    from sim_kinematic.rearrange_episode import RearrangeWorld

    return simulate_rearrange(RearrangeWorld.create(home, seed=seed, spec=rules))


# --- end of the adapter -------------------------------------------------------------------------------------------------

FILE = Path(__file__).parent / "data" / "fingerprints.json"
DIGITS = 12
Digests = dict[str, dict[str, str]]
"""Of a case: digest by part, by group."""


# --- digests ------------------------------------------------------------------------------------------------------------
def canonical(value: Any) -> bytes:
    """Bytes that are equal for equal values: every bit of an array, JSON with sorted keys of anything else."""
    if isinstance(value, bytes):
        return value
    if isinstance(value, np.ndarray) and value.dtype != object:
        if value.dtype.kind == "U":
            value = np.char.encode(value, "utf-8")
            value = value.astype(f"S{max(map(len, value.ravel()), default=0) or 1}")
        array = np.ascontiguousarray(value)
        return f"{array.dtype.str}{array.shape}".encode() + array.tobytes()
    return json.dumps(plain(value), sort_keys=True, ensure_ascii=False).encode()


def plain(value: Any) -> Any:
    """The value as JSON has it. Fields of records that have their default are left out: a new field changes no digest."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        named = {f.name: (getattr(value, f.name), f.default) for f in dataclasses.fields(value)}
        return {
            name: plain(v)
            for name, (v, default) in named.items()
            if isinstance(v, np.ndarray) or type(v) is not type(default) or v != default
        }
    if isinstance(value, np.ndarray):
        return plain(value.tolist()) if value.dtype == object else ["array", value.dtype.str, value.tolist()]
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, bytes):
        return hashlib.sha256(value).hexdigest()
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if value is None or isinstance(value, str | int | float):
        return value
    raise TypeError(f"{type(value).__name__} has no digest")


def digest(value: Any) -> str:
    """The first `DIGITS` hex digits of the SHA-256 of `canonical`."""
    return hashlib.sha256(canonical(value)).hexdigest()[:DIGITS]


@dataclass
class Prints:
    """Takes the values of a case and keeps their digests."""

    folder: Path | None = None
    """Where the values themselves are written, or None."""
    digests: Digests = field(default_factory=dict)

    def add(self, group: str, part: str, value: Any) -> None:
        """One part."""
        parts = self.digests.setdefault(group, {})
        assert part not in parts, f"{group}: {part} twice"
        parts[part] = digest(value)
        if self.folder is not None:
            at = self.folder / group.replace("/", "_")
            at.mkdir(parents=True, exist_ok=True)
            name = part.replace("/", "_")
            if isinstance(value, np.ndarray) and value.dtype != object:
                np.save(at / f"{name}.npy", value)
            elif isinstance(value, bytes):
                (at / name).write_bytes(value)
            else:
                (at / f"{name}.json").write_text(json.dumps(plain(value), indent=1, sort_keys=True))

    def recording(self, group: str, recording: Any) -> None:
        """All that a `Recording` says, but for versions and paths of programs and files."""
        for name, column in recording.columns.items():
            self.add(group, name, np.asarray(column))
        episode = recording.episode
        self.add(group, "order of columns", list(recording.columns))
        if "state_hash" in recording.columns:
            self.add(group, "final state_hash", str(recording.columns["state_hash"][-1:]))
        self.add(
            group, "episode",
            [episode.uid, episode.episode_id, episode.task, episode.scene, episode.seed, episode.dt_ns],
        )  # fmt: skip
        for name, value in episode.info.items():
            self.add(group, f"info.{name}", value)
        for name in ("agents", "bodies", "assets", "skills", "events", "inputs", "attachments"):
            self.add(group, name, getattr(recording, name))

    def steps(self, group: str, seen: Sequence[tuple[int, Mapping[str, Any]]]) -> None:
        """What an environment told at its steps: one part for each name, and the steps at which it was told."""
        told: dict[str, tuple[list[int], list[Any]]] = {}
        for step, values in seen:
            for name, value in values.items():
                at, listed = told.setdefault(name, ([], []))
                at.append(step)
                listed.append(value)
        for name, (at, listed) in told.items():
            self.add(group, name, np.array(listed))
            if len(at) != len(seen):
                self.add(group, f"{name}: steps", at)


# --- the arithmetic of this machine -------------------------------------------------------------------------------------
PACKAGES = ("numpy", "numba", "scipy", "torch", "shapely", "python-fcl", "trimesh", "opencv-python-headless", "embreex")


@functools.cache
def stamp() -> dict[str, str]:
    """What bits depend on: elementary functions as numpy and compiled kernels compute them here, and versions."""
    import shapely

    found = {"functions of numpy": digest(_by_numpy()), "functions of numba": digest(_by_numba())}
    for package in PACKAGES:
        try:
            found[package] = ".".join(importlib.metadata.version(package).split("+")[0].split(".")[:2])
        except importlib.metadata.PackageNotFoundError:
            found[package] = "absent"
    found["GEOS"] = ".".join(map(str, shapely.geos_version[:2]))
    return found


@functools.cache
def torch_stamp() -> str:
    """The same of torch, apart because importing it takes a second."""
    import torch

    x = torch.linspace(-20, 20, 4001, dtype=torch.float64)
    values = [torch.sin(x), torch.cos(x), torch.atan2(x, x.flip(0) + 0.1), torch.exp(x), torch.hypot(x, x.flip(0))]
    return digest(torch.stack([*values, *(v.float().sin().double() for v in values)]).numpy())


def _inputs(dtype: type) -> tuple[NDArray[Any], NDArray[Any]]:
    x = np.linspace(-20, 20, 4001).astype(dtype)
    return x, (x[::-1] * x + dtype(0.1)).astype(dtype)


def _by_numpy() -> NDArray[np.float64]:
    rows = []
    for dtype in (np.float32, np.float64):
        x, y = _inputs(dtype)
        rows += [np.sin(x), np.cos(x), np.arctan2(y, x), np.exp(x), np.hypot(x, y), np.sqrt(np.abs(y)), np.tan(x)]
        square = np.outer(np.sin(x[:64]), np.cos(y[:64])) + np.eye(64, dtype=dtype)
        rows += [np.resize(square @ square.T, x.shape), np.resize(np.add.reduce(np.outer(x[:99], y)), x.shape)]
    return np.array(rows, np.float64)


def _by_numba() -> NDArray[np.float64]:
    from numba import njit

    @njit
    def functions(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        rows = np.empty((len(x), 6))
        for k in range(len(x)):
            rows[k, 0], rows[k, 1], rows[k, 2] = np.sin(x[k]), np.cos(x[k]), np.arctan2(y[k], x[k])
            rows[k, 3], rows[k, 4] = np.exp(x[k]), np.hypot(x[k], y[k])
            rows[k, 5] = x[k] * y[k] + rows[k, 0] * rows[k, 1] - x[k] * rows[k, 2]
        return rows

    return functions(*_inputs(np.float64))


# --- helpers of the cases -----------------------------------------------------------------------------------------------
def command(*words: str | Path, codes: Sequence[int] = (0,)) -> Any:
    """What ``h3data words --json`` prints; it ends with one of some exit codes."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
        ended = run_command([*map(str, words), "--json"])
    assert ended in codes, f"h3data {' '.join(map(str, words))} ended with {ended}: {out.getvalue()}"
    return json.loads(out.getvalue())


PROFILES = {
    "social_nav": ("paper", "habitat", "habitat@0.3.0", "field"),
    "rearrange": ("paper", "field"),
    "wander": ("field",),
}


def measure(prints: Prints, task: str, dataset: Path) -> None:
    """Metrics of a dataset in all profiles."""
    for profile in PROFILES[task]:
        table = command("metrics", dataset, "--profile", profile, codes=(0, 2))
        if "error" in table:  # as for a single person
            prints.add(f"metrics {profile}", "refused", True)
        else:
            add_table(prints, f"metrics {profile}", table)


def add_table(prints: Prints, group: str, table: Any) -> None:
    """A table of metrics: a part for each metric, and one for what else is said of the episodes."""
    rows = table["episodes"]
    for name, what in table["metrics"].items():
        values = [row["values"].get(name) for row in rows], [row["notes"].get(name) for row in rows]
        prints.add(group, name, [what, table["summary"].get(name), *values])
    prints.add(group, "episodes", [{k: v for k, v in row.items() if k not in ("values", "notes")} for row in rows])


def generate(prints: Prints, out: Path, task: str, *options: str) -> None:
    """Episodes that ``h3data generate`` makes, and their metrics."""
    told = command("generate", task, *options, "-o", out / "ds", codes=(0, 1))  # 1: some episodes failed
    prints.add("told", "generate", {name: told[name] for name in ("episodes", "steps", "state_hashes", "failed")})
    dataset = h3data.open(out / "ds")
    for k in range(told["episodes"]):
        recording = dataset.recording(k)
        prints.recording(f"episode {recording.episode.episode_id}", recording)
    measure(prints, task, out / "ds")


def replay(prints: Prints, out: Path, task: str, resumed: Sequence[int], *options: str, other: Sequence[str]) -> None:
    """One episode verified; resumed at some steps, by itself and by another policy; another robot beside its people."""
    command("generate", task, "--episodes", "1", *options, "--mcap", "-o", out / "ds")
    log = out / "ds" / "mcap" / "000000.mcap"
    prints.recording("the log", h3data.open(log))
    told = command("replay", log, "--verify")["episodes"][0]
    prints.add("verify", "told", {name: told[name] for name in ("equal", "steps", "difference")})

    def again(group: str, *words: str) -> None:
        told = command("replay", log, *words, "-o", out / "again.mcap", "--force")
        told.pop("recording")
        prints.add(group, "told", told)
        prints.recording(group, h3data.open(out / "again.mcap"))

    for step in resumed:
        again(f"resume from {step}", "--resume-from", str(step))
    if other:
        again(f"resume from {resumed[-1]}, {other[0]}", "--resume-from", str(resumed[-1]), "--policy", other[0])
        again(f"counterfactual {other[0]}", "--counterfactual", "--policy", other[0])
        again(f"counterfactual {other[0]} from {resumed[0]}", "--counterfactual", "--policy", other[0], "--resume-from",
              str(resumed[0]))  # fmt: skip
    for partner in other[1:]:
        again(f"resume from {resumed[-1]}, partner {partner}", "--resume-from", str(resumed[-1]), "--partner", partner)


HOLD = 12
"""A random action is held for so many steps, so that agents get somewhere."""


def act(space: Any, rng: np.random.Generator, info: Mapping[str, Any], width: tuple[int, ...] = ()) -> Any:
    """A random action, of those that the info says are possible where these are numbers."""
    if hasattr(space, "n"):
        return int(rng.choice(np.flatnonzero(info["action_mask"])))
    return (rng.uniform(-1, 1, (*width, *space.shape)) * 1.2).astype(np.float32)


def single(prints: Prints, _: Path, task: str, steps: int, **options: Any) -> None:
    """An environment of one agent."""
    env = make(task, **options)
    rng = np.random.default_rng(11)
    observed, info = env.reset(seed=3)
    seen, action, over = [(0, _named(observed, info))], None, False
    for step in range(1, steps + 1):
        if over:
            observed, info = env.reset()
            seen.append((step, _named(observed, info)))
            over = False
            continue
        if hasattr(env.action_space, "n") or step % HOLD == 1 or action is None:
            action = act(env.action_space, rng, info)
        observed, reward, terminated, truncated, info = env.step(action)
        seen.append(
            (step, {**_named(observed, info), "reward": reward, "terminated": terminated, "truncated": truncated})
        )
        over = terminated or truncated
    prints.steps(f"{steps} steps", seen)
    prints.add(f"{steps} steps", "spaces", [str(env.observation_space), str(env.action_space), repr(env)])


def vector(prints: Prints, _: Path, task: str, worlds: int, steps: int, **options: Any) -> None:
    """An environment of many worlds, which begins the next episodes by itself."""
    env = make(task, num_envs=worlds, **options)
    rng = np.random.default_rng(12)
    observed, info = env.reset(seed=3)
    seen, action = [(0, _named(observed, info))], None
    for step in range(1, steps + 1):
        if hasattr(env.single_action_space, "n"):
            masks = np.stack(list(info["action_mask"]))
            action = np.array([int(rng.choice(np.flatnonzero(mask))) for mask in masks])
        elif step % HOLD == 1 or action is None:
            action = act(env.single_action_space, rng, info, (worlds,))
        observed, reward, terminated, truncated, info = env.step(action)
        seen.append(
            (step, {**_named(observed, info), "reward": reward, "terminated": terminated, "truncated": truncated})
        )
    prints.steps(f"{worlds} worlds", seen)
    env.close()


def parallel(prints: Prints, _: Path, task: str, steps: int, **options: Any) -> None:
    """An environment of a robot and a person who both learn."""
    env = make(task, agents=("robot", "human"), **options)
    rng = np.random.default_rng(13)
    observed, infos = env.reset(seed=3)
    seen: dict[str, list[tuple[int, dict[str, Any]]]] = {name: [] for name in env.possible_agents}
    actions: dict[str, Any] = {}
    for name in env.possible_agents:
        seen[name].append((0, _named(observed[name], infos[name])))
    for step in range(1, steps + 1):
        if not env.agents:
            observed, infos = env.reset()
            for name in env.possible_agents:
                seen[name].append((step, _named(observed[name], infos[name])))
            continue
        for name in env.agents:
            space = env.action_space(name)
            if hasattr(space, "n") or step % HOLD == 1 or name not in actions:
                actions[name] = act(space, rng, infos[name])
        observed, reward, terminated, truncated, infos = env.step({name: actions[name] for name in env.agents})
        for name in env.possible_agents:
            ends = {"reward": reward[name], "terminated": terminated[name], "truncated": truncated[name]}
            seen[name].append((step, {**_named(observed[name], infos[name]), **ends}))
    for name, told in seen.items():
        prints.steps(name, told)


def tensors(prints: Prints, _: Path, worlds: int, steps: int, **options: Any) -> None:
    """Social navigation in torch on the CPU, in float64."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        env = make("social_nav", num_envs=worlds, device="cpu", dtype=torch.float64, compile=False, **options)
        rng = np.random.default_rng(14)
        observed, info = env.reset(seed=3)
        seen, action = [(0, _named(observed, info))], torch.zeros((worlds, 2))
        for step in range(1, steps + 1):
            if step % HOLD == 1:
                action = torch.from_numpy(rng.uniform(-1.2, 1.2, (worlds, 2)))
            observed, reward, terminated, truncated, info = env.step(action)
            ends = {"reward": reward, "terminated": terminated, "truncated": truncated}
            seen.append((step, {**_named(observed, info), **{name: end.numpy() for name, end in ends.items()}}))
    finally:
        torch.set_num_threads(threads)
    prints.steps(f"{worlds} worlds", seen)


def _named(observed: Mapping[str, Any], info: Mapping[str, Any]) -> dict[str, Any]:
    """All that is seen and told, copied, by name."""
    told = {f"sees {name}": value for name, value in observed.items()}
    told |= {f"info {name}": value for name, value in info.items() if name[0] != "_"}
    return {name: np.array(value.numpy() if hasattr(value, "numpy") else value) for name, value in told.items()}


def habitat(prints: Prints, _: Path, task: str, homes: Sequence[int], seeds: Sequence[int]) -> None:
    """Episodes under Habitat's rules of movement."""
    for number in homes:
        home = h3data.build_home(h3data.HomeSpec(preset="small", seed=number))
        for seed in seeds:
            recording = simulated(task, home, seed=seed, rules=habitat_rules(task))
            prints.recording(f"home {number} seed {seed}", recording)
            for profile in PROFILES[task]:
                found = h3data.measure(recording, profile=profile)
                prints.add(f"metrics {profile}", f"home {number} seed {seed}", found.values)


# --- the cases ----------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, kw_only=True)
class Case:
    """Something that is computed and compared."""

    name: str
    make: Callable[[Prints, Path], None]
    """Computes it, with a folder for its files."""
    quick: bool = False
    """Whether it is part of the ordinary test run."""
    needs: tuple[str, ...] = ()
    """Packages without which it is skipped."""

    def missing(self) -> str:
        """Why it cannot be computed here, or nothing."""
        lacking = [name for name in self.needs if importlib.util.find_spec(name) is None]
        return f"needs {', '.join(lacking)}" if lacking else ""


ENV = ("gymnasium", "pettingzoo")
HOMES = ("small:0", "small:3", "medium:1")
SCENES = ["small:1", "small:4"]
SOCIAL_NAV_SENSES = ["humanoid_gps", "egomotion", "localization", "localization_in_start_frame", "humanoid_in_start_frame",
                     "collision", "arm_joints", "is_holding", "humanoid_velocity", "way", "range_scan"]  # fmt: skip
REARRANGE_SENSES = [
    "humanoid_gps", "egomotion", "localization", "localization_in_start_frame", "humanoid_in_start_frame", "collision",
    "arm_joints", "is_holding", "obj_start_gps_compass", "obj_goal_gps_compass", "obj_gps_compass", "obj_start_sensor",
    "obj_goal_sensor", "obj_sensor", "obj_start_in_start_frame", "obj_goal_in_start_frame", "obj_in_start_frame", "holds",
    "held_by_other", "at_goal", "other_agent_gps", "other_gps_compass", "close", "last_done", "interrupted",
]  # fmt: skip
PICTURES = ["arm_depth", "humanoid_detector", "humanoid_mask", "humanoid_box", "left_depth", "front_left_rgb"]


def _cases() -> Iterator[Case]:
    def generated(name: str, *options: str, quick: bool = False) -> Case:
        task = name.partition(" ")[0]
        return Case(name=f"generate {name}", make=lambda p, out: generate(p, out, task, *options), quick=quick)

    for task in PROFILES:
        yield generated(f"{task} once", "--scenes", "small:1", "--episodes", "1", "--seed", "5", quick=True)
        for home in HOMES:
            yield generated(f"{task} in {home}", "--scenes", home, "--episodes", "10", "--seed", "21")
        few = ("--episodes", "5") if task == "rearrange" else ()
        yield generated(f"{task} by default", *few)
        yield generated(f"{task} with anybody", "--human", "any", "--human-speed", "1.3", "--episodes", "3",
                        "--max-steps", "900", "--spawn-distance", "3", "--seed", "8", "--scenes", "medium")  # fmt: skip
        yield generated(f"{task} of a set", "--scenes", "h3-homes/test", "--episodes", "3")
    for policy in ("plain_expert", "sampling_expert", "future_oracle", "learned_follower", "random", "stand_still"):
        yield generated(f"social_nav by {policy}", "--policy", policy, "--episodes", "3", "--max-steps", "600",
                        "--scenes", "small:3")  # fmt: skip
    yield generated("rearrange that fails twice", "--human", "any", "--human-speed", "1.3", "--episodes", "3",
                    "--max-steps", "500", "--seed", "8", "--scenes", "medium")  # fmt: skip
    for policy in ("greedy_nearest", "same_object", "still", "solo"):
        yield generated(f"rearrange by {policy}", "--policy", policy, "--episodes", "2", "--scenes", "small:3")
    for partner in ("object_1", "object_2", "still", "plan_pop_1", "plan_pop_2", "plan_pop_3", "plan_pop_4"):
        yield generated(f"rearrange with {partner}", "--partner", partner, "--episodes", "2", "--scenes", "small:0")
    for agents, *more in (
        ("robot,robot",), ("robot,robot", "--policy", "complement,both"), ("human,human",), ("robot,robot,human",),
        ("robot,human,male_1", "--partner", "both,object_1"), ("human",), ("lift_arm,human",),
    ):  # fmt: skip
        yield generated(f"rearrange of {' '.join([agents, *more[1:]])}", "--agents", agents, *more, "--episodes", "2",
                        "--scenes", "medium:1", "--seed", "3")  # fmt: skip
    for agents in (
        "robot,human,human",
        "robot,lift_arm,female_1",
        "human,human",
        "robot,robot,robot,human,human,human",
    ):
        yield generated(f"wander of {agents}", "--agents", agents, "--human", "any", "--episodes", "3", "--scenes",
                        "medium:1", "--seed", "3")  # fmt: skip
    for task in ("social_nav", "rearrange"):
        yield Case(
            name=f"{task} as in Habitat", make=lambda p, out, task=task: habitat(p, out, task, (0, 3), (0, 1, 2))
        )

    yield Case(
        name="replay social_nav",
        make=lambda p, out: replay(p, out, "social_nav", (1, 150, 700), "--scenes", "small:1", other=("plain_expert",)),
    )
    yield Case(
        name="replay rearrange",
        make=lambda p, out: replay(
            p, out, "rearrange", (1, 60, 130), "--scenes", "small:1", other=("greedy_nearest", "object_2")
        ),
    )
    yield Case(
        name="replay rearrange of robot,robot,human",
        make=lambda p, out: replay(
            p, out, "rearrange", (60,), "--scenes", "small:1", "--agents", "robot,robot,human", other=("still",)
        ),
    )
    yield Case(
        name="replay wander",
        make=lambda p, out: replay(
            p, out, "wander", (1, 100, 299), "--scenes", "small:1", "--agents", "robot,human,human", other=()
        ),
    )
    yield Case(
        name="replay wander once",
        make=lambda p, out: replay(p, out, "wander", (40,), "--scenes", "small:1", "--max-steps", "80", other=()),
        quick=True,
    )

    def environment(name: str, make: Callable[..., None], *arguments: Any, quick: bool = False, **options: Any) -> Case:
        return Case(
            name=f"environment {name}",
            make=lambda p, out: make(p, out, *arguments, **{"scenes": SCENES, **options}),
            quick=quick,
            needs=ENV,
        )

    nav: dict[str, Any] = {"observations": SOCIAL_NAV_SENSES}
    rearrange: dict[str, Any] = {"observations": REARRANGE_SENSES}
    yield environment("social_nav once", single, "social_nav", 100, scenes="small:1", quick=True, **nav)
    yield environment("social_nav", single, "social_nav", 1000, **nav)
    yield environment("social_nav by default", single, "social_nav", 1000, scenes="h3-homes/train#3")
    yield environment("social_nav with Habitat's reward", single, "social_nav", 1000, reward="habitat", robot="lift_arm",
                      human="male_1", end_on_success=True)  # fmt: skip
    yield environment("social_nav as in Habitat", lambda p, out, **o: single(
        p, out, "social_nav", 1000, spec=habitat_rules("social_nav"), **o))  # fmt: skip
    yield environment("social_nav pictures", single, "social_nav", 60, observations=PICTURES)
    yield environment("social_nav 4 worlds once", vector, "social_nav", 4, 100, scenes="small:1", quick=True, **nav)
    yield environment("social_nav 64 worlds", vector, "social_nav", 64, 1000, **nav)
    yield environment("social_nav 4 worlds with pictures", vector, "social_nav", 4, 30, observations=PICTURES)
    yield environment(
        "social_nav robot and human once", parallel, "social_nav", 100, scenes="small:1", quick=True, **nav
    )
    yield environment("social_nav robot and human", parallel, "social_nav", 1000, **nav)
    yield dataclasses.replace(
        environment("social_nav in torch", tensors, 8, 1000, episodes=32, observations=[
            "humanoid_gps", "egomotion", "localization", "humanoid_velocity", "way", "range_scan"]),
        needs=("torch", *ENV),
    )  # fmt: skip
    yield environment(
        "rearrange once", single, "rearrange", 100, scenes="small:1", level="low", quick=True, **rearrange
    )
    yield environment("rearrange by skills once", single, "rearrange", 20, scenes="small:1", quick=True, **rearrange)
    yield environment("rearrange by skills", single, "rearrange", 400, **rearrange)
    yield environment("rearrange by velocities", single, "rearrange", 1000, level="low", **rearrange)
    yield environment("rearrange person", single, "rearrange", 60, agents=("human",), interrupts_when_close=False)
    yield environment("rearrange with Habitat's rules", lambda p, out, **o: single(
        p, out, "rearrange", 300, spec=habitat_rules("rearrange"), partner="both", **o), **rearrange)  # fmt: skip
    yield environment("rearrange pictures", single, "rearrange", 40, observations=PICTURES, level="low")
    yield environment("rearrange 4 worlds by skills", vector, "rearrange", 4, 150, **rearrange)
    yield environment("rearrange 4 worlds by velocities", vector, "rearrange", 4, 300, level="low", **rearrange)
    yield environment("rearrange robot and human by skills", parallel, "rearrange", 400, **rearrange)
    yield environment("rearrange robot and human by velocities", parallel, "rearrange", 800, level="low", **rearrange)


CASES: dict[str, Case] = {case.name: case for case in _cases()}


# --- storing and comparing ----------------------------------------------------------------------------------------------
def computed(case: Case, *, keep: Path | None = None) -> Digests:
    """The digests of a case, computed now; ``keep`` is a folder for the values."""
    prints = Prints(folder=None if keep is None else keep / case.name.replace("/", "_"))
    with tempfile.TemporaryDirectory() as folder:
        case.make(prints, Path(folder))
    return prints.digests


def differences(stored: Digests, found: Digests) -> list[str]:
    """What moved, one line for each group."""
    lines = []
    for group in dict.fromkeys([*stored, *found]):
        old, new = stored.get(group), found.get(group)
        if old is None or new is None:
            lines.append(f"{group}: {'not stored' if old is None else 'no longer computed'}")
            continue
        told = [
            (what, parts)
            for what, parts in (
                ("differ", [part for part in old if part in new and old[part] != new[part]]),
                ("are gone", [part for part in old if part not in new]),
                ("are new", [part for part in new if part not in old]),
            )
            if parts
        ]
        lines += [f"{group}: {', '.join(parts)} {what}" for what, parts in told]
    return lines


def read(file: Path = FILE) -> dict[str, Any]:
    """``stamp``, ``torch`` and ``cases``, as stored."""
    return json.loads(file.read_text()) if file.exists() else {"stamp": {}, "torch": "", "cases": {}}


def write(stored: Mapping[str, Any], file: Path = FILE) -> None:
    """A line for each group, so that a change of the file shows what moved."""
    cases = []
    for name in sorted(stored["cases"]):
        groups = [f"  {json.dumps(group)}: {json.dumps(parts)}" for group, parts in stored["cases"][name].items()]
        cases.append(f" {json.dumps(name)}: {{\n" + ",\n".join(groups) + "\n }")
    head = f'"stamp": {json.dumps(stored["stamp"], indent=1)},\n"torch": {json.dumps(stored["torch"])}'
    file.write_text(f'{{\n{head},\n"cases": {{\n' + ",\n".join(cases) + "\n}\n}\n")


def elsewhere(stored: Mapping[str, Any], *, torch: bool = False) -> str:
    """In what the arithmetic of this machine is not that of the stored digests, or nothing."""
    here, there = stamp(), stored["stamp"]
    moved = [
        f"{name} {there.get(name, 'absent')} there, {here.get(name, 'absent')} here"
        for name in dict.fromkeys([*there, *here])
        if there.get(name) != here.get(name)
    ]
    if torch and stored["torch"] != torch_stamp():
        moved.append("functions of torch")
    return "; ".join(moved)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; 1 if something differs."""
    parser = argparse.ArgumentParser(prog="python -m tests.fingerprints", description="Digests of what is computed.")
    parser.add_argument("names", nargs="*", help="only cases whose names contain one of these")
    parser.add_argument("--renew", action="store_true", help="store instead of compare")
    parser.add_argument("--list", action="store_true", help="list the cases")
    parser.add_argument("--file", type=Path, default=FILE, help="the stored digests")
    parser.add_argument("--keep", type=Path, help="a folder for the values")
    options = parser.parse_args(arguments)
    chosen = [c for c in CASES.values() if not options.names or any(word in c.name for word in options.names)]
    if options.list:
        print("\n".join(f"{case.name}{'  (quick)' if case.quick else ''}" for case in chosen))
        return 0
    stored = read(options.file)
    other = elsewhere(stored)
    if other and stored["cases"] and not (options.renew and not options.names):
        print(f"The stored digests are of another arithmetic: {other}", file=sys.stderr)
        if options.renew:
            print("Renew all of them.", file=sys.stderr)
            return 1
    failed = 0
    for case in chosen:
        began = time.perf_counter()
        why = case.missing()
        if why:
            print(f"skipped    {case.name}: {why}")
            continue
        found = computed(case, keep=options.keep)
        took = f"{time.perf_counter() - began:.1f} s"
        if options.renew:
            lines = differences(stored["cases"].get(case.name, {}), found)
            stored["cases"][case.name] = found
            stored["stamp"], stored["torch"] = stamp(), torch_stamp()
            write(stored, options.file)
        else:
            lines = differences(stored["cases"][case.name], found) if case.name in stored["cases"] else ["not stored"]
            failed += bool(lines)
        print("\n    ".join([f"{'different' if lines else 'equal':<10} {case.name} ({took})", *lines[:20]]), flush=True)
    if options.renew:
        stored["cases"] = {name: groups for name, groups in stored["cases"].items() if name in CASES}
        write(stored, options.file)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
