"""Machine code of kernels from the package ``h3data_kernels``, which avoids waiting for compilation.

A file holds one kernel for one list of argument types, as numba pickles it for its own cache, compressed with xz. Its
name has the digests of everything that determines the code (`h3data.kernels.digests`), and its folder the versions of
Python and numba, the system and the level of the processor: code that does not fit has another name and is not found,
so the kernel is compiled as if there were no package. The same applies if there is no package, another processor, a
damaged file, or a setting of numba that changes the code (``NUMBA_CPU_NAME=host`` compiles for just this processor).

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

LEVEL = "x86-64-v3"
"""Name of the set `LEVEL_FEATURES`. Code for this level is as fast as code for the machine's own processor, except for
step kernels on processors with AVX-512."""
LEVEL_FEATURES = (
    "avx",
    "avx2",
    "bmi",
    "bmi2",
    "cx16",
    "f16c",
    "fma",
    "lzcnt",
    "movbe",
    "popcnt",
    "sahf",
    "sse4.2",
    "ssse3",
)
NOT_INSTALLED = "h3data-kernels is not installed"
RECORD = "H3DATA_KERNELS_RECORD"
PACKAGE = "h3data_kernels"

_loaded: dict[str, int] = {}


def loaded_files() -> dict[str, int]:
    """Return the size [bytes] of each shipped file whose machine code this process has loaded."""
    return dict(_loaded)


def folder_name() -> str:
    """Return the name of the folder for this Python, numba, system and processor."""
    machine = LEVEL if platform.machine() == "x86_64" else platform.machine()
    return f"{sys.implementation.cache_tag}-numba{numba.__version__}-{sys.platform}-{machine}"


def folder() -> Path | None:
    """Return the folder of the shipped kernels for this machine, or None if there are none."""
    found = _found()
    return found if isinstance(found, Path) else None


def missing() -> str:
    """Return the reason why no kernels are shipped for this machine; empty if there are shipped kernels."""
    found = _found()
    return found if isinstance(found, str) else ""


@functools.cache
def _found() -> Path | str:
    """Return the folder, or why there is none."""
    # these do not change what is compiled
    harmless = {"NUMBA_CACHE_DIR", "NUMBA_NUM_THREADS", "NUMBA_THREADING_LAYER", "NUMBA_DISABLE_PERFORMANCE_WARNINGS"}
    settings = {name for name in os.environ if name.startswith("NUMBA_")} - harmless
    # the very settings with which ``make kernels`` compiles
    if os.environ.get("NUMBA_CPU_NAME") == LEVEL and os.environ.get("NUMBA_CPU_FEATURES") == "":
        settings -= {"NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES"}
    if settings or sys.flags.optimize:
        return f"{', '.join(sorted(settings)) or 'python -O'} may change what is compiled"
    here = Path(__file__).parents[2]  # of all packages: site-packages, or a checkout
    packages = [each / PACKAGE for each in (here, here / "pipelines") if (each / PACKAGE).is_dir()]
    if not packages:
        return NOT_INSTALLED
    folders = [package / folder_name() for package in packages if (package / folder_name()).is_dir()]
    if not folders:
        return f"h3data-kernels has none for {folder_name()}"
    features = llvm.get_host_cpu_features()
    if lacking := [name for name in LEVEL_FEATURES if not features.get(name)]:
        return f"the processor is not of level {LEVEL}: it lacks {', '.join(lacking)}"
    return folders[0]


def load(dispatcher: Any, kinds: Sequence[types.Type]) -> bool:
    """Load the shipped machine code of a kernel for arguments of these types; return False if there is none."""
    shipped = folder()
    name = None if shipped is None else file_name(dispatcher, kinds)
    if shipped is None or name is None:
        return False
    path = shipped / name
    try:
        with lzma.open(path) as file:
            payload = pickle.load(file)
        # the functions for memory that all code refers to; what else `refresh` would import serves only compiling
        rtsys.initialize(dispatcher.targetctx)
        result = CompileResult._rebuild(dispatcher.targetctx, *payload)
    except FileNotFoundError:
        return False
    except Exception as fault:  # damaged, in one of the many ways that pickle and LLVM have to say so
        log.warning("A shipped kernel is damaged and is compiled here (%s: %s): %s", type(fault).__name__, fault, path)
        return False
    dispatcher._cache_hits[tuple(kinds)] += 1
    dispatcher.targetctx.insert_user_function(result.entry_point, result.fndesc, [result.library])
    dispatcher.add_overload(result)
    _loaded[str(path)] = path.stat().st_size
    if RECORD in os.environ:
        shutil.copy(path, _recorded(name))
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
