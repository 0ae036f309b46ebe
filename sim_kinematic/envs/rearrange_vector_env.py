"""Social rearrangement as a Gymnasium vector environment: worlds stepped one after the other. Needs the extra ``env``."""

from __future__ import annotations

from functools import partial
from typing import Any

from h3data.errors import InputError
from sim_kinematic.envs.rearrange_env import RearrangeEnv
from sim_kinematic.envs.social_nav_env import Observations
from sim_kinematic.sensing.observation_set import gymnasium
from sim_kinematic.tasks.describe import bar


class RearrangeVectorEnv(gymnasium.vector.SyncVectorEnv):
    """W worlds of `RearrangeEnv`: world w after ``reset(seed=s)`` is the single one after ``s + w``. Autoreset is Gymnasium's
    NEXT_STEP."""

    def __init__(self, num_envs: int, *args: Any, **options: Any) -> None:
        """``num_envs`` is W; the rest is as in `RearrangeEnv`.

        Raises:
            InputError: an option is none, or W is not at least 1.
        """
        if isinstance(num_envs, bool) or not isinstance(num_envs, int) or num_envs < 1:
            raise InputError(f"Expected at least 1 world (num_envs), a whole number, got {num_envs!r}.")
        super().__init__([partial(RearrangeEnv, *args, **options)] * num_envs)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Observations, dict[str, Any]]:
        """Begin the next episode in all worlds; with a seed the first of the runs seed, seed + 1, ..., or of those listed. A
        bar says how far it is: drawing an episode may take a second."""
        with bar("episodes", self.num_envs, "episode") as begun:
            for env in self._worlds:
                env.session.on_begin = begun.update
            try:
                return super().reset(seed=seed, options=options)  # type: ignore[return-value]
            finally:
                for env in self._worlds:
                    env.session.on_begin = lambda: None

    @property
    def _worlds(self) -> list[RearrangeEnv]:
        return self.envs  # type: ignore[return-value]

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._worlds[0].session.in_words(self.num_envs)})"

    __str__ = __repr__
