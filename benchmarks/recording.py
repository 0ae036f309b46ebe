"""Size and speed of the stores, on synthetic 1500-step episodes: a robot, a free-form human, 20 objects of which 3 move.

The mix is that of ``research/formats.md`` 2, column by column: agents move in 70 % of the steps, commands are held for 20
steps; half of the episodes loop a 60-frame clip in ``joint_quat`` and half move every joint all the time with noise,
which is the worst case (85 % of the bytes are joint rotations; alone it is ``*_free``). ``*_restless`` is the same mix
with agents that never stand still and commands that change every 5 and 30 steps. ``*_clips`` is what our own
episodes have: a clip and a phase instead of rotations. ``mcap_live`` is a log whose rows came one by one, flushed each
second; ``mcap_unclosed`` the same before it is closed. Speeds are steps per CPU second, files closed and synced, from and
to numpy arrays.
"""

from __future__ import annotations

import gzip
import json
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np
from numpy.typing import NDArray

from benchmarks.sim import cpu_s
from h3data.bodies import load_humanoid
from h3data.geometry import ground_pose, pose_from_matrix
from h3data.recording import (
    STEP_NS,
    Agent,
    AssetRef,
    Body,
    Dataset,
    DatasetWriter,
    Episode,
    Recording,
    RecordingWriter,
    SkillSpan,
    open_steps,
    read_mcap,
    write_mcap,
)
from h3data.recording.parquet.dataset import DatasetSteps

STEPS, OBJECTS, EPISODES, THOUSAND = 1500, 20, 10, 1000


def synthetic_episode(seed: int, *, human: str, restless: bool = False) -> Recording:
    """Return an episode with ``human`` = ``clip`` (60 looping frames), ``free`` (every joint moves) or ``coded`` (clip
    phase).
    """
    rng = np.random.default_rng(seed)
    robot, person = _stroll(rng, restless=restless), _stroll(rng, restless=restless)
    held = (5, 30) if restless else (20, 20)
    objects = np.tile(_unit_poses(rng, OBJECTS)[None], (STEPS, 1, 1))
    for k in range(3):
        start = rng.integers(0, STEPS - 400)
        objects[start : start + 300, k] = robot[start : start + 300]
        objects[start + 300 :, k] = robot[start + 300]
    columns: dict[str, NDArray] = {
        "time_ns": np.arange(STEPS, dtype=np.int64) * STEP_NS,
        "object_pose": objects,
        "agent_0.base_pose": robot,
        "agent_0.joint_pos": np.cumsum(rng.normal(0, 0.01, (STEPS, 7)), 0).astype(np.float32),
        "agent_0.grasp_body": np.where(np.arange(STEPS) % 500 < 300, 0, -1).astype(np.int32),
        "agent_0.action": np.repeat(rng.normal(0, 1, (STEPS // held[0], 10)), held[0], axis=0).astype(np.float32),
        "agent_0.skill": (np.arange(STEPS) // 300).astype(np.int32),
        "agent_1.base_pose": person,
        "agent_1.action": np.repeat(rng.normal(0, 1, (STEPS // held[1], 10)), held[1], axis=0).astype(np.float32),
        "agent_1.skill": (np.arange(STEPS) // 200).astype(np.int32),
        "metrics.dist_agents": np.linalg.norm(robot[:, :3] - person[:, :3], axis=1),
        "metrics.collision": np.zeros(STEPS, bool),
    }
    if human == "coded":
        columns["agent_1.motion_id"] = np.zeros(STEPS, np.int32)
        columns["agent_1.motion_phase"] = (np.arange(STEPS) / 60 % 1).astype(np.float32)
        columns["agent_1.motion_blend"] = np.ones(STEPS, np.float32)
    else:
        columns["agent_1.root_pose"] = person + np.array([0, 0.9, 0, 0, 0, 0, 0], np.float32)
        columns["agent_1.joint_quat"] = _joints(rng, free=human == "free")
    return Recording(
        episode=Episode(uid=f"bench-{human}-{seed}", episode_id=str(seed), task="bench", scene="none", seed=seed),
        assets=(AssetRef(name="box", uri="primitive:box"),),
        bodies=tuple(Body(name=f"box_{k}", asset="box", pose=objects[0, k], moving=k) for k in range(OBJECTS)),
        agents=(Agent(name="robot", kind="robot"), Agent(name="human", kind="human", motion_names=("walk",))),
        columns=columns,
        skills=tuple(SkillSpan(agent=0, name=f"s{k}", start_step=k * 300, end_step=k * 300 + 299) for k in range(5)),
    )


def run(emit: Callable[[str, float, str], None]) -> None:
    """Measure both stores and say what they found."""
    free = [synthetic_episode(k, human="free") for k in range(EPISODES)]
    clip = [synthetic_episode(k, human="clip") for k in range(EPISODES)]
    coded = [synthetic_episode(k, human="coded") for k in range(EPISODES)]
    mixed = [episode for pair in zip(clip, free, strict=True) for episode in pair]
    restless = [synthetic_episode(k, human=h, restless=True) for k in range(EPISODES) for h in ("clip", "free")]
    for store in (_parquet, _mcap):
        name = store.__name__.strip("_")
        with tempfile.TemporaryDirectory() as folder:
            store(coded, Path(folder) / "warm")  # imports, page cache
            for suffix, episodes in (("_clips", coded * 2), ("_free", free * 2), ("_restless", restless)):
                size, _, _ = store(episodes, Path(folder) / suffix)
                emit(f"recording.{name}{suffix}.bytes_per_step", _per_step(size), "B")
            size, write_s, read_s = store(mixed, Path(folder) / "mixed")
        emit(f"recording.{name}.bytes_per_step", _per_step(size), "B")
        emit(f"recording.{name}.write_steps_per_cpu_s", STEPS * len(mixed) / write_s, "steps/s")
        emit(f"recording.{name}.read_steps_per_cpu_s", STEPS * len(mixed) / read_s, "steps/s")
        if store is _parquet:
            _against_gfx_replay(emit, mixed[:2], size / len(mixed), read_s / len(mixed))
    _live_log(emit, mixed[:4])
    _step_of_a_long_log(emit, mixed)
    _one_of_a_thousand(emit, mixed)


def _per_step(size: int) -> float:
    return size / (2 * EPISODES * STEPS)


def _live_log(emit: Callable[[str, float, str], None], episodes: list[Recording]) -> None:
    size, unclosed, close_s = 0, 0, 0.0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "live.mcap"
        for episode in episodes:
            writer = RecordingWriter(path, episode, overwrite=True, flush_s=float("inf"))
            for k in range(STEPS):
                writer.append({name: array[k : k + 1] for name, array in episode.columns.items()})
            unclosed += writer.part.stat().st_size
            close_s += cpu_s(writer.close)
            size += path.stat().st_size
    emit("recording.mcap_live.bytes_per_step", size / (STEPS * len(episodes)), "B")
    emit("recording.mcap_live.close_cpu_ms", 1e3 * close_s / len(episodes), "ms")
    emit("recording.mcap_unclosed.bytes_per_step", unclosed / (STEPS * len(episodes)), "B")


def _one_of_a_thousand(emit: Callable[[str, float, str], None], episodes: list[Recording]) -> None:
    """Open a dataset of 1,000 episodes (640 MB), and read whole episodes of it in random order, page cache warm."""
    with tempfile.TemporaryDirectory() as folder:
        with DatasetWriter(folder) as writer:
            for k in range(THOUSAND):
                writer.add(episodes[k % len(episodes)])
        dataset, order = Dataset(folder), np.random.default_rng(0).permutation(THOUSAND)[:100].tolist()
        read = cpu_s(lambda: [dataset.recording(index) for index in order])
        opened = median(cpu_s(lambda: len(Dataset(folder))) for _ in range(20))
        emit("recording.parquet.open_1000_cpu_ms", 1e3 * opened, "ms")
        emit("recording.parquet.episode_of_1000_cpu_ms", 1e3 * read / len(order), "ms")
        rng = np.random.default_rng(1)

        def one_step() -> None:
            DatasetSteps(dataset, int(rng.integers(THOUSAND)))[int(rng.integers(STEPS))]

        emit("recording.parquet.random_step_ms", 1e3 * cpu_s(lambda: [one_step() for _ in range(100)]) / 100, "ms")


def _step_of_a_long_log(emit: Callable[[str, float, str], None], episodes: list[Recording]) -> None:
    """Single steps of a log of 15,000 (8 minutes, 8 MB) in random order, page cache warm; opening it for one; all of it."""
    columns = {n: np.concatenate([e.columns[n] for e in episodes[:10]]) for n in episodes[0].columns}
    columns["time_ns"] = np.arange(10 * STEPS, dtype=np.int64) * STEP_NS
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "long.mcap"
        write_mcap(replace(episodes[0], columns=columns), path)
        order = np.random.default_rng(1).integers(10 * STEPS, size=100).tolist()
        with open_steps(path) as steps:
            emit("recording.mcap.random_step_ms", 1e3 * cpu_s(lambda: [steps[k] for k in order]) / len(order), "ms")

        def opened(k: int) -> None:
            with open_steps(path) as steps:
                steps[k]

        emit("recording.mcap.open_and_step_ms", 1e3 * cpu_s(lambda: [opened(k) for k in order]) / len(order), "ms")
        emit("recording.mcap.whole_long_log_ms", 1e3 * cpu_s(lambda: read_mcap(path)), "ms")


def _against_gfx_replay(
    emit: Callable[[str, float, str], None], episodes: list[Recording], size: float, read_s: float
) -> None:
    """Compare the same episodes as Habitat's replay files with one Parquet episode; parsing alone counts as loading."""
    texts = [_gfx_replay(e) for e in episodes]
    parse_s = cpu_s(lambda: [json.loads(t) for t in texts]) / len(texts)
    emit("recording.vs_gfx_replay.json_bytes_per_step", float(np.mean([len(t) for t in texts])) / STEPS, "B")
    emit("recording.vs_gfx_replay.size_ratio", float(np.mean([len(t) for t in texts])) / size, "x")
    emit("recording.vs_gfx_replay.gzip_ratio", float(np.mean([len(gzip.compress(t)) for t in texts])) / size, "x")
    emit("recording.vs_gfx_replay.load_ratio", parse_s / read_s, "x")


def _gfx_replay(episode: Recording) -> bytes:
    """Keyframes as habitat-sim writes them: the instances that changed (objects and the robot's base, its links are left
    out), and the world poses of all bones of the human; float32 numbers with the digits of a double."""
    columns = episode.columns
    poses = np.concatenate([columns["object_pose"], columns["agent_0.base_pose"][:, None]], axis=1)
    joints = load_humanoid("female_0").joint_matrices_free(columns["agent_1.root_pose"], columns["agent_1.joint_quat"])
    bones = pose_from_matrix(joints).astype(np.float32).astype(np.float64)
    changed = np.ones(poses.shape[:2], bool)
    changed[1:] = np.any(poses[1:] != poses[:-1], axis=-1)

    def transform(pose: list[float]) -> dict[str, list[float]]:
        return {"translation": pose[:3], "rotation": [pose[6], *pose[3:6]]}

    frames = []
    for k, rows in enumerate(poses.astype(np.float64).tolist()):
        updates = [
            {"instanceKey": i, "state": {"absTransform": transform(rows[i]), "semanticId": 0}}
            for i in np.flatnonzero(changed[k]).tolist()
        ]
        rig = [{"t": bone[:3], "r": [bone[6], *bone[3:6]]} for bone in bones[k].tolist()]
        frames.append({"stateUpdates": updates, "rigUpdates": [{"id": 0, "pose": rig}]})
    return json.dumps({"keyframes": frames}, separators=(",", ":")).encode()


def _parquet(episodes: list[Recording], root: Path) -> tuple[int, float, float]:
    """Return bytes on disk, and CPU seconds to write and to read."""

    def write() -> None:
        with DatasetWriter(root) as writer:
            for episode in episodes:
                writer.add(episode)

    def read() -> None:
        dataset = Dataset(root)
        for index in range(len(dataset)):
            dataset.recording(index)

    write_s, read_s = cpu_s(write), cpu_s(read)
    return sum(p.stat().st_size for p in root.rglob("*") if p.is_file()), write_s, read_s


def _mcap(episodes: list[Recording], root: Path) -> tuple[int, float, float]:
    """Return bytes on disk, and CPU seconds to write and to read."""
    paths = [root / f"{k}.mcap" for k in range(len(episodes))]
    write_s = cpu_s(lambda: [write_mcap(e, p) for e, p in zip(episodes, paths, strict=True)])
    read_s = cpu_s(lambda: [read_mcap(p) for p in paths])
    return sum(p.stat().st_size for p in paths), write_s, read_s


def _stroll(rng: np.random.Generator, *, restless: bool) -> NDArray[np.float32]:
    """A walk at about 1 m/s with slowly changing heading that pauses for 5 s now and then if not restless, pose7 [T, 7]."""
    heading = np.cumsum(np.cumsum(rng.normal(0, 0.002, STEPS)) * 0.2)
    xz = np.cumsum(np.stack([np.cos(heading), -np.sin(heading)], -1) / 30, axis=0)
    poses = ground_pose(xz, heading).astype(np.float32)
    if restless:
        return poses
    moving = (np.arange(STEPS) + rng.integers(500)) % 500 < 350
    return poses[np.cumsum(moving) - moving[0]]


def _unit_poses(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    poses = rng.normal(0, 2, (count, 7))
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    return poses.astype(np.float32)


def _joints(rng: np.random.Generator, *, free: bool) -> NDArray[np.float32]:
    """Return the local joint rotations, quaternions [T, 54, 4]."""
    t = np.arange(STEPS)[:, None, None] / 30
    t = t if free else t % 2.0
    quats = 0.3 * np.sin(2 * np.pi * (rng.uniform(0.2, 2, (54, 4)) if free else 0.5) * t + rng.uniform(0, 6, (54, 4)))
    if free:
        quats += np.cumsum(rng.normal(0, 0.001, (STEPS, 54, 4)), 0)
    quats[..., 3] = 1.0
    return (quats / np.linalg.norm(quats, axis=-1, keepdims=True)).astype(np.float32)
