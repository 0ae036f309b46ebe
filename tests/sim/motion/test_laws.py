"""Laws of stepping under random actions: nothing breaks, nothing is entered, one world is the same as many."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from h3data.bodies import load_robot
from h3data.errors import InputError
from h3data.scene import Cylinder, FreeSpace, Scene
from h3data_homes import HomeSpec, build_home
from sim_kinematic.agents.manipulation import grip_objects, move_arms, robot_hands
from sim_kinematic.contact import FclScene, MovingShapes, collide
from sim_kinematic.motion.spec import HOME_BASE, STEP_S, ArmSpec, BaseSpec
from sim_kinematic.motion.state import WorldState
from sim_kinematic.motion.step import are_clear, drive_robots, least_clearance

DEEPEST_M = 2e-3
ARM = ArmSpec()


@lru_cache(maxsize=2)
def floor(seed: int) -> tuple[Scene, FreeSpace]:
    home = build_home(HomeSpec(preset="small", seed=seed))
    return home, FreeSpace.from_scene(home)


@st.composite
def base_specs(draw: st.DrawFn, slides: tuple[str, ...] = ("strict", "habitat")) -> BaseSpec:
    return BaseSpec(
        slide=draw(st.sampled_from(slides)),  # type: ignore[arg-type]
        disc_offsets_m=draw(st.sampled_from([(0.0,), (0.0, 0.225), (0.0, 0.25, -0.25), HOME_BASE.disc_offsets_m])),
        max_speed_mps=draw(st.floats(0.1, 2.5)),
        max_turn_rad_s=draw(st.floats(0.1, 2.5)),
        max_lateral_mps=draw(st.sampled_from([0.0, 1.0])),
        allow_back=draw(st.booleans()),
        keeps_speed=draw(st.booleans()),
    )


def started(free: FreeSpace, spec: BaseSpec, worlds: int, rng: np.random.Generator) -> WorldState:
    """Robots at random where their discs are free, one object near each hand."""
    robot = load_robot("quad_arm")
    state = WorldState.zeros(worlds, joints=len(robot.joint_names), objects=2)
    state.robots[0].joints[:] = robot.rest
    offsets = np.array(spec.disc_offsets_m)
    for w in range(worlds):
        while True:
            (xz,), heading = free.sample(rng, 1), rng.uniform(-np.pi, np.pi)
            clear = least_clearance(free.sdf, free.origin, free.cell_m, xz[0], xz[1], heading, offsets)
            if clear >= spec.disc_radius_m:
                break
        state.robots[0].xz[w], state.robots[0].heading[w] = xz, heading
    state.object_pose[:, 0, :3] = robot_hands(state.robots[0], robot)[:, :3, 3] + rng.normal(0, 0.05, (worlds, 3))
    return state


def act(state: WorldState, free: FreeSpace, spec: BaseSpec, actions: np.ndarray) -> None:
    """One step of everything: actions [W, 11] hold base, arm and grip."""
    robot = load_robot("quad_arm")
    drive_robots(state.robots[0], free, actions[:, : 3 if spec.max_lateral_mps else 2], spec)
    move_arms(state.robots[0], robot, actions[:, 3:10], ARM)
    grip_objects(state, robot_hands(state.robots[0], robot), actions[:, 10], ARM)


def digest(state: WorldState) -> list[bytes]:
    return [array.tobytes() for array in state.arrays()]


@settings(max_examples=4)
@given(base_specs(), st.integers(1, 2), st.integers(0, 2**32 - 1))
def test_one_world_is_as_many_and_nothing_breaks(spec: BaseSpec, home: int, seed: int) -> None:
    _, free = floor(home)
    many = started(free, spec, 64, np.random.default_rng(seed))
    again = many.copy()
    singles = {w: many.take([w]) for w in (0, 17, 63)}
    rng = np.random.default_rng(seed)
    robot = load_robot("quad_arm")
    for _ in range(40):
        actions = rng.uniform(-1.5, 1.5, (64, 11))
        for state in (many, again):
            act(state, free, spec, actions)
        for w, single in singles.items():
            act(single, free, spec, actions[w : w + 1])
    assert digest(many) == digest(again)
    for w, single in singles.items():
        assert digest(single) == digest(many.take([w])), w
    assert all(np.isfinite(array).all() for array in many.arrays())
    assert (many.robots[0].joints >= robot.lower).all()
    assert (many.robots[0].joints <= robot.upper).all()


@settings(max_examples=6)
@given(base_specs(("strict",)), st.integers(1, 2), st.integers(0, 2**32 - 1))
def test_strict_bases_enter_nothing(spec: BaseSpec, home: int, seed: int) -> None:
    """By the distance grid to its tolerance; by FCL, a disc 2 mm smaller touches nothing (its depths are too great)."""
    scene, free = floor(home)
    rng = np.random.default_rng(seed)
    state = started(free, spec, 40, rng)
    offsets = np.array(spec.disc_offsets_m)
    low, high = 0.21, 1.41  # above what a robot climbs
    scenery = FclScene(scene)
    upright = np.array([0, 0, 0, 0, 0, 0, 1.0])
    disc = MovingShapes([Cylinder(pose=upright, radius=spec.disc_radius_m - DEEPEST_M, half_height=(high - low) / 2)])
    for k in range(60):
        actions = rng.uniform(-1, 1, (40, 11))
        actions[:, 0] = rng.choice([1.0, -1.0, 0.4], 40)
        act(state, free, spec, actions)
        ahead = np.stack([np.cos(state.robots[0].heading), -np.sin(state.robots[0].heading)], -1)
        centres = (state.robots[0].xz[:, None] + offsets[:, None] * ahead[:, None]).reshape(-1, 2)
        clear = free.clearance(centres)
        assert clear.min() >= -spec.clearance_tolerance_m - 1e-9
        for x, z in centres[clear < 1e-3] if k % 10 == 9 else ():
            disc.set_transforms(np.array([[[1, 0, 0, x], [0, 1, 0, (low + high) / 2], [0, 0, 1, z], [0, 0, 0, 1.0]]]))
            assert not collide(scenery, disc)


@settings(max_examples=10)
@given(base_specs(("strict",)), st.integers(1, 2), st.integers(0, 2**32 - 1))
def test_obstacles_push_no_base_beyond_its_speed_limit(spec: BaseSpec, home: int, seed: int) -> None:
    _, free = floor(home)
    rng = np.random.default_rng(seed)
    spec = replace(spec, keeps_speed=True)
    state = started(free, spec, 40, rng)
    most = np.hypot(spec.max_speed_mps, spec.max_lateral_mps) * STEP_S
    for _ in range(60):
        before = state.robots[0].xz.copy()
        act(state, free, spec, rng.uniform(-1.5, 1.5, (40, 11)))
        assert np.hypot(*(state.robots[0].xz - before).T).max() <= most + 1e-9


@settings(max_examples=20)
@given(base_specs(("strict",)), st.integers(1, 2), st.integers(0, 2**32 - 1), st.floats(0.1, 0.6))
def test_both_questions_of_clearance_agree(spec: BaseSpec, home: int, seed: int, radius: float) -> None:
    _, free = floor(home)
    rng, offsets = np.random.default_rng(seed), np.array(spec.disc_offsets_m)
    for (x, z), heading in zip(free.sample(rng, 300), rng.uniform(-np.pi, np.pi, 300), strict=True):
        where = free.sdf, free.origin, free.cell_m, x, z
        asked = are_clear(*where, np.cos(heading), np.sin(heading), offsets, radius)
        assert asked == (least_clearance(*where, heading, offsets) >= radius)


@pytest.mark.parametrize("slide", ["strict", "habitat"])
def test_nan_in_one_world_moves_none(slide: str) -> None:
    _, free = floor(1)
    spec = BaseSpec(slide=slide)  # type: ignore[arg-type]
    state = started(free, spec, 3, np.random.default_rng(0))
    before = digest(state)
    actions = np.ones((3, 2))
    actions[2, 1] = np.nan
    with pytest.raises(InputError, match=r"(?s)2.*H3-SIM-034"):
        drive_robots(state.robots[0], free, actions, spec)
    assert digest(state) == before
