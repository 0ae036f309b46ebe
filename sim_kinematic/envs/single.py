"""Gymnasium environment of any task, with one world and one agent; it needs the extra ``env``."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from sim_kinematic.envs.recipe import PickledEnv
from sim_kinematic.envs.stepper import Stepper, gymnasium
from sim_kinematic.motion.spec import STEP_S
from sim_kinematic.sensing.watching import DebugRenderer

Observations = dict[str, NDArray[Any]]
ALL = np.ones(1, np.bool_)
"""Mask that selects the only world."""


class TaskEnv(PickledEnv, gymnasium.Env[Any, Any]):
    """Environment of one world in which one agent acts.

    ``reset(seed=s)`` starts run ``s`` with its episode 0; every `reset` without a seed starts its next episode. The
    same seed gives the same scenes, starts and waypoints on every machine. ``info`` has the task's facts; `reset` adds
    ``scene`` and ``episode_seed``.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": round(1 / STEP_S)}  # type: ignore[misc]

    def __init__(self, stepper: Stepper, *, render_mode: str | None = None) -> None:
        """Make an environment of a stepper; with the ``render_mode`` ``rgb_array``, `render` gives pictures."""
        self.render_mode = checked_render_mode(render_mode)
        self.stepper = stepper
        (self.agent,) = stepper.agents
        self._watcher = DebugRenderer()
        # `reset` counts up before it begins, so that the first episode is number 0
        self._seed, self._episode = 0, -1
        self.observation_space = stepper.observation_space(self.agent)
        self.action_space = stepper.action_space(self.agent)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start the next episode, or with ``seed`` the first of another run; there are no ``options``.

        Raises:
            SceneError: No episode can be sampled in a scene.
        """
        # seeds Gymnasium's own generator, from which a run without a seed gets one
        super().reset(seed=seed)
        # the first reset begins a run even without a seed
        if seed is not None or self._episode < 0:
            self._seed, self._episode = run_seed(seed, self.np_random), -1
        self._episode += 1
        self.stepper.begin([self._seed], [self._episode], ALL)
        return self._observed(), {**self._informed(), **first(self.stepper.episode_info())}

    def step(self, action: ArrayLike) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Carry out an action.

        Raises:
            InputError: The action is malformed, or no episode is running; then nothing has moved.
        """
        reward, terminated, truncated = self.stepper.step({self.agent: one_row(action)})
        return self._observed(), float(reward[0]), bool(terminated[0]), bool(truncated[0]), self._informed()

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """Return a picture of the agent from obliquely above, uint8 [480, 640, 3]; None without a render mode."""
        return None if self.render_mode is None else self.stepper.picture(self.agent, self._watcher)

    def _observed(self) -> Observations:
        return first(self.stepper.observe(self.agent))

    def _informed(self) -> dict[str, Any]:
        return first(self.stepper.info(self.agent))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.stepper.describe()})"

    __str__ = __repr__


def run_seed(seed: int | None, rng: np.random.Generator) -> int:
    """Return the given seed, or one from Gymnasium's generator if there is none."""
    return int(rng.integers(2**63)) if seed is None else int(seed)


def checked_render_mode(mode: str | None) -> str | None:
    """Return a render mode, ``rgb_array`` or None.

    Raises:
        InputError: There is no such mode.
    """
    if mode not in (None, "rgb_array"):
        raise InputError(f"Unknown render mode {mode!r}. Expected rgb_array or None.", code="H3-ENV-024")
    return mode


def first(arrays: Any) -> Any:
    """Return the only world's row of an array, or of each array in a dictionary."""
    return {name: array[0] for name, array in arrays.items()} if isinstance(arrays, dict) else arrays[0]


def one_row(action: ArrayLike) -> NDArray[Any]:
    """Return an action of one world as a row of any type; the stepper raises an error if it is malformed."""
    try:
        # a torch tensor stays one, for the stepper to refuse
        return action if hasattr(action, "detach") else np.asarray(action)[None]  # type: ignore[return-value]
    except (TypeError, ValueError):
        return np.array([None], object)
