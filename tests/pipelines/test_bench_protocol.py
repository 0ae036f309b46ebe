"""The speed benchmark does what it times: agents move, see each other, touch, reach; the command's table and refusals."""

from __future__ import annotations

import gc
import json
import re
import tracemalloc
from itertools import pairwise

import numpy as np
import pytest

from h3data.errors import InputError
from h3data_pipelines.cli import main
from h3data_pipelines.machine.bench_agents import RobotAgent
from h3data_pipelines.machine.bench_protocol import BenchmarkWorlds, Cell


def face_to_face(benchmark: BenchmarkWorlds, apart: float) -> None:
    """The second agent stands ``apart`` metres ahead of the first, which looks along +x, in a free place of the home."""
    free, rng = benchmark.free, np.random.default_rng(0)
    benchmark.reset(rng)
    while True:
        (xz,) = free.sample(rng, 1)
        if np.isclose(free.geodesic(xz, xz + np.array([max(apart, 2.5), 0])), max(apart, 2.5)):
            break
    for agent, place, heading in zip(benchmark.agents, (xz, xz + np.array([apart, 0])), (0.0, np.pi), strict=True):
        agent.own.xz[:], agent.own.heading[:] = place, heading


def stay(benchmark: BenchmarkWorlds) -> np.ndarray:
    return benchmark.step([np.zeros((benchmark.worlds, 2)) for _ in benchmark.agents])


@pytest.mark.parametrize("action", [pytest.param("nav", marks=pytest.mark.slow), "pick"])
@pytest.mark.parametrize(
    "agents",
    [
        pytest.param("robot", marks=pytest.mark.slow),
        pytest.param("human", marks=pytest.mark.slow),
        pytest.param("robot_robot", marks=pytest.mark.slow),
        "human_robot",
    ],
)
def test_every_kind_of_cell_runs(agents: str, action: str) -> None:
    cell = Cell(agents=agents, action=action, worlds=2)  # type: ignore[arg-type]
    benchmark, rng = BenchmarkWorlds(cell), np.random.default_rng(1)
    count = len(agents.split("_"))
    benchmark.reset(rng)
    first = [agent.frames for agent in benchmark.agents]
    bases = [agent.base for agent in benchmark.agents]
    for _ in range(39):
        benchmark.step(benchmark.sample(rng))
    depth = benchmark.step(benchmark.sample(rng))
    assert depth.shape == (count * 2, *(2 * [128 if count == 1 else 256]))
    assert (depth > 0).any((1, 2)).all()
    for agent, before, base in zip(benchmark.agents, first, bases, strict=True):
        assert (np.abs(agent.frames - before).max((1, 2, 3)) > 0.02).all()
        stands = (agent.base == base).all(-1)
        assert stands.all() if action == "pick" else not stands.any()


@pytest.mark.parametrize("agents", ["robot_robot", "human_robot"])
def test_two_agents_see_and_touch_each_other(agents: str) -> None:
    benchmark = BenchmarkWorlds(Cell(agents=agents))  # type: ignore[arg-type]
    for apart, touch in ((2.5, False), (0.5, True)):
        face_to_face(benchmark, apart)
        stay(benchmark)
        assert bool(benchmark.touched[0]) is touch, apart
    face_to_face(benchmark, 2.5)
    stay(benchmark)
    seen = benchmark.render(("instance", "depth"))
    for picture, depth, other in zip(seen["instance"], seen["depth"], benchmark.agents[::-1], strict=True):
        there = np.isin(picture, benchmark.drawn.instances(other.number))
        assert there.sum() > 500
        assert 0.8 < np.median(depth[there]) < 3.2


def test_the_arm_sees_one_picture_of_each_world() -> None:
    benchmark, rng = BenchmarkWorlds(Cell(pictures="arm", worlds=2)), np.random.default_rng(1)
    benchmark.reset(rng)
    depth = benchmark.step(benchmark.sample(rng))
    assert depth.shape == (2, 171, 224)
    assert (depth > 0).any((1, 2)).all()
    with pytest.raises(InputError, match="H3-OPTION-018"):
        BenchmarkWorlds(Cell(agents="human", pictures="arm"))


@pytest.mark.slow
def test_resets_leave_nothing_behind() -> None:
    benchmark, rng = BenchmarkWorlds(Cell(worlds=2)), np.random.default_rng(1)

    def play(resets: int) -> int:
        """Bytes that Python and NumPy hold afterwards."""
        for _ in range(resets):
            benchmark.reset(rng)
            benchmark.step(benchmark.sample(rng))
        gc.collect()
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        held = [play(25) for _ in range(5)]
        assert min(after - before for before, after in pairwise(held)) < 10_000  # what leaks does so every time
    finally:
        tracemalloc.stop()


def test_bones_fill_nearly_what_skin_does() -> None:
    masks = []
    for skinned in (True, False):
        benchmark = BenchmarkWorlds(Cell(skinned=skinned))
        face_to_face(benchmark, 2.5)
        stay(benchmark)
        human, robot = benchmark.agents
        masks.append(np.isin(benchmark.render(("instance",))["instance"][1], benchmark.drawn.instances(human.number)))
        assert isinstance(robot, RobotAgent)
    skin, bones = masks
    assert (skin & bones).sum() > 0.7 * (skin | bones).sum()


def test_hands_take_what_they_reach() -> None:
    benchmark, rng = BenchmarkWorlds(Cell(agents="human", action="pick")), np.random.default_rng(0)
    benchmark.reset(rng)
    (human,) = benchmark.agents
    state = benchmark.state
    state.people[0].xz[0] = benchmark.free.sample(rng, 1)[0]
    state.people[0].heading[0] = 0.0
    state.object_pose[0, 0, :3] = [
        state.people[0].xz[0, 0] + 0.4,
        benchmark.free.floor_y + 1.0,
        state.people[0].xz[0, 1] + 0.1,
    ]
    for _ in range(60):
        benchmark.step([np.array([[0.0, 1.0]])])
    assert state.held_by[0, 0] == human.number


def test_a_run_times_all_steps_but_the_first() -> None:
    benchmark = BenchmarkWorlds(Cell(agents="robot"))
    one, many = (benchmark.run(0, steps=steps, untimed=2) for steps in (3, 42))
    assert 0 < one.wall_s < many.wall_s
    with pytest.raises(InputError, match=r"(?s)10.*H3-OPTION-019"):
        benchmark.run(0, steps=10)
    with pytest.raises(InputError, match=r"(?s)1.*19.*20.*H3-OPTION-017"):
        BenchmarkWorlds(Cell(objects=20))


def test_the_same_seed_gives_the_same_worlds() -> None:
    poses = []
    for _ in range(2):
        benchmark = BenchmarkWorlds(Cell(worlds=2))
        benchmark.run(3, steps=12)
        poses.append(np.concatenate([agent.base for agent in benchmark.agents]))
    np.testing.assert_array_equal(*poses)


def test_command_prints_the_papers_number_beside(capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--agents", "robot,human_robot", "--worlds", "1", "--runs", "2", "--steps", "12"]
    assert main(["bench", "sim", *options]) == 0
    text = capsys.readouterr().out
    assert re.search(r"^small +2 +robot +1 on 1 +nav +- +1 128x128 +\d+±\d+ +\d+\.\d\d +245±19$", text, re.MULTILINE)
    assert re.search(r"^small +2 +human_robot .* skinned +2 256x256 .* 136±8$", text, re.MULTILINE)
    assert (
        main(
            [
                "bench",
                "sim",
                "--agents",
                "human",
                "--bodies",
                "bones",
                "--worlds",
                "1",
                "--runs",
                "1",
                "--steps",
                "12",
                "--json",
            ]
        )
        == 0
    )
    told = json.loads(capsys.readouterr().out)
    (row,) = told["cells"]
    assert (row["skinned"], row["paper"], row["fps_standard_error"]) == (False, None, None)
    assert row["fps"] == [row["fps_mean"]]


@pytest.mark.slow
def test_worlds_are_shared_by_processes(capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--agents", "robot", "--worlds", "3", "--runs", "2", "--steps", "12", "--cores", "2", "--json"]
    assert main(["bench", "sim", *options]) == 0
    (row,) = json.loads(capsys.readouterr().out)["cells"]
    assert (row["worlds"], row["processes"], len(row["fps"])) == (3, 2, 2)
    # a process that fails does not leave the other waiting
    assert main(["bench", "sim", "--agents", "robot", "--objects", "99", "--worlds", "2", "--cores", "2"]) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["render"], "Unknown benchmark 'render'. Expected: sim."),
        (["sim", "--homes", "tiny"], "--homes: unknown 'tiny'. Expected some of: small, medium, large; or all."),
        (["sim", "--worlds", "0"], "--worlds: expected positive whole numbers"),
        (["sim", "--objects", "2,x"], "--objects: expected positive whole numbers"),
        (["sim", "--runs", "0"], "--runs must be at least 1"),
        (["sim", "--steps", "10"], "--steps must be more than 10"),
        (["sim", "--cores", "0"], "--cores must be at least 1"),
        (["sim", "--backend", "gpu", "--cores", "2"], "one process renders all worlds"),
        (["sim", "--agents", "robot", "--bodies", "bones"], "robots have no skin"),
        (["sim", "--objects", "20", "--worlds", "1"], "1 to 19 objects"),
    ],
)
def test_refusals(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", *arguments]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.gpu
def test_gpu_draws_the_same_worlds() -> None:
    from h3data_gpu import gpu_problem

    if problem := gpu_problem():
        pytest.skip(problem)
    pictures = []
    for backend in ("cpu", "gpu"):
        benchmark, rng = BenchmarkWorlds(Cell(worlds=2), backend=backend), np.random.default_rng(2)
        benchmark.reset(rng)
        benchmark.step(benchmark.sample(rng))
        depth = benchmark.step(benchmark.sample(rng))
        pictures.append(depth.cpu().numpy() if backend == "gpu" else depth)
    assert (np.abs(np.subtract(*pictures)) < 1e-3).mean() > 0.99
