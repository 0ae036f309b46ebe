"""Social rearrangement: episodes that can be done, objects that follow hands and else stay put, skills with pre-conditions,
partners and populations, what the paper measures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from h3data.bodies import load_humanoid, load_robot, solve_ik
from h3data.bodies.people.reach import hand_points, reach
from h3data.errors import InputError, SceneError
from h3data.geometry import ground_pose, pose_inverse, pose_multiply, pose_to_matrix, quat_rotate
from h3data.metrics import measure
from h3data.recording import Recording, read_mcap, recordings_equal, state_hash, write_mcap
from h3data.scene import FreeSpace, Scene, instance_matrix
from h3data_homes import HomeSpec, build_home
from sim_kinematic.agents.robots.hand_reach import HAND_REACH, hand_turn
from sim_kinematic.agents.skills import SKILLS, Action
from sim_kinematic.agents.stands import person_stands, robot_stands
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.contact import FclScene, MovingShapes, collide
from sim_kinematic.motion.spec import BaseSpec
from sim_kinematic.policies.rearrange import (
    PARTNERS,
    PLANS,
    POPULATIONS,
    ROBOT_POLICIES,
    partner_plan,
    planner,
    robot_policy,
)
from sim_kinematic.policies.views import RearrangeView
from sim_kinematic.tasks.rearrange.codec import solo_steps_of
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode, RearrangeSpec
from sim_kinematic.tasks.rules.rewards import REARRANGE_REWARDS
from tests.sim.avoidance.commands import Seen, kept_clear
from tests.simulated import REARRANGE, rearrange_episode, simulate_rearrange


@pytest.fixture(scope="module")
def home() -> Scene:
    return build_home(HomeSpec(preset="small", seed=1))


@pytest.fixture(scope="module")
def free(home: Scene) -> FreeSpace:
    return FreeSpace.from_scene(home, radius_m=0.25, cache=False)


@pytest.fixture(scope="module")
def world(home: Scene, free: FreeSpace) -> RearrangeEpisode:
    return rearrange_episode(home, seed=3, free=free)


@pytest.fixture(scope="module")
def pair(world: RearrangeEpisode) -> Recording:
    """The robot and the person do one object each."""
    return simulate_rearrange(world, policy="complement", partner="both")


@dataclass
class Scripted:
    """Chooses from a list, then waits; keeps how each ended."""

    actions: list[Action]
    when: Callable[[RearrangeView], str] = lambda view: ""
    ended: list[str] = field(default_factory=list)

    def act(self, view: RearrangeView) -> Action:
        if view.last is not None:
            self.ended.append(view.last.reason or view.last.outcome)
        return self.actions.pop(0) if self.actions else Action("wait")

    def interrupts(self, view: RearrangeView) -> str:
        return self.when(view)


# --- episodes ---------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_episodes_are_fair(home: Scene, free: FreeSpace) -> None:
    """Objects and goals lie on receptacles of two pieces of furniture, touch nothing, and both agents can get at them."""
    surfaces = {f"{i.name}|{r.name}": instance_matrix(i) @ np.append(r.center, 1) for i, r in home.receptacles()}
    fixed, drawn = FclScene(home), set()
    for seed in range(4):
        w = rearrange_episode(home, seed=seed, free=free)
        assert np.hypot(*(w.starts[0, :2] - w.starts[1, :2])) >= w.spec.spawn_distance_m
        assert len({t.name for t in w.targets}) == 2
        for t in w.targets:
            assert t.source.split("|")[0] != t.destination.split("|")[0]
            assert np.hypot(*(t.start[:3] - t.goal)[[0, 2]]) >= w.spec.carry_m
            instance = next(i for i in home.instances if i.name == t.name)
            bottom = float(home.assets[instance.asset].mesh.bounds[0, 1])
            shapes = MovingShapes(home.assets[instance.asset].shapes)
            for place, on in ((t.start, t.source), (np.append(t.goal, t.start[3:]), t.destination)):
                assert place[1] + bottom == pytest.approx(surfaces[on][1] + 0.001, abs=1e-6)
                shapes.set_transforms(np.tile(pose_to_matrix(place), (len(home.assets[instance.asset].shapes), 1, 1)))
                assert not collide(fixed, shapes)
            drawn.add((t.name, t.destination))
        assert seed or solo_steps_of(REARRANGE, w) < w.spec.max_steps
    assert len(drawn) > 4


def test_stands_reach(world: RearrangeEpisode) -> None:
    for target in world.targets:
        point = target.start[:3]
        stands = person_stands(world.free, world.human, point)
        assert world.free.is_navigable(stands[:, :2]).all()
        for x, z, heading in stands[:: max(len(stands) // 5, 1)]:
            seen = pose_multiply(pose_inverse(ground_pose([x, z], heading)), np.append(point, [0, 0, 0, 1.0]))
            assert reach(world.human, seen[:3]).reached
        for x, z, heading in robot_stands(world.free, world.robot, BaseSpec(), point)[::7]:
            seen = pose_multiply(pose_inverse(ground_pose([x, z], heading)), np.append(point, [0, 0, 0, 1.0]))
            goal = np.append(seen[:3], hand_turn(world.robot))
            assert solve_ik(world.robot, "arm_hand", goal, offset=world.robot.hand_position).reached
    ahead = quat_rotate(hand_turn(world.robot), np.array([1.0, 0, 0]))
    assert np.arcsin(ahead[1]) == pytest.approx(HAND_REACH.hand_pitch_rad)


def test_what_cannot_be_drawn_says_why(home: Scene, free: FreeSpace) -> None:
    bare = replace(home, instances=home.static_instances)
    with pytest.raises(SceneError, match=r"(?s)0.*H3-TASK-010"):
        rearrange_episode(bare, seed=0, free=free)
    with pytest.raises(SceneError, match=r"(?s)person alone would take.*H3-TASK-009"):
        rearrange_episode(home, seed=0, free=free, spec=RearrangeSpec(max_steps=300))
    with pytest.raises(InputError, match=r"(?s)paper, habitat.*H3-TASK-011"):
        RearrangeSpec(reward="mine")


# --- a whole episode --------------------------------------------------------------------------------------------------
def test_a_pair_finishes_and_halves_the_time(world: RearrangeEpisode, pair: Recording) -> None:
    values = measure(pair).values
    assert pair.episode.info["ended"] == "success"
    assert values["SR"] == 1
    assert values["CR"] == 0
    assert values["RC"] == 0.5
    assert values["RE"] > 130
    assert values["RE"] == pytest.approx(100 * solo_steps_of(REARRANGE, world) / len(pair))
    assert pair.columns["metrics.at_goal"][-1].all()
    assert not pair.columns["metrics.at_goal"][:-1].all(axis=1).any()


def test_the_reward_is_the_papers(world: RearrangeEpisode, pair: Recording) -> None:
    reward = pair.columns["metrics.reward"].astype(float)
    assert reward.sum() == pytest.approx(10 + 4 * 5 - 0.005 * len(pair), abs=1e-3)
    cheap = replace(world, spec=replace(world.spec, reward="habitat"))
    again = simulate_rearrange(cheap, policy="complement", partner="both", solo_steps=1)
    assert again.columns["metrics.reward"].astype(float).sum() == pytest.approx(30 - 0.0005 * len(pair), abs=1e-3)
    assert REARRANGE_REWARDS["habitat"].collision == 0.5


def test_objects_follow_hands_and_else_stay_put(world: RearrangeEpisode, pair: Recording) -> None:
    robot, human = load_robot("quad_arm"), load_humanoid("female_0")
    columns = pair.columns
    links = robot.link_matrices(columns["agent_0.base_pose"], columns["agent_0.joint_pos"])[:, robot.hand_link]
    grip = links[:, :3, :3] @ robot.hand_position + links[:, :3, 3]
    bones = human.joint_matrices_free(columns["agent_1.root_pose"], columns["agent_1.joint_quat"])
    palms = hand_points(bones, human, "right")
    for k, body in enumerate(pair.episode.info["goal_objects"]):
        track = columns["object_pose"][:, k]
        by = {i: columns[f"agent_{i}.grasp_body"] == body for i in (0, 1)}
        assert by[0].any() != by[1].any()
        assert np.linalg.norm(track[by[0], :3] - grip[by[0]], axis=1).max(initial=0) < 0.02
        assert np.linalg.norm(track[by[1], :3] - palms[by[1]], axis=1).max(initial=0) < 0.011
        free_now = ~(by[0] | by[1])
        still = free_now[1:] & free_now[:-1]
        assert np.abs(np.diff(track, axis=0)[still]).max() == 0
        np.testing.assert_allclose(track[-1, :3], world.targets[k].goal, atol=0.012)
        assert quat_rotate(track[-1, 3:].astype(float), np.array([0, 1.0, 0]))[1] > 0.999  # it stands


def test_bodies_keep_their_speed_and_out_of_obstacles(world: RearrangeEpisode, pair: Recording) -> None:
    for i in (0, 1):
        base = pair.columns[f"agent_{i}.base_pose"].astype(float)
        assert np.hypot(*np.diff(base[:, [0, 2]], axis=0).T).max() < 2.5 / 30 + 0.03  # a push-out adds a little
    robot = pair.columns["agent_0.base_pose"].astype(float)
    ahead = quat_rotate(robot[:, 3:], np.array([0.225, 0, 0]))
    for offset in (0.0, 1.0):
        discs = (robot[:, :3] + offset * ahead)[:, [0, 2]]
        assert world.free.signed_distance(discs).min() >= 0.25 - 0.0025
    assert world.free.is_navigable(world.free.snap(pair.columns["agent_1.base_pose"][:, [0, 2]])).all()
    joints = np.abs(np.diff(pair.columns["agent_0.joint_pos"], axis=0)).max()
    assert joints <= world.spec.arm_rad_s / 30 + 1e-5


def test_an_instant_arm_picks_and_places_in_one_step(home: Scene, free: FreeSpace) -> None:
    """Habitat's oracle pick and place change the world in the step of the action (spec/habitat.md 2.4)."""
    spec = RearrangeSpec(arm_rad_s=float("inf"))
    episode = rearrange_episode(home, seed=3, free=free, spec=spec)
    recording = simulate_rearrange(episode, policy="complement", partner="both")
    pick, place = (s for s in recording.skills if s.agent == 0 and s.name in ("pick", "place"))
    assert (pick.start_step, pick.outcome) == (pick.end_step, "done")
    assert (place.start_step, place.outcome) == (place.end_step, "done")
    in_hand = recording.columns["agent_0.grasp_body"] >= 0
    assert np.flatnonzero(in_hand).tolist() == list(range(pick.end_step, place.start_step))


def test_same_seed_same_bits(home: Scene, free: FreeSpace, world: RearrangeEpisode, pair: Recording, tmp_path) -> None:
    again = simulate_rearrange(rearrange_episode(home, seed=3, free=free), policy="complement", partner="both")
    assert recordings_equal(pair, again) == []
    state = {k: v for k, v in pair.columns.items() if k != "state_hash"}
    np.testing.assert_array_equal(state_hash(state), pair.columns["state_hash"])
    assert recordings_equal(read_mcap(write_mcap(pair, tmp_path / "e.mcap") or tmp_path / "e.mcap"), pair) == []
    other = simulate_rearrange(world, policy="same_object", partner="object_2", solo_steps=1)
    assert other.columns["state_hash"][-1] != pair.columns["state_hash"][-1]
    assert other.episode.uid != pair.episode.uid


def test_skills_and_events_tell_the_story(pair: Recording) -> None:
    for agent in (0, 1):
        spans = [s for s in pair.skills if s.agent == agent and s.outcome == "done" and s.name in SKILLS[:4]]
        told = [s.name for s in spans if s.name in ("pick", "place")]
        assert told[0] == "pick"
        codes = pair.columns[f"agent_{agent}.skill"]
        for s in spans:
            if s.end_step > s.start_step:
                assert (codes[s.start_step : s.end_step] == SKILLS.index(s.name)).all()
    last = next(e for e in reversed(pair.events) if e.kind == "place")
    ends = {s.agent: s for s in pair.skills if s.end_step == len(pair) - 1}
    assert (ends[last.agent].name, ends[last.agent].outcome) == ("place", "done"), "the skill that completes the task"
    assert ends[1 - last.agent].outcome == "running"
    assert pair.episode.info["ended"] == "success"
    kinds = [(e.kind, e.agent) for e in pair.events]
    assert sorted(k for k, _ in kinds) == ["pick", "pick", "place", "place", "success"]
    for e in pair.events:
        if e.kind == "pick":
            assert pair.columns[f"agent_{e.agent}.grasp_body"][e.step] >= 0
            assert pair.columns[f"agent_{e.agent}.grasp_body"][e.step - 1] < 0


def test_the_person_alone(world: RearrangeEpisode) -> None:
    alone = simulate_rearrange(world, policy="solo", partner="both")
    assert [a.kind for a in alone.agents] == ["human"]
    assert len(alone) == alone.episode.info["solo_steps"] == solo_steps_of(REARRANGE, world)
    values = measure(alone).values
    assert values["SR"] == 1
    assert values["RE"] == 100
    assert np.isnan(values["RC"])  # there is no robot


# --- skills -----------------------------------------------------------------------------------------------------------
def test_infeasible_skills_are_reported_no_ops(world: RearrangeEpisode) -> None:
    short = replace(world, spec=replace(world.spec, max_steps=12))
    script = Scripted([Action("pick", 0), Action("place", 0), Action("turn_left"), Action("wait", steps=2)])
    recording = simulate_rearrange(short, policy=script, partner="still", solo_steps=1)
    spans = [s for s in recording.skills if s.agent == 0]
    assert [(s.name, s.outcome, s.reason, s.end_step - s.start_step + 1) for s in spans[:4]] == [
        ("pick", "failed", "out_of_reach", 1),
        ("place", "failed", "not_held", 1),
        ("turn_left", "done", "", 2),
        ("wait", "done", "", 2),
    ]
    base = recording.columns["agent_0.base_pose"]
    assert np.ptp(base[:2], axis=0).max() == 0
    turned = 2 * np.arccos(np.clip(np.abs(np.sum(base[1, 3:] * base[3, 3:])), 0, 1))
    assert turned == pytest.approx(2 * 2.5 / 30, abs=1e-3)  # 9.55 degrees
    assert script.ended[:2] == ["out_of_reach", "not_held"]
    with pytest.raises(InputError, match=r"(?s)nav_to_object.*H3-TASK-083"):
        simulate_rearrange(short, policy=Scripted([Action("fly")]), partner="still", solo_steps=1)
    with pytest.raises(InputError, match=r"(?s)0.*1.*H3-TASK-083"):
        simulate_rearrange(short, policy=Scripted([Action("pick", 2)]), partner="still", solo_steps=1)


def test_a_skill_can_be_aborted_at_any_step(world: RearrangeEpisode) -> None:
    short = replace(world, spec=replace(world.spec, max_steps=20))
    script = Scripted([Action("nav_to_object", 0), Action("nav_to_goal", 1)], lambda v: "why" * (v.step == 7))
    spans = simulate_rearrange(short, policy=script, partner="still", solo_steps=1).skills
    mine = [(s.name, s.start_step, s.end_step, s.outcome, s.reason) for s in spans if s.agent == 0]
    assert mine == [("nav_to_object", 0, 6, "aborted", "why"), ("nav_to_goal", 7, 19, "running", "")]


def test_one_object_two_agents(world: RearrangeEpisode) -> None:
    """Both go for the first object: one gets it, nobody holds it twice, the other does not wait for ever."""
    recording = simulate_rearrange(world, policy="greedy_nearest", partner="both", solo_steps=1)
    held = np.stack([recording.columns[f"agent_{i}.grasp_body"] for i in (0, 1)])
    assert not ((held[0] == held[1]) & (held[0] >= 0)).any()
    assert measure(recording).values["SR"] == 1


# --- who plays --------------------------------------------------------------------------------------------------------
def test_populations_draw_all_their_members() -> None:
    for name, plans in POPULATIONS.items():
        drawn = [partner_plan(name, seed) for seed in range(60)]
        assert set(drawn) == set(plans)
    assert {partner_plan(plan, 5) for plan in PLANS} == set(PLANS)
    assert {planner("both", seed).objects for seed in range(20)} == {(0, 1), (1, 0)}
    with pytest.raises(InputError, match=r"(?s)plan_pop_4.*H3-POLICY-039"):
        partner_plan("nobody", 0)
    with pytest.raises(InputError, match=r"(?s)greedy_nearest.*H3-POLICY-038"):
        robot_policy("magic")
    assert len(PARTNERS) == 8
    assert {"complement", "same_object", "still"} <= set(ROBOT_POLICIES)


@pytest.mark.slow
def test_specialists_depend_on_their_partner(world: RearrangeEpisode) -> None:
    """As the paper's Plan-Pop 1: fine with who does the other object, lost with who does the same."""
    done = {
        plan: measure(simulate_rearrange(world, policy="same_object", partner=plan, solo_steps=1)).values["SR"]
        for plan in ("object_1", "object_2")
    }
    assert done == {"object_1": 1, "object_2": 0}


# --- keeping clear ----------------------------------------------------------------------------------------------------
def test_the_base_gives_way(free: FreeSpace) -> None:
    base = BaseSpec()
    at = free.sample(np.random.default_rng(0), 400)
    at = at[int(np.argmax(free.signed_distance(at)))]
    ahead = at + np.array([1.2, 0.0])
    far = at + np.array([AVOIDANCE.range_m + 1, 0.0])
    go = (1.0, 0.0)
    assert kept_clear(free, base, at, 0.0, go, ahead, [Seen(far)]) == go
    coming = Seen(ahead, (-2.5, 0.0))
    assert kept_clear(free, base, at, 0.0, go, ahead, [Seen(far), coming]) != go
    command = kept_clear(free, base, at, 0.0, (0.0, 0.0), at, [coming])
    assert command != (0.0, 0.0)  # whoever stands in the way steps aside
