"""Social navigation with two learners, robot and person, as a PettingZoo parallel environment. Needs the extra ``env``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.scene import Scene
from sim_kinematic.envs.pair_env import Infos, PairEnv
from sim_kinematic.envs.social_nav_env import Observations, action_space, checked_render_mode, episodes, infos, watched
from sim_kinematic.envs.social_nav_observations import STATE_OBSERVATIONS, Observer, gymnasium
from sim_kinematic.motion.spec import STEP_S, SocialNavSpec
from sim_kinematic.motion.state import HUMAN, ROBOT
from sim_kinematic.sensing.sensor import NoiseModel
from sim_kinematic.sensing.watching import Watcher
from sim_kinematic.tasks.rewards import RewardProfile
from sim_kinematic.tasks.social_nav_batch import TRAINING, SocialNavBatch, checked_actions


class SocialNavParallelEnv(PairEnv):
    """``robot`` and ``human`` act in every step, both by base velocity; both get the robot's reward.

    The person walks forwards only, as a disc that slides along obstacles. Of the observations each has its own: she has no arm
    and no body cameras, but ``head_depth`` and ``head_rgb``; ``humanoid_gps`` is to her the way to the robot. Scenes,
    episodes, seeds, actions and ends are those of `sim_kinematic.envs.social_nav_env.SocialNavEnv`.
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
        observations: Sequence[str] = STATE_OBSERVATIONS,
        spec: SocialNavSpec = TRAINING,
        reward: RewardProfile = "paper",
        depth_size: tuple[int, int] | None = None,
        rgb_size: tuple[int, int] | None = None,
        noise: Mapping[str, NoiseModel] | None = None,
        robot: str = "quad_arm",
        human: str = "female_0",
        render_mode: str | None = None,
    ) -> None:
        """As `SocialNavEnv`."""
        self.render_mode = checked_render_mode(render_mode)
        self.batch = SocialNavBatch(scenes, spec=spec, reward=reward, robot=robot, human=human, driven_human=True)
        self._observer = Observer(
            self.batch, observations, depth_size=depth_size, rgb_size=rgb_size, noise=noise, people=True
        )
        self._watcher = Watcher()
        super().__init__(
            {"robot": self._observer.space(ROBOT), "human": self._observer.space(HUMAN)},
            {"robot": action_space(self.batch), "human": gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)},
        )

    def _begin(self, seed: int, episode: int) -> dict[str, Any]:
        self.batch.begin(seed, episode)
        return {name: array[0] for name, array in episodes(self.batch).items()}

    def _move(self, actions: dict[str, ArrayLike]) -> tuple[float, bool, bool]:
        robot = checked_actions(actions["robot"], (self.batch.action_width,))
        worth = self.batch.step(robot[None], checked_actions(actions["human"], (2,))[None])
        return float(worth.reward[0]), bool(worth.ends[0]), bool(self.batch.out_of_time[0])

    def render(self) -> NDArray[np.uint8] | None:
        """As `SocialNavEnv.render`."""
        return None if self.render_mode is None else watched(self.batch, self._observer, self._watcher)

    def _observed(self) -> dict[str, Observations]:
        seen = {"robot": self._observer.observe(ROBOT), "human": self._observer.observe(HUMAN)}
        return {agent: {name: array[0] for name, array in of.items()} for agent, of in seen.items()}

    def _informed(self) -> Infos:
        info = {name: array[0] for name, array in infos(self.batch).items()}
        return {agent: dict(info) for agent in self.agents}

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.batch.words})"

    __str__ = __repr__
