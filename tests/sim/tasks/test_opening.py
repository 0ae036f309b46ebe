"""Doors and drawers in rearrangement: skills, refusals, recordings, and what replays and exports show."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import h3data
from h3data.errors import FormatError, InputError
from h3data.mesh.glb import unpack_glb
from h3data.recording import DatasetWriter, Recording, write_mcap
from h3data.scene import FreeSpace, Scene
from h3data.scene.articulation import joints_of, posed
from h3data_exporters.csv_tables import write_csv_tables
from h3data_habitat.gfx.replay import read_gfx_replay
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.cli import main
from h3data_pipelines.validation.recordings import validate_recording
from sim_kinematic.agents.driven.commands import (
    Close,
    Drop,
    Open,
    Pick,
    Place,
    action_of,
    command_from_json,
    command_to_json,
)
from sim_kinematic.agents.driven.person import DrivenPerson
from sim_kinematic.agents.opening.openables import ArticulatedParts
from sim_kinematic.agents.opening.reachable import within_reach
from sim_kinematic.agents.opening.skills import Leading, why_not
from sim_kinematic.agents.skills import ALL_SKILLS, Action, Objects
from sim_kinematic.motion.state import WorldState
from sim_kinematic.policies.policy import External
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode, RearrangeSpec, Target
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.resume import counterfactual, resume, verify
from sim_kinematic.tasks.sessions import Session
from tests.simulated import REARRANGE, rearrange_episode

DRAWER, THING = "kitchen_counter_2/drawer_0", "mug_7"


@pytest.fixture(scope="module")
def home() -> Scene:
    return build_home(HomeSpec(seed=2, articulated=True))


@pytest.fixture(scope="module")
def free(home: Scene) -> FreeSpace:
    return FreeSpace.from_scene(home, radius_m=0.25, height_m=1.41)


@pytest.fixture(scope="module")
def episode(home: Scene, free: FreeSpace) -> RearrangeEpisode:
    """One thing to bring, which lies in a drawer."""
    sampled = rearrange_episode(home, seed=1, free=free, spec=RearrangeSpec(objects=1))
    thing = next(i for i in home.instances if i.name == THING)
    (target,) = sampled.targets
    inside = Target(THING, thing.pose.astype(np.float64), target.goal, f"{DRAWER}|bottom", target.destination)
    return replace(sampled, targets=(inside,), is_sampled=False)


@pytest.fixture(scope="module")
def recording(episode: RearrangeEpisode) -> Recording:
    """A person who plans to bring it, alone."""
    alone = episode.only(1)
    return simulate(REARRANGE, alone, {"human": "both"}, info={"solo_steps": 1})


def openables_of(scene: Scene, objects: Objects | None = None) -> ArticulatedParts:
    joints = joints_of(scene)
    state = WorldState.zeros(1, robots=0, people=0, scene_joints=len(joints))
    state.joint_pos[0] = joints.rest
    return ArticulatedParts(scene, objects or Objects((), np.zeros((0, 3)), state), 0.0)


# --- an episode ---------------------------------------------------------------------------------------------------------
def test_a_planner_opens_what_the_thing_lies_in(recording: Recording) -> None:
    done = [(span.name, span.target) for span in recording.skills]
    opening = [("nav_to_handle", DRAWER), ("open", DRAWER)]
    assert done == [*opening, *((name, THING) for name in ("nav_to_object", "pick", "nav_to_goal", "place"))]
    assert {span.outcome for span in recording.skills} == {"done"}
    assert [(e.kind, e.target) for e in recording.events][:2] == [("open", DRAWER), ("pick", THING)]
    assert recording.episode.info["ended"] == "success"
    assert recording.episode.schema_version == "1.7"
    assert {agent.skill_names for agent in recording.agents} == {ALL_SKILLS}


def test_things_move_with_the_drawer_until_they_are_taken(recording: Recording, home: Scene) -> None:
    joints = joints_of(home)
    k = joints.index(DRAWER)
    positions, poses = recording.columns["scene.joint_pos"], recording.columns["object_pose"][:, 0]
    assert positions.dtype == np.float32
    others = np.delete(positions, k, axis=1)
    np.testing.assert_array_equal(others, np.broadcast_to(np.delete(joints.rest, k), others.shape))
    assert (np.diff(positions[:, k]) >= 0).all()
    assert positions[-1, k] == np.float32(joints.opened[k])
    assert np.abs(np.diff(positions[:, k])).max() < 0.03  # it takes its time
    taken = int(np.argmax(recording.columns["agent_0.grasp_body"] >= 0))
    motions = joints.motions(positions[:taken].astype(np.float64))[:, k]
    start = next(i for i in home.instances if i.name == THING).pose[:3]
    np.testing.assert_allclose(poses[:taken, :3], start + motions[:, :3, 3], atol=1e-5)


def test_it_verifies_and_continues_from_the_middle_of_opening(recording: Recording) -> None:
    assert verify(recording).difference is None
    span = next(span for span in recording.skills if span.name == "open")
    again = resume(recording, step=(span.start_step + span.end_step) // 2)
    for name in ("scene.joint_pos", "object_pose", "agent_0.joint_quat"):
        np.testing.assert_array_equal(again.columns[name], recording.columns[name])


def test_recordings_come_back_from_both_stores(recording: Recording, tmp_path: Path) -> None:
    write_mcap(recording, tmp_path / "e.mcap")
    with DatasetWriter(tmp_path / "ds") as writer:
        writer.add(recording)
    for again in (h3data.open(tmp_path / "e.mcap"), h3data.open(tmp_path / "ds").recording(0)):
        np.testing.assert_array_equal(again.columns["scene.joint_pos"], recording.columns["scene.joint_pos"])
        assert again.skills == recording.skills
        assert again.columns["state_hash"][-1] == recording.columns["state_hash"][-1]


@pytest.mark.slow  # quick: the same of doors
def test_homes_that_do_not_open_have_no_trace_of_it() -> None:
    plain = build_home(HomeSpec(seed=2))
    episode = rearrange_episode(plain, seed=1, spec=RearrangeSpec(max_steps=900)).only(1)
    short = replace(episode, spec=replace(episode.spec, max_steps=60))
    played = simulate(REARRANGE, short, {"human": "still"}, info={"solo_steps": 1})
    assert "scene.joint_pos" not in played.columns
    assert not set(played.agents[0].skill_names) & {"open", "close"}


# --- replay, checks -----------------------------------------------------------------------------------------------------
def test_replays_pose_parts_and_what_nobody_moves_in_them(recording: Recording, home: Scene) -> None:
    replay = h3data.Replay(recording)
    for step in (0, len(recording) // 2, len(recording) - 1):
        there = posed(home, recording.columns["scene.joint_pos"][step].astype(np.float64))
        poses = replay.at(step).poses
        for instance in there.instances:
            if instance.name != THING and instance.name in poses:
                np.testing.assert_allclose(poses[instance.name][:3, 3], instance.pose[:3], atol=1e-5)
    assert not [finding for finding in validate_recording(recording) if finding.severity == "error"]


def test_columns_that_do_not_fit_the_home_are_told(recording: Recording) -> None:
    positions = recording.columns["scene.joint_pos"]
    narrow = replace(recording, columns={**recording.columns, "scene.joint_pos": positions[:, :3].copy()})
    assert any(f.subject == "scene.joint_pos" and f.check == "schema" for f in validate_recording(narrow))
    with pytest.raises(FormatError, match="H3-REPLAY-020"):
        h3data.Replay(narrow)
    far = positions.copy()
    far[5, 0] = 9.0
    beyond = replace(recording, columns={**recording.columns, "scene.joint_pos": far})
    assert any("beyond its limits" in f.text for f in validate_recording(beyond))


# --- a person under commands --------------------------------------------------------------------------------------------
@pytest.fixture
def session(episode: RearrangeEpisode) -> Session:
    return Session(REARRANGE, episode.only(1), {"human": External()})


def driven(session: Session) -> DrivenPerson:
    person = session.play.team.people[0]  # type: ignore[attr-defined]
    assert isinstance(person, DrivenPerson)
    return person


def put_at(session: Session, point: np.ndarray, ahead: np.ndarray, away: float) -> None:
    """Puts the person ``away`` metres before a point, facing it."""
    person, place = driven(session), point + away * ahead
    heading = float(np.arctan2(ahead[2], -ahead[0]))
    pose = person.person.base.copy()
    pose[[0, 2]], pose[3:] = place[[0, 2]], [0, np.sin(heading / 2), 0, np.cos(heading / 2)]
    person.person.set_pose(person.person.quats, person.person.pelvis, pose)


def play_on(session: Session, command: object) -> None:
    session.act("person", command)
    session.step()
    while "human" not in session.waiting and not session.ended:
        session.step()


def handle_of(session: Session, name: str) -> tuple[np.ndarray, np.ndarray]:
    openables = driven(session).openables
    assert openables is not None
    k = openables.joints.index(name)
    frame = openables.joints.parts[k][0].pose
    ahead = np.array([np.sin(2 * np.arctan2(frame[4], frame[6])), 0, np.cos(2 * np.arctan2(frame[4], frame[6]))])
    return openables.handles(openables.positions)[k], ahead


def test_refusals_say_why(session: Session) -> None:
    handle, ahead = handle_of(session, DRAWER)
    assert session.refusal("person", Pick(THING)) == "It is in something that is closed."
    assert session.refusal("person", Close(DRAWER)) == "It is closed already."
    assert session.refusal("person", Open(DRAWER)) == "It is too far away to reach from here."
    put_at(session, handle, ahead, 0.3)
    assert session.refusal("person", Open(DRAWER)) == "It would hit whoever opens it: they stand in its way."
    put_at(session, handle, ahead, 0.78)
    assert session.refusal("person", Open(DRAWER)) is None
    driven(session).objects.held_by[0] = 0
    assert session.refusal("person", Open(DRAWER)) == "The hand already holds something."


def test_a_person_under_commands_opens_takes_places_and_closes(session: Session) -> None:
    openables = driven(session).openables
    assert openables is not None
    k = openables.joints.index(DRAWER)
    play_on(session, Action("nav_to_handle", k))
    play_on(session, Open(DRAWER))
    assert openables.is_open(k)
    assert session.refusal("person", Open(DRAWER)) == "It is open already."
    assert session.refusal("person", Pick(THING)) != "It is in something that is closed."
    play_on(session, Action("nav_to_object", 0))
    play_on(session, Pick(THING))
    assert driven(session).objects.held(0) == 0
    assert session.refusal("person", Close(DRAWER)) == "The hand already holds something."
    play_on(session, Drop())
    play_on(session, Action("nav_to_handle", k))
    play_on(session, Close(DRAWER))
    assert openables.positions[k] == openables.joints.closed[k]
    recording = session.close()
    assert [(e.kind, e.target) for e in recording.events if e.kind in ("open", "close")] == [
        ("open", DRAWER),
        ("close", DRAWER),
    ]
    assert verify(recording).difference is None


def test_what_stands_before_it_keeps_it_shut(session: Session) -> None:
    handle, ahead = handle_of(session, "dishwasher_0/rack")
    put_at(session, handle, ahead, 0.78)
    assert session.refusal("person", Open("dishwasher_0/rack")) == "Something stands before it, or in its way."
    play_on(session, Open("dishwasher_0/rack"))
    recording = session.close()
    (span,) = [span for span in recording.skills if span.name == "open"]
    assert (span.outcome, span.reason, span.target) == ("failed", "obstructed", "dishwasher_0/rack")


def test_nothing_is_put_into_what_is_closed(session: Session, home: Scene) -> None:
    inside = next(i for i in home.instances if i.name == THING).pose[:3].copy()
    objects = driven(session).objects
    objects.held_by[0] = 0
    assert driven(session).openables.barrier_for(0, inside) >= 0  # type: ignore[union-attr]
    assert session.refusal("person", Place(tuple(inside))) == "It is in something that is closed."


def test_commands_survive_json_and_unknown_joints_are_told(session: Session) -> None:
    objects = driven(session).objects
    for command in (Open(DRAWER), Close(2)):
        action = action_of(command, objects, 0)
        assert command_from_json(command_to_json(action)) == action
    with pytest.raises(InputError, match=r"(?s)'lid'.*fridge_0/door.*H3-SIM-004"):
        session.act("person", Open("lid"))
    with pytest.raises(InputError, match=r"(?s)99.*H3-SIM-004"):
        session.act("person", Open(99))


# --- laws ---------------------------------------------------------------------------------------------------------------
def test_every_way_ends_at_its_end_and_never_turns_back(home: Scene) -> None:
    openables = openables_of(home)
    for k in range(len(openables)):
        way = openables.travel(k, opens=True)
        assert way[-1] == openables.joints.opened[k]
        assert (np.diff(np.abs(way - openables.joints.closed[k])) > 0).all()
        openables.move(k, float(way[-1]))
        back = openables.travel(k, opens=False)
        assert back[-1] == openables.joints.closed[k]
        openables.move(k, float(back[-1]))


def test_nobody_is_hit(home: Scene) -> None:
    """A part is barred by whoever stands in its way, and waits for whoever comes into it."""
    openables = openables_of(home)
    k = openables.joints.index(DRAWER)
    handle = openables.handles(openables.positions)[k]
    frame = openables.joints.parts[k][0].pose
    heading = 2 * np.arctan2(frame[4], frame[6])
    before = handle + 0.3 * np.array([np.sin(heading), 0, np.cos(heading)])
    discs = {0: np.zeros((0, 3)), 1: np.array([[before[0], before[2], 0.25]])}
    openables.company = SimpleNamespace(actors=(0, 1), discs_of=discs.__getitem__)  # type: ignore[assignment]
    assert why_not(openables, 0, Action("open", k)) == "blocked"
    assert why_not(openables, 1, Action("open", k)) == "too_near"
    leading = Leading(openables, k, opens=True)
    steps = list(itertools.takewhile(leading.advance, range(len(leading.way))))
    assert 0 < len(steps) < len(leading.way)
    held = float(openables.positions[k])
    while not leading.gave_up:
        assert not leading.advance(len(steps))
    assert openables.positions[k] == held
    discs[1] += [5.0, 0.0, 0.0]
    assert leading.advance(len(steps))
    assert why_not(openables, 0, Action("open", k)) == ""
    assert why_not(None, 0, Action("open", 0)) == "no_joint"


def test_moving_there_and_back_brings_things_back(home: Scene) -> None:
    names = tuple(i.name for i in home.instances if i.motion == "kinematic")
    joints = joints_of(home)
    state = WorldState.zeros(1, robots=0, people=0, objects=len(names), scene_joints=len(joints))
    state.object_pose[0] = [i.pose for i in home.instances if i.motion == "kinematic"]
    openables = openables_of(home, Objects(names, np.zeros((len(names), 3)), state))
    before = state.object_pose.copy()
    for k in range(len(joints)):
        openables.move(k, float(joints.opened[k]))
        moved = {names[n] for n in np.flatnonzero((state.object_pose[0] != before[0]).any(1))}
        carried = {n for n in joints.parts[k][1].instances if n in names}
        assert moved == carried, joints.names[k]
        openables.move(k, float(joints.closed[k]))
        np.testing.assert_allclose(state.object_pose, before, atol=1e-6)
        state.object_pose[:] = before


def test_doors_shut_off_what_is_behind_them_until_they_are_open(home: Scene) -> None:
    openables = openables_of(home)
    shelf = next((i, r) for i, r in home.receptacles() if r.name == "door_shelf_0")
    foot = shelf[0].pose[:3] + np.array([0, shelf[1].center[1], 0])
    k = openables.joints.index("fridge_0/door")
    assert openables.barrier(foot) == k
    openables.move(k, 0.5)
    assert openables.barrier(foot) == k
    openables.move(k, float(openables.joints.opened[k]))
    assert openables.barrier(foot) == -1


def test_both_door_and_rack_are_opened_door_first(home: Scene) -> None:
    found = within_reach(home, "dishwasher_0/rack|rack", np.array([0.0, 1.0, 0.0]))
    assert found is not None
    assert [openables.joints.names[k] for openables, k in found.opened] == ["dishwasher_0/door", "dishwasher_0/rack"]
    assert [openables.is_open(found.opened[0][1]) for openables, _ in found.opened] == [False, True]
    openables = openables_of(home)
    rack = next((i, r) for i, r in home.receptacles() if r.name == "rack")
    foot = (rack[0].pose[:3]) + np.array([0, rack[1].center[1], 0])
    door, slide = (openables.joints.index(f"dishwasher_0/{part}") for part in ("door", "rack"))
    assert openables.barrier(foot) == door
    openables.move(door, float(openables.joints.opened[door]))
    assert openables.barrier(foot) == slide


@pytest.mark.slow
def test_people_who_keep_their_track_open_what_they_opened(episode: RearrangeEpisode) -> None:
    """The same robot again is another policy's counterfactual: what the person did, drawers included, comes out again."""
    both = simulate(REARRANGE, episode, {"human": "both", "robot": "still"}, info={"solo_steps": 1})
    assert "open" in {span.name for span in both.skills if span.agent == 1}
    again = counterfactual(both, "complement")
    steps = min(len(again), len(both))
    for name in ("scene.joint_pos", "agent_1.joint_quat"):
        np.testing.assert_array_equal(again.columns[name][:steps], both.columns[name][:steps])


# --- exports ------------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_gltf_animates_the_drawer_and_what_lies_in_it(recording: Recording, home: Scene, tmp_path: Path) -> None:
    write_mcap(recording, tmp_path / "e.mcap")
    document, _ = unpack_glb(h3data.export(tmp_path / "e.mcap", tmp_path / "e.glb", to="gltf").read_bytes(), "e.glb")
    moved = {document["nodes"][c["target"]["node"]]["name"] for c in document["animations"][0]["channels"]}
    assert {DRAWER, THING} <= moved
    assert not {name for name in joints_of(home).names if name != DRAWER} & moved


@pytest.mark.slow
def test_gfx_replays_move_the_drawer_as_a_rigid_body(recording: Recording, home: Scene, tmp_path: Path) -> None:
    write_mcap(recording, tmp_path / "e.mcap")
    path = h3data.export(tmp_path / "e.mcap", tmp_path / "e.gfx_replay.json", to="gfx-replay")
    again = read_gfx_replay(path)
    joints = joints_of(home)
    k = joints.index(DRAWER)
    motions = joints.motions(recording.columns["scene.joint_pos"].astype(np.float64))[:, k, :3, 3]
    travel = motions[-1] - motions[0]
    tracks = again.columns["object_pose"][:, :, :3].astype(np.float64)
    slid = np.flatnonzero(np.abs(tracks[-1] - tracks[0] - travel).max(-1) < 1e-4)
    assert len(slid)
    np.testing.assert_allclose(tracks[:, slid[0]] - tracks[0, slid[0]], motions - motions[0], atol=1e-4)


def test_csv_names_the_joints(recording: Recording, home: Scene, tmp_path: Path) -> None:
    folder = tmp_path / "csv"
    folder.mkdir()
    write_csv_tables(recording, folder)
    head = (folder / "steps.csv").read_text().splitlines()[0].split(",")
    assert [name for name in head if name.startswith("scene.")] == [
        f"scene.joint_pos.{name}" for name in joints_of(home).names
    ]


def test_info_names_what_moved(recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_mcap(recording, tmp_path / "e.mcap")
    assert main(["info", str(tmp_path / "e.mcap")]) == 0
    assert (
        f"{len(recording.columns['scene.joint_pos'][0])} of doors and drawers; {DRAWER} moved"
        in capsys.readouterr().out
    )
