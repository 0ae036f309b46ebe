"""Bounding boxes and masks of the visible pixels of each id in an instance or semantic image."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from h3data.errors import InputError


class Boxes(NamedTuple):
    """Bounding boxes of the visible pixels of each id in an image, ordered by id."""

    ids: NDArray[np.int32]
    """Id of each box, shape [B]."""
    boxes: NDArray[np.int32]
    """Bounds of the boxes: first column, first row, end column, end row (ends exclusive) [px], shape [B, 4]."""
    pixels: NDArray[np.int64]
    """Number of visible pixels, shape [B]."""


def visible_boxes(ids: ArrayLike, *, groups: ArrayLike | None = None) -> Boxes:
    """Return boxes around the visible pixels of each id in an instance or semantic image [H, W].

    ``groups`` maps ids (0, 1, ...) to the id of the body that they belong to, e.g. the links of a robot to the robot; -1
    leaves an id out.
    """
    i = _grouped(ids, groups)
    unique, inverse = np.unique(i, return_inverse=True)
    rows, columns = np.indices(i.shape).reshape(2, -1)
    inverse = inverse.reshape(-1)
    low, high = np.full((len(unique), 2), 2**31 - 1), np.full((len(unique), 2), -1)
    for axis, values in enumerate((columns, rows)):
        np.minimum.at(low[:, axis], inverse, values)
        np.maximum.at(high[:, axis], inverse, values)
    keep = unique >= 0
    boxes = np.concatenate([low, high + 1], axis=1)[keep].astype(np.int32)
    return Boxes(unique[keep].astype(np.int32), boxes, np.bincount(inverse, minlength=len(unique))[keep])


def visible_masks(ids: ArrayLike, wanted: ArrayLike, *, groups: ArrayLike | None = None) -> NDArray[np.bool_]:
    """Return masks [B, H, W] of the pixels where each of the ``wanted`` ids [B] is visible.

    The argument ``groups`` has the same meaning as in `visible_boxes`.
    """
    return _grouped(ids, groups)[None] == np.asarray(wanted).reshape(-1, 1, 1)


def _grouped(ids: ArrayLike, groups: ArrayLike | None) -> NDArray[np.integer]:
    i = np.asarray(ids)
    if i.ndim != 2 or i.dtype.kind not in "iu":
        raise InputError(
            f"Expected an image of integer ids [H, W], got {i.dtype} {list(i.shape)}.", code="H3-RENDER-001"
        )
    if groups is None:
        return i
    table = np.append(np.asarray(groups, np.int64), -1)
    if i.max(initial=-1) >= len(table) - 1:
        raise InputError(
            f"The groups cover the ids 0 to {len(table) - 2}, but the image has id {i.max()}.", code="H3-RENDER-002"
        )
    return table[np.maximum(i, -1)]


def draw_boxes(
    image: NDArray[np.uint8], boxes: ArrayLike, labels: Sequence[str], colors: ArrayLike, *, thickness: int = 2
) -> None:
    """Draw boxes [B, 4] (see `visible_boxes`) with labels, in colours [B, 3]."""
    import cv2

    rows, paints = np.asarray(boxes).reshape(-1, 4), np.asarray(colors).reshape(-1, 3)
    if not len(rows) == len(labels) == len(paints):
        raise InputError(
            f"Expected a label and a colour for each of {len(rows)} boxes, got {len(labels)}, {len(paints)}.",
            code="H3-RENDER-050",
        )
    for (x0, y0, x1, y1), label, paint in zip(rows.tolist(), labels, paints.tolist(), strict=True):
        cv2.rectangle(image, (x0, y0), (x1 - 1, y1 - 1), paint, thickness)
        for width, color in ((3, (20, 20, 20)), (1, paint)):
            place = (x0 + 3, max(y0 - 5, 12))
            cv2.putText(image, label, place, cv2.FONT_HERSHEY_SIMPLEX, 0.45, color, width, cv2.LINE_AA)
