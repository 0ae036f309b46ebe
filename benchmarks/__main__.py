"""Command ``python -m benchmarks``, which runs benchmark groups and stores their figures in ``benchmarks/results/``."""

from __future__ import annotations

import argparse
import importlib
import importlib.metadata
import inspect
import json
import os
import platform
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

FOLDER = Path(__file__).parent
GROUPS = sorted(p.stem for p in FOLDER.glob("[a-z]*.py"))


def main(arguments: list[str]) -> int:
    """Run the groups named in ``arguments`` (all when none is); ``render`` is also ``render_h2h`` and so on."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("groups", nargs="*", metavar="GROUP", help=f"any of: {', '.join(GROUPS)} (default: all)")
    parser.add_argument(
        "--episodes", type=int, help="episodes of each task, for groups that simulate some (penetration)"
    )
    parser.add_argument(
        "--robot",
        action="append",
        metavar="NAME|FILE",
        help="a robot by name or URDF, or 'all' that are shipped, again for more (penetration; default: quad_arm)",
    )
    parser.add_argument(
        "--human",
        action="append",
        metavar="NAME",
        help="a body of people, or 'all' that are shipped, again for more (penetration: they wander)",
    )
    parser.add_argument(
        "--model",
        action="append",
        metavar="NAME",
        help="a model of crowds, again for more (people; default: orca, social_force and, for speed alone, wander)",
    )
    parser.add_argument(
        "--place", action="append", metavar="NAME", help="a place, again for more (people; default: all)"
    )
    parser.add_argument(
        "--tracks",
        action="append",
        metavar="FILE",
        help="a file of tracks, or a recording that h3data import has written, again for more (people: these alone)",
    )
    options = parser.parse_args(arguments)
    wanted: list[str] = options.groups
    if options.episodes is not None and options.episodes < 1:
        parser.error(f"Expected at least 1 episode, got {options.episodes}.")
    unknown = sorted(set(wanted) - set(GROUPS))
    if unknown:
        sys.stderr.write(f"error: unknown groups {unknown}. Expected some of: {', '.join(GROUPS)}.\n")
        return 2
    figures: dict[str, tuple[float, str]] = {}

    def emit(name: str, value: float, unit: str) -> None:
        figures[name] = (value, unit)
        print(f"{name} {value:.6g} {unit}", flush=True)

    for group in [g for g in GROUPS if not wanted or any(g == w or g.startswith(w + "_") for w in wanted)]:
        run = importlib.import_module(f"benchmarks.{group}").run
        given = {"episodes": options.episodes, "robots": options.robot, "humans": options.human}
        given |= {"models": options.model, "places": options.place, "tracks": options.tracks}
        takes = inspect.signature(run).parameters
        run(emit, **{name: value for name, value in given.items() if value is not None and name in takes})
    record = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": " ".join(["python -m benchmarks", *arguments]),
        "machine": {"processor": _processor(), "gpu": _gpu(), "cpus": os.cpu_count(), "platform": platform.platform()},
        "versions": {p: _version(p) for p in ("h3data", "numpy", "numba", "pyarrow", "mcap")},
        "figures": {name: {"value": value, "unit": unit} for name, (value, unit) in figures.items()},
    }
    (FOLDER / "results").mkdir(exist_ok=True)
    path = FOLDER / "results" / f"{time.strftime('%Y%m%d-%H%M%S')}-{'-'.join(wanted) or 'all'}.json"
    path.write_text(json.dumps(record, indent=2) + "\n")
    return 0


def _version(package: str) -> str | None:
    """Return the version of a package; None if it is not installed, because h3data may be a source tree on the path."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    names = [line.partition(":")[2].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
    return names[0] if names else platform.processor()


def _gpu() -> str | None:
    """Return the first GPU, if a group has used torch and there is one."""
    torch = sys.modules.get("torch")
    return torch.cuda.get_device_name() if torch is not None and torch.cuda.is_available() else None


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
