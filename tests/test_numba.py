"""What kernels take from inside numba, which promises nothing of it. Nothing of h3data is imported before that is checked."""

from __future__ import annotations

import inspect
import pkgutil
import re
import tomllib
from collections.abc import Iterable

import numba
import numba.extending

from tests.paths import ROOT
from tests.test_structure import modules

WHAT_TO_DO = (
    "Keep numba below this version in pyproject.toml until h3data/kernels/parts.py, decorators.py and shipped.py fit it; "
    "then raise the bound and the pin in constraints.txt, and run `make kernels`."
)


def version(text: str) -> tuple[int, ...]:
    return tuple(map(int, text.split(".")[:2]))


def test_the_next_numba_is_refused_until_it_has_been_tried() -> None:
    dependencies = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"]
    (bounds,) = (re.fullmatch(r"numba>=([\d.]+),<([\d.]+)", one) for one in dependencies if one.startswith("numba"))
    assert bounds, "numba needs a lower and an upper bound"
    pinned = re.search(r"^numba==([\d.]+)$", (ROOT / "constraints.txt").read_text(encoding="utf-8"), re.MULTILINE)
    assert pinned
    major, minor = version(pinned[1])
    assert version(bounds[2]) == (major, minor + 1), (
        f"the newest that is allowed is the one that is tested. {WHAT_TO_DO}"
    )
    assert version(bounds[1]) <= version(numba.__version__) < version(bounds[2]), WHAT_TO_DO


MEMBERS = {
    "numba.core.codegen.JITCodeLibrary": "_optimize_functions _optimize_final_module _finalize_final_module",
    "numba.core.codegen.CPUCodeLibrary": "_finalize_dynamic_globals _ensure_finalized",
    "numba.core.typed_passes.NativeLowering": "run_pass",
    "numba.core.compiler.Compiler": "define_pipelines",
    "numba.core.dispatcher.Dispatcher": "compile add_overload get_call_template",
    "numba.core.caching.IndexDataCacheFile": "_load_index _data_path load",
    "numba.core.caching.FunctionCache": "_index_key load_overload",
    "numba.core.caching._CacheLocator": "get_suitable_cache_subpath",
    "numba.misc.appdirs.AppDirs": "user_cache_dir",
    "numba._dynfunc": "make_function",
}
ARGUMENTS = {
    "numba.core.compiler.CompileResult._rebuild": "target_context libdata fndesc env signature objectmode lifted typeann "
    "reload_init referenced_envs",
    "numba.core.dispatcher.Dispatcher.compile": "sig",
    "numba.core.caching.FunctionCache._index_key": "sig codegen",
    "numba.core.codegen.JITCodeLibrary._optimize_functions": "ll_module",
    "numba.core.typed_passes.NativeLowering.run_pass": "state",
}


def imports_of_numba() -> set[str]:
    """What the sources import from the modules of numba, as dotted names."""
    found = set()
    for path in modules().values():
        text = path.read_text(encoding="utf-8")
        for module, members in re.findall(r"^from (numba[\w.]*) import \(?([\w, ]+)", text, re.MULTILINE):
            found |= {f"{module}.{member.split()[0]}" for member in members.split(",") if member.strip()}
    return found


def absent(names: Iterable[str]) -> list[str]:
    """Dotted names that lead to nothing."""
    missing = []
    for name in sorted(names):
        try:
            pkgutil.resolve_name(name)
        except (ImportError, AttributeError):
            missing.append(name)
    return missing


def test_numba_still_has_what_kernels_take_from_inside_it() -> None:
    """Nothing of this is promised. pyproject.toml bounds numba's version; a new one is allowed once this holds for it."""
    names = imports_of_numba()
    assert {"numba.core.compiler.CompileResult", "numba.core.dispatcher.Dispatcher"} <= names
    names |= {
        f"{owner}.{member}" for owner, members in MEMBERS.items() for member in members.split()
    } | ARGUMENTS.keys()
    missing = absent(names)
    assert not missing, f"numba {numba.__version__} has no {', '.join(missing)}. {WHAT_TO_DO}"
    for name, known in ARGUMENTS.items():
        now = [each for each in inspect.signature(pkgutil.resolve_name(name)).parameters if each != "self"]
        assert now == known.split(), f"numba {numba.__version__} has other arguments of {name}. {WHAT_TO_DO}"


def test_what_is_absent_is_found() -> None:
    names = ["numba.njit", "numba.core.no_module.Thing", "numba.core.codegen.NoClass"]
    assert absent(names) == ["numba.core.codegen.NoClass", "numba.core.no_module.Thing"]


def test_a_kernel_has_what_its_cache_is_made_of() -> None:
    from h3data import kernels

    @kernels.kernel()
    def sample(x):
        return x

    assert sample(1) == 1
    assert {"nogil", "no_cfunc_wrapper"} <= set(sample.targetoptions)
    assert hasattr(sample._cache._cache_file, "_source_stamp")
    assert isinstance(sample._cache_hits, dict)
    assert hasattr(sample, "_cache_misses")

    @numba.extending.intrinsic
    def emitted(context, x):
        return x(x), lambda context, builder, signature, arguments: arguments[0]

    assert type(emitted).__module__ == "numba.core.extending"
    assert type(emitted).__name__ == "_Intrinsic"
    assert (emitted.__module__, emitted.__name__) == (__name__, "emitted")
