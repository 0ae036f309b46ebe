"""The people that come with the package, as parameters of tests."""

from __future__ import annotations

from typing import Any

import pytest

from h3data.bodies import humanoid_names

QUICK = ("female_0", "male_1", "child_0", "older_0")
"""In the quick run, one of each kind; all of them are in the full one."""
EVERYBODY: list[Any] = [
    name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in humanoid_names()
]
