"""Script that packs a policy file as planes of bytes, which are smaller in the wheel.

``python -m bake.packed_policy run/policy.npz datasets/policies/learn_pop.npz`` changes no number. ``--rounded`` also
rounds weights to 11 significant bits, which halves their size. The policy then differs slightly, so its scores must be
measured again.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from h3data.files import part_file
from sim_kinematic.policies.network import PLANES, read_arrays

DROPPED_BITS = 13
"""Number of dropped bits of the 24 significant bits of a float32, by ``--rounded``."""


def rounded(weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the nearest numbers whose last `DROPPED_BITS` bits are 0, with ties away from zero."""
    bits = np.ascontiguousarray(weights).view(np.uint32) + np.uint32(1 << (DROPPED_BITS - 1))
    return (bits & np.uint32(0xFFFFFFFF << DROPPED_BITS & 0xFFFFFFFF)).view(np.float32)


def to_planes(array: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return the bytes of an array [...] as planes, uint8 [4, ...]: first bytes of all numbers, then second bytes.

    They compress better, by a fifth where the last bits are 0.
    """
    # little-endian on every machine, as the planes go into files
    planes = np.moveaxis(np.ascontiguousarray(array, "<f4")[..., None].view(np.uint8), -1, 0)
    return np.ascontiguousarray(planes)


def main(source: Path, out: Path, *, rounding: bool) -> None:
    """Write the packed policy file, with rounded weights if requested."""
    _, arrays = read_arrays(source)
    packed = {}
    for name, array in arrays.items():
        if array.dtype == np.float32:
            packed[name + PLANES] = to_planes(rounded(array) if rounding else array)
        else:
            packed[name] = array
    with part_file(out) as part, part.open("wb") as stream:
        np.savez(stream, **packed)  # type: ignore[arg-type]


if __name__ == "__main__":
    files = [Path(word) for word in sys.argv[1:] if word != "--rounded"]
    main(*files, rounding="--rounded" in sys.argv)
