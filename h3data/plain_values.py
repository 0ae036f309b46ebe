"""What `unpickle_arrays` built, unfolded into values that JSON can hold, within bounds that the size of the file sets.

A pickle can refer to one list again and again: a few bytes may stand for more values than any memory holds, or for a list
that holds itself.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.array_pickle import PickledArray

_UNFOLD = 64
"""How many values may come out of one byte: more only happens where a file refers to one list again and again."""
_DEPTH = 100


class PlainValues:
    """Dicts with text keys, lists, numbers, texts and None out of one file; what else comes is up to its kind.

    Called with a value, it raises `TypeError` or `ValueError` for what does not belong into such a file.
    """

    of = "a file"

    def __init__(self, data: bytes) -> None:
        self._budget = _UNFOLD * len(data)

    def __call__(self, value: Any, depth: int = 0) -> Any:
        self._budget -= value.array.size if isinstance(value, PickledArray) else 1
        if self._budget < 0 or depth > _DEPTH:
            raise ValueError("it unfolds to far more than the file holds")
        if isinstance(value, PickledArray):
            return self.array(value.array, depth)
        if isinstance(value, dict):
            return {self.key(key, depth + 1): self(entry, depth + 1) for key, entry in value.items()}
        if isinstance(value, (list, tuple)):
            return [self(entry, depth + 1) for entry in value]
        if isinstance(value, float) and not math.isfinite(value):
            return self.not_finite(value)
        if isinstance(value, str):
            value.encode()  # refuses halves of surrogate pairs, which no file of ours could hold
        if value is None or type(value) in (bool, int, float, str):
            return value
        return self.other(value, depth)

    def key(self, key: Any, depth: int) -> str:
        """A key of a dict."""
        if type(key) not in (str, int):
            raise TypeError(f"a key is a {type(key).__name__}")
        return str(self(key, depth))

    def array(self, array: NDArray[Any], depth: int) -> Any:
        """An array, whose values are in the budget already."""
        del depth
        if array.dtype.hasobject:
            raise TypeError(f"an array of objects does not belong into {self.of}")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError("an array holds NaN or infinity")
        return array.tolist()

    def not_finite(self, value: float) -> Any:
        """NaN or an infinity."""
        del value
        raise ValueError("a number is NaN or infinity")

    def other(self, value: Any, depth: int) -> Any:
        """Anything else."""
        del depth
        raise TypeError(f"a {type(value).__name__.strip('_')} does not belong into {self.of}")
