"""Colour scale of depth pictures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from h3data.render.colors import depth_to_rgb


def draw_depth_scale(image: NDArray[np.uint8], near: float, far: float) -> None:
    """Draw a scale of depth colours into the lower left corner of a depth picture [H, W, 3].

    The scale has the colours of `h3data.render.depth_to_rgb` from ``near`` to ``far`` [m], labelled with both values.
    Pictures smaller than 96 x 64 are not changed.
    """
    import cv2

    height, width = image.shape[:2]
    if width < 96 or height < 64:
        return
    # On a dark plate, in letters of at least 10 pixels: smaller ones, or white ones on the picture, do not survive H.264.
    scale = max(height / 900, 0.45)
    texts = [f"{value:.3g} m" for value in (near, far)]
    sizes = [cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)[0] for text in texts]
    tall = sizes[0][1]
    long, thick, margin = max(width // 4, sizes[0][0] + sizes[1][0] + 12), max(height // 40, 7), max(height // 40, 4)
    top, left = height - margin - thick, margin
    image[top - tall - 10 : top + thick + 3, left - 3 : left + long + 3] = 20
    bar = depth_to_rgb(np.broadcast_to(np.linspace(max(near, 1e-3), far, long), (thick, long)), near, far)
    image[top : top + thick, left : left + long] = bar
    for text, at in zip(texts, (left, left + long - sizes[1][0]), strict=True):
        place = (at, top - 5)
        cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 255, 255), 1, cv2.LINE_AA)
