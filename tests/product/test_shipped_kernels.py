"""With the shipped kernels a clean copy compiles nothing, and makes the same bytes as without them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from h3data.kernels import shipped
from tests.paths import ROOT

*_, BASE = shipped.LEVELS
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not (ROOT / "pipelines" / shipped.PACKAGE / shipped.folder_name(BASE)).is_dir(),
        reason=f"no kernels are shipped for {shipped.folder_name(BASE)}",
    ),
]
CLI = ("-m", "h3data_pipelines.cli")
ENVIRONMENT = """
import h3data
from h3data.kernels import compiled_count
for options in ({"num_envs": 1}, {"num_envs": 4}, {"agents": ("robot", "human")}):
    env = h3data.make("social_nav", **options)
    env.reset(seed=1)
for level in ("high", "low"):
    env = h3data.make("rearrange", scenes="small", level=level)
    env.reset(seed=1)
    env.step(env.action_space.sample())
print(compiled_count())
"""


class CleanCopy:
    """What a fresh clone holds, in another place, with empty caches."""

    def __init__(self, folder: Path) -> None:
        self.root, self.numba = folder / "h3data", folder / "numba"
        listed = subprocess.run(
            ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True, check=True
        )
        for name in listed.stdout.splitlines():
            if (ROOT / name).is_file():
                (self.root / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(ROOT / name, self.root / name)
        self.environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
        self.environment |= {
            "PYTHONPATH": os.pathsep.join(map(str, (self.root, self.root / "pipelines", self.root / "viewers"))),
            "NUMBA_CACHE_DIR": str(self.numba),
            "H3DATA_CACHE": str(folder / "cache"),
        }

    def python(self, *arguments: str, **settings: str) -> str:
        command, environment = [sys.executable, *arguments], self.environment | settings
        done = subprocess.run(command, cwd=self.root, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def compiled(self) -> list[str]:
        """Kernels that any process has compiled: numba keeps each of them."""
        return sorted(path.name for path in self.numba.rglob("*.nbc"))


@pytest.fixture
def clean(tmp_path: Path) -> CleanCopy:
    return CleanCopy(tmp_path)


def test_the_demo_compiles_nothing(clean: CleanCopy) -> None:
    clean.python(*CLI, "demo", "-o", str(clean.root / "out" / "demo"))
    assert clean.compiled() == []


def test_commands_of_the_readme_compile_nothing(clean: CleanCopy) -> None:
    clean.python(
        "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "slow", "tests/product/test_docs_run.py", "-k", "README"
    )
    assert clean.compiled() == []


def test_environments_compile_nothing(clean: CleanCopy) -> None:
    assert clean.python("-c", ENVIRONMENT).strip() == "0"
    assert clean.compiled() == []


def test_results_are_the_same_bytes_without(clean: CleanCopy) -> None:
    made: list[dict[str, bytes]] = []
    # the best level of this processor, the lowest one, and kernels compiled here
    for settings in ({}, {"NUMBA_CPU_NAME": BASE, "NUMBA_CPU_FEATURES": ""}, {"NUMBA_CPU_NAME": "host"}):
        out = clean.root / "out"
        shutil.rmtree(out, ignore_errors=True)
        clean.python(*CLI, "demo", "--steps", "45", "-o", str(out / "demo"), **settings)
        clean.python(
            *CLI, "generate", "social_nav", "--episodes", "2", "--seed", "4", "-o", str(out / "ds"), **settings
        )
        clean.python(*CLI, "generate", "rearrange", "--episodes", "1", "-o", str(out / "tidy"), **settings)
        files = [path for path in out.rglob("*") if path.suffix in (".mcap", ".mp4", ".parquet")]
        made.append({str(path.relative_to(out)): path.read_bytes() for path in files})
        assert bool(clean.compiled()) == ("host" in settings.values())
    assert len(made[0]) >= 7
    for other in made[1:]:
        assert made[0].keys() == other.keys()
        assert [name for name, content in made[0].items() if content != other[name]] == []
