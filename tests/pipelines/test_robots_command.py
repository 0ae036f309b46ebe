"""``h3data robots``: list, picture, reach, refusals."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest

from h3data_pipelines.cli import main


def test_show_lists_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robots", "show", "--json"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)["robots"]}
    assert set(rows) == {"quad_arm", "lift_arm"}
    assert rows["lift_arm"]["joints"]["wheel_left"] == [None, None]
    assert rows["lift_arm"]["joints"]["lift"] == [0, 1]
    assert "robot_back" in rows["quad_arm"]["cameras"]


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_show_draws_robots_and_any_urdf(tmp_path: Path, capsys: pytest.CaptureFixture[str], suffix: str) -> None:
    box = (
        '<visual><geometry><box size="1 1 1"/></geometry><material name="m"><color rgba="1 0 0 1"/></material></visual>'
    )
    urdf = tmp_path / "cube.urdf"
    urdf.write_text(f'<robot name="cube"><link name="a">{box}</link></robot>')
    out = tmp_path / f"robots{suffix}"
    command = ["robots", "show", "quad_arm", str(urdf), "--views", "4", "--width", "400", "-o", str(out), "--json"]
    assert main(command) == 0
    told = json.loads(capsys.readouterr().out)
    image = cv2.imread(str(out))
    assert image.shape == (told["height"], told["width"], 3)
    assert told["width"] == 400
    blue, green, red = (image[-60:, ..., k].astype(int) for k in range(3))
    assert ((red > 120) & (green < 90) & (blue < 90)).mean() > 0.03  # the cube in the last row
    assert main(command) == 2  # already there
    assert "--force" in capsys.readouterr().err


def test_a_robot_without_looks_is_drawn_as_nothing(tmp_path: Path) -> None:
    urdf = tmp_path / "bare.urdf"
    urdf.write_text('<robot name="bare"><link name="a"/></robot>')
    assert main(["robots", "show", str(urdf), "-o", str(tmp_path / "bare.png")]) == 0


def test_reach_tells_joints_and_whether_it_gets_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robots", "reach", "quad_arm", "0.8", "0.5", "0.1", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["reached"]
    assert found["position_error_m"] < 1e-4
    assert found["joint_pos"]["front_left_knee"] == -1.5
    assert main(["robots", "reach", "lift_arm", "0", "3", "0"]) == 1
    text = capsys.readouterr().out
    assert "out of reach" in text
    assert "at its limit" in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["show", "spot"], "Unknown robot 'spot'"),
        (["show", "-o", "robots.gif"], "ends in .png or .jpg"),
        (["show", "-o", "robots.png", "--views", "0"], "--views 1 to 24"),
        (["show", "-o", "robots.png", "--width", "9999999"], "--width 200 to 8000"),
        (["show", "no/such.urdf"], "found none there"),
        (["reach", "quad_arm", "nan", "0", "0"], "expected a number, got 'nan'"),
        (["reach", "quad_arm", "0", "0", "0", "--link", "tail"], "no link 'tail'"),
    ],
)
def test_refusals(
    words: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["robots", *words]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
