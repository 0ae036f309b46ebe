"""The decorator of all compiled kernels: `kernel`, numba's ``njit`` with a cache that notices every change it must.

numba recompiles a cached kernel when the file changes that it stands in. But a kernel also takes in what it calls and the
constants it reads from other files; after an update of those it would go on as before. So the stamp of its cache covers
all of our own modules that its module imports, directly or not.

The first compilation of a process is announced in the log (``h3data.kernels``, INFO): on a fresh machine the first command
spends some twenty seconds on it, once.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import re
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit
from numba.core import event

_log = logging.getLogger(__name__)

OURS = ("h3data", "sim_kinematic")
"""Packages whose sources count."""
_IMPORT = re.compile(r"^(?:from|import)\s+([\w.]+)", re.MULTILINE)
"""Imports at the top level; the indented ones are for type checkers or come too late for a kernel."""


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """A decorator: ``njit(cache=True, nogil=True)`` with further ``options``.

    What is only called by other kernels and compiled into them may be a plain ``njit(nogil=True)``.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            dispatcher: Any = njit(cache=True, nogil=True, **options)(function)
        except RuntimeError:  # numba finds no folder that it can write to
            _warn_once()
            return njit(nogil=True, **options)(function)
        if hasattr(dispatcher, "_cache"):  # not where numba is switched off
            file = dispatcher._cache._cache_file  # numba has no public way; tests/test_kernels.py tells when this ends
            file._source_stamp = (file._source_stamp, source_digest(function.__module__))
        return dispatcher

    return compiled


@functools.cache
def _announce() -> None:
    _log.info("Compiling kernels for this machine, once: up to half a minute in all.")


class _Announcer(event.Listener):
    """Hears of what is compiled; kernels that come from the cache make no event."""

    def on_start(self, event: event.Event) -> None:
        _announce()

    def on_end(self, event: event.Event) -> None:
        pass


event.register("numba:compile", _Announcer())


@functools.cache
def _warn_once() -> None:
    warnings.warn(
        "Compiled kernels cannot be kept, so every start takes some seconds longer: numba can write neither beside the "
        "package nor in the home folder. Hint: set NUMBA_CACHE_DIR to a folder that can be written.",
        RuntimeWarning,
        stacklevel=3,
    )


@functools.cache
def _source(module: str) -> tuple[str, tuple[str, ...]]:
    """Digest of a module's source, and our modules that it imports."""
    path = getattr(sys.modules.get(module), "__file__", None)
    if path is None:
        return "", ()
    text = Path(path).read_text(encoding="utf-8")
    imports = {name for name in _IMPORT.findall(text) if name.split(".")[0] in OURS}
    return hashlib.sha256(text.encode()).hexdigest(), tuple(sorted(imports))


def source_digest(module: str) -> str:
    """Digest of the sources of a module and of all of ours that it imports, directly or not."""
    seen: dict[str, str] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name not in seen:
            seen[name], imports = _source(name)
            waiting += imports
    return hashlib.sha256("".join(f"{name} {seen[name]}\n" for name in sorted(seen)).encode()).hexdigest()
