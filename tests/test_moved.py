"""Names of modules of earlier versions are refused with the new name."""

from __future__ import annotations

import importlib.util

import pytest

from h3data.moved import MOVED, new_name


@pytest.mark.parametrize("old", MOVED)
def test_an_old_name_is_refused_with_a_new_one_that_exists(old: str) -> None:
    with pytest.raises(ModuleNotFoundError) as refusal:
        importlib.import_module(old)
    assert MOVED[old] in str(refusal.value)
    assert importlib.util.find_spec(MOVED[old]) is not None


def test_modules_of_a_moved_package_are_found_with_it() -> None:
    assert new_name("sim_kinematic.torch.rearrange.worlds") == "h3data_training.torch.rearrange.worlds"
    assert new_name("h3data_viewers.hitl.study.store") == "h3data_studies.store"
    assert new_name("sim_kinematic.world") is None
    assert new_name("numpy") is None
