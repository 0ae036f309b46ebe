"""A study that is played in a minute."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from h3data_studies.design import Design

TINY: dict[str, Any] = {
    "name": "tiny",
    "version": "1",
    "title": "Tidying up",
    "participants": 4,
    "retention": "2030-01-31",
    "contact": "study@example.org",
    "scenes": ["small:1", "small:3"],
    "episodes": 1,
    "conditions": [{"name": "solo", "partner": "solo"}, {"name": "still", "partner": "still"}],
    "consent": {"version": "1", "text": "You may stop at any time."},
    "forms": [
        {"builtin": "nasa_tlx"},
        {"builtin": "trust"},
        {
            "id": "you",
            "after": "end",
            "items": [{"id": "age", "text": "Age", "kind": "number", "min": 18, "max": 120, "required": False}],
        },
    ],
}


def tiny(**changes: Any) -> Design:
    """The study with some settings changed."""
    return msgspec.convert({**TINY, **changes}, Design)


def as_toml(data: dict[str, Any]) -> str:
    """A study file with this content; the study's tables are written inline."""

    def value(item: Any) -> str:
        if isinstance(item, dict):
            return "{" + ", ".join(f"{k} = {value(v)}" for k, v in item.items()) + "}"
        if isinstance(item, list):
            return "[" + ", ".join(map(value, item)) + "]"
        if isinstance(item, bool):
            return str(item).lower()
        return msgspec.json.encode(item).decode()

    dates = {"retention"}
    return "".join(f"{k} = {v if k in dates else value(v)}\n" for k, v in data.items())


def write_tiny(folder: Path, **changes: Any) -> Path:
    """The study file in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "study.toml"
    path.write_text(as_toml({**TINY, **changes}))
    return path
