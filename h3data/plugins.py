"""Registries that installed packages can extend: tasks, robots, policies, metric profiles, file formats.

A `Registry` finds built-in implementations in a table and third-party ones in the entry points of one group;
``module:name`` names an implementation without an entry point. Implementations are imported at first use.

Names from a file are looked up within `names_from_data`, where ``module:name`` is refused unless the user has trusted
the module (`trust`). Opening a file from another person therefore never runs Python code from its folder.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import os
import re
import shlex
import sys
import tomllib
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, Generic, TypeVar

from h3data.errors import H3DataError, InputError, PluginError, UntrustedNameError, suggest

T = TypeVar("T")

REFERENCE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")
"""Pattern of ``module:name``, as in an entry point."""


TRUST_VARIABLE = "H3DATA_TRUST"
"""Environment variable with the trusted modules, separated by commas, which worker processes inherit."""

# a context variable, not a global: one thread may read a file while another one serves its user
_FROM_DATA: ContextVar[bool] = ContextVar("names come from data", default=False)


@contextmanager
def names_from_data() -> Iterator[None]:
    """Mark names in this context as read from a file, so that only built-in, installed and trusted ones are looked up."""
    token = _FROM_DATA.set(True)
    try:
        yield
    finally:
        _FROM_DATA.reset(token)


def come_from_data() -> bool:
    """Return whether names in this context come from a file (`names_from_data`), and not from the user."""
    return _FROM_DATA.get()


def trust(*modules: str) -> None:
    """Allow files to name objects of these modules and their submodules, in this process and in processes that it starts.

    A module that the user names (``Registry.get`` outside `names_from_data`) becomes trusted too.
    """
    for module in modules:
        if not re.fullmatch(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*", module):
            raise InputError(
                f"Expected the name of a module to trust, such as my_package.my_task, got {module!r}.",
                code="H3-FILE-012",
            )
    os.environ[TRUST_VARIABLE] = ",".join(dict.fromkeys([*_trusted(), *modules]))


def _trusted() -> list[str]:
    return [name for name in os.environ.get(TRUST_VARIABLE, "").split(",") if name]


def _is_working_directory(folder: str) -> bool:
    """Return whether an entry of ``sys.path`` is the working directory; "" stands for it."""
    try:
        return os.path.samefile(folder or ".", ".")
    except OSError:
        return False


def _last_change(folder: str) -> tuple[str, int, int, int]:
    """Return name, inode, number of links and last change [ns] of a folder."""
    try:
        state = os.stat(folder)
    except OSError:  # not every entry of sys.path exists
        return folder, 0, 0, 0
    # two changes within one tick of the clock of files differ in the number of subfolders
    return folder, state.st_ino, state.st_nlink, state.st_mtime_ns


@lru_cache(maxsize=1)
def _installed_entries(_installed: tuple[tuple[str, int, int, int], ...]) -> Any:
    """Read the entry points of all installed packages, which takes 10 to 20 ms; the result has ``select(group=)``."""
    return importlib.metadata.entry_points()


def _is_editable(distribution: importlib.metadata.Distribution | None) -> bool:
    """Return whether pip left a note with the installed package that its modules are used from where they are written."""
    note = distribution.read_text("direct_url.json") if distribution is not None else None
    try:
        return bool(json.loads(note or "{}")["dir_info"]["editable"])
    except (ValueError, KeyError, TypeError):
        return False


@contextmanager
def _installed_modules_only() -> Iterator[None]:
    """Let imports find nothing in the working directory."""
    kept = list(sys.path)
    sys.path[:] = [folder for folder in kept if not _is_working_directory(folder)]
    try:
        yield
    finally:
        sys.path[:] = kept


class PluginWarning(UserWarning):
    """Warning about an installed plug-in that is ignored, while other plug-ins still work."""


@dataclass(frozen=True)
class Plugin:
    """Entry of a registry that has not been imported yet."""

    name: str
    value: Any
    """Reference ``module:name``, or the object itself."""
    distribution: str = ""
    """Name and version of the installed package; empty for built-in entries and references by ``module:name``."""
    editable: bool = False
    """True if the package is installed with ``pip install -e``, so that its modules may lie in the working directory."""

    def load(self) -> Any:
        """Return the object itself; raise whatever importing its module raises."""
        if not isinstance(self.value, str):
            return self.value
        if (
            self.distribution and not self.editable
        ):  # an installed package: nothing in the working directory takes the place of its modules
            with _installed_modules_only():
                return load_reference(self.value)
        return load_reference(self.value)


@cache
def own_entries(group: str) -> dict[str, str]:
    """Return references ``module:name`` of the entry points of a group that belong to this package, by name.

    The modules need not be installed.
    """
    return dict(_own_groups().get(group, {}))


@cache
def _own_groups() -> dict[str, dict[str, str]]:
    """Return `own_entries` by group."""
    # a source tree first: what pip wrote down when it was installed may be older
    file, groups = Path(__file__).parents[1] / "pyproject.toml", {}
    project = tomllib.loads(file.read_text("utf-8")).get("project", {}) if file.is_file() else {}
    if project.get("name") == "h3data":  # some packages leave such a file where they are installed
        return project["entry-points"]
    with suppress(importlib.metadata.PackageNotFoundError):
        for point in importlib.metadata.distribution("h3data").entry_points:
            groups.setdefault(point.group, {})[point.name] = point.value
    return groups


def _is_there(reference: str) -> bool:
    """Return whether the package of ``module:name`` is installed; a folder without files (a namespace) does not count."""
    spec = importlib.util.find_spec(reference.partition(":")[0].partition(".")[0])
    # a folder that an uninstallation has left behind is found as a namespace, which has no file
    return spec is not None and spec.origin is not None


def missing_part(fault: ModuleNotFoundError) -> str:
    """Return the name of the h3data package that an import did not find.

    Empty if the missing module is not part of h3data.
    """
    package = (fault.name or "").partition(".")[0]
    return package if package.startswith("h3data_") and not _is_there(package) else ""


def import_name(module: str, name: str) -> Any:
    """Return an object from a module of a package that may not be installed.

    Raises:
        InputError: a package of h3data is missing; the message names it.
    """
    try:
        return getattr(importlib.import_module(module), name)
    except ModuleNotFoundError as fault:
        if missing := missing_part(fault):
            raise _without(name, missing) from fault
        raise


def _without(what: str, package: str) -> InputError:
    return InputError(
        f"{what} needs the package {package}, which this installation does not have. Hint: install h3data as a whole.",
        code="H3-FILE-010",
    )


def load_reference(reference: str) -> Any:
    """Return the object that ``module:name`` refers to; raise whatever importing its module raises."""
    return EntryPoint("", reference, "").load()


class Registry(Generic[T]):
    """Built-in and third-party implementations of one kind, found by name.

    Built-in names cannot be taken over. If two packages register the same name, the name is refused; both objects
    remain available as ``module:name``.

    Example:
        TASKS = Registry("h3data.tasks", {"social_nav": "sim_kinematic.tasks.social_nav:TASK"}, what="task")
        TASKS.get("social_nav")
        TASKS.get("my_package.my_task:TASK")
    """

    def __init__(
        self,
        group: str,
        built_in: Mapping[str, str | T],
        *,
        what: str,
        check: Callable[[Any], None] | None = None,
    ) -> None:
        """Create a registry; read no entry points yet.

        Args:
            group: the group of entry points, such as ``h3data.tasks``.
            built_in: ``module:name`` of each built-in entry, or the object itself if it is cheap to import, by name. An entry
                point of a package that comes with this one takes the place of the entry of its name; ``""`` only keeps a
                place in the order for it.
            what: what an entry is called in error texts, such as "task" or "metric profile".
            check: raises an `InputError` that names the missing or wrong field of a loaded object.
        """
        self.group = group
        self.what = what
        self._table = {name: Plugin(name, value) for name, value in built_in.items()}
        self._check = check
        self._scanned: tuple[Any, dict[str, list[Plugin]]] = ((), {})

    @cached_property
    def _own(self) -> dict[str, Plugin]:
        """Entries of packages that come with this one, whether they are installed or not."""
        return {name: Plugin(name, value) for name, value in own_entries(self.group).items()}

    @cached_property
    def _built_in(self) -> dict[str, Plugin]:
        """Entries of the table, then those of the packages that come with this one and are installed."""
        there = {name: entry for name, entry in self._own.items() if _is_there(entry.value)}
        return {name: entry for name, entry in (self._table | there).items() if entry.value != ""}

    def _load_built_in(self, name: str) -> Any:
        """Return an entry of the table, or of a package that comes with this one.

        Raises:
            InputError: that package, or another one that it needs, is not there.
        """
        entry = self._own.get(name)
        if entry is None:
            return self._table[name].load()
        missing = str(entry.value).partition(".")[0]
        if _is_there(entry.value):
            try:
                return entry.load()
            except ModuleNotFoundError as fault:
                missing = missing_part(fault)
                if not missing:
                    raise
        raise _without(f"The {self.what} {name!r}", missing)

    def names(self) -> tuple[str, ...]:
        """Return names that `get` accepts: built-in ones in the order of their table, then third-party ones from A to Z."""
        return tuple(entry.name for entry in self.entries())

    def entries(self) -> tuple[Plugin, ...]:
        """Return all entries without importing them; warn about third-party entries whose names are already taken."""
        third_party = self._third_party()
        for name, claims in third_party.items():
            if name in self._built_in or len(claims) > 1:
                warnings.warn(self._conflict(name, claims), PluginWarning, stacklevel=3)
        # of a contested name nobody gets it: which package wins would depend on the order of folders
        unique = [claims[0] for _, claims in sorted(third_party.items()) if len(claims) == 1]
        return *self._built_in.values(), *(entry for entry in unique if entry.name not in self._built_in)

    def get(self, name: str) -> T:
        """Return the object registered as ``name``, or the one that ``module:name`` refers to.

        Raises:
            InputError: nothing is registered under this name.
            UntrustedNameError: the name comes from data (`names_from_data`), and the user has not trusted its module.
            PluginError: the third-party object cannot be imported, fails the check, or two packages claim its name.
        """
        if name in self._built_in or name in self._own:
            return self._load_built_in(name)
        claims = self._third_party().get(name, [])
        if len(claims) > 1:
            raise PluginError(self._conflict(name, claims), code="H3-FILE-013")
        if claims:
            return self._load(claims[0])
        if REFERENCE.fullmatch(name):
            for entry in (one for claims in self._third_party().values() for one in claims if one.value == name):
                return self._load(entry)  # installed, only named in full
            # with the dot: ``my_package`` must not stand for ``my_package_of_somebody_else``
            module = f"{name.partition(':')[0]}."
            if _FROM_DATA.get() and not any(module.startswith(f"{known}.") for known in _trusted()):
                raise UntrustedNameError(self._untrusted(name), code="H3-FILE-014")
            if not _FROM_DATA.get():
                trust(name.partition(":")[0])  # whoever names it runs it: files may name it too from now on
            if os.getcwd() not in sys.path:
                sys.path.append(os.getcwd())  # only now, after everything that is installed: see h3data docs sharing
            return self._load(Plugin(name, name))
        known = self.names()
        raise InputError(
            f"Unknown {self.what} {name!r}.{suggest(name, known, more='; or module:name')}", code="H3-FILE-011"
        )

    def missing(self) -> dict[str, str]:
        """Return the packages of h3data that are not installed, by the names of the entry points that they would add."""
        return {
            name: str(entry.value).partition(":")[0].partition(".")[0]
            for name, entry in self._own.items()
            if not _is_there(entry.value)
        }

    def load_all(self) -> dict[str, T]:
        """Return every object by name; warn about plug-ins that cannot be loaded and leave them out."""
        loaded: dict[str, T] = {}
        for name in self._built_in:
            with suppress(InputError) if name in self._own else nullcontext():  # a package that it needs is not there
                loaded[name] = self._load_built_in(name)
        return loaded | self.load_third_party()

    def load_third_party(self) -> dict[str, T]:
        """Return the objects that installed packages add; warn about those that cannot be loaded."""
        loaded: dict[str, T] = {}
        for entry in self.entries()[len(self._built_in) :]:
            try:
                loaded[entry.name] = self._load(entry)
            except H3DataError as error:
                warnings.warn(f"Ignored: {error}", PluginWarning, stacklevel=3)
        return loaded

    def origin(self, name: str) -> str:
        """Return the name as written in error messages: with package and entry point if it comes from a plug-in."""
        claims = self._third_party().get(name, [])
        return self._origin(claims[0]) if claims and name not in self._built_in else repr(name)

    def _third_party(self) -> dict[str, list[Plugin]]:
        """Return the installed entry points by name; several if packages disagree about what the name stands for.

        They are read again only after a package has been installed or removed, or the working directory has changed: files are
        recognized and metrics found thousands of times in a process.
        """
        # as long as these folders are the same, the same packages are installed
        installed = tuple(_last_change(folder or ".") for folder in (".", *sys.path))
        if self._scanned[0] != installed:
            self._scanned = installed, self._scan(_installed_entries(installed).select(group=self.group))
        return self._scanned[1]

    def _scan(self, points: Iterable[EntryPoint]) -> dict[str, list[Plugin]]:
        claims: dict[str, list[Plugin]] = {}
        for point in points:
            package = f"{point.dist.name} {point.dist.version}" if point.dist is not None else "an unnamed package"
            if point.dist is not None and point.dist.name == "h3data":
                continue  # built in
            if point.dist is not None and _is_working_directory(str(Path(str(point.dist.locate_file(""))))):
                continue  # came with data, perhaps: a package counts as installed where Python installs packages
            built_in = self._built_in.get(point.name)
            rivals = claims.setdefault(point.name, [])
            # one object may be announced twice, as where a package is installed in two places
            if point.value not in (other.value for other in (*rivals, *([built_in] if built_in else []))):
                rivals.append(Plugin(point.name, point.value, package, editable=_is_editable(point.dist)))
        return {name: rivals for name, rivals in claims.items() if rivals}

    def _load(self, entry: Plugin) -> T:
        try:
            loaded = entry.load()
        except H3DataError:
            raise  # already says what to do, such as which extra to install
        except Exception as fault:  # a plug-in's module can raise anything
            by_reference = not entry.distribution and isinstance(fault, ModuleNotFoundError)
            hint = " Hint: the module must be installed or its folder on PYTHONPATH." if by_reference else ""
            raise PluginError(
                f"The {self.what} {self._origin(entry)} cannot be imported: {type(fault).__name__}: {fault}.{hint}",
                code="H3-FILE-015",
            ) from fault
        if self._check is not None:
            try:
                self._check(loaded)
            except InputError as fault:
                raise PluginError(
                    f"The {self.what} {self._origin(entry)} is not usable: {fault}", code="H3-FILE-016"
                ) from fault
        return loaded

    def _origin(self, entry: Plugin) -> str:
        if not entry.distribution:
            return repr(entry.name)
        return (
            f"{entry.name!r} (entry point {entry.value} of the group {self.group}, installed by {entry.distribution})"
        )

    def _untrusted(self, name: str) -> str:
        module = name.partition(":")[0]
        # also ``python -m h3data_pipelines.cli``, whose first argument is a file of the package
        program = Path(sys.argv[0])
        is_command = program.name in ("h3data", "h3data.exe") or "h3data_pipelines" in program.parts
        command = shlex.join(["h3data", *sys.argv[1:], "--trust", module]) if is_command else ""
        return (
            f"A file names the {self.what} {name!r}, which is neither built in nor installed; using it would run the Python "
            f"module {module}. Hint: if you know and trust that module, "
            + (f"run: {command}" if command else f"call h3data.plugins.trust({module!r}) first.")
        )

    def _conflict(self, name: str, claims: list[Plugin]) -> str:
        packages = " and ".join(f"{claim.value} of {claim.distribution}" for claim in claims)
        if name in self._built_in:
            return f"The {self.what} {name!r} is built in; {packages} cannot replace it and is ignored (group {self.group})."
        return (
            f"The {self.what} {name!r} is claimed by {packages} (entry points of the group {self.group}). "
            "Hint: uninstall one of them, or name the one you mean as module:name."
        )


def own_version() -> str:
    """Return the installed version of this package, or ``source`` if it is a source tree on PYTHONPATH."""
    try:
        return importlib.metadata.version("h3data")
    except importlib.metadata.PackageNotFoundError:
        return "source"
