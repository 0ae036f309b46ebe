"""Protocol for an agent's access to the other agents of its world (`sim_kinematic.agents.giving_way.GivingWay`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from h3data.geometry import Array
from sim_kinematic.avoidance.yielding import Neighbours


class Company(Protocol):
    """All agents of one world, addressed by their numbers."""

    agreed: bool
    """True if all agents step aside for each other when they are asked."""
    solid: bool
    """True if people who are driven from outside slide along the discs of other agents."""
    # untyped, because the modules of the actors import this one
    actors: Sequence[Any]
    bodies: list[Any]

    def around(self, number: int) -> Neighbours:
        """Return all agents as others observe them, and which of them an agent gives way to."""
        ...

    def meets(self, me: Any) -> bool:
        """Return whether an agent touches another agent that it avoids and that it did not touch before."""
        ...

    def comes_too_near(self, me: Any) -> bool:
        """Return whether a person has come nearer in this step to the discs of other agents than allowed."""
        ...

    def discs_of(self, number: int) -> Array:
        """Return the discs ``(x, z, radius)`` [N, 3] of an agent."""
        ...

    def discs_beside(self, number: int) -> Array:
        """Return the discs ``(x, z, radius)`` [N, 3] [m] of all agents except one."""
        ...

    def frames(self) -> list[Array]:
        """Return the world frames of all agents: of robots' links [1, L, 4, 4], or of people's joints [1, 55, 4, 4]."""
        ...
