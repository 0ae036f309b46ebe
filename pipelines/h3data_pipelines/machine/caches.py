"""Command ``h3data cache``, which lists and removes files on disk that make later runs faster."""

from __future__ import annotations

import importlib.util
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from h3data.commands.command import Group, JsonFlag, Outcome
from h3data.errors import InputError, suggest
from h3data.files import cache_folder, size_text
from h3data.terminal import counted

KINDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "kernels": ("functions compiled on this machine", (".nbi", ".nbc", ".lock")),
    "freespace": ("where agents can stand, and paths", (".npz", ".part")),
    "light": ("baked light of homes", (".npz", ".part")),
    "arrow": ("columns of datasets for training", (".arrow", ".part")),
    "gpu": ("functions compiled for a GPU", (".cubin", ".part")),
}
"""Description of each cache, and the suffixes of its files; other files in its folder are neither counted nor
deleted.
"""


@dataclass(frozen=True)
class Cache:
    """Cache of files of one kind that can be generated again."""

    name: str
    holds: str
    folder: Path | None
    """Folder of the cache's files, or their parent folder for kernels; None if no files are stored."""
    files: tuple[Path, ...]

    @property
    def bytes(self) -> int:
        """Size of all files of the cache."""
        return sum(path.stat().st_size for path in self.files if path.exists())

    def row(self) -> dict[str, Any]:
        """Return the contents, size and folder of the cache, for JSON."""
        folder = None if self.folder is None else str(self.folder)
        return {"holds": self.holds, "bytes": self.bytes, "files": len(self.files), "folder": folder}


def find_caches() -> list[Cache]:
    """Return all caches in their current state, by the names of `KINDS`."""
    return [_find(name) for name in KINDS]


def cache_lines(caches: list[Cache]) -> list[str]:
    """Return the caches as lines of a table."""
    return [
        f"  {cache.name:<10} {size_text(cache.bytes):>9}  {cache.holds}{f': {cache.folder}' if cache.folder else ''}"
        for cache in caches
    ]


def _find(name: str) -> Cache:
    holds, endings = KINDS[name]
    if name == "kernels":
        files = kept_files()
        folders = {path.parent for path in files}
        return Cache(name, holds, Path(os.path.commonpath(folders)) if folders else None, tuple(files))
    folder = cache_folder(name)
    if folder is None:
        return Cache(name, holds, None, ())
    inside = sorted(folder.iterdir()) if folder.is_dir() else []
    return Cache(name, holds, folder, tuple(p for p in inside if p.suffix in endings and p.is_file()))


@dataclass(frozen=True)
class CacheList:
    """List the caches with their sizes and folders.

    Examples:
        h3data cache list
        h3data cache list --json
    """

    json: JsonFlag = False

    def run(self) -> Outcome:
        """Return a table of the caches."""
        caches = find_caches()
        return Outcome(text="\n".join(cache_lines(caches)), data={cache.name: cache.row() for cache in caches})


@dataclass(frozen=True)
class CacheClear:
    """Delete caches, whose contents are generated again when they are needed, which takes time.

    Examples:
        h3data cache clear light freespace
        h3data cache clear
    """

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """Names of caches, as `h3data cache list` shows them (default: all caches)."""
    json: JsonFlag = False

    def run(self) -> Outcome:
        """Delete the caches and return the number of bytes that became free."""
        for name in self.names:
            if name not in KINDS:
                raise InputError(f"Unknown cache {name!r}.{suggest(name, KINDS)}", code="H3-MACHINE-011")
        freed: dict[str, int] = {}
        for cache in find_caches():
            if cache.name in (self.names or KINDS):
                freed[cache.name] = cache.bytes
                for path in cache.files:
                    _delete(path)
        text = ", ".join(f"{name} {size_text(count)}" for name, count in freed.items())
        return Outcome(text=f"Deleted {counted(len(freed), 'cache')}: {text}.", data={"bytes": freed})


def _delete(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"Cannot delete a cached file ({error.strerror}): {path}", code="H3-MACHINE-010") from None


CACHE = Group("List and clear the caches of h3data.", {"list": CacheList, "clear": CacheClear})


def kept_files() -> list[Path]:
    """Return all files of numba's cache of h3data's kernels, from every folder where numba may store them.

    Files of earlier versions and other settings are included.
    """
    from numba.core import config
    from numba.core.caching import _CacheLocator
    from numba.misc.appdirs import AppDirs

    from h3data.kernels.digests import OURS

    places: set[str] = set()
    for name in OURS:
        spec = importlib.util.find_spec(name)
        for root in (spec.submodule_search_locations or ()) if spec else ():
            for folder, _, files in os.walk(root):
                if source := next((file for file in files if file.endswith(".py")), None):
                    apart = _CacheLocator.get_suitable_cache_subpath(os.path.join(folder, source))
                    wide = (vars(config)["CACHE_DIR"], AppDirs(appname="numba", appauthor=False).user_cache_dir)
                    places |= {os.path.join(folder, "__pycache__"), *(os.path.join(w, apart) for w in wide if w)}
    found = (path for place in places for path in Path(place).glob("*.nb[ci]*"))
    return sorted(path for path in found if path.suffix in (".nbi", ".nbc", ".lock"))
