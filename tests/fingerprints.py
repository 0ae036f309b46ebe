"""What the product computes, as digests: recordings, environments, replays, metrics, exports, pictures.

    python tests/fingerprints.py                        compare everything with tests/data/fingerprints/
    python tests/fingerprints.py NAME...                only the cases whose names contain one of these words
    python tests/fingerprints.py --renew [NAME...]      compute again and store
    python tests/fingerprints.py --list                 names of all cases
    python tests/fingerprints.py NAME --keep FOLDER     also write the values themselves, to compare those of two commits

A case has groups (one recording, one profile of metrics, one environment), a group has parts (one column, one metric, one
observation), and every part has its own digest, so a difference is named by case, group and part.

Floating-point results differ between types of CPU and versions of libraries. There is a file for each type of CPU, and its
`stamp` says on which arithmetic it was stored. A case that moved when it was renewed on one type is taken out of the files of
the others, to be computed there. On an arithmetic that no file has, store the digests of the commit before a change and compare
the change with them:

    git checkout BEFORE && python tests/fingerprints.py --renew --file /tmp/before.json
    git checkout AFTER && python tests/fingerprints.py --file /tmp/before.json
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import gzip
import hashlib
import importlib.metadata
import importlib.util
import io
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import h3data
from h3data import make

# --- adapter: all that is imported from below the public entry points --------------------------------------------------
from h3data.pseudonyms import KEY_VARIABLE
from h3data_pipelines.cli import main as run_command


def habitat_rules(task: str) -> Any:
    """The rules of a task with sliding and people as in Habitat."""
    from sim_kinematic.motion.spec import BaseSpec, SocialNavSpec, WalkerSpec
    from sim_kinematic.tasks.rearrange.episode import RearrangeSpec

    moves: dict[str, Any] = {"robot": BaseSpec(slide="habitat"), "human": WalkerSpec()}
    if task == "social_nav":
        return SocialNavSpec(max_steps=600, **moves)
    return RearrangeSpec(reward="habitat", arm_rad_s=float("inf"), **moves)


def simulated(task: str, home: Any, *, seed: int, rules: Any) -> Any:
    """The recording of one episode of a task under any rules, with its default policies."""
    from sim_kinematic.tasks.recorder import simulate
    from sim_kinematic.tasks.registry import find_task

    found = find_task(task)
    return simulate(found, found.episode(home, seed=seed, spec=rules))


# --- end of the adapter -------------------------------------------------------------------------------------------------

FOLDER = Path(__file__).parent / "data" / "fingerprints"
"""A file for each type of CPU, named after its `vectors`."""
REAL = Path(__file__).resolve().parents[2] / "shared" / "real"
"""Real Habitat files, as of the fixture ``real``."""
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
    places: Mapping[str, str] = field(default_factory=dict)
    """What texts say instead of paths and versions of this machine."""
    digests: Digests = field(default_factory=dict)

    def add(self, group: str, part: str, value: Any) -> None:
        """One part."""
        parts = self.digests.setdefault(group, {})
        assert part not in parts, f"{group}: {part} twice"
        if not isinstance(value, np.ndarray) or value.dtype == object:
            value = self._everywhere(value)
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

    def _everywhere(self, value: Any) -> Any:
        """The value without what only this machine has."""
        if isinstance(value, bytes):
            for place, name in self.places.items():
                value = value.replace(place.encode(), name.encode())
            return value
        text = json.dumps(plain(value), ensure_ascii=False)
        for place, name in self.places.items():
            text = text.replace(place, name)
        return json.loads(text)

    def recording(self, group: str, recording: Any) -> None:
        """All that a `Recording` says, but for versions and paths of programs and files."""
        for name, column in recording.columns.items():
            self.add(group, name, np.asarray(column))
        episode = recording.episode
        self.add(group, "order of columns", list(recording.columns))
        if "state_hash" in recording.columns:
            self.add(group, "final state_hash", str(recording.columns["state_hash"][-1:]))
        self.add(group, "uid", episode.uid)
        self.add(group, "episode", [episode.episode_id, episode.task, episode.scene, episode.seed, episode.dt_ns])
        for name, value in episode.info.items():
            self.add(group, f"info.{name}", value)
        for name in ("agents", "bodies", "assets", "skills", "events", "inputs"):
            self.add(group, name, getattr(recording, name))
        files = recording.attachments.items()
        self.add(group, "attachments", {name: _of_glb(f) if self._names_place(f) else f for name, f in files})

    def _names_place(self, file: bytes) -> bool:
        return any(place.encode() in file for place in self.places)

    def files(self, group: str, folder: Path) -> None:
        """Contents of all files below a folder; those of a folder with many are one part."""
        found: dict[Path, dict[str, Any]] = {}
        for path in sorted(p for p in folder.rglob("*") if p.is_file()):
            found.setdefault(path.parent, {})[path.name] = path
        for at, paths in found.items():
            where = at.relative_to(folder)
            if len(paths) > MANY:
                told = {name: digest(self._everywhere(contents(path))) for name, path in paths.items()}
                self.add(group, f"{where}/*", told)
            else:
                for name, path in paths.items():
                    self.add(group, str(where / name), contents(path))

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


# --- contents of files --------------------------------------------------------------------------------------------------
MANY = 12


def contents(path: Path) -> Any:
    """What a file says: its bytes, or what they mean where a library's version or compression decides about bytes."""
    kind = "".join(path.suffixes[-2:] if path.suffix == ".gz" else path.suffixes[-1:])
    reader = {
        ".json": lambda: json.loads(path.read_bytes()),
        ".json.gz": lambda: json.loads(gzip.decompress(path.read_bytes())),
        ".parquet": lambda: _of_parquet(path),
        ".npz": lambda: _of_npz(path),
        ".hdf5": lambda: _of_hdf5(path),
        ".mcap": lambda: _of_mcap(path),
        ".png": lambda: _of_picture(path),
    }.get(kind, path.read_bytes)
    return reader()


def _of_glb(file: bytes) -> Any:
    """What the chunks of a GLB file say: paths in it move its bytes."""
    size = int.from_bytes(file[12:16], "little")
    return [json.loads(file[20 : 20 + size]), file[28 + size :]]


def _of_parquet(path: Path) -> Any:
    import pyarrow.parquet

    table = pyarrow.parquet.read_table(path)
    own = {k.decode(): v for k, v in (table.schema.metadata or {}).items() if not k.startswith((b"ARROW", b"pandas"))}
    return [{name: [str(table.schema.field(name).type), table[name].to_pylist()] for name in table.column_names}, own]


def _of_npz(path: Path) -> Any:
    with np.load(path) as file:
        return {name: digest(file[name]) for name in file.files}


def _of_hdf5(path: Path) -> Any:
    import h5py

    found: dict[str, Any] = {}

    def note(name: str, node: Any) -> None:
        found[name] = [{k: str(v) for k, v in node.attrs.items()}]
        if isinstance(node, h5py.Dataset):
            found[name].append(digest(np.asarray(node[()])))

    with h5py.File(path) as file:
        note("/", file)
        file.visititems(note)
    return found


def _of_mcap(path: Path) -> Any:
    from mcap.reader import make_reader

    with path.open("rb") as stream:
        reader = make_reader(stream)
        rows = [
            [s.name if s else "", c.topic, m.log_time, m.publish_time, m.data] for s, c, m in reader.iter_messages()
        ]
        files = [[a.name, a.media_type, a.log_time, a.data] for a in reader.iter_attachments()]
        return [rows, files, [[m.name, m.metadata] for m in reader.iter_metadata()]]


def _of_picture(path: Path) -> Any:
    import cv2

    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert picture is not None, path
    return digest(picture)


# --- the arithmetic of this machine -------------------------------------------------------------------------------------
PACKAGES = (
    "numpy",
    "numba",
    "scipy",
    "torch",
    "shapely",
    "python-fcl",
    "trimesh",
    "opencv-python-headless",
    "pillow",
    "embreex",
)


@functools.cache
def stamp() -> dict[str, str]:
    """What bits depend on: elementary functions as numpy and compiled kernels compute them here, and versions."""
    import shapely

    found = {"functions of numpy": digest(_by_numpy()), "functions of numba": digest(_by_numba())}
    found["vectors"] = vectors()  # the rasteriser is written for them
    for package in PACKAGES:
        try:
            found[package] = ".".join(importlib.metadata.version(package).split("+")[0].split(".")[:2])
        except importlib.metadata.PackageNotFoundError:
            found[package] = "absent"
    found["GEOS"] = ".".join(map(str, shapely.geos_version[:2]))
    return found


def vectors() -> str:
    """The vector instructions of this CPU that change bits."""
    from llvmlite import binding

    has = binding.get_host_cpu_features()
    return " ".join(name for name in ("avx2", "fma", "avx512f", "neon", "sve") if has.get(name))


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
    "social_nav": ("paper", "habitat", "habitat@0.3.0", "field", "social"),
    "rearrange": ("paper", "field"),
    "wander": ("field", "social"),
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
    prints.add(
        group, "episodes", [{k: v for k, v in row.items() if k not in ("values", "notes", "uid")} for row in rows]
    )


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
        prints.add(group, "told", {k: v for k, v in told.items() if k not in ("recording", "uid", "of")})
        prints.recording(group, h3data.open(out / "again.mcap"))

    for step in resumed:
        again(f"resume from {step}", "--resume-from", str(step))
    if other:
        again(f"resume from {resumed[-1]}, {other[0]}", "--resume-from", str(resumed[-1]), "--policy", other[0])
        again(f"counterfactual {other[0]}", "--counterfactual", "--policy", other[0])
        again(
            f"counterfactual {other[0]} from {resumed[0]}",
            "--counterfactual",
            "--policy",
            other[0],
            "--resume-from",
            str(resumed[0]),
        )
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
    for name, value in (
        ("observation_space", env.observation_space),
        ("action_space", env.action_space),
        ("repr", env),
    ):
        prints.add(f"{steps} steps", name, str(value))


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


LENGTH = {"social_nav": "400", "rearrange": "1500", "wander": "300"}
"""Most steps of short episodes."""


def stores(prints: Prints, out: Path) -> None:
    """Recordings from a dataset to logs and back, through both stores."""
    for task in PROFILES:
        command(
            "generate",
            task,
            "--scenes",
            "small:1",
            "--episodes",
            "2",
            "--seed",
            "4",
            "--max-steps",
            LENGTH[task],
            "-o",
            out / task,
            codes=(0, 1),
        )
        command("convert", out / task, out / f"{task} logs")
        command("convert", out / f"{task} logs", out / f"{task} again")
        for path in sorted((out / f"{task} logs").glob("*.mcap")):
            prints.recording(f"{task} log {path.stem}", h3data.open(path))
        again = h3data.open(out / f"{task} again")
        for k in range(len(again)):
            prints.recording(f"{task} dataset {k}", again.recording(k))
    told = command("validate", *(out / task for task in PROFILES))
    prints.add("told", "validate", told)


def tables(prints: Prints, out: Path) -> None:
    """Two runs beside each other, the series and events that metrics come from, and evaluations."""
    for policy in ("rollout_expert", "heuristic_expert"):
        command(
            "generate",
            "social_nav",
            "--policy",
            policy,
            "--episodes",
            "6",
            "--max-steps",
            "600",
            "--scenes",
            "small:3",
            "-o",
            out / policy,
        )
    one, other = out / "rollout_expert", out / "heuristic_expert"
    prints.add("paired", "social_nav", command("metrics", one, other, "--paired"))
    command("metrics", one, "--series", out / "series.csv", "--events", out / "events.csv", "-o", out / "table.csv")
    for name in ("series.csv", "events.csv", "table.csv"):
        prints.add("files", name, (out / name).read_bytes())
    prints.add(
        "evaluate",
        "social_nav",
        command(
            "evaluate",
            "social_nav",
            "--policies",
            "rollout_expert,random",
            "--episodes",
            "3",
            "--max-steps",
            "300",
            "--scenes",
            "small:3",
            "-o",
            out / "follow",
        ),
    )
    prints.add(
        "evaluate",
        "rearrange",
        command(
            "evaluate",
            "rearrange",
            "--policies",
            "complement,still",
            "--partners",
            "both,object_1",
            "--episodes",
            "2",
            "--scenes",
            "small:3",
            "-o",
            out / "tidy",
        ),
    )
    command("generate", "rearrange", "--scenes", "small:3", "--episodes", "1", "-o", out / "ds")
    recording = h3data.open(out / "ds").recording(0)
    episode = recording.episode
    event = recording.events[0]
    for kinds in (("progress", "place"), ("place",), ("progress", "progress")):
        told = dataclasses.replace(
            recording,
            episode=dataclasses.replace(episode, info={**episode.info, "satisfied_at": [9, 40]}),
            events=tuple(
                dataclasses.replace(event, step=9 + 31 * k, agent=k, kind=kind) for k, kind in enumerate(kinds)
            ),
        )
        prints.add("partnr", " ".join(kinds), h3data.measure(told, profile="partnr").values)


SET = """
format = 1
name = "two-homes"
split = "test"
about = "two small homes"
scenes = [
  { id = "one", seed = 31, preset = "small", area_m2 = 68.1, bedrooms = 1, bathrooms = 1, clutter = 0.6 },
  { id = "two", seed = 32, preset = "medium", area_m2 = 121.0, bedrooms = 2, bathrooms = 1, clutter = 1.5 },
]
[social_nav]
episodes_per_scene = 2
spawn_distance_m = 4.0
"""


def scenes(prints: Prints, out: Path) -> None:
    """Homes as files, sets of homes, and episodes of such a set from a Habitat episode file."""
    (out / "set.toml").write_text(SET)
    told = command("scenes", "export", out / "set.toml", "-o", out / "habitat")
    prints.files("habitat", out / "habitat")
    (episodes,) = told["episodes"] if isinstance(told["episodes"], list) else [told["episodes"]]
    generate(prints, out / "file", "social_nav", "--episodes-file", str(episodes), "--max-steps", "200")
    command("generate", "wander", "--scenes", str(out / "set.toml"), "--max-steps", "60", "-o", out / "wander")
    prints.recording("wander", h3data.open(out / "wander").recording(3))
    for home in ("small:3", "large:0"):
        command("scenes", "export", home, "--to", "glb", "-o", out / "glb")
    prints.files("glb", out / "glb")
    prints.add("told", "validate", command("scenes", "validate", "small:3", "medium:0", codes=(0, 1)))
    command("scenes", "show", "small:3", "-o", out / "show" / "home.png")
    prints.files("show", out / "show")


def in_habitat_scene(prints: Prints, out: Path, task: str) -> None:
    """Episodes in a scene of Habitat."""
    room = REAL / "habitat-sim/data/test_assets/scenes/simple_room.stage_config.json"
    generate(prints, out, task, "--scenes", str(room), "--episodes", "2", "--max-steps", "200", "--spawn-distance", "2")


def imports(prints: Prints, out: Path) -> None:
    """All recordings among the real files: imported, stored as a dataset, measured, brought back."""
    folders = [REAL / "habitat-sim", REAL / "habitat-lab" / "reference" / "navmesh"]
    assets = [word for folder in folders for word in ("--assets", folder)]
    key = out / "participants.key"
    key.write_bytes(bytes(32))
    os.environ[KEY_VARIABLE] = str(key)  # pseudonyms depend on it
    told = command("import", REAL, "-o", out / "rec", *assets)
    prints.add("told", "import", [row for row in told["files"] if row["status"] == "imported"])
    prints.add("told", "kinds", {row["source"]: [row["status"], row["kind"]] for row in told["files"]})
    logs = sorted((out / "rec").rglob("*.mcap"))
    for path in logs:
        name = str(path.relative_to(out / "rec"))
        recording = h3data.open(path)
        prints.recording(name, recording)
        replay = h3data.Replay(recording, assets=folders)
        prints.add(name, "missing assets", replay.missing)
        prints.add(name, "state of the middle", replay.at(len(recording) // 2))
        for index, thing in enumerate(replay.drawables):
            if thing.deformable:
                prints.add(name, f"vertices of {thing.name}", replay.vertices(index, np.array([len(recording) // 2])))
        for profile in ("paper", "field"):
            table = command("metrics", path, "--profile", profile, codes=(0, 2))
            prints.add(name, f"metrics {profile}", "error" not in table and table)
    command("convert", out / "rec", out / "ds", "--nominal-fps", "30")
    dataset = h3data.open(out / "ds")
    for k in range(len(dataset)):
        prints.add("dataset", str(k), {name: digest(column) for name, column in dataset.recording(k).columns.items()})
    prints.add("told", "validate", command("validate", out / "rec", *assets, codes=(0, 1)))
    skinned = next(path for path in logs if "room_skinned" in str(path))
    pictures_of(
        prints, "room_skinned", h3data.Replay(h3data.open(skinned), assets=folders), ("top_down", "orbit"), (5, 40)
    )
    command("export", skinned, "--to", "gfx-replay", "-o", out / "again" / "again.gfx_replay.json", *assets)
    command("import", out / "again" / "again.gfx_replay.json", "-o", out / "again")
    prints.recording("room_skinned exported and imported", h3data.open(out / "again" / "again.mcap"))


def exports(prints: Prints, out: Path, kind: str, name: str, task: str) -> None:
    """One episode as files of another program."""
    command(
        "generate",
        task,
        "--scenes",
        "small:1",
        "--episodes",
        "1",
        "--seed",
        "5",
        "--max-steps",
        LENGTH[task],
        "-o",
        out / "ds",
    )
    (out / "files").mkdir()
    told = command("export", f"{out / 'ds'}#0", "--to", kind, "-o", out / "files" / name)
    prints.add("told", "export", {key: value for key, value in told.items() if key != "bytes"})
    prints.files("files", out / "files")


def pictures_of(prints: Prints, group: str, replay: Any, cameras: Sequence[str], steps: Sequence[int]) -> None:
    """Pictures of all kinds."""
    outputs = ("rgb", "depth", "instance", "semantic", "normal")
    for camera in cameras:
        for step in steps:
            drawn = h3data.render_frame(replay, camera=camera, step=step, outputs=outputs)
            for name, picture in drawn.items():
                prints.add(f"{group} {camera} step {step}", name, picture)


def pictures(prints: Prints, out: Path, task: str, cameras: Sequence[str], steps: Sequence[int]) -> None:
    """Poses and pictures of one episode."""
    command(
        "generate",
        task,
        "--scenes",
        "small:1",
        "--episodes",
        "1",
        "--seed",
        "5",
        "--max-steps",
        LENGTH[task],
        "-o",
        out / "ds",
    )
    replay = h3data.Replay(h3data.open(out / "ds").recording(0))
    for step in steps:
        prints.add("poses", f"step {step}", replay.at(step))
    for index, thing in enumerate(replay.drawables):
        if thing.deformable:
            prints.add("poses", f"vertices of {thing.name}", replay.vertices(index, np.array(steps)))
    pictures_of(prints, task, replay, cameras, steps)


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
    real: bool = False
    """Whether it needs the real Habitat files."""

    def missing(self) -> str:
        """Why it cannot be computed here, or nothing."""
        if self.real and not REAL.is_dir():
            return "needs the real Habitat files in ../shared/real, which are not part of the repository"
        lacking = [name for name in self.needs if importlib.util.find_spec(name) is None]
        return f"needs {', '.join(lacking)}" if lacking else ""


ENV = ("gymnasium", "pettingzoo")
HOMES = ("small:0", "small:3", "medium:1")
SCENES = ["small:1", "small:4"]
SOCIAL_NAV_SENSES = [
    "humanoid_gps",
    "egomotion",
    "localization",
    "localization_in_start_frame",
    "humanoid_in_start_frame",
    "collision",
    "arm_joints",
    "is_holding",
    "humanoid_velocity",
    "way",
    "range_scan",
]
REARRANGE_SENSES = [
    "humanoid_gps",
    "egomotion",
    "localization",
    "localization_in_start_frame",
    "humanoid_in_start_frame",
    "collision",
    "arm_joints",
    "is_holding",
    "obj_start_gps_compass",
    "obj_goal_gps_compass",
    "obj_gps_compass",
    "obj_start_sensor",
    "obj_goal_sensor",
    "obj_sensor",
    "obj_start_in_start_frame",
    "obj_goal_in_start_frame",
    "obj_in_start_frame",
    "holds",
    "held_by_other",
    "at_goal",
    "other_agent_gps",
    "other_gps_compass",
    "close",
    "last_done",
    "interrupted",
]
PICTURES = ["arm_depth", "humanoid_detector", "humanoid_mask", "humanoid_box", "left_depth", "front_left_rgb"]


def _cases() -> Iterator[Case]:
    def generated(name: str, *options: str, quick: bool = False) -> Case:
        task = name.partition(" ")[0]
        return Case(name=f"generate {name}", make=lambda p, out: generate(p, out, task, *options), quick=quick)

    for task in PROFILES:
        yield generated(f"{task} once", "--scenes", "small:1", "--episodes", "1", "--seed", "5", quick=True)
        for home in HOMES:
            yield generated(f"{task} in {home}", "--scenes", home, "--episodes", "10", "--seed", "21")
        few = ("--episodes", "4") if task == "rearrange" else ()
        yield generated(f"{task} by default", *few)
        yield generated(
            f"{task} with anybody",
            "--human",
            "any",
            "--human-speed",
            "1.3",
            "--episodes",
            "3",
            "--max-steps",
            "900",
            "--spawn-distance",
            "3",
            "--seed",
            "8",
            "--scenes",
            "medium",
        )
        yield generated(f"{task} of a set", "--scenes", "h3-homes/test", "--episodes", "3")
    for policy in ("heuristic_expert", "sampling_expert", "future_oracle", "learned_follower", "random", "stand_still"):
        yield generated(
            f"social_nav by {policy}",
            "--policy",
            policy,
            "--episodes",
            "3",
            "--max-steps",
            "600",
            "--scenes",
            "small:3",
        )
    yield generated(
        "rearrange that fails twice",
        "--human",
        "any",
        "--rules",
        "paper",
        "--human-speed",
        "1.3",
        "--episodes",
        "3",
        "--max-steps",
        "600",
        "--seed",
        "8",
        "--scenes",
        "medium",
    )
    for policy in ("greedy_nearest", "same_object", "still", "solo"):
        yield generated(f"rearrange by {policy}", "--policy", policy, "--episodes", "2", "--scenes", "small:3")
    for partner in ("object_1", "object_2", "still", "plan_pop_1", "plan_pop_2", "plan_pop_3", "plan_pop_4"):
        yield generated(f"rearrange with {partner}", "--partner", partner, "--episodes", "1", "--scenes", "small:0")
    for agents, *more in (
        ("robot,robot",),
        ("robot,robot", "--policy", "complement,both"),
        ("human,human",),
        ("robot,robot,human",),
        ("robot,human,male_1", "--partner", "both,object_1"),
        ("human",),
        ("lift_arm,human",),
    ):
        yield generated(
            f"rearrange of {' '.join([agents, *more[1:]])}",
            "--agents",
            agents,
            *more,
            "--episodes",
            "1",
            "--scenes",
            "medium:1",
            "--seed",
            "3",
        )
    for agents in (
        "robot,human,human",
        "robot,lift_arm,female_1",
        "human,human",
        "robot,robot,robot,human,human,human",
    ):
        yield generated(
            f"wander of {agents}",
            "--agents",
            agents,
            "--human",
            "any",
            "--episodes",
            "3",
            "--scenes",
            "medium:1",
            "--seed",
            "3",
        )
    for task in ("social_nav", "rearrange"):
        yield Case(
            name=f"{task} as in Habitat", make=lambda p, out, task=task: habitat(p, out, task, (0, 3), (0, 1, 2))
        )

    yield Case(
        name="replay social_nav",
        make=lambda p, out: replay(
            p, out, "social_nav", (1, 150, 700), "--scenes", "small:1", other=("heuristic_expert",)
        ),
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
    yield environment(
        "social_nav with Habitat's reward",
        single,
        "social_nav",
        1000,
        reward="habitat",
        robot="lift_arm",
        human="male_1",
        end_on_success=True,
    )
    yield environment(
        "social_nav as in Habitat",
        lambda p, out, **o: single(p, out, "social_nav", 1000, spec=habitat_rules("social_nav"), **o),
    )
    yield environment("social_nav pictures", single, "social_nav", 60, observations=PICTURES)
    yield environment("social_nav 4 worlds once", vector, "social_nav", 4, 100, scenes="small:1", quick=True, **nav)
    yield environment("social_nav 64 worlds", vector, "social_nav", 64, 1000, **nav)
    yield environment("social_nav 4 worlds with pictures", vector, "social_nav", 4, 30, observations=PICTURES)
    yield environment(
        "social_nav robot and human once", parallel, "social_nav", 100, scenes="small:1", quick=True, **nav
    )
    yield environment("social_nav robot and human", parallel, "social_nav", 1000, **nav)
    yield dataclasses.replace(
        environment(
            "social_nav in torch",
            tensors,
            8,
            1000,
            episodes=32,
            observations=["humanoid_gps", "egomotion", "localization", "humanoid_velocity", "way", "range_scan"],
        ),
        needs=("torch", *ENV),
    )
    yield environment(
        "rearrange once", single, "rearrange", 100, scenes="small:1", level="low", quick=True, **rearrange
    )
    yield environment("rearrange by skills once", single, "rearrange", 20, scenes="small:1", quick=True, **rearrange)
    yield environment("rearrange by skills", single, "rearrange", 400, **rearrange)
    yield environment("rearrange by velocities", single, "rearrange", 1000, level="low", **rearrange)
    yield environment("rearrange person", single, "rearrange", 60, agents=("human",), interrupts_when_close=False)
    yield environment(
        "rearrange with Habitat's rules",
        lambda p, out, **o: single(p, out, "rearrange", 300, spec=habitat_rules("rearrange"), partner="both", **o),
        **rearrange,
    )
    yield environment("rearrange pictures", single, "rearrange", 40, observations=PICTURES, level="low")
    yield environment("rearrange 4 worlds by skills", vector, "rearrange", 4, 100, **rearrange)
    yield environment("rearrange 4 worlds by velocities", vector, "rearrange", 4, 300, level="low", **rearrange)
    yield environment("rearrange robot and human by skills", parallel, "rearrange", 400, **rearrange)
    yield environment("rearrange robot and human by velocities", parallel, "rearrange", 800, level="low", **rearrange)

    yield Case(name="stores", make=stores)
    yield Case(name="tables", make=tables)
    yield Case(name="scenes", make=scenes)
    for task in ("social_nav", "wander"):
        yield Case(name=f"{task} in a scene of Habitat", make=functools.partial(in_habitat_scene, task=task), real=True)
    yield Case(name="imports", make=imports, real=True)
    for kind, name, task, *needs in (
        ("gfx-replay", "e.gfx_replay.json", "social_nav"),
        ("gltf", "e.glb", "social_nav"),
        ("gltf", "e.glb", "rearrange"),
        ("foxglove", "e.foxglove.mcap", "rearrange", "mcap_protobuf", "foxglove_schemas_protobuf"),
        ("csv", "tables", "rearrange"),
        ("lerobot", "lerobot", "rearrange"),
        ("robomimic", "e.hdf5", "rearrange", "h5py"),
    ):
        make_files = functools.partial(exports, kind=kind, name=name, task=task)
        yield Case(name=f"export {task} to {kind}", make=make_files, needs=tuple(needs))
    views = ("third_person", "top_down", "robot_arm", "human_head")
    for task in PROFILES:
        make_pictures = functools.partial(pictures, task=task, cameras=views, steps=(20, 150))
        yield Case(name=f"pictures of {task}", make=make_pictures)
    once = functools.partial(pictures, task="wander", cameras=("top_down",), steps=(7,))
    yield Case(name="pictures of wander once", make=once, quick=True)


CASES: dict[str, Case] = {case.name: case for case in _cases()}


# --- storing and comparing ----------------------------------------------------------------------------------------------
def computed(case: Case, *, keep: Path | None = None) -> Digests:
    """The digests of a case, computed now; ``keep`` is a folder for the values."""
    kept = None if keep is None else keep / case.name.replace("/", "_")
    with tempfile.TemporaryDirectory() as folder:
        version = f"h3data {importlib.metadata.version('h3data')}"
        prints = Prints(folder=kept, places={folder: "OUT", str(REAL): "REAL", version: "h3data"})
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


def file_here() -> Path:
    """Where the digests of this type of CPU are stored."""
    return FOLDER / f"{vectors().replace(' ', '-') or 'plain'}.json"


def read(file: Path) -> dict[str, Any]:
    """``stamp``, ``torch`` and ``cases``, as stored."""
    return json.loads(file.read_text()) if file.exists() else {"stamp": {}, "torch": "", "cases": {}}


def write(stored: Mapping[str, Any], file: Path) -> None:
    """A line for each group, so that a change of the file shows what moved."""
    cases = []
    for name in sorted(stored["cases"]):
        groups = [f"  {json.dumps(group)}: {json.dumps(parts)}" for group, parts in stored["cases"][name].items()]
        cases.append(f" {json.dumps(name)}: {{\n" + ",\n".join(groups) + "\n }")
    head = f'"stamp": {json.dumps(stored["stamp"], indent=1)},\n"torch": {json.dumps(stored["torch"])}'
    file.write_text(f'{{\n{head},\n"cases": {{\n' + ",\n".join(cases) + "\n}\n}\n")


def forget(names: Sequence[str], *, but: Path) -> None:
    """Takes cases out of the files of other types of CPU: their digests there are of what was computed before."""
    for file in sorted(set(FOLDER.glob("*.json")) - {but}):
        stored = read(file)
        kept = {name: groups for name, groups in stored["cases"].items() if name not in names}
        if len(kept) < len(stored["cases"]):
            print(
                f"{len(stored['cases']) - len(kept)} cases that moved are no longer in {file.name}: renew them there."
            )
            write({**stored, "cases": kept}, file)


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
    parser = argparse.ArgumentParser(prog="python tests/fingerprints.py", description="Digests of what is computed.")
    parser.add_argument("names", nargs="*", help="only cases whose names contain one of these")
    parser.add_argument("--renew", action="store_true", help="store instead of compare")
    parser.add_argument("--list", action="store_true", help="list the cases")
    parser.add_argument("--file", type=Path, help="the stored digests, by default those of this type of CPU")
    parser.add_argument("--keep", type=Path, help="a folder for the values")
    options = parser.parse_args(arguments)
    os.environ.pop("H3DATA_ASSETS", None)
    chosen = [c for c in CASES.values() if not options.names or any(word in c.name for word in options.names)]
    if options.list:
        print("\n".join(f"{case.name}{'  (quick)' if case.quick else ''}" for case in chosen))
        return 0
    print(f"sources: {Path(h3data.__file__).parents[1]}", file=sys.stderr)
    file = options.file or file_here()
    stored = read(file)
    other = elsewhere(stored)
    if other and stored["cases"] and not (options.renew and not options.names):
        print(f"The stored digests are of another arithmetic: {other}", file=sys.stderr)
        if options.renew:
            print("Renew all of them.", file=sys.stderr)
            return 1
    moved: list[str] = []
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
            moved += [case.name] if lines and case.name in stored["cases"] else []
            stored["cases"][case.name] = found
            stored["stamp"], stored["torch"] = stamp(), torch_stamp()
            write(stored, file)
        else:
            lines = differences(stored["cases"][case.name], found) if case.name in stored["cases"] else ["not stored"]
            moved += [case.name] if lines else []
        print("\n    ".join([f"{'different' if lines else 'equal':<10} {case.name} ({took})", *lines[:20]]), flush=True)
    if options.renew:
        stored["cases"] = {name: groups for name, groups in stored["cases"].items() if name in CASES}
        write(stored, file)
        if file.parent == FOLDER:
            forget(moved, but=file)
        return 0
    return int(bool(moved))


if __name__ == "__main__":
    sys.exit(main())
