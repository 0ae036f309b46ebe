"""Script that bakes ``datasets/bodies/shape_space.toml``: principal directions of the shapes of all built-in bodies.

``python -m bake.people.shape_space`` (needs the built-in bodies, and nothing else). A direction is a row of weights of
these bodies that sum to 0, scaled so that a step of 1 along it is one standard deviation; weights are rounded to six
digits, so that all machines get the same people, independent of their linear algebra library.
"""

from __future__ import annotations

import sys

import numpy as np

from h3data.bodies.people.humanoid_file import VERTEX_UNIT_M, _builtin_arrays, from_planes, humanoid_names
from h3data.bodies.people.random_humanoid import DIRECTIONS, SHAPE_SPACE
from h3data.builtin import builtin_root


def main() -> None:
    """Write the file and print the share of variance that the directions explain."""
    names = humanoid_names()
    shapes = [VERTEX_UNIT_M * from_planes(_builtin_arrays(name)["base_delta"]).astype(np.float64) for name in names]
    off_mean = np.stack([shape.ravel() for shape in shapes])
    off_mean -= off_mean.mean(axis=0)
    variances, weights = np.linalg.eigh(off_mean @ off_mean.T / len(names))
    variances, weights = variances[::-1], weights[:, ::-1]
    # a direction u = sum(w_i x_i) / (n sigma) has unit length; sigma steps along it are one standard deviation
    rows = (weights[:, :DIRECTIONS] / np.sqrt(len(names))).T
    rows *= np.sign(rows[np.arange(DIRECTIONS), np.abs(rows).argmax(axis=1)])[:, None]
    lines = [
        "# By `python -m bake.people.shape_space`: weights of the built-in bodies, a row for each direction of shape.",
        "bodies = [",
    ]
    lines += [f'    "{name}",' for name in names] + ["]", "directions = ["]
    lines += ["    [" + ", ".join(f"{w:.6f}" for w in row) + "]," for row in rows] + ["]"]
    (builtin_root() / SHAPE_SPACE).write_text("\n".join(lines) + "\n")
    share = variances[:DIRECTIONS].sum() / variances.sum()
    sys.stdout.write(f"{DIRECTIONS} directions of {len(names)} bodies hold {share:.2%} of the variance\n")


if __name__ == "__main__":
    main()
