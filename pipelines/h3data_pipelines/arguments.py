"""Types of the arguments of `h3data.generate` and the other jobs: names, paths, or the objects themselves.

A `Robot` object, a policy class or a task class can be given in place of its name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from h3data.bodies import Robot
    from h3data.commands.arguments import FilePath
    from sim_kinematic.policies.policy import Policy
    from sim_kinematic.tasks.task import Task

    Body = FilePath | Robot
    Agents = str | Sequence[str | Robot]
    Scenes = FilePath | Sequence[FilePath]
    NamedPolicy = str | type[Policy] | Callable[[], Policy]
    """Name of a policy, ``weights:FILE``, ``module:name``, or a class or function that makes one for each episode."""
    Policies = NamedPolicy | Sequence[NamedPolicy]
    TaskChoice = str | type[Task]
    Overrides = Mapping[str, Any] | Sequence[str]
    """Single rules of a task by name, such as ``{"objects": 3}``."""
