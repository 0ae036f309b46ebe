"""Environment `h3data.envs.DatasetEnv` in the form that LeRobot expects."""

from __future__ import annotations

import os
from functools import partial
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.envs import DatasetEnv

STATE, PIXELS = "agent_pos", "pixels"
"""Keys that LeRobot turns into ``observation.state`` and ``observation.images.CAMERA``."""
PREFIX = "observation.images."


class LeRobotEnv(gymnasium.Env[Any, Any]):
    """Environment of one world for a policy that LeRobot has trained.

    Observations are ``agent_pos`` [S] float32 and, where there are cameras, ``pixels`` {CAMERA: uint8 [H, W, 3]}.
    """

    metadata: ClassVar[dict[str, Any]] = dict(DatasetEnv.metadata)  # type: ignore[misc]

    def __init__(
        self, dataset: str | os.PathLike[str], *, render_mode: str | None = "rgb_array", **options: Any
    ) -> None:
        """Create the environment; the arguments are those of `DatasetEnv`.

        Raises:
            InputError: the dataset cannot be played.
        """
        self.env = DatasetEnv(dataset, render_mode=render_mode, **options)
        self._record, self.render_mode = self.env.record, render_mode
        self.action_space = self.env.action_space
        shown: Any = self.env.observation_space
        self.observation_space = gymnasium.spaces.Dict(_sorted(dict(shown.spaces), gymnasium.spaces.Dict))
        self.task, self.task_description = self.env.task, self.env.task_description
        self._max_episode_steps = self.env.max_episode_steps

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin the next episode; ``options`` have no effect.

        Episodes without a seed are those that worlds begin by themselves while others still play. LeRobot does not count them,
        so they are not recorded.
        """
        self.env.record = self._record if seed is not None else None
        shown, info = self.env.reset(seed=seed)
        return _sorted(shown, dict), info

    def step(self, action: ArrayLike) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Act for 1/30 s; ``info["is_success"]`` states whether the episode has succeeded so far.

        Raises:
            InputError: the action has another shape or a number that is not finite; then nothing has moved.
        """
        shown, *rest = self.env.step(action)
        return (_sorted(shown, dict), *rest)  # type: ignore[return-value]

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """Return a picture for people who watch, uint8 [480, 640, 3]."""
        return self.env.render()

    def __repr__(self) -> str:
        return f"LeRobotEnv({self.env!r})"


def make_vector(
    dataset: str | os.PathLike[str], n_envs: int = 1, use_async_envs: bool = False, **options: Any
) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
    """Make the vector environment that LeRobot's loop of evaluation steps; options are those of `LeRobotEnv`."""
    makers = [partial(LeRobotEnv, dataset, **options)] * n_envs
    mode = gymnasium.vector.AutoresetMode.SAME_STEP
    if use_async_envs and n_envs > 1:
        return gymnasium.vector.AsyncVectorEnv(makers, context="forkserver", autoreset_mode=mode)
    return gymnasium.vector.SyncVectorEnv(makers, autoreset_mode=mode)


def _sorted(shown: dict[str, Any], kind: Any) -> dict[str, Any]:
    """Put what a `DatasetEnv` shows under LeRobot's keys."""
    pictures = {name.removeprefix(PREFIX): value for name, value in shown.items() if name.startswith(PREFIX)}
    (state,) = (value for name, value in shown.items() if not name.startswith(PREFIX))
    return {STATE: state, PIXELS: kind(pictures)} if pictures else {STATE: state}
