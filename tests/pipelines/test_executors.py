"""Who does the work: names, refusals, and the order of results, without Ray."""

from __future__ import annotations

import json
import os
import pickle
import socket
import sys
from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from h3data.commands.executors import LostShardError, check_workers, opened
from h3data.errors import H3DataError, InputError, MissingExtraError
from h3data.progress import QUIET
from h3data_pipelines.cli import main
from h3data_pipelines.execution import ray_cluster, ray_worker
from h3data_pipelines.execution.processes import Processes
from h3data_pipelines.execution.ray_worker import Origin, carry_out, portable_task


def square(number: int) -> int:
    if number == 13:
        raise InputError("13 brings bad luck")
    return number * number


@pytest.mark.parametrize("name", ["dask", "Ray", "local://x", "ray://", ""])
def test_unknown_executors_are_refused(name: str) -> None:
    with pytest.raises(InputError, match="H3-JOB-001"):
        check_workers(name, 1)


def test_too_few_workers_are_refused() -> None:
    with pytest.raises(InputError, match=r"(?s)1.*0.*H3-JOB-002"), opened("local", 0):
        pass


@pytest.mark.slow
def test_one_process_and_two_give_the_same_in_order() -> None:
    numbers = [n for n in range(40) if n != 13]
    expected = [n * n for n in numbers]
    assert list(Processes(1).run(square, numbers)) == expected
    assert list(Processes(2).run(square, numbers)) == expected
    with pytest.raises(InputError, match="bad luck"):
        list(Processes(2).run(square, range(20)))


def mortal(folder: Path, number: int) -> int:
    """Dies at 3 the first time, and at 7 always."""
    if number == 7 or (number == 3 and not (folder / "died").exists()):
        (folder / "died").touch()
        os._exit(9)
    return square(number)


@pytest.mark.slow  # four processes die
def test_a_process_that_dies_costs_its_shard_only(tmp_path: Path) -> None:
    run = partial(Processes(2).run, partial(mortal, tmp_path), range(12))
    faults = []
    results = list(run(lost=lambda number, fault: faults.append((number, str(fault))) or -1))
    assert results == [-1 if n == 7 else n * n for n in range(12)]
    assert faults == [(7, "No process survived it in 3 tries, perhaps for lack of memory")]
    assert (tmp_path / "died").exists()
    with pytest.raises(LostShardError, match="H3-JOB-003"):
        list(run())


def test_without_ray_the_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match="H3-JOB-005"), opened("ray", 2):
        pass
    options = ["generate", "social_nav", "--episodes", "1", "--executor", "ray", "-o", str(tmp_path / "ds"), "--json"]
    assert main(options) == 2
    assert "h3data[ray]" in json.loads(capsys.readouterr().out)["error"]
    assert not (tmp_path / "ds").exists(), "nothing is begun"


def test_nobody_at_the_address() -> None:
    pytest.importorskip("ray")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]  # bound, but nobody listens
        with (
            pytest.raises(InputError, match=f"(?s)no Ray cluster at ray://127.0.0.1:{port} .*H3-JOB-007"),
            opened(f"ray://127.0.0.1:{port}", 1),
        ):
            pass
    with pytest.raises(InputError, match="H3-JOB-004"), opened("ray://head", 1):
        pass


def test_where_nobody_is_at_the_address_nothing_is_written_or_deleted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("ray")
    ds = tmp_path / "ds"
    short = ("social_nav", "--episodes", "1", "--max-steps", "5")
    evaluate = ("evaluate", *short, "--policies", "stand_still", "--scenes", "small")
    assert main(["generate", *short, "-o", str(ds)]) == 0
    assert main([*evaluate, "-o", str(tmp_path / "eval")]) == 0
    before = sorted(tmp_path.rglob("*"))
    capsys.readouterr()
    for command, out in (
        (("generate", *short), "new"),
        (("generate", *short, "--force"), "ds"),
        (evaluate, "new"),
        ((*evaluate, "--force"), "eval"),
        (("convert", ds), "new"),
        (("rerender", f"{ds}#0", "--camera", "top_down"), "new"),
        (("report", ds), "new.html"),
    ):
        target = [tmp_path / out] if command[0] == "convert" else ["-o", tmp_path / out]
        assert main([*map(str, (*command, *target)), "--executor", "ray://127.0.0.1:1"]) == 2, command
        (line,) = capsys.readouterr().err.splitlines()
        assert "There is no Ray cluster at ray://127.0.0.1:1" in line
        assert sorted(tmp_path.rglob("*")) == before, command


def test_a_shard_is_hardly_to_blame_for_the_death_of_its_node() -> None:
    pytest.importorskip("ray")
    from ray.exceptions import NodeDiedError, WorkerCrashedError

    under_way = object.__new__(ray_cluster._UnderWay)
    under_way.attempts, under_way.done, under_way.again, under_way.tries = {}, {}, [], Counter()
    for _ in range(10):
        under_way._lost(0, NodeDiedError("power"))
    for _ in range(3):
        under_way._lost(0, WorkerCrashedError())
    assert not under_way.done
    under_way._lost(0, WorkerCrashedError())
    assert "in 4 tries; at the last one its process died" in str(under_way.done[0])


# --- what a worker of Ray does, in this process -----------------------------------------------------------------------
@pytest.fixture
def in_a_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers silence progress for as long as their process lives; this one goes on with other tests."""
    monkeypatch.setenv(QUIET, "1")


@pytest.mark.usefixtures("in_a_worker")
def test_a_worker_carries_out_and_says_what_was_raised() -> None:
    here = Origin.of_this_process().to_json()
    kind, answer = portable_task()(here, pickle.dumps((square, 7)))
    assert (kind, pickle.loads(answer)) == ("done", 49)
    kind, answer = carry_out(here, pickle.dumps((square, 13)))
    assert kind == "raised"
    assert isinstance(pickle.loads(answer), InputError)


class Odd(Exception):
    """Cannot be unpickled: its constructor wants two arguments."""

    def __init__(self, a: int, b: int) -> None:
        super().__init__(f"{a} and {b}")


def odd(number: int) -> int:
    raise Odd(number, number)


@pytest.mark.usefixtures("in_a_worker")
def test_errors_that_cannot_travel_arrive_as_text() -> None:
    _, answer = carry_out(Origin.of_this_process().to_json(), pickle.dumps((odd, 7)))
    error = pickle.loads(answer)
    assert type(error) is H3DataError
    assert str(error) == "Odd: 7 and 7"


@pytest.mark.usefixtures("in_a_worker")
def test_workers_that_would_give_other_bytes_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    here, payload = Origin.of_this_process(), pickle.dumps((square, 7))
    for other, said in (
        (replace(here, packages="python 3.11.0 numpy 1.0"), "install the same"),
        (replace(here, code="0" * 64), "another h3data"),
    ):
        kind, why = carry_out(other.to_json(), payload)
        assert kind == "refused"
        assert said in why
        assert "\n" not in why
    strange = pickle.dumps((square, 7)).replace(b"tests.pipelines.test_executors", b"tests.pipelines.test_executorz")
    assert carry_out(here.to_json(), strange)[0] == "refused"
    monkeypatch.setitem(sys.modules, "h3data_pipelines.execution.ray_worker", None)
    kind, why = portable_task()(here.to_json(), payload)
    assert (kind, "cannot import h3data" in why) == ("refused", True)
    assert ray_worker  # the import at the top stays
