"""Homes are built anew in these tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from h3data_homes import build


@pytest.fixture(autouse=True, scope="package")
def homes_are_built_anew(homes_are_built_once: None) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "build_home", vars(build.build_home)["__wrapped__"])
        yield
