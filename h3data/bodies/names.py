"""People by name: `load_humanoid`."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from h3data.bodies.motion.walk_names import split_walk
from h3data.bodies.people import humanoid_file
from h3data.bodies.people.humanoid import Humanoid


@lru_cache(maxsize=64)
def load_humanoid(name: str | Path) -> Humanoid:
    """Loads a person by name, once; later calls return the same object.

    Args:
        name: a built-in body (``female_0``), ``random:SEED`` (`h3data.bodies.people.random_humanoid`), or an ``.npz`` file.
            A colon and an outfit may follow (``female_0:dress``), and ``+`` and a motion file (``female_0+walk.bvh``), by
            which the person then walks.

    Raises:
        InputError: there is no such body, outfit or motion, or nobody walks in the motion.
        FormatError: a file is damaged or of another kind.
    """
    body, motion = split_walk(str(name))
    if not motion:
        return humanoid_file.load_humanoid(name)
    from h3data.bodies.motion.walk_import import walking

    return walking(humanoid_file.load_humanoid(body), motion)
