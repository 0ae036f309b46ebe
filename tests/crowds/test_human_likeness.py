"""Figures of the motion of people (`benchmarks.people`): files of tracks by hand, groups, and what nobody's motion tells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.people import MEASURED, Walks, describe, read_walks, run, table

RATE_HZ = 2.5


def write_tracks(path: Path, people: dict[str, tuple[range, np.ndarray]]) -> Path:
    """Write a CSV of people who are seen in some rows at places [T, 2]."""
    lines = ["t,id,x,y"]
    for name, (rows, at) in people.items():
        lines += [f"{k / RATE_HZ:.3f},{name},{x:.4f},{y:.4f}" for k, (x, y) in zip(rows, at, strict=True)]
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def line(rows: range, x: float, y: float, vx: float) -> tuple[range, np.ndarray]:
    """Places of somebody who walks along x at a speed, at x and y in row 0."""
    seconds = np.array(rows) / RATE_HZ
    return rows, np.stack([x + vx * seconds, np.full(len(rows), y)], 1)


def test_a_file_of_tracks_is_measured_as_by_hand(tmp_path: Path):
    rows = range(60)
    people = {
        "slow": line(rows, 0.0, 0.0, 1.0),
        "fast": line(rows, 0.0, 50.0, 1.5),
        "late": line(range(20, 60), 0.0, 100.0, 2.0),  # seen for 16 of 24 s
        # two who meet head-on at 12 s with 0.7 m between them
        "east": line(rows, -12.0, 150.0, 1.0),
        "west": line(rows, 12.0, 150.7, -1.0),
        "still": line(rows, 0.0, 200.0, 0.0),
    }
    figures = describe([read_walks(str(write_tracks(tmp_path / "a.csv", people)))])
    assert figures["person_hours"][0] == pytest.approx((5 * 60 + 40) / RATE_HZ / 3600)
    assert figures["speed_mps"][0] == pytest.approx((1.0 + 1.5 + 2.0 + 1.0 + 1.0) / 5, abs=1e-3)
    assert figures["speed_sd_mps"][0] == pytest.approx(np.std([1.0, 1.5, 2.0, 1.0, 1.0]), abs=1e-3)
    assert figures["encounters"][0] == 1
    assert figures["closest_p5_m"][0] == pytest.approx(0.7, abs=0.3)  # places are 0.8 m of their way apart
    assert figures["majority_side"][0] == 1
    assert figures["standing"][0] == pytest.approx(59 / (5 * 59 + 39), abs=1e-6)
    assert "spacing_m" not in figures, "files of tracks name no groups"


def test_spacing_is_of_groups_and_strangers_are_counted_alone():
    seconds = np.arange(300) / 30
    xz = np.stack([np.stack([seconds, np.full(300, z)], 1) for z in (0.0, 0.8, 2.3, 3.5)], 1)
    there = np.ones(xz.shape[:2])
    walks = Walks(xz, np.diff(xz, axis=0) * 30, there[:, 0] < 0, 9 * there, 12 * there, there > 0, groups=((0, 1),))
    figures = describe([walks])
    assert figures["spacing_m"][0] == pytest.approx(0.8)
    assert figures["encounters"][0] == 4, "0 and 3 are too far apart, 0 and 1 belong together"
    assert figures["closest_p5_m"][0] == pytest.approx(1.2, abs=0.1)
    shown = table({"us": figures}).splitlines()
    assert [row.split()[0] for row in shown[1:]] == list(figures)
    assert "0.69 to 1.15" in next(row for row in shown if row.startswith("spacing_m"))


def test_the_command_measures_files_and_refuses_what_it_cannot_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = write_tracks(
        tmp_path / "mine.csv", {"a": line(range(30), 0.0, 0.0, 1.0), "b": line(range(30), 0.0, 9.0, 1.2)}
    )
    told: dict[str, float] = {}
    run(lambda name, value, unit: told.update({name: value}), tracks=[str(file)])
    assert told["people.mine.speed_mps"] == pytest.approx(1.1, abs=1e-3)
    assert {name.rpartition(".")[2] for name in told} <= {"person_hours", "encounters", *MEASURED}
    assert "mine.csv" in capsys.readouterr().out
    (tmp_path / "bad.csv").write_text("a;b\n1;2\n", encoding="utf-8")
    for name in ("bad.csv", "none.csv"):
        with pytest.raises(SystemExit, match="error: "):
            main(["people", "--tracks", str(tmp_path / name)])
