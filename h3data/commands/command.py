"""Shared parts of all commands: their result, common options, and safe output folders."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, TypeVar

import tyro

from h3data.bodies.people.rigid_parts import PeopleStyle
from h3data.errors import InputError
from h3data.files import part_file
from h3data.recording import Recording
from h3data.recording.storage import AnyPath, RemotePath, local
from h3data.render.light.sources import LightMode
from h3data.terminal import counted

if TYPE_CHECKING:
    from h3data.replay import Replay

P = TypeVar("P", Path, RemotePath, AnyPath)
JsonFlag = Annotated[bool, tyro.conf.arg(help="Print one JSON object on stdout instead of text.")]
ForceFlag = Annotated[bool, tyro.conf.arg(help="Overwrite existing output.")]
AssetsOption = Annotated[
    tuple[Path, ...],
    tyro.conf.arg(help="More folders to search for a Habitat scene's files (default: H3DATA_ASSETS)."),
]
DryRunFlag = Annotated[bool, tyro.conf.arg(help="Print what would be done, and do nothing.")]
PeopleOption = Annotated[PeopleStyle, tyro.conf.arg(help="Appearance of people: skin, collision capsules, or bones.")]
StandInsFlag = Annotated[
    bool,
    tyro.conf.arg(
        help="Draw built-in robots and people in the recorded postures, and boxes with names, for assets that are not found, "
        "instead of striped shapes."
    ),
]
LightOption = Annotated[
    LightMode,
    tyro.conf.arg(help="Light in pictures: baked, from windows, sun and lamps; or flat, the same everywhere."),
]
BackendOption = Annotated[
    Literal["auto", "cpu", "gpu"],
    tyro.conf.arg(help="Renderer: cpu; gpu, whose images differ in a few pixels; or auto, a GPU if there is one."),
]
RuleSet = Literal["natural", "paper"]
RuleSetOption = Annotated[
    RuleSet | None,
    tyro.conf.arg(
        help="Rules of the task: natural, whose people walk curves at 1.3 m/s, set off and brake; or paper, those behind the "
        "paper's numbers, whose people turn on the spot and are at 2.5 m/s at once; in rearrange also 750 steps and nobody "
        "who gives way (default: the episode's, else natural)."
    ),
]
Observe = Literal["full", "seen"]
ObserveOption = Annotated[
    Observe | None,
    tyro.conf.arg(
        help="Knowledge of agents: full, where everything is; or seen, only where they have seen things themselves, so that "
        "they search (h3data docs language) (default: full)."
    ),
]
OverridesOption = Annotated[
    tuple[str, ...],
    tyro.conf.arg(name="set", help="A single rule of the task, as NAME=VALUE: --set objects=3 --set near_m=[2.0,1.5]."),
]
MissingFlag = Annotated[
    bool, tyro.conf.arg(help="Leave out objects of a Habitat scene whose files are missing, with a warning.")
]
StepsModelOption = Annotated[
    Literal["auto", "poisson", "observation"],
    tyro.conf.arg(
        help="Model of the steps of a study: the paper's Poisson model, one with an observation effect, or auto: the paper's "
        "unless the steps vary more than it allows. A model that is not sound is never shown alone."
    ),
]
FailedOption = Annotated[
    Literal["leave-out", "limit"],
    tyro.conf.arg(help="Episodes without success: leave them out of the steps, or count the longest duration."),
]
ShareScenesFlag = Annotated[
    bool,
    tyro.conf.arg(
        help="Store each scene once for all .mcap files of the output folder, in its h3/files, instead of in each of them."
    ),
]


@dataclass(frozen=True)
class NameOf:
    """Marker of a text option that names an entry of a registry: its help lists the names, including those of plug-ins."""

    names: Callable[[], Iterable[str]]
    """Function that returns the names. It is called only when the command is chosen: finding plug-ins takes some
    milliseconds."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of a command: text for people, data for machines."""

    text: str
    data: dict[str, Any] = field(default_factory=dict)
    result: Any = None
    """Result of the command for callers from Python (`h3data_pipelines.api`)."""
    exit_code: int = 0
    """Exit code of the process: 0 if all was done, 1 if failures are listed."""


class Command(Protocol):
    """A command: a dataclass of its options with a method that runs it."""

    @property
    def json(self) -> bool:
        """Return whether the command prints its result as JSON instead of text."""
        ...

    def run(self) -> Outcome:
        """Run the command and return its result, which the command line prints."""
        ...


@dataclass(frozen=True)
class Group:
    """Group of commands with the same first word, such as ``h3data scenes list`` and ``h3data scenes show``."""

    about: str
    commands: Mapping[str, type[Command]]


def claim_folder(folder: P, *, force: bool, unfinished: Callable[[], str] = str) -> P:
    """Create an output folder; raise an `InputError` if it already has contents, unless ``force`` is set.

    Object stores need no folders.

    ``unfinished`` returns what ``--resume`` could continue in the existing contents; an empty text means nothing.
    """
    if isinstance(folder, Path):
        local(folder)
        if folder.exists() and not folder.is_dir():
            raise InputError(f"The output folder is a file. Choose another with -o: {folder}", code="H3-OPTION-008")
    # one entry is asked for: an object store may hold millions
    if not force and (isinstance(folder, RemotePath) or folder.is_dir()) and any(folder.iterdir()):
        if held := unfinished():
            raise InputError(
                f"The output folder holds {held}. --resume goes on with the same options, --force replaces it; or choose "
                f"another -o: {folder}",
                code="H3-OPTION-009",
            )
        raise InputError(
            f"The output folder is not empty. Use --force to overwrite, or another -o: {folder}", code="H3-OPTION-001"
        )
    if isinstance(folder, RemotePath):
        return folder
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"Cannot create the output folder ({error.strerror}): {folder}", code="H3-OPTION-010"
        ) from None
    _try_writing(folder, folder)
    return folder


def claim_file(path: P, *, force: bool, suffix: str = "") -> P:
    """Return the path of an output file that ends in ``suffix``.

    Raise an `InputError` if it exists and ``force`` is not set.
    """
    if suffix and path.suffix.lower() != suffix:
        raise InputError(f"Expected a file name that ends in {suffix}, got: {path}", code="H3-OPTION-002")
    if isinstance(path, Path):
        local(path)
    if path.is_dir():
        raise InputError(f"Expected a file name, this is a folder: {path}", code="H3-OPTION-003")
    if path.exists() and not force:
        raise InputError(
            f"The output file exists. Use --force to overwrite, or another -o: {path}", code="H3-OPTION-004"
        )
    try:
        if isinstance(path, Path):
            path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"Cannot create the folder of the output file ({error.strerror}): {path}", code="H3-OPTION-011"
        ) from None
    if isinstance(path, Path):
        _try_writing(path.parent, path)
    return path


def _try_writing(folder: Path, asked: Path) -> None:
    """Refuse a folder in which no file can be made, before work is done for what was asked for."""
    try:
        # a file, not os.access: a full disk, a quota or a network folder may refuse what its mode allows
        with NamedTemporaryFile(dir=folder, prefix=".h3data-"):
            pass
    except OSError as error:
        raise InputError(
            f"Cannot write here ({error.strerror or error}). Choose another -o: {asked}", code="H3-OPTION-012"
        ) from None


def open_episode(path: AnyPath) -> Recording:
    """Open the recording in an .mcap file, or one episode of a dataset, such as ``ds#3``."""
    from h3data.recording import Dataset, open_recording

    opened = open_recording(path)
    if isinstance(opened, Dataset):
        raise InputError(
            f"Expected a recording (.mcap), this is a dataset of {counted(len(opened), 'episode')}. Name one as {path}#0",
            code="H3-OPTION-005",
        )
    return opened


def recording_stem(path: Path) -> str:
    """Return a recording's file name without suffixes: ``my_session`` for ``my_session.gfx_replay.json.gz``."""
    name = path.name
    # from the last suffix inwards
    for suffix in (".gz", ".json", ".pkl", ".gfx_replay", ".mcap"):
        name = name.removesuffix(suffix)
    return name or path.stem


def missing_lines(replay: Replay, *, max_names: int = 8) -> list[str]:
    """Return lines of text that list the assets of a replay that were not found."""
    if not replay.missing:
        return []
    names = sorted(replay.missing)
    shown = "built-in bodies and named boxes stand in" if replay.stand_ins else "shown as striped placeholders"
    plainer = "" if replay.stand_ins else "; --stand-ins draws plain bodies and named boxes"
    lines = [
        f"{len(names)} assets not found, {shown} (Hint: --assets DIR or H3DATA_ASSETS; "
        f"h3data docs import says how to get Habitat's{plainer}):"
    ]
    for name in names[:max_names]:
        count = replay.missing[name]
        lines.append(f"  {name}" + (f"  x{count}" if count > 1 else ""))
    if len(names) > max_names:
        lines.append(f"  ... and {len(names) - max_names} more (--json lists all)")
    return lines


def read_overrides(texts: Iterable[str], **named: Any) -> tuple[tuple[str, Any], ...]:
    """Parse rules of a task from texts ``NAME=VALUE``, in which a value is JSON or a plain word.

    ``named`` holds the values of rules that have a separate option; rules with None are left out.

    Raises:
        InputError: a rule has another form, or is given twice.
    """
    overrides = [(name, value) for name, value in named.items() if value is not None]
    for text in texts:
        name, sign, value = text.partition("=")
        if not sign or not name:
            raise InputError(f"Expected --set NAME=VALUE, got {text!r}.", code="H3-OPTION-075")
        if named.get(name) is not None:
            raise InputError(f"Expected --{name} or --set {name}=..., got both.", code="H3-OPTION-098")
        # what is no JSON is a bare word
        with suppress(ValueError):
            value = json.loads(value)
        overrides.append((name, value))
    return tuple(overrides)


def write_text(path: Path, text: str) -> None:
    """Write a small file atomically, so that it appears only when it is complete."""
    with part_file(path) as part:
        part.write_text(text, encoding="utf-8")


@contextmanager
def keeping(kept: Callable[[], str]) -> Iterator[None]:
    """On Ctrl-C, print a text that states which part of the work is saved and how to continue, unless it is empty."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(kept()) from None
