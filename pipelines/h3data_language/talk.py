"""Messages with a structure, by which planners tell each other what they do and where things are.

A message is text (`h3data.policies.Message`). One of these texts has a meaning for planners too: ``i_take mug_0``.
"""

from __future__ import annotations

from typing import NamedTuple

from h3data.errors import InputError, suggest
from h3data.policies import Message

INTENTS = {"i_take": 1, "i_leave": 1, "handled": 1, "brought": 1, "is_in": 2, "please_move": 0}
"""Number of names that follow each intent: things, and of ``is_in`` a thing and a surface or room."""


class Intent(NamedTuple):
    """Structured meaning of a message."""

    kind: str
    names: tuple[str, ...] = ()

    @classmethod
    def of(cls, text: str) -> Intent | None:
        """Return the meaning of a text; None if it has none for planners."""
        kind, *names = text.split() or [""]
        return cls(kind, tuple(names)) if INTENTS.get(kind) == len(names) else None


def say(kind: str, *names: str, to: str = "") -> Message:
    """Return the message with a structured meaning, to one agent or to all.

    Raises:
        InputError: there is no such intent, or it has another number of names.
    """
    if INTENTS.get(kind) != len(names) or any(not name or name.split() != [name] for name in names):
        raise InputError(
            f"Expected an intent and its names without spaces, got {kind!r} and {len(names)} names."
            f"{suggest(kind, [f'{k} with {n} names' for k, n in INTENTS.items()])}",
            code="H3-LANGUAGE-021",
        )
    return Message(" ".join((kind, *names)), to)
