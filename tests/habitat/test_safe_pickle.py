"""Pickles: plain values and arrays come out as they went in, nothing runs, and a small file never becomes a large one."""

from __future__ import annotations

import collections
import json
import math
import pickle
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from h3data.errors import FormatError
from h3data_habitat.safe_pickle import builtin, load_pickle

PATH = Path("x.pkl")
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


def load(value: Any, protocol: int = 4) -> Any:
    return load_pickle(pickle.dumps(value, protocol=protocol), PATH)


@given(VALUES, st.sampled_from([2, 3, 4, 5]))
def test_plain_values_come_out_as_they_went_in(value: Any, protocol: int) -> None:
    assert load(value, protocol) == value


@given(
    st.lists(st.integers(0, 3), max_size=3),
    st.sampled_from(["i4", ">f4", "f8", "?", "O"]),
    st.sampled_from([2, 4, 5]),
    st.booleans(),
)
def test_arrays_come_out_as_they_went_in(shape: list[int], dtype: str, protocol: int, fortran: bool) -> None:
    array = np.arange(math.prod(shape)).reshape(shape).astype(dtype, order="F" if fortran else "C")
    value = load({"a": array, "b": array[..., :1] if shape else array, "c": np.float32(0.5)}, protocol)
    np.testing.assert_array_equal(value["a"], array)
    assert (value["a"].shape, value["a"].dtype.kind) == (array.shape, array.dtype.kind)
    assert value["c"] == 0.5
    assert json.loads(msgspec.json.encode(value, enc_hook=builtin))["a"] == array.tolist()


def doubled(times: int) -> list[Any]:
    """A list that refers to one list twice, and so on."""
    value: list[Any] = [0]
    for _ in range(times):
        value = [value, value]
    return value


def test_what_unfolds_to_more_than_the_file_is_refused() -> None:
    itself: list[Any] = []
    itself.append(itself)
    through: dict[str, Any] = {"a": np.array([None], object)}
    through["a"][0] = [through]
    deep: list[Any] = []
    for _ in range(200):
        deep = [deep]
    shared = [np.zeros(1000, np.uint8)] * 1000
    for value in (doubled(60), itself, through, deep, shared):
        with pytest.raises(FormatError, match=r"(?s)far more.*H3-FORMAT-026"):
            load(value)
    assert load(doubled(9)) == doubled(9)


@pytest.mark.parametrize(
    "value", [{1.5: 0}, {(1,): 0}, object(), {1, 2}, b"bytes", 1j, print, collections.OrderedDict(), np.array(["text"])]
)
def test_anything_else_is_refused(value: Any) -> None:
    with pytest.raises(FormatError, match="H3-FORMAT-026"):
        load([value])


class Call:
    """Pickles as a call of a function."""

    def __init__(self, function: Any, *arguments: Any, state: Any = None) -> None:
        self.parts = (function, arguments) if state is None else (function, arguments, state)

    def __reduce__(self) -> Any:
        return self.parts


def test_arrays_cannot_claim_what_they_do_not_hold() -> None:
    reconstruct: Any = np.zeros(1).__reduce__()[0]
    float64: Any = np.dtype("f8")
    for shape, dtype, data in (
        ((1 << 40,), float64, b""),
        ((1 << 62, 4), float64, b""),
        ((-1,), float64, b"\0" * 8),
        ((2,), float64, b"\0" * 8),
        ((1,), np.dtype("O"), b"\0" * 8),
        ((1 << 40,), np.dtype("O"), [1]),
        ((1,), float64, [1.0]),
        ((1,), "f8", b"\0" * 8),
        ((1,), np.dtype("V8"), b"\0" * 8),
        ([1], float64, b"\0" * 8),
    ):
        with pytest.raises(FormatError, match="H3-FORMAT-026"):
            load(Call(reconstruct, np.ndarray, (0,), b"b", state=(1, shape, dtype, False, data)))
    assert load(Call(reconstruct, np.ndarray, (1 << 40,), b"b", state=(1, (1,), float64, False, b"\0" * 8))) == [0]


def test_no_dtype_of_the_process_is_changed() -> None:
    swapped = Call(np.dtype, "f8", False, False, state=(3, ">", None, None, None, -1, -1, 0))
    with pytest.raises(FormatError):
        load([swapped])
    assert np.dtype("f8").isnative
