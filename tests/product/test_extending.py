"""docs/extending.md runs as written: its files, its entry points, its commands and its programs."""

import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from h3data.plugins import TRUST_VARIABLE
from h3data_pipelines.cli import main
from tests.bodies.robots.cart_robot import cart_urdf
from tests.paths import DOCS

BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
FILE = re.compile(r"# (\S+\.py)\n")
GROUP = re.compile(r'\[project\.entry-points\."(\S+)"\]')


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The working directory, which has the package acme after ``pip install -e .``, with the entry points of the page."""
    page = (DOCS / "extending.md").read_text(encoding="utf-8")
    (entries,) = (text for kind, text in BLOCK.findall(page) if kind == "toml")
    site = tmp_path / "site-packages"
    info = site / "acme-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "direct_url.json").write_text('{"url": "file:///acme", "dir_info": {"editable": true}}')
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(GROUP.sub(r"[\1]", entries).replace('"', ""))
    (tmp_path / "acme").mkdir()
    (tmp_path / "cart_arm").mkdir()
    (tmp_path / "cart_arm" / "cart_arm.urdf").write_text(cart_urdf())
    (tmp_path / "walk.track").write_text("TRACK\n" + "".join(f"{0.1 * k} 0 0\n" for k in range(20)))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.syspath_prepend(site)
    monkeypatch.setenv(TRUST_VARIABLE, "")
    before = set(sys.modules)
    yield tmp_path
    for name in {name for name in set(sys.modules) - before if name.partition(".")[0] == "acme"}:
        del sys.modules[name]


@pytest.mark.slow
def test_the_page_runs_as_written(package: Path, capsys: pytest.CaptureFixture[str]) -> None:
    blocks, ran = BLOCK.findall((DOCS / "extending.md").read_text(encoding="utf-8")), 0
    for kind, text in blocks:
        if kind == "python" and (name := FILE.match(text)):
            (package / name[1]).write_text(text)
    for kind, text in blocks:
        if kind == "python" and not FILE.match(text):
            exec(compile(text, "extending.md", "exec"), {})
            ran += 1
        elif kind == "console":
            for line in text.splitlines():
                capsys.readouterr()
                assert main(shlex.split(line)[1:]) == 0, f"{line}\n{capsys.readouterr().err}"
                ran += 1
    assert ran >= 12
