"""Batched worlds for training, in which an action is repeated before a picture is rendered, all in one CUDA graph.

`ActionRepeat` is the decision of a learner in worlds of any task, and `ActionRepeatEnv` has those of social navigation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from h3data.bodies import load_humanoid, load_robot
from h3data.errors import InputError
from h3data.render.light.sources import LightMode
from h3data_training.cpu_cameras import CpuCameras
from h3data_training.envs.task_torch_env import PICTURED, arm_cameras, arm_pictures, cameras_of
from h3data_training.envs.torch_env import enough_memory, places_in_bank
from h3data_training.episodes import rules
from h3data_training.settings import CRITIC, Settings
from h3data_training.torch.episodes import EpisodeBank
from h3data_training.torch.graph import can_fuse, captured, fused, overwrite
from h3data_training.torch.social_nav import SocialNavTensors

COUNTS = ("reward", "follows", "collided", "ended", "steps", "contact", "met", "distance")
"""Names of the sums over worlds and steps in `ActionRepeatEnv.totals`."""


class ActionRepeat:
    """Base class of `h3data_training.ppo.Worlds` for all tasks.

    A world whose episode ends during these steps starts the next one at once; rewards after that are not counted.
    """

    counts: tuple[str, ...]
    """Names of the sums over worlds and steps that `totals` accumulates."""
    sim: Any
    """Worlds as tensors, whose ``bank`` has the episodes that they play."""
    play: Any
    """State of all worlds; overwritten by every step."""
    shown: Tensor | None = None
    """Worlds in which a teacher acts as long as it has a weight, bool [W]; None for no world."""
    _action: Tensor
    _shown: dict[str, Tensor]
    """Observations of the last call of `_eager`."""

    def __init__(self, hold: int, worlds: int, device: torch.device | str) -> None:
        """Create sums for ``worlds`` worlds, in which an action is repeated for ``hold`` steps."""
        self.hold, self.num_envs, self.device = hold, worlds, torch.device(device)
        self._advance = self._eager
        """`_eager`, or the CUDA graph that was captured of it."""
        self.gain = torch.zeros(worlds, device=self.device)
        self.over, self.timed_out, self.idle = (
            torch.zeros(worlds, dtype=torch.bool, device=self.device) for _ in range(3)
        )
        self.totals = torch.zeros(len(self.counts), device=self.device)
        self.counted = torch.ones(worlds, dtype=torch.bool, device=self.device)
        """Worlds that `totals` counts, bool [W]: not those in which a teacher acts."""

    def reset(self, *, seed: Sequence[int]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Start an episode in all worlds, each at the position in the bank that depends on its seed, without motion."""
        with torch.no_grad():
            self._begin(seed)
            hold, self.hold = self.hold, 1
            self._eager()
            self.hold = hold
        return self._result(), {}

    def repeat_action(self, action: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor, Tensor]:
        """Advance all worlds by a repeated action [W, A], and return new tensors as `Worlds.repeat_action` does."""
        with torch.no_grad():
            self._action.copy_(action)
            self._advance()
        return self._result(), self.gain.clone(), self.over.clone(), self.timed_out.clone(), self.idle.clone()

    def repeat_action_in_place(self, action: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, Tensor, Tensor]:
        """Perform `repeat_action` operation by operation, so that a CUDA graph can capture it.

        Each call overwrites the same tensors.
        """
        own = self._shown  # where a graph of these worlds alone writes
        self._action.copy_(action)
        self._eager()
        shown, self._shown = self._shown, own
        return shown, self.gain, self.over, self.timed_out, self.idle

    def _eager(self) -> None:
        """Carry out an action of all worlds and show its result, in place."""
        raise NotImplementedError

    def _show(self, shown: dict[str, Tensor]) -> None:
        """Write observations in place, where a captured graph writes them in every replay."""
        if not self._shown:
            self._shown = {name: tensor.clone() for name, tensor in shown.items()}
        overwrite((self._shown[name] for name in shown), shown.values())

    def _result(self) -> dict[str, Tensor]:
        """Return observations of the last step, in tensors of their own."""
        return {name: tensor.clone() for name, tensor in self._shown.items()}

    def _begin(self, seed: int | Sequence[int]) -> None:
        """Let the next step begin an episode in each world, at the place in the bank that follows from its seed."""
        if self.device.type == "cuda" and self._advance == self._eager:
            self._advance = captured(self._eager, list(self.play.tensors()))
        self.play.episode.copy_(places_in_bank(seed, self.num_envs, len(self.sim.bank)) - 1)
        self.play.ended.fill_(True)
        self._action.zero_()

    def taught(self) -> Tensor:
        """Return the actions of a teacher, which most tasks do not have."""
        raise InputError(f"There is no teacher of {self.sim.task.name}. Hint: teacher=0.", code="H3-TRAIN-078")

    def _hold_action(self) -> None:
        """Make `hold` steps of all worlds, in place."""
        play = self.play
        idle, timed_out = play.ended.clone(), play.ended & play.truncated
        live, inside = ~idle, torch.zeros_like(idle)
        gain, sums = torch.zeros_like(self.gain), torch.zeros_like(self.totals)
        for k in range(self.hold):
            before = self._step_held(k)
            if (enough := self._long_enough()) is not None:
                enough = ~play.ended & enough
                play.truncated.logical_or_(enough)
                play.ended.logical_or_(enough)
            ends = live & play.ended
            gained = torch.where(live, play.reward.float(), 0.0)
            gain = gain + gained
            own = self.counted
            counted = [(gained * own).sum(), *self._counted(before, live & own, ends & own)]
            sums = sums + torch.stack(counted).float()
            live = live & ~ends
            if k < self.hold - 1:
                inside, timed_out = inside | ends, timed_out | (ends & play.truncated)
        self.gain.copy_(gain)
        self.over.copy_(idle | inside)
        self.timed_out.copy_(timed_out)
        self.idle.copy_(idle)
        self.totals.add_(sums)

    def _step_held(self, k: int) -> Any:
        """Play step ``k`` of an action, in place, and return what `_counted` needs of the state before it."""
        raise NotImplementedError

    def _long_enough(self) -> Tensor | None:
        """Return the worlds whose episodes are cut short as if their time were over, bool [W]; None if none are."""
        return None

    def _counted(self, before: Any, live: Tensor, ends: Tensor) -> list[Tensor]:
        """Return sums over the worlds that are ``live`` [W] in a step, in the order of `counts` after the first, the reward.

        ``ends`` are the worlds whose episode has just ended.
        """
        raise NotImplementedError


class ActionRepeatGoal(ActionRepeat):
    """`ActionRepeat` for tasks that an episode solves or fails, and that end by themselves after `limit` steps."""

    counts = ("reward", "succeeded", "failed", "ended", "steps", "contact")
    """Names of the sums over worlds and steps in `totals`; subclasses add sums over steps."""
    limit: int

    def _long_enough(self) -> Tensor:
        return self.play.steps >= self.limit

    def _results(self, success: Tensor, live: Tensor, ends: Tensor) -> list[Tensor]:
        """Return the sums of `_counted` for worlds whose episode ends in ``success`` [W] or without."""
        play = self.play
        return [
            (ends & success).sum(),
            (ends & play.terminated & ~success).sum(),
            ends.sum(),
            live.sum(),
            (live & play.robot.contact).sum(),
        ]

    def figures(self, total: dict[str, float]) -> dict[str, float]:
        """Return columns of the learning curve that are computed from the totals, by name."""
        steps, ended = max(total["steps"], 1.0), max(total["ended"], 1.0)
        return {
            "reward": total["reward"] / steps,
            "succeeded": total["succeeded"] / ended,
            "failed": total["failed"] / ended,
            **{name: total[name] / steps for name in self.counts[len(ActionRepeatGoal.counts) :]},
            "contact": total["contact"] / steps,
            "steps_per_episode": steps / ended,
            "ended": total["ended"],
        }


class ActionRepeatEnv(ActionRepeat):
    """`SocialNavTensors` in which an action is repeated for ``hold`` steps, as `h3data_training.ppo.Worlds`.

    `ActionRepeat.repeat_action` and this class carry out a decision of a learner.
    """

    counts = COUNTS

    def __init__(
        self,
        settings: Settings,
        bank: EpisodeBank,
        *,
        device: str,
        compile: bool | None = None,
        hold: int | None = None,
        count: int | None = None,
    ) -> None:
        """Create ``count`` worlds (default: the number in the settings), a share of those of several processes."""
        super().__init__(hold or settings.hold, count or settings.worlds, device)
        self.bank, self.follow_steps = bank, settings.follow_steps
        self._light: LightMode = settings.light
        bodies = {"robot": settings.robot, "human": settings.human}
        self.sim = SocialNavTensors(bank, device=self.device, dtype=torch.float32, spec=rules(settings), **bodies)
        self._names = tuple(dict.fromkeys((*settings.observations, *CRITIC)))
        self._numbers = [name for name in self._names if name not in PICTURED]
        nothing = torch.full((self.num_envs,), -1, dtype=torch.int64, device=self.device)
        self.play = self.sim.before_the_first(nothing)
        self._action = torch.zeros(self.num_envs, self.sim.action_width, device=self.device)
        self._shown: dict[str, Tensor] = {}
        compiles = self.device.type == "cuda" and can_fuse() if compile is None else compile
        self._move = fused(self._moved) if compiles else self._moved
        pictured = set(PICTURED) & set(self._names)
        self._cameras = self._make_cameras(settings.picture_size, compile=compiles, **bodies) if pictured else None

    def _make_cameras(self, size: tuple[int, int] | None, *, compile: bool, robot: str, human: str) -> Any:
        if self.device.type == "cuda":
            return cameras_of(
                self.bank,
                load_robot(robot),
                load_humanoid(human),
                self.sim.spec.human,
                worlds=self.num_envs,
                views=arm_cameras(self._names),
                size=size,
                device=self.device,
                compile=compile,
                light=self._light,
            )
        assert size is not None
        floors = [floor.floor_y for floor in self.bank.floors]
        return CpuCameras(
            self.bank.scenes,
            robot,
            human,
            self.sim.spec.human,
            floors=floors,
            views=arm_cameras(self._names),
            size=size,
            light=self._light,
        )

    def reset(self, *, seed: int | Sequence[int]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Start an episode in all worlds, at the positions in the bank that depend on their seeds, without motion."""
        with enough_memory(self.device, self.num_envs, self.sim.task.name), torch.no_grad():
            self._begin(seed)
            self._advance()
        return self._result(), {}

    def _eager(self) -> None:
        self._hold_action()
        if self._cameras is not None:
            place = self.sim.place_of(self.play) if len(self.bank.scenes) > 1 else None
            self._cameras.pose(self.play.robot, self.play.human, place=place)
            self._shown |= arm_pictures(self._cameras, self._names)
        self._shown = {name: self._shown[name] for name in self._names}

    def _step_held(self, k: int) -> Tensor:
        followed = self.play.memory["followed"].clone()
        self._shown = self._move()
        return followed

    def _moved(self) -> dict[str, Tensor]:
        """Move all worlds a step, in place, and return what they show but for pictures."""
        overwrite(self.play.tensors(), self.sim.step(self.play, self._action).tensors())
        return self.sim.observations(self._numbers, self.play)

    def _long_enough(self) -> Tensor | None:
        return self.play.memory["followed"] >= self.follow_steps if self.follow_steps else None

    def _counted(self, before: Tensor, live: Tensor, ends: Tensor) -> list[Tensor]:
        play = self.play
        return [
            (live & (play.memory["followed"] > before)).sum(),
            (live & play.terminated).sum(),
            ends.sum(),
            live.sum(),
            (live & play.robot.contact).sum(),
            (ends & (play.memory["followed"] > 0)).sum(),
            torch.where(live, (play.robot.xz - play.human.xz).square().sum(-1).sqrt(), 0.0).sum(),
        ]

    def figures(self, total: dict[str, float]) -> dict[str, float]:
        """Return columns of the learning curve that are computed from the totals, by name."""
        steps, ended = max(total["steps"], 1.0), max(total["ended"], 1.0)
        return {
            "reward": total["reward"] / steps,
            "distance_m": total["distance"] / steps,
            "follows": total["follows"] / steps,
            "collided": total["collided"] / ended,
            "met": total["met"] / ended,
            "contact": total["contact"] / steps,
            "steps_per_episode": steps / ended,
        }
