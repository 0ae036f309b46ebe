"""FFV1 (RFC 9043, version 3) for 16-bit images: a lossless encoder that takes three quarters of the time of FFmpeg's.

An image is cut into eight columns ("slices"), each with a range coder of its own; one vector of eight lanes runs all
eight. The earlier stages run for a few rows at a time, without branches for most pixels: the difference of each pixel
to its prediction, its context, and the binary decisions that encode the difference.
"""

from __future__ import annotations

import zlib
from itertools import pairwise
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numpy.typing import NDArray

from h3data.kernels import kernel, kernel_part
from h3data.kernels.vectors import INT, INT64, LANES, intrinsic

_THRESHOLDS = 1, 4
"""Smallest differences between neighbours for the levels 1 and 2; a context consists of three levels."""
_CONTEXTS = 64
"""Number of slots for contexts, at least (5**3 + 1) / 2."""
_EXPONENT, _SIGN, _MANTISSA, _KINDS = 1, 11, 22, 32
"""Indices of the adaptive probabilities of a context: one for zero, ten for exponents, eleven for signs, ten for
mantissas."""
_MARGIN_BYTES = 256
_AT_ONCE = 32
"""Number of pixels that are predicted at once."""
_NONE, _ONE, _TWO, _THREE, _BYTE, _FIFTEEN, _HALF, _WORD, _LOW, _LOW_HALF, _ROW, _STATES = (
    np.uintp(k) for k in (0, 1, 2, 3, 8, 15, 16, 32, 0xFF, 0xFFFF, 2 * LANES, _KINDS * _CONTEXTS)
)
"""Constants as unsigned integers for address arithmetic, because numba converts the sum of a signed and an unsigned
integer to float."""
_REVERSED = bytes(int(f"{k:08b}"[::-1], 2) for k in range(256))


def _next_probabilities() -> NDArray[np.uint8]:
    """Return the probability of a 1, in 1/256, after a 0 and after a 1, given the one before, shape [2, 256].

    It is the default table of RFC 9043 (3.8.1.3): after a 1, the distance to 1 falls by a twentieth. Of the probabilities
    that follow 1/2 one after another, only the table's are rounded; the others start from their rounded values.
    """
    one, limit = 1 << 32, 248
    after = [0] * 256

    def risen(exact: int) -> int:
        return exact + (((one - exact) * int(0.05 * one) + one // 2) >> 32)

    def rounded(exact: int) -> int:
        return (256 * exact + one // 2) >> 32

    exact, before = risen(one // 2), 128
    while before < limit:
        after[before] = max(rounded(exact), before + 1)
        exact, before = risen(exact), after[before]
    for k in range(256 - limit, limit + 1):
        after[k] = after[k] or min(max(rounded(risen(k << 24)), k + 1), limit)
    return np.array([[0, *(256 - after[256 - k] for k in range(1, 256))], after]).astype(np.uint8)


_NEXT = _next_probabilities()


class _Header:
    """Binary decisions of a header: the probability of a 1 in the lower byte, the bit above."""

    def __init__(self) -> None:
        self.decisions: list[int] = []
        self.forget()

    def forget(self) -> None:
        """Make all probabilities even again."""
        self._probabilities = [128] * _KINDS

    def bit(self, value: int, kind: int = 0) -> None:
        """Append a bit."""
        before = self._probabilities[kind]
        self.decisions.append(before | value << 8)
        self._probabilities[kind] = int(_NEXT[value, before])

    def numbers(self, *values: int) -> None:
        """Append numbers from 0 to 1023."""
        for value in values:
            self.bit(int(value == 0))
            exponent = value.bit_length() - 1
            for k in range(exponent + 1):
                self.bit(int(k < exponent), _EXPONENT + k)
            for k in reversed(range(exponent)):
                self.bit(value >> k & 1, _MANTISSA + k)


def _record(slices: int) -> bytes:
    """Return the configuration record (RFC 9043, 4.3): version 3.4, one plane of 16 bits, ``slices`` columns."""
    head = _Header()
    head.numbers(3, 4, 1, 0, 16)  # range coder with its default table, luma
    head.bit(0)  # no chroma
    head.numbers(0, 0)
    head.bit(0)  # no alpha
    head.numbers(slices - 1, 0, 1)
    for bounds in (*[(0, *_THRESHOLDS, 128)] * 3, (0, 128), (0, 128)):
        levels = _Header()
        levels.numbers(*(end - first - 1 for first, end in pairwise(bounds)))
        head.decisions += levels.decisions
    head.bit(0)  # all probabilities are even at first
    head.numbers(1, 1)  # slices have checksums, and images do not depend on each other
    decisions = np.zeros((len(head.decisions), LANES), np.uint16)
    # the other seven lanes code nothing: decisions of 0 leave a coder as it is
    decisions[:, 0] = head.decisions
    out = np.empty(_MARGIN_BYTES + len(head.decisions), np.uint16)
    return _with_checksum(bytes(out[: _code_header(decisions, out)].astype(np.uint8)))


def _with_checksum(data: bytes) -> bytes:
    """Return ``data`` with a CRC of 32 bits after it, highest bit first and from 0; zlib's is its mirror image."""
    # zlib starts from all ones and inverts the result, which is undone
    mirrored = (zlib.crc32(data.translate(_REVERSED), 0xFFFFFFFF) ^ 0xFFFFFFFF).to_bytes(4, "little")
    return data + mirrored.translate(_REVERSED)


class Ffv1Encoder:
    """FFV1 encoder of uint16 images [H, W].

    It has internal buffers, so use one encoder per thread.
    """

    def __init__(self, width: int, height: int) -> None:
        """Prepare the buffers and the ``record`` that decoders need."""
        slices = min(LANES, width)
        self.record = _record(slices)
        self._starts = np.arange(LANES + 1).clip(max=slices) * width // slices
        heads = []
        for k in range(slices):
            head = _Header()
            if k == 0:
                head.bit(1)  # a key frame
                head.forget()
            head.numbers(k, 0, 0, 0, 0, 0, 3, 1, 1)  # place and size, tables, progressive, square pixels
            heads.append(head.decisions)
        self._heads = np.zeros((max(map(len, heads)), LANES), np.uint16)
        for k, head in enumerate(heads):
            self._heads[: len(head), k] = head
        widest = -(-width // slices)
        # about 1,280 pixels of a column are prepared before they are coded
        rows = max(1280 // widest, 1)
        pixels = rows * widest + _AT_ONCE
        # 33 decisions for the largest difference: 0 or not, 16 for the exponent, 15 for the mantissa, the sign
        most = max(33 * pixels, len(self._heads))
        self._buffers = (
            np.empty((LANES, rows + 1, widest + 2 * _AT_ONCE), np.int16),
            *(np.empty((LANES, pixels), kind) for kind in (np.int16, np.uint16, np.uint64)),
            np.empty((LANES, _KINDS, _CONTEXTS), np.uint8),
            np.empty((most, LANES), np.uint16),
            (np.empty((most + LANES, LANES), np.uint32), np.empty(most + LANES, np.uint8)),
        )
        self._rows = rows
        # 21 bytes of a pixel at most: a decision takes 5 bits at the least probability, 8/256
        self._out = np.empty((LANES, 21 * widest * height + _MARGIN_BYTES), np.uint16)
        self._sizes = np.empty(LANES, np.int64)

    def encoded(self, image: NDArray[np.uint16]) -> bytes:
        """Return the encoded frame of an image, which must have the encoder's size."""
        _encode(
            np.ascontiguousarray(image).view(np.int16),
            self._rows,
            self._starts,
            self._heads,
            _NEXT,
            self._buffers,
            self._out,
            self._sizes,
        )
        slices = (
            out[:size].astype(np.uint8).tobytes()
            for out, size in zip(self._out, self._sizes.tolist(), strict=True)
            if size
        )
        return b"".join(_with_checksum(one + len(one).to_bytes(3) + b"\0") for one in slices)


@kernel(boundscheck=False)
def _code_header(decisions, out):
    """Code the decisions [N, 8] of the first lane; return the number of bytes."""
    sizes, coders = np.zeros(LANES, np.int64), _coders()
    traces = np.empty((len(decisions) + LANES, LANES), np.uint32), np.zeros(len(decisions) + LANES, np.uint8)
    _code(decisions, len(decisions), coders, traces, out.reshape(1, -1), sizes)
    return _finish(coders, 0, out, sizes[0])


@kernel(boundscheck=False)
def _encode(image, rows, starts, heads, following, buffers, out, sizes):
    """Fill the slices of an image [H, W], ``rows`` at a time, and their sizes; slices without pixels have 0."""
    lines, differences, classes, entries, probabilities, decisions, traces = buffers
    coders, totals = _coders(), np.zeros(LANES, np.uintp)
    sizes[:] = 0
    lines[:, 0] = 0
    line = np.uintp(2 * lines.shape[2])
    # images do not depend on each other, so each begins with even chances
    probabilities[:] = 128
    _code(heads, len(heads), coders, traces, out, sizes)
    for first in range(0, len(image), rows):
        end = min(first + rows, len(image))
        for lane in range(LANES):
            width = np.uintp(starts[lane + 1] - starts[lane])
            if width == _NONE:
                continue
            differences_at, classes_at, lines_at = (
                _at(differences[lane], 0, 2),
                _at(classes[lane], 0, 2),
                _at(lines[lane], 0, 2),
            )
            # the line above comes first; all are there before the first is read, which the processor would wait for
            copy(lines_at + np.uintp(min(first, rows)) * line, lines_at, line)
            for y in range(first, end):
                here_at = lines_at + np.uintp(y - first + 1) * line
                write_half(read_half(here_at - line + _TWO), here_at)
                copy(_at(image, y * image.shape[1] + starts[lane], 2), here_at + _TWO, width * _TWO)
                last_at = here_at + width * _TWO
                write_half(read_half(last_at), last_at + _TWO)
            for k in range(np.uintp(end - first)):
                above_at, done = lines_at + k * line, k * width * _TWO
                predict_row(above_at, above_at + line, differences_at + done, classes_at + done, width)
        numbers = (end - first) * np.diff(starts)
        _decide(differences, classes, numbers, entries, probabilities, following, decisions, totals)
        longest = totals.max()
        for lane in range(LANES):
            for k in range(totals[lane], longest):
                decisions[k, lane] = 0  # leaves a coder as it is
        _code(decisions, longest, coders, traces, out, sizes)
    for lane in range(LANES):
        if sizes[lane] > 0:
            sizes[lane] = _finish(coders, lane, out[lane], sizes[lane])


@kernel_part(forceinline=True)
def _at(array, k, size):
    return np.uintp(array.ctypes.data) + np.uintp(size) * np.uintp(k)


@kernel_part(boundscheck=False)
def _decide(differences, classes, numbers, entries, probabilities, following, decisions, totals):
    """Fill the decisions [N, 8] about ``numbers`` [8] pixels of each lane, and their number ``totals`` [8].

    First whether each difference is 0. Those that are not are listed, and so on: of the decisions that follow, each is
    made for all of them before the next.
    """
    stride = np.uintp(classes.shape[1])
    places = (
        _at(differences, 0, 2),
        _at(classes, 0, 2),
        _at(entries, 0, 8),
        _at(probabilities, 0, 1),
        _at(following, 0, 1),
        _at(decisions, 0, 2),
        stride,
    )
    for first in range(0, LANES, 4):
        a, b, c, d = np.uintp(first), np.uintp(first + 1), np.uintp(first + 2), np.uintp(first + 3)
        at_a = at_b = at_c = at_d = listed = _NONE
        # four lanes side by side: a probability that is needed again at once is late
        common = numbers[first : first + 4].min()
        for k in range(common):
            at_a, listed = _is_zero(k, a, at_a, listed, places)
            at_b, listed = _is_zero(k, b, at_b, listed, places)
            at_c, listed = _is_zero(k, c, at_c, listed, places)
            at_d, listed = _is_zero(k, d, at_d, listed, places)
        totals[first], totals[first + 1], totals[first + 2], totals[first + 3] = at_a, at_b, at_c, at_d
        for lane in range(first, first + 4):
            for k in range(common, numbers[lane]):
                totals[lane], listed = _is_zero(k, np.uintp(lane), totals[lane], listed, places)
        _decide_rest(listed, places)


@kernel_part(forceinline=True)
def _is_zero(k, lane, at, listed, places):
    """Decide whether difference ``k`` is 0; return the number of decisions up to the next one, and of those listed."""
    _, classes_at, list_at, probabilities_at, next_at, decisions_at, stride = places
    place = lane * stride + np.uintp(k)
    entry = read_half(classes_at + place * _TWO)
    zero = np.uintp((entry >> _BYTE) == _ONE)
    probability_at = probabilities_at + lane * _STATES + (entry & _LOW)
    decide(zero, probability_at, next_at, decisions_at + at * _ROW + lane * _TWO)
    write_long(place | lane << _HALF | at << _WORD, list_at + listed * _BYTE)
    return at + (entry >> _BYTE), listed + _ONE - zero


@kernel_part()
def _decide_rest(listed, places):
    """Decide what is left about the differences that are listed, those of four lanes in turn."""
    _, _, list_at, _, next_at, _, _ = places
    larger = _NONE
    for j in range(listed):
        entry, exponent, state_at, here_at, sign = _listed(j, places)
        decide(np.uintp(exponent > _NONE), state_at + np.uintp(_EXPONENT * _CONTEXTS), next_at, here_at + _ROW)
        sign_at = state_at + (np.uintp(_SIGN) + min(exponent, np.uintp(10))) * np.uintp(_CONTEXTS)
        decide(sign >> _FIFTEEN, sign_at, next_at, here_at + (exponent + _ONE) * _TWO * _ROW)
        write_long(entry, list_at + larger * _BYTE)
        larger += np.uintp(exponent > _NONE)
    largest = _NONE
    for j in range(larger):
        entry, exponent, state_at, here_at, size = _listed(j, places)
        decide(
            np.uintp(exponent > _ONE), state_at + np.uintp((_EXPONENT + 1) * _CONTEXTS), next_at, here_at + _TWO * _ROW
        )
        decide(
            size & _ONE, state_at + np.uintp(_MANTISSA * _CONTEXTS), next_at, here_at + (exponent * _TWO + _ONE) * _ROW
        )
        write_long(entry, list_at + largest * _BYTE)
        largest += np.uintp(exponent > _ONE)
    for j in range(largest):
        _, exponent, state_at, here_at, size = _listed(j, places)
        size = min(size, np.uintp(65536) - size)
        for e in range(_TWO, exponent + _ONE):
            kind_at = state_at + (np.uintp(_EXPONENT) + min(e, np.uintp(9))) * np.uintp(_CONTEXTS)
            decide(np.uintp(e < exponent), kind_at, next_at, here_at + (e + _ONE) * _ROW)
        for k in range(_ONE, exponent):
            e = exponent - k
            kind_at = state_at + (np.uintp(_MANTISSA) + min(e, np.uintp(9))) * np.uintp(_CONTEXTS)
            decide(size >> e & _ONE, kind_at, next_at, here_at + (exponent + _ONE + k) * _ROW)


@kernel_part(forceinline=True)
def _listed(j, places):
    """Return the entry ``j`` of the list, its exponent, the places of its probabilities and decisions, and its 16 bits."""
    differences_at, classes_at, list_at, probabilities_at, _, decisions_at, _ = places
    entry = read_long(list_at + np.uintp(j) * _BYTE)
    place, lane = (entry & _LOW_HALF) * _TWO, entry >> _HALF & _LOW_HALF
    what = read_half(classes_at + place)
    return (
        entry,
        (what >> np.uintp(9)) - _ONE,
        probabilities_at + lane * _STATES + (what & _LOW),
        decisions_at + (entry >> _WORD) * _ROW + lane * _TWO,
        read_half(differences_at + place),
    )


@kernel_part(forceinline=True, boundscheck=False)
def _coders():
    """Return the lower ends and the lengths of the ranges of eight coders, shape [2, 8]."""
    coders = np.zeros((2, LANES), np.uint32)
    # the range at the start (RFC 9043, 3.8.1.1)
    coders[1] = 0xFF00
    return coders


@kernel_part(boundscheck=False)
def _code(decisions, number, coders, traces, out, sizes):
    """Code ``number`` decisions of each lane, and append bytes with carries to ``out`` [8, N] after ``sizes``."""
    uppers, marks = traces
    marks[number : number + LANES] = 0
    run_coders(
        _at(decisions, 0, 2), _at(decisions, number * LANES, 2), _at(coders, 0, 1), _at(uppers, 0, 4), _at(marks, 0, 1)
    )
    marks_at = _at(marks, 0, 1)
    for k in range(0, number, LANES):
        left = read_long(marks_at + np.uintp(k))
        while left != _NONE:
            j = lowest_bit(left)
            left &= left - _ONE
            lane = j & np.uintp(LANES - 1)
            out[lane, np.uintp(sizes[lane])] = uppers[np.uintp(k) + (j >> _THREE), lane]
            sizes[lane] += 1


@kernel_part(boundscheck=False)
def _finish(coders, lane, out, size):
    """End a slice of ``size`` numbers and make bytes of them; return the number of bytes.

    The end is the decision 0 at the probability 129/256, and as many bytes as tell it from others.
    """
    low, length = coders[0, lane], coders[1, lane]
    length -= length * np.uint32(129) >> np.uint32(8)
    if length < 0x100:
        out[size] = low >> np.uint32(8)
        low = (low & np.uint32(0xFF)) << np.uint32(8)
        size += 1
    out[size] = (low + np.uint32(0xFF)) >> np.uint32(8)
    # carries run backwards through bytes that are already written, which is why they are kept in 16 bits
    carry = np.uint16(0)
    for k in range(size, -1, -1):
        out[k] += carry
        carry = out[k] >> np.uint16(8)
    return size + 1


def _memory(bits: int) -> tuple[Any, Any]:
    """Return the functions that read and write a number of ``bits`` at an address."""

    def read(typing_context, at):
        def codegen(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
            value = b.load(b.inttoptr(arguments[0], ir.IntType(bits).as_pointer()))
            value.align = 1
            return b.zext(value, INT64)

        return types.uintp(types.uintp), codegen

    def write(typing_context, value, at):
        def codegen(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
            kind = ir.IntType(bits)
            b.store(b.trunc(arguments[0], kind), b.inttoptr(arguments[1], kind.as_pointer())).align = 1
            return context.get_dummy_value()

        return types.void(types.uintp, types.uintp), codegen

    return intrinsic(read), intrinsic(write)


read_byte, write_byte = _memory(8)
read_half, write_half = _memory(16)
read_long, write_long = _memory(64)


@intrinsic
def copy(typing_context, source_at, target_at, size):
    """Copy ``size`` bytes from one address to another."""

    def codegen(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        source, target = (b.inttoptr(at, ir.IntType(8).as_pointer()) for at in arguments[:2])
        cgutils.raw_memcpy(b, target, source, arguments[2], 1)
        return context.get_dummy_value()

    p = types.uintp
    return types.void(p, p, p), codegen


@intrinsic
def lowest_bit(typing_context, number):
    """Return the position of the lowest set bit of a number above 0."""

    def codegen(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        return b.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.uintp(types.uintp), codegen


@intrinsic
def decide(typing_context, bit, probability_at, next_at, decision_at):
    """Write a binary decision and its probability, and update the probability for the next decision of its kind."""

    def codegen(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        bit, probability_at, next_at, decision_at = arguments
        byte, half = ir.IntType(8), ir.IntType(16)
        probability = b.inttoptr(probability_at, byte.as_pointer())
        decision = b.or_(b.zext(b.load(probability), INT64), b.shl(bit, ir.Constant(INT64, 8)))
        b.store(b.trunc(decision, half), b.inttoptr(decision_at, half.as_pointer())).align = 2
        b.store(b.load(b.inttoptr(b.add(next_at, decision), byte.as_pointer())), probability)
        return context.get_dummy_value()

    p = types.uintp
    return types.void(p, p, p, p), codegen


@intrinsic
def predict_row(typing_context, above_at, here_at, differences_at, classes_at, width):
    """Compute the prediction errors of the pixels of a row and their classes; up to 31 pixels too many are computed.

    A class is the context and, in the upper byte, the number of decisions. The numbers at ``here_at`` and ``above_at``
    start with the left neighbour of the first pixel.
    """

    def codegen(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        above_at, here_at, differences_at, classes_at, width = arguments
        half, byte = (ir.VectorType(ir.IntType(bits), _AT_ONCE) for bits in (16, 8))
        counting = ir.FunctionType(half, [half, ir.IntType(1)])
        leading_zeros = cgutils.get_or_insert_function(b.module, counting, f"llvm.ctlz.v{_AT_ONCE}i16")

        def each(number: int, kind: Any = half) -> Any:
            return ir.Constant(kind, [number] * _AT_ONCE)

        def read(at: Any, k: int) -> Any:
            value = b.load(b.inttoptr(b.add(at, ir.Constant(INT64, 2 * k)), half.as_pointer()))
            value.align = 2
            return value

        def write(value: Any, at: Any) -> None:
            b.store(value, b.inttoptr(at, value.type.as_pointer())).align = 1

        def least(one: Any, other: Any, sign: str = "<") -> Any:
            return b.select(b.icmp_signed(sign, one, other), one, other)

        def negated_if(mask: Any, value: Any) -> Any:
            return b.select(mask, b.sub(each(0), value), value)

        with cgutils.for_range(
            b, b.udiv(b.add(width, ir.Constant(INT64, _AT_ONCE - 1)), ir.Constant(INT64, _AT_ONCE))
        ) as row:
            offset = b.mul(row.index, ir.Constant(INT64, 2 * _AT_ONCE))
            corner, top, right = (read(b.add(above_at, offset), k) for k in range(3))
            left, value = (read(b.add(here_at, offset), k) for k in range(2))
            low, high = least(left, top), least(left, top, ">")
            plane = b.sub(b.add(left, top), corner)
            inner = b.select(b.icmp_signed("<=", corner, low), high, plane)
            difference = b.sub(value, b.select(b.icmp_signed(">=", corner, high), low, inner))
            which = each(0, byte)
            for one, other in ((top, right), (corner, top), (left, corner)):
                step = b.trunc(b.sub(one, other), byte)  # only the lower byte counts
                double = b.add(which, which)
                which = b.add(b.add(double, double), which)  # _LEVELS times
                for threshold in _THRESHOLDS:
                    which = b.sub(which, b.sext(b.icmp_signed(">=", step, each(threshold, byte)), byte))
                    which = b.add(which, b.sext(b.icmp_signed("<=", step, each(-threshold, byte)), byte))
            which = b.sext(which, half)
            negative = b.icmp_signed("<", which, each(0))
            difference = negated_if(negative, difference)
            size = negated_if(b.icmp_signed("<", difference, each(0)), difference)
            bits = b.sub(each(16), b.call(leading_zeros, [size, ir.Constant(ir.IntType(1), 0)]))
            write(difference, b.add(differences_at, offset))
            number = b.shl(b.add(b.add(bits, bits), each(1)), each(8))
            write(b.or_(negated_if(negative, which), number), b.add(classes_at, offset))
        return context.get_dummy_value()

    p = types.uintp
    return types.void(p, p, p, p, p), codegen


@intrinsic
def run_coders(typing_context, at, end, coders_at, uppers_at, marks_at):
    """Encode eight binary decisions at a time, one for each range coder, from address ``at`` to ``end``.

    For each eight decisions, the upper bits of the lower ends of the coders' ranges are written as eight words at
    ``uppers_at``. A byte at ``marks_at`` has a bit for each coder whose range fell below 256; the 9 upper bits of its
    word are a byte to write and its carry. A decision of probability 0 and bit 0 changes nothing.
    """

    def codegen(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        at, end, coders_at, uppers_at, marks_at = arguments
        words = ir.VectorType(INT, LANES)

        def each(number: int) -> Any:
            return ir.Constant(words, [number] * LANES)

        def pointer(where: Any, kind: Any) -> Any:
            return b.inttoptr(where, kind.as_pointer())

        lows_at, lengths_at = pointer(coders_at, words), pointer(b.add(coders_at, ir.Constant(INT64, 4 * LANES)), words)
        first, last = b.load(lows_at), b.load(lengths_at)
        first.align = last.align = 4
        before = b.block
        head, step, after = (b.append_basic_block(name) for name in ("head", "step", "after"))
        b.branch(head)
        b.position_at_end(head)
        here, upper_at, mark_at = b.phi(INT64), b.phi(INT64), b.phi(INT64)
        low, length = b.phi(words), b.phi(words)
        b.cbranch(b.icmp_unsigned("<", here, end), step, after)

        b.position_at_end(step)
        halves = b.load(pointer(here, ir.VectorType(ir.IntType(16), LANES)))
        halves.align = 2
        decision = b.zext(halves, words)
        ones = b.lshr(b.mul(length, b.and_(decision, each(0xFF))), each(8))
        zeros = b.sub(length, ones)
        is_one = b.icmp_unsigned(">", decision, each(0xFF))
        new_low = b.add(low, b.select(is_one, zeros, each(0)))
        new_length = b.select(is_one, ones, zeros)
        b.store(b.lshr(new_low, each(8)), pointer(upper_at, words)).align = 4
        short = b.icmp_unsigned("<", new_length, each(0x100))
        b.store(b.bitcast(short, ir.IntType(8)), pointer(mark_at, ir.IntType(8)))
        new_low = b.select(short, b.shl(b.and_(new_low, each(0xFF)), each(8)), new_low)
        new_length = b.select(short, b.shl(new_length, each(8)), new_length)
        for phi, start, new in (
            (here, at, b.add(here, ir.Constant(INT64, 2 * LANES))),
            (upper_at, uppers_at, b.add(upper_at, ir.Constant(INT64, 4 * LANES))),
            (mark_at, marks_at, b.add(mark_at, ir.Constant(INT64, 1))),
            (low, first, new_low),
            (length, last, new_length),
        ):
            phi.add_incoming(start, before)
            phi.add_incoming(new, step)
        b.branch(head)

        b.position_at_end(after)
        b.store(low, lows_at).align = 4
        b.store(length, lengths_at).align = 4
        return context.get_dummy_value()

    p = types.uintp
    return types.void(p, p, p, p, p), codegen
