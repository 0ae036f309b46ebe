"""Suffixes of a crowd model's name that describe a person, as in ``orca+curious+walk1``."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from functools import cache
from typing import Any, NamedTuple

from h3data.errors import InputError, suggest
from h3data.plugins import Registry
from sim_kinematic.crowd.reactions import REACTIONS
from sim_kinematic.motion.randomness import generator

ANY = "any"
"""Word for a reaction that is sampled for each person by the seed of the episode."""


class Role(NamedTuple):
    """Reaction, group and routine of a person of a crowd."""

    reaction: str = "regular"
    """Reaction of the person to a visible robot: one of `REACTIONS`."""
    group: str = ""
    """Name of the person's group: ``walk1`` walks abreast, ``talk1`` stands and talks; empty if they are alone."""
    routine: str = ""
    """Name of the person's routine (`routines`), or stops ``PLACE:ACTIVITY:SECONDS`` joined by ``+``; empty if they
    walk from goal to goal."""


ALONE = Role()
"""Role of a person without company, who treats robots like people."""


@cache
def routines() -> Registry[Any]:
    """Return the registered functions ``(episode, number)``, by name, that make the `Agenda` of an agent."""
    return Registry("h3data.routines", {"morning": "", "evening": ""}, what="routine")


def read_role(words: str, seed: int = 0, number: int = 0) -> Role:
    """Return the role of agent ``number`` from words joined by ``+``; ``any`` stands for a sampled reaction.

    Raises:
        InputError: There is no such reaction, group or routine.
    """
    role = Role()
    for word in filter(None, words.split("+")):
        if word == ANY:
            names = list(REACTIONS)
            role = role._replace(
                reaction=names[int(generator(seed, "crowd_reaction", world=number).integers(len(names)))]
            )
        elif word in REACTIONS:
            role = role._replace(reaction=word)
        elif word in (*routines().names(), *routines().missing()):
            role = role._replace(routine=word)
        elif word.count(":") == 2:  # PLACE:ACTIVITY:SECONDS
            role = role._replace(routine=f"{role.routine}+{word}".removeprefix("+"))
        elif re.fullmatch(r"(walk|talk)\d{0,4}", word):
            role = role._replace(group=word)
        else:
            known = (*REACTIONS, ANY, *routines().names(), "walk1", "talk1")
            raise InputError(
                f"Nobody in a crowd is {word!r}.{suggest(word, known)} Hint: people of a group have the same word, such as "
                "orca+walk1,orca+walk1.",
                code="H3-SIM-060",
            )
    return role


def check_groups(groups: Iterable[str]) -> None:
    """Check that each group has two or more people.

    Raises:
        InputError: A group has one person.
    """
    for name, count in Counter(filter(None, groups)).items():
        if count == 1:
            raise InputError(
                f"The group {name!r} has one person, and groups have two or more. Hint: name it behind the partner of others "
                f"too: orca+{name},orca+{name}.",
                code="H3-SIM-061",
            )
