"""Parts of kernels that only borrow arrays, for which numba's reference counting is turned off.

Reference counting is atomic, and takes most of the time of functions that read arrays from tuples and rows from arrays.
"""

from __future__ import annotations

import functools
from typing import Any, Literal

from numba import types
from numba.core.compiler_machinery import register_pass
from numba.core.errors import TypingError

from h3data.kernels.parts import PartCompiler, _PartLowering, part_type


@register_pass(mutates_CFG=True, analysis_only=False)
class _BorrowingLowering(_PartLowering):
    """`_PartLowering` without counting. The option of numba would be passed on to all parts that are called from here."""

    _name = "h3data_borrowing_lowering"

    def run_pass(self, state: Any) -> Literal[True]:
        _check(state)
        counting = state.targetctx
        state.targetctx = counting.subtarget(enable_nrt=False)
        try:
            return super().run_pass(state)
        finally:
            state.targetctx = counting


def _check(state: Any) -> None:
    """Refuse a part that returns an array, which would be freed while in use, or makes or is given one, which never would."""

    def holds_arrays(kind: types.Type) -> bool:
        return state.targetctx.data_model_manager[kind].contains_nrt_meminfo()

    name = state.func_id.func_name
    if holds_arrays(state.return_type):
        raise TypingError(f"{name} borrows arrays and must not return {state.return_type}.")
    for expression, signature in state.calltypes.items():
        if not hasattr(signature, "return_type") or not holds_arrays(signature.return_type):
            continue
        operation = getattr(expression, "op", "")
        # the result of one of these is part of what it is applied to
        if operation in ("getitem", "static_getitem", "getattr", "getiter", "iternext", "pair_first", "exhaust_iter"):
            # an array as an index makes a copy of what it picks
            is_view = not any(isinstance(kind, types.Array) for kind in signature.args[1:])
        else:
            # of all calls only ``reshape`` gives a view
            called = state.typemap[expression.func.name] if operation == "call" else None
            is_view = isinstance(called, types.BoundFunction) and called.typing_key == "array.reshape"
        if not is_view:
            raise TypingError(f"{name} borrows arrays and must not get a new {signature.return_type}: {expression}.")


class BorrowingCompiler(PartCompiler):
    """Compiler of functions that only borrow arrays: `PartCompiler` with `_BorrowingLowering`."""

    def define_pipelines(self) -> list[Any]:
        """Return the pipelines of parts, with `_BorrowingLowering` in place of `_PartLowering`."""
        pipelines = super().define_pipelines()
        for pipeline in pipelines:
            pipeline.passes[:] = [
                (_BorrowingLowering if step is _PartLowering else step, text) for step, text in pipeline.passes
            ]
            # numba has finalized it with its own step already
            pipeline._finalized = False
            pipeline.finalize()
        return pipelines


@functools.cache
def borrowing_type(dispatcher_type: type) -> type:
    """Return the dispatcher class of parts that borrow arrays.

    Its name is part of the digests of these parts (`h3data.kernels.digests`).
    """
    return type("BorrowingPart", (part_type(dispatcher_type),), {})
