"""Selection of the pixels of a row that are shaded again, for a static camera.

A pixel's colour depends on the surface in it and its run of equal pixels, on the occlusion around it, and on the
capsules of its tile. Runs are shaded in blocks of 8 pixels from their first pixel, so a pixel is rounded as before only
if its run starts at the same pixel.
"""

from __future__ import annotations

from h3data.kernels import kernel_part
from h3data.render.shade.blockers import TILE_X, TILE_Y

SEEN, LIT, SHADED = 1, 2, 4
"""Bits of a mark, which state that the visible surface may have changed, that only its light may have changed, and that
the pixel has been shaded."""


@kernel_part()
def mark_row(marks, drawn, occlusion_changed, cast_changed, factor, y, width):
    """Fill the marks of a row [W + 8] of the picture.

    ``drawn`` marks the tiles of 8 pixels of the target that were rendered again; the target has ``factor`` times the
    size of the picture. ``occlusion_changed`` marks pixels at half the resolution, each of which affects its
    neighbours. ``cast_changed`` marks tiles whose capsules have changed.
    """
    marks[:] = 0
    each = 8 // factor
    row = drawn[y * factor // 8]
    for tile in range(len(row)):
        if row[tile]:
            for x in range(tile * each, min((tile + 1) * each, width)):
                marks[x] = SEEN
    # an odd row lies between two rows of the coarse image and is lit by both, an even one on a row of its own
    for lower in range(2):
        coarse = (y + lower) // 2
        if coarse < len(occlusion_changed):
            line = occlusion_changed[coarse]
            # most rows have none, which is quick to tell
            for c in range(len(line) if any_marked(line, 0, len(line), 1) else 0):
                if line[c]:
                    # its own pixel and one on either side, which are interpolated from it
                    for x in range(max(2 * c - 1, 0), min(2 * c + 2, width)):
                        marks[x] |= LIT
    across = -(-width // TILE_X)
    for k in range(across if len(cast_changed) else 0):
        if cast_changed[y // TILE_Y * across + k]:
            for x in range(k * TILE_X, min((k + 1) * TILE_X, width)):
                marks[x] |= LIT


@kernel_part()
def marked_runs(marks, words, factor, width):
    """Return the first pixel and the end of the part of a row that holds all marked pixels and the runs of their neighbours.

    ``words`` are those of the row in the target, with ``factor`` times as many columns; a run ends where they differ. The first
    pixel is a multiple of 8, and so is the end unless it is that of the row. Both are 0 without marked pixels.
    """
    first, last = 0, width
    while first < last and not marks[first]:
        first += 1
    while last > first and not marks[last - 1]:
        last -= 1
    if first == last:
        return 0, 0
    # the run after the last marked pixel is marked too if it may have been part of that pixel's run (`mark_run`)
    last = min(last + 1, width)
    while first > 0 and words[factor * first] == words[factor * (first - 1)]:
        first -= 1
    while last < width and words[factor * last] == words[factor * (last - 1)]:
        last += 1
    return first // 8 * 8, min(-(-last // 8) * 8, width)


@kernel_part()
def mark_run(marks, begin, end):
    """Mark the pixels of a run that may have belonged to another run in the last picture."""
    # the pixel before may have been of the same run, which then began earlier and had other blocks
    other = begin > 0 and (marks[begin - 1] & SEEN) != 0
    for x in range(begin, end):
        if marks[x] & SEEN:
            other = True
        if other:
            marks[x] |= LIT


@kernel_part()
def next_blocks(marks, begin, low, end):
    """Find the next blocks with marked pixels and mark them as shaded; return their first pixel and their end.

    Blocks of 8 are counted from ``begin``; the search starts at ``low``.

    Both results are ``end`` if there are no such blocks.
    """
    # whole blocks counted from ``begin``, as when all is shaded, so that each pixel has the same lane as then
    while low < end and not any_marked(marks, low, min(low + 8, end), SEEN | LIT | SHADED):
        low += 8
    low = high = min(low, end)
    while high < end and any_marked(marks, high, min(high + 8, end), SEEN | LIT | SHADED):
        high += 8
    high = min(high, end)
    for x in range(low, high):
        marks[x] |= SHADED
    return low, high


@kernel_part(forceinline=True)
def any_marked(marks, first, last, bits):
    """Return whether one of the pixels from ``first`` to ``last`` has a mark in ``bits``."""
    found = False
    for x in range(first, last):
        found |= (marks[x] & bits) != 0
    return found
