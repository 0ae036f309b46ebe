"""Free space of procedural homes: building, loading, exact and quick distances, and how wrong the quick ones are.

CPU seconds of this process, everything warm; queries are single calls from Python between uniform random points.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import numpy as np

from h3data.scene import FreeSpace, HomeSpec, build_home
from h3data.scene.homes.spec import Preset

SEEDS = (1, 2, 3)
QUERIES = 400
PAIRS = 4000

Emit = Callable[[str, float, str], None]


def run(emit: Emit) -> None:
    """Emits ``freespace.<preset>.{build_s,lattice_s,load_s,geodesic_us,path_us,fast_us,error_median,error_p95}``."""
    _measure(
        FreeSpace.from_scene(build_home(HomeSpec(seed=0, preset="small")), cache=False)
    )  # compiles or loads kernels
    for preset in get_args(Preset):
        rows = []
        for seed in SEEDS:
            home = build_home(HomeSpec(seed=seed, preset=preset))
            start = time.process_time()
            space = FreeSpace.from_scene(home, cache=False)
            rows.append({"build_s": time.process_time() - start, **_measure(space)})
        for name in rows[0]:
            unit = {"s": "s", "us": "us"}.get(name.rpartition("_")[2], "fraction")
            emit(f"freespace.{preset}.{name}", float(np.median([row[name] for row in rows])), unit)


def _measure(space: FreeSpace) -> dict[str, float]:
    a, b = space.sample(np.random.default_rng(0), 2 * PAIRS).reshape(2, PAIRS, 2)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "space.npz"
        space.save(path)
        load_s = _seconds(lambda: FreeSpace.load(path))
    lattice_s = _seconds(lambda: space.lattice)
    exact = space.geodesic(a, b)
    far = exact > 1  # as in the research: below, a millimetre is a large fraction
    error = np.abs(space.geodesic_fast(a, b) - exact)[far] / exact[far]
    pairs = list(zip(a[:QUERIES], b[:QUERIES], strict=True))
    return {
        "lattice_s": lattice_s,
        "load_s": load_s,
        "geodesic_us": _seconds(lambda: [space.geodesic(p, q) for p, q in pairs]) / QUERIES * 1e6,
        "path_us": _seconds(lambda: [space.path(p, q) for p, q in pairs]) / QUERIES * 1e6,
        "fast_us": _seconds(lambda: [space.geodesic_fast(p, q) for p, q in pairs]) / QUERIES * 1e6,
        "error_median": float(np.median(error)),
        "error_p95": float(np.percentile(error, 95)),
    }


def _seconds(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start
