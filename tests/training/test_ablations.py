"""The driver of the table of ablations: every run has the same updates, whatever is killed."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tyro

from bake import ablations
from bake.ablations import ROWS, Ablations, main
from h3data.errors import InputError

PRETENDED = """
import json, os, shutil, signal, sys, time
from pathlib import Path
words = sys.argv[1:]
out, given = Path(words[words.index("-o") + 1]), dict(zip(words, words[1:]))
out.mkdir(parents=True, exist_ok=True)
with (out / "calls").open("a") as stream:
    stream.write(json.dumps([os.environ.get("CUDA_VISIBLE_DEVICES"), *words]) + chr(10))
if words[0] == "evaluate" or (out / "refuse").exists():
    sys.exit(2 * (words[0] == "train"))
count = out / "count"
while (updates := 1 + int(count.read_text() if count.exists() else 0)) <= int(given["--updates"]):
    while updates > 1 and Path(__file__).with_name("pause").exists():
        time.sleep(0.02)
    shutil.copy(Path(__file__).with_name(f"{updates}.npz"), out / "part")
    os.replace(out / "part", out / "policy.npz")
    count.write_text(str(updates))
    if updates == 2 and (out / "die").exists():
        (out / "die").unlink()
        os.kill(os.getpid(), signal.SIGKILL)
"""
"""A command that counts updates as a run would."""
SMALL = Ablations(out=Path(), updates=4, rows=("rgb", "no_depth"), seeds=(0, 1), rules=("natural",), at_once=2)


@pytest.fixture
def pretended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    script = tmp_path / "pretended.py"
    script.write_text(PRETENDED)
    for updates in range(1, 5):
        card = json.dumps({"training": {"updates": updates}})
        np.savez(tmp_path / f"{updates}.npz", card=np.array(card))
    monkeypatch.setattr(ablations, "H3DATA", (sys.executable, str(script)))
    return script


def calls(folder: Path) -> list[list[Any]]:
    return [json.loads(line) for line in (folder / "calls").read_text().splitlines()]


def test_all_runs_get_the_same_updates_and_one_table(pretended: Path, tmp_path: Path) -> None:
    options, said = replace(SMALL, out=tmp_path / "out", gpus=2, at_once=1), []
    assert [run.name for run in options.runs()] == [f"natural/{row}.{seed}" for row in SMALL.rows for seed in (0, 1)]
    killed, refused = (run.folder for run in options.runs()[1:3])
    for folder, name in ((killed, "die"), (refused, "refuse")):
        folder.mkdir(parents=True)
        (folder / name).touch()
    assert main(options, said.append) == 1
    assert not (tmp_path / "out/natural/table").exists()
    # a run that dies of a signal goes on in the same call, one that refuses its options does not
    assert (len(calls(killed)), len(calls(refused))) == (2, 1)
    assert "1 of 4 runs are not over" in said[-1]
    (refused / "refuse").unlink()
    assert main(options, said.append) == 0
    assert [run.updates() for run in options.runs()] == [4] * 4
    assert len(calls(killed)) == 2  # nothing is done again
    by_run = [calls(run.folder)[-1] for run in options.runs()]
    assert {gpu for gpu, *_ in by_run} == {"0", "1"}
    same = {word for word in by_run[0] if word not in ("--light", "baked", "--size", "96x72")}
    assert {"--recipe", "fast", "--updates", "--rules", "--resume", "cuda"} <= same
    for run, (_, *words) in zip(options.runs(), by_run, strict=True):
        assert words[words.index("--observations") + 1] == ",".join(ROWS[run.row])
        assert words[words.index("--seed") + 1] == str(run.seed)
        assert (run.row == "rgb") == ("baked" in words) == ("96x72" in words)
    ((_, *words),) = calls(tmp_path / "out/natural/table")
    policies = [f"weights:{tmp_path}/out/natural/{row}.*/policy.npz" for row in SMALL.rows]
    assert words[words.index("--policies") + 1] == ",".join(policies)


def test_kill_9_takes_the_runs_along_and_the_next_call_goes_on(pretended: Path, tmp_path: Path) -> None:
    options = replace(SMALL, out=tmp_path / "out", seeds=(0,), evaluate="")
    pause = pretended.with_name("pause")
    pause.touch()
    driver = get_context("fork").Process(target=main, args=(options, str))
    driver.start()
    runs = options.runs()
    while not all(run.updates() for run in runs):
        time.sleep(0.02)
        assert driver.is_alive()
    driver.kill()
    driver.join()
    pause.unlink()
    time.sleep(0.2)  # a run that is alive would go on now
    assert [run.updates() for run in runs] == [1, 1]
    assert main(options, str) == 0
    assert [run.updates() for run in runs] == [4, 4]


def test_no_run_begins_that_could_not_end(pretended: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = replace(SMALL, out=tmp_path / "out", seconds=60.0)
    assert main(options, str) == 1
    assert not (tmp_path / "out").exists()
    monkeypatch.setattr(ablations, "SETUP_S", 0.3)
    pretended.with_name("pause").touch()
    assert main(replace(options, seconds=0.6), str) == 1
    assert all(run.updates() < 4 for run in options.runs())


def test_options_that_are_wrong_are_refused() -> None:
    for changes in ({"rows": ("smell",)}, {"updates": 0}, {"at_once": 0}, {"gpus": -1}):
        with pytest.raises(InputError) as caught:
            replace(SMALL, **changes)
        assert "Expected rows among rgb, all" in str(caught.value)


def test_options_of_the_commands_are_one_word_of_the_command_line() -> None:
    words = "out --updates 9 --seeds 3 4 --rows all rgb --gpus 2 --seconds 560 --train=--recipe\tfast --evaluate="
    options = tyro.cli(Ablations, args=[word.replace("\t", " ") for word in words.split(" ")])
    assert (options.train, options.evaluate, options.seconds) == ("--recipe fast", "", 560.0)
    assert [run.name for run in options.runs()][::2] == [
        "natural/rgb.3",
        "natural/rgb.4",
        "natural/all.3",
        "natural/all.4",
    ]
    assert "--stop-after" in options.command(options.runs()[0], stop_after_s=60.0)


@pytest.mark.slow
def test_a_tiny_table_on_the_cpu(tmp_path: Path) -> None:
    options = Ablations(
        out=tmp_path / "out",
        updates=2,
        rows=("rgb", "no_depth"),
        seeds=(0,),
        rules=("natural",),
        at_once=2,
        size="16x12",
        train="--recipe tiny --scenes h3-homes/train#0 --episodes-per-home 1 --worlds 3 --rollout 2 --minibatches 1",
        evaluate="--scenes h3-homes/train#0 --episodes 1 --max-steps 30",
    )
    said: list[str] = []
    assert main(options, said.append) == 0, said
    decisions = [json.loads(str(ablations.read_arrays(run.folder / "policy.npz")[1]["card"])) for run in options.runs()]
    assert [card["training"]["decisions"] for card in decisions] == [12, 12]
    assert (decisions[0]["light"], decisions[0]["picture_size"]) == ("baked", [16, 12])
    table = json.loads((tmp_path / "out/natural/table/table.json").read_text())
    assert len(table["job"]["policies"]) == 2
    assert "0.00 M decisions" in said[0]
