"""Recipe of an environment, from which another process or Gymnasium can make it again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from h3data.errors import H3DataError
from h3data.plugins import load_reference, own_entries

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec


@dataclass(frozen=True)
class EnvRecipe:
    """Arguments of `sim_kinematic.envs.make.make` from which an environment can be made again."""

    function: ClassVar[str] = "h3data:make"
    """Reference to the function that makes environments, by name because the function is in a layer above."""
    task: Any
    """Task: a name, ``module:Class``, or a `Task`."""
    scenes: Any
    options: Mapping[str, Any]

    def make(self) -> Any:
        """Make the environment again, without resetting it."""
        return load_reference(self.function)(self.task, self.scenes, **self.options)

    def gymnasium_spec(self) -> EnvSpec:
        """Return the specification from which ``gymnasium.make(env.spec)`` makes the environment again."""
        from gymnasium.envs.registration import EnvSpec

        name = self.task if isinstance(self.task, str) else self.task.name
        words = (
            name.title().replace("_", "")
            if name in own_entries("h3data.tasks")
            else "".join(c if c.isalnum() else "_" for c in name)
        )
        kwargs = {"task": self.task, "scenes": self.scenes, **self.options}
        # gymnasium.make and make_vec give these two themselves
        kwargs.pop("num_envs", None)
        kwargs.pop("render_mode", None)
        return EnvSpec(
            id=f"h3data/{words}-v0",  # of built-in tasks one of h3data.envs.IDS
            entry_point=self.function,
            vector_entry_point=self.function,
            kwargs=kwargs,
        )


class PickledEnv:
    """Environment that is pickled as its recipe, like Gymnasium's ``EzPickle``; the copy has to be reset first."""

    recipe: EnvRecipe | None = None

    def __reduce__(self) -> tuple[Callable[[], Any], tuple[()]]:
        if self.recipe is None:
            raise H3DataError("Only environments made by h3data.make can be pickled.", code="H3-ENV-023")
        return self.recipe.make, ()
