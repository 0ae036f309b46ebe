"""Digests of everything that determines the machine code of a kernel.

`source_digest` covers whole files and is the stamp of numba's cache. `code_digest` covers only what a kernel reaches - byte
code, constants and intrinsics, through all functions that it calls - so that compiled kernels that are shipped
(`h3data.kernels.shipped`) survive changes of comments, and of everything else in the same files.
"""

from __future__ import annotations

import functools
import hashlib
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
from numba import types
from numba.core.dispatcher import Dispatcher
from numba.core.extending import _Intrinsic

OURS = (
    "h3data",
    "h3data_crowds",
    "h3data_gpu",
    "h3data_habitat",
    "h3data_light",
    "h3data_meshes",
    "h3data_pipelines",
    "sim_kinematic",
)
"""Names of packages whose sources are part of the digests."""


# --- files --------------------------------------------------------------------------------------------------------------
@functools.cache
def _source(module: str) -> tuple[str, tuple[str, ...]]:
    """Return the digest of a module's source, and the names of our modules that it imports."""
    path = getattr(sys.modules.get(module), "__file__", None)
    if path is None:
        return "", ()
    text = Path(path).read_text(encoding="utf-8")
    # at the left margin only: indented imports are for type checkers or run too late to reach a kernel
    found = re.findall(r"^(?:from|import)\s+([\w.]+)", text, re.MULTILINE)
    imports = {name for name in found if name.split(".")[0] in OURS}
    return hashlib.sha256(text.encode()).hexdigest(), tuple(sorted(imports))


def source_digest(module: str) -> str:
    """Return the digest of the sources of a module and of all h3data modules that it imports, directly or indirectly."""
    digests: dict[str, str] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name not in digests:
            digests[name], imports = _source(name)
            waiting += imports
    return _digest(f"{name} {digests[name]}" for name in sorted(digests))


# --- kernels ------------------------------------------------------------------------------------------------------------
class UnknownError(Exception):
    """Error about a kernel that reads something without a digest; it is compiled on the machine where it runs."""


def code_digest(kernel: Any) -> str:
    """Return the digest of everything that determines the machine code of a kernel (a numba dispatcher).

    It covers the byte code, constants, options and intrinsics of the kernel and of all functions that it calls. It is
    the same in all processes of one version of Python; line numbers, comments and docstrings do not count.

    Raises:
        UnknownError: the kernel reads a global or a closure variable of an unsupported type.
    """
    texts: dict[int, str] = {}
    waiting = [kernel]
    while waiting:
        each = waiting.pop()
        if id(each) not in texts:
            texts[id(each)], called = _function(each)
            waiting += called
    # the kernel first, then all in one order: how calls were found must not matter
    return _digest([texts[id(kernel)], *sorted(texts.values())])


def types_digest(kinds: Iterable[types.Type]) -> str:
    """Return the digest of the numba types of a kernel's arguments, including the field names of tuples.

    Raises:
        UnknownError: a type is of an unsupported kind.
    """
    return _digest(map(_type, kinds))


def _function(function: Any) -> tuple[str, list[Any]]:
    """Return the content of one compiled function as text, and the compiled functions that it names."""
    python = function.py_func
    values = {name: python.__globals__[name] for name in _names(python.__code__) if name in python.__globals__}
    cells = (cell.cell_contents for cell in python.__closure__ or ())
    values |= zip(python.__code__.co_freevars, cells, strict=True)
    called = [value for value in values.values() if isinstance(value, Dispatcher)]
    options = sorted((name, repr(value)) for name, value in function.targetoptions.items())
    text = [
        f"{python.__module__}.{python.__qualname__} {type(function).__name__} {options}",
        _code(python.__code__, python.__doc__),
        _constant(python.__defaults__),
        *(f"{name} {_value(values[name])}" for name in sorted(values)),
    ]
    return "\n".join(text), called


def _names(code: CodeType) -> Iterator[str]:
    """Yield the names that code may look up among its globals; some are attributes, which does no harm."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _code(code: CodeType, doc: str | None = None) -> str:
    # the docstring is among the constants of a function and is taken out
    constants = [
        _code(constant) if isinstance(constant, CodeType) else _constant(None if constant == doc else constant)
        for constant in code.co_consts
    ]
    names = (code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
    # without co_flags: numba overwrites them where a profiler is active, and the rest says the same
    counts = (code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount)
    return f"{code.co_code.hex()} {code.co_exceptiontable.hex()} {names} {counts} {constants}"


def _value(value: Any) -> str:
    """Return a global or closure variable that a kernel reads."""
    if isinstance(value, Dispatcher):  # its text is part of the digest
        return f"{value.py_func.__module__}.{value.py_func.__qualname__}"
    if isinstance(value, _Intrinsic):  # emits LLVM code by means of whatever its file has
        return f"{value.__module__}.{value.__name__} {source_digest(value.__module__)}"
    if isinstance(value, ModuleType | BuiltinFunctionType | FunctionType | type):
        name = value.__name__ if isinstance(value, ModuleType) else f"{value.__module__}.{value.__qualname__}"
        # what numba compiles by itself; its version is part of the name of a folder of kernels
        foreign = ("builtins", "numpy", "numba", "math", "cmath", "heapq", "_heapq", "operator", "_operator")
        if name.split(".")[0] in foreign:
            return name
    return _constant(value)


def _constant(value: Any) -> str:
    if value is None or value is Ellipsis or isinstance(value, bool | int | float | complex | str | bytes):
        return repr(value)
    if isinstance(value, np.generic | np.ndarray):
        return f"{value.dtype} {value.shape} {np.ascontiguousarray(value).tobytes().hex()}"
    if type(value) is tuple:
        return f"({', '.join(map(_constant, value))})"
    if isinstance(value, frozenset):  # `x in {1, 2}`
        return f"{{{', '.join(sorted(map(_constant, value)))}}}"
    raise UnknownError(f"{type(value).__name__} {value!r}")


def _type(kind: types.Type) -> str:
    whole: Any = kind  # numba's stubs lack these attributes
    if isinstance(kind, types.BaseNamedTuple):
        # kernels read fields by name, so a field that is renamed or moved is another kernel
        made = whole.instance_class
        return f"{made.__module__}.{made.__qualname__}{made._fields}({', '.join(map(_type, whole.types))})"
    if isinstance(kind, types.BaseTuple):
        return f"({', '.join(map(_type, whole.types))})"
    if isinstance(kind, types.Optional):
        return f"optional({_type(kind.type)})"
    if isinstance(
        kind, types.Array | types.Number | types.Boolean | types.NoneType | types.Omitted | types.UnicodeType
    ):
        return str(kind)
    raise UnknownError(str(kind))


def _digest(texts: Iterable[str]) -> str:
    return hashlib.sha256("".join(f"{text}\n" for text in texts).encode()).hexdigest()
