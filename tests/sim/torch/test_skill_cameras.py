"""Pictures of skills on a device are those of the CPU: the CUDA C run on the CPU, or on a GPU."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from h3data.geometry import quat_from_heading  # noqa: E402
from h3data_training.skills.cpu_cameras import CpuSkillCameras  # noqa: E402
from sim_kinematic.agents.skills import CONTROL, Action  # noqa: E402
from sim_kinematic.envs.skill_stepper import Stage  # noqa: E402
from sim_kinematic.sensing.camera_sensor import CameraSensor  # noqa: E402
from sim_kinematic.tasks.rearrange.episode import RearrangeEpisode  # noqa: E402
from sim_kinematic.tasks.rearrange.skill_judging import play_of  # noqa: E402
from sim_kinematic.tasks.rearrange.skill_starts import draw_starts  # noqa: E402
from sim_kinematic.tasks.rearrange.task import Rearrange  # noqa: E402
from sim_kinematic.tasks.runner import Turns  # noqa: E402
from sim_kinematic.tasks.sources import EpisodeSource  # noqa: E402
from sim_kinematic.torch.skills.bank import SkillBank  # noqa: E402
from sim_kinematic.torch.skills.cameras import SkillCameras  # noqa: E402
from sim_kinematic.torch.skills.worlds import SkillPlay, SkillTensors  # noqa: E402
from tests.sim.torch.test_cameras import device  # noqa: E402, F401

SIZE = (64, 48)


def episode_of(home: str) -> RearrangeEpisode:
    found = EpisodeSource(Rearrange(), home).sample(0, 0)
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


def test_it_sees_what_it_sees_on_the_cpu(device: Any) -> None:  # noqa: F811
    """With the arm folded, reaching and waving, and with an object in the hand that was taken as it lay, and one that an episode
    begins with."""
    name, renderer = device
    episode = episode_of("small:1")
    pick, place = (
        draw_starts(episode, "pick", 1, np.random.default_rng(5), path_m=(0.0, 1.0))[0],
        draw_starts(episode, "place", 1, np.random.default_rng(5))[0],
    )
    hand = play_of(episode, pick, {}).robots[0].hand_pose[:3]
    objects = pick.objects.copy()
    objects[pick.target] = hand + np.array([0.05, 0.0, 0.05])
    starts = [pick, replace(pick, objects=objects), place]
    turns = tuple(t._replace(start=np.append(t.start[:3], quat_from_heading(0.7))) for t in episode.targets)
    episode = replace(episode, targets=turns)
    sim = SkillTensors("pick", SkillBank.of([(episode, episode.free, starts)]), device=name, dtype=torch.float32)
    cameras = SkillCameras(sim, worlds=3, size=SIZE, renderer=renderer)
    now, plays = begun(sim), [play_of(episode, start, {}) for start in starts]
    runs, stages, rng = [Turns(play) for play in plays], [Stage() for _ in plays], np.random.default_rng(0)
    sensor = CameraSensor(size=SIZE, outputs=("depth", "semantic"))
    held, seen_robot, wrong = 0, 0, []
    for step in range(31):
        if step % 10 == 0 or step == 1:
            seen = {output: t.cpu().numpy() for output, t in cameras.observe(now, ("depth", "semantic")).items()}
            for w, (play, stage) in enumerate(zip(plays, stages, strict=True)):
                want = sensor.observe(stage.posed(play))
                wrong.append((np.abs(seen["depth"][w] - want["depth"][0]) > 2e-3).mean())
                assert (seen["semantic"][w] != want["semantic"][0]).mean() < 2e-3
                seen_robot += int((want["semantic"] == 200).sum())
                held += int(now.held[w]) >= 0
        command = np.array([commands_of(kind, step, rng) for kind in ("reaches", "waves", "waves")])
        going = now._replace(ended=torch.zeros_like(now.ended))
        now = sim.step(going, torch.as_tensor(command, dtype=sim.dtype, device=sim.device))
        for w, run in enumerate(runs):
            run.answer(Action(CONTROL, command=tuple(command[w])))
            run.go_on()
    assert max(wrong) < 2e-3
    assert held >= 8
    assert len({round(float(j), 3) for j in now.joints[:, 2]}) == 3
    del seen_robot
