"""``slide="habitat"`` against recorded steps of Habitat's own base action, from each recorded pose and running freely."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from h3data.errors import InputError
from h3data.scene import FreeSpace
from h3data_habitat.navmesh.file import read_navmesh
from h3data_habitat.navmesh.navmesh import free_space_from_navmesh
from h3data_habitat.navmesh.pathfinder import PathFinder
from h3data_homes import HomeSpec, build_home
from sim_kinematic.motion.spec import STEP_S, BaseSpec, HabitatSlideSpec
from sim_kinematic.motion.state import RobotState
from sim_kinematic.motion.step import drive_robots
from tests.paths import REAL

GOLDEN = REAL / "habitat-lab" / "reference"
UNITS = 120 * STEP_S  # Habitat integrates 1/120 s per step: its 10 units are 2.5 m/s
FREE_TOL_M = 2e-6
"""Habitat counts in float32."""
RUN_TOL_M = 5e-5
"""The same after 300 steps."""
FILES = sorted((GOLDEN / "basemotion").glob("*.npz"))
SLIPS, FIRST_SLIP = "21_disc3_slide_simnoslide.npz", 148
"""Where discs stop at the first wall, rounding sometimes makes Habitat miss a slanting wall that a disc starts on, and it
slides on: 16 steps of this file."""
needs_real = pytest.mark.skipif(not FILES, reason="needs the real Habitat files in ../shared/real")


@pytest.fixture(scope="module")
def floor() -> tuple[FreeSpace, PathFinder]:
    navmesh = read_navmesh(GOLDEN / "navmesh" / "flat.navmesh")
    return free_space_from_navmesh(navmesh), PathFinder(navmesh)


def spec_of(data: dict[str, Any]) -> BaseSpec:
    return BaseSpec(
        slide="habitat",
        max_speed_mps=data["longitudinal_lin_speed"] / UNITS,
        max_turn_rad_s=data["ang_speed"] / UNITS,
        max_lateral_mps=data["lateral_lin_speed"] / UNITS if data["enable_lateral_move"] else 0.0,
        allow_back=data["allow_back"],
        disc_offsets_m=tuple(data["navmesh_offsets"][:, 0]),
        contact_tolerance_m=data["collision_threshold"],
        habitat=HabitatSlideSpec(
            root_height_m=0.48,
            slides=data["allow_dyn_slide"],
            slides_while_turning=not data["enable_rotation_check_for_dyn_slide"],
            navmesh_slides=data["sim_allow_sliding"],
        ),
    )


def load(file: Path) -> tuple[BaseSpec, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rules, actions [300, 2 or 3] in our order, places [301, 2], headings [301], contacts [300]."""
    data = {name: array if array.ndim else array.item() for name, array in np.load(file).items()}
    transform = data["sim_obj_T"].astype(np.float64)
    actions = data["actions"] if data["actions"].shape[1] == 2 else data["actions"][:, [0, 2, 1]]
    heading = np.unwrap(np.arctan2(-transform[:, 2, 0], transform[:, 0, 0]))
    return spec_of(data), actions, transform[:, [0, 2], 3], heading, data["collided"]


def at(xz: np.ndarray, heading: np.ndarray) -> RobotState:
    state = RobotState.zeros(len(heading))
    state.xz[:], state.heading[:] = xz, heading
    return state


def test_all_recorded_sequences_are_here(real: Path) -> None:
    assert len(FILES) == 25, real


@needs_real
@pytest.mark.parametrize("file", FILES, ids=lambda f: f.stem)
def test_every_step_from_its_recorded_pose(file: Path, floor: tuple[FreeSpace, PathFinder]) -> None:
    free, finder = floor
    spec, actions, xz, heading, collided = load(file)
    state = at(xz[:-1], heading[:-1])  # 300 worlds, one for each step
    drive_robots(state, free, actions, spec, finder=finder)
    off = np.hypot(*(state.xz - xz[1:]).T)
    wrong = (state.contact != collided) | (off > FREE_TOL_M)
    if file.name == SLIPS:  # we are stopped by that wall
        assert wrong.sum() <= 16
        assert state.contact[wrong].all()
        assert (state.contact != collided).sum() <= 2
    else:
        assert not wrong.any(), np.flatnonzero(wrong)
    turned = np.abs(state.heading - heading[1:])
    assert turned[~wrong].max() < FREE_TOL_M


@needs_real
@pytest.mark.parametrize("file", FILES, ids=lambda f: f.stem)
def test_a_whole_run_from_the_first_pose(file: Path, floor: tuple[FreeSpace, PathFinder]) -> None:
    free, finder = floor
    spec, actions, xz, heading, collided = load(file)
    state = at(xz[:1], heading[:1])
    steps = FIRST_SLIP if file.name == SLIPS else len(actions)
    for k in range(steps):
        drive_robots(state, free, actions[k : k + 1], spec, finder=finder)
        assert np.hypot(*(state.xz[0] - xz[k + 1])) < RUN_TOL_M, k
        assert state.contact[0] == collided[k], k


@needs_real
def test_the_real_robot_touches_walls_in_these_sequences() -> None:
    assert sum(int(load(file)[-1].sum()) for file in FILES) > 2000


@pytest.fixture(scope="module")
def home() -> FreeSpace:
    return FreeSpace.from_scene(build_home(HomeSpec(preset="small", seed=5)))


def random_drive(free: FreeSpace, spec: BaseSpec, worlds: int, steps: int) -> tuple[RobotState, float]:
    """The last state, and the least clearance of the middle disc on the way [m]."""
    rng = np.random.default_rng(3)
    state = at(free.sample(rng, worlds), rng.uniform(-3, 3, worlds))
    least = np.inf
    for _ in range(steps):
        drive_robots(state, free, np.stack([rng.choice([1.0, 0.7], worlds), rng.uniform(-1, 1, worlds)], -1), spec)
        least = min(least, float(free.clearance(state.xz).min()))
    return state, least


def test_in_the_open_both_modes_are_the_same_formula(home: FreeSpace) -> None:
    rng = np.random.default_rng(0)
    starts = home.sample(rng, 1500)
    starts = starts[home.clearance(starts) > 0.4]
    heading, action = rng.uniform(-3, 3, len(starts)), rng.uniform(-1.2, 1.2, (len(starts), 3))
    states = [at(starts, heading), at(starts, heading)]
    for state, slide in zip(states, ("strict", "habitat"), strict=True):
        drive_robots(state, home, action, BaseSpec(slide=slide, max_lateral_mps=1.0))
        assert not state.contact.any()
    assert len(starts) > 20
    np.testing.assert_array_equal(states[0].xz, states[1].xz)
    np.testing.assert_array_equal(states[0].heading, states[1].heading)


def test_only_strict_sliding_keeps_clear(home: FreeSpace) -> None:
    three = (0.0, 0.25, -0.25)
    _, strict = random_drive(home, BaseSpec(disc_offsets_m=three), 30, 300)
    _, habitat = random_drive(home, BaseSpec(disc_offsets_m=three, slide="habitat"), 30, 300)
    assert habitat < strict


def test_unknown_slides_are_refused(home: FreeSpace) -> None:
    with pytest.raises(InputError, match=r"(?s)strict, habitat.*H3-SIM-036"):
        drive_robots(RobotState.zeros(1), home, np.zeros((1, 2)), BaseSpec(slide="bullet"))  # type: ignore[arg-type]
