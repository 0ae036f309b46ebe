"""Words after a model's name that describe a person of a crowd: ``orca+curious+walk1``."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

from h3data.errors import InputError, suggest
from sim_kinematic.crowd.reactions import REACTIONS
from sim_kinematic.motion.randomness import generator

ANY = "any"
"""Name of a reaction that is sampled from the seed of the episode, for each person."""
ROUTINES = ("morning",)
"""Routines by name (`sim_kinematic.crowd.routines`)."""
_GROUP = re.compile(r"(walk|talk)\d{0,4}")


class Role(NamedTuple):
    """Reaction, company and routine of a person of a crowd."""

    reaction: str = "regular"
    """Reaction to a robot that they see: one of `REACTIONS`."""
    group: str = ""
    """Name of the person's group: ``walk1`` walks abreast, ``talk1`` stands and talks; empty if they are alone."""
    routine: str = ""
    """Activities one after another; empty: they walk about."""


ALONE = Role()
"""Role of somebody without company, who treats robots as people."""


def read_role(words: str, seed: int = 0, number: int = 0) -> Role:
    """Returns the role that words with ``+`` between them say; ``any`` is a reaction drawn for agent ``number``.

    Raises:
        InputError: nobody has such a reaction, group or routine.
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
        elif word in ROUTINES:
            role = role._replace(routine=word)
        elif _GROUP.fullmatch(word):
            role = role._replace(group=word)
        else:
            known = (*REACTIONS, ANY, *ROUTINES, "walk1", "talk1")
            raise InputError(
                f"Nobody in a crowd is {word!r}.{suggest(word, known)} Hint: people of a group have the same word, such as "
                "orca+walk1,orca+walk1.",
                code="H3-SIM-060",
            )
    return role


def check_groups(groups: Iterable[str]) -> None:
    """Refuses a group of one.

    Raises:
        InputError: somebody has no company.
    """
    for name, count in Counter(filter(None, groups)).items():
        if count == 1:
            raise InputError(
                f"The group {name!r} has one person, and groups have two or more. Hint: name it behind the partner of others "
                f"too: orca+{name},orca+{name}.",
                code="H3-SIM-061",
            )
