"""Protocol for one agent's access to the others of its world: `sim_kinematic.agents.giving_way.GivingWay`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from h3data.geometry import Array


class Company(Protocol):
    """Agents of one world, by number."""

    agreed: bool
    """True if all agents step aside for each other when they are asked."""
    solid: bool
    """True if people who are driven from outside slide along the discs of the others."""
    # untyped, because the modules of the actors import this one
    actors: Sequence[Any]
    bodies: list[Any]

    def meets(self, me: Any) -> bool:
        """Return whether an agent touches another that it avoids and did not touch before."""
        ...

    def comes_too_near(self, me: Any) -> bool:
        """Return whether a person has come nearer to the discs of others than allowed in this step."""
        ...

    def discs_of(self, number: int) -> Array:
        """Return the discs ``(x, z, radius)`` [N, 3] of an agent."""
        ...

    def discs_beside(self, number: int) -> Array:
        """Return the discs ``(x, z, radius)`` [N, 3] of all agents but one."""
        ...

    def frames(self) -> list[Array]:
        """Return frames of the agents: of robots' links [1, L, 4, 4], of people's joints [1, 55, 4, 4]."""
        ...
