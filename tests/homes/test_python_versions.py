"""Homes have the same bits on all versions of Python."""

from __future__ import annotations

import builtins
from collections.abc import Iterable
from typing import Any

import pytest

from h3data.geometry import add_up
from h3data.scene.open import named_scenes
from h3data.scene.sources import scene_of

plain_sum = builtins.sum


def compensated(values: Iterable[Any], /, start: Any = 0) -> Any:
    """`sum` as of Python 3.12, which keeps what floats lose in a number beside the total (Neumaier)."""
    items = list(values)
    if not items or not all(type(item) in (int, float) for item in items) or all(type(item) is int for item in items):
        return plain_sum(items, start)
    total, lost = float(start), 0.0
    for item in map(float, items):
        after = total + item
        lost += (total - after) + item if abs(total) >= abs(item) else (item - after) + total
        total = after
    return total + lost


def test_sums_of_floats_do_not_depend_on_the_version() -> None:
    tenths = [0.1] * 10
    assert add_up(tenths) != compensated(tenths) == 1.0
    assert add_up(tenths) == 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1
    assert add_up([]) == 0.0


@pytest.mark.parametrize(
    "name", ["h3-homes/test#3", "h3-homes-open/test#0", pytest.param("large:4", marks=pytest.mark.slow)]
)
def test_homes_do_not_depend_on_how_the_version_sums(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before, the homes of the first two differed in their last bits, and so did the identities of their episodes."""

    (named,) = named_scenes(name)

    def numbers() -> list[bytes]:
        scene = scene_of(named.source)
        corners = [scene.assets[instance.asset].mesh.vertices for instance in scene.instances]
        return [array.tobytes() for array in (*corners, *(instance.pose for instance in scene.instances))]

    before = numbers()
    monkeypatch.setattr(builtins, "sum", compensated)
    assert numbers() == before
