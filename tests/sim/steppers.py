"""Steppers of both kinds with short names for what their tests look at."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import h3data
from sim_kinematic.agents.roster import make_roster, sample_places
from sim_kinematic.agents.skills import Action
from sim_kinematic.envs.stepper import Options
from sim_kinematic.envs.world_stepper import WorldStepper
from sim_kinematic.motion.randomness import generator
from sim_kinematic.motion.spec import SocialNavSpec
from sim_kinematic.sensing.table import STATE_OBSERVATIONS
from sim_kinematic.tasks.social_nav import TRAINING
from sim_kinematic.world import DriveCommand, WaypointCommand, World
from tests.simulated import REARRANGE, SOCIAL_NAV

PAIR = ("robot", "human")
social_nav_env: Callable[..., Any] = partial(h3data.make, "social_nav")
rearrange_env: Callable[..., Any] = partial(h3data.make, "rearrange")


class Batch:
    """W worlds of social navigation and what their robots observe."""

    def __init__(
        self,
        scenes: Any,
        *,
        worlds: int = 1,
        spec: Any = TRAINING,
        reward: str = "paper",
        driven: bool = False,
        observations: Any = STATE_OBSERVATIONS,
        depth_size: Any = None,
        **bodies: str,
    ) -> None:
        self.stepper = WorldStepper(
            SOCIAL_NAV,
            scenes,
            worlds=worlds,
            spec=spec,
            reward=reward,
            agents=PAIR if driven else ("robot",),
            observations=observations,
            options=Options(depth_size=depth_size),
            **bodies,
        )
        self.play, self.worlds, self.spec = self.stepper.play, worlds, spec
        self.state = self.play.world.state
        self.ends: NDArray[np.bool_] = np.zeros(worlds, np.bool_)

    def begin(self, seeds: ArrayLike, indices: ArrayLike, *, where: ArrayLike = True) -> None:
        seeds, indices = (np.broadcast_to(np.asarray(v, object), self.worlds).tolist() for v in (seeds, indices))
        self.stepper.begin(seeds, indices, np.broadcast_to(where, self.worlds))

    def step(self, actions: ArrayLike, human: ArrayLike | None = None) -> NDArray[np.float64]:
        """Rewards; `ends` says which worlds the rules end."""
        given: dict[str, Any] = {"robot": actions} if human is None else {"robot": actions, "human": human}
        reward, self.ends, _ = self.stepper.step(given)
        return reward

    def observe(self) -> dict[str, Any]:
        return self.stepper.observe("robot")

    def space(self) -> Any:
        return self.stepper.observation_space("robot")

    @property
    def episodes(self) -> list[Any]:
        return self.play.episodes

    @property
    def memory(self) -> Any:
        return self.play.memory


class SkillSession:
    """One world of rearrangement whose agents are given skills."""

    def __init__(self, scenes: Any, **options: Any) -> None:
        self.stepper = WorldStepper(REARRANGE, scenes, **options)
        self.reward, self.steps = 0.0, 0

    def begin(self, seed: int, index: int) -> None:
        self.stepper.begin([seed], [index], np.ones(1, np.bool_))

    def step(self, actions: Mapping[str, Action]) -> None:
        self.reward = float(self.stepper.step(actions)[0][0])
        self.steps = self.stepper.turns[0].steps

    @property
    def play(self) -> Any:
        return self.stepper.play

    @property
    def ended(self) -> str:
        return self.play.ended if self.stepper.turns[0].is_over else ""

    @property
    def choosing(self) -> tuple[str, ...]:
        return self.stepper.choosing()

    def view(self, agent: str) -> Any:
        return self.play.view(PAIR.index(agent))

    def runner(self, agent: str) -> Any:
        return self.play.team.controllers[PAIR.index(agent)]


class AgentWorlds:
    """A `World` in one home whose people walk to waypoints and whose robots are driven."""

    def __init__(self, home: Any, agents: Any = PAIR, *, worlds: int = 1, spec: Any = None, free: Any = None) -> None:
        self.scene, self.free, self.spec = home, free, spec or SocialNavSpec()
        self.world = World(make_roster(agents), worlds=worlds, base=self.spec.robot, walker=self.spec.human)
        self.cast, self.state, self.pairs = self.world.roster, self.world.state, self.world.pairs
        self.place(np.zeros((worlds, len(self.cast), 3)))

    def place(self, starts: NDArray[np.float64]) -> None:
        self.world.place(starts, [self.free] * self.world.worlds)

    def reset(self, seed: int) -> None:
        self.place(
            np.stack(
                [
                    sample_places(
                        self.scene,
                        self.free,
                        self.cast,
                        generator(seed, "agent_worlds", world=w),
                        apart_m=self.spec.spawn_distance_m,
                        rules=self.spec.robot,
                    )
                    for w in range(self.world.worlds)
                ]
            )
        )

    def step(self, actions: Any) -> NDArray[np.bool_]:
        """Pairs that touch, [W, P]."""
        kinds = [member.kind for member in self.cast]
        if len(actions) != len(kinds):
            self.world.step([DriveCommand(np.asarray(a)) for a in actions])
        commands = [
            DriveCommand(np.asarray(a)) if kind == "robot" else WaypointCommand(np.asarray(a))
            for a, kind in zip(actions, kinds, strict=True)
        ]
        self.world.step(commands)
        return self.world.touching
