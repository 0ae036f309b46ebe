"""Skills as tensors: the lower layer of `RearrangeEnv(level="low")` step for step, and what steps are worth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from h3data.bodies import load_robot
from h3data.errors import InputError
from h3data.geometry import IDENTITY_POSE, quat_to_matrix
from h3data_pipelines.skill_judging import play_of
from h3data_training.torch.skills.arm import Arm, place_hand, seen_by
from h3data_training.torch.skills.bank import SkillBank
from h3data_training.torch.skills.worlds import SkillPlay, SkillTensors
from sim_kinematic.agents.skills import CONTROL, Action
from sim_kinematic.contact.frames import root_pose
from sim_kinematic.motion.spec import SkillSpec
from sim_kinematic.policies.skills.player import SkillView
from sim_kinematic.tasks.play import DecisionLoop, WorldRollout
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.skills.skill_starts import Skill, SkillStart, draw_starts
from sim_kinematic.tasks.sources import EpisodeSource

STEPS = 240


def sampled_episode() -> RearrangeEpisode:
    found = EpisodeSource(Rearrange(), "small:1").sample(0, 0)
    assert isinstance(found, RearrangeEpisode)
    return found


@pytest.fixture(scope="module")
def episode() -> RearrangeEpisode:
    return sampled_episode()


def starts_of(episode: RearrangeEpisode, skill: Skill, count: int = 4, **options: Any) -> list[SkillStart]:
    return draw_starts(episode, skill, count, np.random.default_rng(5), **{"path_m": (0.0, 3.0), **options})


def worlds(episode: RearrangeEpisode, skill: Skill, starts: list[SkillStart]) -> tuple[SkillTensors, SkillPlay]:
    """All starts, one world each, at the beginning."""
    sim = SkillTensors(skill, SkillBank.of([(episode, episode.free, starts)]), device="cpu", dtype=torch.float64)
    play = sim.before_the_first(torch.arange(len(starts)) - 1)
    return sim, sim.step(play, torch.zeros(len(starts), sim.action_width, dtype=torch.float64))


@pytest.mark.parametrize("name", ["quad_arm", "lift_arm"])
def test_the_hand_is_where_the_robots_kinematics_have_it(name: str) -> None:
    robot, rng, count = load_robot(name), np.random.default_rng(0), 40
    columns = list(robot.require_arm())
    joints = np.tile(robot.rest, (count, 1))
    joints[:, columns] = rng.uniform(robot.lower[columns], robot.upper[columns], (count, len(columns)))
    xz, heading = rng.normal(size=(count, 2)), rng.uniform(-4, 4, count)
    frames = robot.link_matrices(root_pose(robot, xz, heading, 0.3), joints)[:, robot.hand_link]
    points = frames[:, :3, 3] + frames[:, :3, :3] @ robot.hand_position
    arm = Arm(robot, "cpu", torch.float64)
    floor = torch.full((count,), 0.3, dtype=torch.float64)
    hand = place_hand(
        arm.hand(torch.as_tensor(joints[:, columns])), torch.as_tensor(xz), torch.as_tensor(heading), floor
    )
    np.testing.assert_allclose(hand.point.numpy(), points, atol=1e-9)
    np.testing.assert_allclose(hand.axes.numpy(), frames[:, :3, :3], atol=1e-9)
    far = rng.normal(size=(count, 3))
    seen = np.einsum("nji,nj->ni", frames[:, :3, :3], far - points)
    np.testing.assert_allclose(seen_by(hand, torch.as_tensor(far)).numpy(), seen, atol=1e-9)


@pytest.mark.parametrize("name", ["quad_arm", "lift_arm"])
def test_all_links_are_where_the_robots_kinematics_have_them(name: str) -> None:
    robot, rng, count = load_robot(name), np.random.default_rng(1), 20
    columns, links = list(robot.require_arm()), list(range(len(robot.links)))[::-1]
    joints = np.tile(robot.rest, (count, 1))
    joints[:, columns] = rng.uniform(robot.lower[columns], robot.upper[columns], (count, len(columns)))
    frames = robot.link_matrices(np.tile(IDENTITY_POSE, (count, 1)), joints)[:, links, :3]
    found = Arm(robot, "cpu", torch.float64).frames(torch.as_tensor(joints[:, columns]), links)
    np.testing.assert_allclose(found.numpy(), frames, atol=1e-9)


@pytest.mark.parametrize(
    "skill", ["pick", *(pytest.param(skill, marks=pytest.mark.slow) for skill in ("nav", "place"))]
)
def test_a_step_is_that_of_the_lower_layer(episode: RearrangeEpisode, skill: Skill) -> None:
    """Random commands, some of them beyond the limits: base, joints, grip and objects are where the CPU has them, and turned as
    there."""
    starts = starts_of(episode, skill)
    if skill == "pick":  # something to take without getting there first
        hand = play_of(episode, starts[0], {}).team.robots[0].hand_pose[:3]
        starts[0].objects[0] = hand + np.array([0.05, 0.0, 0.05])
    sim, now = worlds(episode, skill, starts)
    plays = [play_of(episode, start, {}) for start in starts]
    turns = [DecisionLoop(play) for play in plays]
    rng, gripped = np.random.default_rng(1), 0
    command = np.zeros((len(starts), 10))
    for step in range(STEPS):
        if step % 6 == 0:
            command = rng.uniform(-1.5, 1.5, (len(starts), 10))
            if skill == "nav":
                command[:, 2:] = 0
            if step == 0:  # the hand closes before anything moves
                command[:, :2], command[:, -1] = 0, 1.0
        going = now._replace(ended=torch.zeros_like(now.ended))  # the lower layer goes on whatever the skill has done
        now = sim.step(going, torch.as_tensor(command[:, : sim.action_width]))
        for w, (play, turn) in enumerate(zip(plays, turns, strict=True)):
            turn.answer(Action(CONTROL, command=tuple(command[w])))
            turn.go_on()
            robot = play.team.robots[0]
            np.testing.assert_allclose(now.robot.xz[w].numpy(), robot.xz, atol=1e-5)
            np.testing.assert_allclose(float(now.robot.heading[w]), robot.heading, atol=1e-5)
            np.testing.assert_allclose(now.joints[w].numpy(), robot.arm, atol=1e-5)
            np.testing.assert_allclose(now.objects[w].numpy(), play.team.objects.poses[:, :3], atol=1e-5)
            axes = quat_to_matrix(play.team.objects.poses[:, 3:])
            np.testing.assert_allclose(now.turned[w].numpy(), axes, atol=1e-5)
            assert int(now.held[w]) == play.team.objects.held(0)
            assert bool(now.robot.contact[w]) == bool(robot.state.contact[0])
            gripped += int(now.held[w]) >= 0
    assert gripped or skill == "nav"


def view_of(play: WorldRollout, start: SkillStart, before: tuple[Any, float]) -> SkillView:
    robot = play.team.robots[0]
    return SkillView(
        free=robot.free,
        xz=robot.xz,
        heading=robot.heading,
        before=before,
        point=start.point,
        stand_xz=start.stand_xz,
        hand=robot.hand_pose,
        resting=robot.resting_point,
        arm=robot.arm,
        holds=robot.objects.held(0) >= 0,
        beyond_m=robot.base.disc_radius_m / 2,
    )


def told(sim: SkillTensors, now: SkillPlay, **changes: Any) -> SkillPlay:
    """What the rules make of one step from ``now`` to ``now`` with some changes."""
    fine = now._replace(ended=torch.zeros_like(now.ended))
    return sim._judged(fine, fine._replace(**changes))


def test_picking_is_judged_as_the_rules_say(episode: RearrangeEpisode) -> None:
    rules = SkillSpec()
    sim, now = worlds(episode, "pick", starts_of(episode, "pick"))
    target, other = sim.bank.target[: len(now.held)], 1 - sim.bank.target[: len(now.held)]
    holds, wrong = torch.as_tensor(target), torch.as_tensor(other)
    nothing = torch.full_like(now.held, -1)
    there, out = torch.full_like(now.folded, 0.1), torch.full_like(now.folded, 0.4)
    taken = told(sim, now, held=holds, folded=there)
    assert taken.success.all()
    assert taken.terminated.all()
    torch.testing.assert_close(taken.reward, torch.full_like(out, rules.pick_success - rules.slack))
    assert not told(sim, now, held=holds, folded=out).terminated.any()
    mistaken = told(sim, now, held=wrong, folded=there)
    assert not mistaken.success.any()
    assert mistaken.terminated.all()
    dropped = told(sim, now._replace(held=holds, folded=out), held=nothing, folded=out)
    assert dropped.terminated.all()
    torch.testing.assert_close(dropped.reward, torch.full_like(out, -rules.lost - rules.slack))
    back = told(sim, now._replace(held=holds, folded=out), held=holds, folded=out - 0.1)
    torch.testing.assert_close(back.reward, torch.full_like(out, 0.1 - rules.slack))


def test_placing_is_judged_as_the_rules_say(episode: RearrangeEpisode) -> None:
    rules = SkillSpec()
    sim, now = worlds(episode, "place", starts_of(episode, "place"))
    nothing, out = torch.full_like(now.held, -1), torch.full_like(now.folded, 0.4)
    rows, target = torch.arange(len(now.held)), torch.as_tensor(sim.bank.target)
    at_goal = now.objects.clone()
    at_goal[rows, target] = torch.as_tensor(sim.bank.point)
    now = now._replace(folded=out)
    put = told(sim, now, held=nothing, objects=at_goal)
    assert not put.terminated.any()
    torch.testing.assert_close(put.reward, torch.full_like(out, rules.placed - rules.slack))
    again = told(sim, put, reward=put.reward)
    torch.testing.assert_close(again.reward, torch.full_like(out, -rules.slack))  # paid once
    done = told(sim, put._replace(folded=torch.full_like(out, 0.1)))
    assert done.success.all()
    lost = told(sim, now, held=nothing)
    assert lost.terminated.all()
    assert not lost.success.any()


def test_navigation_ends_near_the_target_and_facing_it(episode: RearrangeEpisode) -> None:
    sim, now = worlds(episode, "nav", starts_of(episode, "nav", 6))
    point = torch.as_tensor(sim.bank.point)[:, 0:3:2]
    gap = point - now.robot.xz
    towards = torch.atan2(-gap[:, 1], gap[:, 0])
    near = point - gap / gap.norm(dim=1, keepdim=True) * 1.2
    short = torch.full_like(now.way, 0.8)
    for turn, way, ends in ((0.9, short, True), (1.2, short, False), (0.0, short * 4, False)):
        robot = now.robot._replace(xz=near, heading=towards + turn)
        assert bool(told(sim, now, robot=robot, way=way).success.all()) is ends
        assert bool(told(sim, now, robot=robot, way=way).success.any()) is ends


def test_episodes_that_are_over_begin_anew(episode: RearrangeEpisode) -> None:
    starts = starts_of(episode, "pick")
    sim, now = worlds(episode, "pick", starts)
    still = torch.zeros(len(starts), sim.action_width, dtype=torch.float64)
    late = sim.step(now._replace(steps=torch.full_like(now.steps, SkillSpec().arm_steps - 1)), still)
    assert late.truncated.all()
    assert late.ended.all()
    fresh = sim.step(late, still + 1.0)
    assert (fresh.steps == 0).all()
    assert (fresh.episode == (now.episode + 1) % len(starts)).all()
    assert (fresh.reward == 0).all()
    np.testing.assert_allclose(fresh.robot.xz.numpy(), np.roll([s.xz for s in starts], -1, 0))


def test_starts_are_as_far_away_as_asked(episode: RearrangeEpisode) -> None:
    for skill, least, most in (("nav", 4.0, np.inf), ("pick", 3.0, 5.0), ("place", 3.0, 5.0)):
        found = draw_starts(episode, skill, 6, np.random.default_rng(0))  # type: ignore[arg-type]
        assert found
        for start in found:
            assert least <= float(episode.free.geodesic(start.xz, start.stand_xz)) <= most
            assert start.holds == (
                skill == "place" or not np.allclose(start.point, episode.targets[start.target].start[:3])
            )


def test_a_command_that_is_not_finite_counts_as_nothing(episode: RearrangeEpisode) -> None:
    sim, now = worlds(episode, "place", starts_of(episode, "place"))
    after = sim.step(now, torch.full((len(now.held), sim.action_width), torch.nan, dtype=torch.float64))
    np.testing.assert_array_equal(after.robot.xz.numpy(), now.robot.xz.numpy())
    np.testing.assert_array_equal(after.joints.numpy(), now.joints.numpy())
    assert (after.held == now.held).all()


def test_it_knows_its_observations(episode: RearrangeEpisode) -> None:
    sim, now = worlds(episode, "nav", starts_of(episode, "nav"))
    with pytest.raises(InputError, match=r"(?s)'humanoid_gps'.*H3-TRAIN-073"):
        sim.observations(("way", "humanoid_gps"), now)
    assert IDENTITY_POSE.shape == (7,)
