"""Social navigation as a Gymnasium environment: one world, one agent, the robot. Needs the extra ``env``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.scene import Scene
from sim_kinematic.envs.social_nav_observations import STATE_OBSERVATIONS, Observer, gymnasium
from sim_kinematic.motion.spec import STEP_S, SocialNavSpec
from sim_kinematic.sensing.sensor import NoiseModel
from sim_kinematic.sensing.watching import Watcher
from sim_kinematic.tasks.rewards import RewardProfile
from sim_kinematic.tasks.social_nav_batch import TRAINING, SocialNavBatch, checked_actions

Observations = dict[str, NDArray[Any]]


class SocialNavEnv(gymnasium.Env[Any, Any]):
    """A robot must find a walking person and follow her at 1-2 m, facing her (paper section 4.1 and appendix).

    Action: forward and left turn in -1..1 of 2.5 m/s and 2.5 rad/s, clipped. The episode is terminated when the two touch,
    truncated after ``spec.max_steps`` (1,500). ``info`` has ``geodesic_m``, ``found``, ``success``, ``followed`` (steps),
    ``collides``, ``robot_contact``; `reset` adds ``scene`` and ``episode_seed``.

    ``reset(seed=s)`` begins run ``s`` with its episode 0; every `reset` without a seed goes on to its next episode. The same
    seed gives the same scenes, starts and way points on every machine.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": round(1 / STEP_S)}  # type: ignore[misc]

    def __init__(
        self,
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
        render_mode: str | None = None,
    ) -> None:
        """
        Args:
            scenes: As `SocialNavBatch`.
            observations: Names of `sim_kinematic.envs.social_nav_observations.Observer`; `PAPER_OBSERVATIONS` are the paper's.
            spec: The rules; by default those of the paper's training.
            reward: ``paper`` or ``habitat``.
            end_on_success: Whether having followed long enough terminates the episode too.
            depth_size: Width and height of depth, masks and boxes [pixels]; None is each camera's own.
            rgb_size: The same of colours.
            noise: Model by name of an observation, as `sim_kinematic.sensing.sensor.with_noise`; by default all are exact.
            robot: Name of a built-in robot.
            human: Name of a built-in body.
            render_mode: ``rgb_array`` for `render`, or None.
        """
        self.render_mode = checked_render_mode(render_mode)
        self.batch = SocialNavBatch(scenes, spec=spec, reward=reward, robot=robot, human=human)
        self._observer = Observer(self.batch, observations, depth_size=depth_size, rgb_size=rgb_size, noise=noise)
        self._watcher = Watcher()
        self._end_on_success = end_on_success
        self._seed, self._episode = 0, -1
        self.observation_space = self._observer.space()
        self.action_space = action_space(self.batch)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Begin the next episode, or with ``seed`` the first of another run. There are no ``options``."""
        super().reset(seed=seed)
        if seed is not None or self._episode < 0:
            self._seed, self._episode = run_seed(seed, self.np_random), -1
        self._episode += 1
        self.batch.begin(self._seed, self._episode)
        return _first(self._observer.observe()), {**_first(infos(self.batch)), **_first(episodes(self.batch))}

    def step(self, action: ArrayLike) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Move by ``action`` [2].

        Raises:
            InputError: it has another shape or is not finite; then nothing has moved.
        """
        worth = self.batch.step(checked_actions(action, (self.batch.action_width,))[None])
        terminated = worth.ends | (self._end_on_success & self.batch.success)
        observed = _first(self._observer.observe())
        info = _first(infos(self.batch))
        return observed, float(worth.reward[0]), bool(terminated[0]), bool(self.batch.out_of_time[0]), info

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """The robot and what is around it from obliquely above, uint8 [480, 640, 3]; None without a render mode."""
        return None if self.render_mode is None else watched(self.batch, self._observer, self._watcher)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.batch.words})"

    __str__ = __repr__


def action_space(batch: SocialNavBatch) -> gymnasium.spaces.Box:
    """Base velocity of one robot in -1..1 of its limits, [2], or [3] where it can move sideways."""
    return gymnasium.spaces.Box(-1.0, 1.0, (batch.action_width,), np.float32)


def run_seed(seed: int | None, rng: np.random.Generator) -> int:
    """The seed that was given, else one from Gymnasium's generator."""
    return int(rng.integers(2**63)) if seed is None else int(seed)


def infos(batch: SocialNavBatch) -> dict[str, NDArray[Any]]:
    """What is known beyond the observations, [W] each."""
    return {
        "geodesic_m": batch.geodesic.copy(),
        "found": batch.found.copy(),
        "success": batch.success.copy(),
        "followed": batch.rewards.followed.copy(),
        "collides": batch.collides.copy(),
        "robot_contact": batch.state.robots[0].contact.copy(),
    }


def episodes(batch: SocialNavBatch) -> dict[str, NDArray[Any]]:
    """Which episode each world plays, [W] each."""
    return {
        "scene": np.array([e.scene.name for e in batch.episodes], object),
        "episode_seed": np.array([e.seed for e in batch.episodes], np.int64),
    }


def watched(batch: SocialNavBatch, observer: Observer, watcher: Watcher) -> NDArray[np.uint8]:
    """The robot of the only world as `Watcher` sees it."""
    if not batch.episodes:
        raise InputError("No episode has begun. Hint: call reset() first.")
    return watcher.picture(observer.posed(np.array([0])))


def checked_render_mode(mode: str | None) -> str | None:
    """``rgb_array`` or None.

    Raises:
        InputError: it is another.
    """
    if mode not in (None, "rgb_array"):
        raise InputError(f"Unknown render mode {mode!r}. Expected rgb_array or None.")
    return mode


def _first(arrays: dict[str, NDArray[Any]]) -> dict[str, Any]:
    return {name: array[0] for name, array in arrays.items()}


gymnasium.register(
    "h3data/SocialNav-v0",
    entry_point="sim_kinematic.envs.social_nav_env:SocialNavEnv",
    vector_entry_point="sim_kinematic.envs.social_nav_vector_env:SocialNavVectorEnv",
)
