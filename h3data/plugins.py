"""Named things that installed packages can add to: tasks, robots, policies, metric profiles, file formats.

A `Registry` knows the built-in ones from a table and third-party ones from the entry points of one group; ``module:name``
names one that is not installed as an entry point. Nothing is imported before it is asked for.
"""

from __future__ import annotations

import importlib.metadata
import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from typing import Any, Generic, TypeVar

from h3data.errors import H3DataError, InputError, PluginError, did_you_mean

T = TypeVar("T")

REFERENCE = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*")
"""``module:name``, as in an entry point."""


class PluginWarning(UserWarning):
    """An installed plug-in is ignored; the others go on working."""


@dataclass(frozen=True)
class Plugin:
    """One entry of a registry, not imported yet."""

    name: str
    value: Any
    """``module:name``, or the object itself."""
    distribution: str = ""
    """Name and version of the installed package; empty for built-in entries and references by ``module:name``."""

    def load(self) -> Any:
        """The object itself; raises whatever importing its module raises."""
        return load_reference(self.value) if isinstance(self.value, str) else self.value


def load_reference(reference: str) -> Any:
    """The object that ``module:name`` refers to; raises whatever importing its module raises."""
    return EntryPoint("", reference, "").load()


class Registry(Generic[T]):
    """Built-in and third-party implementations of one kind, found by name.

    Built-in names cannot be taken over. If two packages claim a name, neither gets it (both remain available as
    ``module:name``).

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
        """Creates a registry; reads no entry points yet.

        Args:
            group: the group of entry points, such as ``h3data.tasks``.
            built_in: ``module:name`` of each built-in entry, or the object itself if it is cheap to import, by name.
            what: what an entry is called in error texts, such as "task" or "metric profile".
            check: raises an `InputError` that names the missing or wrong field of a loaded object.
        """
        self.group = group
        self.what = what
        self._built_in = {name: Plugin(name, value) for name, value in built_in.items()}
        self._check = check

    def names(self) -> tuple[str, ...]:
        """Names that `get` accepts: built-in ones in the order of their table, then third-party ones from A to Z."""
        return tuple(entry.name for entry in self.entries())

    def entries(self) -> tuple[Plugin, ...]:
        """All entries without importing them; warns about third-party entries whose names are already taken."""
        third_party = self._third_party()
        for name, claims in third_party.items():
            if name in self._built_in or len(claims) > 1:
                warnings.warn(self._conflict(name, claims), PluginWarning, stacklevel=3)
        unique = [claims[0] for _, claims in sorted(third_party.items()) if len(claims) == 1]
        return *self._built_in.values(), *(entry for entry in unique if entry.name not in self._built_in)

    def get(self, name: str) -> T:
        """Returns the object registered as ``name``, or the one that ``module:name`` refers to.

        Raises:
            InputError: nothing is registered under this name.
            PluginError: the third-party object cannot be imported, fails the check, or two packages claim its name.
        """
        if name in self._built_in:
            return self._built_in[name].load()
        claims = self._third_party().get(name, [])
        if len(claims) > 1:
            raise PluginError(self._conflict(name, claims))
        if claims:
            return self._load(claims[0])
        if REFERENCE.fullmatch(name):
            return self._load(Plugin(name, name))
        known = self.names()
        raise InputError(
            f"Unknown {self.what} {name!r}.{did_you_mean(name, known)} Expected one of: {', '.join(known)}; or module:name."
        )

    def load_all(self) -> dict[str, T]:
        """Returns every object by name; warns about plug-ins that cannot be loaded and leaves them out."""
        return {name: entry.load() for name, entry in self._built_in.items()} | self.load_third_party()

    def load_third_party(self) -> dict[str, T]:
        """Returns the objects that installed packages add; warns about those that cannot be loaded."""
        loaded: dict[str, T] = {}
        for entry in self.entries()[len(self._built_in) :]:
            try:
                loaded[entry.name] = self._load(entry)
            except H3DataError as error:
                warnings.warn(f"Ignored: {error}", PluginWarning, stacklevel=3)
        return loaded

    def origin(self, name: str) -> str:
        """The name as error texts give it: with package and entry point, if it comes from a plug-in."""
        claims = self._third_party().get(name, [])
        return self._origin(claims[0]) if claims and name not in self._built_in else repr(name)

    def _third_party(self) -> dict[str, list[Plugin]]:
        """Installed entry points by name; several if packages disagree about what the name stands for."""
        claims: dict[str, list[Plugin]] = {}
        for point in importlib.metadata.entry_points(group=self.group):
            package = f"{point.dist.name} {point.dist.version}" if point.dist is not None else "an unnamed package"
            built_in = self._built_in.get(point.name)
            rivals = claims.setdefault(point.name, [])
            if point.value not in (other.value for other in (*rivals, *([built_in] if built_in else []))):
                rivals.append(Plugin(point.name, point.value, package))
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
                f"The {self.what} {self._origin(entry)} cannot be imported: {type(fault).__name__}: {fault}.{hint}"
            ) from fault
        if self._check is not None:
            try:
                self._check(loaded)
            except InputError as fault:
                raise PluginError(f"The {self.what} {self._origin(entry)} is not usable: {fault}") from fault
        return loaded

    def _origin(self, entry: Plugin) -> str:
        if not entry.distribution:
            return repr(entry.name)
        return (
            f"{entry.name!r} (entry point {entry.value} of the group {self.group}, installed by {entry.distribution})"
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
    """The version of this package that pip knows; ``source`` where it is a source tree on PYTHONPATH."""
    try:
        return importlib.metadata.version("h3data")
    except importlib.metadata.PackageNotFoundError:
        return "source"
