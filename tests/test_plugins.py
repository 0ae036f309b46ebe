"""Registries: built-in entries, installed entry points, ``module:name``, and what happens when plug-ins are broken."""

import importlib.metadata
import sys
from typing import Any

import pytest

from h3data.errors import InputError, MissingExtraError, PluginError
from h3data.plugins import PluginWarning, Registry

GROUP = "h3data.test_plugins"


def registry(**options) -> Registry:
    return Registry(GROUP, {"join": "os.path:join", "loads": "json:loads"}, what="gadget", **options)


@pytest.fixture
def install(install_package):
    """Installs a package with entry points of `GROUP` and a module of the same name."""
    return lambda package, entries, source="": install_package(package, GROUP, entries, source)


def test_built_in_entries_keep_their_order_and_are_imported_at_first_use() -> None:
    assert registry().names() == ("join", "loads")
    assert registry().get("join")("a", "b") == "a/b"
    lazy = Registry(GROUP, {"heavy": "a_module_that_does_not_exist:x"}, what="gadget")
    assert lazy.names() == ("heavy",)


def test_entry_points_of_installed_packages_are_found(install) -> None:
    install("acme", {"zeta": "acme:ZETA", "alpha": "acme:ALPHA"}, "ZETA, ALPHA = 1, 2")
    assert registry().names() == ("join", "loads", "alpha", "zeta")
    assert registry().get("zeta") == 1
    assert [entry.distribution for entry in registry().entries()] == ["", "", "acme 1.2", "acme 1.2"]


def test_installed_packages_are_read_again_only_after_a_change(install, monkeypatch: pytest.MonkeyPatch) -> None:
    one, reads = registry(), []
    real = importlib.metadata.entry_points
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda: reads.append(1) or real())
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # a new __pycache__ beside the module is a change, too
    install("acme", {"zeta": "acme:ZETA"}, "ZETA = 1")
    assert {tuple(one.load_all()) for _ in range(5)} == {("join", "loads", "zeta")}
    assert tuple(registry().names()) == ("join", "loads", "zeta")
    assert len(reads) == 1
    install("later", {"beta": "later:BETA"}, "BETA = 2")
    assert one.get("beta") == 2
    assert len(reads) == 2


def test_module_and_name_need_no_entry_point(install) -> None:
    install("loose", {}, "class Box:\n    THING = 5")
    assert registry().get("loose:Box.THING") == 5
    with pytest.raises(PluginError, match=r"(?s)'nowhere:THING'.*ModuleNotFoundError.*PYTHONPATH.*H3-FILE-015"):
        registry().get("nowhere:THING")
    with pytest.raises(PluginError, match=r"(?s)'loose:OTHER'.*AttributeError.*H3-FILE-015"):
        registry().get("loose:OTHER")


def test_unknown_names_list_what_exists(install) -> None:
    install("acme", {"zeta": "acme:ZETA"}, "ZETA = 1")
    with pytest.raises(InputError, match=r"(?s)gadget 'zetta'\. Did you mean 'zeta'\?.*H3-FILE-011"):
        registry().get("zetta")


def test_a_broken_plug_in_is_named_and_the_others_go_on_working(install) -> None:
    install("broken", {"bad": "broken:THING"}, "1 / 0")
    install("acme", {"zeta": "acme:ZETA"}, "ZETA = 1")
    named = r"gadget 'bad' \(entry point broken:THING of the group h3data.test_plugins, installed by broken 1.2\)"
    with pytest.raises(PluginError, match=f"(?s){named} cannot be imported: ZeroDivisionError.*H3-FILE-015"):
        registry().get("bad")
    with pytest.warns(PluginWarning, match=named):
        loaded = registry().load_all()
    assert list(loaded) == ["join", "loads", "zeta"]


def test_what_a_plug_in_says_of_its_own_errors_is_kept(install) -> None:
    source = "from h3data.errors import MissingExtraError\nraise MissingExtraError('Hint: pip install acme[all]')"
    install("acme", {"zeta": "acme:ZETA"}, source)
    with pytest.raises(MissingExtraError, match=r"^Hint: pip install"):
        registry().get("zeta")


def test_a_plug_in_without_a_required_field_is_named(install) -> None:
    def check(thing) -> None:
        if not hasattr(thing, "sample"):
            raise InputError("the field 'sample' is missing.")

    install("acme", {"zeta": "acme:ZETA"}, "ZETA = 1")
    with pytest.raises(PluginError, match=r"(?s)installed by acme 1\.2\).*field 'sample'.*missing.*H3-FILE-016"):
        registry(check=check).get("zeta")


def test_a_name_that_two_packages_claim_goes_to_neither(install) -> None:
    install("acme", {"zeta": "acme:ZETA"}, "ZETA = 1")
    install("rival", {"zeta": "rival:ZETA"}, "ZETA = 2")
    with pytest.raises(PluginError, match=r"(?s)'zeta'.*\w+:ZETA of \w+ 1\.2 .*\w+:ZETA of \w+ 1\.2 .*H3-FILE-013"):
        registry().get("zeta")
    with pytest.warns(PluginWarning, match="claimed by"):
        assert registry().names() == ("join", "loads")
    assert registry().get("join")
    assert registry().get("rival:ZETA") == 2


def test_a_built_in_name_cannot_be_taken_over(install) -> None:
    install("acme", {"join": "acme:ZETA", "loads": "json:loads"}, "ZETA = 1")
    assert registry().get("join")("a", "b") == "a/b"
    with pytest.warns(PluginWarning, match=r"'join' is built in; acme:ZETA of acme 1.2 cannot replace it") as caught:
        assert registry().names() == ("join", "loads")
    assert len(caught) == 1, "an entry point that names the same object as the table is no conflict"


def test_a_package_of_ours_takes_the_place_that_the_table_keeps_for_its_entry() -> None:
    kept = Registry[Any]("h3data.profiles", {"first": 1, "habitat": "", "nobody": "", "last": 2}, what="profile")
    assert kept.names()[:3] == ("first", "habitat", "last")
    assert kept.get("habitat").name == "habitat"
    assert kept.get("last") == 2
    with pytest.raises(InputError, match=r"(?s)profile 'nobody'.*H3-FILE-011"):
        kept.get("nobody")
