"""Views and reports from Python: ``h3data.view`` and ``h3data.report``. Each is imported at first use."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from h3data_viewers.commands.reporting import report as report
    from h3data_viewers.commands.viewing import view as view

_HOMES = {"report": "h3data_viewers.commands.reporting", "view": "h3data_viewers.commands.viewing"}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'h3data_viewers.api' has no attribute {name!r}; it has {', '.join(_HOMES)}")
    return getattr(importlib.import_module(_HOMES[name]), name)
