"""Names of people who walk as a motion: a body, a plus, and the motion, as in ``female_0+walk.npz``.

Recordings name the motion by ``motion:`` and 16 hex digits of the SHA-256 of its file, which is an attachment of theirs.
"""

from __future__ import annotations

from pathlib import Path

JOIN, STORED = "+", "motion:"
ATTACHED = "motion_"
"""Beginning of the name of an attachment that is a walk: ``motion_<digits>.npz``."""


def split_walk(model: str) -> tuple[str, str]:
    """The body and the motion of a name; the motion is empty where none is named. An existing file is a body."""
    if JOIN not in model or Path(model).exists():
        return model, ""
    body, _, motion = model.partition(JOIN)
    return body, motion
