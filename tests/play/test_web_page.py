"""The committed page of `h3data play`: what a browser loads, and from where."""

from __future__ import annotations

import gzip
import json
import re
from pathlib import Path

from tests.paths import ROOT

WEB = ROOT / "viewers" / "h3data_play" / "web"
DIST = WEB / "dist"
SCRIPT_KB = 250


def scripts() -> list[Path]:
    return sorted((DIST / "assets").glob("*.js"))


def test_the_page_is_complete_and_loads_only_its_own_files() -> None:
    html = (DIST / "index.html").read_text(encoding="utf-8")
    paths = re.findall(r'(?:src|href)="([^"]+)"', html)
    assert paths
    assert all(path.startswith("./") and (DIST / path).is_file() for path in paths), paths


def test_a_strict_content_security_policy_suits_the_page() -> None:
    html = (DIST / "index.html").read_text(encoding="utf-8")
    assert "<style" not in html
    assert " style=" not in html
    assert not re.search(r"<script(?![^>]*\bsrc=)", html)
    assert not re.search(r"\son\w+=", html)


def test_the_script_is_small_enough_to_load_in_a_moment() -> None:
    size = sum(len(gzip.compress(path.read_bytes(), 9)) for path in scripts())
    assert 100_000 < size <= SCRIPT_KB * 1000


def test_the_emulated_headset_of_the_tests_is_not_shipped() -> None:
    assert not any("metaQuest" in path.read_text(encoding="utf-8") for path in scripts())


def test_the_licence_of_what_the_page_contains_is_with_it() -> None:
    assert "three.js authors" in (DIST / "licenses.txt").read_text(encoding="utf-8")


def test_the_lock_file_names_no_registry() -> None:
    packages = json.loads((WEB / "package-lock.json").read_text(encoding="utf-8"))["packages"]
    assert packages["node_modules/three"]["version"] == "0.187.0"
    assert [name for name, package in packages.items() if "resolved" in package] == []
    assert all("integrity" in package for name, package in packages.items() if name)
