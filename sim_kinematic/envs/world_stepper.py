"""W worlds of a task whose agents drive and walk, as an environment steps them: actions in, observations and rewards out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.geometry import Array
from h3data.render.light.sources import LightMode
from sim_kinematic.agents.roster import HUMAN_BODY, ROBOT_BODY
from sim_kinematic.envs.stepper import DEFAULTS, Info, Options, checked_actions, gymnasium
from sim_kinematic.motion.state import HumanState
from sim_kinematic.policies.assignment import assign, resolve_policy
from sim_kinematic.policies.policy import External
from sim_kinematic.policies.waypoints import WaypointPolicy
from sim_kinematic.sensing.agent_pictures import camera_names, picture_names
from sim_kinematic.sensing.observation_set import Arrays, ObservationSet, checked_names, split_sizes
from sim_kinematic.sensing.table import STATE_OBSERVATIONS, sensed
from sim_kinematic.tasks.describe import in_words
from sim_kinematic.tasks.play import WorldRollout, resting_arm
from sim_kinematic.tasks.sources import EpisodeSource, Scenes
from sim_kinematic.tasks.task import Task
from sim_kinematic.world import Command, DriveCommand, GaitCommand, PoseCommand, WaypointCommand

if TYPE_CHECKING:
    from gymnasium.spaces import Dict, Space

    from sim_kinematic.sensing.camera_sensor import StateRenderer
    from sim_kinematic.sensing.watching import DebugRenderer


class WorldStepper:
    """Stepper of W worlds of a task whose agents drive and walk."""

    def __init__(
        self,
        task: Task,
        scenes: Scenes,
        *,
        agents: Sequence[str] = ("robot",),
        worlds: int = 1,
        spec: Any = None,
        roster: str | Sequence[str] | None = None,
        partner: Any = None,
        observations: Sequence[str] | None = None,
        robot: str = ROBOT_BODY,
        human: str = HUMAN_BODY,
        options: Options = DEFAULTS,
        **task_options: Any,
    ) -> None:
        """Opens scenes and agents of an environment with W worlds.

        Args:
            task: the task.
            scenes: as for `EpisodeSource`.
            agents: names of the agents that act; the others follow ``partner``.
            worlds: number of worlds W.
            spec: rules (default: the task's).
            roster: all agents of a world (default: the task's roster).
            partner: policy of the agents that do not act, by agent or kind (default: the task's).
            observations: names of sensors and pictures; each agent gets those that its kind has.
            robot: body of robots named by their kind.
            human: body of people named by their kind.
            options: pictures and noise.
            **task_options: options of the task (`WorldRollout.options`).

        Raises:
            InputError: a name does not exist.
        """
        self.source = EpisodeSource(task, scenes, spec=spec, agents=roster, robot=robot, human=human)
        self.task, self.spec = task, self.source.spec
        for name, check in task.usage.env_options.items():
            if name in task_options:
                check(task_options[name])
        self.play = WorldRollout(task, self.spec, self.source.roster, worlds=worlds, options=task_options)
        self.worlds = self.play.world.worlds
        names = [member.name for member in self.source.roster]
        strangers = [agent for agent in agents if agent not in names]
        if strangers or not agents or len(set(agents)) < len(agents):
            raise InputError(
                f"Expected agents that act, some of {', '.join(names)}; got {tuple(agents)!r}.", code="H3-ENV-033"
            )
        self.agents = tuple(agents)
        self.numbers = {agent: names.index(agent) for agent in agents}
        self._others = [k for k in range(len(names)) if k not in self.numbers.values()]
        self._partner, self._options = partner, options
        for k in self._others if isinstance(partner, str) else ():
            resolve_policy(task, self.source.roster[k].kind, partner, self.spec)
        self._walkers: list[list[Any]] = [[] for _ in range(self.worlds)]
        self._targets: dict[int, Array] = {k: np.zeros((self.worlds, 2)) for k in self._others}
        self._home = np.full(self.worlds, -1)
        self._renderers: dict[tuple[int, int, LightMode], StateRenderer] = {}
        """Renderers by home, number of worlds that are rendered at once, and light."""
        self._sets = self._observation_sets(observations or STATE_OBSERVATIONS)

    # --- spaces -------------------------------------------------------------------------------------------------------
    def observation_space(self, agent: str) -> Dict:
        """Space of an agent's observations in one world."""
        return self._sets[self.numbers[agent]].space()

    def action_space(self, agent: str) -> Space[Any]:
        """Base velocity in -1..1 of the limits, [2], or [3] where a robot can move sideways."""
        return gymnasium.spaces.Box(-1.0, 1.0, (self._width(self.numbers[agent]),), np.float32)

    def _width(self, number: int) -> int:
        is_robot = self.source.roster[number].kind == "robot"
        return 3 if is_robot and self.play.world.bases[number].max_lateral_mps else 2

    # --- episodes -----------------------------------------------------------------------------------------------------
    def begin(self, seeds: Sequence[int], indices: Sequence[int], where: NDArray[np.bool_]) -> None:
        """Samples episodes for the worlds ``where`` [W], then begins them together; a failure changes no world."""
        rows = np.flatnonzero(where) if self.play.episodes else np.arange(self.worlds)
        if not len(rows):
            return
        runs = [(int(seeds[w]), int(indices[w])) for w in rows.tolist()]
        self.source.prepare(runs)
        episodes = [self.source.sample(*run) for run in runs]  # all of them first: if one fails, no world has changed
        self.play.begin(episodes, rows)
        homes = {id(home.scene): k for k, home in enumerate(self.source.homes) if home.is_ready}
        for w, episode in zip(rows.tolist(), episodes, strict=True):
            self._home[w] = homes[id(episode.scene)]
            chosen = {agent: External() for agent in self.agents}
            if self._partner is not None:
                chosen |= {self.source.roster[k].name: self._partner for k in self._others}
            self._walkers[w] = [assigned.policy for assigned in assign(self.task, episode, chosen)]
        for k in self._others:
            for w in rows.tolist():
                policy = self._walkers[w][k]
                if isinstance(policy, WaypointPolicy) and self.spec.human.stride is None:
                    self._targets[k][w] = policy.target(self.play.world.state.agents[k].xz[w])

    def step(self, actions: Mapping[str, ArrayLike]) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """Applies the actions [W, n] of the agents that act, and lets the others follow their policies."""
        given = {
            self.numbers[agent]: checked_actions(action, (self.worlds, self._width(self.numbers[agent])))
            for agent, action in actions.items()
        }
        if not self.play.episodes:
            raise InputError("No episode has begun. Hint: call reset() first.", code="H3-ENV-016")
        commands = [
            DriveCommand(given[k]) if k in given else self._other_command(k) for k in range(len(self.source.roster))
        ]
        outcome = self.play.advance(commands)
        ends = outcome.terminated
        if self._options.end_on_success:
            ends = ends | outcome.success
        return outcome.reward, ends, self.play.out_of_time

    def _other_command(self, k: int) -> Command:
        """Command of an agent that is not controlled by actions."""
        own, scripted = self.play.world.state.agents[k], isinstance(self._walkers[0][k], WaypointPolicy)
        if scripted and self.spec.human.stride is not None:
            striding = [self._walkers[w][k] for w in range(self.worlds)]
            moves = np.array([who.stride(own.xz[w], own.heading.item(w)) for w, who in enumerate(striding)])
            return PoseCommand(moves[:, :2], moves[:, 2])
        if scripted:  # only those who have arrived need a new way point
            gap = self._targets[k] - own.xz
            for w in np.flatnonzero(np.hypot(gap[:, 0], gap[:, 1]) <= self.spec.human.arrive_m):
                self._targets[k][w] = self._walkers[w][k].target(own.xz[w])
            return WaypointCommand(self._targets[k])
        walkers = [self._walkers[w][k] for w in range(self.worlds)]
        views = [self.task.view(self.play, k, w) for w in range(self.worlds)]
        together = getattr(walkers[0], "act_together", None)  # policies of one server, which may answer for all at once
        choices = (
            together(walkers, views)
            if together is not None
            else [who.act(view) for who, view in zip(walkers, views, strict=True)]
        )
        if hasattr(choices[0], "gait"):
            gait = HumanState.zeros(self.worlds)
            for w, choice in enumerate(choices):
                gait.put([w], choice.gait)
            return GaitCommand(gait)
        if hasattr(choices[0], "heading"):
            return PoseCommand(
                np.array([choice.xz for choice in choices]), np.array([choice.heading for choice in choices])
            )
        if hasattr(choices[0], "xz"):
            return WaypointCommand(np.array([choice.xz for choice in choices]))
        return DriveCommand(np.array([[choice.forward, choice.turn] for choice in choices]))

    # --- what is shown ------------------------------------------------------------------------------------------------
    def observe(self, agent: str) -> Arrays:
        """Observations of an agent in all worlds, [W, ...] each."""
        own = self._sets[self.numbers[agent]]
        moment = self.play.sensor_context(self.numbers[agent])
        sensors, who = self.task.sensors(self.source.roster[self.numbers[agent]].kind), (self.task.name, agent)
        exact: Arrays = {name: np.asarray(sensed(name, sensors[name], moment, *who), np.float64) for name in own.states}
        if own.pictures.names:
            exact |= self._pictures(own)
        return own.shown(exact, [episode.seed for episode in self.play.episodes], self.play.steps.tolist())

    def info(self, agent: str) -> Info:
        """Facts of the task about all worlds (`Task.info_of`), the same for every agent."""
        del agent
        return self.task.info_of(self.play)

    def episode_info(self) -> Info:
        """Scene and seed of the episode in each world, [W] each."""
        return {
            "scene": np.array([e.scene.name for e in self.play.episodes], object),
            "episode_seed": np.array([e.seed for e in self.play.episodes], np.int64),
        }

    def picture(self, agent: str, watcher: DebugRenderer, world: int = 0) -> NDArray[np.uint8]:
        """Picture of one world for people who watch, uint8 [480, 640, 3]."""
        if not self.play.episodes:
            raise InputError("No episode has begun. Hint: call reset() first.", code="H3-ENV-016")
        return watcher.picture(self._posed(np.array([world]), self._options.light), self.numbers[agent])

    def describe(self) -> str:
        """Task, scenes, agents and number of worlds in a few words."""
        models = {member.name: member.model for member in self.source.roster}
        acting = {name: models[name] for name in self.agents}
        beside = {name: model for name, model in models.items() if name not in acting}
        return in_words(
            self.task.name, self.source.scenes, len(self.source.homes), acting, beside=beside, worlds=self.worlds
        )

    # --- inside -------------------------------------------------------------------------------------------------------
    def _observation_sets(self, names: Sequence[str]) -> dict[int, ObservationSet]:
        roster, lone = self.source.roster, len(self.source.roster) == 1
        numbers = list(self.numbers.values())
        states = []
        for k in numbers:
            arm = resting_arm(roster[k].body)
            states.append(
                {
                    name: sensor.limits(len(arm) if sensor.times == "joints" else 1)
                    for name, sensor in self.task.sensors(roster[k].kind).items()
                    if not (lone and sensor.of_other) and (sensor.times != "joints" or len(arm))
                }
            )
        pictures = [(*picture_names(roster[k].body), *camera_names(roster[k].body)) for k in numbers]
        known = [(*own, *seen) for own, seen in zip(states, pictures, strict=True)]
        names, sizes = split_sizes(names)
        names = [name for name in names if any(name in own for own in known)] if lone else names
        chosen = checked_names(names, *known, noise=self._options.noise or ())
        return {
            k: ObservationSet(
                own,
                limits,
                roster[k].body,
                agent=k,
                depth_size=self._options.depth_size,
                rgb_size=self._options.rgb_size,
                sizes=sizes,
                noise=self._options.noise,
            )
            for k, own, limits in zip(numbers, chosen, states, strict=True)
        }

    def _pictures(self, own: ObservationSet) -> Arrays:
        result: Arrays = {}
        light = self._options.light if own.pictures.in_colour else "flat"
        at_once = self.worlds if len(self.source.homes) == 1 else 1
        for home in np.unique(self._home):
            rows = np.flatnonzero(self._home == home)
            for part in rows.reshape(-1, at_once):
                for name, picture in own.take(self._posed(part, light)).items():
                    if name not in result:
                        result[name] = np.zeros((self.worlds, *picture.shape[1:]), picture.dtype)
                    result[name][part] = picture
        return result

    def _posed(self, worlds: NDArray[np.intp], light: LightMode = "flat") -> StateRenderer:
        """The renderer of some worlds that are in one home, with everything where it is now."""
        renderer = self._renderer(int(self._home[worlds[0]]), len(worlds), light)
        world = self.play.world
        renderer.pose(world.state.take(worlds), floor=world.floors[worlds[0]])
        return renderer

    def _renderer(self, home: int, worlds: int, light: LightMode) -> StateRenderer:
        """Returns the renderer of a home that renders ``worlds`` worlds at once."""
        from sim_kinematic.sensing.camera_sensor import StateRenderer

        if (home, worlds, light) not in self._renderers:
            self._renderers[home, worlds, light] = StateRenderer(
                self.source.homes[home].scene,
                [member.body for member in self.source.roster],
                threads=self._options.threads,
                worlds=worlds,
                speed_mps=self.spec.human.speed_mps,
                light=light,
            )
        return self._renderers[home, worlds, light]
