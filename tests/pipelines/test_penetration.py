"""Depth of parts in walls and furniture: what counts, what is reported."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.penetration import run
from h3data.bodies.robots.robot_files import robot_names
from h3data.geometry import ground_pose
from h3data.recording import Recording, state_hash, write_mcap
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.commands.validating import Validate
from h3data_pipelines.validation.penetration import HELD, REACHING, penetration_findings, penetrations, unintended_depth
from sim_kinematic.motion.spec import SocialNavSpec
from tests.simulated import rearrange_episode, simulate_rearrange, simulate_social_nav, social_nav_episode

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


def test_everything_counts_that_reaches_for_nothing(in_a_wall: Recording) -> None:
    assert (unintended_depth(penetrations(in_a_wall))[10:] > 0.02).all()


def test_a_hand_may_be_in_what_the_object_lies_on_while_it_picks() -> None:
    """It may not be anywhere else then, nor there at any other time; nor may any other part."""
    home = build_home(HomeSpec(preset="small", seed=1))
    recording = simulate_rearrange(rearrange_episode(home, seed=1), solo_steps=1)
    pick = next(
        span for span in recording.skills if span.name == "pick" and recording.agents[span.agent].kind == "human"
    )
    measured = next(found for found in penetrations(recording) if found.agent == pick.agent)
    allowed = {measured.parts[p] for p in np.flatnonzero(measured.reaching)}
    assert allowed == {"left_forearm", "left_hand", "right_forearm", "right_hand", HELD}
    assert not measured.intended[:, ~measured.reaching].any()
    reaches = np.zeros(len(recording), np.bool_)
    for span in recording.skills:
        if span.agent == pick.agent and span.name in REACHING:
            reaches[span.start_step : span.end_step + 1] = True
    assert not measured.intended[~reaches].any()
    inside = measured.intended & (measured.depth_m > 0)
    assert inside.any(), "the hand that takes something from a table is in the table"
    assert set(measured.thing[inside]).isdisjoint({"walls", ""})


@pytest.mark.slow
@pytest.mark.parametrize("robot", robot_names())
def test_nothing_of_any_shipped_robot_or_person_is_inside_anything(robot: str) -> None:
    """Six episodes of each task; ``python -m benchmarks penetration --robot all`` measures fifty."""
    figures: dict[str, float] = {}
    run(lambda name, value, unit: figures.setdefault(name, value), episodes=6, robots=(robot,))
    shares = {name: share for name, share in figures.items() if name.endswith(".above_2cm")}
    assert len(shares) == 3
    assert max(shares.values()) <= 0.002, shares


def test_validate_reports_parts_when_asked(in_a_wall: Recording, tmp_path: Path) -> None:
    path = write_mcap(in_a_wall, tmp_path / "wall.mcap")
    with_parts, without = (Validate(paths=(Path(path),), parts=parts).run() for parts in (True, False))
    subjects = [{f["subject"] for f in out.data["episodes"][0]["findings"]} for out in (with_parts, without)]
    assert any("shank" in subject for subject in subjects[0])
    assert not any("shank" in subject for subject in subjects[1])
