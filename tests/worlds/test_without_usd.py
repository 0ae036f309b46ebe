"""Without usd-core, USD files are refused by the name of the extra."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

import h3data
from h3data.errors import MissingExtraError
from h3data_pipelines.cli import main


def test_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("pxr", "pxr.Usd", "pxr.UsdGeom", "pxr.UsdUtils", "pxr.Tf"):
        monkeypatch.setitem(sys.modules, name, None)
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    with pytest.raises(MissingExtraError) as refused:
        h3data.load_scene(tmp_path / "a.usda")
    assert refused.value.code == "H3-WORLD-009"
    assert main(["scenes", "export", "small:3", "--to", "usd", "-o", str(tmp_path / "b.usdz")]) == 2
    assert "H3-WORLD-009" in capsys.readouterr().err
    assert not (tmp_path / "b.usdz").exists()
