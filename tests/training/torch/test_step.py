"""The step as tensors: the numbers of the numba kernels, on the CPU and, with the marker ``gpu``, on a GPU."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

torch = pytest.importorskip("torch")

from benchmarks.sim_torch import BoxFloor, Stepper  # noqa: E402
from h3data.errors import InputError  # noqa: E402
from h3data_training.torch.graph import captured  # noqa: E402
from h3data_training.torch.random import bits, keys, random  # noqa: E402
from h3data_training.torch.state import HumanTensors, RobotTensors  # noqa: E402
from h3data_training.torch.step import Grids, drive_robots, sample_sdf, walk_humans, wrap_angle  # noqa: E402
from sim_kinematic.motion.randomness import generator  # noqa: E402
from sim_kinematic.motion.spec import BaseSpec, WalkerSpec  # noqa: E402
from sim_kinematic.motion.state import HumanState, RobotState  # noqa: E402

FLOOR = BoxFloor.draw()
SIDEWAYS = BaseSpec(max_lateral_mps=1.0, allow_back=False, disc_offsets_m=(-0.2, 0.0, 0.25), slide_iterations=3)
on_gpu = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no GPU")]


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with torch.no_grad():
        yield
    torch.set_num_threads(threads)


def doubles(array: Any) -> Any:
    return torch.tensor(array, dtype=torch.float64)


def home(preset: Any) -> Any:
    from h3data.scene import FreeSpace
    from h3data_homes import HomeSpec, build_home

    return FreeSpace.from_scene(build_home(HomeSpec(preset=preset, seed=1)))


# --- against the kernels ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("preset", "spec", "steps"),
    [
        ("small", BaseSpec(), 150),
        pytest.param("medium", BaseSpec(), 1000, marks=pytest.mark.slow),
        ("small", SIDEWAYS, 200),
    ],
)
def test_steps_of_64_worlds_are_those_of_the_kernels(preset: str, spec: BaseSpec, steps: int) -> None:
    from sim_kinematic.motion import gait
    from sim_kinematic.motion import step as kernels

    free, worlds, rng, walker = home(preset), 64, np.random.default_rng(0), WalkerSpec()
    robot, human = RobotState.zeros(worlds), HumanState.zeros(worlds)
    robot.xz[:], human.xz[:] = free.sample(rng, worlds), free.sample(rng, worlds)
    grids = Grids.of([free], "cpu", torch.float64)
    robots, people = RobotTensors.of(robot, "cpu", torch.float64), HumanTensors.of(human, "cpu", torch.float64)
    again, touched = RobotState.zeros(worlds), 0
    actions = rng.uniform(-1.2, 1.2, (100, worlds, 3 if spec.max_lateral_mps else 2))
    actions[::7] = 0
    goals = [free.sample(rng, worlds) for _ in range(34)]
    for k in range(steps):
        kernels.drive_robots(robot, free, actions[k // 10], spec)
        gait.walk_humans(human, goals[k // 30], walker)
        robots = drive_robots(grids, robots, doubles(actions[k // 10]), spec)
        people = walk_humans(people, doubles(goals[k // 30]), walker)
        robots.put(again)
        np.testing.assert_array_equal(again.contact, robot.contact)
        np.testing.assert_allclose(again.xz, robot.xz, rtol=0, atol=1e-5)
        np.testing.assert_allclose(again.heading, robot.heading, rtol=0, atol=1e-5)
        touched += robot.contact.sum()
    assert touched > steps
    walked = HumanState.zeros(worlds)
    people.put(walked)
    for mine, theirs in zip(walked.arrays(), human.arrays(), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-5)


places = st.tuples(st.floats(-3, 15), st.floats(-3, 13))
commands = st.tuples(st.floats(-2, 2), st.floats(-2, 2))


@given(places, st.floats(-100, 100), commands)
def test_odd_places_give_the_step_of_the_kernel(place: Any, heading: float, action: Any) -> None:
    from sim_kinematic.motion import step as kernels

    robot = RobotState.zeros(1)
    robot.xz[:], robot.heading[:] = place, heading
    moved = drive_robots(
        Grids.of([FLOOR], "cpu", torch.float64),
        RobotTensors.of(robot, "cpu", torch.float64),
        doubles([action]),
        BaseSpec(),
    )
    kernels.drive_robots(robot, FLOOR, np.array([action]), BaseSpec())  # type: ignore[arg-type]
    np.testing.assert_allclose(moved.xz, robot.xz, rtol=0, atol=1e-6)
    np.testing.assert_allclose(moved.heading, robot.heading, rtol=0, atol=1e-6)
    assert moved.contact.tolist() == robot.contact.tolist()


@given(places, places, st.floats(-100, 100), st.floats(0, 1))
def test_odd_ways_give_the_walk_of_the_kernel(place: Any, goal: Any, heading: float, blend: float) -> None:
    from sim_kinematic.motion import gait

    human = HumanState.zeros(1)
    human.xz[:], human.heading[:], human.blend[:], human.distance[:] = place, heading, blend, 3.0
    walked = walk_humans(HumanTensors.of(human, "cpu", torch.float64), doubles([goal]), WalkerSpec())
    gait.walk_humans(human, np.array([goal]), WalkerSpec())
    for tensor, array in ((tensor, getattr(human, name)) for name, tensor in walked._asdict().items()):
        np.testing.assert_allclose(tensor, array, rtol=0, atol=1e-9)


@given(st.lists(places, min_size=1, max_size=20))
def test_distances_are_those_of_the_grid(points: list[tuple[float, float]]) -> None:
    from h3data.scene.freespace.free_space import sample_sdf as sample
    from h3data.scene.freespace.free_space import sdf_gradient

    seen = sample_sdf(Grids.of([FLOOR], "cpu", torch.float64), doubles(points))
    for k, point in enumerate(points):
        assert abs(seen.distance[k].item() - sample(FLOOR.sdf, FLOOR.origin, FLOOR.cell_m, *point)) < 1e-9
        slope = np.array(sdf_gradient(FLOOR.sdf, FLOOR.origin, FLOOR.cell_m, *point)) * FLOOR.cell_m
        np.testing.assert_allclose(seen.slope[k], slope, rtol=0, atol=1e-7)  # the kernel subtracts in float32


# --- laws ---------------------------------------------------------------------------------------------------------------
def test_worlds_on_several_floors_are_each_as_alone() -> None:
    other = BoxFloor.draw(seed=1)
    finer = BoxFloor(np.kron(other.sdf, np.ones((2, 2), np.float32)), other.origin, other.cell_m / 2)
    floors, place = [FLOOR, finer], torch.tensor([0, 1, 1, 0, 1])
    grids = Grids.of(floors, "cpu", torch.float64)
    assert grids.at(place).cell.tolist() == [0.05, 0.025, 0.025, 0.05, 0.025]
    rng = np.random.default_rng(0)
    robot = RobotTensors(
        doubles(rng.uniform(0, 10, (5, 2))), doubles(rng.uniform(-3, 3, 5)), torch.zeros(5, dtype=torch.bool)
    )
    action = doubles(rng.uniform(-1, 1, (5, 2)))
    together = drive_robots(grids.at(place), robot, action, BaseSpec())
    for w in range(5):
        alone = RobotTensors(*(t[w : w + 1] for t in robot))
        one = drive_robots(Grids.of([floors[place[w]]], "cpu", torch.float64), alone, action[w : w + 1], BaseSpec())
        for a, b in zip(one, together, strict=True):
            assert torch.equal(a[0], b[w])


def test_what_is_not_finite_counts_as_nothing() -> None:
    grids = Grids.of([FLOOR], "cpu", torch.float64)
    robot = RobotTensors(doubles([[2.0, 2.0]] * 3), doubles([0.3] * 3), torch.zeros(3, dtype=torch.bool))
    odd = drive_robots(grids, robot, doubles([[np.nan, 0.5], [np.inf, 0.5], [0.0, 0.5]]), BaseSpec())
    assert torch.equal(odd.xz, robot.xz)
    assert odd.heading.unique().numel() == 1


def test_a_slide_that_tensors_do_not_know_is_refused() -> None:
    robot = RobotTensors(doubles([[2.0, 2.0]]), doubles([0.0]), torch.zeros(1, dtype=torch.bool))
    with pytest.raises(InputError, match=r"(?s)habitat.*H3-TRAIN-077"):
        drive_robots(Grids.of([FLOOR], "cpu", torch.float64), robot, doubles([[1, 0]]), BaseSpec(slide="habitat"))


def test_wrapped_angles() -> None:
    angles = doubles([0.0, np.pi, -np.pi, 7.0, -20.0])
    assert ((wrap_angle(angles) >= -np.pi) & (wrap_angle(angles) < np.pi)).all()
    np.testing.assert_allclose(wrap_angle(angles).sin(), angles.sin(), atol=1e-12)


def test_float32_gives_the_same_step() -> None:
    stepper = Stepper(FLOOR, 2000, "cpu", torch.float64)
    exact = drive_robots(stepper.grids, stepper.robot, stepper.action, stepper.spec.robot)
    single = RobotTensors(stepper.robot.xz.float(), stepper.robot.heading.float(), stepper.robot.contact)
    rough = drive_robots(Grids.of([FLOOR], "cpu", torch.float32), single, stepper.action.float(), stepper.spec.robot)
    assert ((rough.xz - exact.xz).abs().amax(1) < 1e-5).double().mean() > 0.999  # a tie may go the other way


def test_the_step_needs_no_heavy_packages() -> None:
    code = (
        "import sys, benchmarks.sim_torch, h3data_training.torch.step, h3data_training.torch.graph; "
        "print({'shapely', 'fcl', 'trimesh', 'numba', 'scipy', 'gymnasium', 'cv2'} & set(sys.modules))"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "set()"


def test_the_benchmark_leaves_nobody_in_a_wall() -> None:
    stepper = Stepper(FLOOR, 200, "cpu", torch.float64)
    before = stepper.robot.xz.clone()
    for _ in range(60):
        stepper.step()
    assert (stepper.robot.xz - before).norm(dim=1).mean() > 0.2
    spec = stepper.spec.robot
    nearest = min(map(abs, spec.disc_offsets_m))  # of the discs to the root
    room = sample_sdf(stepper.grids, stepper.robot.xz).distance.min()
    assert room >= spec.disc_radius_m - spec.clearance_tolerance_m - nearest
    assert stepper.robot.contact.any()


# --- random numbers -----------------------------------------------------------------------------------------------------
@given(
    st.lists(st.integers(0, 2**64 - 1), min_size=1, max_size=4),
    st.integers(0, 2**40),
    st.integers(0, 50),
    st.integers(1, 9),
)
def test_random_numbers_equal_those_of_numpy_in_every_bit(seeds: list[int], step: int, world: int, count: int) -> None:
    key = keys(seeds, "bank", device="cpu", world=world)
    drawn = random(key, torch.full((len(seeds),), step), count).numpy()
    words = bits(key, torch.full((len(seeds),), step), count).numpy().view(np.uint64)
    for k, seed in enumerate(seeds):
        np.testing.assert_array_equal(drawn[k], generator(seed, "bank", world=world, step=step).random(count))
        raw = generator(seed, "bank", world=world, step=step).bit_generator.random_raw(count)
        np.testing.assert_array_equal(words[k], raw)


# --- on a GPU -----------------------------------------------------------------------------------------------------------
def _both(dtype: Any, worlds: int = 4096) -> tuple[Stepper, Stepper]:
    return Stepper(FLOOR, worlds, "cpu", dtype), Stepper(FLOOR, worlds, "cuda", dtype)


@pytest.mark.parametrize(
    "dtype", [pytest.param(torch.float64, marks=on_gpu), pytest.param(torch.float32, marks=on_gpu)]
)
def test_one_step_on_a_gpu_is_that_of_the_cpu(dtype: Any) -> None:
    cpu, cuda = _both(dtype)
    for _ in range(40):  # from states all over, with walls among them
        for tensor, value in zip(cuda.tensors(), cpu.tensors(), strict=True):
            tensor.copy_(value)
        cpu.step()
        cuda.step()
        apart = torch.stack(
            [(a.cpu() - b).abs().amax(-1) for a, b in ((cuda.robot.xz, cpu.robot.xz), (cuda.human.xz, cpu.human.xz))]
        )
        assert (apart < 1e-5).double().mean() > (0.9999 if dtype == torch.float64 else 0.999)
        assert (cuda.robot.contact.cpu() == cpu.robot.contact).double().mean() > 0.999


@pytest.mark.parametrize("dtype", [pytest.param(torch.float64, marks=on_gpu)])
def test_1000_steps_on_a_gpu_are_those_of_the_cpu(dtype: Any) -> None:
    cpu, cuda = _both(dtype, worlds=1024)
    for _ in range(1000):
        cpu.step()
        cuda.step()
    apart = (cuda.robot.xz.cpu() - cpu.robot.xz).abs().amax(1)
    assert (apart < 1e-5).double().mean() > 0.99  # one tie that goes the other way parts two tracks for good
    assert (cuda.human.xz.cpu() - cpu.human.xz).abs().max() < 1e-5


@pytest.mark.parametrize("dtype", [pytest.param(torch.float32, marks=on_gpu)])
def test_a_graph_is_the_eager_step_bit_for_bit(dtype: Any) -> None:
    eager, graph = (Stepper(FLOOR, 4096, "cuda", dtype) for _ in range(2))
    replay = captured(graph.step, graph.tensors())
    for a, b in zip(eager.tensors(), graph.tensors(), strict=True):
        assert torch.equal(a, b)  # capturing has changed nothing
    for _ in range(200):
        eager.step()
        replay()
    for a, b in zip(eager.tensors(), graph.tensors(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("seed", [pytest.param(2**63 + 5, marks=on_gpu)])
def test_random_numbers_on_a_gpu(seed: int) -> None:
    drawn = random(keys([seed], "bank", device="cuda"), torch.tensor([3], device="cuda"), 7)
    np.testing.assert_array_equal(drawn.cpu()[0], generator(seed, "bank", step=3).random(7))
