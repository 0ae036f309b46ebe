"""Robots that cannot play: one clear error each; what they can play, they play."""

from __future__ import annotations

from pathlib import Path

import pytest

import h3data
from h3data_pipelines.cli import main
from tests.bodies.robots.cart_robot import write_cart

NO_ARM = (
    '<robot name="crate"><link name="base"><collision><geometry><box size="0.4 0.3 0.2"/></geometry></collision></link>'
    "</robot>"
)


def _generate(task: str, robot: Path, out: Path) -> int:
    words = ["--agents", f"robot:{robot},human", "--episodes", "1", "--max-steps", "20", "-o", str(out)]
    return main(["generate", task, *words])


@pytest.mark.parametrize("task", [pytest.param("social_nav", marks=pytest.mark.slow), "wander", "rearrange"])
def test_a_robot_without_an_arm(task: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    urdf = tmp_path / "crate.urdf"
    urdf.write_text(NO_ARM)
    assert _generate(task, urdf, tmp_path / "out") == (2 if task == "rearrange" else 0)
    if task == "rearrange":
        error = capsys.readouterr().err
        assert (
            "error: Robot crate has no hand, so it has no arm to move. Hint: name its hand_link in robot.toml" in error
        )


def test_a_malformed_urdf(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    urdf = tmp_path / "torn.urdf"
    urdf.write_text('<robot name="torn"><link')
    assert _generate("wander", urdf, tmp_path / "out") == 2
    assert "error: Expected URDF, this is not well-formed XML" in capsys.readouterr().err


def test_a_base_too_wide_for_every_door(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_cart(tmp_path / "wide", 'base_radius_m = 1.2\nhand_link = "gripper"\n')
    assert _generate("social_nav", tmp_path / "wide", tmp_path / "out") == 2
    assert "the robot did not fit: base_discs_m and base_radius_m of its robot.toml" in capsys.readouterr().err


@pytest.mark.slow
def test_a_robot_with_eight_arm_joints_picks_places_and_is_verified(tmp_path: Path) -> None:
    """A URDF alone, without a robot.toml."""
    cart, out = write_cart(tmp_path / "cart"), str(tmp_path / "out")
    assert main(["generate", "rearrange", "--agents", f"robot:{cart},human", "--episodes", "1", "-o", out]) == 0
    (recording,) = h3data.open(out)
    done = [event.kind for event in recording.events if event.agent == 0]
    assert done.index("pick") < done.index("place")
    assert recording.episode.info["ended"] == "success"
    assert main(["replay", out, "--verify"]) == 0
