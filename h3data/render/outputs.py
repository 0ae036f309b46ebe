"""Outputs of renderers with their shapes and types, and the poses of instances for an image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from h3data.errors import InputError
from h3data.render.camera import Camera

Output = Literal["depth", "instance", "semantic", "triangle", "rgb", "normal"]

FORMS: Mapping[str, tuple[tuple[int, ...], type]] = {
    "depth": ((), np.float32),
    "instance": ((), np.int32),
    "semantic": ((), np.int32),
    "triangle": ((), np.int32),
    "rgb": ((3,), np.uint8),
    "normal": ((3,), np.float32),
}
"""Trailing shape, after [N, H, W], and dtype of each output."""


class Poses(NamedTuple):
    """State of all instances in one world."""

    matrix: NDArray[np.float64]
    """Matrix from mesh to world of every instance, shape [I, 3, 4]; NaN if it is absent."""
    vertices: Mapping[int, NDArray[np.float32]]
    """Current vertices [V, 3] [m] of the deformable meshes that have changed, by mesh."""
    visible: NDArray[np.bool_]
    """Visibility of instances, shape [I]."""


def check_outputs(outputs: Sequence[str]) -> None:
    """Raise an InputError if a name is not an output."""
    # a string is a sequence too: of its letters
    unknown = [name for name in outputs if name not in FORMS]
    if unknown or isinstance(outputs, str):
        raise InputError(
            f"Unknown outputs {unknown or outputs!r}. Available: {', '.join(get_args(Output))}.", code="H3-RENDER-047"
        )


def picture_arrays(
    cameras: Sequence[Camera], outputs: Sequence[str], out: Mapping[str, NDArray] | None
) -> dict[str, NDArray]:
    """Return arrays [N, H, W, ...] for images of N cameras of one size, taken from ``out`` or else newly allocated."""
    results: dict[str, NDArray] = {}
    for name in outputs:
        trailing, dtype = FORMS[name]
        shape = (len(cameras), cameras[0].height, cameras[0].width, *trailing)
        array = None if out is None else out.get(name)
        if array is None:
            array = np.empty(shape, dtype)
        elif array.shape != shape or array.dtype != dtype or not array.flags.c_contiguous:
            raise InputError(
                f"out[{name!r}] must be contiguous {np.dtype(dtype)} {list(shape[1:])} for each of {len(cameras)} cameras, "
                f"got {array.dtype} {list(array.shape)} for all.",
                code="H3-RENDER-048",
            )
        results[name] = array
    return results
