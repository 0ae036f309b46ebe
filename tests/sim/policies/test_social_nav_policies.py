"""Robot policies of social navigation: laws of their commands, and what they score on a few episodes."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from shapely.affinity import scale
from shapely.geometry import box

from h3data.errors import InputError
from h3data.geometry import wrap_angle
from h3data.metrics import measure
from h3data.scene import FreeSpace, Scene
from h3data.scene.freespace.build import build_from_walkable
from h3data_homes import HomeSpec, build_home
from sim_kinematic.avoidance.rollouts import roll_out, roll_out_to, straight_walk
from sim_kinematic.avoidance.spec import AVOIDANCE
from sim_kinematic.motion.spec import STEP_S, BaseSpec, SocialNavSpec
from sim_kinematic.motion.state import RobotState
from sim_kinematic.motion.step import drive_robots, least_clearance
from sim_kinematic.policies.social_nav import POLICIES, ROBOT_SKILLS, Policy, future_oracle, rollout_expert
from sim_kinematic.policies.views import SocialNavView
from sim_kinematic.tasks.social_nav import plan_of
from tests.simulated import simulate_social_nav, social_nav_episode

SPEC = BaseSpec()
MIRROR = np.array([1.0, -1.0])
"""z to -z: left and right change places."""


@pytest.fixture(scope="module")
def home() -> Scene:
    return build_home(HomeSpec(preset="small", seed=1))


@pytest.fixture(scope="module")
def free(home: Scene) -> FreeSpace:
    return FreeSpace.from_scene(home, radius_m=0.25, cache=False)


def places(free: FreeSpace, count: int) -> list[tuple[np.ndarray, float]]:
    """Free poses of a base."""
    rng, found = np.random.default_rng(3), []
    while len(found) < count:
        xz, heading = free.sample(rng, 1)[0], float(rng.uniform(-4, 4))
        if least_clearance(free.sdf, free.origin, free.cell_m, *xz, heading, np.array(SPEC.disc_offsets_m)) >= 0.25:
            found.append((xz, heading))
    return found


def views(free: FreeSpace, count: int) -> list[SocialNavView]:
    """Robots anywhere, most of them near the person, who stands or walks."""
    rng, found = np.random.default_rng(8), []
    for k, (xz, heading) in enumerate(places(free, count)):
        human = free.snap(xz + rng.normal(size=2) * (1.0 if k % 3 else 4.0))
        velocity = rng.normal(size=2) * (1.5 if k % 2 else 0.0)
        future = partial(free.snap, human + velocity * (np.arange(1, 200)[:, None] * STEP_S))
        found.append(
            SocialNavView(
                free,
                xz,
                heading,
                human,
                float(free.geodesic(xz, human)),
                bool(k % 4),
                5,
                k,
                None,
                human - velocity * STEP_S,
                future,
            )
        )
    return found


@pytest.mark.parametrize("policy", POLICIES.values(), ids=POLICIES)
def test_commands_are_in_range_and_the_same_again(policy: Policy, free: FreeSpace) -> None:
    for view in views(free, 60):
        command = policy(view, SPEC)
        assert -1 <= command.forward <= 1
        assert -1 <= command.turn <= 1
        assert command.skill in ROBOT_SKILLS
        assert policy(view._replace(robot_xz=view.robot_xz.copy()), SPEC) == command


@pytest.mark.parametrize("policy", [rollout_expert, POLICIES["sampling_expert"], future_oracle])
def test_experts_wait_where_there_is_no_way(policy: Policy, free: FreeSpace) -> None:
    for met in (False, True):
        view = views(free, 1)[0]._replace(geodesic_m=np.inf, met=met)
        assert policy(view, SPEC) == (0.0, 0.0, "wait")


def test_a_mirrored_world_has_mirrored_commands() -> None:
    """z to -z: the same speed, the opposite turn."""
    room = box(-4, -3, 4, 3) - box(-1, 0, 0.5, 1) - box(2, -3, 2.5, -1)
    free, mirrored = (
        FreeSpace.from_map(build_from_walkable(r, radius_m=0.25, height_m=1.41, max_climb_m=0.2, cell_m=0.05))
        for r in (room, scale(room, 1, -1, origin=(0, 0)))
    )
    for k, view in enumerate(views(free, 60)):
        assert view.human_before is not None
        other = view._replace(
            free=mirrored,
            robot_xz=view.robot_xz * MIRROR,
            robot_heading=-view.robot_heading,
            human_xz=view.human_xz * MIRROR,
            human_before=view.human_before * MIRROR,
        )
        one, two = rollout_expert(view, SPEC), rollout_expert(other, SPEC)
        assert one.skill == two.skill
        assert one[:2] == pytest.approx((two.forward, -two.turn), abs=1e-6), k


def test_trials_are_the_motion_of_the_simulator(free: FreeSpace) -> None:
    rng = np.random.default_rng(4)
    for xz, heading in places(free, 20):
        commands = np.concatenate(
            [rng.uniform(-1, 1, (5, 2)), [[4], [0], [9], [30], [17]], rng.uniform(-1, 1, (5, 1))], 1
        )
        ends = roll_out(free, SPEC, xz, heading, commands, np.full((30, 2), 99.0), look_steps=25)
        for n, (forward, turn, steps, then) in enumerate(commands):
            robot = RobotState.zeros(1)
            robot.xz[0], robot.heading[0] = xz, heading
            for step in range(25):
                action = [[forward, turn]] if step < steps else [[then, 0.0]]
                drive_robots(robot, free, np.array(action), SPEC)
            np.testing.assert_allclose(ends.xz[n], robot.xz[0], atol=1e-12)
            assert ends.heading[n] == pytest.approx(robot.heading[0])


def test_searches_are_left_out_only_where_another_trial_is_better(free: FreeSpace) -> None:
    rng, left_out = np.random.default_rng(5), 0
    goals = [*free.sample(rng, 29), np.array([99.0, 99.0])]
    for (xz, heading), goal in zip(places(free, 30), goals, strict=True):
        commands = np.concatenate([rng.uniform(-1, 1, (20, 2)), rng.integers(0, 9, (20, 1)), np.ones((20, 1))], 1)
        ends = roll_out(free, SPEC, xz, heading, commands, look_steps=8)
        wanted, direction = free.distance_field(goal).distance_and_direction(ends.xz)
        turned = np.abs(wrap_angle(np.arctan2(-direction[:, 1], direction[:, 0]) - ends.heading))
        left, off = roll_out_to(free, SPEC, xz, heading, commands, goal, look_steps=8, turn_cost_m=0.5)
        found = np.isfinite(left)
        assert np.isfinite(off).all()
        np.testing.assert_array_equal(left[found], wanted[found])
        np.testing.assert_array_equal(off[found], turned[found])
        if found.any():
            assert np.argmin(left + 0.5 * off) == np.argmin(wanted + 0.5 * turned)
        else:
            assert np.isinf(wanted).all()
        left_out += int(np.isfinite(wanted[~found]).sum())
    assert left_out > 0


def test_who_walks_stops_at_the_wall(free: FreeSpace) -> None:
    rng = np.random.default_rng(6)
    for xz in free.sample(rng, 30):
        velocity = rng.normal(size=2) * 3
        walk = straight_walk(free, xz, velocity, 60)
        assert (free.signed_distance(walk) >= 0.25 - 0.031).all()
        turned = np.abs(wrap_angle(np.arctan2(*(walk - xz).T) - np.arctan2(*velocity)))
        assert (turned[np.hypot(*(walk - xz).T) > 1e-6] < 1e-6).all()
        assert (straight_walk(free, xz, np.zeros(2), 9) == xz).all()
        straight = xz + velocity * (np.arange(1, 61)[:, None] * STEP_S)
        blocked = np.flatnonzero(free.signed_distance(straight) < free.radius_m - AVOIDANCE.wall_m)
        if len(blocked):
            straight[blocked[0] :] = straight[blocked[0] - 1] if blocked[0] else xz
        np.testing.assert_array_equal(walk, straight)


@pytest.mark.slow
def test_she_comes_and_the_expert_gives_way(free: FreeSpace) -> None:
    """The only difference is what the person did in the last step: then it backs away at full speed."""
    rng = np.random.default_rng(5)
    while True:
        xz, human = free.sample(rng, 2)
        apart = float(np.hypot(*(human - xz)))
        if 1.4 < apart < 1.49 and free.geodesic(xz, human) < apart + 1e-6 and free.clearance(2 * xz - human) > 0.6:
            break
    heading = float(np.arctan2(-(human - xz)[1], (human - xz)[0]))
    still = SocialNavView(free, xz, heading, human, apart, True, human_before=human)
    comes = still._replace(human_before=human + (human - xz) / apart * 2.5 * STEP_S)
    assert -1 < rollout_expert(still, SPEC).forward < 0
    assert rollout_expert(comes, SPEC).forward == -1


@pytest.mark.parametrize("speed_mps", [0.6, 1.3, 2.2])
@pytest.mark.parametrize("aside_m", [0.0, 0.3])
def test_who_walks_at_the_expert_makes_it_go_back_not_back_and_forth(speed_mps: float, aside_m: float) -> None:
    free = FreeSpace.from_map(
        build_from_walkable(box(-5, -2, 5, 2), radius_m=0.25, height_m=1.41, max_climb_m=0.2, cell_m=0.05)
    )
    robot, human, forward = RobotState.zeros(1), np.array([-4.0, aside_m]), []
    robot.xz[0], robot.heading[0] = (-2.2, 0.0), np.pi
    while human[0] < -0.5:
        before, human = human, human + np.array([speed_mps * STEP_S, 0.0])
        apart = float(free.geodesic(robot.xz[0], human))
        command = rollout_expert(
            SocialNavView(free, robot.xz[0], robot.heading.item(0), human, apart, True, human_before=before), SPEC
        )
        drive_robots(robot, free, np.array([command[:2]]), SPEC)
        assert apart > 1.4
        forward.append(command.forward)
    signs = np.sign(np.array(forward)[np.abs(forward) > 1e-3])
    assert (np.diff(signs) != 0).sum() <= 3  # without heeding their last step: up to 172
    if not aside_m:  # beside, it turns
        assert np.mean(forward[-15:]) * SPEC.max_speed_mps == pytest.approx(-speed_mps, rel=0.15)


def test_only_the_oracle_needs_the_future(free: FreeSpace) -> None:
    view = views(free, 2)[1]._replace(future=None)
    with pytest.raises(InputError, match="H3-POLICY-062"):
        future_oracle(view, SPEC)

    def peeked() -> np.ndarray:
        raise AssertionError("Nobody else may look.")

    for name, policy in POLICIES.items():
        if name != "future_oracle":
            policy(view._replace(future=peeked), SPEC)


def test_the_foreseen_track_is_the_track(home: Scene, free: FreeSpace) -> None:
    world = social_nav_episode(home, seed=3, spec=SocialNavSpec(max_steps=40), free=free)
    seen = {}

    def watcher(view: SocialNavView, spec: BaseSpec) -> object:
        assert view.future is not None
        seen[view.step] = (view.human_xz, view.future()[0], view.human_before)
        return rollout_expert(view, spec)

    simulate_social_nav(world, policy=watcher)  # type: ignore[arg-type]
    np.testing.assert_array_equal([seen[k + 1][0] for k in range(39)], [seen[k][1] for k in range(39)])
    np.testing.assert_array_equal([seen[k + 1][2] for k in range(39)], [seen[k][0] for k in range(39)])
    np.testing.assert_array_equal([seen[k][1] for k in range(40)], plan_of(world).xz)


@pytest.mark.parametrize(
    "policy",
    ["rollout_expert", *(pytest.param(name, marks=pytest.mark.slow) for name in ("sampling_expert", "future_oracle"))],
)
def test_experts_find_follow_and_keep_clear(policy: str, home: Scene, free: FreeSpace) -> None:
    spec = SocialNavSpec(max_steps=400)
    worlds = [social_nav_episode(home, seed=seed, spec=spec, free=free) for seed in range(2)]
    values = [measure(simulate_social_nav(world, policy=policy)).values for world in worlds]
    mean = {name: float(np.mean([v[name] for v in values])) for name in ("S", "SPS", "F", "CR")}
    assert mean["S"] == 1
    assert mean["SPS"] > 0.75
    assert mean["F"] > 0.6
    assert mean["CR"] <= 0.25
