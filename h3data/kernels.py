"""`kernel`, the decorator of all compiled functions: numba's ``njit`` with a cache that also notices changes in other files.

numba recompiles a cached kernel when the kernel's own file changes. But a kernel also inlines the functions it calls and
the constants it reads from other files; when only those change, numba would keep running the stale machine code. The
stamp of the cache therefore covers all of our modules that the kernel's module imports, directly or indirectly.

The first compilation of a process is announced in the log (``h3data.kernels``, INFO): on a fresh machine, the first
command spends about twenty seconds on it, once.
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
"""Packages whose sources are part of the stamp."""
_IMPORT = re.compile(r"^(?:from|import)\s+([\w.]+)", re.MULTILINE)
"""Top-level imports; indented ones are for type checkers or run too late to reach a kernel."""


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator: ``njit(cache=True, nogil=True)`` with further ``options``.

    Functions that are only called by other kernels, and compiled into them, may use a plain ``njit(nogil=True)``.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            dispatcher: Any = njit(cache=True, nogil=True, **options)(function)
        except RuntimeError:  # numba finds no writable folder for its cache
            _warn_once()
            return njit(nogil=True, **options)(function)
        if hasattr(dispatcher, "_cache"):  # absent with NUMBA_DISABLE_JIT
            file = (
                dispatcher._cache._cache_file
            )  # numba has no public hook; tests/test_kernels.py fails if this changes
            file._source_stamp = (file._source_stamp, source_digest(function.__module__))
        return dispatcher

    return compiled


@functools.cache
def _announce() -> None:
    _log.info("Compiling kernels for this machine, once: up to half a minute in all.")


class _Announcer(event.Listener):
    """Listens for compilations; kernels loaded from the cache raise no event."""

    def on_start(self, event: event.Event) -> None:
        _announce()

    def on_end(self, event: event.Event) -> None:
        pass


event.register("numba:compile", _Announcer())


@functools.cache
def _warn_once() -> None:
    warnings.warn(
        "Compiled kernels cannot be cached, so every start takes some seconds longer: numba can write neither beside the "
        "package nor in the home folder. Hint: set NUMBA_CACHE_DIR to a writable folder.",
        RuntimeWarning,
        stacklevel=3,
    )


@functools.cache
def _source(module: str) -> tuple[str, tuple[str, ...]]:
    """Digest of a module's source, and the names of our modules that it imports."""
    path = getattr(sys.modules.get(module), "__file__", None)
    if path is None:
        return "", ()
    text = Path(path).read_text(encoding="utf-8")
    imports = {name for name in _IMPORT.findall(text) if name.split(".")[0] in OURS}
    return hashlib.sha256(text.encode()).hexdigest(), tuple(sorted(imports))


def source_digest(module: str) -> str:
    """Digest of the sources of a module and of all our modules that it imports, directly or indirectly."""
    digests: dict[str, str] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name not in digests:
            digests[name], imports = _source(name)
            waiting += imports
    return hashlib.sha256("".join(f"{name} {digests[name]}\n" for name in sorted(digests)).encode()).hexdigest()
