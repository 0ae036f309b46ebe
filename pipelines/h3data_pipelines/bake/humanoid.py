"""Bake a person into `datasets/bodies/<name>.npz`: ``python -m h3data_pipelines.bake.humanoid [NAME ...]``.

Needs the extra ``bodies`` (anny 0.6.2: 130 s and 1.8 GB the first time) and fast_simplification. The phenotype that made a
body is stored in its file. Results are committed: users never run this.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from h3data.bodies.skeleton import JOINT_INDEX
from h3data_pipelines.bake.cutting import Cloth
from h3data_pipelines.bake.garments import Outfit

LOD_FACES = 3000
"""Triangles of the light mesh before it is cut along the hems, which adds about 1,000."""


@dataclass(frozen=True, kw_only=True)
class BodySpec:
    """What one shipped body is made from."""

    phenotype: dict[str, float]
    """anny's parameters; ``height`` is found from the stature."""
    stature_m: float
    outfit: Outfit


def _outfit(bun_m: float = 0.0, hair_m: float = 0.022, **colors: tuple[int, int, int]) -> Outfit:
    base = {"sclera": (238, 234, 228), "soles": (232, 230, 225), "socks": (226, 226, 222)}
    return Outfit(colors=base | colors, bun_m=bun_m, hair_m=hair_m)


BODIES = {
    "female_0": BodySpec(
        phenotype={
            "gender": 1, "age": 0.67, "muscle": 0.50, "weight": 0.45, "proportions": 0.6, "cupsize": 0.5,
            "firmness": 0.5, "african": 0, "asian": 0, "caucasian": 1,
        },
        stature_m=1.63,
        outfit=_outfit(
            bun_m=0.042, skin=(226, 178, 150), shirt=(72, 148, 146), trousers=(52, 60, 86), shoes=(196, 92, 72),
            hair=(74, 48, 34), brows=(84, 56, 42), iris=(70, 92, 84),
        ),
    ),
    "male_0": BodySpec(
        phenotype={
            "gender": 0, "age": 0.67, "muscle": 0.55, "weight": 0.45, "proportions": 0.6, "cupsize": 0.5,
            "firmness": 0.5, "african": 0, "asian": 0, "caucasian": 1,
        },
        stature_m=1.76,
        outfit=_outfit(
            hair_m=0.014, skin=(214, 164, 134), shirt=(214, 196, 160), trousers=(74, 82, 66), shoes=(70, 74, 84),
            hair=(52, 40, 32), brows=(58, 44, 36), iris=(84, 66, 48),
        ),
    ),
}  # fmt: skip


def decimated(mesh: Cloth, faces: int) -> Cloth:
    """A mesh of about ``faces`` triangles; weights from the three nearest old vertices by inverse distance."""
    import fast_simplification
    from scipy.spatial import cKDTree

    eye = mesh.weights[:, [JOINT_INDEX["left_eye_smplhf"], JOINT_INDEX["right_eye_smplhf"]]].sum(axis=1) > 0.9
    eyes = mesh.faces[eye[mesh.faces].all(axis=1)]
    rest = mesh.faces[~eye[mesh.faces].any(axis=1)]
    vertices, triangles = fast_simplification.simplify(
        mesh.vertices.astype(np.float32), rest, target_count=faces - len(eyes), agg=4
    )
    used, compact = np.unique(triangles, return_inverse=True)
    eyes_used, eyes_compact = np.unique(eyes, return_inverse=True)
    vertices = np.concatenate([vertices[used], mesh.vertices[eyes_used]])
    triangles = np.concatenate([compact.reshape(-1, 3), eyes_compact.reshape(-1, 3) + len(used)])
    distance, nearest = cKDTree(mesh.vertices).query(vertices, k=3)
    share: NDArray[np.float64] = 1 / (distance + 1e-6)
    share /= share.sum(axis=1, keepdims=True)
    weights = np.einsum("vk,vkj->vj", share, mesh.weights[nearest])
    return Cloth(vertices=vertices.astype(np.float64), weights=weights, faces=triangles.astype(np.int32))
