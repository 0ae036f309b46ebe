"""Commands on a Ray cluster of several nodes, some of which die: the same bytes as on this machine alone."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from h3data.commands.executors import LostShardError, opened
from h3data.errors import InputError
from h3data_pipelines.cli import main
from h3data_pipelines.execution import ray_cluster

pytest.importorskip("ray", reason="needs the extra ray")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning", "ignore::FutureWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture(scope="module")
def nodes() -> Iterator[Any]:
    from tests.pipelines.ray_nodes import ray_nodes

    with ray_nodes(3) as cluster:
        yield cluster


def files(root: Path) -> dict[str, str]:
    return {
        str(p.relative_to(root)): hashlib.sha256(p.read_bytes()).hexdigest() for p in root.rglob("*") if p.is_file()
    }


def run(capsys: pytest.CaptureFixture[str], *words: Any, code: int = 0) -> Any:
    assert main([*map(str, words), "--json"]) == code
    return json.loads(capsys.readouterr().out)


# --- shards that can be told what to do -------------------------------------------------------------------------------
def square(number: int) -> int:
    return number * number


def slow_square(number: int) -> int:
    time.sleep(0.4)
    return number * number


def die_at_five(number: int) -> int:
    if number == 5:
        os._exit(9)
    return number


def hang_once(shard: tuple[int, str]) -> int:
    number, folder = shard
    if number == 3:
        try:
            Path(folder, "begun").touch(exist_ok=False)
        except FileExistsError:
            return number
        time.sleep(600)
    return number


def refuse(number: int) -> int:
    raise InputError(f"not {number}")


def test_results_come_in_order(nodes: Any) -> None:
    with opened("ray", 3) as ray:
        assert list(ray.run(square, range(50))) == [n * n for n in range(50)]
        with pytest.raises(InputError, match="not 0"):
            list(ray.run(refuse, range(5)))


def test_a_shard_that_always_dies_costs_itself_only(nodes: Any) -> None:
    with opened("ray", 3) as ray:
        got = list(ray.run(die_at_five, range(12), lost=lambda shard, error: (shard, str(error))))
        assert [n for n in got if isinstance(n, int)] == [n for n in range(12) if n != 5]
        assert got[5] == (5, "No worker finished it in 4 tries; at the last one its process died")
        with pytest.raises(LostShardError):
            list(ray.run(die_at_five, range(12)))


def test_a_straggler_is_tried_twice(nodes: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_cluster, "_SLOW_S", 5.0)
    with opened("ray", 3) as ray:
        began = time.monotonic()
        assert list(ray.run(hang_once, [(n, str(tmp_path)) for n in range(8)])) == list(range(8))
        assert time.monotonic() - began < 60


def test_nodes_die_and_nothing_is_missing(nodes: Any) -> None:
    from tests.pipelines.ray_nodes import killing

    before = nodes.killed
    with opened("ray", 3) as ray, killing(nodes, every_s=3.0, most=before + 3):
        assert list(ray.run(slow_square, range(120))) == [n * n for n in range(120)]
    assert nodes.killed > before


# --- commands ---------------------------------------------------------------------------------------------------------
GENERATE = ("generate", "social_nav", "--episodes", 16, "--max-steps", 60, "--homes", 2, "--seed", 3)


def test_datasets_are_the_same_bytes(nodes: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from tests.pipelines.ray_nodes import killing

    local = run(capsys, *GENERATE, "-o", tmp_path / "local")
    before = nodes.killed
    with killing(nodes, every_s=4.0, most=before + 3):
        ray = run(capsys, *GENERATE, "--executor", "ray", "--workers", 3, "-o", tmp_path / "ray")
    assert nodes.killed > before
    assert ray["state_hashes"] == local["state_hashes"]
    assert files(tmp_path / "ray") == files(tmp_path / "local")


def test_videos_and_evaluations_are_the_same_bytes(
    nodes: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = ("--episodes", 3, "--max-steps", 20, "--seed", 3)
    for name, how in (("local", ()), ("ray", ("--executor", "ray", "--workers", 3))):
        run(capsys, "generate", "social_nav", *short, "--camera", "robot_arm", *how, "-o", tmp_path / name / "ds")
        some = ("--policies", "rollout_expert,stand_still", "--save-recordings", "--scenes", "small")
        run(capsys, "evaluate", "social_nav", *some, *short, *how, "-o", tmp_path / name / "eval")
    assert files(tmp_path / "ray") == files(tmp_path / "local")


def test_an_object_store_gets_the_same_bytes(nodes: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from h3data.recording.storage import RemotePath, place
    from tests.object_store import bucket

    short = ("generate", "social_nav", "--episodes", 24, "--max-steps", 20, "--seed", 3)
    run(capsys, *short, "-o", tmp_path)
    with bucket() as uri:
        assert run(capsys, *short, "--executor", "ray", "--workers", 3, "-o", f"{uri}/ds")["episodes"] == 24
        root = place(f"{uri}/ds")
        assert isinstance(root, RemotePath)
        stored = {
            str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in root.rglob("*")
            if path.is_file()
        }
    assert stored == files(tmp_path)


def test_jobs_that_read_give_the_same(nodes: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ds, by_ray = tmp_path / "ds", ("--executor", "ray", "--workers", 3)
    run(capsys, "generate", "social_nav", "--episodes", 10, "--max-steps", 12, "--seed", 3, "-o", ds)
    for words in (("metrics", ds), ("metrics", ds, "--profile", "field"), ("validate", ds)):
        assert run(capsys, *words, *by_ray) == run(capsys, *words)
    for name, how in (("local", ()), ("ray", by_ray)):
        report = ("--out", tmp_path / name / "report.html", "--markdown", tmp_path / name / "report.md")
        run(capsys, "report", ds, "--pictures", 1, *how, *report)
        run(capsys, "convert", ds, tmp_path / name / "logs", *how)
        some = (f"{ds}#1", f"{ds}#2", "--steps", "0:3")
        run(
            capsys,
            "rerender",
            *some,
            "--format",
            "data",
            "--outputs",
            "rgb,depth",
            *how,
            "-o",
            tmp_path / name / "videos",
        )
    assert files(tmp_path / "ray") == files(tmp_path / "local")


def test_ctrl_c_keeps_what_is_finished(nodes: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "ds"
    words = [
        "generate",
        "social_nav",
        "--max-steps",
        "60",
        "--seed",
        "3",
        "-o",
        str(out),
        "--executor",
        "ray",
        "--workers",
        "3",
    ]
    command = [sys.executable, "-m", "h3data_pipelines.cli", *words]
    process = subprocess.Popen([*command, "--episodes", "400"], stderr=subprocess.PIPE, text=True)
    end = time.monotonic() + 120
    while not (part := [*out.glob("data/chunk-000/_file-000.parquet.part")]) or part[0].stat().st_size < 50_000:
        assert process.poll() is None
        assert time.monotonic() < end
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in error
    assert "the same command with --resume goes on" in error
    from h3data.recording import Dataset

    done = len(Dataset(out))
    assert 2 < done < 400
    assert run(capsys, *words, "--episodes", done + 2, "--resume")["new"] == 2
