"""Values out of pickles: JSON can hold them, and a small file never becomes a large one."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from h3data.array_pickle import PickledArray
from h3data.plain_values import PlainValues

LEAVES = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text()
VALUES = st.recursive(
    LEAVES,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.tuples(inner, inner)
        | st.dictionaries(st.text() | st.integers(), inner, max_size=4)
    ),
    max_leaves=20,
)
ROOMY = b"." * 10_000


@given(VALUES)
def test_plain_values_are_what_json_makes_of_them(value: Any) -> None:
    assert PlainValues(ROOMY)(value) == json.loads(json.dumps(value))


@given(st.lists(st.integers(0, 3), max_size=3), st.sampled_from(["i4", "f4", "f8", "?"]))
def test_arrays_become_lists(shape: list[int], dtype: str) -> None:
    array = np.arange(math.prod(shape)).reshape(shape).astype(dtype)
    assert PlainValues(ROOMY)({"a": PickledArray(array)}) == {"a": array.tolist()}


def doubled(times: int) -> list[Any]:
    """A list that refers to one list twice, and so on."""
    value: list[Any] = [0]
    for _ in range(times):
        value = [value, value]
    return value


def test_what_unfolds_to_more_than_the_file_is_refused() -> None:
    itself: list[Any] = []
    itself.append(itself)
    deep: list[Any] = []
    for _ in range(200):
        deep = [deep]
    wide = PickledArray(np.broadcast_to(np.float32(1), (1 << 30,)))  # type: ignore[arg-type]
    for value in (doubled(60), itself, deep, wide, {"a": [wide, wide]}):
        with pytest.raises(ValueError, match="far more"):
            PlainValues(ROOMY)(value)
    assert PlainValues(b"." * 64)(doubled(9)) == doubled(9)
    with pytest.raises(ValueError, match="far more"):
        PlainValues(b"." * 64)([doubled(9)] * 5)


@pytest.mark.parametrize(
    "value",
    [
        math.nan, -math.inf, "\ud800", {"\ud800": 1}, {1.5: 0}, {(1,): 0}, object(), {1, 2}, b"bytes", 1j,
        PickledArray(np.array([1.0, math.nan])), PickledArray(np.array([None])),
    ],
)  # fmt: skip
def test_what_json_cannot_hold_is_refused(value: Any) -> None:
    with pytest.raises((TypeError, ValueError)):
        PlainValues(ROOMY)([value])
