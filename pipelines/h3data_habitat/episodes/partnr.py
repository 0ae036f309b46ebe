"""Results of PARTNR's analysis of its human trajectories, which are files of a HITL session (spec/habitat.md 5.6)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from h3data.errors import H3DataError
from h3data.formats.source_file import SourceFile, decode_json

METRICS_FILE = "processed_metrics.json"
_RESULTS = {
    "eid_to_round_needed": "rounds_needed",
    "eid_to_pc": "percent_complete",
    "eid_to_success": "success",
    "eid_to_explanation": "explanation",
}
_LEVELS = 3
"""Largest depth of ``<collection>/{raw/<session>,processed/best}/<episode>.json.gz`` below the metrics."""


def partnr_result(path: Path) -> dict[str, Any]:
    """Return the entry of an episode in ``processed_metrics.json``, in its folder or above; {} if there is none.

    Keys: ``episode_id``, ``rounds_needed``, ``percent_complete``, ``success``, ``explanation``, as far as they exist,
    and every other table that contains the episode, under the table's name.
    """
    for folder in list(Path(path).absolute().parents)[: _LEVELS + 1]:
        file = folder / METRICS_FILE
        if file.is_file():
            return _result(file, path)
    return {}


def _result(file: Path, path: Path) -> dict[str, Any]:
    try:
        content = decode_json(SourceFile(file).data)
    except (H3DataError, msgspec.DecodeError):
        return {}
    names = content.get("eid_to_filename") if isinstance(content, dict) else None
    if not isinstance(names, dict):
        return {}
    # exactly one: of several collections each may have an episode of this name
    same = [eid for eid, name in names.items() if isinstance(name, str) and _ends_alike(name, path)]
    if len(same) != 1:
        return {}
    found: dict[str, Any] = {"episode_id": same[0]}
    for key, table in content.items():
        if isinstance(table, dict) and same[0] in table and key != "eid_to_filename":
            found[_RESULTS.get(str(key), str(key))] = table[same[0]]
    return found


def _ends_alike(name: str, path: Path) -> bool:
    """Return whether a recorded file name means this file: session folder and file name are the same, or it is empty."""
    recorded, ours = Path(name).parts[-2:], path.absolute().parts[-2:]
    return bool(recorded) and recorded == ours[-len(recorded) :]
