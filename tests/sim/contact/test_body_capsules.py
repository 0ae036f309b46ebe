"""The capsules around agents hide no contact that FCL finds, and clear most of what FCL need not look at."""

from __future__ import annotations

import numpy as np

from h3data.bodies import load_humanoid, load_robot
from h3data.geometry import IDENTITY_POSE, ground_pose
from sim_kinematic.contact import AgentContacts
from sim_kinematic.contact.body_capsules import AgentCapsules, may_touch
from sim_kinematic.contact.frames import body_shapes, shape_frames


def stored(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32).astype(np.float64)


def test_no_contact_is_hidden() -> None:
    robot, person, rng = load_robot("quad_arm"), load_humanoid("female_0"), np.random.default_rng(0)
    contacts = AgentContacts(body_shapes(robot), body_shapes(person))
    capsules = AgentCapsules(robot), AgentCapsules(person)
    low, high = np.maximum(robot.lower, -3.0), np.minimum(robot.upper, 3.0)
    seen = {True: 0, False: 0}
    for _ in range(300):
        joints = low + rng.random(len(low)) * (high - low)
        base = ground_pose(rng.uniform(-0.9, 0.9, 2), float(rng.uniform(-3, 3)), 0.1)
        root = ground_pose(np.zeros(2), float(rng.uniform(-3, 3)), 0.1)
        (quats,), (pelvis,) = person.clip_pose([1], [rng.random()], [rng.random()])
        contacts.update(0, shape_frames(robot, robot.link_matrices(stored(base)[None], stored(joints)[None]))[0])
        contacts.update(1, shape_frames(person, person.joint_matrices(stored(root), quats[None], pelvis[None]))[0])
        capsules[0].pose(joints)
        capsules[1].pose(quats, pelvis)
        may = may_touch(capsules[0], base, capsules[1], root)
        assert may or not contacts.collides()
        seen[may] += 1
    assert min(seen.values()) > 50


def test_ends_are_where_the_frames_of_links_and_joints_put_them() -> None:
    robot, person, root = load_robot("quad_arm"), load_humanoid("female_0"), IDENTITY_POSE
    (quats,), (pelvis,) = person.clip_pose([1], [0.3], [1.0])
    links = robot.link_matrices(root[None], robot.rest[None])[0]
    joints = person.joint_matrices(root, quats[None], pelvis[None])[0]
    for body, frames, posture in ((robot, links, (robot.rest,)), (person, joints, (quats, pelvis))):
        capsules = AgentCapsules(body)
        capsules.pose(*posture)
        of, ends = capsules._args[:2]
        expected = np.einsum("nij,nkj->nki", frames[of, :3, :3], ends) + frames[of, None, :3, 3]
        np.testing.assert_allclose(capsules.ends, expected, atol=1e-12)
