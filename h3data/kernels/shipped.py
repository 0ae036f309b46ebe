"""Machine code of kernels from the package ``h3data_kernels``, which avoids waiting for compilation.

A file holds one kernel for one list of argument types, as numba pickles it for its own cache, compressed with xz. Its
name has the digests of everything that determines the code (`h3data.kernels.digests`), and its folder the versions of
Python and numba, the system and the level of the processor: code that does not fit has another name and is not found,
so the kernel is compiled as if there were no package. The same applies if there is no package, another processor, a
damaged file, or a setting of numba that changes the code (``NUMBA_CPU_NAME=host`` compiles for just this processor).
Where the processor has all features of several levels (`LEVELS`), the folder of the highest one comes first. It holds only
the kernels that are faster there.

Pickles can run code, as modules can. They are therefore read from one place only: the package beside this one in the
same folder of installed packages, or in the same checkout.

``make kernels`` fills the package. It runs commands with ``H3DATA_KERNELS_RECORD`` naming a folder; every process then
writes the kernels that it has used there.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import lzma
import os
import pickle
import platform
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numba
from llvmlite import binding as llvm
from numba.core import types
from numba.core.compiler import CompileResult
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps

from h3data.kernels.digests import OURS, UnknownError, code_digest, types_digest

log = logging.getLogger(__name__)

_V3 = ("avx", "avx2", "bmi", "bmi2", "cx16", "f16c", "fma", "lzcnt", "movbe", "popcnt", "sahf", "sse4.2", "ssse3")
LEVELS = {
    "x86-64-v4": (*_V3, "avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"),
    "x86-64-v3": _V3,
}
"""Features that each level of processors has for which kernels are shipped, the highest level first.

Results are the same, to the byte. LLVM computes with vectors of 256 bits for both levels; the higher one has twice as many
registers, masks and some instructions more.
"""
NOT_INSTALLED = "h3data-kernels is not installed"
RECORD = "H3DATA_KERNELS_RECORD"
PACKAGE = "h3data_kernels"

_loaded: dict[str, int] = {}


def loaded_files() -> dict[str, int]:
    """Return the size [bytes] of each shipped file whose machine code this process has loaded."""
    return dict(_loaded)


def folder_name(level: str) -> str:
    """Return the name of the folder for this Python, numba and system, and a level of processors."""
    return f"{sys.implementation.cache_tag}-numba{numba.__version__}-{sys.platform}-{level}"


def folders() -> tuple[Path, ...]:
    """Return the folders of the shipped kernels for this machine, the fastest level first."""
    found = _found()
    return () if isinstance(found, str) else found


def missing() -> str:
    """Return the reason why no kernels are shipped for this machine; empty if there are shipped kernels."""
    found = _found()
    return found if isinstance(found, str) else ""


def lacking(level: str) -> list[str]:
    """Return the features of a level that this processor lacks."""
    features = llvm.get_host_cpu_features() if platform.machine() == "x86_64" else {}
    return [name for name in LEVELS[level] if not features.get(name)]


@functools.cache
def _found() -> tuple[Path, ...] | str:
    """Return the folders, or why there are none."""
    # these do not change what is compiled
    harmless = {"NUMBA_CACHE_DIR", "NUMBA_NUM_THREADS", "NUMBA_THREADING_LAYER", "NUMBA_DISABLE_PERFORMANCE_WARNINGS"}
    settings = {name for name in os.environ if name.startswith("NUMBA_")} - harmless
    levels = list(LEVELS)
    # the very settings with which ``make kernels`` compiles
    if os.environ.get("NUMBA_CPU_NAME") in levels and os.environ.get("NUMBA_CPU_FEATURES") == "":
        levels = [os.environ["NUMBA_CPU_NAME"]]
        settings -= {"NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES"}
    if settings or sys.flags.optimize:
        return f"{', '.join(sorted(settings)) or 'python -O'} may change what is compiled"
    fitting = [level for level in levels if not lacking(level)]
    if not fitting:
        return f"the processor is not of level {levels[-1]}: it lacks {', '.join(lacking(levels[-1]))}"
    here = Path(__file__).parents[2]  # of all packages: site-packages, or a checkout
    packages = [each / PACKAGE for each in (here, here / "pipelines") if (each / PACKAGE).is_dir()]
    if not packages:
        return NOT_INSTALLED
    named = (each / folder_name(level) for level in fitting for each in packages)
    return tuple(filter(Path.is_dir, named)) or f"h3data-kernels has none for {folder_name(fitting[0])}"


def load(dispatcher: Any, kinds: Sequence[types.Type]) -> bool:
    """Load the shipped machine code of a kernel for arguments of these types; return False if there is none."""
    name = file_name(dispatcher, kinds) if folders() else None
    return name is not None and any(_load(dispatcher, kinds, folder / name) for folder in folders())


def _load(dispatcher: Any, kinds: Sequence[types.Type], path: Path) -> bool:
    try:
        with lzma.open(path) as file:
            payload = pickle.load(file)
        # the functions for memory that all code refers to; what else `refresh` would import serves only compiling
        rtsys.initialize(dispatcher.targetctx)
        result = CompileResult._rebuild(dispatcher.targetctx, *payload)
    except FileNotFoundError:
        return False
    except Exception as fault:  # damaged, in one of the many ways that pickle and LLVM have to say so
        log.warning("A shipped kernel is damaged and not used (%s: %s): %s", type(fault).__name__, fault, path)
        return False
    dispatcher._cache_hits[tuple(kinds)] += 1
    dispatcher.targetctx.insert_user_function(result.entry_point, result.fndesc, [result.library])
    dispatcher.add_overload(result)
    _loaded[str(path)] = path.stat().st_size
    if RECORD in os.environ:
        shutil.copy(path, _recorded(path.name))
    return True


def record(dispatcher: Any, kinds: Sequence[types.Type]) -> None:
    """Store the machine code just compiled for these argument types in the folder named by `RECORD`, if it is set."""
    if RECORD not in os.environ or dispatcher.py_func.__module__.split(".")[0] not in OURS:
        return
    name = file_name(dispatcher, kinds)
    if name is None:
        log.warning("No digest covers %s of %s; it will not be shipped.", dispatcher.__name__, dispatcher.__module__)
    elif not (path := _recorded(name)).exists():
        cache = dispatcher._cache
        payload = cache._cache_file.load(cache._index_key(tuple(kinds), dispatcher.targetctx.codegen()))
        # several processes may record the same kernel at once
        part = path.with_suffix(f".{os.getpid()}.part")
        part.write_bytes(lzma.compress(_without_paths(payload), preset=9 | lzma.PRESET_EXTREME))
        part.replace(path)


def _without_paths(payload: Sequence[Any]) -> bytes:
    """Return the pickle of what numba keeps of a kernel, without the annotated source and without names of folders.

    Files are named for tracebacks of exceptions; their folders become ``h3data///`` and ``numba///`` of the same lengths.
    """
    # the seventh of what `CompileResult._reduce` returns is the annotated source
    fields = list(payload)
    fields[6] = ""
    text = dumps(tuple(fields))
    for name, folder in (("h3data", Path(__file__).parents[2]), ("numba", Path(numba.__file__).parents[1])):
        place = str(folder).encode()
        # of the same length, as pickles say before each text how long it is
        text = text.replace(place, name.encode().ljust(len(place), b"/")[: len(place)])
    return text


def _recorded(name: str) -> Path:
    return Path(os.environ[RECORD], name)


def file_name(dispatcher: Any, kinds: Sequence[types.Type]) -> str | None:
    """Return the name of the file for a kernel and the types of its arguments; None if no digest can cover what it reads."""
    try:
        code, arguments = code_stamp(dispatcher), types_digest(kinds)
    except UnknownError:
        return None
    return f"{code}-{arguments[:16]}.nbc.xz"


def code_stamp(dispatcher: Any) -> str:
    """Return the part of a file's name that identifies the code of a kernel: its name and a digest."""
    # raise the 1 when machine code changes for a reason that the digests do not see
    digest = hashlib.sha256(f"1 {_compiler_digest()} {code_digest(dispatcher)}".encode()).hexdigest()
    return f"{dispatcher.py_func.__module__}.{dispatcher.py_func.__qualname__}-{digest[:16]}"


@functools.cache
def _compiler_digest() -> str:
    """Return the digest of how we compile."""
    return hashlib.sha256(Path(__file__).with_name("parts.py").read_bytes()).hexdigest()
