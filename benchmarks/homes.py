"""Time to generate a home: CPU seconds of this process, as the median and the worst of several seeds, with warm caches."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import get_args

import numpy as np

from h3data_homes import HomeSpec, build_home
from h3data_homes.spec import Preset

SEEDS = {"small": range(20), "medium": range(20), "large": range(7)}

Emit = Callable[[str, float, str], None]


def run(emit: Emit) -> None:
    """Emit ``homes.<preset>.generate_s`` and ``homes.<preset>.generate_worst_s``."""
    for preset in get_args(Preset):
        build_home(HomeSpec(seed=0, preset=preset))
        seconds = []
        for seed in SEEDS[preset]:
            start = time.process_time()
            build_home(HomeSpec(seed=seed, preset=preset))
            seconds.append(time.process_time() - start)
        emit(f"homes.{preset}.generate_s", float(np.median(seconds)), "s")
        emit(f"homes.{preset}.generate_worst_s", max(seconds), "s")


if __name__ == "__main__":
    run(lambda name, value, unit: print(name, f"{value:.4g}", unit))
