"""Robots of installed packages: found and listed by name; broken ones are named, the others go on working."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from h3data.bodies import load_robot, robot_names
from h3data.errors import PluginError
from h3data.plugins import PluginWarning
from h3data_pipelines.cli import main
from sim_kinematic.agents.roster import make_roster
from tests.bodies.robots.cart_robot import CART_SETTINGS, write_cart

GROUP = "h3data.robots"
Install = Callable[..., None]


@pytest.fixture
def acme(install_package: Install, tmp_path: Path) -> str:
    """A package with one robot, ``acme_cart``."""
    write_cart(tmp_path / "robot", CART_SETTINGS)
    install_package("acme", GROUP, {"acme_cart": "acme:CART"}, f"CART = {str(tmp_path / 'robot')!r}")
    return "acme_cart"


def test_a_robot_of_a_package_is_found_by_name(acme: str) -> None:
    assert robot_names() == ("lift_arm", "quad_arm", acme)
    assert load_robot(acme) is load_robot("acme:CART")
    assert load_robot(acme).hand_name == "gripper"
    for agents in (acme, f"robot:{acme}", "robot:acme:CART"):
        assert make_roster(f"{agents},human")[0].body is load_robot(acme)


@pytest.mark.parametrize(
    ("source", "fault"),
    [
        ("1 / 0", r"cannot be imported: ZeroDivisionError"),
        ("OTHER = 1", r"cannot be imported: AttributeError"),
        ("BAD = 3", r"is not usable: expected the path of a \.urdf.*got 3"),
        ("BAD = 'no/such.urdf'", r"is not usable: .*found none there: no/such\.urdf"),
    ],
)
def test_a_broken_plug_in_is_named(
    acme: str,
    install_package: Install,
    source: str,
    fault: str,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    install_package("broken", GROUP, {"bad": "broken:BAD"}, source)
    named = r"robot 'bad' \(entry point broken:BAD of the group h3data\.robots, installed by broken 1\.2\) "
    with pytest.raises(PluginError, match=rf"(?s){named}{fault}.*H3-FILE-01[56]"):
        load_robot("bad")
    assert main(["robots", "show", "--json"]) == 0
    listed = capsys.readouterr().out
    assert [row["name"] for row in json.loads(listed)["robots"]] == ["lift_arm", "quad_arm", "cart"]
    assert "installed by broken 1.2" in caplog.text
    assert load_robot(acme).name == "cart"


def test_taken_names_stay_with_their_owner(acme: str, install_package: Install) -> None:
    install_package("rival", GROUP, {"quad_arm": "rival:A", acme: "rival:B"}, "A = B = '/nowhere.urdf'")
    assert load_robot("quad_arm").name == "quad_arm"
    with pytest.raises(PluginError, match=r"(?s)'acme_cart'.*\w+:\w+ of \w+ 1\.2 .*H3-FILE-013"):
        load_robot(acme)
    with pytest.warns(PluginWarning) as warned:
        assert robot_names() == ("lift_arm", "quad_arm")
    texts = sorted(str(warning.message) for warning in warned)
    assert "'acme_cart' is claimed by" in texts[0]
    assert "'quad_arm' is built in; rival:A of rival 1.2 cannot replace it" in texts[1]
    assert load_robot("acme:CART").hand_name == "gripper"
