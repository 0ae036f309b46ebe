"""`make setup` says what it does, installs no more than users need, and no CUDA by surprise."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from h3data.kernels import shipped
from tests.paths import ROOT

PYTHON = """#!{python}
import os, sys
words = sys.argv[1:]
with open({log!r}, "a") as log:
    log.write(" ".join(words) + "\\n")
if words[0] == "-c":
    raise SystemExit(os.environ["HAS_TORCH"] == "no")
if words[:3] == ["-m", "pip", "index"]:
    print("Available versions:", os.environ["VERSIONS"])
if "--index-url" in words and os.environ.get("OFFLINE") or os.environ.get("FAILS") in words:
    raise SystemExit(1)
"""
"""Stands in for the Python of the environment: writes down how it is called."""


@pytest.fixture
def venv(tmp_path: Path) -> Path:
    if shutil.which("make") is None:
        pytest.skip("needs make")
    stand_in = tmp_path / "venv" / "bin" / "python"
    stand_in.parent.mkdir(parents=True)
    stand_in.write_text(PYTHON.format(python=sys.executable, log=str(tmp_path / "log")))
    stand_in.chmod(0o755)
    return tmp_path / "venv"


def make(
    venv: Path, target: str, *, versions: str, gpu: str = "", has_torch: str = "no", **more: str
) -> tuple[str, list[str]]:
    """What `make` prints, and the calls of pip that install something."""
    environment = {"PATH": "/usr/bin:/bin", "VERSIONS": versions, "HAS_TORCH": has_torch, **more}
    command = ["make", target, f"VENV={venv}", f"GPU={gpu}", "SLEEP=true"]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lines = (venv.parent / "log").read_text().splitlines()
    return done.stdout, [line for line in lines if line.startswith("-m pip install")]


TORCH = next(line for line in (ROOT / "constraints.txt").read_text().splitlines() if line.startswith("torch=="))
PYPI = TORCH.removeprefix("torch==")


def test_setup_installs_what_users_need_and_says_so_first(venv: Path) -> None:
    said, installed = make(venv, "setup", versions=f"{PYPI}+cpu, {PYPI}")
    assert said.startswith("Installing h3data into")
    assert "minutes" in said.splitlines()[0]
    call = installed[-1]
    assert call.endswith("-e .")
    assert "--no-deps" not in call
    assert "quiet" not in call
    assert "-q" not in call.split()


def test_two_processes_unpack_the_largest_packages(venv: Path) -> None:
    """A pip keeps one core busy, for three quarters of the time that the installation takes."""
    _, installed = make(venv, "setup", versions=f"{PYPI}+cpu, {PYPI}")
    *large, last = installed
    assert len(large) == 2
    assert all("--no-deps" in call.split() and "-c constraints.txt" in call for call in large)
    assert last.endswith("-e .")
    one, other = (set(call.rpartition("--progress-bar off ")[2].split()) for call in large)
    assert not one & other, "two processes would write the same files"
    assert {"torch", "rerun-sdk", "pyarrow", "scipy", "llvmlite"} <= one | other


def test_what_they_cannot_install_is_left_to_the_last_one(venv: Path) -> None:
    _, installed = make(venv, "setup", versions=f"{PYPI}+cpu, {PYPI}", FAILS="--no-deps")
    assert installed[-1].endswith("-e .")


def editable(installed: list[str]) -> list[str]:
    """What is installed from this checkout."""
    return [call.rpartition(" ")[2] for call in installed if " -e " in call]


def test_tests_add_the_rest(venv: Path) -> None:
    said, installed = make(venv, "dev", versions=f"{PYPI}+cpu")
    assert editable(installed) == [".", ".[dev]"]
    assert "what tests and checks need" in said


def test_no_bytecode_is_compiled_ahead(venv: Path) -> None:
    """Of 9,000 modules that come, the demo imports 1,300."""
    _, installed = make(venv, "dev", versions=PYPI)
    assert len(installed) == 5
    assert all("--no-compile" in call.split() for call in installed)


def test_without_a_gpu_torch_comes_without_cuda(venv: Path) -> None:
    said, installed = make(venv, "setup", versions=f"2.14.0+cpu, {PYPI}")
    assert "No NVIDIA GPU here" in said
    assert f"install --disable-pip-version-check --no-compile {TORCH} --index-url" in installed[0]
    assert installed[0].endswith("/cpu")


def test_where_that_cannot_be_had_cuda_is_announced_before_it_comes(venv: Path) -> None:
    said, installed = make(venv, "setup", versions=PYPI, OFFLINE="1")
    assert "pip installs torch with CUDA, 3 GB; Ctrl-C stops it" in said
    assert editable(installed) == ["."]


@pytest.mark.parametrize("known", [{"gpu": "/dev/nvidiactl"}, {"has_torch": "yes"}])
def test_with_a_gpu_or_with_torch_pip_decides(venv: Path, known: dict[str, str]) -> None:
    said, installed = make(venv, "setup", versions=PYPI, **known)
    assert "GPU" not in said
    assert not [call for call in installed if "--index-url" in call]


def test_every_package_that_make_dev_and_make_docs_install_is_pinned() -> None:
    """Other versions of the tools would find other faults, and other versions of the rest compute other numbers."""

    def plain(name: str) -> str:
        return re.sub(r"[-_.]+", "-", name).lower()

    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {plain(line.partition("==")[0]) for line in lines if "==" in line}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    wanted = {
        plain(re.split(r"[^\w.-]", one)[0]) for one in (*project["dependencies"], *extras["dev"], *extras["docs"])
    }
    assert not wanted - pinned
    assert not [line for line in lines if "://" in line or line.startswith("-")], "no index is named"


def test_compiled_kernels_are_an_extra_and_no_dependency() -> None:
    """A dependency on what is on no index makes ``pip install .`` fail where the kernels are for: docs/rendering.md."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    kernels = tomllib.loads((ROOT / "pipelines" / "h3data_kernels" / "pyproject.toml").read_text(encoding="utf-8"))[
        "project"
    ]
    assert not [one for one in project["dependencies"] if "kernels" in one]
    named = [extra for extra, packages in project["optional-dependencies"].items() if "h3data-kernels" in str(packages)]
    assert named == ["kernels"], "neither setup nor dev fetches it"
    (extra,) = map(Requirement, project["optional-dependencies"]["kernels"])
    assert str(extra.specifier) == f"=={kernels['version']}" == f"=={project['version']}"
    assert extra.marker is not None
    there = {"sys_platform": "linux", "platform_machine": "x86_64", "python_version": "3.11"}
    assert extra.marker.evaluate(there)
    for other in ({"sys_platform": "darwin"}, {"platform_machine": "aarch64"}, {"python_version": "3.13"}):
        assert not extra.marker.evaluate({**there, **other}), "files are for one system, processor and Python"
    pinned = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    assert set(kernels["dependencies"]) <= set(pinned), "the numba of make setup"
    folders = {path.name for path in (ROOT / "pipelines" / "h3data_kernels").glob("cpython-*")}
    numba = str(Requirement(kernels["dependencies"][0]).specifier).replace("==", "")
    made = [f"cpython-311-numba{numba}-linux-{level}" for level in shipped.LEVELS]
    assert made[-1] in folders
    assert folders <= set(made)
