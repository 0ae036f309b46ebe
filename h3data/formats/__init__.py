"""File formats: detection by content, readers into recordings, and writers of recordings.

One table (`h3data.formats.builtin_formats`) lists the built-in formats. Installed packages add theirs by entry points of
the group ``h3data.formats``, each of which is a `Format` (h3data docs import). Readers and writers are imported at first use.
"""

from __future__ import annotations

from h3data.formats.detection import (
    FORMATS,
    detect,
    export_options,
    format_by_beginning,
    json_format,
    load,
)
from h3data.formats.format import BagStorage, Exported, ExportRequest, Format, ImportRequest, LengthUnit, PersonDetail
from h3data.formats.source_file import SourceFile

__all__ = [
    "FORMATS",
    "BagStorage",
    "ExportRequest",
    "Exported",
    "Format",
    "ImportRequest",
    "LengthUnit",
    "PersonDetail",
    "SourceFile",
    "detect",
    "export_options",
    "format_by_beginning",
    "json_format",
    "load",
]
