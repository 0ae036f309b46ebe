"""Depth of parts in walls and furniture: what counts, what is reported."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from h3data.geometry import ground_pose
from h3data.recording import Recording, state_hash, write_mcap
from h3data.scene import HomeSpec, build_home
from h3data_pipelines.commands.validating import Validate
from sim_kinematic.agents.penetration import penetration_findings, penetrations, unintended_depth
from sim_kinematic.motion.spec import SocialNavSpec
from tests.simulated import simulate_social_nav, social_nav_episode

STEPS = 40


@pytest.fixture(scope="module")
def recording() -> Recording:
    home = build_home(HomeSpec(preset="small", seed=1))
    return simulate_social_nav(
        social_nav_episode(home, seed=2, spec=SocialNavSpec(max_steps=STEPS)), policy="stand_still"
    )


@pytest.fixture(scope="module")
def in_a_wall(recording: Recording) -> Recording:
    """The robot stands in a corner of the home from step 10 on."""
    columns = dict(recording.columns)
    base = columns["agent_0.base_pose"].copy()
    base[10:] = ground_pose(np.array([0.1, 0.1]), 0.0, 0.0)
    columns["agent_0.base_pose"] = base.astype(np.float32)
    columns["state_hash"] = state_hash({name: values for name, values in columns.items() if name != "state_hash"})
    return replace(recording, columns=columns)


def test_parts_inside_a_wall_are_found(recording: Recording, in_a_wall: Recording) -> None:
    assert not any(finding.subject.startswith("robot") for finding in penetration_findings(recording))
    findings = [f for f in penetration_findings(in_a_wall) if f.subject.startswith("robot")]
    assert findings
    assert {(f.check, f.severity) for f in findings} == {("penetration", "warning")}
    assert min(f.step for f in findings) == 10
    assert any("deep in walls" in f.text for f in findings)


def test_hands_that_reach_do_not_count(in_a_wall: Recording) -> None:
    measured = penetrations(in_a_wall)
    assert (unintended_depth(in_a_wall, measured)[10:] > 0.02).all()
    robot = measured[0]
    hand = replace_depth(robot, np.where(robot.hand, 0.1, 0.0))
    agent = replace(in_a_wall.agents[0], skill_names=("wait", "pick"))
    skill = np.where(np.arange(STEPS) < 20, 1, 0).astype(np.int32)
    reaching = replace(
        in_a_wall, agents=(agent, *in_a_wall.agents[1:]), columns=in_a_wall.columns | {"agent_0.skill": skill}
    )
    np.testing.assert_array_equal(unintended_depth(reaching, [hand]), np.where(np.arange(STEPS) < 20, 0.0, 0.1))


def replace_depth(found, depth):
    return found._replace(depth_m=np.tile(depth, (len(found.steps), 1)))


def test_validate_reports_parts_when_asked(in_a_wall: Recording, tmp_path: Path) -> None:
    path = write_mcap(in_a_wall, tmp_path / "wall.mcap")
    with_parts, without = (Validate(paths=(Path(path),), parts=parts).run() for parts in (True, False))
    subjects = [{f["subject"] for f in out.data["episodes"][0]["findings"]} for out in (with_parts, without)]
    assert any("shank" in subject for subject in subjects[0])
    assert not any("shank" in subject for subject in subjects[1])
