"""Fixtures that several test files share."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path

import pytest

from h3data.pseudonyms import KEY_VARIABLE
from tests.paths import REAL

try:
    from hypothesis import HealthCheck, settings
except ImportError:  # a machine with a GPU and little else: `pytest -m gpu`
    collect_ignore = [str(path) for path in Path(__file__).parent.rglob("test_*.py") if path.name != "test_gpu.py"]
else:
    for profile, count in (("quick", 10), ("full", 30)):  # `make test-all` looks at more examples of each law
        settings.register_profile(
            profile,
            derandomize=True,
            deadline=None,
            max_examples=count,
            suppress_health_check=[HealthCheck.too_slow],
        )
    settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "quick"))


@pytest.fixture(scope="session")
def real() -> Path:
    """Folder of real Habitat files, which are not part of the repository."""
    if not REAL.is_dir():
        pytest.skip("needs the real Habitat files in ../shared/real, which are not part of the repository")
    return REAL


@pytest.fixture(autouse=True, scope="session")
def homes_are_built_once() -> Iterator[None]:
    """Equal specs give the same home in a process, as they do within a command; most tests are about what happens in it.

    Each takes half a second, and 60 files want ``HomeSpec(preset="small", seed=1)``. In `tests/homes`, which are
    about building, every home is a new one.
    """
    from h3data_homes import build

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "build_home", lru_cache(maxsize=64)(build.build_home))
        yield


@pytest.fixture
def one_torch_thread() -> Iterator[None]:
    """Torch on one thread: the tests beside this one have the other cores."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def install_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Installs a package with entry points and a module of the same name, as pip would leave it on sys.path."""
    folder = tmp_path / "site-packages"
    folder.mkdir()
    monkeypatch.syspath_prepend(folder)

    def install(package: str, group: str, entries: Mapping[str, str], source: str = "") -> None:
        info = folder / f"{package}-1.2.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.2\n")
        lines = [f"{name} = {value}" for name, value in entries.items()]
        (info / "entry_points.txt").write_text("\n".join([f"[{group}]", *lines]))
        (folder / f"{package}.py").write_text(source)

    before = set(sys.modules)
    yield install
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(str(folder)):
            del sys.modules[name]


@pytest.fixture(autouse=True, scope="session")
def participant_key_of_the_tests(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """User ids are hashed with a key of the tests, never with that of whoever runs them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(KEY_VARIABLE, str(tmp_path_factory.mktemp("keys") / "participants.key"))
        yield


@pytest.fixture(autouse=True, scope="session")
def _interrupts_arrive() -> None:
    """A shell starts what it puts in the background deaf to Ctrl-C, and so would be the commands that tests start."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True, scope="session")
def _no_user_assets() -> None:
    os.environ.pop("H3DATA_ASSETS", None)
