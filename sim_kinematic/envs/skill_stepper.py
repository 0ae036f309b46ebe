"""One world of rearrangement, stepped by an environment.

On the upper layer an action is a skill, and a step of the environment lasts until the agent must choose again. On the
lower layer it lasts one step of the simulation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies import load_robot
from h3data.errors import InputError
from h3data.geometry import Array
from h3data.render.light.sources import LightMode
from sim_kinematic.agents.robots.skills import checked_command
from sim_kinematic.agents.roster import HUMAN_BODY, ROBOT_BODY
from sim_kinematic.agents.skills import CONTROL, Action, choices
from sim_kinematic.contact.frames import Body
from sim_kinematic.envs.stepper import DEFAULTS, Info, Options, gymnasium
from sim_kinematic.policies.assignment import policy_names, resolve_policy, unknown_policy
from sim_kinematic.policies.policy import External
from sim_kinematic.policies.rearrange import HighLevelPolicy
from sim_kinematic.policies.rearrange_observations import STATE_SENSES, exact, limits
from sim_kinematic.sensing.agent_pictures import Limits, camera_names, picture_names
from sim_kinematic.sensing.observation_set import Arrays, ObservationSet, checked_names, split_sizes
from sim_kinematic.tasks.describe import in_words
from sim_kinematic.tasks.rearrange.play import SkillExecutor, SkillRollout
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.runner import DecisionLoop, rollout
from sim_kinematic.tasks.sources import EpisodeSource, Scenes

if TYPE_CHECKING:
    from gymnasium.spaces import Dict, Space

    from sim_kinematic.sensing.camera_sensor import StateRenderer
    from sim_kinematic.sensing.watching import DebugRenderer

Level = Literal["high", "low"]
KINDS = ("robot", "human")


class SkillStepper:
    """Stepper of one world of rearrangement."""

    worlds = 1

    def __init__(
        self,
        task: Rearrange,
        scenes: Scenes,
        *,
        agents: Sequence[str] = ("robot",),
        partner: str | Callable[[int], HighLevelPolicy] | None = None,
        level: Level = "high",
        observations: Sequence[str] | None = None,
        spec: Any = None,
        interrupts_when_close: bool = True,
        robot: str = ROBOT_BODY,
        human: str = HUMAN_BODY,
        options: Options = DEFAULTS,
    ) -> None:
        """Opens scenes and agents of a rearrangement environment.

        Args:
            task: the task.
            scenes: as for `EpisodeSource`.
            agents: agents that act: ``robot``, ``human`` or both.
            partner: policy of the other agent: the name of a partner or robot policy, ``weights:FILE``, or a function that
                makes one from an episode's seed. By default ``plan_pop_4`` with a robot and ``complement`` with a person.
            level: ``high``: actions are skills; ``low``: the robot's base velocity, arm joints and grip.
            observations: names in `sim_kinematic.policies.rearrange_observations.SENSES` and of pictures.
            spec: rules of the task.
            interrupts_when_close: whether acting agents may choose again at every step while the other agent is close.
            robot: body of the robot.
            human: body of the person.
            options: pictures and noise.

        Raises:
            InputError: a name does not exist.
        """
        if not agents or not set(agents) <= set(KINDS) or len(set(agents)) < len(agents):
            raise InputError(f"Expected agents 'robot', 'human' or both, got {agents!r}.", code="H3-ENV-002")
        if level not in get_args(Level):
            raise InputError(
                f"Unknown level {level!r}. Expected one of: {', '.join(get_args(Level))}.", code="H3-ENV-025"
            )
        if level == "low" and "robot" not in agents:
            raise InputError("Only a robot has a lower layer. Hint: level='high' for the person.", code="H3-ENV-026")
        if len(agents) == len(KINDS) and partner is not None:
            raise InputError(
                "Both agents are told from outside, so there is no partner. Hint: leave out partner.", code="H3-ENV-003"
            )
        self.task, self.agents = task, tuple(agents)
        self.source = EpisodeSource(task, scenes, spec=spec, robot=robot, human=human)
        self.spec = self.source.spec
        self._bodies: dict[str, Body] = {member.kind: member.body for member in self.source.roster}
        self._robot = load_robot(self.source.roster[0].model)
        self._partner = partner if partner is not None else "plan_pop_4" if "robot" in agents else "complement"
        self._interrupts, self._level = interrupts_when_close, level
        if len(agents) < len(KINDS) and isinstance(self._partner, str):
            self._check_partner("human" if "robot" in agents else "robot", self._partner)
        self._choices = {agent: choices(self.spec.objects, robot=agent == "robot") for agent in self.agents}
        self._sets = self._observation_sets(observations or STATE_SENSES, options)
        self._light: LightMode = options.light
        self._stage = Stage()
        self.play: SkillRollout | None = None
        self._turns: DecisionLoop | None = None
        self._steps, self._reward = 0, 0.0

    # --- spaces -------------------------------------------------------------------------------------------------------
    def observation_space(self, agent: str) -> Dict:
        """Space of an agent's observations."""
        return self._sets[agent].space()

    def action_space(self, agent: str) -> Space[Any]:
        """The number of a choice; on the lower layer base [2], arm joints [n] and grip [1] in -1..1."""
        if self._level == "high" or agent != "robot":
            return gymnasium.spaces.Discrete(len(self._choices[agent]))
        return gymnasium.spaces.Box(-1.0, 1.0, (len(self._robot.require_arm()) + 3,), np.float32)

    # --- episodes -----------------------------------------------------------------------------------------------------
    def begin(self, seeds: Sequence[int], indices: Sequence[int], where: NDArray[np.bool_]) -> None:
        """Samples the next episode and plays it until an agent that acts must choose."""
        del where
        episode = self.source.sample(int(seeds[0]), int(indices[0]))
        chosen: dict[str, Any] = {agent: External(interrupts_when_close=self._interrupts) for agent in self.agents}
        for kind in KINDS:
            if kind not in chosen:
                chosen[kind] = self._partner if isinstance(self._partner, str) else self._partner(episode.seed)
        play = rollout(self.task, episode, chosen)
        assert isinstance(play, SkillRollout)
        self.play, self._turns = play, DecisionLoop(play)
        self._steps, self._reward = 0, 0.0
        self._go_on({})
        self._steps, self._reward = 0, 0.0

    @property
    def is_over(self) -> bool:
        """Returns whether the episode has ended."""
        return self._turns is not None and self._turns.over

    def step(self, actions: Mapping[str, Any]) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """Plays until an agent that acts must choose again, or to the end of the episode.

        Actions are given to the agents that are `choosing`; those of busy agents have no effect.
        """
        play = self._playing()
        choosing = self.choosing
        chosen = {}
        for agent, action in actions.items():
            choice = self._chosen(agent, action)
            if agent in choosing:
                chosen[KINDS.index(agent)] = self.task.control.checked(play, KINDS.index(agent), choice)
        self._steps, self._reward = 0, 0.0
        self._go_on(chosen)
        ended = play.ended if self.is_over else ""
        return (
            np.array([self._reward]),
            np.array([ended in ("success", "collision")]),
            np.array([ended == "max_steps"]),
        )

    @property
    def last_steps(self) -> int:
        """Simulated steps of the last `step`."""
        return self._steps

    @property
    def choosing(self) -> tuple[str, ...]:
        """Agents outside whose next action counts: the one that must choose, and those that will in this very step."""
        if self.play is None or self._turns is None or self._turns.asked is None:
            return ()
        runners = self.play.runners
        turn = runners.index(self.play.runner(self._turns.asked))
        now = {r.number for k, r in enumerate(runners) if k == turn or (k > turn and r.is_free)}
        return tuple(agent for agent in self.agents if KINDS.index(agent) in now)

    # --- what is shown ------------------------------------------------------------------------------------------------
    def observe(self, agent: str) -> Arrays:
        """Observations of an agent, with a first axis of length 1."""
        play, own = self._begun(), self._sets[agent]
        shown = exact(play.view(KINDS.index(agent)), own.states)
        seen: Arrays = {name: values[None] for name, values in shown.items()}
        if own.pictures.names:
            seen |= own.take(self._stage.posed(play, self._light if own.pictures.in_colour else "flat"))
        return own.shown(seen, [play.episode.seed], [play.steps])

    def info(self, agent: str) -> Info:
        """Facts about the last skill, the objects and the choices that are possible now."""
        play = self._begun()
        runner: SkillExecutor = play.runner(KINDS.index(agent))
        ending, ended = runner.ending, play.ended if self.is_over else ""
        mask = [not play.objects.why_not(runner.number, action) for action in self._choices[agent]]
        info = {
            "steps": self._steps,
            "step": play.steps,
            "outcome": ending.outcome if ending else "running",
            "reason": ending.reason if ending else "",
            "success": ended == "success",
            "collision": play.collision,
            "at_goal": play.at_goal.copy(),
            "held_by": play.objects.held_by.copy(),
            "action_mask": np.array(mask, np.int8),
        }
        if len(self.agents) > 1:
            info["choosing"] = agent in self.choosing
        return {
            name: np.array([value], object) if isinstance(value, str) else np.asarray(value)[None]
            for name, value in info.items()
        }

    def episode_info(self) -> Info:
        """Scene and seed of the episode."""
        episode = self._begun().episode
        return {"scene": np.array([episode.scene.name], object), "episode_seed": np.array([episode.seed])}

    def picture(self, agent: str, watcher: DebugRenderer, world: int = 0) -> NDArray[np.uint8]:
        """Picture of the world for people who watch, uint8 [480, 640, 3]."""
        del world
        return watcher.picture(self._stage.posed(self._begun(), self._light), KINDS.index(agent))

    def describe(self) -> str:
        """Task, scenes and agents in a few words."""
        models = {member.kind: member.model for member in self.source.roster}
        partner = self._partner if isinstance(self._partner, str) else "partner of its own"
        others = {kind: f"{model} ({partner})" for kind, model in models.items() if kind not in self.agents}
        acting = {kind: models[kind] for kind in self.agents}
        return in_words("rearrange", self.source.scenes, len(self.source.homes), acting, beside=others)

    # --- inside -------------------------------------------------------------------------------------------------------
    def _begun(self) -> SkillRollout:
        if self.play is None:
            raise InputError("No episode has begun. Hint: call reset() first.", code="H3-ENV-016")
        return self.play

    def _playing(self) -> SkillRollout:
        if self.play is None or self.is_over:
            raise InputError("No episode is going on. Hint: call reset() first.", code="H3-ENV-027")
        return self.play

    def _chosen(self, agent: str, action: ArrayLike) -> Action:
        """The choice that a row of actions [1, ...] means; an `Action` is taken as it is."""
        if isinstance(action, Action):
            return action
        if self._level == "low" and agent == "robot":
            row = np.asarray(action, object)
            command = checked_command(row[0] if row.ndim else action, self._robot)
            return Action(CONTROL, command=tuple(command.tolist()))
        number = np.asarray(action)
        there = self._choices[agent]
        if number.shape != (1,) or number.dtype.kind not in "iu" or not 0 <= number[0] < len(there):
            shown = number[0] if number.shape == (1,) else action
            raise InputError(
                f"Expected the number of an action, 0 to {len(there) - 1}, got {shown!r}.", code="H3-ENV-028"
            )
        return there[int(number[0])]

    def _go_on(self, chosen: dict[int, Action]) -> None:
        turns, play = self._turns, self.play
        assert turns is not None
        assert play is not None
        while not turns.over:
            number = turns.asked
            if number is None:
                self._steps += 1
                self._reward += play.reward
                turns.go_on()
            elif not play.policies[number].is_external:
                turns.answer(play.policies[number].policy.act(play.view(number)))
            elif number in chosen:
                turns.answer(chosen.pop(number))
            else:
                return

    def _check_partner(self, kind: str, name: str) -> None:
        """Refuses policies of the other kind, too: the task itself lets either kind follow both, as recordings may."""
        other = "human" if kind == "robot" else "robot"
        if name in policy_names(self.task, other) and name not in policy_names(self.task, kind):
            raise unknown_policy(self.task, kind, name)
        resolve_policy(self.task, kind, name, self.spec)

    def _observation_sets(self, names: Sequence[str], options: Options) -> dict[str, ObservationSet]:
        states = {agent: self._limits(agent) for agent in self.agents}
        bodies = self._bodies
        known = [(*states[a], *picture_names(bodies[a]), *camera_names(bodies[a])) for a in self.agents]
        names, sizes = split_sizes(names)
        chosen = checked_names(names, *known, noise=options.noise or ())
        return {
            agent: ObservationSet(
                own,
                states[agent],
                self._bodies[agent],
                agent=KINDS.index(agent),
                depth_size=options.depth_size,
                rgb_size=options.rgb_size,
                sizes=sizes,
                noise=options.noise,
            )
            for agent, own in zip(self.agents, chosen, strict=True)
        }

    def _limits(self, agent: str) -> dict[str, Limits]:
        arm = len(self._robot.require_arm()) if agent == "robot" else 0
        return limits(objects=self.spec.objects, arm=arm)


class Stage:
    """Renders a play of rearrangement as it is now: arms and hands where they are, objects where they lie or are held."""

    def __init__(self) -> None:
        self._episode: Any = None
        self._renderers: dict[LightMode, StateRenderer] = {}

    def posed(self, play: SkillRollout, light: LightMode = "flat") -> StateRenderer:
        """The renderer of a light, with everything where it is now."""
        from sim_kinematic.sensing.camera_sensor import StateRenderer

        episode = play.episode
        if self._episode is not episode:
            self._episode, self._renderers = episode, {}
        if light not in self._renderers:
            bodies, names = [member.body for member in episode.roster], [target.name for target in episode.targets]
            self._renderers[light] = StateRenderer(episode.scene, bodies, objects=names, light=light)
        self._renderers[light].pose(play.state, frames=play.frames())
        return self._renderers[light]
