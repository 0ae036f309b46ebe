"""Calls of kernels without checks of the types of their arguments."""

from __future__ import annotations

from typing import Any

from numba.core.dispatcher import Dispatcher


class Entries:
    """Machine code of kernels for one owner, such as a floor, found at the first call of each.

    numba checks the types of all arguments in every call, which takes ten times as long as passing them, for a tuple of
    twenty arrays. The owner guarantees that the arguments of all calls of a kernel have the types of the first call;
    they are not checked here. NumPy scalars are treated as Python numbers, but integers must not be passed for floats.
    """

    def __init__(self) -> None:
        self._code: dict[Any, Any] = {}

    def __call__(self, kernel: Any, *arguments: Any) -> Any:
        """Return what a kernel returns for these arguments."""
        code = self._code.get(kernel)
        if code is None:
            # with NUMBA_DISABLE_JIT a kernel is a plain function
            types = tuple(map(kernel.typeof_pyval, arguments)) if isinstance(kernel, Dispatcher) else ()
            code = self._code[kernel] = kernel.compile(types) if types else kernel
        return code(*arguments)

    def __reduce__(self) -> tuple[type[Entries], tuple[()]]:
        # machine code cannot be pickled; another process finds its own
        return Entries, ()
