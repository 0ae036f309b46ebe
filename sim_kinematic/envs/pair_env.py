"""What PettingZoo's environments of robot and person share: spaces, seeds, order of calls. Needs the extra ``env``."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from h3data.errors import InputError, MissingExtraError
from sim_kinematic.envs.social_nav_env import Observations, run_seed

if TYPE_CHECKING:
    from gymnasium.spaces import Space

try:
    import pettingzoo
except ImportError as error:
    raise MissingExtraError("Environments of two agents need PettingZoo. Hint: pip install 'h3data[env]'") from error

Infos = dict[str, dict[str, Any]]


class PairEnv(pettingzoo.ParallelEnv[str, Any, Any]):
    """``robot`` and ``human`` act in every step, and both get the same reward."""

    def __init__(self, observation_spaces: dict[str, Space], action_spaces: dict[str, Space]) -> None:
        """The spaces of ``robot`` and ``human``."""
        self.possible_agents = ["robot", "human"]
        self.agents: list[str] = []
        self.observation_spaces, self.action_spaces = observation_spaces, action_spaces
        self._seed, self._episode = 0, -1

    @abstractmethod
    def _begin(self, seed: int, episode: int) -> dict[str, Any]:
        """Begin an episode of the run of a seed; what `reset` tells of it."""

    @abstractmethod
    def _move(self, actions: dict[str, ArrayLike]) -> tuple[float, bool, bool]:
        """Move both: reward, whether the episode is over, whether its time is up."""

    @abstractmethod
    def _observed(self) -> dict[str, Observations]: ...

    @abstractmethod
    def _informed(self) -> Infos: ...

    def observation_space(self, agent: str) -> Space:
        """The space of an agent's observations, always the same object."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Space:
        """The space of an agent's actions, always the same object."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observations], Infos]:
        """Begin the next episode, or with ``seed`` the first of another run. There are no ``options``."""
        if seed is not None or self._episode < 0:
            self._seed, self._episode = run_seed(seed, np.random.default_rng()), -1
        self._episode += 1
        told = self._begin(self._seed, self._episode)
        self.agents = list(self.possible_agents)
        return self._observed(), {agent: {**info, **told} for agent, info in self._informed().items()}

    def step(
        self, actions: dict[str, ArrayLike]
    ) -> tuple[dict[str, Observations], dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Give both their actions.

        Raises:
            InputError: one is missing or is none; then nothing has moved.
        """
        if set(actions) != set(self.agents) or not self.agents:
            raise InputError(
                f"Expected actions of {', '.join(self.agents) or 'nobody: the episode is over, call reset()'}; got those of "
                f"{', '.join(map(str, actions)) or 'nobody'}."
            )
        reward, terminated, truncated = self._move(actions)
        each = (dict.fromkeys(self.agents, value) for value in (reward, terminated, truncated))
        result = (self._observed(), *each, self._informed())
        if terminated or truncated:
            self.agents = []
        return result  # type: ignore[return-value]

    def close(self) -> None:
        """Nothing is held open."""
