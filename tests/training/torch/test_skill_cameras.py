"""Pictures of skills on a device are those of the CPU: the CUDA C run on the CPU, or on a GPU."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from torch.utils._python_dispatch import TorchDispatchMode  # noqa: E402
from torch.utils._pytree import tree_leaves  # noqa: E402

from h3data.bodies import Robot  # noqa: E402
from h3data.geometry import quat_from_heading  # noqa: E402
from h3data_pipelines.skill_judging import play_of  # noqa: E402
from h3data_training.skills.cpu_cameras import CpuSkillCameras  # noqa: E402
from h3data_training.skills.settings import skill_recipe  # noqa: E402
from h3data_training.torch.skills.bank import SkillBank  # noqa: E402
from h3data_training.torch.skills.cameras import SkillCameras, moved_bodies  # noqa: E402
from h3data_training.torch.skills.teacher import taught  # noqa: E402
from h3data_training.torch.skills.worlds import SkillPlay, SkillTensors  # noqa: E402
from sim_kinematic.agents.skills import CONTROL, Action  # noqa: E402
from sim_kinematic.sensing.camera_sensor import CameraSensor, StateRenderer  # noqa: E402
from sim_kinematic.tasks.play import DecisionLoop  # noqa: E402
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode  # noqa: E402
from sim_kinematic.tasks.rearrange.task import Rearrange  # noqa: E402
from sim_kinematic.tasks.skills.skill_starts import SKILL_NAMES, Skill, draw_starts  # noqa: E402
from sim_kinematic.tasks.sources import EpisodeSource  # noqa: E402
from tests.training.torch.test_cameras import device  # noqa: E402, F401

SIZE = (64, 48)


def episode_of(home: str, number: int = 0) -> RearrangeEpisode:
    found = EpisodeSource(Rearrange(), home).sample(0, number)
    assert isinstance(found, RearrangeEpisode)
    return found


def begun(sim: SkillTensors) -> SkillPlay:
    """The worlds of a bank at the beginning, one for each of its starts."""
    count = len(sim.bank)
    play = sim.before_the_first(torch.arange(count, device=sim.device) - 1)
    return sim.step(play, torch.zeros(count, sim.action_width, dtype=sim.dtype, device=sim.device))


def commands_of(kind: str, step: int, rng: np.random.Generator) -> np.ndarray:
    """Turns on the spot with an arm that reaches out; one in whose hand something is holds on to it."""
    command = np.concatenate([[0.0, 0.5], rng.uniform(-1, 1, 7) if kind == "waves" else np.full(7, 0.6), [1.0]])
    return command if step else np.append(np.zeros(9), 1.0)


@pytest.mark.slow  # quick: each world sees the home of its episode
def test_it_sees_what_it_sees_on_the_cpu(device: Any) -> None:  # noqa: F811
    """With the arm folded, reaching and waving, and with an object in the hand: one that was taken as it lay, and one that an
    episode begins with."""
    name, renderer = device
    episode = episode_of("small:1")
    pick, place = (
        draw_starts(episode, "pick", 1, np.random.default_rng(5), path_m=(0.0, 1.0))[0],
        draw_starts(episode, "place", 1, np.random.default_rng(5))[0],
    )
    hand = play_of(episode, pick, {}).team.robots[0].hand_pose[:3]
    objects = pick.objects.copy()
    objects[pick.target] = hand + np.array([0.05, 0.0, 0.05])
    starts = [pick, replace(pick, objects=objects), place]
    turns = tuple(t._replace(start=np.append(t.start[:3], quat_from_heading(0.7))) for t in episode.targets)
    episode = replace(episode, targets=turns)
    sim = SkillTensors("pick", SkillBank.of([(episode, episode.free, starts)]), device=name, dtype=torch.float32)
    cameras = SkillCameras(sim, worlds=3, size=SIZE, renderer=renderer)
    now, plays = begun(sim), [play_of(episode, start, {}) for start in starts]
    runs, rng = [DecisionLoop(play) for play in plays], np.random.default_rng(0)
    bodies = [member.body for member in plays[0].world.roster]
    stage = StateRenderer(episode.scene, bodies, objects=tuple(episode.moving))
    sensor = CameraSensor(size=SIZE, outputs=("depth", "semantic"))
    wrong, shows_robot, shows_held = [], 0, 0
    ids = [episode.scene.instances[k].semantic_id for k in sim.bank.bodies[0]]
    for step in range(31):
        if step % 10 == 0 or step == 1:
            seen = {output: t.cpu().numpy() for output, t in cameras.observe(now, ("depth", "semantic")).items()}
            for w, play in enumerate(plays):
                stage.pose(play.world.state, frames=play.team.company.frames())
                want = sensor.observe(stage)
                wrong.append((np.abs(seen["depth"][w] - want["depth"][0]) > 2e-3).mean())
                assert (seen["semantic"][w] != want["semantic"][0]).mean() < 2e-3
                shows_robot += (want["semantic"] == Robot.semantic_id).sum()
                shows_held += (want["semantic"] == ids[now.held[w]]).sum() * int(now.held[w] >= 0)
        command = np.array([commands_of(kind, step, rng) for kind in ("reaches", "waves", "waves")])
        going = now._replace(ended=torch.zeros_like(now.ended))
        now = sim.step(going, torch.as_tensor(command, dtype=sim.dtype, device=sim.device))
        for w, run in enumerate(runs):
            run.answer(Action(CONTROL, command=tuple(command[w])))
            run.go_on()
    assert max(wrong) < 2e-3
    assert min(shows_robot, shows_held) > 500
    assert now.held.tolist() == [-1, pick.target, place.target]


class OnTheDevice(TorchDispatchMode):
    """Refuses operations with tensors elsewhere, which a CUDA graph cannot capture. What waits for a value fails by itself on
    the device meta, where tensors have none."""

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        made = operation(*args, **(kwargs or {}))
        tensors = [t for t in tree_leaves((args, kwargs, made)) if isinstance(t, torch.Tensor)]
        elsewhere = [t for t in tensors if t.device.type != "meta" and t.ndim]
        assert not elsewhere, f"{operation} on {elsewhere[0].device}"
        return made


@pytest.mark.slow
@pytest.mark.parametrize("skill", SKILL_NAMES)
def test_a_step_and_its_frames_never_leave_the_device(skill: Skill) -> None:
    episode = episode_of("small:1")
    starts = draw_starts(episode, skill, 2, np.random.default_rng(1), path_m=(0.0, 5.0))
    sim = SkillTensors(skill, SkillBank.of([(episode, episode.free, starts)]), device="meta", dtype=torch.float32)
    cameras = SkillCameras(sim, worlds=4, size=SIZE, renderer=lambda stages, **options: None)  # type: ignore[arg-type, return-value]
    play = sim.before_the_first(torch.full((4,), -1, dtype=torch.int64, device="meta"))
    action = torch.zeros(4, sim.action_width, device="meta")
    settings = skill_recipe("fast", skill)
    with OnTheDevice():
        for looks in (False, True):
            after = sim.step(play, action, looks=looks)
            for was, now in zip(play.tensors(), after.tensors(), strict=True):
                assert (was.shape, was.dtype) == (now.shape, now.dtype)
            play = after
        shown = sim.observations([*settings.observations[1:], *settings.critic], play)
        links, objects = cameras._frames_of(play)
        wanted = taught(sim, play, 3)
    assert {t.dtype for t in (*shown.values(), links, objects, wanted)} == {torch.float32}
    assert wanted.shape == action.shape


@pytest.mark.slow  # quick: test_cameras.py
def test_each_world_sees_the_home_of_its_episode(device: Any) -> None:  # noqa: F811
    """Homes with other objects that may be moved, and episodes that follow each other; as on a machine without a GPU."""
    name, renderer = device
    banks = []
    for home in ("small:1", "small:2"):
        episodes = [episode_of(home, k) for k in range(1 if home == "small:1" else 2)]
        starts = [draw_starts(e, "place", 2, np.random.default_rng(1)) for e in episodes]
        banks.append(SkillBank.of([(e, e.free, s) for e, s in zip(episodes, starts, strict=True)]))
    bank = SkillBank.merged(banks)
    sim = SkillTensors("place", bank, device=name, dtype=torch.float32)
    assert len(set(map(len, moved_bodies(bank)))) == 2
    cameras, there = (
        SkillCameras(sim, worlds=len(bank), size=SIZE, renderer=renderer),
        SkillTensors("place", bank, device="cpu", dtype=torch.float32),
    )
    cpu, now, then = CpuSkillCameras(there, size=SIZE), begun(sim), begun(there)
    for _ in range(2):
        seen, want = cameras.observe(now)["depth"].cpu(), cpu.observe(then)["depth"]
        assert ((seen - want).abs() > 2e-3).float().mean() < 2e-3
        assert len({float(picture.mean()) for picture in want}) > len(bank) // 2
        now, then = (
            one.step(play._replace(ended=torch.ones_like(play.ended)), torch.zeros(len(bank), 10, device=one.device))
            for one, play in ((sim, now), (there, then))
        )
