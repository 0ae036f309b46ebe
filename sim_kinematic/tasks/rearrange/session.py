"""Rearrangement, one world, in which some agents are told from outside what to do: what its training environments step.

An episode is the one that `sim_kinematic.tasks.rearrange.simulate.simulate_rearrange` plays with the same scene, seed and choices, bit for
bit.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from functools import lru_cache

from h3data.bodies import load_humanoid, load_robot
from h3data.errors import InputError, SceneError
from h3data.habitat.scene_names import open_free_space, open_scene
from h3data.scene import FreeSpace, Scene
from sim_kinematic.agents.robot_skills import checked_command
from sim_kinematic.agents.skills import CONTROL, Action
from sim_kinematic.motion.randomness import episode_seed, generator
from sim_kinematic.motion.state import HUMAN, ROBOT
from sim_kinematic.policies.rearrange import HighLevelPolicy, TaskView, partner_policy, robot_policy
from sim_kinematic.tasks.describe import in_words
from sim_kinematic.tasks.rearrange.episode import RearrangeSpec, RearrangeWorld
from sim_kinematic.tasks.rearrange.play import RearrangePlay, Runner
from sim_kinematic.tasks.social_nav_batch import scene_sources

DRAWS = 20
AGENTS: dict[str, int] = {"robot": ROBOT, "human": HUMAN}


class Outside:
    """Stands for a policy that is not here: who is asked answers through `RearrangeSession.step`.

    While the other agent is close, it may choose anew in every step, as Habitat's learned policies must.
    """

    def __init__(self, interrupts_when_close: bool) -> None:
        self._interrupts = interrupts_when_close

    def choose(self, view: TaskView) -> Action:
        """Never asked."""
        raise AssertionError(f"agent {view.agent} chooses outside")

    def interrupts(self, view: TaskView) -> str:
        """As `HighLevelPolicy.interrupts`."""
        going_on = view.action is None or view.action.skill == CONTROL
        return "agents_close" if self._interrupts and view.close and not going_on else ""


class RearrangeSession:
    """One world, episode after episode."""

    def __init__(
        self,
        scenes: str | Scene | Sequence[str | Scene],
        *,
        agents: Sequence[str] = ("robot",),
        partner: str | Callable[[int], HighLevelPolicy] | None = None,
        spec: RearrangeSpec | None = None,
        interrupts_when_close: bool = True,
        robot: str = "quad_arm",
        human: str = "female_0",
    ) -> None:
        """
        Args:
            scenes: As of `sim_kinematic.tasks.social_nav_batch.SocialNavBatch`.
            agents: Who is told from outside: ``robot``, ``human`` or both.
            partner: What moves the other one: a partner or a robot policy by name, ``weights:FILE``, or a function of an
                episode's seed that makes one. By default ``plan_pop_4`` beside a robot and ``complement`` beside a person.
            spec: The rules.
            interrupts_when_close: Whether those outside are asked in every step while the other is close.
            robot: Name of a built-in robot.
            human: Name of a built-in body.

        Raises:
            InputError: there are no such scenes, agents, partners or bodies.
        """
        if not agents or not set(agents) <= set(AGENTS) or len(set(agents)) < len(agents):
            raise InputError(f"Expected agents 'robot', 'human' or both, got {agents!r}.")
        self.spec = spec or RearrangeSpec()
        self.agents = tuple(agents)
        self.bodies = robot, human
        self.robot, self.human = load_robot(robot), load_humanoid(human)
        self._sources, self._scenes = scene_sources(scenes), scenes
        self._places: dict[int, tuple[Scene, FreeSpace]] = {}
        self._outside = Outside(interrupts_when_close)
        self._partner = partner if partner is not None else "plan_pop_4" if "robot" in agents else "complement"
        if len(agents) == len(AGENTS) and partner is not None:
            raise InputError("Both agents are told from outside, so there is no partner. Hint: leave out partner.")
        self._policies(0)
        self.play: RearrangePlay | None = None
        self.ended = ""
        """What ended the episode: ``success``, ``collision`` or ``max_steps``; empty while it goes on."""
        self.reward = 0.0
        """Of the steps of the last `step`, added up."""
        self.steps = 0
        """How many those were."""
        self.on_begin: Callable[[], object] = lambda: None
        """Called when an episode has begun."""
        self._asking: Generator[Runner, Action, str] | None = None
        self._asked: Runner | None = None

    # --- episodes -----------------------------------------------------------------------------------------------------
    def begin(self, seed: int, index: int) -> None:
        """Begin episode ``index`` of run ``seed`` and go on until somebody outside is asked.

        A home and a seed that give no episode are drawn anew, `DRAWS` times at most.

        Raises:
            SceneError: no home gave one.
        """
        world = self._draw(seed, index)
        self.play = RearrangePlay(world, self._policies(world.seed))
        self.ended, self.reward, self.steps = "", 0.0, 0
        self._asking = self.play.questions(self._count)
        self._asked = next(self._asking)
        self._go_on({})
        self.on_begin()

    def step(self, actions: Mapping[str, Action]) -> None:
        """Give those who are `choosing` now their actions, and go on until one of those outside is asked again, or to the end.

        Actions of those who are busy are of no effect.

        Raises:
            InputError: no episode is going on, or an action is none; then nothing has moved.
        """
        if self.play is None or self.ended:
            raise InputError("No episode is going on. Hint: call reset() first.")
        choosing = self.choosing
        chosen = {AGENTS[name]: action for name, action in actions.items() if name in choosing}
        for number, action in chosen.items():
            self.play.objects.why_not(number, action)
            if action.skill == CONTROL:
                checked_command(action.command, self.robot)
        self.reward, self.steps = 0.0, 0
        self._go_on(chosen)

    @property
    def choosing(self) -> tuple[str, ...]:
        """Those outside whose next action counts: who is asked, and who will be in this very step."""
        if self.play is None or self._asked is None:
            return ()
        runners = self.play.runners
        turn = runners.index(self._asked)
        now = {r.number for k, r in enumerate(runners) if k == turn or (k > turn and r.is_free)}
        return tuple(name for name in self.agents if AGENTS[name] in now)

    def runner(self, agent: str) -> Runner:
        """Who acts for an agent."""
        assert self.play is not None
        return next(r for r in self.play.runners if r.number == AGENTS[agent])

    def view(self, agent: str) -> TaskView:
        """What an agent knows now."""
        assert self.play is not None
        return self.play.view(self.runner(agent))

    @property
    def words(self) -> str:
        """What it is."""
        return self.in_words(1)

    def in_words(self, worlds: int) -> str:
        """What so many of them are."""
        models = dict(zip(AGENTS, self.bodies, strict=True))
        partner = self._partner if isinstance(self._partner, str) else "partner of its own"
        others = {kind: f"{model} ({partner})" for kind, model in models.items() if kind not in self.agents}
        agents = {kind: models[kind] for kind in self.agents}
        return in_words("rearrange", self._scenes, len(self._sources), agents, beside=others, worlds=worlds)

    # --- inside -------------------------------------------------------------------------------------------------------
    def _go_on(self, chosen: dict[int, Action]) -> None:
        assert self.play is not None
        assert self._asking is not None
        assert self._asked is not None
        outside = {AGENTS[name] for name in self.agents}
        try:
            while True:
                runner = self._asked
                if runner.number not in outside:
                    action = runner.policy.choose(self.play.view(runner))
                elif runner.number in chosen:
                    action = chosen.pop(runner.number)
                else:
                    return
                self._asked = self._asking.send(action)
        except StopIteration as end:
            self._asked, self.ended = None, end.value

    def _count(self, steps: int) -> None:
        assert self.play is not None
        self.steps += steps
        self.reward += self.play.reward

    def _policies(self, seed: int) -> tuple[HighLevelPolicy, HighLevelPolicy]:
        """Of robot and person."""
        given, objects = self._partner, self.spec.objects
        if len(self.agents) == len(AGENTS):
            return self._outside, self._outside
        if "robot" in self.agents:
            return self._outside, partner_policy(given, seed, objects) if isinstance(given, str) else given(seed)
        return robot_policy(given, objects) if isinstance(given, str) else given(seed), self._outside

    def _draw(self, seed: int, index: int) -> RearrangeWorld:
        robot, human = self.bodies
        fault: SceneError | None = None
        for draw in range(DRAWS):
            run = seed if draw == 0 else episode_seed(seed, draw)
            scene, free = self._place(int(generator(run, "scene", step=index).integers(len(self._sources))))
            try:
                return _world(scene, free, episode_seed(run, index), self.spec, robot, human)
            except SceneError as error:
                fault = error
        assert fault is not None
        raise fault

    def _place(self, index: int) -> tuple[Scene, FreeSpace]:
        if index not in self._places:
            source, size = self._sources[index], (self.spec.agent_radius_m, self.spec.agent_height_m)
            if isinstance(source, Scene):
                free = FreeSpace.from_scene(source, radius_m=size[0], height_m=size[1])
                self._places[index] = source, free
            else:
                self._places[index] = open_scene(source), open_free_space(source, *size)
        return self._places[index]


@lru_cache(maxsize=16)
def _world(scene: Scene, free: FreeSpace, seed: int, spec: RearrangeSpec, robot: str, human: str) -> RearrangeWorld:
    """An episode, drawn once while it is played again and again."""
    return RearrangeWorld.create(scene, seed=seed, spec=spec, free=free, robot=robot, human=human)
