"""Script that adds results of ``h3data benchmark run`` to the baselines of their benchmarks.

The results replace earlier rows of the same policies. Check them with ``h3data benchmark verify`` first.

python -m bake.benchmark_baselines out/RESULT...
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import msgspec

from h3data_pipelines.benchmark.definition import BASELINES, find_benchmark
from h3data_pipelines.benchmark.result import read_result


def main(*folders: str) -> None:
    """Write the file of baselines of each result's benchmark."""
    for folder in folders:
        result = read_result(Path(folder))
        if not result.is_complete:
            raise SystemExit(f"{folder}: not all episodes were played.")
        path = find_benchmark(result.benchmark).folder / BASELINES
        new = msgspec.to_builtins(result)
        del new["files"]
        policies = {row["policy"] for row in new["rows"]}
        before = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []
        for one in before:
            one["rows"] = [row for row in one["rows"] if row["policy"] not in policies]
        kept = [one for one in before if one["rows"]]
        path.write_text(json.dumps([*kept, new], indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
