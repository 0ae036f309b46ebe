"""PNG encoder for images of ids that takes a few percent of zlib's time.

Rows resemble those above, so that most pixels are skipped eight at a time. Each row is stored as its difference to the
row above (filter "up"). Runs of zeros and of any repeated number become references to one or two bytes before (RFC
1951), with the same Huffman code for all pictures.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numpy.typing import NDArray

from h3data.kernels import kernel, kernel_part
from h3data.kernels.vectors import INT64, intrinsic

_UP = 2
"""Number of the filter, the first byte of each row."""
_AT_ONCE = 16
"""Number of pixels that are compared at once."""
_END, _LONGEST = 256, 258
_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def _literal_sizes() -> NDArray[np.int64]:
    """Return the bits of the codes of bytes, of the end of the block, and of the classes of lengths, shape [286].

    Chosen for ids of homes: long runs of zeros, and small differences. Every code is used up: the sum of 2^-bits is 1.
    """
    sizes = np.full(286, 11)
    sizes[[*range(16, 19), *range(238, 241)]] = 10
    sizes[[1, *range(3, 16), *range(241, 256)]] = 9
    sizes[[0, _UP]] = 2, 4
    sizes[[258, 260, 262, *range(264, 277)]] = 7  # uneven lengths are rare: a pixel has two bytes
    sizes[277:286] = 6
    sizes[[284, 285]] = 5, 2
    return sizes


def _huffman(sizes: NDArray[np.int64]) -> list[int]:
    """Return the code of each symbol (RFC 1951, 3.2.2), its first bit lowest."""
    codes, code, before = [0] * len(sizes), 0, 0
    for symbol in sorted(range(len(sizes)), key=lambda k: (sizes[k], k)):
        code <<= int(sizes[symbol]) - before
        before = int(sizes[symbol])
        codes[symbol] = int(f"{code:0{before}b}"[::-1], 2)
        code += 1
    return codes


def _joined(parts: Iterable[tuple[int, int]]) -> tuple[int, int]:
    """Return numbers of given sizes [bits] one after another, lowest bits first, and their size together."""
    total = size = 0
    for number, bits in parts:
        total |= number << size
        size += bits
    return total, size


def _tables() -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.uint8], int]:
    """Return code and size of each byte and of the end [257, 2], and of runs by length [259, 2], without distance.

    Then the bits with which all files begin, as bytes, and their number.
    """
    sizes = _literal_sizes()
    codes = _huffman(sizes)
    runs = np.zeros((_LONGEST + 1, 2), np.int64)
    length = 3
    for k in range(28):
        extra = max(k // 4 - 1, 0)
        for offset in range(1 << extra):
            runs[length + offset] = _joined([(codes[257 + k], int(sizes[257 + k])), (offset, extra)])
        length += 1 << extra
    runs[_LONGEST] = codes[285], sizes[285]
    # one last block with a code of its own, in which the sizes of codes have four bits each, and distances 1 and 2 one bit
    size_codes = _huffman(np.full(16, 4))
    start = [(0x0178, 16), (0b101, 3), (286 - 257, 5), (2 - 1, 5), (19 - 4, 4), (0, 3 * 3), *[(4, 3)] * 16]
    total, bits = _joined([*start, *((size_codes[size], 4) for size in (*sizes, 1, 1))])
    literals = np.array([codes[: _END + 1], sizes[: _END + 1]]).T.copy()
    return literals, runs, np.frombuffer(total.to_bytes(-(-bits // 8), "little"), np.uint8), bits


_TABLES = _tables()


def id_png_bytes(ids: NDArray[np.uint16]) -> bytes:
    """Encode stored ids [H, W] as a PNG file of 16 bits per pixel."""
    height, width = ids.shape
    out = np.empty(4 * ids.size + 8 * height + 1024, np.uint8)
    size, check = _deflate(np.ascontiguousarray(ids), _TABLES, out)
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)),
        (b"IDAT", out[:size].tobytes() + struct.pack(">I", check)),
        (b"IEND", b""),
    ]
    framed = (
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(data, zlib.crc32(name)))
        for name, data in chunks
    )
    return _SIGNATURE + b"".join(framed)


@kernel(boundscheck=False)
def _deflate(ids, tables, out):
    """Fill a zlib stream up to its checksum; return its size and the checksum (Adler-32)."""
    height, width = ids.shape
    literals, runs, start, start_bits = tables
    for k in range(len(start)):
        out[k] = start[k]
    at = start_bits // 8
    bits, count = np.uint64(start[len(start) - 1] if start_bits % 8 else 0), start_bits % 8
    first, second = np.int64(1), np.int64(0)
    ids_at, above_at = np.uintp(ids.ctypes.data), np.uintp(0)
    none = np.zeros(width + _AT_ONCE, np.uint16)
    above = none
    for y in range(height):
        row = ids[y]
        row_at = ids_at + np.uintp(2 * y * width)
        above_at = np.uintp(none.ctypes.data) if y == 0 else row_at - np.uintp(2 * width)
        bits, count, at = _put(bits, count, at, out, literals[_UP, 0], literals[_UP, 1])
        first += _UP
        second += first
        x = zeros = 0
        while True:
            # nothing is read beyond the picture
            while x + _AT_ONCE <= width or y * width + x + _AT_ONCE <= ids.size:
                equal = min(equal_pixels(row_at + np.uintp(2 * x), above_at + np.uintp(2 * x)), width - x)
                x += equal
                zeros += 2 * equal
                if equal < _AT_ONCE:
                    break
            while x < width and row[x] == above[x]:
                x += 1
                zeros += 2
            if x == width:
                break
            high, low = _difference(row[x], above[x])
            begin = x
            x += 1
            while x < width and _difference(row[x], above[x]) == (high, low):
                x += 1
            if high == 0:
                zeros += 1
            second += zeros * first
            bits, count, at = _put_zeros(bits, count, at, out, literals, runs, zeros)
            zeros = 0
            if high != 0:
                first += high
                second += first
                bits, count, at = _put(bits, count, at, out, literals[high, 0], literals[high, 1])
            first += low
            second += first
            bits, count, at = _put(bits, count, at, out, literals[low, 0], literals[low, 1])
            again = x - begin - 1
            for _ in range(again):
                first += high
                second += first
                first += low
                second += first
            if again == 1:
                bits, count, at = _put(bits, count, at, out, literals[high, 0], literals[high, 1])
                bits, count, at = _put(bits, count, at, out, literals[low, 0], literals[low, 1])
            else:
                bits, count, at = _put_run(bits, count, at, out, runs, 2 * again, 1)
        second += zeros * first
        bits, count, at = _put_zeros(bits, count, at, out, literals, runs, zeros)
        first %= 65521
        second %= 65521
        above = row
    bits, count, at = _put(bits, count, at, out, literals[_END, 0], literals[_END, 1])
    while count > 0:
        out[at] = np.uint8(bits)
        bits >>= np.uint64(8)
        count -= 8
        at += 1
    return at, second << 16 | first


@kernel_part(forceinline=True)
def _difference(one, other):
    """Return the differences of the higher and of the lower bytes of two numbers, each modulo 256."""
    return ((one >> 8) - (other >> 8)) & 255, (one - other) & 255


@kernel_part(forceinline=True)
def _put(bits, count, at, out, code, size):
    """Append a code of up to 32 bits."""
    bits |= np.uint64(code) << np.uint64(count)
    count += size
    while count >= 8:
        out[at] = np.uint8(bits)
        bits >>= np.uint64(8)
        count -= 8
        at += 1
    return bits, count, at


@kernel_part()
def _put_run(bits, count, at, out, runs, length, distance_code):
    """Append ``length`` bytes, 0 or at least 3, that repeat those 1 byte (``distance_code`` 0) or 2 bytes (1) back."""
    while length > 0:
        part = min(length, _LONGEST)
        if 0 < length - part < 3:
            part = length - 4  # even, as both numbers of a pair are
        bits, count, at = _put(bits, count, at, out, runs[part, 0] | distance_code << runs[part, 1], runs[part, 1] + 1)
        length -= part
    return bits, count, at


@kernel_part()
def _put_zeros(bits, count, at, out, literals, runs, number):
    for _ in range(number if number < 4 else 1):
        bits, count, at = _put(bits, count, at, out, literals[0, 0], literals[0, 1])
    return _put_run(bits, count, at, out, runs, number - 1 if number >= 4 else 0, 0)


@intrinsic
def equal_pixels(typing_context, one_at, other_at):
    """Return how many of the 16 leading 16-bit numbers at two addresses are equal."""

    def codegen(context: Any, b: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.VectorType(ir.IntType(16), _AT_ONCE)
        values = [b.load(b.inttoptr(at, kind.as_pointer())) for at in arguments]
        for value in values:
            value.align = 2
        differ = b.zext(b.bitcast(b.icmp_unsigned("!=", *values), ir.IntType(_AT_ONCE)), INT64)
        return b.cttz(b.or_(differ, ir.Constant(INT64, 1 << _AT_ONCE)), ir.Constant(ir.IntType(1), 1))

    return types.int64(types.uintp, types.uintp), codegen
