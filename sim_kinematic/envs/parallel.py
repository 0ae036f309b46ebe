"""PettingZoo parallel environment of any task: one world in which several agents act; it needs the extra ``env``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError, MissingExtraError
from sim_kinematic.envs.recipe import PickledEnv
from sim_kinematic.envs.single import ALL, Observations, checked_render_mode, first, one_row, run_seed
from sim_kinematic.envs.stepper import Stepper
from sim_kinematic.motion.spec import STEP_S
from sim_kinematic.sensing.watching import DebugRenderer

if TYPE_CHECKING:
    from gymnasium.spaces import Space

try:
    import pettingzoo
except ImportError as error:
    raise MissingExtraError(
        "Environments of two agents need PettingZoo. Hint: pip install 'h3data[env]'", code="H3-ENV-021"
    ) from error


class TaskParallelEnv(PickledEnv, pettingzoo.ParallelEnv[str, Any, Any]):
    """Environment in which several agents act at every step and all get the same reward.

    In tasks with skills, which differ in duration, a step lasts until one agent must choose.
    ``info[agent]["choosing"]`` is true for agents whose next action counts; the action of a busy agent has no effect.
    If two agents must choose at the same moment but this was known only for the first one, a step of no duration asks
    the second one.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": round(1 / STEP_S)}  # type: ignore[misc]

    def __init__(self, stepper: Stepper, *, name: str, render_mode: str | None = None) -> None:
        """Make an environment of a stepper, for the task with this ``name``."""
        self.metadata = {**type(self).metadata, "name": f"h3data_{name}_v0"}  # type: ignore[misc]
        self.render_mode = checked_render_mode(render_mode)
        self.stepper = stepper
        self.possible_agents = list(stepper.agents)
        self.agents: list[str] = []
        self.observation_spaces = {agent: stepper.observation_space(agent) for agent in self.possible_agents}
        self.action_spaces = {agent: stepper.action_space(agent) for agent in self.possible_agents}
        self._watcher = DebugRenderer()
        self._seed, self._episode = 0, -1

    def observation_space(self, agent: str) -> Space:
        """Return the space of an agent's observations, always the same object."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Space:
        """Return the space of an agent's actions, always the same object."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observations], dict[str, dict[str, Any]]]:
        """Start the next episode, or with ``seed`` the first of another run; there are no ``options``."""
        # unlike Gymnasium's, environments of PettingZoo have no generator of their own
        if seed is not None or self._episode < 0:
            self._seed, self._episode = run_seed(seed, np.random.default_rng()), -1
        self._episode += 1
        self.stepper.begin([self._seed], [self._episode], ALL)
        self.agents = list(self.possible_agents)
        told = first(self.stepper.episode_info())
        return self._observed(), {agent: {**info, **told} for agent, info in self._informed().items()}

    def step(
        self, actions: dict[str, ArrayLike]
    ) -> tuple[dict[str, Observations], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Carry out the actions of all agents.

        Raises:
            InputError: An action is missing or malformed; then nothing has moved.
        """
        # two empty sets are equal: after the end, no actions would pass for the actions of nobody
        if set(actions) != set(self.agents) or not self.agents:
            raise InputError(
                f"Expected actions of {', '.join(self.agents) or 'nobody: the episode is over, call reset()'}; got those of "
                f"{', '.join(map(str, actions)) or 'nobody'}.",
                code="H3-ENV-022",
            )
        reward, terminated, truncated = self.stepper.step({agent: one_row(a) for agent, a in actions.items()})
        ends, stops = bool(terminated[0]), bool(truncated[0])
        each = (dict.fromkeys(self.agents, value) for value in (float(reward[0]), ends, stops))
        # put together before the agents are dropped, so that everybody gets their last observation
        result = (self._observed(), *each, self._informed())
        # PettingZoo's loops run while there are agents
        if ends or stops:
            self.agents = []
        return result  # type: ignore[return-value]

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture of the first agent and its surroundings, like `sim_kinematic.envs.single.TaskEnv.render`."""
        return None if self.render_mode is None else self.stepper.picture(self.possible_agents[0], self._watcher)

    def close(self) -> None:
        """Do nothing, since the environment holds no open resource."""

    def _observed(self) -> dict[str, Observations]:
        """Return the observations of all agents by name."""
        return {agent: first(self.stepper.observe(agent)) for agent in self.agents}

    def _informed(self) -> dict[str, dict[str, Any]]:
        """Return the facts for all agents by name."""
        return {agent: first(self.stepper.info(agent)) for agent in self.agents}

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.stepper.describe()})"

    __str__ = __repr__
