"""Names of bodies of people, and the gaits from motion files that this process has registered.

A person who walks as in a motion file is named by a body, a plus sign, and the file, as in ``female_0+walk.npz``.
One who plays motion files as activities also has their names, as in ``female_0+dance=dance.bvh``. Recordings name the
motion by ``motion:`` and 16 hex digits of the SHA-256 of its file, which is an attachment of the recording.
`h3data.walks` describes the contents of such files.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from h3data.bodies.people import humanoid_file
from h3data.bodies.people.humanoid import Humanoid
from h3data.errors import InputError
from h3data.plugins import Registry

JOIN, STORED = "+", "motion:"
ATTACHED = "motion_"
"""Prefix of the name of an attachment that holds a gait: ``motion_<digits>.npz``."""

_files: dict[str, bytes] = {}


# The name may be a key: stored motions are named by their contents, so what a name means never changes.
@lru_cache(maxsize=64)
def load_humanoid(name: str | Path) -> Humanoid:
    """Load a person by name, once; later calls return the same object.

    Args:
        name: a built-in body (``female_0``), ``random:SEED`` (`h3data.bodies.people.random_humanoid`), or an ``.npz``
            file. A colon and an outfit may follow (``female_0:dress``), and ``+`` and a motion file
            (``female_0+walk.bvh``), which then replaces the person's gait, and motion files by the names of activities
            (``female_0+dance=dance.bvh``), which are in `Humanoid.acts`.

    Raises:
        InputError: there is no such body, outfit or motion, or the motion contains no walking.
        FormatError: a file is damaged or of another kind.
    """
    body, motion = split_walk(str(name))
    if not motion:
        return humanoid_file.load_humanoid(name)
    stored = _stored(motion)
    walk, acts = _parts(stored)
    person = humanoid_file.load_humanoid(body)
    own = f"{person.name}{JOIN}{stored}"
    person = _reader("motion").walking(person, _kept(walk), name=own) if walk else person
    return _reader("act").acting(person, {key: _kept(of) for key, of in acts.items()}, name=own) if acts else person


def split_walk(model: str) -> tuple[str, str]:
    """Split a name into body and motion.

    The motion is empty if the name has none. The name of an existing file is a body.
    """
    # the name of a file may hold a plus itself
    if JOIN not in model or Path(model).exists():
        return model, ""
    body, _, motion = model.partition(JOIN)
    return body, motion


def stored_name(model: str) -> str:
    """Return the name that recordings use for a body with a motion; other names are returned unchanged.

    Raises:
        InputError: there is no such motion file, or it contains no walking.
    """
    body, motion = split_walk(model)
    return f"{body}{JOIN}{_stored(motion)}" if motion else model


def keep_walk(data: bytes) -> str:
    """Register a gait in this process from the contents of its file, and return its name."""
    digits = 16
    name = STORED + hashlib.sha256(data).hexdigest()[:digits]
    # one copy, whichever of several recordings with this walk came first
    _files.setdefault(name, data)
    return name


def keep_walks(attachments: Mapping[str, bytes]) -> None:
    """Register the gaits among a recording's attachments in this process."""
    for name, data in attachments.items():
        if name.startswith(ATTACHED):
            keep_walk(bytes(data))


def walk_attachments(models: Iterable[str]) -> dict[str, bytes]:
    """Return the gait files that stored body names refer to, as attachments of a recording."""
    names = sorted({name for model in models for name in re.findall(rf"{STORED}[0-9a-f]{{16}}", model)})
    return {f"{ATTACHED}{name.removeprefix(STORED)}.npz": _kept(name) for name in names}


def walk_facts(models: Iterable[str]) -> dict[str, Any]:
    """Return entries for a recording's info about the gaits that stored body names refer to, by name of the attachment."""
    return {
        name: {**_reader("motion").facts(data), "sha256": hashlib.sha256(data).hexdigest()}
        for name, data in walk_attachments(models).items()
    }


@cache
def _reader(kind: str) -> Any:
    readers: Registry[Any] = Registry("h3data.walks", {}, what="reader of motion files")
    return readers.get(kind)


def _parts(motion: str) -> tuple[str, dict[str, str]]:
    """Return the walk (empty without one) and the activities by name in what follows the body's name."""
    walk, *acts = re.split(r"\+(?=[a-z]\w*=)", JOIN + motion)
    return walk[1:], {key: of for key, _, of in (act.partition("=") for act in acts)}


def _stored(motion: str) -> str:
    """Return the name by which recordings know motions, which are stored names or paths of files."""
    walk, acts = _parts(motion)
    read = [
        ("", walk, _reader("motion").walk_file),
        *((f"{key}=", of, _reader("act").act_file) for key, of in acts.items()),
    ]
    return JOIN.join(key + (of if of.startswith(STORED) else keep_walk(file(of))) for key, of, file in read if of)


def _kept(name: str) -> bytes:
    if name not in _files:
        raise InputError(
            f"The motion {name} is not at hand: it is an attachment of the recording that names it. Hint: open that recording "
            "first, or name the file that the motion was imported from.",
            code="H3-BODY-060",
        )
    return _files[name]
