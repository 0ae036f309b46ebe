"""`h3data cache` finds what is kept and deletes nothing else; `h3data doctor` shows it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from h3data_pipelines.cli import main
from h3data_pipelines.machine import caches, doctor
from h3data_pipelines.machine.caches import KINDS


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Caches with a file each, and a file of somebody else in each folder."""
    monkeypatch.setenv("H3DATA_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(
        "h3data_pipelines.machine.caches.kept_files", lambda: sorted((tmp_path / "numba").rglob("*.nb?"))
    )
    for name, (_, endings) in KINDS.items():
        folder = tmp_path / ("numba/a_1/x" if name == "kernels" else f"cache/{name}")
        folder.mkdir(parents=True)
        (folder / f"one{endings[0]}").write_bytes(bytes(1000))
        (folder / f"two{endings[1]}").write_bytes(bytes(500))
        (folder / "thesis.txt").write_text("mine")
    return tmp_path


def run(capsys: pytest.CaptureFixture[str], *words: str) -> dict:
    assert main([*words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_caches_are_listed_and_cleared(kept: Path, capsys: pytest.CaptureFixture[str]) -> None:
    listed = run(capsys, "cache", "list")
    assert list(listed) == list(KINDS)
    assert {row["bytes"] for row in listed.values()} == {1500}
    assert listed["light"]["folder"] == str(kept / "cache" / "light")
    assert run(capsys, "cache", "clear", "light", "kernels")["bytes"] == {"kernels": 1500, "light": 1500}
    left = {name: row["bytes"] for name, row in run(capsys, "cache", "list").items()}
    assert left == {name: 0 if name in ("light", "kernels") else 1500 for name in KINDS}
    run(capsys, "cache", "clear")
    assert {path.name for path in kept.rglob("*") if path.is_file()} == {"thesis.txt"}


def test_an_unknown_cache_is_refused(kept: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["cache", "clear", "lihgt"]) == 2
    assert "Unknown cache 'lihgt'. Did you mean 'light'?" in capsys.readouterr().err
    assert len([path for path in kept.rglob("*") if path.is_file()]) == 3 * len(KINDS)


def test_without_a_cache_there_is_nothing_to_clear(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("H3DATA_CACHE", "off")
    monkeypatch.setattr("h3data_pipelines.machine.caches.kept_files", list)
    assert {row["folder"] for row in run(capsys, "cache", "list").values()} == {None}
    assert sum(run(capsys, "cache", "clear")["bytes"].values()) == 0


def test_the_doctor_shows_caches_codecs_browsers_and_disks(
    kept: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    browser = kept / "firefox"
    browser.write_text("#!/bin/sh\necho warning\necho Mozilla Firefox 140.0\n")
    browser.chmod(0o755)
    monkeypatch.setattr(doctor, "_BROWSERS", ("firefox",))
    monkeypatch.setenv("PATH", str(kept))
    monkeypatch.setattr(doctor, "_cpu_renderer", lambda: "depth exact")
    found = run(capsys, "doctor")
    assert found["checks"]["browser (h3data play)"] == {"ok": True, "detail": "Mozilla Firefox 140.0"}
    assert "libx264" in found["checks"]["video (PyAV, FFmpeg)"]["detail"]
    assert "libavcodec " in found["checks"]["video (PyAV, FFmpeg)"]["detail"]
    assert found["caches"]["freespace"]["bytes"] == 1500
    assert found["free_bytes"][str(kept / "cache")] == pytest.approx(shutil.disk_usage(kept).free, rel=0.1)
    browser.unlink()
    assert main(["doctor"]) == 0, "a browser is not needed"
    text = capsys.readouterr().out
    assert "no  browser (h3data play)" in text
    assert "h3data cache clear" in text
    assert str(kept / "cache" / "light") in text


def test_the_doctor_says_which_torch_saves_gigabytes(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    with pytest.raises(RuntimeError, match=r"gigabytes of CUDA.*pip install .*/cpu"):
        doctor._gpu()
    monkeypatch.setattr(torch.version, "cuda", None)
    with pytest.raises(RuntimeError, match=r"no CUDA device \(not needed\)$"):
        doctor._gpu()


def test_kept_kernels_are_those_of_our_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from numba.core import config

    import h3data.bodies
    from h3data.kernels import kernel

    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))

    def ours(x):
        return x + 1

    ours.__code__ = ours.__code__.replace(co_filename=str(Path(h3data.bodies.__file__)))
    kernel()(ours)(1)
    (tmp_path / "other_0123").mkdir()
    (tmp_path / "other_0123" / "theirs.py311.nbi").touch()
    names = {path.suffix for path in caches.kept_files() if tmp_path in path.parents}
    assert names == {".nbi", ".nbc", ".lock"}
    assert not any(path.name == "theirs.py311.nbi" for path in caches.kept_files())
    assert caches.find_caches()[0].name == "kernels"
