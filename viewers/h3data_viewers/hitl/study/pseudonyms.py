"""Pseudonyms of a study's participants under a secret that lies beside the study's folder, not in it."""

from __future__ import annotations

import os
import secrets
from pathlib import Path

IDS = ("PROLIFIC_PID", "STUDY_ID", "SESSION_ID")
"""What links of the recruiting platform carry; all of it is hashed at once."""


def read_key(path: Path) -> bytes:
    """The secret of a study, made at its first use and readable for its owner only: whoever gets the folder lacks the key."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "wb") as file:
            file.write(secrets.token_bytes(32))
        return path.read_bytes()


def recruit_ids(given: dict[str, str], key: bytes) -> dict[str, str]:
    """Pseudonyms of the ids that a link has brought; unknown and empty ones are left out."""
    from h3data.pseudonyms import anonymous_id  # light: it imports nothing but the standard library

    return {name: anonymous_id(given[name], key=key) for name in IDS if given.get(name, "").strip()}
