"""Where the package's own data lie: `datasets/` in a checkout, `h3data/_datasets` in an installed wheel."""

from __future__ import annotations

from pathlib import Path

from h3data.errors import InputError


def builtin_root() -> Path:
    """Folder of the shipped definitions and baked assets (bodies, robots, dataset specs)."""
    package = Path(__file__).resolve().parent
    for candidate in (package / "_datasets", package.parent / "datasets"):
        if candidate.is_dir():
            return candidate
    raise InputError(
        f"The built-in data of h3data are missing. Expected a folder _datasets beside {package}/__init__.py. "
        "Hint: install the wheel again (pip install --force-reinstall h3data)."
    )


def builtin_path(relative: str) -> Path:
    """Path of one shipped file, e.g. ``builtin_path("bodies/female_0.npz")``; names what exists if it does not."""
    path = builtin_root() / relative
    if not path.exists():
        beside = sorted(p.name for p in path.parent.iterdir()) if path.parent.is_dir() else []
        raise InputError(f"No built-in file {relative!r}. Available there: {', '.join(beside) or 'nothing'}.")
    return path
