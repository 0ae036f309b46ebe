"""Location of the data that ship with the package: `datasets/` in a checkout, `h3data/_datasets` in an installed wheel."""

from __future__ import annotations

from pathlib import Path

from h3data.errors import InputError


def builtin_root() -> Path:
    """Folder of the shipped definitions and baked assets (bodies, robots, dataset specs).

    Raises:
        InputError: the installation is incomplete.
    """
    package = Path(__file__).resolve().parent
    for candidate in (package / "_datasets", package.parent / "datasets"):
        if candidate.is_dir():
            return candidate
    raise InputError(
        f"The built-in data of h3data are missing: expected a folder _datasets beside {package}/__init__.py. "
        "Hint: reinstall the wheel (pip install --force-reinstall h3data)."
    )


def pages_root() -> Path:
    """Folder of the documentation's pages: `docs/` in a checkout, `h3data/_docs` in an installed wheel.

    Raises:
        InputError: the installation is incomplete.
    """
    package = Path(__file__).resolve().parent
    for candidate in (package / "_docs", package.parent / "docs"):
        if candidate.is_dir():
            return candidate
    raise InputError(
        f"The pages of the documentation are missing: expected a folder _docs beside {package}/__init__.py."
    )


def builtin_path(relative: str) -> Path:
    """Path of one shipped file, e.g. ``builtin_path("bodies/female_0.npz")``.

    Raises:
        InputError: there is no such file; the message lists its siblings.
    """
    path = builtin_root() / relative
    if not path.exists():
        siblings = sorted(p.name for p in path.parent.iterdir()) if path.parent.is_dir() else []
        raise InputError(f"No built-in file {relative!r}. Available there: {', '.join(siblings) or 'nothing'}.")
    return path
