"""Location of the data and documentation that ship with the package.

In a checkout these are the folders `datasets/` and `docs/`; in an installed wheel `h3data/_datasets` and
`h3data/_docs`.
"""

from __future__ import annotations

from pathlib import Path

from h3data.errors import InputError


def builtin_root() -> Path:
    """Return the folder of the shipped definitions and baked assets (bodies, robots, dataset specs).

    Raises:
        InputError: the installation is incomplete.
    """
    return shipped("_datasets", "datasets", "built-in data of h3data")


def shipped(installed: str, checkout: str, what: str) -> Path:
    """Return a folder that ships with the package: within it where it is installed, beside it in a checkout.

    Raises:
        InputError: the installation is incomplete.
    """
    # the wheel's folder first, as a checkout has none; an installed package may have anything beside it
    package = Path(__file__).resolve().parent
    for candidate in (package / installed, package.parent / checkout):
        if candidate.is_dir():
            return candidate
    raise InputError(
        f"The {what} are missing: expected a folder {installed} beside {package}/__init__.py. "
        "Hint: reinstall the wheel (pip install --force-reinstall h3data).",
        code="H3-FILE-006",
    )


def builtin_path(relative: str) -> Path:
    """Return the path of one shipped file, e.g. ``builtin_path("bodies/female_0.npz")``.

    Raises:
        InputError: there is no such file; the message lists its siblings.
    """
    path = builtin_root() / relative
    if not path.exists():
        siblings = sorted(p.name for p in path.parent.iterdir()) if path.parent.is_dir() else []
        raise InputError(
            f"No built-in file {relative!r}. Available there: {', '.join(siblings) or 'nothing'}.", code="H3-FILE-007"
        )
    return path
