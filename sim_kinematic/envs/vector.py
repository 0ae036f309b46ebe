"""Any task as a Gymnasium vector environment: W worlds, one agent in each. Needs the extra ``env``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from sim_kinematic.envs.recipe import PickledEnv
from sim_kinematic.envs.single import Observations, checked_render_mode, run_seed
from sim_kinematic.envs.stepper import Info, Stepper, gymnasium
from sim_kinematic.motion.spec import STEP_S
from sim_kinematic.sensing.watching import DebugRenderer


class TaskVectorEnv(PickledEnv, gymnasium.vector.VectorEnv[Any, Any, Any]):
    """W worlds of `sim_kinematic.envs.single.TaskEnv`: world w after ``reset(seed=s)`` is the single one after ``s + w``.

    Autoreset is Gymnasium's NEXT_STEP: the step after a world's last ignores its action, begins its next episode, gives
    the first observation of that and a reward of 0.
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": ["rgb_array"],
        "render_fps": round(1 / STEP_S),
        "autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP,
    }

    def __init__(self, stepper: Stepper, *, render_mode: str | None = None) -> None:
        """``render_mode``: ``rgb_array`` for `render`, or None."""
        self.render_mode = checked_render_mode(render_mode)
        self.stepper = stepper
        self.num_envs = stepper.worlds
        self._watchers = [DebugRenderer() for _ in range(self.num_envs)]
        (self.agent,) = stepper.agents
        self._seeds = np.zeros(self.num_envs, object)  # Python's whole numbers: seeds may have any size
        self._indices = np.full(self.num_envs, -1)
        self._ended = np.zeros(self.num_envs, np.bool_)
        self.single_observation_space = stepper.observation_space(self.agent)
        self.single_action_space = stepper.action_space(self.agent)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, self.num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:  # type: ignore[override]
        """Begins the next episode in all worlds; with a seed the first of the runs seed, seed + 1, ..., or of those listed."""
        single = seed if isinstance(seed, int | np.integer) else None
        super().reset(seed=None if single is None else int(single))
        listed: Sequence[int | None]
        if single is not None:
            listed = [int(single) + w for w in range(self.num_envs)]
        else:
            listed = [None] * self.num_envs if seed is None else list(seed)  # type: ignore[arg-type]
        if len(listed) != self.num_envs:
            raise InputError(
                f"Expected one seed, or one for each of {self.num_envs} worlds, got {len(listed)}.", code="H3-ENV-032"
            )
        for w, given in enumerate(listed):
            if given is not None or self._indices[w] < 0:
                self._seeds[w], self._indices[w] = run_seed(given, self.np_random), -1
        self._indices += 1
        self._ended[:] = False
        self.stepper.begin(self._seeds, self._indices, np.ones(self.num_envs, np.bool_))  # type: ignore[arg-type]
        return self.stepper.observe(self.agent), _masked(self._info(episodes=True))

    def step(
        self, actions: ArrayLike
    ) -> tuple[Observations, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:  # type: ignore[override]
        """Acts in all worlds, or begins their next episode.

        Raises:
            InputError: the actions are malformed; then nothing has moved.
        """
        again = self._ended
        going, none = ~again, np.zeros(self.num_envs)
        # where all begin their next episode, nobody acts
        reward, terminated, truncated = (
            self.stepper.step({self.agent: actions}) if going.any() else (none, none > 0, none > 0)
        )
        if again.any():
            self._indices[again] += 1
            self.stepper.begin(self._seeds, self._indices, again)  # type: ignore[arg-type]
        terminated, truncated = going & terminated, going & truncated
        self._ended = terminated | truncated
        info = _masked(self._info(episodes=bool(again.any())))
        return self.stepper.observe(self.agent), np.where(going, reward, 0.0), terminated, truncated, info

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:  # type: ignore[override]
        """Each world's agent and its surroundings, W pictures as `sim_kinematic.envs.single.TaskEnv.render`."""
        if self.render_mode is None:
            return None
        return tuple(self.stepper.picture(self.agent, watcher, w) for w, watcher in enumerate(self._watchers))

    def _info(self, *, episodes: bool) -> Info:
        info = self.stepper.info(self.agent)
        return info | self.stepper.episode_info() if episodes else info

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.stepper.describe()})"

    __str__ = __repr__


def _masked(info: Info) -> dict[str, Any]:
    """Gymnasium's form: beside each array, under ``_name``, in which worlds it holds, here in all."""
    return {**info, **{f"_{name}": np.ones(len(array), np.bool_) for name, array in info.items()}}
