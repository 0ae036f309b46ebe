"""Compiled kernels are compiled anew when anything changes that went into them."""

from __future__ import annotations

import ast
import gc
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba.core.runtime import _nrt_python  # type: ignore[attr-defined]
from numba.core.runtime.nrt import rtsys

from h3data import kernels
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
from h3data import kernels
kernels.OURS = ("h3data", "stale_kernel", "stale_part", "stale_constants")
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
        "h3data.render.raster.raster": {"h3data.render.raster.raster_simd", "h3data.render.raster.vectors"},
        "h3data.render.shade.shading": {
            "h3data.render.shade.occlusion_simd",
            "h3data.render.raster.vectors",
            "h3data.render.raster.raster",
        },
        "sim_kinematic.motion.step": {"h3data.scene.freespace._sdf", "sim_kinematic.motion.spec"},
    }.items():
        __import__(module)
        seen, waiting = set(), {module}
        while waiting:
            name = waiting.pop()
            seen.add(name)
            waiting |= set(kernels._source(name)[1]) - seen
        assert inside <= seen


def test_nothing_is_cached_past_the_decorator():
    for path in [*(ROOT / "h3data").rglob("*.py"), *(ROOT / "sim_kinematic").rglob("*.py")]:
        if path.name == "kernels.py" and path.parent.name == "h3data":
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
        return lambda function: function

    monkeypatch.setattr(kernels, "njit", njit)
    kernels._warn_once.cache_clear()
    with pytest.warns(RuntimeWarning, match="NUMBA_CACHE_DIR"):
        assert kernels.kernel()(abs)(-2) == 2
    assert kernels.kernel()(abs)(-3) == 3, "and it says so only once"


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


def test_garbage_is_collected_again_after_compiling():
    enabled = []

    @kernels.kernel()
    def grown(x):
        return x + 2

    with kernels._garbage_kept():
        enabled.append(gc.isenabled())
    assert grown(1) == 3
    assert enabled == [False]
    assert gc.isenabled()
