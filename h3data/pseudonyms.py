"""Pseudonyms of people, which are the same for the same person under a secret key that is not part of the data."""

from __future__ import annotations

import base64
import hashlib
import hmac
import os
import secrets
import unicodedata
from pathlib import Path

from h3data.errors import InputError

KEY_VARIABLE = "H3DATA_PARTICIPANT_KEY"
"""Environment variable with the path of the key file, to share one key between machines."""
SHORTEST_KEY = 16
"""Number of bytes of the shortest accepted key."""


def anonymous_id(person: str, *, key: bytes) -> str:
    """Return the pseudonym of a name or e-mail address under ``key``: ``P-`` and ten letters or digits.

    The pseudonym is an HMAC-SHA256 truncated to 50 bits; case, outer spaces and Unicode forms do not matter. Without
    the key, the person cannot be identified, not even by trying names. Store the key apart from the data, and delete it
    to make the pseudonyms irreversible.
    """
    if len(key) < SHORTEST_KEY:
        raise InputError(
            f"Expected a key of {SHORTEST_KEY} or more random bytes, got {len(key)}. Hint: secrets.token_bytes(32).",
            code="H3-FILE-017",
        )
    # people write their own name in several ways, and an accent may be one character or two
    text = unicodedata.normalize("NFKC", person).strip().casefold()
    if not text:
        raise InputError("Expected a person's name or e-mail address, got an empty text.", code="H3-FILE-018")
    digest = hmac.new(key, text.encode(), hashlib.sha256).digest()
    # base 32 has neither lower case nor 0, 1, 8 and 9, so that an id can be read aloud
    return "P-" + base64.b32encode(digest).decode()[:10]


def participant_key_path() -> Path:
    """Return the path of this user's key file.

    The path is the value of `KEY_VARIABLE`, or else ``h3data/participants.key`` in the configuration folder.
    """
    if given := os.environ.get(KEY_VARIABLE):
        return Path(given).expanduser()
    return Path(os.environ.get("XDG_CONFIG_HOME") or "~/.config").expanduser() / "h3data" / "participants.key"


def participant_key() -> bytes:
    """Return the secret key of this user's studies, which is created at first use.

    The key is stored with the user's settings and not with the recordings, so it is not published with the data.

    Raises:
        InputError: the file does not hold a key, or cannot be read or written.
    """
    path = participant_key_path()
    try:
        key = path.read_bytes() if path.exists() else _new_key(path)
    except OSError as error:
        raise InputError(
            f"The key that turns user ids into pseudonyms can be neither read nor made ({error.strerror}): {path}. "
            f"Hint: set {KEY_VARIABLE} to a file that can be written.",
            code="H3-FILE-020",
        ) from None
    if len(key) < SHORTEST_KEY:
        raise InputError(
            f"Expected a participant key of {SHORTEST_KEY} or more bytes, got {len(key)}: {path}", code="H3-FILE-019"
        )
    return key


def _new_key(path: Path) -> bytes:
    """Return a random key in a file that only its owner reads; that of another process if that one was first."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}")
    # the mode comes with the file: changed later, the key could be read in between
    part.touch(mode=0o600)
    part.write_bytes(secrets.token_bytes(32))
    try:
        os.link(part, path)  # unlike a rename it never replaces the key of another process
    except FileExistsError:
        pass
    finally:
        part.unlink()
    return path.read_bytes()
