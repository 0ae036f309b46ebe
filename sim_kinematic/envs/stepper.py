"""Interface of a task to environments: it starts episodes, takes actions and returns observations, with worlds first.

`sim_kinematic.envs.world_stepper` is its implementation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from h3data.geometry import Array
from h3data.render.light.sources import LightMode, check_light
from sim_kinematic.sensing.observation_set import Arrays, gymnasium
from sim_kinematic.sensing.sensor import NoiseModel

if TYPE_CHECKING:
    from gymnasium.spaces import Dict, Space

    from sim_kinematic.sensing.watching import DebugRenderer

Info = dict[str, NDArray[Any]]


@dataclass(frozen=True, kw_only=True)
class Options:
    """Settings that environments of all tasks share."""

    depth_size: tuple[int, int] | None = None
    """Width and height of depth, masks and boxes [pixels]; None is each camera's own."""
    rgb_size: tuple[int, int] | None = None
    """Width and height of colour pictures [pixels]; None is each camera's own."""
    light: LightMode = "baked"
    """Light in colour pictures and in ``render()``: ``baked``, from windows, sun and lamps, or ``flat``, the same
    everywhere. Ids do not depend on it, and depth depends on it only in its last bits if there are colours too."""
    noise: Mapping[str, NoiseModel] | None = None
    """Noise models by the name of an observation, as in `sim_kinematic.sensing.sensor.with_noise`; others are exact."""
    end_on_success: bool = False
    """True if success terminates an episode even if the task's rules let it continue."""
    threads: int = 1
    """Number of threads that render pictures."""

    def __post_init__(self) -> None:
        check_light(self.light)


DEFAULTS = Options()


class Stepper(Protocol):
    """W worlds of a task, each with its own episode."""

    task: Any
    """Task of the worlds, which has a ``name``."""
    spec: Any
    """Rules of the task, which include ``max_steps``."""
    worlds: int
    agents: tuple[str, ...]
    """Names of the agents that act."""

    def observation_space(self, agent: str) -> Dict:
        """Return the space of an agent's observations in one world."""
        ...

    def action_space(self, agent: str) -> Space[Any]:
        """Return the space of an agent's actions in one world."""
        ...

    def begin(self, seeds: Sequence[int], indices: Sequence[int], where: NDArray[np.bool_]) -> None:
        """Start the episodes ``indices`` [W] of the runs ``seeds`` [W] in the worlds selected by ``where`` [W].

        Raises:
            SceneError: No episode can be sampled in a scene.
        """
        ...

    def step(self, actions: Mapping[str, Any]) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """Carry out actions by the name of the agent; return reward, terminated and truncated, each [W].

        Raises:
            InputError: An action is malformed, or no episode has begun; then nothing has moved.
        """
        ...

    def observe(self, agent: str) -> Arrays:
        """Return the observations of an agent by name, each [W, ...] and within its space."""
        ...

    def info(self, agent: str) -> Info:
        """Return facts beyond the observations by name, each [W]."""
        ...

    def episode_info(self) -> Info:
        """Return the scene and seed of the episode in each world, each [W]."""
        ...

    def picture(self, agent: str, watcher: DebugRenderer, world: int = 0) -> NDArray[np.uint8]:
        """Return a picture of one world for people who watch, uint8 [480, 640, 3], by the world's ``watcher``.

        Raises:
            InputError: No episode has begun.
        """
        ...

    def describe(self) -> str:
        """Return a description of the environment in a few words."""
        ...


class FlatStepper:
    """Stepper whose observations are one vector for each world, for wrappers that do not support dictionaries."""

    def __init__(self, stepper: Any) -> None:
        self._stepper = stepper
        self._spaces = {agent: stepper.observation_space(agent) for agent in stepper.agents}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stepper, name)

    def observation_space(self, agent: str) -> Space[Any]:
        """Return the space of observation vectors [D], in which the observations follow the order of their names."""
        return gymnasium.spaces.flatten_space(self._spaces[agent])

    def observe(self, agent: str) -> NDArray[Any]:
        """Return the observations of an agent as one vector per world, [W, D]."""
        shown, space = self._stepper.observe(agent), self.observation_space(agent)
        # by the space, not by `shown`: Gymnasium sorts the names of a dictionary space
        rows = [shown[name].reshape(self._stepper.worlds, -1) for name in self._spaces[agent].spaces]
        return np.concatenate(rows, axis=1, dtype=space.dtype)


def refuse_tensors(actions: Any, task: str, agent: str) -> None:
    """Refuse torch tensors as actions of an agent, which are for worlds on a device.

    Raises:
        InputError: The actions are a tensor.
    """
    # by a method that only tensors have: torch need not be installed
    if hasattr(actions, "detach"):
        raise InputError(
            f"The environment of {task} simulates with NumPy, and the action of {agent} is a torch tensor. Hint: "
            "action.cpu().numpy(), or h3data.make(..., device=...) for worlds of tensors.",
            code="H3-ENV-059",
        )


def checked_actions(actions: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return actions as a float64 array of a given shape.

    Raises:
        InputError: The actions are not numbers, have another shape, or one of them is not finite.
    """
    try:
        checked = np.asarray(actions, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"Expected actions of shape {list(shape)}, got {actions!r}.", code="H3-ENV-031") from None
    if checked.shape != shape:
        raise InputError(f"Expected actions of shape {list(shape)}, got {list(checked.shape)}.", code="H3-ENV-010")
    if not np.isfinite(checked).all():
        raise InputError(
            f"Actions must be finite, got {checked[~np.isfinite(checked)][0]} in {checked.tolist()}.", code="H3-ENV-029"
        )
    return checked
