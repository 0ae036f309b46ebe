"""Gymnasium vector environment of any task, with W worlds and one agent in each; it needs the extra ``env``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError
from sim_kinematic.envs.recipe import PickledEnv
from sim_kinematic.envs.single import Observations, checked_render_mode, run_seed
from sim_kinematic.envs.stepper import Info, Stepper, gymnasium
from sim_kinematic.motion.spec import STEP_S
from sim_kinematic.sensing.watching import DebugRenderer


class TaskVectorEnv(PickledEnv, gymnasium.vector.VectorEnv[Any, Any, Any]):
    """Vector environment of W worlds. World w after ``reset(seed=s)`` equals a `TaskEnv` after ``reset(seed=s + w)``.

    Worlds whose episode has ended start the next one by Gymnasium's autoreset modes. NEXT_STEP (the default): the step
    after the last step of an episode ignores its action, starts the next episode, and returns its first observation and
    a reward of 0. SAME_STEP: the last step of an episode already returns the first observation of the next one, with
    the last observation of the old episode in ``info["final_obs"]`` and its facts in ``info["final_info"]``. DISABLED:
    ``reset(options={"reset_mask": ended})`` starts the next episodes, and a step before that is an error.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium's classes have it, and each environment its own
        "render_modes": ["rgb_array"],
        "render_fps": round(1 / STEP_S),
        "autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        stepper: Stepper,
        *,
        render_mode: str | None = None,
        autoreset_mode: str | gymnasium.vector.AutoresetMode = gymnasium.vector.AutoresetMode.NEXT_STEP,
    ) -> None:
        """Wrap worlds in Gymnasium's vector interface.

        Args:
            stepper: the worlds.
            render_mode: ``rgb_array`` for `render`, or None.
            autoreset_mode: a mode of Gymnasium or its name, in capitals or as its value (``NextStep``).

        Raises:
            InputError: There is no such mode.
        """
        self.render_mode = checked_render_mode(render_mode)
        self.autoreset_mode = checked_autoreset_mode(autoreset_mode)
        # a dictionary of its own: the class's is shared by all environments
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self._attributes: dict[str, tuple[Any, ...]] = {}
        self.stepper = stepper
        self.num_envs = stepper.worlds
        self._watchers = [DebugRenderer() for _ in range(self.num_envs)]
        (self.agent,) = stepper.agents
        # Python's whole numbers, as seeds may have any size
        self._seeds = np.zeros(self.num_envs, object)
        self._indices = np.full(self.num_envs, -1)
        self._ended = np.zeros(self.num_envs, np.bool_)
        self.single_observation_space = stepper.observation_space(self.agent)
        self.single_action_space = stepper.action_space(self.agent)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, self.num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:  # type: ignore[override]
        """Start the next episode in all worlds, or with ``seed`` the first episode of other runs.

        The runs have the seeds ``seed``, ``seed + 1`` and so on, or those in a list. ``options["reset_mask"]`` (bool
        [W]) selects the worlds to reset; the others continue, and the masks in ``info`` leave them out.

        Raises:
            InputError: The seeds or the mask do not fit the number of worlds, or some worlds have no episode yet.
        """
        single = seed if isinstance(seed, int | np.integer) else None
        # Gymnasium's generator takes one seed; those of a list belong to single worlds
        super().reset(seed=None if single is None else int(single))
        listed: Sequence[int | None]
        if single is not None:
            # the numbering of Gymnasium's own vector environments
            listed = [int(single) + w for w in range(self.num_envs)]
        else:
            listed = [None] * self.num_envs if seed is None else list(seed)  # type: ignore[arg-type]
        if len(listed) != self.num_envs:
            raise InputError(
                f"Expected one seed, or one for each of {self.num_envs} worlds, got {len(listed)}.", code="H3-ENV-032"
            )
        chosen = self._chosen(options)
        for w in np.flatnonzero(chosen).tolist():
            if listed[w] is not None or self._indices[w] < 0:
                self._seeds[w], self._indices[w] = run_seed(listed[w], self.np_random), -1
        self._begin(chosen)
        self._ended[chosen] = False
        return self.stepper.observe(self.agent), _masked(self._info(episodes=True), chosen)

    def _chosen(self, options: dict[str, Any] | None) -> NDArray[np.bool_]:
        """Return the worlds whose next episodes are to begin, [W].

        Raises:
            InputError: The mask is malformed, or leaves out worlds that have not begun yet.
        """
        mask = (options or {}).get("reset_mask")
        if mask is None:
            return np.ones(self.num_envs, np.bool_)
        chosen = np.asarray(mask)
        # no numbers of worlds: 0 and 1 would choose other worlds as indices than as truth values
        if chosen.shape != (self.num_envs,) or chosen.dtype != np.bool_ or not chosen.any():
            raise InputError(
                f"Expected a reset_mask of {self.num_envs} truth values, at least one of them true, got {mask!r}.",
                code="H3-ENV-051",
            )
        if (self._indices[~chosen] < 0).any():
            raise InputError("Expected a reset of all worlds first. Hint: leave out reset_mask.", code="H3-ENV-052")
        return chosen

    def _begin(self, where: NDArray[np.bool_]) -> None:
        """Begin the next episodes of some worlds."""
        self._indices[where] += 1
        self.stepper.begin(self._seeds, self._indices, where)  # type: ignore[arg-type]

    def step(
        self, actions: ArrayLike
    ) -> tuple[Observations, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:  # type: ignore[override]
        """Carry out actions [W, ...], or start the next episode in worlds whose episode has ended.

        Raises:
            InputError: The actions are malformed; then nothing has moved.
        """
        again, mode = self._ended, self.autoreset_mode
        if mode == gymnasium.vector.AutoresetMode.DISABLED and again.any():
            raise InputError(
                f"The episodes of worlds {np.flatnonzero(again).tolist()} have ended. Hint: "
                'reset(options={"reset_mask": terminated | truncated}) first.',
                code="H3-ENV-053",
            )
        going, none = ~again, np.zeros(self.num_envs)
        # where all begin their next episode, nobody acts
        reward, terminated, truncated = (
            self.stepper.step({self.agent: actions}) if going.any() else (none, none > 0, none > 0)
        )
        # after the step, which moves all worlds: begun before it, new episodes would lose their first state
        if again.any():
            self._begin(again)
        # facts from the stepper about a world that has begun again describe its last episode
        reward, terminated, truncated = np.where(going, reward, 0.0), going & terminated, going & truncated
        self._ended = terminated | truncated
        final: dict[str, Any] = {}
        if mode == gymnasium.vector.AutoresetMode.SAME_STEP and self._ended.any():
            again, self._ended = self._ended, np.zeros(self.num_envs, np.bool_)
            # before the next episodes begin, after which the last observations are gone
            final = self._final(again)
            self._begin(again)
        info = _masked(self._info(episodes=bool(again.any())))
        return self.stepper.observe(self.agent), reward, terminated, truncated, info | final

    def _final(self, ended: NDArray[np.bool_]) -> dict[str, Any]:
        """Return the last observations and facts of the worlds whose episodes have ended, in Gymnasium's form."""
        shown, last = self.stepper.observe(self.agent), np.full(self.num_envs, None, object)
        for w in np.flatnonzero(ended).tolist():
            last[w] = (
                {name: rows[w].copy() for name, rows in shown.items()} if isinstance(shown, dict) else shown[w].copy()
            )
        facts = _masked({name: np.array(rows) for name, rows in self._info(episodes=False).items()}, ended)
        return {"final_obs": last, "_final_obs": ended.copy(), "final_info": facts, "_final_info": ended.copy()}

    # --- attributes of the worlds -------------------------------------------------------------------------------------
    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute of each world: one set by `set_attr`, or one that all worlds share.

        Raises:
            AttributeError: the worlds have no such attribute.
        """
        if name in self._attributes:
            return self._attributes[name]
        # a vector environment has the spaces of one world by other names
        own = {"observation_space": "single_observation_space", "action_space": "single_action_space"}.get(name, name)
        return (getattr(self, own),) * self.num_envs

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Return the result of calling a method of each world, or an attribute of each world, by name.

        Only the results of ``render`` differ between worlds.

        Raises:
            AttributeError: the worlds have no such method or attribute.
            InputError: the method would move single worlds.
        """
        if name == "render":
            return self.render() or (None,) * self.num_envs
        if name in ("reset", "step"):
            raise InputError(
                f"Worlds are stepped together: call {name}() of the vector environment.", code="H3-ENV-054"
            )
        values = self.get_attr(name)
        if name in self._attributes:
            return tuple(value(*args, **kwargs) if callable(value) else value for value in values)
        return (values[0](*args, **kwargs),) * self.num_envs if callable(values[0]) else values

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute of each world: one value for all, or a list or tuple with one for each.

        Raises:
            InputError: the number of values differs, or the environment already has an attribute of this name.
        """
        if name in dir(self):
            raise InputError(f"{name} cannot be set: it was decided when the environment was made.", code="H3-ENV-055")
        each = tuple(values) if isinstance(values, list | tuple) else (values,) * self.num_envs
        if len(each) != self.num_envs:
            raise InputError(
                f"Expected one value of {name}, or one for each of {self.num_envs} worlds, got {len(each)}.",
                code="H3-ENV-056",
            )
        self._attributes[name] = each

    @property
    def task(self) -> str:
        """Name of the task."""
        return str(self.stepper.task.name)

    @property
    def _max_episode_steps(self) -> int:
        """Number of steps after which an episode ends at the latest, by the name that Gymnasium's `TimeLimit` gives it."""
        return int(self.stepper.spec.max_steps)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:  # type: ignore[override]
        """Return a picture of each world's agent and its surroundings, like those of `TaskEnv.render`."""
        if self.render_mode is None:
            return None
        return tuple(self.stepper.picture(self.agent, watcher, w) for w, watcher in enumerate(self._watchers))

    def _info(self, *, episodes: bool) -> Info:
        """Return the facts about all worlds, with those about their ``episodes`` if wanted."""
        info = self.stepper.info(self.agent)
        return info | self.stepper.episode_info() if episodes else info

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.stepper.describe()})"

    __str__ = __repr__


def checked_autoreset_mode(mode: str | gymnasium.vector.AutoresetMode) -> gymnasium.vector.AutoresetMode:
    """Return a Gymnasium autoreset mode, given the mode, its name or its value.

    Raises:
        InputError: There is no such mode.
    """
    known = gymnasium.vector.AutoresetMode
    for one in known:
        if mode in (one, one.name, one.value):
            return one
    raise InputError(
        f"Unknown autoreset mode {mode!r}. Expected one of: {', '.join(one.name for one in known)}.", code="H3-ENV-050"
    )


def _masked(info: Info, where: NDArray[np.bool_] | None = None) -> dict[str, Any]:
    """Return facts in Gymnasium's form, with a mask ``_name`` [W] of the worlds in which each one holds (default: all)."""
    masks = {
        f"_{name}": np.ones(len(array), np.bool_) if where is None else where.copy() for name, array in info.items()
    }
    return {**info, **masks}
