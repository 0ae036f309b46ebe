"""People and robots driven from outside, one command for each step: what they can do, what they are refused, and that a
recording comes out again from its raw input."""

from __future__ import annotations

import io
import json
import runpy
import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import h3data
from h3data.errors import InputError
from h3data.recording import Recording, open_recording
from h3data_pipelines.cli import main
from h3data_pipelines.validation.recordings import validate_recording
from sim_kinematic.agents.driven.commands import (
    STAND,
    Drop,
    HandOver,
    HandTarget,
    PersonCommand,
    Pick,
    Place,
    action_of,
    command_from_json,
    command_to_json,
)
from sim_kinematic.agents.driven.person import DrivenPerson
from sim_kinematic.agents.skills import ALL_SKILLS, Action
from sim_kinematic.motion.state import NOBODY
from sim_kinematic.policies.policy import External, Velocity
from sim_kinematic.tasks.resume import counterfactual, resume, verify
from sim_kinematic.tasks.sessions import Session
from tests.paths import ROOT

EXAMPLE = ROOT / "examples/drive_person.py"


def begun(robot: Any = "still", **options: Any) -> Session:
    """A session of rearrangement whose person is driven."""
    return h3data.session("rearrange", "small:3", agents={"person": External(), "robot": robot}, **options)


def driven(session: Session) -> DrivenPerson:
    person = session.play.team.people[0]  # type: ignore[attr-defined]
    assert isinstance(person, DrivenPerson)
    return person


def put_at(session: Session, point: Any) -> None:
    """Puts the person where a world point is in reach."""
    person = driven(session)
    stand = person.stand_for(point)
    assert stand is not None
    pose = person.person.base.copy()
    pose[[0, 2]] = stand[:2]
    pose[3:] = [0, np.sin(stand[2] / 2), 0, np.cos(stand[2] / 2)]
    person.person.set_pose(person.person.quats, person.person.pelvis, pose)


def until_free(session: Session, steps: int = 300) -> list[Any]:
    """Plays until the person has nothing to do; returns what happened."""
    results = [session.step()]
    while "human" not in session.waiting and not session.ended and len(results) < steps:
        results.append(session.step())
    return results


def picked_up(session: Session, k: int = 0) -> None:
    """Lets the person take object k from where it lies."""
    target = session.episode.targets[k]  # type: ignore[attr-defined]
    put_at(session, target.start[:3])
    session.act("person", Pick(target.name))
    until_free(session)
    assert driven(session).objects.held(1) == k


# --- the whole episode ------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of the example, run as it is written."""
    path = tmp_path_factory.mktemp("driven") / "driven.mcap"
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as said:
        patch.setattr(sys, "argv", [str(EXAMPLE), str(path)])
        runpy.run_path(str(EXAMPLE), run_name="__main__")
    assert "success" in said.getvalue()
    return path


def test_an_episode_driven_from_outside_comes_out_again_from_its_raw_input(whole: Path) -> None:
    recording = open_recording(whole)
    assert recording.episode.info["ended"] == "success"
    assert {event.kind for event in recording.inputs} == {"command"}
    assert not [finding for finding in validate_recording(recording) if finding.severity == "error"]
    assert main(["replay", str(whole), "--verify"]) == 0


def test_raw_input_is_what_decides(whole: Path) -> None:
    recording = open_recording(whole)
    event = recording.inputs[10]
    payload = json.loads(event.payload)
    assert payload["choice"]["skill"] == "control"
    payload["choice"]["command"]["turn"] -= 0.01
    inputs = list(recording.inputs)
    inputs[10] = type(event)(time_ns=event.time_ns, kind=event.kind, user=event.user, payload=json.dumps(payload))
    changed = Recording(**{**vars(recording), "inputs": tuple(inputs)})
    found = verify(changed)
    assert found.difference is not None
    assert found.difference.step == 10


@pytest.mark.slow
def test_a_driven_episode_goes_on_from_the_middle_and_that_comes_out_again(whole: Path) -> None:
    recording = open_recording(whole)
    for step, partner in ((300, "both"), (37, None)):
        continued = resume(recording, step, partner=partner)
        rows = {name: array[:step].tobytes() for name, array in continued.columns.items() if name != "state_hash"}
        assert rows == {name: recording.columns[name][:step].tobytes() for name in rows}
        assert verify(continued).equal
    again = resume(continued, 60, policy="complement")
    assert verify(again).equal


@pytest.mark.slow
def test_robots_beside_the_track_of_a_driven_person(whole: Path) -> None:
    other = counterfactual(open_recording(whole), "complement", step=150)
    assert verify(other).equal


def test_its_columns_say_what_was_commanded(whole: Path) -> None:
    recording = open_recording(whole)
    agent, action = recording.agents[1], recording.columns["agent_1.action"]
    assert (agent.action_names, agent.skill_names) == (("forward", "turn_left"), ALL_SKILLS)
    for event in recording.inputs[:40]:
        data = json.loads(event.payload)
        command = data["choice"]["command"]
        if isinstance(command, dict):
            assert action[data["step"]].tolist() == [command["forward"], command["turn"]]
    names = [span.name for span in recording.skills if span.agent == 1]
    assert names == ["control", "pick", "control", "place"] * 2, "a drive is one span, however many commands it took"


# --- any command ------------------------------------------------------------------------------------------------------
numbers = st.floats(-2, 2)
places = st.tuples(*[st.floats(-999, 999)] * 3)
hands = (
    st.none()
    | st.builds(HandTarget, places)
    | st.builds(HandTarget, st.tuples(*[st.floats(-1.5, 1.5)] * 3), st.tuples(*[st.floats(0.1, 1)] * 4))
)
skills = st.none() | st.sampled_from([Pick(0), Pick(1), Drop(), HandOver(0)]) | st.builds(Place, places)
commands = st.builds(PersonCommand, numbers, numbers, hands, hands, st.none() | st.tuples(numbers, numbers), skills)


@pytest.fixture(scope="module")
def playground() -> Session:
    return begun(max_steps=2000)


@settings(deadline=None, suppress_health_check=list(HealthCheck))
@given(command=commands, steps=st.integers(1, 12))
def test_any_command_leaves_a_person_finite_and_out_of_obstacles(
    playground: Session, command: PersonCommand, steps: int
) -> None:
    person = driven(playground)
    playground.act("person", command)
    for _ in range(steps):
        playground.step()
        frame = person.person.frame()
        assert all(np.isfinite(values).all() for values in (frame.base, frame.root, frame.joints))
        assert np.isfinite(person.objects.poses).all()
        assert float(person.free.signed_distance(person.xz)) >= person.radius_m - 2e-3


@pytest.mark.slow
def test_commands_at_random_come_out_again() -> None:
    session, rng = begun("complement", index=1), np.random.default_rng(3)
    options = [Pick(0), Pick(1), Drop(), HandOver(0), Place((1.0, 0.8, 1.0)), Action("nav_to_object", 1)]
    for step in range(250):
        if session.ended:
            break
        if step % 9 == 0:
            arm = HandTarget(tuple(rng.uniform(-0.5, 1.2, 3))) if rng.random() < 0.5 else None
            session.act("person", PersonCommand(*rng.uniform(-1, 1, 2), right=arm, head=(0.3, -0.2)))
        if step % 40 == 20:
            session.act("person", options[step // 40 % len(options)])
        session.step()
    recording = session.close()
    assert verify(recording).equal
    assert not [finding for finding in validate_recording(recording) if finding.severity == "error"]


@settings(max_examples=50, deadline=None, suppress_health_check=list(HealthCheck))
@given(command=commands)
def test_commands_come_back_from_json(playground: Session, command: PersonCommand) -> None:
    action = action_of(command, driven(playground).objects, 1)
    assert command_from_json(json.loads(json.dumps(command_to_json(action)))) == action


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ((np.nan, 0.0), "(?s)a velocity as 2 finite numbers.*H3-SIM-005"),
        (PersonCommand(0.0, np.inf), "(?s)a velocity as 2 finite numbers.*H3-SIM-005"),
        (PersonCommand(right=HandTarget((1e200, 0.0, 0.0))), r"(?s)the position of a hand.*3.*up to 1000.*H3-SIM-005"),
        (PersonCommand(left=HandTarget((0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 0.0))), "H3-SIM-006"),
        (PersonCommand(head=(0.0,)), r"(?s)yaw and pitch of the head.*2.*H3-SIM-005"),  # type: ignore[arg-type]
        (Place((0.0, np.nan, 0.0)), r"(?s)a point.*3.*H3-SIM-005"),
        (Pick("unicorn"), r"(?s)'unicorn'.*H3-SIM-003"),
        (Pick(7), r"(?s)7.*H3-SIM-003"),
        (Pick(True), "H3-SIM-003"),
        ("go", "H3-SIM-002"),
        (PersonCommand(do="jump"), "H3-SIM-001"),  # type: ignore[arg-type]
    ],
)
def test_malformed_commands_are_refused_before_they_are_recorded(playground: Session, command: Any, says: str) -> None:
    before = len(playground.recorder.inputs)
    with pytest.raises(InputError, match=says):
        playground.act("person", command)
    assert len(playground.recorder.inputs) == before


def test_only_agents_controlled_from_outside_take_commands(playground: Session) -> None:
    with pytest.raises(InputError, match=r"(?s)still.*H3-TASK-046"):
        playground.act("robot", STAND)
    with pytest.raises(InputError, match=r"(?s)'persn'.*H3-TASK-045"):
        playground.act("persn", STAND)


# --- motion -----------------------------------------------------------------------------------------------------------
def test_a_person_walks_turns_and_stands_by_command() -> None:
    session = begun(human_speed=1.0)
    person = driven(session)
    start, heading = person.xz.copy(), person.heading
    session.act("person", (0.0, 0.5))
    session.step()
    assert person.heading - heading == pytest.approx(0.5 * 2.5 / 30)
    assert person.xz.tolist() == start.tolist()
    session.act("person", STAND)
    session.step()
    here = person.xz.copy()
    session.act("person", (-1.0, 0.0))
    session.step()
    gone = person.xz - here
    back = -np.array([np.cos(person.heading), -np.sin(person.heading)])
    assert np.dot(gone, back) == pytest.approx(1 / 30, abs=1e-6) or person.free.signed_distance(person.xz) < 0.27


@pytest.mark.parametrize("forward", [0.0, 0.6])
def test_a_palm_follows_its_target_also_in_walking(forward: float) -> None:
    session = begun(human_speed=1.0)
    person, target = driven(session), (0.35, 1.15, 0.2)
    session.act("person", PersonCommand(forward, 0.1, right=HandTarget(target)))
    for _ in range(30):
        session.step()
    assert np.linalg.norm(person.person.seen(person.person.palm("right")[:3]) - target) < 1e-6


def test_arms_and_head_move_by_small_steps() -> None:
    session = begun(human_speed=1.0)
    person, before = driven(session), None
    for step in range(90):
        arm = HandTarget((0.4, 1.2, 0.1)) if step % 45 < 25 else None
        session.act("person", PersonCommand(right=arm, head=(1.0, 0.5) if arm else None))
        session.step()
        quats = person.person.quats.copy()
        if before is not None:
            turned = 2 * np.arccos(np.minimum(np.abs(np.sum(quats * before, axis=-1)), 1.0))
            assert np.degrees(turned.max()) < 30
        before = quats


# --- skills -----------------------------------------------------------------------------------------------------------
def test_a_person_picks_and_drops_on_what_is_below() -> None:
    session = begun()
    picked_up(session)
    person, objects = driven(session), driven(session).objects
    assert session.refusal("person", Pick(1)) == "The hand already holds something."
    height = objects.poses[0, 1]
    session.act("person", Drop())
    results = until_free(session)
    assert objects.held_by[0] == NOBODY
    assert objects.poses[0, 1] < height
    assert [event.kind for result in results for event in result.events] == ["place"]
    assert person.object_room is not None
    assert person.object_room.refusal(0, objects.poses[0], objects.poses) == ""
    assert session.refusal("person", Drop()) == "The hand holds no such thing."


def test_a_preview_says_what_placing_then_does() -> None:
    """All around a goal: what is not refused succeeds, what is refused fails for that reason."""
    session, rng = begun(max_steps=5000, seed=1), np.random.default_rng(0)
    goal = session.episode.targets[0].goal  # type: ignore[attr-defined]
    outcomes = set()
    for _ in range(12):
        if driven(session).objects.held(1) < 0:
            put_at(session, driven(session).objects.poses[0, :3])
            session.act("person", Pick(0))
            until_free(session)
        put_at(session, goal)
        point = goal + rng.choice([0.0, 0.15, 0.5], 3, p=[0.4, 0.4, 0.2]) * rng.choice([-1, 1], 3) * [1, 0.3, 1]
        command = Place(tuple(point))
        why = session.refusal("person", command)
        session.act("person", command)
        refused = [result.refused["human"] for result in until_free(session) if result.refused]
        assert refused == ([] if why is None else [why])
        if why is None:
            assert np.linalg.norm(driven(session).objects.poses[0, :3] - point) < 0.01
        outcomes.add(why)
        if session.ended:
            break
    assert None in outcomes
    assert len(outcomes) > 1


@pytest.mark.parametrize(
    ("offset", "why"),
    [
        ((0.0, 0.0, 0.0), None),
        ((0.0, 0.3, 0.0), "There is nothing there to put it on."),
        ((0.0, -0.05, 0.0), "There is no space for it: something else is there."),
        ((3.0, 0.0, 0.0), None),
    ],
)
def test_reasons_are_sentences(offset: tuple[float, float, float], why: str | None) -> None:
    session = begun()
    picked_up(session)
    goal = session.episode.targets[0].goal  # type: ignore[attr-defined]
    put_at(session, goal)
    answer = session.refusal("person", Place(tuple(goal + offset)))
    assert answer == why if offset[0] == 0 else answer is not None


def test_what_is_too_far_is_refused_and_nothing_happens() -> None:
    session = begun()
    assert session.refusal("person", Pick(0)) == "It is too far away to reach from here."
    session.act("person", Pick(0))
    result = until_free(session)[-1]
    assert result.refused == {"human": "It is too far away to reach from here."}
    assert [span.outcome for span in result.skills] == ["failed"]


def test_steering_interrupts_a_skill_and_standing_does_not() -> None:
    session = begun()
    person = driven(session)
    put_at(session, session.episode.targets[1].start[:3])  # type: ignore[attr-defined]
    session.act("person", Pick(1))
    for _ in range(8):
        session.step()
        session.act("person", STAND)
    assert session.waiting == ()
    before = person.person.quats.copy()
    session.act("person", (0.0, 1.0))
    result = session.step()
    assert [(span.name, span.outcome, span.reason) for span in result.skills] == [("pick", "aborted", "commanded")]
    turned = 2 * np.arccos(np.minimum(np.abs(np.sum(person.person.quats * before, axis=-1)), 1.0))
    assert np.degrees(turned.max()) < 25, "the arm comes back step by step"


def test_interrupted_skills_come_out_again() -> None:
    session = begun("complement")
    for command in (Action("nav_to_object", 0), (0.5, 0.3), Action("nav_to_object", 1), STAND, (-0.3, 0.0)):
        session.act("person", command)
        for _ in range(25):
            session.step()
    recording = session.close()
    assert [span.name for span in recording.skills if span.agent == 1][:2] == ["nav_to_object", "control"]
    assert verify(recording).equal


@pytest.mark.slow
def test_a_person_hands_over_to_a_robot_that_is_near() -> None:
    session = begun(External(), end_on_collision=False)
    picked_up(session)
    person, objects = driven(session), driven(session).objects
    assert session.refusal("person", HandOver(1)) == "Things can only be handed over to a robot."
    assert session.refusal("person", HandOver(0)) is not None, "it is far away"
    robot = session.play.team.robots[0]  # type: ignore[attr-defined]
    for ahead in np.arange(0.9, 0.5, -0.05):
        forward = np.array([np.cos(person.heading), -np.sin(person.heading)])
        robot.state.heading[0] = person.heading + np.pi
        robot.state.xz[0] += person.xz + forward * ahead - robot.hand_pose[[0, 2]]
        if session.refusal("person", HandOver(0)) is None:
            break
    assert session.refusal("person", HandOver(0)) is None
    session.act("person", HandOver(0))
    results = until_free(session)
    assert not any(result.refused for result in results)
    assert objects.held_by[0] == 0
    assert person.person.held == {}
    np.testing.assert_array_equal(objects.state.grip_pose[0, 0, :3], 0.0)  # the robot's hand has closed around it
    held = objects.poses[0].copy()
    session.act("robot", Velocity(0.0, 1.0))
    session.step()
    assert np.any(objects.poses[0] != held), "the robot carries it"


# --- robots, other tasks ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "task", ["wander", *(pytest.param(task, marks=pytest.mark.slow) for task in ("social_nav", "rearrange"))]
)
def test_robots_and_people_are_driven_in_every_task(task: str) -> None:
    session = h3data.session(task, "small:1", agents={"person": External(), "robot": External()})
    rng = np.random.default_rng(1)
    for _ in range(40):
        for agent in ("person", "robot"):
            if rng.random() < 0.3:
                session.act(agent, Velocity(*rng.uniform(-1, 1, 2)))
        if session.step().ended:
            break
    recording = session.close()
    assert verify(recording).equal
    assert verify(resume(recording, 20)).equal
