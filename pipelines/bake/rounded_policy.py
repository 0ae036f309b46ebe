"""A policy file for the package: weights rounded to 11 significant bits, which halves its size in the wheel.

``python -m pipelines.bake.rounded_policy run/policy.npz datasets/policies/end_to_end.npz``

The file has the same form. It is another policy, if hardly, so scores are to be measured with it.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

DROPPED_BITS = 13
"""Of the 24 significant bits of a float32."""


def rounded(weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """The nearest numbers whose last `DROPPED_BITS` bits are 0, ties away from it."""
    bits = np.ascontiguousarray(weights).view(np.uint32) + np.uint32(1 << (DROPPED_BITS - 1))
    return (bits & np.uint32(0xFFFFFFFF << DROPPED_BITS & 0xFFFFFFFF)).view(np.float32)


def main(source: Path, out: Path) -> None:
    with np.load(source) as held:
        arrays = {name: held[name] for name in held.files}
    np.savez(out, **{n: rounded(a) if a.dtype == np.float32 else a for n, a in arrays.items()})  # type: ignore[arg-type]


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
