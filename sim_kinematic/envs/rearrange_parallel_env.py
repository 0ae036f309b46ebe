"""Social rearrangement with two learners, robot and person, as a PettingZoo parallel environment. Needs the extra ``env``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.scene import Scene
from sim_kinematic.envs.pair_env import Infos, PairEnv
from sim_kinematic.envs.rearrange_env import Hand, Level, ends, episode_info, seen_by
from sim_kinematic.envs.social_nav_env import Observations, checked_render_mode
from sim_kinematic.motion.spec import STEP_S
from sim_kinematic.policies.rearrange_observations import STATE_SENSES
from sim_kinematic.sensing.observation_set import checked_names
from sim_kinematic.sensing.sensor import NoiseModel
from sim_kinematic.sensing.watching import Watcher
from sim_kinematic.tasks.rearrange.episode import RearrangeSpec
from sim_kinematic.tasks.rearrange.session import RearrangeSession
from sim_kinematic.tasks.rearrange.stage import RearrangeStage


class RearrangeParallelEnv(PairEnv):
    """``robot`` and ``human`` both choose, and both get the same reward.

    Skills last differently long: a step lasts until one of the two has to choose. ``info[agent]["choosing"]`` says whose
    next action counts; that of the other, who is busy, is of no effect. When both have to choose at one moment and only the
    first was known to, the second is asked by a step of no length. With ``level="low"`` the robot acts by its lower layer in
    every 1/30 s; the person always chooses skills. All else is as in `sim_kinematic.envs.rearrange_env.RearrangeEnv`.
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "name": "h3data_rearrange_v0",
        "render_modes": ["rgb_array"],
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
        depth_size: tuple[int, int] | None = None,
        rgb_size: tuple[int, int] | None = None,
        noise: Mapping[str, NoiseModel] | None = None,
        render_mode: str | None = None,
    ) -> None:
        """As `RearrangeEnv`; ``level`` is the robot's, and of the observations each has its own."""
        self.render_mode = checked_render_mode(render_mode)
        self.session = RearrangeSession(
            scenes, agents=("robot", "human"), spec=spec, interrupts_when_close=interrupts_when_close, robot=robot,
            human=human,
        )  # fmt: skip
        self._stage, self._watcher = RearrangeStage(self.session), Watcher()
        known = [seen_by(self.session, name) for name in self.session.agents]
        chosen = checked_names(observations, *known, noise=noise or ())
        self._hands = {
            name: Hand(
                self.session, self._stage, name, level if name == "robot" else "high", own, depth_size=depth_size,
                rgb_size=rgb_size, noise=noise,
            )
            for name, own in zip(self.session.agents, chosen, strict=True)
        }  # fmt: skip
        super().__init__(
            {name: hand.observation_space for name, hand in self._hands.items()},
            {name: hand.action_space for name, hand in self._hands.items()},
        )

    def _begin(self, seed: int, episode: int) -> dict[str, Any]:
        self.session.begin(seed, episode)
        return episode_info(self.session)

    def _move(self, actions: dict[str, ArrayLike]) -> tuple[float, bool, bool]:
        self.session.step({name: self._hands[name].chosen(action) for name, action in actions.items()})
        return self.session.reward, *ends(self.session)

    def render(self) -> NDArray[np.uint8] | None:
        """The robot, as `RearrangeEnv.render`."""
        return None if self.render_mode is None else self._watcher.picture(self._stage.posed())

    def _observed(self) -> dict[str, Observations]:
        return {name: self._hands[name].observe() for name in self.agents}

    def _informed(self) -> Infos:
        choosing = self.session.choosing
        return {name: {**self._hands[name].info(), "choosing": name in choosing} for name in self.agents}

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.session.words})"

    __str__ = __repr__
