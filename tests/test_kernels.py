"""Compiled kernels are compiled anew when anything that went into them changes; for a new numba, see tests/test_numba.py."""

from __future__ import annotations

import ast
import collections
import gc
import importlib
import lzma
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numba
import numba.extending
import numpy as np
import pytest
from numba import types
from numba.core.errors import NumbaError
from numba.core.runtime import _nrt_python  # type: ignore[attr-defined]
from numba.core.runtime.nrt import rtsys

from h3data import kernels
from h3data.kernels import decorators, digests, shipped
from h3data.kernels.entries import Entries
from h3data.scene.freespace._sdf import sample_sdf_many
from tests.paths import ROOT

KERNEL = """
from h3data.kernels import kernel
from stale_part import SIZE, double

@kernel()
def scaled(x):
    return double(x) * SIZE
"""
PART = """
from numba import njit
from stale_constants import SIZE

@njit(nogil=True)
def double(x):
    return {factor} * x
"""
SCRIPT = """
from h3data.kernels import digests
digests.OURS = ("h3data", "stale_kernel", "stale_part", "stale_constants")
import stale_kernel
print(stale_kernel.scaled(1.0), sum(stale_kernel.scaled.stats.cache_hits.values()))
"""


def _run(folder: Path, *, factor: int, size: int, script: str = SCRIPT) -> str:
    for name, text in (("kernel", KERNEL), ("part", PART.format(factor=factor)), ("constants", f"SIZE = {size}\n")):
        path = folder / f"stale_{name}.py"
        path.write_text(text)
        os.utime(path, (1_700_000_000, 1_700_000_000))  # the worst case: size and time do not tell
    environment = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}", "PYTHONDONTWRITEBYTECODE": "1"}
    environment.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    return done.stdout.strip()


@pytest.mark.slow
def test_a_kernel_follows_changes_in_the_files_it_imports(tmp_path: Path):
    assert _run(tmp_path, factor=2, size=3) == "6.0 0"
    assert _run(tmp_path, factor=2, size=3) == "6.0 1"  # from the cache
    assert _run(tmp_path, factor=5, size=3) == "15.0 0"  # a function that it calls
    assert _run(tmp_path, factor=5, size=4) == "20.0 0"  # a constant that it takes from a file further down


@pytest.mark.slow
def test_compiling_is_announced_once(tmp_path: Path):
    script = "import logging, sys\nlogging.basicConfig(level='INFO', format='%(message)s', stream=sys.stdout)" + SCRIPT
    announced, result = _run(tmp_path, factor=2, size=3, script=script).splitlines()
    assert announced.startswith("Compiling kernels, once per machine")
    assert result == "6.0 0"
    assert _run(tmp_path, factor=2, size=3, script=script) == "6.0 1"  # nothing was compiled, nothing is said


def test_the_renderer_stamps_cover_the_intrinsics():
    for module, inside in {
        "h3data.render.raster.raster": {"h3data.render.raster.raster_simd", "h3data.kernels.vectors"},
        "h3data.render.shade.shading": {
            "h3data.render.shade.occlusion_simd",
            "h3data.kernels.vectors",
            "h3data.render.raster.raster",
        },
        "sim_kinematic.motion.step": {"h3data.scene.freespace._sdf", "sim_kinematic.motion.spec"},
    }.items():
        __import__(module)
        seen, waiting = set(), {module}
        while waiting:
            name = waiting.pop()
            seen.add(name)
            waiting |= set(digests._source(name)[1]) - seen
        assert inside <= seen


def test_nothing_is_cached_past_the_decorator():
    for path in [*(ROOT / "h3data").rglob("*.py"), *(ROOT / "sim_kinematic").rglob("*.py")]:
        if path == ROOT / "h3data" / "kernels" / "decorators.py":
            continue
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if "cache" in text else ():
            cached = (
                isinstance(node, ast.keyword) and node.arg == "cache" and getattr(node.value, "value", None) is True
            )
            assert not cached, f"{path}:{node.value.lineno}: use h3data.kernels.kernel"  # type: ignore[attr-defined]


def test_kernels_work_where_no_cache_can_be_written(monkeypatch):
    def njit(*, cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function 'f': no locator available")
        return numba.njit(**options)

    monkeypatch.setattr(decorators, "njit", njit)
    decorators._warn_once.cache_clear()
    double, triple = kernels.kernel()(lambda x: 2 * x), kernels.kernel()(lambda x: 3 * x)
    with pytest.warns(RuntimeWarning, match="NUMBA_CACHE_DIR"):
        assert double(2) == 4
    assert triple(3) == 9, "and it says so only once"


def test_a_part_of_a_kernel_refuses_to_be_called_from_python():
    @kernels.kernel_part()
    def part(x):
        return x + 1

    @kernels.kernel()
    def whole(x):
        return part(x) + 1

    assert whole(1) == 3
    with pytest.raises(TypeError, match="part is part of a kernel and has no entry point for Python"):
        part(1)


def test_a_part_has_no_machine_code_and_is_compiled_once_for_all_constants():
    @kernels.kernel_part()
    def scaled_part(x, factor):
        if factor < 0:
            raise ValueError("a negative factor")
        return np.full(3, x * factor)

    @kernels.kernel_part()
    def sum_part(x, factor):
        return scaled_part(x, factor).sum() + scaled_part(x, 2)[0]

    @kernels.kernel()
    def summed(x, factor):
        return sum_part(x, factor) + scaled_part(x, 3)[0]

    _nrt_python.memsys_enable_stats()
    before = rtsys.get_allocation_stats()
    assert summed(2.0, 5) == 30 + 4 + 6
    with pytest.raises(ValueError, match="a negative factor"):
        summed(2.0, -1)
    after = rtsys.get_allocation_stats()
    _nrt_python.memsys_disable_stats()
    assert after.alloc - before.alloc == after.free - before.free > 0, "what a part allocates is freed"
    for part in (scaled_part, sum_part):
        (made,) = part.overloads.values()
        assert not made.library._codegen._engine.is_symbol_defined(made.fndesc.llvm_func_name)
    (whole,) = summed.overloads.values()
    assert whole.library._codegen._engine.is_symbol_defined(whole.fndesc.llvm_func_name)


def test_a_part_that_borrows_counts_no_references():
    def sum_until_5(table, count):
        total = 0.0
        for k in range(count):
            for x in table[0][k]:
                if x > 5:
                    break
                total += x
        return total

    def counts(**options):
        part = kernels.kernel_part(**options)(sum_until_5)
        assert kernels.kernel()(lambda table, count: part(table, count))((np.ones((4, 2)), 1), 3) == 6.0
        (made,) = part.overloads.values()
        return made.library.get_llvm_str().count("@NRT_incref(")

    assert counts() > 0
    assert counts(borrows=True) == 0


def test_a_part_that_borrows_neither_makes_nor_returns_nor_gets_arrays():
    @kernels.kernel_part()
    def first(a):
        return a[0]

    @kernels.kernel_part(borrows=True)
    def returns(a):
        return 1, a

    @kernels.kernel_part(borrows=True)
    def gets(a):
        return first(a)[0]

    @kernels.kernel_part(borrows=True)
    def makes(a):
        return np.empty(len(a)).size

    @kernels.kernel_part(borrows=True)
    def copies(a):
        return a[a > 0].size

    @kernels.kernel_part(borrows=True)
    def adds(a):
        return (a + a)[0, 0]

    for part, why in ((returns, "return"), (gets, "get"), (makes, "get"), (copies, "get"), (adds, "get")):
        with pytest.raises(NumbaError, match=f"borrows arrays and must not {why}"):
            kernels.kernel()(lambda a, part=part: part(a))(np.ones((2, 2)))
    assert kernels.kernel()(lambda a: first(a)[0])(np.ones((2, 2))) == 1.0, "parts that are called are not changed"


def test_garbage_is_collected_again_after_compiling():
    enabled = []

    @kernels.kernel()
    def grown(x):
        return x + 2

    with decorators._garbage_kept():
        enabled.append(gc.isenabled())
    assert grown(1) == 3
    assert enabled == [False]
    assert gc.isenabled()


# --- kernels that come compiled -----------------------------------------------------------------------------------------
SHIPPED = """
from h3data.kernels import kernel, kernel_part
{imports}
SIZE = {size}

@kernel_part()
def grown(x):
    {comment}
    return x + {step}

@kernel()
def many(x):
    return SIZE * grown(x)
"""
HIGHER, BASE = shipped.LEVELS
USE = "from h3data.sample import many; print(many(2.0), many(2), sum(many.stats.cache_misses.values()))"


class Site:
    """A folder of installed packages: a copy of h3data's kernels, a module with one of its own, and the package beside."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name in ("__init__", "progress", "files", "errors", "terminal"):
            (folder / "h3data").mkdir(parents=True, exist_ok=True)
            text = "" if name == "__init__" else (ROOT / "h3data" / f"{name}.py").read_text()
            (folder / "h3data" / f"{name}.py").write_text(text)
        shutil.copytree(ROOT / "h3data" / "kernels", folder / "h3data" / "kernels")
        self.kernels, self.higher = (folder / shipped.PACKAGE / shipped.folder_name(level) for level in (BASE, HIGHER))
        self.kernels.mkdir(parents=True)

    def run(self, *, size=3, step=1, comment="# nothing", imports="", record=False, options=(), **settings) -> str:
        text = SHIPPED.format(size=size, step=step, comment=comment, imports=imports)
        (self.folder / "h3data" / "sample.py").write_text(text)
        environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
        environment |= {"PYTHONPATH": str(self.folder), "NUMBA_CACHE_DIR": str(self.folder / "cache")}
        environment |= {"H3DATA_QUIET": "1", "PYTHONDONTWRITEBYTECODE": "1", **settings}
        if record:
            environment |= {
                "NUMBA_CPU_NAME": BASE,
                "NUMBA_CPU_FEATURES": "",
                shipped.RECORD: str(self.kernels),
            }
        shutil.rmtree(self.folder / "cache", ignore_errors=True)
        command = [sys.executable, *options, "-c", USE]
        done = subprocess.run(command, cwd=self.folder, env=environment, capture_output=True, text=True, check=False)
        return done.stdout.strip() or done.stderr


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    if shipped.lacking(BASE):
        pytest.skip(f"kernels are shipped for {BASE}")
    made = Site(tmp_path_factory.mktemp("site"))
    assert made.run(record=True) == "9.0 9 2"
    assert len(list(made.kernels.iterdir())) == 2
    return made


def test_shipped_kernels_are_not_compiled(site: Site):
    assert site.run(comment='"""Words that change nothing."""', imports="import math") == "9.0 9 0"


@pytest.mark.slow
def test_shipped_kernels_of_other_code_are_compiled(site: Site):
    assert site.run(step=2) == "12.0 12 2"
    assert site.run(size=4) == "12.0 12 2"
    assert site.run(NUMBA_BOUNDSCHECK="1") == "9.0 9 2"
    assert site.run(NUMBA_CPU_NAME="host") == "9.0 9 2"
    assert site.run(options=["-O"]) == "9.0 9 2"


@pytest.mark.slow
def test_damaged_kernels_are_compiled(site: Site):
    whole = {path: path.read_bytes() for path in site.kernels.iterdir()}
    try:
        for damage in (lambda data: b"", lambda data: data[:-60], lambda data: lzma.compress(b"\x80\x05N.")):
            for path, data in whole.items():
                path.write_bytes(damage(data))
            assert site.run() == "9.0 9 2"
    finally:
        for path, data in whole.items():
            path.write_bytes(data)


def test_damaged_kernels_of_a_higher_level_are_those_of_the_lower_one(site: Site):
    site.higher.mkdir()
    try:
        for path in site.kernels.iterdir():  # the other kernel is not there at all
            (site.higher / path.name).write_bytes(b"")
            break
        assert site.run() == "9.0 9 0"
    finally:
        shutil.rmtree(site.higher)


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of a package of kernels for both levels, which lies beside a copy of h3data; both are empty."""
    for name in [name for name in os.environ if name.startswith("NUMBA_")]:
        monkeypatch.delenv(name)
    monkeypatch.setattr(shipped, "__file__", str(tmp_path / "h3data" / "kernels" / "shipped.py"))
    monkeypatch.setattr(shipped.platform, "machine", lambda: "x86_64")
    for level in shipped.LEVELS:
        (tmp_path / shipped.PACKAGE / shipped.folder_name(level)).mkdir(parents=True)
    shipped._found.cache_clear()
    yield tmp_path / shipped.PACKAGE
    shipped._found.cache_clear()


def _levels(monkeypatch: pytest.MonkeyPatch, *without: str) -> list[str]:
    """Levels whose kernels a processor without some features gets, the first one first."""
    features = {name: name not in without for name in shipped.LEVELS[HIGHER]}
    monkeypatch.setattr(shipped, "llvm", SimpleNamespace(get_host_cpu_features=lambda: features))
    shipped._found.cache_clear()
    return [path.name.partition("-linux-")[2] for path in shipped.folders()]


def test_the_features_of_the_processor_choose_the_levels(package: Path, monkeypatch: pytest.MonkeyPatch):
    assert _levels(monkeypatch) == [HIGHER, BASE]
    assert shipped.missing() == ""
    for name in set(shipped.LEVELS[HIGHER]) - set(shipped.LEVELS[BASE]):
        assert _levels(monkeypatch, name) == [BASE]
    assert _levels(monkeypatch, "avx2", "fma") == []
    assert shipped.missing() == f"the processor is not of level {BASE}: it lacks avx2, fma"
    monkeypatch.setattr(shipped.platform, "machine", lambda: "aarch64")
    assert _levels(monkeypatch) == []


def test_levels_that_are_not_shipped_are_left_out(package: Path, monkeypatch: pytest.MonkeyPatch):
    (package / shipped.folder_name(HIGHER)).rmdir()
    assert _levels(monkeypatch) == [BASE]
    (package / shipped.folder_name(BASE)).rmdir()
    assert _levels(monkeypatch) == []
    assert shipped.missing().startswith("h3data-kernels has none for ")
    package.rmdir()
    assert _levels(monkeypatch) == []
    assert shipped.missing() == shipped.NOT_INSTALLED


def test_settings_of_numba_choose_one_level_or_none(package: Path, monkeypatch: pytest.MonkeyPatch):
    for level in shipped.LEVELS:
        monkeypatch.setenv("NUMBA_CPU_NAME", level)
        monkeypatch.setenv("NUMBA_CPU_FEATURES", "")
        assert _levels(monkeypatch) == [level]
        monkeypatch.setenv("NUMBA_CPU_FEATURES", "-fma")
        assert _levels(monkeypatch) == []
        assert shipped.missing() == "NUMBA_CPU_FEATURES, NUMBA_CPU_NAME may change what is compiled"


def test_only_what_is_beside_h3data_is_read(tmp_path: Path, monkeypatch):
    """Files of compiled kernels are pickles: a folder of that name elsewhere must not be opened."""
    (tmp_path / shipped.PACKAGE / shipped.folder_name(BASE)).mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    shipped._found.cache_clear()
    try:
        assert not any(tmp_path in folder.parents for folder in shipped.folders())
    finally:
        shipped._found.cache_clear()


@pytest.mark.slow
def test_the_builder_compiles_for_another_level(tmp_path: Path):
    """The kernel of a file for the lowest level, for the same arguments and under the same name."""
    folder = ROOT / "pipelines" / shipped.PACKAGE / shipped.folder_name(BASE)
    given = next(folder.glob("h3data.bodies.people.kernels.attention.turn_gaze-*"), None)
    if given is None or shipped.lacking(HIGHER):
        pytest.skip(f"needs {folder.name} and a processor of {HIGHER}")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    environment |= {"NUMBA_CPU_NAME": HIGHER, "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(tmp_path / "numba")}
    environment |= {shipped.RECORD: str(tmp_path), "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'pipelines'}"}
    subprocess.run([sys.executable, folder.parent / "build.py", given], env=environment, check=True)
    assert (tmp_path / given.name).is_file()
    fields = [pickle.loads(lzma.decompress(path.read_bytes())) for path in (given, tmp_path / given.name)]
    assert fields[0][3] == fields[1][3], "arguments and result"


def test_types_have_digests_that_tell_them_apart():
    class Point(NamedTuple):
        x: float
        y: float

    turned = collections.namedtuple("Point", ["y", "x"])
    turned.__qualname__, turned.__module__ = Point.__qualname__, Point.__module__
    kinds = [
        types.NamedUniTuple(types.float64, 2, Point),
        types.NamedUniTuple(types.float64, 2, turned),  # numba prints both alike
        types.UniTuple(types.float64, 2),
        types.Array(types.float64, 2, "C"),
        types.Array(types.float64, 2, "A"),
        types.Array(types.float64, 2, "C", readonly=True),
        types.Array(types.float64, 2, "C", aligned=False),
        types.Omitted(1.0),
        types.Omitted(2.0),
        types.int64,
        types.boolean,
        types.none,
    ]
    found = {digests.types_digest([kind]) for kind in kinds}
    assert len(found) == len(kinds)
    with pytest.raises(digests.UnknownError):
        digests.types_digest([types.ListType(types.int64)])


def test_a_kernel_that_reads_something_strange_is_not_shipped():
    strange = object()

    @kernels.kernel()
    def reads_it(x):
        return x if strange is None else -x

    with pytest.raises(digests.UnknownError):
        digests.code_digest(reads_it)
    assert shipped.file_name(reads_it, (types.int64,)) is None


def test_the_package_of_kernels_is_for_the_numba_that_setup_installs():
    """Otherwise no kernel of it would be used, and nothing would say so: run `make kernels` after a change of version."""
    package = ROOT / "pipelines" / shipped.PACKAGE
    pinned = next(line for line in (ROOT / "constraints.txt").read_text().splitlines() if line.startswith("numba=="))
    assert f'dependencies = ["{pinned}"]' in (package / "pyproject.toml").read_text()
    folders = {path.parent.name for path in package.glob("*/*.nbc.xz")}
    assert folders
    assert {name.split("-")[2] for name in folders} == {pinned.replace("==", "")}


def test_shipped_kernels_belong_to_this_code():
    """Where this fails, the code of kernels has changed since they were compiled: run `make kernels` and commit.

    Stale files are never used; deleting them mends this too, and their kernels are compiled at first use again.
    """
    folders = [ROOT / "pipelines" / shipped.PACKAGE / shipped.folder_name(level) for level in shipped.LEVELS]
    stamps = {path.name.rsplit("-", 1)[0] for folder in folders for path in folder.glob("*")}
    if not stamps:
        pytest.skip(f"no kernels are shipped for {folders[-1].name}")
    for stamp in stamps:
        importlib.import_module(stamp.rsplit("-", 1)[0].rpartition(".")[0])
    now = {shipped.code_stamp(kernel) for kernel in decorators._kernels if kernel.__module__.startswith(digests.OURS)}
    assert stamps <= now, f"run make kernels, or git rm {' '.join(f'{stamp}*' for stamp in stamps - now)}"


def test_a_profiler_changes_no_digest() -> None:
    grid = np.random.default_rng(0).random((4, 5)), np.zeros(2), 0.1, np.array([[0.3, 0.4]])
    sample_sdf_many(*grid)
    before = digests.code_digest(sample_sdf_many)
    profiler = sys.getprofile()
    sys.setprofile(lambda *_: None)
    try:
        sample_sdf_many(*grid)
    finally:
        sys.setprofile(profiler)
    assert digests.code_digest(sample_sdf_many) == before


def test_an_index_that_names_renamed_modules_is_made_anew(tmp_path: Path) -> None:
    class Kept:
        _index_path = str(tmp_path / "kernel.nbi")

        def _load_index(self) -> dict[object, str]:
            raise ModuleNotFoundError("The module a is b now.")

    Path(Kept._index_path).write_bytes(b"old")
    assert decorators._index_of(Kept()) == {}
    assert not Path(Kept._index_path).exists()


def test_entries_give_what_kernels_give_and_pickle_without_machine_code():
    sdf, origin, points = np.random.default_rng(0).random((4, 5)), np.zeros(2), np.array([[0.3, 0.4], [1.2, 0.1]])
    call = Entries()
    for _ in range(2):  # the first call finds the machine code, the second one uses it
        assert (call(sample_sdf_many, sdf, origin, 0.3, points) == sample_sdf_many(sdf, origin, 0.3, points)).all()
    again = pickle.loads(pickle.dumps(call))
    assert (again(sample_sdf_many, sdf, origin, 0.3, points) == sample_sdf_many(sdf, origin, 0.3, points)).all()
    assert call(sample_sdf_many.py_func, sdf, origin, 0.3, points[:0]).shape == (0,)  # as with NUMBA_DISABLE_JIT
