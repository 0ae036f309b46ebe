"""Social rearrangement with two learners, robot and person, as a PettingZoo parallel environment. Needs the extra ``env``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

from numpy.typing import ArrayLike

from h3data.scene import Scene
from sim_kinematic.env import Observations
from sim_kinematic.pair_env import Infos, PairEnv
from sim_kinematic.rearrange_env import Hand, Level, ends, episode_info
from sim_kinematic.rearrange_episode import RearrangeSpec
from sim_kinematic.rearrange_observations import STATE_SENSES
from sim_kinematic.rearrange_session import RearrangeSession
from sim_kinematic.spec import STEP_S


class RearrangeParallelEnv(PairEnv):
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

    def render(self) -> None:
        """There is no picture."""

    def _observed(self) -> dict[str, Observations]:
        return {name: self._hands[name].observe() for name in self.agents}

    def _informed(self) -> Infos:
        choosing = self.session.choosing
        return {name: {**self._hands[name].info(), "choosing": name in choosing} for name in self.agents}
