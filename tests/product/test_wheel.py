"""The built wheel is complete: its packages and data work outside the repository."""

import hashlib
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from h3data.kernels import shipped
from tests.paths import ROOT

OPENS = """
from h3data.bodies import load_humanoid, load_robot
from h3data.scene.open import named_scenes
from h3data_viewers.html_report import report
from sim_kinematic.tasks.registry import find_task
assert load_robot('quad_arm').joint_names and load_humanoid('female_0').capsules and find_task('rearrange')
assert len(named_scenes('h3-homes/test')) > 1
raise SystemExit(cli.main(['scenes', 'list']))
"""
"""Reads the data of the wheel without compiling a kernel: at a new place none is cached, and a simulated step takes 20 s."""
GENERATES = """
raise SystemExit(cli.main(['generate', 'social_nav', '--scenes', 'h3-homes/test', '--episodes', '1', '--max-steps', '10',
                           '-o', 'ds']))
"""


@pytest.mark.parametrize(
    ("script", "says"),
    [(OPENS, "h3-homes/test"), pytest.param(GENERATES, "1 episode of h3-homes/test", marks=pytest.mark.slow)],
    ids=["opens", "generates"],
)
def test_the_wheel_works_outside_the_repository(script: str, says: str, tmp_path: Path) -> None:
    build = [sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", str(tmp_path / "dist"), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = (tmp_path / "dist").glob("h3data-*.whl")
    assert wheel.stat().st_size < 13_000_000  # 7.0 MB of it are trained policies, 0.2 MB the pages of the documentation
    site = tmp_path / "site"
    if script is GENERATES:  # as pip leaves both wheels
        subprocess.run([*build[:-1], str(ROOT / "pipelines" / shipped.PACKAGE)], check=True, capture_output=True)
        (kernels,) = (tmp_path / "dist").glob("h3data_kernels-*.whl")
        assert kernels.stat().st_size < 5_000_000
        with zipfile.ZipFile(kernels) as archive:
            assert {name.partition("/")[0].partition("-")[0] for name in archive.namelist()} == {shipped.PACKAGE}
            assert not any(name.endswith(("build.py", ".toml")) for name in archive.namelist())
            archive.extractall(site)
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(site)
    top = {name.partition("/")[0] for name in names}
    assert {n for n in top if not n.endswith(".dist-info")} == {
        "h3data",
        "sim_kinematic",
        "h3data_habitat",
        "h3data_exporters",
        "h3data_gpu",
        "h3data_homes",
        "h3data_light",
        "h3data_meshes",
        "h3data_motion",
        "h3data_worlds",
        "h3data_pipelines",
        "h3data_training",
        "h3data_rays",
        "h3data_remote",
        "h3data_crowds",
        "h3data_language",
        "h3data_llm",
        "h3data_ros",
        "h3data_social",
        "h3data_viewers",
        "h3data_play",
        "h3data_studies",
    }
    assert "h3data/_datasets/bodies/female_0.npz" in names
    assert {f"h3data/_datasets/h3-homes/{f}" for f in ("train.toml", "val.toml", "test.toml", "README.md")} <= set(
        names
    )
    assert "h3data/metrics/paper/published.toml" in names
    assert {f"h3data_remote/adapters/{name}.toml" for name in ("h3data", "openpi", "gr00t")} <= set(names)
    templates = {
        str(path.relative_to(top))
        for top, package in (("viewers", "h3data_viewers"), ("pipelines", "h3data_pipelines"))
        for top in (ROOT / top,)
        for path in (top / package).rglob("*")
        if path.suffix in (".html", ".css", ".js")
    }
    assert {"h3data_viewers/notebook.html", "h3data_pipelines/benchmark/leaderboard.html"} < templates <= set(names)
    pages = {
        str(p.relative_to(ROOT / "docs"))
        for pattern in ("*.md", "tutorials/*.md")
        for p in (ROOT / "docs").glob(pattern)
    }
    pages -= {"index.md", "changes.md", "gallery.md"}
    assert {name.partition("/_docs/")[2] for name in names if "/_docs/" in name} == pages
    page = {name.rpartition("h3data_play/web/")[2] for name in names if "h3data_play/web/" in name}
    assert "dist/index.html" in page
    assert all(name.startswith("dist/") for name in page), page
    assert not any(name.endswith((".pyc", ".nbi", ".nbc")) for name in names)
    script = (
        "import h3data, h3data.builtin, h3data_pipelines.cli as cli\n"
        f"assert h3data.__file__.startswith({str(site)!r}), h3data.__file__\n"
        f"assert h3data.builtin.builtin_root().name == '_datasets'\n{script}"
    )
    environment = {**os.environ, "PYTHONPATH": str(site), "NUMBA_CACHE_DIR": str(tmp_path / "numba")}
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert says in done.stdout
    if shipped.folders():
        assert not list((tmp_path / "numba").rglob("*.nbc")), "nothing is compiled"


@pytest.mark.slow
def test_wheel_and_sdist_are_the_same_bytes_again(tmp_path: Path) -> None:
    digests = []
    for zone, mask in (("UTC", 0o022), ("Asia/Tokyo", 0o077)):
        out = tmp_path / zone.replace("/", "_")
        subprocess.run(
            [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(ROOT)],
            check=True,
            capture_output=True,
            umask=mask,
            env={**os.environ, "SOURCE_DATE_EPOCH": "1700000000", "TZ": zone},
        )
        digests.append({path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in out.iterdir()})
    assert len(digests[0]) == 2
    assert digests[0] == digests[1]
