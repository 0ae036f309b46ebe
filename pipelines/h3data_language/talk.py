"""Structured messages by which planners inform each other about their actions and the places of things.

A message is text (`h3data.policies.Message`). Texts such as ``i_take mug_0`` also have a meaning for planners.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import numpy as np

from h3data.errors import InputError, suggest
from h3data.policies import Action, Message, RearrangeView
from sim_kinematic.motion.state import NOBODY
from sim_kinematic.sensing.sight import surface_names

INTENTS = {"i_take": 1, "i_leave": 1, "handled": 1, "brought": 1, "is_in": 2, "please_move": 0}
"""Number of names that follow each intent: things, and for ``is_in`` a thing and a surface or room."""


class Intent(NamedTuple):
    """Structured meaning of a message."""

    kind: str
    names: tuple[str, ...] = ()

    @classmethod
    def of(cls, text: str) -> Intent | None:
        """Return the structured meaning of a text; None if it has none."""
        kind, *names = text.split() or [""]
        return cls(kind, tuple(names)) if INTENTS.get(kind) == len(names) else None


def say(kind: str, *names: str, to: str = "") -> Message:
    """Return the message with a structured meaning, to one agent or to all.

    Raises:
        InputError: there is no such intent, or it takes a different number of names.
    """
    if INTENTS.get(kind) != len(names) or any(not name or name.split() != [name] for name in names):
        raise InputError(
            f"Expected an intent and its names without spaces, got {kind!r} and {len(names)} names."
            f"{suggest(kind, [f'{k} with {n} names' for k, n in INTENTS.items()])}",
            code="H3-LANGUAGE-021",
        )
    return Message(" ".join((kind, *names)), to)


class Speaker(ABC):
    """Planner that first announces changes once it has chosen what to do next."""

    def __init__(self, episode: Any) -> None:
        self._names = [target.name for target in episode.targets]
        self._surfaces = surface_names(episode.scene)
        self._heard, self._taken = 0, -1
        self._say: list[Message] = []
        self._next: Action | None = None
        """Choice that follows the messages."""

    def act(self, view: RearrangeView) -> Action:
        """Return the next message, or the next skill."""
        if not self._say and self._next is None:
            self._next = self._choose(view)
            self._tell(view)
        if self._say:
            return self._say.pop(0).action
        action, self._next = self._next, None
        assert action is not None
        return action

    @abstractmethod
    def _choose(self, view: RearrangeView) -> Action:
        """Return the next skill."""

    @abstractmethod
    def _tell(self, view: RearrangeView) -> None:
        """Make the messages about everything that has changed since the last ones."""

    def _tell_places(self, view: RearrangeView, told: set[int]) -> set[int]:
        """Say where objects are that were not ``told``; return those whose places are known."""
        assert view.places is not None
        known = {k for k in range(len(self._names)) if view.is_known(k) and view.held_by[k] == NOBODY}
        for k in sorted(known - told):
            nearest = int(np.argmin(np.linalg.norm(view.places.points - view.objects[k], axis=1)))
            self._say.append(say("is_in", self._names[k], self._surfaces[nearest]))
        return known
