"""Social rearrangement as a Gymnasium environment: one world, one agent. Needs the extra ``env``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from h3data.bodies import load_robot
from h3data.errors import InputError
from h3data.scene import Scene
from sim_kinematic.env import Observations, run_seed
from sim_kinematic.manipulation import arm_columns
from sim_kinematic.observations import gymnasium
from sim_kinematic.planners import HighLevelPolicy
from sim_kinematic.rearrange_episode import RearrangeSpec
from sim_kinematic.rearrange_observations import STATE_SENSES, bounds, observe
from sim_kinematic.rearrange_session import RearrangeSession
from sim_kinematic.robot_skills import checked_command
from sim_kinematic.skills import CONTROL, Action, choices
from sim_kinematic.spec import STEP_S

Level = Literal["high", "low"]


class RearrangeEnv(gymnasium.Env[Any, Any]):
    """A robot and a person bring two objects to their goals; one of them acts, a policy moves the other (paper section 4.2).

    ``level="high"``: an action is one of `sim_kinematic.skills.choices`, and a step lasts until its skill has ended, or, while
    the other agent is close, 1/30 s: then one may choose anew, and choosing the same goes on with it. What is infeasible does
    nothing for 1/30 s. ``level="low"`` (robots only): base velocity, arm joints and grip, 1/30 s.

    Terminated with success, or when the two touch; truncated after ``spec.max_steps`` (750). The reward is that of all steps
    that an action took, `sim_kinematic.rewards.RearrangeReward`. ``info``: ``steps`` that it took, ``step`` of the episode,
    ``outcome`` and ``reason`` of the skill, ``success``, ``collision``, ``at_goal``, ``held_by``, ``action_mask``; `reset`
    adds ``scene`` and ``episode_seed``. Seeds are as in `sim_kinematic.env.SocialNavEnv`.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": [], "render_fps": round(1 / STEP_S)}  # type: ignore[misc]

    def __init__(
        self,
        scenes: str | Scene | Sequence[str | Scene] = "h3-homes/train",
        *,
        agent: str = "robot",
        partner: str | Callable[[int], HighLevelPolicy] | None = None,
        level: Level = "high",
        observations: Sequence[str] = STATE_SENSES,
        spec: RearrangeSpec | None = None,
        interrupts_when_close: bool = True,
        robot: str = "quad_arm",
        human: str = "female_0",
        render_mode: str | None = None,
    ) -> None:
        """
        Args:
            scenes: As of `sim_kinematic.social_nav_batch.SocialNavBatch`.
            agent: Who acts: ``robot`` or ``human``.
            partner: Who moves the other one, as of `RearrangeSession`.
            level: ``high`` or ``low``.
            observations: Names in `sim_kinematic.rearrange_observations.SENSES`; `PAPER_SENSES` are the paper's.
            spec: The rules.
            interrupts_when_close: Whether one may choose anew in every step while the other is close.
            robot: Name of a built-in robot.
            human: Name of a built-in body.
            render_mode: None: there is none.

        Raises:
            InputError: there is no such thing.
        """
        if render_mode is not None:
            raise InputError(f"Unknown render mode {render_mode!r}. Expected None.")
        self.render_mode = render_mode
        self.session = RearrangeSession(
            scenes, agents=(agent,), partner=partner, spec=spec, interrupts_when_close=interrupts_when_close,
            robot=robot, human=human,
        )  # fmt: skip
        self.agent = agent
        self._hand = Hand(self.session, agent, level, observations)
        self.observation_space, self.action_space = self._hand.observation_space, self._hand.action_space
        self._seed, self._episode = 0, -1

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Begin the next episode, or with ``seed`` the first of another run. There are no ``options``.

        Raises:
            SceneError: a scene gives no episode.
        """
        super().reset(seed=seed)
        if seed is not None or self._episode < 0:
            self._seed, self._episode = run_seed(seed, self.np_random), -1
        self._episode += 1
        self.session.begin(self._seed, self._episode)
        return self._hand.observe(), {**self._hand.info(), **episode_info(self.session)}

    def step(self, action: ArrayLike) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Do ``action``.

        Raises:
            InputError: it is none, or no episode is going on; then nothing has moved.
        """
        session = self.session
        session.step({self.agent: self._hand.chosen(action)})
        terminated, truncated = ends(session)
        return self._hand.observe(), session.reward, terminated, truncated, self._hand.info()


class Hand:
    """How one agent of a session acts and what it observes, in Gymnasium's terms."""

    def __init__(self, session: RearrangeSession, agent: str, level: Level, observations: Sequence[str]) -> None:
        if level not in get_args(Level):
            raise InputError(f"Unknown level {level!r}. Expected one of: {', '.join(get_args(Level))}.")
        if level == "low" and agent != "robot":
            raise InputError("Only a robot has a lower layer. Hint: level='high' for the person.")
        self._session, self._agent, self._level = session, agent, level
        self._robot = load_robot(session.bodies[0])
        arm = len(arm_columns(self._robot)) if agent == "robot" else 0
        self.choices = choices(session.spec.objects, robot=agent == "robot")
        limits = bounds(observations, objects=session.spec.objects, arm=arm)
        self._names = tuple(limits)
        self.observation_space = gymnasium.spaces.Dict(
            {name: gymnasium.spaces.Box(low, high, dtype=np.float32) for name, (low, high) in limits.items()}
        )
        self.action_space: gymnasium.Space[Any] = (
            gymnasium.spaces.Discrete(len(self.choices))
            if level == "high"
            else gymnasium.spaces.Box(-1.0, 1.0, (arm + 3,), np.float32)
        )

    def chosen(self, action: ArrayLike) -> Action:
        """What an action of `action_space` means.

        Raises:
            InputError: it is none.
        """
        if self._level == "low":
            return Action(CONTROL, command=tuple(checked_command(action, self._robot).tolist()))
        number = np.asarray(action)
        if number.shape != () or number.dtype.kind not in "iu" or not 0 <= number < len(self.choices):
            raise InputError(f"Expected the number of an action, 0 to {len(self.choices) - 1}, got {action!r}.")
        return self.choices[int(number)]

    def observe(self) -> Observations:
        """What the agent sees now."""
        return observe(self._session.view(self._agent), self._names)

    def info(self) -> dict[str, Any]:
        """What is known beyond that."""
        session, play = self._session, self._session.play
        assert play is not None
        runner = session.runner(self._agent)
        ending = runner.ending
        mask = [not play.objects.why_not(runner.number, action) for action in self.choices]
        return {
            "steps": session.steps, "step": play.steps, "outcome": ending.outcome if ending else "running",
            "reason": ending.reason if ending else "", "success": session.ended == "success", "collision": play.collision,
            "at_goal": play.at_goal.copy(), "held_by": play.objects.held_by.copy(),
            "action_mask": np.array(mask, np.int8),
        }  # fmt: skip


def ends(session: RearrangeSession) -> tuple[bool, bool]:
    """Whether the episode is terminated, and whether it is truncated."""
    return session.ended in ("success", "collision"), session.ended == "max_steps"


def episode_info(session: RearrangeSession) -> dict[str, Any]:
    """Which episode it is."""
    assert session.play is not None
    world = session.play.world
    return {"scene": world.scene.name, "episode_seed": world.seed}


gymnasium.register("h3data/Rearrange-v0", entry_point="sim_kinematic.rearrange_env:RearrangeEnv")
