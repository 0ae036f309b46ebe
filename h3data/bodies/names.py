"""People by name: `load_humanoid`."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from h3data.bodies.motion.walk_names import split_walk
from h3data.bodies.people import humanoid_file
from h3data.bodies.people.humanoid import Humanoid


@lru_cache(maxsize=64)
def load_humanoid(name: str | Path) -> Humanoid:
    """A person by name: a built-in body (``female_0``), ``random:SEED`` (`h3data.bodies.people.random_humanoid`), or an
    ``.npz`` file; with a colon and an outfit (``female_0:dress``) they wear that, and with ``+`` and a motion file
    (``female_0+walk.bvh``) they walk as somebody walks in that. Loaded once, then shared.

    Raises:
        InputError: there is no such body, outfit or motion, or nobody walks in it.
        FormatError: a file is damaged, or none of these.
    """
    body, motion = split_walk(str(name))
    if not motion:
        return humanoid_file.load_humanoid(name)
    from h3data.bodies.motion.walk_import import walking

    return walking(humanoid_file.load_humanoid(body), motion)
