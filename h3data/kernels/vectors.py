"""Eight numbers at a time in numba: a small algebra that emits ``<8 x float>`` LLVM IR, or ``<8 x double>``, inside intrinsics.

It depends neither on the auto-vectoriser nor on a C compiler; LLVM lowers the vectors to whatever the machine offers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from llvmlite.binding import get_host_cpu_features
from numba.core import cgutils, config
from numba.extending import intrinsic as _numba_intrinsic

LANES = 8
# NUMBA_CPU_NAME compiles for other processors, as for the shipped kernels
_AVX = get_host_cpu_features().get("avx", False) and getattr(config, "CPU_NAME", None) in (
    None,
    "host",
    "x86-64-v3",
    "x86-64-v4",
)
FLOAT = ir.FloatType()
INT = ir.IntType(32)
INT64 = ir.IntType(64)
FLOAT8 = ir.VectorType(FLOAT, LANES)
INT8 = ir.VectorType(INT, LANES)
DOUBLE8 = ir.VectorType(ir.DoubleType(), LANES)


def intrinsic(function: Callable[..., Any]) -> Any:
    """numba's decorator, typed as `Any` because callers omit the first parameter (the typing context)."""
    return _numba_intrinsic(function)


class Mask:
    """Vector of eight truth values, as a comparison of two vectors gives."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    def __and__(self, other: Mask) -> Mask:
        return Mask(self.builder, self.builder.and_(self.value, other.value))

    def __or__(self, other: Mask) -> Mask:
        return Mask(self.builder, self.builder.or_(self.value, other.value))

    def __invert__(self) -> Mask:
        return Mask(self.builder, self.builder.not_(self.value))

    def bits(self, shift: int) -> Any:
        """Return the eight booleans as bits ``shift`` to ``shift + 7`` of an int32."""
        b = self.builder
        return b.shl(b.zext(b.bitcast(self.value, ir.IntType(LANES)), INT), ir.Constant(INT, shift))


class Vec:
    """Eight float32, or eight float64, with arithmetic; plain numbers are broadcast."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    def _lift(self, other: Vec | float) -> Any:
        return other.value if isinstance(other, Vec) else ir.Constant(self.value.type, [float(other)] * LANES)

    def _binary(self, name: str, other: Vec | float) -> Vec:
        return Vec(self.builder, getattr(self.builder, name)(self.value, self._lift(other)))

    def __add__(self, other: Vec | float) -> Vec:
        return self._binary("fadd", other)

    def __sub__(self, other: Vec | float) -> Vec:
        return self._binary("fsub", other)

    def __mul__(self, other: Vec | float) -> Vec:
        return self._binary("fmul", other)

    def __neg__(self) -> Vec:
        # 0 - x instead of fneg: -(+0) must be +0, because the span code divides by these numbers
        return Vec(self.builder, self.builder.fsub(self._lift(0.0), self.value))

    def reciprocal(self) -> Vec:
        """Reciprocal of each component."""
        return Vec(self.builder, self.builder.fdiv(self._lift(1.0), self.value))

    def divided_by(self, other: Vec) -> Vec:
        """Return the quotients of the components of two vectors."""
        return self._binary("fdiv", other)

    def compare(self, operator: str, other: Vec | float) -> Mask:
        """Return the mask of the components for which a comparison such as ``<`` holds; false for NaN."""
        return Mask(self.builder, self.builder.fcmp_ordered(operator, self.value, self._lift(other)))

    def minimum(self, other: Vec | float) -> Vec:
        """Return the smaller one of each pair of components of two vectors."""
        return self.where(self.compare("<", other), other)

    def maximum(self, other: Vec | float) -> Vec:
        """Return the larger one of each pair of components of two vectors."""
        return self.where(self.compare(">", other), other)

    def where(self, mask: Mask, other: Vec | float) -> Vec:
        """Return the vector where a mask holds, and other components elsewhere."""
        return Vec(self.builder, self.builder.select(mask.value, self.value, self._lift(other)))

    def unary(self, name: str) -> Vec:
        """Return ``ceil``, ``floor``, ``fabs`` or ``sqrt`` of each component."""
        kind = self.value.type
        name = f"llvm.{name}.v8f{32 if kind == FLOAT8 else 64}"
        function = cgutils.get_or_insert_function(self.builder.module, ir.FunctionType(kind, [kind]), name)
        return Vec(self.builder, self.builder.call(function, [self.value]))


def fma(x: Vec, y: Vec | float, z: Vec | float) -> Vec:
    """Return ``x * y + z``, computed by one instruction if the processor has one."""
    b = x.builder
    function = cgutils.get_or_insert_function(b.module, ir.FunctionType(FLOAT8, [FLOAT8] * 3), "llvm.fmuladd.v8f32")
    return Vec(b, b.call(function, [x.value, x._lift(y), x._lift(z)]))


def lanes(builder: Any) -> Vec:
    """Return the lane indices 0 to 7."""
    return Vec(builder, ir.Constant(FLOAT8, [float(k) for k in range(LANES)]))


def splat(builder: Any, scalar: Any, vector_type: Any = FLOAT8) -> Any:
    """Return a scalar broadcast to all eight lanes."""
    undefined = ir.Constant(vector_type, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(INT, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(INT8, [0] * LANES))


def spread(builder: Any, address: Any, word: int, kind: Any = FLOAT8) -> Vec:
    """Return the number ``word`` of the array at ``address`` in all eight lanes."""
    size = 4 if kind == FLOAT8 else 8
    return Vec(builder, splat(builder, load(builder, address, size * word, kind.element), kind))


def load(builder: Any, address: Any, offset: int = 0, kind: Any = FLOAT8) -> Any:
    """Return the value at ``address + offset`` bytes."""
    pointer = builder.inttoptr(builder.add(address, ir.Constant(INT64, offset)), kind.as_pointer())
    value = builder.load(pointer)
    # rows of 8 begin at any float, not only at multiples of 32 bytes, which LLVM would otherwise take for granted
    value.align = 1 if kind == ir.IntType(8) else 4
    return value


def fetch(builder: Any, address: Any) -> None:
    """Request the cache line at ``address``, which may be any address."""
    kind = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, INT, INT, INT])
    function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
    # to read, into all levels, data
    builder.call(function, [builder.inttoptr(address, cgutils.voidptr_t), *(ir.Constant(INT, k) for k in (0, 3, 1))])


def store(builder: Any, value: Any, address: Any, offset: int = 0) -> None:
    """Write a value to ``address + offset`` bytes."""
    pointer = builder.inttoptr(builder.add(address, ir.Constant(INT64, offset)), value.type.as_pointer())
    builder.store(value, pointer).align = 4


def opaque(builder: Any, value: Any) -> Any:
    """Return ``value`` such that LLVM cannot make assumptions about it.

    LLVM turns the store of a selection into a masked store, which AMD's processors execute in microcode and for which
    later loads have to wait. A blend and a whole store take half the time. The function has an effect only where eight
    lanes fit one register.
    """
    if not _AVX:
        return value
    kind = ir.FunctionType(value.type, [value.type])
    return builder.asm(kind, "", "=x,0", [value], side_effect=False)


def pick(builder: Any, low: Any, high: Any, order: Sequence[int]) -> Any:
    """Return lanes of two vectors in the given order: 0-7 are lanes of ``low``, 8-15 are lanes of ``high``."""
    return builder.shuffle_vector(low, high, ir.Constant(INT8, list(order)))


def gather(builder: Any, address: Any, index: Any) -> Any:
    """Return the float32 number ``index[lane]`` of the array at ``address``, per lane.

    Eight scalar loads measured no slower than the machine's gather instruction.
    """
    out = ir.Constant(FLOAT8, ir.Undefined)
    for lane in range(LANES):
        number = builder.zext(builder.extract_element(index, ir.Constant(INT, lane)), INT64)
        value = load(builder, builder.add(address, builder.shl(number, ir.Constant(INT64, 2))), 0, FLOAT)
        out = builder.insert_element(out, value, ir.Constant(INT, lane))
    return out
