"""Contact between robot and person against Bullet's: recorded poses of Habitat's DidAgentsCollide."""

from __future__ import annotations

import json
from typing import NamedTuple

import numpy as np
import pytest

from h3data.bodies import Robot, load_robot
from h3data.geometry import pose_from_matrix
from h3data.scene import Box, Capsule, Shape
from sim_kinematic.contact import MovingShapes, contacts, distance
from tests.paths import REAL

GOLDEN = REAL / "habitat-lab" / "reference"
pytestmark = pytest.mark.skipif(
    not (GOLDEN / "rearrange" / "did_agents_collide.json").is_file(),
    reason="needs the real Habitat files in ../shared/real",
)
DEPTH_TOL_M = 2e-5


class Poses(NamedTuple):
    cases: list[dict]
    robot: Robot
    human: Robot
    robot_links: np.ndarray
    human_links: np.ndarray


@pytest.fixture(scope="module")
def poses() -> Poses:
    told = json.loads((GOLDEN / "rearrange" / "did_agents_collide.json").read_text())
    cases = told["tests"]
    robot, human = (load_robot(GOLDEN / told["urdf"][who], up="y", fill_in=False) for who in ("robot", "human"))
    column = {human.links[int(moved)].name: c for c, moved in reversed(list(enumerate(human.joint_links)))}
    order = np.array([column[name] + k for name in told["link_order_human"] for k in range(4)])
    joints = np.empty((len(cases), len(order)))
    joints[:, order] = [c["human_joint_positions"] for c in cases]
    base = {who: pose_from_matrix(np.array([c[f"{who}_sim_obj_T"] for c in cases])) for who in ("robot", "human")}
    return Poses(
        cases,
        robot,
        human,
        robot.link_matrices(base["robot"], [c["robot_joint_positions"] for c in cases]),
        human.link_matrices(base["human"], joints),
    )


def shapes_of(robot: Robot) -> tuple[list[Shape], list[int]]:
    """All collision shapes and the link of each."""
    return [s for link in robot.links for s in link.shapes], [
        k for k, link in enumerate(robot.links) for _ in link.shapes
    ]


def as_capsule(shape: Shape) -> Shape:
    """The largest capsule along the longest side of a box."""
    assert isinstance(shape, Box)
    half = np.asarray(shape.half_extents)
    axis = np.zeros(3)
    axis[np.argmax(half)] = 1.0
    radius = float(np.min(half))
    way = axis * (half.max() - radius)
    return Capsule(start=shape.pose[:3] - way, end=shape.pose[:3] + way, radius=radius)


def test_boxes_touch_where_and_as_deep_as_in_bullet(poses: Poses) -> None:
    (first, of_first), (second, of_second) = shapes_of(poses.robot), shapes_of(poses.human)
    robot, human = MovingShapes(first), MovingShapes(second)
    hits = 0
    for k, case in enumerate(poses.cases):
        robot.set_transforms(poses.robot_links[k, of_first])
        human.set_transforms(poses.human_links[k, of_second])
        found = contacts(robot, human)
        assert bool(found) == case["did_collide"], (k, distance(robot, human))
        if found:
            hits += 1
            assert found[0].depth_m == pytest.approx(-case["min_contact_distance"], abs=DEPTH_TOL_M)
            touched = {poses.human.links[of_second[c.index_b]].name for c in found}
            touched |= {poses.robot.links[of_first[c.index_a]].name for c in found}
            assert set(case["links"]) <= touched
    assert hits == 100


def test_capsules_instead_of_boxes_find_the_same_contacts(poses: Poses) -> None:
    """The profile of our own people, on this skeleton: they lie inside the boxes, so none can be found that is not there."""
    (first, of_first), (second, of_second) = shapes_of(poses.robot), shapes_of(poses.human)
    robot = MovingShapes(first)
    human = MovingShapes([as_capsule(s) for s in second])
    for k, case in enumerate(poses.cases):
        robot.set_transforms(poses.robot_links[k, of_first])
        human.set_transforms(poses.human_links[k, of_second])
        assert bool(contacts(robot, human)) == case["did_collide"], (k, case["min_contact_distance"])
