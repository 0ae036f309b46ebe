"""Functions that show recordings from Python: ``h3data.view`` and ``h3data.report``.

Both are imported at first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from h3data.moved import lazy_names

if TYPE_CHECKING:
    from h3data_viewers.commands.reporting import report as report
    from h3data_viewers.commands.viewing import view as view

__getattr__ = lazy_names(
    __name__, {"report": "h3data_viewers.commands.reporting", "view": "h3data_viewers.commands.viewing"}
)
