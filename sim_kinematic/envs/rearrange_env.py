"""Social rearrangement as a Gymnasium environment: one world, one agent. Needs the extra ``env``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.scene import Scene
from sim_kinematic.agents.robot_skills import checked_command
from sim_kinematic.agents.skills import CONTROL, Action, choices
from sim_kinematic.contact.frames import Body
from sim_kinematic.envs.social_nav_env import Observations, checked_render_mode, run_seed
from sim_kinematic.motion.spec import STEP_S
from sim_kinematic.policies.rearrange import HighLevelPolicy
from sim_kinematic.policies.rearrange_observations import STATE_SENSES, exact, limits
from sim_kinematic.sensing.agent_pictures import Limits, picture_names
from sim_kinematic.sensing.observation_set import ObservationSet, checked_names, gymnasium
from sim_kinematic.sensing.sensor import NoiseModel
from sim_kinematic.sensing.watching import Watcher
from sim_kinematic.tasks.rearrange.episode import RearrangeSpec
from sim_kinematic.tasks.rearrange.session import AGENTS, RearrangeSession
from sim_kinematic.tasks.rearrange.stage import RearrangeStage

Level = Literal["high", "low"]


class RearrangeEnv(gymnasium.Env[Any, Any]):
    """A robot and a person bring two objects to their goals; one of them acts, a policy moves the other (paper section 4.2).

    ``level="high"``: an action is one of `sim_kinematic.agents.skills.choices`, and a step lasts until its skill has ended, or, while
    the other agent is close, 1/30 s: then one may choose anew, and choosing the same goes on with it. What is infeasible does
    nothing for 1/30 s. ``level="low"`` (robots only): base velocity, arm joints and grip, 1/30 s.

    Terminated with success, or when the two touch; truncated after ``spec.max_steps`` (750). The reward is that of all steps
    that an action took, `sim_kinematic.tasks.rewards.RearrangeReward`. ``info``: ``steps`` that it took, ``step`` of the episode,
    ``outcome`` and ``reason`` of the skill, ``success``, ``collision``, ``at_goal``, ``held_by``, ``action_mask``; `reset`
    adds ``scene`` and ``episode_seed``. Seeds are as in `sim_kinematic.envs.social_nav_env.SocialNavEnv`.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": round(1 / STEP_S)}  # type: ignore[misc]

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
        depth_size: tuple[int, int] | None = None,
        rgb_size: tuple[int, int] | None = None,
        noise: Mapping[str, NoiseModel] | None = None,
        render_mode: str | None = None,
    ) -> None:
        """
        Args:
            scenes: As of `sim_kinematic.tasks.social_nav_batch.SocialNavBatch`.
            agent: Who acts: ``robot`` or ``human``.
            partner: Who moves the other one, as of `RearrangeSession`.
            level: ``high`` or ``low``.
            observations: Names in `sim_kinematic.policies.rearrange_observations.SENSES` and `agent_pictures.picture_names`;
                `PAPER_SENSES` are the paper's.
            spec: The rules.
            interrupts_when_close: Whether one may choose anew in every step while the other is close.
            robot: Name of a built-in robot.
            human: Name of a built-in body.
            depth_size: Width and height of depth, masks and boxes [pixels]; None is each camera's own.
            rgb_size: The same of colours.
            noise: Model by name of an observation, as `sim_kinematic.sensing.sensor.with_noise`; by default all are exact.
            render_mode: ``rgb_array`` for `render`, or None.

        Raises:
            InputError: there is no such thing.
        """
        self.render_mode = checked_render_mode(render_mode)
        self.session = RearrangeSession(
            scenes, agents=(agent,), partner=partner, spec=spec, interrupts_when_close=interrupts_when_close,
            robot=robot, human=human,
        )  # fmt: skip
        self.agent = agent
        self._stage, self._watcher = RearrangeStage(self.session), Watcher()
        (names,) = checked_names(observations, seen_by(self.session, agent), noise=noise or ())
        self._hand = Hand(
            self.session, self._stage, agent, level, names, depth_size=depth_size, rgb_size=rgb_size, noise=noise
        )
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

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """The agent and what is around it from obliquely above, uint8 [480, 640, 3]; None without a render mode."""
        return None if self.render_mode is None else self._watcher.picture(self._stage.posed(), AGENTS[self.agent])

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.session.words})"

    __str__ = __repr__


class Hand:
    """How one agent of a session acts and what it observes, in Gymnasium's terms."""

    def __init__(
        self, session: RearrangeSession, stage: RearrangeStage, agent: str, level: Level, observations: Sequence[str], *,
        depth_size: tuple[int, int] | None, rgb_size: tuple[int, int] | None, noise: Mapping[str, NoiseModel] | None,
    ) -> None:  # fmt: skip
        """As `RearrangeEnv`; observations as `checked_names` gives them."""
        if level not in get_args(Level):
            raise InputError(f"Unknown level {level!r}. Expected one of: {', '.join(get_args(Level))}.")
        if level == "low" and agent != "robot":
            raise InputError("Only a robot has a lower layer. Hint: level='high' for the person.")
        self._session, self._stage, self._agent, self._level = session, stage, agent, level
        self.choices = choices(session.spec.objects, robot=agent == "robot")
        self._set = ObservationSet(
            observations, _limits(session, agent), _body(session, agent), agent=AGENTS[agent], depth_size=depth_size,
            rgb_size=rgb_size, noise=noise,
        )  # fmt: skip
        self.observation_space = self._set.space()
        self.action_space: gymnasium.Space[Any] = (
            gymnasium.spaces.Discrete(len(self.choices))
            if level == "high"
            else gymnasium.spaces.Box(-1.0, 1.0, (len(session.robot.require_arm()) + 3,), np.float32)
        )

    def chosen(self, action: ArrayLike) -> Action:
        """What an action of `action_space` means.

        Raises:
            InputError: it is none.
        """
        if self._level == "low":
            return Action(CONTROL, command=tuple(checked_command(action, self._session.robot).tolist()))
        number = np.asarray(action)
        if number.shape != () or number.dtype.kind not in "iu" or not 0 <= number < len(self.choices):
            raise InputError(f"Expected the number of an action, 0 to {len(self.choices) - 1}, got {action!r}.")
        return self.choices[int(number)]

    def observe(self) -> Observations:
        """What the agent sees now."""
        play = self._session.play
        assert play is not None
        seen = {name: values[None] for name, values in exact(self._session.view(self._agent), self._set.states).items()}
        if self._set.pictures.names:
            seen |= self._set.take(self._stage.posed())
        shown = self._set.shown(seen, [play.world.seed], [play.steps])
        return {name: values[0] for name, values in shown.items()}

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


def seen_by(session: RearrangeSession, agent: str) -> tuple[str, ...]:
    """All observations of an agent."""
    return (*_limits(session, agent), *picture_names(_body(session, agent)))


def _limits(session: RearrangeSession, agent: str) -> dict[str, Limits]:
    """Spaces of those that are no pictures."""
    arm = len(session.robot.require_arm()) if agent == "robot" else 0
    return limits(objects=session.spec.objects, arm=arm)


def _body(session: RearrangeSession, agent: str) -> Body:
    return session.robot if agent == "robot" else session.human


def ends(session: RearrangeSession) -> tuple[bool, bool]:
    """Whether the episode is terminated, and whether it is truncated."""
    return session.ended in ("success", "collision"), session.ended == "max_steps"


def episode_info(session: RearrangeSession) -> dict[str, Any]:
    """Which episode it is."""
    assert session.play is not None
    world = session.play.world
    return {"scene": world.scene.name, "episode_seed": world.seed}


gymnasium.register(
    "h3data/Rearrange-v0",
    entry_point="sim_kinematic.envs.rearrange_env:RearrangeEnv",
    vector_entry_point="sim_kinematic.envs.rearrange_vector_env:RearrangeVectorEnv",
)
