"""Social navigation with two learners, robot and person, as a PettingZoo parallel environment. Needs the extra ``env``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError, MissingExtraError
from h3data.scene import Scene
from sim_kinematic.env import Observations, action_space, episodes, infos, picture_from_above, run_seed
from sim_kinematic.observations import STATE_OBSERVATIONS, Observation, Observer, gymnasium
from sim_kinematic.rewards import RewardProfile
from sim_kinematic.social_nav_batch import TRAINING, SocialNavBatch, checked_actions
from sim_kinematic.spec import STEP_S, SocialNavSpec

if TYPE_CHECKING:
    from gymnasium.spaces import Space

try:
    import pettingzoo
except ImportError as error:
    raise MissingExtraError("Environments of two agents need PettingZoo. Hint: pip install 'h3data[env]'") from error


class SocialNavParallelEnv(pettingzoo.ParallelEnv[str, Any, Any]):
    """``robot`` and ``human`` act in every step, both by base velocity; both get the robot's reward.

    The person walks forwards only, as a disc that slides along obstacles. She sees what needs no picture, with herself in
    the robot's place: ``humanoid_gps`` is then the way to the robot. Scenes, episodes, seeds, actions and ends are those of
    `sim_kinematic.env.SocialNavEnv`.
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "name": "h3data_social_nav_v0",
        "render_modes": ["rgb_array"],
        "render_fps": round(1 / STEP_S),
    }

    def __init__(
        self,
        scenes: str | Scene | Sequence[str | Scene] = "h3-homes/train",
        *,
        observations: Sequence[Observation] = STATE_OBSERVATIONS,
        spec: SocialNavSpec = TRAINING,
        reward: RewardProfile = "paper",
        depth_size: tuple[int, int] | None = None,
        robot: str = "quad_arm",
        human: str = "female_0",
        render_mode: str | None = None,
    ) -> None:
        """As `SocialNavEnv`."""
        if render_mode not in (None, "rgb_array"):
            raise InputError(f"Unknown render mode {render_mode!r}. Expected rgb_array or None.")
        self.render_mode = render_mode
        self.batch = SocialNavBatch(scenes, spec=spec, reward=reward, robot=robot, human=human, driven_human=True)
        self._observer = Observer(self.batch, observations, depth_size=depth_size)
        self._seed, self._episode = 0, -1
        self.possible_agents = ["robot", "human"]
        self.agents: list[str] = []
        self.observation_spaces = {"robot": self._observer.space(), "human": self._observer.people_space()}
        self.action_spaces = {
            "robot": action_space(self.batch),
            "human": gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32),
        }

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
        self.agents = list(self.possible_agents)
        self.batch.begin(self._seed, self._episode)
        return self._observed(), self._informed(**{k: v[0] for k, v in episodes(self.batch).items()})

    def step(self, actions: dict[str, ArrayLike]) -> tuple[
        dict[str, Observations], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]
    ]:  # fmt: skip
        """Move both by their actions [2].

        Raises:
            InputError: one is missing, has another shape or is not finite; then nothing has moved.
        """
        if set(actions) != set(self.agents) or not self.agents:
            raise InputError(
                f"Expected actions of {', '.join(self.agents) or 'nobody: the episode is over, call reset()'}; got those of "
                f"{', '.join(map(str, actions)) or 'nobody'}."
            )
        robot = checked_actions(actions["robot"], (self.batch.action_width,))
        worth = self.batch.step(robot[None], checked_actions(actions["human"], (2,))[None])
        reward, terminated, truncated = float(worth.reward[0]), bool(worth.ends[0]), bool(self.batch.out_of_time[0])
        result = (
            self._observed(), dict.fromkeys(self.agents, reward), dict.fromkeys(self.agents, terminated),
            dict.fromkeys(self.agents, truncated), self._informed(),
        )  # fmt: skip
        if terminated or truncated:
            self.agents = []
        return result

    def render(self) -> NDArray[np.uint8] | None:
        """As `SocialNavEnv.render`."""
        return None if self.render_mode is None else picture_from_above(self.batch, self._observer)

    def close(self) -> None:
        """Nothing is held open."""

    def _observed(self) -> dict[str, Observations]:
        seen = {"robot": self._observer.observe(), "human": self._observer.observe_people()}
        return {agent: {name: array[0] for name, array in of.items()} for agent, of in seen.items()}

    def _informed(self, **more: Any) -> dict[str, dict[str, Any]]:
        info = {name: array[0] for name, array in infos(self.batch).items()}
        return {agent: {**info, **more} for agent in self.agents}
