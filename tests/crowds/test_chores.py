"""Chores: people open a fridge, take something, put it down, carry a tray; hands are at what they hold."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import h3data
from benchmarks.people import hall
from h3data.bodies import Humanoid, humanoid_names, load_humanoid
from h3data.bodies.people.arms import draw_in
from h3data.bodies.people.gestures import BOTH, lead_hands
from h3data.bodies.people.reach import hand_points, reacher
from h3data.errors import InputError, SceneError
from h3data.geometry import IDENTITY_POSE, pose_multiply, pose_to_matrix
from h3data.recording import read_mcap, write_mcap
from h3data.recording.records import JOINTS
from h3data.replay import Replay
from h3data.scene import FreeSpace
from h3data.scene.articulation import handle_points, joints_of
from h3data.scene.open import named_scenes, open_free_space, open_scene
from h3data_crowds.chores import (
    APART_M,
    CARRIED,
    GRIP_BACK_M,
    ITEM_M,
    CarryingHands,
    Chore,
    ChoreRoutine,
    chore_at,
)
from h3data_crowds.driven import chores
from h3data_crowds.routines import Stop
from h3data_exporters.posing import posed_parts
from h3data_habitat.exporters.gfx_replay_export import write_gfx_replay
from h3data_habitat.gfx.replay import read_gfx_replay
from h3data_pipelines.benchmark.verification import _other_facts as other_facts
from h3data_pipelines.benchmark.verification import verify_episode
from h3data_pipelines.validation.recordings import validate_recording
from sim_kinematic.agents.arm_tuck import draw_arms
from sim_kinematic.agents.roster import make_roster
from sim_kinematic.contact.frames import body_frames, root_pose
from sim_kinematic.crowd.crowd import VERSION
from sim_kinematic.crowd.roles import read_role, routines
from sim_kinematic.motion.spec import HOME_WALKER, SocialNavSpec
from sim_kinematic.motion.state import HumanState
from sim_kinematic.policies.crowd.people import CrowdPolicy
from sim_kinematic.policies.traffic import ClipBody
from sim_kinematic.tasks.recorder import simulate
from sim_kinematic.tasks.resume import counterfactual, resume, verify
from sim_kinematic.tasks.resume import restored_episode as restored
from sim_kinematic.tasks.wander import Wander
from tests.crowds.acting import chores_at

HOME = "medium-open:3"
STOPS = Stop("fridge_0", "take", 12.5), Stop("kitchen_counter_0", "put", 9.0), Stop("dining_table_0", "lift", 8.5)


def resident(task: Any, episode: Any, number: int) -> CrowdPolicy:
    """A person who does chores."""
    return chores_at(STOPS, episode, number)


@pytest.fixture(scope="module")
def acted() -> h3data.Recording:
    agents = {"human": f"{__name__}:resident"}
    return h3data.simulate("wander", HOME, roster=["female_1"], agents=agents, seed=3, max_steps=1200)


def test_chores_are_simulated_again_bit_for_bit(acted: h3data.Recording, tmp_path: Path) -> None:
    assert verify(acted).difference is None
    assert [finding.text for finding in validate_recording(acted) if finding.severity == "error"] == []
    write_mcap(acted, tmp_path / "acted.mcap")
    again = read_mcap(tmp_path / "acted.mcap")
    np.testing.assert_array_equal(again.columns["agent_0.motion_hands"], acted.columns["agent_0.motion_hands"])


def test_a_benchmark_expects_what_people_bring_along_and_nothing_else(acted: h3data.Recording) -> None:
    task, episode = restored(acted)
    assert "bodies" not in other_facts(acted, task, episode)
    assert verify_episode(acted, task, episode, f"{__name__}:resident").difference is None
    more = replace(acted, bodies=(*acted.bodies, replace(acted.bodies[0], name="one_more")))
    difference = verify_episode(more, task, episode, f"{__name__}:resident").difference
    assert difference is not None
    assert difference.column == "bodies"


def test_people_without_chores_have_no_columns_of_them() -> None:
    walks = h3data.simulate(
        "wander", "small:1", agents={"human": "orca+morning", "robot": "still"}, seed=1, max_steps=3
    )
    assert not {name for name in walks.columns if "hands" in name or name in ("object_pose", JOINTS)}


@pytest.mark.slow
def test_who_is_replaced_takes_the_things_along_and_other_robots_may_come() -> None:
    agents = {"human": "orca+breakfast", "robot": "still"}
    options = {"spawn_distance_m": 1.0, "end_on_collision": False}
    played = h3data.simulate(
        "crowd_nav", HOME, roster=["robot", "female_1"], agents=agents, seed=4, max_steps=200, **options
    )
    with pytest.raises(InputError, match="H3-TASK-090"):
        resume(played, 100, partner="orca")
    other = counterfactual(played, "shortest_path")
    rows = len(other)
    np.testing.assert_array_equal(other.columns["object_pose"], played.columns["object_pose"][:rows])
    assert set(other.columns) == set(played.columns)


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


def test_palms_hold_the_tray_and_the_carton_follows_the_hand(acted: h3data.Recording) -> None:
    replay, steps = Replay(acted), {(event.kind, event.target): event.step for event in acted.events}
    body, tracks = replay.model(0), {body.name: body.moving for body in acted.moving_bodies}
    assert isinstance(body, Humanoid)
    for name, rows in (
        ("human_carton_0", np.arange(steps["takes", "human_carton_0"], steps["puts", "human_carton_0"], 7)),
        ("human_tray_0", np.arange(steps["takes", "human_tray_0"], len(acted), 7)),
    ):
        places = acted.columns["object_pose"][rows, tracks[name], :3].astype(np.float64)
        palms = np.stack([hand_points(replay.joint_matrices(0, rows), body, hand) for hand in ("left", "right")], 1)
        middle = (
            palms.mean(1)
            if "tray" in name
            else palms[:, np.linalg.norm(palms - places[:, None], axis=2).sum(0).argmin()]
        )
        apart = GRIP_BACK_M if "tray" in name else 0.0
        assert np.abs(np.linalg.norm(middle - places, axis=1) - apart).max() < 0.02


@pytest.mark.slow
def test_files_for_other_programs_have_doors_and_things(acted: h3data.Recording, tmp_path: Path) -> None:
    file = tmp_path / "acted.gfx_replay.json"
    write_gfx_replay(acted, posed_parts(Replay(acted)), file)
    again = read_gfx_replay(file)
    (ours,) = [body.moving for body in acted.moving_bodies if "carton" in body.name]
    track = acted.columns["object_pose"][:, ours, :3]
    tracks = again.columns["object_pose"][..., :3]
    assert np.abs(tracks - track[:, None]).max((0, 2)).min() < 1e-3


def test_what_is_taken_stays_where_it_was_put(acted: h3data.Recording) -> None:
    told = [(event.kind, event.target, event.detail) for event in acted.events if event.kind in ("takes", "puts")]
    assert told == [
        ("takes", "human_carton_0", "fridge_0"),
        ("puts", "human_carton_0", "kitchen_counter_0"),
        ("takes", "human_tray_0", "dining_table_0"),
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
    routine = ChoreRoutine(scene, free, [Stop("fridge_0", "take", 3.0)], body, start=near)
    found = routine.next_stop(near)
    assert found is not None
    assert found[1].refused[1].startswith("H3-TASK-088")
    # nothing is in the hands, so there is nothing to put down and nowhere to go
    assert ChoreRoutine(scene, free, [Stop("kitchen_counter_0", "put", 9.0)], body, start=near).next_stop(near) is None


def test_everybody_has_something_to_do_in_a_home_with_few_spots() -> None:
    home, people = "medium-open:3", ["human"] * 4
    for seed in (0, 1):
        recording = h3data.simulate(
            "wander", home, roster=["robot", *people], agents={"human": "orca+breakfast"}, max_steps=1, seed=seed
        )
        assert len(recording.episode.info["people"]) == len(people)


def test_robots_that_wander_see_people_in_the_posture_in_which_they_handle_things() -> None:
    body, free = load_humanoid("male_2"), FreeSpace.from_scene(hall(), cache=False)
    figure, state = ClipBody(body, 0, free, None), HumanState.zeros(1)
    for seat, hand in ((0.0, 1.0), (1.0, 0.0), (2.0, 0.0)):
        state.seat[:] = 0.45, seat
        state.hands[0, 0], state.hands[0, 2] = (0.5, 0.9, -0.1, hand), (0.8, 0.7, 0.0, hand)
        figure.gait = state.copy()
        frames = body.joint_matrices(figure.base[None], figure.quats[None], figure.pelvis[None])
        np.testing.assert_array_equal(frames, body_frames(body, state, free), "as contact poses them")


def before_version_7(task: Any, episode: Any, number: int) -> CrowdPolicy:
    """A person who does chores by an earlier version of the rules."""
    policy = resident(task, episode, number)
    policy.repeat(5)
    return policy


def test_recordings_of_chores_of_earlier_versions_are_simulated_again(acted: h3data.Recording) -> None:
    agents = {"human": f"{__name__}:before_version_7"}
    older = h3data.simulate("wander", HOME, roster=["female_1"], agents=agents, seed=3, max_steps=700)
    versions = [next(iter(each.episode.info["people"].values()))["version"] for each in (older, acted)]
    assert versions == [5, VERSION]
    # the same person as in `acted`, but for the version that the recording holds
    as_now = {**older.episode.info, "policies": acted.episode.info["policies"]}
    assert verify(replace(older, episode=replace(older.episode, info=as_now))).difference is None
    hands = [each.columns["agent_0.motion_hands"][:700] for each in (older, acted)]
    assert not np.array_equal(*hands), "by version 7 the carton is held close to the body beside walls"


def _beside_wall(free: FreeSpace, seed: int, room: float) -> tuple[np.ndarray, float]:
    """Return a place at a distance from a wall or furniture, and the heading along it."""
    places = free.sample(np.random.default_rng(seed), 4000)
    place = places[np.argmin(np.abs(free.signed_distance(places) - room))]
    away = free.gradient(place)
    return place, float(np.arctan2(-away[0], -away[1]))


@settings(deadline=None)
@example("male_1", 1, 0, 0.25, 0.0)
@example("female_3", 0, 3, 0.3, 0.3)
@given(
    st.sampled_from(humanoid_names()),
    st.integers(0, 1),
    st.integers(0, 30),
    st.floats(0.25, 0.5),
    st.floats(-0.35, 0.35),
)
def test_what_people_carry_stays_out_of_walls_beside_them(name: str, hand: int, seed: int, room: float, turn: float):
    """People walk along walls and turn by up to the angle at which they walk sideways."""
    source, rules = named_scenes("medium2-open:1")[0].source, SocialNavSpec()
    free, body = open_free_space(source, rules.agent_radius_m, rules.agent_height_m), load_humanoid(name)
    place, along = _beside_wall(free, seed, room)
    heading = along + turn + np.pi * (seed % 2)
    work, state = CarryingHands((), (), body), HumanState.zeros(1)
    state.xz[0], state.heading[0] = place, heading
    carry = CARRIED * reacher(body, BOTH[hand]).body.scale * (1, 1, 2 * hand - 1)
    work.lead[hand], work.hand, work.carries = [*carry, 1.0], hand, True
    work.held = {0: np.append(carry, IDENTITY_POSE[3:])}
    lead, held = work.lead, work.held
    for _ in range(30):
        draw_arms(state, free, body, HOME_WALKER.arms)
        before = lead[hand, :3].copy()
        lead, held = work.beside(free, place, heading, HOME_WALKER, state.arms[0])
        assert np.linalg.norm(lead[hand, :3] - before) < 0.04, "the hand does not jump"
    np.testing.assert_array_equal(held[0][:3], lead[hand, :3])
    quats, pelvis = body.clip_pose([0], [0.0])
    draw_in(quats, state.arms, shoulders_forward=True)
    lead_hands(body, quats, pelvis, lead[None])
    root = root_pose(body, place, heading, free)
    start, end, radius = body.capsules_world(body.joint_matrices(root[None], quats, pelvis))
    arm = [k for k, part in enumerate(body.capsules) if part.name in (f"{BOTH[hand]}_forearm", f"{BOTH[hand]}_hand")]
    rooms = [free.signed_distance(points[0, arm][:, [0, 2]]) - radius[arm] for points in (start, end)]
    middle = pose_multiply(root, held[0])[[0, 2]]
    assert min(*np.concatenate(rooms), free.signed_distance(middle) - ITEM_M[0]) > -0.02


@pytest.mark.parametrize("name", ["female_3", "male_2"])
def test_nobody_puts_things_down_through_a_wall(name: str) -> None:
    source, rules = named_scenes("medium2-open:1")[0].source, SocialNavSpec()
    scene, free = open_scene(source), open_free_space(source, rules.agent_radius_m, rules.agent_height_m)
    body, through = load_humanoid(name), []
    for walls in (False, True):
        for thing in ("kitchen_counter_0", "dining_table_0", "kitchen_counter_1"):
            stop = Stop(thing, "put", 9.0)
            plan = chore_at(scene, free, body, stop, near=np.array([8.2, 4.2]), number=3, walls=walls)
            at = plan.root[[0, 2]]
            between = free.signed_distance(at + np.linspace(0, 1, 40)[:, None] * (plan.spot[[0, 2]] - at))
            # on the way to the thing the floor ends once, and what is behind is the thing
            free_to = np.argmax(between < 0) / 40 * np.linalg.norm(plan.spot[[0, 2]] - at)
            through.append((walls, bool(np.linalg.norm(plan.spot[[0, 2]] - at) - free_to > 0.25)))
    assert (True, True) not in through
    assert (False, True) in through, "by version 6 they did"


def test_breakfasts_differ_by_seed_and_are_refused_where_nothing_opens() -> None:
    names = [read_role("breakfast").routine, *routines().names()]
    assert names == ["breakfast", "morning", "evening", "stops", "breakfast", "chores"]
    scene = hall()
    home = FreeSpace.from_scene(scene, radius_m=0.25, height_m=1.5)
    task = Wander()
    episode = task.sample(scene, home, 1, SocialNavSpec(max_steps=2), make_roster(["human"]))
    with pytest.raises(SceneError, match="H3-TASK-089"):
        simulate(task, episode, {"human": "orca+breakfast"})


def knocker(task: Any, episode: Any, number: int) -> CrowdPolicy:
    """A person who knocks at the front door."""
    return chores_at([Stop("front_door", "knock", 5.0)], episode, number)


@pytest.mark.slow
def test_knuckles_come_to_the_door_three_times() -> None:
    agents = {"human": f"{__name__}:knocker"}
    knocks = h3data.simulate("wander", "medium2:1", roster=["female_1"], agents=agents, seed=3, max_steps=900)
    begin = next(event.step for event in knocks.events if event.kind == "activity" and event.target == "knocking")
    replay, rows = Replay(knocks), np.arange(begin, min(begin + 150, len(knocks)))
    body, lead = replay.model(0), knocks.columns["agent_0.motion_hands"][rows, 1]
    assert isinstance(body, Humanoid)
    held = lead[:, 3] == 1
    ahead = lead[held, 0].astype(np.float64)
    near = ahead > ahead.max() - 0.005
    assert np.diff(near.astype(int)).clip(0).sum() + near[0] == 3
    # the palm is where it is led, in the frame of the root
    root = pose_to_matrix(knocks.columns["agent_0.base_pose"][rows[held]].astype(np.float64))
    palm = hand_points(replay.joint_matrices(0, rows[held]), body)
    there = np.einsum("tab,tb->ta", root[:, :3, :3], lead[held, :3]) + root[:, :3, 3]
    np.testing.assert_allclose(palm, there, atol=5e-3)
    assert verify(knocks).difference is None


def reader(task: Any, episode: Any, number: int) -> CrowdPolicy:
    """A person who reads on the sofa."""
    return chores_at([Stop("sofa_0", "read", 8.0)], episode, number)


@pytest.mark.slow
def test_who_reads_holds_a_book_while_sitting() -> None:
    agents = {"human": f"{__name__}:reader"}
    reads = h3data.simulate("wander", "small:1", roster=["female_1"], agents=agents, seed=3, max_steps=800)
    parts = [body.moving for body in reads.moving_bodies if "book" in body.name]
    assert len(parts) == 4
    book = reads.columns["object_pose"][:, parts, :3].astype(np.float64)
    shown = np.flatnonzero(np.isfinite(book).all((1, 2)))
    assert len(shown) > 100
    assert (reads.columns["agent_0.motion_seat"][shown, 1] == 1).all()
    replay = Replay(reads)
    body = replay.model(0)
    assert isinstance(body, Humanoid)
    frames = replay.joint_matrices(0, shown[::20])
    palms = np.mean([hand_points(frames, body, hand) for hand in ("left", "right")], 0)
    # the right hand turns pages
    assert np.linalg.norm(book[shown[::20]].mean(1) - palms, axis=1).max() < 0.15
    assert verify(reads).difference is None


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 5])
def test_people_have_things_at_spots_of_their_own(seed: int) -> None:
    (named,) = named_scenes(HOME)
    scene, free = open_scene(named.source), open_free_space(named.source, 0.25, 1.9)
    roster = make_roster(["robot", *["human"] * 4])
    episode = Wander().sample(scene, free, seed, SocialNavSpec(spawn_distance_m=0.8), roster)
    closest = {}
    for version in (8, 9):
        spots = []
        for number in range(1, 5):
            routine = chores(episode, number, version)
            plans = [plan for plan in routine.plans.values() if isinstance(plan, Chore) and plan.name != "take"]
            spots.append(np.array([plan.spot for plan in plans]).reshape(-1, 3))
        gaps = [np.linalg.norm(a[:, None] - b, axis=2) for a, b in combinations(spots, 2) if len(a) and len(b)]
        closest[version] = min(gap.min() for gap in gaps)
    assert closest[8] < 1e-9
    assert closest[9] >= APART_M
