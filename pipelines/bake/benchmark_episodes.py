"""Script for the episodes of a benchmark: ``python -m bake.benchmark_episodes datasets/benchmarks/NAME@VERSION``.

Use it only for a new version, because the list of a published version never changes.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from h3data.progress import progress
from h3data_pipelines.benchmark.definition import EPISODES, FORMAT, list_episodes, read_benchmark


def main(folder: Path) -> None:
    """Write ``episodes.json`` beside ``benchmark.toml``."""
    benchmark = read_benchmark(folder)
    if (folder / EPISODES).exists():
        raise SystemExit(f"{folder / EPISODES} exists. Remove it first if this version was never published.")
    entries = list(progress(list_episodes(benchmark.jobs()), desc="episodes", unit="episode"))
    lines = ",\n".join("  " + json.dumps(entry) for entry in entries)
    (folder / EPISODES).write_text(f'{{"format": {FORMAT}, "episodes": [\n{lines}\n]}}\n', encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
