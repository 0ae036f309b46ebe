"""Handles of Habitat's objects: ``chair_:0000`` is an instance of the template ``chair``, whose files may be in any folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from h3data.errors import SceneError

HANDLE = "handle:"
"""Prefix of the URI of an asset of which only the name of the template is known."""


def file_of_template(name: str, configs: Sequence[Path], meshes: Sequence[Path]) -> Path | None:
    """Return the file that defines the template ``name``, preferably a config instead of a mesh.

    The result is None if there is no file.

    Raises:
        SceneError: several files match; the message lists them.
    """
    most = 4
    for files in (configs, meshes):
        # resolved first: one file that two roots or a link lead to counts once
        distinct = sorted({file.resolve() for file in files})
        if len(distinct) > 1:
            listed = ", ".join(map(str, distinct[:most])) + (", ..." if len(distinct) > most else "")
            raise SceneError(
                f"{len(distinct)} files fit the object handle {name!r}: {listed}. "
                "Hint: give the folder of one dataset only (assets=[DIR]).",
                code="H3-HABITAT-116",
            )
        if distinct:
            return distinct[0]
    return None
