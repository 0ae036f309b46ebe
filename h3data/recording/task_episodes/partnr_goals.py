"""Goals of PARTNR's collaboration episodes, which state the furniture on which objects must be placed.

An episode lists propositions such as ``is_on_top(object_handles, receptacle_handles, number)``: ``number`` of the
objects have to be on any of the pieces of furniture (partnr-planner, habitat_llm/agent/env/evaluation). Propositions
about objects on furniture can be simulated as rearrangement. Propositions about states (clean, powered on), rooms, the
floor and neighborhood cannot.
"""

from __future__ import annotations

from typing import Any

import msgspec

from h3data.errors import FormatError, InputError
from h3data.recording.task_episodes.rearrange_episode import RearrangeEpisode

PROPOSITIONS = "evaluation_propositions"


class Placement(msgspec.Struct, frozen=True, kw_only=True):
    """Object that must be placed on one of several pieces of furniture."""

    object: str
    """Handle of the object."""
    receptacles: tuple[str, ...]
    """Handles of the furniture."""
    source: str = ""
    """Receptacle on which the object lies."""


class _Arguments(msgspec.Struct):
    object_handles: list[str] = []
    receptacle_handles: list[str] = []
    number: int = 1
    is_same_receptacle: bool = False


class _Proposition(msgspec.Struct):
    function_name: str
    args: dict[str, Any] = {}


def placements_of(episode: RearrangeEpisode) -> tuple[Placement, ...] | None:
    """Return the placements that an episode of PARTNR requires, in the order of its propositions.

    The result is None for other episodes.

    If several objects satisfy a proposition, the first ones that no other proposition needs are chosen. The temporal
    order that an episode requires is ignored.

    Raises:
        FormatError: the propositions are malformed.
        InputError: the episode has unsupported propositions, or none.
    """
    listed = episode.extra.get(PROPOSITIONS)
    if listed is None:
        return None
    where = f"Episode {episode.episode_id!r}"
    # propositions that are played. The furniture of our scenes does not open: inside means on a surface of it.
    on_furniture = ("is_on_top", "is_inside")
    try:
        propositions = msgspec.convert(listed, list[_Proposition])
        arguments = [
            msgspec.convert(p.args, _Arguments) if p.function_name in on_furniture else None for p in propositions
        ]
    except msgspec.ValidationError as fault:
        raise FormatError(f"{where}: {PROPOSITIONS}: {str(fault).replace('`', '')}", code="H3-HABITAT-035") from None
    others = sorted({p.function_name for p in propositions} - {*on_furniture})
    if others:
        raise InputError(
            f"{where} asks for {', '.join(others)}, which h3data does not play. It plays {' and '.join(on_furniture)}.",
            code="H3-HABITAT-033",
        )
    chosen: dict[str, tuple[str, ...]] = {}
    for asked in arguments:
        # other propositions were refused above
        assert asked is not None
        if not 1 <= asked.number <= len(asked.object_handles) or not asked.receptacle_handles:
            raise InputError(
                f"{where}: a proposition asks for {asked.number} of {len(asked.object_handles)} objects on "
                f"{len(asked.receptacle_handles)} pieces of furniture.",
                code="H3-HABITAT-036",
            )
        free = [name for name in dict.fromkeys(asked.object_handles) if name not in chosen]
        if len(free) < asked.number:
            raise InputError(
                f"{where} moves {asked.object_handles[0]!r} more than once, which h3data does not play.",
                code="H3-HABITAT-037",
            )
        # one and the same for all: the first does as well as any other
        on = asked.receptacle_handles[:1] if asked.is_same_receptacle else asked.receptacle_handles
        chosen |= dict.fromkeys(free[: asked.number], tuple(on))
    if not chosen:
        raise InputError(f"{where} has no propositions, so there is nothing to rearrange.", code="H3-HABITAT-034")
    on = episode.name_to_receptacle
    return tuple(Placement(object=name, receptacles=to, source=on.get(name, "")) for name, to in chosen.items())
