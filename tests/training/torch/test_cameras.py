"""Pictures of a state that never leaves the device: those of the CPU, by the CUDA C run on the CPU, or on a GPU."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.gpu.emulator import COMPILER, EmulatedRenderer

torch = pytest.importorskip("torch")

from h3data.bodies import load_humanoid, load_robot  # noqa: E402
from h3data.scene import FreeSpace  # noqa: E402
from h3data_gpu import GpuRenderer  # noqa: E402
from h3data_homes import HomeSpec, build_home  # noqa: E402
from h3data_training.envs.social_nav_torch_env import SocialNavTorchEnv  # noqa: E402
from h3data_training.episodes import rules  # noqa: E402
from h3data_training.torch import cameras as torch_cameras  # noqa: E402
from h3data_training.torch.episodes import EpisodeBank  # noqa: E402
from h3data_training.torch.state import HumanTensors, RobotTensors  # noqa: E402
from h3data_training.worlds import ActionRepeatEnv  # noqa: E402
from sim_kinematic.motion.spec import WalkerSpec  # noqa: E402
from sim_kinematic.motion.state import WorldState  # noqa: E402
from sim_kinematic.sensing.camera_sensor import CameraSensor, StateRenderer  # noqa: E402
from sim_kinematic.sensing.sensor import HUMAN_ID  # noqa: E402
from sim_kinematic.tasks.social_nav import TRAINING  # noqa: E402
from tests.sim.steppers import Batch  # noqa: E402
from tests.training.runs import small  # noqa: E402
from tests.training.torch.capturable import CapturableOnly  # noqa: E402

SIZE = (64, 48)
RULES = replace(TRAINING, max_steps=20)


@pytest.fixture(scope="module", params=["emulated", pytest.param("gpu", marks=pytest.mark.gpu)])
def device(request, tmp_path_factory) -> Any:
    """Name of a device, and its class of renderers."""
    if request.param == "gpu":
        if not torch.cuda.is_available():
            pytest.skip("torch finds no GPU")
        return "cuda", GpuRenderer
    if COMPILER is None:
        pytest.skip("g++ is not installed, so the CUDA code cannot be run on the CPU")
    EmulatedRenderer.folder = tmp_path_factory.mktemp("kernels")
    return "cpu", EmulatedRenderer


@pytest.mark.slow
def test_robots_and_people_see_what_they_see_on_the_cpu(device: Any) -> None:
    home, robot, human = build_home(HomeSpec(preset="small", seed=1)), load_robot("quad_arm"), load_humanoid("female_0")
    worlds, rng, state = 3, np.random.default_rng(3), WorldState.zeros(3)
    (robots,), (people,) = state.robots, state.people
    robots.xz[:], robots.heading[:] = FreeSpace.from_scene(home).sample(rng, worlds), rng.uniform(-3, 3, worlds)
    people.xz[:] = robots.xz + 1.8 * np.stack([np.cos(robots.heading), -np.sin(robots.heading)], -1)
    people.heading[:], people.distance[:], people.blend[:] = rng.uniform(-3, 3, worlds), [0, 1.234, 5.7], [0, 1, 1]
    drawn = StateRenderer(home, [robot, human], worlds=worlds)
    drawn.pose(state)
    sensors = [CameraSensor(agent=k, size=SIZE, outputs=("depth", "semantic")) for k in (0, 1)]
    want = [sensor.observe(drawn) for sensor in sensors]
    name, renderer = device
    cameras = torch_cameras.TensorCameras(
        home,
        robot,
        human,
        WalkerSpec(),
        worlds=worlds,
        views=("robot_arm", "human"),
        size=SIZE,
        device=name,
        renderer=renderer,
    )
    tensors = RobotTensors.of(robots, name, torch.float64), HumanTensors.of(people, name, torch.float64)
    seen = {output: t.cpu().numpy() for output, t in cameras.observe(*tensors, ("depth", "semantic")).items()}
    assert seen["depth"].shape == (2, worlds, SIZE[1], SIZE[0])
    shows_her = 0
    for view, picture in enumerate(want):
        assert (np.abs(seen["depth"][view] - picture["depth"]) > 2e-3).mean() < 1e-3
        assert (seen["semantic"][view] != picture["semantic"]).mean() < 1e-3
        shows_her += (picture["semantic"] == HUMAN_ID).sum()
    assert shows_her > 500


@pytest.mark.slow
def test_the_environment_shows_the_arms_picture(device: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    name, renderer = device
    monkeypatch.setattr("h3data_gpu.GpuRenderer", renderer)
    bank = EpisodeBank.draw("small:1", 2, seed=5, spec=RULES)
    shown: Any = ("arm_depth", "humanoid_detector", "humanoid_gps")
    env = SocialNavTorchEnv(2, device=name, observations=shown, spec=RULES, episodes=bank, depth_size=SIZE)
    seen, info = env.reset(seed=1)
    seen = {key: value.cpu().numpy() for key, value in seen.items()}
    batch = Batch("small:1", worlds=2, spec=RULES, observations=shown, depth_size=SIZE)
    batch.begin(5, info["episode"].cpu().numpy())
    want = batch.observe()
    assert env.single_observation_space == batch.space()
    assert seen["arm_depth"].shape == (2, SIZE[1], SIZE[0], 1)
    assert (np.abs(seen["arm_depth"] - want["arm_depth"]) > 2e-4).mean() < 1e-3
    np.testing.assert_array_equal(seen["humanoid_detector"], want["humanoid_detector"])
    after, *_ = env.step(torch.ones(2, 2))
    assert not np.array_equal(after["arm_depth"].cpu().numpy(), seen["arm_depth"])


@pytest.mark.slow
@pytest.mark.parametrize("light", ["flat", "baked"])
def test_each_world_sees_the_home_of_its_episode(device: Any, monkeypatch: pytest.MonkeyPatch, light: Any) -> None:
    """On the device as in the training worlds of a machine without one, where the CPU renders."""
    name, renderer = device
    monkeypatch.setattr("h3data_gpu.GpuRenderer", renderer)
    shown: Any = ("arm_rgb", "humanoid_detector", "humanoid_gps")
    settings = small(picture_size=SIZE, episodes_per_home=1, worlds=4, observations=shown, light=light)
    homes = ("small:1", "h3-homes-v2/train#0")
    bank = EpisodeBank.merged([EpisodeBank.draw(home, 1, seed=k, spec=rules(settings)) for k, home in enumerate(homes)])
    env = SocialNavTorchEnv(
        4,
        device=name,
        dtype=torch.float32,
        observations=shown,
        spec=rules(settings),
        episodes=bank,
        depth_size=SIZE,
        light=light,
    )
    worlds = ActionRepeatEnv(settings, bank, device="cpu", compile=False, hold=1)
    seen, info = env.reset(seed=1)
    want, _ = worlds.reset(seed=1)
    assert len(set(info["episode"].tolist())) == 2
    for _ in range(3):
        assert levels_apart(seen, want) < 5e-3
        assert torch.equal(seen["humanoid_detector"].cpu(), want["humanoid_detector"])
        seen, want = env.step(torch.ones(4, 2))[0], worlds.repeat_action(torch.ones(4, 2))[0]
    worlds.play.ended.fill_(True)
    env.play.ended.fill_(True)  # the next episode of the bank is in the other home
    seen, want = env.step(torch.ones(4, 2))[0], worlds.repeat_action(torch.ones(4, 2))[0]
    assert levels_apart(seen, want) < 5e-3


@pytest.mark.slow
def test_two_cameras_in_turn_upload_nothing(device: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The detector's picture, then that of the colours: nothing but what a CUDA graph holds."""
    name, renderer = device
    monkeypatch.setattr("h3data_gpu.GpuRenderer", renderer)
    bank = EpisodeBank.draw("small:1", 2, seed=5, spec=RULES)
    shown: Any = ("arm_rgb", "humanoid_detector")
    env = SocialNavTorchEnv(2, device=name, observations=shown, spec=RULES, episodes=bank, depth_size=SIZE)
    first, _ = env.reset(seed=1)
    assert env._cameras is not None
    monkeypatch.setattr(torch, "from_numpy", None)
    with CapturableOnly():
        again = env._pictures(env._cameras)
    assert torch.equal(again["arm_rgb"], first["arm_rgb"])


def levels_apart(seen: Any, want: Any) -> float:
    """Share of colours that are more than two levels apart."""
    return float(((seen["arm_rgb"].cpu().int() - want["arm_rgb"].int()).abs() > 2).float().mean())
