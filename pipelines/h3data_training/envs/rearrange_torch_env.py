"""Rearrangement and tasks derived from it on a device, in W worlds with choices and observations as tensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from h3data.errors import InputError, did_you_mean
from h3data_training.envs.torch_env import Tensors, TorchEnv
from h3data_training.torch.rearrange.observations import View, checked_observations, observed, observed_of
from h3data_training.torch.rearrange.state import FREE, Play
from h3data_training.torch.rearrange.worlds import RearrangeTensors
from sim_kinematic.policies.rearrange import PARTNERS
from sim_kinematic.policies.rearrange_observations import STATE_SENSES, limits
from sim_kinematic.sensing.table import sensors_of
from sim_kinematic.tasks.rearrange.task import Rearrange
from sim_kinematic.tasks.sources import Scenes, in_words

if TYPE_CHECKING:
    from gymnasium.spaces import Dict, Space

    from h3data_training.torch.rearrange.bank import RearrangeBank
    from sim_kinematic.tasks.rearrange.episode import RearrangeSpec

KINDS = ("robot", "human")
EPISODES = 256
"""Default number of episodes in the bank, which take a minute or two to sample."""


class RearrangeTorchEnv(TorchEnv[Play]):
    """W worlds of rearrangement or of a task derived from it on one device, with oracle skills (h3data docs gpu).

    A step is 1/30 s in all worlds. ``info["choosing"]`` states which agents' choices have an effect in the next step;
    the choice -1 continues. The worlds play the episodes of a bank in order, each from a position that depends on its
    seed. With two agents, actions, observations and the entries of info are given by agent.
    """

    def __init__(
        self,
        num_envs: int = 1,
        scenes: Scenes = "h3-homes/train",
        *,
        device: torch.device | str = "cuda",
        dtype: torch.dtype | None = None,
        agents: Sequence[str] = ("robot",),
        partner: str | None = None,
        observations: Sequence[str] = STATE_SENSES,
        spec: RearrangeSpec | None = None,
        interrupts_when_close: bool = True,
        episodes: int | RearrangeBank = EPISODES,
        episodes_seed: int = 0,
        robot: str = "quad_arm",
        human: str = "female_0",
        graph: bool | None = None,
        compile: bool | None = None,
        task: Rearrange | None = None,
    ) -> None:
        """Sample the episodes, or take a bank of them, and copy it to the device.

        Args:
            num_envs: number of worlds W.
            scenes: as for `sim_kinematic.tasks.sources.EpisodeSource`.
            device: device of all tensors: ``cuda``, ``cuda:1``, ``cpu``.
            dtype: type of the state: by default float64 on the CPU, else float32.
            agents: agents that act: ``robot``, ``human`` or both.
            partner: planner of the other agent (`sim_kinematic.policies.rearrange.PARTNERS`; default ``plan_pop_4``).
            observations: names of observations (`h3data_training.torch.rearrange.observations.observed_of`).
            spec: rules with oracle skills; by default `ORACLE_RULES`, or the rules of ``task`` with the oracle skills
                of `ORACLE_RULES`.
            interrupts_when_close: whether acting agents may choose again at every step while the other agent is close.
            episodes: number of episodes in the bank, or a bank.
            episodes_seed: seed of the run from which the first episodes are taken.
            robot: name of a built-in robot.
            human: name of a built-in body.
            graph: whether a step is captured as a CUDA graph; by default on a GPU.
            compile: whether its operations are fused (`h3data_training.torch.graph.fused`); by default on a GPU, if Triton is
                installed.
            task: a task derived from `Rearrange`, whose functions are for arrays of any namespace (h3data docs extending).

        Raises:
            InputError: an argument is not supported on devices, or there is no such device.
        """
        from h3data_training.torch.rearrange.bank import RearrangeBank
        from sim_kinematic.tasks.rearrange.episode import with_oracle_skills

        self.task = task or Rearrange()
        self.agents: tuple[str, ...] = (agents,) if isinstance(agents, str) else tuple(agents)
        if not self.agents or not set(self.agents) <= set(KINDS) or len(set(self.agents)) < len(self.agents):
            raise InputError(f"Expected agents 'robot', 'human' or both, got {agents!r}.", code="H3-ENV-002")
        if len(self.agents) == len(KINDS) and partner is not None:
            raise InputError(
                "Both agents are controlled from outside, so there is no partner. Hint: leave out partner.",
                code="H3-ENV-003",
            )
        partner = partner or "plan_pop_4"
        if partner not in PARTNERS:
            raise InputError(
                f"On a device partners are planners, not {partner!r}.{did_you_mean(str(partner), PARTNERS)} Expected one "
                f"of: {', '.join(PARTNERS)}.",
                code="H3-ENV-004",
            )
        self.name = self.task.name
        super().__init__(num_envs, device, graph=graph, compile=compile)
        self._partner, usual = partner, self.task.usage.device_rules
        rules = spec or (usual if type(usual) is self.task.Spec else with_oracle_skills(self.task.Spec()))
        self._sensors = {agent: sensors_of(agent, self.task.sensors) for agent in self.agents}
        known = [name for agent in self.agents for name in observed_of(self._sensors[agent], rules.parts)]
        chosen = (observations,) if isinstance(observations, str) else tuple(observations)
        self._names = checked_observations(chosen, tuple(dict.fromkeys(known)))
        if not isinstance(episodes, RearrangeBank):
            bodies = {"robot": robot, "human": human}
            episodes = RearrangeBank.draw(scenes, episodes, seed=episodes_seed, spec=rules, task=self.task, **bodies)
        elif spec is not None and spec != episodes.spec:
            raise InputError("The bank has rules of its own. Hint: leave out spec.", code="H3-ENV-006")
        self.bank = episodes
        self.sim = RearrangeTensors(
            episodes,
            task=self.task,
            device=self.device,
            dtype=dtype,
            planners=set(KINDS) - set(self.agents),
            partner=partner,
            interrupts="close" if interrupts_when_close else "never",
        )
        self.sim.check_functions()
        nothing = torch.full((self.num_envs,), -1, dtype=torch.int64, device=self.device)
        self._actions = {kind: torch.full_like(nothing, FREE) for kind in KINDS}
        self.play: Play = self.sim.before_the_first(nothing)
        self._shown: dict[str, Tensors] = {}
        self._told: Tensors = {}

    # --- the interface ------------------------------------------------------------------------------------------------
    def step(self, actions: Tensor | Mapping[str, Tensor]) -> tuple[Any, Tensor, Tensor, Tensor, Tensors]:
        """Advance all worlds by 1/30 s; worlds whose episode is over start the next one.

        Args:
            actions: numbers of choices, int64 [W], or a mapping of them by agent. Those of busy agents have no effect; -1
                continues what an agent is doing, or waits. Numbers that are too large count as the last choice, because
                    a check would have to wait for the device.

        Returns:
            Observations, rewards [W], terminated [W], truncated [W], and info.

        Raises:
            InputError: the actions are no tensors, have the wrong shape or are not integers, or no episode has started.
        """
        self._require_begun()
        given = actions if isinstance(actions, Mapping) else {self.agents[0]: actions}
        if set(given) != set(self.agents):
            raise InputError(
                f"Expected actions of {' and '.join(self.agents)}, got those of {' and '.join(given)}.",
                code="H3-ENV-005",
            )
        with torch.no_grad():
            for agent, chosen in given.items():
                numbers = self._tensor(chosen, agent)
                if numbers.shape != (self.num_envs,) or numbers.dtype.is_floating_point:
                    raise InputError(
                        f"Expected whole numbers of shape {[self.num_envs]}, got {numbers.dtype} {list(numbers.shape)}.",
                        code="H3-ENV-007",
                    )
                self._actions[agent].copy_(numbers, non_blocking=True)
            return self._stepped()

    def info(self) -> Tensors:
        """Return data in addition to the observations, [W, ...] each; ``episode`` is a number in the bank.

        With two agents, the names of the entries of each agent start with ``robot_`` or ``human_``.
        """
        return {name: tensor.clone() for name, tensor in self._told.items()}

    # --- parts --------------------------------------------------------------------------------------------------------
    def _eager(self) -> None:
        """Make one step of all worlds, in place."""
        self._shown, self._told = self._move()

    def _moved(self) -> tuple[dict[str, Tensors], Tensors]:
        self._keep(self.sim.step(self.play, self._actions["robot"], self._actions["human"]))
        views = {agent: View.of(self.sim, self.play, agent) for agent in self.agents}
        return {agent: observed(view, self._names, self._sensors[agent]) for agent, view in views.items()}, self._known(
            views
        )

    def _known(self, views: Mapping[str, View]) -> Tensors:
        play = self.play
        known = {
            "episode": play.episode,
            "steps": play.steps,
            "success": play.success,
            "collision": play.collides,
            "held_by": play.held_by,
        }
        for agent, view in views.items():
            prefix = f"{agent}_" if len(views) > 1 else ""
            free = view.does.skill == FREE
            known |= {
                f"{prefix}choosing": free | view.close if self.sim.interrupts == "close" else free,
                f"{prefix}action_mask": view.allowed().to(torch.int8),
                f"{prefix}last": view.does.last,
                f"{prefix}outcome": view.does.outcome,
            }
        return known

    def _result(self) -> Any:
        shown = {agent: {name: t.clone() for name, t in seen.items()} for agent, seen in self._shown.items()}
        return shown if len(shown) > 1 else next(iter(shown.values()))

    # --- spaces, where Gymnasium is installed -------------------------------------------------------------------------
    @cached_property
    def single_action_space(self) -> Space[Any]:
        """Action space of one world, or with two agents a space for each agent."""
        from sim_kinematic.envs.stepper import gymnasium

        spaces: dict[str, Space[Any]] = {
            agent: gymnasium.spaces.Discrete(len(self.sim.choices[agent])) for agent in self.agents
        }
        return gymnasium.spaces.Dict(spaces) if len(spaces) > 1 else spaces[self.agents[0]]

    @cached_property
    def single_observation_space(self) -> Dict:
        """Observation space of one world, or with two agents a space for each agent."""
        from sim_kinematic.envs.stepper import gymnasium
        from sim_kinematic.sensing.observation_set import box

        arms = {"robot": len(self.bank.robot.require_arm()), "human": 0}
        spaces = {}
        for agent in self.agents:
            sensors, parts = self._sensors[agent], self.bank.spec.parts
            known = limits(sensors, objects=self.bank.objects, arm=arms[agent], parts=parts)
            spaces[agent] = gymnasium.spaces.Dict({name: box(known[name]) for name in self._names})
        return gymnasium.spaces.Dict(spaces) if len(spaces) > 1 else spaces[self.agents[0]]

    def __repr__(self) -> str:
        models = {"robot": self.bank.robot.name, "human": self.bank.human.name}
        acting = {kind: models[kind] for kind in self.agents}
        others = {kind: f"{model} ({self._partner})" for kind, model in models.items() if kind not in self.agents}
        what = in_words(self.name, self.bank.scenes, len(self.bank.scenes), acting, beside=others, worlds=self.num_envs)
        return f"RearrangeTorchEnv({what}, {len(self.bank)} episodes, {self.device}, {self.sim.dtype})"
