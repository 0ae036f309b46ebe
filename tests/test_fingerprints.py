"""What is computed is what was computed when the digests of this type of CPU were stored; `fingerprints` says how to renew."""

from __future__ import annotations

import functools
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))  # whether or not the tests are a package

import fingerprints
from fingerprints import CASES, Case

HINT = (
    "The stored digests are of another arithmetic ({}). To compare two commits here, run `python tests/fingerprints.py "
    "--renew --file FILE` on the old one and `python tests/fingerprints.py --file FILE` on the new one."
)


@functools.cache
def stored() -> dict[str, Any]:
    return fingerprints.read(fingerprints.file_here())


def _marked(case: Case) -> Any:
    return pytest.param(case, id=case.name, marks=() if case.quick else pytest.mark.slow)


@pytest.mark.parametrize("case", [_marked(case) for case in CASES.values()])
def test_what_is_computed_is_what_was_computed(case: Case) -> None:
    if why := case.missing():
        pytest.skip(why)
    if other := fingerprints.elsewhere(stored(), torch="torch" in case.needs):
        pytest.skip(HINT.format(other))
    if case.name not in stored()["cases"]:
        pytest.skip(
            f"moved since it was stored on {fingerprints.vectors()}: python tests/fingerprints.py --renew '{case.name}'"
        )
    moved = fingerprints.differences(stored()["cases"][case.name], fingerprints.computed(case))
    assert not moved, f"{case.name}:\n" + "\n".join(moved)


def test_digests_notice_every_bit() -> None:
    one = np.arange(6, dtype=np.float32)
    other = one.copy()
    other[3] = np.nextafter(other[3], np.float32(9), dtype=np.float32)
    values = [
        one,
        other,
        one.astype(np.float64),
        one.reshape(2, 3),
        one.tolist(),
        [*one.tolist(), float("nan")],
        b"",
        "",
        None,
    ]
    assert len({fingerprints.digest(value) for value in values}) == len(values)


def test_cases_that_moved_leave_the_files_of_other_cpus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fingerprints, "FOLDER", tmp_path)
    cases = {"a": {"g": {"p": "1"}}, "b": {"g": {"p": "2"}}}
    for name in ("here", "there"):
        fingerprints.write({"stamp": {}, "torch": "", "cases": cases}, tmp_path / f"{name}.json")
    fingerprints.forget(["a"], but=tmp_path / "here.json")
    assert fingerprints.read(tmp_path / "here.json")["cases"] == cases
    assert list(fingerprints.read(tmp_path / "there.json")["cases"]) == ["b"]


def test_differences_name_group_and_part() -> None:
    old = {"episode 0": {"time_ns": "a", "state_hash": "b", "skills": "c"}, "metrics": {"S": "d"}}
    new = {"episode 0": {"time_ns": "a", "state_hash": "x", "events": "e"}, "told": {}}
    assert fingerprints.differences(old, old) == []
    assert fingerprints.differences(old, new) == [
        "episode 0: state_hash differ",
        "episode 0: skills are gone",
        "episode 0: events are new",
        "metrics: no longer computed",
        "told: not stored",
    ]
