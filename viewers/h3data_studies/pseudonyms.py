"""Pseudonyms of a study's participants, made with a secret that is stored outside the study's folder."""

from __future__ import annotations

import base64
import hashlib
import hmac
import os
import re
import secrets
from pathlib import Path

IDS = ("PROLIFIC_PID", "STUDY_ID", "SESSION_ID")
"""Names of the ids in links of the recruiting platform; all ids are hashed on arrival."""
PATTERNS = {"PROLIFIC_PID": "[0-9a-fA-F]{24}"}
"""Default formats of ids, for which the study file gives none (``[recruiting] id_pattern``)."""
ANY = ".*"
_PLACEHOLDER = re.compile(r"[{}<>%$\[\]]")


def read_key(path: Path) -> bytes:
    """Return the secret of a study, which is created at its first use and readable only by its owner.

    It is not in the study's folder, so that a copy of the folder lacks the key.
    """
    try:
        return path.read_bytes()
    except FileNotFoundError:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "wb") as file:
            file.write(secrets.token_bytes(32))
        return path.read_bytes()


def recruit_ids(given: dict[str, str], key: bytes) -> dict[str, str]:
    """Return pseudonyms of the ids in a participant's link, without unknown and empty ids."""
    from h3data.pseudonyms import anonymous_id  # light: it imports nothing but the standard library

    ids = {name: given.get(name, "").strip() for name in IDS}
    # the same digits in capitals are the same person
    ids = {
        name: value.lower() if re.fullmatch(PATTERNS["PROLIFIC_PID"], value) else value for name, value in ids.items()
    }
    return {name: anonymous_id(value, key=key) for name, value in ids.items() if value}


def refused_id(given: dict[str, str], patterns: str | dict[str, str] | None) -> tuple[str, str]:
    """Return the name of the first invalid id and of the reason in `texts.ENGLISH`, or empty texts if all are valid.

    Args:
        given: Parameters of the participant's link, by name.
        patterns: Regular expressions for whole ids by name, or one for ``PROLIFIC_PID``, as in the study file.
    """
    own = {"PROLIFIC_PID": patterns} if isinstance(patterns, str) else patterns or {}
    for name in IDS:
        value = given.get(name, "").strip()
        if not value:
            continue
        if _PLACEHOLDER.search(value) or value.strip("_:#@ ").upper() == name:
            return name, "placeholder"
        if not re.fullmatch(own.get(name, PATTERNS.get(name, ANY)), value):
            return name, "bad_id"
    return "", ""


def completion_code(pseudonym: str, key: bytes) -> str:
    """Return the completion code of one participant, which differs from all others: 10 letters and digits."""
    code = hmac.digest(key, f"complete|{pseudonym}".encode(), hashlib.sha256)
    return base64.b32encode(code[:7]).decode()[:10]


def rejoin_code(pseudonym: str, seat: str, key: bytes) -> str:
    """Return the code by which a participant can continue once in another browser; it changes with the seat.

    Args:
        pseudonym: Pseudonym of the participant.
        seat: Digest of the token of their current seat.
        key: Secret of the study.
    """
    code = hmac.digest(key, f"rejoin|{pseudonym}|{seat}".encode(), hashlib.sha256)
    return base64.urlsafe_b64encode(code[:24]).decode()
