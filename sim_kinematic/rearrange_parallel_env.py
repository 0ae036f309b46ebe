"""Social rearrangement with two learners, robot and person, as a PettingZoo parallel environment. Needs the extra ``env``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from h3data.errors import InputError
from h3data.scene import Scene
from sim_kinematic.env import Observations, run_seed
from sim_kinematic.parallel_env import pettingzoo
from sim_kinematic.rearrange_env import Hand, Level, ends, episode_info
from sim_kinematic.rearrange_episode import RearrangeSpec
from sim_kinematic.rearrange_observations import STATE_SENSES
from sim_kinematic.rearrange_session import RearrangeSession
from sim_kinematic.spec import STEP_S

if TYPE_CHECKING:
    from gymnasium.spaces import Space


class RearrangeParallelEnv(pettingzoo.ParallelEnv[str, Any, Any]):
    """``robot`` and ``human`` both choose, and both get the same reward.

    Skills last differently long: a step lasts until one of the two has to choose. ``info[agent]["choosing"]`` says whose
    next action counts; that of the other, who is busy, is of no effect. When both have to choose at one moment and only the
    first was known to, the second is asked by a step of no length. With ``level="low"`` the robot acts by its lower layer in
    every 1/30 s; the person always chooses skills. All else is as in `sim_kinematic.rearrange_env.RearrangeEnv`.
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "name": "h3data_rearrange_v0",
        "render_modes": [],
        "render_fps": round(1 / STEP_S),
    }

    def __init__(
        self,
        scenes: str | Scene | Sequence[str | Scene] = "h3-homes/train",
        *,
        level: Level = "high",
        observations: Sequence[str] = STATE_SENSES,
        spec: RearrangeSpec | None = None,
        interrupts_when_close: bool = True,
        robot: str = "quad_arm",
        human: str = "female_0",
    ) -> None:
        """As `RearrangeEnv`; ``level`` is the robot's."""
        self.render_mode = None
        self.session = RearrangeSession(
            scenes, agents=("robot", "human"), spec=spec, interrupts_when_close=interrupts_when_close, robot=robot,
            human=human,
        )  # fmt: skip
        names = [name for name in observations if name != "arm_joints"]
        self._hands = {
            "robot": Hand(self.session, "robot", level, observations),
            "human": Hand(self.session, "human", "high", names if not isinstance(observations, str) else observations),
        }
        self._seed, self._episode = 0, -1
        self.possible_agents = ["robot", "human"]
        self.agents: list[str] = []
        self.observation_spaces = {name: hand.observation_space for name, hand in self._hands.items()}
        self.action_spaces = {name: hand.action_space for name, hand in self._hands.items()}

    def observation_space(self, agent: str) -> Space:
        """The space of an agent's observations, always the same object."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Space:
        """The space of an agent's actions, always the same object."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observations], dict[str, dict[str, Any]]]:
        """Begin the next episode, or with ``seed`` the first of another run. There are no ``options``."""
        if seed is not None or self._episode < 0:
            self._seed, self._episode = run_seed(seed, np.random.default_rng()), -1
        self._episode += 1
        self.session.begin(self._seed, self._episode)
        self.agents = list(self.possible_agents)
        return self._observed(), self._informed(**episode_info(self.session))

    def step(self, actions: dict[str, ArrayLike]) -> tuple[
        dict[str, Observations], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
    ]:  # fmt: skip
        """Give both their actions.

        Raises:
            InputError: one is missing or is none; then nothing has moved.
        """
        if set(actions) != set(self.agents) or not self.agents:
            raise InputError(
                f"Expected actions of {', '.join(self.agents) or 'nobody: the episode is over, call reset()'}; got those of "
                f"{', '.join(map(str, actions)) or 'nobody'}."
            )
        self.session.step({name: self._hands[name].chosen(action) for name, action in actions.items()})
        terminated, truncated = ends(self.session)
        result = (
            self._observed(), dict.fromkeys(self.agents, self.session.reward), dict.fromkeys(self.agents, terminated),
            dict.fromkeys(self.agents, truncated), self._informed(),
        )  # fmt: skip
        if terminated or truncated:
            self.agents = []
        return result

    def render(self) -> None:
        """There is no picture."""

    def close(self) -> None:
        """Nothing is held open."""

    def _observed(self) -> dict[str, Observations]:
        return {name: self._hands[name].observe() for name in self.agents}

    def _informed(self, **more: Any) -> dict[str, dict[str, Any]]:
        choosing = self.session.choosing
        return {name: {**self._hands[name].info(), "choosing": name in choosing, **more} for name in self.agents}
