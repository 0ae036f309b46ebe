"""Arrays without reference counts, because counting would take longer than the small functions that use them."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types

from h3data.kernels.vectors import intrinsic


@intrinsic
def borrowed(typing_context, value):
    """Return the same array, or tuple of arrays, without ownership of its memory; the caller must keep it alive.

    Numba increments a reference count whenever an array is read from a tuple.
    """

    def codegen(context, builder, signature, arguments):
        return _without_owner(context, builder, signature.args[0], arguments[0])

    return value(value), codegen


def _without_owner(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    if isinstance(kind, types.Array):
        array = context.make_array(kind)(context, builder, value)
        array.meminfo = ir.Constant(array.meminfo.type, None)
        return array._getvalue()
    if isinstance(kind, types.BaseTuple):
        members: Any = kind
        for k, member in enumerate(members):
            part = _without_owner(context, builder, member, builder.extract_value(value, k))
            value = builder.insert_value(value, part, k)
    return value
