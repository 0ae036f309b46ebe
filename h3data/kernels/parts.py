"""Functions that only kernels call, without machine code of their own.

This module contains all uses of the internals of numba's compiler. `h3data.kernels.decorators` and
`h3data.kernels.shipped` use the internals of its cache. tests/test_kernels.py reports changes of these in a new version
of numba.
"""

from __future__ import annotations

import functools
from typing import Any, Literal

from numba import _dynfunc, types  # type: ignore[attr-defined]  # a compiled module
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NativeLowering


class _PartLibrary(JITCodeLibrary):
    """LLVM module of a function that is linked into the kernels that call it.

    numba would optimise the module together with all functions that it calls, and compile it to machine code that is
    never run. Skipping this saves a third of the compile time (21 of 36 s for the gait of people).
    """

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


class PartCompiler(Compiler):
    """Compiler of numba with `_PartLowering` in place of `NativeLowering`."""

    def define_pipelines(self) -> list[Any]:
        """Return numba's pipelines, with `_PartLowering` in place of `NativeLowering`."""
        pipelines = super().define_pipelines()
        for pipeline in pipelines:
            pipeline.passes[:] = [
                (_PartLowering if step is NativeLowering else step, text) for step, text in pipeline.passes
            ]
            pipeline._finalized = False
            pipeline.finalize()
        return pipelines


@functools.cache
def part_type(dispatcher_type: type) -> type:
    """Return the class of parts: a dispatcher that Python cannot call."""

    def refuse(self: Any, *_: Any, **__: Any) -> None:
        raise TypeError(
            f"{self.__name__} is part of a kernel and has no entry point for Python; call it from a kernel."
        )

    def get_call_template(self: Any, args: Any, kws: Any) -> Any:
        """Return the call template, with constant arguments typed as plain values."""
        plain = {name: types.unliteral(kind) for name, kind in kws.items()}
        return dispatcher_type.get_call_template(self, tuple(types.unliteral(kind) for kind in args), plain)

    # without __call__, numba would call a null pointer
    return type("KernelPart", (dispatcher_type,), {"__call__": refuse, "get_call_template": get_call_template})
