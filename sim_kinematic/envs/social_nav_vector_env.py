"""Social navigation as a Gymnasium vector environment: W worlds stepped together. Needs the extra ``env``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.scene import Scene
from sim_kinematic.envs.social_nav_env import Observations, action_space, episodes, infos, run_seed
from sim_kinematic.envs.social_nav_observations import STATE_OBSERVATIONS, Observer, gymnasium
from sim_kinematic.motion.spec import STEP_S, SocialNavSpec
from sim_kinematic.sensing.sensor import NoiseModel
from sim_kinematic.tasks.rewards import RewardProfile
from sim_kinematic.tasks.social_nav_batch import TRAINING, SocialNavBatch


class SocialNavVectorEnv(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """W worlds of `sim_kinematic.envs.social_nav_env.SocialNavEnv`: world w after ``reset(seed=s)`` is the single one after ``s + w``.

    Autoreset is Gymnasium's NEXT_STEP: the step after a world's last ignores its action, begins its next episode, gives
    the first observation of that and a reward of 0.
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": [],
        "render_fps": round(1 / STEP_S),
        "autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        scenes: str | Scene | Sequence[str | Scene] = "h3-homes/train",
        *,
        observations: Sequence[str] = STATE_OBSERVATIONS,
        spec: SocialNavSpec = TRAINING,
        reward: RewardProfile = "paper",
        end_on_success: bool = False,
        depth_size: tuple[int, int] | None = None,
        rgb_size: tuple[int, int] | None = None,
        noise: Mapping[str, NoiseModel] | None = None,
        robot: str = "quad_arm",
        human: str = "female_0",
        threads: int = 1,
    ) -> None:
        """``num_envs`` is W; ``threads`` draw pictures. The rest is as in `SocialNavEnv`."""
        self.batch = SocialNavBatch(scenes, worlds=num_envs, spec=spec, reward=reward, robot=robot, human=human)
        self.num_envs = self.batch.worlds
        self._observer = Observer(
            self.batch, observations, depth_size=depth_size, rgb_size=rgb_size, noise=noise, threads=threads
        )
        self._end_on_success = end_on_success
        self._seeds = np.zeros(self.num_envs, object)  # Python's whole numbers: seeds may have any size
        self._indices = np.full(self.num_envs, -1)
        self._ended = np.zeros(self.num_envs, np.bool_)
        self.single_observation_space = self._observer.space()
        self.single_action_space = action_space(self.batch)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, self.num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:  # type: ignore[override]
        """Begin the next episode in all worlds; with a seed the first of the runs seed, seed + 1, ..., or of those listed."""
        single = seed if isinstance(seed, int | np.integer) else None
        super().reset(seed=None if single is None else int(single))
        listed: Sequence[int | None]
        if single is not None:
            listed = [int(single) + w for w in range(self.num_envs)]
        else:
            listed = [None] * self.num_envs if seed is None else list(seed)  # type: ignore[arg-type]
        if len(listed) != self.num_envs:
            raise InputError(f"Expected one seed, or one for each of {self.num_envs} worlds, got {len(listed)}.")
        for w, given in enumerate(listed):
            if given is not None or self._indices[w] < 0:
                self._seeds[w], self._indices[w] = run_seed(given, self.np_random), -1
        self._indices += 1
        self._ended[:] = False
        self.batch.begin(self._seeds, self._indices)
        return self._observer.observe(), _masked({**infos(self.batch), **episodes(self.batch)})

    def step(
        self, actions: ArrayLike
    ) -> tuple[Observations, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:  # type: ignore[override]
        """Move all worlds by ``actions`` [W, 2], or begin their next episode.

        Raises:
            InputError: the actions have another shape or are not finite; then nothing has moved.
        """
        again = self._ended
        worth = self.batch.step(actions)
        going = ~again
        if again.any():
            self._indices[again] += 1
            self.batch.begin(self._seeds, self._indices, where=again)
        terminated = going & (worth.ends | (self._end_on_success & self.batch.success))
        truncated = going & self.batch.out_of_time
        self._ended = terminated | truncated
        info = infos(self.batch)
        if again.any():
            info |= episodes(self.batch)
        return self._observer.observe(), np.where(going, worth.reward, 0.0), terminated, truncated, _masked(info)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.batch.words})"

    __str__ = __repr__


def _masked(info: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Gymnasium's form: beside each array, under ``_name``, in which worlds it holds, here in all."""
    return {**info, **{f"_{name}": np.ones(len(array), np.bool_) for name, array in info.items()}}
