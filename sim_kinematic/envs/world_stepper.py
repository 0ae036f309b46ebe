"""Stepper of W worlds of any task.

Agents who drive and walk are moved in all worlds at once, and a step of the environment is one step of the simulation.
Agents with skills (`sim_kinematic.tasks.skills`) are asked in turn, separately in each world. Their action is a skill,
and a step of the environment lasts until an agent that acts must choose again; on the lower layer it lasts one step of
the simulation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.bodies import Robot
from h3data.errors import InputError
from h3data.geometry import Array
from h3data.progress import progress
from h3data.render.light.sources import LightMode
from sim_kinematic.agents.robots.skills import checked_command
from sim_kinematic.agents.roster import HUMAN_BODY, ROBOT_BODY
from sim_kinematic.agents.skills import CONTROL, Action, choices
from sim_kinematic.envs.stepper import DEFAULTS, Info, Options, checked_actions, gymnasium, refuse_tensors
from sim_kinematic.policies.assignment import assign, policy_names, resolve_policy, unknown_policy
from sim_kinematic.policies.crowd.people import CrowdPolicy
from sim_kinematic.policies.policy import External
from sim_kinematic.policies.rearrange_observations import limits
from sim_kinematic.policies.waypoints import WaypointPolicy
from sim_kinematic.sensing.agent_pictures import picture_names
from sim_kinematic.sensing.observation_set import Arrays, ObservationSet, checked_names, split_sizes
from sim_kinematic.sensing.table import sensors_of
from sim_kinematic.tasks.control import command_of, resting_arm
from sim_kinematic.tasks.episode import Episode
from sim_kinematic.tasks.play import DecisionLoop, WorldRollout
from sim_kinematic.tasks.sources import EpisodeSource, Scenes, in_words
from sim_kinematic.tasks.task import Task
from sim_kinematic.world import Command, DriveCommand, PoseCommand, WaypointCommand

if TYPE_CHECKING:
    from gymnasium.spaces import Dict, Space

    from sim_kinematic.sensing.camera_sensor import StateRenderer
    from sim_kinematic.sensing.watching import DebugRenderer

OTHER = {"robot": "human", "human": "robot"}


class Turns:
    """World whose agents choose in turn; agents in ``acting`` are controlled from outside, the others by policies."""

    def __init__(self, play: WorldRollout, acting: Sequence[int]) -> None:
        self.play, self._acting, self._loop = play, acting, DecisionLoop(play)
        self.steps, self.reward = 0, 0.0
        """Number of simulated steps of the last `go_on`, and the sum of their rewards."""
        # steps up to the first choice follow from no action, so they and their rewards are not counted
        self.go_on({})
        self.steps, self.reward = 0, 0.0

    @property
    def is_over(self) -> bool:
        """Return whether the episode has ended."""
        return self._loop.over

    @property
    def choosing(self) -> list[int]:
        """Return the agents controlled from outside whose next action counts in this step."""
        if self._loop.asked is None:
            return []
        team = self.play.team
        now = list(team.order)[list(team.order).index(self._loop.asked) :]
        return [k for k in self._acting if k == now[0] or (k in now and team.controllers[k].is_free)]

    def go_on(self, chosen: dict[int, Action]) -> None:
        """Play until an agent controlled from outside that is not in ``chosen`` must choose, or to the end."""
        self.steps, self.reward = 0, 0.0
        loop, play = self._loop, self.play
        while not loop.over:
            number = loop.asked
            if number is None:
                # nobody is asked after each simulated step, until the next one begins
                self.steps += 1
                self.reward += play.reward
                loop.go_on()
            elif number not in self._acting:
                loop.answer(play.decide(number))
            elif number in chosen:
                loop.answer(chosen.pop(number))
            else:
                return


class WorldStepper:
    """Stepper of W worlds of a task."""

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
        """Open scenes and agents of an environment with W worlds.

        Args:
            task: the task.
            scenes: homes, in the forms that `EpisodeSource` takes.
            agents: names of the agents that act; the others follow ``partner``.
            worlds: number of worlds W.
            spec: rules (default: the task's).
            roster: all agents of a world (default: the task's roster).
            partner: policy of the agents that do not act, by agent or kind (default: the task's); of agents with skills also a
                function that makes one from an episode's seed.
            observations: names of sensors and pictures; each agent gets the ones that its kind has.
            robot: body of robots named by their kind.
            human: body of people named by their kind.
            options: pictures and noise.
            **task_options: options of the task (`TaskUsage.env_options`).

        Raises:
            InputError: A name does not exist.
        """
        self.source = EpisodeSource(task, scenes, spec=spec, agents=roster, robot=robot, human=human)
        self.task, self.spec = task, self.source.spec
        for name, check in task.usage.env_options.items():
            if name in task_options:
                check(task_options[name])
        names = [member.name for member in self.source.roster]
        strangers = [agent for agent in agents if agent not in names]
        if strangers or not agents or len(set(agents)) < len(agents):
            raise InputError(
                f"Expected agents that act, some of {', '.join(names)}; got {tuple(agents)!r}.", code="H3-ENV-033"
            )
        self.agents = tuple(agents)
        self.numbers = {agent: names.index(agent) for agent in agents}
        self._others = [k for k in range(len(names)) if k not in self.numbers.values()]
        self._partner, self._options, self._task_options = partner, options, task_options
        if task.control.has_skills:
            self._check_skills(worlds)
        for k in self._others:
            self._check_partner(k)
        self.worlds = worlds
        self.plays: list[WorldRollout] = []
        """Rollouts: one of all worlds, or one per world if agents have skills."""
        if not task.control.has_skills:
            self.plays = [WorldRollout(task, self.spec, self.source.roster, worlds=worlds, options=task_options)]
        self.turns: list[Turns] = []
        """Worlds whose agents have skills and choose in turn."""
        self._walkers: list[list[Any]] = [[] for _ in range(worlds)]
        self._targets: dict[int, Array] = {k: np.zeros((worlds, 2)) for k in self._others}
        self._home = np.full(worlds, -1)
        self._renderers: dict[Any, StateRenderer] = {}
        """Renderers by home, number of worlds that are rendered at once, and light; with skills by world and light."""
        self._sets = self._observation_sets(observations or task.control.observations)

    def _check_skills(self, worlds: int) -> None:
        """Check the number of worlds, the level and the partner of agents with skills.

        Raises:
            InputError: One of them does not fit.
        """
        if isinstance(worlds, bool) or not isinstance(worlds, int) or worlds < 1:
            raise InputError(
                f"Expected at least 1 world (num_envs), a whole number, got {worlds!r}.", code="H3-ENV-030"
            )
        if self._is_low and not any(map(self._driven, self.numbers.values())):
            raise InputError("Only a robot has a lower layer. Hint: level='high' for the person.", code="H3-ENV-026")
        if not self._others and self._partner is not None:
            raise InputError(
                "All agents are controlled from outside, so there is no partner. Hint: leave out partner.",
                code="H3-ENV-041",
            )

    def _check_partner(self, k: int) -> None:
        """Check that the policy of an agent exists for its kind.

        Raises:
            InputError: There is no such policy.
        """
        # policies of the other kind too: the task itself takes them, because recordings may have them
        name, kind = self._partner_of(k), self._kind(k)
        if isinstance(name, str):
            if name in policy_names(self.task, OTHER[kind]) and name not in policy_names(self.task, kind):
                raise unknown_policy(self.task, kind, name)
            resolve_policy(self.task, kind, name, self.spec)

    def _partner_of(self, k: int) -> Any:
        """Return the policy of an agent that does not act; None: the task's."""
        return self.task.usage.env_partners.get(self._kind(k)) if self._partner is None else self._partner

    def _kind(self, k: int) -> str:
        return self.source.roster[k].kind

    @property
    def _objects(self) -> int:
        return self.spec.objects if self.task.control.has_skills else 1  # sensors of things say that there are none

    def _driven(self, k: int) -> Robot | None:
        """Return the robot whose base, arm and grip the actions of an agent move; None on the higher layer."""
        body = self.source.roster[k].body
        return body if self._is_low and isinstance(body, Robot) else None

    @property
    def _is_low(self) -> bool:
        return self._task_options.get("level") == "low"

    @property
    def play(self) -> WorldRollout:
        """Rollout of all worlds, or of the first world if agents have skills.

        Raises:
            InputError: No episode has begun.
        """
        if not self.plays:
            raise InputError("No episode has begun. Hint: call reset() first.", code="H3-ENV-016")
        return self.plays[0]

    # --- spaces -------------------------------------------------------------------------------------------------------
    def observation_space(self, agent: str) -> Dict:
        """Return the space of an agent's observations in one world."""
        return self._sets[self.numbers[agent]].space()

    def action_space(self, agent: str) -> Space[Any]:
        """Return the space of an agent's actions in one world.

        An action is a base velocity in -1..1 of the limits, [2], or [3] for a robot that can move sideways. For agents
        with skills, an action is the number of a choice; on the lower layer it is base [2], arm joints [n] and grip [1]
        in -1..1.
        """
        number = self.numbers[agent]
        if not self.task.control.has_skills:
            return gymnasium.spaces.Box(-1.0, 1.0, (self.play.world.widths[number],), np.float32)
        if robot := self._driven(number):
            return gymnasium.spaces.Box(-1.0, 1.0, (len(robot.require_arm()) + 3,), np.float32)
        known = choices(self._objects, robot=self._kind(number) == "robot", parts=tuple(range(self.spec.parts)))
        return gymnasium.spaces.Discrete(len(known))

    # --- episodes -----------------------------------------------------------------------------------------------------
    def begin(self, seeds: Sequence[int], indices: Sequence[int], where: NDArray[np.bool_]) -> None:
        """Sample episodes for the worlds ``where`` [W] and start them; if one cannot be sampled, no world changes.

        Agents with skills are then simulated until one that acts must choose.
        """
        begun = bool(self.plays and self.plays[0].episodes)
        rows = np.flatnonzero(where) if begun else np.arange(self.worlds)
        if not len(rows):
            return
        runs = [(int(seeds[w]), int(indices[w])) for w in rows.tolist()]
        # all episodes are sampled before any world begins, so an error leaves the worlds as they are
        self.source.prepare(runs)
        # a bar for one episode would take a twentieth of its reset
        shown = progress(runs, desc="episodes", unit="episode", delay=1.0, leave=False) if len(runs) > 1 else runs
        episodes = [self.source.sample(*run) for run in shown]
        if self.task.control.has_skills:
            self._begin_turns(rows, episodes)
        else:
            self._begin_together(rows, episodes)

    def _begin_turns(self, rows: NDArray[np.intp], episodes: Sequence[Episode]) -> None:
        """Begin episodes of agents with skills in the worlds ``rows``, and play them up to the first choice."""
        turns = []
        for episode in episodes:
            play = WorldRollout.of(self.task, episode, assign(self.task, episode, self._policies(episode)))
            turns.append(Turns(play, list(self.numbers.values())))
        # the first time all worlds begin, so that each has its own from then on
        self.turns = self.turns or list(turns)
        for w, begun in zip(rows.tolist(), turns, strict=True):
            self.turns[w] = begun
            # with skills each world has a renderer of its own, which holds the home of its last episode
            self._renderers = {key: renderer for key, renderer in self._renderers.items() if key[0] != w}
        self.plays = [one.play for one in self.turns]

    def _policies(self, episode: Episode) -> dict[str, Any]:
        """Return the policies of an episode by agent: `External` for those that act, the partner for the others."""
        closely = self._task_options.get("interrupts_when_close", True)
        chosen: dict[str, Any] = {agent: External(interrupts_when_close=closely) for agent in self.agents}
        for k in self._others:
            partner = self._partner_of(k)
            if self.task.control.has_skills and callable(partner):
                partner = partner(episode.seed)
            if partner is not None:
                chosen[self.source.roster[k].name] = partner
        return chosen

    def _begin_together(self, rows: NDArray[np.intp], episodes: Sequence[Episode]) -> None:
        """Begin episodes of agents who drive and walk in the worlds ``rows``."""
        self.play.begin(episodes, rows)
        homes = {id(home.scene): k for k, home in enumerate(self.source.homes) if home.is_ready}
        for w, episode in zip(rows.tolist(), episodes, strict=True):
            self._home[w] = homes.get(id(episode.scene), id(episode.scene))  # a task may have built a scene of its own
            self._walkers[w] = [given.policy for given in assign(self.task, episode, self._policies(episode))]
        for k in self._others:
            for w in rows.tolist():
                policy = self._walkers[w][k]
                # only people who turn on the spot keep a waypoint from step to step
                if isinstance(policy, WaypointPolicy) and self.spec.human.stride is None:
                    self._targets[k][w] = policy.target(self.play.world.state.agents[k].xz[w])

    def step(self, actions: Mapping[str, Any]) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """Apply the actions [W, n] of the agents that act, and let the others follow their policies.

        Agents with skills are simulated until one that acts must choose again, or to the end. Worlds whose episode is
        over return zeros, and actions count only for the agents that are `choosing`.
        """
        for agent, action in actions.items():
            refuse_tensors(action, self.task.name, agent)
        if self.task.control.has_skills:
            return self._step_turns(actions)
        given = {
            self.numbers[agent]: checked_actions(action, (self.worlds, self.play.world.widths[self.numbers[agent]]))
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

    def _step_turns(self, actions: Mapping[str, Any]) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """Play each world on with the actions of the agents that are asked; all actions are checked before anything moves."""
        going = [w for w, turns in enumerate(self.turns) if not turns.is_over]
        if not going:
            raise InputError("No episode is going on. Hint: call reset() first.", code="H3-ENV-027")
        chosen: dict[int, dict[int, Action]] = {w: {} for w in going}
        for agent, action in actions.items():
            number = self.numbers[agent]
            for w in going:
                # an `Action` of one world stays whole: it is a tuple, which an array would take apart
                own = action if self.worlds == 1 else np.asarray(action)[w : w + 1]
                # checked also for agents that are busy: a malformed action is an error whenever it comes
                choice = self._chosen(self.plays[w], number, own)
                if number in self.turns[w].choosing:
                    chosen[w][number] = self.task.control.checked(self.plays[w], number, choice)
        reward, ended = np.zeros(self.worlds), [""] * self.worlds
        for w in going:
            turns = self.turns[w]
            turns.go_on(chosen[w])
            reward[w], ended[w] = turns.reward, turns.play.ended if turns.is_over else ""
        return reward, np.array([word not in ("", "max_steps") for word in ended]), np.array(ended) == "max_steps"

    def _chosen(self, play: WorldRollout, number: int, action: ArrayLike | Action) -> Action:
        """Return the choice that a row of actions [1, ...] encodes; an `Action` is returned unchanged."""
        if isinstance(action, Action):
            return action
        there = play.team.choices(number)
        if robot := self._driven(number):
            row = np.asarray(action, object)
            return Action(CONTROL, command=tuple(checked_command(row[0] if row.ndim else action, robot).tolist()))
        given = np.asarray(action)
        # `int` would also take 1.5 and True, which are the numbers of no choice
        if given.shape != (1,) or given.dtype.kind not in "iu" or not 0 <= given[0] < len(there):
            shown = given[0] if given.shape == (1,) else action
            raise InputError(
                f"Expected the number of an action, 0 to {len(there) - 1}, got {shown!r}.", code="H3-ENV-028"
            )
        return there[int(given[0])]

    def choosing(self, world: int = 0) -> tuple[str, ...]:
        """Return the names of the agents with skills whose next action counts in a world."""
        now = self.turns[world].choosing if self.turns else []
        return tuple(agent for agent, number in self.numbers.items() if number in now)

    def _other_command(self, k: int) -> Command:
        """Return the command of an agent that is not controlled by actions."""
        # world 0 speaks for all: the partner was chosen once, for every world
        own, scripted = self.play.world.state.agents[k], isinstance(self._walkers[0][k], WaypointPolicy)
        if scripted and self.spec.human.stride is not None:
            striding = [self._walkers[w][k] for w in range(self.worlds)]
            moves = np.array([who.stride(own.xz[w], own.heading.item(w)) for w, who in enumerate(striding)])
            return PoseCommand(moves[:, :2], moves[:, 2], np.zeros((self.worlds, 2)))
        if scripted:  # only those who have arrived need a new waypoint
            gap = self._targets[k] - own.xz
            for w in np.flatnonzero(np.hypot(gap[:, 0], gap[:, 1]) <= self.spec.human.arrive_m):
                self._targets[k][w] = self._walkers[w][k].target(own.xz[w])
            return WaypointCommand(self._targets[k])
        walkers = [self._walkers[w][k] for w in range(self.worlds)]
        # the exact type: a subclass may decide by a view
        if all(type(who) is CrowdPolicy for who in walkers):  # they need no view
            team, steps = self.play.team, self.play.steps.tolist()
            moved = [who.move(team.crowds_of(w), k, steps[w]) for w, who in enumerate(walkers)]
            return command_of(moved, self.source.roster[k].name)
        views = [self.task.view(self.play, k, w) for w in range(self.worlds)]
        together = getattr(walkers[0], "act_together", None)  # policies of one server, which may answer for all at once
        chosen = (
            together(walkers, views)
            if together is not None
            else [who.act(view) for who, view in zip(walkers, views, strict=True)]
        )
        return command_of(chosen, self.source.roster[k].name)

    # --- what is shown ------------------------------------------------------------------------------------------------
    def observe(self, agent: str) -> Arrays:
        """Return observations of an agent in all worlds, [W, ...] each."""
        number = self.numbers[agent]
        own, sensors = self._sets[number], self.task.sensors
        self._require_begun()
        first, *beside = (play.team for play in self.plays)
        exact = first.exact(number, own.states, sensors, beside=beside)
        if own.pictures.names:
            exact |= self._pictures(own)
        steps = [step for play in self.plays for step in play.steps.tolist()]
        return own.shown(exact, [episode.seed for episode in self._episodes], steps)

    def _require_begun(self) -> None:
        if not self.play.episodes:
            raise InputError("No episode has begun. Hint: call reset() first.", code="H3-ENV-016")

    @property
    def _episodes(self) -> list[Episode]:
        return [episode for play in self.plays for episode in play.episodes]

    def info(self, agent: str) -> Info:
        """Return success and the facts of the task about all worlds (`TaskUsage.env_info`), the same for every agent.

        For an agent with skills, the facts are its last skill, the objects, and the choices that are possible now.
        """
        play = self.play
        if not self.task.control.has_skills:
            known = self.task.usage.env_info.items()
            return {"success": np.array(play.outcome.success), **{name: np.array(of(play)) for name, of in known}}
        number, told = self.numbers[agent], []
        for w, (turns, play) in enumerate(zip(self.turns, self.plays, strict=True)):
            facts = {"steps": turns.steps, "step": play.step, **play.team.info(number)}
            facts["success"] = turns.is_over and play.ended == "success"
            if len(self.agents) > 1:
                facts["choosing"] = agent in self.choosing(w)
            told.append(facts)
        return {
            name: np.array([facts[name] for facts in told], object if isinstance(value, str) else None)
            for name, value in told[0].items()
        }

    def episode_info(self) -> Info:
        """Return the scene and seed of the episode in each world, [W] each."""
        self._require_begun()
        return {
            "scene": np.array([e.scene.name for e in self._episodes], object),
            "episode_seed": np.array([e.seed for e in self._episodes], np.int64),
        }

    def picture(self, agent: str, watcher: DebugRenderer, world: int = 0) -> NDArray[np.uint8]:
        """Return a picture of one world for people who watch, uint8 [480, 640, 3]."""
        self._require_begun()
        return watcher.picture(self._posed(np.array([world]), self._options.light), self.numbers[agent])

    def describe(self) -> str:
        """Return a short description of the task, scenes, agents and number of worlds."""
        models = {member.name: member.model for member in self.source.roster}
        acting = {name: models[name] for name in self.agents}
        beside = {name: model for name, model in models.items() if name not in acting}
        if self.task.control.has_skills:
            beside = {name: f"{model} ({self._partner_named(name)})" for name, model in beside.items()}
        return in_words(
            self.task.name, self.source.scenes, len(self.source.homes), acting, beside=beside, worlds=self.worlds
        )

    def _partner_named(self, name: str) -> str:
        """Return the name of the policy of an agent that does not act, for `describe`."""
        number = next(k for k in self._others if self.source.roster[k].name == name)
        partner = self._partner_of(number) or self.task.defaults[self._kind(number)]
        return partner if isinstance(partner, str) else "partner of its own"

    # --- inside -------------------------------------------------------------------------------------------------------
    def _observation_sets(self, names: Sequence[str]) -> dict[int, ObservationSet]:
        """Return the observations of each agent that acts by its number; a lone agent has none of other agents."""
        roster, lone = self.source.roster, len(self.source.roster) == 1
        numbers = list(self.numbers.values())
        states = [
            {
                name: space
                for name, space in limits(
                    sensors,
                    objects=self._objects,
                    arm=len(resting_arm(roster[k].body)),
                    parts=getattr(self.spec, "parts", 0),
                ).items()
                if not (lone and sensors[name].of_other)
            }
            for k in numbers
            for sensors in (sensors_of(roster[k].kind, self.task.sensors),)
        ]
        pictures = [(*picture_names(roster[k].body), *roster[k].body.camera_names) for k in numbers]
        known = [(*own, *seen) for own, seen in zip(states, pictures, strict=True)]
        names, sizes = split_sizes(names)
        names = [name for name in names if any(name in own for own in known)] if lone else names
        chosen = checked_names(names, *known, noise=self._options.noise or ())
        return {
            k: ObservationSet(
                own,
                spaces,
                roster[k].body,
                agent=k,
                depth_size=self._options.depth_size,
                rgb_size=self._options.rgb_size,
                sizes=sizes,
                noise=self._options.noise,
            )
            for k, own, spaces in zip(numbers, chosen, states, strict=True)
        }

    def _pictures(self, own: ObservationSet) -> Arrays:
        """Return the pictures of an agent in all worlds, [W, ...] each."""
        result: Arrays = {}
        # depth and ids do not depend on light, so no light is baked for them
        light = self._options.light if own.pictures.in_colour else "flat"
        # worlds of one home share a renderer; with several homes its size would change with each reset
        together = len(self.source.homes) == 1 and not self.task.control.has_skills
        for home in np.unique(self._home):
            rows = np.flatnonzero(self._home == home)
            for part in rows.reshape(-1, self.worlds if together else 1):
                for name, picture in own.take(self._posed(part, light)).items():
                    if name not in result:
                        result[name] = np.zeros((self.worlds, *picture.shape[1:]), picture.dtype)
                    result[name][part] = picture
        return result

    def _posed(self, worlds: NDArray[np.intp], light: LightMode = "flat") -> StateRenderer:
        """Return the renderer of some worlds that are in one home, with everything where it is now."""
        w = int(worlds[0])
        if self.task.control.has_skills:
            renderer = self._renderer((w, light), self.plays[w].episode, light)
            now = self.plays[w].team.scenery(0)
            renderer.pose(now["state"], frames=now["frames"])
            return renderer
        world = self.play.world
        renderer = self._renderer((int(self._home[w]), len(worlds), light), self.play.episodes[w], light, len(worlds))
        # worlds of one home have one floor
        renderer.pose(world.state.take(worlds), floor=world.floors[w])
        return renderer

    def _renderer(self, key: Any, episode: Episode, light: LightMode, worlds: int = 1) -> StateRenderer:
        """Return the renderer of a home that renders ``worlds`` worlds at once."""
        from sim_kinematic.sensing.camera_sensor import StateRenderer

        if key not in self._renderers:
            self._renderers[key] = StateRenderer(
                episode.scene,
                [member.body for member in self.source.roster],
                objects=tuple(episode.moving),
                threads=self._options.threads,
                worlds=worlds,
                speed_mps=self.spec.human.speed_mps,
                light=light,
            )
        return self._renderers[key]
