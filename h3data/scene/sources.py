"""Sources of scenes: generators and files, to which packages add others by entry points of the group ``h3data.scenes``.

An entry point is a `SceneGenerator`, whose name is the kind that `Scene.source` and scene sets give (``home``), or a
`SceneReader` for files of other programs.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, cast

import msgspec

from h3data.errors import FormatError, InputError, SceneError
from h3data.plugins import Registry

if TYPE_CHECKING:
    from h3data.mesh.mesh import Mesh
    from h3data.scene.records import Scene


class SceneSpec(Protocol):
    """Specification from which a generator makes a scene.

    Specs are hashable, and equal specs give the same scene.
    """

    kind: ClassVar[str]
    """Name of the generator among the `SCENES`."""


@dataclass(frozen=True, kw_only=True)
class SceneFile:
    """Scene in a file that `h3data.scene.save_scene` wrote, or in a format that a `SceneReader` reads."""

    path: str
    """File of the scene: GLB, or Habitat's ``.scene_instance.json``, ``.stage_config.json``, ``.scene_dataset_config.json``."""
    scene: str = ""
    """Name of the scene within a file that holds several, such as a ``.scene_dataset_config.json``."""
    assets: tuple[str, ...] = ()
    """Additional folders in which the scene's files are searched; if empty, the folders in H3DATA_ASSETS."""
    strict: bool = False
    """True if warnings count as errors."""
    allow_missing: bool = False
    """True if objects whose files are missing are left out with a warning."""

    def open(self) -> Scene:
        """Read the scene from the current contents of the file.

        Raises:
            SceneError, FormatError: the file cannot be read.
        """
        # ours first: it is a GLB too, which a reader of meshes would take for a building without rooms
        if not self.scene and _is_ours(Path(self.path)):
            from h3data.scene.scene_file import load_scene

            return load_scene(self.path)
        reader = reader_of(self.path)
        if reader is None:
            endings = ", ".join(f"*{e}" for r in scene_readers() for e in r.endings) or "a GLB that h3data wrote"
            raise FormatError(f"Expected a scene ({endings}): {self.path}{missing_packages()}", code="H3-SCENE-067")
        return reader.read(self)


SceneSource = SceneSpec | SceneFile
"""Hashable specification that identifies a scene."""


@dataclass(frozen=True, kw_only=True)
class SceneSize:
    """Figures in the list of ``h3data scenes list`` for scenes of one generator; None if a figure varies or does not apply."""

    area_m2: float | None = None
    """Floor area [m2]."""
    bedrooms: int | None = None
    bathrooms: int | None = None


@dataclass(frozen=True, kw_only=True)
class SceneGenerator:
    """Generator of scenes from a name and a seed, such as ``small:3``."""

    names: Sequence[str]
    """Names that may come before the colon in the name of a scene."""
    named: Callable[[str, int], SceneSpec]
    """Function that returns the spec of a name and a seed."""
    Spec: Callable[..., SceneSpec]
    """Type of specs, made from the keywords in `Scene.source` or in a table of a scene set."""
    Table: type[msgspec.Struct]
    """Keys and types of a table in a scene set: ``id`` and the keywords of `Spec`."""
    build: Callable[[Any], Scene]
    """Function that builds the scene of a spec."""
    listed: Mapping[str, SceneSize] = field(default_factory=dict)
    """Names that ``h3data scenes list`` lists."""
    about: str = ""
    """Help text on the names of scenes, in whole sentences, which appears below their list."""


@dataclass(frozen=True, kw_only=True)
class SceneReader:
    """Reader of scenes from files of one format, which may also write such files."""

    endings: Sequence[str]
    """Suffixes of the files, in lower case."""
    read: Callable[[SceneFile], Scene]
    collection: str = ""
    """Suffix, one of `endings`, of files that hold several scenes, named as ``path#scene``; empty if none do."""
    open_collection: Callable[[Path], Any] | None = None
    """Function that makes the object that `h3data.open` returns for a collection file."""
    scenes_in: Callable[[Path], Sequence[str]] = lambda _: ()
    """Function that returns the names of the scenes in a collection file."""
    object_mesh: Callable[[str, Path, Sequence[Path]], Mesh] | None = None
    """Function that returns the mesh of an object template, as `object_mesh`."""
    write_collection: Callable[..., Path] | None = None
    """Function that writes scenes as a new collection. It is called as
    ``(scenes, folder, *, name=None, split_building=False, force=False)`` and returns the collection's file in the new
    ``folder``. ``split_building`` stores walls and floors as separate objects."""
    write_scene: Callable[[Scene, Path], Sequence[Path]] | None = None
    """Function that writes one scene as a file of this format and returns the files, the scene file first."""
    with_objects: (
        Callable[
            [Sequence[Scene], Path, Sequence[str | Path]],
            tuple[list[Scene], int, Mapping[str, Mapping[str, Any]]],
        ]
        | None
    ) = None
    """Function that replaces movable objects by object templates in a folder. It returns the scenes, the number of
    replaced objects, and facts about every template by name."""
    recognizes: Callable[[Path], bool] = lambda _: True
    """Function that returns whether a file has this format, for suffixes that other formats use too."""


def _check(entry: Any) -> None:
    if not isinstance(entry, SceneGenerator | SceneReader):
        raise InputError(
            f"Expected an h3data.scene.sources.SceneGenerator or SceneReader, got {entry!r:.60}.", code="H3-SCENE-065"
        )


SCENES: Registry[SceneGenerator | SceneReader] = Registry("h3data.scenes", {}, what="kind of scenes", check=_check)
"""Generators and readers of scenes by kind."""


@cache
def _installed(path: tuple[str, ...]) -> dict[str, SceneGenerator | SceneReader]:
    """Return all entries, as of one ``sys.path``: looking for installed packages takes 30 ms."""
    return SCENES.load_all()


def scene_generators() -> dict[str, SceneGenerator]:
    """Return the installed generators of scenes by the kind of scene that they make."""
    return {kind: entry for kind, entry in _installed(tuple(sys.path)).items() if isinstance(entry, SceneGenerator)}


def scene_readers() -> list[SceneReader]:
    """Return the installed readers of scene files."""
    return [entry for entry in _installed(tuple(sys.path)).values() if isinstance(entry, SceneReader)]


def reader_of(path: str) -> SceneReader | None:
    """Return the reader of a scene file, by its name and, if formats share an ending, its content.

    The result is None if no reader fits.
    """
    text = path.lower()
    fitting = (reader for reader in scene_readers() if text.endswith(tuple(reader.endings)))
    # a generator, so that a file is opened only where the ending alone does not decide
    return next((reader for reader in fitting if reader.recognizes(Path(path))), None)


def scene_of(source: SceneSource) -> Scene:
    """Generate or read a scene without caching (`h3data.scene.open.open_scene` caches scenes).

    Raises:
        InputError: the package that generates such scenes is not installed.
        SceneError, FormatError: the scene cannot be generated or read.
    """
    if isinstance(source, SceneFile):
        return source.open()
    return cast(SceneGenerator, SCENES.get(source.kind)).build(source)


def scene_files(maker: str) -> SceneReader:
    """Return the reader and writer of scene files of a kind, such as ``habitat``.

    Raises:
        InputError: the package that provides it is not installed.
    """
    return cast(SceneReader, SCENES.get(maker))


def object_mesh(name: str, file: Path, roots: Sequence[Path]) -> Mesh:
    """Return the mesh of the object template ``name`` [m], in the frame of the object's logged poses.

    The origin of that frame is the centre of mass.

    Args:
        name: Name of the template.
        file: Config or mesh file of the template.
        roots: Folders in which files that a config names are searched.

    Raises:
        SceneError: the template cannot be used, or no installed package reads such files.
    """
    reader = reader_of(str(file))
    if reader is None or reader.object_mesh is None:
        raise SceneError(
            f"No installed package reads the object template {name!r}: {file}{missing_packages()}", code="H3-SCENE-066"
        )
    return reader.object_mesh(name, file, roots)


def missing_packages() -> str:
    """Return a hint with the missing packages of h3data that provide more scenes; empty if all are installed."""
    missing = ", ".join(f"{package} ({kind})" for kind, package in SCENES.missing().items())
    return f" Hint: this installation lacks {missing}; install h3data as a whole." if missing else ""


def _is_ours(path: Path) -> bool:
    """Return whether `h3data.scene.save_scene` wrote it: any other GLB is a mesh."""
    from h3data.mesh.glb import unpack_glb

    if path.suffix.lower() != ".glb" or not path.is_file():
        return False
    try:
        extras = unpack_glb(path.read_bytes(), str(path), what="a scene as GLB")[0].get("extras")
    except FormatError:
        return False
    return isinstance(extras, dict) and isinstance(extras.get("h3data"), dict) and "format" in extras["h3data"]
