"""Depth of parts in walls and furniture: what counts, what is reported."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import h3data
from benchmarks.penetration import run
from h3data.bodies.robots.robot_files import robot_names
from h3data.geometry import ground_pose
from h3data.recording import Recording, state_hash, write_mcap
from h3data.recording.records import JOINTS
from h3data.replay import Replay
from h3data.scene.articulation import joints_of
from h3data.scene.records import instance_bounds
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


@pytest.fixture(scope="module")
def at_home() -> Recording:
    """Two people who have not begun a chore."""
    roster, agents = ["female_0", "male_1"], {"human": "orca+chores"}
    return h3data.simulate("wander", "small2-open:2", roster=roster, agents=agents, seed=2, max_steps=20)


def moved(recording: Recording, **columns: np.ndarray) -> Recording:
    return replace(recording, columns={**recording.columns, **columns})


def at_rest(recording: Recording, agent: int, xz: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of an agent who stands at a place."""
    base = ground_pose(xz, 0.0, recording.columns[f"agent_{agent}.base_pose"][0, 1])
    return {f"agent_{agent}.base_pose": np.tile(base, (len(recording), 1)).astype(np.float32)}


def test_a_door_counts_where_it_is(at_home: Recording) -> None:
    scene = Replay(at_home).scene
    assert scene is not None
    joints = joints_of(scene)
    k = next(k for k, name in enumerate(joints.names) if name.startswith("fridge"))
    leaf = next(each for each in scene.instances if joints.owner.get(each.name) == k)
    positions = np.tile(joints.rest, (len(at_home), 1))
    positions[10:, k] = joints.opened[k]
    middle = instance_bounds(scene, leaf).mean(0)
    x, _, z = (joints.motions(positions[-1])[k] @ np.append(middle, 1.0))[:3]
    in_the_leaf = at_rest(at_home, 1, np.array([x, z]))
    found = penetrations(moved(at_home, **in_the_leaf, **{JOINTS: positions.astype(np.float32)}))[1]
    assert (found.unintended_m[10:].max(1) > 0.05).all()
    assert "door" not in found.kind[:10]
    deepest = found.unintended_m[10:].argmax(1)
    assert set(found.thing[np.arange(10, 20), deepest]) == {leaf.name}
    assert set(found.kind[np.arange(10, 20), deepest]) == {"door"}
    still = penetrations(moved(at_home, **in_the_leaf, **{JOINTS: positions.astype(np.float32)}), moved=False)[1]
    assert leaf.name not in still.thing
    # where it was before it opened there is nothing any more
    away = at_rest(at_home, 1, middle[[0, 2]])
    behind = penetrations(moved(at_home, **away, **{JOINTS: positions.astype(np.float32)}))[1]
    assert leaf.name in behind.thing[:10]
    assert leaf.name not in behind.thing[10:]


def test_what_others_carry_counts_while_it_moves(at_home: Recording) -> None:
    tray = next(body for body in at_home.moving_bodies if body.name.startswith("human_1_tray"))
    poses = at_home.columns["object_pose"].copy()
    x, y, z = at_home.columns["agent_1.base_pose"][0, :3].tolist()
    poses[:, tray.moving] = [x, y + 1.1, z, 0, 0, 0, 1]
    poses[5:15, tray.moving, 0] += 0.01 * np.arange(10)
    person = at_rest(at_home, 1, np.array([x, z]))
    own, other = penetrations(moved(at_home, object_pose=poses, **person, **at_rest(at_home, 0, np.array([x, z]))))
    rows = np.flatnonzero((other.kind == "carried").any(1))
    assert rows[0] <= 5
    assert rows[-1] == 15
    assert len(rows) == 11
    assert other.unintended_m[rows].max() > 0.05
    assert "carried" not in own.kind, "it is in their own hands"


@pytest.mark.slow
@pytest.mark.parametrize("robot", robot_names())
def test_nothing_of_any_shipped_robot_or_person_is_inside_anything(robot: str) -> None:
    """Six episodes of each task; ``python -m benchmarks penetration --robot all`` measures fifty."""
    figures: dict[str, float] = {}
    run(lambda name, value, unit: figures.setdefault(name, value), episodes=6, robots=(robot,))
    # people who do chores lean into what they handle (docs/crowds.md)
    shares = {
        name: share for name, share in figures.items() if name.endswith(".above_2cm") and "open_homes" not in name
    }
    assert len(shares) == 3
    assert max(shares.values()) <= 0.002, shares


def test_validate_reports_parts_when_asked(in_a_wall: Recording, tmp_path: Path) -> None:
    path = write_mcap(in_a_wall, tmp_path / "wall.mcap")
    with_parts, without = (Validate(paths=(Path(path),), parts=parts).run() for parts in (True, False))
    subjects = [{f["subject"] for f in out.data["episodes"][0]["findings"]} for out in (with_parts, without)]
    assert any("shank" in subject for subject in subjects[0])
    assert not any("shank" in subject for subject in subjects[1])
