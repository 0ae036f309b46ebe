"""Trained robots of crowd navigation from files of weights (``--policy weights:FILE``; h3data docs crowds)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from h3data.builtin import builtin_path
from h3data.errors import InputError
from h3data_crowds.robots import SKILLS
from sim_kinematic.motion.spec import BaseSpec
from sim_kinematic.policies.learned import PREFIX, VisualNavigation, network_of, require, trained_for
from sim_kinematic.policies.network import Network
from sim_kinematic.policies.policy import FunctionPolicy, Velocity
from sim_kinematic.policies.views import AgentView
from sim_kinematic.policies.visual_policy import VisualPolicy

FILE = "policies/crowd_reinforced.npz"
"""Weights among the shipped data, of `h3data train crowd_nav --recipe fast` (h3data docs crowds)."""


class _Moment(NamedTuple):
    """Part of an `AgentView` that a trained robot reads."""

    step: int
    observe: Any
    met: bool = True


class RecurrentDriver(VisualNavigation):
    """Robot of crowd navigation that `h3data train crowd_nav` has trained, for one episode."""

    def __call__(self, view: Any, spec: BaseSpec) -> Velocity:
        """Return the velocity of the base for an `AgentView` of the robot."""
        return _moves(super().__call__(_Moment(view.step, _observe(view)), spec))  # type: ignore[arg-type]

    def look(self, view: Any, spec: BaseSpec) -> dict[str, NDArray[Any]]:
        """Return the observations by name, as in training."""
        card = self.network.card
        return dict(view.observe(card.observations, card.picture_size, card.light))


def _observe(view: AgentView) -> Callable[..., Mapping[str, NDArray[Any]]]:
    if view.observe is None:
        raise InputError("The policy needs observations, and nobody computes them here.", code="H3-TASK-099")
    return view.observe


def _moves(chosen: Velocity) -> Velocity:
    return chosen._replace(skill=SKILLS[0] if chosen.forward or chosen.turn else SKILLS[1])


def reinforced(task: Any, episode: Any, number: int) -> FunctionPolicy:
    """Return the robot with the shipped weights, which has learned by reinforcement, for one episode."""
    network = network_of(f"{PREFIX}{builtin_path(FILE)}")
    driver = driver_of(network, network.task, robot=episode.roster[number].model)
    return FunctionPolicy(driver, episode.bases[number])


def driver_of(network: Any, task: str, *, robot: str = "") -> Callable[[AgentView, BaseSpec], Velocity]:
    """Return a new policy that plays a network, for one episode of ``task``.

    A multi-layer perceptron reads its observations one after the other; its outputs are clipped to -1..1.

    Raises:
        FormatError: the network is for another task or another robot, or has not two outputs.
    """
    fitting = trained_for(network, task, Network, VisualPolicy)
    if isinstance(fitting, VisualPolicy):
        return RecurrentDriver(fitting, robot=robot)
    require(fitting, fitting.observations, outputs=2)

    def drive(view: AgentView, base: BaseSpec) -> Velocity:
        seen = _observe(view)(fitting.observations)
        out = fitting(np.concatenate([np.ravel(seen[name]) for name in fitting.observations]))
        return _moves(Velocity(*np.clip(np.nan_to_num(out, nan=0.0), -1, 1).tolist()))

    return drive
