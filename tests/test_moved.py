"""Names of modules and objects of earlier versions are refused with the new name."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import pytest

from h3data.moved import MOVED, RENAMED, MovedFinder, announce_moves, new_name


@pytest.mark.parametrize("old", MOVED)
def test_an_old_name_is_refused_with_a_new_one_that_exists(old: str) -> None:
    with pytest.raises(ModuleNotFoundError) as refusal:
        MovedFinder().find_spec(old)  # what an import asks last: an old checkout may still have the folder
    assert MOVED[old] in str(refusal.value)
    assert importlib.util.find_spec(MOVED[old]) is not None


def test_modules_of_a_moved_package_are_found_with_it() -> None:
    assert new_name("sim_kinematic.torch.rearrange.worlds") == "h3data_training.torch.rearrange.worlds"
    assert new_name("h3data_viewers.hitl.study.store") == "h3data_studies.store"
    assert new_name("sim_kinematic.world") is None
    assert new_name("numpy") is None


def test_imports_ask_for_moved_modules() -> None:
    announce_moves()
    with pytest.raises(ModuleNotFoundError, match=r"h3data_training\.torch"):
        importlib.import_module("sim_kinematic.torch.step")


def test_a_package_that_is_a_module_now_still_refuses_its_old_modules() -> None:
    with pytest.raises(ModuleNotFoundError, match=r"codec is sim_kinematic\.tasks\.social_nav now"):
        importlib.import_module("sim_kinematic.tasks.social_nav.codec")


@pytest.mark.parametrize("package", sorted({old.partition(".")[0] for old in MOVED}))
def test_a_program_that_imports_an_old_name_first_learns_the_new_one(package: str) -> None:
    old = next(old for old in MOVED if old.startswith(f"{package}."))
    result = subprocess.run([sys.executable, "-c", f"import {old}"], capture_output=True, text=True, check=False)
    assert f"The module {old} is {MOVED[old]} now" in result.stderr


@pytest.mark.parametrize("old", RENAMED)
def test_the_old_name_of_an_object_is_refused_with_a_new_one_that_exists(old: str) -> None:
    module, _, name = old.rpartition(".")
    found = importlib.import_module(module)
    with pytest.raises(ImportError, match=rf"{name} is {RENAMED[old]} now"):
        exec(f"from {module} import {name}")
    new_module, _, new = (RENAMED[old] if "." in RENAMED[old] else f"{module}.{RENAMED[old]}").rpartition(".")
    assert hasattr(importlib.import_module(new_module), new)
    assert not hasattr(found, "never_there")
