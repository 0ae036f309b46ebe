"""Free space of procedural homes: building, loading, exact distances, and how wrong the lattice's are.

CPU seconds of this process, everything warm, the median of some rounds but for ``build_s``; queries are single calls from
Python between uniform random points, but for ``bulk_us`` and ``field_us``, which are per pair of one call.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from benchmarks.sim import cpu_s
from h3data.kernels import kernel
from h3data.scene import FreeSpace
from h3data.scene.freespace._visibility import Graph, sees
from h3data_habitat.navmesh.pathfinder import PathFinder
from h3data_homes import HomeSpec, build_home
from h3data_homes.spec import Preset

SEEDS = (1, 2, 3)
QUERIES = 400
PAIRS = 4000
ORACLE_PAIRS = 100
ROUNDS = 5

Emit = Callable[[str, float, str], None]


def run(emit: Emit) -> None:
    """Emit
    ``freespace.<preset>.{build_s,lattice_s,load_s,geodesic_us,pathfinder_us,path_us,bulk_us,field_us,lattice_us,
    error_median,error_p95,exact_error_max}``.
    """
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
        loaded = [FreeSpace.load(path) for _ in range(ROUNDS)]
    lattice_s = _seconds(lambda: loaded.pop().lattice)
    exact = space.geodesic(a, b)
    far = exact > 1  # as in the research: below, a millimetre is a large fraction
    error = np.abs(space.geodesic_lattice(a, b) - exact)[far] / exact[far]
    pairs = list(zip(a[:QUERIES], b[:QUERIES], strict=True))
    finder = PathFinder(space)
    y = space.floor_y
    ends = [(np.array([p[0], y, p[1]]), np.array([q[0], y, q[1]])) for p, q in pairs]
    field = space.distance_field(b[0])
    few = far.nonzero()[0][:ORACLE_PAIRS]
    plain = plain_distances(space, a[few], b[few])
    return {
        "lattice_s": lattice_s,
        "load_s": load_s,
        "geodesic_us": _each_us(lambda: [space.geodesic(p, q) for p, q in pairs], QUERIES),
        "pathfinder_us": _each_us(lambda: [finder.geodesic_distance(p, q) for p, q in ends], QUERIES),
        "path_us": _each_us(lambda: [space.path(p, q) for p, q in pairs], QUERIES),
        "bulk_us": _each_us(lambda: space.geodesic(a, b), PAIRS),
        "field_us": _each_us(lambda: field.distance(a), PAIRS),
        "lattice_us": _each_us(lambda: [space.geodesic_lattice(p, q) for p, q in pairs], QUERIES),
        "error_median": float(np.median(error)),
        "error_p95": float(np.percentile(error, 95)),
        "exact_error_max": float(np.abs(exact[few] / plain - 1).max()),
    }


def plain_distances(space: FreeSpace, a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return lengths [N] [m] by the complete visibility graph of all corners and both ends, and Dijkstra: nothing is
    left out.
    """
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import dijkstra

    nodes = np.concatenate([a, b, space.graph.nodes])
    pairs = _all_that_see_each_other(space.graph, nodes)
    length = np.linalg.norm(nodes[pairs[:, 0]] - nodes[pairs[:, 1]], axis=1)
    n = len(a)
    graph = csr_matrix((length, pairs.T), (len(nodes), len(nodes)))
    return dijkstra(graph, directed=False, indices=np.arange(n))[np.arange(n), n + np.arange(n)]


@kernel()
def _all_that_see_each_other(graph: Graph, nodes: NDArray) -> NDArray:
    out = np.empty((1024, 2), np.int64)
    count = 0
    for i in range(len(nodes)):
        for j in range(i + 1, len(nodes)):
            if sees(graph, nodes[i, 0], nodes[i, 1], nodes[j, 0], nodes[j, 1]):
                if count == len(out):
                    out = np.concatenate((out, np.empty_like(out)))
                out[count, 0], out[count, 1] = i, j
                count += 1
    return out[:count]


def _seconds(work: Callable[[], object]) -> float:
    return median(cpu_s(work) for _ in range(ROUNDS))


def _each_us(work: Callable[[], object], count: int) -> float:
    return _seconds(work) / count * 1e6
