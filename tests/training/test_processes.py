"""Runs of several processes: the same weights in all of them, the curve of all worlds, exact resume, and failures that end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from h3data.errors import InputError
from h3data_training.curve import curve_of
from h3data_training.episodes import make_bank
from h3data_training.launch import StopRequest, launch
from h3data_training.ppo import Learner, Schedule
from h3data_training.ranks import Ranks, connect, leave, own_place, torchrun_place
from h3data_training.run import CHECKPOINT, POLICY, train
from h3data_training.torch.episodes import EpisodeBank
from h3data_training.worlds import ActionRepeatEnv
from sim_kinematic.policies.learned import network_of
from sim_kinematic.policies.visual_policy import VisualPolicy
from tests.training.runs import small

BLIND = small(observations=("humanoid_gps", "range_scan"), worlds=8)


@pytest.fixture(scope="module")
def bank() -> EpisodeBank:
    return make_bank(BLIND, seed=0, workers=1)


def policy(folder: Path) -> VisualPolicy:
    network = network_of(f"weights:{folder / POLICY}")
    assert isinstance(network, VisualPolicy)
    return network


def assert_same(a: Path, b: Path) -> None:
    for name, array in policy(a).arrays.items():
        np.testing.assert_array_equal(policy(b).arrays[name], array, err_msg=name)


# --- what a process does ------------------------------------------------------------------------------------------------
def two_updates(bank: EpisodeBank, stop: StopRequest, say: Any) -> Any:
    """Weights and curve of this process, gathered from all."""
    torch.set_num_threads(1)
    ranks, device = own_place("cpu")
    connect(ranks, torch.device(device))
    try:
        worlds = ActionRepeatEnv(BLIND, bank, device=device, compile=False, count=BLIND.worlds // ranks.count)
        learner = Learner(BLIND, worlds, seed=5, ranks=ranks)
        gps = ranks.gathered(learner.memory.shown["humanoid_gps"])
        rows = [learner.update(Schedule(1e-3, 0.98)) for _ in range(2)]
        squares = ranks.own(torch.arange(12.0).reshape(4, 3).square())
        weight, unused = torch.nn.Parameter(torch.ones(2)), torch.nn.Parameter(torch.ones(3))
        (weight.sum() * squares.mean() / 3).backward()
        ranks.average_gradients([weight, unused])
        assert weight.grad is not None
        flat = torch.cat([p.detach().flatten() for p in learner.net.parameters()])
        return {
            "weights": ranks.gathered(flat[None]).numpy(),
            "gps": gps.numpy(),
            "rows": rows,
            "curves": ranks.gathered(torch.tensor([list(row.values()) for row in rows])[None]).numpy(),
            "own": ranks.own(torch.arange(6)).tolist(),
            "variance": float(ranks.variance(squares)),
            "gradient": weight.grad.tolist(),
            "first": ranks.first(torch.tensor([float(ranks.rank)])).tolist(),
        }
    finally:
        leave()


def fails(given: int, stop: StopRequest, say: Any) -> None:
    place = torchrun_place()
    assert place is not None
    say(f"process {place[0]}")
    if place[0] == given:
        raise InputError("This one cannot go on.")
    if given < 0 and place[0]:
        os._exit(3)
    time.sleep(600)


def waits(given: None, stop: StopRequest, say: Any) -> str:
    while not stop.is_set():
        time.sleep(0.05)
    return "stopped"


# --- tests --------------------------------------------------------------------------------------------------------------
@pytest.mark.slow  # torch starts three times
def test_processes_agree_on_weights_and_curve(bank: EpisodeBank) -> None:
    found = launch(two_updates, 2, bank, stop=threading.Event(), say=print)
    first, second = found["weights"]
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(*found["curves"])
    assert found["own"] == [0, 1, 2]
    assert found["first"] == [0.0]
    squares = torch.arange(12.0).square()
    assert found["variance"] == pytest.approx(float(squares.var()))
    assert found["gradient"] == pytest.approx([float(squares.mean()) / 3] * 2)
    alone = Learner(BLIND, ActionRepeatEnv(BLIND, bank, device="cpu", compile=False), seed=5)
    np.testing.assert_array_equal(
        found["gps"], alone.memory.shown["humanoid_gps"].numpy()
    )  # the very worlds of one process
    before = torch.cat([p.detach().flatten() for p in alone.net.parameters()]).numpy()
    assert np.abs(first - before).max() > 1e-4
    row = alone.update(Schedule(1e-3, 0.98))
    assert set(row) == set(found["rows"][0])
    assert row["steps_per_episode"] == pytest.approx(found["rows"][0]["steps_per_episode"])  # sums over all worlds


def test_alone_nothing_is_touched() -> None:
    alone, x = Ranks(), torch.randn(3, 2)
    assert all(f(x) is x for f in (alone.sum, alone.mean, alone.first, alone.gathered, alone.own))
    assert float(alone.variance(x)) == float(x.var())


@pytest.mark.slow
def test_two_processes_resume_exactly(bank: EpisodeBank, tmp_path: Path) -> None:
    folders = [tmp_path / name for name in ("whole", "parts")]
    for folder in folders:
        folder.mkdir()
    whole, parts = folders
    settings = replace(
        BLIND, updates=4, rate_end=1.0, horizon=(300.0, 300.0)
    )  # the same whatever the length of the run
    said: list[str] = []
    assert train(whole, settings, gpus=2, bank=bank, say=said.append).done
    assert sum("update 1 " in line for line in said) == 1  # one process speaks
    assert train(parts, replace(settings, updates=2), gpus=2, bank=bank).done
    assert train(parts, settings, gpus=2, bank=bank, resume=True).updates == 4
    assert_same(whole, parts)
    assert [row["decisions"] for row in curve_of(whole)] == [24, 48, 72, 96]
    assert policy(whole).card.training["processes"] == 2
    assert not list(whole.glob("*.part"))
    kept = torch.load(whole / CHECKPOINT, weights_only=True)
    assert len(kept["state"]) == BLIND.worlds
    with pytest.raises(InputError, match="H3-TRAIN-004"):
        train(parts, replace(settings, updates=5), bank=bank, resume=True)


@pytest.mark.slow
def test_torchrun_starts_a_run_too(tmp_path: Path) -> None:
    options = f"--scenes {BLIND.scenes} --worlds 8 --updates 2 -o {tmp_path / 'run'}"
    command = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--nproc-per-node",
        "2",
        "-m",
        "h3data_pipelines.cli",
        "train",
        "social_nav",
        *options.split(),
    ]
    subprocess.run(command, check=True, timeout=300, env={**os.environ, "H3DATA_QUIET": "1"})
    assert policy(tmp_path / "run").card.training["processes"] == 2


@pytest.mark.parametrize(
    ("given", "fault", "message"),
    [
        pytest.param(1, InputError, "cannot go on", marks=pytest.mark.slow),
        pytest.param(-1, RuntimeError, "code 3", marks=pytest.mark.slow),
    ],
)
def test_a_process_that_fails_ends_the_others(given: int, fault: type[Exception], message: str) -> None:
    said: list[str] = []
    with pytest.raises(fault, match=message):
        launch(fails, 2, given, stop=threading.Event(), say=said.append)
    assert set(said) <= {"process 0", "process 1"}


@pytest.mark.slow
def test_a_stop_reaches_all_processes() -> None:
    stop = threading.Event()
    threading.Timer(1.0, stop.set).start()
    assert launch(waits, 2, None, stop=stop, say=print) == "stopped"


@pytest.mark.slow
def test_an_interrupted_run_of_two_saves(bank: EpisodeBank, tmp_path: Path) -> None:
    def interrupt(line: str) -> None:
        if "update 1 " in line:
            os.kill(os.getpid(), signal.SIGTERM)

    result = train(tmp_path, replace(BLIND, updates=100_000), gpus=2, bank=bank, say=interrupt)
    assert not result.done
    assert len(curve_of(tmp_path)) == result.updates >= 1


def test_a_process_sees_its_own_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {
        "RANK": "1",
        "LOCAL_RANK": "1",
        "WORLD_SIZE": "2",
        "MASTER_ADDR": "x",
        "MASTER_PORT": "1",
    }.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: os.environ["CUDA_VISIBLE_DEVICES"] != "")
    for visible, chosen in {"4,7": "7", "": "1"}.items():
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
        assert own_place("cuda") == (Ranks(1, 2), "cuda")
        assert os.environ["CUDA_VISIBLE_DEVICES"] == chosen
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4")
    with pytest.raises(InputError, match=r"(?s)2.*1.*H3-TRAIN-040"):
        own_place("cuda")


def test_worlds_must_split(bank: EpisodeBank, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"(?s)2.*3.*8.*H3-TRAIN-041"):
        train(tmp_path, BLIND, gpus=3, bank=bank)
