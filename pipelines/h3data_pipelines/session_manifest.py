"""Manifest of a study: a CSV table of participants, sessions and conditions.

A manifest has one row for each participant, condition, session or file. Some columns select recordings, and others give
data about them:

========== =============================================================================================================
selects    ``file``: path of the imported file below the imported folder, ``*`` and ``?`` allowed (``P01/*``); without a
           folder, its name. ``user_id``: as logged, or its pseudonym. ``episode_id``, ``experiment``: as logged
states     ``participant``, ``condition``, ``policy`` (of the robot), ``partner``, ``population``, ``solo_steps`` (steps of
           a person alone in the same episode), ``max_steps`` (longest duration)
========== =============================================================================================================

A row applies to the recordings that match all of its non-empty selecting cells; a later row overrides an earlier one.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from typing import Any

from h3data.errors import FormatError, InputError, did_you_mean
from h3data.pseudonyms import anonymous_id, participant_key
from h3data.recording.records import Recording

CHOOSING = ("file", "user_id", "episode_id", "experiment")
SAYING = ("participant", "condition", "policy", "partner", "population", "solo_steps", "max_steps")
_NUMBERS = ("solo_steps", "max_steps")
_MOST_BYTES = 1 << 26


@dataclass(frozen=True, kw_only=True, eq=False)
class ManifestRow:
    """Row of a manifest."""

    line: int
    """Number of the row's line in the file."""
    choose: Mapping[str, str]
    say: Mapping[str, str | int]

    def fits(self, recording: Recording, file: PurePosixPath) -> bool:
        """Return whether all non-empty selecting cells of the row match a recording that was imported from ``file``."""
        info = recording.episode.info
        people = [str(name) for name in dict(info.get("participants") or {}).values()]
        tests = {
            "file": lambda cell: any(fnmatchcase(str(f), cell) for f in (file, file.name)),
            "user_id": lambda cell: bool(people) and (cell in people or _pseudonym(cell) in people),
            "episode_id": lambda cell: cell == recording.episode.episode_id,
            "experiment": lambda cell: cell == str(info.get("experiment", "")),
        }
        return all(tests[name](cell) for name, cell in self.choose.items())


@dataclass(frozen=True, kw_only=True, eq=False)
class SessionManifest:
    """Manifest of a study, with a record of the rows that have been used."""

    path: Path
    rows: tuple[ManifestRow, ...]
    ignored: tuple[str, ...]
    """Names of columns without a meaning."""
    used: set[int] = field(default_factory=set)
    """Lines of the rows that matched a recording."""

    def applied(self, recording: Recording, file: PurePosixPath) -> tuple[Recording, bool]:
        """Return the recording with the data of its rows in `Episode.info`, and whether any row matched.

        Args:
            recording: The imported recording.
            file: Path of the recording's file relative to the imported folder.
        """
        facts: dict[str, Any] = {}
        fitting = [row for row in self.rows if row.fits(recording, file)]
        for row in fitting:
            self.used.add(row.line)
            facts |= row.say
        if not facts:
            return recording, bool(fitting)
        episode = replace(recording.episode, info={**recording.episode.info, **facts})
        return replace(recording, episode=episode), True

    @property
    def unused(self) -> tuple[int, ...]:
        """Lines of the rows that matched no recording."""
        return tuple(row.line for row in self.rows if row.line not in self.used)


def read_manifest(path: Path) -> SessionManifest:
    """Read the CSV manifest at ``path``.

    Raises:
        InputError: there is no such file.
        FormatError: a required column is missing, a row selects nothing, or a number is malformed.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise FormatError(f"Expected a manifest of at most 64 MiB: {path}", code="H3-HABITAT-078")
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"The manifest cannot be read ({error.strerror}): {path}", code="H3-HABITAT-079") from None
    except UnicodeDecodeError:
        raise FormatError(f"Expected a manifest as CSV in UTF-8: {path}", code="H3-HABITAT-080") from None
    lines = csv.DictReader(text.splitlines(), skipinitialspace=True)
    names = [name.strip() for name in lines.fieldnames or () if name]
    lines.fieldnames = [(name or "").strip() for name in lines.fieldnames or ()]
    for kind, some, example in (("chooses recordings", CHOOSING, "file"), ("says something", SAYING, "condition")):
        if not set(some) & set(names):
            near = next((hint for name in names if (hint := did_you_mean(name, some))), "")
            raise FormatError(
                f"Expected a column that {kind} ({', '.join(some)}), got {', '.join(names) or 'none'}.{near} "
                f"Hint: a manifest begins with a line such as file,participant,condition ({example} is missing): {path}",
                code="H3-HABITAT-081",
            )
    rows = []
    for cells in lines:
        given = {k: v.strip() for k, v in cells.items() if isinstance(k, str) and isinstance(v, str) and v.strip()}
        if given:
            rows.append(_row(lines.line_num, given, path))
    if not rows:
        raise FormatError(f"The manifest has no rows: {path}", code="H3-HABITAT-076")
    ignored = tuple(name for name in names if name not in (*CHOOSING, *SAYING))
    return SessionManifest(path=path, rows=tuple(rows), ignored=ignored)


def _row(line: int, given: Mapping[str, str], path: Path) -> ManifestRow:
    choose = {name: given[name] for name in CHOOSING if name in given}
    say: dict[str, str | int] = {name: given[name] for name in SAYING if name in given}
    if not choose:
        raise FormatError(
            f"Line {line} chooses no recording: fill in one of {', '.join(CHOOSING)}: {path}", code="H3-HABITAT-077"
        )
    for name in _NUMBERS:
        if name in say:
            if not given[name].isdecimal() or not 0 < int(given[name]) < 10**9:
                raise FormatError(
                    f"Expected a number of steps in {name} of line {line}, got {given[name]!r}: {path}",
                    code="H3-HABITAT-082",
                )
            say[name] = int(given[name])
    return ManifestRow(line=line, choose=choose, say=say)


def _pseudonym(user_id: str) -> str:
    return anonymous_id(user_id, key=participant_key())
