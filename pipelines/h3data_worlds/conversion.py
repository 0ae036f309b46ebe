"""Cache of scenes converted from other formats; a result is used until one of its files changes."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from h3data.errors import H3DataError
from h3data.files import cache_folder, evict, part_file
from h3data.progress import say
from h3data.scene.records import Scene
from h3data.scene.scene_file import load_scene, save_scene

log = logging.getLogger(__name__)
VERSION = 1
"""Version that is part of every cache key; increase it when a reader changes its results."""
ROOM_BYTES = 4e9
"""Total size of conversions above which the least recently used ones are deleted [bytes]."""
_LICENCES = ("license", "licence", "copying", "notice")
_SHOWN_CHARACTERS = 2000


def converted(path: Path, options: Sequence[Any], read: Callable[[], tuple[Scene, Sequence[str] | None]]) -> Scene:
    """Return the scene of a file from the cache, or else from ``read``.

    The licence next to the file is printed when the file is converted, and is ``licence`` in `Scene.source`.

    Args:
        path: File of the scene.
        options: Options that change the result.
        read: Function that returns the scene and the files on which it depends, or None for them if some are missing,
            so that the scene is not cached.
    """
    folder = cache_folder("scenes")
    words = json.dumps([VERSION, str(path.resolve()), *map(str, options)])
    key = hashlib.sha256(words.encode()).hexdigest()
    kept = None if folder is None else _kept(folder, key)
    if kept is not None:
        return kept
    scene, files = read()
    licence = licence_beside(path)
    if licence:
        say(f"Licence of {path.name}:\n{licence}")
        scene = replace(scene, source={**scene.source, "licence": licence})
    if folder is not None and files is not None:
        try:
            _keep(folder, key, scene, [path, *map(Path, files)])
        except (OSError, H3DataError) as fault:
            log.info("The converted scene is not cached: %s", fault)
    return scene


def licence_beside(path: Path) -> str:
    """Return the first part of the licence in the folder of a file; empty if there is none."""
    with suppress(OSError):
        for file in sorted(path.resolve().parent.iterdir()):
            if file.name.lower().split(".")[0] in _LICENCES and file.is_file() and file.stat().st_size < 1e6:
                return file.read_text("utf-8", "replace")[:_SHOWN_CHARACTERS].strip()
    return ""


def _state(file: Path) -> list[Any]:
    status = file.stat()
    return [str(file), status.st_size, status.st_mtime_ns]


def _kept(folder: Path, key: str) -> Scene | None:
    try:
        wanted = json.loads((folder / f"{key}.json").read_text("utf-8"))
        if any(_state(Path(str(row[0]))) != row for row in wanted):
            return None
        scene = load_scene(folder / f"{key}.glb")
        (folder / f"{key}.glb").touch()
    except (OSError, ValueError, LookupError, TypeError, H3DataError):
        return None
    return scene


def _keep(folder: Path, key: str, scene: Scene, files: Sequence[Path]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    states = [_state(file) for file in dict.fromkeys(files)]
    (folder / f"{key}.json").unlink(missing_ok=True)
    save_scene(scene, folder / f"{key}.glb")
    with part_file(folder / f"{key}.json") as part:
        part.write_text(json.dumps(states), "utf-8")
    evict(folder, ROOM_BYTES, keep=folder / f"{key}.glb")
