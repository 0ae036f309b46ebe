"""A URDF alone as a robot: the robot.toml drafted from it gives the same one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from h3data.bodies import Robot, load_robot
from h3data.geometry import IDENTITY_POSE
from h3data_pipelines.cli import main
from h3data_worlds.robot_guess import row_radius
from h3data_worlds.shape_points import shape_points
from tests.bodies.robots.cart_robot import write_cart

SHARED = Path(__file__).parents[4] / "shared" / "robots"


def _same(one: Robot, other: Robot) -> None:
    assert (one.name, one.joint_names, one.hand_link) == (other.name, other.joint_names, other.hand_link)
    for name in ("rest", "base_discs", "hull_discs", "hand_position", "hand_axes", "to_base"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    assert (one.base_radius_m, one.body_height_m) == (other.base_radius_m, other.body_height_m)
    assert [c.name for c in one.cameras] == [c.name for c in other.cameras]
    for a, b in zip(one.cameras, other.cameras, strict=True):
        np.testing.assert_array_equal(a.pose, b.pose)


@pytest.mark.slow
def test_the_drafted_settings_give_the_same_robot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    urdf = write_cart(tmp_path / "cart")
    out = tmp_path / "mine" / "robot.toml"
    out.parent.mkdir()
    guessed = load_robot(urdf)
    command = ["robots", "init", str(urdf), "-o", str(out)]
    assert main(command) == 0
    _same(load_robot(out), guessed)
    assert main(command) == 2
    assert "--force" in capsys.readouterr().err
    assert main(["robots", "init", str(urdf)]) == 0, "by default beside the URDF"
    _same(load_robot(urdf), guessed)


@pytest.mark.parametrize("name", ["fetch", pytest.param("tiago_no_hand", marks=pytest.mark.slow)])
def test_published_robots_are_drafted(name: str, tmp_path: Path) -> None:
    urdf = SHARED / f"{name}.urdf"
    if not urdf.is_file():
        pytest.skip(f"the reference data have no {urdf.name}")
    out = tmp_path / "robot.toml"
    assert main(["robots", "init", str(urdf), "-o", str(out)]) == 0
    robot = load_robot(out)
    _same(robot, load_robot(urdf))
    assert len(robot.arm_columns) >= 7
    covered = float(row_radius(robot.base_discs, _outline(robot)))
    assert covered <= robot.base_radius_m + 1e-3, "discs cover the folded arm beside the base"


def _outline(robot: Robot) -> np.ndarray:
    """Floor points ``(x, z)`` [N, 2] under the resting robot."""
    frames = robot.link_matrices(IDENTITY_POSE[None], robot.rest[None])[0]
    points = [
        shape_points(shape) @ frames[k, :3, :3].T + frames[k, :3, 3]
        for k, link in enumerate(robot.links)
        for shape in link.shapes
    ]
    return np.concatenate(points)[:, [0, 2]]
