"""The simulator as tensors: states stepped (robots drive, people walk; nothing else) on one CPU thread and, where there is one,
on a GPU, there launched operation by operation (eager) and as a CUDA graph; and whole environments of social navigation.

The floor of ``sim.torch.{cpu,cuda}.*`` is made here, so that these lines need nothing but NumPy and torch. Environments play in
a furnished home and need all of h3data.

``sim.gpu.human_robot.w*_depth_fps`` follows the paper's protocol of two agents (docs/benchmark.md): small home, random base
velocities, a person who walks shortest paths, contact, skinning, and two depth images of 256 x 256 per world, 90 degrees: the
robot's arm camera and between the person's eyes. One step of all worlds is one CUDA graph; nothing comes back to the host.
Unlike there, people walk to random points instead of objects, in a clip of a fixed speed, and no object can be taken.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from statistics import median
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import torch

Emit = Callable[[str, float, str], None]
HOME = "small:1"
CPU_WORLDS, CPU_STEPS = 1024, 20
CUDA_WORLDS = (1024, 8192, 65536, 262144)
NEEDED = ("fcl", "msgspec", "numba", "pyarrow", "scipy", "shapely", "tqdm")
"""What an environment needs beyond NumPy and torch."""


class BoxFloor(NamedTuple):
    """Rooms of 12 x 10 m with furniture, as a distance grid."""

    sdf: NDArray[np.float32]
    origin: NDArray[np.float64]
    cell_m: float
    has_stairs: bool = False

    @classmethod
    def draw(cls, seed: int = 0) -> BoxFloor:
        """Return a floor of four rooms, doors of 1 m between them, and ten boxes."""
        rng = np.random.default_rng(seed)
        thin, (width, depth) = 0.06, (12.0, 10.0)
        boxes = [
            (5.0, 0.0, 5.0, 2.0),
            (5.0, 3.0, 5.0, 7.0),
            (5.0, 8.0, 5.0, depth),
            (0.0, 4.5, 1.5, 4.5),
            (2.5, 4.5, 9.0, 4.5),
            (10.0, 4.5, width, 4.5),
        ]
        boxes = [(x0 - thin, z0 - thin, x1 + thin, z1 + thin) for x0, z0, x1, z1 in boxes]
        for x, z in rng.uniform((0, 0), (width - 1.4, depth - 0.7), (10, 2)):
            boxes.append((x, z, x + rng.uniform(0.4, 1.4), z + rng.uniform(0.4, 0.7)))
        cell = 0.05
        i, j = np.meshgrid(np.arange(-4, width / cell + 4), np.arange(-4, depth / cell + 4), indexing="ij")
        x, z = (i + 0.5) * cell, (j + 0.5) * cell
        sdf = np.minimum(np.minimum(x, width - x), np.minimum(z, depth - z))
        for x0, z0, x1, z1 in boxes:
            dx, dz = np.maximum(x0 - x, x - x1), np.maximum(z0 - z, z - z1)
            sdf = np.minimum(sdf, np.hypot(dx.clip(0), dz.clip(0)) + np.maximum(dx, dz).clip(max=0))
        return cls(sdf.astype(np.float32), np.array([-4 * cell, -4 * cell]), cell)

    def free_places(self, count: int, rng: np.random.Generator, clear_m: float = 0.5) -> NDArray[np.float64]:
        """Return the centres of cells with enough room around them, [count, 2] [m]."""
        cells = np.argwhere(self.sdf > clear_m)
        return self.origin + (cells[rng.integers(len(cells), size=count)] + 0.5) * self.cell_m


class Stepper:
    """Worlds whose robots and people are stepped in place by the same few tensors."""

    def __init__(self, floor: Any, worlds: int, device: str, dtype: torch.dtype, seed: int = 0) -> None:
        import torch

        from h3data_training.torch.state import HumanTensors, RobotTensors
        from h3data_training.torch.step import Grids
        from sim_kinematic.motion.spec import HOME_WALKER, SocialNavSpec

        rng = np.random.default_rng(seed)

        def on_device(array: Any) -> torch.Tensor:
            return torch.as_tensor(array, dtype=dtype, device=device)

        zero = on_device(np.zeros(worlds))
        self.grids = Grids.of([floor], device, dtype)
        self.robot = RobotTensors(
            on_device(floor.free_places(worlds, rng)), on_device(rng.uniform(-3, 3, worlds)), zero > 0
        )
        people = on_device(floor.free_places(worlds, rng))
        self.human = HumanTensors(people, zero.clone(), zero.clone(), zero.clone(), zero.clone())
        self.goal = on_device(floor.free_places(worlds, rng))
        self.action = on_device(rng.uniform(-1, 1, (worlds, 2)))
        self.spec = SocialNavSpec(human=HOME_WALKER)

    def tensors(self) -> list[torch.Tensor]:
        return [*self.robot, *self.human]

    def step(self) -> None:
        """Step all worlds once, without branches, so that the cost does not depend on their states."""
        from h3data_training.torch.step import drive_robots, walk_humans

        robot = drive_robots(self.grids, self.robot, self.action, self.spec.robot)
        human = walk_humans(self.human, self.goal, self.spec.human)
        for mine, new in zip(self.tensors(), [*robot, *human], strict=True):
            mine.copy_(new)


def run(emit: Emit) -> None:
    """Emit ``sim.torch.*`` and ``sim.gpu.*``; the lines of the GPU only where there is one."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with torch.no_grad():
        stepper = Stepper(BoxFloor.draw(), CPU_WORLDS, "cpu", torch.float32)
        stepper.step()
        seconds = median(cpu_s(lambda: _often(stepper.step, CPU_STEPS)) for _ in range(5))
    emit(f"sim.torch.cpu.w{CPU_WORLDS}_env_steps_per_cpu_s", CPU_WORLDS * CPU_STEPS / seconds, "steps/s")
    if not _missing():
        env, actions = _environment(CPU_WORLDS, "cpu")
        seconds = median(cpu_s(lambda: _often(lambda: env.step(actions), 5)) for _ in range(5))
        emit(f"sim.torch.cpu.env_w{CPU_WORLDS}_env_steps_per_cpu_s", CPU_WORLDS * 5 / seconds, "steps/s")
    torch.set_num_threads(threads)
    if not torch.cuda.is_available():
        print("# sim.torch.cuda: no GPU that torch can use")
        return
    _parity(emit)
    for worlds in CUDA_WORLDS:
        _on_cuda(emit, worlds)
    if _missing():
        print(f"# sim.torch.cuda.env: {', '.join(_missing())} not installed")
        return
    for worlds in (1024, 16384, 65536):
        for compile, name in ((False, "graph"), (True, "compiled")):
            env, actions = _environment(worlds, "cuda", compile=compile)
            seconds = _wall_s(lambda e=env, a=actions: e.step(a))
            emit(f"sim.torch.cuda.env_w{worlds}_{name}_steps_per_s", worlds / seconds, "steps/s")
    for compile, name in ((False, "graph"), (True, "compiled")):
        env, actions = _environment(4096, "cuda", compile=compile, depth_size=(64, 64))
        seconds = _wall_s(lambda e=env, a=actions: e.step(a))
        emit(f"sim.torch.cuda.env_w4096_64x64_depth_{name}_steps_per_s", 4096 / seconds, "steps/s")
    for worlds in (16, 1024):
        for compile, name in ((False, "graph"), (True, "compiled")):
            emit(f"sim.gpu.human_robot.w{worlds}_{name}_depth_fps", _depth_fps(worlds, compile=compile), "frames/s")


def _depth_fps(worlds: int, *, compile: bool) -> float:
    """Return the steps of all worlds per second, with two depth images each."""
    import torch

    from h3data.bodies import load_humanoid, load_robot
    from h3data_training.torch.cameras import TensorCameras
    from h3data_training.torch.episodes import EpisodeBank
    from h3data_training.torch.graph import captured, fused, overwrite
    from h3data_training.torch.social_nav import SocialNavTensors
    from sim_kinematic.motion.spec import HOME_WALKER, SocialNavSpec

    rules = SocialNavSpec(end_on_collision=False, max_steps=3000, human=HOME_WALKER)
    bank = EpisodeBank.draw(HOME, 64, spec=rules)
    sim = SocialNavTensors(bank, device="cuda", spec=rules)
    cameras = TensorCameras(
        bank.scenes[0],
        load_robot("quad_arm"),
        load_humanoid("female_0"),
        rules.human,
        worlds=worlds,
        floor_y=bank.floors[0].floor_y,
        views=("robot_arm", "human"),
        size=(256, 256),
        hfov_deg=90.0,
        compile=compile,
    )
    play = sim.before_the_first(torch.arange(worlds, device="cuda") % len(bank))
    actions = torch.rand(64, worlds, 2, device="cuda") * 2 - 1
    row = torch.zeros(1, dtype=torch.int64, device="cuda")

    def move() -> None:
        row.add_(1).remainder_(len(actions))
        overwrite(play.tensors(), sim.step(play, actions.index_select(0, row)[0]).tensors())

    moves = fused(move) if compile else move

    def step() -> None:
        moves()
        cameras.observe(play.robot, play.human)

    with torch.no_grad():
        replay = captured(step, [*play.tensors(), row])
        for _ in range(60):  # they have set off
            replay()
        return worlds / _wall_s(replay, steps=50)


def _parity(emit: Emit, worlds: int = 4096, steps: int = 1000) -> None:
    """Measure the distance between positions on the CPU and on the GPU in float64 [m].

    One figure is the worst of single steps from the same states. The other is the distance after 1,000 steps that each device
    makes by itself; two tracks that hit a corner of a wall equally far from both sides may part for good.
    """
    import torch

    with torch.no_grad():
        cpu, led, alone = (Stepper(BoxFloor.draw(), worlds, d, torch.float64) for d in ("cpu", "cuda", "cuda"))
        worst = {"robot": [], "human": []}
        for _ in range(steps):
            for tensor, value in zip(led.tensors(), cpu.tensors(), strict=True):
                tensor.copy_(value)
            for stepper in (cpu, led, alone):
                stepper.step()
            for agent, apart in worst.items():
                apart.append((getattr(led, agent).xz.cpu() - getattr(cpu, agent).xz).abs().amax(1))
        for agent, apart in worst.items():
            every = torch.stack(apart)
            emit(f"sim.torch.cuda.parity.{agent}_one_step_max_m", float(every.max()), "m")
            emit(f"sim.torch.cuda.parity.{agent}_one_step_within_1e-5_m", float((every < 1e-5).double().mean()), "1")
            apart = (getattr(alone, agent).xz.cpu() - getattr(cpu, agent).xz).abs().amax(1)
            emit(f"sim.torch.cuda.parity.{agent}_1000_steps_median_m", float(apart.median()), "m")
            emit(f"sim.torch.cuda.parity.{agent}_1000_steps_within_1e-5_m", float((apart < 1e-5).double().mean()), "1")


def _on_cuda(emit: Emit, worlds: int) -> None:
    import torch

    from h3data_training.torch.graph import captured, fused

    with torch.no_grad():
        stepper = Stepper(BoxFloor.draw(), worlds, "cuda", torch.float32)
        emit(f"sim.torch.cuda.w{worlds}_eager_steps_per_s", worlds / _wall_s(stepper.step, steps=20), "steps/s")
        for step, name in ((stepper.step, "graph"), (fused(stepper.step), "compiled")):
            seconds = _wall_s(captured(step, stepper.tensors()))
            emit(f"sim.torch.cuda.w{worlds}_{name}_steps_per_s", worlds / seconds, "steps/s")


def cpu_s(work: Callable[[], object]) -> float:
    """Return CPU seconds of this process for ``work`` (`benchmarks.sim` has the same, but needs all of h3data)."""
    start = time.process_time()
    work()
    return time.process_time() - start


def _wall_s(work: Callable[[], object], *, steps: int = 100) -> float:
    """Return wall-clock time of one call [s] including the wait for the GPU: the median of some rounds of ``steps``."""
    import torch

    times = []
    for _ in range(6):
        torch.cuda.synchronize()
        start = time.perf_counter()
        _often(work, steps)
        torch.cuda.synchronize()
        times.append((time.perf_counter() - start) / steps)
    return median(times[1:])


def _environment(
    worlds: int, device: str, *, compile: bool = False, depth_size: tuple[int, int] | None = None
) -> tuple[Any, torch.Tensor]:
    """Return an environment, with arm depth if there is a size of pictures."""
    import torch

    from h3data_training.envs.social_nav_torch_env import SocialNavTorchEnv

    shown: Any = {"depth_size": depth_size, "observations": ("arm_depth", "humanoid_gps")} if depth_size else {}
    env = SocialNavTorchEnv(worlds, HOME, device=device, episodes=64, compile=compile, **shown)
    env.reset(seed=0)
    return env, torch.as_tensor(np.random.default_rng(0).uniform(-1, 1, (worlds, 2)), device=device)


def _missing() -> list[str]:
    return [name for name in NEEDED if importlib.util.find_spec(name) is None]


def _often(work: Callable[[], object], times: int) -> None:
    for _ in range(times):
        work()


if __name__ == "__main__":
    run(lambda name, value, unit: print(f"{name} {value:.6g} {unit}", flush=True))
