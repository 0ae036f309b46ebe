"""Observations of one agent of a training environment, with their names, spaces and noise.

This module needs the extra ``env``.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError, MissingExtraError
from h3data.replay.cameras import split_size
from sim_kinematic.contact.frames import Body
from sim_kinematic.motion.randomness import generator
from sim_kinematic.sensing.agent_pictures import AgentPictures, Limits
from sim_kinematic.sensing.sensor import NoiseModel, scaled_depth

if TYPE_CHECKING:
    from gymnasium.spaces import Dict

    from sim_kinematic.sensing.camera_sensor import StateRenderer

try:
    import gymnasium
except ImportError as error:
    raise MissingExtraError(
        "Training environments need Gymnasium and PettingZoo. Hint: pip install 'h3data[env]'", code="H3-SIM-045"
    ) from error

Arrays = dict[str, NDArray[Any]]


class ObservationSet:
    """Named observations of an agent, made from exact values by adding noise, scaling depth and clipping to `space`."""

    def __init__(
        self,
        names: Sequence[str],
        states: Mapping[str, Limits],
        body: Body,
        *,
        agent: int,
        depth_size: tuple[int, int] | None = None,
        rgb_size: tuple[int, int] | None = None,
        sizes: Mapping[str, tuple[int, int]] | None = None,
        noise: Mapping[str, NoiseModel] | None = None,
    ) -> None:
        """Select the observations of one agent.

        Args:
            names: some of ``states`` and of the body's `picture_names`, as `checked_names` returns them.
            states: limits of observations that are not pictures.
            body: body of the agent.
            agent: number of the agent in the state.
            depth_size: width and height of depth, masks and boxes [pixels], as for `AgentPictures`.
            rgb_size: width and height of colours [pixels], as for `AgentPictures`.
            sizes: width and height of single pictures by name [pixels], as for `AgentPictures`.
            noise: noise model by name of an observation; others are exact.

        Raises:
            InputError: A size is less than 1 x 1 or too large.
        """
        self.names = tuple(names)
        self.pictures = AgentPictures(
            body, self.names, agent=agent, depth_size=depth_size, rgb_size=rgb_size, sizes=sizes
        )
        self.states = tuple(name for name in self.names if name not in self.pictures.names)
        self.limits = {n: states[n] if n in self.states else self.pictures.limits(n) for n in self.names}
        # doubles, as exact values are: clipping them by floats would cast twice
        self._bounds = {
            n: (np.asarray(one.low, np.float64), np.asarray(one.high, np.float64)) for n, one in self.limits.items()
        }
        self._noise = {name: model for name, model in (noise or {}).items() if name in self.names}
        plain = [n for n in self.states if n not in self._noise and self.limits[n].dtype == np.float32]
        self._plain = plain if len(plain) > 3 else []
        """Names of the observations that are only clipped, which is done for all of them at once unless they are few."""
        self._ends = np.cumsum([0, *(self._bounds[n][0].size for n in self._plain)]).tolist()
        sides = zip(*(self._bounds[n] for n in self._plain), strict=True)
        self._low, self._high = (
            (np.concatenate([one.ravel() for one in side]) for side in sides) if self._plain else (0, 0)
        )
        self._agent = agent

    def space(self) -> Dict:
        """Return the space of one world's observations."""
        return gymnasium.spaces.Dict({name: box(self.limits[name]) for name in self.names})

    def take(self, drawn: StateRenderer) -> Arrays:
        """Return the exact pictures of all worlds in the last pose, [W, ...]; empty if no observation is a picture."""
        return self.pictures.take(drawn) if self.pictures.names else {}

    def shown(self, exact: Arrays, seeds: Sequence[int], steps: Sequence[int]) -> Arrays:
        """Return observations [W, ...] for exact values [W, ...]: with noise, and within the bounds of the space.

        Depth is scaled to 0..1.

        The noise is determined by the episodes' ``seeds`` [W] and ``steps`` [W].
        """
        shown = self._clipped(exact) if self._plain else {}
        if len(shown) == len(self.names):
            return shown
        for name in self.names:
            if name in shown:
                shown[name] = shown.pop(name)  # in the order of the names
                continue
            values, limits = exact[name], self.limits[name]
            if name in self._noise:
                values = self._with_noise(name, values, seeds, steps)
            # after the noise, whose models take metres
            if name in self.pictures.names and name.endswith("_depth"):
                values = scaled_depth(values)
            elif name in self._noise or name in self.states:
                low, high = self._bounds[name]
                values = np.minimum(np.maximum(values, low), high)  # `clip` takes twice as long for a few numbers
                # colours with noise are rounded; conversion alone would cut them off
                values = np.rint(values) if limits.dtype == np.uint8 else values
            shown[name] = values.astype(limits.dtype, copy=False)
        return shown

    def _clipped(self, exact: Arrays) -> Arrays:
        """Return the plain numbers [W, ...] within their bounds."""
        worlds = len(exact[self._plain[0]])
        # nearly all have two axes already, and to reshape them takes as long as to clip them
        rows = [exact[n] if exact[n].ndim == 2 else exact[n].reshape(worlds, -1) for n in self._plain]
        every = np.minimum(np.maximum(np.concatenate(rows, axis=1), self._low), self._high).astype(np.float32)
        parts = ((n, every[:, a:b], exact[n]) for n, a, b in zip(self._plain, self._ends, self._ends[1:], strict=False))
        return {name: part if own.ndim == 2 else part.reshape(own.shape) for name, part, own in parts}

    def _with_noise(self, name: str, values: NDArray[Any], seeds: Sequence[int], steps: Sequence[int]) -> NDArray[Any]:
        """Return the values [W, ...] of an observation with noise.

        Raises:
            InputError: A model of noise changes the shape, or gives values that are not finite.
        """
        noisy = np.empty(values.shape, np.float64)
        for w, (seed, step) in enumerate(zip(seeds, steps, strict=True)):
            # by seed and step alone, so that an episode has the same noise in any batch of worlds
            rng = generator(int(seed), f"noise/{name}", world=self._agent, step=int(step))
            drawn = np.asarray(self._noise[name](values[w], rng=rng), np.float64)
            if drawn.shape != values[w].shape or not np.isfinite(drawn).all():
                raise InputError(
                    f"The noise of {name} must keep the shape {list(values[w].shape)} and be finite, got "
                    f"{list(drawn.shape)}.",
                    code="H3-SIM-048",
                )
            noisy[w] = drawn
        return noisy


def box(limits: Limits) -> gymnasium.spaces.Box:
    """Return the space of an observation with these limits."""
    return gymnasium.spaces.Box(limits.low, limits.high, limits.shape, limits.dtype)


def split_sizes(names: Sequence[str]) -> tuple[Sequence[str], dict[str, tuple[int, int]]]:
    """Split names such as ``robot_arm@224x224`` into names of observations, and sizes of pictures by name [pixels].

    Raises:
        InputError: a side is 0 or too large, or one picture has two sizes.
    """
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        return names, {}  # `checked_names` says what is wrong with it
    split = [split_size(name) for name in names]
    sizes: dict[str, tuple[int, int]] = {}
    for name, size in split:
        if size is not None and sizes.setdefault(name, size) != size:
            raise InputError(f"Expected one size of {name}, got several: {', '.join(names)}.", code="H3-SIM-058")
    return [name for name, _ in split], sizes


def checked_names(
    names: Sequence[str], *known: Collection[str], noise: Collection[str] = ()
) -> tuple[tuple[str, ...], ...]:
    """Return, for each agent, the observations of ``names`` that are ``known`` for it, without duplicates.

    Raises:
        InputError: no agent has one of the observations, or ``noise`` names one that is not among them.
    """
    every = tuple(dict.fromkeys(name for each in known for name in each))
    if not isinstance(names, list | tuple) or not names or not all(name in every for name in names):
        raise InputError(
            f"Expected a list of observations, some of: {', '.join(every)}. Got {names!r}.", code="H3-SIM-046"
        )
    strangers = sorted(set(noise) - set(names))
    if strangers:
        raise InputError(
            f"Noise is for observations that are shown ({', '.join(names)}), not {', '.join(strangers)}.",
            code="H3-SIM-047",
        )
    return tuple(tuple(name for name in dict.fromkeys(names) if name in each) for each in known)
