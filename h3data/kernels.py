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
import hashlib
import logging
import os
import re
import socket
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import parent_process
from pathlib import Path
from typing import Any, Literal

from numba import _dynfunc, njit, types  # type: ignore[attr-defined]  # a compiled module
from numba.core import sigutils
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_lock import global_compiler_lock
from numba.core.compiler_machinery import register_pass
from numba.core.dispatcher import Dispatcher
from numba.core.typed_passes import NativeLowering

from h3data.progress import has_begun, is_quiet

try:
    import fcntl
except ImportError:  # not POSIX: every process compiles for itself
    fcntl = None

_log = logging.getLogger(__name__)
if _log.level == logging.NOTSET:
    _log.setLevel(logging.INFO)
_kernels: list[Any] = []
_COMMON: dict[str, Any] = {"nogil": True, "no_cfunc_wrapper": True}  # nobody takes the address of a kernel
_PART: dict[str, Any] = {**_COMMON, "no_cpython_wrapper": True}

OURS = ("h3data", "sim_kinematic")
"""Packages whose sources are part of the stamp."""
ANNOUNCEMENT = "Compiling kernels, once per machine: up to a minute in all; `h3data warmup` does it ahead."
_IMPORT = re.compile(r"^(?:from|import)\s+([\w.]+)", re.MULTILINE)
"""Top-level imports; indented ones are for type checkers or run too late to reach a kernel."""


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator: ``njit(cache=True, nogil=True)`` with further ``options``.

    Functions that only kernels call are better a `kernel_part`.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            dispatcher: Any = njit(cache=True, **_COMMON, **options)(function)
        except RuntimeError:  # numba finds no writable folder for its cache
            _warn_once()
            dispatcher = njit(**_COMMON, **options)(function)
        cache: Any = getattr(dispatcher, "_cache", None)
        if hasattr(cache, "_cache_file"):  # absent with NUMBA_DISABLE_JIT
            file = cache._cache_file  # numba has no public hook; tests/test_kernels.py fails if this changes
            file._source_stamp = (file._source_stamp, source_digest(function.__module__))
        if isinstance(dispatcher, Dispatcher):
            vars(dispatcher)["compile"] = functools.partial(_compile, dispatcher)
            _kernels.append(dispatcher)
        return dispatcher

    return compiled


def kernel_part(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator: ``njit(nogil=True)`` with further ``options``, for functions that only kernels call.

    They have no machine code of their own, which halves the time that kernels take to compile: LLVM sees a part as
    numba lowered it and optimises it once in each kernel that it becomes part of. A call from Python raises TypeError.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        part: Any = njit(**_PART, pipeline_class=_PartCompiler, **options)(function)
        if isinstance(part, Dispatcher):
            part.__class__ = _part_type(type(part))
        return part

    return compiled


class _PartLibrary(JITCodeLibrary):
    """The LLVM module of a part of kernels, to be linked into theirs. numba would optimise it, with all parts that it calls,
    and compile it to machine code that nobody runs: a third of the time (21 of 36 s for the gait of people in all)."""

    def _optimize_functions(self, ll_module: Any) -> None:
        try:
            passes, builder = self._codegen._function_pass_manager()
        except TypeError:  # numba 0.61
            super()._optimize_functions(ll_module)
            return
        ll_module.data_layout = self._codegen._data_layout
        for function in ll_module.functions:
            if not function.is_declaration:
                passes.run(function, builder)

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _PartLowering(NativeLowering):
    """`NativeLowering` into a `_PartLibrary`."""

    _name = "h3data_part_lowering"

    def run_pass(self, state: Any) -> Literal[True]:
        library = _PartLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library, state.flags.no_compile = library, True
        super().run_pass(state)
        library._ensure_finalized()
        made, name = state["cr"], state.func_id.func_name
        entry = _dynfunc.make_function(made.fndesc.lookup_module(), name, "", 0, made.env, (library,))
        state.targetctx.insert_user_function(entry, made.fndesc, [library])  # by which callers find the library
        if reloaded := getattr(library, "_reload_init", ()):  # since numba 0.62
            state.reload_init.extend(reloaded)
        state["cr"] = made._replace(cfunc=entry)
        return True


class _PartCompiler(Compiler):
    """numba's compiler, with `_PartLowering` in place of `NativeLowering`."""

    def define_pipelines(self) -> list[Any]:
        pipelines = super().define_pipelines()
        for pipeline in pipelines:
            pipeline.passes[:] = [
                (_PartLowering if step is NativeLowering else step, text) for step, text in pipeline.passes
            ]
            pipeline._finalized = False
            pipeline.finalize()
        return pipelines


@functools.cache
def _part_type(dispatcher_type: type) -> type:
    def refuse(self: Any, *_: Any, **__: Any) -> None:
        raise TypeError(
            f"{self.__name__} is part of a kernel and has no entry point for Python; call it from a kernel."
        )

    def get_call_template(self: Any, args: Any, kws: Any) -> Any:
        """numba would compile a part once for each constant argument."""
        plain = {name: types.unliteral(kind) for name, kind in kws.items()}
        return dispatcher_type.get_call_template(self, tuple(types.unliteral(kind) for kind in args), plain)

    # without __call__, numba would call a null pointer
    return type("KernelPart", (dispatcher_type,), {"__call__": refuse, "get_call_template": get_call_template})


# --- compiling ------------------------------------------------------------------------------------------------------
def compiled_count() -> int:
    """Number of kernels that this process has compiled itself."""
    return sum(sum(kernel.stats.cache_misses.values()) for kernel in _kernels)


def compiled_files() -> dict[str, int]:
    """Size [bytes] of each file of machine code, one for each type of arguments, of the kernels imported so far."""
    files = [kernel._cache._cache_file for kernel in _kernels if hasattr(kernel._cache, "_cache_file")]
    paths = [Path(file._data_path(name)) for file in files for name in file._load_index().values()]
    return {str(path): path.stat().st_size for path in paths}


def _compile(dispatcher: Any, signature: Any) -> Any:
    """numba's `Dispatcher.compile`, once per machine."""
    compile_here = functools.partial(type(dispatcher).compile, dispatcher, signature)
    with global_compiler_lock:  # taken before the file lock by everybody, so that threads cannot block each other
        if tuple(sigutils.normalize_signature(signature)[0]) in dispatcher.overloads:
            return compile_here()
        file = getattr(dispatcher._cache, "_cache_file", None)
        if file is None:
            _announce()
            with _garbage_kept():
                return compile_here()
        key = dispatcher._cache._index_key(signature, dispatcher.targetctx.codegen())
        if key in file._load_index():
            return compile_here()
        _announce()
        with _locked(Path(file._index_path + ".lock")), _garbage_kept():
            return compile_here()  # looks into the cache again: another process may have just filled it


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Waits for other processes that hold the lock file ``path``; it is released even when this process is killed."""
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
    """Pauses the garbage collector: numba allocates millions of objects, and scanning them takes a sixth of its time."""
    paused = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if paused:
            gc.enable()


@functools.cache
def _announce() -> None:
    """Says on stderr, or in the log if there is one, that compiling takes a while: once for a process and its workers.

    Between lines of progress it would only puzzle.
    """
    if is_quiet() or has_begun() or not _log.isEnabledFor(logging.INFO):
        return
    parent = parent_process()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as announcer:
        try:  # an abstract address of Linux: one process at a time can take it, and it is free again when that one ends
            announcer.bind(f"\0h3data-kernels-{os.getpid() if parent is None else parent.pid}")
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                return
        announcer.detach()  # open until the process ends
    if _log.hasHandlers():
        _log.info(ANNOUNCEMENT)
    else:
        sys.stderr.write(ANNOUNCEMENT + "\n")


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
