"""Names of file formats in the arguments of commands."""

from __future__ import annotations

from h3data.errors import InputError, suggest
from h3data.formats import FORMATS, Format, export_options


def import_suffixes() -> tuple[str, ...]:
    """Return the suffixes of the files that `h3data import` collects from a folder."""
    readable = (one for one in FORMATS.load_all().values() if one.read is not None)
    return tuple(dict.fromkeys(suffix for one in readable for suffix in one.suffixes))


def export_format(name: str) -> Format:
    """Return the export format with a name, or the format given as ``module:name``.

    Raises:
        InputError: there is no such export format.
        PluginError: the format belongs to a plug-in that cannot be loaded.
    """
    key = name if ":" in name else name.replace("-", "_")
    if key in FORMATS.missing():
        return FORMATS.get(key)  # fails, and says which package has it
    try:
        chosen = FORMATS.get(key)
    except InputError:
        chosen = None
    if chosen is not None and chosen.write is not None:
        return chosen
    options = export_options()
    if name.lower() in ("habitat", "scene", "scenes"):
        raise InputError(
            f"Cannot export to {name!r}. Hint: `h3data scenes export` writes scenes for Habitat; --to habitat-episodes writes "
            "the episodes of recordings, --to gfx-replay one recording.",
            code="H3-FORMAT-004",
        )
    raise InputError(
        f"Cannot export to {name!r}.{suggest(name, options, more='; or module:name')}", code="H3-FORMAT-001"
    )
