"""Any mix of robots and people in a world: state, contact, wandering, rearrangement, pictures."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.bodies import load_humanoid, load_robot
from h3data.errors import InputError, SceneError
from h3data.geometry import ground_pose
from h3data.metrics import measure
from h3data.recording import Recording, open_recording, write_mcap
from h3data.replay import Replay
from h3data.scene import FreeSpace, Scene
from h3data_homes import HomeSpec, build_home
from h3data_pipelines.validation.recordings import validate_recording
from sim_kinematic.agents.roster import kinds_of, make_roster
from sim_kinematic.avoidance.robot_base import base_of
from sim_kinematic.contact.clearance import RobotHumanContact
from sim_kinematic.motion.spec import HOME_BASE, SocialNavSpec
from sim_kinematic.motion.state import WorldState
from sim_kinematic.policies.assignment import assign
from sim_kinematic.sensing.camera_sensor import CameraSensor, StateRenderer
from sim_kinematic.tasks.play import WorldRollout, contact_columns
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode
from sim_kinematic.tasks.resume import verify
from tests.sim.steppers import AgentWorlds
from tests.simulated import REARRANGE, rearrange_episode, simulate_rearrange, simulate_wander

MIXES = ("robot", "human", "robot,robot", "human,male_1", "robot,human", "robot,lift_arm,human,female_2")
CLOSE = SocialNavSpec(spawn_distance_m=1.2)


@pytest.fixture(scope="module")
def home() -> Scene:
    return build_home(HomeSpec(preset="small", seed=5))


@pytest.fixture(scope="module")
def free(home: Scene) -> FreeSpace:
    return FreeSpace.from_scene(home)


@pytest.fixture(scope="module")
def drawn(home: Scene, free: FreeSpace) -> RearrangeEpisode:
    """An episode of rearrangement for whoever plays it."""
    return rearrange_episode(home, seed=3, free=free)


def random_actions(worlds: AgentWorlds, rng: np.random.Generator) -> list[np.ndarray]:
    """Drives at random, and waypoints within half a metre."""
    drives = [rng.uniform(-1, 1, (worlds.state.worlds, 2)) for _ in worlds.state.robots]
    return drives + [p.xz + rng.uniform(-0.5, 0.5, (worlds.state.worlds, 2)) for p in worlds.state.people]


# --- the state ----------------------------------------------------------------------------------------------------------
@given(st.integers(0, 3), st.integers(0, 3), st.integers(0, 2), st.integers(1, 5))
def test_worlds_are_taken_and_put_back(robots: int, people: int, objects: int, worlds: int) -> None:
    state = WorldState.zeros(worlds, robots=robots, people=people, joints=range(robots), objects=objects)
    rng = np.random.default_rng(0)
    for array in state.arrays():
        array[...] = rng.integers(0, 2, array.shape)
    assert len(state.agents) == robots + people
    assert len(state.arrays()) == 4 * robots + 8 * people + 4
    assert [own.joints.shape for own in state.robots] == [(worlds, j) for j in range(robots)]
    copy, blank = (
        state.copy(),
        WorldState.zeros(worlds, robots=robots, people=people, joints=range(robots), objects=objects),
    )
    for w in range(worlds):
        blank.put([w], state.take([w]))
    for a, b, c in zip(state.arrays(), copy.arrays(), blank.arrays(), strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)
        assert not np.shares_memory(a, b)


@pytest.mark.parametrize(
    "bad", [{"robots": -1}, {"people": -1}, {"robots": 2, "joints": [7]}, {"objects": -2}, {"joints": -1}]
)
def test_impossible_states_are_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="H3-SIM-033"):
        WorldState.zeros(2, **bad)


# --- casts --------------------------------------------------------------------------------------------------------------
def test_a_cast_counts_robots_first() -> None:
    cast = make_roster("human, lift_arm,male_1,robot")
    assert [(m.name, m.model) for m in cast] == [
        ("robot_1", "lift_arm"),
        ("robot_2", "quad_arm"),
        ("human_1", "female_0"),
        ("human_2", "male_1"),
    ]
    assert kinds_of(make_roster(["human"])) == ("human",)
    assert make_roster(["human"])[0].name == "human"


@pytest.mark.parametrize("agents", ["", [], "cat", "robot,,human", ["robot", None], [7], "ROBOT"])
def test_agents_that_do_not_exist_are_refused(agents: Any) -> None:
    with pytest.raises(InputError, match=r"(?s)robot.*H3-SIM-0(19|20)"):
        make_roster(agents)


# --- worlds -------------------------------------------------------------------------------------------------------------
@settings(max_examples=3)
@given(st.sampled_from(MIXES), st.integers(0, 2**32 - 1))
def test_one_world_is_as_many(home: Scene, free: FreeSpace, agents: str, seed: int) -> None:
    many, again = (AgentWorlds(home, agents, worlds=64, spec=CLOSE, free=free) for _ in range(2))
    one, rng = AgentWorlds(home, agents, spec=CLOSE, free=free), np.random.default_rng(seed)
    for worlds in (many, again):
        worlds.reset(seed)
    w = int(rng.integers(64))
    one.state.put([0], many.state.take([w]))
    for _ in range(12):
        actions = random_actions(many, rng)
        touching = many.step(actions)
        np.testing.assert_array_equal(again.step(actions), touching)
        np.testing.assert_array_equal(one.step([a[[w]] for a in actions])[0], touching[w])
    for a, b, c in zip(many.state.arrays(), again.state.arrays(), one.state.arrays(), strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a[[w]], c)


@settings(max_examples=8)
@given(st.permutations(range(4)), st.integers(0, 2**32 - 1))
def test_who_touches_whom_does_not_depend_on_the_order(
    home: Scene, free: FreeSpace, order: list[int], seed: int
) -> None:
    names, rng = ["quad_arm", "lift_arm", "female_0", "male_1"], np.random.default_rng(seed)
    places = np.concatenate([rng.uniform(-0.6, 0.6, (4, 2)), rng.uniform(-3, 3, (4, 1))], axis=1)
    found = []
    for listed in (names, [names[k] for k in order]):
        worlds = AgentWorlds(home, listed, free=free)
        for member, own in zip(worlds.cast, worlds.state.agents, strict=True):
            own.xz[0], own.heading[0] = (place := places[names.index(member.model)])[:2], place[2]
        stay = [np.zeros((1, 2)) for _ in worlds.state.robots] + [own.xz.copy() for own in worlds.state.people]
        touching = worlds.step(stay)[0]
        models = [member.model for member in worlds.cast]
        found.append({frozenset((models[a], models[b])) for (a, b), t in zip(worlds.pairs, touching, strict=True) if t})
    assert found[0] == found[1]


def test_robot_and_person_touch_as_in_social_navigation(home: Scene, free: FreeSpace) -> None:
    rng, count = np.random.default_rng(0), 200
    worlds = AgentWorlds(home, worlds=count, free=free)
    (robot,), (person,) = worlds.state.robots, worlds.state.people
    robot.xz[:], robot.heading[:] = rng.uniform(-0.7, 0.7, (count, 2)), rng.uniform(-3, 3, count)
    person.heading[:] = rng.uniform(-3, 3, count)
    robot.joints[:] = load_robot("quad_arm").rest
    touching = worlds.step([np.zeros((count, 2)), np.zeros((count, 2))])[:, 0]
    contact = RobotHumanContact(load_robot("quad_arm"), load_humanoid("female_0"))
    bases = (ground_pose(own.xz, own.heading, free.floor_y) for own in (robot, person))
    expected = contact.touching(*bases, np.zeros(count, int), np.zeros(count), np.ones(count))
    np.testing.assert_array_equal(touching, expected)
    assert 40 < expected.sum() < 180


@pytest.mark.parametrize(
    "bad",
    [
        [],
        [[[0, 0]]],
        [[[0, 0]], [[0, 0]], [[0, 0]]],
        [[[0, np.nan]], [[0, 0]]],
        [[[0, 0]], [[np.inf, 0]]],
        [[[0, 0, 0]], [[0, 0]]],
    ],
)
def test_bad_actions_move_nobody(home: Scene, free: FreeSpace, bad: Any) -> None:
    worlds = AgentWorlds(home, free=free)
    worlds.reset(0)
    before = worlds.state.copy()
    with pytest.raises(InputError, match=r"(?s)(robot|human).*H3-SIM-053| 2 .*H3-SIM-051"):
        worlds.step(bad)
    for a, b in zip(before.arrays(), worlds.state.arrays(), strict=True):
        np.testing.assert_array_equal(a, b)


def test_no_worlds_and_no_room(home: Scene, free: FreeSpace) -> None:
    with pytest.raises(InputError, match="H3-SIM-050"):
        AgentWorlds(home, worlds=0, free=free)
    with pytest.raises(SceneError, match="H3-SIM-021"):
        AgentWorlds(home, ["human"] * 60, free=free).reset(0)
    with pytest.raises(InputError, match="H3-TASK-004"):
        simulate_wander(home, steps=0, free=free)


# --- recordings ---------------------------------------------------------------------------------------------------------
def require_sound(recording: Recording, tmp_path: Any) -> None:
    """It is read back as it was, every reader takes it, and nobody is inside an obstacle."""
    file = tmp_path / "r.mcap"
    write_mcap(recording, file)
    back = open_recording(file)
    np.testing.assert_array_equal(back.columns["state_hash"], recording.columns["state_hash"])
    assert not [p for p in validate_recording(back) if p.severity == "error"]
    replay = Replay(back)
    assert len(replay) == len(recording)


def require_outside(recording: Recording, free: FreeSpace) -> None:
    for k, agent in enumerate(recording.agents):
        pose = recording.columns[f"agent_{k}.base_pose"].astype(np.float64)
        if agent.kind == "robot":
            base = base_of(load_robot(agent.model.removeprefix("robot/")), HOME_BASE)
            heading = 2 * np.arctan2(pose[:, 4], pose[:, 6])
            ahead = np.stack([np.cos(heading), -np.sin(heading)], axis=-1)
            for offset in base.disc_offsets_m:
                gap = free.signed_distance(pose[:, [0, 2]] + offset * ahead) - base.disc_radius_m
                assert gap.min() >= -base.clearance_tolerance_m - 1e-5
        else:
            xz = pose[:, [0, 2]]
            assert np.hypot(*(free.snap(xz) - xz).T).max() <= 2e-3


@pytest.mark.parametrize(
    "agents",
    [mix if mix in ("robot", "human", "robot,human") else pytest.param(mix, marks=pytest.mark.slow) for mix in MIXES],
)
def test_everybody_wanders(home: Scene, free: FreeSpace, agents: str, tmp_path: Any) -> None:
    made = [simulate_wander(home, agents, seed=4, steps=120, free=free) for _ in range(2)]
    assert made[0].columns["state_hash"][-1] == made[1].columns["state_hash"][-1]
    recording = made[0]
    assert [a.kind for a in recording.agents] == list(kinds_of(make_roster(agents)))
    require_sound(recording, tmp_path)
    require_outside(recording, free)
    for k in range(len(recording.agents)):
        assert np.ptp(recording.columns[f"agent_{k}.base_pose"][:, [0, 2]], axis=0).max() > 0.5


@pytest.mark.parametrize(
    ("agents", "policy", "partner"),
    [
        ("robot,robot", "complement,both", "both"),
        pytest.param("human,male_1", "complement", "both,complement", marks=pytest.mark.slow),
        ("robot", "greedy_nearest", "both"),
        pytest.param("robot,robot,human", "complement", "object_1", marks=pytest.mark.slow),
    ],
)
def test_any_agents_rearrange(
    drawn: RearrangeEpisode, free: FreeSpace, agents: str, policy: str, partner: str, tmp_path: Any
) -> None:
    world = drawn.played_by(agents)
    recording = simulate_rearrange(world, policy=policy, partner=partner, solo_steps=700)
    assert [a.name for a in recording.agents] == [m.name for m in make_roster(agents)]
    assert {e.kind for e in recording.events} & {"pick", "collision"}
    assert all(0 <= e.agent < len(recording.agents) for e in recording.events if e.kind == "pick")
    require_sound(recording, tmp_path)
    require_outside(recording, free)
    assert measure(recording).values["TS"] == len(recording) or recording.episode.info["ended"] != "success"


def test_the_same_seed_gives_the_same_bits(home: Scene, free: FreeSpace, drawn: RearrangeEpisode) -> None:
    other = rearrange_episode(home, seed=3, free=free, agents="robot,robot")
    world = drawn.played_by("robot,robot")
    for one, two in zip(other.targets, world.targets, strict=True):
        np.testing.assert_array_equal(one.goal, two.goal)
    np.testing.assert_array_equal(other.starts, world.starts)
    np.testing.assert_array_equal(world.starts[0], drawn.starts[0])
    hashes = [
        simulate_rearrange(one, policy="greedy_nearest", solo_steps=700).columns["state_hash"] for one in (world, other)
    ]
    np.testing.assert_array_equal(*hashes)


@pytest.mark.slow
def test_a_person_alone_is_the_solo_episode(drawn: RearrangeEpisode) -> None:
    alone = simulate_rearrange(drawn.played_by("human"), partner="object_1", solo_steps=700)
    solo = simulate_rearrange(drawn, policy="solo", partner="object_1", solo_steps=700)
    assert alone.episode == solo.episode
    np.testing.assert_array_equal(alone.columns["state_hash"], solo.columns["state_hash"])


def test_everybody_needs_a_policy(drawn: RearrangeEpisode) -> None:
    world = drawn.played_by("robot,robot")
    with pytest.raises(InputError, match=r"(?s)2.*H3-POLICY-004"):
        simulate_rearrange(world, policy="complement,both,still")
    with pytest.raises(InputError, match=r"(?s)policy.*H3-POLICY-002"):
        simulate_rearrange(world, policy="complement,magic")
    with pytest.raises(InputError, match=r"(?s)2.*H3-TASK-016"):
        WorldRollout.of(REARRANGE, world, [])
    first, second = assign(REARRANGE, world.played_by("human,male_1"), {"human": "both"})
    assert first.plan == second.plan == "both"
    assert first.policy is not second.policy


# --- pictures -----------------------------------------------------------------------------------------------------------
def test_everybody_sees_everybody(home: Scene, free: FreeSpace) -> None:
    worlds = AgentWorlds(home, "robot,lift_arm,human,male_1", worlds=2, free=free)
    centre = free.snap(np.array([worlds.free.origin]) + 2.0)[0]
    drawn = StateRenderer(home, [member.body for member in worlds.cast], worlds=2)
    corners = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]]) * 1.3
    for own, corner, member in zip(worlds.state.agents, corners, worlds.cast, strict=True):
        own.xz[:], own.heading[:] = centre + corner, np.arctan2(corner[1], -corner[0])
        if member.kind == "robot":
            own.joints[:] = member.body.rest  # type: ignore[union-attr]
    drawn.pose(worlds.state, floor=50.0)  # far above the home: nothing is in the way
    for k in (2, 3):
        seen = CameraSensor(agent=k, outputs=("instance",), size=(120, 90)).observe(drawn)["instance"]
        assert np.isin(seen, drawn.instances(k - 2)).sum((1, 2)).min() > 30  # who stands opposite
    with pytest.raises(InputError, match="H3-SIM-043"):
        drawn.cameras(agent=4)
    with pytest.raises(InputError, match=r"(?s)1.*1.*H3-SIM-029"):
        drawn.pose(WorldState.zeros(2))


# --- metrics ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("agents", ["robot,lift_arm", "human,male_1", "robot,robot,human"])
def test_any_two_agents_are_measured_near_each_other(home: Scene, free: FreeSpace, agents: str) -> None:
    recording = simulate_wander(home, agents, seed=1, steps=40, free=free)
    measured = measure(recording, "field")
    chosen = (0, 2) if "robot,human" in agents else (0, 1)
    own, other = (recording.columns[f"agent_{k}.base_pose"][:, [0, 2]].astype(np.float64) for k in chosen)
    assert measured.values["D_min"] == pytest.approx(np.hypot(*(own - other).T).min())
    assert measured.values["PL"] == pytest.approx(np.hypot(*np.diff(own, axis=0).T).sum())
    told = [recording.agents[k].name for k in chosen]
    same_kind = chosen == (0, 1)
    assert all(name in measured.notes.get("D_min", "") for name in told) is same_kind
    if same_kind:
        with pytest.raises(InputError, match=r"(?s)'wander'.*field, social, partnr.*H3-METRIC-023"):
            measure(recording, "paper")


def test_one_agent_is_near_nobody(home: Scene, free: FreeSpace) -> None:
    with pytest.raises(InputError, match="H3-METRIC-029"):
        measure(simulate_wander(home, "robot", steps=3, free=free), "field")


def test_contacts_are_told_apart() -> None:
    # Pairs of two robots (0, 1) and two people (2, 3): 01, 02, 03, 12, 13, 23.
    touching = np.array([[0, 0, 0, 0, 0, 1], [0, 0, 1, 0, 0, 0], [1, 0, 0, 1, 0, 0], [0] * 6], np.bool_)
    columns = contact_columns(["robot", "robot", "human", "human"], touching)
    assert columns["metrics.collision"].tolist() == [True, True, True, False]
    assert columns["metrics.collision_people"].tolist() == [
        [False, False],
        [False, True],
        [False, False],
        [False, False],
    ]
    assert columns["metrics.collision_robots"].tolist() == [[False], [False], [True], [False]]
    assert set(contact_columns(["human", "robot", "human"], touching[:, :3])) == {
        "metrics.collision",
        "metrics.collision_people",
    }
    assert contact_columns(["human", "robot", "human"], touching[1:3, [0, 2, 5]])[
        "metrics.collision_people"
    ].tolist() == [
        [False, False],
        [True, False],
    ]
    for kinds in (["robot", "human"], ["human", "human", "human"]):
        assert set(contact_columns(kinds, touching[:, :3])) == {"metrics.collision"}


def test_recordings_say_whom_the_robot_touches_and_older_ones_still_verify(
    home: Scene, free: FreeSpace, tmp_path: Any
) -> None:
    recording = simulate_wander(home, "robot,human,male_1", seed=4, steps=20, free=free)
    told = recording.columns["metrics.collision_people"]
    assert (told.dtype, told.shape) == (np.bool_, (20, 2))
    require_sound(recording, tmp_path)
    assert measure(recording, "social").values["HC"] == 0
    older = {name: column for name, column in recording.columns.items() if name != "metrics.collision_people"}
    assert verify(replace(recording, columns=older)).equal
    wrong = replace(recording, columns={**recording.columns, "metrics.collision_people": ~told})
    assert verify(wrong).difference.column == "metrics.collision_people"
