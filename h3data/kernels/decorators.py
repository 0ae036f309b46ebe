"""`kernel`, the decorator of all compiled functions: numba's ``njit`` with a cache that also notices changes in other files.

numba recompiles a cached kernel when the kernel's own file changes. But a kernel also inlines the functions it calls and
the constants it reads from other files; when only those change, numba would keep running the stale machine code. The
stamp of the cache therefore covers all of our modules that the kernel's module imports, directly or indirectly.

Processes share the work: each kernel is compiled under a lock of its own in the cache folder, so that of several workers
one compiles it and the others load it. The first compilation is announced on stderr, once for a process and its workers.
``H3DATA_QUIET=1`` (`h3data.progress`) silences it, and so does ``logging.getLogger("h3data.kernels").setLevel("WARNING")``.
"""

from __future__ import annotations

import errno
import functools
import gc
import logging
import os
import socket
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import parent_process
from pathlib import Path
from typing import Any

from numba import njit
from numba.core import sigutils
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher

from h3data.kernels import shipped
from h3data.kernels.borrowing import BorrowingCompiler, borrowing_type
from h3data.kernels.digests import source_digest
from h3data.kernels.parts import PartCompiler, part_type
from h3data.progress import BEGUN, is_quiet

try:
    import fcntl
except ImportError:  # not POSIX: every process compiles for itself
    fcntl = None

_log = logging.getLogger("h3data.kernels")
# at WARNING, the default of the root logger, nobody would see the announcement; a level that the user has set stays
if _log.level == logging.NOTSET:
    _log.setLevel(logging.INFO)
_kernels: list[Any] = []
_COMMON: dict[str, Any] = {"nogil": True, "no_cfunc_wrapper": True}  # nobody takes the address of a kernel

ANNOUNCEMENT = "Compiling kernels, once per machine: up to a minute in all; `h3data warmup` does it ahead."


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorate a function with ``njit(cache=True, nogil=True)`` and further ``options``.

    Use `kernel_part` for functions that only kernels call.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            dispatcher: Any = njit(cache=True, **_COMMON, **options)(function)
        except RuntimeError:  # numba finds no writable folder for its cache
            dispatcher = njit(**_COMMON, **options)(function)
        cache: Any = getattr(dispatcher, "_cache", None)
        if hasattr(cache, "_cache_file"):  # absent with NUMBA_DISABLE_JIT
            file = cache._cache_file  # numba has no public hook; tests/test_numba.py fails if this changes
            file._source_stamp = (file._source_stamp, source_digest(function.__module__))
        if isinstance(dispatcher, Dispatcher):
            vars(dispatcher)["compile"] = functools.partial(_compile, dispatcher)
            _kernels.append(dispatcher)
        return dispatcher

    return compiled


def kernel_part(*, borrows: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorate a function that only kernels call with ``njit(nogil=True)`` and further ``options``.

    Parts have no machine code of their own, which halves the time for compiling kernels: LLVM gets a part as numba
    lowered it, and optimises it once in each kernel that contains it. A call from Python raises TypeError.

    Args:
        borrows: True if the part creates and returns no arrays, and calls no part that returns one. It only reads and
            writes the arrays in its arguments, which the kernel keeps alive. numba then counts no references to arrays
            in it. Counting is atomic, and took two thirds of the time of people's gait, whose parts take arrays out of
            tuples and rows out of arrays. Compilation fails if such a part creates, returns or receives an array
            nevertheless.
        options: Further options of ``njit``.
    """
    compiler, kind = (BorrowingCompiler, borrowing_type) if borrows else (PartCompiler, part_type)

    def compiled(function: Callable[..., Any]) -> Any:
        own: dict[str, Any] = {"no_cpython_wrapper": True, "pipeline_class": compiler}
        part: Any = njit(**_COMMON, **own, **options)(function)
        if isinstance(part, Dispatcher):
            part.__class__ = kind(type(part))
        return part

    return compiled


# --- compiling ------------------------------------------------------------------------------------------------------
def compiled_count() -> int:
    """Return the number of kernels that this process has compiled itself."""
    return sum(sum(kernel.stats.cache_misses.values()) for kernel in _kernels)


def compiled_files() -> dict[str, int]:
    """Return the size [bytes] of each file of machine code, one for each type of arguments, of the kernels imported so far."""
    files = [kernel._cache._cache_file for kernel in _kernels if hasattr(kernel._cache, "_cache_file")]
    paths = [Path(file._data_path(name)) for file in files for name in _index_of(file).values()]
    return {str(path): path.stat().st_size for path in paths}


def _compile(dispatcher: Any, signature: Any) -> Any:
    """Run numba's `Dispatcher.compile`, at most once per machine, and not at all if the machine code was shipped."""
    with global_compiler_lock:  # taken before the file lock by everybody, so that threads cannot block each other
        types = tuple(sigutils.normalize_signature(signature)[0])
        if types not in dispatcher.overloads and not shipped.load(dispatcher, types):
            _compile_here(dispatcher, signature)
            shipped.record(dispatcher, types)
        return dispatcher.overloads[types].entry_point


def _compile_here(dispatcher: Any, signature: Any) -> None:
    compile_here = functools.partial(type(dispatcher).compile, dispatcher, signature)
    file = getattr(dispatcher._cache, "_cache_file", None)
    if file is None:
        _warn_once()
        _announce()
        with _garbage_kept():
            compile_here()
        return
    # what is cached is only loaded: neither announced nor locked
    key = dispatcher._cache._index_key(signature, dispatcher.targetctx.codegen())
    if key in _index_of(file):
        compile_here()
        return
    _announce()
    with _locked(Path(file._index_path + ".lock")), _garbage_kept():
        compile_here()  # looks into the cache again: another process may have just filled it


def _index_of(file: Any) -> dict[Any, str]:
    """Return numba's index of a kernel; deletes it and returns an empty one if it names modules that have been renamed since.

    numba unpickles the types of arguments before it compares the time of the source, and would raise an ImportError.
    """
    try:
        return file._load_index()
    except (ImportError, AttributeError):
        # all of this kernel is compiled again, as after a change of its source
        Path(file._index_path).unlink(missing_ok=True)
        return {}


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Wait for other processes that hold the lock file ``path``; it is released even when this process is killed."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("ab")
        if fcntl:
            fcntl.flock(file, fcntl.LOCK_EX)
    except OSError:  # a read-only folder or a file system without locks: compile all the same
        yield
        return
    try:
        yield
    finally:
        if fcntl:
            fcntl.flock(file, fcntl.LOCK_UN)  # closing would not do while a forked process holds the file open
        file.close()


@contextmanager
def _garbage_kept() -> Iterator[None]:
    """Pause the garbage collector: numba allocates millions of objects, and scanning them takes a sixth of its time."""
    paused = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if paused:
            gc.enable()


@functools.cache
def _announce() -> None:
    """Say on stderr, or in the log if there is one, that compiling takes a while: once for a process and its workers.

    Between lines of progress it would only puzzle.
    """
    if is_quiet() or BEGUN.is_set() or not _log.isEnabledFor(logging.INFO):
        return
    parent = parent_process()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as announcer:
        try:  # an abstract address of Linux: one process at a time can take it, and it is free again when that one ends
            announcer.bind(f"\0h3data-kernels-{os.getpid() if parent is None else parent.pid}")
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                return
        announcer.detach()  # open until the process ends
    text = ANNOUNCEMENT
    if shipped.missing() == shipped.NOT_INSTALLED and sys.platform == "linux":
        text += " The package h3data-kernels has them compiled."
    if _log.hasHandlers():
        _log.info(text)
    else:
        sys.stderr.write(text + "\n")


@functools.cache
def _warn_once() -> None:
    warnings.warn(
        "Compiled kernels cannot be cached, so every start takes some seconds longer: numba can write neither beside the "
        "package nor in the home folder. Hint: set NUMBA_CACHE_DIR to a writable folder.",
        RuntimeWarning,
        stacklevel=3,
    )
