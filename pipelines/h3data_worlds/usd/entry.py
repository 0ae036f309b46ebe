"""Reader of USD scenes by path: an entry point of the group ``h3data.scenes``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from h3data.scene.records import Scene
from h3data.scene.sources import SceneFile, SceneReader
from h3data_worlds.conversion import converted
from h3data_worlds.usd.stages import USD_ENDINGS


def read_scene(file: SceneFile) -> Scene:
    """Read a USD file with the options of ``file``, as `h3data_worlds.usd.reading.read_usd` does."""
    path = Path(file.path)

    def read() -> tuple[Scene, Sequence[str] | None]:
        from h3data_worlds.usd.reading import read_usd

        return read_usd(path, allow_missing=file.allow_missing, strict=file.strict)

    return converted(path, ("usd", file.allow_missing, file.strict), read)


def write_scene(scene: Scene, path: Path) -> Sequence[Path]:
    """Write a USD file; see `h3data_worlds.usd.writing.write_usd`, which is imported at first use."""
    from h3data_worlds.usd.writing import write_usd

    return write_usd(scene, path)


USD = SceneReader(endings=USD_ENDINGS, read=read_scene, write_scene=write_scene)
