"""Robots of one's own as agents: which joints are the arm, and how `--agents` names robots and people."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from h3data.bodies import load_robot
from h3data.errors import FormatError, InputError
from h3data.scene import FreeSpace
from h3data_homes import HomeSpec, build_home
from sim_kinematic.agents.robots.arm_clearance import arm_links
from sim_kinematic.agents.robots.skills import RobotActor, checked_command
from sim_kinematic.agents.roster import make_roster
from sim_kinematic.agents.skills import Objects
from sim_kinematic.motion.spec import BaseSpec
from sim_kinematic.motion.state import WorldState
from tests.bodies.robots.cart_robot import ARM, CART_SETTINGS, WHEELS, write_cart


@pytest.fixture(scope="module")
def cart(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_cart(tmp_path_factory.mktemp("cart"), CART_SETTINGS)


def test_the_arm_is_not_the_first_seven_joints(cart: Path) -> None:
    robot = load_robot(cart)
    assert robot.joint_names == (*WHEELS, *ARM, "finger_left")
    assert tuple(robot.joint_names[column] for column in robot.arm_columns) == ARM
    moved = {robot.links[k].name for k in arm_links(robot)}
    assert moved == {*ARM, "gripper", "finger_left", "finger_right"}
    assert checked_command(np.zeros(12), robot).shape == (12,)


def test_all_arm_joints_move_and_no_wheel(cart: Path) -> None:
    robot = load_robot(cart)
    free = FreeSpace.from_scene(build_home(HomeSpec(preset="small", seed=1)))
    state = WorldState.zeros(1, robots=1, people=0, joints=len(robot.rest), objects=1)
    state.robots[0].joints[0], state.robots[0].xz[0] = robot.rest, free.sample(np.random.default_rng(0), 1)[0]
    actor = RobotActor(robot, free, BaseSpec(), Objects(("cup",), np.zeros((1, 3)), state), 0.15, 8.0)
    posture = np.arange(12) / 20
    for _ in actor._bring_arm(posture):
        pass
    np.testing.assert_array_equal(actor.joints[2:11], posture[2:11])
    np.testing.assert_array_equal(actor.joints[:2], robot.rest[:2])
    np.testing.assert_array_equal(actor.arm, posture[2:11])


def test_a_hand_that_follows_a_joint_elsewhere_has_an_arm(tmp_path: Path) -> None:
    """The hand's only joint mimics one that is not between base and hand."""
    axis = '<origin/><axis xyz="0 0 1"/><limit lower="-1" upper="1"/>'
    urdf = tmp_path / "follower.urdf"
    urdf.write_text(
        '<robot name="follower"><link name="base"/><link name="dial"/><link name="hand"/>'
        f'<joint name="dial" type="revolute"><parent link="base"/><child link="dial"/>{axis}</joint>'
        '<joint name="hand" type="revolute"><parent link="base"/><child link="hand"/>'
        f'{axis}<mimic joint="dial" multiplier="2"/></joint></robot>'
    )
    (tmp_path / "robot.toml").write_text('hand_link = "hand"')
    assert load_robot(urdf).arm_columns == (0,)


def test_robots_without_an_arm_say_so(tmp_path: Path) -> None:
    robot = load_robot(write_cart(tmp_path, 'hand_link = "base"'))
    assert robot.arm_columns == ()
    with pytest.raises(InputError, match=r"(?s)cart.*joint that moves.*hand base.*H3-BODY-095"):
        checked_command(np.zeros(3), robot)
    with pytest.raises(InputError, match=r"(?s)cart.*hand.*H3-BODY-095"):
        load_robot(write_cart(tmp_path / "other", "base_radius_m = 0.3")).require_arm()


# --- the roster -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("form", ["{urdf}", "robot:{urdf}", "robot:{folder}", "{folder}", "{folder}/robot.toml"])
def test_a_robot_by_path_is_an_agent(cart: Path, form: str) -> None:
    model = form.format(urdf=cart, folder=cart.parent)
    roster = make_roster(f"human, {model}")
    assert [agent.kind for agent in roster] == ["robot", "human"]
    assert roster[0].model == model.removeprefix("robot:")
    assert roster[0].body is load_robot(cart)


def test_kinds_may_be_named_with_their_bodies() -> None:
    listed = "human:male_1,robot:lift_arm,robot,human"
    assert [(a.name, a.model) for a in make_roster(listed)] == [
        ("robot_1", "lift_arm"),
        ("robot_2", "quad_arm"),
        ("human_1", "male_1"),
        ("human_2", "female_0"),
    ]


@pytest.mark.parametrize(
    ("agents", "message"),
    [
        ("robot:", r"(?s)''.*H3-BODY-102"),
        ("robot:female_0", r"(?s)'female_0'.*H3-BODY-102"),
        ("human:quad_arm", r"(?s)'quad_arm'.*H3-BODY-072"),
        ("robot:no/such.urdf", r"(?s)no/such\.urdf.*H3-BODY-116"),
        ("no/such/robot.toml", r"(?s)no/such/robot\.toml.*H3-BODY-106"),
        ("cat:no-such", r"(?s)'cat:no-such'.*H3-SIM-019"),
        ("quadarm", r"(?s)Did you mean 'quad_arm'.*H3-SIM-019"),
    ],
)
def test_unknown_bodies_are_named(agents: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_roster(agents)


def test_a_robot_toml_names_its_urdf(tmp_path: Path, cart: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    for name in ("a", "b"):
        write_cart(folder).rename(folder / f"{name}.urdf")
    with pytest.raises(InputError, match=r'(?s)= "FILE".*a\.urdf, b\.urdf.*H3-BODY-105'):
        load_robot(folder)
    (folder / "robot.toml").write_text('urdf = "b.urdf"\nbase_radius_m = 0.31')
    assert load_robot(folder).base_radius_m == load_robot(folder / "b.urdf").base_radius_m == 0.31
    assert load_robot(folder / "a.urdf").base_radius_m != 0.31
    (folder / "robot.toml").write_text(f'urdf = "{cart}"')
    assert load_robot(folder).name == "cart"
    (folder / "robot.toml").write_text("base_radius_m = nan")
    with pytest.raises(FormatError, match=r"(?s)base_radius_m.*robot\.toml.*H3-BODY-109"):
        load_robot(folder / "a.urdf")
