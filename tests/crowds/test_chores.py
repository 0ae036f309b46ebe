"""Chores: people open a fridge, take something, put it down, carry a tray; hands are at what they hold."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import h3data
from h3data.bodies import Humanoid, load_humanoid
from h3data.bodies.people.reach import hand_points
from h3data.errors import InputError
from h3data.recording.records import JOINTS
from h3data.replay import Replay
from h3data.scene.articulation import handle_points, joints_of
from h3data.scene.open import named_scenes, open_free_space, open_scene
from h3data_crowds.chores import ChoreRoutine, act_out, chore_at
from h3data_pipelines.validation.recordings import validate_recording
from sim_kinematic.crowd.routines import Stop
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.policies.crowd.people import CrowdPolicy
from sim_kinematic.tasks.resume import verify

HOME = "medium-open:3"
STOPS = Stop("fridge_0", "take", 12.5), Stop("kitchen_counter_0", "put", 9.0), Stop("dining_table_0", "lift", 8.5)


def resident(task: Any, episode: Any, number: int) -> CrowdPolicy:
    """A person who does chores."""
    routine = ChoreRoutine(episode.scene, episode.free, STOPS, episode.roster[number].body)
    return CrowdPolicy("orca", episode.free, episode.seed, number, episode.spec.human, routine=routine)


@pytest.fixture(scope="module")
def played() -> h3data.Recording:
    agents = {"human": f"{__name__}:resident"}
    return h3data.simulate("wander", HOME, roster=["female_1"], agents=agents, seed=3, max_steps=1200)


@pytest.fixture(scope="module")
def acted(played: h3data.Recording) -> h3data.Recording:
    return act_out(played)


@pytest.mark.slow
def test_acting_out_changes_nobodys_way_and_the_original_verifies(
    played: h3data.Recording, acted: h3data.Recording
) -> None:
    assert verify(played).difference is None
    np.testing.assert_array_equal(acted.agent_column(0, "base_pose"), played.agent_column(0, "base_pose"))
    assert [finding.text for finding in validate_recording(acted) if finding.severity == "error"] == []
    walks = h3data.simulate("wander", "small:1", agents={"human": "still", "robot": "still"}, seed=1, max_steps=20)
    assert act_out(walks) is walks


def test_a_hand_leads_the_door_and_the_other_one_takes(acted: h3data.Recording) -> None:
    replay = Replay(acted)
    body, scene = replay.model(0), replay.scene
    assert isinstance(body, Humanoid)
    assert scene is not None
    joints, positions = joints_of(scene), acted.columns[JOINTS].astype(np.float64)
    k = joints.index("fridge_0/door")
    assert joints.is_open(positions.max(0))[k]
    assert positions[-1, k] == pytest.approx(joints.closed[k], abs=1e-3)
    moving = np.flatnonzero(np.abs(np.diff(positions[:, k])) > 1e-4)
    motions = joints.motions(positions[moving])[:, k]
    handle = motions[:, :3, :3] @ handle_points(scene)[k] + motions[:, :3, 3]
    palms = np.stack([hand_points(replay.joint_matrices(0, moving), body, hand) for hand in ("left", "right")], 1)
    assert np.linalg.norm(palms - handle[:, None], axis=2).min(1).max() < 0.02


def test_what_is_taken_stays_where_it_was_put(acted: h3data.Recording) -> None:
    told = [(event.kind, event.target, event.detail) for event in acted.events if event.kind in ("takes", "puts")]
    assert told == [
        ("takes", "human_carton_0", "fridge_0"),
        ("puts", "human_carton_0", "kitchen_counter_0"),
        ("takes", "human_tray", "dining_table_0"),
    ]
    step = next(event.step for event in acted.events if event.kind == "puts")
    (carton,) = [body for body in acted.moving_bodies if "carton" in body.name]
    track = acted.columns["object_pose"][:, carton.moving]
    assert (track[step:] == track[step]).all()
    assert track[step, 1] == pytest.approx(1.0, abs=0.03)  # on a worktop of 0.9 m
    assert np.linalg.norm(np.diff(track[:, :3], axis=0), axis=1).max() < 0.08


def test_what_cannot_be_done_is_refused() -> None:
    source = named_scenes(HOME)[0].source
    rules = SocialNavSpec()
    scene, free = open_scene(source), open_free_space(source, rules.agent_radius_m, rules.agent_height_m)
    body, near = load_humanoid("female_1"), np.array([7.0, 9.1])
    with pytest.raises(InputError, match="H3-TASK-086"):
        chore_at(scene, free, body, Stop("dining_table_0", "take", 12.5), near=near)
    routine = ChoreRoutine(scene, free, [Stop("fridge_0", "take", 3.0)], body)
    found = routine.next_stop(near)
    assert found is not None
    assert "at least" in found[1].refused[1]
